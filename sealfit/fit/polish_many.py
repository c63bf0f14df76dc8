"""Nonlinear least squares from one starting point each, of many small problems at once, with bounds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

STEPS = 200
SAME = 1e-13  # relative change of the sum of squares that is rounding
SHRINKS = 0.9  # from one step to the next where they converge: the sum of squares is flat at its minimum
FREE, STUCK = 1e-3, 1e9  # damping below which a step is one of Gauss and Newton; above which there is no way down
RIDGE = 1e-13  # of the scaled normal matrix: what the values do not tell stays where it is


def polish_many(
    evaluate: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least-squares optima that the starts lead to, and their sums of squares.

    By steps of Levenberg and Marquardt, which near the optimum are those of Gauss and Newton.

    Parameters
    ----------
    evaluate : callable
        `evaluate(x, rows)` -> weighted residual, shape (r, n), and its derivative, shape (r, p, n), of the problems
        `rows` (r,) at x (r, p).
    start : ndarray, shape (problems, p)
        Starting points; moved inside the bounds.
    low, high : ndarray, shape (p,) or (problems, p)
        Closed bounds; infinite where there is none, equal where a number is held.

    Returns
    -------
    x : ndarray, shape (problems, p)
    rss : ndarray, shape (problems,)
        Infinite where the residual is not finite at the start.
    """
    low, high = np.broadcast_to(low, start.shape), np.broadcast_to(high, start.shape)
    x, todo = np.clip(start, low, high), np.arange(len(start))
    damping, length = np.full(len(x), 1e-6), np.full(len(x), np.inf)  # of the last step, in standard errors
    with np.errstate(all="ignore"):  # a trial step that overflows is a bad step, not an error
        rest, slope = evaluate(x, todo)
        rss = _squares(rest)
        todo = np.flatnonzero(np.isfinite(rss))
        for _ in range(STEPS):
            if not todo.size:
                break
            at = x[todo]
            pull = -(slope[todo] @ rest[todo, :, None])[..., 0]
            normal = slope[todo] @ np.swapaxes(slope[todo], 1, 2)
            free = ~((at <= low[todo]) & (pull <= 0)) & ~((at >= high[todo]) & (pull >= 0))
            size = np.sqrt(np.maximum(np.einsum("kpp->kp", normal), 1e-300))
            scaled = normal / (size[:, :, None] * size[:, None, :]) * (free[:, :, None] & free[:, None, :])
            scaled += np.where(free, damping[todo, None] + RIDGE, 1.0)[..., None] * np.eye(at.shape[1])
            move = np.linalg.solve(scaled, np.where(free, pull / size, 0.0)[..., None])[..., 0] / size
            trial = np.clip(at + move, low[todo], high[todo])
            left, bends = evaluate(trial, todo)
            gain, step = rss[todo] - _squares(left), np.linalg.norm((trial - at) * size, axis=1)
            same, shrinks = np.abs(gain) <= SAME * rss[todo], step < SHRINKS * length[todo]
            better = (gain > 0) | (same & shrinks)
            done = same & ~(shrinks & (step > 0)) & ((damping[todo] < FREE) | ~better)
            moved = todo[better]
            x[moved], rest[moved], slope[moved], length[moved] = (
                trial[better],
                left[better],
                bends[better],
                step[better],
            )
            rss[moved] -= gain[better]
            damping[todo] = np.where(better, damping[todo] / 10, np.maximum(damping[todo], 1e-4) * 10)
            todo = todo[~done & (damping[todo] < STUCK)]
    return x, rss


def _squares(rest: np.ndarray) -> np.ndarray:
    squares = (rest**2).sum(axis=-1)
    return np.where(np.isfinite(squares), squares, np.inf)
