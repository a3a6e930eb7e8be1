"""Whether a sighting that comes late to a landmark of the graph is where that landmark is expected."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion
from sonar_graph.slam.sighting import Sighting
from sonar_graph.slam.smoother import Smoother
from sonar_graph.slam.view import View

STILL = PreintegratedMotion(
    gtsam.Pose3(), np.zeros((6, 6)), np.zeros((6, 3)), np.zeros(3), 0.0, mean_specific_force=np.full(3, np.nan)
)
"""No motion between keyframe and sonar but what a sighting has in it already."""


class LateGate:
    """Chi-square gate on range and azimuth, from keyframes as they are estimated now.

    Parameters
    ----------
    smoother
        The graph.
    threshold
        Largest squared Mahalanobis distance; infinite: no gate.
    """

    def __init__(self, smoother: Smoother, threshold: float) -> None:
        self._smoother = smoother
        self._threshold = threshold

    def inside(self, sightings: list[Sighting], landmark_id: int) -> list[bool]:
        """Which sightings pass, one by one, as those do that come at once; all of a landmark not in the graph."""
        key, values = L(landmark_id), self._smoother.values
        if not np.isfinite(self._threshold) or not sightings or not values.exists(key):
            return [True] * len(sightings)
        joint = self._smoother.joint_covariance_of_any([key, *{sighting.line.pose_key for sighting in sightings}])
        points = values.atPoint3(key)[None]
        distances = []
        for sighting in sightings:
            line = sighting.line
            view = View(line.pose_key, None, values.atPose3(line.pose_key), STILL, line.body_T_sonar, joint)
            found = view.compare([key], points, line.z[None], sighting.noise[None])
            distances.append(float(found.distance[0]))
        return [distance <= self._threshold for distance in distances]
