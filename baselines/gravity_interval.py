"""The direction of the world's up in the body, from the specific force over an interval between two nodes.

Over about a second the specific force less the change of the Doppler velocity is that of gravity
(`sonar_graph.navigation.alignment`). Both filters measure it so; how it corrects a state is their own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from baselines.filter_clock import NODE, OPENED
from baselines.filter_models import VehicleModel
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.alignment import tilt_sigma, up_direction
from sonar_graph.navigation.interpolation import rows_until, value_at
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.recursion import Integral
from sonar_graph.navigation.steps import Columns
from sonar_graph.navigation.triples import (
    IDENTITY,
    Vector,
    cross,
    matrix,
    place,
    plus,
    product,
    transformed,
    vector,
)

UP: Vector = (0.0, 0.0, 1.0)


class GravityInterval(NamedTuple):
    """What has run up since the last use of gravity."""

    i_R_node: Floats
    """Rotation since the interval began, shape (3, 3)."""
    impulse: Floats
    """Integral of the specific force in the interval's first frame, shape (3,), m/s."""
    velocity: Floats
    """Of the IMU's point when it began, shape (3,), and the variance of one component: shape (4,)."""


GravityValues = tuple[Floats, Floats, Floats]
"""Fields of a `GravityInterval`."""


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
def up_at_node(
    columns: Columns, vehicle: VehicleModel, motion: Integral, clock: Ints, interval: GravityInterval
) -> tuple[Vector, float]:
    """The world's up at the node that a motion has led to, and the sigma of its tilt (rad).

    NaN: not measured there, or the interval is to go on.
    """
    if vehicle.gravity_interval_ns <= 0:
        return UP, math.nan
    _extend(interval, motion)
    if clock[NODE] - clock[OPENED] < vehicle.gravity_interval_ns:
        return UP, math.nan
    up, sigma = _measured_up(columns, vehicle, clock, interval)
    open_interval(columns, vehicle.dvl_p_imu, interval, clock)
    return up, sigma


@inlined
def _extend(interval: GravityInterval, motion: Integral) -> None:
    """Let the running interval reach one node further."""
    i_R_node, impulse = matrix(interval.i_R_node), interval.impulse
    impulse[0], impulse[1], impulse[2] = transformed(vector(impulse), i_R_node, motion.impulse)
    place(product(i_R_node, motion.dR), interval.i_R_node, 0, 0)


@inlined
def _measured_up(
    columns: Columns, vehicle: VehicleModel, clock: Ints, interval: GravityInterval
) -> tuple[Vector, float]:
    """From the running interval; NaN: the specific force was not measured all along."""
    duration_s = (clock[NODE] - clock[OPENED]) * 1e-9
    velocity = _velocity_at_node(columns, clock[NODE], vehicle.dvl_p_imu)
    mean_force = interval.impulse / duration_s
    up = up_direction(mean_force, interval.i_R_node, interval.velocity[:3], velocity[:3], duration_s)
    if not np.isfinite(up).all():
        return UP, math.nan
    velocity_sigma = math.sqrt(0.5 * (velocity[3] + interval.velocity[3]))
    sigma = tilt_sigma(
        duration_s,
        velocity_sigma,
        vehicle.accel_noise_density,
        vehicle.accel_bias_sigma,
        vehicle.gyro_noise_density,
        vehicle.gyro_bias_sigma,
        vehicle.gravity_m_s2,
    )
    return vector(up), sigma
