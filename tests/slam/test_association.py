import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.stats import chi2

from sonar_graph.measurements import LandmarkDetections
from sonar_graph.slam.landmarks.association import gate_threshold, identify
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


@pytest.mark.parametrize("dof", [1, 2, 3])
def test_a_gate_lets_its_share_pass(dof):
    assert chi2.cdf(gate_threshold(0.95, dof), dof) == pytest.approx(0.95)
    assert gate_threshold(1.0, dof) == np.inf


def test_a_journal_keeps_every_row_in_order():
    journal = DetectionJournal()
    assert len(journal.log()) == 0
    assert journal.log().innovation_covs.shape == (0, 2, 2)
    journal.record(5, 2, Outcome.NEW)
    journal.record(9, 3, Outcome.USED, np.array([0.1, 0.2]), np.eye(2))
    log = journal.log()
    assert_array_equal(log.stamps_ns, [5, 9])
    assert_array_equal(log.landmark_ids, [2, 3])
    assert log.outcomes == [Outcome.NEW, Outcome.USED]
    assert_array_equal(log.innovations, [[np.nan, np.nan], [0.1, 0.2]])
    assert_array_equal(log.innovation_covs[1], np.eye(2))


def test_a_log_is_a_copy():
    journal = DetectionJournal()
    journal.record(5, 2, Outcome.NEW)
    before = journal.log()
    journal.record(6, 2, Outcome.USED, np.zeros(2), np.eye(2))
    assert len(before) == 1


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
