"""Several estimators on the same measurements, asked at the same instants, judged by the same truth.

What a comparison ran on: versions, machine, date, command.
"""

from __future__ import annotations

import os
import platform
import shlex
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import sonar_graph
from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation.consistency import error_series
from sonar_graph.evaluation.results import Comparison, ErrorSeries, Kind, RunResult, Score
from sonar_graph.evaluation.run import check_request, run_estimator
from sonar_graph.evaluation.scored_instants import ScoredInstants, rows_at, scored_instants
from sonar_graph.evaluation.scores import detection_scores, landmark_scores, resource_scores, trajectory_scores
from sonar_graph.measurements import Ints
from sonar_graph.sequence import Sequence
from sonar_graph.states import Trajectory

LIBRARIES = ("gtsam", "numpy", "scipy", "numba")


def describe_environment() -> dict[str, str]:
    """Versions, machine, date (UTC) and command, each as text."""
    command = [Path(sys.argv[0]).name, *sys.argv[1:]]
    return {
        "sonar_graph": sonar_graph.__version__,
        "python": platform.python_version(),
        **_library_versions(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} processors",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": shlex.join(command),
    }


@lru_cache
def _library_versions() -> dict[str, str]:
    """Looked up once: each look goes through all that is installed."""
    return {library: version(library) for library in LIBRARIES}


LEAST_INSTANTS = 2
"""Fewer scored instants than this make no trajectory."""


def compare(
    sequence: Sequence,
    names: list[str],
    overrides: dict[str, dict[str, Any]] | None = None,
    *,
    rate_hz: float = 2.0,
    progress: Callable[[str, int, int], None] | None = None,
) -> Comparison:
    """Run estimators one after the other over one sequence and score them.

    Parameters
    ----------
    names
        Estimators by the names under which they are installed, each once.
    overrides
        Settings that differ from the defaults, by estimator.
    rate_hz
        How often estimates are asked for, from the start on.
    progress
        Called after each step with the estimator's name, the number of its steps done and their total.

    Raises
    ------
    EvaluationError
        When no estimator is named, one is named twice, or settings are for one that is not named.
    UnknownEstimatorError, EstimatorError
        As in `run_estimator`, before anything runs: mistakes in names and settings. A failed run is a result instead.
    """
    settings = overrides or {}
    _check_names(names, settings)
    for name in names:
        check_request(name, settings.get(name))
    instants_ns = sequence.instants(rate_hz)
    runs = [
        run_estimator(sequence, name, settings.get(name), instants_ns=instants_ns, progress=_named(progress, name))
        for name in names
    ]
    return judge(sequence, instants_ns, runs)


def judge(sequence: Sequence, instants_ns: Ints, runs: list[RunResult]) -> Comparison:
    """Score runs that were asked for estimates at the same instants."""
    environment = describe_environment()
    scores = {run.estimator: _other_scores(sequence, run) for run in runs}
    errors: dict[str, dict[Kind, ErrorSeries]] = {}
    if sequence.truth is None or not len(sequence.truth):
        environment["scored instants"] = "none: the log has no truth, so no trajectory error can be given"
        return Comparison(sequence, instants_ns, runs, scores, errors, environment)
    scored = scored_instants(instants_ns, sequence.truth, runs)
    environment["scored instants"] = str(scored)
    if len(scored) < LEAST_INSTANTS:
        environment["scored instants"] += ": too few for any trajectory error"
        return Comparison(sequence, instants_ns, runs, scores, errors, environment)
    truth = sequence.truth.at(scored.stamps_ns)
    for run in runs:
        estimates = _estimates(run, scored)
        errors[run.estimator] = _errors(sequence, estimates, truth)
        for kind, estimate in estimates.items():
            series = errors[run.estimator][kind]
            scores[run.estimator] |= trajectory_scores(kind, estimate, truth, series, str(scored))
    return Comparison(sequence, instants_ns, runs, scores, errors, environment)


def _estimates(run: RunResult, scored: ScoredInstants) -> dict[Kind, Trajectory]:
    """What a run said at the scored instants; nothing if it failed."""
    if run.status == "failed" or run.causal is None or run.smoothed is None:
        return {}
    return {"causal": rows_at(run.causal, scored.stamps_ns), "smoothed": rows_at(run.smoothed, scored.stamps_ns)}


def _errors(sequence: Sequence, estimates: dict[Kind, Trajectory], truth: Trajectory) -> dict[Kind, ErrorSeries]:
    """Raw errors of each estimate."""
    position_dof = 3 if sequence.calibration.planar is None else 2
    return {kind: error_series(estimate, truth, position_dof) for kind, estimate in estimates.items()}


def _other_scores(sequence: Sequence, run: RunResult) -> dict[str, Score]:
    """The scores of one run that need no true trajectory, by key; none if it failed."""
    if run.status == "failed":
        return {}
    scores = resource_scores(run, sequence.duration_s)
    if run.landmarks is not None:
        scores |= landmark_scores(run.landmarks, sequence.true_landmarks)
    if run.detections is not None:
        scores |= detection_scores(run.detections)
    return scores


def _check_names(names: list[str], overrides: dict[str, dict[str, Any]]) -> None:
    if not names:
        raise EvaluationError("no estimator to compare; name at least one")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise EvaluationError(f"named more than once: {', '.join(twice)}; each estimator runs once in a comparison")
    idle = sorted(set(overrides) - set(names))
    if idle:
        raise EvaluationError(f"settings for {', '.join(idle)}, which is not among {', '.join(names)}")


def _named(progress: Callable[[str, int, int], None] | None, name: str) -> Callable[[int, int], None] | None:
    """The progress of one estimator, reported under its name."""
    if progress is None:
        return None
    return lambda done, total: progress(name, done, total)
