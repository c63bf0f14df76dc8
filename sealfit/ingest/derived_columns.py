"""What cells of runs.csv say, and what it leaves out: conditions, runs, repeats, specimens, their order."""

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from sealfit.config import AGING_CONDITION, Config
from sealfit.errors import KEPT, NOTED, CampaignError, ConfigError, Fault
from sealfit.ingest.cells import OVERLOAD
from sealfit.ingest.columns import UNAGED, Column, Columns, known, mapped, overlaid, put, where
from sealfit.ingest.expression import evaluate, parse, require_columns
from sealfit.ingest.files import TEXT_COLUMNS, as_number
from sealfit.ingest.listing import NUMBERS, Entry, stopped
from sealfit.units import Conversion

COUNTS = {"repeat": "repeats", "stroke": "strokes"}  # whole numbers
_MOSTLY = 0.5  # a column with more numbers than this is one of numbers, and the rest of its cells are slips
# Words for unaged rubber, in lower case. RT: kept at room temperature.
UNAGED_WORDS = (
    "unaged", "fresh", "new", "virgin", "rt", "ref", "reference", "initial", "ungealtert", "frisch", "neu",
    "neuf", "nuovo", "nuevo", "nieuw",
)  # fmt: skip
_AGED_ONLY = ("temperature_C", "compression_ratio_pct")  # of unaged rubber nobody reads them


def with_day_0(columns: Columns, config: Config) -> Columns:
    """Return the columns with the days of unaged rubber as 0, and with none of its words where numbers stand.

    Unaged is what has 0, or one of `UNAGED_WORDS`, in its days; or, without days, such a word in another
    condition column. Its temperature and compression may hold any word.

    Examples
    --------
    >>> with_day_0({"aging_days": ["fresh", "4"], "temperature_C": ["RT", "60"]}, Config())
    {'aging_days': [0.0, '4'], 'temperature_C': [None, '60']}
    """
    others = [name for name in config.series_columns if name in columns and name not in config.rubber]
    if not config.aging or not columns:
        return columns
    files = len(next(iter(columns.values())))
    days = columns.get("aging_days", [None] * files)
    said = where(days, means_unaged)
    for name in others:
        said |= ~known(days) & where(columns[name], means_unaged)
    unaged = said | where(days, lambda value: _number(value) == 0)
    if not unaged.any():
        return columns
    changed = {"aging_days": put(days, dict.fromkeys(np.flatnonzero(said).tolist(), 0.0))}
    for name in others:
        is_word = (lambda cell: math.isnan(_number(cell))) if name in _AGED_ONLY else means_unaged
        words = where(columns[name], is_word)
        changed[name] = put(columns[name], dict.fromkeys(np.flatnonzero(unaged & words).tolist()))
    return columns | changed


def means_unaged(cell: float | str) -> bool:
    """Return whether a cell, or a piece of a name, is one of `UNAGED_WORDS`."""
    return isinstance(cell, str) and cell.strip().lower() in UNAGED_WORDS


def with_constants(columns: Columns, rows: int, config: Config) -> Columns:
    """Return the columns with the config's constants where a file has no value."""
    return overlaid({name: [value] * rows for name, value in config.runs.constants.items()}, columns)


def to_values(entries: list[Entry], columns: Columns, config: Config) -> tuple[Columns, list[Fault]]:
    """Return the columns as numbers or as labels, those that the config computes, and faults of cells.

    A column of numbers is one whose name says so, one of the config's condition columns or a channel where
    more than half of the cells are numbers, and any where all are. Helpers ("_name") are left out.
    CampaignError if an expression reads a column that is not there, or words as numbers.
    """

    def as_array(column: Column) -> np.ndarray:
        none = "" if any(isinstance(value, str) for value in column) else math.nan
        return np.array([none if value is None else value for value in column])

    made = {name: _column(name, cells, entries, config) for name, cells in columns.items()}
    faults = [fault for _, found in made.values() for fault in found]
    columns = {name: column for name, (column, _) in made.items()}
    for name, text in config.runs.compute.items():
        expression = parse(text)
        read = {column: columns[column] for column in expression.names if column in columns}
        try:
            require_columns(expression, columns)
            values = evaluate(expression, {column: as_array(cells) for column, cells in read.items()})
        except ConfigError as error:
            _refuse_words(entries, error.column, read.get(error.column, ()), name)
            place = {"file": f"config '{config.name}'", "column": f"runs.compute.{name}"}
            raise stopped("config", error.message, error.fix, **place) from error
        values = np.broadcast_to(values, len(entries)).astype(float)
        whole = np.ones(len(entries), bool)  # files with a value in every column that is read
        for cells in read.values():
            whole &= where(cells, lambda value: isinstance(value, str) or math.isfinite(value))
        reason = f'is computed as "{text}", which is no number here.'
        fix = "Correct the cells that it reads, or the expression."
        wrong = np.flatnonzero(whole & ~np.isfinite(values)).tolist()
        faults += [entries[i].fault("not_finite", reason, name, fix=fix) for i in wrong]
        good = np.where(whole & np.isfinite(values), values, None).tolist()
        columns[name] = mapped(good, partial(of_its_kind, name))
    return {name: column for name, column in columns.items() if not name.startswith("_")}, faults


def _refuse_words(entries: list[Entry], column: str, cells: Sequence, computed: str) -> None:
    """Raise CampaignError for the first word among numbers in a column that an expression reads."""
    words = [i for i, cell in enumerate(cells) if isinstance(cell, str) and as_number(cell) is None]
    if words and len(words) < (1 - _MOSTLY) * len(cells):
        reason = f"is not a number, and runs.compute.{computed} reads it."
        fault = entries[words[0]].fault("not_a_number", reason, column, value=cells[words[0]])
        raise CampaignError([replace(fault, action="stopped", fix="Correct the cell, or leave it empty.")])


def of_its_kind(name: str, value: float) -> float | str:
    """Return a computed number as its column holds it: an integer for repeats or strokes, text for a name."""
    if name in COUNTS and value == int(value):
        return int(value)
    return f"{value:.12g}" if name in TEXT_COLUMNS else value


def _column(name: str, cells: Column, entries: list[Entry], config: Config) -> tuple[Column, list[Fault]]:
    labels = mapped(cells, _text)
    if name in TEXT_COLUMNS:
        return labels, []
    values = mapped(cells, _number)  # nan: not missing, but wrong
    wrong = np.flatnonzero(where(values, lambda value: not abs(value) < OVERLOAD)).tolist()
    count = int(known(cells).sum())
    meant = name in NUMBERS or name in COUNTS  # as numbers
    if wrong and not meant and len(wrong) >= (1 - _MOSTLY) * count:
        return labels, []
    if wrong and not meant and name not in config.condition:
        entry, label = entries[wrong[0]], labels[wrong[0]]
        reason = f"{len(wrong)} of {count} cells are not numbers; the column is kept as labels."
        fix = "Empty the cell, or put a number there."
        return labels, [entry.fault("not_a_number", reason, name, value=label, fix=fix, **KEPT)]

    def faults(rows: list[int], reason: str, values: Column, fix: str) -> list[Fault]:
        return [entries[i].fault("not_a_number", reason, name, value=values[i], fix=fix) for i in rows]

    found = faults(wrong, "is not a number.", labels, "Put a number there.")
    if name not in COUNTS:
        return values, found
    broken = where(values, lambda value: math.isfinite(value) and value != int(value))
    fix = f"Number the {COUNTS[name]} 1, 2, 3."
    found += faults(np.flatnonzero(broken).tolist(), "is not a whole number.", values, fix)
    return mapped(values, lambda value: int(value) if math.isfinite(value) else -1), found


def _number(cell: float | str) -> float:
    number = cell if isinstance(cell, float) else as_number(cell)
    return math.nan if number is None else number


def in_our_units(columns: Columns, conversions: Mapping[str, Conversion]) -> Columns:
    """Return the columns with numbers of other units converted; cells without a number stay as they are."""

    def converted(convert: Conversion, cell: float | str) -> float | str:
        number = _number(cell)
        return convert.of_cell(number) if math.isfinite(number) else cell

    changed = {name: partial(converted, c) for name, c in conversions.items() if name in columns}
    return columns | {name: mapped(columns[name], convert) for name, convert in changed.items()}


def empty_cells(entries: list[Entry], name: str, rows: np.ndarray) -> list[Fault]:
    """Return the faults of files, by their numbers, that lack a value in a condition column."""
    reason = "holds no value: empty, n/a or the like."
    fix = "Fill it: it is one of the config's condition columns."
    return [entries[i].fault("empty_cell", reason, name, value="", fix=fix) for i in rows.tolist()]


def out_of_range(entries: list[Entry], columns: Columns) -> list[Fault]:
    """Return faults of impossible values: negative days, no load, no speed, too cold, or too large."""
    found: list[tuple[int, Fault]] = []

    def add(name: str, wrong: Callable[[float], bool], reason: str, fix: str) -> None:
        column = columns.get(name, [])
        for i in np.flatnonzero(where(column, lambda v: not isinstance(v, str) and wrong(v))).tolist():
            found.append((i, entries[i].fault("out_of_range", reason, name, value=column[i], fix=fix)))

    add("aging_days", lambda value: value < 0, "is below 0 days.", "Days count from 0, unaged.")
    fix = "A normal load presses; leave the cell empty if it is unknown."
    add("load_N", lambda value: value <= 0, "is not above 0.", fix)
    fix = "Leave it empty if it is unknown."
    add("speed_mm_s", lambda value: value == 0, "is not a sliding speed.", fix)
    fix = "Temperatures are in °C; give another unit in the rig config."
    for name in (name for name in columns if name.endswith("_C")):
        add(name, lambda value: value <= -273.15, "is not above absolute zero.", fix)
    reason, fix = "is larger than any quantity of a rig.", "Correct what gives it."
    for name in columns:
        add(name, lambda value: abs(value) >= OVERLOAD, reason, fix)
    return [fault for _, fault in sorted(found, key=lambda one: one[0])]


def swapped_columns(entries: list[Entry], columns: Columns) -> list[Fault]:
    """Return that unaged rubber has 100 degrees and a compression other than 100, as if these were swapped.

    Day 0 may have temperature and compression of an aged condition: nobody reads them there.
    """
    none = [None] * len(entries)
    days, *others = (columns.get(name, none) for name in ("aging_days", *_AGED_ONLY))
    pairs = list(zip(*others, strict=True))
    aged = {pair for pair, day in zip(pairs, days, strict=True) if day != 0}
    for entry, pair, day in zip(entries, pairs, days, strict=True):
        if day == 0 and pair[0] == 100 and pair[1] not in (100, None) and pair not in aged:
            reason = f"unaged rubber is at 100 °C with a compression ratio of {_text(pair[1])} %."
            fix = "Are compression_ratio_pct and temperature_C swapped? Not compressed is 100 %."
            return [entry.fault("swapped_columns", reason, _AGED_ONLY[0], value=pair[0], fix=fix, **KEPT)]
    return []


# Share by which commanded speeds and loads of one setting differ at most; a plate or a step is more.
SETTING = 0.005
# Share by which measured speeds of one commanded speed differ at most; rigs repeat within a few percent.
SAME_TESTED_SPEED = 0.05
# Share by which a measured load may exceed the next smaller one of its run. Settings differ by more, and
# drift, friction of the loading device and the noise of a sensor by less.
SAME_TESTED_LOAD = 0.1


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.12g}"


def as_set(columns: Columns) -> Columns:
    """Return the columns with commanded speeds and loads that differ by rounding only taken as one setting.

    Values within `SETTING` of the smallest of them become the one that most files have: a controller's
    readback, or a change of units, must not make runs fall apart.
    """
    there = [name for name in ("speed_mm_s", "load_N") if name in columns]
    return columns | {name: _one_setting(columns[name]) for name in there}


def _one_setting(column: Column) -> Column:
    count = Counter(value for value in column if value is not None and math.isfinite(value))
    usual: dict[float, float] = {}
    group: list[float] = []
    for value in sorted(count, key=lambda value: (value < 0, abs(value))):
        if group and (value * group[0] < 0 or abs(value) > abs(group[0]) * (1 + SETTING)):
            group = []
        group.append(value)
        usual.update(dict.fromkeys(group, max(group, key=count.__getitem__)))
    return mapped(column, lambda value: usual.get(value, value))


def add_runs(
    columns: Columns, conditions: list[str], measured: Sequence[float], unit: str
) -> tuple[Columns, list[Fault]]:
    """Return the columns with a `run_id` for every file, and what is to be said of it.

    Where none is given there is one per condition, commanded speed, load (of several; measured ones within
    10 % are one) and (named) specimen.
    Without a commanded speed it is that `measured`, in `unit` (nan where one is commanded): files within 5 %
    share a run. So do files with several speeds each (nan), and strokes there and back of one record, a file
    each, as the column `stroke` tells them.
    """
    none = [None] * len(conditions)
    given = columns.get("run_id", none)
    run_ids: dict[int, str] = {}
    groups = defaultdict(list)
    specimens, speeds = columns.get("specimen_id", none), columns.get("speed_mm_s", none)
    loads = load_settings(columns.get("load_N", none))
    several_loads = len({load for load in loads if load is not None}) > 1
    for i in np.flatnonzero(~known(given)).tolist():
        words = [conditions[i]]
        if specimens[i] is not None:
            words.append(str(specimens[i]))
        if several_loads and loads[i] is not None:
            words.append(f"load {loads[i]:g}")
        if speeds[i] is not None:
            run_ids[i] = ", ".join([*words, f"{speeds[i]:g} {unit}"])
        else:
            groups[", ".join(words)].append(i)
    stroke = columns.get("stroke", none)
    for words, members in groups.items():
        speeds = np.array([measured[i] for i in members])
        settings = [[members[k] for k in own] for own in of_one_setting(speeds, SAME_TESTED_SPEED)]
        if _there_and_back([[stroke[i] for i in own] for own in settings]):
            settings = [[i for own in settings for i in own]]
        for own in settings:
            middle = measured[own[len(own) // 2]]
            name = words if math.isnan(middle) else f"{words}, about {middle:.3g} {unit}"
            run_ids.update(dict.fromkeys(own, name))
    added = {**columns, "run_id": put(given, run_ids)}
    if not groups:
        return added, []
    reason = "neither run_id nor a commanded speed is given; "
    reason += "files of one condition share a run within 5 % of speed."
    return added, [Fault("run_id_derived", reason, fix="Give run_id or speed_mm_s.", **NOTED)]


def load_settings(loads: Column) -> Column:
    """Return loads, those within 10 % of the next one as the middle one of their setting."""
    usual: dict[float, float] = {}
    values = np.array([value for value in set(loads) if value is not None])
    for own in of_one_setting(values, SAME_TESTED_LOAD):
        middle = float(np.sort(values[own])[own.size // 2]) if own.size else 0.0
        usual.update(dict.fromkeys(values[own].tolist(), middle))
    return mapped(loads, lambda value: usual.get(value, value))


def of_one_setting(values: np.ndarray, tolerance: float) -> list[np.ndarray]:
    """Return the places of positive values, smallest first: those within a share of the next one together."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    return np.split(order, np.flatnonzero(~(ordered[1:] <= ordered[:-1] * (1.0 + tolerance))) + 1)


def _there_and_back(strokes: Sequence[Sequence[int | None]]) -> bool:
    """Whether the files of two speeds hold the odd and the even strokes of one record, each stroke once."""
    if len(strokes) != 2 or None in (every := [*strokes[0], *strokes[1]]) or len({*every}) < len(every):
        return False
    first, second = ({int(number) % 2 for number in own} for own in strokes)
    return len(first) == len(second) == 1 and first != second


def add_repeats(columns: Columns) -> Columns:
    """Return the columns with `repeat`, filled by `started_at` if the whole run has it, else by file order.

    Files that hold different strokes of a run, as their column `stroke` says, are numbered stroke by stroke.
    """
    run = columns["run_id"]
    none = [None] * len(run)
    given, hours, stroke = (columns.get(name, none) for name in ("repeat", "elapsed_h", "stroke"))
    runs = defaultdict(list)
    for i, key in enumerate(zip(run, stroke, strict=True)):
        runs[key].append(i)
    numbers: dict[int, int] = {}
    for members in runs.values():
        if all(hours[i] is not None for i in members):
            members.sort(key=lambda i: (hours[i], i))
        used = {given[i] for i in members if given[i] is not None}
        free = (number for number in range(1, len(members) + len(used) + 1) if number not in used)
        numbers.update({i: next(free) for i in members if given[i] is None})
    return {**columns, "repeat": put(given, numbers)}


def pooled_unaged(columns: Columns, config: Config) -> list[Fault]:
    """Return the condition columns in which unaged files differ, which make one condition nevertheless."""
    unaged = [i for i, value in enumerate(columns.get("aging_days", ())) if value == 0]
    faults = []
    for name in [n for n in config.condition if n not in (*AGING_CONDITION, *config.rubber) and n in columns]:
        values = sorted({_text(value) for i in unaged if (value := columns[name][i]) is not None})
        if len(values) > 1:
            reason = f"unaged files differ in it ({', '.join(values)}), and are one condition."
            fix = "Take it out of the config's condition, so that the loop tests it, or put it into rubber."
            faults.append(Fault("unaged_pooled", reason, column=name, fix=fix, **KEPT))
    return faults


def disagreements(entries: list[Entry], columns: Columns, conditions: list[str]) -> list[Fault]:
    """Return faults of runs: a repeat stands twice or differs from its run in condition, speed or load."""
    none = [None] * len(entries)
    run, repeat, specimen = (columns[name] for name in ("run_id", "repeat", "specimen_id"))
    stroke = columns.get("stroke", none)
    told = {name: columns.get(name, none) for name in ("speed_mm_s", "load_N")} | {"condition": conditions}
    settings = told | {"load_N": load_settings(told["load_N"])}
    first: dict[object, int] = {}  # file of each run, and of each repeat
    faults = []
    for i, entry in enumerate(entries):
        j = first.setdefault(run[i], i)
        other = first.setdefault((run[i], repeat[i], stroke[i]), i)
        if other != i:
            reason = f"repeat {repeat[i]} of run '{run[i]}' is there already: {_place(entries[other])}."
            fix = "" if specimen[i] == specimen[other] else "Give each specimen a run_id of its own. "
            fix += "Give every file of a run its own repeat number, files of other runs a run_id each, and "
            fix += "files with the strokes forward and back of one repeat the numbers 1 and 2 in a column "
            fix += "stroke. Is the speed of one of the two right?"
            if conditions[i].startswith(UNAGED):
                fix += " Pieces of unaged rubber that were tested with several series "
                fix += "need a specimen_id each."
            faults.append(entry.fault("duplicate_repeat", reason, "repeat", value=repeat[i], fix=fix))
        for name, column in told.items():
            mine, theirs = column[i], column[j]
            if settings[name][i] != settings[name][j]:
                there = "none" if theirs is None else _text(theirs)
                reason = f"differs from the other repeats of run '{run[i]}', {_place(entries[j])}: {there}."
                fix = "One run is one condition, speed and load: give it another run_id, or correct the cell."
                value = "none" if mine is None else mine
                faults.append(entry.fault("run_disagrees", reason, name, value=value, fix=fix))
        if specimen[i] != specimen[j] and told["speed_mm_s"][i] == told["speed_mm_s"][j]:
            reason = f"run '{run[i]}' has repeats on several specimens; "
            reason += "their scatter counts as that of repeats."
            about = {"value": specimen[i], "fix": "Give each specimen a run_id of its own.", **KEPT}
            faults.append(entry.fault("run_specimens", reason, "specimen_id", **about))
    return faults


def _place(entry: Entry) -> str:
    return f"line {entry.line}" if entry.line is not None else entry.file
