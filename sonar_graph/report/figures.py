"""Figures of a comparison: each a pure function to a matplotlib figure, None where there is nothing to draw.

Estimators keep their colour in all figures. Angles are drawn in degrees. Panels side by side have scales of their own,
because the drift of a dead reckoning would flatten the errors of the others. Maps: `sonar_graph.report.maps`.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import chi2

from sonar_graph.evaluation import Comparison, Reliability, RunResult, nis, own_map_errors, yaw_rad
from sonar_graph.measurements import Floats
from sonar_graph.report import figure_style as style
from sonar_graph.states import DetectionLog, Outcome, Trajectory

TIME_LABEL = "time since start (s)"
BAND_PROBABILITY = 0.95
NIS_DOF = 2
NEES_FLOOR = 1e-3
"""Smaller values are drawn at the edge: below the band it does not matter how far."""
NEES_MEANS = 40
"""Stretches of the run over which NEES is averaged for the line among the dots."""
COLUMN_IN = 3.1
"""Width of a panel where runs stand side by side."""
SINGLE_IN = (7.4, 3.1)
"""Size of a figure with one panel."""
LARGEST_DOT, SMALLEST_DOT = 90.0, 9.0
"""Areas in points²."""
SMALL = 7.5


def error_figure(comparison: Comparison) -> Figure | None:
    """Causal error in x, y, (z) and yaw over time with the reported ±3σ: a row for each quantity, a column a run."""
    runs = _runs_with_errors(comparison)
    if not runs:
        return None
    series = [comparison.errors[run.estimator]["causal"] for _, run in runs]
    axes_count = max(errors.position_dof for errors in series)
    labels = [f"error in {'xyz'[axis]} (m)" for axis in range(axes_count)]
    if any(np.isfinite(errors.yaw_rad).any() for errors in series):
        labels.append("yaw error (°)")
    figure, axes = style.blank_panels(len(labels), len(runs), _size(len(labels), len(runs)), sharex=True)
    for column, ((index, run), errors) in enumerate(zip(runs, series, strict=True)):
        style.head_panel(axes[0, column], run.estimator, style.colour(index))
        seconds = style.seconds_since_start(comparison, errors.stamps_ns)
        for row, label in enumerate(labels):
            panel: Axes = axes[row, column]
            if row < axes_count:
                error, sigma = errors.position_m[:, row], errors.position_sigma_m[:, row]
            else:
                error, sigma = np.degrees(errors.yaw_rad), np.degrees(errors.yaw_sigma_rad)
            if np.isfinite(sigma).any():
                band = np.union1d(
                    style.evenly(len(sigma), style.SERIES_POINTS // 2), style.thinned(sigma, style.SERIES_POINTS // 2)
                )
                low, high = -3 * sigma[band], 3 * sigma[band]
                panel.fill_between(seconds[band], low, high, color=style.colour(index), alpha=0.2, linewidth=0)
            rows = style.thinned(error)
            panel.axhline(0.0, color=style.MUTED, linewidth=0.7)
            panel.plot(seconds[rows], error[rows], color=style.colour(index), linewidth=1.1)
            style.name_axes(panel, TIME_LABEL if row == len(labels) - 1 else "", "" if column else label)
    return figure


def own_map_figure(comparison: Comparison) -> Figure | None:
    """Causal position error of each run on the map that it had at that instant."""
    found = {}
    for index, run in enumerate(comparison.runs):
        scored = comparison.errors.get(run.estimator, {}).get("causal")
        if scored is not None and len((series := own_map_errors(run, comparison.sequence, scored.stamps_ns))[0]):
            found[index] = series
    if not found:
        return None
    figure, axes = style.blank_panels(1, 1, SINGLE_IN)
    panel: Axes = axes[0, 0]
    for index, (stamps_ns, errors_m) in found.items():
        seconds = style.seconds_since_start(comparison, stamps_ns)
        look = {"color": style.colour(index), "linestyle": style.line_style(index), "linewidth": 1.3}
        panel.plot(seconds, errors_m, marker="o", markersize=3.5, label=comparison.runs[index].estimator, **look)
    panel.set_ylim(bottom=0.0)
    style.name_axes(panel, TIME_LABEL, "error on its own map (m)")
    style.legend_above(figure, panel)
    return figure


def yaw_figure(comparison: Comparison) -> Figure | None:
    """Heading of truth and causal estimates over time, wrapped to ±180°."""
    runs = [(i, run.causal) for i, run in enumerate(comparison.runs) if run.causal is not None and len(run.causal)]
    if not runs:
        return None
    figure, axes = style.blank_panels(1, 1, SINGLE_IN)
    panel: Axes = axes[0, 0]
    truth = comparison.sequence.true_poses
    if truth is not None and len(truth):
        seconds, degrees = _headings(comparison, truth)
        panel.plot(seconds, degrees, color=style.TRUTH, linewidth=3.2, alpha=0.6, label="truth")
    for index, path in runs:
        seconds, degrees = _headings(comparison, path)
        label = comparison.runs[index].estimator
        panel.plot(
            seconds, degrees, color=style.colour(index), linestyle=style.line_style(index), linewidth=1.2, label=label
        )
    panel.set(ylim=(-185, 185), yticks=[-180, -90, 0, 90, 180])
    style.name_axes(panel, TIME_LABEL, "yaw (°)")
    style.legend_above(figure, panel)
    return figure


def nees_figure(comparison: Comparison) -> Figure | None:
    """Causal NEES of position and yaw over time per degree of freedom, with the two-sided 95 % chi-square band."""
    runs = []
    for index, run in _runs_with_errors(comparison):
        errors = comparison.errors[run.estimator]["causal"]
        if np.isfinite(errors.nees_position).any() or np.isfinite(errors.nees_yaw).any():
            runs.append((index, run))
    if not runs:
        return None
    has_yaw = any(np.isfinite(comparison.errors[run.estimator]["causal"].nees_yaw).any() for _, run in runs)
    count = 2 if has_yaw else 1
    figure, axes = style.blank_panels(count, len(runs), _size(count, len(runs)), sharex=True, sharey=True)
    for column, (index, run) in enumerate(runs):
        errors = comparison.errors[run.estimator]["causal"]
        style.head_panel(axes[0, column], run.estimator, style.colour(index))
        seconds = style.seconds_since_start(comparison, errors.stamps_ns)
        blocks = (("position", errors.nees_position, errors.position_dof), ("yaw", errors.nees_yaw, 1))
        for row, (label, nees, dof) in enumerate(blocks[:count]):
            style.logarithmic(axes[row, column], "y")
            _draw_nees(axes[row, column], seconds, nees, dof, style.colour(index))
            style.name_axes(
                axes[row, column], TIME_LABEL if row == count - 1 else "", "" if column else f"{label} NEES / dof"
            )
    return figure


def innovation_figure(comparison: Comparison) -> Figure | None:
    """Range and azimuth innovations over time: used detections as dots, those refused by the gate as crosses."""

    def is_predicted(log: DetectionLog) -> NDArray[np.bool_]:
        return np.asarray(np.isfinite(log.innovations).all(axis=1), dtype=np.bool_)

    logs = [(i, run.estimator, run.detections) for i, run in enumerate(comparison.runs) if run.detections]
    runs = [(index, name, log) for index, name, log in logs if is_predicted(log).any()]
    if not runs:
        return None
    figure, axes = style.blank_panels(2, len(runs), _size(2, len(runs)), sharex=True)
    for column, (index, name, log) in enumerate(runs):
        style.head_panel(axes[0, column], name, style.colour(index))
        gated = np.array([outcome is Outcome.GATED for outcome in log.outcomes], dtype=bool)
        predicted = is_predicted(log)
        seconds = style.seconds_since_start(comparison, log.stamps_ns)
        for row, (label, factor) in enumerate((("range (m)", 1.0), ("azimuth (°)", np.degrees(1.0)))):
            panel: Axes = axes[row, column]
            for chosen, marker, shade, outcome in (
                (predicted & ~gated, ".", style.colour(index), "used"),
                (predicted & gated, "x", style.INK, "refused by the gate"),
            ):
                values = factor * log.innovations[chosen, row]
                rows = np.union1d(
                    style.evenly(len(values), style.SERIES_POINTS // 2),
                    style.thinned(values, style.SERIES_POINTS // 20),
                )
                x, y = seconds[chosen][rows], values[rows]
                panel.plot(x, y, marker, color=shade, markersize=3.5, linestyle="none", label=outcome)
            panel.axhline(0.0, color=style.MUTED, linewidth=0.7)
            style.name_axes(panel, TIME_LABEL if row else "", "" if column else label)
    style.legend_above(figure, axes[0, 0])
    return figure


def nis_figure(comparison: Comparison) -> Figure | None:
    """Share of used detections whose NIS lies below a value, against that of a chi-square with two degrees."""
    known = [(i, run, nis(run.detections)) for i, run in enumerate(comparison.runs) if run.detections]
    runs = [(index, run, values) for index, run, values in known if values.size]
    if not runs:
        return None
    figure, axes = style.blank_panels(1, 1, SINGLE_IN)
    panel: Axes = axes[0, 0]
    grid = np.geomspace(1e-2, max(30.0, *(float(values.max()) for _, _, values in runs)), 200)
    panel.plot(
        grid, 100 * chi2.cdf(grid, NIS_DOF), color=style.TRUTH, linewidth=3.2, alpha=0.6, label="χ², 2 dof: expected"
    )
    for index, run, values in runs:
        _draw_distribution(panel, values, index, run.estimator)
    style.logarithmic(panel, "x")
    panel.set_xlim(grid[0], grid[-1])
    style.name_axes(panel, "NIS", "detections below (%)")
    style.legend_above(figure, panel)
    return figure


def timing_figure(comparison: Comparison) -> Figure | None:
    """Share of updates that took at most a duration; the median and the 99th percentile are marked."""
    runs = [(index, run) for index, run in enumerate(comparison.runs) if len(run.update_s)]
    if not runs:
        return None
    figure, axes = style.blank_panels(1, 1, SINGLE_IN)
    panel: Axes = axes[0, 0]
    for index, run in runs:
        update_ms = 1e3 * run.update_s
        _draw_distribution(panel, update_ms, index, run.estimator)
        panel.plot(np.percentile(update_ms, [50, 99]), [50, 99], "o", color=style.colour(index), markersize=5)
    style.logarithmic(panel, "x")
    style.name_axes(panel, "duration of an update (ms)", "updates at most as long (%)")
    style.legend_above(figure, panel)
    return figure


def reliability_figure(judged: Reliability) -> Figure:
    """Share of right identities over confidence, and below the number of detections in each bin.

    A dot's area is in proportion to the detections behind it, down to a least size.
    """
    figure, axes = style.blank_panels(2, 1, (5.2, 4.6), sharex=True, height_ratios=[3, 1])
    shares, counts = axes[:, 0]
    shares.plot([0, 1], [0, 1], color=style.TRUTH, linewidth=1, zorder=1)
    areas = np.maximum(LARGEST_DOT * judged.count / max(int(judged.count.max()), 1), SMALLEST_DOT)
    shares.scatter(judged.confidence, judged.right, s=areas, color=style.INK, zorder=2, clip_on=False)
    shares.set(xlim=(0, 1), ylim=(0, 1.03))
    style.name_axes(shares, y="share that is right")
    width = 1 / len(judged.count)
    middles = (np.arange(len(judged.count)) + 0.5) * width
    bars = counts.bar(middles, judged.count, width=0.8 * width, color=style.INK)
    counts.bar_label(bars, [str(n) if n else "" for n in judged.count], color=style.MUTED, fontsize=SMALL, padding=1.5)
    counts.set_ylim(0, 1.25 * max(int(judged.count.max()), 1))
    style.name_axes(counts, "posterior of the most probable class", "detections")
    return figure


def _runs_with_errors(comparison: Comparison) -> list[tuple[int, RunResult]]:
    return [
        (index, run)
        for index, run in enumerate(comparison.runs)
        if "causal" in (series := comparison.errors.get(run.estimator, {})) and len(series["causal"].stamps_ns)
    ]


def _size(rows: int, columns: int) -> tuple[float, float]:
    return max(7.4, COLUMN_IN * columns), 1.75 * rows + 0.6


def _headings(comparison: Comparison, path: Trajectory) -> tuple[Floats, Floats]:
    """Seconds and degrees, with a gap wherever the heading passes ±180°."""
    degrees = np.degrees(yaw_rad(path.matrices))
    rows = np.union1d(style.evenly(len(degrees), 2 * style.SERIES_POINTS), style.thinned(degrees))
    seconds, degrees = style.seconds_since_start(comparison, path.stamps_ns)[rows], degrees[rows]
    jumps = np.flatnonzero(np.abs(np.diff(degrees)) > 180) + 1
    return np.insert(seconds, jumps, np.nan), np.insert(degrees, jumps, np.nan)


def _draw_nees(panel: Axes, seconds: Floats, nees: Floats, dof: int, own_colour: str) -> None:
    low, high = (float(chi2.ppf((1 + side * BAND_PROBABILITY) / 2, dof)) / dof for side in (-1, 1))
    per_dof = nees / dof
    known = per_dof[np.isfinite(per_dof)]
    top = max(panel.get_ylim()[1], 10.0, 2 * float(known.max(initial=0.0)))
    panel.set_ylim(NEES_FLOOR, top)
    panel.axhspan(low, high, color=style.TRUTH, alpha=0.25, linewidth=0)
    panel.axhline(1.0, color=style.MUTED, linewidth=0.7)
    rows = style.evenly(len(per_dof), style.SERIES_POINTS // 2)
    panel.plot(seconds[rows], np.maximum(per_dof[rows], NEES_FLOOR), ".", color=own_colour, markersize=2, alpha=0.5)
    stretches = [rows for rows in np.array_split(np.flatnonzero(np.isfinite(per_dof)), NEES_MEANS) if rows.size]
    middles, means = ([values[rows].mean() for rows in stretches] for values in (seconds, per_dof))
    panel.plot(middles, means, color=own_colour, linewidth=1.6)
    if known.size:
        inside = 100 * float(np.mean((known >= low) & (known <= high)))
        panel.text(
            0.02,
            0.04,
            f"{inside:.0f} % in the band",
            transform=panel.transAxes,
            color=style.INK,
            fontsize=style.TICK_SIZE,
        )


def _draw_distribution(panel: Axes, values: Floats, index: int, label: str) -> None:
    ordered = np.sort(values)
    rows = style.evenly(len(ordered), style.SERIES_POINTS // 2)
    share = 100 * (rows + 1) / len(ordered)
    look = {"color": style.colour(index), "linestyle": style.line_style(index), "linewidth": 1.5}
    panel.plot(ordered[rows], share, label=label, **look)
