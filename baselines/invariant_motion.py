"""How the body moved, for the invariant filter: motions from a node, and their derivatives by the gyro bias.

The steps are every estimator's (`sonar_graph.navigation.steps`). With the perturbation [theta_i, eps] in the node's
frame a bias that is larger by db gives ``theta_i = D_t db`` and ``eps = D_r db``
(`sonar_graph.navigation.recursion.extended_by_bias`).
"""

from __future__ import annotations

from baselines.ekf_motion import earth_in_body, finished, told_again
from baselines.filter_models import VehicleModel
from sonar_graph.measurements import Floats
from sonar_graph.navigation.gap_motion import GapMotion, bridge
from sonar_graph.navigation.interpolation import rows_until
from sonar_graph.navigation.kernels import compiled
from sonar_graph.navigation.recursion import NO_MOTION, extended, extended_by_bias, increment, rate_of_turn
from sonar_graph.navigation.steps import Columns, cursor_at, next_step
from sonar_graph.navigation.triples import (
    ZEROS,
    Vector,
    matrix,
    vector,
)


@compiled
def motion_to_node(
    columns: Columns, vehicle: VehicleModel, R: Floats, bias: Floats, start_ns: int, node_ns: int
) -> GapMotion:
    """Final motion to the next node, with the first IMU row at or after it."""
    earth = earth_in_body(vehicle, matrix(R))
    if node_ns - start_ns > vehicle.gap[0]:
        return bridge(columns, vehicle.gap, start_ns, node_ns, True, vector(bias), earth)
    imu_rows = rows_until(columns[0], node_ns - 1) + 1
    return _integrate(columns, vehicle, imu_rows, vector(bias), earth, start_ns, node_ns)


@compiled
def motion_since_node(
    columns: Columns, vehicle: VehicleModel, R: Floats, bias: Floats, node_ns: int, until_ns: int
) -> GapMotion:
    """Provisional motion to an instant, from rows stamped no later."""
    earth = earth_in_body(vehicle, matrix(R))
    if until_ns - node_ns > vehicle.gap[0]:
        return bridge(columns, vehicle.gap, node_ns, until_ns, False, vector(bias), earth)
    return _integrate(columns, vehicle, rows_until(columns[0], until_ns), vector(bias), earth, node_ns, until_ns)


@compiled
def told_again_with_bias(motion: GapMotion, times_told: int) -> GapMotion:
    """The motion to the k-th measurement in one gap: `told_again`; the bias is in the state and needs no such care."""
    return GapMotion(told_again(motion.integral, times_told), motion.D_t, motion.D_r)


@compiled
def _integrate(
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
