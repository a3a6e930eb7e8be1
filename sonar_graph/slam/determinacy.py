"""Whether factors determine variables, and in words what they leave open.

Linearised factors ``A x = b`` leave every direction v with ``A v = 0`` open. Columns are scaled to unit length; v is
open where its singular value is below `RANK_LIMIT` of the largest.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import gtsam
import numpy as np

from sonar_graph.measurements import Floats

LEAST_SAID = 2e-3
"""Standard deviations by metre or radian: the graph gives directions that it leaves to others sigmas of a thousand and
more (`sonar_graph.slam.factors`)."""
RANK_LIMIT = 1e-9
OPEN_SHARE = 1e-3
"""Share of a unit vector v from which on a variable takes part in it."""
AXES = {
    "x": ("roll", "pitch", "yaw", "forward", "left", "up"),
    "l": ("x", "y", "z"),
    "b": ("about x", "about y", "about z"),
}
KINDS = {
    "RangeFactorWithTransform3D": "range",
    "RangeFactor3D": "range",
    "GenericProjectionFactorCal3Fisheye": "azimuth",
    "BearingRangeFactor3D": "first direction",
    "PriorFactorPoint3": "prior",
    "PriorFactorPose3": "prior",
    "BetweenFactorPose3": "odometry",
    "BetweenFactorPoint3": "bias walk",
    "GPSFactorArm": "depth",
    "MagPoseFactorPose3": "gravity",
    "LinearContainerFactor": "marginal of what left the window",
}


@dataclass(frozen=True, eq=False)
class Open:
    """What factors leave open of a variable."""

    key: int
    directions: Floats
    """Of its tangent space, as rows of unit length, shape (k, n)."""

    def axes(self) -> str:
        """Each direction by the axis nearest to it, and how near that is where it is not the axis itself."""
        names = AXES[chr(gtsam.symbolChr(self.key))]
        return ", ".join(_named(row, names) for row in self.directions)


def _named(direction: Floats, names: tuple[str, ...]) -> str:
    nearest = int(np.argmax(np.abs(direction)))
    if abs(direction[nearest]) > 0.999:
        return names[nearest]
    return f"mostly {names[nearest]} ({', '.join(f'{share:.2f}' for share in direction)})"


def left_open(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keys: Iterable[int], least_said: float = 0.0
) -> list[Open]:
    """Which of some variables the factors leave open, given all others.

    Parameters
    ----------
    values
        Of all variables of the factors.
    keys
        The variables that are not taken as known.
    least_said
        Whitened rows of A shorter than this, such as `LEAST_SAID`, count as zero.

    Returns
    -------
    list[Open]
        Nothing where a derivative is no number (`not_finite`).
    """
    places, size = {}, 0
    for key in keys:
        places[key] = slice(size, size + _size(key))
        size += _size(key)
    if not size:
        return []
    A = np.vstack([np.zeros((1, size)), *(_rows(graph.at(i), values, places, least_said) for i in range(graph.size()))])
    if not np.isfinite(A).all():
        return []
    lengths = np.linalg.norm(A, axis=0)
    scale = 1.0 / np.where(lengths > 0, lengths, 1.0)
    _, s, V = np.linalg.svd(A * scale, full_matrices=True)
    rank = int(np.sum(s > RANK_LIMIT * max(s[0], 1e-300)))
    null = V[rank:] * scale
    null /= np.maximum(np.linalg.norm(null, axis=1, keepdims=True), 1e-300)
    return [Open(key, found) for key, place in places.items() if len(found := _basis(null[:, place]))]


def _rows(factor: gtsam.NonlinearFactor, values: gtsam.Values, places: dict[int, slice], least_said: float) -> Floats:
    """A factor's whitened rows in the columns of the variables that are not known."""
    factor_keys, size = list(factor.keys()), max(place.stop for place in places.values())
    if not any(key in places for key in factor_keys):
        return np.zeros((0, size))
    linear = factor.linearize(values)
    A, _ = linear.jacobian()
    rows, column = np.zeros((len(A), size)), 0
    for key in list(linear.keys()):
        if key in places:
            rows[:, places[key]] += A[:, column : column + _size(key)]
        column += _size(key)
    return rows[np.linalg.norm(A, axis=1) >= least_said]


def _basis(rows: Floats) -> Floats:
    """Unit vectors that span what is of any length in some rows."""
    if not len(rows):
        return rows
    _, s, V = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(V[s > OPEN_SHARE])


def not_finite(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> list[int]:
    """Places of the factors whose error or derivative is no number."""
    found = []
    for i in range(graph.size()):
        A, b = graph.at(i).linearize(values).jacobian()
        if not (np.isfinite(A).all() and np.isfinite(b).all()):
            found.append(i)
    return found


def variable_name(key: int) -> str:
    """In words."""
    kind = {"x": "keyframe", "l": "landmark", "b": "gyro bias"}.get(chr(gtsam.symbolChr(key)), "variable")
    return f"{kind} {gtsam.Symbol(key).index()}"


def factor_names(factors: Iterable[gtsam.NonlinearFactor]) -> str:
    """How many of which kind, in words."""
    counts = Counter(_kind(factor) for factor in factors)
    return ", ".join(f"{count} {kind}" for kind, count in counts.items()) or "no factor"


def _kind(factor: gtsam.NonlinearFactor) -> str:
    name = type(factor).__name__
    if name != "CustomFactor":
        return KINDS.get(name, name)
    kinds = [chr(gtsam.symbolChr(key)) for key in list(factor.keys())]
    return "odometry" if kinds[:2] == ["x", "x"] else "range and azimuth"


def _size(key: int) -> int:
    return 6 if gtsam.symbolChr(key) == ord("x") else 3
