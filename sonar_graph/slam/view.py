"""What the graph expects a sonar frame to show, and how surely."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion
from sonar_graph.navigation.kernels import compiled, skew
from sonar_graph.slam.joint_covariance import JointCovariance
from sonar_graph.slam.models import project, wrap_angle

ABSENT = -1
"""Row of a variable that is not estimated."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Detections of a frame beside what was expected of them."""

    innovation: Floats
    """Measured minus expected range (m) and azimuth (rad, wrapped), shape (m, 2)."""
    S: Floats
    """Covariance of the innovation, shape (m, 2, 2)."""
    distance: Floats
    """Squared Mahalanobis distance of the innovation, shape (m,)."""
    gain: Floats
    """The larger of the expected variances relative to the noise, shape (m,): how much a detection has to tell."""


class View:
    """A frame, seen from a keyframe whose estimate and covariance are known.

    With the motion M from that keyframe X to the frame, its noise covariance Q and its derivative D by the gyro bias b,
    and the sonar mounted at T, the landmark p is expected at ``h(X M T, p)``. What is expected has the covariance
    ``H P H' + H_M Q H_M'``: P of (X, b, p) together, ``H = [H_X, H_M D, H_p]``, H_M the derivative by the body's pose
    at the frame.

    Parameters
    ----------
    pose_key, bias_key
        The keyframe, and the gyro bias since then; None when there is none to estimate.
    world_T_keyframe
        The keyframe's estimate.
    motion
        From the keyframe to the frame.
    body_T_sonar
        The sonar's mounting.
    covariance
        Of the keyframe, the bias and the landmarks that are compared, together.
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
        """The sonar at the frame."""
        self._world_T_keyframe = world_T_keyframe
        self._covariance = covariance
        self._pose_row = covariance.rows[pose_key]
        self._bias_row = ABSENT if bias_key is None else covariance.rows[bias_key]
        self._world_T_sonar = self.world_T_sonar.matrix()
        self._to_keyframe = keyframe_T_sonar.inverse().AdjointMap()
        self._to_body = body_T_sonar.inverse().AdjointMap()
        self._motion = motion

    def height_variance(self, point: Floats) -> float:
        """Variance of the world z of a point fixed to the body at the frame, shape (3,) in the world, m².

        Of keyframe and motion; that of the gyro bias, which turns about the vertical most of all, is left out.
        """
        by_keyframe = _height_derivative(self._world_T_keyframe, point)
        by_body = _height_derivative(self._world_T_keyframe.compose(self._motion.i_T_j), point)
        r = self._pose_row
        P = self._covariance.matrix[r : r + 6, r : r + 6]
        return float(by_keyframe @ P @ by_keyframe + by_body @ self._motion.covariance @ by_body)

    def expect(self, keys: list[int], points: Floats) -> tuple[Floats, Floats]:
        """What landmarks at points of the world, shape (m, 3), are expected to show.

        Returns
        -------
        Range (m) and azimuth (rad), shape (m, 2), and their covariances, shape (m, 2, 2).
        """
        rows = np.array([self._covariance.rows[key] for key in keys], dtype=np.int64)
        return _expect(
            points,
            rows,
            self._pose_row,
            self._bias_row,
            self._covariance.matrix,
            self._world_T_sonar,
            self._to_keyframe,
            self._to_body,
            self._motion.D_bias,
            self._motion.covariance,
        )

    def compare(self, keys: list[int], points: Floats, z: Floats, cov: Floats) -> Comparison:
        """Detections z, shape (m, 2), with noise (m, 2, 2), of landmarks at points of the world, shape (m, 3)."""
        return Comparison(*weigh(z, *self.expect(keys, points), cov))

    def blurred(self, cov: Floats, motion: PreintegratedMotion, points: Floats) -> Floats:
        """Noise of range and azimuth of points of the world, (m, 2, 2), with that of a motion that ends at the frame.

        The motion's part is added to each variance; that it correlates range and azimuth a little is left out.
        """
        return _blurred(cov, points, self._world_T_sonar, self._to_body, motion.covariance)


def _height_derivative(world_T_body: gtsam.Pose3, point: Floats) -> Floats:
    """Derivative of the world z of a point of the body by the right perturbation of its pose, shape (6,)."""
    up = world_T_body.rotation().matrix()[2]
    return np.concatenate([np.cross(world_T_body.transformTo(point), up), up])


@compiled
def weigh(z: Floats, predicted: Floats, prior_cov: Floats, cov: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Compare m detections with what was expected: the fields of `Comparison`."""
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
def _expect(
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
    sonar_R_world = np.ascontiguousarray(world_T_sonar[:3, :3].T)
    predicted, covs = np.empty((len(points), 2)), np.empty((len(points), 2, 2))
    place = np.full(12, ABSENT)
    H, P = np.zeros((2, 12)), np.zeros((12, 12))
    for k in range(len(points)):
        q = sonar_R_world @ (points[k] - world_T_sonar[:3, 3])
        predicted[k], D_q = project(q)
        by_sonar = _by_sonar_pose(q, D_q)
        by_body = by_sonar @ to_body
        H[:, :6] = by_sonar @ to_keyframe
        H[:, 6:9] = by_body @ D_bias
        H[:, 9:] = D_q @ sonar_R_world
        for r in range(12):
            place[r] = pose_row + r if r < 6 else rows[k] + r - 9
            if 6 <= r < 9:
                place[r] = ABSENT if bias_row == ABSENT else bias_row + r - 6
        for r in range(12):
            for c in range(12):
                P[r, c] = 0.0 if place[r] == ABSENT or place[c] == ABSENT else joint[place[r], place[c]]
        covs[k] = H @ P @ H.T + by_body @ motion_cov @ by_body.T
    return predicted, covs


@compiled
def _blurred(cov: Floats, points: Floats, world_T_sonar: Floats, to_body: Floats, motion_cov: Floats) -> Floats:
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
