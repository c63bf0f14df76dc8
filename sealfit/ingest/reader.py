"""One trace file to a clean table: read, computed, filtered, checked; every fault with its place and fix."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from statistics import mode

import numpy as np

from sealfit.config import MOST, Config, TraceFormat
from sealfit.errors import KEPT, BadFile, ConfigError, Fault
from sealfit.ingest.cells import Trace, body_of, checked_cells, clean, read_cells, width_of
from sealfit.ingest.columns import (
    RESERVED,
    SLOTS,
    TraceRef,
    beside,
    channel_columns,
    header_units,
    locate,
    numeric_names,
    required,
)
from sealfit.ingest.expression import Expression, evaluate, parse
from sealfit.ingest.files import (
    HEAD_BYTES,
    FileLayout,
    as_utf8,
    bad_file,
    find_layout,
    header_field_units,
    header_fields,
    in_file,
    placed,
    read_bytes,
    split_line,
    whole_lines,
    without_footer,
)
from sealfit.ingest.formats import OF_ARRAYS, Arrays, kind_of, read_arrays
from sealfit.ingest.listing import name_parts
from sealfit.ingest.workbooks import read_sheet
from sealfit.units import conversion

UNFILLED = ("", "Comment")  # last names without cells: a stray separator, and LabVIEW's column of comments
MIN_ROWS = 4  # fewer rows are no trace: there is not even a speed in them


def read_trace(campaign: Path, ref: TraceRef, config: Config) -> Trace:
    """Return one trace, with bad rows left out and named.

    Its columns are time_s, displacement_mm and force_N (and load_N, where it was measured) as float64, and
    any further channel as float64 or text. BadFile, with every fault, if the file must be left out.
    """
    return parse_trace(read_bytes(campaign, ref.file), ref, config)


def parse_trace(raw: bytes, ref: TraceRef, config: Config) -> Trace:
    """Return the trace that the bytes of a file hold; raises as `read_trace`."""
    with in_file(ref.file):
        layout, content, settings = _content(raw, ref.file, config.trace)
        if isinstance(content, Arrays):
            ours = locate(layout, len(content.columns), settings)
            line = np.arange(1, len(content.columns[0]) + 1)  # the number of the sample: there are no lines
            columns = dict(enumerate(content.columns))
            rows = checked_cells(columns, line, ours, numeric_names(settings), settings.decimal)
            rows = replace(rows, faults=(*content.faults, *rows.faults))
        else:
            rows = _read_text(content, layout, settings, ref.cut)
        trace = _trace(rows, layout, ref, config)
        units = header_units(layout, settings, config.units, trace.clock)
        trace = trace.with_faults([*units, *header_field_units(layout.header, config)])
    return replace(trace, faults=placed(trace.faults, ref.file))


def _content(
    raw: bytes, file: str, settings: TraceFormat, *, head: bool = False
) -> tuple[FileLayout, bytes | Arrays, TraceFormat]:
    """Return a file's layout, its text as UTF-8 or its arrays, and the settings with its delimiter."""
    kind = kind_of(file, settings)
    if kind in OF_ARRAYS:
        found = read_arrays(raw, kind, settings, head=head)
        return FileLayout(found.header, found.names, None, 0, 1), found, settings
    if kind == "csv":
        text = as_utf8(raw, settings.encoding, head=head)
    else:
        text = read_sheet(raw, settings.sheet, decimal=settings.decimal, head=head)
        settings = settings.model_copy(update={"delimiter": "tab"})
    return find_layout(text, settings), text, settings


def read_header(campaign: Path, file: str, config: Config) -> dict[str, float | str]:
    """Return what the header lines of a trace file say; raises `BadFile` if it cannot be read."""
    raw = read_bytes(campaign, file, head=kind_of(file, config.trace) == "csv")
    return header_fields(_content(raw, file, config.trace, head=True)[0].header, config)


def _read_text(text: bytes, layout: FileLayout, settings: TraceFormat, may_be_cut: bool) -> Trace:
    cut = ()
    text = without_footer(text, settings.footer, layout.start)
    if may_be_cut:
        text, *cut = whole_lines(text)
    body = body_of(text, layout, settings)
    width = width_of(body, settings.delimiter)
    _refuse_narrow(layout, width, settings)
    try:
        ours = locate(layout, len(layout.names) or width, settings)
    except BadFile as error:
        raise _names_elsewhere(error, layout, body, settings) from None
    rows = read_cells(body, layout, settings, ours, numeric_names(settings))
    return replace(rows, faults=(*cut, *rows.faults))


def _refuse_narrow(layout: FileLayout, width: int, settings: TraceFormat) -> None:
    """Raise `BadFile` if columns go by name and the first line has fewer cells than there are names."""
    named = len(layout.names)
    while named and layout.names[named - 1] in UNFILLED:
        named -= 1
    by_name = any(isinstance(theirs, str) for theirs in settings.their_columns.values())
    if by_name and len(layout.names) > 1 and 1 < width < named:
        reason = f"the header names {named} columns, and the first line of data has {width} cells."
        fix = "Complete the header or the data: no cell can be told to be that of a name."
        raise bad_file("too_few_cells", reason, fix, line=layout.first_line)


def _names_elsewhere(error: BadFile, layout: FileLayout, body: bytes, settings: TraceFormat) -> BadFile:
    """Return the error, or another one if the names of the columns stand in another line, which it names."""
    wanted = {name for name in settings.their_columns.values() if isinstance(name, str)}
    if layout.names_line is None or wanted <= set(layout.names):
        return error
    lines = [*layout.header, *body[:HEAD_BYTES].decode("utf-8", "replace").split("\n")]
    for number, line in enumerate(lines, start=1):
        if wanted <= set(split_line(line, settings.delimiter)):
            instead = " in place of header_ends_at" if settings.header_ends_at is not None else ""
            count = number + len(layout.header) - layout.names_line
            fix = f"They stand in line {number}: set header_lines = {count}{instead} under [trace]."
            reason = "the names of the columns do not stand in this line."
            return BadFile(replace(error.fault, reason=reason, column=None, fix=fix))
    return error


def _trace(rows: Trace, layout: FileLayout, ref: TraceRef, config: Config) -> Trace:
    """Return the trace that the rows of a file make; raises as `read_trace`."""
    settings = config.trace
    known: Mapping[str, object] = {}
    if settings.compute or settings.keep is not None or settings.rate_Hz is not None:
        named = name_parts(ref.file, config.files, config.conversions("names")) or {}
        known = {**ref.channels, **named, **header_fields(layout.header, config), **settings.constants}
    read = np.arange(rows.rows_read)
    rows = _in_our_units(channel_columns(rows, config), config, layout)
    if settings.rate_Hz is not None:  # a row that is left out takes its time, too
        seconds = read / _rate_Hz(settings.rate_Hz, known)
        rows = rows.having({"time_s": conversion("s", config.units.unit("time"))(seconds)})
    rows = rows.where(read >= settings.drop_first_rows)
    counted = len(rows.line)
    rows = _derive(rows.where(~rows.bad), known, settings, layout)
    _refuse_too_many(counted, rows, config)
    rows = replace(rows, number=np.arange(len(rows.line)))
    if settings.keep is not None:
        keep = _evaluate(parse(settings.keep, condition=True), {**known, **rows.columns})
        rows = rows.where(np.broadcast_to(keep, rows.line.shape))
    rows = rows.with_faults(_not_computed(rows, settings))
    if len(rows.line) < MIN_ROWS:
        reason = f"{len(rows.line)} of {len(read)} data rows are left; a trace needs {MIN_ROWS}."
        fix = "Check drop_first_rows, keep and the export."
        raise BadFile(*rows.faults, bad_file("no_rows", reason, fix).fault)
    return replace(rows, columns=_named_beside(rows, ref, settings), channels=ref.channels)


def _rate_Hz(rate: float | str, known: Mapping[str, object]) -> float:
    """Return the rows per second of a file; raises `BadFile` where what is known of it gives none."""
    value = float(_evaluate(parse(rate), known)) if isinstance(rate, str) else rate
    if not 0 < value <= MOST:
        reason = f'rate_Hz = "{rate}" gives {value:g} rows per second.'
        raise bad_file("rate", reason, "Correct what it reads, or the expression.")
    return value


def _in_our_units(rows: Trace, config: Config, layout: FileLayout) -> Trace:
    """Return the rows with numbers of other units converted; raises `BadFile` where they are labels."""
    changed, conversions = {}, dict(config.conversions("trace"))
    if rows.clock:  # times of day are in s, whatever the unit of the column
        conversions["time_s"] = conversion("s", config.units.unit("time"))
    for name, convert in conversions.items():
        if name not in rows.columns:
            continue
        if rows.columns[name].dtype.kind != "f":
            reason = "has a unit in the rig config and holds no numbers."
            fix = "Take its unit out of [trace.columns], or export numbers."
            raise bad_file("not_a_number", reason, fix, column=name, line=layout.names_line)
        changed[name] = convert(rows.columns[name])
    return rows.having(changed)


def _derive(rows: Trace, known: Mapping[str, object], settings: TraceFormat, layout: FileLayout) -> Trace:
    """Return the good ones of rows, with computed columns and integrated displacement."""
    speed = settings.integrate_displacement
    compute = {name: parse(text) for name, text in settings.compute.items()}
    later: list[str] = []  # computed columns that need the integral, directly or through another one
    for name, expression in compute.items() if speed else ():
        if expression.names & {"displacement_mm", *later}:
            later.append(name)
    rows = _computed(rows, {n: e for n, e in compute.items() if n not in later}, known)
    if speed:
        # The integral needs its rows clean first: one bad row would shift every displacement after it.
        required(rows.columns, layout, (speed, "time_s"))
        rows = clean(rows, [speed, *SLOTS])
        v = rows.columns[speed] / (60.0 if settings.integrate_per == "min" else 1.0)
        steps = 0.5 * (v[1:] + v[:-1]) * np.diff(rows.columns["time_s"])
        integral = np.cumsum(np.r_[0.0, steps])[: len(v)]  # by the trapezoid rule
        rows = rows.having({"displacement_mm": integral})
        rows = _computed(rows, {name: compute[name] for name in later}, known)
    required(rows.columns, layout)
    return clean(rows, SLOTS)


def _computed(rows: Trace, compute: Mapping[str, Expression], known: Mapping[str, object]) -> Trace:
    for name, expression in compute.items():
        value = _evaluate(expression, {**known, **rows.columns})
        rows = rows.having({name: np.broadcast_to(value, rows.line.shape).astype(float)})
    return rows


def _not_computed(rows: Trace, settings: TraceFormat) -> list[Fault]:
    """Return a warning for each computed channel that is no number in some rows."""
    faults = []
    for name in settings.compute.keys() - {*SLOTS, *(settings.drop_columns or ())}:
        if lacking := np.count_nonzero(~np.isfinite(rows.columns[name])):
            reason = f"is computed in the rig config, and is no number in {lacking} of {len(rows.line)} rows."
            fix = "Correct the expression, or the cells that it reads."
            faults.append(Fault("not_finite", reason, column=name, fix=fix, **KEPT))
    return faults


def _evaluate(expression: Expression, values: Mapping[str, object]) -> np.ndarray:
    try:
        return evaluate(expression, values)
    except ConfigError as error:
        raise bad_file("expression", error.message, error.fix, column=error.column) from error


def _refuse_too_many(counted: int, rows: Trace, config: Config) -> None:
    """Raise `BadFile` if more of the rows are bad than the config allows; `rows` are those that are left."""
    bad = counted - len(rows.line)
    if bad > config.quality.max_bad_rows * counted:
        fixes = [fault.fix for fault in rows.faults if fault.action == "row left out" and fault.fix]
        fix = mode(fixes) if fixes else ""
        reason = f"{bad} of {counted} rows are bad, more than {100 * config.quality.max_bad_rows:g} %."
        too_many = bad_file("too_many_bad_rows", reason, fix, value=float(bad))
        raise BadFile(*rows.faults, too_many.fault)


def _named_beside(rows: Trace, ref: TraceRef, settings: TraceFormat) -> dict[str, np.ndarray]:
    """Return slots first, then channels, without helper columns.

    A channel that `ref` has too is left out where it is constant; one that varies is another quantity, and is
    renamed, `temperature_file_C` beside `temperature_C`; so is one whose name a table of ours makes itself.
    """
    columns = {name: rows.columns[name] for name in SLOTS if name in rows.columns}
    for name, values in rows.columns.items():
        known = name in ref.channels and (values == values[0]).all()
        if name not in (*SLOTS, *(settings.drop_columns or ())) and not known:
            columns[beside(name, RESERVED.union(columns, ref.channels))] = values
    return columns
