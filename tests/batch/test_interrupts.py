from __future__ import annotations

import contextlib
import os
import signal
import threading
from typing import Any

import pytest

from sonar_graph.batch.batch import deferred_interrupt, terminations_as_interrupts


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def interrupted_block(steps: list[str]) -> None:
    with deferred_interrupt():
        try:
            interrupt()
        except KeyboardInterrupt:
            pytest.fail("swallowed here, and lost")
        steps.append("went on")


def test_interrupt_within_the_block_is_told_at_its_end() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    steps: list[str] = []
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted_block(steps)
        assert steps == ["went on"]
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def failing_block() -> None:
    with contextlib.suppress(OSError), deferred_interrupt():
        interrupt()
        raise OSError("disk full")


def test_interrupt_of_a_block_that_fails_outlives_its_error() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            failing_block()
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("handler", [signal.default_int_handler, signal.SIG_IGN])
def test_termination_counts_like_an_interrupt_also_where_shells_let_it_be_ignored(handler: Any) -> None:
    before = signal.signal(signal.SIGINT, handler), signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(KeyboardInterrupt), terminations_as_interrupts():
            os.kill(os.getpid(), signal.SIGTERM)
        assert signal.getsignal(signal.SIGTERM) is before[1]
    finally:
        signal.signal(signal.SIGINT, before[0])


def test_termination_is_deferred_like_an_interrupt() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    steps: list[str] = []

    def terminated_block() -> None:
        with terminations_as_interrupts(), deferred_interrupt():
            os.kill(os.getpid(), signal.SIGTERM)
            steps.append("went on")

    try:
        with pytest.raises(KeyboardInterrupt):
            terminated_block()
    finally:
        signal.signal(signal.SIGINT, before)
    assert steps == ["went on"]


def test_block_without_interrupt_and_in_another_thread_is_as_without() -> None:
    handler = signal.getsignal(signal.SIGINT)
    done = []

    def block() -> None:
        with deferred_interrupt():
            done.append(signal.getsignal(signal.SIGINT) is handler)

    thread = threading.Thread(target=block)
    thread.start()
    thread.join()
    with deferred_interrupt():
        done.append(True)
    assert done == [True, True]
    assert signal.getsignal(signal.SIGINT) is handler


def test_error_within_the_block_gives_the_handler_back() -> None:
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(OSError, match="full"), deferred_interrupt():
        raise OSError("full")
    assert signal.getsignal(signal.SIGINT) is handler


def test_interrupt_that_is_ignored_stays_so() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with deferred_interrupt():
            interrupt()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
