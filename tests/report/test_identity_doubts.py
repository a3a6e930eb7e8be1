"""What is said of identities first: that there are none, that a map is wrong, what landmarks without a name are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.evaluation.digits import ABSENT
from sonar_graph.evaluation.results import Comparison, RunResult
from sonar_graph.evaluation.scores import landmark_scores
from sonar_graph.report.comparison_page import render_report
from sonar_graph.report.findings import ABSURD, doubt_of_identities, nameless_landmarks
from sonar_graph.report.landmark_table import landmark_table
from sonar_graph.states import FIRST_ANONYMOUS_ID, DetectionLog, LandmarkMap, Outcome
from tests.synthetic import IDS, LANDMARKS, basin_comparison, only, with_run

from .test_console import printed

SIGMA_M = 0.02


def with_map(
    ids: np.ndarray, offsets_m: list[float], policy: str = "robust", *, has_truth: bool = True, **changes: object
) -> Comparison:
    """One run whose landmarks are so far from the true ones along x, with a sigma of 2 cm."""
    comparison = only(basin_comparison(60), "isam2")
    positions = LANDMARKS + np.column_stack([offsets_m, np.zeros(4), np.zeros(4)])
    found = LandmarkMap(ids, positions, np.tile(SIGMA_M**2 * np.eye(3), (4, 1, 1)))
    run = replace(comparison.runs[0], landmarks=found, params={"identity": {"policy": policy}}, **changes)
    sequence = comparison.sequence if has_truth else replace(comparison.sequence, true_landmarks=None)
    return replace(with_run(comparison, run), sequence=sequence)


def log_of(outcomes: list[Outcome], innovations_m: list[float], landmark_id: int = 2) -> DetectionLog:
    n = len(outcomes)
    innovations = np.column_stack([innovations_m, np.zeros(n)])
    covs = np.tile(SIGMA_M**2 * np.eye(2), (n, 1, 1))
    return DetectionLog(np.arange(n), np.full(n, landmark_id), innovations, covs, outcomes)


def test_the_threshold_is_the_quantile_that_chance_exceeds_once_in_a_billion() -> None:
    assert np.exp(-ABSURD / 2) == pytest.approx(1e-9, rel=1e-6)  # of two degrees of freedom, in closed form


def test_a_landmark_that_its_covariance_rules_out_is_named_with_the_policy() -> None:
    comparison = with_map(IDS, [0.0, 0.05, 5.0, 0.01])
    line = (
        "Warning: isam2 puts landmark 3 far outside its covariance (NEES up to 31250); "
        'look at identities (identity.policy is "robust"), then at noise and start'
    )
    assert doubt_of_identities(comparison) == [line]
    assert line in printed(comparison, 200)
    page = render_report(comparison)
    assert page.index("puts landmark 3 far outside") < page.index("<nav")


def test_just_inside_the_quantile_nothing_is_said_and_just_outside_it_is() -> None:
    limit_m = SIGMA_M * np.sqrt(ABSURD)
    assert doubt_of_identities(with_map(IDS, [0.999 * limit_m] * 4)) == []
    (line,) = doubt_of_identities(with_map(IDS, [1.001 * limit_m] * 4))
    assert "landmarks 1, 2, 3 and 4 far outside" in line


def test_consistent_maps_are_never_called_wrong() -> None:
    rng = np.random.default_rng(1)
    assert not any(doubt_of_identities(with_map(IDS, list(rng.normal(0, SIGMA_M, 4)))) for _ in range(50))


def test_without_true_landmarks_the_innovations_tell() -> None:
    used = [Outcome.USED] * 10
    for far, is_told in ((2, False), (3, True), (10, True)):
        log = log_of(used, [1.0] * far + [0.01] * (10 - far))
        lines = doubt_of_identities(with_map(IDS, [0.0] * 4, has_truth=False, detections=log))
        assert bool(lines) == is_told, far
        if far == 3:
            assert "(mean NIS up to 375)" in lines[0]  # (3 * 50² + 7 * 0.5²) / 10 / 2
        assert not doubt_of_identities(with_map(IDS, [0.0] * 4, detections=log))  # the truth says that all is well
    assert lines[0].startswith("Warning: isam2: sightings of landmark 2 contradict its map (mean NIS up to 1250); look")


def test_sightings_contradict_a_map_where_sigmas_are_four_times_too_small_but_not_where_three() -> None:
    n, rng = 2000, np.random.default_rng(2)
    unit = replace(log_of([Outcome.USED] * n, [0.0] * n), innovations=SIGMA_M * rng.standard_normal((n, 2)))
    for factor, is_told in ((3.0, False), (4.0, True)):
        log = replace(unit, innovations=factor * unit.innovations)
        assert bool(doubt_of_identities(with_map(IDS, [0.0] * 4, has_truth=False, detections=log))) == is_told


@pytest.mark.parametrize(
    ("count", "listed"), [(2, "1 and 2"), (5, "1, 2, 3, 4 and 5"), (6, "1, 2, 3, 4, 5 and 1 more")]
)
def test_five_landmarks_are_named_and_more_are_counted(count: int, listed: str) -> None:
    ids, blank = np.arange(1, count + 1), with_map(IDS, [0.0] * 4, has_truth=False)
    log = replace(log_of([Outcome.USED] * count, [1.0] * count), landmark_ids=ids)
    landmarks = LandmarkMap(ids, np.zeros((count, 3)), np.zeros((count, 3, 3)))
    (line,) = doubt_of_identities(with_run(blank, replace(blank.runs[0], landmarks=landmarks, detections=log)))
    assert f"sightings of landmarks {listed} contradict its map" in line


@pytest.mark.parametrize("outcome", [Outcome.GATED, Outcome.WITHHELD, Outcome.REPEATED])
def test_innovations_that_were_refused_say_nothing_of_the_map(outcome: Outcome) -> None:
    log = log_of([outcome] * 10, [1.0] * 10)
    assert doubt_of_identities(with_map(IDS, [0.0] * 4, has_truth=False, detections=log)) == []


@pytest.mark.parametrize("outcome", [Outcome.NO_IDENTITY, Outcome.WAITING, Outcome.FORGOTTEN, Outcome.UNFIT])
def test_a_log_without_any_identity_is_told_with_what_to_do(outcome: Outcome) -> None:
    log = log_of([outcome] * 6, [np.nan] * 6)
    blind = with_map(IDS, [0.0] * 4, detections=log)
    line = (
        "Warning: none of 6 detections has an identity that isam2 can use: no landmark is mapped; "
        'isam2 maps them by place with identity.unknown.policy = "associate"'
    )
    assert doubt_of_identities(blind) == [line]
    assert line in printed(blind, 200)
    assert "none of 6 detections has an identity" in render_report(blind)
    one_used = log_of([outcome] * 5 + [Outcome.NEW], [np.nan] * 6)
    assert doubt_of_identities(with_map(IDS, [0.0] * 4, detections=one_used)) == []


def test_detections_that_were_refused_before_their_identity_mattered_do_not_hide_that_none_has_one() -> None:
    before = [Outcome.UNSOUND, Outcome.LATE, Outcome.UNLOCATED, Outcome.TRACK_REPEATED]
    mixed = log_of([*before, Outcome.WAITING, Outcome.NO_IDENTITY, Outcome.WAITING], [np.nan] * 7)
    (line,) = doubt_of_identities(with_map(IDS, [0.0] * 4, detections=mixed))
    assert line.startswith("Warning: none of 3 detections has an identity that isam2 can use")
    assert doubt_of_identities(with_map(IDS, [0.0] * 4, detections=log_of(before, [np.nan] * 4))) == []


def test_runs_that_know_no_identity_are_named_together_with_the_most_that_any_was_given() -> None:
    comparison = only(basin_comparison(60), "isam2", "ekf-slam")
    for run, n in zip(comparison.runs, (4, 6), strict=True):
        blind = replace(run, detections=log_of([Outcome.NO_IDENTITY] * n, [np.nan] * n))
        comparison = with_run(comparison, blind)
    (line,) = doubt_of_identities(comparison)
    assert line.startswith("Warning: none of 6 detections has an identity that isam2, ekf-slam can use")
    assert "associate" in line
    comparison = with_run(
        comparison, replace(comparison.runs[0], params={"identity": {"unknown": {"policy": "associate"}}})
    )
    assert not any("associate" in line for line in doubt_of_identities(comparison))


def test_what_is_asked_for_already_is_not_advised() -> None:
    blind = with_map(IDS, [0.0] * 4, detections=log_of([Outcome.WAITING] * 6, [np.nan] * 6))
    run: RunResult = replace(blind.runs[0], params={"identity": {"unknown": {"policy": "associate"}}})
    (line,) = doubt_of_identities(with_run(blind, run))
    assert line.endswith("no landmark is mapped")


def test_landmarks_without_a_name_are_counted_and_scored_by_place() -> None:
    nameless = with_map(np.arange(4) + FIRST_ANONYMOUS_ID, [0.01, 0.02, 3.0, 0.01])
    sentence = "isam2 found 4 landmarks without a name (identity.unknown.policy); scored by place, as 1, 2 and 4."
    assert nameless_landmarks(nameless) == [sentence]
    assert sentence in printed(nameless, 200)
    assert sentence in render_report(nameless)
    table = landmark_table(nameless)
    assert table is not None
    assert [row[2].text != ABSENT for row in table.rows[:8:2]] == [True, True, False, True]
    scores = landmark_scores(nameless.runs[0].landmarks, nameless.sequence.true_landmarks)
    assert scores["landmarks.raw_m"].value == pytest.approx(np.sqrt((0.01**2 + 0.02**2 + 0.01**2) / 3))
    assert "3 landmarks matched by identity, 3 of them by place within 1 m" in scores["landmarks.raw_m"].protocol


def test_a_landmark_without_a_name_is_wrong_where_its_place_names_it_but_its_covariance_rules_it_out() -> None:
    nameless = with_map(np.arange(4) + FIRST_ANONYMOUS_ID, [0.01, 0.5, 3.0, 0.01])  # the third is nobody's
    (line,) = doubt_of_identities(nameless)
    assert "puts landmark 2 far outside its covariance" in line


def test_an_identity_that_is_merely_wrong_is_not_named_by_place() -> None:
    wrong = with_map(np.array([1, 2, 3, 9]), [0.0] * 4)
    assert nameless_landmarks(wrong) == []
    scores = landmark_scores(wrong.runs[0].landmarks, wrong.sequence.true_landmarks)
    assert "3 landmarks matched by identity (4 true" in scores["landmarks.raw_m"].protocol


def test_without_truth_they_are_only_counted() -> None:
    nameless = with_map(np.array([1, 2, 3, FIRST_ANONYMOUS_ID]), [0.0] * 4, has_truth=False)
    assert nameless_landmarks(nameless) == [
        "isam2 found 1 landmark without a name (identity.unknown.policy); identities from 3000000000 on are made up."
    ]
