"""The robustness study: its arguments, its sums, its tables and its picture."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments.runner.vane_views import perturb
from experiments.studies.robustness import report as robustness_report
from experiments.studies.robustness import study as robustness
from experiments.studies.robustness.disturbances import Stand
from vanejax.cad import guide_vane
from vanejax.errors import InputError
from vanejax.plotting import save_figure


def row(deg: float, mm: float) -> dict[str, Any]:
    errors = {
        "rotation_deg": deg,
        "translation_mm": mm,
        "rmse_mm": 0.8 + mm,
        "ffmde_abs_mm": 0.3 + mm,
        "time_s": 0.1,
    }
    fine = errors | {"rotation_deg": deg / 100, "translation_mm": mm / 100, "ffmde_abs_mm": 0.31}
    return {
        "points": 1000,
        "hole_share": 0.25,
        "foreign_share": 0.0,
        "truth": {"rmse_mm": 0.8, "ffmde_abs_mm": 0.3},
        "ideal": {"alone": errors, "refined": fine},
        "robust": {"alone": errors | {"rotation_deg": deg / 2}, "refined": fine},
    }


@pytest.fixture
def report() -> dict[str, Any]:
    few = [{"value": v, "rows": [row(1.0 + v, 0.5), row(0.2, 0.4)]} for v in (0.0, 10.0)]
    many = [{"value": 10.0 * k, "rows": [row(0.3, 0.2)]} for k in range(36)]
    return {
        "networks": {"ideal": {}, "robust": {}},
        "series": [
            {"name": "light", "title": "Strong light", "unit": "%", "paper": None, "steps": few},
            {
                "name": "angle",
                "title": "Angle",
                "unit": "deg",
                "paper": {"rmse_mm": 0.7904, "ffmde_abs_mm": 0.362},
                "steps": many,
            },
        ],
        "random": None,
    }


def found(number: int, deg: float, mm: float, verdict: str) -> dict[str, Any]:
    return {
        "number": number,
        "rotation_deg": deg,
        "translation_mm": mm,
        "right": deg < 0.1 and mm < 0.15,
        "verdict": verdict,
        "reason": "",
        "seconds": 1.0,
    }


def test_random_scans_are_summed_up():
    rows = [found(k, 0.01, 0.02, "accepted") for k in range(97)]
    rows += [
        found(97, 0.2, 0.02, "accepted"),
        found(98, 9.0, 4.0, "rejected"),
        found(99, 0.01, 0.01, "ambiguous"),
    ]
    summary = robustness.summarize_random(rows)
    assert summary["right"] == 0.98
    assert summary["accepted_wrong"] == 1
    assert summary["verdicts"]["rejected"] == {"right": 0, "wrong": 1}
    assert [row["number"] for row in summary["listed"]] == [97, 98, 99]
    assert summary["rotation_deg"]["max"] == 9.0
    words = robustness_report.random_lines(summary | {"network": "robust"})
    assert "98.0% right" in words
    assert "98 accepted (1 of them wrong)" in words


def test_tables_say_medians_shares_and_the_paper(report):
    step = report["series"][0]["steps"][1]
    assert robustness_report.share_within_need(step, "ideal", "alone") == 0.5  # 11 deg and 0.2 deg
    text = robustness_report.table(report)
    assert "FFMDE 0.3620, RMSE 0.7904 mm on average" in text
    assert "0 to 350" in text
    rows = [line.partition(" ideal ")[2].split() for line in text.splitlines() if " ideal " in line]
    assert [cells[0] for cells in rows] == ["0.600", "5.600", "0.300"]  # medians, deg
    markdown = robustness_report.markdown(report)
    assert markdown.count("### ") == 2
    assert len({line.count("|") for line in markdown.splitlines() if line.startswith("|")}) == 1


def test_the_picture_has_a_panel_for_each_series_and_figure_11(report, tmp_path):
    figure = robustness_report.picture(report)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["Strong light", "Angle", "", "", "Angle", "Angle", "", ""]
    metric = figure.axes[5]
    labels = {line.get_label(): line for line in metric.get_lines()}
    assert "paper, mean" in labels
    np.testing.assert_allclose(labels["refined by ray casting"].get_ydata(), 1.0)
    save_figure(figure, tmp_path / "robustness.png")
    assert (tmp_path / "robustness.png").stat().st_size > 20_000
    assert (tmp_path / "robustness.pdf").stat().st_size > 5_000


@pytest.mark.parametrize("words", [[], ["vane.npz"], ["a=1.npz", "a=2.npz"], ["=x.npz"]])
def test_weights_need_a_name_and_a_file(words):
    with pytest.raises(InputError, match="--weights"):
        robustness.parse_weights(words)


def test_weights_keep_their_order():
    files = robustness.parse_weights(["robust=b.npz", "ideal=a.npz"])
    assert files == {"robust": Path("b.npz"), "ideal": Path("a.npz")}
    assert list(files) == ["robust", "ideal"]
    assert robustness.make_parser().parse_args(["--weights", "a=b"]).views == 6


@pytest.fixture
def trial(monkeypatch) -> robustness.Trial:
    """A network that answers with its guess, and guesses that are nearly right."""
    part = guide_vane()
    points, normals, _ = part.sample(20_000, seed=0)
    network = SimpleNamespace(
        iterations=1, reference_points=points, reference_normals=normals, voxel_mm=2.0
    )
    monkeypatch.setattr(robustness, "match_poses", lambda matcher, scan, guess, **_: guess)
    monkeypatch.setattr(
        robustness, "_rough", lambda truth, part, rng: perturb(truth, part, deg=1, mm=1, rng=rng)
    )
    return robustness.Trial(part, {"guess": network})


@pytest.mark.slow
def test_a_series_is_refined_and_stock_is_found_where_it_says_so(trial):
    every = {one.name: one for one in Stand(trial.part, seed=0).series(views=3)}
    found = {}
    for name in ("casting", "stock"):
        report = robustness.run_series(
            trial, dataclasses.replace(every[name], values=(1.0,)), seed=0
        )
        (step,) = report["steps"]
        assert step["value"] == 1.0
        for row in step["rows"]:
            assert row["guess"]["alone"]["rotation_deg"] == pytest.approx(1.0)
            assert row["guess"]["alone"]["translation_mm"] == pytest.approx(1.0)
        found[name] = step["rows"]
    # the same scans from the same starts: castings with 0.5 mm of stock, and waves on it
    points = ([row["points"] for row in rows] for rows in found.values())
    assert next(points) == next(points)
    without, with_stock = (
        np.mean([row["guess"]["refined"]["translation_mm"] for row in rows])
        for rows in found.values()
    )
    assert without > 0.4
    assert with_stock < 0.7 * without  # the waves stay


def test_refinement_is_what_the_table_says_it_is(trial):
    series = {one.name: one for one in Stand(trial.part, seed=0).series(views=1)}["noise"]
    report = robustness.run_series(trial, dataclasses.replace(series, values=(0.0,)), seed=0)
    (row,) = report["steps"][0]["rows"]
    fine = row["guess"]["refined"]
    assert fine["rotation_deg"] < 0.1
    assert fine["translation_mm"] < 0.15
    assert fine["ffmde_abs_mm"] == pytest.approx(row["truth"]["ffmde_abs_mm"], abs=0.02)
    assert row["foreign_share"] == 0
