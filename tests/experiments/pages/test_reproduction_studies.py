"""The studies' commands are those that made the records, in an order that works."""

from __future__ import annotations

import importlib
import json
from typing import Any

import pytest

from experiments.pages.reproduction import studies
from vanejax.errors import InputError


def test_every_record_has_a_study_and_every_study_a_record() -> None:
    there = {path.stem for path in studies.RESULTS.glob("*.json")}
    assert there <= set(studies.BY_RECORD)


def arguments_of(study: studies.Study) -> dict[str, Any]:
    """What the command's own parser makes of a study's arguments."""
    parser = importlib.import_module(study.arguments[0]).make_parser()
    words = study.words({"out": "o", "real_scans": "r", "shapes": "solids"})[1:]
    values = vars(parser.parse_args(words))
    return json.loads(json.dumps(values, default=str))


@pytest.mark.parametrize(
    "study", [s for s in studies.STUDIES if s.record], ids=lambda study: study.name
)
def test_the_command_is_the_one_that_made_the_record(study, results) -> None:
    if study.record not in results:
        pytest.skip(f"{study.record} is not recorded yet")
    config = results[study.record].get("config", {})
    if "out" in config:
        mine = arguments_of(study)
        # files and folders lie elsewhere; what an older record lacks has its default since
        paths = {"out", "weights", "folder"} | ({"only"} if study.name == "scaling" else set())
        for name in set(mine) & set(config) - paths:
            assert mine[name] == config[name], name
        if isinstance(mine.get("weights"), list):
            names = [[word.split("=")[0] for word in c["weights"]] for c in (mine, config)]
            assert names[0] == names[1]
    for argument in study.arguments:
        if argument.startswith("--config.") and "{" not in argument:
            path, value = argument.removeprefix("--config.").split("=")
            for name in path.split("."):
                config = config[name]
            assert str(config) == value
    if "--sweep" in study.arguments:
        (sweep,) = results[study.record]["sweeps"]
        field, values = study.arguments[study.arguments.index("--sweep") + 1].split("=")
        assert field == sweep["field"]
        assert [float(v) for v in values.split(",")] == sweep["values"]


def test_studies_come_after_what_they_need() -> None:
    for place, study in enumerate(studies.STUDIES):
        before = {other.name for other in studies.STUDIES[:place]}
        assert set(study.needs) <= before
        used = {a.split("}/")[1].split("/")[0] for a in study.arguments if "{out}/" in a}
        assert used <= set(study.needs) | {study.name}
    assert [s.name for s in studies.chosen("any_pose")] == ["vane", "vane_weights", "any_pose"]
    with pytest.raises(InputError, match="no study nothing; there are vane"):
        studies.chosen("nothing")
