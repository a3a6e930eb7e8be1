import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X
from hypothesis import given, settings
from hypothesis import strategies as st

from sonar_graph.measurements import Floats
from sonar_graph.navigation.preintegration.motion import PreintegratedMotion
from sonar_graph.slam.models.prediction import PredictedView, weigh
from sonar_graph.slam.smoother.batch_solution import JointCovariance

BODY_T_SONAR = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.4, -0.3), np.array([0.4, 0.1, -0.2]))
KEYFRAMES = {
    "random": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.4, 2.2), np.array([3.0, -2.0, 1.0])),
    "near identity": gtsam.Pose3(gtsam.Rot3.RzRyRx(1e-9, 0.0, -1e-9), np.array([1e-9, 0.0, 0.0])),
    "yaw at pi": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.1, np.pi), np.array([-1.0, 5.0, 0.3])),
}
keyframes = pytest.mark.parametrize("keyframe", KEYFRAMES.values(), ids=KEYFRAMES)
with_bias = pytest.mark.parametrize("bias", [True, False], ids=["bias", "no bias"])


def joint_of(cov: Floats, sizes: dict[int, int]) -> JointCovariance:
    starts = np.cumsum([0, *sizes.values()])[:-1].tolist()
    return JointCovariance(cov, dict(zip(sizes, starts, strict=True)))


def covariance(n: int, sigma: float, seed: int = 0) -> Floats:
    root = np.random.default_rng(seed).standard_normal((n, n))
    return sigma**2 * (root @ root.T / n + 0.1 * np.eye(n))


def some_motion(seed: int = 0, sigma: float = 0.01) -> PreintegratedMotion:
    rng = np.random.default_rng(seed)
    mean = gtsam.Pose3.Expmap(np.concatenate([0.3 * rng.standard_normal(3), 0.5 * rng.standard_normal(3)]))
    D_bias = rng.standard_normal((6, 3))
    return PreintegratedMotion(mean, covariance(6, sigma, seed + 1), D_bias, np.zeros(3), 1.0, np.zeros(3))


def observed(world_T_body: gtsam.Pose3, point: Floats) -> Floats:
    q = world_T_body.compose(BODY_T_SONAR).transformTo(point)
    return np.array([np.linalg.norm(q), np.arctan2(q[1], q[0])])


def ahead(keyframe: gtsam.Pose3, motion: PreintegratedMotion, azimuth_rad: float = 0.3) -> Floats:
    q = 3.0 * np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.1])
    return keyframe.compose(motion.i_T_j).compose(BODY_T_SONAR).transformFrom(q)


def made(keyframe, motion, joint, bias: bool = True) -> PredictedView:
    return PredictedView(X(2), B(0) if bias else None, keyframe, motion, BODY_T_SONAR, joint)


def expected_of(view: PredictedView, landmarks: dict[int, Floats], *ids: int) -> tuple[Floats, Floats]:
    return view.expect([L(i) for i in ids], np.array([landmarks[i] for i in ids]))


def some_view(keyframe: gtsam.Pose3, bias: bool, seed: int = 0, sigma: float = 0.02):
    """View of landmarks 5 and 6, and its parts."""
    motion = some_motion(seed, sigma / 2)
    landmarks = {5: ahead(keyframe, motion), 6: ahead(keyframe, motion, -0.6)}
    sizes = {X(2): 6, L(5): 3, L(6): 3} | ({B(0): 3} if bias else {})
    joint = joint_of(covariance(sum(sizes.values()), sigma, seed + 2), sizes)
    return made(keyframe, motion, joint, bias), motion, landmarks, joint


def moved(keyframe: gtsam.Pose3, motion: PreintegratedMotion, xi: Floats, db: Floats, noise: Floats) -> gtsam.Pose3:
    """X Exp(xi) M Exp(D db + noise)."""
    wrong = gtsam.Pose3.Expmap(motion.D_bias @ db + noise)
    return keyframe.compose(gtsam.Pose3.Expmap(xi)).compose(motion.i_T_j).compose(wrong)


def numerical(keyframe: gtsam.Pose3, motion: PreintegratedMotion, point: Floats) -> Floats:
    """Derivative of what is observed by (pose, landmark, bias, motion), by differences, shape (2, 18)."""

    def at(change: Floats) -> Floats:
        return observed(moved(keyframe, motion, change[:6], change[9:12], change[12:]), point + change[6:9])

    return np.column_stack([(at(1e-6 * axis) - at(-1e-6 * axis)) / 2e-6 for axis in np.eye(18)])


@keyframes
@with_bias
@pytest.mark.parametrize("seed", range(3))
def test_the_expected_covariance_is_that_of_the_whole_model(keyframe, bias, seed):
    """H P H' of pose, landmark and bias together, and the motion's noise, with derivatives by differences."""
    view, motion, landmarks, joint = some_view(keyframe, bias, seed)
    for landmark_id, point in landmarks.items():
        keys = [X(2), L(landmark_id), *([B(0)] if bias else [])]
        P = np.block([[joint.at(a, b) for b in keys] for a in keys])
        H = numerical(keyframe, motion, point)
        state = H[:, : len(P)]
        expected = state @ P @ state.T + H[:, 12:] @ motion.covariance @ H[:, 12:].T
        (z,), (S,) = expected_of(view, landmarks, landmark_id)
        assert z == pytest.approx(observed(keyframe.compose(motion.i_T_j), point))
        assert np.allclose(S, expected, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("left_out", ["pose with landmark", "pose with bias", "bias with landmark", "motion"])
def test_no_part_of_the_covariance_is_idle(left_out):
    """Negative control: each cross-covariance, and the motion's noise, changes what is expected."""
    view, motion, landmarks, joint = some_view(KEYFRAMES["random"], True)
    S = expected_of(view, landmarks, 5)[1][0]
    a, b = {"pose with landmark": (X(2), L(5)), "pose with bias": (X(2), B(0)), "bias with landmark": (B(0), L(5))}.get(
        left_out, (None, None)
    )
    if a is None:
        motion = PreintegratedMotion(motion.i_T_j, np.zeros((6, 6)), motion.D_bias, motion.bias, 1.0, np.zeros(3))
    else:
        joint.at(a, b)[:] = 0.0
        joint.at(b, a)[:] = 0.0
    without = expected_of(made(KEYFRAMES["random"], motion, joint), landmarks, 5)[1][0]
    assert np.abs(S - without).max() > 0.02 * np.abs(S).max()


@with_bias
def test_landmarks_asked_for_together_are_those_asked_for_one_by_one(bias):
    view, _, landmarks, _ = some_view(KEYFRAMES["random"], bias)
    z, S = expected_of(view, landmarks, 6, 5, 6)
    for row, landmark_id in enumerate((6, 5, 6)):
        (z_alone,), (S_alone,) = expected_of(view, landmarks, landmark_id)
        assert np.array_equal(z[row], z_alone)
        assert np.array_equal(S[row], S_alone)
    assert not np.allclose(S[0], S[1], rtol=1e-2)


def test_the_expected_covariance_is_that_of_many_draws():
    """Sample covariance of 20000 draws through the model itself; its relative standard error is 1 %."""
    keyframe, n = KEYFRAMES["random"], 20_000
    view, motion, landmarks, joint = some_view(keyframe, True, sigma=0.005)
    keys, rng = [X(2), L(5), B(0)], np.random.default_rng(3)
    P = np.block([[joint.at(a, b) for b in keys] for a in keys])
    states = rng.multivariate_normal(np.zeros(12), P, n)
    noises = rng.multivariate_normal(np.zeros(6), motion.covariance, n)
    seen = np.array(
        [
            observed(moved(keyframe, motion, s[:6], s[9:], e), landmarks[5] + s[6:9])
            for s, e in zip(states, noises, strict=True)
        ]
    )
    S = expected_of(view, landmarks, 5)[1][0]
    whitened = np.linalg.solve(np.linalg.cholesky(S), (seen - seen.mean(0)).T)
    assert np.cov(whitened) == pytest.approx(np.eye(2), abs=0.05)


@keyframes
def test_the_variance_of_a_height_is_that_of_keyframe_and_motion(keyframe):
    """By differences of the world z of a point that moves with the body."""
    view, motion, _, joint = some_view(keyframe, True)
    body = keyframe.compose(motion.i_T_j)
    q = np.array([1.5, -0.4, -0.8])

    def z(change: Floats) -> float:
        return moved(keyframe, motion, change[:6], np.zeros(3), change[6:]).transformFrom(q)[2]

    J = np.array([(z(1e-6 * axis) - z(-1e-6 * axis)) / 2e-6 for axis in np.eye(12)])
    expected = J[:6] @ joint.at(X(2), X(2)) @ J[:6] + J[6:] @ motion.covariance @ J[6:]
    assert view.height_variance(body.transformFrom(q)) == pytest.approx(expected, rel=1e-6)


@keyframes
def test_blurred_noise_is_the_noise_and_the_variances_of_the_motion(keyframe):
    view, motion, landmarks, _ = some_view(keyframe, True)
    R = np.array([[4e-4, 3e-5], [3e-5, 8e-5]])
    H = numerical(keyframe, motion, landmarks[5])[:, 12:]
    short = some_motion(9)
    expected = R + np.diag(np.diag(H @ short.covariance @ H.T))
    kept = R.copy()
    assert np.allclose(view.blurred(R[None], short, landmarks[5][None])[0], expected, rtol=1e-6, atol=1e-12)
    assert np.array_equal(R, kept)
    assert np.all(np.diag(expected) > 1.01 * np.diag(R))


@given(st.floats(-np.pi, np.pi), st.floats(-np.pi, np.pi), st.floats(-1, 1), st.floats(-0.9, 0.9), st.floats(-0.9, 0.9))
@settings(max_examples=50)
def test_weighing_is_mahalanobis_of_the_wrapped_innovation(measured, expected, range_off, by_prior, by_noise):
    def cov(range_sigma: float, azimuth_sigma: float, correlation: float) -> Floats:
        off = correlation * range_sigma * azimuth_sigma
        return np.array([[range_sigma**2, off], [off, azimuth_sigma**2]])

    prior, noise = cov(0.1, 0.03, by_prior), cov(0.02, 0.01, by_noise)
    (innovation,), (S,), (distance,), (gain,) = weigh(
        np.array([[3.0 + range_off, measured]]), np.array([[3.0, expected]]), prior[None], noise[None]
    )
    assert innovation[0] == pytest.approx(range_off)
    assert abs(innovation[1]) <= np.pi + 1e-12
    assert np.exp(1j * (innovation[1] - (measured - expected))) == pytest.approx(1.0)
    assert np.array_equal(S, prior + noise)
    assert distance == pytest.approx(innovation @ np.linalg.solve(S, innovation), rel=1e-9, abs=1e-12)
    assert gain == pytest.approx(25.0)


def test_the_gain_is_that_of_the_coordinate_that_has_more_to_tell():
    z, noise = np.array([3.0, 0.0]), np.diag([4.0, 9.0])
    for prior, gain in ((np.diag([8.0, 9.0]), 2.0), (np.diag([4.0, 36.0]), 4.0)):
        assert weigh(z[None], z[None], prior[None], noise[None])[3][0] == pytest.approx(gain)
