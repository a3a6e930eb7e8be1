"""Marginal of a submap on what it shares with the rest, as a factor in a level frame that moves with it.

Sonar, odometry, depth and gravity say nothing of where in the plane a submap lies or which way it heads. So its
marginal ``|A delta - b|²`` is taken in a level frame T, the motion in the plane that fits best (docs/theory/isam2.md)::

    T = argmin sum w_i |T (p_i)_0 - p_i|²  over positions of keyframes and landmarks, and keyframes' yaw likewise
    xi_pose of Y = T^-1 X: turn from R_0 to R_Y, R_0^T (p_Y - p_0)   xi_landmark = T^-1 l - l_0   xi_T = (yaw, x, y)
    error = A xi + A G xi_T - b,                                G: perturbations by a motion, in the plane, of all of it

Index 0 is where it was linearised, in T as it was there: without yaw, at a mean of the positions. G is in the null
space of A unless some factor is absolute.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.numerics import I3, Mat3, Vec3, chord_inverse, compiled, cross, inlined, outer, rotation_log, vec
from sonar_graph.slam.odometry_arrays import pose, pose_row
from sonar_graph.slam.smoother.batch_solution import is_landmark, is_pose, tangent_size

ROUNDING = 1e-6
"""Share of its rows by which a motion in the plane may change a summary that says nothing of where it lies.

Depths leave 1e-7, by the large sigmas that stand for none; a position fix of 0.1 m to one keyframe or two makes 1e-2.
"""


@inlined
def about_up(yaw_rad: float) -> Mat3:
    """Turn about the vertical."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return Mat3(Vec3(c, -s, 0.0), Vec3(s, c, 0.0), Vec3(0.0, 0.0, 1.0))


@inlined
def yaw_from(R_0: Mat3, R: Mat3) -> tuple[float, Vec3]:
    """Yaw psi of the turn about the vertical nearest to ``R R_0^T``, and its derivative by a perturbation of R.

    It is defined for all attitudes, and turns but those that tilt R_0 by half a turn.
    """
    turn = R @ R_0.T
    s, c = turn.y.x - turn.x.y, turn.x.x + turn.y.y
    n = s * s + c * c
    by_turn = Vec3((-c * turn.x.z - s * turn.y.z) / n, (s * turn.x.z - c * turn.y.z) / n, 1.0)
    return math.atan2(s, c), R_0.T @ by_turn


@inlined
def turn_from(R_0: Mat3, R: Mat3) -> tuple[Vec3, Mat3]:
    """Turn from R_0 to R in the axes of R_0, ``Log(R_0^T Rz(-psi) R) + psi up``, and its derivative by R.

    Yaw and tilt add up: to first order it is ``Log(R_0^T R)``, which takes one tilt for another after a large yaw.
    """
    psi, by_turn = yaw_from(R_0, R)
    tilt = rotation_log(R_0.T @ about_up(-psi) @ R)
    by_tilt = chord_inverse(tilt).T @ (I3 - outer(R.z, by_turn))
    return tilt + psi * R_0.z, by_tilt + outer(R_0.z, by_turn)


@inlined
def put(v: Vec3, out: Floats, row: int, column: int) -> None:
    """Write a vector into a row of an array."""
    out[row, column], out[row, column + 1], out[row, column + 2] = v


@compiled
def level_frame(poses: Floats, points: Floats, poses_0: Floats, by_yaw: Floats, shares: Floats, arms: Floats) -> Floats:
    """Yaw (rad), x and y (m) of T, and numerator s and denominator c of the tangent of its yaw, shape (5,).

    Parameters
    ----------
    poses, points, poses_0
        Rows of R, and p, shape (n, 12), and landmarks, shape (m, 3); poses in T where they were linearised.
    by_yaw, shares, arms
        Weights of yaw, shape (n,), and of positions, shape (n + m,), their sum 1; positions about their mean, in the
        plane, times their weights, shape (n + m, 2).
    """
    n, s, c, x, y = len(poses), 0.0, 0.0, 0.0, 0.0
    for i in range(n + len(points)):
        px, py = (poses[i, 9], poses[i, 10]) if i < n else (points[i - n, 0], points[i - n, 1])
        x, y = x + shares[i] * px, y + shares[i] * py
        s, c = s + arms[i, 0] * py - arms[i, 1] * px, c + arms[i, 0] * px + arms[i, 1] * py
    for i in range(n):
        yaw_rad, _ = yaw_from(pose(poses_0[i])[0], pose(poses[i])[0])
        s, c = s + by_yaw[i] * math.sin(yaw_rad), c + by_yaw[i] * math.cos(yaw_rad)
    return np.array([math.atan2(s, c), x, y, s, c])


@compiled
def perturbations(poses: Floats, points: Floats, poses_0: Floats, points_0: Floats, T: Floats) -> Floats:
    """Xi of poses and landmarks in the level frame ``T``, shape (6 n + 3 m,)."""
    R_T, p_T, n = about_up(T[0]), Vec3(T[1], T[2], 0.0), len(poses)
    xi = np.empty((2 * n + len(points), 3))
    for i in range(n):
        (R, p), (R_0, p_0) = pose(poses[i]), pose(poses_0[i])
        put(turn_from(R_0, R_T.T @ R)[0], xi, 2 * i, 0)
        put(R_0.T @ (R_T.T @ (p - p_T) - p_0), xi, 2 * i + 1, 0)
    for i in range(len(points)):
        put(R_T.T @ (vec(points[i]) - p_T) - vec(points_0[i]), xi, 2 * n + i, 0)
    return xi.ravel()


@compiled
def differentiate(
    J: Floats,
    AG: Floats,
    poses: Floats,
    points: Floats,
    poses_0: Floats,
    by_yaw: Floats,
    shares: Floats,
    arms: Floats,
    T: Floats,
) -> Floats:
    """Turn A, given as ``J``, into the derivative of ``A xi + AG xi_T`` by poses and landmarks.

    They move xi, and T, which moves xi and xi_T.

    Returns
    -------
    Derivative by [yaw, x, y] of T in its own axes, shape (rows, 3).
    """
    R_T, p_T, s, c, n = about_up(T[0]), Vec3(T[1], T[2], 0.0), T[3], T[4], len(poses)
    r2, up = (s * s + c * c) or 1.0, Vec3(0.0, 0.0, 1.0)
    by_T = AG.copy()
    for r in range(len(J)):
        by_T[r, 1] = AG[r, 1] * R_T.x.x + AG[r, 2] * R_T.y.x
        by_T[r, 2] = AG[r, 1] * R_T.x.y + AG[r, 2] * R_T.y.y
    for i in range(n):  # T moves them the other way
        (R, p), (R_0, _) = pose(poses[i]), pose(poses_0[i])
        R_Y, p_Y = R_T.T @ R, R_T.T @ (p - p_T)
        by_R, by_p = turn_from(R_0, R_Y)[1].T, R_Y.T @ R_0
        lever = R_Y.T @ cross(up, p_Y)
        for r in range(len(J)):
            a, b = by_R @ vec(J[r, 6 * i :]), by_p @ vec(J[r, 6 * i + 3 :])
            by_T[r, 0] -= a @ R_Y.z + b @ lever
            by_T[r, 1], by_T[r, 2] = by_T[r, 1] - b @ R_Y.x, by_T[r, 2] - b @ R_Y.y
            put(a, J, r, 6 * i)
            put(b, J, r, 6 * i + 3)
    for i in range(len(points)):
        q, k = R_T.T @ (vec(points[i]) - p_T), 6 * n + 3 * i
        for r in range(len(J)):
            a = vec(J[r, k:])
            by_T[r, 0] -= a.y * q.x - a.x * q.y
            by_T[r, 1], by_T[r, 2] = by_T[r, 1] - a.x, by_T[r, 2] - a.y
            put(R_T @ a, J, r, k)
    for i in range(n + len(points)):  # they move T
        ax, ay = arms[i, 0], arms[i, 1]
        turns = Vec3(-(c * ay + s * ax) / r2, (c * ax - s * ay) / r2, 0.0)
        in_x, in_y = shares[i] * Vec3(R_T.x.x, R_T.y.x, 0.0), shares[i] * Vec3(R_T.x.y, R_T.y.y, 0.0)
        k = 6 * i + 3 if i < n else 6 * n + 3 * (i - n)
        if i < n:
            R = pose(poses[i])[0]
            turns, in_x, in_y = R.T @ turns, R.T @ in_x, R.T @ in_y
            yaw_rad, by_turn = yaw_from(pose(poses_0[i])[0], R)
            by_turn = (by_yaw[i] * (c * math.cos(yaw_rad) + s * math.sin(yaw_rad)) / r2) * by_turn
            for r in range(len(J)):
                put(vec(J[r, 6 * i :]) + by_T[r, 0] * by_turn, J, r, 6 * i)
        for r in range(len(J)):
            put(vec(J[r, k:]) + by_T[r, 0] * turns + by_T[r, 1] * in_x + by_T[r, 2] * in_y, J, r, k)
    return by_T


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
        self.keys, self.A, self.b = list(keys), np.asfortranarray(A), b
        self._poses = [key for key in keys if is_pose(key)]
        self._points = [key for key in keys if is_landmark(key)]
        self._biases = self.keys[len(self._poses) + len(self._points) :]
        self._biases_0 = [values.atVector(key) for key in self._biases]
        self._columns = np.cumsum([0, *map(tangent_size, self.keys)]).tolist()
        poses, points = self._at(values)
        n, end = len(poses), 6 * len(poses) + 3 * len(points)
        R_0, by_pose = poses[:, :9].reshape(n, 3, 3), A[:, : 6 * n].reshape(len(A), n, 2, 3)
        # how well each yaw and position in the plane is known when all others are
        by_yaw = np.square(np.einsum("rni,ni->rn", by_pose[:, :, 0], R_0[:, 2])).sum(axis=0)
        in_plane = np.einsum("rni,nki->knr", by_pose[:, :, 1], R_0[:, :2])
        x, y = np.concatenate((in_plane, A[:, 6 * n : end].reshape(len(A), len(points), 3).T[:2]), axis=1)
        xx, yy, xy = np.vecdot(x, x), np.vecdot(y, y), np.vecdot(x, y)
        weights = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)  # of the direction that is known least
        total = weights.sum() if n else 0.0
        shares = weights / total if total > 0.0 else 0.0 * weights
        positions = np.vstack((poses[:, 9:], points))
        start_m = np.append(shares @ positions[:, :2], 0.0)
        arms = total * shares[:, None] * (positions - start_m)[:, :2]
        self._start_m, self._points_0 = start_m, points - start_m
        poses_0 = np.hstack((poses[:, :9], poses[:, 9:] - start_m))
        self._fit = poses_0, by_yaw, shares, arms
        T = level_frame(poses, points, *self._fit)
        self._AG = -differentiate(self.A.copy("F"), np.zeros((len(A), 3)), poses, points, *self._fit, T)
        self._is_absolute = bool(np.linalg.norm(self._AG) > ROUNDING * np.linalg.norm(A))

    def factor(self) -> gtsam.NonlinearFactor:
        """The factor that GTSAM uses."""
        noise = gtsam.noiseModel.Unit.Create(len(self.b))
        return gtsam.CustomFactor(noise, self.keys, self._error)

    def _at(self, values: gtsam.Values) -> tuple[Floats, Floats]:
        """Poses, as rows of R, and p, shape (n, 12), and landmarks, shape (m, 3)."""
        poses = np.array([pose_row(values.atPose3(key)) for key in self._poses]).reshape(-1, 12)
        return poses, np.array([values.atPoint3(key) for key in self._points]).reshape(-1, 3)

    def _xi(self, values: gtsam.Values, poses: Floats, points: Floats, T: Floats) -> Floats:
        biases = [values.atVector(key) - start for key, start in zip(self._biases, self._biases_0, strict=True)]
        return np.concatenate((perturbations(poses, points, self._fit[0], self._points_0, T), *biases))

    def deviation(self, values: gtsam.Values) -> tuple[Floats, gtsam.Pose3]:
        """Perturbations xi in the moved frame, in the order of the keys, and the motion of the frame."""
        poses, points = self._at(values)
        T = level_frame(poses, points, *self._fit)
        motion = gtsam.Pose3(gtsam.Rot3.Rz(T[0]), np.array([T[1], T[2], 0.0]))
        return self._xi(values, poses, points, T), motion.compose(gtsam.Pose3(gtsam.Rot3(), -self._start_m))

    def change_of_shape(self, values: gtsam.Values) -> float:
        """Largest perturbation of a pose or landmark in the moved frame, rad or m; of an absolute one its turn, too."""
        n = 6 * len(self._poses) + 3 * len(self._points)
        xi, motion = self.deviation(values)
        turn_rad = abs(motion.rotation().yaw()) if self._is_absolute else 0.0
        return max(turn_rad, float(np.abs(xi[:n]).max(initial=0.0)))

    def _error(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        poses, points = self._at(values)
        T = level_frame(poses, points, *self._fit)
        if jacobians is not None:
            J = self.A.copy("F")
            differentiate(J, self._AG, poses, points, *self._fit, T)
            for i, (first, end) in enumerate(pairwise(self._columns)):
                jacobians[i] = J[:, first:end]
        xi_T = np.array([T[0], T[1] - self._start_m[0], T[2] - self._start_m[1]])
        return self.A @ self._xi(values, poses, points, T) + self._AG @ xi_T - self.b
