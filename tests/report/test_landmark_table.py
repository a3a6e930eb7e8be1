from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.evaluation import Comparison
from sonar_graph.report.landmark_table import (
    MOST_LANDMARKS,
    landmark_table,
    landmarks_left_out,
)
from sonar_graph.states import LandmarkMap
from sonar_graph.table import ABSENT
from tests.synthetic import basin_comparison, only, with_run


def rows_of(comparison: Comparison) -> list[list[str]]:
    """The texts of the table, with hyphens for minus signs and dashes."""
    plain = str.maketrans(f"\N{MINUS SIGN}{ABSENT}", "--")
    rows = landmark_table(comparison).rows
    return [[cell.text.translate(plain) for cell in row] for row in rows]


def mapped(*landmarks: tuple[int, float, float]) -> LandmarkMap:
    ids, x, y = np.reshape(landmarks, (-1, 3)).T
    unknown = np.full((len(ids), 3, 3), np.nan)
    return LandmarkMap(ids.astype(int), np.column_stack([x, y, x]), unknown)


def by_hand(estimated: LandmarkMap, true: LandmarkMap | None) -> Comparison:
    """One run with this map in a log with that truth."""
    comparison = only(basin_comparison(8), "isam2")
    changed = with_run(comparison, replace(comparison.runs[0], landmarks=estimated))
    return replace(changed, sequence=replace(comparison.sequence, true_landmarks=true))


@pytest.mark.parametrize(
    ("estimated", "true", "expected"),
    [
        (
            [(3, 1.5, -2.25)],
            [(3, 1.25, -2.0)],
            ["ID 3, x|1.250|1.500 (0.250)", "ID 3, y|-2.000|-2.250 (-0.250)"],
        ),
        (  # a landmark that is not mapped has a dash, one that is not true has no row
            [(1, 1.0, 1.0), (8, 4.0, 4.0)],
            [(1, 1.0, 1.0), (2, 2.0, 2.0)],
            [
                *("ID 1, x|1.000|1.000 (0.000)", "ID 1, y|1.000|1.000 (0.000)"),
                *("ID 2, x|2.000|-", "ID 2, y|2.000|-"),
            ],
        ),
        # zero has no sign
        ([(1, -1e-6, 0.0)], [(1, 0.0, 0.0)], ["ID 1, x|0.000|0.000 (0.000)"]),
        ([(3, 1.5, -2.25)], None, ["ID 3, x|1.500", "ID 3, y|-2.250"]),
    ],
)
def test_estimates_stand_beside_the_truth_with_their_difference(
    estimated, true, expected
):
    comparison = by_hand(mapped(*estimated), mapped(*true) if true else None)
    shown = ["|".join(row) for row in rows_of(comparison)]
    assert shown[: len(expected)] == expected
    assert len(shown) == (2 * len(true) + 2 if true else len(expected))


def test_totals_are_the_scores_of_all_landmarks():
    comparison = basin_comparison(60)
    table = landmark_table(comparison)
    names = [column.heading for column in table.columns[2:]]
    assert names == ["isam2", "ekf-slam"]
    (first,) = table.sections
    keys = "landmarks.raw_m", "landmarks.se2_m"
    for row, key in zip(table.rows[first:], keys, strict=True):
        values = [comparison.scores[name][key].value for name in names]
        assert [cell.text for cell in row[2:]] == [f"{value:.3f}" for value in values]
    known = mapped(*((i, i, 0) for i in range(MOST_LANDMARKS + 3)))
    many = by_hand(known, known)
    assert len(rows_of(many)) == 2 * MOST_LANDMARKS + 2
    assert landmarks_left_out(many) == 3
    assert landmarks_left_out(comparison) == 0
    unmapped = only(comparison, "dead-reckoning")
    assert landmark_table(unmapped) is None, "no map, no table"
    assert landmark_table(by_hand(mapped(), mapped((1, 0.0, 0.0)))) is None
