"""The least squares of a joint law of aging: from anywhere, without some of the values, or of many draws of them."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from sealfit.fit.polish_many import polish_many

if TYPE_CHECKING:
    from sealfit.fit.joint_law import JointLaw

ENERGIES = (0.0, 50.0, 100.0)  # kJ/mol, to begin with
SHAPES = {"b": (0.01, 0.3, 10.0), "tau": (0.5, 5.0, 50.0), "beta": (0.5, 1.0), "n": (0.2, 0.5, 1.0), "t_i": (0.3, 3.0)}
LIMITS = {"b": (1e-9, 1e4), "tau": (1e-6, 1e6), "beta": (0.05, 5.0), "n": (0.01, 5.0), "t_i": (1e-3, 1e3)}
POLISHED = 4  # points of the grid


def solved(law: JointLaw, covariance: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """Return the parameters of least squares, shape (p,): from a start, or from the best few of a grid.

    Parameters
    ----------
    law : JointLaw
        Gives shape, way, values and the references.
    covariance : ndarray, shape (n, n)
        Of the values.
    start : ndarray, shape (p,), optional
        Where to begin.
    """
    white = _whitening(covariance)
    starts = _best_of_grid(law, white) if start is None else start[None, :]
    x, rss = _polished(law, white, law.aged.value, starts)
    return x[np.argmin(rss)]


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
    return _polished(law, _whitening(covariance), values, np.tile(law.x, (len(values), 1)))[0]


def solved_without(law: JointLaw, covariance: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Return the parameters without the values of each mask, shape (masks, p), all masks at once.

    Parameters
    ----------
    law : JointLaw
        Where the search begins.
    covariance : ndarray, shape (n, n)
        Of the values.
    masks : ndarray of bool, shape (masks, n)
        What is left out.
    """
    white = _whitening(covariance)
    # a value with a number of its own that takes it up whole says nothing: what its column reaches is projected out
    aside = np.zeros((len(masks), masks.sum(axis=1).max(), len(white)))
    for own, out in zip(aside, masks, strict=True):
        own[: out.sum()] = np.linalg.qr(white[:, out])[0].T
    return _polished(law, white, law.aged.value, np.tile(law.x, (len(masks), 1)), aside)[0]


def _whitening(covariance: np.ndarray) -> np.ndarray:
    return np.linalg.inv(np.linalg.cholesky(covariance))


def _best_of_grid(law: JointLaw, white: np.ndarray) -> np.ndarray:
    """Return the best few points of a grid, mu_0 and a solved for, shape (POLISHED, p)."""
    own, value = law.loss.parameters, white @ law.aged.value
    grids = [[np.log(v) for v in SHAPES[name]] for name in own]
    grids += [ENERGIES if name == "E" else (0.0,) for name in law.names[2 + len(own) :]]
    x = np.array([(0.0, 1.0, *point) for point in product(*grids)])
    basis = white @ np.stack([np.ones((len(x), value.size)), law.at(law.aged, x)], axis=-1)
    x[:, :2] = np.linalg.pinv(basis, rcond=1e-10) @ value
    left = ((value - (basis @ x[:, :2, None])[..., 0]) ** 2).sum(axis=1)
    return x[np.argsort(left, kind="stable")[:POLISHED]]


def _polished(law: JointLaw, white: np.ndarray, values: np.ndarray, start: np.ndarray, aside: np.ndarray | None = None):
    """Return `polish_many` of the law; `aside`, shape (problems, s, n), are orthonormal rows that are projected out."""

    def whitened(rows, many):
        many = many.reshape(-1, len(white)) @ white.T
        if aside is None:
            return many
        many, out = many.reshape(len(rows), -1, len(white)), aside[rows]
        return many - (many @ np.swapaxes(out, 1, 2)) @ out

    def residual(x, rows):
        measured = values if values.ndim == 1 else values[rows]
        return whitened(rows, law.at(law.aged, x) - measured).reshape(len(rows), -1)

    def tangent(x, rows):
        return whitened(rows, law.slope(law.aged, x)).reshape(len(rows), x.shape[1], -1)

    own = law.loss.parameters
    low, high = (
        np.array([np.log(LIMITS[name][end]) if name in own else (-np.inf, np.inf)[end] for name in law.names])
        for end in (0, 1)
    )
    return polish_many(residual, tangent, start, low, high)
