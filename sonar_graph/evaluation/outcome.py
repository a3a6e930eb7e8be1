"""What an estimator handed back, checked before anyone judges it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonar_graph.errors import EvaluationError
from sonar_graph.measurements import Floats, Ints
from sonar_graph.states import Estimate, LandmarkMap, Trajectory

Flags = NDArray[np.bool_]
NEGATIVE_TOLERANCE = 1e-9
"""An eigenvalue may be this far below zero, as a fraction of the largest: rounding."""


def check_estimate(estimate: Estimate | None, end_ns: int) -> None:
    """Refuse an estimate for another instant than the one asked for.

    Raises
    ------
    EvaluationError
        Naming both stamps.
    """
    if estimate is not None and estimate.stamp_ns != end_ns:
        raise EvaluationError(f"process returned an estimate for {estimate.stamp_ns} ns when asked for {end_ns} ns")


def check_outcome(causal: Trajectory, smoothed: Trajectory, landmarks: LandmarkMap) -> None:
    """Refuse what cannot be scored.

    Raises
    ------
    EvaluationError
        When there is no estimate; the smoothed trajectory is not at the causal one's instants; a pose or landmark is
        not finite; a covariance is neither unknown (all NaN) nor symmetric and positive semidefinite.
    """
    if not len(causal):
        raise EvaluationError("process never returned an estimate")
    if not np.array_equal(causal.stamps_ns, smoothed.stamps_ns):
        raise EvaluationError(
            f"trajectory() has {len(smoothed)} instants, not the {len(causal)} for which process returned estimates"
        )
    for kind, trajectory in (("causal", causal), ("smoothed", smoothed)):
        rows = np.column_stack([trajectory.positions, trajectory.quaternions_xyzw])
        _refuse(_not_finite(rows), f"{kind} pose is not finite", trajectory.stamps_ns, "ns")
        _refuse(_impossible(trajectory.covariances), f"{kind} covariance is impossible", trajectory.stamps_ns, "ns")
    _refuse(_not_finite(landmarks.positions), "position is not finite", landmarks.ids, "landmark")
    _refuse(_impossible(landmarks.covariances), "covariance is impossible", landmarks.ids, "landmark")


def _refuse(bad: Flags, fault: str, labels: Ints, unit: str) -> None:
    """Raise for the first bad row, naming it and how many there are."""
    rows = np.flatnonzero(bad)
    if rows.size:
        raise EvaluationError(f"{fault} in {rows.size} of {len(bad)} rows, first at {unit} {labels[rows[0]]}")


def _not_finite(rows: Floats) -> Flags:
    return np.asarray(~np.all(np.isfinite(rows), axis=1))


def _impossible(covs: Floats) -> Flags:
    """Which of the covariances, shape (n, d, d), are partly NaN, infinite, asymmetric or not positive semidefinite."""
    n = len(covs)
    rows = covs.reshape(n, covs.shape[1] * covs.shape[2])
    unknown, finite = np.all(np.isnan(rows), axis=1), ~_not_finite(rows)
    filled = np.where(finite[:, None, None], covs, 0.0)
    size = np.abs(filled).max(axis=(1, 2), initial=0.0)
    asymmetry = np.abs(filled - filled.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
    smallest = np.linalg.eigvalsh(filled)[:, 0] if n else np.zeros(0)
    sound = finite & (asymmetry <= 1e-6 * size) & (smallest >= -NEGATIVE_TOLERANCE * size)
    return np.asarray(~(unknown | sound))
