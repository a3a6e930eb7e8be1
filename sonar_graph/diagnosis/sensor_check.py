"""Check of a log's sensors against each other: units, offsets, mountings, scale and noise.

The estimators are in `sonar_graph.navigation.alignment`; here each number is compared with the calibration and the log
configuration of a run, and becomes a line for one of the two. Derivation: docs/theory/sensor_check.md.

Units are recognised where the values, read as configured, are implausible for a vehicle and a common factor makes them
plausible. A slow vehicle's rates in degrees can pass for rates in radians: no finding is no proof.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Start
from sonar_graph.diagnosis.aiding_check import (
    AZIMUTH,
    DEPTH,
    HEADING_SENSE,
    HEADING_TURN,
    LARGE_TURN_RAD,
    RANGE,
    compared,
    findings_of,
    heading_findings,
    position_findings,
    start_depth_findings,
    vertical_bias,
)
from sonar_graph.diagnosis.dvl_axes import match_axes
from sonar_graph.diagnosis.findings import (
    IN_CALIBRATION,
    IN_LOG_CONFIG,
    NO_NEED,
    Finding,
    StartTilt,
    bias_findings,
    find_start_heading,
    find_start_tilt,
    in_degrees,
    lever_findings,
    matters,
    numbers,
    tilt_findings,
    turned_mounting,
    with_fitted,
    worst_first,
)
from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.logs import gravity_warning
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import NS_PER_S, Dvl, Floats, Imu
from sonar_graph.navigation.alignment import (
    DvlMatch,
    Estimate1D,
    Estimates3D,
    longest_rest,
    match_dvl_to_imu,
    match_reference_to_imu,
    noise_densities,
)
from sonar_graph.sequence import Sequence

FASTEST_M_S = 20.0
"""Implausible over the bottom for a twentieth of a log."""
FASTEST_TURN_RAD_S = 2.0
"""Implausible likewise, 115 degrees a second."""
SPEEDS = {"cm/s": 1e-2, "mm/s": 1e-3}
"""Factor to m/s."""
FORCES = {"g": 9.80665, "mg": 9.80665e-3, "cm/s²": 1e-2, "mm/s²": 1e-3}
"""Factor to m/s²; mg and cm/s² differ by a fiftieth, so that the nearest counts."""
SHARE_OF_GRAVITY = 0.2
"""Relative difference allowed between a typical specific force and gravity."""
USUAL_SPEED_M_S = 3.0
PAIR_S, LONGEST_PAIR_S = 1.0, 3.0
"""Time between two sightings of a landmark that are compared: long enough to move, and short enough to turn little."""
FEWEST_PAIRS, MEDIAN_ROWS = 20, 9
LARGEST_RANGE_RATIO = 10.0
"""Changes of range by the Doppler log over those measured: 1 but for noise and turns, 100 in cm/s."""
HIGH_PERCENTILE = 95.0
LEAST_SECONDS = 30
LEAST_TILTING_RAD_S = 0.02
LARGEST_TILT_RATIO = 10.0
"""Tilting by gyros over that by gravity: below 1 in rad/s but for the gyros' noise, up to 57 in degrees."""


def wrong_units(sequence: Sequence, config: LogConfig) -> list[Finding]:
    """Velocities, rates and specific forces in an implausible unit; the configured scales enter the advice."""
    advice: dict[str, str] = {}
    speed_m_s, changes_m = (
        _exceeded_by_few(sequence.dvl.velocity),
        range_changes(sequence),
    )
    is_far = changes_m is not None and changes_m[1] > LARGEST_RANGE_RATIO * changes_m[0]
    if speed_m_s > FASTEST_M_S or is_far:
        unit = next(
            (
                unit
                for unit, factor in SPEEDS.items()
                if speed_m_s * factor <= USUAL_SPEED_M_S
            ),
            "mm/s",
        )
        scale = config.number("dvl", "scale", 1.0) * SPEEDS[unit]
        why = f"up to {speed_m_s:.3g} m/s"
        if is_far and changes_m is not None:
            why += (
                "; ranges to landmarks change by {:.3g} m, by them by {:.3g} m".format(
                    *changes_m
                )
            )
        advice["DVL: unit"] = (
            f"velocities look {1 / SPEEDS[unit]:.0f} times too large ({why}): {unit}? "
            f"`scale = {scale:.4g}` under [dvl] {IN_LOG_CONFIG}"
        )
        if speed_m_s > FASTEST_M_S and unit != "mm/s":
            advice["DVL: unit"] += (
                f"; mm/s if the vehicle moves at {speed_m_s * SPEEDS['mm/s']:.2g} m/s"
            )
    rate_rad_s = _exceeded_by_few(sequence.imu.angular_velocity)
    tilting = tilt_rates(sequence.imu)
    doubt = (
        f"57 times too large (up to {rate_rad_s:.3g} rad/s)"
        if rate_rad_s > FASTEST_TURN_RAD_S
        else ""
    )
    if (
        not doubt
        and tilting
        and tilting[0] > max(LEAST_TILTING_RAD_S, LARGEST_TILT_RATIO * tilting[1])
    ):
        doubt = "too large (they tilt the vehicle by {:.2g} rad/s, gravity by {:.2g})".format(
            *tilting
        )
    if doubt:
        scale = config.number("imu", "angular_velocity_scale", 1.0) * np.radians(1.0)
        advice["gyro: unit"] = (
            f"rates look {doubt}: degrees a second? `angular_velocity_scale = {scale:.5g}` under [imu] {IN_LOG_CONFIG}"
        )
    forces, gravity = (
        _lengths(sequence.imu.specific_force),
        sequence.calibration.gravity_m_s2,
    )
    typical = float(np.median(forces)) if len(forces) else 0.0
    unit = min(FORCES, key=lambda unit: abs(typical * FORCES[unit] - gravity))
    if len(forces) and not abs(typical * FORCES[unit] / gravity - 1) > SHARE_OF_GRAVITY:
        scale = config.number("imu", "linear_acceleration_scale", 1.0) * FORCES[unit]
        advice["accelerometer: unit"] = (
            f"specific forces are typically {typical:.4g} instead of {gravity:.4g} m/s²: {unit}? "
            f"`linear_acceleration_scale = {scale:.6g}` under [imu] {IN_LOG_CONFIG}"
        )
    unknown = Estimate1D(np.nan, np.inf, "wrong unit")
    return [
        Finding(quantity, unknown, "", line, acts=True, grave=True)
        for quantity, line in advice.items()
    ]


def doubts(sequence: Sequence, config: LogConfig) -> list[Finding]:
    """Findings to act on, without the slower comparison of Doppler log and accelerometers (`check_sensors`).

    All grave ones are among them. Of a heading that is turned against known positions only a large turn.
    """
    if faults := wrong_units(sequence, config):
        return faults
    axes, right = axes_finding(sequence)
    found = worst_first([*axes, *motion_findings(right, config)])
    return [
        finding
        for finding in found
        if finding.acts and (finding.grave or finding.quantity != HEADING_TURN)
    ]


def axes_finding(sequence: Sequence) -> tuple[list[Finding], Sequence]:
    """Finding about axes and signs of the Doppler log, and the sequence with the axes put right."""
    imu, calibration = sequence.imu, sequence.calibration
    if gravity_warning(
        imu.specific_force, calibration.imu.mounting, calibration.gravity_m_s2
    ):
        return [], sequence  # the IMU's axes come first
    found = match_axes(imu, sequence.dvl, calibration)
    if found is None or found.is_as_read:
        return [], sequence
    axes = found.axes
    body_R_dvl = calibration.dvl.mounting.pose().rotation().matrix()
    if not found.is_vertical_sure and np.linalg.det(axes) < 0:
        motion = BodyMotion.of(turned_dvl(sequence, axes))
        depth = (
            None
            if motion is None
            else compared(turned_dvl(sequence, axes), motion, DEPTH)
        )
        if (
            depth is not None
            and depth.gain.is_known
            and depth.gain.value + 4 * depth.gain.sigma < 0
        ):
            axes = np.diag([1.0, 1.0, -1.0]) @ axes
    wrong = f"velocity changes as the IMU measures, {found.ratio:.2g} times closer, about the axes ({found.names()})"
    driver = body_R_dvl.T @ axes @ body_R_dvl
    if np.linalg.det(axes) > 0:
        rpy = Rotation.from_matrix(axes @ body_R_dvl).as_euler("ZYX")[::-1]
        line = f"`dvl.mounting.rpy_rad = {numbers(rpy, 4)}` {IN_CALIBRATION}"
        wrong += (
            ": the Doppler log is turned on the vehicle, or the driver has other axes"
        )
    else:
        names = [
            f'"{"-" if row.sum() < 0 else ""}{"xyz"[int(np.argmax(np.abs(row)))]}"'
            for row in np.round(driver)
        ]
        line = f"`rotation = [{', '.join(names)}]` under [dvl] {IN_LOG_CONFIG}, after which the mounting counts"
        wrong += ": mirrored, the driver gives one axis the wrong sign"
    unknown = Estimate1D(np.nan, np.inf, "wrong axes")
    finding = Finding(
        "DVL axes", unknown, "", f"{wrong}: {line}", acts=True, grave=True
    )
    return [finding], turned_dvl(sequence, axes)


def turned_dvl(sequence: Sequence, axes: Floats) -> Sequence:
    """Sequence with velocities along other axes of the body."""
    R = sequence.calibration.dvl.mounting.pose().rotation().matrix()
    turn = R.T @ axes @ R
    dvl = sequence.dvl
    turned = Dvl(dvl.stamps_ns, dvl.velocity @ turn.T, turn @ dvl.velocity_cov @ turn.T)
    return replace(sequence, dvl=turned)


def motion_findings(right: Sequence, config: LogConfig) -> list[Finding]:
    """Depth, heading, fixes and sightings against the motion of the body, and the gyros' bias about the vertical."""
    motion = BodyMotion.of(right)
    if motion is None:
        return []
    found = list(start_depth_findings(right))
    for check in (DEPTH, RANGE, AZIMUTH):
        match = compared(right, motion, check)
        is_range_wrong = check is AZIMUTH and any(
            f.grave and f.quantity.startswith(RANGE.name) for f in found
        )
        if (
            match is not None and not is_range_wrong
        ):  # the place of a landmark depends on its range
            found += findings_of(check, match, right, config)
    of_heading = list(heading_findings(right, config, motion))
    is_heading_wrong = any(
        finding.quantity == HEADING_SENSE and finding.acts for finding in of_heading
    )
    vertical = vertical_bias(right)
    if vertical is not None and not is_heading_wrong:
        found.append(vertical)
    found += of_heading
    found += position_findings(right, config, motion)
    return found


def tilt_rates(imu: Imu) -> tuple[float, float] | None:
    """Median rates of tilting by the gyros and by the accelerometers, rad/s; None where these tell nothing.

    From second to second gravity turns in the sensor by ``u_k+1 - u_k = -θ x u_k``, and the force also by what
    accelerates the vehicle: the accelerometers' rate is too large, never too small.
    """
    names, first, count = np.unique(
        (imu.stamps_ns - imu.stamps_ns[0]) // NS_PER_S, True, False, True
    )
    force = np.add.reduceat(imu.specific_force, first, axis=0)
    is_next = np.diff(names) == 1
    if (
        np.count_nonzero(is_next) < LEAST_SECONDS
        or not np.isfinite(force).all()
        or not force.any(axis=1).all()
    ):
        return None
    up = force / np.linalg.norm(force, axis=1)[:, None]
    rate = np.add.reduceat(imu.angular_velocity, first, axis=0) / count[:, None]
    rate = rate - np.median(rate, axis=0)  # a bias turns nothing
    by_gyros = np.linalg.norm(np.cross((rate[1:] + rate[:-1]) / 2, up[:-1]), axis=1)
    by_gravity = np.linalg.norm(np.diff(up, axis=0), axis=1)
    return float(np.median(by_gyros[is_next])), float(np.median(by_gravity[is_next]))


def range_changes(sequence: Sequence) -> tuple[float, float] | None:
    """Median change of the range to a landmark between sightings, and by the Doppler log, m; None where few are known.

    With u the direction in which it is seen, `r_j - r_i = -∫ u·v dt`. The noise of ranges makes the first one larger.
    """
    seen, dvl, calibration = sequence.detections, sequence.dvl, sequence.calibration
    rows = np.flatnonzero(np.isfinite(dvl.velocity).all(axis=1))
    if seen is None or len(rows) < MEDIAN_ROWS:
        return None
    dvl_s, t = (
        (stamps_ns - dvl.stamps_ns[rows[0]]) * 1e-9
        for stamps_ns in (dvl.stamps_ns[rows], seen.stamps_ns)
    )
    body_v = dvl.velocity[rows] @ calibration.dvl.mounting.pose().rotation().matrix().T
    body_v = median_filter(body_v, size=(MEDIAN_ROWS, 1))  # outliers would add up
    steps = (body_v[1:] + body_v[:-1]) / 2 * np.diff(dvl_s)[:, None]
    path = np.vstack([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    ids, is_sound = (
        seen.most_probable()[0],
        seen.are_sound() & (t >= 0) & (t <= dvl_s[-1]),
    )
    ahead = np.column_stack(
        [np.cos(seen.azimuth_rad), np.sin(seen.azimuth_rad), np.zeros(len(seen))]
    )
    u = ahead @ calibration.sonar.mounting.pose().rotation().matrix().T
    measured, by_dvl = [], []
    for landmark_id in np.unique(ids[is_sound & (ids >= 0)]).tolist():
        rows = np.flatnonzero(is_sound & (ids == landmark_id))
        later = rows[
            np.minimum(np.searchsorted(t[rows], t[rows] + PAIR_S), len(rows) - 1)
        ]
        pairs = (t[later] - t[rows] >= PAIR_S) & (t[later] - t[rows] <= LONGEST_PAIR_S)
        i, j = rows[pairs], later[pairs]
        moved = np.column_stack(
            [np.interp(t[j], dvl_s, p) - np.interp(t[i], dvl_s, p) for p in path.T]
        )
        measured += np.abs(seen.range_m[j] - seen.range_m[i]).tolist()
        by_dvl += np.abs(np.einsum("ka,ka->k", moved, (u[i] + u[j]) / 2)).tolist()
    if len(measured) < FEWEST_PAIRS:
        return None
    return max(float(np.median(measured)), calibration.sonar.range_sigma_m), float(
        np.median(by_dvl)
    )


def _exceeded_by_few(vectors: Floats) -> float:
    """Length that one in twenty vectors exceeds, so that spikes do not count."""
    lengths = _lengths(vectors)
    return float(np.percentile(lengths, HIGH_PERCENTILE)) if len(lengths) else 0.0


def _lengths(vectors: Floats) -> Floats:
    """Lengths of the finite rows."""
    return np.asarray(np.linalg.norm(vectors[np.isfinite(vectors).all(axis=1)], axis=1))


LONGEST_S = 600.0
"""Longest part compared, in the middle of the log; 240 s take about 1 s."""
LEAST_OFFSET_S = 0.01
LEAST_YAW_RAD = np.radians(0.25)
LEAST_SCALE = 0.002
LARGE_OFFSET_S, LARGE_SCALE = 0.2, 0.05
"""Beyond these the Doppler log contradicts the accelerometers so much that results are doubtful."""
LEAST_HEADING_RAD = np.radians(1.0)
"""Smaller errors are hidden by others."""
LARGEST_DENSITY_RATIO = 1.5
"""Ratio to the calibration's density, either way, from which on a line is advised."""
LARGEST_RESTING_M_S = 0.1
FROM_DRIVE = "from the turns of the drive"


def check_sensors(sequence: Sequence, config: LogConfig | None = None) -> list[Finding]:
    """Findings in the order in which to act; wrong units alone, since they spoil the rest.

    Parameters
    ----------
    sequence
        As a run would read it.
    config
        Log configuration of the reading; corrections are added to it.

    Examples
    --------
    >>> from sonar_graph.diagnosis import check_sensors
    >>> from sonar_graph.testing import small_world
    >>> [finding.quantity for finding in check_sensors(small_world()) if finding.acts]
    []
    """
    config = config or LogConfig()
    if faults := wrong_units(sequence, config):
        return faults
    axes, sequence = axes_finding(sequence)
    imu, dvl = sequence.imu, sequence.dvl
    first_ns, last_ns = (
        max(imu.stamps_ns[0], dvl.stamps_ns[0]),
        min(imu.stamps_ns[-1], dvl.stamps_ns[-1]),
    )
    spare_ns = (int(last_ns - first_ns) - round(LONGEST_S * NS_PER_S)) // 2
    if spare_ns > 0:
        ends = int(first_ns) + spare_ns, int(last_ns) - spare_ns
        inner_imu, inner_dvl = imu.between(*ends), dvl.between(*ends)
        if inner_imu is not None and inner_dvl is not None:
            imu, dvl = inner_imu, inner_dvl
    match = match_dvl_to_imu(imu, dvl, sequence.calibration)
    of_dvl = dvl_findings(match, sequence, config)
    lever = lever_findings(match, sequence.calibration)
    right = corrected_sequence(sequence, match, of_dvl)
    tilt = find_start_tilt(right)
    bias = bias_findings(*surest_bias(match, tilt), sequence.calibration.imu)
    by_motion = motion_findings(right, config)
    if any(
        f.quantity.startswith("gyro bias about") and f.estimate.is_known
        for f in by_motion
    ):
        bias = [f for f in bias if f.estimate.is_known or f.acts]
    found = [
        *axes,
        *of_dvl,
        *lever,
        *bias,
        *by_motion,
        *reference_findings(right, config, tilt),
    ]
    return worst_first([*found, *noise_findings(sequence)])


def dvl_findings(
    found: DvlMatch, sequence: Sequence, config: LogConfig
) -> list[Finding]:
    """Time offset, mounting yaw and scale of the DVL."""
    turns = matters(found.yaw, LEAST_YAW_RAD)
    scales = matters(replace(found.scale, value=found.scale.value - 1), LEAST_SCALE)
    yaw_advice = scale_advice = NO_NEED
    if turns:
        rpy = numbers(turned_mounting(sequence.calibration.dvl, found.yaw.value), 4)
        yaw_advice = (
            f"turn the DVL's mounting: `dvl.mounting.rpy_rad = {rpy}` {IN_CALIBRATION}"
        )
    if scales:
        scale = config.number("dvl", "scale", 1.0) * found.scale.value
        scale_advice = f"scale the DVL's velocities: `scale = {scale:.4f}` under [dvl] {IN_LOG_CONFIG}"
    offset = _offset("DVL against IMU", found.offset, sequence.imu, "dvl", config)[0]
    is_late = offset.acts and abs(offset.estimate.value) > LARGE_OFFSET_S
    is_turned = turns and abs(found.yaw.value) > LARGE_TURN_RAD
    is_scaled = scales and abs(found.scale.value - 1) > LARGE_SCALE
    return [
        replace(offset, grave=is_late),
        Finding(
            "DVL mounting yaw", in_degrees(found.yaw), "°", yaw_advice, turns, is_turned
        ),
        Finding("DVL scale", found.scale, "", scale_advice, scales, is_scaled),
    ]


def corrected_sequence(
    sequence: Sequence, match: DvlMatch, of_dvl: list[Finding]
) -> Sequence:
    """Sequence with the advised changes: stamps, yaw and scale of the DVL, lever arm, sigma of the gyro bias."""
    late, turned, scaled = (finding.acts for finding in of_dvl)
    dvl, calibration = sequence.dvl, with_fitted(match, sequence.calibration)
    shift_ns = round(match.offset.value * NS_PER_S) if late else 0
    velocity = dvl.velocity * (match.scale.value if scaled else 1.0)
    if turned:
        rpy = turned_mounting(calibration.dvl, match.yaw.value)
        mounting = calibration.dvl.mounting.model_copy(update={"rpy_rad": rpy})
        section = calibration.dvl.model_copy(update={"mounting": mounting})
        calibration = calibration.model_copy(update={"dvl": section})
    moved = Dvl(dvl.stamps_ns + shift_ns, velocity, dvl.velocity_cov)
    return replace(sequence, dvl=moved, calibration=calibration)


def surest_bias(
    match: DvlMatch, tilt: StartTilt
) -> tuple[Estimates3D, tuple[str, str, str]]:
    """Gyro bias of the whole drive or of a rest, whichever is more certain on each axis, and its source."""
    still = tilt.gyro_bias() or match.gyro_bias
    pairs = [
        (a, tilt.said)
        if tilt.is_rest and (not b.is_known or a.sigma < b.sigma)
        else (b, FROM_DRIVE)
        for a, b in zip(still, match.gyro_bias, strict=True)
    ]
    (x, of_x), (y, of_y), (z, of_z) = pairs
    return (x, y, z), (of_x, of_y, of_z)


def reference_findings(
    right: Sequence, config: LogConfig, tilt: StartTilt
) -> Iterator[Finding]:
    """Time offset and first headings of the reference, and the start; its line has the heading of the reference."""
    start = right.calibration.start
    reference = right.true_poses
    if reference is None:
        yield from tilt_findings(tilt, start, start.rpy_rad[2])
        return
    found = match_reference_to_imu(right.imu, reference, right.calibration)
    row, offset = _offset(
        "reference against IMU", found.offset, right.imu, "truth", config
    )
    yield row
    jump = in_degrees(found.start_heading)
    acts = matters(found.start_heading, LEAST_HEADING_RAD)
    advice = (
        "the reference begins with a wrong heading: leave its beginning out with `--start`"
        if acts
        else NO_NEED
    )
    yield Finding("first headings of the reference: error", jump, "°", advice, acts)
    is_compared = offset.is_known and start != Start()
    heading = find_start_heading(right, reference, offset) if is_compared else None
    yield from tilt_findings(
        tilt,
        start,
        heading.rpy_rad[2] if heading and heading.acts else start.rpy_rad[2],
    )
    if heading:
        yield heading.finding(tilt)


def noise_findings(sequence: Sequence) -> Iterator[Finding]:
    """Noise densities of gyro and accelerometer, where the DVL confirms the rest: a steady drive can be as quiet."""
    found, imu = noise_densities(sequence.imu), sequence.calibration.imu
    stamps_ns = sequence.imu.stamps_ns[longest_rest(sequence.imu)]
    during = (
        sequence.dvl.between(int(stamps_ns[0]), int(stamps_ns[-1]))
        if len(stamps_ns)
        else None
    )
    speed = (
        0.0
        if during is None
        else float(np.median(np.linalg.norm(during.velocity, axis=1)))
    )
    rest = f"from {found.still_s:.0f} s of rest"
    known = {
        "gyro noise density": (
            "gyro_noise_density",
            found.gyro,
            imu.gyro_noise_density,
            "rad/s/√Hz",
        ),
        "accelerometer noise density": (
            "accel_noise_density",
            found.accel,
            imu.accel_noise_density,
            "m/s²/√Hz",
        ),
    }
    for quantity, (field, estimate, given, unit) in known.items():
        if estimate.is_known and speed > LARGEST_RESTING_M_S:
            estimate = replace(
                estimate,
                reason=f"{found.still_s:.0f} s are steady, but at {speed:.1f} m/s",
            )
        ratio = (
            max(estimate.value / given, given / estimate.value)
            if estimate.value > 0 and given > 0
            else np.inf
        )
        acts = (
            matters(replace(estimate, value=estimate.value - given), 0.0)
            and ratio > LARGEST_DENSITY_RATIO
        )
        advice = f"{rest}; the calibration's {given:.2g} fits, no need to act"
        if acts:
            advice = f"{rest}, not the calibration's {given:.2g}: `imu.{field} = {estimate.value:.2g}` {IN_CALIBRATION}"
        yield Finding(quantity, estimate, unit, advice, acts)


def _offset(
    quantity: str, offset: Estimate1D, imu: Imu, role: str, config: LogConfig
) -> tuple[Finding, Estimate1D]:
    """Row for a time offset, and the offset with the uncertainty of the instant that an IMU sample stands for."""
    interval_s = (
        float(np.median(np.diff(imu.stamps_ns))) / NS_PER_S if len(imu) > 1 else 0.0
    )
    offset = replace(
        offset, sigma=float(np.hypot(offset.sigma, interval_s / np.sqrt(12)))
    )
    total_s = config.number(role, "stamp_offset_s", 0.0) + offset.value
    acts = matters(offset, LEAST_OFFSET_S)
    advice = f"shift its stamps: `stamp_offset_s = {total_s:.3f}` under [{role}] {IN_LOG_CONFIG}"
    return Finding(
        f"{quantity}: time offset", offset, "s", advice if acts else NO_NEED, acts
    ), offset
