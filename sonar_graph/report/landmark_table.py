"""Landmarks in rows, as in Table I of the 2014 paper: true and estimated x and y, the difference in brackets.

Where a run repeats the published experiment, the paper's own table stands beside it, and two rows give the displacement
from the first to the last position.
"""

from dataclasses import dataclass

import numpy as np

from sonar_graph.evaluation import (
    RETURN_M,
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
from sonar_graph.states import LandmarkMap, Trajectory, landmark_name
from sonar_graph.table import ABSENT, Column, Table, words

PAPER = "2014 paper"
# largest number of landmarks in rows; others are left to ``landmarks.csv``
MOST_LANDMARKS = 30
DECIMALS = 3
PAPER_DECIMALS = 2
PAPER_RETURN_DECIMALS = 4


@dataclass(frozen=True)
class MapColumn:
    """The source of one column of the table: a run, or the paper."""

    landmarks: LandmarkMap | None
    path: Trajectory | None = None
    """None for the paper, whose path is not published."""
    decimals: int = DECIMALS


def coordinate(landmarks: LandmarkMap | None, identity: int, axis: int) -> float | None:
    """The x or y of a landmark; None where it is not in the map, or there is none."""
    if landmarks is None or identity not in landmarks.ids:
        return None
    return float(landmarks.positions[landmarks.ids == identity, axis][0])


def landmark_table(comparison: Comparison) -> Table | None:
    """The final maps of the runs against the true one, as scored; None where no run has mapped a landmark.

    Columns: quantity, true value (where the true landmarks are known), each run with a map, and the paper where its
    experiment is repeated (then also runs with a path only). Rows: x and y of each landmark; below a section heading
    the RMS errors and the displacement.
    """
    runs = comparison.runs
    true = comparison.sequence.true_landmarks
    repeats = repeats_published(comparison.sequence)
    mapped = {}
    # a map may also be aligned because its world is not that of the truth
    is_aligned = comparison.is_aligned
    for run in runs:
        if run.landmarks is not None and len(run.landmarks):
            scored = scored_map(run.landmarks, comparison.sequence)
            mapped[run.estimator] = (
                run.landmarks if scored is None else scored.landmarks
            )
            is_aligned |= scored is not None and scored.alignment is not None
    columns = {name: MapColumn(landmarks) for name, landmarks in mapped.items()}
    # beside the paper also runs with a path only count: it compares returns too
    if repeats:
        walked = {
            run.estimator: run.causal
            for run in runs
            if run.causal is not None and len(run.causal)
        }
        columns = {
            name: MapColumn(mapped.get(name), path) for name, path in walked.items()
        }
        columns[PAPER] = MapColumn(published_maps()[0], decimals=PAPER_DECIMALS)
    known = [
        column.landmarks for column in columns.values() if column.landmarks is not None
    ]
    if not known:
        return None
    rows: list[list[str]] = []
    for id_ in mapped_ids(comparison, known)[:MOST_LANDMARKS]:
        # the paper gives x and y
        for axis in (0, 1):
            at = coordinate(true, id_, axis)
            found = [
                (coordinate(column.landmarks, id_, axis), column.decimals)
                for column in columns.values()
            ]
            cells = [_with_difference(value, at, decimals) for value, decimals in found]
            rows.append(
                [
                    f"ID {landmark_name(id_)}, {'xy'[axis]}",
                    _with_difference(at, None, DECIMALS),
                    *cells,
                ]
            )
    sections = {}
    if true is not None:
        # below the last landmark
        sections[len(rows)] = "In all"
        errors = [
            None if one.landmarks is None else landmark_errors(one.landmarks, true)
            for one in columns.values()
        ]
        raw = [fixed(rmse(e.horizontal_m), DECIMALS) if e else ABSENT for e in errors]
        aligned = [
            ABSENT
            if not e or np.isnan(e.aligned_rmse_m)
            else fixed(e.aligned_rmse_m, DECIMALS)
            for e in errors
        ]
        rows += (
            [] if is_aligned else [[f"RMS, {unaligned(comparison.sequence)}", "", *raw]]
        )
        rows.append(["RMS after SE(2) alignment", "", *aligned])
        if repeats:
            rows += _return_rows(
                comparison.sequence.truth, [column.path for column in columns.values()]
            )
    heads = [Column("quantity", "Quantity", is_number=False), Column("true", "true")]
    heads += [Column(name, name) for name in columns]
    # without a truth its column would be empty
    if true is None:
        heads, rows = [heads[0], *heads[2:]], [[row[0], *row[2:]] for row in rows]
    caption = "Positions in the map at the end, metres" + (
        "" if true is None else "; in brackets estimate minus truth"
    )
    if comparison.is_aligned:
        caption += "; each map aligned to the true landmarks"
    elif is_aligned:
        caption += (
            "; maps aligned to the true landmarks, whose world is not that of the start"
        )
    elif true is not None:
        caption += f"; {unaligned(comparison.sequence)}"
    return Table(
        "landmarks",
        caption,
        "",
        heads,
        [[words(text) for text in row] for row in rows],
        sections,
    )


def mapped_ids(comparison: Comparison, maps: list[LandmarkMap]) -> list[int]:
    """Identities of the true landmarks; where these are not known, of the maps."""
    true = comparison.sequence.true_landmarks
    return np.unique(
        np.concatenate(
            [landmarks.ids for landmarks in ([true] if true is not None else maps)]
        )
    ).tolist()


def landmarks_left_out(comparison: Comparison) -> int:
    """Number of landmarks for which the table has no row."""
    maps = [run.landmarks for run in comparison.runs if run.landmarks is not None]
    return max(0, len(mapped_ids(comparison, maps)) - MOST_LANDMARKS) if maps else 0


def _return_rows(
    truth: Trajectory | None, paths: list[Trajectory | None]
) -> list[list[str]]:
    """Last minus first position of the causal estimates, and of the truth at the same instants or nearest to them."""

    def displacement(path: Trajectory) -> Floats:
        return np.asarray(path.positions[-1] - path.positions[0])

    rows = []
    for axis in (0, 1):
        first = ABSENT
        cells = []
        for place, path in enumerate(paths):
            if path is None:
                cells.append(fixed(RETURN_M[axis], PAPER_RETURN_DECIMALS))
                continue
            at = None
            if truth is not None:
                # a truth that begins later or ends earlier has a displacement between its own ends
                ends_ns = np.clip(
                    path.stamps_ns[[0, -1]], truth.stamps_ns[0], truth.stamps_ns[-1]
                )
                if ends_ns[0] < ends_ns[1]:  # else they have no time in common
                    at = float(displacement(truth.at(ends_ns))[axis])
            cells.append(
                _with_difference(float(displacement(path)[axis]), at, DECIMALS)
            )
            first = _with_difference(at, None, DECIMALS) if place == 0 else first
        rows.append([f"last minus first position, {'xy'[axis]}", first, *cells])
    return rows


def _with_difference(value: float | None, true: float | None, decimals: int) -> str:
    """A coordinate in metres, and in brackets its difference to the true one."""
    if value is None:
        return ABSENT
    shown = fixed(value, decimals)
    return shown if true is None else f"{shown} ({fixed(value - true, decimals)})"
