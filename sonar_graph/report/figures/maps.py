"""Maps: paths, landmarks and 95 % ellipses in the world of the start pose, at the end and as they grew.

The growing map is the counterpart of Fig. 4 of the 2014 paper, at its times or the same fractions of another run.
"""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from sonar_graph.evaluation import Comparison, RunResult, map_instants, scored_map
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.report import figure_style as style
from sonar_graph.report.given_map import draw_given_map
from sonar_graph.states import (
    FIRST_ANONYMOUS_ID,
    LandmarkMap,
    Trajectory,
    landmark_name,
)

ELLIPSE_PROBABILITY = 0.95
# distance, in sizes of the truth, to which the map follows estimates that leave it
MARGIN = 0.3
# a smoothed path nowhere farther than this from the causal one is not drawn a second time
SAME_M = 1e-3
PATH_POINTS = 2500
# height of the view of the map over its width, at most
HIGHEST = 0.72
# factors by which ellipses may be enlarged
ENLARGED = (1, 2, 5, 10, 20, 50)
# largest half length of an enlarged ellipse, relative to the view's size
LARGEST_ELLIPSE = 0.09


def map_figure(comparison: Comparison) -> Figure | None:
    """Truth, causal and smoothed paths, landmarks with covariance ellipses; None where there is no path to draw.

    Axes are world x and y in metres at one scale. The view holds the truth, true landmarks and as
    much around them as `MARGIN` says; `paths_cut_off` names the runs that leave it.
    """
    view = map_view(comparison)
    if view is None:
        return None
    # one factor for all landmarks, so that ellipses can be compared
    factor = enlargement(comparison)
    view = view if factor == 1 else with_room(view)
    figure, axes = style.blank_panels(1, 1, (style.width_in(), style.width_in()))
    panel: Axes = axes[0, 0]
    truth = comparison.sequence.truth
    # in the world of the estimates, as paths are
    true_landmarks = true_landmarks_drawn(comparison)
    look: dict[str, Any]
    if truth is not None and len(truth):
        panel.plot(*horizontal(truth), label="truth", zorder=1, **style.TRUTH_LOOK)
    if true_landmarks is not None and len(true_landmarks):
        look = {"color": style.INK, "markersize": 9, "markeredgewidth": 1.4}
        x_y = true_landmarks.positions.T[:2]
        panel.plot(*x_y, "+", label="true landmarks", zorder=5, **look)
    for index, run in enumerate(comparison.runs):
        own = style.colour(index)
        if run.causal is not None and len(run.causal):
            look = style.run_look(index, 1.3)
            panel.plot(*horizontal(run.causal), label=run.estimator, zorder=3, **look)
        if run.smoothed is not None and smoothed_differs(run):
            look = {"linestyle": (0, (1, 1)), "linewidth": 1.9, "alpha": 0.75}
            look |= {"label": f"{run.estimator}, smoothed", "color": own, "zorder": 2}
            panel.plot(*horizontal(run.smoothed), **look)
        if run.landmarks is not None and len(run.landmarks):
            look = {"markersize": 3.5, "markerfacecolor": "none", "zorder": 4}
            x_y = run.landmarks.positions.T[:2]
            panel.plot(*x_y, "os^Dv<"[index % 6], color=own, **look)
            for ellipse in ellipses(run.landmarks, own, factor):
                panel.add_patch(ellipse)
    draw_given_map(panel, comparison)
    view = landscape(view)
    panel.set(xlim=view[:, 0], ylim=view[:, 1])
    panel.set_aspect("equal", adjustable="box")
    panel.set(xlabel="world x (m)", ylabel="world y (m)")
    style.legend_above(figure, panel)
    # the room for names is measured on the figure as it will be
    style.arrange(figure)
    label_landmarks(panel, comparison)
    return figure


def landscape(view: Floats) -> Floats:
    """The view, widened until its height is at most `HIGHEST` of its width, so that a map fits a screen."""
    width, height = view[1] - view[0]
    missing = max(height / HIGHEST - width, 0.0)
    return np.asarray(view + np.array([[-missing / 2, 0.0], [missing / 2, 0.0]]))


def true_landmarks_drawn(comparison: Comparison) -> LandmarkMap | None:
    """The true landmarks in the world of the start pose; landmarks of another world are aligned to the first map."""
    true = comparison.sequence.true_landmarks
    # the first map decides, so that all are drawn in one world
    maps = [
        run.landmarks
        for run in comparison.runs
        if run.landmarks is not None and len(run.landmarks)
    ]
    scored = scored_map(maps[0], comparison.sequence) if maps else None
    if true is None or scored is None or scored.alignment is None:
        return true
    return scored.alignment.inverse().map(true)


def paths_cut_off(comparison: Comparison) -> list[str]:
    """Names of runs whose path leaves the map's view."""
    view = map_view(comparison)
    if view is None:
        return []
    return [
        run.estimator
        for run in comparison.runs
        if any(np.any((path < view[0]) | (path > view[1])) for path in _paths(run))
    ]


def smoothed_differs(run: RunResult) -> bool:
    """True where the smoothed path is not the causal one."""
    if run.smoothed is None or not len(run.smoothed):
        return False
    if run.causal is None:
        return True
    # a start that is found in a map gives smoothed poses where there is no causal one
    _, rows, of_causal = np.intersect1d(
        run.smoothed.stamps_ns, run.causal.stamps_ns, return_indices=True
    )
    apart = run.smoothed.positions[rows] - run.causal.positions[of_causal]
    return len(rows) < len(run.causal) or bool(np.abs(apart).max(initial=0.0) > SAME_M)


def _paths(run: RunResult) -> list[Floats]:
    return [
        path.positions[:, :2]
        for path in (run.causal, run.smoothed)
        if path is not None and len(path)
    ]


def map_view(comparison: Comparison) -> Floats | None:
    """Lower left and upper right corner of the map, shape (2, 2), metres; None where there is no path."""
    estimates = [path for run in comparison.runs for path in _paths(run)]
    sequence = comparison.sequence
    references = (
        [sequence.truth.positions[:, :2]]
        if sequence.truth and len(sequence.truth)
        else []
    )

    def box(points: Floats) -> Floats:
        return np.array([np.nanmin(points, axis=0), np.nanmax(points, axis=0)])

    if not references and not estimates:
        return None
    true = true_landmarks_drawn(comparison)
    if true is not None and len(true):
        references.append(true.positions[:, :2])
    maps = [
        run.landmarks.positions[:, :2]
        for run in comparison.runs
        if run.landmarks and len(run.landmarks)
    ]
    # an estimate that diverges must not shrink the truth to a point: the truth sets the scale
    anchor = box(np.vstack(references or estimates))
    largest = max(float(np.max(anchor[1] - anchor[0])), 1.0)
    limits = anchor + np.array([[-1.0], [1.0]]) * MARGIN * largest
    everything = np.vstack([anchor, *estimates, *maps])
    shown = box(
        np.clip(everything[np.isfinite(everything).all(axis=1)], limits[0], limits[1])
    )
    return shown + np.array([[-1.0], [1.0]]) * 0.04 * largest


def with_room(view: Floats) -> Floats:
    """The view, widened by what the largest ellipse may need."""
    return np.asarray(
        view
        + np.array([[-1.0], [1.0]]) * LARGEST_ELLIPSE * float((view[1] - view[0]).max())
    )


def ellipses(landmarks: LandmarkMap, edge: str, enlarged: float = 1.0) -> list[Ellipse]:
    """Horizontal ellipses that hold each landmark with `ELLIPSE_PROBABILITY`; none where the covariance is unknown."""
    scale = enlarged * 2 * math.sqrt(chi_square_quantile(ELLIPSE_PROBABILITY, 2))
    ellipses = []
    for position, cov in zip(
        landmarks.positions, landmarks.covariances[:, :2, :2], strict=True
    ):
        if not np.isfinite(cov).all():
            continue
        # ascending: the last direction is that of the long axis, which matplotlib calls the width
        variances, directions = np.linalg.eigh(cov)
        width, height = scale * np.sqrt(np.maximum(variances[::-1], 0.0))
        angle = np.degrees(np.arctan2(directions[1, 1], directions[0, 1]))
        ellipses.append(
            Ellipse(
                (position[0], position[1]),
                width,
                height,
                angle=angle,
                fill=False,
                edgecolor=edge,
                zorder=4,
            )
        )
    return ellipses


def label_landmarks(panel: Axes, comparison: Comparison) -> None:
    """Write names beside landmarks in view: true ones, and of the first map those without an identity, or all."""
    true = true_landmarks_drawn(comparison)
    maps = [run.landmarks for run in comparison.runs if run.landmarks]
    shown = [] if true is None else [(true.ids, true.positions)]
    if maps:
        is_shown = maps[0].ids >= (0 if true is None else FIRST_ANONYMOUS_ID)
        shown.append((maps[0].ids[is_shown], maps[0].positions[is_shown]))
    if not shown:
        return
    ids = np.concatenate([own for own, _ in shown])
    points = np.concatenate([positions[:, :2] for _, positions in shown])
    low, high = np.array([panel.get_xlim(), panel.get_ylim()]).T
    # a name outside the view would stand at the edge of the paper
    rows = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    names = [landmark_name(identity) for identity in ids[rows].tolist()]
    style.label_points(panel, names, points[rows])


def horizontal(trajectory: Trajectory) -> tuple[Floats, Floats]:
    """World x and y of at most `PATH_POINTS` poses."""
    rows = style.evenly(len(trajectory), PATH_POINTS)
    return trajectory.positions[rows, 0], trajectory.positions[rows, 1]


def growth_figure(comparison: Comparison) -> Figure | None:
    """A row a run, a column a time: causal path until then, landmarks with ellipses as known then."""
    view = map_view(comparison)
    runs = _runs_with_maps(comparison)
    if view is None or not runs:
        return None
    view = with_room(view)
    stamps_ns = grown_at(comparison)
    enlarged = enlargement(comparison)
    size = style.width_in(), style.width_in()
    figure, axes = style.blank_panels(
        len(runs), len(stamps_ns), size, sharex=True, sharey=True
    )
    true = true_landmarks_drawn(comparison)
    truth = comparison.sequence.truth
    marks = {"markersize": 7, "markeredgewidth": 1.2, "color": style.INK}
    for panels, (index, run) in zip(axes, runs.items(), strict=True):
        own = style.colour(index)
        panels[0].set_ylabel(f"{run.estimator}\nworld y (m)")
        # a run may have kept its map at other instants too
        known_at = {known.stamp_ns: known.landmarks for known in run.maps}
        for panel, stamp_ns in zip(panels, stamps_ns.tolist(), strict=True):
            look = style.TRUTH_LOOK | {"linewidth": 2.6}
            _draw_until(panel, stamp_ns, truth, label="truth", **look)
            look = {"color": own, "linewidth": 1.0}
            _draw_until(panel, stamp_ns, run.causal, label="causal estimate", **look)
            if true is not None:
                x_y = true.positions.T[:2]
                panel.plot(*x_y, "+", label="true landmarks", **marks)
            if stamp_ns in known_at:
                x_y = known_at[stamp_ns].positions.T[:2]
                look = {"color": own, "markersize": 2.5}
                panel.plot(*x_y, "o", label="estimated landmarks", **look)
                for ellipse in ellipses(known_at[stamp_ns], own, enlarged):
                    panel.add_patch(ellipse)
            panel.set(xlim=view[:, 0], ylim=view[:, 1])
            panel.set_aspect("equal", adjustable="box")
    seconds = style.seconds_since_start(comparison, stamps_ns)
    for top, bottom, at_s in zip(axes[0], axes[-1], seconds, strict=True):
        style.head_panel(top, f"T = {at_s:.1f} s")
        bottom.set_xlabel("world x (m)")
    style.legend_above(figure, axes[0, 0])
    style.arrange(figure)
    for panel in axes.flat:
        label_landmarks(panel, comparison)
    return figure


def grown_at(comparison: Comparison) -> Ints:
    """Stamps at which the growing map is drawn, shape (n,)."""
    runs = _runs_with_maps(comparison).values()
    kept = [known.stamp_ns for run in runs for known in run.maps]
    asked = map_instants(comparison.instants_ns, comparison.sequence.start_ns)
    return np.intersect1d(kept, asked)


def enlargement(comparison: Comparison) -> int:
    """The factor by which ellipses are enlarged, so that they can be seen and do not cover each other."""
    view = map_view(comparison)
    grown_ns = grown_at(comparison)
    variances = [
        np.linalg.eigvalsh(cov).max()
        for run in _runs_with_maps(comparison).values()
        for known in run.maps
        if known.stamp_ns in grown_ns
        for cov in known.landmarks.covariances[:, :2, :2]
        if np.isfinite(cov).all()
    ]
    if view is None or not variances:
        return 1
    # relative to the view: what can be seen depends on the size of the picture
    room_m = LARGEST_ELLIPSE * float(np.ptp(view, axis=0).max())
    radius = chi_square_quantile(ELLIPSE_PROBABILITY, 2)
    half_m = math.sqrt(max(variances) * radius)
    return max((factor for factor in ENLARGED if factor * half_m <= room_m), default=1)


def _runs_with_maps(comparison: Comparison) -> dict[int, RunResult]:
    """Runs that kept a map with landmarks, by their index."""
    return {
        index: run
        for index, run in enumerate(comparison.runs)
        if any(len(known.landmarks) for known in run.maps)
    }


def _draw_until(
    panel: Axes, stamp_ns: int, path: Trajectory | None, **look: Any
) -> None:
    """The path until an instant."""
    if path is not None and (path.stamps_ns <= stamp_ns).any():
        until = path.rows(np.flatnonzero(path.stamps_ns <= stamp_ns))
        panel.plot(*horizontal(until), **look)
