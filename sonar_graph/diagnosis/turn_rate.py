"""Turn rate of the gyros against accelerometers and Doppler log, which show it where a moving vehicle turns.

In the frame of the gyros' path, C its turn, v the velocity of the body and g the felt gravity::

    d(C v)/dt = C dv/dt + C (w x v),    r = mean(C f) - d(C v)/dt - g

Over stretches of half a minute g is constant but for the tilt that the gyros' bias adds up to. r is noise where the
gyros are right. A rate about the vertical that is wrong by d leaves ``d |v|`` across the level velocity, and nothing
along it, which makes the part along it the measure of the noise. So ``(w x v) . across`` by the gyros is compared with
``(w x v + r) . across``, which does not depend on their rate about the vertical.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sonar_graph.diagnosis.findings import (
    ACTING_SIGMAS,
    Finding,
    contradiction,
    matters,
    scale_line,
)
from sonar_graph.diagnosis.motion_signals import UP_OVER_S, BodyMotion
from sonar_graph.diagnosis.signals import (
    CLEARLY_BETTER,
    NO_LAG,
    Match,
    match,
    root_mean_square,
)
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import NS_PER_S, Floats
from sonar_graph.numerics import columns_at, running_integral
from sonar_graph.sequence import Sequence

GRAVITY_OVER_S = 30.0
"""Time over which gravity is a line in the frame of the gyros' path."""
LEAST_SPEED_M_S = 0.2
"""Level speed below which a turn bends no path."""
FEWEST_ROWS = 20
LEAST_NOISE_M_S = 0.01
LARGEST_SCALE_SIGMA = 0.05
"""Of the Doppler log's scale along the velocity, up to which it is divided out."""
LARGEST_SCALE = 0.2
"""Deviation of that scale beyond which it is wrong."""
UNKNOWN_SCALE = 0.05
"""Sigma of that scale where the speed is too even to show it."""
NOISE_RATIO = 3.0
"""Accelerations over `UP_OVER_S` by the Doppler log are so many of its sigmas off, with what the hull swings."""
SCATTERED = 2.0
"""Scatter in sigmas of such accelerations, from which on the rates are no multiple of the right ones."""
MOST_MISFIT = 0.15
"""Share of the rate's changes that goes with it."""
OTHER_RATE = 1.3
"""Ratio of the rates, either way, from which on the gyros are wrong, not the speed of sound."""
LEAST_EXCESS = 1.5
"""Root mean square of r across the velocity over that along it. Waves and a noisy log make both alike."""
LARGEST_GAIN_SIGMA = 0.12
VERTICAL_FACTORS = (0.5, 2.0)
"""Tried beside the inverse of the gain, which turns that are far too large spoil."""
TURN_RATE = "gyro rate about the vertical over that by the other sensors"


class TurnMatch(NamedTuple):
    """The comparison, and the size of what contradicts it beside that of the noise."""

    match: Match
    excess: float
    """Root mean square of r across the level velocity over that along it."""


def turn_match(motion: BodyMotion) -> TurnMatch | None:
    """Acceleration across the velocity by the gyros' rate, over that by all sensors; None without gravity or motion.

    A scale of the Doppler log's velocities shows along the velocity too, and is divided out where it is known.
    """
    felt = motion.felt
    if felt is None:
        return None
    t = motion.seconds
    up = felt.gravity_m_s2 / np.linalg.norm(felt.gravity_m_s2, axis=1)[:, None]
    level = felt.velocity_m_s - np.sum(felt.velocity_m_s * up, 1)[:, None] * up
    speed_m_s = np.linalg.norm(level, axis=1)
    along = level / np.maximum(speed_m_s, 1e-9)[:, None]
    across = np.cross(up, along)
    r = residual(motion, felt.gravity_m_s2)  # (n, 3)
    r[speed_m_s <= LEAST_SPEED_M_S] = np.nan
    if np.count_nonzero(np.isfinite(r).all(axis=1)) < FEWEST_ROWS:
        return None
    # a wrong rate leaves nothing along the velocity, so that this part is noise
    noise = max(root_mean_square([np.sum(r * along, axis=1)]), 1e-12)
    excess = root_mean_square([np.sum(r * across, axis=1)]) / noise
    # over the windows of the forces
    turned = running_integral(t, np.cross(felt.rate_rad_s, felt.velocity_m_s))
    by_rate = felt.windows.rates(lambda at: columns_at(at, t, turned))
    changed = felt.windows.rates(lambda at: columns_at(at, t, felt.velocity_m_s))
    # what the Doppler log alone measures: the change of velocity in the body
    by_velocity = changed - by_rate
    found = gain_along(motion, by_rate, r, across)
    of_scale = gain_along(motion, by_velocity, r, along).gain
    of_scale = of_scale.limited(LARGEST_SCALE_SIGMA, "even speed")
    # gyros that are wrong spoil that comparison too
    is_scale = abs(of_scale.value - 1.0) < LARGEST_SCALE
    unsure = UNKNOWN_SCALE
    if of_scale.is_known and is_scale:
        ratio = replace(found.gain, value=found.gain.value / of_scale.value)
        found = replace(found, gain=ratio)
        unsure = abs(ratio.value) * of_scale.sigma
    return TurnMatch(found.less_certain(unsure), excess)


def turn_rate_finding(sequence: Sequence, config: LogConfig) -> Finding | None:
    """Rate about the vertical that accelerometers and Doppler log contradict; None: it is right, or cannot be found.

    A scale is one that the data bear out: with it the contradiction is gone. Without one the rate counts as wrong only
    where r is larger across the velocity than along it.
    """
    compared = rate_match(sequence)
    if compared is None:
        return None
    found = compared.match
    is_wrong = is_contradicted(found, sequence)
    is_off = matters(found.gain.minus(1.0), 0.0)
    if not (is_wrong or (is_off and compared.excess > LEAST_EXCESS)):
        return None
    row = contradiction(
        TURN_RATE,
        estimate=found.gain,
        line="",
        cause=f"accelerometers and Doppler log turn otherwise ({100 * found.misfit:.0f} % is left): rates about the "
        "vertical are dead, clipped, filtered or of another scale",
        consequence="headings and positions are wrong from the first turn on",
    )
    # factors that drivers get wrong, tried before any other scale
    rate_hz = NS_PER_S / float(np.median(np.diff(sequence.imu.stamps_ns)))
    causes = {
        rate_hz: "angles between two samples, not rates?",
        np.radians(1.0): "degrees?",
        np.degrees(1.0): "radians that were converted twice?",
    }
    for factor, why in causes.items() if is_wrong else ():
        right = rate_match(scaled_gyros(sequence, factor * np.eye(3)))
        if right and is_borne_out(right.match, sequence):
            cause = f"accelerometers and Doppler log turn otherwise: {why}"
            line = scale_line("imu", "angular_velocity_scale", config, 1.0 / factor)
            return replace(row, cause=cause, line=line)
    for factor in (1.0 / found.gain.value, *VERTICAL_FACTORS):
        right = rate_match(scaled_gyros(sequence, np.diag([1.0, 1.0, factor])))
        if right is None or not is_borne_out(right.match, sequence):
            continue
        # what the line leaves is clearly less than what was there
        if right.match.scatter * CLEARLY_BETTER < found.scatter:
            cause = f"accelerometers and Doppler log turn {factor:.2g} times as fast: the scale of the gyro along z is wrong"
            return replace(row, cause=cause)
    return row if is_wrong and compared.excess > LEAST_EXCESS else None


def rate_match(sequence: Sequence) -> TurnMatch | None:
    """The comparison of a sequence, where the vehicle turns enough; None: it does not."""
    motion = BodyMotion.of(sequence)
    found = None if motion is None else turn_match(motion)
    if found is None or not found.match.gain.is_known:
        return None
    return found if found.match.moved > noise_m_s2(sequence) else None


def noise_m_s2(sequence: Sequence) -> float:
    """Of an acceleration by the Doppler log."""
    velocity_m_s = max(*sequence.calibration.dvl.velocity_sigma_m_s, LEAST_NOISE_M_S)
    return NOISE_RATIO * velocity_m_s / UP_OVER_S


def is_contradicted(found: Match, sequence: Sequence) -> bool:
    """True where the rate is surely another one; a rate with the opposite sign is that of other axes."""
    gain = found.gain
    is_sure = matters(replace(gain, value=abs(gain.value) - 1.0), 0.0)
    is_other = is_sure and not 1 / OTHER_RATE < abs(gain.value) < OTHER_RATE
    is_scattered = found.scatter > SCATTERED * noise_m_s2(sequence)
    is_opposite = gain.value + ACTING_SIGMAS * gain.sigma < 0
    return not is_opposite and (
        is_other or (is_scattered and found.misfit > MOST_MISFIT)
    )


def is_borne_out(found: Match, sequence: Sequence) -> bool:
    """True where the rate is surely near the right one, and only noise is left: beside huge rates all else is little."""
    gain = found.gain.limited(LARGEST_GAIN_SIGMA, "too little turning")
    is_near = 1 / OTHER_RATE < gain.value < OTHER_RATE
    is_noise = found.scatter < SCATTERED * noise_m_s2(sequence)
    return gain.is_known and is_near and is_noise


def scaled_gyros(sequence: Sequence, scales: Floats) -> Sequence:
    """Sequence with rates of the body times a matrix, shape (3, 3)."""
    imu = sequence.imu
    body_R_imu = sequence.calibration.imu.mounting.rotation_matrix()
    rate = imu.angular_velocity @ (body_R_imu.T @ scales @ body_R_imu).T
    return replace(sequence, imu=replace(imu, angular_velocity=rate))


def gain_along(
    motion: BodyMotion, by_sensor: Floats, r: Floats, direction: Floats
) -> Match:
    """An acceleration by one sensor over what it would be without the residual, along a direction, all shape (n, 3)."""
    t = motion.seconds
    y = np.sum(by_sensor * direction, axis=1)
    x = y + np.sum(r * direction, axis=1)
    rows = motion.stretches(t, y, lambda at: np.interp(at, t, x))
    return match(rows, lags_s=NO_LAG)


def residual(motion: BodyMotion, gravity_m_s2: Floats) -> Floats:
    """Felt gravity about a line in each stretch of `GRAVITY_OVER_S`, shape (n, 3); NaN in stretches with few rows."""
    found = np.full_like(gravity_m_s2, np.nan)
    for part in np.unique(motion.parts):
        rows = np.flatnonzero(motion.parts == part)
        t = motion.seconds[rows]
        count = max(1, int(np.ceil((t[-1] - t[0]) / GRAVITY_OVER_S)))
        for inside in np.array_split(rows, count):
            if len(inside) < FEWEST_ROWS:
                continue
            A = np.vander(motion.seconds[inside] - motion.seconds[inside[0]], 2)
            felt = gravity_m_s2[inside]
            found[inside] = felt - A @ np.linalg.lstsq(A, felt, rcond=None)[0]
    return found
