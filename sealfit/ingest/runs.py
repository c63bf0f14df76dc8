"""The trace files of a campaign and everything that is known of each before it is fitted to anything.

What runs.csv, the file name, the header lines and the constant columns of the trace say is put together here, in this
order of precedence; runs, repeats, specimens and the order of the campaign are derived where they are not given.
"""

from __future__ import annotations

import codecs
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sealfit.conditions import condition_columns
from sealfit.config import Config
from sealfit.errors import BadFile, CampaignError, ConfigError, Fault
from sealfit.ingest.columns import RESERVED, beside, suggestion
from sealfit.ingest.derive import (
    Channels,
    add_order,
    add_repeats,
    add_runs,
    add_specimens,
    condition_keys,
    disagreements,
)
from sealfit.ingest.folder import read_bytes
from sealfit.ingest.names import TEXT_COLUMNS, NameParts, name_parts
from sealfit.ingest.read import read_trace
from sealfit.ingest.refs import TraceRef
from sealfit.ingest.run_values import MISSING, out_of_range, to_values
from sealfit.ingest.runs_csv import Entry, list_entries
from sealfit.ingest.speed_check import measured_speed
from sealfit.ingest.speed_unit import speed_factor
from sealfit.ingest.text import as_utf8, find_layout, header_fields

__all__ = ["TraceRef", "list_traces"]


def list_traces(campaign: Path, config: Config) -> tuple[list[TraceRef], list[Fault]]:
    """Return every trace file of a campaign with its channels, and what was found that does not stop the run.

    Parameters
    ----------
    campaign : Path
        Folder with runs.csv, or with files that the config's glob finds.
    config : Config
        What makes a condition, and what file names and header lines say.

    Raises
    ------
    CampaignError
        With every fault of the campaign at once: a missing folder or column, a path outside, cells that are no
        numbers, doubled files or repeats, repeats that differ from their run, a config that cannot be meant.
    """
    if faults := _config_faults(config):
        raise CampaignError(faults)
    entries, faults = list_entries(campaign, config)
    if any(fault.check in ("path_outside", "missing_file") for fault in faults):
        _stop_at_errors(faults)  # nothing can be said of files that are not there, and none outside is opened
    if not entries:
        raise CampaignError([*faults, _nothing_left()])
    entries, parts, found = _matched(entries, config)
    faults += found
    files = [
        {**_header(campaign, entry.file, config), **named.channels, **_cells(entry)}
        for entry, named in zip(entries, parts, strict=True)
    ]
    entries = [entry.place() for entry in entries]  # their cells are not needed any more, and are much memory
    files, found = to_values(entries, files, config)
    faults += found
    needed = _Needed.of(config)
    files, measured, left_out, found = _from_traces(campaign, entries, files, config, needed)
    keep = [i for i in range(len(entries)) if i not in left_out]
    if not keep:
        raise CampaignError([*faults, *found, _nothing_left()])
    entries, files, measured = ([rows[i] for i in keep] for rows in (entries, files, measured))
    faults += found + _missing(entries, files, needed) + out_of_range(entries, files)
    files, found = add_order(entries, files)
    faults += found
    _stop_at_errors(faults)
    speeds = [channels.get("speed_mm_s") for channels in files]
    conditions = condition_keys(files, config)
    files, found = add_runs(files, conditions, speeds, measured, config.units.unit("speed"))
    faults += found
    files = add_repeats(add_specimens(files, conditions))
    faults += disagreements(entries, files, conditions, speeds)
    _stop_at_errors(faults)
    return [TraceRef(entry.file, _set_speed(channels)) for entry, channels in zip(entries, files, strict=True)], faults


def _nothing_left() -> Fault:
    mend = "Mend what is said above; start with one file."
    return Fault("nothing_left", "no trace file can be used.", mend=mend)


def _set_speed(channels: Channels) -> Channels:
    """Return the channels with the commanded speed under its own name, as a magnitude."""
    if "speed_mm_s" not in channels:
        return channels
    renamed = dict(channels)
    renamed["speed_set_mm_s"] = abs(renamed.pop("speed_mm_s"))
    return renamed


def _stop_at_errors(faults: Sequence[Fault]) -> None:
    errors = [fault for fault in faults if fault.severity == "error" and fault.action == "stopped"]
    if errors:
        raise CampaignError(errors)


def _config_faults(config: Config) -> list[Fault]:
    """Return what is wrong with the config by itself, before any file is opened."""
    settings, faults = config.trace, []

    def add(column: str, value: str, reason: str, mend: str) -> None:
        faults.append(Fault("config", reason, file=f"config '{config.name}'", column=column, value=value, mend=mend))

    if settings.encoding != "auto":
        try:
            codecs.lookup(settings.encoding)
        except LookupError:
            add("trace.encoding", settings.encoding, "is no encoding.", "Use auto, utf-8, latin-1 or utf-16.")
    if settings.delimiter not in ("tab", "whitespace") and (
        len(settings.delimiter) != 1 or settings.delimiter in '"\n\r ' or settings.delimiter.isalnum()
    ):
        add("trace.delimiter", settings.delimiter, "is no delimiter.", "Use one character, 'tab' or 'whitespace'.")
    if settings.delimiter == settings.decimal:
        add("trace.delimiter", settings.delimiter, "is the decimal mark too.", "Set trace.delimiter or trace.decimal.")
    for name in ("file", "speed_mm_s"):
        if name in config.condition:
            add("condition", name, "is no condition: it differs within one.", "Take it out of condition.")
    if settings.names == "none":
        for ours, theirs in settings.columns.items():
            if isinstance(theirs, str):
                mend = "Give its position, counted from 1, or names = 'header'."
                add(f"trace.columns.{ours}", theirs, "is a name, but the files have none.", mend)
    checks = {"quantities": lambda: speed_factor(config.units)}
    if config.files.name_pattern is None:
        checks["files"] = lambda: name_parts("", config.files)
    for column, check in checks.items():
        try:
            check()
        except ConfigError as error:
            add(column, config.name, error.message, error.mend)
    return faults


def _matched(entries: list[Entry], config: Config) -> tuple[list[Entry], list[NameParts], list[Fault]]:
    """Return the entries and what their names say; a file found by the glob whose name says nothing is left out."""
    kept, parts, faults = [], [], []
    for entry in entries:
        try:
            named = name_parts(entry.file, config.files)
        except ConfigError as error:
            raise CampaignError([entry.fault("file_name", error.message, error.column, mend=error.mend)]) from error
        if not named.matched:
            listed = entry.line is not None
            reason = f"the name '{entry.file}' does not match files.name_pattern."
            mend = "Rename it, widen the pattern, or list it under files.exclude."
            place = {"severity": "warning", "action": "kept" if listed else "file left out", "mend": mend}
            faults.append(Fault("not_matched", reason, file=entry.file, **place))
            if not listed:
                continue
        kept.append(entry)
        parts.append(named)
    if entries and not kept:
        mend = "Check files.name_pattern in the rig config."
        reason = f"none of {len(entries)} file names is matched."
        raise CampaignError([*faults[:3], Fault("not_matched", reason, mend=mend)])
    return kept, parts, faults


def _header(campaign: Path, file: str, config: Config) -> Channels:
    """Return what the header lines say; nothing of a file that cannot be read: reading it will say why."""
    if not config.trace.header_fields:
        return {}
    try:
        text = as_utf8(read_bytes(campaign, file, head=True), config.trace.encoding, file, head=True)
        found = header_fields(find_layout(text, config.trace, file).header, config.trace)
    except BadFile:
        return {}
    return {name: value for name, value in found.items() if not name.startswith("_") and value != ""}


def _cells(entry: Entry) -> Channels:
    if MISSING.isdisjoint(map(str.lower, entry.cells.values())):
        return entry.cells
    return {name: cell for name, cell in entry.cells.items() if cell.lower() not in MISSING}


@dataclass(frozen=True, slots=True)
class _Needed:
    """The condition columns that a file must have; of unaged rubber only the days and the rubber are needed."""

    aged: tuple[str, ...]
    unaged: tuple[str, ...]

    @classmethod
    def of(cls, config: Config) -> _Needed:
        aged = tuple(condition_columns(config))
        return cls(aged, ("aging_days", *config.rubber) if config.aging else aged)

    def missing(self, channels: Channels) -> list[str]:
        """Return those that a file lacks."""
        needed = self.unaged if channels.get("aging_days") == 0 else self.aged
        return [name for name in needed if name not in channels]


def _from_traces(
    campaign: Path, entries: Sequence[Entry], files: Sequence[Channels], config: Config, needed: _Needed
) -> tuple[list[Channels], list[float], set[int], list[Fault]]:
    """Return the files with what constant columns of their traces add, reading only files that lack something.

    Also the measured speed of each file read (nan of the others), the files to leave out, and their faults.
    """
    added, measured = list(files), [math.nan] * len(files)
    left_out: set[int] = set()
    faults: list[Fault] = []
    for i, (entry, channels) in enumerate(zip(entries, files, strict=True)):
        wanted = needed.missing(channels)
        if not wanted and ("run_id" in channels or "speed_mm_s" in channels):
            continue
        try:
            table = read_trace(campaign, TraceRef(entry.file, {}), config).table
        except BadFile as error:
            if wanted:  # otherwise it is left out, and said why, when it is read for good
                left_out.add(i)
                faults += error.faults
            continue
        _, plateau = measured_speed(table["time_s"].to_numpy(), table["displacement_mm"].to_numpy())
        measured[i] = plateau * speed_factor(config.units)
        sources = {
            name: beside(name, RESERVED) for name in ("run_id", "repeat", "specimen_id", "started_at", "speed_mm_s")
        }
        sources |= {name: name for name in wanted}
        for name, column in sources.items():
            if name in channels or column not in table:
                continue
            values = table[column]
            if (values == values.iloc[0]).all():
                added[i] = {**added[i], name: _constant(name, values.iloc[0])}
            elif name in wanted:
                reason = f"varies within the file, {values.min()} to {values.max()}; a condition is one value."
                mend = "Write the value that was set into runs.csv."
                place = {"file": entry.file, "column": name, "action": "file left out", "mend": mend}
                faults.append(Fault("condition_varies", reason, **place))
                left_out.add(i)
    return added, measured, left_out, faults


def _constant(name: str, value: float | str) -> float | str:
    if name == "repeat" and not isinstance(value, str):
        return int(value)
    if name in TEXT_COLUMNS and not isinstance(value, str):
        return f"{value:g}"
    return value if isinstance(value, str) else float(value)


def _missing(entries: Sequence[Entry], files: Sequence[Channels], needed: _Needed) -> list[Fault]:
    """Return faults of condition columns that no source gives: one per column, or one per cell."""
    faults = []
    lacking: dict[str, list[int]] = {}
    for i, channels in enumerate(files):
        for name in needed.missing(channels):
            lacking.setdefault(name, []).append(i)
    if not lacking:
        return []
    known = list(dict.fromkeys(name for channels in files for name in channels))
    for name, rows in lacking.items():
        if any(name in channels for channels in files):
            for i in rows:
                mend = "Fill it: it is one of the config's condition columns."
                faults.append(entries[i].fault("empty_cell", "the cell is empty.", name, value="", mend=mend))
        else:
            reason = "there is no such column in runs.csv, file names, header lines or traces."
            mend = suggestion(name, known) + " Add it, or take it out of the config's condition."
            place = {"file": "runs.csv" if entries[0].line is not None else None, "column": name, "mend": mend.strip()}
            faults.append(Fault("missing_column", reason, **place))
    return faults
