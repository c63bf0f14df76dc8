"""Where the optima of many problems may lie, from inner products along a grid of u: see `moving`.

What the moving column explains beyond the base is the square of one smooth number, its pull. The global optimum is
beside a grid point where the pull turns back towards zero; all such points that could hold it are polished.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sealfit.fit.batch import DEPENDENT
from sealfit.fit.moving import Moving, Optimum, chosen, polish

ROUNDING = 1e-12  # of |y|^2: bound of the error of what is explained, where the moving column is all its own
LONGER = 1.2  # way of a direction from one grid point to the next over the angle between both
RESOLVED = 0.6  # radians from one grid point to the next beyond which the grid does not tell how far a direction turns
LEAST_ANGLE = 1e-5  # radians: rounding of an angle that is nearly none
TINY = 1e-300
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
    ways : ndarray, shape (n, g), or None
        The moving column's direction beyond the base, where all problems share it.
    """

    first: np.ndarray
    step: float
    pull: np.ndarray
    share: np.ndarray
    total: np.ndarray
    inside: np.ndarray | None
    ways: np.ndarray | None = None

    def top(self) -> np.ndarray:
        """Return the grid point of the greatest pull either way, each problem, shape (B,)."""
        if self.inside is not None:
            return np.argmax(np.where(self.inside, np.abs(self.pull), -1.0), axis=1)
        most, least = np.argmax(self.pull, axis=1), np.argmin(self.pull, axis=1)
        every = np.arange(len(most))
        return np.where(self.pull[every, most] >= -self.pull[every, least], most, least)

    def error(self, rows, k) -> np.ndarray:
        """Bound of the rounding in the pull's square at grid points, shape (r,)."""
        share = self.share[0, k] if len(self.share) == 1 else self.share[rows, k]
        return ROUNDING * self.total[rows] / np.maximum(share, DEPENDENT)

    def peaks(self, enough, top=None):
        """Return the grid points beside which the optimum may lie.

        Parameters
        ----------
        enough : ndarray, shape (B,)
            A sum that the optimum explains for certain. A peak is left out that would not reach it were it four times
            as high above its grid point as a parabola of the bends there and at both neighbours can be.
        top : ndarray of int, shape (B,), optional
            Grid points that are known already.

        Returns
        -------
        rows, k : ndarray of int, shape (peaks,)
            Problem, rising, and grid point.
        """
        # a point where the pull turns back towards zero; size alone would miss one beside a change of sign
        points = self.pull.shape[1]
        flat = self.pull.ravel()  # end to end: numpy is five times as quick as with slices of rows
        positive, up = flat > 0, np.append(flat[1:] >= flat[:-1], False)
        falls = (up != positive).reshape(-1, points)
        grows = np.append(False, up[:-1] == positive[1:]).reshape(-1, points)
        grows[:, 0] = falls[:, -1] = True
        if self.inside is not None:
            grows[:, 1:] |= ~self.inside[:, :-1]
            falls[:, :-1] |= ~self.inside[:, 1:]
        peak = grows & falls if self.inside is None else grows & falls & self.inside
        if top is not None:
            peak[np.arange(len(top)), top] = False
        rows, k = np.divmod(np.flatnonzero(peak), points)
        near = self._around(rows, k, 2)
        bends = np.abs(near[:-2] - 2 * near[1:-1] + near[2:])
        needed = np.sqrt(np.maximum(enough[rows] - self.error(rows, k), 0.0))
        could = np.abs(near[2]) + bends.sum(axis=0) / 2 >= needed
        return rows[could], k[could]

    def reachable(self, rows, k, top, rest, enough) -> np.ndarray:
        """Return whether a peak could explain more than is known: an optimum is as near to the measured values.

        What a direction explains says its angle to them. Two directions that both explain enough are no farther apart
        than both angles together.

        Parameters
        ----------
        rows, k : ndarray of int, shape (peaks,)
        top : ndarray of int, shape (B,)
            Grid point that explains most.
        rest, enough : ndarray, shape (B,)
            Square of the measured values beyond the base, and what is known to be explained of it.
        """
        whole = np.sqrt(np.maximum(rest, 0.0)) + TINY
        known = np.sqrt(np.maximum(enough, 0.0)) / whole
        own = np.abs(self.pull[np.arange(len(top)), top]) / whole
        angles = np.arccos(np.minimum(known, 1.0)) + np.arccos(np.minimum(own, 1.0)) + LEAST_ANGLE
        return _apart(self.ways)[top[rows], k] <= angles[rows]

    def vertex(self, rows, k) -> np.ndarray:
        """Return u of the peak of the polynomial through nine grid points, no more than a step from the middle one."""
        return chosen(self.first, rows) + self.step * (k + _turn(_polynomial(self._around(rows, k, 4)), 1))

    def _around(self, rows, k, far: int) -> np.ndarray:
        """The pull at grid points and `far` on either side, past an end mirrored, shape (2 far + 1, peaks)."""
        points = self.pull.shape[1]
        at = np.abs(k + np.arange(-far, far + 1)[:, None])
        return self.pull.ravel()[rows * points + np.abs(points - 1 - np.abs(points - 1 - at))]


def _apart(ways) -> np.ndarray:
    """Return how near the direction at each grid point and those beside another can be, in radians, shape (g, g).

    From one grid point to the next a direction turns by no more than `LONGER` times the angle between both.
    """
    angle = np.arccos(np.minimum(np.abs(ways.T @ ways), 1.0))
    turn = LONGER * np.diagonal(angle, 1)
    turn = np.where(turn > RESOLVED, np.pi, turn)
    least = np.full((len(angle), len(angle) + 1), np.inf)
    least[:, 1:-1] = (angle[:, 1:] + angle[:, :-1] - turn) / 2
    return np.minimum(least[:, 1:], least[:, :-1])


def _polynomial(near) -> np.ndarray:
    """Return the coefficients, lowest first, of the polynomial through values at even steps about 0, (points, r)."""
    far = len(near) // 2
    return np.linalg.inv(np.vander(np.arange(-far, far + 1.0), increasing=True)) @ near


def _value(numbers, x) -> np.ndarray:
    found = numbers[-1]
    for number in numbers[-2::-1]:
        found = found * x + number
    return found


def _turn(numbers, steps: int) -> np.ndarray:
    """Return where polynomials turn near 0, at most 1 from it, by Newton's steps after the parabola's, shape (r,)."""
    powers = np.arange(1, len(numbers))[:, None]
    first = numbers[1:] * powers
    second = first[1:] * powers[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        x = np.clip(-first[0] / second[0], -1, 1)
        for _ in range(steps):
            x = np.clip(x - _value(first, x) / _value(second, x), -1, 1)
    return np.where(np.isfinite(x), x, 0.0)


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
    top = grid.top()
    best = polish_peaks(problems, grid, None, top, base)
    rest = grid.total - base
    rows, k = grid.peaks(rest - best.rss, top)
    if grid.ways is not None:
        could = grid.reachable(rows, k, top, rest, rest - best.rss)
        rows, k = rows[could], k[could]
    if rows.size:
        best.keep_better(rows, polish_peaks(problems, grid, rows, k, base, best.rss[rows]))
    return best
