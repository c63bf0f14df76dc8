"""Data lines of a trace file to columns of numbers, and which of its rows are measurements."""

import re
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv as pacsv

from sealfit.config import TraceFormat
from sealfit.errors import Fault
from sealfit.ingest.files import FileLayout, as_number, bad_file, split_line, without_strays


@dataclass(frozen=True, slots=True)
class Trace:
    """Rows of one trace file, in our columns and units.

    `columns` are float64 arrays, or object arrays of text (None where empty), by our names; `line` is the
    1-based line in the file of every row; `bad` marks rows that are still to be left out; `rows_read` is the
    number of data rows in the file. `channels` is what is known of the whole file; `number` is that of every
    row before the config's `keep` filtered them, None before that; `clock` says that times are times of day.
    """

    columns: Mapping[str, np.ndarray]
    line: np.ndarray
    bad: np.ndarray
    rows_read: int
    faults: tuple[Fault, ...] = ()
    channels: Mapping[str, float | str] = field(default_factory=dict)
    number: np.ndarray | None = None
    clock: bool = False

    def where(self, keep: np.ndarray) -> Self:
        """Return the trace with some of its rows."""
        columns = {name: values[keep] for name, values in self.columns.items()}
        number = None if self.number is None else self.number[keep]
        return replace(self, columns=columns, line=self.line[keep], bad=self.bad[keep], number=number)

    def having(self, columns: Mapping[str, np.ndarray]) -> Self:
        """Return the trace with further columns."""
        return replace(self, columns={**self.columns, **columns})

    def with_faults(self, faults: Iterable[Fault]) -> Self:
        """Return the trace with further findings."""
        return replace(self, faults=(*self.faults, *faults))

    @property
    def table(self) -> pd.DataFrame:
        """The columns as a table."""
        return pd.DataFrame(self.columns)


def clean(rows: Trace, names: Sequence[str]) -> Trace:
    """Return the rows whose slots are finite and whose time rises, with the faults of the others."""
    faults: list[Fault] = []
    finite = np.ones(len(rows.line), bool)
    for name in (name for name in names if name in rows.columns):
        sizes = np.abs(rows.columns[name])
        wrong, overload = ~np.isfinite(sizes), (sizes >= OVERLOAD) & np.isfinite(sizes)
        finite &= ~(wrong | overload)
        faults += _row_faults("not_finite", name, rows, wrong)
        faults += _row_faults("overload", name, rows, overload)
    good = rows.where(finite)
    time_s, check = good.columns["time_s"], "time_order"
    back = _out_of_order(time_s)
    if back.sum() > SEVERAL * len(back) and (first := _begins_anew(time_s)):
        back, check = np.arange(len(back)) >= first, "time_anew"
    faults += _row_faults(check, "time_s", good, back)
    return good.where(~back).with_faults(faults)


_ROW_FAULTS = {  # check: (reason, fix)
    "not_finite": ("the computed value is not a finite number.", "Check [trace.compute]."),
    "overload": ("is an instrument's mark for overload.", "Check the sensor's range."),
    "time_order": ("time repeats or runs backwards.", "Check the recorder's clock, or delete the line."),
    "time_anew": ("is after time began anew: several recordings follow each other, or the clock restarted.",
                  "Save each recording in a file of its own, and what differs between them in runs.csv. If "
                  "only the clock restarted, give the rows per second as trace.rate_Hz, without time_s."),
}  # fmt: skip
SEVERAL = 0.05  # share of the rows out of order from which time is looked at whether it began anew
RECORDING = 30  # rows before that, fewer are none
ANEW = 0.01  # share of the time so far that may be left where it does


def _row_faults(check: str, name: str, rows: Trace, wrong: np.ndarray) -> list[Fault]:
    place = {"column": name, "action": "row left out"}
    reason, fix = _ROW_FAULTS[check]

    def make(i: int) -> Fault:
        value = float(rows.columns[name][i])
        shown = value if np.isfinite(value) else str(value)  # JSON has no nan
        return Fault(check, reason, line=int(rows.line[i]), value=shown, fix=fix, **place)

    return listed(np.flatnonzero(wrong), make, check, f"rows: {reason}")


def _begins_anew(time_s: np.ndarray) -> int:
    """Return the row at which time first falls back to where it began; 0 if none, or after few rows only."""
    since = time_s - time_s[0]
    anew = 1 + np.flatnonzero((np.diff(since) < 0) & (since[1:] <= ANEW * since[:-1]))
    rows = np.diff(np.r_[0, anew, len(time_s)])
    return int(anew[0]) if anew.size and rows[0] >= max(RECORDING, rows.max() / 2) else 0


def _out_of_order(time_s: np.ndarray) -> np.ndarray:
    """Return a mask of the rows outside a longest rising subsequence of the times (patience sorting)."""
    if len(time_s) < 2 or (np.diff(time_s) > 0).all():
        return np.zeros(len(time_s), bool)
    tails: list[float] = []
    at: list[int] = []
    before = np.full(len(time_s), -1)
    for i, t in enumerate(time_s.tolist()):
        place = bisect_left(tails, t)
        if place < len(tails) and tails[place] == t:
            continue  # of two equal times the first stays
        before[i] = at[place - 1] if place else -1
        tails[place : place + 1], at[place : place + 1] = [t], [i]
    bad = np.ones(len(time_s), bool)
    i = at[-1]
    while i >= 0:
        bad[i] = False
        i = before[i]
    return bad


# ---------------------------------------------------------------- cells
OVERLOAD = 1e24  # no rig measures this; instruments write 9.9e37 for overload and 9.91e37 for no value (SCPI)
LISTED = 20  # faults of one kind that are written out for a file; the rest is counted in one more
# A time of day, after a date or not, with am, pm or a time zone after it. One zone holds for a whole file.
_CLOCK = re.compile(
    r"(?:.*[\sT])?(\d+):(\d\d):(\d\d(?:[.,]\d+)?)(?:\s*([ap])\.?m\.?|Z|[+-]\d\d:?\d\d)?", re.IGNORECASE
)
_DAY_S = 86400.0


def listed(rows: np.ndarray, make: Callable[[int], Fault], check: str, more: str) -> list[Fault]:
    """Return a fault for each of the first rows, and one of `check` that counts the rest, `more`."""
    faults, rest = [make(int(row)) for row in rows[:LISTED]], len(rows) - LISTED
    if rest > 0:
        reason, place = f"and {rest} more {more}", {"line": None, "value": float(rest)}
        faults.append(replace(faults[0], check=check, reason=reason, fix="", **place))
    return faults


def body_of(text: bytes, layout: FileLayout, settings: TraceFormat) -> bytes:
    """Return the data lines of a file, without line ends after the last one; BadFile if it has none."""
    body = text[layout.start :]
    last = len(body.rstrip(b"\n \t,;"))  # spreadsheets write separators for rows that are empty
    body = body[:last] + body[last:].partition(b"\n")[0]
    body = body.rstrip(b" \t") if settings.delimiter == "whitespace" else body
    if not body.strip(b"\n \t,;"):
        reason = "has a header but no data." if len(layout.names) > 1 else "holds no table of numbers."
        raise bad_file("no_rows", reason, "Export it again.")
    return body


def width_of(body: bytes, delimiter: str) -> int:
    """Return how many cells the first line that is not blank has."""
    begin = body.rfind(b"\n", 0, len(body) - len(body.lstrip(b"\n \t"))) + 1
    end = body.find(b"\n", begin)
    first = body[begin : None if end < 0 else end]
    return len(split_line(first.decode("utf-8", "replace"), delimiter))


def read_cells(
    body: bytes, layout: FileLayout, settings: TraceFormat, ours: Mapping[int, str], must: Collection[str]
) -> Trace:
    """Return the data of a text file, whose data lines are `body` (`body_of`); the others as `checked_cells`.

    Arrow reads the lines if it can; else they are split one by one.
    """
    rows = body.count(b"\n") + 1
    numeric = [i for i, name in ours.items() if name in must]
    columns = _fast(body, rows, layout, settings, numeric)
    if columns is not None:
        line = np.arange(layout.first_line, layout.first_line + rows)
        return checked_cells(columns, line, ours, must, settings.decimal)
    every = enumerate(body.decode("utf-8", "replace").split("\n"), start=layout.first_line)
    lines = {number: text for number, text in every if text.strip()}
    line = np.array(list(lines), dtype=np.int64)
    cells = [split_line(without_strays(text, settings), settings.delimiter) for text in lines.values()]
    count = np.array([len(row) for row in cells])
    width = len(layout.names) or count.max(initial=0)
    columns = {
        i: np.array([row[i] if i < len(row) else None for row in cells], dtype=object) for i in range(width)
    }
    trace = checked_cells(columns, line, ours, must, settings.decimal, count)
    beyond = np.array([any(row[width:]) for row in cells], dtype=bool)

    def make(i: int) -> Fault:
        value = " ".join(filter(None, cells[i][width:]))
        reason = f"the line has {len(cells[i])} cells where {width} are named."
        fix = "Move it to a column with a name of its own, or delete the line."
        if len(cells[i]) == 2 * width:
            fix = "Decimal commas between commas? Export with another separator, or with decimal points."
        place = {"line": int(line[i]), "value": value, "action": "row left out"}
        return Fault("too_many_cells", reason, fix=fix, **place)

    more = "lines with cells beyond the last named column."
    found = listed(np.flatnonzero(beyond & ~trace.bad), make, "too_many_cells", more)
    return replace(trace, bad=trace.bad | beyond).with_faults(found)


def checked_cells(
    columns: Mapping[int, np.ndarray],
    line: np.ndarray,
    ours: Mapping[int, str],
    must: Collection[str],
    decimal: str,
    count: np.ndarray | None = None,
) -> Trace:
    """Return columns of cells, by position (from 0), by our names; `must` are those that must hold numbers.

    A column holds numbers, text as objects, or datetime64: seconds since the first where a number is needed,
    else text in ISO 8601. A row without a needed number is bad. `count` is the number of cells of each line
    of a text, in which None stands for a cell beyond its end.
    """
    bad, made, faults, clock = np.zeros(len(line), bool), {}, [], False
    for i, name in ours.items():
        if i not in columns:
            continue
        values = columns[i]
        if values.dtype.kind == "M":
            values = _from_dates(values, name in must)
        if name in must:
            numbers = seconds_of_day(values) if name == "time_s" and values.dtype.kind == "O" else None
            clock |= numbers is not None
            if numbers is None:
                numbers = values if values.dtype.kind == "f" else numbers_of(values, decimal)
            wrong = ~np.isfinite(numbers)
            bad |= wrong
            faults += cell_faults(name, values, wrong, line, decimal, count)
            made[name] = numbers
        elif values.dtype.kind == "O":
            cells = np.array([(cell or "").strip() or None for cell in values], dtype=object)
            words = any(cell is not None and as_number(cell, decimal) is None for cell in cells)
            made[name] = cells if words else numbers_of(cells, decimal)
        else:
            made[name] = values
    return Trace(made, line, bad, len(line), tuple(faults), clock=clock)


def _from_dates(times: np.ndarray, as_seconds: bool) -> np.ndarray:
    unknown = np.isnat(times)
    if as_seconds:  # since the first that is known
        return (times - times[unknown.argmin()]) / np.timedelta64(1, "s")
    texts = np.datetime_as_string(times).astype(object)
    texts[unknown] = None
    return texts


def _fast(
    body: bytes, rows: int, layout: FileLayout, settings: TraceFormat, numeric: Sequence[int]
) -> dict[int, np.ndarray] | None:
    """Return the columns as Arrow reads them; None where a cell, a line or the delimiter is beyond it."""
    types = dict.fromkeys(numeric, pa.float64())
    table = _arrow(body, settings, types)
    if table is None or table.num_rows != rows:  # blank lines, or line ends inside quotes
        return None
    for i, kind in enumerate(table.schema.types):
        if not (_numeric(kind) or pa.types.is_string(kind)):
            types[i] = pa.string()  # TRUE, a date or 08:30, which Arrow would write in another way
    if len(types) > len(numeric):
        table = _arrow(body, settings, types)
    columns = {i: _column(column) for i, column in enumerate(table.columns)}
    for i in range(len(layout.names), len(columns)) if layout.names else ():
        beyond = columns.pop(i)
        if beyond.dtype.kind != "f" or not np.isnan(beyond).all():
            return None
    # Empty cells, NaN and inf are to be named as they stand in the file.
    return columns if all(np.isfinite(columns[i]).all() for i in numeric) else None


def _arrow(body: bytes, settings: TraceFormat, types: Mapping[int, pa.DataType]) -> pa.Table | None:
    """Return the table that Arrow reads, with the types of some columns given; None where it cannot read."""
    delimiter = settings.delimiter
    if delimiter == "whitespace":
        body, delimiter = re.sub(rb"(?m)^\t|\t$", b"", re.sub(rb"[ \t]+", b"\t", body)), "tab"
    mark = "\t" if delimiter == "tab" else delimiter
    width = width_of(body, delimiter)
    if width <= max(types, default=0) or len(mark.encode()) != 1:
        return None
    names, size = [str(i) for i in range(width)], max(len(body) + 1, 1024)
    kinds = {names[i]: kind for i, kind in types.items()}
    read = pacsv.ReadOptions(column_names=names, use_threads=False, block_size=size)
    convert = pacsv.ConvertOptions(decimal_point=settings.decimal, column_types=kinds)
    try:
        return pacsv.read_csv(pa.BufferReader(body), read, pacsv.ParseOptions(delimiter=mark), convert)
    except pa.ArrowInvalid:
        return None


def _numeric(kind: pa.DataType) -> bool:
    return pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_null(kind)


def _column(column: pa.ChunkedArray) -> np.ndarray:
    if _numeric(column.type):
        return column.cast(pa.float64(), safe=False).to_numpy()  # a whole number beyond 2**53 is rounded
    return np.array(column.cast(pa.string()).to_pylist(), dtype=object)


def seconds_of_day(cells: Sequence[str | None]) -> np.ndarray | None:
    """Return seconds since the first of the times of day in cells, shape (n,); None if most hold none.

    Dates are not read: where the time falls by more than half a day, midnight has passed.

    Examples
    --------
    >>> seconds_of_day(["2026-03-01 23:59:59,5", "2026-03-02 00:00:00,0"])
    array([0. , 0.5])
    >>> seconds_of_day(["0.1", "0.2"]) is None
    True
    """
    found = [_CLOCK.fullmatch(cell.strip()) if cell is not None else None for cell in cells]
    if sum(match is not None for match in found) <= 0.5 * len(found):
        return None
    seconds = np.array([np.nan if match is None else _since_midnight(*match.groups()) for match in found])
    known = np.flatnonzero(np.isfinite(seconds))
    step = np.diff(seconds[known]) / _DAY_S
    midnight = (step < -0.5) & ~(np.append(step[1:], 0.0) > 0.5)  # not if it is back at once: one wrong time
    seconds[known] += _DAY_S * np.r_[0, np.cumsum(midnight)]
    return seconds - seconds[known[0]]


def _since_midnight(hours: str, minutes: str, seconds: str, half: str | None) -> float:
    hour = int(hours) if half is None else int(hours) % 12 + 12 * (half.lower() == "p")
    return 3600.0 * hour + 60.0 * int(minutes) + float(seconds.replace(",", "."))


def numbers_of(cells: Iterable[str | None], decimal: str) -> np.ndarray:
    """Return the numbers in cells of text, shape (n,); NaN where one holds none, or is None."""
    found = (None if cell is None else as_number(cell, decimal) for cell in cells)
    return np.array([np.nan if number is None else number for number in found], dtype=float)


def cell_faults(
    name: str,
    cells: Sequence,
    wrong: np.ndarray,
    line: np.ndarray,
    decimal: str,
    count: np.ndarray | None = None,
) -> list[Fault]:
    """Return the faults of cells that hold no number; `count` as for `checked_cells`."""
    place = {"column": name, "action": "row left out"}

    def make(i: int) -> Fault:
        if cells[i] is None and count is not None:
            reason, fix = f"the line ends after {count[i]} cells.", "Complete or delete the line."
            return Fault("too_few_cells", reason, line=int(line[i]), fix=fix, **place)
        cell = "" if pd.isna(cells[i]) else str(cells[i])  # as text: JSON has no inf
        value = cell.strip()
        check, reason = "not_a_number", "is not a number."
        fix = decimal_fix(cell, decimal) or "Put a number there or delete the line."
        if not value:
            check, reason = "empty_cell", "holds no value: empty, n/a or the like."
            fix = "Fill it or delete the line."
        elif as_number(value, decimal) is not None:
            check, reason, fix = "not_finite", "is not a measured number.", "Delete the line."
        elif i == 0 and not wrong.all() and not any(char.isdigit() for char in value):
            fix = "If this is a row of units, set units_row = true in the rig config; "
            fix += "otherwise delete the line."
        return Fault(check, reason, line=int(line[i]), value=value, fix=fix, **place)

    return listed(np.flatnonzero(wrong), make, "not_a_number", "cells of this column that are not numbers.")


def decimal_fix(cell: str, decimal: str) -> str:
    """Return the fix for a number with the other decimal mark or one of thousands; "" if it has neither."""
    other, name = (",", "point") if decimal == "." else (".", "comma")
    if as_number(cell, other) is not None:
        return f'Use a decimal {name}, or set decimal = "{other}" in the rig config.'
    if as_number(cell.replace(other, ""), decimal) is not None:
        return "Export it again without marks between thousands."
    return ""
