"""Prediction of a sonar frame from the graph: range and azimuth of landmarks, with covariances.

With the motion M from a keyframe X to the frame, its noise covariance Q, its derivative D by the gyro bias b, and the
sonar mounted at T, the landmark p is expected at ``h(X M T, p)``, h of `sonar_graph.slam.models.sonar_model`. The
expectation has the covariance ``H P H' + H_M Q H_M'``: P of (X, b, p) together, ``H = [H_X, H_M D, H_p]``, H_M the
derivative by the body's pose at the frame.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation import PreintegratedMotion
from sonar_graph.numerics import compiled, skew
from sonar_graph.slam.models.sonar_model import project, wrap_angle
from sonar_graph.slam.smoother import JointCovariance

ABSENT = -1
"""Row of a variable that is not estimated."""


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
        self._pose_row = covariance.rows[pose_key]
        self._bias_row = ABSENT if bias_key is None else covariance.rows[bias_key]
        self._world_T_sonar = self.world_T_sonar.matrix()
        self._to_keyframe = keyframe_T_sonar.inverse().AdjointMap()
        self._to_body = body_T_sonar.inverse().AdjointMap()
        self._motion = motion

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
        rows = np.array([self.covariance.rows[key] for key in keys], dtype=np.int64)
        return expected_view(
            points,
            rows,
            self._pose_row,
            self._bias_row,
            self.covariance.matrix,
            self._world_T_sonar,
            self._to_keyframe,
            self._to_body,
            self._motion.D_bias,
            self._motion.covariance,
        )

    def expect_jointly(self, keys: list[int], points: Floats, sources: list[Source]) -> tuple[Floats, Floats]:
        """Joint expectation of landmarks of the graph, shape (m, 3), and of points that are not in it.

        Returns
        -------
        Range (m) and azimuth (rad), shape (m + s, 2), and their joint covariance, shape (2 (m + s), 2 (m + s)).
        """
        everywhere = np.concatenate([points.reshape(-1, 3), *(source.point[None] for source in sources)])
        predicted, by_state, by_motion = _derivatives(
            everywhere, self._world_T_sonar, self._to_keyframe, self._to_body, self._motion.D_bias
        )
        H, own = np.zeros((len(everywhere), 2, len(self.covariance.matrix))), np.zeros((len(everywhere), 2, 2))
        H[:, :, self._pose_row : self._pose_row + 6] = by_state[:, :, :6]
        if self._bias_row != ABSENT:
            H[:, :, self._bias_row : self._bias_row + 3] = by_state[:, :, 6:9]
        for k, key in enumerate(keys):
            row = self.covariance.rows[key]
            H[k, :, row : row + 3] = by_state[k, :, 9:]
        for k, source in enumerate(sources, start=len(keys)):
            row, by_point = self.covariance.rows[source.pose_key], by_state[k, :, 9:]
            H[k, :, row : row + 6] += by_point @ source.by_pose
            own[k] = by_point @ source.cov @ by_point.T
        n = 2 * len(H)
        J, G = H.reshape(n, -1), by_motion.reshape(n, 6)
        joint = J @ self.covariance.matrix @ J.T + G @ self._motion.covariance @ G.T
        for k, cov in enumerate(own):
            joint[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += cov
        return predicted, np.asarray(0.5 * (joint + joint.T))

    def compare(self, keys: list[int], points: Floats, z: Floats, cov: Floats) -> ComparedRow:
        """Detections z, shape (m, 2), with noise (m, 2, 2), of landmarks at points of the world, shape (m, 3)."""
        return ComparedRow(*weigh(z, *self.expect(keys, points), cov))

    def blurred(self, cov: Floats, motion: PreintegratedMotion, points: Floats) -> Floats:
        """Noise of range and azimuth of points of the world, (m, 2, 2), with that of a motion that ends at the frame.

        The motion's part is added to each variance; that it correlates range and azimuth a little is left out.
        """
        return blurred_noise(cov, points, self._world_T_sonar, self._to_body, motion.covariance)


def _height_derivative(world_T_body: gtsam.Pose3, point: Floats) -> Floats:
    """Derivative of the world z of a point of the body by the right perturbation of its pose, shape (6,)."""
    up = world_T_body.rotation().matrix()[2]
    return np.concatenate([np.cross(world_T_body.transformTo(point), up), up])


@compiled
def weigh(z: Floats, predicted: Floats, prior_cov: Floats, cov: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Compare m detections with what was expected: the fields of `ComparedRow`."""
    S = prior_cov + cov
    innovation, distance, gain = np.empty(z.shape), np.empty(len(z)), np.empty(len(z))
    for k in range(len(z)):
        r, alpha = z[k, 0] - predicted[k, 0], wrap_angle(z[k, 1] - predicted[k, 1])
        innovation[k, 0], innovation[k, 1] = r, alpha
        a, b, c = S[k, 0, 0], 0.5 * (S[k, 0, 1] + S[k, 1, 0]), S[k, 1, 1]
        distance[k] = (c * r**2 - 2.0 * b * r * alpha + a * alpha**2) / (a * c - b * b)
        gain[k] = max(prior_cov[k, 0, 0] / cov[k, 0, 0], prior_cov[k, 1, 1] / cov[k, 1, 1])
    return innovation, S, distance, gain


@compiled
def _by_sonar_pose(q: Floats, D_q: Floats) -> Floats:
    """Derivative of range and azimuth by the right perturbation of the sonar's pose, shape (2, 6)."""
    H = np.empty((2, 6))
    H[:, :3] = D_q @ skew(q)
    H[:, 3:] = -D_q
    return H


@compiled
def expected_view(
    points: Floats,
    rows: Ints,
    pose_row: int,
    bias_row: int,
    joint: Floats,
    world_T_sonar: Floats,
    to_keyframe: Floats,
    to_body: Floats,
    D_bias: Floats,
    motion_cov: Floats,
) -> tuple[Floats, Floats]:
    """Range and azimuth of m points, shape (m, 2), and their covariances, shape (m, 2, 2)."""
    predicted, by_state, by_body = _derivatives(points, world_T_sonar, to_keyframe, to_body, D_bias)
    covs = np.empty((len(points), 2, 2))
    place = np.full(12, ABSENT)
    P = np.zeros((12, 12))
    for k in range(len(points)):
        for r in range(12):
            place[r] = pose_row + r if r < 6 else rows[k] + r - 9
            if 6 <= r < 9:
                place[r] = ABSENT if bias_row == ABSENT else bias_row + r - 6
        for r in range(12):
            for c in range(12):
                P[r, c] = 0.0 if place[r] == ABSENT or place[c] == ABSENT else joint[place[r], place[c]]
        covs[k] = by_state[k] @ P @ by_state[k].T + by_body[k] @ motion_cov @ by_body[k].T
    return predicted, covs


@compiled
def _derivatives(
    points: Floats, world_T_sonar: Floats, to_keyframe: Floats, to_body: Floats, D_bias: Floats
) -> tuple[Floats, Floats, Floats]:
    """Range and azimuth, (m, 2), with derivatives by keyframe, bias and point, (m, 2, 12), and by motion, (m, 2, 6)."""
    sonar_R_world = np.ascontiguousarray(world_T_sonar[:3, :3].T)
    predicted = np.empty((len(points), 2))
    by_state, by_motion = np.empty((len(points), 2, 12)), np.empty((len(points), 2, 6))
    for k in range(len(points)):
        q = sonar_R_world @ (points[k] - world_T_sonar[:3, 3])
        predicted[k], D_q = project(q)
        by_sonar = _by_sonar_pose(q, D_q)
        by_body = by_sonar @ to_body
        by_state[k, :, :6] = by_sonar @ to_keyframe
        by_state[k, :, 6:9] = by_body @ D_bias
        by_state[k, :, 9:] = D_q @ sonar_R_world
        by_motion[k] = by_body
    return predicted, by_state, by_motion


@compiled
def blurred_noise(cov: Floats, points: Floats, world_T_sonar: Floats, to_body: Floats, motion_cov: Floats) -> Floats:
    """Noise of range and azimuth, shape (m, 2, 2), with the variances of a motion's noise."""
    sonar_R_world = np.ascontiguousarray(world_T_sonar[:3, :3].T)
    blurred = cov.copy()
    for k in range(len(points)):
        q = sonar_R_world @ (points[k] - world_T_sonar[:3, 3])
        _, D_q = project(q)
        by_body = _by_sonar_pose(q, D_q) @ to_body
        noise = by_body @ motion_cov @ by_body.T
        for r in range(2):
            blurred[k, r, r] += noise[r, r]
    return blurred
