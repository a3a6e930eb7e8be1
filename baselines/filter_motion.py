"""How the body moved, for EKF-SLAM: final motions from node to node, provisional ones to what happens in between.

Every motion begins at the node of the state, and its covariance is that of the perturbation [theta_i, eps] in that
node's frame (`sonar_graph.navigation.preintegration.recursion`): ``Exp(theta_i) dR`` and ``dp + eps``.

Between two nodes several depth samples and frames follow each other. What they have in common, the steps up to the
newest IMU row, is integrated once and extended: the sums are the same to the last bit as those from the node on.

How the body moved, for the invariant filter: motions from a node, and their derivatives by the gyro bias.

The steps are every estimator's (`sonar_graph.navigation.preintegration.recursion`). With the perturbation [theta_i,
eps] in the node's
frame a bias that is larger by db gives ``theta_i = D_t db`` and ``eps = D_r db``
(`sonar_graph.navigation.preintegration.recursion.extended_by_bias`).
"""

from __future__ import annotations

from typing import NamedTuple

from baselines.filter_inputs import VehicleModel
from sonar_graph.measurements import Floats
from sonar_graph.navigation import rows_until
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
    ZERO,
    ZEROS,
    Matrix,
    Vector,
    compiled,
    gram,
    inlined,
    matrix,
    multiple_of,
    rotation_from_euler,
    sum_of,
    times,
    transposed,
    vector,
)


class ProvisionalMotion(NamedTuple):
    """Motion since a node over the steps that later instants share, and what it holds for."""

    node_ns: int
    dvl_rows: int
    """Rows that it has seen: one more changes the velocity that was held so far."""
    earth: Vector
    """Earth's rotation in the node's frame, rad/s; a correction of the attitude changes it."""
    cursor: Cursor
    motion: Integral


@compiled
def motion_to_node(columns: Columns, vehicle: VehicleModel, x: Floats, start_ns: int, node_ns: int) -> Integral:
    """Final motion to the next node, with the first IMU row at or after it."""
    if node_ns - start_ns > vehicle.gap[0]:
        return _bridged(columns, vehicle, x, start_ns, node_ns, True)
    imu_ns, dvl_ns = columns[0], columns[3]
    imu_rows, dvl_rows = rows_until(imu_ns, node_ns - 1) + 1, rows_until(dvl_ns, node_ns)
    start, earth = cursor_at(columns, start_ns), _earth(vehicle, x)
    _, motion = _integrate(columns, vehicle, imu_rows, dvl_rows, earth, start, NO_MOTION, node_ns)
    return finished(motion)


@compiled
def motion_since_node(
    columns: Columns, vehicle: VehicleModel, x: Floats, running: ProvisionalMotion, node_ns: int, until_ns: int
) -> tuple[ProvisionalMotion, Integral]:
    """Provisional motion to an instant, from rows stamped no later.

    Parameters
    ----------
    running
        As returned for an earlier instant, or by `nothing_running`.
    """
    if until_ns - node_ns > vehicle.gap[0]:
        return running, _bridged(columns, vehicle, x, node_ns, until_ns, False)
    imu_ns, dvl_ns = columns[0], columns[3]
    imu_rows, dvl_rows = rows_until(imu_ns, until_ns), rows_until(dvl_ns, until_ns)
    earth = _earth(vehicle, x)
    cursor, motion = running.cursor, running.motion
    if (running.node_ns, running.dvl_rows, running.earth) != (node_ns, dvl_rows, earth):
        cursor, motion = cursor_at(columns, node_ns), NO_MOTION
    newest_ns = imu_ns[imu_rows - 1] if imu_rows > 0 else node_ns
    cursor, motion = _integrate(columns, vehicle, imu_rows, dvl_rows, earth, cursor, motion, newest_ns)
    _, until = _integrate(columns, vehicle, imu_rows, dvl_rows, earth, cursor, motion, until_ns)
    return ProvisionalMotion(node_ns, dvl_rows, earth, cursor, motion), finished(until)


@compiled
def _bridged(
    columns: Columns, vehicle: VehicleModel, x: Floats, start_ns: int, end_ns: int, is_closed: bool
) -> Integral:
    """Motion over a gap of the Doppler log, with what an unknown gyro bias adds to the displacement.

    The state has no bias. Elsewhere its drift is left out, as published; in a gap it tilts gravity, and the
    displacement would be wrong by many times its sigma.
    """
    earth = _earth(vehicle, x)
    motion, _, D = bridge(columns, vehicle.gap, start_ns, end_ns, is_closed, ZERO, earth)
    cov_rr = sum_of(motion.cov_rr, multiple_of(vehicle.gyro_bias_sigma**2, gram(D)))
    return Integral(motion.dR, motion.dp, motion.impulse, motion.cov_tt, motion.cov_rt, cov_rr)


@compiled
def inflate_shared_motion(motion: Integral, times_told: int) -> Integral:
    """The motion to the k-th measurement that is related to the state over the same gap.

    All share its error. Taken as independent, many of them would tell more than one exact one can: with k (k + 1) times
    the covariance the information of all together stays below that, since ``sum 1 / (k (k + 1)) = 1``.
    """
    share = float(times_told * (times_told + 1))
    tt, rt, rr = (
        multiple_of(share, motion.cov_tt),
        multiple_of(share, motion.cov_rt),
        multiple_of(share, motion.cov_rr),
    )
    return Integral(motion.dR, motion.dp, motion.impulse, tt, rt, rr)


@compiled
def nothing_running() -> ProvisionalMotion:
    """Before the first provisional motion."""
    return ProvisionalMotion(-1, -1, ZERO, Cursor(-1, 0, 0), NO_MOTION)


@inlined
def earth_in_body(vehicle: VehicleModel, R: Matrix) -> Vector:
    """Earth's rotation in the body frame of the state, rad/s."""
    return times(transposed(R), vehicle.earth_rate)


@inlined
def _earth(vehicle: VehicleModel, x: Floats) -> Vector:
    return earth_in_body(vehicle, rotation_from_euler(vector(x[3:])))


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
    """A motion and its place among the rows, taken on to an instant."""
    while cursor.stamp_ns < until_ns:
        cursor, step = next_step(columns, imu_rows, dvl_rows, cursor, until_ns)
        rate = rate_of_turn(step, motion.dR, ZERO, earth)
        added = increment(motion.dR, step.duration_s, rate, step.velocity, vehicle.body_p_dvl)
        motion = extended(motion, step, added, vehicle.gyro_noise_density)
    return cursor, motion


@inlined
def finished(motion: Integral) -> Integral:
    """With all blocks of the covariance whole."""
    return Integral(motion.dR, motion.dp, motion.impulse, motion.cov_tt, motion.cov_rt, mirrored(motion.cov_rr))


@compiled
def motion_to_node_with_bias(
    columns: Columns, vehicle: VehicleModel, R: Floats, bias: Floats, start_ns: int, node_ns: int
) -> GapMotion:
    """Final motion to the next node, with the first IMU row at or after it."""
    earth = earth_in_body(vehicle, matrix(R))
    if node_ns - start_ns > vehicle.gap[0]:
        return bridge(columns, vehicle.gap, start_ns, node_ns, True, vector(bias), earth)
    imu_rows = rows_until(columns[0], node_ns - 1) + 1
    return _integrate_invariant_motion(columns, vehicle, imu_rows, vector(bias), earth, start_ns, node_ns)


@compiled
def motion_since_node_with_bias(
    columns: Columns, vehicle: VehicleModel, R: Floats, bias: Floats, node_ns: int, until_ns: int
) -> GapMotion:
    """Provisional motion to an instant, from rows stamped no later."""
    earth = earth_in_body(vehicle, matrix(R))
    if until_ns - node_ns > vehicle.gap[0]:
        return bridge(columns, vehicle.gap, node_ns, until_ns, False, vector(bias), earth)
    return _integrate_invariant_motion(
        columns, vehicle, rows_until(columns[0], until_ns), vector(bias), earth, node_ns, until_ns
    )


@compiled
def inflate_shared_motion_with_bias(motion: GapMotion, times_told: int) -> GapMotion:
    """Motion to the k-th measurement in one gap; the bias is in the state and needs no inflation."""
    return GapMotion(inflate_shared_motion(motion.integral, times_told), motion.D_t, motion.D_r)


@compiled
def _integrate_invariant_motion(
    columns: Columns, vehicle: VehicleModel, imu_rows: int, bias: Vector, earth: Vector, start_ns: int, end_ns: int
) -> GapMotion:
    """Over all steps, from the rows that may be known."""
    dvl_rows = rows_until(columns[3], end_ns)
    cursor, motion, D_t, D_r = cursor_at(columns, start_ns), NO_MOTION, ZEROS, ZEROS
    while cursor.stamp_ns < end_ns:
        cursor, step = next_step(columns, imu_rows, dvl_rows, cursor, end_ns)
        turn = rate_of_turn(step, motion.dR, bias, earth)
        added = increment(motion.dR, step.duration_s, turn, step.velocity, vehicle.body_p_dvl)
        D_t, D_r = extended_by_bias(D_t, D_r, step, added)
        motion = extended(motion, step, added, vehicle.gyro_noise_density)
    return GapMotion(finished(motion), D_t, D_r)
