"""Files of a campaign as bytes, never one outside it, and their bytes as clean UTF-8 text."""

import codecs
import csv
import os
import re
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import regex

from sealfit.config import Config, TraceFormat
from sealfit.errors import KEPT, ROW_OUT, BadFile, ConfigError, Fault, did_you_mean, shortened
from sealfit.store.manifest import Fingerprint, fingerprint_of
from sealfit.units import other_unit

LINE_ENDS = b"\r\n\x1a"  # the last is DOS's end of a file
MOST_CUT = 0.25  # Largest share of text files without a line end that are taken for cut: one of four.


def inside(campaign: Path, file: str) -> Path | None:
    """Return the path of `file` if it lies inside the campaign folder, links followed; otherwise None."""
    pure = PurePosixPath(file)
    if pure.is_absolute() or re.match(r"[A-Za-z]:[\\/]|\\\\", file) or "\0" in file:
        return None
    path = campaign / pure
    try:
        resolved, root = path.resolve(), campaign.resolve()
    except (OSError, RuntimeError):  # a loop of links
        return None
    return path if resolved != root and resolved.is_relative_to(root) else None


def read_bytes(campaign: Path, file: str, *, head: bool = False) -> bytes:
    """Return the file's bytes, or with `head` its first ones; raises as `read_marked`."""
    return read_marked(campaign, file, head=head)[0]


def cut_files(campaign: Path, texts: Sequence[str]) -> frozenset[str]:
    """Return those of some text files that do not end with a line end although most do.

    A copy that was broken off ends anywhere, and the part of a number is a number. Some programs write no
    line end after the last line; all of their files lack it.
    """
    lacking = [file for file in texts if not _ends_a_line(os.path.join(campaign, file))]
    return frozenset(lacking if len(lacking) <= MOST_CUT * len(texts) else ())


def _ends_a_line(path: str) -> bool:
    """Whether the last character of a file is a line end, in UTF-16, too; or it cannot be read."""
    if not os.path.isfile(path):  # a pipe would be waited for
        return True
    try:
        with open(path, "rb") as file:
            file.seek(-2, os.SEEK_END)
            return any(byte in LINE_ENDS for byte in file.read())
    except OSError:
        return True


def whole_lines(text: bytes) -> tuple[bytes, Fault]:
    """Return a text without its last line, which may end within a number, and the fault that says so."""
    end = max(text.rfind(b"\n"), text.rfind(b"\r")) + 1
    reason = "the last line has no line end, which most files here have: it may be cut within a number."
    line = text.count(b"\n", 0, end) + 1
    fix = "Copy the file again; if it is whole, end its last line."
    return text[:end], Fault("cut_file", reason, line=line, fix=fix, **ROW_OUT)


def bad_file(check: str, reason: str, fix: str, **place) -> BadFile:
    """Return the error of a file that is left out; the path is added by `in_file`."""
    return BadFile(Fault(check, reason, action="file left out", fix=fix, **place))


def placed(faults: Sequence[Fault], file: str) -> tuple[Fault, ...]:
    """Return what was found in a file with the file's path."""
    return tuple(replace(fault, file=file) for fault in faults)


@contextmanager
def in_file(file: str) -> Iterator[None]:
    """Add the path of a file to the error of reading it."""
    try:
        yield
    except BadFile as error:
        raise BadFile(*placed(error.faults, file)) from error


def read_marked(campaign: Path, file: str, *, head: bool = False) -> tuple[bytes, Fingerprint]:
    """Return the file's bytes, or with `head` its first ones, and the fingerprint of these very bytes.

    BadFile if it is missing, outside the campaign, no file, not readable or empty.
    """
    with in_file(file):
        path = inside(campaign, file)
        if path is None:
            fix = "Copy it into the folder of runs.csv."
            raise bad_file("path_outside", "lies outside the campaign folder.", fix)
        try:
            if not stat.S_ISREG(path.stat().st_mode):  # a pipe would be waited for
                raise bad_file("unreadable_file", "is not a file.", "Check the path.")
            with path.open("rb") as opened:
                status, raw = os.fstat(opened.fileno()), opened.read(HEAD_BYTES if head else -1)
        except FileNotFoundError:
            reason, fix = "does not exist.", did_you_mean(path, Path.is_file, campaign)
            if path.is_symlink():
                reason = f"is a link to '{path.readlink()}', which does not exist."
                fix = "Copy the file itself into the campaign."
            fix = fix or "Paths are relative to the folder of runs.csv."
            raise bad_file("missing_file", reason, fix) from None
        except OSError as error:
            reason = f"cannot be read ({error.strerror})."
            raise bad_file("unreadable_file", reason, "Check its rights.") from error
        marks = [len(mark) for mark, _ in _BOMS if raw.startswith(mark)]
        if not raw[max(marks, default=0) :].strip(b" \t\r\n\0"):
            fix = "Export it again, or leave it out: of runs.csv, or by files.exclude in the rig config."
            raise bad_file("empty_file", "is empty.", fix)
        return raw, fingerprint_of(raw, status)


# ---------------------------------------------------------------- text

# The rest of a header line after a number, if it is a unit.
AT_END = regex.compile(r"""[\s"',;\[(]*([^\W\d_][^\s"',;\])]*)[\s"',;\])]*""")
TEXT_COLUMNS = ("run_id", "specimen_id", "started_at")  # "007" is a name here, not the number 7

HEAD_BYTES = 65_536  # a header longer than this is no header
_BOMS = (  # UTF-32 first: its mark begins with that of UTF-16
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_PACKED = {
    b"PK\x03\x04": "a zip archive or .xlsx workbook",
    b"\x1f\x8b": "gzip",
    b"\xd0\xcf\x11\xe0": "an .xls workbook",
    b"TDSm": "a TDMS file",
    b"PAR1": "a Parquet file",
    b"MATLAB 5.0 MAT-file": "a MAT-file",
    b"MATLAB 7.3 MAT-file": "a MAT-file",
}
_MARKED_UP = {
    b"<!doctype html": "a web page",
    b"<html": "a web page",
    b"<?xml": "an XML file",
    b'{"': "a JSON file",
    b"[{": "a JSON file",
}
_CONTROL = bytes(set(range(32)) - {9, 10, 12, 13}) + b"\x7f"


@dataclass(frozen=True, slots=True)
class FileLayout:
    """Where a trace file's data begin, at byte `start` of line `first_line`, and what its columns are called.

    `header` are the lines before; `names` is empty where columns go by position. Lines count from 1.
    """

    header: tuple[str, ...]
    names: tuple[str, ...]
    names_line: int | None
    start: int
    first_line: int


def as_utf8(raw: bytes, encoding: str, *, head: bool = False) -> bytes:
    """Return the text as UTF-8 bytes without byte-order mark, lines ended by a single line feed.

    `auto` looks for a byte-order mark, then for the zero bytes of UTF-16, then takes UTF-8, and bytes that
    are not UTF-8 as Latin-1. BadFile if it is no text in that encoding, or begins as other formats do.
    """
    if what := next((what for magic, what in _PACKED.items() if raw.startswith(magic)), None):
        fix = "Export it as CSV, or give the file the ending of its format."
        raise bad_file("binary_file", f"is {what}, not text.", fix)
    automatic = encoding == "auto"
    if automatic:
        encoding = next((name for mark, name in _BOMS if raw.startswith(mark)), None) or _guess(raw)
    elif encoding.lower().replace("_", "-") in ("utf-8", "utf8"):
        encoding = "utf-8-sig"
    if not raw.isascii() or encoding not in ("utf-8", "utf-8-sig", "latin-1"):
        try:
            decoder = codecs.getincrementaldecoder(encoding)()
            text = decoder.decode(raw, final=not head)  # a head may end in the middle of a character
        except UnicodeError as error:
            if encoding != "utf-8":
                start = getattr(error, "start", None)
                why = "there is no byte-order mark" if start is None else f"byte {start} cannot be read"
                reason, line = f"is not {encoding}: {why}.", raw[: start or 0].count(b"\n") + 1
                fix = "Export it again." if automatic else 'Set encoding = "auto".'
                raise bad_file("wrong_encoding", reason, fix, line=line) from error
            text = raw.decode("utf-8", "as_latin_1")  # UTF-8 was guessed
        raw = text.encode("utf-8", "replace").removeprefix(codecs.BOM_UTF8)
    raw = raw.rstrip(b"\x1a")  # DOS's end of a file
    if raw.translate(None, _CONTROL) != raw:
        place = next(i for i, byte in enumerate(raw) if byte in _CONTROL)
        reason, line = f"is not text: byte {raw[place]:#04x} stands in it.", raw.count(b"\n", 0, place) + 1
        raise bad_file("binary_file", reason, "Export the trace as text (CSV).", line=line)
    return raw.replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def _latin_1(error: UnicodeError) -> tuple[str, int]:
    return error.object[error.start : error.end].decode("latin-1"), error.end


codecs.register_error("as_latin_1", _latin_1)


def find_layout(text: bytes, settings: TraceFormat) -> FileLayout:
    """Return where the data of a trace file begin; ConfigError as `found_by`.

    BadFile if it is no table (HTML, XML or JSON), if no line matches `header_ends_at`, or if the header is
    shorter than the config says.
    """
    begin = text[:256].lstrip().lower()
    if what := next((what for mark, what in _MARKED_UP.items() if begin.startswith(mark)), None):
        raise bad_file("no_table", f"is {what}, not a table.", "Export the trace as CSV.")
    lines = text[:HEAD_BYTES].decode("utf-8", "ignore").split("\n")
    count = _header_lines(lines, settings)
    parts = text.split(b"\n", count)
    start = len(text) - len(parts[count]) if len(parts) > count else len(text)
    header = tuple(part.decode("utf-8", "ignore") for part in parts[:count])
    if settings.names == "none":
        return FileLayout(header, (), None, start, count + 1)
    back = settings.names_line or (2 if settings.units_row else 1)
    if back > len(header):
        reason = f"has a header of {len(header)} lines, and its names should stand {back} lines before the "
        fix = "Check header_lines and names_line in the rig config."
        raise bad_file("header_not_found", f"{reason}data.", fix)
    names = tuple(split_line(without_strays(header[-back], settings), settings.delimiter))
    return FileLayout(header, names, count - back + 1, start, count + 1)


def split_line(line: str, delimiter: str) -> list[str]:
    """Return the cells of one line without white space around them; a quoted one may hold the delimiter."""
    if delimiter == "whitespace":
        return line.split()
    mark = "\t" if delimiter == "tab" else delimiter
    cells = line.split(mark)
    if '"' in line:
        with suppress(csv.Error):
            cells = next(csv.reader([line], delimiter=mark), [])
    return [cell.strip() for cell in cells]


# Longest time of a pattern of the config on one line or name, in s. Ordinary patterns take microseconds;
# repeats within repeats can take years.
PATTERN_S = 0.5


def found_by(pattern: str, text: str, *, whole: bool = False, cut: bool = False) -> regex.Match | None:
    """Return the first place in a text where a pattern of the config matches; with `whole`, all of the text.

    With `cut` the text may end before the match does. ConfigError if that takes longer than `PATTERN_S`.
    """
    match = regex.fullmatch if whole else regex.search
    try:
        return match(pattern, text, partial=cut, timeout=PATTERN_S)
    except TimeoutError:
        reason = f"the pattern '{shortened(pattern)}' takes too long on '{shortened(text)}'."
        fix = "Write it without repeats within repeats, such as (a+)+."
        raise ConfigError(reason, fix=fix) from None


def header_fields(header: tuple[str, ...], config: Config) -> dict[str, float | str]:
    """Return the channels that a config reads from header lines: the first match of each, in our units."""
    found: dict[str, float | str] = {}
    units = config.conversions("names")
    for name, _, match in _first_matches(header, config):
        value = (match.group(1) if match.re.groups else match.group()) or ""
        stays = name in (*TEXT_COLUMNS, *config.files.text_parts)
        number = None if stays else as_number(value, config.trace.decimal)
        if number is not None and name in units:
            number = units[name].of_cell(number)
        found[name] = value.strip() if number is None else number
    return found


def _first_matches(header: Sequence[str], config: Config) -> Iterator[tuple[str, int, regex.Match]]:
    """Yield the name of each header field that is found, its line from 1, and the match."""
    for name, pattern in config.trace.header_fields.items():
        lines = ((number, found_by(pattern, line)) for number, line in enumerate(header, start=1))
        if found := next((pair for pair in lines if pair[1] is not None), None):
            yield name, *found


def header_field_units(header: Sequence[str], config: Config) -> list[Fault]:
    """Return a warning for each header line that ends in another unit than its number is taken in."""
    faults = []
    for name, line, match in _first_matches(header, config):
        taken = config.files.units.get(name) or config.units.of(name)
        said = AT_END.fullmatch(match.string, match.end(1 if match.re.groups else 0))
        unit = other_unit(said[1], taken) if said and taken else None
        if unit is not None:
            reason = f"the header line says '{said[1]}', and the config takes the number in {taken}."
            fix = f'If the line is right, set {name} = "{unit or said[1]}" under [files.units]. '
            fix += "Files with another unit than the rest need a config of their own."
            faults.append(Fault("unit", reason, fix=fix, line=line, column=name, **KEPT))
    return faults


def as_number(cell: str, decimal: str = ".") -> float | None:
    """Return the number in a cell (nan and inf included), or None if it holds none.

    Examples
    --------
    >>> as_number(" 1,5 ", ","), as_number("1,5"), as_number("1_000"), as_number("-2e-3")
    (1.5, None, None, -0.002)
    """
    if "_" in cell or (
        decimal == "," and "." in cell
    ):  # Python reads 1_000 as a number; a rig never writes it
        return None
    try:
        return float(cell.replace(",", ".") if decimal == "," else cell)
    except ValueError:
        return None


def _guess(raw: bytes) -> str:
    """Return "utf-16-le" or "-be" if every other byte is zero, as in UTF-16 of Latin text; else "utf-8"."""
    sample = raw[:4096]
    half = len(sample) // 2
    zeros = sample[::2].count(0), sample[1::2].count(0)
    if half > 1 and max(zeros) > 0.8 * half and min(zeros) < 0.1 * half:
        return "utf-16-le" if zeros[1] > zeros[0] else "utf-16-be"
    return "utf-8"


def without_strays(line: str, settings: TraceFormat) -> str:
    """Return a line without the separators that it ends in, where the config says that these are stray."""
    if not settings.trailing_separator:
        return line
    return line.rstrip(",; \t" + (settings.delimiter if len(settings.delimiter) == 1 else ""))


def without_footer(text: bytes, footer: str | None, start: int) -> bytes:
    """Return a text up to the first line from `start` on that begins as the footer does; else all of it.

    >>> without_footer(b"Test 1\\nt,x\\n0,1\\nTest ended\\n", "Test", start=11)
    b'Test 1\\nt,x\\n0,1\\n'
    """
    at = -1 if footer is None else text.find(b"\n" + footer.encode(), max(start - 1, 0))
    return text if at < 0 else text[: at + 1]


def _header_lines(lines: list[str], settings: TraceFormat) -> int:
    if settings.header_ends_at is not None:
        for number, line in enumerate(lines, start=1):
            if found_by(settings.header_ends_at, line):
                return number
        reason = f"no line matches header_ends_at = {settings.header_ends_at!r}."
        fix = "Check header_ends_at in the rig config against the file."
        raise bad_file("header_not_found", reason, fix)
    if settings.header_lines is not None:
        return settings.header_lines
    if settings.names == "none":
        return 0
    # Blank lines may stand before the names.
    blank = next((i for i, line in enumerate(lines) if line.strip()), 0)
    return blank + 1 + settings.units_row
