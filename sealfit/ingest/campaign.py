"""A campaign folder to tables: every file read, split and judged, repeats averaged; part by part."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from sealfit.config import Config
from sealfit.engine.run_map import run_map
from sealfit.errors import CampaignError, Fault, grouped
from sealfit.ingest.columns import condition_columns, force_inputs
from sealfit.ingest.partitions import INNER, SAMPLED, Asked, PartitionResult, plan_parts, shaped
from sealfit.ingest.quality import (
    computed_force,
    improbable_loads,
    incomplete_columns,
    quality_table,
    repeats_of_force,
)
from sealfit.ingest.repeat_checks import (
    judged,
    other_units,
    outlying_files,
    settings_within_runs,
    turned_sign,
)
from sealfit.ingest.runs import FIX, list_traces
from sealfit.ingest.stored_parts import asked_again, load_parts, make_part, stored_strokes
from sealfit.progress import timed
from sealfit.store.manifest import Fingerprint, Fingerprints, fingerprint
from sealfit.store.parquet import as_words
from sealfit.store.staged_writes import file_size
from sealfit.tables import RUNS, STEADY


def inputs_table(
    campaign: Path, marks: Fingerprints, counts: np.ndarray, used: np.ndarray, faults: Sequence[Fault]
) -> tuple[pd.DataFrame, Fingerprints]:
    """Return table `inputs`, every trace file of the campaign, and their fingerprints.

    `marks` are those of the listing's files, `counts` their rows and strokes, and `used` says which have a
    stroke that is used. Faults name the files that are not in the listing.
    """
    others: dict[str, str] = {}  # files that are not in the listing, and their status
    for fault in faults:
        if fault.file is not None and fault.file not in marks and fault.action == "file left out":
            others.setdefault(fault.file, "left out" if fault.severity == "error" else "not matched")
    marks |= {file: fingerprint(campaign / file) for file in others}
    rows, strokes = np.pad(counts, ((0, 0), (0, len(others))))
    table = pd.DataFrame(
        {
            "file": pd.array(list(marks), "str"),
            "size": pd.array([mark.size for mark in marks.values()], "Int64"),
            "mtime_ns": pd.array([mark.mtime_ns for mark in marks.values()], "Int64"),
            "sha256": pd.array([mark.sha256 for mark in marks.values()], "str"),
            "rows": rows,
            "strokes": strokes,
            "status": pd.array([*np.where(used, "used", "left out").tolist(), *others.values()], "str"),
        }
    )
    return table, {file: mark for file, mark in marks.items() if mark.sha256 is not None}


SHOWN = 20  # faults that a campaign without a single usable stroke lists, those that files share as one


@dataclass(frozen=True)
class Place:
    """Where parts are stored, those already there, by their keys, and the campaign's files as they are now.

    Without a folder the parts are kept in memory.
    """

    folder: Path | None = None
    known: Mapping[str, Path] = field(default_factory=dict)
    marks: Fingerprints = field(default_factory=dict)


@dataclass(frozen=True)
class Ingested:
    """Tables inputs, runs, quality and steady, and traces, traces_mean and bins unless stored by parts.

    `faults` are the warnings and errors of `quality`; `marks` the files as they were read; `stored` the files
    of the parts, by their names below OUT, with their sizes.
    """

    tables: dict[str, pd.DataFrame]
    faults: list[Fault]
    marks: Fingerprints
    stored: dict[str, int]


def ingest_campaign(
    campaign: Path,
    config: Config,
    *,
    workers: int = 1,
    on_file: Callable[[int, int], None] | None = None,
    place: Place | None = None,
) -> Ingested:
    """Return the tables of a campaign.

    Parameters
    ----------
    campaign : Path
        Folder with runs.csv, or with files that the config's glob finds.
    workers : int
        Processes; the tables do not depend on it.
    on_file : callable, optional
        Called as files have been read with their number so far, and the number of files to be read.
    place : Place, optional
        Where the tables of samples are to be stored, so that they need not fit into memory; only what is not
        there yet is read.

    Raises
    ------
    CampaignError
        For faults that concern the whole campaign, or where not one stroke can be used.
    """
    place = place or Place()
    with timed("listing trace files") as part:
        listing, faults = list_traces(campaign, config)
        marks = {file: place.marks.get(file, Fingerprint()) for file in listing.files}
        # 0 of a file that cannot be read: reading it will say why.
        sizes = [marks[file].size or file_size(f"{campaign}/{file}") or 0 for file in listing.files]
        numbers = plan_parts(listing.conditions, listing.columns["run_id"], sizes)
        plan = [np.array(files) for files in numbers]
        part.rows, part.of = len(listing), "files"
    make = partial(make_part, campaign=campaign, config=config, folder=place.folder)
    read = partial(_read, make=make, workers=workers, on_file=on_file)
    listings = [listing.take(rows) for rows in plan]
    with timed("reading trace files") as part:
        made = load_parts(listings, marks, place.known, config)
        asked = {i: Asked(own) for i, own in enumerate(listings) if i not in made}
        made |= read(asked)
        part.rows, part.of = sum(len(one.refs) for one in asked.values()), "files"
    parts = [made[i] for i in range(len(plan))]
    number = {file: i for i, file in enumerate(listing.files)}
    faults += sorted((fault for part in parts for fault in part.faults), key=lambda fault: number[fault.file])
    files = np.concatenate([np.repeat(rows, part.found) for rows, part in zip(plan, parts, strict=True)])
    order = np.argsort(files, kind="stable")
    strokes = strokes_of([stored_strokes(part, place.folder) for part in parts])
    strokes, files = strokes.take(order).reset_index(drop=True), files[order]
    parts = [replace(part, strokes=None) for part in parts]  # they are in one table now
    strokes, found = judged(strokes)
    faults += found
    if not strokes["used"].any():
        raise CampaignError(_nothing_left(faults, len(listing)))
    if turned := turned_sign(strokes, config):
        raise CampaignError(turned)
    steady, found = outlying_files(strokes[strokes["used"]].reset_index(drop=True), config)
    faults += found
    inputs = force_inputs(config)
    seen = steady.drop(columns=[*INNER, *config.loop.ignore_channels, *inputs], errors="ignore")
    faults += incomplete_columns(seen, config.series_columns if config.aging else ())
    faults += improbable_loads(steady, config) + computed_force(inputs & {*steady.columns})
    faults += other_units(steady, config)
    faults += repeats_of_force(seen)
    faults += settings_within_runs(seen, {*STEADY.names(), *condition_columns(config)})
    used = strokes["used"].to_numpy(bool).copy()
    used[used] = steady["used"].to_numpy(bool)
    strokes = strokes.assign(used=used)
    again = read(asked_again(listings, parts, strokes))
    parts = [again.get(i, part) for i, part in enumerate(parts)]
    used = np.zeros(len(listing), bool)
    used[files[strokes["used"].to_numpy(bool)]] = True
    for part in parts:
        marks |= part.marks
    counts = np.zeros((2, len(listing)), np.int64)
    counts[:, np.concatenate(plan)] = np.concatenate([[part.rows, part.found] for part in parts], axis=1)
    inputs, marks = inputs_table(campaign, marks, counts, used, faults)
    tables = {
        "inputs": inputs,
        "runs": shaped(strokes, RUNS, drop=STEADY.names()),
        "quality": quality_table(faults, inputs["file"].tolist()),
        "steady": shaped(steady, STEADY),
    }
    if place.folder is None:
        for name in SAMPLED:
            own = pa.concat_tables(part.tables[name] for part in parts if name in part.tables)
            tables[name] = own.replace_schema_metadata().to_pandas()
    stored = {name: size for part in parts for name, size in part.stored.items()}
    return Ingested(tables, [fault for fault in faults if fault.severity != "info"], marks, stored)


def _read(
    asked: Mapping[int, Asked],
    make: Callable[[Asked], PartitionResult],
    workers: int,
    on_file: Callable[[int, int], None] | None,
) -> dict[int, PartitionResult]:
    """Return the parts; the largest are read first, so that at the end no process has much left alone."""
    order = sorted(asked, key=lambda i: -len(asked[i].refs))
    total, done, made = sum(len(part.refs) for part in asked.values()), 0, {}
    results = run_map(make, [asked[i] for i in order], workers=workers, together=1)
    for i, part in zip(order, results, strict=True):
        made[i] = part
        done += len(part.rows)
        if on_file is not None:
            on_file(done, total)
    return made


def strokes_of(parts: Sequence[pa.Table]) -> pd.DataFrame:
    """Return the strokes of all parts in one table; a column with words in one part has words in all."""
    whole = [part for part in parts if part.num_rows] or parts[:1]
    words = {column.name for part in whole for column in part.schema if column.type == pa.string()}
    worded = []
    for part in whole:
        for i, column in enumerate(part.schema):
            if column.name in words and column.type != pa.string():
                part = part.set_column(i, column.name, as_words(part.column(i).to_pandas()))
        worded.append(part)
    table = pa.concat_tables(worded, promote_options="permissive").to_pandas()
    return table.assign(by_itself=table["used"])


def _nothing_left(faults: Sequence[Fault], files: int) -> list[Fault]:
    errors = [fault for fault in faults if fault.severity == "error"]
    shown = [fault for group in grouped(errors)[:SHOWN] for fault in group]
    more = len(errors) - len(shown)
    rest = f"; {more} more faults are not shown." if more > 0 else "."
    reason = f"none of {files} trace files can be used{rest}"
    return [*shown, Fault("nothing_left", reason, fix=FIX)]
