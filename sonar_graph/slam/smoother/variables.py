"""Keys of the graph's variables: their kind, dimension and name, and values of some of them."""

from collections.abc import Iterable
from typing import Protocol

import gtsam

from sonar_graph.measurements import Floats
from sonar_graph.models import BIASES

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
    return TANGENT_SIZES[kind(key)]


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
