"""Reference against gyros, with poses of a simulated mission stamped early by known amounts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.measurements import Imu
from sonar_graph.navigation.alignment.reference_offset import match_reference_to_imu
from sonar_graph.simulation.mission import MissionOptions, simulate_mission
from sonar_graph.states import Trajectory

RUN = simulate_mission(MissionOptions(seed=3, duration_s=200, landmarks=1))


@pytest.fixture(params=[-0.43, 0.25])
def offset_s(request):
    return request.param


def early(offset_s: float, seed: int = 0, wrong_rad: float = 0.0) -> Trajectory:
    truth = RUN.truth
    stamps = truth.stamps_ns[::50]
    noise = Rotation.from_rotvec(1e-3 * np.random.default_rng(seed).standard_normal((len(stamps), 3)))
    seconds = (stamps - stamps[0]) * 1e-9
    turned = Rotation.from_euler("z", np.where(seconds < 11, wrong_rad, 0.0)[:, None])
    rotations = turned * Rotation.from_quat(truth.quaternions_xyzw[::50]) * noise
    return Trajectory.without_covariances(stamps - round(offset_s * 1e9), truth.positions[::50], rotations.as_quat())


def test_offset_is_found(offset_s):
    found = match_reference_to_imu(RUN.imu, early(offset_s), RUN.calibration).offset
    assert abs(found.value - offset_s) < 4 * found.sigma < 0.1


@pytest.mark.slow
def test_interval_holds_the_offset_at_its_stated_rate():
    found = [match_reference_to_imu(RUN.imu, early(0.2, seed), RUN.calibration).offset for seed in range(40)]
    held = [abs(f.value - 0.2) < 1.96 * f.sigma for f in found]
    assert np.mean(held) >= 0.8
    assert np.std([f.value for f in found]) > 0.3 * np.mean([f.sigma for f in found])


def test_a_wrong_start_heading_is_named():
    found = match_reference_to_imu(RUN.imu, early(0.1, wrong_rad=0.07), RUN.calibration).start_heading
    assert found.value == pytest.approx(0.07, abs=4 * found.sigma)
    right = match_reference_to_imu(RUN.imu, early(0.1), RUN.calibration).start_heading
    assert abs(right.value) < 0.005


def test_without_turning_the_offset_cannot_be_told():
    still = Imu(RUN.imu.stamps_ns, 1e-4 * np.ones((len(RUN.imu), 3)), RUN.imu.specific_force)
    level = replace(early(0.1), quaternions_xyzw=np.tile([0.0, 0, 0, 1], (len(early(0.1)), 1)))
    assert not match_reference_to_imu(still, level, RUN.calibration).offset.is_known


def test_a_rotation_of_the_world_is_told_apart_from_the_reference():
    """The Earth's, exaggerated: felt by the gyros along the world's axes, so that it turns in those of the vehicle."""
    stamps = RUN.imu.stamps_ns
    world_earth, truth = np.array([2e-3, -1e-3, 3e-3]), RUN.truth.at(np.clip(stamps, *RUN.truth.stamps_ns[[0, -1]]))
    felt = RUN.imu.angular_velocity + truth.rotations().inv().apply(world_earth)
    turning = Imu(stamps, felt, RUN.imu.specific_force)
    without, found = (match_reference_to_imu(imu, early(0.2), RUN.calibration).offset for imu in (RUN.imu, turning))
    assert found.value == pytest.approx(without.value, abs=0.3 * without.sigma)
    assert found.sigma < 1.6 * without.sigma


def test_nothing_is_compared_over_a_hole_of_the_gyros(monkeypatch):
    """5 s without a row in a turning vehicle."""
    t = (RUN.imu.stamps_ns - RUN.imu.stamps_ns[0]) * 1e-9
    holed = RUN.imu.rows((t <= 80.0) | (t >= 85.0))
    right, wrong = early(0.2), early(0.2, wrong_rad=0.07)
    offset = match_reference_to_imu(holed, right, RUN.calibration).offset
    heading = match_reference_to_imu(holed, wrong, RUN.calibration).start_heading
    assert abs(offset.value - 0.2) < 3 * offset.sigma < 0.01
    assert heading.value == pytest.approx(0.07, abs=4 * heading.sigma)
    assert heading.sigma < 0.005
    monkeypatch.setattr("sonar_graph.navigation.alignment.dvl_imu.holes_before", np.zeros_like)
    assert match_reference_to_imu(holed, right, RUN.calibration).offset.sigma > 1.5 * offset.sigma
    assert match_reference_to_imu(holed, wrong, RUN.calibration).start_heading.sigma > 0.005


def test_a_hole_soon_after_the_start_leaves_its_heading_untold():
    t = (RUN.imu.stamps_ns - RUN.imu.stamps_ns[0]) * 1e-9
    found = match_reference_to_imu(RUN.imu.rows((t <= 20.0) | (t >= 22.0)), early(0.2), RUN.calibration)
    assert found.offset.is_known
    assert "too soon after the start" in found.start_heading.reason


def test_between_many_holes_too_few_poses_are_left():
    t = (RUN.imu.stamps_ns - RUN.imu.stamps_ns[0]) * 1e-9
    found = match_reference_to_imu(RUN.imu.rows(t % 8.0 > 0.5), early(0.2), RUN.calibration)
    assert "without a hole" in found.offset.reason
