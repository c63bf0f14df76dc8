"""One flat array that holds many traces, or many strokes, one after the other: what is computed of each in one go.

A function of numpy costs a microsecond before it sees a number, and a trace of a thousand rows needs a few hundred of
them. So the traces of some dozens of files are laid end to end, and every step is done for all of them at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

BINS = 64  # parts of a range that a weighted median is looked for in


class Pieces:
    """Where each of k pieces lies in a flat array: rows `start` to `stop` (exclusive), both of shape (k,).

    The pieces follow one another without gaps, and none is empty.
    """

    def __init__(self, sizes: Sequence[int] | np.ndarray):
        self.size = np.asarray(sizes, np.int64)
        self.stop = np.cumsum(self.size)
        self.start = self.stop - self.size

    def __len__(self) -> int:
        return len(self.size)

    @property
    def rows(self) -> int:
        """Length of the flat array."""
        return int(self.stop[-1]) if len(self.stop) else 0

    @cached_property
    def of(self) -> np.ndarray:
        """The piece of every row, shape (rows,)."""
        return np.repeat(np.arange(len(self)), self.size)

    @cached_property
    def slices(self) -> list[slice]:
        """The rows of every piece."""
        return [slice(*ends) for ends in zip(self.start.tolist(), self.stop.tolist(), strict=True)]

    def spread(self, per_piece: np.ndarray) -> np.ndarray:
        """Return a value per piece as one per row."""
        return np.repeat(per_piece, self.size)

    def max(self, values: np.ndarray) -> np.ndarray:
        """Return the largest value of every piece, shape (k,)."""
        return np.maximum.reduceat(values, self.start)

    def min(self, values: np.ndarray) -> np.ndarray:
        """Return the smallest value of every piece, shape (k,)."""
        return np.minimum.reduceat(values, self.start)

    def sum(self, values: np.ndarray) -> np.ndarray:
        """Return the sum over every piece, shape (k,); of a mask, how many are true."""
        if values.dtype == bool:
            return np.add.reduceat(values, self.start, dtype=np.int64)
        # Not by reduceat, which adds one after the other: the mean of a constant would not be that constant.
        return np.array([np.add.reduce(values[own]) for own in self.slices])

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return the mean of every piece, shape (k,)."""
        return self.sum(values) / self.size

    def steps(self, values: np.ndarray) -> np.ndarray:
        """Return how far it is from every row to the next one of its piece, shape (rows,); 0 at the last."""
        made = np.zeros(self.rows)
        np.subtract(values[1:], values[:-1], out=made[:-1])
        made[self.stop - 1] = 0.0
        return made

    def split(self, rows: np.ndarray) -> list[np.ndarray]:
        """Return, for every piece, those of `rows` (rising) that lie in it, counted from its first row."""
        at = np.searchsorted(rows, [*self.start, self.rows]).tolist()
        return [rows[a:b] - start for a, b, start in zip(at, at[1:], self.start.tolist(), strict=False)]


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


def weighted_medians(values: np.ndarray, weights: np.ndarray, pieces: Pieces) -> np.ndarray:
    """Return, for every piece, the value at which half of the weight lies at smaller ones; 0 where there is none.

    Only what is positive weighs: `weights` are 0 wherever `values` are not above 0.
    """
    made, numbers = np.zeros(len(pieces)), np.arange(len(pieces))
    low, high, before = np.zeros(len(pieces)), pieces.max(values), np.zeros(len(pieces))
    half: np.ndarray | None = None
    rows, part, here = np.arange(pieces.rows), pieces, numbers  # what is left to look at: its rows, its pieces, whose
    value, weight = values, weights
    # How much lies in which part of the range, and again within the part where the half is, until few are to be sorted.
    for _ in range(4):
        scale = np.divide(BINS, high - low, out=np.zeros(len(pieces)), where=high > low)
        place = (value - part.spread(low[here])) * part.spread(scale[here])
        place = place.clip(0.0, BINS - 1.0).astype(np.int64) + part.spread(BINS * here)
        held = np.bincount(place, weight, minlength=BINS * len(pieces)).reshape(len(pieces), BINS)
        covered = before[:, None] + np.cumsum(held, axis=1)
        half = 0.5 * covered[:, -1] if half is None else half
        crossing = np.minimum((covered < half[:, None]).sum(axis=1), BINS - 1)
        before = np.where(crossing > 0, covered[numbers, crossing - 1], before)
        inside = place == part.spread((crossing + BINS * numbers)[here])
        count = part.sum(inside)
        rows, value, weight = rows[inside], value[inside], weight[inside]
        here, part = here[count > 0], Pieces(count[count > 0])
        low[here], high[here] = part.min(value), part.max(value)
        if ((part.size <= BINS) | (low == high)[here]).all():
            break
    for i, own in enumerate(pieces.split(rows)):
        if half[i] > 0.0 and low[i] == high[i]:
            made[i] = low[i]
        elif half[i] > 0.0:
            held = own + pieces.start[i]
            order = held[np.argsort(values[held])]
            reached = np.searchsorted(before[i] + np.cumsum(weights[order]), half[i])
            made[i] = values[order[min(int(reached), len(order) - 1)]]
    return made
