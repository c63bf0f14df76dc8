"""A campaign cut into parts of whole runs: what is read at once, by one process, and stored in one file a table.

Where a cut lies depends on the runs beside it alone (content-defined chunking), so files that are added to a campaign
change the part they belong to and, at most, its neighbours; everything else stays as it is on the disk.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

PART_FILES = 256  # a part of so many files is stored in one file a table: few enough files, and little to read for one
PART_BYTES = 4_000_000  # condition; of trace files, whichever comes first: a part's samples take some ten times that
LEAST, MOST = 0.25, 2.0  # smallest and largest part, in parts as wanted; a run is never cut


def plan_parts(conditions: Sequence[str], runs: Sequence[str], sizes: Sequence[int]) -> list[list[int]]:
    """Return the files of each part, by their numbers, rising within a part; every file is in one part.

    Conditions stay together unless one is larger than a part; runs always. A part holds conditions that are neighbours
    in the order of their names, so the least and the largest name, which Parquet keeps, tell a reader what to skip.

    Parameters
    ----------
    conditions, runs : sequence of str, length n
        Condition and run of every file.
    sizes : sequence of int, length n
        Sizes of the files in bytes.

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
        weights = {run: _weight(files, sizes) for run, files in of_run.items()}
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


def _weight(files: Sequence[int], sizes: Sequence[int]) -> float:
    """Return how much of a part these files fill."""
    return max(len(files) / PART_FILES, sum(sizes[i] for i in files) / PART_BYTES)


def _cut(name: str, weight: float) -> bool:
    """Whether a part ends at `name`: by its hash, as often as makes parts of the wanted size."""
    number = int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")
    return number < weight * 2.0**64
