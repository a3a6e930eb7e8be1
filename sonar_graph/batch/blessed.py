"""The file of a reference: what each run of a blessed batch was asked for, and what it reached."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sonar_graph.batch.recorded import RecordedBatch, RecordedRun
from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation.strict_json import read_json, write_json

FORMAT = "sonar_graph batch reference 2"
Name = tuple[str, str, int | None]
"""Log, contestant and seed."""


def write_reference(batch: RecordedBatch, keys: list[str], path: Path) -> None:
    """Write all runs with the scores under these keys.

    Raises
    ------
    EvaluationError
        When the results do not say what was asked for.
    """
    content = {"format": FORMAT, "suite": batch.name, "versions": batch.runs[0].texts, "metrics": keys}
    write_json(path, content | {"runs": [_entry(run, keys) for run in batch.runs]})


def _entry(run: RecordedRun, keys: list[str]) -> dict[str, Any]:
    scores = {key: run.values[key] for key in keys if run.ended and key in run.values}
    names = {"log": run.log, "estimator": run.contestant, "seed": run.seed}
    return {**names, "asked": asked_of(run), "status": run.status, "scores": scores}


def asked_of(run: RecordedRun) -> dict[str, Any]:
    """What the suite stated of a run.

    Raises
    ------
    EvaluationError
        When the results are of a version that did not record it.
    """
    if "asked" not in run.texts:
        raise EvaluationError(
            f"{told(name_of(run))}: the results have no column asked, so nobody knows what they are comparable with; "
            "run bench again in that folder"
        )
    return dict(json.loads(run.texts["asked"]))


def read_reference(path: Path) -> dict[str, Any]:
    """Content of a reference, its runs by name.

    Raises
    ------
    EvaluationError
        When the file is no reference of this version.
    """
    content = read_json(path)
    if content.get("format") != FORMAT:
        raise EvaluationError(
            f"{path}: format is {content.get('format')!r}, expected {FORMAT!r}; make it again with bench bless, from a "
            "batch run with the code that it stands for"
        )
    runs = {(entry["log"], entry["estimator"], entry["seed"]): entry for entry in content["runs"]}
    return content | {"runs": runs}


def check_comparable(entry: dict[str, Any], run: RecordedRun, path: Path) -> None:
    """Refuse a run that was asked for something else than the reference's of its name.

    Raises
    ------
    EvaluationError
        With run, field and both values.
    """
    before, now = _flat(entry["asked"]), _flat(asked_of(run))
    for field in sorted(before | now):
        if (field in before, before.get(field)) != (field in now, now.get(field)):
            raise EvaluationError(
                f"{path}: {told(name_of(run))}: {field} is {_value(now, field)}, in the reference "
                f"{_value(before, field)}; these are different experiments: run the suite of the reference, or bless a "
                "new one"
            )


def _flat(asked: dict[str, Any]) -> dict[str, Any]:
    """Fields by name; landmarks that are simulated with nothing stated of them are ``landmarks``, which is ``{}``."""
    flat: dict[str, Any] = {}
    for name, value in asked.items():
        if isinstance(value, dict) and value:
            flat |= {f"{name}.{inner}": content for inner, content in value.items()}
        elif value is not None and (value != {} or name == "landmarks"):
            flat[name] = value
    return flat


def _value(fields: dict[str, Any], field: str) -> str:
    return json.dumps(fields[field]) if field in fields else "not given"


def name_of(run: RecordedRun) -> Name:
    """Under which a run is found again in another batch of its suite."""
    return run.log, run.contestant, run.seed


def told(name: Name) -> str:
    """A run in words."""
    log, contestant, seed = name
    return f"{log}, {contestant}" + ("" if seed is None else f", seed {seed}")
