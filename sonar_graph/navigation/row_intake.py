"""Which rows of IMU and Doppler log are used, and why others are not.

A row is turned into body axes and placed by its stamp. One that belongs to a motion already used is late; a velocity
that no vehicle reaches is an outlier (`sonar_graph.navigation.velocity_gate`); one of too few beams waits until it can
be completed (`sonar_graph.navigation.partial_velocity`).
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.doppler_beams import finite, is_partial
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.navigation.inertial_carry import InertialRows
from sonar_graph.navigation.kernels import compiled
from sonar_graph.navigation.partial_velocity import PartialVelocities
from sonar_graph.navigation.stamped_rows import EARLIEST_NS, LATEST_NS, StampedRows
from sonar_graph.navigation.velocity_gate import GATE, distances
from sonar_graph.states import Refusal, RefusedRow

_Rows = TypeVar("_Rows", Imu, Dvl)
Flags = NDArray[np.bool_]


class RowIntake:
    """Takes in rows of both sensors.

    Parameters
    ----------
    calibration
        Mountings, DVL noise where the log has none, and the meaning of a sample.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._body_R_imu = _rotation(calibration.imu.mounting)
        self._body_R_dvl = _rotation(calibration.dvl.mounting)
        self._default_cov = np.diag(np.square(calibration.dvl.velocity_sigma_m_s))
        self._may_jump = calibration.odometry_interpolation == "hold-past"
        self._walk = calibration.dvl.velocity_walk_density
        self._partial = PartialVelocities(calibration)
        self.imu = StampedRows((3,), (3,))
        """Angular rate and specific force, body axes."""
        self.dvl = StampedRows((3,), (3, 3))
        """Velocity of the DVL's origin and its covariance, body axes."""
        self.settled_ns: int = EARLIEST_NS
        """Up to when motion is used and stays as it is."""
        self._refused: list[RefusedRow] = []

    @property
    def refused(self) -> list[RefusedRow]:
        """Rows that are not used, and why; of too few beams also those that may still be completed."""
        incomplete = self._partial.not_completed_ns
        return [*self._refused, *(RefusedRow("dvl", at_ns, Refusal.INCOMPLETE, np.nan) for at_ns in incomplete)]

    def add_imu(self, imu: Imu) -> bool:
        """Returns whether rows were placed before others that are there already."""
        rows = self._in_time(imu, self.imu.stamps_ns, "imu")
        if rows is None:
            return False
        rate, force = rows.angular_velocity, rows.specific_force
        if self._body_R_imu is not None:
            rate, force = rate @ self._body_R_imu.T, force @ self._body_R_imu.T
        return self.imu.insert(rows.stamps_ns, rate, force)

    def add_dvl(self, dvl: Dvl) -> bool:
        """The same; of rows that leave a direction unmeasured, those that can be completed now."""
        rows = self._in_time(dvl, self.dvl.stamps_ns, "dvl")
        if rows is None:
            return False
        partial = is_partial(rows.velocity_cov)
        velocity, cov = self._in_body(rows, finite(rows.velocity_cov) if partial.any() else rows.velocity_cov)
        believed = self._believed(rows.stamps_ns, velocity, cov, partial)
        inertial = InertialRows(self.imu.stamps_ns, *self.imu.values)
        whole = self._partial.completed(
            rows.stamps_ns[believed], velocity[believed], cov[believed], partial[believed], inertial
        )
        return len(whole[0]) > 0 and self.dvl.insert(*whole)

    def _in_body(self, dvl: Dvl, cov: Floats) -> tuple[Floats, Floats]:
        """Velocity and a covariance in body axes."""
        cov = np.where(np.isnan(cov), self._default_cov, cov)
        if self._body_R_dvl is None:
            return dvl.velocity, cov
        return dvl.velocity @ self._body_R_dvl.T, self._body_R_dvl @ cov @ self._body_R_dvl.T

    def _believed(self, stamps_ns: Ints, velocity: Floats, cov: Floats, partial: Flags) -> slice | Flags:
        """Rows that are no outliers, each beside the one before it; held velocities may jump and are all believed."""
        if self._may_jump:
            return slice(None)
        before = self._row_before(stamps_ns[0], velocity, cov)
        found = distances(stamps_ns, velocity, cov, partial, *before, self._walk)
        is_outlier = found > GATE
        if not is_outlier.any():
            return slice(None)
        for stamp_ns, distance in zip(stamps_ns[is_outlier].tolist(), found[is_outlier].tolist(), strict=True):
            self._refused.append(RefusedRow("dvl", stamp_ns, Refusal.OUTLIER, distance))
        return ~is_outlier

    def _row_before(self, stamp_ns: int, velocity: Floats, cov: Floats) -> tuple[int, Floats, Floats]:
        """The row kept before a stamp; where there is none, a row too late to be compared with."""
        k = int(np.searchsorted(self.dvl.stamps_ns, stamp_ns)) - 1
        if k < 0:
            return LATEST_NS, velocity[0], cov[0]
        return int(self.dvl.stamps_ns[k]), self.dvl.values[0][k], self.dvl.values[1][k]

    def _in_time(self, rows: _Rows, known_ns: Ints, sensor: str) -> _Rows | None:
        """Rows that can still be used, each stamp once."""
        if rows.stamps_ns[0] <= self.settled_ns:
            late = rows.between(EARLIEST_NS, self.settled_ns)
            new = [] if late is None else np.setdiff1d(late.stamps_ns, known_ns).tolist()
            self._refused += [RefusedRow(sensor, stamp_ns, Refusal.LATE, np.nan) for stamp_ns in new]
            later = rows.between(self.settled_ns, LATEST_NS)
            if later is None:
                return None
            rows = later
        if _has_repeats(rows.stamps_ns):
            rows = rows.rows(np.unique(rows.stamps_ns, return_index=True)[1])
        return rows


def _rotation(mounting: Mounting) -> Floats | None:
    """body_R_sensor, None for a sensor whose axes are the body's."""
    return mounting.pose().rotation().matrix() if any(mounting.rpy_rad) else None


@compiled
def _has_repeats(stamps: Ints) -> bool:
    """Whether two rows share a stamp: nothing can be interpolated between them."""
    return bool(np.any(stamps[1:] == stamps[:-1]))
