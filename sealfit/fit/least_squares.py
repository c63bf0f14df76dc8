"""Nonlinear least squares by Levenberg-Marquardt, of one or many small problems at once, and its covariance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

STEPS = 2000
SAME = 1e-13  # relative change of the sum of squares that is rounding
SHRINKS = 0.9  # from one step to the next where they converge: the sum of squares is flat at its minimum
DAMPING = 1e-3  # to begin with; below it a step is one of Gauss and Newton
STUCK = 1e12  # damping above which there is no way down
RANK = 1e-11  # singular values this small against the largest, columns scaled to length 1, are zero


def levenberg_marquardt(
    evaluate: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    *,
    damping: float = DAMPING,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least-squares optima that the starts lead to, and their sums of squares.

    Parameters
    ----------
    evaluate : callable
        `evaluate(x, rows)` -> weighted residual, shape (r, n), and its derivative, shape (r, p, n), of the problems
        `rows` (r,) at x (r, p).
    start : ndarray, shape (problems, p)
        Starting points; moved inside the bounds.
    low, high : ndarray, shape (p,) or (problems, p)
        Closed bounds; infinite where there is none, equal where a number is held.
    damping : float
        Of the first step; next to none from starts that are nearly there.

    Returns
    -------
    x : ndarray, shape (problems, p)
    rss : ndarray, shape (problems,)
        Infinite where the residual is not finite at the start.

    Notes
    -----
    The scale of each number is the largest norm that its column has had (More 1978, Lecture Notes in Mathematics 630,
    105-116), and the damped step is solved for by singular values, which keeps the digits that normal equations lose.
    """
    low, high = np.broadcast_to(low, start.shape), np.broadcast_to(high, start.shape)
    x, todo = np.clip(start, low, high), np.arange(len(start))
    damping = np.full(len(x), damping)
    length = np.full(len(x), np.inf)  # of the last step, in standard errors
    scale = np.zeros(x.shape)
    with np.errstate(all="ignore"):  # a trial step that overflows is a bad step, not an error
        rest, slope = evaluate(x, todo)
        rss = _squares(rest)
        todo = np.flatnonzero(np.isfinite(rss))
        for _ in range(STEPS):
            if not todo.size:
                break
            at, size = x[todo], np.linalg.norm(slope[todo], axis=2)
            scale[todo] = np.maximum(scale[todo], size)
            pull = -(slope[todo] @ rest[todo, :, None])[..., 0]
            free = ~((at <= low[todo]) & (pull <= 0)) & ~((at >= high[todo]) & (pull >= 0))
            own_scale = np.where(scale[todo] > 0, scale[todo], 1.0)
            move = _damped(slope[todo] / own_scale[..., None] * free[..., None], rest[todo], damping[todo]) / own_scale
            trial = np.clip(at + move, low[todo], high[todo])
            left, bends = evaluate(trial, todo)
            gain, step = rss[todo] - _squares(left), np.linalg.norm((trial - at) * size, axis=1)
            same, shrinks = np.abs(gain) <= SAME * rss[todo], step < SHRINKS * length[todo]
            better = (gain > 0) | (same & shrinks)
            done = same & ~(shrinks & (step > 0)) & ((damping[todo] < DAMPING) | ~better)
            moved = todo[better]
            x[moved], rest[moved], slope[moved], length[moved] = (
                trial[better],
                left[better],
                bends[better],
                step[better],
            )
            rss[moved] -= gain[better]
            damping[todo] = np.where(better, damping[todo] / 10, np.maximum(damping[todo], 1e-12) * 10)
            todo = todo[~done & (damping[todo] < STUCK)]
    return x, rss


def _damped(slope: np.ndarray, rest: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return the x that minimise |x slope + rest|^2 + damping |x|^2, shape (r, p); slope (r, p, n), rest (r, n)."""
    axes, singular, rows = np.linalg.svd(slope, full_matrices=False)
    share = np.where(singular > 0, singular / (singular**2 + damping[:, None]), 0.0)
    return -(axes @ (share * (rows @ rest[..., None])[..., 0])[..., None])[..., 0]


def _squares(rest: np.ndarray) -> np.ndarray:
    squares = (rest**2).sum(axis=-1)
    return np.where(np.isfinite(squares), squares, np.inf)


def central_jacobian(residual: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """Return the derivative of `residual` at `x`, shape (n, p), by central differences of fourth order.

    The step is 1e-4 of each parameter: rounding stays near 1e-12 of the derivative, and a place parameter that is a
    hundred widths from its origin (a peak at 450 nm, 4 nm wide) still moves by a hundredth of its width only.

    Parameters
    ----------
    residual : callable
        (p,) -> (n,).
    x : ndarray, shape (p,)
        Where.
    """
    h = 1e-4 * np.where(x == 0, 1.0, np.abs(x))
    points = x + np.array([-2, -1, 1, 2])[:, None, None] * np.diag(h)
    below2, below, above, above2 = np.array([[residual(point) for point in side] for side in points])
    return ((below2 - 8 * below + 8 * above - above2) / (12 * h[:, None])).T


def covariance_of(jacobian: np.ndarray, free: np.ndarray | None = None) -> tuple[np.ndarray, int]:
    """Return (J'J)^-1, shape (p, p), and its rank; inf on the diagonal of what the tangent does not determine.

    Parameters
    ----------
    jacobian : ndarray, shape (n, p)
        Tangent of the weighted residual.
    free : ndarray of bool, shape (p,), optional
        Parameters that are fitted; the others get zeros.
    """
    p = jacobian.shape[1]
    free = np.ones(p, bool) if free is None else free
    covariance = np.zeros((p, p))
    if not free.any():
        return covariance, 0
    scale = np.linalg.norm(jacobian[:, free], axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    wide = jacobian.shape[0] < scale.size  # then only the full decomposition has the null directions; else no one asks
    _, singular, rows = np.linalg.svd(jacobian[:, free] / scale, full_matrices=wide)
    known = np.zeros(rows.shape[0], bool)
    known[: singular.size] = singular > RANK * max(singular.max(initial=0.0), 1e-300)
    inverse = (rows[known].T / singular[known[: singular.size]] ** 2) @ rows[known]
    part = inverse / np.outer(scale, scale)
    lost = np.any(np.abs(rows[~known]) > 1e-6, axis=0)  # parameters that a null direction moves
    part[lost, :], part[:, lost] = 0.0, 0.0
    part[lost, lost] = np.inf
    covariance[np.ix_(free, free)] = part
    return covariance, int(known.sum())
