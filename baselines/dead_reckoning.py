"""Dead reckoning: gyros and Doppler log from a given start, level by gravity; docs/theory/dead_reckoning.md."""

import math
from typing import ClassVar

import gtsam
import numpy as np
from pydantic import Field

from sonar_graph.calibration import Calibration, Section, require_params
from sonar_graph.measurements import (
    Floats,
    LandmarkDetections,
    Measurements,
    require_measurements,
)
from sonar_graph.models import gravity_direction
from sonar_graph.motion import MotionSource, PreintegratedMotion, require_source
from sonar_graph.states import (
    CausalEstimates,
    DetectionJournal,
    DetectionLog,
    Estimate,
    LandmarkMap,
    Outcome,
    RefusedRow,
    Trajectory,
)


class DeadReckoningParams(Section):
    """Settings of dead reckoning."""

    gravity_interval_s: float = Field(1.0, gt=0)
    """Least time between updates of roll and pitch by gravity, where the calibration uses it."""


class DeadReckoning:
    """Composition of preintegrated motions, with the covariance of an unestimated gyro bias.

    From one DVL stamp to the next, with the motion i_T_j of covariance C and bias derivative D
    (`sonar_graph.motion`)::

        world_T_j = world_T_i i_T_j
        P <- F P F^T + Q,    F = [ Ad(j_T_i)  D ],    Q = diag(C, walk^2 T I)
                                 [ 0          I ]

    for the perturbation [theta, rho, bias]. The bias is *considered*: its mean stays zero, and its uncertainty widens
    the covariance and correlates successive errors. Roll and pitch are kept by the direction of gravity, with
    ``up = world_R_body^T e_z`` (`sonar_graph.navigation.alignment.gravity_direction`)::

        e = measured up - up,    H = [ [up]x  0  0 ],    K = P H^T (H P H^T + sigma^2 I)^-1, of the tilt alone
        P <- (I - K H) P (I - K H)^T + sigma^2 K K^T

    Depth, headings, position fixes and detections are not used; `withheld` names headings and fixes.

    Parameters
    ----------
    calibration
        Noise, mountings, start.
    odometry
        Source of motion, its own.
    params
        None: the defaults.
    """

    Params: ClassVar[type[Section]] = DeadReckoningParams

    def __init__(
        self,
        calibration: Calibration,
        odometry: MotionSource,
        params: DeadReckoningParams | None = None,
    ) -> None:
        require_source(
            odometry, calibration, "DeadReckoning(calibration, odometry, params)"
        )
        require_params(params, self.Params, "dead-reckoning")
        self._params = params or DeadReckoningParams()
        self._odometry = odometry
        self._calibration = calibration
        has_bias = calibration.imu.gyro_bias_sigma > 0
        self._walk_density = calibration.imu.gyro_bias_walk_density if has_bias else 0.0
        self._pose = calibration.start.pose()
        # of [theta, rho, bias], theta and rho in body axes
        self._P = np.zeros((9, 9))
        self._P[:6, :6] = calibration.start.covariance()
        self._P[6:, 6:] = np.eye(3) * calibration.imu.gyro_bias_sigma**2
        self._epoch_ns: int | None = None
        self._felt: PreintegratedMotion | None = None
        """Motion since gravity was used, from the epoch with this velocity of the IMU and its variance."""
        self._felt_from: tuple[Floats, float] | None = None
        self._unused: set[str] = set()
        """Aids of the log that are not used."""
        self._estimates = CausalEstimates()
        self._journal = DetectionJournal()

    def process(self, measurements: Measurements) -> Estimate | None:
        """Process measurements and return the causal estimate at ``measurements.end_ns``.

        None before the first DVL stamp that IMU rows cover from both sides.
        """
        require_measurements(measurements, "dead-reckoning")
        self._odometry.add(measurements.imu, measurements.dvl)
        # depths are not used here, but judged and listed as by every estimator
        self._odometry.used_depths(measurements.depth)
        if measurements.heading is not None:
            self._unused.add("headings")
        if measurements.positions is not None:
            self._unused.add("position fixes")
        if measurements.detections is not None:
            self._record(measurements.detections)
        end_ns = measurements.end_ns
        epoch_ns = (
            self._odometry.start_by(end_ns)
            if self._epoch_ns is None
            else self._epoch_ns
        )
        if epoch_ns is None or end_ns < epoch_ns:
            return None
        for reached_ns in self._odometry.epochs(epoch_ns, end_ns).tolist():
            motion = self._odometry.motion(
                epoch_ns, reached_ns, ZERO_BIAS, self._attitude(), known_ns=end_ns
            )
            self._felt_from = self._felt_from or self._odometry.velocity_at_imu(
                epoch_ns
            )
            self._pose, self._P = self._after(motion)
            # gravity needs the specific force over the whole interval, in one frame
            self._felt = motion if self._felt is None else self._felt.then(motion)
            epoch_ns = reached_ns
            if (
                self._felt.duration_s >= self._params.gravity_interval_s
                and self._calibration.use_gravity
            ):
                self._level(
                    self._felt,
                    self._felt_from,
                    self._odometry.velocity_at_imu(epoch_ns),
                )
                self._felt = self._felt_from = None
        self._odometry.forget_before(epoch_ns)
        self._epoch_ns = epoch_ns
        # the provisional motion to the end of the call leaves the state at the epoch
        provisional = self._odometry.motion(
            epoch_ns, end_ns, ZERO_BIAS, self._attitude()
        )
        pose, P = self._after(provisional)
        estimate = Estimate(end_ns, pose, P[:6, :6].copy())
        self._estimates.keep(estimate)
        return estimate

    def _record(self, detections: LandmarkDetections) -> None:
        """Record the outcome of each detection: ignored or unsound."""
        ids, _ = detections.most_probable()
        rows = zip(
            detections.stamps_ns.tolist(),
            ids.tolist(),
            detections.are_sound().tolist(),
            strict=True,
        )
        for stamp_ns, landmark_id, is_sound in rows:
            self._journal.record(
                stamp_ns, landmark_id, Outcome.IGNORED if is_sound else Outcome.UNSOUND
            )

    def trajectory(self) -> Trajectory:
        """The causal estimates; dead reckoning does not revise them."""
        return self._estimates.trajectory()

    def landmarks(self) -> LandmarkMap:
        """An empty map."""
        return LandmarkMap.empty()

    def detections(self) -> DetectionLog:
        """Every detection, ignored or unsound."""
        return self._journal.log()

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of IMU, Doppler log and depth that are not used, with the reason."""
        return self._odometry.refused

    def withheld(self) -> list[str]:
        """A line about headings and position fixes of the log, which other estimators use."""
        if not self._unused:
            return []
        return [f"{' and '.join(sorted(self._unused))} of the log are not used"]

    def _attitude(self) -> Floats:
        """world_R_body at the newest epoch."""
        return self._pose.rotation().matrix()

    def _level(
        self,
        felt: PreintegratedMotion,
        begin: tuple[Floats, float],
        end: tuple[Floats, float],
    ) -> None:
        """Correct by gravity's direction over an interval, with the IMU's velocities and variances at its ends."""
        sigma_m_s = math.sqrt(0.5 * (begin[1] + end[1]))
        found = gravity_direction(felt, begin[0], end[0], sigma_m_s, self._calibration)
        if found is None:
            return
        measured, sigma = found
        up = self._attitude()[2]
        H = np.zeros((3, 9))
        H[:, :3] = gtsam.SO3.Hat(up)
        S = H @ self._P @ H.T + sigma**2 * np.eye(3)
        K = np.linalg.solve(S, H @ self._P).T  # (9, 3)
        # of the tilt alone: through the bias gravity would reach heading and place, and turn the path
        K[:3] -= np.outer(up, up @ K[:3])
        K[:3] -= np.outer(up, up @ K[:3])  # again, for the rounding of the first
        K[3:] = 0.0
        # Joseph's form: K is not the optimal gain
        A = np.eye(9) - K @ H
        self._pose = self._pose.compose(gtsam.Pose3.Expmap((K @ (measured - up))[:6]))
        P = A @ self._P @ A.T + sigma**2 * K @ K.T
        self._P = 0.5 * (P + P.T)

    def _after(self, motion: PreintegratedMotion) -> tuple[gtsam.Pose3, Floats]:
        """Pose, and covariance of [theta, rho, bias], shape (9, 9), after a motion."""
        F = np.eye(9)
        Q = np.zeros((9, 9))
        F[:6, :6] = motion.i_T_j.inverse().AdjointMap()
        F[:6, 6:] = motion.D_bias
        Q[:6, :6] = motion.covariance
        Q[6:, 6:] = np.eye(3) * (self._walk_density**2 * motion.duration_s)
        P = F @ self._P @ F.T + Q
        return self._pose.compose(motion.i_T_j), 0.5 * (P + P.T)


ZERO_BIAS = np.zeros(3)
