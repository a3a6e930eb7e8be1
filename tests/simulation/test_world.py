"""Landmarks lie on the floor as the floor prior says."""

import numpy as np
from scipy import stats

from sonar_graph.simulation.detections import world_on_floor


def test_landmark_heights_obey_the_floor_prior():
    xy = np.arange(2000.0).reshape(1000, 2)
    world = world_on_floor(xy, -1.7, 0.03, np.random.default_rng(0))
    low, high = stats.chi2.interval(0.9999, 1000)
    assert low < np.sum(((world.landmark_positions[:, 2] + 1.7) / 0.03) ** 2) < high
    np.testing.assert_array_equal(world.landmark_positions[:, :2], xy)


def test_landmarks_are_numbered_from_one_and_truth_claims_no_covariance():
    landmarks = world_on_floor(np.zeros((3, 2)), -1.0, 0.01, np.random.default_rng(0)).landmark_map()
    assert landmarks.ids.tolist() == [1, 2, 3]
    assert np.isnan(landmarks.covariances).all()
