"""Runs that tests spoil by hand: other columns and calibrations, sensors of the true motion, and what is found in them."""

import tomllib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from sonar_graph.calibration import Calibration, Start
from sonar_graph.diagnosis import Finding, check_sensors
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import (
    Depth,
    Dvl,
    Floats,
    Heading,
    Imu,
    Ints,
    PositionFixes,
)
from sonar_graph.sequence import Sequence


def spoilt(run: Sequence, role: str, **columns: Any) -> Sequence:
    """The run with other columns of a sensor."""
    return replace(run, **{role: replace(getattr(run, role), **columns)})


def late(run: Sequence, role: str, delay_s: float) -> Sequence:
    stamps_ns = getattr(run, role).stamps_ns + round(delay_s * 1e9)
    return spoilt(run, role, stamps_ns=stamps_ns)


def recalibrated(run: Sequence, role: str, **values: Any) -> Sequence:
    """The run with other values in a section of its calibration."""
    section = getattr(run.calibration, role).model_copy(update=values)
    calibration = run.calibration.model_copy(update={role: section})
    return replace(run, calibration=calibration)


def started(run: Sequence, start: Start) -> Sequence:
    calibration = run.calibration.model_copy(update={"start": start})
    return replace(run, calibration=calibration)


def with_mounting(run: Sequence, role: str, **values: Any) -> Sequence:
    mounting = getattr(run.calibration, role).mounting.model_copy(update=values)
    return recalibrated(run, role, mounting=mounting)


def without_imu(run: Sequence, begin_s: float, end_s: float) -> Sequence:
    """The run with a hole of the IMU."""
    t = (run.imu.stamps_ns - run.imu.stamps_ns[0]) * 1e-9
    return replace(run, imu=run.imu.rows((t <= begin_s) | (t >= end_s)))


def unstated(*shape: int) -> Floats:
    """Uncertainties of rows that state none."""
    return np.full(shape, np.nan)


def dvl_rows(stamps_ns: Ints, velocity: Floats) -> Dvl:
    return Dvl(stamps_ns, velocity, unstated(len(stamps_ns), 3, 3))


def heading_rows(stamps_ns: Ints, yaw_rad: Floats) -> Heading:
    return Heading(stamps_ns, yaw_rad, unstated(len(stamps_ns)))


def fix_rows(stamps_ns: Ints, position_m: Floats) -> PositionFixes:
    return PositionFixes(stamps_ns, position_m, unstated(len(stamps_ns), 3, 3))


def with_depth(run: Sequence, z_m: Floats, variance_m2: float = np.nan) -> Sequence:
    """The run with depths at every tenth row of the IMU."""
    stamps_ns = run.imu.stamps_ns[::10]
    return replace(run, depth=Depth(stamps_ns, z_m, np.full(len(z_m), variance_m2)))


def level_vehicle(
    velocity: Floats, yaw_rate: Floats, seed: int, every: int = 1
) -> Sequence:
    """A level vehicle by hand, its velocity in the body and its yaw rate at 50 Hz: ``f = dv/dt + w x v + g``, with noise.

    The Doppler log has 5 rows a second, or ``every`` so many of them.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(len(velocity)) / 50.0
    stamps_ns = np.rint(t * 1e9).astype(np.int64)
    up = np.array([0.0, 0.0, 1.0])
    rate = np.outer(yaw_rate, up)
    force = np.gradient(velocity, t, axis=0) + np.cross(rate, velocity) + 9.80665 * up
    rate += 1e-3 * rng.standard_normal(rate.shape)
    force += 1e-2 * rng.standard_normal(force.shape)
    slow = slice(None, None, 10)
    noisy = velocity[slow] + 0.01 * rng.standard_normal(velocity[slow].shape)
    imu = Imu(stamps_ns, rate, force)
    dvl = dvl_rows(stamps_ns[slow], noisy).rows(slice(0, None, every))
    return Sequence("by hand", Calibration(), imu, dvl)


def true_yaw(run: Sequence) -> Floats:
    return np.unwrap(run.truth.rotations().as_euler("ZYX")[:, 0])


def compass(
    run: Sequence,
    said: Callable[[Floats], Floats] = np.asarray,
    sigma_rad: float = 0.02,
) -> Sequence:
    """The run with headings, as a compass says the true ones."""
    rows = slice(0, None, 10)
    yaw_rad = true_yaw(run)[rows]
    noise = sigma_rad * np.random.default_rng(0).standard_normal(len(yaw_rad))
    heading = heading_rows(run.truth.stamps_ns[rows], said(yaw_rad) + noise)
    return replace(run, heading=heading)


def fixed(
    run: Sequence, scale=1.0, origin=(0.0, 0.0, 0.0), sigma_m=0.0, every_s=1.0
) -> Sequence:
    """The run with fixes of the true position, in another unit and from another origin, with noise."""
    t = np.arange(run.truth.stamps_ns[0], run.truth.stamps_ns[-1], round(every_s * 1e9))
    noise = sigma_m * np.random.default_rng(1).standard_normal((len(t), 3))
    places = scale * (run.truth.at(t).positions + noise) + origin
    return replace(run, positions=fix_rows(t, places))


def acting(run: Sequence, config: LogConfig | None = None) -> list[Finding]:
    return [found for found in check_sensors(run, config) if found.acts]


def grave(run: Sequence) -> list[Finding]:
    return [found for found in check_sensors(run) if found.grave]


def names(findings: list[Finding]) -> list[str]:
    return [found.quantity for found in findings]


def by_name(findings: list[Finding]) -> dict[str, Finding]:
    return {found.quantity: found for found in findings}


def lines_of(finding: Finding) -> list[dict[str, Any]]:
    """All lines of an advice."""
    return [tomllib.loads(line) for line in finding.advice.split("`")[1::2]]


def line_of(finding: Finding) -> dict[str, Any]:
    return lines_of(finding)[0]
