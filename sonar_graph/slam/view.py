"""What the graph expects a sonar frame to show, and how surely."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.measurements import Floats
from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion
from sonar_graph.navigation.kernels import compiled, skew
from sonar_graph.slam.models import project, wrap_angle


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
    landmarks
        Estimates of the landmarks that may be seen, shape (3,), by identity.
    covariance
        Of the keyframe, the bias and those landmarks together.
    """

    def __init__(
        self,
        pose_key: int,
        bias_key: int | None,
        world_T_keyframe: gtsam.Pose3,
        motion: PreintegratedMotion,
        body_T_sonar: gtsam.Pose3,
        landmarks: dict[int, Floats],
        covariance: gtsam.JointMarginal,
    ) -> None:
        keyframe_T_sonar = motion.i_T_j.compose(body_T_sonar)
        self.world_T_sonar = world_T_keyframe.compose(keyframe_T_sonar)
        """The sonar at the frame."""
        self.landmarks = landmarks
        self._pose_key, self._bias_key = pose_key, bias_key
        self._covariance = covariance
        self._world_R_sonar = np.ascontiguousarray(self.world_T_sonar.rotation().matrix())
        self._world_p_sonar = np.asarray(self.world_T_sonar.translation(), dtype=np.float64)
        self._to_keyframe = np.ascontiguousarray(keyframe_T_sonar.inverse().AdjointMap())
        self._to_body = np.ascontiguousarray(body_T_sonar.inverse().AdjointMap())
        self._motion = motion
        self._P = np.zeros((12, 12))
        self._P[:6, :6] = covariance.at(pose_key, pose_key)
        if bias_key is not None:
            self._P[6:9, 6:9] = covariance.at(bias_key, bias_key)
            self._P[:6, 6:9] = covariance.at(pose_key, bias_key)
            self._P[6:9, :6] = self._P[:6, 6:9].T

    def expect(self, landmark_id: int) -> tuple[Floats, Floats]:
        """Expected range and azimuth of a landmark, shape (2,), and their covariance, shape (2, 2)."""
        p = L(landmark_id)
        self._P[9:, 9:] = self._covariance.at(p, p)
        self._P[:6, 9:] = self._covariance.at(self._pose_key, p)
        if self._bias_key is not None:
            self._P[6:9, 9:] = self._covariance.at(self._bias_key, p)
        self._P[9:, :9] = self._P[:9, 9:].T
        return _expect(
            self.landmarks[landmark_id],
            self._world_R_sonar,
            self._world_p_sonar,
            self._to_keyframe,
            self._to_body,
            self._P,
            self._motion.D_bias,
            self._motion.covariance,
        )

    def blurred(self, cov: Floats, motion: PreintegratedMotion, point: Floats) -> Floats:
        """Noise of range and azimuth of a point of the world, (2, 2), with that of a motion that ends at the frame.

        The motion's part is added to each variance; that it correlates range and azimuth a little is left out.
        """
        return _blurred(cov, point, self._world_R_sonar, self._world_p_sonar, self._to_body, motion.covariance)


@compiled
def weigh(z: Floats, predicted: Floats, prior_cov: Floats, cov: Floats) -> tuple[Floats, Floats, float, float]:
    """Compare a detection with what was expected.

    Returns
    -------
    Innovation (2,), azimuth wrapped; its covariance S (2, 2); its squared Mahalanobis distance; and the larger of the
    expected variances relative to the noise, which says how much the detection has to tell.
    """
    innovation = np.array([z[0] - predicted[0], wrap_angle(z[1] - predicted[1])])
    S = prior_cov + cov
    a, b, c = S[0, 0], 0.5 * (S[0, 1] + S[1, 0]), S[1, 1]
    distance = (c * innovation[0] ** 2 - 2.0 * b * innovation[0] * innovation[1] + a * innovation[1] ** 2) / (
        a * c - b * b
    )
    return innovation, S, distance, max(prior_cov[0, 0] / cov[0, 0], prior_cov[1, 1] / cov[1, 1])


@compiled
def _by_sonar_pose(q: Floats, D_q: Floats) -> Floats:
    """Derivative of range and azimuth by the right perturbation of the sonar's pose, shape (2, 6)."""
    H = np.empty((2, 6))
    H[:, :3] = D_q @ skew(q)
    H[:, 3:] = -D_q
    return H


@compiled
def _expect(
    point: Floats,
    world_R_sonar: Floats,
    world_p_sonar: Floats,
    to_keyframe: Floats,
    to_body: Floats,
    P: Floats,
    D_bias: Floats,
    motion_cov: Floats,
) -> tuple[Floats, Floats]:
    sonar_R_world = np.ascontiguousarray(world_R_sonar.T)
    q = sonar_R_world @ (point - world_p_sonar)
    predicted, D_q = project(q)
    by_sonar = _by_sonar_pose(q, D_q)
    by_body = by_sonar @ to_body
    H = np.empty((2, 12))
    H[:, :6] = by_sonar @ to_keyframe
    H[:, 6:9] = by_body @ D_bias
    H[:, 9:] = D_q @ sonar_R_world
    return predicted, H @ P @ H.T + by_body @ motion_cov @ by_body.T


@compiled
def _blurred(
    cov: Floats, point: Floats, world_R_sonar: Floats, world_p_sonar: Floats, to_body: Floats, motion_cov: Floats
) -> Floats:
    q = np.ascontiguousarray(world_R_sonar.T) @ (point - world_p_sonar)
    _, D_q = project(q)
    by_body = _by_sonar_pose(q, D_q) @ to_body
    noise = by_body @ motion_cov @ by_body.T
    blurred = cov.copy()
    for k in range(2):
        blurred[k, k] += noise[k, k]
    return blurred
