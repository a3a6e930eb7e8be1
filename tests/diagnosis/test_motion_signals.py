"""Motion of the body by its own sensors is the motion of the simulated vehicle, and breaks at holes and gaps."""

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.calibration import Mounting
from sonar_graph.diagnosis import aiding_check
from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.diagnosis.sightings import by_climb, sighting_changes
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission

from .runs import compass, recalibrated, spoilt, without_imu

RUN = simulate_mission(MissionOptions(seed=4, duration_s=100.0, landmarks=1))


@pytest.mark.parametrize(("missing", "parts"), [(1, 1), (2, 2)])
def test_two_missing_rows_of_a_slow_doppler_log_are_a_gap(missing, parts):
    """Its velocity is not taken as linear over three seconds."""
    t = (RUN.dvl.stamps_ns - RUN.dvl.stamps_ns[0]) * 1e-9
    _, each_second = np.unique(np.floor(t + 1e-6), return_index=True)
    kept = np.delete(each_second, slice(30, 30 + missing))
    motion = BodyMotion.of(replace(RUN, dvl=RUN.dvl.rows(kept)))
    assert len(np.unique(motion.parts)) == parts


@pytest.mark.parametrize("bias", [0.0, 0.01])
def test_yaw_height_path_and_up_are_those_of_the_vehicle(bias):
    """A bias that the calibration knows is taken off."""
    rate = np.add(RUN.imu.angular_velocity, [0.0, 0.0, bias])
    run = recalibrated(RUN, "imu", gyro_bias_rad_s=(0.0, 0.0, bias))
    motion = BodyMotion.of(spoilt(run, "imu", angular_velocity=rate))
    at_ns = motion.origin_ns + np.round(motion.seconds * 1e9).astype(np.int64)
    poses = RUN.truth.at(np.clip(at_ns, *RUN.truth.stamps_ns[[0, -1]]))
    attitude = poses.rotations()
    yaw = np.unwrap(attitude.as_euler("ZYX")[:, 0])
    off_m = poses.positions - poses.positions[0]
    assert motion.yaw_rad == pytest.approx(yaw - yaw[0], abs=0.03)
    assert motion.height_m == pytest.approx(off_m[:, 2], abs=0.3)
    ours = motion.path_m * np.exp(1j * yaw[0])
    assert np.abs(ours - off_m @ [1.0, 1j, 0.0]).max() < 0.8
    up = attitude.as_matrix()[:, 2]
    assert np.sum(motion.up * up, axis=1).min() > np.cos(0.03)
    assert np.all(motion.parts == 0)


def test_an_imu_hole_splits_motion_and_reference():
    motion = BodyMotion.of(without_imu(RUN, 40.0, 46.0))
    assert set(motion.parts) == {0, 1}
    yaw = motion.reference(motion.yaw_rad)
    outside = motion.seconds[[0, -1]] + [-1.0, 1.0]
    assert np.isnan(yaw(np.array([41.0, 43.0, 45.0, *outside]))).all()
    assert np.isfinite(yaw(np.array([39.0, 47.0]))).all()
    rows = motion.stretches(np.arange(100.0), np.arange(100.0), yaw)
    assert all(part.seconds[-1] <= 41 or part.seconds[0] >= 45 for part in rows)


@pytest.mark.parametrize("is_broken", [True, False])
def test_a_turn_in_a_hole_of_the_imu_is_no_bias_of_the_gyros(is_broken):
    """The heading has a turn that no gyro felt; drawn straight across the hole it is a bias."""
    at_s = (RUN.truth.stamps_ns - RUN.imu.stamps_ns[0]) * 1e-9
    run = compass(RUN, lambda yaw_rad: yaw_rad + (at_s[::10] > 43.0), sigma_rad=0.0)
    run = without_imu(run, 40.0, 46.0)
    motion = BodyMotion.of(run)
    if not is_broken:
        motion = replace(motion, parts=np.zeros_like(motion.parts))
    found = aiding_check.vertical_bias(run, motion)
    assert (abs(found.estimate.value) < 1e-3) == is_broken
    if is_broken:
        match = aiding_check.HEADING.compare(run, motion)
        rows = aiding_check.heading_findings(match, run, LogConfig(), motion)
        assert not any(row.acts for row in rows)


def climbing(climb_m_s: float) -> BodyMotion:
    """A level vehicle that goes ahead at 0.5 m/s and climbs."""
    seconds = np.arange(0.0, 40.0, 0.5)
    zero = np.zeros(len(seconds))
    return BodyMotion(
        origin_ns=0,
        seconds=seconds,
        parts=zero.astype(int),
        up=np.outer(zero + 1.0, [0.0, 0.0, 1.0]),
        yaw_rad=zero,
        height_m=climb_m_s * seconds,
        path_m=0.5 * seconds + 0j,
        ahead_m=0.5 * seconds,
        imu_s=seconds,
        imu_yaw_rad=zero,
    )


def seen_ahead(motion: BodyMotion, range_m: np.ndarray, ids: np.ndarray) -> Sequence:
    """The run with landmarks straight ahead of the sonar at the rows of a motion."""
    n = len(range_m)
    seen = LandmarkDetections(
        np.round(motion.seconds * 1e9).astype(np.int64),
        range_m,
        np.zeros(n),
        np.tile(1e-4 * np.eye(2), (n, 1, 1)),
        ids[:, None].astype(np.int64),
        np.ones((n, 1)),
    )
    return replace(RUN, detections=seen)


@pytest.mark.parametrize("climb_m_s", [0.2, -0.2])
def test_a_sonar_that_looks_down_sees_ranges_change_as_the_vehicle_climbs(climb_m_s):
    """Landmark in the plane of a sonar with a pitch of 45 degrees: p_j = p_i - d, all by hand."""
    motion = climbing(climb_m_s)
    zero = np.zeros(len(motion.seconds))
    down = Mounting(rpy_rad=(0.0, np.pi / 4, 0.0))
    run = recalibrated(seen_ahead(motion, zero + 10.0, zero), "sonar", mounting=down)
    changes = sighting_changes(run, motion).range
    place = 10.0 * np.array([1.0, 0.0, -1.0]) / np.sqrt(2)
    expected = np.linalg.norm(place - [0.5, 0.0, climb_m_s]) - 10.0
    np.testing.assert_allclose(changes.reference(changes.seconds), expected, atol=1e-9)


@pytest.mark.parametrize(("climb_m_s", "is_sure"), [(-0.15, False), (0.0, True)])
def test_a_dive_towards_landmarks_is_no_scale_of_their_ranges(climb_m_s, is_sure):
    """A landmark at the end of the dive is nearer by sin(e) dz; its right ranges leave the gain's interval at 1."""
    motion = climbing(climb_m_s)
    until_next = 10.0 - motion.seconds % 10.0
    lever = RUN.calibration.sonar.mounting.translation_m[0]
    range_m = np.hypot(9.0 - lever + 0.5 * until_next, climb_m_s * until_next)
    run = seen_ahead(motion, range_m, motion.seconds // 10)
    level = Mounting(translation_m=(lever, 0.0, 0.0))
    run = recalibrated(run, "sonar", mounting=level)
    gain = aiding_check.sighting_match(run, motion, of_range=True).gain
    assert abs(gain.value - 1.0) < 2.0 * gain.sigma + 1e-3
    assert (gain.sigma < 0.01) == is_sure


def test_heave_that_the_ranges_do_not_show_leaves_their_gain_sure():
    """A dz that is as often up as down while a landmark comes nearer adds nothing: sum dz dr of a passage is small."""
    longer = np.full(40, -0.5)
    passage = np.zeros(40, dtype=np.int64)
    # the sides on which two passages pass do not cancel each other
    halves = np.repeat([0, 1], 20)
    for heave, passages, share in (
        (np.tile([0.05, -0.05], 20), passage, 0.0),
        (longer / 2, passage, 0.5),
        (np.repeat([0.25, -0.25], 20), halves, 0.5),
    ):
        assert by_climb(longer, heave, passages) == pytest.approx(share, abs=1e-12)
