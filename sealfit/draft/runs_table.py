"""A table of runs beside the trace files, runs.csv or one under another name, and what its columns mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from sealfit.config import AGING_CONDITION
from sealfit.draft.files_found import text_of
from sealfit.draft.header_lines import SETTINGS
from sealfit.draft.vocabulary import UNAGED, Unit, name_and_unit, setting
from sealfit.errors import BadFile
from sealfit.ingest.files import as_number, split_line
from sealfit.ingest.listing import RUNS_CSV
from sealfit.ingest.start_times import time_of

NAMING = 0.5
"""Share of a column's cells that must be names of trace files: a log may list tests that were not kept."""

MAX_BYTES = 4_000_000
"""A larger file is no list of runs."""


@dataclass(frozen=True)
class RunsTable:
    """A table with a line for each trace file.

    `ours` is our name of each of its columns, by theirs; `units` the units that their names carry; `named` is
    how many of its cells name a trace file, with or without folders and suffix.
    """

    file: str
    ours: Mapping[str, str]
    units: Mapping[str, Unit]
    cells: Mapping[str, tuple[str, ...]]
    named: int

    @property
    def given(self) -> set[str]:
        """Our columns that it gives."""
        return set(self.ours.values())


def find_table(folder: Path, others: Sequence[str], traces: Sequence[str]) -> RunsTable | None:
    """Return the table of runs among files other than traces: runs.csv, else the one that names most."""
    tables = [table for file in others if (table := _table(folder, file, traces)) is not None]
    return max(tables, key=lambda table: (table.file == RUNS_CSV, table.named), default=None)


def _table(folder: Path, file: str, traces: Sequence[str]) -> RunsTable | None:
    try:
        if (folder / file).stat().st_size > MAX_BYTES:
            return None
        text = text_of(folder, file, first_sheet=True)
    except (BadFile, OSError):
        return None
    lines = [line for line in text.split("\n") if line.strip(" \t,;")]
    if len(lines) < 2:
        return None
    delimiter = max((",", ";", "\t"), key=lines[0].count)
    mark = "tab" if delimiter == "\t" else delimiter
    names = [cell.strip() for cell in split_line(lines[0], mark)]
    rows = [[cell.strip() for cell in split_line(line, mark)] for line in lines[1:]]
    cells = {
        name: tuple(row[i] if i < len(row) else "" for row in rows) for i, name in enumerate(names) if name
    }
    naming = {name: _names_files(column, traces) for name, column in cells.items()}
    best = max(naming, key=lambda name: naming[name], default=None)
    if best is None or naming[best] < NAMING * len(rows):
        return None
    ours, units = _meanings(names, best, cells)
    return RunsTable(file, ours, units, cells, naming[best])


def _names_files(column: Sequence[str], traces: Sequence[str]) -> int:
    """Return how many cells name a trace, with or without folders and suffix."""
    paths = [PurePosixPath(file) for file in traces]
    known = {*traces, *(path.with_suffix("").as_posix() for path in paths)}
    known |= {path.name for path in paths} | {path.stem for path in paths}
    return sum(cell.replace("\\", "/") in known for cell in column if cell)


def _meanings(
    names: Sequence[str], file_column: str, cells: Mapping[str, Sequence[str]]
) -> tuple[dict[str, str], dict[str, Unit]]:
    """Return our name of each column that has one, the first of those that mean the same, and their units."""
    ours, units = {file_column: "file"}, {}
    exact = [name for name in names if setting(name) == name]
    for name in [*exact, *names]:
        base, unit = name_and_unit(name)
        meaning = setting(base) or setting(name)
        if unit is not None and unit.dimension != SETTINGS.get(meaning, unit.dimension):
            meaning = ""  # an oven's temperature is no time, whatever word stands beside it
        if not meaning and unit is not None and unit.dimension == "speed":
            meaning = "speed_mm_s"
        if not meaning or name in ours or meaning in ours.values() or not _fits(meaning, cells.get(name, ())):
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
        return all(time_of(cell.replace(",", ".")) for cell in full)
    if meaning in ("specimen_id", "run_id", "rubber", "file"):
        return True
    if meaning in AGING_CONDITION:  # the words for unaged rubber
        full = [cell for cell in full if cell.lower() not in UNAGED]
    numbers = [cell for cell in full if as_number(cell) is not None or as_number(cell, ",") is not None]
    return len(numbers) > 0.8 * len(full)
