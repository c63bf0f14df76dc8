"""The least squares of a joint law of aging: one set of values from anywhere, or many draws of them at once."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from sealfit.fit.aged import Aged
from sealfit.fit.polish import polish

if TYPE_CHECKING:
    from sealfit.fit.joint_law import JointLaw

ENERGIES = (0.0, 50.0, 100.0)  # kJ/mol, to begin with
SHAPES = {"b": (0.01, 0.3, 10.0), "tau": (0.5, 5.0, 50.0), "beta": (0.5, 1.0), "n": (0.2, 0.5, 1.0), "t_i": (0.3, 3.0)}
LIMITS = {"b": (1e-9, 1e4), "tau": (1e-6, 1e6), "beta": (0.05, 5.0), "n": (0.01, 5.0), "t_i": (1e-3, 1e3)}
POLISHED = 4  # points of the grid
STEPS, GAIN, STUCK = 60, 1e-8, 1e9  # of Levenberg and Marquardt: at most; the chi-square and the damping that end them


def solved(law: JointLaw, covariance: np.ndarray, start: np.ndarray | None = None, aged: Aged | None = None):
    """Return the parameters of least squares, shape (p,): from a start, or from the best few of a grid.

    Parameters
    ----------
    law : JointLaw
        Gives shape, way and the references.
    covariance : ndarray, shape (n, n)
        Of the values.
    start : ndarray, shape (p,), optional
        Where to begin.
    aged : Aged, optional
        The values; default the law's.
    """
    aged, own = aged or law.aged, law.loss.parameters
    low, high = _limits(law)
    white = np.linalg.inv(np.linalg.cholesky(covariance))
    value = white @ aged.value

    def residual(x):
        return white @ law.at(aged, x) - value

    def tangent(x):
        return white @ law.slope(aged, x)

    if start is not None:
        return polish(residual, tangent, start, (low, high)).x
    grids = [[np.log(v) for v in SHAPES[name]] for name in own]
    grids += [ENERGIES if name == "E" else (0.0,) for name in law.names[2 + len(own) :]]
    tried = []
    for point in product(*grids):
        x = np.r_[0.0, 1.0, point]
        basis = white @ np.column_stack([np.ones(aged.value.size), law.at(aged, x)])
        x[:2], *_ = np.linalg.lstsq(basis, value, rcond=1e-10)
        tried.append((float((residual(x) ** 2).sum()), x))
    tried.sort(key=lambda entry: entry[0])
    found = [polish(residual, tangent, x, (low, high)) for _, x in tried[:POLISHED]]
    return min(found, key=lambda f: f.rss).x


def solved_many(law: JointLaw, covariance: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the parameters for many draws of the values near the law's own, shape (draws, p), all draws at once.

    Parameters
    ----------
    law : JointLaw
        Where the search begins.
    covariance : ndarray, shape (n, n)
        Of the values of a draw.
    values : ndarray, shape (draws, n)
        The draws.
    """
    low, high = _limits(law)
    white = np.linalg.inv(np.linalg.cholesky(covariance))
    x, damping = np.tile(law.x, (len(values), 1)), np.full(len(values), 1e-6)
    residual = (values - law.at(law.aged, x)) @ white.T
    rss, todo = (residual**2).sum(axis=1), np.arange(len(values))
    for _ in range(STEPS):
        tangent = white @ law.slope(law.aged, x[todo])
        normal = np.swapaxes(tangent, 1, 2) @ tangent
        size = np.sqrt(np.maximum(np.einsum("kpp->kp", normal), 1e-300))
        scaled = normal / (size[:, :, None] * size[:, None, :]) + (damping[todo, None, None] + 1e-12) * np.eye(
            x.shape[1]
        )
        pull = np.einsum("knp,kn->kp", tangent, residual[todo]) / size
        trial = np.clip(x[todo] + np.linalg.solve(scaled, pull[..., None])[..., 0] / size, low, high)
        left = (values[todo] - law.at(law.aged, trial)) @ white.T
        gain = rss[todo] - (left**2).sum(axis=1)
        better = gain >= 0
        at = todo[better]
        x[at], residual[at], rss[at] = trial[better], left[better], rss[at] - gain[better]
        damping[todo] = np.where(better, damping[todo] / 10, np.maximum(damping[todo], 1e-4) * 10)
        todo = todo[~better | (gain > GAIN)]
        todo = todo[damping[todo] < STUCK]
        if not todo.size:
            break
    return x


def _limits(law: JointLaw) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and greatest value of each parameter, shape (p,) each."""
    own = law.loss.parameters
    return tuple(
        np.array([np.log(LIMITS[name][end]) if name in own else (-np.inf, np.inf)[end] for name in law.names])
        for end in (0, 1)
    )
