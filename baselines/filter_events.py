"""The clock of a filter: integers that compiled code writes to.

The direction of the world's up in the body, from the specific force over an interval between two nodes.

Over about a second the specific force less the change of the Doppler velocity is that of gravity
(`sonar_graph.navigation.alignment.gravity`). Both filters measure it so; how it corrects a state is their own.

The order of events in a window of measurements, the same for both filters.

Events happen in the order of their stamps: first all nodes that are reached by then, then the depth sample or the
detections of a sonar frame, at a provisional motion from the newest node. At equal stamps depth comes first. Nodes are
the stamps of the Doppler log (`sonar_graph.navigation.odometry`).

Measurements that are related to the state over the same gap of the Doppler log are counted, those of depth and those of
landmarks each for themselves: `baselines.filter_motion.inflate_shared_motion`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from baselines.filter_inputs import DetectionColumns, DetectionOutcomes, Frame, SonarValues, VehicleModel, VehicleValues
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation import rows_until, value_at
from sonar_graph.navigation.alignment import tilt_sigma, up_direction
from sonar_graph.navigation.preintegration import Columns, Integral
from sonar_graph.numerics import (
    IDENTITY,
    Vector,
    compiled,
    cross,
    inlined,
    matrix,
    place,
    plus,
    product,
    transformed,
    vector,
)

NODE, OPENED, DEPTHS, SIGHTINGS, LOST = 0, 1, 2, 3, 4
"""Places in the clock: stamp of the state, stamp at which the running gravity interval began, how many depth samples
and detections were used since the Doppler log lost the bottom, and whether it ever did (0 or 1)."""
CLOCK = 5
"""Numbers of the clock."""


@inlined
def reach_node(clock: Ints, node_ns: int) -> None:
    """The state is at a node; what was told over a gap before it counts no longer."""
    clock[NODE] = node_ns
    clock[DEPTHS:LOST] = 0


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


DepthColumns = tuple[Ints, Floats, Floats]
"""Stamps in ns, heights of the port in m, variances in m² (NaN where the log does not say), each (m,)."""
PoseArrays = tuple[Floats, Floats, Floats]
"""world_R_body (3, 3), position (3,), covariance of [theta, rho] (6, 6)."""
END, NODE_REACHED, DEPTH, FRAME = 0, 1, 2, 3
"""Kinds of events."""


class MeasurementWindow(NamedTuple):
    """What a filter is to take in, and how far."""

    columns: Columns
    """Rows of `Odometry.columns`."""
    vehicle: VehicleValues
    sonar: SonarValues
    clock: Ints
    """Changed, as is the gravity interval."""
    interval: GravityValues
    depth: DepthColumns
    """Samples from the state's stamp up to ``until_ns``, in order."""
    frame_ns: Ints
    """A stamp for each detection, from the state's up to ``until_ns``, in order."""
    detections: DetectionColumns
    until_ns: int


WindowValues = tuple[
    Columns, VehicleValues, SonarValues, Ints, GravityValues, DepthColumns, Ints, DetectionColumns, int
]
"""Fields of a `Window`; plain tuples enter compiled code faster."""


class Stamps(NamedTuple):
    """When what comes in was measured, each (m,), in ns, and how far the window goes."""

    imu_ns: Ints
    dvl_ns: Ints
    depth_ns: Ints
    frame_ns: Ints
    until_ns: int


class Event(NamedTuple):
    """What happens next."""

    kind: int
    stamp_ns: int
    samples: int
    """Depth samples so far, with this one where it is one."""
    first: int
    rows: int
    """Detections so far; those of a frame begin at ``first``."""
    times_told: int
    """How many measurements of this kind were related to the state over the present gap, with this one; 0: no gap."""


BEFORE_ALL = Event(END, 0, 0, 0, 0, 0)


@inlined
def stamps_of(window: MeasurementWindow) -> Stamps:
    """All that the order of events depends on."""
    return Stamps(window.columns[0], window.columns[3], window.depth[0], window.frame_ns, window.until_ns)


@inlined
def next_event(stamps: Stamps, clock: Ints, longest_ns: int, done: Event) -> Event:
    """The event after another one; counts in the clock what is told over a gap.

    Parameters
    ----------
    longest_ns
        Without Doppler log; what is longer is a gap.
    """
    samples, rows, times_told = done.samples, done.rows, 0
    kind, stamp_ns = _next_measurement(stamps, samples, rows)
    node_ns = _next_node(stamps, clock[NODE], stamp_ns)
    if node_ns >= 0:
        kind, stamp_ns = NODE_REACHED, node_ns
    is_gap = int(stamp_ns - clock[NODE] > longest_ns)
    clock[LOST] |= is_gap
    if kind == DEPTH:
        samples += 1
        clock[DEPTHS] += is_gap
        times_told = is_gap * clock[DEPTHS]
    elif kind == FRAME:
        while rows < len(stamps.frame_ns) and stamps.frame_ns[rows] == stamp_ns:
            rows += 1
        clock[SIGHTINGS] += is_gap * (rows - done.rows)
        times_told = is_gap * clock[SIGHTINGS]
    return Event(kind, stamp_ns, samples, done.rows, rows, times_told)


@inlined
def _next_measurement(stamps: Stamps, samples: int, rows: int) -> tuple[int, int]:
    """Kind and stamp of the first measurement that is left."""
    kind, stamp_ns = END, stamps.until_ns
    if rows < len(stamps.frame_ns):
        kind, stamp_ns = FRAME, stamps.frame_ns[rows]
    if samples < len(stamps.depth_ns) and stamps.depth_ns[samples] <= stamp_ns:
        kind, stamp_ns = DEPTH, stamps.depth_ns[samples]
    return kind, stamp_ns


@inlined
def _next_node(stamps: Stamps, node_ns: int, until_ns: int) -> int:
    """The first node after one instant, when it is reached at another; else -1."""
    imu_ns, dvl_ns = stamps.imu_ns, stamps.dvl_ns
    k, seen = rows_until(dvl_ns, node_ns), rows_until(imu_ns, until_ns)
    if k == len(dvl_ns) or seen == 0 or dvl_ns[k] > min(until_ns, imu_ns[seen - 1]):
        return -1
    return int(dvl_ns[k])


@inlined
def depth_sample(depth: DepthColumns, event: Event, vehicle: VehicleModel) -> tuple[float, float]:
    """Height of the pressure port in m and its variance, as logged or the calibration's, m²."""
    _, z_m, variance_m2 = depth
    row = event.samples - 1
    return z_m[row], vehicle.depth_variance_m2 if np.isnan(variance_m2[row]) else variance_m2[row]


@inlined
def frame_at(detections: DetectionColumns, event: Event, told: DetectionOutcomes, clock: Ints) -> Frame:
    """The detections of a frame."""
    return Frame(detections, event.first, event.rows, told, clock[LOST] > 0)
