"""EKF-SLAM as published, in its textbook form: the estimator around `baselines.ekf_equations`.

docs/theory/ekf_slam.md.
"""

import math
from typing import ClassVar

import gtsam
import numpy as np

from baselines import ekf_equations
from baselines.ekf_equations import (
    COMPASS,
    LANDMARK,
    MAP,
    MOST_PITCH_RAD,
    POSE,
    correct_depth,
    correct_up,
    observe,
    predict,
    upright,
)
from baselines.event_order import (
    DEPTH,
    EPOCH,
    FRAME,
    GRAVITY,
    NO_BIAS,
    Events,
    Motion,
    add_force,
    remove_rate,
    up_at_end,
)
from baselines.filter import FilterParams, FilterShell
from baselines.sonar_update import Gate
from sonar_graph.calibration import Calibration, PlanarMotion, Section
from sonar_graph.measurements import Floats
from sonar_graph.models import ACCEPTED
from sonar_graph.motion import MotionSource
from sonar_graph.numerics import compiled, rotation_from_euler, vec


@compiled
def advance(
    x: Floats, P: Floats, i_R_j: Floats, impulse: Floats, earth: Floats, port: Floats, depth_variance: float,
    body_R_sonar: Floats, body_p_sonar: Floats, gate: Gate, events: Events, k: int,
) -> int:  # fmt: skip
    """Use events from k on, up to a gap, a landmark that is new or may be far, or an event of another kind."""
    dR, dp, C, D, force = events.dR, events.dp, events.C, events.D, events.impulse
    while not math.isnan(dp[k, 0]):
        kind, row = events.kind[k], events.row[k]
        if events.has_rate[k]:
            earth_i = rotation_from_euler(vec(x[3:])).T @ vec(earth)
            remove_rate(dR[k], dp[k], D[k], force[k], NO_BIAS, earth_i)
            events.has_rate[k] = False
        if kind == EPOCH:
            predict(x, P, dR[k], dp[k], C[k])
            add_force(i_R_j, impulse, dR[k], force[k])
        elif kind == GRAVITY:
            up = up_at_end(i_R_j, impulse, events.gravity[row])
            if not math.isnan(up[0]):
                correct_up(x, P, up, events.gravity[row, 7])
        elif kind == DEPTH:
            variance_m2 = depth_variance if math.isnan(events.variance_m2[row]) else events.variance_m2[row]
            correct_depth(x, P, dR[k], dp[k], C[k], port, events.z_m[row], variance_m2)
        elif kind == FRAME:
            while row < len(events.seen_ns) and events.seen_ns[row] == events.stamp_ns[k]:
                if events.outcome[row] == ACCEPTED:
                    if events.landmark[row] < 0:
                        return k
                    events.outcome[row] = observe(
                        x, P, MAP + LANDMARK * events.landmark[row], dR[k], dp[k], C[k], body_R_sonar, body_p_sonar,
                        events.z[row], events.R_z[row], gate, events.e[row], events.S[row],
                    )  # fmt: skip
                row += 1
        else:
            break
        k += 1
        if abs(x[4]) >= MOST_PITCH_RAD:
            break
    return k


class EkfSlamParams(FilterParams):
    """Settings of EKF-SLAM; the paper gives none of them."""


class EkfSlam(FilterShell):
    """Extended Kalman filter over pose and landmarks.

    State (4) and covariance (5), prediction by gyros and Doppler log, observation (6) and innovation (7) of range and
    azimuth, and augmentation at first sight, after "Experimental Results of Real-time Sonar-based Underwater
    Localization Using Landmarks". Choices that the paper leaves open are in docs/theory/ekf_slam.md; those to know:

    - There is no gyro bias in the state (4), and its drift is not in the covariance: with a biased gyro the filter is
      overconfident in its heading, and a gate, which is not there by default, refuses true detections in time.
    - A gap of the Doppler log is bridged as by every estimator; there Q holds the gyro bias, which tilts gravity.
      Measurements in a gap are related to the state before it, with growing variance.
    - A new landmark's elevation comes from a floor of known height, else it is 0 with sigma aperture / sqrt(12).
    - Depth, the direction of gravity and planar motion, where the calibration has them, are ungated updates.
    - Jacobians are taken once (no iteration); detections of a frame are used one after the other.

    Parameters
    ----------
    calibration
        Noise, mountings, start, floor.
    odometry
        Source of motion; the filter takes its rows in.
    params
        None: the defaults.
    """

    Params: ClassVar[type[Section]] = EkfSlamParams
    name = "ekf-slam"

    def __init__(self, calibration: Calibration, odometry: MotionSource, params: EkfSlamParams | None = None) -> None:
        super().__init__(calibration, odometry, params or EkfSlamParams())
        start = calibration.start
        angles = upright(vec(start.pose().rotation().rpy()))
        self._x, self._P = np.array([*start.position_m, *angles, 0.0]), np.zeros((MAP, MAP))
        E = np.linalg.inv(np.array(ekf_equations.after(self._x, np.eye(3), np.zeros(3))[2].b))  # W^-1
        self._P[:3, :3] = np.diag(np.square(start.position_sigma_m))
        self._P[3:6, 3:6] = E @ np.diag(np.square(start.rpy_sigma_rad)) @ E.T
        self._overturned: list[str] = []
        self._P[COMPASS, COMPASS] = calibration.heading.bias_sigma_rad**2

    def state(self) -> tuple[int, Floats, Floats]:
        """Stamp (ns), x of equation (4) and P of (5) at the newest epoch; copies."""
        return self.node_ns, self._x.copy(), self._P.copy()

    def advance(self, events: Events, k: int) -> int:
        """Predict over epochs and correct by depth, from event k on, and take note of a pitch of 90 degrees or more."""
        state = self._x, self._P, self.turned, self.impulse
        k = advance(*state, self.earth, self.port, self.depth_variance, *self.sonar[:3], events, k)
        if abs(self._x[4]) >= MOST_PITCH_RAD:
            self._overturned = self._overturned or [
                f"pitch came to {math.degrees(self._x[4]):.0f} deg, first at {int(events.start_ns[k])} ns, where the"
                " Euler angles of its state are singular, or beyond: the filter has lost its way, by wrong gyros,"
                " velocities or detections; or it needs another estimator, such as isam2"
            ]
        return k  # the next prediction reads the angles from the rotation, within a right angle again

    def withheld(self) -> list[str]:
        """Messages about detections of the gate, and about a pitch of 90 degrees or more."""
        return [*super().withheld(), *self._overturned]

    def correct_plane(self, plane: PlanarMotion) -> None:
        """Update Z, roll and pitch."""
        tilt = (0.0, plane.tilt_sigma_rad)
        for k, (value, sigma) in enumerate([(plane.z_m, plane.z_sigma_m), tilt, tilt], start=2):
            ekf_equations.correct_number(self._x, self._P, k, value, sigma**2)

    def correct_heading(self, motion: Motion, yaw_rad: float, variance_rad2: float) -> None:
        """Update by the yaw of the body and the compass' bias."""
        ekf_equations.correct_heading(self._x, self._P, motion, yaw_rad, variance_rad2)

    def correct_position(self, motion: Motion, point: Floats, position_m: Floats, cov_m2: Floats) -> None:
        """Update by the position of a point of the body."""
        ekf_equations.correct_position(self._x, self._P, motion, point, position_m, cov_m2)

    def observe(
        self, motion: Motion, slot: int, z: Floats, R_z: Floats, *, may_be_far: bool
    ) -> tuple[int, Floats, Floats]:
        """Update by range and azimuth of a known landmark, (6) and (7)."""
        at, sonar = MAP + LANDMARK * slot, self.sonar
        if may_be_far and (told := ekf_equations.observe_far(self._x, self._P, at, motion, sonar, z, R_z)) is not None:
            return told
        dR, dp, C, _, _ = motion
        e, S, place = np.empty(2), np.empty((2, 2)), (sonar.body_R_sonar, sonar.body_p_sonar)
        return observe(self._x, self._P, at, dR, dp, C, *place, z, R_z, sonar.gate, e, S), e, S

    def augment(self, motion: Motion, z: Floats, R_z: Floats) -> None:
        """Append a landmark to (4) and (5)."""
        self._x, self._P = ekf_equations.augment(self._x, self._P, motion, self.sonar, z, R_z)

    def pose_after(self, motion: Motion) -> tuple[Floats, Floats, Floats]:
        """world_R_body (3, 3), position (3,), and covariance of [theta, rho] (6, 6) a motion after the state."""
        R, X, T = ekf_equations.pose_after(self._x, motion.dR, motion.dp)
        cov = T @ self._P[:POSE, :POSE] @ T.T + motion.C
        return R, X, 0.5 * (cov + cov.T)

    def landmark(self, slot: int) -> tuple[Floats, Floats]:
        """Position, and its block of (5)."""
        block = slice(MAP + LANDMARK * slot, MAP + LANDMARK * (slot + 1))
        return self._x[block], self._P[block, block]

    def attitude(self) -> Floats:
        """world_R_body of the state, shape (3, 3)."""
        return np.ascontiguousarray(gtsam.Rot3.RzRyRx(self._x[3:6]).matrix())
