"""Files of a log that is a folder: those that the ``metadata.yaml`` of ``ros2 bag record`` names, or all, in order."""

import re
from itertools import pairwise
from pathlib import Path

from sonar_graph.errors import LogError
from sonar_graph.files import text_of
from sonar_graph.logs.mcap.log_file import LogFile
from sonar_graph.logs.mcap.reader import first_time_ns

METADATA_FILE = "metadata.yaml"
SPLIT_S = 10.0
"""Longest time from the last message of a file to the first of the next, where a recorder splits one recording."""


def log_parts(path: Path) -> list[Path]:
    """Files of a log in the order of their times; of a log that is a file, that one.

    Files that ``metadata.yaml`` names are given also where they do not exist.

    Raises LogError where a folder holds no MCAP files, those of a bag in another form, or two recordings of one time.
    """
    if not path.is_dir():
        return [path]
    if (path / METADATA_FILE).is_file():
        return _named_parts(path)
    files = [
        file for file in path.iterdir() if file.suffix == ".mcap" and file.is_file()
    ]
    if not files:
        if any(path.glob("*.csv")):
            raise LogError(
                f"{path}: is a folder of CSV tables; `sonar-graph convert csv {path} --toml > dive.toml` begins their "
                f"description, `sonar-graph convert csv {path} --config dive.toml -o dive.mcap` makes a log of them"
            )
        raise LogError(
            f"{path}: is a folder without {METADATA_FILE} and .mcap files; give a log, or the folder of a bag that "
            "`ros2 bag record` wrote"
        )
    spans = sorted(
        ((*_span_ns(file), file) for file in files),
        key=lambda span: (span[0], span[2].name),
    )
    for (_, end_ns, before), (begin_ns, _, after) in pairwise(spans):
        # two vehicles' recordings in one folder would be mixed into one
        if end_ns is not None and begin_ns < end_ns:
            raise LogError(
                f"{path}: {after.name} begins before {before.name} ends: these are two recordings and not parts "
                "of one; give one of them"
            )
    return [file for _, _, file in spans]


def earlier_parts(path: Path) -> list[Path]:
    """Files before one of a recording that is split by time, the last first: ``dive_1.mcap`` before ``dive_2.mcap``.

    Each ends when the next begins, to within `SPLIT_S`; so files that only share a name are not taken for parts.
    """
    found: list[Path] = []
    number = re.fullmatch(r"(.*_)(\d+)", path.stem)
    if number is None or not path.is_file():
        return found
    begin_ns, _ = _span_ns(path)
    for part in range(int(number[2]) - 1, -1, -1):
        before = path.with_stem(f"{number[1]}{part}")
        if not before.is_file():
            break
        earlier_ns, end_ns = _span_ns(before)
        if end_ns is None or not 0 <= begin_ns - end_ns <= SPLIT_S * 1e9:
            break
        found.append(before)
        begin_ns = earlier_ns
    return found


def _named_parts(folder: Path) -> list[Path]:
    try:
        text = text_of(folder / METADATA_FILE)
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"{folder / METADATA_FILE}: cannot be read: {error}") from error
    storage = re.search(r"storage_identifier:\s*['\"]?(\w+)", text)
    if storage is not None and storage[1] != "mcap":
        raise LogError(
            f"{folder}: is a ROS 2 bag of the {storage[1]} kind; `sonar-graph convert rosbag {folder} -o "
            f"{folder.name}.mcap` makes a log of it"
        )
    # a YAML parser would be a dependency for one list, which has two forms
    _, _, listed = text.partition("relative_file_paths:")
    names = re.findall(
        r"[^\s'\"\[\],]+\.(?:mcap|db3)[^\s'\"\[\],]*", re.split(r"\n\s*\w+:", listed)[0]
    )
    if not names:
        raise LogError(
            f"{folder / METADATA_FILE}: names no files under relative_file_paths; `ros2 bag reindex` does"
        )
    if packed := next((name for name in names if not name.endswith(".mcap")), None):
        raise LogError(
            f"{folder}: {packed} is no .mcap file; unpack the files first (`zstd -d`), then `ros2 bag reindex`"
        )
    return [folder / name for name in names]


def _span_ns(file: Path) -> tuple[int, int | None]:
    """Times of the first message and, where the file's summary has it, of the last."""
    with LogFile(file) as log:
        statistics = log.summary.statistics if log.summary else None
        end_ns = int(statistics.message_end_time) if statistics else None
        return first_time_ns(log), end_ns
