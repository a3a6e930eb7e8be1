"""Levenberg-Marquardt solution of a whole graph, and joint covariances.

GTSAM's optimisers hand each Python factor a copy of all values, at a cost quadratic in the length of a run; linearising
from Python does not. So the loop is here, and the linear algebra is GTSAM's.

The azimuth factor holds in the half space ahead of the sonar. For a landmark behind, GTSAM's camera has a constant
error and no gradient. A large correction, such as a loop closed after much drift, may put a landmark there; then its
sightings say where to start it instead (docs/theory/isam2.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.slam.biases import BIASES

MAX_STEPS = 50
"""Steps that a descent may try, whether or not they lower the error: each costs a factorisation of the graph."""
RELATIVE_DECREASE = 1e-6
"""Stop when an iteration lowers the error by less than this share of it."""
LEAST_DECREASE = 1e-5
"""Stop when an iteration lowers the error, half a sum of squares, by less: a step of 0.004 sigma."""
FIRST_DAMPING = 1e-9
DAMPING_FACTOR = 10.0
MAX_DAMPING = 1e9


def solve(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values) -> gtsam.Values:
    """Solution by Levenberg–Marquardt; the initial values where no step lowers the error."""
    return descended(graph, initial, MAX_STEPS)[0]


def descended(
    graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values, most_steps: int
) -> tuple[gtsam.Values, float, int]:
    """Levenberg–Marquardt from ``initial``, in at most so many steps.

    Minimises the sum of squared whitened (and robustly weighted) errors. Damping multiplies the identity; it starts
    negligible (a Gauss–Newton step) and grows tenfold while a step does not lower the error (Nocedal and Wright,
    Numerical Optimization, section 10.3). A step is doubled while that lowers the error more: those of a robust
    kernel fall short, since its weights are held while a step is solved for.

    Returns
    -------
    The values reached, their error, and the number of steps that were tried.
    """
    values, error = initial, graph.error(initial)
    damping, ordering, tried = FIRST_DAMPING, None, 0
    while tried < most_steps:
        linear = graph.linearize(values)
        if ordering is None:
            ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
        candidate, candidate_error = values, np.inf
        while damping <= MAX_DAMPING and tried < most_steps:
            tried += 1
            try:
                step = damped_step(linear, values, damping, ordering)
                candidate = values.retract(step)
                candidate_error = graph.error(candidate)
            except RuntimeError:  # GTSAM: indeterminate for this damping
                candidate_error = np.inf
            if candidate_error < error:
                break
            damping *= DAMPING_FACTOR
        else:
            break
        damping = max(damping / DAMPING_FACTOR, FIRST_DAMPING)
        while True:  # weights that are made anew with each step make steps too short
            step = step.scale(2.0)
            further = values.retract(step)
            further_error = graph.error(further)
            if not further_error < candidate_error:
                break
            candidate, candidate_error = further, further_error
        decrease = error - candidate_error
        values, error = candidate, candidate_error
        if decrease <= max(RELATIVE_DECREASE * error, LEAST_DECREASE):
            break
    return values, error, tried


def damped_step(
    linear: gtsam.GaussianFactorGraph, values: gtsam.Values, damping: float, ordering: gtsam.Ordering
) -> gtsam.VectorValues:
    """Step of a linear graph with ``damping`` times the identity in its information."""
    damped = linear
    if damping > FIRST_DAMPING:
        damped = linear.clone()
        zero = values.zeroVectors()
        for key in linear.keyVector():
            n, root = len(zero.at(key)), np.sqrt(damping)
            damped.push_back(gtsam.JacobianFactor(key, root * np.eye(n), np.zeros(n), gtsam.noiseModel.Unit.Create(n)))
    try:
        return damped.optimize(ordering)
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
    tree.update(held, values)
    return tree


class Marginals:
    """Marginal covariances of a graph, linearised at the values; by QR where Cholesky refuses.

    GTSAM eliminates anew for each question, so that Cholesky may refuse one variable and not another. Each question
    decides for itself: no answer depends on what was asked before.
    """

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        self._linear, self._values = graph.linearize(values), values
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

    def _world_T_sonar(self, values: gtsam.Values) -> gtsam.Pose3:
        return values.atPose3(self.pose_key).compose(self.body_T_sonar)


Sightlines = Mapping[int, Sequence[Sightline]]
"""Sightings that have become factors, by landmark's key."""


def turned_away(values: gtsam.Values, sightlines: Sightlines) -> list[int]:
    """Landmarks that lie behind the sonar in at least half of their sightings."""
    found = []
    for key, lines in sightlines.items():
        landmark = values.atPoint3(key)
        if 2 * sum(line.is_behind(values, landmark) for line in lines) >= len(lines):
            found.append(key)
    return found


def placed_anew(values: gtsam.Values, sightlines: Sightlines, landmark_keys: list[int]) -> gtsam.Values:
    """The values, with each of the landmarks at the median of where its sightings, from these poses, say it is."""
    placed = gtsam.Values(values)
    for key in landmark_keys:
        placed.update(key, np.median([line.point(values) for line in sightlines[key]], axis=0))
    return placed


def solve_in_sight(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values, sightlines: Sightlines) -> gtsam.Values:
    """Solve a graph; again while a landmark is stuck behind the sonar and its new start lowers the error.

    All that begins anew may try `MAX_STEPS` together, so that a graph whose measurements contradict each other, where
    landmarks stay behind, costs twice what one descent may.
    """
    (values, error, _), left = descended(graph, initial, MAX_STEPS), MAX_STEPS
    while left and (stuck := turned_away(values, sightlines)):
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


def tangent_size(key: int) -> int:
    """Dimension of a variable: 6 of a pose, 11 of the biases, 3 of a point."""
    return {ord("x"): 6, ord("b"): BIASES}.get(gtsam.symbolChr(key), 3)


def is_pose(key: int) -> bool:
    """True for a keyframe."""
    return bool(gtsam.symbolChr(key) == ord("x"))


def picked(values: gtsam.Values, keys: Iterable[int]) -> gtsam.Values:
    """Some of the variables, poses and vectors. GTSAM copies all that it is given for each factor in Python."""
    few = gtsam.Values()
    for key in keys:
        few.insert(key, values.atPose3(key) if is_pose(key) else values.atVector(key))
    return few
