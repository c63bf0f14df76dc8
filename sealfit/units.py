"""The true unit of every column: what a slot such as `force_N` holds.

A config may declare another quantity and unit. Column names are fixed; `Units.of` gives the true unit.
Numbers of files that are in other units are converted by `conversion`, once, when they are read.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cache

from sealfit.errors import ConfigError

_DEFAULT = {
    "force": ("friction force", "N"),
    "displacement": ("displacement", "mm"),
    "speed": ("sliding speed", "mm/s"),
    "load": ("normal load", "N"),
    "time": ("time", "s"),
}


@dataclass(frozen=True, slots=True)
class Units:
    """The true unit of each slot: `Units({"force": ("torque", "mN m")})` when a config declares one."""

    declared: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    channels: Mapping[str, str] = field(default_factory=dict)  # units of the campaign's own channels

    def quantity(self, slot: str) -> str:
        """Return the true name of a slot's quantity, e.g. "torque" for `force`."""
        return {**_DEFAULT, **self.declared}[slot][0]

    def unit(self, slot: str) -> str:
        """Return the true unit of `force`, `displacement`, `speed`, `load` or `time`."""
        return {**_DEFAULT, **self.declared}[slot][1]

    @property
    def speed_factor(self) -> float:
        """What turns displacement unit per time unit into the speed's: 60 for turn, s and rpm, 1 for mm/s.

        ConfigError if the units do not fit together (turn and mm/s), or are not known to pint and not spelled
        "<displacement>/<time>".

        >>> Units({"displacement": ("angle", "turn"), "speed": ("speed", "rpm")}).speed_factor
        60.0
        """
        displacement, time, speed = (self.unit(slot) for slot in ("displacement", "time", "speed"))
        try:
            return conversion(f"{displacement}/{time}", speed).factor
        except ConfigError as error:
            reason = f"displacement in {displacement!r} over time in {time!r} gives no speed in {speed!r}."
            fix = f"Declare the speed's unit as '{displacement}/{time}', or one of its dimension."
            raise ConfigError(reason, fix=fix) from error

    def of(self, column: str) -> str:
        """Return the true unit of a column by its name; "" if it has none that we know."""
        if column in self.channels:
            return self.channels[column]
        if column.startswith(("displacement", "distance", "rise_mm")) and column.endswith("_mm"):
            return self.unit("displacement")
        if column.startswith("speed") and column.endswith("_mm_s"):
            return self.unit("speed")
        if column == "time_s":
            return self.unit("time")
        if column.endswith("_N"):
            return self.unit("load" if column.startswith("load") else "force")
        if column == "power":
            return f"{self.unit('load')} {self.unit('speed')}"
        return next((unit for ending, unit in _ENDINGS.items() if column.endswith(ending)), "")

    def label(self, column: str) -> str:
        """Return an axis label with the true quantity and unit, e.g. "torque (mN m)"."""
        if column in ("force_N", "displacement_mm", "speed_mm_s", "load_N", "time_s"):
            slot = column.partition("_")[0]
            return f"{self.quantity(slot)} ({self.unit(slot)})"
        unit = self.of(column)
        ending = next((e for e in _ENDINGS if column.endswith(e)), "") if unit else ""
        words = _MEANING.get(column, column.removesuffix(ending)).replace("_", " ")
        return f"{words} ({unit})" if unit else words


_ENDINGS = {
    "_mm_s": "mm/s",
    "_m_s": "m/s",
    "_C": "°C",
    "_pct": "%",
    "_days": "d",
    "_h": "h",
    "_s": "s",
    "_mm": "mm",
    "_N": "N",
    "_bar": "bar",
}
_MEANING = {
    "distance_mm": "sliding distance",
    "run_order": "run order",
    "elapsed_h": "time since first run",
    "specimen_use": "use of the specimen",
    "aging_days": "aging time",
    "temperature_C": "aging temperature",
    "compression_ratio_pct": "compression ratio",
    "speed_set_mm_s": "commanded speed",
    "power": "sliding power (load times speed)",
}


# ---------------------------------------------------------------- conversion by pint

_FAR = 1000.0  # a scale with an offset is read here and at 0: its factor then keeps all digits


@dataclass(frozen=True, slots=True)
class Conversion:
    """From the unit of a file's numbers to ours: a number or an array times `factor`, plus `offset`."""

    factor: float = 1.0
    offset: float = 0.0

    def __call__(self, value):
        """Return the value in our unit."""
        return value * self.factor + self.offset

    def of_cell(self, value: float) -> float:
        """Return a number that somebody typed, in our unit, to 12 digits: 60, not 60.00000000000006."""
        return float(f"{self(value):.12g}")


@cache
def conversion(unit: str, to: str) -> Conversion:
    """Return the conversion of numbers in `unit` to the unit `to`, as pint reads them: kgf, mm/min, degF.

    ConfigError if `unit` is unknown or of another dimension than `to`; the fix names the nearest unit.

    >>> conversion("kgf", "N")(2.0), round(conversion("degF", "degC")(212.0), 9)
    (19.6133, 100.0)
    """
    if unit == to:
        return Conversion()
    registry = _registry()
    ours, theirs = _dimension(to), _dimension(unit)
    if ours is None:
        reason = f"nothing can be converted to {to!r}, which is no known unit."
        raise ConfigError(reason, fix="Drop the unit.")
    if theirs != ours:
        found = f"{unit!r} is no known unit"
        if theirs is not None:
            found = f"the unit {unit!r} is one of {_measured(unit)}"
        raise ConfigError(f"{found}; {_measured(to)} ({to}) is expected.", fix=_nearest(unit, ours))

    def converted(value: float) -> float:
        return float(registry.Quantity(value, registry.Unit(unit)).m_as(registry.Unit(to)))

    offset = converted(0.0)
    if offset == 0:
        return Conversion(converted(1.0))
    return Conversion((converted(_FAR) - offset) / _FAR, offset)


def other_unit(said: str, unit: str) -> str | None:
    """Return the unit that a header says, if it is not `unit`: "" for one of another dimension; else None.

    A unit that is not known says nothing.

    >>> other_unit("kN", "N"), other_unit("kg", "N"), other_unit("V", "N")
    ('kN', 'kgf', '')
    >>> other_unit("kg", "kgf"), other_unit("Sek", "s")
    (None, None)
    """
    if said == unit or not said[:1].isalpha():
        return None
    own, ours = unit_of(said), _dimension(unit)
    spelled = (said.lower(), said, said if own is None else own.name)  # MM stands for mm, and kg for kgf
    found = [_dimension(one) for one in spelled]
    if ours is None or all(one is None for one in found):
        return None
    known = [name for name, one in zip(spelled, found, strict=True) if one == ours]
    if any(abs(conversion(name, unit).factor - 1.0) < 1e-9 for name in known):
        return None
    return known[0] if known else ""


@cache
def _registry():
    import pint  # here, as it takes half a second to load and few configs name a unit

    registry = pint.UnitRegistry(on_redefinition="ignore")
    for length in ("", "c", "m"):  # pint's own Nm is one of textiles, metres per gram
        registry.define(f"newton_{length}m = newton * {length}m = N{length}m")
    registry.define("umdrehung = turn = U")  # pint's own U is one of enzymes
    return registry


@cache
def _dimension(unit: str) -> Hashable | None:
    """Return what dimension a unit is of; None if there is no such unit."""
    try:
        return _registry().Unit(unit).dimensionality
    except Exception:  # pint raises whatever the parser of Python does: a dozen kinds of errors
        return None


def _measured(unit: str) -> str:
    """Return what a unit that pint knows measures."""
    dimension = _dimension(unit)
    for known in (UNITS.get(unit), *UNITS.values()):  # its own entry first: N m is a torque, not a work
        if known is not None and known.dimension != "none" and _dimension(known.name) == dimension:
            return known.dimension
    return re.sub(r"[\[\]]", "", str(dimension))


def _nearest(unit: str, dimension: Hashable) -> str:
    """Return a fix: the unit of that dimension that is written most like `unit`."""
    own = [name for name in {known.name: None for known in UNITS.values()} if _dimension(name) == dimension]
    close = get_close_matches(unit, own, n=1, cutoff=0.3)
    named = close or [one for one in own if one.lower() == unit.lower()]
    return f"Did you mean '{named[0]}'?" if named else f"Units: {', '.join(own)}." if own else ""


# ---------------------------------------------------------------- spellings


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit: what it measures, and its name in a config, which is pint's where it can be converted."""

    dimension: str
    name: str

    @property
    def suffix(self) -> str:
        """The unit as the end of a column's name, e.g. "mm_s"."""
        return {"degC": "C", "%": "pct"}.get(self.name, re.sub("[/ ]", "_", self.name))


_LENGTHS = {"mm": "mm", "m": "m", "cm": "cm", "um": "um", "µm": "um", "μm": "um", "in": "in", "inch": "in"}
_TIMES = {"s": "s", "sec": "s", "min": "min", "h": "h"}
_SPELLINGS = {
    ("time", "s"): ("s", "sec", "secs", "second", "seconds", "sek", "sekunden"),
    ("time", "ms"): ("ms", "msec", "millisec", "milliseconds"),
    ("time", "us"): ("us", "µs", "μs"),
    ("time", "min"): ("min", "minutes", "minuten"),
    ("time", "h"): ("h", "hr", "hours", "std", "stunden"),
    ("time", "d"): ("d", "days", "day", "tage", "tag"),
    ("time", "week"): ("wk", "week", "weeks", "woche", "wochen", "semaines"),
    ("time", "month"): ("month", "months", "monat", "monate", "mois", "mes", "meses", "mesi"),
    ("time", "year"): ("yr", "year", "years", "jahr", "jahre"),
    ("length", "ft"): ("ft",),
    ("force", "N"): ("N",),
    ("force", "kN"): ("kN",),
    ("force", "mN"): ("mN",),
    ("force", "daN"): ("daN",),
    ("force", "uN"): ("uN", "µN", "μN"),
    ("force", "lbf"): ("lbf", "lb", "lbs"),
    ("force", "kgf"): ("kgf", "kp", "kg"),
    ("force", "gf"): ("gf", "g"),
    ("rotation", "rpm"): ("rpm", "1/min", "U/min", "min-1"),
    ("torque", "N m"): ("Nm", "N m", "N*m", "N·m"),
    ("torque", "mN m"): ("mNm", "mN m", "mN*m", "mN·m"),
    ("torque", "N cm"): ("Ncm", "N cm", "N*cm", "N·cm"),
    ("torque", "N mm"): ("Nmm", "N mm", "N*mm", "N·mm"),
    ("angle", "deg"): ("deg", "°", "degrees"),
    ("angle", "rad"): ("rad",),
    ("angle", "turn"): ("turn", "turns", "rev", "U"),
    ("temperature", "degC"): ("°C", "C", "degC", "deg C", "Grad C", "ºC"),
    ("temperature", "degF"): ("°F", "F", "degF", "deg F", "ºF"),
    ("temperature", "K"): ("K", "kelvin"),
    ("share", "%"): ("%", "pct", "percent", "prozent", "Prozent"),
    ("pressure", "bar"): ("bar",),
    ("pressure", "mbar"): ("mbar",),
    ("pressure", "kPa"): ("kPa",),
    ("stress", "MPa"): ("MPa",),
    ("none", "1"): ("-", "1", "segments", "counts", "cycles"),
}
UNITS = {
    **{spelled: Unit(*unit) for unit, spellings in _SPELLINGS.items() for spelled in spellings},
    **{spelled: Unit("length", unit) for spelled, unit in _LENGTHS.items()},
    **{
        f"{length}/{time}": Unit("speed", f"{_LENGTHS[length]}/{_TIMES[time]}")
        for length in _LENGTHS
        for time in _TIMES
    },
    **{spelled: Unit("none", spelled) for spelled in ("V", "mV", "A", "Hz", "kHz", "mV/V", "mm/mm")},
}
_BY_LOWER = {spelled.lower(): unit for spelled, unit in reversed(UNITS.items())}


def unit_of(text: str) -> Unit | None:
    """Return the unit that a text is, brackets around it or not; None if it is none that is known.

    >>> unit_of("[kN]").name, unit_of("Sec").name, unit_of("(µm)").name, unit_of("Weg")
    ('kN', 's', 'um', None)
    """
    bare = text.strip().strip("[]()<>{}").strip()
    return UNITS.get(bare) or _BY_LOWER.get(bare.lower())
