"""Sensors by name: data-sheet figures, and what is assumed where a sheet says nothing.

The vehicle's own sensors are not published. These are what similar vehicles carry.

==========  ==============  =====================  ==============  ====================  ==========
IMU         gyro bias       gyro white noise       accel bias      accel white noise     rate
==========  ==============  =====================  ==============  ====================  ==========
hg1700      1 °/h           0.125 °/√h             1 mg            0.065 ft/s/√h         100 Hz
mti1        10 °/h          0.007 °/s/√Hz          1 mg (ours)     120 µg/√Hz            100 Hz
==========  ==============  =====================  ==============  ====================  ==========

The random walks of the gyro biases are ours: over 2000 s they add a tenth of the initial bias.
Sources: IS4S NavToolkit (Honeywell HG1700), Xsens MTi-1 data sheet, Field Robotics DAVE (Teledyne DVLs).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sonar_graph.calibration import STANDARD_GRAVITY, ImuCalibration

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
