r"""Scatter at several nested levels, and the whitening that makes rows independent.

A residual is noise of its row plus random offsets and gains of its stroke, file, run and specimen,

.. math:: r_i = \epsilon_i + \sum_l (o_{l,g(i)} + k_{l,g(i)} F_{s(i)}), \quad
          \mathrm{Var}\, o_l = \sigma_{o,l}^2, \ \mathrm{Var}\, k_l = \sigma_{k,l}^2

with F_s the model's mean force in the stroke: a gain shifts a stroke as a whole. Neighbouring rows are alike, and files
differ in shape along their strokes: the row noise counts `alike` times in the mean of a stroke, and `shape` times more
often about it. So only the strokes' means, one number each, feel the components; there a root of the inverse covariance
is a chain of rank-one updates, as groups nest: exact and linear in the number of rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from sealfit.fit.groups import Groups


@dataclass(frozen=True, slots=True)
class Component:
    """Variance of one kind of random effect at one level: an `offset` in force units, or a relative `gain`."""

    level: str
    kind: str
    variance: float
    df: float = np.nan


@dataclass(frozen=True, slots=True)
class Scatter:
    """Everything random: row noise sqrt(s0^2 + (gF)^2) and the components above it, finest level first."""

    s0: float
    g: float
    components: tuple[Component, ...] = ()
    alike: float = 1.0  # by which neighbours that resemble each other widen the variance of a mean
    shape: float = 1.0  # by which files' own shapes widen the variance of a pattern along the stroke, beyond that

    def noise_sd(self, force: np.ndarray) -> np.ndarray:
        """Return the standard deviation of a row's own noise, shape of `force`."""
        return np.sqrt(self.s0**2 + (self.g * force) ** 2)

    def level_variance(self, level: str, force: np.ndarray) -> np.ndarray:
        """Return the variance that one level adds to a row at `force`, shape of `force`."""
        total = np.zeros_like(force, dtype=float)
        for part in self.components:
            if part.level == level:
                total += part.variance * (force**2 if part.kind == "gain" else 1.0)
        return total


class Between:
    """Whitening of one number per finest group, whose own noise is independent, under the components above it.

    Parameters
    ----------
    force, sd : ndarray, shape (m,)
        The model's force in each group, signed, which a gain loads on; standard deviation of the number's noise.
    groups : Groups
        Nested groups of the m numbers, one number in each of the finest.
    components : sequence of Component
        Variance components, finest level first.

    Attributes
    ----------
    logdet : float
        log det of the covariance.
    """

    def __init__(self, force: np.ndarray, sd: np.ndarray, groups: Groups, components: Sequence[Component]) -> None:
        finest = next(iter(groups.starts))
        own = sd**2
        above = []
        for part in components:
            if part.variance > 0 and part.level == finest:
                own = own + part.variance * (force**2 if part.kind == "gain" else 1.0)
            elif part.variance > 0:
                load = np.sqrt(part.variance) * (force if part.kind == "gain" else np.ones_like(force))
                above.append((groups.starts[part.level], groups.codes[part.level], load))
        self.scale = 1 / np.sqrt(own)
        self.logdet = float(np.log(own).sum())
        self.steps: list[tuple] = []
        loads = np.column_stack([load for *_, load in above]) * self.scale[:, None] if above else None
        for k, (start, code, _) in enumerate(above):
            load = loads[:, k]
            square = np.add.reduceat(load**2, start)
            self.logdet += float(np.log1p(square).sum())
            shrink = (1.0 - 1.0 / np.sqrt(1.0 + square)) / np.maximum(square, 1e-300)
            self.steps.append((start, code, load.copy(), shrink))
            loads = self._step(loads, *self.steps[-1])

    def __call__(self, numbers: np.ndarray) -> np.ndarray:
        """Return columns over the groups, shape (m, k), in coordinates where they are independent, of unit variance."""
        white = numbers * self.scale[:, None]
        for step in self.steps:
            white = self._step(white, *step)
        return white

    @staticmethod
    def _step(
        columns: np.ndarray, start: np.ndarray, code: np.ndarray, load: np.ndarray, shrink: np.ndarray
    ) -> np.ndarray:
        inner = np.add.reduceat(load[:, None] * columns, start, axis=0) * shrink[:, None]
        return columns - load[:, None] * inner[code]


class Whitening:
    """A root of the inverse covariance of rows, made once and applied to many columns.

    Parameters
    ----------
    scatter : Scatter
        Row noise and components.
    force : ndarray, shape (n,)
        The model's force, signed: what noise and gains load on.
    groups : Groups
        Nested groups of the rows, strokes first.

    Attributes
    ----------
    logdet : float
        log det of the covariance.
    """

    def __init__(self, scatter: Scatter, force: np.ndarray, groups: Groups) -> None:
        finest = next(iter(groups.starts))
        start, code = groups.starts[finest], groups.codes[finest]
        sd = scatter.noise_sd(force) * np.sqrt(scatter.alike)
        size = np.sqrt(np.bincount(code, sd**-2.0))  # of a stroke's ones, in units of the rows' noise
        self.between = Between(groups.means(force, finest), 1 / size, groups.at(finest), scatter.components)
        self.logdet = self.between.logdet + float(
            2 * (np.log(sd).sum() + np.log(size).sum()) + (sd.size - start.size) * np.log(scatter.shape)
        )
        every, root = np.arange(sd.size + 1), np.sqrt(scatter.shape)
        along = 1 / (sd * size[code])  # the unit vector of each stroke
        self.about = 1 / (sd * root)
        self.mean = csr_array((along / (sd * size[code]), every[:-1], np.r_[start, sd.size]))
        self.back = csr_array((along, code, every), shape=(sd.size, start.size))
        self.kept = size / root

    def normal(self, columns: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return C' V^-1 C, shape (k, k), and C' V^-1 r of columns on the rows, shape (n, k): no column is whitened.

        `residual`, shape (n,), is white already.
        """
        mean = self.mean @ columns
        scaled = columns * self.about[:, None]
        between, kept = self.between(mean), mean * self.kept[:, None]
        part = residual @ self.back
        return (
            scaled.T @ scaled + between.T @ between - kept.T @ kept,
            residual @ scaled + part @ (between - kept),
        )

    def __call__(self, columns: np.ndarray) -> np.ndarray:
        """Return columns on the rows, shape (n, k), in coordinates where rows are independent, of unit variance."""
        mean = self.mean @ columns
        white = columns * self.about[:, None]
        white += self.back @ (self.between(mean) - mean * self.kept[:, None])
        return white
