"""Units of velocities, rates and forces, where the values as configured are implausible for a vehicle.

A common factor must make them plausible. A slow vehicle's rates in degrees can pass for rates in radians: no finding is
no proof. docs/theory/sensor_check.md.
"""

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import median_filter

from sonar_graph.diagnosis.findings import (
    IN_CALIBRATION,
    IN_LOG_CONFIG,
    Finding,
    Findings,
    contradiction,
    judged,
    scale_line,
)
from sonar_graph.diagnosis.sightings import sighting_pairs
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import NS_PER_S, Floats, Imu
from sonar_graph.navigation.alignment import Estimate1D
from sonar_graph.numerics import columns_at, running_integral
from sonar_graph.sequence import Sequence

FASTEST_M_S = 20.0
"""Implausible over the bottom for a twentieth of a log."""
FASTEST_TURN_RAD_S = 2.0
"""Implausible for a twentieth of a log, 115 degrees a second."""
DVL_UNIT = "DVL: unit"
WRONG_UNIT = "wrong unit"
SPEEDS = {"cm/s": 1e-2, "mm/s": 1e-3}
"""Factor to m/s."""
FORCES = {"g": 9.80665, "mg": 9.80665e-3, "cm/s²": 1e-2, "mm/s²": 1e-3}
"""Factor to m/s²; mg and cm/s² differ by a fiftieth, so that the nearest counts."""
SHARE_OF_GRAVITY = 0.2
"""Relative difference allowed between a typical specific force and gravity."""
MOST_OF_GRAVITY = 2.0
"""Beyond it, either way, it is another unit, or forces without gravity."""
LEAST_FORCE_SCALE = 0.015
"""Gravity differs by 0.5 % over the Earth, and what accelerates a vehicle adds little."""
SWELLS_S = 20
"""Seconds over which a swell averages out."""
LARGE_FORCE_SCALE = 0.1
"""From here on gaps of the Doppler log are bridged with an error of a metre after two seconds."""
USUAL_SPEED_M_S = 3.0
MEDIAN_ROWS = 9
LARGEST_RANGE_RATIO = 10.0
"""Changes of range by the Doppler log over those measured: 1 but for noise and turns, 100 in cm/s."""
COARSE_SIGMAS = 5.0
FEWEST_CHANGES = 5
STEP_TOLERANCE = 0.01
HIGH_PERCENTILE = 95.0
LEAST_SECONDS = 30
LEAST_TILTING_RAD_S = 0.02
LARGEST_TILT_RATIO = 10.0
"""Tilting by gyros over that by gravity: below 1 in rad/s but for the gyros' noise, up to 57 in degrees."""


def wrong_units(sequence: Sequence, config: LogConfig) -> Findings:
    """Velocities, rates and specific forces in an implausible unit; the configured scales enter the lines."""
    checks = (velocity_unit, rate_unit, force_unit)
    return [finding for check in checks for finding in check(sequence, config)]


def coarse_findings(sequence: Sequence) -> Findings:
    """Velocities and rates that come in steps far above their stated noise, rounded or cut by a driver.

    Where noise is above the step of a sensor, rows differ and means are right. Else a cut towards zero takes half of a
    step off most rows.
    """
    calibration = sequence.calibration
    if calibration.odometry_interpolation != "linear":
        return []
    imu = sequence.imu
    interval_s = float(np.median(np.diff(imu.stamps_ns))) / NS_PER_S
    gyro_sigma = calibration.imu.gyro_noise_density / np.sqrt(max(interval_s, 1e-9))
    dvl_sigma = max(calibration.dvl.velocity_sigma_m_s)
    of_dvl = "`dvl.velocity_sigma_m_s = [{0:.2g}, {0:.2g}, {0:.2g}]`"
    of_gyro = "`imu.gyro_bias_sigma = {0:.2g}`"
    rows = [
        ("DVL", "m/s", sequence.dvl.velocity, dvl_sigma, of_dvl),
        ("gyro", "rad/s", imu.angular_velocity, gyro_sigma, of_gyro),
    ]
    if sequence.depth is not None:
        z_m = sequence.depth.z_m[:, None]
        of_depth = "`depth.sigma_m = {0:.2g}`"
        rows.append(("depth", "m", z_m, calibration.depth.sigma_m, of_depth))
    found = Findings()
    for name, unit, values, sigma, line in rows:
        step = coarse_step(values)
        if step / 2 > COARSE_SIGMAS * sigma:
            finding = contradiction(
                f"{name}: resolution",
                f"values come in steps, most rows repeat, and the stated noise of {sigma:.2g} is far below: rounded or "
                "cut by the driver",
                f"record all digits, or state {line.format(step / 2)} {IN_CALIBRATION}",
                Estimate1D(step, 0.0),
                unit,
                f"an error of {step / 2:.2g} typically where they are cut",
            )
            found.append(finding)
    return found


def coarse_step(values: Floats) -> float:
    """Largest step of the axes on which most of the rows, shape (n, k), repeat the one before; 0 without such an axis."""
    coarsest = 0.0
    for column in np.abs(np.diff(values, axis=0)).T:
        changes = column[column > 0]
        if FEWEST_CHANGES <= len(changes) < len(column) / 2:
            step = float(changes.min())
            multiples = changes / step
            # noise of a sensor that stood still has no step in common
            if np.abs(multiples - np.round(multiples)).max() < STEP_TOLERANCE:
                coarsest = max(coarsest, step)
    return coarsest


def velocity_unit(sequence: Sequence, config: LogConfig) -> Iterator[Finding]:
    """Speeds that no vehicle has, or that change ranges to landmarks far too much."""
    speed_m_s = exceeded_by_few(sequence.dvl.velocity)
    measured_m, by_dvl_m = range_changes(sequence) or (1.0, 0.0)
    is_far = by_dvl_m > LARGEST_RANGE_RATIO * measured_m
    if not (speed_m_s > FASTEST_M_S or is_far):
        return
    # the largest unit in which the vehicle is no faster than usual
    slow = [unit for unit in SPEEDS if speed_m_s * SPEEDS[unit] <= USUAL_SPEED_M_S]
    unit = slow[0] if slow else "mm/s"
    scale = config.number("dvl", "scale", 1.0) * SPEEDS[unit]
    why = f"up to {speed_m_s:.3g} m/s"
    if is_far:
        why += f"; ranges to landmarks change by {measured_m:.3g} m, by them by {by_dvl_m:.3g} m"
    line = f"`scale = {scale:.4g}` under [dvl] {IN_LOG_CONFIG}"
    if speed_m_s > FASTEST_M_S and unit != "mm/s":
        line += f"; mm/s if the vehicle moves at {speed_m_s * SPEEDS['mm/s']:.2g} m/s"
    cause = f"velocities look {1 / SPEEDS[unit]:.0f} times too large ({why}): {unit}?"
    yield contradiction(DVL_UNIT, cause, line, WRONG_UNIT)


def rate_unit(sequence: Sequence, config: LogConfig) -> Iterator[Finding]:
    """Rates that no vehicle has, or that tilt it far more than gravity does in the accelerometers."""
    rate_rad_s = exceeded_by_few(sequence.imu.angular_velocity)
    by_gyros, by_gravity = tilt_rates(sequence.imu) or (0.0, 0.0)
    if rate_rad_s > FASTEST_TURN_RAD_S:
        doubt = f"57 times too large (up to {rate_rad_s:.3g} rad/s)"
    elif by_gyros > max(LEAST_TILTING_RAD_S, LARGEST_TILT_RATIO * by_gravity):
        doubt = f"too large (they tilt the vehicle by {by_gyros:.2g} rad/s, gravity by {by_gravity:.2g})"
    else:
        return
    scale = config.number("imu", "angular_velocity_scale", 1.0) * np.radians(1.0)
    yield contradiction(
        "gyro: unit",
        f"rates look {doubt}: degrees a second?",
        f"`angular_velocity_scale = {scale:.5g}` under [imu] {IN_LOG_CONFIG}",
        WRONG_UNIT,
    )


def force_unit(sequence: Sequence, config: LogConfig) -> Iterator[Finding]:
    """Typical specific forces that are gravity in another unit."""
    forces = sequence.imu.specific_force
    forces = forces[np.isfinite(forces).all(axis=1)]
    if not len(forces):
        return
    typical = float(np.median(np.linalg.norm(forces, axis=1)))
    gravity = sequence.calibration.gravity_m_s2
    # of units that differ little the nearest counts
    unit = min(FORCES, key=lambda unit: abs(typical * FORCES[unit] - gravity))
    if abs(typical * FORCES[unit] / gravity - 1) > SHARE_OF_GRAVITY:
        return
    scale = config.number("imu", "linear_acceleration_scale", 1.0) * FORCES[unit]
    yield contradiction(
        "accelerometer: unit",
        f"specific forces are typically {typical:.4g} instead of {gravity:.4g} m/s²: {unit}?",
        f"`linear_acceleration_scale = {scale:.6g}` under [imu] {IN_LOG_CONFIG}",
        WRONG_UNIT,
    )


def force_scale(sequence: Sequence, config: LogConfig) -> Finding | None:
    """Typical specific force over gravity; None where the accelerometers do not measure gravity.

    Of means over a second, since a hull that shakes makes single forces longer, and of `SWELLS_S` of these: a swell of a
    few seconds, which meets the seconds at few phases, moves a median of them by some hundredths.
    """
    is_measured = np.isfinite(sequence.imu.specific_force).all(axis=1)
    seconds = sequence.imu.stamps_ns[is_measured] // NS_PER_S
    _, first, count = np.unique(seconds, return_index=True, return_counts=True)
    sums = np.add.reduceat(sequence.imu.specific_force[is_measured], first, axis=0)
    forces = np.linalg.norm(sums / count[:, None], axis=1)
    if not len(forces):
        return None
    swells = np.array_split(forces, max(len(forces) // SWELLS_S, 1))
    gravity = sequence.calibration.gravity_m_s2
    typical = float(np.median([np.mean(swell) for swell in swells]))
    if not 1 / MOST_OF_GRAVITY < typical / gravity < MOST_OF_GRAVITY:
        return None
    # acceleration across gravity makes a force longer by a^2 / 2 g; that along it shows its size
    across = np.median([np.var(swell) for swell in swells]) / gravity**2
    sigma = float(np.hypot(sequence.calibration.imu.accel_bias_sigma / gravity, across))
    scale = Estimate1D(typical / gravity, sigma)
    row = Finding(
        "accelerometer scale",
        scale,
        cause=f"specific forces are typically {typical:.4g} instead of {gravity:.4g} m/s²",
        line=scale_line("imu", "linear_acceleration_scale", config, scale.value),
    )
    error = scale.minus(1.0)
    return judged(row, error, LEAST_FORCE_SCALE, large=LARGE_FORCE_SCALE)


def tilt_rates(imu: Imu) -> tuple[float, float] | None:
    """Median rates of tilting by the gyros and by the accelerometers, rad/s; None where these show nothing.

    From second to second gravity turns in the sensor by ``u_k+1 - u_k = -θ x u_k``, and the force also by what
    accelerates the vehicle: the accelerometers' rate is too large, never too small.
    """
    seconds = (imu.stamps_ns - imu.stamps_ns[0]) // NS_PER_S
    names, first, count = np.unique(seconds, return_index=True, return_counts=True)
    force = np.add.reduceat(imu.specific_force, first, axis=0)
    # seconds without a sample are no neighbours
    is_next = np.diff(names) == 1
    is_measured = np.isfinite(force).all() and force.any(axis=1).all()
    if np.count_nonzero(is_next) < LEAST_SECONDS or not is_measured:
        return None
    # over a second what accelerates a vehicle is small beside gravity
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
    seen = sequence.detections
    dvl = sequence.dvl
    if seen is None or len(dvl) < MEDIAN_ROWS:
        return None
    origin_ns = dvl.stamps_ns[0]
    dvl_s = (dvl.stamps_ns - origin_ns) / NS_PER_S
    t = (seen.stamps_ns - origin_ns) / NS_PER_S
    # gyros may be wrong too, so that only the Doppler log moves the vehicle here
    pairs = sighting_pairs(seen, t, dvl_s[-1])
    if pairs is None:
        return None
    i, j = pairs.T
    calibration = sequence.calibration
    v = dvl.velocity @ calibration.dvl.mounting.rotation_matrix().T
    v = median_filter(v, size=(MEDIAN_ROWS, 1))  # outliers would add up
    path = running_integral(dvl_s, v)
    moved = columns_at(t[j], dvl_s, path) - columns_at(t[i], dvl_s, path)
    azimuth = seen.azimuth_rad
    ahead = np.column_stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth])
    u = ahead @ calibration.sonar.mounting.rotation_matrix().T
    by_dvl = np.abs(np.einsum("ka,ka->k", moved, (u[i] + u[j]) / 2))
    measured = np.abs(seen.range_m[j] - seen.range_m[i])
    least = calibration.sonar.range_sigma_m
    # the range of a landmark abeam hardly changes: a change below the noise does not count
    return max(float(np.median(measured)), least), float(np.median(by_dvl))


def exceeded_by_few(vectors: Floats) -> float:
    """Length that one in twenty vectors exceeds, so that spikes do not count."""
    return float(np.percentile(np.linalg.norm(vectors, axis=1), HIGH_PERCENTILE))
