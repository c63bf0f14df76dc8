"""Flat arrays of many strokes or runs one after the other, and medians and stretches along one trace."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d


class Pieces:
    """Where each of k pieces lies in a flat array: rows `start` to `stop` (exclusive), both of shape (k,).

    The pieces follow one another without gaps, and none is empty.
    """

    def __init__(self, sizes: Sequence[int] | np.ndarray):
        self.size = np.asarray(sizes, np.int64)
        self.stop = np.cumsum(self.size)
        self.start = self.stop - self.size

    @cached_property
    def of(self) -> np.ndarray:
        """The piece of every row, shape (rows,)."""
        return np.repeat(np.arange(len(self.size)), self.size)

    @cached_property
    def slices(self) -> list[slice]:
        """The rows of every piece."""
        return [slice(*ends) for ends in zip(self.start.tolist(), self.stop.tolist(), strict=True)]

    def spread(self, per_piece: np.ndarray) -> np.ndarray:
        """Return a value per piece as one per row."""
        return np.repeat(per_piece, self.size)


def median(values: np.ndarray) -> float:
    """Return the median, as `np.median` does, of an array that holds no nan."""
    half, odd = divmod(len(values), 2)
    ordered = np.partition(values, half)
    return float(ordered[half]) if odd else float((ordered[:half].max() + ordered[half]) / 2.0)


def quantile(values: np.ndarray, share: float) -> float:
    """Return the quantile between neighbours, as `np.quantile` does, of an array that holds no nan.

    Examples
    --------
    >>> quantile(np.array([3.0, 1.0, 2.0, 4.0]), 0.5), quantile(np.array([3.0, 1.0, 2.0, 4.0]), 0.9)
    (2.5, 3.7)
    """
    place = (len(values) - 1) * share
    low = int(place)
    ordered = np.partition(values, low)
    below = float(ordered[low])
    if low + 1 == len(values):
        return below
    above, part = float(ordered[low + 1 :].min()), place - low
    return above - (above - below) * (1.0 - part) if part >= 0.5 else below + (above - below) * part


def weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the value at which half of the weight lies at smaller ones; 0 where there is no weight.

    Examples
    --------
    >>> weighted_median(np.array([5.0, 1.0, 3.0]), np.array([1.0, 1.0, 4.0]))
    3.0
    """
    order = np.argsort(values)
    covered = np.cumsum(weights[order])
    return float(values[order[covered.searchsorted(0.5 * covered[-1])]]) if covered[-1] > 0.0 else 0.0


def smoothed(values: np.ndarray, samples: int) -> np.ndarray:
    """Return `values` as a running mean of running medians over `samples` samples, shape (n,)."""
    values = np.asarray(values, float)
    if samples == 1:
        return values
    return uniform_filter1d(median_filter(values, samples, mode="nearest"), samples, mode="nearest")


def stretches(mask: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and the last row (exclusive) of every stretch in which `mask` is true.

    Examples
    --------
    >>> stretches(np.array([True, False, True, True]))
    [(0, 1), (2, 4)]
    """
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))
