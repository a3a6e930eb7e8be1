"""Identities that are accepted, decided and weighed."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from sonar_graph.measurements import LandmarkDetections
from sonar_graph.slam.landmarks.association import LEAST_LANDMARKS, IdentityPosterior, RecogniserErrors, identify
from sonar_graph.slam.landmarks.sighting import Sighting
from sonar_graph.slam.landmarks.tracked import NO_LANDMARK, UNDECIDED, decide
from sonar_graph.slam.smoother.batch_solution import Sightline
from sonar_graph.states import DetectionJournal, Outcome


def detections(ids, probabilities):
    n = len(ids)
    return LandmarkDetections(
        np.arange(n), np.ones(n), np.zeros(n), np.full((n, 2, 2), np.nan), np.array(ids), np.array(probabilities)
    )


def test_the_most_probable_identity_is_accepted_from_the_threshold_on():
    found = identify(detections([[3, 7], [3, 7], [3, 7]], [[0.2, 0.8], [0.5, 0.1], [0.49, 0.48]]), 0.5)
    assert_array_equal(found.ids, [7, 3, 3])
    assert found.refusals == [None, None, Outcome.NO_IDENTITY]


def test_no_identity_is_refused_however_low_the_threshold():
    found = identify(detections([[-1, 2], [4, -1]], [[0.9, 0.1], [0.0, 0.0]]), 0.0)
    assert found.refusals == [Outcome.NO_IDENTITY, None]


def test_a_row_is_amended_in_its_place_and_loses_its_innovation():
    journal = DetectionJournal()
    rows = [journal.record(5, 2, Outcome.USED, np.ones(2), np.eye(2)), journal.record(6, 3, Outcome.WAITING)]
    assert rows == [0, 1]
    journal.amend(0, Outcome.MOVED, 7)
    journal.amend(1, Outcome.FORGOTTEN)
    log = journal.log()
    assert log.outcomes == [Outcome.MOVED, Outcome.FORGOTTEN]
    assert log.landmark_ids.tolist() == [7, 3]
    assert log.stamps_ns.tolist() == [5, 6]
    assert np.isnan(log.innovations).all()
    assert np.isnan(log.innovation_covs).all()


def test_of_one_identity_in_one_frame_the_most_probable_row_is_taken():
    """Of equals the first; the same identity in another frame is another matter."""
    rows = detections([[7], [7], [7], [7]], [[0.8], [0.9], [0.9], [0.8]])
    rows = LandmarkDetections(np.array([0, 0, 0, 1]), *list(vars(rows).values())[1:])
    assert identify(rows, 0.5).refusals == [Outcome.REPEATED, None, Outcome.REPEATED, None]


CHANCES = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=4).map(lambda p: [x / max(sum(p), 1.0) for x in p])


def statement(ids: list[int], probability: list[float]) -> IdentityPosterior:
    n = len(ids)
    rows = LandmarkDetections(
        np.zeros(1, dtype=int), np.ones(1), np.ones(1), np.ones((1, 2, 2)), np.array([ids]), np.array([probability])
    )
    assert n == len(probability)
    return IdentityPosterior.of(rows, 0)


@given(CHANCES, st.floats(0.001, 0.999), st.integers(LEAST_LANDMARKS, 60))
def test_weights_are_a_distribution_with_none_impossible(chances: list[float], q: float, count: int) -> None:
    ids = list(range(count))
    weights = np.exp(statement(ids[: len(chances)], chances).log_weights(ids, RecogniserErrors(wrong_id_probability=q)))
    assert weights.sum() == pytest.approx(1.0)
    assert weights.min() >= min(0.5 * q / count, 0.5 * q) * (1 - 1e-9)


def test_what_is_no_landmark_is_not_stated() -> None:
    assert statement([5, -1, 3], [0.0, 0.9, 0.1]).probability == {3: 0.1}
    assert statement([-1], [1.0]).favourite is None


@pytest.mark.parametrize(
    ("probability", "named"),
    [
        ([0.97, 0.01], 5),
        ([0.2, 0.2], None),
        ([0.4, 0.1], None),
        ([0.5, 0.5], None),
        ([0.1, 0.6], 3),
        ([0.0, 0.0], None),
    ],
)
def test_only_what_is_more_probable_than_all_else_is_named(probability: list[float], named: int | None) -> None:
    assert statement([5, 3][: len(probability)], probability).favourite == named


LEAST = 0.75


def frame(*beliefs: list[float]) -> LandmarkDetections:
    """Of landmarks 4 and 7."""
    n = len(beliefs)
    return LandmarkDetections(
        np.zeros(n, dtype=int),
        np.ones(n),
        np.zeros(n),
        np.full((n, 2, 2), np.nan),
        np.tile([4, 7], (n, 1)),
        np.array(beliefs),
    )


@pytest.mark.parametrize(
    ("belief", "decided"),
    [
        ([0.75, 0.0], 4),  # binary fractions: exactly as much as is asked
        ([0.0, 0.75], 7),
        ([0.5, 0.25], UNDECIDED),
        ([0.125, 0.125], NO_LANDMARK),
        ([0.125, 0.1875], UNDECIDED),
        ([np.nextafter(0.75, 0.0), 0.0], UNDECIDED),
        ([0.0, 0.0], NO_LANDMARK),
    ],
)
def test_what_reaches_the_least_probability_is_decided(belief: list[float], decided: int) -> None:
    assert decide(frame(belief, [1.0, 0.0]), LEAST) == [decided, 4]


def sighting(stamp_ns: int) -> Sighting:
    return Sighting(stamp_ns, 0, Sightline(X(0), gtsam.Pose3(), np.array([2.0, 0.0])), np.eye(2), None)
