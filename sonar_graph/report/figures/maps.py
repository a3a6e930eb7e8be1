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
    if factor > 1:
        view = widened(view, LARGEST_ELLIPSE * size_of(view))
    figure, axes = style.blank_panels(1, 1, (style.width_in(),) * 2)
    panel: Axes = axes[0, 0]
    look: dict[str, Any] = {"color": style.INK, "markersize": 9, "markeredgewidth": 1.4}
    draw_path(
        panel, comparison.sequence.truth, label="truth", zorder=1, **style.TRUTH_LOOK
    )
    # in the world of the estimates, as paths are
    if true := true_landmarks_drawn(comparison):
        draw_points(panel, true, "+", label="true landmarks", zorder=5, **look)
    for index, run in enumerate(comparison.runs):
        own = style.colour(index)
        look = style.run_look(index, 1.3)
        draw_path(panel, run.causal, label=run.estimator, zorder=3, **look)
        if smoothed_differs(run):
            look = {"linestyle": (0, (1, 1)), "linewidth": 1.9, "alpha": 0.75}
            look |= {"label": f"{run.estimator}, smoothed", "color": own, "zorder": 2}
            draw_path(panel, run.smoothed, **look)
        if run.landmarks:
            look = {"markersize": 3.5, "markerfacecolor": "none", "zorder": 4}
            mark = "os^Dv<"[index % 6]
            draw_points(panel, run.landmarks, mark, color=own, **look)
            draw_ellipses(panel, run.landmarks, own, factor)
    draw_given_map(panel, comparison)
    frame(panel, landscape(view))
    panel.set(xlabel="world x (m)", ylabel="world y (m)")
    style.legend_above(figure, panel)
    # the room for names is measured on the figure as it will be
    style.arrange(figure)
    label_landmarks(panel, comparison)
    return figure


def draw_path(
    panel: Axes, path: Trajectory | None, until_ns: float = math.inf, **look: Any
) -> None:
    """Draw at most `PATH_POINTS` poses of a path until an instant; nothing where there are none."""
    shown = path.positions[path.stamps_ns <= until_ns, :2] if path else ()
    if len(shown):
        panel.plot(*shown[style.evenly(len(shown), PATH_POINTS)].T, **look)


def draw_points(panel: Axes, landmarks: LandmarkMap, mark: str, **look: Any) -> None:
    """Draw the places of landmarks."""
    panel.plot(*landmarks.positions.T[:2], mark, **look)


def frame(panel: Axes, view: Floats) -> None:
    """Let a panel show this view, a metre as long in x as in y."""
    panel.set(xlim=view[:, 0], ylim=view[:, 1])
    panel.set_aspect("equal", adjustable="box")


def landscape(view: Floats) -> Floats:
    """The view, widened until its height is at most `HIGHEST` of its width, so that a map fits a screen."""
    width, height = view[1] - view[0]
    missing = max(height / HIGHEST - width, 0.0)
    return view + np.array([[-missing / 2, 0.0], [missing / 2, 0.0]])


def true_landmarks_drawn(comparison: Comparison) -> LandmarkMap | None:
    """The true landmarks in the world of the start pose; landmarks of another world are aligned to the first map."""
    true = comparison.sequence.true_landmarks
    # the first map decides, so that all are drawn in one world
    first = next(iter(comparison.maps), None)
    scored = scored_map(first, comparison.sequence) if first else None
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
    if not run.smoothed or run.causal is None:
        return bool(run.smoothed)
    # a start that is found in a map gives smoothed poses where there is no causal one
    _, rows, of_causal = np.intersect1d(
        run.smoothed.stamps_ns, run.causal.stamps_ns, return_indices=True
    )
    apart = run.smoothed.positions[rows] - run.causal.positions[of_causal]
    return len(rows) < len(run.causal) or bool(np.abs(apart).max(initial=0.0) > SAME_M)


def _paths(run: RunResult) -> list[Floats]:
    return [path.positions[:, :2] for path in (run.causal, run.smoothed) if path]


def map_view(comparison: Comparison) -> Floats | None:
    """Lower left and upper right corner of the map, shape (2, 2), metres; None where there is no path."""
    estimates = [path for run in comparison.runs for path in _paths(run)]
    truth = comparison.sequence.truth
    references = [truth.positions[:, :2]] if truth else []
    if not references and not estimates:
        return None
    if true := true_landmarks_drawn(comparison):
        references.append(true.positions[:, :2])

    def box(points: Floats) -> Floats:
        return np.array([np.nanmin(points, axis=0), np.nanmax(points, axis=0)])

    # an estimate that diverges must not shrink the truth to a point: the truth sets the scale
    anchor = box(np.vstack(references or estimates))
    largest = max(size_of(anchor), 1.0)
    limits = widened(anchor, MARGIN * largest)
    places = [landmarks.positions[:, :2] for landmarks in comparison.maps]
    everything = np.vstack([anchor, *estimates, *places])
    shown = box(np.clip(everything[np.isfinite(everything).all(axis=1)], *limits))
    return widened(shown, 0.04 * largest)


def size_of(view: Floats) -> float:
    """The longer side of a view, metres."""
    return float(np.max(view[1] - view[0]))


def widened(view: Floats, margin_m: float) -> Floats:
    """The view with a margin on all sides."""
    return view + np.array([[-1.0], [1.0]]) * margin_m


def draw_ellipses(
    panel: Axes, landmarks: LandmarkMap, edge: str, enlarged: float
) -> None:
    """Draw ellipses that hold each landmark with `ELLIPSE_PROBABILITY`; none where the covariance is unknown."""
    scale = enlarged * 2 * math.sqrt(chi_square_quantile(ELLIPSE_PROBABILITY, 2))
    covs = landmarks.covariances[:, :2, :2]
    for position, cov in zip(landmarks.positions, covs, strict=True):
        if not np.isfinite(cov).all():
            continue
        # ascending: the last direction is that of the long axis, which matplotlib calls the width
        variances, directions = np.linalg.eigh(cov)
        size = scale * np.sqrt(np.maximum(variances[::-1], 0.0))
        angle = np.degrees(np.arctan2(directions[1, 1], directions[0, 1]))
        look: dict[str, Any] = {"fill": False, "edgecolor": edge, "zorder": 4}
        panel.add_patch(Ellipse(position[:2], *size, angle=angle, **look))


def label_landmarks(panel: Axes, comparison: Comparison) -> None:
    """Write names beside landmarks in view: true ones, and of the first map those without an identity, or all."""
    true = true_landmarks_drawn(comparison)
    shown = [] if true is None else [(true.ids, true.positions)]
    for first in comparison.maps[:1]:
        is_shown = first.ids >= (0 if true is None else FIRST_ANONYMOUS_ID)
        shown.append((first.ids[is_shown], first.positions[is_shown]))
    if not shown:
        return
    ids, points = map(np.concatenate, zip(*shown, strict=True))
    points = points[:, :2]
    low, high = np.array([panel.get_xlim(), panel.get_ylim()]).T
    # a name outside the view would stand at the edge of the paper
    is_inside = ((points >= low) & (points <= high)).all(axis=1)
    names = [landmark_name(identity) for identity in ids[is_inside].tolist()]
    style.label_points(panel, names, points[is_inside])


def growth_figure(comparison: Comparison) -> Figure | None:
    """A row a run, a column a time: causal path until then, landmarks with ellipses as known then."""
    view = map_view(comparison)
    runs = _runs_with_maps(comparison)
    if view is None or not runs:
        return None
    view = widened(view, LARGEST_ELLIPSE * size_of(view))
    stamps_ns = grown_at(comparison)
    enlarged = enlargement(comparison)
    figure, axes = style.blank_panels(
        len(runs), len(stamps_ns), (style.width_in(),) * 2, sharex=True, sharey=True
    )
    true = true_landmarks_drawn(comparison)
    truth = comparison.sequence.truth
    for panels, (index, run) in zip(axes, runs.items(), strict=True):
        own = style.colour(index)
        panels[0].set_ylabel(f"{run.estimator}\nworld y (m)")
        # a run may have kept its map at other instants too
        known_at = {known.stamp_ns: known.landmarks for known in run.maps}
        for panel, stamp_ns in zip(panels, stamps_ns.tolist(), strict=True):
            look = style.TRUTH_LOOK | {"linewidth": 2.6}
            draw_path(panel, truth, stamp_ns, label="truth", **look)
            look = {"color": own, "linewidth": 1.0}
            draw_path(panel, run.causal, stamp_ns, label="causal estimate", **look)
            if true is not None:
                look = {"markersize": 7, "markeredgewidth": 1.2, "color": style.INK}
                draw_points(panel, true, "+", label="true landmarks", **look)
            if stamp_ns in known_at:
                known = known_at[stamp_ns]
                look = {"color": own, "markersize": 2.5}
                draw_points(panel, known, "o", label="estimated landmarks", **look)
                draw_ellipses(panel, known, own, enlarged)
            frame(panel, view)
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
    room_m = LARGEST_ELLIPSE * size_of(view)
    radius = chi_square_quantile(ELLIPSE_PROBABILITY, 2)
    half_m = math.sqrt(max(variances) * radius)
    return max((factor for factor in ENLARGED if factor * half_m <= room_m), default=1)


def _runs_with_maps(comparison: Comparison) -> dict[int, RunResult]:
    """Runs that kept a map with landmarks, by their index."""
    return {
        index: run
        for index, run in enumerate(comparison.runs)
        if any(known.landmarks for known in run.maps)
    }
