from __future__ import annotations

import numpy as np
import pytest

from sonar_graph.logs.checks import stamp_faults

SECOND = 10**9
EVEN = np.arange(100) * SECOND // 10 + 10**18


def test_even_stamps_have_no_faults() -> None:
    assert list(stamp_faults(EVEN, EVEN + SECOND // 20)) == []


def test_what_was_recorded_at_zero_has_the_stamp_zero() -> None:
    from_zero = np.arange(100) * SECOND
    assert list(stamp_faults(from_zero, from_zero)) == []


@pytest.mark.parametrize(
    ("stamps_ns", "log_times_ns", "expected"),
    [
        (np.where(np.arange(100) < 3, 0, EVEN), EVEN, "3 messages without a stamp"),
        (EVEN[np.r_[:50, 52, 50:52, 53:100]], EVEN, "once backwards, by 0.2 s at most"),
        (np.where(np.arange(100) == 7, EVEN[6], EVEN), EVEN, "1 message with the stamp of another"),
        (np.where(np.arange(100) < 1, 0, EVEN), EVEN, "1 message without a stamp"),
        (EVEN - 5 * SECOND, EVEN, "stamped 5 s before recording"),
        (EVEN + 5 * SECOND, EVEN, "stamped 5 s after recording"),
        (EVEN - np.where(np.arange(100) < 60, 0, SECOND * 9 // 10), EVEN, "drift apart by 0.9 s"),
    ],
)
def test_each_fault_is_told(stamps_ns: np.ndarray, log_times_ns: np.ndarray, expected: str) -> None:
    assert any(expected in fault for fault in stamp_faults(stamps_ns, log_times_ns))
