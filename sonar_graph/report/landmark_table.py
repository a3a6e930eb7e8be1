"""Landmarks in rows, as in Table I of the 2014 paper: true and estimated x and y, the difference in brackets.

Where a run repeats the published experiment, the paper's own table stands beside it.
"""

import numpy as np

from sonar_graph.evaluation import (
    Comparison,
    fixed,
    landmark_errors,
    published_maps,
    repeats_published,
    rmse,
    scored_map,
    unaligned,
)
from sonar_graph.states import LandmarkMap, landmark_name
from sonar_graph.table import ABSENT, Column, Table, words

PAPER = "2014 paper"
# largest number of landmarks in rows; others are left to ``landmarks.csv``
MOST_LANDMARKS = 30
DECIMALS = 3
PAPER_DECIMALS = 2


def coordinate(landmarks: LandmarkMap | None, identity: int, axis: int) -> float | None:
    """The x or y of a landmark; None where it is not in the map, or without a map."""
    if landmarks is None or identity not in landmarks.ids:
        return None
    return float(landmarks.positions[landmarks.ids == identity, axis][0])


def landmark_table(comparison: Comparison) -> Table | None:
    """The final maps of the runs against the true one, as scored; None where no run has mapped a landmark.

    Columns: quantity, true value (where the true landmarks are known), each run with a map, and the paper where its
    experiment is repeated. Rows: x and y of each landmark; below a section heading the RMS errors.
    """
    true = comparison.sequence.true_landmarks
    maps: dict[str, LandmarkMap] = {}
    # a map may also be aligned because its world is not that of the truth
    is_aligned = comparison.is_aligned
    for run in comparison.runs:
        if run.landmarks:
            scored = scored_map(run.landmarks, comparison.sequence)
            maps[run.estimator] = run.landmarks if scored is None else scored.landmarks
            is_aligned |= scored is not None and scored.alignment is not None
    if not maps:
        return None
    if repeats_published(comparison.sequence):
        maps[PAPER] = published_maps()[0]
    rows: list[list[str]] = []
    for id_ in mapped_ids(comparison, list(maps.values()))[:MOST_LANDMARKS]:
        # the paper gives x and y
        for axis in (0, 1):
            at = coordinate(true, id_, axis)
            row = [f"ID {landmark_name(id_)}, {'xy'[axis]}"]
            row.append(_with_difference(at, None, DECIMALS))
            for name, landmarks in maps.items():
                decimals = PAPER_DECIMALS if name == PAPER else DECIMALS
                value = coordinate(landmarks, id_, axis)
                row.append(_with_difference(value, at, decimals))
            rows.append(row)
    sections = {}
    if true is not None:
        # below the last landmark
        sections[len(rows)] = "In all"
        errors = [landmark_errors(landmarks, true) for landmarks in maps.values()]
        if not is_aligned:
            raw = [
                fixed(rmse(e.horizontal_m), DECIMALS) if e else ABSENT for e in errors
            ]
            rows.append([f"RMS, {unaligned(comparison.sequence)}", "", *raw])
        aligned = [
            ABSENT if np.isnan(e.aligned_rmse_m) else fixed(e.aligned_rmse_m, DECIMALS)
            for e in errors
        ]
        rows.append(["RMS after SE(2) alignment", "", *aligned])
    heads = [Column("quantity", "Quantity", is_number=False), Column("true", "true")]
    heads += [Column(name, name) for name in maps]
    # without a truth its column would be empty
    if true is None:
        heads = [heads[0], *heads[2:]]
        rows = [[row[0], *row[2:]] for row in rows]
    caption = "Positions in the map at the end, metres"
    if true is not None:
        caption += "; in brackets estimate minus truth"
    if comparison.is_aligned:
        caption += "; each map aligned to the true landmarks"
    elif is_aligned:
        caption += (
            "; maps aligned to the true landmarks, whose world is not that of the start"
        )
    elif true is not None:
        caption += f"; {unaligned(comparison.sequence)}"
    cells = [[words(text) for text in row] for row in rows]
    return Table("landmarks", caption, "", heads, cells, sections)


def mapped_ids(comparison: Comparison, maps: list[LandmarkMap]) -> list[int]:
    """Identities of the true landmarks; where these are not known, of the maps."""
    true = comparison.sequence.true_landmarks
    known = maps if true is None else [true]
    return sorted({id_ for landmarks in known for id_ in landmarks.ids.tolist()})


def landmarks_left_out(comparison: Comparison) -> int:
    """Number of landmarks for which the table has no row."""
    maps = [run.landmarks for run in comparison.runs if run.landmarks is not None]
    return max(0, len(mapped_ids(comparison, maps)) - MOST_LANDMARKS) if maps else 0


def _with_difference(value: float | None, true: float | None, decimals: int) -> str:
    """A coordinate in metres, and in brackets its difference to the true one."""
    if value is None:
        return ABSENT
    shown = fixed(value, decimals)
    return shown if true is None else f"{shown} ({fixed(value - true, decimals)})"
