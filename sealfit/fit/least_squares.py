"""Nonlinear least squares: Levenberg-Marquardt for one or many small problems, and variable projection."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize.elementwise import find_minimum
from scipy.special import stdtrit

from sealfit.errors import FitError

# Largest number of steps.
STEPS = 2000
# Relative change of the sum of squares that counts as rounding.
SAME = 1e-13
# Steps that shrink at least by this factor still converge, though the sum of squares stays the same.
SHRINKS = 0.9
# Relative change of all parameters that is rounding; such steps could repeat without end.
ROUNDING = 4 * np.finfo(float).eps
# Damping of the first step, which is close to a Gauss-Newton step.
DAMPING = 1e-3
# Damping at which the search ends without a further decrease.
LARGEST_DAMPING = 1e12
# Singular values below this share of the largest count as zero, with columns scaled to length 1.
RANK = 1e-11


def levenberg_marquardt(
    evaluate: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    linear: "Linear | None" = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the local least-squares optima from starting points, (problems, p), and their sums of squares.

    `evaluate(x, rows)` returns weighted residuals, shape (r, n), and their derivatives, shape (r, p, n), of
    the problems `rows`, shape (r,), at x, shape (r, p). Starts are moved inside the closed bounds, shape (p,)
    or (problems, p), which are infinite for none and equal for a fixed parameter. `linear` has the products
    of derivatives that are not arrays. A sum of squares is infinite if the residual is not finite at the
    start.

    The scale of each parameter is the largest norm of its column so far (More 1978, Lecture Notes in
    Mathematics 630, 105-116).
    """
    linear = linear or Linear()
    low, high = np.broadcast_to(low, start.shape), np.broadcast_to(high, start.shape)
    x, todo = np.clip(start, low, high), np.arange(len(start))
    damping = np.full(len(x), DAMPING)
    length = np.full(len(x), np.inf)  # of the last step, in standard errors
    scale = np.zeros(x.shape)
    with np.errstate(all="ignore"):  # a trial step that overflows is rejected
        rest, slope = evaluate(x, todo)
        rss = _squares(rest)
        todo = np.flatnonzero(np.isfinite(rss))
        for _ in range(STEPS):
            if not todo.size:
                break
            at, size = x[todo], linear.norms(slope[todo])
            scale[todo] = np.maximum(scale[todo], size)
            pull = -linear.gradient(slope[todo], rest[todo])
            free = ~((at <= low[todo]) & (pull <= 0)) & ~((at >= high[todo]) & (pull >= 0))
            own_scale = np.where(scale[todo] > 0, scale[todo], 1.0)
            move = linear.step(slope[todo], free / own_scale, rest[todo], damping[todo]) / own_scale
            trial = np.clip(at + move, low[todo], high[todo])
            trial_rest, trial_slope = evaluate(trial, todo)
            gain, step = rss[todo] - _squares(trial_rest), np.linalg.norm((trial - at) * size, axis=1)
            same, shrinks = np.abs(gain) <= SAME * rss[todo], step < SHRINKS * length[todo]
            better = (gain > 0) | (same & shrinks)
            done = same & ~(shrinks & (step > 0)) & ((damping[todo] < DAMPING) | ~better)
            done |= (np.abs(trial - at) <= ROUNDING * np.abs(at)).all(axis=1)
            moved = todo[better]
            x[moved], length[moved] = trial[better], step[better]
            rest[moved], slope[moved] = trial_rest[better], trial_slope[better]
            rss[moved] -= gain[better]
            damping[todo] = np.where(better, damping[todo] / 10, np.maximum(damping[todo], 1e-12) * 10)
            todo = todo[~done & (damping[todo] < LARGEST_DAMPING)]
    return x, rss


class Linear:
    """Products of the derivatives of residuals, here arrays of shape (r, p, n); residuals are (r, n)."""

    def norms(self, slope: np.ndarray) -> np.ndarray:
        """Return the norm of each parameter's derivative, shape (r, p)."""
        return np.linalg.norm(slope, axis=2)

    def gradient(self, slope: np.ndarray, rest: np.ndarray) -> np.ndarray:
        """Return half the derivative of the sum of squares, shape (r, p)."""
        return (slope @ rest[..., None])[..., 0]

    def step(self, slope: np.ndarray, scale: np.ndarray, rest: np.ndarray, damping: np.ndarray) -> np.ndarray:
        """Return x of least |x scale slope + rest|^2 + damping |x|^2, shape (r, p); scale is (r, p)."""
        axes, singular, rows = np.linalg.svd(slope * scale[..., None], full_matrices=False)
        share = damped_inverse(singular, damping[:, None])
        return -(axes @ (share * (rows @ rest[..., None])[..., 0])[..., None])[..., 0]


def damped_inverse(singular: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return s / (s^2 + damping) of singular values s, 0 for s = 0."""
    return np.where(singular > 0, singular / (singular**2 + damping), 0.0)


def _squares(rest: np.ndarray) -> np.ndarray:
    squares = (rest**2).sum(axis=-1)
    return np.where(np.isfinite(squares), squares, np.inf)


def central_jacobian(residual: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """Return the derivative of `residual`, (p,) -> (n,), at `x`, shape (n, p), by fourth-order differences.

    With a step of 1e-4 of each parameter rounding errors are near 1e-12 of the derivative.
    """
    h = 1e-4 * np.where(x == 0, 1.0, np.abs(x))
    points = x + np.array([-2, -1, 1, 2])[:, None, None] * np.diag(h)
    below2, below, above, above2 = np.array([[residual(point) for point in side] for side in points])
    return ((below2 - 8 * below + 8 * above - above2) / (12 * h[:, None])).T


def covariance_of(jacobian: np.ndarray, free: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return (J'J)^-1, shape (..., p, p), and its rank; undetermined parameters have infinite variance.

    J, shape (..., n, p), is of weighted residuals. Parameters not in `free`, (..., p), have variance 0.
    """
    n, p = jacobian.shape[-2:]
    free = np.ones(p, bool) if free is None else free
    jacobian = jacobian * free[..., None, :]
    scale = np.linalg.norm(jacobian, axis=-2)
    scale = np.where(scale > 0, scale, 1.0)
    # The null space of a wide matrix needs the full decomposition.
    _, singular, rows = np.linalg.svd(jacobian / scale[..., None, :], full_matrices=n < p)
    singular = np.concatenate([singular, np.zeros((*singular.shape[:-1], p - singular.shape[-1]))], axis=-1)
    known = singular > RANK * np.maximum(singular.max(axis=-1, keepdims=True), 1e-300)
    half = rows * np.divide(1.0, singular, out=np.zeros(singular.shape), where=known)[..., None]
    covariance = np.swapaxes(half, -1, -2) @ half / (scale[..., :, None] * scale[..., None, :])
    unknown = free & np.any(~known[..., None] & (np.abs(rows) > 1e-6), axis=-2)  # change in the null space
    covariance[unknown[..., :, None] | unknown[..., None, :]] = 0.0
    covariance[unknown[..., :, None] & np.eye(p, dtype=bool)] = np.inf
    return covariance, known.sum(axis=-1)


def t_quantile(df):
    """Return Student's quantile of two-sided 95 % intervals, of the shape of `df`; NaN for df = 0."""
    return stdtrit(df, 0.975)


# ---------------------------------------------------------------- variable projection
# Many problems with one nonlinear parameter each, solved together. Golub and Pereyra 1973, SIAM J. Numer.
# Anal. 10(2), 413-432, doi:10.1137/0710036.

# A column is linearly dependent if the others explain all but this share of its variance.
DEPENDENT = 1e-13
# Number of values in a temporary array: 16 MB.
CHUNK = 2_000_000
# Tolerance of the nonlinear parameter, usually a logarithm, within which the sum of squares is constant.
CLOSE = 1e-9
# Largest number of steps of this search.
MOST_STEPS = 60


def solve_kept(gram, moment, keep):
    """Return the coefficients of columns in `keep`, (..., p), others 0; gram (..., p, p) has unit diagonal.

    Cholesky factorisation of all problems together. A linearly dependent column has coefficient 0.
    """
    p = moment.shape[-1]
    lower = [[None] * p for _ in range(p)]
    inverse, z = [None] * p, [None] * p
    for j in range(p):
        pivot = gram[..., j, j] - sum((lower[j][k] ** 2 for k in range(j)), 0.0)
        good = keep[..., j] & (pivot > DEPENDENT)
        inverse[j] = np.where(good, 1 / np.sqrt(np.where(good, pivot, 1.0)), 0.0)
        for i in range(j + 1, p):
            cross = gram[..., i, j] - sum((lower[i][k] * lower[j][k] for k in range(j)), 0.0)
            lower[i][j] = cross * inverse[j]
        z[j] = (moment[..., j] - sum((lower[j][k] * z[k] for k in range(j)), 0.0)) * inverse[j]
    solution = [None] * p
    for j in reversed(range(p)):
        solution[j] = (z[j] - sum((lower[i][j] * solution[i] for i in range(j + 1, p)), 0.0)) * inverse[j]
    return np.stack(solution, axis=-1)


def least_squares_of(gram, moment, nonnegative: Sequence[bool]):
    """Return the global least squares with some nonnegative coefficients, by trying every active set.

    `gram`, shape (..., p, p), is B'B of the columns, scaled to unit diagonal (0 for a column of zeros), and
    `moment`, shape (..., p), is B'y. Returns the coefficients and which columns are in the optimum.
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
    bounded = np.flatnonzero(nonnegative)
    for zeros in product((False, True), repeat=bounded.size):
        subset = np.ones(m.shape[-1], bool)
        subset[bounded] = ~np.array(zeros)
        tried = solve_kept(g, m, np.broadcast_to(subset, m.shape))
        gain = np.einsum("...p,...p", tried, m)
        better = ~np.any((tried < 0) & nonnegative, axis=-1) & (gain > explained)
        best[better], support[better], explained[better] = tried[better], subset, gain[better]
    coefficients[bad], keep[bad] = best, support
    return coefficients, keep


def project(columns, y, nonnegative, refine: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return coefficients, (..., p), of weighted columns (..., n, p) and y (..., n), and the rss, (...).

    `refine` steps of iterative refinement recover digits that normal equations lose.
    """
    norm = np.sqrt(np.einsum("...np,...np->...p", columns, columns))
    scaled = columns / np.where(norm > 0, norm, 1.0)[..., None, :]
    transposed = np.swapaxes(scaled, -1, -2)
    gram = transposed @ scaled
    moment = (transposed @ y[..., None])[..., 0]
    c, support = least_squares_of(gram, moment, nonnegative)
    rest = y - (scaled @ c[..., None])[..., 0]
    for _ in range(refine):
        c = c + solve_kept(gram, (transposed @ rest[..., None])[..., 0], support)
        rest = y - (scaled @ c[..., None])[..., 0]
    c = np.where(nonnegative, np.maximum(c, 0.0), c)
    return c / np.where(norm > 0, norm, 1.0), np.einsum("...n,...n->...", rest, rest)


@dataclass(frozen=True)
class BatchFit:
    """Optimum per problem; u is the argument of the basis, usually the nonlinear parameter's logarithm."""

    u: np.ndarray  # (problems,)
    coefficients: np.ndarray  # (problems, p)
    rss: np.ndarray  # (problems,), weighted


@dataclass(frozen=True)
class Separable:
    """Least-squares problems with one nonlinear parameter each.

    `basis(u, rows)` returns the columns, shape (r, g, n, p), of the problems `rows`, shape (r,), at u, shape
    (r, g).
    """

    basis: Callable[[np.ndarray, np.ndarray], np.ndarray]
    y: np.ndarray  # (problems, n) measured values
    weight: np.ndarray  # (problems, n) 1/variance; 0 for padding
    nonnegative: Sequence[bool]  # (p,) which coefficients are nonnegative


def profile(
    problems: Separable, u: np.ndarray, rows: np.ndarray | None = None, *, refine: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least weighted sums of squares, (r, g), and coefficients, (r, g, p), of the problems `rows`.

    `u`, shape (r, g), are the nonlinear parameters. `refine` is as in `project`: 0 is for a search.
    """
    rows = np.arange(len(problems.y)) if rows is None else rows
    y, root, p = problems.y[rows], np.sqrt(problems.weight[rows]), len(problems.nonnegative)
    rss, coefficients = np.empty(u.shape), np.empty((*u.shape, p))
    step = max(1, CHUNK // max(1, u.shape[1] * y.shape[1] * p))
    for start in range(0, len(u), step):
        part = slice(start, start + step)
        columns = problems.basis(u[part], rows[part])
        measured = np.broadcast_to((y[part] * root[part])[:, None, :], columns.shape[:-1])
        weighted = columns * root[part, None, :, None]
        coefficients[part], rss[part] = project(weighted, measured, problems.nonnegative, refine)
    return rss, coefficients


def global_optimum(problems: Separable, grid: np.ndarray) -> BatchFit:
    """Return the global least-squares optimum of each problem on the range of its grid, shape (problems, g).

    Every local minimum along the grid, which rises closely enough, is refined. The result is the best of
    them, or an end of the grid. FitError if a measured value or weight is not finite, or a weight is
    negative.
    """
    y, weight = problems.y, problems.weight
    if not (np.all(np.isfinite(y)) and np.all(np.isfinite(weight)) and np.all(weight >= 0)):
        raise FitError(
            "measured values and weights must be finite, weights not negative.", fix="Look for empty cells."
        )
    rss, _ = profile(problems, grid)
    inner = rss[:, 1:-1]
    problem, k = np.nonzero((inner <= rss[:, :-2]) & (inner <= rss[:, 2:]))

    def rss_at(u, problem):
        return profile(problems, u[:, None], problem.astype(int), refine=2)[0][:, 0]

    bracket = tuple(grid[problem, k + step] for step in range(3))
    stops = {"xatol": CLOSE, "xrtol": 0.0, "fatol": 0.0, "frtol": 0.0}
    valley = find_minimum(rss_at, bracket, args=(problem,), tolerances=stops, maxiter=MOST_STEPS).x
    every = np.arange(len(problems.y))
    problem = np.concatenate([problem, every])
    u = np.concatenate([valley, grid[every, np.argmin(rss, axis=1)]])
    rss, coefficients = (found[:, 0] for found in profile(problems, u[:, None], problem, refine=2))
    order = np.lexsort([rss, problem])
    best = order[np.unique(problem[order], return_index=True)[1]]
    return BatchFit(u[best], coefficients[best], rss[best])


def even_grid(low, high, per_decade: int) -> np.ndarray:
    """Return `per_decade` or more even points from `low` to `high`, natural logarithms, (problems, g)."""
    points = int(np.ceil(per_decade * np.max(high - low) / np.log(10))) + 1
    return low[:, None] + (high - low)[:, None] * np.linspace(0, 1, points)
