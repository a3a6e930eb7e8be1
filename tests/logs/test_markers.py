from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.logs.mcap.writer import write_recording
from sonar_graph.logs.viewer_messages import GREY, UNKNOWN_DIAMETER_M, ellipsoids, landmark_markers, position_ellipsoids
from sonar_graph.states import LandmarkMap, Trajectory


@given(st.integers(0, 10_000))
def test_points_on_the_drawn_ellipsoid_have_the_same_mahalanobis_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(1, 3, 3)) + 2 * np.eye(3)
    covariances = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)
    diameters, quaternions = ellipsoids(covariances)
    sphere = rng.normal(size=(50, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    points = Rotation.from_quat(quaternions[0]).apply(sphere * diameters[0] / 2)
    squared = np.einsum("ni,ij,nj->n", points, np.linalg.inv(covariances[0]), points)
    np.testing.assert_allclose(squared, 7.814727903251179)  # chi-square table: 3 degrees of freedom, 0.95


def test_the_ellipsoid_holds_95_percent_of_samples() -> None:
    covariance = np.diag([1.0, 4.0, 0.25])
    diameters, quaternions = ellipsoids(covariance[None])
    samples = np.random.default_rng(0).multivariate_normal(np.zeros(3), covariance, 100_000)
    within = Rotation.from_quat(quaternions[0]).inv().apply(samples) / (diameters[0] / 2)
    assert abs(np.mean(np.sum(within**2, axis=1) < 1) - 0.95) < 0.003


def test_unknown_covariances_are_small_spheres_and_known_ones_beside_them_stay() -> None:
    diameters, _ = ellipsoids(np.array([np.full((3, 3), np.nan), np.eye(3)]))
    np.testing.assert_allclose(diameters[0], UNKNOWN_DIAMETER_M)
    np.testing.assert_allclose(diameters[1], 2 * np.sqrt(7.814727903251179))


def test_a_landmark_known_exactly_can_still_be_seen() -> None:
    assert (ellipsoids(np.zeros((1, 3, 3)))[0] > 0).all()


def test_namespaces_tell_ellipsoids_that_mean_something_from_those_that_do_not(
    tmp_path: Path, decoded: Callable[[Path], dict[str, list[Any]]]
) -> None:
    covariances = np.array([np.diag([0.01, 0.04, 0.09]), np.full((3, 3), np.nan)])
    landmarks = LandmarkMap(np.array([7, 2**40]), np.array([[1.0, 2, 3], [4, 5, 6]]), covariances)
    write_recording(tmp_path / "a.mcap", [landmark_markers("/landmarks", landmarks, 1, GREY, 0.5)], {})
    ((array,),) = decoded(tmp_path / "a.mcap").values()
    assert [(m.ns, m.text) for m in array.markers] == [
        ("ellipsoid_95_percent", ""),
        ("covariance_unknown", ""),
        ("identity", "7"),
        ("identity", "1099511627776"),
    ]
    assert [(m.pose.position.z, m.scale.z) for m in array.markers[2:]] == [(3.5, 0.5), (6.5, 0.5)]
    assert {(m.header.frame_id, m.action, m.lifetime.sec) for m in array.markers} == {("map", 0, 0)}


def test_a_drawn_ellipsoid_lies_as_its_covariance_does(
    tmp_path: Path, decoded: Callable[[Path], dict[str, list[Any]]]
) -> None:
    """A stick of 1 m standard deviation along (1, 1, 0), thin across; by hand, its longest axis lies there."""
    along, across = np.array([1.0, 1, 0]) / np.sqrt(2), np.array([1.0, -1, 0]) / np.sqrt(2)
    covariance = np.outer(along, along) + 0.04 * np.outer(across, across) + 0.01 * np.diag([0, 0, 1.0])
    landmarks = LandmarkMap(np.array([1]), np.zeros((1, 3)), covariance[None])
    write_recording(tmp_path / "a.mcap", [landmark_markers("/landmarks", landmarks, 1, GREY, 0.5)], {})
    ((array,),) = decoded(tmp_path / "a.mcap").values()
    marker = array.markers[0]
    diameters = np.array([marker.scale.x, marker.scale.y, marker.scale.z])
    q = marker.pose.orientation
    axes = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    longest = axes[:, np.argmax(diameters)]
    np.testing.assert_allclose(np.abs(longest @ along), 1)
    np.testing.assert_allclose(np.sort(diameters), 2 * 2.7954834829151074 * np.array([0.1, 0.2, 1.0]))


def test_the_ellipsoid_of_a_pose_holds_95_percent_of_sampled_positions(
    tmp_path: Path, decoded: Callable[[Path], dict[str, list[Any]]]
) -> None:
    """Its covariance is in the body's axes, the ellipsoid is drawn in those of the map."""
    rng = np.random.default_rng(5)
    root = rng.normal(size=(3, 6, 6))
    covariances = root @ root.transpose(0, 2, 1)
    covariances[1] = np.nan
    rotations = Rotation.random(3, rng)
    positions = rng.normal(size=(3, 3))
    trajectory = Trajectory(np.array([10, 20, 30]), positions, rotations.as_quat(), covariances)
    write_recording(tmp_path / "a.mcap", [position_ellipsoids("/pose", trajectory, GREY)], {})
    (arrays,) = decoded(tmp_path / "a.mcap").values()
    assert [array.markers[0].header.stamp.nanosec for array in arrays] == [10, 30]
    for array, row in zip(arrays, (0, 2), strict=True):
        marker, q = array.markers[0], array.markers[0].pose.orientation
        samples = rng.multivariate_normal(np.zeros(6), covariances[row], 50_000)[:, 3:]
        sampled = rotations[row].apply(samples) + positions[row]
        centre = np.array([marker.pose.position.x, marker.pose.position.y, marker.pose.position.z])
        radii = np.array([marker.scale.x, marker.scale.y, marker.scale.z]) / 2
        within = Rotation.from_quat([q.x, q.y, q.z, q.w]).inv().apply(sampled - centre) / radii
        assert abs(np.mean(np.sum(within**2, axis=1) < 1) - 0.95) < 0.005
