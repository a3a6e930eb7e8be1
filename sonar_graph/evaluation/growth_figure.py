"""The map as it grew: path and landmarks as each estimator knew them at three times of the run.

The counterpart of Fig. 4 of the 2014 paper, at its times, or at the same fractions of another run.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import chi2

from sonar_graph.evaluation.figure_style import (
    INK,
    LABEL_SIZE,
    TRUTH,
    blank_panels,
    colour,
    head_panel,
    legend_above,
    name_axes,
    seconds_since_start,
)
from sonar_graph.evaluation.map_figure import (
    ELLIPSE_PROBABILITY,
    ellipses,
    horizontal,
    label_landmarks,
    seen_from_above,
)
from sonar_graph.evaluation.results import Comparison, MapSoFar, RunResult
from sonar_graph.measurements import Floats, Ints
from sonar_graph.states import Trajectory

WIDTH_IN = 7.6
ENLARGED = (1, 2, 5, 10, 20, 50)
"""How many times as large ellipses may be drawn."""
LARGEST_ELLIPSE = 0.09
"""Half its length against the view's size: enlarging goes no further."""


def growth_figure(comparison: Comparison) -> Figure | None:
    """A row a run, a column a time: causal path until then, landmarks with ellipses as known then, not aligned."""
    view, runs = seen_from_above(comparison), _runs_with_maps(comparison)
    if view is None or not runs:
        return None
    view = view + np.array([[-1.0], [1.0]]) * LARGEST_ELLIPSE * float((view[1] - view[0]).max())
    stamps_ns = growth_instants(comparison)
    enlarged = enlargement(comparison)
    span = view[1] - view[0]
    height_in = np.clip(WIDTH_IN / len(stamps_ns) * span[1] / span[0], 1.2, 4.0)
    size = WIDTH_IN, float(height_in) * len(runs) + 0.5
    figure, axes = blank_panels(len(runs), len(stamps_ns), size, sharex=True, sharey=True)
    for row, (index, run) in enumerate(runs):
        for column, stamp_ns in enumerate(stamps_ns.tolist()):
            panel: Axes = axes[row, column]
            _draw_until(panel, comparison, run, stamp_ns, colour(index), enlarged)
            label_landmarks(panel, comparison, view)
            panel.set(xlim=view[:, 0], ylim=view[:, 1])
            panel.set_aspect("equal", adjustable="box")
            name_axes(panel, "world x (m)" if row == len(runs) - 1 else "", "" if column else "world y (m)")
        axes[row, 0].annotate(
            run.estimator,
            (-0.34, 0.5),
            xycoords="axes fraction",
            rotation=90,
            va="center",
            color=colour(index),
            fontsize=LABEL_SIZE,
            fontweight="bold",
        )
    for column, seconds in enumerate(seconds_since_start(comparison, stamps_ns)):
        head_panel(axes[0, column], f"T = {seconds:.1f} s")
    legend_above(figure, axes[0, 0])
    return figure


def growth_instants(comparison: Comparison) -> Ints:
    """When maps were kept, in order."""
    stamps = {known.stamp_ns for _, run in _runs_with_maps(comparison) for known in run.maps}
    return np.array(sorted(stamps), dtype=np.int64)


def enlargement(comparison: Comparison) -> int:
    """How many times as large ellipses are drawn, so that they can be seen and do not cover each other."""
    view = seen_from_above(comparison)
    sigmas = [
        np.sqrt(np.linalg.eigvalsh(cov).max())
        for _, run in _runs_with_maps(comparison)
        for known in run.maps
        for cov in known.landmarks.covariances[:, :2, :2]
        if np.isfinite(cov).all()
    ]
    if view is None or not sigmas:
        return 1
    room_m = LARGEST_ELLIPSE * float((view[1] - view[0]).max())
    half_m = float(max(sigmas)) * float(np.sqrt(chi2.ppf(ELLIPSE_PROBABILITY, 2)))
    return max((factor for factor in ENLARGED if factor * half_m <= room_m), default=1)


def _runs_with_maps(comparison: Comparison) -> list[tuple[int, RunResult]]:
    return [(i, run) for i, run in enumerate(comparison.runs) if any(len(known.landmarks) for known in run.maps)]


def _draw_until(
    panel: Axes, comparison: Comparison, run: RunResult, stamp_ns: int, own_colour: str, enlarged: float
) -> None:
    truth, true = comparison.sequence.truth, comparison.sequence.true_landmarks
    if truth is not None:
        _draw_path(panel, truth, stamp_ns, color=TRUTH, linewidth=2.6, alpha=0.6, label="truth")
    if run.causal is not None:
        _draw_path(panel, run.causal, stamp_ns, color=own_colour, linewidth=1.0, label="causal estimate")
    if true is not None:
        panel.plot(*_xy(true.positions), "+", color=INK, markersize=7, markeredgewidth=1.2, label="true landmarks")
    known = _map_at(run, stamp_ns)
    if known is not None:
        points = _xy(known.landmarks.positions)
        panel.plot(*points, "o", color=own_colour, markersize=2.5, label="estimated landmarks")
        for ellipse in ellipses(known.landmarks, own_colour, enlarged):
            panel.add_patch(ellipse)


def _draw_path(panel: Axes, path: Trajectory, stamp_ns: int, **style: Any) -> None:
    until = path.rows(np.flatnonzero(path.stamps_ns <= stamp_ns))
    if len(until):
        panel.plot(*horizontal(until), **style)


def _map_at(run: RunResult, stamp_ns: int) -> MapSoFar | None:
    return next((known for known in run.maps if known.stamp_ns == stamp_ns), None)


def _xy(positions: Floats) -> tuple[Floats, Floats]:
    return positions[:, 0], positions[:, 1]
