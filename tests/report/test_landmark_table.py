from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.evaluation.results import ABSENT, Comparison
from sonar_graph.evaluation.scored_instants import published_maps
from sonar_graph.report.landmark_table import MOST_LANDMARKS, PAPER, landmark_table
from sonar_graph.states import LandmarkMap, Trajectory
from tests.synthetic import basin_comparison, only, with_run

MINUS = "\N{MINUS SIGN}"
UNKNOWN = np.full((3, 3), np.nan)


def minus(text: str) -> str:
    """The text with minus signs for hyphens."""
    return text.replace("-", MINUS)


def mapped(*landmarks: tuple[int, float, float]) -> LandmarkMap:
    positions = np.array([[x, y, -1.0] for _, x, y in landmarks]).reshape(-1, 3)
    return LandmarkMap(np.array([i for i, *_ in landmarks]), positions, np.tile(UNKNOWN, (len(landmarks), 1, 1)))


def by_hand(estimated: LandmarkMap, true: LandmarkMap | None) -> Comparison:
    """One run with this map in a log with that truth."""
    comparison = only(basin_comparison(8), "isam2")
    changed = with_run(comparison, replace(comparison.runs[0], landmarks=estimated))
    return replace(changed, sequence=replace(comparison.sequence, true_landmarks=true))


def repeated(instants: int = 60) -> Comparison:
    """The published landmarks in a synthetic run."""
    comparison = basin_comparison(instants)
    return replace(comparison, sequence=replace(comparison.sequence, true_landmarks=published_maps()[1]))


def test_estimates_stand_beside_the_truth_with_their_difference():
    table = landmark_table(by_hand(mapped((3, 1.5, -2.25)), mapped((3, 1.25, -2.0))))
    assert table is not None
    assert [(row.label, row.true, row.cells) for row in table.positions] == [
        ("ID 3, x", "1.250", ["1.500 (0.250)"]),
        ("ID 3, y", minus("-2.000"), [minus("-2.250 (-0.250)")]),
    ]
    assert table.totals[0].cells == ["0.354"]


def test_what_is_not_mapped_and_what_is_not_true_has_a_dash():
    table = landmark_table(by_hand(mapped((1, 1.0, 1.0), (8, 4.0, 4.0)), mapped((1, 1.0, 1.0), (2, 2.0, 2.0))))
    assert table is not None
    assert [row.label for row in table.positions] == ["ID 1, x", "ID 1, y", "ID 2, x", "ID 2, y"]
    assert [row.cells for row in table.positions[2:]] == [[ABSENT], [ABSENT]]


def test_a_difference_that_rounds_to_nothing_has_no_sign():
    table = landmark_table(by_hand(mapped((1, -1e-6, 0.0)), mapped((1, 0.0, 0.0))))
    assert table is not None
    assert table.positions[0].cells == ["0.000 (0.000)"]


def test_without_truth_there_is_nothing_in_brackets_and_no_total():
    table = landmark_table(by_hand(mapped((3, 1.5, -2.25)), None))
    assert table is not None
    assert not table.has_truth
    assert [row.cells for row in table.positions] == [["1.500"], [minus("-2.250")]]
    assert table.totals == []


def test_totals_are_the_scores():
    comparison = basin_comparison(60)
    table = landmark_table(comparison)
    assert table is not None
    assert table.columns == ["isam2", "ekf-slam"]
    for row, key in zip(table.totals, ("landmarks.raw_m", "landmarks.se2_m"), strict=True):
        assert row.cells == [f"{comparison.scores[name][key].value:.3f}" for name in table.columns]


def test_no_map_no_table():
    assert landmark_table(only(basin_comparison(8), "dead-reckoning")) is None
    assert landmark_table(by_hand(mapped(), mapped((1, 0.0, 0.0)))) is None


def test_landmarks_beyond_what_a_page_holds_are_counted():
    many = mapped(*((i, float(i), 0.0) for i in range(MOST_LANDMARKS + 3)))
    table = landmark_table(by_hand(many, many))
    assert table is not None
    assert (len(table.positions), table.left_out) == (2 * MOST_LANDMARKS, 3)


def test_only_the_repeated_experiment_has_the_papers_column():
    other, same = landmark_table(basin_comparison(60)), landmark_table(repeated())
    assert other is not None
    assert PAPER not in other.columns
    assert same is not None
    assert same.columns == ["isam2", "ekf-slam", "dead-reckoning", PAPER]
    assert [row.cells[-1] for row in same.positions[:4]] == [
        minus("4.81 (-0.19)"),
        minus("-0.07 (-0.07)"),
        minus("6.74 (-0.26)"),
        minus("-5.01 (-0.01)"),
    ]
    assert [row.cells[-1] for row in same.totals] == ["0.227", "0.093", minus("-0.3013"), minus("-0.1758")]
    assert not same.has_map(2)
    assert same.has_map(3)


@pytest.mark.parametrize("begins_later", [0, 3])
def test_the_return_is_told_against_the_truth_at_the_runs_own_ends(begins_later: int):
    """A path that keeps a distance from the truth returns as the truth does; one that drifts by 0.3 m does not."""
    comparison = repeated()
    truth = comparison.sequence.truth
    assert truth is not None
    path = truth.rows(slice(begins_later, None))
    for drift_m, difference in ((0.0, "(0.000)"), (0.3, "(0.300)")):
        away = path.positions + np.linspace([0.5, 0.5, 0.0], [0.5 + drift_m, 0.5 + drift_m, 0.0], len(path))
        moved = Trajectory.without_covariances(path.stamps_ns, away, path.quaternions_xyzw)
        table = landmark_table(with_run(comparison, replace(comparison.runs[0], causal=moved)))
        assert table is not None
        assert all(row.cells[0].endswith(difference) for row in table.totals[2:])
        way = away[-1] - away[0]
        assert table.totals[2].cells[0].startswith(minus(f"{way[0]:.3f}"))
