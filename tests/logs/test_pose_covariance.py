from __future__ import annotations

import gtsam
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.logs.adapters.vehicle_messages import body_to_ros, ros_to_body


def random_covariances(seed: int, n: int = 3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, 6, 6))
    return root @ root.transpose(0, 2, 1), Rotation.random(n, rng).as_matrix()


@given(st.integers(0, 1000))
def test_ros_to_body_undoes_body_to_ros(seed: int) -> None:
    covariances, rotations = random_covariances(seed)
    np.testing.assert_allclose(ros_to_body(body_to_ros(covariances, rotations), rotations), covariances, atol=1e-12)


def test_ros_covariance_is_that_of_sampled_poses_in_fixed_axes() -> None:
    covariances, rotations = random_covariances(1, 1)
    pose = gtsam.Pose3(gtsam.Rot3(rotations[0]), np.array([1.0, 2, 3]))
    samples = np.random.default_rng(2).multivariate_normal(np.zeros(6), covariances[0] * 1e-8, 20_000)
    moved = [pose.compose(gtsam.Pose3.Expmap(sample)) for sample in samples]
    translations = np.array([m.translation() - pose.translation() for m in moved])
    turns = np.array([gtsam.Rot3.Logmap(m.rotation().compose(pose.rotation().inverse())) for m in moved])
    sampled = np.cov(np.hstack([translations, turns]).T) * 1e8
    np.testing.assert_allclose(sampled, body_to_ros(covariances, rotations)[0], atol=0.05 * np.abs(sampled).max())


def test_unknown_is_nan_here_and_zero_or_negative_there() -> None:
    _, rotations = random_covariances(0, 2)
    assert not body_to_ros(np.full((2, 6, 6), np.nan), rotations).any()
    theirs = np.zeros((2, 6, 6))
    theirs[1, 0, 0] = -1
    assert np.isnan(ros_to_body(theirs, rotations)).all()
