"""Symbols, channels and conditions as people read them: in HTML, in a plot, and always with the true unit."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from sealfit.conditions import UNAGED
from sealfit.config import Config
from sealfit.units import Units

GREEK = {
    "alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "epsilon": "ε", "zeta": "ζ", "eta": "η", "theta": "θ",
    "kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "xi": "ξ", "rho": "ρ", "sigma": "σ", "tau": "τ", "phi": "φ",
    "chi": "χ", "psi": "ψ", "omega": "ω",
}  # fmt: skip
_SYMBOL = re.compile(rf"({'|'.join(GREEK)}|[A-Za-z])(?:_?([0-9]+)|_([A-Za-z0-9]{{1,4}}))?")
_SLOTS = ("speed_set_mm_s", "displacement_from_mm", "displacement_to_mm", "displacement_mm", "distance_mm",
          "speed_mm_s", "force_N", "load_N")  # fmt: skip
_SLOT = re.compile(rf"\b(?:{'|'.join(_SLOTS)})\b")
_STATISTICS = {"rmse_N": "rms error", "reduced_chi2": "χ² / df", "lack_of_fit_p": "lack of fit, p", "n_runs": "runs",
               "n_files": "files", "n_speeds": "speeds", "n_days": "days tested", "last_day": "last day",
               "rmse": "rms error", "max_error_pct": "largest error",
               "specimen_sd_pct": "specimen scatter"}  # fmt: skip


def symbol_html(name: str) -> Markup:
    """Return a parameter's symbol as HTML: mu_s as an italic mu with an upright s below; other names as they are.

    Examples
    --------
    >>> str(symbol_html("mu_s")), str(symbol_html("<b>"))
    ('<i>μ</i><sub>s</sub>', '&lt;b&gt;')
    """
    base, sub = _split(name)
    if base is None:
        return escape(name)
    return Markup("<i>{}</i><sub>{}</sub>").format(base, sub) if sub else Markup("<i>{}</i>").format(base)


def symbol_plain(name: str) -> str:
    """Return a parameter's symbol as plain text: "μ_s".

    Examples
    --------
    >>> symbol_plain("sigma_2"), symbol_plain("rate")
    ('σ_2', 'rate')
    """
    base, sub = _split(name)
    return name if base is None else f"{base}_{sub}" if sub else base


def symbol_math(name: str) -> str:
    r"""Return a parameter's symbol for a plot, in matplotlib's mathtext.

    Examples
    --------
    >>> symbol_math("mu_s"), symbol_math("cost$")
    ('$\\mu_{\\mathrm{s}}$', 'cost\\$')
    """
    base, sub = _split(name)
    if base is None:
        return plain(name)
    letter = next((f"\\{word}" for word, sign in GREEK.items() if sign == base), base)
    return f"${letter}_{{\\mathrm{{{sub}}}}}$" if sub else f"${letter}$"


def _split(name: str) -> tuple[str | None, str]:
    found = _SYMBOL.fullmatch(str(name))
    if found is None:
        return None, ""
    return GREEK.get(found[1], found[1]), found[2] or found[3] or ""


def plain(text: object) -> str:
    """Return text for a plot as it stands: a dollar sign in a column's name starts no formula."""
    return str(text).replace("$", r"\$")


def short(text: object, longest: int = 34) -> str:
    """Return text cut to `longest` characters, with an ellipsis where it was cut."""
    text = str(text)
    return text if len(text) <= longest else text[: longest - 1].rstrip() + "…"


def true_units(text: str, units: Units) -> str:
    """Return a sentence with every slot's name put as its true quantity and unit.

    Examples
    --------
    >>> true_units("force_N is stuck", Units({"force": ("torque", "mN m")}))
    'torque (mN m) is stuck'
    """
    return _SLOT.sub(lambda found: channel_label(found[0], units), str(text))


def channel_label(name: str, units: Units) -> str:
    """Return a channel with its unit, e.g. "sliding distance (mm)"; a column of the campaign's own keeps its name.

    Examples
    --------
    >>> channel_label("displacement_mm", Units({"displacement": ("angle", "turn")})), channel_label("batch", Units())
    ('angle (turn)', 'batch')
    """
    quantity, unit = channel_words(name, units), units.of(name)
    return f"{quantity} ({unit})" if unit else quantity


def channel_words(name: str, units: Units) -> str:
    """Return a channel's name in words, without its unit."""
    special = {
        "distance_mm": "sliding distance",
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


def split_channels(text: str | None, known: Collection[str]) -> list[str]:
    """Return the channels whose names, joined by spaces, `text` is.

    A column's own name may hold spaces, so the names that are known decide where to cut.

    Examples
    --------
    >>> split_channels("direction oil temp", {"direction", "oil temp"})
    ['direction', 'oil temp']
    """
    names, words = [], text.split(" ") if text else []
    while words:
        n = next((n for n in range(len(words), 0, -1) if " ".join(words[:n]) in known), 1)
        names.append(" ".join(words[:n]))
        words = words[n:]
    return names


def effect_label(effect: Mapping, units: Units) -> str:
    """Return an effect's label in words, slots by their true quantity; how it acts is said elsewhere.

    Examples
    --------
    >>> effect = {"label": "ripple along displacement_mm, added to force", "acts_on": "force"}
    >>> effect_label(effect, Units())
    'ripple along displacement'
    """
    label = re.sub(rf", (?:added to|factor on) {re.escape(str(effect.get('acts_on')))}$", "", str(effect["label"]))
    return _SLOT.sub(lambda found: channel_words(found[0], units), label)


def quantity_words(name: str) -> str:
    """Return what a fit's statistic is called."""
    return _STATISTICS.get(name, name.removesuffix("_N").replace("_", " "))


@dataclass(frozen=True)
class ConditionNames:
    """How conditions and series are spelled: values with units, the order said once.

    Examples
    --------
    >>> names = ConditionNames.of(Config())
    >>> names("temperature_C=60, compression_ratio_pct=80, aging_days=4"), names("unaged"), names.key
    ('60 °C · 80 % · 4 d', 'unaged', 'aging temperature · compression ratio · aging time')
    """

    columns: tuple[str, ...]
    units: Units

    @classmethod
    def of(cls, config: Config) -> ConditionNames:
        """Return the names for a config's condition and rubber columns."""
        rubber = [name for name in config.rubber if name not in config.condition]
        return cls((*config.condition, *rubber), config.units)

    def __call__(self, text: object) -> str:
        """Return a condition or series as the tables spell it, in short."""
        parts = self.parts(text)
        if not parts:
            return str(text)
        return " · ".join(self._value(name, value) for name, value in parts.items())

    def parts(self, text: object) -> dict[str, str]:
        """Return {column: value} of a condition as the tables spell it; empty if it is not spelled so (unaged)."""
        marks = "|".join(re.escape(name) for name in sorted(self.columns, key=len, reverse=True))
        pieces = re.split(rf"(?:^|, )({marks})=", str(text))
        if pieces[0]:
            return {}
        return dict(zip(pieces[1::2], pieces[2::2], strict=True))

    def number(self, text: object, column: str) -> float:
        """Return a condition's value of a column as a number; NaN where it has none."""
        try:
            return float(self.parts(text).get(column, "nan"))
        except ValueError:
            return float("nan")

    @property
    def key(self) -> str:
        """What the values stand for, in their order; "" for a single one, which needs no telling apart."""
        if len(self.columns) < 2:
            return ""
        return " · ".join(channel_words(name, self.units) for name in self.columns)

    def _value(self, name: str, value: str) -> str:
        unit = self.units.of(name)
        number = re.fullmatch(r"-?[0-9.]+(e[-+]?[0-9]+)?", value)
        if unit:
            return f"{value} {unit}" if number else value
        return f"{channel_words(name, self.units)} {value}" if number else value


def is_unaged(text: object) -> bool:
    """Return whether a condition or series is that of unaged rubber."""
    return str(text) == UNAGED or str(text).startswith(f"{UNAGED}, ")


def joined(words: Sequence[str]) -> str:
    """Return "a", "a and b", "a, b and c"."""
    words = [str(word) for word in words]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}" if words else ""
