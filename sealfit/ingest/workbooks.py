"""Excel workbooks and tables of runs to text: lines of cells between tabs, read as any other text file.

The number of a line is that of the sheet's row. Numbers are written without loss, dates in ISO 8601.
"""

import io
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from datetime import timedelta
from itertools import takewhile
from pathlib import Path

from sealfit.config import Config
from sealfit.errors import nearest
from sealfit.ingest.files import as_utf8, bad_file, read_bytes
from sealfit.ingest.formats import CALLED, damage_named, kind_of, library, parquet_columns, value_text

HEAD_ROWS = 1000  # a header longer than this is no header
LONGEST = object()  # stands for the sheet with the most rows
_OLE = b"\xd0\xcf\x11\xe0"  # of .xls, and of the shell that Excel puts around an encrypted workbook


def read_sheet(
    raw: bytes,
    sheet: str | int | object | None,
    *,
    decimal: str = ".",
    head: bool = False,
    merged: bool = True,
) -> bytes:
    """Return a sheet of a workbook as text: its name or number (from 1), or None for the only one with cells.

    `LONGEST` is the one with the most rows. With `head`, `HEAD_ROWS` rows are enough. Numbers are written
    with the mark `decimal`. A merged cell has its value in its first place only. BadFile if it is no workbook
    that can be read, has no such sheet, formulas without values, or merged cells that may not be there;
    CampaignError if openpyxl is not installed.
    """
    with _book(raw, formulas=True, by_row=merged) as book:
        title = _title(book, sheet)
        lines, formulas = _lines(book[title], decimal, head)
        if not merged:
            _refuse_merged(book[title])
    if formulas:
        with _book(raw, formulas=False) as book:
            lines, _ = _lines(book[title], decimal, head, formulas)
    return "\n".join(lines).encode("utf-8", "replace")


def rows_of_sheets(raw: bytes) -> dict[str, int]:
    """Return the number of rows with cells of every sheet, the most first; errors as `read_sheet`."""
    with _book(raw, formulas=True) as book:
        return _rows(book)


def _rows(book) -> dict[str, int]:
    rows = {sheet.title: sum(map(_has_cell, sheet.iter_rows(values_only=True))) for sheet in book.worksheets}
    return dict(sorted(rows.items(), key=lambda item: -item[1]))


@contextmanager
def _book(raw: bytes, *, formulas: bool, by_row: bool = True) -> Iterator:
    """Open a workbook with its formulas or their values; `by_row` in little memory, without merged cells."""
    _refuse_others(raw)
    openpyxl = library("openpyxl", "xlsx")
    options = {"read_only": by_row, "data_only": not formulas, "keep_links": False}
    with damage_named("xlsx"), closing(openpyxl.load_workbook(io.BytesIO(raw), **options)) as book:
        for sheet in book.worksheets if by_row else ():
            sheet.reset_dimensions()  # some writers note a size that is not so
        yield book


def _refuse_others(raw: bytes) -> None:
    if raw.startswith(b"PK"):
        return
    reason, fix = "is not an Excel workbook (.xlsx).", "Export it again, or name it for what it is."
    if raw.startswith(_OLE):
        reason, fix = "is a workbook of old Excel (.xls).", "Save it as .xlsx."
        if "EncryptedPackage".encode("utf-16-le") in raw:
            reason = "is protected by a password."
            fix = "Save it without (File > Info > Protect Workbook > Encrypt with Password)."
    raise bad_file("binary_file", reason, fix)


def _title(book, wanted: str | int | object | None) -> str:
    """Return the name of the sheet that is meant."""
    if wanted is LONGEST:
        return next(iter(_rows(book)))
    titles = [sheet.title for sheet in book.worksheets]
    if wanted is None:
        titles = [s.title for s in book.worksheets if any(map(_has_cell, s.iter_rows(values_only=True)))]
    listed = f"The sheets are {', '.join(repr(title) for title in titles)}."
    if isinstance(wanted, int):
        if 0 < wanted <= len(titles):
            return titles[wanted - 1]
        raise bad_file("missing_sheet", f"there is no sheet {wanted}: it has {len(titles)}.", listed)
    if wanted in titles:
        return wanted
    if wanted is not None:
        close = nearest(wanted, titles)
        fix = f"Did you mean '{close}'?" if close else listed
        raise bad_file("missing_sheet", f"there is no sheet '{wanted}'.", fix)
    if not titles:
        raise bad_file("empty_file", "has no sheet with cells.", "Export it again.")
    if len(titles) > 1:
        fix = f"Choose one in the rig config: sheet = {titles[0]!r} under [trace]. {listed}"
        raise bad_file("several_tables", f"has {len(titles)} sheets with cells.", fix)
    return titles[0]


def _has_cell(row: Sequence[object]) -> bool:
    return any(cell is not None for cell in row)


def _lines(
    sheet, decimal: str, head: bool, saved: Collection[tuple[int, int]] = ()
) -> tuple[list[str], set[tuple[int, int]]]:
    """Return the rows as lines, at least as long as the longest above, and row and column of every formula.

    `saved` are the places of formulas whose values are read; raises `BadFile` if Excel kept none of one.
    """
    lines, formulas, width = [], set(), 0
    rows = sheet.iter_rows(max_row=HEAD_ROWS if head else None, values_only=True)
    for number, row in enumerate(rows, start=1):
        cells = []
        for place, value in enumerate(row, start=1):
            # A range of formulas has a `ref`.
            if (isinstance(value, str) and value.startswith("=")) or hasattr(value, "ref"):
                formulas.add((number, place))
            if value is None and (number, place) in saved:
                reason = "the cell holds a formula whose value was not saved."
                fix = "Open it in Excel and save it, or paste values over the formulas."
                column = sheet.cell(number, place).column_letter
                raise bad_file("formula", reason, fix, line=number, column=column)
            cells.append(_cell(value, decimal))
        while cells and not cells[-1]:
            cells.pop()
        width = max(width, len(cells))
        lines.append("\t".join(cells + [""] * (width - len(cells))) if cells else "")
    while lines and not lines[-1]:
        lines.pop()
    return lines, formulas


def _cell(value: object, decimal: str) -> str:
    text = value_text(value)
    if isinstance(value, int | float | timedelta):
        return text.replace(".", decimal)
    return '"' + text.replace('"', '""') + '"' if '"' in text else text


def _refuse_merged(sheet) -> None:
    """Raise `BadFile` if cells are merged, other than those of title lines at the top."""
    rows = sheet.iter_rows(values_only=True)
    titles = sum(1 for _ in takewhile(lambda row: sum(cell is not None for cell in row) < 2, rows))
    below = [cells for cells in sheet.merged_cells.ranges if cells.max_row > titles]
    if merged := sorted(below, key=lambda cells: cells.min_row):
        fix = "Unmerge them and write the value into each, or move remarks to a sheet of their own."
        raise bad_file("merged_cells", f"the cells {merged[0]} are merged.", fix, line=merged[0].min_row)


def text_of_runs(campaign: Path, file: str, config: Config) -> tuple[bytes, str]:
    """Return a table of runs as UTF-8 and the delimiter of its cells, "" where that is to be found out.

    BadFile if it cannot be read, or is of another format; CampaignError if the library is not installed.
    """
    raw, kind = read_bytes(campaign, file), kind_of(file)
    if kind == "csv":
        return as_utf8(raw, "auto"), ""
    if kind == "parquet":
        with damage_named(kind):
            return _parquet_text(raw), "\t"
    if kind == "xlsx":
        sheet = 1 if config.files.runs_sheet is None else config.files.runs_sheet
        return read_sheet(raw, sheet, merged=False), "\t"
    reason = f"is {CALLED[kind]}, which is no table of runs."
    raise bad_file("binary_file", reason, "Save it as .csv, .xlsx or .parquet.")


def _parquet_text(raw: bytes) -> bytes:
    columns = parquet_columns(raw)
    rows = zip(*(column.to_pylist() for column in columns.values()), strict=True)
    lines = ["\t".join(_cell(value, ".") for value in row) for row in (columns, *rows)]
    return "\n".join(lines).encode("utf-8", "replace")
