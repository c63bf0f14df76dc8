"""Rig configs: `configs/*.toml`, checked on load, unknown keys refused."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    StrictInt,
    ValidationError,
    field_validator,
    model_validator,
)

from sealfit.errors import ConfigError, did_you_mean, nearest, shortened
from sealfit.units import Conversion, Units, conversion

MEASURED = ("time_s", "displacement_mm", "force_N")  # columns of a trace file, by default
AGING_CONDITION = ["temperature_C", "compression_ratio_pct", "aging_days"]
MOST = 10**9  # largest whole number of a config: no file has more lines
LONGEST_PATTERN = 1000  # characters; a longer one takes long to compile

Table = TypeVar("Table", bound=BaseModel)


class Strict(BaseModel):
    """A table of a config or SPEC: unknown keys refused, values fixed, numbers finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


def _regular(pattern: str) -> str:
    """Raise ValueError for a text that is no regular expression, or a long one."""
    import regex  # here, so that commands that read no pattern start quickly

    if len(pattern) > LONGEST_PATTERN:
        raise ValueError(f"is not a regular expression: it has more than {LONGEST_PATTERN} characters")
    try:
        regex.compile(pattern)
    except (regex.error, RecursionError, OverflowError) as error:
        raise ValueError(f"is not a regular expression: {error}") from None
    return pattern


def _expression(text: str, *, condition: bool = False) -> str:
    """Raise ConfigError for a text that is no expression."""
    from sealfit.ingest.expression import parse  # here, so that commands that read no config start quickly

    return parse(text, condition=condition).text


def _encoding(name: str) -> str:
    """Raise ValueError for a name that is no encoding of text, as rot13 is none."""
    try:
        if name == "auto" or "a".encode(name):
            return name
    except (LookupError, ValueError):
        raise ValueError(f"{name!r} is not an encoding. Use auto, utf-8, latin-1 or utf-16") from None


def _delimiter(text: str) -> str:
    """Raise ValueError for a text that cannot stand between cells."""
    if text in ("tab", "whitespace") or (len(text) == 1 and text not in '"\n\r ' and not text.isalnum()):
        return text
    raise ValueError(f"{text!r} is not a delimiter. Use one character, 'tab' or 'whitespace'")


Pattern = Annotated[str, AfterValidator(_regular)]
Expression = Annotated[str, AfterValidator(_expression)]
Condition = Annotated[str, AfterValidator(partial(_expression, condition=True))]


class FileColumn(Strict):
    """A column of a file: `force_N = "Kraft"`, or with its unit `force_N = {name = "Kraft", unit = "kgf"}`.

    `name` is what the file calls it, or its position from 1; its numbers are converted when they are read.
    """

    name: str | Annotated[StrictInt, Field(ge=1)]
    unit: str | None = None


def _in_full(columns: object) -> object:
    """Return a config's table of columns with each of them in its long form; one without a name has ours."""
    if not isinstance(columns, dict):
        return columns  # refused by the type
    full = dict(columns)
    for ours, column in columns.items():
        if isinstance(column, str | int):
            full[ours] = {"name": column}
        elif isinstance(column, dict):
            full[ours] = {"name": ours, **column}
    return full


FileColumns = Annotated[dict[str, FileColumn], BeforeValidator(_in_full)]


def _as_list(formats: object) -> object:
    return [formats] if isinstance(formats, str) else formats


class StartedAt(Strict):
    """Columns of date and time of day, if these are two: `started_at = {date = "Datum", time = "Zeit"}`."""

    date: str
    time: str


class TraceFormat(Strict):
    """How one trace file is written."""

    format: Literal["csv", "xlsx", "tdms", "mat", "parquet"] | None = None
    """What files are whose ending does not say it: `"csv"`, `"xlsx"`, `"tdms"`, `"mat"` or `"parquet"`."""
    sheet: str | int | None = None
    """Excel: name or number, from 1, of the sheet with the data; none: the only one with cells in it."""
    group: str | None = None
    """TDMS: the group of channels; none: the only one, or the only one with the columns below."""
    variable: str | None = None
    """MATLAB: struct or matrix, `"S.field"` in a struct, `"(vectors)"` for vectors; none: as `group`."""
    encoding: Annotated[str, AfterValidator(_encoding)] = "auto"
    """`utf-8`, `latin-1`, `utf-16`, or `auto`: byte-order mark, then UTF-8, then Latin-1."""
    delimiter: Annotated[str, AfterValidator(_delimiter)] = ","
    """One character, `"tab"` or `"whitespace"`."""
    decimal: Literal[".", ","] = "."
    """`"."` or `","`."""
    header_lines: int | None = Field(None, ge=0, le=MOST)
    """Lines before the first data row, column names included."""
    header_ends_at: Pattern | None = None
    """Regular expression; the header ends with the line that it matches."""
    names: Literal["header", "none"] = "header"
    """`"none"`: there is no line of names, columns are given by position."""
    names_line: int | None = Field(None, ge=1, le=MOST)
    """The line of names, counted back from the header's end: 1 = the last."""
    units_row: bool = False
    """A row of units follows the names."""
    trailing_separator: bool = False
    """Lines end in stray separators; they are stripped."""
    footer: str | None = Field(None, min_length=1)
    """How the first line below the data begins, such as "*** END"; it and all lines below are not read."""
    drop_first_rows: int = Field(0, ge=0, le=MOST)
    """Data rows to leave out at the start of each file."""
    columns: FileColumns = Field(default_factory=lambda: {name: FileColumn(name=name) for name in MEASURED})
    """Our name = the file's, or its position from 1; with its unit: `{name = "Kraft", unit = "kgf"}`."""
    rate_Hz: float | str | None = None
    """Rows per second of files without a column of time: it counts from 0 at the first row of data. Where
    files differ, an expression over what runs.csv, its name or its header says of each: `"1000 * rate_kHz"`.
    """
    optional: list[str] = Field(default_factory=list)
    """Those of `columns` that a file may lack."""
    other_columns: Literal["channels", "ignore"] = "channels"
    """Columns not listed in `columns`: kept as channels, or `"ignore"`."""
    header_fields: dict[str, Pattern] = Field(default_factory=dict)
    """Channel = regular expression with one group, searched in the header lines."""
    keep: Condition | None = None
    """Row filter, e.g. `"load_N > 4.9"`."""
    compute: dict[str, Expression] = Field(default_factory=dict)
    """Column = expression over columns, parts of the file name and constants."""
    constants: dict[str, float] = Field(default_factory=dict)
    """Numbers that expressions may name."""
    drop_columns: list[str] | None = None
    """Columns that expressions read and that are no channels. Without this list, the loop does not search
    those that `force_N` is computed from.
    """
    integrate_displacement: str | None = None
    """Speed column whose integral over time is the displacement; converted if its unit is given."""
    integrate_per: Literal["s", "min"] = "s"
    """Time unit of that speed; `"min"` for rpm."""

    @field_validator("rate_Hz")
    @classmethod
    def _some_rate(cls, rate: float | str | None) -> float | str | None:
        if isinstance(rate, float) and not 0 < rate <= MOST:
            raise ValueError(f"{rate:g} rows per second are not possible")
        return _expression(rate) if isinstance(rate, str) else rate

    @model_validator(mode="before")
    @classmethod
    def _one_time(cls, table: object) -> object:
        """Leave the default column of time out where the rate is given; raise ValueError for both."""
        if not isinstance(table, dict) or table.get("rate_Hz") is None:
            return table
        for key in ("columns", "compute"):
            if isinstance(own := table.get(key), dict) and "time_s" in own:
                raise ValueError(f"both rate_Hz and {key}.time_s give the time. Take one of them out")
        return {"columns": {name: name for name in MEASURED[1:]}} | table

    @model_validator(mode="after")
    def _can_be_read(self) -> TraceFormat:
        for ours, theirs in self.their_columns.items() if self.names == "none" else ():
            if isinstance(theirs, str):
                raise ValueError(
                    f"columns.{ours}: {theirs!r} is a name, but the files have none. "
                    "Give its position, counted from 1, or names = 'header'"
                )
        return self

    @property
    def their_columns(self) -> dict[str, str | int]:
        """Our name = the file's column name, or its position from 1."""
        return {ours: column.name for ours, column in self.columns.items()}


def _glob(pattern: str | None) -> str | None:
    """Raise ValueError for a pattern that pathlib refuses."""
    parts = PurePosixPath("*" if pattern is None else pattern).parts
    if not parts or any("**" in part and part != "**" for part in parts):
        raise ValueError('a pattern for paths is needed, in which "**" stands alone: "traces/**/*.csv"')
    if parts.count("**") > 3:  # each of them walks through all folders again
        raise ValueError('"**" stands for any number of folders, and three times are enough')
    if parts[0] == "/" or ".." in parts:
        raise ValueError("leads outside the campaign folder. Make it relative")
    return pattern


class Files(Strict):
    """Where the trace files are when runs.csv does not list them, and what their names say."""

    glob: Annotated[str | None, AfterValidator(_glob)] = None
    """E.g. `"raw/**/*.csv"`; then runs.csv is not needed."""
    exclude: list[str] = Field(default_factory=list)
    """Globs of files that are not traces."""
    name_pattern: Pattern | None = None
    """Regular expression with named groups, matched against the whole relative path. Every part is a channel,
    except names that start with `_`. Files without a match are listed, with where the match broke.
    """
    values: dict[str, dict[str, float | str]] = Field(default_factory=dict)
    """Value map per part: `sign = {"" = 1, n = -1}`."""
    columns: dict[str, str] = Field(default_factory=dict)
    """Our column = template over the parts: `run_id = "{rig}_{bar}bar"`."""
    compute: dict[str, Expression] = Field(default_factory=dict)
    """Our column = expression over the parts: `speed_mm_s = "sign * rpm"`."""
    units: dict[str, str] = Field(default_factory=dict)
    """Unit of a part, of a column made of parts, or of a header field: `temperature_C = "degF"`."""
    date_format: Annotated[list[str], BeforeValidator(_as_list)] = Field(default_factory=list)
    """Formats of `started_at` as in Python's strptime, one or several, tried in order: `["%d.%m.%Y %H:%M",
    "%d.%m.%Y"]`; then ISO 8601 and Excel's serial numbers. A time with a zone (`%z`) is an instant, one
    without is taken as it stands.
    """
    started_at: StartedAt | None = None
    """Date and time of day, if these are two columns or parts: `{date = "Datum", time = "Uhrzeit"}`."""
    runs_columns: FileColumns = Field(default_factory=dict)
    """Our name = the name in runs.csv; with a unit: `load_N = {name = "Last", unit = "kgf"}`."""
    runs_table: str | None = None
    """Table to read in place of runs.csv: a `.csv`, `.xlsx` or `.parquet` file in the folder."""
    runs_sheet: str | int | None = None
    """Excel: name or number, from 1, of its sheet; none: the first."""

    @model_validator(mode="after")
    def _parts_are_there(self) -> Files:
        if self.name_pattern is None and (self.columns or self.compute):
            from sealfit.ingest.listing import name_parts

            name_parts("", self, {})
        return self

    @property
    def copies(self) -> dict[str, str]:
        """Columns that are a part as it stands, by the template "{T}" or the expression T, and that part."""
        whole = {name: text[1:-1] for name, text in self.columns.items() if re.fullmatch(r"\{[^{}]*\}", text)}
        named = {name: text.strip() for name, text in self.compute.items() if text.strip().isidentifier()}
        return named | whole

    @property
    def text_parts(self) -> tuple[str, ...]:
        """Parts of names that stay text, with their leading zeros: date and time of day."""
        return () if self.started_at is None else (self.started_at.date, self.started_at.time)

    @field_validator("date_format")
    @classmethod
    def _formats_are_known(cls, formats: list[str]) -> list[str]:
        for one in formats:
            try:
                day = datetime(2024, 2, 1, 9, 30, tzinfo=UTC).strftime(one)
                datetime.strptime(day, one)
            except (ValueError, re.error) as error:
                example = "Write for example '%d.%m.%Y %H:%M'"
                raise ValueError(f"{one!r} is no date format: {error}. {example}") from None
            if not {"%d", "%j", "%x", "%c"} & set(re.findall("%.", one)):
                raise ValueError(f"{one!r} has no day. Write for example '%d.%m.%Y %H:%M'")
        return formats


class Runs(Strict):
    """What is worked out from runs.csv, or what it leaves out."""

    compute: dict[str, Expression] = Field(default_factory=dict)
    """Our column = expression over the columns that are known of each file, from runs.csv, names and headers:
    `load_N = "9.80665 * mass_kg + 2.1"`. Without a value where one of these has none.
    """
    constants: dict[str, float | str] = Field(default_factory=dict)
    """Columns of one value, number or word, for files that have none: `{load_N = 49.03}`. Constants and
    columns whose name starts with `_` are for expressions only.
    """


Slot = Literal["force", "displacement", "speed", "load", "time"]


class Quantity(Strict):
    """Another quantity and unit in a slot: `[quantities] force = {quantity = "torque", unit = "mN m"}`."""

    quantity: str
    unit: str


class Strokes(Strict):
    """How strokes and their steady windows are found."""

    smooth_samples: int = Field(7, ge=1, le=1001)
    """Displacement is smoothed over this many samples to find where it turns."""
    min_travel_mm: float | None = Field(None, gt=0)
    """Shorter strokes are not strokes."""
    min_samples: int = Field(20, ge=4, le=MOST)
    """A steady window with fewer samples is too short."""
    speed_tolerance: float = Field(0.1, gt=0, le=1)
    """Steady: smoothed speed within this share of its plateau."""
    min_steady_share: float = Field(0.2, gt=0, lt=1)
    """A steady window that is a smaller share of its stroke is too short, unless the speed never settles."""
    whole_file: bool = False
    """Every file is one steady stroke, without ramps."""
    turn: float | None = Field(None, ge=1e-9)
    """One turn of a rotation, in the unit of the displacement: `360`. Each turn is a stroke of its own, and
    its displacement counts from the turn's start. An angle that begins anew at each turn is unwrapped.
    """


class Rig(Strict):
    """What the rig adds to the measured force."""

    moving_mass_kg: float = Field(0.0, ge=0, le=1e6)
    """Mass that the measured force accelerates; mass times acceleration is subtracted from the force."""


class Bins(Strict):
    """How the steady window is cut along displacement."""

    per_stroke: int = Field(40, ge=1, le=1000)
    """Bins in a stroke."""
    min_samples: int = Field(4, ge=1, le=MOST)
    """Bins with fewer samples are left out."""


class Quality(Strict):
    """When a row, file or repeat is left out."""

    max_bad_rows: float = Field(0.05, ge=0, le=1)
    """Share of its rows that a file may lose before it is left out."""
    outlier_p: float = Field(0.001, gt=0, lt=1)
    """Family-wise level at which a repeat is flagged."""
    drop_outliers: bool = False
    """Leave flagged repeats out of the fits."""
    max_gap_factor: float = Field(10.0, gt=1)
    """A time step this many times the median is a gap."""
    max_gap_share: float = Field(0.2, gt=0, le=1)
    """Gaps that hide more of the time leave the stroke out."""
    saturated_share: float = Field(0.05, gt=0, le=1)
    """Share of samples at the very extreme that counts as saturated."""
    stuck_samples: int = Field(50, ge=3, le=MOST)
    """This many equal force samples in a row are stuck."""
    spike_sigma: float = Field(12.0, gt=3)
    """A sample this many robust standard deviations off its neighbours is a spike."""
    speed_disagreement: float = Field(0.2, gt=0)
    """Share by which speed x time may miss the displacement."""


class Sensor(Strict):
    """The force sensor's accuracy: type B, one unknown shared by all samples."""

    accuracy: float = Field(0.2, ge=0)
    """Half-width, in the force's unit."""
    distribution: Literal["rectangular", "normal"] = "rectangular"
    """`"rectangular"`, or `"normal"`, whose half-width is that of 95 %."""

    @property
    def u(self) -> float:
        """Standard uncertainty: half-width / sqrt 3 (rectangular), half-width / 1.96 (normal)."""
        return self.accuracy / (3**0.5 if self.distribution == "rectangular" else 1.959964)


class Loop(Strict):
    """How the loop is closed."""

    family_error: float = Field(0.005, gt=0, lt=0.5)
    """Family-wise error rate: probability of any false effect per campaign."""
    max_rounds: int = Field(12, ge=1, le=100)
    """Effects added at most."""
    folds: int = Field(5, ge=2, le=100)
    """Folds of the cross-validation."""
    seed: int = Field(1, ge=0, le=MOST)
    """Seed of the random numbers."""
    ignore_channels: list[str] = Field(default_factory=list)
    """Channels that are not tested."""
    effects_folder: str | None = None
    """Folder with your own effects, relative to the config. **Python is run from it**: only if `--config`
    names this config. Later commands need `--effects-folder`.
    """


class Config(Strict):
    """One rig: what its files look like and which columns make a condition."""

    name: str = "default"
    """What reports call the rig."""
    condition: list[str] = Field(default_factory=lambda: list(AGING_CONDITION))
    """Columns that define a condition; without `aging_days` there is no aging law."""
    rubber: list[str] = Field(default_factory=list)
    """Columns that identify the rubber."""
    position_origin: Literal["rig", "file"] = "rig"
    """`"file"`: the origin of the position, and so the phase of a ripple, differs between files."""
    trace: TraceFormat = TraceFormat()
    files: Files = Files()
    runs: Runs = Runs()
    quantities: dict[Slot, Quantity] = Field(default_factory=dict)
    """Another quantity in a slot (`force`, `displacement`, `speed`, `load`, `time`): `force = {quantity =
    "torque", unit = "mN m"}`. Column names stay; labels, summaries and metadata show the true unit.
    """
    column_units: dict[str, str] = Field(default_factory=dict)
    """Units of your own channels: `humidity = "%"`."""
    rig: Rig = Rig()
    strokes: Strokes = Strokes()
    bins: Bins = Bins()
    quality: Quality = Quality()
    sensor: Sensor = Sensor()
    loop: Loop = Loop()
    _conversions: dict[str, dict[str, Conversion]] = PrivateAttr(default_factory=dict)
    _kept_units: dict[str, str] = PrivateAttr(default_factory=dict)

    @field_validator("condition")
    @classmethod
    def _some_condition(cls, value: list[str]) -> list[str]:
        if not value or len(set(value)) != len(value):
            raise ValueError("name at least one column, each once")
        for name in {"file", "speed_mm_s"} & set(value):
            raise ValueError(f"{name!r} cannot be a condition column: it differs within a condition")
        return value

    @model_validator(mode="after")
    def _units_convert(self) -> Config:
        units, parts = self.units, self.files.units
        integrated = f"{units.unit('displacement')}/{self.trace.integrate_per}"
        copies = {n: parts[p] for n, p in self.files.copies.items() if p in parts and not units.of(p)}
        for table, place, columns in (
            ("trace", "trace.columns", {name: column.unit for name, column in self.trace.columns.items()}),
            ("runs", "files.runs_columns", {n: column.unit for n, column in self.files.runs_columns.items()}),
            ("names", "files.units", copies | parts),
        ):
            for name, unit in columns.items():
                if not unit:
                    continue
                # A channel of the campaign's own keeps its numbers, and labels show its unit.
                own = integrated if (table, name) == ("trace", self.trace.integrate_displacement) else unit
                to = units.of(name) or self._kept_units.setdefault(name, own)
                try:
                    self._conversions.setdefault(table, {})[name] = conversion(unit, to)
                except ConfigError as error:
                    raise ValueError(f"{place}.{name}: {error}") from None
        for key, needed in (
            ("rig.moving_mass_kg", lambda: self.mass),
            ("quantities", lambda: units.speed_factor),
        ):
            try:
                needed()
            except ConfigError as error:
                raise ValueError(f"{key}: {error}") from None
        return self

    @property
    def mass(self) -> float:
        """Moving mass in units of force per unit of acceleration: 1 kg is 0.001 N s2/mm."""
        if not self.rig.moving_mass_kg:
            return 0.0
        force, length, time = (self.units.unit(slot) for slot in ("force", "displacement", "time"))
        return conversion(f"kg*{length}/{time}**2", force)(self.rig.moving_mass_kg)

    def conversions(self, table: Literal["trace", "runs", "names"]) -> dict[str, Conversion]:
        """Return the conversion per column of traces, runs.csv or file names whose unit the config gives."""
        return self._conversions.get(table, {})

    @property
    def units(self) -> Units:
        """True unit of every slot."""
        declared = {slot: (q.quantity, q.unit) for slot, q in self.quantities.items()}
        return Units(declared, self._kept_units | self.column_units)

    @property
    def aging(self) -> bool:
        """Whether `aging_days` is one of the condition columns."""
        return "aging_days" in self.condition

    @property
    def series_columns(self) -> list[str]:
        """Condition columns without the days."""
        return [name for name in self.condition if name != "aging_days"]


def read_config(path: Path | None) -> str:
    """Return the text of the config at `path`, an empty one without a path; errors as `read_toml`."""
    if path is None:
        return ""
    return read_toml(path, "Check --config.")


def read_toml(path: Path, fix: str) -> str:
    """Return the text of a file; ConfigError, whose fix names the likeliest file, if it cannot be read."""
    try:
        if Path(path).exists() and not Path(path).is_file():  # a pipe would be waited for
            raise ConfigError("is not a file.", file=path, fix=fix)
        return Path(path).read_text("utf-8-sig")  # Windows editors begin with a byte-order mark
    except OSError as error:
        likely = did_you_mean(Path(path), Path.is_file)
        raise ConfigError(f"cannot be read ({error.strerror}).", file=path, fix=likely or fix) from error
    except UnicodeDecodeError as error:
        raise ConfigError("is not UTF-8.", file=path, fix="Save it as UTF-8.") from error


def parse_config(text: str, name: str) -> Config:
    """Return the config written in `text`, which messages call `name`; errors as `parse_toml`."""
    return parse_toml(Config, text, name, "docs/reference/config.md has every key.")


def parse_toml(model: type[Table], text: str, name: str | Path, fix: str) -> Table:
    """Return what the text of a TOML file says as a `model`; ConfigError, with a sentence for each fault."""
    try:
        return model.model_validate(tomllib.loads(text))
    except ValidationError as error:
        faults = error.errors()
        line = _line(faults[0], text) if len(faults) == 1 else None
        raise ConfigError(explain(error, model, text), file=name, line=line, fix=fix) from error
    except (ValueError, RecursionError) as error:  # a number of thousands of digits, or lists in lists
        raise ConfigError(f"is not TOML: {error}.", file=name, fix=fix) from error


def explain(error: ValidationError, model: type[BaseModel] | None = None, source: str = "") -> str:
    """Return a sentence per fault, with its line in `source` and, for an unknown key, the nearest one."""
    lines = []
    for fault in error.errors():
        if error.error_count() > 1 and (line := _line(fault, source)):
            lines.append(f"line {line}:")
        key, text = ".".join(str(part) for part in fault["loc"]), fault["msg"].removeprefix("Value error, ")
        if fault["type"] == "extra_forbidden":
            meant = _nearest_key(fault["loc"], model) if model is not None else ""
            lines.append(f"unknown key '{key}'." + (f" Did you mean '{meant}'?" if meant else ""))
            continue
        end = "" if text.endswith(("?", ".")) else "."
        lines.append(f"key '{key}': {_given(fault)}{text}{end}" if key else f"{text}{end}")
    return " ".join(lines)


def _given(fault: Mapping) -> str:
    """Return the value that a type or a range refuses, to stand before the reason; our reasons have it."""
    own = fault["type"] in ("value_error", "assertion_error", "missing")
    if own or not isinstance(fault["input"], str | int | float):
        return ""
    return f"{shortened(repr(fault['input']))}: "


def _line(fault: Mapping, text: str) -> int | None:
    """Return the line of the last key of a fault; None if it is none, or stands in several lines."""
    said = fault["msg"].removeprefix("Value error, ").partition(":")[0]  # of a fault of the whole config
    keys = [part for part in fault["loc"] if isinstance(part, str)]
    for part in reversed(keys or said.split(".")):
        key = re.compile(rf"(?<![\w-]){re.escape(part)}['\"]?\s*[]=.]")
        lines = [number for number, line in enumerate(text.split("\n"), start=1) if key.search(line)]
        if lines:
            return lines[0] if len(lines) == 1 else None
    return None


def _nearest_key(place: tuple[int | str, ...], model: type[BaseModel]) -> str:
    """Return the key most likely meant: one of the same table, else of that name in another; "" if none."""
    *above, wrong = place
    here = model
    for part in above:
        field = here.model_fields.get(str(part))
        here = here if field is None else _table_of(field.annotation) or here
    if close := nearest(str(wrong), here.model_fields):
        return ".".join([*map(str, above), close])
    tables = {name: _table_of(field.annotation) for name, field in model.model_fields.items()}
    elsewhere = (f"{name}.{wrong}" for name, table in tables.items() if table and wrong in table.model_fields)
    return next(elsewhere, "")


def _table_of(annotation: object) -> type[BaseModel] | None:
    """Return the model of a table of a config, or of the tables that it holds; None where it holds none."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((table for part in get_args(annotation) if (table := _table_of(part))), None)
