"""Parts of a campaign on disk: written by whoever reads them, and samples of strokes read from them again."""

import hashlib
import json
import os
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from sealfit import __version__
from sealfit.config import Config
from sealfit.errors import Fault, disk
from sealfit.ingest.columns import Listing
from sealfit.ingest.partitions import SAMPLED, Asked, Columns, PartitionResult, read_part
from sealfit.store import parquet
from sealfit.store.manifest import Fingerprints
from sealfit.store.staged_writes import PARQUET, sync


@dataclass(frozen=True)
class StoredTraces:
    """Where the traces of some conditions lie: all of theirs, and of no others."""

    conditions: frozenset[str]
    paths: tuple[Path, ...]

    def read(self, columns: list[str] | None = None, coded: Sequence[str] = ()) -> pd.DataFrame:
        """Return them, or those columns of table `traces`; words of `coded` as categories."""
        return parquet.read(self.paths, columns, coded)


def by_conditions(parts: Mapping[Path, Iterable[str]]) -> list[StoredTraces]:
    """Return the parts of table `traces`, given with their conditions, in groups that share no condition.

    Examples
    --------
    >>> groups = by_conditions({Path("1"): ["a", "b"], Path("2"): ["c"], Path("3"): ["b", "d"]})
    >>> [sorted(group.conditions) for group in groups]
    [['a', 'b', 'd'], ['c']]
    """
    groups: list[StoredTraces] = []
    for path, conditions in parts.items():
        joined = StoredTraces(frozenset(conditions), (path,))
        for group in [group for group in groups if group.conditions & joined.conditions]:
            groups.remove(group)
            joined = StoredTraces(group.conditions | joined.conditions, (*group.paths, *joined.paths))
        groups.append(joined)
    return sorted(groups, key=lambda group: min(group.conditions, default=""))


def a_part_at_a_time(
    traces: pd.DataFrame | Sequence[StoredTraces], columns: list[str]
) -> Iterator[pd.DataFrame]:
    """Yield table `traces`, or each part of where it lies: these columns of it, files as categories there."""
    if isinstance(traces, pd.DataFrame):
        yield traces[columns]
        return
    for path in (path for group in traces for path in group.paths):
        yield parquet.read(path, columns, coded=["file"])


def stroke_index(table: pd.DataFrame) -> pd.MultiIndex:
    """Return the file and stroke of each row, for `strokes_of`."""
    return pd.MultiIndex.from_frame(table[["file", "stroke"]])


def strokes_of(traces: pd.DataFrame, strokes: pd.MultiIndex) -> tuple[np.ndarray, np.ndarray]:
    """Return `edges`, shape (n + 1,), and `own`, shape (n,), of the strokes of table `traces`.

    Samples edges[k] to edges[k + 1] are one stroke: `strokes[own[k]]`; own[k] is -1 where it is not there.
    """
    file = traces["file"]
    if isinstance(file.dtype, pd.CategoricalDtype):
        file, names = file.cat.codes.to_numpy(), file.cat.categories
    else:
        file, names = pd.factorize(file)
    stroke = traces["stroke"].to_numpy()
    first = np.flatnonzero(np.r_[True, (file[1:] != file[:-1]) | (stroke[1:] != stroke[:-1])])
    there = pd.MultiIndex.from_arrays([np.asarray(names, object)[file[first]], stroke[first]])
    return np.r_[first, file.size], strokes.get_indexer(there)


def noise_from_bends(bends: np.ndarray) -> float:
    """Return the standard deviation of a sample from second differences of neighbours; 0 without any.

    Their variance is six times a sample's; the median is blind to where the signal itself bends.
    """
    return 1.4826 * np.median(np.abs(bends - np.median(bends))) / np.sqrt(6.0) if bends.size else 0.0


# ---------------------------------------------------------------- stored parts
# A part's files are named by what it was made from, so a part that is as it was keeps its files. Beside its
# tables a part has a file of its strokes and findings: with it, the campaign is judged without the samples.

PARTS = "parts"  # folder of OUT with the strokes of each part
ARROW = ".arrow"
FORMAT = 7  # of a part's files; those of another one are made again
_ABOUT = b"part"


def make_part(asked: Asked, campaign: Path, config: Config, folder: Path | None) -> PartitionResult:
    """Read a part and store it below `folder`, or keep its tables in memory where there is none.

    OutError if the disk is full or refuses.
    """
    part = read_part(asked, campaign, config)
    if folder is None:
        return part
    hashes = [part.marks[file].sha256 for file in asked.refs.files]
    key = part_key(asked.refs, hashes, seen_by_parts(config)) or uuid.uuid4().hex[:20]
    variant = json.dumps([sorted(asked.unused), asked.columns], sort_keys=True)
    name = f"{key}-{hashlib.sha256(variant.encode()).hexdigest()[:8]}{PARQUET}"
    with disk(folder.parent):
        stored = {
            (file := f"{of}{PARQUET}/{name}"): _written(folder / file, table, parquet.write_arrow)
            for of, table in part.tables.items()
        }
        about = {name: getattr(part, name) for name in ("wanted", "columns", "rows", "found")}
        faults = [fault.as_dict() for fault in part.faults]
        about |= {"unused": sorted(part.unused), "faults": faults, "stored": stored}
        metadata = {**(part.strokes.schema.metadata or {}), _ABOUT: json.dumps(about)}
        file = f"{PARTS}/{Path(name).with_suffix(ARROW)}"
        strokes = part.strokes.replace_schema_metadata(metadata)
        stored[file] = _written(folder / file, strokes, parquet.write_ipc)
    # Its strokes are not sent: whoever asked need not hold them while other parts are read.
    return replace(part, strokes=None, tables={}, stored=stored)


def stored_strokes(part: PartitionResult, folder: Path | None) -> pa.Table:
    """Return the strokes of a part, from the disk if they lie there: in `folder`, in which it was made."""
    if part.strokes is not None:
        return part.strokes
    return parquet.read_ipc(folder / next(name for name in part.stored if name.startswith(f"{PARTS}/")))


def seen_by_parts(config: Config) -> str:
    """Return in words what every part is made by, whatever its files: the program's version and the rig."""
    return json.dumps([__version__, FORMAT, config.model_dump(mode="json")])


def part_key(listing: Listing, hashes: Sequence[str | None], seen: str) -> str | None:
    """Return a hash of what a part is made from, or None where a file's content is not known.

    `hashes` are those of the content of its files; `seen` is what `seen_by_parts` says.
    """
    if None in hashes:
        return None
    about = json.dumps([seen, listing.files, hashes, listing.columns, sorted(listing.cut)])
    return hashlib.sha256(about.encode("utf-8", "surrogatepass")).hexdigest()[:20]


def known_parts(out: Path, files: Iterable[str], is_whole: Callable[[str], bool]) -> dict[str, Path]:
    """Return the stored parts that are whole, by their keys; `files` are those of the last ingest."""
    whole = {Path(name).stem: out / name for name in files if name.startswith(f"{PARTS}/")}
    for name in files:
        if "/" in name and not is_whole(name):
            whole.pop(Path(name).stem, None)
    return {name.split("-", 1)[0]: path for name, path in whole.items()}


def load_parts(
    listings: Sequence[Listing], marks: Fingerprints, known: Mapping[str, Path], config: Config
) -> dict[int, PartitionResult]:
    """Return the parts that are stored (`known_parts`), without their tables, by number in the plan."""
    made, seen = {}, seen_by_parts(config)
    for i, listing in enumerate(listings if known else ()):
        path = known.get(part_key(listing, [marks[file].sha256 for file in listing.files], seen) or "")
        if path is None:
            continue
        strokes = parquet.read_ipc(path)
        about = json.loads(strokes.schema.metadata[_ABOUT])
        about["unused"] = frozenset((file, stroke) for file, stroke in about["unused"])
        about["faults"] = tuple(Fault(**fault) for fault in about["faults"])
        about["stored"][f"{PARTS}/{path.name}"] = path.stat().st_size
        made[i] = PartitionResult(marks={}, strokes=strokes, **about)
    return made


def asked_again(
    listings: Sequence[Listing], parts: Sequence[PartitionResult], strokes: pd.DataFrame
) -> dict[int, Asked]:
    """Return the parts to make again: the whole campaign omits other strokes or has other columns."""
    # A stroke whose own file shows something wrong is left out by its part anyway.
    gone = strokes[~strokes["used"].to_numpy(bool) & strokes["by_itself"].to_numpy(bool)]
    of_file = gone.groupby("file")["stroke"].agg(list).to_dict()
    columns, again = _common_columns(parts), {}
    for i, (own, part) in enumerate(zip(listings, parts, strict=True)):
        out = frozenset((file, stroke) for file in own.files for stroke in of_file.get(file, ()))
        has = {table: (part.wanted or part.columns)[table] for table in part.columns}
        agrees = all(list(types.items()) == list(columns[table].items()) for table, types in has.items())
        if part.unused != out or not agrees:
            again[i] = Asked(own, out, columns)
    return again


def _common_columns(parts: Sequence[PartitionResult]) -> Columns:
    """Return the columns of each table over all parts, which must agree; numbers beside words are words."""
    common: dict[str, dict[str, str]] = {name: {} for name in SAMPLED}
    for columns in (part.columns for part in parts):
        for table, types in columns.items():
            for name, kind in types.items():
                known = common[table].setdefault(name, kind)
                if known != kind:
                    common[table][name] = "string" if "string" in (known, kind) else "double"
    return common


def _written(path: Path, table: pa.Table, write: Callable[[pa.Table, Path], None]) -> int:
    """Write a table whole or not at all, also where two processes write the same; return its size."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
    write(table, draft)
    sync(draft)
    os.replace(draft, path)
    return path.stat().st_size
