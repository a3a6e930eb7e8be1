"""The pose at an instant after a keyframe, and its covariance, by differences."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, X

from sonar_graph.measurements import Floats
from sonar_graph.navigation.preintegration.motion import PreintegratedMotion
from sonar_graph.slam.estimates import AnchoredPose
from sonar_graph.slam.smoother.batch_solution import JointCovariance

KEYFRAME = gtsam.Pose3(gtsam.Rot3.Ypr(0.4, -0.1, 0.05), np.array([3.0, -2.0, -1.0]))
BIAS = np.array([1e-3, -2e-3, 5e-3])
STEP = 1e-6


def covariance(size: int, scale: float, seed: int) -> Floats:
    A = np.random.default_rng(seed).standard_normal((size, size))
    return scale * (A @ A.T + 0.1 * np.eye(size))


def motion() -> PreintegratedMotion:
    return PreintegratedMotion(
        gtsam.Pose3(gtsam.Rot3.Ypr(0.5, 0.1, 0.0), np.array([2.0, 0.3, -0.1])),
        covariance(6, 1e-5, 1),
        0.5 * np.random.default_rng(2).standard_normal((6, 3)),
        np.zeros(3),
        2.0,
        np.full(3, np.nan),
    )


def values() -> gtsam.Values:
    found = gtsam.Values()
    found.insert(X(3), KEYFRAME)
    found.insert(B(0), BIAS)
    return found


@pytest.mark.parametrize("bias_key", [None, B(0)], ids=["no bias", "bias"])
def test_the_pose_and_its_covariance_are_those_of_keyframe_bias_and_motion(bias_key: int | None) -> None:
    """``J P J'`` with J by differences, P joint of keyframe and bias: what both share counts."""
    moved, P = motion(), covariance(9, 1e-4, 3)
    joint = JointCovariance(P, {B(0): 6, X(3): 0})
    found = AnchoredPose(7, 3, bias_key, moved).carried_on(values(), joint)

    def carried(state: Floats) -> gtsam.Pose3:
        pose = KEYFRAME.compose(gtsam.Pose3.Expmap(state[:6]))
        if bias_key is None:
            return pose.compose(moved.i_T_j)
        return pose.compose(moved.i_T_j).compose(gtsam.Pose3.Expmap(moved.D_bias @ (BIAS + state[6:])))

    mean = carried(np.zeros(9))
    assert found.world_T_body.equals(mean, 1e-9)
    columns = [gtsam.Pose3.Logmap(carried(-STEP * e).between(carried(STEP * e))) / (2 * STEP) for e in np.eye(9)]
    J = np.column_stack(columns)
    expected = J @ P @ J.T + moved.covariance
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-2, atol=1e-2 * np.abs(expected).max())
    np.testing.assert_array_equal(found.covariance, found.covariance.T)
    if bias_key is not None:
        apart = np.kron(np.eye(3), np.ones((3, 3)))
        apart[:6, :6] = 1.0
        assert np.abs(J @ (P * (1.0 - apart)) @ J.T).max() > 0.05 * np.abs(expected).max()
