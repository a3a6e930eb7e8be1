"""Sources of a batch's sequences: logs, data sets, simulators.

A source is a kind and its options. With a seed it gives the same sequence on every machine that has the files; its
`fingerprint` changes when a file does.
"""

import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import gtsam
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.diagnosis import compared, trusted
from sonar_graph.files import regular
from sonar_graph.logs import PartialCalibration, read_log
from sonar_graph.logs.adapters import as_log_config
from sonar_graph.logs.convert import (
    read_akit,
    read_dlr,
    read_mrclam,
    read_stpere,
    read_victoria_park,
    with_truth,
)
from sonar_graph.logs.mcap import LogFile, TimeWindow, log_parts
from sonar_graph.map_file import in_map, read_map
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import (
    BasinOptions,
    LandmarkOptions,
    MissionOptions,
    add_landmarks,
    cruise_speed,
    simulate_basin,
    simulate_mission,
)

Stamp = tuple[int, int, int, int]
_BLOCK_BYTES = 1 << 20


class LogOptions(Section):
    """An MCAP log with landmark detections, with the reading options of `sonar-graph compare`."""

    log: str
    calibration: str | None = None
    """TOML or JSON file whose fields replace the log's own."""
    log_config: str | None = None
    map: str | None = None
    """Map of known landmarks, TOML or CSV."""
    truth: str | None = None
    """Table of true poses, ``t x y z qx qy qz qw``, in place of those of the log."""
    topics: dict[str, str] = Field(default_factory=dict)
    """By role."""
    start: str | None = None
    end: str | None = None
    salvage: bool = False


class MrclamOptions(Section):
    """One robot of a UTIAS data set."""

    folder: str
    robot: int = Field(ge=1, le=5)


class AkitOptions(Section):
    """One trajectory of the A-KIT data set."""

    folder: str
    trajectory: int = Field(ge=1)


class FolderOptions(Section):
    """A data set of one run: DLR, St. Pere."""

    folder: str


class VictoriaParkOptions(Section):
    """Victoria Park, from the file that GTSAM brings; no options."""


@dataclass(frozen=True)
class SourceKind:
    """A kind of source: its options and its reader."""

    options: type[Section]
    read: Callable[[Any], Sequence]
    check: Callable[[Any], object] = lambda _options: None
    """Quick check that raises for options which are valid one by one but not together."""


def _read_log(options: LogOptions) -> Sequence:
    config = as_log_config(options.log_config, "read_log")
    sequence = read_log(
        options.log,
        calibration=options.calibration,
        topics=options.topics,
        config=config,
        window=TimeWindow.parse(options.start, options.end),
        salvage=options.salvage,
    )
    if options.truth is not None:
        of_truth = config.table("truth") if config else {}
        sequence = with_truth(sequence, Path(options.truth), of_truth)
    return in_map(sequence, Path(options.map) if options.map else None)


def _check_log(options: LogOptions) -> None:
    """Raise for a file that is no log, and for options about it that cannot be understood."""
    for part in log_parts(Path(options.log)):
        LogFile(part).close()
    if options.calibration is not None:
        PartialCalibration.read(Path(options.calibration))
    as_log_config(options.log_config, "read_log")
    TimeWindow.parse(options.start, options.end)
    if options.map is not None:
        read_map(Path(options.map))


GENERATORS: dict[str, SourceKind] = {
    "basin": SourceKind(BasinOptions, simulate_basin, cruise_speed),
    "mission": SourceKind(MissionOptions, simulate_mission),
}
DATASETS: dict[str, SourceKind] = {
    "akit": SourceKind(
        AkitOptions, lambda options: read_akit(Path(options.folder), options.trajectory)
    ),
    "dlr": SourceKind(FolderOptions, lambda options: read_dlr(Path(options.folder))),
    "mrclam": SourceKind(
        MrclamOptions, lambda options: read_mrclam(Path(options.folder), options.robot)
    ),
    "stpere": SourceKind(
        FolderOptions, lambda options: read_stpere(Path(options.folder))
    ),
    "victoria-park": SourceKind(
        VictoriaParkOptions, lambda _options: read_victoria_park()
    ),
}
LOG = "mcap"
KINDS: dict[str, SourceKind] = {
    LOG: SourceKind(LogOptions, _read_log, _check_log),
    **DATASETS,
    **GENERATORS,
}
# options that name files: their content counts, not their path
FILES = ("log", "folder", "calibration", "log_config", "map", "truth")
# key in fingerprints for the file of a data set that has no option for one
FILE = "file"


def read_source(
    kind: str,
    options: dict[str, Any],
    seed: int | None,
    landmarks: dict[str, Any] | None = None,
) -> Sequence:
    """Read or simulate the sequence of a source, with simulated landmarks where there are options for them.

    A generator takes the seed, and so do landmarks. Raises `SonarGraphError` from the reader or simulator.
    """
    source = KINDS[kind]
    values = options | {"seed": seed} if kind in GENERATORS else options
    sequence = source.read(source.options.model_validate(values))
    if landmarks is None:
        return sequence
    return add_landmarks(sequence, LandmarkOptions(**(landmarks | {"seed": seed})))


def with_findings(kind: str, options: dict[str, Any], sequence: Sequence) -> Sequence:
    """The sequence of a log with notes of what its sensors contradict; simulators and data sets are known."""
    if kind != LOG:
        return trusted(sequence)
    return compared(sequence, as_log_config(options.get("log_config"), "read_log"))


def fingerprint(kind: str, options: dict[str, Any]) -> dict[str, Any]:
    """All options of a source, with hashes of the content in place of file names."""
    content = {
        name: hash_of(Path(options[name]))
        for name in FILES
        if options.get(name) is not None
    }
    if kind == "victoria-park":
        content[FILE] = hash_of(Path(gtsam.findExampleDataFile("victoria_park.txt")))  # type: ignore[no-untyped-call]
    return {"kind": kind, **options, **content}


def hash_of(path: Path, is_ignored: Callable[[str], bool] = lambda _name: False) -> str:
    """SHA-256 of a file, or of all names and files below a folder; read again only if stamps changed."""
    # of a file the content counts, and not the name
    if not path.is_dir():
        return content_hash(((".", str(path), stamp_of(path)),))
    named = [
        (
            os.path.relpath(entry.path, path).replace(os.sep, "/"),
            entry.path,
            stamp_of(entry),
        )
        for entry in files_below(str(path), is_ignored)
    ]
    return content_hash(tuple(sorted(named)))


@lru_cache
def content_hash(files: tuple[tuple[str, str, Stamp], ...]) -> str:
    """SHA-256 over names and contents of files, given by name, path and stamp.

    The lengths of both are hashed too, so that no two sets of files give the same bytes.
    """
    digest = hashlib.sha256()
    for name, path, _ in files:
        file = Path(path)
        digest.update(f"{len(name.encode())} {file.stat().st_size} {name}".encode())
        with regular(file).open("rb") as content:
            while block := content.read(_BLOCK_BYTES):
                digest.update(block)
    return digest.hexdigest()


def stamp_of(path: Path | os.DirEntry[str]) -> Stamp:
    """Inode, size, and times of the last change of content and of status (ns); the latter cannot be set back."""
    state = path.stat()
    return state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns


def files_below(
    folder: str,
    is_ignored: Callable[[str], bool],
    around: tuple[str, ...] = (),
) -> Iterator[os.DirEntry[str]]:
    """Files below a folder, links followed as readers and imports do; a link to a folder around it is ignored.

    Directory entries, not paths, because they are quick and runs wait for this list.
    """
    here = os.path.realpath(folder)
    if here in around:
        return
    with os.scandir(folder) as entries:
        for entry in entries:
            if is_ignored(entry.name):
                continue
            if entry.is_dir():
                yield from files_below(entry.path, is_ignored, (*around, here))
            elif entry.is_file():
                yield entry
