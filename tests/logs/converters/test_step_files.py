"""Planar robots by the files of their steps: DLR and Victoria Park."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from sonar_graph.logs.convert.planar import range_azimuth, twists_of_steps
from sonar_graph.logs.convert.step_files import read_dlr, read_victoria_park

from .builders import chain, hold_past_motions

metres = st.floats(-10, 10)
turns = st.one_of(st.floats(-3.1, 3.1), st.floats(-2e-4, 2e-4), st.just(0.0))
COV = "1e-5 2e-6 2e-5 3e-6 4e-6"
STRAIGHT, RIGHT = f"STEP image 0 -1 0 {COV} 1e-4", f"STEP image 0 -1 {np.pi / 2} {COV}"


def motion_of(velocity, rate):
    return expm(np.array([[0, -rate, velocity[0]], [rate, 0, velocity[1]], [0, 0, 0]]))


@given(metres, metres, turns)
def test_twist_held_over_the_step_makes_the_step_and_its_noise(dx, dy, turn):
    cov = np.diag([4e-4, 2e-4, 0.0])
    cov[0, 1] = cov[1, 0] = 1e-4
    (velocity,), (velocity_cov,), (rate,) = twists_of_steps(np.array([[dx, dy, turn]]), cov[None])
    assert np.allclose(motion_of(velocity, rate), gtsam.Pose2(dx, dy, turn).matrix(), rtol=0, atol=1e-11)
    V = np.column_stack([motion_of(axis, rate)[:2, 2] for axis in np.eye(2)])
    assert np.allclose(V @ velocity_cov @ V.T, cov[:2, :2], rtol=0, atol=1e-12)


@given(st.floats(0.5, 20), st.floats(-3.1, 3.1), st.floats(0.01, 0.2), st.floats(0.01, 0.2), st.floats(-0.9, 0.9))
def test_polar_covariance_is_the_numerical_jacobians(distance, azimuth, sx, sy, rho):
    point = distance * np.array([[np.cos(azimuth), np.sin(azimuth)]])
    S = np.array([[[sx**2, rho * sx * sy], [rho * sx * sy, sy**2]]])

    def polar(offset):
        return np.concatenate(range_azimuth(point + offset, S)[:2])

    assert np.allclose(polar(0), [distance, azimuth])
    J = np.column_stack([(polar(offset) - polar(-offset)) / 2e-6 for offset in 1e-6 * np.eye(2)])
    assert np.allclose(range_azimuth(point, S)[2], J @ S[0] @ J.T, rtol=1e-6, atol=1e-9)


# ---- axes and identities of DLR


@pytest.fixture
def dlr_of(tmp_path):
    def sequence(*lines):
        path = tmp_path / "map.circles"
        path.write_text("# a header\n" + "\n".join(lines) + "\n")
        return read_dlr(path)

    return sequence


def test_ahead_is_minus_y_and_angles_grow_to_the_right_in_the_file(dlr_of):
    """By hand: forward variance is the file's c_yy, leftward its c_xx; the reflection leaves c_xy."""
    s = dlr_of(STRAIGHT, "LANDMARK_C 0 -2 0.9 1e-3 2e-4 5e-3 4", f"{RIGHT} 2e-4", "LANDMARK_C 1 -2 1 1 0 1 4",
               f"{RIGHT} 3e-4")  # fmt: skip
    poses = chain(hold_past_motions(s))
    assert np.allclose(poses[2], [[0, 1, 2], [-1, 0, 0], [0, 0, 1]], atol=1e-12)
    assert np.allclose(poses[3][:2, 2], [2, -1], atol=1e-12)
    assert np.allclose(s.dvl.velocity_cov[:2, :2, :2], [[2e-5, 2e-6], [2e-6, 1e-5]])
    assert s.dvl.velocity_cov[:, 2, 2] == pytest.approx([1e-6] * 4)  # a millimetre a second
    assert s.calibration.imu.gyro_noise_density**2 == pytest.approx(2e-4)  # the mean over the steps
    assert not np.any([s.dvl.velocity[0], s.imu.angular_velocity[0]])  # it begins at rest
    assert np.isnan(s.imu.specific_force).all()
    assert np.allclose(s.detections.range_azimuth_cov[0], [[5e-3, 2e-4 / 2], [2e-4 / 2, 1e-3 / 4]])
    assert s.detections.range_m == pytest.approx([2, np.sqrt(5)])
    assert s.detections.azimuth_rad == pytest.approx([0, -np.arctan(0.5)])
    assert s.detections.stamps_ns.tolist() == [10**9, 2 * 10**9]


def test_several_identities_share_and_none_is_none(dlr_of):
    point = "LANDMARK_C 0 -2 0.9 1e-3 0 5e-3"
    d = dlr_of(STRAIGHT, f"{point} 4 9", f"{point} -1", f"{point} 7").detections
    assert d.candidate_ids.tolist() == [[4, 9], [-1, -1], [7, -1]]
    assert d.id_probability.tolist() == [[0.5, 0.5], [0, 0], [1, 0]]


# ---- the recorded runs


@pytest.fixture(scope="module", params=[pytest.param("dlr", marks=pytest.mark.recording), "park"])
def recorded(request):
    """Name, lines of the file, and sequence."""
    is_dlr = request.param == "dlr"
    path = Path(gtsam.findExampleDataFile("victoria_park.txt"))
    if is_dlr:
        path = next(request.getfixturevalue("unpacked")("dlr.tar.xz").rglob("map.circles"))
    lines = [line.split() for line in path.read_text().splitlines() if line.strip()]
    return request.param, lines, read_dlr(path.parent) if is_dlr else read_victoria_park()


def test_chain_of_relative_poses_is_the_composition_of_the_files_steps(recorded):
    """Composed in the file's own axes, and reflected once at the end; velocities taken as chords break the chain."""
    name, lines, sequence = recorded
    kind, column, body_R_file = ("ODOMETRY", 3, np.eye(3))
    if name == "dlr":
        kind, column, body_R_file = "STEP", 2, np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, 1]])
    steps = [gtsam.Pose2(*map(float, line[column : column + 3])).matrix() for line in lines if line[0] == kind]
    got = chain(hold_past_motions(sequence))
    assert len(got) == {"dlr": 3298, "park": 6969}[name]
    assert np.abs(got - body_R_file @ chain(steps) @ body_R_file).max() < 1e-9
    chords = np.column_stack([sequence.dvl.velocity[1:, :2], sequence.imu.angular_velocity[1:, 2]])
    assert np.abs(got - chain([gtsam.Pose2(*chord).matrix() for chord in chords])).max() > 0.05


def test_a_landmark_stays_where_it_is_from_pose_to_pose(recorded):
    """Predicted to the next pose, as it is and mirrored; in the office where the robot turns."""
    name, _, sequence = recorded
    least_turn_rad, count, most_m = (0.05, 4000, 0.05) if name == "dlr" else (-1, 500, 0.5)
    motions, d = hold_past_motions(sequence), sequence.detections
    medians = []
    for azimuth_rad in (d.azimuth_rad, -d.azimuth_rad):
        points = np.column_stack([d.range_m * np.cos(azimuth_rad), d.range_m * np.sin(azimuth_rad), np.ones(len(d))])
        at = zip((d.stamps_ns // 10**9).tolist(), d.most_probable()[0].tolist(), strict=True)
        seen = {(k, i): point for (k, i), point in zip(at, points, strict=True) if i >= 0}
        moved = [
            np.linalg.norm(np.linalg.solve(motions[k], point) - seen[k + 1, i])
            for (k, i), point in seen.items()
            if (k + 1, i) in seen and abs(motions[k][1, 0]) > least_turn_rad
        ]
        assert len(moved) > count
        medians.append(np.median(moved))
    assert medians[0] < most_m
    assert medians[1] > (0.3 if name == "dlr" else medians[0])


def test_detections_are_the_files(recorded):
    name, lines, sequence = recorded
    d = sequence.detections
    ids, probability = d.most_probable()
    if name == "dlr":
        assert len(ids) == 14745
        assert np.sum(ids == -1) == np.sum(probability == 0) == 436
        assert len(np.unique(ids[ids >= 0])) == 576
        return
    seen = [line for line in lines if line[0] == "LANDMARK"]
    assert len(d) == len(seen) == 3640
    points = np.array([line[3:5] for line in seen], dtype=float)
    assert np.allclose(d.range_m[:, None] * np.column_stack([np.cos(d.azimuth_rad), np.sin(d.azimuth_rad)]), points)
    assert ids.tolist() == [int(line[2]) for line in seen]
    assert (probability == 1).all()
    edges_before = np.cumsum([line[0] == "ODOMETRY" for line in lines])[[line[0] == "LANDMARK" for line in lines]]
    assert (d.stamps_ns // 10**9).tolist() == edges_before.tolist()
    # S = 0.4 I becomes diag(0.4, 0.4 / r²)
    expected = np.zeros((len(d), 2, 2))
    expected[:, 0, 0], expected[:, 1, 1] = 0.4, 0.4 / d.range_m**2
    assert np.allclose(d.range_azimuth_cov, expected, rtol=1e-12, atol=1e-12)
    imu = sequence.calibration.imu
    assert (imu.gyro_noise_density, imu.gyro_bias_sigma) == pytest.approx((2e-3, 0))
    assert np.allclose(sequence.dvl.velocity_cov[5, :2, :2], np.diag([1e-4, 4e-6]), rtol=0, atol=1e-8)
    assert sequence.calibration.odometry_interpolation == "hold-past"
