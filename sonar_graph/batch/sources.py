"""Where the sequences of a batch come from: logs, data sets, simulators.

A source is a kind and its options; with a seed it gives the same sequence on every machine that has the files.

Whether a file is still the one that was read, told without reading it again.
"""

from __future__ import annotations

import hashlib
import os
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import gtsam
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.errors import CalibrationError
from sonar_graph.logs import PartialCalibration, read_log
from sonar_graph.logs.adapters import LogConfig, read_log_config
from sonar_graph.logs.convert import read_akit, read_mrclam, read_victoria_park
from sonar_graph.logs.mcap import Instant, LogFile, TimeWindow
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, MissionOptions, cruise_speed, simulate_basin, simulate_mission

Stamp = tuple[int, int, int, int]


def stamp_of(path: Path | os.DirEntry[str]) -> Stamp:
    """Inode, size, and the times in ns of the last change of content and of status; the last one cannot be set back."""
    state = path.stat()
    return state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns


def files_below(
    folder: str, is_passed_over: Callable[[str], bool] = lambda _name: False, around: tuple[str, ...] = ()
) -> Iterator[os.DirEntry[str]]:
    """Files in a folder and in those within, linked ones too, since readers and imports follow links.

    Entries rather than paths: runs wait for this list. A link to a folder around it is passed over.
    """
    here = os.path.realpath(folder)
    if here in around:
        return
    with os.scandir(folder) as entries:
        for entry in entries:
            if is_passed_over(entry.name):
                continue
            if entry.is_dir():
                yield from files_below(entry.path, is_passed_over, (*around, here))
            elif entry.is_file():
                yield entry


_BLOCK_BYTES = 1 << 20


class LogOptions(Section):
    """An MCAP log with landmark detections, and what is said about reading it, as `sonar-graph compare` takes it."""

    log: str
    calibration: str | None = None
    """A TOML file whose fields go before the log's own."""
    log_config: str | None = None
    topics: dict[str, str] = Field(default_factory=dict)
    """By role."""
    start: str | None = None
    end: str | None = None
    salvage: bool = False


class MrclamOptions(Section):
    """A robot of a UTIAS data set."""

    folder: str
    robot: int = Field(ge=1, le=5)


class AkitOptions(Section):
    """A trajectory of the A-KIT data set."""

    folder: str
    trajectory: int = Field(ge=1)


class VictoriaParkOptions(Section):
    """Victoria Park: nothing to choose, the file is the one that GTSAM brings."""


@dataclass(frozen=True)
class SourceKind:
    """A way to get a sequence."""

    options: type[Section]
    read: Callable[[Any], Sequence]
    """From options."""
    check: Callable[[Any], object] = lambda _options: None
    """Raises for options that fit one by one and not together, without any long work."""


def _read_log(options: LogOptions) -> Sequence:
    return read_log(
        Path(options.log),
        calibration=_read_calibration(options.calibration),
        topics=options.topics,
        config=_read_config(options.log_config),
        window=_window(options),
        salvage=options.salvage,
    )


def _check_log(options: LogOptions) -> None:
    """Raise for what is no log, and for what is said about it that cannot be understood."""
    with LogFile(Path(options.log)):
        _read_calibration(options.calibration)
        _read_config(options.log_config)
        _window(options)


def _window(options: LogOptions) -> TimeWindow:
    first, last = (None if text is None else Instant.parse(text) for text in (options.start, options.end))
    return TimeWindow(first, last)


def _read_config(name: str | None) -> LogConfig | None:
    return None if name is None else read_log_config(Path(name))


def _read_calibration(name: str | None) -> PartialCalibration | None:
    if name is None:
        return None
    path = Path(name)
    try:
        return PartialCalibration.parse(tomllib.loads(path.read_text(encoding="utf-8")), str(path))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: not TOML: {error}") from error


GENERATORS: dict[str, SourceKind] = {
    "basin": SourceKind(BasinOptions, simulate_basin, cruise_speed),
    "mission": SourceKind(MissionOptions, simulate_mission),
}
DATASETS: dict[str, SourceKind] = {
    "akit": SourceKind(AkitOptions, lambda options: read_akit(Path(options.folder), options.trajectory)),
    "mrclam": SourceKind(MrclamOptions, lambda options: read_mrclam(Path(options.folder), options.robot)),
    "victoria-park": SourceKind(VictoriaParkOptions, lambda _options: read_victoria_park()),
}
LOG = "mcap"
KINDS: dict[str, SourceKind] = {LOG: SourceKind(LogOptions, _read_log, _check_log), **DATASETS, **GENERATORS}
FILES = ("log", "folder", "calibration", "log_config")
"""Options that name files: of these the content counts, not the place."""
FILE = "file"
"""In fingerprints, the file of a data set that has no option to name one."""


def read_source(kind: str, options: dict[str, Any], seed: int | None) -> Sequence:
    """The sequence of a source; a generator takes the seed.

    Raises
    ------
    SonarGraphError
        As the reader or simulator.
    """
    source = KINDS[kind]
    values = options | {"seed": seed} if kind in GENERATORS else options
    return source.read(source.options.model_validate(values))


def fingerprint(kind: str, options: dict[str, Any]) -> dict[str, Any]:
    """What makes the sequence what it is: all options, and in place of files what is in them."""
    content = {name: _hash(Path(options[name])) for name in FILES if options.get(name) is not None}
    if kind == "victoria-park":
        content[FILE] = _hash(Path(gtsam.findExampleDataFile("victoria_park.txt")))  # type: ignore[no-untyped-call]
    return {"kind": kind, **options, **content}


def _hash(path: Path) -> str:
    """SHA-256 of a file, or of all names and files below a folder; read again only where stamps changed."""
    files = sorted(Path(entry.path) for entry in files_below(str(path))) if path.is_dir() else [path]
    return _digest(path, tuple((file, stamp_of(file)) for file in files))


@lru_cache
def _digest(path: Path, files: tuple[tuple[Path, Stamp], ...]) -> str:
    digest = hashlib.sha256()
    for file, _ in files:
        name = file.relative_to(path).as_posix().encode()
        digest.update(f"{len(name)} {file.stat().st_size} ".encode() + name)
        with file.open("rb") as content:
            while block := content.read(_BLOCK_BYTES):
                digest.update(block)
    return digest.hexdigest()
