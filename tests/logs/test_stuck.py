from __future__ import annotations

import numpy as np
import pytest

from sonar_graph.logs.checks import stuck_warning
from sonar_graph.measurements import Floats


def moving(seed: int = 0) -> Floats:
    return np.random.default_rng(seed).standard_normal((300, 3))


def found(values: Floats, rate_hz: float = 10.0) -> str | None:
    stamps_ns = 1_400_000_000_000_000_000 + np.rint(np.arange(len(values)) * 1e9 / rate_hz).astype(np.int64)
    return stuck_warning(stamps_ns, values, "velocity")


def test_what_moves_is_not_stuck() -> None:
    assert found(moving()) is None


@pytest.mark.parametrize(("value", "what"), [((0.0, 0.0, 0.0), "exactly zero"), ((0.4, 0.0, -0.1), "the same to the")])
def test_equal_rows_are_named_with_times_and_count(value: tuple[float, ...], what: str) -> None:
    values = moving()
    values[100:131] = value
    text = found(values)
    assert text is not None
    assert text.startswith(f"velocity {what}")
    assert "in 31 rows, 10.000 to 13.000 s after the first: used as measured" in text
    assert "without lock" in text


def test_a_stretch_at_either_end_counts() -> None:
    values = moving()
    values[:20], values[-30:] = 0.0, 0.0
    text = found(values)
    assert text is not None
    assert "in 50 rows, 0.000 to 1.900, 27.000 to 29.900 s" in text


@pytest.mark.parametrize(
    ("rows", "rate_hz", "is_named"), [(11, 10, False), (12, 10, True), (4, 1, False), (5, 1, True)]
)
def test_more_than_a_second_and_five_rows(rows: int, rate_hz: float, is_named: bool) -> None:
    values = moving()
    values[100 : 100 + rows] = 0.0
    assert (found(values, rate_hz) is not None) is is_named


def test_one_axis_alone_may_stay_the_same() -> None:
    """A vehicle in the plane, or a log without a vertical."""
    values = moving()
    values[:, :2] = 0.0
    assert found(values) is None


def test_zeros_are_told_from_other_values_and_the_longest_are_named() -> None:
    values = moving()
    values[10:40] = 1.0
    for k in range(5):
        values[60 + 40 * k : 80 + 41 * k] = 0.0
    text = found(values)
    assert text is not None
    assert "exactly zero in 110 rows of 5 stretches, the longest 14.000 to 16.100, 18.000 to 20.200, 22.000 to" in text
    assert "and the same to the last bit in 30 rows, 1.000 to 3.900 s after the first" in text


def test_a_single_row_is_not_stuck() -> None:
    assert found(np.zeros((1, 3))) is None
