"""Sonar model and prediction against numerical differences, draws and plain trigonometry."""

import math

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import block_diag

from sonar_graph.measurements import Floats
from sonar_graph.models import (
    Contradictions,
    locate,
    locate_jacobians,
    range_azimuth,
    range_azimuth_jacobians,
)
from sonar_graph.navigation import PreintegratedMotion
from sonar_graph.slam.prediction import PredictedView, Source, Tie, weigh
from sonar_graph.slam.smoother import JointCovariance
from sonar_graph.testing import check_derivative
from sonar_graph.testing.numerical import central_differences

from .made import POSES, polar, random_covariance, some_motion

angles = st.floats(-3.0, 3.0)
coordinates = st.floats(-20.0, 20.0)
poses = st.builds(
    lambda *v: gtsam.Pose3.Expmap(np.array(v)),
    angles,
    angles,
    angles,
    coordinates,
    coordinates,
    coordinates,
)
tiny = st.floats(-1e-7, 1e-7)
near_identity = st.builds(
    lambda *v: gtsam.Pose3.Expmap(np.array(v)), tiny, tiny, tiny, tiny, tiny, tiny
)
any_pose = poses | near_identity
views = st.tuples(
    st.floats(0.5, 15.0), st.floats(-math.pi, math.pi), st.floats(-1.2, 1.2)
)


@given(any_pose, any_pose, views)
def test_a_located_point_is_seen_there_with_numerical_derivatives(
    world_T_body, body_T_sonar, view
):
    world_T_sonar = world_T_body.compose(body_T_sonar)
    p = locate(world_T_sonar, *view)
    point, G_pose, G_view = locate_jacobians(world_T_body, body_T_sonar, *view)
    z, H_pose, H_landmark = range_azimuth_jacobians(world_T_body, body_T_sonar, p)

    def sonar(xi):
        return world_T_body.compose(gtsam.Pose3.Expmap(xi)).compose(body_T_sonar)

    assert_allclose(point, p)
    assert z[0] == pytest.approx(view[0], rel=1e-9)
    assert math.remainder(z[1] - view[1], 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    range_m, azimuth_rad = range_azimuth(world_T_sonar, p)
    assert range_m == pytest.approx(z[0], rel=1e-12)
    assert math.remainder(z[1] - azimuth_rad, 2 * math.pi) == pytest.approx(
        0.0, abs=1e-12
    )
    check_derivative(
        lambda xi: range_azimuth(sonar(xi), p), H_pose, np.zeros(6), angles=[1]
    )
    check_derivative(
        lambda q: range_azimuth(world_T_sonar, q), H_landmark, p, angles=[1]
    )
    check_derivative(lambda xi: locate(sonar(xi), *view), G_pose, np.zeros(6))
    check_derivative(lambda at: locate(world_T_sonar, *at), G_view, view)


BODY_T_SONAR = gtsam.Pose3(
    gtsam.Rot3.RzRyRx(0.1, 0.4, -0.3), np.array([0.4, 0.1, -0.2])
)
keyframes = pytest.mark.parametrize("keyframe", POSES.values(), ids=POSES)


def joint_of(cov: Floats, sizes: dict[int, int]) -> JointCovariance:
    starts = np.cumsum([0, *sizes.values()])[:-1].tolist()
    return JointCovariance(cov, dict(zip(sizes, starts, strict=True)))


def observed(world_T_body: gtsam.Pose3, point: Floats) -> Floats:
    return polar(world_T_body.compose(BODY_T_SONAR), point)


def ahead(
    keyframe: gtsam.Pose3, motion: PreintegratedMotion, azimuth_rad: float = 0.3
) -> Floats:
    q = 3.0 * np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.1])
    return keyframe.compose(motion.i_T_j).compose(BODY_T_SONAR).transformFrom(q)


def made(keyframe, motion, joint, bias: bool = True) -> PredictedView:
    return PredictedView(
        Tie(X(2), B(0) if bias else None, motion), keyframe, BODY_T_SONAR, joint
    )


def moved(
    keyframe: gtsam.Pose3,
    motion: PreintegratedMotion,
    xi: Floats,
    db: Floats,
    noise: Floats,
) -> gtsam.Pose3:
    """X Exp(xi) M Exp(D db + noise)."""
    wrong = gtsam.Pose3.Expmap(motion.D_bias @ db + noise)
    return keyframe.compose(gtsam.Pose3.Expmap(xi)).compose(motion.i_T_j).compose(wrong)


@keyframes
def test_blurred_noise_is_the_noise_and_the_variances_of_the_motion(keyframe):
    motion = some_motion(0, 0.01)
    point = ahead(keyframe, motion)
    view = made(keyframe, motion, joint_of(np.eye(6), {X(2): 6}))
    R = np.array([[4e-4, 3e-5], [3e-5, 8e-5]])
    still = np.zeros(17)
    H = central_differences(
        lambda noise: observed(
            moved(keyframe, motion, still[:6], still[6:], noise), point
        ),
        still[:6],
        angles=[1],
    )
    short = some_motion(9)
    expected = R + np.diag(np.diag(H @ short.covariance @ H.T))
    kept = R.copy()
    blurred = view.blurred(R[None], short, point[None])[0]
    assert_allclose(blurred, expected, rtol=1e-6, atol=1e-12)
    assert np.array_equal(R, kept)
    assert np.all(np.diag(expected) > 1.01 * np.diag(R))


def test_weighing_is_mahalanobis_of_the_wrapped_innovation():
    """Of detections whose expectations are correlated; a gain is the larger ratio of expected variance to noise."""
    rng = np.random.default_rng(0)
    m = 50
    z, expected = rng.uniform(-np.pi, np.pi, (2, m, 2))
    joint = random_covariance(2 * m, 0.1)
    noise = np.array([random_covariance(2, 0.05, k) for k in range(m)])
    found = weigh(z, expected, joint, noise)
    for k, (e, S, distance, gain) in enumerate(zip(*found, strict=True)):
        prior = joint[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        off = z[k] - expected[k]
        assert e == pytest.approx([off[0], math.remainder(off[1], 2 * math.pi)])
        assert np.array_equal(S, prior + noise[k])
        assert distance == pytest.approx(e @ np.linalg.solve(S, e), rel=1e-9)
        assert gain == pytest.approx(np.max(np.diag(prior) / np.diag(noise[k])))
    assert (np.abs(z - expected)[:, 1] > np.pi).any()


@keyframes
@pytest.mark.parametrize("bias", [True, False], ids=["bias", "no bias"])
@pytest.mark.parametrize(
    "seen_from", [X(1), X(2)], ids=["an earlier keyframe", "the same keyframe"]
)
def test_the_joint_covariance_is_that_of_all_that_is_uncertain(
    keyframe, bias, seen_from
):
    """``H P H'`` of keyframes, bias, landmark, motion and the located point's own noise, by differences.

    A landmark that is expected alone is as beside others.
    """
    motion = some_motion(3, 0.001)
    earlier = keyframe.compose(
        gtsam.Pose3(gtsam.Rot3.Yaw(0.2), np.array([-0.4, 0.2, 0.0]))
    )
    anchor = {X(1): earlier, X(2): keyframe}[seen_from]
    landmark = ahead(keyframe, motion)
    located = ahead(keyframe, motion, -0.4)
    body_p = anchor.transformTo(located)

    def point_from(xi: Floats) -> Floats:
        return anchor.compose(gtsam.Pose3.Expmap(xi)).transformFrom(body_p)

    def shown(change: Floats) -> Floats:
        of_anchor = change[:6] if seen_from == X(1) else change[6:12]
        db = bias * change[12:23]
        body = moved(keyframe, motion, change[6:12], db, change[26:32])
        seen = [
            observed(body, landmark + change[23:26]),
            observed(body, point_from(of_anchor) + change[32:]),
        ]
        return np.concatenate(seen)

    own = random_covariance(3, 0.001, 7)
    joint = joint_of(
        random_covariance(26, 0.001, 5), {X(1): 6, X(2): 6, B(0): 11, L(5): 3}
    )
    source = Source(
        seen_from, located, central_differences(point_from, np.zeros(6)), own
    )
    view = made(keyframe, motion, joint, bias)
    z, S = view.expect_jointly([L(5)], landmark[None], [source])
    alone = view.expect([L(5)], landmark[None])
    H = central_differences(shown, np.zeros(35), angles=[1, 3])  # (4, 35)
    P = block_diag(joint.matrix, motion.covariance, own)  # (35, 35)
    assert z.ravel() == pytest.approx(shown(np.zeros(35)))
    assert_allclose(S, H @ P @ H.T, rtol=1e-6, atol=1e-8 * np.abs(S).max())
    assert_allclose(alone[0], z[:1], rtol=1e-12)
    assert_allclose(alone[1][0], S[:2, :2], rtol=1e-9)


@pytest.mark.parametrize(
    ("sensor", "sigmas", "is_named", "is_doubtless"),
    [
        ("positions", 4.0, False, False),
        ("positions", 6.0, True, True),
        ("heading", 6.0, True, False),
        ("heading", 11.0, True, True),
    ],
)
def test_most_rows_far_from_the_estimate_leave_no_doubt(
    sensor, sigmas, is_named, is_doubtless
):
    """Twelve of twenty: fixes from 5 sigmas on, headings from 10."""
    found = Contradictions()
    found.judge(sensor, np.array([sigmas] * 12 + [1.0] * 8))
    messages = found.messages()
    assert bool(messages) == is_named
    assert ("beyond doubt" in "".join(messages)) == is_doubtless
