"""Factors of joint preintegration, for any GTSAM graph.

=========================== ============================================== ======================
factor                      keys                                           rows of the error
=========================== ============================================== ======================
`doppler_odometry`          pose i, pose j, bias (, scale) (, mounting)    theta, ds
`inertial_doppler_odometry` pose i, velocity i, pose j, velocity j, bias   theta, dv, dp, ds
                            (, scale) (, mounting)
=========================== ============================================== ======================

Poses are ``world_T_body``; velocities are those of the IMU's point in the world (of the body where that is its origin);
biases are `gtsam.imuBias.ConstantBias` in body axes; the scale is a double and the mounting a point, zero where the
calibration is right: ``u = Exp(mounting) (1 + scale) body_R_dvl z``.

With the motion corrected to first order by these parameters, ``t`` its duration and g the world's gravity::

    theta = Log(R^T R_i^T R_j)
    dv    = R_i^T (v_j - v_i - g t) - v
    dp    = R_i^T (a_j - a_i - v_i t - g t^2 / 2) - p        a: the IMU
    ds    = R_i^T (d_j - d_i) - s                            d: the Doppler log

Both are Python callbacks around compiled arithmetic; GTSAM has no compiled factor with these rows. Where no bias is to
be estimated, `sonar_graph.slam.factors.odometry` makes of ``motion.relative_pose()`` a compiled one.
"""

import gtsam
import numpy as np
from numpy.typing import NDArray

from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Floats
from sonar_graph.navigation import DISPLACEMENT, ROTATION, JointMotion, finite_vector
from sonar_graph.numerics import compiled, cross_matrix, left_jacobian, rotation_exp
from sonar_graph.slam.factors import gaussian

BIAS_ORDER = np.r_[3:6, 0:3]
"""GTSAM's bias has the accelerometers first."""
DOPPLER_ROWS = np.r_[ROTATION, DISPLACEMENT]
COLUMNS = {
    "pose_i": slice(0, 6),
    "velocity_i": slice(6, 9),
    "pose_j": slice(9, 15),
    "velocity_j": slice(15, 18),
    "bias": slice(18, 24),
    "scale": slice(24, 25),
    "mounting": slice(25, 28),
}
"""Columns of the derivatives of `joint_error`."""


def inertial_doppler_odometry(
    pose_i: int,
    velocity_i: int,
    pose_j: int,
    velocity_j: int,
    bias: int,
    motion: JointMotion,
    gravity: Floats,
    scale: int | None = None,
    mounting: int | None = None,
) -> gtsam.NonlinearFactor:
    """Twelve rows from gyro, accelerometer and Doppler log.

    Parameters
    ----------
    motion
        Of `sonar_graph.navigation.joint_preintegration`; in a chain, ``motion.after(the one before)``.
    gravity
        In the world, shape (3,), m/s²; (0, 0, -9.81) where z is up.
    scale, mounting
        Keys; None: as calibrated.

    Raises
    ------
    MeasurementError
        When gravity is no vector, a key is given twice or is no integer, or the motion's specific force was not
        measured.
    """
    if not np.isfinite(motion.velocity).all():
        raise MeasurementError(
            f"motion: from {motion.start_ns} to {motion.end_ns} ns the specific force was not measured in every row;"
            " use doppler_odometry"
        )
    ends = {"pose_i": pose_i, "velocity_i": velocity_i, "pose_j": pose_j, "velocity_j": velocity_j}
    keys = {**ends, "bias": bias, "scale": scale, "mounting": mounting}
    return _factor(keys, motion, finite_vector("gravity", gravity, 3), np.arange(12))


def doppler_odometry(
    pose_i: int, pose_j: int, bias: int, motion: JointMotion, scale: int | None = None, mounting: int | None = None
) -> gtsam.NonlinearFactor:
    """Six rows from gyro and Doppler log; see `inertial_doppler_odometry`."""
    keys = {"pose_i": pose_i, "pose_j": pose_j, "bias": bias, "scale": scale, "mounting": mounting}
    return _factor(keys, motion, np.zeros(3), DOPPLER_ROWS)


def _factor(
    given: dict[str, int | None], motion: JointMotion, gravity: Floats, rows: NDArray[np.intp]
) -> gtsam.NonlinearFactor:
    """Rows of `joint_error` as a factor of the variables that have a key."""
    keys = {name: key for name, key in given.items() if key is not None}
    for key in keys.values():
        if not isinstance(key, int | np.integer):
            raise MeasurementError(f"keys: expected integers, such as gtsam.symbol('x', 0), not {key!r}")
        if list(keys.values()).count(key) > 1:
            raise MeasurementError(
                f"keys: {gtsam.DefaultKeyFormatter(key)} is given twice; each variable needs its own"
            )
    constants = (
        motion.i_R_j.matrix(),
        np.array([motion.velocity, motion.position, motion.displacement]),
        np.ascontiguousarray(motion.D_parameters),
        motion.bias,
        motion.body_p_imu,
        motion.body_p_dvl,
        np.asarray(gravity, np.float64),
        motion.duration_s,
    )

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        parameters, at_rest = np.zeros(10), np.zeros(3)
        parameters[:6] = values.atConstantBias(keys["bias"]).vector()[BIAS_ORDER]
        if "scale" in keys:
            parameters[6] = values.atDouble(keys["scale"])
        if "mounting" in keys:
            parameters[7:] = values.atPoint3(keys["mounting"])
        X_i, X_j = (values.atPose3(keys[name]).matrix() for name in ("pose_i", "pose_j"))
        v_i, v_j = (values.atPoint3(keys[n]) if n in keys else at_rest for n in ("velocity_i", "velocity_j"))
        e, H = joint_error(X_i, v_i, X_j, v_j, parameters, *constants)
        if jacobians is not None:
            for n, name in enumerate(keys):
                jacobians[n] = H[rows, COLUMNS[name]]
        return e[rows]

    return gtsam.CustomFactor(gaussian(motion.covariance[np.ix_(rows, rows)]), list(keys.values()), error)


@compiled
def joint_error(
    X_i: Floats,
    v_i: Floats,
    X_j: Floats,
    v_j: Floats,
    parameters: Floats,
    i_R_j: Floats,
    measured: Floats,
    D: Floats,
    bias: Floats,
    body_p_imu: Floats,
    body_p_dvl: Floats,
    gravity: Floats,
    t: float,
) -> tuple[Floats, Floats]:
    """Error of `inertial_doppler_odometry` and its derivatives.

    ``X_i``, ``X_j``: ``world_T_body``, shape (4, 4); ``parameters``: gyro bias, accelerometer bias, scale, mounting,
    shape (10,); ``measured``: v, p, s as rows, shape (3, 3); ``bias``: for which ``measured`` holds, shape (6,).

    Returns shape (12,), and (12, 28) by pose i, velocity i, pose j, velocity j, bias (accelerometers first), scale,
    mounting.
    """
    change = parameters.copy()
    change[:6] -= bias
    correction = D @ change
    R_i, R_j = np.ascontiguousarray(X_i[:3, :3]), np.ascontiguousarray(X_j[:3, :3])
    world_R_i = np.ascontiguousarray(R_i.T)
    turn = world_R_i @ R_j
    between = world_R_i @ (X_j[:3, 3] - X_i[:3, 3])
    gained = world_R_i @ (v_j - v_i - gravity * t)
    fallen = world_R_i @ (v_i * t + gravity * (0.5 * t * t))
    e, H = np.empty(12), np.zeros((12, 28))
    mean = i_R_j @ rotation_exp(correction[:3])
    E = np.ascontiguousarray(mean.T) @ turn
    e[:3] = rotation_log(E)
    e[3:6] = gained - measured[0] - correction[3:6]
    e[6:9] = between + turn @ body_p_imu - body_p_imu - fallen - measured[1] - correction[6:9]
    e[9:] = between + turn @ body_p_dvl - body_p_dvl - measured[2] - correction[9:]

    by_parameters = -D
    by_log = np.linalg.inv(left_jacobian(-e[:3]))  # inverse right Jacobian
    H[:3, 0:3] = -by_log @ np.ascontiguousarray(turn.T)
    H[:3, 9:12] = by_log
    by_parameters[:3] = -by_log @ np.ascontiguousarray(E.T) @ left_jacobian(-correction[:3]) @ D[:3]
    H[3:6, 0:3], H[3:6, 6:9], H[3:6, 15:18] = cross_matrix(gained), -world_R_i, world_R_i
    _put_point_rows(H[6:9], between + turn @ body_p_imu - fallen, turn, body_p_imu)
    H[6:9, 6:9] = -world_R_i * t
    _put_point_rows(H[9:], between + turn @ body_p_dvl, turn, body_p_dvl)
    H[:, 18:21], H[:, 21:24], H[:, 24:] = by_parameters[:, 3:6], by_parameters[:, :3], by_parameters[:, 6:]
    return e, H


@compiled
def _put_point_rows(rows: Floats, seen: Floats, turn: Floats, body_p: Floats) -> None:
    """Derivatives of where a point of body j is, seen from body i, by both poses."""
    rows[:, 0:3], rows[:, 3:6] = cross_matrix(seen), -np.eye(3)
    rows[:, 9:12], rows[:, 12:15] = -turn @ cross_matrix(body_p), turn


@compiled
def rotation_log(R: Floats) -> Floats:
    """Rotation vector of a rotation matrix, rad, shape (3,); by way of its quaternion, sound near half a turn."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    q = np.empty(4)
    largest = np.argmax(np.array([R[0, 0], R[1, 1], R[2, 2], trace]))
    if largest == 3:
        q[0], q[1], q[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
        q[3] = 1.0 + trace
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q[i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        q[j], q[k] = R[j, i] + R[i, j], R[k, i] + R[i, k]
        q[3] = R[k, j] - R[j, k]
    if q[3] < 0:
        q = -q
    sine = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
    if sine < 1e-9 * q[3]:
        return 2.0 * q[:3] / q[3]
    return 2.0 * np.arctan2(sine, q[3]) / sine * q[:3]
