from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"


def pose(foreign: Any, position: tuple[float, ...], rotation: Rotation) -> dict[str, Any]:
    x, y, z, w = rotation.as_quat().tolist()
    return {"position": foreign.vector(*position), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def poses(foreign: Any, kind: str, rotation: Rotation, covariance: list[float] | None = None) -> list[dict[str, Any]]:
    inner = pose(foreign, (1, 2, 3), rotation)
    whole = {"pose": inner, "covariance": covariance or [0.0] * 36} if kind == POSE_WITH_COVARIANCE else inner
    return [{"header": foreign.header(i), "pose": whole} for i in range(3)]


@pytest.mark.parametrize("kind", [POSE, POSE_WITH_COVARIANCE])
def test_poses_are_truth_where_their_name_says_so(foreign: Any, read: Any, kind: str) -> None:
    turn = Rotation.from_euler("z", 1)
    sequence = read(foreign.imu(), foreign.dvl(), ("/ground_truth/pose", kind, poses(foreign, kind, turn)))
    np.testing.assert_array_equal(sequence.truth.positions, [[1, 2, 3]] * 3)
    np.testing.assert_allclose(sequence.truth.quaternions_xyzw, [turn.as_quat()] * 3)
    guess = read(foreign.imu(), foreign.dvl(), ("/pose", kind, poses(foreign, kind, turn)))
    assert guess.truth is None
    assert "/pose only if chosen" in guess.notes["log.truth"]


def test_north_east_down_becomes_east_north_up(foreign: Any, read: Any) -> None:
    # in NED and FRD: heading 30 degrees from north towards east, nose up by 10, right side down by 5
    recorded = Rotation.from_euler("ZYX", [30, 10, 5], degrees=True)
    messages = poses(foreign, POSE, recorded)
    toml = '[truth]\nworld = "ned"\nrotation = "frd"'
    truth = read(foreign.imu(), foreign.dvl(), ("/ground_truth/pose", POSE, messages), toml=toml).truth
    np.testing.assert_array_equal(truth.positions, [[2, 1, -3]] * 3)
    # the same attitude in ENU and FLU: 60 degrees from east towards north; pitch changes sign, roll does not
    expected = Rotation.from_euler("ZYX", [60, -10, 5], degrees=True)
    np.testing.assert_allclose(truth.rotations().as_matrix(), [expected.as_matrix()] * 3, atol=1e-12)


@pytest.mark.parametrize("meaning", ["variance", "standard deviation"])
def test_covariances_follow_the_axes_and_what_they_mean(foreign: Any, read: Any, meaning: str) -> None:
    deviations = np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])
    given = deviations**2 if meaning == "variance" else deviations
    messages = poses(foreign, POSE_WITH_COVARIANCE, Rotation.identity(), np.diag(given).ravel().tolist())
    toml = f'[truth]\nworld = "ned"\nrotation = "frd"\ncovariance_meaning = "{meaning}"'
    entry = ("/ground_truth/pose", POSE_WITH_COVARIANCE, messages)
    truth = read(foreign.imu(), foreign.dvl(), entry, toml=toml).truth
    # body x is north, y (left) west, z up: [rotation, translation] in the body, signs drop out of a diagonal
    np.testing.assert_allclose(truth.covariances, [np.diag(deviations[[3, 4, 5, 0, 1, 2]] ** 2)] * 3, atol=1e-15)


def test_a_body_that_the_driver_turns_is_turned_back(foreign: Any, read: Any) -> None:
    # the driver's x is our y: with it pointing along the world's x, our x points along the world's -y
    messages = poses(foreign, POSE, Rotation.identity())
    toml = "[truth]\nrotation = [0, 0, 90]"
    truth = read(foreign.imu(), foreign.dvl(), ("/ground_truth/pose", POSE, messages), toml=toml).truth
    np.testing.assert_allclose(truth.rotations().apply([1, 0, 0]), [[0, -1, 0]] * 3, atol=1e-12)
    np.testing.assert_array_equal(truth.positions, [[1, 2, 3]] * 3)
