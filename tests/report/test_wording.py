from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.evaluation.digits import format_value
from sonar_graph.evaluation.results import Score
from sonar_graph.evaluation.scores import detection_scores
from sonar_graph.report.findings import NO_DETECTIONS, finding, lost_runs
from sonar_graph.states import DetectionLog, Outcome
from tests.synthetic import basin_comparison, only, with_failure, with_run, with_score

MINUS = "\N{MINUS SIGN}"
KEY = "causal.ate_se2_m"


def scored(**values: float):
    comparison = basin_comparison(60)
    for name, value in values.items():
        score = Score(value, "m", "By hand.")
        comparison = with_score(comparison, name.replace("_", "-"), KEY, score)
    return comparison


def causal_sentence(comparison) -> str:
    return next(sentence for sentence in finding(comparison) if sentence.startswith("Causal position error"))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.12345, "0.123"),
        (0.0688888, "0.0689"),
        (1.0, "1"),
        (9.999, "10.0"),
        (0.9996, "1.00"),
        (38.04, "38.0"),
        (1234.5, "1234"),
        (2_039_000.0, "2039000"),
        (0.00012, f"1.20e{MINUS}4"),
        (0.0, "0"),
        (-0.5, f"{MINUS}0.500"),
        (float("nan"), "\N{EN DASH}"),
        (float("inf"), "∞"),
        (float("-inf"), f"{MINUS}∞"),
    ],
)
def test_numbers_have_as_many_digits_as_mean_something(value, text):
    assert format_value(value) == text


@given(st.floats(1e-9, 1e9))
def test_a_shown_number_is_within_half_a_percent(value):
    assert float(format_value(value).replace(MINUS, "-")) == pytest.approx(value, rel=5.1e-3)


def test_radians_are_shown_as_degrees():
    score = Score(math.pi / 2, "rad", "By hand.")
    assert score.text() == "90"
    assert score.with_unit == "90°"


def test_finding_names_the_smaller_error_and_by_how_much():
    sentence = causal_sentence(scored(isam2=0.1, ekf_slam=0.25, dead_reckoning=2.0))
    assert "isam2 is 60 % below ekf-slam and 95 % below dead-reckoning" in sentence


def test_finding_follows_the_numbers_when_they_turn_round():
    sentence = causal_sentence(scored(isam2=0.25, ekf_slam=0.1, dead_reckoning=2.0))
    assert "ekf-slam is 60 % below isam2 and 95 % below dead-reckoning" in sentence


def test_finding_claims_nothing_from_a_small_difference():
    sentence = causal_sentence(only(scored(isam2=0.100, ekf_slam=0.103), "isam2", "ekf-slam"))
    assert "isam2 and ekf-slam differ by less than 5 %" in sentence
    assert "below" not in sentence


def test_equal_and_zero_errors_are_no_difference():
    sentence = causal_sentence(only(scored(isam2=0.0, ekf_slam=0.0), "isam2", "ekf-slam"))
    assert "differ by less than 5 %" in sentence


def test_failures_come_first():
    sentences = finding(with_failure(scored(), "ekf-slam", "no odometry."))
    assert sentences[0] == "ekf-slam failed: no odometry."
    assert "ekf-slam" not in " ".join(sentences[1:])


def test_finding_says_why_there_is_none():
    assert "no ground truth" in " ".join(finding(basin_comparison(60, truth=False)))
    everything_failed = with_failure(only(scored(), "isam2"), "isam2", "no odometry")
    assert "nothing to compare" in finding(everything_failed)[-1]
    unscored = replace(scored(), scores={})
    assert finding(unscored) == ["No position error could be computed against the log's ground truth."]


def test_consistency_follows_the_interval_and_without_one_a_factor_of_two():
    assert [Score(v, "1", "", better="inside").verdict for v in (0.49, 0.51, 1.99, 2.01)] == [
        "over-cautious",
        "",
        "",
        "over-confident",
    ]
    bounds = (0.9, 1.1)
    assert [Score(v, "1", "", bounds, "inside").verdict for v in (0.8, 1.0, 1.2)] == [
        "over-cautious",
        "consistent",
        "over-confident",
    ]
    assert Score(40.0, "m", "").verdict == ""


def test_finding_tells_the_nees_furthest_from_one():
    comparison = only(basin_comparison(60), "isam2")
    for position, yaw, told in (
        (1.5, 6.0, "isam2 6 (yaw, over-confident)"),
        (0.1, 6.0, "isam2 0.100 (position, over-cautious)"),
        (1.5, 1.2, "isam2 1.50 (position)"),
        (0.0, 6.0, "isam2 0 (position, over-cautious)"),
    ):
        judged = with_score(comparison, "isam2", "causal.nees_position", Score(position, "1", "", better="inside"))
        judged = with_score(judged, "isam2", "causal.nees_yaw", Score(yaw, "1", "", better="inside"))
        assert finding(judged)[-1].endswith(f": {told}.")


@pytest.mark.parametrize("truth", [True, False])
def test_finding_says_that_there_were_no_detections(truth):
    comparison = basin_comparison(60, truth=truth)
    assert NO_DETECTIONS not in finding(comparison)
    none = replace(comparison.sequence, detections=None)
    assert finding(replace(comparison, sequence=none))[0] == NO_DETECTIONS
    part = replace(none, notes={"log.part": "the beginning to 10.000 s"})
    said = "The part of the log that was chosen (the beginning to 10.000 s) has no landmark detections"
    assert finding(replace(comparison, sequence=part))[0].startswith(said)


@pytest.mark.parametrize(("gated", "is_told"), [(19, False), (21, True)])
def test_an_estimator_that_refuses_a_fifth_of_the_detections_is_called_lost(gated, is_told):
    outcomes = [Outcome.GATED] * gated + [Outcome.USED] * (100 - gated)
    log = DetectionLog(
        np.arange(100), np.ones(100, np.int64), np.full((100, 2), 0.1), np.tile(np.eye(2), (100, 1, 1)), outcomes
    )
    comparison = basin_comparison(60)
    runs = [replace(run, detections=log) if run.estimator == "ekf-slam" else run for run in comparison.runs]
    sentences = finding(replace(comparison, runs=runs))
    told = [sentence for sentence in sentences if sentence.startswith(f"ekf-slam refused {gated} of 100")]
    assert bool(told) == is_told
    assert detection_scores(log)["detections.nis"].verdict == ("" if is_told else "over-cautious")


def test_without_truth_innovations_tell_whether_covariances_hold():
    comparison = with_score(
        basin_comparison(60, truth=False), "isam2", "detections.nis", Score(6.9, "1", "By hand.", (0.9, 1.1), "inside")
    )
    assert "isam2 6.90 (over-confident)" in finding(comparison)[-1]


def test_a_gate_that_refuses_much_may_have_three_causes():
    comparison = only(basin_comparison(60), "isam2")
    run = comparison.runs[0]
    gated = replace(run.detections, outcomes=[Outcome.GATED] * 30 + [Outcome.USED] * 30)
    for policy, advice in (
        ("gate", 'identities are wrong (try identity.policy = "max-mixture"), or'),
        (None, "wrong, or"),
    ):
        params = {} if policy is None else {"identity": {"policy": policy}}
        (sentence,) = lost_runs(with_run(comparison, replace(run, detections=gated, params=params)))
        assert "refused 30 of 60 detections as outside its gate: it has lost its way, identities are wrong" in sentence
        assert advice in sentence
        assert "or noise is set far too small" in sentence
