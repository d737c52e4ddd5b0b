"""Registration of a casting with uniform stock: the whole way, and at the command line."""

from __future__ import annotations

import functools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from example_scans import model, pose_error, vane, with_noise

from vanejax.cad.investment_casting import InvestmentCasting, as_cast
from vanejax.cli.program import main
from vanejax.errors import InputError
from vanejax.localization import PoseResult, refine, register
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, Scanner, hemisphere_viewpoints
from vanejax.scans.scan_file import save_points

STOCK_MM = 0.5


@functools.cache
def stocked() -> tuple[np.ndarray, RigidTransform]:
    """Points of a casting with 0.5 mm of stock and 0.1 mm of noise, and part_from_camera."""
    casting = InvestmentCasting(allowance_mm=STOCK_MM, waviness_mm=0.0)
    cast = as_cast(vane(), casting, np.random.default_rng(0))
    pose = hemisphere_viewpoints(vane().center).view(45)
    scan = Scanner(cast).scan(Camera(width=320, height=256), pose)
    return with_noise(scan.points.astype(np.float64), 0.1, 0), pose.inverse()


@functools.cache
def found(max_allowance_mm: float | None = None) -> PoseResult:
    points, truth = stocked()
    return register(points, vane(), init=truth, max_allowance_mm=max_allowance_mm)


def test_stock_moves_the_part_unless_it_is_estimated() -> None:
    points, truth = stocked()
    plain = refine(model(vane()), points, truth)
    assert pose_error(vane(), plain.part_from_camera, truth)[1] > 0.3
    assert max(pose_error(vane(), found().part_from_camera, truth)) < 0.03
    form = found().refinement.form
    assert form.stock_mm == pytest.approx(STOCK_MM, abs=4 * form.stock_sigma_mm)
    assert 0 < form.stock_sigma_mm < 0.01
    assert "stock 0." in found().verdict.reason


@pytest.mark.parametrize("most_mm", [0.0, 0.2])
def test_the_largest_allowance_is_a_bound(most_mm: float) -> None:
    _, truth = stocked()
    result = found(most_mm)
    assert result.refinement.form.stock_mm == most_mm
    assert ("stock 0.200 mm, its largest" in result.verdict.reason) == (most_mm == 0.2)
    # a smooth deviation takes up the rest of what is there all the same
    _, off_mm = pose_error(vane(), result.part_from_camera, truth)
    assert result.verdict.status != "accepted" or off_mm < 0.2


def test_the_checks_are_of_the_part_under_its_stock() -> None:
    """Deviations are those of the noise, and not of the stock, at the right pose."""
    checked = found().verification
    assert found().verdict.status == "accepted"
    assert checked.inlier_share > 0.85
    assert np.nanmedian(checked.deviation_mm) == pytest.approx(0, abs=0.02)
    # three robust deviations of 0.1 mm of noise, seen at the angles of a vane
    assert checked.tolerance_mm < STOCK_MM


@pytest.mark.parametrize("wrong", [-1.0, float("nan"), float("inf")])
def test_stock_that_cannot_be_is_refused_at_once(wrong: float) -> None:
    with pytest.raises(InputError, match="max_allowance_mm must be 0 mm or more"):
        register("no such file", "none either", max_allowance_mm=wrong)


def test_the_command_says_how_much_stock_there_is(tmp_path: Path, capsys) -> None:
    points, truth = stocked()
    save_points(tmp_path / "scan.ply", points)
    (tmp_path / "init.json").write_text(
        json.dumps({"part_from_camera": truth.as_matrix().tolist()})
    )
    arguments = ["register", str(tmp_path / "scan.ply"), "vane", "--json", str(tmp_path / "p.json")]
    arguments += ["--init", str(tmp_path / "init.json"), "--sensor-origin", "0,0,0"]
    assert main(arguments) == 0
    assert re.search(r"form +stock 0\.(49|50)\d \+- 0\.00\d mm", capsys.readouterr().out)
    written = json.loads((tmp_path / "p.json").read_text())["form_deviation"]
    assert written["stock_mm"] == pytest.approx(STOCK_MM, abs=0.03)
    assert main([*arguments, "--max-allowance-mm", "-1"]) == 2
    assert "max_allowance_mm must be 0 mm or more" in capsys.readouterr().err
