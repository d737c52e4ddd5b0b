"""Procedural solids: closed, of one body, the same for the same seed, sampled as scans are."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.spatial

from vanejax.training.generic_solids import make_solid, make_solids

COUNT = 24


@pytest.fixture(scope="module")
def solids() -> tuple[np.ndarray, list[str]]:
    return make_solids(COUNT, seed=0, num_points=2000)


def test_samples_fill_the_unit_sphere(solids):
    samples, names = solids
    assert samples.shape == (COUNT, 2000, 6)
    assert samples.dtype == np.float32
    assert len(set(names)) == COUNT
    reach = np.linalg.norm(samples[..., :3], axis=2).max(axis=1)
    assert reach.max() <= 1 + 1e-6  # f32 eps x 10
    assert reach.min() > 0.8  # the farthest corner is 1 away, points come near
    # as `Part.center`: the bounding box is centred, as far as 2000 points reach its sides
    middle = 0.5 * (samples[..., :3].max(axis=1) + samples[..., :3].min(axis=1))
    assert np.abs(middle).max() < 0.1
    np.testing.assert_allclose(np.linalg.norm(samples[..., 3:], axis=2), 1, atol=1e-6)


def test_normals_look_out(solids):
    """The divergence theorem on the samples: mean(p . n) area / 3 is the volume, and positive."""
    for number, (sample, name) in enumerate(zip(*solids, strict=True)):
        part = make_solid(number, 0)
        assert part.name == name
        area = part.triangles.areas().sum() / part.radius**2
        heights = np.sum(sample[:, :3] * sample[:, 3:], axis=1)
        volume = part.triangles.volume() / part.radius**3
        assert volume > 0
        # five standard errors of the mean
        error = 5 * heights.std() / np.sqrt(2000) * area / 3
        np.testing.assert_allclose(heights.mean() * area / 3, volume, atol=error)


def test_each_is_one_closed_body():
    for number in range(COUNT):
        part = make_solid(number, 0)
        assert part.closed
        assert part.notes == ()  # nothing to repair, no second body, no cavity
        assert part.mesh.is_watertight
        assert part.mesh.body_count == 1


def test_they_differ(solids):
    """No two are alike: of their sorted distances from the centre, none agree."""
    reach = np.sort(np.linalg.norm(solids[0][..., :3], axis=2), axis=1)
    assert scipy.spatial.distance.pdist(reach, "chebyshev").min() > 0.01
    # all have been worked on; each of the family turns up
    recipes = " ".join(solids[1])
    assert all(" + " in name or " - " in name for name in solids[1])
    for name in ("box", "cylinder", "cone", "torus", "capsule", "prism", "twisted prism"):
        assert name in recipes


def test_a_seed_names_its_solids(solids):
    samples, names = make_solids(3, seed=0, num_points=2000)
    np.testing.assert_array_equal(samples, solids[0][:3])  # whatever number is asked for
    assert names == solids[1][:3]
    assert make_solid(2, 0).sha256 == make_solid(2, 0).sha256
    assert make_solid(2, 1).sha256 != make_solid(2, 0).sha256
