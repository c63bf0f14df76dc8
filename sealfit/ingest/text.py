"""Bytes of a file to clean UTF-8 text, and where its header ends: encodings, byte-order marks, line ends, names."""

from __future__ import annotations

import codecs
import csv
import re
from dataclasses import dataclass

import numpy as np

from sealfit.config import TraceFormat
from sealfit.errors import BadFile, Fault

HEAD_BYTES = 65_536  # a header longer than this is no header
_BOMS = (  # UTF-32 first: its mark begins with that of UTF-16
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_ASCII = ("auto", "utf-8", "utf8", "utf_8", "latin-1")  # encodings that are ASCII where the text is
_CONTROL = bytes(set(range(32)) - {9, 10, 12, 13}) + b"\x7f"


@dataclass(frozen=True, slots=True)
class Layout:
    """Where a trace file's data begin and what its columns are called.

    `header` are the lines before the data, without line ends; `names` is empty where columns go by position;
    `start` is the offset of the first data byte and `first_line` its 1-based line number.
    """

    header: tuple[str, ...]
    names: tuple[str, ...]
    names_line: int | None
    start: int
    first_line: int


def as_utf8(raw: bytes, encoding: str, file: str, *, head: bool = False) -> bytes:
    """Return the text as UTF-8 bytes without byte-order mark, lines ended by a single line feed.

    `auto` looks for a byte-order mark, then for the zero bytes of UTF-16, then tries UTF-8, then takes Latin-1.

    Raises
    ------
    BadFile
        If the bytes are not text in that encoding.
    """
    if _is_plain(raw) and encoding.lower() in _ASCII:
        return raw
    if encoding == "auto":
        encoding = next((name for mark, name in _BOMS if raw.startswith(mark)), None) or _guess(raw)
    elif encoding.lower().replace("_", "-") in ("utf-8", "utf8"):
        encoding = "utf-8-sig"
    if not raw.isascii() or encoding not in ("utf-8", "utf-8-sig", "latin-1"):
        try:
            decoder = codecs.getincrementaldecoder(encoding)()
            text = decoder.decode(raw, final=not head)  # a head may end in the middle of a character
        except UnicodeDecodeError as error:
            if encoding == "utf-8":  # guessed
                text = raw.decode("latin-1")
            else:
                line = raw[: error.start].count(b"\n") + 1
                reason = f"is not {encoding}: byte {error.start} cannot be read."
                raise _bad(file, "wrong_encoding", reason, 'Set encoding = "auto".', line) from error
        raw = text.encode("utf-8", "replace").removeprefix(codecs.BOM_UTF8)
    if raw.translate(None, _CONTROL) != raw:
        place = next(i for i, byte in enumerate(raw) if byte in _CONTROL)
        line = raw[:place].count(b"\n") + 1
        reason = f"is not text: byte {raw[place]:#04x} stands in it."
        raise _bad(file, "binary_file", reason, "Export the trace as text (CSV).", line)
    if b"\r" in raw:
        raw = raw.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return raw


def _is_plain(raw: bytes) -> bool:
    """Return whether the bytes are letters, figures and marks of ASCII between line feeds, and nothing else."""
    codes = np.frombuffer(raw, np.uint8)
    return bool(codes.max(initial=0) < 127) and np.count_nonzero(codes < 32) == np.count_nonzero(codes == 10)


def find_layout(text: bytes, settings: TraceFormat, file: str) -> Layout:
    """Return where the data of a trace file begin.

    Raises
    ------
    BadFile
        If no line matches `header_ends_at`, or the header is longer than the file.
    """
    lines = text[:HEAD_BYTES].decode("utf-8", "ignore").split("\n")
    count = _header_lines(lines, settings, file)
    start = 0
    for _ in range(count):
        end = text.find(b"\n", start)
        if end < 0:
            start = len(text)
            break
        start = end + 1
    header = tuple(lines[:count])
    if settings.names == "none":
        return Layout(header, (), None, start, count + 1)
    back = settings.names_line or (2 if settings.units_row else 1)
    if back > count:
        reason = f"has a header of {count} lines, and its names should stand {back} lines before the data."
        raise _bad(file, "header_not_found", reason, "Check header_lines and names_line in the rig config.")
    names = tuple(name.strip() for name in split_line(without_strays(header[-back], settings), settings.delimiter))
    return Layout(header, names, count - back + 1, start, count + 1)


def split_line(line: str, delimiter: str) -> list[str]:
    """Return the cells of one line; a quoted cell may hold the delimiter."""
    if delimiter == "whitespace":
        return line.split()
    mark = "\t" if delimiter == "tab" else delimiter
    if '"' not in line:
        return line.split(mark)
    try:
        return next(csv.reader([line], delimiter=mark), [])
    except csv.Error:
        return line.split(mark)


def header_fields(header: tuple[str, ...], settings: TraceFormat) -> dict[str, float | str]:
    """Return the channels that the config reads from header lines: the first match of each, numbers as numbers."""
    found: dict[str, float | str] = {}
    for name, pattern in settings.header_fields.items():
        for line in header:
            if match := re.search(pattern, line):
                value = (match.group(1) if match.re.groups else match.group()) or ""
                number = as_number(value, settings.decimal)
                found[name] = value.strip() if number is None else number
                break
    return found


def as_number(cell: str, decimal: str = ".") -> float | None:
    """Return the number in a cell (nan and inf included), or None if it holds none.

    Examples
    --------
    >>> as_number(" 1,5 ", ","), as_number("1,5"), as_number("1_000"), as_number("-2e-3")
    (1.5, None, None, -0.002)
    """
    text = cell.strip()
    if decimal == ",":
        if "." in text:
            return None
        text = text.replace(",", ".")
    if "_" in text:  # Python reads 1_000 as a number; a rig never writes it
        return None
    try:
        return float(text)
    except ValueError:
        return None


def _bad(file: str, check: str, reason: str, fix: str, line: int | None = None) -> BadFile:
    return BadFile(Fault(check, reason, file=file, line=line, action="file left out", fix=fix))


def _guess(raw: bytes) -> str:
    """Return "utf-16-le" or "-be" where every other byte is zero, as in UTF-16 of Latin letters; else "utf-8"."""
    sample = raw[:4096]
    half = len(sample) // 2
    if half > 1 and sample[1::2].count(0) > 0.8 * half and sample[::2].count(0) < 0.1 * half:
        return "utf-16-le"
    if half > 1 and sample[::2].count(0) > 0.8 * half and sample[1::2].count(0) < 0.1 * half:
        return "utf-16-be"
    return "utf-8"


def without_strays(line: str, settings: TraceFormat) -> str:
    """Return a line without the separators that it ends in, where the config says that these are stray."""
    if not settings.trailing_separator:
        return line
    return line.rstrip(",; \t" + (settings.delimiter if len(settings.delimiter) == 1 else ""))


def _header_lines(lines: list[str], settings: TraceFormat, file: str) -> int:
    if settings.header_ends_at is not None:
        for number, line in enumerate(lines, start=1):
            if re.search(settings.header_ends_at, line):
                return number
        reason = f"no line matches header_ends_at = {settings.header_ends_at!r}."
        raise _bad(file, "header_not_found", reason, "Check header_ends_at in the rig config against the file.")
    if settings.header_lines is not None:
        return settings.header_lines
    if settings.names == "none":
        return 0
    blank = next((i for i, line in enumerate(lines) if line.strip()), 0)  # blank lines may stand before the names
    return blank + 1 + settings.units_row
