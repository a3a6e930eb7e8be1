"""What is lost of a log: where, when, of which topics, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sonar_graph.logs.topic import Topic

_NS_PER_S = 1_000_000_000
_TOPICS_NAMED = 6


@dataclass
class Loss:
    """A stretch of a file that could not be read."""

    at: int
    """Offset of its first byte."""
    end: int
    """Offset after its last byte."""
    reason: str
    start_ns: int | None = None
    """Log time from which on messages may be missing; None: not known."""
    end_ns: int | None = None
    """Log time until which messages may be missing."""
    messages: dict[str, int] | None = None
    """How many, by topic; None: not known."""
    is_estimate: bool = False
    """The numbers follow from the topics' rates."""

    def describe(self, beginning_ns: int | None) -> str:
        """In words, with times in seconds after the log's beginning."""
        text = f"bytes {self.at} to {self.end}: {self.reason}"
        if self.start_ns is not None and self.end_ns is not None and beginning_ns is not None:
            start_s, end_s = ((ns - beginning_ns) / _NS_PER_S for ns in (self.start_ns, self.end_ns))
            text += f"; {start_s:.3f} s to {end_s:.3f} s of the log"
        if self.messages:
            about = "about " if self.is_estimate else ""
            parts = [f"{about}{count} of {name}" for name, count in sorted(self.messages.items())]
            more = f" and of {len(parts) - _TOPICS_NAMED} more topics" if len(parts) > _TOPICS_NAMED else ""
            text += f"; lost: {', '.join(parts[:_TOPICS_NAMED])}{more}"
        elif self.messages is not None:
            text += "; no messages lost"
        return text


@dataclass
class Damage:
    """What is wrong with a file."""

    losses: list[Loss] = field(default_factory=list)
    """Stretches in its middle that are lost."""
    ending: Loss | None = None
    """What is missing at the end of a file that was cut off."""
    remarks: list[str] = field(default_factory=list)
    """What is wrong but cost no messages."""
    unprotected: list[str] = field(default_factory=list)
    """What was read without a CRC over it."""


def settle(damage: Damage, topics: Mapping[str, Topic], counts: Mapping[str, int] | None) -> None:
    """Find out how much is lost where nothing in the loss itself tells.

    Parameters
    ----------
    damage
        Of a file.
    topics
        What was read.
    counts
        How many messages each topic has by the file's own statistics; None: not known.
    """
    missing = _missing(damage.losses, topics, counts) if counts is not None else None
    unknown = [loss for loss in damage.losses if loss.messages is None]
    if missing and not unknown:
        whole = Loss(0, 0, "fewer messages than the file's statistics count", messages=missing)
        damage.losses.append(whole)
    for loss in unknown:
        loss.is_estimate = missing is None or len(unknown) > 1
        loss.messages = _by_rate(loss, topics) if missing is None or (missing and len(unknown) > 1) else missing


def _missing(losses: list[Loss], topics: Mapping[str, Topic], counts: Mapping[str, int]) -> dict[str, int]:
    known = {name: sum((loss.messages or {}).get(name, 0) for loss in losses) for name in counts}
    found = {name: len(topics[name]) if name in topics else 0 for name in counts}
    missing = {name: counts[name] - found[name] - known[name] for name in counts}
    return {name: count for name, count in missing.items() if count > 0}


def _by_rate(loss: Loss, topics: Mapping[str, Topic]) -> dict[str, int] | None:
    if loss.start_ns is None or loss.end_ns is None:
        return None
    lost = {}
    for name, topic in topics.items():
        times_ns = topic.log_times_ns
        before, after = times_ns[times_ns <= loss.start_ns], times_ns[times_ns >= loss.end_ns]
        if len(before) < 2 or not len(after):
            continue
        step_ns = float(np.median(np.diff(before[-100:])))
        count = round((after.min() - before.max()) / step_ns) - 1 if step_ns > 0 else 0
        if count > 0:
            lost[name] = count
    return lost or None
