"""Figures of paths over time: errors, their bounds, the place on the own map, heading and NEES.

Each is a pure function to a matplotlib figure, None where there is nothing to draw. Estimators keep their colour in all
figures. Angles are drawn in degrees. Runs share their axes; one whose errors are far larger leaves the picture, because
a common scale would flatten the others.
"""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sonar_graph.evaluation import (
    Comparison,
    ErrorSeries,
    RunResult,
    own_map_errors,
    yaw_rad,
)
from sonar_graph.measurements import Floats
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.report import figure_style as style
from sonar_graph.states import Trajectory

DISTANCE_LABEL = "distance travelled (m)"
BAND_PROBABILITY = 0.95
BAND_SIGMAS = math.sqrt(chi_square_quantile(BAND_PROBABILITY, 1))
"""1.96: half the width of the band of one error, in standard deviations."""
NEES_FLOOR = 1e-3
"""Smaller values are drawn at the edge: below the band it does not matter how far."""
NEES_MEANS = 40
"""Stretches of the run over which NEES is averaged for the line among the dots."""
LARGER = 5.0
"""An error this many times the largest of the best run leaves the picture."""
ROOM = 1.15
"""Upper end of an axis of errors, in the largest error."""


def error_figure(comparison: Comparison) -> Figure | None:
    """Size of the causal errors of position and heading of all runs, over time and over the distance travelled."""
    runs = _runs_with_errors(comparison)
    if not runs:
        return None
    series = [
        (index, comparison.errors[run.estimator]["causal"]) for index, run in runs
    ]
    labels = ["position error (m)", *(["yaw error (°)"] if has_yaw(comparison) else [])]
    figure, axes = style.blank_panels(
        len(labels),
        2,
        style.size_in(len(labels)),
        sharex="col",
        sharey="row",
        width_ratios=[1.0, 1.0],
    )
    for (index, errors), (_, run) in zip(series, runs, strict=True):
        look = {
            "color": style.colour(index),
            "linestyle": style.line_style(index),
            "linewidth": 1.2,
        }
        seconds = style.seconds_since_start(comparison, errors.stamps_ns)
        for row, error in enumerate(_sizes(errors)[: len(labels)]):
            rows = style.thinned(error, style.SERIES_POINTS // 2)
            for panel, along in zip(
                axes[row], (seconds, distance_m(run, errors)), strict=True
            ):
                panel.plot(along[rows], error[rows], label=run.estimator, **look)
    for row, label in enumerate(labels):
        axes[row, 0].set_ylim(
            0.0, ROOM * shared_limit([_sizes(errors)[row] for _, errors in series])
        )
        for column, name in enumerate((style.TIME_LABEL, DISTANCE_LABEL)):
            style.name_axes(
                axes[row, column],
                name if row == len(labels) - 1 else "",
                "" if column else label,
            )
    style.legend_above(figure, axes[0, 0])
    return figure


def _sizes(errors: ErrorSeries) -> list[Floats]:
    """Horizontal position error, metres, and size of the heading's error, degrees; each of shape (n,)."""
    return [np.hypot(*errors.position_m[:, :2].T), np.abs(np.degrees(errors.yaw_rad))]


def distance_m(run: RunResult, errors: ErrorSeries) -> Floats:
    """Distance that the truth has travelled until each scored instant, from the first one, shape (n,)."""
    assert run.causal is not None, "a run with errors has a path"
    rows = np.searchsorted(run.causal.stamps_ns, errors.stamps_ns)
    # estimate minus error is the true path; an estimate's own would be another distance for each run
    steps = np.diff(run.causal.positions[rows] - errors.position_m, axis=0)
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])


def shared_limit(sizes: list[Floats]) -> float:
    """The largest error that runs show on a common axis: of all, or `LARGER` times that of the best run."""
    largest = [
        float(np.nanmax(values)) for values in sizes if np.isfinite(values).any()
    ]
    return max(min(max(largest, default=0.0), LARGER * min(largest, default=0.0)), 1e-9)


def errors_cut_off(comparison: Comparison) -> list[str]:
    """Names of runs of which an error leaves the picture."""
    sizes = {
        run.estimator: _sizes(comparison.errors[run.estimator]["causal"])
        for _, run in _runs_with_errors(comparison)
    }
    limits = [
        ROOM * shared_limit([both[row] for both in sizes.values()]) for row in (0, 1)
    ]
    return [
        name
        for name, both in sizes.items()
        if any(
            np.nanmax(own, initial=0.0) > limit
            for own, limit in zip(both, limits, strict=True)
        )
    ]


def bounds_figure(comparison: Comparison) -> Figure | None:
    """Causal error in x, y, (z) and yaw over time with the reported 95 % band: a row for each quantity, a column a run."""
    runs = _runs_with_errors(comparison)
    if not runs:
        return None
    series = [comparison.errors[run.estimator]["causal"] for _, run in runs]
    axes_count = max(errors.position_dof for errors in series)
    labels = [f"error in {'xyz'[axis]} (m)" for axis in range(axes_count)]
    labels += ["yaw error (°)"] if has_yaw(comparison) else []
    figure, axes = style.blank_panels(
        len(labels),
        len(runs),
        style.size_in(len(labels), 1.45),
        sharex=True,
        sharey="row",
    )
    points = style.SERIES_POINTS // min(len(runs), 2)
    for row, label in enumerate(labels):
        drawn = [
            _signed(errors, row if row < axes_count else None) for errors in series
        ]
        limit = ROOM * shared_limit(
            [np.fmax(np.abs(error), BAND_SIGMAS * sigma) for error, sigma in drawn]
        )
        axes[row, 0].set_ylim(-limit, limit)
        for column, ((index, run), errors, (error, sigma)) in enumerate(
            zip(runs, series, drawn, strict=True)
        ):
            panel: Axes = axes[row, column]
            seconds = style.seconds_since_start(comparison, errors.stamps_ns)
            if np.isfinite(sigma).any():
                band = np.union1d(
                    style.evenly(len(sigma), points // 4),
                    style.thinned(sigma, points // 4),
                )
                half = BAND_SIGMAS * sigma[band]
                panel.fill_between(
                    seconds[band],
                    -half,
                    half,
                    color=style.colour(index),
                    alpha=0.2,
                    linewidth=0,
                )
            rows = style.thinned(error, points)
            panel.axhline(0.0, color=style.MUTED, linewidth=0.7)
            panel.plot(
                seconds[rows], error[rows], color=style.colour(index), linewidth=1.1
            )
            style.name_axes(
                panel,
                style.TIME_LABEL if row == len(labels) - 1 else "",
                "" if column else label,
            )
            if row == 0:
                style.head_panel(panel, run.estimator, style.colour(index))
    return figure


def _signed(errors: ErrorSeries, axis: int | None) -> tuple[Floats, Floats]:
    """Error along an axis with its sigma, metres; of the heading, degrees, without one."""
    if axis is None:
        return np.degrees(errors.yaw_rad), np.degrees(errors.yaw_sigma_rad)
    return errors.position_m[:, axis], errors.position_sigma_m[:, axis]


def own_map_figure(comparison: Comparison) -> Figure | None:
    """Causal position error of each run on the map that it had at that instant."""
    found = {}
    for index, run in enumerate(comparison.runs):
        scored = comparison.errors.get(run.estimator, {}).get("causal")
        if scored is not None and len(
            (series := own_map_errors(run, comparison.sequence, scored.stamps_ns))[0]
        ):
            found[index] = series
    if not found:
        return None
    figure, axes = style.blank_panels(1, 1, style.size_in(1))
    panel: Axes = axes[0, 0]
    for index, (stamps_ns, errors_m) in found.items():
        seconds = style.seconds_since_start(comparison, stamps_ns)
        look = {
            "color": style.colour(index),
            "linestyle": style.line_style(index),
            "linewidth": 1.3,
        }
        panel.plot(
            seconds,
            errors_m,
            marker="o",
            markersize=3.5,
            label=comparison.runs[index].estimator,
            **look,
        )
    panel.set_ylim(bottom=0.0)
    style.name_axes(panel, style.TIME_LABEL, "own-map error (m)")
    style.legend_above(figure, panel)
    return figure


def yaw_figure(comparison: Comparison) -> Figure | None:
    """Heading of truth and causal estimates over time, wrapped to ±180°."""
    runs = [
        (i, run.causal)
        for i, run in enumerate(comparison.runs)
        if run.causal is not None and len(run.causal)
    ]
    if not runs:
        return None
    figure, axes = style.blank_panels(1, 1, style.size_in(1))
    panel: Axes = axes[0, 0]
    truth = comparison.sequence.true_poses
    if truth is not None and len(truth):
        seconds, degrees = _headings(comparison, truth)
        panel.plot(
            seconds, degrees, color=style.TRUTH, linewidth=3.2, alpha=0.6, label="truth"
        )
    for index, path in runs:
        seconds, degrees = _headings(comparison, path)
        label = comparison.runs[index].estimator
        panel.plot(
            seconds,
            degrees,
            color=style.colour(index),
            linestyle=style.line_style(index),
            linewidth=1.2,
            label=label,
        )
    panel.set(ylim=(-185, 185), yticks=[-180, -90, 0, 90, 180])
    style.name_axes(panel, style.TIME_LABEL, "yaw (°)")
    style.legend_above(figure, panel)
    return figure


def nees_figure(comparison: Comparison) -> Figure | None:
    """Causal NEES of position and yaw over time per degree of freedom, with the two-sided 95 % chi-square band."""
    runs = []
    for index, run in _runs_with_errors(comparison):
        errors = comparison.errors[run.estimator]["causal"]
        if (
            np.isfinite(errors.nees_position).any()
            or np.isfinite(errors.nees_yaw).any()
        ):
            runs.append((index, run, errors))
    if not runs:
        return None
    has_yaw = any(np.isfinite(errors.nees_yaw).any() for _, _, errors in runs)
    count = 2 if has_yaw else 1
    figure, axes = style.blank_panels(
        count, 1, style.size_in(count, 2.1), sharex=True, sharey=True
    )
    for row, label in enumerate(("position", "yaw")[:count]):
        panel: Axes = axes[row, 0]
        style.logarithmic(panel, "y")
        dof = runs[0][2].position_dof if row == 0 else 1
        low, high = _band(dof)
        panel.axhspan(low, high, color=style.TRUTH, alpha=0.25, linewidth=0)
        panel.axhline(1.0, color=style.MUTED, linewidth=0.7)
        inside: list[str] = []
        for index, run, errors in runs:
            per_dof = (errors.nees_position, errors.nees_yaw)[row] / dof
            seconds = style.seconds_since_start(comparison, errors.stamps_ns)
            _draw_nees(panel, seconds, per_dof, index, run.estimator)
            known = per_dof[np.isfinite(per_dof)]
            if known.size:
                share = float(np.mean((known >= low) & (known <= high)))
                inside.append(f"{run.estimator}: {100 * share:.0f} % in the band")
        panel.text(
            0.02,
            0.04,
            "\n".join(inside),
            transform=panel.transAxes,
            color=style.INK,
        )
        style.name_axes(
            panel, style.TIME_LABEL if row == count - 1 else "", f"{label} NEES / dof"
        )
    style.legend_above(figure, axes[0, 0])
    return figure


def _runs_with_errors(comparison: Comparison) -> list[tuple[int, RunResult]]:
    return [
        (index, run)
        for index, run in enumerate(comparison.runs)
        if "causal" in (series := comparison.errors.get(run.estimator, {}))
        and len(series["causal"].stamps_ns)
    ]


def has_yaw(comparison: Comparison) -> bool:
    """True where a run has errors of heading."""
    series = (
        comparison.errors[run.estimator]["causal"]
        for _, run in _runs_with_errors(comparison)
    )
    return any(np.isfinite(errors.yaw_rad).any() for errors in series)


def _headings(comparison: Comparison, path: Trajectory) -> tuple[Floats, Floats]:
    """Seconds and degrees, with a gap wherever the heading passes ±180°."""
    degrees = np.degrees(yaw_rad(path.matrices))
    rows = np.union1d(
        style.evenly(len(degrees), 2 * style.SERIES_POINTS), style.thinned(degrees)
    )
    seconds, degrees = (
        style.seconds_since_start(comparison, path.stamps_ns)[rows],
        degrees[rows],
    )
    # a NaN interrupts the line, which else crosses the panel at every turn past 180°
    jumps = np.flatnonzero(np.abs(np.diff(degrees)) > 180) + 1
    return np.insert(seconds, jumps, np.nan), np.insert(degrees, jumps, np.nan)


def _band(dof: int) -> tuple[float, float]:
    """The values per degree of freedom between which those of a consistent estimator are in `BAND_PROBABILITY`."""
    low, high = (
        chi_square_quantile((1 + side * BAND_PROBABILITY) / 2, dof) / dof
        for side in (-1, 1)
    )
    return low, high


def _draw_nees(
    panel: Axes, seconds: Floats, per_dof: Floats, index: int, label: str
) -> None:
    """Instants as dots, and a line through the means of `NEES_MEANS` stretches."""
    known = per_dof[np.isfinite(per_dof)]
    panel.set_ylim(
        NEES_FLOOR, max(panel.get_ylim()[1], 10.0, 2 * float(known.max(initial=0.0)))
    )
    rows = style.evenly(len(per_dof), style.SERIES_POINTS // 4)
    style.dots(
        panel, seconds[rows], np.maximum(per_dof[rows], NEES_FLOOR), style.colour(index)
    )
    stretches = [
        rows
        for rows in np.array_split(np.flatnonzero(np.isfinite(per_dof)), NEES_MEANS)
        if rows.size
    ]
    middles, means = (
        [values[rows].mean() for rows in stretches] for values in (seconds, per_dof)
    )
    look = {
        "color": style.colour(index),
        "linestyle": style.line_style(index),
        "linewidth": 1.6,
    }
    panel.plot(middles, means, label=label, **look)
