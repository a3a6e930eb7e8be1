"""Figures of paths over time: errors, their bounds, heading and NEES.

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
    anees_interval,
    yaw_rad,
)
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
    labels = ["position error (m)", "yaw error (°)"][: 1 + has_yaw(comparison)]
    size_in = style.size_in(len(labels))
    figure, axes = style.blank_panels(
        len(labels), 2, size_in, sharex="col", sharey="row"
    )
    for row, label in enumerate(labels):
        sizes = {index: _sizes(errors)[row] for index, errors in series.items()}
        for index, error in sizes.items():
            run = comparison.runs[index]
            errors = series[index]
            seconds = style.seconds_since_start(comparison, errors.stamps_ns)
            rows = style.thinned(error, style.SERIES_POINTS // 2)
            look = style.run_look(index, 1.2) | {"label": run.estimator}
            axes[row, 0].plot(seconds[rows], error[rows], **look)
            axes[row, 1].plot(distance_m(run, errors)[rows], error[rows], **look)
        # one scale for all, or a small error would look like a large one
        limit = ROOM * shared_limit(list(sizes.values()))
        axes[row, 0].set(ylim=(0.0, limit), ylabel=label)
    axes[-1, 0].set_xlabel(style.TIME_LABEL)
    axes[-1, 1].set_xlabel(DISTANCE_LABEL)
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
    known = [values for values in sizes if np.isfinite(values).any()]
    largest = [float(np.nanmax(values)) for values in known] or [0.0]
    return max(min(max(largest), LARGER * min(largest)), 1e-9)


def errors_cut_off(comparison: Comparison) -> list[str]:
    """Names of runs with an error that leaves the picture."""
    sizes = {i: _sizes(errors) for i, errors in _causal_errors(comparison).items()}
    # of position and of heading
    limits = [
        ROOM * shared_limit(list(own)) for own in zip(*sizes.values(), strict=True)
    ]
    return [
        comparison.runs[index].estimator
        for index, both in sizes.items()
        if any(np.any(own > most) for own, most in zip(both, limits, strict=True))
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
        sizes = []
        for panel, (index, errors) in zip(axes[row], series.items(), strict=True):
            error = np.degrees(errors.yaw_rad)  # (n,)
            sigma = np.degrees(errors.yaw_sigma_rad)  # (n,)
            if row < axes_count:
                error = errors.position_m[:, row]
                sigma = errors.position_sigma_m[:, row]
            half = BAND_SIGMAS * sigma
            sizes.append(np.fmax(np.abs(error), half))
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
        limit = ROOM * shared_limit(sizes)
        axes[row, 0].set(ylim=(-limit, limit), ylabel=label)
    for panel, last, index in zip(axes[0], axes[-1], series, strict=True):
        style.head_panel(panel, comparison.runs[index].estimator, style.colour(index))
        last.set_xlabel(style.TIME_LABEL)
    return figure


def yaw_figure(comparison: Comparison) -> Figure | None:
    """Heading of truth and causal estimates over time, wrapped to ±180°."""
    drawn = [
        (run.estimator, run.causal, style.run_look(index, 1.2))
        for index, run in enumerate(comparison.runs)
        if run.causal
    ]
    if not drawn:
        return None
    if truth := comparison.sequence.true_poses:
        drawn = [("truth", truth, style.TRUTH_LOOK), *drawn]
    figure, axes = style.blank_panels(1, 1, style.size_in(1))
    panel = axes[0, 0]
    for name, path, look in drawn:
        panel.plot(*_headings(comparison, path), label=name, **look)
    panel.set(ylim=(-185, 185), yticks=[-180, -90, 0, 90, 180])
    panel.set(xlabel=style.TIME_LABEL, ylabel="yaw (°)")
    style.legend_above(figure, panel)
    return figure


def nees_figure(comparison: Comparison) -> Figure | None:
    """Causal NEES of position and yaw over time per degree of freedom, with the two-sided 95 % chi-square band."""
    series = _with_nees(comparison)
    if not series:
        return None
    dofs = _nees_dofs(series)
    size_in = style.size_in(len(dofs), 2.1)
    figure, axes = style.blank_panels(len(dofs), 1, size_in, sharex=True, sharey=True)
    for panel, (label, dof) in zip(axes[:, 0], dofs.items(), strict=True):
        style.logarithmic(panel, "y")
        # chi-square with the degrees of freedom of the error
        low, high = anees_interval(1, dof, BAND_PROBABILITY)
        panel.axhspan(low, high, color=style.TRUTH, alpha=0.25, linewidth=0)
        panel.axhline(1.0, color=style.MUTED, linewidth=0.7)
        for index, errors in series.items():
            name = comparison.runs[index].estimator
            seconds = style.seconds_since_start(comparison, errors.stamps_ns)
            _draw_nees(panel, seconds, _nees(errors, label) / dof, index, name)
        panel.set_ylabel(f"{label} NEES / dof")
    axes[-1, 0].set_xlabel(style.TIME_LABEL)
    style.legend_above(figure, axes[0, 0])
    return figure


def shares_in_band(comparison: Comparison) -> str:
    """A sentence with the share of instants whose NEES is in the band, by run; empty where there is no NEES."""
    series = _with_nees(comparison)
    dofs = _nees_dofs(series) if series else {}
    parts = []
    for index, errors in series.items():
        shares = []
        for label, dof in dofs.items():
            low, high = anees_interval(1, dof, BAND_PROBABILITY)
            nees = _nees(errors, label) / dof
            known = nees[np.isfinite(nees)]
            if known.size:
                share = np.mean((known >= low) & (known <= high))
                shares.append(f"{100.0 * share:.0f} %")
        parts.append(f"{comparison.runs[index].estimator} {', '.join(shares)}")
    return f" In the band ({', '.join(dofs)}): {'; '.join(parts)}." if parts else ""


def _with_nees(comparison: Comparison) -> dict[int, ErrorSeries]:
    """Causal errors with a NEES, by the index of the run."""
    return {
        index: errors
        for index, errors in _causal_errors(comparison).items()
        if np.isfinite([errors.nees_position, errors.nees_yaw]).any()
    }


def _nees_dofs(series: dict[int, ErrorSeries]) -> dict[str, int]:
    """Degrees of freedom of the errors that have a NEES."""
    dofs = {"position": next(iter(series.values())).position_dof, "yaw": 1}
    if not np.isfinite([errors.nees_yaw for errors in series.values()]).any():
        del dofs["yaw"]
    return dofs


def _nees(errors: ErrorSeries, label: str) -> Floats:
    return errors.nees_position if label == "position" else errors.nees_yaw


def _causal_errors(comparison: Comparison) -> dict[int, ErrorSeries]:
    """Causal errors by the index of the run, where there are any."""
    return {
        index: errors
        for index, run in enumerate(comparison.runs)
        if (errors := comparison.errors.get(run.estimator, {}).get("causal"))
        and len(errors.yaw_rad)
    }


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
