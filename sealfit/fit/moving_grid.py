"""Where the optima of many problems may lie, from inner products along a grid of u: see `moving`.

What the moving column explains beyond the base is the square of one smooth number, its pull. The global optimum is
beside a grid point where the pull turns back towards zero; all such points that could hold it are polished.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sealfit.fit.batch import DEPENDENT
from sealfit.fit.moving import Moving, Optimum, chosen, polish

ROUNDING = 1e-12  # of |y|^2: bound of the error of what is explained, where the moving column is all its own
BLOCK = 4096  # problems at once: numpy takes 1 us a call, and a block takes hundreds
TABLE = 500_000  # numbers in one table of moving columns: 4 MB, larger ones leave the cache


def common(values) -> np.ndarray:
    """Return one row where all rows are equal, else all of them; shape (1, n) or (problems, n)."""
    return values[:1] if values.strides[0] == 0 or np.all(values == values[0]) else values


@dataclass(frozen=True)
class Grid:
    """What the moving column explains along an even grid of u.

    Attributes
    ----------
    first : ndarray, shape (B,) or (1,)
        First u.
    step : float
    pull : ndarray, shape (B, g)
        Inner product of the rest with the moving column's direction beyond the base: its square is explained.
    share : ndarray, shape (B, g) or (1, g)
        Share of the moving column's square that is beyond the base.
    total : ndarray, shape (B,)
        Square of the measured values.
    inside : ndarray of bool, shape (B, g), or None where all are
        Grid points less than a step outside the limits of u.
    """

    first: np.ndarray
    step: float
    pull: np.ndarray
    share: np.ndarray
    total: np.ndarray
    inside: np.ndarray | None

    @cached_property
    def size(self) -> np.ndarray:
        """Size of the pull, -1 where u is out of its limits, shape (B, g)."""
        size = np.abs(self.pull)
        if self.inside is not None:
            size[~self.inside] = -1.0
        return size

    def error(self, rows, k) -> np.ndarray:
        """Bound of the rounding in the pull's square at grid points, shape (r,)."""
        share = self.share[0, k] if len(self.share) == 1 else self.share[rows, k]
        return ROUNDING * self.total[rows] / np.maximum(share, DEPENDENT)

    def peaks(self, enough):
        """Return the grid points beside which the optimum may lie.

        Parameters
        ----------
        enough : ndarray, shape (B,)
            A sum that the optimum explains for certain. A peak is left out that would not reach it were it four times
            as high above its grid point as a parabola of the bends there and at both neighbours can be.

        Returns
        -------
        rows, k : ndarray of int, shape (peaks,)
            Problem, rising, and grid point.
        """
        # a point where the pull turns back towards zero; size alone would miss one beside a change of sign
        positive = self.pull > 0
        up = self.pull[:, 1:] >= self.pull[:, :-1]
        peak = np.ones(positive.shape, bool)
        grows, falls = up == positive[:, 1:], up != positive[:, :-1]
        if self.inside is not None:
            grows |= ~self.inside[:, :-1]
            falls |= ~self.inside[:, 1:]
            peak &= self.inside
        peak[:, 1:] &= grows
        peak[:, :-1] &= falls
        rows, k = np.nonzero(peak)
        near = self._around(rows, k)
        bends = np.abs(near[:-2] - 2 * near[1:-1] + near[2:])
        highest = np.abs(near[2]) + bends.sum(axis=0) / 2
        could = highest**2 + self.error(rows, k) >= enough[rows]
        return rows[could], k[could]

    def vertex(self, rows, k) -> np.ndarray:
        """Return u of the peak of the quartic through five grid points, no more than a step from the middle one."""
        b, before, here, after, a = self._around(rows, k)
        # derivatives of the quartic at the middle point: Abramowitz and Stegun 1964, table 25.2
        first, third = (8 * (after - before) - (a - b)) / 12, (a - b) / 2 - (after - before)
        second, fourth = (16 * (after + before) - (a + b) - 30 * here) / 12, a + b - 4 * (after + before) + 6 * here
        with np.errstate(divide="ignore", invalid="ignore"):
            x = np.clip(-first / second, -1, 1)
            for _ in range(2):
                slope = first + x * (second + x * (third / 2 + x * fourth / 6))
                x = np.clip(x - slope / (second + x * (third + x * fourth / 2)), -1, 1)
        return chosen(self.first, rows) + self.step * (k + np.where(np.isfinite(x), x, 0.0))

    def _around(self, rows, k) -> np.ndarray:
        """The pull at grid points and two on either side, those past an end mirrored, shape (5, peaks)."""
        last = self.pull.shape[1] - 1
        at = np.abs(k + np.arange(-2, 3)[:, None])
        return self.pull[rows, last - np.abs(last - at)]


def polish_peaks(problems: Moving, grid: Grid, rows, k, base, beat=None) -> Optimum:
    """Polish peaks of the problems `rows` (None: one of each), each between the neighbouring grid points.

    `base` is what the fixed columns explain; `beat` as `polish`.
    """
    each = np.arange(len(k)) if rows is None else rows
    low, high = chosen(problems.low, rows), chosen(problems.high, rows)
    point = chosen(grid.first, rows) + grid.step * k
    centre = np.clip(point, low, high)
    known = grid.total[each] - chosen(base, rows) - grid.pull[each, k] ** 2 + grid.error(each, k)
    known = np.where(point == centre, known, np.inf)
    u = np.clip(grid.vertex(each, k), low, high)
    return polish(problems, rows, u, centre, grid.step, known=known, beat=beat)


def polish_best(problems: Moving, grid: Grid, base) -> Optimum:
    """Global optimum of every problem: its highest peak, and every other that could be higher."""
    top = np.argmax(grid.size, axis=1)
    best = polish_peaks(problems, grid, None, top, base)
    rows, k = grid.peaks(grid.total - base - best.rss)
    other = k != top[rows]
    if other.any():
        rows, k = rows[other], k[other]
        best.keep_better(rows, polish_peaks(problems, grid, rows, k, base, best.rss[rows]))
    return best
