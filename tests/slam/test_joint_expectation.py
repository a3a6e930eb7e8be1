"""What several landmarks and located points are expected to show together: the covariance of many drawn worlds."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X

from sonar_graph.slam.models.prediction import Source

from .test_view import (
    KEYFRAMES,
    ahead,
    covariance,
    joint_of,
    keyframes,
    made,
    moved,
    observed,
    some_motion,
    some_view,
    with_bias,
)

DRAWS = 20_000
SMALL = 1e-3


@keyframes
@with_bias
def test_alone_each_landmark_is_expected_as_before(keyframe: gtsam.Pose3, bias: bool):
    view, _, landmarks, _ = some_view(keyframe, bias)
    keys, points = [L(5), L(6)], np.array([landmarks[5], landmarks[6]])
    predicted, cov = view.expect_jointly(keys, points, [])
    alone, covs = view.expect(keys, points)
    assert predicted == pytest.approx(alone, abs=1e-12)
    assert cov[:2, :2] == pytest.approx(covs[0], rel=1e-9)
    assert cov[2:, 2:] == pytest.approx(covs[1], rel=1e-9)


@pytest.mark.parametrize("seen_from", [X(1), X(2)], ids=["an earlier keyframe", "the same keyframe"])
def test_the_joint_covariance_is_that_of_many_draws(seen_from: int):
    """Keyframes, bias, landmark, motion and the located point's own noise, drawn with their correlations."""
    keyframe, motion = KEYFRAMES["random"], some_motion(3, SMALL)
    earlier = keyframe.compose(gtsam.Pose3(gtsam.Rot3.Yaw(0.2), np.array([-0.4, 0.2, 0.0])))
    landmark, located = ahead(keyframe, motion), ahead(keyframe, motion, -0.4)
    joint = joint_of(covariance(18, SMALL, 5), {X(1): 6, X(2): 6, B(0): 3, L(5): 3})
    anchor = {X(1): earlier, X(2): keyframe}[seen_from]
    body_p, own = anchor.transformTo(located), covariance(3, SMALL, 7)
    by_pose = np.column_stack([_shifted(anchor, axis, body_p) - located for axis in np.eye(6)]) / 1e-6
    source = Source(seen_from, located, by_pose, own)
    predicted, cov = made(keyframe, motion, joint).expect_jointly([L(5)], landmark[None], [source])
    rng = np.random.default_rng(1)
    drawn = rng.multivariate_normal(np.zeros(18), joint.matrix, DRAWS)
    noise = rng.multivariate_normal(np.zeros(6), motion.covariance, DRAWS)
    beside = rng.multivariate_normal(np.zeros(3), own, DRAWS)
    shown = []
    for x, e, d in zip(drawn, noise, beside, strict=True):
        body = moved(keyframe, motion, x[6:12], x[12:15], e)
        of_anchor = x[:6] if seen_from == X(1) else x[6:12]
        point = anchor.compose(gtsam.Pose3.Expmap(of_anchor)).transformFrom(body_p) + d
        shown.append(np.concatenate([observed(body, landmark + x[15:]), observed(body, point)]))
    sigma = np.sqrt(np.diag(cov))
    assert predicted.ravel() == pytest.approx(np.mean(shown, axis=0), abs=5 * sigma.max() / np.sqrt(DRAWS))
    assert np.cov(np.transpose(shown)) / np.outer(sigma, sigma) == pytest.approx(cov / np.outer(sigma, sigma), abs=0.04)
    assert np.abs(cov[:2, 2:] / np.outer(sigma[:2], sigma[2:])).max() > 0.2


def _shifted(pose: gtsam.Pose3, axis: np.ndarray, body_p: np.ndarray) -> np.ndarray:
    return np.asarray(pose.compose(gtsam.Pose3.Expmap(1e-6 * axis)).transformFrom(body_p))
