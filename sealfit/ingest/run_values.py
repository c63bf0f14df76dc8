"""Cells of runs.csv and of file names to values: which columns are numbers, which are labels, and what cannot be."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from sealfit.config import Config
from sealfit.errors import Fault
from sealfit.ingest.derive import Channels
from sealfit.ingest.names import TEXT_COLUMNS
from sealfit.ingest.runs_csv import Entry
from sealfit.ingest.text import as_number

NUMBERS = ("temperature_C", "compression_ratio_pct", "aging_days", "load_N", "speed_mm_s")
MISSING = {"", "na", "n/a", "#n/a", "nan", "null", "none", "-", "?"}
_MOSTLY = 0.8  # a column with this share of numbers is one of numbers, and the rest of its cells are slips


def to_values(
    entries: Sequence[Entry], files: Sequence[Channels], config: Config
) -> tuple[list[Channels], list[Fault]]:
    """Return the files with every column as numbers or as labels, and faults of cells that are neither.

    A column of numbers is one whose name says so, one of the config's condition columns or a channel where more than
    four fifths of the cells are numbers, and any where all are.
    """
    columns: dict[str, dict[int, float | str]] = {}
    for i, channels in enumerate(files):
        for name, value in channels.items():
            columns.setdefault(name, {})[i] = value
    faults: list[Fault] = []
    made: list[Channels] = [{} for _ in files]
    for name, cells in columns.items():
        values, found = _column(name, cells, entries, config)
        faults += found
        for i, value in values.items():
            made[i][name] = value
    return made, faults


def _column(
    name: str, cells: Mapping[int, float | str], entries: Sequence[Entry], config: Config
) -> tuple[Mapping[int, float | str], list[Fault]]:
    # Every different cell is looked at once: a campaign has many files of few temperatures.
    label = {cell: cell if isinstance(cell, str) else f"{cell:g}" for cell in set(cells.values())}
    if name in TEXT_COLUMNS:
        return {i: label[cell] for i, cell in cells.items()}, []
    number = {cell: cell if isinstance(cell, float) else as_number(cell) for cell in label}
    bad = {cell for cell, value in number.items() if value is None or not math.isfinite(value)}
    wrong = [i for i, cell in cells.items() if cell in bad] if bad else []
    known = name in NUMBERS or name == "repeat"
    if wrong and not known and len(wrong) >= (1 - _MOSTLY) * len(cells):
        return {i: label[cell] for i, cell in cells.items()}, []
    if wrong and not known and name not in config.condition:
        i = wrong[0]
        reason = f"{len(wrong)} of {len(cells)} cells are no numbers; the column is kept as labels."
        mend = "Empty the cell, or put a number there."
        place = {"severity": "warning", "action": "kept", "value": label[cells[i]], "mend": mend}
        labels = {i: label[cell] for i, cell in cells.items()}
        return labels, [entries[i].fault("not_a_number", reason, name, **place)]
    mend = "Put a number there."
    faults = [
        entries[i].fault("not_a_number", "is not a number.", name, value=label[cells[i]], mend=mend) for i in wrong
    ]
    number |= {cell: math.nan for cell, value in number.items() if value is None}  # nan: not missing, but wrong
    values = {i: number[cell] for i, cell in cells.items()}
    if name != "repeat":
        return values, faults
    broken = [i for i, value in values.items() if math.isfinite(value) and value != int(value)]
    mend = "Number the repeats 1, 2, 3."
    faults += [
        entries[i].fault("not_a_number", "is no whole number.", name, value=values[i], mend=mend) for i in broken
    ]
    return {i: int(value) if math.isfinite(value) else -i for i, value in values.items()}, faults


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
