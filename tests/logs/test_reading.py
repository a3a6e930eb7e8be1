"""A log as a sequence: topics, stamps, rows left out, detections, damage, and the account of all that in the notes."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sonar_graph as sg
from sonar_graph.calibration import Calibration, Start
from sonar_graph.errors import (
    CalibrationError,
    LogError,
    MissingTopicError,
    SonarGraphError,
)
from sonar_graph.logs import PartialCalibration, inspect_log, read_log, write_log
from sonar_graph.logs.cdr import definition
from sonar_graph.logs.mcap import Instant, TimeWindow, writer

from .conftest import T0_NS, Bench, chunk_indexes, cut, flip, header

STEP_NS = 10**8


# --- topics ---------------------------------------------------------------------------------------------------------


# fmt: off
REFUSED_CHOICES: list[tuple[str, dict[str, str], type[Exception], str]] = [
    ("/imu", {}, MissingTopicError, r"nothing for dvl: no topic of a known type, such as marine_acoustic.*/imu \(sens"),
    ("/dvl", {}, MissingTopicError, r"nothing for imu: no topic of a known type.*/dvl \(marine"),
    ("/imu /dvl /other", {}, LogError, r"2 topics fit: /imu, /other; choose one: --topic imu=/imu \(topics=\{'imu'"),
    ("/imu /dvl", {"imu": "/nowhere"}, MissingTopicError, "/nowhere was chosen but is not in the log; the log has .*/"),
    ("/imu /dvl", {"gyro": "/imu"}, LogError, "no role gyro; topics are chosen for imu, dvl"),
]
# fmt: on


def test_the_chosen_topic_is_read_and_impossible_ones_are_refused(bench):
    fast = [bench.imu(T0_NS + i * STEP_NS, (0, 0, 7.0)) for i in range(5)]
    entries = [*bench.basics(), ("/other", "imu", fast)]
    for there, topics, error, message in REFUSED_CHOICES:
        path = bench.write(*(entry for entry in entries if entry[0] in there.split()))
        with pytest.raises(error, match=message):
            read_log(path, topics=topics)
    chosen = read_log(bench.write(*entries), topics={"imu": "/other"})
    assert chosen.imu.angular_velocity[0, 2] == 7.0
    assert "imu: /other" in chosen.notes["log.topics"]
    field = "geometry_msgs/Vector3 angular_velocity\n"
    lacking = definition("sensor_msgs/msg/Imu").replace(field, "")
    for message in fast:
        del message["angular_velocity"]
    message = r"nothing for imu: /imu has no field angular_velocity\.x"
    with pytest.raises(LogError, match=message):
        read_log(bench.write(("/imu", "imu", fast, lacking), entries[1]))


def test_paths_may_be_texts_and_a_window_two_times(bench, tmp_path):
    path = str(bench.write(*bench.basics()))
    setup = tmp_path / "setup.toml"
    setup.write_text("[imu]\ngyro_bias_sigma = 0.25")
    config = tmp_path / "mine.toml"
    config.write_text('[dvl]\nrotation = "frd"')
    given = {"calibration": str(setup), "config": str(config)}
    sequence = read_log(path, **given, window=(0.1, "0.3"))
    assert sequence.calibration.imu.gyro_bias_sigma == 0.25
    assert sequence.notes["log.adapters"] == 'dvl: rotation = "frd"'
    assert len(sequence.imu) == 2
    summary = inspect_log(path, config, window=(0, None))
    assert '\nrotation = "frd"' in summary.toml
    write_log(str(tmp_path / "copy.mcap"), sequence)
    message = r"absent\.toml: cannot be read: No such"
    with pytest.raises(CalibrationError, match=message):
        read_log(path, calibration=tmp_path / "absent.toml")


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda _: sg.read_log(3), r"read_log\(path\): expected a path, a str or Path, not int"),
        (lambda log: sg.write_log(log, str(log)), r"write_log\(path, sequence\): expected a Sequence, not str"),
        (lambda log: sg.read_log(log, log_config="a"), r"no argument log_config=; .* is config="),
        (lambda log: sg.read_log(log, window=3), r"window=\(START, END\)\): expected two times.*\(0, 10\), not 3"),
        (lambda log: sg.read_log(log, topics=["/imu"]), r"topics=\{'imu': .*\}\): expected topics by role, not list"),
        (lambda log: replace(sg.read_log(log), imu=None), r"Sequence\.imu: expected Imu, not None; every estimator"),
        (lambda log: replace(sg.read_log(log), calibration={}), r"Sequence\.calibration: expected a Calibration"),
        (lambda log: sg.read_log(log).instants("2"), "'2' Hz is no rate; expected a number"),
    ],
)  # fmt: skip
def test_a_wrong_argument_is_an_error_of_this_package_with_what_mends_it(
    bench, call, said
):
    with pytest.raises(SonarGraphError, match=said):
        call(bench.write(*bench.basics()))


def test_zero_noise_raises_a_doubt_where_the_log_has_none(make_sequence, tmp_path):
    path = tmp_path / "a.mcap"
    write_log(path, make_sequence())
    given = tmp_path / "a.toml"
    given.write_text("[dvl]\nvelocity_sigma_m_s = [0.0, 0.1, 0.1]")
    sequence = read_log(path, calibration=given)
    assert np.isnan(sequence.dvl.velocity_cov).any()
    doubt = "velocity_sigma_m_s of the calibration is 0"
    assert doubt in sequence.notes["log.warnings"]
    # of a file that is given, the summary names the fields
    source = inspect_log(path, calibration=given).calibration
    assert source == f"from {given}: dvl.velocity_sigma_m_s; else from the log"


# --- rows -----------------------------------------------------------------------------------------------------------


def test_stamps_are_the_headers_sorted_and_once(bench):
    _, dvl = bench.basics()
    rows = enumerate((0, 2, 1, 2, 3))
    imu = [bench.imu(T0_NS + k * STEP_NS, (float(i), 0, 0)) for i, k in rows]
    sequence = read_log(bench.write(("/imu", "imu", imu), dvl))
    assert sequence.imu.stamps_ns.tolist() == [T0_NS + i * STEP_NS for i in range(4)]
    assert sequence.imu.angular_velocity[:, 0].tolist() == [0, 2, 1, 4]
    assert sequence.notes["log.dropped"] == "imu: 1 with the stamp of another"
    # without a stamp: the time of recording
    unset = read_log(bench.write(("/imu", "imu", [bench.imu(0)] * 3), dvl))
    assert unset.imu.stamps_ns.tolist() == [T0_NS + i * STEP_NS for i in range(3)]


# --- detections -----------------------------------------------------------------------------------------------------


def detected(bench: Bench, *frames: dict[str, Any]) -> Path:
    return bench.write(*bench.basics(), ("/landmarks", "detections", list(frames)))


def test_detections_are_padded_and_keep_their_tracks(bench):
    """Also when messages of one log differ in having tracks."""
    frames = [
        bench.detections(T0_NS, [1.0, 2.0], [5, 6], (4, 3)),
        bench.detections(T0_NS + 1, [], []),
        bench.detections(T0_NS + 2, [3.0], [7, 8, 9]),
        bench.detections(T0_NS + 3, [np.nan, 4.0], [1, 2], (9, -1)),
    ]
    found = read_log(detected(bench, *frames)).detections
    assert (found.stamps_ns - T0_NS).tolist() == [0, 0, 2, 3]
    assert found.range_m.tolist() == [1, 2, 3, 4]
    ids = [[5, -1, -1], [6, -1, -1], [7, 8, 9], [2, -1, -1]]
    assert found.candidate_ids.tolist() == ids
    assert found.track.tolist() == [4, 3, -1, -1]
    # logs older than tracks
    text = definition("sonar_graph_msgs/msg/LandmarkDetections")
    old = "".join(x for x in text.splitlines(keepends=True) if "track" not in x)
    del frames[0]["track"]
    path = bench.write(*bench.basics(), ("/landmarks", "detections", frames[:1], old))
    assert read_log(path).detections.track.tolist() == [-1, -1]


def one_of(bench: Bench, **changed: Any) -> Path:
    """A log with a sound frame of one detection, and a changed one of two."""
    frames = [
        bench.detections(T0_NS, [3.0], [5]),
        bench.detections(T0_NS + STEP_NS, [1.0, 2.0], [5, 6]) | changed,
    ]
    return detected(bench, *frames)


# fmt: off
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "lists": ({"azimuth_rad": [0.1]}, "2 ranges, 1 azimuths, 8 covariance elements, 2 identities"),
    "tracks": ({"track": [1]}, "2 ranges and 1 tracks; expected as many, or none"),
    "2^56": ({"candidate_ids": [5, 2**56]}, r"an identity of 2\^56 or more; number"),
}
# fmt: on


@pytest.mark.parametrize(("changed", "message"), REFUSED.values(), ids=REFUSED)
def test_a_message_that_breaks_its_rules_is_named(bench, changed, message):
    path = one_of(bench, **changed)
    message = f"topic /landmarks: message 1 has {message}"
    with pytest.raises(LogError, match=message) as caught:
        read_log(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value) in inspect_log(path).unusable


COVARIANCE = "a covariance that is not positive definite"
# fmt: off
TOLD: dict[str, tuple[dict[str, Any], int, str]] = {
    "sound": ({}, 3, ""),
    "largest identity": ({"candidate_ids": [5, 2**56 - 1]}, 3, ""),
    "unknown covariance": ({"covariance": [np.nan] * 8, "track": [3, 4]}, 3, "2 of 3 rows say no covariance"),
    "degrees": ({"azimuth_rad": [-40.0, 1.0]}, 3, "1 of 3 rows have an azimuth beyond a full turn in rad (up to 40)"),
    "97 %": ({"id_probability": [97.0, 0.5]}, 2,
             "1 with probabilities that are not between 0 and 1 or more than 1 in sum"),
    "range": ({"range_m": [-1.0, 2.0]}, 3, "1 of 3 rows have a range that is not above 0 and at most 100 km"),
    "no covariance": ({"covariance": [0.0] * 4 + [0.01, 0, 0, 0.02]}, 3, f"1 of 3 rows have {COVARIANCE}"),
    "singular": ({"covariance": [1.0, 1, 1, 1] * 2}, 3, f"2 of 3 rows have {COVARIANCE}"),
    "track": ({"track": [7, 7]}, 3, "1 of 3 rows have the track number of another row of their frame, in 1 frames"),
    "early": ({"header": header(T0_NS - 5 * 10**9)}, 3, "2 of 3 rows have a stamp before the first odometry"),
    "late": ({"header": header(T0_NS + 60 * 10**9)}, 3, "2 of 3 rows have a stamp after the last odometry"),
}
# fmt: on


@pytest.mark.parametrize(("changed", "rows", "account"), TOLD.values(), ids=TOLD)
def test_unusable_detections_are_reported_and_impossible_ones_left_out(
    bench, changed, rows, account
):
    path = one_of(bench, **changed)
    sequence = read_log(path)
    summary = inspect_log(path)
    assert len(sequence.detections) == rows
    told = [*summary.warnings, *summary.left_out]
    told = [text for text in told if text.startswith("detections")]
    assert len(told) == bool(account)
    notes = str(sequence.notes)
    assert all(text.startswith(f"detections: {account}") for text in told)
    assert all(text in notes for text in told)


# --- damage and windows ---------------------------------------------------------------------------------------------


@pytest.fixture
def long(make_sequence: Any, tmp_path: Path, monkeypatch: Any) -> tuple[Any, Path]:
    """A sequence of several chunks with a stated start, and its log."""
    monkeypatch.setattr(writer, "_CHUNK_BYTES", 1 << 16)
    sequence = make_sequence(samples=1000)
    start = {"start": Start(position_m=(0.0, 0.0, 0.0))}
    stated = sequence.calibration.model_copy(update=start)
    sequence = replace(sequence, calibration=stated)
    write_log(tmp_path / "a.mcap", sequence)
    return sequence, tmp_path / "a.mcap"


def test_a_truncated_log_is_read_and_a_hole_needs_salvage(long, caplog):
    sequence, path = long
    content = path.read_bytes()
    cut(path, len(content) // 2)
    found = read_log(path)
    assert 0 < len(found.imu) < len(sequence.imu)
    assert "cut off" in found.notes["log.ending"]
    assert "cut off" in caplog.text
    assert "cut off" in inspect_log(path).damage[0]
    path.write_bytes(content)
    chunk = chunk_indexes(path)[1]
    flip(path, chunk.chunk_start_offset + chunk.chunk_length // 2)
    message = r"is damaged: bytes \d+ to \d+: chunk 2 is lost.*lost: .* of /imu/data.*--salvage"
    with pytest.raises(LogError, match=message):
        read_log(path)
    assert "chunk 2 is lost" in inspect_log(path).damage[0]
    found = read_log(path, salvage=True)
    is_there = np.isin(sequence.imu.stamps_ns, found.imu.stamps_ns)
    lost = np.count_nonzero(~is_there)
    assert 0 < lost < len(sequence.imu)
    rates = sequence.imu.angular_velocity[is_there]
    np.testing.assert_array_equal(found.imu.angular_velocity, rates)
    assert f"{lost} of /imu/data" in found.notes["log.damage"]
    path.write_bytes(content)
    flip(path, content.index(b"gravity_m_s2") + len("gravity_m_s2") + 2, 1)
    with pytest.raises(LogError, match="a metadata record is lost: its CRC does not"):
        read_log(path)


LATER = TimeWindow(Instant.parse("2"))


@pytest.mark.parametrize(
    ("stated", "window", "is_told"),
    [
        (None, LATER, True),
        ({"gravity_m_s2": 9.8}, LATER, True),
        ({"start": {"position_m": [1.0, 0.0, 0.0]}}, LATER, False),
        (Calibration(), LATER, False),
        (None, TimeWindow(end=Instant.parse("2")), False),
        (None, TimeWindow(Instant.parse("0")), False),
    ],
)
def test_a_start_pose_of_another_instant_is_noted(long, stated, window, is_told):
    is_part = isinstance(stated, dict)
    given = PartialCalibration.parse(stated, "x.toml") if is_part else stated
    notes = read_log(long[1], window=window, calibration=given).notes
    assert ("log.start_pose" in notes) == is_told
    pattern = r"of its beginning, 2\.000 s before .*\[start\] position_m and rpy_rad .*--calibration"
    assert not is_told or re.search(pattern, notes["log.start_pose"])
