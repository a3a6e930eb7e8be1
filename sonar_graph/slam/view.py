"""What the graph expects a sonar frame to show, and how surely."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.measurements import Floats
from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion
from sonar_graph.navigation.kernels import compiled, skew
from sonar_graph.slam.models import project


class View:
    """A frame, seen from a keyframe whose estimate and covariance are known.

    With the motion M (covariance Q) from that keyframe X to the frame and the sonar mounted at T, the landmark p is
    expected at ``h(X M T, p)``. Its innovation has the covariance ``H P H' + H_M Q H_M' + R`` with P of keyframe and
    landmark together, H their derivatives, and H_M that by the body's pose at the frame.

    Parameters
    ----------
    pose_key, world_T_keyframe
        The keyframe and its estimate.
    motion
        From the keyframe to the frame.
    landmarks
        Estimates of the landmarks that may be seen, shape (3,), by identity.
    covariance
        Of the keyframe and those landmarks together.
    """

    def __init__(
        self,
        pose_key: int,
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
        self._pose_key = pose_key
        self._covariance = covariance
        self._world_R_sonar = np.ascontiguousarray(self.world_T_sonar.rotation().matrix())
        self._world_p_sonar = np.asarray(self.world_T_sonar.translation(), dtype=np.float64)
        self._to_keyframe = np.ascontiguousarray(keyframe_T_sonar.inverse().AdjointMap())
        self._to_body = np.ascontiguousarray(body_T_sonar.inverse().AdjointMap())
        self._motion_cov = motion.covariance

    def expect(self, landmark_id: int) -> tuple[Floats, Floats]:
        """Expected range and azimuth of a landmark, shape (2,), and their covariance, shape (2, 2), without R."""
        X, p = self._pose_key, L(landmark_id)
        P = np.empty((9, 9))
        P[:6, :6], P[6:, 6:] = self._covariance.at(X, X), self._covariance.at(p, p)
        P[:6, 6:] = self._covariance.at(X, p)
        P[6:, :6] = P[:6, 6:].T
        return _expect(
            self.landmarks[landmark_id],
            self._world_R_sonar,
            self._world_p_sonar,
            self._to_keyframe,
            self._to_body,
            P,
            self._motion_cov,
        )

    def noise_of(self, motion: PreintegratedMotion, point: Floats) -> Floats:
        """Variance of range and azimuth of a point of the world by the noise of a motion that ends here, shape (2,)."""
        return _motion_noise(point, self._world_R_sonar, self._world_p_sonar, self._to_body, motion.covariance)


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
    motion_cov: Floats,
) -> tuple[Floats, Floats]:
    q = world_R_sonar.T @ (point - world_p_sonar)
    predicted, D_q = project(q)
    by_sonar = _by_sonar_pose(q, D_q)
    H = np.empty((2, 9))
    H[:, :6] = by_sonar @ to_keyframe
    H[:, 6:] = D_q @ world_R_sonar.T
    by_body = by_sonar @ to_body
    return predicted, H @ P @ H.T + by_body @ motion_cov @ by_body.T


@compiled
def _motion_noise(
    point: Floats, world_R_sonar: Floats, world_p_sonar: Floats, to_body: Floats, motion_cov: Floats
) -> Floats:
    q = world_R_sonar.T @ (point - world_p_sonar)
    _, D_q = project(q)
    by_body = _by_sonar_pose(q, D_q) @ to_body
    return np.diag(by_body @ motion_cov @ by_body.T).copy()
