r"""Contrasts in few units: does the same slope show in all of them, beyond the scatter of the units' own slopes?

A contrast is one column L of the force, whitened, projected on what the current model leaves open, and of length 1.
Unit u (a specimen, or a run or file where there are few specimens) gives the score :math:`s_u = L_u^T r_u`, and
:math:`\hat\beta = \sum_u s_u`. Units may have slopes of their own, so that their scores scatter more than the noise
inside them says. The variance of :math:`\hat\beta` is therefore taken from the units,

.. math:: V = \sum_u \frac{(s_u - h_u \hat\beta)^2}{1 - h_u}, \quad h_u = L_u^T L_u ,

(CR2; Bell & McCaffrey 2002, Survey Methodology 28(2), 169-181) with Satterthwaite's degrees of freedom. With a dozen
units V is uncertain. What all contrasts of a kind show of it is a prior for each of them: moderated t (Smyth 2004,
doi:10.2202/1544-6115.1027). Contrasts overlap, so the prior counts for no more degrees of freedom than their scores
have independent directions. An effect stands in the scatter of all contrasts but its own, so V alone is tried as well:
the p-value is twice the smaller of the two. P-values are adjusted for the number of contrasts (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtrc, log_ndtr, polygamma, psi, stdtr

from sealfit.fit.estimate import Fitted

LEAST_UNITS = 5
"""Units from which slopes are compared between them."""

LEAST_DF = 1.5
"""Satterthwaite degrees of freedom below which one or two units hold nearly all of a contrast: it is not tested."""

MOST_DF = 1e4
"""Degrees of freedom of a prior that the contrasts' variances do not contradict: as good as known."""

WAYS = 2
"""Variances that a contrast is held against: moderated, and its own. Each has half of the error."""

LARGEST_LEVERAGE = 0.98
"""Of a unit in a contrast; one with more owns it, and nothing else says how it scatters."""


SHOWN = 0.05
"""Leverage from which a specimen says something of a contrast."""

AGREE = 0.1
"""P-value of Student's t over two to four specimens, above which their own slopes do not agree."""

CLOSELY = 0.005
"""The same p-value where the slopes differ by more than noise, so that they may agree by chance."""

DIFFER = 0.05
"""P-value of chi-squared below which the slopes of specimens differ by more than noise."""

LEAST_SPECIMENS = 2.5
"""Specimens, counted by their leverages, from which slopes along strokes may agree: two do too often by chance."""

LARGE = 0.01
"""Share of the force, root mean square: what changes along the strokes of every specimen by more, and the same way, is
no scatter of specimens. A straight line of that size changes by 3.5 % from end to end."""


class ContrastTest(NamedTuple):
    """Contrasts of one candidate: estimates, their variances from the units, and what the prior needs."""

    level: str  # of the units
    slope: np.ndarray  # (m,) estimates, in standard errors of the fitted scatter
    variance: np.ndarray  # (m,) of the estimates, from the units' own scatter; about 1 where only the noise scatters
    df: np.ndarray  # (m,) Satterthwaite degrees of freedom of the variance
    along: np.ndarray  # (m,) whether the contrast lies inside strokes
    deviations: np.ndarray  # (units, m) of the scores
    agree: np.ndarray  # (m,) whether the few specimens in which the units lie have the same slope


class Prior(NamedTuple):
    """Variance that contrasts of a kind share, and for how many degrees of freedom it counts."""

    variance: float
    df: float


def contrast_test(fitted: Fitted, left: np.ndarray, level: str) -> ContrastTest | None:
    """Return the contrasts of projected columns, each by itself; None with too few units.

    Parameters
    ----------
    fitted : Fitted
        The current model at its optimum.
    left : ndarray, shape (n, k)
        Columns of the force, whitened and projected; columns of zeros are left out.
    level : str
        Level of the units.
    """
    groups = fitted.rows.groups
    if groups.starts[level].size < LEAST_UNITS:
        return None
    size = np.sqrt(np.einsum("ij,ij->j", left, left))
    left = left[:, size > 0] / size[size > 0]
    if left.shape[1] == 0:
        return None
    leverage = groups.sums(left**2, level)
    slope = left.T @ fitted.white_residual
    scores = groups.sums(left * fitted.unit_residual(level)[:, None], level)
    deviations = (scores - leverage * slope) / np.sqrt(1 - np.minimum(leverage, LARGEST_LEVERAGE))
    df = satterthwaite_df(leverage)
    known = df >= LEAST_DF
    if not known.any():
        return None
    parts = (slope, (deviations**2).sum(axis=0), df, along_strokes(fitted, left))
    return ContrastTest(level, *(p[known] for p in parts), deviations[:, known], specimens_agree(fitted, left)[known])


def satterthwaite_df(leverage: np.ndarray) -> np.ndarray:
    """Return the degrees of freedom of CR2 variances of contrasts, shape (m,), from leverages, shape (units, m).

    The leverages of a contrast add up to 1.
    """
    shared = leverage**2 / (1 - np.minimum(leverage, LARGEST_LEVERAGE))
    return 1 / ((leverage**2).sum(axis=0) + shared.sum(axis=0) ** 2 - (shared**2).sum(axis=0))


def specimens_agree(fitted: Fitted, left: np.ndarray) -> np.ndarray:
    """Return whether up to four specimens show the same slope along each whitened column, shape (n, m) -> (m,).

    From `LEAST_UNITS` on they are the units themselves. Along strokes each has a slope of its own, so there they must
    be enough, and agree closely where they differ by more than noise; or all their slopes must be larger than specimens
    have them.
    """
    found = enough_specimens(fitted, left)
    if not few_specimens(fitted):
        return found
    inside = along_strokes(fitted, left)
    leverage, every = _slopes_of_specimens(fitted, left)
    for k in np.flatnonzero(found):
        shown = leverage[:, k] > 0
        own, slopes = leverage[shown, k], every[shown, k]
        if slopes.size < 2:
            continue
        t = slopes.mean() / max(np.std(slopes) / np.sqrt(slopes.size - 1), 1e-300)
        log_p = log_p_of_t(t, np.array(slopes.size - 1.0))
        alike = chdtrc(slopes.size - 1, own @ (slopes - np.average(slopes, weights=own)) ** 2) > DIFFER
        found[k] = log_p < np.log(AGREE if alike or not inside[k] else CLOSELY)
    return found | (inside & (least_share(fitted, left) > LARGE))


def _slopes_of_specimens(fitted: Fitted, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return leverage and slope of each specimen along whitened columns, shape (specimens, m); 0 where not `SHOWN`."""
    sums = fitted.rows.groups.sums
    leverage, scores = sums(left**2, "specimen"), sums(left * fitted.white_residual[:, None], "specimen")
    shown = leverage > SHOWN * leverage.sum(axis=0)
    return np.where(shown, leverage, 0.0), np.where(shown, scores / np.where(shown, leverage, 1.0), 0.0)


def least_share(fitted: Fitted, left: np.ndarray) -> np.ndarray:
    """Return what whitened columns, shape (n, m), hold of the residual in the specimen that shows least of it, (m,).

    It is a share of the force, root mean square, and 0 where specimens differ in sign.
    """
    sums = fitted.rows.groups.sums
    leverage, slopes = _slopes_of_specimens(fitted, left)
    size_N = np.sqrt(sums((left / fitted.whitening.unit[:, None]) ** 2, "specimen"))
    force_N = np.sqrt(sums(fitted.rows.force[:, None] ** 2, "specimen"))
    share = slopes * size_N / force_N
    least, most = (np.where(leverage > 0, share, outside) for outside in (np.inf, -np.inf))
    return np.maximum(np.maximum(least.min(axis=0), -most.max(axis=0)), 0.0)


def enough_specimens(fitted: Fitted, left: np.ndarray) -> np.ndarray:
    """Return whether up to four specimens could agree on each whitened column at all, shape (n, m) -> (m,).

    They are counted by their leverages. Of columns that do not lie along strokes they always could.
    """
    if not few_specimens(fitted):
        return np.ones(left.shape[1], dtype=bool)
    leverage = fitted.rows.groups.sums(left**2, "specimen")
    many = leverage.sum(axis=0) ** 2 > LEAST_SPECIMENS * (leverage**2).sum(axis=0)
    return many | ~along_strokes(fitted, left)


def few_specimens(fitted: Fitted) -> bool:
    """Return whether up to four specimens were tested: too few to be the units of a slope."""
    return fitted.rows.groups.starts["specimen"].size < LEAST_UNITS


def along_strokes(fitted: Fitted, left: np.ndarray) -> np.ndarray:
    """Return whether most of each whitened column varies inside strokes, shape (n, m) -> (m,)."""
    sums = fitted.rows.groups.sums
    between = sums(left, "stroke") ** 2 / sums(np.ones(len(left)), "stroke")[:, None]
    return between.sum(axis=0) < 0.5 * (left**2).sum(axis=0)


def slope_log_p(tests: Sequence[ContrastTest]) -> list[np.ndarray]:
    """Return the log p-values of the contrasts of several candidates, two-sided, not adjusted for their number."""
    found = []
    for test, (variance, df) in zip(tests, moderated(tests), strict=True):
        logs = [log_p_of_t(test.slope / np.sqrt(v), d) for v, d in ((variance, df), (test.variance, test.df))]
        found.append(np.minimum(np.log(WAYS) + np.minimum(*logs), 0.0))
    return found


def moderated(tests: Sequence[ContrastTest]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return for each test the variances of its contrasts, moderated by all of a kind, and their degrees of freedom."""
    priors = {kind: _prior(tests, *kind) for kind in {(t.level, bool(a)) for t in tests for a in t.along}}
    found = []
    for test in tests:
        own = [priors[test.level, bool(a)] for a in test.along]
        known, variance = (np.array(part) for part in zip(*[(p.df, p.variance) for p in own], strict=True))
        df = test.df + known
        found.append(((known * variance + test.df * test.variance) / df, df))
    return found


def log_p_of_t(t: np.ndarray, df: np.ndarray) -> np.ndarray:
    """Return the two-sided log p-value of Student's t, shape of `t`."""
    tail = np.log(np.maximum(stdtr(df, -np.abs(t)), 1e-300))
    return np.log(2) + np.where(df >= MOST_DF, log_ndtr(-np.abs(t)), tail)


def _prior(tests: Sequence[ContrastTest], level: str, along: bool) -> Prior:
    """Return the prior of the variances of one kind of contrast, by moments of their logarithms (Smyth 2004, 6.2)."""
    chosen = [(t, t.along == along) for t in tests if t.level == level]
    variance, df = (np.concatenate([getattr(t, name)[own] for t, own in chosen]) for name in ("variance", "df"))
    deviations = np.concatenate([t.deviations[:, own] for t, own in chosen], axis=1)
    mean, spread = _log_moments(variance, df)
    known = _degrees_of_freedom(spread)
    half = known / 2
    typical = float(np.exp(mean + (psi(half) - np.log(half) if known < MOST_DF else 0.0)))
    return Prior(typical, min(known, (_independent(deviations) - 1) * float(np.median(df))))


def _log_moments(variance: np.ndarray, df: np.ndarray) -> tuple[float, float]:
    """Return mean and variance of the logarithms of true variances, sampling error taken out."""
    half = df / 2
    logs = np.log(np.maximum(variance, 1e-12)) - psi(half) + np.log(half)
    spread = float(np.var(logs, ddof=1) - np.mean(polygamma(1, half))) if logs.size > 1 else 0.0
    return float(np.mean(logs)), spread


def _degrees_of_freedom(spread: float) -> float:
    """Return d such that the logarithm of a scaled inverse chi-squared of d degrees has this variance."""
    if spread <= polygamma(1, MOST_DF / 2):
        return MOST_DF
    if spread >= polygamma(1, 1e-3):
        return 0.0
    return float(2 * np.exp(brentq(lambda x: polygamma(1, np.exp(x)) - spread, np.log(1e-3), np.log(MOST_DF / 2))))


def _independent(deviations: np.ndarray) -> float:
    """Return of how many independent directions the columns of scores behave like: (tr R)^2 / tr R^2, at least 1."""
    size = np.sqrt((deviations**2).sum(axis=0))
    alike = deviations[:, size > 0] / size[size > 0]
    if alike.shape[1] == 0:
        return 1.0
    inner = alike @ alike.T  # has the same trace of its square as the matrix between columns, and is smaller
    return float(max(alike.shape[1] ** 2 / (inner**2).sum(), 1.0))
