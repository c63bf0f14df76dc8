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
from sealfit.tables import BINS

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
    itself shows; `tables` are those of `SAMPLED`, without the strokes that are not used or were asked to be left out.
    """

    files: tuple[FileFound, ...]
    faults: tuple[Fault, ...]
    strokes: pa.Table
    tables: dict[str, pd.DataFrame]


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
    samples = sample_table(files, strokes)
    tables = {"traces": samples.drop(columns=["row", "sliding"])}
    if strokes["used"].any():
        tables["traces_mean"] = mean_traces(*_sliding(samples, strokes))
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
    ways = table.groupby(["run_id", "file"])["direction"].transform("nunique")
    used = table["direction"].where(table["used"]).groupby(table["run_id"]).transform("nunique")
    both = (ways.groupby(table["run_id"]).transform("max") > 1) | (used > 1)
    sign = np.where(table["direction"] > 0, "+", "-")
    names = table["run_id"].astype(str)
    return table.assign(run_id=names.where(~both, names + sign), run=names)


def _plain(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table with every column that holds words and numbers together as words."""
    mixed = {name: values for name, values in table.items() if values.dtype == object}
    return table.assign(**{name: values.map(str, na_action="ignore") for name, values in mixed.items()})


def sample_table(files: Sequence[FileStrokes], strokes: pd.DataFrame) -> pd.DataFrame:
    """Return all samples, with `row` (place in `strokes`); `steady` is false throughout a stroke that is not used."""
    parts = [made for made in files if made.samples is not None]
    names = list(dict.fromkeys(name for made in parts for name in made.samples))
    length = [len(made.samples["time_s"]) for made in parts]
    columns = {name: _stacked([made.samples.get(name) for made in parts], length) for name in names}
    first = np.concatenate(([0], np.cumsum([len(made.strokes) for made in parts])[:-1]))
    row = np.repeat(first, length) + columns["stroke"] - 1
    columns["steady"] = columns["steady"] & strokes["used"].to_numpy(bool)[row]
    head = {name: _each(strokes[name], row) for name in ("file", "condition")}
    head["stroke"] = columns.pop("stroke").astype(np.int64)
    order = ["time_s", "displacement_mm", "force_N", "steady"]
    return pd.DataFrame({**head, **{name: columns.pop(name) for name in order}, **columns, "row": row})


def _each(labels: pd.Series, row: np.ndarray) -> pd.api.extensions.ExtensionArray:
    """Return the label of every sample: Arrow repeats words ten times as fast as an array of objects."""
    return pd.array(pa.array(labels, pa.string(), from_pandas=True).take(pa.array(row)), dtype="str")


def _stacked(parts: list[np.ndarray | None], length: list[int]) -> np.ndarray:
    """Return the parts in one array; null where a file lacks the channel."""
    kinds = {part.dtype.kind for part in parts if part is not None}
    if kinds <= set("fiub"):
        return np.concatenate([np.full(n, np.nan) if p is None else p for p, n in zip(parts, length, strict=True)])
    return np.concatenate([np.full(n, None, object) if p is None else p for p, n in zip(parts, length, strict=True)])


def _sliding(samples: pd.DataFrame, strokes: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the samples of sliding of the strokes that are used, and these strokes, with places renewed."""
    used = strokes["used"].to_numpy(bool)
    place = np.cumsum(used) - 1
    row = samples["row"].to_numpy()
    rows = samples.loc[samples["sliding"].to_numpy(bool) & used[row], ["row", "displacement_mm", "force_N", "steady"]]
    return rows.assign(row=place[rows["row"].to_numpy()]), strokes[used].reset_index(drop=True)


def _bins(samples: pd.DataFrame, strokes: pd.DataFrame, config: Config) -> pd.DataFrame:
    """Return table `bins`: means of what was measured along the trace, and what is known of the whole stroke."""
    rows = samples[samples["steady"].to_numpy(bool)].drop(columns=["file", "condition", "stroke", "steady", "sliding"])
    made = bin_table(rows, strokes, config.bins)
    measured = [name for name in made.columns if name != "row"]
    whole = strokes.drop(columns=[name for name in measured if name in strokes.columns])
    if "load_N" in measured and "load_N" in strokes.columns:  # where some files measure it and others declare it
        made["load_N"] = made["load_N"].fillna(strokes["load_N"].iloc[made["row"]].reset_index(drop=True))
    known = whole.iloc[made["row"]].reset_index(drop=True)
    return shaped(pd.concat([known, made], axis=1), BINS, drop=(*STEADY_ONLY, "used"))
