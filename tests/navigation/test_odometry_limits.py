"""Which rows odometry keeps and uses, on either side of each limit."""

from __future__ import annotations

import numpy as np
import pytest

from sonar_graph.calibration import ROWS_BEFORE, Calibration, DvlCalibration
from sonar_graph.errors import MeasurementError
from sonar_graph.navigation.odometry import Odometry
from sonar_graph.navigation.samples import longest_interval_ns
from sonar_graph.states import Refusal

from .rows import NS, T0_NS, dvl, imu, stamps

HELD = Calibration(odometry_interpolation="hold-past")


def at(seconds: float) -> int:
    return T0_NS + round(seconds * NS)


def steady(seconds: float = 4.0, calibration: Calibration | None = None) -> Odometry:
    """Ten IMU rows a second and two of the Doppler log: tenths of a second in rad/s, and their hundredth in m/s."""
    quick, slow = stamps(10, seconds), stamps(2, seconds)
    odometry = Odometry(calibration or Calibration())
    rate, velocity = (np.outer((t - T0_NS) / (NS / 10), [0, 0, 1.0]) for t in (quick, slow))
    odometry.add(imu(quick, rate), dvl(slow, 0.01 * velocity))
    return odometry


def test_it_is_said_whether_rows_came_before_others_of_either_sensor():
    odometry = steady()
    assert not odometry.add(imu(stamps(10, 0.2, 4.1), 0.0), dvl(stamps(2, 0.0, 4.5), [0, 0, 0.45]))
    assert odometry.add(imu(stamps(10, 0.0, 1.03), 0.0), dvl(stamps(2, 0.0, 5.0), [0, 0, 0.5]))
    assert odometry.add(imu(stamps(10, 0.0, 5.0), 0.0), dvl(stamps(2, 0.0, 1.03), [0, 0, 0.103]))
    assert odometry.add(imu(stamps(10, 0.0, 2.03), 0.0), None)
    assert odometry.add(None, dvl(stamps(2, 0.0, 2.03), [0, 0, 0.203]))
    assert not odometry.add(None, None)


@pytest.mark.parametrize("block", [imu(stamps(2, 1.0), 0.0), "rows"])
def test_a_block_of_another_kind_is_refused_in_either_place(block):
    with pytest.raises(MeasurementError, match="expected Imu and Dvl, not NoneType and"):
        Odometry(Calibration()).add(None, block)


def test_what_is_settled_or_forgotten_stays_so():
    for close in (Odometry.settle, Odometry.forget_before):
        odometry = steady()
        close(odometry, at(3.0))
        odometry.settle(at(1.0))
        odometry.add(imu(stamps(10, 0.0, 2.94), 0.0), dvl(stamps(2, 0.0, 2.93), [0, 0, 0.293]))
        assert [row.reason for row in odometry.refused] == [Refusal.LATE] * 2


@pytest.mark.parametrize(("calibration", "kept_s"), [(HELD, 0.0), (Calibration(), 5.0)], ids=["held", "linear"])
def test_forgetting_drops_rows_of_both_sensors_that_no_motion_needs(calibration, kept_s):
    """A gap that opens later is bridged by a line through the five seconds before it; held velocities need one row.

    What counts as a hole of the IMU is told from some rows more.
    """
    odometry = steady(20.0, calibration)
    odometry.forget_before(at(15.0))
    columns = odometry.columns()
    assert columns[6] == (calibration is HELD)
    more_s = ROWS_BEFORE / 10
    for stamps_ns, earliest_s in ((columns[0], 15.0 - more_s), (columns[3], 14.5)):
        assert at(earliest_s - kept_s - 0.1) <= stamps_ns[0] <= at(15.0 - kept_s)
        assert stamps_ns[-1] == at(20.0)


def test_motion_to_a_node_may_begin_at_the_first_row_and_end_where_it_begins():
    odometry = steady()
    assert odometry.steps_to_node(at(0.0), at(1.0)).duration_s.sum() == pytest.approx(1.0)
    for found in (odometry.steps_to_node(at(1.0), at(1.0)), odometry.steps_since_node(at(1.0), at(1.0))):
        assert not found.duration_s.sum()


def test_a_row_at_the_very_instant_is_used_and_none_after_it():
    """Rates are linear from 10 on and held after the newest row; so are velocities from 0.1 on."""
    odometry = steady()
    for until_s, turn, way in ((1.2, 2.2, 0.02), (1.25, 2.2 + 0.6, 0.025), (1.5, 6.25, 0.0625)):
        steps = odometry.steps_since_node(at(1.0), at(until_s))
        assert steps.duration_s @ steps.rate[:, 2] == pytest.approx(turn)
        assert steps.duration_s @ steps.velocity[:, 2] == pytest.approx(way)


def test_final_motion_uses_the_row_that_covers_its_end():
    """With the node between two IMU rows."""
    odometry = Odometry(Calibration())
    quick = stamps(10, 2.0)
    odometry.add(imu(quick, np.outer((quick - T0_NS) / (NS / 10), [0, 0, 1.0])), dvl(stamps(2, 1.5, 0.05), 0.0))
    steps = odometry.steps_between_nodes(at(0.55), at(1.05))
    assert steps.duration_s @ steps.rate[:, 2] == pytest.approx(0.5 * 8.0)


def test_the_newest_node_is_the_last_that_is_reached():
    odometry = steady()
    assert odometry.newest_node(at(0.5), at(2.2)) == at(2.0)
    assert odometry.newest_node(at(2.0), at(2.2)) is None
    assert odometry.nodes(at(0.5), at(2.2)).tolist() == [at(1.0), at(1.5), at(2.0)]


def test_a_gap_is_longer_than_the_calibration_says():
    """Between nodes that follow each other; held samples leave none."""
    calibration = Calibration(dvl=DvlCalibration(gap_s=0.5))
    assert longest_interval_ns(calibration) == NS // 2
    odometry, held = (
        Odometry(known) for known in (calibration, HELD.model_copy(update={"dvl": DvlCalibration(gap_s=0.5)}))
    )
    slow = T0_NS + np.array([0, 500, 1001, 1501, 4000]) * 1_000_000
    for one in (odometry, held):
        one.add(imu(stamps(10, 5.0), 0.0), dvl(slow, 0.0))
    assert not odometry.is_gap(at(0.0), at(0.5))
    assert odometry.is_gap(at(0.0), at(0.5) + 1)
    assert odometry.gaps(at(0.0), at(4.0)) == [(at(0.5), at(1.001)), (at(1.501), at(4.0))]
    assert odometry.gaps(at(0.5), at(1.501)) == [(at(0.5), at(1.001))]
    assert not held.gaps(at(0.0), at(4.0))
    assert not held.is_gap(at(0.0), at(1e6))


@pytest.mark.parametrize("instant_s", [0.25, 4.2, -0.5])
def test_velocity_is_told_at_nodes_only(instant_s):
    with pytest.raises(MeasurementError, match=rf"node_ns: {at(instant_s)} is none of the 9 Doppler stamps"):
        steady().velocity_at_node(at(instant_s))


def test_an_interval_of_no_length_is_not_in_the_wrong_order():
    with pytest.raises(MeasurementError, match=r"start_ns: .* is none of the 9 Doppler stamps"):
        steady().steps_between_nodes(at(0.25), at(0.25))


@pytest.mark.parametrize("speed_m_s", [0.0, 3.0])
def test_the_start_is_reached_at_the_same_time_however_the_log_is_cut(speed_m_s):
    """When its velocity is confirmed: at 3 m/s by two rows more than at rest."""
    imu_rows = imu(stamps(100, 3), 0.0)
    dvl_rows = dvl(stamps(5, 3), (speed_m_s, 0, 0), 1e-4 * np.eye(3))
    at_once, by_and_by = Odometry(Calibration()), Odometry(Calibration())
    at_once.add(imu_rows, dvl_rows)
    reached = []
    for until_ns in imu_rows.stamps_ns.tolist():
        by_and_by.add(
            imu_rows.between(until_ns - NS // 100, until_ns), dvl_rows.between(until_ns - NS // 100, until_ns)
        )
        assert by_and_by.start_by(until_ns) == at_once.start_by(until_ns)
        reached.append(at_once.start_by(until_ns) is not None)
    assert at_once.start_ns() == T0_NS
    assert reached.index(True) == (20 if speed_m_s == 0 else 60)
