"""Offset between the clock of sonar images and that of IMU and Doppler log, by the motion that both measure.

For step k between frames the images give the motion ahead and the motion across at the middle range r of the image,
which is what they show best (`sonar_graph.recognition.image_motion`)::

    z_k = (x_k,  y_k + r yaw_k)

IMU and Doppler log give the tangent f_k(s) of the sonar's motion, shape (6,), over the stretch of the step, moved by an
offset s. Each component of z is regressed on that of f which it should be and on those that come through an inclined
floor (`SHOWN`), so that neither the floor nor the sonar's scale need be known. With the residual variances s_c^2(s),

    L(s) = -1/2 sum_c n_c ln(s_c^2(s) / s_c^2(no relation))

is the profile of the likelihood, n_c the number of independent steps: residuals repeat each other (their long-run
variance: Newey and West, Econometrica 55, 1987). An answer counts if it is more likely by `LEAST_NATS` than every other
that is farther away than `APART_S`. Its standard deviation is that of a jackknife over stretches (Tukey 1958): errors
of motion from images last for seconds, and one by independent steps was six times too small on pieces of 10 s.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.measurements import NS_PER_S, Floats
from sonar_graph.recognition.image_motion import PlanarStep
from sonar_graph.recognition.sonar_motion import SonarMotions
from sonar_graph.sequence import Sequence as Run

GRID_NS = NS_PER_S // 20
"""Step of the navigation's motion."""
OFFSET_STEP_S = 0.02
SHOWN = ((3, 1, 5), (2, 4, 0))
"""Components of the tangent (rotation first) that the motion ahead and the motion across are regressed on."""
LEAST_STEPS = 50
"""Measured steps within the navigation that an offset needs."""
LEAST_SHARE = 0.5
"""The same as a share of those of the offset with the most."""
LEAST_NATS = 5.0
APART_S = 1.0
LARGEST_SIGMA_S = 0.5
CLIPPED_AT = 0.98
"""Quantile of the size of the images' motions beyond which they are clipped: a wrong fit must not outweigh the rest."""
OUTLYING = 4.0
"""Robust standard deviations beyond which a step is left out of the final fit."""
LONGEST_LAG = 25
"""Steps over which residuals may repeat each other."""
STRETCHES = 8
"""Stretches of the jackknife."""
UNDETERMINED = "the images do not determine the offset of their clock"
AS_STATED = "state it with --offset SECONDS, to be added to the images' stamps"


@dataclass(frozen=True)
class ClockOffset:
    """Seconds to add to the stamps of the images."""

    seconds: float
    sigma_s: float
    steps: int
    """Steps of the images that were compared."""
    correlations: tuple[float, float]
    """Of the motion ahead and across with that of IMU and Doppler log."""
    nats: float
    """Logarithm of how much more likely it is than the next best."""

    def __str__(self) -> str:
        ahead, across = self.correlations
        return (
            f"{self.seconds:+.3f} s ± {self.sigma_s:.3f} s (1 sigma), from {self.steps} steps between images; "
            f"correlation {ahead:.2f} ahead, {across:.2f} across"
        )


class NavigationMotion:
    """Motion of the sonar by IMU and Doppler log, integrated over time."""

    def __init__(self, sequence: Run, first_ns: int, last_ns: int) -> None:
        motions = SonarMotions(sequence)
        stamps = np.arange(
            max(first_ns, sequence.start_ns), min(last_ns, sequence.end_ns) + 1, GRID_NS
        )
        steps = [motions.at(stamp_ns)[0] for stamp_ns in stamps.tolist()]
        tangents = [
            np.zeros(6) if step is None else gtsam.Pose3.Logmap(step.previous_T_sonar)
            for step in steps
        ]
        self.epoch_ns = int(stamps[0]) if len(stamps) else first_ns
        self._sums = np.cumsum(tangents, axis=0)

    def over(self, start_s: Floats, end_s: Floats) -> Floats:
        """Sums of the tangents over stretches, in seconds after the epoch, shape (n, 6); NaN where not covered."""
        if len(self._sums) < 2:
            return np.full((len(start_s), 6), np.nan)
        return self._until(end_s) - self._until(start_s)

    def _until(self, seconds: Floats) -> Floats:
        """Sums until instants, linear between those of the grid."""
        # linear between the instants of the grid
        place = np.asarray(seconds) * (NS_PER_S / GRID_NS)
        before = np.clip(place.astype(np.intp), 0, len(self._sums) - 2)
        sums = self._sums[before] + (place - before)[:, None] * (
            self._sums[before + 1] - self._sums[before]
        )
        sums[(place < 0) | (place > len(self._sums) - 1)] = np.nan
        return sums


def estimate_offset(
    steps: Sequence[PlanarStep],
    sequence: Run,
    range_m: float,
    around_s: float = 0.0,
    search_s: float = 10.0,
) -> ClockOffset:
    """Offset of the images' clock within ``search_s`` of ``around_s``.

    Parameters
    ----------
    steps
        Motion between images in the plane of the image.
    sequence
        IMU and Doppler log, with the mounting of the sonar.
    range_m
        Middle of the images' window.

    Raises
    ------
    LogError
        When the images do not determine the offset, with the reason.
    """
    known = [step for step in steps if step.is_measured]
    if len(known) < LEAST_STEPS:
        raise LogError(
            f"{UNDETERMINED}: {len(known)} of {len(steps)} steps between them could be measured, and {LEAST_STEPS} are "
            f"needed; {AS_STATED}"
        )
    # the navigation is moved by every offset of the search
    margin_ns = round((abs(around_s) + search_s + 1.0) * NS_PER_S)
    navigation = NavigationMotion(
        sequence, known[0].start_ns - margin_ns, known[-1].end_ns + margin_ns
    )
    start_s, end_s = (
        (np.array([getattr(step, name) for step in known]) - navigation.epoch_ns) * 1e-9
        for name in ("start_ns", "end_ns")
    )
    yaw, x, y = np.array([step.motion for step in known]).T
    # yaw and motion across look alike in an image; their sum at the middle range does not
    z = np.column_stack([x, y + range_m * yaw])
    offsets_s = around_s + np.arange(
        -search_s, search_s + 0.5 * OFFSET_STEP_S, OFFSET_STEP_S
    )

    def moved(offset_s: float) -> Floats:
        return navigation.over(start_s + offset_s, end_s + offset_s)

    counts = np.array([np.isfinite(moved(s)[:, 0]).sum() for s in offsets_s.tolist()])
    # an offset with few common steps may fit by chance
    is_covered = counts >= max(LEAST_STEPS, LEAST_SHARE * counts.max())
    if not is_covered.any():
        raise LogError(
            f"{UNDETERMINED}: within {search_s:g} s of {around_s:+.3f} s fewer than {LEAST_STEPS} steps between them "
            f"lie in IMU and Doppler log; {AS_STATED}"
        )
    likely = np.where(is_covered, 0.0, -np.inf)
    most = np.quantile(np.abs(z), CLIPPED_AT, axis=0)
    # first with clipped motions, to find the outliers of a good fit
    rough = _profile(np.clip(z, -most, most), moved, offsets_s, likely, np.ones(2))
    at_rough = moved(float(offsets_s[np.argmax(rough)]))
    residuals = z - _fitted(z, at_rough)
    # robust standard deviation by the median
    spread = 1.4826 * np.nanmedian(np.abs(residuals), axis=0)
    z = np.where(np.abs(residuals) > OUTLYING * spread, np.nan, z)
    # residuals of neighbouring steps repeat: so many fewer are independent
    repetition = np.array(
        [_repetition(column) for column in (z - _fitted(z, at_rough)).T]
    )
    found = _profile(z, moved, offsets_s, likely, repetition)
    best = int(np.argmax(found))
    # the top may lie beyond the search
    if best in (0, len(found) - 1):
        raise LogError(
            f"{UNDETERMINED}: the likeliest, {offsets_s[best]:+.2f} s, is at the end of the search; give a longer "
            f"--search SECONDS, or {AS_STATED}"
        )
    seconds = _top(offsets_s, found)
    # the stretches of the jackknife differ by less
    near = np.abs(offsets_s - offsets_s[best]) <= APART_S
    sigma_s = _jackknife(z, moved, offsets_s[near])
    nats = float(found[best]) - float(
        found[np.abs(offsets_s - seconds) > APART_S].max(initial=0.0)
    )
    if nats < LEAST_NATS or sigma_s > LARGEST_SIGMA_S:
        raise LogError(
            f"{UNDETERMINED}: {seconds:+.2f} s ± {sigma_s:.2f} s is only exp({nats:.1f}) times as likely as others "
            f"(a steady motion, or images that show it badly); {AS_STATED}"
        )
    fitted = _fitted(z, f := moved(seconds))
    ahead, across = (_correlation(z[:, c], fitted[:, c]) for c in range(2))
    return ClockOffset(
        seconds, sigma_s, int(np.isfinite(f[:, 0]).sum()), (ahead, across), nats
    )


def _profile(
    z: Floats,
    moved: Callable[[float], Floats],
    offsets_s: Floats,
    likely: Floats,
    repetition: Floats,
) -> Floats:
    """Likelihood of each offset in nats over no relation, -inf where it is not covered, shape as ``likely``.

    ``moved``: motion of the navigation with an offset, computed at each call: of all offsets it would fill the
    memory.
    """
    profile = likely.copy()
    for at in np.flatnonzero(np.isfinite(likely)).tolist():
        # -n / 2 ln(1 - r^2) is the log likelihood ratio of a regression
        fitted = _fitted(z, moved(float(offsets_s[at])))
        for c in range(2):
            n = np.isfinite(z[:, c] + fitted[:, c]).sum() / repetition[c]
            profile[at] -= (
                0.5
                * n
                * np.log1p(-(min(_correlation(z[:, c], fitted[:, c]), 0.99999) ** 2))
            )
    return profile


def _top(offsets_s: Floats, profile: Floats) -> float:
    """Offset at the top of the parabola through the highest value and its neighbours."""
    at = int(np.argmax(profile))
    if not 0 < at < len(profile) - 1:
        return float(offsets_s[at])
    before, here, after = profile[at - 1 : at + 2].tolist()
    bend = before - 2 * here + after
    return float(
        offsets_s[at]
        + (0.5 * OFFSET_STEP_S * (before - after) / bend if -np.inf < bend < 0 else 0.0)
    )


def _jackknife(z: Floats, moved: Callable[[float], Floats], offsets_s: Floats) -> float:
    """Standard deviation by leaving out one stretch of the steps after the other."""
    tops = []
    # stretches, not steps: errors of neighbouring steps repeat
    for left_out in np.array_split(np.arange(len(z)), STRETCHES):
        rest = z.copy()
        rest[left_out] = np.nan
        tops.append(
            _top(
                offsets_s,
                _profile(rest, moved, offsets_s, np.zeros(len(offsets_s)), np.ones(2)),
            )
        )
    return float(np.sqrt((STRETCHES - 1) * np.var(tops)))


def _correlation(z: Floats, f: Floats) -> float:
    """Correlation of two columns where both are known; 0 where one of them does not change."""
    known = np.isfinite(z + f)
    z = z[known] - np.mean(z[known])
    f = f[known] - np.mean(f[known])
    scale = float(np.sqrt(np.sum(z**2) * np.sum(f**2)))
    return float(np.sum(z * f)) / scale if scale > 1e-12 else 0.0


def _fitted(z: Floats, f: Floats) -> Floats:
    """Regression of z on f, shape of z; NaN where f is not known."""
    columns = []
    for c, shown in enumerate(SHOWN):
        A = np.column_stack([f[:, list(shown)], np.ones(len(f))])
        known = np.isfinite(z[:, c]) & np.isfinite(A).all(axis=1)
        slopes = np.linalg.lstsq(A[known], z[known, c])[0]
        if slopes[0] < 0:  # ahead is not back
            slopes = np.append(np.zeros(len(shown)), np.mean(z[known, c]))
        columns.append(A @ slopes)
    return np.column_stack(columns)


def _repetition(values: Floats) -> float:
    """Variance of the sum of a series over that of independent values, at least 1."""
    r = np.where(np.isfinite(values), values, 0.0)
    lags = min(LONGEST_LAG, len(r) // 4)
    by_lag = np.array([np.sum(r[lag:] * r[: len(r) - lag]) for lag in range(lags + 1)])
    # weights of Bartlett keep the variance positive (Newey, West 1987)
    weights = 1 - np.arange(1, lags + 1) / (lags + 1)
    return max(1.0, 1 + 2 * float(weights @ by_lag[1:]) / max(float(by_lag[0]), 1e-30))
