r"""Scatter at several nested levels: its size by REML, and the whitening that makes rows independent.

A residual is noise of its row plus random offsets and gains of its stroke, file, run and specimen,

.. math:: r_i = \epsilon_i + \sum_l (o_{l,g(i)} + k_{l,g(i)} F_i), \quad
          \mathrm{Var}\, o_l = \sigma_{o,l}^2, \ \mathrm{Var}\, k_l = \sigma_{k,l}^2

with F the model's force. Neighbouring rows are alike, and files differ in shape along their strokes: the row noise
counts `alike` times in the mean of a stroke, and `shape` times more often about it. The covariance is a diagonal plus
one rank-one term per group and kind. As groups nest, a symmetric square root of its inverse is a chain of rank-one
updates, exact and linear in the number of rows.

Searle, Casella & McCulloch 1992, *Variance Components*, doi:10.1002/9780470316856 (REML, chapter 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

REVIVED = 0.03  # share at which a component starts though it was nothing before: from zero it could not come back
MOST_GAIN = 0.5  # no rig's gain scatters more: a model near zero with gains of any size would fit every force


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

    def whitened(self, columns: np.ndarray, force: np.ndarray, groups: Groups) -> tuple[np.ndarray, float]:
        """Return `whiten` of some columns, shape (n, k), with this scatter at the model's force, shape (n,)."""
        sd = self.noise_sd(force) * np.sqrt(self.alike)
        return whiten(columns, sd, force, groups, self.components, shape=self.shape)

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


@dataclass(frozen=True, slots=True)
class Groups:
    """Nested groups of sorted rows: for each level, the first row of every group and each row's group number."""

    starts: dict[str, np.ndarray]
    codes: dict[str, np.ndarray]

    @classmethod
    def of(cls, codes: dict[str, np.ndarray]) -> Groups:
        """Return the groups of `codes` (level -> group per row, contiguous, finest level first)."""
        starts, numbers = {}, {}
        for level, code in codes.items():
            change = np.flatnonzero(np.r_[True, code[1:] != code[:-1]])
            starts[level] = change
            numbers[level] = np.repeat(np.arange(change.size), np.diff(np.r_[change, code.size]))
        return cls(starts, numbers)

    def means(self, values: np.ndarray, level: str) -> np.ndarray:
        """Return the mean of `values`, shape (n,) or (n, k), in each group of a level."""
        start = self.starts[level]
        count = np.diff(np.r_[start, values.shape[0]]).astype(float)
        total = np.add.reduceat(values, start, axis=0)
        return total / (count if values.ndim == 1 else count[:, None])

    def at(self, level: str) -> Groups:
        """Return the groups of a table with one row per group of `level`."""
        first = self.starts[level]
        levels = list(self.codes)
        return Groups.of({name: self.codes[name][first] for name in levels[levels.index(level) :]})


def whiten(
    columns: np.ndarray,
    sd: np.ndarray,
    force: np.ndarray,
    groups: Groups,
    components: Sequence[Component],
    *,
    shape: float = 1.0,
) -> tuple[np.ndarray, float]:
    """Return the columns in coordinates where rows are independent with unit variance, and log det of the covariance.

    Parameters
    ----------
    columns : ndarray, shape (n, k)
        Residual, Jacobian columns, candidates: anything that lives on the rows.
    sd : ndarray, shape (n,)
        Standard deviation of each row's own noise.
    force : ndarray, shape (n,)
        The model's force, signed: the loading of a gain.
    groups, components
        Nested groups, and the variance components, finest level first.
    shape : float
        Factor on the rows' variance about the mean of their stroke (the first level of `groups`).
    """
    white = columns / sd[:, None]
    logdet = 2.0 * float(np.log(sd).sum())
    about_mean = _AboutMean(sd, groups, shape) if shape > 1.0 else None
    if about_mean is not None:
        white = about_mean.widened(white)
        logdet += (sd.size - about_mean.start.size) * np.log(shape)
    active = [part for part in components if part.variance > 0]
    loadings = np.empty((sd.size, len(active)))
    for k, part in enumerate(active):
        loadings[:, k] = np.sqrt(part.variance) * (force if part.kind == "gain" else 1.0) / sd
    if about_mean is not None:
        loadings = about_mean.widened(loadings)
    for k, part in enumerate(active):
        start, code = groups.starts[part.level], groups.codes[part.level]
        loading = loadings[:, k].copy()
        square = np.add.reduceat(loading**2, start)
        shrink = (1.0 - 1.0 / np.sqrt(1.0 + square)) / np.maximum(square, 1e-300)
        logdet += float(np.log1p(square).sum())
        for block in (white, loadings[:, k + 1 :]):
            if block.shape[1]:
                inner = np.add.reduceat(loading[:, None] * block, start, axis=0) * shrink[:, None]
                block -= loading[:, None] * inner[code]
    return white, logdet


class _AboutMean:
    """Rows of a stroke (the finest groups) divided by a root of `shape`, all but their weighted mean."""

    def __init__(self, sd: np.ndarray, groups: Groups, shape: float) -> None:
        finest = next(iter(groups.starts))
        self.start, self.code = groups.starts[finest], groups.codes[finest]
        self.unit = 1 / sd
        self.square = np.add.reduceat(self.unit**2, self.start)
        self.root = np.sqrt(shape)

    def widened(self, white: np.ndarray) -> np.ndarray:
        """Return columns, shape (n, k), that had been divided by `sd`."""
        mean = np.add.reduceat(self.unit[:, None] * white, self.start, axis=0) / self.square[:, None]
        return white / self.root + (1 - 1 / self.root) * self.unit[:, None] * mean[self.code]


def reml(
    residual: np.ndarray,
    jacobian: np.ndarray,
    variance: np.ndarray,
    force: np.ndarray,
    groups: Groups,
    kinds: Sequence[tuple[str, str]],
    start: Sequence[float] | None = None,
) -> tuple[Component, ...]:
    """Return the variance components of group means by restricted maximum likelihood.

    Parameters
    ----------
    residual : ndarray, shape (m,)
        Mean residual of each finest group, at the fitted model.
    jacobian : ndarray, shape (m, p)
        Mean tangent of the model; the degrees of freedom it takes are accounted for.
    variance : ndarray, shape (m,)
        Variance of each mean from the rows' own noise.
    force : ndarray, shape (m,)
        Mean force of the model, signed.
    groups : Groups
        Groups of the m means.
    kinds : sequence of (level, kind)
        Components sought, finest level first.
    start : sequence of float, optional
        Variances to start from.
    """
    if not kinds:
        return ()
    basis = orthonormal(jacobian / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300))
    stacked = np.column_stack([basis, residual])
    scale_force = max(float(np.sqrt(np.mean(force**2))), 1e-12)
    total = max(float(np.var(residual)), float(np.mean(variance)), 1e-20)
    unit = np.array([total / (scale_force**2 if kind == "gain" else 1.0) for _, kind in kinds])
    sd = np.sqrt(variance)

    def objective(log_share: np.ndarray) -> float:
        parts = [
            Component(level, kind, float(v)) for (level, kind), v in zip(kinds, unit * np.exp(log_share), strict=True)
        ]
        white, logdet = whiten(stacked, sd, force, groups, parts)
        gram = white.T @ white
        p = basis.shape[1]
        chol = np.linalg.cholesky(gram[:p, :p] + 1e-12 * np.eye(p))
        half = np.linalg.solve(chol, gram[:p, p])
        return 0.5 * (logdet + 2.0 * np.log(np.diag(chol)).sum() + gram[p, p] - half @ half)

    low = np.log(1e-7)
    high = np.log(
        [min(30.0, MOST_GAIN**2 / u) if kind == "gain" else 30.0 for u, (_, kind) in zip(unit, kinds, strict=True)]
    )
    high = np.maximum(high, low + 2.0)
    first = np.full(len(kinds), np.log(0.2)) if start is None else np.log(np.maximum(np.asarray(start) / unit, REVIVED))
    best = minimize(
        objective,
        np.clip(first, low + 1.0, high - 1.0),
        method="L-BFGS-B",
        bounds=[(low, most) for most in high],
        options={"maxiter": 40, "ftol": 1e-7},
    )
    share = np.exp(best.x)
    variances = np.where(share > 1e-5, unit * share, 0.0)
    return tuple(Component(level, kind, float(v)) for (level, kind), v in zip(kinds, variances, strict=True))


def orthonormal(columns: np.ndarray, tolerance: float = 1e-9) -> np.ndarray:
    """Return an orthonormal basis of the columns' span, shape (m, rank)."""
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, size > tolerance * max(size.max(initial=0.0), 1e-300)]
