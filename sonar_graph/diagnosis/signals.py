"""Two signals of one quantity: gain, lag and scatter of one against the other.

A sensor's signal y and a reference x that other sensors give, real, or complex for a level plane, over stretches of
some minutes each. With the lag tau of y, an offset a per stretch and a drift b of the reference per second::

    y(t) = a + c x(t - tau) + b (t - t_0) + e,    c = 1 and tau = 0 where both sensors are right

A wrong sense is ``c < 0``, a wrong unit or scale is ``|c|``, a turned world is ``arg c``, a stuck sensor is ``c = 0``.
tau minimises the squares of e over a grid and is refined by one Gauss-Newton step. Rows far from the fit are left out.
Errors of successive rows are alike, so that covariances are of blocks of rows, six or a dozen in each stretch (a sandwich)::

    cov(p) = (A^H A)^-1 sum_blocks (A_k^H e_k)(A_k^H e_k)^H (A^H A)^-1 n / (n - p)

docs/theory/sensor_check.md.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.diagnosis.findings import ACTING_SIGMAS, unknown
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.alignment import Estimate1D

Values = NDArray[np.floating | np.complexfloating]
LAGS_S = np.arange(-4.0, 4.01, 0.25)
FAR_LAGS_S = np.arange(-120.0, 120.01, 0.5)
"""Of a sensor on another clock, such as GPS time without its leap seconds."""
NO_LAG = np.zeros(1)
FAR_ROWS = 600
FAR_MISFIT = 0.05
FAR_GAIN = 0.1
FAR_APART_S = 5.0
FAR_SHARE = 0.3
"""Of the log."""
BLOCKS = (12, 6)
"""Numbers of blocks of a stretch; the larger variance counts."""
FEWEST_ROWS = 8
ROUNDS = 4
SOFT_ROUNDS = 4
"""Rounds before them in which rows count less the farther they are; not of many candidates, for their cost."""
OUTLYING = 6.0
"""Rows beyond so many robust sigmas of the fit are left out."""
MOST_OUTLYING = 0.25
LAG_STEP_S = 0.05
CLEARLY_BETTER = 1.5
"""Ratio of sums of squares from which on another lag, or the mirrored reference, counts."""
BEYOND_DOUBT = 10.0
"""Sigmas of a cause from which on `A_PART` of what is left over need be its own: a slow vehicle's noise hides it."""
A_PART = 1.2
WILD = 5.0
"""Median deviations from the rows about it, three to four sigmas, beyond which a row may be wild."""
MOST_WILD = 0.1
"""Share of rows up to which wild ones are single wrong rows."""
STEP_ROWS = 3
STEP_SIGMAS = 10.0
"""Far beyond the largest of a long log's differences by noise, also where it has heavy tails."""
LEAST_STEP = 4.0
"""In sigmas of a row: a coarse sensor has no typical difference."""
MOST_STEPS = 5
SMALL_SAMPLE = 1.2
"""Quantile of Student's t for a dozen blocks over that of the normal distribution, between 2 and 4 sigma."""


@dataclass(frozen=True, eq=False)
class SignalStretch:
    """Rows of a sensor and its reference over some minutes."""

    seconds: Floats
    """Shape (n,)."""
    y: Values
    """Shape (n,)."""
    reference: Callable[[Floats], Values]
    """x at times of any shape; NaN where it is not known."""
    has_offset: bool = True
    """False for changes, which have none."""
    slow_sigma: float = 0.0
    """Error of the reference that changes as slowly as the motion: of a sensor without noise, the residuals hide it."""
    beside: Callable[[Floats], Values] | None = None
    """What else may move the sensor, shape (n, q), by the table of checks."""

    @property
    def x(self) -> Values:
        """Reference at the rows, shape (n,)."""
        return self.shifted(np.zeros(1))[0]

    def excess(self) -> "SignalStretch":
        """What the sensor has beyond its reference, ``y - x``, as a signal of its own."""
        return replace(self, y=self.y - self.x)

    def thinned(self, most: int) -> "SignalStretch":
        """The same with so many rows, or a few more."""
        every = max(1, len(self.seconds) // most)
        return replace(self, seconds=self.seconds[::every], y=self.y[::every])

    def delayed(self, lag_s: float) -> "SignalStretch":
        """The same with a reference that comes later."""
        return replace(self, reference=lambda t: self.reference(t - lag_s))

    def shifted(self, lags_s: Floats) -> Values:
        """Reference at the rows for each lag, shape (k, n)."""
        at = self.seconds - lags_s[:, None]
        return np.broadcast_to(self.reference(at), at.shape)

    def slope(self, lag_s: float) -> Values:
        """Derivative of x by time at the rows, shape (n,)."""
        before, after = self.shifted(lag_s + LAG_STEP_S * np.array([1.0, -1.0]))
        return (after - before) / (2 * LAG_STEP_S)


@dataclass(frozen=True, eq=False)
class Match:
    """Result of the comparison."""

    gain: Estimate1D
    """``|c|``, with the sign of c for real signals."""
    angle: Estimate1D
    """``arg c``, rad, of complex signals."""
    lag: Estimate1D
    """Of the sensor, s: its rows come so much too late."""
    scatter: float = np.nan
    """Root mean square of e, of the rows that fit."""
    moved: float = np.nan
    """Root mean square of the reference about what the fit leaves open: its mean, and its slope where it drifts."""
    misfit: float = 0.0
    """Share of y's squares that the reference does not explain."""
    rate: float = 0.0
    """Root mean square of the sensor's change a second."""
    is_mirrored: bool = False
    """True where the conjugate of the reference fits."""
    stretches: tuple[SignalStretch, ...] = ()
    """What was compared."""
    whole: tuple[SignalStretch, ...] = ()
    """The same in one piece for each part of the log."""
    interval_s: float = 0.0
    """Between rows of the reference, where it is an integral that counts as even there."""

    def in_time(self) -> "Match":
        """The same with the sensor's delay taken off what is in one piece."""
        lag_s = self.lag.value if self.lag.is_known else 0.0
        return replace(self, whole=tuple(one.delayed(lag_s) for one in self.whole))

    def less_certain(self, sigma: float) -> "Match":
        """The same with an error of the gain by what the comparison leaves out."""
        whole = np.hypot(self.gain.sigma, sigma)
        return replace(self, gain=replace(self.gain, sigma=whole))

    @classmethod
    def unknown(cls, reason: str) -> "Match":
        """A comparison that could not be made."""
        nothing = unknown(reason)
        return cls(nothing, nothing, nothing)


@dataclass(frozen=True, eq=False)
class RobustFit:
    """Least squares of one stretch for k candidates of the reference at once."""

    A: Values
    """Columns of the reference, of the offset and of the drift, shape (k, n, p)."""
    p: Values
    """Coefficients, shape (k, p)."""
    inverse: Values
    """Of the information, shape (k, p, p)."""
    residuals: Values
    """Shape (k, n); zero where the reference is not known."""
    usable: NDArray[np.bool_]
    """Rows with a reference, shape (k, n)."""
    kept: NDArray[np.bool_]
    """Rows that fit, shape (k, n)."""

    @classmethod
    def of(
        cls,
        columns: Values,
        stretch: SignalStretch,
        drift_sigma: float,
        fitting: NDArray[np.bool_] | bool = True,
    ) -> "RobustFit":
        """Fit columns of the reference, shape (k, n, q), and what drifts, without outlying rows.

        ``fitting``: rows to begin with, which another fit has kept, shape (k, n).
        """
        t = stretch.seconds - stretch.seconds.mean()
        slow = [np.ones_like(t)] * stretch.has_offset + [t] * (drift_sigma > 0)
        nuisance = np.reshape(slow, (len(slow), len(t))).T
        shape = (len(columns), *nuisance.shape)
        A = np.concatenate([columns, np.broadcast_to(nuisance, shape)], axis=2)
        usable = np.isfinite(A).all(axis=2) & np.isfinite(stretch.y)
        A = np.where(usable[:, :, None], A, 0.0)
        # the far origin of a map grid would cost digits
        offset = np.nanmean(stretch.y) if stretch.has_offset else 0.0
        y = np.where(usable, stretch.y - offset, 0.0)
        kept = usable & fitting
        weights = kept.astype(np.float64)
        prior = np.zeros(len(A))
        soft_rounds = SOFT_ROUNDS if len(columns) == 1 else 0
        for k in range(soft_rounds + ROUNDS):
            AH = np.swapaxes((A * weights[:, :, None]).conj(), 1, 2)  # (k, p, n)
            information = AH @ A
            information[:, -1, -1] += prior
            inverse = np.linalg.pinv(information, hermitian=True)
            p = (inverse @ AH @ y[:, :, None])[:, :, 0]
            residuals = np.where(usable, y - (A @ p[:, :, None])[:, :, 0], 0.0)
            size = np.abs(residuals)
            if drift_sigma > 0:
                # a drift counts in units of what the fit leaves
                variance = np.mean(
                    size**2, axis=1, where=kept | ~kept.any(axis=1)[:, None]
                )
                prior = np.maximum(variance, 1e-24) / drift_sigma**2
            known = np.where(usable | ~usable.any(axis=1)[:, None], size, np.nan)
            robust = 1.5 * np.nanmedian(known, axis=1)
            robust = np.maximum(robust, 1e-12)[:, None]
            near = usable & (size <= OUTLYING * robust)
            fewest = (1 - MOST_OUTLYING) * usable.sum(axis=1)
            is_most = near.sum(axis=1) >= fewest
            # where so many are far the model is wrong, not the rows
            kept = np.where(is_most[:, None], near, usable)
            # far rows among few hide each other: at first they only count less
            soft = robust / np.maximum(size, robust)
            weights = soft * (usable & fitting) if k < soft_rounds else kept
        return cls(A, p, inverse, residuals, usable, kept)

    @property
    def rows(self) -> Ints:
        """Number of rows with a reference of each candidate, shape (k,); 0 where they are too few."""
        rows = self.usable.sum(axis=1)
        return np.where(rows < FEWEST_ROWS, 0, rows)

    @property
    def squares(self) -> Floats:
        """Sum of squares of each candidate, shape (k,), in which a far row counts as the farthest that fits."""
        size = np.abs(self.residuals)
        limit = np.max(size, axis=1, where=self.kept, initial=0.0)
        squares = np.sum(np.minimum(size, limit[:, None]) ** 2, axis=1)
        return np.where(self.rows > 0, squares, 0.0)

    def sigmas(self) -> Floats:
        """Standard deviations of the first candidate's coefficients, by blocks of rows, shape (p,)."""
        rows = self.kept[0]
        scores = self.A[0, rows].conj() * self.residuals[0, rows, None]  # (m, p)
        p = scores.shape[1]
        variances = list[Floats]()
        # errors that last longer than a short block show in the longer ones
        for count in BLOCKS:
            blocks = np.array_split(scores, count)
            sums = np.array([block.sum(axis=0) for block in blocks])
            small_sample = count / max(count - p, 1)
            meat = sums.T @ sums.conj() * small_sample
            cov = self.inverse[0] @ meat @ self.inverse[0].conj().T
            variances.append(np.abs(np.diag(cov)))
        return SMALL_SAMPLE * np.sqrt(np.max(variances, axis=0))


def match(
    stretches: list[SignalStretch], drift_sigma: float = 0.0, lags_s: Floats = LAGS_S
) -> Match:
    """Compare a sensor with its reference.

    ``drift_sigma``: how fast the reference may drift, in its unit a second; 0: not at all. ``lags_s``: those that are tried,
    0 among them; `NO_LAG` where none is to be found.
    """
    is_plane = any(np.iscomplexobj(s.y) for s in stretches)
    squares = np.zeros((1 + is_plane, len(lags_s)))
    rows = np.zeros_like(squares)
    for stretch in stretches:
        x = stretch.shifted(lags_s)
        candidates = np.concatenate([x, x.conj()] if is_plane else [x])
        found = RobustFit.of(candidates[:, :, None], stretch, drift_sigma)
        squares += found.squares.reshape(squares.shape)
        rows += found.rows.reshape(squares.shape)
    mean_squares = np.where(rows > 0, squares / np.maximum(rows, 1), np.inf)
    now = int(np.argmin(np.abs(lags_s)))
    if not rows[0, now]:
        return Match.unknown("too few rows beside its reference")
    least = mean_squares.min(axis=1)
    # a straight way is its own mirror image, turned: the other sense must be far better
    is_mirrored = is_plane and bool(least[-1] * CLEARLY_BETTER**2 < least[0])
    of_lags = mean_squares[int(is_mirrored)]
    best = int(np.argmin(of_lags))
    # a vehicle that circles fits as well half a turn later
    if of_lags[best] * CLEARLY_BETTER > of_lags[now]:
        best = now
    find_lag = len(lags_s) > 1
    return refined(stretches, drift_sigma, float(lags_s[best]), is_mirrored, find_lag)


def far_lags(found: Match) -> list[Estimate1D]:
    """Delays with which a sensor on another clock agrees with its reference, s, the best first; nothing without any.

    Ways that repeat fit at several times, of which two are enough to see that the best is not sure.
    """
    thinned = [one.thinned(FAR_ROWS) for one in found.whole]
    duration_s = max((float(np.ptp(one.seconds)) for one in found.whole), default=0.0)
    # most rows must have a reference then
    lags_s = FAR_LAGS_S[np.abs(FAR_LAGS_S) < FAR_SHARE * duration_s]
    fitting = list[Estimate1D]()
    limit = found.scatter / CLEARLY_BETTER**2
    while len(lags_s) and len(fitting) < 2:
        far = match(thinned, lags_s=lags_s)
        is_alike = not far.is_mirrored and far.misfit < FAR_MISFIT
        is_right = is_alike and abs(far.gain.value - 1.0) < FAR_GAIN
        if not (is_right and far.scatter < limit):
            break
        fitting.append(far.lag)
        lags_s = lags_s[np.abs(lags_s - far.lag.value) > FAR_APART_S]
        limit = far.scatter * CLEARLY_BETTER**2
    return fitting


def refined(
    stretches: list[SignalStretch],
    drift_sigma: float,
    lag_s: float,
    is_mirrored: bool,
    find_lag: bool,
) -> Match:
    """Fits about the best lag, with the derivative by the lag; means of the stretches by their certainty."""
    gains = list[tuple[float, float]]()
    angles = list[tuple[float, float]]()
    lags = list[tuple[float, float]]()
    residuals = list[Values]()
    for stretch in stretches:
        x = stretch.shifted(np.array([lag_s]))[0]
        columns = np.column_stack([x, stretch.slope(lag_s)] if find_lag else [x])
        # one candidate: the grid has chosen the lag and the sense
        columns = (columns.conj() if is_mirrored else columns)[None]  # (1, n, p)
        found = RobustFit.of(columns[:, :, :1], stretch, drift_sigma)
        if find_lag:
            # a far row with a large slope would make a delay of its own
            found = RobustFit.of(columns, stretch, drift_sigma, found.kept)
        if not found.rows[0]:
            continue
        c = found.p[0, 0]
        sigmas = found.sigmas()
        moved = root_mean_square([moved_in(stretch, has_drift=drift_sigma > 0)])
        sigmas[0] = np.hypot(sigmas[0], stretch.slow_sigma / max(moved, 1e-9))
        size = max(abs(c), 1e-12)
        gains.append((abs(c) if np.iscomplexobj(c) else float(c), sigmas[0]))
        angles.append((float(np.angle(c)), sigmas[0] / size))
        if find_lag:
            # the coefficient of the derivative is -c tau
            step_s = -float(np.real(found.p[0, 1] * np.conj(c))) / size**2
            lags.append((lag_s + step_s, sigmas[1] / size))
        residuals.append(found.residuals[0, found.kept[0]])
    if not gains:
        return Match.unknown("too few rows beside its reference")
    scatter = root_mean_square(residuals)
    signal = root_mean_square([centred(s.y, s) for s in stretches])
    return Match(
        weighted(gains),
        weighted(angles),
        weighted(lags) if find_lag else unknown("not estimated"),
        scatter,
        root_mean_square([moved_in(s, has_drift=drift_sigma > 0) for s in stretches]),
        scatter**2 / max(signal**2, 1e-24),
        root_mean_square([s.slope(0.0) for s in stretches]),
        is_mirrored,
        tuple(stretches),
    )


@dataclass(frozen=True, eq=False)
class Explained:
    """Fit of ``y - x = a + A q + B p + e`` with one q for all stretches; B has the columns that count in any case."""

    q: Values
    """Shape (q,)."""
    sigmas: Floats
    """Shape (q,)."""
    before: float
    """Root mean square of what is left without A, of the rows that fit."""
    after: float
    """Root mean square of e, the same."""

    @property
    def is_clear(self) -> bool:
        """True where the columns surely count, and most of what was left over is theirs; beyond doubt, a part of it."""
        size = float(np.linalg.norm(self.q / np.maximum(self.sigmas, 1e-12)))
        share = self.before / max(self.after, 1e-12)
        is_sure = size > ACTING_SIGMAS and share > CLEARLY_BETTER
        return is_sure or (size > BEYOND_DOUBT and share > A_PART)


def explained(
    stretches: Iterable[SignalStretch],
    columns: Callable[[SignalStretch], Values],
    wanted: int,
) -> Explained | None:
    """What the first ``wanted`` columns, shape (n, q), explain of a sensor beyond its reference and the other columns.

    None where some stretch is too short.
    """
    values = list[Values]()
    precisions = list[Floats]()
    before = list[Values]()
    after = list[Values]()
    for stretch in stretches:
        excess = stretch.excess()
        A = columns(stretch)  # (n, q)
        is_wanted = np.arange(A.shape[1]) < wanted
        without = RobustFit.of(np.where(is_wanted, 0.0, A)[None], excess, 0.0)
        fit = RobustFit.of(A[None], excess, 0.0)
        if not fit.rows[0]:
            return None
        values.append(fit.p[0, :wanted])
        precisions.append(np.maximum(fit.sigmas()[:wanted], 1e-12) ** -2)
        # of the same rows, so that an outlier is not what was explained
        before.append(without.residuals[0, fit.kept[0]])
        after.append(fit.residuals[0, fit.kept[0]])
    if not values:
        return None
    weights = np.array(precisions)  # (stretches, q)
    total = np.sum(weights, axis=0)
    mean = np.sum(weights * np.array(values), axis=0) / total
    sigmas = 1.0 / np.sqrt(total)
    return Explained(mean, sigmas, root_mean_square(before), root_mean_square(after))


class SignalStep(NamedTuple):
    """A change from one row to the next that stays."""

    seconds: float
    """Time of the first row after it."""
    size: float
    """Without its sign."""


def steps(
    seconds: Floats,
    y: Values,
    x: Values,
    sigma: float,
    ratio: float,
    doubt: Floats | None = None,
) -> list[SignalStep]:
    """Steps of a sensor y beyond its reference x, shape (n,) or (n, k) both; nothing where there are many.

    The difference of the medians of `STEP_ROWS` rows of ``y - x`` on either side of an instant is beyond `STEP_SIGMAS`
    of its own typical size, and beyond `LEAST_STEP` of ``sigma``, that of a row; so is that of three times as many. A
    vehicle that stops and goes shows a wrong scale in steps: those of x must be smaller by a ``ratio``.

    ``doubt``: by how much x may be wrong at each row, shape (n,); NaN counts as 0.
    """
    beyond = as_columns(y - x)
    known = np.isfinite(beyond).all(axis=1)
    t = seconds[known]
    excess = beyond[known]
    near = median_changes(excess, STEP_ROWS)
    wide = median_changes(excess, 3 * STEP_ROWS)
    size = np.minimum(near, wide)
    # what drifts away changes by three times as much
    size[near < wide / 2] = 0.0
    size[size < ratio * median_changes(as_columns(x)[known], STEP_ROWS)] = 0.0
    if doubt is not None:
        size[size < np.nan_to_num(doubt[known])] = 0.0
    typical = float(np.median(near)) if len(t) > FEWEST_ROWS else np.inf
    least = max(STEP_SIGMAS * typical, LEAST_STEP * sigma, 1.5 * resolution(y[known]))
    found = list[SignalStep]()
    while len(size) and size.max() > least:
        k = int(np.argmax(size))
        found.append(SignalStep(float(t[k]), float(size[k])))
        if len(found) > MOST_STEPS:
            return []
        size[max(k - 3 * STEP_ROWS, 0) : k + 3 * STEP_ROWS] = 0.0
    return sorted(found)


def are_wild(rows: Floats, least: float) -> NDArray[np.bool_]:
    """Rows, shape (n, 3), far from the median of five about them, shape (n,): Hampel's filter.

    The scale is the median deviation of the five, or that of all rows or ``least`` where these are larger: rows at rest
    agree by chance. A wild row is also nearer to neither neighbour than they are to each other: a vehicle that begins to
    turn is not wild.
    The second time wild rows are as the median, so that of two beside each other both are found.
    """
    steady = rows.copy()
    is_wild = np.zeros(len(rows), dtype=np.bool_)
    for _ in range(2):
        found, middle = wild_rows(steady, least)
        steady[found] = middle[found]
        is_wild |= found
    return is_wild


def wild_rows(rows: Floats, least: float) -> tuple[NDArray[np.bool_], Floats]:
    """Rows that are wild beside their neighbours, shape (n,), and the medians of five, shape (n, 3)."""
    padded = np.pad(rows, ((2, 2), (0, 0)), mode="reflect")
    five = np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0)  # (n, 3, 5)
    middle = np.median(five, axis=2)
    off = np.abs(rows - middle)
    scatter = np.median(np.abs(five - middle[:, :, None]), axis=2)
    usual = np.median(off, axis=0)
    scale = np.maximum(np.maximum(scatter, usual), least)
    is_far = np.linalg.norm(off / scale, axis=1) > WILD
    beside = np.pad(rows, ((1, 1), (0, 0)), mode="reflect")
    before = beside[:-2]
    after = beside[2:]
    nearest = np.minimum(
        np.linalg.norm(rows - before, axis=1),
        np.linalg.norm(rows - after, axis=1),
    )
    is_alone = nearest > np.linalg.norm(after - before, axis=1)
    return is_far & is_alone, np.asarray(middle)


def resolution(y: Values) -> float:
    """Typical change of a sensor whose rows mostly repeat; 0 of others."""
    moves = np.linalg.norm(np.diff(as_columns(y), axis=0), axis=1)
    is_move = moves > 0.0
    is_coarse = is_move.any() and np.mean(is_move) < 0.5
    return float(np.median(moves[is_move])) if is_coarse else 0.0


def as_columns(values: Values) -> Floats:
    """A real or complex signal, shape (n,), or columns as they are, as real columns, shape (n, k)."""
    if values.ndim > 1:
        return np.asarray(values, np.float64)
    return np.column_stack([values.real, values.imag])


def median_changes(e: Floats, rows: int) -> Floats:
    """Length of the difference of medians after and before each row, shape (n,); 0 near the ends."""
    size = np.zeros(len(e))
    if len(e) >= 2 * rows:
        windows = np.lib.stride_tricks.sliding_window_view(e, rows, axis=0)
        medians = np.median(windows, axis=2)  # (n - rows + 1, k)
        change = medians[rows:] - medians[:-rows]
        size[rows : rows + len(change)] = np.linalg.norm(change, axis=1)
    return size


def centred(values: Values, stretch: SignalStretch) -> Values:
    """Values about their mean, but for changes."""
    known = values[np.isfinite(values)]
    has_mean = stretch.has_offset and len(known)
    return values - known.mean() if has_mean else values


def moved_in(stretch: SignalStretch, *, has_drift: bool) -> Values:
    """Reference at the rows about its mean, or about a line, shape (n,)."""
    x = stretch.x
    if not has_drift:
        return centred(x, stretch)
    known = np.isfinite(x)
    if np.count_nonzero(known) < FEWEST_ROWS:
        return x * np.nan
    t = stretch.seconds - stretch.seconds.mean()
    line = np.polynomial.Polynomial.fit(t[known], x[known], 1)
    return x - line(t)


def root_mean_square(parts: list[Values]) -> float:
    """Of the finite values of all parts; NaN without any."""
    values = np.concatenate(parts)
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.abs(values) ** 2))) if len(values) else np.nan


def weighted(estimates: list[tuple[float, float]]) -> Estimate1D:
    """Mean weighted by inverse variances; its sigma includes the scatter between stretches."""
    values, sigmas = np.array(estimates).T
    # a stretch without noise must not have all of the weight
    weights = 1.0 / np.maximum(sigmas, 1e-9) ** 2
    mean = float(weights @ values / weights.sum())
    scatter = float(weights @ (values - mean) ** 2) / max(len(values) - 1, 1)
    return Estimate1D(mean, np.sqrt(max(scatter, 1.0) / weights.sum()))
