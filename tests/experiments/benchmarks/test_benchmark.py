"""The benchmark: what it counts, divides, skips and runs; its times themselves are no test."""

from __future__ import annotations

import dataclasses
import functools
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from experiments import benchmark
from experiments.benchmarks import (
    compilation,
    evaluation,
    network,
    processes,
    registration,
    scaling,
    scanning,
)
from experiments.benchmarks.network import VanePairs
from experiments.benchmarks.registration import CountedRays, bare_rays, register_from
from experiments.benchmarks.scaling import Series
from experiments.benchmarks.timing import Bench, Figure, summarize, table
from experiments.runner import machine
from experiments.runner.vane_views import VaneViews
from vanejax.errors import InputError
from vanejax.localization import refine
from vanejax.scanner import Camera

SMALL = VaneViews(camera=Camera().scaled(0.1))


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench(repeats=2, seed=0, weights=None, views=SMALL)


@pytest.fixture
def once(bench: Bench) -> Bench:
    return dataclasses.replace(bench, repeats=1)


def test_a_peer_is_to_be_slower_and_a_limit_near() -> None:
    rows = summarize(
        [
            Figure("mine", [4.0, 3.0, 5.0], {"peer": 3.0}, {"limit": 1.5}, goal_s=3.0),
            Figure("quick", [2.0], {"peer": 3.0, "gone": 1.0}, {"limit": 1.5}, 3.0, "a word"),
            Figure("peer", [12.0, 6.0, 8.0]),
            Figure("limit", [2.0]),
            Figure("gone", [], note="skipped: not here"),
            Figure("asks for nothing", [1.0], {"peer": None}, {"limit": None}),
        ]
    )
    assert rows[0]["seconds"] == {"median": 4.0, "min": 3.0, "max": 5.0}
    ratios = [[entry["ratio"] for entry in row["against"]] for row in rows]
    assert ratios == [[2.0, 2.0], [4.0, None, 1.0], [], [], [], [8.0, 0.5]]
    words = [[entry["met"] for entry in row["against"]] for row in rows]
    assert words == [["missed"] * 2, ["met", None, "met"], [], [], [], [None, None]]
    assert [row["met"] for row in rows] == ["missed", "met", None, None, None, None]
    assert rows[4]["seconds"] is None
    lines = table(rows).splitlines()
    assert max(map(len, lines)) <= 100
    assert lines[1].split() == ["mine", "4.000", "3.000", "-", "5.000", "3:", "missed"]
    assert lines[2] == "    2.00 times as fast as peer (at least 3: missed)"
    assert "    1.00 times as long as limit (at most 1.5: met)" in lines
    assert "    not compared with gone" in lines
    assert "    skipped: not here" in lines


def test_repeats_do_not_count_the_first(monkeypatch) -> None:
    calls = []
    three = Bench(repeats=3, seed=0, weights=None)
    seconds, result = three.time(lambda: calls.append(1) or 7)
    assert (len(calls), len(seconds), result) == (4, 3, 7)
    assert min(seconds) >= 0
    assert len(three.time_sparingly(lambda: None)) == 3
    monkeypatch.setattr("experiments.benchmarks.timing.LONG_S", 0.0)
    assert len(three.time_sparingly(lambda: None)) == 1


def test_the_largest_view_is_taken(bench: Bench) -> None:
    counts = {view: len(SMALL.points(view)) for view in SMALL.select("test")}
    assert counts[bench.view] == max(counts.values())


@pytest.mark.parametrize(
    ("time", "more"),
    [
        (registration.open3d_icp, ()),
        (registration.small_gicp_icp, ()),
        (scanning.open3d_scan, (range(1), 1.0, "")),
        (network.torch_step, (VanePairs(),)),
        (network.torch_inference, (VanePairs(),)),
    ],
)
def test_a_peer_that_is_not_installed_is_skipped(time, more, bench, monkeypatch) -> None:
    for name in machine.PEERS:
        monkeypatch.setitem(sys.modules, name, None)
    figure = time(bench, *more)
    assert list(figure.seconds) == []
    assert figure.note.startswith("skipped: ")


# ---- scanning ----


def test_the_needed_rays_are_those_of_the_scan(bench: Bench) -> None:
    """In the window every point of a scan is hit, and hardly more."""
    scene = registration.bare_scene(SMALL.part)
    pose = SMALL.viewpoints.view(bench.view)
    origins, directions = scanning.window_rays(SMALL.part, SMALL.camera, pose)
    face = scanning.run_strips(scene, origins, directions, 1000)
    expected = SMALL.model.scanner.scan(SMALL.camera, pose).face
    met = face[face >= 0]
    # float32 rays may take the neighbour at an edge, and edge-on faces are not measured
    assert abs(len(met) - len(expected)) <= 0.01 * len(expected)
    assert len(np.intersect1d(met, expected)) >= 0.99 * len(np.unique(expected))
    assert len(origins) < SMALL.camera.width * SMALL.camera.height


@pytest.mark.slow
def test_scans_stand_beside_open3d_and_embree(once: Bench) -> None:
    pytest.importorskip("open3d")
    rows = summarize(list(scanning.scan(once)))
    assert [bool(row["seconds"]) for row in rows] == [True] * 3
    peer, limit = rows[2]["against"]
    assert (peer["kind"], peer["goal"], limit["kind"], limit["goal"]) == ("peer", 6, "limit", 1.5)
    assert peer["ratio"] == pytest.approx(
        rows[0]["seconds"]["median"] / rows[2]["seconds"]["median"]
    )
    # both see the same points
    million = [float(row["note"].rsplit(" M points", 1)[0].rsplit(" ")[-1]) for row in rows[::2]]
    assert million[0] == pytest.approx(million[1], rel=0.1)


# ---- refining and registering ----


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


@pytest.mark.slow
def test_without_weights_half_of_the_registrations_are_skipped(once: Bench) -> None:
    figures = list(register_from(once))
    assert [bool(figure.seconds) for figure in figures] == [True, False, False, True, True]
    assert all("accepted" in figure.note for figure in figures[3:])
    assert all("no --weights" in figure.note for figure in figures[1:3])


# ---- the network ----


@pytest.fixture
def _small_network(monkeypatch) -> None:
    sizes = functools.partial(VanePairs, sources=32, targets=64, neighbors=4, batch=2)
    monkeypatch.setattr(network, "VanePairs", sizes)


@pytest.mark.slow
@pytest.mark.usefixtures("_small_network")
def test_the_network_stands_beside_pytorch_and_arithmetic(once: Bench) -> None:
    pytest.importorskip("torch")
    for benchmark_of in (network.step, network.inference):
        rows = summarize(list(benchmark_of(once)))
        assert [bool(row["seconds"]) for row in rows] == [True] * 3
        kinds = [(entry["kind"], entry["ratio"] > 0) for entry in rows[2]["against"]]
        assert kinds == [("peer", True), ("limit", True)]
        assert "32 x 64 points, k = 4" in rows[2]["note"]


@pytest.mark.slow
def test_every_source_point_of_a_timed_pair_is_real() -> None:
    pair = VanePairs(sources=32, targets=64).pair(1)
    assert pair.source.mask.shape == (32,)
    assert pair.source.mask.all()
    assert pair.target.mask.shape == (64,)
    np.testing.assert_allclose(np.linalg.norm(pair.source.normals, axis=1), 1, rtol=1e-5)


# ---- processes ----


def test_each_first_run_has_an_empty_cache(bench: Bench, monkeypatch) -> None:
    runs = []

    def record(arguments: list[str], **environment: str) -> float:
        runs.append((arguments, environment.get("VANEJAX_CACHE_DIR")))
        if "register" in arguments:
            assert Path(arguments[3]).is_file()
        return float(len(runs))

    monkeypatch.setattr(processes, "run", record)
    figures = list(processes.command(bench))
    assert [len(figure.seconds) for figure in figures] == [2] * 5
    caches = [cache for arguments, cache in runs if cache]
    assert len(caches) == 8
    assert caches[::2] == caches[1::2]
    assert len(set(caches)) == 4
    assert sum("--init" in arguments for arguments, _ in runs) == 4
    first, second = figures[1:3]
    assert all(b == a + 1 for a, b in zip(first.seconds, second.seconds, strict=True))


def test_a_process_that_fails_is_no_time() -> None:
    assert processes.run(["-c", "raise SystemExit(3)"]) > 0
    assert processes.output(["-c", "print(7)"]) == "7\n"
    with pytest.raises(InputError, match="went wrong"):
        processes.run(["-c", "raise SystemExit('it went wrong')"])


@pytest.mark.slow
def test_a_start_stands_beside_that_of_python(once: Bench) -> None:
    rows = summarize(list(processes.start(once)))
    assert [row["goal_s"] for row in rows] == [None, 0.5, 1.0]
    assert [len(row["against"]) for row in rows] == [0, 1, 1]


def test_compilations_are_told_apart(bench: Bench, monkeypatch) -> None:
    caches = []

    def answer(arguments: list[str], **environment: str) -> str:
        caches.append(environment["VANEJAX_CACHE_DIR"])
        warm = caches.count(caches[-1]) > 1
        return json.dumps({"trace": 1.0, "compile": 0.25 if warm else 6.0})

    monkeypatch.setattr(processes, "output", answer)
    figures = list(compilation.compilation(bench))
    assert [figure.seconds for figure in figures] == [[1.0] * 4, [7.0, 7.0], [0.25, 0.25]]
    assert len(caches) == 4


def test_an_evaluation_is_told_with_and_without_pictures(bench: Bench, monkeypatch) -> None:
    def answer(arguments: list[str], **environment: str) -> str:
        assert Path(arguments[2]).is_file()
        return json.dumps({"figures": 2.0, "alone": 1.5, "pictures": 3.0})

    monkeypatch.setattr(processes, "output", answer)
    figures = list(evaluation.evaluation(bench))
    assert figures[1].name == "evaluation, 54 views, first process"
    assert [figure.seconds[0] for figure in figures[1:]] == [2.0, 5.0, 2.0, 5.0]
    assert set(figures[1].limits) == {figures[0].name}


# ---- scaling ----


def test_a_refined_part_is_the_same_surface() -> None:
    part = scaling.refined(SMALL.part, 2)
    assert len(part.mesh.faces) == 4 * len(SMALL.part.mesh.faces)
    assert part.mesh.area == pytest.approx(SMALL.part.mesh.area, rel=1e-9)
    assert part.mesh.is_watertight
    assert scaling.refined(SMALL.part, 1) is SMALL.part


def test_measured_points_are_as_many_as_wanted(bench: Bench) -> None:
    have = len(bench.points)
    for count in (have // 10, 3 * have):
        points = scaling.measured_points(bench, count)
        assert points.shape == (count, 3)
        assert len(np.unique(points, axis=0)) == count


@pytest.mark.slow
def test_every_cost_has_its_series(once: Bench, monkeypatch) -> None:
    asked = []
    for name in ("registering", "training"):  # which compile; they are timed above
        monkeypatch.setattr(scaling, name, lambda pairs: lambda: asked.append(pairs))
    sizes = scaling.Sizes((1, 2), (0.5, 1.0), (300, 600), (32, 64), (2, 4), (1, 2))
    series = list(scaling.scaling(once, sizes))
    assert all(isinstance(one, Series) and len(one.sizes) == 2 for one in series)
    assert [one.unit for one in series] == (
        ["faces"] * 4 + ["pixels"] + ["points"] * 4 + ["neighbours", "pairs"]
    )
    assert series[0].sizes == [22_976, 91_904]
    assert {pairs.sources for pairs in asked[:4]} == {32, 64}
    assert {pairs.batch for pairs in asked[-4:]} == {1, 2}


# ---- the command ----


@pytest.mark.slow
def test_the_refinements_are_compared(record, monkeypatch, capsys) -> None:
    monkeypatch.setattr(benchmark, "Bench", functools.partial(Bench, views=SMALL))
    report = record(benchmark, "benchmark", "--only", "refine", "--repeats", "1")
    rows = {row["name"]: row for row in report["rows"]}
    against = {entry["name"]: entry for entry in rows["refine"]["against"]}
    assert against["bare casts of refine"]["ratio"] > 1
    assert rows["refine"]["goal_s"] == 0.5
    assert rows["refine"]["met"] in ("met", "missed")
    assert report["machine"]["cpu"]
    assert report["machine"]["matmul_flops_per_second"] > 1e6
    assert set(machine.PEERS) <= set(report["versions"])
    printed = capsys.readouterr().out
    assert "medians of at least 5" in printed
    assert "GFLOP/s" in printed


def test_scaling_has_a_table_of_its_own(record, monkeypatch, capsys) -> None:
    def quadratic(bench: Bench) -> Iterator[Series]:
        assert bench.large
        yield Series("a thing", "points", [10, 20], [[0.1], [0.4]])

    monkeypatch.setitem(benchmark.BENCHMARKS, "scaling", quadratic)
    report = record(benchmark, "benchmark", "--only", "scaling", "--large")
    assert report["rows"] == []
    assert report["scaling"][0]["exponent"] == pytest.approx(2.0)
    assert "a thing: grows as size^2.00" in capsys.readouterr().out


def test_an_unknown_benchmark_is_refused(record) -> None:
    with pytest.raises(InputError, match="no benchmark speed; there are scan, step, inference"):
        record(benchmark, "benchmark", "--only", "refine,speed")
