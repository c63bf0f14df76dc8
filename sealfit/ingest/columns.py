"""From a file's columns to ours: which position holds what, and what the other columns are called."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping, Sequence

from sealfit.config import TraceFormat
from sealfit.errors import BadFile, Fault
from sealfit.ingest.expression import parse
from sealfit.ingest.text import Layout, split_line
from sealfit.tables import BINS, RUNS

SLOTS = ("time_s", "displacement_mm", "force_N", "load_N")  # always numbers
# Columns that our tables make themselves: a channel of that name in a trace file gets another, `stroke_file`.
RESERVED = ({column.name for schema in (BINS, RUNS) for column in schema.columns} | {"line", "steady"}) - set(SLOTS)


def numeric_names(settings: TraceFormat) -> set[str]:
    """Return the columns that must hold numbers: the slots and whatever an expression or the integral reads."""
    texts = [parse(text) for text in settings.compute.values()]
    if settings.keep is not None:
        texts.append(parse(settings.keep, condition=True))
    names = set(SLOTS).union(*(text.names for text in texts))
    return names | {settings.integrate_displacement} if settings.integrate_displacement else names


def locate(layout: Layout, width: int, settings: TraceFormat, file: str) -> dict[int, str]:
    """Return our name for each position (from 0) of a file with `width` columns.

    Columns that the config does not list keep the file's name (`column_4` where it has none), or a name beside it
    where the config gives that name to another column.

    Raises
    ------
    BadFile
        If a column is missing or its name stands twice; the nearest name is suggested.
    """
    found: dict[int, str] = {}
    faults = []
    for ours, theirs in settings.columns.items():
        if isinstance(theirs, int):
            positions = [theirs - 1] if 0 < theirs <= width else []
        else:
            positions = [i for i, name in enumerate(layout.names) if name == theirs]
        if len(positions) == 1:
            found[positions[0]] = ours
        elif positions:
            fix = "Rename one, or name the column by its position in the rig config."
            faults.append(
                _fault("duplicate_column", f"stands {len(positions)} times in the header.", layout, file, theirs, fix)
            )
        elif ours not in settings.optional:
            faults.append(_missing(theirs, layout, width, settings, file))
    if faults:
        raise BadFile(*faults)
    if settings.other_columns == "channels":
        for i in range(width):
            if i not in found:
                named = layout.names[i] if i < len(layout.names) else ""
                found[i] = beside(named or f"column_{i + 1}", list(found.values()))
    return found


def beside(name: str, taken: Collection[str]) -> str:
    """Return the name, or one beside it where it is taken.

    Examples
    --------
    >>> beside("stroke", {"stroke"}), beside("speed_mm_s", {"speed_mm_s"}), beside("humidity_pct", ())
    ('stroke_file', 'speed_file_mm_s', 'humidity_pct')
    """
    while name in taken:
        for unit in ("_mm_s", "_mm", "_N", "_s", "_C", "_pct", "_h", "_days", "_bar", ""):
            if name.endswith(unit) and name != unit:
                name = f"{name.removesuffix(unit)}_file{unit}"
                break
    return name


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the known name that `name` most likely means: the same in other case, or a close one; "" if none."""
    known = [other for other in known if other]
    by_case = [other for other in known if other.lower() == name.lower()]
    folded = {other.lower(): other for other in known}
    close = difflib.get_close_matches(name.lower(), list(folded), n=1, cutoff=0.6)
    return by_case[0] if by_case else folded[close[0]] if close else ""


def suggestion(name: str, known: Sequence[str]) -> str:
    """Return a fix for a missing column: the nearest name, or the names that there are."""
    if close := nearest(name, known):
        case = " (the case of letters matters)" if close.lower() == name.lower() else ""
        return f"Did you mean '{close}'?{case}"
    return f"The columns are {', '.join(repr(n) for n in known if n)}." if any(known) else ""


def required(table: Mapping[str, object], layout: Layout, file: str) -> None:
    """Raise `BadFile` if, after everything is computed, a slot that every trace needs is not there."""
    missing = [name for name in SLOTS[:3] if name not in table]
    if missing:
        fix = "Name it under [trace.columns], compute it under [trace.compute], or integrate it from a speed column."
        raise BadFile(
            *(_fault("missing_column", "there is no such column.", layout, file, name, fix) for name in missing)
        )


def _missing(theirs: str | int, layout: Layout, width: int, settings: TraceFormat, file: str) -> Fault:
    if isinstance(theirs, int):
        reason = f"there is no column {theirs}: the lines have {width}."
        fix = "Check delimiter and positions in the rig config."
        return _fault("missing_column", reason, layout, file, theirs, fix)
    fix = suggestion(theirs, layout.names)
    if len(layout.names) <= 1 and layout.names_line is not None:
        line = layout.header[layout.names_line - 1]
        for mark, word in ((";", '";"'), ("\t", '"tab"'), (",", '","'), (" ", '"whitespace"')):
            if len(split_line(line, "tab" if mark == "\t" else mark)) >= 2 and mark != settings.delimiter:
                fix = f"The header looks separated otherwise: set delimiter = {word} in the rig config."
                break
    return _fault("missing_column", "there is no such column.", layout, file, theirs, fix)


def _fault(check: str, reason: str, layout: Layout, file: str, column: str | int, fix: str) -> Fault:
    return Fault(check, reason, file=file, line=layout.names_line, column=str(column), action="file left out", fix=fix)
