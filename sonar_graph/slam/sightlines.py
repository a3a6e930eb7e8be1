"""Landmarks that an estimate has put behind the sonar that saw them, and where to start them instead.

The azimuth factor is a camera along the measured azimuth (`sonar_graph.slam.factors`). It holds in the half space ahead
of the sonar; for a landmark behind, GTSAM's camera has a constant error and no gradient. A landmark gets there when a
large correction, such as a loop closed after much drift, turns the poses that saw it, and if all its sightings are of
that kind nothing pulls it back. Its sightings themselves say where it should be.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.slam.batch import solve

MAX_PLACEMENTS = 3
"""Times that stuck landmarks are placed anew in one solution."""


@dataclass(frozen=True, eq=False, slots=True)
class Sightline:
    """One sighting of a landmark."""

    pose_key: int
    body_T_sonar: gtsam.Pose3
    """The sonar in the body frame of that keyframe."""
    z: Floats
    """Range (m) and azimuth (rad), shape (2,)."""

    def point(self, values: gtsam.Values) -> Floats:
        """Where in the world the landmark was measured, at elevation 0, shape (3,), m."""
        on_beam = self.z[0] * np.array([np.cos(self.z[1]), np.sin(self.z[1]), 0.0])
        return self._world_T_sonar(values).transformFrom(on_beam)

    def is_behind(self, values: gtsam.Values, landmark: Floats) -> bool:
        """Whether a point of the world is more than a right angle off the measured azimuth."""
        x, y, _ = self._world_T_sonar(values).transformTo(landmark)
        return bool(x * np.cos(self.z[1]) + y * np.sin(self.z[1]) <= 0)

    def _world_T_sonar(self, values: gtsam.Values) -> gtsam.Pose3:
        return values.atPose3(self.pose_key).compose(self.body_T_sonar)


class Sightlines:
    """All sightings that have become factors, by landmark."""

    def __init__(self) -> None:
        self._lines: dict[int, dict[Sightline, None]] = defaultdict(dict)

    def add(self, landmark_key: int, sightline: Sightline) -> None:
        """A sighting of a landmark."""
        self._lines[landmark_key][sightline] = None

    def remove(self, landmark_key: int, sightline: Sightline) -> None:
        """A sighting that is no longer one of this landmark."""
        del self._lines[landmark_key][sightline]
        if not self._lines[landmark_key]:
            del self._lines[landmark_key]

    def leave(self, pose_keys: set[int]) -> None:
        """Let go of sightings from some poses."""
        for key in list(self._lines):
            for line in [line for line in self._lines[key] if line.pose_key in pose_keys]:
                self.remove(key, line)

    def turned_away(self, values: gtsam.Values) -> list[int]:
        """Landmarks that lie behind the sonar in at least half of their sightings."""
        return [key for key, lines in self._lines.items() if 2 * _behind(lines, values, key) >= len(lines)]

    def placed_anew(self, values: gtsam.Values, landmark_keys: list[int]) -> gtsam.Values:
        """The values, with each of the landmarks at the median of where its sightings, from these poses, say it is."""
        placed = gtsam.Values(values)
        for key in landmark_keys:
            placed.update(key, np.median([line.point(values) for line in self._lines[key]], axis=0))
        return placed


def _behind(lines: Iterable[Sightline], values: gtsam.Values, landmark_key: int) -> int:
    landmark = values.atPoint3(landmark_key)
    return sum(line.is_behind(values, landmark) for line in lines)


def solve_in_sight(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values, sightlines: Sightlines) -> gtsam.Values:
    """Solve a graph; again while a landmark is stuck behind the sonar and its new start lowers the error."""
    values = solve(graph, initial)
    for _ in range(MAX_PLACEMENTS):
        stuck = sightlines.turned_away(values)
        if not stuck:
            break
        retried = solve(graph, sightlines.placed_anew(values, stuck))
        if graph.error(retried) >= graph.error(values):
            break
        values = retried
    return values
