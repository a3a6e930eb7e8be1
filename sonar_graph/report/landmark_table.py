"""Landmarks in rows, as in Table I of the 2014 paper: true and estimated x and y, the difference in brackets.

Where a run repeats the published experiment the paper's own table stands beside it, and two rows tell how far from its
first position the last one is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_graph.evaluation import (
    ABSENT,
    RETURN_M,
    Comparison,
    anonymous_named,
    landmark_errors,
    published_maps,
    repeats_published,
    rmse,
)
from sonar_graph.measurements import Floats
from sonar_graph.states import LandmarkMap, Trajectory

PAPER = "2014 paper"
MOST_LANDMARKS = 30
"""Rows of more landmarks than a page should hold are left to ``landmarks.csv``."""
DECIMALS, PAPER_DECIMALS, PAPER_RETURN_DECIMALS = 3, 2, 4


@dataclass(frozen=True)
class LandmarkRow:
    """One quantity in metres: of the truth and of each column."""

    label: str
    true: str
    cells: list[str]


@dataclass(frozen=True)
class LandmarkTable:
    """Landmarks, and below them what they come to."""

    columns: list[str]
    """Runs that have a map; at the end the paper, where its experiment is repeated."""
    has_truth: bool
    positions: list[LandmarkRow]
    totals: list[LandmarkRow]
    left_out: int
    """Landmarks for which there is no row."""

    def has_map(self, column: int) -> bool:
        """Whether a column holds any position."""
        return any(row.cells[column] != ABSENT for row in self.positions)


@dataclass(frozen=True)
class _Column:
    """What one column is made from."""

    landmarks: LandmarkMap | None
    path: Trajectory | None
    """None for the paper, whose path is not published."""
    decimals: int


def landmark_table(comparison: Comparison) -> LandmarkTable | None:
    """The final maps of the runs against the true one, not aligned; None where no run has mapped a landmark."""
    columns = _columns(comparison)
    known = [column.landmarks for column in columns.values() if column.landmarks is not None]
    if not known:
        return None
    true, shown = comparison.sequence.true_landmarks, list(columns.values())
    ids = np.unique(np.concatenate([landmarks.ids for landmarks in ([true] if true is not None else known)])).tolist()
    return LandmarkTable(
        columns=list(columns),
        has_truth=true is not None,
        positions=[_position_row(id_, axis, true, shown) for id_ in ids[:MOST_LANDMARKS] for axis in (0, 1)],
        totals=_totals(comparison, true, shown),
        left_out=max(0, len(ids) - MOST_LANDMARKS),
    )


def _columns(comparison: Comparison) -> dict[str, _Column]:
    """Runs with a map; where the published experiment is repeated all that have a path, and the paper."""
    runs, true = comparison.runs, comparison.sequence.true_landmarks
    mapped = {
        run.estimator: anonymous_named(run.landmarks, true)
        for run in runs
        if run.landmarks is not None and len(run.landmarks)
    }
    if not repeats_published(comparison.sequence):
        return {name: _Column(landmarks, None, DECIMALS) for name, landmarks in mapped.items()}
    walked = {run.estimator: run.causal for run in runs if run.causal is not None and len(run.causal)}
    columns = {name: _Column(mapped.get(name), path, DECIMALS) for name, path in walked.items()}
    return columns | {PAPER: _Column(published_maps()[0], None, PAPER_DECIMALS)}


def _position_row(identity: int, axis: int, true: LandmarkMap | None, columns: list[_Column]) -> LandmarkRow:
    at = None if true is None else _coordinate(true, identity, axis)
    cells = [_with_difference(_coordinate(column.landmarks, identity, axis), at, column.decimals) for column in columns]
    return LandmarkRow(f"ID {identity}, {'xy'[axis]}", ABSENT if at is None else _metres(at, DECIMALS), cells)


def _coordinate(landmarks: LandmarkMap | None, identity: int, axis: int) -> float | None:
    if landmarks is None:
        return None
    rows = np.flatnonzero(landmarks.ids == identity)
    return float(landmarks.positions[rows[0], axis]) if rows.size else None


def _totals(comparison: Comparison, true: LandmarkMap | None, columns: list[_Column]) -> list[LandmarkRow]:
    if true is None:
        return []
    errors = [None if column.landmarks is None else landmark_errors(column.landmarks, true) for column in columns]
    raw = [_rms(rmse(e.horizontal_m)) if e else ABSENT for e in errors]
    aligned = [_rms(e.aligned_rmse_m) if e else ABSENT for e in errors]
    rows = [LandmarkRow("RMS, not aligned", "", raw), LandmarkRow("RMS after SE(2) alignment", "", aligned)]
    return [*rows, *_return_rows(comparison, columns)] if repeats_published(comparison.sequence) else rows


def _return_rows(comparison: Comparison, columns: list[_Column]) -> list[LandmarkRow]:
    """Last minus first position of the causal estimates, and of the truth at the same instants."""
    truth = comparison.sequence.truth
    paths = [column.path for column in columns]
    ways = [None if path is None else _way(path) for path in paths]
    true_ways = [None if truth is None or path is None else _way(_ends_along(truth, path)) for path in paths]
    rows = []
    for axis in (0, 1):
        at = [None if way is None else float(way[axis]) for way in true_ways]
        cells = [
            _metres(RETURN_M[axis], PAPER_RETURN_DECIMALS)
            if way is None
            else _with_difference(float(way[axis]), true, DECIMALS)
            for way, true in zip(ways, at, strict=True)
        ]
        label = f"last minus first position, {'xy'[axis]}"
        rows.append(LandmarkRow(label, ABSENT if at[0] is None else _metres(at[0], DECIMALS), cells))
    return rows


def _ends_along(truth: Trajectory, path: Trajectory) -> Trajectory:
    """The truth at a path's first and last instant, or as near to them as it reaches."""
    return truth.at(np.clip(path.stamps_ns[[0, -1]], truth.stamps_ns[0], truth.stamps_ns[-1]))


def _way(path: Trajectory) -> Floats:
    return np.asarray(path.positions[-1] - path.positions[0])


def _with_difference(value: float | None, true: float | None, decimals: int) -> str:
    if value is None:
        return ABSENT
    shown = _metres(value, decimals)
    return shown if true is None else f"{shown} ({_metres(value - true, decimals)})"


def _rms(value: float) -> str:
    return ABSENT if np.isnan(value) else _metres(value, DECIMALS)


def _metres(value: float, decimals: int) -> str:
    text = f"{value:.{decimals}f}"
    return (text[1:] if float(text) == 0 and text.startswith("-") else text).replace("-", "\N{MINUS SIGN}")
