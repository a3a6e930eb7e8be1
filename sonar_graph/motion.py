"""Motion between two instants: its value, and the contract of its source.

A motion i_T_j is the mean of what gyros and Doppler log measured from instant i to instant j, with one covariance and
the derivative by the gyro bias. Its perturbation is [rotation, translation] in the last frame j::

    i_R_j = dR Exp(theta),    i_p_j = dp + dR rho,    [theta; rho] = D (bias - bias_0) + n,    n ~ N(0, C)

Epochs are the stamps of the Doppler log: between two of them the velocity is known on both sides and the motion is
final. An epoch counts as reached once its velocity is known and an IMU row at or after it has come; a velocity that has
to wait for others to confirm or complete it is known from their stamp on. docs/theory/preintegration.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import gtsam
import numpy as np

from sonar_graph.calibration import Calibration, require_calibration
from sonar_graph.errors import CalibrationError
from sonar_graph.measurements import Depth, Dvl, Floats, Imu, Ints
from sonar_graph.states import RefusedRow


@dataclass(frozen=True, eq=False)
class PreintegratedMotion:
    """Motion from body frame i to body frame j.

    Examples
    --------
    A second at 0.5 m/s, and the same again, as one motion:

    >>> import gtsam, numpy as np
    >>> still, second = np.zeros(3), gtsam.Pose3(gtsam.Rot3(), np.array([0.5, 0.0, 0.0]))
    >>> motion = PreintegratedMotion(second, 1e-4 * np.eye(6), np.zeros((6, 3)), still, 1.0, np.array([0.0, 0.0, 9.81]))
    >>> twice = motion.then(motion)
    >>> round(float(twice.i_T_j.x()), 6), round(twice.duration_s, 6)
    (1.0, 2.0)
    """

    i_T_j: gtsam.Pose3
    """Mean, for the gyro bias `bias`."""
    covariance: Floats
    """C, covariance of [theta, rho], shape (6, 6), rad and m."""
    D_bias: Floats
    """D, derivative of [theta, rho] by the gyro bias, shape (6, 3), per rad/s."""
    bias: Floats
    """Gyro bias that was removed, shape (3,), rad/s."""
    duration_s: float
    mean_specific_force: Floats
    """Mean over time of the specific force, turned into frame i, shape (3,), m/s²; NaN where not measured."""

    def then(self, next_motion: PreintegratedMotion) -> PreintegratedMotion:
        """The motion followed by the next one, for the same gyro bias.

        ``i_T_k = i_T_j j_T_k``; a perturbation of the first reaches frame k through ``Ad(j_T_k^-1)``.
        """
        # over no time nothing moves, and there is no mean force
        if self.duration_s == 0.0:
            return next_motion
        if next_motion.duration_s == 0.0:
            return self
        # the perturbation of the first motion, moved to the last frame
        A = next_motion.i_T_j.inverse().AdjointMap()
        i_R_j = self.i_T_j.rotation().matrix()
        duration_s = self.duration_s + next_motion.duration_s
        # means over time add up by their durations, in one frame
        impulse = self.mean_specific_force * self.duration_s
        impulse += i_R_j @ next_motion.mean_specific_force * next_motion.duration_s
        return PreintegratedMotion(
            self.i_T_j.compose(next_motion.i_T_j),
            A @ self.covariance @ A.T + next_motion.covariance,
            A @ self.D_bias + next_motion.D_bias,
            self.bias,
            duration_s,
            impulse / duration_s,
        )

    def corrected(self, bias: Floats) -> gtsam.Pose3:
        """i_T_j for another gyro bias, to first order: ``i_T_j Exp(D_bias (bias - self.bias))``."""
        return self.i_T_j.compose(gtsam.Pose3.Expmap(self.D_bias @ (bias - self.bias)))


EARTH_RATE_RAD_S = 7.292115e-5
"""WGS 84."""


def earth_rate_in_world(calibration: Calibration) -> Floats | None:
    """Earth's angular rate in a world with x east, y north, z up, shape (3,), rad/s; None without a latitude."""
    latitude = calibration.earth_rate_latitude_rad
    if latitude is None:
        return None
    return EARTH_RATE_RAD_S * np.array([0.0, np.cos(latitude), np.sin(latitude)])


def require_source(odometry: object, calibration: Calibration, call: str) -> None:
    """Refuse what is no calibration, no source of motion (TypeError), or made with another (CalibrationError)."""
    require_calibration(calibration, call)
    if isinstance(odometry, type) or not hasattr(odometry, "motions"):
        given = (
            odometry.__name__ if isinstance(odometry, type) else type(odometry).__name__
        )
        raise TypeError(
            f"{call}: expected a source of motion, such as Odometry(calibration), not {given}"
        )
    if getattr(odometry, "calibration", calibration) != calibration:
        raise CalibrationError(
            f"{call}: the odometry was made with another calibration; make both with the same"
        )


class Motions(NamedTuple):
    """Motions over n intervals, as arrays; all NaN for an interval that has a gap of the Doppler log.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph import Odometry
    >>> from sonar_graph.testing import small_world
    >>> world = small_world()
    >>> odometry = Odometry(world.calibration)
    >>> is_out_of_date = odometry.add(world.imu, world.dvl)
    >>> epochs = odometry.epochs(world.start_ns, world.end_ns)
    >>> motions = odometry.motions(epochs[:3], epochs[1:4], np.full(3, world.end_ns), np.zeros(3))
    >>> motions.dR.shape, motions.dp.shape, motions.C.shape
    ((3, 3, 3), (3, 3), (3, 6, 6))
    """

    dR: Floats
    """i_R_j, shape (n, 3, 3)."""
    dp: Floats
    """i_p_j, shape (n, 3), m."""
    C: Floats
    """Covariance of [theta, rho] in frame j, shape (n, 6, 6)."""
    D: Floats
    """Derivative of [theta, rho] by the gyro bias, shape (n, 6, 3), per rad/s."""
    impulse: Floats
    """Integral of the specific force in frame i, shape (n, 3), m/s; NaN where not measured."""


class MotionSource(Protocol):
    """Contract of the source of motion that is handed to an estimator, such as `sonar_graph.navigation.Odometry`.

    What a motion uses depends on stamps alone, not on how a log is cut into blocks.

    Examples
    --------
    >>> from sonar_graph import Calibration, Odometry
    >>> from sonar_graph.motion import MotionSource
    >>> source: MotionSource = Odometry(Calibration())
    """

    @property
    def refused(self) -> list[RefusedRow]:
        """Rows that are not used, with the reason."""

    def add(self, imu: Imu | None, dvl: Dvl | None) -> bool:
        """Take in rows; True where some were placed before others: provisional motions are out of date."""

    def used_depths(self, depth: Depth | None) -> Depth | None:
        """Depth samples that a vehicle can have measured, None without any; the others are `refused`."""

    def start_by(self, until_ns: int) -> int | None:
        """First epoch, where the start pose holds, if it is reached at an instant; else None."""

    def epochs(self, after_ns: int, until_ns: int) -> Ints:
        """Epochs after one instant that are reached at another, in order, shape (n,)."""

    def epochs_reached(self, after_ns: int, until_ns: int) -> tuple[Ints, Ints]:
        """`epochs` and their `reached_ns`, shapes (n,)."""

    def reached_ns(self, epoch_ns: int) -> int:
        """Instant at which an epoch is reached: an IMU row covers it, and its velocity is known."""

    def is_gap(self, start_ns: int, end_ns: int) -> bool:
        """True for a time without Doppler rows that is too long for a linear velocity."""

    def motion(
        self,
        start_ns: int,
        end_ns: int,
        bias: Floats,
        world_R_i: Floats | None = None,
        known_ns: int | None = None,
    ) -> PreintegratedMotion:
        """Motion from one instant to another, over gaps too, without the gyro bias (body axes, shape (3,), rad/s).

        The attitude ``world_R_i`` at the start, shape (3, 3), serves to remove the Earth's rotation where the
        calibration has a latitude; None: it is not removed. Rows stamped after ``known_ns``, by default ``end_ns``, are not
        used: to an epoch it is final only if that is an instant at which the epoch is reached.
        """

    def motions(
        self,
        start_ns: Ints,
        end_ns: Ints,
        known_ns: Ints,
        bias: Floats,
        *,
        over_gaps: bool = False,
    ) -> Motions:
        """Motions over n intervals, each from rows stamped no later than its ``known_ns``, for one ``bias`` (3,).

        Intervals with a gap are NaN and left to `motion`. With ``over_gaps``, which needs a velocity on both sides of
        each gap, the velocity is linear there and the covariance counts its random walk. The Earth's rotation is not
        removed.
        """

    def velocity_at_imu(self, epoch_ns: int) -> tuple[Floats, float]:
        """Velocity of the IMU's point at an epoch, body axes, shape (3,), m/s, and the variance of one component."""

    def settle(self, epoch_ns: int) -> None:
        """Declare the motion up to an epoch as used: rows stamped at or before it are late from now on."""

    def forget_before(self, epoch_ns: int) -> None:
        """Settle, and drop rows that no motion from this epoch on can need."""
