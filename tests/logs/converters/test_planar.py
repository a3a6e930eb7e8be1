"""Planar robots by the files of their steps: DLR and Victoria Park."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from sonar_graph.logs.convert.dlr import read_dlr
from sonar_graph.logs.convert.planar import (
    planar_trajectory,
    range_azimuth,
    stepped_calibration,
    stepped_odometry,
    twists_of_steps,
    velocity_cov_of_steps,
)
from sonar_graph.logs.convert.victoria_park import read_victoria_park

metres = st.floats(-10, 10)
turns = st.one_of(st.floats(-3.1, 3.1), st.floats(-2e-4, 2e-4), st.just(0.0))


def motion_of(velocity, rate, duration):
    twist = np.array([[0, -rate, velocity[0]], [rate, 0, velocity[1]], [0, 0, 0]])
    return expm(twist * duration)


@given(metres, metres, turns, st.sampled_from([0.1, 1.0, 7.0]))
def test_twist_held_over_the_step_makes_the_step(dx, dy, turn, duration):
    velocity, rate = twists_of_steps(np.array([[dx, dy, turn]]), duration)
    made = motion_of(velocity[0], rate[0], duration)
    assert np.allclose(made, gtsam.Pose2(dx, dy, turn).matrix(), rtol=0, atol=1e-11)


def test_twist_is_the_logarithm_of_another_library():
    for step in [(1.0, 0.2, 0.3), (-0.4, 2.0, -1.7), (0.5, 0.1, 1e-3)]:
        velocity, rate = twists_of_steps(np.array([step]), 1.0)
        assert np.allclose([*velocity[0], rate[0]], gtsam.Pose2.Logmap(gtsam.Pose2(*step)), rtol=0, atol=1e-10)


def test_the_chord_alone_would_not_make_the_step():
    velocity = np.array([1.0, 0.0])
    assert not np.allclose(motion_of(velocity, 0.3, 1.0), gtsam.Pose2(1.0, 0.0, 0.3).matrix(), atol=1e-2)


def test_velocity_noise_makes_the_noise_of_the_step():
    rng = np.random.default_rng(3)
    step = np.array([[0.8, -0.1, 0.6]])
    S = np.array([[4e-4, 1e-4], [1e-4, 2e-4]])
    cov = np.zeros((1, 3, 3))
    cov[0, :2, :2] = S
    velocity_cov = velocity_cov_of_steps(step, cov, 2.0)[0]
    velocity, rate = twists_of_steps(step, 2.0)
    draws = rng.multivariate_normal(velocity[0], velocity_cov, 4000)
    V = np.column_stack([motion_of(axis, rate[0], 2.0)[:2, 2] for axis in np.eye(2)])
    reached = draws @ V.T
    assert np.allclose(np.cov(reached.T), S, rtol=0.1, atol=1e-5)


def test_calibrated_turn_noise_is_the_mean_variance_over_a_step():
    covs = np.tile(1e-4 * np.eye(3), (2, 1, 1))
    covs[:, 2, 2] = [1e-4, 3e-4]
    _, dvl = stepped_odometry(np.zeros((2, 3)), covs, 2)
    density = stepped_calibration(dvl, covs, 2).imu.gyro_noise_density
    assert density**2 * 2 == pytest.approx(2e-4)


def test_run_begins_with_a_row_without_motion():
    imu, dvl = stepped_odometry(np.array([[1.0, 0.0, 0.1]]), np.zeros((1, 3, 3)), 1)
    assert imu.stamps_ns.tolist() == dvl.stamps_ns.tolist() == [0, 1_000_000_000]
    assert not dvl.velocity[0].any()
    assert dvl.velocity_cov[:, 2, 2] == pytest.approx([1e-6, 1e-6])  # a millimetre a second
    assert not imu.angular_velocity[0].any()
    assert np.isnan(imu.specific_force).all()


@given(st.floats(0.5, 20), st.floats(-3.1, 3.1), st.floats(0.01, 0.2), st.floats(0.01, 0.2), st.floats(-0.9, 0.9))
def test_polar_covariance_is_the_numerical_jacobians(distance, azimuth, sx, sy, rho):
    point = distance * np.array([[np.cos(azimuth), np.sin(azimuth)]])
    S = np.array([[[sx**2, rho * sx * sy], [rho * sx * sy, sy**2]]])
    r, a, cov = range_azimuth(point, S)
    assert np.allclose([r[0], a[0]], [distance, azimuth])
    J = np.empty((2, 2))
    for axis in range(2):
        offset = 1e-6 * np.eye(2)[axis]
        ahead, behind = range_azimuth(point + offset, S), range_azimuth(point - offset, S)
        turn = np.angle(np.exp(1j * (ahead[1] - behind[1])))
        J[:, axis] = [(ahead[0] - behind[0])[0] / 2e-6, turn[0] / 2e-6]
    assert np.allclose(cov[0], J @ S[0] @ J.T, rtol=1e-6, atol=1e-9)


def test_planar_poses_turn_about_the_vertical():
    trajectory = planar_trajectory(np.array([0, 1]), np.array([[1.0, 2.0, 0.0], [3.0, 4.0, np.pi / 2]]))
    assert np.allclose(trajectory.positions, [[1, 2, 0], [3, 4, 0]])
    assert np.allclose(trajectory.rotations().apply([1, 0, 0]), [[1, 0, 0], [0, 1, 0]])


# ---- DLR


COV = "1e-5 2e-6 2e-5 3e-6 4e-6 1e-4"


@pytest.fixture
def write(tmp_path):
    def file(*lines):
        path = tmp_path / "map.circles"
        path.write_text("# a header\n" + "\n".join(lines) + "\n")
        return path

    return file


def test_robot_that_drives_ahead_and_turns_right_does_so_in_body_axes(write, chain, hold_past_motions):
    """-y is forward and x to the right in the file, so that its angles grow to the right."""
    step = f"STEP image 0 -1 {np.pi / 2} {COV}"
    sequence = read_dlr(write(step, step))
    poses = chain(hold_past_motions(sequence))
    assert np.allclose(poses[1], [[0, 1, 1], [-1, 0, 0], [0, 0, 1]], atol=1e-12)
    assert np.allclose(poses[2][:2, 2], [1, -1], atol=1e-12)


def test_disc_ahead_to_the_right_is_seen_there(write):
    d = read_dlr(write(f"STEP image 0 -1 0 {COV}", "LANDMARK_C 1 -2 0.9 1e-3 2e-4 5e-3 4")).detections
    assert d.range_m[0] == pytest.approx(np.sqrt(5))
    assert d.azimuth_rad[0] == pytest.approx(-np.arctan(0.5))
    assert d.stamps_ns.tolist() == [10**9]


def test_covariances_follow_the_axes(write):
    """By hand: forward variance is the file's c_yy, leftward its c_xx; the reflection leaves c_xy."""
    sequence = read_dlr(write(f"STEP image 0 -1 0 {COV}", "LANDMARK_C 0 -2 0.9 1e-3 2e-4 5e-3 4"))
    assert np.allclose(sequence.dvl.velocity_cov[1, :2, :2], [[2e-5, 2e-6], [2e-6, 1e-5]])
    assert np.allclose(sequence.detections.range_azimuth_cov[0], [[5e-3, 2e-4 / 2], [2e-4 / 2, 1e-3 / 4]])
    assert sequence.calibration.imu.gyro_noise_density == pytest.approx(1e-2)


def test_several_identities_share_and_none_is_none(write):
    point = "LANDMARK_C 0 -2 0.9 1e-3 0 5e-3"
    d = read_dlr(write(f"STEP i 0 -1 0 {COV}", f"{point} 4 9", f"{point} -1", f"{point} 7")).detections
    assert d.candidate_ids.tolist() == [[4, 9], [-1, -1], [7, -1]]
    assert d.id_probability.tolist() == [[0.5, 0.5], [0, 0], [1, 0]]


@pytest.mark.recording
class TestDlr:
    @pytest.fixture
    def path(self, unpacked):
        return next(unpacked("dlr.tar.xz").rglob("map.circles"))

    def test_chain_of_relative_poses_is_the_composition_of_the_files_steps(self, path, se2, chain, hold_past_motions):
        """Composed in the file's own axes, and reflected once at the end."""
        rows = [line.split() for line in path.read_text().splitlines() if line.startswith("STEP")]
        expected = chain(se2(np.array([row[2:5] for row in rows], dtype=float)))
        reflection = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, 1]])
        got = chain(hold_past_motions(read_dlr(path.parent)))
        assert len(got) == 3298
        assert np.abs(got - reflection @ expected @ reflection).max() < 1e-9

    def test_a_disc_stays_where_it_is_from_pose_to_pose(self, path, hold_past_motions):
        sequence = read_dlr(path)
        motions, d = hold_past_motions(sequence), sequence.detections
        x, y = d.range_m * np.cos(d.azimuth_rad), d.range_m * np.sin(d.azimuth_rad)
        ids, _ = d.most_probable()
        seen = {(s // 10**9, i): np.array([a, b]) for s, i, a, b in zip(d.stamps_ns, ids, x, y, strict=True) if i >= 0}
        turning = [k for k in seen if (k[0] + 1, k[1]) in seen and abs(motions[k[0]][1, 0]) > 0.05]
        right = [np.linalg.solve(motions[k], [*seen[k, i], 1])[:2] - seen[k + 1, i] for k, i in turning]
        mirrored = [motions[k, :2, :2] @ (seen[k, i] - motions[k, :2, 2]) - seen[k + 1, i] for k, i in turning]
        assert len(turning) > 4000
        assert np.median(np.linalg.norm(right, axis=1)) < 0.05
        assert np.median(np.linalg.norm(mirrored, axis=1)) > 0.3

    def test_identities_are_the_files(self, path):
        sequence = read_dlr(path)
        ids, probability = sequence.detections.most_probable()
        assert len(ids) == 14745
        assert np.sum(ids == -1) == np.sum(probability == 0) == 436
        assert len(np.unique(ids[ids >= 0])) == 576


# ---- Victoria Park


@pytest.fixture(scope="module")
def lines():
    path = Path(gtsam.findExampleDataFile("victoria_park.txt"))
    return [line.split() for line in path.read_text().splitlines() if line]


@pytest.fixture(scope="module")
def sequence():
    return read_victoria_park()


def test_chain_of_relative_poses_is_the_composition_of_the_files_edges(sequence, lines, chain, hold_past_motions):
    pose, expected = gtsam.Pose2(), [np.eye(3)]
    for line in lines:
        if line[0] == "ODOMETRY":
            pose = pose.compose(gtsam.Pose2(*map(float, line[3:6])))
            expected.append(pose.matrix())
    motions = hold_past_motions(sequence)
    assert len(motions) == 6968
    assert np.abs(chain(motions) - np.array(expected)).max() < 1e-9


def test_velocities_taken_as_chords_break_the_chain(sequence, se2, chain, hold_past_motions):
    exact = chain(hold_past_motions(sequence))
    chords = se2(np.column_stack([sequence.dvl.velocity[1:, :2], sequence.imu.angular_velocity[1:, 2]]))
    assert np.abs(exact - chain(chords)).max() > 0.05


def test_detections_are_the_files_points_at_the_files_poses(sequence, lines):
    d = sequence.detections
    seen = [line for line in lines if line[0] == "LANDMARK"]
    assert len(d) == len(seen) == 3640
    points = np.array([line[3:5] for line in seen], dtype=float)
    assert np.allclose(d.range_m * np.cos(d.azimuth_rad), points[:, 0])
    assert np.allclose(d.range_m * np.sin(d.azimuth_rad), points[:, 1])
    assert d.candidate_ids[:, 0].tolist() == [int(line[2]) for line in seen]
    assert (d.id_probability == 1).all()
    edges_before = np.cumsum([line[0] == "ODOMETRY" for line in lines])[[line[0] == "LANDMARK" for line in lines]]
    assert (d.stamps_ns // 10**9).tolist() == edges_before.tolist()


def test_isotropic_points_have_the_covariance_of_hand_algebra(sequence):
    """S = 0.4 I becomes diag(0.4, 0.4 / r²)."""
    d = sequence.detections
    expected = np.zeros((len(d), 2, 2))
    expected[:, 0, 0], expected[:, 1, 1] = 0.4, 0.4 / d.range_m**2
    assert np.allclose(d.range_azimuth_cov, expected, rtol=1e-12, atol=1e-12)


def test_a_landmark_stays_where_it_is_from_pose_to_pose(sequence, hold_past_motions):
    """Second frame predicted from the first by the edge between: the spread is a fraction of the file's sigma."""
    d, motions = sequence.detections, hold_past_motions(sequence)
    seen = {(s // 10**9, i): (r, a) for s, i, r, a in zip(*columns(d), strict=True)}
    errors = {1: [], -1: []}
    for (k, i), (r, a) in seen.items():
        if (k + 1, i) in seen:
            for sign, found in errors.items():
                here, there = point(r, sign * a), point(*seen[k + 1, i])
                moved = np.linalg.solve(motions[k], [*here, 1.0])[:2]
                found.append(np.linalg.norm(moved - [there[0], sign * there[1]]))
    assert len(errors[1]) > 500
    assert np.median(errors[1]) < 0.5
    assert np.median(errors[1]) <= np.median(errors[-1])


def columns(d):
    return d.stamps_ns.tolist(), d.candidate_ids[:, 0].tolist(), d.range_m.tolist(), d.azimuth_rad.tolist()


def point(r, a):
    return r * np.cos(a), r * np.sin(a)


def test_noise_is_the_files(sequence):
    c = sequence.calibration
    assert c.imu.gyro_noise_density == pytest.approx(2e-3)
    assert c.imu.gyro_bias_sigma == 0
    assert np.allclose(sequence.dvl.velocity_cov[5, :2, :2], np.diag([1e-4, 4e-6]), rtol=0, atol=1e-8)
    assert c.odometry_interpolation == "hold-past"
