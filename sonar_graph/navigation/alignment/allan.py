"""Noise density of a still sensor, by the overlapping Allan deviation.

With means over tau, ``y_i``, of a signal sampled every dt, m = tau / dt and N samples::

    sigma^2(tau) = 1 / (2 (N - 2 m + 1)) sum_i (y_{i+m} - y_i)^2

White noise of root spectral density N has ``sigma(tau) = N / sqrt(tau)``: at one second the deviation is the density
(IEEE Std 952). How far it can be trusted follows from the equivalent degrees of freedom of overlapping estimates of
white noise (W. J. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065, 2008, table 5)::

    edf = [3 (N' - 1) / (2 m) - 2 (N' - 2) / N'] 4 m^2 / (4 m^2 + 5),    N' = N + 1
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats, Imu, Ints
from sonar_graph.navigation.alignment.time_offset import Estimate1D

TAU_S = 1.0
SHORT_TAU_S = 0.25
LARGEST_SLOW = 1.5
"""Ratio of the densities at both times beyond which the slower part is motion; 1 for white noise."""
LEAST_STILL_S = 30.0
WINDOW_S = 1.0
GYRO_MOTION_RAD_S = 0.005
ACCEL_MOTION_M_S2 = 0.05
"""Change of the mean from one second to the next that is no rest, on top of five times that of noise."""
QUIET_SHARE = 0.1
LARGEST_SPREAD = 1.5
"""Largest spread within a second at rest, in units of that of the quietest tenth of all seconds."""


@dataclass(frozen=True)
class NoiseDensities:
    """Noise densities of the noisiest gyro and accelerometer axis."""

    still_s: float
    """Length of the longest rest, which the densities are from."""
    gyro: Estimate1D
    """rad/s/√Hz."""
    accel: Estimate1D
    """m/s²/√Hz."""


def allan_deviation(samples: Floats, together: int) -> Floats:
    """Overlapping Allan deviation of each of (n, columns) over means of ``together`` samples, shape (columns,)."""
    before_first = np.zeros((1, samples.shape[1]))
    # (n + 1, columns)
    sums = np.cumsum(np.concatenate([before_first, samples]), axis=0)
    # means over every window, each a sample later than the one before
    means = (sums[together:] - sums[:-together]) / together
    steps = means[together:] - means[:-together]
    return np.sqrt(0.5 * np.mean(steps**2, axis=0))


def degrees_of_freedom(count: int, together: int) -> float:
    """Equivalent degrees of freedom of the overlapping deviation of white noise, over ``together`` samples."""
    n = count + 1  # N' of the module's equation
    m = together
    by_means = 3 * (n - 1) / (2 * m)
    by_ends = 2 * (n - 2) / n
    return (by_means - by_ends) * 4 * m**2 / (4 * m**2 + 5)


def density(samples: Floats, rate_hz: float) -> Estimate1D:
    """Root spectral density at one second of the noisiest of (n, columns) readings of a still sensor.

    Unknown where all are equal: no sensor is without noise, and an estimator would trust such a density. Unknown too
    where the density at `SHORT_TAU_S` is clearly smaller: a vehicle that floats moves slowly, and noise is white.
    """
    if not np.ptp(samples, axis=0).any():
        return Estimate1D.unknown(
            "the same to the last bit while still: commanded, or too coarse for its noise"
        )
    found = dict[float, Estimate1D]()
    for tau_s in (TAU_S, SHORT_TAU_S):
        together = max(1, round(tau_s * rate_hz))
        # white noise of density N has the deviation N / sqrt(tau)
        deviation = float(allan_deviation(samples, together).max())
        value = deviation * np.sqrt(together / rate_hz)
        freedom = degrees_of_freedom(len(samples), together)
        found[tau_s] = Estimate1D(value, value / np.sqrt(2 * freedom))
    whole = found[TAU_S]
    if whole.value > LARGEST_SLOW * found[SHORT_TAU_S].value:
        return replace(whole, reason="never quite still: slow motion, not noise")
    return whole


def noise_densities(imu: Imu) -> NoiseDensities:
    """Noise densities from the longest rest in a log, if it is long enough."""
    rest = longest_rest(imu)
    seconds = (imu.stamps_ns[rest] - imu.stamps_ns[0]) * 1e-9
    still_s = float(seconds[-1] - seconds[0]) if len(seconds) > 1 else 0.0
    if still_s < LEAST_STILL_S:
        moving = Estimate1D.unknown(f"never still for {LEAST_STILL_S:g} s")
        return NoiseDensities(still_s, moving, moving)
    rate_hz = (len(seconds) - 1) / still_s
    force = imu.specific_force[rest]
    gyro = density(imu.angular_velocity[rest], rate_hz)
    if not np.isfinite(force).all():
        return NoiseDensities(still_s, gyro, Estimate1D.unknown("no accelerometers"))
    return NoiseDensities(still_s, gyro, density(force, rate_hz))


def longest_rest(imu: Imu) -> slice:
    """The longest run of rows in which the means over a second hardly change."""
    since_ns = imu.stamps_ns - imu.stamps_ns[0]
    second = (since_ns * (1e-9 / WINDOW_S)).astype(np.int64)
    names, first, count = np.unique(second, return_index=True, return_counts=True)
    still = _steady(imu.angular_velocity, first, count, GYRO_MOTION_RAD_S)
    if np.isfinite(imu.specific_force).all():
        still &= _steady(imu.specific_force, first, count, ACCEL_MOTION_M_S2)
    still[1:] &= np.diff(names) == 1  # a hole in the log is no rest
    bordered = np.concatenate([[0], still.astype(int), [0]])
    edges = np.flatnonzero(np.diff(bordered))  # where rest begins and ends, in turn
    if not len(edges):
        return slice(0, 0)
    begins = edges[::2]
    ends = edges[1::2]
    longest = int(np.argmax(ends - begins))
    begin = begins[longest]
    last = ends[longest] - 1
    return slice(int(first[begin]), int(first[last] + count[last]))


def _steady(
    values: Floats, first: Ints, count: Ints, least: float
) -> NDArray[np.bool_]:
    """True for seconds that vary no more than the quietest, and whose mean is near that of the second before."""
    means = np.add.reduceat(values, first, axis=0) / count[:, None]
    squares = np.add.reduceat(values**2, first, axis=0) / count[:, None]
    spread = np.sqrt(np.maximum(squares - means**2, 0.0))
    quiet = np.quantile(spread, QUIET_SHARE, axis=0)
    steps = np.abs(np.diff(means, axis=0, prepend=means[:1]))
    near = steps <= least + 5.0 * quiet * np.sqrt(2.0 / np.median(count))
    return (near & (spread <= LARGEST_SPREAD * quiet + least)).all(axis=1)
