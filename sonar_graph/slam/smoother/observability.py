"""Observability: directions that factors leave open, in words, and new factors that a smoother does without.

Linearised factors ``A x = b`` leave every direction v with ``A v = 0`` open. Columns are scaled to unit length; v is
open where its singular value is below `RANK_LIMIT` of the largest.

A landmark whose new factors leave a direction open cannot be solved for; a factor whose error is no number spoils all
variables, and marginals for good. Such factors are withheld, with landmarks and biases that then have none, and the
rest goes on without them. A keyframe cannot be withheld, since later ones hang on it.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import gtsam
import numpy as np

from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.batch_solution import tangent_size
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
    """Directions of a variable that factors leave open."""

    key: int
    directions: Floats
    """Directions of its tangent space, as rows of unit length, shape (k, n)."""

    def axes(self) -> str:
        """Name of the axis nearest to each direction, with its components where it is not the axis itself."""
        names, found = AXES[chr(gtsam.symbolChr(self.key))], []
        for direction in self.directions:
            nearest = int(np.argmax(np.abs(direction)))
            shares = f"mostly {names[nearest]} ({', '.join(f'{share:.2f}' for share in direction)})"
            found.append(names[nearest] if abs(direction[nearest]) > 0.999 else shares)
        return ", ".join(found)


def left_open(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keys: Iterable[int], least_said: float = 0.0
) -> list[Open]:
    """Directions of some variables that the factors leave open, given all others; none where a derivative is NaN.

    ``values``: of all variables of the factors; ``keys``: the variables that are not taken as known; ``least_said``:
    whitened rows of A shorter than this, such as `LEAST_SAID`, count as zero.
    """
    places, size = {}, 0
    for key in keys:
        places[key] = slice(size, size + tangent_size(key))
        size += tangent_size(key)
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
    found = []
    for key, place in places.items() if len(null) else ():
        _, s, V = np.linalg.svd(null[:, place], full_matrices=False)
        if (s > OPEN_SHARE).any():
            found.append(Open(key, np.asarray(V[s > OPEN_SHARE])))
    return found


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
            rows[:, places[key]] += A[:, column : column + tangent_size(key)]
        column += tangent_size(key)
    return rows[np.linalg.norm(A, axis=1) >= least_said]


def not_finite(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> list[int]:
    """Places of the factors whose error or derivative is no number."""
    found = []
    for i in range(graph.size()):
        A, b = graph.at(i).linearize(values).jacobian()
        if not (np.isfinite(A).all() and np.isfinite(b).all()):
            found.append(i)
    return found


def variable_name(key: int) -> str:
    """Kind and number of a variable, in words."""
    kind = {"x": "keyframe", "l": "landmark", "b": "gyro bias"}.get(chr(gtsam.symbolChr(key)), "variable")
    return f"{kind} {gtsam.Symbol(key).index()}"


def factor_names(factors: Iterable[gtsam.NonlinearFactor]) -> str:
    """Number of factors of each kind, in words."""
    counts: Counter[str] = Counter()
    for factor in factors:
        name, kinds = type(factor).__name__, [chr(gtsam.symbolChr(key)) for key in list(factor.keys())]
        custom = "odometry" if kinds[:2] == ["x", "x"] else "range and azimuth"
        counts[custom if name == "CustomFactor" else KINDS.get(name, name)] += 1
    return ", ".join(f"{count} {kind}" for kind, count in counts.items()) or "no factor"


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
    """New factors whose error is no number."""
    if np.isfinite(pending.graph.error(values)):
        return []
    found = []
    for i in not_finite(pending.graph, values):
        handle, factor = pending.handles[i], pending.graph.at(i)
        key = max(list(factor.keys()), key=lambda k: gtsam.symbolChr(k) == ord("l"))
        told = f"{_placed(key, [factor], times_s)}: {factor_names([factor])} gives an error that is no number; withheld"
        found.append(Withheld({handle}, set(), told))
    return found


def undetermined(
    pending: Pending, values: gtsam.Values, times_s: dict[int, float], least_said: float = 0.0
) -> list[Withheld]:
    """New landmarks and biases that their factors leave open, whatever becomes of the poses."""
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
    """New factors because of which a window cannot be solved; none where it can, if with better arithmetic.

    An `EstimatorError` where a keyframe, or what was in the window before, is left open.
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
    """Reason, in words, why a graph has no solution."""
    spoilt = [graph.at(i) for i in not_finite(graph, values)]
    if spoilt:
        where = _placed(list(spoilt[0].keys())[-1], spoilt, times_s)
        return f"{where}: {factor_names(spoilt)} gives an error that is no number; leave the measurement out"
    found = [explained(open_, _on(open_.key, graph), times_s) for open_ in left_open(graph, values, keys_of(values))]
    return "; ".join(found) or "the graph is determined too weakly for arithmetic of sixteen digits; narrow its priors"


def explained(open_: Open, factors: list[gtsam.NonlinearFactor], times_s: dict[int, float]) -> str:
    """Variable, its factors, the open directions, and what would close them, in words."""
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
    new = pending.on(open_.key)
    return Withheld(set(new), {open_.key}, f"{explained(open_, list(new.values()), times_s)}; withheld")


def _on(key: int, graph: gtsam.NonlinearFactorGraph) -> list[gtsam.NonlinearFactor]:
    return [graph.at(i) for i in range(graph.size()) if key in list(graph.at(i).keys())]
