"""Dives by another hand: worlds, sensors and files that share no code with the package.

Paths are splines of scipy, messages are serialised by `rosbags`, files are written by `mcap`. A seed draws the world
(`World.draw`): style of motion, depth, speed, rates, noise, lever arms, gaps of bottom lock, and sensors. Errors of
sensors are white and correlated (Gauss-Markov). `make_log` gives the rows of every sensor, `write` a file, and
`calibration_of` what the owner of the vehicle knows. `foreign_logs.py` puts faults into these logs.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
DURATION_S = 60.0
EPOCH_S = 1_760_000_000
GRAVITY_M_S2 = 9.80665
GRAVITY = np.array([0.0, 0.0, GRAVITY_M_S2])
ATMOSPHERE_PA = 101_325.0
PASCALS_PER_METRE = 1000.0 * GRAVITY_M_S2
KNOT_S = 3.0
FIELD_OF_VIEW_RAD = 0.8
LONGEST_RANGE_M = 12.0
LANDMARKS = 30
HUGE_VARIANCE = 1e9
"""With which some drivers mark what they did not measure."""
DETECTIONS = """std_msgs/Header header
float64[] range_m
float64[] azimuth_rad
float64[] covariance
int64[] candidate_ids
float64[] id_probability
int64[] track"""
HEADING = """std_msgs/Header header
float64 yaw_rad
float64 sigma_rad"""


STYLES = (
    "wander",
    "wander",
    "straight",
    "mower",
    "hover",
    "profile",
    "sideways",
    "waves",
)
"""Ways of motion: legs and turns are those of a mower, a hovering vehicle begins at rest, a profile goes up and down."""


@dataclass(frozen=True)
class World:
    """What differs between two dives."""

    style: str
    """One of `STYLES`."""
    depth_m: float
    speed_m_s: float
    imu_hz: float
    dvl_hz: float
    aiding_hz: float
    """Of depth and heading."""
    fix_hz: float
    noise: float
    """Factor on the noise of every sensor; the calibration has it too."""
    dvl_arm_m: Floats
    imu_arm_m: Floats
    port_m: Floats
    antenna_m: Floats
    sonar_arm_m: Floats
    sensors: frozenset[str]
    """Of depth, heading, fixes, sonar, names: the latter where sightings have identities."""
    has_pressure: bool
    """Depth comes as a pressure, not as a height."""
    has_yaw_message: bool
    """Heading comes as an angle, not as a quaternion."""
    is_start_stated: bool
    gaps_s: tuple[tuple[float, float], ...]
    """Without bottom lock."""
    wild_share: float
    """Of the rows of Doppler log, depth, heading and fixes, which are far off, as right sensors have them at times."""

    @classmethod
    def draw(cls, rng: np.random.Generator, needs: frozenset[str]) -> "World":
        """World with at least the sensors that a fault needs."""
        share = {
            "depth": 0.85,
            "heading": 0.6,
            "fixes": 0.5,
            "sonar": 0.6,
            "names": 0.7,
        }
        sensors = (
            frozenset(name for name, p in share.items() if rng.random() < p) | needs
        )
        is_measured = {"heading", "fixes", "depth"} <= sensors
        gaps_s = [
            (float(begin), float(begin + rng.uniform(2.0, 6.0)))
            for begin in rng.uniform(8.0, 50.0, rng.integers(3))
        ]
        return cls(
            style=str(rng.choice(STYLES)),
            depth_m=float(rng.uniform(1.0, 60.0)),
            speed_m_s=float(rng.uniform(0.3, 1.5)),
            imu_hz=float(rng.choice([20.0, 50.0, 100.0, 200.0])),
            dvl_hz=float(rng.choice([1.0, 2.0, 4.0, 8.0])),
            aiding_hz=float(rng.choice([1.0, 5.0, 10.0])),
            fix_hz=float(rng.choice([0.5, 1.0, 2.0])),
            noise=float(rng.choice([0.5, 1.0, 2.0])),
            dvl_arm_m=rng.uniform(-0.4, 0.4, 3),
            imu_arm_m=rng.uniform(-0.2, 0.2, 3),
            port_m=rng.uniform(-0.3, 0.3, 3),
            antenna_m=rng.uniform(-0.3, 0.3, 3),
            sonar_arm_m=rng.uniform(-0.3, 0.3, 3),
            sensors=sensors,
            has_pressure=bool(rng.random() < 0.4),
            has_yaw_message=bool(rng.random() < 0.5),
            is_start_stated=not (is_measured and rng.random() < 0.4),
            gaps_s=tuple(gaps_s),
            wild_share=float(rng.choice([0.0, 0.01])),
        )


@dataclass
class Log:
    """Rows of every sensor; times in seconds from the start."""

    world: World
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
    unmeasured: dict[str, Mask] = field(default_factory=dict)
    """Rows that their driver marks, by sensor: rate, force, velocity, depth, heading, fixes; frames of sonar."""


# --- world and sensors -------------------------------------------------------------------------------------------


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


def motion(
    world: World, rng: np.random.Generator
) -> tuple[CubicSpline, RotationSpline]:
    """Position and attitude of the body over the dive."""
    knots = np.arange(-2 * KNOT_S, DURATION_S + 4 * KNOT_S, KNOT_S)
    n = len(knots)
    speed = world.speed_m_s * (1.0 + 0.15 * rng.standard_normal(n))
    steps_rad = rng.normal(0.0, 0.35, n)
    climbs_m = rng.normal(0.0, 0.5, n)
    if world.style == "straight":
        steps_rad *= 0.05
        climbs_m *= 0.1
    elif world.style == "mower":
        leg = np.arange(n) % 12
        steps_rad = (
            0.05 * steps_rad
            + np.pi / 2 * np.isin(leg, (4, 5))
            - np.pi / 2 * np.isin(leg, (10, 11))
        )
    elif world.style == "hover":
        is_hovering = knots < DURATION_S / 2
        speed[is_hovering] *= 0.03
        steps_rad[is_hovering] *= 0.1
        climbs_m[is_hovering] *= 0.05
    yaw = np.cumsum(steps_rad) + rng.uniform(-np.pi, np.pi)
    sway = 0.12 * world.speed_m_s * rng.standard_normal(n)
    level = np.cumsum(KNOT_S * (speed + 1j * sway) * np.exp(1j * yaw)) + complex(
        *rng.uniform(-50.0, 50.0, 2)
    )
    z = -world.depth_m + np.cumsum(climbs_m)
    if world.style == "profile":
        level = level[0] + 0.05 * (level - level[0])
        z = z + 4.0 * np.sin(2.0 * np.pi * knots / rng.uniform(25.0, 50.0))
    elif world.style == "sideways":
        yaw = yaw + rng.uniform(-np.pi, np.pi)
    z = np.minimum(z, -0.5)
    tilt = 0.04 * rng.standard_normal((2, n))
    attitudes = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt[0], tilt[1]]))
    place = CubicSpline(knots, np.column_stack([level.real, level.imag, z]))
    attitude = RotationSpline(knots, attitudes)
    return swung(place, attitude, rng) if world.style == "waves" else (place, attitude)


def swung(
    place: CubicSpline, attitude: RotationSpline, rng: np.random.Generator
) -> tuple[CubicSpline, RotationSpline]:
    """The motion with a swell from one side, in which the vehicle heaves, is carried to and fro, rolls and pitches."""
    t = np.arange(-15.0, DURATION_S + 25.0, 0.25)
    phase = 2.0 * np.pi * t / rng.uniform(4.0, 9.0)
    side = rng.uniform(-np.pi, np.pi)
    carried = np.outer(np.cos(phase), [np.cos(side), np.sin(side), 0.0])
    heave = np.outer(np.sin(phase), [0.0, 0.0, 1.0])
    shifts = rng.uniform(0.0, 2.0 * np.pi, 3)
    angles = np.column_stack([np.sin(phase + shift) for shift in shifts])
    turn = np.radians(rng.uniform(2.0, 6.0)) * angles * [0.3, 0.6, 1.0]
    places = place(t) + rng.uniform(0.2, 0.6) * (carried + heave)
    attitudes = attitude(t) * Rotation.from_euler("ZYX", turn)
    return CubicSpline(t, places), RotationSpline(t, attitudes)


def make_log(seed: list[int], needs: frozenset[str] = frozenset()) -> Log:
    """One dive of `DURATION_S` without a fault, in a world by its seed."""
    rng = np.random.default_rng(seed)
    world = World.draw(rng, needs)
    place, attitude = motion(world, rng)
    noise = world.noise
    imu_s = np.arange(0.0, DURATION_S, 1.0 / world.imu_hz)
    dvl_s = np.arange(0.0, DURATION_S, 1.0 / world.dvl_hz)
    has_lock = ~np.any(
        [
            (dvl_s > begin) & (dvl_s < end)
            for begin, end in [*world.gaps_s, (-2.0, -1.0)]
        ],
        axis=0,
    )
    dvl_s = dvl_s[has_lock]
    depth_s = np.arange(0.0, DURATION_S, 1.0 / world.aiding_hz)
    heading_s = depth_s.copy()
    fix_s = np.arange(0.0, DURATION_S, 1.0 / world.fix_hz)
    frame_s = np.arange(0.0, DURATION_S, 1.0)

    white = noise * np.sqrt(world.imu_hz)
    rate = attitude(imu_s, 1)
    arm = world.imu_arm_m
    swing = np.cross(attitude(imu_s, 2), arm) + np.cross(rate, np.cross(rate, arm))
    force = attitude(imu_s).inv().apply(place(imu_s, 2) + GRAVITY) + swing
    rate = rate + rng.normal(0, 1e-4 * white, rate.shape) + rng.normal(0, 4e-5, 3)
    force = force + rng.normal(0, 1e-3 * white, force.shape) + rng.normal(0, 5e-3, 3)

    velocity = attitude(dvl_s).inv().apply(place(dvl_s, 1)) + np.cross(
        attitude(dvl_s, 1), world.dvl_arm_m
    )
    slow = np.column_stack(
        [gauss_markov(rng, dvl_s, 0.002 * noise, 5.0) for _ in range(3)]
    )
    velocity = (
        velocity * (1 + rng.normal(0, 0.001))
        + slow
        + rng.normal(0, 0.01 * noise, velocity.shape)
    )

    z_m = place(depth_s)[:, 2] + attitude(depth_s).apply(world.port_m)[:, 2]
    z_m = (
        z_m
        + gauss_markov(rng, depth_s, 0.01 * noise, 3.0)
        + rng.normal(0, 0.01 * noise, len(depth_s))
    )
    yaw_rad = attitude(heading_s).as_euler("ZYX")[:, 0]
    yaw_rad = (
        yaw_rad
        + gauss_markov(rng, heading_s, 0.01 * noise, 20.0)
        + rng.normal(0, 0.01 * noise, len(heading_s))
    )
    fix_m = place(fix_s) + attitude(fix_s).apply(world.antenna_m)
    wander = np.column_stack(
        [gauss_markov(rng, fix_s, 0.15 * noise, 10.0) for _ in range(3)]
    )
    fix_m = fix_m + wander + rng.normal(0, 0.3 * noise, (len(fix_s), 3))

    for values, size in (
        (velocity, 3.0),
        (z_m, 5.0),
        (yaw_rad, 2.0),
        (fix_m, 20.0),
    ):
        is_wild = rng.random(len(values)) < world.wild_share
        values[is_wild] += rng.uniform(-size, size, values[is_wild].shape)

    yaw_0, pitch_0, roll_0 = attitude(0.0).as_euler("ZYX")
    return Log(
        world=world,
        imu_s=imu_s,
        rate=rate,
        force=force,
        dvl_s=dvl_s,
        velocity=velocity,
        depth_s=depth_s,
        z_m=z_m,
        heading_s=heading_s,
        yaw_rad=yaw_rad,
        fix_s=fix_s,
        fix_m=fix_m,
        frame_s=frame_s,
        sightings=list(sightings(world, rng, place, attitude, frame_s)),
        start=(place(0.0), np.array([roll_0, pitch_0, yaw_0])),
        truth=np.column_stack([imu_s, place(imu_s)]),
    )


def sightings(
    world: World,
    rng: np.random.Generator,
    place: CubicSpline,
    attitude: RotationSpline,
    frame_s: Floats,
) -> Iterator[tuple[NDArray[np.int64], Floats, Floats]]:
    """Identities, ranges and azimuths of the landmarks that each frame shows."""
    way = place(np.linspace(0, DURATION_S, LANDMARKS))
    landmarks = way + np.column_stack(
        [rng.normal(0, 5.0, (LANDMARKS, 2)), rng.normal(0, 0.3, LANDMARKS)]
    )
    for second in frame_s:
        seen = (
            attitude(second).inv().apply(landmarks - place(second)) - world.sonar_arm_m
        )
        distance = np.linalg.norm(seen, axis=1)
        azimuth = np.arctan2(seen[:, 1], seen[:, 0])
        elevation = np.arcsin(seen[:, 2] / distance)
        is_near = (distance > 1.0) & (distance < LONGEST_RANGE_M)
        ids = np.flatnonzero(
            is_near & (np.abs(azimuth) < FIELD_OF_VIEW_RAD) & (np.abs(elevation) < 0.12)
        )
        noisy_r = distance[ids] + rng.normal(0, 0.02 * world.noise, len(ids))
        noisy_a = azimuth[ids] + rng.normal(0, 0.009 * world.noise, len(ids))
        yield ids.astype(np.int64), noisy_r, noisy_a


# --- messages ----------------------------------------------------------------------------------------------------

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(
    get_types_from_msg(DETECTIONS, "sonar_graph_msgs/msg/LandmarkDetections")
)
STORE.register(get_types_from_msg(HEADING, "sonar_graph_msgs/msg/Heading"))
TYPES = STORE.types
IMU = "sensor_msgs/msg/Imu"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
PRESSURE = "sensor_msgs/msg/FluidPressure"
QUATERNION = "geometry_msgs/msg/QuaternionStamped"
YAW = "sonar_graph_msgs/msg/Heading"
SEEN = "sonar_graph_msgs/msg/LandmarkDetections"
Row = tuple[float, str, str, Any]
"""Time, topic, type and message."""


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


def quaternion(yaw_rad: float) -> Any:
    """Quaternion of a yaw; without a direction for NaN."""
    xyzw = (
        np.zeros(4)
        if np.isnan(yaw_rad)
        else Rotation.from_euler("z", yaw_rad).as_quat()
    )
    return TYPES["geometry_msgs/msg/Quaternion"](*map(float, xyzw))


def pose(seconds: float, values: Any, variance: float) -> Any:
    """PoseWithCovarianceStamped of a position."""
    covariance = np.zeros(36)
    covariance[[0, 7, 14]] = variance
    point = TYPES["geometry_msgs/msg/Point"](*map(float, values))
    inner = TYPES["geometry_msgs/msg/Pose"](point, quaternion(0.0))
    with_covariance = TYPES["geometry_msgs/msg/PoseWithCovariance"](inner, covariance)
    return TYPES[POSE](header(seconds, "map"), with_covariance)


def marked(log: Log, sensor: str, count: int) -> Mask:
    """Rows that the driver marks as not measured, shape (n,)."""
    return log.unmeasured.get(sensor, np.zeros(count, bool))


def imu_rows(log: Log) -> Iterator[Row]:
    """Rates and forces; what is not measured has -1 in its covariance, as the message's definition has it."""
    unknown = np.zeros(9)
    absent = np.zeros(9)
    absent[0] = -1.0
    no_turn = quaternion(0.0)
    rates_marked = marked(log, "rate", len(log.imu_s))
    forces_marked = marked(log, "force", len(log.imu_s))
    for k, t in enumerate(log.imu_s):
        of_rate = absent if rates_marked[k] else unknown
        of_force = absent if forces_marked[k] else unknown
        rate = vector(log.rate[k])
        force = vector(log.force[k])
        yield (
            t,
            "/imu/data",
            IMU,
            TYPES[IMU](
                header(t, "imu_link"), no_turn, absent, rate, of_rate, force, of_force
            ),
        )


def dvl_rows(log: Log) -> Iterator[Row]:
    """Velocities, with a huge variance where marked."""
    is_marked = marked(log, "velocity", len(log.dvl_s))
    for k, t in enumerate(log.dvl_s):
        covariance = np.zeros(36)
        covariance[[0, 7, 14]] = (
            HUGE_VARIANCE if is_marked[k] else (0.01 * log.world.noise) ** 2
        )
        twist = TYPES["geometry_msgs/msg/Twist"](
            vector(log.velocity[k]), vector(np.zeros(3))
        )
        with_covariance = TYPES["geometry_msgs/msg/TwistWithCovariance"](
            twist, covariance
        )
        yield (
            t,
            "/dvl/twist",
            TWIST,
            TYPES[TWIST](header(t, "dvl_link"), with_covariance),
        )


def depth_rows(log: Log) -> Iterator[Row]:
    """Heights, or pressures, with a huge variance where marked."""
    is_marked = marked(log, "depth", len(log.depth_s))
    for k, t in enumerate(log.depth_s):
        variance = HUGE_VARIANCE if is_marked[k] else (0.015 * log.world.noise) ** 2
        if log.world.has_pressure:
            pascals = ATMOSPHERE_PA - PASCALS_PER_METRE * log.z_m[k]
            message = TYPES[PRESSURE](
                header(t, "depth_link"), float(pascals), variance * PASCALS_PER_METRE**2
            )
            yield t, "/depth/pressure", PRESSURE, message
        else:
            yield t, "/depth/pose", POSE, pose(t, (0.0, 0.0, log.z_m[k]), variance)


def heading_rows(log: Log) -> Iterator[Row]:
    """Angles with a sigma, or quaternions; where marked a huge sigma, or no quaternion."""
    is_marked = marked(log, "heading", len(log.heading_s))
    for k, t in enumerate(log.heading_s):
        if log.world.has_yaw_message:
            sigma = HUGE_VARIANCE if is_marked[k] else 0.014 * log.world.noise
            yield (
                t,
                "/heading",
                YAW,
                TYPES[YAW](header(t, "map"), float(log.yaw_rad[k]), sigma),
            )
        else:
            turn = quaternion(np.nan if is_marked[k] else log.yaw_rad[k])
            yield t, "/heading", QUATERNION, TYPES[QUATERNION](header(t, "map"), turn)


def fix_rows(log: Log) -> Iterator[Row]:
    """Positions, with a huge variance where marked."""
    is_marked = marked(log, "fixes", len(log.fix_s))
    for k, t in enumerate(log.fix_s):
        variance = HUGE_VARIANCE if is_marked[k] else (0.34 * log.world.noise) ** 2
        yield t, "/usbl/fix_pose", POSE, pose(t, log.fix_m[k], variance)


def sonar_rows(log: Log) -> Iterator[Row]:
    """Sightings of every frame, with identities or with tracks alone."""
    covariance_of_one = np.diag([4e-4, 8.1e-5]).ravel() * log.world.noise**2
    for t, (ids, r, a) in zip(log.frame_s, log.sightings, strict=True):
        n = len(ids)
        is_named = "names" in log.world.sensors
        names = ids if is_named else np.full(n, -1)
        tracks = np.full(n, -1) if is_named else ids
        probability = np.full(n, 1.0 if is_named else 0.0)
        covariance = np.tile(covariance_of_one, n)
        message = TYPES[SEEN](
            header(t, "sonar_link"), r, a, covariance, names, probability, tracks
        )
        yield t, "/sonar/landmarks", SEEN, message


def write(log: Log, path: Path) -> None:
    """Write an MCAP file with the sensors of the world."""
    rows = [*imu_rows(log), *dvl_rows(log)]
    for sensor, of_sensor in {
        "depth": depth_rows,
        "heading": heading_rows,
        "fixes": fix_rows,
        "sonar": sonar_rows,
    }.items():
        if sensor in log.world.sensors:
            rows += of_sensor(log)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="foreign_world")
        channels: dict[str, int] = {}
        for t, topic, kind, message in sorted(rows, key=lambda row: row[0]):
            if topic not in channels:
                definition, _ = STORE.generate_msgdef(kind, ros_version=2)
                schema = writer.register_schema(kind, "ros2msg", definition.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            ns = round(t * 1e9) + EPOCH_S * 1_000_000_000
            writer.add_message(
                channels[topic], ns, bytes(STORE.serialize_cdr(message, kind)), ns
            )
        writer.finish()


def numbers(values: Floats) -> str:
    """Array of TOML."""
    return "[" + ", ".join(f"{value:.5f}" for value in values) + "]"


def calibration_of(log: Log) -> str:
    """TOML of what the owner knows."""
    world = log.world
    position, rpy = log.start
    stated = f"""[start]
position_m = {numbers(position)}
rpy_rad = {numbers(rpy)}
position_sigma_m = [0.05, 0.05, 0.05]
rpy_sigma_rad = [0.02, 0.02, 0.02]
"""
    return f"""{stated if world.is_start_stated else ""}[imu]
gyro_noise_density = {1e-4 * world.noise}
accel_noise_density = {1e-3 * world.noise}
mounting.translation_m = {numbers(world.imu_arm_m)}
[dvl]
velocity_sigma_m_s = [{0.01 * world.noise}, {0.01 * world.noise}, {0.01 * world.noise}]
mounting.translation_m = {numbers(world.dvl_arm_m)}
[depth]
sigma_m = {0.015 * world.noise}
port_m = {numbers(world.port_m)}
[heading]
sigma_rad = {0.014 * world.noise}
bias_sigma_rad = {0.02 * world.noise}
[positions]
sigma_m = [{0.34 * world.noise}, {0.34 * world.noise}, {0.34 * world.noise}]
antenna_m = {numbers(world.antenna_m)}
[sonar]
mounting.translation_m = {numbers(world.sonar_arm_m)}
"""
