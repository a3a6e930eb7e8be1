"""A folder of MCAP files, as ``ros2 bag record`` splits a recording, is the log that one file would be."""

import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from sonar_graph.errors import LogError
from sonar_graph.live import recorded_messages
from sonar_graph.logs import inspect_log, read_log, write_log
from sonar_graph.logs.mcap import Keep, Recording, TimeWindow, log_parts, stream
from sonar_graph.testing import small_world

from .conftest import Stored, copy, cut, entries, recorded, scan_all, writing

METADATA = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: {storage}
  relative_file_paths:
{names}
  duration:
    nanoseconds: 20000000000
"""
NAMES = [f"dive_{part}.mcap" for part in range(12)]
"""More than ten, so that the order of names is none of times."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "dive.mcap"
    write_log(path, small_world())
    return path


@pytest.fixture
def folder(whole, tmp_path) -> Path:
    """The same log, split by time."""
    folder = tmp_path / "dive"
    folder.mkdir()
    messages = recorded(whole)
    with whole.open("rb") as log:
        records = {m.name: m.metadata for m in make_reader(log).iter_metadata()}
    edges = np.linspace(0, len(messages), len(NAMES) + 1).astype(int)
    for name, (first, last) in zip(NAMES, pairwise(edges), strict=True):
        crcs = {"chunk_size": 2000, "enable_data_crcs": True}
        with writing(folder / name, **crcs) as writer:
            copy(messages[first:last], writer)
            if first == 0:
                writer.add_metadata("sonar_graph", records["sonar_graph"])
    return folder


def with_metadata(
    folder: Path, names: list[str] = NAMES, storage: str = "mcap"
) -> Path:
    listed = "\n".join(f"    - {name}" for name in names)
    text = METADATA.format(storage=storage, names=listed)
    (folder / "metadata.yaml").write_text(text)
    return folder


def contents(path: Path) -> dict[str, list[Stored]]:
    """Times and payloads by topic, in the order of the log."""
    return {name: entries(topic) for name, topic in scan_all(path).topics.items()}


@pytest.mark.parametrize("is_listed", [True, False])
def test_a_folder_is_the_single_file(whole, folder, is_listed):
    if is_listed:
        with_metadata(folder)
    assert [part.name for part in log_parts(folder)] == NAMES
    assert contents(folder) == contents(whole)
    one = read_log(whole)
    several = read_log(folder)
    for name in ("calibration", "name", "notes"):
        assert getattr(several, name) == getattr(one, name)
    found, expected = inspect_log(folder), inspect_log(whole)
    for part in ("topics", "damage", "warnings"):
        assert getattr(found, part) == getattr(expected, part)
    assert list(recorded_messages(folder)) == list(recorded_messages(whole))


def test_a_part_of_the_time_is_counted_from_the_first_file(whole, folder):
    for window in (TimeWindow.parse("5", "12.5"), TimeWindow.parse("14", None)):
        one, several = (scan_all(path, window) for path in (whole, folder))
        assert several.part == one.part or "of the recording" in several.part
        assert counts(several) == counts(one)
    with pytest.raises(LogError, match=r"dive: nothing was recorded from"):
        scan_all(folder, TimeWindow.parse("50", None))


def counts(recording: Recording) -> dict[str, int]:
    return {name: len(topic) for name, topic in recording.topics.items()}


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (Path.unlink, "is missing"),
        (lambda path: cut(path, 2000), r"bytes \d+ to \d+: the file is cut off"),
    ],
)
def test_a_missing_part_is_an_error_unless_salvaged(folder, damage, said):
    with_metadata(folder)
    damage(folder / NAMES[4])
    said = rf"dive is damaged: dive_4\.mcap: {said}"
    with pytest.raises(LogError, match=said):
        read_log(folder)
    with pytest.raises(LogError, match=said):
        list(stream(folder, lambda _: Keep.ALL))
    assert any(NAMES[4] in line for line in inspect_log(folder).damage)
    found = read_log(folder, salvage=True)
    assert NAMES[4] in found.notes["log.damage"]
    assert 850 < len(found.imu) < 1001
    assert found.imu.stamps_ns[-1] == small_world().imu.stamps_ns[-1]


def test_a_last_part_that_is_cut_off_is_read_as_far_as_it_goes(folder):
    cut(folder / NAMES[-1], (folder / NAMES[-1]).stat().st_size // 3)
    found = read_log(folder)
    assert re.search(r"cut off.* spans 1[89]\.\d* s", found.notes["log.ending"])
    assert "log.damage" not in found.notes


def test_other_folders_are_refused_with_what_to_do(folder, tmp_path):
    def refused(path: Path, message: str) -> None:
        with pytest.raises(LogError, match=message):
            read_log(path)

    with_metadata(folder, storage="sqlite3")
    refused(
        folder, r"dive: is a ROS 2 bag of the sqlite3 kind; `sonar-graph convert rosbag"
    )
    with_metadata(folder, ["dive_0.mcap.zstd"])
    refused(folder, r"dive_0\.mcap\.zstd is no \.mcap file; unpack")
    (folder / "metadata.yaml").write_text("nothing: here\n")
    refused(
        folder,
        r"metadata\.yaml: names no files under relative_file_paths; `ros2 bag reindex`",
    )
    (folder / "metadata.yaml").unlink()
    (folder / "other.mcap").write_bytes((folder / NAMES[3]).read_bytes())
    refused(
        folder,
        r"dive: (other|dive_3)\.mcap begins before (dive_3|other)\.mcap ends: these are two",
    )
    empty = tmp_path / "empty"
    empty.mkdir()
    refused(empty, r"empty: is a folder without metadata\.yaml and \.mcap files")
    (empty / "imu.csv").write_text("t,x\n")
    refused(empty, r"`sonar-graph convert csv .*empty --toml")
