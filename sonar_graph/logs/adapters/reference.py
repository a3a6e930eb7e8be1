"""Reference poses of the body."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation as SpatialRotation

from sonar_graph.logs.adapters.adapter import Adapter
from sonar_graph.logs.adapters.axes import World, axes_matrix, world_matrix
from sonar_graph.logs.pose_covariance import ros_to_body
from sonar_graph.logs.table import NOT_FINITE, Dropped, Table, fit_rows, not_finite
from sonar_graph.measurements import Floats
from sonar_graph.states import Trajectory


class TruthAdapter(Adapter):
    """Poses of the body; a twist is not used.

    From the driver's world and body (axes ``w`` and ``b``) to ours: ``R = enu_R_w w_R_b ours_R_b^T``.
    """

    frame_id_field: str | None = None
    position: tuple[str, str, str]
    """Fields of x, y, z in the world."""
    orientation: tuple[str, str, str, str]
    """Fields of the quaternion's x, y, z, w."""
    covariance: str | None = None
    """Array field of 36: position, then rotation, along the world's axes, as ROS has it."""
    covariance_meaning: Literal["variance", "standard deviation"] = "variance"
    """"variance", or "standard deviation" where the driver puts those on the diagonal."""
    world: World = "enu"
    """"enu" (any world with z up), or "ned"."""

    def fields(self) -> Iterator[str]:
        """Paths that a message must have."""
        yield from (*self.position, *self.orientation)
        yield from filter(None, (self.covariance,))

    def read(self, table: Table) -> tuple[Trajectory | None, Dropped]:
        """Poses with covariances; NaN: unknown."""
        positions, quaternions = table.beside(self.position), table.beside(self.orientation)
        lengths = np.linalg.norm(quaternions, axis=1)
        faults = {NOT_FINITE: not_finite(positions, quaternions), "without an orientation": lengths < 0.5}
        rows, dropped = fit_rows(table.stamps_ns, faults, unique=True)
        if not rows.size:
            return None, dropped
        scale = np.where(np.abs(lengths - 1) > 1e-6, lengths, 1.0)  # what is of unit length stays as it is to the bit
        quaternions = (quaternions / scale[:, None])[rows]
        truth = Trajectory.without_covariances(table.stamps_ns[rows], *self._in_our_axes(positions[rows], quaternions))
        covariances = self._covariances(table)[rows]
        covariances = ros_to_body(covariances, truth.matrices)
        return Trajectory(truth.stamps_ns, truth.positions, truth.quaternions_xyzw, covariances), dropped

    def _in_our_axes(self, positions: Floats, quaternions: Floats) -> tuple[Floats, Floats]:
        if self.world == "enu" and self.rotation == "flu":
            return positions, quaternions
        W, B = world_matrix(self.world), axes_matrix(self.rotation)
        turned = SpatialRotation.from_matrix(W @ SpatialRotation.from_quat(quaternions).as_matrix() @ B.T)
        return positions @ W.T, turned.as_quat()

    def _covariances(self, table: Table) -> Floats:
        if self.covariance is None:
            return np.full((len(table), 6, 6), np.nan)
        covariances = table.column(self.covariance)
        if covariances.shape[1:] != (36,):
            table.refuse(self.covariance, "is no array of 36 numbers")
        covariances = covariances.reshape(-1, 6, 6)
        if self.covariance_meaning == "standard deviation":
            covariances = np.where(covariances < 0, covariances, covariances**2) * np.eye(6)
        if self.world != "enu":
            W = np.kron(np.eye(2), world_matrix(self.world))
            covariances = W @ covariances @ W.T
        return covariances
