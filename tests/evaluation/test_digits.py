import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.evaluation.digits import (
    between,
    fixed,
    quantile_text,
    supported,
    with_error,
)

# fmt: on


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (
            with_error(0.123456, 0.0034),
            "0.123 ± 0.003",
        ),  # value and error have the same digits
        (with_error(1234.5, 86.0), "1230 ± 90"),
        (with_error(-2.0, 0.15), "-2.00 ± 0.15"),
        (supported(0.123456, math.nan), "0.123"),  # without an error three digits
        (with_error(0.123456, math.nan), "0.123"),
        *(
            (form(0.123456, 0.0), "0.123")
            for form in (supported, quantile_text, with_error)
        ),  # zero is no error
        (
            quantile_text(0.123456, 40.0),
            "0.12",
        ),  # a quantile has two digits however large its error
        (quantile_text(-0.00098765, 40.0), "-0.00099"),
        (quantile_text(0.0, 40.0), "0"),
        (
            with_error(3.21e-20, 4e-22),
            "3.21e-20 ± 4.00e-22",
        ),  # nothing at twelve decimals: a power of ten
        (with_error(0.25, 5e-324), "0.250000000000 ± 4.94e-324"),
        (quantile_text(5e-324, 1.0), "4.94e-324"),
        (quantile_text(0.25, 5e-324), "0.250000000000"),
        (supported(0.0, 5e-324), "0"),
        (fixed(3e-12, 12), "0.000000000003"),
        (fixed(3e-13, 12), "0.000000000000"),
        (supported(-0.001, 0.3), "0.0"),  # zero has no sign
        (supported(math.inf, 0.1), "no value"),
        (between(0.1, math.inf), "0.100 to no value"),
        (between(0.123456, 0.987654, 0.03), "0.12 to 0.99"),
        *(
            (between(*bounds), "\N{EN DASH}")
            for bounds in ((math.nan, math.nan), (0.1, math.nan), (math.nan, 0.1))
        ),
    ],
)
def test_digits_by_hand(text, shown):
    assert text.replace("\N{MINUS SIGN}", "-") == shown


@given(st.floats(-1e300, 1e300), st.floats(0.0, 1e300))
def test_every_number_can_be_written(value, error):
    for text in (
        supported(value, error),
        quantile_text(value, error),
        with_error(value, error),
    ):
        assert text
        assert "nan" not in text
