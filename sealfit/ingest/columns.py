"""Columns of a trace file, columns of a campaign's listing, and the keys of conditions built from them."""

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Self

import numpy as np
import pandas as pd

from sealfit.config import MEASURED, Config, FileColumn, TraceFormat
from sealfit.errors import KEPT, NOTED, BadFile, Fault, SealfitError, nearest, shortened
from sealfit.ingest.cells import OVERLOAD, Trace, cell_faults, listed, numbers_of
from sealfit.ingest.expression import parse
from sealfit.ingest.files import FileLayout, as_number, bad_file, split_line
from sealfit.tables import BINS, RUNS
from sealfit.units import Units, other_unit

Value = float | str
Column = list[Value | None]  # a value of every file, None where it has none
Columns = dict[str, Column]

LONGEST_LIST = 400  # characters of the names of columns that a message lists
NO_COLUMN = "there is no such column."
# A unit at the end of a column's name.
UNIT_IN_BRACKETS = re.compile(r"[\[(]([^\])]+)[\])]\s*$")
SLOTS = (*MEASURED, "load_N")  # always numbers
# Columns that our tables make themselves: a channel of that name gets another, `stroke_file`.
RESERVED = {*BINS.names(), *RUNS.names(), "line", "steady"} - set(SLOTS)


# ---------------------------------------------------------------- listing
# Columns of a campaign's listing: a value per file.


def mapped(column: Column, change: Callable[[Value], Value | None]) -> Column:
    """Return the column with every value changed; None stays None."""
    return [None if value is None else change(value) for value in column]


def where(column: Column, holds: Callable[[Value], bool]) -> np.ndarray:
    """Return which files have a value of which `holds` is true, shape (files,)."""
    return np.array([value is not None and bool(holds(value)) for value in column], bool)


def known(column: Column) -> np.ndarray:
    """Return which files have a value, shape (files,)."""
    return where(column, lambda value: True)


def put(column: Column, cells: Mapping[int, Value]) -> Column:
    """Return the column with other values for some files, by their numbers."""
    return [cells.get(i, value) for i, value in enumerate(column)]


def columns_of(rows: Sequence[Mapping[str, Value]]) -> Columns:
    """Return rows of named values as columns, in the order in which the names appear."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in names}


def over(column: Column, other: Column) -> Column:
    """Return the column with the values of `other` for files that have none."""
    return [theirs if own is None else own for own, theirs in zip(column, other, strict=True)]


def overlaid(*columns: Columns) -> Columns:
    """Return columns of the same files in one; the last that has a value for a file says it."""
    whole: Columns = {}
    for some in columns:
        for name, column in some.items():
            whole[name] = over(column, whole[name]) if name in whole else column
    return whole


def taken(columns: Columns, files: Sequence[int]) -> Columns:
    """Return the columns of some of the files, by their numbers."""
    return {name: [column[i] for i in files] for name, column in columns.items()}


def in_order(columns: Columns) -> Columns:
    """Return the columns in the order of the first file with a value in each, without those that none has."""
    filled = {name: known(column) for name, column in columns.items()}
    first = {name: int(there.argmax()) for name, there in filled.items() if there.any()}
    return {name: columns[name] for name in sorted(first, key=first.__getitem__)}


@dataclass(frozen=True, slots=True)
class TraceRef:
    """One trace file and all that runs.csv, its name, header or constant columns say of the whole file.

    `file` is relative to the campaign folder, with forward slashes. `channels` always holds `run_id`,
    `repeat`, `specimen_id` and the condition columns (day 0 may lack those other than the days); what is not
    known is not there. `cut` says that the file may end within a number.
    """

    file: str
    channels: Mapping[str, float | str]
    cut: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Listing(Sequence[TraceRef]):
    """The trace files of a campaign, or some of them, in order.

    `columns` hold the channels, `conditions` words; files of `cut` may end within a number.
    """

    files: list[str]
    columns: Columns
    conditions: list[str]
    cut: frozenset[str] = frozenset()

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, i: int) -> TraceRef:
        known = ((name, column[i]) for name, column in self.columns.items())
        channels = {name: value for name, value in known if value is not None}
        return TraceRef(self.files[i], channels, self.files[i] in self.cut)

    def take(self, files: np.ndarray) -> Self:
        """Return some of the files, by their numbers, with the columns in which any of them has a value."""
        columns = taken(self.columns, files)
        filled = {name: c for name, c in columns.items() if any(value is not None for value in c)}
        own = [self.files[i] for i in files]
        return Listing(own, filled, [self.conditions[i] for i in files], self.cut.intersection(own))


# ---------------------------------------------------------------- conditions
# The keys `condition`, `series` and `rubber` of a table are spelled here only.

UNAGED = "unaged"
ALL = "all"  # the series of a rig whose only condition is its age
ONE_RUBBER = "rubber"


def condition_columns(config: Config) -> list[str]:
    """Return the columns that make a condition: the config's, and the rubber columns not among them."""
    return [*config.condition, *(name for name in config.rubber if name not in config.condition)]


def add_keys(table: pd.DataFrame, config: Config) -> pd.DataFrame:
    """Return `table` with `condition`, `series` and `rubber`.

    A condition is spelled "temperature_C=60, compression_ratio_pct=80, aging_days=4"; a series is the
    condition without days ("all" when no other column is left). Rows with aging_days = 0 are "unaged" in both
    ("unaged, <rubber>" where the config names rubber columns). Other rows with an empty condition cell have
    null for both. SealfitError if one of the config's condition or rubber columns is missing.

    Examples
    --------
    >>> runs = pd.DataFrame(
    ...     {"temperature_C": [60, 60], "compression_ratio_pct": [80, 80], "aging_days": [4, 0]}
    ... )
    >>> add_keys(runs, Config())[["condition", "series"]].values.tolist()[1]
    ['unaged', 'unaged']
    """
    columns = condition_columns(config)
    missing = [name for name in columns if name not in table.columns]
    if missing:
        reason = f"condition column {', '.join(repr(name) for name in missing)} is missing."
        fix = "Add it, or name other columns in the config's condition and rubber."
        raise SealfitError(reason, fix=fix)
    keys = keys_of({name: table[name].tolist() for name in columns}, len(table), config)
    return table.assign(**{key: pd.array(words, dtype="str") for key, words in keys.items()})


def keys_of(
    columns: Mapping[str, Sequence[object]], rows: int, config: Config
) -> dict[str, list[str | None]]:
    """Return `condition`, `series` and `rubber` of every row, as `add_keys`, from all condition columns."""
    spelled = cache(_spell)
    texts = {name: [spelled(value) for value in columns[name]] for name in condition_columns(config)}
    words = {name: [t if t is None else f"{name}={t}" for t in own] for name, own in texts.items()}
    condition = _joined(words.values(), rows)
    rubber = _joined([texts[name] for name in config.rubber], rows) if config.rubber else [ONE_RUBBER] * rows
    series = condition
    if config.aging:
        others = [own for name, own in words.items() if name != "aging_days"]
        series = _joined(others, rows) if others else [ALL] * rows
        unaged = _joined([[UNAGED] * rows, *([rubber] if config.rubber else [])], rows)
        new = {i: unaged[i] for i, days in enumerate(texts["aging_days"]) if days == "0"}
        condition, series = put(condition, new), put(series, new)
    return {"condition": condition, "series": series, "rubber": rubber}


def _spell(value: object) -> str | None:
    """Return a value as text: 60, 60.0 and "60" are one condition; null as None."""
    if pd.isna(value):
        return None
    number = as_number(str(value))
    if number is None:
        return str(value).strip() or None
    return str(int(number)) if number.is_integer() and abs(number) < 2**53 else f"{number:g}"


def _joined(parts: Iterable[Sequence[str | None]], rows: int) -> list[str | None]:
    """Return the parts of each row joined by ", "; None where any part is."""
    each = list(zip(*parts, strict=True)) or [()] * rows
    return [None if None in row else ", ".join(row) for row in each]


# ---------------------------------------------------------------- trace files
# What stands in each column of a trace file: our columns, channels of numbers, or labels.


def numeric_names(settings: TraceFormat) -> set[str]:
    """Return the columns that must hold numbers: the slots and what an expression or the integral reads."""
    texts = [parse(text) for text in settings.compute.values()]
    if settings.keep is not None:
        texts.append(parse(settings.keep, condition=True))
    names = set(SLOTS).union(*(text.numbers for text in texts))
    return names | {settings.integrate_displacement} if settings.integrate_displacement else names


def force_inputs(config: Config) -> set[str]:
    """Return the columns that `force_N` is computed from and that are no channels; none with `drop_columns`.

    An effect of one of them would give the force back that was computed from it.
    """
    settings = config.trace
    if settings.drop_columns is not None:
        return set()
    read: set[str] = set()
    for name in reversed(settings.compute):  # each may read those that are computed before it
        if name == "force_N" or name in read:
            read |= parse(settings.compute[name]).names
    return {beside(name, RESERVED) for name in read - {*SLOTS, *condition_columns(config)}}


def locate(layout: FileLayout, width: int, settings: TraceFormat) -> dict[int, str]:
    """Return our name for each position (from 0) of a file with `width` columns.

    Columns that the config does not list keep the file's name (`column_4` where it has none), or one beside
    it where that is taken. BadFile if a column is missing or its name stands twice.
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
            faults += bad_file("duplicate_column", reason, fix, **place).faults
        elif ours not in settings.optional:
            faults.append(_missing(ours, layout, width, settings))
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


def suggestion(name: str, known: Sequence[str], *, used: Collection[str] = ()) -> str:
    """Return a fix for a missing column: the nearest name that is not used, or the names that there are."""
    if close := nearest(name, [other for other in known if other not in used]):
        case = " (the case of letters matters)" if close.lower() == name.lower() else ""
        return f"Did you mean {shortened(repr(close))}?{case}"
    names = ", ".join(shortened(repr(n)) for n in known if n)
    return f"The columns are {shortened(names, LONGEST_LIST)}." if names else ""


# What a file without this column can be read by, when it is neither named nor computed.
INSTEAD = {
    "time_s": "give the rows per second as rate_Hz under [trace]",
    "displacement_mm": "name a column of speed as integrate_displacement under [trace]",
}


def required(table: Mapping[str, object], layout: FileLayout, names: Sequence[str] = MEASURED) -> None:
    """Raise `BadFile` if, after everything is computed, a column that a trace needs is not there."""
    found = []
    for name in (name for name in names if name not in table):
        fix = "Name it under [trace.columns], or compute it under [trace.compute]."
        if other := INSTEAD.get(name):
            fix = f"Name it under [trace.columns], compute it under [trace.compute], or {other}."
        found.append(missing_column(name, layout, fix))
    if found:
        raise BadFile(*found)


def missing_column(column: str | int, layout: FileLayout, fix: str, reason: str = NO_COLUMN) -> Fault:
    """Return the fault of a file that lacks a column, and is left out."""
    place = {"line": layout.names_line, "column": str(column)}
    return bad_file("missing_column", reason, fix, **place).fault


def header_units(layout: FileLayout, settings: TraceFormat, units: Units, clock: bool) -> list[Fault]:
    """Return a warning for each column with another unit in the header than that its numbers are taken in.

    With `clock` the times are times of day, whatever the header says.
    """
    faults, names = [], layout.names
    row = split_line(layout.header[-1], settings.delimiter) if settings.units_row and layout.header else []
    for ours, column in settings.columns.items():
        taken = "" if clock and ours == SLOTS[0] else column.unit or units.of(ours)
        if column.name not in (*names, *range(1, len(names) + 1)) or not taken:
            continue
        at = column.name - 1 if isinstance(column.name, int) else names.index(column.name)
        cell = row[at].strip(" []()") if at < len(row) else ""
        said = cell if cell[:1].isalpha() else _unit_in_name(names[at], taken)
        place = {"line": layout.names_line, "column": names[at]}
        faults += unit_said(said, ours, column, taken, "trace.columns", place)
    return faults


def _unit_in_name(name: str, taken: str) -> str:
    """Return the unit in brackets at the end of a name; "" if round ones hold no other unit of its quantity.

    Round brackets may hold a remark: the "(s)" of a displacement is no unit.
    """
    found = UNIT_IN_BRACKETS.search(name)
    said = found[1].strip() if found else ""
    return "" if name.endswith(")") and not other_unit(said, taken) else said


def unit_said(
    said: str, ours: str, column: FileColumn, taken: str, table: str, place: Mapping[str, str | int | None]
) -> Iterator[Fault]:
    """Yield a warning if a header says another unit than that in which the numbers of a column are taken.

    `table` is the one of the config that names the column as `ours`.
    """
    unit = other_unit(said, taken)
    if unit is None:
        return
    fix = f'set {ours} = {{name = {column.name!r}, unit = "{unit}"}} under [{table}].'
    if not unit:
        fix = f"name the column otherwise under [{table}], and compute {ours} from it."
    reason = f"the header says '{said}', and the config takes the numbers in {taken}."
    yield Fault("unit", reason, fix=f"If the header is right, {fix}", **place, **KEPT)


def _missing(ours: str, layout: FileLayout, width: int, settings: TraceFormat) -> Fault:
    theirs = settings.their_columns[ours]
    if isinstance(theirs, int):
        reason = f"there is no column {theirs}: the lines have {width}."
        fix = "Check delimiter and positions in the rig config."
        return missing_column(theirs, layout, fix, reason)
    fix = "Columns without names go by position, from 1."
    if layout.names:
        fix = suggestion(theirs, layout.names, used=list(settings.their_columns.values()))
        if ours in INSTEAD and not nearest(theirs, layout.names):
            fix += f" Name it under [trace.columns], or {INSTEAD[ours]}."
    if len(layout.names) <= 1 and layout.names_line is not None:
        line = layout.header[layout.names_line - 1]
        marks = ((";", ";"), ("\t", "tab"), (",", ","), ("|", "|"), (" ", "whitespace"))
        likely = [w for mark, w in marks if len(split_line(line, mark)) >= 2 and mark != settings.delimiter]
        if likely:
            fix = f'The header looks separated otherwise. If all files are so, set delimiter = "{likely[0]}" '
            fix += "in the rig config; else export this one as the others are."
    return missing_column(theirs, layout, fix)


# ---------------------------------------------------------------- channels

# A text column with more different values, most of them used once, is a clock or a serial number.
MAX_LABELS = 20


def channel_columns(rows: Trace, config: Config) -> Trace:
    """Return the rows with the columns that are of use, and what was found in the channels.

    A channel with a few cells missing costs these rows; one with more than `quality.max_bad_rows` of them is
    left out itself. Text is a label, or remarks where most cells are empty; where most cells are numbers, the
    others are faults.
    """
    kept, drop, faults, good = dict(rows.columns), np.zeros(len(rows.line), bool), [], ~rows.bad
    said = {fault.column for fault in rows.faults}
    for name, values in rows.columns.items():
        if name in SLOTS:
            continue
        numbers = values
        if values.dtype.kind != "f":
            full = np.array([cell is not None for cell in values])
            numbers = numbers_of(values, config.trace.decimal)
            if full.any() and np.isfinite(numbers).sum() <= 0.5 * full.sum():
                if found := _label_faults(name, values, full, rows.line):
                    faults += found
                    del kept[name]
                continue
            kept[name] = numbers
        missing = good & ~(np.abs(numbers) < OVERLOAD)
        share = missing.sum() / max(good.sum(), 1)
        if share == 1:
            if name not in said:
                faults.append(_left_out(name, "the column is empty", "", NOTED))
            del kept[name]
        elif share > config.quality.max_bad_rows:
            reason = f"{missing.sum()} of {good.sum()} cells hold no number"
            fix = "Fill it, or list it under trace.optional and leave it out of the export."
            faults.append(_left_out(name, reason, fix, KEPT))
            del kept[name]
        elif share:
            drop |= missing
            faults += cell_faults(name, values, missing, rows.line, config.trace.decimal)
    return replace(rows, columns=kept, bad=rows.bad | drop).with_faults(faults)


def _label_faults(name: str, texts: np.ndarray, full: np.ndarray, line: np.ndarray) -> list[Fault]:
    """Return why a text column is no label; nothing if it is one."""
    if full.sum() < 0.5 * len(full):
        place = {"column": name, **NOTED}

        def make(i: int) -> Fault:
            return Fault("remark", "a remark; the row is kept.", line=int(line[i]), value=texts[i], **place)

        return listed(np.flatnonzero(full), make, "remark", "remarks.")
    labels = len(set(texts[full]))
    if labels > MAX_LABELS and labels > 0.5 * full.sum():
        return [_left_out(name, f"{labels} different texts are too many for labels", "", NOTED)]
    return []


def _left_out(name: str, reason: str, fix: str, done: Mapping[str, str]) -> Fault:
    reason = f"{reason}; the column is not used."
    return Fault("channel_left_out", reason, column=name, fix=fix, **done)
