"""Checks of depth, heading, position fixes and sightings against the motion of the body.

`CHECKS` is the table: a row for each quantity with its signals, the units and scales that sensors confuse, and the
lines that mend a fault. One comparison finds all of them (`sonar_graph.diagnosis.signals`): gain, lag, scatter.
docs/theory/sensor_check.md.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sonar_graph.diagnosis.findings import (
    ACTING_SIGMAS,
    IN_CALIBRATION,
    IN_LOG_CONFIG,
    NO_NEED,
    Finding,
    Gravity,
    gravity_of,
    in_degrees,
    matters,
    numbers,
    unknown,
)
from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.diagnosis.sightings import sighting_changes
from sonar_graph.diagnosis.signals import (
    CLEARLY_BETTER,
    Match,
    match,
    root_mean_square,
)
from sonar_graph.diagnosis.start import LEAST_BIAS_RAD_S, turned_mounting
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import NS_PER_S, UNMEASURED_M2, Floats, PositionFixes
from sonar_graph.models import wrap_angle
from sonar_graph.navigation.alignment import Estimate1D
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.sequence import Sequence

HEADING_SENSE = "heading: turn over that of the gyros"
VERTICAL_BIAS = "gyro bias about the vertical"
HEADING_TURN = "heading: turn towards the positions"
LARGEST_GAIN_SIGMA = 0.12
"""Of a gain that is told: 1 and -1 are sixteen sigmas apart."""
LARGEST_LAG_SIGMA_S = 0.5
LARGEST_HEADING_SIGMA_RAD = 0.25
OTHER_UNIT = 1.3
"""Gain, either way, from which on a unit is asked for, not a scale."""
SLIPPING_UNIT = 3.0
"""The same for sightings of a vehicle on wheels, which slip."""
UNIT_TOLERANCE = 0.1
HARDLY = 0.25
"""Gain below which a sensor is said to hardly change."""
LEAST_MOVED = 1.0
"""Motion in sigmas of a row, below which nothing is known of a sensor."""
STUCK_MOVED = 10.0
"""The same for a sensor that is stuck."""
MOST_MISFIT = 0.3
"""Share of its changes that the reference does not explain, from which on a sensor contradicts it."""
LARGEST_SCATTER = 10.0
"""Scatter in sigmas, from which on a sensor contradicts beyond doubt: normalised squares of 100."""
GRAVE_ERROR = 5.0
"""Error by a scale or a lag, in sigmas of a row, from which on results are doubtful."""
CLIMB_S = 40.0
"""Time in which a vehicle climbs or dives by much more than the Doppler log's noise adds up to."""
FEWEST_DEPTHS = 30
LARGE_TURN_RAD = np.radians(10.0)
"""Of the heading against positions: beyond, a run's result is of little worth."""
LENGTHS = {
    "mm": 1e-3,
    "cm": 1e-2,
    "feet": 0.3048,
    "inches": 0.0254,
    "fathoms": 1.8288,
    "km": 1e3,
}
PRESSURES = {"kPa as Pa": 1e3, "hPa as Pa": 1e2, "dbar as Pa": 1e4, "bar as Pa": 1e5}
DEGREES = {"degrees": float(np.radians(1.0))}


@dataclass(frozen=True)
class Advice:
    """What may be wrong, and the line that mends it."""

    cause: str
    line: str


@dataclass(frozen=True, eq=False)
class Check:
    """A row of the table of checks: a sensor and its reference."""

    name: str
    role: str
    against: str
    """The reference, as the subject of a sentence."""
    compare: Callable[[Sequence, BodyMotion], Match | None]
    """The comparison; None where the log has no such sensor."""
    sigma: Callable[[Sequence], float]
    """Of one row, in the sensor's unit."""
    sense: Callable[[LogConfig], Advice]
    """Where the gain is negative or the signal is mirrored."""
    scaled: Callable[[LogConfig, float], Advice]
    """Where the gain is near 1."""
    units: Mapping[str, float] = field(default_factory=dict)
    """Factors to the right unit, by the name of the wrong one."""
    scale_key: str = "scale"
    systematic: float = 0.0
    """Sigma of the gain by what the comparison leaves out."""
    slow_sigma: Callable[[Sequence], float] = lambda _: 0.0
    """Error of sensor and reference that changes as slowly as the motion, in the sensor's unit: blocks of rows hide it."""
    least_scale: float = 0.03
    least_lag_s: float = 0.1
    reach: Callable[[Sequence, Match], float] = lambda _, found: found.moved
    """What the error of a gain is multiplied by, in the sensor's unit."""
    quantity: str = ""
    """Name of the gain where it is not made from the others."""
    is_angle: bool = False

    @property
    def is_sighting(self) -> bool:
        """True for the checks of landmarks, whose identities may be wrong."""
        return self.role == "detections"

    def slips(self, sequence: Sequence) -> bool:
        """True for sightings from wheels, whose odometry has a scale of its own."""
        is_wheeled = sequence.calibration.odometry_interpolation == "hold-past"
        return self.is_sighting and is_wheeled


def scale_line(role: str, key: str, config: LogConfig, gain: float) -> str:
    """Line that divides a configured scale by a gain."""
    scale = config.number(role, key, 1.0) / gain
    return f"`{key} = {scale:.4g}` under [{role}] {IN_LOG_CONFIG}"


def unused(role: str) -> str:
    """Line that leaves a sensor out."""
    return f"`use = false` under [{role}] {IN_LOG_CONFIG}"


def other_world(config: LogConfig, role: str) -> str:
    """The world that is not the configured one, as a setting."""
    is_ned = config.table(role).get("world", "enu") == "ned"
    return f'`world = "{"enu" if is_ned else "ned"}"` under [{role}] {IN_LOG_CONFIG}'


def depth_match(sequence: Sequence, motion: BodyMotion) -> Match | None:
    """Height of the depth sensor's port by the Doppler log's vertical velocity, which drifts."""
    depth = sequence.depth
    if depth is None:
        return None
    height = motion.height_m + motion.up @ sequence.calibration.depth.port_m
    t = motion.since_origin(depth.stamps_ns)
    # the noise of velocities adds up to a walk of the height, which grows with the time compared
    interval_s = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    longest_s = max(CLIMB_S, FEWEST_DEPTHS * interval_s)
    rows = motion.stretches(t, depth.z_m, motion.reference(height), longest_s)
    found = match(rows, drift_sigma=0.03)
    return found.less_certain(motion.sampling_error(motion.height_m))


def climb_sigma(sequence: Sequence) -> float:
    """Error of a height reckoned by the Doppler log over `CLIMB_S`, about a line, m.

    The integral of white noise is a random walk, and about a line an eighth of its end's error is left in a gain.
    """
    interval_s = float(np.median(np.diff(sequence.dvl.stamps_ns))) / NS_PER_S
    duration_s = min(sequence.duration_s, CLIMB_S)
    velocity_m_s = max(sequence.calibration.dvl.velocity_sigma_m_s)
    return velocity_m_s * float(np.sqrt(interval_s * duration_s)) / 8.0


def heading_match(sequence: Sequence, motion: BodyMotion) -> Match | None:
    """Heading by the gyros, which drift."""
    heading = sequence.heading
    if heading is None:
        return None
    t = motion.since_origin(heading.stamps_ns)
    yaw_rad = np.unwrap(heading.yaw_rad)
    rows = motion.stretches(t, yaw_rad, motion.reference(motion.yaw_rad))
    return match(rows, drift_sigma=0.02)


def fix_match(sequence: Sequence, motion: BodyMotion) -> Match | None:
    """Level position of the antenna by the path."""
    if sequence.positions is None:
        return None
    fixes = sequence.positions
    fixes = fixes.rows(np.flatnonzero(is_level_fix(fixes)))
    antenna = complex(*sequence.calibration.positions.antenna_m[:2])
    path = motion.path_m + antenna * np.exp(1j * motion.yaw_rad)
    t = motion.since_origin(fixes.stamps_ns)
    level = fixes.position_m @ [1.0, 1j, 0.0]
    found = match(motion.stretches(t, level, motion.reference(path)))
    return found.less_certain(motion.sampling_error(motion.path_m))


def is_level_fix(fixes: PositionFixes) -> NDArray[np.bool_]:
    """Mask of fixes whose level coordinates are measured, shape (n,)."""
    variances = np.einsum("nii->ni", fixes.covariance_m2)[:, :2]
    is_unmeasured = (variances >= 0.5 * UNMEASURED_M2).any(axis=1)
    return np.asarray(fixes.are_sound() & ~is_unmeasured)


def sighting_match(
    sequence: Sequence, motion: BodyMotion, *, of_range: bool
) -> Match | None:
    """Changes between sightings of a landmark by the motion, with azimuths as they are or mirrored."""
    found = {}
    for sign in (1.0, -1.0):
        changes = sighting_changes(sequence, motion, sign)
        if changes is None:
            return None
        # only turns show a delay: ranges change evenly
        found[sign] = (changes, match([changes.azimuth], find_lag=not of_range))
    # a landmark's place depends on its azimuth: a mirrored one is more than a gain of -1
    is_mirrored = found[-1.0][1].scatter < found[1.0][1].scatter / CLEARLY_BETTER
    changes, by_azimuth = found[-1.0 if is_mirrored else 1.0]
    if of_range:
        return match([changes.range], find_lag=False)
    # a delay turns landmarks about the vehicle as fast as it turns, not as changes of the azimuth change
    turn_rate = root_mean_square([np.diff(motion.yaw_rad) / np.diff(motion.seconds)])
    return replace(by_azimuth, is_mirrored=is_mirrored, rate=turn_rate)


DEPTH = Check(
    name="depth",
    role="depth",
    against="the Doppler log's vertical velocity",
    compare=depth_match,
    sigma=lambda sequence: max(sequence.calibration.depth.sigma_m, 0.02),
    slow_sigma=climb_sigma,
    units=LENGTHS | PRESSURES,
    sense=lambda config: Advice(
        "it rises where the vehicle sinks by the Doppler log: depths downwards, or an altimeter?",
        f"{scale_line('depth', 'scale', config, -1.0)}; an altimeter is no depth: `use = false` under [depth]",
    ),
    scaled=lambda config, gain: Advice(
        "",
        f"{scale_line('depth', 'scale', config, gain)}; of a pressure the water's density (water_density_kg_m3)",
    ),
)
HEADING = Check(
    name="heading",
    role="heading",
    against="the gyros",
    compare=heading_match,
    sigma=lambda sequence: sequence.calibration.heading.sigma_rad,
    slow_sigma=lambda sequence: 0.1 * sequence.calibration.heading.bias_sigma_rad,
    units=DEGREES,
    sense=lambda config: Advice(
        "it turns against the gyros, clockwise", other_world(config, "heading")
    ),
    # a heading that turns too far is right as a rule: the gyros' rate is too small
    scaled=lambda config, gain: Advice(
        "the gyros' scale is wrong, or the compass deviates with the heading",
        scale_line("imu", "angular_velocity_scale", config, 1.0 / gain),
    ),
    least_scale=0.01,
    quantity=HEADING_SENSE,
    is_angle=True,
)
POSITIONS = Check(
    name="position fixes",
    role="positions",
    against="the path by gyros and Doppler log",
    compare=fix_match,
    sigma=lambda sequence: level_sigma_m(sequence.calibration.positions.sigma_m),
    slow_sigma=lambda sequence: (
        0.1 * level_sigma_m(sequence.calibration.positions.sigma_m)
    ),
    units=LENGTHS | {"degrees": 1.1e5},
    sense=lambda config: Advice(
        "north and east are exchanged",
        f"{other_world(config, 'positions')}, or the fields of position in another order",
    ),
    scaled=lambda config, gain: Advice(
        "",
        f"{scale_line('positions', 'scale', config, gain)}; or the Doppler log's scale is wrong: "
        f"`scale = {config.number('dvl', 'scale', 1.0) * gain:.4g}` under [dvl]",
    ),
    least_lag_s=0.3,
)
SIGHTINGS = partial(Check, role="detections", against="the motion between frames")
RANGE = SIGHTINGS(
    name="ranges to landmarks",
    compare=lambda sequence, motion: sighting_match(sequence, motion, of_range=True),
    sigma=lambda sequence: sequence.calibration.sonar.range_sigma_m,
    units=LENGTHS,
    scale_key="range_scale",
    # landmarks are wrong by the error of the whole range, not of its changes
    reach=lambda sequence, _: typical_sighting(sequence)[0],
    sense=lambda _: Advice(
        "they grow where the vehicle approaches: the sonar looks backwards?",
        f"`sonar.mounting.rpy_rad` {IN_CALIBRATION}",
    ),
    scaled=lambda config, gain: Advice(
        "",
        f"{scale_line('detections', 'range_scale', config, gain)}: the sonar's speed of sound is wrong, or the scale "
        "of the Doppler log",
    ),
)
AZIMUTH = SIGHTINGS(
    name="azimuths of landmarks",
    compare=lambda sequence, motion: sighting_match(sequence, motion, of_range=False),
    sigma=lambda sequence: sequence.calibration.sonar.azimuth_sigma_rad,
    units=DEGREES,
    scale_key="azimuth_scale",
    reach=lambda sequence, _: typical_sighting(sequence)[1],
    sense=lambda config: Advice(
        "they turn with the vehicle, mirrored",
        f'{scale_line("detections", "azimuth_scale", config, -1.0)}; of a Detection3DArray `rotation = "frd"`',
    ),
    scaled=lambda config, gain: Advice(
        "", scale_line("detections", "azimuth_scale", config, gain)
    ),
    systematic=0.01,
    least_scale=0.1,
    is_angle=True,
)
CHECKS = (DEPTH, RANGE, AZIMUTH, HEADING, POSITIONS)


def typical_sighting(sequence: Sequence) -> tuple[float, float]:
    """Range, m, and size of the azimuth, rad, of sightings that can be used, root mean squares; 0 without any."""
    seen = sequence.detections
    if seen is None or not (is_sound := seen.are_sound()).any():
        return 0.0, 0.0
    mean_squares = [
        float(np.mean(np.square(values[is_sound])))
        for values in (seen.range_m, seen.azimuth_rad)
    ]
    return float(np.sqrt(mean_squares[0])), float(np.sqrt(mean_squares[1]))


def level_sigma_m(sigma_m: tuple[float, float, float]) -> float:
    """Standard deviation of a level position, both axes together."""
    return float(np.hypot(*sigma_m[:2]))


def findings_of(
    check: Check, found: Match, sequence: Sequence, config: LogConfig
) -> list[Finding]:
    """Rows of the report for a comparison: gain and lag, with cause and line where one is wrong."""
    quantity = check.quantity or f"{check.name}: change over that by {check.against}"
    sigma = check.sigma(sequence)
    still = "too little turning"
    if not check.is_angle:
        still = f"too little motion for {check.name}"
    size = abs(found.gain.value)
    if not found.gain.is_known:
        return [Finding(quantity, found.gain)]
    by_slow = check.slow_sigma(sequence) / max(found.moved, 1e-9)
    found = found.less_certain(float(np.hypot(by_slow, check.systematic)))
    if not found.moved * max(1.0, size) > LEAST_MOVED * sigma:
        return [Finding(quantity, replace(found.gain, reason=still))]
    gain = found.gain.limited(LARGEST_GAIN_SIGMA * max(1.0, size), still)
    fault = grave_fault(check, replace(found, gain=gain), sequence, config)
    if fault is not None:
        return [
            Finding(
                quantity,
                gain,
                cause=fault.cause,
                line=fault.line,
                gravity=Gravity.GRAVE,
            )
        ]
    if not gain.is_known:
        return [Finding(quantity, gain)]
    error = abs(size - 1.0) * check.reach(sequence, found)
    # a scale matters only where its error shows beside the noise of a row
    is_off = matters(replace(gain, value=size - 1.0), check.least_scale)
    acts = is_off and error > sigma and not check.slips(sequence)
    row = Finding(quantity, gain, cause=NO_NEED)
    if acts:
        advice = check.scaled(config, size)
        row = replace(
            row,
            cause=f"it changes {size:.3g} times as much",
            consequence=f"up to {error:.2g}",
            line=f"{advice.cause}: {advice.line}" if advice.cause else advice.line,
            gravity=gravity_of(acts, error > GRAVE_ERROR * sigma),
        )
    # wheels start to slip in turns: no delay of a sensor
    if not found.lag.is_known or check.slips(sequence):
        return [row]
    return [row, lag_finding(check, found, sigma, config)]


def grave_fault(
    check: Check, found: Match, sequence: Sequence, config: LogConfig
) -> Advice | None:
    """Cause and line of a fault beyond doubt: stuck, another sense or unit, or another thing; None: none."""
    gain = found.gain
    size = abs(gain.value)
    sigma = check.sigma(sequence)
    # a wrong unit may make a gain small too
    is_flat = size + 4 * gain.sigma < HARDLY and found.moved > STUCK_MOVED * sigma
    if is_flat and not unit_of(check, size):
        verb = "turns" if check is HEADING else "changes"
        cause = f"it hardly {verb} where {check.against} do: stuck, or not of the body"
        return Advice(cause, unused(check.role))
    if found.is_mirrored or (gain.is_known and gain.value < 0):
        return check.sense(config)
    other_unit = SLIPPING_UNIT if check.slips(sequence) else OTHER_UNIT
    is_sure = matters(replace(gain, value=size - 1.0), 0.0)
    if is_sure and not 1 / other_unit < size < other_unit:
        return unit_advice(check, size, config)
    # sightings that contradict the motion are wrong identities as a rule, which the estimators name
    is_scattered = found.scatter > LARGEST_SCATTER * sigma and not check.is_sighting
    if is_scattered and found.misfit > MOST_MISFIT:
        return Advice(
            f"{100 * found.misfit:.0f} % of its changes are not those by {check.against}, {found.scatter:.3g} apart "
            "typically: another sensor's values, or wrong axes?",
            f"{unused(check.role)} leaves it out",
        )
    return None


def unit_of(check: Check, gain: float) -> str:
    """The unit that a gain looks like; empty: none."""
    near = {unit: abs(np.log(gain * factor)) for unit, factor in check.units.items()}
    unit = min(near, key=near.__getitem__, default="")
    return unit if unit and near[unit] < UNIT_TOLERANCE else ""


def unit_advice(check: Check, gain: float, config: LogConfig) -> Advice:
    """Question for the unit, and the line."""
    unit = unit_of(check, gain)
    times = 1.0 / check.units[unit] if unit else gain
    line = scale_line(check.role, check.scale_key, config, times)
    if check is POSITIONS and unit == "degrees":
        line = f"`geodetic`, with the fields of latitude and longitude, under [positions] {IN_LOG_CONFIG}"
    question = f"{unit or 'another unit'}?"
    return Advice(
        f"it changes {gain:.3g} times as much as by {check.against}: {question}", line
    )


def lag_finding(check: Check, found: Match, sigma: float, config: LogConfig) -> Finding:
    """Row for a delay of the sensor."""
    lag = found.lag.limited(LARGEST_LAG_SIGMA_S, "too little changes in the motion")
    row = Finding(f"{check.name} against {check.against}: delay", lag, "s", NO_NEED)
    error = abs(lag.value) * found.rate
    if not matters(lag, check.least_lag_s) or error < sigma:
        return row
    total_s = config.number(check.role, "stamp_offset_s", 0.0) - lag.value
    return replace(
        row,
        cause=f"its rows come too {'late' if lag.value > 0 else 'early'}",
        consequence=f"an error of {error:.2g} typically",
        line=f"`stamp_offset_s = {total_s:.3f}` under [{check.role}] {IN_LOG_CONFIG}",
        gravity=gravity_of(True, error > GRAVE_ERROR * sigma),
    )


LEAST_BIAS_S = 30.0


def vertical_bias(
    sequence: Sequence,
    motion: BodyMotion | None = None,
    of_axes_rad_s: Floats | None = None,
) -> Finding | None:
    """Bias of the gyros about the vertical, by a heading or by true orientations; None without either.

    ``of_axes_rad_s``: bias along the axes of the body as otherwise known, shape (3,), whose level part enters the line.

    The slope over time of the gyros' turn, less the bias that is known, less the heading.
    """
    truth = sequence.true_poses
    if sequence.heading is not None:
        source = "the heading"
        stamps_ns = sequence.heading.stamps_ns
        yaw_rad = np.unwrap(sequence.heading.yaw_rad)
    elif truth is not None and len(truth) > 1:
        source = "the true orientations"
        stamps_ns = truth.stamps_ns
        yaw_rad = np.unwrap(truth.rotations().as_euler("ZYX")[:, 0])
    else:
        return None
    quantity = VERTICAL_BIAS
    bias = unknown(f"too little time beside {source}")
    motion = motion or BodyMotion.of(sequence)
    if motion is None:
        return Finding(quantity, bias, "rad/s")
    t = motion.since_origin(stamps_ns)
    drift_rad = motion.reference(motion.yaw_rad)(t) - yaw_rad
    # against time itself, whose gain is the rate
    rows = motion.stretches(t, drift_rad, lambda seconds: seconds)
    duration_s = sum(float(np.ptp(part.seconds)) for part in rows)
    if rows and duration_s > LEAST_BIAS_S:
        found = match(rows, find_lag=False)
        # a slow wave of the heading looks like a bias: as if all of its scatter were one in each stretch
        slope = 2.0 * found.scatter * float(np.sqrt(len(rows))) / duration_s
        bias = replace(found.gain, sigma=max(found.gain.sigma, slope, 1e-9))
    imu = sequence.calibration.imu
    allowed = imu.gyro_bias_sigma
    if not matters(bias, LEAST_BIAS_RAD_S, allowed):
        cause = f"by {source}; the calibration's sigma of {allowed:.2g} allows it, {NO_NEED}"
        return Finding(quantity, bias, "rad/s", cause)
    up = np.median(motion.up, axis=0)
    up = up / np.linalg.norm(up)
    level_rad_s = np.zeros(3)
    if of_axes_rad_s is not None:
        level_rad_s = of_axes_rad_s - (of_axes_rad_s @ up) * up
    # the line is in the axes of the IMU
    body_R_imu = imu.mounting.pose().rotation().matrix()
    more_rad_s = (level_rad_s + bias.value * up) @ body_R_imu
    whole = np.add(imu.gyro_bias_rad_s, more_rad_s)
    turned_rad = abs(bias.value) * sequence.duration_s
    return Finding(
        quantity,
        bias,
        "rad/s",
        cause=f"by {source}, {np.degrees(bias.value):.3g}°/s beyond the calibration's sigma of {allowed:.2g}",
        consequence=f"a turn of {np.degrees(turned_rad):.3g}° over the log",
        line=f"`imu.gyro_bias_rad_s = {numbers(whole, 5)}` {IN_CALIBRATION}",
        gravity=gravity_of(True, turned_rad > LARGE_TURN_RAD),
    )


FARTHEST_FROM_START_M = 0.5
"""Difference between the height of a start and that of the first depths that waves and a rough start make."""
FIRST_ROWS = 5


def fix_height_findings(sequence: Sequence) -> Iterator[Finding]:
    """Depths at another height than the position fixes, where no start decides which of them is wrong."""
    depth = sequence.depth
    fixes = sequence.positions
    if depth is None or fixes is None or sequence.calibration.start.source == "stated":
        return
    heights_m2 = fixes.covariance_m2[:, 2, 2]
    inside = fixes.are_sound() & ~(heights_m2 >= 0.5 * UNMEASURED_M2)
    inside &= fixes.stamps_ns >= depth.stamps_ns[0]
    inside &= fixes.stamps_ns <= depth.stamps_ns[-1]
    if np.count_nonzero(inside) < NEAR_START:
        return
    by_depth = np.interp(fixes.stamps_ns[inside], depth.stamps_ns, depth.z_m)
    off_m = float(np.median(fixes.position_m[inside, 2] - by_depth))
    sigma_m = sequence.calibration.positions.sigma_m[2]
    if abs(off_m) <= FARTHEST_FROM_START_M + ACTING_SIGMAS * sigma_m:
        return
    yield Finding(
        "depth: height of the position fixes over it",
        Estimate1D(off_m, sigma_m),
        "m",
        cause="another origin, sign or unit of the depths, or another height of the fixes?",
        line=f"{unused('depth')} leaves the depths out",
        gravity=Gravity.GRAVE,
    )


def start_depth_findings(sequence: Sequence) -> Iterator[Finding]:
    """A stated start that is at another height than the first depths; nothing where they agree."""
    depth = sequence.depth
    start = sequence.calibration.start
    is_stated = start.source == "stated" and "position_m" in start.model_fields_set
    if depth is None or not is_stated:
        return
    first = max(int(np.searchsorted(depth.stamps_ns, sequence.start_ns)) - 1, 0)
    rows_m = depth.z_m[first : first + FIRST_ROWS]
    height_m = float(np.median(rows_m))
    port = np.array(sequence.calibration.depth.port_m)
    off_m = height_m - float(start.pose().transformFrom(port)[2])
    sigma_m = float(
        np.hypot(start.position_sigma_m[2], sequence.calibration.depth.sigma_m)
    )
    climbed_m = float(np.ptp(rows_m))
    if abs(off_m) <= FARTHEST_FROM_START_M + climbed_m + ACTING_SIGMAS * sigma_m:
        return
    x, y, z = start.position_m
    yield Finding(
        "depth: distance from the start",
        Estimate1D(off_m, sequence.calibration.depth.sigma_m),
        "m",
        cause=f"the height begins at {height_m:.2f} m, the start of the calibration is at {height_m - off_m:.2f} m: an "
        "altimeter, another sign, unit or origin, or a wrong start?",
        line=f"{unused('depth')} leaves the depths out, scale = -1 there is for depths downwards; "
        f"`start.position_m = {numbers((x, y, z + off_m), 2)}` {IN_CALIBRATION} where the depths are right",
        gravity=Gravity.GRAVE,
    )


def heading_findings(
    right: Sequence, config: LogConfig, motion: BodyMotion | None = None
) -> Iterator[Finding]:
    """Sense, scale and delay of the heading; where right, the angle by which it is off the world of the positions."""
    motion = motion or BodyMotion.of(right)
    found = None if motion is None else HEADING.compare(right, motion)
    if motion is None or found is None:
        return
    rows = findings_of(HEADING, found, right, config)
    yield from rows
    if not rows[0].grave:
        yield from heading_turn(right, config, motion)


def start_heading_findings(right: Sequence, motion: BodyMotion) -> Iterator[Finding]:
    """First headings that differ from a stated start; nothing where they agree, or no start is stated."""
    heading = right.heading
    start = right.calibration.start
    is_stated = start.source == "stated" and "rpy_rad" in start.model_fields_set
    if heading is None or not is_stated:
        return
    first = max(int(np.searchsorted(heading.stamps_ns, right.start_ns)) - 1, 0)
    t = motion.since_origin(heading.stamps_ns[first : first + FIRST_ROWS])
    turned = motion.reference(motion.yaw_rad)(t) - motion.yaw_rad[0]
    off = heading.yaw_rad[first : first + FIRST_ROWS] - turned - start.rpy_rad[2]
    if not np.isfinite(off).any():
        return
    calibration = right.calibration.heading
    sigma = np.hypot(calibration.sigma_rad, calibration.bias_sigma_rad)
    error = Estimate1D(
        float(np.nanmedian(wrap_angle(off))),
        float(np.hypot(sigma, start.rpy_sigma_rad[2])),
    )
    if not matters(error, LARGE_TURN_RAD):
        return
    yield Finding(
        "heading: turn from that of the start",
        in_degrees(error),
        "°",
        cause="another north, sense or unit of the headings, or a wrong start?",
        line=f"`world` and `yaw_offset_rad` under [heading] {IN_LOG_CONFIG}, or `start.rpy_rad` {IN_CALIBRATION}",
        gravity=Gravity.GRAVE,
    )


def heading_turn(
    right: Sequence, config: LogConfig, motion: BodyMotion
) -> Iterator[Finding]:
    """Angle from the path by heading and Doppler log to that of the positions; nothing without positions."""
    known = right.positions or right.truth
    if known is None or right.heading is None:
        return
    places = known.position_m if isinstance(known, PositionFixes) else known.positions
    heading_s = motion.since_origin(right.heading.stamps_ns)
    yaw_rad = np.interp(motion.seconds, heading_s, np.unwrap(right.heading.yaw_rad))
    # the way of the Doppler log, laid along the heading instead of the gyros' yaw
    steps = np.diff(motion.path_m) * np.exp(1j * (yaw_rad - motion.yaw_rad))[1:]
    path = np.append(0.0, np.cumsum(steps))
    t = motion.since_origin(known.stamps_ns)
    level = places @ [1.0, 1j, 0.0]
    rows = motion.stretches(t, level, motion.reference(path))
    turn = match(rows, find_lag=False)
    angle = unknown("too little motion beside positions")
    # a way that fits badly has no direction
    if turn.misfit < MOST_MISFIT and 0.5 < turn.gain.value < 2.0:
        angle = turn.angle.limited(LARGEST_HEADING_SIGMA_RAD, angle.reason)
    allowed = right.calibration.heading.bias_sigma_rad
    row = Finding(
        HEADING_TURN,
        in_degrees(angle),
        "°",
        f"the calibration's bias sigma of {allowed:.2g} rad allows it, {NO_NEED}",
    )
    if not matters(angle, 0.0, allowed / 2):
        yield row
        return
    offset = config.number("heading", "yaw_offset_rad", 0.0) + angle.value
    rpy = numbers(turned_mounting(right.calibration.dvl.mounting, angle.value), 4)
    vertical = vertical_bias(right, motion)
    is_biased = vertical is not None and vertical.acts
    first = "once the gyro bias is put right, which comes first, " if is_biased else ""
    yield replace(
        row,
        cause=f"{first}either its world, north or mounting is another",
        line=f"`yaw_offset_rad = {offset:.3f}` under [heading] {IN_LOG_CONFIG}; or the Doppler log is turned on the "
        f"vehicle: `dvl.mounting.rpy_rad = {rpy}` {IN_CALIBRATION}",
        gravity=gravity_of(True, abs(angle.value) > LARGE_TURN_RAD),
    )


HIGH_PERCENTILE = 95.0
JUMP_NS = 20 * NS_PER_S
JUMP_GATE = chi_square_quantile(1 - 1e-4, 3)
LARGEST_JUMPING_SHARE = 0.2
"""Of the fixes; single outliers are what a robust kernel is for."""
FEWEST_JUMPS = 6
NEAR_START = 6
"""Number of fixes about the start whose median is compared with it."""
FARTHEST_ORIGIN_M = 1e5
"""No vehicle of a run goes so far; coordinates of a map grid begin beyond."""


def way_m(right: Sequence, at_ns: np.ndarray) -> np.ndarray:
    """Way by the Doppler log until each instant, shape (n,), in a gap at the log's high speed."""
    is_measured = np.isfinite(right.dvl.velocity).all(axis=1)
    stamps_ns = right.dvl.stamps_ns[is_measured]
    speed = np.linalg.norm(right.dvl.velocity[is_measured], axis=1)
    if len(speed) < 2:
        return np.zeros(len(at_ns))
    steps_s = np.diff(stamps_ns) / NS_PER_S
    mean_speed = (speed[1:] + speed[:-1]) / 2
    # nothing is known of a gap but how fast the vehicle goes elsewhere
    is_gap = steps_s > right.calibration.dvl.gap_s
    mean_speed[is_gap] = np.percentile(speed, HIGH_PERCENTILE)
    return np.interp(at_ns, stamps_ns, np.append(0.0, np.cumsum(mean_speed * steps_s)))


def jumping_share(right: Sequence, fixes: PositionFixes) -> tuple[float, int]:
    """Share of fixes from which the one `JUMP_NS` later is farther than the Doppler log moves, and their number.

    With l the way by the Doppler log, a displacement Δ of length d is beyond it by ``e = Δ (1 - l / d)``, and is no
    noise of the two fixes where ``eᵀ (C_i + C_j)⁻¹ e`` is above `JUMP_GATE`.
    """
    fixes = fixes.rows(np.flatnonzero(fixes.are_sound()))
    t = fixes.stamps_ns
    dvl_ns = right.dvl.stamps_ns[np.isfinite(right.dvl.velocity).all(axis=1)]
    later = np.searchsorted(t, t + JUMP_NS)
    if not len(dvl_ns):
        return 0.0, 0
    i = np.flatnonzero((later < len(t)) & (t >= dvl_ns[0]))
    i = i[t[later[i]] <= dvl_ns[-1]]
    if not len(i):
        return 0.0, 0
    j = later[i]
    way = way_m(right, t)
    moved = fixes.position_m[j] - fixes.position_m[i]
    length = np.maximum(np.linalg.norm(moved, axis=1), 1e-9)
    beyond = moved * np.maximum(0.0, 1 - (way[j] - way[i]) / length)[:, None]
    noise = np.diag(np.square(right.calibration.positions.sigma_m))
    cov_m2 = np.where(np.isnan(fixes.covariance_m2), noise, fixes.covariance_m2)
    normalised = np.linalg.solve(cov_m2[i] + cov_m2[j], beyond[:, :, None])[:, :, 0]
    squares = np.sum(beyond * normalised, axis=1)
    return float(np.mean(squares > JUMP_GATE)), len(i)


def position_findings(
    right: Sequence, config: LogConfig, motion: BodyMotion | None = None
) -> Iterator[Finding]:
    """Unit and delay of the position fixes, jumps that no vehicle makes, and their distance from start or origin."""
    fixes = right.positions
    if fixes is None:
        return
    motion = motion or BodyMotion.of(right)
    found = None if motion is None else POSITIONS.compare(right, motion)
    few = Match.unknown("too few fixes beside the Doppler log")
    rows = findings_of(POSITIONS, found or few, right, config)
    # changes that the path does not explain may be jumps, which are a better name
    if rows[0].grave and "%" not in rows[0].advice:
        yield rows[0]
        return
    share, count = jumping_share(right, fixes)
    if share > LARGEST_JUMPING_SHARE and share * count >= FEWEST_JUMPS:
        sigma = float(np.sqrt(share * (1 - share) / count))
        yield Finding(
            "position fixes: jumps",
            Estimate1D(100 * share, 100 * sigma),
            "%",
            cause=f"fixes {JUMP_NS / NS_PER_S:.0f} s apart are farther from each other than the vehicle moves by its "
            "Doppler log and their noise allows: angles, or of another thing?",
            line=f"{unused('positions')} leaves them out; or they are worse than `positions.sigma_m` {IN_CALIBRATION}",
            gravity=Gravity.GRAVE,
        )
        return
    yield from rows
    if not rows[0].estimate.reason.startswith("too few"):
        yield distance_finding(right, fixes, config)


def distance_finding(
    right: Sequence, fixes: PositionFixes, config: LogConfig
) -> Finding:
    """Distance of the first fixes from the start, and whether they begin far from it or from the world's origin."""
    calibration = right.calibration
    order = np.argsort(np.abs(fixes.stamps_ns - right.start_ns))[:NEAR_START]
    near = np.median(fixes.position_m[order], axis=0)
    from_start_m = float(np.hypot(*(near - calibration.start.position_m)[:2]))
    from_origin_m = float(np.hypot(*near[:2]))
    noise_m = level_sigma_m(calibration.positions.sigma_m)
    # how far the vehicle can be from the start by then
    path_m = float(way_m(right, fixes.stamps_ns[order]).max())
    start_m = level_sigma_m(calibration.start.position_sigma_m)
    allowed_m = 5.0 * float(np.hypot(noise_m, start_m)) + path_m
    quantity = "position fixes: distance from the start"
    row = Finding(quantity, Estimate1D(from_start_m, noise_m), "m", NO_NEED)
    far = {}
    if from_origin_m > FARTHEST_ORIGIN_M:
        far["the origin of the world"] = from_origin_m
    if from_start_m > allowed_m:
        far["the start"] = from_start_m
    if not far:
        return row
    place, distance_m = far.popitem()  # the start comes before the origin
    before = np.array(config.table("positions").get("origin_m", np.zeros(3)), float)
    origin = numbers(before + np.round(near), 0)
    return replace(
        row,
        cause=f"they begin {distance_m:.3g} m from {place}, the way to them is {path_m:.3g} m: a map grid (UTM), or another "
        "scale or place?",
        line=f"`origin_m = {origin}` under [positions] {IN_LOG_CONFIG} moves the origin to the first; or state the "
        "start there",
        gravity=Gravity.GRAVE,
    )
