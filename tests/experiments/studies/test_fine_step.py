"""The fine step leads from a method's unit-sphere frame to the CAD's millimetres and back."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest
import trimesh

from experiments.configs import smoke
from experiments.runner.registrations import Results, register_views
from experiments.studies.comparison.fine_step import FineStep
from vanejax.cad import Part, guide_vane, load_part
from vanejax.matching import Registration
from vanejax.rigid import RigidTransform
from vanejax.training import PairSampling, ScanSet, make_bank, make_scan_set

AWAY_MM = (60.0, -35.0, 20.0)  # a CAD file whose origin is not the part's centre


@pytest.fixture(scope="module")
def part(tmp_path_factory) -> Part:
    path = tmp_path_factory.mktemp("cad") / "away.stl"
    guide_vane().export(path)
    mesh = trimesh.load_mesh(path)
    mesh.apply_translation(AWAY_MM)
    mesh.export(path)
    return load_part(Path(path), units="mm")


@pytest.fixture(scope="module")
def scans(part: Part) -> ScanSet:
    config = smoke.get_config()
    config.views.azimuths_deg = (0.0, 40.0)
    viewpoints = config.make_viewpoints(part)
    return make_scan_set(part, config.make_camera(), viewpoints, voxel_mm=4.0, progress=False)


def registered(scans: ScanSet, register) -> Results:
    """Pairs without noise, of a pose up to 3 deg and 0.02 radii from the identity."""
    bank = make_bank(scans, num_reference=256)
    rows = int(bank.source_sizes.max())
    sampling = PairSampling(
        num_reference=256, num_source=rows, noise=0.0, max_rotation_deg=3.0, max_translation=0.02
    )
    return register_views(register, bank, sampling, seed=0, unit_mm=scans.radius_mm, progress=False)


def start_as_it_is(source, target, init, key) -> Registration:
    return Registration(init, np.array(True), np.int32(0), np.float32(0), np.float32(1))


def test_it_finds_the_pose_of_a_part_away_from_the_origin(part: Part, scans: ScanSet) -> None:
    found = registered(scans, start_as_it_is)
    refined = FineStep(part, scans)(found)
    assert np.linalg.norm(scans.center) > 30
    assert found.errors.rotation_deg.min() > 0.05  # something is left to find
    # points in f32 of a noiseless scan: a thousandth of a degree and of a millimetre, times ten
    assert refined.errors.rotation_deg.max() < 0.01
    assert refined.errors.translation_mm.max() < 0.01
    assert (refined.time_s > 0).all()


def test_a_pose_that_is_not_finite_stays(part: Part, scans: ScanSet) -> None:
    def lost(source, target, init, key) -> Registration:
        pose = RigidTransform(np.full((3, 3), np.nan, np.float32), np.zeros(3, np.float32))
        return start_as_it_is(source, target, pose, key)

    refined = FineStep(part, scans)(registered(scans, lost))
    assert np.isnan(refined.registration.target_from_source.rotation).all()
    assert np.isnan(refined.time_s).all()
    assert jax.tree.leaves(refined)[0].shape[0] == len(scans)
