"""The MCAP container: messages gathered by topic, and what is damaged.

The file is walked in its own order. Each chunk from which anything is taken is unpacked whole and its CRC checked;
where its messages lie says the message index, once it is found to agree with the chunk in every record, or else a walk
through the records. A chunk is passed over, unread and unchecked, only when a summary that agrees with the chunk's head
says that it holds no wanted topic, or nothing of the wanted time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from sonar_graph.errors import LogError
from sonar_graph.logs.mcap.file_pass import IndexLiesError, Passage, Progress
from sonar_graph.logs.mcap.file_summary import TimeWindow
from sonar_graph.logs.mcap.records import LogFile
from sonar_graph.logs.mcap.topic import STAMP_BYTES, Damage, Keep, Topic, settle

__all__ = ["STAMP_BYTES", "Keep", "Progress", "Recording", "Topic", "scan", "stream"]
_NS_PER_S = 1_000_000_000
_PIECE_BYTES = 1 << 20


@dataclass
class Recording:
    """What an MCAP file holds."""

    path: Path
    topics: dict[str, Topic] = field(default_factory=dict)
    """Those with messages, by name."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    """Metadata records by name; of two with one name the last."""
    damage: Damage = field(default_factory=Damage)
    """What is wrong with the file."""
    beginning_ns: int | None = None
    """The earliest log time that is known."""
    chunks: int = 0
    """In the file."""
    skipped_chunks: int = 0
    """Passed over, because they hold nothing that was asked for; their CRCs are not checked."""
    part: str | None = None
    """Which part of the time was asked for, if not all."""

    @property
    def ending(self) -> str | None:
        """What is wrong with the end of a file that was cut off, and how much is there; everything before is whole."""
        ending = self.damage.ending
        if ending is None:
            return None
        if ending.start_ns is None or self.beginning_ns is None:
            return f"{ending.reason}; no message is there"
        return f"{ending.reason}; what is there spans {(ending.start_ns - self.beginning_ns) / _NS_PER_S:.3f} s"

    @property
    def corrupt(self) -> list[str]:
        """What is lost, where, of which topics, and why."""
        return [loss.describe(self.beginning_ns) for loss in self.damage.losses]

    def notes(self) -> dict[str, str]:
        """What a reader of results must know about how the file was read, by subject."""
        skipped = (
            f"{self.skipped_chunks} of {self.chunks} chunks hold nothing that was asked for; not read, not checked"
        )
        texts = {
            "log.ending": self.ending or "",
            "log.damage": "; ".join(self.corrupt),
            "log.remarks": "; ".join(self.damage.remarks),
            "log.unprotected": ", ".join(self.damage.unprotected),
            "log.part": self.part or "",
            "log.skipped": skipped if self.skipped_chunks else "",
        }
        return {subject: text for subject, text in texts.items() if text}

    def require_sound(self) -> None:
        """Refuse a file that has holes.

        Raises
        ------
        LogError
            Naming the first hole, and what reads the rest.
        """
        if self.corrupt:
            more = f" (and {len(self.corrupt) - 1} more)" if len(self.corrupt) > 1 else ""
            advice = "copy it again, or read what is whole with --salvage"
            raise LogError(f"{self.path} is damaged: {self.corrupt[0]}{more}; {advice}")


def scan(
    path: Path, keep: Callable[[str], Keep], window: TimeWindow | None = None, progress: Progress | None = None
) -> Recording:
    """Go through an MCAP file once.

    Parameters
    ----------
    path
        The file.
    keep
        From a type's name, how much of such messages to keep.
    window
        Only what was recorded then, and latched topics such as ``/tf_static`` whenever recorded.
    progress
        Called with the bytes done and the bytes in all.

    Raises
    ------
    LogError
        When there is no such file, it is not MCAP, or nothing in it was recorded in the window.
    """
    with LogFile(path) as file:
        passage = Passage(file, keep, window, progress=progress)
        try:
            _gather(passage)
        except IndexLiesError:
            remarks = passage.damage.remarks
            passage = Passage(file, keep, window, may_skip=False, progress=progress)
            _gather(passage)
            passage.damage.remarks[:0] = remarks
        recording = _recording(path, passage)
    if recording.part and not any(len(topic) and not topic.is_latched for topic in recording.topics.values()):
        raise LogError(f"{path}: nothing was recorded from {recording.part}")
    return recording


def stream(
    path: Path,
    keep: Callable[[str], Keep],
    window: TimeWindow | None = None,
    progress: Progress | None = None,
    *,
    salvage: bool = False,
) -> Iterator[Topic]:
    """Messages piece by piece: each item holds some of one topic, in the order of the file.

    A piece is given as soon as it has 1 MiB, so that what is in memory at a time does not grow with the file.

    Parameters
    ----------
    path, keep, window, progress
        As of `scan`.
    salvage
        Holes are no error.

    Raises
    ------
    LogError
        As `scan`, and without ``salvage`` at the end when the file has holes: what was given until then is whole.
    """
    with LogFile(path) as file:
        passage = Passage(file, keep, window, progress=progress)
        held: dict[str, Topic] = {}
        for piece in passage:
            topic = held.get(piece.topic.name) or held.setdefault(piece.topic.name, piece.topic.empty())
            topic.gather(piece.data, *piece.found)
            if topic.held_bytes >= _PIECE_BYTES:
                yield held.pop(topic.name)
        yield from (topic for topic in held.values() if topic.keep is not Keep.NONE)
    if not salvage:
        Recording(path, damage=passage.damage).require_sound()


def _gather(passage: Passage) -> None:
    for piece in passage:
        piece.topic.gather(piece.data, *piece.found)


def _recording(path: Path, passage: Passage) -> Recording:
    counts = passage.counts or {}
    topics = {
        name: topic
        for name, topic in sorted(passage.topics.items())
        if len(topic) or (topic.keep is Keep.NONE and counts.get(name))  # those of chunks passed over
    }
    whole = passage.counts if passage.is_complete else None
    settle(passage.damage, topics, whole)
    first_ns = [int(topic.log_times_ns.min()) for topic in topics.values() if topic.times]
    return Recording(
        path,
        topics,
        passage.metadata,
        passage.damage,
        min(first_ns, default=None),
        passage.chunks,
        passage.skipped,
        passage.part,
    )
