"""Right-invariant EKF-SLAM with the biases of gyros and accelerometers in its state, the strongest filter here.

Equations: `baselines.invariant_equations`; docs/theory/invariant_ekf.md.
"""

from typing import ClassVar

import numpy as np
from pydantic import Field

from baselines import invariant_equations as equations
from baselines.event_order import DEPTH, EPOCH, GRAVITY, Events, Motion, add_force, up_at_end
from baselines.filter import FilterParams, FilterShell
from baselines.invariant_equations import BARE, BETA, BODY, EYE, THETA, UP, InvariantState
from baselines.sonar_update import GATED, admit, far_view, polar_covariance
from sonar_graph.calibration import Calibration, PlanarMotion, Section
from sonar_graph.measurements import Floats
from sonar_graph.models import BIASES, FLOOR_GATE, bias_sigmas, doubted, gyro_bias_of, wrap_angle
from sonar_graph.motion import MotionSource


class InvariantEkfParams(FilterParams):
    """Settings of the invariant filter: those of EKF-SLAM, with the smoother's kernel."""

    kernel_width: float = Field(1.5, ge=0)
    """As `FilterParams.kernel_width`; the smoother's default."""


class InvariantEkf(FilterShell):
    """Right-invariant extended Kalman filter over pose, biases and landmarks.

    Same measurements, gates, floor and gaps as `baselines.ekf_slam.EkfSlam`, with three differences:

    - The error is right-invariant, in the world's frame. The unobservable directions, position and heading of the
      world, are then the same at every estimate, and no linearisation gains information along them (Barrau and
      Bonnabel, 2015; Zhang, Wu, Song, Huang and Dissanayake, RA-L 2(2), 2017).
    - The biases of gyros and accelerometers are states that walk; a scale error of the Doppler log is a constant one.
      Every motion has its derivatives by them, also over gaps.
    - Attitude is a rotation matrix and has no singular pitch.

    It linearises once, and cannot revise an association. Derivation: docs/theory/invariant_ekf.md; what gravity tells:
    docs/theory/gravity.md.

    Parameters
    ----------
    calibration
        Noise, mountings, start, floor. ``imu.gyro_bias_sigma = 0`` means that there is no bias, and none that walks.
    odometry
        Source of motion; the filter takes its rows in.
    params
        None: the defaults.
    """

    Params: ClassVar[type[Section]] = InvariantEkfParams
    name = "invariant-ekf"

    def __init__(
        self, calibration: Calibration, odometry: MotionSource, params: InvariantEkfParams | None = None
    ) -> None:
        super().__init__(calibration, odometry, params or InvariantEkfParams())
        self._walk_density = bias_sigmas(calibration)[1]
        self._state = start_state(calibration)

    def state(self) -> tuple[int, InvariantState]:
        """Stamp (ns) and a copy of the state at the newest epoch."""
        s = self._state
        return self.node_ns, InvariantState(
            s.R.copy(), s.points.copy(), s.bias.copy(), s.P.copy(), s.body_p_dvl, s.is_levelled
        )

    def attitude(self) -> Floats:
        """world_R_body of the state, shape (3, 3)."""
        return self._state.R

    has_bias = True

    def gyro_bias(self) -> Floats:
        """Estimated gyro bias, shape (3,), rad/s."""
        return gyro_bias_of(self._state.bias, self._state.up())

    def predict(self, motion: Motion, duration_s: float) -> None:
        """Carry the state over the motion to the next epoch, (2) and (3)."""
        equations.predict(self._state, motion, self._walk_density**2 * duration_s)

    def advance(self, events: Events, k: int) -> int:
        """Predict over epochs and correct by depth, from event k on."""
        while events.kind[k] in (EPOCH, GRAVITY, DEPTH) and not np.isnan(events.dp[k, 0]):
            motion, row = self.motion_to(events, k), events.row[k]
            if events.kind[k] == GRAVITY:
                mean_R = 0.5 * (EYE + self.turned.T)
                up = up_at_end(self.turned, self.impulse, events.gravity[row])
                if not np.isnan(up[0]):
                    self.correct_up(up, events.gravity[row, 7], mean_R / self.calibration.gravity_m_s2)
            elif events.kind[k] == EPOCH:
                self.predict(motion, (events.end_ns[k] - events.start_ns[k]) * 1e-9)
                add_force(self.turned, self.impulse, motion.dR, motion.impulse)
            else:
                variance_m2 = events.variance_m2[row]
                self.correct_depth(
                    motion, events.z_m[row], self.depth_variance if np.isnan(variance_m2) else variance_m2
                )
            k += 1
        return k

    def correct_up(self, up: Floats, sigma: float, by_accel: Floats) -> None:
        """Update by the world's up in the body, shape (3,), with the sigma of its tilt, rad, (8)."""
        y, H = equations.up_innovation(self._state, up, by_accel)
        equations.correct(self._state, *equations.innovation_covariance(self._state, H, sigma**2 * np.eye(2)), y)

    def correct_height(self, k: int, z_m: float, variance_m2: float, gate: float = np.inf) -> None:
        """Update by the height of the body (k = 0) or a landmark within a gate, (7)."""
        height_m, H = equations.height_of_point(self._state, k)
        HP, S = equations.innovation_covariance(self._state, H, np.full((1, 1), variance_m2))
        if (z_m - height_m) ** 2 <= gate * S[0, 0]:
            equations.correct(self._state, HP, S, np.array([z_m - height_m]))

    def correct_plane(self, plane: PlanarMotion) -> None:
        """Update by the plane on which the vehicle stays: height and tilt."""
        self.correct_height(0, plane.z_m, plane.z_sigma_m**2)
        self.correct_up(UP, plane.tilt_sigma_rad, np.zeros((3, 3)))

    def correct_depth(self, motion: Motion, z_m: float, variance_m2: float) -> None:
        """Update by the height of the pressure port a motion after the state, (7)."""
        position_m, H, H_m = (part[2:] for part in equations.position_of_body_point(self._state, motion, self.port))
        HP, S = equations.innovation_covariance(self._state, H, H_m @ motion.C @ H_m.T + variance_m2)
        equations.correct(self._state, HP, S, z_m - position_m)

    def correct_heading(self, motion: Motion, yaw_rad: float, variance_rad2: float) -> None:
        """Update by the yaw of the body and the compass' bias a motion after the state, (10)."""
        predicted, H, H_m = equations.yaw_of_compass(self._state, motion)
        e = np.array([wrap_angle(yaw_rad - predicted)])
        self.correct_robustly(motion, H, H_m, e, np.array([[variance_rad2]]))

    def correct_position(self, motion: Motion, point: Floats, position_m: Floats, cov_m2: Floats) -> None:
        """Update by the position of a point of the body a motion after the state, (7)."""
        predicted, H, H_m = equations.position_of_body_point(self._state, motion, point)
        self.correct_robustly(motion, H, H_m, position_m - predicted, cov_m2)

    def correct_robustly(self, motion: Motion, H: Floats, H_m: Floats, e: Floats, R_z: Floats) -> None:
        """Update by measurements of which some are outliers, (9)."""
        HP, S = equations.innovation_covariance(self._state, H, H_m @ motion.C @ H_m.T + R_z)
        equations.correct(self._state, HP, doubted(e, S, R_z), e)

    def observe(
        self, motion: Motion, slot: int, z: Floats, R_z: Floats, *, may_be_far: bool
    ) -> tuple[int, Floats, Floats]:
        """Update by range and azimuth of a known landmark, (5), or the point seen where it may be far away, (6)."""
        state, k = self._state, 1 + slot
        if may_be_far:
            x, G, G_m, G_z = equations.location(state, motion, self.sonar, z, 0.0)
            # Exp(theta) turns both points: what is missed is xi_k - xi_new, without theta however far they are apart
            missed, H = x - state.points[k], -G
            H[:, equations.place_of(k)] += EYE
            HP, S = equations.innovation_covariance(state, H, G_m @ motion.C @ G_m.T)
            view = far_view(missed, S, G_z, self.sonar, z, R_z, slot)
            if view is not None:
                outcome, S, e, S_view = view
                if outcome != GATED:
                    equations.correct(state, HP, S, missed)
                return outcome, e, S_view
        predicted, H, H_m = equations.observation(state, k, motion, self.sonar)
        e = z - predicted
        e[1] = wrap_angle(e[1])
        HP, S = equations.innovation_covariance(state, H, H_m @ motion.C @ H_m.T + R_z)
        outcome, widened = admit(e, S, R_z, self.sonar.gate, slot)
        if outcome != GATED:
            equations.correct(state, HP, S + widened, e)
        return outcome, e, S

    def augment(self, motion: Motion, z: Floats, R_z: Floats) -> None:
        """Append a landmark seen for the first time, (6), on a floor of known height within the floor's gate."""
        elevation_rad = self.sonar.elevation_of_new(*equations.pose(self._state, motion), z)
        x, G, G_m, G_z = equations.location(self._state, motion, self.sonar, z, elevation_rad)
        view = polar_covariance(R_z, self.sonar.aperture_rad)
        self._state = equations.augmented(self._state, x, G, G_m @ motion.C @ G_m.T + G_z @ view @ G_z.T)
        self.correct_height(len(self._state.points) - 1, self.sonar.floor_z_m, self.sonar.floor_variance_m2, FLOOR_GATE)

    def pose_after(self, motion: Motion) -> tuple[Floats, Floats, Floats]:
        """world_R_body (3, 3), position (3,), and covariance of [theta, rho] (6, 6) a motion after the state."""
        return *equations.pose(self._state, motion), equations.pose_covariance(self._state, motion)

    def landmark(self, slot: int) -> tuple[Floats, Floats]:
        """Position, and covariance of its coordinates."""
        return self._state.points[1 + slot], equations.landmark_covariance(self._state, 1 + slot)


def start_state(calibration: Calibration) -> InvariantState:
    """State at the start, without landmarks.

    Errors of the start, ``R = R^ Exp(delta)`` and ``X = X^ + d``, are ``theta = R^ delta``, ``xi_0 = d + [X^]x theta``.
    """
    start = calibration.start
    R, X = start.pose().rotation().matrix(), np.array(start.position_m)
    A, P = np.zeros((BARE, 6)), np.zeros((BARE, BARE))
    A[THETA, :3], A[BODY, :3], A[BODY, 3:] = R, equations.hat(X) @ R, EYE
    P = A @ np.diag(np.square((*start.rpy_sigma_rad, *start.position_sigma_m))) @ A.T
    P[BETA, BETA] = np.diag(bias_sigmas(calibration)[0] ** 2)
    body_p_dvl = np.array(calibration.dvl.mounting.translation_m)
    return InvariantState(
        R, X[None].copy(), np.zeros(BIASES), equations.symmetric(P), body_p_dvl, calibration.use_gravity
    )
