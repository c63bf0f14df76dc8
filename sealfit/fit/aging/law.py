"""Eq. 15 fitted to the coefficients of many conditions: one law per curve, one unaged value for all curves.

A curve is one quantity (mu_s or mu_c) of one series. Curves of a quantity share mu_0, so their values are
fitted together by generalised least squares. mu_0 and a are linear; ln b is searched globally, curve by
curve.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import brentq
from scipy.sparse import csr_array

from sealfit.fit.least_squares import (
    BatchFit,
    Separable,
    covariance_of,
    even_grid,
    global_optimum,
    levenberg_marquardt,
)

# b is searched from this share of the first aged day to this multiple of the last.
SOONEST, LATEST = 1e-9, 1e3
# Grid points of b per decade. ln(1 + t/b) changes slowly over a decade of b.
PER_DECADE = 8
# Largest relative scatter. If a law is zero, no relative scatter explains its residuals.
MOST_SCATTER = 1e6
# Number of points along ln b at which the intervals of a and c are computed.
PROFILED = 17


def search_limits(days) -> tuple[np.ndarray, np.ndarray]:
    """Return the limits of ln b, shape (...), for tested days, shape (..., n), not all n of them zero."""
    first = np.min(days, axis=-1, where=days > 0, initial=np.inf)
    return np.log(first * SOONEST), np.log(np.max(days, axis=-1) * LATEST)


def solve_law(days, value, weight) -> BatchFit:
    """Return the global weighted least-squares fit of the aging law to many separate curves.

    Parameters
    ----------
    days, value, weight : ndarray, shape (curves, n)
        Aging time in days, measured value, 1/variance (0 for padding).

    Returns
    -------
    BatchFit
        `u` is ln b; `coefficients` are mu_0 and a.

    Examples
    --------
    >>> t = np.array([[0.0, 1, 2, 4, 8, 16]])
    >>> fit = solve_law(t, 0.9 - 0.05 * np.log1p(t / 0.3), np.ones_like(t))
    >>> [round(float(x), 9) for x in (*fit.coefficients[0], np.exp(fit.u[0]))]
    [0.9, 0.05, 0.3]
    """
    days, value, weight = np.broadcast_arrays(*(np.asarray(x, float) for x in (days, value, weight)))
    low, high = search_limits(np.where(weight > 0, days, 0.0))

    def basis(u, rows):
        ratio = days[rows][:, None, :] * np.exp(-u)[..., None]
        return np.stack([np.ones_like(ratio), -np.log1p(ratio)], axis=-1)

    return global_optimum(Separable(basis, value, weight, (False, False)), even_grid(low, high, PER_DECADE))


@dataclass(frozen=True)
class Values:
    """Measured values of one rubber; values of one condition are adjacent."""

    days: np.ndarray  # (n,)
    value: np.ndarray  # (n,)
    origin: np.ndarray  # (n,) int: number of the value's mu_0
    curve: np.ndarray  # (n,) int: number of its curve, -1 for unaged rubber
    covariance: np.ndarray  # (n, n)
    # (n,), values to which the scatter between specimens is relative; None: the law's own
    size: np.ndarray | None = None
    # degrees of freedom of a covariance estimated from replicates, of differences between values and of their
    # common level; 0 if it is known otherwise
    replicates_df: float = 0.0
    level_df: float = 0.0

    @property
    def origins(self) -> int:
        """Number of mu_0."""
        return int(self.origin.max()) + 1

    @property
    def curves(self) -> int:
        """Number of curves."""
        return int(self.curve.max()) + 1

    @cached_property
    def whitening(self) -> np.ndarray:
        """W with W C W' = 1, shape (n, n); block diagonal where only adjacent values are correlated."""
        n = self.value.size
        linked = np.abs(self.covariance) > 0
        reach = np.array([np.flatnonzero(row)[-1] for row in linked])
        ends = np.flatnonzero(np.maximum.accumulate(reach) == np.arange(n)) + 1
        inverse, start = np.zeros((n, n)), 0
        for end in ends:
            block = slice(start, end)
            inverse[block, block] = np.linalg.inv(np.linalg.cholesky(self.covariance[block, block]))
            start = end
        return inverse

    def part(self, keep) -> Values:
        """Return some of the values, with origins and curves renumbered."""
        curve = self.curve[keep]
        numbered = np.searchsorted(np.unique(curve[curve >= 0]), curve)
        return Values(
            self.days[keep],
            self.value[keep],
            np.unique(self.origin[keep], return_inverse=True)[1],
            np.where(curve >= 0, numbered, -1),
            self.covariance[np.ix_(keep, keep)],
            None if self.size is None else self.size[keep],
            self.replicates_df,
            self.level_df,
        )

    def scale(self, model: np.ndarray) -> np.ndarray:
        """Return the values to which the scatter is relative, shape (n,), given the law's."""
        return np.abs(model) if self.size is None else self.size


@dataclass(frozen=True)
class LawFit:
    """Optimum of the joint fit; parameters in the order mu_0 (origins), a (curves), ln b (curves)."""

    values: Values
    x: np.ndarray
    chi2: float
    limits: tuple[np.ndarray, np.ndarray]  # of ln b per curve

    @cached_property
    def jacobian(self) -> np.ndarray:
        """Derivative of the model, not whitened, shape (n, p)."""
        return law_model(self.values, self.x)[1]

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the parameters, shape (p, p), by `covariance_of`; 0 for a ln b at a limit."""
        free = np.ones(self.x.size, bool)
        free[-self.values.curves :] = (self.x[-self.values.curves :] > self.limits[0]) & (
            self.x[-self.values.curves :] < self.limits[1]
        )
        return covariance_of(self.values.whitening @ self.jacobian, free)[0]

    @property
    def df(self) -> int:
        """Values less parameters."""
        return self.values.value.size - self.x.size

    @property
    def model(self) -> np.ndarray:
        """The law at every value, shape (n,)."""
        return law_model(self.values, self.x)[0]


def law_model(values: Values, x) -> tuple[np.ndarray, np.ndarray]:
    """Return the law at every value, shape (n,), and its derivative, shape (n, p)."""
    m, k, n = values.origins, values.curves, values.value.size
    a, u = x[m : m + k], x[m + k :]
    jacobian = np.zeros((n, x.size))
    every = np.arange(n)
    jacobian[every, values.origin] = 1.0
    aged = every[values.curve >= 0]
    curve = values.curve[aged]
    ratio = values.days[aged] * np.exp(-u[curve])
    loss = np.log1p(ratio)
    jacobian[aged, m + curve] = -loss
    jacobian[aged, m + k + curve] = a[curve] * ratio / (1 + ratio)
    model = x[values.origin].copy()
    model[aged] -= a[curve] * loss
    return model, jacobian


def fit_law(values: Values, start: np.ndarray | None = None) -> LawFit:
    """Return the global generalised least-squares fit of all curves together.

    Every curve is first fitted alone (with the unaged values of its quantity). Then all are fitted together
    from this start. Then each b is searched over its whole range with the other parameters fixed, until none
    improves the fit.

    Parameters
    ----------
    values : Values
        At least one value per parameter.
    start : ndarray, shape (p,), optional
        Parameters of a fit to nearly the same values, for a local fit only.
    """
    m, k = values.origins, values.curves
    whiten = csr_array(values.whitening)
    limits = np.array([search_limits(values.days[values.curve == c]) for c in range(k)]).reshape(k, 2).T
    low, high = (
        np.concatenate([np.full(m + k, end), own]) for end, own in zip((-np.inf, np.inf), limits, strict=True)
    )

    def evaluate(x, _rows):
        model, slope = law_model(values, x[0])
        return (whiten @ (model - values.value))[None], (whiten @ slope).T[None]

    def polished(x):
        found, rss = levenberg_marquardt(evaluate, x[None], low, high)
        return LawFit(values, found[0], float(rss[0]), (limits[0], limits[1]))

    if start is not None:
        return polished(start)
    found = polished(_each_alone(values))
    for _ in range(3):
        moved = _rescan(found)
        if moved is None:
            break
        again = polished(moved)
        if not again.chi2 < found.chi2 * (1 - 1e-9):
            break
        found = again
    return found


def _each_alone(values: Values) -> np.ndarray:
    m, k = values.origins, values.curves
    members = []
    for c in range(k):
        own = values.curve == c
        shared = (values.curve < 0) & (values.origin == values.origin[own][0])
        members.append(np.flatnonzero(own | shared))
    longest = max(len(rows) for rows in members)
    days, value, weight = np.ones((k, longest)), np.zeros((k, longest)), np.zeros((k, longest))
    variance = np.diag(values.covariance)
    for c, rows in enumerate(members):
        days[c, : len(rows)], value[c, : len(rows)] = values.days[rows], values.value[rows]
        weight[c, : len(rows)] = 1 / variance[rows]
    alone = solve_law(days, value, weight)
    start_0 = [
        np.mean([alone.coefficients[c, 0] for c in range(k) if values.origin[values.curve == c][0] == q])
        for q in range(m)
    ]
    return np.concatenate([start_0, alone.coefficients[:, 1], alone.u])


def _rescan(found: LawFit) -> np.ndarray | None:
    """Return parameters with each b searched over its whole range, others fixed; None if none is better."""
    values, limits, whiten = found.values, found.limits, found.values.whitening
    m, k = values.origins, values.curves
    x, gained = found.x.copy(), False
    rest = values.value - found.model
    for c in range(k):
        rows = np.flatnonzero(values.curve == c)
        u = np.linspace(limits[0][c], limits[1][c], 120)
        columns = -np.log1p(values.days[rows] * np.exp(-u)[:, None])
        without = rest.copy()
        without[rows] += x[m + c] * -np.log1p(values.days[rows] * np.exp(-x[m + k + c]))
        target = whiten @ without
        white = columns @ whiten[:, rows].T
        gain = (white @ target) ** 2 / np.maximum(np.einsum("gn,gn->g", white, white), 1e-300)
        best = int(np.argmax(gain))
        if target @ target - gain[best] < found.chi2 * (1 - 1e-6):
            x[m + k + c], x[m + c] = u[best], white[best] @ target / (white[best] @ white[best])
            gained = True
    return x if gained else None


def between_scatter(values: Values) -> tuple[float, LawFit]:
    """Return the relative scatter of a quantity's values beyond their covariance, and the fit without it.

    The variance of every value is increased by (scatter times the law or `size`)^2; the estimate is Paule and
    Mandel's.
    """
    plain = fit_law(values)
    if plain.df <= 0 or plain.chi2 <= plain.df:
        return 0.0, plain
    scale = values.scale(plain.model)

    def chi2(tau: float) -> float:
        covariance = values.covariance + np.diag((tau * scale) ** 2)
        return fit_law(replace(values, covariance=covariance), plain.x).chi2

    return paule_mandel(chi2, plain.df, (plain.model - values.value) / scale), plain


def paule_mandel(chi2: Callable[[float], float], df: float, residual: np.ndarray) -> float:
    """Return the relative scatter that reduces chi-square to its degrees of freedom; 0 if it is not larger.

    Parameters
    ----------
    chi2 : callable
        Chi-square as a function of the scatter, with which it falls.
    df : float
        Its degrees of freedom.
    residual : ndarray
        Relative residuals; the search starts at their RMS.

    Notes
    -----
    Paule and Mandel 1982, J. Res. NBS 87(5), 377-385, doi:10.6028/jres.087.022.
    """
    if df < 1 or not chi2(0.0) > df:  # also if chi-square is NaN
        return 0.0
    high = float(np.sqrt(np.mean(residual**2))) + 1e-9
    while chi2(high) > df and high < MOST_SCATTER:
        high *= 2
    if high >= MOST_SCATTER:
        return MOST_SCATTER
    return float(brentq(lambda tau: chi2(tau) - df, 0.0, high, xtol=1e-6 * high))
