"""A comparison with each path and map moved onto the truth, so that figures and tables show the aligned errors.

Positions are moved by the rotation about the vertical and the translation that fit best: ``p' = R p + t``. A path is
fitted to the true path at the scored instants, a map to the true landmarks. These are the alignments of the scores
``causal.ate_se2_m``, ``smoothed.ate_se2_m`` and ``landmarks.se2_m``. NEES stay those of the estimates as reported.

A position on the estimator's own map is aligned by the map: the place where a vehicle finds itself among its landmarks.

    e_j = | T_j p(t_j) - p_true(t_j) |,    T_j: the best alignment of the map known at t_j to the true landmarks

A smoother moves its whole map when it learns, and the path that it gave before does not move with it. Raw and aligned
errors of the path count that; this one does not. Derivation: docs/theory/metrics.md.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from sonar_graph.evaluation.consistency import sigmas, world_position_covs
from sonar_graph.evaluation.metrics import (
    Alignment,
    align_map,
    align_yaw,
    in_both,
    scored_map,
    yaw_rad,
)
from sonar_graph.evaluation.results import Comparison, ErrorSeries, Kind, RunResult
from sonar_graph.evaluation.scored_instants import rows_at
from sonar_graph.measurements import Floats, Ints
from sonar_graph.models import wrap_angle
from sonar_graph.sequence import Sequence
from sonar_graph.states import LandmarkMap, Trajectory

# fewer landmarks leave the rotation of a map open; the map then moves with the causal path
LEAST_MATCHED = 2
# true landmarks that a map must name for an error on it: of two, the errors alone would turn it
LEAST_LANDMARKS = 3


def aligned_to_truth(comparison: Comparison) -> Comparison | None:
    """The comparison with every path and map aligned to the truth; None where no run has errors.

    Examples
    --------
    >>> from sonar_graph import compare
    >>> from sonar_graph.evaluation import aligned_to_truth
    >>> from sonar_graph.testing import small_world
    >>> comparison = compare(small_world(), ["dead-reckoning"])
    >>> errors = aligned_to_truth(comparison).errors["dead-reckoning"]["causal"]
    >>> bool(abs(errors.position_m[:, :2].mean()) < 1e-9)
    True
    """
    # without a truth there is nothing to align to
    if not any(comparison.errors.values()):
        return None
    runs = []
    errors: dict[str, dict[Kind, ErrorSeries]] = {}
    for run in comparison.runs:
        series = comparison.errors.get(run.estimator, {})
        if not series:
            runs.append(run)
            continue
        moved, errors[run.estimator] = _aligned_run(run, series, comparison.sequence)
        runs.append(moved)
    return replace(comparison, runs=runs, errors=errors, is_aligned=True)


def _aligned_run(
    run: RunResult, series: dict[Kind, ErrorSeries], sequence: Sequence
) -> tuple[RunResult, dict[Kind, ErrorSeries]]:
    """A run with its errors, after the alignments of its paths and of its map."""
    moved: dict[str, Any] = {}
    alignments: dict[Kind, Alignment] = {}
    errors: dict[Kind, ErrorSeries] = {}
    for kind, own in series.items():
        path = run.causal if kind == "causal" else run.smoothed
        assert path is not None, "a run with errors has a path"
        estimate = rows_at(path, own.stamps_ns)
        # estimate minus error is the true path at these instants
        truth = estimate.positions - own.position_m  # (n, 3)
        alignments[kind] = align_yaw(estimate.positions, truth)
        moved[kind] = alignments[kind].path(path)
        errors[kind] = _aligned_errors(estimate, truth, own, alignments[kind])
    # a map of fewer than two true landmarks moves with the path that it was made on
    of_map = alignments["causal"]
    if run.landmarks is not None:
        of_map = _of_map(run.landmarks, sequence) or of_map
        moved["landmarks"] = of_map.map(run.landmarks)
    moved["maps"] = [
        replace(known, landmarks=of_map.map(known.landmarks)) for known in run.maps
    ]
    return replace(run, **moved), errors


def _of_map(landmarks: LandmarkMap, sequence: Sequence) -> Alignment | None:
    """The alignment of a map to the true landmarks; None where too few of them are known."""
    true = sequence.true_landmarks
    scored = scored_map(landmarks, sequence)
    if true is None or scored is None:
        return None
    named, targets = in_both(scored.landmarks, true)
    return align_yaw(named.positions, targets) if len(named) >= LEAST_MATCHED else None


def _aligned_errors(
    estimate: Trajectory, truth: Floats, errors: ErrorSeries, alignment: Alignment
) -> ErrorSeries:
    """Errors after the alignment, with the reported covariances turned as the path is."""
    R = alignment.rotation
    # the 95 % bands are along the axes of the truth's world
    covs = R @ world_position_covs(estimate) @ R.T  # (n, 3, 3)
    return replace(
        errors,
        position_m=alignment.apply(estimate.positions) - truth,
        position_sigma_m=sigmas(np.diagonal(covs, axis1=1, axis2=2)),
        # a turn about the vertical adds the same angle to every heading
        yaw_rad=wrap_angle(errors.yaw_rad + yaw_rad(R[None])),
    )


def own_map_errors(
    run: RunResult, sequence: Sequence, scored_ns: Ints
) -> dict[int, float]:
    """Horizontal errors by the stamps of those scored instants at which the run's map was kept.

    Instants at which the map names fewer than `LEAST_LANDMARKS` true landmarks are left out.
    """
    truth = sequence.truth
    true = sequence.true_landmarks
    path = run.causal
    errors: dict[int, float] = {}
    if truth is None or true is None or path is None:
        return errors
    # each error has an alignment of its own: the map of that instant
    for known in run.maps:
        at_ns = np.array([known.stamp_ns])
        named = np.isin(known.landmarks.ids, true.ids).sum()
        if known.stamp_ns in scored_ns and named >= LEAST_LANDMARKS:
            alignment = align_map(known.landmarks, true, sequence.calibration)
            assert alignment is not None
            position = rows_at(path, at_ns).positions
            off = alignment.apply(position) - truth.at(at_ns).positions
            errors[known.stamp_ns] = float(np.linalg.norm(off[0, :2]))
    return errors
