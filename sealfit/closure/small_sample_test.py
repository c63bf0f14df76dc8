"""Tests in few units: a slope in each, or a number per specimen or run, against the scatter between units."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.special import chdtrc, fdtrc

from sealfit.closure import criteria
from sealfit.fit.joint import Fitted
from sealfit.fit.joint.rows import CELL
from sealfit.fit.joint.tangent import Tangent
from sealfit.fit.joint.variance_components import orthonormal
from sealfit.fit.joint.whitening import Whitening

# ---------------------------------------------------------------- contrasts
# The mean slope is tested against the scatter of the units' own slopes.
#
# A contrast is one column L of the force, whitened, projected off the tangent space of the model, and of
# length 1. Unit u (a specimen, or a run or file where there are few specimens) gives the score
# :math:`s_u = L_u^T r_u`, and :math:`\hat\beta = \sum_u s_u`. Units may have slopes of their own, so that
# their scores scatter more than by noise. The variance of :math:`\hat\beta` is therefore estimated from the
# units,
#
# .. math:: V = \sum_u \frac{(s_u - h_u \hat\beta)^2}{1 - h_u}, \quad h_u = L_u^T L_u ,
#
# (CR2; Bell & McCaffrey 2002, Survey Methodology 28(2), 169-181) with Satterthwaite's degrees of freedom.

# Smallest variance of a contrast, so that one of noise-free data, 0 of 0, has the p-value 1.
LEAST_VARIANCE = 1e-300
LEAST_FREE = 0.5  # Least share of a contrast in units whose scores other columns do not determine.


class ContrastTest(NamedTuple):
    """Contrasts of one candidate: estimates, their variances from the units, and data for the prior."""

    level: str  # of the units
    slope: np.ndarray  # (m,) estimates, in standard errors by the fitted scatter
    variance: np.ndarray  # (m,) of the estimates, from the units; about 1 if only noise scatters
    df: np.ndarray  # (m,) Satterthwaite degrees of freedom of the variance
    along: np.ndarray  # (m,) whether the contrast varies within strokes
    deviations: np.ndarray  # (units, m) of the scores
    drawn: np.ndarray  # (m, draws) estimates in draws of noise alone
    consistent: np.ndarray  # (m,) whether two to four specimens have the same slope


def contrast_test(
    fitted: Fitted,
    left: np.ndarray,
    level: str,
    noise: np.ndarray | None = None,
    other: np.ndarray | None = None,
) -> ContrastTest | None:
    """Return the contrasts of projected columns, one by one, in units of a level; None with too few.

    The columns of the force, shape (n, k), are whitened and projected; columns of zeros are ignored. `noise`
    has draws of whitened noise, shape (n, draws). Orthonormal columns `other`, shape (n, m), have been taken
    out of the columns, and out of the residual: if they are still in it, the variance is too large.
    """
    groups = fitted.rows.groups
    if groups.starts[level].size < criteria.LEAST_UNITS_OF_SLOPES:
        return None
    size = np.sqrt(np.einsum("ij,ij->j", left, left))
    left = left[:, size > 0] / size[size > 0]
    if left.shape[1] == 0:
        return None
    leverage = groups.sums(left**2, level)
    slope = left.T @ fitted.white_residual
    scores = groups.sums(left * fitted.unit_residual(level)[:, None], level)
    shared = np.zeros((*leverage.shape, 0 if other is None else other.shape[1]))
    for k in range(shared.shape[2]):
        shared[:, :, k] = groups.sums(left * other[:, [k]], level)
    own = own_share(leverage, shared)
    deviations = (scores - leverage * slope) / np.sqrt(own)
    df = satterthwaite_df(leverage, shared)
    # Where the other columns determine the scores of units their deviations are rounding errors.
    free = own > 1 - criteria.LARGEST_LEVERAGE
    known = (df >= criteria.LEAST_DF) & ((leverage * free).sum(axis=0) >= LEAST_FREE)
    if not known.any():
        return None
    variance = np.maximum((deviations**2).sum(axis=0), LEAST_VARIANCE)
    along = along_strokes(fitted, left)
    agree = specimens_agree(fitted, left) if along.any() else shapes_agree(fitted, left)
    parts = (p[known] for p in (slope, variance, df, along))
    drawn = left[:, known].T @ (np.empty((len(left), 0)) if noise is None else noise)
    return ContrastTest(level, *parts, deviations[:, known], drawn, agree[known])


def own_share(leverage: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Return the share of each unit's variance that the contrast and other columns leave, shape (units, m).

    `shared`, shape (units, m, columns), are the products of the contrast and the columns within each unit.
    """
    taken = leverage + (shared**2).sum(axis=2) / np.maximum(leverage, 1e-300)
    return 1 - np.minimum(taken, criteria.LARGEST_LEVERAGE)


def satterthwaite_df(leverage: np.ndarray, shared: np.ndarray | None = None) -> np.ndarray:
    """Return the degrees of freedom of CR2 variances of contrasts, shape (m,), from leverages, (units, m).

    The leverages of a contrast add up to 1, or are all 0: its variance is 0 then, and known. For `shared` see
    `own_share`.
    """
    shared = np.empty((*leverage.shape, 0)) if shared is None else shared
    both = np.concatenate([leverage[:, :, None], shared], axis=2)
    both /= np.sqrt(own_share(leverage, shared))[:, :, None]
    # Sum of the squared elements of the covariance outside its diagonal, which is the leverage.
    products = np.einsum("umi,umj->mij", both, both)
    outside = (products**2).sum(axis=(1, 2)) - ((both**2).sum(axis=2) ** 2).sum(axis=0)
    return 1 / np.maximum((leverage**2).sum(axis=0) + outside, 1e-300)


def specimens_agree(fitted: Fitted, left: np.ndarray) -> np.ndarray:
    """Return whether up to four specimens have equal slopes along each whitened column, shape (n, m) -> (m,).

    Along strokes there must be enough specimens, and slopes that differ by more than noise must meet a
    stricter level; or all slopes must be larger than the scatter of specimens can be.
    """
    found = enough_specimens(fitted, left)
    if not few_specimens(fitted):
        return found
    inside = along_strokes(fitted, left)
    for k in np.flatnonzero(found):
        found[k] = _coefficients_agree(fitted, left[:, [k]], strict=inside[k])
    return found | (inside & (least_share(fitted, left) > criteria.LARGE_SHARE))


def shapes_agree(fitted: Fitted, left: np.ndarray) -> np.ndarray:
    """Return the same for the columns of one shape that is not along strokes: all are true, or none."""
    agree = not few_specimens(fitted) or _coefficients_agree(fitted, orthonormal(left, 1e-3), strict=False)
    return np.full(left.shape[1], agree)


def _coefficients_agree(fitted: Fitted, left: np.ndarray, *, strict: bool) -> bool:
    r"""Return whether two to four specimens agree in their coefficients of orthonormal columns, shape (n, k).

    The mean of the coefficients :math:`b_s` of S specimens is tested against their scatter,

    .. math:: F = \frac{S |\bar b|^2 / k}{\sum_s |b_s - \bar b|^2 / (k (S - 1))} ,

    for one column the square of Student's t. If `strict`, the level is `CONSISTENT_P_IF_DIFFERENT` where the
    coefficients differ by more than noise. Specimens below `LEAST_LEVERAGE` are left out.
    """
    groups = fitted.rows.groups
    share = np.stack([own.T @ own for own in np.split(left, groups.starts["specimen"][1:])])
    score = groups.sums(left * fitted.white_residual[:, None], "specimen")
    leverage = share.trace(axis1=1, axis2=2)
    shown = leverage > criteria.LEAST_LEVERAGE * leverage.sum()
    share, score, k = share[shown], score[shown], left.shape[1]
    if len(share) < 2:
        return True
    own = np.einsum("sij,sj->si", np.linalg.pinv(share, hermitian=True), score)
    df = k * (len(own) - 1)
    between = float(((own - own.mean(axis=0)) ** 2).sum()) / df
    f = len(own) * float((own.mean(axis=0) ** 2).sum()) / k / max(between, 1e-300)
    off = own - np.linalg.solve(share.sum(axis=0), score.sum(axis=0))
    equal = chdtrc(df, np.einsum("si,sij,sj->", off, share, off)) > criteria.DIFFERENT_P
    most = criteria.CONSISTENT_P_IF_DIFFERENT if strict and not equal else criteria.CONSISTENT_P
    return bool(log_p_of_f(f, k, df) < np.log(most))


def _slopes_of_specimens(fitted: Fitted, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return leverage and slope of each specimen along columns, (specimens, m); 0 below `LEAST_LEVERAGE`."""
    sums = fitted.rows.groups.sums
    leverage, scores = sums(left**2, "specimen"), sums(left * fitted.white_residual[:, None], "specimen")
    shown = leverage > criteria.LEAST_LEVERAGE * leverage.sum(axis=0)
    return np.where(shown, leverage, 0.0), np.where(shown, scores / np.where(shown, leverage, 1.0), 0.0)


def least_share(fitted: Fitted, left: np.ndarray) -> np.ndarray:
    """Return the smallest effect of whitened columns, shape (n, m), in any specimen, shape (m,).

    It is the RMS as a share of the force; 0 if specimens differ in sign.
    """
    sums = fitted.rows.groups.sums
    leverage, slopes = _slopes_of_specimens(fitted, left)
    size_N = np.sqrt(sums((left / fitted.whitening.unit[:, None]) ** 2, "specimen"))
    force_N = np.sqrt(sums(fitted.rows.force[:, None] ** 2, "specimen"))
    share = slopes * size_N / force_N
    least, most = (np.where(leverage > 0, share, outside) for outside in (np.inf, -np.inf))
    return np.maximum(np.maximum(least.min(axis=0), -most.max(axis=0)), 0.0)


def enough_specimens(fitted: Fitted, left: np.ndarray) -> np.ndarray:
    """Return whether up to four specimens are enough to agree on each whitened column, shape (n, m) -> (m,).

    Their effective number follows from their leverages. They are always enough for columns not along strokes.
    """
    if not few_specimens(fitted):
        return np.ones(left.shape[1], dtype=bool)
    leverage = fitted.rows.groups.sums(left**2, "specimen")
    many = leverage.sum(axis=0) ** 2 > criteria.LEAST_SPECIMENS * (leverage**2).sum(axis=0)
    return many | ~along_strokes(fitted, left)


def few_specimens(fitted: Fitted) -> bool:
    """Return whether there are too few specimens (up to four) to be the units of a slope."""
    return fitted.rows.groups.starts["specimen"].size < criteria.LEAST_UNITS_OF_SLOPES


def along_strokes(fitted: Fitted, left: np.ndarray) -> np.ndarray:
    """Return whether most of each whitened column varies within strokes, shape (n, m) -> (m,)."""
    sums = fitted.rows.groups.sums
    between = sums(left, "stroke") ** 2 / sums(np.ones(len(left)), "stroke")[:, None]
    return between.sum(axis=0) < 0.5 * (left**2).sum(axis=0)


# ---------------------------------------------------------------- small sample test
# An effect on a quantity that is constant within specimens shifts each specimen along one direction, the
# slope of that quantity. With g_u that direction in specimen u (whitened, of length 1), :math:`\rho_u = g_u^T
# r_u` is one number per specimen. What the model has removed from these numbers is known. Without it they are
# independent, with one variance if all specimens scatter equally, and a channel's columns are tested against
# their residual by F. The variance of a few numbers is uncertain. If runs and files explain it, it gets eight
# prior degrees of freedom (moderated F: Smyth 2004, doi:10.2202/1544-6115.1027); if specimens scatter
# themselves, it has no prior. The same test is used for what is constant in runs, with few runs.
#
# A dozen specimens have too few sign flips for a search of hundreds of candidates. The F test assumes normal
# scatter instead. Its p-values are adjusted by the smallest over all candidates in draws of normal numbers
# with the same covariance (a rotation test: Langsrud 2005, doi:10.1007/s11222-005-4789-5).

MANY = 100  # Number of units from which their covariance is not computed as a matrix.
# Level below which the forces of cells scatter more than the files do.
CELLS_SCATTER_P = 0.05


class SmallSampleTest(NamedTuple):
    """F test of columns that are one number per unit."""

    target: tuple[str, str]
    basis: np.ndarray  # (d, k) orthonormal
    known: float  # prior degrees of freedom, from the variance components
    chi2: float  # whitened sum of squares they explain
    log_p: float  # not adjusted
    share: float  # of the columns' sum of squares that is one number per unit
    error_df: int  # residual degrees of freedom between units
    level: str = "specimen"  # of the units

    @property
    def enough_df(self) -> bool:
        """Whether there are enough residual degrees of freedom between units."""
        between_specimens = self.level == "specimen"
        least = criteria.LEAST_ERROR_DF if between_specimens else criteria.LEAST_ERROR_DF_OF_RUNS
        return self.error_df >= least


class Numbers(NamedTuple):
    """One number per unit along the direction of one quantity."""

    direction: np.ndarray  # (n,) whitened slope, of length 1 in each unit
    taken: Tangent  # (units, p) of the model's basis along it
    root: np.ndarray | Root  # (d, units) whitens the numbers
    values: np.ndarray  # (d,), or (units,) with zeros in the other directions
    df: int  # d
    known: float  # prior degrees of freedom, from the variance components


class Root:
    r"""Inverse root of the covariance 1 - T T' of many units' numbers.

    With :math:`T^T T = V S^2 V^T` it is :math:`1 + T V [(1 - S^2)^{-1/2} - 1] S^{-2} V^T T^T`, without the
    directions that the model determines. All matrices have the size of the model. T is `taken`, shape
    (units, p), 0 for the units that the quantity does not change: those not `moved`, shape (units,).
    """

    def __init__(self, taken: Tangent, moved: np.ndarray) -> None:
        share, axes = np.linalg.eigh(taken.gram())
        kept = 1 - share > criteria.LEAST_OWN_VARIANCE
        factor = np.where(kept, 1 / np.sqrt(np.where(kept, 1 - share, 1.0)) - 1, -1.0)
        self.taken, self.moved, self.df = taken, moved, int(moved.sum() - (~kept).sum())
        small = share < 1e-9  # the limit of the quotient
        self.core = (axes * np.where(small, 0.5, factor / np.where(small, 1.0, share))) @ axes.T

    def __matmul__(self, numbers: np.ndarray) -> np.ndarray:
        """Return whitened numbers of the units, shape (units,) or (units, k)."""
        return (numbers.T * self.moved).T + self.taken @ (self.core @ self.taken.against(numbers))


def small_root(taken: Tangent, moved: np.ndarray) -> np.ndarray:
    """Return the same for few units as a matrix in the principal axes of the covariance, shape (d, units)."""
    dense = taken.toarray()
    share, axes = np.linalg.eigh(np.diag(moved.astype(float)) - dense @ dense.T)
    kept = share > criteria.LEAST_OWN_VARIANCE
    return axes[:, kept].T / np.sqrt(share[kept])[:, None]


class ClusterTests:
    """Tests on one number per unit of a fit; the groups of the level share only the model.

    The level may also be `CELL`. Cells lie across the groups, so that their sums are made here.
    """

    def __init__(self, fitted: Fitted, level: str = "specimen") -> None:
        self.fitted, self.level = fitted, level
        self._numbers: dict[tuple[str, str], Numbers] = {}
        rows = fitted.rows
        self.codes = rows.cells() if level == CELL else rows.codes(level)
        self.units = int(self.codes.max()) + 1

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Return the sum of `values`, shape (n,) or (n, k), over each unit."""
        if self.level != CELL:
            return self.fitted.rows.groups.sums(values, self.level)
        each = np.arange(self.codes.size)
        return csr_array((np.ones(each.size), (self.codes, each)), shape=(self.units, each.size)) @ values

    def _taken(self, direction: np.ndarray) -> Tangent:
        """Return the sums of the model's basis along a direction, shape (n,)."""
        basis = self.fitted.basis
        if self.level != CELL:
            return basis.sums(self.fitted.rows.groups, self.level, direction)
        return Tangent.dense(self.sums(direction[:, None] * basis.toarray()))

    @cached_property
    def _residual(self) -> np.ndarray:
        """Whitened residual off the tangent space, where priors and bounds may leave a part; shape (n,)."""
        return self.fitted.basis.project_out(self.fitted.white_residual)

    @cached_property
    def _finer(self) -> Whitening:
        """Whitening as if the units themselves did not scatter."""
        fitted, starts = self.fitted, self.fitted.rows.groups.starts
        # Without repeats runs and files share their scatter.
        finer = tuple(c for c in fitted.scatter.components if starts[c.level].size > self.units)
        return Whitening(replace(fitted.scatter, components=finer), fitted.loads, fitted.rows.groups)

    def numbers(self, target: tuple[str, str]) -> Numbers:
        """Return the units' numbers along the direction of a quantity: (acts_on, operation)."""
        if target not in self._numbers:
            slope = self.fitted.slope(*target)[:, None]
            white = self.fitted.whitening(slope)[:, 0]
            numbers = self.along(white)
            if self.level == CELL:
                share = float(chdtrc(numbers.df, numbers.values @ numbers.values) > CELLS_SCATTER_P)
            else:
                size, finer = (self.sums(w**2) for w in (white, self._finer(slope)[:, 0]))
                share = min(mean_ratio(size, finer), 1.0)
            self._numbers[target] = numbers._replace(known=criteria.KNOWN_DF * share)
        return self._numbers[target]

    def along(self, white: np.ndarray) -> Numbers:
        """Return the units' numbers along a whitened column, shape (n,), without prior degrees of freedom."""
        size = np.sqrt(self.sums(white**2))
        inverse = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
        direction = white * inverse[self.codes]
        taken = self._taken(direction)
        root = (Root if size.size > MANY else small_root)(taken, size > 0)
        values = root @ self.sums(direction * self._residual)
        df = root.df if isinstance(root, Root) else values.size
        return Numbers(direction, taken, root, values, df, 0.0)

    def share(self, left: np.ndarray, target: tuple[str, str]) -> float:
        """Return the share of projected columns' sum of squares, (n, k), that is one number per unit."""
        columns = self.sums(self.numbers(target).direction[:, None] * left)
        return float((columns**2).sum() / max((left**2).sum(), 1e-300))

    def test(self, left: np.ndarray, target: tuple[str, str]) -> SmallSampleTest | None:
        """Return the F test of projected columns, shape (n, k), on a quantity; None with too few units."""
        numbers = self.numbers(target)
        columns = self.sums(numbers.direction[:, None] * left)
        basis = orthonormal(numbers.root @ columns, 1e-3)
        d, k = numbers.df, basis.shape[1]
        if k == 0 or d == k:
            return None
        chi2 = float(((numbers.values @ basis) ** 2).sum())
        log_p = float(log_p_of_numbers(numbers.values[None, :], basis, numbers.known, d)[0])
        share = self.share(left, target)
        return SmallSampleTest(target, basis, numbers.known, chi2, log_p, share, d - k, self.level)

    def draws(self, count: int, rng: np.random.Generator) -> dict[tuple[str, str], np.ndarray]:
        """Return draws of the numbers under the null hypothesis, shape (count, d), for each quantity."""
        known = list(self._numbers.values())

        def covariance(one: Numbers, other: Numbers) -> np.ndarray:
            shared = np.diag(self.sums(one.direction * other.direction))
            half = one.root @ (shared - one.taken @ other.taken.toarray().T)
            return (other.root @ half.T).T  # a `Root` multiplies from the left only

        blocks = [[covariance(one, other) for other in known] for one in known]
        size, axes = np.linalg.eigh(np.block(blocks))
        drawn = rng.standard_normal((count, size.size)) @ (axes * np.sqrt(np.maximum(size, 0.0))).T
        ends = np.cumsum([len(n.values) for n in known])[:-1]
        found = {}
        for (target, numbers), own in zip(self._numbers.items(), np.split(drawn, ends, axis=1), strict=True):
            df = numbers.known  # the prior variance is that uncertain
            scale = np.sqrt(df / rng.chisquare(df, count)) if df > criteria.LEAST_KNOWN_DF else np.ones(count)
            found[target] = own * scale[:, None]
        return found


def mean_ratio(squares: np.ndarray, finer: np.ndarray) -> float:
    """Return the mean of squares / finer, shape (units,) each, over units where `finer` is not rounding.

    It is 1 if there are none. A derivative far from its Stribeck velocity may underflow in a unit.
    """
    known = finer > 1e-30 * finer.max(initial=0.0)
    return float(np.mean(squares[known] / finer[known])) if known.any() else 1.0


def log_p_of_numbers(values: np.ndarray, basis: np.ndarray, known: float, d: int | None = None) -> np.ndarray:
    """Return log p-values of F for rows of d independent numbers, shape (m, d), and columns (d, k) -> (m,).

    Both may be padded with zeros to more than d.
    """
    return log_p_of_f(*f_of(values, basis, known, d))


def f_of(
    values: np.ndarray, basis: np.ndarray, known: float, d: int | None = None
) -> tuple[np.ndarray, int, float]:
    """Return F, shape (m,), and its two degrees of freedom; arguments as `log_p_of_numbers`."""
    d, k = d or basis.shape[0], basis.shape[1]
    explained = ((values @ basis) ** 2).sum(axis=1)
    left = np.maximum((values**2).sum(axis=1) - explained, 1e-300)
    df = known + d - k
    return explained / k / ((known + left) / df), k, df


def log_p_of_f(f: np.ndarray, k: int, df: float) -> np.ndarray:
    """Return log p-values of F, shape (m,), with k and df degrees of freedom."""
    return np.log(np.maximum(fdtrc(k, df, f), 1e-300))
