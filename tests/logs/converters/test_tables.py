import decimal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.logs.convert.text_tables import decimal_ns, read_table


@given(st.integers(-(2**62), 2**62))
def test_decimal_text_gives_its_nanoseconds_exactly(ns):
    text = f"{'-' if ns < 0 else ''}{abs(ns) // 10**9}.{abs(ns) % 10**9:09d}"
    assert decimal_ns(text) == ns


def test_a_double_would_have_lost_what_the_text_keeps():
    text = "1248444175.103"
    assert decimal_ns(text) == 1248444175103000000
    assert int(float(text) * 1e9) != decimal_ns(text)


@pytest.mark.parametrize("text", ["nan", "inf", "-Infinity", "soon", ""])
def test_what_is_no_time_is_refused(text):
    with pytest.raises(ValueError, match="no finite decimal"):
        decimal_ns(text)


def test_precision_of_the_caller_does_not_matter():
    with decimal.localcontext() as context:
        context.prec = 28
        assert decimal_ns("1.00250626566416034242424242") == 1002506266


def test_comments_and_blank_lines_are_passed_over(tmp_path):
    path = tmp_path / "t.dat"
    path.write_text("# time value\n\n  1.5 \t -2\n # again\n2.5 3e1\n")
    table = read_table(path, ("time", "value"))
    assert table.first == ["1.5", "2.5"]
    assert np.array_equal(table.values, [[1.5, -2.0], [2.5, 30.0]])
    assert table.stamps_ns().tolist() == [1_500_000_000, 2_500_000_000]


@pytest.mark.parametrize(
    ("content", "fragments"),
    [
        ("", ("holds no data", "time, value")),
        ("# only a comment\n", ("holds no data",)),
        ("1 2\n\n1\n", ("line 3", "1 fields", "2 numbers: time, value")),
        ("1 2\n1 two\n", ("line 2", "two")),
        ("1 nan\n", ("line 1", "not finite")),
    ],
)
def test_a_bad_table_is_refused_by_file_and_line(tmp_path, refusal, content, fragments):
    path = tmp_path / "bad.dat"
    path.write_text(content)
    refusal(lambda: read_table(path, ("time", "value")), path, *fragments)


def test_a_missing_or_binary_file_is_refused(tmp_path, refusal):
    refusal(lambda: read_table(tmp_path / "absent.dat", ("time",)), "absent.dat", "rows of time")
    (tmp_path / "binary.dat").write_bytes(b"\xff\xfe\x00\x81")
    refusal(lambda: read_table(tmp_path / "binary.dat", ("time",)), "binary.dat", "text")
