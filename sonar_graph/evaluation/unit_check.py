"""Units that a log's numbers can hardly be in: read as said, no vehicle moves like that.

Where a factor between common units makes them plausible, it is named with the line that says so to the reader of the
log. A slow vehicle's rates in degrees can pass for a lively one's in radians: nothing found is no proof.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.logs.adapters.config import LogConfig
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.sequence import Sequence

FASTEST_M_S = 20.0
"""No vehicle with a Doppler log over the bottom keeps such a speed for a twentieth of a log."""
FASTEST_TURN_RAD_S = 2.0
"""Nor such a rate, 115 degrees a second."""
SPEEDS = {"cm/s": 1e-2, "mm/s": 1e-3}
"""Factor to m/s."""
FORCES = {"g": 9.80665, "mg": 9.80665e-3, "cm/s²": 1e-2, "mm/s²": 1e-3}
"""Factor to m/s²; mg and cm/s² differ by a fiftieth, so that the nearest counts."""
SHARE_OF_GRAVITY = 0.2
"""By which a typical specific force may differ from gravity."""
USUAL_SPEED_M_S = 3.0
HIGH_PERCENTILE = 95.0


class WrongUnit(NamedTuple):
    """What looks wrong, and what to write where."""

    quantity: str
    advice: str


def wrong_units(sequence: Sequence, config: LogConfig) -> list[WrongUnit]:
    """Velocities, rates and specific forces in another unit than they are read in.

    Parameters
    ----------
    sequence
        As a run would read it.
    config
        With which it was read: its scales are taken over into the advice.
    """
    found = [
        _of_speed(sequence.dvl, config),
        _of_rate(sequence.imu, config),
        _of_force(sequence.imu, sequence.calibration, config),
    ]
    return [fault for fault in found if fault is not None]


def _of_speed(dvl: Dvl, config: LogConfig) -> WrongUnit | None:
    high = _high(dvl.velocity)
    if high <= FASTEST_M_S:
        return None
    unit = next((unit for unit, factor in SPEEDS.items() if high * factor <= USUAL_SPEED_M_S), "mm/s")
    scale = float(config.table("dvl").get("scale", 1.0)) * SPEEDS[unit]
    return WrongUnit(
        "DVL: unit",
        f"velocities look {1 / SPEEDS[unit]:.0f} times too large (up to {high:.3g} m/s): {unit}? "
        f"`scale = {scale:.4g}` under [dvl] in the log configuration",
    )


def _of_rate(imu: Imu, config: LogConfig) -> WrongUnit | None:
    high = _high(imu.angular_velocity)
    if high <= FASTEST_TURN_RAD_S:
        return None
    scale = float(config.table("imu").get("angular_velocity_scale", 1.0)) * np.radians(1.0)
    return WrongUnit(
        "gyro: unit",
        f"rates look 57 times too large (up to {high:.3g} rad/s): degrees a second? "
        f"`angular_velocity_scale = {scale:.5g}` under [imu] in the log configuration",
    )


def _of_force(imu: Imu, calibration: Calibration, config: LogConfig) -> WrongUnit | None:
    lengths = _lengths(imu.specific_force)
    if not len(lengths):
        return None
    typical, gravity = float(np.median(lengths)), calibration.gravity_m_s2
    unit = min(FORCES, key=lambda unit: abs(typical * FORCES[unit] - gravity))
    if abs(typical * FORCES[unit] / gravity - 1) > SHARE_OF_GRAVITY:
        return None
    scale = float(config.table("imu").get("linear_acceleration_scale", 1.0)) * FORCES[unit]
    return WrongUnit(
        "accelerometer: unit",
        f"specific forces are typically {typical:.4g} instead of {gravity:.4g} m/s²: {unit}? "
        f"`linear_acceleration_scale = {scale:.6g}` under [imu] in the log configuration",
    )


def _high(vectors: Floats) -> float:
    """What is exceeded by a twentieth of them only: spikes do not count."""
    lengths = _lengths(vectors)
    return float(np.percentile(lengths, HIGH_PERCENTILE)) if len(lengths) else 0.0


def _lengths(vectors: Floats) -> Floats:
    """Of the rows that were measured."""
    return np.asarray(np.linalg.norm(vectors[np.isfinite(vectors).all(axis=1)], axis=1))
