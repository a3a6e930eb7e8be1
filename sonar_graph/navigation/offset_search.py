"""The time offset at which two sensors agree best, with its uncertainty or the reason why it cannot be told.

Over a grid of offsets the data are lined up anew and fitted; around the best one Gauss-Newton steps with the offset as
one more parameter give its value and covariance together with all others. A second place that fits nearly as well, or a
best one at the end of the range, means that the motion does not tell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.navigation.differenced_fit import Fit, Stretch, fit

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

LineUp = Callable[[float], Sequence[Stretch]]
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

    fit: Fit
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
        Of the other common parameters (see `sonar_graph.navigation.differenced_fit.fit`), shape (p,).
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


def _with_offset(line_up: LineUp, offset_s: float, prior_sigmas: Floats, ratios: Floats) -> list[Stretch]:
    """The data at an offset, with the derivative of ``y - A p`` by it as a further column in front."""
    here, before, after = (line_up(offset_s + step) for step in (0.0, -DERIVATIVE_STEP_S, DERIVATIVE_STEP_S))
    p = fit(here, prior_sigmas, ratios).parameters
    stretches = []
    for h, b, a in zip(here, before, after, strict=True):
        slope = ((a.y - a.A @ p) - (b.y - b.A @ p)) / (2 * DERIVATIVE_STEP_S)
        stretches.append(replace(h, A=np.concatenate([-slope[:, :, None], h.A], axis=2)))
    return stretches
