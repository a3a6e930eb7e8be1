"""Motion by gyros and Doppler log between any two instants.

Epochs. The stamps of the DVL rows are *epochs*: between two epochs the velocity is known on both sides and the motion
is final. A row is known from its own stamp on, one that waits (the first velocities, those after a long gap) from
that of the row that confirms it (`sonar_graph.navigation.dvl_screening`). An epoch
counts as reached at time t when its row is known and an IMU row at or after it is stamped at or before t. What happens
between epochs (a detection, a depth sample, an estimate) is related to the newest reached epoch by a provisional motion
that uses nothing known later. Results therefore depend on stamps alone, to the bit, not on how a log is cut into calls
or on earlier calls, as long as no row comes after another of its sensor that is stamped later.

Gaps. A gap between two epochs is bridged with both its ends known. In a gap that lasts, both instants are reached from
the epoch at which bottom lock was lost::

    M = M_1^-1 M_2,    P = P_2 - Ad(M^-1) P_1 Ad(M^-1)^T

P is the growth of the error, so that successive motions, taken as independent, add up to that since the epoch.
docs/theory/preintegration.md, docs/theory/gaps.md.
"""

from types import NoneType

import numpy as np

from sonar_graph.calibration import ROWS_BEFORE, Calibration, require_calibration
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Depth, Dvl, Floats, Imu, Ints
from sonar_graph.motion import Motions, PreintegratedMotion, earth_rate_in_world
from sonar_graph.navigation.dvl_gaps import (
    closed_bridge,
    end_of_gap,
    open_bridge,
    remaining_motion,
    walked_until_end,
)
from sonar_graph.navigation.dvl_screening import RowIntake
from sonar_graph.navigation.imu_gaps import UNTURNED, turns_of
from sonar_graph.navigation.preintegration import (
    Intervals,
    Removed,
    Rows,
    Sensors,
    Stretch,
    motions_over,
    rows_until,
)
from sonar_graph.navigation.samples import (
    EARLIEST_NS,
    LATEST_NS,
    WINDOW_NS,
    finite_vector,
    no_doppler_stamp,
)
from sonar_graph.numerics import compiled
from sonar_graph.sequence import PAUSE_NS
from sonar_graph.states import RefusedRow

ZERO = np.zeros(3)


NOTHING_KEPT: tuple[object, Stretch] = (None, Stretch.begin(0, ZERO))


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
    >>> imu_ns = np.arange(201) * 10_000_000
    >>> dvl_ns = np.arange(11) * 200_000_000
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
        require_calibration(calibration, "Odometry(calibration)")
        self.calibration = calibration
        """Calibration that it was made with."""
        self._intake = RowIntake(calibration)
        self._imu = self._intake.imu
        self._dvl = self._intake.dvl
        self._hold_past = calibration.odometry_interpolation == "hold-past"
        self._turns = UNTURNED if self._hold_past else turns_of(calibration.imu)
        self._sensors = Sensors.of(calibration)
        self._dvl_p_imu = (self._sensors.body_p_imu - self._sensors.body_p_dvl).tolist()
        self._earth = earth_rate_in_world(calibration)
        self._kept = NOTHING_KEPT
        """Start, bias and Earth's rotation of a motion, and its part since the last gap, with the motion before it."""

    @property
    def refused(self) -> list[RefusedRow]:
        """Rows that are not used, with the reason; includes rows that may still be completed or confirmed."""
        return self._intake.refused

    def add(self, imu: Imu | None, dvl: Dvl | None) -> bool:
        """Add rows and place them by their stamps.

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
            raise MeasurementError(
                f"imu, dvl: expected Imu and Dvl, not {type(imu).__name__} and {type(dvl).__name__}"
            )
        placed_imu = imu is not None and self._intake.add_imu(imu)
        placed_dvl = dvl is not None and self._intake.add_dvl(dvl)
        if placed_imu or placed_dvl:
            self._kept = NOTHING_KEPT
        return placed_imu or placed_dvl

    def used_depths(self, depth: Depth | None) -> Depth | None:
        """Depth samples that a vehicle can have measured, each stamp once, None without any; others go to `refused`."""
        return None if depth is None else self._intake.used_depths(depth)

    def settle(self, epoch_ns: int) -> None:
        """Declare the motion up to an epoch as used: rows stamped at or before it are late from now on."""
        self._intake.settled_ns = max(self._intake.settled_ns, epoch_ns)

    def forget_before(self, epoch_ns: int) -> None:
        """Settle, and drop rows that no motion from this epoch on can need, gaps after it included."""
        self.settle(epoch_ns)
        # a gap that opens at the epoch is bridged by a line through the window before it
        needed_ns = epoch_ns if self._hold_past else epoch_ns - WINDOW_NS
        self._imu.forget_before(needed_ns, ROWS_BEFORE)
        self._dvl.forget_before(needed_ns)

    def start_by(self, until_ns: int) -> int | None:
        """First epoch, if it is reached at an instant: IMU rows cover it, and its velocity is confirmed; else None.

        It is the first instant with both sensors, where the start pose holds. Where the IMU begins between two rows of the
        Doppler log, its first row becomes an epoch.
        """
        imu_ns = self._imu.stamps_ns
        dvl_ns = self._dvl.stamps_ns
        if not len(imu_ns):
            return None
        first = int(dvl_ns.searchsorted(imu_ns[0]))
        if first == len(dvl_ns) or dvl_ns[first] > imu_ns[-1]:
            return None
        first_ns = int(dvl_ns[first])
        # a clock that was set after the first rows of the IMU
        if first_ns - imu_ns[0] > PAUSE_NS:
            self._intake.refuse_imu_before(first_ns - PAUSE_NS)
            return self.start_by(until_ns)
        if self.reached_ns(first_ns) > until_ns:
            return None
        begin_ns = int(imu_ns[0])
        if first == 0 or begin_ns == first_ns:
            return first_ns
        self._add_epoch(begin_ns, first)
        return begin_ns

    def _add_epoch(self, epoch_ns: int, after: int) -> None:
        """Add an epoch before a row of the Doppler log, with the velocity between that row and the one before it."""
        dvl_ns = self._dvl.stamps_ns
        velocity, cov, known_ns = self._dvl.values
        before = after - 1
        share = float((epoch_ns - dvl_ns[before]) / (dvl_ns[after] - dvl_ns[before]))
        # a held velocity is that until the stamp of its row
        share = 1.0 if self._hold_past else share
        between = (1.0 - share) * velocity[before] + share * velocity[after]
        spread = (1.0 - share) ** 2 * cov[before] + share**2 * cov[after]
        # between two known velocities the random walk is a Brownian bridge
        duration_s = (dvl_ns[after] - dvl_ns[before]) * 1e-9
        q = self.calibration.dvl.velocity_walk_density
        spread += q**2 * share * (1.0 - share) * duration_s * np.eye(3)
        known = known_ns[after : after + 1].copy()
        self._dvl.insert(np.array([epoch_ns]), between[None], spread[None], known)
        self._kept = NOTHING_KEPT

    def epochs(self, after_ns: int, until_ns: int) -> Ints:
        """Epochs after one instant that are reached at another, in order, shape (n,)."""
        first, last = self._epochs_between(after_ns, until_ns)
        return self._dvl.stamps_ns[first:last]

    def epochs_reached(self, after_ns: int, until_ns: int) -> tuple[Ints, Ints]:
        """`epochs` and their `reached_ns`, shapes (n,)."""
        first, last = self._epochs_between(after_ns, until_ns)
        imu_ns = self._imu.stamps_ns
        known_ns = self._dvl.values[2]
        epochs_ns = self._dvl.stamps_ns[first:last]
        # stamp of the IMU row that covers each epoch
        covered_ns = imu_ns[imu_ns.searchsorted(epochs_ns)]
        return epochs_ns, np.maximum(covered_ns, known_ns[first:last])

    def reached_ns(self, epoch_ns: int) -> int:
        """Instant at which an epoch is reached: an IMU row covers it, and its velocity is known."""
        imu_ns = self._imu.stamps_ns
        dvl_ns = self._dvl.stamps_ns
        known_ns = self._dvl.values[2]
        return int(
            max(
                imu_ns[imu_ns.searchsorted(epoch_ns)],
                known_ns[dvl_ns.searchsorted(epoch_ns)],
            )
        )

    def is_gap(self, start_ns: int, end_ns: int) -> bool:
        """True for a time without Doppler rows that is too long for a linear velocity."""
        return end_ns - start_ns > self._sensors.longest_ns

    def motion(
        self,
        start_ns: int,
        end_ns: int,
        bias: Floats,
        world_R_i: Floats | None = None,
        known_ns: int | None = None,
    ) -> PreintegratedMotion:
        """Motion from one instant to another, over gaps too, from rows known at ``known_ns``, by default the second.

        To an epoch, name an instant at which it is reached. The part up to the newest epoch is final and kept: the same
        start and bias, with later and later ends, cost what is new.

        Raises
        ------
        MeasurementError
            When the instants are no integers or in the wrong order, the first lies before all rows, or the bias is no
            finite vector.
        """
        bias = finite_vector("bias", bias, 3)
        self._require_interval(start_ns, end_ns)
        if known_ns is None:
            known_ns = end_ns
        # without an attitude the Earth's rotation in frame i is not known
        earth = (
            ZERO
            if self._earth is None or world_R_i is None
            else world_R_i.T @ self._earth
        )
        removed = Removed(bias, earth)
        # the IMU row that covers an epoch may come after the epoch's own stamp
        epochs_ns = self.epochs(EARLIEST_NS, known_ns)
        epochs_ns = epochs_ns[: epochs_ns.searchsorted(end_ns, side="right")]
        known = self.rows().known(known_ns)
        lost_ns = int(epochs_ns[-1]) if len(epochs_ns) else end_ns
        if lost_ns < start_ns < end_ns and self.is_gap(lost_ns, end_ns):
            # both instants lie in one open gap
            before = self._motion_since(lost_ns, start_ns, known, epochs_ns, removed)
            whole = self._motion_since(lost_ns, end_ns, known, epochs_ns, removed)
            return remaining_motion(before, whole)
        return self._motion_since(start_ns, end_ns, known, epochs_ns, removed)

    def motions(
        self,
        start_ns: Ints,
        end_ns: Ints,
        known_ns: Ints,
        bias: Floats,
        *,
        over_gaps: bool = False,
    ) -> Motions:
        """Motions over intervals, each from rows known at its ``known_ns``."""
        longest_ns = LATEST_NS if over_gaps else self._sensors.longest_ns
        intervals = Intervals(start_ns, end_ns, known_ns, longest_ns)
        removed = Removed(bias, ZERO)
        motions = motions_over(self.rows(), intervals, self._sensors, removed)
        if over_gaps:
            walked_m2 = self._walked_m2(start_ns, end_ns)  # (n,)
            motions.C[:, 3:, 3:] += walked_m2[:, None, None] * np.eye(3)
        return motions

    def _walked_m2(self, start_ns: Ints, end_ns: Ints) -> Floats:
        """What the walk of the velocity in closed gaps adds to the displacement over each interval, shape (n,)."""
        first = max(int(self._dvl.stamps_ns.searchsorted(start_ns[0])) - 1, 0)
        dvl_ns = self._dvl.stamps_ns[first:]
        is_gap = dvl_ns[1:] - dvl_ns[:-1] > self._sensors.longest_ns
        if not is_gap.any():
            return np.zeros(len(start_ns))
        found_ns = dvl_ns[1:][is_gap]
        gap_s = (found_ns - dvl_ns[:-1][is_gap]) * 1e-9  # (g,)
        # from both ends of each interval to the end of each gap, (n, g)
        from_start_s = np.clip((found_ns - start_ns[:, None]) * 1e-9, 0.0, gap_s)
        from_end_s = np.clip((found_ns - end_ns[:, None]) * 1e-9, 0.0, gap_s)
        walked_m2 = walked_until_end(
            self._sensors, gap_s, from_start_s
        ) - walked_until_end(self._sensors, gap_s, from_end_s)
        return walked_m2.sum(axis=1)

    def velocity_at_imu(self, epoch_ns: int) -> tuple[Floats, float]:
        """Velocity of the IMU's point at an epoch, body axes, shape (3,), m/s, and the variance of one component."""
        velocity, cov, _ = self._dvl.values
        dvl_ns = self._dvl.stamps_ns
        k = int(dvl_ns.searchsorted(epoch_ns))
        if k == len(dvl_ns) or dvl_ns[k] != epoch_ns:
            raise no_doppler_stamp("epoch_ns", epoch_ns, dvl_ns)
        x, y, z = self._rate_at(epoch_ns)
        a, b, c = self._dvl_p_imu
        # w x (imu - dvl); np.cross takes ten times as long
        swing = (
            y * c - z * b,
            z * a - x * c,
            x * b - y * a,
        )
        xx, yy, zz = cov[k].diagonal().tolist()
        return velocity[k] + swing, (xx + yy + zz) / 3.0

    def _rate_at(self, epoch_ns: int) -> list[float]:
        """Angular rate at an epoch, body axes, rad/s."""
        rate = self._imu.values[0]
        imu_ns = self._imu.stamps_ns
        i = int(imu_ns.searchsorted(epoch_ns))
        after: list[float] = rate[min(i, len(rate) - 1)].tolist()
        if self._hold_past or not 0 < i < len(rate):
            return after
        share = float((epoch_ns - imu_ns[i - 1]) / (imu_ns[i] - imu_ns[i - 1]))
        return [
            w_0 + share * (w - w_0)
            for w_0, w in zip(rate[i - 1].tolist(), after, strict=True)
        ]

    def rows(self) -> Rows:
        """Rows of both sensors that are still needed."""
        inertial = self._imu
        log = self._dvl
        columns = (
            inertial.stamps_ns,
            *inertial.values,
            log.stamps_ns,
            *log.values,
            self._hold_past,
            self._turns,
        )
        return Rows._make(columns)

    def _epochs_between(self, after_ns: int, until_ns: int) -> tuple[int, int]:
        """First and last row (exclusive) of the epochs after one instant that are reached at another."""
        return _epochs_between(
            after_ns,
            until_ns,
            self._imu.stamps_ns,
            self._dvl.stamps_ns,
            self._dvl.values[2],
        )

    def _lies_in_gap(self, instant_ns: int) -> bool:
        """True where an instant lies between the two epochs of a closed gap."""
        k = int(self._dvl.stamps_ns.searchsorted(instant_ns))
        if not 0 < k < len(self._dvl.stamps_ns):
            return False
        before_ns = int(self._dvl.stamps_ns[k - 1])
        after_ns = int(self._dvl.stamps_ns[k])
        return instant_ns < after_ns and self.is_gap(before_ns, after_ns)

    def _require_interval(self, start_ns: int, end_ns: int) -> None:
        """Raise MeasurementError where rows do not begin before an interval, or its end lies before its start."""
        imu_ns = self._imu.stamps_ns
        dvl_ns = self._dvl.stamps_ns
        if not (len(imu_ns) and len(dvl_ns)):
            raise MeasurementError(
                "motion: needs rows of IMU and Doppler log; add them first"
            )
        for name, instant in (("start_ns", start_ns), ("end_ns", end_ns)):
            if not isinstance(instant, (int, np.integer)):
                raise MeasurementError(
                    f"{name}: expected integer nanoseconds, not {instant!r}; take the stamp of a row"
                )
        if end_ns < start_ns:
            raise MeasurementError(
                f"interval: ends at {end_ns} ns, before its start {start_ns}; the earlier first"
            )
        first_ns = max(imu_ns[0], dvl_ns[0])
        if start_ns < first_ns:
            raise MeasurementError(
                f"start_ns: {start_ns} lies before the rows; begin at {first_ns} or later"
            )

    def _motion_since(
        self,
        start_ns: int,
        end_ns: int,
        rows: Rows,
        epochs_ns: Ints,
        removed: Removed,
    ) -> PreintegratedMotion:
        """Motion from an instant by known rows: final to the newest epoch, provisional from there on.

        Gaps between epochs are bridged; between gaps the motion is one sum of steps. ``epochs_ns``: those that are
        reached, up to the end.
        """
        sensors = self._sensors
        epochs_ns = epochs_ns[epochs_ns.searchsorted(start_ns) :]
        newest_ns = int(epochs_ns[-1]) if len(epochs_ns) else start_ns
        key = start_ns, removed.bias.tobytes(), removed.earth.tobytes()
        # what is final is kept for the next call with the same start, bias and Earth's rotation
        kept_key, stretch = self._kept
        if kept_key != key or stretch.until_ns > newest_ns:
            stretch = Stretch.begin(start_ns, removed.bias)

        if stretch.until_ns < newest_ns:
            new_ns = epochs_ns[epochs_ns.searchsorted(stretch.until_ns) :]
            if stretch.until_ns < new_ns[0] and self._lies_in_gap(start_ns):
                found_ns = int(new_ns[0])
                over_gap = end_of_gap(rows, sensors, removed, start_ns, found_ns)
                stretch = Stretch.begin(found_ns, removed.bias, over_gap)
            is_gap = new_ns[1:] - new_ns[:-1] > sensors.longest_ns
            for k in is_gap.nonzero()[0].tolist():
                lost_ns = int(new_ns[k])
                found_ns = int(new_ns[k + 1])
                (until_lost,) = stretch.continued(rows, sensors, removed, [lost_ns])
                before = until_lost.motion
                here = removed.after(before)
                over_gap = closed_bridge(rows, sensors, here, lost_ns, found_ns)
                stretch = Stretch.begin(found_ns, removed.bias, before.then(over_gap))
        # from the newest epoch on: provisional, and not kept
        is_open = bool(len(epochs_ns)) and self.is_gap(newest_ns, end_ns)
        ends_ns = [newest_ns] if is_open else [newest_ns, end_ns]
        until_newest, *until_end = stretch.continued(rows, sensors, removed, ends_ns)
        self._kept = (key, until_newest)
        if is_open:
            before = until_newest.motion
            here = removed.after(before)
            since_lost = open_bridge(rows, sensors, here, newest_ns, end_ns)
            return before.then(since_lost)
        return until_end[0].motion


@compiled
def _epochs_between(
    after_ns: int, until_ns: int, imu_ns: Ints, dvl_ns: Ints, known_ns: Ints
) -> tuple[int, int]:
    """First and last row (exclusive) of `Odometry.epochs`."""
    # an epoch needs an IMU row at or after it, and a velocity that is known
    seen = rows_until(imu_ns, until_ns)
    first = rows_until(dvl_ns, after_ns)
    last = 0
    if seen > 0:
        last = min(rows_until(known_ns, until_ns), rows_until(dvl_ns, imu_ns[seen - 1]))
    return first, max(first, last)
