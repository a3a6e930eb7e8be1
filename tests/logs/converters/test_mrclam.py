import numpy as np
import pytest

from sonar_graph.logs.convert.mrclam import read_mrclam

from .builders import chain, hold_past_motions

T0 = 1248444187
NS = 10**9


@pytest.fixture
def folder(tmp_path):
    def write(name, rows):
        (tmp_path / name).write_text("# Data Format:\n" + "".join(" \t ".join(map(str, row)) + "\n" for row in rows))

    write("Barcodes.dat", [(1, 5), (2, 14), (6, 63), (20, 25)])
    write("Landmark_Groundtruth.dat", [(20, 1.5, -2.5, 0.001, 0.002), (6, 3.0, 4.0, 0.003, 0.004)])
    write("Robot1_Odometry.dat", [(f"{T0}.100", 0.1, 0.0), (f"{T0}.300", 0.2, 0.5), (f"{T0}.400", 0.0, 0.0)])
    write("Robot1_Groundtruth.dat", [(f"{T0}.000", 1, 2, 3.0), (f"{T0}.200", 3, 2, -3.0), (f"{T0}.200", 9, 9, 0)])
    seen = [(".250", 25, 2.0, 0.1), (".250", 14, 2.0, 0.1), (".120", 63, 1.0, -0.2), (".350", 99, 1, 0)]
    write("Robot1_Measurement.dat", [(f"{T0}{time}", *row) for time, *row in seen])
    return tmp_path


def test_a_command_holds_from_its_stamp_to_the_next_and_so_does_its_noise(folder):
    """0.1 m/s for 0.2 s, then 0.2 m/s for 0.1 s while turning 0.05 rad; the last command governs nothing."""
    sequence = read_mrclam(folder, 1)
    end = chain(hold_past_motions(sequence))[-1]
    radius = 0.2 / 0.5
    expected = [0.02 + radius * np.sin(0.05), radius * (1 - np.cos(0.05))]
    assert np.allclose(end[:2, 2], expected, rtol=0, atol=1e-9)
    assert np.arctan2(end[1, 0], end[0, 0]) == pytest.approx(0.05)
    assert sequence.calibration.odometry_interpolation == "hold-past"
    # slip grows with time: the distance has variance sum(var * dt²) = q² T however T is divided
    dt = np.diff(sequence.dvl.stamps_ns) * 1e-9
    assert np.sum(sequence.dvl.velocity_cov[1:, 0, 0] * dt**2) == pytest.approx(0.02**2 * dt.sum())


def test_of_commands_with_one_stamp_the_last_holds(folder):
    (folder / "Robot1_Odometry.dat").write_text(f"{T0}.1 0.1 0\n{T0}.2 0.9 0.9\n{T0}.2 0.3 0.4\n{T0}.3 0 0\n")
    sequence = read_mrclam(folder, 1)
    assert sequence.dvl.velocity[:, 0].tolist() == [0.1, 0.1, 0.3]
    assert sequence.imu.angular_velocity[:, 2].tolist() == [0.0, 0.0, 0.4]


def test_times_subjects_and_coordinates_stay_the_data_sets_own_and_robots_are_left_out(folder):
    sequence = read_mrclam(folder, 1)
    stamps = [T0 * NS + 100_000_000, T0 * NS + 300_000_000, T0 * NS + 400_000_000]
    assert sequence.imu.stamps_ns.tolist() == sequence.dvl.stamps_ns.tolist() == stamps
    d, landmarks = sequence.detections, sequence.true_landmarks
    assert d.stamps_ns.tolist() == [T0 * NS + 120_000_000, T0 * NS + 250_000_000]
    assert (d.candidate_ids.tolist(), d.id_probability.tolist()) == ([[6], [20]], [[1], [1]])
    assert (d.range_m.tolist(), d.azimuth_rad.tolist()) == ([1.0, 2.0], [-0.2, 0.1])
    assert np.isnan(d.range_azimuth_cov).all()
    assert "1 of other robots, 1 with unknown" in sequence.notes["detections"]
    assert landmarks.ids.tolist() == [6, 20]
    assert landmarks.positions.tolist() == [[3.0, 4.0, 0.0], [1.5, -2.5, 0.0]]
    assert np.allclose(landmarks.covariances[0], np.diag([9e-6, 16e-6, 0]))


def test_start_is_the_truth_at_the_first_command_across_the_wrap(folder):
    """Half way from heading 3 to -3 by the short way is pi."""
    sequence = read_mrclam(folder, 1)
    start, truth = sequence.calibration.start, sequence.truth
    assert truth.positions.tolist() == [[1.0, 2.0, 0.0], [3.0, 2.0, 0.0]]
    assert np.allclose(truth.rotations()[0].apply([1, 0, 0]), [np.cos(3), np.sin(3), 0])
    assert np.allclose(start.position_m, [2.0, 2.0, 0.0])
    assert abs(start.rpy_rad[2]) == pytest.approx(np.pi)


def test_without_robot_truth_at_the_first_command_the_start_is_the_origin(folder):
    (folder / "Robot1_Groundtruth.dat").write_text(f"{T0}.2 3 2 1\n{T0}.3 3 2 1\n")
    (folder / "Robot1_Measurement.dat").write_text(f"{T0}.2 14 1 0\n")  # of another robot
    late = read_mrclam(folder, 1)
    assert (len(late.truth), late.detections) == (2, None)
    assert "origin" in late.notes["start"]
    (folder / "Robot1_Groundtruth.dat").unlink()
    never = read_mrclam(folder, 1)
    assert never.truth is None
    assert never.true_landmarks is not None
    assert "no robot truth" in never.notes["truth"]
    assert late.calibration.start.position_m == never.calibration.start.position_m == (0.0, 0.0, 0.0)


@pytest.fixture(scope="module", params=[1, 2, 3, 4, 5])
def sequence(request, unpacked):
    folder = next(unpacked("mrclam_ds6.tar.xz").rglob("Barcodes.dat")).parent
    return read_mrclam(folder, request.param)


@pytest.mark.recording
class TestSet6:
    """Against motion capture; bounds from docs/theory/datasets.md, with room."""

    def test_detections_point_at_the_true_landmarks(self, sequence):
        assert set(sequence.detections.candidate_ids[:, 0].tolist()) <= set(range(6, 21))
        assert sequence.true_landmarks.ids.tolist() == list(range(6, 21))
        assert T0 - 20 < sequence.start_ns / NS < T0 + 20
        d, truth = sequence.detections, sequence.truth
        d = d.rows((d.stamps_ns >= truth.stamps_ns[0]) & (d.stamps_ns <= truth.stamps_ns[-1]))
        stamps, frame = np.unique(d.stamps_ns, return_inverse=True)
        frames = truth.at(stamps)
        world_R_body, position = frames.rotations()[frame], frames.positions[frame]
        where = np.searchsorted(sequence.true_landmarks.ids, d.candidate_ids[:, 0])
        offset = world_R_body.inv().apply(sequence.true_landmarks.positions[where] - position)
        azimuth = np.arctan2(offset[:, 1], offset[:, 0])
        assert np.median(np.abs(d.range_m - np.hypot(*offset[:, :2].T))) < 0.15
        assert np.median(np.abs(wrapped(d.azimuth_rad - azimuth))) < 0.02
        assert np.median(np.abs(wrapped(-d.azimuth_rad - azimuth))) > 0.3

    def test_held_commands_follow_the_truth_better_than_other_readings(self, sequence):
        """RMS turn error over one second: held to the next < value at its stamp, and < held from the one before."""
        held = turn_error(sequence, sequence.imu.angular_velocity[1:, 2])
        commands = np.append(sequence.imu.angular_velocity[1:, 2], 0.0)
        assert held < 0.06
        assert held < turn_error(sequence, 0.5 * (commands[1:] + commands[:-1]))
        assert held < turn_error(sequence, commands[1:])
        assert turn_error(sequence, -sequence.imu.angular_velocity[1:, 2]) > 0.15

    def test_turns_err_by_the_calibrated_noise(self, sequence):
        imu = sequence.calibration.imu
        for seconds in (1, 5):
            predicted = np.hypot(imu.gyro_noise_density * np.sqrt(seconds), imu.gyro_bias_sigma * seconds)
            error = turn_error(sequence, sequence.imu.angular_velocity[1:, 2], seconds)
            assert 0.5 < error / predicted < 1.5


def turn_error(sequence, rates, seconds=1):
    """RMS of measured minus true heading change over windows that begin each half second."""
    stamps, truth = sequence.imu.stamps_ns, sequence.truth
    heading = np.concatenate([[0.0], np.cumsum(rates * np.diff(stamps) * 1e-9)])
    begin = np.arange(stamps[0] + NS, min(stamps[-1], truth.stamps_ns[-1]) - (seconds + 1) * NS, NS // 2)
    end = begin + seconds * NS
    origin = stamps[0]
    measured = np.interp(end - origin, stamps - origin, heading) - np.interp(begin - origin, stamps - origin, heading)
    yaw = [truth.at(t).rotations().as_euler("ZYX")[:, 0] for t in (begin, end)]
    return np.sqrt(np.mean(wrapped(measured - (yaw[1] - yaw[0])) ** 2))


def wrapped(angle):
    return np.angle(np.exp(1j * angle))


@pytest.mark.recording
def test_sets_without_robot_truth_have_landmarks_and_motion(unpacked):
    folder = unpacked("mrclam_ds2_ds4.tar.xz") / "MRCLAM_Dataset4"
    sequence = read_mrclam(folder, 2)
    assert sequence.truth is None
    assert len(sequence.true_landmarks) == 15
    assert len(sequence.detections) > 1000
