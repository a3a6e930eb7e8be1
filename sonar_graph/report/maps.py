"""The map: paths, landmarks and 95 % ellipses in the world of the start pose, seen from above.

The map as it grew: path and landmarks as each estimator knew them at three times of the run.

The counterpart of Fig. 4 of the 2014 paper, at its times, or at the same fractions of another run.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from scipy.stats import chi2

from sonar_graph.evaluation import Comparison, MapSoFar, RunResult
from sonar_graph.measurements import Floats, Ints
from sonar_graph.report.figure_style import (
    INK,
    LABEL_SIZE,
    TICK_SIZE,
    TRUTH,
    blank_panels,
    colour,
    evenly,
    head_panel,
    legend_above,
    line_style,
    name_axes,
    seconds_since_start,
)
from sonar_graph.states import LandmarkMap, Trajectory

ELLIPSE_PROBABILITY = 0.95
MARGIN = 0.3
"""How far, in sizes of the truth, the map follows estimates that leave it."""
WIDTH_IN = 7.4
LEGEND_COLUMNS = 3
SAME_M = 1e-3
"""A smoothed path nowhere farther than this from the causal one is not drawn a second time."""
PATH_POINTS = 2500


def map_figure(comparison: Comparison) -> Figure | None:
    """Truth, causal and smoothed paths, landmarks with covariance ellipses; None where there is no path to draw.

    Axes are world x and y in metres at one scale, nothing is aligned. The view holds the truth, true landmarks and as
    much around them as `MARGIN` says; `paths_cut_off` names the runs that leave it.
    """
    view = seen_from_above(comparison)
    if view is None:
        return None
    figure, axes = blank_panels(1, 1, (WIDTH_IN, WIDTH_IN))
    panel: Axes = axes[0, 0]
    _draw_truth(panel, comparison)
    for index, run in enumerate(comparison.runs):
        _draw_paths(panel, run, index)
        _draw_landmarks(panel, run, index)
    label_landmarks(panel, comparison, view)
    panel.set(xlim=view[:, 0], ylim=view[:, 1])
    panel.set_aspect("equal", adjustable="box")
    name_axes(panel, "world x (m)", "world y (m)")
    legend_above(figure, panel, columns=LEGEND_COLUMNS)
    figure.set_size_inches(WIDTH_IN, _height_in(panel, view))
    return figure


def _height_in(panel: Axes, view: Floats) -> float:
    """Height at which axes of the view's shape fill the figure's width, with room for legend and labels."""
    span = view[1] - view[0]
    legend_rows = -(-len(panel.get_legend_handles_labels()[1]) // LEGEND_COLUMNS)
    drawing = np.clip((WIDTH_IN - 0.8) * span[1] / span[0], 2.5, 8.0)
    return float(drawing) + 0.75 + 0.17 * legend_rows


def paths_cut_off(comparison: Comparison) -> list[str]:
    """Names of runs whose path leaves the map's view."""
    view = seen_from_above(comparison)
    if view is None:
        return []
    return [
        run.estimator
        for run in comparison.runs
        if any(np.any((path < view[0]) | (path > view[1])) for path in _paths(run))
    ]


def smoothed_differs(run: RunResult) -> bool:
    """Whether the smoothed path is another one than the causal one."""
    if run.smoothed is None or not len(run.smoothed):
        return False
    if run.causal is None or len(run.causal) != len(run.smoothed):
        return True
    return bool(np.abs(run.smoothed.positions - run.causal.positions).max() > SAME_M)


def _paths(run: RunResult) -> list[Floats]:
    return [path.positions[:, :2] for path in (run.causal, run.smoothed) if path is not None and len(path)]


def seen_from_above(comparison: Comparison) -> Floats | None:
    """What a map shows, lower left and upper right corner, shape (2, 2); None where there is no path."""
    estimates = [path for run in comparison.runs for path in _paths(run)]
    sequence = comparison.sequence
    references = [sequence.truth.positions[:, :2]] if sequence.truth and len(sequence.truth) else []
    if not references and not estimates:
        return None
    if sequence.true_landmarks and len(sequence.true_landmarks):
        references.append(sequence.true_landmarks.positions[:, :2])
    maps = [run.landmarks.positions[:, :2] for run in comparison.runs if run.landmarks and len(run.landmarks)]
    anchor = _box(np.vstack(references or estimates))
    largest = max(float(np.max(anchor[1] - anchor[0])), 1.0)
    limits = anchor + np.array([[-1.0], [1.0]]) * MARGIN * largest
    everything = np.vstack([anchor, *estimates, *maps])
    box = _box(np.clip(everything[np.isfinite(everything).all(axis=1)], limits[0], limits[1]))
    return box + np.array([[-1.0], [1.0]]) * 0.04 * largest


def _box(points: Floats) -> Floats:
    return np.array([np.nanmin(points, axis=0), np.nanmax(points, axis=0)])


def _draw_truth(panel: Axes, comparison: Comparison) -> None:
    truth, landmarks = comparison.sequence.truth, comparison.sequence.true_landmarks
    if truth is not None and len(truth):
        x, y = horizontal(truth)
        panel.plot(x, y, color=TRUTH, linewidth=3.2, alpha=0.6, label="truth", solid_capstyle="round", zorder=1)
    if landmarks is not None and len(landmarks):
        x, y = landmarks.positions[:, 0], landmarks.positions[:, 1]
        panel.plot(x, y, "+", color=INK, markersize=9, markeredgewidth=1.4, label="true landmarks", zorder=5)


def _draw_paths(panel: Axes, run: RunResult, index: int) -> None:
    if run.causal is not None and len(run.causal):
        x, y = horizontal(run.causal)
        label = f"{run.estimator}, causal"
        panel.plot(x, y, color=colour(index), linestyle=line_style(index), linewidth=1.3, label=label, zorder=3)
    if run.smoothed is not None and smoothed_differs(run):
        x, y = horizontal(run.smoothed)
        label = f"{run.estimator}, smoothed"
        panel.plot(x, y, color=colour(index), linestyle=(0, (1, 1)), linewidth=1.9, alpha=0.75, label=label, zorder=2)


def _draw_landmarks(panel: Axes, run: RunResult, index: int) -> None:
    if run.landmarks is None or not len(run.landmarks):
        return
    x, y = run.landmarks.positions[:, 0], run.landmarks.positions[:, 1]
    label = f"{run.estimator}, landmarks"
    marker = "os^Dv<"[index % 6]
    panel.plot(x, y, marker, color=colour(index), markersize=3.5, markerfacecolor="none", label=label, zorder=4)
    for ellipse in ellipses(run.landmarks, colour(index)):
        panel.add_patch(ellipse)


def ellipses(landmarks: LandmarkMap, edge: str, enlarged: float = 1.0) -> list[Ellipse]:
    """What holds each landmark with `ELLIPSE_PROBABILITY`, horizontally; none where the covariance is unknown."""
    scale = enlarged * 2 * np.sqrt(chi2.ppf(ELLIPSE_PROBABILITY, 2))
    ellipses = []
    for position, cov in zip(landmarks.positions, landmarks.covariances[:, :2, :2], strict=True):
        if not np.isfinite(cov).all():
            continue
        variances, directions = np.linalg.eigh(cov)
        width, height = scale * np.sqrt(np.maximum(variances[::-1], 0.0))
        angle = np.degrees(np.arctan2(directions[1, 1], directions[0, 1]))
        ellipses.append(
            Ellipse((position[0], position[1]), width, height, angle=angle, fill=False, edgecolor=edge, zorder=4)
        )
    return ellipses


def label_landmarks(panel: Axes, comparison: Comparison, view: Floats) -> None:
    """Write identities beside landmarks that are in view: the true ones, or those of the first run that has any."""
    candidates = [comparison.sequence.true_landmarks, *(run.landmarks for run in comparison.runs)]
    landmarks = next((known for known in candidates if known is not None and len(known)), None)
    if landmarks is None:
        return
    size = TICK_SIZE if len(landmarks) <= 40 else 6.0
    for identity, position in zip(landmarks.ids.tolist(), landmarks.positions[:, :2], strict=True):
        if np.all((position >= view[0]) & (position <= view[1])):
            panel.annotate(
                str(identity),
                (position[0], position[1]),
                xytext=(7, 6),
                textcoords="offset points",
                color=INK,
                fontsize=size,
                fontweight="bold",
                zorder=6,
            )


def horizontal(trajectory: Trajectory) -> tuple[Floats, Floats]:
    """World x and y of as many poses as can be told apart."""
    rows = evenly(len(trajectory), PATH_POINTS)
    return trajectory.positions[rows, 0], trajectory.positions[rows, 1]


GROWTH_WIDTH_IN = 7.6
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
    height_in = np.clip(GROWTH_WIDTH_IN / len(stamps_ns) * span[1] / span[0], 1.2, 4.0)
    size = GROWTH_WIDTH_IN, float(height_in) * len(runs) + 0.5
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
