"""Nonlinear least squares from one starting point, with bounds and covariance: scipy's solver, finished and checked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from sealfit.errors import FitError

SAME = 1e-13  # relative rise of the sum of squares that is rounding
SHRINKS = 0.9  # from one step to the next where they converge: in a large residual they swing about the optimum
RANK = 1e-11  # singular values this small against the largest, columns scaled to length 1, are zero


@dataclass(frozen=True)
class Polished:
    """A least-squares optimum: parameters, residual and tangent there, and what the tangent says of them."""

    x: np.ndarray  # (p,)
    residual: np.ndarray  # (n,)
    jacobian: np.ndarray  # (n, p), of the residual
    rss: float
    covariance: np.ndarray  # (p, p), for residuals of variance 1; inf where not determined, 0 where held at a bound
    rank: int
    at_bound: np.ndarray  # (p,) bool
    converged: bool
    evaluations: int


def central_jacobian(
    residual: Callable[[np.ndarray], np.ndarray], x: np.ndarray, *, together: bool = False
) -> np.ndarray:
    """Return the derivative of `residual` at `x`, shape (n, p), by central differences of fourth order.

    The step is 1e-4 of each parameter: rounding stays near 1e-12 of the derivative, and a place parameter that is a
    hundred widths from its origin (a peak at 450 nm, 4 nm wide) still moves by a hundredth of its width only.

    Parameters
    ----------
    residual : callable
        (p,) -> (n,).
    x : ndarray, shape (p,)
        Where.
    together : bool
        Whether `residual` takes many points at once, (..., p) -> (..., n). x may then be (..., p) too, and the answer
        is (..., n, p).
    """
    h = 1e-4 * np.where(x == 0, 1.0, np.abs(x))
    steps = np.array([-2, -1, 1, 2])[:, None, None] * (h[..., None] * np.eye(x.shape[-1]))[..., None, :, :]
    points = x[..., None, None, :] + steps  # (..., 4, p, p)
    values = residual(points) if together else np.stack([[residual(point) for point in side] for side in points])
    below2, below, above, above2 = np.moveaxis(values, -3, 0)
    return np.swapaxes((below2 - 8 * below + 8 * above - above2) / (12 * h[..., None]), -1, -2)


def polish(
    residual: Callable[[np.ndarray], np.ndarray],
    jacobian: Callable[[np.ndarray], np.ndarray] | None,
    start: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray] | None = None,
    *,
    max_evaluations: int | None = None,
) -> Polished:
    """Return the least-squares optimum that `start` leads to.

    Levenberg-Marquardt (MINPACK) without bounds, trust-region reflective with bounds, both on scaled columns, then
    Gauss-Newton steps until the sum of squares no longer falls: the first stops early where the optimum is flat.

    Parameters
    ----------
    residual : callable
        Weighted residual of the parameters, shape (p,) -> (n,).
    jacobian : callable or None
        Its derivative, (p,) -> (n, p); None takes central differences.
    start : ndarray, shape (p,)
        Starting point; moved inside the bounds.
    bounds : (lower, upper), each shape (p,), optional
        Closed bounds; infinite where there is none.
    max_evaluations : int, optional
        Default 1000 per parameter.

    Raises
    ------
    FitError
        If the residual is not finite at the start, or there are no residuals.
    """
    start = np.atleast_1d(np.asarray(start, float))
    free = start.size == 0 or bounds is None or not (np.isfinite(bounds[0]).any() or np.isfinite(bounds[1]).any())
    low, high = (np.full(start.size, -np.inf), np.full(start.size, np.inf)) if free else map(np.asarray, bounds)
    start = np.clip(start, low, high)
    first = residual(start)
    if first.size == 0 or not np.all(np.isfinite(first)):
        raise FitError(f"the residual is not finite at the starting point {start}.", mend="Start elsewhere.")
    derivative = jacobian or (lambda x: central_jacobian(residual, x))
    budget = max_evaluations or 1000 * max(start.size, 1)
    with np.errstate(all="ignore"):
        found = least_squares(
            lambda x: _finite(residual(x)),
            start,
            jac=lambda x: _finite(derivative(x)),
            # MINPACK needs as many residuals as parameters
            method="lm" if free and first.size >= start.size else "trf",
            bounds=(-np.inf, np.inf) if free else (low, high),
            x_scale="jac",
            ftol=1e-15,
            xtol=1e-15,
            gtol=None if not free else 1e-15,
            max_nfev=budget,
        )
        x, steps, reestimated = _finish(residual, derivative, found.x, low, high)
    at_bound = (x <= low) | (x >= high)
    rest, tangent = residual(x), derivative(x)
    covariance, rank = covariance_of(tangent, ~at_bound)
    return Polished(
        x=x,
        residual=rest,
        jacobian=tangent,
        rss=float(rest @ rest),
        covariance=covariance,
        rank=rank,
        at_bound=at_bound,
        converged=bool(found.success or reestimated),
        evaluations=int(found.nfev) + steps,
    )


def _finite(values: np.ndarray) -> np.ndarray:
    """A trial step that overflows is a bad step, not an error: make it large, so that it is refused."""
    return np.nan_to_num(values, nan=1e100, posinf=1e100, neginf=-1e100)


def _finish(residual, derivative, x, low, high):
    """Gauss-Newton steps from a point that is nearly there, while they shrink and do not raise the sum of squares.

    The sum of squares is flat at its minimum: judged by it alone, half the digits of the parameters would be left.
    """
    rest = residual(x)
    rss, steps, length = rest @ rest, 0, np.inf
    for steps in range(1, 61):
        tangent = derivative(x)
        # within 1e-9 of a bound the reflective method has stopped short of it: take the bound
        near = np.isfinite(low) & (x - low <= 1e-9 * np.maximum(1.0, np.abs(low)))
        near |= np.isfinite(high) & (high - x <= 1e-9 * np.maximum(1.0, np.abs(high)))
        scale = np.linalg.norm(tangent, axis=0)
        move = np.zeros_like(x)
        use = ~near & (scale > 0) & np.isfinite(scale)
        if use.any():
            scaled = np.linalg.lstsq(tangent[:, use] / scale[use], -rest, rcond=RANK)[0]
            move[use] = scaled / scale[use]
        trial = np.clip(np.where(near, np.where(x - low < high - x, low, high), x + move), low, high)
        step = float(np.linalg.norm((trial - x) * np.where(np.isfinite(scale), scale, 0.0)))
        if step == 0.0:
            return x, steps, True
        trial_rest = residual(trial)
        trial_rss = trial_rest @ trial_rest
        if not (trial_rss <= rss * (1 + SAME) and step < length):
            return x, steps, bool(np.isfinite(length))
        x, rest, rss, length = trial, trial_rest, trial_rss, SHRINKS * step
    return x, steps, False


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
