"""Adapters for inertial measurements, depth, and reference poses of the vehicle.

Height from a pressure p is ``z = -(p - atmosphere) / (density g)``.

A pose covariance is of ``[theta, rho]`` in the body frame in this package, and in ``geometry_msgs/PoseWithCovariance``
of translation, then rotation, along the fixed axes of the header's frame. With ``R = world_R_body``:

    [rho_world; theta_world] = [[0, R], [R, 0]] [theta; rho]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation as SpatialRotation

from sonar_graph.logs.adapters.adapter import (
    Adapter,
    AngleScale,
    CovarianceFields,
    DepthScale,
    ForceScale,
    RateScale,
    SignedAxes,
    axes_matrix,
    turn,
    variances,
)
from sonar_graph.logs.adapters.aiding_messages import ENU_R_NED, PlaceAdapter
from sonar_graph.logs.adapters.geodesy import Origin
from sonar_graph.logs.adapters.message_table import (
    LARGEST,
    NOT_FINITE,
    Dropped,
    FieldTable,
    fit_block,
    fit_rows,
    not_finite,
    share,
)
from sonar_graph.measurements import Depth, Floats, Imu
from sonar_graph.states import Trajectory

Paths = tuple[str, str, str]
WITHOUT_RATE = "without angular rate"
LEAST_MOVE_M = 1.0
"""A vehicle that moved less may not have turned."""


class ImuAdapter(Adapter):
    """Angular rate and specific force."""

    PATHS = (
        "angular_velocity",
        "linear_acceleration",
        "angular_velocity_status",
        "linear_acceleration_status",
    )

    angular_velocity: Paths
    """Fields of the rates about x, y, z."""
    angular_velocity_scale: RateScale = 1.0
    """Turns them into rad/s; 0.017453292519943295 or "deg/s" from degrees."""
    angular_velocity_axes: SignedAxes | None = None
    """Rates alone, after `rotation`: the axis of each, ["x", "y", "-z"] where the driver has yaw with the wrong sign."""
    angular_velocity_status: str | None = None
    """Field that is -1 where the rate was not measured."""
    linear_acceleration: Paths | None
    """Fields of the specific force along x, y, z, which accelerometers measure: +9.81 upwards at rest; false: none."""
    linear_acceleration_scale: ForceScale = 1.0
    """Turns them into m/s²; 9.80665 or "g" from g, -1 where the driver gives gravity's own direction."""
    linear_acceleration_status: str | None = None
    """Field that is -1 where it was not measured."""
    are_zeros_measured: bool = False
    """true: an acceleration of 0 is a value even where all messages have it; else the driver does not fill it."""
    unfilled: Literal["all", "each"] = "all"
    """"all": zeros are not measured where all messages have them; "each": wherever a message has them."""

    def read(self, table: FieldTable) -> tuple[Imu | None, Dropped]:
        """The rows with an angular rate; specific force is NaN where it was not measured."""
        rate = table.beside(self.angular_velocity) * self.angular_velocity_scale
        force = self._force(table)
        # NaN is what estimators take as not measured
        unmeasured = _is_marked(
            table, self.linear_acceleration_status, force
        ) | self._is_force_unfilled(table, force)
        if self.unfilled == "each":
            unmeasured |= ~force.any(axis=1)
        force = np.where(
            unmeasured[:, None] | ~(np.abs(force) < LARGEST), np.nan, force
        )
        is_unmeasured = _is_marked(table, self.angular_velocity_status, rate)
        faults = {WITHOUT_RATE: is_unmeasured, NOT_FINITE: not_finite(rate)}
        rate = turn(self.rotation, rate)
        if self.angular_velocity_axes is not None:
            rate = turn(self.angular_velocity_axes, rate)
        force = turn(self.rotation, force)
        return fit_block(Imu, table.stamps_ns, faults, rate, force)

    def warnings(self, table: FieldTable) -> Iterator[str]:
        """Warnings about values that the driver does not fill, or fills with what is no number."""
        force = self._force(table)
        if denied := self._denied(table, force):
            fields = " and ".join(str(getattr(self, key)) for key in denied)
            keys = ", ".join(f"{key} = false" for key in denied)
            yield (
                f"{fields} are -1 (not measured) in every message, and yet the values change: used as measured; "
                f"`{keys}` under [imu] in a log configuration confirms it"
            )
        if self.linear_acceleration is None:
            return
        names = ", ".join(self.linear_acceleration)
        bad = not_finite(force)
        if self._is_force_unfilled(table, force):
            yield f"{names} are 0 in every message, which no accelerometer measures: taken as not measured"
        elif bad.any() and not bad.all():
            yield f"{names} are not finite in {share(bad)} messages: taken as not measured there"

    def accepts(self, fault: str) -> str | None:
        """Setting with which messages that are left out for a fault are used; None: there is none."""
        return (
            "angular_velocity_status = false"
            if fault == WITHOUT_RATE
            else super().accepts(fault)
        )

    def pinned(self, table: FieldTable) -> dict[str, Any]:
        """Settings by which single messages are read as all messages of a table are together."""
        imu, _ = self.read(table)
        has_force = imu is not None and bool(np.isfinite(imu.specific_force).any())
        settings: dict[str, Any] = (
            {"are_zeros_measured": True} if has_force else {"unfilled": "each"}
        )
        force = self._force(table)
        return settings | dict.fromkeys(self._denied(table, force), False)

    def _denied(self, table: FieldTable, force: Floats) -> list[str]:
        """Keys of the statuses by which a driver calls all rows not measured, although the values change."""
        rate = table.beside(self.angular_velocity)
        found = []
        for key, values in (
            ("angular_velocity_status", rate),
            ("linear_acceleration_status", force),
        ):
            status = getattr(self, key)
            if status is not None and _is_denied(table.column(status), values):
                found.append(key)
        return found

    def _force(self, table: FieldTable) -> Floats:
        """Specific force in m/s², shape (n, 3); NaN without accelerometers."""
        if self.linear_acceleration is None:
            return np.full((len(table), 3), np.nan)
        force = table.beside(self.linear_acceleration)
        return np.asarray(force * self.linear_acceleration_scale)

    def _is_force_unfilled(self, table: FieldTable, force: Floats) -> bool:
        """Tell whether the force is zero in all messages, which not even free fall gives."""
        if self.are_zeros_measured:
            return False
        measured = force[~_is_marked(table, self.linear_acceleration_status, force)]
        return bool(len(measured)) and not measured.any()


def _is_marked(table: FieldTable, path: str | None, values: Floats) -> np.ndarray:
    """Mask of rows whose status says that the values, shape (n, 3), were not measured, shape (n,)."""
    if path is None:
        return np.zeros(len(table), bool)
    status = table.column(path)
    if _is_denied(status, values):
        return np.zeros(len(table), bool)
    return np.asarray(status == -1)


def _is_denied(status: np.ndarray, values: Floats) -> bool:
    """Tell whether a driver calls all rows not measured, although the values change as measured ones do."""
    if not (status == -1).all():
        return False
    # a driver that fills in -1 everywhere would lose its whole log
    finite = values[np.isfinite(values).all(axis=1)]
    return len(finite) > 1 and bool(
        np.any(finite[1:] != finite[:-1], axis=1).mean() > 0.5
    )


class DepthAdapter(Adapter):
    """Height of the pressure port, from a pressure or from a field in metres."""

    PATHS = ("pressure", "height", "variance")
    NEEDS = ("gravity_m_s2",)

    pressure: str | None = None
    """Field with a pressure."""
    height: str | None = None
    """Field with a height, instead: metres, upwards; with scale = -1 a depth, downwards."""
    scale: DepthScale = 1.0
    """Turns the field into Pa or into metres upwards; 100 or "hPa" from hPa and mbar."""
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

    def read(
        self, table: FieldTable, gravity_m_s2: float
    ) -> tuple[Depth | None, Dropped]:
        """Heights with variances; NaN: unknown."""
        variance_m2 = variances(self.variance, table) * self.scale**2
        if self.pressure is not None:
            pascals_per_metre = self.water_density_kg_m3 * gravity_m_s2
            z_m = (
                self.atmosphere_pa - table.column(self.pressure) * self.scale
            ) / pascals_per_metre
            variance_m2 = variance_m2 / pascals_per_metre**2
        else:
            z_m = table.column(str(self.height)) * self.scale
        faults = {NOT_FINITE: not_finite(z_m)}
        return fit_block(Depth, table.stamps_ns, faults, z_m, variance_m2)

    def assumption(self, gravity_m_s2: float) -> str | None:
        """Formula from pressure to height for the notes; None where the message gives a height."""
        if self.pressure is None:
            return None
        water = f"{self.water_density_kg_m3:g} kg/m3 x {gravity_m_s2:g} m/s2"
        fresh = ", fresh water assumed" if self.water_density_kg_m3 == 1000 else ""
        return f"z = -(p - {self.atmosphere_pa:g} Pa) / ({water}){fresh}"

    def warnings(self, table: FieldTable) -> Iterator[str]:
        """Warning about a pressure below the atmosphere's."""
        if self.pressure is None:
            return
        # the first and last rows of a dive are at the surface
        typical_pa = float(np.nanmedian(table.column(self.pressure))) * self.scale
        if typical_pa < 0.5 * self.atmosphere_pa:
            yield (
                f"{self.pressure} is typically {typical_pa:.4g} Pa, less than the atmosphere's: give scale (100 for "
                f"hPa or mbar), or atmosphere_pa = 0 where it is counted from the surface"
            )


class TruthAdapter(PlaceAdapter):
    """Poses of the body; a twist is not used.

    From world and body axes of the driver (``w``, ``b``) to those of this package: ``R = enu_R_w w_R_b ours_R_b^T``.
    """

    PATHS = ("position", "geodetic", "orientation", "rpy", "covariance")

    frame_id_field: str | None = None
    orientation: tuple[str, str, str, str] | None = None
    """Fields of the quaternion's x, y, z, w; false: only positions are true, and no heading is scored."""
    rpy: Paths | None = None
    """Fields of roll, pitch, yaw instead: world_R_body = Rz(yaw) Ry(pitch) Rx(roll), along the driver's axes."""
    rpy_scale: AngleScale = 1.0
    """Turns them into rad; 0.017453292519943295 or "deg" from degrees."""
    covariance: str | None = None
    """Array field of 36: position, then rotation, along the world's axes, as ROS has it."""
    covariance_meaning: Literal["variance", "standard deviation"] = "variance"
    """"variance", or "standard deviation" where the driver puts those on the diagonal."""

    @model_validator(mode="after")
    def _has_one_turn(self) -> TruthAdapter:
        if self.orientation is not None and self.rpy is not None:
            raise ValueError(
                "give either orientation = [x, y, z, w] or rpy = [roll, pitch, yaw]"
            )
        return self

    def read(
        self, table: FieldTable, origin: Origin | None = None
    ) -> tuple[Trajectory | None, Dropped]:
        """Poses with covariances, NaN: unknown; ``origin`` in degrees and metres, of positions on the Earth."""
        positions, faults, _ = self.places(table, origin)
        if self.orientation is None and self.rpy is None:
            rows, dropped = fit_rows(table.stamps_ns, faults, unique=True)
            if not rows.size:
                return None, dropped
            stamps_ns = table.stamps_ns[rows]
            return Trajectory.of_positions(stamps_ns, positions[rows]), dropped
        quaternions = self._quaternions(table)
        lengths = np.linalg.norm(quaternions, axis=1)
        faults[NOT_FINITE] = not_finite(positions, quaternions)
        faults["without an orientation"] = lengths < 0.5
        rows, dropped = fit_rows(table.stamps_ns, faults, unique=True)
        if not rows.size:
            return None, dropped
        # unit quaternions keep every bit
        scale = np.where(np.abs(lengths - 1) > 1e-6, lengths, 1.0)
        quaternions = (quaternions / scale[:, None])[rows]
        enu_R_world = ENU_R_NED if self.world == "ned" else np.eye(3)
        if self.world != "enu" or self.rotation != "flu":
            world_R_driver = SpatialRotation.from_quat(quaternions).as_matrix()
            driver_R_body = axes_matrix(self.rotation).T
            quaternions = SpatialRotation.from_matrix(
                enu_R_world @ world_R_driver @ driver_R_body
            ).as_quat()
        truth = Trajectory.without_covariances(
            table.stamps_ns[rows], positions[rows], quaternions
        )
        if self.covariance is None:
            return truth, dropped
        C = table.column(self.covariance)
        if C.shape[1:] != (36,):
            table.refuse(self.covariance, "is no array of 36 numbers")
        C = C.reshape(-1, 6, 6)[rows]
        if self.covariance_meaning == "standard deviation":
            C = np.where(C < 0, C, C**2) * np.eye(6)
        if self.world != "enu":
            W = np.kron(np.eye(2), enu_R_world)
            C = W @ C @ W.T
        return replace(truth, covariances=ros_to_body(C, truth.matrices)), dropped

    def _quaternions(self, table: FieldTable) -> np.ndarray:
        """Orientations x, y, z, w, shape (n, 4); zeros where an angle is not finite."""
        if self.rpy is None:
            return table.beside(self.orientation or ())
        angles = table.beside(self.rpy) * self.rpy_scale
        is_finite = np.asarray(np.isfinite(angles).all(axis=1))
        found = SpatialRotation.from_euler(
            "xyz", np.where(is_finite[:, None], angles, 0.0)
        ).as_quat()
        return np.where(is_finite[:, None], found, 0.0)

    def warnings(self, table: FieldTable) -> Iterator[str]:
        """Warning about an orientation that never changes while the vehicle moves."""
        has_turns = self.orientation is not None or self.rpy is not None
        if not has_turns or self.position is None or len(table) < 2:
            return
        quaternions = self._quaternions(table)
        positions = self.scaled(table)
        moved_m = float(np.linalg.norm(np.ptp(positions, axis=0)))
        is_turning = (quaternions != quaternions[0]).any()
        # False for a NaN
        if LEAST_MOVE_M < moved_m < np.inf and not is_turning:
            yield (
                f"its orientation is the same in all {len(table)} messages, although it moves by {moved_m:.3g} m: if "
                "that is none, `orientation = false` under [truth] in the log configuration; no heading is then scored"
            )


def body_to_ros(covariances: Floats, rotations: Floats) -> Floats:
    """Covariances for ROS messages: of ``[rho, theta]`` along the world's axes, shape (n, 6, 6); zeros: unknown.

    From those of ``[theta, rho]`` in the body frame, shape (n, 6, 6), NaN: unknown, and ``world_R_body``, (n, 3, 3).
    """
    swap = _swap(rotations)
    return np.nan_to_num(swap @ covariances @ swap.transpose(0, 2, 1), nan=0.0)


def ros_to_body(covariances: Floats, rotations: Floats) -> Floats:
    """Inverse of `body_to_ros`; all zeros, or a negative variance, mean unknown and become NaN."""
    swap = _swap(rotations).transpose(0, 2, 1)
    # ROS has no other mark for unknown
    known = np.any(covariances != 0, axis=(1, 2)) & (
        np.diagonal(covariances, axis1=1, axis2=2) >= 0
    ).all(axis=1)
    return np.where(
        known[:, None, None], swap @ covariances @ swap.transpose(0, 2, 1), np.nan
    )


def _swap(rotations: Floats) -> Floats:
    swap = np.zeros((len(rotations), 6, 6))
    swap[:, :3, 3:] = rotations
    swap[:, 3:, :3] = rotations
    return swap
