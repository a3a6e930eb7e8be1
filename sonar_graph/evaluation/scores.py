"""Scores of one run: each a value with its unit and the sentence of its measuring rule (docs/theory/metrics.md)."""

import math
from collections import Counter
from typing import NamedTuple

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
from sonar_graph.evaluation.tables import unaligned
from sonar_graph.sequence import Sequence
from sonar_graph.states import DetectionLog, LandmarkMap, Outcome, Trajectory

# time difference of the relative error, seconds
RELATIVE_DELTA_S = 10
ESTIMATES: dict[str, str] = {
    "causal": "Causal estimate (what could be known at each instant)",
    "smoothed": "Smoothed estimate (what is known at the end about each instant)",
}
# outcomes of detections that are in the estimate
USED = {
    *(Outcome.USED, Outcome.NEW, Outcome.USED_LATER),
    *(Outcome.PLACED_LATER, Outcome.MOVED, Outcome.REASSIGNED),
}
UNNAMED = {Outcome.NO_IDENTITY, Outcome.WAITING, Outcome.FORGOTTEN}
IN_TIME = "errors of successive instants are correlated: their mean is worth {} independent samples, for which the band is"


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
    instants, world, space = words
    which = ESTIMATES[kind]
    # each protocol is one sentence that can be quoted alone
    over = f"over {instants}, to which the truth is interpolated"
    fitted = "without scale (Umeyama 1991), fitted to these instants: rms of"
    aligned_m = aligned_errors_m(estimate.positions, truth.positions)
    rules = [
        ("ate_raw_m", errors.position_m, f", {world}: rms of {space} {over}"),
        ("ate_yaw_m", aligned_m, f", aligned by yaw and translation {fitted} {space} {over}"),
        ("ate_se2_m", aligned_m[:, :2], f", aligned by SE(2) {fitted} horizontal position error {over}"),
        ("yaw_rmse_rad", errors.yaw_rad, f", {world}: rms of wrapped heading error {over}"),
    ]  # fmt: skip
    # displacement is in the body frame, for which a true orientation is needed
    moved_m, turned_rad = relative_errors(estimate, truth, RELATIVE_DELTA_S)
    if len(moved_m) and truth.has_orientation:
        pairs = (
            f"over {len(moved_m)} overlapping pairs {RELATIVE_DELTA_S} s apart, {over}"
        )
        rules += [
            ("rpe_10s_m", moved_m, f": rms of the error of body-frame displacement {pairs}"),
            ("rpe_10s_rad", turned_rad, f": rms of the error of heading change {pairs}"),
        ]  # fmt: skip
    scores = {
        key: Score(rmse(values), key.rpartition("_")[2], f"{which}{rule}.")
        for key, values, rule in rules
    }
    axes = "x and y" if errors.position_dof == 2 else "x, y and z"
    parts = [
        (errors.nees_position, errors.position_dof, errors.position_samples, f"position ({axes})"),
        (errors.nees_yaw, 1, errors.yaw_samples, "heading"),
    ]  # fmt: skip
    for key, (nees, dof, samples, what) in zip(
        ("nees_position", "nees_yaw"), parts, strict=True
    ):
        # the protocol states how many instants the mean is of
        known = int(np.isfinite(nees).sum())
        protocol = (
            f"{which}, {world}: mean normalised squared error of {what} divided by {dof}, {over}, {known} of which "
            f"have a covariance; 1 is consistent; {IN_TIME.format(samples)}."
        )
        interval = time_average_interval(samples, dof)
        mean = mean_normalised(nees, dof)
        scores[key] = Score(mean, "1", protocol, interval, better="inside")
    return {f"{kind}.{key}": score for key, score in _finite(scores).items()}


def landmark_scores(estimated: LandmarkMap, sequence: Sequence) -> dict[str, Score]:
    """The final map against the true one, where there is one."""
    mapped = float(len(estimated))
    count = Score(mapped, "1", "Landmarks in the map at the end.", better="none")
    scores = {"landmarks.count": count}
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
    se2 = "aligned by SE(2) without scale fitted to the landmarks: rms of horizontal error"
    where = (
        "aligned, since without a true path the world of the landmarks is not that of the start"
        if is_aligned
        else unaligned(sequence)
    )
    dof = 2 * len(errors) - (3 if is_aligned else 0)
    mean = float(nees.sum() / dof) if dof else math.nan
    rule = (
        f"{which}, {where}: sum of normalised squared horizontal errors divided by {dof}; 1 is consistent; "
        "landmarks of one map are correlated, so no band is given."
    )
    raw = f"{which}, {where}: rms of horizontal error."
    raw_m = math.nan if is_aligned else rmse(errors.horizontal_m)
    return _finite(
        {
            "landmarks.raw_m": Score(raw_m, "m", raw),
            "landmarks.se2_m": Score(errors.aligned_rmse_m, "m", f"{which}, {se2}."),
            **scores,
            "landmarks.nees": Score(mean, "1", rule, better="inside"),
        }
    )


def own_map_scores(errors_m: list[float]) -> dict[str, Score]:
    """The causal position on the run's own map at instants that all runs with a map share."""
    if not errors_m:
        return {}
    rule = (
        f"Causal estimate at {len(errors_m)} instants, moved by the alignment of the estimator's map as it was then "
        "to the true landmarks: rms of horizontal position error; of the instants at which maps are kept those at "
        f"which every estimator that maps so many knows {LEAST_LANDMARKS} landmarks."
    )
    return {"causal.own_map_m": Score(rmse(np.array(errors_m)), "m", rule)}


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
    rules = (
        ("used", used, f"Detections used, {of_all}; {new} of those used began a landmark."),
        ("refused", refused, f"Detections of a landmark refused, {of_all}: outside the gate, repeated, too late, taken "
         "back or without odometry."),
        ("unnamed", unnamed, f"Detections in which no landmark is probable enough for this estimator, {of_all}; the "
         "recogniser mostly took these for no landmark."),
    )  # fmt: skip
    scores = {
        f"detections.{key}": Score(float(n), "1", rule, better="none")
        for key, n, rule in rules
    }
    squares = nis(log)
    is_gated_much = counts[Outcome.GATED] > GATED_SHARE * len(log)
    if squares.size:
        rule = (
            f"Mean normalised squared innovation of {squares.size} detections used, divided by 2; 1 is consistent; the "
            "two-sided 95 % band takes innovations as independent; what a gate refused is not in it, which lowers it."
        )
        mean = mean_normalised(squares, 2)
        band = anees_interval(squares.size, 2)
        scores["detections.nis"] = Score(
            mean, "1", rule, band, "none" if is_gated_much else "inside"
        )
    return scores


def resource_scores(run: RunResult, log_s: float) -> dict[str, Score]:
    """Time and memory of one run over a log of this duration in seconds."""
    each = "one per instant, each with all measurements since the last"
    calls = f"wall-clock time over {len(run.update_s)} calls of process, {each}"
    total_s = float(run.update_s.sum() + run.finish_s)
    ms = run.update_s * 1e3
    speed = f"Duration of the log ({log_s:.1f} s) divided by time.total_s."
    whole = "all calls of process and of asking for trajectory and map at the end"
    memory = (
        "Highest resident memory of the process during the run above that at its start (Linux); memory freed by "
        "earlier runs is reused without being counted."
    )
    rules = [
        ("time.update_median_ms", np.median(ms), "ms", f"Median {calls}."),
        ("time.update_p99_ms", np.quantile(ms, 0.99), "ms", f"99th percentile of {calls}."),
        ("time.update_max_ms", ms.max(), "ms", f"Longest {calls}; compiling is not counted."),
        ("time.total_s", total_s, "s", f"Wall-clock time of {whole}."),
        ("time.real_time_factor", log_s / total_s, "1", speed),
        ("memory.peak_mb", run.peak_memory_mb, "MB", memory),
    ]  # fmt: skip
    # the last ratio alone is better when it is higher
    return _finite(
        {
            key: Score(
                float(value), unit, rule, better="higher" if unit == "1" else "lower"
            )
            for key, value, unit, rule in rules
        }
    )


def _finite(scores: dict[str, Score]) -> dict[str, Score]:
    """Without those that could not be determined."""
    return {key: score for key, score in scores.items() if math.isfinite(score.value)}
