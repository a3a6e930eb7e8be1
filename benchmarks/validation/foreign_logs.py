"""Logs by another hand: every fault of the table of checks at three sizes, and logs without a fault.

    python benchmarks/validation/foreign_logs.py [--quick] [--faultless 50] [--only FAULT ...] [--keep FOLDER]

World, sensors and writer share no code with the package: splines of scipy, messages of `rosbags`, files of `mcap`.
Errors of sensors are white and correlated (Gauss-Markov). A log is judged by ``sonar-graph compare``, by its exit code,
its printed lines and the trajectories that it writes:

* ``silent``: the error is over five times that of the log without the fault, and no line names the cause;
* ``warned``: a line names the cause, the error is over five times as large, and the exit code is 0;
* ``misled``: a line asks for a change of a sensor that is right;
* ``false_alarms``: a log without a fault whose lines ask for a change, or whose exit code is not 0.

``coverage`` counts how often the 95 % intervals of ``sonar-graph inspect --json`` hold the true value on logs without a
fault. docs/theory/sensor_check.md has the table of checks.
"""

import argparse
import contextlib
import io
import json
import os
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import make_parser, note, print_figures, print_table

os.environ.setdefault("COLUMNS", "2000")  # before rich: a warning stays on its line
from sonar_graph.cli.main import main as main_command

Floats = NDArray[np.float64]
DURATION_S = 60.0
EPOCH_S = 1_760_000_000
GRAVITY_M_S2 = 9.80665
DVL_ARM_M = np.array([0.3, 0.0, -0.1])
WORSE = 5.0
"""Ratio of errors above which a fault matters."""
LEAST_ERROR_M = 0.05
SONAR = """std_msgs/Header header
float64[] range_m
float64[] azimuth_rad
float64[] covariance
int64[] candidate_ids
float64[] id_probability
int64[] track"""


@dataclass
class Log:
    """Rows of every sensor; times in seconds from the start."""

    imu_s: Floats
    rate: Floats
    force: Floats
    dvl_s: Floats
    velocity: Floats
    depth_s: Floats
    z_m: Floats
    heading_s: Floats
    yaw_rad: Floats
    fix_s: Floats
    fix_m: Floats
    frame_s: Floats
    sightings: list[tuple[NDArray[np.int64], Floats, Floats]]
    """Identities, ranges and azimuths of each frame."""
    start: tuple[Floats, Floats]
    """Position, and roll, pitch, yaw."""
    truth: Floats
    """Seconds and position, shape (n, 4)."""


def gauss_markov(
    rng: np.random.Generator, times: Floats, sigma: float, time_s: float
) -> Floats:
    """An error that holds for some time, shape (n,)."""
    keep = np.exp(-np.diff(times, prepend=times[0]) / time_s)
    drawn = sigma * np.sqrt(1 - keep**2) * rng.standard_normal(len(times))
    value = sigma * float(rng.standard_normal())
    found = np.empty(len(times))
    for k in range(len(times)):
        value = keep[k] * value + drawn[k]
        found[k] = value
    return found


def make_log(seed: int) -> Log:
    """One dive of `DURATION_S` without a fault."""
    rng = np.random.default_rng(seed)
    knots = np.arange(-6.0, DURATION_S + 12.0, 3.0)
    turns = np.cumsum(rng.normal(0.0, 0.35, len(knots)))
    yaw = turns + rng.uniform(-np.pi, np.pi)
    speed = rng.uniform(0.4, 1.0) + 0.15 * rng.standard_normal(len(knots))
    sway = 0.12 * rng.standard_normal(len(knots))
    steps = 3.0 * (speed + 1j * sway) * np.exp(1j * yaw)
    level = np.cumsum(steps)
    z = -4.0 + np.cumsum(rng.normal(0.0, 0.5, len(knots)))
    z = np.minimum(z, -0.5)
    place = CubicSpline(knots, np.column_stack([level.real, level.imag, z]))
    tilt = 0.04 * rng.standard_normal((2, len(knots)))
    attitude = RotationSpline(
        knots, Rotation.from_euler("ZYX", np.column_stack([yaw, tilt[0], tilt[1]]))
    )

    def instants(rate_hz: float) -> Floats:
        return np.arange(0.0, DURATION_S, 1.0 / rate_hz)

    imu_s, dvl_s, depth_s, heading_s, fix_s, frame_s = map(
        instants, (50.0, 5.0, 5.0, 5.0, 1.0, 2.0)
    )
    gravity = np.array([0.0, 0.0, GRAVITY_M_S2])
    rate = (
        attitude(imu_s, 1)
        + rng.normal(0, 7e-4, (len(imu_s), 3))
        + rng.normal(0, 5e-5, 3)
    )
    force = attitude(imu_s).inv().apply(place(imu_s, 2) + gravity)
    force = force + rng.normal(0, 7e-3, force.shape) + rng.normal(0, 5e-3, 3)
    velocity = attitude(dvl_s).inv().apply(place(dvl_s, 1)) + np.cross(
        attitude(dvl_s, 1), DVL_ARM_M
    )
    slow = np.column_stack([gauss_markov(rng, dvl_s, 0.002, 5.0) for _ in range(3)])
    velocity = (
        velocity * (1 + rng.normal(0, 0.001))
        + slow
        + rng.normal(0, 0.01, velocity.shape)
    )
    z_m = (
        place(depth_s)[:, 2]
        + gauss_markov(rng, depth_s, 0.01, 3.0)
        + rng.normal(0, 0.01, len(depth_s))
    )
    yaw_rad = attitude(heading_s).as_euler("ZYX")[:, 0]
    yaw_rad = (
        yaw_rad
        + gauss_markov(rng, heading_s, 0.01, 20.0)
        + rng.normal(0, 0.01, len(heading_s))
    )
    wander = np.column_stack([gauss_markov(rng, fix_s, 0.15, 10.0) for _ in range(3)])
    fix_m = place(fix_s) + wander + rng.normal(0, 0.3, (len(fix_s), 3))
    first = place(imu_s[0])
    spread = place(np.linspace(0, DURATION_S, 25)) + np.column_stack(
        [rng.normal(0, 5.0, (25, 2)), np.zeros(25)]
    )
    spread[:, 2] += rng.normal(0, 0.3, 25)
    sightings = []
    for second in frame_s:
        seen = attitude(second).inv().apply(spread - place(second))
        distance = np.linalg.norm(seen, axis=1)
        azimuth = np.arctan2(seen[:, 1], seen[:, 0])
        elevation = np.arcsin(seen[:, 2] / distance)
        visible = (
            (distance > 1.0)
            & (distance < 12.0)
            & (np.abs(azimuth) < 0.8)
            & (np.abs(elevation) < 0.12)
        )
        ids = np.flatnonzero(visible)
        noisy_r = distance[ids] + rng.normal(0, 0.02, len(ids))
        noisy_a = azimuth[ids] + rng.normal(0, 0.009, len(ids))
        sightings.append((ids.astype(np.int64), noisy_r, noisy_a))
    yaw_0, pitch_0, roll_0 = attitude(0.0).as_euler("ZYX")
    start = (first, np.array([roll_0, pitch_0, yaw_0]))
    truth = np.column_stack([imu_s, place(imu_s)])
    return Log(
        *(
            imu_s,
            rate,
            force,
            dvl_s,
            velocity,
            depth_s,
            z_m,
            heading_s,
            yaw_rad,
            fix_s,
            fix_m,
            frame_s,
            sightings,
        ),
        start=start,
        truth=truth,
    )


# --- faults ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fault:
    """A fault, its sizes, and what a line must contain to name its cause."""

    sizes: tuple[float, ...]
    spoil: Callable[[Log, float], None]
    words: str
    """Regular expression of the cause."""
    roles: tuple[str, ...]
    """Tables and sections that a line may ask to change."""


def stuck(times: Floats, values: Floats, from_s: float) -> None:
    """Repeat one value from an instant on."""
    later = times >= from_s
    values[later] = values[np.argmax(later)]


def scale_ranges(log: Log, factor: float) -> None:
    log.sightings = [(ids, r * factor, a) for ids, r, a in log.sightings]


def scale_azimuths(log: Log, factor: float) -> None:
    log.sightings = [(ids, r, a * factor) for ids, r, a in log.sightings]


def turn_velocity(log: Log, axes: tuple[float, float, float]) -> None:
    log.velocity *= np.array(axes)


def late(name: str) -> Callable[[Log, float], None]:
    def spoil(log: Log, seconds: float) -> None:
        setattr(log, name, getattr(log, name) + seconds)

    return spoil


def factor_of(name: str) -> Callable[[Log, float], None]:
    def spoil(log: Log, factor: float) -> None:
        setattr(log, name, getattr(log, name) * factor)

    return spoil


def mirrored(axes: tuple[float, float, float]) -> Callable[[Log, float], None]:
    return lambda log, _: turn_velocity(log, axes)


def rotated_90(log: Log, _: float) -> None:
    log.velocity = log.velocity[:, [1, 0, 2]] * np.array([1.0, -1.0, 1.0])


def swap_fixes(log: Log, _: float) -> None:
    log.fix_m = log.fix_m[:, [1, 0, 2]]


def add_depth(log: Log, metres: float) -> None:
    log.z_m = log.z_m + metres


def clockwise(log: Log, _: float) -> None:
    log.yaw_rad = np.pi / 2 - log.yaw_rad


def turn_heading(log: Log, degrees: float) -> None:
    log.yaw_rad = log.yaw_rad + np.radians(degrees)


def bias_gyro(log: Log, rad_s: float) -> None:
    log.rate[:, 2] += rad_s


def flip_gyro(log: Log, axis: float) -> None:
    log.rate[:, int(axis)] *= -1


FAULTS = {
    "depth unit": Fault(
        (1 / 0.3048, 100.0, 10.0),
        factor_of("z_m"),
        r"depth.*\d times as much",
        ("depth", "start"),
    ),
    "depth sense": Fault(
        (-1.0, -1 / 0.3048, -100.0),
        factor_of("z_m"),
        r"depth.*(rises|another sign)",
        ("depth", "start"),
    ),
    "depth scale": Fault(
        (1.15, 0.8, 1.25), factor_of("z_m"), r"depth.*times as much", ("depth", "start")
    ),
    "depth late": Fault(
        (1.0, 2.0, 3.0), late("depth_s"), r"depth.*too late", ("depth",)
    ),
    "depth stuck": Fault(
        (15.0, 30.0, 45.0),
        lambda log, s: stuck(log.depth_s, log.z_m, s),
        r"depth.*repeat",
        ("depth",),
    ),
    "depth origin": Fault(
        (5.0, 20.0, -10.0), add_depth, r"depth.*height begins", ("depth", "start")
    ),
    "heading sense": Fault(
        (0.0, 1.0, 2.0), clockwise, r"heading.*clockwise", ("heading",)
    ),
    "heading late": Fault(
        (0.7, 1.5, 2.5), late("heading_s"), r"heading.*too late", ("heading",)
    ),
    "heading stuck": Fault(
        (15.0, 30.0, 45.0),
        lambda log, s: stuck(log.heading_s, log.yaw_rad, s),
        r"heading.*repeat",
        ("heading",),
    ),
    "heading turned": Fault(
        (25.0, 60.0, -90.0),
        turn_heading,
        r"heading.*towards the positions",
        ("heading", "dvl"),
    ),
    "fix unit": Fault(
        (1e3, 1 / 0.3048, 1e2),
        factor_of("fix_m"),
        r"position.*times as much",
        ("positions", "start"),
    ),
    "fix late": Fault(
        (1.5, 2.0, 3.0), late("fix_s"), r"position.*too late", ("positions",)
    ),
    "fix stuck": Fault(
        (15.0, 28.0, 45.0),
        lambda log, s: stuck(log.fix_s, log.fix_m, s),
        r"positions.*repeat",
        ("positions",),
    ),
    "fix axes": Fault(
        (0.0, 1.0, 2.0),
        swap_fixes,
        r"position.*(exchanged|begin)",
        ("positions", "heading", "dvl"),
    ),
    "velocity left is right": Fault(
        (0.0, 1.0, 2.0), mirrored((1, -1, 1)), r"DVL axes.*mirrored", ("dvl",)
    ),
    "velocity backwards": Fault(
        (0.0, 1.0, 2.0), mirrored((-1, -1, 1)), r"DVL axes", ("dvl",)
    ),
    "velocity z turned": Fault(
        (0.0, 1.0, 2.0), mirrored((1, 1, -1)), r"DVL axes", ("dvl",)
    ),
    "velocity down": Fault(
        (0.0, 1.0, 2.0), mirrored((1, -1, -1)), r"DVL axes", ("dvl",)
    ),
    "velocity negated": Fault(
        (0.0, 1.0, 2.0), mirrored((-1, -1, -1)), r"DVL axes", ("dvl",)
    ),
    "velocity across": Fault(
        (0.0, 1.0, 2.0), rotated_90, r"DVL axes|mounting yaw", ("dvl",)
    ),
    "velocity unit": Fault(
        (1e3, 1e2, 1 / 0.5144),
        factor_of("velocity"),
        r"DVL.*(unit|scale)",
        ("dvl", "positions"),
    ),
    "velocity scale": Fault(
        (1.1, 0.9, 1.2),
        factor_of("velocity"),
        r"DVL scale|Doppler",
        ("dvl", "positions", "detections"),
    ),
    "velocity late": Fault(
        (0.5, 1.0, 1.5), late("dvl_s"), r"DVL against IMU", ("dvl",)
    ),
    "range unit": Fault(
        (1e3, 1e2, 1 / 0.3048),
        scale_ranges,
        r"ranges.*times as much",
        ("detections", "dvl"),
    ),
    "range scale": Fault(
        (1.045, 1.1, 0.9), scale_ranges, r"ranges.*times as much", ("detections", "dvl")
    ),
    "azimuth sense": Fault(
        (-1.0, -1.0, -1.0), scale_azimuths, r"azimuths.*mirrored", ("detections",)
    ),
    "azimuth unit": Fault(
        (57.29578, 57.29578, 57.29578),
        scale_azimuths,
        r"azimuth.*degrees",
        ("detections",),
    ),
    "gyro scale": Fault(
        (1.02, 1.05, 0.95), factor_of("rate"), r"angular_velocity_scale", ("imu",)
    ),
    "gyro unit": Fault(
        (57.29578, 57.29578, 57.29578), factor_of("rate"), r"gyro.*degrees", ("imu",)
    ),
    "gyro bias": Fault((0.005, 0.01, -0.02), bias_gyro, r"gyro bias", ("imu",)),
    "gyro sense": Fault(
        (0.0, 1.0, 2.0),
        flip_gyro,
        r"gyro rates|turns against the gyros",
        ("imu", "heading"),
    ),
}


# --- messages ----------------------------------------------------------------------------------------------------

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(get_types_from_msg(SONAR, "sonar_graph_msgs/msg/LandmarkDetections"))
TYPES = STORE.types


def header(seconds: float, frame: str) -> Any:
    """Header at some seconds after the epoch."""
    ns = round(seconds * 1e9) + EPOCH_S * 1_000_000_000
    stamp = TYPES["builtin_interfaces/msg/Time"](
        sec=ns // 1_000_000_000, nanosec=ns % 1_000_000_000
    )
    return TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def vector(values: Floats) -> Any:
    """Vector3."""
    return TYPES["geometry_msgs/msg/Vector3"](*map(float, values))


def point(values: Any) -> Any:
    """Point."""
    return TYPES["geometry_msgs/msg/Point"](*map(float, values))


def pose(seconds: float, values: Any, variance: float) -> Any:
    """PoseWithCovarianceStamped of a position."""
    covariance = np.zeros(36)
    covariance[[0, 7, 14]] = variance
    quaternion = TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    inner = TYPES["geometry_msgs/msg/Pose"](point(values), quaternion)
    with_covariance = TYPES["geometry_msgs/msg/PoseWithCovariance"](inner, covariance)
    return TYPES["geometry_msgs/msg/PoseWithCovarianceStamped"](
        header(seconds, "map"), with_covariance
    )


def messages(log: Log, sensors: set[str]) -> Iterator[tuple[float, str, str, Any]]:
    """Time, topic, type and message of every row."""
    none = np.full(9, 0.0)
    unknown = none.copy()
    unknown[0] = -1.0
    no_turn = TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    for t, w, f in zip(log.imu_s, log.rate, log.force, strict=True):
        kind = "sensor_msgs/msg/Imu"
        yield (
            t,
            "/imu/data",
            kind,
            TYPES[kind](
                header(t, "imu_link"),
                no_turn,
                unknown,
                vector(w),
                none,
                vector(f),
                none,
            ),
        )
    for t, v in zip(log.dvl_s, log.velocity, strict=True):
        kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
        twist = TYPES["geometry_msgs/msg/Twist"](vector(v), vector(np.zeros(3)))
        covariance = np.zeros(36)
        covariance[[0, 7, 14]] = 1e-4
        yield (
            t,
            "/dvl/twist",
            kind,
            TYPES[kind](
                header(t, "dvl_link"),
                TYPES["geometry_msgs/msg/TwistWithCovariance"](twist, covariance),
            ),
        )
    for t, z in zip(log.depth_s, log.z_m, strict=True):
        yield (
            t,
            "/depth/pose",
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            pose(t, (0.0, 0.0, z), 4e-4),
        )
    if "heading" in sensors:
        for t, yaw in zip(log.heading_s, log.yaw_rad, strict=True):
            kind = "geometry_msgs/msg/QuaternionStamped"
            x, y, z, w = Rotation.from_euler("z", yaw).as_quat()
            yield (
                t,
                "/heading",
                kind,
                TYPES[kind](
                    header(t, "map"), TYPES["geometry_msgs/msg/Quaternion"](x, y, z, w)
                ),
            )
    if "fixes" in sensors:
        for t, p in zip(log.fix_s, log.fix_m, strict=True):
            yield (
                t,
                "/usbl/fix_pose",
                "geometry_msgs/msg/PoseWithCovarianceStamped",
                pose(t, p, 0.12),
            )
    if "sonar" in sensors:
        for t, (ids, r, a) in zip(log.frame_s, log.sightings, strict=True):
            kind = "sonar_graph_msgs/msg/LandmarkDetections"
            covariance = np.tile(np.array([4e-4, 0.0, 0.0, 8.1e-5]), len(ids))
            yield (
                t,
                "/sonar/landmarks",
                kind,
                TYPES[kind](
                    header(t, "sonar_link"),
                    r,
                    a,
                    covariance,
                    ids,
                    np.ones(len(ids)),
                    np.full(len(ids), -1),
                ),
            )


def write(log: Log, sensors: set[str], path: Path) -> None:
    """Write an MCAP file."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="foreign_logs")
        channels: dict[str, int] = {}
        for t, topic, kind, message in sorted(
            messages(log, sensors), key=lambda row: row[0]
        ):
            if topic not in channels:
                definition, _ = STORE.generate_msgdef(kind, ros_version=2)
                schema = writer.register_schema(kind, "ros2msg", definition.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            ns = round(t * 1e9) + EPOCH_S * 1_000_000_000
            writer.add_message(
                channels[topic], ns, bytes(STORE.serialize_cdr(message, kind)), ns
            )
        writer.finish()


def calibration_of(log: Log) -> str:
    """TOML of what the owner knows."""
    position, rpy = (
        ", ".join(f"{value:.4f}" for value in values) for values in log.start
    )
    arm = ", ".join(map(str, DVL_ARM_M))
    return f"""[start]
position_m = [{position}]
rpy_rad = [{rpy}]
position_sigma_m = [0.05, 0.05, 0.05]
rpy_sigma_rad = [0.02, 0.02, 0.02]
[imu]
gyro_noise_density = 1e-4
accel_noise_density = 1e-3
[dvl]
velocity_sigma_m_s = [0.01, 0.01, 0.01]
[dvl.mounting]
translation_m = [{arm}]
[depth]
sigma_m = 0.02
[heading]
sigma_rad = 0.015
bias_sigma_rad = 0.02
[positions]
sigma_m = [0.35, 0.35, 0.35]
"""


# --- judging -----------------------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """What ``compare`` did with a log."""

    code: int
    lines: list[str]
    error_m: float

    def asks_for(self) -> set[str]:
        """Tables and sections that its doubts and warnings ask to change."""
        text = " ".join(
            line for line in self.lines if line.startswith(("Doubtful", "Warning"))
        )
        asked = set(re.findall(r"under \[(\w+)\]", text))
        return asked | set(re.findall(r"`(\w+)\.[\w.]+ = ", text))


def command(*words: str | Path) -> tuple[int, str]:
    """Exit code and printed text of ``sonar-graph`` with these words, in this process, which is faster."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            main_command([str(word) for word in words])
        except SystemExit as end:
            return int(end.code or 0), printed.getvalue()
    return 0, printed.getvalue()


def judge(log: Log, sensors: set[str], folder: Path) -> Outcome:
    """Run ``compare`` as the owner of the log would."""
    path, vehicle, results = (
        folder / "dive.mcap",
        folder / "vehicle.toml",
        folder / "results",
    )
    write(log, sensors, path)
    vehicle.write_text(calibration_of(log))
    options = ["--calibration", vehicle, "-o", results, "--overwrite"]
    code, text = command("compare", path, *options)
    errors = [0.0]
    for name in ("isam2", "ekf-slam"):
        file = results / "runs" / name / "causal.tum"
        if code in (0, 3) and file.exists():
            rows = np.loadtxt(file)
            seconds = rows[:, 0] - EPOCH_S
            true = np.column_stack(
                [
                    np.interp(seconds, log.truth[:, 0], column)
                    for column in log.truth[:, 1:].T
                ]
            )
            errors.append(
                float(np.sqrt(np.mean(np.sum((rows[:, 1:4] - true) ** 2, axis=1))))
            )
    return Outcome(code, text.splitlines(), max(errors))


def sensors_of(fault: str, seed: int) -> set[str]:
    """Sensors of a log beside IMU, Doppler log and depth: those of the fault, and others by its number."""
    every = ({"sonar"}, {"heading", "fixes"}, {"sonar", "heading"})[seed % 3]
    needed = {
        "heading": {"heading"},
        "fix": {"fixes"},
        "range": {"sonar"},
        "azimuth": {"sonar"},
    }
    of_fault = needed.get(fault.partition(" ")[0], set())
    if fault in ("heading turned", "heading late", "heading stuck"):
        of_fault = {"heading", "fixes"}
    if fault in ("gyro scale", "gyro bias"):
        of_fault = {"heading"}
    return every | of_fault


def measure(
    arguments: argparse.Namespace, folder: Path
) -> tuple[Counter[str], list[tuple[Any, ...]]]:
    """Counts, and a row for each log."""
    counts, rows = Counter[str](), list[tuple[Any, ...]]()
    for seed in range(arguments.faultless):
        outcome = judge(make_log(1000 + seed), sensors_of("", seed), folder)
        is_alarm = bool(outcome.asks_for()) or outcome.code != 0
        counts["faultless"] += 1
        counts["false_alarms"] += is_alarm
        rows.append(
            (
                "faultless",
                seed,
                outcome.code,
                outcome.error_m,
                "",
                "false alarm" if is_alarm else "",
            )
        )
        if is_alarm:
            note(
                "\n".join(
                    line[:400]
                    for line in outcome.lines
                    if line.startswith(("Doubt", "Warn", "sonar"))
                )
            )
    for name, fault in FAULTS.items():
        if arguments.only and name not in arguments.only:
            continue
        for place, size in enumerate(fault.sizes[: arguments.sizes]):
            seed = place + 3 * list(FAULTS).index(name)
            sensors = sensors_of(name, seed)
            right = judge(make_log(seed), sensors, folder)
            log = make_log(seed)
            fault.spoil(log, size)
            outcome = judge(log, sensors, folder)
            is_worse = outcome.error_m > WORSE * max(
                right.error_m, LEAST_ERROR_M / WORSE
            )
            is_named = any(re.search(fault.words, line) for line in outcome.lines)
            verdict = ""
            if outcome.code not in (0, 3):
                verdict = "refused" if is_named else "unhelpful"
            elif outcome.asks_for() - set(fault.roles):
                verdict = "misled"
            elif is_worse and not is_named:
                verdict = "silent"
            elif is_worse and outcome.code == 0:
                verdict = "warned"
            counts["logs"] += 1
            counts[verdict or "right"] += 1
            rows.append(
                (name, size, outcome.code, outcome.error_m, right.error_m, verdict)
            )
            if verdict:
                note(
                    f"{name} {size:g}: {verdict}, {outcome.error_m:.2f} m, {sorted(sensors)}"
                )
                note(
                    "\n".join(
                        line[:400]
                        for line in outcome.lines
                        if line.startswith(("Doubt", "Warn", "sonar"))
                    )
                )
    return counts, rows


TRUE_VALUES = {
    "DVL against IMU: time offset": 0.0,
    "DVL mounting yaw": 0.0,
    "DVL scale": 1.0,
    "lever arm from IMU to DVL, x": DVL_ARM_M[0],
    "lever arm from IMU to DVL, y": DVL_ARM_M[1],
    "depth: change over": 1.0,
    "depth against": 0.0,
    "heading: turn over": 1.0,
    "heading against": 0.0,
    "position fixes: change": 1.0,
    "position fixes against": 0.0,
    "ranges to landmarks: change": 1.0,
    "azimuths of landmarks: change": 1.0,
}


def coverage(count: int, folder: Path) -> list[tuple[str, int, float, float]]:
    """How often the intervals of ``inspect`` hold the true value: quantity, logs, share, rms of error over sigma."""
    ratios: dict[str, list[float]] = {}
    for seed in range(count):
        log = make_log(2000 + seed)
        path, vehicle = folder / "dive.mcap", folder / "vehicle.toml"
        write(log, {"sonar", "heading", "fixes"}, path)
        vehicle.write_text(calibration_of(log))
        _, text = command("inspect", path, "--calibration", vehicle, "--json")
        for finding in json.loads(text)["sensors"]:
            for name, true in TRUE_VALUES.items():
                if (
                    finding["quantity"].startswith(name)
                    and finding["value"] is not None
                ):
                    ratios.setdefault(name, []).append(
                        (finding["value"] - true) / finding["sigma"]
                    )
    return [
        (
            name,
            len(found),
            float(np.mean(np.abs(found) < 1.96)),
            float(np.sqrt(np.mean(np.square(found)))),
        )
        for name, found in ratios.items()
    ]


def main() -> None:
    """Measure and print."""
    parser = make_parser(__doc__)
    parser.add_argument(
        "--faultless", type=int, default=50, help="logs without a fault"
    )
    parser.add_argument("--sizes", type=int, default=3, help="sizes of each fault")
    parser.add_argument(
        "--coverage", type=int, default=0, help="logs for the coverage of intervals"
    )
    parser.add_argument(
        "--only", nargs="*", default=[], metavar="FAULT", help="faults to measure"
    )
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.faultless = min(arguments.faultless, 2)
        arguments.sizes = 1
        arguments.only = arguments.only or [
            "depth unit",
            "fix stuck",
            "velocity left is right",
            "azimuth sense",
        ]
    with tempfile.TemporaryDirectory() as folder:
        counts, rows = measure(arguments, Path(folder))
        print_table(
            ("fault", "size", "exit code", "error (m)", "without (m)", "verdict"), rows
        )
        if arguments.coverage:
            print_table(
                ("quantity", "logs", "95 % held", "rms error / sigma"),
                coverage(arguments.coverage, Path(folder)),
            )
    wanted = (
        "logs",
        "right",
        "silent",
        "warned",
        "misled",
        "unhelpful",
        "refused",
        "faultless",
        "false_alarms",
    )
    print_figures({name: counts[name] for name in wanted})


if __name__ == "__main__":
    main()
