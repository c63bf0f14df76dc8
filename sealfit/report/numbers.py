"""Numbers as people read them: a value rounded to its uncertainty, a minus that is a minus, nothing invented."""

from __future__ import annotations

import math
from collections.abc import Sequence

NOTHING = "–"
THIN = "\u202f"  # narrow no-break space: between thousands, and around the cross of a power of ten
_UP = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
SMALL, LARGE = 1e-4, 1e6  # outside of these a power of ten is taken out


def known(value: object) -> bool:
    """Return whether `value` is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def number(value: float | None, digits: int = 3) -> str:
    """Return `value` to `digits` significant digits; a dash if there is none.

    Examples
    --------
    >>> number(0.61234), number(-12.3456), number(1752.4), number(0.0), number(None)
    ('0.612', '−12.3', '1752', '0', '–')
    >>> number(1.234e-5)
    '1.23\u202f×\u202f10⁻⁵'
    """
    if isinstance(value, float) and math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if not known(value):
        return NOTHING
    value = float(value)
    if value == 0:
        return "0"
    power = _power(value)
    value /= 10.0**power
    return _fixed(value, max(decimals(value, digits), 0)) + _times_ten(power)


def given(value: float | None, digits: int = 3) -> str:
    """Return a number that somebody set, without the zeros that a measured one would need.

    Examples
    --------
    >>> given(0.5), given(10.02), given(1752.0)
    ('0.5', '10', '1752')
    """
    if not known(value):
        return NOTHING
    text = number(value, digits)
    return text.rstrip("0").rstrip(".") if "." in text and "×" not in text else text


def decimals(size: float, digits: int = 2) -> int:
    """Return how many decimals show `size` to `digits` significant digits; negative left of the point.

    Examples
    --------
    >>> decimals(0.0123), decimals(0.0996), decimals(3.4), decimals(456.0)
    (3, 2, 1, -1)
    """
    size = abs(float(size))
    if size == 0 or not math.isfinite(size):
        return 0
    rounded = float(f"{size:.{digits - 1}e}")  # 0.0996 is 0.10: one decimal less than its own exponent says
    return digits - 1 - math.floor(math.log10(rounded) + 1e-12)


def measured(value: float | None, lo: float | None, hi: float | None, digits: int = 2) -> tuple[str, str]:
    """Return a value and its interval, both rounded to `digits` significant digits of the interval's half-width.

    With `digits` 1, a half-width that begins with 1 keeps two: one would round it by up to a third.

    Examples
    --------
    >>> measured(0.83512, 0.8214, 0.8489)
    ('0.835', '[0.821, 0.849]')
    >>> measured(6.123, 5.513, 6.7012)
    ('6.12', '[5.51, 6.70]')
    >>> measured(4.02, 3.61, 4.48, digits=1), measured(4.02, 3.9, 4.14, digits=1)
    (('4.0', '[3.6, 4.5]'), ('4.02', '[3.90, 4.14]'))
    >>> measured(4.0, None, None), measured(4.0, None, 5.5)
    (('4.00', '–'), ('4.00', 'up to 5.50'))
    """
    if not known(value):
        return NOTHING, NOTHING
    if not (known(lo) and known(hi)):
        return number(value), f"from {number(lo)}" if known(lo) else f"up to {number(hi)}" if known(hi) else NOTHING
    if hi == lo:
        return number(value), f"[{number(lo)}, {number(hi)}]"
    power = _power(max(abs(value), abs(lo), abs(hi)))
    value, lo, hi = (x / 10.0**power for x in (value, lo, hi))
    half = (hi - lo) / 2
    if digits == 1 and f"{half:.1e}".startswith("1"):
        digits = 2
    places = min(decimals(half, digits), 9)
    tail = _times_ten(power)
    return _fixed(value, places) + tail, f"[{_fixed(lo, places)}, {_fixed(hi, places)}]" + tail


def uncertain(value: float | None, u: float | None) -> str:
    """Return a value rounded to two significant digits of its uncertainty.

    Examples
    --------
    >>> uncertain(1.23456, 0.034), uncertain(1.23456, None)
    ('1.235', '1.23')
    """
    if not known(value) or not known(u) or u <= 0:
        return number(value)
    power = _power(max(abs(value), abs(u)))
    return _fixed(value / 10.0**power, min(decimals(u / 10.0**power), 9)) + _times_ten(power)


def together(values: Sequence[float | None], digits: int = 2) -> list[str]:
    """Return several numbers of one unit with the same decimals: the smallest shows `digits` significant ones.

    Examples
    --------
    >>> together([1.4234, 0.3121, 0.2899, None])
    ['1.42', '0.31', '0.29', '–']
    """
    sizes = [abs(value) for value in values if known(value) and value != 0]
    if not sizes:
        return [number(value) for value in values]
    power = _power(max(sizes))
    largest = decimals(max(sizes) / 10.0**power, 4)  # one tiny value does not give the others nine decimals
    places = min(decimals(min(sizes) / 10.0**power, digits), largest)
    return [_fixed(v / 10.0**power, places) + _times_ten(power) if known(v) else NOTHING for v in values]


def p_value(p: float | None) -> str:
    """Return a p-value with its sign: "= 0.012", "< 0.001".

    Examples
    --------
    >>> p_value(0.0123), p_value(0.00012), p_value(0.0512), p_value(0.8), p_value(None)
    ('= 0.012', '< 0.001', '= 0.051', '= 0.80', 'not available')
    """
    if not known(p):
        return "not available"
    if p < 0.001:
        return "< 0.001"
    if p > 0.99:
        return "> 0.99"
    return f"= {p:.{decimals(p, 2)}f}"


def of_unit(text: str, unit: str) -> str:
    """Return a number with its unit, which no line break parts.

    Examples
    --------
    >>> of_unit("1.5", "mN m")
    '1.5\xa0mN\xa0m'
    >>> of_unit("1.5", "")
    '1.5'
    """
    return f"{text} {unit}".strip().replace(" ", "\u00a0")


def count(n: int, one: str, many: str | None = None) -> str:
    """Return "1 file", "3 files".

    Examples
    --------
    >>> count(1, "series", "series"), count(0, "file"), count(1752, "file")
    ('1 series', '0 files', '1752 files')
    """
    return f"{_fixed(float(n), 0)} {one if n == 1 else many or one + 's'}"


def _power(value: float) -> int:
    size = abs(value)
    return math.floor(math.log10(size)) if size and not SMALL <= size < LARGE else 0


def power_of_ten(power: int) -> str:
    """Return an exponent as it is written above the line.

    Examples
    --------
    >>> power_of_ten(-12)
    '⁻¹²'
    """
    return str(power).translate(_UP)


def _times_ten(power: int) -> str:
    return f"{THIN}×{THIN}10{power_of_ten(power)}" if power else ""


def _fixed(value: float, places: int) -> str:
    text = f"{round(value, places):,.{max(places, 0)}f}"
    if float(text.replace(",", "")) == 0:
        text = text.lstrip("-")  # no minus before a zero
    whole, point, rest = text.replace("-", "−").partition(".")
    if len(whole.lstrip("−")) <= 5:  # four digits are read without help
        whole = whole.replace(",", "")
    return whole.replace(",", THIN) + point + rest
