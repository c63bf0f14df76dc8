"""One part of a campaign: its files read, their strokes in one table, and the tables that grow with the samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from sealfit.conditions import add_keys
from sealfit.config import Config
from sealfit.errors import Fault
from sealfit.fingerprint import Fingerprint
from sealfit.ingest.average import bin_table, mean_traces
from sealfit.ingest.refs import TraceRef
from sealfit.ingest.shaped import STEADY_ONLY, shaped
from sealfit.ingest.trace_file import FileStrokes, read_files
from sealfit.parquet import as_dictionary, to_arrow
from sealfit.tables import BINS, TEXT, TRACES, TRACES_MEAN

SAMPLED = ("traces", "traces_mean", "bins")  # tables that are made, and stored, part by part

Stroke = tuple[str, int]  # file, and number of the stroke in it


@dataclass(frozen=True)
class Asked:
    """Files to read together: whole runs.

    `unused` are strokes that a comparison with other parts has ruled out; `columns`, per table, those that it is to
    have, and their types, since other parts have them.
    """

    refs: tuple[TraceRef, ...]
    unused: frozenset[Stroke] = frozenset()
    columns: Mapping[str, Mapping[str, str]] | None = None


@dataclass(frozen=True, slots=True)
class FileFound:
    """What is kept of a file once its samples are in the tables."""

    file: str
    mark: Fingerprint
    rows: int
    strokes: int


@dataclass(frozen=True)
class Part:
    """What one part gives.

    `strokes` has a row per stroke with everything that is known of it, the keys included, and `used` by what the file
    itself shows; `tables` are those of `SAMPLED` that have rows, without the strokes that are not used or were asked
    to be left out; their words are dictionaries.
    """

    files: tuple[FileFound, ...]
    faults: tuple[Fault, ...]
    strokes: pa.Table
    tables: dict[str, pa.Table]


def read_part(asked: Asked, campaign: Path, config: Config) -> Part:
    """Return the strokes and the tables of one part.

    Parameters
    ----------
    asked : Asked
        Which files.
    campaign : Path
        Campaign folder.
    config : Config
        The rig.
    """
    files = read_files(asked.refs, campaign, config)
    strokes = stroke_table(files, config)
    known = pa.Table.from_pandas(_plain(strokes), preserve_index=False)
    found = tuple(FileFound(made.file, made.mark, made.rows, len(made.strokes)) for made in files)
    faults = tuple(fault for made in files for fault in made.faults)
    if not len(strokes):
        return Part(found, faults, known, {})
    out = [stroke in asked.unused for stroke in zip(strokes["file"], strokes["stroke"].tolist(), strict=True)]
    strokes = strokes.assign(used=strokes["used"].to_numpy(bool) & ~np.array(out, bool))
    samples = sample_columns(files, strokes)
    tables = {"traces": _traces(samples, strokes, config)}
    if samples["sliding"].any():
        tables["traces_mean"] = _mean_traces(samples, strokes, config)
    if samples["steady"].any():
        tables["bins"] = _bins(samples, strokes, config)
    return Part(found, faults, known, tables)


def stroke_table(files: Sequence[FileStrokes], config: Config) -> pd.DataFrame:
    """Return one row per stroke with everything that is known of it, the keys included; run_id with its direction.

    A run with strokes both ways is two: `<run_id>+` and `<run_id>-`.
    """
    table = pd.DataFrame([row for made in files for row in made.strokes])
    if not len(table):
        return pd.DataFrame({"used": np.array([], bool)})
    table = table.infer_objects()
    for name in (*config.condition, *config.rubber):
        if name not in table.columns:  # every file is unaged, and none says the rest
            table[name] = np.nan
    return _two_runs(add_keys(table, config))


def _two_runs(table: pd.DataFrame) -> pd.DataFrame:
    names = table["run_id"].astype(str)
    run, runs = pd.factorize(names)
    file = pd.factorize(table["file"])[0]
    direction, used = table["direction"].to_numpy(), table["used"].to_numpy(bool)
    both = _both_ways(run[used], direction[used], len(runs))
    both[run[_both_ways(file, direction, len(table))[file]]] = True
    sign = np.where(direction > 0, "+", "-")
    return table.assign(run_id=names.where(~both[run], names + sign), run=names)


def _both_ways(group: np.ndarray, direction: np.ndarray, groups: int) -> np.ndarray:
    """Return, for every group, whether it has strokes both ways."""
    up, down = (np.bincount(group, chosen, groups) for chosen in (direction > 0, direction < 0))
    return (up > 0) & (down > 0)


def _plain(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table with every column that holds words and numbers together as words."""
    mixed = {name: values for name, values in table.items() if values.dtype == object}
    return table.assign(**{name: values.map(str, na_action="ignore") for name, values in mixed.items()})


def sample_columns(files: Sequence[FileStrokes], strokes: pd.DataFrame) -> dict[str, np.ndarray]:
    """Return all samples, with `row` (place in `strokes`); `steady` and `sliding` are false throughout a stroke that is
    not used."""
    parts = [made for made in files if made.samples is not None]
    names = list(dict.fromkeys(name for made in parts for name in made.samples))
    length = [len(made.samples["time_s"]) for made in parts]
    columns = {name: _stacked([made.samples.get(name) for made in parts], length) for name in names}
    first = np.concatenate(([0], np.cumsum([len(made.strokes) for made in parts])[:-1]))
    columns["row"] = np.repeat(first, length) + columns["stroke"] - 1
    used = strokes["used"].to_numpy(bool)
    if not used.all():
        for name in ("steady", "sliding"):
            columns[name] = columns[name] & used[columns["row"]]
    return columns


def _stacked(parts: list[np.ndarray | None], length: list[int]) -> np.ndarray:
    """Return the parts in one array; null where a file lacks the channel."""
    kinds = {part.dtype.kind for part in parts if part is not None}
    if kinds <= set("fiub"):
        return np.concatenate([np.full(n, np.nan) if p is None else p for p, n in zip(parts, length, strict=True)])
    return np.concatenate([np.full(n, None, object) if p is None else p for p, n in zip(parts, length, strict=True)])


def _traces(samples: Mapping[str, np.ndarray], strokes: pd.DataFrame, config: Config) -> pa.Table:
    """Return table `traces`."""
    measured = {name: values for name, values in samples.items() if name not in ("row", "sliding")}
    words = {name: as_dictionary(strokes[name], samples["row"]) for name in ("file", "condition")}
    return to_arrow({**measured, **words}, TRACES, config.units)


def _mean_traces(samples: Mapping[str, np.ndarray], strokes: pd.DataFrame, config: Config) -> pa.Table:
    """Return table `traces_mean`, of the sliding of the strokes that are used."""
    rows = np.flatnonzero(samples["sliding"])
    names = ("row", "displacement_mm", "force_N", "steady")
    made = mean_traces({name: samples[name][rows] for name in names}, strokes)
    row = made.pop("row")
    words = {name: as_dictionary(strokes[name], row) for name in ("run_id", "condition")}
    return to_arrow({**made, "direction": strokes["direction"].to_numpy()[row], **words}, TRACES_MEAN, config.units)


def _bins(samples: Mapping[str, np.ndarray], strokes: pd.DataFrame, config: Config) -> pa.Table:
    """Return table `bins`: means of what was measured along the trace, and what is known of the whole stroke."""
    rows = np.flatnonzero(samples["steady"])
    measured = {name: values[rows] for name, values in samples.items() if name not in ("stroke", "steady", "sliding")}
    made = bin_table(measured, strokes, config.bins)
    binned, place = np.unique(made.pop("row"), return_inverse=True)
    strokes = strokes.iloc[binned].reset_index(drop=True)
    if "load_N" in made and "load_N" in strokes.columns:  # where some files measure it and others declare it
        made["load_N"] = np.where(np.isnan(made["load_N"]), strokes["load_N"].to_numpy(float)[place], made["load_N"])
    whole = strokes.drop(columns=[name for name in made if name in strokes.columns]).assign(**dict.fromkeys(made, 0.0))
    known = to_arrow(shaped(whole, BINS, drop=(*STEADY_ONLY, "used")), BINS, config.units)
    columns = {name: made[name] if name in made else _spread(known.column(name), place) for name in known.column_names}
    return to_arrow(columns, BINS, config.units)


def _spread(values: pa.ChunkedArray, row: np.ndarray) -> pa.Array:
    """Return the value of every row, words as dictionaries."""
    whole = values.combine_chunks()
    return as_dictionary(whole, row) if whole.type == TEXT else whole.take(pa.array(row))
