"""The table of real scans: on a folder made here, and on the real one where it is there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.studies.real_scans import study as real_scans
from experiments.studies.real_scans.study import KnownScan, load_truth
from experiments.studies.verdicts.challenge_parts import challenge_parts
from experiments.studies.verdicts.depth_camera import measure, random_pose
from vanejax.cad.symmetry import rotation_about
from vanejax.errors import InputError
from vanejax.rigid import RigidTransform
from vanejax.scanner import Scanner
from vanejax.scans import save_points

REAL = Path(__file__).parents[4] / "shared" / "data" / "real_scans"
REAL_SCANS = load_truth(REAL) if REAL.is_dir() else []
IN_DEFAULT_RUN = ("Range_Hood_1.ply", "Separator_1.ply")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scans in metres of a housing whose CAD file is in centimetres."""
    folder = tmp_path_factory.mktemp("scans")
    part = challenge_parts(["pump_housing"])["pump_housing"].part
    small = part.mesh.copy()
    small.apply_scale(0.1)
    small.export(folder / "pump.stl")
    entries = []
    for number in range(2):
        pose = random_pose(np.random.default_rng(number), part, 300.0)
        points = measure(part, Scanner(part), pose, kind="depth_camera", seed=number)
        save_points(folder / f"pump_{number}.ply", points / 1000)
        known_pose = {"scan_units": "m", "scan_from_cad_mm": [pose.as_matrix().tolist()]}
        files = {"scan": f"pump_{number}.ply", "cad": "pump.stl", "cad_unit_mm": 10.0}
        entries.append(files | known_pose)
    (folder / "ground_truth.json").write_text(json.dumps(entries))
    return folder


def test_a_folder_becomes_a_table(folder: Path, record, capsys) -> None:
    report = record(real_scans, "real_scans", str(folder))
    assert (report["scans"], report["right"], report["accepted_wrong"]) == (2, 2, 0)
    assert max(row["translation_mm"] for row in report["rows"]) < 5
    printed = capsys.readouterr().out
    assert "pump_1.ply" in printed
    assert "2 of 2 right (within 5 deg and 5 mm)" in printed
    assert "sensor" not in report


@pytest.mark.slow
def test_a_named_sensor_is_a_second_column(folder: Path, record, capsys) -> None:
    report = record(real_scans, "real_scans", str(folder), "--sensor", "consumer_depth")
    again = report["sensor"]
    assert (again["name"], again["scans"], again["right"]) == ("consumer_depth", 2, 2)
    for before, after in zip(report["rows"], again["rows"], strict=True):
        assert before["scan"] == after["scan"]
        assert before["rotation_deg"] != after["rotation_deg"]
    assert "without what the window of consumer_depth rounds off" in capsys.readouterr().out


def known(poses: np.ndarray) -> KnownScan:
    return KnownScan(Path("scan"), Path("cad"), "m", "mm", poses)


def test_the_error_is_that_to_the_nearest_right_pose() -> None:
    truth = RigidTransform(
        Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix(), np.array([5.0, 6.0, -300.0])
    ).as_matrix()
    other = truth @ rotation_about(np.array([0.0, 0.0, 1.0]), 180.0, np.zeros(3))
    shifted = truth.copy()
    shifted[:3, 3] += [3.0, 0.0, 4.0]
    found = RigidTransform.from_matrix(shifted).inverse()
    assert known(truth[None]).error(found) == pytest.approx((0.0, 5.0), abs=1e-6)
    # turned about its own origin, the part's place stays
    turned = RigidTransform.from_matrix(other).inverse()
    assert known(truth[None]).error(turned) == pytest.approx((180.0, 0.0), abs=1e-6)
    assert known(np.stack([truth, other])).error(turned) == pytest.approx((0.0, 0.0), abs=1e-6)


def entry(**changes: object) -> dict[str, object]:
    good = {"scan": "a.ply", "cad": "a.stl", "cad_unit_mm": 1.0, "scan_from_cad_mm": [np.eye(4).tolist()]}  # fmt: skip # noqa: E501
    return good | changes


def test_a_single_matrix_is_one_answer(tmp_path: Path) -> None:
    truth = [entry(scan_from_cad_mm=np.eye(4).tolist(), cad_unit_mm=25.4)]
    (tmp_path / "ground_truth.json").write_text(json.dumps(truth))
    (one,) = load_truth(tmp_path)
    assert one.camera_from_part.shape == (1, 4, 4)
    assert (one.cad_units, one.scan_units) == ("in", "auto")


@pytest.mark.parametrize(
    ("truth", "words"),
    [
        ([], "list of scans"),
        ({"scan": "a.ply"}, "list of scans"),
        (["a.ply"], "entry 0"),
        ([{"scan": "a.ply"}], "scan_from_cad_mm"),
        ([entry(), entry(cad_unit_mm=3.0)], "entry 1: cad_unit_mm"),
        ([entry(cad_unit_mm="wide")], "entry 0"),
        ([entry(scan=5)], "entry 0"),
        ([entry(scan_from_cad_mm=[[1, 2], [3, 4]])], "not \\[S, 4, 4\\]"),
        ([entry(scan_from_cad_mm=[])], "entry 0"),
        ([entry(scan_from_cad_mm=np.diag([2, 2, 2, 1]).tolist())], "scales by 2"),
        ([entry(scan_from_cad_mm=np.diag([1, 1, -1, 1]).tolist())], "mirror"),
    ],
)
def test_ground_truth_that_makes_no_sense_is_refused(tmp_path, truth, words) -> None:
    (tmp_path / "ground_truth.json").write_text(json.dumps(truth))
    with pytest.raises(InputError, match=words):
        load_truth(tmp_path)


def test_a_folder_without_ground_truth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"ground_truth\.json"):
        load_truth(tmp_path)


def test_an_accepted_wrong_pose_is_seen() -> None:
    good = {
        "scan": "a.ply", "rotation_deg": 1.0, "translation_mm": 2.0, "right": True,
        "verdict": "accepted", "alternatives": 0, "inlier_share": 0.9, "violation_share": None,
        "unmeasured_share": 0.0, "seconds": 1.0,
    }  # fmt: skip
    fine = real_scans.summarize([good, good])
    assert real_scans.table(fine).splitlines()[-1].startswith("met")
    wrong = real_scans.summarize([good, good | {"right": False, "rotation_deg": 175.0}])
    assert (wrong["right"], wrong["accepted"], wrong["accepted_wrong"]) == (1, 2, 1)
    assert wrong["mean_of_right"] == {"rotation_deg": 1.0, "translation_mm": 2.0}
    assert "WRONG" in real_scans.table(wrong)
    assert real_scans.table(wrong).splitlines()[-1].startswith("MISSED")
    none = real_scans.summarize([good | {"right": False}])
    assert none["mean_of_right"]["rotation_deg"] is None
    assert "0 of 1 right" in real_scans.table(none)
    slow = real_scans.summarize([good | {"seconds": 30.0}])
    assert real_scans.table(slow).splitlines()[-1].startswith("MISSED")


def as_case(scan: KnownScan):
    name = scan.scan.name
    return pytest.param(scan, marks=() if name in IN_DEFAULT_RUN else pytest.mark.slow, id=name)


@pytest.mark.parametrize("scan", map(as_case, REAL_SCANS))
def test_a_real_scan_is_within_5_deg_and_5_mm_from_no_guess(scan: KnownScan) -> None:
    """Scans of a depth camera: right, and never rejected."""
    (row,) = real_scans.measure([scan], seed=0)
    assert row["right"]
    assert row["verdict"] in ("accepted", "ambiguous")


@pytest.mark.skipif(not REAL_SCANS, reason=f"the real scans are not at {REAL}")
def test_all_15_real_scans_are_there() -> None:
    assert len(REAL_SCANS) == 15
    assert all(one.scan.is_file() and one.cad.is_file() for one in REAL_SCANS)
    assert {one.cad_units for one in REAL_SCANS} == {"mm", "cm"}
