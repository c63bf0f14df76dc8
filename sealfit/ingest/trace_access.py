"""Samples of traces as table `traces` holds them, those of a stroke one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from sealfit.ingest.segments import median
from sealfit.store import parquet


@dataclass(frozen=True)
class StoredTraces:
    """Where the traces of some conditions lie: all of theirs, and of no others."""

    conditions: frozenset[str]
    paths: tuple[Path, ...]

    def read(self, columns: list[str] | None = None, coded: Sequence[str] = ()) -> pd.DataFrame:
        """Return them, or those columns of table `traces`; words of `coded` as categories."""
        return parquet.read(self.paths, columns, coded)


def by_conditions(parts: Mapping[Path, Iterable[str]]) -> list[StoredTraces]:
    """Return the parts of table `traces` in groups that share no condition.

    Parameters
    ----------
    parts : mapping of Path to iterable of str
        The conditions of each part.

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


def a_part_at_a_time(traces: pd.DataFrame | Sequence[StoredTraces], columns: list[str]) -> Iterator[pd.DataFrame]:
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
    """Return where each stroke's samples begin, the end of the last added, and which of `strokes` each is.

    Parameters
    ----------
    traces : DataFrame
        Rows of table `traces`.
    strokes : MultiIndex
        File and stroke of each.

    Returns
    -------
    edges : ndarray of int, shape (n + 1,)
        Samples edges[k] to edges[k + 1] are one stroke.
    own : ndarray of int, shape (n,)
        Its place in `strokes`; -1 where it is not among them.
    """
    file = traces["file"]
    if isinstance(file.dtype, pd.CategoricalDtype):
        file, names = file.cat.codes.to_numpy(), file.cat.categories
    else:
        file, names = pd.factorize(file)
    stroke = traces["stroke"].to_numpy()
    first = np.flatnonzero(np.r_[True, (file[1:] != file[:-1]) | (stroke[1:] != stroke[:-1])])
    own = strokes.get_indexer(pd.MultiIndex.from_arrays([np.asarray(names, object)[file[first]], stroke[first]]))
    return np.r_[first, file.size], own


def noise_from_bends(bends: np.ndarray) -> float:
    """Return the standard deviation of a sample from second differences of neighbours; 0 without any.

    Their variance is six times a sample's; the median absolute deviation is blind to where the signal itself bends.
    """
    return 1.4826 * median(np.abs(bends - median(bends))) / np.sqrt(6.0) if bends.size else 0.0
