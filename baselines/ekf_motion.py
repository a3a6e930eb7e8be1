"""How the body moved, for EKF-SLAM: final motions from node to node, provisional ones to what happens in between.

Every motion begins at the node of the state, and its covariance is that of the perturbation [theta_i, eps] in that
node's frame (`sonar_graph.navigation.recursion`): ``Exp(theta_i) dR`` and ``dp + eps``.

Between two nodes several depth samples and frames follow each other. What they have in common, the steps up to the
newest IMU row, is integrated once and extended: the sums are the same to the last bit as those from the node on.
"""

from __future__ import annotations

from typing import NamedTuple

from baselines.ekf_prediction import VehicleModel
from baselines.euler import rotation_from_euler
from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.odometry import Columns, Cursor, cursor_at, next_step, rows_until
from sonar_graph.navigation.recursion import NO_MOTION, Integral, extended, increment, mirrored, rate_of_turn
from sonar_graph.navigation.triples import ZERO, Vector, times, transposed, vector


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
    imu_ns, dvl_ns = columns[0], columns[3]
    imu_rows, dvl_rows = rows_until(imu_ns, node_ns - 1) + 1, rows_until(dvl_ns, node_ns)
    start, earth = cursor_at(columns, start_ns), earth_in_body(vehicle, x)
    _, motion = _integrate(columns, vehicle, imu_rows, dvl_rows, earth, start, NO_MOTION, node_ns)
    return _finished(motion)


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
    imu_ns, dvl_ns = columns[0], columns[3]
    imu_rows, dvl_rows = rows_until(imu_ns, until_ns), rows_until(dvl_ns, until_ns)
    earth = earth_in_body(vehicle, x)
    cursor, motion = running.cursor, running.motion
    if (running.node_ns, running.dvl_rows, running.earth) != (node_ns, dvl_rows, earth):
        cursor, motion = cursor_at(columns, node_ns), NO_MOTION
    newest_ns = imu_ns[imu_rows - 1] if imu_rows > 0 else node_ns
    cursor, motion = _integrate(columns, vehicle, imu_rows, dvl_rows, earth, cursor, motion, newest_ns)
    _, until = _integrate(columns, vehicle, imu_rows, dvl_rows, earth, cursor, motion, until_ns)
    return RunningMotion(node_ns, dvl_rows, earth, cursor, motion), _finished(until)


@compiled
def nothing_running() -> RunningMotion:
    """Before the first provisional motion."""
    return RunningMotion(-1, -1, ZERO, Cursor(-1, 0, 0), NO_MOTION)


@inlined
def earth_in_body(vehicle: VehicleModel, x: Floats) -> Vector:
    """Earth's rotation in the body frame of the state, rad/s."""
    return times(transposed(rotation_from_euler(vector(x[3:]))), vehicle.earth_rate)


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
def _finished(motion: Integral) -> Integral:
    """With all blocks of the covariance whole."""
    return Integral(motion.dR, motion.dp, motion.impulse, motion.cov_tt, motion.cov_rt, mirrored(motion.cov_rr))
