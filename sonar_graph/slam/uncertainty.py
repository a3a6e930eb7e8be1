"""Joint covariances of keyframes and landmarks, asked for by their numbers or stamps."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from typing import Literal, NamedTuple, get_args

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from sonar_graph.errors import EstimatorError
from sonar_graph.slam.joint_covariance import JointCovariance
from sonar_graph.slam.smoother import Smoother

Over = Literal["window", "history"]
MOST_LISTED = 12
"""Landmarks that a message lists."""


class Solution(NamedTuple):
    """Of the whole graph."""

    values: gtsam.Values
    marginals: gtsam.Marginals | gtsam.ISAM2
    ids: list[int]
    """Of the landmarks in it, ascending."""


def joint_covariance(
    smoother: Smoother,
    history: Callable[[], Solution],
    stamps_ns: Sequence[int],
    over: Over,
    keyframes: Iterable[int],
    at_ns: Iterable[int],
    landmarks: Iterable[int],
) -> JointCovariance:
    """See `sonar_graph.slam.isam2.Isam2.joint_covariance`.

    Parameters
    ----------
    history
        Solves the whole graph.
    stamps_ns
        Of all keyframes of the run.
    at_ns
        Stamps of those that are asked for beside ``keyframes``.
    """
    if over not in get_args(Over):
        raise EstimatorError(f'isam2: over is {over!r}; expected "window" or "history"')
    keyframes, at_ns, landmarks = (
        _numbers(*asked) for asked in (("keyframes", keyframes), ("stamps_ns", at_ns), ("landmarks", landmarks))
    )
    poses = [*keyframes, *(_number_at(stamp_ns, stamps_ns) for stamp_ns in at_ns)]
    for number in poses:
        if not 0 <= number < len(stamps_ns):
            raise EstimatorError(f"isam2: there is no keyframe {number}; {_existing(len(stamps_ns))}")
    known_ids = smoother.landmark_ids if over == "window" else history().ids
    keys = list(dict.fromkeys([*map(X, poses), *map(L, _known(landmarks, known_ids))]))
    if not keys:
        raise EstimatorError("isam2: the covariance of nothing was asked for; give keyframes, stamps or landmarks")
    held = set(smoother.in_window(keys))
    left = [number for number in dict.fromkeys(poses) if X(number) not in held]
    if left and (over == "window" or smoother.is_bounded):
        first = next((k for k in range(len(stamps_ns)) if smoother.in_window([X(k)])), len(stamps_ns) - 1)
        instead = "none is known any more" if smoother.is_bounded else 'ask over="history" for older ones'
        raise EstimatorError(
            f"isam2: keyframe {left[0]} has left the window, which holds {first} to {len(stamps_ns) - 1}; {instead}"
        )
    if over == "window":
        return JointCovariance.of(smoother.marginals, sorted(keys))
    return JointCovariance.of(history().marginals, sorted(keys))


def _numbers(field: str, asked: object) -> list[int]:
    found = np.asarray(list(asked) if isinstance(asked, Iterable) else asked)
    if found.ndim != 1 or (found.size and found.dtype.kind not in "iu"):
        raise EstimatorError(f"isam2: {field}: expected a list of integers, such as [1, 2], not {asked!r}")
    return [int(number) for number in found.tolist()]


def _number_at(stamp_ns: int, stamps_ns: Sequence[int]) -> int:
    place = bisect_left(stamps_ns, stamp_ns)
    if place < len(stamps_ns) and stamps_ns[place] == stamp_ns:
        return place
    beside = " and ".join(str(stamp) for stamp in stamps_ns[max(place - 1, 0) : place + 1])
    nearest = f"the nearest are at {beside} ns" if beside else "there is none yet"
    raise EstimatorError(f"isam2: no keyframe at {stamp_ns} ns; {nearest}")


def _known(landmarks: Iterable[int], ids: list[int]) -> list[int]:
    asked = list(landmarks)
    unknown = [i for i in asked if i not in set(ids)]
    if unknown:
        listed = ", ".join(map(str, ids[:MOST_LISTED])) + (", ..." if len(ids) > MOST_LISTED else "")
        raise EstimatorError(f"isam2: landmark {unknown[0]} is not in the graph; it holds {listed or 'none yet'}")
    return asked


def _existing(count: int) -> str:
    return f"it has 0 to {count - 1}" if count else "none was set yet"
