"""Least squares with one nonlinear number each, for thousands of small problems at once as arrays.

The linear coefficients are exact once the nonlinear number is given; that number is searched on a grid, then polished.
Golub and Pereyra 1973, SIAM J. Numer. Anal. 10(2), 413-432, doi:10.1137/0710036 (variable projection).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from sealfit.errors import FitError

DEPENDENT = 1e-13  # share of a column's variance left by the others below which it adds nothing in double precision
CHUNK = 2_000_000  # numbers per temporary array: 16 MB, stays near the cache and never fills a laptop
MINIMA = 3  # local minima of the grid that are polished; more have never been seen in Eq. 14 or Eq. 15
TURNS = 80


# ---------------------------------------------------------------- the linear part
def solve_kept(gram, moment, keep):
    """Coefficients of the kept columns, the rest zero; gram (..., p, p) with unit diagonal, moment and keep (..., p).

    Cholesky written out over the few columns, so that all problems go together; a dependent column gets zero.
    """
    p = moment.shape[-1]
    lower = [[None] * p for _ in range(p)]
    inverse, z = [None] * p, [None] * p
    for j in range(p):
        left = gram[..., j, j] - sum((lower[j][k] ** 2 for k in range(j)), 0.0)
        good = keep[..., j] & (left > DEPENDENT)
        inverse[j] = np.where(good, 1 / np.sqrt(np.where(good, left, 1.0)), 0.0)
        for i in range(j + 1, p):
            cross = gram[..., i, j] - sum((lower[i][k] * lower[j][k] for k in range(j)), 0.0)
            lower[i][j] = cross * inverse[j]
        z[j] = (moment[..., j] - sum((lower[j][k] * z[k] for k in range(j)), 0.0)) * inverse[j]
    solution = [None] * p
    for j in reversed(range(p)):
        solution[j] = (z[j] - sum((lower[i][j] * solution[i] for i in range(j + 1, p)), 0.0)) * inverse[j]
    return np.stack(solution, axis=-1)


def least_squares_of(gram, moment, nonnegative: Sequence[bool]):
    """Exact least squares with some coefficients held at or above zero, by trying every set of zeros.

    Parameters
    ----------
    gram : ndarray, shape (..., p, p)
        B'B of the columns, scaled to unit diagonal (a column of zeros may keep 0).
    moment : ndarray, shape (..., p)
        B'y.
    nonnegative : sequence of bool, length p
        Which coefficients must not be negative.

    Returns
    -------
    coefficients, support : ndarray, shape (..., p)
        The optimum, and which columns are in it. Convex, so the best feasible set is the global optimum.
    """
    nonnegative = np.asarray(nonnegative, bool)
    keep = np.ones(moment.shape, bool)
    coefficients = solve_kept(gram, moment, keep)
    bad = np.any((coefficients < 0) & nonnegative, axis=-1)
    if not bad.any():
        return coefficients, keep
    g, m = gram[bad], moment[bad]
    best, support = np.zeros_like(m), np.zeros(m.shape, bool)
    explained = np.full(m.shape[:-1], -np.inf)
    held = np.flatnonzero(nonnegative)
    for zeros in product((False, True), repeat=held.size):
        subset = np.ones(m.shape[-1], bool)
        subset[held] = ~np.array(zeros)
        tried = solve_kept(g, m, np.broadcast_to(subset, m.shape))
        gain = np.einsum("...p,...p", tried, m)
        better = ~np.any((tried < 0) & nonnegative, axis=-1) & (gain > explained)
        best[better], support[better], explained[better] = tried[better], subset, gain[better]
    coefficients[bad], keep[bad] = best, support
    return coefficients, keep


@dataclass(frozen=True)
class Point:
    """The linear optimum at given nonlinear numbers: leading shape (...), and the slope of the rss along them."""

    coefficients: np.ndarray
    support: np.ndarray
    residual: np.ndarray
    rss: np.ndarray


def project(columns, y, nonnegative, refine: int = 2) -> Point:
    """Solve for the coefficients of weighted columns (..., n, p) and y (..., n)."""
    norm = np.sqrt(np.einsum("...np,...np->...p", columns, columns))
    scaled = columns / np.where(norm > 0, norm, 1.0)[..., None, :]
    transposed = np.swapaxes(scaled, -1, -2)
    gram = transposed @ scaled
    moment = (transposed @ y[..., None])[..., 0]
    c, support = least_squares_of(gram, moment, nonnegative)
    rest = y - (scaled @ c[..., None])[..., 0]
    for _ in range(refine):  # normal equations square the condition number; refining on the true residual undoes it
        c = c + solve_kept(gram, (transposed @ rest[..., None])[..., 0], support)
        rest = y - (scaled @ c[..., None])[..., 0]
    c = np.where(nonnegative, np.maximum(c, 0.0), c)
    return Point(c / np.where(norm > 0, norm, 1.0), support, rest, np.einsum("...n,...n->...", rest, rest))


# ---------------------------------------------------------------- one nonlinear number, many problems
@dataclass(frozen=True)
class BatchFit:
    """Optimum of each problem; u is what the basis takes, as a rule the logarithm of the nonlinear number."""

    u: np.ndarray  # (problems,)
    coefficients: np.ndarray  # (problems, p)
    rss: np.ndarray  # (problems,), weighted
    at_edge: np.ndarray  # (problems,), -1 at the lower end of the grid, +1 at the upper, else 0


Basis = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def profile(basis: Basis, y, weight, u, nonnegative, *, refine: int = 0):
    """Best weighted sum of squares, its slope and the coefficients at given nonlinear numbers.

    Parameters
    ----------
    basis : callable
        `basis(u, rows)` -> columns and their derivatives along u, each shape (r, g, n, p), for the problems `rows`,
        shape (r,), at u, shape (r, g).
    y, weight : ndarray, shape (problems, n)
        Measured values and 1/variance; weight 0 for padding.
    u : ndarray, shape (problems, g)
        Where.
    nonnegative : sequence of bool, length p
        Coefficients held at or above zero.
    refine : int
        Steps of iterative refinement; 0 is enough for a search, 2 gives all digits.

    Returns
    -------
    rss, slope : ndarray, shape (problems, g)
    coefficients : ndarray, shape (problems, g, p)
    """
    return _profile(basis, y, np.sqrt(weight), u, nonnegative, np.arange(len(y)), refine)


def _profile(basis, y, root, u, nonnegative, rows, refine):
    p = len(nonnegative)
    rss, slope = np.empty(u.shape), np.empty(u.shape)
    coefficients = np.empty((*u.shape, p))
    step = max(1, CHUNK // max(1, u.shape[1] * y.shape[1] * p))
    for start in range(0, len(u), step):
        part = slice(start, start + step)
        chosen = rows[part]
        weights = root[chosen][:, None, :, None]
        columns, slopes = basis(u[part], chosen)
        measured = np.broadcast_to((y[chosen] * root[chosen])[:, None, :], columns.shape[:-1])
        point = project(columns * weights, measured, nonnegative, refine)
        # the optimum over the coefficients does not move to first order, so only the columns' own change counts
        change = ((slopes * weights) @ point.coefficients[..., None])[..., 0]
        rss[part], coefficients[part] = point.rss, point.coefficients
        slope[part] = -2 * np.einsum("rgn,rgn->rg", point.residual, change)
    return rss, slope, coefficients


def solve_batch(basis: Basis, y, weight, grid, nonnegative) -> BatchFit:
    """Global optimum of many small problems, each linear once its one nonlinear number u is given.

    The grid finds the basin, a bracketed secant on the slope then finds u to about 1e-12 (in log u, relative). The best
    `MINIMA` local minima of the grid are all polished, so two that are nearly equal are not confused.

    Parameters
    ----------
    basis, y, weight, nonnegative
        As `profile`.
    grid : ndarray, shape (problems, g)
        Rising values of u that cover every basin.

    Raises
    ------
    FitError
        If a measured value or a weight is not finite, or a weight is negative.

    Examples
    --------
    Two decays, y = c exp(-t / tau), with u = ln tau:

    >>> t = np.array([[0.0, 1.0, 2.0, 4.0]])
    >>> def basis(u, rows):
    ...     x = t[rows][:, None, :] / np.exp(u)[..., None]
    ...     return np.exp(-x)[..., None], (x * np.exp(-x))[..., None]
    >>> grid = np.linspace(-3, 3, 40)[None, :]
    >>> fit = solve_batch(basis, 5 * np.exp(-t / 1.7), np.ones((1, 4)), grid, (True,))
    >>> round(float(np.exp(fit.u[0])), 10), round(float(fit.coefficients[0, 0]), 10)
    (1.7, 5.0)
    """
    y, weight, grid = (np.asarray(a, float) for a in (y, weight, grid))
    if not (np.all(np.isfinite(y)) and np.all(np.isfinite(weight)) and np.all(weight >= 0)):
        raise FitError(
            "measured values and weights must be finite, weights not negative.", mend="Look for empty cells."
        )
    root = np.sqrt(weight)
    everyone = np.arange(len(y))
    rss, slope, _ = _profile(basis, y, root, grid, nonnegative, everyone, 0)
    last = grid.shape[1] - 1
    padded = np.pad(rss, ((0, 0), (1, 1)), constant_values=np.inf)
    minimum = (rss <= padded[:, :-2]) & (rss <= padded[:, 2:])
    ranked = np.argsort(np.where(minimum, rss, np.inf), axis=1, kind="stable")[:, : min(MINIMA, last + 1)]
    rows = np.repeat(everyone, ranked.shape[1])
    k = ranked.ravel()
    real = minimum[rows, k]
    rows, k = rows[real], k[real]
    rising = slope[rows, k] > 0
    neighbour = np.clip(np.where(rising, k - 1, k + 1), 0, last)
    at_k, at_neighbour = grid[rows, k], grid[rows, neighbour]
    u = _root(basis, y, root, nonnegative, rows, at_k, at_neighbour, slope[rows, k], slope[rows, neighbour])
    both = np.stack([u, at_k], axis=1)
    rss_both, _, c_both = _profile(basis, y, root, both, nonnegative, rows, 2)
    # the polished point, unless the grid's own point is better by more than rounding
    pick = (rss_both[:, 1] < rss_both[:, 0] * (1 - 1e-12)).astype(int)
    each = np.arange(len(rows))
    value, u, c = rss_both[each, pick], both[each, pick], c_both[each, pick]
    order = np.lexsort((value, rows))
    first = order[np.searchsorted(rows[order], everyone)]
    u, value, c = u[first], value[first], c[first]
    at_edge = np.where(u <= grid[:, 0], -1, np.where(u >= grid[:, -1], 1, 0))
    return BatchFit(u, c, value, at_edge)


def _root(basis, y, root, nonnegative, rows, near, far, slope_near, slope_far):
    """Zero of the slope between two grid points, all problems at once: secant steps inside a bracket (Illinois).

    Where both ends slope alike (a bump inside one cell) the signs still steer to a minimum or to an end; the caller
    compares the result with the grid's point and keeps the better.
    """
    low, high = np.minimum(near, far), np.maximum(near, far)
    is_low = near <= far
    at_low, at_high = np.where(is_low, slope_near, slope_far), np.where(is_low, slope_far, slope_near)
    at_low, at_high = -np.abs(at_low), np.abs(at_high)
    best = near.copy()
    todo = np.flatnonzero((low < high) & (slope_near != 0))
    for turn in range(TURNS):
        if not todo.size:
            break
        a, b, fa, fb = low[todo], high[todo], at_low[todo], at_high[todo]
        with np.errstate(divide="ignore", invalid="ignore"):
            secant = (a * fb - b * fa) / (fb - fa)
        middle = (a + b) / 2
        inside = np.isfinite(secant) & (secant > a) & (secant < b)
        u = np.where(inside & (turn % 4 != 3), secant, middle)  # a halving now and then bounds the number of turns
        _, f, _ = _profile(basis, y, root, u[:, None], nonnegative, rows[todo], 1)
        f = f[:, 0]
        rising = f > 0
        done = (f == 0) | (b - a < 4e-14 * np.maximum(1.0, np.abs(u))) | (np.abs(u - best[todo]) < 1e-14)
        best[todo] = u
        # Illinois: halve the kept end's value so that it does not stay for ever
        low[todo], at_low[todo] = np.where(rising, a, u), np.where(rising, fa / 2, f)
        high[todo], at_high[todo] = np.where(rising, u, b), np.where(rising, f, fb / 2)
        todo = todo[~done]
    return best
