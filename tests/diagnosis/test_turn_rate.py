"""Gyros that are wrong about the vertical, of a vehicle made by hand: named without a compass, fixes or landmarks."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from sonar_graph.diagnosis import check_sensors, compared
from sonar_graph.diagnosis.turn_rate import TURN_RATE, turn_rate_finding
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.sequence import Sequence

from .runs import acting, level_vehicle, spoilt

HZ = 50.0
T = np.arange(0.0, 60.0, 1 / HZ)


def level_drive(seed: int, spoil=np.asarray, phase: float = 0.0) -> Sequence:
    """A level vehicle that turns to and fro, and speeds up and down."""
    speed = 0.9 + 0.25 * np.sin(0.7 * T + phase)
    yaw_rate = 0.3 * np.sin(0.4 * T + phase) + 0.1
    run = level_vehicle(np.outer(speed, [1.0, 0.0, 0.0]), yaw_rate, seed)
    return spoilt(run, "imu", angular_velocity=spoil(run.imu.angular_velocity))


def high_passed(rate):
    width = round(10 * HZ)
    return rate - uniform_filter1d(rate, width, axis=0, mode="constant")


@pytest.mark.parametrize(
    "spoil",
    [lambda rate: rate * [1.0, 1.0, 0.5], high_passed],
    ids=["half", "high-passed"],
)
def test_a_turn_that_forces_and_velocities_show_and_gyros_do_not_is_grave(spoil):
    """No line: no single factor mends such a rate. Nothing else is advised beside it."""
    (finding,) = acting(level_drive(0, spoil))
    assert finding.quantity == TURN_RATE
    assert finding.grave
    assert not finding.line


@pytest.mark.parametrize(
    "spoil",
    [lambda rate: rate * [1.0, 1.0, 0.0], lambda rate: np.clip(rate, -0.1, 0.1)],
    ids=["dead", "clipped"],
)
def test_gyros_with_dead_or_clipped_rows_are_not_compared(spoil):
    run = level_drive(0, spoil)
    (finding,) = check_sensors(run)
    assert "angular rate along z" in finding.estimate.reason
    assert "angular rate along z" in compared(run).notes["log.doubtful"]


def test_angle_increments_are_found_with_the_factor_to_rates():
    finding, *_ = check_sensors(level_drive(0, lambda rate: rate / HZ))
    assert finding.quantity == TURN_RATE
    assert "`angular_velocity_scale = 50`" in finding.line


@pytest.mark.parametrize("seed", range(2))
def test_gyros_are_not_contradicted_by_waves_beside_gaps(seed):
    """Beside a gap the velocity is known on one side only."""
    wave = 0.8 * np.sin(1.5 * T + seed)
    velocity = np.column_stack([0.6 + 0.0 * T, wave, 0.0 * T])
    run = level_vehicle(velocity, 0.02 * np.sin(0.2 * T), seed)
    t = T[::10]
    is_lost = ((t > 20.0) & (t < 24.0)) | ((t > 40.0) & (t < 43.5))
    with_gaps = replace(run, dvl=run.dvl.rows(~is_lost))
    assert turn_rate_finding(with_gaps, LogConfig()) is None


@pytest.mark.parametrize(("seed", "waves_m_s2"), [(0, 0.0), (0, 3.0), (1, 3.0)])
def test_right_gyros_are_not_contradicted(seed, waves_m_s2):
    """Also by accelerations of either level axis that the velocities, 5 a second and noisy, do not show."""
    run = level_drive(seed, phase=0.8 * seed)
    if waves_m_s2:
        rng = np.random.default_rng(100 + seed)
        white = np.zeros_like(run.imu.specific_force)
        white[:, :2] = rng.standard_normal((len(T), 2))
        waves = waves_m_s2 * uniform_filter1d(white, 20, axis=0, mode="constant")
        force = run.imu.specific_force + waves
        noise = 0.1 * rng.standard_normal(run.dvl.velocity.shape)
        run = spoilt(run, "imu", specific_force=force)
        run = spoilt(run, "dvl", velocity=run.dvl.velocity + noise)
    assert turn_rate_finding(run, LogConfig()) is None
