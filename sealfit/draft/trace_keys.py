"""The `[trace]` part of a draft: how files are written, which column goes where, what the header gives."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from sealfit.draft.columns import BY_BEHAVIOUR, DIMENSION, Roles, TraceColumn, rises, stroke_count
from sealfit.draft.config_text import Notes, date_keys, file_column, is_own_unit
from sealfit.draft.dialect import RATE, SETTINGS, STRAYS, rate_in, settings_in, started_in
from sealfit.draft.files_found import Found
from sealfit.draft.run_keys import compressed
from sealfit.draft.vocabulary import name_and_unit, plain
from sealfit.ingest.cells import seconds_of_day
from sealfit.ingest.files import read_bytes, split_line
from sealfit.ingest.formats import OF_ARRAYS, kind_of
from sealfit.ingest.workbooks import rows_of_sheets
from sealfit.units import UNITS, Unit, Units, conversion

LONG_S = 3600.0  # longer traces without a unit of time, at a sample per second or slower, are taken as ms
BAD_ROWS = 2  # with a missing value, that may stand above the first whole row of data
AS_LONG = 0.5  # share of the rows of a workbook's longest sheet above which another may be a recording

# A displacement that covers less than this share of the distance by a column of speed is doubted.
LEAST_SHARE_OF_DISTANCE = 0.1
LEAST_TURN_MM = 10.0  # Least circumference of a track, in mm: its radius is 1.6 mm or more.

SLOTS = {"time": "time_s", "displacement": "displacement_mm", "force": "force_N", "load": "load_N"}
NEGATED = {"force": "with the sign of the motion", "load": "as a load that presses counts above 0"}
CHANNELS = ("temperature", "humidity", "pressure")


def _footer_key(footers: Sequence[Sequence[str]], sniffed: int, notes: Notes) -> None:
    """Add how the first line below the data begins, if it does so in words in all files that have one."""
    footers = [footer for footer in footers if footer[0].strip(" \t,;")]
    if not footers:
        return
    what = f"{len(footers)} of {sniffed} files end in lines that are no data, such as '{footers[0][0][:60]}'"
    begins = re.match(r"[^\d\t;,]*", footers[0][0])[0]
    if any(map(str.isalpha, begins)) and all(footer[0].startswith(begins) for footer in footers):
        notes.guess("trace.footer", begins, what)
    else:
        fix = "They are left out, and `check` lists them. If they begin alike, set trace.footer to that."
        notes.doubt("trace", f"{what}.", fix)


def _sheet_key(found: Found, notes: Notes) -> None:
    """Add the sheet of the workbooks, if they have several."""
    file = found.traces[0]
    (sheet, most), *others = rows_of_sheets(read_bytes(found.folder, file)).items()
    if filled := sum(rows > 0 for _, rows in others):
        notes.guess("trace.sheet", sheet, f"has the most rows of the {filled + 1} sheets of a workbook")
    if alike := [f"'{name}'" for name, rows in others if rows > AS_LONG * most]:
        reason = f"only '{sheet}' of {file} is read, and {', '.join(alike[:5])} may be recordings, too."
        notes.doubt("trace.sheet", reason, "If so, save each sheet in a file of its own.")


def dialect_keys(found: Found, notes: Notes) -> None:
    """Add the keys of how the files are written."""
    kind = kind_of(found.traces[0])
    if kind in OF_ARRAYS:
        return  # no text: nothing is to be said of lines
    if kind == "xlsx":
        _sheet_key(found, notes)
    one, sniffed = found.dialect, found.sniffed
    of = f"{len(sniffed)} of {len(sniffed)} files"
    if len(found.traces) > len(sniffed):
        of += f" looked at, of {len(found.traces)}"
    if one.delimiter != ",":
        notes.guess("trace.delimiter", one.delimiter, f"the separator in {of}")
    if one.decimal == ",":
        number = re.search(r"[-+]?[0-9]+,[0-9]+", one.first)
        example = f"'{number.group()}'" if number else "with a comma"
        notes.guess("trace.decimal", ",", f"numbers such as {example} in {of}")
    _header_keys(found, of, notes)
    extra = [set(other.names) - set(one.names) for other in found.wider.values()]
    if further := sorted(set().union(*extra)):  # none where the columns are in another order
        count = f"{sum(map(bool, extra))} of {len(sniffed)} files"
        reason = f"{count} have further columns: {', '.join(further)}."
        notes.doubt("trace", reason, "They are read by the names that all files have.")
    if trailing := sum(other.trailing for other in sniffed):
        evidence = f"lines of data end in separators in {trailing} of {len(sniffed)} files"
        notes.guess("trace.trailing_separator", True, evidence)
    _footer_key([other.footer for other in sniffed if other.footer], len(sniffed), notes)
    if grouped := next((other.grouped for other in sniffed if other.grouped), ""):
        reason = f"some numbers have marks between thousands, such as '{grouped}'. They cannot be read."
        notes.doubt("trace.columns", reason, "Export the files again without these marks.")


def _header_keys(found: Found, of: str, notes: Notes) -> None:
    """Add where the header ends and which of its lines holds the names."""
    one, count = found.dialect, len(found.dialect.header)
    back = one.names_back if one.names_are_cells else None
    if back is None:
        why = "no line of names above the data" if one.names_back is None else "the names hold separators"
        notes.guess("trace.names", "none", f"{why} in {of}: columns go by position")
    units_row = back == 2 and one.units_back == 1
    if units_row:
        evidence = f"the line below the names holds units: {_shown(one.header[-1])}"
        notes.guess("trace.units_row", True, evidence)
    elif back is not None and back > 1:
        line = f"line {count - back + 1} of {count}: {_shown(one.header[-back])}"
        notes.guess("trace.names_line", back, f"the names are in the header's {line}")
    if len({len(other.header) for other in found.sniffed}) > 1:
        _varying_header(found, notes)
    elif count != (1 + units_row if back is not None else 0):
        notes.guess("trace.header_lines", count, f"lines above the first row of numbers in {of}")


def _varying_header(found: Found, notes: Notes) -> None:
    """Add the pattern of the header's last line, as headers are not of one length."""
    lengths = Counter(len(one.header) for one in found.sniffed)
    shown = ", ".join(f"{length} lines in {count} files" for length, count in sorted(lengths.items()))
    count = lengths.most_common(1)[0][0]
    usual = next(one.header for one in found.sniffed if len(one.header) == count)
    last = usual[-1].rstrip(STRAYS) if usual else ""
    pattern = "^" + re.escape(last[:80]).replace(r"\ ", " ").replace("\\\t", r"\t")
    if last and all(_ends_at(one.header, pattern) for one in found.sniffed):
        evidence = f"headers differ in length ({shown}), and this line ends all of them"
        notes.guess("trace.header_ends_at", pattern, evidence)
        return
    notes.guess("trace.header_lines", count, f"the most frequent of {shown}")
    reason = f"headers differ in length ({shown}), and no one line ends all of them."
    fix = "Set header_ends_at to a pattern that only the last header line matches, or export all files alike."
    notes.doubt("trace.header_lines", reason, fix)


def _ends_at(header: Sequence[str], pattern: str) -> bool:
    """Whether the first line that the pattern matches is the last of the header or has bad rows below it."""
    first = next((i for i, line in enumerate(header, start=1) if re.search(pattern, line)), 0)
    return first > 0 and len(header) - first <= BAD_ROWS


def _shown(line: str) -> str:
    text = " ".join(line.split())
    return f"'{text[:70]}...'" if len(text) > 70 else f"'{text}'"


def column_keys(found: Found, roles: Roles, units: Mapping[str, Unit], notes: Notes) -> None:
    """Add which column goes into which slot, in the `settled_units`, and what is done with the others."""
    helpers: list[str] = []
    for role, slot in SLOTS.items():
        column = getattr(roles, role)
        if column is None:
            continue
        negated = role == "force" and roles.sign < 0
        negated |= role == "load" and np.mean([np.mean(values) for values in column.values]) < 0
        name = slot.replace("_", "_raw_") if negated else slot
        value = file_column(column.key, units.get(role), slot)
        notes.guess(f"trace.columns.{name}", value, _evidence(column, role, roles))
        if negated:
            notes.guess(f"trace.compute.{slot}", f"-{name}", NEGATED[role])
            helpers.append(name)
        _column_doubts(column, role, f"trace.columns.{name}", roles, notes)
    if roles.coefficient is not None:
        evidence = f"{roles.coefficient.place}: by its name; there is no column of force"
        notes.guess("trace.columns.coefficient", roles.coefficient.key, evidence)
        product = "a coefficient of friction times the load"
        notes.guess("trace.compute.force_N", "coefficient * load_N", product)
        helpers.append("coefficient")
    if roles.displacement is None and roles.speed is not None:
        helpers.append(_integrated(roles.speed, notes))
    _displacement_against_speed(roles, units, notes)
    clock = _clock_or_rate(found, notes) if roles.time is None else None
    _missing_slots(roles, clock is not None, notes)
    force = roles.dimension("force")
    if force == "torque" or (force and re.search("torque|moment", plain(roles.force.label))):
        torque = {"quantity": "torque", "unit": roles.force.unit.name}
        notes.guess("quantities.force", torque, f"{roles.force.place} is a torque")
    if roles.dimension("displacement") == "angle":
        _rotation(roles.displacement.unit, f"{roles.displacement.place} is an angle", notes)
    if helpers:
        evidence = "read for the columns computed below, no channels of their own"
        notes.guess("trace.drop_columns", helpers, evidence)
    _side_by_side(roles, notes)
    _other_columns(found, roles, clock or "", notes)


def _displacement_against_speed(roles: Roles, units: Mapping[str, Unit], notes: Notes) -> None:
    """Add a doubt if the displacement covers far less than a column of speed says: it may be a height."""
    time, place, speed = roles.time, roles.displacement, roles.speed
    angle = roles.dimension("displacement") == "angle"
    if None in (time, place, speed) or angle or not speed.in_unit_of("speed"):
        return
    rotates = speed.dimension == "rotation"
    in_s = conversion(units["time"].name if "time" in units else "s", "s")
    in_mm = conversion(units["displacement"].name if "displacement" in units else "mm", "mm")
    per_s = conversion(speed.unit.name, "rpm" if rotates else "mm/s")
    mm = LEAST_TURN_MM / 60.0 if rotates else 1.0
    shares = []
    for t, x, v in zip(time.values, place.values, speed.values, strict=True):
        distance_mm = mm * np.abs(per_s(v) * np.gradient(in_s(t))).sum()
        shares.append(stroke_count(x) * np.ptp(in_mm(x)) / max(distance_mm, 1e-300))
    if np.median(shares) < LEAST_SHARE_OF_DISTANCE:
        reason = f"{place.place} covers less than a tenth of the distance that {speed.place} gives"
        fix = "If so, delete the line, and set trace.integrate_displacement to a column of speed."
        notes.doubt("trace.columns.displacement_mm", f"{reason}: it may be a height.", fix)


def _side_by_side(roles: Roles, notes: Notes) -> None:
    """Add a doubt if further columns are called like displacement and force, but for a number."""
    again = []
    for taken in (roles.displacement, roles.force):
        bare = None if taken is None else re.sub(r"[\W\d_]", "", taken.label)
        again.append([c for c in roles.others if bare and re.sub(r"[\W\d_]", "", c.label) == bare])
    if all(again):
        places, forces = (own[0].place for own in again)
        reason = f"{forces} is called like the force, and {places} like the displacement."
        fix = "They are not read. If they are further recordings, save each in a file of its own."
        notes.doubt("trace.columns.force_N", reason, fix)


def _evidence(column: TraceColumn, role: str, roles: Roles) -> str:
    by = ["its name"] if column.role == role else []
    by += ["its unit"] if column.in_unit_of(role) else []
    follows = f"it follows the direction of motion in {roles.signed_files} of {len(column.values)} files"
    follows += ", with the other sign" if roles.sign < 0 else ""
    behaves = {"time": "it rises evenly", "displacement": "it goes along strokes", "force": follows}
    text = f"{column.place}: by {' and '.join(by) or 'behaviour'}"
    return f"{text}; {behaves[role]}" if role in behaves else text


def _column_doubts(column: TraceColumn, role: str, key: str, roles: Roles, notes: Notes) -> None:
    named, unit_fits = column.role == role, column.in_unit_of(role)
    if not named and not unit_fits:
        in_unit = f", and {SLOTS[role].rpartition('_')[2]} is assumed" if key.endswith(SLOTS[role]) else ""
        reason = f"neither name nor unit says that {column.place} is the {role}; its behaviour does{in_unit}."
        notes.doubt(key, reason, f"Name the right column of {role} here if it is another.")
    if role != "force":
        return
    if roles.signs_differ:
        reason = f"the sign of {column.place} against the motion is not the same in all files."
        fix = "Check whether the sensor was turned, or the force was exported as a magnitude."
        notes.doubt(key, reason, fix)
    if not unit_fits and column.unit is not None:
        fix = "Give the factor to N under [trace.compute], or declare it under [quantities]."
        notes.doubt(key, f"{column.place} is not in a unit of force.", fix)
    moves = roles.time is not None and roles.displacement is not None
    if named and moves and roles.both_ways and roles.strength < BY_BEHAVIOUR / 2:
        reason = f"{column.place} has the same sign in both directions."
        notes.doubt(key, reason, "It looks like a magnitude: export the force with its sign.")


def _integrated(speed: TraceColumn, notes: Notes) -> str:
    """Add what makes a displacement of a speed; return the helper column."""
    rotation = speed.dimension == "rotation"
    helper = "speed_rpm" if rotation else "speed_column_mm_s"
    value = speed.key if rotation else file_column(speed.key, speed.unit, helper)
    notes.guess(f"trace.columns.{helper}", value, f"{speed.place}: by its name or unit")
    evidence = "there is no column of displacement: it is the integral of the speed"
    notes.guess("trace.integrate_displacement", helper, evidence)
    if rotation:
        notes.guess("trace.integrate_per", "min", "rpm")
        _rotation(UNITS["turn"], f"from {speed.place}", notes)
        notes.guess("position_origin", "file", "an integral begins anew in every file")
    return helper


def _rotation(angle: Unit, source: str, notes: Notes) -> None:
    """Add the quantities of a rotation, and the doubt whether its turns are strokes."""
    notes.guess("quantities.displacement", {"quantity": "angle", "unit": angle.name}, source)
    notes.guess("quantities.speed", {"quantity": "rotational speed", "unit": "rpm"}, source)
    reason = "a rotation in one direction may slide over the same track in each turn."
    fix = "Then set turn: each turn is a stroke of its own."
    notes.doubt("strokes", reason, fix, (f"turn = {conversion('turn', angle.name)(1.0):.10g}",))


def _clock_or_rate(found: Found, notes: Notes) -> str | None:
    """Add the first column of times of day, or the header's rate; None if there is neither.

    The name of the column is returned, which may be empty.
    """
    one = found.dialect
    for i, cell in enumerate(split_line(one.first, one.delimiter)):
        if i not in one.numbers and seconds_of_day([cell]) is not None:
            name = one.names[i] if i < len(one.names) and one.names_are_cells else ""
            evidence = f"column {i + 1} '{name}': times of day; seconds count from the first"
            notes.guess("trace.columns.time_s", name or i + 1, evidence)
            return name
    if (rate := rate_in([one.header for one in found.sniffed], one.decimal)) is None:
        return None
    per_second, line, pattern = rate
    evidence = f"no column of time; rows per second by the header of every file looked at: '{line}'"
    notes.guess("trace.rate_Hz", per_second, evidence)
    if isinstance(per_second, str):
        notes.guess(f"trace.header_fields.{RATE}", pattern, "the number of that line, which differs")
    return ""


def _missing_slots(roles: Roles, has_clock: bool, notes: Notes) -> None:
    wanted = {
        "time": (has_clock, "no column of numbers rises evenly: there is no time."),
        "displacement": (roles.speed, "no column goes along strokes: there is no displacement, nor a speed."),
        "force": (roles.coefficient, "no column follows the motion: there is no force."),
    }
    for role, (instead, reason) in wanted.items():
        if getattr(roles, role) is None and not instead:
            fix = f"Name it as {SLOTS[role]}, by the file's name of the column or by its position."
            fix += " Or give the rows per second as rate_Hz under [trace]." if role == "time" else ""
            notes.doubt("trace.columns", reason, fix, (f"{SLOTS[role]} = 1",))


def _other_columns(found: Found, roles: Roles, clock: str, notes: Notes) -> None:
    """Add the columns kept as channels and say which are not used; `clock` is that of times of day."""
    one, ignored, taken = found.dialect, [], {""}
    for column in roles.others:
        if name := _channel(column, taken):
            taken.add(name)
            notes.guess(f"trace.columns.{name}", column.key, f"{column.place}: kept as a channel")
        else:
            ignored.append(column)
    texts = [name for i, name in enumerate(one.names) if i not in one.numbers and name not in ("", clock)]
    if roles.speed is not None and roles.displacement is not None:
        ignored.append(roles.speed)
    if ignored or texts or one.width > len(one.numbers) + bool(clock):
        same = {c.position: f", the same signal as column {c.copy_of}" for c in ignored if c.copy_of}
        shown = [c.place + same.get(c.position, "") for c in ignored]
        shown += [f"'{name}' (text)" for name in texts]
        evidence = f"not used: {'; '.join(shown)}" if shown else "there are empty columns"
        notes.guess("trace.other_columns", "ignore", evidence)


def _channel(column: TraceColumn, taken: set[str]) -> str:
    """Return a name for a column as a channel, none of those taken; "" for a ratio, a counter or a copy."""
    role = column.role or column.dimension
    if column.copy_of or role not in CHANNELS or all(rises(values) for values in column.values):
        return ""
    unit = f"_{column.unit.suffix}" if column.unit is not None else ""
    base, said = name_and_unit(column.label)
    label = "_".join(plain(base if said == column.unit else column.label).split())
    bases = (f"{role}_sensor", label, f"{role}_column_{column.position}")
    return next(name for base in bases if (name := base + unit) not in taken)


def settled_units(roles: Roles, notes: Notes) -> dict[str, Unit]:
    """Return the unit of each role's column; what files do not say is assumed, with a doubt."""
    units = {}
    for role, slot in SLOTS.items():
        column = getattr(roles, role)
        if column is None:
            continue
        unit = column.unit or _assumed(column, role, slot, notes)
        if unit is not None and unit.dimension in {*DIMENSION[role]} - {"torque", "angle"}:
            units[role] = unit
    return units


def _assumed(column: TraceColumn, role: str, slot: str, notes: Notes) -> Unit | None:
    if role == "time":
        step, long = np.median(np.diff(column.values[0])), np.ptp(column.values[0])
        if step >= 1.0 and long > LONG_S:
            lasts = f"in seconds a file would last {long / 3600:.1f} h"
            reason = f"{column.place} has no unit; {lasts}, so it is taken as ms."
            notes.doubt("trace.columns.time_s", reason, "Change the unit if it is another.")
            return UNITS["ms"]
    if column.role == role:  # else it is said where nothing but its behaviour speaks for it
        has = f"the unit '{column.unknown}', which is not known here" if column.unknown else "no unit"
        reason = f"{column.place} has {has}; {slot.rpartition('_')[2]} is assumed."
        fix = f"If it is another, name it: {slot} = {{ name = ..., unit = ... }}."
        notes.doubt(f"trace.columns.{slot}", reason, fix)
    return None


def header_keys(found: Found, given: set[str], notes: Notes) -> list[str]:
    """Add the date and the settings that header lines give and nothing else does; return their columns."""
    headers = [one.header for one in found.sniffed]
    if not headers[0]:
        return []
    when = started_in(headers)
    if when is not None and "started_at" not in given:
        evidence = f"header line {when.line}, in every file looked at: {_shown(when.text)}"
        for key, value in date_keys(when).items():
            notes.guess(key, value, evidence)
        if not when.sure:
            month = "month" if when.format.startswith("%m") else "day"
            reason = f"the {month} is taken to stand first in header line {when.line}: {_shown(when.text)}."
            notes.doubt("files.date_format", reason, "If it is the other way round, change date_format.")
    settings = [one for one in settings_in(headers, found.dialect.decimal) if one.ours not in given]
    for one in settings:
        evidence = f"header line {one.line}, in every file looked at: {_shown(one.text)}"
        pressed = one.ours == "compression_ratio_pct" and compressed(one.values, one.name, notes)
        ours = "_compressed_pct" if pressed else one.ours
        notes.guess(f"trace.header_fields.{ours}", one.pattern, evidence)
        if one.ours == "specimen_id" and len(set(one.values)) == len(one.values):
            reason = f"every file looked at has a specimen of its own: {_shown(one.text)}."
            fix = "If that counts the tests, delete this line."
            notes.doubt("trace.header_fields.specimen_id", reason, fix)
        if one.unknown and one.ours in SETTINGS:
            reason = f"'{one.unknown}' in header line {one.line} is no unit that is known here"
            reason += f"; {Units().of(one.ours)} is assumed."
            fix = f"If it is a unit, name it as files.units.{one.ours}, or convert under runs.compute."
            notes.doubt(f"trace.header_fields.{one.ours}", reason, fix)
        if not is_own_unit(one.unit, one.ours):
            notes.guess(f"files.units.{one.ours}", one.unit.name, f"the unit in header line {one.line}")
    return [one.ours for one in settings]
