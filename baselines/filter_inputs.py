"""What the filters take from a calibration: the sensors that move the state, and the sonar.

Compiled code gets a model as the plain tuple of its fields, which enters faster, and makes it anew.

Detections of landmarks in the compiled code of both filters: what comes in, what is said of each, and the gate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from pydantic import Field

from sonar_graph.calibration import Calibration, Section
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.alignment import earth_rate_in_world
from sonar_graph.navigation.preintegration import NO_GAPS, GapValues, gap_values
from sonar_graph.numerics import ZERO, Matrix, Vector, compiled, inlined, matrix, minus, vector
from sonar_graph.slam.landmarks import gate_threshold


class FilterParams(Section):
    """Settings of a filter; the paper of EKF-SLAM gives none of them."""

    gate_probability: float = Field(0.999, gt=0, le=1)
    """Share of true innovations that the gate lets pass; 1: no gate."""
    minimum_id_probability: float = Field(0.5, ge=0, le=1)
    """Posterior below which an identity is not believed."""
    gravity_interval_s: float = Field(1.0, gt=0)
    """Over which the specific force is averaged for one correction of roll and pitch."""


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
    depth_variance_m2: float = 1.0
    """Of a depth sample, where the log does not say."""


class SonarModel(NamedTuple):
    """What is known of sonar and floor."""

    body_R_sonar: Matrix
    body_p_sonar: Vector
    gate: float
    """Squared Mahalanobis distance beyond which an innovation is refused."""
    aperture_rad: float
    range_variance_m2: float
    """Where the log does not say."""
    azimuth_variance: float
    """Where the log does not say, rad²."""
    has_floor: bool
    floor_z_m: float
    floor_variance_m2: float


VehicleValues = tuple[
    float, Vector, Vector, Vector, Vector, int, float, float, float, bool, float, float, float, GapValues, float, float
]
"""Fields of a `VehicleModel`."""
SonarValues = tuple[Matrix, Vector, float, float, float, float, bool, float, float]
"""Fields of a `SonarModel`."""


def vehicle_model(calibration: Calibration, gravity_interval_s: float) -> VehicleModel:
    """Gyros, Doppler log, accelerometers, pressure port and plane."""
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


def sonar_model(calibration: Calibration, gate_probability: float) -> SonarModel:
    """Sonar, gate and floor."""
    body_T_sonar = calibration.sonar.mounting.pose()
    floor = calibration.floor
    return SonarModel(
        body_R_sonar=matrix(body_T_sonar.rotation().matrix()),
        body_p_sonar=calibration.sonar.mounting.translation_m,
        gate=gate_threshold(gate_probability, 2),
        aperture_rad=calibration.sonar.elevation_aperture_rad,
        range_variance_m2=calibration.sonar.range_sigma_m**2,
        azimuth_variance=calibration.sonar.azimuth_sigma_rad**2,
        has_floor=floor is not None,
        floor_z_m=floor.z_m if floor else 0.0,
        floor_variance_m2=floor.sigma_m**2 if floor else 1.0,
    )


USED, NEW, GATED, PASSED_OVER = 0, 1, 2, 3
"""What became of a detection, in compiled code."""
NO_SLOT = -1
"""The place of a detection that is not to be used."""
DetectionColumns = tuple[Ints, Floats, Floats, Floats]
"""Place of each row's landmark in the state, the first unused one for a new landmark, or NO_SLOT (m,); range in m and
azimuth in rad (m,); their covariance (m, 2, 2), NaN where the log does not say."""
DetectionOutcomes = tuple[Ints, Floats, Floats]
"""USED, NEW, GATED or PASSED_OVER (m,); innovations (m, 2), their covariances (m, 2, 2): NaN without prediction."""
Noise = tuple[float, float, float]
"""Variance of the range, covariance, variance of the azimuth."""


class Frame(NamedTuple):
    """The detections of one instant, among those of a window."""

    detections: DetectionColumns
    first: int
    last: int
    """Rows from the first up to, without, the last."""
    told: DetectionOutcomes
    """Written at these rows."""
    was_lost: bool
    """Whether the Doppler log has lost the bottom: from then on views are linearised as in
    `baselines.sonar_update`, where
    it takes that."""


class DetectionRow(NamedTuple):
    """One detection, and where to write what was expected of it."""

    slot: int
    z: tuple[float, float]
    """Range in m and azimuth in rad."""
    R_z: Noise
    innovation: Floats
    """Shape (2,)."""
    S: Floats
    """Covariance of the innovation, shape (2, 2)."""


@compiled
def nothing_told(rows: int) -> DetectionOutcomes:
    """Room for what becomes of some detections."""
    return np.empty(rows, np.int64), np.full((rows, 2), np.nan), np.full((rows, 2, 2), np.nan)


@inlined
def sighting(frame: Frame, row: int, sonar: SonarModel) -> DetectionRow:
    """A row of a frame; its noise as logged, or the calibration's."""
    slots, range_m, azimuth_rad, noise = frame.detections
    z, R_z = (range_m[row], azimuth_rad[row]), _logged_noise(noise[row], sonar)
    return DetectionRow(slots[row], z, R_z, frame.told[1][row], frame.told[2][row])


@inlined
def _logged_noise(logged: Floats, sonar: SonarModel) -> Noise:
    if math.isnan(logged[0, 0] + logged[0, 1] + logged[1, 0] + logged[1, 1]):
        return sonar.range_variance_m2, 0.0, sonar.azimuth_variance
    return logged[0, 0], 0.5 * (logged[0, 1] + logged[1, 0]), logged[1, 1]


@inlined
def is_inside_gate(seen: DetectionRow, sonar: SonarModel) -> bool:
    """Whether ``e^T S^-1 e`` of the innovation written is no more than the gate."""
    e, S = seen.innovation, seen.S
    determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    squared = (S[1, 1] * e[0] * e[0] - (S[0, 1] + S[1, 0]) * e[0] * e[1] + S[0, 0] * e[1] * e[1]) / determinant
    return bool(squared <= sonar.gate)
