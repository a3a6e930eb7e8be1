"""Range and azimuth whose noises are correlated, as one factor, and all such factors of a graph at once.

``e = h(X, L) - z ~ N(0, R)``, azimuth wrapped, with h and its derivatives as in `sonar_graph.models.sonar`. GTSAM
has no compiled factor of it. It calls Python once for each factor, which takes as long as many compiled ones, so that a
solution of thousands evaluates them together (`SightingStack`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats
from sonar_graph.models import project_points, view_points, wrap_angle

UNIT = gtsam.noiseModel.Unit.Create(2)


class SightingError:
    """Error of one factor, called by GTSAM."""

    __slots__ = ("body_T_sonar", "by_body", "keys", "z")

    def __init__(self, keys: tuple[int, int], body_T_sonar: gtsam.Pose3, z: Floats) -> None:
        self.keys = keys
        self.z = z
        self.body_T_sonar = body_T_sonar
        self.by_body = body_T_sonar.inverse().AdjointMap()

    def __call__(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        """Error, shape (2,), m and rad."""
        pose_key, landmark_key = self.keys
        world_T_sonar = values.atPose3(pose_key).compose(self.body_T_sonar)
        view = view_points(world_T_sonar, values.atPoint3(landmark_key)[None])
        if jacobians is not None:
            jacobians[0] = view.by_sonar[0] @ self.by_body
            jacobians[1] = view.by_point[0]
        e = view.z[0] - self.z
        e[1] = wrap_angle(e[1])
        return e


class CorrelatedSighting(gtsam.CustomFactor):
    """Range (m) and azimuth (rad) of a landmark, ``z``, shape (2,), with their noise, robust or not."""

    __slots__ = ("law",)
    Stack: ClassVar[type[SightingStack]]

    def __init__(
        self,
        pose_key: int,
        landmark_key: int,
        body_T_sonar: gtsam.Pose3,
        z: Floats,
        noise: gtsam.noiseModel.Base,
    ) -> None:
        self.law = SightingError((pose_key, landmark_key), body_T_sonar, z)
        super().__init__(noise, [pose_key, landmark_key], self.law)


class SightingViews(NamedTuple):
    """Landmarks as n sonars see them."""

    world_R_sonar: Floats
    """Shape (n, 3, 3)."""
    q: Floats
    """The landmarks in the sonars' axes, shape (n, 3), m."""
    D_q: Floats
    """Derivative of range and azimuth by q, shape (n, 2, 3)."""
    e: Floats
    """Whitened errors, shape (n, 2)."""
    lengths: list[float]
    """Lengths of those that have a kernel."""


class SightingStack:
    """Many `CorrelatedSighting` as arrays (`batch_solution.Stack`); the same numbers to rounding."""

    def __init__(self, factors: Sequence[CorrelatedSighting]) -> None:
        laws = [factor.law for factor in factors]
        sonars = np.array([law.body_T_sonar.matrix() for law in laws])
        self._keys = [law.keys for law in laws]
        self._pose_keys = np.array([law.keys[0] for law in laws], np.uint64)
        self._landmark_keys = sorted({law.keys[1] for law in laws})
        self._landmark_of = np.searchsorted(self._landmark_keys, [law.keys[1] for law in laws])
        self._body_R_sonar = sonars[:, :3, :3]
        self._body_p_sonar = sonars[:, :3, 3]
        self._by_body = np.array([law.by_body for law in laws])
        self._z = np.array([law.z for law in laws])
        noises: list[Any] = [factor.noiseModel() for factor in factors]
        is_robust = [isinstance(noise, gtsam.noiseModel.Robust) for noise in noises]
        self._robust = np.flatnonzero(is_robust)
        self._kernels = [noises[k].robust() for k in self._robust]
        plain = [noise.noise() if robust else noise for noise, robust in zip(noises, is_robust, strict=True)]
        self._whitening = np.array([noise.R() for noise in plain])

    def error(self, values: gtsam.Values) -> float:
        """Sum of the kernels' losses."""
        view = self._views(values)
        losses = 0.5 * np.vecdot(view.e, view.e)
        losses[self._robust] = [kernel.loss(d) for kernel, d in zip(self._kernels, view.lengths, strict=True)]
        return float(losses.sum())

    def linear_factors(self, values: gtsam.Values) -> list[gtsam.JacobianFactor]:
        """Each factor, linearised, with the weight of its kernel."""
        view = self._views(values)
        # a robust kernel multiplies rows and residuals by the root of its weight
        root = np.ones((len(view.e), 1))
        weights = [kernel.weight(d) for kernel, d in zip(self._kernels, view.lengths, strict=True)]
        root[self._robust, 0] = np.sqrt(weights)
        D_q = root[..., None] * self._whitening @ view.D_q
        q_x = -np.cross(view.q[:, None, :], np.eye(3))  # [q]x
        by_pose = np.concatenate((D_q @ q_x, -D_q), axis=2) @ self._by_body
        by_landmark = D_q @ view.world_R_sonar.transpose(0, 2, 1)
        return [
            gtsam.JacobianFactor(pose, A_pose, landmark, A_landmark, rhs, UNIT)
            for (pose, landmark), A_pose, A_landmark, rhs in zip(
                self._keys, by_pose, by_landmark, -root * view.e, strict=True
            )
        ]

    def _views(self, values: gtsam.Values) -> SightingViews:
        """Every sighting at these values."""
        poses = poses_of(values, self._pose_keys)
        R = poses[:, :9].reshape(-1, 3, 3)
        world_R_sonar = R @ self._body_R_sonar
        world_p_sonar = poses[:, 9:] + times(R, self._body_p_sonar)
        points = np.array([values.atPoint3(key) for key in self._landmark_keys])[self._landmark_of]
        q = times(world_R_sonar.transpose(0, 2, 1), points - world_p_sonar)
        # the same model as `view_points`, for sonars of different poses
        predicted, D_q = project_points(np.ascontiguousarray(q))
        e = predicted - self._z
        e[:, 1] = wrap_angle(e[:, 1])
        e = times(self._whitening, e)
        return SightingViews(world_R_sonar, q, D_q, e, np.linalg.norm(e[self._robust], axis=1).tolist())


CorrelatedSighting.Stack = SightingStack


def times(matrices: Floats, vectors: Floats) -> Floats:
    """Product of each matrix with its vector."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def poses_of(values: gtsam.Values, keys: NDArray[np.uint64]) -> Floats:
    """Poses of a graph by the keys of keyframes, shape (...): rows of R, and p, shape (..., 12)."""
    known = np.fromiter(values.keys(), np.uint64)
    poses = np.asarray(gtsam.utilities.extractPose3(values))  # by ascending key
    return poses[np.searchsorted(known[known >> np.uint64(56) == ord("x")], keys)]
