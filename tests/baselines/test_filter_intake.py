import numpy as np
import pytest
from numpy.testing import assert_array_equal

from baselines.filter import DetectionIntake, check_rows, depth_since
from baselines.sonar_update import NEW, NO_SLOT, USED
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Depth, LandmarkDetections, Measurements
from sonar_graph.states import Outcome


def detections(stamps_ns, ids, probability=0.9):
    n = len(ids)
    return LandmarkDetections(
        np.array(stamps_ns),
        np.arange(1.0, n + 1),
        np.zeros(n),
        np.full((n, 2, 2), np.nan),
        np.array(ids)[:, None],
        np.full((n, 1), probability),
    )


def test_landmarks_get_places_in_the_order_of_their_first_use():
    intake = DetectionIntake(0.5)
    identified = intake.identify(detections([10, 20, 30], [7, 3, 7]), 0, 0)
    assert intake.columns(identified)[0].tolist() == [0, 1, 0]
    assert intake.slots == {7: 0, 3: 1}


def test_what_is_refused_gets_no_place_and_its_reason():
    """Before the first node, before what is done, and without an identity."""
    intake = DetectionIntake(0.5)
    early = intake.identify(detections([10, 20, 30], [1, 2, 3]), 15, 25)
    assert early.refusals == [Outcome.UNLOCATED, Outcome.LATE, None]
    doubtful = intake.identify(detections([40], [4], 0.3), 15, 25)
    assert doubtful.refusals == [Outcome.NO_IDENTITY]
    assert intake.columns(early)[0].tolist() == [NO_SLOT, NO_SLOT, 0]
    assert intake.columns(doubtful)[0].tolist() == [NO_SLOT]
    assert intake.slots == {3: 0}


def test_every_row_is_remembered_with_what_became_of_it():
    intake = DetectionIntake(0.5)
    identified = intake.identify(detections([10, 20, 30], [1, 2, 2]), 15, 0)
    innovations, covs = np.array([[np.nan] * 2] * 2 + [[0.1, 0.2]]), np.tile(np.eye(2), (3, 1, 1))
    intake.record(identified, (np.array([0, NEW, USED]), innovations, covs))
    log = intake.log()
    assert log.outcomes == [Outcome.UNLOCATED, Outcome.NEW, Outcome.USED]
    assert log.landmark_ids.tolist() == [1, 2, 2]
    assert_array_equal(log.innovations[2], [0.1, 0.2])
    assert np.isnan(log.innovations[0]).all()


def test_no_detections_are_no_outcomes():
    intake = DetectionIntake(0.5)
    identified = intake.identify(None, 0, 0)
    assert len(intake.columns(identified)[0]) == 0
    assert len(intake.log()) == 0


def test_rows_after_the_instant_are_an_error_that_names_them():
    depth = Depth(np.array([5, 11]), np.zeros(2), np.zeros(2))
    check_rows(Measurements(11, depth=depth))
    with pytest.raises(MeasurementError, match="Depth has a row at 11 ns, after end_ns = 10"):
        check_rows(Measurements(10, depth=depth))


def test_depth_from_an_instant_on():
    depth = Depth(np.array([5, 8, 11]), np.array([1.0, 2.0, 3.0]), np.ones(3))
    assert depth_since(depth, 8)[1].tolist() == [2.0, 3.0]
    assert depth_since(depth, 1)[1].tolist() == [1.0, 2.0, 3.0]
    assert len(depth_since(None, 0)[0]) == 0
