import math

import pytest

from sonar_graph.evaluation import fixed, format_value


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (fixed(3e-12, 12), "0.000000000003"),
        (fixed(-0.001, 1), "0.0"),  # zero has no sign
        (fixed(-1.25, 1), "-1.2"),
        (format_value(0.00012), "1.20e-4"),
        (format_value(9.999), "10.0"),
        (format_value(1234.5), "1234"),
        (format_value(math.nan), "\N{EN DASH}"),
        (format_value(-math.inf), "-∞"),
    ],
)
def test_digits_by_hand(text, shown):
    assert text.replace("\N{MINUS SIGN}", "-") == shown
