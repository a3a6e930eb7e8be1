"""Causes that a gain and a delay do not show: steps, drifts, a pitched sensor, a compass among iron, a current.

A cause is a set of columns A of what the sensor has beyond its reference, ``y - x = a + A q + e`` with one q for the
whole log. It is named where q is sure, e is clearly smaller than ``y - x - a``, and no gain or delay fits as well.
docs/theory/sensor_check.md.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.diagnosis.findings import (
    IN_CALIBRATION,
    IN_LOG_CONFIG,
    Advice,
    Finding,
    Findings,
    contradiction,
    in_degrees,
    numbers,
    unused,
)
from sonar_graph.diagnosis.motion_signals import BodyMotion, holes_beside
from sonar_graph.diagnosis.signals import (
    FEWEST_ROWS,
    Explained,
    Match,
    SignalStep,
    SignalStretch,
    Values,
    explained,
    steps,
)
from sonar_graph.diagnosis.start import lacks_gravity, turned_mounting, without_bias
from sonar_graph.diagnosis.turn_rate import residual
from sonar_graph.errors import AlignmentError
from sonar_graph.measurements import NS_PER_S, Dvl, Floats, Imu
from sonar_graph.navigation.alignment import (
    Estimate1D,
    align_in_motion,
    until_hole,
)
from sonar_graph.numerics import running_integral
from sonar_graph.sequence import Sequence

AS_GOOD = 1.1
"""Ratio of the scatter to that of the best gain and delay, up to which a cause fits as well."""
LEAST_DRIFT_M_S = 0.03
"""Of a height: the vertical velocity of a Doppler log that is turned by two degrees at 1 m/s."""
LEAST_PITCH_RAD = np.radians(3.0)
LEAST_SONAR_TURN_RAD = np.radians(5.0)
LEAST_DEVIATION_RAD = np.radians(3.0)
LARGEST_IRON_RAD = np.radians(45.0)
"""Deviation that iron of the vehicle makes at most."""
LEAST_CURRENT_M_S = 0.05
BEST_NOISE_M_S = 0.01
"""Of a row of a good Doppler log."""
JUMPING = 2.0
"""Ratio of a change to that of the path beyond which it shows no direction."""
LONGEST_LIST = 3
LARGEST_MISFIT = 10.0
"""Differences over their sigmas, beyond those of noise that is stated too small."""
HALF_MINUTE_S = 30.0
MOST_HALF_MINUTES = 6


@dataclass(frozen=True)
class Cause:
    """Columns of one cause, and what to write where they explain a sensor."""

    name: str
    unit: str
    """Of q: degrees for an angle in radians."""
    columns: Callable[[SignalStretch], Values]
    """Shape (n, q)."""
    wanted: int
    """Number of the columns, the first ones, that are the cause; the others may count without it."""
    least: Callable[[Calibration], float]
    """Length of q from which on the cause matters."""
    advice: Callable[[Values, Calibration], Advice]
    """By q."""
    least_turn_rad: float = 0.0
    """Range of a heading that a stretch must have."""


def since_middle(stretch: SignalStretch) -> Values:
    """Time as a column, shape (n, 1), s."""
    return (stretch.seconds - stretch.seconds.mean())[:, None]


def of_way(stretch: SignalStretch) -> Values:
    """What the table of checks has beside the reference, at the rows, shape (n, q)."""
    assert stretch.beside is not None
    return stretch.beside(stretch.seconds)


def of_turn(stretch: SignalStretch) -> Values:
    """Direction of the heading, and a drift of the gyros, shape (n, 3)."""
    yaw_rad = stretch.x.real
    return np.column_stack([np.cos(yaw_rad), np.sin(yaw_rad), since_middle(stretch)])


def of_turn_and_twice(stretch: SignalStretch) -> Values:
    """Directions of the heading and of twice the heading, and a drift of the gyros, shape (n, 5)."""
    twice_rad = 2.0 * stretch.x.real
    soft = np.column_stack([np.cos(twice_rad), np.sin(twice_rad)])
    return np.hstack([soft, of_turn(stretch)])


def of_current(stretch: SignalStretch) -> Values:
    """Time, and the path itself, whose turn and scale are other findings, shape (n, 2)."""
    return np.column_stack([since_middle(stretch), stretch.x])


def of_current_beside_scale(stretch: SignalStretch) -> Values:
    """What the table of checks has beside the reference, and the reference itself, shape (n, q + 1).

    On a straight way a current along it and a scale are the same.
    """
    return np.column_stack([of_way(stretch), stretch.x])


def of_scale(stretch: SignalStretch) -> Values:
    """Changes of ranges themselves, and what heights of landmarks take off them, shape (n, 2)."""
    return np.column_stack([stretch.x, of_way(stretch)[:, 2]])


def of_sonar_turn(stretch: SignalStretch) -> Values:
    """Changes of ranges to landmarks 90 degrees to the left, and those as seen, shape (n, 2).

    Turned by an angle a, ranges change by ``cos(a) x + sin(a) x_left``.
    """
    return np.column_stack([of_way(stretch)[:, 3], stretch.x])


def drift_advice(q: Values, _: Calibration) -> Advice:
    """A height that drifts."""
    return Advice(
        f"it changes by {float(q[0].real):+.2g} m/s more than the Doppler log's vertical velocity all the time: the depths "
        "drift, or that velocity is wrong",
        f"{unused('depth')} leaves the depths out; or a larger `dvl.velocity_sigma_m_s` {IN_CALIBRATION}",
    )


def pitch_advice(q: Values, calibration: Calibration) -> Advice:
    """A height that changes with the way ahead: which of both is pitched, only a stated start shows."""
    pitch_rad = np.arcsin(np.clip(q[0].real, -1.0, 1.0))
    of_dvl = pitched_line("dvl", calibration, -pitch_rad)
    of_imu = pitched_line("imu", calibration, pitch_rad)
    return Advice(
        f"it changes with the way ahead: the Doppler log or the IMU is pitched by {abs(np.degrees(pitch_rad)):.2g}° on the "
        "vehicle",
        f"{of_dvl} {IN_CALIBRATION} or, if that mounting is sure, {of_imu}",
    )


def pitched_line(role: str, calibration: Calibration, pitch_rad: float) -> str:
    """Setting of a mounting after a turn about the body's y axis."""
    mounting: Mounting = getattr(calibration, role).mounting
    rpy_rad = turned_mounting(mounting, (0.0, pitch_rad, 0.0))
    return f"`{role}.mounting.rpy_rad = {numbers(rpy_rad, 4)}`"


def pitched_one(
    findings: Findings, off: Estimate1D, calibration: Calibration
) -> tuple[Findings, bool]:
    """Findings with the line for the one that is pitched, and whether it is the IMU.

    ``off``: pitch at a stated start by gravity, less the stated one, rad: that of the IMU's mounting, or none.
    """
    found = next((f for f in findings if f.quantity.endswith(PITCH.name)), None)
    if found is None or not off.is_known:
        return findings, False
    # the height changes by the sine for each metre ahead
    pitch_rad = np.radians(found.estimate.value)
    is_imu = abs(off.value - pitch_rad) < abs(off.value)
    role = "imu" if is_imu else "dvl"
    line = pitched_line(role, calibration, pitch_rad if is_imu else -pitch_rad)
    right = replace(found, line=f"{line} {IN_CALIBRATION}")
    return [right if f is found else f for f in findings], is_imu


def sonar_turn_advice(q: Values, calibration: Calibration) -> Advice:
    """Ranges that change as if the landmarks were seen in another direction."""
    turn_rad = np.arcsin(np.clip(q[0].real, -1.0, 1.0))
    rpy_rad = turned_mounting(calibration.sonar.mounting, (0.0, 0.0, turn_rad))
    side = "left" if turn_rad > 0 else "right"
    return Advice(
        f"ranges change as for landmarks {abs(np.degrees(turn_rad)):.2g}° further to the {side}: the sonar is turned on the "
        "vehicle, or its azimuths have another zero",
        f"`sonar.mounting.rpy_rad = {numbers(rpy_rad, 4)}` {IN_CALIBRATION}",
    )


def deviation_advice(q: Values, _: Calibration) -> Advice:
    """A compass whose error depends on its heading."""
    largest_rad = float(np.linalg.norm(q))
    iron = "a compass among iron of the vehicle, or a wrong calibration of it"
    cause = f"degrees that are read as radians, or {iron}"
    return Advice(
        f"it is off by up to {np.degrees(largest_rad):.2g}° one way and the other as the vehicle turns: "
        f"{cause if largest_rad > LARGEST_IRON_RAD else iron}",
        f"calibrate the compass on the vehicle, or {unused('heading')}",
    )


def current_advice(q: Values, _: Calibration) -> Advice:
    """Velocities over something that moves."""
    return Advice(
        f"the path moves away by {float(np.linalg.norm(q)):.2g} m/s in one direction: the Doppler log measures the water, "
        "not the bottom; or, on a way that hardly turns, north and east of the fixes are exchanged",
        f"name a `topic` with its bottom track under [dvl] {IN_LOG_CONFIG}",
    )


PITCH = Cause(
    "pitch of Doppler log or IMU",
    "°",
    of_way,
    wanted=1,
    least=lambda _: LEAST_PITCH_RAD,
    advice=pitch_advice,
)
DRIFT = Cause(
    "drift",
    "m/s",
    since_middle,
    wanted=1,
    least=lambda _: LEAST_DRIFT_M_S,
    advice=drift_advice,
)
DEVIATION = Cause(
    "deviation with the heading",
    "°",
    of_turn,
    wanted=2,
    # its owner knows of a bias, which may change with the heading
    least=lambda known: max(LEAST_DEVIATION_RAD, 2.0 * known.heading.bias_sigma_rad),
    advice=deviation_advice,
    # on a shorter turn, between two holes of the IMU, it looks like a drift
    least_turn_rad=np.radians(45.0),
)
# iron that the Earth magnetises beside magnets on the vehicle
SOFT_IRON = replace(DEVIATION, columns=of_turn_and_twice, wanted=4)
SONAR_TURN = Cause(
    "turn of the sonar",
    "°",
    of_sonar_turn,
    wanted=1,
    least=lambda _: LEAST_SONAR_TURN_RAD,
    advice=sonar_turn_advice,
)
CURRENT = partial(
    Cause, "current", "m/s", least=lambda _: LEAST_CURRENT_M_S, advice=current_advice
)
OF_FIXES = CURRENT(columns=of_current, wanted=1)
OF_RANGES = CURRENT(columns=of_current_beside_scale, wanted=2)


def explained_by(cause: Cause, found: Match) -> Explained | None:
    """What a cause explains, by the stretches that can show it."""
    shown = [
        stretch
        for stretch in found.stretches
        if known_range(stretch.x) >= cause.least_turn_rad
    ]
    return explained(shown, cause.columns, cause.wanted)


def known_range(values: Values) -> float:
    """Largest less smallest value; references are unknown across gaps."""
    known = values[np.isfinite(values)]
    return float(np.ptp(known.real)) if len(known) else 0.0


def cause_of(
    name: str,
    causes: tuple[Cause, ...],
    found: Match,
    calibration: Calibration,
    most: float = AS_GOOD,
) -> Finding | None:
    """The cause that explains a sensor best; None: none does, or one that is too small to matter does as well.

    ``most``: largest ratio of the scatter to that of the best gain and delay.
    """
    tried = [(explained_by(cause, found), cause) for cause in causes]
    # a cause counts only where its columns surely do
    fits = [(result, cause) for result, cause in tried if result and result.is_clear]
    if not fits:
        return None
    result, cause = min(fits, key=lambda fit: fit[0].after)
    if result.after > most * found.scatter:
        return None
    for rival, other in fits:
        is_small = float(np.linalg.norm(rival.q)) < other.least(calibration)
        if is_small and rival.after < AS_GOOD * result.after:
            return None
    is_signed = len(result.q) == 1 and not np.iscomplexobj(result.q)
    value = float(result.q[0].real if is_signed else np.linalg.norm(result.q))
    estimate = Estimate1D(value, float(np.max(result.sigmas)))
    advice = cause.advice(result.q, calibration)
    return contradiction(
        f"{name}: {cause.name}",
        advice.cause,
        advice.line,
        in_degrees(estimate) if cause.unit == "°" else estimate,
        cause.unit,
    )


def step_text(found: Match, sigma: float, unit: str, ratio: float) -> str:
    """Size and times of steps of a sensor beyond its reference; empty without any."""
    texts = list[str]()
    for whole in found.whole:
        x = turned_to(whole.y, whole.x)
        # a velocity that changes between two rows of a slow Doppler log may have changed at any time between them
        T = found.interval_s
        before, at, after = whole.shifted(np.array([T, 0.0, -T]))
        doubt = np.abs(after - 2.0 * at + before)
        for step in steps(whole.seconds, whole.y, x, sigma, ratio, doubt):
            size = np.degrees(step.size) if unit == "°" else step.size
            texts.append(f"by {size:.3g} {unit} at {step.seconds:.1f} s")
    return " and ".join(texts[:LONGEST_LIST])


PAUSES_S = (20.0, 60.0)
"""Lengths of the windows in which a sensor may stand still."""
PAUSE_MOVED = 5.0
PAUSE_LACKED = 3.0
PAUSE_NOISE = 1.5
HARDLY_MOVED = 0.1


def pause_text(found: Match, sigma: float, drift: float) -> str:
    """Longest time over which a sensor stands still while its reference moves; empty without any.

    In a window of its rows the reference's standard deviation is `PAUSE_MOVED` of ``sigma``, that of a row, beyond a
    ``drift`` in its unit a second, and the sensor's that of its noise, or a tenth of the reference's. What it lacks there is
    `PAUSE_LACKED` times what it lacks in a quarter of the shorter windows: of a vehicle that keeps its depth the reference
    may drift all the time.
    """
    longest = (0.0, 0.0)
    for whole in found.whole:
        t = whole.seconds
        x = turned_to(whole.y, whole.x)
        lacked_a_second = np.inf
        for length_s in PAUSES_S:
            interval_s = float(np.median(np.diff(t)))
            # stamps that are cut to seconds
            if not interval_s > 0.0:
                continue
            rows = max(FEWEST_ROWS, int(np.ceil(length_s / interval_s)))
            if rows >= len(t):
                continue
            moved, by_y, lacked = (
                spreads(signal, rows) for signal in (x, whole.y, whole.y - x)
            )
            if not np.isfinite(lacked).any():
                continue
            still = np.maximum(PAUSE_NOISE * sigma, HARDLY_MOVED * moved)
            of_quarter = np.percentile(lacked[np.isfinite(lacked)], 25.0)
            lacked_a_second = min(lacked_a_second, of_quarter / length_s)
            usual = max(lacked_a_second * length_s, sigma)
            # the standard deviation of a line
            drifted = drift * length_s / np.sqrt(12.0)
            is_paused = (moved > PAUSE_MOVED * sigma + drifted) & (by_y < still)
            is_paused &= lacked > PAUSE_LACKED * usual
            # a window across a hole of the log is longer
            is_paused &= t[rows - 1 :] - t[: len(t) - rows + 1] < 2.0 * length_s
            edges = np.flatnonzero(np.diff(is_paused, prepend=False, append=False))
            for first, end in zip(edges[::2], edges[1::2], strict=True):
                span = (float(t[first]), float(t[end + rows - 2]))
                longest = max(longest, span, key=lambda one: one[1] - one[0])
    begin_s, end_s = longest
    return f"between {begin_s:.0f} and {end_s:.0f} s" if end_s else ""


def spreads(values: Values, rows: int) -> Floats:
    """Standard deviation of so many rows from each one on, shape (n - rows + 1,); NaN where one of them is not known."""
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(values) - rows + 1, np.nan)
    centred = np.where(known, values - np.mean(values[known]), 0.0)

    def mean(columns: Values) -> Values:
        sums = np.append(0.0, np.cumsum(columns))
        return (sums[rows:] - sums[:-rows]) / rows

    variance = mean(np.abs(centred) ** 2).real - np.abs(mean(centred)) ** 2
    is_whole = mean(known.astype(float)) > 1.0 - 0.5 / rows
    return np.where(is_whole, np.sqrt(np.maximum(variance, 0.0)), np.nan)


EXCURSION_OVER_S = 5.0
"""Time over which noise and waves average out of a heading."""
FEWEST_MEDIANS = 12
MOST_PAIRS = 20_000
EXCURSION_SCATTERS = 8.0
MOST_OFF = 0.4
"""Share of the log; a sensor that is off for longer has other faults."""


def excursion(found: Match, least: float) -> str:
    """Size and time of a stretch in which a sensor leaves its reference and comes back; empty without one.

    The medians over some seconds of what it has beyond the reference are on a line, by the median of the slopes (Theil,
    Sen), but for a share of them. A single wild row does not move them.
    """
    for whole in found.whole:
        beyond = whole.excess()
        is_known = np.isfinite(beyond.y.real)
        t = beyond.seconds[is_known]
        if not len(t):
            continue
        block = ((t - t[0]) // EXCURSION_OVER_S).astype(int)
        _, first = np.unique(block, return_index=True)
        middle_s = medians(np.split(t, first[1:]))
        usual = medians(np.split(beyond.y.real[is_known], first[1:]))
        if len(usual) < FEWEST_MEDIANS:
            continue
        i, j = np.triu_indices(len(usual), 1)
        every = max(1, len(i) // MOST_PAIRS)
        rise = usual[j[::every]] - usual[i[::every]]
        slope = np.median(rise / (middle_s[j[::every]] - middle_s[i[::every]]))
        off = usual - slope * middle_s
        off -= np.median(off)
        # the median of deviations as a standard deviation of normal noise
        scatter = 1.4826 * float(np.median(np.abs(off)))
        is_off = np.abs(off) > max(least, EXCURSION_SCATTERS * scatter)
        if is_off.any() and is_off.mean() <= MOST_OFF:
            largest_deg = np.degrees(off[np.abs(off).argmax()])
            begin_s, end_s = middle_s[np.flatnonzero(is_off)[[0, -1]]]
            return (
                f"by up to {largest_deg:.2g}° between {begin_s:.0f} and {end_s:.0f} s"
            )
    return ""


def medians(blocks: list[Floats]) -> Floats:
    """Of each block of numbers."""
    return np.array([np.median(block) for block in blocks])


def velocity_steps(sequence: Sequence) -> Finding | None:
    """Steps of the Doppler log that the accelerometers do not feel; None without any, or where they cannot be found."""
    motion = BodyMotion.of(sequence)
    if motion is None or motion.felt is None:
        return None
    felt = motion.felt
    gravity = felt.gravity_m_s2 - residual(motion, felt.gravity_m_s2)  # (n, 3)
    found = list[SignalStep]()
    # nothing is felt in holes of the accelerometers
    imu = sequence.imu
    is_felt = np.isfinite(imu.specific_force).all(axis=1)
    felt_s = motion.since_origin(imu.stamps_ns[is_felt])
    before, after = holes_beside(imu.stamps_ns[is_felt], felt_s, motion.seconds)
    parts = motion.parts + before
    for part in np.unique(parts):
        rows = np.flatnonzero((parts == part) & (before == after))
        t = motion.seconds[rows]
        # with gravity taken off, the forces show how the velocity changed
        by_forces = felt.impulse_m_s[rows] - running_integral(t, gravity[rows])
        # a wrong unit of velocities was found before
        found += steps(t, felt.velocity_m_s[rows], by_forces, BEST_NOISE_M_S, ratio=1.0)
    if not found:
        return None
    texts = [f"by {step.size:.2g} m/s at {step.seconds:.1f} s" for step in found]
    return contradiction(
        "DVL: steps",
        estimate="wrong velocities",
        cause=f"velocities change {' and '.join(texts[:LONGEST_LIST])} while the accelerometers feel nothing: bottom lock "
        "lost, such as a change to the water, or values repeated",
        line=f"leave the rows without bottom lock out (`lock` under [dvl] {IN_LOG_CONFIG}), or that part by --start and "
        "--end",
    )


def unlike_pair(sequence: Sequence) -> Finding | None:
    """Doppler log and IMU that contradict each other in two of up to six half minutes, by what no other comparison knows.

    A single wild velocity spoils no more than one of them.
    """
    if np.isnan(sequence.imu.specific_force).all() or lacks_gravity(sequence):
        return None
    first_ns, *_, last_ns = sequence.imu.stamps_ns.tolist()
    # windows of a shorter log are its halves: a row must not be in two of them
    step_ns = min(round(HALF_MINUTE_S * NS_PER_S), (last_ns - first_ns) // 2)
    count = int(np.clip((last_ns - first_ns) // max(step_ns, 1), 2, MOST_HALF_MINUTES))
    begins_ns = np.linspace(first_ns, last_ns - step_ns, count)
    misfits = np.array(
        [misfit_of(sequence, int(begin), step_ns) for begin in begins_ns]
    )
    unlike = np.flatnonzero(misfits > LARGEST_MISFIT)
    if len(unlike) < 2:
        return None
    from_s = (begins_ns[unlike[0]] - first_ns) / NS_PER_S
    cause = (
        f"in {len(unlike)} of {count} half minutes, from {from_s:.0f} s on, velocities and accelerations differ up to "
        f"{misfits.max():.0f} times more than their noise says; whether axes, stamps, scale or noise of either is wrong "
        "could not be found, and other sensors were not compared"
    )
    line = f"compare axes, stamps and units of both with their manuals, and the noise {IN_CALIBRATION} with theirs"
    quantity = "DVL against IMU: velocities and accelerometers"
    return contradiction(quantity, cause, line, "they contradict each other")


def misfit_of(sequence: Sequence, begin_ns: int, step_ns: int) -> float:
    """Differences of velocities and accelerations of a window over their sigmas; 0 where they are usual, or too few."""
    end_ns = begin_ns + step_ns
    calibration = sequence.calibration
    imu = without_bias(sequence.imu, calibration).between(begin_ns - 1, end_ns)
    dvl = sequence.dvl.between(begin_ns - 1, end_ns)
    if imu is None or dvl is None:
        return 0.0
    whole = until_hole(imu)
    found = misfit_with(whole, dvl, calibration)
    # a calibration states the noise of a sensor at rest, and thrusters shake it: what that noise explains is no misfit
    sensors = calibration.imu
    shaken = max(sensors.accel_noise_density, vibration_density(whole))
    sensors = sensors.model_copy(update={"accel_noise_density": shaken})
    of_shaken = calibration.model_copy(update={"imu": sensors})
    if found > LARGEST_MISFIT and not misfit_with(whole, dvl, of_shaken):
        return 0.0
    return found


def misfit_with(imu: Imu, dvl: Dvl, calibration: Calibration) -> float:
    """Differences of velocities and accelerations over their sigmas by a calibration; 0 where they are usual."""
    try:
        align_in_motion(imu, dvl, calibration)
    except AlignmentError as error:
        return error.misfit
    except np.linalg.LinAlgError:
        pass  # the noise of the calibration is zero
    return 0.0


def vibration_density(imu: Imu) -> float:
    """Noise density of the specific force by its second differences, m/s²/√Hz: motion changes little in two rows."""
    force = imu.specific_force
    # a driver that is faster than its sensor repeats rows
    is_new = np.append(True, (np.diff(force, axis=0) != 0.0).any(axis=1))
    bent = np.diff(force[is_new], n=2, axis=0)
    if not len(bent):
        return 0.0
    # the second difference of white noise has six times its variance
    sigma = 1.4826 * np.median(np.abs(bent), axis=0) / np.sqrt(6.0)  # (3,)
    interval_s = float(np.median(np.diff(imu.stamps_ns[is_new]))) / NS_PER_S
    return float(sigma.max() * np.sqrt(interval_s))


def turned_to(y: Values, x: Values) -> Values:
    """A level path turned, and mirrored if that is nearer, as a signal y changes apart from jumps; others as they are."""
    if not np.iscomplexobj(y):
        return x
    of_y = np.diff(y)
    of_x = np.diff(x)
    # changes that the path cannot have are no part of its direction
    is_usual = np.abs(of_y) < JUMPING * np.abs(of_x)
    turns = [np.vdot(way[is_usual], of_y[is_usual]) for way in (of_x, of_x.conj())]
    best = int(np.argmax(np.abs(turns)))
    return (x, x.conj())[best] * np.exp(1j * np.angle(turns[best]))
