from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.evaluation.digits import between, decimals_of, fixed, quantile_text, supported, with_error


@pytest.mark.parametrize(
    ("error", "decimals"),
    [
        (0.034, 2),
        (0.012, 3),
        (340.0, -2),
        (1.0, 1),
        (0.2, 1),
        (9.9e-5, 5),
        (1.99, 1),
        (2.0, 0),
        (0.3, 1),
        (1e-3, 4),
        (2e-3, 3),
        (1.999996, 1),
        (1.9999996, 0),
        (5e-324, 324),
        (3e-320, 320),
    ],
)
def test_digits_end_where_the_standard_error_begins(error, decimals):
    assert decimals_of(error) == decimals


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e3))
def test_rounding_changes_a_value_by_less_than_half_its_standard_error(value, error):
    shown = float(supported(value, error).replace("\N{MINUS SIGN}", "-"))
    assert abs(shown - value) <= 0.5 * error + 1e-9 * abs(value)


def test_value_and_error_have_the_same_digits():
    assert with_error(0.123456, 0.0034) == "0.123 ± 0.003"
    assert with_error(1234.5, 86.0) == "1230 ± 90"
    assert with_error(-2.0, 0.15) == "\N{MINUS SIGN}2.00 ± 0.15"


def test_a_value_without_an_error_has_three_digits():
    assert supported(0.123456, math.nan) == "0.123"
    assert with_error(0.123456, math.nan) == "0.123"


@pytest.mark.parametrize(("value", "text"), [(0.123456, "0.12"), (-0.00098765, "\N{MINUS SIGN}0.00099"), (0.0, "0")])
def test_a_quantile_has_two_digits_however_large_its_error(value, text):
    assert quantile_text(value, 40.0) == text


@given(st.floats(0.1, 1e6), st.floats(1e-6, 1e-2))
def test_a_quantile_with_a_small_error_is_rounded_by_it(value, error):
    assert quantile_text(value, error) == supported(value, error)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (with_error(3.21e-20, 4e-22), "3.21e-20 ± 4.00e-22"),
        (with_error(0.25, 5e-324), "0.250000000000 ± 4.94e-324"),
        (quantile_text(5e-324, 1.0), "4.94e-324"),
        (quantile_text(0.25, 5e-324), "0.250000000000"),
        (supported(0.0, 5e-324), "0"),
        (fixed(3e-12, 12), "0.000000000003"),
        (fixed(3e-13, 12), "0.000000000000"),
    ],
)
def test_what_is_nothing_at_twelve_decimals_has_a_power_of_ten(text, shown):
    assert text.replace("\N{MINUS SIGN}", "-") == shown


@given(st.floats(-1e300, 1e300), st.floats(0.0, 1e300))
def test_every_number_can_be_written(value, error):
    for text in (supported(value, error), quantile_text(value, error), with_error(value, error)):
        assert text
        assert "nan" not in text


def test_what_rounds_to_zero_has_no_sign():
    assert supported(-0.001, 0.3) == "0.0"


def test_what_is_infinite_is_no_number():
    assert supported(math.inf, 0.1) == "no value"
    assert between(0.1, math.inf) == "0.100 to no value"
    assert between(math.nan, math.nan) == "\N{EN DASH}"


def test_an_error_of_zero_is_none_that_is_known():
    assert supported(0.123456, 0.0) == quantile_text(0.123456, 0.0) == with_error(0.123456, 0.0) == "0.123"


def test_two_bounds_are_rounded_alike_and_one_alone_is_a_dash():
    assert between(0.123456, 0.987654, 0.03) == "0.12 to 0.99"
    assert between(0.1, math.nan) == between(math.nan, 0.1) == "\N{EN DASH}"
