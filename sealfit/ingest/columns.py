"""What stands in each column of a trace file: our columns, channels of numbers, or labels."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import pandas as pd

from sealfit.config import Config, TraceFormat
from sealfit.errors import KEPT, NOTED, BadFile, Fault, nearest, shortened
from sealfit.ingest.cells import OTHER_CELLS, OVERLOAD, ColumnOfFile, listed, numbers_of
from sealfit.ingest.expression import parse
from sealfit.ingest.files import Layout, as_number, bad_file, split_line
from sealfit.tables import BINS, RUNS

# ---------------------------------------------------------------- columns
LONGEST_LIST = 400  # characters of the names of columns that a message lists
NO_COLUMN = "there is no such column."
SLOTS = ("time_s", "displacement_mm", "force_N", "load_N")  # always numbers
# Columns that our tables make themselves: a channel of that name in a trace file gets another, `stroke_file`.
RESERVED = ({column.name for schema in (BINS, RUNS) for column in schema.columns} | {"line", "steady"}) - set(
    SLOTS
)


def numeric_names(settings: TraceFormat) -> set[str]:
    """Return the columns that must hold numbers: the slots and what an expression or the integral reads."""
    texts = [parse(text) for text in settings.compute.values()]
    if settings.keep is not None:
        texts.append(parse(settings.keep, condition=True))
    names = set(SLOTS).union(*(text.names for text in texts))
    return names | {settings.integrate_displacement} if settings.integrate_displacement else names


def locate(layout: Layout, width: int, settings: TraceFormat, file: str) -> dict[int, str]:
    """Return our name for each position (from 0) of a file with `width` columns.

    Columns that the config does not list keep the file's name (`column_4` where it has none), or a name
    beside it where the config gives that name to another column.

    Raises
    ------
    BadFile
        If a column is missing or its name stands twice; the nearest name is suggested.
    """
    found: dict[int, str] = {}
    faults = []
    for ours, theirs in settings.their_columns.items():
        if isinstance(theirs, int):
            positions = [theirs - 1] if 0 < theirs <= width else []
        else:
            positions = [i for i, name in enumerate(layout.names) if name == theirs]
        if len(positions) == 1:
            found[positions[0]] = ours
        elif positions:
            reason = f"stands {len(positions)} times in the header."
            fix = "Rename one, or name the column by its position in the rig config."
            place = {"line": layout.names_line, "column": theirs}
            faults += bad_file(file, "duplicate_column", reason, fix, **place).faults
        elif ours not in settings.optional:
            faults.append(_missing(theirs, layout, width, settings, file))
    if faults:
        raise BadFile(*faults)
    if settings.other_columns == "channels":
        for i in range(width):
            if i not in found:
                named = layout.names[i] if i < len(layout.names) else ""
                found[i] = beside(named or f"column_{i + 1}", list(found.values()))
    return found


def beside(name: str, taken: Collection[str]) -> str:
    """Return the name, or one beside it where it is taken.

    Examples
    --------
    >>> beside("stroke", {"stroke"}), beside("speed_mm_s", {"speed_mm_s"}), beside("humidity_pct", ())
    ('stroke_file', 'speed_file_mm_s', 'humidity_pct')
    """
    while name in taken:
        for unit in ("_mm_s", "_mm", "_N", "_s", "_C", "_pct", "_h", "_days", "_bar", ""):
            if name.endswith(unit) and name != unit:
                name = f"{name.removesuffix(unit)}_file{unit}"
                break
    return name


def suggestion(name: str, known: Sequence[str]) -> str:
    """Return a fix for a missing column: the nearest name, or the names that there are."""
    if close := nearest(name, known):
        case = " (the case of letters matters)" if close.lower() == name.lower() else ""
        return f"Did you mean {shortened(repr(close))}?{case}"
    names = ", ".join(shortened(repr(n)) for n in known if n)
    return f"The columns are {shortened(names, LONGEST_LIST)}." if names else ""


BY_RATE = "give the rows per second as rate_Hz under [trace]"
BY_SPEED = "integrate it from a speed column"


def required(table: Mapping[str, object], layout: Layout, file: str) -> None:
    """Raise `BadFile` if, after everything is computed, a slot that every trace needs is not there."""
    found = []
    for name in SLOTS[:3]:
        if name not in table:
            last = BY_RATE if name == "time_s" else BY_SPEED
            fix = f"Name it under [trace.columns], compute it under [trace.compute], or {last}."
            found.append(missing_column(name, layout, file, fix))
    if found:
        raise BadFile(*found)


def missing_column(column: str | int, layout: Layout, file: str, fix: str, reason: str = NO_COLUMN) -> Fault:
    """Return the fault of a file that lacks a column, and is left out."""
    place = {"line": layout.names_line, "column": str(column)}
    return bad_file(file, "missing_column", reason, fix, **place).fault


def _missing(theirs: str | int, layout: Layout, width: int, settings: TraceFormat, file: str) -> Fault:
    if isinstance(theirs, int):
        reason = f"there is no column {theirs}: the lines have {width}."
        fix = "Check delimiter and positions in the rig config."
        return missing_column(theirs, layout, file, fix, reason)
    fix = "Columns without names go by position, from 1."
    if layout.names:
        fix = suggestion(theirs, layout.names)
    if len(layout.names) <= 1 and layout.names_line is not None:
        line = layout.header[layout.names_line - 1]
        for mark, word in ((";", '";"'), ("\t", '"tab"'), (",", '","'), ("|", '"|"'), (" ", '"whitespace"')):
            if len(split_line(line, "tab" if mark == "\t" else mark)) >= 2 and mark != settings.delimiter:
                fix = f"The header looks separated otherwise: set delimiter = {word} in the rig config."
                break
    return missing_column(theirs, layout, file, fix)


# ---------------------------------------------------------------- channels

# A text column with more different values, most of them used once, is a clock or a serial number.
MAX_LABELS = 20


def channel_columns(
    columns: Mapping[str, np.ndarray], good: np.ndarray, line: np.ndarray, config: Config, file: str
) -> tuple[dict[str, np.ndarray], np.ndarray, list[Fault]]:
    """Return the columns that are of use, a mask of rows to leave out, and the faults.

    A channel with a few cells missing costs these rows; one with more than `quality.max_bad_rows` of them
    missing is left out itself, and the file stays. Text is a label; where most cells are numbers, the others
    are faults; where most cells are empty, the rest are remarks, and each is named.

    Parameters
    ----------
    columns : mapping of str to ndarray, shape (n,)
        Float or object columns under our names; those of `SLOTS` are passed on as they are.
    good, line : ndarray, shape (n,)
        Rows that are good so far, and the line numbers of all rows.
    """
    kept, drop, faults = dict(columns), np.zeros(len(good), bool), []
    for name, values in columns.items():
        if name in SLOTS:
            continue
        numbers = values
        if values.dtype.kind != "f":
            full = np.array([cell is not None for cell in values])
            numbers = numbers_of(values, config.trace.decimal)
            if np.isfinite(numbers).sum() <= 0.5 * full.sum():
                found = _label_faults(name, values, full, line, file)
                faults += found
                if found:
                    del kept[name]
                continue
            kept[name] = numbers
        missing = good & ~(np.abs(numbers) < OVERLOAD)
        share = missing.sum() / max(good.sum(), 1)
        if share == 1:
            faults.append(_left_out(name, "the column is empty", "", file, NOTED))
            del kept[name]
        elif share > config.quality.max_bad_rows:
            reason = f"{missing.sum()} of {good.sum()} cells hold no number"
            fix = "Fill it, or list it under trace.optional and leave it out of the export."
            faults.append(_left_out(name, reason, fix, file, KEPT))
            del kept[name]
        elif share:
            drop |= missing
            column = ColumnOfFile(file, name, line, config.trace.decimal)
            faults += _cell_faults(column, np.flatnonzero(missing), values)
    return kept, drop, faults


def _label_faults(name: str, texts: np.ndarray, full: np.ndarray, line: np.ndarray, file: str) -> list[Fault]:
    """Return why a text column is no label; nothing if it is one."""
    if full.sum() < 0.5 * len(full):
        place = {"file": file, "column": name, **NOTED}

        def make(i: int) -> Fault:
            return Fault("remark", "a remark; the row is kept.", line=int(line[i]), value=texts[i], **place)

        return listed(np.flatnonzero(full), make, "remark", "remarks.")
    labels = len(set(texts[full]))
    if labels > MAX_LABELS and labels > 0.5 * full.sum():
        return [_left_out(name, f"{labels} different texts are too many for labels", "", file, NOTED)]
    return []


def _left_out(name: str, reason: str, fix: str, file: str, done: Mapping[str, str]) -> Fault:
    reason = f"{reason}; the column is not used."
    return Fault("channel_left_out", reason, file=file, column=name, fix=fix, **done)


def _cell_faults(column: ColumnOfFile, at: np.ndarray, cells: np.ndarray) -> list[Fault]:
    def make(i: int) -> Fault:
        cell = cells[i]
        if isinstance(cell, str) and as_number(cell, column.decimal) is None:
            return column.not_a_number(i, cell)
        value = "" if pd.isna(cell) else str(cell)  # as text: JSON has no inf
        reason = "is not a measured number." if value != "" else "the cell holds no number."
        return column.fault(i, "not_finite", reason, value=value, fix="Fill it or delete the line.")

    return listed(at, make, "not_a_number", OTHER_CELLS)
