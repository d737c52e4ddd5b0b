"""How a command ends before its work is done, and the exit code of each way."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from vanejax.errors import InputError


class TrainingDiverged(RuntimeError):
    """The loss is not finite or has exploded; the last good checkpoint stands."""


class Interrupted(RuntimeError):
    """SIGINT or SIGTERM, the number ``signal``; the state is saved."""

    def __init__(self, number: int, step: int, folder: Path) -> None:
        name = signal.Signals(number).name
        super().__init__(f"stopped by {name} after step {step}; saved in {folder}")
        self.signal = number


@contextmanager
def stop_signal() -> Iterator[list[int]]:
    """A list that receives SIGINT or SIGTERM; a second one acts as it always does."""
    caught: list[int] = []
    before = {}

    def catch(number: int, _: object) -> None:
        caught.append(number)
        signal.signal(number, before[number])

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, catch)
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def exit_code(work: Callable[[], object]) -> int:
    """Does the work of a command; its exit code, after a line on stderr where it is not 0.

    2 where the input is at fault, 1 where a training diverged, 128 + N after signal N.
    """
    # jaxlib announces TPUs and GPUs that are not there
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    try:
        work()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except TrainingDiverged as trouble:
        print(
            f"error: training stopped: {trouble}. The last good checkpoint is kept. "
            "Try a lower learning_rate in config.training, with another --workdir.",
            file=sys.stderr,
        )
        return 1
    except Interrupted as stop:
        print(f"{stop}. Run the same command to go on.", file=sys.stderr)
        return 128 + stop.signal
    except KeyboardInterrupt:
        print("interrupted; what was finished and saved is kept", file=sys.stderr)
        return 128 + signal.SIGINT
    return 0
