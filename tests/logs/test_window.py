from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.errors import LogError
from sonar_graph.logs.mcap.file_summary import Instant, TimeWindow

BEGINNING_NS = 1_700_000_000_000_000_001


@given(st.datetimes(min_value=datetime(1971, 1, 1), max_value=datetime(2200, 1, 1)), st.integers(-12, 14))
def test_a_date_is_absolute_in_its_zone(when: datetime, hours: int) -> None:
    zoned = when.replace(tzinfo=timezone(timedelta(hours=hours)))
    expected_us = (zoned - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1)
    assert Instant.parse(zoned.isoformat()).resolve(BEGINNING_NS) == expected_us * 1000


def test_without_a_zone_a_date_is_in_utc() -> None:
    assert Instant.parse("1970-01-02T00:00:01").resolve(BEGINNING_NS) == 86_401 * 10**9


def test_a_number_is_seconds_from_the_beginning() -> None:
    assert Instant.parse("1.5").resolve(BEGINNING_NS) == BEGINNING_NS + 1_500_000_000
    assert Instant.parse("1700000000").resolve(0) == 1_700_000_000 * 10**9


@pytest.mark.parametrize("text", ["-1", "nan", "inf", "x", "", "12:30", "1e30"])
def test_other_texts_are_refused_with_an_example(text: str) -> None:
    with pytest.raises(LogError, match=r"no time in a log: give seconds from its beginning"):
        Instant.parse(text)


def test_an_end_before_the_start_is_refused() -> None:
    with pytest.raises(LogError, match="ends before it starts"):
        TimeWindow(Instant.parse("2"), Instant.parse("2")).resolve(BEGINNING_NS)
