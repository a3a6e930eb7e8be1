"""The time offset at which two sensors agree best, with its uncertainty or the reason why it cannot be told.

Over a grid of offsets the data are lined up anew and fitted; around the best one Gauss-Newton steps with the offset as
one more parameter give its value and covariance together with all others. A second place that fits nearly as well, or a
best one at the end of the range, means that the motion does not tell.

Least squares on differences of successive samples, whose noises are unknown and told from the residuals.

A stretch is a run of m differences ``y_k = x_{k+1} - x_k`` over durations T_k, three axes each, with the model::

    y = A p + B n + e,    cov(e) = sigma^2 K
    K = tridiag(-1, 2, -1) + r_1 diag(T) + r_2 T_j T_k min(t_j, t_k)

p is common to all stretches, n is a stretch's own and of no interest. Each sample's white noise enters two successive
differences with opposite signs (the tridiagonal part); white noise of a rate, such as an accelerometer's, enters each
difference with a variance that grows with its duration; a rate that walks from the stretch's beginning, as gravity seen
with a gyro's noise does, correlates all later ones (t is the time of a difference's middle). Taking the differences for
independent would make the parameters look more or less certain than they are.

Not every axis need walk: a tilt turns gravity's two horizontal components and leaves the vertical one as it is. Axes
that do not walk have r_2 = 0 (`Stretch.walks`). Sharing one r_2 among all three would spread the walk of two axes over
three, and slow motion would claim 1.2 times too small a sigma.

The ratios r maximise the restricted likelihood, in which what fitting p and n costs is counted (Harville, JASA 72,
1977)::

    -2 log L = (N - rank) log RSS + sum 3 log|K| + log|B' K^-1 B| + log|A' P A|,    P = K^-1 projected off B

and sigma^2 is ``RSS / (N - rank)``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize

from sonar_graph.measurements import Floats

LOG_RATIO_LIMIT = 12.0
"""Of both ratios, made free of units by the mean duration."""
RANK_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class SampleSeries:
    """Successive differences without a gap."""

    y: Floats
    """Shape (m, 3)."""
    A: Floats
    """Derivative by the common parameters, shape (m, 3, p)."""
    B: Floats
    """Derivative by the stretch's own, shape (m, 3, q)."""
    duration_s: Floats
    """Shape (m,)."""
    walks: tuple[bool, bool, bool] = (True, True, True)
    """Which axes of y walk."""


@dataclass(frozen=True, eq=False)
class LeastSquaresFit:
    """Common parameters and how sure they are."""

    parameters: Floats
    """Shape (p,)."""
    covariance: Floats
    """Shape (p, p)."""
    rss: float
    """Whitened sum of squares, of the prior too, in units of the samples' variance."""
    variance: float
    """sigma², the variance of a sample's noise."""
    ratios: Floats
    """(r_1 in 1/s, r_2 in 1/s³)."""


def fit(stretches: Sequence[SampleSeries], prior_sigmas: Floats, ratios: Floats | None = None) -> LeastSquaresFit:
    """The common parameters.

    Parameters
    ----------
    stretches
        At least one, with more differences in all than parameters.
    prior_sigmas
        Of the common parameters about zero, shape (p,): so wide that they matter only where the data say nothing. A
        parameter whose covariance is the prior's was not seen.
    ratios
        Of the noises; None: told from the data.
    """
    if ratios is None:
        ratios = _likeliest_ratios(stretches, prior_sigmas)
    return _Reduced.of(stretches, ratios).fit(prior_sigmas, ratios)


def rate_noise_power(stretches: Sequence[SampleSeries], ratios: Floats) -> float:
    """Expected whitened product of y with its own rates' noise, over sigma²: ``sum tr(P (K - tridiag(-1, 2, -1)))``.

    A column of A that holds the same noise as y, since it was integrated from the same sensor, shifts the parameters by
    its column of their covariance times this (errors in variables).
    """
    return sum(_rate_noise_power(stretch, ratios) for stretch in stretches)


def _rate_noise_power(stretch: SampleSeries, ratios: Floats) -> float:
    m = len(stretch.y)
    differences = np.diff(np.eye(m + 1), axis=0)
    factors = _factors(stretch, ratios)
    own, _ = _orthonormal(np.concatenate([_whitened(factors[axis], stretch.B[:, axis]) for axis in range(3)]))
    power = 3.0 * m - own.shape[1]
    for axis in range(3):
        of_samples, basis = _whitened(factors[axis], differences), own[axis * m : (axis + 1) * m]
        power -= float(np.sum(of_samples**2) - np.sum((basis.T @ of_samples) ** 2))
    return power


def _factors(stretch: SampleSeries, ratios: Floats) -> list[Floats]:
    """Cholesky factor of K of each axis."""
    kinds = set(stretch.walks)
    by_kind = {walks: np.linalg.cholesky(_correlation(stretch.duration_s, ratios, walks)) for walks in kinds}
    return [np.asarray(by_kind[walks], dtype=np.float64) for walks in stretch.walks]


def _whitened(factor: Floats, columns: Floats) -> Floats:
    return np.asarray(solve_triangular(factor, columns, lower=True, check_finite=False))


def _likeliest_ratios(stretches: Sequence[SampleSeries], prior_sigmas: Floats) -> Floats:
    rate = 1.0 / float(np.concatenate([s.duration_s for s in stretches]).mean())
    units = np.array([rate, rate**3])

    def criterion(logs: Floats) -> float:
        bounded = np.clip(logs, -LOG_RATIO_LIMIT, LOG_RATIO_LIMIT)
        return _Reduced.of(stretches, units * np.exp(bounded)).criterion(prior_sigmas)

    start = np.array([[-2.0, -6.0], [1.0, -6.0], [-2.0, -2.0]])
    best = minimize(
        criterion, start[0], method="Nelder-Mead", options={"initial_simplex": start, "xatol": 0.1, "fatol": 0.02}
    )
    return np.asarray(units * np.exp(np.clip(best.x, -LOG_RATIO_LIMIT, LOG_RATIO_LIMIT)))


@dataclass(frozen=True, eq=False)
class _Reduced:
    """Whitened data of all stretches with their own parameters projected out."""

    AtA: Floats
    Aty: Floats
    yty: float
    freedom: int
    """Rows less the stretches' own parameters."""
    log_determinants: float
    """``sum 3 log|K| + log|B' K^-1 B|``."""

    @classmethod
    def of(cls, stretches: Sequence[SampleSeries], ratios: Floats) -> _Reduced:
        parts = [_reduce(stretch, ratios) for stretch in stretches]
        return cls(
            sum((p.AtA for p in parts[1:]), parts[0].AtA),
            sum((p.Aty for p in parts[1:]), parts[0].Aty),
            sum(p.yty for p in parts),
            sum(p.freedom for p in parts),
            sum(p.log_determinants for p in parts),
        )

    def solve(self, prior_sigmas: Floats) -> tuple[Floats, Floats, float, float]:
        """Parameters, information, sum of squares and sample variance; the prior's weight takes two rounds."""
        count = len(prior_sigmas)
        variance = self.yty / self.freedom
        for _ in range(3):
            information = self.AtA + np.diag(variance / np.square(prior_sigmas))
            parameters = np.asarray(np.linalg.solve(information, self.Aty), dtype=np.float64)
            rss = max(self.yty - float(parameters @ self.Aty), 1e-12 * self.yty + 1e-300)
            variance = rss / max(self.freedom - count, 1)
        return parameters, information, rss, variance

    def criterion(self, prior_sigmas: Floats) -> float:
        _, information, rss, _ = self.solve(prior_sigmas)
        freedom = max(self.freedom - len(prior_sigmas), 1)
        return float(freedom * np.log(rss) + self.log_determinants + np.linalg.slogdet(information)[1])

    def fit(self, prior_sigmas: Floats, ratios: Floats) -> LeastSquaresFit:
        parameters, information, rss, variance = self.solve(prior_sigmas)
        covariance = np.asarray(variance * np.linalg.inv(information), dtype=np.float64)
        return LeastSquaresFit(parameters, covariance, rss, variance, ratios)


def _reduce(stretch: SampleSeries, ratios: Floats) -> _Reduced:
    m, _, p = stretch.A.shape
    columns = np.concatenate([stretch.y[:, :, None], stretch.A, stretch.B], axis=2)
    factors = _factors(stretch, ratios)
    white = np.concatenate([_whitened(factors[axis], columns[:, axis]) for axis in range(3)])
    own, size = _orthonormal(white[:, 1 + p :])
    kept = white[:, : 1 + p] - own @ (own.T @ white[:, : 1 + p])
    squares = kept.T @ kept
    return _Reduced(
        squares[1:, 1:],
        squares[1:, 0],
        float(squares[0, 0]),
        3 * m - own.shape[1],
        2.0 * sum(float(np.log(np.diag(factor)).sum()) for factor in factors) + size,
    )


def _correlation(duration_s: Floats, ratios: Floats, walks: bool) -> Floats:
    """K, shape (m, m)."""
    m = len(duration_s)
    middle = np.cumsum(duration_s) - 0.5 * duration_s
    walk = np.outer(duration_s, duration_s) * np.minimum.outer(middle, middle)
    return np.asarray(
        np.diag(2.0 + ratios[0] * duration_s) - np.eye(m, k=1) - np.eye(m, k=-1) + walks * ratios[1] * walk
    )


def _orthonormal(B: Floats) -> tuple[Floats, float]:
    """A basis of the columns' span, and ``log|B'B|`` over it."""
    if not B.shape[1]:
        return B, 0.0
    U, s, _ = np.linalg.svd(B, full_matrices=False)
    kept = s > RANK_TOLERANCE * max(float(s[0]), 1e-300)
    return U[:, kept], 2.0 * float(np.log(s[kept]).sum())


RANGE_S = 2.0
"""Offsets are looked for from minus to plus this."""
GRID_STEP_S = 0.1
DERIVATIVE_STEP_S = 0.05
"""Long against an IMU sample: the derivative of a single sample is mostly its noise."""
PRIOR_OFFSET_S = 10.0
CLEARLY_WORSE = 16.0
"""Chi-square by which any other minimum must be worse: four sigmas."""
NEIGHBOURHOOD_S = 0.3
ROUNDS = 6
LineUp = Callable[[float], Sequence[SampleSeries]]
"""The data lined up for an offset in seconds."""


@dataclass(frozen=True)
class Estimate1D:
    """One number with its standard deviation, or why it cannot be told."""

    value: float
    sigma: float
    reason: str = ""
    """Why the number cannot be told; empty: it can."""

    @property
    def is_known(self) -> bool:
        """Whether the log tells it."""
        return not self.reason

    def limited(self, sigma_limit: float, reason: str) -> Estimate1D:
        """Cannot be told where it is less certain than some limit."""
        known = self.is_known and self.sigma <= sigma_limit
        return self if known or not self.is_known else replace(self, reason=reason)


@dataclass(frozen=True, eq=False)
class OffsetFit:
    """Offset and the other parameters, with the offset first."""

    fit: LeastSquaresFit
    """Its parameters are corrections that are near zero at the solution, but for the linear ones."""
    offset_s: float
    reason: str
    """Why the offset cannot be told; empty: it can."""

    def offset(self) -> Estimate1D:
        """The offset as a number."""
        return Estimate1D(self.offset_s, float(np.sqrt(self.fit.covariance[0, 0])), self.reason)


def search_offset(line_up: LineUp, prior_sigmas: Floats) -> OffsetFit:
    """The best offset.

    Parameters
    ----------
    line_up
        Gives the data for an offset; the same rows for all of them.
    prior_sigmas
        Of the other common parameters (see `sonar_graph.navigation.alignment.time_offset.fit`), shape (p,).
    """
    grid = np.arange(-RANGE_S, RANGE_S + GRID_STEP_S / 2, GRID_STEP_S)
    lined_up = [line_up(float(offset)) for offset in grid]
    ratios = fit(lined_up[len(grid) // 2], prior_sigmas).ratios
    for _ in range(2):
        fits = [fit(stretches, prior_sigmas, ratios) for stretches in lined_up]
        rss = np.array([f.rss for f in fits])
        best = int(np.argmin(rss))
        ratios = fit(lined_up[best], prior_sigmas).ratios
    reason = _doubt(grid, rss / fits[best].variance, best)
    return _refine(line_up, prior_sigmas, ratios, float(grid[best]), reason)


def _doubt(grid: Floats, chi2: Floats, best: int) -> str:
    if best in (0, len(grid) - 1):
        return f"no best offset within ±{RANGE_S:g} s"
    inner = np.flatnonzero((chi2[1:-1] <= chi2[:-2]) & (chi2[1:-1] <= chi2[2:])) + 1
    others = [i for i in (*inner, 0, len(grid) - 1) if abs(grid[i] - grid[best]) > NEIGHBOURHOOD_S]
    rivals = [i for i in others if chi2[i] - chi2[best] < CLEARLY_WORSE]
    if rivals:
        return f"{grid[best]:+.1f} s and {grid[rivals[0]]:+.1f} s fit as well: too little changes in the motion"
    return ""


def _refine(line_up: LineUp, prior_sigmas: Floats, ratios: Floats, offset_s: float, reason: str) -> OffsetFit:
    """Twice: the noises told on the grid, up to half a step from the best offset, hold motion that is not lined up."""
    limits = offset_s - 2 * GRID_STEP_S, offset_s + 2 * GRID_STEP_S
    sigmas = np.concatenate([[PRIOR_OFFSET_S], prior_sigmas])
    offset_s = _converge(line_up, prior_sigmas, ratios, offset_s, limits).offset_s
    ratios = fit(_with_offset(line_up, offset_s, prior_sigmas, ratios), sigmas).ratios
    return replace(_converge(line_up, prior_sigmas, ratios, offset_s, limits), reason=reason)


def _converge(
    line_up: LineUp, prior_sigmas: Floats, ratios: Floats, offset_s: float, limits: tuple[float, float]
) -> OffsetFit:
    sigmas = np.concatenate([[PRIOR_OFFSET_S], prior_sigmas])
    for _ in range(ROUNDS):
        found = fit(_with_offset(line_up, offset_s, prior_sigmas, ratios), sigmas, ratios)
        step = float(np.clip(found.parameters[0], -GRID_STEP_S, GRID_STEP_S))
        offset_s = float(np.clip(offset_s + step, *limits))
        if abs(step) < 1e-5:
            break
    return OffsetFit(found, offset_s, "")


def _with_offset(line_up: LineUp, offset_s: float, prior_sigmas: Floats, ratios: Floats) -> list[SampleSeries]:
    """The data at an offset, with the derivative of ``y - A p`` by it as a further column in front."""
    here, before, after = (line_up(offset_s + step) for step in (0.0, -DERIVATIVE_STEP_S, DERIVATIVE_STEP_S))
    p = fit(here, prior_sigmas, ratios).parameters
    stretches = []
    for h, b, a in zip(here, before, after, strict=True):
        slope = ((a.y - a.A @ p) - (b.y - b.A @ p)) / (2 * DERIVATIVE_STEP_S)
        stretches.append(replace(h, A=np.concatenate([-slope[:, :, None], h.A], axis=2)))
    return stretches
