"""Range and azimuth whose noises are correlated, as one factor, and all such factors of a graph at once.

``e = h(X, L) - z ~ N(0, R)``, azimuth wrapped, with h and its derivatives as in `sonar_graph.models.sonar`. GTSAM
has no compiled factor of it. One evaluation in Python takes as long as many compiled ones, so that a solution of
thousands asks for all of them together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.models import project_points, view_points, wrap_angle
from sonar_graph.slam.odometry_arrays import poses_of

UNIT = gtsam.noiseModel.Unit.Create(2)


class SightingError:
    """Error of one such factor, as GTSAM asks for it."""

    __slots__ = ("body_T_sonar", "by_body", "keys", "z")

    def __init__(self, keys: tuple[int, int], body_T_sonar: gtsam.Pose3, z: Floats) -> None:
        self.keys, self.body_T_sonar, self.z = keys, body_T_sonar, z
        self.by_body = body_T_sonar.inverse().AdjointMap()

    def __call__(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        """Error, shape (2,), m and rad."""
        world_T_sonar = values.atPose3(self.keys[0]).compose(self.body_T_sonar)
        (predicted,), (by_sonar,), (by_landmark,) = view_points(world_T_sonar, values.atPoint3(self.keys[1])[None])
        if jacobians is not None:
            jacobians[0], jacobians[1] = by_sonar @ self.by_body, by_landmark
        return np.array([predicted[0] - self.z[0], wrap_angle(predicted[1] - self.z[1])])


class Evaluated(NamedTuple):
    """Expected range and azimuth of n sightings."""

    z: Floats
    """Shape (n, 2), m and rad."""
    D_q: Floats
    """Derivative by q, shape (n, 2, 3)."""
    q: Floats
    """The landmarks in the sonars' axes, shape (n, 3), m."""
    world_R_sonar: Floats
    """Shape (n, 3, 3)."""


class SightingStack:
    """Many `CorrelatedSighting` as arrays (`batch_solution.Stack`); the same numbers to rounding."""

    def __init__(self, factors: Sequence[CorrelatedSighting]) -> None:
        laws = [factor.law for factor in factors]
        self._keys = [law.keys for law in laws]
        self._pose_keys = np.array([law.keys[0] for law in laws], np.uint64)
        self._landmark_keys = sorted({law.keys[1] for law in laws})
        self._landmarks = np.searchsorted(self._landmark_keys, [law.keys[1] for law in laws])
        sonars = np.array([law.body_T_sonar.matrix() for law in laws])
        self._body_R_sonar, self._body_p_sonar = sonars[:, :3, :3], sonars[:, :3, 3]
        self._by_body = np.array([law.by_body for law in laws])
        self._z = np.array([law.z for law in laws])
        noises: list[Any] = [factor.noiseModel() for factor in factors]
        robust = [isinstance(noise, gtsam.noiseModel.Robust) for noise in noises]
        self._kernels = [noise.robust() for noise, has in zip(noises, robust, strict=True) if has]
        self._robust = np.flatnonzero(robust)
        plain = [noise.noise() if has else noise for noise, has in zip(noises, robust, strict=True)]
        self._whitening = np.array([noise.R() for noise in plain])

    def error(self, values: gtsam.Values) -> float:
        """Sum of the kernels' losses."""
        e, distances = self._whitened(self._missed(self._evaluated(values).z))
        losses = 0.5 * np.vecdot(e, e)
        losses[self._robust] = [kernel.loss(d) for kernel, d in zip(self._kernels, distances, strict=True)]
        return float(losses.sum())

    def linear_factors(self, values: gtsam.Values) -> list[gtsam.JacobianFactor]:
        """What linearising each of them gives, with the kernels' weights."""
        z, D_q, q, world_R_sonar = self._evaluated(values)
        e, distances = self._whitened(self._missed(z))
        weights = [kernel.weight(d) for kernel, d in zip(self._kernels, distances, strict=True)]
        root = np.ones((len(e), 1))
        root[self._robust, 0] = np.sqrt(weights)
        D_q = root[..., None] * self._whitening @ D_q  # whitened, with the kernels' weights
        crosses = -np.cross(q[:, None, :], np.eye(3))
        by_pose = np.concatenate((D_q @ crosses, -D_q), axis=2) @ self._by_body
        by_landmark = D_q @ world_R_sonar.transpose(0, 2, 1)
        make = gtsam.JacobianFactor
        return [
            make(pose, A_pose, landmark, A_landmark, rhs, UNIT)
            for (pose, landmark), A_pose, A_landmark, rhs in zip(
                self._keys, by_pose, by_landmark, -root * e, strict=True
            )
        ]

    def _evaluated(self, values: gtsam.Values) -> Evaluated:
        """Every sighting at these values."""
        poses = poses_of(values, self._pose_keys)
        R, p = poses[:, :9].reshape(-1, 3, 3), poses[:, 9:]
        world_R_sonar = R @ self._body_R_sonar
        points = np.array([values.atPoint3(key) for key in self._landmark_keys])[self._landmarks]
        q = times(world_R_sonar.transpose(0, 2, 1), points - p - times(R, self._body_p_sonar))
        z, D_q = project_points(np.ascontiguousarray(q))
        return Evaluated(z, D_q, q, world_R_sonar)

    def _missed(self, z: Floats) -> Floats:
        """Expected minus measured range and azimuth, shape (n, 2)."""
        e = z - self._z
        e[:, 1] = wrap_angle(e[:, 1])
        return e

    def _whitened(self, e: Floats) -> tuple[Floats, list[float]]:
        """Whitened errors, and the lengths of those that have a kernel."""
        e = times(self._whitening, e)
        return e, np.linalg.norm(e[self._robust], axis=1).tolist()


class CorrelatedSighting(gtsam.CustomFactor):
    """Range (m) and azimuth (rad) of a landmark, ``z``, shape (2,), with their noise, robust or not."""

    __slots__ = ("law",)
    Stack: ClassVar = SightingStack

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


def times(matrices: Floats, vectors: Floats) -> Floats:
    """Product of each matrix with its vector."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])
