"""The figure of detections: their innovations over time."""

import numpy as np
from matplotlib.figure import Figure

from sonar_graph.evaluation import Comparison
from sonar_graph.report import figure_style as style
from sonar_graph.states import Outcome


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
        # people read azimuths in degrees
        shown = (log.innovations[:, 0], np.degrees(log.innovations[:, 1]))
        look = {"color": style.INK, "markersize": 3.5, "label": "refused by the gate"}
        for panel, innovations in zip(panels, shown, strict=True):
            for is_refused in (False, True):
                chosen = np.flatnonzero(is_predicted & (is_gated == is_refused))
                values = innovations[chosen]
                # an even choice shows the noise, the extremes show what was refused
                even = style.evenly(len(values), style.SERIES_POINTS // 2)
                extreme = style.thinned(values, style.SERIES_POINTS // 20)
                rows = chosen[np.union1d(even, extreme)]
                if is_refused:
                    panel.plot(seconds[rows], innovations[rows], "x", **look)
                else:
                    style.dots(panel, seconds[rows], innovations[rows], own, "used")
            panel.axhline(0.0, color=style.MUTED, linewidth=0.7)
    axes[0, 0].set_ylabel("range (m)")
    axes[1, 0].set_ylabel("azimuth (°)")
    style.legend_above(figure, axes[0, 0])
    return figure
