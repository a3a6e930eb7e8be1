"""Time offset at which two sensors agree best, with its uncertainty or the reason why it is not known.

Over a grid of offsets the data are lined up again and fitted; Gauss-Newton steps around the best offset give its value
and covariance together with the other parameters. A second minimum that fits nearly as well, or a best offset at the
end of the range, means that the motion does not determine it.

The data are stretches: runs of m differences ``y_k = x_{k+1} - x_k`` over durations T_k, three axes each, with::

    y = A p + B n + e,    cov(e) = sigma^2 K
    K = tridiag(-1, 2, -1) + r_1 diag(T) + r_2 T_j T_k min(t_j, t_k)

p is common to all stretches, n belongs to one and is of no interest. Of two successive differences both hold the sample
between them (tridiagonal part); r_1 is white noise of a rate, r_2 a rate that walks, on the axes `SampleSeries.walks`;
t is the time of a difference's middle. The ratios r maximise the restricted likelihood (Harville, JASA 72, 1977),
sigma^2 is ``RSS / (N - rank)``::

    -2 log L = (N - rank) log RSS + sum 3 log|K| + log|B' K^-1 B| + log|A' P A|,    P = K^-1 projected off B

Derivation and measured coverage: docs/theory/sensor_check.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sonar_graph.measurements import Floats

LEAST_VARIANCE = 1e-18
"""Of a sample, (m/s)²: without noise only the prior makes the information regular."""
LOG_RATIO_LIMIT = 12.0
"""Largest logarithm of either ratio, in units of the mean duration."""
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
    """Common parameters with their covariance and the noise that was found."""

    parameters: Floats
    """Shape (p,)."""
    covariance: Floats
    """Shape (p, p)."""
    rss: float
    """Whitened sum of squares, the prior's included, in units of the samples' variance."""
    variance: float
    """sigma², the variance of a sample's noise."""
    ratios: Floats
    """(r_1 in 1/s, r_2 in 1/s³)."""


def fit(
    stretches: Sequence[SampleSeries],
    prior_sigmas: Floats,
    ratios: Floats | None = None,
) -> LeastSquaresFit:
    """Fit the common parameters.

    ``stretches``: at least one, with more differences in all than parameters. ``prior_sigmas``: of the common
    parameters about zero, shape (p,), so wide that they matter only where the data determine nothing; a parameter whose
    covariance is the prior's was not observed. ``ratios``: of the noises; None: estimated from the data.
    """
    groups = grouped(stretches)
    if ratios is None:
        rate = 1.0 / np.concatenate([s.duration_s for s in stretches]).mean()
        units = np.array([rate, rate**3])

        def bounded(logs: Floats) -> Floats:
            return units * np.exp(np.clip(logs, -LOG_RATIO_LIMIT, LOG_RATIO_LIMIT))

        def criterion(logs: Floats) -> float:
            return NormalEquations.of(groups, bounded(logs)).criterion(prior_sigmas)

        start = np.array([[-2.0, -6.0], [1.0, -6.0], [-2.0, -2.0]])
        from scipy.optimize import minimize  # takes most of a second to load

        best = minimize(
            criterion,
            start[0],
            method="Nelder-Mead",
            options={"initial_simplex": start, "xatol": 0.1, "fatol": 0.02},
        )
        ratios = bounded(best.x)
    normal = NormalEquations.of(groups, ratios)
    parameters, information, rss, variance = normal.solve(prior_sigmas)
    covariance = np.asarray(variance * np.linalg.inv(information), dtype=np.float64)
    return LeastSquaresFit(parameters, covariance, rss, variance, ratios)


def are_enough(stretches: Sequence[SampleSeries], prior_sigmas: Floats) -> bool:
    """Check that `fit` has more differences than parameters, those of each stretch counted."""
    if not stretches:
        return False
    ratios = np.ones(2)  # what is free does not depend on the noise
    normal = NormalEquations.of(grouped(stretches), ratios)
    return normal.freedom > len(prior_sigmas)


def rate_noise_power(stretches: Sequence[SampleSeries], ratios: Floats) -> float:
    """Expected whitened product of y with its own rates' noise, over sigma²: ``sum tr(P (K - tridiag(-1, 2, -1)))``.

    A column of A that holds the same noise as y, since it was integrated from the same sensor, shifts the parameters by
    its column of their covariance times this (errors in variables).
    """
    power = 0.0
    for group in grouped(stretches):
        count, m = group.duration_s.shape
        differences = np.diff(np.eye(m + 1), axis=0)[:, None, :]
        whole = np.broadcast_to(differences, (count, m, 3, m + 1))
        white, _ = _whitened(group, group.B, ratios)  # (s, 3, m, q)
        own, _, rank = _orthonormal(white.reshape(count, 3 * m, -1))
        of_samples, _ = _whitened(group, whole, ratios)  # (s, 3, m, m + 1)
        basis = own.reshape(count, 3, m, -1)
        projected = np.swapaxes(basis, 2, 3) @ of_samples
        power += 3.0 * m * count - rank
        power -= np.sum(of_samples**2) - np.sum(projected**2)
    return power


class Group(NamedTuple):
    """s stretches of one length and kind: one call of LAPACK serves all of them."""

    data: Floats
    """Columns y and A, shape (s, m, 3, 1 + p)."""
    B: Floats
    """Shape (s, m, 3, q)."""
    duration_s: Floats
    """Shape (s, m)."""
    walks: tuple[bool, bool, bool]


def grouped(stretches: Sequence[SampleSeries]) -> list[Group]:
    """Stretches of one length and kind together."""
    groups: dict[tuple[object, ...], list[SampleSeries]] = {}
    for stretch in stretches:
        kind = (stretch.A.shape, stretch.B.shape, stretch.walks)
        groups.setdefault(kind, []).append(stretch)
    return [
        Group(
            np.array(
                [np.concatenate([one.y[:, :, None], one.A], axis=2) for one in group]
            ),
            np.array([one.B for one in group]),
            np.array([one.duration_s for one in group]),
            group[0].walks,
        )
        for group in groups.values()
    ]


def _whitened(group: Group, columns: Floats, ratios: Floats) -> tuple[Floats, float]:
    """Columns, shape (s, m, 3, k), by the inverse of the Cholesky factor of K, shape (s, 3, m, k); ``sum 3 log|K|``."""
    T = group.duration_s  # (s, m)
    count, m = T.shape
    middle = np.cumsum(T, axis=1) - 0.5 * T
    both = np.minimum(middle[:, :, None], middle[:, None, :])
    walk = T[:, :, None] * T[:, None, :] * both
    neighbours = np.eye(m, k=1) + np.eye(m, k=-1)
    steady = (2.0 + ratios[0] * T)[:, :, None] * np.eye(m) - neighbours
    white = np.empty((count, 3, m, columns.shape[3]))
    log_determinant = 0.0
    # axes of a kind have the same K: one factor for all of them
    for walks in set(group.walks):
        axes = [axis for axis in range(3) if group.walks[axis] == walks]
        factor = np.linalg.cholesky(steady + walks * ratios[1] * walk)
        of_axes = columns[:, :, axes].reshape(count, m, -1)
        solved = np.linalg.solve(factor, of_axes).reshape(count, m, len(axes), -1)
        white[:, axes] = np.swapaxes(solved, 1, 2)
        roots = np.log(np.diagonal(factor, axis1=1, axis2=2))
        log_determinant += 2.0 * len(axes) * roots.sum()
    return white, log_determinant


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Whitened data of all stretches with their own parameters n projected out."""

    AtA: Floats
    Aty: Floats
    yty: float
    freedom: int
    """Rows less the stretches' own parameters."""
    log_determinants: float
    """``sum 3 log|K| + log|B' K^-1 B|``."""

    @classmethod
    def of(cls, groups: Sequence[Group], ratios: Floats) -> NormalEquations:
        """Reduce each stretch and sum."""
        p = groups[0].data.shape[3] - 1
        squares = np.zeros((1 + p, 1 + p))  # of [y, A]
        freedom = 0
        log_determinants = 0.0
        for group in groups:
            count, m = group.duration_s.shape
            columns = np.concatenate([group.data, group.B], axis=3)
            white, log_size = _whitened(group, columns, ratios)
            white = white.reshape(count, 3 * m, -1)
            own, log_own, rank = _orthonormal(white[:, :, 1 + p :])
            data = white[:, :, : 1 + p]
            data = data - own @ (np.swapaxes(own, 1, 2) @ data)
            squares += np.einsum("smi,smj->ij", data, data, optimize=True)
            log_determinants += log_size + log_own
            freedom += 3 * m * count - rank
        return cls(
            squares[1:, 1:],
            squares[1:, 0],
            squares[0, 0],
            freedom,
            log_determinants,
        )

    def solve(self, prior_sigmas: Floats) -> tuple[Floats, Floats, float, float]:
        """Parameters, information, sum of squares and sample variance; the prior's weight depends on the variance."""
        count = len(prior_sigmas)
        variance = max(self.yty / self.freedom, LEAST_VARIANCE)
        for _ in range(3):
            information = self.AtA + np.diag(variance / np.square(prior_sigmas))
            parameters = np.asarray(
                np.linalg.solve(information, self.Aty), dtype=np.float64
            )
            explained = float(parameters @ self.Aty)
            rss = max(self.yty - explained, 1e-12 * self.yty + 1e-300)
            variance = max(rss / max(self.freedom - count, 1), LEAST_VARIANCE)
        return parameters, information, rss, variance

    def criterion(self, prior_sigmas: Floats) -> float:
        """``-2 log L`` of the module's equation, but for a constant."""
        _, information, rss, _ = self.solve(prior_sigmas)
        freedom = max(self.freedom - len(prior_sigmas), 1)
        _, log_information = np.linalg.slogdet(information)
        return freedom * np.log(rss) + self.log_determinants + log_information


def _orthonormal(B: Floats) -> tuple[Floats, float, int]:
    """A basis of the columns' span of each matrix, shape (s, m, q), ``sum log|B'B|`` over them, and their rank."""
    # without parameters of their own there is nothing to project out
    if not B.shape[2]:
        return B, 0.0, 0
    U, s, _ = np.linalg.svd(B, full_matrices=False)
    kept = s > RANK_TOLERANCE * np.maximum(s[:, :1], 1e-300)
    log_size = 2.0 * np.log(s[kept]).sum()
    return U * kept[:, None, :], log_size, int(kept.sum())


RANGE_S = 2.0
"""Offsets are searched from minus to plus this."""
GRID_STEP_S = 0.1
DERIVATIVE_STEP_S = 0.05
"""Long against an IMU sample: the derivative of a single sample is mostly its noise."""
PRIOR_OFFSET_S = 10.0
CLEARLY_WORSE = 16.0
"""Least chi-square by which any other minimum must be worse: four sigmas."""
NEIGHBOURHOOD_S = 0.3
HOLLOWS_S = 0.5
"""Distance up to which hollows of one valley are looked for; others are rivals."""
ROUNDS = 6
SETTLED_SIGMAS = 0.5
"""Largest last step of an offset that is known: its square would add a quarter to the variance."""
LineUp = Callable[[float], Sequence[SampleSeries]]
"""The data lined up for an offset in seconds."""


@dataclass(frozen=True)
class Estimate1D:
    """One number with its standard deviation, or the reason why it is not known."""

    value: float
    sigma: float
    reason: str = ""
    """Why the number is not known; empty: it is."""

    @classmethod
    def unknown(cls, reason: str) -> Estimate1D:
        """No number, for a reason."""
        return cls(np.nan, np.inf, reason)

    @property
    def is_known(self) -> bool:
        """True where the number is known."""
        return not self.reason

    def limited(self, sigma_limit: float, reason: str) -> Estimate1D:
        """The same number, marked as not known where its sigma is above a limit."""
        known = self.is_known and self.sigma <= sigma_limit
        return self if known or not self.is_known else replace(self, reason=reason)

    def minus(self, value: float) -> Estimate1D:
        """The number less one that is known."""
        return replace(self, value=self.value - value)


@dataclass(frozen=True, eq=False)
class OffsetFit:
    """Offset and the other parameters, with the offset first."""

    fit: LeastSquaresFit
    """Its parameters are corrections that are near zero at the solution, but for the linear ones."""
    offset_s: float
    reason: str
    """Why the offset is not known; empty: it is."""

    hollow_s2: float = 0.0
    """Variance of the offset beyond the fit's: of a valley with several hollows the curvature in one is too large."""

    @property
    def covariance(self) -> Floats:
        """Of all parameters, shape (p, p), with what they owe to an offset that is less certain than the fit says."""
        P = self.fit.covariance
        by_offset = P[:, 0] / P[0, 0]
        return P + self.hollow_s2 * np.outer(by_offset, by_offset)

    def offset(self) -> Estimate1D:
        """The offset as a number."""
        sigma_s = float(np.sqrt(self.covariance[0, 0]))
        return Estimate1D(self.offset_s, sigma_s, self.reason)

    def widened(self, neighbours_s: Floats, chi2: Floats) -> OffsetFit:
        """With the sigma that neighbouring offsets have which fit nearly as well.

        ``chi2``: of each, less that of this one; a parabola has ``sigma = |offset| / sqrt(chi2)`` everywhere.
        """
        off_s = np.abs(neighbours_s - self.offset_s)
        is_near = (chi2 < CLEARLY_WORSE) & (off_s > GRID_STEP_S / 2)
        # what fits better still must not make the sigma infinite
        sigmas_s = off_s[is_near] / np.sqrt(np.maximum(chi2[is_near], 1.0))
        more = np.max(sigmas_s, initial=0.0) ** 2 - self.fit.covariance[0, 0]
        return replace(self, hollow_s2=max(float(more), 0.0))

    def without_shared_noise(
        self, stretches: Sequence[SampleSeries], column: int
    ) -> OffsetFit:
        """Corrected where one column of A holds the same rates' noise as y (`rate_noise_power`)."""
        shift = self.fit.covariance[:, column] * rate_noise_power(
            stretches, self.fit.ratios
        )
        corrected = replace(self.fit, parameters=self.fit.parameters - shift)
        return replace(self, fit=corrected, offset_s=self.offset_s - float(shift[0]))


def search_offset(line_up: LineUp, prior_sigmas: Floats) -> OffsetFit:
    """Find the best offset within `RANGE_S`.

    ``line_up``: gives the data for an offset; the same rows for all of them; ``prior_sigmas``: of the other common
    parameters (see `sonar_graph.navigation.alignment.time_offset.fit`), shape (p,).
    """
    # wide first: the criterion has several minima for a periodic motion
    grid = np.arange(-RANGE_S, RANGE_S + GRID_STEP_S / 2, GRID_STEP_S)
    lined_up = [line_up(offset) for offset in grid]
    ratios = fit(lined_up[len(grid) // 2], prior_sigmas).ratios
    for _ in range(2):
        fits = [fit(stretches, prior_sigmas, ratios) for stretches in lined_up]
        rss = np.array([f.rss for f in fits])
        best = int(np.argmin(rss))
        ratios = fit(lined_up[best], prior_sigmas).ratios
    reason = reason_not_unique(grid, rss / fits[best].variance, best)
    offset_s = grid[best]
    limits = offset_s - 2 * GRID_STEP_S, offset_s + 2 * GRID_STEP_S
    sigmas = np.concatenate([[PRIOR_OFFSET_S], prior_sigmas])
    # ratios of the grid are up to half a step off the best offset: what is not lined up there counts as noise
    offset_s = _converge(line_up, prior_sigmas, ratios, offset_s, limits).offset_s
    ratios = fit(_with_offset(line_up, offset_s, prior_sigmas, ratios), sigmas).ratios
    found = _converge(line_up, prior_sigmas, ratios, offset_s, limits)
    here = fit(line_up(found.offset_s), prior_sigmas, ratios)
    near_s = grid[np.abs(grid - found.offset_s) < HOLLOWS_S]
    near = np.array([fit(line_up(at_s), prior_sigmas, ratios).rss for at_s in near_s])
    found = found.widened(near_s, (near - here.rss) / here.variance)
    return replace(found, reason=reason or found.reason)


def reason_not_unique(grid: Floats, chi2: Floats, best: int) -> str:
    """The reason why the best offset of the grid does not stand out; empty: it does."""
    if best in (0, len(grid) - 1):
        return f"no best offset within ±{RANGE_S:g} s"
    is_minimum = (chi2[1:-1] <= chi2[:-2]) & (chi2[1:-1] <= chi2[2:])
    minima = (*(np.flatnonzero(is_minimum) + 1), 0, len(grid) - 1)
    others = [i for i in minima if abs(grid[i] - grid[best]) > NEIGHBOURHOOD_S]
    rivals = [i for i in others if chi2[i] - chi2[best] < CLEARLY_WORSE]
    if rivals:
        return f"{grid[best]:+.1f} s and {grid[rivals[0]]:+.1f} s fit as well: too little changes in the motion"
    return ""


def _converge(
    line_up: LineUp,
    prior_sigmas: Floats,
    ratios: Floats,
    offset_s: float,
    limits: tuple[float, float],
) -> OffsetFit:
    """Gauss-Newton steps of the offset within limits; one that still moves by half its sigma is not known."""
    sigmas = np.concatenate([[PRIOR_OFFSET_S], prior_sigmas])
    for _ in range(ROUNDS):
        found = fit(
            _with_offset(line_up, offset_s, prior_sigmas, ratios), sigmas, ratios
        )
        step = np.clip(found.parameters[0], -GRID_STEP_S, GRID_STEP_S)
        offset_s = float(np.clip(offset_s + step, *limits))
        if abs(step) < 1e-5:
            break
    sigma_s = np.sqrt(found.covariance[0, 0])
    is_settled = abs(found.parameters[0]) < max(SETTLED_SIGMAS * sigma_s, 1e-5)
    unsettled = f"it does not settle: after {ROUNDS} steps near {offset_s:+.2f} s the next is {step:+.2g} s"
    return OffsetFit(found, offset_s, "" if is_settled else unsettled)


def _with_offset(
    line_up: LineUp, offset_s: float, prior_sigmas: Floats, ratios: Floats
) -> list[SampleSeries]:
    """The data at an offset, with minus the derivative of ``y - A p`` by it as a further column in front."""
    here, before, after = (
        line_up(offset_s + step)
        for step in (0.0, -DERIVATIVE_STEP_S, DERIVATIVE_STEP_S)
    )
    p = fit(here, prior_sigmas, ratios).parameters
    stretches = []
    for h, b, a in zip(here, before, after, strict=True):
        residual_before = b.y - b.A @ p
        residual_after = a.y - a.A @ p
        slope = (residual_after - residual_before) / (2 * DERIVATIVE_STEP_S)  # (m, 3)
        with_offset = np.concatenate([-slope[:, :, None], h.A], axis=2)
        stretches.append(replace(h, A=with_offset))
    return stretches
