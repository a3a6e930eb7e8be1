"""Copies of logs as other programs write them."""

from collections.abc import Callable
from pathlib import Path

from tests.logs.conftest import copy, recorded, writing


def bare(
    source: Path,
    target: Path,
    payload: Callable[[int, bytes], bytes] = lambda _row, data: data,
) -> Path:
    """Messages of a log without the records of this package; each topic's rows with payloads made of theirs."""
    with writing(target) as writer:
        copy(recorded(source), writer, lambda _topic, *message: payload(*message))
    return target
