"""The true unit of every column: what a slot such as `force_N` holds; a config may declare another quantity and unit.

Column names are fixed (design: "Units"); `Units.of` gives the true unit, and that is what the Parquet metadata and
every label show.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

_DEFAULT = {
    "force": ("friction force", "N"),
    "displacement": ("displacement", "mm"),
    "speed": ("sliding speed", "mm/s"),
    "load": ("normal load", "N"),
    "time": ("time", "s"),
}


@dataclass(frozen=True, slots=True)
class Units:
    """The true unit of each slot: `Units({"force": ("torque", "mN m")})` when a config declares one.

    Keys are quantities (`force`, `displacement`, `speed`, `load`, `time`); values are (quantity name, unit).
    """

    declared: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    channels: Mapping[str, str] = field(default_factory=dict)  # units of the campaign's own channels

    def quantity(self, slot: str) -> str:
        """Return the true name of a slot's quantity, e.g. "torque" for `force`."""
        return {**_DEFAULT, **self.declared}[slot][0]

    def unit(self, slot: str) -> str:
        """Return the true unit of `force`, `displacement`, `speed`, `load` or `time`."""
        return {**_DEFAULT, **self.declared}[slot][1]

    def of(self, column: str) -> str:
        """Return the true unit of a column by its name; "" if it has none that we know."""
        if column in self.channels:
            return self.channels[column]
        if column.startswith(("displacement", "distance")) and column.endswith("_mm"):
            return self.unit("displacement")
        if column.startswith("speed") and column.endswith("_mm_s"):
            return self.unit("speed")
        if column == "time_s":
            return self.unit("time")
        if column.startswith("load") and column.endswith("_N"):
            return self.unit("load")
        if column.endswith("_N"):
            return self.unit("force")
        if column in _KNOWN:
            return _KNOWN[column]
        for ending, unit in _ENDINGS.items():
            if column.endswith(ending):
                return unit
        return ""

    def label(self, column: str) -> str:
        """Return an axis label with the true quantity and unit, e.g. "torque (mN m)"."""
        slots = {
            "force_N": "force",
            "displacement_mm": "displacement",
            "speed_mm_s": "speed",
            "load_N": "load",
            "time_s": "time",
        }
        if column in slots:
            return f"{self.quantity(slots[column])} ({self.unit(slots[column])})"
        unit = self.of(column)
        words = _MEANING.get(column, column if not unit else _without_unit(column)).replace("_", " ")
        return f"{words} ({unit})" if unit else words


_ENDINGS = {"_C": "°C", "_pct": "%", "_days": "d", "_h": "h", "_s": "s", "_mm": "mm", "_N": "N", "_bar": "bar"}
_KNOWN = {"aging_days": "d", "temperature_C": "°C", "compression_ratio_pct": "%", "elapsed_h": "h"}
_MEANING = {
    "distance_mm": "sliding distance",
    "run_order": "run order",
    "elapsed_h": "time since first run",
    "aging_days": "aging time",
    "temperature_C": "aging temperature",
    "compression_ratio_pct": "compression ratio",
    "speed_set_mm_s": "commanded speed",
    "power": "sliding power (load times speed)",
}


def _without_unit(column: str) -> str:
    for ending in ("_mm_s", *_ENDINGS):
        if column.endswith(ending):
            return column.removesuffix(ending)
    return column
