"""A trained matcher in one file: what goes in comes out, and nothing else is taken."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from example_scans import solid
from scipy.spatial.transform import Rotation

from experiments.configs.smoke import get_config
from experiments.evaluate import load_variables
from experiments.runner.experiment import Experiment
from experiments.runner.run_folder import RunFolder
from vanejax.cad import Part, part_from_mesh
from vanejax.cli.program import main
from vanejax.errors import InputError
from vanejax.files import read_arrays, write_arrays
from vanejax.localization.matched_poses import match_poses
from vanejax.localization.registration import register
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, Scanner, hemisphere_viewpoints
from vanejax.scans.measured_scan import MeasuredScan
from vanejax.training import Checkpoints, ScanSet, make_optimizer, make_scan_set
from vanejax.training.export import export_workdir
from vanejax.training.train_step import first_state
from vanejax.training.weight_file import (
    TrainedMatcher,
    abstract_variables,
    find_weights,
    load_model,
    save_model,
)


@pytest.fixture(scope="module")
def config() -> Experiment:
    config = get_config()
    config.views.azimuths_deg = (0.0, 20.0)
    config.views.elevations_deg = (60.0,)
    return config


@pytest.fixture(scope="module")
def part(config: Experiment) -> Part:
    return config.make_part()


@pytest.fixture(scope="module")
def scans(config: Experiment, part: Part) -> ScanSet:
    return make_scan_set(
        part,
        config.make_camera(),
        config.make_viewpoints(part),
        voxel_mm=config.data.voxel_mm,
        progress=False,
    )


@pytest.fixture(scope="module")
def workdir(config: Experiment, part: Part, scans: ScanSet, tmp_path_factory) -> Path:
    """As experiments.train leaves it: step 10 is the best, step 20 the last, and they differ."""
    path = tmp_path_factory.mktemp("run")
    with RunFolder(path) as folder:
        folder.claim(config, part)
        scans.save(path / "scans.npz")
        rng = np.random.default_rng(0)
        variables = jax.tree.map(
            lambda leaf: jnp.asarray(0.1 * rng.normal(size=leaf.shape), leaf.dtype),
            abstract_variables(config.make_network().model),
        )
        state = first_state(make_optimizer(config.training), variables)
        with Checkpoints(folder.checkpoints) as checkpoints:
            for step, score in ((10, 1.0), (20, 2.0)):
                average = jax.tree.map(lambda leaf, step=step: leaf + 0.01 * step, state.variables)
                checkpoints.save(
                    state.replace(step=jnp.asarray(step, jnp.int32), average=average), score=score
                )
    return path


@pytest.fixture(scope="module")
def exported(workdir: Path, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("exported") / "vane.safetensors"
    export_workdir(workdir, path)
    return path


@pytest.fixture(scope="module")
def matcher(exported: Path) -> TrainedMatcher:
    return load_model(exported)


def assert_same_weights(found: Any, wanted: Any) -> None:
    assert len(jax.tree.leaves(found)) == 52
    jax.tree.map(np.testing.assert_array_equal, found, wanted)


def test_an_export_holds_the_run(
    matcher: TrainedMatcher, config: Experiment, scans: ScanSet, part: Part, workdir: Path
) -> None:
    assert matcher.model == config.make_network().model
    assert matcher.sampling == config.pair_sampling(scans)
    assert matcher.iterations == config.model.test_iterations
    assert matcher.voxel_mm == config.data.voxel_mm
    assert matcher.camera == config.make_camera()
    np.testing.assert_array_equal(matcher.center, part.center)
    assert matcher.radius_mm == part.radius
    np.testing.assert_array_equal(matcher.reference_points, scans.reference_points)
    np.testing.assert_array_equal(matcher.reference_normals, scans.reference_normals)
    assert (matcher.part_name, matcher.part_sha256) == (part.name, part.sha256)
    assert matcher.trained["step"] == 10
    assert "jax" in matcher.trained["versions"]
    matcher.check_part(part)


def test_the_weights_are_those_that_evaluate_takes_and_the_run_is_only_read(
    workdir: Path, tmp_path: Path, config, scans, matcher: TrainedMatcher
) -> None:
    def look() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in workdir.rglob("*") if path.is_file()}

    before = look()
    export_workdir(workdir, tmp_path / "vane.safetensors", checkpoint="last")
    assert look() == before
    assert [path.name for path in tmp_path.iterdir()] == ["vane.safetensors"]
    last = load_model(tmp_path / "vane.safetensors")
    for found, which, step in ((matcher, "best", 10), (last, "latest", 20)):
        assert found.trained["step"] == step
        assert_same_weights(found.variables, load_variables(config, scans, workdir, which=which))


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_saving_what_was_loaded_changes_nothing(
    matcher: TrainedMatcher, tmp_path: Path, suffix: str
) -> None:
    save_model(tmp_path / f"again{suffix}", matcher)
    again = load_model(tmp_path / f"again{suffix}")
    assert_same_weights(again.variables, matcher.variables)
    for field in dataclasses.fields(TrainedMatcher):
        if field.name != "variables":
            one, other = getattr(again, field.name), getattr(matcher, field.name)
            np.testing.assert_array_equal(one, other, err_msg=field.name)


def test_another_part_is_refused_by_name(matcher: TrainedMatcher) -> None:
    corners = np.array([[0, 0, 0], [50, 0, 0], [0, 50, 0], [0, 0, 50.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    wedge = part_from_mesh(corners, faces, name="wedge")
    with pytest.raises(InputError) as caught:
        matcher.check_part(wedge)
    words = (matcher.part_name, matcher.part_sha256[:12], "wedge", wedge.sha256[:12])
    assert all(word in str(caught.value) for word in words)


def set_header(*path: str, to: Any) -> Callable[[dict, dict], None]:
    """A change of one entry of the header; None removes it."""

    def change(arrays: dict[str, np.ndarray], header: dict[str, Any]) -> None:
        *groups, name = path
        place = functools.reduce(dict.get, groups, header)
        place[name] = to
        if to is None:
            del place[name]

    return change


def set_array(name: str, to: Callable[[np.ndarray], np.ndarray]) -> Callable:
    return lambda arrays, header: arrays.update({name: to(arrays[name])})


KERNEL = "params/feature_net/prepool_0/dense/kernel"
BIAS = "params/feature_net/prepool_0/dense/bias"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda arrays, header: arrays.pop(KERNEL), f"missing: {KERNEL}"),
        (lambda arrays, header: arrays.update(more=np.zeros(3, np.float32)), "unknown: more"),
        (set_array(KERNEL, lambda x: x.T.copy()), rf"{KERNEL} is float32 \(32, 10\).*\(10, 32\)"),
        (set_array(KERNEL, lambda x: x.astype(np.float64)), f"{KERNEL} is float64"),
        (set_array(BIAS, lambda x: x * np.nan), f"{BIAS} holds values that are not finite"),
        (set_array("reference_points", lambda x: x[:, :2]), "should both be"),
        (set_array("reference_normals", np.float16), "reference_normals is float16"),
        (set_header("drawing", "num_reference", to=4096), "reference points, fewer than the 4096"),
        (lambda arrays, header: header.clear(), "not a weights file of vanejax"),
        (set_header("format", to="other"), "not a weights file of vanejax"),
        (set_header("version", to=2), "of version 2, this program reads 1"),
        (set_header("camera", to=None), "should have .*'camera'"),
        (set_header("camera", "width", to=-5), "camera: camera width"),
        (set_header("model", "feature_width", to=10**12), "feature_width=10+ should be int"),
        (set_header("model", "feature_width", to=33), "feature_width=33 is no multiple of 8"),
        (set_header("model", "feature_width", to=64), r"the network's is float32"),
        (set_header("model", "num_neighbors", to=True), "num_neighbors=True should be int"),
        (set_header("model", "depth", to=3), "model: has .*'depth'"),
        (set_header("drawing", "noise", to=None), "drawing: has"),
        (set_header("drawing", "noise", to="0.1"), "noise='0.1' should be float"),
        (set_header("iterations", to=0), "iterations=0 should be int, from 1"),
        (set_header("voxel_mm", to=float("nan")), "voxel_mm=nan"),
        (set_header("part", to=[]), r"part: has \[\], should have"),
        (set_header("part", "center_mm", to=[0, 0, "1"]), "center_mm='1'"),
        (set_header("part", "sha256", to=5), "sha256=5 should be of type str"),
    ],
)
def test_a_changed_file_is_refused_by_what_changed(
    exported: Path, tmp_path: Path, change: Callable, words: str
) -> None:
    path = tmp_path / "changed.safetensors"
    arrays, header = read_arrays(exported)
    change(arrays, header)
    write_arrays(path, arrays, header)
    with pytest.raises(InputError, match=words) as caught:
        load_model(path)
    assert str(path) in str(caught.value)


def test_what_is_no_file_of_weights_is_refused(exported: Path, tmp_path: Path) -> None:
    cut_off = tmp_path / "cut_off.safetensors"
    cut_off.write_bytes(exported.read_bytes()[:-1])
    problems = {
        cut_off: r"cut_off\..*: truncated or not a weights file",
        tmp_path / "none.npz": "no such file",
        tmp_path: "is a folder",
    }
    for path, words in problems.items():
        with pytest.raises(InputError, match=words):
            load_model(path)


def test_what_cannot_be_loaded_is_not_saved(matcher: TrainedMatcher, tmp_path: Path) -> None:
    broken = jax.tree.map(lambda leaf: leaf * np.float32(np.nan), matcher.variables)
    with pytest.raises(InputError, match="not finite"):
        save_model(tmp_path / "bad.npz", dataclasses.replace(matcher, variables=broken))
    assert not list(tmp_path.iterdir())


def test_what_is_no_run_is_refused(workdir: Path, tmp_path: Path) -> None:
    out, run = tmp_path / "out.npz", tmp_path / "run"

    def refuse(words: str, record: Any = None, **options: Any) -> None:
        if record is not None:
            (run / "run.json").write_text(json.dumps(record))
        with pytest.raises(InputError, match=words):
            export_workdir(run, out, **options)
        assert not out.exists()

    refuse("no such folder")
    run.mkdir()
    refuse("run.json: no such file")
    (run / "run.json").write_text("{")
    refuse("cannot be read as JSON")
    refuse("does not say which config and part", [])
    record = json.loads((workdir / "run.json").read_text())
    refuse(r"scans\.npz: no such file", record)
    (run / "scans.npz").symlink_to(workdir / "scans.npz")
    refuse("holds no checkpoints")
    (run / "checkpoints").mkdir()
    refuse("no checkpoint", checkpoint="last")
    (run / "checkpoints").rmdir()
    (run / "checkpoints").symlink_to(workdir / "checkpoints")
    record["config"]["model"]["feature_width"] = 64
    refuse("another config", record)
    del record["config"]["data"]["noise"]
    refuse("has no 'noise'", record)
    record["part"]["sha256"] = "0" * 64
    refuse("mixes two runs", record)


# ---- the weights that come with the package: they know the built-in guide vane, nothing else ----


@pytest.fixture(scope="module")
def pretrained(part: Part) -> TrainedMatcher:
    return find_weights("pretrained", part)


def test_the_file_says_what_it_is(pretrained: TrainedMatcher, part: Part) -> None:
    assert pretrained.part_name == part.name
    trained = pretrained.trained
    assert trained["step"] == trained["config"]["training"]["steps"]
    assert trained["config"]["part"] == {"path": "", "units": "mm"}
    figures = trained["evaluation"]
    recorded = json.loads((Path(__file__).parents[2] / "experiments/results/vane.json").read_text())
    # the file, the recorded result and so the pages are of one run
    assert figures["views"] == recorded["views"] == 54
    assert figures["summary"] == recorded["summary"]


@pytest.mark.slow
def test_it_knows_the_part_in_other_files(pretrained: TrainedMatcher, part: Part) -> None:
    rounded = part.mesh.copy()
    rounded.vertices = np.round(rounded.vertices, 3)  # as a text file may have it
    for mesh in (rounded, part.mesh.subdivide()):
        again = solid(mesh, name="again")
        assert again.sha256 != part.sha256
        assert pretrained.knows(again)


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
def test_it_knows_no_other_part(pretrained: TrainedMatcher, part: Part, change: str) -> None:
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
    other = solid(mesh, name=change)
    if change == "more":
        assert (other.center == part.center).all()
        assert other.radius == part.radius
    with pytest.raises(InputError, match=f"no pretrained weights for {change}"):
        find_weights("pretrained", other)


@pytest.mark.slow
def test_the_network_alone_comes_near_and_the_product_to_the_pose(
    pretrained: TrainedMatcher, part: Part
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
    found = match_poses(pretrained, measured, guess, iterations=pretrained.iterations)
    cosine = (np.trace(found.rotation[0].T @ truth.rotation) - 1) / 2
    assert np.degrees(np.arccos(cosine)) < 2.0  # 1.2 at most on its test views
    result = register(measured, part, init=rough, weights="pretrained")
    assert result.verdict.status == "accepted"
    np.testing.assert_allclose(result.part_from_camera.as_matrix(), truth.as_matrix(), atol=5e-3)


def test_weights_of_another_part_are_refused(pretrained: TrainedMatcher, part: Part) -> None:
    other = dataclasses.replace(pretrained, part_sha256="0" * 64, center=pretrained.center + 1.0)
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
    box = solid(part.mesh.convex_hull, name="box")
    box.export("box.stl")
    assert main(["register", scan, "box.stl", "--weights", "pretrained"]) == 2
    assert "no pretrained weights for box" in capsys.readouterr().err
