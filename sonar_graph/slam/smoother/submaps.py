"""Submaps: stretches of keyframes, marginalised onto what they share with the rest, in a frame that moves with them.

A submap is the marginal of its factors on its first and last keyframe, its landmarks and biases: with the interior
keyframes eliminated, ``|A delta - b|²`` of the perturbations of those from where they were linearised
(docs/theory/isam2.md). Sonar, odometry, depth and gravity say nothing of where in the plane a submap lies or which way
it heads. So the marginal is taken in a level frame T, the motion in the plane that fits them best::

    T = argmin sum w_i |T (p_i)_0 - p_i|²  over positions of keyframes and landmarks, and keyframes' yaw likewise
    xi_pose of Y = T^-1 X: `turn_from`         xi_landmark = T^-1 l - (T^-1 l)_0        xi_T = (yaw, x, y) - their start
    error = A xi + A G xi_T - b,               G: perturbations by a motion, in the plane, of all of it

G is in the null space of A unless some factor is absolute. A submap that turns and moves as a whole, as when a loop is
closed, therefore stays exact: what is frozen is its shape, and that is known much better than its place. Least known of
the shape is how much it winds, by which what gravity tells of its tilt must not change either.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from scipy.linalg import solve_triangular
from threadpoolctl import ThreadpoolController

from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.batch_solution import is_landmark, is_pose, picked, tangent_size

CHANGED = 0.005
"""Change of the shape of a submap (rad or m) from which on it is asked whether its summary still holds."""
TOLERANCE = 0.00005
"""Error (half a sum of squares) a variable of the interior by which a summary may be wrong: of 1,000 keyframes 0.05
together, which moves an estimate by 0.3 of its sigma at most, where all of them err in one direction."""
MOST_STEPS = 5
"""Gauss-Newton steps of the interior of a submap, at most, each time that it is linearised."""
ROUNDING = 1e-6
"""Share of its rows by which a motion in the plane may change a summary that says nothing of where it lies.

Depths leave 1e-7, by the large sigmas that stand for none; a position fix of 0.1 m to one keyframe or two makes 1e-2.
"""
BLAS = ThreadpoolController()
"""Libraries of linear algebra: matrices of this size are faster by one thread, much so on a busy machine."""
Factor = gtsam.NonlinearFactor

I3, TWIST = np.eye(3), np.eye(6)[:, 2:5]
"""Identity, and tangent directions of poses in which a level frame moves: yaw, x, y."""


def yaw_from(R0: Floats, R: Floats) -> tuple[float, Floats]:
    """Yaw psi of the turn about the vertical nearest to ``R R0^T``, and its derivative by a perturbation of R, (3,).

    It is defined for all attitudes, and turns but those that tilt R0 by half a turn.
    """
    (r00, r01, r02), (r10, r11, r12), _ = R.dot(R0.T).tolist()
    s, c = r10 - r01, r00 + r11
    n = s * s + c * c
    return math.atan2(s, c), np.array([(-c * r02 - s * r12) / n, (s * r02 - c * r12) / n, 1.0]).dot(R0)


def turn_from(R0: Floats, R: Floats) -> tuple[Floats, Floats]:
    """Turn from R0 to R in the axes of R0, ``Log(R0^T Rz(-psi) R) + psi up``, (3,), and its derivative by R, (3, 3).

    Yaw and tilt add up: to first order it is ``Log(R0^T R)``, which takes one tilt for another after a large yaw.
    """
    psi, by_turn = yaw_from(R0, R)
    tilt = gtsam.Rot3.Logmap(gtsam.Rot3(R0.T.dot(gtsam.Rot3.Rz(-psi).matrix()).dot(R)))
    by_tilt = gtsam.Rot3.LogmapDerivative(tilt).dot(I3 - R[2][:, None] * by_turn)
    return tilt + psi * R0[2], by_tilt + R0[2][:, None] * by_turn


class SubmapFactor:
    """Marginal of a submap on its separator, in the level frame that fits it best.

    Parameters
    ----------
    keys
        Variables of the separator: poses, landmarks, biases. Without a pose T is the world.
    A, b
        Whitened rows of the marginal, by perturbations of these variables.
    values
        Where it was linearised; T has no yaw there.
    """

    def __init__(self, keys: Sequence[int], A: Floats, b: Floats, values: gtsam.Values) -> None:
        self.keys, self.A, self.b = list(keys), A, b
        self._poses = [key for key in keys if is_pose(key)]
        self._points = [key for key in keys if is_landmark(key)]
        self._biases = self.keys[len(self._poses) + len(self._points) :]
        self._biases_0 = [values.atVector(key) for key in self._biases]
        n, m = 6 * len(self._poses), 3 * len(self._points)
        self._A_poses, self._A_points = [A[:, i : i + 6] for i in range(0, n, 6)], A[:, n : n + m]
        self._A_x, self._A_y = self._A_points[:, 0::3].copy(), self._A_points[:, 1::3].copy()
        self._R0 = [values.atPose3(key).rotation().matrix() for key in self._poses]
        # how well each yaw and position in the plane is known when all others are
        self._by_yaw = np.array(
            [np.square(A_k[:, :3] @ R[2]).sum() for A_k, R in zip(self._A_poses, self._R0, strict=True)]
        )
        by_x = [A_k[:, 3:] @ R[0] for A_k, R in zip(self._A_poses, self._R0, strict=True)]
        by_y = [A_k[:, 3:] @ R[1] for A_k, R in zip(self._A_poses, self._R0, strict=True)]
        x, y = np.column_stack([*by_x, self._A_x]), np.column_stack([*by_y, self._A_y])
        xx, yy, xy = np.square(x).sum(axis=0), np.square(y).sum(axis=0), (x * y).sum(axis=0)
        weights = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)  # of the direction that is known least
        total = weights.sum() if self._poses else 0.0
        self._shares = weights / total if total > 0.0 else 0.0 * weights
        positions = self._positions(values)
        self._start_m = np.append(self._shares @ positions[:, :2], 0.0)
        self._arms = total * self._shares[:, None] * (positions - self._start_m)[:, :2]
        self._points_0 = positions[len(self._poses) :] - self._start_m
        start = gtsam.Pose3(gtsam.Rot3(), -self._start_m)
        self._Y0 = [start.compose(values.atPose3(key)) for key in self._poses]
        self._A_rigid = self._by_motion(self._points_0)
        for A_k, Y in zip(self._A_poses, self._Y0, strict=True):
            self._A_rigid = self._A_rigid + A_k @ (Y.inverse().AdjointMap() @ TWIST)
        self._is_absolute = bool(np.linalg.norm(self._A_rigid) > ROUNDING * np.linalg.norm(A))

    def factor(self) -> gtsam.NonlinearFactor:
        """The factor that GTSAM uses."""
        noise = gtsam.noiseModel.Unit.Create(len(self.b))
        return gtsam.CustomFactor(noise, self.keys, self._error)

    def _positions(self, values: gtsam.Values) -> Floats:
        """Positions of poses and landmarks, shape (n, 3)."""
        poses = [values.atPose3(key).translation() for key in self._poses]
        return np.array(poses + [values.atPoint3(key) for key in self._points]).reshape(-1, 3)

    def _fit(self, values: gtsam.Values) -> tuple[gtsam.Pose3, float, float]:
        """Frame T, and numerator s and denominator c of the tangent of its yaw."""
        positions = self._positions(values)
        (ax, ay), (px, py) = self._arms.T, positions.T[:2]
        s, c = float(ax @ py - ay @ px), float(ax @ px + ay @ py)
        for weight, R0, key in zip(self._by_yaw.tolist(), self._R0, self._poses, strict=True):
            yaw_rad, _ = yaw_from(R0, values.atPose3(key).rotation().matrix())
            s, c = s + weight * math.sin(yaw_rad), c + weight * math.cos(yaw_rad)
        x, y, _ = (self._shares @ positions).tolist()
        return gtsam.Pose3(gtsam.Rot3.Rz(math.atan2(s, c)), np.array([x, y, 0.0])), s, c

    def _by_separator(self, values: gtsam.Values, T: gtsam.Pose3, s: float, c: float) -> Floats:
        """Derivative of T, [yaw, x, y] in its own axes, by poses and landmarks, shape (3, 6 n + 3 m)."""
        (ax, ay), r2 = self._arms.T, s * s + c * c or 1.0
        by_position = np.zeros((len(self._arms), 3, 3))  # rows [yaw, x, y] of each, by its x, y and z
        by_position[:, 0, 0], by_position[:, 0, 1] = -(c * ay + s * ax) / r2, (c * ax - s * ay) / r2
        by_position[:, 1:, :2] = self._shares[:, None, None] * T.rotation().matrix().T[:2, :2]
        blocks = [np.zeros((3, 0))]
        for i, key in enumerate(self._poses):
            R = values.atPose3(key).rotation().matrix()
            yaw_rad, by_turn = yaw_from(self._R0[i], R)
            share = self._by_yaw[i] * (c * math.cos(yaw_rad) + s * math.sin(yaw_rad)) / r2
            blocks += [np.vstack([share * by_turn, np.zeros((2, 3))]), by_position[i] @ R]
        return np.hstack([*blocks, *by_position[len(self._poses) :]])

    def deviation(self, values: gtsam.Values) -> tuple[Floats, gtsam.Pose3]:
        """Perturbations xi in the moved frame, in the order of the keys, and the motion of the frame."""
        T, _, _ = self._fit(values)
        return self._from_frame(values, T), T.compose(gtsam.Pose3(gtsam.Rot3(), -self._start_m))

    def _from_frame(self, values: gtsam.Values, T: gtsam.Pose3) -> Floats:
        inverse, R = T.inverse(), T.rotation().matrix()
        parts = [np.zeros(0)]
        for Y0, R0, key in zip(self._Y0, self._R0, self._poses, strict=True):
            Y = inverse.compose(values.atPose3(key))
            parts.append(turn_from(R0, Y.rotation().matrix())[0])
            parts.append(Y0.rotation().unrotate(Y.translation() - Y0.translation()))
        if self._points:
            points = np.array([values.atPoint3(key) for key in self._points])
            parts.append(((points - T.translation()) @ R - self._points_0).ravel())
        parts += [values.atVector(key) - start for key, start in zip(self._biases, self._biases_0, strict=True)]
        return np.concatenate(parts)

    def change_of_shape(self, values: gtsam.Values) -> float:
        """Largest perturbation of a pose or landmark in the moved frame, rad or m; of an absolute one its turn, too."""
        n = 6 * len(self._poses) + 3 * len(self._points)
        xi, motion = self.deviation(values)
        turn_rad = abs(motion.rotation().yaw()) if self._is_absolute else 0.0
        return max(turn_rad, float(np.abs(xi[:n]).max(initial=0.0)))

    def _error(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        T, s, c = self._fit(values)
        xi, R = self._from_frame(values, T), T.rotation().matrix()
        if jacobians is not None:
            inverse, J = T.inverse(), self.A.copy()
            by_frame = self._A_rigid.copy()
            by_frame[:, 1:] = self._A_rigid[:, 1:] @ R[:2, :2]
            for i, (A_k, key) in enumerate(zip(self._A_poses, self._poses, strict=True)):
                Y, D = inverse.compose(values.atPose3(key)), np.zeros((6, 6))
                D[:3, :3] = turn_from(self._R0[i], Y.rotation().matrix())[1]
                D[3:, 3:] = self._Y0[i].rotation().between(Y.rotation()).matrix()
                J[:, 6 * i : 6 * i + 6] = by_pose = A_k @ D
                by_frame -= by_pose @ (Y.inverse().AdjointMap() @ TWIST)
            n = 6 * len(self._poses)
            end = n + 3 * len(self._points)
            by_frame -= self._by_motion(xi[n:end].reshape(-1, 3) + self._points_0)
            J[:, n:end] = (self._A_points.reshape(-1, 3) @ R.T).reshape(self._A_points.shape)
            J[:, :end] += by_frame @ self._by_separator(values, T, s, c)
            column = 0
            for i, key in enumerate(self.keys):
                jacobians[i] = J[:, column : column + tangent_size(key)]
                column += tangent_size(key)
        moved_m = T.translation() - self._start_m
        return self.A @ xi + self._A_rigid @ np.array([T.rotation().yaw(), moved_m[0], moved_m[1]]) - self.b

    def _by_motion(self, points: Floats) -> Floats:
        """Derivative of the error of landmarks by a rigid motion in the plane (yaw, x, y) of all of them."""
        by_yaw = self._A_y @ points[:, 0] - self._A_x @ points[:, 1]
        return np.column_stack([by_yaw, self._A_x.sum(axis=1), self._A_y.sum(axis=1)])


@dataclass(eq=False)
class Submap:
    """Keyframes between two others with their factors, or two such submaps and the keyframe between them."""

    interior: list[int]
    """Keys of what is eliminated: its keyframes in the order of time, and biases on which nothing else hangs."""
    factors: dict[Factor, None]
    """On its interior; those that stand for its parts among them."""
    values: gtsam.Values
    """Its interior where it was last linearised."""
    ends: tuple[int, int] = (0, 0)
    """Keys of the keyframes before and after it."""
    parts: tuple[Submap, ...] = ()
    """The two submaps that it joins, if any."""
    parent: Submap | None = None
    """The submap of which it is a part."""
    summary: SubmapFactor | None = None
    """Its marginal; None before it is linearised."""
    marginals: Sequence[Factor] = ()
    """The factor that stands for it elsewhere; none where nothing hangs on it."""
    is_settled: bool = False
    """True when its interior was at rest, and its parts as they are now, when it was linearised."""
    level: int = field(init=False)
    """0 of keyframes, 1 of two such submaps, and so on."""

    def __post_init__(self) -> None:
        self.level = 1 + max((part.level for part in self.parts), default=-1)
        for part in self.parts:
            part.parent = self

    def lineage(self) -> Iterator[Submap]:
        """The submap, the one of which it is a part, and so on."""
        submap: Submap | None = self
        while submap is not None:
            yield submap
            submap = submap.parent

    def present(self, estimate: gtsam.Values) -> gtsam.Values:
        """Its interior at its best, given the estimate of what stays, moved with the frame of the submap."""
        if self.summary is None:
            return self.values
        xi, motion = self.summary.deviation(estimate)
        return self._moved(self.values, solve_triangular(self._R, self._d - self._S @ xi), motion)

    def _moved(self, values: gtsam.Values, step: Floats, motion: gtsam.Pose3) -> gtsam.Values:
        """Its interior, from these values by a step and a motion."""
        moved, n = gtsam.Values(), 0
        for key in self.interior:
            d = step[n : n + tangent_size(key)]
            if is_pose(key):
                moved.insert(key, motion.compose(values.atPose3(key).retract(d)))
            else:
                moved.insert(key, values.atVector(key) + d)
            n += len(d)
        return moved

    def has_changed(self, estimate: gtsam.Values) -> bool:
        """True when its shape is another than where it was linearised, or it was not settled."""
        return not self.is_settled or (self.summary is not None and self.summary.change_of_shape(estimate) > CHANGED)

    def is_stale(self, estimate: gtsam.Values) -> bool:
        """True when the error of its factors has changed otherwise than its summary says, or was not settled."""
        if not self.is_settled or self.summary is None:
            return not self.is_settled
        values = picked(estimate, self.summary.keys)
        values.insert(self.present(estimate))
        error = sum(factor.error(values) for factor in self.factors)
        off = (error - self._error) - (self.marginals[0].error(estimate) - 0.5 * float(self.summary.b @ self.summary.b))
        return abs(off + 0.5 * float(self._d @ self._d)) > TOLERANCE * len(self.interior)

    def linearise(self, estimate: gtsam.Values) -> None:
        """Marginalise its factors at the estimate of what stays, its interior at rest after some Gauss-Newton steps.

        By QR of the whitened rows, with s for what stays: ``[A_interior A_s b] = Q [R S d; 0 A b]``.
        """
        graph, order = gtsam.NonlinearFactorGraph(), gtsam.Ordering()
        for factor in self.factors:
            graph.add(factor)
        interior, inside = self.present(estimate), set(self.interior)
        kept = [key for key in graph.keyVector() if key not in inside]
        kept.sort(key=lambda key: (not is_pose(key), not is_landmark(key), key))
        for key in self.interior + kept:
            order.push_back(key)
        n = sum(map(tangent_size, self.interior))
        rows: Floats = np.zeros((0, 0))
        for steps in range(MOST_STEPS):
            if steps:
                interior = self._moved(interior, solve_triangular(rows[:n, :n], rows[:n, -1]), gtsam.Pose3())
            values = picked(estimate, kept)
            values.insert(interior)
            stacked = np.column_stack(graph.linearize(values).jacobian(order))
            with BLAS.limit(limits=1, user_api="blas"):
                rows = np.asarray(np.linalg.qr(stacked, "r"))[: stacked.shape[1] - 1]
            if len(rows) < n or not np.diag(rows)[:n].all():
                raise RuntimeError("submap: its factors leave a direction of its interior open")
            self.is_settled = bool(0.5 * np.square(rows[:n, -1]).sum() <= TOLERANCE * len(self.interior))
            if self.is_settled:
                break
        self.values, self._R, self._S, self._d = interior, rows[:n, :n], rows[:n, n:-1], rows[:n, -1]
        self._error = graph.error(values)
        self.summary = SubmapFactor(kept, rows[n:, n:-1], rows[n:, -1], values)
        self.marginals = [self.summary.factor()] if kept else []
