"""Comparison of estimators: the same measurements, the same instants, the same truth. See docs/design/0007."""

import logging
import os
import platform
import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sonar_graph.diagnosis import compared
from sonar_graph.errors import ArgumentError, EvaluationError
from sonar_graph.estimator import EstimatorChoice, name_of
from sonar_graph.evaluation.aligned import own_map_errors
from sonar_graph.evaluation.consistency import error_series
from sonar_graph.evaluation.free_start import with_fitted_truth
from sonar_graph.evaluation.results import (
    ByName,
    Comparison,
    ErrorSeries,
    Kind,
    RunResult,
    Score,
)
from sonar_graph.evaluation.run import check_request, run_estimator
from sonar_graph.evaluation.scored_instants import rows_at, scored_instants
from sonar_graph.evaluation.scores import (
    ScoredWords,
    detection_scores,
    landmark_scores,
    own_map_scores,
    resource_scores,
    trajectory_scores,
)
from sonar_graph.evaluation.tables import FITTED, HEIGHTS, NO_HEIGHTS, unaligned
from sonar_graph.files import spelt
from sonar_graph.measurements import Ints
from sonar_graph.sequence import Sequence, require_sequence
from sonar_graph.states import Trajectory
from sonar_graph.version import __version__

LOG = logging.getLogger("sonar_graph.evaluation")
LIBRARIES = ("gtsam", "numpy", "scipy", "numba")
# fewer scored instants than this make no trajectory
LEAST_INSTANTS = 2


@lru_cache
def library_versions() -> dict[str, str]:
    """Versions of `LIBRARIES`; kept, because each look-up goes through all that is installed."""
    return {library: version(library) for library in LIBRARIES}


def describe_environment() -> dict[str, str]:
    """Versions, machine, date (UTC) and command, each as text."""
    command = [Path(sys.argv[0]).name, *sys.argv[1:]]
    return {
        "sonar_graph": __version__,
        "python": platform.python_version(),
        **library_versions(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} processors",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": spelt(shlex.join(command)),
    }


def compare(
    sequence: Sequence,
    estimators: list[EstimatorChoice] | list[str],
    overrides: dict[str, dict[str, Any]] | None = None,
    *,
    rate_hz: float = 2.0,
    progress: Callable[[str, int, int], None] | None = None,
) -> Comparison:
    """Compare the sensors of a sequence, run estimators one after the other over it, and score them.

    What the sensors contradict is in the notes of the comparison's sequence and is logged, as are failures of estimators.

    Parameters
    ----------
    estimators
        Names under which estimators are installed, classes of your own, or functions ``make(calibration, odometry)``
        that return an estimator; each name once. A class or function gives its results its own name.
    overrides
        Settings that differ from the defaults, by name: ``{"isam2": {"identity.policy": "gate"}}``.
    rate_hz
        Rate of the estimates, from the start on, Hz.
    progress
        Called after each step with the estimator's name, the number of its steps done and their total.

    Returns
    -------
    Runs, scores and errors. In a notebook it shows itself as a table; `sonar_graph.report.write_report` writes it.

    Raises
    ------
    EvaluationError
        When no estimator is named, one is named twice, or settings are for one that is not named.
    UnknownEstimatorError, EstimatorError
        As in `run_estimator`, before anything runs: mistakes in names and settings. A failed run is a result instead.
    ArgumentError
        When `sequence` is no `Sequence`, `estimators` is no list, or `overrides` is no mapping.

    Examples
    --------
    >>> from sonar_graph.evaluation import compare
    >>> from sonar_graph.simulation import MissionOptions, simulate_mission
    >>> sequence = simulate_mission(MissionOptions(duration_s=10.0))
    >>> comparison = compare(sequence, ["ekf-slam", "dead-reckoning"])
    >>> sorted(comparison.scores)
    ['dead-reckoning', 'ekf-slam']
    >>> comparison.scores["ekf-slam"]["causal.ate_se2_m"].value < 0.1
    True
    """
    # a path in place of a sequence is the commonest mistake
    require_sequence(sequence, "compare(sequence, estimators)")
    if not isinstance(estimators, list | tuple):
        raise ArgumentError(
            f"compare(sequence, estimators): estimators is a list: give {as_list(estimators)}"
        )
    names = [name_of(one) for one in estimators]
    settings = overrides or {}
    if not isinstance(settings, Mapping):
        raise ArgumentError(
            f"compare(sequence, estimators, overrides): expected settings by estimator, such as "
            f"{{'isam2': {{'kernel.width': 2.0}}}}, not {type(settings).__name__}"
        )
    if not names:
        raise EvaluationError("no estimator to compare; name at least one")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise EvaluationError(
            f"named more than once: {', '.join(twice)}; each estimator runs once in a comparison"
        )
    # a misspelt name would let the defaults run, which looks like the settings had no effect
    idle = sorted(set(settings) - set(names))
    if idle:
        raise EvaluationError(
            f"settings for {', '.join(idle)}, which is not among {', '.join(names)}; "
            f"give them by estimator: {{{names[0]!r}: {{...}}}}"
        )
    # before anything runs: a mistake found after an hour costs that hour
    for name, estimator in zip(names, estimators, strict=True):
        check_request(estimator, settings.get(name))
    sequence = with_doubts(sequence)
    # once for all: errors at other instants cannot be compared
    instants_ns = sequence.instants(rate_hz)
    runs = []
    for name, estimator in zip(names, estimators, strict=True):
        told = None if progress is None else partial(progress, name)
        runs.append(
            run_estimator(
                sequence,
                estimator,
                settings.get(name),
                instants_ns=instants_ns,
                progress=told,
            )
        )
        if runs[-1].status == "failed":
            LOG.warning("%s failed: %s", name, runs[-1].reason)
    return judge(sequence, instants_ns, runs)


def with_doubts(sequence: Sequence) -> Sequence:
    """The sequence with notes on contradictions between its sensors; notes that it did not have before are logged."""
    found = compared(sequence)
    for subject in ("log.doubtful", "log.sensors"):
        # a sequence that had its notes was logged when they were made
        if found is not sequence and subject in found.notes:
            LOG.warning("%s: %s: %s", sequence.name, subject, found.notes[subject])
    return found


def as_list(given: object) -> str:
    """Text of the list that a user may have meant who gave something else in its place."""
    if isinstance(given, Mapping):
        names = ", ".join(repr(name) for name in given)
        return (
            f"[{names}], and settings after it: compare(sequence, [{names}], {{...}})"
        )
    if isinstance(given, str):
        return f"[{given!r}]"
    name = getattr(given, "__name__", "")
    return f"[{name}]" if name else f'["isam2"], not {given!r:.60}'


def judge(sequence: Sequence, instants_ns: Ints, runs: list[RunResult]) -> Comparison:
    """Score runs with estimates at these instants, shape (n,)."""
    environment = describe_environment()
    # before any score: all are against the truth in the world of the estimates
    sequence = with_fitted_truth(sequence, instants_ns, runs)
    # heights that were not measured are all alike; true poses of a dive may be as well
    true = sequence.truth
    is_flat = (
        true is not None
        and len(true) > 1
        and not true.has_orientation
        and not np.ptp(true.positions[:, 2])
    )
    if is_flat:
        sequence = replace(sequence, notes={**sequence.notes, HEIGHTS: NO_HEIGHTS})
    errors: dict[str, dict[Kind, ErrorSeries]] = {}
    scores: dict[str, dict[str, Score]] = ByName(
        {run.estimator: ByName.of_failed(run.reason) for run in runs}
    )
    # a failed run has no numbers, and must not take instants from the others
    ended = [run for run in runs if run.status != "failed"]
    for run in ended:
        own = scores[run.estimator]
        own |= resource_scores(run, sequence.duration_s)
        if run.landmarks is not None:
            own |= landmark_scores(run.landmarks, sequence)
        if run.detections is not None:
            own |= detection_scores(run.detections)
    comparison = Comparison(sequence, instants_ns, runs, scores, errors, environment)
    if not true or not ended:
        why = "no run has a pose"
        if not true:
            why = "the log has no truth, so no trajectory error can be given; `--truth FILE` gives it one"
        environment["scored instants"] = f"none: {why}"
        return comparison
    scored = scored_instants(instants_ns, true, runs)
    # a reader of the protocol must see that the truth was moved
    fitted = f"; {unaligned(sequence)}" if FITTED in sequence.notes else ""
    environment["scored instants"] = f"{scored}{fitted}"
    if len(scored) < LEAST_INSTANTS:
        environment["scored instants"] += ": too few for any trajectory error"
        return comparison
    truth = true.at(scored.stamps_ns)
    # a planar vehicle has no error in z that an estimator could make
    position_dof = 3 if sequence.calibration.planar is None and not is_flat else 2
    space = f"{'horizontal' if is_flat else '3-D'} position error"
    words = ScoredWords(str(scored), unaligned(sequence), space)
    on_maps: dict[str, dict[int, float]] = {}
    for run in runs:
        errors[run.estimator] = {}
        if run not in ended or run.causal is None or run.smoothed is None:
            continue
        both: dict[Kind, Trajectory] = {"causal": run.causal, "smoothed": run.smoothed}
        for kind, trajectory in both.items():
            # the same instants for every run and kind
            estimate = rows_at(trajectory, scored.stamps_ns)
            if is_flat:
                x_y_z = np.c_[estimate.positions[:, :2], truth.positions[:, 2]]
                estimate = replace(estimate, positions=x_y_z)
            series = error_series(estimate, truth, position_dof)
            errors[run.estimator][kind] = series
            scores[run.estimator] |= trajectory_scores(
                kind, estimate, truth, series, words
            )
        # a run without a map at all must not take all instants from the others
        if own_errors := own_map_errors(run, sequence, scored.stamps_ns):
            on_maps[run.estimator] = own_errors
    # errors on maps of other instants are of other lengths of the way
    shared_ns = sorted(set(scored.stamps_ns.tolist()).intersection(*on_maps.values()))
    for name, own_errors in on_maps.items():
        scores[name] |= own_map_scores([own_errors[at_ns] for at_ns in shared_ns])
    return comparison
