"""What a report says of a training run."""

from __future__ import annotations

import math

import pytest

from experiments.runner.run_folder import VALIDATION, RunFolder, TrainingRecord, training_record
from vanejax.errors import InputError
from vanejax.files import write_text


def rows(errors_deg: list[float]) -> list[dict[str, float]]:
    """A validation every 10 steps, and a row of the training between them."""
    out = []
    for index, error in enumerate(errors_deg):
        step = 10 * (index + 1)
        out += [{"step": step - 5, "loss": 1.0}, {"step": step} | dict.fromkeys(VALIDATION, error)]
    return out


def test_the_fall_compares_the_last_quarter_with_the_third() -> None:
    record = TrainingRecord(rows([9, 9, 8, 8, 4, 4, 2, 2]), 7200.0)
    told = record.summary(80)
    assert told["steps"] == told["wanted_steps"] == 80
    assert told["ended_by"] == "steps"
    assert told["hours"] == 2
    assert told["fall_in_last_quarter"] == pytest.approx(0.5)
    assert not told["flat"]
    assert [point["step"] for point in record.curve] == list(range(10, 90, 10))
    flat = TrainingRecord(rows([9, 9, 8, 8, 4, 4, 3.9, 3.9]), 1.0).summary(80)
    assert flat["flat"]


def test_fewer_steps_than_wanted_were_ended_by_the_budget() -> None:
    assert TrainingRecord(rows([3, 2, 2, 2]), 1.0).summary(80)["ended_by"] == "budget"


def test_too_few_validations_leave_the_curve_open() -> None:
    for few in ([], rows([2.0])):
        told = TrainingRecord(few, 0.0).summary(10)
        assert math.isnan(told["fall_in_last_quarter"])
        assert not told["flat"]


def test_a_folder_keeps_its_clock_and_its_shapes(tmp_path) -> None:
    with RunFolder(tmp_path) as folder:
        assert folder.seconds == 0
        folder.seconds = 12.5
        folder.claim_shapes("200 solids", "abc")
        folder.claim_shapes("200 solids", "abc")
        with pytest.raises(InputError, match="other shapes: sha256 was 'abc', now 'def'"):
            folder.claim_shapes("200 solids", "def")
    write_text(tmp_path / "metrics.jsonl", '{"step": 3, "loss": 1.0}\n')
    record = training_record(tmp_path)
    assert record.seconds == 12.5
    assert record.rows == [{"step": 3, "loss": 1.0}]
