"""Flat arrays that hold many traces or strokes one after the other, and running means and medians along each."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, cached_property
from typing import Literal

import numpy as np

# ---------------------------------------------------------------- pieces
# One flat array that holds many traces, or many strokes, one after the other: what is computed of each in one go.
#
# A function of numpy costs a microsecond before it sees a number, and a trace of a thousand rows needs a few hundred of
# them. So the traces of some dozens of files are laid end to end, and every step is done for all of them at once.

SAMPLE = 64  # rows of a piece that tell where about its weighted median lies


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


def numbered(labels: Sequence[object]) -> tuple[np.ndarray, int]:
    """Return a number for every label, the first one 0 and every new one the next, and how many labels there are.

    Examples
    --------
    >>> numbered(["b", "a", "b"])
    (array([0, 1, 0]), 2)
    """
    numbers: dict[object, int] = {}
    return np.array([numbers.setdefault(label, len(numbers)) for label in labels], np.int64), len(numbers)


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
    # A sample of rows tells between which values the half will lie; only what lies between them is put in order.
    at = pieces.start[:, None] + np.arange(SAMPLE) * pieces.size[:, None] // SAMPLE
    order = np.argsort(values[at], axis=1)
    sample = np.take_along_axis(values[at], order, axis=1)
    covered = np.cumsum(np.take_along_axis(weights[at], order, axis=1), axis=1)
    ends = [np.argmax(covered >= share * covered[:, -1:], axis=1) for share in (0.35, 0.65)]
    low, high = np.take_along_axis(sample, np.array(ends).T, axis=1).T
    inside = (values >= pieces.spread(low)) & (values <= pieces.spread(high))
    half = 0.5 * np.add.reduceat(weights, pieces.start)
    before = np.add.reduceat(weights * (values < pieces.spread(low)), pieces.start)
    held = np.add.reduceat(weights * inside, pieces.start)
    caught = (before < half) & (half <= before + held)
    made = np.zeros(len(pieces))
    for i, own in enumerate(pieces.slices):
        if half[i] <= 0.0:
            continue
        if caught[i] and low[i] == high[i]:
            made[i] = low[i]
            continue
        chosen = inside[own] if caught[i] else slice(None)
        value, weight = values[own][chosen], weights[own][chosen]
        order = np.argsort(value)
        reached = (before[i] if caught[i] else 0.0) + np.cumsum(weight[order])
        made[i] = value[order[min(int(reached.searchsorted(half[i])), len(order) - 1)]]
    return made


# ---------------------------------------------------------------- running
# Running medians and means along every piece of a flat array, as scipy.ndimage has them along one trace.

BLOCK = 8192  # rows at once: what is held of them fits into the cache
Edge = Literal["nearest", "mirror"]
# Which two of a window are put in order, one pair after the other, until its middle holds the median: N. Devillard
# 1998, Fast median search: an ANSI C implementation.
_NETWORKS = {
    3: ((0, 1), (1, 2), (0, 1)),
    5: ((0, 1), (3, 4), (0, 3), (1, 4), (1, 2), (2, 3), (1, 2)),
    7: ((0, 5), (0, 3), (1, 6), (2, 4), (0, 1), (3, 5), (2, 6), (2, 3), (3, 6), (4, 5), (1, 4), (1, 3), (3, 4)),
}


def running_median(values: np.ndarray, pieces: Pieces, samples: int, edge: Edge = "nearest") -> np.ndarray:
    """Return the median over `samples` samples around every row, shape (rows,); of an even number, the upper one.

    Parameters
    ----------
    edge : str
        What lies beyond the ends of a piece: its last sample ("nearest"), or its samples mirrored about that one.
    """
    left = samples // 2
    made = np.empty(len(values))
    inner = len(values) - samples + 1
    for first in range(0, inner, BLOCK):
        last = min(first + BLOCK, inner)
        made[left + first : left + last] = _medians([values[first + i : last + i] for i in range(samples)])
    rows = _near_ends(pieces, left, samples - left - 1)
    window = _reached(rows, np.arange(-left, samples - left), pieces, edge)
    made[rows] = _medians(list(values[window]))
    return made


def running_mean(values: np.ndarray, pieces: Pieces, samples: int) -> np.ndarray:
    """Return the mean over `samples` samples around every row, shape (rows,); beyond an end lies its last sample.

    The sum is carried along the piece, as scipy.ndimage.uniform_filter1d does.
    """
    left = samples // 2
    right = samples - left - 1
    step = np.empty(len(values))
    inner = len(values) - samples
    if inner > 0:
        np.subtract(values[samples:], values[:-samples], out=step[left + 1 : left + 1 + inner])
    rows = _near_ends(pieces, left + 1, right)
    step[rows] = np.subtract(*values[_reached(rows, np.array([right, -left - 1]), pieces, "nearest")])
    first = values[_reached(pieces.start, np.arange(-left, right + 1), pieces, "nearest")]
    total = np.zeros(len(pieces))
    for sample in first:
        total += sample
    step[pieces.start] = total
    for rows in pieces.slices:
        np.cumsum(step[rows], out=step[rows])
    return step / samples


def _medians(window: list[np.ndarray]) -> np.ndarray:
    """Return the medians of as many samples as there are arrays, shape that of each of them."""
    samples, at = len(window), len(window) // 2
    if samples not in _NETWORKS:
        return np.partition(np.stack(window), at, axis=0)[at]
    held = list(window)
    for low, high, wants_low, wants_high in _steps(samples):
        a, b = held[low], held[high]
        if wants_low:
            held[low] = np.minimum(a, b)
        if wants_high:
            held[high] = np.maximum(a, b)
    return held[at]


@cache
def _steps(samples: int) -> list[tuple[int, int, bool, bool]]:
    """Return the network of a median, and which of the two of every pair is of use later."""
    wanted, made = {samples // 2}, []
    for low, high in reversed(_NETWORKS[samples]):
        made.append((low, high, low in wanted, high in wanted))
        wanted |= {low, high}
    return made[::-1]


def _near_ends(pieces: Pieces, left: int, right: int) -> np.ndarray:
    """Return the rows less than `left` rows from the start of their piece, or `right` from its end."""
    head = np.minimum(pieces.start[:, None] + np.arange(left), pieces.stop[:, None] - 1)
    tail = np.maximum(pieces.stop[:, None] - 1 - np.arange(right), pieces.start[:, None])
    return np.concatenate([head.ravel(), tail.ravel()])


def _reached(rows: np.ndarray, offsets: np.ndarray, pieces: Pieces, edge: Edge) -> np.ndarray:
    """Return the rows at `offsets` from each of `rows` within its piece, shape (offsets, rows)."""
    of = np.searchsorted(pieces.stop, rows, side="right")
    first, last = pieces.start[of], pieces.stop[of] - 1
    at = rows + offsets[:, None]
    if edge == "mirror":
        at = np.where(at < first, 2 * first - at, at)
        at = np.where(at > last, 2 * last - at, at)
    return np.clip(at, first, last)
