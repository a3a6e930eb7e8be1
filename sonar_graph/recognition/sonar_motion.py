"""Motion of the sonar between frames, its tilt, and its height over the floor, without landmarks.

Motion: preintegrated gyros and Doppler log. Tilt: gyros, corrected by the direction of gravity once a second. Height:
depth and the calibration's floor. Nothing stamped after a frame is used for it.
"""

import numpy as np

from sonar_graph.measurements import NS_PER_S, Depth, Dvl, Floats, Imu
from sonar_graph.models import gravity_direction
from sonar_graph.navigation import MotionSource, Odometry, PreintegratedMotion
from sonar_graph.sequence import Sequence
from sonar_graph.sonar import FloorView, SonarStep

GRAVITY_INTERVAL_NS = NS_PER_S
"""Shortest time over which accelerometers are averaged; the noise of velocity at its ends falls with its square."""
KEPT_NS = 60 * NS_PER_S
"""Rows of a live run that are kept before the last frame, for a sensor that is late."""
KNOWN_HEIGHT_M = 0.1
"""Sigma of a start's height up to which it gives the place of the floor, before the first depth sample."""
OUT_OF_ORDER = "out of order"
NO_ODOMETRY = "no IMU and Doppler log at its stamp"
_NO_BIAS = np.zeros(3)


class _Tilt:
    """Direction of up in the body: a Kalman filter with one variance, predicted by gyros, corrected by gravity."""

    def __init__(self, sequence: Sequence, odometry: MotionSource) -> None:
        calibration = sequence.calibration
        self._calibration = calibration
        self._odometry = odometry
        self.epoch_ns = sequence.start_ns
        self.up: Floats = calibration.start.pose().rotation().matrix()[2]
        self.variance = float(np.max(np.square(calibration.start.rpy_sigma_rad[:2])))

    def reach(self, instant_ns: int) -> None:
        """Predict and correct until an instant."""
        for epoch_ns in self._odometry.epochs(
            self.epoch_ns + GRAVITY_INTERVAL_NS - 1, instant_ns
        ).tolist():
            # too short: the noise of velocity at both ends would hide gravity
            if epoch_ns - self.epoch_ns < GRAVITY_INTERVAL_NS:
                continue
            motion = self._odometry.motion(
                self.epoch_ns, epoch_ns, _NO_BIAS, known_ns=instant_ns
            )
            # a start between epochs has no velocity
            began_at_epoch = self.epoch_ns in self._odometry.epochs(
                self.epoch_ns - 1, instant_ns
            )
            measured = None
            if self._calibration.use_gravity and began_at_epoch:
                (before, variance), (after, other) = map(
                    self._odometry.velocity_at_imu, (self.epoch_ns, epoch_ns)
                )
                sigma = float(np.sqrt(0.5 * (variance + other)))
                # direction of up at the epoch, and its standard deviation
                measured = gravity_direction(
                    motion, before, after, sigma, self._calibration
                )
            # predict by the gyros first, then correct by gravity
            self.up, self.variance = self.after(motion)
            if measured is not None:
                direction, sigma = measured
                # one variance for both directions: tilts of vehicles are small
                gain = self.variance / (self.variance + sigma**2)
                self.up = _unit(self.up + gain * (direction - self.up))
                self.variance *= 1 - gain
            self.epoch_ns = epoch_ns

    def after(self, motion: PreintegratedMotion) -> tuple[Floats, float]:
        """Up in the body and its variance after a motion since the last correction."""
        # the bias is the same all the time: its error grows with time, not its root
        drift = self._calibration.imu.gyro_bias_sigma * motion.duration_s
        noise = float(np.max(np.diag(motion.covariance)[:3]))
        return (
            motion.i_T_j.rotation().matrix().T @ self.up,
            self.variance + noise + drift**2,
        )


class _Height:
    """Height of the body's origin: a Kalman filter, predicted by the vertical motion, corrected by depth."""

    def __init__(self, depth: Depth | None, sequence: Sequence) -> None:
        self._depth = depth
        self._port = np.array(sequence.calibration.depth.port_m)
        self._default = sequence.calibration.depth.sigma_m**2
        start = sequence.calibration.start
        self.z_m = start.position_m[2]
        self.variance = start.position_sigma_m[2] ** 2
        self.is_measured = (
            depth is not None and start.position_sigma_m[2] <= KNOWN_HEIGHT_M
        )
        """True from the first depth sample that corrected it, or with depth and a start whose height is known."""
        self._stamp_ns = sequence.start_ns

    def carry(self, climbed_m: float, variance_m2: float) -> None:
        """Predict over a motion."""
        self.z_m += climbed_m
        self.variance += variance_m2

    def add(self, depth: Depth) -> None:
        """Take in samples that have come since; those before the last frame are forgotten."""
        kept = (
            None
            if self._depth is None
            else self._depth.between(self._stamp_ns, int(self._depth.stamps_ns[-1]))
        )
        parts = [part for part in (kept, depth) if part is not None]
        self._depth = Depth.concatenate(parts)

    def correct(self, up: Floats, until_ns: int) -> None:
        """Correct by the latest of the depth samples since the last call."""
        rows = (
            None
            if self._depth is None
            else self._depth.between(self._stamp_ns, until_ns)
        )
        self._stamp_ns = until_ns
        if rows is None:
            return
        self.is_measured = True
        variances = np.where(
            np.isnan(rows.variance_m2), self._default, rows.variance_m2
        )
        # height of the body's origin: the port is up . lever above it
        z_m = float(rows.z_m[-1] - up @ self._port)
        gain = self.variance / (self.variance + float(variances[-1]))
        self.z_m += gain * (z_m - self.z_m)
        self.variance *= 1 - gain


class SonarMotions:
    """Motion from frame to frame of a sequence; the height needs depth and a floor."""

    def __init__(self, sequence: Sequence) -> None:
        calibration = sequence.calibration
        self._odometry = Odometry(calibration)
        self._odometry.add(sequence.imu, sequence.dvl)
        self._tilt = _Tilt(sequence, self._odometry)
        self._height = _Height(sequence.depth, sequence)
        self._floor = calibration.floor
        self._body_T_sonar = calibration.sonar.mounting.pose()
        self._start_ns = sequence.start_ns
        self._end_ns = sequence.end_ns
        self._stamp_ns = sequence.start_ns
        self._is_first = True

    def extend(self, imu: Imu | None, dvl: Dvl | None, depth: Depth | None) -> None:
        """Take in rows that have come since; a frame up to the newest IMU row is then covered."""
        self._odometry.add(imu, dvl)
        if imu is not None:
            self._end_ns = max(self._end_ns, int(imu.stamps_ns[-1]))
        if depth is not None:
            self._height.add(depth)
        # neither motion nor tilt needs rows before both
        settled_ns = min(self._stamp_ns, self._tilt.epoch_ns)
        if settled_ns > self._start_ns + KEPT_NS:
            self._odometry.forget_before(settled_ns - KEPT_NS)

    def refusal(self, stamp_ns: int) -> str:
        """Reason not to use a frame, which is from before the last one or where no sensor is; empty without."""
        if not self._is_first and stamp_ns < self._stamp_ns:
            return OUT_OF_ORDER
        is_covered = self._start_ns <= stamp_ns <= self._end_ns
        return "" if is_covered else NO_ODOMETRY

    def at(self, stamp_ns: int) -> tuple[SonarStep | None, FloorView | None]:
        """Motion since the frame before and view of the floor, at a frame not before that of the last call.

        The motion of the first frame is None, and so is the view where the height is not known or not positive.
        """
        # provisional between epochs; nothing after the frame is used
        motion = self._odometry.motion(self._stamp_ns, stamp_ns, _NO_BIAS)
        step = None
        view = None
        self._tilt.reach(stamp_ns)
        up, tilt_variance = self._tilt.after(
            self._odometry.motion(self._tilt.epoch_ns, stamp_ns, _NO_BIAS)
        )
        # vertical part of the motion: up at the frame before, in its axes
        body_R_previous = motion.i_T_j.rotation().matrix().T
        climbed = up @ body_R_previous @ motion.i_T_j.translation()
        self._height.carry(
            float(climbed), float(np.trace(motion.covariance[3:, 3:])) / 3
        )
        self._height.correct(up, stamp_ns)
        if not self._is_first:
            # the motion of the body as the sonar makes it, by its lever arm
            sonar_T_body = self._body_T_sonar.inverse()
            adjoint = sonar_T_body.AdjointMap()
            previous_T_sonar = sonar_T_body.compose(motion.i_T_j).compose(
                self._body_T_sonar
            )
            step = SonarStep(previous_T_sonar, adjoint @ motion.covariance @ adjoint.T)
        self._stamp_ns = stamp_ns
        self._is_first = False
        if self._floor is not None and self._height.is_measured:
            height_m = float(
                self._height.z_m
                + up @ self._body_T_sonar.translation()
                - self._floor.z_m
            )
            # a floor above the sonar is a wrong calibration: without a view the plane of the image holds
            if height_m > 0:
                level_R_sonar = level_from_up(
                    self._body_T_sonar.rotation().matrix().T @ up
                )
                sigma_m = float(
                    np.hypot(np.sqrt(self._height.variance), self._floor.sigma_m)
                )
                view = FloorView(
                    level_R_sonar, height_m, sigma_m, float(np.sqrt(tilt_variance))
                )
        return step, view


def level_from_up(up: Floats) -> Floats:
    """Rotation to level axes, x in the vertical plane of the first axis, from the direction of up, shape (3, 3)."""
    # the first axis without its vertical part
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    y = np.array([0.0, up[2], -up[1]])
    return np.array([_unit(x), _unit(y), up])


def _unit(v: Floats) -> Floats:
    return v / np.linalg.norm(v)
