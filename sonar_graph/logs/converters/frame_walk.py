"""From frame to frame through a sonar's file, believing none that its neighbours contradict.

The formats have no checksums. What can be checked is checked: a frame is whole when its header makes sense and another
sensible header, or the end of the file, follows where it should; a frame has a damaged header whose settings are those
of none of its neighbours (some sonars alternate between two), or whose time is not between theirs. What cannot be told:
samples that were overwritten in place, and bytes that are missing or too many by exactly the length of frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from itertools import combinations

from sonar_graph.logs.converters.sonar_file import ByteSource, DamagedFrameError, FrameHead, Lost, SonarFormat

_NEIGHBOURS = 4
"""On either side, with which a frame's settings are compared."""
_DRIFT = 1e-3
"""Relative change of a setting given as a float (speed of sound) between neighbours that is none."""
_ODD_GAP = 10
"""How many times longer the first and last interval may be than the one beside it, before its time counts as damaged,
with ..."""
_ODD_GAP_NS = 1_000_000_000
"""... this much to spare."""


def frames_and_losses(source: ByteSource, kind: SonarFormat) -> Iterator[FrameHead | Lost]:
    """Headers of all frames that can be believed, in the order of the file, and what is lost between."""
    accepted: deque[FrameHead] = deque(maxlen=_NEIGHBOURS)
    waiting: deque[FrameHead] = deque()
    for found in _whole(source, kind):
        if isinstance(found, Lost):
            yield found
            continue
        waiting.append(found)
        if len(waiting) > _NEIGHBOURS:
            yield _judged(accepted, waiting, kind.clock_period_ns)
    while waiting:
        yield _judged(accepted, waiting, kind.clock_period_ns)


def _judged(accepted: deque[FrameHead], waiting: deque[FrameHead], period_ns: int | None) -> FrameHead | Lost:
    """The first that waits: believed, or lost."""
    head = waiting.popleft()
    fault = _fault(accepted, head, waiting, period_ns)
    if fault:
        return Lost(head.at, head.end, f"frame {head.number}: {fault}")
    accepted.append(head)
    return head


def first_sound(source: ByteSource, kind: SonarFormat) -> FrameHead | None:
    """The first header with an image that makes sense, wherever it is; None: there is none."""
    head = _next_sound(source, kind, 0)
    while head is not None and not head.has_image:
        head = _next_sound(source, kind, head.at + 1)
    return head


def _whole(source: ByteSource, kind: SonarFormat) -> Iterator[FrameHead | Lost]:
    """Frames after which the file goes on as it should, with their neighbours not yet compared."""
    at, pending = kind.first_at, None
    while at < source.size:
        try:
            head = _head(source, kind, at)
        except DamagedFrameError as error:
            found = _next_sound(source, kind, _search_start(kind, pending, at), but_not=at)
            is_shifted = pending is not None and _is_shifted(source, kind, pending, found)
            yield from _around_damage(pending, at, found.at if found else source.size, str(error), is_shifted)
            pending, at = None, found.at if found else source.size
            continue
        if pending and pending.has_image:
            yield pending
        pending, at = head, head.end
    if pending and pending.end > source.size:
        have = source.size - pending.at
        yield Lost(
            pending.at, source.size, f"frame {pending.number}: cut off, {have} of {pending.size} bytes are there"
        )
    elif pending and pending.has_image:
        yield pending


def _search_start(kind: SonarFormat, pending: FrameHead | None, at: int) -> int:
    """Within the frame before, from which bytes may be missing, or within the file's header, from which too."""
    if pending:
        return pending.at + 1
    return 0 if at == kind.first_at else at + 1


def _head(source: ByteSource, kind: SonarFormat, at: int) -> FrameHead:
    head = kind.head(source.read(at, kind.head_bytes), at)
    if head.end > source.size and _next_sound(source, kind, at + 1):
        raise DamagedFrameError(f"frame {head.number} claims to be longer than the file, in which others follow")
    return head


def _is_shifted(source: ByteSource, kind: SonarFormat, pending: FrameHead, found: FrameHead | None) -> bool:
    """Whether bytes may be missing from the frame before a bad header, or too many be in it."""
    if found is not None:
        return (found.at - pending.end) % pending.size != 0
    rest = source.size - pending.end
    if rest < kind.head_bytes and kind.may_follow(source.read(pending.end, rest), pending):
        return False
    return rest % pending.size != 0


def _around_damage(
    pending: FrameHead | None, at: int, end: int, reason: str, is_shifted: bool
) -> Iterator[FrameHead | Lost]:
    """What becomes of the frame before a bad header at ``at``, and of all up to the next good one or the end."""
    if pending and is_shifted:
        yield Lost(pending.at, end, f"frame {pending.number} and what follows: bytes are missing or too many")
        return
    if pending and pending.has_image:
        yield pending
    yield Lost(at, end, reason) if end > at else Lost(0, end, f"the file's header is {at - end} bytes too short")


def _next_sound(source: ByteSource, kind: SonarFormat, start: int, but_not: int = -1) -> FrameHead | None:
    """The first header from ``start`` on that makes sense, one place left out."""
    for at in source.places(kind.signature, start + kind.signature_at):
        begin = at - kind.signature_at
        try:
            if begin != but_not:
                return kind.head(source.read(begin, kind.head_bytes), begin)
        except DamagedFrameError:
            continue  # the signature's bytes by chance
    return None


def _fault(
    accepted: Sequence[FrameHead], judged: FrameHead, waiting: Sequence[FrameHead], period_ns: int | None
) -> str | None:
    """Why a frame's header is not believed; None: it is."""
    if accepted and (accepted[-1].number, accepted[-1].clock_ns) == (judged.number, judged.clock_ns):
        return f"a repetition of the frame at byte {accepted[-1].at}"
    if _is_odd(judged, [*accepted, *waiting]):
        return "its settings are those of no frame beside it"
    if accepted and waiting:
        is_right = _is_between(accepted[-1], judged, waiting[0], period_ns)
    elif len(waiting) > 1:
        is_right = _is_near(_elapsed(judged, waiting[0], period_ns), _elapsed(waiting[0], waiting[1], period_ns))
    elif len(accepted) > 1:
        is_right = _is_near(_elapsed(accepted[-1], judged, period_ns), _elapsed(accepted[-2], accepted[-1], period_ns))
    else:
        return None
    return None if is_right else "its time does not fit those of the frames beside it"


def _is_odd(judged: FrameHead, others: list[FrameHead]) -> bool:
    """Whether no other has its settings although some agree among themselves."""
    if any(_agree(judged, other) for other in others):
        return False
    return any(_agree(one, other) for one, other in combinations(others, 2))


def _is_near(gap_ns: int, usual_ns: int) -> bool:
    """Whether the first or last interval can be one, given the one beside it; where that runs back, nobody knows."""
    return usual_ns < 0 or 0 <= gap_ns <= _ODD_GAP * usual_ns + _ODD_GAP_NS


def _agree(one: FrameHead, other: FrameHead) -> bool:
    return all(
        abs(a - b) <= _DRIFT * abs(b) if isinstance(a, float) and isinstance(b, float) else a == b
        for a, b in zip(one.settings, other.settings, strict=True)
    )


def _is_between(earlier: FrameHead, judged: FrameHead, later: FrameHead, period_ns: int | None) -> bool:
    """Whether time runs on; where it runs back over both steps, the clock was set and nothing can be said."""
    before, after = _elapsed(earlier, judged, period_ns), _elapsed(judged, later, period_ns)
    total = _elapsed(earlier, later, period_ns)
    return total < 0 or (before >= 0 and after >= 0 and before + after == total)


def _elapsed(one: FrameHead, other: FrameHead, period_ns: int | None) -> int:
    difference = other.clock_ns - one.clock_ns
    return difference if period_ns is None else difference % period_ns
