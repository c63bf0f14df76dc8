"""From a folder of files to the draft of a rig config."""

import shlex
from dataclasses import dataclass
from pathlib import Path

from sealfit.config import parse_config
from sealfit.draft import run_keys, trace_keys
from sealfit.draft.columns import columns_of, find_roles, measured_speeds, motion_words
from sealfit.draft.config_text import Doubt, Guess, Notes, config_text
from sealfit.draft.file_names import read_names
from sealfit.draft.files_found import VALUES, find_table, look, read_tables
from sealfit.errors import RequestError

# Guesses that the summary repeats: the others are in the draft.
SHOWN = (
    "trace.columns.", "trace.rate_Hz", "condition", "files.glob", "files.name_pattern", "files.runs_columns",
)  # fmt: skip


@dataclass(frozen=True)
class Draft:
    """A drafted config: its text, the guesses and the doubts; `motion` says in words how the rig moves."""

    text: str
    files: int
    motion: str
    guesses: tuple[Guess, ...]
    doubts: tuple[Doubt, ...]


def draft(folder: Path) -> Draft:
    """Return the draft of a config that reads the trace files in a folder; errors as `look`."""
    found = look(folder)
    notes = Notes()
    tables = read_tables(found)
    roles = find_roles(columns_of(found.dialect, list(tables.values())))
    if roles.time is None and roles.force is None and roles.coefficient is None:
        tables = f"{len(found.traces)} files hold tables of numbers, such as {found.traces[0]}"
        fix = "Give the folder that holds traces: time, displacement and force in columns."
        raise RequestError(f"{tables}, but no time and no force.", file=folder, fix=f"{fix} {VALUES}")
    units = trace_keys.settled_units(roles, notes)
    speeds = measured_speeds(roles, units, list(tables))
    table = find_table(found)
    names = run_keys.suited_to(read_names(found.traces), roles)
    names = run_keys.improved(names, speeds, notes)
    if table is not None:
        names = run_keys.beside_table(names, table)
    given = names.given.union(() if table is None else table.given, () if roles.load is None else ["load_N"])
    header = trace_keys.header_keys(found, given, notes)
    run_keys.source_keys(found, names, table, header, notes)
    trace_keys.dialect_keys(found, notes)
    trace_keys.column_keys(found, roles, units, notes)
    run_keys.condition_keys(names, table, header, notes)
    text = config_text(folder.resolve().name or "rig", shlex.quote(str(folder)), notes)
    # A draft that is no config is a fault of this module, and raises here.
    parse_config(text, "the drafted config")
    words = motion_words(roles)
    return Draft(text, len(found.traces), words, tuple(notes.guesses), tuple(notes.doubts))


def summary_lines(made: dict) -> list[str]:
    """Return what `sealfit init` prints: what was found, what was not determined, the command to run next."""
    count = f"{made['files']} trace file" + ("s" if made["files"] != 1 else "")
    lines = [f"{count} in {made['folder']}; {made['motion']}"]
    shown = [guess for guess in made["guesses"] if guess["key"].startswith(SHOWN)]
    lines += [f"  {guess['key'].rpartition('.')[2]}: {guess['evidence']}" for guess in shown]
    if made["doubts"]:
        lines.append("not determined:")
        lines += [f"  - {doubt['reason']} {doubt['fix']}" for doubt in made["doubts"]]
    return [*lines, f"draft: {made['config']}", f"next: {made['next']}"]
