"""Checks of depth, heading, position fixes and sightings against the motion of the body.

`CHECKS` is the table: a row for each quantity with the reference, the units and scales that sensors confuse, and the
line that puts a fault right. One comparison finds all of them (`sonar_graph.diagnosis.signals`): gain, lag, scatter.
docs/theory/sensor_check.md.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from sonar_graph.diagnosis.findings import (
    IN_CALIBRATION,
    IN_LOG_CONFIG,
    LEAST_BIAS_RAD_S,
    NO_NEED,
    Finding,
    in_degrees,
    matters,
    numbers,
    turned_mounting,
)
from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.diagnosis.signals import (
    CLEARLY_BETTER,
    Match,
    SignalStretch,
    Values,
    match,
    unknown,
)
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import (
    NS_PER_S,
    UNMEASURED_M2,
    Floats,
    Imu,
    Ints,
    PositionFixes,
)
from sonar_graph.models import wrap_angle
from sonar_graph.navigation.alignment import Estimate1D, holes_before
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.sequence import Sequence

HEADING_SENSE, HEADING_TURN = (
    "heading: turn over that of the gyros",
    "heading: turn towards the positions",
)
STRETCH_S = 120.0
"""Rows are compared over so long at a time; longer, a drift of the gyros would bend the path."""
WINDOW_NS = 10 * NS_PER_S
FEWEST_WINDOWS = 6
LEAST_BIAS_S = 30.0
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
LEAST_MOVED, STUCK_MOVED = 1.0, 10.0
"""Motion in sigmas of a row, below which nothing is told of a sensor, and not that it is stuck."""
MOST_MISFIT, LARGEST_SCATTER = 0.3, 10.0
"""Share of its changes that the reference does not explain, and scatter in sigmas, from which on a sensor contradicts
beyond doubt: normalised squares of 100."""
GRAVE_ERROR = 5.0
"""Error by a scale or a lag, in sigmas of a row, from which on results are doubtful."""
HIGH_PERCENTILE = 95.0
JUMP_NS = 2 * WINDOW_NS
JUMP_GATE = chi_square_quantile(1 - 1e-4, 3)
LARGEST_JUMPING_SHARE = 0.2
"""Of the fixes; single outliers are what a robust kernel is for."""
FARTHEST_ORIGIN_M = 1e5
"""No vehicle of a run goes so far; coordinates of a map grid begin beyond."""
LENGTHS = {
    "mm": 1e-3,
    "cm": 1e-2,
    "feet": 0.3048,
    "inches": 0.0254,
    "fathoms": 1.8288,
    "km": 1e3,
}


@dataclass(frozen=True)
class Check:
    """A row of the table of checks: a sensor and its reference."""

    name: str
    role: str
    against: str
    """The reference, as the subject of a sentence."""
    sigma: Callable[[Sequence], float]
    """Of one row, in the sensor's unit."""
    drift_sigma: float = 0.0
    """How fast the reference drifts, in the sensor's unit a second."""
    units: Mapping[str, float] = field(default_factory=dict)
    """Factors to the right unit, by the name of the wrong one."""
    sense: Callable[[LogConfig], str] = lambda _: ""
    """Cause and line where the gain is negative."""
    scaled: Callable[[LogConfig, float], str] = lambda _, __: ""
    """Line for a gain near 1."""
    reach: Callable[[Sequence, Match], float] = lambda _, found: found.moved
    """What a scale is multiplied by, in the sensor's unit."""
    systematic: float = 0.0
    """Sigma of the gain by what the comparison leaves out."""
    least_scale: float = 0.03
    least_lag_s: float = 0.1
    is_turned: bool = False
    """True for a level plane, whose directions are another check's."""


def _scale_line(role: str, key: str, config: LogConfig, gain: float) -> str:
    return f"`{key} = {config.number(role, key, 1.0) / gain:.4g}` under [{role}] {IN_LOG_CONFIG}"


def _other(config: LogConfig, role: str, key: str, default: str, other: str) -> str:
    """The value of a key with two values that is not the configured one."""
    return default if config.table(role).get(key, default) == other else other


def _heading_sense(config: LogConfig) -> str:
    world = _other(config, "heading", "world", "enu", "ned")
    return f'it turns against the gyros, clockwise: `world = "{world}"` under [heading] {IN_LOG_CONFIG}'


def _depth_sense(config: LogConfig) -> str:
    line = _scale_line("depth", "scale", config, -1.0)
    return (
        f"it rises where the vehicle sinks by the Doppler log: depths downwards, or an altimeter? {line}; an altimeter "
        f"is no depth: `use = false` under [depth]"
    )


def _gyro_scale(config: LogConfig, gain: float) -> str:
    scale = config.number("imu", "angular_velocity_scale", 1.0) * gain
    return (
        f"the gyros' scale is wrong, or the compass deviates with the heading: `angular_velocity_scale = {scale:.4f}` "
        f"under [imu] {IN_LOG_CONFIG}"
    )


def _depth_scale(config: LogConfig, gain: float) -> str:
    line = _scale_line("depth", "scale", config, gain)
    return f"{line}; of a pressure the water's density (water_density_kg_m3)"


def _fix_sigma(sequence: Sequence) -> float:
    return float(np.hypot(*sequence.calibration.positions.sigma_m[:2]))


DEPTH = Check(
    name="depth",
    role="depth",
    against="the Doppler log's vertical velocity",
    sigma=lambda sequence: max(sequence.calibration.depth.sigma_m, 0.02),
    drift_sigma=0.03,
    units={
        **LENGTHS,
        "kPa as Pa": 1e3,
        "hPa as Pa": 1e2,
        "dbar as Pa": 1e4,
        "bar as Pa": 1e5,
    },
    sense=_depth_sense,
    scaled=_depth_scale,
)
HEADING = Check(
    name="heading",
    role="heading",
    against="the gyros",
    sigma=lambda sequence: sequence.calibration.heading.sigma_rad,
    drift_sigma=0.02,
    units={"degrees": float(np.radians(1.0))},
    sense=_heading_sense,
    scaled=_gyro_scale,
    least_scale=0.01,
    least_lag_s=0.1,
)
POSITIONS = Check(
    name="position fixes",
    role="positions",
    against="the path by gyros and Doppler log",
    sigma=_fix_sigma,
    units={**LENGTHS, "degrees": 1.1e5},
    sense=lambda config: (
        f'north and east are exchanged: `world = "{_other(config, "positions", "world", "enu", "ned")}"` under '
        f"[positions] {IN_LOG_CONFIG}, or the fields of position in another order"
    ),
    scaled=lambda config, gain: (
        f"{_scale_line('positions', 'scale', config, gain)}; or the Doppler log's scale is wrong: "
        f"`scale = {config.number('dvl', 'scale', 1.0) * gain:.4g}` under [dvl]"
    ),
    least_lag_s=0.3,
    is_turned=True,
)
RANGE = Check(
    name="ranges to landmarks",
    role="detections",
    against="the motion between frames",
    sigma=lambda sequence: sequence.calibration.sonar.range_sigma_m,
    units=LENGTHS,
    sense=lambda _: (
        f"they grow where the vehicle approaches: the sonar looks backwards? `sonar.mounting.rpy_rad` {IN_CALIBRATION}"
    ),
    scaled=lambda config, gain: (
        f"{_scale_line('detections', 'range_scale', config, gain)}: the sonar's speed of sound is wrong, or the scale "
        "of the Doppler log"
    ),
)
AZIMUTH = Check(
    name="azimuths of landmarks",
    role="detections",
    against="the motion between frames",
    sigma=lambda sequence: sequence.calibration.sonar.azimuth_sigma_rad,
    units={"degrees": float(np.radians(1.0))},
    sense=lambda config: (
        f"they turn with the vehicle, mirrored: {_scale_line('detections', 'azimuth_scale', config, -1.0)}"
        '; of a Detection3DArray `rotation = "frd"`'
    ),
    scaled=lambda config, gain: _scale_line(
        "detections", "azimuth_scale", config, gain
    ),
    systematic=0.01,
    least_scale=0.1,
)


def stretches(
    seconds: Floats,
    y: Values,
    reference: Callable[[Floats], Values],
    motion: BodyMotion,
) -> list[SignalStretch]:
    """Rows in parts of at most `STRETCH_S`, which end at gaps of the Doppler log."""
    gaps = np.diff(motion.seconds) > motion.gap_s
    edges = np.concatenate(
        [motion.seconds[:1], motion.seconds[1:][gaps], motion.seconds[-1:] + 1e-9]
    )
    found = []
    for begin, end in pairwise(edges.tolist()):
        count = max(1, int(np.ceil((end - begin) / STRETCH_S)))
        for part in range(count):
            first = begin + part * (end - begin) / count
            rows = (seconds >= first) & (seconds < first + (end - begin) / count)
            if np.count_nonzero(rows) >= FEWEST_WINDOWS:
                found.append(SignalStretch(seconds[rows], y[rows], reference))
    return found


def compared(sequence: Sequence, motion: BodyMotion, check: Check) -> Match | None:
    """The comparison of a row of the table; None where the log has no such sensor."""
    if check is DEPTH and sequence.depth is not None:
        height = motion.height_m + motion.up @ sequence.calibration.depth.port_m
        t = motion.since_origin(sequence.depth.stamps_ns)
        return match(
            stretches(t, sequence.depth.z_m, lambda at: motion.at(at, height), motion),
            check.drift_sigma,
        )
    if check is HEADING and (heading := sequence.heading) is not None:
        t = motion.since_origin(heading.stamps_ns)
        yaw_rad = np.unwrap(heading.yaw_rad)
        return match(
            stretches(t, yaw_rad, lambda at: motion.at(at, motion.yaw_rad), motion),
            check.drift_sigma,
        )
    if check is POSITIONS and sequence.positions is not None:
        fixes = sequence.positions.rows(
            np.flatnonzero(is_level_fix(sequence.positions))
        )
        antenna = complex(*sequence.calibration.positions.antenna_m[:2])
        path = motion.path_m + antenna * np.exp(1j * motion.yaw_rad)
        t = motion.since_origin(fixes.stamps_ns)
        return match(
            stretches(
                t,
                fixes.position_m @ [1.0, 1j, 0.0],
                lambda at: motion.at(at, path),
                motion,
            )
        )
    if check in (RANGE, AZIMUTH) and sequence.detections is not None:
        changes = sightings(sequence, motion)
        if changes is None:
            return None
        found = match([changes[1]], find_lag=False)
        # the place of a landmark depends on its azimuth too, so that a mirrored one is more than a gain of -1
        other = sightings(sequence, motion, sign=-1.0)
        assert other is not None
        mirrored = match([other[1]], find_lag=False)
        is_mirrored = mirrored.scatter < found.scatter / CLEARLY_BETTER
        if check is RANGE:
            return match([other[0] if is_mirrored else changes[0]], find_lag=False)
        return replace(mirrored if is_mirrored else found, is_mirrored=is_mirrored)
    return None


def is_level_fix(fixes: PositionFixes) -> np.ndarray:
    """Mask of fixes whose level coordinates are measured, shape (n,)."""
    variances = np.einsum("nii->ni", fixes.covariance_m2)[:, :2]
    return np.asarray(
        fixes.are_sound() & ~(variances >= 0.5 * UNMEASURED_M2).any(axis=1)
    )


def findings_of(
    check: Check, found: Match, sequence: Sequence, config: LogConfig
) -> list[Finding]:
    """Rows of the report for a comparison: gain and lag, with cause and line where one is wrong."""
    quantity = (
        HEADING_SENSE
        if check is HEADING
        else f"{check.name}: change over that by {check.against}"
    )
    sigma = check.sigma(sequence)
    still = (
        "too little turning"
        if check in (HEADING, AZIMUTH)
        else f"too little motion for {check.name}"
    )
    if not found.gain.is_known:
        return [Finding(quantity, found.gain, "", "")]
    if not found.moved * max(1.0, abs(found.gain.value)) > LEAST_MOVED * sigma:
        return [Finding(quantity, replace(found.gain, reason=still), "", "")]
    gain = found.gain.limited(
        LARGEST_GAIN_SIGMA * max(1.0, abs(found.gain.value)), still
    )
    grave = grave_fault(check, replace(found, gain=gain), sequence, config)
    if grave:
        return [Finding(quantity, gain, "", grave, acts=True, grave=True)]
    if not gain.is_known:
        return [Finding(quantity, gain, "", "")]
    off = replace(gain, value=abs(gain.value) - 1.0)
    reach = check.reach(sequence, found)
    slips = (
        check.role == "detections"
        and sequence.calibration.odometry_interpolation == "hold-past"
    )
    acts = (
        not slips and matters(off, check.least_scale) and abs(off.value) * reach > sigma
    )
    advice = NO_NEED
    if acts:
        size = abs(gain.value)
        advice = f"it changes {size:.3g} times as much, up to {abs(off.value) * reach:.2g}: {check.scaled(config, size)}"
    known = replace(gain, sigma=float(np.hypot(gain.sigma, check.systematic)))
    is_grave = acts and abs(off.value) * reach > GRAVE_ERROR * sigma
    rows = [Finding(quantity, known, "", advice, acts, is_grave)]
    if found.lag.is_known:
        name = f"{check.name} against {check.against}: delay"
        rows.append(lag_finding(check, name, found, sigma, config))
    return rows


def grave_fault(
    check: Check, found: Match, sequence: Sequence, config: LogConfig
) -> str:
    """Cause and line of a fault beyond doubt: stuck, another sense or unit, or another thing; empty: none."""
    gain, sigma = found.gain, check.sigma(sequence)
    size = abs(gain.value)
    is_stuck = size + 4 * gain.sigma < HARDLY and found.moved > STUCK_MOVED * sigma
    slips = (
        check.role == "detections"
        and sequence.calibration.odometry_interpolation == "hold-past"
    )
    other_unit = SLIPPING_UNIT if slips else OTHER_UNIT
    if is_stuck and not unit_of(check, size):
        verb = "turns" if check is HEADING else "changes"
        return (
            f"it hardly {verb} where {check.against} do: stuck, or not of the body; `use = false` under [{check.role}] "
            f"{IN_LOG_CONFIG}"
        )
    if found.is_mirrored or (gain.is_known and gain.value < 0):
        return check.sense(config)
    if gain.is_known and not 1 / other_unit < size < other_unit:
        return unit_advice(check, size, config)
    # sightings that contradict the motion are wrong identities as a rule, which the estimators name
    is_landmark = check.role == "detections"
    is_scattered = found.scatter > LARGEST_SCATTER * sigma
    if is_scattered and found.misfit > MOST_MISFIT and not is_landmark:
        return contradiction(check, found)
    return ""


def contradiction(check: Check, found: Match) -> str:
    """Cause and line for a sensor that its reference does not explain."""
    return (
        f"{100 * found.misfit:.0f} % of its changes are not those by {check.against}, {found.scatter:.3g} apart "
        f"typically: another sensor's values, or wrong axes? `use = false` under [{check.role}] {IN_LOG_CONFIG} leaves "
        "it out"
    )


def unit_of(check: Check, gain: float) -> str:
    """The unit that a gain looks like; empty: none."""
    near = {unit: abs(np.log(gain * factor)) for unit, factor in check.units.items()}
    unit = min(near, key=near.__getitem__, default="")
    return unit if unit and near[unit] < UNIT_TOLERANCE else ""


def unit_advice(check: Check, gain: float, config: LogConfig) -> str:
    """Question for the unit, and the line."""
    unit = unit_of(check, gain)
    key = {
        "ranges to landmarks": "range_scale",
        "azimuths of landmarks": "azimuth_scale",
    }.get(check.name, "scale")
    times = 1.0 / check.units[unit] if unit else gain
    line = _scale_line(check.role, key, config, times)
    if check is POSITIONS and unit == "degrees":
        line = f"`geodetic`, with the fields of latitude and longitude, under [positions] {IN_LOG_CONFIG}"
    asked = f"{unit}? " if unit else "another unit? "
    return f"it changes {gain:.3g} times as much as by {check.against}: {asked}{line}"


def lag_finding(
    check: Check, quantity: str, found: Match, sigma: float, config: LogConfig
) -> Finding:
    """Row for a delay of the sensor."""
    lag = found.lag.limited(LARGEST_LAG_SIGMA_S, "too little changes in the motion")
    if not matters(lag, check.least_lag_s) or abs(lag.value) * found.rate < sigma:
        return Finding(quantity, lag, "s", NO_NEED)
    total_s = config.number(check.role, "stamp_offset_s", 0.0) - lag.value
    moved = abs(lag.value) * found.rate
    what = "late" if lag.value > 0 else "early"
    advice = (
        f"its rows come too {what}, an error of {moved:.2g} typically: `stamp_offset_s = {total_s:.3f}` under "
        f"[{check.role}] {IN_LOG_CONFIG}"
    )
    return Finding(
        quantity, lag, "s", advice, acts=True, grave=moved > GRAVE_ERROR * sigma
    )


def upwards(imu: Imu, body_R_imu: Floats) -> Floats:
    """Typical vertical in the IMU's axes, shape (3,), by gravity; the body's z without accelerometers."""
    force = imu.specific_force[np.isfinite(imu.specific_force).all(axis=1)]
    up = np.median(force, axis=0) if len(force) else body_R_imu.T @ [0.0, 0.0, 1.0]
    return np.asarray(up / np.linalg.norm(up))


def turned_about_up(imu: Imu, body_R_imu: Floats, at_ns: Ints) -> Floats:
    """Turn by the gyros about the vertical since the first row, shape (n,), rad; level without accelerometers."""
    rate = imu.angular_velocity @ upwards(imu, body_R_imu)
    steps = (rate[1:] + rate[:-1]) / 2 * np.diff(imu.stamps_ns) * 1e-9
    return np.interp(at_ns, imu.stamps_ns, np.concatenate([[0.0], np.cumsum(steps)]))


def vertical_bias(sequence: Sequence) -> Finding | None:
    """Bias of the gyros about the vertical, by a heading or by true orientations; None without either.

    The slope of the gyros' turn less the heading over time, less the bias that is known.
    """
    source = "the heading"
    if (heading := sequence.heading) is not None:
        stamps_ns, yaw_rad = heading.stamps_ns, np.unwrap(heading.yaw_rad)
    elif (truth := sequence.true_poses) is not None and len(truth) > 1:
        source = "the true orientations"
        stamps_ns, yaw_rad = (
            truth.stamps_ns,
            np.unwrap(truth.rotations().as_euler("ZYX")[:, 0]),
        )
    else:
        return None
    during = (stamps_ns >= sequence.start_ns) & (stamps_ns <= sequence.end_ns)
    stamps_ns, yaw_rad = stamps_ns[during], yaw_rad[during]
    imu, known = sequence.imu, np.array(sequence.calibration.imu.gyro_bias_rad_s)
    body_R_imu = sequence.calibration.imu.mounting.pose().rotation().matrix()
    up = upwards(imu, body_R_imu)
    drift_rad = turned_about_up(imu, body_R_imu, stamps_ns) - yaw_rad
    seconds = (stamps_ns - sequence.start_ns) / NS_PER_S
    # a turn during a hole of the IMU is in the heading alone
    before = np.searchsorted(imu.stamps_ns, stamps_ns, side="right") - 1
    holes = holes_before(imu.stamps_ns)[np.maximum(before, 0)]
    ends = np.flatnonzero(np.diff(holes)) + 1
    parts = []
    for run_s, run_rad in zip(
        np.split(seconds, ends), np.split(drift_rad, ends), strict=True
    ):
        if len(run_s) < FEWEST_WINDOWS:
            continue
        count = max(1, int(np.ceil(np.ptp(run_s) / STRETCH_S)))
        for part_s, part_rad in zip(
            np.array_split(run_s, count), np.array_split(run_rad, count), strict=True
        ):
            parts.append(SignalStretch(part_s, part_rad, lambda at: at))
    bias = Estimate1D(np.nan, np.inf, f"too little time beside {source}")
    found = match(parts, find_lag=False).gain if parts else bias
    if found.is_known and np.ptp(seconds) > LEAST_BIAS_S:
        bias = Estimate1D(found.value - float(up @ known), max(found.sigma, 1e-9))
    allowed = sequence.calibration.imu.gyro_bias_sigma
    acts = matters(
        replace(bias, sigma=float(np.hypot(bias.sigma, allowed))), LEAST_BIAS_RAD_S
    )
    advice = (
        f"by {source}; the calibration's sigma of {allowed:.2g} allows it, {NO_NEED}"
    )
    if acts:
        whole = known + bias.value * up
        advice = (
            f"by {source}, {np.degrees(bias.value):.3g}°/s beyond the calibration's sigma of {allowed:.2g}: "
            f"`imu.gyro_bias_rad_s = {numbers(whole, 5)}` {IN_CALIBRATION}"
        )
    turned_rad = abs(bias.value) * sequence.duration_s
    return Finding(
        "gyro bias about the vertical",
        bias,
        "rad/s",
        advice,
        acts,
        acts and turned_rad > LARGE_TURN_RAD,
    )


FARTHEST_FROM_START_M = 2.0
"""Height that a vehicle gains about the start, with its depth sensor's error."""
FIRST_ROWS = 5


def start_depth_findings(sequence: Sequence) -> Iterator[Finding]:
    """A stated start that is at another height than the first depths; nothing where they agree."""
    depth, start, calibration = (
        sequence.depth,
        sequence.calibration.start,
        sequence.calibration,
    )
    if (
        depth is None
        or start.source != "stated"
        or "position_m" not in start.model_fields_set
    ):
        return
    first = max(int(np.searchsorted(depth.stamps_ns, sequence.start_ns)) - 1, 0)
    height_m = float(np.median(depth.z_m[first : first + FIRST_ROWS]))
    off_m = height_m - float(
        start.pose().transformFrom(np.array(calibration.depth.port_m))[2]
    )
    if abs(off_m) <= FARTHEST_FROM_START_M + 3.0 * start.position_sigma_m[2]:
        return
    x, y, z = start.position_m
    place = numbers((x, y, z + off_m), 2)
    advice = (
        f"the height begins at {height_m:.2f} m, the start of the calibration is at {height_m - off_m:.2f} m: an "
        f"altimeter, another sign, unit or origin, or a wrong start? `use = false` under [depth] {IN_LOG_CONFIG} "
        f"leaves the depths out, scale = -1 there is for depths downwards; `start.position_m = {place}` "
        f"{IN_CALIBRATION} where the depths are right"
    )
    off = Estimate1D(off_m, calibration.depth.sigma_m)
    yield Finding(
        "depth: distance from the start", off, "m", advice, acts=True, grave=True
    )


def heading_findings(
    right: Sequence, config: LogConfig, motion: BodyMotion | None = None
) -> Iterator[Finding]:
    """Sense, scale and delay of the heading; where right, the angle by which it is off the world of the positions."""
    if right.heading is None:
        return
    motion = motion or BodyMotion.of(right)
    found = None if motion is None else compared(right, motion, HEADING)
    if motion is None or found is None:
        return
    rows = findings_of(HEADING, found, right, config)
    yield from rows
    known = right.positions or right.truth
    if rows[0].grave or known is None:
        return
    places = known.position_m if isinstance(known, PositionFixes) else known.positions
    t = motion.since_origin(known.stamps_ns)
    heading_s = motion.since_origin(right.heading.stamps_ns)
    by_heading = np.interp(motion.seconds, heading_s, np.unwrap(right.heading.yaw_rad))
    steps = np.diff(motion.path_m) * np.exp(1j * (by_heading - motion.yaw_rad))[1:]
    path = np.concatenate([np.zeros(1), np.cumsum(steps)])
    turn = match(
        stretches(t, places @ [1.0, 1j, 0.0], lambda at: motion.at(at, path), motion),
        find_lag=False,
    )
    angle = Estimate1D(np.nan, np.inf, "too little motion beside positions")
    if turn.misfit < MOST_MISFIT and 0.5 < turn.gain.value < 2.0:
        angle = turn.angle.limited(LARGEST_HEADING_SIGMA_RAD, angle.reason)
    allowed = right.calibration.heading.bias_sigma_rad
    acts = matters(replace(angle, sigma=float(np.hypot(angle.sigma, allowed / 2))), 0.0)
    advice = f"the calibration's bias sigma of {allowed:.2g} rad allows it, {NO_NEED}"
    if acts:
        offset = config.number("heading", "yaw_offset_rad", 0.0) + angle.value
        rpy = numbers(turned_mounting(right.calibration.dvl, angle.value), 4)
        vertical = vertical_bias(right)
        first = (
            "once the gyro bias is put right, which comes first, "
            if vertical is not None and vertical.acts
            else ""
        )
        advice = (
            f"{first}either its world, north or mounting is another: `yaw_offset_rad = {offset:.3f}` under [heading] "
            f"{IN_LOG_CONFIG}; or the Doppler log is turned on the vehicle: `dvl.mounting.rpy_rad = {rpy}` "
            f"{IN_CALIBRATION}"
        )
    yield Finding(
        HEADING_TURN,
        in_degrees(angle),
        "°",
        advice,
        acts,
        acts and abs(angle.value) > LARGE_TURN_RAD,
    )


LARGE_TURN_RAD = np.radians(10.0)
"""Of the heading against positions: beyond, a run's result is of little worth."""


def jumping_share(right: Sequence, fixes: PositionFixes) -> tuple[float, int]:
    """Share of fixes from which the one `JUMP_NS` later is farther than the Doppler log moves, and their number.

    With l the way by the Doppler log, in a gap at the log's high speed, a displacement Δ of length d is beyond it by
    ``e = Δ (1 - l / d)``, and is no noise of the two fixes where ``eᵀ (C_i + C_j)⁻¹ e`` is above `JUMP_GATE`.
    """
    fixes = fixes.rows(np.flatnonzero(fixes.are_sound()))
    is_measured = np.isfinite(right.dvl.velocity).all(axis=1)
    stamps_ns, speed = (
        right.dvl.stamps_ns[is_measured],
        np.linalg.norm(right.dvl.velocity[is_measured], axis=1),
    )
    steps_s = np.diff(stamps_ns) * 1e-9
    mean_speed = np.where(
        steps_s > right.calibration.dvl.gap_s,
        np.percentile(speed, HIGH_PERCENTILE),
        (speed[1:] + speed[:-1]) / 2,
    )
    t = fixes.stamps_ns
    way_m = np.interp(
        t, stamps_ns, np.concatenate([[0.0], np.cumsum(mean_speed * steps_s)])
    )
    later = np.searchsorted(t, t + JUMP_NS)
    i = np.flatnonzero((later < len(t)) & (t >= stamps_ns[0]))
    i = i[t[later[i]] <= stamps_ns[-1]]
    if not len(i):
        return 0.0, 0
    j = later[i]
    moved = fixes.position_m[j] - fixes.position_m[i]
    length = np.maximum(np.linalg.norm(moved, axis=1), 1e-9)
    beyond = moved * np.maximum(0.0, 1 - (way_m[j] - way_m[i]) / length)[:, None]
    noise = np.diag(np.square(right.calibration.positions.sigma_m))
    cov_m2 = np.where(np.isnan(fixes.covariance_m2), noise, fixes.covariance_m2)
    squares = np.einsum(
        "ka,ka->k",
        beyond,
        np.linalg.solve(cov_m2[i] + cov_m2[j], beyond[:, :, None])[:, :, 0],
    )
    return float(np.mean(squares > JUMP_GATE)), len(i)


def position_findings(
    right: Sequence, config: LogConfig, motion: BodyMotion | None = None
) -> Iterator[Finding]:
    """Unit and delay of the position fixes, jumps that no vehicle makes, and their distance from start or origin."""
    fixes, calibration = right.positions, right.calibration
    if fixes is None:
        return
    table = config.table("positions")
    motion = motion or BodyMotion.of(right)
    found = (
        unknown("too few fixes beside the Doppler log")
        if motion is None
        else compared(right, motion, POSITIONS)
    )
    rows = findings_of(POSITIONS, found or unknown("no fixes"), right, config)
    if rows[0].grave and "%" not in rows[0].advice:
        yield rows[0]
        return
    noise_m = _fix_sigma(right)
    share, count = jumping_share(right, fixes)
    if share > LARGEST_JUMPING_SHARE and share * count >= FEWEST_WINDOWS:
        of_all = Estimate1D(
            100 * share, 100 * float(np.sqrt(share * (1 - share) / count))
        )
        advice = (
            f"fixes {JUMP_NS / NS_PER_S:.0f} s apart are farther from each other than the vehicle moves by its Doppler "
            f"log and their noise allows: angles, or of another thing? `use = false` under [positions] {IN_LOG_CONFIG} "
            f"leaves them out; or they are worse than `positions.sigma_m` {IN_CALIBRATION}"
        )
        yield Finding(
            "position fixes: jumps", of_all, "%", advice, acts=True, grave=True
        )
        return
    yield from rows
    if not rows[0].estimate.is_known and rows[0].estimate.reason.startswith("too few"):
        return
    near = np.median(
        fixes.position_m[
            np.argsort(np.abs(fixes.stamps_ns - right.start_ns))[:FEWEST_WINDOWS]
        ],
        axis=0,
    )
    start = np.array(calibration.start.position_m)
    path_m = float(
        np.sum(
            np.linalg.norm(right.dvl.velocity[1:], axis=1)
            * np.diff(right.dvl.stamps_ns)
        )
        * 1e-9
    )
    allowed_m = (
        5.0
        * float(np.hypot(noise_m, np.hypot(*calibration.start.position_sigma_m[:2])))
        + path_m
    )
    from_start_m, from_origin_m = (
        float(np.linalg.norm((near - place)[:2])) for place in (start, 0.0 * start)
    )
    advice = NO_NEED
    acts = from_start_m > allowed_m or from_origin_m > FARTHEST_ORIGIN_M
    distance = Estimate1D(from_start_m, noise_m)
    if acts:
        place = "the start" if from_start_m > allowed_m else "the origin of the world"
        far_m = from_start_m if from_start_m > allowed_m else from_origin_m
        before = np.array(table.get("origin_m", np.zeros(3)), float)
        line = f"`origin_m = {numbers(before + np.round(near), 0)}` under [positions] {IN_LOG_CONFIG}"
        advice = (
            f"they begin {far_m:.3g} m from {place}, the whole way is {path_m:.3g} m: a map grid (UTM)? "
            f"{line} moves the origin to the first; or state the start there"
        )
    yield Finding(
        "position fixes: distance from the start", distance, "m", advice, acts, acts
    )


PAIR_S, LONGEST_PAIR_S = 1.0, 3.0
"""Time between two sightings of a landmark that are compared: long enough to move, and short enough to turn little."""
FEWEST_PAIRS = 20


def sightings(
    sequence: Sequence, motion: BodyMotion, sign: float = 1.0
) -> tuple[SignalStretch, SignalStretch] | None:
    """Changes of range and azimuth between two sightings of a landmark, and those by the motion; None: too few.

    With p = l + r u the landmark in the body, u the direction, l the sonar's place, and the body moved by d and turned
    by R: ``p_j = R' (p_i - d)``. Elevations are taken as zero; azimuths count with a ``sign``.
    """
    seen, mounting = sequence.detections, sequence.calibration.sonar.mounting.pose()
    if seen is None:
        return None
    t = motion.since_origin(seen.stamps_ns)
    ids = seen.most_probable()[0]
    is_usable = (
        seen.are_sound()
        & (t >= motion.seconds[0])
        & (t <= motion.seconds[-1])
        & (ids >= 0)
    )
    first, second = list[int](), list[int]()
    for landmark_id in np.unique(ids[is_usable]).tolist():
        rows = np.flatnonzero(is_usable & (ids == landmark_id))
        later = rows[
            np.minimum(np.searchsorted(t[rows], t[rows] + PAIR_S), len(rows) - 1)
        ]
        pairs = (t[later] - t[rows] >= PAIR_S) & (t[later] - t[rows] <= LONGEST_PAIR_S)
        first += rows[pairs].tolist()
        second += later[pairs].tolist()
    if len(first) < FEWEST_PAIRS:
        return None
    order = np.argsort(t[second], kind="stable")
    i, j = np.array(first)[order], np.array(second)[order]
    R, lever = mounting.rotation().matrix(), mounting.translation()
    azimuth = sign * seen.azimuth_rad[i]
    ahead = np.column_stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth])
    place = lever + (seen.range_m[i, None] * ahead) @ R.T  # (k, 3)
    path_i, path_j, yaw_i, yaw_j = (
        motion.at(t[rows], values)
        for values in (motion.path_m, motion.yaw_rad)
        for rows in (i, j)
    )
    climbed = motion.at(t[j], motion.height_m) - motion.at(t[i], motion.height_m)
    # level, in axes of the body at the first sighting
    moved = (path_j - path_i) * np.exp(-1j * yaw_i)
    level = (place[:, 0] + 1j * place[:, 1] - moved) * np.exp(-1j * (yaw_j - yaw_i))
    after = (
        np.column_stack([level.real, level.imag, place[:, 2] - climbed]) - lever
    ) @ R
    r = np.linalg.norm(after, axis=1)
    turned = wrap_angle(np.arctan2(after[:, 1], after[:, 0]) - azimuth)
    seen_turn = wrap_angle(sign * seen.azimuth_rad[j] - azimuth)
    by_range = SignalStretch(
        t[j],
        seen.range_m[j] - seen.range_m[i],
        lambda _: r - seen.range_m[i],
        has_offset=False,
    )
    by_azimuth = SignalStretch(t[j], seen_turn, lambda _: turned, has_offset=False)
    return by_range, by_azimuth
