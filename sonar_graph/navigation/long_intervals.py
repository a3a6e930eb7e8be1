"""What long times between rows ask of joint preintegration.

Rule "inertial". What is straight in time is the velocity of the IMU's point less what the accelerometers gained; the
log's own swings about it. Over long intervals the log's samples are therefore taken to the IMU's point by the gyros,
``z - w x l``, and the log's way about that point, ``(R_j - R_i) l``, is added (`joint_recursion`). The gyros' noise at
the two ends is then one with that of the samples.

All other rules know nothing of the velocity between two samples: they refuse long intervals. No rule knows how the
vehicle turned in a hole of the inertial rows (`sonar_graph.navigation.unmeasured_turns`).
"""

from __future__ import annotations

import gtsam
import numpy as np

from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.joint_recursion import LONG_S
from sonar_graph.navigation.unmeasured_turns import row_after_hole


def refuse_beyond(longest_s: float, dvl_ns: Ints) -> None:
    """Raise where Doppler samples are too far apart for a velocity that they alone shape.

    Raises
    ------
    MeasurementError
        Names the interval.
    """
    between_ns = np.diff(dvl_ns)
    k = int(between_ns.argmax())
    if between_ns[k] > longest_s * 1e9:
        raise MeasurementError(
            f"Dvl.stamps_ns: no row for {between_ns[k] * 1e-9:.3g} s after {dvl_ns[k]} ns, more than longest_s"
            f' ({longest_s:g} s); use the rule "inertial", or let sonar_graph.navigation.odometry.Odometry bridge it'
        )


def refuse_holes(longest_s: float, imu_ns: Ints, first: int, last: int) -> None:
    """Raise where inertial rows, from one to another, are too far apart to tell how the vehicle turned.

    Raises
    ------
    MeasurementError
        Names the hole.
    """
    row = row_after_hole(imu_ns, first, last, round(longest_s * 1e9))
    if row >= 0:
        raise MeasurementError(
            f"Imu.stamps_ns: no row for {(imu_ns[row] - imu_ns[row - 1]) * 1e-9:.3g} s after {imu_ns[row - 1]} ns: the"
            " turn in there is not measured; begin a motion after it, let sonar_graph.navigation.odometry.Odometry"
            f" bridge it, or set longest_hole_s ({longest_s:g} s) higher if the vehicle hardly turns"
        )


def with_rate_noise(cov: Floats, dvl_ns: Ints, imu_ns: Ints, gyro_density: float, arm: Floats) -> Floats:
    """Covariances of ``z - w x l`` at samples that begin or end a long interval, of z at others.

    Parameters
    ----------
    cov
        Of the samples z, body axes, shape (n, 3, 3), m²/s².
    dvl_ns, imu_ns
        Stamps.
    gyro_density
        rad/s/√Hz.
    arm
        l, from the IMU to the Doppler log, body axes, shape (3,), m.

    Returns
    -------
    Shape (n, 3, 3), m²/s²: more by ``n_g² / dt [l]x [l]x^T`` with the mean time dt between inertial rows.
    """
    is_long = np.diff(dvl_ns) > LONG_S * 1e9
    if not is_long.any():
        return cov
    at_end = np.r_[False, is_long] | np.r_[is_long, False]
    rows_per_s = (len(imu_ns) - 1) * 1e9 / (imu_ns[-1] - imu_ns[0])
    turned = gyro_density * gtsam.SO3.Hat(arm)
    return cov + np.where(at_end[:, None, None], rows_per_s * turned @ turned.T, 0.0)
