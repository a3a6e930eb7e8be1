"""The order of events in a window of measurements, the same for both filters.

Events happen in the order of their stamps: first all nodes that are reached by then, then the depth sample or the
detections of a sonar frame, at a provisional motion from the newest node. At equal stamps depth comes first. Nodes are
the stamps of the Doppler log (`sonar_graph.navigation.odometry`).

Measurements that are related to the state over the same gap of the Doppler log are counted, those of depth and those of
landmarks each for themselves: `baselines.ekf_motion.told_again`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.filter_clock import DEPTHS, LOST, NODE, SIGHTINGS
from baselines.filter_detections import DetectionColumns, DetectionOutcomes, Frame
from baselines.filter_models import SonarValues, VehicleModel, VehicleValues
from baselines.gravity_interval import GravityValues
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.interpolation import rows_until
from sonar_graph.navigation.kernels import inlined
from sonar_graph.navigation.steps import Columns

DepthColumns = tuple[Ints, Floats, Floats]
"""Stamps in ns, heights of the port in m, variances in m² (NaN where the log does not say), each (m,)."""
PoseArrays = tuple[Floats, Floats, Floats]
"""world_R_body (3, 3), position (3,), covariance of [theta, rho] (6, 6)."""

END, NODE_REACHED, DEPTH, FRAME = 0, 1, 2, 3
"""Kinds of events."""


class Window(NamedTuple):
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
def stamps_of(window: Window) -> Stamps:
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
