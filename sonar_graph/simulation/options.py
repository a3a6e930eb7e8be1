"""Options of every simulated run, and presets of its sensors from data sheets.

The sensors of the paper's vehicle are not published; similar vehicles carry these.

==========  ==============  =====================  ==============  ====================  ==========
IMU         gyro bias       gyro white noise       accel bias      accel white noise     rate
==========  ==============  =====================  ==============  ====================  ==========
hg1700      1 °/h           0.125 °/√h             1 mg            0.065 ft/s/√h         100 Hz
mti1        10 °/h          0.007 °/s/√Hz          1 mg (ours)     120 µg/√Hz            100 Hz
==========  ==============  =====================  ==============  ====================  ==========

The random walks of the gyro biases are ours: over 2000 s they add a tenth of the initial bias.
Sources: IS4S NavToolkit (Honeywell HG1700), Xsens MTi-1 data sheet, Field Robotics DAVE (Teledyne DVLs).
"""

from dataclasses import dataclass
from typing import Literal

from pydantic import ConfigDict, Field

from sonar_graph.calibration import STANDARD_GRAVITY, ImuCalibration, Section

ImuName = Literal["hg1700", "mti1"]
DvlName = Literal["workhorse", "explorer"]
IMU_RATE_HZ = 100.0
DEPTH_RATE_HZ = 10.0
DEG = 0.017453292519943295
DEG_PER_HOUR = DEG / 3600
DEG_PER_SQRT_HOUR = DEG / 60
IMU_PRESETS: dict[ImuName, ImuCalibration] = {
    "hg1700": ImuCalibration(
        gyro_noise_density=0.125 * DEG_PER_SQRT_HOUR,
        gyro_bias_sigma=1 * DEG_PER_HOUR,
        gyro_bias_walk_density=1e-8,
        accel_noise_density=0.065 * 0.3048 / 60,
        accel_bias_sigma=1e-3 * STANDARD_GRAVITY,
    ),
    "mti1": ImuCalibration(
        gyro_noise_density=0.007 * DEG,
        gyro_bias_sigma=10 * DEG_PER_HOUR,
        gyro_bias_walk_density=1e-7,
        accel_noise_density=120e-6 * STANDARD_GRAVITY,
        accel_bias_sigma=1e-3 * STANDARD_GRAVITY,
    ),
}


@dataclass(frozen=True)
class DvlPreset:
    """A Doppler velocity log."""

    velocity_sigma_m_s: float
    """White noise of one velocity sample along each axis."""
    rate_hz: float


DVL_PRESETS: dict[DvlName, DvlPreset] = {
    "workhorse": DvlPreset(velocity_sigma_m_s=0.005, rate_hz=7.0),
    "explorer": DvlPreset(velocity_sigma_m_s=0.018, rate_hz=12.0),
}


class SimulationOptions(Section):
    """Sensors and their faults, and how often the landmark recogniser is right."""

    model_config = ConfigDict(allow_inf_nan=False)

    seed: int = Field(0, ge=0)
    """Of everything random; equal options give equal bits."""
    imu: ImuName = "hg1700"
    """IMU preset."""
    dvl: DvlName = "workhorse"
    """Doppler log preset."""
    gyro_bias_scale: float = Field(1.0, ge=0)
    """Times the preset's gyro bias and its random walk; 0: none, and estimators know it."""
    accel_bias_scale: float = Field(1.0, ge=0)
    """Times the preset's accelerometer bias; 0: none, and estimators know it."""
    dvl_scale_error: float = Field(0.0, gt=-0.5, lt=0.5)
    """Relative error of all velocities (0.007 reads 0.7 % too fast); estimators do not know it."""
    dvl_dropouts_per_hour: float = Field(0.0, ge=0)
    """Losses of bottom lock."""
    dvl_dropout_s: float = Field(3.0, gt=0)
    """How long each loss lasts."""
    frame_rate_hz: float = Field(5.0, gt=0, le=30)
    """Sonar frames a second."""
    range_sigma_m: float = Field(0.015, gt=0)
    """White noise of a detection's range."""
    azimuth_sigma_rad: float = Field(0.007, gt=0)
    """White noise of a detection's azimuth (0.4 degrees)."""
    detection_probability: float = Field(0.9, ge=0, le=1)
    """Of a landmark inside the fan, in each frame."""
    wrong_id_rate: float = Field(0.0, ge=0, le=1)
    """Share of the detected landmarks taken confidently for another one; with ``tracks``, share of the tracks."""
    tracks: bool = False
    """Whether the recogniser watches landmarks over frames: detections then carry the number of their track."""
    id_delay_s: float = Field(0.0, ge=0)
    """With ``tracks``: nothing is believed of a track until it is that old."""
    wrong_id_share: float = Field(0.5, ge=0, le=1)
    """With ``tracks``: share of a track, once something is believed, in which a wrong identity is; 1: to its end."""
    anonymous_share: float = Field(0.0, ge=0, le=1)
    """Share of all detections, false ones as well, that come without any identity."""
    false_detections_per_frame: float = Field(0.02, ge=0)
    """Mean number of detections of nothing."""
    confident_false_fraction: float = Field(0.0, ge=0, le=1)
    """Share of the false detections taken confidently for a landmark."""
    start_position_sigma_m: float = Field(0.01, gt=0)
    """The start which estimators are given is drawn about the true one with this sigma on each axis."""
    start_rotation_sigma_rad: float = Field(0.005, gt=0)
    """The same for its rotation, about each body axis."""
    floor_sigma_m: float = Field(0.01, gt=0)
    """Landmark heights are drawn about the floor with this sigma, and estimators know it."""
