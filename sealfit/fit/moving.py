r"""Least squares on fixed columns and one that moves with a number u, for very many small problems at once.

.. math:: y = Q b + a \varphi(u)

with Q orthonormal. Given u, a and b are exact, so the sum of squares is a function of u alone (variable projection). Of
a grid over all u only inner products are wanted; the peaks of what the column explains there are then polished by
Newton steps with the exact second derivative. Arrays have points first and problems last, (n, B), so that every
operation runs along problems; what all problems share is (n, 1).

Golub and Pereyra 1973, SIAM J. Numer. Anal. 10(2), 413-432, doi:10.1137/0710036.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sealfit.fit.batch import DEPENDENT

CLOSE = 3e-7  # a Newton step this short leaves an error of its square; it is taken along the tangent, not evaluated
CLOSER, THIRD = 1e-5, 1e-11  # so is one this short where the bend times its cube is that share of the sum of squares
TURNS = 100  # halvings of a cell to the last digit take 50
SAME = 1e-13  # relative rise of the sum of squares that is rounding: the slope then knows better
FLAT = 1e-17  # share of the sum of squares: where all that u may still move promises no more, it is over
PROMISE = 10.0  # a valley that is a fourth power promises two thirds of what it holds, an exponential cliff half


def dot(a, b) -> np.ndarray:
    """Inner products over the points of (n, B) or (n, 1) arrays, shape (B,) or (1,)."""
    if a.shape[1] == 1:
        return a[:, 0] @ b
    return b[:, 0] @ a if b.shape[1] == 1 else np.einsum("nb,nb->b", a, b)


def chosen(values, rows) -> np.ndarray:
    """Return the problems `rows` of an array whose last axis are problems or is 1; None means all."""
    return values if rows is None or values.shape[-1] == 1 else values[..., rows]


@dataclass(frozen=True)
class Moving:
    """Problems of one kind.

    Attributes
    ----------
    column : callable
        `column(u, rows)` -> the weighted moving column and its first two derivatives along u, shape (n, r) each, for
        the problems `rows` (r,) (None: all) at u (r,).
    base : tuple of ndarray, shape (n, B) or (n, 1)
        Fixed weighted columns, orthonormal; a column of zeros is one that adds nothing.
    rest : ndarray, shape (n, B)
        Weighted measured values less their projection on the base.
    low, high : ndarray, shape (B,) or (1,)
        Limits of u.
    """

    column: Callable[[np.ndarray, np.ndarray | None], tuple[np.ndarray, np.ndarray, np.ndarray]]
    base: tuple[np.ndarray, ...]
    rest: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True)
class Optimum:
    """u, a, the base's inner products with the moving column and the sum of squares, each problem; all float."""

    u: np.ndarray  # (B,)
    a: np.ndarray  # (B,)
    inner: np.ndarray  # (base columns, B)
    rss: np.ndarray  # (B,)

    @classmethod
    def unknown(cls, problems: int, columns: int) -> Optimum:
        """Return room for optima, each with an infinite sum of squares."""
        empty = np.zeros((columns + 2, problems))
        return cls(empty[0], empty[1], empty[2:], np.full(problems, np.inf))

    def put(self, at, other: Optimum, which=slice(None)) -> None:
        """Write the optima `which` of another over those `at`."""
        self.u[at], self.a[at], self.rss[at] = other.u[which], other.a[which], other.rss[which]
        self.inner[:, at] = other.inner[:, which]

    def keep_better(self, rows, other: Optimum) -> None:
        """Take the optima of another, of the problems `rows` (repeats allowed), where they are better."""
        order = np.argsort(-other.rss, kind="stable")  # of several for one problem the best is written last
        order = order[other.rss[order] < self.rss[rows[order]]]
        self.put(rows[order], other, order)


@dataclass(frozen=True)
class _Turn:
    """One evaluation: values at u, half the slope and half the curvature of the rss, and how a and inner move."""

    a: np.ndarray
    inner: np.ndarray
    rss: np.ndarray
    slope: np.ndarray
    curvature: np.ndarray
    a_slope: np.ndarray
    inner_slope: np.ndarray


def _evaluate(problems: Moving, u, rows) -> _Turn:
    phi, first, second = problems.column(u, rows)
    base = [chosen(q, rows) for q in problems.base]
    rest = chosen(problems.rest, rows)
    inner = np.array([dot(q, phi) for q in base]).reshape(len(base), u.size)
    inner_slope = np.array([dot(q, first) for q in base]).reshape(len(base), u.size)
    size = dot(phi, phi)
    for q, along in zip(base, inner, strict=True):
        phi = phi - q * along
    left = dot(phi, phi)
    sound = left > DEPENDENT * size
    left = np.where(sound, left, 1.0)
    a = np.where(sound, dot(rest, phi) / left, 0.0)
    cross = dot(phi, first)
    phi *= a
    rest = rest - phi
    pull = dot(rest, first)
    a_slope = np.where(sound, (pull - a * cross) / left, 0.0)
    # the Hessian over u and all coefficients, the coefficients eliminated
    curvature = a**2 * (dot(first, first) - (inner_slope**2).sum(axis=0)) - a * dot(rest, second) - left * a_slope**2
    return _Turn(a, inner, dot(rest, rest), -a * pull, curvature, a_slope, inner_slope)


def polish(problems: Moving, rows, u, centre, reach: float, *, known=np.inf, beat=None) -> Optimum:
    """Local minimum of the sum of squares, of the problems `rows` (None: all).

    Newton steps from the best point so far, which only ever gets better. Points that were worse, and the limits of u,
    bracket it; where a step leaves the bracket its end is tried, and where that is known the middle.

    Parameters
    ----------
    problems : Moving
    rows : ndarray of int, shape (r,), or None
    u, centre : ndarray, shape (r,)
        A guess, and a point that is known already, both within the limits.
    reach : float
        Longest step.
    known : ndarray, shape (r,)
        Sum of squares at the centre: where the guess is worse, the centre is next.
    beat : ndarray, shape (r,), optional
        A sum of squares that is reached elsewhere: a problem that will not reach it, were there `PROMISE` times to gain
        what the next step promises, is given up, with an infinite sum of squares.
    """
    best = Optimum.unknown(u.size, len(problems.base))
    low, high = chosen(problems.low, rows), chosen(problems.high, rows)
    # rows of the state: next u; best u, its rss, half its slope and curvature; bracket; whether its ends are evaluated
    state = np.empty((9, u.size))
    state[0], state[1], state[2], state[3:5], state[5], state[6], state[7:] = u, centre, known, np.nan, low, high, 0.0
    todo = np.arange(u.size)
    for _ in range(TURNS):
        if not todo.size:
            break
        u, at, rss, slope, curvature, low, high, low_seen, high_seen = state
        everyone = todo.size == best.u.size
        turn = _evaluate(problems, u, rows if everyone else todo if rows is None else rows[todo])
        better = (turn.rss <= rss * (1 + SAME)) | (u == at)
        right = np.where(better, turn.slope > 0, u > at)  # the new point is the bracket's right end
        high, high_seen = np.where(right, u, high), np.where(right, 1.0, high_seen)
        low, low_seen = np.where(right, low, u), np.where(right, low_seen, 1.0)
        at, rss = np.where(better, u, at), np.where(better, turn.rss, rss)
        slope, curvature = np.where(better, turn.slope, slope), np.where(better, turn.curvature, curvature)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.where(curvature > 0, -slope / curvature, np.nan)
        end, seen = np.where(slope > 0, low, high), np.where(slope > 0, low_seen, high_seen) > 0
        goal = at + step
        goal = np.where((goal > low) & (goal < high), goal, np.where(seen | np.isnan(step), (at + end) / 2, end))
        goal = np.where(np.isnan(slope), at, np.clip(goal, at - reach, at + reach))
        length = np.abs(step)
        short = better & ((length < CLOSE) | ((length < CLOSER) & (curvature * length**3 <= THIRD * rss)))
        done = short | (better & (np.abs(slope) * (high - low) <= FLAT * rss))
        done |= (high - low <= 1e-14 * np.maximum(1.0, np.abs(u))) | ((goal == u) & better)
        if beat is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                lost = better & (curvature > 0) & (rss - PROMISE * slope**2 / curvature > beat[todo])
            turn.rss[lost] = np.inf
            done |= lost
        if done.any():
            move = np.where(short, np.clip(u + step, low, high) - u, 0.0)
            found = Optimum(
                u + move,
                turn.a + turn.a_slope * move,
                turn.inner + turn.inner_slope * move,
                turn.rss + (2 * turn.slope + turn.curvature * move) * move,
            )
            best.put(todo[done], found, done)
        state = np.stack([goal, at, rss, slope, curvature, low, high, low_seen, high_seen])
        if done.any():
            todo, state = todo[~done], state[:, ~done]
    return best
