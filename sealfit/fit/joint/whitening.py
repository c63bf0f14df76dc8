r"""Scatter at several nested levels, and the whitening that makes rows independent.

A residual is noise of its row plus random offsets and gains of its stroke, file, run and specimen,

.. math:: r_i = \epsilon_i + \sum_l (o_{l,g(i)} + k_{l,g(i)} F_i), \quad
          \mathrm{Var}\, o_l = \sigma_{o,l}^2, \ \mathrm{Var}\, k_l = \sigma_{k,l}^2

where F is the model's friction, its force without added forces. Specimens may also differ in mu_s, v_s and
sigma_2, with the derivatives of the force in place of F. Neighbouring rows are correlated, which multiplies
the noise variance of all patterns in a stroke by the design effect. Files differ in shape along their
strokes, which multiplies that of all patterns other than the mean by a further factor, `shape`.

Within a stroke the components change only two numbers: its mean, and its projection on the variation of F
about its mean (zero if F is constant); what else these three change there is left out. For these a root
of the inverse covariance is a product of rank-one updates, as groups are nested; all other patterns are
divided by their noise. Time is linear in the number of rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from sealfit.fit.joint.rows import Groups
from sealfit.fit.joint.tangent import Tangent

# Kinds of random effects, in the order of the columns of `loads`: the change of a row's force per unit of
# each. An offset adds to the force, a gain multiplies friction, and v_s stands for its logarithm.
KINDS = ("offset", "gain", "mu_s", "v_s", "sigma_2")
GAIN = KINDS.index("gain")
# Kinds that change all speeds alike.
LEVELS_OF_FORCE = ("offset", "gain")

# A force whose variation within a stroke is below this share of its mean is constant there.
FLAT = 1e-9


@dataclass(frozen=True, slots=True)
class Component:
    """Variance of a kind of random effect at one level: an `offset` in force units, or a relative `gain`."""

    level: str
    kind: str
    variance: float
    df: float = np.nan


@dataclass(frozen=True, slots=True)
class Scatter:
    """The covariance of the rows: noise sqrt(s0^2 + (gF)^2) and variance components, finest level first."""

    s0: float
    g: float
    components: tuple[Component, ...] = ()
    design_effect: float = 1.0  # factor on the variance of a stroke's mean, as rows are correlated
    shape: float = 1.0  # further factor on that of patterns along the stroke, as files differ

    def estimates(self, level: str) -> bool:
        """Return whether the variance of a level was estimated separately; the estimate may be zero."""
        return any(part.level == level and part.kind in LEVELS_OF_FORCE for part in self.components)

    def noise_sd(self, friction: np.ndarray) -> np.ndarray:
        """Return the standard deviation of a row's own noise, shape of `friction`."""
        return np.sqrt(self.s0**2 + (self.g * friction) ** 2)

    def level_variance(self, level: str, loads: np.ndarray) -> np.ndarray:
        """Return the variance of rows that is due to one level, shape (n,), from their loads, (n, kinds)."""
        total = np.zeros(len(loads))
        for part in self.components:
            if part.level == level:
                total += part.variance * loads[:, KINDS.index(part.kind)] ** 2
        return total


class Between:
    """Whitening of a few numbers per stroke with independent noise, under the variance components."""

    def __init__(
        self, variance: np.ndarray, loads: np.ndarray, groups: Groups, components: Sequence[Component]
    ) -> None:
        above = [part for part in components if part.variance > 0]
        columns = [np.sqrt(part.variance) * loads[:, KINDS.index(part.kind)] for part in above]
        self.scale = 1 / np.sqrt(variance)
        self.logdet = float(np.log(variance).sum())
        self.steps: list[tuple] = []
        left = np.column_stack(columns) * self.scale[:, None] if above else None
        for k, part in enumerate(above):
            start, code = groups.starts[part.level], groups.codes[part.level]
            load = left[:, k].copy()
            square = np.add.reduceat(load**2, start)
            self.logdet += float(np.log1p(square).sum())
            shrink = (1.0 - 1.0 / np.sqrt(1.0 + square)) / np.maximum(square, 1e-300)
            # A sparse product sums over groups ten times as fast as reduceat.
            inner = csr_array((load * shrink[code], np.arange(load.size), np.r_[start, load.size]))
            self.steps.append((inner, code, load))
            left = self._step(left, *self.steps[-1])

    def __call__(self, numbers: np.ndarray) -> np.ndarray:
        """Return columns over the numbers, shape (m, k), whitened."""
        white = numbers * self.scale[:, None]
        for step in self.steps:
            white = self._step(white, *step)
        return white

    @staticmethod
    def _step(columns: np.ndarray, inner: csr_array, code: np.ndarray, load: np.ndarray) -> np.ndarray:
        return columns - load[:, None] * (inner @ columns)[code]


class Whitening:
    """A root of the inverse covariance of rows with loads, (n, kinds), applied to many columns.

    The groups are nested, strokes first. `logdet` is the log determinant of the covariance.
    """

    def __init__(self, scatter: Scatter, loads: np.ndarray, groups: Groups) -> None:
        friction = loads[:, GAIN]
        finest = next(iter(groups.starts))
        start, code = groups.starts[finest], groups.codes[finest]
        n, m = friction.size, start.size
        self.twice = np.repeat(start, 2)  # first row of the stroke of each of the 2 m numbers
        sd = scatter.noise_sd(friction) * np.sqrt(scatter.design_effect)
        size = np.sqrt(np.bincount(code, sd**-2.0))
        mean = 1 / (sd * size[code])  # unit vector along a stroke's mean, rows in units of their noise
        level = np.bincount(code, mean * friction / sd)
        about = friction / sd - level[code] * mean
        spread = np.sqrt(np.bincount(code, about**2))
        flat = spread <= FLAT * np.abs(level)
        # Unit vector along F - mean.
        about = np.where(flat[code], 0.0, about / np.where(flat, 1.0, spread)[code])
        self.root = np.sqrt(scatter.shape)
        self.unit = 1 / (sd * self.root)
        columns = (2 * code[:, None] + [0, 1]).ravel()
        parts = np.column_stack([mean, about]).ravel(), columns, 2 * np.arange(n + 1)
        self.back = csr_array(parts, shape=(n, 2 * m))
        self.take = csr_array(self.back.T.multiply(1 / sd[None, :]))
        variance, strokes = np.tile([1.0, scatter.shape], m), groups.at(finest).repeated(2)
        self.between = Between(variance, self.take @ loads, strokes, scatter.components)
        self.logdet = self.between.logdet + float(2 * np.log(sd).sum() + (n - 2 * m) * np.log(scatter.shape))

    def normal(self, tangent: Tangent, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return C' V^-1 C, (p, p), and C' V^-1 r, (p,), of a tangent C and a residual whitened already."""
        scaled, numbers = tangent.values * self.unit[:, None], self.take @ tangent.values
        between, kept = self.between(numbers), numbers / self.root
        rows, strokes = tangent.layout, tangent.layout.of(self.twice)
        square = rows.gram(scaled, scaled) + strokes.gram(between, between) - strokes.gram(kept, kept)
        pull = Tangent(strokes, between - kept).against(residual @ self.back)
        return square, tangent.with_values(scaled).against(residual) + pull

    def of(self, tangent: Tangent) -> Tangent:
        """Return a tangent on the rows, whitened."""
        return tangent.with_values(self(tangent.values))

    def __call__(self, columns: np.ndarray) -> np.ndarray:
        """Return columns on the rows, shape (n, k), whitened: rows are uncorrelated with variance 1."""
        white, numbers = columns * self.unit[:, None], self.take @ columns
        white += self.back @ (self.between(numbers) - numbers / self.root)
        return white


def members(links: csr_array) -> list[np.ndarray]:
    """Return the connected groups of a symmetric matrix, those of one size together, (groups, size) each."""
    _, label = connected_components(links, directed=False)
    size, order = np.bincount(label), np.argsort(label, kind="stable")
    start = np.cumsum(size) - size
    return [order[start[size == s][:, None] + np.arange(s)] for s in np.unique(size)]


def blockwise(function: Callable[[np.ndarray], np.ndarray], matrix: csr_array) -> csr_array:
    """Return `function`, (k, s, s) -> (k, s, s), of the independent blocks of a symmetric matrix."""
    rows, columns, found = [], [], []
    for own in members(matrix):
        count, size = own.shape
        row, column = (axis.ravel() for axis in np.broadcast_arrays(own[:, :, None], own[:, None, :]))
        found.append(function(matrix[row, column].reshape(count, size, size)).ravel())
        rows.append(row)
        columns.append(column)
    parts = np.concatenate(found), (np.concatenate(rows), np.concatenate(columns))
    found = csr_array(parts, shape=matrix.shape)
    found.eliminate_zeros()
    return found


def whitening_of(covariance: csr_array) -> csr_array:
    """Return W with W C W' = 1, lower triangular within the independent blocks of C, shape (n, n)."""
    return blockwise(lambda blocks: np.linalg.inv(np.linalg.cholesky(blocks)), covariance)


def log_determinant(white: csr_array) -> float:
    """Return ln det C of the covariance that `whitening_of` was given, from its result."""
    return float(-2 * np.log(white.diagonal()).sum())
