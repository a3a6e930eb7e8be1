"""A reference, a stated start or a known map that the sensors contradict.

True heights, orientations and level positions are compared with the motion as the vehicle's own sensors are, by the same
rows of the table of checks. A start is wrong where a `live` run came too late; a map is in another unit or has other axes
(`sonar_graph.navigation`).

Landmarks whose places are known, of a map or of the truth, place the start with a covariance (`map_start`).
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sonar_graph.calibration import Calibration, KnownMap
from sonar_graph.diagnosis.aiding_check import (
    ANOTHER_UNIT,
    DEPTH,
    FAULTS,
    HEADING,
    LENGTHS,
    POSITIONS,
    Check,
    SensorComparison,
    fix_match,
    height_over,
)
from sonar_graph.diagnosis.causes import Cause, cause_of, of_current_beside_scale
from sonar_graph.diagnosis.findings import (
    ACTING_SIGMAS,
    IN_CALIBRATION,
    IN_LOG_CONFIG,
    NO_NEED,
    Advice,
    Finding,
    Gravity,
    contradiction,
    in_degrees,
    numbers,
    other_world,
    unknown,
    unused,
)
from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.diagnosis.signals import (
    FEWEST_ROWS,
    LAGS_S,
    MOST_WILD,
    NO_LAG,
    Match,
    Values,
    are_wild,
    match,
)
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import NS_PER_S, Depth, Floats, Heading, PositionFixes
from sonar_graph.models import listed, named, wrap_angle
from sonar_graph.navigation import FoundStart, first_start, map_fit
from sonar_graph.navigation.alignment import Estimate1D
from sonar_graph.numerics import columns_at
from sonar_graph.sequence import Sequence
from sonar_graph.states import FIRST_ANONYMOUS_ID

FARTHEST_M = 0.5
"""Distance of a start from the truth that a rough survey of both makes."""
FARTHEST_RAD = 0.1
"""The same for its heading, with landmarks that are some metres away."""
STAMPS_S = 1.0
"""Error of the truth's stamps that is no error of the start."""
TRUE_SIGMA_M = 0.01
"""Of a place that counts as true."""

REFERENCE = "reference"
LEAST_INTERVAL_S = 0.1
"""A faster reference is thinned."""
LEAST_NOISE_M = 0.05
"""Of true positions, beside which the path of a Doppler log is not better."""
LEAST_ARM_M = 0.3
MOST_ARM_SCATTERS = 5.0
LEAST_TURN_RAD = np.radians(45.0)
"""Of a vehicle whose turns show an arm."""
LEAST_LATE_M = 0.3
LATE_S = 1.8
"""Delay from which on true positions show it better than true orientations."""
LARGEST_TILT_RAD = np.radians(20.0)
"""Of the reference's body against the vehicle's, which a rough mounting of markers has."""
UPSIDE_DOWN_RAD = np.radians(150.0)
WILD_SIGMAS = 10.0
DELAY = ": delay"
OWN_WORLD = "where the truth has a world of its own, as of a motion capture, read the aligned errors"
OR_PATH = "where the truth is right, the Doppler log or the gyros are wrong"
ORIENTATION_LINE = (
    "quaternions are x, y, z, w, of the body in the world, not of the world in the body; `orientation = false` under "
    f"[truth] {IN_LOG_CONFIG} leaves them out"
)


def as_sensors(sequence: Sequence) -> Sequence:
    """The sequence with true heights, headings and positions of the body's origin in place of the measured ones."""
    truth = sequence.truth
    assert truth is not None
    interval_s = float(np.median(np.diff(truth.stamps_ns))) / NS_PER_S
    every = max(1, round(LEAST_INTERVAL_S / max(interval_s, 1e-9)))
    truth = truth.rows(np.arange(0, len(truth), every))
    unknown_of_row = np.full(len(truth), np.nan)
    heading = None
    if truth.has_orientation:
        yaw_rad = truth.rotations().as_euler("ZYX")[:, 0]
        heading = Heading(truth.stamps_ns, yaw_rad, unknown_of_row)
    calibration = sequence.calibration
    at_origin = {
        "depth": calibration.depth.model_copy(update={"port_m": (0.0, 0.0, 0.0)}),
        "positions": calibration.positions.model_copy(
            update={"antenna_m": (0.0, 0.0, 0.0)}
        ),
    }
    return replace(
        sequence,
        calibration=calibration.model_copy(update=at_origin),
        truth=truth,
        depth=Depth(truth.stamps_ns, truth.positions[:, 2], unknown_of_row),
        heading=heading,
        positions=PositionFixes(
            truth.stamps_ns, truth.positions, np.full((len(truth), 3, 3), np.nan)
        ),
    )


def noise_of_positions_m(positions: Floats) -> float:
    """Noise of true positions, shape (n, 3), by second differences, those of white noise being sqrt(6) times as large."""
    bent = np.diff(positions, n=2, axis=0)
    if not len(bent):
        return 0.0
    return 1.4826 * float(np.median(np.abs(bent), axis=0).max()) / np.sqrt(6.0)


def reference_noise_m(as_sensed: Sequence) -> float:
    """Noise of true positions that take the place of position fixes."""
    assert as_sensed.positions is not None
    noise_m = noise_of_positions_m(as_sensed.positions.position_m)
    return max(noise_m, LEAST_NOISE_M)


def true_path_match(as_sensed: Sequence, motion: BodyMotion) -> Match | None:
    """True level positions by the path, beside the direction of the true heading where there is one."""
    found = fix_match(as_sensed, motion)
    heading = as_sensed.heading
    if found is None or heading is None:
        return found
    t_of_heading = motion.since_origin(heading.stamps_ns)
    yaw_rad = np.unwrap(heading.yaw_rad)

    def ahead(t: Floats) -> Values:
        """Level unit vectors, shape (n, 1)."""
        return np.exp(1j * np.interp(t, t_of_heading, yaw_rad))[:, None]

    # where the vehicle hardly turns an arm is an offset
    stretches = [
        replace(one, beside=ahead)
        for one in found.stretches
        if np.ptp(np.interp(one.seconds, t_of_heading, yaw_rad)) > LEAST_TURN_RAD
    ]
    return replace(found, stretches=tuple(stretches))


def arm_advice(q: Values, _: Calibration) -> Advice:
    """True positions that turn with the vehicle about another point."""
    # + 0.0 takes the sign off a zero
    ahead_m = round(float(q[0].real), 2) + 0.0
    left_m = round(float(q[0].imag), 2) + 0.0
    return Advice(
        f"it is of a point {ahead_m:+.2f} m ahead and {left_m:+.2f} m to the left of the body's origin, such as that of the "
        "markers: all errors have this arm",
        f"give poses of the body's origin; or take {numbers((ahead_m, left_m), 2)} off each `translation_m` "
        f"{IN_CALIBRATION}, and the origin is that point",
    )


ARM = Cause(
    "arm",
    "m",
    # a turn of the world looks like an arm where the way does
    of_current_beside_scale,
    wanted=1,
    least=lambda _: LEAST_ARM_M,
    advice=arm_advice,
)
PATH = replace(
    POSITIONS,
    name=REFERENCE,
    role="truth",
    quantity="reference: path over that by gyros and Doppler log",
    compare=true_path_match,
    sigma=reference_noise_m,
    slow_sigma=reference_noise_m,
    units=LENGTHS,
    other_lines={},
    sense=lambda _, config: Advice(
        "it is its mirror image: north, east, down instead of east, north, up; all errors are of that",
        f'{other_world(config, "truth")}, and `rotation = "frd"` where its orientations are of a body with z down; or the '
        "fields of position in another order",
    ),
)
HEIGHT = replace(
    DEPTH,
    name="heights of the reference",
    role="truth",
    quantity="reference: height over that by the Doppler log",
    sigma=reference_noise_m,
    units=LENGTHS,
    sense=lambda *_: Advice("its z points down", "turn the sign of its z"),
    causes=(),
)
ORIENTATION = replace(
    HEADING,
    name="orientations of the reference",
    role="truth",
    quantity="reference: turn over that of the gyros",
    sense=lambda _, config: Advice(
        "they turn against the gyros",
        f"{other_world(config, 'truth')}; or {ORIENTATION_LINE}",
    ),
    causes=(),
)


def reference_faults(sequence: Sequence, config: LogConfig) -> Iterator[Finding]:
    """What of a reference contradicts the sensors beyond doubt, and an arm or delay of its positions; nothing if right."""
    motion = BodyMotion.of(sequence)
    if motion is None or sequence.truth is None or len(sequence.truth) < FEWEST_ROWS:
        return
    as_sensed = as_sensors(sequence)
    yield from wild_positions(sequence.truth.positions)
    path = compared_with(PATH, as_sensed, motion, config)
    of_path = faults_of(path)
    yield from of_path
    # at another time nothing else can be compared
    if any(fault.quantity.endswith(DELAY) for fault in of_path):
        return
    turned = compared_with(ORIENTATION, as_sensed, motion, config)
    of_turn = faults_of(turned)
    # a tilt of what does not turn with the vehicle is no tilt
    yield from of_turn or tilted_reference(as_sensed, motion)
    if of_path or of_turn:
        return
    if path is not None:
        yield from arm_or_delay(path, turned)
    height = compared_with(HEIGHT, as_sensed, motion, config)
    yield from faults_of(height) or true_height(sequence, as_sensed)


def compared_with(
    check: Check, as_sensed: Sequence, motion: BodyMotion, config: LogConfig
) -> SensorComparison | None:
    """True values compared with the motion; None without them, or where the vehicle moves too little."""
    found = check.compare(as_sensed, motion)
    sigma = check.sigma(as_sensed)
    if found is None or not found.gain.is_known or found.moved <= sigma:
        return None
    slow = check.slow_sigma(as_sensed) / found.moved
    found = found.less_certain(slow)
    return SensorComparison(check, check.quantity, found, sigma, as_sensed, config)


def faults_of(one: SensorComparison | None) -> list[Finding]:
    """The first of the faults that hide each other; nothing without any."""
    if one is None:
        return []
    is_path = one.check is PATH
    # only a path shows another time, since ways there and back turn alike
    finds = [
        find
        for find in FAULTS
        if is_path or find is not SensorComparison.of_other_clock
    ]
    # beside a path that a current takes away a right truth looks stuck
    fault = (is_path and one.of_cause()) or next(
        filter(None, (find(one) for find in finds)), None
    )
    if not fault:
        return []
    is_open = fault.line.startswith(unused("truth")) or ANOTHER_UNIT in fault.cause
    if is_open and one.check is ORIENTATION:
        return [replace(fault, line=ORIENTATION_LINE)]
    if is_open and is_path:
        return [replace(fault, line=f"{fault.line}; {OR_PATH}")]
    return [fault]


def arm_or_delay(
    path: SensorComparison, turned: SensorComparison | None
) -> Iterator[Finding]:
    """A reference of another point, or whose stamps are late; at an even speed only orientations tell them apart."""
    if turned is not None and turned.found.lag.is_known and not turned.is_late:
        arm = cause_of(REFERENCE, (ARM,), path.found, path.sequence.calibration)
        # an arm that is there leaves as much between the positions and the path in time
        apart_m = match(list(path.found.stretches), lags_s=NO_LAG).scatter
        if arm and arm.estimate.value < MOST_ARM_SCATTERS * apart_m:
            yield arm
        return
    late = replace(path, sigma=max(path.sigma, LEAST_LATE_M)).delay()
    delay_s = abs(late.estimate.value)
    # at the end of the lags that are tried it is none
    is_found = late.acts and delay_s < LAGS_S[-1]
    # to two seconds orientations show it better
    if is_found and (turned is None or delay_s > LATE_S):
        yield replace(
            late,
            cause=f"{late.cause}, or it is of another point than the body's origin",
        )


def wild_positions(positions: Floats) -> Iterator[Finding]:
    """Single true positions, shape (n, 3), far from those before and after."""
    is_wild = are_wild(
        positions, WILD_SIGMAS * max(noise_of_positions_m(positions), LEAST_NOISE_M)
    )
    if not is_wild.any() or is_wild.mean() > MOST_WILD:
        return
    rows = np.arange(len(positions), dtype=np.float64)
    between = columns_at(rows[is_wild], rows[~is_wild], positions[~is_wild])
    off_m = np.linalg.norm(positions[is_wild] - between, axis=1)
    yield contradiction(
        "reference: wild positions",
        f"{len(off_m)} of {len(positions)} are up to {off_m.max():.3g} m from those before and after: the errors there are "
        "the reference's",
        "leave these rows out of it",
        "not of the vehicle",
    )


def tilted_reference(as_sensed: Sequence, motion: BodyMotion) -> Iterator[Finding]:
    """True orientations whose up is not that of the vehicle."""
    poses = as_sensed.true_poses
    if poses is None or motion.felt is None:
        return
    true_up = poses.rotations().inv().apply([0.0, 0.0, 1.0])  # (n, 3)
    t = motion.since_origin(poses.stamps_ns)
    felt_up = columns_at(t, motion.seconds, motion.up)
    felt_up /= np.maximum(np.linalg.norm(felt_up, axis=1), 1e-9)[:, None]
    cosine = np.sum(true_up * felt_up, axis=1)
    tilt_rad = float(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))
    if tilt_rad <= LARGEST_TILT_RAD:
        return
    cause = f"its body is tilted by {np.degrees(tilt_rad):.0f}° against the vehicle, by the accelerometers"
    line = ORIENTATION_LINE
    if tilt_rad > UPSIDE_DOWN_RAD:
        cause += ": a body with z down?"
        line = f'`rotation = "frd"` under [truth] {IN_LOG_CONFIG}'
    yield contradiction("reference: tilt", cause, line, "not of the vehicle")


def true_height(sequence: Sequence, as_sensed: Sequence) -> Iterator[Finding]:
    """A reference at another height than the depths."""
    known = as_sensed.positions
    if sequence.depth is None or known is None:
        return
    off = height_over(sequence.depth, known, reference_noise_m(as_sensed))
    if off is None:
        return
    yield contradiction(
        "reference: height over the depths",
        "another origin or sign of either: raw errors are of that",
        f"turn the sign of its z, or add {-off.value:+.2f} m to it; where the depths are wrong, {unused('depth')}; "
        f"{OWN_WORLD}",
        off,
        "m",
    )


def start_place_findings(right: Sequence, motion: BodyMotion) -> Iterator[Finding]:
    """Distance of a stated start from the truth or, without one, of the first landmarks from their true places."""
    if not right.calibration.start.states("position_m"):
        return
    by_truth = truth_finding(right, motion)
    if by_truth is not None:
        yield by_truth
        return
    true = right.true_landmarks
    if true is None or right.detections is None or not len(true):
        return
    # true places are a map without errors
    known = KnownMap.of(true.ids.tolist(), true.positions, sigma_m=TRUE_SIGMA_M)
    found = first_start(right, known)
    if found is not None:
        yield from stated_start_findings(right, found, "of the truth")


def map_findings(right: Sequence) -> Iterator[Finding]:
    """What is wrong with the known map, or with a stated start in it."""
    known = right.calibration.map
    if known is None or right.detections is None:
        return
    seen = set(right.detections.most_probable()[0].tolist())
    identities = {i for i in seen if 0 <= i < FIRST_ANONYMOUS_ID}
    # landmarks that were never named could be any of the map
    if identities and identities.isdisjoint(known.ids):
        yield contradiction(
            "map: identities",
            f"none of the map's identities {listed(known.ids)} was seen; seen: {listed(identities)}",
            "give the map of this place, with the identities of the log",
            "none in common",
        )
        return
    # a map in another unit or sense fits nowhere: such mistakes are looked for first
    fit = map_fit(right)
    if not fit.is_checked:
        why = "fewer than three of its landmarks are seen"
        yield Finding("map: axes, unit and sense", unknown(why))
    if fit.mistake:
        yield contradiction(
            "map: places",
            f"the sightings contradict the map: {fit.mistake}",
            fit.remedy,
            "the sightings do not fit it",
        )
        return
    if fit.is_checked and fit.start is None:
        yield Finding(
            "map: places",
            unknown("they fit nowhere"),
            cause="the sightings give no single place in it: a map of another place, or landmarks moved, or stand in a row",
            line="give the map of this place, or none",
            gravity=Gravity.ACT,
        )
    if fit.start is not None:
        sigma = np.sqrt(fit.start.covariance[0, 0])
        turn = Estimate1D(wrap_angle(fit.start.parameters[0]), sigma)
        agreeing = [known.ids[row] for row in fit.start.agreeing]
        fits = f"the sightings of landmarks {listed(agreeing)} fit the map, {NO_NEED}"
        if others := identities.difference(known.ids):
            fits += f"; not in it: {listed(others)}"
        yield Finding("map: yaw of the start in it", in_degrees(turn), "°", fits)
    if fit.rise_m:
        aperture_deg = np.degrees(right.calibration.sonar.elevation_aperture_rad)
        yield Finding(
            "map: heights",
            unknown("another zero, or another sonar"),
            cause=f"most landmarks are not within the sonar's vertical aperture of {aperture_deg:.0f}° at their heights "
            "in the map: these count from another zero than the depth, or the sonar's tilt or aperture is wrong",
            line=f"add {fit.rise_m:+.1f} m to each z_m of the map; or give `rpy_rad` under [sonar.mounting] or "
            f"`elevation_aperture_rad` under [sonar] {IN_CALIBRATION}",
            gravity=Gravity.ACT,
        )
    if fit.elsewhere:
        yield Finding(
            "map: landmarks elsewhere",
            unknown("they moved"),
            cause=f"{named(fit.elsewhere)}: seen several times in another place than the map has: moved, wrong lines of "
            "the survey, or heights from another zero",
            line="correct these lines of the map, or leave them out",
            gravity=Gravity.ACT,
        )
    if fit.start is not None and right.calibration.start.source != "map":
        yield from stated_start_findings(right, fit.start, "of the map")


def stated_start_findings(
    right: Sequence, found: FoundStart, whose: str
) -> Iterator[Finding]:
    """A stated start that is elsewhere than landmarks have it; nothing where both agree by their covariances."""
    start = right.calibration.start
    yaw, x, y = found.parameters.tolist()
    stated_x, stated_y, _ = start.position_m
    turn_rad = wrap_angle(yaw - start.rpy_rad[2])
    off = np.array([turn_rad, x - stated_x, y - stated_y])
    sigmas = [start.rpy_sigma_rad[2], *start.position_sigma_m[:2]]
    # Mahalanobis distance, with the uncertainty of both poses
    P = found.covariance + np.diag(np.square(sigmas))
    is_near = np.hypot(*off[1:]) <= FARTHEST_M and abs(off[0]) <= FARTHEST_RAD
    if is_near or float(off @ np.linalg.solve(P, off)) <= ACTING_SIGMAS**2:
        return
    yield contradiction(
        "start pose",
        estimate="the landmarks have it elsewhere",
        cause=f"landmarks {whose} place it at ({x:.2f}, {y:.2f}) m with a yaw of {wrap_angle(yaw):.3f} rad, not at "
        f"({stated_x:.2f}, {stated_y:.2f}) m with {start.rpy_rad[2]:.3f} rad: another start, a log that is joined after its "
        "beginning, or landmarks of another frame?",
        line=f'`start.source = "map"` with a map, or `start.position_m` and `start.rpy_rad`, {IN_CALIBRATION}',
    )


FROM_TRUTH = "start position: distance from the truth"


def truth_finding(right: Sequence, motion: BodyMotion) -> Finding | None:
    """The truth at the start; None where they agree or the truth begins later."""
    truth = right.truth
    begin_ns = right.start_ns
    if truth is None or len(truth) < 2:
        return None
    if not truth.stamps_ns[0] <= begin_ns <= truth.stamps_ns[-1]:
        return None
    start = right.calibration.start
    x, y, _ = truth.at(np.array([begin_ns])).positions[0].tolist()
    off_m = np.hypot(*np.subtract((x, y), start.position_m[:2]))
    # stamps of the truth that are off by a second move it by the way of that second
    soon = motion.seconds <= motion.seconds[0] + STAMPS_S
    way_m = float(np.abs(motion.path_m[soon] - motion.path_m[0]).max())
    noise_m = noise_of_positions_m(truth.positions)
    sigma_m = float(np.linalg.norm([*start.position_sigma_m[:2], noise_m]))
    if off_m <= FARTHEST_M + way_m + ACTING_SIGMAS * sigma_m:
        return None
    return contradiction(
        FROM_TRUTH,
        estimate=Estimate1D(off_m, sigma_m),
        unit="m",
        cause=f"the truth begins {off_m:.2f} m from the start of the calibration: a log that is joined after its beginning, "
        "or another world of the truth?",
        line=f"`start.position_m = {numbers((x, y, start.position_m[2]), 2)}` {IN_CALIBRATION}; {OWN_WORLD}",
    )
