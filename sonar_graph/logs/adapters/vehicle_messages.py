"""Inertial measurements.

Depth: from pressure, or from anything that gives a height or a depth in metres.

Reference poses of the body.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation as SpatialRotation

from sonar_graph.logs.adapters.adapter import (
    Adapter,
    CovarianceFields,
    Scale,
    World,
    axes_matrix,
    ros_to_body,
    turn,
    world_matrix,
)
from sonar_graph.logs.message_table import NOT_FINITE, Dropped, MessageTable, fit_rows, not_finite
from sonar_graph.measurements import Depth, Floats, Imu
from sonar_graph.states import Trajectory

Paths = tuple[str, str, str]


class ImuAdapter(Adapter):
    """Angular rate and specific force."""

    angular_velocity: Paths
    """Fields of the rates about x, y, z."""
    angular_velocity_scale: Scale = 1.0
    """Turns them into rad/s; 0.017453292519943295 from degrees."""
    angular_velocity_status: str | None = None
    """Field that is -1 where the rate was not measured."""
    linear_acceleration: Paths
    """Fields of the specific force along x, y, z: what accelerometers feel, +9.81 upwards at rest."""
    linear_acceleration_scale: Scale = 1.0
    """Turns them into m/s²; 9.80665 from g, -1 where the driver gives gravity's own direction."""
    linear_acceleration_status: str | None = None
    """Field that is -1 where it was not measured."""

    def fields(self) -> Iterator[str]:
        """Paths that a message must have."""
        yield from (*self.angular_velocity, *self.linear_acceleration)
        yield from filter(None, (self.angular_velocity_status, self.linear_acceleration_status))

    def read(self, table: MessageTable) -> tuple[Imu | None, Dropped]:
        """The rows with an angular rate; specific force is NaN where it was not measured."""
        rate = _scaled(table.beside(self.angular_velocity), self.angular_velocity_scale)
        force = _scaled(table.beside(self.linear_acceleration), self.linear_acceleration_scale)
        unmeasured = _is_marked(table, self.linear_acceleration_status) | self._is_force_unfilled(table)
        force = np.where(unmeasured[:, None] | ~np.isfinite(force), np.nan, force)
        faults = {
            "without angular rate": _is_marked(table, self.angular_velocity_status),
            NOT_FINITE: not_finite(rate),
        }
        rows, dropped = fit_rows(table.stamps_ns, faults, unique=True)
        rate, force = turn(self.rotation, rate[rows]), turn(self.rotation, force[rows])
        return (Imu(table.stamps_ns[rows], rate, force) if rows.size else None), dropped

    def warnings(self, table: MessageTable) -> Iterator[str]:
        """That a driver leaves the specific force as it was made."""
        if self._is_force_unfilled(table):
            names = ", ".join(self.linear_acceleration)
            yield f"{names} are 0 in every message, which no accelerometer measures: taken as not measured"

    def _is_force_unfilled(self, table: MessageTable) -> bool:
        """Whether it is zero throughout: not even free fall is that."""
        said = table.beside(self.linear_acceleration)[~_is_marked(table, self.linear_acceleration_status)]
        return bool(len(said)) and not said.any()


def _scaled(values: np.ndarray, scale: float) -> np.ndarray:
    return values if scale == 1 else values * scale


def _is_marked(table: MessageTable, path: str | None) -> np.ndarray:
    return np.zeros(len(table), bool) if path is None else table.column(path) == -1


class DepthAdapter(Adapter):
    """Height of the pressure port: ``z = -(p - atmosphere) / (density g)``, or a field's own metres."""

    pressure: str | None = None
    """Field with a pressure."""
    height: str | None = None
    """Field with a height, instead: metres, upwards; with scale = -1 a depth, downwards."""
    scale: Scale = 1.0
    """Turns the field into Pa or into metres upwards; 100 from hPa and mbar."""
    atmosphere_pa: float = Field(101_325.0, ge=0)
    """Pressure at the surface; 0 where the driver gives the pressure above it."""
    water_density_kg_m3: float = Field(1000.0, gt=0)
    """1000 for fresh water, 1025 for the sea."""
    variance: CovarianceFields | None = None
    """One field, before `scale`; without it, or where it is not above 0, the calibration's noise holds."""

    @model_validator(mode="after")
    def _has_one_source(self) -> DepthAdapter:
        if (self.pressure is None) == (self.height is None):
            raise ValueError("give either pressure or height")
        return self

    def fields(self) -> Iterator[str]:
        """Paths that a message must have."""
        yield from filter(None, (self.pressure, self.height))
        yield from self.variance.fields if self.variance else ()

    def read(self, table: MessageTable, gravity_m_s2: float) -> tuple[Depth | None, Dropped]:
        """Heights with variances; NaN: unknown."""
        variance_m2 = self.variance.read_variance(table) if self.variance else np.full(len(table), np.nan)
        if self.scale != 1:
            variance_m2 = variance_m2 * self.scale**2
        if self.pressure is not None:
            pascals_per_metre = self.water_density_kg_m3 * gravity_m_s2
            z_m = (self.atmosphere_pa - table.column(self.pressure) * self.scale) / pascals_per_metre
            variance_m2 = variance_m2 / pascals_per_metre**2
        else:
            z_m = table.column(str(self.height)) * self.scale
        rows, dropped = fit_rows(table.stamps_ns, {NOT_FINITE: not_finite(z_m)}, unique=True)
        return (Depth(table.stamps_ns[rows], z_m[rows], variance_m2[rows]) if rows.size else None), dropped

    def assumption(self, gravity_m_s2: float) -> str | None:
        """How heights were got from pressure, for the notes; None where they were not."""
        if self.pressure is None:
            return None
        water = f"{self.water_density_kg_m3:g} kg/m3 x {gravity_m_s2:g} m/s2"
        fresh = ", fresh water assumed" if self.water_density_kg_m3 == 1000 else ""
        return f"z = -(p - {self.atmosphere_pa:g} Pa) / ({water}){fresh}"

    def warnings(self, table: MessageTable) -> Iterator[str]:
        """What makes a pressure an unlikely one."""
        if self.pressure is None:
            return
        typical_pa = float(np.nanmedian(table.column(self.pressure))) * self.scale
        if typical_pa < 0.5 * self.atmosphere_pa:
            yield (
                f"{self.pressure} is typically {typical_pa:.4g} Pa, less than the atmosphere's: give scale (100 for "
                f"hPa or mbar), or atmosphere_pa = 0 where it is counted from the surface"
            )


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

    def read(self, table: MessageTable) -> tuple[Trajectory | None, Dropped]:
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

    def _covariances(self, table: MessageTable) -> Floats:
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
