"""What a log's sensors say about each other: offsets, mounting, scale and noise, and whether to act on it.

The estimators are in `sonar_graph.navigation`, derived in docs/theory/sensor_check.md. Here each number meets what the
run would use (calibration and log configuration) and becomes a line to put into one of the two.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import DvlCalibration, Start
from sonar_graph.evaluation.unit_check import wrong_units
from sonar_graph.logs.adapters.config import LogConfig
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.allan import noise_densities
from sonar_graph.navigation.dvl_against_imu import match_dvl_to_imu
from sonar_graph.navigation.offset_search import Estimate1D
from sonar_graph.navigation.reference_match import match_reference_to_imu
from sonar_graph.sequence import NS_PER_S, Sequence
from sonar_graph.states import Trajectory

LONGEST_S = 600.0
"""Compared over at most so long, in the middle of the log, which bounds the time: 240 s take about 1 s."""
INTERVAL_SIGMAS = 1.96
"""Intervals are printed as plus or minus 95 %."""
LEAST_OFFSET_S = 0.01
LEAST_YAW_RAD = np.radians(0.25)
LEAST_SCALE = 0.002
LEAST_HEADING_RAD = np.radians(1.0)
"""What is smaller changes nothing that other errors would not hide."""
TURN_OVER_NS = NS_PER_S // 2
LEAST_SPREAD_RAD = np.radians(0.1)
NO_NEED = "no need to act"
LARGEST_DENSITY_RATIO = 1.5
"""Densities further from the calibration's than this, either way, are worth a line."""


@dataclass(frozen=True)
class Finding:
    """One quantity, how sure it is, and what to do."""

    quantity: str
    estimate: Estimate1D
    unit: str
    advice: str
    """A sentence; says that nothing need be done where nothing need."""
    acts: bool = False
    """Whether something should be done."""

    def text(self) -> str:
        """Value with its 95 % interval, and the advice; or why it cannot be told, or what is wrong before that."""
        if not self.estimate.is_known:
            return self.advice if self.acts else f"cannot be told: {self.estimate.reason}"
        return f"{with_interval(self.estimate, self.unit)}: {self.advice}"

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        known, e = self.estimate.is_known, self.estimate
        numbers = {"value": e.value if known else None, "sigma": e.sigma if known else None, "unit": self.unit}
        return {"quantity": self.quantity, **numbers, "reason": e.reason, "act": bool(self.acts), "advice": self.advice}


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
    of_dvl = list(_of_dvl(sequence, config))
    return [*of_dvl, *_of_reference(sequence, config, of_dvl[0]), *_of_noise(sequence)]


def with_interval(estimate: Estimate1D, unit: str) -> str:
    """Digits as far as the interval supports them."""
    half = INTERVAL_SIGMAS * estimate.sigma
    digits = int(np.clip(1 - np.floor(np.log10(half)), 0, 8)) if half > 0 else 3
    if unit.startswith(("rad/s", "m/s")):
        return f"{estimate.value:.2g} ± {half:.1g} {unit}"
    sign = "" if unit == "" else "+"
    return f"{estimate.value:{sign}.{digits}f} ± {half:.{digits}f} {unit}".rstrip()


def _of_dvl(sequence: Sequence, config: LogConfig) -> Iterator[Finding]:
    found = match_dvl_to_imu(*_middle(sequence.imu, sequence.dvl), sequence.calibration)
    yield _offset("DVL against IMU", _as_sure_as_samples(found.offset, sequence.imu), "dvl", config)
    yaw_deg = _in_degrees(found.yaw)
    if _matters(found.yaw, LEAST_YAW_RAD):
        rpy = ", ".join(f"{angle:.4f}" for angle in _turned(sequence.calibration.dvl, found.yaw.value))
        advice = f"turn the DVL's mounting: `dvl.mounting.rpy_rad = [{rpy}]` in the calibration"
        yield Finding("DVL mounting yaw", yaw_deg, "°", advice, acts=True)
    else:
        yield Finding("DVL mounting yaw", yaw_deg, "°", NO_NEED)
    if _matters(replace(found.scale, value=found.scale.value - 1), LEAST_SCALE):
        scale = float(config.table("dvl").get("scale", 1.0)) * found.scale.value
        advice = f"scale the DVL's velocities: `scale = {scale:.4f}` under [dvl] in the log configuration"
        yield Finding("DVL scale", found.scale, "", advice, acts=True)
    else:
        yield Finding("DVL scale", found.scale, "", NO_NEED)


def _of_reference(sequence: Sequence, config: LogConfig, dvl_offset: Finding) -> Iterator[Finding]:
    if sequence.truth is None:
        return
    found = match_reference_to_imu(sequence.imu, sequence.truth, sequence.calibration)
    offset = _as_sure_as_samples(found.offset, sequence.imu)
    yield _offset("reference against IMU", offset, "truth", config)
    jump = _in_degrees(found.start_heading)
    acts = _matters(found.start_heading, LEAST_HEADING_RAD)
    advice = "the reference begins with a wrong heading: leave its beginning out with `--start`" if acts else NO_NEED
    yield Finding("first headings of the reference", jump, "°", advice, acts)
    if offset.is_known and sequence.calibration.start != Start():
        yield _start_heading(sequence, sequence.truth, offset, dvl_offset.estimate.value if dvl_offset.acts else 0.0)


def _start_heading(sequence: Sequence, reference: Trajectory, offset: Estimate1D, dvl_offset_s: float) -> Finding:
    """The calibration's start against the reference at that instant, its stamps put right."""
    start = sequence.calibration.start
    start_ns = max(int(sequence.imu.stamps_ns[0]), int(sequence.dvl.stamps_ns[0]) + round(dvl_offset_s * NS_PER_S))
    first_ns, last_ns = reference.stamps_ns[[0, -1]].tolist()
    at_ns = min(max(start_ns - round(offset.value * NS_PER_S), first_ns), last_ns)
    pose, ends_ns = reference.at(np.array([at_ns])), np.array([at_ns - TURN_OVER_NS, at_ns + TURN_OVER_NS])
    ends = reference.at(np.unique(np.clip(ends_ns, first_ns, last_ns))).rotations()
    turn_rate = (ends[0].inv() * ends[-1]).magnitude() * NS_PER_S / TURN_OVER_NS
    yaw, pitch, roll = pose.rotations().as_euler("ZYX")[0].tolist()
    error = float(np.angle(np.exp(1j * (start.rpy_rad[2] - yaw))))
    estimate = Estimate1D(error, float(np.hypot(LEAST_SPREAD_RAD, turn_rate * offset.sigma)))
    acts = _matters(estimate, LEAST_HEADING_RAD)
    advice = NO_NEED
    if acts:
        place = ", ".join(f"{metres:.2f}" for metres in pose.positions[0])
        advice = (
            "the start heading is wrong; the reference, its stamps put right, says "
            f"`start.rpy_rad = [{roll:.4f}, {pitch:.4f}, {yaw:.4f}]`, `start.position_m = [{place}]` in the calibration"
        )
    return Finding("start heading of the calibration", _in_degrees(estimate), "°", advice, acts)


def _of_noise(sequence: Sequence) -> Iterator[Finding]:
    found, imu = noise_densities(sequence.imu), sequence.calibration.imu
    rest = f"from {found.still_s:.0f} s of rest"
    known = {
        "gyro noise density": ("gyro_noise_density", found.gyro, imu.gyro_noise_density, "rad/s/√Hz"),
        "accelerometer noise density": ("accel_noise_density", found.accel, imu.accel_noise_density, "m/s²/√Hz"),
    }
    for quantity, (field, estimate, given, unit) in known.items():
        ratio = max(estimate.value / given, given / estimate.value) if estimate.value > 0 and given > 0 else np.inf
        acts = _matters(replace(estimate, value=estimate.value - given), 0.0) and ratio > LARGEST_DENSITY_RATIO
        advice = f"{rest}; the calibration's {given:.2g} fits, no need to act"
        if acts:
            advice = (
                f"{rest}, not the calibration's {given:.2g}: `imu.{field} = {estimate.value:.2g}` in the calibration"
            )
        yield Finding(quantity, estimate, unit, advice, acts)


def _offset(quantity: str, estimate: Estimate1D, role: str, config: LogConfig) -> Finding:
    if not _matters(estimate, LEAST_OFFSET_S):
        return Finding(f"{quantity}: time offset", estimate, "s", NO_NEED)
    total_s = float(config.table(role).get("stamp_offset_s", 0.0)) + estimate.value
    advice = f"shift its stamps: `stamp_offset_s = {total_s:.3f}` under [{role}] in the log configuration"
    return Finding(f"{quantity}: time offset", estimate, "s", advice, acts=True)


def _as_sure_as_samples(offset: Estimate1D, imu: Imu) -> Estimate1D:
    """No surer than it is known what instant of its interval a sample of the IMU stands for (uniform)."""
    interval_s = float(np.median(np.diff(imu.stamps_ns))) / NS_PER_S if len(imu) > 1 else 0.0
    return replace(offset, sigma=float(np.hypot(offset.sigma, interval_s / np.sqrt(12))))


def _in_degrees(angle: Estimate1D) -> Estimate1D:
    return replace(angle, value=float(np.degrees(angle.value)), sigma=float(np.degrees(angle.sigma)))


def _matters(estimate: Estimate1D, least: float) -> bool:
    """Larger than what is worth the trouble, and its interval leaves zero out."""
    return bool(estimate.is_known and abs(estimate.value) > max(least, INTERVAL_SIGMAS * estimate.sigma))


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
