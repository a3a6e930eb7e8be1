"""Motion by gyros and Doppler log between any two instants.

Epochs. The stamps of the DVL rows are *epochs*: between two epochs the velocity is known on both sides and the motion
is final. An epoch counts as reached at time t when its own row and an IMU row at or after it are stamped at or before
t. What happens between epochs (a detection, a depth sample, an estimate) is related to the newest reached epoch by a
provisional motion that uses nothing stamped later. Results therefore depend on stamps alone, not on how a log is cut
into blocks. Two exceptions, where rows are added long before they are used: the first velocities, and those after a
long gap, are epochs once later ones have confirmed them, and rows of too few beams once a whole one has completed them
(`sonar_graph.navigation.dvl_screening`).

Gaps. A gap between two epochs is bridged with both its ends known. In a gap that lasts, both instants are reached from
the epoch at which bottom lock was lost::

    M = M_1^-1 M_2,    P = P_2 - Ad(M^-1) P_1 Ad(M^-1)^T

P is the growth of the error, so that successive motions, taken as independent, add up to that since the epoch.
docs/theory/preintegration.md, docs/theory/gaps.md.
"""

from types import NoneType

import numpy as np

from sonar_graph.calibration import ROWS_BEFORE, Calibration
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.motion import Motions, PreintegratedMotion
from sonar_graph.navigation.alignment import earth_rate_in_world
from sonar_graph.navigation.dvl_gaps import Sensors, bridge, motion_over, remaining_motion
from sonar_graph.navigation.dvl_screening import RowIntake
from sonar_graph.navigation.imu_gaps import UNTURNED, turns_of
from sonar_graph.navigation.samples import WINDOW_NS, finite_vector, no_doppler_stamp
from sonar_graph.navigation.steps import Rows
from sonar_graph.navigation.sums import motions_over
from sonar_graph.states import RefusedRow

ZERO = np.zeros(3)


class Odometry:
    """Source of motion (`sonar_graph.motion.MotionSource`) from the rows of both sensors that are still needed.

    Parameters
    ----------
    calibration
        Mountings, DVL noise where the log has none, and the interpolation between samples.

    Examples
    --------
    Half a metre per second ahead, for one second:

    >>> import numpy as np
    >>> from sonar_graph.calibration import Calibration
    >>> from sonar_graph.measurements import Dvl, Imu
    >>> from sonar_graph.navigation import Odometry
    >>> imu_ns, dvl_ns = np.arange(201) * 10_000_000, np.arange(11) * 200_000_000
    >>> odometry = Odometry(Calibration())
    >>> odometry.add(
    ...     Imu(imu_ns, np.zeros((201, 3)), np.tile([0.0, 0.0, 9.81], (201, 1))),
    ...     Dvl(dvl_ns, np.tile([0.5, 0.0, 0.0], (11, 1)), np.full((11, 3, 3), np.nan)),
    ... )
    False
    >>> motion = odometry.motion(0, 1_000_000_000, np.zeros(3))
    >>> round(float(motion.i_T_j.x()), 6), motion.covariance.shape
    (0.5, (6, 6))
    """

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        """What it was made with."""
        self._intake = RowIntake(calibration)
        self._imu, self._dvl = self._intake.imu, self._intake.dvl
        self._hold_past = calibration.odometry_interpolation == "hold-past"
        self._turns = UNTURNED if self._hold_past else turns_of(calibration.imu)
        self._sensors = Sensors.of(calibration)
        self._earth = earth_rate_in_world(calibration)
        self._dvl_p_imu = (self._sensors.body_p_imu - self._sensors.body_p_dvl).tolist()
        self._final: tuple[tuple[int, bytes, bytes], int, PreintegratedMotion] | None = None

    @property
    def refused(self) -> list[RefusedRow]:
        """Rows that are not used, with the reason; includes rows that may still be completed or confirmed."""
        return self._intake.refused

    def add(self, imu: Imu | None, dvl: Dvl | None) -> bool:
        """Take in rows and place them by their stamps.

        Of rows with equal stamps the first counts. A row that comes after motion up to its stamp was settled is late,
        and a velocity may be an outlier (`sonar_graph.navigation.dvl_screening.dvl_gate`): both go to `refused`.

        Returns
        -------
        bool
            True where rows were placed before others that were there already: provisional motion is out of date.

        Raises
        ------
        MeasurementError
            When the blocks are of another kind.
        """
        if not (isinstance(imu, (Imu, NoneType)) and isinstance(dvl, (Dvl, NoneType))):
            raise MeasurementError(f"imu, dvl: expected Imu and Dvl, not {type(imu).__name__} and {type(dvl).__name__}")
        placed_imu = imu is not None and self._intake.add_imu(imu)
        placed_dvl = dvl is not None and self._intake.add_dvl(dvl)
        if placed_imu or placed_dvl:
            self._final = None
        return placed_imu or placed_dvl

    def settle(self, epoch_ns: int) -> None:
        """Declare the motion up to an epoch as used: rows stamped at or before it are late from now on."""
        self._intake.settled_ns = max(self._intake.settled_ns, epoch_ns)

    def forget_before(self, epoch_ns: int) -> None:
        """Settle, and drop rows that no motion from this epoch on can need, gaps after it included."""
        self.settle(epoch_ns)
        needed_ns = epoch_ns if self._hold_past else epoch_ns - WINDOW_NS
        self._imu.forget_before(needed_ns, ROWS_BEFORE)
        self._dvl.forget_before(needed_ns)

    def start_by(self, until_ns: int) -> int | None:
        """First epoch, if it is reached at an instant: IMU rows cover it, and its velocity is confirmed; else None."""
        imu_ns, dvl_ns = self._imu.stamps_ns, self._dvl.stamps_ns
        first = dvl_ns[np.searchsorted(dvl_ns, imu_ns[0]) :] if len(imu_ns) else dvl_ns[:0]
        if not len(first) or first[0] > imu_ns[-1]:
            return None
        reached_ns = max(int(self.reached_ns(first[:1])[0]), self._intake.start_known_ns)
        return int(first[0]) if reached_ns <= until_ns else None

    def epochs(self, after_ns: int, until_ns: int) -> Ints:
        """Epochs after one instant that are reached at another, in order, shape (n,)."""
        imu_ns, dvl_ns = self._imu.stamps_ns, self._dvl.stamps_ns
        seen = imu_ns.searchsorted(until_ns, side="right")
        if not seen:
            return dvl_ns[:0]
        return dvl_ns[dvl_ns.searchsorted(after_ns, side="right") : dvl_ns.searchsorted(imu_ns[seen - 1], side="right")]

    def reached_ns(self, epochs_ns: Ints) -> Ints:
        """Instants at which epochs are reached: stamps of the first IMU rows at or after them, shape (n,)."""
        return self._imu.stamps_ns[self._imu.stamps_ns.searchsorted(epochs_ns)]

    def is_gap(self, start_ns: int, end_ns: int) -> bool:
        """True for a time without Doppler rows that is too long for a linear velocity."""
        return end_ns - start_ns > self._sensors.longest_ns

    def motion(
        self, start_ns: int, end_ns: int, bias: Floats, world_R_i: Floats | None = None, known_ns: int | None = None
    ) -> PreintegratedMotion:
        """Motion from one instant to another, over gaps too, from rows stamped no later than an instant.

        The part up to the newest epoch is final and kept: the same start and bias, asked for later and later instants,
        cost what is new.

        Raises
        ------
        MeasurementError
            When the instants are in the wrong order, the first lies before all rows, or the bias is no finite vector.
        """
        bias = finite_vector("bias", bias, 3)
        imu_ns, dvl_ns = self._imu.stamps_ns, self._dvl.stamps_ns
        if not (len(imu_ns) and len(dvl_ns)):
            raise MeasurementError("motion: needs rows of IMU and Doppler log; add them first")
        if end_ns < start_ns:
            raise MeasurementError(f"interval: ends at {end_ns} ns, before its start {start_ns}; the earlier first")
        if start_ns < (first_ns := max(imu_ns[0], dvl_ns[0])):
            raise MeasurementError(f"start_ns: {start_ns} lies before the rows; begin at {first_ns} or later")
        earth = ZERO if self._earth is None or world_R_i is None else world_R_i.T @ self._earth
        if known_ns is None:
            known_ns = end_ns
            if end_ns <= imu_ns[-1] and self._is_doppler_stamp(end_ns):
                known_ns = int(self.reached_ns(np.array([end_ns]))[0])
        if self._is_doppler_stamp(start_ns):
            return self._since_epoch(start_ns, end_ns, known_ns, bias, earth)
        rows, noise = self._rows(), (bias, earth)
        epochs_ns = self.epochs(start_ns, min(end_ns, known_ns))
        if len(epochs_ns):
            first_ns = int(epochs_ns[0])
            head = motion_over(rows, self._sensors, start_ns, first_ns, known_ns, *noise)
            if first_ns == end_ns:
                return head
            earth = head.i_T_j.rotation().unrotate(earth)
            return head.then(self._since_epoch(first_ns, end_ns, known_ns, bias, earth))
        before_ns = self.epochs(dvl_ns[0] - 1, end_ns)
        if start_ns < end_ns and len(before_ns) and self.is_gap(int(before_ns[-1]), end_ns):
            lost_ns = int(before_ns[-1])
            return remaining_motion(*(self._since_epoch(lost_ns, t, known_ns, *noise) for t in (start_ns, end_ns)))
        return motion_over(rows, self._sensors, start_ns, end_ns, known_ns, *noise)

    def motions(self, start_ns: Ints, end_ns: Ints, known_ns: Ints, bias: Floats) -> Motions:
        """Motions over intervals, each from rows stamped no later than its ``known_ns``."""
        sensors = self._sensors
        noise = bias, ZERO, sensors.body_p_dvl, sensors.gyro_density
        return motions_over(self._rows(), start_ns, end_ns, known_ns, sensors.longest_ns, *noise)

    def velocity_at_imu(self, epoch_ns: int) -> tuple[Floats, float]:
        """Velocity of the IMU's point at an epoch, body axes, shape (3,), m/s, and the variance of one component."""
        if not self._is_doppler_stamp(epoch_ns):
            raise no_doppler_stamp("epoch_ns", epoch_ns, self._dvl.stamps_ns)
        k, i = (int(stamps.searchsorted(epoch_ns)) for stamps in (self._dvl.stamps_ns, self._imu.stamps_ns))
        (velocity, cov), (rates, _), imu_ns = self._dvl.values, self._imu.values, self._imu.stamps_ns
        rate = rates[min(i, len(rates) - 1)]
        if 0 < i < len(rates) and not self._hold_past:
            rate = rates[i - 1] + (epoch_ns - imu_ns[i - 1]) / (imu_ns[i] - imu_ns[i - 1]) * (rates[i] - rates[i - 1])
        (x, y, z), (a, b, c) = rate.tolist(), self._dvl_p_imu
        swing = y * c - z * b, z * a - x * c, x * b - y * a
        return velocity[k] + swing, float(cov[k, 0, 0] + cov[k, 1, 1] + cov[k, 2, 2]) / 3.0

    def _rows(self) -> Rows:
        imu, dvl = self._imu, self._dvl
        return Rows(imu.stamps_ns, *imu.values, dvl.stamps_ns, *dvl.values, self._hold_past, self._turns)

    def _is_doppler_stamp(self, instant_ns: int) -> bool:
        k = self._dvl.stamps_ns.searchsorted(instant_ns)
        return bool(k < len(self._dvl.stamps_ns) and self._dvl.stamps_ns[k] == instant_ns)

    def _since_epoch(
        self, start_ns: int, end_ns: int, known_ns: int, bias: Floats, earth: Floats
    ) -> PreintegratedMotion:
        """Motion from an epoch: final to the newest one, provisional from there on."""
        key, rows, at_ns, motion = (start_ns, bias.tobytes(), earth.tobytes()), self._rows(), start_ns, None
        epochs_ns = self.epochs(start_ns, known_ns)
        epochs_ns = epochs_ns[: epochs_ns.searchsorted(end_ns, side="right")]
        if len(epochs_ns):
            newest_ns = int(epochs_ns[-1])
            if self._final is not None and self._final[0] == key and self._final[1] <= newest_ns:
                _, at_ns, motion = self._final
            if at_ns < newest_ns:
                marks_ns = np.concatenate([[at_ns], epochs_ns[epochs_ns.searchsorted(at_ns, side="right") :]])
                for k in np.flatnonzero(marks_ns[1:] - marks_ns[:-1] > self._sensors.longest_ns).tolist():
                    lost_ns, found_ns = int(marks_ns[k]), int(marks_ns[k + 1])
                    if at_ns < lost_ns:
                        motion = self._extended(motion, rows, at_ns, lost_ns, bias, earth)
                    over_gap = bridge(rows, self._sensors, lost_ns, found_ns, True, bias, _in_frame(motion, earth))
                    motion, at_ns = over_gap if motion is None else motion.then(over_gap), found_ns
                if at_ns < newest_ns:
                    motion, at_ns = self._extended(motion, rows, at_ns, newest_ns, bias, earth), newest_ns
            assert motion is not None
            self._final = key, at_ns, motion
        if motion is not None and at_ns == end_ns:
            return motion
        if self.is_gap(at_ns, end_ns):
            rest = bridge(rows, self._sensors, at_ns, end_ns, False, bias, _in_frame(motion, earth))
        else:
            rest = motion_over(rows, self._sensors, at_ns, end_ns, known_ns, bias, _in_frame(motion, earth))
        return rest if motion is None else motion.then(rest)

    def _extended(
        self, motion: PreintegratedMotion | None, rows: Rows, at_ns: int, end_ns: int, bias: Floats, earth: Floats
    ) -> PreintegratedMotion:
        """A motion, or none, followed by the final one between two epochs without a gap."""
        known_ns = int(self.reached_ns(np.array([end_ns]))[0])
        more = motion_over(rows, self._sensors, at_ns, end_ns, known_ns, bias, _in_frame(motion, earth))
        return more if motion is None else motion.then(more)


def _in_frame(motion: PreintegratedMotion | None, earth: Floats) -> Floats:
    """Earth's rotation in the last frame of a motion."""
    return earth if motion is None else motion.i_T_j.rotation().unrotate(earth)
