"""Truth from the simulator, whose exact kinematics share no code with navigation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.doppler_beams import UNMEASURED_M_S
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.dvl_against_imu import DvlMatch, match_dvl_to_imu
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission

OFFSET_S, YAW_RAD, SCALE = 0.13, np.radians(3), 1.01


def spoilt(seed: int, offset_s: float = OFFSET_S, yaw_rad: float = YAW_RAD, scale: float = SCALE) -> Sequence:
    """A mission whose Doppler log is stamped early, turned and short by known amounts."""
    run = simulate_mission(MissionOptions(seed=seed, duration_s=240, landmarks=1))
    early = run.dvl.stamps_ns - round(offset_s * 1e9)
    velocity = Rotation.from_euler("z", -yaw_rad).apply(run.dvl.velocity) / scale
    return replace(run, dvl=Dvl(early, velocity, run.dvl.velocity_cov))


def matched(run: Sequence) -> DvlMatch:
    return match_dvl_to_imu(run.imu, run.dvl, run.calibration)


def test_offset_yaw_and_scale_are_found():
    found = matched(spoilt(1))
    assert abs(found.offset.value - OFFSET_S) < 4 * found.offset.sigma < 0.4
    assert abs(found.yaw.value - YAW_RAD) < 4 * found.yaw.sigma < 0.03
    assert abs(found.scale.value - SCALE) < 4 * found.scale.sigma < 0.02


def test_shifting_the_stamps_shifts_the_offset():
    here, there = matched(spoilt(2, offset_s=-0.4)), matched(spoilt(2, offset_s=0.3))
    assert there.offset.value - here.offset.value == pytest.approx(0.7, abs=0.02)


def test_straight_and_steady_driving_tells_nothing():
    rng = np.random.default_rng(0)
    n = 12_000
    imu = Imu(
        np.arange(n, dtype=np.int64) * 10_000_000,
        1e-4 * rng.standard_normal((n, 3)),
        [0, 0, 9.81] + 1e-2 * rng.standard_normal((n, 3)),
    )
    velocity = [1.0, 0, 0] + 0.01 * rng.standard_normal((600, 3))
    dvl = Dvl(np.arange(600, dtype=np.int64) * 200_000_000, velocity, np.full((600, 3, 3), np.nan))
    found = match_dvl_to_imu(imu, dvl, simulate_mission(MissionOptions(duration_s=10)).calibration)
    assert not found.offset.is_known
    assert not found.scale.is_known
    assert not found.yaw.is_known


def test_without_accelerometers_nothing_can_be_told():
    run = spoilt(1)
    blind = replace(run, imu=Imu(run.imu.stamps_ns, run.imu.angular_velocity, np.full((len(run.imu), 3), np.nan)))
    assert "no accelerometers" in matched(blind).offset.reason


def test_rows_of_few_beams_say_what_they_would_say_were_they_not_there():
    run = spoilt(1)
    some = np.random.default_rng(0).random(len(run.dvl)) < 0.2
    velocity, cov = run.dvl.velocity.copy(), run.dvl.velocity_cov.copy()
    velocity[some, 1:], cov[some] = 0.0, np.diag([1e-4, UNMEASURED_M_S**2, UNMEASURED_M_S**2])
    found = matched(replace(run, dvl=Dvl(run.dvl.stamps_ns, velocity, cov)))
    without = matched(replace(run, dvl=run.dvl.rows(np.flatnonzero(~some))))
    for one, other in ((found.offset, without.offset), (found.yaw, without.yaw), (found.scale, without.scale)):
        assert one == other
    assert abs(found.offset.value - OFFSET_S) < 4 * found.offset.sigma < 0.4


def test_a_gyro_bias_changes_no_estimate():
    """Ten times a good MEMS gyro's: turning while it tilts gravity must not look like a turn of the mounting."""
    run = spoilt(1)
    bias = np.array([2e-3, -2e-3, 1e-3])
    biased = replace(run, imu=Imu(run.imu.stamps_ns, run.imu.angular_velocity + bias, run.imu.specific_force))
    here, there = matched(run), matched(biased)
    for one, other in ((here.offset, there.offset), (here.yaw, there.yaw), (here.scale, there.scale)):
        assert abs(one.value - other.value) < 0.2 * one.sigma
        assert other.sigma < 1.1 * one.sigma
