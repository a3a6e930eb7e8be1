from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.evaluation.results import Score
from sonar_graph.evaluation.wording import display_value, finding, format_value, with_unit

from .synthetic import basin_comparison, only, with_failure, with_score

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
    assert display_value(score) == "90"
    assert with_unit(score) == "90°"


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
    assert "no ground truth" in finding(basin_comparison(60, truth=False))[-1]
    everything_failed = with_failure(only(scored(), "isam2"), "isam2", "no odometry")
    assert "nothing to compare" in finding(everything_failed)[-1]
    unscored = replace(scored(), scores={})
    assert finding(unscored) == ["No position error could be computed against the log's ground truth."]
