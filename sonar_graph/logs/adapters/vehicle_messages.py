"""Adapters for inertial measurements, depth, and reference poses of the vehicle.

Height from a pressure p is ``z = -(p - atmosphere) / (density g)``.

A pose covariance is of ``[theta, rho]`` in the body frame in this package, and in ``geometry_msgs/PoseWithCovariance``
of translation, then rotation, along the fixed axes of the header's frame. With ``R = world_R_body``, for what is written:

    [rho_world; theta_world] = [[0, R], [R, 0]] [theta; rho]
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation as SpatialRotation

from sonar_graph.logs.adapters.adapter import (
    Adapter,
    AngleScale,
    CovarianceFields,
    DepthScale,
    FieldPath,
    FieldPaths,
    ForceScale,
    RateScale,
    Setup,
    SignedAxes,
    axes_matrix,
    turn,
    variances,
)
from sonar_graph.logs.adapters.aiding_messages import ENU_R, PlaceAdapter, not_zero
from sonar_graph.logs.adapters.message_table import (
    NOT_FINITE,
    FieldTable,
    Fit,
    Mask,
    fit_block,
    fit_rows,
    not_finite,
    share,
)
from sonar_graph.measurements import Depth, Floats, Imu
from sonar_graph.states import Trajectory

WITHOUT_RATE = "without angular rate"
LEAST_MOVE_M = 1.0
"""A vehicle that moved less may not have turned."""


STATUSES = ("angular_velocity_status", "linear_acceleration_status")


class _Signals(NamedTuple):
    """Rates in rad/s and forces in m/s² along the driver's axes, a row each."""

    rate: Floats
    """Shape (n, 3)."""
    force: Floats
    """Shape (n, 3); NaN without accelerometers."""
    no_rate: Mask
    """Rows whose status calls the rate not measured, shape (n,)."""
    no_force: Mask
    denied: list[str]
    """Statuses that do so in all rows, although the values change."""


class ImuAdapter(Adapter):
    """Angular rate and specific force."""

    angular_velocity: FieldPaths
    """Fields of the rates about x, y, z."""
    angular_velocity_scale: RateScale = 1.0
    """Turns them into rad/s; 0.017453292519943295 or "deg/s" from degrees."""
    angular_velocity_axes: SignedAxes | None = None
    """Rates alone, after `rotation`: the axis of each, ["x", "y", "-z"] where the driver has yaw with the wrong sign."""
    angular_velocity_status: FieldPath | None = None
    """Field that is -1 where the rate was not measured."""
    linear_acceleration: FieldPaths | None
    """Fields of the specific force along x, y, z, which accelerometers measure: +9.81 upwards at rest; false: none."""
    linear_acceleration_scale: ForceScale = 1.0
    """Turns them into m/s²; 9.80665 or "g" from g, -1 where the driver gives gravity's own direction."""
    linear_acceleration_status: FieldPath | None = None
    """Field that is -1 where it was not measured."""
    are_zeros_measured: bool = False
    """true: an acceleration of 0 is a value even where all messages have it; else the driver does not fill it."""
    unfilled: Literal["all", "each"] = "all"
    """"all": zeros are not measured where all messages have them; "each": wherever a message has them."""

    def read(self, table: FieldTable, setup: Setup) -> Fit[Imu]:  # noqa: ARG002  # of all adapters
        """The rows with an angular rate; specific force is NaN where it was not measured."""
        found = self._signals(table)
        force = found.force
        is_forceless = found.no_force | not_finite(force)
        is_forceless |= self._is_force_unfilled(found)
        if self.unfilled == "each":
            is_forceless |= ~force.any(axis=1)
        # NaN is what estimators take as not measured
        force[is_forceless] = np.nan
        rate = turn(self.rotation, found.rate)
        faults = {WITHOUT_RATE: found.no_rate, NOT_FINITE: not_finite(rate)}
        if self.angular_velocity_axes is not None:
            rate = turn(self.angular_velocity_axes, rate)
        force = turn(self.rotation, force)
        return fit_block(Imu, table.stamps_ns, faults, rate, force)

    def warnings(self, table: FieldTable) -> Iterator[str]:
        """Warnings about values that the driver does not fill, or fills with what is no number."""
        found = self._signals(table)
        if found.denied:
            fields = " and ".join(str(getattr(self, key)) for key in found.denied)
            keys = " and ".join(f"`{key} = false`" for key in found.denied)
            yield (
                f"{fields} are -1 (not measured) in every message, and yet the values change: used as measured; "
                f"{keys} under [imu] in a log configuration confirms it"
            )
        names = ", ".join(self.linear_acceleration or ())
        bad = not_finite(found.force)
        if self._is_force_unfilled(found):
            yield f"{names} are 0 in every message, which no accelerometer measures: taken as not measured"
        elif bad.any() and not bad.all():
            yield f"{names} are not finite in {share(bad)} messages: taken as not measured there"

    def accepts(self, fault: str) -> str | None:
        """Setting with which messages that are left out for a fault are used; None without one."""
        if fault == WITHOUT_RATE:
            return "angular_velocity_status = false"
        return super().accepts(fault)

    def pinned(self, table: FieldTable) -> dict[str, Any]:
        """Settings by which single messages are read as all messages of a table are together."""
        imu, _ = self.read(table, Setup())
        # what no message fills now may be filled later, message by message
        has_force = imu is not None and bool(np.isfinite(imu.specific_force).any())
        settings: dict[str, Any] = {"unfilled": "each"}
        if has_force:
            settings = {"are_zeros_measured": True}
        return settings | dict.fromkeys(self._signals(table).denied, False)

    def _signals(self, table: FieldTable) -> _Signals:
        """What a driver sends, and what it calls not measured."""
        rate = table.beside(self.angular_velocity) * self.angular_velocity_scale
        force = np.full((len(table), 3), np.nan)
        if self.linear_acceleration is not None:
            sent = table.beside(self.linear_acceleration)
            force = sent * self.linear_acceleration_scale
        marks: list[Mask] = []
        denied = []
        for key, values in zip(STATUSES, (rate, force), strict=True):
            path = getattr(self, key)
            is_marked = np.zeros(len(table), bool)
            if path is not None:
                is_marked = table.column(path) == -1
            # a driver that fills in -1 everywhere would lose its whole log
            if is_marked.all() and _changes(values):
                denied.append(key)
                is_marked = ~is_marked
            marks.append(is_marked)
        no_rate, no_force = marks
        return _Signals(rate, force, no_rate, no_force, denied)

    def _is_force_unfilled(self, found: _Signals) -> bool:
        """True where the force is zero in all messages, which not even free fall gives."""
        measured = found.force[~found.no_force]
        is_zero = bool(len(measured)) and not measured.any()
        return is_zero and not self.are_zeros_measured


def _changes(values: Floats) -> bool:
    """True where values, shape (n, 3), change from row to row, as measured ones do."""
    finite = values[np.isfinite(values).all(axis=1)]
    return len(finite) > 1 and bool(
        (finite[1:] != finite[:-1]).any(axis=1).mean() > 0.5
    )


class DepthAdapter(Adapter):
    """Height of the pressure port, from a pressure or from a field in metres."""

    EITHER = (("pressure", "height", "pressure or height"),)

    pressure: FieldPath | None = None
    """Field with a pressure."""
    height: FieldPath | None = None
    """Field with a height, instead: metres, upwards; with scale = -1 a depth, downwards."""
    scale: DepthScale = 1.0
    """Turns the field into Pa or into metres upwards; 100 or "hPa" from hPa and mbar."""
    atmosphere_pa: float = Field(101_325.0, ge=0)
    """Pressure at the surface; 0 where the driver gives the pressure above it."""
    water_density_kg_m3: float = Field(1000.0, gt=0)
    """1000 for fresh water, 1025 for the sea."""
    variance: CovarianceFields | None = None
    """One field, before `scale`; without it, or where it is not above 0, the calibration's noise holds."""

    def read(self, table: FieldTable, setup: Setup) -> Fit[Depth]:
        """Heights with variances; NaN: unknown."""
        scale = self.scale
        above = table.column(str(self.height)) * scale if self.height else None
        if above is None:
            # a pressure grows downwards
            pascals_per_metre = (
                self.water_density_kg_m3 * setup.calibration.gravity_m_s2
            )
            pressure_pa = table.column(str(self.pressure)) * scale
            above = (self.atmosphere_pa - pressure_pa) / pascals_per_metre
            scale /= pascals_per_metre
        variance_m2 = variances(self.variance, table) * scale**2
        faults = {NOT_FINITE: not_finite(above)}
        return fit_block(Depth, table.stamps_ns, faults, above, variance_m2)

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
    """Poses of the body; twists and covariances are not used.

    From world and body axes of the driver (``w``, ``b``) to those of this package: ``R = enu_R_w w_R_b ours_R_b^T``.
    """

    frame_id_field: str | None = None
    orientation: tuple[FieldPath, FieldPath, FieldPath, FieldPath] | None = None
    """Fields of the quaternion's x, y, z, w; false: only positions are true, and no heading is scored."""
    rpy: FieldPaths | None = None
    """Fields of roll, pitch, yaw instead: world_R_body = Rz(yaw) Ry(pitch) Rx(roll), along the driver's axes."""
    rpy_scale: AngleScale = 1.0
    """Turns them into rad; 0.017453292519943295 or "deg" from degrees."""

    @model_validator(mode="after")
    def _has_one_turn(self) -> TruthAdapter:
        if self.orientation is not None and self.rpy is not None:
            raise ValueError(
                "give either orientation = [x, y, z, w] or rpy = [roll, pitch, yaw]"
            )
        return self

    def read(self, table: FieldTable, setup: Setup) -> Fit[Trajectory]:
        """Poses; quaternions are NaN where only positions are known."""
        positions, faults, _ = self.places(table, setup.origin)
        quaternions = self._quaternions(table)
        if quaternions is not None:
            faults[NOT_FINITE] = not_finite(positions, quaternions)
            faults["without an orientation"] = ~not_zero(quaternions)
        rows, dropped = fit_rows(table.stamps_ns, faults, unique=True)
        if not rows.size:
            return None, dropped
        stamps_ns = table.stamps_ns[rows]
        if quaternions is None:
            return Trajectory.of_positions(stamps_ns, positions[rows]), dropped
        chosen = quaternions[rows]
        lengths = np.linalg.norm(chosen, axis=1)
        # of drivers that round to four digits; unit quaternions keep every bit
        scale = np.where(np.abs(lengths - 1) > 1e-6, lengths, 1.0)
        chosen = chosen / scale[:, None]
        if self.world != "enu" or self.rotation != "flu":
            world_R_driver = SpatialRotation.from_quat(chosen).as_matrix()
            driver_R_body = axes_matrix(self.rotation).T
            R = ENU_R[self.world] @ world_R_driver @ driver_R_body
            chosen = SpatialRotation.from_matrix(R).as_quat()
        poses = Trajectory.without_covariances(stamps_ns, positions[rows], chosen)
        return poses, dropped

    def _quaternions(self, table: FieldTable) -> Floats | None:
        """Orientations x, y, z, w, shape (n, 4), zeros where an angle is not finite; None where none is stated."""
        if self.rpy is None:
            return table.beside(self.orientation) if self.orientation else None
        angles = table.beside(self.rpy) * self.rpy_scale
        is_finite = np.all(np.isfinite(angles), axis=1)[:, None]
        turns = SpatialRotation.from_euler("xyz", np.where(is_finite, angles, 0.0))
        return np.where(is_finite, turns.as_quat(), 0.0)

    def warnings(self, table: FieldTable) -> Iterator[str]:
        """Warning about an orientation that never changes while the vehicle moves."""
        quaternions = self._quaternions(table)
        if quaternions is None or self.position is None or len(table) < 2:
            return
        moved_m = float(np.linalg.norm(np.ptp(self.scaled(table), axis=0)))
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
    swap = np.zeros((len(rotations), 6, 6))
    swap[:, :3, 3:] = rotations
    swap[:, 3:, :3] = rotations
    return np.nan_to_num(swap @ covariances @ swap.transpose(0, 2, 1), nan=0.0)
