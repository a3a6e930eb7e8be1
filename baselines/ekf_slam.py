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
from typing import ClassVar, NamedTuple

import numpy as np

from baselines.events import (
    DEPTH,
    EPOCH,
    FRAME,
    NO_ROW,
    UNKNOWN,
    Events,
    FilterSetup,
    Motion,
    Sonar,
    Views,
    feel,
    in_frame,
    is_followed,
    motion_to,
    remove_rate,
    shows_new,
)
from baselines.filter import FilterParams, FilterShell
from baselines.kalman import correction, correction_by_view, view_noise
from sonar_graph.calibration import Calibration, PlanarMotion, Section
from sonar_graph.measurements import Floats
from sonar_graph.models import Mount, sight_of, wrap_angle
from sonar_graph.motion import MotionSource
from sonar_graph.numerics import (
    O3,
    ZERO,
    Mat3,
    Mat6,
    Vec3,
    Vec6,
    compiled,
    cross,
    inlined,
    innovation_of,
    mat,
    mat6,
    skew,
    store,
    store6,
    store_all,
    store_row,
    store_row6,
    store_vector,
    vec,
)

Z = 2
ROLL = 3
PITCH = 4
YAW = 5
COMPASS = 6
"""Place of c."""
MAP = 7
"""Place of p_1."""
POSE = 6
"""Length of x_v."""
LANDMARK = 3
"""Length of p_i."""
MOST_PITCH_RAD = 0.5 * math.pi - 1e-3
"""Nearer to 90 degrees Euler angles count as singular."""

# -------------------------------------------------------------------------------- Euler angles (phi, theta, psi)
# Fossen, "Handbook of Marine Craft Hydrodynamics and Motion Control", 2011, (2.18), (2.28)


@inlined
def rotation_from_euler(roll: float, pitch: float, yaw: float) -> Mat3:
    """``world_R_body = Rz(psi) Ry(theta) Rx(phi)``."""
    sr = math.sin(roll)
    cr = math.cos(roll)
    sp = math.sin(pitch)
    cp = math.cos(pitch)
    sy = math.sin(yaw)
    cy = math.cos(yaw)
    return Mat3(
        Vec3(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        Vec3(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        Vec3(-sp, cp * sr, cp * cr),
    )


@inlined
def euler_from_rotation(R: Mat3) -> Vec3:
    """Angles of a rotation, with the pitch at least 1 mrad from 90 degrees: by 1 mrad another attitude."""
    pitch = math.atan2(-R.z.x, math.hypot(R.z.y, R.z.z))
    pitch = max(-MOST_PITCH_RAD, min(pitch, MOST_PITCH_RAD))
    return Vec3(math.atan2(R.z.y, R.z.z), pitch, math.atan2(R.y.x, R.x.x))


@inlined
def body_rates_from_euler(roll: float, pitch: float) -> Mat3:
    """W: body rates are ``w = W (phi', theta', psi')^T``."""
    sr = math.sin(roll)
    cr = math.cos(roll)
    sp = math.sin(pitch)
    cp = math.cos(pitch)
    return Mat3(Vec3(1.0, 0.0, -sp), Vec3(0.0, cr, sr * cp), Vec3(0.0, -sr, cr * cp))


@inlined
def euler_rates_from_body(roll: float, pitch: float) -> Mat3:
    """``E = W^-1``: Euler rates are ``(phi', theta', psi')^T = E w``."""
    sr = math.sin(roll)
    cr = math.cos(roll)
    cp = math.cos(pitch)
    tp = math.tan(pitch)
    return Mat3(
        Vec3(1.0, sr * tp, cr * tp), Vec3(0.0, cr, -sr), Vec3(0.0, sr / cp, cr / cp)
    )


# -------------------------------------------------------------------------------- prediction


class EulerPoseAfter(NamedTuple):
    """Pose a motion after the state."""

    R: Mat3
    """R'."""
    X: Vec3
    """X'."""
    T: Mat6
    """Derivative of delta by x_v."""


@inlined
def pose_after(x: Floats, motion: Motion) -> EulerPoseAfter:
    """R', X' and T of the pose a motion after the state."""
    dR = mat(motion.dR)
    dp = vec(motion.dp)
    R = rotation_from_euler(x[ROLL], x[PITCH], x[YAW])
    W = body_rates_from_euler(x[ROLL], x[PITCH])
    R_after = R @ dR
    T = Mat6(O3, dR.T @ W, R_after.T, -1.0 * (dR.T @ skew(dp) @ W))
    return EulerPoseAfter(R_after, vec(x) + R @ dp, T)


@compiled
def pose_arrays(x: Floats, motion: Motion) -> tuple[Floats, Floats, Floats]:
    """`pose_after` as arrays, shapes (3, 3), (3,) and (6, 6)."""
    after = pose_after(x, motion)
    R = np.empty((3, 3))
    T = np.empty((6, 6))
    store(after.R, R)
    store_all(after.T, T)
    return R, np.array([after.X.x, after.X.y, after.X.z]), T


@compiled
def predict(x: Floats, P: Floats, motion: Motion) -> None:
    """Carry state and covariance over a motion: ``P_vv <- F P_vv F^T + G C G^T``, ``P_vm <- F P_vm``."""
    R, X, T = pose_after(x, motion)
    angles = euler_from_rotation(R)
    store_vector(X, x, 0)
    store_vector(angles, x, ROLL)
    E = euler_rates_from_body(angles.x, angles.y)
    G = Mat6(O3, R, E, O3)  # of x_v by delta
    F = G @ T
    P_vv = mat6(P)
    store6(F @ P_vv @ F.T + G @ mat6(motion.C) @ G.T, P)
    for j in range(POSE, len(x)):
        # column j
        P_vm_j = Vec6(Vec3(P[0, j], P[1, j], P[2, j]), Vec3(P[3, j], P[4, j], P[5, j]))
        store_row6(F @ P_vm_j, P, j, 0)
        for i in range(POSE):
            P[i, j] = P[j, i]


# -------------------------------------------------------------------------------- update


@compiled
def update(x: Floats, P: Floats, H: Floats, e: Floats, R: Floats) -> None:
    """``x <- x + K e``, ``P <- P - K S K^T``, with ``S = H P H^T + R`` and ``K = P H^T S^-1``."""
    HP, S = innovation_of(P, H, R)
    move(x, correction(P, HP, S, e))


@inlined
def move(x: Floats, by: Floats) -> None:
    """Add to the state, and wrap roll and yaw."""
    for i in range(len(x)):
        x[i] += by[i]
    x[ROLL] = wrap_angle(x[ROLL])
    x[YAW] = wrap_angle(x[YAW])


@compiled
def observe(
    x: Floats, P: Floats, motion: Motion, sonar: Sonar, views: Views, first: int
) -> int:
    """Update by range and azimuth of known landmarks, one after the other; writes outcome, e of (7) and S of each.

    From one row of a frame on; returns the row of the next landmark that is not known, `NO_ROW` without any.
    """
    mount = Mount(sonar.body_R_sonar, sonar.body_p_sonar)
    for row in in_frame(views, first):
        if views.slot[row] == UNKNOWN:
            return row
        at = MAP + LANDMARK * views.slot[row]
        R, X, T = pose_after(x, motion)
        sight = sight_of(R, X, mount, Vec3(x[at], x[at + 1], x[at + 2]))  # (6)
        H = np.zeros((2, len(x)))
        # H_b T and H_p, row by row
        store_row6(T.T @ sight.range_by_body, H, 0, 0)
        store_row6(T.T @ sight.azimuth_by_body, H, 1, 0)
        store_row(sight.range_by_point, H, 0, at)
        store_row(sight.azimuth_by_point, H, 1, at)
        noise = view_noise(sight, motion, views.R_z[row])
        by = correction_by_view(P, H, sight, noise, views, row, sonar.kernel_width)
        move(x, by)
    return NO_ROW


@compiled
def update_depth(
    x: Floats, P: Floats, motion: Motion, port: Floats, z_m: float, variance_m2: float
) -> None:
    """Update by the height of the pressure port, ``(X' + R' q)_z``."""
    R, X, T = pose_after(x, motion)
    q = vec(port)
    h_b = Vec6(cross(q, R.z), R.z)  # of the height by delta
    H = np.zeros((1, len(x)))
    store_row6(T.T @ h_b, H, 0, 0)
    e = np.array([z_m - X.z - R.z @ q])
    update(x, P, H, e, np.array([[h_b @ (mat6(motion.C) @ h_b) + variance_m2]]))


@compiled
def follow(x: Floats, P: Floats, events: Events, setup: FilterSetup, first: int) -> int:
    """Predict to epochs, update by depths and frames, in turn from one event on; the number of the event that is next.

    It stops before a frame with a new landmark, before an epoch where the Euler angles are singular, and after one at which
    more is measured.
    """
    order = events.order
    k = first
    while is_followed(events, setup, k, first):
        motion = motion_to(events, k)
        # a motion over a gap has been reduced
        if setup.has_rate and not events.is_gap[k]:
            R = rotation_from_euler(x[ROLL], x[PITCH], x[YAW])
            motion = remove_rate(motion, ZERO, R.T @ vec(setup.earth_rad_s))
        row = order.row[k]
        # the caller appends new landmarks, and takes the whole frame: all its rows have one motion
        if order.kind[k] == FRAME and shows_new(events.views, row):
            return k
        if order.kind[k] == EPOCH:
            # the prediction folds the angles back
            if k > first and abs(x[PITCH]) >= MOST_PITCH_RAD:
                return k
            predict(x, P, motion)
            # gravity is compared with the specific force in the frame where its interval began
            feel(setup.felt, motion)
            if order.has_more[k]:
                return k + 1
        elif order.kind[k] == DEPTH:
            z_m = events.value[row, 2]
            variance_m2 = events.noise[row, 2, 2]
            update_depth(x, P, motion, setup.port_m, z_m, variance_m2)
        else:
            observe(x, P, motion, setup.sonar, events.views, row)
        k += 1
    return k


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
    - a known map (`map`), whose landmarks are in the state from the start, with a gate;
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

    def __init__(
        self,
        calibration: Calibration,
        odometry: MotionSource,
        params: EkfSlamParams | None = None,
    ) -> None:
        super().__init__(calibration, odometry, params or EkfSlamParams())
        start = calibration.start
        angles = euler_from_rotation(mat(start.pose().rotation().matrix()))
        places = self._known.places().ravel()
        self._x = np.concatenate((start.position_m, angles, [0.0], places))
        sigmas = (
            *start.position_sigma_m,
            *start.rpy_sigma_rad,
            calibration.heading.bias_sigma_rad,
        )
        self._P = np.zeros((len(self._x), len(self._x)))
        self._P[:MAP, :MAP] = np.diag(np.square(sigmas))
        self._P[MAP:, MAP:] = self._known.joint()
        self._overturned: list[str] = []

    def state(self) -> tuple[int, Floats, Floats]:
        """Stamp (ns), x of equation (4) and P of (5) at the newest epoch; copies."""
        return self.node_ns, self._x.copy(), self._P.copy()

    def follow(self, events: Events, first: int) -> int:
        """Predict to epochs, update by depths and frames, in turn; the number of the event that is next."""
        return follow(self._x, self._P, events, self.setup, first)

    def observe(self, motion: Motion, views: Views, first: int) -> int:
        """Update by range and azimuth of known landmarks, (6) and (7)."""
        return observe(self._x, self._P, motion, self.sonar, views, first)

    def append(self, place: Floats, P: Floats) -> int:
        """Append a landmark to (4)."""
        self._x = np.concatenate((self._x, place))
        self._P = P
        return (len(self._x) - MAP) // LANDMARK - 1

    def linearised(self, motion: Motion) -> tuple[Floats, Floats, Floats]:
        """R', X', and T."""
        return pose_arrays(self._x, motion)

    def height_jacobian(self, slot: int) -> Floats:
        """Derivative of a landmark's height by (4)."""
        H = np.zeros((1, len(self._x)))
        H[0, self.place_of(slot).stop - 1] = 1.0
        return H

    def covariance(self) -> Floats:
        """P of (5)."""
        return self._P

    def correct(self, H: Floats, e: Floats, R: Floats) -> None:
        """Update by an innovation."""
        update(self._x, self._P, H, e, R)

    def place_of(self, slot: int) -> slice:
        """Place of a landmark in (4)."""
        at = MAP + LANDMARK * slot
        return slice(at, at + LANDMARK)

    def compass(self) -> tuple[int, float]:
        """Place of c in (4), and its estimate."""
        return COMPASS, self._x[COMPASS]

    def update_up(self, up: Floats, sigma_rad: float, i_R_j: Floats) -> None:  # noqa: ARG002  # (4) has no bias
        """Update roll and pitch by the direction of the world's up in the body."""
        # roll is as uncertain as the pitch is steep
        level = math.hypot(up[1], up[2])
        roll_off = wrap_angle(math.atan2(up[1], up[2]) - self._x[ROLL])
        e = np.array([roll_off, math.atan2(-up[0], level) - self._x[PITCH]])
        self._update_numbers([ROLL, PITCH], e, [(sigma_rad / level) ** 2, sigma_rad**2])

    def update_plane(self, plane: PlanarMotion) -> None:
        """Update Z, roll and pitch by the plane on which the vehicle stays."""
        e = np.array([plane.z_m, 0.0, 0.0]) - self._x[[Z, ROLL, PITCH]]
        tilt_variance = plane.tilt_sigma_rad**2
        self._update_numbers(
            [Z, ROLL, PITCH], e, [plane.z_sigma_m**2, tilt_variance, tilt_variance]
        )

    def _update_numbers(
        self, places: list[int], e: Floats, variances: list[float]
    ) -> None:
        """Update by direct measurements of numbers of the state."""
        H = np.zeros((len(places), len(self._x)))
        H[range(len(places)), places] = 1.0
        self.correct(H, e, np.diag(variances))

    def points(self, slots: list[int]) -> tuple[Floats, Floats]:
        """Positions, and their blocks of (5)."""
        first = MAP + LANDMARK * np.array(slots, dtype=np.int64)
        places = np.add.outer(first, np.arange(LANDMARK)).ravel()
        return self._x[places].reshape(-1, 3), self._P[np.ix_(places, places)]

    def attitude(self) -> Floats:
        """world_R_body of the state, shape (3, 3)."""
        return np.array(rotation_from_euler(*self._x[ROLL:POSE].tolist()))

    def check(self, epoch_ns: int) -> None:
        """Note a state whose Euler angles are singular; the prediction from it reads them from the rotation."""
        if abs(self._x[PITCH]) >= MOST_PITCH_RAD and not self._overturned:
            self._overturned = [
                f"pitch came to {math.degrees(self._x[PITCH]):.0f} deg, first at {epoch_ns} ns, where the Euler angles"
                " of its state are singular, or beyond: the filter has lost its way, by wrong gyros, velocities or"
                " detections; or it needs another estimator, such as isam2"
            ]

    def withheld(self) -> list[str]:
        """Messages of both filters, and one about a pitch of 90 degrees or more."""
        return [*super().withheld(), *self._overturned]
