"""Scores of one run: each a value with its unit and the sentence of its measuring rule (docs/theory/metrics.md)."""

import math
from collections import Counter
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sonar_graph.evaluation.aligned import LEAST_LANDMARKS
from sonar_graph.evaluation.consistency import (
    GATED_SHARE,
    anees_interval,
    mean_normalised,
    nis,
    normalised_squares,
    time_average_interval,
)
from sonar_graph.evaluation.metrics import (
    FARTHEST_M,
    aligned_errors_m,
    landmark_errors,
    relative_errors,
    rmse,
    scored_map,
)
from sonar_graph.evaluation.results import ErrorSeries, Kind, RunResult, Score
from sonar_graph.evaluation.tables import ESTIMATES, SCORES, unaligned
from sonar_graph.sequence import Sequence
from sonar_graph.states import DetectionLog, LandmarkMap, Outcome, Trajectory

# time difference of the relative error, seconds
RELATIVE_DELTA_S = 10
# outcomes of detections that are in the estimate
USED = {
    *(Outcome.USED, Outcome.NEW, Outcome.USED_LATER),
    *(Outcome.PLACED_LATER, Outcome.MOVED, Outcome.REASSIGNED),
}
UNNAMED = {Outcome.NO_IDENTITY, Outcome.WAITING, Outcome.FORGOTTEN}


class ScoredWords(NamedTuple):
    """What the protocols of a comparison's trajectories have in common."""

    instants: str
    """The scored instants."""
    world: str
    """`unaligned`."""
    space: str
    """Position errors, in the directions that the truth has."""


def trajectory_scores(
    kind: Kind,
    estimate: Trajectory,
    truth: Trajectory,
    errors: ErrorSeries,
    words: ScoredWords,
) -> dict[str, Score]:
    """Accuracy and consistency of one trajectory, under keys that begin with its kind.

    Estimate, truth and errors are at the scored instants. Scores that need true orientations are left out where the
    truth has positions only. Where it has no heights, the caller has set those of the estimate to those of the truth.
    """
    over = f"over {words.instants}, to which the truth is interpolated"
    said: dict[str, Any] = {
        "which": ESTIMATES[kind],
        "world": words.world,
        "space": words.space,
        "over": over,
        "fitted": "without scale (Umeyama 1991), fitted to these instants: rms of",
    }
    aligned_m = aligned_errors_m(estimate.positions, truth.positions)
    values = {
        "ate_raw_m": errors.position_m,
        "ate_yaw_m": aligned_m,
        "ate_se2_m": aligned_m[:, :2],
        "yaw_rmse_rad": errors.yaw_rad,
    }
    # displacement is in the body frame, for which a true orientation is needed
    moved_m, turned_rad = relative_errors(estimate, truth, RELATIVE_DELTA_S)
    if len(moved_m) and truth.has_orientation:
        said["pairs"] = (
            f"over {len(moved_m)} overlapping pairs {RELATIVE_DELTA_S} s apart, {over}"
        )
        values |= {"rpe_10s_m": moved_m, "rpe_10s_rad": turned_rad}
    scores = {
        f"{kind}.{key}": defined(f"{kind}.{key}", rmse(value), **said)
        for key, value in values.items()
    }
    said["axes"] = "x and y" if errors.position_dof == 2 else "x, y and z"
    for key, nees, dof, samples in (
        ("position", errors.nees_position, errors.position_dof, errors.position_samples),
        ("yaw", errors.nees_yaw, 1, errors.yaw_samples),
    ):  # fmt: skip
        # the protocol states how many instants the mean is of
        known = int(np.isfinite(nees).sum())
        scores[f"{kind}.nees_{key}"] = defined(
            f"{kind}.nees_{key}",
            mean_normalised(nees, dof),
            time_average_interval(samples, dof),
            **said,
            dof=dof,
            known=known,
            samples=samples,
        )
    return _finite(scores)


def defined(
    key: str,
    value: float,
    interval: tuple[float, float] | None = None,
    **said: object,
) -> Score:
    """The score of this key, with its unit, and its rule in which the values stand."""
    kind = SCORES[key]
    protocol = kind.rule.format(**said)
    return Score(value, kind.unit, protocol, interval, kind.better)


def landmark_scores(estimated: LandmarkMap, sequence: Sequence) -> dict[str, Score]:
    """The final map against the true one, where there is one."""
    scores = {"landmarks.count": defined("landmarks.count", float(len(estimated)))}
    true = sequence.true_landmarks
    scored = scored_map(estimated, sequence)
    if true is None or scored is None:
        return scores
    named = scored.landmarks
    is_aligned = scored.alignment is not None
    errors = landmark_errors(named, true)
    if not len(errors):
        return scores
    by_place = len(np.setdiff1d(named.ids, estimated.ids))
    how = (
        f"by identity, {by_place} of them by place within {FARTHEST_M:g} m"
        if by_place
        else "by identity"
    )
    which = f"Map at the end, {len(errors)} landmarks matched {how} ({len(true)} true, {len(estimated)} estimated)"
    nees = normalised_squares(errors.horizontal_m, errors.horizontal_covs)
    where = (
        "aligned, since without a true path the world of the landmarks is not that of the start"
        if is_aligned
        else unaligned(sequence)
    )
    dof = 2 * len(errors) - (3 if is_aligned else 0)
    values = {
        "landmarks.raw_m": math.nan if is_aligned else rmse(errors.horizontal_m),
        "landmarks.se2_m": errors.aligned_rmse_m,
        "landmarks.count": float(len(estimated)),
        "landmarks.nees": float(nees.sum() / dof) if dof else math.nan,
    }
    return _finite(
        {
            key: defined(key, value, which=which, where=where, dof=dof)
            for key, value in values.items()
        }
    )


def own_map_scores(errors_m: list[float]) -> dict[str, Score]:
    """The causal position on the run's own map at instants that all runs with a map share."""
    if not errors_m:
        return {}
    said: dict[str, Any] = {"instants": len(errors_m), "landmarks": LEAST_LANDMARKS}
    key = "causal.own_map_m"
    return {key: defined(key, rmse(np.array(errors_m)), **said)}


def detection_scores(log: DetectionLog) -> dict[str, Score]:
    """Counts of detections by outcome, and the NIS of those used."""
    counts = Counter(log.outcomes)
    new = counts[Outcome.NEW]
    ignored = counts[Outcome.IGNORED]
    used = sum(counts[outcome] for outcome in USED)
    unnamed = sum(counts[outcome] for outcome in UNNAMED)
    refused = len(log) - used - ignored - unnamed
    of_all = f"of {len(log)}" + (
        f", {ignored} of which this estimator has no use for" if ignored else ""
    )
    values = {"used": used, "refused": refused, "unnamed": unnamed}
    scores = {
        f"detections.{key}": defined(
            f"detections.{key}", float(n), of_all=of_all, new=new
        )
        for key, n in values.items()
    }
    squares = nis(log)
    if squares.size:
        band = anees_interval(squares.size, 2)
        mean = mean_normalised(squares, 2)
        found = defined("detections.nis", mean, band, used=squares.size)
        if counts[Outcome.GATED] > GATED_SHARE * len(log):
            # what the gate let through is no evidence then
            found = replace(found, better="none")
        scores["detections.nis"] = found
    return scores


def resource_scores(run: RunResult, log_s: float) -> dict[str, Score]:
    """Time and memory of one run over a log of this duration in seconds."""
    total_s = float(run.update_s.sum() + run.finish_s)
    ms = run.update_s * 1e3
    values = {
        "time.update_median_ms": np.median(ms),
        "time.update_p99_ms": np.quantile(ms, 0.99),
        "time.update_max_ms": ms.max(),
        "time.total_s": total_s,
        "time.real_time_factor": log_s / total_s,
        "memory.peak_mb": run.peak_memory_mb,
    }
    said: dict[str, Any] = {"calls": len(run.update_s), "log_s": log_s}
    return _finite(
        {key: defined(key, float(value), **said) for key, value in values.items()}
    )


def _finite(scores: dict[str, Score]) -> dict[str, Score]:
    """Without those that could not be determined."""
    return {key: score for key, score in scores.items() if math.isfinite(score.value)}
