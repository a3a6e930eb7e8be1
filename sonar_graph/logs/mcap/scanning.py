"""Reading of whole logs, a file or several: messages gathered by topic, or given piece by piece."""

from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path

from sonar_graph.errors import LogError
from sonar_graph.logs.mcap.bag_folder import log_parts
from sonar_graph.logs.mcap.log_file import LARGEST_BYTES, LARGEST_RATIO, LogFile
from sonar_graph.logs.mcap.reader import Passage, Progress, Recording, first_time_ns
from sonar_graph.logs.mcap.time_window import TimeWindow, WindowLimits
from sonar_graph.logs.mcap.topic import (
    Damage,
    Keep,
    Keeping,
    Loss,
    Topic,
    keeping,
    settle,
)

_PIECE_BYTES = 1 << 20
_NUMBERS_ALONE = keeping([])


def scan(
    path: Path,
    keep: Keeping = _NUMBERS_ALONE,
    window: TimeWindow | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Read a log in one pass: an MCAP file, or a folder of several (`log_parts`).

    Parameters
    ----------
    path
        The file or folder.
    keep
        Part of the messages to keep, by the name of their type; without it only their number.
    window
        Wanted time of recording; latched topics such as ``/tf_static`` are read whenever recorded.
    progress
        Called with the bytes done and the bytes in all.

    Raises
    ------
    LogError
        When the log does not exist, is not MCAP, or nothing in it was recorded in the window.
    """
    whole = Recording(path)
    for file, passage in _passages(path, keep, window, progress, whole.damage):
        _join(whole, file, passage)
    whole.topics = dict(sorted(whole.topics.items()))
    is_empty = all(
        topic.is_latched or not len(topic) for topic in whole.topics.values()
    )
    if whole.part and is_empty:
        raise LogError(f"{path}: nothing was recorded from {whole.part}")
    return whole


def _passages(
    path: Path,
    keep: Keeping,
    window: TimeWindow | None,
    progress: Progress | None,
    damage: Damage,
) -> Iterator[tuple[LogFile, Passage]]:
    """A passage through each file of a log; its damage is added to that of the log when the next begins.

    A file that cannot be opened is a loss with the name of the file, and a LogError where there is no other.
    """
    parts = log_parts(path)
    sizes = [part.stat().st_size if part.exists() else 0 for part in parts]
    ends = list(accumulate(sizes))
    failures = []
    limits: WindowLimits | None = None
    for part, size, end in zip(parts, sizes, ends, strict=True):
        name = part.name if parts != [path] else ""
        try:
            file = LogFile(part)
        except LogError as error:
            failures.append(error)
            reason = str(error).removeprefix(f"{part} ")
            if not part.exists():
                reason = "is missing"
            damage.extend(Damage([Loss(0, 0, reason)]), name)
            continue
        with file:
            # a part of the time is counted from the beginning of the first file
            if limits is None and window is not None and (window.start or window.end):
                limits = window.resolve(first_time_ns(file))
            shown = _shifted(progress, end - size, ends[-1])
            passage = Passage(file, keep, limits, progress=shown)
            yield file, passage
        damage.extend(passage.damage, name)
    if len(failures) == len(parts):
        raise failures[0]


def _shifted(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Progress of a file as a part of the progress of all."""
    if progress is None:
        return None
    return lambda done, _: progress(before + done, total)


def _join(whole: Recording, file: LogFile, passage: Passage) -> None:
    """Read the next file of a log, and add what is in it."""
    _gather_all(passage, file)
    counts = passage.counts
    # where chunks are skipped or left out, not every message that can be read was counted
    is_complete = not passage.skipped and passage.limits is None
    settle(passage.damage, passage.described.by_name, counts if is_complete else None)
    for name, topic in passage.described.by_name.items():
        # topics that are only counted are listed, although their chunks were skipped
        is_in_skipped = topic.keep is Keep.NONE and bool((counts or {}).get(name))
        if not len(topic) and not is_in_skipped:
            continue
        if topic.times:
            first_ns = int(topic.log_times_ns.min())
            known = whole.beginning_ns
            whole.beginning_ns = first_ns if known is None else min(known, first_ns)
        if name in whole.topics:
            whole.topics[name].extend(topic)
        else:
            whole.topics[name] = topic
            topic.file = whole.path
    whole.metadata |= passage.metadata
    whole.chunks += passage.chunks
    whole.skipped_chunks += passage.skipped
    whole.part = passage.limits.text if passage.limits else None


def _gather_all(passage: Passage, file: LogFile) -> None:
    """Gather the wanted messages by topic; a LogError where they are more than a log of this size can honestly hold."""
    held = 0
    most = max(LARGEST_BYTES, file.size * LARGEST_RATIO)
    for piece in passage:
        before = piece.topic.held_bytes
        piece.topic.gather(piece.data, *piece.found)
        held += piece.topic.held_bytes - before
        # compression of zeros could fill all memory
        if held > most:
            raise LogError(
                f"{file.path}: its {file.size} bytes unpack to more than {most} bytes of messages, as no sensor's do; "
                "read a part with --start and --end, or leave the topic out with `mcap filter`"
            )


def stream(
    path: Path,
    keep: Keeping,
    window: TimeWindow | None = None,
    *,
    salvage: bool = False,
) -> Iterator[Topic]:
    """Messages piece by piece: each item holds some messages of one topic, in the order of the file.

    A piece is given as soon as it has 1 MiB, so memory does not grow with the file. Parameters and errors are those of
    `scan`; without ``salvage`` also a file with holes is a LogError, at the end: what was given before is whole.
    """
    damage = Damage()
    for _, passage in _passages(path, keep, window, None, damage):
        held: dict[str, Topic] = {}
        for piece in passage:
            if piece.topic.name not in held:
                held[piece.topic.name] = piece.topic.empty()
            topic = held[piece.topic.name]
            topic.gather(piece.data, *piece.found)
            # small pieces would be decoded one by one
            if topic.held_bytes >= _PIECE_BYTES:
                yield held.pop(topic.name)
        yield from (topic for topic in held.values() if topic.keep is not Keep.NONE)
    if not salvage:
        Recording(path, damage=damage).require_sound()
