"""Motion by gyros and Doppler log, asked for by stamps.

Nodes. The stamps of the DVL rows are *nodes*: between two nodes the velocity is known on both sides and the motion is
final. A node counts as reached at time t when its own row and an IMU row at or after it are stamped at or before t.
Whatever happens between nodes (a detection, a depth sample, an estimate being asked for) is related to the newest
reached node by a provisional motion that uses nothing stamped later. Results therefore depend on stamps alone, not on
how a log is cut into blocks, and nothing peeks ahead. One thing does where rows are added long before they are asked
for: the first velocities, and those after a long gap, are nodes once later ones have confirmed them
(`sonar_graph.navigation.velocity_doubt`).

Rows: `sonar_graph.navigation.row_intake`. Motion between them: `sonar_graph.navigation.steps`.
"""

from __future__ import annotations

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.navigation import argument_checks as check
from sonar_graph.navigation.interpolation import value_at
from sonar_graph.navigation.row_intake import RowIntake
from sonar_graph.navigation.stamped_rows import LATEST_NS, WINDOW_NS, node_range, rows_before_gaps
from sonar_graph.navigation.steps import Columns, Steps, are_nodes, merge_rows
from sonar_graph.navigation.unmeasured_turns import NO_TURNS, ROWS_BEFORE, turn_values
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
        and a velocity may be an outlier (`sonar_graph.navigation.velocity_gate`): these become rows of `refused`.

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
                return check.no_stamp(name, instant_ns, self._dvl.stamps_ns)
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
            raise check.no_stamp("node_ns", node_ns, self._dvl.stamps_ns)
        i = int(np.searchsorted(self._imu.stamps_ns, node_ns))
        rate = value_at(self._imu.stamps_ns, self._imu.values[0], i, node_ns, self._hold_past)
        return self._dvl.values[0][k], self._dvl.values[1][k], np.array(rate)


def longest_interval_ns(calibration: Calibration) -> int:
    """Between velocity samples that is no gap; held samples leave none."""
    return LATEST_NS if calibration.odometry_interpolation == "hold-past" else round(calibration.dvl.gap_s * 1e9)
