"""EKF-SLAM without landmarks: prediction from node to node, depth, gravity and the planar constraint.

Nodes are the stamps of the Doppler log (`sonar_graph.navigation.odometry`); a depth sample between two of them is
related to the earlier by a provisional motion.

Gravity. From the specific force over about a second follows the direction of the world's up in the body
(`sonar_graph.navigation.alignment`), of which roll and pitch are ``atan2(up_y, up_z)`` and
``atan2(-up_x, hypot(up_y, up_z))``: corrections of one state each, with the variance of the tilt (for roll over
``cos(theta)^2``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from baselines.ekf_landmarks import add_covariances, moment_after, motion_covariance, row_along
from baselines.ekf_state import correct, predict
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.alignment import tilt_sigma, up_direction
from sonar_graph.navigation.gap_motion import NO_GAPS, GapValues
from sonar_graph.navigation.interpolation import rows_until, value_at
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.recursion import Integral
from sonar_graph.navigation.steps import Columns
from sonar_graph.navigation.triples import (
    IDENTITY,
    Vector,
    cross,
    dot,
    matrix,
    place,
    plus,
    product,
    transformed,
    vector,
)
from sonar_graph.slam.models import wrap_angle

NODE, OPENED, DEPTHS, SIGHTINGS, LOST = 0, 1, 2, 3, 4
"""Places in the clock: stamp of the state, stamp at which the running gravity interval began, how many depth samples
and detections were used since the Doppler log lost the bottom, and whether it ever did (0 or 1)."""
CLOCK = 5
"""Numbers of the clock."""


class VehicleModel(NamedTuple):
    """What is known of the sensors that move the state."""

    gyro_noise_density: float
    body_p_dvl: Vector
    dvl_p_imu: Vector
    """Lever arm from DVL to IMU, body axes."""
    earth_rate: Vector
    """In the world, rad/s; zero where it is not removed."""
    body_p_port: Vector
    gravity_interval_ns: int
    """0: gravity is not used."""
    accel_noise_density: float
    accel_bias_sigma: float
    gravity_m_s2: float
    is_planar: bool
    plane_z_m: float
    plane_z_variance: float
    plane_tilt_variance: float
    gap: GapValues = NO_GAPS
    gyro_bias_sigma: float = 0.0
    """Of gaps and of gravity only, rad/s."""


class GravityInterval(NamedTuple):
    """What has run up since the last use of gravity."""

    i_R_node: Floats
    """Rotation since the interval began, shape (3, 3)."""
    impulse: Floats
    """Integral of the specific force in the interval's first frame, shape (3,), m/s."""
    velocity: Floats
    """Of the IMU's point when it began, shape (3,), and the variance of one component: shape (4,)."""


VehicleValues = tuple[
    float, Vector, Vector, Vector, Vector, int, float, float, float, bool, float, float, float, GapValues, float
]
GravityValues = tuple[Floats, Floats, Floats]


@compiled
def open_interval(columns: Columns, dvl_p_imu: Vector, interval: GravityInterval, clock: Ints) -> None:
    """Begin a gravity interval at the node."""
    velocity = _velocity_at_node(columns, clock[NODE], dvl_p_imu)
    place(IDENTITY, interval.i_R_node, 0, 0)
    for r in range(3):
        interval.impulse[r] = 0.0
    for r in range(4):
        interval.velocity[r] = velocity[r]
    clock[OPENED] = clock[NODE]


@inlined
def _velocity_at_node(columns: Columns, node_ns: int, dvl_p_imu: Vector) -> Floats:
    """Velocity of the IMU's point in body axes, m/s, and the variance of one component, shape (4,)."""
    imu_ns, rate, _, dvl_ns, velocity, cov, hold_past, _ = columns
    k = rows_until(dvl_ns, node_ns - 1)
    w = value_at(imu_ns, rate, rows_until(imu_ns, node_ns - 1), node_ns, hold_past)
    at_imu = np.empty(4)
    at_imu[0], at_imu[1], at_imu[2] = plus(vector(velocity[k]), cross(w, dvl_p_imu))
    at_imu[3] = (cov[k, 0, 0] + cov[k, 1, 1] + cov[k, 2, 2]) / 3.0
    return at_imu


@inlined
def next_node(columns: Columns, node_ns: int, until_ns: int) -> int:
    """The first node after one instant, when it is reached at another; else -1."""
    imu_ns, dvl_ns = columns[0], columns[3]
    k, seen = rows_until(dvl_ns, node_ns), rows_until(imu_ns, until_ns)
    if k == len(dvl_ns) or seen == 0 or dvl_ns[k] > min(until_ns, imu_ns[seen - 1]):
        return -1
    return int(dvl_ns[k])


@compiled
def advance_to_node(
    columns: Columns,
    model: VehicleModel,
    x: Floats,
    P: Floats,
    n: int,
    clock: Ints,
    interval: GravityInterval,
    node_ns: int,
    motion: Integral,
) -> None:
    """Predict over a motion to a node and apply what holds there.

    Parameters
    ----------
    x, P, n, clock, interval
        Filter state; changed.
    """
    predict(x, P, n, motion)
    clock[NODE] = node_ns
    clock[DEPTHS:LOST] = 0
    if model.gravity_interval_ns > 0:
        extend_interval(interval, motion)
        if clock[NODE] - clock[OPENED] >= model.gravity_interval_ns:
            _correct_gravity(columns, model, x, P, n, clock, interval)
            open_interval(columns, model.dvl_p_imu, interval, clock)
    if model.is_planar:
        values = (model.plane_z_m, 0.0, 0.0)
        variances = (model.plane_z_variance, model.plane_tilt_variance, model.plane_tilt_variance)
        for k in range(3):
            _correct_state(x, P, n, 2 + k, values[k], variances[k])


@inlined
def extend_interval(interval: GravityInterval, motion: Integral) -> None:
    """Let the running interval reach one node further."""
    i_R_node, impulse = matrix(interval.i_R_node), interval.impulse
    impulse[0], impulse[1], impulse[2] = transformed(vector(impulse), i_R_node, motion.impulse)
    place(product(i_R_node, motion.dR), interval.i_R_node, 0, 0)


@inlined
def _correct_gravity(
    columns: Columns, model: VehicleModel, x: Floats, P: Floats, n: int, clock: Ints, interval: GravityInterval
) -> None:
    """Correct roll and pitch, where the specific force was measured."""
    up, sigma = measured_up(columns, model, clock, interval)
    if math.isnan(sigma):
        return
    level = math.hypot(up[1], up[2])
    _correct_state(x, P, n, 3, math.atan2(up[1], up[2]), (sigma / level) ** 2)
    _correct_state(x, P, n, 4, math.atan2(-up[0], level), sigma**2)


@inlined
def measured_up(columns: Columns, model: VehicleModel, clock: Ints, interval: GravityInterval) -> tuple[Floats, float]:
    """The world's up at the node, from the running interval, and the sigma of its tilt (rad); NaN: not measured."""
    duration_s = (clock[NODE] - clock[OPENED]) * 1e-9
    velocity = _velocity_at_node(columns, clock[NODE], model.dvl_p_imu)
    mean_force = interval.impulse / duration_s
    up = up_direction(mean_force, interval.i_R_node, interval.velocity[:3], velocity[:3], duration_s)
    if not np.isfinite(up).all():
        return up, math.nan
    velocity_sigma = math.sqrt(0.5 * (velocity[3] + interval.velocity[3]))
    sigma = tilt_sigma(
        duration_s,
        velocity_sigma,
        model.accel_noise_density,
        model.accel_bias_sigma,
        model.gyro_noise_density,
        model.gyro_bias_sigma,
        model.gravity_m_s2,
    )
    return up, sigma


@inlined
def _correct_state(x: Floats, P: Floats, n: int, at: int, value: float, variance: float) -> None:
    """Correct by a direct measurement of Z or of an angle."""
    innovation = value - x[at] if at < 3 else wrap_angle(value - x[at])
    correct(x, P, n, P[at, :n].copy(), P[at, at] + variance, innovation)


@inlined
def correct_depth(x: Floats, P: Floats, n: int, motion: Integral, port: Vector, z_m: float, variance_m2: float) -> None:
    """Correct by the height of the pressure port, ``(X + R s)_z`` with ``s = dp + dR port``: row(n, s) along up."""
    moment = moment_after(x, motion)
    s = transformed(motion.dp, motion.dR, port)
    row = row_along(moment, moment.R[2], s)
    U = np.zeros(n)
    add_covariances(P, n, 0, row.by_X, U)
    add_covariances(P, n, 3, row.by_angles, U)
    S = dot(row.by_X, vector(U)) + dot(row.by_angles, vector(U[3:])) + motion_covariance(motion, row, row) + variance_m2
    correct(x, P, n, U, S, z_m - x[2] - dot(moment.R[2], s))
