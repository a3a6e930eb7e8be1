"""Inertial measurements."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sonar_graph.logs.adapters.adapter import Adapter, Scale
from sonar_graph.logs.adapters.axes import turn
from sonar_graph.logs.table import NOT_FINITE, Dropped, Table, fit_rows, not_finite
from sonar_graph.measurements import Imu

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

    def read(self, table: Table) -> tuple[Imu | None, Dropped]:
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

    def warnings(self, table: Table) -> Iterator[str]:
        """That a driver leaves the specific force as it was made."""
        if self._is_force_unfilled(table):
            names = ", ".join(self.linear_acceleration)
            yield f"{names} are 0 in every message, which no accelerometer measures: taken as not measured"

    def _is_force_unfilled(self, table: Table) -> bool:
        """Whether it is zero throughout: not even free fall is that."""
        said = table.beside(self.linear_acceleration)[~_is_marked(table, self.linear_acceleration_status)]
        return bool(len(said)) and not said.any()


def _scaled(values: np.ndarray, scale: float) -> np.ndarray:
    return values if scale == 1 else values * scale


def _is_marked(table: Table, path: str | None) -> np.ndarray:
    return np.zeros(len(table), bool) if path is None else table.column(path) == -1
