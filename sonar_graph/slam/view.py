"""What the graph expects a sonar frame to show, and how surely."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.measurements import Floats
from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion
from sonar_graph.slam.models import range_azimuth_jacobians


@dataclass(frozen=True, eq=False)
class View:
    """A frame as the graph expects it, seen from the newest keyframe."""

    stamp_ns: int
    pose_key: int
    world_T_keyframe: gtsam.Pose3
    motion: PreintegratedMotion
    """From the keyframe to the frame."""
    body_T_sonar: gtsam.Pose3
    landmarks: dict[int, Floats]
    """Positions of the landmarks expected, shape (3,)."""
    covariance: gtsam.JointMarginal
    """Of the keyframe and those landmarks."""

    @property
    def keyframe_T_sonar(self) -> gtsam.Pose3:
        """The sonar at the frame, in the keyframe's body frame."""
        return self.motion.i_T_j.compose(self.body_T_sonar)

    @property
    def world_T_sonar(self) -> gtsam.Pose3:
        """The sonar at the frame."""
        return self.world_T_keyframe.compose(self.keyframe_T_sonar)

    def expect(self, landmark_id: int, cov: Floats) -> tuple[Floats, Floats, Floats]:
        """Expected range and azimuth (2,), the innovation's covariance (2, 2), and the noise in it (2, 2).

        Parameters
        ----------
        cov
            Noise of range and azimuth, shape (2, 2).
        """
        predicted, H, R = self.expect_at(self.landmarks[landmark_id], cov)
        X, p = self.pose_key, L(landmark_id)
        P = np.empty((9, 9))
        P[:6, :6], P[6:, 6:] = self.covariance.at(X, X), self.covariance.at(p, p)
        P[:6, 6:] = self.covariance.at(X, p)
        P[6:, :6] = P[:6, 6:].T
        return predicted, H @ P @ H.T + R, R

    def expect_at(self, point: Floats, cov: Floats) -> tuple[Floats, Floats, Floats]:
        """The same for any point: expected measurement (2,), derivative by keyframe and point (2, 9), noise (2, 2).

        The noise is the sonar's and, on each component, that of the motion between keyframe and frame.
        """
        predicted, by_keyframe, by_point = range_azimuth_jacobians(self.world_T_keyframe, self.keyframe_T_sonar, point)
        world_T_body = self.world_T_keyframe.compose(self.motion.i_T_j)
        _, by_motion, _ = range_azimuth_jacobians(world_T_body, self.body_T_sonar, point)
        R = cov + np.diag(np.diag(by_motion @ self.motion.covariance @ by_motion.T))
        return predicted, np.hstack([by_keyframe, by_point]), R
