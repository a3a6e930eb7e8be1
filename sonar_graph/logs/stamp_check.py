"""What is wrong with the stamps of a topic."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sonar_graph.measurements import Ints

_NS_PER_S = 1e9
_LARGEST_LAG_S = 1.0
_LARGEST_LAG_CHANGE_S = 0.5


def stamp_faults(stamps_ns: Ints, log_times_ns: Ints) -> Iterator[str]:
    """In words, what a reader of the numbers would want to know.

    Parameters
    ----------
    stamps_ns
        Of the headers, in the order of the file, shape (n,).
    log_times_ns
        When each message was recorded, shape (n,).
    """
    unset = (stamps_ns == 0) & (log_times_ns != 0)  # recorded at 0, 0 is the time: data sets begin there
    if unset.any():
        yield f"{_messages(int(unset.sum()))} without a stamp: the time of recording is used"
    stamps_ns, log_times_ns = stamps_ns[~unset], log_times_ns[~unset]
    if len(stamps_ns) < 2:
        return
    steps_ns = np.diff(stamps_ns)
    if (steps_ns < 0).any():
        yield f"{_times(steps_ns < 0)} backwards, by {-steps_ns.min() / _NS_PER_S:.3g} s at most: rows are sorted"
    again = len(stamps_ns) - len(np.unique(stamps_ns))
    if again:
        yield f"{_messages(again)} with the stamp of another"
    yield from _lag(log_times_ns - stamps_ns)


def _lag(lag_ns: Ints) -> Iterator[str]:
    """How recording follows stamps: another clock, or one that jumps or drifts."""
    typical_s = float(np.median(lag_ns)) / _NS_PER_S
    if abs(typical_s) > _LARGEST_LAG_S:
        side = "before" if typical_s > 0 else "after"
        yield f"stamped {abs(typical_s):.4g} s {side} recording: another clock, or a delay"
    first_s, last_s = (float(np.median(part)) / _NS_PER_S for part in (lag_ns[:20], lag_ns[-20:]))
    if abs(last_s - first_s) > _LARGEST_LAG_CHANGE_S:
        yield f"stamps and recording drift apart by {abs(last_s - first_s):.3g} s: a clock jumped or runs wrong"


def _messages(count: int) -> str:
    return "1 message" if count == 1 else f"{count} messages"


def _times(which: np.ndarray) -> str:
    count = int(np.count_nonzero(which))
    return "once" if count == 1 else f"{count} times"
