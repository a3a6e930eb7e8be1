"""Pose covariances in this package's order and in ROS's.

Here the perturbation is ``[theta, rho]`` in the body frame; in ``geometry_msgs/PoseWithCovariance`` it is translation
and then rotation about the fixed axes of the header's frame. With ``R = world_R_body`` the first becomes the second by

    [rho_world; theta_world] = [[0, R], [R, 0]] [theta; rho]
"""

from __future__ import annotations

import numpy as np

from sonar_graph.measurements import Floats


def body_to_ros(covariances: Floats, rotations: Floats) -> Floats:
    """Covariances for ROS messages.

    Parameters
    ----------
    covariances
        Of ``[theta, rho]`` in the body frame, shape (n, 6, 6); NaN: unknown.
    rotations
        ``world_R_body``, shape (n, 3, 3).

    Returns
    -------
    ndarray
        Of ``[rho, theta]`` along the world's axes, shape (n, 6, 6); zeros: unknown.
    """
    swap = _swap(rotations)
    return np.nan_to_num(swap @ covariances @ swap.transpose(0, 2, 1), nan=0.0)


def ros_to_body(covariances: Floats, rotations: Floats) -> Floats:
    """The inverse of `body_to_ros`; all zeros, or a negative variance, mean unknown and become NaN."""
    swap = _swap(rotations).transpose(0, 2, 1)
    known = np.any(covariances != 0, axis=(1, 2)) & (np.diagonal(covariances, axis1=1, axis2=2) >= 0).all(axis=1)
    return np.where(known[:, None, None], swap @ covariances @ swap.transpose(0, 2, 1), np.nan)


def _swap(rotations: Floats) -> Floats:
    swap = np.zeros((len(rotations), 6, 6))
    swap[:, :3, 3:] = rotations
    swap[:, 3:, :3] = rotations
    return swap
