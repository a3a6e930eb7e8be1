from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sonar_graph.calibration import Calibration
from sonar_graph.errors import CalibrationError, LogError, MissingTopicError
from sonar_graph.logs.cdr.definitions import definition
from sonar_graph.logs.mcap.file_summary import Instant, TimeWindow
from sonar_graph.logs.mcap.writer import write_recording
from sonar_graph.logs.reading import read_log
from sonar_graph.logs.vehicle_setup import PartialCalibration
from sonar_graph.logs.writing import dvl_messages, imu_messages, write_log

from .containers import chunk_indexes, flip

STEP_NS = 10**8


def test_a_log_without_imu_or_dvl_names_what_is_there(bench: Any) -> None:
    imu, dvl = bench.basics()
    with pytest.raises(
        MissingTopicError, match=r"nothing for dvl: no marine_acoustic_msgs/Dvl, dvl_msgs/DVL.*/imu \(sensor_msgs"
    ):
        read_log(bench.write(imu))
    with pytest.raises(
        MissingTopicError, match=r"nothing for imu.*IMU and Doppler log must both be in the log.*/dvl \(marine"
    ):
        read_log(bench.write(dvl))


def test_two_topics_for_one_role_must_be_chosen_from(bench: Any) -> None:
    imu, dvl = bench.basics()
    fast = [bench.imu(bench.t0_ns + i * STEP_NS, (0, 0, 7.0)) for i in range(5)]
    path = bench.write(imu, dvl, ("/other", "imu", fast))
    with pytest.raises(LogError, match=r"2 topics fit: /imu, /other; choose one: --topic imu=/imu \(topics=\{'imu'"):
        read_log(path)
    assert read_log(path, topics={"imu": "/imu"}).imu.angular_velocity[0, 2] == 0.1
    chosen = read_log(path, topics={"imu": "/other"})
    assert chosen.imu.angular_velocity[0, 2] == 7.0
    assert "imu: /other" in chosen.notes["log.topics"]


def test_choices_that_cannot_be_are_refused(bench: Any) -> None:
    path = bench.write(*bench.basics())
    with pytest.raises(MissingTopicError, match=r"/nowhere was chosen but is not in the log.*/imu"):
        read_log(path, topics={"imu": "/nowhere"})
    with pytest.raises(MissingTopicError, match="/dvl was chosen but is a marine_acoustic_msgs/msg/Dvl"):
        read_log(path, topics={"depth": "/dvl"})
    with pytest.raises(LogError, match="no role gyro; topics are chosen for imu, dvl"):
        read_log(path, topics={"gyro": "/imu"})


def test_stamps_are_the_headers_sorted_and_once(bench: Any) -> None:
    imu, dvl = bench.basics()
    stamps = [bench.t0_ns + i * STEP_NS for i in (0, 2, 1, 2, 3)]
    rates = [(float(i), 0, 0) for i in range(5)]
    imu = ("/imu", "imu", [bench.imu(s, r) for s, r in zip(stamps, rates, strict=True)])
    sequence = read_log(bench.write(imu, dvl))
    assert sequence.imu.stamps_ns.tolist() == [bench.t0_ns + i * STEP_NS for i in range(4)]
    assert sequence.imu.angular_velocity[:, 0].tolist() == [0, 2, 1, 4]
    assert sequence.notes["log.dropped"] == "imu: 1 with the stamp of another"


def test_log_time_stands_in_for_a_stamp_of_zero(bench: Any) -> None:
    _, dvl = bench.basics()
    imu = ("/imu", "imu", [bench.imu(0) for _ in range(3)])
    sequence = read_log(bench.write(imu, dvl))
    assert sequence.imu.stamps_ns.tolist() == [bench.t0_ns + i * STEP_NS for i in range(3)]


def test_unusable_rows_are_left_out_and_counted(bench: Any) -> None:
    t0 = bench.t0_ns
    nothing = [-1.0] + [0.0] * 8
    imu = [bench.imu(t0), bench.imu(t0 + 1, (np.nan, 0, 0)), bench.imu(t0 + 2, angular_velocity_covariance=nothing)]
    imu += [bench.imu(t0 + 3, linear_acceleration_covariance=nothing)]
    dvl = [bench.dvl(t0), bench.dvl(t0 + 1, (np.inf, 0, 0)), bench.dvl(t0 + 2, velocity_mode=2)]
    dvl += [bench.dvl(t0 + 3, num_good_beams=0), bench.dvl(t0 + 4)]
    sequence = read_log(bench.write(("/imu", "imu", imu), ("/dvl", "dvl", dvl)))
    assert (sequence.imu.stamps_ns - t0).tolist() == [0, 3]
    assert (sequence.dvl.stamps_ns - t0).tolist() == [0, 4]
    np.testing.assert_array_equal(sequence.imu.specific_force, [[0.1, 0.2, 9.8], [np.nan] * 3])
    assert sequence.notes["log.dropped"] == (
        "imu: 1 without angular rate, 1 with values that are not finite; "
        "dvl: 1 with velocity_mode not 1, 1 without a good beam, 1 with values that are not finite"
    )


def test_a_role_of_which_nothing_is_left_is_an_error(bench: Any) -> None:
    imu, _ = bench.basics()
    water = ("/dvl", "dvl", [bench.dvl(bench.t0_ns + i, velocity_mode=2) for i in range(3)])
    with pytest.raises(LogError, match=r"/dvl: none of its 3 messages can be used: 3 with velocity_mode not 1"):
        read_log(bench.write(imu, water))


def test_a_driver_that_never_counts_beams_is_believed(bench: Any) -> None:
    imu, _ = bench.basics()
    dvl = ("/dvl", "dvl", [bench.dvl(bench.t0_ns + i, num_good_beams=0) for i in range(3)])
    assert len(read_log(bench.write(imu, dvl)).dvl) == 3


def test_unknown_velocity_covariances_are_nan_and_known_ones_are_kept(bench: Any) -> None:
    imu, _ = bench.basics()
    known = [0.1, 0, 0, 0, 0.2, 0, 0, 0, 0.3]
    covariances = [[-1.0] + [0.0] * 8, [0.0] * 9, known]
    dvl = ("/dvl", "dvl", [bench.dvl(bench.t0_ns + i, velocity_covar=c) for i, c in enumerate(covariances)])
    found = read_log(bench.write(imu, dvl)).dvl.velocity_cov
    assert np.isnan(found[:2]).all()
    np.testing.assert_array_equal(found[2], np.diag([0.1, 0.2, 0.3]))


def test_pressure_becomes_height_by_hydrostatics(bench: Any) -> None:
    # ten metres of fresh water at standard gravity weigh 98066.5 Pa
    messages = [bench.pressure(bench.t0_ns, 101_325.0), bench.pressure(bench.t0_ns + 1, 101_325 + 98_066.5, 98.0665**2)]
    sequence = read_log(bench.write(*bench.basics(), ("/bar30", "pressure", messages)))
    assert sequence.depth is not None
    np.testing.assert_allclose(sequence.depth.z_m, [0, -10], atol=1e-12)
    np.testing.assert_allclose(sequence.depth.variance_m2, [np.nan, 1e-4])
    assert "1000 kg/m3" in sequence.notes["log.depth"]


def test_truth_needs_a_name_that_says_so(bench: Any) -> None:
    poses = [bench.odometry(bench.t0_ns + i, float(i)) for i in range(3)]
    guess = read_log(bench.write(*bench.basics(), ("/odom", "odometry", poses)))
    assert guess.truth is None
    assert "/odom only if chosen" in guess.notes["log.truth"]
    path = bench.write(*bench.basics(), ("/odom", "odometry", poses), ("/rov/ground_truth", "odometry", poses))
    for sequence in (read_log(path), read_log(path, topics={"truth": "/odom"})):
        assert sequence.truth is not None
        assert sequence.truth.positions[:, 0].tolist() == [0, 1, 2]
        assert np.isnan(sequence.truth.covariances).all()


def test_detections_are_padded_to_the_most_candidates(bench: Any) -> None:
    t0 = bench.t0_ns
    frames = [bench.detections(t0, [1.0, 2.0], [5, 6]), bench.detections(t0 + 1, [], [])]
    frames += [bench.detections(t0 + 2, [3.0], [7, 8, 9]), bench.detections(t0 + 3, [np.nan, 4.0], [1, 2])]
    sequence = read_log(bench.write(*bench.basics(), ("/landmarks", "detections", frames)))
    assert sequence.detections is not None
    assert (sequence.detections.stamps_ns - t0).tolist() == [0, 0, 2, 3]
    assert sequence.detections.range_m.tolist() == [1, 2, 3, 4]
    assert sequence.detections.candidate_ids.tolist() == [[5, -1, -1], [6, -1, -1], [7, 8, 9], [2, -1, -1]]
    assert sequence.detections.id_probability[0].tolist() == [0.5, 0, 0]
    np.testing.assert_array_equal(sequence.detections.range_azimuth_cov[0], [[0.01, 0], [0, 0.02]])


def test_detections_belong_to_tracks_where_the_message_says_so(bench: Any) -> None:
    """Also when messages of one log differ in it."""
    t0 = bench.t0_ns
    frames = [bench.detections(t0, [1.0, 2.0], [5, 6], (4, 3)), bench.detections(t0 + 1, [3.0], [5])]
    frames += [bench.detections(t0 + 2, [4.0, 5.0], [5, 6], (-1, 3)), bench.detections(t0 + 3, [6.0], [5], (7,))]
    found = read_log(bench.write(*bench.basics(), ("/landmarks", "detections", frames))).detections
    assert found is not None
    assert found.range_m.tolist() == [1, 2, 3, 4, 5, 6]
    assert found.track.tolist() == [4, 3, -1, -1, 3, 7]


def test_detections_of_logs_older_than_tracks_belong_to_none(bench: Any) -> None:
    text = definition("sonar_graph_msgs/msg/LandmarkDetections")
    older = "\n".join(line for line in text.split("\n") if not line.startswith("int64[] track"))
    assert older != text
    frames = [bench.detections(bench.t0_ns, [1.0, 2.0], [5, 6])]
    del frames[0]["track"]
    path = bench.write(*bench.basics(), ("/landmarks", "detections", frames), schemas={"detections": older})
    found = read_log(path).detections
    assert found is not None
    assert found.range_m.tolist() == [1, 2]
    assert found.track.tolist() == [-1, -1]


def test_tracks_of_another_number_than_detections_are_named(bench: Any) -> None:
    frames = [bench.detections(bench.t0_ns, [1.0, 2.0], [5, 6], (4,))]
    with pytest.raises(LogError, match=r"/landmarks: message 0 has 2 ranges and 1 tracks"):
        read_log(bench.write(*bench.basics(), ("/landmarks", "detections", frames)))


def test_detections_whose_lists_disagree_are_named(bench: Any) -> None:
    frames = [bench.detections(bench.t0_ns, [1.0], [5]), bench.detections(bench.t0_ns, [1.0, 2.0], [5, 6, 7])]
    with pytest.raises(LogError, match=r"/landmarks: message 1 has 2 ranges.* 3 identities"):
        read_log(bench.write(*bench.basics(), ("/landmarks", "detections", frames)))


def test_mountings_come_from_tf_static_through_frames_in_between(bench: Any) -> None:
    first = bench.transform("base_link", "frame", (1, 0, 0), np.pi / 2)
    second = bench.transform("frame", "imu_link", (0.5, 0, 0), np.pi / 2)
    tree = ("/tf_static", "tf", [{"transforms": [second]}, {"transforms": [first]}])
    sequence = read_log(bench.write(*bench.basics(), tree))
    # half a metre along the frame's x, which points along the body's y
    np.testing.assert_allclose(sequence.calibration.imu.mounting.translation_m, [1, 0.5, 0], atol=1e-12)
    np.testing.assert_allclose(np.abs(sequence.calibration.imu.mounting.rpy_rad), [0, 0, np.pi], atol=1e-12)
    assert sequence.calibration.dvl == Calibration().dvl
    assert "mountings from /tf_static: imu; not in the tree" in sequence.notes["log.calibration"]


def test_a_given_calibration_goes_before_the_one_in_the_log(make_sequence: Any, tmp_path: Path) -> None:
    sequence = make_sequence()
    write_log(tmp_path / "a.mcap", sequence)
    assert read_log(tmp_path / "a.mcap").calibration == sequence.calibration
    given = read_log(tmp_path / "a.mcap", calibration=Calibration(), name="mine")
    assert given.calibration == Calibration()
    assert given.name == "mine"
    assert given.notes["log.calibration"] == "given by the caller"


@pytest.mark.parametrize(
    ("record", "error", "message"),
    [
        ({"calibration": "{"}, LogError, "calibration is not JSON"),
        ({"calibration": '{"imu": {"nonsense": 1}}'}, CalibrationError, "imu.nonsense"),
        ({"notes": "[]"}, LogError, "notes must be a JSON object"),
    ],
)
def test_a_broken_metadata_record_is_named(
    make_sequence: Any, tmp_path: Path, record: dict[str, str], error: type[Exception], message: str
) -> None:
    sequence = make_sequence()
    messages = [imu_messages("/imu", sequence.imu), dvl_messages("/dvl", sequence.dvl)]
    write_recording(tmp_path / "a.mcap", messages, {"sonar_graph": record})
    with pytest.raises(error, match=message):
        read_log(tmp_path / "a.mcap")


def test_a_definition_without_a_needed_field_is_named(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    lacking = definition("sensor_msgs/msg/Imu").replace("geometry_msgs/Vector3 angular_velocity\n", "")
    imu, dvl = bench.basics()
    for message in imu[2]:
        message.pop("angular_velocity")
    monkeypatch.setitem(
        bench.write.__globals__, "definition", lambda n: lacking if n.endswith("Imu") else definition(n)
    )
    with pytest.raises(LogError, match=r"nothing for imu: /imu has no field angular_velocity\.x"):
        read_log(bench.write(imu, dvl))


def test_a_file_cut_at_its_end_is_read_with_a_note(make_sequence: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    sequence = make_sequence(samples=20_000)
    write_log(path, sequence)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    found = read_log(path)
    assert 0 < len(found.imu) < len(sequence.imu)
    assert "cut off" in found.notes["log.ending"]


def damaged(path: Path, sequence: Any) -> None:
    """A log with a bit of its second chunk flipped."""
    write_log(path, sequence)
    chunk = chunk_indexes(path)[1]
    flip(path, chunk.chunk_start_offset + chunk.chunk_length // 2)


def test_a_hole_is_refused_unless_salvage_is_asked_for(make_sequence: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    sequence = make_sequence(samples=20_000)
    damaged(path, sequence)
    with pytest.raises(
        LogError, match=r"is damaged: bytes \d+ to \d+: chunk 2 is lost.*lost: .* of /imu/data.*--salvage"
    ):
        read_log(path)
    found = read_log(path, salvage=True)
    is_there = np.isin(sequence.imu.stamps_ns, found.imu.stamps_ns)
    assert 0 < np.count_nonzero(~is_there) < len(sequence.imu)
    np.testing.assert_array_equal(found.imu.angular_velocity, sequence.imu.angular_velocity[is_there])
    assert f"{np.count_nonzero(~is_there)} of /imu/data" in found.notes["log.damage"]


def test_a_window_is_the_same_part_of_every_block(make_sequence: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    sequence = make_sequence(samples=20_000)
    write_log(path, sequence)
    first_ns = int(min(sequence.imu.stamps_ns[0], sequence.dvl.stamps_ns[0]))
    start_ns, end_ns = first_ns + 2 * 10**9, first_ns + 4 * 10**9
    found = read_log(path, window=TimeWindow(Instant.parse("2"), Instant.parse("4")))
    for name in ("imu", "dvl", "depth", "truth"):
        whole, part = getattr(sequence, name), getattr(found, name)
        is_inside = (whole.stamps_ns >= start_ns) & (whole.stamps_ns < end_ns)
        np.testing.assert_array_equal(part.stamps_ns, whole.stamps_ns[is_inside])
    assert found.calibration == sequence.calibration
    assert found.notes["log.part"] == "2.000 s to 4.000 s of the recording"


def test_a_start_pose_of_the_logs_beginning_is_said_to_be_of_another_instant(
    make_sequence: Any, tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    write_log(path, make_sequence(samples=20_000))
    later = TimeWindow(Instant.parse("2"))
    said = read_log(path, window=later).notes["log.start"]
    assert re.search(r"of its beginning, 2\.000 s before .*\[start\] position_m and rpy_rad .*--calibration", said)
    given = PartialCalibration.parse({"start": {"position_m": [1.0, 0.0, 0.0]}}, "x.toml")
    other = PartialCalibration.parse({"gravity_m_s2": 9.8}, "x.toml")
    assert "log.start" in read_log(path, window=later, calibration=other).notes
    for harmless in (
        {"window": later, "calibration": given},
        {"window": later, "calibration": Calibration()},
        {"window": TimeWindow(end=Instant.parse("2"))},
        {"window": TimeWindow(Instant.parse("0"))},
        {},
    ):
        assert "log.start" not in read_log(path, **harmless).notes


def test_stamps_that_run_backwards_or_beside_the_log_are_in_the_notes(bench: Any) -> None:
    _, dvl = bench.basics()
    late = [bench.t0_ns + i * STEP_NS - 60 * 10**9 for i in (0, 2, 1, 3)] + [bench.t0_ns]
    sequence = read_log(bench.write(("/imu", "imu", [bench.imu(s) for s in late]), dvl))
    assert "imu: once backwards, by 0.1 s" in sequence.notes["log.stamps"]
    assert "imu: stamped 60 s before recording" in sequence.notes["log.stamps"]
    assert "dvl" not in sequence.notes["log.stamps"]


def test_sensors_of_two_clocks_are_refused(bench: Any) -> None:
    _, dvl = bench.basics()
    late = [bench.t0_ns + i * STEP_NS - 3600 * 10**9 for i in range(4)]
    path = bench.write(("/imu", "imu", [bench.imu(s) for s in late]), dvl)
    with pytest.raises(LogError, match=rf"{path.name}: IMU from .* DVL from .*: no common time"):
        read_log(path)


def test_gaps_of_this_reading_count_and_not_those_of_an_earlier_one(make_sequence: Any, tmp_path: Path) -> None:
    whole = replace(make_sequence(), notes={"log.gaps": "dvl: no velocity for a day", "log.warnings": "of yesterday"})
    write_log(tmp_path / "a.mcap", whole)
    notes = read_log(tmp_path / "a.mcap").notes
    assert "a day" not in notes.get("log.gaps", "")
    assert "yesterday" not in notes.get("log.warnings", "")
    rows = whole.dvl.stamps_ns
    sparse = whole.dvl.rows((rows == rows[0]) | (rows == rows[-1]))
    few = Calibration.model_validate(whole.calibration.model_dump() | {"dvl": {"gap_s": 1e-3}})
    write_log(tmp_path / "b.mcap", replace(whole, dvl=sparse, calibration=few))
    assert "dvl: no velocity 0.000 to" in read_log(tmp_path / "b.mcap").notes["log.gaps"]


def test_a_flipped_bit_in_the_calibration_is_never_read_as_a_number(make_sequence: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_log(path, make_sequence())
    flip(path, path.read_bytes().index(b"gravity_m_s2") + len("gravity_m_s2") + 2, 1)
    with pytest.raises(LogError, match="a metadata record is lost: its CRC does not fit"):
        read_log(path)


@pytest.mark.recording
def test_a_third_party_log_without_the_sensors_lists_its_topics(recordings: Path) -> None:
    with pytest.raises(
        MissingTopicError, match=r"nothing for imu.*/amcl_pose \(.*/odom \(nav_msgs.*/tf \(.*/tf_static"
    ):
        read_log(recordings / "bags" / "nav2_turtlebot.mcap")


@pytest.mark.recording
def test_a_ros_1_bag_is_sent_to_convert(recordings: Path) -> None:
    with pytest.raises(LogError, match=r"a ROS 1 bag; `sonar-graph convert rosbag"):
        read_log(recordings / "bags" / "husky.bag")
