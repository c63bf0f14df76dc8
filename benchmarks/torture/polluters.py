"""Polluted copies of a text table: the kinds of Pollock, at every place that matters.

The kinds are those of Vitagliano, Hameed, Jiang, Reisener, Wu and Naumann (2023), "Pollock: A Data Loading
Benchmark", PVLDB 16(8), 1870-1882, doi:10.14778/3594512.3594518, and of its generator, and further ones of
cells. Nothing of that generator is used here.
"""

from __future__ import annotations

import codecs
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

Rows = Sequence[Sequence[str]]
ENCODINGS = {
    "UTF-8 with a mark": (codecs.BOM_UTF8, "utf-8"),
    "UTF-16 LE": (codecs.BOM_UTF16_LE, "utf-16-le"),
    "UTF-16 BE": (codecs.BOM_UTF16_BE, "utf-16-be"),
    "UTF-32 LE": (codecs.BOM_UTF32_LE, "utf-32-le"),
    "UTF-16 LE without a mark": (b"", "utf-16-le"),
    "Latin-1": (b"", "latin-1"),
    "cp1252": (b"", "cp1252"),
    "EBCDIC": (b"", "cp500"),
}
# Files of each group of kinds in Pollock's survey, of 4,604 (pollock_weights.json of its repository).
SURVEY = {
    "no payload": 15, "no line end at the end": 184, "two line ends at the end": 5, "no header": 470,
    "several headers": 94, "preamble": 282, "several tables": 188, "header only": 3, "one row": 4,
    "delimiter missing": 338.33, "delimiter added": 338.33, "quote added": 8.52, "delimiter of a row": 13.14,
    "record delimiter": 1698, "field delimiter": 943, "quotation mark": 11, "escape character": 8,
}  # fmt: skip


@dataclass(frozen=True)
class Polluted:
    """One polluted file.

    `kind` is the kind of pollution and `place` where it is; `row` is the row that it concerns (0 for the
    header), None for the whole file. `rows` is how many of the clean rows are in the file, `dialect` what a
    reader would have to be told, and `exact` says whether a reader that is told can read every clean row.
    """

    kind: str
    place: str
    raw: bytes
    rows: int
    row: int | None = None
    dialect: dict = field(default_factory=dict)
    exact: bool = False


def text_of(rows: Rows, delimiter: str = ",", end: str = "\n") -> str:
    """Return rows of cells as text; a cell that holds the delimiter is quoted."""
    cells = ([f'"{cell}"' if delimiter in cell else cell for cell in row] for row in rows)
    return "".join(delimiter.join(row) + end for row in cells)


def polluted(rows: Rows, *, numbers: Sequence[int], every: bool = False) -> Iterator[Polluted]:
    """Yield every polluted copy of a table.

    Parameters
    ----------
    rows : sequence of rows
        Cells, the header first.
    numbers : sequence of int
        Columns (from 0) that hold numbers.
    every : bool
        Whether records are polluted at every row, and not at the header, the first two, the middle and the
        last one only.
    """
    last = len(rows) - 1
    places = range(len(rows)) if every else sorted({0, 1, 2, len(rows) // 2, last})
    yield from _files(rows)
    for row in places:
        yield from _records(rows, row)
        for column in range(len(rows[0])):
            yield from _delimiters(rows, row, column)
            if row:
                yield from _cells(rows, row, column, column in numbers)


def _files(rows: Rows) -> Iterator[Polluted]:
    plain, header, count = text_of(rows), text_of(rows[:1]), len(rows) - 1
    width = len(rows[0])

    def whole(kind: str, place: str, text: str | bytes, rows: int = count, exact=True, **dialect) -> Polluted:
        raw = text if isinstance(text, bytes) else text.encode()
        return Polluted(kind, place, raw, rows, None, dialect, exact)

    yield whole("none", "", plain)
    yield whole("no payload", "", b"", 0, exact=False)
    yield whole("header only", "", header, 0, exact=False)
    yield whole("one row", "", text_of(rows[:2]), 1)
    yield whole("wrong size", "half of the rows", text_of(rows[: len(rows) // 2]), len(rows) // 2 - 1)
    yield whole("wrong size", "a block of zeros at the end", plain.encode() + b"\0" * 512, exact=False)
    yield whole("wrong size", "rows twice", plain + text_of(rows[1:]), exact=False)
    yield whole("no line end at the end", "", plain[:-1])
    yield whole("two line ends at the end", "", plain + "\n")
    yield whole("no header", "", text_of(rows[1:]), header=False)
    for more in (1, 2):
        yield whole("several headers", f"{more + 1}", header * more + plain, preamble=more)
    yield whole(
        "several headers", "a row of units", header + "s" + "," * (width - 1) + "\n" + plain[len(header) :]
    )
    for cells, name in ((1, "less"), (width, "same"), (width + 1, "more")):
        table = text_of([[f"other {i}" for i in range(cells)], *([["7.5"] * cells] * 3)])
        yield whole("several tables", f"{name} columns below", plain + table, exact=False)
        yield whole(
            "several tables", f"{name} columns below an empty line", plain + "\n" + table, exact=False
        )
    yield whole("several tables", "the same again", plain + "\n" + plain, exact=False)
    for lines, name in (("Rig 7\n", "a line"), ("Rig 7\nOil 3\n\n", "two lines, one empty")):
        yield whole("preamble", name, lines + plain, preamble=lines.count("\n"))
        stuffed = "".join(f"{line}{',' * (width - 1)}\n" for line in lines.splitlines())
        yield whole("preamble", f"{name}, delimited", stuffed + plain, preamble=lines.count("\n"))
    for name, line in (("a line", "End of test"), ("delimited", "End" + "," * (width - 1)), ("sum", "Sum,7")):
        yield whole("footer", name, plain + line + "\n", exact=False)
    for name, (mark, codec) in ENCODINGS.items():
        yield whole("encoding", name, mark + plain.encode(codec), encoding=codec)
    yield whole(
        "encoding", "cut in a character", codecs.BOM_UTF16_LE + plain.encode("utf-16-le")[:-1], exact=False
    )
    yield whole("encoding", "bytes that are no text", b"\xff" * 5000, 0, exact=False)
    for name, end in (("CR LF", "\r\n"), ("CR", "\r")):
        yield whole("record delimiter", name, text_of(rows, end=end))
    yield whole("record delimiter", "mixed", "".join(
        line + ("\r\n" if i % 2 else "\n") for i, line in enumerate(plain.splitlines())
    ))  # fmt: skip
    for mark in (";", "\t", " ", "|", ", "):
        name = {"\t": "tab", " ": "blank", ", ": "comma and blank"}.get(mark, mark)
        text = text_of(rows, ",").replace(",", mark) if mark == ", " else text_of(rows, mark)
        yield whole("field delimiter", name, text, delimiter=mark)
    for mark in ('"', "'"):
        quoted = text_of([[f"{mark}{cell}{mark}" for cell in row] for row in rows])
        yield whole("quotation mark", mark, quoted, quote=mark)
    for mark in ("\\", ""):
        shown = text_of([[f'"{mark}"{cell}{mark}""' for cell in row] for row in rows])
        yield whole("escape character", mark or "none", shown, exact=False, escape=mark)
    yield whole("other format", "HTML", f"<html><table>{plain}</table></html>", 0, exact=False)
    yield whole("other format", "JSON", '{"rows": [[0, 1], [2, 3]]}', 0, exact=False)


def _records(rows: Rows, row: int) -> Iterator[Polluted]:
    """Yield what can be wrong with one record."""
    lines, count = [line for line in text_of(rows).split("\n") if line], len(rows) - 1

    def with_line(kind: str, place: str, *line: str, exact: bool = False) -> Polluted:
        text = "\n".join([*lines[:row], *line, *lines[row + 1 :]]) + "\n"
        return Polluted(kind, f"row {row}, {place}", text.encode(), count, row, {}, exact)

    own = lines[row]
    for mark, name in ((" ", "blank"), (";", ";"), ("\t", "tab")):
        yield with_line("delimiter of a row", name, own.replace(",", mark))
    if row < len(lines) - 1:
        text = "\n".join([*lines[:row], own + lines[row + 1], *lines[row + 2 :]]) + "\n"
        yield Polluted("record delimiter missing", f"row {row}", text.encode(), count, row)
    yield with_line("record delimiter added", "before", "", own, exact=True)
    yield with_line("record delimiter added", "CR at the end", own + "\r", exact=True)
    cells = own.split(",")
    yield with_line("cells missing", "the last", ",".join(cells[:-1]))
    yield with_line("cells missing", "all but the first", cells[0])
    yield with_line("cells missing", "the first", ",".join(cells[1:]))
    yield with_line("cells added", "a number", own + ",7.5")
    yield with_line("cells added", "a word", own + ",slipped")
    yield with_line("record twice", "", own, own)
    yield with_line("record quoted", "", f'"{own}"')
    yield with_line("control character", "zero byte", own + "\0")
    yield with_line("control character", "escape", "\x1b[2J" + own)


def _delimiters(rows: Rows, row: int, column: int) -> Iterator[Polluted]:
    """Yield what can be wrong with the marks around one cell."""
    lines, count = [line for line in text_of(rows).split("\n") if line], len(rows) - 1
    cells = lines[row].split(",")

    def with_cells(kind: str, place: str, line: str) -> Polluted:
        text = "\n".join([*lines[:row], line, *lines[row + 1 :]]) + "\n"
        return Polluted(kind, f"row {row}, column {column + 1}{place}", text.encode(), count, row)

    before, after = ",".join(cells[:column]), ",".join(cells[column:])
    if column:
        yield with_cells("delimiter missing", "", before + after)
        yield with_cells("record delimiter inside", "", before + ",\n" + after)
    yield with_cells("delimiter added", "", f"{before},,{after}" if column else f",{after}")
    for place, cell in (
        ("", '"' + cells[column]),
        (", behind", cells[column] + '"'),
        (", both", f'"{cells[column]}"'),
    ):
        yield with_cells("quote added", place, ",".join([*cells[:column], cell, *cells[column + 1 :]]))
    yield with_cells(
        "quote added", ", single", ",".join([*cells[:column], "'" + cells[column], *cells[column + 1 :]])
    )
    yield with_cells(
        "escape added", "", ",".join([*cells[:column], "\\" + cells[column], *cells[column + 1 :]])
    )


def _cells(rows: Rows, row: int, column: int, number: bool) -> Iterator[Polluted]:
    """Yield what one cell can hold that is no clean value."""
    cell, count = rows[row][column], len(rows) - 1
    marks = {
        "empty": "", "blank": " ", "blanks around": f"  {cell} ", "nan": "NaN", "no value": "-", "n/a": "n/a",
        "infinite": "inf", "error of a spreadsheet": "#DIV/0!", "formula": "=A1+1", "word": "slipped",
        "very long": "x" * 20_000,
    }  # fmt: skip
    if number:
        marks |= {
            "decimal comma": cell.replace(".", ","), "unit": f"{cell} N", "thousands": f"1,{cell}",
            "overload": "9.9e37", "apostrophe": f"'{cell}", "letter O": cell.replace("0", "O") + "O",
            "full-width digits": cell.translate({48 + i: 0xFF10 + i for i in range(10)}),
            "hexadecimal": "0x1F",
            "minus sign": "\u2212" + cell, "underscore": cell[:1] + "_" + cell[1:], "power": f"{cell}e400",
            "remark": f"{cell} (slipped)", "clock": "12:30:01", "true": "true",
        }  # fmt: skip
    for name, text in marks.items():
        changed = [list(one) for one in rows]
        changed[row][column] = text
        place = f"row {row}, column {column + 1}: {name}"
        yield Polluted("cell", place, text_of(changed).encode(), count, row, exact=name == "blanks around")
