"""Figures over time: errors, their bounds, heading, NEES and innovations.

Each is a pure function to a matplotlib figure, None where there is nothing to draw. Estimators keep their colour in all
figures. Angles are drawn in degrees. Runs share their axes; one whose errors are far larger leaves the picture, because
a common scale would flatten the others.
"""

import math
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sonar_graph.evaluation import (
    Comparison,
    ErrorSeries,
    RunResult,
    anees_interval,
    rows_at,
    yaw_rad,
)
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.report import figure_style as style
from sonar_graph.states import Outcome, Trajectory

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


class Drawn(NamedTuple):
    """The causal errors of a run, as figures draw them."""

    place: int
    run: RunResult
    errors: ErrorSeries
    seconds: Floats
    """Of each error since the start, shape (n,)."""

    def sizes(self) -> list[Floats]:
        """Horizontal position error, metres, and size of the heading's error, degrees; each of shape (n,)."""
        position_m = np.hypot(*self.errors.position_m[:, :2].T)
        return [position_m, np.abs(np.degrees(self.errors.yaw_rad))]

    def per_dof(self) -> dict[str, Floats]:
        """NEES of position and yaw, divided by their degrees of freedom, each of shape (n,)."""
        position = self.errors.nees_position / self.errors.position_dof
        return {"position": position, "yaw": self.errors.nees_yaw}


def error_figure(comparison: Comparison) -> Figure | None:
    """Size of the causal errors of position and heading of all runs, over time and over the distance travelled."""
    series = _causal_errors(comparison)
    if not series:
        return None
    labels = ["position error (m)", "yaw error (°)"][: 1 + has_yaw(comparison)]
    figure, axes = style.blank_panels(
        len(labels), 2, style.size_in(len(labels)), sharex="col", sharey="row"
    )
    for row, label in enumerate(labels):
        sizes = [one.sizes()[row] for one in series]
        for one, error in zip(series, sizes, strict=True):
            rows = style.thinned(error, style.SERIES_POINTS // 2)
            look = style.run_look(one.place, 1.2) | {"label": one.run.estimator}
            axes[row, 0].plot(one.seconds[rows], error[rows], **look)
            axes[row, 1].plot(distance_m(one)[rows], error[rows], **look)
        # one scale for all, or a small error would look like a large one
        axes[row, 0].set(ylim=(0.0, ROOM * shared_limit(sizes)), ylabel=label)
    axes[-1, 0].set_xlabel(style.TIME_LABEL)
    axes[-1, 1].set_xlabel(DISTANCE_LABEL)
    style.legend_above(figure, axes[0, 0])
    return figure


def distance_m(one: Drawn) -> Floats:
    """Distance that the truth has travelled until each scored instant, from the first one, shape (n,)."""
    assert one.run.causal is not None, "a run with errors has a path"
    # scored instants are some of the path's own
    estimate = rows_at(one.run.causal, one.errors.stamps_ns)
    # estimate minus error is the true path; an estimate's own would be another distance for each run
    steps = np.diff(estimate.positions - one.errors.position_m, axis=0)
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])


def shared_limit(sizes: list[Floats]) -> float:
    """Upper end of a common axis: the largest error of all runs, at most `LARGER` times that of the best run."""
    # a run without an error of this kind has NaN throughout
    known = [values for values in sizes if np.isfinite(values).any()]
    largest = [float(np.nanmax(values)) for values in known] or [0.0]
    return max(min(max(largest), LARGER * min(largest)), 1e-9)


def errors_cut_off(comparison: Comparison) -> list[str]:
    """Names of runs with an error that leaves the picture."""
    sizes = {one.run.estimator: one.sizes() for one in _causal_errors(comparison)}
    # of position and of heading
    limits = [
        ROOM * shared_limit(list(own)) for own in zip(*sizes.values(), strict=True)
    ]
    return [
        name
        for name, both in sizes.items()
        if any(np.any(own > most) for own, most in zip(both, limits, strict=True))
    ]


def bounds_figure(comparison: Comparison) -> Figure | None:
    """Causal error in x, y, (z) and yaw over time with the reported 95 % band: a row for each quantity, a column a run."""
    series = _causal_errors(comparison)
    if not series:
        return None
    axes_count = max(one.errors.position_dof for one in series)
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
        for panel, one in zip(axes[row], series, strict=True):
            error = np.degrees(one.errors.yaw_rad)  # (n,)
            sigma = np.degrees(one.errors.yaw_sigma_rad)  # (n,)
            if row < axes_count:
                error = one.errors.position_m[:, row]
                sigma = one.errors.position_sigma_m[:, row]
            half = BAND_SIGMAS * sigma
            sizes.append(np.fmax(np.abs(error), half))
            own = style.colour(one.place)
            # an estimator may report no covariance
            if np.isfinite(half).any():
                band = style.evenly_with_extremes(half, points // 4)
                look = {"color": own, "alpha": 0.2, "lw": 0}
                panel.fill_between(one.seconds[band], -half[band], half[band], **look)
            rows = style.thinned(error, points)
            panel.axhline(0.0, color=style.MUTED, linewidth=0.7)
            panel.plot(one.seconds[rows], error[rows], color=own, linewidth=1.1)
        limit = ROOM * shared_limit(sizes)
        axes[row, 0].set(ylim=(-limit, limit), ylabel=label)
    for column, one in zip(axes.T, series, strict=True):
        style.head_panel(column[0], one.run.estimator, style.colour(one.place))
        column[-1].set_xlabel(style.TIME_LABEL)
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
    bands = _bands(comparison)
    if not bands:
        return None
    figure, axes = style.blank_panels(
        len(bands), 1, style.size_in(len(bands), 2.1), sharex=True, sharey=True
    )
    for panel, (label, band) in zip(axes[:, 0], bands.items(), strict=True):
        style.logarithmic(panel, "y")
        panel.axhspan(*band, color=style.TRUTH, alpha=0.25, linewidth=0)
        panel.axhline(1.0, color=style.MUTED, linewidth=0.7)
        for one in _with_nees(comparison):
            _draw_nees(panel, one, one.per_dof()[label])
        panel.set_ylabel(f"{label} NEES / dof")
    axes[-1, 0].set_xlabel(style.TIME_LABEL)
    style.legend_above(figure, axes[0, 0])
    return figure


def shares_in_band(comparison: Comparison) -> str:
    """A sentence with the share of instants whose NEES is in the band, by run; empty where there is no NEES."""
    bands = _bands(comparison)
    parts = []
    for one in _with_nees(comparison):
        shares = []
        for label, (low, high) in bands.items():
            nees = one.per_dof()[label]
            known = nees[np.isfinite(nees)]
            if known.size:
                share = np.mean((known >= low) & (known <= high))
                shares.append(f"{100.0 * share:.0f} %")
        parts.append(f"{one.run.estimator} {', '.join(shares)}")
    return f" In the band ({', '.join(bands)}): {'; '.join(parts)}." if parts else ""


def _with_nees(comparison: Comparison) -> list[Drawn]:
    """Causal errors with a NEES."""
    return [
        one
        for one in _causal_errors(comparison)
        if np.isfinite([*one.per_dof().values()]).any()
    ]


def _bands(comparison: Comparison) -> dict[str, tuple[float, float]]:
    """The chi-square bands of the kinds of NEES that the errors have."""
    series = _with_nees(comparison)
    if not series:
        return {}
    dofs = {"position": series[0].errors.position_dof}
    if np.isfinite([one.errors.nees_yaw for one in series]).any():
        dofs["yaw"] = 1
    return {
        label: anees_interval(1, dof, BAND_PROBABILITY) for label, dof in dofs.items()
    }


def _causal_errors(comparison: Comparison) -> list[Drawn]:
    """Causal errors of the runs that have any."""
    found = []
    for index, run in enumerate(comparison.runs):
        errors = comparison.errors_of(run)
        if errors and len(errors.yaw_rad):
            seconds = style.seconds_since_start(comparison, errors.stamps_ns)
            found.append(Drawn(index, run, errors, seconds))
    return found


def has_yaw(comparison: Comparison) -> bool:
    """True where a run has errors of heading."""
    series = _causal_errors(comparison)
    return any(np.isfinite(one.errors.yaw_rad).any() for one in series)


def _headings(comparison: Comparison, path: Trajectory) -> tuple[Floats, Floats]:
    """Seconds and degrees, with a gap wherever the heading passes ±180°."""
    degrees = np.degrees(yaw_rad(path.matrices))
    rows = style.evenly_with_extremes(degrees, style.SERIES_POINTS)
    seconds = style.seconds_since_start(comparison, path.stamps_ns[rows])
    degrees = degrees[rows]
    # a NaN interrupts the line, which else crosses the panel at every turn past 180°
    jumps = np.flatnonzero(np.abs(np.diff(degrees)) > 180) + 1
    return np.insert(seconds, jumps, np.nan), np.insert(degrees, jumps, np.nan)


def _draw_nees(panel: Axes, one: Drawn, per_dof: Floats) -> None:
    """Instants as dots, and a line through the means of `NEES_MEANS` stretches."""
    known = np.flatnonzero(np.isfinite(per_dof))
    highest = 2 * float(per_dof[known].max(initial=0.0))
    panel.set_ylim(NEES_FLOOR, max(panel.get_ylim()[1], 10.0, highest))
    rows = style.evenly(len(per_dof), style.SERIES_POINTS // 4)
    shown = np.maximum(per_dof[rows], NEES_FLOOR)
    style.dots(panel, one.seconds[rows], shown, style.colour(one.place))
    stretches = [rows for rows in np.array_split(known, NEES_MEANS) if rows.size]
    middles = [one.seconds[rows].mean() for rows in stretches]
    means = [per_dof[rows].mean() for rows in stretches]
    look = style.run_look(one.place, 1.6)
    panel.plot(middles, means, label=one.run.estimator, **look)


def innovation_figure(comparison: Comparison) -> Figure | None:
    """Range and azimuth innovations over time: used detections as dots, those refused by the gate as crosses."""
    logs = {
        index: run.detections
        for index, run in enumerate(comparison.runs)
        if run.detections and np.isfinite(run.detections.innovations).all(axis=1).any()
    }
    if not logs:
        return None
    figure, axes = style.blank_panels(
        2, len(logs), style.size_in(2), sharex=True, sharey="row"
    )
    for panels, (index, log) in zip(axes.T, logs.items(), strict=True):
        own = style.colour(index)
        style.head_panel(panels[0], comparison.runs[index].estimator, own)
        panels[-1].set_xlabel(style.TIME_LABEL)
        # refused detections are drawn apart from used ones
        is_gated = np.array([one is Outcome.GATED for one in log.outcomes], dtype=bool)
        seconds = style.seconds_since_start(comparison, log.stamps_ns)
        # people read azimuths in degrees
        shown = (log.innovations[:, 0], np.degrees(log.innovations[:, 1]))
        is_predicted = np.isfinite(log.innovations).all(axis=1)  # (n,)
        look = {"color": style.INK, "markersize": 3.5, "label": "refused by the gate"}
        for panel, innovations in zip(panels, shown, strict=True):
            used = _seen(is_predicted & ~is_gated, innovations)
            style.dots(panel, seconds[used], innovations[used], own, "used")
            refused = _seen(is_predicted & is_gated, innovations)
            panel.plot(seconds[refused], innovations[refused], "x", **look)
            panel.axhline(0.0, color=style.MUTED, linewidth=0.7)
    axes[0, 0].set_ylabel("range (m)")
    axes[1, 0].set_ylabel("azimuth (°)")
    style.legend_above(figure, axes[0, 0])
    return figure


def _seen(chosen: NDArray[np.bool_], values: Floats) -> Ints:
    """Rows of the chosen values that are drawn: an even choice shows the noise, the extremes what was refused."""
    rows = np.flatnonzero(chosen)
    even = style.evenly(len(rows), style.SERIES_POINTS // 2)
    extreme = style.thinned(values[rows], style.SERIES_POINTS // 20)
    return rows[np.union1d(even, extreme)]
