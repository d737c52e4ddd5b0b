"""The weights that come with the package know the built-in guide vane, and nothing else."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from vanejax.cad import Part, guide_vane, part_from_mesh
from vanejax.cli.program import main
from vanejax.errors import InputError
from vanejax.localization.matched_poses import match_poses
from vanejax.localization.registration import register
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, Scanner, hemisphere_viewpoints
from vanejax.scans.measured_scan import MeasuredScan
from vanejax.training.weight_file import TrainedMatcher, find_weights


@pytest.fixture(scope="module")
def part() -> Part:
    return guide_vane()


@pytest.fixture(scope="module")
def matcher(part: Part) -> TrainedMatcher:
    return find_weights("pretrained", part)


def part_of(mesh: trimesh.Trimesh, name: str) -> Part:
    return part_from_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), name=name)


def test_the_file_says_what_it_is(matcher: TrainedMatcher, part: Part) -> None:
    assert matcher.part_name == part.name
    trained = matcher.trained
    assert trained["step"] == trained["config"]["training"]["steps"]
    assert trained["config"]["part"] == {"path": "", "units": "mm"}
    figures = trained["evaluation"]
    recorded = json.loads((Path(__file__).parents[2] / "experiments/results/vane.json").read_text())
    # the file, the recorded result and so the pages are of one run
    assert figures["views"] == recorded["views"] == 54
    assert figures["summary"] == recorded["summary"]


@pytest.mark.slow
def test_it_knows_the_part_in_other_files(matcher: TrainedMatcher, part: Part) -> None:
    rounded = part.mesh.copy()
    rounded.vertices = np.round(rounded.vertices, 3)  # as a text file may have it
    for mesh in (rounded, part.mesh.subdivide()):
        again = part_of(mesh, "again")
        assert again.sha256 != part.sha256
        assert matcher.knows(again)


@pytest.mark.parametrize(
    "change",
    [
        "scaled",
        "moved",
        "more",
        pytest.param("mirrored", marks=pytest.mark.slow),
        pytest.param("filled", marks=pytest.mark.slow),
    ],
)
def test_it_knows_no_other_part(matcher: TrainedMatcher, part: Part, change: str) -> None:
    mesh = part.mesh.copy()
    if change == "scaled":
        mesh.apply_scale(1.01)
    elif change == "moved":
        mesh.apply_translation([0.5, 0.0, 0.0])
    elif change == "mirrored":
        mesh.apply_transform(np.diag([1.0, -1.0, 1.0, 1.0]))
        mesh.apply_translation([0.0, 2 * part.center[1], 0.0])
    elif change == "filled":
        mesh = mesh.convex_hull
    else:  # every point of the vane is there, and a block in the empty corner of its box besides
        middle = part.center + np.array([48.0, -18.0, -15.0])
        block = trimesh.creation.box(bounds=[middle - 5.0, middle + 5.0])
        mesh = trimesh.util.concatenate([mesh, block])
    other = part_of(mesh, change)
    if change == "more":
        assert (other.center == part.center).all()
        assert other.radius == part.radius
    with pytest.raises(InputError, match=f"no pretrained weights for {change}"):
        find_weights("pretrained", other)


@pytest.mark.slow
def test_the_network_alone_comes_near_and_the_product_to_the_pose(
    matcher: TrainedMatcher, part: Part
) -> None:
    pose = hemisphere_viewpoints(part.center).view(100)
    scan = Scanner(part).scan(Camera(width=640, height=512), pose)
    measured = MeasuredScan(scan.points.astype(np.float64), None, np.zeros(3))
    truth = pose.inverse()
    nudge = Rotation.from_rotvec([0.3, -0.2, 0.25]).as_matrix()  # 25 deg about the part's centre
    rough = RigidTransform(
        nudge @ truth.rotation,
        nudge @ (truth.translation - part.center) + part.center + [8.0, -6.0, 4.0],
    )
    guess = RigidTransform(rough.rotation[None], rough.translation[None])
    found = match_poses(matcher, measured, guess, iterations=matcher.iterations)
    cosine = (np.trace(found.rotation[0].T @ truth.rotation) - 1) / 2
    assert np.degrees(np.arccos(cosine)) < 2.0  # 1.2 at most on its test views
    result = register(measured, part, init=rough, weights="pretrained")
    assert result.verdict.status == "accepted"
    np.testing.assert_allclose(result.part_from_camera.as_matrix(), truth.as_matrix(), atol=5e-3)


def test_weights_of_another_part_are_refused(matcher: TrainedMatcher, part: Part) -> None:
    other = dataclasses.replace(matcher, part_sha256="0" * 64, center=matcher.center + 1.0)
    with pytest.raises(InputError, match="trained for guide-vane segment"):
        register(np.zeros((100, 3)), part, weights=other)


@pytest.mark.slow
def test_the_command_takes_them_by_name(part: Part, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("VANEJAX_CACHE_DIR", "off")
    assert main(["scan", "vane", "--out", "scans", "--views", "7,", "--resolution", "0.25"]) == 0
    scan = "scans/view_007.ply"
    command = ["register", scan, "vane", "--weights", "shipped", "--json", "pose.json"]
    assert main([*command, "--quiet"]) == 0
    assert json.loads(Path("pose.json").read_text())["weights"] == "shipped"
    box = part_of(part.mesh.convex_hull, "box")
    box.export("box.stl")
    assert main(["register", scan, "box.stl", "--weights", "pretrained"]) == 2
    assert "no pretrained weights for box" in capsys.readouterr().err
