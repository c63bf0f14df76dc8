"""Nested groups of rows: strokes in files, files in runs, runs in specimens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array


@dataclass(frozen=True, slots=True)
class Groups:
    """Nested groups of sorted rows: for each level, the first row of every group and each row's group number."""

    starts: dict[str, np.ndarray]
    codes: dict[str, np.ndarray]

    @classmethod
    def of(cls, codes: dict[str, np.ndarray]) -> Groups:
        """Return the groups of `codes` (level -> group per row, contiguous, finest level first)."""
        starts, numbers = {}, {}
        for level, code in codes.items():
            change = np.flatnonzero(np.r_[True, code[1:] != code[:-1]][: code.size])  # no rows: no groups
            starts[level] = change
            numbers[level] = np.repeat(np.arange(change.size), np.diff(np.r_[change, code.size]))
        return cls(starts, numbers)

    def sums(self, values: np.ndarray, level: str) -> np.ndarray:
        """Return the sum of `values`, shape (n,) or (n, k), over each group of a level."""
        start, n = self.starts[level], values.shape[0]
        if values.ndim == 1:
            return np.add.reduceat(values, start)
        summing = csr_array((np.ones(n), np.arange(n), np.r_[start, n]), shape=(start.size, n))
        return summing @ values  # ten times as fast as reduceat

    def means(self, values: np.ndarray, level: str) -> np.ndarray:
        """Return the mean of `values`, shape (n,) or (n, k), in each group of a level."""
        count = np.diff(np.r_[self.starts[level], values.shape[0]]).astype(float)
        return self.sums(values, level) / (count if values.ndim == 1 else count[:, None])

    def at(self, level: str) -> Groups:
        """Return the groups of a table with one row per group of `level`."""
        first = self.starts[level]
        levels = list(self.codes)
        return Groups.of({name: self.codes[name][first] for name in levels[levels.index(level) :]})

    def repeated(self, count: int) -> Groups:
        """Return the groups of a table with each row `count` times, one copy after the other."""
        return Groups(
            {level: count * start for level, start in self.starts.items()},
            {level: np.repeat(code, count) for level, code in self.codes.items()},
        )
