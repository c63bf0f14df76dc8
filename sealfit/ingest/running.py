"""Running medians and means along every piece of a flat array, as scipy.ndimage has them along one trace."""

from __future__ import annotations

from functools import cache
from typing import Literal

import numpy as np

from sealfit.ingest.pieces import Pieces

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
