"""Figures of paths over time: errors, their bounds, heading and NEES.

Each is a pure function to a matplotlib figure, None where there is nothing to draw. Estimators keep their colour in all
figures. Angles are drawn in degrees. Runs share their axes; one whose errors are far larger leaves the picture, because
a common scale would flatten the others.
"""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sonar_graph.evaluation import Comparison, ErrorSeries, RunResult, yaw_rad
from sonar_graph.measurements import Floats
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.report import figure_style as style
from sonar_graph.states import Trajectory

DISTANCE_LABEL = "distance travelled (m)"
BAND_PROBABILITY = 0.95
# 1.96: half the width of the band of one error, in standard deviations
BAND_SIGMAS = math.sqrt(chi_square_quantile(BAND_PROBABILITY, 1))
# smaller values are drawn at the edge: below the band it does not matter how far
NEES_FLOOR = 1e-3
# stretches of the run over which NEES is averaged for the line among the dots
NEES_MEANS = 40
# an error this many times the largest of the best run leaves the picture
LARGER = 5.0
# upper end of an axis of errors, in the largest error
ROOM = 1.15


def error_figure(comparison: Comparison) -> Figure | None:
    """Size of the causal errors of position and heading of all runs, over time and over the distance travelled."""
    series = _causal_errors(comparison)
    if not series:
        return None
    sizes = {index: _sizes(errors) for index, errors in series.items()}
    labels = ["position error (m)", "yaw error (°)"][: 1 + has_yaw(comparison)]
    size_in = style.size_in(len(labels))
    figure, axes = style.blank_panels(
        len(labels), 2, size_in, sharex="col", sharey="row"
    )
    for index, errors in series.items():
        run = comparison.runs[index]
        seconds = style.seconds_since_start(comparison, errors.stamps_ns)
        for row, panels in enumerate(axes):
            error = sizes[index][row]
            rows = style.thinned(error, style.SERIES_POINTS // 2)
            look = style.run_look(index, 1.2)
            for panel, along in zip(
                panels, (seconds, distance_m(run, errors)), strict=True
            ):
                panel.plot(along[rows], error[rows], label=run.estimator, **look)
    for row, label in enumerate(labels):
        # one scale for all, or a small error would look like a large one
        limit = shared_limit([both[row] for both in sizes.values()])
        axes[row, 0].set_ylim(0.0, ROOM * limit)
        axes[row, 0].set_ylabel(label)
    for column, label in enumerate((style.TIME_LABEL, DISTANCE_LABEL)):
        axes[-1, column].set_xlabel(label)
    style.legend_above(figure, axes[0, 0])
    return figure


def _sizes(errors: ErrorSeries) -> list[Floats]:
    """Horizontal position error, metres, and size of the heading's error, degrees; each of shape (n,)."""
    return [np.hypot(*errors.position_m[:, :2].T), np.abs(np.degrees(errors.yaw_rad))]


def distance_m(run: RunResult, errors: ErrorSeries) -> Floats:
    """Distance that the truth has travelled until each scored instant, from the first one, shape (n,)."""
    assert run.causal is not None, "a run with errors has a path"
    # scored instants are some of the path's own
    rows = np.searchsorted(run.causal.stamps_ns, errors.stamps_ns)
    # estimate minus error is the true path; an estimate's own would be another distance for each run
    steps = np.diff(run.causal.positions[rows] - errors.position_m, axis=0)
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])


def shared_limit(sizes: list[Floats]) -> float:
    """Upper end of a common axis: the largest error of all runs, at most `LARGER` times that of the best run."""
    # a run without an error of this kind has NaN throughout
    largest = [
        float(np.nanmax(values)) for values in sizes if np.isfinite(values).any()
    ]
    return max(min(max(largest, default=0.0), LARGER * min(largest, default=0.0)), 1e-9)


def errors_cut_off(comparison: Comparison) -> list[str]:
    """Names of runs with an error that leaves the picture."""
    series = _causal_errors(comparison)
    largest = np.array(
        [
            [np.nanmax(own, initial=0.0) for own in _sizes(errors)]
            for errors in series.values()
        ]
    ).reshape(-1, 2)  # (runs, position and heading)
    limits = [ROOM * shared_limit(list(column[:, None])) for column in largest.T]
    is_cut = np.any(largest > limits, axis=1).tolist()
    return [
        comparison.runs[index].estimator
        for index, is_out in zip(series, is_cut, strict=True)
        if is_out
    ]


def bounds_figure(comparison: Comparison) -> Figure | None:
    """Causal error in x, y, (z) and yaw over time with the reported 95 % band: a row for each quantity, a column a run."""
    series = _causal_errors(comparison)
    if not series:
        return None
    axes_count = max(errors.position_dof for errors in series.values())
    labels = [f"error in {'xyz'[axis]} (m)" for axis in range(axes_count)]
    labels += ["yaw error (°)"] if has_yaw(comparison) else []
    size_in = style.size_in(len(labels), 1.45)
    figure, axes = style.blank_panels(
        len(labels), len(series), size_in, sharex=True, sharey="row"
    )
    # columns beside each other are narrow: fewer points are seen
    points = style.SERIES_POINTS // min(len(series), 2)
    for row, label in enumerate(labels):
        limit = 0.0
        drawn = []
        for index, errors in series.items():
            error = np.degrees(errors.yaw_rad)  # (n,)
            sigma = np.degrees(errors.yaw_sigma_rad)  # (n,)
            if row < axes_count:
                error = errors.position_m[:, row]
                sigma = errors.position_sigma_m[:, row]
            drawn.append((index, errors, error, BAND_SIGMAS * sigma))
        limit = ROOM * shared_limit(
            [np.fmax(np.abs(error), half) for _, _, error, half in drawn]
        )
        axes[row, 0].set(ylim=(-limit, limit), ylabel=label)
        for panel, (index, errors, error, half) in zip(axes[row], drawn, strict=True):
            seconds = style.seconds_since_start(comparison, errors.stamps_ns)
            own = style.colour(index)
            # an estimator may report no covariance
            if np.isfinite(half).any():
                band = style.evenly_with_extremes(half, points // 4)
                panel.fill_between(
                    seconds[band], -half[band], half[band], color=own, alpha=0.2, lw=0
                )
            rows = style.thinned(error, points)
            panel.axhline(0.0, color=style.MUTED, linewidth=0.7)
            panel.plot(seconds[rows], error[rows], color=own, linewidth=1.1)
    for panel, last, index in zip(axes[0], axes[-1], series, strict=True):
        style.head_panel(panel, comparison.runs[index].estimator, style.colour(index))
        last.set_xlabel(style.TIME_LABEL)
    return figure


def yaw_figure(comparison: Comparison) -> Figure | None:
    """Heading of truth and causal estimates over time, wrapped to ±180°."""
    truth = comparison.sequence.true_poses
    looks: dict[str, dict[str, Any]] = {
        run.estimator: style.run_look(index, 1.2)
        for index, run in enumerate(comparison.runs)
        if run.causal is not None and len(run.causal)
    }
    if not looks:
        return None
    figure, panel = style.one_panel()
    paths = {run.estimator: run.causal for run in comparison.runs}
    if truth is not None and len(truth):
        looks = {"truth": style.TRUTH_LOOK} | looks
        paths["truth"] = truth
    for name, look in looks.items():
        path = paths[name]
        assert path is not None, "runs without a path have no look"
        panel.plot(*_headings(comparison, path), label=name, **look)
    panel.set(ylim=(-185, 185), yticks=[-180, -90, 0, 90, 180])
    panel.set(xlabel=style.TIME_LABEL, ylabel="yaw (°)")
    style.legend_above(figure, panel)
    return figure


def nees_figure(comparison: Comparison) -> Figure | None:
    """Causal NEES of position and yaw over time per degree of freedom, with the two-sided 95 % chi-square band."""
    series = {
        index: errors
        for index, errors in _causal_errors(comparison).items()
        if np.isfinite([errors.nees_position, errors.nees_yaw]).any()
    }
    if not series:
        return None
    position_dof = next(iter(series.values())).position_dof
    per_dof = {
        "position": {i: one.nees_position / position_dof for i, one in series.items()},
        "yaw": {index: errors.nees_yaw for index, errors in series.items()},
    }
    if not np.isfinite([*per_dof["yaw"].values()]).any():
        del per_dof["yaw"]
    size_in = style.size_in(len(per_dof), 2.1)
    figure, axes = style.blank_panels(
        len(per_dof), 1, size_in, sharex=True, sharey=True
    )
    for panel, (label, values) in zip(axes[:, 0], per_dof.items(), strict=True):
        style.logarithmic(panel, "y")
        # chi-square with the degrees of freedom of the error
        low, high = _band(position_dof if label == "position" else 1)
        panel.axhspan(low, high, color=style.TRUTH, alpha=0.25, linewidth=0)
        panel.axhline(1.0, color=style.MUTED, linewidth=0.7)
        inside: list[str] = []
        for index, nees in values.items():
            name = comparison.runs[index].estimator
            seconds = style.seconds_since_start(comparison, series[index].stamps_ns)
            _draw_nees(panel, seconds, nees, index, name)
            known = nees[np.isfinite(nees)]
            if known.size:
                share = float(np.mean((known >= low) & (known <= high)))
                inside.append(f"{name}: {100 * share:.0f} % in the band")
        text = "\n".join(inside)
        panel.text(0.02, 0.04, text, transform=panel.transAxes, color=style.INK)
        panel.set_ylabel(f"{label} NEES / dof")
    axes[-1, 0].set_xlabel(style.TIME_LABEL)
    style.legend_above(figure, axes[0, 0])
    return figure


def _causal_errors(comparison: Comparison) -> dict[int, ErrorSeries]:
    """Causal errors by the index of the run, where there are any."""
    found = {
        index: comparison.errors.get(run.estimator, {}).get("causal")
        for index, run in enumerate(comparison.runs)
    }
    return {i: errors for i, errors in found.items() if errors and len(errors.yaw_rad)}


def has_yaw(comparison: Comparison) -> bool:
    """True where a run has errors of heading."""
    series = _causal_errors(comparison).values()
    return any(np.isfinite(errors.yaw_rad).any() for errors in series)


def _headings(comparison: Comparison, path: Trajectory) -> tuple[Floats, Floats]:
    """Seconds and degrees, with a gap wherever the heading passes ±180°."""
    degrees = np.degrees(yaw_rad(path.matrices))
    rows = style.evenly_with_extremes(degrees, style.SERIES_POINTS)
    seconds = style.seconds_since_start(comparison, path.stamps_ns[rows])
    degrees = degrees[rows]
    # a NaN interrupts the line, which else crosses the panel at every turn past 180°
    jumps = np.flatnonzero(np.abs(np.diff(degrees)) > 180) + 1
    return np.insert(seconds, jumps, np.nan), np.insert(degrees, jumps, np.nan)


def _band(dof: int) -> tuple[float, float]:
    """The values per degree of freedom between which those of a consistent estimator are in `BAND_PROBABILITY`."""
    tail = (1 - BAND_PROBABILITY) / 2
    low = chi_square_quantile(tail, dof) / dof
    return low, chi_square_quantile(1 - tail, dof) / dof


def _draw_nees(
    panel: Axes, seconds: Floats, per_dof: Floats, index: int, label: str
) -> None:
    """Instants as dots, and a line through the means of `NEES_MEANS` stretches."""
    known = np.flatnonzero(np.isfinite(per_dof))
    highest = 2 * float(per_dof[known].max(initial=0.0))
    panel.set_ylim(NEES_FLOOR, max(panel.get_ylim()[1], 10.0, highest))
    rows = style.evenly(len(per_dof), style.SERIES_POINTS // 4)
    shown = np.maximum(per_dof[rows], NEES_FLOOR)
    style.dots(panel, seconds[rows], shown, style.colour(index))
    stretches = [rows for rows in np.array_split(known, NEES_MEANS) if rows.size]
    middles = [seconds[rows].mean() for rows in stretches]
    means = [per_dof[rows].mean() for rows in stretches]
    panel.plot(middles, means, label=label, **style.run_look(index, 1.6))
