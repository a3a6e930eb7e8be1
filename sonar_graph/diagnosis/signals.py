"""Two signals of one quantity: gain, lag and scatter of one against the other.

A sensor's signal y and a reference x that other sensors give, real, or complex for a level plane, over stretches of
some minutes each. With the lag tau of y, an offset a per stretch and a drift b of the reference per second::

    y(t) = a + c x(t - tau) + b (t - t_0) + e,    c = 1 and tau = 0 where both sensors are right

A wrong sense is ``c < 0``, a wrong unit or scale is ``|c|``, a turned world is ``arg c``, a stuck sensor is ``c = 0``.
tau minimises the squares of e over a grid and is refined by one Gauss-Newton step. Rows far from the fit are left out.
Errors of successive rows are alike, so that covariances are of blocks of rows, a dozen in all (a sandwich)::

    cov(p) = (A^H A)^-1 sum_blocks (A_k^H e_k)(A_k^H e_k)^H (A^H A)^-1 n / (n - p)

docs/theory/sensor_check.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats
from sonar_graph.navigation.alignment import Estimate1D

Values = NDArray[np.floating | np.complexfloating]
LAGS_S = np.arange(-4.0, 4.01, 0.25)
BLOCKS = 12
FEWEST_ROWS = 8
OUTLYING = 6.0
"""Rows beyond so many robust sigmas of the fit are left out."""
MOST_OUTLYING = 0.25
LAG_STEP_S = 0.05
CLEARLY_BETTER = 1.5
"""Ratio of sums of squares from which on another lag, or the mirrored reference, counts."""
SMALL_SAMPLE = 1.3
"""Quantiles of Student's t for a dozen blocks over those of the normal distribution, at 4 sigma and more."""


@dataclass(frozen=True, eq=False)
class SignalStretch:
    """Rows of a sensor and its reference over some minutes."""

    seconds: Floats
    """Shape (n,)."""
    y: Values
    """Shape (n,)."""
    reference: Callable[[Floats], Values]
    """x at any times; NaN where it is not known."""
    has_offset: bool = True
    """False for changes, which have none."""


@dataclass(frozen=True, eq=False)
class Match:
    """Result of the comparison."""

    gain: Estimate1D
    """``|c|``, with the sign of c for real signals."""
    angle: Estimate1D
    """``arg c``, rad, of complex signals."""
    lag: Estimate1D
    """Of the sensor, s: its rows come so much too late."""
    scatter: float
    """Root mean square of e, of the rows that fit."""
    moved: float
    """Root mean square of the reference about its mean."""
    misfit: float
    """Share of y's squares that the reference does not explain."""
    rate: float = 0.0
    """Root mean square of the sensor's change a second."""
    is_mirrored: bool = False
    """True where the conjugate of the reference fits."""
    outlying: float = 0.0
    """Share of rows that were left out."""


def unknown(reason: str) -> Match:
    """A comparison that could not be made."""
    nothing = Estimate1D(np.nan, np.inf, reason)
    return Match(nothing, nothing, nothing, np.nan, np.nan, 0.0)


@dataclass(frozen=True, eq=False)
class Fit:
    """Least squares of one stretch."""

    p: Values
    """Coefficients: c, then -c tau where it was asked for."""
    cov: Values
    residuals: Values
    kept: NDArray[np.bool_]

    @property
    def squares(self) -> float:
        """Sum of all squares, in which a far row counts as much as the farthest one that fits."""
        limit = np.abs(self.residuals[self.kept]).max(initial=0.0)
        return float(np.sum(np.minimum(np.abs(self.residuals), limit) ** 2))


def fit(
    stretch: SignalStretch,
    lag_s: float,
    drift_sigma: float,
    *,
    mirrored: bool = False,
    slope: bool = False,
) -> Fit | None:
    """Fit one stretch at a lag; with ``slope`` with the derivative by the lag. None: too few rows."""
    at = stretch.seconds - lag_s
    x = stretch.reference(at)
    columns = [x]
    if slope:
        after = stretch.reference(at + LAG_STEP_S)
        before = stretch.reference(at - LAG_STEP_S)
        columns.append((after - before) / (2 * LAG_STEP_S))
    A = np.column_stack(columns)
    A = A.conj() if mirrored else A
    usable = np.isfinite(A).all(axis=1) & np.isfinite(stretch.y)
    if np.count_nonzero(usable) < FEWEST_ROWS:
        return None
    t = stretch.seconds - stretch.seconds.mean()
    nuisance = [np.ones_like(t)] if stretch.has_offset else []
    if drift_sigma > 0:
        nuisance.append(t)
    whole = np.column_stack([A, *nuisance])
    p = whole.shape[1]
    kept = usable
    prior = np.zeros((0, p))
    for _ in range(4):
        rows = whole[kept]
        solution = np.linalg.lstsq(
            np.vstack([rows, prior]), np.append(stretch.y[kept], np.zeros(len(prior)))
        )[0]
        residuals = np.where(
            usable, stretch.y - np.where(usable[:, None], whole, 0.0) @ solution, 0.0
        )
        size = float(np.sqrt(np.mean(np.abs(residuals[kept]) ** 2)))
        if drift_sigma > 0:
            prior = np.zeros((1, p))
            prior[0, -1] = max(size, 1e-12) / drift_sigma
        robust = 1.5 * float(np.median(np.abs(residuals[usable])))
        near = usable & (np.abs(residuals) <= OUTLYING * max(robust, 1e-12))
        kept = (
            near
            if np.count_nonzero(near) >= (1 - MOST_OUTLYING) * np.count_nonzero(usable)
            else usable
        )
    rows = whole[kept]
    information = rows.conj().T @ rows + prior.T @ prior
    inverse = np.linalg.pinv(information, hermitian=True)
    edges = np.linspace(0, len(rows), BLOCKS + 1).astype(int)
    scores = rows.conj() * residuals[kept][:, None]
    sums = np.array([scores[i:j].sum(axis=0) for i, j in pairwise(edges.tolist())])
    meat = sums.T @ sums.conj() * BLOCKS / max(BLOCKS - p, 1)
    cov = inverse @ meat @ inverse.conj().T
    n = A.shape[1]
    return Fit(solution[:n], cov[:n, :n], residuals, kept)


def match(
    stretches: list[SignalStretch], drift_sigma: float = 0.0, *, find_lag: bool = True
) -> Match:
    """Compare a sensor with its reference.

    ``drift_sigma``: how fast the reference may drift, in its unit a second; 0: not at all.
    """
    fits = {}
    lags = LAGS_S if find_lag else np.zeros(1)
    for mirrored in (False, True):
        for lag_s in lags.tolist():
            found = [fit(s, lag_s, drift_sigma, mirrored=mirrored) for s in stretches]
            known = [one for one in found if one is not None]
            if known:
                squares = sum(one.squares for one in known) / sum(
                    len(one.kept) for one in known
                )
                fits[mirrored, lag_s] = squares
        if not any(np.iscomplexobj(s.y) for s in stretches):
            break
    if (False, 0.0) not in fits:
        return unknown("too few rows beside its reference")
    mirrored, lag_s = min(fits, key=fits.__getitem__)
    if mirrored and not fits[True, lag_s] * CLEARLY_BETTER**2 < min(
        fits[key] for key in fits if not key[0]
    ):
        mirrored, lag_s = min((key for key in fits if not key[0]), key=fits.__getitem__)
    if fits[mirrored, lag_s] * CLEARLY_BETTER > fits.get((mirrored, 0.0), np.inf):
        lag_s = 0.0  # a vehicle that circles fits as well half a turn later
    parts = [
        fit(s, lag_s, drift_sigma, mirrored=mirrored, slope=find_lag) for s in stretches
    ]
    return combined(
        [one for one in parts if one is not None], stretches, lag_s, mirrored
    )


def combined(
    parts: list[Fit], stretches: list[SignalStretch], lag_s: float, mirrored: bool
) -> Match:
    """Mean of the stretches' gains, angles and lags, weighted by their certainty."""
    gains, angles, lags = [], [], []
    for one in parts:
        c = one.p[0]
        sigma = SMALL_SAMPLE * float(np.sqrt(np.abs(one.cov[0, 0])))
        size = abs(c)
        is_plane = np.iscomplexobj(one.p)
        gains.append((float(size if is_plane else c.real), sigma))
        angles.append((float(np.angle(c)), sigma / max(size, 1e-12)))
        if len(one.p) > 1:
            lag = lag_s - float(np.real(one.p[1] * np.conj(c))) / max(size**2, 1e-12)
            lags.append(
                (
                    lag,
                    SMALL_SAMPLE
                    * float(np.sqrt(np.abs(one.cov[1, 1])))
                    / max(size, 1e-12),
                )
            )
    residuals = np.concatenate([one.residuals[one.kept] for one in parts])
    y = np.concatenate([s.y - np.nanmean(s.y) * s.has_offset for s in stretches])
    x = [s.reference(s.seconds) for s in stretches]
    x_about = np.concatenate(
        [
            one - np.nanmean(one) * s.has_offset
            for one, s in zip(x, stretches, strict=True)
        ]
    )
    speeds = [
        np.abs(
            s.reference(s.seconds + LAG_STEP_S) - s.reference(s.seconds - LAG_STEP_S)
        )
        ** 2
        / (2 * LAG_STEP_S) ** 2
        for s in stretches
    ]
    scatter = float(np.sqrt(np.mean(np.abs(residuals) ** 2)))
    return Match(
        weighted(gains),
        weighted(angles),
        weighted(lags) if lags else Estimate1D(np.nan, np.inf, "not asked for"),
        scatter,
        float(np.sqrt(np.nanmean(np.abs(x_about) ** 2))),
        scatter**2 / max(float(np.nanmean(np.abs(y) ** 2)), 1e-24),
        float(np.sqrt(np.nanmean(np.concatenate(speeds)))),
        mirrored,
        1.0 - float(np.mean(np.concatenate([one.kept for one in parts]))),
    )


def weighted(values: list[tuple[float, float]]) -> Estimate1D:
    """Mean weighted by inverse variances; its sigma holds the scatter between stretches."""
    value, sigma = np.array(values).T
    weights = 1.0 / np.maximum(sigma, 1e-9) ** 2
    mean = float(weights @ value / weights.sum())
    of_scatter = float(weights @ (value - mean) ** 2) / max(len(value) - 1, 1)
    return Estimate1D(mean, float(np.sqrt(max(of_scatter, 1.0) / weights.sum())))
