"""How a text file of numbers is written, and what its header lines say of the date and the rig.

The data are the lines that hold numbers where the last lines of the sample do; separator and decimal sign are
those that leave nothing but numbers there, else the most of them.
"""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

from sealfit.config import AGING_CONDITION
from sealfit.draft.vocabulary import column_role, name_and_unit, plain, setting
from sealfit.ingest.derived_columns import UNAGED_WORDS, means_unaged
from sealfit.ingest.files import as_number, split_line
from sealfit.ingest.listing import NUMBERS
from sealfit.ingest.runs import formats_that_fit
from sealfit.units import Unit, Units, conversion, unit_of

SAMPLE_LINES = 200  # from the top that are looked at: longer than the headers we know of, by five times
ENDS = 1000  # lines at either end of a file that are looked at for lines that are no data
MIN_ROWS = 8  # fewer rows of numbers are a table of settings or results, not a trace
NAMES_ABOVE = 12  # header lines above the data in which names and units are looked for
STRAYS = ",;| \t"  # what lines end in without meaning: separators of empty columns, or of a spreadsheet
DELIMITERS = ("tab", ";", ",", "|", "whitespace")  # of equally good ones the first is taken

# What header lines may set, and what its unit measures.
SETTINGS = {name: unit_of(Units().of(name)).dimension for name in NUMBERS}
_LINE = re.compile(r'^\W*(?P<key>[^\W\d][^:=;\t"]*?)"?\s*[:=;,\t]+\s*"?(?P<value>.*)$')
_SPECIMEN = re.compile(
    r"(specimen|probe|sample|pruefling|muster)"
    r"( (id|nr|no|number|nummer|name|label|code|kennung|bezeichnung))?"
)
_SIZE = r"[-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?"
_NUMBER = re.compile(rf"{_SIZE}(?=$|[\s;,\t\"°%A-Za-zµ])")
_SAMPLED = r"(?:sampl|abtast|mess|scan|acqui|logg|data|daten|campion|echantillon|muestre)"
_RATE = re.compile(rf"{_SAMPLED}.*(?:rate|freq)|(?:rate|freq).*{_SAMPLED}")  # not that of a motion
_STEP = re.compile(rf"{_SAMPLED}.*(?:interval|period)|(?:interval|period).*{_SAMPLED}|\bdt\b|\bdelta [tx]\b")
RATE = "_rate"  # header field that an expression for the rate reads; by its first letter it is no channel
_QUOTED = re.compile(r'"[-+]?\d+,\d+"')
_DATE = re.compile(r"(?<!\d)(?:20\d\d([-/])\d\d?\1\d\d?|\d\d?(?P<mark>[./])\d\d?(?P=mark)20\d\d)(?!\d)")
_DATES = ("%d.%m.%Y", "%Y-%m-%d", "%Y/%m/%d", "%m/%d/%Y", "%d/%m/%Y")
_ISO = [f"%Y-%m-%d{mark}%H:%M{seconds}" for mark in " T" for seconds in ("", ":%S")]
CLOCK = re.compile(
    r"(?P<clock>[0-2]?\d:[0-5]\d(?P<second>:[0-5]\d)?)(?:[.,]\d+)?(?P<half>\s*[AP]M)?", re.IGNORECASE
)


@dataclass(frozen=True, slots=True)
class Dialect:
    """How one file is written."""

    delimiter: str
    decimal: str  # "" where no number has one
    header: tuple[str, ...]  # lines above the data
    names: tuple[str, ...]  # one per column, or none
    names_back: int | None  # their line, counted back from the header's end, 1 the last
    units: tuple[str, ...]
    units_back: int | None
    numbers: tuple[int, ...]  # positions that hold numbers, from 0
    width: int
    trailing: bool  # lines of data end in separators
    first: str  # line of data
    names_are_cells: bool  # False where the reader cuts the line of names otherwise: names hold separators
    footer: tuple[str, ...]  # lines below the data
    grouped: str  # a cell with marks between thousands, "" where there is none


def sniff(text: str) -> Dialect | None:
    """Return how a text is written; None if it holds no table of numbers with at least two columns.

    Lines end in a line feed.
    """
    lines = text.split("\n")
    if len(lines) > 2 * ENDS:
        lines = lines[:ENDS] + lines[-ENDS:]
    sample = lines[:SAMPLE_LINES]
    # a point before a comma: where there are whole numbers only, the first is taken
    written = [(mark, decimal) for mark, decimal in product(DELIMITERS, ".,") if mark != decimal]
    if any(map(_QUOTED.search, sample)):  # decimal commas between commas
        written.append((",", ","))
    blocks = [_block(sample, *marks) for marks in written]
    tables = [block for block in blocks if block is not None and block.rows >= MIN_ROWS]
    best = max(tables, key=lambda block: (block.pure, block.rows * len(block.numbers)), default=None)
    return None if best is None else _dialect(lines, best)


class _Block(NamedTuple):
    """Data lines under one separator and decimal sign: where they begin and which positions hold numbers."""

    delimiter: str
    decimal: str
    start: int
    rows: int
    numbers: tuple[int, ...]
    pure: bool  # nothing but numbers in its lines


def _block(lines: Sequence[str], delimiter: str, decimal: str) -> _Block | None:
    """Return the data lines: those with numbers where most lines of the second half have them."""
    numbers = [_numeric(line, delimiter, decimal) for line in lines]
    several = [found for found in numbers[len(lines) // 2 :] if found and len(found) >= 2]
    counts = Counter(i for found in several for i in found)
    core = frozenset(i for i, count in counts.items() if count >= 0.9 * len(several))
    data = [(i, found is not None and core <= found) for i, found in enumerate(numbers) if found is not None]
    start = _first_of_many([is_data for _, is_data in data])
    if len(core) < 2 or start is None:
        return None
    rows = [split_line(lines[i], delimiter) for i, good in data[start:] if good]
    full = [sum(bool(cell.strip()) for cell in cells) for cells in rows]
    pure = full.count(len(core)) > 0.9 * len(full)
    return _Block(delimiter, decimal, data[start][0], len(rows), tuple(sorted(core)), pure)


def _numeric(line: str, delimiter: str, decimal: str) -> frozenset[int] | None:
    """Return the positions of numbers in a line; None if it is empty but for separators."""
    bare = line.rstrip(STRAYS)
    if not bare.strip(' "'):
        return None
    cells = enumerate(split_line(bare, delimiter))
    return frozenset(i for i, cell in cells if cell.strip() and as_number(cell, decimal) is not None)


def _first_of_many(data: Sequence[bool]) -> int | None:
    """Return the first line of data that others follow: a table of results above has a few lines only."""
    for i, is_data in enumerate(data):
        following = data[i : i + MIN_ROWS]
        if is_data and sum(following) >= min(MIN_ROWS, len(data) - i) - 1:
            return i
    return None


# A number with marks between its thousands: 1.120,000 or 12'500.5.
_GROUPED = re.compile(r"[+-]?\d{1,3}([., '\u00a0\u202f\u2019])\d{3}(?:\1\d{3})*(?:[.,]\d*)?")


def _dialect(lines: list[str], block: _Block) -> Dialect:
    core, start, delimiter = frozenset(block.numbers), block.start, block.delimiter
    numeric = [_numeric(line, delimiter, block.decimal) for line in lines[start:]]
    is_data = [found is not None and core <= found for found in numeric]
    last = max(i for i, good in enumerate(is_data) if good)
    below = [line for line in lines[start + last + 1 :] if line.strip()]
    data = [line for line, good in zip(lines[start : start + SAMPLE_LINES], is_data, strict=False) if good]
    marks = ("\t" if delimiter == "tab" else delimiter, ",", ";")
    ending = sum(line.rstrip(" ").endswith(marks) for line in data)
    header = lines[:start]
    width = max(len(split_line(line.rstrip(STRAYS), delimiter)) for line in data)
    rows = [_header_cells(line, delimiter, width) for line in header]
    units_at = _units_line(rows)
    names_at = _names_line(rows, units_at, max(core), len(core))
    if names_at is None and units_at is not None and not _of_a_rig(rows[units_at]):  # t, s, F
        names_at, units_at = units_at, None
    cells = [cell.strip() for line in data for cell in split_line(line, delimiter)]
    in_groups = (c for c in cells if _GROUPED.fullmatch(c) and as_number(c, block.decimal) is None)
    return Dialect(
        delimiter=delimiter,
        decimal=block.decimal if any(block.decimal in cell for cell in cells) else "",
        header=tuple(header),
        names=tuple(rows[names_at]) if names_at is not None else (),
        names_back=len(header) - names_at if names_at is not None else None,
        units=tuple(rows[units_at]) if units_at is not None else (),
        units_back=len(header) - units_at if units_at is not None else None,
        numbers=block.numbers,
        width=width,
        trailing=delimiter != "whitespace" and ending > 0.5 * len(data),
        first=data[0],
        names_are_cells=names_at is None or rows[names_at] == _cells_of(header[names_at], delimiter),
        footer=tuple(below),
        grouped=next(in_groups, ""),
    )


def _header_cells(line: str, delimiter: str, width: int) -> list[str]:
    """Return the cells of a header line.

    A mark of comment in a cell of its own is left out; names with blanks in them, above columns of blanks,
    are those that two blanks part.
    """
    cells = _cells_of(line, delimiter)
    if len(cells) == width + 1 and cells[0] in ("#", "%", "//", ";"):  # a mark of comment
        return cells[1:]
    if delimiter == "whitespace" and len(cells) != width:
        apart = re.split(r"\s{2,}|\t", line.strip("#%; \t"))
        return apart if len(apart) == width else []
    return cells


def _cells_of(line: str, delimiter: str) -> list[str]:
    return [cell.strip() for cell in split_line(line.rstrip(STRAYS), delimiter)]


def _units_line(rows: Sequence[Sequence[str]]) -> int | None:
    """Return the line of units nearest to the data: two or more, and more than half of the cells."""
    for i in range(len(rows))[: -NAMES_ABOVE - 1 : -1]:
        full = [cell for cell in rows[i] if cell]
        units = sum(unit_of(cell) is not None for cell in full)
        if units >= 2 and units > 0.5 * len(full) and not all(as_number(cell) is not None for cell in full):
            return i
    return None


def _of_a_rig(units: Sequence[str]) -> bool:
    """Return whether two or more cells are units of time, displacement or force."""
    known = [unit.dimension for cell in units if (unit := unit_of(cell)) is not None]
    return sum(dimension in ("time", "length", "angle", "force", "torque") for dimension in known) >= 2


def _names_line(rows: Sequence[Sequence[str]], units_at: int | None, last: int, count: int) -> int | None:
    """Return the line of names: as wide as the data, no numbers, most words that name columns.

    Units beside the words count if no other line holds them.
    """
    found = []
    for i in range(len(rows))[: -NAMES_ABOVE - 1 : -1]:
        full = [cell for cell in rows[i] if cell]
        texts = all(as_number(cell) is None and as_number(cell, ",") is None for cell in full)
        if i != units_at and len(rows[i]) > last and texts and len(full) >= max(2, count - 1):
            found.append(i)

    def points(i: int) -> int:
        named = [name_and_unit(cell) for cell in rows[i]]
        units = sum(unit is not None for _, unit in named) if units_at is None else 0
        return sum(column_role(name)[1] for name, _ in named) + units

    return max(found, key=points, default=None)


# ---------------------------------------------------------------- header lines


@dataclass(frozen=True, slots=True)
class Setting:
    """A setting in a header line of every file."""

    ours: str  # "" for none
    name: str  # what the files call it
    pattern: str  # that finds it
    unit: Unit | None
    values: tuple[str, ...]  # of each of the files
    line: int  # of the first file
    text: str  # of that line
    unknown: str = ""  # a word behind the number that is no unit known here


@dataclass(frozen=True, slots=True)
class When:
    """A date in header lines."""

    pattern: str  # that finds it
    format: str  # "" for ISO 8601
    line: int
    text: str
    sure: bool  # whether no other order of day and month fits all files
    clock: str = ""  # pattern of the time of day, where that stands in a line of its own


def _settings(headers: Sequence[Sequence[str]], decimal: str) -> Iterator[Setting]:
    """Yield the numbers and the specimens that the header lines of every file give."""
    for line, text in enumerate(headers[0], start=1):
        match = _LINE.match(text)
        if match is None or match["key"].count("/") > 1:
            continue  # group/channel/property of a TDMS file: it is about the channel
        name, unit = name_and_unit(match["key"])
        value, unknown = match["value"].strip(), ""
        number, ours = _NUMBER.match(value), setting(name)
        if ours == "specimen_id":  # Sample rate, Number of samples
            ours = ""
        is_word = ours in AGING_CONDITION and means_unaged(value.strip(STRAYS + '"'))
        if _SPECIMEN.fullmatch(plain(match["key"])):
            ours, pattern = "specimen_id", _after(match["key"], r'([^\s;,"][^;,\t"]*)')
        elif is_word or (number and as_number(number.group(), decimal or ".") is not None):
            pattern = _after(match["key"], rf"({_SIZE})")
            # The unit stands behind the number, or in the next cell.
            words = _found(_after(match["key"], rf"{_SIZE}(?:\"?[;,\t]\"?)?([^;,\t\"]*)"), headers)
            said = {_unit_at_start(text, ours) for text in words if text.strip()}
            unknown = next((text.split()[0] for text in words if text.strip()), "")
            if len(said) > 1:  # 24 h in one file, 7 d in another: one config cannot say it
                continue
            unit = unit or (said.pop() if said else None)
            unknown = unknown if unit is None and unknown[:1].isalpha() else ""
        else:
            continue
        values = tuple(_found(pattern, headers))
        if "" in values and ours in AGING_CONDITION:
            pattern = _after(match["key"], rf"({_SIZE}|(?i:{'|'.join(UNAGED_WORDS)})\b)")
            values = tuple(_found(pattern, headers))
        if "" not in values:
            yield Setting(ours, name, pattern, unit, values, line, text.strip(), unknown)


def _unit_at_start(text: str, ours: str) -> Unit | None:
    """Return the unit of a text, or that of its first word if it is one of the setting: `h at 70 °C`."""
    first = unit_of(text.split()[0])
    return unit_of(text) or (first if first and first.dimension == SETTINGS.get(ours) else None)


def settings_in(headers: Sequence[Sequence[str]], decimal: str) -> list[Setting]:
    """Return the settings that the header lines of every file give, those that their words name."""
    found: dict[str, Setting] = {}
    said = list(_settings(headers, decimal))
    aged = [one for one in said if one.ours == "aging_days" and one.unit]
    ovens = [replace(one, ours="temperature_C") for one in aged if one.unit.dimension == "temperature"]
    for one in [*said, *ovens]:
        fits = one.unit is None or one.unit.dimension == SETTINGS.get(one.ours)
        differs = one.ours == "specimen_id" and len(set(one.values)) > 1
        if differs or (one.ours in SETTINGS and fits):
            found.setdefault(one.ours, one)
    return list(found.values())


def rate_in(headers: Sequence[Sequence[str]], decimal: str) -> tuple[float | str, str, str] | None:
    """Return the rows per second that a header line gives, the line, and the pattern of its number; or None.

    Where files differ in them they are an expression over the number, `RATE`.
    """
    for one in _settings(headers, decimal):
        value, words = as_number(one.values[0], decimal or "."), plain(one.name)
        if not value or value < 0:
            continue
        differ = len(set(one.values)) > 1
        step = one.unit is not None and one.unit.dimension == "time"  # a rate in ms is a step
        if _RATE.search(words) and not step:
            scale = 1000.0 if one.unit is not None and one.unit.name == "kHz" else 1.0
            return f"{scale:g} * {RATE}" if differ else value * scale, one.text, one.pattern
        if (_RATE.search(words) and step) or (_STEP.search(words) and (step or one.unit is None)):
            scale = conversion(one.unit.name if one.unit else "s", "s")(1.0)
            rate = f"1 / ({scale:g} * {RATE})" if differ else float(f"{1 / (scale * value):.9g}")
            return rate, one.text, one.pattern
    return None


def started_in(headers: Sequence[Sequence[str]]) -> When | None:
    """Return the date that the header lines of every file give, ISO 8601 first; None if there is none."""
    found = [_date_in(headers, number, line) for number, line in enumerate(headers[0], start=1)]
    return min(filter(None, found), key=lambda when: when.format != "", default=None)


def _date_in(headers: Sequence[Sequence[str]], number: int, line: str) -> When | None:
    """Return the date of a line with the time of day after it, or in the next line."""
    match = _DATE.search(line)
    if match is None:
        return None
    clock, start, end = CLOCK.search(line, match.end()), match.start(), match.end()
    if clock is not None:
        end = clock.end() if clock["half"] else clock.end("clock")  # strptime reads no fraction of a second
    numbers = re.sub(r"\d+", r"\\d+", re.escape(line[start:end]))
    pattern = f"{_leading(line[:start])}({numbers})"
    pattern = re.sub(r"[AP]M\)$", "[AP]M)", pattern).replace(r"\ ", " ")
    days = [_DATE.search(text) or [""] for text in _found(pattern, headers)]
    fitting = list(formats_that_fit([day[0] for day in days], _DATES))
    if not fitting:
        return None
    spelled, sure = fitting[0], len(fitting) == 1
    following = headers[0][number] if number < len(headers[0]) else ""
    if clock is not None:
        spelled += line[match.end() : clock.start()].replace("%", "%%") + _clock_format(clock)
    elif clock := CLOCK.search(following):
        own = _leading(following[: clock.start()]) + r"(\d+:\d+(?::\d+)?)"
        return When(pattern, f"{spelled} {_clock_format(clock)}", number, line.strip(), sure, own)
    return When(pattern, "" if spelled in _ISO else spelled, number, line.strip(), sure)


def _clock_format(clock: re.Match) -> str:
    hours = "%I" if clock["half"] else "%H"
    return f"{hours}:%M" + (":%S" if clock["second"] else "") + (" %p" if clock["half"] else "")


def _leading(text: str) -> str:
    """Return a pattern for what stands before the date in its line: the words, and whatever numbers."""
    words = re.escape(text).replace(r"\ ", " ").replace("\\\t", r"\t")
    return "^" + re.sub(r"\d+(?:[.,]\d+)?", r"[\\d.,]+", words)


def _after(key: str, value: str) -> str:
    """Return the pattern of a value behind the key of its line."""
    return rf'^\W*{re.escape(key)}"?[\s:=;,"]*'.replace(r"\ ", " ") + value


def _found(pattern: str, headers: Sequence[Sequence[str]]) -> list[str]:
    """Return what a pattern finds in the header lines of each file, "" for nothing."""
    searched = ((re.search(pattern, line) for line in header) for header in headers)
    return [next((match[1].strip() for match in found if match), "") for found in searched]
