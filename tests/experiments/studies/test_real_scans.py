"""Real depth-camera scans of two parts, from no guess: right or in doubt, never accepted wrong."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from vanejax.cad.part import Part, part_from_mesh
from vanejax.localization.registration import register
from vanejax.rigid import RigidTransform

FOLDER = Path(__file__).parents[4] / "shared" / "data" / "real_scans"
LISTED = FOLDER / "ground_truth.json"
CASES = json.loads(LISTED.read_text()) if LISTED.exists() else []

pytestmark = pytest.mark.skipif(not CASES, reason=f"the real scans are not at {FOLDER}")


@functools.cache
def part(name: str, unit_mm: float) -> Part:
    mesh = trimesh.load(FOLDER / name)
    return part_from_mesh(np.asarray(mesh.vertices) * unit_mm, mesh.faces, name=Path(name).stem)


def error(found: RigidTransform, case: dict) -> tuple[float, float]:
    """Degrees, and mm between the part's origins in the scan's frame: of the nearest answer."""
    errors = []
    for matrix in case["scan_from_cad_mm"]:
        true = RigidTransform.from_matrix(np.asarray(matrix, np.float64))
        turn = Rotation.from_matrix(found.rotation @ true.rotation.T).magnitude()
        shift = np.linalg.norm(found.translation - true.translation)
        errors.append((float(np.degrees(turn)), float(shift)))
    return min(errors, key=max)


@pytest.mark.parametrize("case", CASES, ids=[case["scan"] for case in CASES])
def test_within_5_deg_and_5_mm_from_no_guess(case):
    result = register(
        FOLDER / case["scan"],
        part(case["cad"], case["cad_unit_mm"]),
        units_scan=case["scan_units"],
    )
    angle, shift = error(result.camera_from_part, case)
    assert angle < 5
    assert shift < 5
    np.testing.assert_array_equal(result.sensor_origin, np.zeros(3))
    assert result.verdict.status in ("accepted", "ambiguous")


def test_all_15_are_there():
    assert len(CASES) == 15
