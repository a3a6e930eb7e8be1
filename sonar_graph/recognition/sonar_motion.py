"""How the sonar moved between its frames, how it is tilted, and how high it hangs over the floor.

Everything comes from what a vehicle has without landmarks: gyros and Doppler log (preintegrated), accelerometers (the
direction of gravity), pressure and a known floor (height). Nothing stamped after a frame is used for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from sonar_graph.measurements import Depth, Floats
from sonar_graph.navigation import Odometry, motion_between, motion_between_nodes
from sonar_graph.navigation.alignment import gravity_direction, velocity_at_imu
from sonar_graph.navigation.preintegration import PreintegratedMotion, Preintegrator
from sonar_graph.sequence import NS_PER_S, Sequence
from sonar_graph.sonar import FloorView, SonarStep

GRAVITY_INTERVAL_NS = NS_PER_S
"""Shortest time over which accelerometers are averaged: the noise of velocity at its ends fades with its square."""
_NO_BIAS = np.zeros(3)


@dataclass(frozen=True, eq=False)
class SonarMotion:
    """What is known about the sonar when a frame is taken."""

    previous_T_sonar: gtsam.Pose3 | None
    """From the frame before; None for the first."""
    covariance: Floats
    """Of its perturbation [rotation, translation], shape (6, 6)."""
    level_R_sonar: Floats
    """From sonar axes to level ones: z up, x horizontally along the centre beam, shape (3, 3)."""
    tilt_sigma_rad: float
    """Standard deviation of a small tilt of it."""
    height_m: float | None
    """Of the sonar over the floor; None where it is not known."""
    height_sigma_m: float

    def step(self) -> SonarStep | None:
        """Motion since the frame before, for the tracker; None for the first frame."""
        return None if self.previous_T_sonar is None else SonarStep(self.previous_T_sonar, self.covariance)

    def floor_view(self) -> FloorView | None:
        """The floor; None where the height over it is not known or not positive."""
        if self.height_m is None or self.height_m <= 0:
            return None
        return FloorView(self.level_R_sonar, self.height_m, self.height_sigma_m, self.tilt_sigma_rad)


class _Tilt:
    """The direction of up in the body, a Kalman filter of one variance.

    Gyros carry it, gravity corrects it once a second or so.
    """

    def __init__(self, sequence: Sequence, odometry: Odometry, preintegrator: Preintegrator) -> None:
        calibration = sequence.calibration
        self._calibration, self._odometry, self._preintegrator = calibration, odometry, preintegrator
        self.node_ns = sequence.start_ns
        self.up: Floats = calibration.start.pose().rotation().matrix()[2]
        self.variance = float(np.max(np.square(calibration.start.rpy_sigma_rad[:2])))

    def reach(self, instant_ns: int) -> None:
        """Take in what gravity says until an instant."""
        for node_ns in self._odometry.nodes(self.node_ns + GRAVITY_INTERVAL_NS - 1, instant_ns).tolist():
            if node_ns - self.node_ns >= GRAVITY_INTERVAL_NS:
                self._advance(node_ns)

    def _advance(self, node_ns: int) -> None:
        motion = motion_between_nodes(self._odometry, self._preintegrator, self.node_ns, node_ns, _NO_BIAS, None)
        measured = self._gravity(motion, node_ns)
        self.up, self.variance = self.after(motion)
        if measured is not None:
            direction, sigma = measured
            gain = self.variance / (self.variance + sigma**2)
            self.up = _unit(self.up + gain * (direction - self.up))
            self.variance *= 1 - gain
        self.node_ns = node_ns

    def after(self, motion: PreintegratedMotion) -> tuple[Floats, float]:
        """Up in the body, and its variance, after a motion from the last correction."""
        drift = self._calibration.imu.gyro_bias_sigma * motion.duration_s
        noise = float(np.max(np.diag(motion.covariance)[:3]))
        return motion.i_T_j.rotation().matrix().T @ self.up, self.variance + noise + drift**2

    def _gravity(self, motion: PreintegratedMotion, node_ns: int) -> tuple[Floats, float] | None:
        if not self._calibration.use_gravity:
            return None
        ends = [self._odometry.velocity_at_node(at_ns) for at_ns in (self.node_ns, node_ns)]
        imu, dvl = (np.array(m.translation_m) for m in (self._calibration.imu.mounting, self._calibration.dvl.mounting))
        before, after = (velocity_at_imu(velocity, rate, dvl, imu) for velocity, _, rate in ends)
        sigma = float(np.sqrt(np.mean([np.trace(cov) / 3 for _, cov, _ in ends])))
        return gravity_direction(motion, before, after, sigma, self._calibration.imu, self._calibration.gravity_m_s2)


class _Height:
    """Height of the body's origin in the world: depth samples, carried by the Doppler log's vertical part."""

    def __init__(self, depth: Depth | None, sequence: Sequence) -> None:
        self._depth = depth
        self._port = np.array(sequence.calibration.depth.port_m)
        self._default = sequence.calibration.depth.sigma_m**2
        start = sequence.calibration.start
        self.z_m, self.variance = start.position_m[2], start.position_sigma_m[2] ** 2
        self._stamp_ns = sequence.start_ns

    def carry(self, climbed_m: float, variance_m2: float) -> None:
        """After a motion."""
        self.z_m += climbed_m
        self.variance += variance_m2

    def correct(self, up: Floats, until_ns: int) -> None:
        """With the depth samples since the last call; the body has hardly moved since the older ones."""
        rows = None if self._depth is None else self._depth.between(self._stamp_ns, until_ns)
        self._stamp_ns = until_ns
        if rows is None:
            return
        variances = np.where(np.isnan(rows.variance_m2), self._default, rows.variance_m2)
        z_m = float(rows.z_m[-1] - up @ self._port)
        gain = self.variance / (self.variance + float(variances[-1]))
        self.z_m += gain * (z_m - self.z_m)
        self.variance *= 1 - gain


class SonarMotions:
    """Motion from frame to frame of one sequence.

    Parameters
    ----------
    sequence
        With IMU and Doppler log; with depth and a floor where the height shall be known.
    """

    def __init__(self, sequence: Sequence) -> None:
        calibration = sequence.calibration
        self._odometry = Odometry(calibration)
        self._odometry.add(sequence.imu, sequence.dvl)
        self._preintegrator = Preintegrator.from_calibration(calibration)
        self._tilt = _Tilt(sequence, self._odometry, self._preintegrator)
        self._height = _Height(sequence.depth, sequence)
        self._floor = calibration.floor if sequence.depth is not None else None
        self._body_T_sonar = calibration.sonar.mounting.pose()
        self._start_ns, self._end_ns = sequence.start_ns, sequence.end_ns
        self._stamp_ns = sequence.start_ns
        self._is_first = True

    def covers(self, stamp_ns: int) -> bool:
        """Whether IMU and Doppler log are there at an instant, and it is not before the last one asked for."""
        return self._start_ns <= stamp_ns <= self._end_ns and not self.passed(stamp_ns)

    def passed(self, stamp_ns: int) -> bool:
        """Whether an instant is before the last one asked for."""
        return not self._is_first and stamp_ns < self._stamp_ns

    def at(self, stamp_ns: int) -> SonarMotion:
        """At a frame, not before that of the call before."""
        motion = self._between(self._stamp_ns, stamp_ns)
        self._tilt.reach(stamp_ns)
        up, tilt_variance = self._tilt.after(self._between(self._tilt.node_ns, stamp_ns))
        self._move_height(motion, up, stamp_ns)
        self._stamp_ns = stamp_ns
        sonar_T_body = self._body_T_sonar.inverse()
        adjoint = sonar_T_body.AdjointMap()
        relative = None if self._is_first else sonar_T_body.compose(motion.i_T_j).compose(self._body_T_sonar)
        self._is_first = False
        up_in_sonar = self._body_T_sonar.rotation().matrix().T @ up
        height = self._sonar_height(up)
        return SonarMotion(
            relative,
            adjoint @ motion.covariance @ adjoint.T,
            level_from_up(up_in_sonar),
            float(np.sqrt(tilt_variance)),
            height,
            float(np.hypot(np.sqrt(self._height.variance), self._floor.sigma_m if self._floor else 0.0)),
        )

    def _between(self, start_ns: int, end_ns: int) -> PreintegratedMotion:
        return motion_between(self._odometry, self._preintegrator, start_ns, end_ns, _NO_BIAS)

    def _move_height(self, motion: PreintegratedMotion, up: Floats, stamp_ns: int) -> None:
        """Over the motion since the last frame; its displacement is in the axes of that frame."""
        body_R_previous = motion.i_T_j.rotation().matrix().T
        climbed = up @ body_R_previous @ motion.i_T_j.translation()
        self._height.carry(float(climbed), float(np.trace(motion.covariance[3:, 3:])) / 3)
        self._height.correct(up, stamp_ns)

    def _sonar_height(self, up: Floats) -> float | None:
        if self._floor is None:
            return None
        return float(self._height.z_m + up @ self._body_T_sonar.translation() - self._floor.z_m)


def level_from_up(up: Floats) -> Floats:
    """Rotation to level axes from the direction of up, shape (3, 3); x lies in the vertical plane of the first axis."""
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    y = np.array([0.0, up[2], -up[1]])
    return np.array([_unit(x), _unit(y), up])


def _unit(v: Floats) -> Floats:
    return np.asarray(v / np.linalg.norm(v))
