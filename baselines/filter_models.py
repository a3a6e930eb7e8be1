"""What the filters take from a calibration: the sensors that move the state, and the sonar.

Compiled code gets a model as the plain tuple of its fields, which enters faster, and makes it anew.
"""

from __future__ import annotations

from typing import NamedTuple

from pydantic import Field

from sonar_graph.calibration import Calibration, Section
from sonar_graph.navigation.earth import earth_rate_in_world
from sonar_graph.navigation.gap_motion import NO_GAPS, GapValues, gap_values
from sonar_graph.navigation.triples import ZERO, Matrix, Vector, matrix, minus, vector
from sonar_graph.slam.association import gate_threshold


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
