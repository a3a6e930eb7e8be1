"""Window of measurements as compiled code sees it: vehicle model, rows, clock, and the order of events.

Events happen in the order of their stamps: first all epochs reached by then, then the depth sample or the detections of
a sonar frame, a provisional motion after the newest epoch. At equal stamps depth comes first. Epochs are the stamps of
the Doppler log (`sonar_graph.navigation.Odometry`).

Depth samples and detections that are related to the state over the same gap of the Doppler log are counted
(`baselines.filter_motion.inflate_shared_motion`).
"""

from typing import NamedTuple

import numpy as np
from pydantic import Field

from baselines.sonar_update import DetectionColumns, DetectionOutcomes, Frame, SonarValues
from sonar_graph.calibration import Calibration, Section
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation import rows_until
from sonar_graph.navigation.alignment import earth_rate_in_world
from sonar_graph.navigation.preintegration import NO_GAPS, Columns, GapValues, gap_values
from sonar_graph.numerics import ZERO, Vector, inlined, minus, vector


class FilterParams(Section):
    """Settings of both filters; the paper gives none of them."""

    gate_probability: float = Field(0.999, gt=0, le=1)
    """Probability with which a right detection passes the gate (chi-square); 1: no gate."""
    minimum_id_probability: float = Field(0.5, ge=0, le=1)
    """Least posterior of the most probable identity with which a detection is used."""
    gravity_interval_s: float = Field(1.0, gt=0)
    """Time over which the specific force is averaged for one correction of roll and pitch."""


class VehicleModel(NamedTuple):
    """Mountings and noise of gyros, accelerometers, Doppler log and depth sensor, and the plane of planar motion."""

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
    """Used in gaps and for gravity only, rad/s."""
    depth_variance_m2: float = 1.0
    """Of a depth sample, used where the log has none."""


VehicleValues = tuple[
    float, Vector, Vector, Vector, Vector, int, float, float, float, bool, float, float, float, GapValues, float, float
]
"""Fields of a `VehicleModel`: plain tuples enter compiled code faster."""


def vehicle_model(calibration: Calibration, gravity_interval_s: float) -> VehicleModel:
    """The model of a calibration."""
    imu, dvl = calibration.imu, calibration.dvl
    body_p_dvl = dvl.mounting.translation_m
    plane = calibration.planar
    earth_rate = earth_rate_in_world(calibration)
    return VehicleModel(
        gyro_noise_density=imu.gyro_noise_density,
        body_p_dvl=body_p_dvl,
        dvl_p_imu=minus(imu.mounting.translation_m, body_p_dvl),
        earth_rate=ZERO if earth_rate is None else vector(earth_rate),
        body_p_port=calibration.depth.port_m,
        gravity_interval_ns=round(gravity_interval_s * 1e9) if calibration.use_gravity else 0,
        accel_noise_density=imu.accel_noise_density,
        accel_bias_sigma=imu.accel_bias_sigma,
        gravity_m_s2=calibration.gravity_m_s2,
        is_planar=plane is not None,
        plane_z_m=plane.z_m if plane else 0.0,
        plane_z_variance=plane.z_sigma_m**2 if plane else 1.0,
        plane_tilt_variance=plane.tilt_sigma_rad**2 if plane else 1.0,
        gap=gap_values(calibration),
        gyro_bias_sigma=imu.gyro_bias_sigma,
        depth_variance_m2=calibration.depth.sigma_m**2,
    )


NODE, OPENED, DEPTHS, SIGHTINGS, LOST = 0, 1, 2, 3, 4
"""Indices of the clock, integers that compiled code changes: stamp of the epoch, stamp at which the gravity interval
began, number of depth samples and of detections in the present gap of the Doppler log, and 1 once it has had a gap."""
CLOCK = 5
"""Length of the clock."""


@inlined
def reach_node(clock: Ints, node_ns: int) -> None:
    """Set the state's stamp and forget the counts of the gap before it."""
    clock[NODE] = node_ns
    clock[DEPTHS:LOST] = 0


class GravityInterval(NamedTuple):
    """Sums over the interval since gravity was last used."""

    i_R_node: Floats
    """Rotation since the interval began, shape (3, 3)."""
    impulse: Floats
    """Integral of the specific force in the interval's first frame, shape (3,), m/s."""
    velocity: Floats
    """Velocity of the IMU at the beginning and the variance of one component, shape (4,)."""


GravityValues = tuple[Floats, Floats, Floats]
"""Fields of a `GravityInterval`."""

DepthColumns = tuple[Ints, Floats, Floats]
"""Stamps in ns, heights of the port in m, variances in m² (NaN where the log has none), each (m,)."""
PoseArrays = tuple[Floats, Floats, Floats]
"""world_R_body (3, 3), position (3,), covariance of [theta, rho] (6, 6)."""
END, NODE_REACHED, DEPTH, FRAME = 0, 1, 2, 3
"""Kinds of events."""


class MeasurementWindow(NamedTuple):
    """Measurements that a filter is to use, up to an instant."""

    columns: Columns
    """Rows of `Odometry.columns`."""
    vehicle: VehicleValues
    sonar: SonarValues
    clock: Ints
    """Changed, as the gravity interval is."""
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
"""Fields of a `MeasurementWindow`."""


class Stamps(NamedTuple):
    """Stamps of all rows of a window, each (m,), in ns, and its end."""

    imu_ns: Ints
    dvl_ns: Ints
    depth_ns: Ints
    frame_ns: Ints
    until_ns: int


class Event(NamedTuple):
    """An epoch, a depth sample, the detections of a frame, or the end of the window."""

    kind: int
    stamp_ns: int
    samples: int
    """Depth samples so far, including this event."""
    first: int
    rows: int
    """Detections so far; those of this frame begin at ``first``."""
    count_in_gap: int
    """Measurements of this kind in the present gap of the Doppler log, including this one; 0: no gap."""


BEFORE_ALL = Event(END, 0, 0, 0, 0, 0)


@inlined
def stamps_of(window: MeasurementWindow) -> Stamps:
    """Stamps of a window."""
    return Stamps(window.columns[0], window.columns[3], window.depth[0], window.frame_ns, window.until_ns)


@inlined
def next_event(stamps: Stamps, clock: Ints, longest_ns: int, done: Event) -> Event:
    """The event after another one; counts measurements in a gap on the clock.

    ``longest_ns``: a longer time without Doppler log is a gap.
    """
    samples, rows, count_in_gap = done.samples, done.rows, 0
    kind, stamp_ns = END, stamps.until_ns
    if rows < len(stamps.frame_ns):
        kind, stamp_ns = FRAME, stamps.frame_ns[rows]
    if samples < len(stamps.depth_ns) and stamps.depth_ns[samples] <= stamp_ns:
        kind, stamp_ns = DEPTH, stamps.depth_ns[samples]
    imu_ns, dvl_ns = stamps.imu_ns, stamps.dvl_ns
    k, imu_rows = rows_until(dvl_ns, clock[NODE]), rows_until(imu_ns, stamp_ns)
    if k < len(dvl_ns) and imu_rows > 0 and dvl_ns[k] <= min(stamp_ns, imu_ns[imu_rows - 1]):
        kind, stamp_ns = NODE_REACHED, dvl_ns[k]
    is_gap = int(stamp_ns - clock[NODE] > longest_ns)
    clock[LOST] |= is_gap
    if kind == DEPTH:
        samples += 1
        clock[DEPTHS] += is_gap
        count_in_gap = is_gap * clock[DEPTHS]
    elif kind == FRAME:
        while rows < len(stamps.frame_ns) and stamps.frame_ns[rows] == stamp_ns:
            rows += 1
        clock[SIGHTINGS] += is_gap * (rows - done.rows)
        count_in_gap = is_gap * clock[SIGHTINGS]
    return Event(kind, stamp_ns, samples, done.rows, rows, count_in_gap)


@inlined
def depth_sample(depth: DepthColumns, event: Event, vehicle: VehicleModel) -> tuple[float, float]:
    """Height of the pressure port in m, and its variance in m² from the log or else from the calibration."""
    _, z_m, variance_m2 = depth
    row = event.samples - 1
    return z_m[row], vehicle.depth_variance_m2 if np.isnan(variance_m2[row]) else variance_m2[row]


@inlined
def frame_at(detections: DetectionColumns, event: Event, outcomes: DetectionOutcomes, clock: Ints) -> Frame:
    """The detections of a frame."""
    return Frame(detections, event.first, event.rows, outcomes, clock[LOST] > 0)
