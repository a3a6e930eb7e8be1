"""Levenberg-Marquardt solution of a whole graph, and joint covariances.

GTSAM's optimisers hand each Python factor a copy of all values, at a cost quadratic in the length of a run; linearising
from Python does not. So the loop is here, and the linear algebra is GTSAM's.

The azimuth factor holds in the half space ahead of the sonar. For a landmark behind, GTSAM's camera has a constant
error and no gradient. A large correction, such as a loop closed after much drift, may put a landmark there; then its
sightings say where to start it instead (docs/theory/isam2.md).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.models import BIASES, project, wrap_angle

MAX_STEPS = 50
"""Steps that a descent may try, whether or not they lower the error: each costs a factorisation of the graph."""
RELATIVE_DECREASE = 1e-6
"""Stop when an iteration lowers the error by less than this share of it."""
LEAST_DECREASE = 1e-5
"""Stop when an iteration lowers the error, half a sum of squares, by less: a step of 0.004 sigma."""
FIRST_DAMPING = 1e-9
DAMPING_FACTOR = 10.0
MAX_DAMPING = 1e9
MOVING = 0.1
"""Share of the largest move of a keyframe in a step from which on another one moves much."""
FEW = 0.4
"""Share of keyframes up to which they are solved for by themselves."""
MAX_STEPS_OF_PART = 20
"""Steps that the solution of a part may try by itself. Its own parts may begin until they have tried `MAX_STEPS`."""
HELD = 1e-6
"""Standard deviation of what is held meanwhile, rad or m."""
POSE, LANDMARK, BIAS = map(ord, "xlb")
TANGENT_SIZES = {POSE: 6, LANDMARK: 3, BIAS: BIASES}


class Stack(Protocol):
    """Many factors of one kind, evaluated as arrays."""

    def __init__(self, factors: Sequence[Any]) -> None: ...

    def error(self, values: gtsam.Values) -> float:
        """Half the sum of squared whitened errors."""

    def linear_factors(self, values: gtsam.Values) -> list[gtsam.JacobianFactor]:
        """What linearising each of them gives."""


class StackedGraph:
    """A graph, of which factors in Python that can be are evaluated together: those whose class has a `Stack`."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph) -> None:
        self.factors = [graph.at(i) for i in range(graph.size())]
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
        return float(self._rest.error(values)) + sum(stack.error(values) for stack in self._stacks)

    def linearize(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        """All factors, linearised."""
        linear = self._rest.linearize(values)
        for factor in (factor for stack in self._stacks for factor in stack.linear_factors(values)):
            linear.push_back(factor)
        return linear

    @cached_property
    def _on(self) -> dict[int, list[int]]:
        """Places of the factors on each keyframe."""
        places = defaultdict(list)
        for i, factor in enumerate(self.factors):
            for key in filter(is_pose, list(factor.keys())):
                places[key].append(i)
        return places

    def unsettled(self, step: gtsam.VectorValues) -> list[int]:
        """Keyframes that a step moves at least a tenth as far as the one that it moves most, where these are few."""
        keyframes = list(self._on)
        moves = np.abs(step.vector(keyframes)).reshape(-1, 6).max(axis=1, initial=0.0)
        found = np.flatnonzero(moves > MOVING * moves.max(initial=0.0)).tolist()
        return [keyframes[i] for i in found] if len(found) < FEW * len(moves) else []

    def around(self, keyframes: list[int], values: gtsam.Values) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Factors on some keyframes, and the values of their variables."""
        part = gtsam.NonlinearFactorGraph()
        for i in sorted({i for key in keyframes for i in self._on[key]}):
            part.add(self.factors[i])
        return part, picked(values, list(part.keyVector()))


def solve(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values) -> gtsam.Values:
    """Solution by Levenberg–Marquardt; the initial values where no step lowers the error."""
    return descended(graph, initial, MAX_STEPS)[0]


def descended(
    graph: gtsam.NonlinearFactorGraph,
    initial: gtsam.Values,
    most_steps: int,
    held: Collection[int] = (),
) -> tuple[gtsam.Values, float, int]:
    """Levenberg–Marquardt from ``initial``, in at most so many steps.

    Minimises the sum of squared whitened (and robustly weighted) errors. Damping multiplies the identity; it starts
    negligible (a Gauss–Newton step) and grows, by 10, 100, 1000 and so on, while a step does not lower the error
    (Nocedal and Wright, Numerical Optimization, section 10.3). A step is doubled while that lowers the error more:
    those of a robust kernel fall short, since its weights are held while a step is solved for. After a step by
    which few keyframes move much these are solved for in the same way, with all else held, before the next step of all.

    Parameters
    ----------
    held
        Variables that stay where they are.

    Returns
    -------
    The values reached, their error, and the number of steps that were tried; those of parts count where something is
    held.
    """
    stacked = StackedGraph(graph)
    values, error = initial, stacked.error(initial)
    damping, ordering, tried, in_parts = FIRST_DAMPING, None, 0, 0
    priors, still = [prior_of(key, 1 / HELD) for key in held], gtsam.VectorValues()
    for key in held:
        still.insert(key, np.zeros(tangent_size(key)))
    while tried < most_steps:
        linear = stacked.linearize(values)
        for prior in priors:
            linear.push_back(prior)
        if ordering is None:
            ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
        candidate, candidate_error, factor = values, np.inf, DAMPING_FACTOR
        while damping <= MAX_DAMPING and tried < most_steps:
            tried += 1
            try:
                step = damped_step(linear, values, damping, ordering)
                step.update(still)  # doubled again and again the least move would add up
                candidate = values.retract(step)
                candidate_error = stacked.error(candidate)
            except RuntimeError:  # GTSAM: indeterminate for this damping
                candidate_error = np.inf
            if candidate_error < error:
                break
            damping, factor = damping * factor, factor * DAMPING_FACTOR
        else:
            break
        damping = max(damping / DAMPING_FACTOR, FIRST_DAMPING)
        while True:  # weights that are made anew with each step make steps too short
            step = step.scale(2.0)
            further = values.retract(step)
            further_error = stacked.error(further)
            if not further_error < candidate_error:
                break
            candidate, candidate_error = further, further_error
        decrease = error - candidate_error
        values, error = candidate, candidate_error
        if decrease <= max(RELATIVE_DECREASE * error, LEAST_DECREASE):
            break
        if (not held or in_parts < MAX_STEPS) and (moving := stacked.unsettled(step)):
            part, some = stacked.around(moving, values)
            rest = set(some.keys()).difference(moving)
            some, _, steps = descended(part, some, MAX_STEPS_OF_PART, rest)
            in_parts += steps
            values = gtsam.Values(values)
            values.update(picked(some, moving))
            error = stacked.error(values)
    return values, error, tried + in_parts if held else tried


def prior_of(key: int, weight: float) -> gtsam.JacobianFactor:
    """A linear factor by which a variable stays where it is, each component with a standard deviation of 1 / weight."""
    n = tangent_size(key)
    return gtsam.JacobianFactor(key, weight * np.eye(n), np.zeros(n), gtsam.noiseModel.Unit.Create(n))


def damped_step(
    linear: gtsam.GaussianFactorGraph, values: gtsam.Values, damping: float, ordering: gtsam.Ordering
) -> gtsam.VectorValues:
    """Step of a linear graph with ``damping`` times the identity in its information."""
    damped = linear
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
    for i in range(linear.size()):
        held.push_back(gtsam.LinearContainerFactor(linear.at(i), values))
    tree.update(held, picked(values, linear.keyVector()))
    return tree


class Marginals:
    """Marginal covariances of a graph, linearised at the values; by QR where Cholesky refuses.

    GTSAM eliminates anew for each question, so that Cholesky may refuse one variable and not another. Each question
    decides for itself: no answer depends on what was asked before.
    """

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        self._linear, self._values = StackedGraph(graph).linearize(values), values
        self._by_cholesky: gtsam.Marginals | None = None
        with suppress(RuntimeError):
            self._by_cholesky = gtsam.Marginals(self._linear, values)
        self._by_qr: gtsam.ISAM2 | None = None

    def marginalCovariance(self, key: int) -> Floats:
        """Covariance of one variable; the name is GTSAM's."""
        return np.asarray(self._ask(lambda marginals: marginals.marginalCovariance(key)))

    def jointMarginalCovariance(self, keys: list[int]) -> gtsam.JointMarginal:
        """Joint covariance of some; the name is GTSAM's."""
        return self._ask(lambda marginals: marginals.jointMarginalCovariance(keys))

    def _ask(self, question: Callable[[gtsam.Marginals | gtsam.ISAM2], Any]) -> Any:
        if self._by_cholesky is not None:
            with suppress(RuntimeError):
                return question(self._by_cholesky)
        self._by_qr = self._by_qr or qr_tree(self._linear, self._values)
        return question(self._by_qr)


@dataclass(frozen=True, eq=False, slots=True)
class Sightline:
    """One sighting of a landmark."""

    pose_key: int
    body_T_sonar: gtsam.Pose3
    """The sonar in the body frame of that keyframe."""
    z: Floats
    """Range (m) and azimuth (rad), shape (2,)."""

    def point(self, values: gtsam.Values) -> Floats:
        """Point of the world where the landmark was measured, at elevation 0, shape (3,), m."""
        on_beam = self.z[0] * np.array([np.cos(self.z[1]), np.sin(self.z[1]), 0.0])
        return self._world_T_sonar(values).transformFrom(on_beam)

    def is_behind(self, values: gtsam.Values, landmark: Floats) -> bool:
        """True when a point of the world is a right angle or more off the measured azimuth."""
        x, y, _ = self._world_T_sonar(values).transformTo(landmark)
        return bool(x * np.cos(self.z[1]) + y * np.sin(self.z[1]) <= 0)

    def miss_m(self, values: gtsam.Values, landmark: Floats) -> float:
        """Distance by which range and azimuth miss a point of the world."""
        x, y, z = self._world_T_sonar(values).transformTo(landmark)
        expected, _ = project(np.array([x, y, z]))
        turn_rad = wrap_angle(expected[1] - self.z[1])
        return math.hypot(expected[0] - self.z[0], self.z[0] * turn_rad)

    def _world_T_sonar(self, values: gtsam.Values) -> gtsam.Pose3:
        return values.atPose3(self.pose_key).compose(self.body_T_sonar)


Sightlines = Mapping[int, Sequence[Sightline]]
"""Sightings that have become factors, by landmark's key."""


OUTVOTED, LEAST_SCATTER_M = 5.0, 0.01
"""A landmark lies where only a few sightings say if the median one misses it by so many times their scatter about the
median of all, which is at least so much."""


def misplaced(values: gtsam.Values, sightlines: Sightlines) -> list[int]:
    """Landmarks behind the sonar in at least half of their sightings, or where only a few of them say (`OUTVOTED`).

    A robust kernel leaves a landmark where its first sightings put it, however many contradict these: far from all of
    them their loss hardly falls.
    """
    found = []
    for key, lines in sightlines.items():
        landmark = values.atPoint3(key)
        if 2 * sum(line.is_behind(values, landmark) for line in lines) >= len(lines):
            found.append(key)
        elif len(lines) > 2:
            points = np.array([line.point(values)[:2] for line in lines])
            scatter_m = np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1))
            miss_m = np.median([line.miss_m(values, landmark) for line in lines])
            if miss_m > OUTVOTED * max(scatter_m, LEAST_SCATTER_M):
                found.append(key)
    return found


def placed_anew(values: gtsam.Values, sightlines: Sightlines, landmark_keys: list[int]) -> gtsam.Values:
    """The values, with each of the landmarks at the median of where its sightings, from these poses, say it is."""
    placed = gtsam.Values(values)
    for key in landmark_keys:
        placed.update(key, np.median([line.point(values) for line in sightlines[key]], axis=0))
    return placed


def solve_in_sight(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values, sightlines: Sightlines) -> gtsam.Values:
    """Solve a graph; again while a landmark is misplaced and its new start lowers the error.

    All that begins anew may try `MAX_STEPS` together, so that a graph whose measurements contradict each other, where
    landmarks stay misplaced, costs twice what one descent may.
    """
    (values, error, _), left = descended(graph, initial, MAX_STEPS), MAX_STEPS
    while left and (stuck := misplaced(values, sightlines)):
        retried, lower, tried = descended(graph, placed_anew(values, sightlines, stuck), left)
        left -= tried
        if lower >= error:
            break
        values, error = retried, lower
    return values


@dataclass(frozen=True, eq=False)
class JointCovariance:
    """Joint covariance of some variables of a graph, in the tangent space of each.

    One matrix, so that compiled code can pick what it needs; GTSAM's `JointMarginal` hands out one block a call.
    """

    matrix: Floats
    """Shape (n, n), in the order in which the variables were asked for."""
    rows: dict[int, int]
    """The first row of each variable, by key."""

    @classmethod
    def of(cls, marginals: Marginals | gtsam.ISAM2, keys: list[int]) -> JointCovariance:
        """Ask for poses (6 rows each), biases (11) and points (3)."""
        rows, n = {}, 0
        for key in keys:
            rows[key] = n
            n += tangent_size(key)
        return cls(marginals.jointMarginalCovariance(keys).fullMatrix(), rows)

    def at(self, a: int, b: int) -> Floats:
        """The block of two variables."""
        i, j = self.rows[a], self.rows[b]
        return self.matrix[i : i + tangent_size(a), j : j + tangent_size(b)]


class KeptCovariance:
    """One joint covariance for all questions between two updates.

    It also covers what was asked for before the last update, since successive frames show mostly the same landmarks.
    """

    def __init__(self) -> None:
        self._joint: JointCovariance | None = None
        self._asked: set[int] = set()
        self._asked_before: set[int] = set()

    def of(self, marginals: Marginals | gtsam.ISAM2, keys: list[int]) -> JointCovariance:
        """Joint covariance of these variables, and possibly of more."""
        self._asked.update(keys)
        if self._joint is None or not self._joint.rows.keys() >= self._asked:
            self._joint = JointCovariance.of(marginals, sorted(self._asked | self._asked_before))
        return self._joint

    def outdate(self) -> None:
        """The same graph is linearised elsewhere."""
        self._joint = None

    def renew(self, lasting: Iterable[int]) -> None:
        """The graph has changed; of what was asked for only some variables last."""
        self._joint, self._asked, self._asked_before = None, set(), self._asked.intersection(lasting)


def kind(key: int) -> int:
    """Character of a variable's symbol, which GTSAM keeps in the highest byte of its key."""
    return key >> 56


def tangent_size(key: int) -> int:
    """Dimension of a variable: 6 of a pose, 11 of the biases, 3 of a point."""
    return TANGENT_SIZES[kind(key)]


def is_pose(key: int) -> bool:
    """True for a keyframe."""
    return kind(key) == POSE


def is_landmark(key: int) -> bool:
    """True for a landmark."""
    return kind(key) == LANDMARK


def is_bias(key: int) -> bool:
    """True for the biases of a stretch of time."""
    return kind(key) == BIAS


def picked(values: gtsam.Values, keys: Iterable[int]) -> gtsam.Values:
    """Some of the variables, poses and vectors. GTSAM copies all that it is given for each factor in Python."""
    few = gtsam.Values()
    for key in keys:
        few.insert(key, values.atPose3(key) if is_pose(key) else values.atVector(key))
    return few
