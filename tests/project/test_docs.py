"""The pages: every command is one that its program takes, every link leads somewhere.

What is cheap is run as written (the quick start, the Python of `RUN`); of what takes long, the
program and its own parser are asked. `test_compensate` runs its own page.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import re
import runpy
import shlex
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType

import numpy as np
import pytest
import registration_contract
import test_verdict
from absl import flags
from example_result import example_result
from test_architecture import GROUND, WINGS

from experiments.pages.reproduction.studies import STUDIES
from experiments.runner import command_line
from experiments.runner.experiment import Experiment
from experiments.studies.comparison.settings import METHODS
from vanejax.cli.program import main, make_parser
from vanejax.cli.register import EXIT_CODES
from vanejax.errors import InputError
from vanejax.localization import clutter_removal, misfit
from vanejax.localization.pose_result import FormDeviation, Verdict
from vanejax.localization.verdict import CompetingHypothesis

ROOT = Path(__file__).parents[2]
PAGES = sorted([*(ROOT / "docs").glob("*.md"), ROOT / "README.md", ROOT / "CHANGELOG.md"])
RUN = {  # page: what holds after its Python, beside what it asserts itself
    "conventions": "",
    "adding_a_method": "",
    "virtual_scans": """
assert np.linalg.norm(points_part - part.center, axis=1).max() < part.radius + 0.01  # mm
assert len(measured.points) == (measured.reason == 0).sum()
assert len(in_scene.points) > len(measured.points)  # the table's, too
assert not np.allclose(casting.extent_mm, part.extent_mm, atol=0.1)
""",
}
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
TOOLS = ("cat", "cut", "head", "tail", "ls", "cd", "mkdir")
FENCED = re.compile(r"^( *)```(\w*)\n(.*?)^\1```", re.DOTALL | re.MULTILINE)


def blocks(text: str, *languages: str) -> list[tuple[str, str]]:
    """(language, content) of the fenced blocks in these languages, in order."""
    return [(block[2], block[3]) for block in FENCED.finditer(text) if block[2] in languages]


def commands(text: str) -> Iterator[list[str]]:
    """The simple commands of shell text: comments off, lines joined, split at && and ;."""
    text = re.sub(
        r"<<'?(\w+)'?\n.*?\n\1$", "", text, flags=re.DOTALL | re.MULTILINE
    )  # here-documents
    text = re.sub(r" >>? *\S+", "", text)  # where the output goes
    for line in text.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars="&;|")
        lexer.whitespace_split = True
        words: list[str] = []
        for word in lexer:
            if set(word) <= set("&;|"):
                yield words
                words = []
            else:
                words.append(word)
        if words:
            yield words


def inline_commands(text: str) -> Iterator[list[str]]:
    """Commands with arguments that stand between backticks in a sentence."""
    for code in re.findall(r"`((?:vanejax|python -m) [^`]+)`", FENCED.sub("", text)):
        words = shlex.split(code)
        if len(words) > 2:
            yield words


def page_commands(text: str) -> list[list[str]]:
    """All commands of a page."""
    shell = "\n".join(code for _, code in blocks(text, "sh", "bash", "shell", "console"))
    return [*commands(shell), *inline_commands(text)]


def check(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Asks the program of a command whether it takes these arguments.

    Raises:
      AssertionError: it does not, or the program is none that is known here.
    """
    while re.fullmatch(r"\w+=.*", words[0]):
        words = words[1:]
    program, rest = words[0].rpartition("/")[2], words[1:]
    try:
        if program == "vanejax":
            make_parser().parse_args(rest)
        elif program in ("python", "python3") and rest[:1] == ["-m"]:
            check_module(rest[1], rest[2:], monkeypatch)
        elif program == "pip":
            check_pip(rest)
        elif program == ".":
            assert rest == [".venv/bin/activate"]
        elif program == "jupyter":
            assert rest[0] in ("lab", "notebook")
            assert (ROOT / rest[1]).exists()
        else:
            assert program in TOOLS, "no program that this test knows"
    except (AssertionError, InputError, SystemExit) as error:
        raise AssertionError(f"{shlex.join(words)}: {error}") from error


def check_pip(rest: list[str]) -> None:
    """Installs of this project, with extras that it has."""
    names = [word for word in rest if not word.startswith("-") and word != "install"]
    assert rest[0] == "install"
    for name in names:
        requirement = re.fullmatch(r"(?:\.|vanejax)(?:\[([\w,]+)\])?", name)
        assert requirement, f"no package of this project: {name}"
        assert set((requirement[1] or "").split(",")) - {""} <= set(EXTRAS), (
            f"no such extra: {name}"
        )


def check_module(module: str, rest: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The module is there, and its command takes the arguments; nothing of it is run."""
    if not module.startswith("experiments."):
        assert module in ("venv", "pytest"), f"no module that this test knows: {module}"
        return
    path = ROOT / Path(*module.split(".")).with_suffix(".py")
    assert path.exists(), f"no such module: {module}"
    source = path.read_text()
    assert 'if __name__ == "__main__":' in source, f"{module} is no command"
    if "import main, make_parser" in source or "def make_parser(" in source:
        importlib.import_module(module).make_parser().parse_args(rest)
    elif "command_line.run(" in source:
        parse_flags(path, rest, monkeypatch)
    else:
        assert not rest, f"{module} takes no arguments"


def parse_flags(path: Path, rest: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs a command of `experiments.runner.command_line` up to where the work would begin."""
    before = set(flags.FLAGS)

    def parse_only(run: FunctionType, *, tree: type = Experiment, **_: object) -> None:
        command_line.define_flags()
        left = command_line._parse(tree, command_line.resolve_config(sys.argv))
        assert left[1:] == [], f"no such argument: {left[1:]}"
        config = flags.FLAGS.config
        assert isinstance(config, tree), f"--config must hold a {tree.__name__}"
        config.check()
        assert set(getattr(flags.FLAGS, "methods", ())) <= set(METHODS)
        space = run.__globals__
        for name, value in list(space.items()):  # what the module itself would do
            if (
                isinstance(value, FunctionType)
                and (value.__module__ == "__main__" or name == "main")
                and value is not run
            ):
                space[name] = lambda *_, **__: 0
        if run.__name__ != "train":  # the work itself
            run(config, Path("runs"))

    monkeypatch.setattr(sys, "argv", [path.stem, *rest])
    monkeypatch.setattr(command_line, "run", parse_only)
    try:
        runpy.run_path(str(path), run_name="__main__")
    finally:
        for name in set(flags.FLAGS) - before:
            delattr(flags.FLAGS, name)
        flags.FLAGS.unparse_flags()
        monkeypatch.undo()


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Where the configs and the example of a page lie."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "adding_a_method.md").read_text()
    for _, code in blocks(text, "python"):
        if name := re.match(r"# (my_\w+\.py)\n", code):
            (tmp_path / name[1]).write_text(code)
    return tmp_path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_is_one_that_its_program_takes(page, folder) -> None:
    wrong = []
    for words in page_commands(page.read_text()):
        with pytest.MonkeyPatch.context() as patch:
            try:
                check(words, patch)
            except AssertionError as error:
                wrong.append(str(error))
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "line",
    [
        "vanejax register scan.ply part.stl --unit mm",
        "vanejax registers scan.ply part.stl",
        "python -m experiments.trane --config vane.py",
        "python -m experiments.train --config vain.py",
        "python -m experiments.train --config vane.py --config.model.neighbors=16",
        "python -m experiments.train --config vane.py --config.model.num_neighbors=few",
        "python -m experiments.train --config table1.py",
        "python -m experiments.train --config vane.py --config.data.noise=-1",
        "python -m experiments.compare --config table1.py --methods icq",
        "python -m experiments.ablate --config vane.py --sweep model.neighbors=8,16",
        "python -m experiments.fine --vews 3",
        "python -m experiments.docs --fast",
        "python -m experiments.studies.comparison.methods",
        "pip install -e '.[peer]'",
        "rm -rf runs",
    ],
)
def test_a_wrong_command_is_found(line, folder, monkeypatch) -> None:
    (words,) = commands(line)
    with pytest.raises(AssertionError, match=re.escape(words[0])):
        check(words, monkeypatch)


def test_every_program_of_the_pages_is_run_by_reproduce_or_by_a_test() -> None:
    """What takes hours is run by `experiments.reproduce`, the rest by tests."""
    named = set()
    for page in PAGES:
        for words in page_commands(page.read_text()):
            words = [word for word in words if not re.fullmatch(r"\w+=.*", word)]
            if words[0].rpartition("/")[2] in ("python", "python3"):
                named.add(words[2])
    tested = {f"experiments.{path.stem[5:]}" for path in (ROOT / "tests").rglob("test_*.py")}
    studied = {study.arguments[0] for study in STUDIES}
    assert named - studied - tested == {"venv", "pytest"}


def test_shell_text_falls_into_its_commands() -> None:
    text = "a -x '.[b]' && b 1 \\\n  2  # words\n\n. c > d.log\ncat > e <<'END'\nf g\nEND\nh | i\n"
    simple = [["a", "-x", ".[b]"], ["b", "1", "2"], [".", "c"], ["cat"], ["h"], ["i"]]
    assert list(commands(text)) == simple
    assert list(inline_commands("`vanejax scan vane --out x`, `vanejax scan`, `vanejax`")) == [
        ["vanejax", "scan", "vane", "--out", "x"]
    ]


def links(text: str) -> list[str]:
    """Targets of links and pictures outside code."""
    prose = re.sub(r"`[^`\n]*`", "", FENCED.sub("", text))
    return re.findall(r"\[[^\]]*\]\(([^)\s]+)\)", re.sub(r"!\[", "[", prose)) + re.findall(
        r'(?:src|href)="([^"]+)"', prose
    )


def dead(page: Path, text: str) -> list[str]:
    """Links of a page that lead to no file; `mkdocs build --strict` asks for their anchors too."""
    local = [link for link in links(text) if not re.match(r"https://|mailto:|data:|#", link)]
    places = {link: (page.parent / link.partition("#")[0]).resolve() for link in local}
    return [link for link, at in places.items() if not (at.is_relative_to(ROOT) and at.exists())]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_and_picture_is_there(page) -> None:
    assert dead(page, page.read_text()) == []


def test_a_dead_link_is_found() -> None:
    text = "# A\n[x](#a) [z](none.md) ![p](none.png) [q](README.md#a) [r](https://a.b) [s](../x)"
    assert dead(ROOT / "README.md", text) == ["none.md", "none.png", "../x"]


def test_the_index_lists_every_page_and_pages_show_every_picture() -> None:
    """So does the navigation of the site."""
    listed = links((ROOT / "docs" / "README.md").read_text())
    navigation = (ROOT / "mkdocs.yml").read_text()
    shown = {Path(link).name for page in PAGES for link in links(page.read_text())}
    files = sorted((ROOT / "docs").iterdir())
    assert [p.name for p in files if p.suffix == ".md" and p.name not in listed] == ["README.md"]
    assert [p.name for p in files if p.suffix in (".png", ".svg") and p.name not in shown] == []
    assert [p.name for p in files if p.suffix == ".md" and f": {p.name}\n" not in navigation] == []
    overview = (ROOT / "docs" / "api" / "index.md").read_text()
    assert re.findall(r"::: vanejax\.(\w+)\n", overview) == sorted(GROUND)
    for wing in WINGS[:-1]:  # the command line has a page of its own
        assert f": api/{wing}.md\n" in navigation
        assert f"::: vanejax.{wing}\n" in (ROOT / "docs" / "api" / f"{wing}.md").read_text()


def test_the_page_of_the_command_line_has_every_option_and_no_other() -> None:
    page = (ROOT / "docs" / "command_line.md").read_text()
    sections = dict(re.findall(r"(?ms)^## vanejax (\w+)\n(.*?)(?=^## |\Z)", page))
    (choices,) = [a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction)]
    assert sections.keys() == choices.choices.keys()
    for name, parser in choices.choices.items():
        options = {flag for action in parser._actions for flag in action.option_strings}
        assert set(re.findall(r"`(--[\w-]+)", sections[name])) == options - {"-h", "--help"}, name


def test_the_files_that_the_architecture_names_are_there() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    files = re.findall(r"`((?:vanejax|experiments|tests)/[\w/.]+)`", page)
    assert len(files) > 20
    assert [name for name in files if not (ROOT / name).exists()] == []
    assert re.findall(r"^\| `vanejax\.(\w+)` \|", page, re.MULTILINE) == WINGS


def test_what_pages_and_docstrings_name_is_there() -> None:
    sources = [path for name in ("vanejax", "experiments") for path in (ROOT / name).rglob("*.py")]
    missing = []
    for page in [*PAGES, *sources]:
        for name in re.findall(r"`((?:vanejax|experiments)(?:\.\w+)+)[`(]", page.read_text()):
            parts = name.split(".")
            for length in range(len(parts), 0, -1):
                place = ROOT.joinpath(*parts[:length])
                if place.is_dir() or place.with_suffix(".py").exists():
                    break
            value = importlib.import_module(".".join(parts[:length]))
            for part in parts[length:]:
                value = getattr(value, part, None) or getattr(value, "__annotations__", {}).get(
                    part
                )
            if value is None:
                missing.append(f"{page.name}: {name}")
    assert missing == []


def test_the_imports_of_every_page_are_there() -> None:
    for page in PAGES:
        for _, code in blocks(page.read_text(), "python"):
            for node in ast.walk(ast.parse(code)):
                if isinstance(node, ast.ImportFrom) and node.module.startswith("vanejax"):
                    module = importlib.import_module(node.module)
                    missing = [a.name for a in node.names if not hasattr(module, a.name)]
                    assert missing == [], f"{page.name}: {node.module}"


# ---- what is run as it is written


def masked(text: str) -> list[str]:
    """Lines without their figures: another processor's last digits may differ."""
    return [re.sub(r"\d[\d,.e]*", "#", line) for line in text.splitlines()]


# tried only: the first takes half a minute until everything was tried, the others a trained network
LONG = ("register scan.ply block.stl", "experiments.", "export", "--weights", "pip", "venv")


@pytest.mark.slow
def test_the_quick_start_runs_as_written(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "quick_start.md").read_text()
    run, verdicts = 0, 0
    printed = ""
    space: dict[str, object] = {}  # a later block goes on from an earlier one
    for language, code in blocks(page, "python", "sh", "text"):
        if language == "python":
            exec(compile(code, "quick_start.md", "exec"), space)
            continue
        if language == "sh":
            printed = ""
            for words in commands(code):
                if any(word in shlex.join(words) for word in LONG) or words[0] == ".":
                    continue
                exit_code = main(words[1:])
                output = capsys.readouterr().out
                if words[1] == "register":
                    status = output.partition(":")[0].lower()
                    assert exit_code == EXIT_CODES[status]
                    verdicts += 1
                printed += output + "\n"
                run += 1
            continue
        here = set(masked(printed))
        for line, kept in zip(code.splitlines(), masked(code), strict=True):
            if line and not re.match(r"time:|\.\.\.|REJECTED", line):
                assert kept in here, f"not printed: {line}"
    assert (run, verdicts) == (10, 7)
    assert Path("pose.html").stat().st_size > 10_000
    assert json.loads(Path("pose.json").read_text())["verdict"]["status"] == "accepted"


def reasons() -> dict[tuple[str, str], re.Pattern[str]]:
    """Of the quick start's table: by verdict and words, what fits them; … is one word, ... any."""
    page = (ROOT / "docs" / "quick_start.md").read_text()
    rows = re.findall(r"^\| (accepted|ambiguous|rejected) \| `([^`]+)` \|", page, re.MULTILINE)
    return {
        row: re.compile(re.escape(row[1]).replace("…", r"\S+").replace(r"\.\.\.", ".*"))
        for row in rows
    }


def test_every_reason_of_the_verdict_has_its_line() -> None:
    """`register` can say nothing that the quick start does not explain, and the page no more."""
    pose = test_verdict.FAR.part_from_camera
    better, close = (
        CompetingHypothesis(-20.0, 180.0, 0.5, pose),
        CompetingHypothesis(1.0, 180.0, 0.5, pose),
    )
    results = example_result(), example_result("rejected")
    verdicts = [
        test_verdict.verdict(),
        test_verdict.verdict(competing=(close,)),
        test_verdict.verdict(competing=(better, close)),
        test_verdict.verdict(inlier_share=0.65),
        test_verdict.verdict(inlier_share=0.95, unmeasured_share=0.4),
        test_verdict.verdict(inlier_share=0.65, unmeasured_share=float("nan")),
        test_verdict.verdict(tolerance_mm=3 * 0.03 * test_verdict.RADIUS),
        test_verdict.verdict(uncertainty={"covariance": np.diag([1.0, 0, 0, 0, 0, 0])}),
        test_verdict.verdict(uncertainty={"covariance": np.diag([0, 0, 0, 4.0, 0, 0])}),
        *(test_verdict.verdict(form=FormDeviation(**form)) for form in test_verdict.FORMS),
        *(test_verdict.verdict(**changes) for changes in test_verdict.REJECTED.values()),
        *(Verdict("rejected", misfit.in_words(k, *results)) for k in (misfit.MIRRORED, 0.95, 10)),
    ]
    used = set()
    for verdict in verdicts:
        rows = [
            row
            for row, pattern in reasons().items()
            if row[0] == verdict.status and pattern.fullmatch(verdict.reason)
        ]
        assert len(rows) == 1, f"{verdict.status}: {verdict.reason}"
        used.add(rows[0])
    moved, left = sorted(set(reasons()) - used)  # those that are not said of a pose alone
    assert moved[1].startswith("seen from the scan's origin")
    tree = ast.parse(Path(clutter_removal.__file__).read_text())
    templates = [
        "".join(p.value if isinstance(p, ast.Constant) else "…%" for p in text.values)
        for text in ast.walk(tree)
        if isinstance(text, ast.JoinedStr)
    ]
    assert left[0] == "rejected"
    assert left[1] in templates


@pytest.mark.parametrize("name", RUN)
def test_the_python_of_a_page_runs(name, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {"__name__": name}
    for _, code in blocks((ROOT / "docs" / f"{name}.md").read_text(), "python"):
        exec(compile(code, f"{name}.md", "exec", dont_inherit=True), space)
    exec(RUN[name], space)


def test_the_method_of_the_page_keeps_the_contract() -> None:
    text = (ROOT / "docs" / "adding_a_method.md").read_text()
    space: dict[str, object] = {}
    exec(compile(blocks(text, "python")[0][1], "adding_a_method.md", "exec"), space)
    with pytest.raises(InputError, match="max_distance"):
        space["pca"](max_distance=0)
    case = registration_contract.Case(space["pca"])
    for law in registration_contract.LAWS:
        law(case)


# ---- the README: short, its first screen, and everything that it shows runs as it is written

README = (ROOT / "README.md").read_text()


def readme(language: str) -> list[str]:
    return [code for _, code in blocks(README, language)]


def test_it_is_short_and_starts_with_the_picture_and_the_two_commands() -> None:
    assert len(README.split()) <= 1500
    first_screen = README.partition("\n## ")[0]
    assert len(first_screen.splitlines()) < 35
    assert "](docs/overview.png)" in first_screen
    train, test = readme("sh")[0].splitlines()
    assert readme("sh")[0] in first_screen
    assert train.endswith("-m experiments.train --config vane.py")
    # one line, as .ci/run takes it
    assert re.fullmatch(r"python3 -m venv .* install .*'\.\[test\]' .*-m pytest", test)


def test_the_commands_register_a_scan(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    (block,) = [b for b in readme("sh") if "vanejax register" in b]
    run = [words[1:] for words in commands(block) if words[0] == "vanejax"]
    assert [command[0] for command in run] == ["scan", "register"]
    for command in run:
        assert main(command) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("scans: 6 scans")
    for line in readme("text")[0].splitlines():  # but for the last digits of another processor
        assert re.sub(r"\d+", "#", line) in re.sub(r"\d+", "#", printed)
    pose = np.array(json.loads(Path("pose.json").read_text())["part_from_camera"])
    label = json.loads(Path("scans/labels.json").read_text())["views"][0]
    truth = np.linalg.inv(np.array(label["camera_from_part"]))
    np.testing.assert_allclose(pose, truth, atol=0.01)  # 400 mm times 1e-5 rad, and 0.0003 mm
    assert Path("pose.html").stat().st_size > 10_000


@pytest.mark.slow  # 216 scans, and the compilation of a training step
def test_the_core_runs() -> None:
    (code,) = readme("python")
    assert len(code.splitlines()) <= 17
    space: dict = {}
    exec(compile(code, "README.md", "exec"), space)
    assert (len(space["scans"].train), len(space["scans"].test)) == (162, 54)
    assert int(space["state"].step) == 1
    assert np.isfinite(float(space["metrics"]["loss"]))
    result = space["result"]
    assert result.verdict.status == "accepted"
    placed = result.part_from_camera.apply(space["scan"].points[:100])
    true = space["views"].view(20).inverse().apply(space["scan"].points[:100])
    np.testing.assert_allclose(placed, true, atol=0.01)  # mm, no noise
