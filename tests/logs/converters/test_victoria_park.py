from pathlib import Path

import gtsam
import numpy as np
import pytest

from sonar_graph.logs.convert.victoria_park import read_victoria_park


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


GOOD = "ODOMETRY 0 1 1 0 0 1 0 0 1 0 1\n"


@pytest.mark.parametrize(
    ("content", "fragments"),
    [
        ("", ("holds no data", "ODOMETRY")),
        (GOOD + "EDGE 1 2\n", ("line 2", "EDGE")),
        (GOOD + "ODOMETRY 1 2 1 0\n", ("line 2", "4 fields", "11 numbers")),
        (GOOD + "ODOMETRY 0 2 1 0 0 1 0 0 1 0 1\n", ("line 2", "newest pose is 1")),
        (GOOD + "LANDMARK 0 7 1 0 1 0 1\n", ("line 2", "newest pose is 1")),
        ("LANDMARK 0 7 1 0 1 0 1\n", ("no ODOMETRY",)),
    ],
)
def test_a_malformed_file_is_refused_by_line(tmp_path, refusal, content, fragments):
    path = tmp_path / "park.txt"
    path.write_text(content)
    refusal(lambda: read_victoria_park(path), path, *fragments)


def test_a_file_without_landmarks_has_no_detections(tmp_path):
    path = tmp_path / "park.txt"
    path.write_text(GOOD)
    assert read_victoria_park(path).detections is None
