"""Checks of depth, heading, position fixes and sightings against the motion of the body.

`CHECKS` is the table: a row for each quantity with its signals, the units and scales that sensors confuse, and the
lines that mend a fault. One comparison finds all of them (`sonar_graph.diagnosis.signals`): gain, lag, scatter.
docs/theory/sensor_check.md.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sonar_graph.diagnosis.causes import (
    AS_GOOD,
    DEVIATION,
    DRIFT,
    LEAST_DRIFT_M_S,
    OF_FIXES,
    OF_RANGES,
    PITCH,
    SOFT_IRON,
    SONAR_TURN,
    Cause,
    cause_of,
    excursion,
    of_scale,
    pause_text,
    step_text,
)
from sonar_graph.diagnosis.findings import (
    ACTING_SIGMAS,
    IN_CALIBRATION,
    IN_LOG_CONFIG,
    NO_NEED,
    Advice,
    Finding,
    Findings,
    Gravity,
    contradiction,
    gravity_of,
    in_degrees,
    known_values,
    matters,
    numbers,
    other_world,
    scale_line,
    shift_line,
    unknown,
    unused,
)
from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.diagnosis.sightings import SightingChanges, sighting_changes
from sonar_graph.diagnosis.signals import (
    CLEARLY_BETTER,
    FAR_MISFIT,
    LAGS_S,
    NO_LAG,
    Match,
    Values,
    explained,
    far_lags,
    match,
    root_mean_square,
)
from sonar_graph.diagnosis.start import (
    LARGE_TURN_RAD,
    LEAST_BIAS_RAD_S,
    turned_mounting,
)
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import (
    NS_PER_S,
    UNMEASURED_M2,
    Depth,
    Floats,
    Ints,
    PositionFixes,
)
from sonar_graph.models import wrap_angle
from sonar_graph.navigation.alignment import Estimate1D, Estimates3D
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.sequence import Sequence
from sonar_graph.states import Trajectory

HEADING_SENSE = "heading: turn over that of the gyros"
VERTICAL_BIAS = "gyro bias about the vertical"
HEADING_TURN = "heading: turn towards the positions"
OR_DVL = "; or the Doppler log"
LARGEST_GAIN_SIGMA = 0.12
"""Of a gain that is shown: 1 and -1 are sixteen sigmas apart."""
LARGEST_LAG_SIGMA_S = 0.5
LARGEST_HEADING_SIGMA_RAD = 0.25
OTHER_UNIT = 1.3
"""Gain, either way, from which on a unit is suspected, not a scale."""
SLIPPING_UNIT = 3.0
"""The same for sightings of a vehicle on wheels, which slip."""
UNIT_TOLERANCE = 0.03
MOST_UNIT_TOLERANCE = 0.1
HARDLY = 0.25
"""Gain below which a sensor counts as one that can hardly change."""
LEAST_MOVED = 1.0
"""Motion in sigmas of a row, below which nothing is known of a sensor."""
STUCK_MOVED = 10.0
"""The same for a sensor that is stuck."""
STEP_GAIN_ERROR = 0.1
STEP_RATIO = 3.0
"""Steps of a sensor over those of its motion, from which on they are none of the motion."""
MOST_MISFIT = 0.3
"""Share of its changes that the reference does not explain, from which on a sensor contradicts it."""
LARGEST_SCATTER = 10.0
"""Scatter in sigmas, from which on a sensor contradicts beyond doubt: normalised squares of 100."""
GRAVE_ERROR = 5.0
"""Error by a scale or a lag, in sigmas of a row, from which on results are doubtful."""
GRAVE_SCALE = 0.1
"""Error of a scale that no sensor has which works."""
CLIMB_S = 40.0
"""Time in which a vehicle climbs or dives by much more than the Doppler log's noise adds up to."""
FEWEST_DEPTHS = 30
LENGTHS = {
    "mm": 1e-3,
    "cm": 1e-2,
    "feet": 0.3048,
    "inches": 0.0254,
    "fathoms": 1.8288,
    "km": 1e3,
}
PRESSURES = {"kPa as Pa": 1e3, "hPa as Pa": 1e2, "dbar as Pa": 1e4, "bar as Pa": 1e5}
ANOTHER_UNIT = "another unit"
KNOTS = "knots of the Doppler log"
KNOTS_LINE = f"`scale = 0.5144` under [dvl] {IN_LOG_CONFIG}"
MINUTES = "degrees and minutes written as 12.3456"
DEGREES = {"degrees": np.radians(1.0)}


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
    sense: Callable[[Sequence, LogConfig], Advice]
    """Where the gain is negative or the signal is mirrored."""
    scaled: Callable[[LogConfig, float], str]
    """Where the gain is near 1."""
    units: Mapping[str, float] = field(default_factory=dict)
    """Factors to the right unit, by the name of the wrong one."""
    scale_key: str = "scale"
    grave_scale: float = GRAVE_SCALE
    """Error of a scale from which on results are doubtful, however little moves."""
    systematic: float = 0.0
    """Sigma of the gain by what the comparison leaves out."""
    slow_sigma: Callable[[Sequence], float] = lambda _: 0.0
    """Error of sensor and reference that changes as slowly as the motion, in the sensor's unit: blocks of rows hide it."""
    drift: Callable[[Sequence], float] = lambda _: 0.0
    """How fast the reference may drift, in the sensor's unit a second, where nothing is wrong."""
    least_scale: float = 0.03
    least_lag_s: float = 0.1
    reach: Callable[[Sequence, Match], float] = lambda _, found: found.moved
    """What the error of a gain is multiplied by, in the sensor's unit."""
    quantity: str = ""
    """Name of the gain where it is not made from the others."""
    is_angle: bool = False
    causes: tuple[Cause, ...] = ()
    """What else may be wrong."""
    other_lines: Mapping[str, str] = field(default_factory=dict)
    """Lines for units that no scale puts right."""
    step_unit: str = ""
    """Unit of steps; empty where steps are not looked for."""

    @property
    def is_sighting(self) -> bool:
        """True for the checks of landmarks, whose identities may be wrong."""
        return self.role == "detections"


def match_rows(
    motion: BodyMotion,
    seconds: Floats,
    y: Values,
    reference: Callable[[Floats], Values],
    drift_sigma: float = 0.0,
    slow_sigma: float = 0.0,
) -> Match:
    """Rows of a sensor compared with the motion; also in one piece, for the search of causes."""
    stretches = [
        replace(part, slow_sigma=slow_sigma)
        for part in motion.stretches(seconds, y, reference)
    ]
    whole = motion.stretches(seconds, y, reference, np.inf)
    return replace(match(stretches, drift_sigma), whole=tuple(whole))


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
    reference = motion.reference(height)
    ahead = motion.reference(motion.ahead_m)
    stretches = [
        replace(
            part,
            slow_sigma=climb_sigma(sequence),
            beside=lambda t: ahead(t)[:, None],
        )
        for part in motion.stretches(t, depth.z_m, reference, longest_s)
    ]
    whole = motion.stretches(t, depth.z_m, reference, np.inf)
    found = replace(match(stretches, 0.03), whole=tuple(whole))
    return motion.between_rows(found, motion.height_m)


def climb_sigma(sequence: Sequence) -> float:
    """Error of a height reckoned by the Doppler log over `CLIMB_S`, about a line, m.

    The integral of white noise is a random walk, and about a line an eighth of its end's error is left in a gain.
    """
    interval_s = float(np.median(np.diff(sequence.dvl.stamps_ns))) / NS_PER_S
    duration_s = min(sequence.duration_s, CLIMB_S)
    velocity_m_s = max(sequence.calibration.dvl.velocity_sigma_m_s)
    return velocity_m_s * np.sqrt(interval_s * duration_s) / 8.0


def unwrapped(yaw_rad: Floats) -> Floats:
    """Headings without jumps by a turn, shape (n,): wild rows do not carry those after them over a turn.

    The middle of five directions is unwrapped, and each row stays near it.
    """
    directions = np.exp(1j * np.pad(yaw_rad, 2, mode="edge"))
    five = np.lib.stride_tricks.sliding_window_view(directions, 5)  # (n, 5)
    middle = np.median(five.real, axis=1) + 1j * np.median(five.imag, axis=1)
    steady = np.unwrap(np.angle(middle))
    return steady + wrap_angle(yaw_rad - steady)


def heading_match(sequence: Sequence, motion: BodyMotion) -> Match | None:
    """Heading by the gyros, which drift."""
    heading = sequence.heading
    if heading is None:
        return None
    t = motion.since_origin(heading.stamps_ns)
    yaw_rad = unwrapped(heading.yaw_rad)
    slow_rad = slow_heading_sigma(sequence)
    return match_rows(motion, t, yaw_rad, motion.turned, 0.02, slow_rad)


def slow_heading_sigma(sequence: Sequence) -> float:
    """Error of a compass that changes as slowly as the vehicle turns, rad."""
    return 0.1 * sequence.calibration.heading.bias_sigma_rad


def fix_match(sequence: Sequence, motion: BodyMotion) -> Match | None:
    """Level position of the antenna by the path."""
    if sequence.positions is None:
        return None
    fixes = sequence.positions
    fixes = fixes.rows(is_level_fix(fixes))
    antenna = complex(*sequence.calibration.positions.antenna_m[:2])
    path = motion.path_m + antenna * np.exp(1j * motion.yaw_rad)
    t = motion.since_origin(fixes.stamps_ns)
    level = fixes.position_m @ [1.0, 1j, 0.0]
    slow_m = slow_fix_sigma(sequence)
    found = match_rows(motion, t, level, motion.reference(path), slow_sigma=slow_m)
    return motion.between_rows(found, motion.path_m)


def slow_fix_sigma(sequence: Sequence) -> float:
    """Error of fixes that changes as slowly as the vehicle moves, m."""
    return 0.1 * level_sigma_m(fix_sigma_m(sequence))


def is_level_fix(fixes: PositionFixes) -> NDArray[np.bool_]:
    """Mask of fixes whose level coordinates are measured, shape (n,)."""
    return fixes.are_sound() & ~are_unmeasured(fixes)[:, :2].any(axis=1)


def are_unmeasured(fixes: PositionFixes) -> NDArray[np.bool_]:
    """Mask of coordinates that a fix states as not measured, shape (n, 3)."""
    variances = np.einsum("nii->ni", fixes.covariance_m2)
    return variances >= 0.5 * UNMEASURED_M2


def sighting_match(
    sequence: Sequence, motion: BodyMotion, *, of_range: bool
) -> Match | None:
    """Changes between sightings of a landmark by the motion, with azimuths as they are or mirrored."""
    fits = list[tuple[SightingChanges, Match]]()
    for sign in (1.0, -1.0):
        changes = sighting_changes(sequence, motion, sign)
        if changes is None:
            return None
        # only turns show a delay: ranges change evenly
        fits.append(
            (changes, match([changes.azimuth], lags_s=NO_LAG if of_range else LAGS_S))
        )
    # a landmark's place depends on its azimuth: a mirrored one is more than a gain of -1
    is_mirrored = fits[1][1].scatter < fits[0][1].scatter / CLEARLY_BETTER
    changes, by_azimuth = fits[is_mirrored]
    if of_range:
        aperture_rad = sequence.calibration.sonar.elevation_aperture_rad
        return range_match(changes, aperture_rad)
    # a delay turns landmarks about the vehicle as fast as it turns, not as changes of the azimuth change
    turn_rate = root_mean_square([np.diff(motion.yaw_rad) / np.diff(motion.seconds)])
    return replace(by_azimuth, is_mirrored=is_mirrored, rate=turn_rate)


def range_match(changes: SightingChanges, aperture_rad: float) -> Match:
    """Changes of ranges by the motion, beside what heights of landmarks take off them.

    Elevations are not measured, but lie within the aperture, with a sigma of ``aperture / sqrt(12)``.
    """
    whole = changes.range
    found = replace(match([whole], lags_s=NO_LAG), stretches=(whole,))
    of_elevation = aperture_rad / np.sqrt(12.0) * changes.error_by_elevation
    by_scale = explained(found.stretches, of_scale, 1)
    if by_scale is None or not found.gain.is_known:
        return found
    beside_heights = Estimate1D(1.0 + float(by_scale.q[0]), float(by_scale.sigmas[0]))
    # where ranges change little, a scale and heights look alike: the nearer to 1 of both readings is sure
    gain = min(found.gain, beside_heights, key=lambda one: abs(one.value - 1.0))
    return replace(found, gain=gain).less_certain(of_elevation)


def depth_sense(sequence: Sequence, config: LogConfig) -> Advice:
    """Line for depths that run against the Doppler log; above the water they are downwards, else either may be wrong."""
    assert sequence.depth is not None
    cause = "it rises where the vehicle sinks by the Doppler log"
    negated = scale_line("depth", "scale", config, -1.0)
    if float(np.median(sequence.depth.z_m)) > HIGHEST_M:
        return Advice(f"{cause}, above the water: depths downwards", negated)
    return Advice(
        f"{cause}: depths downwards, an altimeter, or the Doppler log has the wrong sense along z?",
        f"{negated}; an altimeter is no depth: {unused('depth')}; `rotation` under [dvl] {IN_LOG_CONFIG} turns its axes",
    )


DEPTH = Check(
    name="depth",
    role="depth",
    against="the Doppler log's vertical velocity",
    compare=depth_match,
    sigma=lambda sequence: max(sequence.calibration.depth.sigma_m, 0.02),
    slow_sigma=climb_sigma,
    drift=lambda _: LEAST_DRIFT_M_S,
    causes=(PITCH, DRIFT),
    step_unit="m",
    units=LENGTHS | PRESSURES,
    sense=depth_sense,
    scaled=lambda config, gain: (
        f"{scale_line('depth', 'scale', config, gain)}; of a pressure the water's density (water_density_kg_m3)"
    ),
)
HEADING = Check(
    name="heading",
    role="heading",
    against="the gyros",
    compare=heading_match,
    sigma=lambda sequence: sequence.calibration.heading.sigma_rad,
    slow_sigma=slow_heading_sigma,
    drift=lambda sequence: 3.0 * sequence.calibration.imu.gyro_bias_sigma,
    units=DEGREES,
    sense=lambda _, config: Advice(
        "it turns against the gyros, clockwise", other_world(config, "heading")
    ),
    # a heading that turns too far is right as a rule: the gyros' rate is too small
    scaled=lambda config, gain: (
        "the gyros' scale is wrong, or the compass deviates with the heading: "
        + scale_line("imu", "angular_velocity_scale", config, 1.0 / gain)
    ),
    least_scale=0.01,
    # gyros keep within one per cent, and each turn adds to the error
    grave_scale=0.03,
    quantity=HEADING_SENSE,
    causes=(DEVIATION, SOFT_IRON),
    step_unit="°",
    is_angle=True,
)
POSITIONS = Check(
    name="position fixes",
    role="positions",
    against="the path by gyros and Doppler log",
    compare=fix_match,
    sigma=lambda sequence: level_sigma_m(fix_sigma_m(sequence)),
    slow_sigma=slow_fix_sigma,
    units=LENGTHS | {"degrees": 1.1e5, MINUTES: 1 / 0.6, KNOTS: 1 / 0.5144},
    sense=lambda _, config: Advice(
        "north and east are exchanged",
        f"{other_world(config, 'positions')}, or the fields of position in another order; of latitude and longitude, one "
        "without its sign",
    ),
    scaled=lambda config, gain: (
        f"{scale_line('positions', 'scale', config, gain)}; or the Doppler log's scale is wrong: "
        f"`scale = {config.number('dvl', 'scale', 1.0) * gain:.4g}` under [dvl]"
    ),
    least_lag_s=0.3,
    other_lines={
        "degrees": f"`geodetic`, with the fields of latitude and longitude, under [positions] {IN_LOG_CONFIG}",
        MINUTES: "write them as decimal degrees",
        KNOTS: KNOTS_LINE,
    },
    causes=(OF_FIXES,),
    step_unit="m",
)
SIGHTINGS = partial(Check, role="detections", against="the motion between frames")
RANGE = SIGHTINGS(
    name="ranges to landmarks",
    compare=partial(sighting_match, of_range=True),
    sigma=lambda sequence: sequence.calibration.sonar.range_sigma_m,
    units=LENGTHS
    | {"the way there and back": 0.5, "half of the range": 2.0, KNOTS: 1 / 0.5144},
    other_lines={KNOTS: KNOTS_LINE},
    scale_key="range_scale",
    # landmarks are wrong by the error of the whole range, not of its changes
    reach=lambda sequence, _: typical_sighting(sequence, "range_m"),
    causes=(OF_RANGES, SONAR_TURN),
    sense=lambda *_: Advice(
        "they grow where the vehicle approaches: the sonar looks backwards, or the Doppler log has the wrong sense?",
        f"`sonar.mounting.rpy_rad` {IN_CALIBRATION}, its yaw changed by 3.1416",
    ),
    scaled=lambda config, gain: (
        f"{scale_line('detections', 'range_scale', config, gain)}: the sonar's speed of sound is wrong, or the scale "
        "of the Doppler log"
    ),
)
AZIMUTH = SIGHTINGS(
    name="azimuths of landmarks",
    compare=partial(sighting_match, of_range=False),
    sigma=lambda sequence: sequence.calibration.sonar.azimuth_sigma_rad,
    units=DEGREES,
    scale_key="azimuth_scale",
    reach=lambda sequence, _: typical_sighting(sequence, "azimuth_rad"),
    sense=lambda _, config: Advice(
        "they turn with the vehicle, mirrored",
        f'{scale_line("detections", "azimuth_scale", config, -1.0)}; of a Detection3DArray `rotation = "frd"`',
    ),
    scaled=partial(scale_line, "detections", "azimuth_scale"),
    systematic=0.01,
    least_scale=0.1,
    is_angle=True,
)
CHECKS = (DEPTH, RANGE, AZIMUTH, HEADING, POSITIONS)


def begins_below_water(sequence: Sequence) -> bool:
    """True for depths that begin at a stated start, which is not where z has no sign: they are right."""
    start = sequence.calibration.start
    is_deep = start.states("position_m") and abs(start.position_m[2]) > HIGHEST_M
    return is_deep and not any(start_depth_findings(sequence))


def typical_sighting(sequence: Sequence, column: str) -> float:
    """Size of the range, m, or of the azimuth, rad, of sightings that can be used, a root mean square."""
    seen = sequence.detections
    assert seen is not None
    return root_mean_square([getattr(seen, column)[seen.are_sound()]])


def fix_sigma_m(sequence: Sequence) -> tuple[float, float, float]:
    """Typical standard deviations of a fix along the world's axes: the log's, or the calibration's where it has none."""
    known = sequence.positions
    if known is not None:
        variances = np.einsum("nii->ni", known.covariance_m2)
        # a coordinate that is not measured says nothing of those that are
        measured = np.where(are_unmeasured(known), np.nan, variances)
        stated = known.are_sound() & np.isfinite(variances).all(axis=1)
        measured = measured[stated]
        if np.isfinite(measured).any(axis=0).all():
            x, y, z = np.sqrt(np.nanmedian(measured, axis=0)).tolist()
            return x, y, z
    return sequence.calibration.positions.sigma_m


def level_sigma_m(sigma_m: tuple[float, float, float]) -> float:
    """Standard deviation of a level position, both axes together."""
    return np.hypot(*sigma_m[:2])


def findings_of(
    check: Check, found: Match, sequence: Sequence, config: LogConfig
) -> Findings:
    """Rows of the report for a comparison: gain and lag, with cause and line where one is wrong."""
    quantity = check.quantity or f"{check.name}: change over that by {check.against}"
    if not found.gain.is_known:
        return [Finding(quantity, found.gain)]
    little = "turning" if check.is_angle else f"motion for {check.name}"
    still = f"too little {little}"
    sigma = check.sigma(sequence)
    size = max(1.0, abs(found.gain.value))
    by_slow = check.slow_sigma(sequence) / max(found.moved, 1e-9)
    found = found.less_certain(np.hypot(by_slow, check.systematic))
    is_still = not found.moved * size > LEAST_MOVED * sigma
    gain = found.gain.limited(0.0 if is_still else LARGEST_GAIN_SIGMA * size, still)
    one = SensorComparison(
        check, quantity, replace(found, gain=gain), sigma, sequence, config
    )
    if is_still:
        # no motion is needed to see that a sensor jumps
        return [one.jumps() or Finding(quantity, gain)]
    fault = next(filter(None, (find(one) for find in FAULTS)), None)
    if fault is not None:
        return [fault]
    if not gain.is_known:
        return [Finding(quantity, gain)]
    return one.small_faults()


@dataclass(frozen=True, eq=False)
class SensorComparison:
    """A comparison in which the vehicle moves enough, and the faults that it may show."""

    check: Check
    quantity: str
    found: Match
    sigma: float
    """Of a row."""
    sequence: Sequence
    config: LogConfig

    @property
    def size(self) -> float:
        """Of the gain, without its sign."""
        return abs(self.found.gain.value)

    @property
    def is_late(self) -> bool:
        """True where the delay is sure."""
        return matters(self.found.lag, self.check.least_lag_s)

    @property
    def slips(self) -> bool:
        """True for sightings from wheels, whose odometry has a scale of its own."""
        is_wheeled = self.sequence.calibration.odometry_interpolation == "hold-past"
        return self.check.is_sighting and is_wheeled

    @property
    def units(self) -> list[str]:
        """The units that the gain looks like, within its interval, the nearest one first."""
        size = max(self.size, 1e-12)
        near = {
            unit: abs(np.log(size * factor))
            for unit, factor in self.check.units.items()
        }
        tolerance = max(UNIT_TOLERANCE, ACTING_SIGMAS * self.found.gain.sigma / size)
        most = min(tolerance, MOST_UNIT_TOLERANCE)
        return sorted((u for u in near if near[u] < most), key=near.__getitem__)

    def contradiction(self, cause: str, line: str) -> Finding:
        """The row of the gain with a cause."""
        return contradiction(self.quantity, cause, line, self.found.gain)

    def stuck(self) -> Finding | None:
        """No change where the reference has some; a wrong unit may make a gain small too."""
        moved = self.found.moved
        is_flat = self.size + 4 * self.found.gain.sigma < HARDLY
        if not is_flat or self.units or moved <= STUCK_MOVED * self.sigma:
            return None
        verb = "turns" if self.check is HEADING else "changes"
        return self.contradiction(
            f"it hardly {verb} where {self.check.against} do: stuck, or not of the body",
            unused(self.check.role),
        )

    def of_other_clock(self) -> Finding | None:
        """Changes that are the reference's at another time."""
        found = self.found
        is_near = found.scatter < LARGEST_SCATTER * self.sigma
        is_alike = is_near and found.misfit < FAR_MISFIT and not found.is_mirrored
        # turned about, a way there and back is its own beginning
        if (is_alike and found.gain.value > 0.0) or self.check.is_sighting:
            return None
        lags = far_lags(found)
        if not lags:
            return None
        shifts = [shift_line(self.check.role, self.config, -lag.value) for lag in lags]
        return contradiction(
            f"{self.check.name} against {self.check.against}: delay",
            "it agrees at another time only: another clock, such as GPS time, 18 s before UTC, or TAI, 37 s?",
            "; or ".join(shifts),
            lags[0],
            "s",
        )

    def pauses(self) -> Finding | None:
        """No change for a part of the log, of a sensor that follows its reference else."""
        if not self.found.gain.value > HARDLY:
            return None
        found = self.found.in_time() if self.is_late else self.found
        times = pause_text(found, self.sigma, self.check.drift(self.sequence))
        if not times:
            return None
        return self.contradiction(
            f"it stands still {times}, unlike {self.check.against}: its last value is repeated",
            f"{unused(self.check.role)} leaves it out, --start and --end that time",
        )

    def jumps(self) -> Finding | None:
        """Steps; a wrong scale or delay shows in steps too where the motion has some."""
        is_right = abs(self.found.gain.value - 1.0) < STEP_GAIN_ERROR
        ratio = 1.0 if is_right and not self.is_late else STEP_RATIO
        unit = self.check.step_unit
        # a turn that begins later is no step
        found = self.found.in_time() if self.is_late else self.found
        steps = unit and step_text(found, self.sigma, unit, ratio)
        if not steps:
            return None
        return self.contradiction(
            f"it jumps against {self.check.against}, {steps}",
            f"{unused(self.check.role)} leaves it out",
        )

    def opposite(self) -> Finding | None:
        """Another sense, of a sensor that agrees with its reference otherwise."""
        found = self.found
        gain = found.gain
        is_opposite = gain.is_known and gain.value + ACTING_SIGMAS * gain.sigma < 0
        if not (is_opposite or found.is_mirrored) or found.misfit >= MOST_MISFIT:
            return None
        sense = self.check.sense(self.sequence, self.config)
        return self.contradiction(sense.cause, sense.line)

    def of_cause(self) -> Finding | None:
        """A cause of the check's own; only where it fits better than a gain that is a unit, or the gyros' scale."""
        has_gain = self.units or self.check.is_angle
        most = 1 / AS_GOOD if has_gain else AS_GOOD
        known = self.sequence.calibration
        return cause_of(self.check.name, self.check.causes, self.found, known, most)

    def other_unit(self) -> Finding | None:
        """A gain that is surely far from 1 of a sensor that agrees with its reference otherwise."""
        check = self.check
        found = self.found
        size = self.size
        most = SLIPPING_UNIT if self.slips else OTHER_UNIT
        is_sure = matters(replace(found.gain, value=size - 1.0), 0.0)
        if not is_sure or 1 / most < size < most or found.misfit > MOST_MISFIT:
            return None
        units = self.units
        # a gain that may be none is no unit
        if not units and not matters(found.gain, 0.0):
            return None
        if not units and size < 1 and self.is_late:
            return self.contradiction(
                f"it follows {check.against} {found.lag.value:.2g} s late and {size:.2g} times as far: smoothed by the "
                "sensor or its driver",
                unused(check.role),
            )
        unit = units[0] if units else ANOTHER_UNIT
        times = 1.0 / check.units.get(unit, 1.0 / size)
        line = check.other_lines.get(unit)
        line = line or scale_line(check.role, check.scale_key, self.config, times)
        if check.is_angle:
            line += "; of an orientation, whose quaternion is wrong then, " + unused(
                check.role
            )
        return self.contradiction(
            f"it changes {size:.3g} times as much as by {check.against}: {' or '.join(units) or unit}?",
            line,
        )

    def unrelated(self) -> Finding | None:
        """Changes that have nothing to do with the reference."""
        check = self.check
        found = self.found
        # sightings that contradict the motion are wrong identities as a rule, which the estimators name
        if check.is_sighting or found.misfit < MOST_MISFIT:
            return None
        if found.scatter < LARGEST_SCATTER * self.sigma and not found.is_mirrored:
            return None
        return self.contradiction(
            f"{100 * found.misfit:.0f} % of its changes are not those by {check.against}, {found.scatter:.3g} apart "
            "typically: another sensor's values, or wrong axes?",
            f"{unused(check.role)} leaves it out",
        )

    def small_faults(self) -> Findings:
        """Scale and delay."""
        size = self.size
        gain = self.found.gain
        off = replace(gain, value=size - 1.0)
        error = abs(off.value) * self.check.reach(self.sequence, self.found)
        # a scale matters only where its error shows beside the noise of a row
        is_off = matters(off, self.check.least_scale)
        # another sense or unit has been named, where the changes fit one
        if is_off and not 1 / OTHER_UNIT < gain.value < OTHER_UNIT:
            reason = f"its few changes do not follow {self.check.against}"
            return [Finding(self.quantity, unknown(reason))]
        row = Finding(self.quantity, gain, cause=NO_NEED)
        if is_off and error > self.sigma and not self.slips:
            is_grave = abs(off.value) > self.check.grave_scale
            row = replace(
                row,
                cause=f"it changes {size:.3g} times as much",
                consequence=f"up to {error:.2g}",
                line=self.check.scaled(self.config, size),
                gravity=gravity_of(is_grave or self.is_grave(error)),
            )
        # wheels start to slip in turns: no delay of a sensor
        if not self.found.lag.is_known or self.slips:
            return [row]
        return [row, self.delay()]

    def is_grave(self, error: float) -> bool:
        """True where an error makes results doubtful."""
        return error > GRAVE_ERROR * self.sigma

    def delay(self) -> Finding:
        """Row for a delay of the sensor."""
        check = self.check
        lag = self.found.lag
        known = lag.limited(LARGEST_LAG_SIGMA_S, "too little changes in the motion")
        name = f"{check.name} against {check.against}: delay"
        row = Finding(name, known, "s", NO_NEED)
        error = abs(lag.value) * self.found.rate
        if not matters(known, check.least_lag_s) or error < self.sigma:
            return row
        late, early = ("late", "early") if lag.value > 0 else ("early", "late")
        # the gyros are the reference of angles
        of_imu = f", or those of the IMU too {early}" if check.is_angle else ""
        return replace(
            row,
            cause=f"its rows come too {late}{of_imu}",
            consequence=f"an error of {error:.2g} typically",
            line=shift_line(check.role, self.config, -lag.value),
            gravity=gravity_of(self.is_grave(error)),
        )


FAULTS = (
    SensorComparison.stuck,
    SensorComparison.pauses,
    SensorComparison.jumps,
    SensorComparison.of_other_clock,
    SensorComparison.opposite,
    SensorComparison.of_cause,
    SensorComparison.other_unit,
    SensorComparison.unrelated,
)
"""In the order in which they are looked for: each hides those after it."""


LEAST_BIAS_S = 30.0
LARGEST_BIAS_RAD_S = 0.2
"""No gyro that works has such a bias."""


def vertical_bias(
    sequence: Sequence,
    motion: BodyMotion,
    of_axes: Estimates3D | None = None,
) -> Finding | None:
    """Bias of the gyros about the vertical, by a heading or by true orientations; None without either.

    ``of_axes``: bias along the axes of the body by the drive or a rest, whose level part enters the line, and whose
    vertical part shows whether the heading drifts instead.

    The slope over time of the gyros' turn, less the bias that is known, less the heading.
    """
    truth = sequence.true_poses
    if sequence.heading is not None:
        source = "the heading"
        stamps_ns = sequence.heading.stamps_ns
        yaw_rad = unwrapped(sequence.heading.yaw_rad)
    elif truth is not None and len(truth) > 1:
        source = "the true orientations"
        stamps_ns = truth.stamps_ns
        yaw_rad = np.unwrap(truth.rotations().as_euler("ZYX")[:, 0])
    else:
        return None
    bias = unknown(f"too little time beside {source}")
    t = motion.since_origin(stamps_ns)
    drift_rad = motion.turned(t) - yaw_rad
    # against time itself, whose gain is the rate
    rows = motion.stretches(t, drift_rad, lambda seconds: seconds)
    duration_s = sum(float(np.ptp(part.seconds)) for part in rows)
    if rows and duration_s > LEAST_BIAS_S:
        found = match(rows, lags_s=NO_LAG)
        # a slow wave of the heading looks like a bias: as if all of its scatter were one in each stretch
        slope = 2.0 * found.scatter * np.sqrt(len(rows)) / duration_s
        bias = replace(found.gain, sigma=max(found.gain.sigma, slope, 1e-9))
    imu = sequence.calibration.imu
    allowed = imu.gyro_bias_sigma
    if not matters(bias, LEAST_BIAS_RAD_S, allowed):
        cause = f"by {source}; the calibration's sigma of {allowed:.2g} allows it, {NO_NEED}"
        return Finding(VERTICAL_BIAS, bias, "rad/s", cause)
    up = np.median(motion.up, axis=0)
    up = up / np.linalg.norm(up)
    turned_rad = abs(bias.value) * sequence.duration_s
    axes = of_axes or (unknown("not compared"),) * 3
    known = known_values(axes)
    # the line is in the axes of the IMU
    body_R_imu = imu.mounting.rotation_matrix()
    more_rad_s = known - (known @ up) * up + bias.value * up
    whole = np.add(imu.gyro_bias_rad_s, more_rad_s @ body_R_imu)
    row = Finding(
        VERTICAL_BIAS,
        bias,
        "rad/s",
        cause=f"by {source}, {np.degrees(bias.value):.3g}°/s beyond the calibration's sigma of {allowed:.2g}",
        consequence=f"a turn of {np.degrees(turned_rad):.3g}° over the log",
        line=f"`imu.gyro_bias_rad_s = {numbers(whole, 5)}` {IN_CALIBRATION}",
        gravity=gravity_of(turned_rad > LARGE_TURN_RAD),
    )
    # the truth drifts from nothing
    if sequence.heading is None:
        return row
    apart = bias.minus(float(known @ up))
    cause = "it turns otherwise than the gyros, whose bias is known: a compass that drifts, or is disturbed"
    if abs(bias.value) > LARGEST_BIAS_RAD_S:
        cause = "it turns otherwise than the gyros, by more than any bias of theirs: degrees that are read as radians?"
    elif not all(one.is_known for one in axes) or not matters(
        apart,
        LEAST_BIAS_RAD_S,
        float(np.linalg.norm([one.sigma for one in axes] * up)),
    ):
        return row
    return replace(
        row,
        quantity=f"{HEADING.name}: drift",
        estimate=replace(apart, value=-apart.value),
        cause=cause,
        line=unused(HEADING.role),
    )


LEAST_EXCURSION_RAD = np.radians(10.0)
EXCURSION_SIGMAS = 3.0
HIGHEST_M = 1.0
"""Height above the surface that waves and the weather give a pressure sensor there."""
LEAST_FROM_START_M = 0.1
"""Difference between the height of a start and that of the first depths, beyond their sigmas, that is told."""
FARTHEST_FROM_START_M = 0.5
"""The same that waves and a rough start make: beyond it results are doubtful."""
FIRST_ROWS = 5
ATMOSPHERE_M = 10.1
"""Water that weighs as much as the air."""
ATMOSPHERE_SHARE = 0.05


def first_rows(stamps_ns: Ints, start_ns: int) -> slice:
    """Rows of a sensor at the start."""
    first = max(int(np.searchsorted(stamps_ns, start_ns)) - 1, 0)
    return slice(first, first + FIRST_ROWS)


def fix_height_findings(sequence: Sequence, config: LogConfig) -> Iterator[Finding]:
    """Depths at another height than the position fixes: the fixes are wrong where the depths begin at a stated start."""
    depth = sequence.depth
    fixes = sequence.positions
    if depth is None or fixes is None:
        return
    has_height = fixes.are_sound() & ~are_unmeasured(fixes)[:, 2]
    if not has_height.any():
        return
    off = height_over(depth, fixes.rows(has_height), fix_sigma_m(sequence)[2])
    if off is None:
        return
    off_m = off.value
    of_fixes = origin_line(config, (0.0, 0.0, off_m), 2)
    if "log.origin" in sequence.notes:
        of_fixes = f"an `origin_deg_m` that is {off_m:+.2f} m higher, in geodetic under [positions] {IN_LOG_CONFIG}"
    cause = "another origin, sign or unit of the depths, or another height or scale of the fixes?"
    line = f"{unused('depth')} leaves the depths out; where they are right, {of_fixes}"
    if sequence.calibration.start.states():
        cause = "the depths begin at the stated start: only the heights of the fixes are wrong, of another origin or sign"
        line = of_fixes
    quantity = "depth: height of the position fixes over it"
    yield contradiction(quantity, cause, line, off, "m")


def height_over(
    depth: Depth, known: PositionFixes, sigma_m: float
) -> Estimate1D | None:
    """Typical height of positions over that of the depths, beyond doubt; None where they agree, or are few."""
    by_depth = np.interp(
        known.stamps_ns, depth.stamps_ns, depth.z_m, left=np.nan, right=np.nan
    )
    off = known.position_m[:, 2] - by_depth
    off = off[np.isfinite(off)]
    if len(off) < NEAR_START:
        return None
    off_m = float(np.median(off))
    sigma_m = max(sigma_m, float(np.median(np.abs(off - off_m))))
    if abs(off_m) <= FARTHEST_FROM_START_M + ACTING_SIGMAS * sigma_m:
        return None
    return Estimate1D(off_m, sigma_m)


def origin_line(config: LogConfig, off_m: ArrayLike, digits: int) -> str:
    """Line that adds to a configured origin of the position fixes."""
    before = np.array(config.table("positions").get("origin_m", np.zeros(3)), float)
    return f"`origin_m = {numbers(before + off_m, digits)}` under [positions] {IN_LOG_CONFIG}"


def start_depth_findings(sequence: Sequence) -> Iterator[Finding]:
    """First depths at another height than a stated start, or above z = 0 where none is stated; nothing where they fit."""
    depth = sequence.depth
    if depth is None:
        return
    start = sequence.calibration.start
    rows_m = depth.z_m[first_rows(depth.stamps_ns, sequence.start_ns)]
    height_m = float(np.median(rows_m))
    if not start.states("position_m"):
        # a map has heights of its own
        if height_m > HIGHEST_M and sequence.calibration.map is None:
            yield above_water(height_m, sequence.calibration.depth.sigma_m)
        return
    sensor = sequence.calibration.depth
    port = np.array(sensor.port_m)
    off_m = height_m - float(start.pose().transformFrom(port)[2])
    sigma_m = np.hypot(start.position_sigma_m[2], sensor.sigma_m)
    climbed_m = float(np.ptp(rows_m))
    beyond_m = abs(off_m) - climbed_m - ACTING_SIGMAS * sigma_m
    if beyond_m <= LEAST_FROM_START_M:
        return
    x, y, z = start.position_m
    of_air = ""
    if abs(abs(off_m) - ATMOSPHERE_M) < ATMOSPHERE_SHARE * ATMOSPHERE_M:
        of_air = (
            f"`atmosphere_pa = 0` under [depth] {IN_LOG_CONFIG} where pressures are counted from the surface, since so "
            "much water weighs as much as the air; "
        )
    is_far = beyond_m > FARTHEST_FROM_START_M
    right = f"`start.position_m = {numbers((x, y, z + off_m), 2)}` {IN_CALIBRATION} where the depths are right"
    use = f"{unused('depth')} leaves the depths out, scale = -1 there is for depths downwards"
    row = contradiction(
        "depth: distance from the start",
        cause=f"the height begins at {height_m:.2f} m, the start of the calibration is at {height_m - off_m:.2f} m: an "
        "altimeter, another sign, unit or origin, or a wrong start?",
        line=f"{of_air}{use}; {right}" if is_far else right,
        estimate=Estimate1D(off_m, sensor.sigma_m),
        unit="m",
    )
    # a rough start, as long as the depths lead the estimators back
    yield replace(row, gravity=gravity_of(is_far))


def above_water(height_m: float, sigma_m: float) -> Finding:
    """Depths above z = 0, on a log whose owner states no start."""
    return Finding(
        "depth: height above z = 0",
        Estimate1D(height_m, sigma_m),
        "m",
        "the vehicle would begin above the water: an altimeter, depths positive downwards, or a world whose z = 0 lies "
        "below the surface?",
        line=f"{unused('depth')} leaves an altimeter out, scale = -1 there is for depths downwards; where the heights are "
        f"right, state the start: `start.position_m = {numbers((0.0, 0.0, height_m), 2)}` {IN_CALIBRATION}",
        gravity=Gravity.ACT,
    )


def heading_findings(
    found: Match | None, right: Sequence, config: LogConfig, motion: BodyMotion
) -> Iterator[Finding]:
    """Sense, scale and delay of the heading; where right, the angle by which it is off the world of the positions."""
    if found is None:
        return
    rows = findings_of(HEADING, found, right, config)
    yield from rows
    if rows[0].grave:
        return
    bias_sigma_rad = right.calibration.heading.bias_sigma_rad
    least_rad = max(LEAST_EXCURSION_RAD, EXCURSION_SIGMAS * bias_sigma_rad)
    is_late = matters(found.lag, HEADING.least_lag_s)
    if left := excursion(found.in_time() if is_late else found, least_rad):
        yield contradiction(
            "heading: excursion from that by the gyros",
            f"it leaves them {left} and comes back: a compass near iron, or an outage of its source",
            f"{unused('heading')} leaves it out, --start and --end that time",
            "disturbed",
        )
    yield from heading_turn(right, config, motion)


def start_heading_findings(right: Sequence, motion: BodyMotion) -> Iterator[Finding]:
    """First headings that differ from a stated start; nothing where they agree, or no start is stated."""
    heading = right.heading
    start = right.calibration.start
    if heading is None or not start.states("rpy_rad"):
        return
    rows = first_rows(heading.stamps_ns, right.start_ns)
    t = motion.since_origin(heading.stamps_ns[rows])
    turned = motion.turned(t) - motion.yaw_rad[0]
    off = wrap_angle(heading.yaw_rad[rows] - turned - start.rpy_rad[2])
    off = off[np.isfinite(off)]
    calibration = right.calibration.heading
    sigma = np.hypot(calibration.sigma_rad, calibration.bias_sigma_rad)
    sigma = np.hypot(sigma, start.rpy_sigma_rad[2])
    error = Estimate1D(float(np.median(off)) if len(off) else 0.0, sigma)
    if not matters(error, LARGE_TURN_RAD):
        return
    yield contradiction(
        "heading: turn from that of the start",
        "another north, sense or unit of the headings, or a wrong start?",
        f"`world` and `yaw_offset_rad` under [heading] {IN_LOG_CONFIG}, or `start.rpy_rad` {IN_CALIBRATION}",
        in_degrees(error),
        "°",
    )


def heading_turn(
    right: Sequence, config: LogConfig, motion: BodyMotion
) -> Iterator[Finding]:
    """Angle from the path by heading and Doppler log to that of the positions; nothing without positions."""
    known = right.positions or right.truth
    if known is None or right.heading is None:
        return
    angle = course_angle(known, right.heading.yaw_rad, right, motion)
    allowed = right.calibration.heading.bias_sigma_rad
    row = Finding(
        HEADING_TURN,
        in_degrees(angle),
        "°",
        f"the calibration's bias sigma of {allowed:.2g} rad allows it, {NO_NEED}",
    )
    if not matters(angle, 0.0, allowed):
        yield row
        return
    # on a way without turns the sense shows only here
    clockwise_rad = np.pi / 2 - right.heading.yaw_rad
    other = course_angle(known, clockwise_rad, right, motion)
    sense = of_sense = ""
    if other.is_known and not matters(other, 0.0, allowed):
        sense = "clockwise from north, or "
        of_sense = f"{other_world(config, 'heading')}; or "
    offset = config.number("heading", "yaw_offset_rad", 0.0) + angle.value
    turn_rad = (0.0, 0.0, angle.value)
    rpy = turned_mounting(right.calibration.dvl.mounting, turn_rad)
    vertical = vertical_bias(right, motion)
    is_biased = vertical is not None and vertical.acts
    first = "once the gyro bias is put right, which comes first, " if is_biased else ""
    sigma = np.hypot(right.calibration.heading.sigma_rad, allowed)
    large_rad = min(LARGE_TURN_RAD, GRAVE_ERROR * sigma)
    starts_so = right.calibration.start.states("rpy_rad") and not any(
        start_heading_findings(right, motion)
    )
    of_known = f"{unused('positions')}, whose world is turned"
    if right.positions is None:
        of_known = "read the aligned errors, since the truth's world is turned"
    of_known = f"; or {of_known}: the stated start agrees with the heading"
    yield replace(
        row,
        cause=f"{first}{sense}either its world, north or mounting is another",
        line=f"{of_sense}`yaw_offset_rad = {offset:.3f}` under [heading] {IN_LOG_CONFIG}{of_known if starts_so else ''}"
        f"{OR_DVL} is turned on the vehicle: `dvl.mounting.rpy_rad = {numbers(rpy, 4)}` {IN_CALIBRATION}",
        gravity=gravity_of(abs(angle.value) > large_rad),
    )


def course_angle(
    known: PositionFixes | Trajectory,
    yaw_rad: Floats,
    right: Sequence,
    motion: BodyMotion,
) -> Estimate1D:
    """Angle from the way of the Doppler log, laid along headings, shape (n,), to that of known positions, rad."""
    assert right.heading is not None
    places = known.position_m if isinstance(known, PositionFixes) else known.positions
    heading_s = motion.since_origin(right.heading.stamps_ns)
    yaw_rad = np.interp(motion.seconds, heading_s, unwrapped(yaw_rad))
    steps = np.diff(motion.path_m) * np.exp(1j * (yaw_rad - motion.yaw_rad))[1:]
    path = np.append(0.0, np.cumsum(steps))
    t = motion.since_origin(known.stamps_ns)
    level = places @ [1.0, 1j, 0.0]
    turn = match(motion.stretches(t, level, motion.reference(path)), lags_s=NO_LAG)
    reason = "too little motion beside positions"
    # north and east exchanged are a fault of the positions; a way that fits badly has no direction
    is_way = not turn.is_mirrored and turn.misfit < MOST_MISFIT
    if not (is_way and 0.5 < turn.gain.value < 2.0):
        return unknown(reason)
    return turn.angle.limited(LARGEST_HEADING_SIGMA_RAD, reason)


HIGH_PERCENTILE = 95.0
JUMP_NS = 20 * NS_PER_S
JUMP_GATE = chi_square_quantile(1 - 1e-4, 3)
LARGEST_JUMPING_SHARE = 0.2
"""Of the fixes; single outliers are what a robust kernel is for."""
FEWEST_JUMPS = 6
LEAST_WAY_M = 0.1
"""Way by the Doppler log against which a jump's size is told."""
NEAR_START = 6
"""Number of fixes about the start whose median is compared with it."""
SEEN_WITHIN_S = 60.0
"""Time after the start in which gyros do not turn the path."""
FARTHEST_ORIGIN_M = 1e5
"""No vehicle of a run goes so far; coordinates of a map grid begin beyond."""


def way_m(right: Sequence, at_ns: np.ndarray) -> np.ndarray:
    """Way by the Doppler log until each instant, shape (n,), in a gap at the log's high speed."""
    stamps_ns = right.dvl.stamps_ns
    speed = np.linalg.norm(right.dvl.velocity, axis=1)
    steps_s = np.diff(stamps_ns) / NS_PER_S
    mean_speed = (speed[1:] + speed[:-1]) / 2
    # nothing is known of a gap but how fast the vehicle goes elsewhere
    is_gap = steps_s > right.calibration.dvl.gap_s
    mean_speed[is_gap] = np.percentile(speed, HIGH_PERCENTILE)
    return np.interp(at_ns, stamps_ns, np.append(0.0, np.cumsum(mean_speed * steps_s)))


def jump_finding(right: Sequence, fixes: PositionFixes) -> Finding | None:
    """Fixes from which, often, the one `JUMP_NS` later is farther than the Doppler log moves; None where few are.

    With l the way by the Doppler log, a displacement Δ of length d is beyond it by ``e = Δ (1 - l / d)``, and is no
    noise of the two fixes where ``eᵀ (C_i + C_j)⁻¹ e`` is above `JUMP_GATE`.
    """
    fixes = fixes.rows(fixes.are_sound())
    t = fixes.stamps_ns
    dvl_ns = right.dvl.stamps_ns
    later = np.searchsorted(t, t + JUMP_NS)
    i = np.flatnonzero((later < len(t)) & (t >= dvl_ns[0]))
    i = i[t[later[i]] <= dvl_ns[-1]]
    j = later[i]
    at_fixes_m = way_m(right, t)
    way = at_fixes_m[j] - at_fixes_m[i]
    moved = fixes.position_m[j] - fixes.position_m[i]
    length = np.maximum(np.linalg.norm(moved, axis=1), 1e-9)
    beyond = moved * np.maximum(0.0, 1 - way / length)[:, None]
    noise = np.diag(np.square(right.calibration.positions.sigma_m))
    cov_m2 = np.where(np.isnan(fixes.covariance_m2), noise, fixes.covariance_m2)
    normalised = np.linalg.solve(cov_m2[i] + cov_m2[j], beyond[:, :, None])[:, :, 0]
    jumps = np.sum(beyond * normalised, axis=1) > JUMP_GATE
    if np.count_nonzero(jumps) < FEWEST_JUMPS:
        return None
    share = float(np.mean(jumps))
    if share <= LARGEST_JUMPING_SHARE:
        return None
    times = np.median(length[jumps] / np.maximum(way[jumps], LEAST_WAY_M))
    sigma = np.sqrt(share * (1 - share) / len(jumps))
    return contradiction(
        "position fixes: jumps",
        cause=f"fixes {JUMP_NS / NS_PER_S:.0f} s apart move {times:.3g} times as much as the vehicle by its Doppler "
        "log, beyond their noise: worse than stated, angles, another scale, or of another thing?",
        line=f"a larger `positions.sigma_m` {IN_CALIBRATION} where they are worse; {unused('positions')} leaves them "
        "out",
        estimate=Estimate1D(100 * share, 100 * sigma),
        unit="%",
    )


def position_findings(
    found: Match | None, right: Sequence, config: LogConfig, motion: BodyMotion
) -> Iterator[Finding]:
    """Unit and delay of the position fixes, jumps that no vehicle makes, and their distance from start or origin."""
    fixes = right.positions
    if fixes is None or found is None:
        return
    rows = findings_of(POSITIONS, found, right, config)
    # changes that the path does not explain may be jumps, which are a better name
    if rows[0].grave and "%" not in rows[0].advice:
        yield rows[0]
        return
    # of another scale, fixes move farther than the vehicle too
    is_scaled = rows[0].acts and not rows[0].grave
    if not is_scaled and (jumps := jump_finding(right, fixes)):
        yield jumps
        return
    if rows[0].estimate.reason.startswith("too few"):
        yield from rows
        return
    distance = distance_finding(right, fixes, motion, config)
    # a scale moves fixes away from the start as well
    if rows[0].acts and distance.acts:
        yield replace(rows[0], gravity=Gravity.GRAVE)
        return
    yield from rows
    yield distance


def led_to_fixes(
    right: Sequence, fixes: PositionFixes, motion: BodyMotion
) -> tuple[Floats, float] | None:
    """Median offset of the fixes of a minute from the path that leads to them from the start, shape (3,), and its sigma, m.

    None where the owner does not state the start's place and heading, or fixes are too few.
    """
    start = right.calibration.start
    if not start.states("position_m", "rpy_rad"):
        return None
    if any(start_heading_findings(right, motion)):
        return None
    begin_s = float(motion.since_origin(np.array([right.start_ns]))[0])
    t = motion.since_origin(fixes.stamps_ns)
    path = motion.path_m * np.exp(1j * start.rpy_rad[2])
    moved = motion.reference(path)(t)
    inside = np.isfinite(moved) & (motion.part_at(t) == 0)
    inside &= (t >= begin_s) & (t <= begin_s + SEEN_WITHIN_S) & is_level_fix(fixes)
    if np.count_nonzero(inside) < NEAR_START:
        return None
    x, y, _ = start.position_m
    moved = moved[inside]
    off = fixes.position_m[inside] @ [1.0, 1j, 0.0] - (x + 1j * y) - moved
    median_off = np.array([np.median(off.real), np.median(off.imag), 0.0])
    parts = (
        level_sigma_m(fix_sigma_m(right)) / 2,
        level_sigma_m(start.position_sigma_m),
        float(np.median(np.abs(moved))) * start.rpy_sigma_rad[2],
        np.hypot(*right.calibration.positions.antenna_m[:2]),
    )
    return median_off, float(np.linalg.norm(parts))


def distance_finding(
    right: Sequence, fixes: PositionFixes, motion: BodyMotion, config: LogConfig
) -> Finding:
    """Distance of the first fixes from the start, and whether they begin far from it or from the world's origin.

    From a start with a stated heading the path leads to the fixes of a minute; else the way to the first ones is allowed.
    """
    start = right.calibration.start
    noise_m = level_sigma_m(fix_sigma_m(right))
    start_m = level_sigma_m(start.position_sigma_m)
    order = np.argsort(np.abs(fixes.stamps_ns - right.start_ns))[:NEAR_START]
    near = np.median(fixes.position_m[order], axis=0)
    off = near - start.position_m
    from_origin_m = np.hypot(*near[:2])
    sigma_m = np.hypot(noise_m, start_m)
    # how far the vehicle can be from the start by then
    reach_m = float(way_m(right, fixes.stamps_ns[order]).max())
    if led := led_to_fixes(right, fixes, motion):
        off, sigma_m = led
        reach_m = FARTHEST_FROM_START_M
    from_start_m = np.hypot(*off[:2])
    quantity = "position fixes: distance from the start"
    row = Finding(quantity, Estimate1D(from_start_m, sigma_m), "m", NO_NEED)
    if from_start_m > 5.0 * sigma_m + reach_m:
        place = f"{from_start_m:.3g} m from the start"
        more = "moves them to the start; or state another start"
    elif from_origin_m > FARTHEST_ORIGIN_M:
        place = f"{from_origin_m:.3g} m from the origin of the world"
        more = "moves the origin to the first; the start likewise"
        off = near
    else:
        return row
    return replace(
        row,
        cause=f"they begin {place}, beyond their noise and the way to them: a map grid (UTM), or another scale, place or "
        "start heading?",
        line=f"{origin_line(config, off, 1)} {more}",
        gravity=Gravity.GRAVE,
    )
