"""Motion by gyros and Doppler log, asked for by stamps.

Nodes. The stamps of the DVL rows are *nodes*: between two nodes the velocity is known on both sides and the motion is
final. A node counts as reached at time t when its own row and an IMU row at or after it are stamped at or before t.
Whatever happens between nodes (a detection, a depth sample, an estimate being asked for) is related to the newest
reached node by a provisional motion that uses nothing stamped later. Results therefore depend on stamps alone, not on
how a log is cut into blocks, and nothing peeks ahead. One thing does where rows are added long before they are asked
for: the first velocities, and those after a long gap, are nodes once later ones have confirmed them
(`sonar_graph.navigation.dvl_screening.dvl_gate`).

Rows: `sonar_graph.navigation.dvl_screening.row_intake`. Motion between them:
`sonar_graph.navigation.preintegration.recursion`.

Motion from a node of the odometry, over whatever lies behind it: Doppler samples, and gaps without them.

Motion since a node, asked for at one instant after another, without integrating twice what is final.

Motion between any two instants, from what is stamped no later than the second.

Nodes are the stamps of the Doppler log (`sonar_graph.navigation.odometry`). Without a gap of the log the motion runs
over the steps between the instants. A gap that has ended between two nodes is bridged with both its ends known. In one
that has not, both instants are reached from the node at which bottom lock was lost, and the motion between them is::

    M = M_1^-1 M_2,    P = P_2 - Ad(M^-1) P_1 Ad(M^-1)^T

P is what the error grew by, so that motions which follow each other, taken as independent, add up to that since the
node. What they share makes a single one surer than P says.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonar_graph.calibration import ROWS_BEFORE, Calibration
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.navigation.dvl_screening import RowIntake
from sonar_graph.navigation.imu_gaps import NO_TURNS, turn_values
from sonar_graph.navigation.preintegration import (
    Columns,
    PreintegratedMotion,
    Preintegrator,
    Steps,
    are_nodes,
    merge_rows,
)
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


class Odometry:
    """Keeps the rows that are still needed and turns them into steps.

    Parameters
    ----------
    calibration
        Mountings, DVL noise where the log has none, and the meaning of a sample.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._intake = RowIntake(calibration)
        self._imu, self._dvl = self._intake.imu, self._intake.dvl
        self._hold_past = calibration.odometry_interpolation == "hold-past"
        self._turns = NO_TURNS if self._hold_past else turn_values(calibration.imu)
        self._longest_ns = longest_interval_ns(calibration)

    @property
    def refused(self) -> list[RefusedRow]:
        """Rows that are not used, and why; of too few beams also those that may still be completed."""
        return self._intake.refused

    def add(self, imu: Imu | None, dvl: Dvl | None) -> bool:
        """Take in rows and place them by their stamps.

        Of rows with equal stamps the first counts. A row that comes after motion up to its stamp was settled is late,
        and a velocity may be an outlier (`sonar_graph.navigation.dvl_screening.dvl_gate`): these become rows of
        `refused`.

        Returns
        -------
        Whether rows were placed before others that are there already: provisional motion has to be had anew.

        Raises
        ------
        MeasurementError
            When the blocks are of another kind.
        """
        if not (isinstance(imu, Imu | None) and isinstance(dvl, Dvl | None)):
            raise MeasurementError(f"imu, dvl: expected Imu and Dvl, not {type(imu).__name__} and {type(dvl).__name__}")
        placed_imu = imu is not None and self._intake.add_imu(imu)
        placed_dvl = dvl is not None and self._intake.add_dvl(dvl)
        return placed_imu or placed_dvl

    def settle(self, node_ns: int) -> None:
        """Motion up to a node is used and stays as it is: rows up to there come too late from now on."""
        self._intake.settled_ns = max(self._intake.settled_ns, node_ns)

    def forget_before(self, node_ns: int) -> None:
        """Drop rows that no motion from this node on can need, gaps after it included."""
        self.settle(node_ns)
        needed_ns = node_ns if self._hold_past else node_ns - WINDOW_NS
        self._imu.forget_before(needed_ns, ROWS_BEFORE)
        self._dvl.forget_before(needed_ns)

    def columns(self) -> Columns:
        """All rows, for compiled loops over many instants."""
        return (
            self._imu.stamps_ns,
            *self._imu.values,
            self._dvl.stamps_ns,
            *self._dvl.values,
            self._hold_past,
            self._turns,
        )

    def start_ns(self) -> int | None:
        """First node that IMU rows cover from both sides; None before there is one."""
        if not len(self._imu.stamps_ns) or not len(self._dvl.stamps_ns):
            return None
        first = np.searchsorted(self._dvl.stamps_ns, self._imu.stamps_ns[0])
        if first == len(self._dvl.stamps_ns) or self._dvl.stamps_ns[first] > self._imu.stamps_ns[-1]:
            return None
        return int(self._dvl.stamps_ns[first])

    def start_reached_ns(self, start_ns: int) -> int:
        """When the first node was reached: an IMU row was at or after it, and its velocity was confirmed."""
        covered_ns = int(self._imu.stamps_ns[np.searchsorted(self._imu.stamps_ns, start_ns)])
        return max(covered_ns, self._intake.start_known_ns)

    def start_by(self, until_ns: int) -> int | None:
        """First node, when it is reached at an instant; None before."""
        start_ns = self.start_ns()
        if start_ns is None or self.start_reached_ns(start_ns) > until_ns:
            return None
        return start_ns

    def nodes(self, after_ns: int, until_ns: int) -> Ints:
        """Nodes after one instant that are reached at another, in order."""
        first, last = node_range(self._imu.stamps_ns, self._dvl.stamps_ns, after_ns, until_ns)
        return self._dvl.stamps_ns[first:last]

    def newest_node(self, after_ns: int, until_ns: int) -> int | None:
        """Last of `nodes`; None where there is none."""
        first, last = node_range(self._imu.stamps_ns, self._dvl.stamps_ns, after_ns, until_ns)
        return int(self._dvl.stamps_ns[last - 1]) if last > first else None

    def steps_between_nodes(self, start_ns: int, end_ns: int) -> Steps:
        """Final motion from one node to a later, reached one.

        Raises
        ------
        MeasurementError
            When an end is no node or is not covered by IMU rows, or the ends are in the wrong order.
        """
        if not are_nodes(self._imu.stamps_ns, self._dvl.stamps_ns, start_ns, end_ns):
            raise self._no_nodes(start_ns, end_ns, {"start_ns": start_ns, "end_ns": end_ns})
        return self._final_steps(start_ns, end_ns)

    def steps_to_node(self, since_ns: int, node_ns: int) -> Steps:
        """Final motion to a reached node from any instant between the rows before it, such as one in a gap.

        Raises
        ------
        MeasurementError
            When the node is none or is not covered by IMU rows, or the instant lies before all rows or after the node.
        """
        if not are_nodes(self._imu.stamps_ns, self._dvl.stamps_ns, node_ns, node_ns) or since_ns > node_ns:
            raise self._no_nodes(since_ns, node_ns, {"node_ns": node_ns})
        first_ns = max(self._imu.stamps_ns[0], self._dvl.stamps_ns[0])
        if since_ns < first_ns:
            raise MeasurementError(f"since_ns: {since_ns} lies before the rows; begin at {first_ns} or later")
        return self._final_steps(since_ns, node_ns)

    def steps_since_node(self, node_ns: int, until_ns: int) -> Steps:
        """Provisional motion from a reached node to any later instant, from rows stamped no later than that.

        Raises
        ------
        MeasurementError
            When the node is none or is not reached, or the instant lies before it.
        """
        if until_ns < node_ns or not are_nodes(self._imu.stamps_ns, self._dvl.stamps_ns, node_ns, node_ns):
            raise self._no_nodes(node_ns, until_ns, {"node_ns": node_ns})
        imu_rows = int(np.searchsorted(self._imu.stamps_ns, until_ns, side="right"))
        dvl_rows = int(np.searchsorted(self._dvl.stamps_ns, until_ns, side="right"))
        return self._steps(node_ns, until_ns, imu_rows, dvl_rows)

    def is_gap(self, start_ns: int, end_ns: int) -> bool:
        """Whether the velocity is not taken as linear, or held, over a time without samples."""
        return end_ns - start_ns > self._longest_ns

    def gaps(self, start_ns: int, end_ns: int) -> list[tuple[int, int]]:
        """Stamps of successive nodes with a gap in between, from one node to another."""
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
        """What is wrong with an interval of which these ends have to be nodes."""
        if end_ns < start_ns:
            return MeasurementError(f"interval: ends at {end_ns} ns, before its start {start_ns}; the earlier first")
        for name, instant_ns in nodes.items():
            if instant_ns not in self._dvl.stamps_ns:
                return no_doppler_stamp(name, instant_ns, self._dvl.stamps_ns)
        covered = (
            f"from {self._imu.stamps_ns[0]} to {self._imu.stamps_ns[-1]} ns" if len(self._imu.stamps_ns) else "none"
        )
        return MeasurementError(
            f"{', '.join(nodes)}: IMU rows ({covered}) do not cover {', '.join(map(str, nodes.values()))}; take nodes"
            " from start_ns() on, of nodes()"
        )

    def velocity_at_node(self, node_ns: int) -> tuple[Floats, Floats, Floats]:
        """DVL velocity (body axes), its covariance, and the angular rate at a node; shapes (3,), (3, 3), (3,)."""
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
    """Final motion from one node to a later, reached one; each gap in between is bridged with both its ends known.

    Parameters
    ----------
    bias
        Gyro bias in the body frame to remove, shape (3,), rad/s.
    earth_rate
        Earth's rotation in the body frame at the first node, shape (3,), rad/s; None: not removed.
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
    """Provisional motion from the newest node reached to an instant, from rows stamped no later than that."""
    if preintegrator.gap and odometry.is_gap(node_ns, until_ns):
        return preintegrator.bridge(odometry.columns(), node_ns, until_ns, False, bias, earth_rate)
    return preintegrator.integrate(odometry.steps_since_node(node_ns, until_ns), bias, earth_rate)


def _then(before: PreintegratedMotion | None, motion: PreintegratedMotion) -> PreintegratedMotion:
    return motion if before is None else before.then(motion)


def _turned(earth_rate: Floats | None, motion: PreintegratedMotion | None) -> Floats | None:
    """Earth's rotation after a motion."""
    if earth_rate is None or motion is None:
        return earth_rate
    return motion.i_T_j.rotation().unrotate(earth_rate)


class RunningMotion:
    """Motion from one node to later and later instants.

    Motion between nodes is final and is kept; only what follows the newest reached node is integrated at each call.

    Parameters
    ----------
    start_ns
        The node.
    bias
        Gyro bias to remove, shape (3,), rad/s.
    earth_rate
        Earth's rotation in the body frame at the node, shape (3,), rad/s; None: not removed.
    """

    def __init__(
        self,
        odometry: Odometry,
        preintegrator: Preintegrator,
        start_ns: int,
        bias: Floats,
        earth_rate: Floats | None,
    ) -> None:
        self._odometry = odometry
        self._preintegrator = preintegrator
        self._bias = bias
        self._earth_rate = earth_rate
        self._reached_ns = start_ns
        self._reached: PreintegratedMotion | None = None

    def until(self, instant_ns: int) -> PreintegratedMotion:
        """Provisional motion to an instant not before that of any earlier call."""
        newest_ns = self._odometry.newest_node(self._reached_ns, instant_ns)
        if newest_ns is not None:
            motion = motion_between_nodes(*self._from_reached(newest_ns))
            self._reached = motion if self._reached is None else self._reached.then(motion)
            self._reached_ns = newest_ns
        if instant_ns == self._reached_ns and self._reached is not None:
            return self._reached
        motion = motion_since_node(*self._from_reached(instant_ns))
        return motion if self._reached is None else self._reached.then(motion)

    def _from_reached(self, until_ns: int) -> tuple[Odometry, Preintegrator, int, int, Floats, Floats | None]:
        """What a motion from the newest node reached needs."""
        earth_rate = self._earth_rate
        if earth_rate is not None and self._reached is not None:
            earth_rate = self._reached.i_T_j.rotation().unrotate(earth_rate)
        return self._odometry, self._preintegrator, self._reached_ns, until_ns, self._bias, earth_rate


def motion_between(
    odometry: Odometry, preintegrator: Preintegrator, start_ns: int, end_ns: int, bias: Floats
) -> PreintegratedMotion:
    """Provisional motion from one instant to a later one, the first not before the first node.

    Parameters
    ----------
    bias
        Gyro bias in the body frame to remove, shape (3,), rad/s.
    """
    newest_ns = odometry.newest_node(start_ns, end_ns)
    if newest_ns is None:
        return _without_a_node(odometry, preintegrator, start_ns, end_ns, bias)
    first_ns = int(odometry.nodes(start_ns - 1, end_ns)[0])
    if not (odometry.gaps(first_ns, newest_ns) or odometry.is_gap(newest_ns, end_ns)):
        return _over_steps(odometry, preintegrator, start_ns, end_ns, end_ns, bias)
    motion = motion_between_nodes(odometry, preintegrator, first_ns, newest_ns, bias, None)
    if start_ns < first_ns:
        motion = _over_steps(odometry, preintegrator, start_ns, first_ns, end_ns, bias).then(motion)
    if newest_ns < end_ns:
        motion = motion.then(motion_since_node(odometry, preintegrator, newest_ns, end_ns, bias, None))
    return motion


def _without_a_node(
    odometry: Odometry, preintegrator: Preintegrator, start_ns: int, end_ns: int, bias: Floats
) -> PreintegratedMotion:
    """No node after the first instant is reached at the second."""
    node_ns = odometry.newest_node(EARLIEST_NS, end_ns)
    if node_ns is None or start_ns == end_ns or not odometry.is_gap(node_ns, end_ns):
        return _over_steps(odometry, preintegrator, start_ns, end_ns, end_ns, bias)
    whole = motion_since_node(odometry, preintegrator, node_ns, end_ns, bias, None)
    if node_ns == start_ns:
        return whole
    return _rest(motion_since_node(odometry, preintegrator, node_ns, start_ns, bias, None), whole)


def _rest(before: PreintegratedMotion, whole: PreintegratedMotion) -> PreintegratedMotion:
    """What is left of a motion after another that begins where it begins."""
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
    """Over linear or held velocities, by rows stamped until an instant not before the end."""
    columns = odometry.columns()
    rows = rows_until(columns[0], known_ns), rows_until(columns[3], known_ns)
    return preintegrator.integrate(Steps(*merge_rows(columns, *rows, start_ns, end_ns)), bias)
