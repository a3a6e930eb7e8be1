"""Numbers as text, with the digits that they support: the one formatter of terminal, notebook, pages and tables.

Without a known standard error a number has three significant digits. With one it ends at the error's first digit, or at
its second where the first is 1. The minus sign is typographic.
"""

import math

from sonar_graph.table import ABSENT

MINUS = "\N{MINUS SIGN}"
# a value that is zero at so many decimals is written with a power of ten
MOST_DECIMALS = 12
# significant digits of a quantile, however large its error: it stands without the error, and one digit may be
# zero
LEAST_DIGITS = 2


def format_value(value: float) -> str:
    """Three significant digits; whole numbers and thousands in full; a dash for NaN.

    Examples
    --------
    >>> format_value(0.12345), format_value(9.999), format_value(1234.5), format_value(0.00012)
    ('0.123', '10.0', '1234', '1.20e−4')
    """
    if math.isnan(value):
        return ABSENT
    if math.isinf(value):
        return "∞" if value > 0 else f"{MINUS}∞"
    if float(value).is_integer() or abs(value) >= 1000:
        # counts and thousands have no use for decimals
        text = f"{value:.0f}"
    elif abs(value) < 1e-3:
        mantissa, exponent = f"{value:.2e}".split("e")
        text = f"{mantissa}e{int(exponent)}"
    else:
        # 9.999 becomes 10.0: the decimals are those of the rounded value
        rounded = float(f"{value:.3g}")
        text = f"{rounded:.{max(0, 2 - math.floor(math.log10(abs(rounded))))}f}"
    return text.replace("-", MINUS)


def format_or_missing(value: float) -> str:
    """`format_value`, but "no value" for infinity, which stands for a run of a batch without a value."""
    return "no value" if math.isinf(value) else format_value(value)


def fixed(value: float, decimals: int) -> str:
    """The value with so many decimals, at most 12; negative ones round before the decimal point."""
    if decimals > MOST_DECIMALS and round(value, MOST_DECIMALS) == 0:
        return format_or_missing(value)
    decimals = min(decimals, MOST_DECIMALS)
    text = f"{round(value, decimals):.{max(0, decimals)}f}"
    if float(text) == 0:
        text = text.lstrip("-")
    return text.replace("-", MINUS)


def decimals_of(standard_error: float) -> int:
    """Decimals down to the first digit of the standard error, one more where that is 1.

    Examples
    --------
    >>> decimals_of(0.034), decimals_of(0.012), decimals_of(340.0)
    (2, 3, -2)
    """
    # rounding first: 0.0999 is 0.10, whose first digit is a 1
    leading, exponent = f"{standard_error:.6e}".split("e")
    return (1 if float(leading) < 2 else 0) - int(exponent)


def is_known(value: float, standard_error: float) -> bool:
    """True where value and standard error are numbers, and the error is not zero."""
    return math.isfinite(value) and math.isfinite(standard_error) and standard_error > 0


def supported(value: float, standard_error: float) -> str:
    """The value, rounded where its standard error begins.

    Examples
    --------
    >>> supported(0.123456, 0.0034), supported(1234.5, 86.0), supported(0.123456, float("nan"))
    ('0.123', '1230', '0.123')
    """
    if not is_known(value, standard_error):
        return format_or_missing(value)
    return fixed(value, decimals_of(standard_error))


def quantile_text(value: float, error: float) -> str:
    """A median or another quantile, rounded where its error begins, but with two significant digits at least.

    Examples
    --------
    >>> quantile_text(0.123456, 0.0034), quantile_text(0.123456, 40.0), quantile_text(0.123456, float("nan"))
    ('0.123', '0.12', '0.123')
    """
    if not is_known(value, error):
        return format_or_missing(value)
    # a median without its error beside it must not shrink to one digit
    least = LEAST_DIGITS - 1 - math.floor(math.log10(abs(value))) if value else 0
    return fixed(value, max(decimals_of(error), least))


def with_error(value: float, standard_error: float) -> str:
    """Value and standard error with the same decimals, ``0.123 ± 0.003``; the value alone where no error is known."""
    if not is_known(value, standard_error):
        return format_or_missing(value)
    decimals = decimals_of(standard_error)
    return f"{fixed(value, decimals)} ± {fixed(standard_error, decimals)}"


def between(low: float, high: float, standard_error: float = math.nan) -> str:
    """Two bounds, rounded alike; a dash where one is NaN."""
    if math.isnan(low) or math.isnan(high):
        return ABSENT
    return f"{supported(low, standard_error)} to {supported(high, standard_error)}"
