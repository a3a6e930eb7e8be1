from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

from sonar_graph.errors import LogError
from sonar_graph.logs.mcap.writer import recording
from sonar_graph.logs.reading import read_log, read_sonar_frames
from sonar_graph.logs.writing import sonar_image_messages, write_log
from sonar_graph.measurements import Imu, SonarFrames

BLOCKS = ("imu", "dvl", "depth", "detections", "truth", "true_landmarks")


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**31),
    samples=st.integers(1, 40),
    candidates=st.integers(1, 4),
    left_out=st.sets(st.sampled_from(BLOCKS[2:])),
)
def test_reading_what_was_written_is_the_identity(make_sequence, tmp_path_factory, seed, samples, candidates, left_out):
    sequence = replace(make_sequence(seed, samples, candidates), **dict.fromkeys(left_out))
    path = tmp_path_factory.mktemp("log") / "log.mcap"
    write_log(path, sequence)
    found = read_log(path)
    for name in BLOCKS:
        expected, actual = getattr(sequence, name), getattr(found, name)
        assert (expected is None) == (actual is None), name
        for field in fields(expected) if expected is not None else ():
            np.testing.assert_array_equal(
                getattr(actual, field.name), getattr(expected, field.name), f"{name}.{field.name}"
            )
    assert (found.name, found.calibration) == (sequence.name, sequence.calibration)
    assert found.notes.items() >= sequence.notes.items()


def test_known_covariances_of_the_truth_survive(make_sequence, tmp_path):
    sequence = make_sequence()
    root = np.random.default_rng(0).normal(size=(len(sequence.truth), 6, 6))
    truth = replace(sequence.truth, covariances=root @ root.transpose(0, 2, 1))
    write_log(tmp_path / "a.mcap", replace(sequence, truth=truth))
    np.testing.assert_allclose(read_log(tmp_path / "a.mcap").truth.covariances, truth.covariances, atol=1e-12)


def test_mcap_ros2_support_decodes_what_is_written(make_sequence, tmp_path, decoded):
    sequence = make_sequence()
    write_log(tmp_path / "a.mcap", sequence)
    messages = decoded(tmp_path / "a.mcap")
    assert set(messages) == {"/imu/data", "/dvl/data", "/depth/pose", "/sonar/landmarks", "/tf_static",
                             "/ground_truth/odometry", "/ground_truth/landmarks"}  # fmt: skip
    imu = messages["/imu/data"]
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in imu]
    assert stamps == sequence.imu.stamps_ns.tolist()
    rates = [[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for m in imu]
    assert rates == sequence.imu.angular_velocity.tolist()
    assert [m.linear_acceleration_covariance[0] for m in imu] == [-1.0 if i % 4 == 0 else 0.0 for i in range(20)]
    assert [m.velocity_mode for m in messages["/dvl/data"]] == [1] * 20
    assert [m.pose.pose.position.z for m in messages["/depth/pose"]] == sequence.depth.z_m.tolist()
    ranges = [r for m in messages["/sonar/landmarks"] for r in m.range_m]
    assert ranges == sequence.detections.range_m.tolist()
    assert list(messages["/ground_truth/landmarks"][0].ids) == [3, 7]
    (tree,) = messages["/tf_static"]
    assert [t.child_frame_id for t in tree.transforms] == ["imu", "dvl", "depth", "sonar"]
    assert tree.transforms[0].transform.translation.y == 0.2


def test_a_stamp_that_ros_cannot_express_or_a_file_that_cannot_be_written_is_named_and_nothing_is_left(
    make_sequence, tmp_path
):
    for stamp_ns in (2**31 * 10**9, -(2**31) * 10**9 - 1):
        sequence = replace(make_sequence(), imu=Imu(np.array([stamp_ns]), np.zeros((1, 3)), np.zeros((1, 3))))
        with pytest.raises(LogError, match="32-bit seconds"):
            write_log(tmp_path / "a.mcap", sequence)
        assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(LogError, match=r"file/a\.mcap cannot be written"):
        write_log(tmp_path / "file" / "a.mcap", make_sequence())


# --- sonar images ----------------------------------------------------------------------------------------------------

KINDS = ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"]


def frames(kind: str = "u1", count: int = 3, first: int = 0, beams: int = 4, bins: int = 5) -> SonarFrames:
    intensity = np.arange(count * beams * bins).reshape(count, beams, bins) % 97 + first
    stamps_ns = 1_700_000_000_000_000_123 + (first + np.arange(count)) * 10**8
    azimuths_rad = np.radians(np.linspace(14.0, -15.0, beams))
    return SonarFrames(stamps_ns, intensity.astype(kind), np.linspace(1.26, 2.51, bins), azimuths_rad)


def write_frames(path: Path, *blocks: SonarFrames) -> Path:
    with recording(path, {}) as out:
        for block in blocks:
            out.write([sonar_image_messages("/sonar/image", block, frequency_hz=1.8e6, sound_speed_m_s=1480)])
    return path


@pytest.mark.parametrize("kind", [*KINDS, ">u2", ">f4"])
def test_frames_are_read_as_they_were_written(tmp_path, kind):
    written = frames(kind)
    (read,) = read_sonar_frames(write_frames(tmp_path / "log.mcap", written))
    np.testing.assert_array_equal(read.stamps_ns, written.stamps_ns)
    np.testing.assert_array_equal(read.intensity, written.intensity)
    assert read.intensity.dtype == written.intensity.dtype.newbyteorder("<")
    np.testing.assert_array_equal(read.ranges_m, written.ranges_m.astype(np.float32))
    np.testing.assert_allclose(read.azimuths_rad, written.azimuths_rad, atol=1e-15)


def test_another_library_sees_what_the_message_defines(tmp_path):
    written = frames()
    with write_frames(tmp_path / "log.mcap", written).open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        messages = [message for *_, message in reader.iter_decoded_messages()]
    assert [m.header.stamp.nanosec for m in messages] == [123, 100_000_123, 200_000_123]
    first = messages[0]
    assert (first.ping_info.frequency, first.ping_info.sound_speed) == (np.float32(1.8e6), 1480)
    assert (first.image.dtype, first.image.beam_count, first.image.is_bigendian) == (0, 4, False)
    assert bytes(first.image.data) == written.intensity[0].T.tobytes()  # all beams of the first range first
    left, right = first.beam_directions[0], first.beam_directions[-1]
    assert (left.x, right.x) == (0, 0)
    assert left.y < 0 < right.y  # y is to the right
    np.testing.assert_allclose([left.z, right.z], np.cos(np.radians([14, 15])))


def test_pieces_of_different_size_are_one_recording(tmp_path):
    blocks = [frames(first=0), frames(first=3, bins=7), frames(first=6, count=1)]
    read = list(read_sonar_frames(write_frames(tmp_path / "log.mcap", *blocks)))
    assert [(len(block), block.intensity.shape[2]) for block in read] == [(3, 5), (3, 7), (1, 5)]
    assert (np.diff(np.concatenate([block.stamps_ns for block in read])) > 0).all()
    np.testing.assert_array_equal(read[2].intensity, blocks[2].intensity)


def test_an_existing_recording_survives_an_error(tmp_path):
    path = write_frames(tmp_path / "log.mcap", frames())
    before = path.read_bytes()
    with pytest.raises(LogError, match="/sonar/image: samples of type complex"):
        write_frames(path, frames(first=3), frames("c16"))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_messages_and_images_that_are_made_one_by_one_lie_in_the_order_of_their_times(make_sequence, tmp_path):
    sequence = make_sequence()
    blocks = [replace(frames(count=1), stamps_ns=sequence.imu.stamps_ns[row : row + 1]) for row in (4, 12)]
    write_log(tmp_path / "a.mcap", sequence)
    write_log(tmp_path / "b.mcap", sequence, (sonar_image_messages("/sonar/image", block) for block in blocks))
    times: list[list[int]] = []
    for name in ("a.mcap", "b.mcap"):
        with (tmp_path / name).open("rb") as stream:
            times.append([r.log_time for r in StreamReader(stream).records if isinstance(r, Message)])
    assert len(times[0]) > 80
    assert times[0] == sorted(times[0])
    assert times[1] == sorted([*times[0], *(int(block.stamps_ns[0]) for block in blocks)])
