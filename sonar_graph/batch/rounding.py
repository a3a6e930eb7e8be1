"""Numbers with as many digits as their standard error supports."""

from __future__ import annotations

import math

from sonar_graph.evaluation.wording import ABSENT, format_value

MOST_DECIMALS = 12
"""What is nothing at so many decimals has three significant digits and a power of ten."""
LEAST_DIGITS = 2
"""Of a value that stands without its error: with fewer it may look like nothing at all."""
MINUS = "\N{MINUS SIGN}"


def decimals_of(standard_error: float) -> int:
    """Decimals down to the first digit of the standard error, one more where that is 1; negative before the point.

    0.034 gives 2, 0.012 gives 3, 340 gives -2.
    """
    leading, exponent = f"{standard_error:.6e}".split("e")
    return (1 if float(leading) < 2 else 0) - int(exponent)


def supported(value: float, standard_error: float) -> str:
    """The value, rounded where its standard error begins; three significant digits where no error is known.

    Examples
    --------
    >>> supported(0.123456, 0.0034), supported(1234.5, 86.0), supported(0.123456, float("nan"))
    ('0.123', '1230', '0.123')
    """
    if not math.isfinite(value) or not math.isfinite(standard_error) or standard_error <= 0:
        return shown(value)
    return fixed(value, decimals_of(standard_error))


def quantile_text(value: float, error: float) -> str:
    """A median or another quantile, rounded where its error begins, but with two significant digits at least.

    Examples
    --------
    >>> quantile_text(0.123456, 0.0034), quantile_text(0.123456, 40.0), quantile_text(0.123456, float("nan"))
    ('0.123', '0.12', '0.123')
    """
    if not math.isfinite(value) or not math.isfinite(error) or error <= 0:
        return shown(value)
    least = LEAST_DIGITS - 1 - math.floor(math.log10(abs(value))) if value else 0
    return fixed(value, max(decimals_of(error), least))


def with_error(value: float, standard_error: float) -> str:
    """Value and standard error with the same decimals, ``0.123 ± 0.003``; the value alone where no error is known."""
    if not math.isfinite(value) or not math.isfinite(standard_error) or standard_error <= 0:
        return shown(value)
    decimals = decimals_of(standard_error)
    return f"{fixed(value, decimals)} ± {fixed(standard_error, decimals)}"


def between(low: float, high: float, standard_error: float = math.nan) -> str:
    """Two bounds, rounded alike; a dash where there are none."""
    if math.isnan(low) or math.isnan(high):
        return ABSENT
    return f"{supported(low, standard_error)} to {supported(high, standard_error)}"


def fixed(value: float, decimals: int) -> str:
    """Rounded to so many decimals, at most 12; negative ones round before the point."""
    if decimals > MOST_DECIMALS and round(value, MOST_DECIMALS) == 0:
        return shown(value)
    decimals = min(decimals, MOST_DECIMALS)
    rounded = round(value, decimals)
    text = f"{rounded:.{max(0, decimals)}f}"
    if float(text) == 0:
        text = text.lstrip("-")
    return text.replace("-", MINUS)


def shown(value: float) -> str:
    """Three significant digits; a dash for NaN; what is infinite is no number but a run without one."""
    return "no value" if math.isinf(value) else format_value(value)
