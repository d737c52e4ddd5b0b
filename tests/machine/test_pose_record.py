"""What a pose file says beside the pose: read as it was written, and never trusted."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from example_result import example_result
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vanejax.errors import InputError
from vanejax.localization.pose_result import FormDeviation
from vanejax.localization.verdict import Limits
from vanejax.machine.pose_file import result_to_dict
from vanejax.machine.pose_record import PoseRecord, read_record

NAMES = {"scan_name": "scan", "part_name": "vane", "part_sha256": "ab" * 32}
FORM = FormDeviation(stock_mm=-0.2, stock_sigma_mm=0.01, field="form", field_mm=0.1, is_told=False)


@pytest.fixture
def written() -> dict[str, Any]:
    result = example_result()
    refinement = dataclasses.replace(result.refinement, form=FORM)
    result = dataclasses.replace(result, refinement=refinement)
    limits = Limits(tolerance_mm=0.3, tolerance_deg=0.1)
    return result_to_dict(result, **NAMES, calibration_name="paper_camera", limits=limits)


def read(tmp_path: Path, values: Any) -> PoseRecord:
    path = tmp_path / "pose.json"
    path.write_text(json.dumps(values))
    return read_record(path)


def test_what_is_written_is_read_again(tmp_path: Path, written: dict[str, Any]) -> None:
    found, uncertainty = read(tmp_path, written), example_result().uncertainty
    np.testing.assert_array_equal(found.covariance.covariance, uncertainty.covariance)
    np.testing.assert_array_equal(found.covariance.center, uncertainty.center)
    assert found.form == FORM
    assert found.verdict == example_result().verdict
    assert found.part_sha256 == "ab" * 32
    assert (found.calibration, found.tolerance_mm) == ("paper_camera", 0.3)


def test_what_an_old_file_does_not_say_is_none(tmp_path: Path, written: dict[str, Any]) -> None:
    new = ("uncertainty", "form_deviation", "calibration", "tolerance", "verdict", "part")
    found = read(tmp_path, {name: v for name, v in written.items() if name not in new})
    nothing = (*(None,) * 6, False)
    assert found[1:] == nothing
    assert read(tmp_path, written | dict.fromkeys(new))[1:] == nothing
    assert read(tmp_path, np.eye(4).tolist())[1:] == nothing


def changed(*at: Any) -> Any:
    """A function that puts the last value at the place that the others lead to."""
    *way, last, value = at

    def change(values: dict[str, Any]) -> None:
        for name in way:
            values = values[name]
        values[last] = value

    return change


ENTRY = ("uncertainty", "covariance")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (changed("uncertainty", [1]), "its uncertainty is no object"),
        (changed(*ENTRY, np.eye(3).tolist()), "its covariance is not 6 x 6 numbers"),
        (changed(*ENTRY, [[1.0] * 6] * 5 + [[1.0] * 5]), "not 6 x 6 numbers"),
        (changed(*ENTRY, 2, 2, None), "not 6 x 6 numbers"),
        (changed(*ENTRY, 2, 2, "1"), "not 6 x 6 numbers"),
        (changed(*ENTRY, 2, 2, True), "not 6 x 6 numbers"),
        (changed(*ENTRY, 2, 2, float("nan")), "its covariance holds a value that is not finite"),
        (changed(*ENTRY, 2, 2, 10**400), "not finite, or too large"),
        (changed(*ENTRY, 0, 1, 1e-15), "not symmetric"),
        (changed(*ENTRY, 2, 2, -1e-12), "negative variance in some direction"),
        (changed(*ENTRY, 2, 2, 0.0), None),
        (
            changed(*ENTRY, (np.diag(np.full(6, 1e-6)) + 1e-5 * np.eye(6)[::-1]).tolist()),
            "negative",
        ),
        (changed("uncertainty", "center_mm", [0.0, 0.0]), "its center_mm is not 3 numbers"),
        (changed("uncertainty", "center_mm", None), "its center_mm is not"),
        (changed("form_deviation", "0.5 mm"), "its form_deviation is no object"),
        (changed("form_deviation", "stock_mm", None), "form_deviation.stock_mm is not a number"),
        (changed("form_deviation", "field", "wavy"), "field is none of none, form,"),
        (changed("form_deviation", "converged", 1), "converged is neither true nor false"),
        (changed("form_deviation", "field_mm", -0.1), "field_mm is -0.1, less than 0"),
        (changed("tolerance", "mm", 0), "tolerance.mm is 0, not above 0"),
        (changed("tolerance", "mm", "wide"), "tolerance.mm is not a number"),
    ],
)
def test_what_is_wrong_is_named(
    tmp_path: Path, written: dict[str, Any], change: Any, words: str | None
) -> None:
    change(written)
    if words is None:
        read(tmp_path, written)
        return
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path, written)
    assert str(caught.value).startswith(str(tmp_path / "pose.json"))
    assert str(caught.value).endswith("write it again with `vanejax register --json`")


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=6)
        | st.dictionaries(
            st.sampled_from(["covariance", "center_mm", "status", "mm", "field"]), inner, max_size=3
        )
    ),
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    st.dictionaries(
        st.sampled_from(["uncertainty", "form_deviation", "tolerance", "calibration", "verdict"]),
        JSON,
    )
)
def test_nothing_but_an_input_error_comes_of_rubbish(tmp_path: Path, values: Any) -> None:
    with contextlib.suppress(InputError):
        record = read(tmp_path, {"part_from_camera": np.eye(4).tolist()} | values)
        numbers = [] if record.covariance is None else [record.covariance.covariance]
        if record.form is not None:
            numbers += [v for v in vars(record.form).values() if isinstance(v, int | float)]
        assert all(np.isfinite(each).all() for each in numbers)
