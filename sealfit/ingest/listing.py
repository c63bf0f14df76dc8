"""Which trace files a campaign has and what its table or its folder says of each: runs.csv, or a glob."""

import csv
import os
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import SequenceMatcher, get_close_matches
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path

from sealfit.config import AGING_CONDITION, Config, Files
from sealfit.errors import KEPT, NOTED, BadFile, CampaignError, ConfigError, Fault, nearest, printable
from sealfit.ingest.columns import NO_COLUMN, UNIT_IN_BRACKETS, Columns, mapped, suggestion, unit_said
from sealfit.ingest.expression import evaluate, parse
from sealfit.ingest.files import TEXT_COLUMNS, as_number, found_by, inside, split_line
from sealfit.ingest.workbooks import text_of_runs
from sealfit.store.manifest import found_by_glob, glob_names
from sealfit.store.paths import runs_tables
from sealfit.units import Conversion

NUMBERS = (*AGING_CONDITION, "load_N", "speed_mm_s")
KNOWN = (*TEXT_COLUMNS, *NUMBERS, "repeat")
# Words, and codes of loggers, for no value.
MISSING = {"", "na", "n/a", "#n/a", "nan", "null", "none", "-", "?", "-999", "-9999", "-99999"}
PASSED_OVER = {"severity": "info", "action": "file left out"}
FILES_LOOKED_AT = 2000  # for the one that is most like a glob; a campaign's names are much alike
TITLE_LINES = 30  # lines in which the header of a table is looked for
INDEX = ".tdms_index"  # ending of the files that LabVIEW writes beside its traces


@dataclass(frozen=True, slots=True)
class Entry:
    """The place of one trace file in the list, for messages; in no table if the glob found it."""

    file: str
    line: int | None = None
    table: str | None = None  # of runs

    def fault(self, check: str, reason: str, column: str | None = None, **rest) -> Fault:
        """Return a fault at this entry's place: its line in the table of runs, or the file itself."""
        return Fault(check, reason, column=column, file=self.table or self.file, line=self.line, **rest)


def list_entries(campaign: Path, config: Config) -> tuple[list[Entry], Columns, list[Fault]]:
    """Return the trace files of a campaign in order, what runs.csv says of them, and what was found amiss.

    The folder is one that `paths.campaign_folder` accepts: without a table of runs the config's glob finds
    the files, in natural order (2 before 10). CampaignError if runs.csv cannot be read as a table.
    """
    cells: Columns = {}
    if table := _runs_table(campaign, config):
        lines, cells, faults = read_table(campaign, table, config, needed="file")
        files = [_posix(campaign, file) for file in cells.pop("file", [])]
        if not files and not any(fault.severity == "error" for fault in faults):
            raise stopped("no_rows", "has a header but no rows.", "Write one row per trace file.", file=table)
        entries = [Entry(file, line, table) for file, line in zip(files, lines, strict=True)]
        entries, found = _with_whole_paths(campaign, entries, table)
        faults += found
    else:
        entries, faults = _by_glob(campaign, config)
    outside = {entry.file for entry in entries if inside(campaign, entry.file) is None}
    faults = faults + _paths(campaign, entries, outside) + _unlisted(campaign, entries, outside, config)
    return entries, cells, faults


def natural(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that puts `run2` before `run10`."""
    parts = [part for part in re.split(r"(\d+)", name) if part]
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def stopped(check: str, reason: str, fix: str, **place) -> CampaignError:
    """Return the error of a campaign, or of a table, that cannot be used."""
    return CampaignError([Fault(check, reason, fix=fix, **place)])


def _runs_table(campaign: Path, config: Config) -> str | None:
    """Return the table of runs; None if there is none."""
    found, named = runs_tables(campaign, config), config.files.runs_table
    if len(found) > 1:
        fix = "Delete or rename one, or name the one that counts: runs_table under [files] in the rig config."
        raise stopped("several_tables", f"{' and '.join(found)} are both there.", fix, file=found[0])
    if named is not None and not found:
        reason = "does not exist, but files.runs_table names it."
        raise stopped("missing_file", reason, "Check its path.", file=named)
    return found[0] if found else None


def read_table(
    folder: Path, table: str, config: Config, *, needed: str | None = None
) -> tuple[list[int], Columns, list[Fault]]:
    """Return the line of every row of a CSV, Excel or Parquet table, its cells by our names, and its faults.

    Cells are text, None where they say that there is nothing, except in the column that is needed in every
    row. CampaignError if it cannot be read as a table, or that column is not there.
    """
    try:
        text, delimiter = text_of_runs(folder, table, config)
    except BadFile as error:
        raise CampaignError([replace(error.fault, file=table, action="stopped")]) from error
    whole = text.decode().split("\n")
    numbered = [(number, line) for number, line in enumerate(whole, start=1) if line.strip(" \t,;")]
    place, delimiter, header = _header(numbered[:TITLE_LINES], delimiter, config)
    names, faults = _our_names(header, {"file": table, "line": place}, config)
    if needed and needed not in names:
        fix = suggestion(needed, header)
        raise stopped("missing_column", NO_COLUMN, fix, file=table, line=place, column=needed)
    below = [line for line in numbered if line[0] > place]
    lines, columns, found = _rows(below, names, delimiter, table, needed)

    def with_point(cell: str) -> str:
        return cell.replace(",", ".") if as_number(cell, ",") is not None else cell

    def unless_missing(cell: str) -> str | None:
        return None if re.sub(r"(?<=\d)[.,]0+$", "", cell.lower()) in MISSING else cell

    # Decimal commas are plain here: no cell of a table of ; or tabs can be split by them.
    if delimiter != ",":
        columns = {name: mapped(column, with_point) for name, column in columns.items()}
    for name in columns.keys() - {needed}:
        columns[name] = mapped(columns[name], unless_missing)
    return lines, columns, faults + found


def _header(numbered: list[tuple[int, str]], delimiter: str, config: Config) -> tuple[int, str, list[str]]:
    """Return number, delimiter and cells of the first line that names a known column.

    If none does it is the first of several cells: a title has one.
    """
    theirs = (str(own.name) for own in config.files.runs_columns.values())
    known = {"file", *KNOWN, *config.condition, *theirs}
    found = []
    for number, line in numbered:
        own = delimiter or max(",;\t", key=line.count)
        found.append((number, own, split_line(line, own)))
    named = [one for one in found if known & set(one[-1])]
    several = [one for one in found if sum(map(bool, one[-1])) > 1]
    return next(iter(named or several or found), (1, ",", []))


def _rows(
    numbered: list[tuple[int, str]], names: list[str], delimiter: str, table: str, needed: str | None
) -> tuple[list[int], Columns, list[Fault]]:
    """Return the line of every row, the columns that have a name, and the faults of lines left out."""
    lines, rows, faults = [], [], []
    named = max((i for i, name in enumerate(names, start=1) if name), default=0)
    for number, line in numbered:
        cells = split_line(line, delimiter)
        row = {name: cell for name, cell in zip(names, cells, strict=False) if name and cell}
        place = {"file": table, "line": number}
        if '"' in line and _left_open(line, delimiter):
            check, reason, fix = "open_quote", "a quotation mark is left open.", "Close or delete it."
        elif any(cells[len(names) :]):
            reason = f"the line has {len(cells)} cells where {len(names)} are named."
            check, fix = "too_many_cells", "Quote cells with commas."
        elif len(cells) < named:
            reason = f"the line has {len(cells)} cells where {named} are named."
            check, fix = "too_few_cells", "Complete the line: a cell that is empty needs its separator."
        elif needed and needed not in row:
            reason = "no trace file is named." if needed == "file" else "the cell is empty."
            check, fix, place["column"] = "empty_cell", "Fill it.", needed
        else:
            lines.append(number)
            rows.append(row)
            continue
        faults.append(Fault(check, reason, fix=fix, **place))
    return lines, {name: [row.get(name) for row in rows] for name in names if name}, faults


def _left_open(line: str, delimiter: str) -> bool:
    """Whether a cell that begins with a quotation mark holds the end of the line, or is too long to tell."""
    try:
        return next(csv.reader([f"{line}\n"], delimiter=delimiter))[-1].endswith("\n")
    except csv.Error:
        return True


def _our_names(
    header: list[str], place: Mapping[str, str | int], config: Config
) -> tuple[list[str], list[Fault]]:
    """Return our name of every column of a table, and faults: missing, doubled, or misspelt columns."""
    ours = {str(theirs.name): name for name, theirs in config.files.runs_columns.items()}
    names = [ours.get(name, name) for name in header]
    faults = []

    def add(check: str, name: str, reason: str, fix: str) -> None:
        faults.append(Fault(check, reason, column=name, fix=fix, **place))

    for name in sorted({name for name in names if name and names.count(name) > 1}):
        add("duplicate_column", name, f"stands {names.count(name)} times in the header.", "Rename one.")
    for theirs in (name for name in ours if name not in header):
        reason = "there is no such column, but files.runs_columns names it."
        add("missing_column", theirs, reason, suggestion(theirs, header))
    faults += _units_in_header(header, config, place)
    return names, faults + misspelt(names, names, config, place)


def _units_in_header(
    header: Sequence[str], config: Config, place: Mapping[str, str | int]
) -> Iterator[Fault]:
    """Yield a warning for each column whose name has a unit in brackets other than the config's."""
    for ours, theirs in config.files.runs_columns.items():
        name, taken = str(theirs.name), theirs.unit or config.units.of(ours)
        said = UNIT_IN_BRACKETS.search(name)
        if name in header and said and taken:
            own = {**place, "column": name}
            yield from unit_said(said[1], ours, theirs, taken, "files.runs_columns", own)


def misspelt(
    names: Iterable[str], beside: Collection[str], config: Config, place: Mapping[str, str | int]
) -> list[Fault]:
    """Return faults of columns whose names look like one that is not `beside` them; `place` says where."""
    faults, wanted = [], [*dict.fromkeys([*KNOWN, *config.condition])]
    for name in names:
        close = nearest(name, wanted) if name not in wanted and name != "file" else ""
        if not close or close in beside or name.endswith(f"_{close}"):  # lab_temperature_C is another one
            continue
        if close.lower() == name.lower():
            reason, fix = f"differs from '{close}' in the case of letters only.", f"Write '{close}'."
            faults.append(Fault("column_name", reason, fix=fix, column=name, **place))
        elif SequenceMatcher(None, name, close).ratio() > 0.85:
            reason = f"is kept as a channel; it looks like '{close}'."
            fix = f"Write '{close}' if that is meant."
            faults.append(Fault("column_name", reason, fix=fix, column=name, **place, **KEPT))
    return faults


def _posix(campaign: Path, file: str) -> str:
    """Return a listed path with forward slashes and without detours; Windows' backslashes are understood."""
    if "\\" in file and not os.path.exists(campaign / file):
        file = file.replace("\\", "/")
    return os.path.normpath(file) if file else file


def _with_whole_paths(campaign: Path, entries: list[Entry], table: str) -> tuple[list[Entry], list[Fault]]:
    """Return the entries with folders and suffix where a log gives the name of a file only, and notes."""
    missing = {entry.file for entry in entries if not os.path.exists(campaign / entry.file)}
    named: dict[str, list[str]] = defaultdict(list)
    for path in campaign.rglob("*") if missing else ():
        own = path.relative_to(campaign)
        if own.as_posix() != table and own.suffix != INDEX and path.is_file():
            for name in {own.name, own.stem, own.with_suffix("").as_posix()} & missing:
                named[name].append(own.as_posix())
    whole = {name: files[0] for name, files in named.items() if len(files) == 1}
    notes = []
    for entry in (entry for entry in entries if entry.file in whole):
        reason = f"is taken for '{whole[entry.file]}', the only file of that name."
        notes.append(entry.fault("file_name", reason, "file", value=entry.file, **NOTED))
    return [replace(entry, file=whole.get(entry.file, entry.file)) for entry in entries], notes


def _by_glob(campaign: Path, config: Config) -> tuple[list[Entry], list[Fault]]:
    glob = config.files.glob
    files = sorted(found_by_glob(campaign, glob), key=lambda file: (natural(file), file))
    if not files:
        reason = f"no file in '{campaign}' matches files.glob = {glob!r}, "
        reason += "which stands for paths below that folder."
        # The file whose path is most like the glob.
        there = (path.relative_to(campaign).as_posix() for path in campaign.rglob("*") if path.is_file())
        close = get_close_matches(glob, list(islice(there, FILES_LOOKED_AT)), n=1, cutoff=0.0)
        fix = f"The nearest file is '{close[0]}'." if close else "There is no file in it: check the folder."
        raise stopped("missing_file", reason, fix)
    faults, kept = [], []
    for file in files:
        if not is_utf8(file):
            faults.append(_odd_name(file, "error"))
        elif pattern := next((p for p in config.files.exclude if fnmatchcase(file, p)), None):
            reason = f"excluded by files.exclude = {pattern!r}."
            faults.append(Fault("excluded", reason, file=file, **PASSED_OVER))
        else:
            kept.append(Entry(file))
    return kept, faults


def _paths(campaign: Path, entries: list[Entry], outside: set[str]) -> list[Fault]:
    """Return faults of the listed paths: outside the campaign, listed twice, or none of them there."""
    faults, lines = [], {}
    for entry in entries:
        if entry.file in outside:
            reason = "the trace file lies outside the campaign folder."
            fix = "Copy it into the folder of runs.csv and write its path relative to it."
            faults.append(entry.fault("path_outside", reason, "file", value=entry.file, fix=fix))
        elif entry.file in lines:
            reason, fix = f"the trace file is listed already on line {lines[entry.file]}.", "Delete one line."
            faults.append(entry.fault("duplicate_file", reason, "file", value=entry.file, fix=fix))
        lines.setdefault(entry.file, entry.line)
    if entries and not faults and not any(os.path.isfile(campaign / entry.file) for entry in entries):
        reason = f"none of the {len(entries)} trace files listed exists."
        fix = "Paths are relative to the folder of runs.csv."
        faults.append(entries[0].fault("missing_file", reason, "file", value=entries[0].file, fix=fix))
    return faults


def _unlisted(campaign: Path, entries: list[Entry], outside: set[str], config: Config) -> list[Fault]:
    """Return files that runs.csv omits: beside the traces and of the same ending, or matched by the glob."""
    if not entries or entries[0].table is None:
        return []
    table, listed = entries[0].table, {entry.file for entry in entries}
    there, faults = files_beside(campaign, listed - outside), []
    if config.files.glob:
        there.update(found := glob_names(campaign, config.files))
        if not found:
            reason = f"no file matches files.glob = {config.files.glob!r}."
            place = {"file": f"config '{config.name}'", "fix": "Correct it, or take it out."}
            faults = [Fault("config", reason, **place, **KEPT)]
    reason, fix = f"is not in {table}.", f"Add it to {table} if it is a trace."
    for file in sorted(there - listed - {table}, key=natural):
        if not any(fnmatchcase(file, pattern) for pattern in config.files.exclude):
            missed = Fault("not_listed", reason, file=file, fix=fix, **PASSED_OVER)
            faults.append(missed if is_utf8(file) else _odd_name(file, "info"))
    return faults


def is_utf8(file: str) -> bool:
    """Whether the name of a file is text; on Linux it may be any bytes."""
    try:
        file.encode()
    except UnicodeEncodeError:
        return False
    return True


def _odd_name(file: str, severity: str) -> Fault:
    done = {"severity": severity, "action": "file left out", "fix": "Rename it."}
    return Fault("file_name", "the name of the file is not UTF-8.", file=printable(file), **done)


def files_beside(campaign: Path, files: Collection[str]) -> set[str]:
    """Return the files beside `files`, in the same folders and with one of their endings; not `files`."""
    endings, found = {os.path.splitext(file)[1] for file in files}, set()
    for folder in {file.rpartition("/")[0] for file in files}:
        below = f"{folder}/" if folder else ""
        try:
            with os.scandir(campaign / folder) as entries:
                names = [e.name for e in entries if os.path.splitext(e.name)[1] in endings and e.is_file()]
        except OSError:  # no folder, or one that may not be read: its files will say so when they are read
            continue
        found.update(below + name for name in names)
    return found.difference(files)


# ---------------------------------------------------------------- names
# What the name of a trace file says: named parts of a pattern, value maps, templates and computed columns.

_FIELD = re.compile(r"\{([^{}]*)\}")
Named = Mapping[str, float | str]  # what a name says; helpers begin with `_`


def name_parts(file: str, settings: Files, conversions: Mapping[str, Conversion]) -> Named | None:
    """Return what the relative path `file` says under the config's `files`; None if it does not match.

    Every named group of `name_pattern` is a part, with the value of its map where that has one; `compute` and
    the templates of `columns` then add columns. Empty parts say nothing, nor does what is computed from their
    numbers. Numbers in other units than ours are converted, those of parts first. ConfigError if a template
    or an expression reads a part that the pattern does not have, or as `found_by`.

    Examples
    --------
    >>> rig = Files(name_pattern=r"(?P<_sign>n?)(?P<_rpm>\\d+)\\.csv", values={"_sign": {"": 1, "n": -1}},
    ...             compute={"speed_mm_s": "_sign * _rpm"}, columns={"run_id": "{_rpm} rpm"})
    >>> channels_of(name_parts("n120.csv", rig, {}))
    {'speed_mm_s': -120.0, 'run_id': '120 rpm'}
    """
    texts: dict[str, str] = {}
    values: dict[str, float | str] = {}

    def say(name: str, text: str, value: float | str) -> None:
        if name in conversions and isinstance(value, float):
            value = conversions[name].of_cell(value)
            text = f"{value:.12g}"
        texts[name], values[name] = text, value

    if settings.name_pattern is not None:
        match = found_by(settings.name_pattern, file, whole=True)
        if match is None:
            return None
        for name, text in match.groupdict(default="").items():
            known = settings.values.get(name, {})
            mapped = known.get(text, text)
            stays = text in known or name in (*TEXT_COLUMNS, *settings.text_parts)
            if isinstance(mapped, int | float):
                say(name, f"{mapped:g}", float(mapped))
            else:
                say(name, mapped, mapped if stays else _value(mapped))
    for name, expression in settings.compute.items():
        value = float(evaluate(parse(expression), values))
        absent = any(values[part] == "" for part in parse(expression).numbers)
        say(name, *(("", "") if absent else (f"{value:g}", value)))
    for name, template in settings.columns.items():
        text = _FIELD.sub(lambda found: _part(found.group(1), texts, template), template)  # noqa: B023
        say(name, text, text if name in TEXT_COLUMNS else _value(text))
    return {name: value for name, value in values.items() if value != "" or name.startswith("_")}


def channels_of(named: Named | None, helpers: Collection[str] = ()) -> dict[str, float | str]:
    """Return what a name says, of the helpers only those asked for; nothing where it does not match."""
    said = (named or {}).items()
    return {name: v for name, v in said if v != "" and (not name.startswith("_") or name in helpers)}


def _value(text: str) -> float | str:
    number = as_number(text)
    return text if number is None else number


def _part(name: str, texts: Mapping[str, str], template: str) -> str:
    if name not in texts:
        reason = f"template {template!r} reads a part '{name}' that the name has not."
        raise ConfigError(reason, fix=f"Parts: {', '.join(texts) or 'none'}.")
    return texts[name]
