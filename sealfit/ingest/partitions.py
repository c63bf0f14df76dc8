"""Parts of a campaign, of whole runs each: what one process reads at once, and the tables it gives."""

import hashlib
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from sealfit.config import Config
from sealfit.errors import Fault
from sealfit.ingest.averages import ALONG, FileStrokes, bin_table, mean_traces, read_strokes
from sealfit.ingest.columns import Listing, columns_of, condition_columns, keys_of
from sealfit.ingest.derived_columns import SAME_TESTED_LOAD, of_one_setting
from sealfit.ingest.files import as_number
from sealfit.ingest.strokes import several_speeds
from sealfit.store import parquet
from sealfit.store.manifest import Fingerprints
from sealfit.store.parquet import as_words, to_arrow
from sealfit.tables import BINS, BOOL, FLOAT, INT, STEADY, TEXT, TRACES, TRACES_MEAN, Schema

# Columns that serve the ingest only.
INNER = (
    "several", "several_speeds", "left", "equal", "extreme", "begins", "begins_half", "run", "sliding", "row",
    "by_itself",
)  # fmt: skip
IN_PANDAS = {FLOAT: float, INT: np.int64, TEXT: "str", BOOL: bool}


def shaped(table: pd.DataFrame, schema: Schema, drop: Sequence[str] = ()) -> pd.DataFrame:
    """Return the schema's columns in order with their types, then the open ones but `drop` and `INNER`."""
    fixed, missing = {}, pd.Series(None, index=table.index, dtype=object)
    for column in schema.columns:
        values = table.get(column.name, missing)
        if column.dtype == FLOAT:
            values = pd.to_numeric(values, errors="coerce")
        fixed[column.name] = values.astype(IN_PANDAS[column.dtype])
    taken = {*fixed, *INNER, *drop}
    return pd.DataFrame({**fixed, **{name: table[name] for name in table.columns if name not in taken}})


# ---------------------------------------------------------------- parts
# Where a cut lies depends on the runs beside it alone (content-defined chunking), so files that are added to
# a campaign change the part they belong to and, at most, its neighbours.

PART_FILES = 256  # few enough to be read for one condition; 100,000 files are some 400 parts
PART_BYTES = 4_000_000  # of trace files, if these come first; the samples take ten times that in memory
LEAST, MOST = 0.25, 2.0  # smallest and largest part, as multiples of the size above; a run is never cut


def plan_parts(conditions: Sequence[str], runs: Sequence[str], sizes: Sequence[int]) -> list[list[int]]:
    """Return the files of each part, by their numbers, rising within a part; every file is in one part.

    Conditions stay together unless one is larger than a part; runs always. A part holds neighbours in the
    order of names, so the least and the largest, which Parquet keeps, tell a reader what to skip. The
    arguments are condition, run and size in bytes of every file.

    Examples
    --------
    >>> plan_parts(["a", "b", "a"], ["1", "2", "1"], [10, 10, 10])
    [[0, 1, 2]]
    """
    whole: dict[str, dict[str, list[int]]] = {}
    for i, (condition, run) in enumerate(zip(conditions, runs, strict=True)):
        whole.setdefault(condition, {}).setdefault(run, []).append(i)
    parts: list[list[int]] = [[]]
    filled = 0.0
    for condition, of_run in sorted(whole.items()):
        weights = {  # how much of a part the files of each run fill
            run: max(len(files) / PART_FILES, sum(sizes[i] for i in files) / PART_BYTES)
            for run, files in of_run.items()
        }
        total = sum(weights.values())
        if filled >= LEAST and filled + total > MOST:
            parts.append([])
            filled = 0.0
        for run, files in of_run.items():
            if total > 1.0 and filled >= LEAST and (filled + weights[run] > MOST or _cut(run, weights[run])):
                parts.append([])
                filled = 0.0
            parts[-1] += files
            filled += weights[run]
        if filled >= LEAST and _cut(condition, total):
            parts.append([])
            filled = 0.0
    return [sorted(part) for part in parts if part]


def _cut(name: str, weight: float) -> bool:
    """Whether a part ends at `name`: by its hash, as often as makes parts of the wanted size."""
    number = int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")
    return number < weight * 2.0**64


SAMPLED = ("traces", "traces_mean", "bins")  # tables that are made, and stored, part by part

Stroke = tuple[str, int]  # file, and number of the stroke in it
Columns = Mapping[str, Mapping[str, str]]  # of each table: the type of each column, as Arrow spells it


@dataclass(frozen=True)
class Asked:
    """Files to read together: whole runs.

    `unused` are strokes that other parts have ruled out; `columns`, per table, those that it is to have.
    """

    refs: Listing
    unused: frozenset[Stroke] = frozenset()
    columns: Columns | None = None


@dataclass(frozen=True)
class PartitionResult:
    """What one part gives.

    Of its files, in order, `rows` are the rows that were read, and `found` the strokes; `marks` are the
    fingerprints of those that were read now. `strokes` has a row per stroke with everything that is known of
    it, and `used` by what the file itself shows; it is None where they are left on the disk. `tables` are
    those of `SAMPLED` that have rows, without the strokes that are not used; or they are on the disk, in
    `stored`: files by their names below OUT, with their sizes in bytes. `columns` are those that the samples
    gave, `unused` and `wanted` what was asked for (`Asked`).
    """

    marks: Fingerprints
    rows: Sequence[int]
    found: Sequence[int]
    faults: tuple[Fault, ...]
    strokes: pa.Table | None
    unused: frozenset[Stroke]
    wanted: Columns | None
    columns: Columns
    tables: Mapping[str, pa.Table] = field(default_factory=dict)
    stored: Mapping[str, int] = field(default_factory=dict)


def read_part(asked: Asked, campaign: Path, config: Config) -> PartitionResult:
    """Return the strokes and the tables of one part of a campaign, both in memory."""
    files = [read_strokes(ref, campaign, config) for ref in asked.refs]
    strokes = stroke_columns(files, config)
    known = pa.table({name: _array(values) for name, values in strokes.items()})
    tables: dict[str, pa.Table] = {}
    if known.num_rows:
        each = zip(strokes["used"], strokes["file"], strokes["stroke"], strict=True)
        strokes["used"] = [used and (file, stroke) not in asked.unused for used, file, stroke in each]
        samples = sample_columns(files, strokes)
        tables["traces"] = _traces(samples, strokes, config)
        if samples["sliding"].any():
            tables["traces_mean"] = _mean_traces(samples, strokes, config)
        if samples["steady"].any():
            tables["bins"] = _bins(samples, strokes, config)
    columns = {}
    for name, table in tables.items():
        columns[name] = {column.name: str(column.type) for column in table.schema}
        if asked.columns is not None:
            tables[name] = parquet.with_columns(table, asked.columns[name], config.units)
    marks, rows = {made.file: made.mark for made in files}, [made.rows for made in files]
    found, faults = [len(made.strokes) for made in files], tuple(f for made in files for f in made.faults)
    return PartitionResult(marks, rows, found, faults, known, asked.unused, asked.columns, columns, tables)


def stroke_columns(files: Sequence[FileStrokes], config: Config) -> dict[str, list]:
    """Return everything that is known of every stroke, the keys included.

    A run with strokes both ways is two: `<run_id>+` and `<run_id>-`. One with several steady speeds in a
    stroke, or in a file for which none is commanded, is one for each of them: `<run_id> at 42.1`. One at
    several measured loads is one for each of these, with repeats of its own: `<run_id>, load 45`.
    """
    rows = [row for made in files for row in made.strokes]
    columns = columns_of(rows)
    for name in condition_columns(config):
        columns.setdefault(name, [math.nan] * len(rows))  # every file is unaged, and none says the rest
    if not rows:
        return {"used": []}
    columns |= keys_of(columns, len(rows), config) | {"run": [str(name) for name in columns["run_id"]]}
    columns |= _at_speeds(columns, config.strokes.speed_tolerance)
    columns |= _at_loads(columns)
    return columns | {"run_id": _two_runs(columns)}


def _at_speeds(strokes: Mapping[str, list], tolerance: float) -> dict[str, list]:
    """Return `run_id` with the speed where the run has several in a file, and that as the speed set."""
    names = np.array(strokes["run"], object)
    commanded = strokes.get("speed_set_mm_s", [None] * len(names)).copy()
    known = np.array(strokes["used"], bool)
    of_file = defaultdict(list)
    for i in np.flatnonzero(known & [one is None for one in commanded]):
        of_file[strokes["file"][i]].append(strokes["speed_mm_s"][i])
    by_file = {file: bool(several_speeds(speeds)) for file, speeds in of_file.items()}
    several = np.array(strokes["several_speeds"]) | [by_file.get(file, False) for file in strokes["file"]]
    if not several.any():
        return {"run_id": names.tolist()}
    speed = np.abs(np.array(strokes["speed_mm_s"], float))
    for run in dict.fromkeys(names[several]):
        own = np.flatnonzero((names == run) & known)
        for part in (own[places] for places in of_one_setting(speed[own], tolerance)):
            for i in part:
                commanded[i] = float(f"{np.median(speed[part]):.3g}")
                names[i] = f"{run} at {commanded[i]:g}"
    return {"run_id": names.tolist(), "speed_set_mm_s": commanded}


def _at_loads(strokes: Mapping[str, list]) -> dict[str, list]:
    """Return `run_id` with the load where files of a run were measured at several, and `repeat` within each.

    A file has one load, the median over its strokes: loading devices have friction, and a direction.
    """
    names, repeats = np.array(strokes["run_id"], object), np.array(strokes["repeat"], object)
    load = pd.Series(strokes.get("load_N", [math.nan] * len(names)), dtype=float)
    loads = (
        load.where(np.array(strokes["used"], bool)).groupby(strokes["file"]).transform("median").to_numpy()
    )
    for run in dict.fromkeys(names):
        own = np.flatnonzero((names == run) & np.isfinite(loads))
        parts = [own[places] for places in of_one_setting(loads[own], SAME_TESTED_LOAD)]
        for part in parts if len(parts) > 1 else ():
            names[part] = f"{run}, load {np.median(loads[part]):.3g}"
            repeats[part] = 1 + np.unique(repeats[part].astype(int), return_inverse=True)[1]
    return {"run_id": names.tolist(), "repeat": repeats.tolist()}


def _two_runs(strokes: Mapping[str, list]) -> list[str]:
    """Return `run_id` with its direction where needed."""
    ways, signs = defaultdict(set), ["+" if way > 0 else "-" for way in strokes["direction"]]
    for run, file, way, used in zip(strokes["run_id"], strokes["file"], signs, strokes["used"], strict=True):
        ways[run, file].add(way)
        if used:
            ways[run, None].add(way)
    both = {run for (run, _), found in ways.items() if len(found) > 1}
    named = zip(strokes["run_id"], signs, strict=True)
    return [f"{run}{way}" if run in both else run for run, way in named]


def _array(values: Sequence[object]) -> pa.Array:
    """Return the values as Arrow has them; where they are words and numbers together, as words."""
    try:
        return pa.array(values, from_pandas=True)
    except (pa.ArrowInvalid, pa.ArrowTypeError):
        return as_words(pd.Series(values, dtype=object))


def sample_columns(files: Sequence[FileStrokes], strokes: Mapping[str, list]) -> dict[str, np.ndarray]:
    """Return all samples, with `row` (place in `strokes`); none is steady or sliding in an unused stroke."""
    parts = [made for made in files if made.samples is not None]
    names = list(dict.fromkeys(name for made in parts for name in made.samples))
    length = [len(made.samples["time_s"]) for made in parts]
    columns = {name: _stacked([made.samples.get(name) for made in parts], length) for name in names}
    count = [len(made.strokes) for made in parts]
    first = np.cumsum(count) - count - [made.strokes[0]["stroke"] for made in parts]
    columns["row"] = np.repeat(first, length) + columns["stroke"]
    used = np.array(strokes["used"], bool)[columns["row"]]
    return columns | {name: columns[name] & used for name in ("steady", "sliding")}


def _stacked(parts: list[np.ndarray | None], length: list[int]) -> np.ndarray:
    """Return the parts in one array; null where a file lacks the channel."""
    numbers = all(part is None or part.dtype.kind in "fiub" for part in parts)
    null = np.nan if numbers else None
    return np.concatenate([np.full(n, null) if p is None else p for p, n in zip(parts, length, strict=True)])


def _traces(samples: Mapping[str, np.ndarray], strokes: Mapping[str, list], config: Config) -> pa.Table:
    """Return table `traces`."""
    measured = {name: values for name, values in samples.items() if name not in ("row", "sliding", ALONG)}
    words = {name: _array(strokes[name]).take(pa.array(samples["row"])) for name in ("file", "condition")}
    return to_arrow({**measured, **words}, TRACES, config.units)


def _mean_traces(samples: Mapping[str, np.ndarray], strokes: Mapping[str, list], config: Config) -> pa.Table:
    """Return table `traces_mean`, of the sliding of the strokes that are used."""
    rows = np.flatnonzero(samples["sliding"])
    names = ("row", "displacement_mm", "force_N", "steady")
    made = mean_traces({name: samples[name][rows] for name in names}, strokes)
    row = made.pop("row")
    made["direction"] = np.array(strokes["direction"])[row]
    words = {name: _array(strokes[name]).take(pa.array(row)) for name in ("run_id", "condition")}
    return to_arrow(made | words, TRACES_MEAN, config.units)


def _bins(samples: Mapping[str, np.ndarray], strokes: Mapping[str, list], config: Config) -> pa.Table:
    """Return table `bins`: means of what is measured along a trace, and what is known of the whole stroke."""
    rows = np.flatnonzero(samples["steady"])
    names = [name for name in samples if name not in ("stroke", "steady", "sliding")]
    measured = {name: samples[name][rows] for name in names}
    measured["force_N"] = measured["force_N"] - measured["presliding_N"]
    made = bin_table(measured, strokes, config.bins)
    binned, place = np.unique(made.pop("row"), return_inverse=True)
    known = {name: [values[i] for i in binned.tolist()] for name, values in strokes.items()}
    if "load_N" in made and "load_N" in known:  # where some files measure it and others declare it
        declared = np.array(known["load_N"], float)[place]
        made["load_N"] = np.where(np.isnan(made["load_N"]), declared, made["load_N"])
    kinds = {column.name: column.dtype for column in BINS.columns}
    left_out = {*INNER, *STEADY.names(), *kinds}
    columns = {name: _array(values) for name, values in known.items() if name not in left_out}
    for name, kind in kinds.items():
        values = known.get(name, [None] * len(binned))
        if kind == FLOAT:  # null where a word stands for a number
            values = [as_number(value) if isinstance(value, str) else value for value in values]
        columns[name] = _array(values).cast(kind)
    spread = {name: values.take(pa.array(place)) for name, values in columns.items() if name not in made}
    return to_arrow(spread | made, BINS, config.units)
