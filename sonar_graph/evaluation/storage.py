"""A comparison as a folder, and back.

::

    DIR/comparison.json         scores with units and protocol, states of the runs, settings, environment
    DIR/sequence.npz            truth, true landmarks, detections and instants
    DIR/recognition.json, recognised/STAMP.jpg
                                how detections came from sonar images, and the pictures that the report shows
    DIR/runs/NAME/trajectory.tum, causal.tum, landmarks.csv
                                what the estimator said, for other tools; absent when the run failed
    DIR/runs/NAME/result.json   settings, versions, timings, status and reason
    DIR/runs/NAME/series.npz    everything as arrays, with covariances

Each file appears whole or not at all. ``comparison.json`` goes first and comes last: a folder that has one is complete.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation.archive import (
    read_arrays,
    restore_errors,
    restore_run,
    restore_sequence,
    run_arrays,
    sequence_arrays,
    write_arrays,
)
from sonar_graph.evaluation.atomic import replacing
from sonar_graph.evaluation.metrics import rmse
from sonar_graph.evaluation.recognition import read_recognition, write_recognition
from sonar_graph.evaluation.refusals import gathered
from sonar_graph.evaluation.results import Comparison, ErrorSeries, Kind, RunResult, Score
from sonar_graph.evaluation.strict_json import read_json, write_json
from sonar_graph.logs.tum import write_landmarks_csv, write_tum
from sonar_graph.sequence import Sequence

FORMAT = "sonar_graph comparison 1"
INDEX, SEQUENCE, RUNS = "comparison.json", "sequence.npz", "runs"
RESULT, SERIES = "result.json", "series.npz"
ESTIMATES = ("trajectory.tum", "causal.tum", "landmarks.csv")


def write_comparison(comparison: Comparison, folder: Path) -> None:
    """Write a comparison into a folder, made where it does not exist.

    Files of the same names are replaced. The files of an earlier comparison's other runs, and of a run that now
    failed, are removed, so that nothing in the folder is of another comparison; files that are not ours stay.

    Raises
    ------
    EvaluationError
        When an estimator's name cannot be a folder's.
    """
    for run in comparison.runs:
        _check_folder_name(run.estimator)
    (folder / RUNS).mkdir(parents=True, exist_ok=True)
    (folder / INDEX).unlink(missing_ok=True)
    _remove_other_runs(folder / RUNS, {run.estimator for run in comparison.runs})
    write_arrays(folder / SEQUENCE, sequence_arrays(comparison.sequence) | {"instants_ns": comparison.instants_ns})
    for run in comparison.runs:
        _write_run(run, comparison, folder / RUNS / run.estimator)
    write_recognition(comparison.recognition, folder)
    write_json(folder / INDEX, _index(comparison))


def read_comparison(folder: Path) -> Comparison:
    """The comparison in a folder. Its sequence has start, end, truth and notes, but not the measurements.

    Raises
    ------
    EvaluationError
        When the folder holds no complete comparison, naming the file at fault.
    """
    if not (folder / INDEX).is_file():
        raise EvaluationError(f"{folder}: no {INDEX} in it; it needs a folder that a comparison was written to")
    index = read_json(folder / INDEX)
    if index.get("format") != FORMAT:
        raise EvaluationError(f"{folder / INDEX}: format is {index.get('format')!r}, expected {FORMAT!r}; compare anew")
    try:
        return _restore(index, folder)
    except (KeyError, TypeError, ValueError) as error:
        raise EvaluationError(f"{folder}: incomplete, {error} is missing or not as written; compare anew") from error


def _restore(index: dict[str, Any], folder: Path) -> Comparison:
    arrays = {name: read_arrays(folder / RUNS / name / SERIES) for name in index["runs"]}
    runs = {name: restore_run(_plain_run(name, entry), arrays[name]) for name, entry in index["runs"].items()}
    stored = read_arrays(folder / SEQUENCE)
    errors = {name: restore_errors(arrays[name]) for name in runs if "errors" in index["runs"][name]}
    return Comparison(
        sequence=_restore_sequence(index["sequence"], stored, folder),
        instants_ns=stored["instants_ns"],
        runs=list(runs.values()),
        scores={name: _restore_scores(entry["scores"]) for name, entry in index["runs"].items()},
        errors=errors,
        environment=index["environment"],
        recognition=read_recognition(folder),
    )


def _restore_sequence(entry: dict[str, Any], arrays: dict[str, np.ndarray], folder: Path) -> Sequence:
    calibration = Calibration.parse(entry["calibration"], str(folder / INDEX))
    return restore_sequence(entry["name"], calibration, entry["notes"], arrays)


def _restore_scores(entries: dict[str, dict[str, Any]]) -> dict[str, Score]:
    return {
        key: Score(**(entry | {"interval": tuple(entry["interval"]) if entry["interval"] else None}))
        for key, entry in entries.items()
    }


def _plain_run(name: str, entry: dict[str, Any]) -> RunResult:
    """A run as far as the index tells: without its arrays."""
    memory = entry["peak_memory_mb"]
    return RunResult(
        name,
        entry["params"],
        entry["status"],
        entry["reason"],
        withheld=entry.get("withheld", []),
        finish_s=entry["finish_s"],
        peak_memory_mb=float("nan") if memory is None else memory,
    )


def _index(comparison: Comparison) -> dict[str, Any]:
    """What comparison.json says."""
    sequence, instants = comparison.sequence, comparison.instants_ns
    return {
        "format": FORMAT,
        "sequence": {
            "name": sequence.name,
            "duration_s": sequence.duration_s,
            "notes": sequence.notes,
            "calibration": sequence.calibration.model_dump(mode="json"),
        },
        "instants": {"count": len(instants), "first_ns": int(instants[0]), "last_ns": int(instants[-1])},
        "environment": comparison.environment,
        "runs": {run.estimator: _run_entry(run, comparison) for run in comparison.runs},
    }


def _run_entry(run: RunResult, comparison: Comparison) -> dict[str, Any]:
    scores = comparison.scores.get(run.estimator, {})
    entry = _state(run) | {"scores": {key: asdict(score) for key, score in scores.items()}}
    if run.estimator in comparison.errors:
        errors = comparison.errors[run.estimator]
        entry["errors"] = {kind: _summary(series) for kind, series in errors.items()}
    return entry


def _state(run: RunResult) -> dict[str, Any]:
    return {
        "status": run.status,
        "reason": run.reason,
        "params": run.params,
        "finish_s": run.finish_s,
        "peak_memory_mb": run.peak_memory_mb,
        "refused": [asdict(rows) for rows in gathered(run.refused)],
        "withheld": run.withheld,
    }


def _summary(series: ErrorSeries) -> dict[str, Any]:
    """Raw errors by axis in a few numbers; the series itself is in the run's arrays."""
    rms_xyz = [rmse(series.position_m[:, axis]) for axis in range(3)]
    return {
        "instants": len(series.stamps_ns),
        "rms_xyz_m": rms_xyz,
        "max_position_m": float(np.linalg.norm(series.position_m, axis=1).max()),
        "rms_yaw_rad": rmse(series.yaw_rad),
        "max_yaw_rad": float(np.abs(series.yaw_rad).max()),
    }


def _write_run(run: RunResult, comparison: Comparison, folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    for name in ESTIMATES:
        (folder / name).unlink(missing_ok=True)
    if run.smoothed is not None and run.causal is not None and run.landmarks is not None:
        with replacing(folder / "trajectory.tum") as path:
            write_tum(path, run.smoothed)
        with replacing(folder / "causal.tum") as path:
            write_tum(path, run.causal)
        with replacing(folder / "landmarks.csv") as path:
            write_landmarks_csv(path, run.landmarks)
    errors: dict[Kind, ErrorSeries] = comparison.errors.get(run.estimator, {})
    write_arrays(folder / SERIES, run_arrays(run, errors))
    write_json(folder / RESULT, _result(run, comparison))


def _result(run: RunResult, comparison: Comparison) -> dict[str, Any]:
    """What result.json says: how this run went."""
    scores = comparison.scores.get(run.estimator, {})
    timings = {key.removeprefix("time."): score.value for key, score in scores.items() if key.startswith("time.")}
    return {
        "estimator": run.estimator,
        "sequence": comparison.sequence.name,
        **_state(run),
        "timings": timings | {"calls": len(run.update_s)},
        "environment": comparison.environment,
    }


def _remove_other_runs(folder: Path, names: set[str]) -> None:
    """Remove what earlier comparisons left under other names; a folder goes only when nothing else is in it."""
    for result in folder.glob(f"*/{RESULT}"):
        if result.parent.name not in names:
            for name in (*ESTIMATES, SERIES, RESULT):
                (result.parent / name).unlink(missing_ok=True)
            if not any(result.parent.iterdir()):
                result.parent.rmdir()


def _check_folder_name(name: str) -> None:
    if name in ("", ".", "..") or any(character in name for character in '/\\:*?"<>|'):
        raise EvaluationError(f"estimator name {name!r} cannot name a folder; install it under another name")
