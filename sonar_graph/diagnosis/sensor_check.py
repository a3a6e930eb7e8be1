"""What a log's sensors say about each other: offsets, mounting, scale and noise, and whether to act on it.

The estimators are in `sonar_graph.navigation`, derived in docs/theory/sensor_check.md. Here each number meets what the
run would use (calibration and log configuration) and becomes a line to put into one of the two.

Units that a log's numbers can hardly be in: read as said, no vehicle moves like that.

Where a factor between common units makes them plausible, it is named with the line that says so to the reader of the
log. A slow vehicle's rates in degrees can pass for a lively one's in radians: nothing found is no proof.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, DvlCalibration, Start
from sonar_graph.diagnosis.findings import (
    NO_NEED,
    Finding,
    StartTilt,
    bias_findings,
    find_start_heading,
    find_start_tilt,
    in_degrees,
    lever_findings,
    matters,
    tilt_findings,
    with_fitted,
)
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.navigation.alignment import (
    DvlMatch,
    Estimate1D,
    Estimates3D,
    longest_rest,
    match_dvl_to_imu,
    match_reference_to_imu,
    noise_densities,
)
from sonar_graph.sequence import NS_PER_S, Sequence

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


LONGEST_S = 600.0
"""Compared over at most so long, in the middle of the log, which bounds the time: 240 s take about 1 s."""
LEAST_OFFSET_S = 0.01
LEAST_YAW_RAD = np.radians(0.25)
LEAST_SCALE = 0.002
LEAST_HEADING_RAD = np.radians(1.0)
"""What is smaller changes nothing that other errors would not hide."""
LARGEST_DENSITY_RATIO = 1.5
"""Densities further from the calibration's than this, either way, are worth a line."""
LARGEST_RESTING_M_S = 0.1
FROM_DRIVE = "from the turns of the drive"


def check_sensors(sequence: Sequence, config: LogConfig | None = None) -> list[Finding]:
    """Everything that can be told, in the order in which to act; wrong units alone, since they spoil the rest.

    Parameters
    ----------
    sequence
        As a run would read it.
    config
        With which it was read: corrections are added to what it says already.
    """
    config = config or LogConfig()
    faults = wrong_units(sequence, config)
    if faults:
        unknown = Estimate1D(np.nan, np.inf, "wrong unit")
        return [Finding(quantity, unknown, "", advice, acts=True) for quantity, advice in faults]
    match = match_dvl_to_imu(*_middle(sequence.imu, sequence.dvl), sequence.calibration)
    of_dvl = list(_of_dvl(match, sequence, config))
    lever = lever_findings(match, sequence.calibration)
    right = _put_right(sequence, match, of_dvl)
    tilt = find_start_tilt(right)
    bias = bias_findings(*_surest_bias(match, tilt), sequence.calibration.imu)
    return [*of_dvl, *lever, *bias, *_of_reference(right, config, tilt), *_of_noise(sequence)]


def _of_dvl(found: DvlMatch, sequence: Sequence, config: LogConfig) -> Iterator[Finding]:
    yield _offset("DVL against IMU", _as_sure_as_samples(found.offset, sequence.imu), "dvl", config)
    yaw_deg = in_degrees(found.yaw)
    if matters(found.yaw, LEAST_YAW_RAD):
        rpy = ", ".join(f"{angle:.4f}" for angle in _turned(sequence.calibration.dvl, found.yaw.value))
        advice = f"turn the DVL's mounting: `dvl.mounting.rpy_rad = [{rpy}]` in the calibration"
        yield Finding("DVL mounting yaw", yaw_deg, "°", advice, acts=True)
    else:
        yield Finding("DVL mounting yaw", yaw_deg, "°", NO_NEED)
    if matters(replace(found.scale, value=found.scale.value - 1), LEAST_SCALE):
        scale = float(config.table("dvl").get("scale", 1.0)) * found.scale.value
        advice = f"scale the DVL's velocities: `scale = {scale:.4f}` under [dvl] in the log configuration"
        yield Finding("DVL scale", found.scale, "", advice, acts=True)
    else:
        yield Finding("DVL scale", found.scale, "", NO_NEED)


def _put_right(sequence: Sequence, match: DvlMatch, of_dvl: list[Finding]) -> Sequence:
    """With what the rows before would change: the Doppler log's stamps, yaw and scale, lever arm, sigma of the bias."""
    late, turned, scaled = (finding.acts for finding in of_dvl)
    dvl, calibration = sequence.dvl, with_fitted(match, sequence.calibration)
    shift_ns = round(match.offset.value * NS_PER_S) if late else 0
    velocity = dvl.velocity * (match.scale.value if scaled else 1.0)
    if turned:
        rpy = _turned(calibration.dvl, match.yaw.value)
        mounting = calibration.dvl.mounting.model_copy(update={"rpy_rad": rpy})
        section = calibration.dvl.model_copy(update={"mounting": mounting})
        calibration = calibration.model_copy(update={"dvl": section})
    moved = Dvl(dvl.stamps_ns + shift_ns, velocity, dvl.velocity_cov)
    return replace(sequence, dvl=moved, calibration=calibration)


def _surest_bias(match: DvlMatch, tilt: StartTilt) -> tuple[Estimates3D, tuple[str, str, str]]:
    """Of the whole drive's and a rest's the surer one, axis by axis, and from which it is."""
    still = tilt.gyro_bias() or match.gyro_bias
    pairs = [
        (a, tilt.said) if tilt.is_rest and (not b.is_known or a.sigma < b.sigma) else (b, FROM_DRIVE)
        for a, b in zip(still, match.gyro_bias, strict=True)
    ]
    (x, of_x), (y, of_y), (z, of_z) = pairs
    return (x, y, z), (of_x, of_y, of_z)


def _of_reference(right: Sequence, config: LogConfig, tilt: StartTilt) -> Iterator[Finding]:
    """With the start's roll and pitch, whose line has the heading that the reference puts right."""
    start = right.calibration.start
    if right.truth is None:
        yield from tilt_findings(tilt, start, start.rpy_rad[2])
        return
    found = match_reference_to_imu(right.imu, right.truth, right.calibration)
    offset = _as_sure_as_samples(found.offset, right.imu)
    yield _offset("reference against IMU", offset, "truth", config)
    jump = in_degrees(found.start_heading)
    acts = matters(found.start_heading, LEAST_HEADING_RAD)
    advice = "the reference begins with a wrong heading: leave its beginning out with `--start`" if acts else NO_NEED
    yield Finding("first headings of the reference", jump, "°", advice, acts)
    is_compared = offset.is_known and start != Start()
    heading = find_start_heading(right, right.truth, offset) if is_compared else None
    yield from tilt_findings(tilt, start, heading.rpy_rad[2] if heading and heading.acts else start.rpy_rad[2])
    if heading:
        yield heading.finding(tilt)


def _of_noise(sequence: Sequence) -> Iterator[Finding]:
    found, imu, speed = noise_densities(sequence.imu), sequence.calibration.imu, _speed_in_rest(sequence)
    rest = f"from {found.still_s:.0f} s of rest"
    known = {
        "gyro noise density": ("gyro_noise_density", found.gyro, imu.gyro_noise_density, "rad/s/√Hz"),
        "accelerometer noise density": ("accel_noise_density", found.accel, imu.accel_noise_density, "m/s²/√Hz"),
    }
    for quantity, (field, measured, given, unit) in known.items():
        driving = measured.is_known and speed > LARGEST_RESTING_M_S
        estimate = (
            replace(measured, reason=f"{found.still_s:.0f} s are steady, but at {speed:.1f} m/s")
            if driving
            else measured
        )
        ratio = max(estimate.value / given, given / estimate.value) if estimate.value > 0 and given > 0 else np.inf
        acts = matters(replace(estimate, value=estimate.value - given), 0.0) and ratio > LARGEST_DENSITY_RATIO
        advice = f"{rest}; the calibration's {given:.2g} fits, no need to act"
        if acts:
            advice = (
                f"{rest}, not the calibration's {given:.2g}: `imu.{field} = {estimate.value:.2g}` in the calibration"
            )
        yield Finding(quantity, estimate, unit, advice, acts)


def _speed_in_rest(sequence: Sequence) -> float:
    """Of the Doppler log, m/s: a steady drive can be as quiet as a rest."""
    stamps_ns = sequence.imu.stamps_ns[longest_rest(sequence.imu)]
    during = sequence.dvl.between(int(stamps_ns[0]), int(stamps_ns[-1])) if len(stamps_ns) else None
    return 0.0 if during is None else float(np.median(np.linalg.norm(during.velocity, axis=1)))


def _offset(quantity: str, estimate: Estimate1D, role: str, config: LogConfig) -> Finding:
    if not matters(estimate, LEAST_OFFSET_S):
        return Finding(f"{quantity}: time offset", estimate, "s", NO_NEED)
    total_s = float(config.table(role).get("stamp_offset_s", 0.0)) + estimate.value
    advice = f"shift its stamps: `stamp_offset_s = {total_s:.3f}` under [{role}] in the log configuration"
    return Finding(f"{quantity}: time offset", estimate, "s", advice, acts=True)


def _as_sure_as_samples(offset: Estimate1D, imu: Imu) -> Estimate1D:
    """No surer than it is known what instant of its interval a sample of the IMU stands for (uniform)."""
    interval_s = float(np.median(np.diff(imu.stamps_ns))) / NS_PER_S if len(imu) > 1 else 0.0
    return replace(offset, sigma=float(np.hypot(offset.sigma, interval_s / np.sqrt(12))))


def _turned(dvl: DvlCalibration, yaw_rad: float) -> tuple[float, float, float]:
    """Roll, pitch, yaw of the mounting after a turn about the body's z axis."""
    before = Rotation.from_euler("ZYX", dvl.mounting.rpy_rad[::-1])
    yaw, pitch, roll = (Rotation.from_euler("z", yaw_rad) * before).as_euler("ZYX").tolist()
    return roll, pitch, yaw


def _middle(imu: Imu, dvl: Dvl) -> tuple[Imu, Dvl]:
    """The middle of a long log."""
    first_ns = max(imu.stamps_ns[0], dvl.stamps_ns[0])
    last_ns = min(imu.stamps_ns[-1], dvl.stamps_ns[-1])
    spare_ns = (int(last_ns - first_ns) - round(LONGEST_S * NS_PER_S)) // 2
    if spare_ns <= 0:
        return imu, dvl
    ends = int(first_ns) + spare_ns, int(last_ns) - spare_ns
    inner_imu, inner_dvl = imu.between(*ends), dvl.between(*ends)
    return (imu, dvl) if inner_imu is None or inner_dvl is None else (inner_imu, inner_dvl)
