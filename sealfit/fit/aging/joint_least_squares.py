"""Least squares of a joint law of aging: of some values, or of many draws of the values."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_array

from sealfit.fit.least_squares import levenberg_marquardt

if TYPE_CHECKING:
    from sealfit.fit.aging.joint_law import Aged, JointLaw

# Starting values of E in kJ/mol.
ENERGIES = (0.0, 50.0, 100.0)
# Starting values and bounds of the parameters of the shapes: days, and exponents.
SHAPES = {
    "b": (0.01, 0.3, 10.0),
    "tau": (0.5, 5.0, 50.0),
    "beta": (0.5, 1.0),
    "n": (0.2, 0.5, 1.0),
    "t_i": (0.3, 3.0),
}
LIMITS = {"b": (1e-9, 1e4), "tau": (1e-6, 1e6), "beta": (0.05, 5.0), "n": (0.01, 5.0), "t_i": (1e-3, 1e3)}
# Number of linear parameters: mu_0 and a.
LINEAR = 2
# Number of starting points that are polished.
POLISHED = 4
# The loss is constant, and a not determined, if mu_0 explains all but this share of its square.
DEPENDENT = 1e-20


def solved(law: JointLaw, aged: Aged, white: csr_array, start: np.ndarray | None = None) -> np.ndarray:
    """Return the least-squares parameters, shape (p,), from a start or from the best points of a grid.

    `law` gives the shape, its target and the references; `white` is W, shape (n, n), with W C W' = 1 for the
    covariance C of the values in `aged`.
    """
    problem = _Projected(law, aged, white, aged.value[None])
    nonlinear = problem.grid() if start is None else start[None, LINEAR:]
    x, rss = problem.polished(nonlinear, np.zeros(len(nonlinear), int))
    return x[np.argmin(rss)]


def solved_many(law: JointLaw, white: csr_array, values: np.ndarray) -> np.ndarray:
    """Return the parameters for many sets of values, shape (sets, n) -> (sets, p), computed together.

    As `solved`, from the law's parameters.
    """
    return _Projected(law, law.aged, white, values).polished(np.tile(law.x[LINEAR:], (len(values), 1)))[0]


class _Projected:
    """Variable projection of a law on sets of values, shape (sets, n): mu_0 and a are solved for.

    The other arguments are those of `solved`. Golub & Pereyra 1973, SIAM J. Numer. Anal. 10(2), 413-432,
    doi:10.1137/0710036, with the tangent of Kaufman 1975, BIT 15, 49-57, doi:10.1007/BF01932995.
    """

    def __init__(self, law: JointLaw, aged: Aged, white: csr_array, values: np.ndarray) -> None:
        self.law, self.aged, self.values, self.white = law, aged, values, white
        level = white.sum(axis=1)
        self.column = level / np.linalg.norm(level)  # of mu_0
        self.level = (level / (level @ level)) @ white
        self.measured = self._whitened(values[:, None])
        self.reach = float((white.data**2).sum())

    def _whitened(self, many: np.ndarray) -> np.ndarray:
        """Return rows, shape (r, m, n), whitened, with mu_0 projected out."""
        many = (self.white @ many.reshape(-1, many.shape[2]).T).T.reshape(many.shape)
        return many - (many @ self.column)[..., None] * self.column

    def solve(self, nonlinear: np.ndarray, of: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return mu_0 and a, shape (r, 2), the whitened residual, (r, n), and its derivative, (r, p - 2, n).

        `nonlinear`, shape (r, p - 2), are all other parameters; `of`, shape (r,), the numbers of the sets of
        values.
        """
        law, measured = self.law, self.measured[of]
        # The law with mu_0 = 0 and a = -1 is the loss.
        unit = np.concatenate([np.tile([0.0, -1.0], (len(nonlinear), 1)), nonlinear], axis=1)
        plain = law.slope(self.aged, unit)[:, 1:]
        columns = self._whitened(plain)
        square = (columns[:, :1] ** 2).sum(axis=2, keepdims=True)
        sound = square > DEPENDENT * self.reach * (plain[:, :1] ** 2).max(axis=2, keepdims=True)
        column = np.divide(columns[:, :1], np.sqrt(square), out=np.zeros(measured.shape), where=sound)
        along = (measured * column).sum(axis=2, keepdims=True)
        a = np.divide(along, np.sqrt(square), out=np.zeros(square.shape), where=sound)
        slope = columns[:, 1:] - (columns[:, 1:] * column).sum(axis=2, keepdims=True) * column
        mu_0 = ((self.values[of] - a[:, 0] * plain[:, 0]) @ self.level)[:, None]
        return np.concatenate([mu_0, a[:, 0]], axis=1), (along * column - measured)[:, 0], -a * slope

    def grid(self) -> np.ndarray:
        """Return the best points of a grid, shape (POLISHED, p - 2)."""
        own = self.law.loss.parameters
        grids = [[np.log(v) for v in SHAPES[name]] for name in own]
        grids += [ENERGIES if name == "E" else (0.0,) for name in self.law.names[LINEAR + len(own) :]]
        points = np.array(list(product(*grids)))
        rest = self.solve(points, np.zeros(len(points), int))[1]
        return points[np.argsort((rest**2).sum(axis=1), kind="stable")[:POLISHED]]

    def polished(self, nonlinear: np.ndarray, of: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return all parameters, shape (r, p), and sums of squares, shape (r,), at the optima from starts."""
        of = np.arange(len(nonlinear)) if of is None else of
        own = self.law.loss.parameters
        low, high = (
            np.array(
                [np.log(LIMITS[name][end]) if name in own else infinity for name in self.law.names[LINEAR:]]
            )
            for end, infinity in enumerate((-np.inf, np.inf))
        )
        found, rss = levenberg_marquardt(lambda x, rows: self.solve(x, of[rows])[1:], nonlinear, low, high)
        return np.concatenate([self.solve(found, of)[0], found], axis=1), rss
