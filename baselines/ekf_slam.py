"""EKF-SLAM as published: equations (4) to (7) of the paper, the augmentation by new landmarks, and the estimator.

::

    x = [X, Y, Z, phi, theta, psi, c, p_1, ..., p_N]         (4)  p_i: landmark in the world, 3 numbers
    P = [ P_vv  P_vm ; P_vm^T  P_mm ]                        (5)
    z_hat = h(x_v, p)                                        (6)  range and azimuth
    e = z - z_hat, azimuth wrapped                           (7)

A motion (dR, dp) leads to the pose ``R' = R dR, X' = X + R dp``, with ``R = Rz(psi) Ry(theta) Rx(phi)``. C is the
covariance of its perturbation [theta, rho] in its last frame. Every measurement depends on the perturbation delta of
the pose after the motion, in the body's own axes, to which state and motion contribute ::

    delta = T dx_v + [theta; rho],      T = [ 0           dR^T W           ]
                                            [ dR^T R^T   -dR^T [dp]x W     ]

The paper has no compass; c is its constant bias, and without headings nothing is learnt of it. W turns Euler rates into
body rates, ``E = W^-1``. Derivation, and the choices that the paper leaves open: docs/theory/ekf_slam.md.
"""

import math
from typing import ClassVar

import numpy as np

from baselines.events import Motion, Sonar, elevation_of_new
from baselines.filter import FilterParams, FilterShell
from baselines.kalman import (
    GATED,
    Judged,
    correction,
    distance,
    judged,
    judged_far,
    polar_covariance,
    stands_on_floor,
    symmetric,
)
from sonar_graph.calibration import Calibration, PlanarMotion, Section
from sonar_graph.measurements import Floats
from sonar_graph.models import (
    body_point_jacobian,
    huber_scale,
    locate_from_body,
    view_from_body,
    wrap_angle,
    yaw_and_derivative,
)
from sonar_graph.motion import MotionSource
from sonar_graph.numerics import compiled, cross_matrix

Z, ROLL, PITCH, YAW = 2, 3, 4, 5
POSE, COMPASS, MAP, LANDMARK = 6, 6, 7, 3
"""Length of x_v, place of c, that of p_1, and length of p_i."""
MOST_PITCH_RAD = 0.5 * math.pi - 1e-3
"""Nearer to 90 degrees Euler angles count as singular."""

# -------------------------------------------------------------------------------- Euler angles (phi, theta, psi)
# Fossen, "Handbook of Marine Craft Hydrodynamics and Motion Control", 2011, (2.18), (2.28)


@compiled
def rotation_from_euler(angles: Floats) -> Floats:
    """``world_R_body = Rz(psi) Ry(theta) Rx(phi)``, shape (3, 3)."""
    sr = math.sin(angles[0])
    cr = math.cos(angles[0])
    sp = math.sin(angles[1])
    cp = math.cos(angles[1])
    sy = math.sin(angles[2])
    cy = math.cos(angles[2])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


@compiled
def euler_from_rotation(R: Floats) -> Floats:
    """Angles of a rotation, shape (3,), with the pitch at least 1 mrad from 90 degrees: by 1 mrad another attitude."""
    pitch = math.atan2(-R[2, 0], math.hypot(R[2, 1], R[2, 2]))
    pitch = max(-MOST_PITCH_RAD, min(pitch, MOST_PITCH_RAD))
    return np.array([math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])])


@compiled
def body_rates_from_euler(angles: Floats) -> Floats:
    """W: body rates are ``w = W (phi', theta', psi')^T``, shape (3, 3)."""
    sr = math.sin(angles[0])
    cr = math.cos(angles[0])
    sp = math.sin(angles[1])
    cp = math.cos(angles[1])
    return np.array([[1.0, 0.0, -sp], [0.0, cr, sr * cp], [0.0, -sr, cr * cp]])


# -------------------------------------------------------------------------------- prediction


@compiled
def pose_after(x: Floats, motion: Motion) -> tuple[Floats, Floats, Floats]:
    """R' (3, 3), X' (3,) and T (6, 6) of the pose a motion after the state."""
    R = rotation_from_euler(x[ROLL:POSE])
    W = body_rates_from_euler(x[ROLL:POSE])
    R_after = R @ motion.dR
    T = np.zeros((6, POSE))
    T[:3, 3:] = motion.dR.T @ W
    T[3:, :3] = R_after.T
    T[3:, 3:] = -motion.dR.T @ cross_matrix(motion.dp) @ W
    return R_after, x[:3] + R @ motion.dp, T


@compiled
def predict(x: Floats, P: Floats, motion: Motion) -> None:
    """Carry state and covariance over a motion: ``P_vv <- F P_vv F^T + G C G^T``, ``P_vm <- F P_vm``."""
    R, X, T = pose_after(x, motion)
    x[:3] = X
    x[ROLL:POSE] = euler_from_rotation(R)
    E = np.linalg.inv(body_rates_from_euler(x[ROLL:POSE]))
    G = np.zeros((POSE, 6))  # of x_v by delta
    G[:3, 3:] = R
    G[3:, :3] = E
    F = G @ T
    P_vv = P[:POSE, :POSE].copy()
    P_vm = F @ P[:POSE, POSE:].copy()
    P[:POSE, :POSE] = symmetric(F @ P_vv @ F.T + G @ motion.C @ G.T)
    P[:POSE, POSE:] = P_vm
    P[POSE:, :POSE] = P_vm.T


# -------------------------------------------------------------------------------- update


@compiled
def update(x: Floats, P: Floats, H: Floats, e: Floats, R: Floats) -> None:
    """``x <- x + K e``, ``P <- P - K S K^T``, with ``S = H P H^T + R`` and ``K = P H^T S^-1``."""
    x += correction(P, H, e, R)
    x[ROLL] = wrap_angle(x[ROLL])
    x[YAW] = wrap_angle(x[YAW])


@compiled
def observe(
    x: Floats, P: Floats, at: int, motion: Motion, sonar: Sonar, z: Floats, R_z: Floats
) -> tuple[int, Floats, Floats]:
    """Update by range and azimuth of a known landmark at ``x[at : at + 3]``; outcome, e of (7) and S."""
    R, X, T = pose_after(x, motion)
    z_hat, H_b, H_p = view_from_body(R, X, sonar.mount, x[at : at + LANDMARK])  # (6)
    e = z - z_hat  # (7)
    e[1] = wrap_angle(e[1])
    H = np.zeros((2, len(x)))
    H[:, :POSE] = H_b @ T
    H[:, at : at + LANDMARK] = H_p
    noise = H_b @ motion.C @ H_b.T + R_z
    S = symmetric(H @ P @ H.T + noise)
    outcome, widened = judged(e, S, R_z, sonar.gate, sonar.kernel_width)
    if outcome != GATED:
        update(x, P, H, e, noise + widened)
    return outcome, e, S


@compiled
def update_depth(x: Floats, P: Floats, motion: Motion, port: Floats, z_m: float, variance_m2: float) -> None:
    """Update by the height of the pressure port, ``(X' + R' q)_z``."""
    R, X, T = pose_after(x, motion)
    H_b = body_point_jacobian(R, port)[2:]  # (1, 6)
    H = np.zeros((1, len(x)))
    H[:, :POSE] = H_b @ T
    e = z_m - (X + R @ port)[2:]
    update(x, P, H, e, H_b @ motion.C @ H_b.T + variance_m2)


class EkfSlamParams(FilterParams):
    """Settings of EKF-SLAM; the paper gives none of them."""


class EkfSlam(FilterShell):
    """Extended Kalman filter over pose and landmarks.

    State (4) and covariance (5), prediction by gyros and Doppler log, observation (6) and innovation (7) of range and
    azimuth, and augmentation at first sight, after "Experimental Results of Real-time Sonar-based Underwater
    Localization Using Landmarks". Jacobians are taken once. The gyro bias is not in the state: with a biased gyro the
    filter is overconfident in its heading.

    The paper has none of the following. Each is used only where the calibration or the log calls for it:

    - depth, direction of gravity (`Calibration.use_gravity`), plane (`planar`), floor of known height (`floor`);
    - headings and position fixes with Huber's kernel, and the constant bias of the compass in the state;
    - in a gap of the Doppler log, the gyro bias in Q, and ``k (k + 1)`` times the motion's covariance for the k-th
      measurement of a kind.

    Gate, kernel and `far_views` are settings, off by default. Table: docs/theory/ekf_slam.md.

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
        R = np.ascontiguousarray(start.pose().rotation().matrix())
        self._x = np.zeros(MAP)
        self._x[:3] = start.position_m
        self._x[ROLL:POSE] = euler_from_rotation(R)
        E = np.linalg.inv(body_rates_from_euler(self._x[ROLL:POSE]))
        self._P = np.zeros((MAP, MAP))
        self._P[:3, :3] = np.diag(np.square(start.position_sigma_m))
        self._P[ROLL:POSE, ROLL:POSE] = E @ np.diag(np.square(start.rpy_sigma_rad)) @ E.T
        self._P[COMPASS, COMPASS] = calibration.heading.bias_sigma_rad**2
        self._overturned: list[str] = []

    def state(self) -> tuple[int, Floats, Floats]:
        """Stamp (ns), x of equation (4) and P of (5) at the newest epoch; copies."""
        return self.node_ns, self._x.copy(), self._P.copy()

    def predict(self, motion: Motion, duration_s: float) -> None:  # noqa: ARG002  # nothing walks
        """Carry the state over the motion to the next epoch."""
        predict(self._x, self._P, motion)

    def observe(self, motion: Motion, slot: int, z: Floats, R_z: Floats) -> Judged:
        """Update by range and azimuth of a known landmark, (6) and (7)."""
        return Judged(*observe(self._x, self._P, MAP + LANDMARK * slot, motion, self.sonar, z, R_z))

    def observe_far(self, motion: Motion, slot: int, z: Floats, R_z: Floats) -> Judged | None:
        """Update by a landmark far from where it is predicted, ``0 = g(x_v, z) - p``; None if it is near."""
        x = self._x
        P = self._P
        sonar = self.sonar
        at = MAP + LANDMARK * slot
        R, X, T = pose_after(x, motion)
        g, G_b, G_z = locate_from_body(R, X, sonar.mount, z, 0.0)
        e = g - x[at : at + LANDMARK]
        H = np.zeros((LANDMARK, len(x)))
        H[:, :POSE] = -G_b @ T
        H[:, at : at + LANDMARK] = np.eye(3)
        told, R_g = judged_far(e, H @ P @ H.T, G_b @ motion.C @ G_b.T, G_z, sonar, z, R_z)
        if told is not None and told.outcome != GATED:
            update(x, P, H, e, R_g)
        return told

    def augment(self, motion: Motion, z: Floats, R_z: Floats) -> None:
        """Append a landmark ``p = g(x_v, z, elevation)`` to (4) and (5), on a floor of known height if it is near.

        ``P_pv = G_v P_v.``,  ``P_pp = G_v P_vv G_v^T + G_b C G_b^T + G_z diag(R_z, elevation_sigma^2) G_z^T``.
        """
        x = self._x
        P = self._P
        sonar = self.sonar
        R, X, T = pose_after(x, motion)
        p, G_b, G_z = locate_from_body(R, X, sonar.mount, z, elevation_of_new(R, X, sonar, z))
        G_v = G_b @ T
        P_pv = G_v @ P[:POSE]  # (3, n)
        P_pp = P_pv[:, :POSE] @ G_v.T + G_b @ motion.C @ G_b.T
        P_pp += G_z @ polar_covariance(R_z, sonar.aperture_rad) @ G_z.T
        self._x = np.concatenate((x, p))
        self._P = np.block([[P, P_pv.T], [P_pv, symmetric(P_pp)]])
        if stands_on_floor(p[2], P_pp[2, 2], sonar):
            self._update_numbers([len(x) + 2], np.array([sonar.floor_z_m - p[2]]), [sonar.floor_variance_m2])

    def update_depth(self, motion: Motion, z_m: float, variance_m2: float) -> None:
        """Update by the height of the pressure port."""
        update_depth(self._x, self._P, motion, self.port, z_m, variance_m2)

    def update_heading(self, motion: Motion, yaw_rad: float, variance_rad2: float) -> float:
        """Update by a compass, ``psi' + c``, with Huber's kernel."""
        x = self._x
        P = self._P
        R, _, T = pose_after(x, motion)
        yaw, by_turn = yaw_and_derivative(R)
        H_b = np.array([[*by_turn, 0.0, 0.0, 0.0]])
        H = np.zeros((1, len(x)))
        H[:, :POSE] = H_b @ T
        noise = H_b @ motion.C @ H_b.T
        e = np.array([wrap_angle(yaw_rad - yaw)])
        off = distance(e, H @ P @ H.T + noise + variance_rad2 + self.compass_variance_rad2)
        H[0, COMPASS] = 1.0
        e = wrap_angle(e - x[COMPASS])
        scale = huber_scale(e, H @ P @ H.T + noise + variance_rad2)
        update(x, P, H, e, noise + scale * variance_rad2)
        return off

    def update_position(self, motion: Motion, position_m: Floats, cov_m2: Floats) -> float:
        """Update by the position of the antenna, ``X' + R' q``, with Huber's kernel."""
        x = self._x
        P = self._P
        R, X, T = pose_after(x, motion)
        H_b = body_point_jacobian(R, self.antenna)  # (3, 6)
        H = np.zeros((3, len(x)))
        H[:, :POSE] = H_b @ T
        e = position_m - (X + R @ self.antenna)
        noise = H_b @ motion.C @ H_b.T
        S = symmetric(H @ P @ H.T + noise + cov_m2)
        update(x, P, H, e, noise + huber_scale(e, S) * cov_m2)
        return distance(e, S)

    def update_up(self, up: Floats, sigma_rad: float, i_R_j: Floats) -> None:  # noqa: ARG002  # (4) has no bias
        """Update roll and pitch by the direction of the world's up in the body."""
        level = math.hypot(up[1], up[2])
        roll_off = wrap_angle(math.atan2(up[1], up[2]) - self._x[ROLL])
        e = np.array([roll_off, math.atan2(-up[0], level) - self._x[PITCH]])
        self._update_numbers([ROLL, PITCH], e, [(sigma_rad / level) ** 2, sigma_rad**2])

    def update_plane(self, plane: PlanarMotion) -> None:
        """Update Z, roll and pitch by the plane on which the vehicle stays."""
        e = np.array([plane.z_m, 0.0, 0.0]) - self._x[[Z, ROLL, PITCH]]
        tilt_variance = plane.tilt_sigma_rad**2
        self._update_numbers([Z, ROLL, PITCH], e, [plane.z_sigma_m**2, tilt_variance, tilt_variance])

    def _update_numbers(self, places: list[int], e: Floats, variances: list[float]) -> None:
        """Update by direct measurements of numbers of the state."""
        update(self._x, self._P, np.eye(len(self._x))[places], e, np.diag(variances))

    def pose_after(self, motion: Motion) -> tuple[Floats, Floats, Floats]:
        """world_R_body (3, 3), position (3,), and covariance of [theta, rho] (6, 6) a motion after the state."""
        R, X, T = pose_after(self._x, motion)
        return R, X, symmetric(T @ self._P[:POSE, :POSE] @ T.T + motion.C)

    def landmark(self, slot: int) -> tuple[Floats, Floats]:
        """Position, and its block of (5)."""
        block = slice(MAP + LANDMARK * slot, MAP + LANDMARK * (slot + 1))
        return self._x[block], self._P[block, block]

    def attitude(self) -> Floats:
        """world_R_body of the state, shape (3, 3)."""
        return rotation_from_euler(self._x[ROLL:POSE])

    def check(self, epoch_ns: int) -> None:
        """Note a state whose Euler angles are singular; the next prediction reads them from the rotation."""
        if abs(self._x[PITCH]) >= MOST_PITCH_RAD and not self._overturned:
            self._overturned = [
                f"pitch came to {math.degrees(self._x[PITCH]):.0f} deg, first at {epoch_ns} ns, where the Euler angles"
                " of its state are singular, or beyond: the filter has lost its way, by wrong gyros, velocities or"
                " detections; or it needs another estimator, such as isam2"
            ]

    def withheld(self) -> list[str]:
        """Messages of both filters, and one about a pitch of 90 degrees or more."""
        return [*super().withheld(), *self._overturned]
