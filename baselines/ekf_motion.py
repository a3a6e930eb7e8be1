"""How the body moved, for EKF-SLAM: final motions from node to node, provisional ones to what happens in between.

Every motion begins at the node of the state, and its covariance is that of the perturbation [theta_i, eps] in that
node's frame (`sonar_graph.navigation.recursion`): ``Exp(theta_i) dR`` and ``dp + eps``.

Between two nodes several depth samples and frames follow each other. What they have in common, the steps up to the
newest IMU row, is integrated once and extended: the sums are the same to the last bit as those from the node on.
"""

from __future__ import annotations

from typing import NamedTuple

from baselines.euler import rotation_from_euler
from baselines.filter_models import VehicleModel
from sonar_graph.measurements import Floats
from sonar_graph.navigation.gap_motion import bridge
from sonar_graph.navigation.interpolation import rows_until
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.recursion import NO_MOTION, Integral, extended, increment, mirrored, rate_of_turn
from sonar_graph.navigation.steps import Columns, Cursor, cursor_at, next_step
from sonar_graph.navigation.triples import ZERO, Matrix, Vector, gram, multiple_of, sum_of, times, transposed, vector


class RunningMotion(NamedTuple):
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
    columns: Columns, vehicle: VehicleModel, x: Floats, running: RunningMotion, node_ns: int, until_ns: int
) -> tuple[RunningMotion, Integral]:
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
    return RunningMotion(node_ns, dvl_rows, earth, cursor, motion), finished(until)


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
def told_again(motion: Integral, times_told: int) -> Integral:
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
def nothing_running() -> RunningMotion:
    """Before the first provisional motion."""
    return RunningMotion(-1, -1, ZERO, Cursor(-1, 0, 0), NO_MOTION)


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
