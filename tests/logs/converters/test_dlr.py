import numpy as np
import pytest

from sonar_graph.logs.convert.dlr import read_dlr

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


@pytest.mark.parametrize(
    ("lines", "fragments"),
    [
        ([], ("holds no data", "STEP")),
        (["LANDMARK_C 0 1 1 1 0 1 4"], ("line 2", "before the first STEP")),
        (["STEP image 1 2"], ("line 2", "2 fields", "9 numbers")),
        ([f"STEP image 0 0 0 {COV}", "LANDMARK_C 0 1 1 1 0 1"], ("line 3", "no landmark ID")),
        ([f"STEP image 0 0 0 {COV}", "LANDMARK_C 0 1 1 1 0 1 4.5"], ("line 3", "4.5", "whole numbers")),
        ([f"STEP image 0 0 0 {COV}", "CIRCLE 1"], ("line 3", "CIRCLE")),
    ],
)
def test_a_malformed_file_is_refused_by_line(write, refusal, lines, fragments):
    path = write(*lines)
    refusal(lambda: read_dlr(path), path, *fragments)


def test_a_folder_without_the_file_is_refused(tmp_path, refusal):
    told = refusal(lambda: read_dlr(tmp_path), "map.circles", "STEP", "give the folder that does, or the file itself")
    assert "Errno" not in told
    assert "Errno" not in refusal(lambda: read_dlr(tmp_path / "missing"), "missing", "No such file", "STEP")


@pytest.mark.recording
class TestRecording:
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
