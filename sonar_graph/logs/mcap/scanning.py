"""Reading of whole logs, a file or several: messages gathered by topic, or given piece by piece."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.logs.mcap.bag_folder import log_parts
from sonar_graph.logs.mcap.file_summary import (
    Instant,
    TimeWindow,
    first_time_ns,
    read_summary,
)
from sonar_graph.logs.mcap.reader import (
    IndexMismatchError,
    Passage,
    Progress,
    Recording,
)
from sonar_graph.logs.mcap.records import LARGEST_BYTES, LARGEST_RATIO, LogFile
from sonar_graph.logs.mcap.topic import Damage, Keep, Loss, Topic, settle

_PIECE_BYTES = 1 << 20


def scan(
    path: Path,
    keep: Callable[[str], Keep],
    window: TimeWindow | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Read a log in one pass: an MCAP file, or a folder of several (`log_parts`).

    Parameters
    ----------
    path
        The file or folder.
    keep
        Part of the messages to keep, by the name of their type.
    window
        Wanted time of recording; latched topics such as ``/tf_static`` are read whenever recorded.
    progress
        Called with the bytes done and the bytes in all.

    Raises
    ------
    LogError
        When the log does not exist, is not MCAP, or nothing in it was recorded in the window.
    """
    parts = log_parts(path)
    if parts == [path]:
        whole = _scan_file(path, keep, window, progress)
    else:
        whole = Recording(path)
        steps = _progress_of(parts, progress)
        for part, file in _opened(parts, whole.damage):
            window = window if whole.beginning_ns is not None else _fixed(window, file)
            _join(whole, _scan_file(part, keep, window, steps[part]))
        whole.topics = dict(sorted(whole.topics.items()))
    if whole.part and not any(
        len(topic) and not topic.is_latched for topic in whole.topics.values()
    ):
        raise LogError(f"{path}: nothing was recorded from {whole.part}")
    return whole


def _scan_file(
    path: Path,
    keep: Callable[[str], Keep],
    window: TimeWindow | None,
    progress: Progress | None,
) -> Recording:
    with LogFile(path) as file:
        passage = Passage(file, keep, window, progress=progress)
        try:
            _gather_all(passage, file)
        except IndexMismatchError:
            remarks = passage.damage.remarks
            passage = Passage(file, keep, window, may_skip=False, progress=progress)
            _gather_all(passage, file)
            passage.damage.remarks[:0] = remarks
    counts = passage.counts
    topics = {
        name: topic
        for name, topic in sorted(passage.topics.items())
        if len(topic)
        or (
            topic.keep is Keep.NONE and (counts or {}).get(name)
        )  # those of skipped chunks
    }
    # every message that can be read was counted
    is_complete = not passage.skipped and passage.part is None
    settle(passage.damage, topics, counts if is_complete else None)
    return Recording(
        path,
        topics,
        passage.metadata,
        passage.damage,
        min(
            (int(topic.log_times_ns.min()) for topic in topics.values() if topic.times),
            default=None,
        ),
        passage.chunks,
        passage.skipped,
        passage.part,
    )


def _opened(parts: list[Path], damage: Damage) -> Iterator[tuple[Path, LogFile]]:
    """Files of a log that can be opened; the others are losses, each with the name of the file."""
    failures = []
    for part in parts:
        try:
            file = LogFile(part)
        except LogError as error:
            reason = (
                "is missing"
                if not part.exists()
                else str(error).removeprefix(f"{part} ")
            )
            damage.extend(Damage([Loss(0, 0, reason)]), part.name)
            failures.append(str(error))
            continue
        with file:
            yield part, file
    if len(failures) == len(parts):
        raise LogError(failures[0])


def _fixed(window: TimeWindow | None, first: LogFile) -> TimeWindow | None:
    """The same window in absolute times, by the beginning of the first file of a log."""
    if window is None or not (window.start or window.end):
        return window
    beginning_ns = first_time_ns(first, read_summary(first)[0])
    ends = [
        None if end is None else Instant(absolute_ns=end.resolve(beginning_ns))
        for end in (window.start, window.end)
    ]
    return TimeWindow(*ends)


def _progress_of(
    parts: list[Path], progress: Progress | None
) -> dict[Path, Progress | None]:
    """Progress of each file as a part of the progress of all."""
    sizes = [part.stat().st_size if part.exists() else 0 for part in parts]
    before = np.concatenate([[0], np.cumsum(sizes)]).tolist()

    def of(first: int) -> Progress | None:
        return (
            None
            if progress is None
            else lambda done, _: progress(first + done, before[-1])
        )

    return {part: of(first) for part, first in zip(parts, before, strict=False)}


def _join(whole: Recording, part: Recording) -> None:
    """Add the next file of a log."""
    for name, topic in part.topics.items():
        if name in whole.topics:
            whole.topics[name].extend(topic)
        else:
            whole.topics[name] = topic
            topic.file = whole.path
    whole.metadata |= part.metadata
    whole.damage.extend(part.damage, part.path.name)
    starts = [ns for ns in (whole.beginning_ns, part.beginning_ns) if ns is not None]
    whole.beginning_ns = min(starts, default=None)
    whole.chunks += part.chunks
    whole.skipped_chunks += part.skipped_chunks
    whole.part = whole.part or part.part


def _gather_all(passage: Passage, file: LogFile) -> None:
    """Gather the wanted messages by topic; a LogError where they are more than a log of this size can honestly hold."""
    held, most = 0, max(LARGEST_BYTES, file.size * LARGEST_RATIO)
    for piece in passage:
        before = piece.topic.held_bytes
        piece.topic.gather(piece.data, *piece.found)
        held += piece.topic.held_bytes - before
        if held > most:
            raise LogError(
                f"{file.path}: its {file.size} bytes unpack to more than {most} bytes of messages, as no sensor's do; "
                "read a part with --start and --end, or leave the topic out with `mcap filter`"
            )


def stream(
    path: Path,
    keep: Callable[[str], Keep],
    window: TimeWindow | None = None,
    progress: Progress | None = None,
    *,
    salvage: bool = False,
) -> Iterator[Topic]:
    """Messages piece by piece: each item holds some messages of one topic, in the order of the file.

    A piece is given as soon as it has 1 MiB, so memory does not grow with the file. Parameters and errors are those of
    `scan`; without ``salvage`` also a file with holes is a LogError, at the end: what was given before is whole.
    """
    parts, damage, is_first = log_parts(path), Damage(), True
    steps = _progress_of(parts, progress) if parts != [path] else {path: progress}
    for part, file in (
        _opened(parts, damage) if parts != [path] else [(path, LogFile(path))]
    ):
        window, is_first = (_fixed(window, file) if is_first else window), False
        with file:
            passage = Passage(file, keep, window, progress=steps[part])
            held: dict[str, Topic] = {}
            for piece in passage:
                topic = held.get(piece.topic.name) or held.setdefault(
                    piece.topic.name, piece.topic.empty()
                )
                topic.gather(piece.data, *piece.found)
                if topic.held_bytes >= _PIECE_BYTES:
                    yield held.pop(topic.name)
            yield from (topic for topic in held.values() if topic.keep is not Keep.NONE)
        damage.extend(passage.damage, part.name if parts != [path] else "")
    if not salvage:
        Recording(path, damage=damage).require_sound()
