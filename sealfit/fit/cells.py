"""Strokes in groups, averaged over cells of distance: all groups of a condition together."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from sealfit.fit.starts import LEAST, Part
from sealfit.ingest.pieces import Pieces, median

MOST_CELLS = 200  # of the distance over which strokes are averaged


class Cells:
    """Cells of distance, for groups of strokes that lie one after the other.

    The cells of a group reach as far as half of its strokes do and are as many as such a stroke has samples,
    MOST_CELLS at most. Arrays have as many columns as the group with most cells has.

    Attributes
    ----------
    parts : sequence of Part, length strokes
        The strokes, those of a group one after the other.
    groups : Pieces
        Which strokes are of which group.
    count : ndarray of int, shape (groups,)
        Cells of each group.
    samples, reach_mm : ndarray, shape (groups,)
        Median number of samples of a stroke, and the distance that half of the strokes reach.
    middle_mm : ndarray, shape (groups, cells)
        Middle of each cell.
    """

    def __init__(self, parts: Sequence[Part], group: np.ndarray) -> None:
        self.parts = parts
        self.groups = Pieces(np.bincount(group)) if len(parts) else Pieces([])
        self._size = np.array([part.force_N.size for part in parts], np.int64)
        reach = np.array([part.distance_mm[-1] for part in parts], float)
        self.samples, self.reach_mm = (
            np.array([median(values[own]) for own in self.groups.slices]) for values in (self._size, reach)
        )
        self.count = np.clip(self.samples.astype(int), LEAST, MOST_CELLS)
        width = int(self.count.max(initial=0))
        self.middle_mm = (np.arange(width) + 0.5) * (self.reach_mm / self.count)[:, None]
        # The cell of every sample in a flat array, one column more taking what lies beyond.
        distance = np.concatenate([part.distance_mm for part in parts]) if len(parts) else np.zeros(0)
        count = np.repeat(self.groups.spread(self.count), self._size)
        cell = (distance / np.repeat(self.groups.spread(self.reach_mm), self._size) * count).astype(np.int64)
        cell = np.where(cell < count, cell, width)
        self._cell = cell + np.repeat(np.arange(len(parts)) * (width + 1), self._size)
        self._shape = len(parts), width + 1

    @cached_property
    def own(self) -> np.ndarray:
        """Which cells are those of a stroke's group, shape (strokes, cells)."""
        return np.arange(self._shape[1] - 1) < self.groups.spread(self.count)[:, None]

    @cached_property
    def _hits(self) -> np.ndarray:
        return np.bincount(self._cell, minlength=self._shape[0] * self._shape[1]).reshape(self._shape)[:, :-1]

    def means(self, values: Sequence[np.ndarray]) -> np.ndarray:
        """Return each stroke's mean in each cell, shape (strokes, cells); NaN where it has no sample.

        Parameters
        ----------
        values : sequence of ndarray, shape (n,) each
            What is averaged, a number per sample of each stroke.
        """
        total = np.bincount(self._cell, np.concatenate(values), minlength=self._shape[0] * self._shape[1])
        return np.where(self._hits > 0, total.reshape(self._shape)[:, :-1] / np.maximum(self._hits, 1), np.nan)

    @cached_property
    def force_N(self) -> np.ndarray:
        """Each stroke's mean force, as `means` has it."""
        return self.means([part.force_N for part in self.parts])

    def totals(self, values: np.ndarray) -> np.ndarray:
        """Return the sum of values of strokes, shape (strokes, ...), over every group, shape (groups, ...)."""
        return np.add.reduceat(values, self.groups.start, axis=0)


def mean_over(cells: Cells, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean of strokes in each cell of their group, its standard error and how many, (groups, cells) each.

    Parameters
    ----------
    cells : Cells
        Of the strokes.
    values : ndarray, shape (strokes, cells)
        NaN where a stroke has none.
    """
    there = np.isfinite(values)
    n = cells.totals(there.astype(np.int64))
    mean = np.where(n > 0, cells.totals(np.where(there, values, 0.0)) / np.maximum(n, 1), np.nan)
    away = np.where(there, values - np.repeat(mean, cells.groups.size, axis=0), 0.0)
    variance = cells.totals(away**2) / np.maximum(n - 1, 1)
    return mean, np.where(n > 1, np.sqrt(variance / np.maximum(n, 1)), np.nan), n
