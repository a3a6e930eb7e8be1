"""Check of headings and position fixes against gyros and Doppler log.

Over windows of `WINDOW_NS` the heading turns by ``y = k x + b T + e`` where the gyros turn by x about the vertical, of
bias b: k is 1, and -1 where yaw is counted clockwise. With Δp the displacement by Doppler log and heading as a complex
number and Δg that of the fixes, ``Δg = c Δp + e``: the heading lacks ``arg c``, and ``|c|`` is the unit of the fixes.
docs/theory/sensor_check.md.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sonar_graph.diagnosis.findings import (
    IN_CALIBRATION,
    IN_LOG_CONFIG,
    INTERVAL_SIGMAS,
    LEAST_BIAS_RAD_S,
    NO_NEED,
    Finding,
    in_degrees,
    matters,
    numbers,
    turned_mounting,
)
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import NS_PER_S, Floats, Heading, Imu, Ints, PositionFixes
from sonar_graph.navigation.alignment import Estimate1D
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.sequence import Sequence

HEADING_SENSE, HEADING_TURN = (
    "heading: turn over that of the gyros",
    "heading: turn towards the positions",
)
WINDOW_NS = 10 * NS_PER_S
FEWEST_WINDOWS = 6
LARGEST_HEADING_SIGMA_RAD = 0.25
LARGEST_TURN_SIGMA = 0.25
"""Of k, so that 1 and -1 are eight sigmas apart."""
UNITS_M = {"mm": 1e-3, "cm": 1e-2, "km": 1e3, "degrees": 1.1e5}
HIGH_PERCENTILE = 95.0
LARGEST_RATIO = 10.0
"""Of displacements by fixes over those by the Doppler log, either way; no noise within the calibration's makes it."""
JUMP_NS = 2 * WINDOW_NS
JUMP_GATE = chi_square_quantile(1 - 1e-4, 3)
LARGEST_JUMPING_SHARE = 0.2
"""Of the fixes; single outliers are what a robust kernel is for."""
FARTHEST_ORIGIN_M = 1e5
"""No vehicle of a run goes so far; coordinates of a map grid begin beyond."""


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


def heading_sense(sequence: Sequence, heading: Heading, config: LogConfig) -> Finding:
    """Sense in which the heading turns, by the gyros."""
    ends = np.arange(
        max(sequence.start_ns, heading.stamps_ns[0]),
        min(sequence.end_ns, heading.stamps_ns[-1]) + 1,
        WINDOW_NS,
    )
    body_R_imu = sequence.calibration.imu.mounting.pose().rotation().matrix()
    x = np.diff(turned_about_up(sequence.imu, body_R_imu, ends))
    y = np.diff(np.interp(ends, heading.stamps_ns, np.unwrap(heading.yaw_rad)))
    sense = Estimate1D(np.nan, np.inf, "too little turning")
    if len(x) >= FEWEST_WINDOWS and np.ptp(x) > 0:
        x, y = x - float(x.mean()), y - float(y.mean())
        k = float(x @ y / (x @ x))
        scatter_rad2 = float(np.sum((y - k * x) ** 2)) / (len(x) - 2)
        sense = Estimate1D(k, float(np.sqrt(scatter_rad2 / (x @ x)))).limited(
            LARGEST_TURN_SIGMA, "too little turning"
        )
    if sense.is_known and matters(sense, 0.0) and sense.value < 0:
        world = "enu" if config.table("heading").get("world") == "ned" else "ned"
        advice = f'it turns against the gyros, clockwise: `world = "{world}"` under [heading] {IN_LOG_CONFIG}'
        return Finding(HEADING_SENSE, sense, "", advice, acts=True)
    is_stuck = sense.is_known and sense.value + INTERVAL_SIGMAS * sense.sigma < 0.5
    advice = (
        "it hardly turns where the gyros do: stuck, or not of the body; `use = false` under [heading] "
        + IN_LOG_CONFIG
    )
    return Finding(HEADING_SENSE, sense, "", advice if is_stuck else NO_NEED, is_stuck)


def vertical_bias(sequence: Sequence) -> Finding | None:
    """Bias of the gyros about the vertical, by a heading or by true orientations; None without either.

    Windows of the gyros' turn x and the heading's y give ``b = mean(x - y) / T``, less the bias that is known.
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
    ends = np.arange(
        max(sequence.start_ns, stamps_ns[0]),
        min(sequence.end_ns, stamps_ns[-1]) + 1,
        WINDOW_NS,
    )
    imu, known = sequence.imu, np.array(sequence.calibration.imu.gyro_bias_rad_s)
    body_R_imu = sequence.calibration.imu.mounting.pose().rotation().matrix()
    up = upwards(imu, body_R_imu)
    rate = (
        np.diff(turned_about_up(imu, body_R_imu, ends))
        - np.diff(np.interp(ends, stamps_ns, yaw_rad))
    ) / (WINDOW_NS / NS_PER_S)
    bias = Estimate1D(np.nan, np.inf, f"too little time beside {source}")
    if len(rate) >= FEWEST_WINDOWS:
        sigma = float(np.std(rate)) / float(np.sqrt(len(rate)))
        bias = Estimate1D(float(np.mean(rate)) - float(up @ known), max(sigma, 1e-9))
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
    return Finding("gyro bias about the vertical", bias, "rad/s", advice, acts)


def heading_findings(right: Sequence, config: LogConfig) -> Iterator[Finding]:
    """Sense of the heading; where it turns as the gyros, the angle by which it is off the world of the positions."""
    if right.heading is None:
        return
    sense = heading_sense(right, right.heading, config)
    yield sense
    known = right.positions or right.truth
    if sense.acts or known is None:
        return
    places = known.position_m if isinstance(known, PositionFixes) else known.positions
    yaw_rad = np.interp(
        right.dvl.stamps_ns, right.heading.stamps_ns, np.unwrap(right.heading.yaw_rad)
    )
    seen, reckoned = displacements(right, known.stamps_ns, places, yaw_rad)
    moved = float(np.vdot(reckoned, reckoned).real)
    angle = Estimate1D(np.nan, np.inf, "too little motion beside positions")
    if len(seen) >= FEWEST_WINDOWS and moved > 0:
        c = np.vdot(reckoned, seen) / moved
        scatter_m2 = float(np.mean(np.abs(seen - c * reckoned) ** 2)) / 2
        found = Estimate1D(
            float(np.angle(c)), float(np.sqrt(scatter_m2 / moved) / max(abs(c), 1e-9))
        )
        angle = found.limited(
            LARGEST_HEADING_SIGMA_RAD, "too little motion beside positions"
        )
    allowed = right.calibration.heading.bias_sigma_rad
    acts = matters(replace(angle, sigma=float(np.hypot(angle.sigma, allowed))), 0.0)
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
    yield Finding(HEADING_TURN, in_degrees(angle), "°", advice, acts)


def displacements(
    right: Sequence, stamps_ns: Ints, places: Floats, yaw_rad: Floats
) -> tuple[Floats, Floats]:
    """Level displacements over windows as complex numbers: of places, shape (n, 3), and by the Doppler log.

    ``yaw_rad``: of the body at the rows of the Doppler log.
    """
    x, y, _ = (
        right.calibration.dvl.mounting.pose().rotation().matrix() @ right.dvl.velocity.T
    )
    velocity = (x + 1j * y) * np.exp(1j * yaw_rad)
    steps = (velocity[1:] + velocity[:-1]) / 2 * np.diff(right.dvl.stamps_ns) * 1e-9
    path = np.concatenate([[0.0], np.cumsum(steps)])
    ends = np.arange(
        max(stamps_ns[0], right.start_ns),
        min(stamps_ns[-1], right.end_ns) + 1,
        WINDOW_NS,
    )
    reckoned = np.diff(np.interp(ends, right.dvl.stamps_ns, path))
    return np.diff(
        np.interp(ends, stamps_ns, places[:, 0] + 1j * places[:, 1])
    ), reckoned


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


def position_findings(right: Sequence, config: LogConfig) -> Iterator[Finding]:
    """Unit of the position fixes, jumps that no vehicle makes, and their distance from the start or the origin.

    The origin where no start is stated.
    """
    fixes, calibration = right.positions, right.calibration
    if fixes is None:
        return
    table, unknown = (
        config.table("positions"),
        Estimate1D(np.nan, np.inf, "too few fixes beside the Doppler log"),
    )
    body_R_imu = calibration.imu.mounting.pose().rotation().matrix()
    yaw_rad = turned_about_up(right.imu, body_R_imu, right.dvl.stamps_ns)
    seen, reckoned = displacements(right, fixes.stamps_ns, fixes.position_m, yaw_rad)
    if len(seen) < FEWEST_WINDOWS:
        yield Finding("position fixes: unit", unknown, "", "")
        return
    noise_m = float(np.hypot(*calibration.positions.sigma_m[:2]))
    seen_m, reckoned_m = (
        float(np.median(np.abs(seen))),
        float(np.median(np.abs(reckoned))),
    )
    if (
        seen_m > LARGEST_RATIO * max(reckoned_m, noise_m)
        or reckoned_m > LARGEST_RATIO**2 * seen_m > 0
    ):
        unit = min(
            UNITS_M,
            key=lambda unit: abs(
                np.log(seen_m / max(reckoned_m, 1e-9) * UNITS_M[unit])
            ),
        )
        line = f"`scale = {float(table.get('scale', 1.0)) * UNITS_M[unit]:.4g}`"
        line = (
            "`geodetic`, with the fields of latitude and longitude,"
            if unit == "degrees"
            else line
        )
        advice = (
            f"in {WINDOW_NS / NS_PER_S:.0f} s they move by {seen_m:.3g} m, the Doppler log by {reckoned_m:.3g} m: "
            f"{unit}? {line} under [positions] {IN_LOG_CONFIG}"
        )
        yield Finding(
            "position fixes: unit",
            replace(unknown, reason="wrong unit"),
            "",
            advice,
            acts=True,
        )
        return
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
        yield Finding("position fixes: jumps", of_all, "%", advice, acts=True)
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
    advice, acts = (
        NO_NEED,
        from_start_m > allowed_m or from_origin_m > FARTHEST_ORIGIN_M,
    )
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
        "position fixes: distance from the start", distance, "m", advice, acts
    )
