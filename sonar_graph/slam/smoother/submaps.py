"""Submaps: stretches of keyframes, marginalised onto what they share with the rest, in a frame that moves with them.

A submap is the marginal of its factors on its first and last keyframe, its landmarks and biases: with the interior
keyframes eliminated, ``|A delta - b|²`` of the perturbations of those from where they were linearised
(docs/theory/isam2.md). Sonar, odometry, depth and gravity say nothing of where in the plane a submap lies or which way
it heads. So the marginal is taken in the frame T of its first keyframe (yaw and horizontal position, level)::

    xi_pose of Y = T^-1 X: `turn_from`         xi_landmark = T^-1 l - (T^-1 l)_0        xi_T = (yaw, x, y) - their start
    error = A xi + A G xi_T - b,               G: perturbations by a rigid motion, in the plane, of all of it

G is in the null space of A unless some factor is absolute. A submap that turns and moves as a whole, as when a loop is
closed, therefore stays exact: what is frozen is its shape, and that is known much better than its place. Least known of
the shape is how much it winds, by which what gravity tells of its tilt must not change either.
"""

import math
from collections.abc import Sequence

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.batch_solution import is_pose, tangent_size

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
    """Marginal of a submap on its separator, in the level frame of its first keyframe.

    Parameters
    ----------
    keys
        Variables of the separator; the first is the pose that carries the frame T, of yaw 0 where it was linearised.
    A, b
        Whitened rows of the marginal, by perturbations of these variables in the order of the keys.
    values
        Where it was linearised.
    """

    def __init__(self, keys: Sequence[int], A: Floats, b: Floats, values: gtsam.Values) -> None:
        self.keys = list(keys)
        self.b = b
        self._R_start = values.atPose3(keys[0]).rotation().matrix()
        self._start_m = self._frame(values).translation()
        self._poses = list(filter(is_pose, self.keys))
        self._points = [key for key in self.keys if gtsam.symbolChr(key) == ord("l")]
        self._others = [key for key in self.keys if key not in self._poses and key not in self._points]
        columns, n = {}, 0
        for key in self.keys:
            columns[key] = slice(n, n + tangent_size(key))
            n += tangent_size(key)
        self._local = [gtsam.Pose3(gtsam.Rot3(), -self._start_m).compose(values.atPose3(key)) for key in self._poses]
        self._rotations = [Y.rotation().matrix() for Y in self._local]
        self._A_poses = [A[:, columns[key]] for key in self._poses]
        self._A_points = np.hstack([np.zeros((len(A), 0)), *(A[:, columns[key]] for key in self._points)])
        self._A_points_x, self._A_points_y = self._A_points[:, 0::3].copy(), self._A_points[:, 1::3].copy()
        points = np.array([values.atPoint3(key) for key in self._points]).reshape(-1, 3)
        self._points_0 = points - self._start_m
        self._A_others = [A[:, columns[key]] for key in self._others]
        self._others_0 = [values.atVector(key) for key in self._others]
        self._A_all = np.hstack([*self._A_poses, self._A_points, *self._A_others])
        G = [Y.inverse().AdjointMap() @ TWIST for Y in self._local]
        self._A_rigid = self._by_motion(self._points_0)
        for A_k, G_k in zip(self._A_poses, G, strict=True):
            self._A_rigid = self._A_rigid + A_k @ G_k
        self.order = self._poses + self._points + self._others
        """Order of the variables in the factor."""

    def factor(self) -> gtsam.NonlinearFactor:
        """The factor that GTSAM uses."""
        noise = gtsam.noiseModel.Unit.Create(len(self.b))
        return gtsam.CustomFactor(noise, self.order, self._error)

    def motion(self, values: gtsam.Values) -> gtsam.Pose3:
        """Motion of the frame from where it was."""
        return self._frame(values).compose(gtsam.Pose3(gtsam.Rot3(), -self._start_m))

    def _frame(self, values: gtsam.Values) -> gtsam.Pose3:
        """Frame T: yaw and horizontal position of the first keyframe."""
        pose = values.atPose3(self.keys[0])
        x, y, _ = pose.translation()
        yaw_rad, _ = yaw_from(self._R_start, pose.rotation().matrix())
        return gtsam.Pose3(gtsam.Rot3.Rz(yaw_rad), np.array([x, y, 0.0]))

    def deviation(self, values: gtsam.Values) -> tuple[Floats, Floats, gtsam.Pose3]:
        """Perturbations in the moved frame, of the frame itself, and the frame."""
        frame = self._frame(values)
        inverse, R = frame.inverse(), frame.rotation().matrix()
        parts = []
        for Y0, R0, key in zip(self._local, self._rotations, self._poses, strict=True):
            Y = inverse.compose(values.atPose3(key))
            parts.append(turn_from(R0, Y.rotation().matrix())[0])
            parts.append(Y0.rotation().unrotate(Y.translation() - Y0.translation()))
        if self._points:
            points = np.array([values.atPoint3(key) for key in self._points])
            parts.append(((points - frame.translation()) @ R - self._points_0).ravel())
        parts += [values.atVector(key) - start for key, start in zip(self._others, self._others_0, strict=True)]
        moved_m = frame.translation() - self._start_m
        return np.concatenate(parts), np.array([math.atan2(R[1, 0], R[0, 0]), moved_m[0], moved_m[1]]), frame

    def step(self, values: gtsam.Values) -> gtsam.VectorValues:
        """Perturbations in the moved frame, as GTSAM's steps from where it was linearised."""
        xi, _, _ = self.deviation(values)
        step, n = gtsam.VectorValues(), 0
        for key in self.order:
            step.insert(key, xi[n : n + tangent_size(key)])
            n += tangent_size(key)
        return step

    def _error(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        xi, rigid, frame = self.deviation(values)
        if jacobians is not None:
            inverse, R = frame.inverse(), frame.rotation().matrix()
            by_frame = self._A_rigid.copy()
            by_frame[:, 1:] = self._A_rigid[:, 1:] @ R[:2, :2]
            for i, (A_k, key) in enumerate(zip(self._A_poses, self._poses, strict=True)):
                Y, Y0, D = inverse.compose(values.atPose3(key)), self._local[i], np.zeros((6, 6))
                D[:3, :3] = turn_from(self._rotations[i], Y.rotation().matrix())[1]
                D[3:, 3:] = Y0.rotation().between(Y.rotation()).matrix()
                jacobians[i] = A_k @ D
                by_frame -= jacobians[i] @ (Y.inverse().AdjointMap() @ TWIST)
            n, m = len(self._poses), len(self._points)
            by_frame -= self._by_motion(xi[6 * n : 6 * n + 3 * m].reshape(-1, 3) + self._points_0)
            by_points = (self._A_points.reshape(-1, 3) @ R.T).reshape(self._A_points.shape)
            for i in range(m):
                jacobians[n + i] = by_points[:, 3 * i : 3 * i + 3]
            for i, A_k in enumerate(self._A_others, n + m):
                jacobians[i] = A_k
            first, of_frame = values.atPose3(self.keys[0]).rotation().matrix(), np.zeros((3, 6))
            of_frame[0, :3], of_frame[1:, 3:] = yaw_from(self._R_start, first)[1], R.T[:2] @ first
            jacobians[0] = jacobians[0] + by_frame @ of_frame
        return self._A_all @ xi + self._A_rigid @ rigid - self.b

    def _by_motion(self, points: Floats) -> Floats:
        """Derivative of the error of landmarks by a rigid motion in the plane (yaw, x, y) of all of them."""
        by_yaw = self._A_points_y @ points[:, 0] - self._A_points_x @ points[:, 1]
        return np.column_stack([by_yaw, self._A_points_x.sum(axis=1), self._A_points_y.sum(axis=1)])
