"""Reading ends, in time and memory that a log's size allows, whatever a file claims."""

import contextlib
import os
import re
import time
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, DataEnd, Header

from sonar_graph.errors import CalibrationError, LogError
from sonar_graph.files import text_of
from sonar_graph.files.inputs import LARGEST_TEXT
from sonar_graph.logs import PartialCalibration, inspect_log, read_log
from sonar_graph.logs.cdr import parse_definition
from sonar_graph.logs.mcap import chunks, scanning, write_recording
from sonar_graph.logs.mcap.foreign_files import MCAP_MAGIC
from sonar_graph.logs.writing import imu_messages

from .conftest import scan_all, tree

LIMIT = 1 << 16
PACK: dict[str, Callable[[bytes], bytes]] = {
    "zstd": zstandard.compress,
    "lz4": lz4.frame.compress,
    "": bytes,
}


def log_with_chunk(path: Path, content: bytes, compression: str, size: int) -> Path:
    packed = PACK[compression](content)
    builder = RecordBuilder()
    Header(profile="", library="").write(builder)
    Chunk(compression, packed, 1, 1, 0, size).write(builder)
    DataEnd(0).write(builder)
    path.write_bytes(MCAP_MAGIC + builder.end())
    return path


@pytest.mark.parametrize("compression", PACK)
@pytest.mark.parametrize(
    ("size", "stated", "reason"),
    [
        (LIMIT, LIMIT, "unread"),  # zeros are no records
        (LIMIT + 1, LIMIT + 1, rf"{LIMIT}.*mcap compress"),
        (LIMIT + 1, 9, "is lost"),
        (9, 2**62, "is lost"),
    ],
)
def test_a_chunk_beyond_the_limit_is_lost_before_it_is_unpacked(
    tmp_path, monkeypatch, compression, size, stated, reason
):
    monkeypatch.setattr(chunks, "LARGEST_BYTES", LIMIT)
    path = log_with_chunk(tmp_path / "log.mcap", bytes(size), compression, stated)
    (loss,) = scan_all(path).damage.losses
    assert re.search(reason, loss.reason)


def test_messages_far_larger_than_their_file_are_refused(
    tmp_path, monkeypatch, make_sequence
):
    path = tmp_path / "log.mcap"
    write_recording(path, [imu_messages("/imu", make_sequence().imu)], {})
    size = path.stat().st_size
    monkeypatch.setattr(scanning, "LARGEST_BYTES", 10)
    scan_all(path)
    monkeypatch.setattr(scanning, "LARGEST_RATIO", 1 / size)
    message = rf"its {size} bytes unpack to more than .* --start and --end"
    with pytest.raises(LogError, match=message):
        scan_all(path)


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_a_pipe_or_device_is_refused_wherever_a_file_is_read(tmp_path, kind):
    path = tmp_path / "in.mcap"
    os.mkfifo(path) if kind == "pipe" else path.symlink_to("/dev/zero")
    for read in (read_log, inspect_log, PartialCalibration.read):
        message = r"in\.mcap:? cannot be read: it is a pipe, a socket or a device"
        with pytest.raises((LogError, CalibrationError), match=message):
            read(path)


def test_a_text_that_is_too_large_is_refused_unread(tmp_path):
    path = tmp_path / "a.toml"
    path.touch()
    os.truncate(path, LARGEST_TEXT + 1)  # without a block on the disk
    with pytest.raises(OSError, match=f"it has {LARGEST_TEXT + 1} bytes, and at most"):
        text_of(path)


ROTATION = "a quaternion of length "
TRANSLATION = "numbers that are not finite"


@pytest.mark.parametrize(
    ("x_m", "w", "message"),
    [
        (0.0, np.nan, TRANSLATION),
        (0.0, 0.0, ROTATION + "0"),
        (1e300, 1.0, r"dvl_link: is .* m from base_link"),
        (350.0, 1.0, r"dvl_link: is .* m from base_link: millimetres"),
    ],
)
def test_a_mounting_that_cannot_be_is_named_unless_the_user_states_it(
    bench, x_m, w, message
):
    path = bench.write(*bench.basics(), tree("dvl_link", (x_m, 0, 0), w=w))
    pattern = rf"log\.mcap: dvl: /tf_static: .*{message}.*--calibration"
    with pytest.raises(LogError, match=pattern):
        read_log(path)
    assert any("--calibration" in text for text in inspect_log(path).unusable)
    stated = PartialCalibration.parse({"dvl": {"mounting": {}}}, "vehicle.toml")
    mounting = read_log(path, calibration=stated).calibration.dvl.mounting
    assert mounting.translation_m == (0.0, 0.0, 0.0)


SLOW: dict[str, str] = {
    "line feeds": "float64 a\n" + "=" * 80 + "\n" * 300_000 + "x",
    "separators": ("=" * 80 + "\n") * 12_000,
    "spaces": "float64 a" + " " * 900_000,
    "fields": "\n".join(f"float64 f{i}" for i in range(60_000)),
    "an array": f"float64[{'9' * 5000}] a",
}


@pytest.mark.parametrize("text", SLOW.values(), ids=SLOW)
def test_definitions_are_parsed_in_a_time_that_grows_with_their_length(
    text,
):
    began = time.process_time()
    for kind in ("p/msg/A", "p/msg/B"):
        for _ in range(5):
            with contextlib.suppress(LogError):
                parse_definition(kind, text)
    assert time.process_time() - began < 2.0
