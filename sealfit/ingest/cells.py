"""Data lines of a trace file to columns of numbers, and which of its rows are measurements."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv

from sealfit.config import TraceFormat
from sealfit.errors import Fault
from sealfit.ingest.files import Layout, as_number, split_line, without_strays

# ---------------------------------------------------------------- rows
# Rows of a trace on their way to a clean table: what is no measurement, or out of time, is named and left out.


@dataclass(frozen=True, slots=True)
class Rows:
    """Columns of equal length on their way through the checks, and the lines they come from."""

    columns: dict[str, np.ndarray]
    line: np.ndarray

    def where(self, mask: np.ndarray) -> Rows:
        """Return the rows that the mask chooses."""
        if np.count_nonzero(mask) == len(mask):
            return self
        return Rows({name: values[mask] for name, values in self.columns.items()}, self.line[mask])


def clean(rows: Rows, names: list[str], file: str) -> tuple[Rows, int, list[Fault]]:
    """Return the rows whose slots are finite and whose time rises, the number left out, and the faults."""
    names = [name for name in names if name in rows.columns]
    if _in_order(rows, names):
        return rows, 0, []
    faults: list[Fault] = []
    finite = np.ones(len(rows.line), bool)
    for name in names:
        sizes = np.abs(rows.columns[name])
        wrong, overload = ~np.isfinite(sizes), (sizes >= OVERLOAD) & np.isfinite(sizes)
        finite &= ~(wrong | overload)
        faults += _row_faults("not_finite", "the computed value is not a finite number.", name, rows, wrong, file)
        faults += _row_faults("overload", "is an instrument's mark for overload.", name, rows, overload, file)
    good = rows.where(finite)
    back = _out_of_order(good.columns["time_s"])
    faults += _row_faults("time_order", "time repeats or runs backwards.", "time_s", good, back, file)
    return good.where(~back), int((~finite).sum() + back.sum()), faults


def _in_order(rows: Rows, names: Sequence[str]) -> bool:
    """Return whether nothing is to be found: every slot measured, time rising throughout."""
    time_s = rows.columns["time_s"]
    if len(time_s) < 2 or not (time_s[1:] > time_s[:-1]).all():
        return False
    return all(np.abs(rows.columns[name]).max() < OVERLOAD for name in names)  # not so of nan


def _row_faults(check: str, reason: str, name: str, rows: Rows, wrong: np.ndarray, file: str) -> list[Fault]:
    place = {"file": file, "column": name, "action": "row left out"}
    fix = {
        "time_order": "Check the recorder's clock, or delete the line.",
        "not_finite": "Check [trace.compute].",
        "overload": "Check the sensor's range.",
    }[check]

    def make(i: int) -> Fault:
        value = float(rows.columns[name][i])
        shown = value if np.isfinite(value) else str(value)  # JSON has no nan
        return Fault(check, reason, line=int(rows.line[i]), value=shown, fix=fix, **place)

    def rest(count: int) -> Fault:
        return Fault(check, f"and {count} more rows: {reason}", value=float(count), **place)

    return listed(np.flatnonzero(wrong), make, rest)


def _out_of_order(time_s: np.ndarray) -> np.ndarray:
    """Return a mask of the fewest rows whose removal leaves a time that rises from row to row.

    They are the rows outside a longest rising subsequence (patience sorting), so one wrong time that lies far ahead
    costs one row and not all that follow.
    """
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
# Data lines of a trace file to columns of numbers: Arrow's CSV reader, and a patient one for what it cannot read.
#
# Both give the same columns and the line number of every row; the patient one also names what stands in the way: text
# where a number belongs, remarks typed beside a number, lines with too few or too many cells.

OVERLOAD = 1e30  # no rig measures this; instruments write 9.9e37 for overload and 9.91e37 for no value (SCPI)
LISTED = 20  # faults of one kind that are written out for a file; the rest is counted in one more
_CLOCK = re.compile(r"(.*\s)?\d+:\d+(:\d+([.,]\d+)?)?")
_REMARK = re.compile(r"\s*([-+]?[\d.,]+(?:[eE][-+]?\d+)?)[\s,;]+(?P<remark>.*[^\W\d_].*?)[\s,;]*$")


@dataclass(frozen=True, slots=True)
class Cells:
    """Columns by position from 0: float64 arrays, or object arrays of text (None where empty).

    `line` is the 1-based line number of every row; `bad` marks rows with a cell that is not a number; `faults` names
    what was found in them.
    """

    columns: dict[int, np.ndarray]
    line: np.ndarray
    bad: np.ndarray
    faults: tuple[Fault, ...]


def listed(rows: np.ndarray, make: Callable[[int], Fault], rest: Callable[[int], Fault]) -> list[Fault]:
    """Return a fault for each of the first rows, and one that counts the others: nothing floods, all is counted."""
    faults = [make(int(row)) for row in rows[:LISTED]]
    return [*faults, rest(len(rows) - LISTED)] if len(rows) > LISTED else faults


def read_cells(
    bodies: Sequence[bytes],
    files: Sequence[str],
    layout: Layout,
    settings: TraceFormat,
    numeric: Mapping[int, str],
) -> list[Cells]:
    """Return the data of trace files that are written alike, those of each file by themselves.

    Parameters
    ----------
    bodies : sequence of bytes
        The data lines of each file as clean UTF-8 (`text.body_of`), none of them empty.
    files : sequence of str
        What messages call the files.
    layout : Layout
        Where the data begin, in all of the files.
    numeric : mapping of int to str
        Positions (from 0) that must hold numbers, and the names that messages call them.
    """
    found = _fast(bodies, layout, settings, numeric)
    return [
        _patient(body, layout, settings, numeric, file) if cells is None else cells
        for cells, body, file in zip(found, bodies, files, strict=True)
    ]


def _fast(
    bodies: Sequence[bytes], layout: Layout, settings: TraceFormat, numeric: Mapping[int, str]
) -> list[Cells | None]:
    """Return the cells as Arrow reads them, all files in one go; None for a file that is beyond it.

    A file that spoils the reading of all is found by halving, so that it costs the others little.
    """
    rows = [_lines(body) for body in bodies]
    table = _arrow(b"\n".join(bodies), sum(rows), settings, numeric)
    texts = table is not None and any(not _is_number(column.type) for column in table.columns)
    if len(bodies) > 1 and (table is None or texts):
        # What is text in one file may be numbers in the next: such files are read one by one.
        size = 1 if texts else (len(bodies) + 1) // 2
        parts = [bodies[i : i + size] for i in range(0, len(bodies), size)]
        return [cells for part in parts for cells in _fast(part, layout, settings, numeric)]
    columns = None if table is None else _named_columns(table, layout)
    if columns is None:
        alone = ([None] if len(bodies) == 1 else _fast([body], layout, settings, numeric) for body in bodies)
        return [cells for found in alone for cells in found]
    stops = np.cumsum(rows)
    starts = stops - rows
    finite = np.ones(stops[-1], bool)
    for i in numeric:
        finite &= np.isfinite(columns[i])
    made: list[Cells | None] = []
    for start, stop, sound in zip(starts, stops, np.logical_and.reduceat(finite, starts), strict=True):
        own = {i: values[start:stop] for i, values in columns.items()}
        line = np.arange(layout.first_line, layout.first_line + stop - start)
        # Empty cells, NaN and inf are to be named as they stand in the file.
        made.append(Cells(own, line, np.zeros(stop - start, bool), ()) if sound else None)
    return made


def _arrow(body: bytes, rows: int, settings: TraceFormat, numeric: Mapping[int, str]) -> pa.Table | None:
    """Return the table that Arrow reads; None where a cell, a line or the delimiter is beyond it."""
    delimiter = settings.delimiter
    if delimiter == "whitespace":
        body, delimiter = _single_tabs(body), "tab"
    mark = "\t" if delimiter == "tab" else delimiter
    first = body[: body.find(b"\n")] if b"\n" in body else body
    width = len(split_line(first.decode("utf-8", "replace"), delimiter))
    if width <= max(numeric, default=0) or len(mark.encode()) != 1:
        return None
    names = [str(i) for i in range(width)]
    try:
        table = pacsv.read_csv(
            pa.BufferReader(body),
            read_options=pacsv.ReadOptions(column_names=names, use_threads=False, block_size=max(len(body) + 1, 1024)),
            parse_options=pacsv.ParseOptions(delimiter=mark),
            convert_options=pacsv.ConvertOptions(
                decimal_point=settings.decimal, column_types={str(i): pa.float64() for i in numeric}
            ),
        )
    except pa.ArrowInvalid:
        return None
    # Blank lines, or line ends inside quotes: the line numbers would be wrong.
    return table if table.num_rows == rows else None


def _named_columns(table: pa.Table, layout: Layout) -> dict[int, np.ndarray] | None:
    """Return the columns by position; None where something stands beyond the last named one."""
    columns = {i: _column(column) for i, column in enumerate(table.columns)}
    for i in range(len(layout.names), len(columns)) if layout.names else ():
        if columns[i].dtype.kind != "f" or not np.isnan(columns[i]).all():
            return None
        del columns[i]
    return columns


def _lines(body: bytes) -> int:
    return int(np.count_nonzero(np.frombuffer(body, np.uint8) == ord("\n"))) + 1


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_null(kind)


def _column(column: pa.ChunkedArray) -> np.ndarray:
    if _is_number(column.type):
        return column.cast(pa.float64(), safe=False).to_numpy()  # a whole number beyond 2**53 is rounded
    text = np.array(column.cast(pa.string()).to_pylist(), dtype=object)
    text[text == ""] = None
    return text


def _single_tabs(body: bytes) -> bytes:
    if b" " in body or b"\t\t" in body or body.startswith(b"\t") or b"\n\t" in body or b"\t\n" in body:
        body = re.sub(rb"[ \t]+", b"\t", body)
        body = re.sub(rb"(?m)^\t|\t$", b"", body)
    return body


def _patient(body: bytes, layout: Layout, settings: TraceFormat, numeric: Mapping[int, str], file: str) -> Cells:
    """Return the cells line by line, with a fault for everything that is not as it should be."""
    lines = body.decode("utf-8", "replace").split("\n")
    rows, number = [], []
    for i, line in enumerate(lines):
        if line.strip():
            rows.append(split_line(without_strays(line, settings), settings.delimiter))
            number.append(layout.first_line + i)
    line = np.array(number, dtype=np.int64)
    width = len(layout.names) or max((len(row) for row in rows), default=0)
    columns: dict[int, np.ndarray] = {}
    bad = np.zeros(len(rows), bool)
    faults: list[Fault] = []
    for i, name in numeric.items():
        cells = [row[i] if i < len(row) else None for row in rows]
        values = np.array([_float(cell, settings.decimal) for cell in cells], dtype=float)
        wrong = ~np.isfinite(values)
        bad |= wrong
        faults += _cell_faults(np.flatnonzero(wrong), cells, rows, line, name, settings.decimal, file)
        columns[i] = values
    beyond = np.array([any(cell.strip() for cell in row[width:]) for row in rows], dtype=bool)
    faults += _beyond_faults(np.flatnonzero(beyond & ~bad), rows, line, width, file)
    bad |= beyond
    for i in range(width):
        if i not in columns:
            columns[i] = np.array([(row[i].strip() or None) if i < len(row) else None for row in rows], dtype=object)
            if all(cell is None or as_number(cell, settings.decimal) is not None for cell in columns[i]):
                columns[i] = np.array([_float(cell, settings.decimal) for cell in columns[i]])
    return Cells(columns, line, bad, tuple(faults))


def _float(cell: str | None, decimal: str) -> float:
    number = as_number(cell, decimal) if cell is not None else None
    return np.nan if number is None else number


def _cell_faults(at, cells, rows, line, name, decimal, file) -> list[Fault]:
    def make(i: int) -> Fault:
        cell = cells[i]
        place = {"file": file, "line": int(line[i]), "column": name, "action": "row left out"}
        if cell is None:
            reason = f"the line ends after {len(rows[i])} cells."
            return Fault("too_few_cells", reason, fix="Complete or delete the line.", **place)
        if not cell.strip():
            return Fault("empty_cell", "the cell is empty.", fix="Fill it or delete the line.", value="", **place)
        if as_number(cell, decimal) is not None:
            return Fault("not_finite", "is not a finite number.", value=cell.strip(), fix="Delete the line.", **place)
        if match := _REMARK.match(cell):
            remark = match["remark"]
            reason = f"a remark stands beside the number: {remark!r}."
            fix = "Put the right number alone in the cell."
            return Fault("remark", reason, value=cell.strip(), fix=fix, **place)
        fix = decimal_fix(cell, decimal) or "Put a number there or delete the line."
        if i == 0 and len(at) < len(cells) and not any(char.isdigit() for char in cell):
            fix = "If this is a row of units, set units_row = true in the rig config; otherwise delete the line."
        elif _CLOCK.fullmatch(cell.strip()):
            fix = "Export the time as seconds, not as time of day."
        return Fault("not_a_number", "is not a number.", value=cell.strip(), fix=fix, **place)

    def rest(count: int) -> Fault:
        reason = f"and {count} more cells of this column that are not numbers."
        return Fault("not_a_number", reason, file=file, column=name, value=float(count), action="row left out")

    return listed(at, make, rest)


def decimal_fix(cell: str, decimal: str) -> str:
    """Return the fix for a number written with the other decimal mark; "" if that is not what is wrong."""
    if decimal == "." and as_number(cell, ",") is not None:
        return 'Use a decimal point, or set decimal = "," in the rig config.'
    if decimal == "," and as_number(cell, ".") is not None:
        return 'Use a decimal comma, or set decimal = "." in the rig config.'
    return ""


def _beyond_faults(at, rows, line, width, file) -> list[Fault]:
    def make(i: int) -> Fault:
        value = " ".join(cell.strip() for cell in rows[i][width:] if cell.strip())
        words = f"a remark stands beside the numbers: {value!r}." if as_number(value) is None else ""
        reason = words or f"the line has {len(rows[i])} cells where {width} are named."
        fix = "Move it to a column with a name of its own, or delete the line."
        if not words and len(rows[i]) == 2 * width:
            fix = "Decimal commas between commas? Export with another separator, or with decimal points."
        check = "remark" if words else "too_many_cells"
        return Fault(check, reason, file=file, line=int(line[i]), value=value, action="row left out", fix=fix)

    def rest(count: int) -> Fault:
        reason = f"and {count} more lines with cells beyond the last named column."
        return Fault("too_many_cells", reason, file=file, value=float(count), action="row left out")

    return listed(at, make, rest)
