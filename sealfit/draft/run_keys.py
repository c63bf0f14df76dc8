"""The `[files]` of a draft: where traces are, what names or a table of runs say, what makes a condition."""

import glob
import os
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import PurePosixPath

from sealfit.config import AGING_CONDITION
from sealfit.draft.columns import Roles
from sealfit.draft.config_text import Notes, file_column
from sealfit.draft.dialect import CLOCK, Dialect
from sealfit.draft.file_names import FEW, HEIGHT_FROM, ONCE, NamePart, Names, is_repeat
from sealfit.draft.files_found import Found, RunsTable
from sealfit.errors import ConfigError
from sealfit.ingest.files import as_number
from sealfit.ingest.listing import KNOWN, channels_of, name_parts, natural
from sealfit.ingest.runs import excel_time, usual_formats
from sealfit.store.paths import RUNS as RUNS_CSV
from sealfit.units import Units, conversion

NO_CONDITION = {*KNOWN, "direction", "direction_set", "rubber", "file", "stroke", "speed_rpm"}
OF_NAMES = {
    "columns": "made of parts of the name",
    "values": "how these are written in the names",
    "compute": "computed from parts of the name",
    "units": "the unit of the number in the names",
}
AGREES = 0.2  # as `quality.speed_disagreement`
MOSTLY = 0.75  # of the files read: the slowest may be steps of their resolution only
SPEED_UNITS = ("mm/min", "m/s", "cm/s", "um/s", "in/min", "in/s")
_WHOLE_DAY = re.compile(r"\d{4}-\d\d-\d\d(?:[ T]00:00(?::00)?)?")  # a workbook's date is a midnight


def values_by_file(names: Names, files: Collection[str]) -> dict[str, dict[str, float | str]]:
    """Return what the names of files say, by file."""
    settings = names.settings
    conversions = {name: conversion(unit, Units().of(name)) for name, unit in settings.units.items()}
    found: dict[str, dict[str, float | str]] = {file: {} for file in files}
    for file in files:
        with suppress(ConfigError):
            found[file] = channels_of(name_parts(file, settings, conversions))
    return found


def improved(names: Names, speeds: Mapping[str, float], notes: Notes) -> Names:
    """Return the names with speeds that agree with the measured ones, and repeats that tell files apart.

    `speeds` are the measured ones, negative backward.
    """
    if names.settings.name_pattern is None:
        return names
    names = _with_repeat(_with_direction(_with_speed(names, speeds, notes), speeds))
    return _unaged_apart(_told_apart(names, notes))


def _with_repeat(names: Names) -> Names:
    """Return the names with an unknown number as the repeat, now that the speed is known."""
    known = sorted(name for name in names.given if not name.startswith(("part_", "started_at")))
    said = [one for one in values_by_file(names, names.files).values() if one]
    settings = [tuple(map(one.get, known)) for one in said]
    for part in names.parts if "repeat" not in known else ():
        if part.ours.startswith("part_") and is_repeat(part, [one.get(part.ours) for one in said], settings):
            return names.changed(part, ours="repeat", why=f"{part.why}, {ONCE}", doubt="")
    return names


def _with_direction(names: Names, speeds: Mapping[str, float]) -> Names:
    """Return the names with the direction that a word says: one in all files that go forward, one backward.

    A condition for each word would hide what differs between the directions.
    """
    said = values_by_file(names, speeds)
    for part in names.parts:
        ways = {(one[part.ours], speeds[file] > 0) for file, one in said.items() if part.ours in one}
        signs = {word: 1.0 if forward else -1.0 for word, forward in sorted(ways)}
        if part.ours.startswith("label_") and len(ways) == len(signs) == len(set(signs.values())) == 2:
            why = f"{part.why}; follows the displacement"
            return names.changed(part, ours="direction", why=why, doubt="", signs=signs)
    return names


def _with_speed(names: Names, speeds: Mapping[str, float], notes: Notes) -> Names:
    """Return the names with the unit of their speed, or the number that is the speed, by what is measured."""
    said = values_by_file(names, speeds)
    if "speed_mm_s" in names.given:
        named = {f: v.get("speed_mm_s") for f, v in said.items()}
        ratio = _ratio(named, speeds)
        if ratio is None:
            _doubt_speeds(named, speeds, notes)
        elif abs(ratio - 1) > AGREES:
            return _speed_in_unit(names, ratio, notes)
        return names
    for part in names.parts:
        if part.ours.startswith("part_") and len(part.texts) > 1:
            ratio = _ratio({f: v.get(part.ours) for f, v in said.items()}, speeds)
            if ratio is not None and abs(ratio - 1) <= AGREES:
                why = f"{part.why}; agrees with the measured speed"
                return names.changed(part, ours="speed_mm_s", why=why, doubt="")
    return names


def _ratio(said: Mapping[str, object], measured: Mapping[str, float]) -> float | None:
    """Return the named over the measured speed, if most files of two speeds or more have the same."""
    named = {f: abs(v) for f, v in said.items() if isinstance(v, int | float) and v and measured.get(f)}
    if len(set(named.values())) < 2:
        return None
    ratios = sorted(speed / abs(measured[file]) for file, speed in named.items())
    middle = ratios[len(ratios) // 2]
    agree = sum(abs(ratio / middle - 1) <= AGREES for ratio in ratios)
    return middle if agree >= MOSTLY * len(ratios) else None


def _doubt_speeds(said: Mapping[str, object], measured: Mapping[str, float], notes: Notes) -> None:
    """Add a doubt about the first file whose named speed is not that measured."""
    for file, speed in said.items():
        found = abs(measured.get(file, 0.0))
        if isinstance(speed, int | float) and found and abs(abs(speed) / found - 1) > AGREES:
            reason = f"the speed in the name of {file} is {abs(speed):g}, and {found:.3g} mm/s is measured."
            fix = "Check the units of time and displacement, and whether this number is a speed."
            notes.doubt("files.name_pattern", reason, fix)
            return


def _speed_in_unit(names: Names, ratio: float, notes: Notes) -> Names:
    """Return the names with the unit of the speed, where one explains the ratio; otherwise a doubt."""
    part = next(part for part in names.parts if part.ours == "speed_mm_s")
    unit = next((u for u in SPEED_UNITS if abs(ratio * conversion(u, "mm/s").factor - 1) <= AGREES / 2), None)
    if unit is None or part.unit:
        reason = f"speeds in names are {ratio:.3g} times those measured."
        fix = "Check the units of time and displacement, and the speed in names."
        notes.doubt("files.name_pattern", reason, fix)
        return names
    why = f"{part.why}; {ratio:.3g} times the measured speed in mm/s, so it is in {unit}"
    return names.changed(part, unit=unit, why=why)


def _told_apart(names: Names, notes: Notes) -> Names:
    """Return the names without a repeat that does not tell files of the same settings apart.

    Where settings, repeat and unknown words do so, each word has runs of its own.
    """
    repeat = next((part for part in names.parts if part.ours == "repeat"), None)
    if repeat is None:
        return names
    said = values_by_file(names, names.files)
    of_run = names.given - {"started_at"}
    if aging := names.given & set(AGING_CONDITION):
        of_run = {*aging, "rubber", "specimen_id", "speed_mm_s", "speed_rpm", "load_N", "repeat"}
    keys = _keys(said, of_run)
    if not keys or max(keys.values()) == 1:
        return names
    words = {part.ours for part in names.parts if part.ours.startswith("label_") and len(part.texts) <= FEW}
    if "speed_mm_s" in of_run & names.given and max(_keys(said, of_run | words).values()) == 1:
        of_run = (of_run | words | {"direction"}) - {"repeat"}
        template = " ".join(f"{{{part.group}}}" for part in names.parts if part.ours in of_run)
        return replace(names, templates={**names.templates, "run_id": template})
    count = sum(number for number in keys.values() if number > 1)
    reason = f"the repeat in names does not tell {count} files apart that have the same settings."
    fix = "It is not used; repeats are numbered in the order of the files."
    notes.doubt("files.name_pattern", reason, fix)
    return names.without(repeat)


def _keys(said: Mapping[str, dict], columns: Collection[str]) -> Counter:
    """Return how many files the names give the same values of these columns."""
    return Counter(tuple((name, one.get(name)) for name in sorted(columns)) for one in said.values() if one)


def _unaged_apart(names: Names) -> Names:
    """Return the names with a specimen for each series, where files of unaged rubber are alike otherwise."""
    series = [part for part in names.parts if part.ours in AGING_CONDITION]
    if "specimen_id" in names.given or "aging_days" not in names.given or len(series) < 2:
        return names
    alike = sorted(names.given - {*AGING_CONDITION, "started_at", "run_id"})
    unaged = [one for one in values_by_file(names, names.files).values() if one.get("aging_days") == 0]
    both = {tuple(tuple(map(one.get, own)) for own in (alike, AGING_CONDITION)) for one in unaged}
    if len(both) == len({otherwise for otherwise, _ in both}):
        return names
    template = " ".join(f"{{{part.group}}}" for part in series)
    return replace(names, templates={**names.templates, "specimen_id": template})


def beside_table(names: Names, table: RunsTable) -> Names:
    """Return the names without unknown numbers that the table of runs has, too, in a column of its own."""
    said = {}
    for file, one in values_by_file(names, names.files).items():
        path = PurePosixPath(file)
        said |= dict.fromkeys((file, path.with_suffix("").as_posix(), path.name, path.stem), one)
    listed = next(table.cells[theirs] for theirs, ours in table.ours.items() if ours == "file")
    of_rows = [said.get(cell.replace("\\", "/"), {}) for cell in listed]
    columns = [[as_number(cell) for cell in cells] for cells in table.cells.values()]
    for part in names.parts:
        if part.ours.startswith("part_") and [one.get(part.ours) for one in of_rows] in columns:
            names = names.without(part)
    return names


def suited_to(names: Names, roles: Roles) -> Names:
    """Return the names as the columns of traces ask for it.

    Where these hold an angle or a rotational speed, rpm in names are the speed. Where they hold a torque, the
    one load in names is matched only: their ratio is no friction coefficient.
    """
    ours = {part.ours: part for part in names.parts}
    rotates = roles.dimension("speed" if roles.displacement is None else "displacement")
    if rotates in ("angle", "rotation") and "speed_rpm" in ours and "speed_mm_s" not in names.given:
        names = names.changed(ours["speed_rpm"], ours="speed_mm_s")
    if roles.dimension("force") not in ("", "force") and "load_N" in ours and len(ours["load_N"].texts) == 1:
        names = names.without(ours["load_N"])
    return names


def source_keys(
    found: Found, names: Names, table: RunsTable | None, header: Collection[str], notes: Notes
) -> None:
    """Add where files are, and what names and the table of runs say; `header` is what header lines give."""
    if table is not None:
        if table.file != RUNS_CSV:
            notes.guess("files.runs_table", table.file, f"lists {table.named} of {len(found.traces)} traces")
        _table_keys(table, notes)
    else:
        _glob_keys(found, names, notes)
    if table is None or not set(AGING_CONDITION) <= table.given:
        told = table is not None or bool(set(header) & set(AGING_CONDITION))
        _name_keys(names, told, notes)
    _otherwise({f: one for f, one in found.otherwise.items() if table is None or f != table.file}, notes)
    for file, reason in list(found.unreadable.items())[:3]:
        notes.doubt("files", f"{file} {reason}", "It is in no run.")
    for suffix, count in found.formats.items():
        reason = f"{count} files ({suffix}) are not read."
        notes.doubt("files", reason, "Export them as text (CSV) if they hold traces or the list of runs.")


def _otherwise(others: Mapping[str, Dialect], notes: Notes) -> None:
    if not others:
        return
    one, shown = next(iter(others.values())), ", ".join(list(others)[:3])
    columns = ", ".join(one.names[:4]) or "without names"
    form = f"separator '{one.delimiter}', decimal '{one.decimal or '.'}', columns {columns}"
    count = "1 file is" if len(others) == 1 else f"{len(others)} files are"
    fix = "One config reads files of one form. "
    fix += "Move them to a folder of their own and draft a config for them, too."
    notes.doubt("files", f"{count} written otherwise ({form}): {shown}.", fix)


def _glob_keys(found: Found, names: Names, notes: Notes) -> None:
    pattern = glob_of(found.traces)
    notes.guess("files.glob", pattern, f"finds the trace files: {len(found.traces)}")
    matched = {p.relative_to(found.folder).as_posix() for p in found.folder.glob(pattern) if p.is_file()}
    unmatched = set(names.unmatched)
    if surplus := (matched - set(found.traces)) | (unmatched & matched):
        why = "no traces, or named or written otherwise than the rest"
        notes.guess("files.exclude", _excluded(surplus, matched), why)
    if unmatched:
        shown = ", ".join(sorted(unmatched, key=natural)[:3])
        reason = f"{len(unmatched)} of {len(found.traces)} trace files are named otherwise: {shown}."
        notes.doubt("files.exclude", reason, "They are left out. Rename them, or widen name_pattern.")


def glob_of(files: Sequence[str]) -> str:
    """Return the glob that finds files.

    Examples
    --------
    >>> glob_of(["a.csv", "b.csv"]), glob_of(["raw/x/a.txt", "raw/y/b.txt"]), glob_of(["a.ASC", "b/c.asc"])
    ('*.csv', 'raw/**/*.txt', '**/*.[aA][sS][cC]')
    """
    folders = {PurePosixPath(file).parent.as_posix() for file in files}
    common = os.path.commonpath(folders) if "." not in folders else ""
    below = f"{glob.escape(common)}/" if common else ""
    deep = "**/" if folders != {common or "."} else ""
    suffix, *others = {PurePosixPath(file).suffix for file in files}
    ending = "" if others else glob.escape(suffix)
    if others and {other.lower() for other in others} == {suffix.lower()}:
        ending = "".join(f"[{c.lower()}{c.upper()}]" if c.isalpha() else c for c in suffix)
    return f"{below}{deep}*{ending}"


def _excluded(surplus: set[str], matched: set[str]) -> list[str]:
    """Return globs of files: of whole folders where nothing else lies there."""
    kept = {folder.as_posix() for file in matched - surplus for folder in PurePosixPath(file).parents}
    globs = []
    for file in sorted(surplus, key=natural):
        folder = PurePosixPath(file).parent.as_posix()
        whole = folder not in kept and folder != "."
        globs.append(f"{glob.escape(folder)}/*" if whole else glob.escape(file))
    return list(dict.fromkeys(globs))


def _name_keys(names: Names, told: bool, notes: Notes) -> None:
    """Add what names say; that they say nothing matters only where nothing else has `told` the conditions."""
    settings = names.settings
    if settings.name_pattern is None:
        if told:
            return
        reason = "the names of the files say nothing that is known here: temperature, days, speed, repeat."
        fix = f"Write a {RUNS_CSV} with a line for each file, or name_pattern by hand."
        notes.doubt("files", reason, fix)
        return
    ours, files = [part for part in names.parts if part.ours], len(names.files)
    said = "; ".join(f"{_example(part)} -> {part.ours} ({part.why}: {_values(part)})" for part in ours)
    matched = f"matches {files - len(names.unmatched)} of {files} files. {said}"
    notes.guess("files.name_pattern", settings.name_pattern, matched)
    for part in ours:
        if part.doubt:
            reason = f"'{_example(part)}': {part.doubt}."
            notes.doubt("files.name_pattern", reason, "Check what it stands for.")
    for table, evidence in OF_NAMES.items():
        for name, value in getattr(settings, table).items():
            notes.guess(f"files.{table}.{name}", value, evidence)
    if template := settings.columns.get("specimen_id"):
        reason = (
            f"files with another '{template}' are taken to be of other pieces of rubber, unaged ones, too."
        )
        fix = "If one piece was tested, delete this line, and call the number `repeat` in name_pattern."
        notes.doubt("files.columns.specimen_id", reason, fix)


def _example(part: NamePart) -> str:
    return next(filter(None, part.texts), "")


def _values(part: NamePart) -> str:
    texts = sorted(filter(None, part.texts), key=natural)
    return ", ".join(texts[:5]) + (", ..." if len(texts) > 5 else "")


def _table_keys(table: RunsTable, notes: Notes) -> None:
    clock = next((name for name, cells in table.cells.items() if all(map(CLOCK.fullmatch, cells))), None)
    for theirs, ours in table.ours.items():
        if ours == "started_at" and clock and all(map(_WHOLE_DAY.fullmatch, table.cells[theirs])):
            evidence = f"columns '{theirs}' and '{clock}' of {table.file}"
            notes.guess("files.started_at", {"date": theirs, "time": clock}, evidence)
            continue
        value = file_column(theirs, table.units.get(theirs), ours)
        if ours == "compression_ratio_pct" and compressed(table.cells[theirs], theirs, notes):
            ours = "_compressed_pct"
        if value != ours:
            cell = next((cell for cell in table.cells[theirs] if cell), "")
            evidence = f"column '{theirs}' of {table.file}, such as '{cell}'"
            if ours == "started_at" and (time := excel_time(cell)):
                evidence += f": Excel's serial number of {time.isoformat(' ', 'minutes')}"
            notes.guess(f"files.runs_columns.{ours}", value, evidence)
    told = {*table.ours, clock}
    if "started_at" not in table.given:
        told.add(_dates_doubt(table, clock, notes))
    if unknown := [f"'{name}'" for name in table.cells if name not in told and not Units().of(name)]:
        hold = "holds" if len(unknown) == 1 else "hold"
        reason = f"what {', '.join(unknown)} of {table.file} {hold} is not known here."
        fix = "Name a load, a temperature or the like by our name for it; "
        fix += "what is neither sample nor contact, such as remarks, goes into loop.ignore_channels."
        notes.doubt("files.runs_columns", reason, fix)


def compressed(cells: Sequence[str], theirs: str, notes: Notes) -> bool:
    """Whether cells say how much the rubber was compressed; the height that is left is then computed."""
    numbers = [number for cell in cells if cell and (number := as_number(cell)) is not None]
    if not numbers or max(numbers) >= HEIGHT_FROM:
        return False
    key = "runs.compute.compression_ratio_pct"
    evidence = "the height that is left, in percent of the original"
    fix = "If it is the height that was left, name it compression_ratio_pct, and delete this line."
    reason = f"up to {max(numbers):g} % in '{theirs}' are taken as how much the rubber was compressed."
    notes.doubt(key, reason, fix)
    notes.guess(key, "100 - _compressed_pct", evidence)
    return True


def _dates_doubt(table: RunsTable, clock: str | None, notes: Notes) -> str:
    """Add a doubt about a column of dates in a form that is not known, and return its name; "" if none.

    Of several it is the one that differs most: many tests follow one day in the oven.
    """
    dates = re.compile(r"\d{1,4}[./-]\d{1,2}[./-]\d{2,4}")
    for name, cells in sorted(table.cells.items(), key=lambda column: -len(set(column[1]))):
        full = [cell for cell in cells if cell]
        if name not in table.ours and full and all(map(dates.search, full)):
            what = f"holds dates that are not ISO 8601, such as '{full[0]}'"
            started = f"files.runs_columns.started_at = '{name}'"
            if clock is not None:
                started = f"files.started_at = {{ date = '{name}', time = '{clock}' }}"
                full = [f"{day} {time}" for day, time in zip(cells, table.cells[clock], strict=True) if day]
            form = " or ".join(usual_formats(full)) or "a list of formats, such as ['%d.%m.%Y %H:%M']"
            fix = f"Set {started} and files.date_format = {form}."
            notes.doubt("files.runs_columns", f"column '{name}' of {table.file} {what}.", fix)
            return name
    return ""


def condition_keys(names: Names, table: RunsTable | None, header: Collection[str], notes: Notes) -> None:
    """Add which columns make a condition, and which tell rubbers apart."""
    of_table = set() if table is None else table.given
    given = names.given | of_table | set(header)
    aging = [name for name in AGING_CONDITION if name in given]
    varied = {part.ours for part in names.parts if len(part.texts) > 1}
    if "rubber" in given and (table is not None or "rubber" in varied):
        notes.guess("rubber", ["rubber"], "a column of its own for each rubber")
    if aging:
        notes.guess("condition", aging, f"{', '.join(aging)}: what is known of the aging")
        if missing := [name for name in AGING_CONDITION if name not in given]:
            reason = f"nothing says {' or '.join(missing)}: the same is assumed for all files."
            where = f"a {RUNS_CSV}" if table is None else table.file
            notes.doubt("condition", reason, f"Add it to {where} if it differs.")
        if "temperature_C" in aging and "aging_days" not in given:
            reason = "temperature_C is the temperature of aging, and nothing says the days."
            fix = "If it is that of the tests, call it test_temperature_C in this file."
            notes.doubt("condition", reason, fix)
        return
    own = [part.ours for part in names.parts if part.ours and part.ours not in NO_CONDITION]
    own += sorted(of_table - set(NO_CONDITION))
    if own:
        notes.guess("condition", own, "what names give besides speed and repeat")
        reason = "nothing says temperature, compression or days: there is no aging to fit."
        fix = "Leave those that change nothing about the sample or the contact out of it."
        notes.doubt("condition", reason, fix)
        return
    write = f"Write a {RUNS_CSV} with" if table is None else f"Add to {table.file}"
    notes.guess("condition", ["state"], "nothing tells conditions apart")
    notes.guess("files.columns.state", "one", "the same for all files")
    notes.doubt(
        "condition",
        "nothing says what differs between the files: all are taken as one condition.",
        f"{write} temperature_C, compression_ratio_pct and aging_days.",
    )
