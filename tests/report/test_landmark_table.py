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

MINUS = "\N{MINUS SIGN}"
UNKNOWN = np.full((3, 3), np.nan)


def rows_of(comparison: Comparison) -> list[list[str]]:
    """The texts of the table, with hyphens for minus signs and dashes."""
    table = landmark_table(comparison)
    return [
        [cell.text.replace(MINUS, "-").replace(ABSENT, "-") for cell in row]
        for row in table.rows
    ]


def mapped(*landmarks: tuple[int, float, float]) -> LandmarkMap:
    positions = np.array([[x, y, -1.0] for _, x, y in landmarks]).reshape(-1, 3)
    return LandmarkMap(
        np.array([i for i, *_ in landmarks]),
        positions,
        np.tile(UNKNOWN, (len(landmarks), 1, 1)),
    )


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
            [
                ["ID 3, x", "1.250", "1.500 (0.250)"],
                ["ID 3, y", "-2.000", "-2.250 (-0.250)"],
            ],
        ),
        (  # a landmark that is not mapped has a dash, one that is not true has no row
            [(1, 1.0, 1.0), (8, 4.0, 4.0)],
            [(1, 1.0, 1.0), (2, 2.0, 2.0)],
            [
                *(
                    ["ID 1, x", "1.000", "1.000 (0.000)"],
                    ["ID 1, y", "1.000", "1.000 (0.000)"],
                ),
                *(["ID 2, x", "2.000", "-"], ["ID 2, y", "2.000", "-"]),
            ],
        ),
        (
            [(1, -1e-6, 0.0)],
            [(1, 0.0, 0.0)],
            [["ID 1, x", "0.000", "0.000 (0.000)"]],
        ),  # zero has no sign
        ([(3, 1.5, -2.25)], None, [["ID 3, x", "1.500"], ["ID 3, y", "-2.250"]]),
    ],
)
def test_estimates_stand_beside_the_truth_with_their_difference(
    estimated, true, expected
):
    shown = rows_of(
        by_hand(mapped(*estimated), None if true is None else mapped(*true))
    )
    assert shown[: len(expected)] == expected
    assert len(shown) == (len(expected) if true is None else 2 * len(true) + 2)


def test_totals_are_the_scores_of_all_landmarks():
    comparison = basin_comparison(60)
    table = landmark_table(comparison)
    assert [column.heading for column in table.columns[2:]] == ["isam2", "ekf-slam"]
    (first,) = table.sections
    for row, key in zip(
        table.rows[first:], ("landmarks.raw_m", "landmarks.se2_m"), strict=True
    ):
        expected = [
            f"{comparison.scores[name][key].value:.3f}"
            for name in ("isam2", "ekf-slam")
        ]
        assert [cell.text for cell in row[2:]] == expected
    many = mapped(*((i, float(i), 0.0) for i in range(MOST_LANDMARKS + 3)))
    assert len(rows_of(by_hand(many, many))) == 2 * MOST_LANDMARKS + 2
    assert landmarks_left_out(by_hand(many, many)) == 3
    assert landmarks_left_out(comparison) == 0
    assert landmark_table(only(comparison, "dead-reckoning")) is None, (
        "no map, no table"
    )
    assert landmark_table(by_hand(mapped(), mapped((1, 0.0, 0.0)))) is None
