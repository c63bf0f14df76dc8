"""Numbers, symbols, channels and conditions as people read them, always with the true unit."""

import math
import re
from collections.abc import Collection, Mapping, Sequence

from markupsafe import Markup, escape

from sealfit.config import Config
from sealfit.ingest.columns import UNAGED
from sealfit.tables import HISTORY
from sealfit.units import Units

NOTHING = "–"
THIN = "\u202f"  # narrow no-break space: between thousands, and around the cross of a power of ten
_UP = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
SMALL, LARGE = 1e-4, 1e6  # outside of these a power of ten is taken out


def known(value: object) -> bool:
    """Return whether `value` is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def number(value: float | None, digits: int = 3) -> str:
    """Return `value` to `digits` significant digits; a dash if there is none.

    >>> number(0.61234), number(-12.3456), number(1752.4), number(0.0), number(1.234e-5)
    ('0.612', '−12.3', '1752', '0', '1.23\u202f×\u202f10⁻⁵')
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
    """Return a number that was set, without trailing zeros.

    >>> given(0.5), given(10.02), given(1752.0)
    ('0.5', '10', '1752')
    """
    text = number(value, digits) if known(value) else NOTHING
    return text.rstrip("0").rstrip(".") if "." in text and "×" not in text else text


def decimals(size: float, digits: int = 2) -> int:
    """Return how many decimals show `size` to `digits` significant digits; negative left of the point.

    >>> decimals(0.0123), decimals(0.0996), decimals(3.4), decimals(456.0)
    (3, 2, 1, -1)
    """
    size = abs(float(size))
    if size == 0 or not math.isfinite(size):
        return 0
    rounded = float(f"{size:.{digits - 1}e}")  # 0.0996 is 0.10: one decimal less than its own exponent says
    return digits - 1 - math.floor(math.log10(rounded) + 1e-12)


def measured(value: float | None, lo: float | None, hi: float | None) -> tuple[str, str]:
    """Return a value and its interval, rounded to two significant digits of the interval's shorter side.

    >>> measured(6.123, 5.513, 6.7012), measured(1.5, 0.25, 21.0), measured(4.0, None, 5.5)
    (('6.12', '[5.51, 6.70]'), ('1.5', '[0.2, 21.0]'), ('4.00', 'up to 5.50'))
    """
    if not known(value):
        return NOTHING, NOTHING
    if not (known(lo) and known(hi)):
        end = f"from {number(lo)}" if known(lo) else f"up to {number(hi)}" if known(hi) else NOTHING
        return number(value), end
    if hi == lo:
        return number(value), f"[{number(lo)}, {number(hi)}]"
    power = _power(max(abs(value), abs(lo), abs(hi)))
    value, lo, hi = (x / 10.0**power for x in (value, lo, hi))
    sides = [side for side in (value - lo, hi - value) if side > 0] or [hi - lo]
    places = min(decimals(min(sides)), 9)
    tail = _times_ten(power)
    return _fixed(value, places) + tail, f"[{_fixed(lo, places)}, {_fixed(hi, places)}]" + tail


def together(values: Sequence[float | None]) -> list[str]:
    """Return numbers of one unit with the same decimals: the smallest shows two significant ones."""
    sizes = [abs(value) for value in values if known(value) and value != 0]
    if not sizes:
        return [number(value) for value in values]
    power = _power(max(sizes))
    largest = decimals(max(sizes) / 10.0**power, 4)  # one tiny value does not give the others nine decimals
    places = min(decimals(min(sizes) / 10.0**power), largest)
    return [_fixed(v / 10.0**power, places) + _times_ten(power) if known(v) else NOTHING for v in values]


def p_value(p: float | None) -> str:
    """Return a p-value with its sign: "= 0.012", "< 0.001"."""
    if not known(p):
        return "not available"
    if p < 0.001:
        return "< 0.001"
    if p > 0.99:
        return "> 0.99"
    return f"= {p:.{decimals(p, 2)}f}"


def of_unit(text: str, unit: str) -> str:
    """Return a number with its unit, without a line break between them."""
    return f"{text} {unit}".strip().replace(" ", "\u00a0")


def count(n: int, one: str, many: str | None = None) -> str:
    """Return "1 file", "3 files"."""
    return f"{_fixed(float(n), 0)} {one if n == 1 else many or one + 's'}"


def _power(value: float) -> int:
    size = abs(value)
    return math.floor(math.log10(size)) if size and not SMALL <= size < LARGE else 0


def _times_ten(power: int) -> str:
    return f"{THIN}×{THIN}10{str(power).translate(_UP)}" if power else ""


def _fixed(value: float, places: int) -> str:
    text = f"{round(value, places):,.{max(places, 0)}f}"
    if float(text.replace(",", "")) == 0:
        text = text.lstrip("-")  # no minus before a zero
    whole, point, rest = text.replace("-", "−").partition(".")
    if len(whole.lstrip("−")) <= 5:  # four digits are read without help
        whole = whole.replace(",", "")
    return whole.replace(",", THIN) + point + rest


# ---------------------------------------------------------------- symbols

GREEK = {
    "alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "epsilon": "ε", "zeta": "ζ", "eta": "η",
    "theta": "θ", "kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "xi": "ξ", "rho": "ρ", "sigma": "σ",
    "tau": "τ", "phi": "φ", "chi": "χ", "psi": "ψ", "omega": "ω",
}  # fmt: skip
_SYMBOL = re.compile(rf"({'|'.join(GREEK)}|[A-Za-z])(?:_?([0-9]+)|_([A-Za-z0-9]{{1,4}}))?")
_SLOTS = ("speed_set_mm_s", "displacement_from_mm", "displacement_to_mm", "displacement_mm", "distance_mm",
          "speed_mm_s", "force_N", "load_N", "time_s", "aging_days", "temperature_C",
          "compression_ratio_pct", *HISTORY)  # fmt: skip


def symbol_html(name: str) -> Markup:
    """Return a parameter's symbol as HTML, with an upright s below an italic μ; other names as they are."""
    word, sub = _split(name)
    if word is None:
        return escape(name)
    letter = Markup("<i>{}</i>").format(GREEK.get(word, word))
    return letter + Markup("<sub>{}</sub>").format(sub) if sub else letter


def symbol_plain(name: str) -> str:
    """Return a parameter's symbol as plain text: "μ_s"."""
    word, sub = _split(name)
    letter = GREEK.get(word, word)
    return name if word is None else f"{letter}_{sub}" if sub else letter


def symbol_math(name: str) -> str:
    r"""Return a parameter's symbol for a plot, in matplotlib's mathtext.

    >>> symbol_math("mu_s"), symbol_math("cost$")
    ('$\\mu_{\\mathrm{s}}$', 'cost\\$')
    """
    word, sub = _split(name)
    if word is None:
        return plain(name)
    letter = f"\\{word}" if word in GREEK else word
    return f"${letter}_{{\\mathrm{{{sub}}}}}$" if sub else f"${letter}$"


def _split(name: str) -> tuple[str | None, str]:
    found = _SYMBOL.fullmatch(str(name))
    return (None, "") if found is None else (found[1], found[2] or found[3] or "")


def plain(text: object) -> str:
    """Return text for a plot, with dollar signs escaped."""
    return str(text).replace("$", r"\$")


def short(text: object, longest: int = 34) -> str:
    """Return text cut to `longest` characters, with an ellipsis where it was cut."""
    text = str(text)
    return text if len(text) <= longest else text[: longest - 1].rstrip() + "…"


def _slot(names: Collection[str] = ()) -> re.Pattern:
    """Return a pattern of the slots and of those of a campaign's own columns that words would not contain."""
    found = sorted({*_SLOTS, *(name for name in names if "_" in name)}, key=len, reverse=True)
    return re.compile(rf"\b(?:{'|'.join(map(re.escape, found))})\b")


def true_units(text: str, units: Units, names: Collection[str] = ()) -> str:
    """Return a sentence with each name of a slot, or of `names`, replaced by its quantity and unit."""
    return _slot(names).sub(lambda found: channel_label(found[0], units), str(text))


def channel_label(name: str, units: Units) -> str:
    """Return a channel with its unit: "sliding distance (mm)"; a campaign's own column keeps its name."""
    quantity, unit = channel_words(name, units), units.of(name)
    return f"{quantity} ({unit})" if unit else quantity


def channel_words(name: str, units: Units) -> str:
    """Return a channel's name in words, without its unit."""
    special = {
        "displacement_from_mm": f"{units.quantity('displacement')} at the window's start",
        "displacement_to_mm": f"{units.quantity('displacement')} at the window's end",
        "speed_set_mm_s": f"commanded {units.quantity('speed').removeprefix('sliding ')}",
        "specimen_id": "specimen",
        "run_id": "run",
    }
    if name in special:
        return special[name]
    unit, label = units.of(name), units.label(name)
    return label.removesuffix(f" ({unit})") if unit else label


def effect_label(effect: Mapping, units: Units) -> str:
    """Return an effect's label in words, slots and the force by their quantity, without the target."""
    target = rf", (?:added to|factor on) {re.escape(effect['acts_on'])}(?=,|$)"
    force = units.quantity("force").removeprefix("friction ")
    label = re.sub(r"\bforce\b", force, re.sub(target, "", effect["label"]))
    return _slot(effect["channels"]).sub(lambda found: channel_words(found[0], units), label)


class ConditionNames:
    """Short names of conditions and series of a config: values with units.

    >>> names = ConditionNames(Config())
    >>> names("temperature_C=60, compression_ratio_pct=80, aging_days=4"), names("unaged"), names.key
    ('60 °C · 80 % · 4 d', 'unaged', 'aging temperature · compression ratio · aging time')
    """

    def __init__(self, config: Config) -> None:
        self.columns, self.units = tuple(dict.fromkeys([*config.condition, *config.rubber])), config.units

    def __call__(self, text: object) -> str:
        """Return the short name of a condition or series."""
        values = [self._value(name, value) for name, value in self.parts(text).items()]
        return " · ".join(values) or str(text)

    def parts(self, text: object) -> dict[str, str]:
        """Return {column: value} of a condition's name; empty for "unaged"."""
        marks = "|".join(re.escape(name) for name in sorted(self.columns, key=len, reverse=True))
        pieces = re.split(rf"(?:^|, )({marks})=", str(text))
        if pieces[0]:
            return {}
        return dict(zip(pieces[1::2], pieces[2::2], strict=True))

    def place(self, text: object) -> tuple[bool, list]:
        """Return a sort key of conditions and series: unaged first, then by the numbers of their names."""
        return not is_unaged(text), natural(self(text))

    @property
    def key(self) -> str:
        """The names of the values, in their order; "" for a single one."""
        names = [channel_words(name, self.units) for name in self.columns]
        return " · ".join(names) if len(names) > 1 else ""

    def _value(self, name: str, value: str) -> str:
        if not re.fullmatch(r"-?[0-9.]+(e[-+]?[0-9]+)?", value):
            return value
        unit = self.units.of(name)
        return f"{value} {unit}" if unit else f"{channel_words(name, self.units)} {value}"


def is_unaged(text: object) -> bool:
    """Return whether a condition or series is that of unaged rubber."""
    return str(text) == UNAGED or str(text).startswith(f"{UNAGED}, ")


def joined(words: Sequence[str]) -> str:
    """Return "a", "a and b", "a, b and c"."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def capital(text: str) -> str:
    """Return text with its first letter large."""
    return text[:1].upper() + text[1:]


def by_number(text: str) -> tuple[int, float, str]:
    """Return a sort key that puts texts that are numbers by their size and before the others."""
    try:
        return 0, float(text), ""
    except ValueError:
        return 1, 0.0, text


def is_number(text: str) -> bool:
    """Return whether text is a number."""
    return by_number(text)[0] == 0


def natural(text: str) -> list[tuple[int, float, str]]:
    """Return a sort key that puts 9 before 10, word by word."""
    return [by_number(word) for word in text.split()]
