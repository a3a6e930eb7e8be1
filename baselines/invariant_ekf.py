"""Right-invariant EKF-SLAM with the biases of gyros and accelerometers in its state: equations and estimator.

The state is a rotation and 1 + N points that turn with the world, one element of SE_{1+N}(3), and the biases b of
`sonar_graph.models.aiding`. The error is right-invariant::

    R = Exp(theta) R^,    x_k = Exp(theta) x_k^ + J_l(theta) xi_k,    b = b^ + beta                            (1)

with x_0 = X the body, and P the covariance of ``xi = [theta, beta, xi_0, ..., xi_N]``. Prediction over a motion
(dR, dp) with perturbation ``eps = [theta_j, rho]`` in its last frame, ``D = d eps / d b``, ``C = cov(eps)``::

    R' = R dR,    X' = X + R dp                                                                                (2)
    xi' = xi + J (D beta + eps)                                                                                (3)
    rows of J:    theta [R' 0],  beta [0 0],  xi_0 [[X']x R'  R'],  xi_k [[x_k]x R'  0]

A measurement is taken a motion after the state, at R', X': H is its derivative by xi, H_b that by eps, and ::

    H_beta = H_b D                                                                                             (4)

Landmark k in range and azimuth, H_p their derivative by the point in the world::

    H_theta = 0,    H_xi_k = H_p = -H_xi_0                                                                     (5)

New landmark at ``g = X' + R' q(z)``, q the point of the body that is seen at z = (range, azimuth, elevation)::

    xi_new = xi_0 + G_b eps + G_z dz                                                                           (6)

Position of ``a = X' + R' q``, k = 0, or of a landmark ``a = x_k`` with zero H_b; heights are their last rows::

    H_theta = -[a]x,    H_xi_k = I                                                                             (7)

Direction u of the world's up in the body, tilted by A times the bias a of the accelerometers, and the innovation
covariance::

    y = (R (u - A a))_xy = [ -theta_y, theta_x ] + (R A beta_a)_xy + noise                                     (8)
    S = H P H^T + H_b C H_b^T + R_z                                                                            (9)

Compass, with the derivative h of the yaw by a turn in the body, and its bias c in b::

    psi' + c,    H_theta = h R'^T,    H_c = 1,    H_b = [h 0]                                                 (10)

Every H but those of compass and position fixes is zero along a shift of everything in x and y and a turn about the
vertical, at any estimate, so these unobservable directions stay unobservable. Derivation: docs/theory/invariant_ekf.md.
"""

from copy import deepcopy
from typing import ClassVar, NamedTuple

import gtsam
import numpy as np
from pydantic import Field

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
from baselines.kalman import correction, correction_by_view, symmetric, view_noise
from sonar_graph.calibration import Calibration, PlanarMotion, Section
from sonar_graph.measurements import Floats
from sonar_graph.models import (
    ACCEL,
    BIASES,
    COMPASS,
    SCALE,
    KnownLandmarks,
    Mount,
    bias_jacobian,
    bias_sigmas,
    gyro_bias_of,
    sight_of,
)
from sonar_graph.motion import MotionSource
from sonar_graph.numerics import (
    UPPER_RIGHT,
    ZERO,
    Mat3,
    Vec3,
    Vec6,
    compiled,
    cross,
    exp_and_mean,
    inlined,
    innovation_of,
    mat,
    mat6,
    skew,
    store,
    store_row,
    store_vector,
    vec,
)

THETA = slice(0, 3)
BETA = slice(3, 3 + BIASES)
BODY = slice(3 + BIASES, 6 + BIASES)
"""Place of xi_0 in xi."""
BARE = 6 + BIASES
"""Length of xi without landmarks."""
POINT = 3
"""Length of one xi_k."""
BETA_ACCEL = slice(3 + ACCEL.start, 3 + ACCEL.stop)
BETA_COMPASS = 3 + COMPASS


class InvariantState(NamedTuple):
    """Estimate and covariance."""

    R: Floats
    """world_R_body, shape (3, 3)."""
    points: Floats
    """Positions of the body and of the landmarks, shape (1 + N, 3), m."""
    bias: Floats
    """b of `sonar_graph.models.aiding`, shape (11,)."""
    P: Floats
    """Covariance of xi, shape (17 + 3 N, 17 + 3 N)."""
    body_p_dvl: Floats
    """Doppler log in the body, shape (3,), m."""
    is_level: bool
    """True where gravity levels the vehicle."""


def place_of(k: int) -> slice:
    """Place of xi_k in xi."""
    return slice(BODY.start + POINT * k, BODY.stop + POINT * k)


# -------------------------------------------------------------------------------- prediction


class InvariantPoseAfter(NamedTuple):
    """Pose a motion after the state, (2)."""

    R: Mat3
    """R'."""
    X: Vec3
    """X', without the scale error of the Doppler log."""
    D: Floats
    """Derivative of the motion by b, shape (6, 11)."""


@inlined
def pose_after(state: InvariantState, motion: Motion) -> InvariantPoseAfter:
    """R', X' of (2), and D."""
    R = mat(state.R)
    dR = mat(motion.dR)
    dp = vec(motion.dp)
    up = R.z if state.is_level else ZERO  # splits the gyros' bias
    D = bias_jacobian(motion.D, dR, dp, up, R.z, vec(state.body_p_dvl))
    scaled = state.bias[SCALE] * Vec3(D[3, SCALE], D[4, SCALE], D[5, SCALE])
    R_after = R @ dR
    X = vec(state.points[0]) + R @ dp + R_after @ scaled
    return InvariantPoseAfter(R_after, X, D)


@compiled
def pose_arrays(state: InvariantState, motion: Motion) -> tuple[Floats, Floats, Floats]:
    """`pose_after` as arrays, shapes (3, 3), (3,) and (6, 11)."""
    after = pose_after(state, motion)
    R = np.empty((3, 3))
    store(after.R, R)
    return R, np.array([after.X.x, after.X.y, after.X.z]), after.D


@compiled
def predict(state: InvariantState, motion: Motion, walk_variance: Floats) -> None:
    """Carry estimate and covariance over a motion, (2) and (3): ``P <- F P F^T + J C J^T``, ``F = I + J D E_beta``.

    ``walk_variance``: of the biases since, shape (11,).
    """
    R, X, D = pose_after(state, motion)
    store(R, state.R)
    store_vector(X, state.points[0], 0)
    P = state.P
    J = np.zeros((len(P), 6))
    # R and X are those at the end of the motion; the landmarks do not move
    store(R, J)  # theta
    store(R, J[BODY], UPPER_RIGHT)
    for k in range(len(state.points)):
        x_k = vec(state.points[k])
        store(skew(x_k) @ R, J[BODY.start + POINT * k :])
    JD = J @ D
    # F P F^T = P + M + M^T, with half of what is quadratic in J in M
    M = JD @ (P[BETA] + 0.5 * P[BETA, BETA].copy() @ JD.T) + J @ (0.5 * motion.C @ J.T)
    P += M + M.T
    for i in range(BIASES):
        P[BETA.start + i, BETA.start + i] += walk_variance[i]


# -------------------------------------------------------------------------------- update


@compiled
def update(state: InvariantState, H: Floats, e: Floats, R: Floats) -> None:
    """Update by an innovation: ``xi = K e`` moves the estimate by (1), ``P <- P - K S K^T``."""
    HP, S = innovation_of(state.P, H, R)
    move(state, correction(state.P, HP, S, e))


@inlined
def move(state: InvariantState, xi: Floats) -> None:
    """Move the estimate by an error, (1)."""
    # the error turns with the world, so that all points turn together
    Exp, J_l = exp_and_mean(vec(xi))
    store(Exp @ mat(state.R), state.R)
    for k in range(len(state.points)):
        xi_k = vec(xi[BODY.start + POINT * k :])
        store_vector(Exp @ vec(state.points[k]) + J_l @ xi_k, state.points[k], 0)
    for i in range(BIASES):
        state.bias[i] += xi[BETA.start + i]


@inlined
def store_by_biases(h_b: Vec6, D: Floats, H: Floats, row: int) -> None:
    """Write ``H_beta = H_b D`` of (4) into a row of H."""
    for i in range(BIASES):
        D_i = Vec6(Vec3(D[0, i], D[1, i], D[2, i]), Vec3(D[3, i], D[4, i], D[5, i]))
        H[row, BETA.start + i] = h_b @ D_i


@compiled
def observe(
    state: InvariantState, motion: Motion, sonar: Sonar, views: Views, first: int
) -> int:
    """Update by range and azimuth of known landmarks, (5), in turn; writes outcome, innovation and covariance of each.

    From one row of a frame on; returns the row of the next landmark that is not known, `NO_ROW` without any.
    """
    mount = Mount(sonar.body_R_sonar, sonar.body_p_sonar)
    for row in in_frame(views, first):
        if views.slot[row] == UNKNOWN:
            return row
        k = 1 + views.slot[row]
        at = BODY.start + POINT * k
        R, X, D = pose_after(state, motion)
        sight = sight_of(R, X, mount, vec(state.points[k]))
        H = np.zeros((2, len(state.P)))
        # a turn of everything about the origin changes no view: H_theta is zero
        store_row(sight.range_by_point, H, 0, at)
        store_row(sight.azimuth_by_point, H, 1, at)
        store_row(-1.0 * sight.range_by_point, H, 0, BODY.start)
        store_row(-1.0 * sight.azimuth_by_point, H, 1, BODY.start)
        store_by_biases(sight.range_by_body, D, H, 0)
        store_by_biases(sight.azimuth_by_body, D, H, 1)
        noise = view_noise(sight, motion, views.R_z[row])
        width = sonar.kernel_width
        xi = correction_by_view(state.P, H, sight, noise, views, row, width)  # (9)
        move(state, xi)
    return NO_ROW


@compiled
def update_depth(
    state: InvariantState, motion: Motion, port: Floats, z_m: float, variance_m2: float
) -> None:
    """Update by the height of the pressure port, (7)."""
    R, X, D = pose_after(state, motion)
    q = vec(port)
    a = X + R @ q
    h_b = Vec6(cross(q, R.z), R.z)  # of the height by eps
    H = np.zeros((1, len(state.P)))
    store_row(Vec3(a.y, -a.x, 0.0), H, 0, THETA.start)
    H[0, BODY.start + 2] = 1.0
    store_by_biases(h_b, D, H, 0)
    e = np.array([z_m - a.z])
    update(state, H, e, np.array([[h_b @ (mat6(motion.C) @ h_b) + variance_m2]]))


@compiled
def follow(
    state: InvariantState, events: Events, setup: FilterSetup, first: int
) -> int:
    """Predict to epochs, update by depths and frames, in turn from one event on; the number of the event that is next.

    It stops before a frame with a new landmark, and after an epoch at which more is measured.
    """
    order = events.order
    k = first
    while is_followed(events, setup, k, first):
        motion = motion_to(events, k)
        # a motion over a gap has been reduced
        if setup.has_rate and not events.is_gap[k]:
            R = mat(state.R)
            up = R.z if state.is_level else ZERO
            bias = gyro_bias_of(state.bias, up)
            motion = remove_rate(motion, bias, R.T @ vec(setup.earth_rad_s))
        row = order.row[k]
        # the caller appends new landmarks, and takes the whole frame: all its rows have one motion
        if order.kind[k] == FRAME and shows_new(events.views, row):
            return k
        if order.kind[k] == EPOCH:
            duration_s = (order.end_ns[k] - order.start_ns[k]) * 1e-9
            predict(state, motion, setup.walk_density**2 * duration_s)
            # gravity is compared with the specific force in the frame where its interval began
            feel(setup.felt, motion)
            if order.has_more[k]:
                return k + 1
        elif order.kind[k] == DEPTH:
            z_m = events.value[row, 2]
            variance_m2 = events.noise[row, 2, 2]
            update_depth(state, motion, setup.port_m, z_m, variance_m2)
        else:
            observe(state, motion, setup.sonar, events.views, row)
        k += 1
    return k


class InvariantEkfParams(FilterParams):
    """Settings of the invariant filter: those of EKF-SLAM, with the smoother's kernel."""

    kernel_width: float = Field(1.5, ge=0)
    """As `FilterParams.kernel_width`; the smoother's default."""
    far_views: bool = True
    """As `FilterParams.far_views`."""


class InvariantEkf(FilterShell):
    """Right-invariant extended Kalman filter over pose, biases and landmarks.

    Same measurements, gates, floor and gaps as `baselines.ekf_slam.EkfSlam`, with three differences:

    - The error is right-invariant, in the world's frame. The unobservable directions, position and heading of the
      world, are then the same at every estimate, and no linearisation gains information along them (Barrau and
      Bonnabel, 2015; Zhang, Wu, Song, Huang and Dissanayake, RA-L 2(2), 2017).
    - The biases of gyros and accelerometers are states that walk; a scale error of the Doppler log is a constant one.
      Every motion has its derivatives by them, also over gaps.
    - Attitude is a rotation matrix and has no singular pitch.

    It linearises once, and cannot revise an association. Derivation: docs/theory/invariant_ekf.md; gravity:
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
    has_bias = True

    def __init__(
        self,
        calibration: Calibration,
        odometry: MotionSource,
        params: InvariantEkfParams | None = None,
    ) -> None:
        super().__init__(calibration, odometry, params or InvariantEkfParams())
        self.setup = self.setup._replace(walk_density=bias_sigmas(calibration)[1])
        self._state = with_map(start_state(calibration), self._known)

    def state(self) -> tuple[int, InvariantState]:
        """Stamp (ns) and a copy of the state at the newest epoch."""
        return self.node_ns, deepcopy(self._state)

    def follow(self, events: Events, first: int) -> int:
        """Predict to epochs, update by depths and frames, in turn; the number of the event that is next."""
        return follow(self._state, events, self.setup, first)

    def observe(self, motion: Motion, views: Views, first: int) -> int:
        """Update by range and azimuth of known landmarks, (5)."""
        return observe(self._state, motion, self.sonar, views, first)

    def linearised(self, motion: Motion) -> tuple[Floats, Floats, Floats]:
        """R', X', and ``J xi = [R'^T theta; R'^T (xi_0 - [X']x theta)] + D beta``, to which eps is added."""
        R, X, D = pose_arrays(self._state, motion)
        J = np.zeros((6, BARE))
        J[:3, THETA] = R.T
        J[3:, BODY] = R.T
        J[3:, THETA] = -R.T @ gtsam.SO3.Hat(X)
        J[:, BETA] = D
        return R, X, J

    def by_point(self, G: Floats) -> Floats:
        """Derivative of xi_new, (6), by xi: of theta nothing, since Exp(theta) turns all points, and all of xi_0."""
        by_state = G.copy()
        by_state[:, THETA] = 0.0
        by_state[:, BODY] = np.eye(3)
        return by_state

    def covariance(self) -> Floats:
        """P of xi."""
        return self._state.P

    def correct(self, H: Floats, e: Floats, R: Floats) -> None:
        """Update by an innovation."""
        update(self._state, H, e, R)

    def place_of(self, slot: int) -> slice:
        """Place of a landmark in xi."""
        return place_of(1 + slot)

    def compass(self) -> tuple[int, float]:
        """Place of c in xi, (10), and its estimate."""
        return BETA_COMPASS, self._state.bias[COMPASS]

    def append(self, place: Floats, P: Floats) -> int:
        """Append a landmark, (6)."""
        points = np.vstack((self._state.points, place))
        self._state = self._state._replace(points=points, P=P)
        return len(points) - 2

    def height_jacobian(self, slot: int) -> Floats:
        """H of a landmark's height, (7)."""
        return self._height_jacobian(1 + slot)

    def update_up(self, up: Floats, sigma_rad: float, i_R_j: Floats) -> None:
        """Update by the direction of the world's up in the body, (8)."""
        # the accelerometers' bias is constant in the body, which turns from i to j
        by_accel = 0.5 * (np.eye(3) + i_R_j.T) / self.calibration.gravity_m_s2
        self._update_tilt(up, by_accel, sigma_rad)

    def update_plane(self, plane: PlanarMotion) -> None:
        """Update by the plane on which the vehicle stays: height of the body, (7), and tilt, (8)."""
        e = plane.z_m - self._state.points[0, 2:]
        update(
            self._state, self._height_jacobian(0), e, np.array([[plane.z_sigma_m**2]])
        )
        self._update_tilt(
            np.array([0.0, 0.0, 1.0]), np.zeros((3, 3)), plane.tilt_sigma_rad
        )

    def _update_tilt(self, up: Floats, by_accel: Floats, sigma_rad: float) -> None:
        """Update by (8); ``by_accel``: A, shape (3, 3)."""
        state = self._state
        by_bias = state.R @ by_accel
        y = state.R @ up - by_bias @ state.bias[ACCEL]
        H = np.zeros((2, len(state.P)))
        H[0, 1] = -1.0
        H[1, 0] = 1.0
        H[:, BETA_ACCEL] = by_bias[:2]
        update(state, H, y[:2], sigma_rad**2 * np.eye(2))

    def _height_jacobian(self, k: int) -> Floats:
        """H of the height of x_k, (7), shape (1, 17 + 3 N)."""
        x, y, _ = self._state.points[k]
        H = np.zeros((1, len(self._state.P)))
        H[0, THETA] = (y, -x, 0.0)
        H[0, place_of(k)] = (0.0, 0.0, 1.0)
        return H

    def attitude(self) -> Floats:
        """world_R_body of the state, shape (3, 3)."""
        return self._state.R.copy()

    def gyro_bias(self) -> Floats:
        """Estimated gyro bias, shape (3,), rad/s."""
        up = vec(self._state.R[2]) if self._state.is_level else ZERO
        return np.array(gyro_bias_of(self._state.bias, up))

    def points(self, slots: list[int]) -> tuple[Floats, Floats]:
        """Positions, and covariance of their coordinates, ``xi_k - [x_k]x theta``."""
        P = self._state.P
        positions = self._state.points[[1 + slot for slot in slots]]  # (m, 3)
        first = BARE + POINT * np.array(slots, dtype=np.int64)
        places = np.add.outer(first, np.arange(POINT)).ravel()
        B = np.array([gtsam.SO3.Hat(at) for at in positions]).reshape(-1, 3)  # (3 m, 3)
        turned = B @ P[THETA, places]  # (3 m, 3 m)
        joint = (
            P[np.ix_(places, places)] - turned - turned.T + B @ P[THETA, THETA] @ B.T
        )
        return positions, symmetric(joint)


def start_state(calibration: Calibration) -> InvariantState:
    """State at the start, without landmarks.

    Errors of the start, ``R = R^ Exp(delta)`` and ``X = X^ + R^ d``, are ``theta = R^ delta`` and
    ``xi_0 = R^ d + [X^]x theta``.
    """
    start = calibration.start
    R = np.ascontiguousarray(start.pose().rotation().matrix())
    X = np.array(start.position_m)
    A = np.zeros((BARE, 6))
    A[THETA, :3] = R
    A[BODY, :3] = gtsam.SO3.Hat(X) @ R
    A[BODY, 3:] = R
    P = A @ start.covariance() @ A.T
    P[BETA, BETA] = np.diag(bias_sigmas(calibration)[0] ** 2)
    body_p_dvl = np.array(calibration.dvl.mounting.translation_m)
    return InvariantState(
        R,
        X[None].copy(),
        np.zeros(BIASES),
        symmetric(P),
        body_p_dvl,
        calibration.use_gravity,
    )


def with_map(state: InvariantState, known: KnownLandmarks) -> InvariantState:
    """State with the landmarks of a map, whose places do not depend on the vehicle's.

    The error d of a place is ``xi_k = d + [x_k^]x theta``, as that of the body.
    """
    places = known.places()  # (m, 3)
    A = np.zeros((places.size, len(state.P)))  # of xi_1 to xi_m by xi
    for k, place in enumerate(places):
        A[POINT * k : POINT * (k + 1), THETA] = gtsam.SO3.Hat(place)
    AP = A @ state.P
    own = symmetric(AP @ A.T + known.joint())
    P = np.block([[state.P, AP.T], [AP, own]])
    return state._replace(points=np.vstack((state.points, places)), P=P)
