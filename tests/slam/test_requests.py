"""What cannot be meant is refused in one line, before anything is changed."""

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.errors import EstimatorError
from sonar_graph.slam.isam2 import Isam2
from sonar_graph.states import FIRST_ANONYMOUS_ID, Outcome

from .late_identities import assert_outcomes_account, run
from .rail import STEP_S, rail


@pytest.fixture(scope="module")
def ran() -> Isam2:
    return run(rail(8)[0], 1 / STEP_S)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"landmarks": 4}, r"landmarks: expected a list of integers, such as \[1, 2\], not 4"),
        ({"landmarks": ["4"]}, "landmarks: expected a list of integers"),
        ({"keyframes": 0.0}, "keyframes: expected a list of integers"),
        ({"keyframes": [0.5]}, "keyframes: expected a list of integers"),
        ({"stamps_ns": [1.5]}, "stamps_ns: expected a list of integers"),
        ({"landmarks": [4], "over": "whole"}, 'over is \'whole\'; expected "window" or "history"'),
    ],
)
def test_a_covariance_of_what_cannot_be_is_refused(ran: Isam2, asked: dict, said: str):
    with pytest.raises(EstimatorError, match=f"^isam2: {said}") as caught:
        ran.joint_covariance(**asked)
    assert "\n" not in str(caught.value)
    assert np.array_equal(ran.joint_covariance(landmarks=np.array([4])).matrix, ran.marginal(landmark=4))


def test_a_marginal_over_neither_is_refused(ran: Isam2):
    with pytest.raises(EstimatorError, match='expected "window" or "history"'):
        ran.marginal(landmark=4, over="whole")  # type: ignore[arg-type]


@pytest.mark.parametrize("params", [{"lag_s": 3}, {}, "robust"])
def test_settings_are_of_their_own_type(params: object):
    with pytest.raises(EstimatorError, match=r"^isam2: params: expected Isam2Params or None, not (dict|str)"):
        Isam2(rail()[0].calibration, params)


def test_names_of_landmarks_without_names_are_refused_where_these_begin():
    sequence, _ = rail(8)
    assert sequence.detections is not None
    ids = np.where(sequence.detections.candidate_ids == 4, FIRST_ANONYMOUS_ID, 7)
    named = replace(sequence, detections=replace(sequence.detections, candidate_ids=ids))
    with pytest.raises(EstimatorError, match=rf"has identity {FIRST_ANONYMOUS_ID}; with identity.unknown.policy = "):
        run(named, 1 / STEP_S, identity__unknown__policy="associate")
    assert FIRST_ANONYMOUS_ID in run(named, 1 / STEP_S).landmarks().ids


@pytest.mark.parametrize("policy", ["robust", "gate", "max-mixture", "gnc"])
@pytest.mark.parametrize("range_m", [1.1e5, 1e10, 1e200])
def test_a_range_beyond_any_sonar_is_refused_by_name_and_the_run_is_that_without_it(policy: str, range_m: float):
    sequence, _ = rail(8)
    seen = sequence.detections
    assert seen is not None
    far = seen.range_m.copy()
    far[3] = range_m
    estimator = run(replace(sequence, detections=replace(seen, range_m=far)), 1 / STEP_S, identity__policy=policy)
    assert assert_outcomes_account(estimator, sequence)[Outcome.UNSOUND] == 1
    without = replace(sequence, detections=seen.rows(np.arange(len(seen)) != 3))
    known = run(without, 1 / STEP_S, identity__policy=policy)
    assert np.array_equal(estimator.landmarks().positions, known.landmarks().positions)
    assert np.array_equal(estimator.trajectory().positions, known.trajectory().positions)
