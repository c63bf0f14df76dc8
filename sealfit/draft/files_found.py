"""Which files of a folder are traces, how they are written, and which of the others is a table of runs."""

import os
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from sealfit.config import AGING_CONDITION, Config, TraceFormat
from sealfit.draft.dialect import MIN_ROWS, SETTINGS, STRAYS, Dialect, sniff
from sealfit.draft.file_names import shape_of, tokens
from sealfit.draft.vocabulary import name_and_unit, setting
from sealfit.errors import BadFile, CampaignError, RequestError, did_you_mean
from sealfit.ingest.derived_columns import means_unaged
from sealfit.ingest.files import as_number, as_utf8, read_bytes, split_line
from sealfit.ingest.formats import OF_ARRAYS, kind_of, read_arrays, value_text
from sealfit.ingest.listing import is_utf8, natural, read_table
from sealfit.ingest.runs import time_of
from sealfit.ingest.workbooks import LONGEST, read_sheet
from sealfit.store.manifest import found_by_glob
from sealfit.store.paths import RUNS as RUNS_CSV
from sealfit.units import Unit

SNIFFED = 24  # files of one kind of name that are looked at, spread evenly: more would show the same
MOST = 240  # files that are looked at, however many ways of naming them there are
READ = 6  # trace files that are read whole, for how their columns behave
WHOLE_BYTES = 8_000_000  # of larger files the first 64 kB are looked at, and their ends are not known
ROWS = 20_000  # of a trace that are read: enough for some strokes
FORMATS = {
    ".xls": "Excel workbooks before 2007", ".h5": "HDF5 files", ".hdf5": "HDF5 files", ".bin": "binary files",
}  # fmt: skip
DOCUMENTS = {
    ".md", ".rst", ".toml", ".json", ".py", ".ipynb", ".m", ".html", ".htm", ".pdf", ".png", ".jpg", ".svg",
    ".ini", ".xml", ".yml", ".yaml", ".zip", ".gz", ".docx", ".doc", ".pptx", ".exe", ".tex",
}  # fmt: skip
_OF_PROGRAMS = re.compile(r"(^|/)(__[^/]*/|~[^/]*$)")  # such as __pycache__/a, and ~$a.xlsx
NO_TRACES = ("readme", "license", "licence", "notice", "sha256sums", "changelog")
NAMING = 0.5  # share of a column's cells that must name traces: a log may list tests that were not kept
MAX_BYTES = 4_000_000  # a larger file is no list of runs


@dataclass(frozen=True)
class Found:
    """The files of a folder, as paths below it."""

    folder: Path
    traces: tuple[str, ...]  # those that one config can read
    dialects: dict[str, Dialect]  # how some of them are written
    wider: dict[str, Dialect]  # how those of them are written that have further columns
    otherwise: dict[str, Dialect]  # traces written in another way
    others: tuple[str, ...]  # files that are no traces
    unreadable: dict[str, str]  # files with the reason
    formats: Counter  # files that sealfit cannot read, by suffix

    @property
    def sniffed(self) -> list[Dialect]:
        """How the traces that were looked at are written."""
        return [*self.dialects.values(), *self.wider.values()]

    @property
    def dialect(self) -> Dialect:
        """How most of the traces are written; the first with fractions, which show the decimal sign."""
        usual = list(self.dialects.values())
        return next((one for one in usual if one.decimal), usual[0])


def look(folder: Path) -> Found:
    """Return what lies in a folder.

    RequestError if there is no such folder, or no trace file in it. CampaignError if the library that reads a
    file is not installed.
    """
    if not folder.is_dir():
        reason = "is a file, not a folder." if folder.is_file() else "there is no such folder."
        fix = did_you_mean(folder) or "Give the folder that holds the trace files."
        raise RequestError(reason, file=folder, fix=fix)
    found = (file for file in found_by_glob(folder, "**/*") if not _OF_PROGRAMS.search(file))
    files = sorted(found, key=natural)
    if odd := [file for file in files if not is_utf8(file)]:
        reason = f"the names of {len(odd)} files are not UTF-8, such as {os.fsencode(odd[0])!r}."
        raise RequestError(reason, file=folder, fix="Rename them.")
    formats = Counter(suffix for file in files if (suffix := PurePosixPath(file).suffix.lower()) in FORMATS)
    texts = [file for file in files if _may_be_trace(file)]
    dialects, unreadable = _sniffed(folder, texts)
    tables = {file: dialect for file, dialect in dialects.items() if dialect is not None and file != RUNS_CSV}
    if not tables:
        raise _no_traces(folder, files, formats, unreadable)
    same, wider, otherwise = _by_form(tables)
    rest = [file for file in texts if file not in dialects and file not in unreadable]
    not_looked_at = _like({**same, **wider}, rest, dialects)
    others = [file for file, dialect in dialects.items() if dialect is None or file == RUNS_CSV]
    traces = sorted([*same, *wider, *not_looked_at], key=natural)
    return Found(folder, tuple(traces), same, wider, otherwise, tuple(others), unreadable, formats)


def _like(same: Collection[str], rest: Sequence[str], looked_at: Collection[str]) -> list[str]:
    """Return those of the files not looked at that are named as the traces are, or have their suffix."""
    kinds, known = {_kind(file) for file in same}, {_kind(file) for file in looked_at}
    suffixes = {kind[0] for kind in kinds}
    named = [(file, _kind(file)) for file in rest]
    return [file for file, kind in named if kind in kinds or (kind not in known and kind[0] in suffixes)]


def _may_be_trace(file: str) -> bool:
    path = PurePosixPath(file.lower())
    return path.suffix not in FORMATS and path.suffix not in DOCUMENTS and not path.name.startswith(NO_TRACES)


def _kind(file: str) -> tuple:
    """Return what files named alike have in common."""
    path = PurePosixPath(file)
    return path.suffix.lower(), shape_of(tokens(str(path.with_suffix(""))))


def _sniffed(folder: Path, texts: Sequence[str]) -> tuple[dict[str, Dialect | None], dict[str, str]]:
    """Return how some files of each kind of name are written, None for no table; and what is unreadable."""
    kinds = defaultdict(list)
    for file in texts:
        kinds[_kind(file)].append(file)
    dialects: dict[str, Dialect | None] = {}
    unreadable: dict[str, str] = {}
    for members in sorted(kinds.values(), key=len, reverse=True):
        if len(dialects) + len(unreadable) >= MOST:
            break
        for file in evenly(members, SNIFFED):
            try:
                dialects[file] = sniff(text_of(folder, file))
            except BadFile as error:
                unreadable[file] = f"{error.fault.reason} {error.fault.fix}".strip()
    return dialects, unreadable


def evenly(items: Sequence[str], count: int) -> list[str]:
    """Return at most so many of the items, spread evenly, the first and the last among them."""
    if len(items) <= count:
        return list(items)
    return [items[round(i * (len(items) - 1) / (count - 1))] for i in range(count)]


def text_of(folder: Path, file: str) -> str:
    """Return a file as text: cells of sheets and arrays lie between tabs.

    Of a large file it is the whole lines of the beginning, of a workbook the sheet with the most rows.
    BadFile if it cannot be read. CampaignError if the library that reads it is not installed.
    """
    kind = kind_of(file)
    if kind in OF_ARRAYS:
        return _text_of_arrays(read_bytes(folder, file), kind)
    if kind == "xlsx":
        return read_sheet(read_bytes(folder, file), LONGEST).decode()
    whole = (folder / file).stat().st_size <= WHOLE_BYTES if (folder / file).exists() else True
    raw = read_bytes(folder, file, head=not whole)
    text = as_utf8(raw, "auto", head=not whole).decode("utf-8", "replace")
    return text if whole else text.rpartition("\n")[0]


def _text_of_arrays(raw: bytes, kind: str) -> str:
    """Return the header lines, names, units and first rows of a file of arrays."""
    found = read_arrays(raw, kind, TraceFormat())
    lines = [*found.header]
    if found.names:
        lines += ["\t".join(found.names), "\t".join(_unit_in(found.header, name) for name in found.names)]
    rows = zip(*(column[:ROWS].tolist() for column in found.columns), strict=True)
    return "\n".join([*lines, *("\t".join(map(value_text, row)) for row in rows)])


def _unit_in(header: Sequence[str], name: str) -> str:
    """Return the unit of a channel by the properties of a TDMS file; "" if there is none."""
    start = f"/{name}/unit_string\t"
    return next((line.partition(start)[2] for line in header if start in line), "")


def _by_form(tables: dict[str, Dialect]) -> tuple[dict[str, Dialect], dict[str, Dialect], dict[str, Dialect]]:
    """Return the files written as most are, those with further columns beside the same, and the others."""
    forms = {file: (one.delimiter, one.names or one.width) for file, one in tables.items()}
    usual_form = Counter(forms.values()).most_common(1)[0][0]
    alike = {file: one for file, one in tables.items() if forms[file] == usual_form}
    decimals = Counter(one.decimal for one in alike.values() if one.decimal)
    decimal = decimals.most_common(1)[0][0] if decimals else ""
    same = {file: one for file, one in alike.items() if one.decimal in (decimal, "")}
    rest = {file: one for file, one in tables.items() if file not in same}
    usual = next(iter(same.values()))
    wider = {file: one for file, one in rest.items() if one.decimal in (decimal, "") and _holds(one, usual)}
    return same, wider, {file: one for file, one in rest.items() if file not in wider}


def _holds(one: Dialect, usual: Dialect) -> bool:
    """Whether a file has all columns of another one, by their names."""
    by_name = usual.names_are_cells and one.names_are_cells and len(set(usual.names)) == len(usual.names) > 0
    return by_name and one.delimiter == usual.delimiter and set(usual.names) <= set(one.names)


VALUES = "A table of values over aging days is fitted by: sealfit fit-aging --values TABLE --out OUT."


def _no_traces(folder: Path, files: Sequence[str], formats: Counter, unreadable: dict) -> RequestError:
    fix = "Give the folder that holds the trace files, or export them as text (CSV)."
    if not files:
        reason = "the folder is empty."
    elif unreadable:
        reason = f"no trace file can be read: {' '.join(next(iter(unreadable.items())))}"
    elif formats:
        what = ", ".join(f"{count} {FORMATS[suffix]} ({suffix})" for suffix, count in formats.most_common())
        reason = f"holds {what} and no trace file that can be read."
    else:
        shown, fix = ", ".join(files[:3]) + (", ..." if len(files) > 3 else ""), f"{fix} {VALUES}"
        reason = f"none of {len(files)} files holds a table of numbers with two columns or more ({shown})."
    return RequestError(reason, file=folder, fix=fix)


def read_tables(found: Found) -> dict[str, np.ndarray]:
    """Return the numbers of some traces, shape (rows, width) each, nan where there are none."""
    tables = {}
    whole = [file for file, one in found.dialects.items() if {*found.dialect.numbers} <= {*one.numbers}]
    for file in evenly(whole, READ):
        dialect = found.dialects[file]
        lines = text_of(found.folder, file).split("\n")
        table = _numbers(lines[len(dialect.header) :], found.dialect)
        if len(table) >= MIN_ROWS:
            tables[file] = table
    return tables


def _numbers(lines: Sequence[str], dialect: Dialect) -> np.ndarray:
    width = max(dialect.numbers) + 1
    rows = []
    for line in lines[:ROWS]:
        cells = split_line(line.rstrip(STRAYS), dialect.delimiter)[:width]
        numbers = [as_number(cell, dialect.decimal or ".") for cell in cells]
        if len(numbers) == width and all(numbers[i] is not None for i in dialect.numbers):
            rows.append([np.nan if number is None else number for number in numbers])
    return np.array(rows)


@dataclass(frozen=True)
class RunsTable:
    """A table with a line for each trace file."""

    file: str
    ours: Mapping[str, str]  # our name of each of its columns, by theirs
    units: Mapping[str, Unit]  # that the names of its columns carry
    cells: Mapping[str, Sequence[str]]
    named: int  # cells that name a trace file, with or without folders and suffix

    @property
    def given(self) -> set[str]:
        """Our columns that it gives."""
        return set(self.ours.values())


def find_table(found: Found) -> RunsTable | None:
    """Return the table of runs among files other than traces: runs.csv, else the one that names most."""
    tables = [own for file in (*found.others, *found.otherwise) if (own := _table(found, file)) is not None]
    return max(tables, key=lambda table: (table.file == RUNS_CSV, table.named), default=None)


def _table(found: Found, file: str) -> RunsTable | None:
    try:
        if (found.folder / file).stat().st_size > MAX_BYTES:
            return None
        _, columns, _ = read_table(found.folder, file, Config())
    except (CampaignError, OSError):
        return None
    cells = {name: [cell or "" for cell in column] for name, column in columns.items()}
    naming = {name: _names_files(column, found.traces) for name, column in cells.items()}
    best = max(naming, key=naming.get, default=None)
    if best is None or not cells[best] or naming[best] < NAMING * len(cells[best]):
        return None
    ours, units = _meanings(best, cells)
    return RunsTable(file, ours, units, cells, naming[best])


def _names_files(column: Sequence[str], traces: Sequence[str]) -> int:
    """Return how many cells name a trace, with or without folders and suffix."""
    paths = [PurePosixPath(file) for file in traces]
    known = {*traces, *(path.with_suffix("").as_posix() for path in paths)}
    known |= {path.name for path in paths} | {path.stem for path in paths}
    return len({cell.replace("\\", "/") for cell in column if cell} & known)


def _meanings(file_column: str, cells: Mapping[str, Sequence[str]]) -> tuple[dict[str, str], dict[str, Unit]]:
    """Return our name of each column that has one, the first of those that mean the same, and their units."""
    ours, units = {file_column: "file"}, {}
    exact = [name for name in cells if setting(name) == name]
    for name in [*exact, *cells]:
        base, unit = name_and_unit(name)
        meaning = setting(base) or setting(name)
        if unit is not None and unit.dimension != SETTINGS.get(meaning):
            meaning = ""  # an oven's temperature is no time, whatever word stands beside it
        if not meaning and unit is not None and unit.dimension == "speed":
            meaning = "speed_mm_s"
        if not meaning or name in ours or meaning in ours.values() or not _fits(meaning, cells[name]):
            continue
        ours[name] = meaning
        if unit is not None:
            units[name] = unit
    return ours, units


def _fits(meaning: str, column: Sequence[str]) -> bool:
    """Whether the cells can be what the name says: numbers, or dates in ISO 8601 or as Excel counts days."""
    full = [cell for cell in column if cell]
    if not full:
        return False
    if meaning == "started_at":
        return all(map(time_of, full))
    if meaning in ("specimen_id", "run_id", "rubber", "file"):
        return True
    if meaning in AGING_CONDITION:  # the words for unaged rubber
        full = [cell for cell in full if not means_unaged(cell)]
    return sum(as_number(cell) is not None for cell in full) > 0.8 * len(full)
