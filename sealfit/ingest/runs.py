"""The trace files of a campaign and everything that is known of each before it is fitted to anything.

Runs.csv goes before the file name, that before the header lines, and these before the constant columns of the
trace. Runs, repeats, specimens and the order of the campaign are derived where they are not given.
"""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import islice
from pathlib import Path

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.errors import BadFile, CampaignError, ConfigError, Fault, nearest, shortened
from sealfit.ingest import derived_columns as derived
from sealfit.ingest.averages import with_strokes
from sealfit.ingest.columns import (
    RESERVED,
    Column,
    Columns,
    Listing,
    TraceRef,
    beside,
    columns_of,
    condition_columns,
    in_order,
    keys_of,
    known,
    mapped,
    over,
    overlaid,
    suggestion,
    taken,
    where,
)
from sealfit.ingest.expression import parse, read_by
from sealfit.ingest.files import as_number, bad_file, cut_files, found_by, placed, read_bytes
from sealfit.ingest.formats import kind_of
from sealfit.ingest.listing import Entry, channels_of, list_entries, misspelt, name_parts
from sealfit.ingest.reader import read_header, read_trace
from sealfit.ingest.strokes import several_speeds
from sealfit.ingest.trace_checks import measured_speeds
from sealfit.units import Conversion, conversion

EXCEL_DAY_0 = datetime(1899, 12, 30)
EXCEL_DAYS = (32874, 73415)  # 1990 to 2100: other numbers are hours, or seconds, or no times at all
_USUAL = ("%d.%m.%Y", "%d/%m/%Y", "%m/%d/%Y", "%Y/%m/%d", "%d.%m.%y", "%d-%m-%Y", "%d %b %Y", "%Y%m%d")
_CLOCKS = (" %H:%M:%S", " %H:%M", " %I:%M:%S %p", " %I:%M %p", "", "T%H:%M:%S", "_%H%M%S", "_%H%M")

# Columns that are taken from a constant column of a trace where nothing else gives them.
FROM_TRACES = ("run_id", "repeat", "specimen_id", "started_at", "speed_mm_s")
FIX = "Fix what is said above; start with one file."
NOTHING_LEFT = Fault("nothing_left", "no trace file can be used.", fix=FIX)


# ---------------------------------------------------------------- start times
# When files were started, as the log writes it: to ISO 8601, and to the order and hours of the campaign.


def join_date_and_time(entries: list[Entry], columns: Columns, config: Config) -> tuple[Columns, list[Fault]]:
    """Return the columns with `started_at` in place of the config's date and time; faults of these."""
    two = config.files.started_at
    if two is None:
        return columns, []
    missing = [name for name in (two.date, two.time) if name not in columns]
    joined: Column = []
    faults = []
    for name in missing:
        reason = "there is no such column, but files.started_at names it."
        fix = suggestion(name, list(columns))
        faults.append(Fault("missing_column", reason, column=name, fix=fix, file=entries[0].table))
    if missing:
        return columns, faults
    for i, cells in enumerate(zip(columns[two.date], columns[two.time], strict=True)):
        if (cells[0] is None) != (cells[1] is None):
            empty, other = (two.date, two.time) if cells[0] is None else (two.time, two.date)
            reason, fix = f"the cell is empty, but '{other}' is not.", "Fill it, or empty both."
            faults.append(entries[i].fault("empty_cell", reason, empty, value="", fix=fix))
        # A workbook's date is a midnight: 2024-03-01 00:00:00.
        day = re.sub(r"[ T]00:00(:00)?$", "", str(cells[0]).strip())
        joined.append(None if None in cells else f"{day} {str(cells[1]).strip()}")
    rest = {name: column for name, column in columns.items() if name not in (two.date, two.time)}
    return rest | {"started_at": joined}, faults


def add_order(entries: list[Entry], columns: Columns, config: Config) -> tuple[Columns, list[Fault]]:
    """Return the columns with `HISTORY` where files have start times, and faults of bad times.

    Times in one of the config's formats, and Excel's serial numbers, become ISO 8601. Equal times share their
    order. A time with a zone is an instant; one without is UTC beside others with zones.
    """
    if "started_at" not in columns:
        return columns, []
    formats = config.files.date_format
    texts = mapped(columns["started_at"], lambda value: str(value).strip())
    read = {text: time_of(text, formats) for text in set(texts) if text is not None}
    times = mapped(texts, read.__getitem__)
    tried = ", ".join(repr(one) for one in formats)
    reason = f"fits none of the formats tried: {tried}, ISO 8601." if formats else "is not an ISO 8601 time."
    faults = [
        entries[i].fault("not_a_time", reason, "started_at", value=text, fix=_fix(text))
        for i, (text, time) in enumerate(zip(texts, times, strict=True))
        if text is not None and time is None
    ]
    as_given = not formats and config.files.started_at is None
    as_iso = {
        text: time.isoformat() if time and not (as_given and _read(datetime.fromisoformat, text)) else text
        for text, time in read.items()
    }
    columns = columns | {"started_at": mapped(texts, as_iso.__getitem__)}
    if any(time.tzinfo for time in times if time is not None):
        in_zones = mapped(times, lambda time: time if time.tzinfo else time.replace(tzinfo=UTC))
        times = mapped(in_zones, lambda time: time.astimezone(UTC))
    moments = pd.Series(pd.to_datetime(pd.Series(times, dtype=object), utc=True))
    if not moments.notna().any():
        return columns, faults
    hours = (moments - moments.min()) / pd.Timedelta(hours=1)
    orders = {"run_order": moments.rank(method="min"), "elapsed_h": hours}
    specimens = pd.Series(columns.get("specimen_id", [None] * len(entries)), dtype=object)
    if specimens.nunique() > 1:
        orders["specimen_use"] = moments.groupby(specimens).rank(method="min")
    for name, values in orders.items():
        columns[name] = values.astype(object).where(values.notna(), None).tolist()
    return columns, faults


def time_of(text: str, formats: Sequence[str] = ()) -> datetime | None:
    """Return the time by the first format that fits, else ISO 8601, else Excel's serial number, or None."""
    in_formats = (_read(datetime.strptime, text, one) for one in formats)
    return next(filter(None, in_formats), None) or _read(datetime.fromisoformat, text) or excel_time(text)


def _read(reader: Callable[..., datetime], *given: str) -> datetime | None:
    """Return the time, or None: a program without a time writes 0001-01-01, for example."""
    try:
        time = reader(*given)
    except ValueError:
        return None
    return time if time.year >= 1900 else None


def excel_time(text: str) -> datetime | None:
    """Return the time of a serial number of Excel, 45352.395833 or 45352 0.395833; None for other texts."""
    numbers = [as_number(part) for part in text.split()]
    if not numbers or None in numbers or not EXCEL_DAYS[0] <= sum(numbers) < EXCEL_DAYS[1]:
        return None
    return EXCEL_DAY_0 + timedelta(milliseconds=round(sum(numbers) * 86_400_000))


def usual_formats(texts: Sequence[str]) -> list[str]:
    """Return the first two of the usual formats in which all of these dates are, as a config writes them.

    Examples
    --------
    >>> usual_formats(["14/03/2024 09:30"]), usual_formats(["03/02/2024", "14/02/2024"])
    (["'%d/%m/%Y %H:%M'"], ["'%d/%m/%Y'"])
    """
    usual = (date + clock for clock in _CLOCKS for date in _USUAL)
    return list(islice(map(repr, formats_that_fit(texts, usual)), 2))


def formats_that_fit(texts: Sequence[str], formats: Iterable[str]) -> Iterator[str]:
    """Yield those of the formats in which all of these dates are."""
    return (one for one in formats if all(_read(datetime.strptime, text, one) for text in texts))


def _fix(text: str) -> str:
    """Return a fix: the formats that a date is in, by the usual ones, or how it should be written."""
    if likely := usual_formats([text]):
        return f"Set date_format = {' or '.join(likely)} under [files] in the rig config."
    fix = "Write it as 2024-03-01T09:30:00, or give its format: "
    return fix + "date_format = '%d.%m.%Y %H:%M' under [files]."


# ---------------------------------------------------------------- runs


def list_traces(campaign: Path, config: Config) -> tuple[Listing, list[Fault]]:
    """Return every trace file of a campaign with its channels, and what was found that does not stop the run.

    CampaignError has every fault of the campaign at once: a missing folder or column, a path outside, cells
    that are no numbers, doubled files or repeats, repeats that differ from their run.
    """
    entries, cells, faults = list_entries(campaign, config)
    if any(fault.check in ("path_outside", "missing_file") for fault in faults):
        _stop_at_errors(faults)  # nothing can be said of files that are not there, and none outside is opened
    if not entries:
        raise CampaignError([*faults, NOTHING_LEFT])
    kept, named, found = _named(entries, config)
    faults += found
    entries, cells = _kept(kept, entries, cells)
    cells = derived.in_our_units(cells, config.conversions("runs"))
    columns = in_order(overlaid(_headers(campaign, entries, config), named, cells))
    columns, found = join_date_and_time(entries, columns, config)
    faults += found
    columns = derived.with_day_0(derived.with_constants(columns, len(entries), config), config)
    columns, found = derived.to_values(entries, columns, config)
    faults += found
    of_config = [name for name in columns if name not in cells]
    faults += misspelt(of_config, columns, config, {"file": f"config '{config.name}'"})
    columns, measured, left_out, found = _from_traces(campaign, entries, columns, config)
    kept = [i for i in range(len(entries)) if i not in left_out]
    if not kept:
        raise CampaignError([*faults, *found, NOTHING_LEFT])
    entries, columns = _kept(kept, entries, columns)
    columns, measured = in_order(columns), [measured[i] for i in kept]
    faults += found + _missing(entries, columns, config) + derived.out_of_range(entries, columns)
    faults += derived.swapped_columns(entries, columns)
    columns, found = add_order(entries, columns, config)
    faults += found
    files = [entry.file for entry in entries]
    _stop_at_errors(faults, campaign, files)
    columns = derived.as_set(columns)
    of_conditions = {name: columns.get(name, [None] * len(entries)) for name in condition_columns(config)}
    conditions = keys_of(of_conditions, len(entries), config)["condition"]
    columns, found = derived.add_runs(columns, conditions, measured, config.units.unit("speed"))
    faults += found
    # One specimen per condition where none is named.
    specimens = over(columns.get("specimen_id", [None] * len(entries)), conditions)
    columns = derived.add_repeats(columns | {"specimen_id": specimens})
    faults += derived.disagreements(entries, columns, conditions) + derived.pooled_unaged(columns, config)
    _stop_at_errors(faults, campaign, files)
    cut = cut_files(campaign, [file for file in files if kind_of(file, config.trace) == "csv"])
    return Listing(files, _set_speed(columns), conditions, cut), faults


def _kept(files: list[int], entries: list[Entry], columns: Columns) -> tuple[list[Entry], Columns]:
    return [entries[i] for i in files], taken(columns, files)


def _set_speed(columns: Columns) -> Columns:
    """Return the columns with the commanded speed under its own name, as a magnitude."""
    if "speed_mm_s" not in columns:
        return columns
    rest = {name: column for name, column in columns.items() if name != "speed_mm_s"}
    return rest | {"speed_set_mm_s": mapped(columns["speed_mm_s"], abs)}


def _stop_at_errors(faults: Sequence[Fault], campaign: Path | None = None, files: Sequence[str] = ()) -> None:
    """Raise `CampaignError` if there are errors of the campaign, with those of opening its files."""
    errors = [fault for fault in faults if fault.severity == "error" and fault.action == "stopped"]
    if not errors:
        return
    for file in dict.fromkeys(files):
        try:
            read_bytes(campaign, file, head=True)
        except BadFile as error:
            errors += error.faults
    raise CampaignError(errors)


def _named(entries: list[Entry], config: Config) -> tuple[list[int], Columns, list[Fault]]:
    """Return which files to keep, what their names say, and findings; of the glob only those that match."""
    kept, parts, faults = [], [], []
    for i, entry in enumerate(entries):
        try:
            named = name_parts(entry.file, config.files, config.conversions("names"))
        except ConfigError as error:
            fault = entry.fault("file_name", error.message, error.column, fix=error.fix)
            raise CampaignError([fault]) from error
        listed = entry.line is not None
        if named is None:
            reason, fix = unmatched(entry.file, config.files.name_pattern)
            place = {"severity": "warning", "action": "kept" if listed else "file left out", "fix": fix}
            faults.append(Fault("not_matched", reason, file=entry.file, **place))
        if named is not None or listed:
            kept.append(i)
            parts.append(channels_of(named, read_by(config.runs.compute)))
    if not kept:
        pattern = config.files.name_pattern
        nearest = max(faults, key=lambda fault: len(fits_up_to(pattern, fault.file)))
        reason = f"none of {len(entries)} files is matched; of this one, the nearest, {nearest.reason}"
        raise CampaignError([replace(nearest, reason=reason, severity="error", action="stopped")])
    return kept, columns_of(parts), faults


def fits_up_to(pattern: str, file: str) -> str:
    """Return the longest beginning of a path with which a match of the pattern can begin.

    Examples
    --------
    >>> fits_up_to(r"T(?P<T>\\d+)_d(?P<aging_days>\\d+)[.]csv", "T80_C20_d4.csv")
    'T80_'
    """
    begins = (file[:length] for length in range(len(file), 0, -1))
    with suppress(ConfigError):  # it takes too long
        return next((begin for begin in begins if found_by(pattern, begin, whole=True, cut=True)), "")
    return ""


def unmatched(file: str, pattern: str) -> tuple[str, str]:
    """Return why a path does not match the config's pattern, without the path, and the fix."""
    begin = fits_up_to(pattern, file)
    up_to = f"it fits up to '{begin}', then" if begin else "from its start"
    rest = f"'{shortened(file[len(begin) :], 30)}'" if begin != file else "nothing more"
    where = f"{up_to} the path has {rest}"
    reason = f"the whole path below the campaign folder does not match files.name_pattern: {where}."
    fix = "Rename it, widen the pattern, or list it under files.exclude."
    if "/" in file and found_by(pattern, file.rpartition("/")[2], whole=True):
        fix = "The pattern matches the name without its folders: begin it with '(?:.*/)?'."
    return reason, fix


def _headers(campaign: Path, entries: list[Entry], config: Config) -> Columns:
    """Return what header lines say; nothing of a file that cannot be read: reading it will say why."""
    rows = []
    for entry in entries if config.trace.header_fields else ():
        try:
            found = read_header(campaign, entry.file, config)
        except BadFile:
            found = {}
        rows.append(channels_of(found, read_by(config.runs.compute)))
    return columns_of(rows)


def _lacking(columns: Columns, files: int, config: Config) -> dict[str, np.ndarray]:
    """Return which files lack each condition column; unaged rubber needs only the days and the rubber."""
    none, names = [None] * files, condition_columns(config)
    unaged = where(columns.get("aging_days", none), lambda days: days == 0)
    always = ("aging_days", *config.rubber) if config.aging else names
    return {name: ~known(columns.get(name, none)) & (~unaged | (name in always)) for name in names}


def _from_traces(
    campaign: Path, entries: list[Entry], columns: Columns, config: Config
) -> tuple[Columns, list[float], set[int], list[Fault]]:
    """Return the columns with what constant columns of traces add, reading only files that lack something.

    Also the measured speed of each file (nan if not read, or of several), files to leave out, and faults.
    """
    none = [None] * len(entries)
    refs = Listing([entry.file for entry in entries], _set_speed(columns), [])
    lacking = _lacking(columns, len(entries), config)
    runs = known(columns.get("run_id", none)) | known(columns.get("speed_mm_s", none))
    whole = {name: list(column) for name, column in columns.items()}
    measured = [math.nan] * len(entries)
    left_out: set[int] = set()
    faults: list[Fault] = []
    to_read = np.any([~runs, *lacking.values()], axis=0)
    if not to_read.all() and _says_more(campaign, refs[0], columns, config):
        to_read[:] = True
    for i in np.flatnonzero(to_read).tolist():
        wanted, file = [name for name, lack in lacking.items() if lack[i]], entries[i].file
        try:
            trace, strokes = with_strokes(read_trace(campaign, refs[i], config), config)
        except BadFile as error:
            if wanted:  # otherwise it is left out, and said why, when it is read for good
                left_out.add(i)
                faults += error.faults
            continue
        table = trace.table
        if not several_speeds([stroke.speed_mm_s for stroke in strokes]):
            measured[i] = measured_speeds(trace, strokes, config.units)[1]
        sources = {name: beside(name, RESERVED) for name in FROM_TRACES} | {name: name for name in wanted}
        for name, column in sources.items():
            if columns.get(name, none)[i] is not None or column not in table:
                continue
            try:
                value = _constant(name, table[column], wanted=name in wanted)
            except BadFile as error:
                left_out.add(i)
                faults += placed(error.faults, file)
                continue
            if value is not None:
                whole.setdefault(name, list(none))[i] = value
    return whole, measured, left_out, faults


def _constant(name: str, values: pd.Series, *, wanted: bool) -> float | str | None:
    """Return the value of a column of a trace; None, or BadFile where it is `wanted`, if it varies."""
    value = values.iloc[0]
    if (values != value).any():
        if not wanted:
            return None
        reason = f"varies within the file, {values.min()} to {values.max()}; a condition is one value."
        raise bad_file("condition_varies", reason, "Write the value that was set into runs.csv.", column=name)
    if not isinstance(value, str):
        return derived.of_its_kind(name, float(value))
    if name in (*derived.NUMBERS, *derived.COUNTS):
        fix = "Export it as a number, or write it into runs.csv."
        raise bad_file("not_a_number", f"is '{value}', which is no number.", fix, column=name)
    return value


def _says_more(campaign: Path, ref: TraceRef, columns: Columns, config: Config) -> bool:
    """Whether a file has a constant column of `FROM_TRACES` that nothing else gives."""
    try:
        rows = read_trace(campaign, ref, config).columns
    except BadFile:
        return False
    found = (rows.get(beside(name, RESERVED)) for name in FROM_TRACES if name not in columns)
    return any(values is not None and len(set(values)) == 1 for values in found)


def _missing(entries: list[Entry], columns: Columns, config: Config) -> list[Fault]:
    """Return faults of condition columns that no source gives: one per column, or one per cell."""
    faults, table = [], entries[0].table
    lacking = {name: np.flatnonzero(lack) for name, lack in _lacking(columns, len(entries), config).items()}
    for name, rows in sorted(lacking.items(), key=lambda one: one[1][:1].tolist()):
        if name in columns:
            faults += derived.empty_cells(entries, name, rows)
        elif len(rows):
            reason = "there is no such column in runs.csv, file names, header lines or traces."
            fix = suggestion(name, list(columns)) + " Add it, or take it out of the config's condition."
            fix = (table and _in_other_unit(name, columns, config)) or fix
            if (text := config.files.compute.get(name)) is not None:
                reason = f"files.compute.{name} gives no value in any file, such as {entries[0].file}."
                parts = ", ".join(f'{part} = {{"" = 0}}' for part in sorted(parse(text).numbers))
                fix = "Correct files.name_pattern, or "
                fix += f"give the part that is absent there a number under [files.values]: {parts}."
            faults.append(Fault("missing_column", reason, file=table, column=name, fix=fix.strip()))
    return faults


def _in_other_unit(name: str, columns: Columns, config: Config) -> str:
    """Return the fix where the nearest column of the table of runs ends in another unit; "" if none does."""
    close = nearest(name, columns)
    unit, ours = close.rpartition("_")[2], config.units.of(name)
    with suppress(ConfigError):
        if ours and conversion(unit, ours) != Conversion():
            meant = f'{name} = {{name = "{close}", unit = "{unit}"}} under [files.runs_columns]'
            return f"Did you mean '{close}'? Set {meant} in the rig config."
    return ""
