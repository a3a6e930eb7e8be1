"""Motion by gyros and Doppler log between two instants.

Epochs. The stamps of the DVL rows are *epochs* (`nodes` in code): between two epochs the velocity is known on both
sides and the motion is final. An epoch counts as reached at time t when its own row and an IMU row at or after it are
stamped at or before t. What happens between epochs (a detection, a depth sample, an estimate) is related to the newest
reached epoch by a provisional motion that uses nothing stamped later. Results therefore depend on stamps alone, not on
how a log is cut into blocks. One exception: where rows are added long before they are used, the first velocities, and
those after a long gap, are epochs once later ones have confirmed them
(`sonar_graph.navigation.dvl_screening.dvl_gate`).

Gaps. Without a gap of the log the motion runs over the steps between the instants. A gap between two epochs is bridged
with both its ends known. In a gap that lasts, both instants are reached from the epoch at which bottom lock was lost::

    M = M_1^-1 M_2,    P = P_2 - Ad(M^-1) P_1 Ad(M^-1)^T

P is the growth of the error, so that successive motions, taken as independent, add up to that since the epoch.
docs/theory/preintegration.md, docs/theory/gaps.md.
"""

from dataclasses import replace

import numpy as np

from sonar_graph.calibration import ROWS_BEFORE, Calibration
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.motion import Motions, PreintegratedMotion
from sonar_graph.navigation.dvl_screening import RowIntake
from sonar_graph.navigation.imu_gaps import NO_TURNS, UNTURNED, turn_values, turns_of
from sonar_graph.navigation.preintegration import (
    Columns,
    Preintegrator,
    Steps,
    are_nodes,
    merge_rows,
)
from sonar_graph.navigation.preintegration.steps import Rows, steps_over
from sonar_graph.navigation.preintegration.sums import motions_over
from sonar_graph.navigation.samples import (
    EARLIEST_NS,
    WINDOW_NS,
    longest_interval_ns,
    no_doppler_stamp,
    node_range,
    rows_before_gaps,
    rows_until,
    value_at,
)
from sonar_graph.states import RefusedRow

ZERO_RATE = np.zeros(3)


class Odometry:
    """Rows of both sensors that are still needed, and the steps between two instants.

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
    >>> from sonar_graph.navigation import Odometry, Preintegrator, motion_between_nodes
    >>> imu_ns, dvl_ns = np.arange(201) * 10_000_000, np.arange(11) * 200_000_000
    >>> odometry = Odometry(Calibration())
    >>> odometry.add(
    ...     Imu(imu_ns, np.zeros((201, 3)), np.tile([0.0, 0.0, 9.81], (201, 1))),
    ...     Dvl(dvl_ns, np.tile([0.5, 0.0, 0.0], (11, 1)), np.full((11, 3, 3), np.nan)),
    ... )
    False
    >>> sensors = Preintegrator.from_calibration(Calibration())
    >>> motion = motion_between_nodes(odometry, sensors, 0, 1_000_000_000, np.zeros(3), None)
    >>> round(float(motion.i_T_j.x()), 6), motion.covariance.shape
    (0.5, (6, 6))
    """

    def __init__(self, calibration: Calibration) -> None:
        self._intake = RowIntake(calibration)
        self._imu, self._dvl = self._intake.imu, self._intake.dvl
        self._hold_past = calibration.odometry_interpolation == "hold-past"
        self._turns = NO_TURNS if self._hold_past else turn_values(calibration.imu)
        self._turn_model = UNTURNED if self._hold_past else turns_of(calibration.imu)
        self._longest_ns = longest_interval_ns(calibration)
        self._preintegrator = Preintegrator.from_calibration(calibration)
        latitude = calibration.earth_rate_latitude_rad
        self._calibration_earth = None
        if latitude is not None:
            self._calibration_earth = 7.292115e-5 * np.array([0.0, np.cos(latitude), np.sin(latitude)])
        self._running: tuple[object, int, RunningMotion] | None = None
        self._dvl_p_imu = np.subtract(calibration.imu.mounting.translation_m, calibration.dvl.mounting.translation_m)

    @property
    def refused(self) -> list[RefusedRow]:
        """Rows that are not used, and why; includes rows that may still be completed or confirmed."""
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
        if not (isinstance(imu, Imu | None) and isinstance(dvl, Dvl | None)):
            raise MeasurementError(f"imu, dvl: expected Imu and Dvl, not {type(imu).__name__} and {type(dvl).__name__}")
        placed_imu = imu is not None and self._intake.add_imu(imu)
        placed_dvl = dvl is not None and self._intake.add_dvl(dvl)
        self._running = None if placed_imu or placed_dvl else self._running
        return placed_imu or placed_dvl

    def settle(self, node_ns: int) -> None:
        """Fix the motion up to an epoch: rows stamped at or before it are late from now on."""
        self._intake.settled_ns = max(self._intake.settled_ns, node_ns)

    def forget_before(self, node_ns: int) -> None:
        """Settle, and drop rows that no motion from this epoch on can need, gaps after it included."""
        self.settle(node_ns)
        needed_ns = node_ns if self._hold_past else node_ns - WINDOW_NS
        self._imu.forget_before(needed_ns, ROWS_BEFORE)
        self._dvl.forget_before(needed_ns)

    def columns(self) -> Columns:
        """All rows, for compiled loops over many instants."""
        imu, dvl = self._imu, self._dvl
        return imu.stamps_ns, *imu.values, dvl.stamps_ns, *dvl.values, self._hold_past, self._turns

    def start_ns(self) -> int | None:
        """First epoch that IMU rows cover from both sides; None before there is one."""
        if not len(self._imu.stamps_ns) or not len(self._dvl.stamps_ns):
            return None
        first = np.searchsorted(self._dvl.stamps_ns, self._imu.stamps_ns[0])
        if first == len(self._dvl.stamps_ns) or self._dvl.stamps_ns[first] > self._imu.stamps_ns[-1]:
            return None
        return int(self._dvl.stamps_ns[first])

    def start_reached_ns(self, start_ns: int) -> int:
        """Instant at which the first epoch was reached: an IMU row covers it, and its velocity is confirmed."""
        covered_ns = int(self._imu.stamps_ns[np.searchsorted(self._imu.stamps_ns, start_ns)])
        return max(covered_ns, self._intake.start_known_ns)

    def start_by(self, until_ns: int) -> int | None:
        """First epoch, if it is reached at an instant; else None."""
        start_ns = self.start_ns()
        if start_ns is None or self.start_reached_ns(start_ns) > until_ns:
            return None
        return start_ns

    def nodes(self, after_ns: int, until_ns: int) -> Ints:
        """Epochs after one instant that are reached at another, in order."""
        first, last = node_range(self._imu.stamps_ns, self._dvl.stamps_ns, after_ns, until_ns)
        return self._dvl.stamps_ns[first:last]

    def newest_node(self, after_ns: int, until_ns: int) -> int | None:
        """Last of `nodes`; None where there is none."""
        nodes = self.nodes(after_ns, until_ns)
        return int(nodes[-1]) if len(nodes) else None

    def steps_between_nodes(self, start_ns: int, end_ns: int) -> Steps:
        """Steps of the final motion from one epoch to a later, reached one.

        Raises MeasurementError where an end is no epoch or not covered by IMU rows, or the ends are in the wrong order.
        """
        if not are_nodes(self._imu.stamps_ns, self._dvl.stamps_ns, start_ns, end_ns):
            raise self._no_nodes(start_ns, end_ns, {"start_ns": start_ns, "end_ns": end_ns})
        return self._final_steps(start_ns, end_ns)

    def steps_to_node(self, since_ns: int, node_ns: int) -> Steps:
        """Steps of the final motion to a reached epoch from any instant among the rows, such as one in a gap.

        Raises MeasurementError where the epoch is none or not covered, or the instant is before all rows or after it.
        """
        if not are_nodes(self._imu.stamps_ns, self._dvl.stamps_ns, node_ns, node_ns) or since_ns > node_ns:
            raise self._no_nodes(since_ns, node_ns, {"node_ns": node_ns})
        first_ns = max(self._imu.stamps_ns[0], self._dvl.stamps_ns[0])
        if since_ns < first_ns:
            raise MeasurementError(f"since_ns: {since_ns} lies before the rows; begin at {first_ns} or later")
        return self._final_steps(since_ns, node_ns)

    def steps_since_node(self, node_ns: int, until_ns: int) -> Steps:
        """Steps of the provisional motion from a reached epoch to a later instant, from rows stamped no later.

        Raises MeasurementError where the epoch is none or not reached, or the instant lies before it.
        """
        if until_ns < node_ns or not are_nodes(self._imu.stamps_ns, self._dvl.stamps_ns, node_ns, node_ns):
            raise self._no_nodes(node_ns, until_ns, {"node_ns": node_ns})
        imu_rows = int(np.searchsorted(self._imu.stamps_ns, until_ns, side="right"))
        dvl_rows = int(np.searchsorted(self._dvl.stamps_ns, until_ns, side="right"))
        return self._steps(node_ns, until_ns, imu_rows, dvl_rows)

    def is_gap(self, start_ns: int, end_ns: int) -> bool:
        """True for a time without samples that is too long for a linear velocity."""
        return end_ns - start_ns > self._longest_ns

    def gaps(self, start_ns: int, end_ns: int) -> list[tuple[int, int]]:
        """Stamps of successive epochs with a gap in between, from one epoch to another."""
        stamps_ns = self._dvl.stamps_ns
        rows = rows_before_gaps(stamps_ns, start_ns, end_ns, self._longest_ns)
        return [(int(stamps_ns[row]), int(stamps_ns[row + 1])) for row in rows]

    def _final_steps(self, start_ns: int, end_ns: int) -> Steps:
        imu_rows = int(np.searchsorted(self._imu.stamps_ns, end_ns)) + 1
        dvl_rows = int(np.searchsorted(self._dvl.stamps_ns, end_ns, side="right"))
        return self._steps(start_ns, end_ns, imu_rows, dvl_rows)

    def _steps(self, start_ns: int, end_ns: int, imu_rows: int, dvl_rows: int) -> Steps:
        return Steps(*merge_rows(self.columns(), imu_rows, dvl_rows, start_ns, end_ns))

    def _no_nodes(self, start_ns: int, end_ns: int, nodes: dict[str, int]) -> MeasurementError:
        """The error for an interval whose named ends have to be epochs."""
        if end_ns < start_ns:
            return MeasurementError(f"interval: ends at {end_ns} ns, before its start {start_ns}; the earlier first")
        for name, instant_ns in nodes.items():
            if instant_ns not in self._dvl.stamps_ns:
                return no_doppler_stamp(name, instant_ns, self._dvl.stamps_ns)
        imu_ns = self._imu.stamps_ns
        covered = f"from {imu_ns[0]} to {imu_ns[-1]} ns" if len(imu_ns) else "none"
        return MeasurementError(
            f"{', '.join(nodes)}: IMU rows ({covered}) do not cover {', '.join(map(str, nodes.values()))}; take nodes"
            " from start_ns() on, of nodes()"
        )

    def epochs(self, after_ns: int, until_ns: int) -> Ints:
        """Epochs after one instant that are reached at another, in order, shape (n,)."""
        return self.nodes(after_ns, until_ns)

    def reached_ns(self, epochs_ns: Ints) -> Ints:
        """Instants at which epochs are reached: stamps of the first IMU rows at or after them, shape (n,)."""
        return self._imu.stamps_ns[np.searchsorted(self._imu.stamps_ns, epochs_ns)]

    def motion(
        self, start_ns: int, end_ns: int, bias: Floats, world_R_i: Floats | None = None, known_ns: int | None = None
    ) -> PreintegratedMotion:
        """Motion from one instant to another, over gaps too, from rows stamped no later than an instant."""
        earth = self._calibration_earth
        earth_rate = None if earth is None or world_R_i is None else world_R_i.T @ earth
        known = end_ns if known_ns is None else known_ns
        if are_nodes(self._imu.stamps_ns, self._dvl.stamps_ns, start_ns, end_ns) and (
            known_ns is None or self.reached_ns(np.array([end_ns]))[0] <= known
        ):
            return motion_between_nodes(self, self._preintegrator, start_ns, end_ns, bias, earth_rate)
        if not are_nodes(self._imu.stamps_ns, self._dvl.stamps_ns, start_ns, start_ns):
            return motion_between(self, self._preintegrator, start_ns, end_ns, bias)
        asked = start_ns, bias.tobytes(), None if earth_rate is None else earth_rate.tobytes()
        if self._running is None or self._running[0] != asked or end_ns < self._running[1]:
            self._running = asked, end_ns, RunningMotion(self, self._preintegrator, start_ns, bias, earth_rate)
        self._running = asked, end_ns, self._running[2]
        return self._running[2].until(end_ns)

    def motions(self, start_ns: Ints, end_ns: Ints, known_ns: Ints, bias: Floats) -> Motions:
        """Motions over intervals, each from rows stamped no later than its ``known_ns``."""
        sensors = self._preintegrator
        steps = steps_over(self._rows(), start_ns, end_ns, known_ns, self._longest_ns)
        return motions_over(*steps, bias, ZERO_RATE, sensors.body_p_dvl, sensors.gyro_noise_density)

    def _rows(self) -> Rows:
        imu, dvl = self._imu, self._dvl
        return Rows(imu.stamps_ns, *imu.values, dvl.stamps_ns, *dvl.values, self._hold_past, self._turn_model)

    def velocity_at_imu(self, epoch_ns: int) -> tuple[Floats, float]:
        """Velocity of the IMU's point at an epoch, body axes, shape (3,), m/s, and the variance of one component."""
        velocity, cov, rate = self.velocity_at_node(epoch_ns)
        return velocity + np.cross(rate, self._dvl_p_imu), float(np.trace(cov)) / 3.0

    def velocity_at_node(self, node_ns: int) -> tuple[Floats, Floats, Floats]:
        """DVL velocity (body axes), its covariance, and the angular rate at an epoch; shapes (3,), (3, 3), (3,)."""
        k = int(np.searchsorted(self._dvl.stamps_ns, node_ns))
        if k == len(self._dvl.stamps_ns) or self._dvl.stamps_ns[k] != node_ns:
            raise no_doppler_stamp("node_ns", node_ns, self._dvl.stamps_ns)
        i = int(np.searchsorted(self._imu.stamps_ns, node_ns))
        rate = value_at(self._imu.stamps_ns, self._imu.values[0], i, node_ns, self._hold_past)
        return self._dvl.values[0][k], self._dvl.values[1][k], np.array(rate)


def motion_between_nodes(
    odometry: Odometry,
    preintegrator: Preintegrator,
    start_ns: int,
    end_ns: int,
    bias: Floats,
    earth_rate: Floats | None,
) -> PreintegratedMotion:
    """Final motion from one epoch to a later, reached one; each gap in between is bridged with both its ends known.

    Parameters
    ----------
    bias
        Gyro bias in the body frame to remove, shape (3,), rad/s.
    earth_rate
        Earth's rotation in the body frame at the first epoch, shape (3,), rad/s; None: not removed.
    """
    gaps = odometry.gaps(start_ns, end_ns) if preintegrator.gap else []
    if not gaps:
        return preintegrator.integrate(odometry.steps_between_nodes(start_ns, end_ns), bias, earth_rate)
    total, at_ns = None, start_ns
    for lost_ns, found_ns in [*gaps, (end_ns, end_ns)]:
        if at_ns < lost_ns:
            steps = odometry.steps_between_nodes(at_ns, lost_ns)
            total = _then(total, preintegrator.integrate(steps, bias, _turned(earth_rate, total)))
        if lost_ns < found_ns:
            gap = preintegrator.bridge(odometry.columns(), lost_ns, found_ns, True, bias, _turned(earth_rate, total))
            total = _then(total, gap)
        at_ns = found_ns
    assert total is not None
    return total


def motion_since_node(
    odometry: Odometry,
    preintegrator: Preintegrator,
    node_ns: int,
    until_ns: int,
    bias: Floats,
    earth_rate: Floats | None,
) -> PreintegratedMotion:
    """Provisional motion from the newest reached epoch to an instant, from rows stamped no later than that."""
    if preintegrator.gap and odometry.is_gap(node_ns, until_ns):
        return preintegrator.bridge(odometry.columns(), node_ns, until_ns, False, bias, earth_rate)
    return preintegrator.integrate(odometry.steps_since_node(node_ns, until_ns), bias, earth_rate)


def _then(before: PreintegratedMotion | None, motion: PreintegratedMotion) -> PreintegratedMotion:
    """A motion after another, if there is one before."""
    return motion if before is None else before.then(motion)


def _turned(earth_rate: Floats | None, motion: PreintegratedMotion | None) -> Floats | None:
    """Earth's rotation in the frame at the end of a motion."""
    if earth_rate is None or motion is None:
        return earth_rate
    return motion.i_T_j.rotation().unrotate(earth_rate)


class RunningMotion:
    """Motion from one epoch to later and later instants; final motion between epochs is kept, not integrated again.

    Parameters
    ----------
    start_ns
        Stamp of the epoch.
    bias
        Gyro bias to remove, shape (3,), rad/s.
    earth_rate
        Earth's rotation in the body frame at the epoch, shape (3,), rad/s; None: not removed.
    """

    def __init__(
        self, odometry: Odometry, preintegrator: Preintegrator, start_ns: int, bias: Floats, earth_rate: Floats | None
    ) -> None:
        self._odometry, self._preintegrator = odometry, preintegrator
        self._bias, self._earth_rate = bias, earth_rate
        self._reached_ns = start_ns
        self._reached: PreintegratedMotion | None = None

    def until(self, instant_ns: int) -> PreintegratedMotion:
        """Provisional motion to an instant not before that of any earlier call."""
        sensors = self._odometry, self._preintegrator
        newest_ns = self._odometry.newest_node(self._reached_ns, instant_ns)
        if newest_ns is not None:
            earth = _turned(self._earth_rate, self._reached)
            motion = motion_between_nodes(*sensors, self._reached_ns, newest_ns, self._bias, earth)
            self._reached, self._reached_ns = _then(self._reached, motion), newest_ns
        if instant_ns == self._reached_ns and self._reached is not None:
            return self._reached
        earth = _turned(self._earth_rate, self._reached)
        return _then(self._reached, motion_since_node(*sensors, self._reached_ns, instant_ns, self._bias, earth))


def motion_between(
    odometry: Odometry, preintegrator: Preintegrator, start_ns: int, end_ns: int, bias: Floats
) -> PreintegratedMotion:
    """Provisional motion from one instant to a later one, the first not before the first epoch.

    Parameters
    ----------
    bias
        Gyro bias in the body frame to remove, shape (3,), rad/s.
    """
    newest_ns = odometry.newest_node(start_ns, end_ns)
    if newest_ns is None:
        lost_ns = odometry.newest_node(EARLIEST_NS, end_ns)
        if lost_ns is None or start_ns == end_ns or not odometry.is_gap(lost_ns, end_ns):
            return _over_steps(odometry, preintegrator, start_ns, end_ns, end_ns, bias)
        whole = motion_since_node(odometry, preintegrator, lost_ns, end_ns, bias, None)
        if lost_ns == start_ns:
            return whole
        return remaining_motion(motion_since_node(odometry, preintegrator, lost_ns, start_ns, bias, None), whole)
    first_ns = int(odometry.nodes(start_ns - 1, end_ns)[0])
    if not (odometry.gaps(first_ns, newest_ns) or odometry.is_gap(newest_ns, end_ns)):
        return _over_steps(odometry, preintegrator, start_ns, end_ns, end_ns, bias)
    motion = motion_between_nodes(odometry, preintegrator, first_ns, newest_ns, bias, None)
    if start_ns < first_ns:
        motion = _over_steps(odometry, preintegrator, start_ns, first_ns, end_ns, bias).then(motion)
    if newest_ns < end_ns:
        motion = motion.then(motion_since_node(odometry, preintegrator, newest_ns, end_ns, bias, None))
    return motion


def remaining_motion(before: PreintegratedMotion, whole: PreintegratedMotion) -> PreintegratedMotion:
    """The rest of a whole motion after a first part of it; P of the module's equation."""
    motion = before.i_T_j.between(whole.i_T_j)
    adjoint = motion.inverse().AdjointMap()
    grown = whole.covariance - adjoint @ before.covariance @ adjoint.T
    variances, axes = np.linalg.eigh(0.5 * (grown + grown.T))
    impulse = whole.mean_specific_force * whole.duration_s - before.mean_specific_force * before.duration_s
    duration_s = whole.duration_s - before.duration_s
    return replace(
        whole,
        i_T_j=motion,
        covariance=(axes * np.maximum(variances, 0.0)) @ axes.T,
        D_bias=whole.D_bias - adjoint @ before.D_bias,
        duration_s=duration_s,
        mean_specific_force=before.i_T_j.rotation().unrotate(impulse / duration_s),
    )


def _over_steps(
    odometry: Odometry, preintegrator: Preintegrator, start_ns: int, end_ns: int, known_ns: int, bias: Floats
) -> PreintegratedMotion:
    """Motion over linear or held velocities, from rows stamped up to an instant not before the end."""
    columns = odometry.columns()
    rows = rows_until(columns[0], known_ns), rows_until(columns[3], known_ns)
    return preintegrator.integrate(Steps(*merge_rows(columns, *rows, start_ns, end_ns)), bias)
