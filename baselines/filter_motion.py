"""Motion of the body and direction of gravity, from the IMU and the Doppler log; for both filters.

A motion (dR, dp) begins at the epoch of the state. Its covariance is that of the perturbation [theta_i, eps] in that
epoch's frame: ``Exp(theta_i) dR`` and ``dp + eps``. A gyro bias larger by db adds ``theta_i = D_t db`` and
``eps = D_r db``; only the invariant filter has a bias in its state. Steps and gaps are those of every estimator
(`sonar_graph.navigation.preintegration`, docs/theory/preintegration.md, docs/theory/gaps.md).

Between two epochs EKF-SLAM integrates the steps up to the newest IMU row once and extends them to each depth sample and
frame: the sums are the same to the last bit as those from the epoch on.

Over about a second the mean specific force less the change of the Doppler velocity is that of gravity, which gives the
direction of the world's up in the body (`sonar_graph.navigation.alignment`, docs/theory/ekf_slam.md).
"""

import math
from typing import NamedTuple

import numpy as np

from baselines.filter_window import NODE, OPENED, GravityInterval, VehicleModel
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation import rows_until, value_at
from sonar_graph.navigation.preintegration import (
    NO_MOTION,
    Columns,
    Cursor,
    GapMotion,
    Integral,
    bridge,
    cursor_at,
    extended,
    extended_by_bias,
    increment,
    mirrored,
    next_step,
    rate_of_turn,
)
from sonar_graph.numerics import (
    IDENTITY,
    ZERO,
    ZEROS,
    Matrix,
    Vector,
    compiled,
    cross,
    gram,
    inlined,
    matrix,
    multiple_of,
    place,
    plus,
    product,
    rotation_from_euler,
    sum_of,
    times,
    transformed,
    transposed,
    vector,
)

UP: Vector = (0.0, 0.0, 1.0)


class ProvisionalMotion(NamedTuple):
    """Motion since an epoch over the steps that later instants share, and the conditions under which it holds."""

    node_ns: int
    dvl_rows: int
    """Doppler rows used: one more changes the velocity that was held."""
    earth: Vector
    """Earth's rotation in the epoch's frame, rad/s; a correction of the attitude changes it."""
    cursor: Cursor
    motion: Integral


@compiled
def motion_to_node(columns: Columns, vehicle: VehicleModel, x: Floats, start_ns: int, node_ns: int) -> Integral:
    """Final motion to the next epoch, with the first IMU row at or after it."""
    if node_ns - start_ns > vehicle.gap[0]:
        return _bridged(columns, vehicle, x, start_ns, node_ns, True)
    imu_ns, dvl_ns = columns[0], columns[3]
    imu_rows, dvl_rows = rows_until(imu_ns, node_ns - 1) + 1, rows_until(dvl_ns, node_ns)
    start, earth = cursor_at(columns, start_ns), _earth_in_body(vehicle, rotation_from_euler(vector(x[3:])))
    _, motion = _integrate(columns, vehicle, imu_rows, dvl_rows, earth, start, NO_MOTION, node_ns)
    return _finished(motion)


@compiled
def motion_since_node(
    columns: Columns, vehicle: VehicleModel, x: Floats, running: ProvisionalMotion, node_ns: int, until_ns: int
) -> tuple[ProvisionalMotion, Integral]:
    """Provisional motion to an instant, from rows stamped no later.

    Parameters
    ----------
    running
        As returned for an earlier instant, or by `no_provisional_motion`.
    """
    if until_ns - node_ns > vehicle.gap[0]:
        return running, _bridged(columns, vehicle, x, node_ns, until_ns, False)
    imu_ns, dvl_ns = columns[0], columns[3]
    imu_rows, dvl_rows = rows_until(imu_ns, until_ns), rows_until(dvl_ns, until_ns)
    earth = _earth_in_body(vehicle, rotation_from_euler(vector(x[3:])))
    cursor, motion = running.cursor, running.motion
    if (running.node_ns, running.dvl_rows, running.earth) != (node_ns, dvl_rows, earth):
        cursor, motion = cursor_at(columns, node_ns), NO_MOTION
    newest_ns = imu_ns[imu_rows - 1] if imu_rows > 0 else node_ns
    cursor, motion = _integrate(columns, vehicle, imu_rows, dvl_rows, earth, cursor, motion, newest_ns)
    _, until = _integrate(columns, vehicle, imu_rows, dvl_rows, earth, cursor, motion, until_ns)
    return ProvisionalMotion(node_ns, dvl_rows, earth, cursor, motion), _finished(until)


@compiled
def _bridged(
    columns: Columns, vehicle: VehicleModel, x: Floats, start_ns: int, end_ns: int, is_closed: bool
) -> Integral:
    """Motion over a gap of the Doppler log, with what an unknown gyro bias adds to the displacement.

    EKF-SLAM's state has no bias, and its drift is left out elsewhere, as published. In a gap the bias tilts gravity:
    without its share the displacement would be wrong by many times its sigma.
    """
    earth = _earth_in_body(vehicle, rotation_from_euler(vector(x[3:])))
    motion, _, D = bridge(columns, vehicle.gap, start_ns, end_ns, is_closed, ZERO, earth)
    cov_rr = sum_of(motion.cov_rr, multiple_of(vehicle.gyro_bias_sigma**2, gram(D)))
    return Integral(motion.dR, motion.dp, motion.impulse, motion.cov_tt, motion.cov_rt, cov_rr)


@compiled
def inflate_shared_motion(motion: Integral, k: int) -> Integral:
    """The motion to the k-th measurement that is related to the state over the same gap.

    All of them share its error. With k (k + 1) times the covariance they together carry no more information than one
    exact measurement: ``sum 1 / (k (k + 1)) = 1``.
    """
    factor = float(k * (k + 1))
    tt, rt = multiple_of(factor, motion.cov_tt), multiple_of(factor, motion.cov_rt)
    return Integral(motion.dR, motion.dp, motion.impulse, tt, rt, multiple_of(factor, motion.cov_rr))


@compiled
def no_provisional_motion() -> ProvisionalMotion:
    """Placeholder before the first provisional motion."""
    return ProvisionalMotion(-1, -1, ZERO, Cursor(-1, 0, 0), NO_MOTION)


@inlined
def _earth_in_body(vehicle: VehicleModel, R: Matrix) -> Vector:
    """Earth's rotation in the body frame, rad/s."""
    return times(transposed(R), vehicle.earth_rate)


@inlined
def _integrate(
    columns: Columns,
    vehicle: VehicleModel,
    imu_rows: int,
    dvl_rows: int,
    earth: Vector,
    cursor: Cursor,
    motion: Integral,
    until_ns: int,
) -> tuple[Cursor, Integral]:
    """Extend a motion, and its cursor among the rows, to an instant."""
    while cursor.stamp_ns < until_ns:
        cursor, step = next_step(columns, imu_rows, dvl_rows, cursor, until_ns)
        rate = rate_of_turn(step, motion.dR, ZERO, earth)
        added = increment(motion.dR, step.duration_s, rate, step.velocity, vehicle.body_p_dvl)
        motion = extended(motion, step, added, vehicle.gyro_noise_density)
    return cursor, motion


@inlined
def _finished(motion: Integral) -> Integral:
    """The motion with its covariance made symmetric."""
    return Integral(motion.dR, motion.dp, motion.impulse, motion.cov_tt, motion.cov_rt, mirrored(motion.cov_rr))


@compiled
def motion_to_node_with_bias(
    columns: Columns, vehicle: VehicleModel, R: Floats, bias: Floats, start_ns: int, node_ns: int
) -> GapMotion:
    """Final motion to the next epoch, with the first IMU row at or after it."""
    earth = _earth_in_body(vehicle, matrix(R))
    if node_ns - start_ns > vehicle.gap[0]:
        return bridge(columns, vehicle.gap, start_ns, node_ns, True, vector(bias), earth)
    imu_rows = rows_until(columns[0], node_ns - 1) + 1
    return _integrate_with_bias(columns, vehicle, imu_rows, vector(bias), earth, start_ns, node_ns)


@compiled
def motion_since_node_with_bias(
    columns: Columns, vehicle: VehicleModel, R: Floats, bias: Floats, node_ns: int, until_ns: int
) -> GapMotion:
    """Provisional motion to an instant, from rows stamped no later."""
    earth = _earth_in_body(vehicle, matrix(R))
    if until_ns - node_ns > vehicle.gap[0]:
        return bridge(columns, vehicle.gap, node_ns, until_ns, False, vector(bias), earth)
    return _integrate_with_bias(
        columns, vehicle, rows_until(columns[0], until_ns), vector(bias), earth, node_ns, until_ns
    )


@compiled
def inflate_shared_motion_with_bias(motion: GapMotion, k: int) -> GapMotion:
    """The same as `inflate_shared_motion`; the bias is in the state and its derivatives stay."""
    return GapMotion(inflate_shared_motion(motion.integral, k), motion.D_t, motion.D_r)


@compiled
def _integrate_with_bias(
    columns: Columns, vehicle: VehicleModel, imu_rows: int, bias: Vector, earth: Vector, start_ns: int, end_ns: int
) -> GapMotion:
    """Integrate all steps and the derivatives by the bias."""
    dvl_rows = rows_until(columns[3], end_ns)
    cursor, motion, D_t, D_r = cursor_at(columns, start_ns), NO_MOTION, ZEROS, ZEROS
    while cursor.stamp_ns < end_ns:
        cursor, step = next_step(columns, imu_rows, dvl_rows, cursor, end_ns)
        turn = rate_of_turn(step, motion.dR, bias, earth)
        added = increment(motion.dR, step.duration_s, turn, step.velocity, vehicle.body_p_dvl)
        D_t, D_r = extended_by_bias(D_t, D_r, step, added)
        motion = extended(motion, step, added, vehicle.gyro_noise_density)
    return GapMotion(_finished(motion), D_t, D_r)


@compiled
def up_direction(
    mean_force: Floats, i_R_j: Floats, velocity_i: Floats, velocity_j: Floats, duration_s: float
) -> Floats:
    """up_j of the module's equation, shape (3,); NaN where the force is not measured."""
    up_i = np.empty(3)
    for r in range(3):
        turned = i_R_j[r, 0] * velocity_j[0] + i_R_j[r, 1] * velocity_j[1] + i_R_j[r, 2] * velocity_j[2]
        up_i[r] = mean_force[r] - (turned - velocity_i[r]) / duration_s
    length = math.sqrt(up_i[0] ** 2 + up_i[1] ** 2 + up_i[2] ** 2)
    up_j = np.empty(3)
    for c in range(3):
        up_j[c] = (i_R_j[0, c] * up_i[0] + i_R_j[1, c] * up_i[1] + i_R_j[2, c] * up_i[2]) / length
    return up_j


@compiled
def tilt_sigma(
    duration_s: float,
    velocity_sigma_m_s: float,
    accel_noise_density: float,
    accel_bias_sigma: float,
    gyro_noise_density: float,
    gyro_bias_sigma: float,
    gravity: float,
) -> float:
    """Standard deviation of the direction's tilt, rad."""
    noise = (accel_noise_density**2 / duration_s + 2.0 * (velocity_sigma_m_s / duration_s) ** 2) / gravity**2
    noise += gyro_noise_density**2 * duration_s / 3.0 + (gyro_bias_sigma * duration_s) ** 2 / 4.0
    beta = accel_bias_sigma / gravity
    tau_s = (beta / max(gyro_noise_density, 1e-7)) ** 2
    return math.sqrt(noise + beta**2 * max(1.0, tau_s / duration_s))


@compiled
def open_interval(columns: Columns, dvl_p_imu: Vector, interval: GravityInterval, clock: Ints) -> None:
    """Begin a gravity interval at the epoch."""
    velocity = _imu_velocity(columns, clock[NODE], dvl_p_imu)
    place(IDENTITY, interval.i_R_node, 0, 0)
    for r in range(3):
        interval.impulse[r] = 0.0
    for r in range(4):
        interval.velocity[r] = velocity[r]
    clock[OPENED] = clock[NODE]


@inlined
def _imu_velocity(columns: Columns, node_ns: int, dvl_p_imu: Vector) -> Floats:
    """Velocity of the IMU at an epoch in body axes, m/s, and the variance of one component, shape (4,)."""
    imu_ns, rate, _, dvl_ns, velocity, cov, hold_past, _ = columns
    k = rows_until(dvl_ns, node_ns - 1)
    w = value_at(imu_ns, rate, rows_until(imu_ns, node_ns - 1), node_ns, hold_past)
    at_imu = np.empty(4)
    at_imu[0], at_imu[1], at_imu[2] = plus(vector(velocity[k]), cross(w, dvl_p_imu))
    at_imu[3] = (cov[k, 0, 0] + cov[k, 1, 1] + cov[k, 2, 2]) / 3.0
    return at_imu


@inlined
def up_at_node(
    columns: Columns, vehicle: VehicleModel, motion: Integral, clock: Ints, interval: GravityInterval
) -> tuple[Vector, float]:
    """Direction of the world's up in the body at the epoch that a motion has led to, and the sigma of its tilt (rad).

    The sigma is NaN while the interval goes on, and where the specific force was not measured all along.
    """
    if vehicle.gravity_interval_ns <= 0:
        return UP, math.nan
    i_R_node, impulse = matrix(interval.i_R_node), interval.impulse
    impulse[0], impulse[1], impulse[2] = transformed(vector(impulse), i_R_node, motion.impulse)
    place(product(i_R_node, motion.dR), interval.i_R_node, 0, 0)
    if clock[NODE] - clock[OPENED] < vehicle.gravity_interval_ns:
        return UP, math.nan
    duration_s = (clock[NODE] - clock[OPENED]) * 1e-9
    velocity = _imu_velocity(columns, clock[NODE], vehicle.dvl_p_imu)
    up = up_direction(impulse / duration_s, interval.i_R_node, interval.velocity[:3], velocity[:3], duration_s)
    sigma = tilt_sigma(
        duration_s,
        math.sqrt(0.5 * (velocity[3] + interval.velocity[3])),
        vehicle.accel_noise_density,
        vehicle.accel_bias_sigma,
        vehicle.gyro_noise_density,
        vehicle.gyro_bias_sigma,
        vehicle.gravity_m_s2,
    )
    open_interval(columns, vehicle.dvl_p_imu, interval, clock)
    if not np.isfinite(up).all():
        return UP, math.nan
    return vector(up), sigma
