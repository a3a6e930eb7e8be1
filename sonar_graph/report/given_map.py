"""A map of known landmarks beside what the dive made of it: what moved, what was not seen, where the start was found."""

import math
from collections.abc import Container
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from sonar_graph.calibration import KnownMap
from sonar_graph.evaluation import Comparison, RunResult, fixed
from sonar_graph.models import LOCATED_AGAIN
from sonar_graph.report import figure_style as style
from sonar_graph.report.landmark_table import DECIMALS, MOST_LANDMARKS, places_of
from sonar_graph.states import ABSENT, Outcome
from sonar_graph.table import Table, text_table

MOVED = "moved"


def landmarks_with(run: RunResult, outcomes: Container[Outcome]) -> set[int]:
    """Landmarks with a detection of one of these outcomes.

    One of the given map that is `Outcome.NEW` was taken out of it, and initialised again.
    """
    if run.detections is None:
        return set()
    ids = run.detections.landmark_ids.tolist()
    pairs = zip(ids, run.detections.outcomes, strict=True)
    return {landmark_id for landmark_id, each in pairs if each in outcomes}


def located_line(comparison: Comparison) -> str:
    """When and where each run was located in the map; empty where the start was not to be found in it."""
    sequence = comparison.sequence
    if sequence.calibration.start.source != "map":
        return ""
    parts = []
    for run in comparison.runs:
        if not run.causal:
            parts.append(f"{run.estimator}: not located")
            continue
        seconds = (run.causal.stamps_ns[0] - sequence.start_ns) * 1e-9
        x, y, _ = run.causal.positions[0].tolist()
        part = f"{run.estimator}: after {seconds:.1f} s at ({x:.2f}, {y:.2f}) m"
        again = [
            m.partition(":")[0] for m in run.withheld if m.startswith(LOCATED_AGAIN)
        ]
        parts.append(", ".join([part, *again]))
    return f"Located in the map: {', '.join(parts)}."


def draw_given_map(panel: Axes, comparison: Comparison) -> None:
    """Draw the given places of landmarks, a line to where each moved, and a star where each run was located.

    The world is that of the given map, so that nothing is drawn after an alignment to the truth.
    """
    known = comparison.sequence.calibration.map
    if known is None or comparison.is_aligned:
        return
    places = dict(zip(known.ids, np.array(known.positions_m)[:, :2], strict=True))
    look: dict[str, Any] = {"markersize": 10, "markerfacecolor": "none", "zorder": 3}
    panel.plot(
        *zip(*places.values(), strict=True),
        "s",
        color=style.MUTED,
        label="map that was given",
        **look,
    )
    for index, run in enumerate(comparison.runs):
        own = style.colour(index)
        found = places_of(run.landmarks)
        for landmark_id in mapped_again(run, known):
            if landmark_id in found:
                ends = np.array([places[landmark_id], found[landmark_id][:2]])
                panel.plot(*ends.T, color=own, linewidth=2.5, zorder=6)
        is_found = comparison.sequence.calibration.start.source == "map"
        if is_found and run.causal:
            first = run.causal.positions[0, :2]
            panel.plot(*first, "*", color=own, markersize=13, zorder=7)


def mapped_again(run: RunResult, known: KnownMap) -> list[int]:
    """Landmarks of the given map that a run took out of it, and initialised again."""
    return sorted(landmarks_with(run, {Outcome.NEW}).intersection(known.ids))


def landmarks_moved(comparison: Comparison) -> bool:
    """True where a run took landmarks out of the given map, and initialised them again."""
    known = comparison.sequence.calibration.map
    return known is not None and any(
        mapped_again(run, known) for run in comparison.runs
    )


def given_map_table(comparison: Comparison) -> Table | None:
    """The map before and after: each landmark as given, and how far each run has it from there; None without a map."""
    known = comparison.sequence.calibration.map
    runs = [run for run in comparison.runs if run.landmarks is not None]
    if known is None or not runs:
        return None
    mapped = {run.estimator: places_of(run.landmarks) for run in runs}
    sigmas_m = np.sqrt(np.diag(known.joint()).reshape(-1, 3)[:, :2].mean(axis=1))
    rows = []
    for k, landmark_id in enumerate(known.ids):
        given = np.array(known.positions_m[k])
        cells = []
        for run in runs:
            found = mapped[run.estimator].get(landmark_id)
            if landmark_id not in landmarks_with(run, list(Outcome)):
                cells.append("not seen")
            elif found is None:
                cells.append(ABSENT)
            elif landmark_id not in landmarks_with(run, {Outcome.USED, Outcome.NEW}):
                # where it stands is not known by this dive
                cells.append("refused")
            else:
                away_m = fixed(math.hypot(*(found - given)[:2]), DECIMALS)
                is_moved = landmark_id in landmarks_with(run, {Outcome.NEW})
                cells.append(f"{away_m}, {MOVED}" if is_moved else away_m)
        place = f"{fixed(given[0], DECIMALS)}, {fixed(given[1], DECIMALS)}"
        rows.append([str(landmark_id), place, fixed(sigmas_m[k], DECIMALS), *cells])
    # what moved first, then what was seen
    rows.sort(key=lambda cells: (MOVED not in " ".join(cells), "not seen" in cells))
    added = sorted(set[int]().union(*mapped.values()).difference(known.ids))
    caption = "The map before and after: places as given, and the horizontal distance of each run's map from them, metres"
    if len(rows) > MOST_LANDMARKS:
        caption += f"; {len(rows) - MOST_LANDMARKS} more landmarks are in map.toml"
    if added:
        caption += f"; new: {', '.join(map(str, added[:MOST_LANDMARKS]))}"
    heads = ["Landmark", "given x, y", "sigma", *mapped]
    return text_table("given_map", caption, heads, rows[:MOST_LANDMARKS])
