"""Levenberg-Marquardt solution of a whole graph, and marginal and joint covariances.

GTSAM's optimisers hand each Python factor a copy of all values, at a cost quadratic in the length of a run; linearising
from Python does not. So the loop is here, and the linear algebra is GTSAM's.

The azimuth factor holds in the half space ahead of the sonar. For a landmark behind, GTSAM's camera has a constant
error and no gradient. A large correction, such as a loop closed after much drift, may put a landmark there; then its
sightings start it again (docs/theory/isam2.md).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import gtsam
import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.slam.smoother.factor_store import (
    Known,
    Sightlines,
    factors_in,
    missed,
    picked,
    sighted_from,
    tangent_size,
)

MAX_STEPS = 50
"""Steps that a descent may try, whether or not they lower the error: each costs a factorisation of the graph."""
RELATIVE_DECREASE = 1e-6
"""Stop when an iteration lowers the error by less than this share of it."""
LEAST_DECREASE = 1e-5
"""Stop when an iteration lowers the error, half a sum of squares, by less: a step of 0.004 sigma."""
FIRST_DAMPING = 1e-9
DAMPING_FACTOR = 10.0
MAX_DAMPING = 1e9


class Stack(Protocol):
    """Many factors of one kind, evaluated as arrays."""

    def __init__(self, factors: Sequence[Any]) -> None: ...

    def error(self, values: gtsam.Values) -> float:
        """Half the sum of squared whitened errors."""

    def linear_factors(self, values: gtsam.Values) -> list[gtsam.JacobianFactor]:
        """What linearising each of them gives."""


class StackedGraph:
    """A graph whose factors in Python are evaluated together, where their class has a `Stack`."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph) -> None:
        self.factors = factors_in(graph)
        self._rest = gtsam.NonlinearFactorGraph()
        kinds: dict[type[Stack], list[gtsam.NonlinearFactor]] = defaultdict(list)
        for factor in self.factors:
            if kind := getattr(factor, "Stack", None):
                kinds[kind].append(factor)
            else:
                self._rest.add(factor)
        self._stacks = [kind(members) for kind, members in kinds.items()]

    def error(self, values: gtsam.Values) -> float:
        """Half the sum of squared errors."""
        return self._rest.error(values) + sum(
            stack.error(values) for stack in self._stacks
        )

    def linearize(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        """All factors, linearised."""
        linear = self._rest.linearize(values)
        for factor in (
            factor for stack in self._stacks for factor in stack.linear_factors(values)
        ):
            linear.push_back(factor)
        return linear


class Descent(NamedTuple):
    """Result of a descent."""

    values: gtsam.Values
    error: float
    """Half the sum of squared whitened errors, robustly weighted."""
    steps: int
    """Number of steps that were tried."""


def descended(
    graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values, most_steps: int
) -> Descent:
    """Levenberg-Marquardt from initial values, in at most so many steps.

    Damping multiplies the identity. It starts negligible (a Gauss-Newton step) and grows, by 10, 100, 1000 and so on,
    while a step does not lower the error (Nocedal and Wright, Numerical Optimization, section 10.3). A step is doubled
    while that lowers the error further: steps of a robust kernel are too short, since its weights are held while a step
    is solved for. Doubling halves the time of a graph with many robust factors, such as DLR's.
    """
    stacked = StackedGraph(graph)
    values = initial
    error = stacked.error(initial)
    damping = FIRST_DAMPING
    ordering = None
    tried = 0
    while tried < most_steps:
        linear = stacked.linearize(values)
        if ordering is None:
            # all linear graphs of a descent have the same structure
            ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
        step = None
        growth = DAMPING_FACTOR
        while step is None and damping <= MAX_DAMPING and tried < most_steps:
            tried += 1
            step = lowering_step(stacked, linear, values, error, damping, ordering)
            if step is None:
                # the least damping is far below the useful ones: reach them in a few attempts
                damping *= growth
                growth *= DAMPING_FACTOR
        if step is None:
            break
        # near the solution undamped steps converge quadratically
        damping = max(damping / DAMPING_FACTOR, FIRST_DAMPING)
        before = error
        values, error = doubled(stacked, values, step)
        if before - error <= max(RELATIVE_DECREASE * error, LEAST_DECREASE):
            break
    return Descent(values, error, tried)


def lowering_step(
    stacked: StackedGraph,
    linear: gtsam.GaussianFactorGraph,
    values: gtsam.Values,
    error: float,
    damping: float,
    ordering: gtsam.Ordering,
) -> gtsam.VectorValues | None:
    """Damped step, if it lowers the error of the graph; else None."""
    try:
        step = damped_step(linear, values, damping, ordering)
        is_lower = stacked.error(values.retract(step)) < error
    except RuntimeError:  # GTSAM: indeterminate for this damping
        return None
    return step if is_lower else None


def doubled(
    stacked: StackedGraph, values: gtsam.Values, step: gtsam.VectorValues
) -> tuple[gtsam.Values, float]:
    """Values after a step, doubled while that lowers the error, and their error."""
    reached = values.retract(step)
    error = stacked.error(reached)
    while True:
        step = step.scale(2.0)
        further = values.retract(step)
        further_error = stacked.error(further)
        # not < : stop where the error is no number
        if not further_error < error:
            return reached, error
        reached = further
        error = further_error


def prior_of(key: int, weight: float) -> gtsam.JacobianFactor:
    """A linear factor by which a variable stays where it is, each component with a standard deviation of 1 / weight."""
    n = tangent_size(key)
    return gtsam.JacobianFactor(
        key, weight * np.eye(n), np.zeros(n), gtsam.noiseModel.Unit.Create(n)
    )


def damped_step(
    linear: gtsam.GaussianFactorGraph,
    values: gtsam.Values,
    damping: float,
    ordering: gtsam.Ordering,
) -> gtsam.VectorValues:
    """Step of a linear graph with ``damping`` times the identity in its information."""
    damped = linear
    # the least damping is negligible: solve the graph as it is
    if damping > FIRST_DAMPING:
        damped = linear.clone()
        for key in linear.keyVector():
            damped.push_back(prior_of(key, np.sqrt(damping)))
    try:
        return damped.eliminateSequential(ordering).optimize()
    except RuntimeError:  # Cholesky refuses what is determined, but weakly
        return qr_tree(damped, values).getDelta()


def qr_tree(linear: gtsam.GaussianFactorGraph, values: gtsam.Values) -> gtsam.ISAM2:
    """A linear graph, eliminated by QR: for its solution and marginals where Cholesky refuses it.

    GTSAM's Python interface offers QR only inside ISAM2; the factors are held there at the values they came from.
    """
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    tree = gtsam.ISAM2(params)
    held = gtsam.NonlinearFactorGraph()
    for factor in factors_in(linear):
        held.push_back(gtsam.LinearContainerFactor(factor, values))
    tree.update(held, picked(values, linear.keyVector()))
    return tree


NO_SIGHTLINES: Sightlines = {}
OUTVOTED = 5.0
"""A landmark is misplaced where the median sighting misses it by more than this number of scatters. The scatter is the
median distance of the sighted points from their median."""
LEAST_SCATTER_M = 0.01


def misplaced(values: Known, sightlines: Sightlines) -> list[int]:
    """Landmarks behind the sonar in at least half of their sightings, or that most sightings contradict (`OUTVOTED`).

    A robust kernel leaves a landmark where its first sightings put it, however many contradict these: far from all of
    them their loss hardly falls.
    """
    found = []
    for key, lines in sightlines.items():
        sighted = sighted_from(values, lines)
        behind, miss_m = missed(sighted, values.atPoint3(key))
        if 2 * behind >= len(lines):
            found.append(key)
        elif len(lines) > 2:
            points = sighted.points()[:, :2]
            scatter_m = np.median(
                np.linalg.norm(points - np.median(points, axis=0), axis=1)
            )
            if np.median(miss_m) > OUTVOTED * max(scatter_m, LEAST_SCATTER_M):
                found.append(key)
    return found


def placed_again(
    values: gtsam.Values, sightlines: Sightlines, landmark_keys: list[int]
) -> gtsam.Values:
    """The values, with each of the landmarks at the median of the points that its sightings give from these poses."""
    placed = gtsam.Values(values)
    for key in landmark_keys:
        points = sighted_from(values, sightlines[key]).points()
        placed.update(key, np.median(points, axis=0))
    return placed


def solve(
    graph: gtsam.NonlinearFactorGraph,
    initial: gtsam.Values,
    sightlines: Sightlines = NO_SIGHTLINES,
) -> gtsam.Values:
    """Solve a graph; solve it again while landmarks are misplaced and new starts for them lower the error.

    Without sightlines, and where no step lowers the error, once; the initial values may be the solution.
    The repeated descents may try `MAX_STEPS` together, so that a graph whose measurements contradict each other, where
    landmarks stay misplaced, costs at most twice as much as one descent.
    """
    best = descended(graph, initial, MAX_STEPS)
    steps_left = MAX_STEPS
    while steps_left:
        stuck = misplaced(best.values, sightlines)
        if not stuck:
            break
        retried = descended(
            graph, placed_again(best.values, sightlines, stuck), steps_left
        )
        steps_left -= retried.steps
        # the new starts do not help: most sightings of these landmarks are wrong
        if retried.error >= best.error:
            break
        best = retried
    return best.values


@dataclass(frozen=True, eq=False)
class JointCovariance:
    """Joint covariance of some variables of a graph, in the tangent space of each.

    One matrix, so that compiled code can pick what it needs; GTSAM's `JointMarginal` hands out one block a call.
    """

    matrix: Floats
    """Shape (n, n), in the order in which the variables were given."""
    rows: dict[int, int]
    """The first row of each variable, by key."""

    @classmethod
    def of(cls, marginals: Marginals | gtsam.ISAM2, keys: list[int]) -> JointCovariance:
        """Compute that of poses (6 rows each), biases (11) and points (3)."""
        rows, n = {}, 0
        for key in keys:
            rows[key] = n
            n += tangent_size(key)
        # in the layout for which compiled code exists
        joint = marginals.jointMarginalCovariance(keys).fullMatrix()
        return cls(np.ascontiguousarray(joint), rows)

    def first_rows(self, keys: list[int]) -> Ints:
        """First row of each variable, shape (len(keys),)."""
        return np.array([self.rows[key] for key in keys])

    def at(self, a: int, b: int) -> Floats:
        """The block of two variables."""
        i, j = self.rows[a], self.rows[b]
        return self.matrix[i : i + tangent_size(a), j : j + tangent_size(b)]


class KeptCovariance:
    """One joint covariance for all questions between two updates.

    Each joint covariance costs an elimination of most of the map, however small it is. So the first one after an update
    includes the landmarks that the next frame is likely to show.
    """

    def __init__(self) -> None:
        self._joint: JointCovariance | None = None
        self._asked: set[int] = set()

    def of(
        self,
        marginals: Marginals | gtsam.ISAM2,
        keys: list[int],
        likely: Callable[[], list[int]],
    ) -> JointCovariance:
        """Joint covariance of these variables, and possibly of more; ``likely`` names those that are needed next."""
        # the next joint covariance includes all variables since the update, so that no question is repeated
        self._asked.update(keys)
        if self._joint is None or not self._joint.rows.keys() >= self._asked:
            self._joint = JointCovariance.of(
                marginals, sorted(self._asked.union(likely()))
            )
        return self._joint

    def renew(self) -> None:
        """The graph has changed."""
        self._joint = None
        self._asked = set()


class Marginals:
    """Marginal covariances of a graph, linearised at the values; by QR where Cholesky refuses.

    GTSAM eliminates again for each covariance, so that Cholesky may refuse one variable and not another. The choice is
    made for each covariance: no result depends on earlier calls.
    """

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        self._linear, self._values = StackedGraph(graph).linearize(values), values
        self._by_cholesky: gtsam.Marginals | None = None
        with suppress(RuntimeError):
            self._by_cholesky = gtsam.Marginals(self._linear, values)
        self._by_qr: gtsam.ISAM2 | None = None

    def marginalCovariance(self, key: int) -> Floats:
        """Covariance of one variable; the name is GTSAM's."""
        return self._ask(lambda marginals: marginals.marginalCovariance(key))

    def jointMarginalCovariance(self, keys: list[int]) -> gtsam.JointMarginal:
        """Joint covariance of some; the name is GTSAM's."""
        return self._ask(lambda marginals: marginals.jointMarginalCovariance(keys))

    def _ask(self, question: Callable[[gtsam.Marginals | gtsam.ISAM2], Any]) -> Any:
        # QR is slower
        if self._by_cholesky is not None:
            with suppress(RuntimeError):
                return question(self._by_cholesky)
        self._by_qr = self._by_qr or qr_tree(self._linear, self._values)
        return question(self._by_qr)
