"""Nonlinear least squares: Levenberg-Marquardt for one or many small problems, and variable projection."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize.elementwise import find_minimum

from sealfit.errors import FitError

# ---------------------------------------------------------------- least squares
# Nonlinear least squares by Levenberg-Marquardt, of one or many small problems at once, and its covariance.

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


# ---------------------------------------------------------------- variable projection
# Least squares that is linear in all but one number: the linear part is solved exactly along the nonlinear one.
#
# Many problems are solved together, as arrays: the conditions of a campaign, or the draws of a bootstrap.
# Golub and Pereyra 1973, SIAM J. Numer. Anal. 10(2), 413-432, doi:10.1137/0710036 (variable projection).

DEPENDENT = 1e-13  # share of a column's variance left by the others below which it adds nothing in double precision
CHUNK = 2_000_000  # numbers per temporary array: 16 MB
CLOSE = 1e-9  # of the nonlinear number, a logarithm as a rule: nearer, the sum of squares is flat to its last digit
MOST_STEPS = 60
NEXT_TO_NONE = 1e-15  # damping of steps from where the minimum is already known to half its digits
NUDGES = 1e-3 * np.array([-2, -1, 0, 1, 2])  # of the nonlinear number: a derivative of fourth order


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


def project(columns, y, nonnegative, refine: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return the coefficients, shape (..., p), of weighted columns (..., n, p) and y (..., n), and the rss, (...)."""
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
    return c / np.where(norm > 0, norm, 1.0), np.einsum("...n,...n->...", rest, rest)


# ---------------------------------------------------------------- one nonlinear number, many problems
@dataclass(frozen=True)
class BatchFit:
    """Optimum of each problem; u is what the basis takes, as a rule the logarithm of the nonlinear number."""

    u: np.ndarray  # (problems,)
    coefficients: np.ndarray  # (problems, p)
    rss: np.ndarray  # (problems,), weighted


@dataclass(frozen=True)
class Separable:
    """Least-squares problems that are linear in all but one number each.

    Attributes
    ----------
    basis : callable
        `basis(u, rows)` -> columns, shape (r, g, n, p), for the problems `rows`, shape (r,), at u, shape (r, g).
    y, weight : ndarray, shape (problems, n)
        Measured values and 1/variance; weight 0 for padding.
    nonnegative : sequence of bool, length p
        Coefficients held at or above zero.
    """

    basis: Callable[[np.ndarray, np.ndarray], np.ndarray]
    y: np.ndarray
    weight: np.ndarray
    nonnegative: Sequence[bool]

    def some(self, own: np.ndarray) -> Separable:
        """Return chosen problems, by their numbers, shape (r,)."""
        return replace(self, basis=lambda u, rows: self.basis(u, own[rows]), y=self.y[own], weight=self.weight[own])


def profile(problems: Separable, u: np.ndarray, *, refine: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the best weighted sum of squares and the coefficients at given nonlinear numbers.

    Parameters
    ----------
    problems : Separable
        What is fitted.
    u : ndarray, shape (problems, g)
        Where.
    refine : int
        Steps of iterative refinement; 0 is enough for a search, 2 gives all digits.

    Returns
    -------
    rss : ndarray, shape (problems, g)
    coefficients : ndarray, shape (problems, g, p)
    """
    y, weight, nonnegative = problems.y, problems.weight, problems.nonnegative
    root, rows = np.sqrt(weight), np.arange(len(y))
    p = len(nonnegative)
    rss = np.empty(u.shape)
    coefficients = np.empty((*u.shape, p))
    step = max(1, CHUNK // max(1, u.shape[1] * y.shape[1] * p))
    for start in range(0, len(u), step):
        part = slice(start, start + step)
        chosen = rows[part]
        weights = root[chosen][:, None, :, None]
        columns = problems.basis(u[part], chosen)
        measured = np.broadcast_to((y[chosen] * root[chosen])[:, None, :], columns.shape[:-1])
        coefficients[part], rss[part] = project(columns * weights, measured, nonnegative, refine)
    return rss, coefficients


def global_optimum(problems: Separable, grid: np.ndarray) -> BatchFit:
    """Return the least-squares optimum of each problem over its whole grid.

    Every local minimum of the sum of squares along the grid is refined; the best of them, or an end of the grid, is the
    answer.

    Parameters
    ----------
    problems : Separable
        What is fitted.
    grid : ndarray, shape (problems, g)
        Rising nonlinear numbers, close enough that no minimum hides between two of them.

    Raises
    ------
    FitError
        If a measured value or weight is not finite, or a weight is negative.
    """
    check(problems.y, problems.weight)
    rss, _ = profile(problems, grid)
    inner = rss[:, 1:-1]
    problem, k = np.nonzero((inner <= rss[:, :-2]) & (inner <= rss[:, 2:]))

    def solved(u, problem):
        return profile(problems.some(problem.astype(int)), u[:, None], refine=2)

    bracket = tuple(grid[problem, k + step] for step in range(3))
    stops = {"xatol": CLOSE, "xrtol": 0.0, "fatol": 0.0, "frtol": 0.0}
    valley = find_minimum(
        lambda u, problem: solved(u, problem)[0][:, 0], bracket, args=(problem,), tolerances=stops, maxiter=MOST_STEPS
    ).x
    start = np.column_stack([solved(valley, problem)[1][:, 0], valley])
    valley = _to_all_digits(problems.some(problem), start, grid[problem][:, [0, -1]])
    every = np.arange(len(problems.y))
    problem = np.concatenate([problem, every])
    u = np.concatenate([valley, grid[every, np.argmin(rss, axis=1)]])
    left, coefficients = (found[:, 0] for found in solved(u, problem))
    order = np.lexsort([left, problem])
    best = order[np.unique(problem[order], return_index=True)[1]]
    return BatchFit(u[best], coefficients[best], left[best])


def _to_all_digits(problems: Separable, start: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return the nonlinear numbers, shape (r,), that starts near an optimum lead to, shape (r, p + 1).

    Along the nonlinear number alone, the sum of squares is flat where half of its digits are known.
    """
    root = np.sqrt(problems.weight)

    def evaluate(x, own):
        columns = problems.basis(x[:, -1:] + NUDGES, own) * root[own][:, None, :, None]
        below2, below, here, above, above2 = np.moveaxis(np.einsum("rgnp,rp->rgn", columns, x[:, :-1]), 1, 0)
        along = (below2 - 8 * below + 8 * above - above2) / (12 * NUDGES[-2])
        slope = np.concatenate([np.swapaxes(columns[:, 2], 1, 2), along[:, None]], axis=1)
        return here - problems.y[own] * root[own], slope

    linear = np.tile(np.where(problems.nonnegative, 0.0, -np.inf), (len(start), 1))
    low = np.column_stack([linear, ends[:, 0]])
    high = np.column_stack([np.full(linear.shape, np.inf), ends[:, 1]])
    return levenberg_marquardt(evaluate, start, low, high, damping=NEXT_TO_NONE)[0][:, -1]


def even_grid(low, high, per_decade: int) -> np.ndarray:
    """Return even points from `low` to `high`, logarithms, shape (problems, g): so many or more to a factor of ten."""
    points = int(np.ceil(per_decade * np.max(high - low) / np.log(10))) + 1
    return low[:, None] + (high - low)[:, None] * np.linspace(0, 1, points)


def check(y, weight) -> None:
    """Refuse measured values and weights that cannot be fitted.

    Raises
    ------
    FitError
        If one is not finite, or a weight is negative.
    """
    if not (np.all(np.isfinite(y)) and np.all(np.isfinite(weight)) and np.all(weight >= 0)):
        raise FitError("measured values and weights must be finite, weights not negative.", fix="Look for empty cells.")
