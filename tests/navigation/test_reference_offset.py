"""Reference against gyros, with poses of a simulated mission stamped early by known amounts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.measurements import Imu
from sonar_graph.navigation.alignment.reference_offset import ReferenceMatch, match_reference_to_imu
from sonar_graph.simulation.mission import MissionOptions, simulate_mission
from sonar_graph.states import Trajectory

RUN = simulate_mission(MissionOptions(seed=3, duration_s=200, landmarks=1))


def without_rows(is_lost: Callable[[np.ndarray], np.ndarray]) -> Imu:
    return RUN.imu.rows(~is_lost((RUN.imu.stamps_ns - RUN.imu.stamps_ns[0]) * 1e-9))


def matched(imu: Imu, reference: Trajectory) -> ReferenceMatch:
    return match_reference_to_imu(imu, reference, RUN.calibration)


def early(offset_s: float, seed: int = 0, wrong_rad: float = 0.0) -> Trajectory:
    truth = RUN.truth
    stamps = truth.stamps_ns[::50]
    noise = Rotation.from_rotvec(1e-3 * np.random.default_rng(seed).standard_normal((len(stamps), 3)))
    seconds = (stamps - stamps[0]) * 1e-9
    turned = Rotation.from_euler("z", np.where(seconds < 11, wrong_rad, 0.0)[:, None])
    rotations = turned * Rotation.from_quat(truth.quaternions_xyzw[::50]) * noise
    return Trajectory.without_covariances(stamps - round(offset_s * 1e9), truth.positions[::50], rotations.as_quat())


@pytest.mark.parametrize("offset_s", [-0.43, 0.25])
def test_offset_is_found(offset_s):
    found = matched(RUN.imu, early(offset_s)).offset
    assert abs(found.value - offset_s) < 4 * found.sigma < 0.1


@pytest.mark.slow
def test_interval_holds_the_offset_at_its_stated_rate():
    found = [matched(RUN.imu, early(0.2, seed)).offset for seed in range(40)]
    held = [abs(f.value - 0.2) < 1.96 * f.sigma for f in found]
    assert np.mean(held) >= 0.8
    assert np.std([f.value for f in found]) > 0.3 * np.mean([f.sigma for f in found])


def test_a_wrong_start_heading_is_named():
    found = matched(RUN.imu, early(0.1, wrong_rad=0.07)).start_heading
    assert found.value == pytest.approx(0.07, abs=4 * found.sigma)
    assert abs(matched(RUN.imu, early(0.1)).start_heading.value) < 0.005


def test_without_turning_the_offset_cannot_be_told():
    still = replace(RUN.imu, angular_velocity=1e-4 * np.ones((len(RUN.imu), 3)))
    level = replace(early(0.1), quaternions_xyzw=np.tile([0.0, 0, 0, 1], (len(early(0.1)), 1)))
    assert not matched(still, level).offset.is_known


def test_a_rotation_of_the_world_is_told_apart_from_the_reference():
    """The Earth's, exaggerated: felt by the gyros along the world's axes, so that it turns in those of the vehicle."""
    truth = RUN.truth.at(np.clip(RUN.imu.stamps_ns, *RUN.truth.stamps_ns[[0, -1]]))
    felt = RUN.imu.angular_velocity + truth.rotations().inv().apply([2e-3, -1e-3, 3e-3])
    turning = replace(RUN.imu, angular_velocity=felt)
    without, found = (matched(imu, early(0.2)).offset for imu in (RUN.imu, turning))
    assert found.value == pytest.approx(without.value, abs=0.3 * without.sigma)
    assert found.sigma < 1.6 * without.sigma


def test_nothing_is_compared_over_a_hole_of_the_gyros(monkeypatch):
    """5 s without a row in a turning vehicle."""
    holed = without_rows(lambda t: (t > 80.0) & (t < 85.0))
    right, wrong = early(0.2), early(0.2, wrong_rad=0.07)
    offset, heading = matched(holed, right).offset, matched(holed, wrong).start_heading
    assert abs(offset.value - 0.2) < 3 * offset.sigma < 0.01
    assert heading.value == pytest.approx(0.07, abs=4 * heading.sigma)
    assert heading.sigma < 0.005
    monkeypatch.setattr("sonar_graph.navigation.alignment.dvl_imu.holes_before", np.zeros_like)
    assert matched(holed, right).offset.sigma > 1.5 * offset.sigma
    assert matched(holed, wrong).start_heading.sigma > 0.005


def test_a_hole_soon_after_the_start_leaves_its_heading_untold_and_many_too_few_poses():
    found = matched(without_rows(lambda t: (t > 20.0) & (t < 22.0)), early(0.2))
    assert found.offset.is_known
    assert "too soon after the start" in found.start_heading.reason
    assert "without a hole" in matched(without_rows(lambda t: t % 8.0 <= 0.5), early(0.2)).offset.reason
