"""Motion between any two instants, gaps of the Doppler log or not."""

from __future__ import annotations

from itertools import pairwise

import gtsam
import numpy as np
import pytest

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.odometry import Odometry, motion_between, motion_between_nodes, motion_since_node
from sonar_graph.navigation.preintegration.motion import Preintegrator

from . import test_gap_motion as tumbling
from .test_gaps import DVL, FOUND_S, LOST_S, NOISY, QUIET, Vehicle, at, rows

ZERO = np.zeros(3)


def ready(until_s=20.0, imu=QUIET):
    """What was measured until an instant, and what it means."""
    calibration = Calibration(imu=imu, dvl=DVL)
    odometry = Odometry(calibration)
    imu_rows, dvl_rows = rows()
    odometry.add(imu_rows.between(0, at(until_s)), dvl_rows.between(0, at(until_s)))
    return odometry, Preintegrator.from_calibration(calibration)


def moved(start_s, end_s, until_s=20.0, imu=QUIET):
    return motion_between(*ready(until_s, imu), at(start_s), at(end_s), ZERO)


@pytest.mark.parametrize(
    ("start_s", "end_s"),
    [
        *((1.03, 1.17), (5.9, 6.0), (5.93, 8.31), (6.0, 12.0), (6.0, 16.0), (6.0, 17.3), (8.07, 8.36), (13.0, 15.9)),
        *((5.03, 16.53), (16.0, 16.1)),
    ],
)
def test_motion_is_that_of_the_vehicle_before_in_over_and_after_a_gap(start_s, end_s):
    truth, found = Vehicle().displacement(start_s, end_s), moved(start_s, end_s)
    assert found.i_T_j.translation() == pytest.approx(truth, abs=0.02)
    turn = Vehicle().attitude([end_s - start_s]).as_matrix()[0]
    assert found.i_T_j.rotation().equals(gtsam.Rot3(turn), 1e-6)
    assert found.duration_s == pytest.approx(end_s - start_s)


def in_between(start_s, end_s, bias=(0.0, 0.0, 0.0), gap_s=1.5):
    """Of a vehicle that rolls, pitches and turns, whose Doppler stamps fall between those of the IMU."""
    known = tumbling.calibration({"gyro_noise_density": 1e-3}, velocity_sigma_m_s=(0.01,) * 3, gap_s=gap_s)
    imu_rows, dvl_rows = tumbling.rows()
    biased = Imu(imu_rows.stamps_ns, imu_rows.angular_velocity + bias, imu_rows.specific_force)
    odometry = Odometry(known)
    odometry.add(biased, Dvl(dvl_rows.stamps_ns + 30_000_000, dvl_rows.velocity, dvl_rows.velocity_cov))
    return motion_between(odometry, Preintegrator.from_calibration(known), at(start_s), at(end_s), np.array(bias))


INTERVALS = pytest.mark.parametrize(
    ("start_s", "end_s"), [(1.11, 1.72), (8.0, 9.0), (6.03, 9.0), (5.58, 8.31), (5.58, 11.7), (4.6, 15.78)]
)


@INTERVALS
def test_the_turn_is_that_of_the_gyros_whatever_the_doppler_log_does(start_s, end_s):
    """As if a straight line led over its gaps, to the last digits; the displacement is another one there."""
    found, straight = in_between(start_s, end_s), in_between(start_s, end_s, gap_s=100.0)
    assert found.i_T_j.rotation().equals(straight.i_T_j.rotation(), 1e-12)
    assert found.i_T_j.equals(straight.i_T_j, 1e-3) == (start_s < 2.0)


@INTERVALS
def test_a_bias_that_is_removed_is_as_if_it_had_not_been(start_s, end_s):
    found, clean = in_between(start_s, end_s, bias=(0.03, -0.02, 0.04)), in_between(start_s, end_s)
    assert found.i_T_j.equals(clean.i_T_j, 1e-9)
    assert found.covariance == pytest.approx(clean.covariance, abs=1e-12)
    assert found.D_bias == pytest.approx(clean.D_bias, abs=1e-9)


def test_without_a_gap_motion_is_that_over_the_steps_to_the_bit():
    odometry, preintegrator = ready()
    found = motion_between(odometry, preintegrator, at(1.0), at(3.2), ZERO)
    steps = odometry.steps_between_nodes(at(1.0), at(3.2))
    expected = preintegrator.integrate(steps, ZERO)
    assert np.array_equal(found.i_T_j.matrix(), expected.i_T_j.matrix())
    assert np.array_equal(found.covariance, expected.covariance)


def test_motions_that_follow_each_other_in_a_gap_add_up_to_that_since_the_node():
    odometry, preintegrator = ready(15.0, NOISY)
    total = motion_between(odometry, preintegrator, at(LOST_S), at(7.3), ZERO)
    for start_s, end_s in pairwise([7.3, 7.6, 9.0, 9.2, 12.0, 14.7]):
        total = total.then(motion_between(odometry, preintegrator, at(start_s), at(end_s), ZERO))
    whole = motion_since_node(odometry, preintegrator, at(LOST_S), at(14.7), ZERO, None)
    assert total.i_T_j.equals(whole.i_T_j, 1e-9)
    assert total.covariance == pytest.approx(whole.covariance, rel=1e-3, abs=1e-9)
    assert total.D_bias == pytest.approx(whole.D_bias, rel=1e-6, abs=1e-9)
    assert total.mean_specific_force == pytest.approx(whole.mean_specific_force, abs=1e-9)
    assert total.duration_s == pytest.approx(whole.duration_s)


def test_a_motion_late_in_a_gap_is_less_sure_than_one_early_in_it():
    sigmas = [np.sqrt(np.trace(moved(t, t + 0.3, 15.9, NOISY).covariance[3:, 3:])) for t in (6.5, 9.0, 12.0, 14.0)]
    assert sorted(sigmas) == sigmas
    assert sigmas[-1] > 3 * sigmas[0]


def test_a_gap_that_has_ended_is_bridged_with_both_its_ends():
    odometry, preintegrator = ready(imu=NOISY)
    found = motion_between(odometry, preintegrator, at(5.0), at(17.0), ZERO)
    nodes = motion_between_nodes(odometry, preintegrator, at(5.0), at(17.0), ZERO, None)
    assert found.i_T_j.equals(nodes.i_T_j, 1e-12)
    assert found.covariance == pytest.approx(nodes.covariance)
    longer = motion_between(odometry, preintegrator, at(4.91), at(17.09), ZERO)
    assert np.trace(longer.covariance) > np.trace(nodes.covariance)


@pytest.mark.parametrize(
    ("start_s", "end_s"), [(1.03, 1.17), (5.0, 9.0), (8.0, 9.0), (15.0, FOUND_S + 0.2), (15.0, 16.3)]
)
def test_nothing_stamped_after_the_second_instant_is_used(start_s, end_s):
    here, there = (moved(start_s, end_s, until_s, NOISY) for until_s in (20.0, end_s))
    assert np.array_equal(here.i_T_j.matrix(), there.i_T_j.matrix())
    assert np.array_equal(here.covariance, there.covariance)


@pytest.mark.parametrize("instant_s", [1.1, 3.0, 9.0])
def test_from_an_instant_to_itself_nothing_moves(instant_s):
    found = moved(instant_s, instant_s)
    assert found.i_T_j.equals(gtsam.Pose3(), 0.0)
    assert not found.covariance.any()


def test_covariances_have_no_negative_variance():
    for start_s in np.arange(6.0, 15.0, 0.37):
        cov = moved(start_s, start_s + 0.05, 15.9, NOISY).covariance
        assert np.linalg.eigvalsh(cov)[0] >= -1e-18
