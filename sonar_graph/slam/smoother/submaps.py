"""Submaps: stretches of keyframes, marginalised onto what they share with the rest, in a frame that moves with them.

A submap is the marginal of its factors on its first and last keyframe, its landmarks and biases: with the interior
keyframes eliminated, ``|A delta - b|²`` of the perturbations of those from where they were linearised
(docs/theory/isam2.md). Sonar, odometry, depth and gravity say nothing of where in the plane a submap lies or which way
it heads. So the marginal is taken in the frame T of its first keyframe (yaw and horizontal position, level)::

    xi_pose of Y = T^-1 X: `Attitude`          xi_landmark = T^-1 l - (T^-1 l)_0        xi_T = (yaw, x, y) - their start
    error = A xi + A G xi_T - b,               G: perturbations by a rigid motion, in the plane, of all of it

G is in the null space of A unless some factor is absolute. A submap that turns and moves as a whole, as when a loop is
closed, therefore stays exact: what is frozen is its shape, and that is known much better than its place. Least known of
the shape is how much it winds, by which what gravity tells of its tilt must not change either.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.batch_solution import is_pose, tangent_size


def level_yaw(R: Floats) -> tuple[float, Floats]:
    """Yaw of the turn about the vertical nearest to a rotation, and its derivative by a perturbation, shape (3,)."""
    (r00, r01, r02), (r10, r11, r12), _ = R.tolist()
    s, c = r10 - r01, r00 + r11
    n = s * s + c * c
    return math.atan2(s, c), np.array([(-c * r02 - s * r12) / n, (s * r02 - c * r12) / n, 1.0])


def level_frame(pose: gtsam.Pose3) -> gtsam.Pose3:
    """Yaw and horizontal position of a pose."""
    x, y, _ = pose.translation()
    return gtsam.Pose3(gtsam.Rot3.Rz(level_yaw(pose.rotation().matrix())[0]), np.array([x, y, 0.0]))


def level_frame_jacobian(pose: gtsam.Pose3, frame: gtsam.Pose3) -> Floats:
    """Derivative of yaw and horizontal position, in the frame, by the perturbation of the pose, shape (3, 6)."""
    R, J = pose.rotation().matrix(), np.zeros((3, 6))
    J[0, :3] = level_yaw(R)[1]
    J[1:, 3:] = frame.rotation().matrix().T[:2] @ R
    return J


I3, TWIST = np.eye(3), np.eye(6)[:, 2:5]
"""Identity, and tangent directions of poses in which a level frame moves: yaw, x, y."""


class Attitude:
    """Rotation, as its yaw and its tilt."""

    def __init__(self, R: gtsam.Rot3) -> None:
        matrix = R.matrix()
        self.yaw_rad, self.by_turn = level_yaw(matrix)
        self.tilt = gtsam.Rot3.Rz(-self.yaw_rad).compose(R)
        self.up = matrix[2]

    def turn_to(self, after: Attitude) -> tuple[Floats, Floats]:
        """Turn to another rotation in the axes of this one, shape (3,), and its derivative by a perturbation of that.

        Log between the tilts, and the yaw about the vertical, added up: to first order Log between the rotations, which
        takes one tilt for another after a turn about the vertical.
        """
        tilt = gtsam.Rot3.Logmap(self.tilt.between(after.tilt))
        by_tilt = gtsam.Rot3.LogmapDerivative(tilt).dot(I3 - after.up[:, None] * after.by_turn)
        yaw_rad = math.remainder(after.yaw_rad - self.yaw_rad, 2.0 * math.pi)
        return tilt + yaw_rad * self.up, by_tilt + self.up[:, None] * after.by_turn


class SubmapFactor:
    """Marginal of a submap on its separator, in the level frame of its first keyframe.

    Parameters
    ----------
    keys
        Variables of the separator; the first is the pose that carries the frame.
    A, b
        Whitened rows of the marginal, by perturbations of these variables in the order of the keys.
    values
        Where it was linearised.
    """

    def __init__(self, keys: Sequence[int], A: Floats, b: Floats, values: gtsam.Values) -> None:
        self.keys = list(keys)
        self.b = b
        self._start = level_frame(values.atPose3(keys[0]))
        self._inverse_start = self._start.inverse()
        self._poses = list(filter(is_pose, self.keys))
        self._points = [key for key in self.keys if gtsam.symbolChr(key) == ord("l")]
        self._others = [key for key in self.keys if key not in self._poses and key not in self._points]
        columns, n = {}, 0
        for key in self.keys:
            columns[key] = slice(n, n + tangent_size(key))
            n += tangent_size(key)
        R0 = self._start.rotation().matrix()
        self._local = [self._inverse_start.compose(values.atPose3(key)) for key in self._poses]
        self._attitudes = [Attitude(Y.rotation()) for Y in self._local]
        self._A_poses = [A[:, columns[key]] for key in self._poses]
        self._A_points = np.hstack([np.zeros((len(A), 0)), *(A[:, columns[key]] @ R0 for key in self._points)])
        self._A_points_x, self._A_points_y = self._A_points[:, 0::3].copy(), self._A_points[:, 1::3].copy()
        points = np.array([values.atPoint3(key) for key in self._points]).reshape(-1, 3)
        self._points_0 = (points - self._start.translation()) @ R0
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
        return level_frame(values.atPose3(self.keys[0])).compose(self._inverse_start)

    def deviation(self, values: gtsam.Values) -> tuple[Floats, Floats, gtsam.Pose3]:
        """Perturbations in the moved frame, of the frame itself, and the frame."""
        frame = level_frame(values.atPose3(self.keys[0]))
        inverse, R = frame.inverse(), frame.rotation().matrix()
        parts = []
        for Y0, attitude, key in zip(self._local, self._attitudes, self._poses, strict=True):
            Y = inverse.compose(values.atPose3(key))
            parts.append(attitude.turn_to(Attitude(Y.rotation()))[0])
            parts.append(Y0.rotation().unrotate(Y.translation() - Y0.translation()))
        if self._points:
            points = np.array([values.atPoint3(key) for key in self._points])
            parts.append(((points - frame.translation()) @ R - self._points_0).ravel())
        parts += [values.atVector(key) - start for key, start in zip(self._others, self._others_0, strict=True)]
        rigid = gtsam.Pose3.Logmap(self._inverse_start.compose(frame))
        moved_m = self._inverse_start.transformFrom(frame.translation())
        return np.concatenate(parts), np.array([rigid[2], moved_m[0], moved_m[1]]), frame

    def step(self, values: gtsam.Values) -> gtsam.VectorValues:
        """Perturbations in the moved frame, as GTSAM's steps from where it was linearised."""
        xi, _, _ = self.deviation(values)
        R, step, n = self._start.rotation().matrix(), gtsam.VectorValues(), 0
        for key in self.order:
            part = xi[n : n + tangent_size(key)]
            step.insert(key, R @ part if key in self._points else part)
            n += len(part)
        return step

    def _error(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        xi, rigid, frame = self.deviation(values)
        if jacobians is not None:
            inverse, R = frame.inverse(), frame.rotation().matrix()
            turned = self._start.rotation().matrix().T @ R
            by_frame = self._A_rigid.copy()
            by_frame[:, 1:] = self._A_rigid[:, 1:] @ turned[:2, :2]
            for i, (A_k, key) in enumerate(zip(self._A_poses, self._poses, strict=True)):
                Y, Y0, D = inverse.compose(values.atPose3(key)), self._local[i], np.zeros((6, 6))
                D[:3, :3] = self._attitudes[i].turn_to(Attitude(Y.rotation()))[1]
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
            jacobians[0] = jacobians[0] + by_frame @ level_frame_jacobian(values.atPose3(self.keys[0]), frame)
        return self._A_all @ xi + self._A_rigid @ rigid - self.b

    def _by_motion(self, points: Floats) -> Floats:
        """Derivative of the error of landmarks by a rigid motion in the plane (yaw, x, y) of all of them."""
        by_yaw = self._A_points_y @ points[:, 0] - self._A_points_x @ points[:, 1]
        return np.column_stack([by_yaw, self._A_points_x.sum(axis=1), self._A_points_y.sum(axis=1)])
