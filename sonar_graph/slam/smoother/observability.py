"""Whether factors determine variables, and in words what they leave open.

Linearised factors ``A x = b`` leave every direction v with ``A v = 0`` open. Columns are scaled to unit length; v is
open where its singular value is below `RANK_LIMIT` of the largest.

Which new factors a smoother has to do without, and why, in words.

A landmark whose new factors leave a direction open cannot be solved for; a factor whose error is no number spoils all
variables, and marginals for good. Such factors are withheld, with the landmarks and biases that then have none, and the
rest goes on as if they had never come. A keyframe cannot be withheld, since later ones hang on it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import gtsam
import numpy as np

from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.factor_store import Pending
from sonar_graph.slam.smoother.fixed_lag import keys_of

LEAST_SAID = 2e-3
"""Standard deviations by metre or radian: the graph gives directions that it leaves to others sigmas of a thousand and
more (`sonar_graph.slam.models.factors`)."""
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


MISSING = {
    "l": "an elevation, a floor prior or a view from elsewhere is missing",
    "b": "a prior or a walk from another bias is missing",
    "x": "odometry from another keyframe or a prior is missing",
}


@dataclass(frozen=True, eq=False)
class Withheld:
    """Factors that are not used, with variables that are not estimated."""

    handles: set[int]
    keys: set[int]
    message: str
    """The variable, its factors, and what is missing."""


def spoilt(pending: Pending, values: gtsam.Values, times_s: dict[int, float]) -> list[Withheld]:
    """New factors whose error is no number.

    Parameters
    ----------
    values, times_s
        See `undetermined`.
    """
    if np.isfinite(pending.graph.error(values)):
        return []
    return [_no_number(pending.handles[i], pending, times_s) for i in not_finite(pending.graph, values)]


def undetermined(
    pending: Pending, values: gtsam.Values, times_s: dict[int, float], least_said: float = 0.0
) -> list[Withheld]:
    """New landmarks and biases that their factors leave open, whatever becomes of the poses.

    Parameters
    ----------
    values
        Of the variables of the new factors.
    times_s
        Of the keyframes.
    least_said
        See `sonar_graph.slam.smoother.observability.left_open`.
    """
    found = []
    for key in keys_of(pending.values):
        if gtsam.symbolChr(key) != ord("x"):
            found += [
                _without(open_, pending, times_s) for open_ in left_open(pending.graph, values, [key], least_said)
            ]
    return found


def culprits(
    window: gtsam.NonlinearFactorGraph, pending: Pending, values: gtsam.Values, times_s: dict[int, float]
) -> list[Withheld]:
    """Why a window with new factors cannot be solved; nothing where it can, if with better arithmetic.

    Parameters
    ----------
    window
        Without what is pending.

    Raises
    ------
    EstimatorError
        When a keyframe, or what was in the window before, is left open.
    """
    graph = gtsam.NonlinearFactorGraph(window)
    graph.push_back(pending.graph)
    found: list[Withheld] = []
    used = set(graph.keyVector()) | set(keys_of(pending.values))
    for open_ in left_open(graph, values, sorted(used)):
        if gtsam.symbolChr(open_.key) == ord("x") or not pending.values.exists(open_.key):
            raise EstimatorError(f"isam2: {explained(open_, _on(open_.key, graph), times_s)}")
        found.append(_without(open_, pending, times_s))
    return found or undetermined(pending, values, times_s, LEAST_SAID)


def reasons(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, times_s: dict[int, float]) -> str:
    """Why a graph has no solution."""
    spoilt = [graph.at(i) for i in not_finite(graph, values)]
    if spoilt:
        where = _placed(list(spoilt[0].keys())[-1], spoilt, times_s)
        return f"{where}: {factor_names(spoilt)} gives an error that is no number; leave the measurement out"
    found = [explained(open_, _on(open_.key, graph), times_s) for open_ in left_open(graph, values, keys_of(values))]
    return "; ".join(found) or "the graph is determined too weakly for arithmetic of sixteen digits; narrow its priors"


def explained(open_: Open, factors: list[gtsam.NonlinearFactor], times_s: dict[int, float]) -> str:
    """The variable, its factors, the open directions, and what would close them."""
    kind = chr(gtsam.symbolChr(open_.key))
    return f"{_placed(open_.key, factors, times_s)}: {factor_names(factors)}; open: {open_.axes()}; {MISSING[kind]}"


def _placed(key: int, factors: list[gtsam.NonlinearFactor], times_s: dict[int, float]) -> str:
    """A variable by name, with the keyframes that its factors tie it to."""
    keyframes = sorted({k for factor in factors for k in list(factor.keys()) if gtsam.symbolChr(k) == ord("x")})
    if gtsam.symbolChr(key) == ord("x"):
        keyframes = [key]
    at = ", ".join(f"{variable_name(k)} at {times_s[k]:.3f} s" for k in keyframes if k in times_s)
    if gtsam.symbolChr(key) == ord("x"):
        return at or variable_name(key)
    return f"{variable_name(key)}, from {at}" if at else variable_name(key)


def _without(open_: Open, pending: Pending, times_s: dict[int, float]) -> Withheld:
    handles = pending.on(open_.key)
    factors = [pending.factor(handle) for handle in handles]
    return Withheld(set(handles), {open_.key}, f"{explained(open_, factors, times_s)}; withheld")


def _no_number(handle: int, pending: Pending, times_s: dict[int, float]) -> Withheld:
    factor = pending.factor(handle)
    key = max(list(factor.keys()), key=lambda k: gtsam.symbolChr(k) == ord("l"))
    where = _placed(key, [factor], times_s)
    return Withheld({handle}, set(), f"{where}: {factor_names([factor])} gives an error that is no number; withheld")


def _on(key: int, graph: gtsam.NonlinearFactorGraph) -> list[gtsam.NonlinearFactor]:
    return [graph.at(i) for i in range(graph.size()) if key in list(graph.at(i).keys())]
