"""Landmarks that an estimate has put behind the sonar that saw them, and where to start them instead.

The azimuth factor is a camera along the measured azimuth (`sonar_graph.slam.factors`). It holds in the half space ahead
of the sonar; for a landmark behind, GTSAM's camera has a constant error and no gradient. A landmark gets there when a
large correction, such as a loop closed after much drift, turns the poses that saw it, and if all its sightings are of
that kind nothing pulls it back. Its sightings themselves say where it should be.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import gtsam
import numpy as np

from sonar_graph.measurements import Floats


@dataclass(frozen=True, eq=False)
class Sightline:
    """One sighting of a landmark, in the body frame of its keyframe."""

    pose_key: int
    origin: Floats
    """The sonar, shape (3,), m."""
    point: Floats
    """The landmark where it was measured, at elevation 0, shape (3,), m."""

    def is_behind(self, values: gtsam.Values, landmark: Floats) -> bool:
        """Whether a point of the world is more than a right angle off the measured azimuth."""
        seen = values.atPose3(self.pose_key).transformTo(landmark) - self.origin
        return bool(seen @ (self.point - self.origin) <= 0)


class Sightlines:
    """All sightings that have become factors, by landmark."""

    def __init__(self) -> None:
        self._lines: dict[int, list[Sightline]] = defaultdict(list)

    def add(self, landmark_key: int, pose_key: int, body_T_sonar: gtsam.Pose3, z: Floats) -> None:
        """A sighting: the sonar in the keyframe's body frame, range (m) and azimuth (rad)."""
        on_beam = z[0] * np.array([np.cos(z[1]), np.sin(z[1]), 0.0])
        line = Sightline(pose_key, body_T_sonar.translation(), body_T_sonar.transformFrom(on_beam))
        self._lines[landmark_key].append(line)

    def turned_away(self, values: gtsam.Values) -> list[int]:
        """Landmarks that lie behind the sonar in at least half of their sightings."""
        return [key for key, lines in self._lines.items() if 2 * _behind(lines, values, key) >= len(lines)]

    def placed_anew(self, values: gtsam.Values, landmark_keys: list[int]) -> gtsam.Values:
        """The values, with each of the landmarks at the median of where its sightings, from these poses, say it is."""
        placed = gtsam.Values(values)
        for key in landmark_keys:
            points = [values.atPose3(line.pose_key).transformFrom(line.point) for line in self._lines[key]]
            placed.update(key, np.median(points, axis=0))
        return placed


def _behind(lines: list[Sightline], values: gtsam.Values, landmark_key: int) -> int:
    landmark = values.atPoint3(landmark_key)
    return sum(line.is_behind(values, landmark) for line in lines)
