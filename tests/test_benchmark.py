"""The benchmark: what it counts, divides and runs; its times themselves are no test."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path

import numpy as np
import pytest

from experiments import benchmark
from experiments.benchmark import CountedRays, bare_rays, command, main, make_parser
from experiments.timing import Bench, Figure, summarize, table
from experiments.vane_views import VaneViews
from vanejax.camera import Camera
from vanejax.errors import InputError
from vanejax.refine import refine

SMALL = VaneViews(camera=Camera().scaled(0.1))


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench(repeats=2, seed=0, weights=None, views=SMALL)


def test_a_ratio_is_that_of_medians_and_skips_what_was_skipped() -> None:
    rows = summarize(
        [
            Figure("base", [1.0, 2.0, 9.0]),
            Figure("twice", [4.0, 3.0, 5.0], against="base", goal_s=3.0, note="a word"),
            Figure("missing", [], against="base", note="skipped: not here"),
            Figure("orphan", [1.0], against="missing"),
        ]
    )
    assert [row["ratio"] for row in rows] == [None, 2.0, None, None]
    assert rows[1]["seconds"] == {"median": 4.0, "min": 3.0, "max": 5.0}
    assert rows[2]["seconds"] is None
    lines = table(rows).splitlines()
    assert lines[2].split() == ["twice", "4.000", "3.000", "-", "5.000", "3", "2.00", "base"]
    assert "    skipped: not here" in lines


def test_repeats_do_not_count_the_first() -> None:
    calls = []
    seconds, result = Bench(repeats=3, seed=0, weights=None).time(lambda: calls.append(1) or 7)
    assert (len(calls), len(seconds), result) == (4, 3, 7)
    assert min(seconds) >= 0


def test_the_largest_view_is_taken(bench: Bench) -> None:
    counts = {view: len(SMALL.points(view)) for view in SMALL.select("test")}
    assert counts[bench.view] == max(counts.values())


def test_counting_changes_nothing(bench: Bench) -> None:
    model = SMALL.model
    counted = CountedRays(model.scanner, model.surface, model.sensor_origin)
    plain = refine(model, bench.points, bench.rough)
    found = refine(counted, bench.points, bench.rough)
    np.testing.assert_array_equal(
        found.part_from_camera.as_matrix(), plain.part_from_camera.as_matrix()
    )
    assert found.method == plain.method
    # the last stage casts every point; one stage more or less than iterations is no matter
    assert counted.rays.count(len(bench.points)) >= 1
    assert len(counted.rays) >= found.iterations


def test_bare_rays_are_those_of_the_scan(bench: Bench) -> None:
    pose = SMALL.truth(bench.view)
    scene, origins, directions = bare_rays(SMALL.part, pose, bench.points)
    assert origins.dtype == directions.dtype == np.float32
    face = scene.run(origins, directions)
    sensor = np.broadcast_to(pose.translation, bench.points.shape)
    expected = SMALL.model.scanner.cast(sensor, pose.rotate(bench.points)).face
    # float32 rays may take the neighbour at an edge
    assert np.mean(face == expected) > 0.99


def test_the_refinements_are_compared(tmp_path: Path, monkeypatch, capsys) -> None:
    small = functools.partial(Bench, views=SMALL)
    monkeypatch.setattr(benchmark, "Bench", small)
    arguments = ["--only", "refine", "--repeats", "1", "--out", str(tmp_path)]
    settings = make_parser().parse_args(arguments)
    report = main(settings)
    assert json.loads((tmp_path / "benchmark.json").read_text()) == report
    rows = {row["name"]: row for row in report["rows"]}
    assert rows["refine"]["ratio"] > 1
    assert rows["refine"]["goal_s"] == 0.5
    assert "medians of at least 5" in capsys.readouterr().out


def test_without_weights_half_of_the_registrations_are_skipped(bench: Bench) -> None:
    figures = list(benchmark.register_from(dataclasses.replace(bench, repeats=1)))
    assert [bool(figure.seconds) for figure in figures] == [True, False, False, True, True]
    assert all("accepted" in figure.note for figure in figures[3:])
    assert all("no --weights" in figure.note for figure in figures[1:3])


def test_each_first_run_has_an_empty_cache(bench: Bench, monkeypatch) -> None:
    runs = []

    def record(arguments: list[str], **environment: str) -> float:
        runs.append((arguments, environment.get("VANEJAX_CACHE_DIR")))
        if "register" in arguments:
            assert Path(arguments[3]).is_file()
        return float(len(runs))

    monkeypatch.setattr(benchmark, "_process", record)
    figures = list(command(bench))
    assert [len(figure.seconds) for figure in figures] == [2] * 5
    caches = [cache for arguments, cache in runs if cache]
    assert len(caches) == 8
    assert caches[::2] == caches[1::2]
    assert len(set(caches)) == 4
    assert sum("--init" in arguments for arguments, _ in runs) == 4
    first, second = figures[1:3]
    assert all(b == a + 1 for a, b in zip(first.seconds, second.seconds, strict=True))


def test_a_process_that_fails_is_no_time() -> None:
    assert benchmark._process(["-c", "raise SystemExit(3)"]) > 0
    with pytest.raises(InputError, match="went wrong"):
        benchmark._process(["-c", "raise SystemExit('it went wrong')"])


def test_an_unknown_benchmark_is_refused(tmp_path: Path) -> None:
    arguments = make_parser().parse_args(["--only", "refine,speed", "--out", str(tmp_path)])
    with pytest.raises(InputError, match="no benchmark speed; there are refine, register, command"):
        main(arguments)
