"""A campaign folder to tables: every file read, split and judged, repeats averaged. Writes nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from sealfit.conditions import add_keys
from sealfit.config import Config
from sealfit.engine import run_map
from sealfit.errors import CampaignError, Fault
from sealfit.fingerprint import fingerprint
from sealfit.ingest.average import bin_table, mean_traces
from sealfit.ingest.peers import constant_strokes, outlying_files, reversed_strokes
from sealfit.ingest.quality import quality_table
from sealfit.ingest.runs import list_traces
from sealfit.ingest.trace_file import FileStrokes, read_strokes
from sealfit.tables import BINS, FLOAT, INT, RUNS, STEADY, TEXT, Schema

INNER = ("several", "equal", "extreme", "run", "sliding", "row")  # columns that serve the ingest only
OF_SAMPLES = ("time_s", "displacement_mm", "distance_mm", "force_N", "force_sd_N", "n")  # their means are in `steady`
FAULTY = ("warning", "error")
SHOWN = 20  # faults that a campaign without a single usable stroke lists


@dataclass(frozen=True)
class Ingested:
    """Tables inputs, runs, quality, traces, traces_mean, steady and bins; `faults` are the warnings and errors among
    the findings of `quality`."""

    tables: dict[str, pd.DataFrame]
    faults: list[Fault]


def ingest_campaign(
    campaign: Path, config: Config, *, workers: int = 1, on_file: Callable[[int, int], None] | None = None
) -> Ingested:
    """Return the tables of a campaign.

    Parameters
    ----------
    campaign : Path
        Folder with runs.csv, or with files that the config's glob finds.
    config : Config
        The rig.
    workers : int
        Processes; the tables do not depend on it.
    on_file : callable, optional
        Called after each file with its number, from 1, and the number of files.

    Raises
    ------
    CampaignError
        For faults that concern the whole campaign, or where not one stroke can be used.
    """
    campaign = Path(campaign)
    refs, faults = list_traces(campaign, config)
    files: list[FileStrokes] = []
    for made in run_map(partial(read_strokes, campaign=campaign, config=config), refs, workers=workers, trial_s=1.0):
        files.append(made)
        if on_file is not None:
            on_file(len(files), len(refs))
    faults = [*faults, *(fault for made in files for fault in made.faults)]
    strokes, found = judged(stroke_table(files, config))
    faults += found
    if not strokes["used"].any():
        raise CampaignError(_nothing_left(faults, len(files)))
    steady, found = outlying_files(_steady(strokes), config)
    faults += found
    strokes = strokes.assign(used=_still_used(strokes, steady))
    samples = sample_table(files, strokes)
    inputs = _inputs(campaign, files, strokes, faults)
    tables = {
        "inputs": inputs,
        "runs": _shaped(strokes, RUNS, drop=(*_steady_only(), *OF_SAMPLES)),
        "quality": quality_table(faults, inputs["file"].tolist()),
        "traces": samples.drop(columns=["row", "sliding"]),
        "traces_mean": mean_traces(*_sliding(samples, strokes)),
        "steady": _shaped(steady, STEADY),
        "bins": _bins(samples, strokes, config),
    }
    return Ingested(tables, [fault for fault in faults if fault.severity in FAULTY])


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


def judged(strokes: pd.DataFrame) -> tuple[pd.DataFrame, list[Fault]]:
    """Return the strokes with `used` false for those that a comparison with the others rules out, and findings."""
    faults: list[Fault] = []
    for rule in (constant_strokes, reversed_strokes):
        if strokes["used"].any():
            keep, found = rule(strokes)
            strokes = strokes.assign(used=strokes["used"].to_numpy(bool) & keep)
            faults += found
    return strokes, faults


def sample_table(files: Sequence[FileStrokes], strokes: pd.DataFrame) -> pd.DataFrame:
    """Return all samples, with `row` (place in `strokes`); `steady` is false throughout a stroke that is not used."""
    parts = [made for made in files if made.samples is not None]
    names = list(dict.fromkeys(name for made in parts for name in made.samples))
    length = [len(made.samples["time_s"]) for made in parts]
    columns = {name: _stacked([made.samples.get(name) for made in parts], length) for name in names}
    first = np.concatenate(([0], np.cumsum([len(made.strokes) for made in parts])[:-1]))
    row = np.repeat(first, length) + columns["stroke"] - 1
    columns["steady"] = columns["steady"] & strokes["used"].to_numpy(bool)[row]
    file = np.repeat(np.array([made.file for made in parts], object), length)
    head = {"file": pd.array(file, dtype="str"), "stroke": columns.pop("stroke").astype(np.int64)}
    order = ["time_s", "displacement_mm", "force_N", "steady"]
    return pd.DataFrame({**head, **{name: columns.pop(name) for name in order}, **columns, "row": row})


def _stacked(parts: list[np.ndarray | None], length: list[int]) -> np.ndarray:
    """Return the parts in one array; null where a file lacks the channel."""
    kinds = {part.dtype.kind for part in parts if part is not None}
    if kinds <= set("fiub"):
        return np.concatenate([np.full(n, np.nan) if p is None else p for p, n in zip(parts, length, strict=True)])
    return np.concatenate([np.full(n, None, object) if p is None else p for p, n in zip(parts, length, strict=True)])


def _steady(strokes: pd.DataFrame) -> pd.DataFrame:
    return strokes[strokes["used"]].reset_index(drop=True)


def _still_used(strokes: pd.DataFrame, steady: pd.DataFrame) -> np.ndarray:
    used = strokes["used"].to_numpy(bool).copy()
    used[used] = steady["used"].to_numpy(bool)
    return used


def _sliding(samples: pd.DataFrame, strokes: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the samples of sliding of the strokes that are used, and these strokes, with places renewed."""
    used = strokes["used"].to_numpy(bool)
    place = np.cumsum(used) - 1
    row = samples["row"].to_numpy()
    rows = samples.loc[samples["sliding"].to_numpy(bool) & used[row], ["row", "displacement_mm", "force_N", "steady"]]
    return rows.assign(row=place[rows["row"].to_numpy()]), strokes[used].reset_index(drop=True)


def _bins(samples: pd.DataFrame, strokes: pd.DataFrame, config: Config) -> pd.DataFrame:
    """Return table `bins`: means of what was measured along the trace, and what is known of the whole stroke."""
    rows = samples[samples["steady"].to_numpy(bool)].drop(columns=["file", "stroke", "steady", "sliding"])
    made = bin_table(rows, strokes, config.bins)
    measured = [name for name in made.columns if name != "row"]
    whole = strokes.drop(columns=[name for name in measured if name in strokes.columns])
    if "load_N" in measured and "load_N" in strokes.columns:  # where some files measure it and others declare it
        made["load_N"] = made["load_N"].fillna(strokes["load_N"].iloc[made["row"]].reset_index(drop=True))
    known = whole.iloc[made["row"]].reset_index(drop=True)
    return _shaped(pd.concat([known, made], axis=1), BINS, drop=(*_steady_only(), "used"))


def _steady_only() -> tuple[str, ...]:
    inner = {column.name for column in STEADY.columns} - {column.name for column in RUNS.columns}
    return tuple(inner - {column.name for column in BINS.columns})


def _shaped(table: pd.DataFrame, schema: Schema, drop: Sequence[str] = ()) -> pd.DataFrame:
    """Return the schema's columns in order and with their types, then the open ones."""
    fixed = {}
    for column in schema.columns:
        values = (
            table[column.name] if column.name in table.columns else pd.Series(None, index=table.index, dtype=object)
        )
        if column.dtype == FLOAT:
            fixed[column.name] = pd.to_numeric(values, errors="coerce").astype(float)
        elif column.dtype == INT:
            fixed[column.name] = values.astype(np.int64)
        elif column.dtype == TEXT:
            fixed[column.name] = values.astype("str")
        else:
            fixed[column.name] = values.astype(bool)
    taken = {*fixed, *INNER, *(name for name in drop if name not in fixed)}
    return pd.DataFrame({**fixed, **{name: table[name] for name in table.columns if name not in taken}})


def _inputs(
    campaign: Path, files: Sequence[FileStrokes], strokes: pd.DataFrame, faults: Sequence[Fault]
) -> pd.DataFrame:
    """Return table `inputs`: every trace file of the campaign, and those that are not used."""
    used = set(strokes.loc[strokes["used"], "file"])
    rows = [
        (made.file, made.mark, made.rows, len(made.strokes), "used" if made.file in used else "left out")
        for made in files
    ]
    known = {made.file for made in files}
    for fault in faults:
        if fault.file is not None and fault.file not in known and fault.action == "file left out":
            known.add(fault.file)
            status = "left out" if fault.severity == "error" else "not matched"
            rows.append((fault.file, fingerprint(campaign / fault.file), 0, 0, status))
    table = pd.DataFrame(
        [(file, m.size, m.mtime_ns, m.sha256, n, count, status) for file, m, n, count, status in rows],
        columns=["file", "size", "mtime_ns", "sha256", "rows", "strokes", "status"],
    )
    return table.astype({"file": "str", "size": "Int64", "mtime_ns": "Int64", "sha256": "str", "status": "str"})


def _nothing_left(faults: Sequence[Fault], files: int) -> list[Fault]:
    errors = [fault for fault in faults if fault.severity == "error"]
    more = len(errors) - SHOWN
    reason = f"none of {files} trace files can be used" + (f"; {more} more faults are not shown." if more > 0 else ".")
    return [*errors[:SHOWN], Fault("nothing_left", reason, mend="Mend what is said above; start with one file.")]
