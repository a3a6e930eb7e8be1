"""Prediction of a sonar frame from the graph: range and azimuth of landmarks, with covariances.

With the motion M from a keyframe X to the frame, its noise covariance Q, its derivative D by the gyro bias b, and the
sonar mounted at T, the landmark p is expected at ``h(X M T, p)``, h of `sonar_graph.models.sonar`. The
expectation has the covariance ``H P H' + H_M Q H_M'``: P of (X, b, p) together, ``H = [H_X, H_M D, H_p]``, H_M the
derivative by the body's pose at the frame.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.models import view_points, wrap_angle
from sonar_graph.navigation import PreintegratedMotion
from sonar_graph.slam.smoother import JointCovariance

IDENTITY = np.eye(2)


@dataclass(frozen=True, eq=False)
class ComparedRow:
    """Detections of a frame beside what was expected of them."""

    innovation: Floats
    """Measured minus expected range (m) and azimuth (rad, wrapped), shape (m, 2)."""
    S: Floats
    """Covariance of the innovation, shape (m, 2, 2)."""
    distance: Floats
    """Squared Mahalanobis distance of the innovation, shape (m,)."""
    gain: Floats
    """Larger of the expected variances relative to the noise, shape (m,): what a detection has to tell."""


@dataclass(frozen=True, eq=False)
class Source:
    """A point that is not in the graph, as located from a keyframe that is."""

    pose_key: int
    point: Floats
    """Point in the world, shape (3,), m."""
    by_pose: Floats
    """Its derivative by the keyframe, shape (3, 6)."""
    cov: Floats
    """Covariance of the point as seen from the keyframe, shape (3, 3), m²."""


class PredictedView:
    """Prediction of a frame from a keyframe whose estimate and covariance are known.

    Parameters
    ----------
    bias_key
        Gyro bias since the keyframe; None when none is estimated.
    motion
        Motion from the keyframe to the frame.
    covariance
        Joint covariance of the keyframe, the bias and the landmarks.
    """

    def __init__(
        self,
        pose_key: int,
        bias_key: int | None,
        world_T_keyframe: gtsam.Pose3,
        motion: PreintegratedMotion,
        body_T_sonar: gtsam.Pose3,
        covariance: JointCovariance,
    ) -> None:
        keyframe_T_sonar = motion.i_T_j.compose(body_T_sonar)
        self.world_T_sonar = world_T_keyframe.compose(keyframe_T_sonar)
        """Pose of the sonar at the frame."""
        self._world_T_keyframe = world_T_keyframe
        self.covariance = covariance
        self._motion = motion
        self._pose_row = covariance.rows[pose_key]
        self._by_body = body_T_sonar.inverse().AdjointMap()
        """Derivative of the sonar's pose by the body's, both at the frame, shape (6, 6)."""
        self._by_state = np.zeros((6, len(covariance.matrix)))
        """Derivative of the sonar's pose by all variables of the covariance, of which keyframe and bias count."""
        self._by_state[:, self._pose_row : self._pose_row + 6] = keyframe_T_sonar.inverse().AdjointMap()
        if bias_key is not None:
            row = covariance.rows[bias_key]
            self._by_state[:, row : row + len(motion.bias)] = self._by_body @ motion.D_bias

    def height_variance(self, point: Floats) -> float:
        """Variance of the world z of a point fixed to the body at the frame, shape (3,) in the world, m².

        By keyframe and motion; the gyro bias, which turns about the vertical most of all, is left out.
        """
        by_keyframe = _height_derivative(self._world_T_keyframe, point)
        by_body = _height_derivative(self._world_T_keyframe.compose(self._motion.i_T_j), point)
        r = self._pose_row
        P = self.covariance.matrix[r : r + 6, r : r + 6]
        return float(by_keyframe @ P @ by_keyframe + by_body @ self._motion.covariance @ by_body)

    def expect(self, keys: list[int], points: Floats) -> tuple[Floats, Floats]:
        """Expected range and azimuth of landmarks at points of the world, shape (m, 3).

        Returns
        -------
        Range (m) and azimuth (rad), shape (m, 2), and their covariances, shape (m, 2, 2).
        """
        predicted, joint = self.expect_jointly(keys, points, [])
        return predicted, np.einsum("kikj->kij", joint.reshape(len(keys), 2, len(keys), 2))

    def expect_jointly(self, keys: list[int], points: Floats, sources: list[Source]) -> tuple[Floats, Floats]:
        """Joint expectation of landmarks of the graph, shape (m, 3), and of points that are not in it.

        Returns
        -------
        Range (m) and azimuth (rad), shape (m + s, 2), and their joint covariance, shape (2 (m + s), 2 (m + s)).
        """
        everywhere = np.array([*points, *(source.point for source in sources)]).reshape(-1, 3) if sources else points
        predicted, by_sonar, by_point = view_points(self.world_T_sonar, everywhere)
        rows, P, n = self.covariance.rows, self.covariance.matrix, len(everywhere)
        H = by_sonar @ self._by_state
        for k, key in enumerate(keys):
            H[k, :, rows[key] : rows[key] + 3] = by_point[k]
        for k, source in enumerate(sources, start=len(keys)):
            H[k, :, rows[source.pose_key] : rows[source.pose_key] + 6] += by_point[k] @ source.by_pose
        J, J_M = H.reshape(2 * n, len(P)), (by_sonar @ self._by_body).reshape(2 * n, 6)
        joint = J @ P @ J.T + J_M @ self._motion.covariance @ J_M.T
        for k, source in enumerate(sources, start=len(keys)):
            joint[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += by_point[k] @ source.cov @ by_point[k].T
        return predicted, np.asarray(0.5 * (joint + joint.T))

    def compare(self, keys: list[int], points: Floats, z: Floats, cov: Floats) -> ComparedRow:
        """Detections z, shape (m, 2), with noise (m, 2, 2), of landmarks at points of the world, shape (m, 3)."""
        return weigh(z, *self.expect(keys, points), cov)

    def blurred(self, cov: Floats, motion: PreintegratedMotion, points: Floats) -> Floats:
        """Noise of range and azimuth of points of the world, (m, 2, 2), with that of a motion that ends at the frame.

        The motion's part is added to each variance; that it correlates range and azimuth a little is left out.
        """
        H_M = view_points(self.world_T_sonar, points).by_sonar @ self._by_body
        return cov + IDENTITY * (H_M @ motion.covariance * H_M).sum(axis=2)[:, None]


def weigh(z: Floats, expected: Floats, prior_cov: Floats, cov: Floats) -> ComparedRow:
    """Compare m detections and their noise with what was expected and its covariance."""
    innovation, S = z - expected, prior_cov + cov
    innovation[:, 1] = wrap_angle(innovation[:, 1])
    (r, alpha), (a, b, _, c) = innovation.T, S.reshape(-1, 4).T
    distance = (c * r**2 - 2.0 * b * r * alpha + a * alpha**2) / (a * c - b**2)
    gain = np.maximum(prior_cov[:, 0, 0] / cov[:, 0, 0], prior_cov[:, 1, 1] / cov[:, 1, 1])
    return ComparedRow(innovation, S, distance, gain)


def _height_derivative(world_T_body: gtsam.Pose3, point: Floats) -> Floats:
    """Derivative of the world z of a point of the body by the right perturbation of its pose, shape (6,)."""
    (x, y, z), (a, b, c) = world_T_body.transformTo(point).tolist(), world_T_body.rotation().matrix()[2].tolist()
    return np.array([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c])
