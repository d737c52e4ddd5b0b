"""When a scan is taken apart, and what the points left out still have to say."""

from __future__ import annotations

import dataclasses
import functools
import json

import numpy as np
import pytest
from example_scans import (
    batch,
    bracket,
    disturbed,
    measured_points,
    model,
    pose_error,
    random_view,
    vane,
    with_noise,
)

from vanejax.cli.program import main
from vanejax.errors import InputError
from vanejax.localization import PoseResult, clutter_removal, register
from vanejax.localization.clutter_removal import segmentations, with_clutter, without_clutter
from vanejax.machine.pose_file import read_pose
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, Clutter, clutter_scene, hemisphere_viewpoints
from vanejax.scans import MeasuredScan, Segment, Segments, clean_scan, save_points

CAMERA = Camera(width=320, height=256, near_mm=200.0)
EVERYTHING = Clutter(table=True, tilt_deg=2.0, clamps=2, chips=15, drops=10)


@functools.cache
def cluttered(seed: int = 0) -> tuple[MeasuredScan, np.ndarray, RigidTransform]:
    """A vane's scan among everything, which points are its own [N] bool, and part_from_camera."""
    scene = clutter_scene(vane(), EVERYTHING, np.random.default_rng([7, seed]))
    pose = hemisphere_viewpoints(vane().center).view(60 + 31 * seed)
    scan = scene.scanner().scan(CAMERA, pose)
    points = with_noise(scan.points.astype(np.float64), 0.1, seed)
    return (
        clean_scan(points, sensor_origin=np.zeros(3)),
        scene.owner(scan.face) == 0,
        pose.inverse(),
    )


@functools.cache
def found() -> PoseResult:
    scan, _, truth = cluttered()
    return register(scan, vane(), init=disturbed(vane(), truth, 10, 10, seed=0))


def given(tables: int, others: int, parts: int = 1000) -> Segments:
    label = np.repeat(np.array([0, 1, 2], np.uint8), [parts, tables, others])
    return Segments(label, ())


# --- registration -------------------------------------------------------------------------------


def test_a_vane_on_a_table_between_clamps_is_found():
    """As near to the truth as from its own points alone: what stays on it does not pull."""
    scan, mine, truth = cluttered()
    assert mine.mean() < 0.2
    assert found().verdict.status == "accepted"
    assert max(pose_error(vane(), found().part_from_camera, truth)) < 0.01
    assert any("taken away as a table" in note for note in found().notes)
    checked, status = found().verification.checked, found().verification.status
    assert len(checked) < 0.3 * len(scan.points)
    assert np.mean(mine[checked[status == 0]]) > 0.99  # the indices are those of the whole scan


@pytest.mark.slow
def test_off_leaves_the_scan_as_it_is():
    """Four of five points are none of the part's: nothing is accepted, and nothing taken away."""
    scan, _, truth = cluttered()
    result = register(scan, vane(), segment="off", init=disturbed(vane(), truth, 2, 2, seed=0))
    assert result.verdict.status == "rejected"
    assert not any("taken away" in note for note in result.notes)


def test_without_clutter_nothing_changes():
    points, truth = measured_points(bracket(), random_view(bracket(), 1))
    init = disturbed(bracket(), truth, 3, 3, seed=0)
    plain = register(points, bracket(), init=init, segment="off")
    same = register(points, bracket(), init=init, segment="on")
    for name in ("rotation", "translation"):
        a, b = (getattr(result.part_from_camera, name) for result in (plain, same))
        assert a.tobytes() == b.tobytes()
    assert plain.notes == same.notes
    np.testing.assert_array_equal(plain.verification.status, same.verification.status)


# --- in which order -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("when", "larger", "segments", "expected"),
    [
        ("off", True, given(900, 900), "w"),
        ("on", True, given(900, 0), "s"),
        ("on", False, given(0, 500), "s"),
        ("on", True, given(0, 0), "w"),  # nothing to take away
        ("auto", False, given(100, 100), "ws"),
        ("auto", False, given(0, 0), "w"),
        ("auto", False, given(0, 10), "w"),  # too little to matter
        ("auto", True, given(100, 100), "ws"),  # registration bears a third
        ("auto", True, given(300, 400), "sw"),
        ("auto", True, given(1500, 0), "s"),  # the whole cannot be accepted
        ("auto", True, given(30, 1500, parts=10), "w"),  # too few for a pose
    ],
)
def test_the_likelier_is_tried_first(when, larger, segments, expected, monkeypatch):
    monkeypatch.setattr(clutter_removal, "is_larger", lambda *_: larger)
    monkeypatch.setattr(clutter_removal, "segment", lambda *_, **__: segments)
    scan = MeasuredScan(np.zeros((len(segments.label), 3)), None, np.zeros(3))
    tried = list(segmentations(scan, vane(), when))
    assert "".join("w" if attempt is None else "s" for attempt in tried) == expected


def test_a_clean_scan_that_is_right_is_not_taken_apart(monkeypatch):
    points, _ = measured_points(vane())
    monkeypatch.setattr(clutter_removal, "segment", None)
    scan = clean_scan(points)
    assert next(segmentations(scan, vane(), "auto")) is None


def test_a_word_that_is_none():
    with pytest.raises(InputError, match="segment"):
        next(segmentations(cluttered()[0], vane(), "perhaps"))


# --- what is left out ---------------------------------------------------------------------------


def test_only_the_parts_points_are_kept():
    scan, _, _ = cluttered()
    normals = np.tile(np.float32([0, 0, 1]), (len(scan.points), 1))
    label = np.zeros(len(scan.points), np.uint8)
    label[::3], label[1::3] = Segment.TABLE, Segment.OTHER
    some = without_clutter(dataclasses.replace(scan, normals=normals), Segments(label, ()))
    np.testing.assert_array_equal(some.points, scan.points[2::3])
    assert some.normals.shape == some.points.shape
    assert f"{np.sum(label == 1):,} were taken away as a table" in some.notes[-1]


def test_a_table_seen_through_the_part_rejects_the_pose():
    """The part is moved to where the table was seen; the points left out know that."""
    scan, mine, truth = cluttered()
    segments = Segments(np.where(mine, 0, 1).astype(np.uint8), ())
    aside = RigidTransform(truth.rotation, truth.translation + np.array([0.0, 60.0, 12.0]))
    result = dataclasses.replace(found(), part_from_camera=aside)
    indices = dataclasses.replace(result.verification, checked=np.arange(100))
    result = dataclasses.replace(result, verification=indices)
    wrong = with_clutter(result, scan, segments, model(vane()))
    assert wrong.verdict.status == "rejected"
    assert "through" in wrong.verdict.reason
    now = model(vane()).residuals(batch(aside), scan.points[~mine])
    behind = now.hit & (now.deviation_mm < -result.verification.tolerance_mm)
    assert f"{behind.sum() / mine.sum():.0%}" in wrong.verdict.reason
    right = with_clutter(
        dataclasses.replace(result, part_from_camera=truth), scan, segments, model(vane())
    )
    assert right.verdict is result.verdict
    np.testing.assert_array_equal(right.verification.checked, np.flatnonzero(mine)[:100])


def test_of_rays_that_are_not_known_nothing_is_said():
    scan, mine, truth = cluttered()
    segments = Segments(np.where(mine, 0, 1).astype(np.uint8), ())
    aside = RigidTransform(truth.rotation, truth.translation + np.array([0.0, 60.0, 12.0]))
    result = dataclasses.replace(found(), part_from_camera=aside, sensor_origin=None)
    indices = dataclasses.replace(result.verification, checked=np.arange(100))
    result = dataclasses.replace(result, verification=indices)
    assert with_clutter(result, scan, segments, model(vane())).verdict is result.verdict


def test_the_command_takes_the_part_out_of_its_scene(tmp_path, capsys) -> None:
    scan, _, truth = cluttered()
    save_points(tmp_path / "scan.ply", scan.points)
    arguments = ["register", str(tmp_path / "scan.ply"), "vane", "--sensor-origin", "0,0,0"]
    # with a table in it a scan is so large that nobody knows its unit
    arguments += ["--json", str(tmp_path / "pose.json"), "--units-scan", "mm"]
    init = disturbed(vane(), truth, 10, 10, seed=0).as_matrix().tolist()
    (tmp_path / "init.json").write_text(json.dumps({"part_from_camera": init}))
    arguments += ["--init", str(tmp_path / "init.json")]
    assert main([*arguments, "--segment", "on"]) == 0
    assert "taken away as a table" in " ".join(capsys.readouterr().out.split())
    pose = read_pose(tmp_path / "pose.json")
    assert max(pose_error(vane(), pose, truth)) < 0.15
    assert main([*arguments, "--segment", "perhaps"]) == 2
    assert "choose from" in capsys.readouterr().err
