"""Faults of foreign logs: every cell of the table of checks at three sizes (`foreign_logs.py` judges them).

A row of the table names a quantity, a kind of fault, the sizes, the function that puts the fault into a log of
`foreign_world.py`, what a line must contain to name its cause, the sections that a line may ask to change, and the
sensors without which the fault has no effect or no witness.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from foreign_world import Floats, Log, Mask
from scipy.spatial.transform import Rotation

BURST_S = 2.0
"""Typical length of a stretch without measurements."""

Spoil = Callable[[Log, float], None]


@dataclass(frozen=True)
class Fault:
    """A fault, its sizes, and what a line must contain to name its cause."""

    quantity: str
    kind: str
    detail: str
    """What the sizes are."""
    sizes: tuple[float, ...]
    spoil: Spoil
    words: str
    """Regular expression of the cause."""
    roles: frozenset[str]
    """Tables and sections that a line may ask to change."""
    needs: frozenset[str] = frozenset()
    """Sensors beside IMU and Doppler log, without which the fault has no effect or no witness."""

    @property
    def name(self) -> str:
        """Name for the results."""
        return f"{self.quantity}: {self.kind}, {self.detail}"


def stuck(times: str, values: str) -> Spoil:
    """Repeat one value from an instant on."""

    def spoil(log: Log, from_s: float) -> None:
        later = getattr(log, times) >= from_s
        column = getattr(log, values)
        column[later] = column[np.argmax(later)]

    return spoil


def late(times: str) -> Spoil:
    """Add seconds to the stamps."""

    def spoil(log: Log, seconds: float) -> None:
        setattr(log, times, getattr(log, times) + seconds)

    return spoil


def scaled(values: str) -> Spoil:
    """Multiply the values."""

    def spoil(log: Log, factor: float) -> None:
        setattr(log, values, getattr(log, values) * factor)

    return spoil


def turned(values: str, axes: Floats) -> Spoil:
    """Turn or mirror vectors: new = axes @ old; the size does not matter."""

    def spoil(log: Log, _: float) -> None:
        setattr(log, values, getattr(log, values) @ axes.T)

    return spoil


def leaning(axis: str, *columns: str) -> Spoil:
    """Turn vectors about a level axis, by degrees."""

    def spoil(log: Log, degrees: float) -> None:
        turn = Rotation.from_euler(axis, degrees, degrees=True)
        for values in columns:
            setattr(log, values, turn.apply(getattr(log, values)))

    return spoil


def one_axis_negated(values: str) -> Spoil:
    """Negate the axis that the size numbers."""

    def spoil(log: Log, axis: float) -> None:
        getattr(log, values)[:, int(axis)] *= -1

    return spoil


def added(values: str, factor: float = 1.0) -> Spoil:
    """Add a constant, the size times a factor."""

    def spoil(log: Log, size: float) -> None:
        setattr(log, values, getattr(log, values) + size * factor)

    return spoil


def clockwise(log: Log, _: float) -> None:
    log.yaw_rad = np.pi / 2 - log.yaw_rad


def in_world(log: Log, _: float) -> None:
    """Velocities along axes of the world, as the twist of an odometry message in the wrong frame."""
    roll, pitch, yaw = log.start[1]
    turns = Rotation.from_rotvec(log.rate[:-1] * np.diff(log.imu_s)[:, None])
    attitudes = [Rotation.from_euler("ZYX", [yaw, pitch, roll])]
    for step in turns:
        attitudes.append(attitudes[-1] * step)
    at = np.searchsorted(log.imu_s, log.dvl_s).clip(max=len(attitudes) - 1)
    log.velocity = Rotation.concatenate([attitudes[k] for k in at]).apply(log.velocity)


def bias_of_yaw_rate(log: Log, rad_s: float) -> None:
    log.rate[:, 2] += rad_s


def bias_of_force(log: Log, m_s2: float) -> None:
    log.force[:, 0] += m_s2


def scale_ranges(log: Log, factor: float) -> None:
    log.sightings = [(ids, r * factor, a) for ids, r, a in log.sightings]


def scale_azimuths(log: Log, factor: float) -> None:
    log.sightings = [(ids, r, a * factor) for ids, r, a in log.sightings]


def repeat_frames(log: Log, from_s: float) -> None:
    first = int(np.argmax(log.frame_s >= from_s))
    first = next(
        (k for k in range(first, len(log.frame_s)) if len(log.sightings[k][0])), first
    )
    log.sightings[first:] = [log.sightings[first]] * (len(log.frame_s) - first)


def hold_azimuths(log: Log, from_s: float) -> None:
    """All landmarks have one azimuth from an instant on."""
    later = np.flatnonzero(log.frame_s >= from_s)
    held = next((float(a[0]) for _, _, a in log.sightings[later[0] :] if len(a)), 0.0)
    for k in later:
        ids, r, _ = log.sightings[k]
        log.sightings[k] = (ids, r, np.full(len(ids), held))


def bursts(times: Floats, share: float) -> Mask:
    """Rows in stretches of some seconds, a share of all; the first five seconds are whole."""
    rng = np.random.default_rng(round(1e3 * share))
    period_s = BURST_S / share
    phase_s = rng.uniform(0.0, period_s)
    return ((times + phase_s) % period_s < BURST_S) & (times > 5.0)


@dataclass(frozen=True)
class Marked:
    """Rows that hold no measurement and are marked by their driver, or are not finite.

    ``without``: the same log as it is where a driver sends nothing instead.
    """

    sensor: str
    times: str
    values: str
    is_finite: bool

    def __call__(self, log: Log, share: float) -> None:
        """Put zeros into marked rows, or NaN."""
        times = getattr(log, self.times)
        rows = bursts(times, share)
        getattr(log, self.values)[rows] = 0.0 if self.is_finite else np.nan
        if self.is_finite:
            log.unmeasured[self.sensor] = rows

    def without(self, log: Log, share: float) -> None:
        """Leave the rows out; of an IMU without forces, the forces."""
        rows = bursts(getattr(log, self.times), share)
        if self.sensor == "force":
            log.force[rows] = np.nan
            return
        of_message = ("rate", "force") if self.sensor == "rate" else (self.values,)
        for name in (self.times, *of_message):
            setattr(log, name, getattr(log, name)[~rows])


@dataclass(frozen=True)
class MarkedSightings:
    """Sightings whose range (1) or azimuth (2) is not finite."""

    column: int

    def __call__(self, log: Log, share: float) -> None:
        """Put NaN into the frames of some stretches."""
        for k in np.flatnonzero(bursts(log.frame_s, share)):
            of_frame = list(log.sightings[k])
            of_frame[self.column] = np.full(len(of_frame[0]), np.nan)
            log.sightings[k] = tuple(of_frame)

    def without(self, log: Log, share: float) -> None:
        """Leave the sightings out."""
        for k in np.flatnonzero(bursts(log.frame_s, share)):
            log.sightings[k] = tuple(part[:0] for part in log.sightings[k])


FROM_S = (15.0, 30.0, 45.0)
SHARES = (0.1, 0.3, 0.5)
AGAIN = (0.0, 1.0, 2.0)
"""Of faults without a size: three worlds."""
DEGREE = float(np.degrees(1.0))
FOOT = 1 / 0.3048
FROM, NEGATED, SENSE = "from a second on", "axis negated", "axes or sense"
LEFT_OUT = r"left out|not measured|no velocity|no sample|not finite|not used"
MIRRORS = {
    "y negated": np.diag([1, -1, 1]),
    "x and y negated": np.diag([-1, -1, 1]),
    "z negated": np.diag([1, 1, -1]),
    "y and z negated": np.diag([1, -1, -1]),
    "negated": -np.eye(3),
}
X_Y = np.eye(3)[[1, 0, 2]]
X_Z = np.eye(3)[[2, 1, 0]]
QUARTER_TURN = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])


def roles(*names: str) -> frozenset[str]:
    return frozenset(names)


LEANS = (5.0, 15.0, 30.0)
LEANING = r"mounting (roll|pitch)|pitch of Doppler log or IMU|start (roll|pitch): value"
EITHER = roles("imu", "dvl", "start")


# fmt: off
def of_angular_rate() -> Iterator[Fault]:
    row = partial(Fault, "angular rate", roles=roles("imu"))
    gyro = r"angular rate|gyro"
    yield row("stuck", FROM, FROM_S, stuck("imu_s", "rate"), r"angular rate.*same|gyro")
    imu_late = late("imu_s")
    words = r"DVL against IMU|those of the IMU too"
    yield row("late", "seconds, of all IMU rows", (0.5, 1.0, 1.5), imu_late, words, roles=roles("imu", "dvl"))
    yield row(SENSE, NEGATED, AGAIN, one_axis_negated("rate"), gyro)
    yield row(SENSE, "x and z exchanged", AGAIN, turned("rate", X_Z), gyro)
    of_imu = leaning("x", "rate", "force"), leaning("y", "rate", "force")
    yield row(SENSE, "IMU rolled, degrees", LEANS, of_imu[0], LEANING, roles=EITHER)
    yield row(SENSE, "IMU pitched, degrees", LEANS, of_imu[1], LEANING, roles=EITHER)
    yield row("unit", "degrees", (DEGREE, DEGREE, DEGREE), scaled("rate"), r"gyro.*degrees")
    row = partial(row, needs=roles("heading"))
    yield row("scale", "factor", (1.02, 1.05, 0.95), scaled("rate"), r"angular_velocity_scale")
    yield row("scale", "bias of yaw, rad/s", (0.005, 0.01, -0.02), bias_of_yaw_rate, r"gyro bias")
    row = partial(row, needs=roles())
    yield row("marked invalid", "share, -1 as covariance", SHARES, Marked("rate", "imu_s", "rate", True), LEFT_OUT)
    yield row("marked invalid", "share, NaN", SHARES, Marked("rate", "imu_s", "rate", False), LEFT_OUT)


def of_specific_force() -> Iterator[Fault]:
    row = partial(Fault, "specific force", roles=roles("imu"))
    force = r"specific force|accelerometer|gravity"
    yield row("stuck", FROM, FROM_S, stuck("imu_s", "force"), r"specific force.*same")
    yield row(SENSE, "negated", AGAIN, turned("force", -np.eye(3)), force)
    yield row(SENSE, "x and z exchanged", AGAIN, turned("force", X_Z), force)
    yield row(SENSE, "x and y exchanged", AGAIN, turned("force", X_Y), force)
    yield row("unit", "g, mg, cm/s2", (1 / 9.80665, 1e3 / 9.80665, 1e2), scaled("force"), force)
    yield row("scale", "factor", (1.05, 1.25, 0.8), scaled("force"), force)
    yield row("scale", "bias of x, m/s2", (0.1, 0.3, -0.5), bias_of_force, r"accelerometer bias|start (roll|pitch): value")
    yield row("marked invalid", "share, -1 as covariance", SHARES, Marked("force", "imu_s", "force", True), LEFT_OUT)
    yield row("marked invalid", "share, NaN", SHARES, Marked("force", "imu_s", "force", False), LEFT_OUT)


def of_velocity() -> Iterator[Fault]:
    row = partial(Fault, "velocity", roles=roles("dvl"))
    yield row("stuck", FROM, FROM_S, stuck("dvl_s", "velocity"), r"(velocity|DVL).*(same|stuck|repeat)")
    yield row("late", "seconds", (0.5, 1.0, 1.5), late("dvl_s"), r"DVL against IMU")
    either = roles("dvl", "imu")  # of a turn about the vertical, which the pair alone does not tell apart
    words = r"DVL axes|Doppler log has the wrong sense"
    for name, axes in MIRRORS.items():
        may_change = either if name == "x and y negated" else roles("dvl")
        yield row(SENSE, name, AGAIN, turned("velocity", axes), words, roles=may_change)
    yield row(SENSE, "rolled, degrees", LEANS, leaning("x", "velocity"), LEANING, roles=EITHER)
    yield row(SENSE, "pitched, degrees", LEANS, leaning("y", "velocity"), LEANING, roles=EITHER)
    quarter = turned("velocity", QUARTER_TURN)
    yield row(SENSE, "turned by 90 degrees", AGAIN, quarter, r"DVL axes|mounting yaw", roles=either)
    yield row(SENSE, "in axes of the world", AGAIN, in_world, r"axes of the world", roles=either)
    yield row("marked invalid", "share, huge variance", SHARES, Marked("velocity", "dvl_s", "velocity", True), LEFT_OUT)
    yield row("marked invalid", "share, NaN", SHARES, Marked("velocity", "dvl_s", "velocity", False), LEFT_OUT)
    row = partial(row, roles=roles("dvl", "positions", "detections", "depth"))
    scale = r"DVL.*(unit|scale)|Doppler log.s scale|scale of the Doppler|knots of the Doppler"
    yield row("unit", "mm/s, cm/s, knots", (1e3, 1e2, 1 / 0.5144), scaled("velocity"), scale)
    yield row("scale", "factor", (1.1, 0.9, 1.2), scaled("velocity"), scale)


def of_depth() -> Iterator[Fault]:
    row = partial(Fault, "depth", roles=roles("depth", "start"), needs=roles("depth"))
    times = r"depth.*(times as much|height begins|rises)"
    yield row("stuck", FROM, FROM_S, stuck("depth_s", "z_m"), r"depth.*(repeat|stuck|same)")
    yield row("late", "seconds", (1.0, 2.0, 3.0), late("depth_s"), r"depth.*too late")
    yield row(SENSE, "factor", (-1.0, -FOOT, -100.0), scaled("z_m"), times)
    yield row("unit", "feet, cm, decimetres", (FOOT, 100.0, 10.0), scaled("z_m"), times)
    yield row("scale", "factor", (1.15, 0.8, 1.25), scaled("z_m"), times)
    yield row("scale", "origin, m", (5.0, 20.0, -10.0), added("z_m"), r"depth.*height (begins|of the)")
    yield row("marked invalid", "share, huge variance", SHARES, Marked("depth", "depth_s", "z_m", True), LEFT_OUT)
    yield row("marked invalid", "share, NaN", SHARES, Marked("depth", "depth_s", "z_m", False), LEFT_OUT)


def of_heading() -> Iterator[Fault]:
    row = partial(Fault, "heading", roles=roles("heading", "start"), needs=roles("heading"))
    degrees = r"heading.*(degrees|another|of its changes|that of the start)|yaw_rad.*degrees"
    yield row("stuck", FROM, FROM_S, stuck("heading_s", "yaw_rad"), r"heading.*(repeat|stuck|same)")
    yield row("late", "seconds", (0.7, 1.5, 2.5), late("heading_s"), r"heading.*too late")
    yield row(SENSE, "clockwise from north", AGAIN, clockwise, r"heading.*(clockwise|that of the start)")
    yield row("unit", "degrees", (DEGREE, DEGREE, DEGREE), scaled("yaw_rad"), degrees)
    yield row("scale", "factor", (1.1, 0.9, 1.3), scaled("yaw_rad"), r"heading", roles=roles("heading", "imu", "start"))
    yield row("marked invalid", "share, sigma or none", SHARES, Marked("heading", "heading_s", "yaw_rad", True), LEFT_OUT)
    yield row("marked invalid", "share, NaN", SHARES, Marked("heading", "heading_s", "yaw_rad", False), LEFT_OUT)
    row = partial(row, roles=roles("heading", "dvl", "start"), needs=roles("heading", "fixes"))
    from_north = r"heading.*(towards the positions|that of the start)"
    yield row(SENSE, "turned, degrees", (25.0, 60.0, -90.0), added("yaw_rad", 1 / DEGREE), from_north)


def of_position() -> Iterator[Fault]:
    row = partial(Fault, "position", roles=roles("positions", "start"), needs=roles("fixes"))
    times = r"position.*(times as much|begin)"
    yield row("stuck", FROM, FROM_S, stuck("fix_s", "fix_m"), r"position.*(repeat|stuck|same)")
    yield row("late", "seconds", (1.5, 2.0, 3.0), late("fix_s"), r"position.*too late")
    yield row("unit", "mm, feet, cm", (1e3, FOOT, 1e2), scaled("fix_m"), times)
    yield row("marked invalid", "share, huge variance", SHARES, Marked("fixes", "fix_s", "fix_m", True), LEFT_OUT)
    yield row("marked invalid", "share, NaN", SHARES, Marked("fixes", "fix_s", "fix_m", False), LEFT_OUT)
    row = partial(row, roles=roles("positions", "start", "dvl", "heading"))
    exchanged = r"position.*(exchanged|begin|of its changes)|towards the positions"
    yield row("scale", "factor", (1.1, 0.9, 1.25), scaled("fix_m"), times)
    yield row(SENSE, "x and y exchanged", AGAIN, turned("fix_m", X_Y), exchanged)


def of_sonar() -> Iterator[Fault]:
    seen = roles("detections", "sonar")
    held = r"(sonar|landmark|detections).*(same|repeat|hardly)"
    row = partial(Fault, "range", roles=seen, needs=roles("sonar", "names"))
    ranges = r"ranges.*(times as much|grow|hardly)"
    yield row("stuck", "frame repeated " + FROM, FROM_S, repeat_frames, held)
    yield row("late", "seconds, of the frame", (0.5, 1.0, 2.0), late("frame_s"), r"(sonar|detections|azimuths|ranges).*late")
    yield row("unit", "mm, cm, feet", (1e3, 1e2, FOOT), scale_ranges, ranges, roles=seen | {"dvl"})
    yield row("scale", "factor", (1.045, 1.1, 0.9), scale_ranges, ranges, roles=seen | {"dvl"})
    yield row("marked invalid", "share, NaN", SHARES, MarkedSightings(1), LEFT_OUT)
    row = partial(Fault, "azimuth", roles=seen, needs=roles("sonar", "names"))
    azimuths = r"azimuths?.*(times as much|mirrored|degrees|hardly)"
    yield row("stuck", "one value " + FROM, FROM_S, hold_azimuths, held)
    yield row(SENSE, "mirrored", AGAIN, lambda log, _: scale_azimuths(log, -1.0), azimuths)
    yield row("unit", "degrees", (DEGREE, DEGREE, DEGREE), scale_azimuths, azimuths)
    yield row("scale", "factor", (1.1, 0.8, 1.25), scale_azimuths, azimuths)
    yield row("marked invalid", "share, NaN", SHARES, MarkedSightings(2), LEFT_OUT)
# fmt: on


def table() -> list[Fault]:
    """Every fault."""
    groups = (
        of_angular_rate,
        of_specific_force,
        of_velocity,
        of_depth,
        of_heading,
        of_position,
        of_sonar,
    )
    return [fault for group in groups for fault in group()]
