"""The factor that stands for a submap: its error, derivative and level frame."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X

from sonar_graph.numerics import Mat3, mat
from sonar_graph.slam.smoother.submap_factor import SubmapFactor, turn_from, yaw_from
from sonar_graph.testing import check_derivative

from .made import values_of

KEYS = [X(3), X(9), L(1), L(2), B(0)]
SIZES = {X(3): 6, X(9): 6, L(1): 3, L(2): 3, B(0): 11}


def some_values(seed: int, roll_rad: float = 0.0) -> gtsam.Values:
    rng, rolled = np.random.default_rng(seed), gtsam.Pose3(gtsam.Rot3.Rx(roll_rad), np.zeros(3))
    moved = {k: gtsam.Pose3.Expmap(rng.normal(size=6) * [0.4, 0.4, 2.0, 3, 3, 3]) for k in (3, 9)}
    poses = {f"X{k}": pose.compose(rolled) for k, pose in moved.items()}
    return values_of(**poses, L1=5 * rng.normal(size=3), L2=5 * rng.normal(size=3), B0=0.01 * rng.normal(size=11))


def rows(R: gtsam.Rot3) -> Mat3:
    """A rotation as compiled code takes it."""
    return mat(R.matrix())


def moved_by(values: gtsam.Values, step: dict[int, np.ndarray]) -> gtsam.Values:
    vector = values.zeroVectors()
    moved = gtsam.VectorValues()
    for key in SIZES:
        moved.insert(key, step.get(key, vector.at(key)))
    return values.retract(moved)


def random_summary(values: gtsam.Values) -> tuple[np.ndarray, np.ndarray, gtsam.CustomFactor]:
    rng = np.random.default_rng(7)
    A, b = rng.normal(size=(21, 29)), rng.normal(size=21)
    return A, b, SubmapFactor(KEYS, A, b, values).factor()


def test_where_it_was_made_a_summary_is_the_marginal():
    values = some_values(0)
    A, b, factor = random_summary(values)
    found_A, found_b = factor.linearize(values).jacobian()
    assert found_A == pytest.approx(A, abs=1e-12)
    assert found_b == pytest.approx(b, abs=1e-12)


@pytest.mark.parametrize("roll_rad", [0.0, 3.0])
@pytest.mark.parametrize("seed", range(4))
def test_elsewhere_its_derivative_is_that_of_its_error(seed, roll_rad):
    """Frame, poses, landmarks and biases, far from where it was made, and upside down; with an absolute part."""
    _, _, factor = random_summary(some_values(0, roll_rad))
    values = some_values(seed + 1, roll_rad)
    found, _ = factor.linearize(values).jacobian()
    columns = []
    for key, size in SIZES.items():
        for i in range(size):
            ends = [factor.unwhitenedError(moved_by(values, {key: h * np.eye(size)[i]})) for h in (1e-6, -1e-6)]
            columns.append((ends[0] - ends[1]) / 2e-6)
    assert found == pytest.approx(np.array(columns).T, abs=1e-7 * np.abs(found).max())


def test_a_turn_about_the_vertical_leaves_the_tilt_as_it_was():
    """Exactly, from wherever and however far; of the logarithm half of it turns with it."""
    before = gtsam.Rot3.RzRyRx(0.3, -0.2, 2.0)
    for tilt in (gtsam.Rot3(), gtsam.Rot3.RzRyRx(0.05, -0.08, 0.1)):
        after, up = before.compose(tilt), before.matrix()[2]
        for turn_rad in (-2.0, 0.4):
            wound = gtsam.Rot3.Rz(turn_rad).compose(after)
            expected = np.array(turn_from(rows(before), rows(after))[0]) + turn_rad * up
            assert turn_from(rows(before), rows(wound))[0] == pytest.approx(expected, abs=1e-12)
    off = gtsam.Rot3.Logmap(before.between(wound)) - gtsam.Rot3.Logmap(before.between(after)) - turn_rad * up
    assert np.abs(off).max() > 0.01


@pytest.mark.parametrize("roll_rad", [0.0, 1.5, 3.0, np.pi])
def test_yaw_turns_with_a_rotation_whatever_its_attitude(roll_rad):
    """Upside down as well, where that of the rotation alone is not defined."""
    start = gtsam.Rot3.RzRyRx(roll_rad, 0.1, 2.0)
    for tilt in (gtsam.Rot3(), gtsam.Rot3.RzRyRx(0.2, -0.3, 0.0)):
        R = tilt.compose(start)
        turned, derivative = yaw_from(rows(start), rows(gtsam.Rot3.Rz(2.5).compose(R)))
        assert turned - yaw_from(rows(start), rows(R))[0] == pytest.approx(2.5, abs=1e-12)
        check_derivative(
            lambda theta: np.array([yaw_from(rows(start), rows(R.retract(theta)))[0]]),  # noqa: B023
            np.array([yaw_from(rows(start), rows(R))[1]]),
            np.zeros(3),
        )
        assert np.linalg.norm(derivative) < 1.5


def test_its_error_does_not_depend_on_the_axes_of_the_body():
    """Nor does the frame, which goes by how well the yaw of each keyframe is known, about the world's vertical."""
    roll, (start, moved) = gtsam.Pose3(gtsam.Rot3.RzRyRx(1.2, 0.4, -0.3), np.zeros(3)), map(some_values, (0, 1))
    A, b, factor = random_summary(start)
    rolled_A, ends = A.copy(), []
    for i in (0, 6):
        rolled_A[:, i : i + 6] = A[:, i : i + 6] @ roll.AdjointMap()
    for values in (start, moved):
        rolled = gtsam.Values(values)
        for key in (X(3), X(9)):
            rolled.update(key, values.atPose3(key).compose(roll))
        ends.append(rolled)
    rolled_factor = SubmapFactor(KEYS, rolled_A, b, ends[0]).factor()
    assert rolled_factor.unwhitenedError(ends[1]) == pytest.approx(factor.unwhitenedError(moved), abs=1e-9)


def test_a_landmark_of_which_one_direction_is_known_does_not_carry_the_frame_along():
    """Nothing says where it lies, so that it may go far."""
    values, moved = (values_of(X3=gtsam.Pose3(), L1=np.array([3.0, y, 0.0])) for y in (1.0, 50.0))
    A = np.eye(7, 9)  # of the landmark x only
    _, motion = SubmapFactor([X(3), L(1)], A, np.zeros(7), values).deviation(moved)
    assert motion.equals(gtsam.Pose3(), 1e-12)


def test_without_a_pose_its_error_is_linear_in_the_world():
    start, moved = some_values(0), some_values(1)
    A, b = np.random.default_rng(7).normal(size=(9, 6)), np.ones(9)
    by = [moved.atPoint3(key) - start.atPoint3(key) for key in (L(1), L(2))]
    error = SubmapFactor([L(1), L(2)], A, b, start).factor().unwhitenedError(moved)
    assert error == pytest.approx(A @ np.concatenate(by) - b, abs=1e-12)
