"""Data flows one way: a module imports only what stands above it, and importing does nothing."""

from __future__ import annotations

import ast
import graphlib
import importlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import vanejax

ROOT = Path(__file__).parents[2]

# From the ground up: the files of a wing may import those of the wings before it. What stands
# beside the wings is for all of them.
WINGS = [
    "cad",
    "scanner",
    "scans",
    "matching",
    "training",
    "localization",
    "plotting",
    "machine",
    "report",
    "cli",
]
GROUND = ["errors", "settings", "files", "rigid", "pointcloud", "compilation_cache"]
# needs no JAX, so that a command line without networks starts a second earlier
HOST_WINGS = ["cad", "scanner", "scans", "localization", "machine"]
# what brings JAX when it is asked for: normals for networks, and the poses that networks find
JAX_IN_HOST_WINGS = {"scans.normals", "localization.matched_poses"}
# what several baselines are made of
SHARED = {
    f"matching.baselines.{name}"
    for name in ("feature_matches", "fpfh", "pointnet", "dgcnn", "transformer")
}


def modules(package: str = "vanejax") -> dict[str, Path]:
    """Dotted name inside the package to file, without the faces of packages."""
    found = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT / package).with_suffix("").parts
        if parts[-1] == "__init__":
            continue  # a face, which only hands on names
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


def wing(module: str) -> str:
    """The wing of a module, or the module itself where it stands beside them."""
    return module.partition(".")[0]


def test_every_module_has_its_place():
    places = {wing(name) for name in modules()} - {"__main__"}
    assert places == {*WINGS, *GROUND}
    assert len(WINGS) <= 10
    assert len(list((ROOT / "vanejax").glob("*.py"))) <= 8


@pytest.mark.parametrize("name", WINGS)
def test_a_wing_imports_only_what_stands_before_it(name):
    allowed = {*GROUND, *WINGS[: WINGS.index(name) + 1]}
    for module, path in modules().items():
        if wing(module) == name:
            others = {other for other in inside(path) if wing(other) not in allowed}
            assert not others, f"{module} imports {sorted(others)}, of wings behind {name}"


def test_the_ground_knows_no_wing():
    for name in GROUND:
        assert {wing(other) for other in inside(modules()[name])} <= set(GROUND)


def test_imports_make_no_circle():
    """Inside a wing too: its files have an order."""
    arrows = {name: inside(path) - {name} for name, path in modules().items()}
    graph = graphlib.TopologicalSorter(arrows)
    assert len(list(graph.static_order())) == len(arrows)  # CycleError names the circle


@pytest.mark.parametrize("name", WINGS)
def test_a_wing_says_what_it_is_and_hands_on_its_names(name):
    face = importlib.import_module(f"vanejax.{name}")
    assert len(face.__doc__.split()) > 5
    files = {path.stem for path in Path(face.__file__).parent.glob("*.py")}
    for public in getattr(face, "__all__", ()):
        assert getattr(face, public).__doc__ or public.isupper()
        assert public not in files, f"vanejax.{name}.{public} hides the file of that name"


def test_the_public_interface_is_there():
    """Every name loads, and editors are told the same names."""
    tree = ast.parse(Path(vanejax.__file__).read_text())
    told = next(n for n in ast.walk(tree) if isinstance(n, ast.If)).body
    assert sorted(alias.name for node in told for alias in node.names) == vanejax.__all__
    for name in vanejax.__all__:
        assert getattr(vanejax, name).__doc__, name
        assert name in dir(vanejax)
    with pytest.raises(AttributeError, match="no attribute 'registr'"):
        vanejax.registr  # noqa: B018


def test_the_library_does_not_know_its_experiments_or_tests():
    for name, path in modules().items():
        foreign = {i for i in imports(path) if i.split(".")[0] in ("experiments", "tests")}
        assert not foreign, f"{name} imports {foreign}"


def test_the_host_side_runs_without_jax():
    for name, path in modules().items():
        if wing(name) in HOST_WINGS and name not in JAX_IN_HOST_WINGS:
            used = {i for i in imports(path) if i.split(".")[0] in ("jax", "flax")}
            assert not used, f"{name} imports {used}"
    program = "import sys, {}; sys.exit('jax' in sys.modules)".format(
        ", ".join(f"vanejax.{name}" for name in HOST_WINGS)
    )
    assert subprocess.run([sys.executable, "-c", program], cwd=ROOT).returncode == 0


def test_baselines_do_not_know_each_other():
    """So that each can be read, replaced and deleted alone; they share parts only."""
    for name, path in modules().items():
        if name.startswith("matching.baselines."):
            others = {n for n in inside(path) if n.startswith("matching.baselines.")}
            assert others <= SHARED, f"{name} imports {sorted(others)}"


def test_only_the_scanner_knows_embree():
    users = {
        n for n, path in modules().items() if any(i.startswith("embreex") for i in imports(path))
    }
    assert users == {"scanner.embree_scene"}


def test_the_rules_can_fail(tmp_path):
    """The walk finds imports of every form, also inside a function."""
    source = "import vanejax.cad.part as p\ndef f():\n    from vanejax.training import pairs\n"
    (tmp_path / "module.py").write_text(source + "from vanejax.matching.rpmnet import Match\n")
    assert inside(tmp_path / "module.py") == {"cad.part", "training.pairs", "matching.rpmnet"}


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
    names = [f"vanejax.{name}" for name in modules()]
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
