"""Figures of detections and of updates: innovations, NIS, reliability of posteriors, durations.

Each is a pure function to a matplotlib figure, None where there is nothing to draw.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sonar_graph.evaluation import Comparison, Reliability, nis
from sonar_graph.measurements import Floats
from sonar_graph.numerics import chi_square_share
from sonar_graph.report import figure_style as style
from sonar_graph.states import Outcome

NIS_DOF = 2
# areas in points²
LARGEST_DOT, SMALLEST_DOT = 90.0, 9.0


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
        is_predicted = np.isfinite(log.innovations).all(axis=1)  # (n,)
        # refused detections are drawn apart from used ones
        is_gated = np.array([one is Outcome.GATED for one in log.outcomes], dtype=bool)
        seconds = style.seconds_since_start(comparison, log.stamps_ns)
        for panel, innovations in zip(panels, log.innovations.T, strict=True):
            for is_refused in (False, True):
                chosen = is_predicted & (is_gated == is_refused)
                values = innovations[chosen]
                # the second row is the azimuth, which people read in degrees
                if panel is panels[-1]:
                    values = np.degrees(values)
                # an even choice shows the noise, the extremes show what was refused
                rows = np.union1d(
                    style.evenly(len(values), style.SERIES_POINTS // 2),
                    style.thinned(values, style.SERIES_POINTS // 20),
                )
                x = seconds[chosen][rows]
                if is_refused:
                    look = {"color": style.INK, "markersize": 3.5}
                    label = "refused by the gate"
                    panel.plot(x, values[rows], "x", label=label, **look)
                else:
                    style.dots(panel, x, values[rows], own, label="used")
            panel.axhline(0.0, color=style.MUTED, linewidth=0.7)
    axes[0, 0].set_ylabel("range (m)")
    axes[1, 0].set_ylabel("azimuth (°)")
    style.legend_above(figure, axes[0, 0])
    return figure


def nis_figure(comparison: Comparison) -> Figure | None:
    """Share of used detections whose NIS lies below a value, against that of a chi-square with two degrees."""
    known = {
        index: nis(run.detections)
        for index, run in enumerate(comparison.runs)
        if run.detections
    }
    known = {index: values for index, values in known.items() if values.size}
    if not known:
        return None
    figure, panel = style.one_panel()
    highest = max(30.0, *(float(values.max()) for values in known.values()))
    # the scale is logarithmic
    grid = np.geomspace(1e-2, highest, 200)
    expected = 100 * chi_square_share(grid, NIS_DOF)
    panel.plot(grid, expected, label="expected: χ²", **style.TRUTH_LOOK)
    for index, values in known.items():
        _draw_distribution(panel, values, index, comparison.runs[index].estimator)
    style.logarithmic(panel, "x")
    panel.set(xlim=(grid[0], grid[-1]), xlabel="NIS", ylabel="detections (%)")
    style.legend_above(figure, panel)
    return figure


def timing_figure(comparison: Comparison) -> Figure | None:
    """Share of updates that took at most a duration; the median and the 99th percentile are marked."""
    if not any(len(run.update_s) for run in comparison.runs):
        return None
    figure, panel = style.one_panel()
    for index, run in enumerate(comparison.runs):
        if len(run.update_s):
            update_ms = 1e3 * run.update_s
            _draw_distribution(panel, update_ms, index, run.estimator)
            marks = [50, 99]
            at_ms = np.percentile(update_ms, marks)
            panel.plot(at_ms, marks, "o", color=style.colour(index), markersize=5)
    style.logarithmic(panel, "x")
    panel.set(xlabel="duration of an update (ms)", ylabel="updates (%)")
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
    largest = max(int(judged.count.max()), 1)
    shares.plot([0, 1], [0, 1], color=style.TRUTH, linewidth=1, zorder=1)
    areas = np.maximum(LARGEST_DOT * judged.count / largest, SMALLEST_DOT)
    look = {"color": style.INK, "zorder": 2, "clip_on": False}
    shares.scatter(judged.confidence, judged.right, s=areas, **look)
    shares.set(xlim=(0, 1), ylim=(0, 1.03), ylabel="share that is right")
    width = 1 / len(judged.count)
    middles = (np.arange(len(judged.count)) + 0.5) * width
    bars = counts.bar(middles, judged.count, width=0.8 * width, color=style.INK)
    texts = [str(n) if n else "" for n in judged.count]
    counts.bar_label(bars, texts, color=style.MUTED, padding=1.5)
    counts.set(ylim=(0, 1.25 * largest), ylabel="detections")
    counts.set_xlabel("posterior of the most probable class")
    return figure


def _draw_distribution(panel: Axes, values: Floats, index: int, label: str) -> None:
    rows = style.evenly(len(values), style.SERIES_POINTS // 2)
    share = 100 * (rows + 1) / len(values)
    panel.plot(np.sort(values)[rows], share, label=label, **style.run_look(index, 1.5))
