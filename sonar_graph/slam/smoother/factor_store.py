"""Variables and factors of the graph: kinds of keys, and groups of factors by handle.

A group of factors is used together or not at all, and each factor has a label for messages. One store serves window and
history: groups are new until the window has taken them up. A group leaves a bounded window with the oldest pose of its
factors, or bias where they have none; marginals contain its information then.
"""

from collections import defaultdict
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.models import BIASES, wrap_angle

POSE = ord("x")
LANDMARK = ord("l")
BIAS = ord("b")
TANGENT_SIZES = {POSE: 6, LANDMARK: 3, BIAS: BIASES}
NAMES = {POSE: "keyframe", LANDMARK: "landmark", BIAS: "gyro bias"}


class Known(Protocol):
    """Values by key, as `gtsam.Values` has them."""

    def exists(self, key: int, /) -> bool:
        """True for a variable that is known."""
        ...

    def atPose3(self, key: int, /) -> gtsam.Pose3:
        """Pose of a keyframe."""
        ...

    def atPoint3(self, key: int, /) -> Floats:
        """Position of a landmark."""
        ...

    def atVector(self, key: int, /) -> Floats:
        """Biases."""
        ...


def kind(key: int) -> int:
    """Character of a variable's symbol, which GTSAM keeps in the highest byte of its key."""
    return key >> 56


def tangent_size(key: int) -> int:
    """Dimension of a variable: 6 for a pose, 11 for the biases, 3 for a point."""
    return TANGENT_SIZES[
        key >> 56
    ]  # `kind`, without a call for each variable of each covariance


def is_pose(key: int) -> bool:
    """True for a keyframe."""
    return kind(key) == POSE


def is_landmark(key: int) -> bool:
    """True for a landmark."""
    return kind(key) == LANDMARK


def variable_name(key: int) -> str:
    """Kind and number of a variable, in words."""
    return f"{NAMES.get(kind(key), 'variable')} {gtsam.Symbol(key).index()}"


def picked(values: Known, keys: Iterable[int]) -> gtsam.Values:
    """Values of some variables: poses and vectors."""
    some = gtsam.Values()
    for key in keys:
        value = values.atPose3(key) if is_pose(key) else values.atVector(key)
        some.insert(key, value)
    return some


Factors = dict[str, gtsam.NonlinearFactor]
"""Factors by their labels in messages, such as "range"."""


@dataclass(frozen=True, eq=False, slots=True)
class Sightline:
    """One sighting of a landmark."""

    pose_key: int
    body_T_sonar: gtsam.Pose3
    """The sonar in the body frame of that keyframe."""
    z: Floats
    """Range (m) and azimuth (rad), shape (2,)."""

    def point(self, values: Known) -> Floats:
        """Point of the world where the landmark was measured, at elevation 0, shape (3,), m."""
        return sighted_from(values, [self]).points()[0]


class SonarViews(NamedTuple):
    """Poses of the sonar, and what it measured from there, n times."""

    R: Floats
    """world_R_sonar, shape (n, 3, 3)."""
    t: Floats
    """Position of the sonar, shape (n, 3), m."""
    z: Floats
    """Range (m) and azimuth (rad), shape (n, 2)."""

    def points(self) -> Floats:
        """Points of the world at range and azimuth and elevation 0, shape (n, 3), m."""
        range_m, azimuth_rad = self.z.T[:, :, None]  # (n, 1) each
        beam = np.cos(azimuth_rad) * self.R[:, :, 0]
        beam += np.sin(azimuth_rad) * self.R[:, :, 1]
        return self.t + range_m * beam

    def in_sonar(self, points: Floats) -> Floats:
        """Points of the world, shape (k, 3), in the axes of each sonar, shape (n, k, 3)."""
        from_sonar = points - self.t[:, None]
        return np.einsum("nji,nkj->nki", self.R, from_sonar)  # R^T (p - t)


def sighted_from(values: Known, lines: Sequence[Sightline]) -> SonarViews:
    """Sightings from where keyframes are estimated."""
    world_T_sonar = np.array(
        [
            values.atPose3(line.pose_key).compose(line.body_T_sonar).matrix()
            for line in lines
        ]
    ).reshape(-1, 4, 4)
    z = np.array([line.z for line in lines]).reshape(-1, 2)
    return SonarViews(world_T_sonar[:, :3, :3], world_T_sonar[:, :3, 3], z)


def missed(sighted: SonarViews, landmark: Floats) -> tuple[int, Floats]:
    """Number of sightings with a point of the world behind, and the distance by which each misses the point, (n,), m.

    Behind is a right angle or more off the measured azimuth.
    """
    range_m, azimuth_rad = sighted.z.T
    q = sighted.in_sonar(landmark[None])[:, 0]  # (n, 3)
    off_rad = wrap_angle(np.arctan2(q[:, 1], q[:, 0]) - azimuth_rad)
    off_m = np.sqrt(np.vecdot(q, q)) - range_m
    ahead_m = q[:, 0] * np.cos(azimuth_rad) + q[:, 1] * np.sin(azimuth_rad)
    return int(np.count_nonzero(ahead_m <= 0)), np.hypot(off_m, range_m * off_rad)


Sightlines = Mapping[int, Sequence[Sightline]]
"""Sightings that have become factors, by landmark's key."""


class FactorGroup:
    """Factors that are used together or not at all, such as those of one sighting.

    Parameters
    ----------
    factors
        The factors, or a function that makes them, which is called when they are first needed: to make the factors of
        many sightings in a row, at an update, is faster than to make those of each frame.
    seen
        Of a sighting: the key of its landmark, and where that was seen from.
    """

    __slots__ = ("_factors", "seen")

    def __init__(
        self,
        factors: Factors | Callable[[], Factors],
        seen: tuple[int, Sightline] | None = None,
    ) -> None:
        self._factors = factors
        self.seen = seen

    @property
    def factors(self) -> Factors:
        """Factors by their labels."""
        if not isinstance(self._factors, dict):
            self._factors = self._factors()
        return self._factors

    def __iter__(self) -> Iterator[gtsam.NonlinearFactor]:
        return iter(self.factors.values())


class FactorStore:
    """Groups of factors in the order in which they came, each with a handle that stays the same."""

    def __init__(self) -> None:
        self.new: dict[int, FactorGroup] = {}
        """Groups that the window has not taken up yet, by handle."""
        self._new_graph: gtsam.NonlinearFactorGraph | None = None
        self.gone: set[gtsam.NonlinearFactor] = set()
        """Factors that were taken out since the window took up the others."""
        self.groups: dict[int, FactorGroup] = {}
        """All groups by handle."""
        self._leaving_with: dict[int, list[int]] = defaultdict(list)
        self._lines: dict[int, dict[int, Sightline]] = defaultdict(dict)
        """Sightings of each landmark, by handle."""
        self._next = 0

    def add(self, group: FactorGroup) -> int:
        """Handle of a new group."""
        handle, self._next = self._next, self._next + 1
        self.groups[handle] = self.new[handle] = group
        self._new_graph = None
        if group.seen is not None:
            # most groups are sightings: do not search the keys of their factors
            landmark_key, line = group.seen
            self._lines[landmark_key][handle] = line
            lasting = [line.pose_key]
        else:
            keys = {key for factor in group for key in list(factor.keys())}
            poses = [key for key in keys if is_pose(key)]
            # landmarks never leave; biases outlive the poses that they hold for
            lasting = poses or [key for key in keys if not is_landmark(key)]
        # a factor on landmarks alone stays
        if lasting:
            self._leaving_with[min(lasting)].append(handle)
        return handle

    @property
    def new_graph(self) -> gtsam.NonlinearFactorGraph:
        """Factors of the new groups."""
        if self._new_graph is None:
            self._new_graph = graph_of(self.new.values())
        return self._new_graph

    def remove(self, handles: Iterable[int]) -> None:
        """Take groups out."""
        for handle in handles:
            self.new.pop(handle, None)
            group = self.groups.pop(handle)
            self.gone.update(group)
            self._drop_line(handle, group)
        self._new_graph = None

    def leave(self, keys: Iterable[int]) -> list[int]:
        """Drop the groups that leave with these variables; their handles."""
        left = []
        for key in keys:
            for handle in self._leaving_with.pop(key, ()):
                group = self.groups.pop(handle, None)
                if group is not None:
                    left.append(handle)
                    self._drop_line(handle, group)
        return left

    def _drop_line(self, handle: int, group: FactorGroup) -> None:
        if group.seen is not None:
            del self._lines[group.seen[0]][handle]

    def take_up(self) -> None:
        """The window has taken up what was new, and let go of what is gone."""
        self.new = {}
        self.gone = set()
        self._new_graph = None

    def graph(self, left_out: Container[int] = ()) -> gtsam.NonlinearFactorGraph:
        """All factors but those of some handles."""
        return graph_of(
            group for handle, group in self.groups.items() if handle not in left_out
        )

    def __iter__(self) -> Iterator[FactorGroup]:
        return iter(self.groups.values())

    def sighting_count(self, landmark_key: int) -> int:
        """Number of sightings of a landmark."""
        return len(self._lines[landmark_key])

    def sightlines_of(self, landmark_key: int) -> list[Sightline]:
        """Sightings of a landmark, in the order in which they came."""
        return list(self._lines[landmark_key].values())

    def sightlines(self) -> Sightlines:
        """All sightings, by landmark's key."""
        return {
            key: self.sightlines_of(key) for key, lines in self._lines.items() if lines
        }

    def newly_seen(self) -> set[int]:
        """Landmarks whose sightings the window has not taken up yet."""
        return {group.seen[0] for group in self.new.values() if group.seen is not None}


def factors_in(graph: Any) -> list[Any]:
    """Factors of a graph in which none is missing."""
    return [graph.at(i) for i in range(graph.size())]


def graph_of(groups: Iterable[FactorGroup]) -> gtsam.NonlinearFactorGraph:
    """Graph of the factors of some groups, in their order."""
    graph = gtsam.NonlinearFactorGraph()
    for group in groups:
        for factor in group.factors.values():
            graph.add(factor)
    return graph
