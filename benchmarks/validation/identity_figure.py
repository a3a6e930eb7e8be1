"""The picture of identities.py: errors against the share of wrong identities, by estimator."""

from pathlib import Path

import numpy as np
from identity_runs import Case
from matplotlib.axes import Axes

from sonar_graph.report.figure_style import (
    MUTED,
    arrange,
    blank_panels,
    colour,
    head_panel,
    legend_above,
    logarithmic,
)

Figures = dict[Case, dict[str, dict[str, float]]]
"""By case, estimator and figure."""
SHOWN = {
    "tracks corrected halfway": Case(0.0, 5.0),
    "tracks never corrected": Case(0.0, 5.0, wrong_id_share=1.0),
    "frame by frame": Case(0.0, tracks=False),
}
"""Kinds of cases, a column each; of these alone all differ."""
ROWS = {
    "smoothed": "trajectory, m",
    "causal": "causal trajectory, m",
    "landmarks": "map, m",
}
"""Errors, a row each, and their axis."""
DRAWN = {
    "EKF-SLAM": (0, "-"),
    "invariant EKF": (4, "-"),
    "iSAM2, gate": (1, (0, (5, 1.6))),
    "iSAM2, robust": (5, (0, (1.2, 1.2))),
    "iSAM2, deferred": (2, "-"),
    "iSAM2, max-mixture": (3, "-"),
}
"""Estimators beside dead reckoning: colour and line. Graduated non-convexity lies on the max-mixture here."""
ASIDE_PERCENT = 0.3
"""By which points of estimators stand apart, so that each interval is seen."""


def draw(figures: Figures, path: Path) -> None:
    """Draw what is there of `SHOWN` into a file."""
    shown = {
        title: kind
        for title, kind in SHOWN.items()
        if any(_is_of(case, kind) for case in figures)
    }
    figure, panels = blank_panels(
        len(ROWS), max(len(shown), 1), (10.0, 8.4), sharex=True, sharey="row"
    )
    for column, (title, kind) in enumerate(shown.items()):
        cases = {
            case.wrong_id_rate: told
            for case, told in figures.items()
            if _is_of(case, kind)
        }
        for row, (error, label) in enumerate(ROWS.items()):
            _panel(panels[row, column], cases, error)
            panels[row, column].set_xlabel("wrong, %" if row == len(ROWS) - 1 else "")
            panels[row, column].set_ylabel(label if column == 0 else "")
        head_panel(panels[0, column], title)
    legend_above(figure, panels[0, 0])
    arrange(figure)
    figure.savefig(path, dpi=110, facecolor="white")


def _is_of(case: Case, kind: Case) -> bool:
    return (
        case.id_delay_s,
        case.gyro_bias_scale,
        case.wrong_id_share,
        case.tracks,
    ) == (
        kind.id_delay_s,
        kind.gyro_bias_scale,
        kind.wrong_id_share,
        kind.tracks,
    )


def _panel(
    panel: Axes, cases: dict[float, dict[str, dict[str, float]]], error: str
) -> None:
    """Mean and standard error at each rate; where a run has no figure there is no mean, and no point."""
    percent = 100 * np.array(list(cases))
    if error != "landmarks":
        means = [told["dead reckoning"][f"{error}_m"] for told in cases.values()]
        panel.plot(percent, means, color=MUTED, linewidth=1.0, label="dead reckoning")
        panel.set_ylim(bottom=0.0)
    else:
        logarithmic(panel, "y")
    for place, (name, (index, line)) in enumerate(DRAWN.items()):
        means, errors = (
            [told[name][f"{error}{of}_m"] for told in cases.values()]
            for of in ("", "_error")
        )
        x = percent + ASIDE_PERCENT * (place - 0.5 * (len(DRAWN) - 1))
        panel.errorbar(
            x,
            means,
            errors,
            color=colour(index),
            linestyle=line,
            linewidth=1.4,
            capsize=2,
            label=name,
        )
    panel.set_xticks(percent)
