r"""Few units: does one number per specimen, or per run, follow a channel, held against the units' own scatter?

What acts on a quantity and is constant within a specimen shifts each specimen along one direction, the slope of that
quantity. With g_u that direction in specimen u (whitened, of length 1), :math:`\rho_u = g_u^T r_u` is one number a
specimen; what the current model has taken out of them is known, and without it they are independent and of one variance
if specimens scatter alike. A channel's columns then stand against what is left of them by an F test. A few numbers may
look quieter than they are: where runs and files explain their variance of 1, that counts as if eight more had been seen
(moderated F: Smyth 2004, doi:10.2202/1544-6115.1027); where it is the specimens' own, it is known from nothing else.

The same test holds what is constant in runs against their own scatter where there are few of these.

A dozen specimens have too few sign flips for a search of hundreds of candidates, and a strong effect stands in its own
denominator there. The F test needs normal scatter instead; its p-values are adjusted by the largest over all candidates
in draws of such numbers with the same covariance (a rotation test: Langsrud 2005, doi:10.1007/s11222-005-4789-5).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

from sealfit.fit.estimate import Fitted
from sealfit.fit.reml import orthonormal
from sealfit.fit.tangent import Tangent
from sealfit.fit.whitening import Whitening

MANY = 100  # units from which their covariance is not made as a matrix
LEAST_LEFT = 0.01  # of a number's variance: what the model has taken out beyond that is no number any more
KNOWN = 8.0  # degrees of freedom that a variance counts for which runs and files explain
LEAST_KNOWN = 0.5  # of these degrees of freedom; with fewer the scale is free and no draw depends on it
LEAST_ERROR = 4  # degrees of freedom left for the specimens' scatter, with fewer of which nothing is claimed
LEAST_ERROR_OF_RUNS = 3  # the same for runs: three speeds both ways leave three


class SmallSampleTest(NamedTuple):
    """Columns seen as one number per specimen: the quantity, their span there, and how surely it is followed."""

    target: tuple[str, str]
    basis: np.ndarray  # (d, k) orthonormal
    known: float  # degrees of freedom that the variance components count for
    chi2: float  # whitened sum of squares they explain
    log_p: float  # not adjusted
    share: float  # of the columns' sum of squares that is one number a unit
    error_df: int  # numbers left for the units' own scatter
    level: str = "specimen"  # of the units

    @property
    def sure(self) -> bool:
        """Whether enough is left to show the units' own scatter."""
        return self.error_df >= (LEAST_ERROR if self.level == "specimen" else LEAST_ERROR_OF_RUNS)


class Numbers(NamedTuple):
    """One number per specimen along the direction of one quantity."""

    direction: np.ndarray  # (n,) whitened slope, of length 1 in each specimen
    taken: Tangent  # (units, p) of the model's basis along it
    root: np.ndarray | Root  # (d, units) makes the numbers independent, with variance 1
    values: np.ndarray  # (d,), or (units,) with zeros in the other directions
    df: int  # d
    known: float  # degrees of freedom that the variance components count for


class Root:
    r"""A root of the inverse covariance, 1 - T T', of many units' numbers.

    With :math:`T^T T = V S^2 V^T` it is :math:`1 + T V [(1 - S^2)^{-1/2} - 1] S^{-2} V^T T^T`, without the directions
    of which next to nothing is left; only matrices of the size of the model are made.

    Parameters
    ----------
    taken : Tangent, shape (units, p)
        T, which is nothing where `moved` is false.
    moved : ndarray of bool, shape (units,)
        Which units the quantity moves.
    """

    def __init__(self, taken: Tangent, moved: np.ndarray) -> None:
        share, axes = np.linalg.eigh(taken.gram())
        kept = 1 - share > LEAST_LEFT
        grown = np.where(kept, 1 / np.sqrt(np.where(kept, 1 - share, 1.0)) - 1, -1.0)
        self.taken, self.moved, self.df = taken, moved, int(moved.sum() - (~kept).sum())
        small = share < 1e-9  # the limit of the quotient
        self.core = (axes * np.where(small, 0.5, grown / np.where(small, 1.0, share))) @ axes.T

    def __matmul__(self, numbers: np.ndarray) -> np.ndarray:
        """Return numbers of the units, shape (units,) or (units, k), made independent."""
        return (numbers.T * self.moved).T + self.taken @ (self.core @ self.taken.against(numbers))


def small_root(taken: Tangent, moved: np.ndarray) -> np.ndarray:
    """Return the same for few units as a matrix of d rows, in the covariance's own axes, shape (d, units)."""
    dense = taken.toarray()
    share, axes = np.linalg.eigh(np.diag(moved.astype(float)) - dense @ dense.T)
    kept = share > LEAST_LEFT
    return axes[:, kept].T / np.sqrt(share[kept])[:, None]


class ClusterTests:
    """The specimens of a fit as single numbers.

    Parameters
    ----------
    fitted : Fitted
        The current model at its optimum.
    level : str
        Level of the units: nothing is shared between its groups but the model.
    """

    def __init__(self, fitted: Fitted, level: str = "specimen") -> None:
        self.fitted, self.level = fitted, level
        self._numbers: dict[tuple[str, str], Numbers] = {}

    @cached_property
    def _residual(self) -> np.ndarray:
        """Whitened residual less what priors and bounds have kept the fit from taking out of it, shape (n,)."""
        return self.fitted.basis.freed(self.fitted.white_residual)

    @cached_property
    def _finer(self) -> Whitening:
        """What whitens columns where the units themselves do not scatter."""
        fitted, starts = self.fitted, self.fitted.rows.groups.starts
        units = starts[self.level].size  # without repeats a run is a file, and their scatter is one
        finer = tuple(c for c in fitted.scatter.components if starts[c.level].size > units)
        return Whitening(replace(fitted.scatter, components=finer), fitted.friction, fitted.rows.groups)

    def numbers(self, target: tuple[str, str]) -> Numbers:
        """Return the units' numbers along the direction of a quantity: (acts_on, operation)."""
        if target not in self._numbers:
            fitted, groups = self.fitted, self.fitted.rows.groups
            slope = fitted.slope(*target)[:, None]
            white = fitted.whitening(slope)[:, 0]
            size, finer = (groups.sums(w**2, self.level) for w in (white, self._finer(slope)[:, 0]))
            explained = float(np.mean(size[finer > 0] / finer[finer > 0]))
            self._numbers[target] = self.along(white)._replace(known=KNOWN * min(explained, 1.0))
        return self._numbers[target]

    def along(self, white: np.ndarray) -> Numbers:
        """Return the units' numbers along a whitened column, shape (n,); their scatter is known from them alone."""
        groups = self.fitted.rows.groups
        size = np.sqrt(groups.sums(white**2, self.level))
        direction = white * np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)[groups.codes[self.level]]
        taken = self.fitted.basis.sums(groups, self.level, direction)
        root = (Root if size.size > MANY else small_root)(taken, size > 0)
        values = root @ groups.sums(direction * self._residual, self.level)
        return Numbers(direction, taken, root, values, root.df if isinstance(root, Root) else values.size, 0.0)

    def test(self, left: np.ndarray, target: tuple[str, str]) -> SmallSampleTest | None:
        """Return the F test of projected columns, shape (n, k), on a quantity; None with too few units for one."""
        numbers = self.numbers(target)
        columns = self.fitted.rows.groups.sums(numbers.direction[:, None] * left, self.level)
        basis = orthonormal(numbers.root @ columns, 1e-3)
        d, k = numbers.df, basis.shape[1]
        if k == 0 or d == k:
            return None
        chi2 = float(((numbers.values @ basis) ** 2).sum())
        log_p = float(log_p_of(numbers.values[None, :], basis, numbers.known, d)[0])
        share = float((columns**2).sum() / max((left**2).sum(), 1e-300))
        return SmallSampleTest(target, basis, numbers.known, chi2, log_p, share, d - k, self.level)

    def draws(self, count: int, rng: np.random.Generator) -> dict[tuple[str, str], np.ndarray]:
        """Return numbers as chance alone would give them, for each quantity of shape (count, d), correlated as here."""
        groups, known = self.fitted.rows.groups, list(self._numbers.values())

        def covariance(one: Numbers, other: Numbers) -> np.ndarray:
            alike = np.diag(groups.sums(one.direction * other.direction, self.level))
            return one.root @ (alike - one.taken @ other.taken.toarray().T) @ other.root.T

        blocks = [[covariance(one, other) for other in known] for one in known]
        size, axes = np.linalg.eigh(np.block(blocks))
        drawn = rng.standard_normal((count, size.size)) @ (axes * np.sqrt(np.maximum(size, 0.0))).T
        ends = np.cumsum([len(n.values) for n in known])[:-1]
        found = {}
        for (target, numbers), own in zip(self._numbers.items(), np.split(drawn, ends, axis=1), strict=True):
            df = numbers.known  # a variance that counts for so many is as uncertain as that
            scale = np.sqrt(df / rng.chisquare(df, count)) if df > LEAST_KNOWN else np.ones(count)
            found[target] = own * scale[:, None]
        return found


def log_p_of(values: np.ndarray, basis: np.ndarray, known: float, d: int | None = None) -> np.ndarray:
    """Return the log p-value of F for rows of d independent numbers, shape (m, d), against columns (d, k) -> (m,).

    Both may have more places than d, in which neither holds anything.
    """
    d, k = d or basis.shape[0], basis.shape[1]
    explained = ((values @ basis) ** 2).sum(axis=1)
    left = np.maximum((values**2).sum(axis=1) - explained, 1e-300)
    df = known + d - k
    return np.log(np.maximum(fdtrc(k, df, explained / k / ((known + left) / df)), 1e-300))
