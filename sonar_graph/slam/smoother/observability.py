"""Observability: directions that factors leave open, in words, and new factors that a smoother does without.

Linearised factors ``A x = b`` leave every direction v with ``A v = 0`` open. Columns are scaled to unit length; v is
open where its singular value is below `RANK_LIMIT` of the largest.

A landmark whose new factors leave a direction open cannot be solved for; a factor whose error is no number spoils all
variables, and marginals for good. Such factors are withheld, with landmarks and biases that then have none, and the
rest goes on without them. A keyframe cannot be withheld, since later ones hang on it.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.factor_store import (
    BIAS,
    LANDMARK,
    POSE,
    FactorStore,
    factors_in,
    is_landmark,
    is_pose,
    kind,
    tangent_size,
    variable_name,
)

Labelled = tuple[str, gtsam.NonlinearFactor]
MARGINAL = "marginal of what left the window"
LEAST_SAID = 2e-3
"""Standard deviations by metre or radian: the graph gives directions that it leaves to others sigmas of a thousand and
more (`sonar_graph.slam.factors`)."""
RANK_LIMIT = 1e-9
OPEN_SHARE = 1e-3
"""Share of a unit vector v from which on a variable takes part in it."""
AXES = {
    POSE: ("roll", "pitch", "yaw", "forward", "left", "up"),
    LANDMARK: ("x", "y", "z"),
    BIAS: ("about x", "about y", "about z"),
}
MISSING = {
    LANDMARK: "an elevation, a floor prior or a view from elsewhere is missing",
    BIAS: "a prior or a walk from another bias is missing",
    POSE: "odometry from another keyframe or a prior is missing",
}
SPOILT = "gives an error that is no number"


@dataclass(frozen=True, eq=False)
class Open:
    """Directions of a variable that factors leave open."""

    key: int
    directions: Floats
    """Directions of its tangent space, as rows of unit length, shape (k, n)."""

    def axes(self) -> str:
        """Name of the axis nearest to each direction, with its components where it is not the axis itself."""
        names = AXES[kind(self.key)]
        found = []
        for direction in self.directions:
            nearest = int(np.argmax(np.abs(direction)))
            shares = f"mostly {names[nearest]} ({', '.join(f'{share:.2f}' for share in direction)})"
            found.append(names[nearest] if abs(direction[nearest]) > 0.999 else shares)
        return ", ".join(found)


def left_open(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    keys: Iterable[int],
    least_said: float = 0.0,
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
    factors = [
        factor
        for factor in factors_in(graph)
        if not places.keys().isdisjoint(factor.keys())
    ]
    A = np.vstack(
        [
            np.zeros((1, size)),
            *(_rows(factor, values, places, least_said) for factor in factors),
        ]
    )
    # such a factor is reported as spoilt
    if not np.isfinite(A).all():
        return []
    # radians and metres beside each other: the rank must not depend on their units
    lengths = np.linalg.norm(A, axis=0)
    scale = 1.0 / np.where(lengths > 0, lengths, 1.0)
    _, s, V = np.linalg.svd(np.linalg.qr(A * scale, mode="r"), full_matrices=True)
    rank = int(np.sum(s > RANK_LIMIT * max(s[0], 1e-300)))
    null = V[rank:] * scale
    null /= np.maximum(np.linalg.norm(null, axis=1, keepdims=True), 1e-300)
    found = []
    for key, place in places.items() if len(null) else ():
        _, s, V = np.linalg.svd(null[:, place], full_matrices=False)
        if (s > OPEN_SHARE).any():
            found.append(Open(key, V[s > OPEN_SHARE]))
    return found


def _rows(
    factor: gtsam.NonlinearFactor,
    values: gtsam.Values,
    places: dict[int, slice],
    least_said: float,
) -> Floats:
    """A factor's whitened rows in the columns of the variables that are not known."""
    linear = factor.linearize(values)
    A, _ = linear.jacobian()
    rows, column = np.zeros((len(A), max(place.stop for place in places.values()))), 0
    for key in list(linear.keys()):
        if key in places:
            rows[:, places[key]] += A[:, column : column + tangent_size(key)]
        column += tangent_size(key)
    return rows[np.linalg.norm(A, axis=1) >= least_said]


def is_finite(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> bool:
    """True when error and derivative of a factor are numbers."""
    return all(np.isfinite(part).all() for part in factor.linearize(values).jacobian())


@dataclass(frozen=True, eq=False)
class Withheld:
    """Factors that are not used, with variables that are not estimated."""

    handles: set[int]
    keys: set[int]
    message: str
    """The variable, its factors, and what is missing."""


class Blame:
    """Finds which new factors keep a graph from a solution, and names them, or what it lacks, in messages.

    Parameters
    ----------
    store
        Factors with their labels.
    new_keys
        Variables that the window has not taken up yet.
    times_s
        Times of keyframes.
    """

    def __init__(
        self,
        store: FactorStore,
        new_keys: Collection[int],
        times_s: Mapping[int, float],
    ) -> None:
        self._store, self._new_keys, self._times_s = store, new_keys, times_s
        self.graph = store.new_graph
        """New factors."""

    def spoilt(self, values: gtsam.Values) -> list[Withheld]:
        """New factors whose error is no number."""
        # one call in the usual case; each factor only where the sum is no number
        if np.isfinite(self.graph.error(values)):
            return []
        return [
            Withheld(
                {handle}, set(), f"{self._told([(label, factor)])} {SPOILT}; withheld"
            )
            for handle, group in self._store.new.items()
            for label, factor in group.factors.items()
            if not is_finite(factor, values)
        ]

    def undetermined(
        self, values: gtsam.Values, least_said: float = 0.0
    ) -> list[Withheld]:
        """New landmarks and biases that their factors leave open, whatever becomes of the poses."""
        return [
            self._without(open_)
            for key in self._new_keys
            if not is_pose(key)
            for open_ in left_open(self.graph, values, [key], least_said)
        ]

    def culprits(
        self, window: gtsam.NonlinearFactorGraph, values: gtsam.Values
    ) -> list[Withheld]:
        """New factors without which a window can be solved; empty where only the arithmetic fails.

        Raises an `EstimatorError` where a keyframe, or what was in the window before, is left open.
        """
        graph = gtsam.NonlinearFactorGraph(window)
        inside = {*window.keyVector(), *self._new_keys}
        for factor in factors_in(self.graph):
            # a new factor may be on a variable that has left the window
            if inside.issuperset(factor.keys()):
                graph.add(factor)
        found: list[Withheld] = []
        for open_ in left_open(graph, values, sorted(inside)):
            if is_pose(open_.key) or open_.key not in self._new_keys:
                raise EstimatorError(
                    f"isam2: {self._explained(open_, self._labelled(graph, open_.key))}"
                )
            found.append(self._without(open_))
        # nothing is open, so that only weak factors can be to blame
        return found or self.undetermined(values, LEAST_SAID)

    def reasons(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> str:
        """Reason, in words, why a graph has no solution."""
        if spoilt := [
            (label, factor)
            for label, factor in self._labelled(graph)
            if not is_finite(factor, values)
        ]:
            return f"{self._told(spoilt)} {SPOILT}; leave the measurement out"
        found = left_open(graph, values, list(values.keys()))
        return "; ".join(
            self._explained(open_, self._labelled(graph, open_.key)) for open_ in found
        ) or (
            "the graph is determined too weakly for arithmetic of sixteen digits; narrow its priors"
        )

    def _labelled(
        self, graph: gtsam.NonlinearFactorGraph, key: int | None = None
    ) -> list[Labelled]:
        """Factors of a graph, or those on a variable."""
        labels = {
            f: label for group in self._store for label, f in group.factors.items()
        }
        return [
            (labels.get(f, MARGINAL), f)
            for f in factors_in(graph)
            if key is None or key in list(f.keys())
        ]

    def _without(self, open_: Open) -> Withheld:
        handles = set()
        factors = []
        for handle, group in self._store.new.items():
            for label, factor in group.factors.items():
                if open_.key in list(factor.keys()):
                    handles.add(handle)
                    factors.append((label, factor))
        message = f"{self._explained(open_, factors)}; withheld"
        return Withheld(handles, {open_.key}, message)

    def _explained(self, open_: Open, factors: list[Labelled]) -> str:
        """Variable, its factors, the open directions, and what would close them, in words."""
        missing = MISSING[kind(open_.key)]
        return f"{self._told(factors, open_.key)}; open: {open_.axes()}; {missing}"

    def _told(self, factors: list[Labelled], key: int | None = None) -> str:
        """A variable by name, with the keyframes that its factors tie it to, and the number of factors of each label.

        ``key``: None for the landmark, or last variable, of the first factor.
        """
        keys = [list(factor.keys()) for _, factor in factors]
        if key is None:
            key = max(keys[0], key=is_landmark)
        # a keyframe stands for itself
        others = {k for ks in keys for k in ks if is_pose(k)}
        keyframes = [key] if is_pose(key) else sorted(others)
        at = ", ".join(
            f"{variable_name(k)} at {self._times_s[k]:.3f} s"
            for k in keyframes
            if k in self._times_s
        )
        name = variable_name(key)
        if at:
            name = at if is_pose(key) else f"{name}, from {at}"
        counts = Counter(label for label, _ in factors)
        return f"{name}: {', '.join(f'{count} {label}' for label, count in counts.items()) or 'no factor'}"
