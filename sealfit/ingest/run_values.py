"""Cells of runs.csv and of file names to values: which columns are numbers, which are labels, and what cannot be."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sealfit.config import Config
from sealfit.errors import Fault
from sealfit.ingest.derive import Channels
from sealfit.ingest.names import TEXT_COLUMNS
from sealfit.ingest.runs_csv import Entry
from sealfit.ingest.text import as_number

NUMBERS = ("temperature_C", "compression_ratio_pct", "aging_days", "load_N", "speed_mm_s")
MISSING = {"", "na", "n/a", "#n/a", "nan", "null", "none", "-", "?"}
_MOSTLY = 0.8  # a column with this share of numbers is one of numbers, and the rest of its cells are slips


def to_numbers(entries: Sequence[Entry], files: Sequence[Channels], config: Config) -> list[Fault]:
    """Turn the cells of every column of numbers into numbers, in place; return faults of cells that are none."""
    faults = []
    for name in dict.fromkeys(name for channels in files for name in channels):
        rows = [i for i, channels in enumerate(files) if name in channels]
        if name in TEXT_COLUMNS:
            _as_labels(files, rows, name)
            continue
        numbers = {i: v if isinstance(v := files[i][name], float) else as_number(v) for i in rows}
        wrong = [i for i, number in numbers.items() if number is None or not math.isfinite(number)]
        known = name in NUMBERS or name == "repeat"
        mostly = len(wrong) < (1 - _MOSTLY) * len(rows)
        if wrong and not known and not mostly:
            _as_labels(files, rows, name)
            continue
        if wrong and not known and name not in config.condition:
            i = wrong[0]
            reason = f"{len(wrong)} of {len(rows)} cells are no numbers; the column is kept as labels."
            mend = "Empty the cell, or put a number there."
            place = {"severity": "warning", "action": "kept", "value": str(files[i][name]), "mend": mend}
            faults.append(entries[i].fault("not_a_number", reason, name, **place))
            _as_labels(files, rows, name)
            continue
        for i in wrong:
            mend = "Put a number there."
            faults.append(
                entries[i].fault("not_a_number", "is not a number.", name, value=str(files[i][name]), mend=mend)
            )
        for i, number in numbers.items():
            files[i][name] = number if number is not None else math.nan
    for entry, channels in zip(entries, files, strict=True):
        repeat = channels.get("repeat")
        if repeat is not None and math.isfinite(repeat):
            if repeat != int(repeat):
                mend = "Number the repeats 1, 2, 3."
                faults.append(entry.fault("not_a_number", "is no whole number.", "repeat", value=repeat, mend=mend))
            channels["repeat"] = int(repeat)
    return faults


def _as_labels(files: Sequence[Channels], rows: Sequence[int], name: str) -> None:
    for i in rows:
        value = files[i][name]
        files[i][name] = value if isinstance(value, str) else f"{value:g}"


def out_of_range(entries: Sequence[Entry], files: Sequence[Channels]) -> list[Fault]:
    """Return faults of values that cannot be: negative days, a load that does not press, a speed of zero."""
    rules = (
        ("aging_days", lambda value: value < 0, "is below 0 days.", "Days count from 0, unaged."),
        (
            "load_N",
            lambda value: value <= 0,
            "does not press.",
            "The normal load is above 0; leave it empty if unknown.",
        ),
        ("speed_mm_s", lambda value: value == 0, "is no speed to slide at.", "Leave it empty if it is unknown."),
    )
    return [
        entry.fault("out_of_range", reason, name, value=channels[name], mend=mend)
        for entry, channels in zip(entries, files, strict=True)
        for name, wrong, reason, mend in rules
        if name in channels and wrong(channels[name])
    ]
