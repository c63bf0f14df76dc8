"""Cells of runs.csv and of file names to values: which columns are numbers, which are labels, and what cannot be."""

from __future__ import annotations

import math

import numpy as np

from sealfit.config import Config
from sealfit.errors import Fault
from sealfit.ingest.coded import Coded, Columns
from sealfit.ingest.names import TEXT_COLUMNS
from sealfit.ingest.runs_csv import Entries
from sealfit.ingest.text import as_number

NUMBERS = ("temperature_C", "compression_ratio_pct", "aging_days", "load_N", "speed_mm_s")
COUNTS = {"repeat": "repeats", "stroke": "strokes"}  # whole numbers
_MOSTLY = 0.8  # a column with this share of numbers is one of numbers, and the rest of its cells are slips


def to_values(entries: Entries, columns: Columns, config: Config) -> tuple[Columns, list[Fault]]:
    """Return the columns as numbers or as labels, and faults of cells that are neither.

    A column of numbers is one whose name says so, one of the config's condition columns or a channel where more than
    four fifths of the cells are numbers, and any where all are.
    """
    faults: list[Fault] = []
    made: Columns = {}
    for name, cells in columns.items():
        made[name], found = _column(name, cells, entries, config)
        faults += found
    return made, faults


def _column(name: str, cells: Coded, entries: Entries, config: Config) -> tuple[Coded, list[Fault]]:
    labels = cells.map(lambda cell: cell if isinstance(cell, str) else f"{cell:g}")
    if name in TEXT_COLUMNS:
        return labels, []
    number = [cell if isinstance(cell, float) else as_number(cell) for cell in cells.values]
    bad = [value is None or not math.isfinite(value) for value in number]
    wrong = np.flatnonzero(np.array([*bad, False], bool)[cells.codes])
    count = int(cells.known.sum())
    known = name in NUMBERS or name in COUNTS
    if len(wrong) and not known and len(wrong) >= (1 - _MOSTLY) * count:
        return labels, []
    if len(wrong) and not known and name not in config.condition:
        i = int(wrong[0])
        reason = f"{len(wrong)} of {count} cells are no numbers; the column is kept as labels."
        fix = "Empty the cell, or put a number there."
        place = {"severity": "warning", "action": "kept", "value": labels[i], "fix": fix}
        return labels, [entries[i].fault("not_a_number", reason, name, **place)]
    fix = "Put a number there."
    faults = [
        entries[i].fault("not_a_number", "is not a number.", name, value=labels[i], fix=fix) for i in wrong.tolist()
    ]
    # nan: not missing, but wrong
    values = Coded(cells.codes, [math.nan if value is None else value for value in number])
    if name not in COUNTS:
        return values, faults
    fix = f"Number the {COUNTS[name]} 1, 2, 3."
    faults += [
        entries[i].fault("not_a_number", "is no whole number.", name, value=values[i], fix=fix)
        for i in np.flatnonzero(values.where(lambda value: math.isfinite(value) and value != int(value))).tolist()
    ]
    return values.map(lambda value: int(value) if math.isfinite(value) else -1), faults


def out_of_range(entries: Entries, columns: Columns) -> list[Fault]:
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
    found = [
        (i, entries[i].fault("out_of_range", reason, name, value=columns[name][i], fix=fix))
        for name, wrong, reason, fix in rules
        if name in columns
        for i in np.flatnonzero(columns[name].where(wrong)).tolist()
    ]
    return [fault for _, fault in sorted(found, key=lambda one: one[0])]
