import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from sonar_graph.errors import MeasurementError
from sonar_graph.states import Estimate, Trajectory

angles = st.floats(-3.1, 3.1)


def turning(n: int = 11, step_rad: float = 0.3) -> Trajectory:
    """Constant speed along x and constant yaw rate, a second a row."""
    yaw = step_rad * np.arange(n)
    quaternions = np.column_stack(
        [np.zeros(n), np.zeros(n), np.sin(yaw / 2), np.cos(yaw / 2)]
    )
    positions = np.column_stack(
        [np.arange(n, dtype=float), np.zeros(n), np.full(n, -1.0)]
    )
    return Trajectory.without_covariances(
        np.arange(n, dtype=np.int64) * 10**9, positions, quaternions
    )


@given(angles, st.floats(-1.5, 1.5), angles)
def test_trajectory_through_estimates_keeps_their_poses(roll, pitch, yaw):
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array([1.0, -2.0, 3.0]))
    covariance = np.diag(np.arange(1.0, 7.0))
    path = Trajectory.from_estimates([Estimate(5, pose, covariance)])
    np.testing.assert_allclose(
        path.rotations().as_matrix()[0], pose.rotation().matrix(), atol=1e-12
    )
    np.testing.assert_array_equal(path.positions[0], pose.translation())
    np.testing.assert_array_equal(path.covariances[0], covariance)


def test_interpolation_is_that_of_scipy():
    rng = np.random.default_rng(3)
    n = 50
    stamps_ns = np.cumsum(rng.integers(1, 10**9, n))
    positions = rng.normal(size=(n, 3))
    rotations = Rotation.random(n, rng=rng)
    path = Trajectory.without_covariances(stamps_ns, positions, rotations.as_quat())
    asked_ns = np.sort(rng.integers(stamps_ns[0], stamps_ns[-1], 200))
    there = path.at(asked_ns)
    by_scipy = Slerp(stamps_ns.astype(float), rotations)(asked_ns.astype(float))
    np.testing.assert_allclose(
        (there.rotations().inv() * by_scipy).magnitude(), 0, atol=1e-12
    )
    line = make_interp_spline(stamps_ns.astype(float), positions, k=1)
    np.testing.assert_allclose(
        there.positions, line(asked_ns.astype(float)), atol=1e-12
    )


def test_interpolation_keeps_nanoseconds_of_an_epoch():
    path = turning(2)
    epoch_ns = 1_700_000_000 * 10**9
    late = Trajectory.without_covariances(
        path.stamps_ns + epoch_ns, path.positions, path.quaternions_xyzw
    )
    moved_m = late.at(np.array([epoch_ns + 1])).positions[0, 0]
    assert moved_m == pytest.approx(1e-9, rel=1e-6)


@pytest.mark.parametrize("outside_ns", [-1, 10 * 10**9 + 1])
def test_instants_outside_are_refused(outside_ns):
    with pytest.raises(MeasurementError, match="outside"):
        turning().at(np.array([outside_ns]))


def test_stamps_must_increase_strictly():
    with pytest.raises(MeasurementError, match="increase"):
        Trajectory.without_covariances(
            np.array([1, 1]), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1))
        )
