"""The command lines that take a ``--config``: overrides, the work folder, errors in one line."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from absl import app, flags, logging
from ml_collections import config_flags

from experiments.runner.experiment import Experiment
from experiments.runner.stopping import exit_code
from vanejax import compilation_cache
from vanejax.errors import InputError
from vanejax.settings import hint

CONFIG_FOLDER = Path(__file__).parents[1] / "configs"
flags.disclaim_key_flags()  # the flags defined here belong to the command that asks for them

_OVERRIDE = re.compile(r"--?config\.([^=]+)")


WORKDIR = (
    "folder of the run; if not given, runs/NAME with the config's name, and -NETWORK where another "
    "network than RPM-Net is trained"
)


def default_workdir(config: Any) -> str:
    """The folder of a run whose command line names none."""
    network = config.model.name if isinstance(config, Experiment) else "rpmnet"
    return f"runs/{config.name}" if network == "rpmnet" else f"runs/{config.name}-{network}"


def define_flags(workdir: str = WORKDIR) -> None:
    """Defines ``--config`` and ``--workdir`` with these words of help."""
    config_flags.DEFINE_config_file(
        "config",
        None,
        f"a file with get_config(), here or in experiments/configs/ ({_names()}). Any field can be "
        "overridden: --config.model.num_neighbors=16",
    )
    flags.DEFINE_string("workdir", None, workdir)


def run(
    main: Callable[[Any, Path], object],
    *,
    tree: type = Experiment,
    workdir: str = WORKDIR,
    default: Callable[[Any], str] = default_workdir,
) -> None:
    """Parses the command line, runs ``main`` on config and work folder, exits with its `exit_code`.

    ``tree`` is the dataclass that a config file's ``get_config()`` must return; ``workdir`` is the
    help of ``--workdir``, and ``default`` the folder where it is not given.
    """

    def guarded(rest: list[str]) -> int:
        logging.set_verbosity(logging.ERROR)  # orbax tells of every file it writes
        return exit_code(lambda: checked(rest))

    def checked(rest: list[str]) -> None:
        if len(rest) > 1:
            raise InputError(f"no such argument: {' '.join(rest[1:])}; see --help")
        if flags.FLAGS.config is None:
            raise InputError("--config is missing; try --config vane.py, or --help")
        if not isinstance(flags.FLAGS.config, tree):
            kind = type(flags.FLAGS.config).__name__
            raise InputError(
                f"--config: the file holds settings of the kind {kind}, this command takes "
                f"{tree.__name__}; see --help"
            )
        compilation_cache.enable()
        config = flags.FLAGS.config
        main(config, Path(flags.FLAGS.workdir or default(config)))

    def parsed_and_run() -> None:
        parser = functools.partial(_parse, tree)
        app.run(guarded, argv=resolve_config(sys.argv), flags_parser=parser)

    define_flags(workdir)
    sys.exit(exit_code(parsed_and_run))


def resolve_config(argv: list[str]) -> list[str]:
    """Replaces a bare config name by its path: the working folder first, then ours."""
    argv = list(argv)
    for index, before, value in _configs(argv):
        path = next((p for p in (Path(value), CONFIG_FOLDER / value) if p.is_file()), None)
        if path is None:
            raise InputError(f"no config {value!r} here or in experiments/configs/: {_names()}")
        argv[index] = f"{before}{path}"
    return argv


def _names() -> str:
    """The config files that there are."""
    return ", ".join(sorted(path.name for path in CONFIG_FOLDER.glob("[!_]*.py")))


def _configs(argv: Sequence[str]) -> Iterator[tuple[int, str, str]]:
    """Every value of ``--config``: the place of its word, what stands before it there, and it."""
    for index, argument in enumerate(argv):
        name, equals, value = argument.partition("=")
        if name in ("--config", "-config"):
            if not equals and index + 1 == len(argv):
                raise InputError("--config needs a file, such as --config vane.py")
            yield (index, f"{name}=", value) if equals else (index + 1, "", argv[index + 1])


def _parse(tree: type, argv: list[str]) -> list[str]:
    """Absl's parser, with overrides checked first so that a typo lists the right names."""
    config = _load(argv) or tree()
    for argument in argv[1:]:
        if match := _OVERRIDE.match(argument):
            check_field(config, match.group(1))
    try:
        return flags.FLAGS(argv)
    except flags.IllegalFlagValueError as error:
        match = _OVERRIDE.search(str(error))
        wanted = f"; it takes {kind_of(config, match.group(1))}" if match else ""
        raise InputError(f"{error}{wanted}") from error
    except (flags.Error, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{error}; see --help") from error


def _load(argv: list[str]) -> Any:
    """What the config file of a command line holds before overrides; None where none is named."""
    for _, _, path in _configs(argv):
        spec = importlib.util.spec_from_file_location("config_of_this_command", path)
        module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.get_config()
    return None


def kind_of(config: Any, path: str) -> str:
    """What a field holds, such as "an int, for example 32"."""
    value: Any = config
    for name in path.split("."):
        value = getattr(value, name)
    kind = type(value).__name__
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}, for example {value!r}"


def check_field(config: Any, path: str) -> None:
    """Refuses a path such as ``model.num_neighbors`` that names no field, and says what is near."""
    node: Any = config
    walked = "config"
    for name in path.split("."):
        names = [f.name for f in dataclasses.fields(node)] if dataclasses.is_dataclass(node) else []
        if name not in names:
            right = f"its fields are: {', '.join(names)}" if names else "it has no fields"
            raise InputError(
                f"--config.{path}: {walked} has no {name!r}{hint(name, names)} ({right})"
            )
        node = getattr(node, name)
        walked = f"{walked}.{name}"
    if dataclasses.is_dataclass(node):
        names = ", ".join(f.name for f in dataclasses.fields(node))
        raise InputError(f"--config.{path} is a group; set one of its fields: {names}")
