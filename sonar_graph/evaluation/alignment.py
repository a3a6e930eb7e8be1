"""Rigid alignment of an estimate with the truth: what is left of an error without the choice of world frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_graph.errors import EvaluationError
from sonar_graph.measurements import Floats


@dataclass(frozen=True, eq=False)
class Alignment:
    """A rigid motion of the estimate's world into the truth's: ``p_truth = rotation @ p_estimate + translation``."""

    rotation: Floats
    """Shape (3, 3)."""
    translation: Floats
    """Shape (3,), metres."""

    def apply(self, points: Floats) -> Floats:
        """Points moved into the truth's world, shape (n, 3)."""
        return np.asarray(points @ self.rotation.T + self.translation)


def umeyama(points: Floats, targets: Floats) -> tuple[Floats, Floats]:
    """The rotation and translation that minimise ``sum |targets - (R points + t)|²``, without scale.

    Where the points leave the rotation open (all in one place, or in 3-D on one line) it is one of the best.

    Parameters
    ----------
    points, targets
        Paired, shape (n, d), n >= 1.

    Returns
    -------
    R : shape (d, d), determinant +1
    t : shape (d,)

    Raises
    ------
    EvaluationError
        When there is no pair, or the shapes differ.

    References
    ----------
    S. Umeyama, Least-squares estimation of transformation parameters between two point patterns, IEEE Transactions
    on Pattern Analysis and Machine Intelligence 13(4), 1991. Equation numbers below are his.
    """
    if points.shape != targets.shape or not len(points):
        raise EvaluationError(f"alignment needs paired points, at least one; got {points.shape} and {targets.shape}")
    mean_x, mean_y = points.mean(axis=0), targets.mean(axis=0)  # (34), (35)
    covariance = (targets - mean_y).T @ (points - mean_x) / len(points)  # (38)
    U, _, Vt = np.linalg.svd(covariance)
    S = np.ones(points.shape[1])
    S[-1] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))  # (43), which (39) equals at full rank
    R = (U * S) @ Vt  # (40)
    return R, mean_y - R @ mean_x  # (41) with c = 1


def align_se3(points: Floats, targets: Floats) -> Alignment:
    """The best rotation and translation in three dimensions, from points of shape (n, 3)."""
    return Alignment(*umeyama(points, targets))


def align_yaw(points: Floats, targets: Floats) -> Alignment:
    """The best rotation about the vertical and translation: the four directions that sonar, IMU and Doppler cannot see.

    Height and heading do not meet in the sum of squares, so its horizontal part is also the best SE(2) alignment.
    Points have shape (n, 3).
    """
    rotation, translation = np.eye(3), (targets - points).mean(axis=0)
    rotation[:2, :2], translation[:2] = umeyama(points[:, :2], targets[:, :2])
    return Alignment(rotation, translation)
