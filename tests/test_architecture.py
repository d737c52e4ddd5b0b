"""Data flows one way: a module imports only what stands above it, and importing does nothing."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# From the ground up; a module may import those of the lines before its own, and a new module must
# be given its place here.
LAYERS = [
    # the ground, for both sides
    "errors",
    "whole_file",
    "array_file",
    "rigid_transform",
    "rigid",
    "pointcloud",
    # host: parts
    "triangles",
    "solid_bodies",
    "mesh_repair",
    "cad_file",
    "camera",
    "part",
    "loft",
    "airfoil",
    "vane",
    # host: scans and files
    "envelope",
    "pixel_rays",
    "scanner",
    "casting",
    "scene",
    "exposure",
    "range_errors",
    "sensor",
    "measurement",
    "dataset",
    "inert_pickle",
    "torch_weights",
    "sensor_place",
    "voxels",
    "segmentation",
    "measured_scan",
    "point_records",
    "pcd_file",
    "ply_file",
    "point_file",
    "scan_file",
    "pose_result",
    "pose_file",
    "frame_notation",
    "machine",
    "positioning",
    "cube",
    "calibration",
    # host: fine registration
    "surface",
    "nearest_face",
    "tool_path",
    "residuals",
    "noise",
    "covariance",
    "refine",
    "edge_rounding",
    "verification",
    "verdict",
    "pose_search",
    # JAX: registration
    "features",
    "matching",
    "registration",
    "classical.icp",
    "classical.feature_matches",
    "classical.sac_ia",
    "classical.fgr",
    "models.layers",
    "models.iteration",
    "models.rpmnet",
    "models.pointnet",
    "models.pointnetlk",
    "models.pcrnet",
    "models.dgcnn",
    "models.transformer",
    "models.dcp",
    # JAX: training
    "normals",
    "pairs",
    "shape_pairs",
    "scan_stream",
    "losses",
    "accumulation",
    "metrics",
    "training",
    "rpmnet_loss",
    "pointnet_losses",
    "dcp_loss",
    "checkpoint",
    # one scan, one part, one pose
    "model_file",
    "shipped",
    "model_export",
    "inspection",
    "matched_poses",
    "foreign_points",
    "locate",
    # pictures
    "plotting.canvas",
    "plotting.shading",
    "plotting.clouds",
    "plotting.charts",
    "plotting.overview",
    "plotting.scene",
    "plotting.deviation",
    "plotting.casting",
    "plotting.sensing",
    "plotting.segments",
    "plotting.matching",
    "plotting",
    "report.wording",
    "report.templates",
    "report.pictures",
    "report.viewer",
    "report.view3d",
    "report.page",
    "report",
    # the command line
    "compilation_cache",
    "commands.workpiece",
    "commands.pose_summary",
    "commands.register",
    "commands.compensate",
    "commands.scan",
    "commands.inspect",
    "commands.export",
    "cli",
    "__main__",
]
# what several algorithms are made of
SHARED = {
    "classical.feature_matches",
    "models.layers",
    "models.iteration",
    "models.pointnet",
    "models.dgcnn",
    "models.transformer",
}
HOST = LAYERS[: LAYERS.index("pose_search") + 1]


def modules(package: str = "vanejax") -> dict[str, Path]:
    """Dotted name inside the package to file; an ``__init__`` of only words is no module."""
    found = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT / package).with_suffix("").parts
        if parts[-1] == "__init__":
            if all(isinstance(node, ast.Expr) for node in ast.parse(path.read_text()).body):
                continue
            parts = parts[:-1]
        if not parts:
            continue  # the package's own face, which loads what it offers when asked
        found[".".join(parts)] = path
    return found


def imports(path: Path) -> Iterator[str]:
    """Every module named in an import, at any depth; both readings of ``from package import x``."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write the whole name"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def inside(path: Path) -> set[str]:
    """The modules of vanejax that a file imports."""
    named = {name.removeprefix("vanejax.") for name in imports(path) if name.startswith("vanejax.")}
    return named & set(modules())


def test_every_module_has_its_place():
    assert sorted(modules()) == sorted(LAYERS), "give the new module its place in LAYERS"


@pytest.mark.parametrize("name", sorted(modules()))
def test_a_module_imports_only_what_stands_above_it(name):
    place = LAYERS.index(name)
    below = {other for other in inside(modules()[name]) if LAYERS.index(other) >= place}
    assert not below, f"{name} imports {sorted(below)}, which stand below it"


def test_the_library_does_not_know_its_experiments_or_tests():
    for name, path in modules().items():
        foreign = {i for i in imports(path) if i.split(".")[0] in ("experiments", "tests")}
        assert not foreign, f"{name} imports {foreign}"


def test_the_host_side_does_not_know_the_models():
    for name in HOST:
        assert not [other for other in inside(modules()[name]) if other.startswith("models.")]
        if name not in ("rigid", "pointcloud"):  # these two serve both sides
            used = {i for i in imports(modules()[name]) if i.split(".")[0] in ("jax", "flax")}
            assert not used, f"{name} imports {used}"


def test_algorithms_do_not_know_each_other():
    """So that each can be read, replaced and deleted alone; they share parts only."""
    for package in ("models.", "classical."):
        for name in modules():
            if name.startswith(package):
                others = {n for n in inside(modules()[name]) if n.startswith(package)}
                assert others <= SHARED, f"{name} imports {sorted(others)}"


def test_only_the_scanner_knows_embree():
    users = {n for n, path in modules().items() if any("embree" in i for i in imports(path))}
    assert users == {"scanner"}


def test_the_rules_can_fail(tmp_path):
    """The walk finds imports of every form, also inside a function."""
    source = "import vanejax.part as p\ndef f():\n    from vanejax import pairs\n"
    (tmp_path / "module.py").write_text(source + "from vanejax.models.rpmnet import Match\n")
    assert inside(tmp_path / "module.py") == {"part", "pairs", "models.rpmnet"}


PROGRAM = """
import importlib, os, sys
sys.argv = ["program", "--no-such-flag", "--help"]
written = []
def watch(event, args):
    if event == "open" and isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR):
        written.append(str(args[0]))
    elif event in ("os.mkdir", "os.rename", "os.remove"):
        written.append(str(args[0]))
sys.addaudithook(watch)
for name in sys.stdin.read().split():
    importlib.import_module(name)
import jax
assert not jax._src.xla_bridge.backends_are_initialized(), "an import chose a device"
here = os.getcwd()
written = [path for path in written if os.path.abspath(path).startswith(here)]
assert not written, f"an import wrote {written}"
"""


def test_importing_does_nothing(tmp_path):
    """No arguments parsed, no file written, no device chosen, nothing printed."""
    names = [f"vanejax.{name}" for name in LAYERS]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        input="\n".join(names),
        cwd=tmp_path,
        env=environment,
        text=True,
        capture_output=True,
        timeout=300,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []
