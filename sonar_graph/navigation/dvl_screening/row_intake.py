"""Which rows of IMU and Doppler log are used, and why others are not.

A row is turned into body axes and placed by its stamp. One that belongs to a motion already used is late; a velocity
that no vehicle reaches is an outlier (`sonar_graph.navigation.dvl_screening.dvl_gate`); one with none before it waits
until it
is confirmed (`sonar_graph.navigation.dvl_screening.dvl_gate`); one of too few beams waits until it can be completed
(`sonar_graph.navigation.dvl_screening.partial_beams`).
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.devices import in_numbers
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.navigation.dvl_screening.dvl_gate import GATE, VelocityDoubt, VelocityVerdict, judge
from sonar_graph.navigation.dvl_screening.partial_beams import InertialRows, PartialVelocities, Rows
from sonar_graph.navigation.samples import EARLIEST_NS, LATEST_NS, StampedRows
from sonar_graph.numerics import compiled
from sonar_graph.states import Refusal, RefusedRow

_Rows = TypeVar("_Rows", Imu, Dvl)


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
        self._gate = np.inf if calibration.odometry_interpolation == "hold-past" else GATE  # held velocities may jump
        self._walk = calibration.dvl.velocity_walk_density
        self._doubt = None if calibration.odometry_interpolation == "hold-past" else VelocityDoubt(self._walk)
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
        """Rows that are not used, and why; also those that may still be completed or confirmed."""
        incomplete, waiting = self._partial.not_completed_ns, self._doubt.waiting_ns if self._doubt else []
        return [
            *self._refused,
            *(RefusedRow("dvl", at_ns, Refusal.INCOMPLETE, np.nan) for at_ns in incomplete),
            *(RefusedRow("dvl", at_ns, Refusal.UNCONFIRMED, np.nan) for at_ns in waiting),
        ]

    @property
    def start_known_ns(self) -> int:
        """When the first velocity was confirmed."""
        return self._doubt.start_known_ns if self._doubt else EARLIEST_NS

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
        columns = rows.stamps_ns, *self._in_body(rows)
        verdict = self._judged(columns)
        if self._doubt is None:
            return self._place(columns, verdict)
        whole_ns = rows.stamps_ns[~(verdict.is_outlier | verdict.is_partial)]
        if self._doubt.is_none(rows.stamps_ns, whole_ns):
            self._doubt.believe(whole_ns)
            return self._place(columns, verdict)
        before = [self._place_beyond(self._doubt, *row) for row in zip(*columns, verdict.is_partial, strict=True)]
        return any(before)

    def _judged(self, rows: Rows) -> VelocityVerdict:
        return judge(*rows, self.dvl.stamps_ns, *self.dvl.values, self._walk, self._gate)

    def _place(self, rows: Rows, verdict: VelocityVerdict) -> bool:
        """Whether rows were placed before others, of those that the gate lets pass and that are, or can be, whole."""
        if not verdict.is_plain or self._partial.is_waiting:
            rows = self._completed(*rows, verdict)
        else:
            self._partial.remember(*rows)
        return len(rows[0]) > 0 and self.dvl.insert(*rows)

    def _place_beyond(
        self, doubt: VelocityDoubt, stamp_ns: np.int64, velocity: Floats, cov: Floats, is_partial: np.bool_
    ) -> bool:
        """The same of one row, and of those that have waited for it."""
        rows, refused = doubt.passed(int(stamp_ns), velocity, cov, is_partial=bool(is_partial))
        self._refused += refused
        if not len(rows[0]):
            return False
        verdict = self._judged(rows)
        doubt.believe(rows[0][~(verdict.is_outlier | verdict.is_partial)])
        return self._place(rows, verdict)

    def _in_body(self, dvl: Dvl) -> tuple[Floats, Floats]:
        """Velocity and its covariance in body axes."""
        cov = in_numbers(dvl.velocity_cov, self._default_cov)
        if self._body_R_dvl is None:
            return dvl.velocity, cov
        return dvl.velocity @ self._body_R_dvl.T, self._body_R_dvl @ cov @ self._body_R_dvl.T

    def _completed(self, stamps_ns: Ints, velocity: Floats, cov: Floats, verdict: VelocityVerdict) -> Rows:
        """Rows that are no outliers, without those that wait, and those that have waited for them."""
        outlier = verdict.is_outlier
        for stamp_ns, distance in zip(stamps_ns[outlier].tolist(), verdict.distance[outlier].tolist(), strict=True):
            self._refused.append(RefusedRow("dvl", stamp_ns, Refusal.OUTLIER, distance))
        inertial = InertialRows(self.imu.stamps_ns, *self.imu.values)
        believed = stamps_ns[~outlier], velocity[~outlier], cov[~outlier]
        return self._partial.completed(*believed, verdict.is_partial[~outlier], inertial)

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
