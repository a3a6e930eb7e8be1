"""Limits of the table of checks: the size at which each check fires, its false alarms, and the cover of its intervals.

    python benchmarks/validation/check_limits.py [--quick] [--logs 100] [--table benchmarks/results/check_limits.md]

A vehicle on splines (`spline_vehicle`) whose sensors have white and correlated errors is spoilt by each fault at rising
sizes, until the check fires in 95 of 100 logs. A check that fires on a log without a fault is a false alarm. Intervals
are those of the same logs without a fault: how many of the 95 % intervals hold the true value.
"""

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import make_parser, note, print_figures, print_table
from spline_vehicle import BODY_P_DVL, BODY_P_IMU, BODY_R_DVL, Vehicle, make_vehicle

from sonar_graph.calibration import Calibration
from sonar_graph.diagnosis import Finding, check_sensors
from sonar_graph.measurements import (
    Depth,
    Dvl,
    Heading,
    Imu,
    LandmarkDetections,
    PositionFixes,
)
from sonar_graph.sequence import Sequence

DURATION_S = 120.0
FIRED = 0.95
INTERVAL_SIGMAS = 1.96
LANDMARKS = 30


def gauss_markov(
    rng: np.random.Generator, times_s: np.ndarray, sigma: float, time_s: float
) -> np.ndarray:
    """An error that holds for some time, shape (n,)."""
    keep = np.exp(-np.diff(times_s, prepend=times_s[0]) / time_s)
    drawn = sigma * np.sqrt(1 - keep**2) * rng.standard_normal(len(times_s))
    found = np.empty(len(times_s))
    value = sigma * float(rng.standard_normal())
    for k in range(len(times_s)):
        value = keep[k] * value + drawn[k]
        found[k] = value
    return found


def nanoseconds(times_s: np.ndarray) -> np.ndarray:
    """Stamps of seconds."""
    return np.round(times_s * 1e9).astype(np.int64)


def instants(rate_hz: float) -> np.ndarray:
    """Times of the rows of a sensor."""
    return np.arange(0.0, DURATION_S, 1.0 / rate_hz)


def make_calibration(vehicle: Vehicle) -> Calibration:
    """What the owner of the vehicle knows: the places and the noise of all sensors."""
    roll, pitch, yaw = vehicle.angles(0.0).tolist()
    turned = BODY_R_DVL.as_euler("ZYX")[::-1].tolist()
    return Calibration.model_validate(
        {
            "gravity_m_s2": 9.81,
            "start": {
                "position_m": vehicle.position(0.0).tolist(),
                "rpy_rad": [roll, pitch, yaw],
                "position_sigma_m": [0.05, 0.05, 0.05],
                "rpy_sigma_rad": [0.02, 0.02, 0.02],
            },
            "imu": {
                "mounting": {"translation_m": BODY_P_IMU.tolist()},
                "gyro_noise_density": 1e-4,
                "accel_noise_density": 1e-3,
            },
            "dvl": {
                "mounting": {
                    "translation_m": BODY_P_DVL.tolist(),
                    "rpy_rad": turned,
                },
                "velocity_sigma_m_s": [0.01, 0.01, 0.01],
            },
            "depth": {"sigma_m": 0.02},
            "heading": {"sigma_rad": 0.015, "bias_sigma_rad": 0.02},
            "positions": {"sigma_m": [0.35, 0.35, 0.35]},
        }
    )


def make_log(seed: int) -> Sequence:
    """A log without a fault."""
    rng = np.random.default_rng(seed)
    vehicle = make_vehicle(seed, DURATION_S)
    t = instants(50.0)
    density = np.sqrt(50.0)
    rate = vehicle.rate(t) + rng.normal(0, 1e-4 * density, (len(t), 3))
    force = vehicle.specific_force(t) + rng.normal(0, 1e-3 * density, (len(t), 3))
    imu = Imu(
        nanoseconds(t), rate + rng.normal(0, 5e-5, 3), force + rng.normal(0, 5e-3, 3)
    )
    t = instants(5.0)
    slow = np.column_stack([gauss_markov(rng, t, 0.002, 5.0) for _ in range(3)])
    velocity = vehicle.doppler(t) + slow + rng.normal(0, 0.01, (len(t), 3))
    unknown = np.full((len(t), 3, 3), np.nan)
    z_m = vehicle.position(t)[:, 2] + gauss_markov(rng, t, 0.01, 3.0)
    yaw_rad = vehicle.angles(t)[:, 2] + gauss_markov(rng, t, 0.01, 20.0)
    depth = Depth(
        nanoseconds(t), z_m + rng.normal(0, 0.01, len(t)), np.full(len(t), np.nan)
    )
    heading = Heading(
        nanoseconds(t), yaw_rad + rng.normal(0, 0.01, len(t)), np.full(len(t), np.nan)
    )
    dvl = Dvl(nanoseconds(t), velocity, unknown)
    t = instants(1.0)
    wander = np.column_stack([gauss_markov(rng, t, 0.15, 10.0) for _ in range(3)])
    places = vehicle.position(t) + wander + rng.normal(0, 0.3, (len(t), 3))
    fixes = PositionFixes(nanoseconds(t), places, np.full((len(t), 3, 3), np.nan))
    return Sequence(
        f"splines {seed}",
        make_calibration(vehicle),
        imu,
        dvl,
        depth=depth,
        heading=heading,
        positions=fixes,
        detections=sightings(vehicle, rng),
    )


def sightings(vehicle: Vehicle, rng: np.random.Generator) -> LandmarkDetections:
    """Ranges and azimuths of landmarks near the way, twice a second."""
    t = instants(2.0)
    along = vehicle.position(rng.uniform(0, DURATION_S, LANDMARKS))
    places = along + np.column_stack(
        [rng.normal(0, 3.0, (LANDMARKS, 2)), rng.normal(0, 0.2, LANDMARKS)]
    )
    rows = []
    for second in t:
        seen = vehicle.attitude(second).inv().apply(places - vehicle.position(second))
        distance = np.linalg.norm(seen, axis=1)
        azimuth = np.arctan2(seen[:, 1], seen[:, 0])
        elevation = np.abs(seen[:, 2]) / distance
        visible = (distance > 1) & (distance < 12) & (np.abs(azimuth) < 0.8)
        rows += [
            (second, distance[k], azimuth[k], k)
            for k in np.flatnonzero(visible & (elevation < 0.12))
        ]
    table = np.array(rows)
    n = len(table)
    return LandmarkDetections(
        nanoseconds(table[:, 0]),
        table[:, 1] + rng.normal(0, 0.02, n),
        table[:, 2] + rng.normal(0, 0.009, n),
        np.tile(np.diag([4e-4, 8.1e-5]), (n, 1, 1)),
        table[:, 3].astype(np.int64)[:, None],
        np.ones((n, 1)),
    )


@dataclass(frozen=True)
class Fault:
    """A fault at rising sizes, and the quantity whose finding must act."""

    name: str
    unit: str
    sizes: tuple[float, ...]
    spoil: Callable[[Sequence, float], Sequence]
    quantity: str
    """Regular expression."""


def late(role: str) -> Callable[[Sequence, float], Sequence]:
    """Stamps of a sensor moved by seconds."""

    def spoil(log: Sequence, seconds: float) -> Sequence:
        rows = getattr(log, role)
        moved = replace(rows, stamps_ns=rows.stamps_ns + round(seconds * 1e9))
        return replace(log, **{role: moved})

    return spoil


def scaled(role: str, field: str) -> Callable[[Sequence, float], Sequence]:
    """Values of a sensor that are too large by a share."""

    def spoil(log: Sequence, share: float) -> Sequence:
        rows = getattr(log, role)
        values = getattr(rows, field) * (1.0 + share)
        return replace(log, **{role: replace(rows, **{field: values})})

    return spoil


def turned_heading(log: Sequence, degrees: float) -> Sequence:
    """Heading of another north."""
    yaw_rad = log.heading.yaw_rad + np.radians(degrees)
    return replace(log, heading=replace(log.heading, yaw_rad=yaw_rad))


def biased(log: Sequence, bias_rad_s: float) -> Sequence:
    """Gyro with a bias about its z axis."""
    rate = log.imu.angular_velocity + np.array([0.0, 0.0, bias_rad_s])
    return replace(log, imu=replace(log.imu, angular_velocity=rate))


def raised(log: Sequence, metres: float) -> Sequence:
    """Depth with another origin."""
    return replace(log, depth=replace(log.depth, z_m=log.depth.z_m + metres))


def with_axes(
    role: str, field: str, signs: tuple[float, ...]
) -> Callable[[Sequence, float], Sequence]:
    """Values of a sensor with signs of their own."""

    def spoil(log: Sequence, _: float) -> Sequence:
        rows = getattr(log, role)
        values = getattr(rows, field) * np.array(signs if len(signs) > 1 else signs[0])
        return replace(log, **{role: replace(rows, **{field: values})})

    return spoil


def mirrored(
    signs: tuple[float, float, float],
) -> Callable[[Sequence, float], Sequence]:
    """Velocities with signs along the axes of the body."""
    R = BODY_R_DVL.as_matrix()
    turn = R.T @ np.diag(signs) @ R

    def spoil(log: Sequence, _: float) -> Sequence:
        velocity = log.dvl.velocity @ turn.T
        return replace(log, dvl=replace(log.dvl, velocity=velocity))

    return spoil


SHARES = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 1.0)
SECONDS = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)
FAULTS = (
    Fault("depth, scale", "", SHARES, scaled("depth", "z_m"), "^depth: change"),
    Fault("depth, late", "s", SECONDS, late("depth"), "^depth against"),
    Fault("depth, origin", "m", (1.0, 1.5, 2.0, 2.5, 3.0, 4.0), raised, "^depth: dist"),
    Fault(
        "heading, scale of the gyros",
        "",
        SHARES,
        scaled("imu", "angular_velocity"),
        "^heading: turn over",
    ),
    Fault("heading, late", "s", SECONDS, late("heading"), "^heading against"),
    Fault(
        "heading, turned",
        "deg",
        (5, 7, 10, 12, 15, 20, 30),
        turned_heading,
        "^heading: turn towards",
    ),
    Fault(
        "gyro, bias",
        "rad/s",
        (1e-3, 2e-3, 3e-3, 5e-3, 7e-3, 1e-2),
        biased,
        "^gyro bias about",
    ),
    Fault(
        "position, scale",
        "",
        SHARES,
        scaled("positions", "position_m"),
        "^position fixes: change",
    ),
    Fault("position, late", "s", SECONDS, late("positions"), "^position fixes against"),
    Fault("range, scale", "", SHARES, scaled("detections", "range_m"), "^ranges"),
    Fault(
        "azimuth, scale", "", SHARES, scaled("detections", "azimuth_rad"), "^azimuths"
    ),
)
SIGNS = (
    Fault(
        "gyro, sense of yaw",
        "",
        (1.0,),
        with_axes("imu", "angular_velocity", (1, 1, -1)),
        "^gyro axes",
    ),
    Fault("velocity, left is right", "", (1.0,), mirrored((1, -1, 1)), "^DVL axes"),
    Fault("velocity, backwards", "", (1.0,), mirrored((-1, -1, 1)), "^DVL axes"),
    Fault(
        "heading, sense",
        "",
        (1.0,),
        with_axes("heading", "yaw_rad", (-1,)),
        "^heading: turn over",
    ),
    Fault(
        "depth, sense", "", (1.0,), with_axes("depth", "z_m", (-1,)), "^depth: change"
    ),
    Fault(
        "azimuth, sense",
        "",
        (1.0,),
        with_axes("detections", "azimuth_rad", (-1,)),
        "^azimuths",
    ),
)
FITTED = {
    "Doppler log, late": ("DVL against IMU: time offset", "s", 0.0),
    "Doppler log, yaw": ("DVL mounting yaw", "deg", 0.0),
    "Doppler log, scale": ("DVL scale", "", 1.0),
}
"""Estimates of one fit, which is linear in a small fault: what it would need to fire follows from its sigma."""
TRUE_VALUES = {
    "DVL against IMU: time offset": 0.0,
    "DVL mounting yaw": 0.0,
    "DVL scale": 1.0,
    "lever arm from IMU to DVL, x": BODY_P_DVL[0] - BODY_P_IMU[0],
    "lever arm from IMU to DVL, y": BODY_P_DVL[1] - BODY_P_IMU[1],
    "depth: change over": 1.0,
    "depth against": 0.0,
    "heading: turn over": 1.0,
    "heading against": 0.0,
    "heading: turn towards": 0.0,
    "position fixes: change": 1.0,
    "position fixes against": 0.0,
    "ranges to landmarks: change": 1.0,
    "azimuths of landmarks: change": 1.0,
}


def fires(fault: Fault, log: Sequence, size: float) -> bool:
    """True where a finding of the fault's quantity asks for an action."""
    found = check_sensors(fault.spoil(log, size))
    return any(f.acts and re.search(fault.quantity, f.quantity) for f in found)


def limit_of(fault: Fault, logs: list[Sequence]) -> float:
    """Smallest of the sizes at which the check fires in `FIRED` of the logs; infinite: at none."""
    allowed = int((1 - FIRED) * len(logs))
    for size in fault.sizes:
        missed = 0
        for log in logs:
            missed += not fires(fault, log, size)
            if missed > allowed:
                break
        else:
            return size
    return float("inf")


def errors_of(logs: list[Sequence]) -> tuple[dict[str, list[Finding]], list[Finding]]:
    """Findings by quantity of logs without a fault, and those that ask for an action."""
    by_name = dict[str, list[Finding]]()
    alarms = list[Finding]()
    for log in logs:
        for finding in check_sensors(log):
            by_name.setdefault(finding.quantity, []).append(finding)
            if finding.acts:
                alarms.append(finding)
                note(f"{log.name}: {finding.quantity}: {finding.text()}")
    return by_name, alarms


def cover(findings: list[Finding], true: float) -> tuple[int, float, float]:
    """Number that is known, share of intervals with the true value, and rms of error over sigma."""
    known = [f.estimate for f in findings if f.estimate.is_known]
    ratios = np.array([(e.value - true) / e.sigma for e in known])
    if not len(ratios):
        return 0, float("nan"), float("nan")
    return (
        len(ratios),
        float(np.mean(np.abs(ratios) < INTERVAL_SIGMAS)),
        float(np.sqrt(np.mean(ratios**2))),
    )


def main() -> None:
    """Measure, print, and write the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--logs", type=int, default=100, help="simulated logs")
    parser.add_argument("--table", type=Path, help="Markdown file to write")
    arguments = parser.parse_args()
    count = 3 if arguments.quick else arguments.logs
    logs = [make_log(seed) for seed in range(count)]
    by_name, alarms = errors_of(logs)
    limits = list[tuple[str, str, str, float]]()
    for fault in (*FAULTS, *SIGNS):
        false = sum(bool(re.search(fault.quantity, f.quantity)) for f in alarms)
        size = limit_of(fault, logs)
        found = "never" if np.isinf(size) else f"{size:g} {fault.unit}".strip()
        if fault in SIGNS:
            found = "found" if np.isfinite(size) else "not in 95 %"
        limits.append((fault.name, found, f"{false} of {count}", len(alarms)))
        note(f"{fault.name}: {found}")
    for name, (quantity, unit, true) in FITTED.items():
        needed = [
            4.5 * f.estimate.sigma + abs(f.estimate.value - true)
            for f in by_name[quantity]
            if f.estimate.is_known
        ]
        false = sum(f.quantity == quantity for f in alarms)
        size = float(np.quantile(needed, FIRED)) if needed else float("nan")
        limits.append((name, f"{size:.2g} {unit}".strip(), f"{false} of {count}", 0))
    covers = list[tuple[str, int, float, float]]()
    for name, true in TRUE_VALUES.items():
        found = [f for key in by_name if key.startswith(name) for f in by_name[key]]
        covers.append((name, *cover(found, true)))
    rows = [row[:3] for row in limits]
    head = ("check", "fires in 95 % of logs from", "false alarms")
    print_table(head, rows)
    cover_head = ("quantity", "logs", "95 % held", "rms error / sigma")
    print_table(cover_head, covers)
    if arguments.table is not None:
        arguments.table.write_text(
            f"# Limits of the checks\n\nWritten by `benchmarks/validation/check_limits.py --logs {count}`: "
            f"{DURATION_S:.0f} s of a vehicle on splines, whose sensors have white and correlated errors. "
            "See [sensor_check](../../docs/theory/sensor_check.md).\n\n"
            f"{markdown(head, rows)}\n{markdown(cover_head, covers)}",
            encoding="utf-8",
        )
    print_figures({"logs": count, "false_alarms": len(alarms)})


def markdown(head: tuple[str, ...], rows: list[tuple[object, ...]]) -> str:
    """A table."""
    lines = [" | ".join(head), " | ".join("---" for _ in head)]
    for row in rows:
        cells = [
            f"{cell:.2f}" if isinstance(cell, float) else str(cell) for cell in row
        ]
        lines.append(" | ".join(cells))
    return "".join(f"| {line} |\n" for line in lines)


if __name__ == "__main__":
    main()
