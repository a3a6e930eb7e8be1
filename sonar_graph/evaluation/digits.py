"""Numbers as text: the one formatter of terminal, notebook, pages and tables. The minus sign is typographic."""

import math

from sonar_graph.table import ABSENT

MINUS = "\N{MINUS SIGN}"


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


def fixed(value: float, decimals: int) -> str:
    """The value with so many decimals, a dash for NaN; a zero has no sign."""
    if math.isnan(value):
        return ABSENT
    text = f"{value:.{decimals}f}"
    if float(text) == 0:
        text = text.lstrip("-")
    return text.replace("-", MINUS)
