"""Landmarks in rows, as in Table I of the 2014 paper: true and estimated x and y, the difference in brackets.

Where a run repeats the published experiment, the paper's own table stands beside it.
"""

import math

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
from sonar_graph.measurements import Floats
from sonar_graph.states import LandmarkMap, landmark_name
from sonar_graph.table import ABSENT, Column, Table, text_table

PAPER = "2014 paper"
# largest number of landmarks in rows; others are left to ``landmarks.csv``
MOST_LANDMARKS = 30
DECIMALS = 3
PAPER_DECIMALS = 2


def places_of(landmarks: LandmarkMap | None) -> dict[int, Floats]:
    """Positions of landmarks by identity, each of shape (3,), m; empty without a map."""
    if landmarks is None:
        return {}
    return dict(zip(landmarks.ids.tolist(), landmarks.positions, strict=True))


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
    true_places = places_of(true)
    places = {name: places_of(landmarks) for name, landmarks in maps.items()}
    for id_ in mapped_ids(comparison, list(maps.values()))[:MOST_LANDMARKS]:
        at = true_places.get(id_)
        # the paper gives x and y
        for axis, letter in enumerate("xy"):
            row = [f"ID {landmark_name(id_)}, {letter}"]
            # without a truth its column would be empty
            row += [] if true is None else [_with_difference(at, None, axis, DECIMALS)]
            for name, known in places.items():
                decimals = PAPER_DECIMALS if name == PAPER else DECIMALS
                row.append(_with_difference(known.get(id_), at, axis, decimals))
            rows.append(row)
    sections = {}
    heads = [Column("quantity", "Quantity", is_number=False)]
    caption = "Positions in the map at the end, metres"
    if true is not None:
        # below the last landmark
        sections[len(rows)] = "In all"
        heads.append(Column("true", "true"))
        caption += "; in brackets estimate minus truth"
        errors = [landmark_errors(landmarks, true) for landmarks in maps.values()]
        raw_m = [rmse(e.horizontal_m) if e else math.nan for e in errors]
        aligned_m = [e.aligned_rmse_m for e in errors]
        if not is_aligned:
            what = f"RMS, {unaligned(comparison.sequence)}"
            rows.append([what, "", *(fixed(value, DECIMALS) for value in raw_m)])
        what = "RMS after SE(2) alignment"
        rows.append([what, "", *(fixed(value, DECIMALS) for value in aligned_m)])
    heads += [Column(name, name) for name in maps]
    if comparison.is_aligned:
        caption += "; each map aligned to the true landmarks"
    elif is_aligned:
        caption += (
            "; maps aligned to the true landmarks, whose world is not that of the start"
        )
    elif true is not None:
        caption += f"; {unaligned(comparison.sequence)}"
    return text_table("landmarks", caption, heads, rows, sections=sections)


def mapped_ids(comparison: Comparison, maps: list[LandmarkMap]) -> list[int]:
    """Identities of the true landmarks; where these are not known, of the maps."""
    true = comparison.sequence.true_landmarks
    known = maps if true is None else [true]
    return sorted({id_ for landmarks in known for id_ in landmarks.ids.tolist()})


def landmarks_left_out(comparison: Comparison) -> int:
    """Number of landmarks for which the table has no row."""
    maps = [run.landmarks for run in comparison.runs if run.landmarks is not None]
    return max(0, len(mapped_ids(comparison, maps)) - MOST_LANDMARKS) if maps else 0


def _with_difference(
    place: Floats | None, true: Floats | None, axis: int, decimals: int
) -> str:
    """A coordinate in metres, and in brackets its difference to the true one."""
    if place is None:
        return ABSENT
    shown = fixed(place[axis], decimals)
    if true is None:
        return shown
    return f"{shown} ({fixed(place[axis] - true[axis], decimals)})"
