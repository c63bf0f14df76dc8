"""Separable least squares: the linear numbers exactly, the nonlinear ones by a global grid and a polish.

`solve_separable` does one problem with one to three nonlinear numbers, without a starting guess. `polish` takes one,
for any model.

Golub and Pereyra 1973, SIAM J. Numer. Anal. 10(2), 413-432, doi:10.1137/0710036 (variable projection);
Kaufman 1975, BIT 15, 49-57, doi:10.1007/BF01932995 (its tangent).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sealfit.errors import FitError
from sealfit.fit.batch import CHUNK, BatchFit, least_squares_of, profile, project
from sealfit.fit.polish import Polished, central_jacobian, covariance_of, polish

__all__ = [
    "BatchFit",
    "Polished",
    "SeparableFit",
    "least_squares_of",
    "polish",
    "profile",
    "solve_separable",
]


@dataclass(frozen=True)
class SeparableFit:
    """Optimum of one separable problem; `covariance` is of (coefficients, theta), for residuals of variance 1."""

    theta: np.ndarray  # (d,)
    coefficients: np.ndarray  # (p,)
    rss: float
    residual: np.ndarray  # (n,), weighted
    jacobian: np.ndarray  # (n, p + d), of the weighted model, coefficients first
    covariance: np.ndarray
    df: int
    converged: bool


def solve_separable(
    basis: Callable[[np.ndarray], np.ndarray],
    y,
    weight=None,
    grid: Sequence[np.ndarray] = (),
    *,
    nonnegative: Sequence[bool] | None = None,
    offset: Callable[[np.ndarray], np.ndarray] | None = None,
    bounds: tuple[np.ndarray, np.ndarray] | None = None,
    starts: int = 6,
) -> SeparableFit:
    """Global optimum of y = offset(theta) + basis(theta) c over c and one to three nonlinear numbers theta.

    Every point of the grid is solved exactly for c; the best local minima of the grid are polished on the projected
    residual, and the best of those is returned.

    Parameters
    ----------
    basis : callable
        theta, shape (m, d) -> columns, shape (m, n, p).
    y : ndarray, shape (n,)
        Measured values.
    weight : ndarray, shape (n,), optional
        1/variance; default 1.
    grid : sequence of ndarray
        One rising array per nonlinear number; their product is searched.
    nonnegative : sequence of bool, length p, optional
        Coefficients held at or above zero; default none.
    offset : callable, optional
        theta, shape (m, d) -> the part without coefficient, shape (m, n).
    bounds : (lower, upper), optional
        Of theta; default none.
    starts : int
        Local minima of the grid that are polished.

    Raises
    ------
    FitError
        If the grid is empty or no point of it gives finite columns.
    """
    y = np.asarray(y, float)
    root = np.ones_like(y) if weight is None else np.sqrt(np.asarray(weight, float))
    if not 1 <= len(grid) <= 3:
        raise FitError(f"a grid of {len(grid)} numbers was given.", mend="Give one to three rising arrays.")
    axes = [np.asarray(axis, float) for axis in grid]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    p = basis(points[:1]).shape[-1]
    held = np.zeros(p, bool) if nonnegative is None else np.asarray(nonnegative, bool)

    def projected(theta):
        columns = basis(theta) * root[:, None]
        target = (y - (0 if offset is None else offset(theta))) * root
        return project(columns, np.broadcast_to(target, columns.shape[:-1]), held)

    step = max(1, CHUNK // max(1, y.size * p))
    with np.errstate(all="ignore"):
        rss = np.concatenate([projected(points[i : i + step]).rss for i in range(0, len(points), step)])
    rss = np.where(np.isfinite(rss), rss, np.inf).reshape([axis.size for axis in axes])
    if not np.isfinite(rss).any():
        raise FitError("the columns are not finite anywhere on the grid.", mend="Search where the model is defined.")
    lowest = np.isfinite(rss)
    for axis in range(rss.ndim):
        ends = np.pad(rss, [(1, 1) if k == axis else (0, 0) for k in range(rss.ndim)], constant_values=np.inf)
        lowest &= (rss <= np.take(ends, range(rss.shape[axis]), axis)) & (
            rss <= np.take(ends, range(2, rss.shape[axis] + 2), axis)
        )
    candidates = np.flatnonzero(lowest.ravel())
    candidates = candidates[np.argsort(rss.ravel()[candidates], kind="stable")][:starts]

    def model(theta, c):
        fixed = 0 if offset is None else offset(theta[None, :])[0]
        return root * (basis(theta[None, :])[0] @ c + fixed)

    def tangent(theta):
        point = projected(theta[None, :])
        columns = basis(theta[None, :])[0] * root[:, None] * point.support[0]
        moved = central_jacobian(lambda at: model(at, point.coefficients[0]), theta)
        scale = np.linalg.norm(columns, axis=0)
        q, r = np.linalg.qr(columns / np.where(scale > 0, scale, 1.0))
        q = q[:, np.abs(np.diag(r)) > 1e-12]
        return -(moved - q @ (q.T @ moved))

    found = [polish(lambda t: projected(t[None, :]).residual[0], tangent, points[k], bounds) for k in candidates]
    best = min(found, key=lambda f: f.rss)
    point = projected(best.x[None, :])
    support = point.support[0]

    def parted(both):  # the coefficients in use and theta
        c = np.zeros(p)
        c[support] = both[: support.sum()]
        return both[support.sum() :], c

    # The projected sum of squares is flat to rounding along a valley, where all numbers together still have digits.
    low, high = (np.full(len(axes), -np.inf), np.full(len(axes), np.inf)) if bounds is None else bounds
    least = np.r_[np.where(held, 0.0, -np.inf)[support], low]
    most = np.r_[np.full(support.sum(), np.inf), high]
    start = np.r_[point.coefficients[0][support], best.x]
    last = polish(lambda both: y * root - model(*parted(both)), None, start, (least, most))
    theta, c = parted(last.x)
    columns = basis(theta[None, :])[0] * root[:, None]
    jacobian = np.hstack([columns, central_jacobian(lambda at: model(at, c), theta)])
    free = np.concatenate([support, ~last.at_bound[support.sum() :]])
    covariance, rank = covariance_of(jacobian, free)
    return SeparableFit(
        theta, c, last.rss, last.residual, jacobian, covariance, y.size - rank, best.converged and last.converged
    )
