"""Which trace files a campaign has and what its table or its folder says of each: runs.csv, or a glob."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from difflib import SequenceMatcher
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath

from sealfit.config import Config
from sealfit.errors import BadFile, CampaignError, Fault
from sealfit.ingest.columns import nearest, suggestion
from sealfit.ingest.folder import read_bytes
from sealfit.ingest.listing import Folders
from sealfit.ingest.text import as_number, as_utf8, split_line

RUNS_CSV = "runs.csv"
KNOWN = (
    "run_id",
    "repeat",
    "specimen_id",
    "temperature_C",
    "compression_ratio_pct",
    "aging_days",
    "load_N",
    "speed_mm_s",
    "started_at",
)


@dataclass(frozen=True, slots=True)
class Entry:
    """One trace file as it is listed: its place (for messages) and its cells as text, empty ones left out."""

    file: str
    line: int | None = None  # in runs.csv; None where the file was found by the glob
    cells: dict[str, str] = field(default_factory=dict)

    def place(self) -> Entry:
        """Return the entry without its cells."""
        return Entry(self.file, self.line)

    def fault(self, check: str, reason: str, column: str | None = None, **rest) -> Fault:
        """Return a fault at this entry's place: its line in runs.csv, or the file itself."""
        place = {"file": RUNS_CSV, "line": self.line} if self.line is not None else {"file": self.file}
        return Fault(check, reason, column=column, **place, **rest)


def list_entries(campaign: Path, config: Config) -> tuple[list[Entry], list[Fault]]:
    """Return the trace files of a campaign in order, and what was found amiss (errors stop the run).

    runs.csv is read where there is one; otherwise the config's glob finds the files, in natural order (2 before 10).

    Raises
    ------
    CampaignError
        If there is no folder, or neither runs.csv nor a glob, or runs.csv cannot be read as a table.
    """
    if not campaign.is_dir():
        what = "is no folder." if campaign.exists() else "does not exist."
        raise _stop("missing_folder", f"the campaign folder '{campaign}' {what}", "Check the path.")
    if (campaign / RUNS_CSV).exists() or (campaign / RUNS_CSV).is_symlink():
        entries, faults = _read_runs(campaign, config)
    elif config.files.glob is not None:
        entries, faults = _by_glob(campaign, config)
    else:
        count = sum(1 for _ in campaign.rglob("*.csv"))
        mend = f"Write one (the folder holds {count} CSV files), or give a config with files.glob."
        raise _stop("missing_file", f"there is no {RUNS_CSV} in '{campaign}'.", mend, file=RUNS_CSV)
    folders = Folders(campaign)
    outside = {entry.file for entry in entries if not folders.hold(entry.file)}
    return entries, faults + _paths(campaign, entries, outside) + _unlisted(folders, entries, outside, config)


def natural(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that puts `run2` before `run10`."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]


def _stop(check: str, reason: str, mend: str, **place) -> CampaignError:
    return CampaignError([Fault(check, reason, mend=mend, **place)])


def _read_runs(campaign: Path, config: Config) -> tuple[list[Entry], list[Fault]]:
    try:
        text = as_utf8(read_bytes(campaign, RUNS_CSV), "auto", RUNS_CSV).decode()
    except BadFile as error:
        raise _stop(error.fault.check, error.fault.reason, error.fault.mend, file=RUNS_CSV) from error
    lines = [(number, line) for number, line in enumerate(text.split("\n"), start=1) if line.strip(" \t,;")]
    delimiter = max(",;\t", key=lines[0][1].count) if lines else ","
    mark = "tab" if delimiter == "\t" else delimiter
    header = [cell.strip() for cell in split_line(lines[0][1], mark)] if lines else []
    names, faults = _our_names(header, config)
    if "file" not in names:
        mend = suggestion("file", header)
        raise _stop("missing_column", "there is no such column.", mend, file=RUNS_CSV, line=1, column="file")
    entries, unnamed = [], "" in names
    for number, line in lines[1:]:
        cells = [cell.strip() for cell in split_line(line, mark)]
        if any(cells[len(names) :]):
            reason = f"the line has {len(cells)} cells where {len(names)} are named."
            faults.append(Fault("too_many_cells", reason, file=RUNS_CSV, line=number, mend="Quote cells with commas."))
            continue
        if unnamed or "" in cells:
            named = {name: cell for name, cell in zip(names, cells, strict=False) if name and cell}
        else:
            named = dict(zip(names, cells, strict=False))
        if mark != ",":  # decimal commas are plain here: no cell of a table of ; or tabs can be split by them
            named = {n: c.replace(",", ".") if as_number(c, ",") is not None else c for n, c in named.items()}
        file = named.pop("file", "")
        if not file:
            reason = "no trace file is named."
            faults.append(Fault("empty_cell", reason, file=RUNS_CSV, line=number, column="file", mend="Name it."))
            continue
        entries.append(Entry(_posix(campaign, file), number, named))
    if not entries and not any(fault.severity == "error" for fault in faults):
        raise _stop("no_rows", "has a header but no rows.", "Write one row per trace file.", file=RUNS_CSV)
    return entries, faults


def _our_names(header: list[str], config: Config) -> tuple[list[str], list[Fault]]:
    """Return our name of every column of runs.csv, and faults: missing, doubled, or misspelt columns."""
    ours = {theirs: name for name, theirs in config.files.runs_columns.items()}
    names = [ours.get(name, name) for name in header]
    faults = []
    for name in sorted({name for name in names if name and names.count(name) > 1}):
        reason = f"stands {names.count(name)} times in the header."
        faults.append(Fault("duplicate_column", reason, file=RUNS_CSV, line=1, column=name, mend="Rename one."))
    for theirs in ours:
        if theirs not in header:
            reason, mend = "there is no such column, but files.runs_columns names it.", suggestion(theirs, header)
            faults.append(Fault("missing_column", reason, file=RUNS_CSV, line=1, column=theirs, mend=mend))
    wanted = [*dict.fromkeys([*KNOWN, *config.condition])]
    for name in names:
        close = nearest(name, wanted) if name not in wanted and name != "file" else ""
        if close and close.lower() == name.lower() and close not in names:
            reason, mend = f"differs from '{close}' in the case of letters only.", f"Write '{close}'."
            faults.append(Fault("column_name", reason, file=RUNS_CSV, line=1, column=name, mend=mend))
        elif close and close not in names and SequenceMatcher(None, name, close).ratio() > 0.85:
            reason, mend = f"is kept as a channel; it looks like '{close}'.", f"Write '{close}' if that is meant."
            place = {"file": RUNS_CSV, "line": 1, "column": name}
            faults.append(Fault("column_name", reason, severity="warning", action="kept", mend=mend, **place))
    return names, faults


def _posix(campaign: Path, file: str) -> str:
    """Return a path as listed with forward slashes and without detours; Windows' backslashes are understood."""
    if "\\" in file and not (campaign / file).exists():
        file = file.replace("\\", "/")
    return os.path.normpath(file) if file else file


def _by_glob(campaign: Path, config: Config) -> tuple[list[Entry], list[Fault]]:
    glob = config.files.glob
    if PurePosixPath(glob).is_absolute() or ".." in PurePosixPath(glob).parts or not glob:
        raise _stop("path_outside", f"files.glob = {glob!r} leads outside the campaign folder.", "Make it relative.")
    files = sorted((p.relative_to(campaign).as_posix() for p in campaign.glob(glob) if not p.is_dir()), key=natural)
    if not files:
        mend = "Check the folder, or files.glob in the rig config."
        raise _stop("missing_file", f"no file in '{campaign}' matches files.glob = {glob!r}.", mend)
    faults, entries = [], []
    for file in files:
        if pattern := next((p for p in config.files.exclude if fnmatchcase(file, p)), None):
            reason = f"excluded by files.exclude = {pattern!r}."
            faults.append(Fault("excluded", reason, file=file, severity="info", action="file left out"))
        else:
            entries.append(Entry(file))
    return entries, faults


def _paths(campaign: Path, entries: list[Entry], outside: set[str]) -> list[Fault]:
    """Return faults of the listed paths: outside the campaign, listed twice, or none of them there."""
    faults, lines = [], {}
    for entry in entries:
        if entry.file in outside:
            reason = "the trace file lies outside the campaign folder."
            mend = "Copy it into the folder of runs.csv and write its path relative to it."
            faults.append(entry.fault("path_outside", reason, "file", value=entry.file, mend=mend))
        elif entry.file in lines:
            reason = f"the trace file is listed already on line {lines[entry.file]}."
            faults.append(entry.fault("duplicate_file", reason, "file", value=entry.file, mend="Delete one line."))
        lines.setdefault(entry.file, entry.line)
    if entries and not faults and not any((campaign / entry.file).is_file() for entry in entries):
        reason = f"none of the {len(entries)} trace files listed exists."
        mend = "Paths are relative to the folder of runs.csv."
        faults.append(entries[0].fault("missing_file", reason, "file", value=entries[0].file, mend=mend))
    return faults


def _unlisted(folders: Folders, entries: list[Entry], outside: set[str], config: Config) -> list[Fault]:
    """Return files that runs.csv does not list: beside the traces and of the same ending, or matched by the glob."""
    if not entries or entries[0].line is None:
        return []
    listed = {entry.file for entry in entries}
    there = folders.beside(listed - outside)
    if config.files.glob and ".." not in config.files.glob and not config.files.glob.startswith("/"):
        found = (p for p in folders.campaign.glob(config.files.glob) if p.is_file())
        there |= {p.relative_to(folders.campaign).as_posix() for p in found}
    files = there - listed - {RUNS_CSV}
    mend = "Add it to runs.csv if it is a trace."
    return [
        Fault("not_listed", f"is not in {RUNS_CSV}.", file=f, severity="info", action="file left out", mend=mend)
        for f in sorted(files, key=natural)
        if not any(fnmatchcase(f, pattern) for pattern in config.files.exclude)
    ]
