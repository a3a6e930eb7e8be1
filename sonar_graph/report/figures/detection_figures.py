"""Figures of detections and of updates: innovations, NIS, reliability of posteriors, durations.

Each is a pure function to a matplotlib figure, None where there is nothing to draw.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sonar_graph.evaluation import Comparison, Reliability, nis
from sonar_graph.measurements import Floats
from sonar_graph.numerics import chi_square_share
from sonar_graph.report import figure_style as style
from sonar_graph.states import DetectionLog, Outcome

NIS_DOF = 2
LARGEST_DOT, SMALLEST_DOT = 90.0, 9.0
"""Areas in points²."""


def innovation_figure(comparison: Comparison) -> Figure | None:
    """Range and azimuth innovations over time: used detections as dots, those refused by the gate as crosses."""

    def is_predicted(log: DetectionLog) -> NDArray[np.bool_]:
        return np.asarray(np.isfinite(log.innovations).all(axis=1), dtype=np.bool_)

    logs = [
        (i, run.estimator, run.detections)
        for i, run in enumerate(comparison.runs)
        if run.detections
    ]
    runs = [(index, name, log) for index, name, log in logs if is_predicted(log).any()]
    if not runs:
        return None
    figure, axes = style.blank_panels(
        2, len(runs), style.size_in(2), sharex=True, sharey="row"
    )
    for column, (index, name, log) in enumerate(runs):
        style.head_panel(axes[0, column], name, style.colour(index))
        gated = np.array(
            [outcome is Outcome.GATED for outcome in log.outcomes], dtype=bool
        )
        predicted = is_predicted(log)
        seconds = style.seconds_since_start(comparison, log.stamps_ns)
        for row, (label, factor) in enumerate(
            (("range (m)", 1.0), ("azimuth (°)", np.degrees(1.0)))
        ):
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
                x = seconds[chosen][rows]
                y = values[rows]
                if marker == ".":
                    style.dots(panel, x, y, shade, label=outcome)
                else:
                    panel.plot(
                        x,
                        y,
                        marker,
                        color=shade,
                        markersize=3.5,
                        linestyle="none",
                        label=outcome,
                    )
            panel.axhline(0.0, color=style.MUTED, linewidth=0.7)
            style.name_axes(
                panel, style.TIME_LABEL if row else "", "" if column else label
            )
    style.legend_above(figure, axes[0, 0])
    return figure


def nis_figure(comparison: Comparison) -> Figure | None:
    """Share of used detections whose NIS lies below a value, against that of a chi-square with two degrees."""
    known = [
        (i, run, nis(run.detections))
        for i, run in enumerate(comparison.runs)
        if run.detections
    ]
    runs = [(index, run, values) for index, run, values in known if values.size]
    if not runs:
        return None
    figure, axes = style.blank_panels(1, 1, style.size_in(1))
    panel: Axes = axes[0, 0]
    grid = np.geomspace(
        1e-2, max(30.0, *(float(values.max()) for _, _, values in runs)), 200
    )
    panel.plot(
        grid,
        100 * chi_square_share(grid, NIS_DOF),
        color=style.TRUTH,
        linewidth=3.2,
        alpha=0.6,
        label="expected: χ²",
    )
    for index, run, values in runs:
        _draw_distribution(panel, values, index, run.estimator)
    style.logarithmic(panel, "x")
    panel.set_xlim(grid[0], grid[-1])
    style.name_axes(panel, "NIS", "detections (%)")
    style.legend_above(figure, panel)
    return figure


def timing_figure(comparison: Comparison) -> Figure | None:
    """Share of updates that took at most a duration; the median and the 99th percentile are marked."""
    runs = [
        (index, run) for index, run in enumerate(comparison.runs) if len(run.update_s)
    ]
    if not runs:
        return None
    figure, axes = style.blank_panels(1, 1, style.size_in(1))
    panel: Axes = axes[0, 0]
    for index, run in runs:
        update_ms = 1e3 * run.update_s
        _draw_distribution(panel, update_ms, index, run.estimator)
        panel.plot(
            np.percentile(update_ms, [50, 99]),
            [50, 99],
            "o",
            color=style.colour(index),
            markersize=5,
        )
    style.logarithmic(panel, "x")
    style.name_axes(panel, "duration of an update (ms)", "updates (%)")
    style.legend_above(figure, panel)
    return figure


def reliability_figure(judged: Reliability) -> Figure:
    """Share of right identities over confidence, and below the number of detections in each bin.

    A dot's area is in proportion to the detections behind it, down to a least size.
    """
    figure, axes = style.blank_panels(
        2, 1, (5.2, 4.6), sharex=True, height_ratios=[3, 1]
    )
    shares, counts = axes[:, 0]
    shares.plot([0, 1], [0, 1], color=style.TRUTH, linewidth=1, zorder=1)
    areas = np.maximum(
        LARGEST_DOT * judged.count / max(int(judged.count.max()), 1), SMALLEST_DOT
    )
    shares.scatter(
        judged.confidence,
        judged.right,
        s=areas,
        color=style.INK,
        zorder=2,
        clip_on=False,
    )
    shares.set(xlim=(0, 1), ylim=(0, 1.03))
    style.name_axes(shares, y="share that is right")
    width = 1 / len(judged.count)
    middles = (np.arange(len(judged.count)) + 0.5) * width
    bars = counts.bar(middles, judged.count, width=0.8 * width, color=style.INK)
    counts.bar_label(
        bars,
        [str(n) if n else "" for n in judged.count],
        color=style.MUTED,
        padding=1.5,
    )
    counts.set_ylim(0, 1.25 * max(int(judged.count.max()), 1))
    style.name_axes(counts, "posterior of the most probable class", "detections")
    return figure


def _draw_distribution(panel: Axes, values: Floats, index: int, label: str) -> None:
    ordered = np.sort(values)
    rows = style.evenly(len(ordered), style.SERIES_POINTS // 2)
    share = 100 * (rows + 1) / len(ordered)
    look = {
        "color": style.colour(index),
        "linestyle": style.line_style(index),
        "linewidth": 1.5,
    }
    panel.plot(ordered[rows], share, label=label, **look)
