"""Eq. 15 fitted to the coefficients of many conditions: one law per curve, one unaged value for all curves.

A curve is one quantity (mu_s or mu_c) of one series. Curves of a quantity share mu_0, so their values are
fitted together by generalised least squares. Given mu_0 the series are independent: a and b are eliminated
series by series, many at once as arrays (Golub and Pereyra 1973, SIAM J. Numer. Anal. 10(2), 413-432,
doi:10.1137/0710036). The cost is proportional to the number of series.
"""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import brentq
from scipy.sparse import block_array, csr_array

from sealfit.fit.joint.whitening import members, whitening_of
from sealfit.fit.least_squares import (
    BatchFit,
    Linear,
    Separable,
    damped_inverse,
    even_grid,
    global_optimum,
    levenberg_marquardt,
)

# b is searched from this share of the first aged day to this multiple of the last.
SOONEST, LATEST = 1e-9, 1e3
# Grid points of b per decade. ln(1 + t/b) changes slowly over a decade of b.
PER_DECADE = 8
# Largest relative scatter; if a law is zero, no relative scatter explains its residuals.
MOST_SCATTER = 1e6
# Points along ln b at which the intervals of a and c are computed, and at which b is searched anew.
PROFILED, SCANNED = 17, 120
# Directions of a and ln b with singular values below this share are not determined.
DEPENDENT = 1e-10


def search_limits(days) -> tuple[np.ndarray, np.ndarray]:
    """Return the limits of ln b, shape (...), for tested days, shape (..., n), not all n of them zero."""
    first = np.min(days, axis=-1, where=days > 0, initial=np.inf)
    return np.log(first * SOONEST), np.log(np.max(days, axis=-1) * LATEST)


def solve_law(days, value, weight) -> BatchFit:
    """Return the global weighted least-squares fit of the aging law to many separate curves.

    Days, values and weights, 1/variance or 0 for padding, have the shape (curves, n). In the result `u` is ln
    b, and `coefficients` are mu_0 and a.

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
class Measured:
    """Measured values, each of a specimen or the mean of those of a condition; arrays are (n,).

    The degrees of freedom are those of a covariance estimated from replicates, of differences between values
    and of their common level; 0 if it is known otherwise.
    """

    days: np.ndarray
    value: np.ndarray
    _: KW_ONLY
    size: np.ndarray | None = None  # values to which further scatter is relative; None: the law's
    replicates_df: float = 0.0
    level_df: float = 0.0

    def scale(self, own: np.ndarray) -> np.ndarray:
        """Return the values to which further scatter is relative, shape (n,), given the law's `own`."""
        return np.abs(own) if self.size is None else self.size

    def df(self, left: float, scatter: float, *, level: bool) -> float:
        """Return the degrees of freedom of intervals of a law's values (`level`) or of their differences.

        They are `left`, those of the law's residual, if it shows `scatter` beyond the covariance.
        """
        return left if scatter > 0 else (self.level_df if level else self.replicates_df) or left


@dataclass(frozen=True)
class Values(Measured):
    """Measured values of one rubber; values of one condition are adjacent."""

    origin: np.ndarray  # (n,) int: number of the value's mu_0
    curve: np.ndarray  # (n,) int: number of its curve, -1 for unaged rubber
    covariance: csr_array  # (n, n), or an array

    def __post_init__(self) -> None:
        covariance = csr_array(self.covariance, copy=True)
        covariance.eliminate_zeros()
        object.__setattr__(self, "covariance", covariance)

    @property
    def origins(self) -> int:
        """Number of mu_0."""
        return int(self.origin.max()) + 1

    @property
    def curves(self) -> int:
        """Number of curves."""
        return int(self.curve.max()) + 1

    @cached_property
    def whitening(self) -> csr_array:
        """W with W C W' = 1, shape (n, n)."""
        return whitening_of(self.covariance)

    @cached_property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Limits of ln b per curve, as `search_limits`, shape (curves,) each."""
        first, last = np.full(self.curves, np.inf), np.zeros(self.curves)
        aged = self.curve >= 0
        np.minimum.at(first, self.curve[aged], self.days[aged])
        np.maximum.at(last, self.curve[aged], self.days[aged])
        return np.log(first * SOONEST), np.log(last * LATEST)

    @cached_property
    def places_of_curve(self) -> np.ndarray:
        """Places of mu_0, a and ln b of each curve among the parameters, shape (curves, 3)."""
        m, curve = self.origins, np.arange(self.curves)
        origin, aged = np.zeros(self.curves, int), self.curve >= 0
        origin[self.curve[aged]] = self.origin[aged]
        return np.column_stack([origin, m + curve, m + self.curves + curve])

    @cached_property
    def groups(self) -> "list[EqualGroups]":
        """The values in groups that are independent given mu_0, those of one size together."""
        n, aged = self.value.size, np.flatnonzero(self.curve >= 0)
        member = csr_array((np.ones(aged.size), (aged, self.curve[aged])), shape=(n, self.curves))
        found = {}
        for own in members(block_array([[self.covariance, member], [member.T, None]], format="csr")):
            of_values = (own < n).sum(axis=1)  # values come first
            for count in np.unique(of_values):
                rows, curves = np.split(own[of_values == count], [count], axis=1)
                found[rows.shape[1], curves.shape[1]] = EqualGroups(self, rows, curves - n)
        return list(found.values())

    def part(self, keep) -> "Values":
        """Return some of the values, with origins and curves renumbered."""
        curve = self.curve[keep]
        numbered = np.searchsorted(np.unique(curve[curve >= 0]), curve)
        origin = np.unique(self.origin[keep], return_inverse=True)[1]
        size = None if self.size is None else self.size[keep]
        given = {"days": self.days[keep], "value": self.value[keep], "origin": origin, "size": size}
        curve, covariance = np.where(curve >= 0, numbered, -1), self.covariance[keep][:, keep]
        return replace(self, **given, curve=curve, covariance=covariance)


class EqualGroups:
    """Groups of values and of their curves, of one size each and independent given mu_0.

    A group is a series with its correlated quantities, an unaged condition, or, if batches correlate
    conditions, several of them. `rows`, shape (g, n), and `curves`, (g, w), are its values and curves,
    ascending. Its p parameters are all mu_0, then a, then ln b of its curves; `places`, shape (g, p), are
    their places among all parameters, and `bounds`, shape (2, g, p), their limits.
    """

    def __init__(self, values: Values, rows: np.ndarray, curves: np.ndarray) -> None:
        self.rows, self.curves, self.m, self.width = rows, curves, values.origins, curves.shape[1]
        self.days, self.value = values.days[rows], values.value[rows]
        self.of_origin = values.origin[rows][:, None] == np.arange(self.m)[:, None]
        self.of_curve = values.curve[rows][:, None] == curves[..., None]
        shared = np.tile(np.arange(self.m), (len(rows), 1))
        self.places = np.hstack([shared, self.m + curves, self.m + values.curves + curves])
        self.size = self.m + 2 * values.curves
        self.bounds = np.full((2, *self.places.shape), np.inf)
        self.bounds[0] *= -1
        self.bounds[:, :, self.m + self.width :] = np.array(values.limits)[:, curves]
        row, column = np.broadcast_arrays(rows[:, :, None], rows[:, None, :])
        self.whitening = values.whitening[row.ravel(), column.ravel()].reshape(row.shape)

    def evaluate(self, x: np.ndarray, of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whitened residuals, shape (r, n), and derivatives, (r, p, n), of groups at x, (r, p)."""
        a, u = x[:, self.m : self.m + self.width, None], x[:, self.m + self.width :, None]
        ratio = self.of_curve[of] * self.days[of, None] * np.exp(-u)
        loss = np.log1p(ratio)
        model = (x[:, : self.m, None] * self.of_origin[of]).sum(axis=1) - (a * loss).sum(axis=1)
        slope = np.concatenate([self.of_origin[of], -loss, a * ratio / (1 + ratio)], axis=1)
        columns = np.concatenate([slope, (model - self.value[of])[:, None]], axis=1)
        white = columns @ np.swapaxes(self.whitening[of], 1, 2)
        return white[:, -1], white[:, :-1]

    def at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `evaluate` of all groups; `x`, shape (all,), are all parameters."""
        return self.evaluate(x[self.places], np.arange(len(self.rows)))

    def total(self, each: np.ndarray) -> np.ndarray:
        """Return what is given for the parameters of each group, shape (g, p), added up for all, (all,)."""
        return np.bincount(self.places.ravel(), each.ravel(), minlength=self.size)

    def free(self, x: np.ndarray) -> np.ndarray:
        """Return which parameters of the groups, shape (g, p), are not at a limit of ln b."""
        return (x[self.places] > self.bounds[0]) & (x[self.places] < self.bounds[1])

    def eliminated(self, x: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return whitened derivatives with respect to mu_0 and a column, a and b eliminated, (g, m + 1, n).

        `x`, shape (all,), are all parameters; `column`, shape (g, n), is any whitened column.
        """
        _, slope = self.at(x)
        columns = np.concatenate([slope[:, : self.m], column[:, None]], axis=1)
        if not self.width:
            return columns
        aside = slope[:, self.m :] * self.free(x)[:, self.m :, None]
        scale = np.linalg.norm(aside, axis=2, keepdims=True)
        _, singular, basis = np.linalg.svd(aside / np.where(scale > 0, scale, 1.0), full_matrices=False)
        basis = basis * (singular > DEPENDENT)[..., None]
        return columns - (columns @ np.swapaxes(basis, 1, 2)) @ basis


@dataclass(frozen=True)
class LawFit:
    """Optimum of the joint fit; parameters in the order mu_0 (origins), a (curves), ln b (curves)."""

    values: Values
    x: np.ndarray
    chi2: float

    @property
    def df(self) -> int:
        """Values less parameters."""
        return self.values.value.size - self.x.size

    @cached_property
    def model(self) -> np.ndarray:
        """The law at every value, shape (n,)."""
        return law_model(self.values, self.x)

    @cached_property
    def residuals(self) -> list[np.ndarray]:
        """Whitened residuals of `values.groups`, shape (g, n) each."""
        return [own.at(self.x)[0] for own in self.values.groups]


def law_model(values: Values, x: np.ndarray) -> np.ndarray:
    """Return the law with parameters x at every value, shape (n,)."""
    m, k = values.origins, values.curves
    a, b = np.append(x[m : m + k], 0.0), np.exp(np.append(x[m + k :], 0.0))  # unaged rubber is curve -1
    return x[values.origin] - a[values.curve] * np.log1p(values.days / b[values.curve])


def fit_law(values: Values, start: np.ndarray | None = None) -> LawFit:
    """Return the global generalised least-squares fit of all curves together.

    Every curve is first fitted alone, then all together. Then each b is searched over its whole range until
    none improves the fit. From `start`, the parameters of nearly the same values, the fit is only local.
    """
    if start is not None:
        return _polished(values, start)
    found = _polished(values, _each_alone(values))
    for _ in range(3):
        moved = _rescan(found)
        if moved is None:
            break
        again = _polished(values, moved)
        if not again.chi2 < found.chi2 * (1 - 1e-9):
            break
        found = again
    return found


def _polished(values: Values, start: np.ndarray) -> LawFit:
    """Return the local optimum from a start."""
    groups, endless = values.groups, np.full(values.origins + values.curves, np.inf)

    def evaluate(x, _):
        rests, slopes = zip(*(own.at(x[0]) for own in groups), strict=True)
        slope = np.empty(1, object)
        slope[0] = slopes
        return np.concatenate([rest.ravel() for rest in rests])[None], slope

    low, high = np.r_[-endless, values.limits[0]], np.r_[endless, values.limits[1]]
    x, rss = levenberg_marquardt(evaluate, start[None], low, high, linear=_Eliminating(groups))
    return LawFit(values, x[0], float(rss[0]))


class _Eliminating(Linear):
    """Products for one problem, whose derivatives are a list by groups.

    A step eliminates a and b group by group, solves the remaining equations of mu_0 (Schur complement), and
    substitutes back.
    """

    def __init__(self, groups: list[EqualGroups]) -> None:
        self.groups = groups
        self.ends = np.cumsum([own.rows.size for own in groups])[:-1]

    def _each(self, slope, rest):
        parts = np.split(rest[0], self.ends)
        for own, one, part in zip(self.groups, slope[0], parts, strict=True):
            yield own, one, part.reshape(own.rows.shape)

    def norms(self, slope):
        squares = (own.total((one**2).sum(axis=2)) for own, one in zip(self.groups, slope[0], strict=True))
        return np.sqrt(sum(squares))[None]

    def gradient(self, slope, rest):
        parts = (own.total((one @ part[..., None])[..., 0]) for own, one, part in self._each(slope, rest))
        return sum(parts)[None]

    def step(self, slope, scale, rest, damping):
        m, found = self.groups[0].m, np.zeros(scale.shape)
        normal, kept = np.zeros((m + 1, m + 1)), []
        for own, one, part in self._each(slope, rest):
            one = one * scale[0, own.places, None]
            columns = np.concatenate([one[:, :m], part[:, None]], axis=1)
            normal += np.einsum("gin,gjn->ij", columns, columns)
            if own.width:
                axes, singular, rows = np.linalg.svd(one[:, m:], full_matrices=False)
                along, share = columns @ np.swapaxes(rows, 1, 2), damped_inverse(singular, damping)
                normal -= np.einsum("gik,gk,gjk->ij", along, singular * share, along)
                kept.append((own, axes * share[:, None], along))
        found[0, :m] = np.linalg.solve(normal[:m, :m] + damping * np.eye(m), -normal[:m, m])
        for own, inverse, along in kept:
            left = along[:, m] + found[0, :m] @ along[:, :m]
            found[0, own.places[:, m:]] = -(inverse @ left[..., None])[..., 0]
        return found


def _each_alone(values: Values) -> np.ndarray:
    """Return the parameters if every curve is fitted alone; unaged values enter as their weighted mean."""
    m, k = values.origins, values.curves
    weight = 1 / values.covariance.diagonal()
    aged = np.flatnonzero(values.curve >= 0)
    aged = aged[np.argsort(values.curve[aged], kind="stable")]
    curve = values.curve[aged]
    number = 1 + np.arange(aged.size) - np.searchsorted(curve, curve)
    table = np.zeros((3, k, 1 + int(number.max())))
    table[0] = 1.0
    table[:, curve, number] = values.days[aged], values.value[aged], weight[aged]
    unaged = values.curve < 0
    total = np.bincount(values.origin[unaged], weight[unaged], minlength=m)
    moment = np.bincount(values.origin[unaged], (weight * values.value)[unaged], minlength=m)
    mean = np.divide(moment, total, out=np.zeros(m), where=total > 0)
    origin = values.places_of_curve[:, 0]
    table[:, :, 0] = np.zeros(k), mean[origin], total[origin]
    alone = solve_law(*table)
    start = np.bincount(origin, alone.coefficients[:, 0], minlength=m) / np.bincount(origin, minlength=m)
    return np.concatenate([start, alone.coefficients[:, 1], alone.u])


def _rescan(found: LawFit) -> np.ndarray | None:
    """Return parameters with each b searched over its whole range, others fixed; None if none is better."""
    x, gained = found.x.copy(), False
    for own, rest in zip(found.values.groups, found.residuals, strict=True):
        every, chi2 = np.arange(len(own.rows)), (rest**2).sum(axis=1)
        for place in range(own.width):
            at_a, at_b = own.m + place, own.m + own.width + place
            tried = found.x[own.places]
            target = tried[:, at_a, None] * own.evaluate(tried, every)[1][:, at_a] - rest
            most, best = np.zeros(len(every)), tried[:, [at_a, at_b]]
            for u in np.linspace(own.bounds[0][:, at_b], own.bounds[1][:, at_b], SCANNED):
                tried[:, at_b] = u
                column = own.evaluate(tried, every)[1][:, at_a]
                along, size = (column * target).sum(axis=1), np.maximum((column**2).sum(axis=1), 1e-300)
                more = along**2 / size > most
                most[more] = (along**2 / size)[more]
                best[more] = np.column_stack([along / size, u])[more]
            better = (target**2).sum(axis=1) - most < chi2 - 1e-6 * found.chi2
            x[own.places[better, at_a]], x[own.places[better, at_b]] = best[better].T
            gained |= bool(better.any())
    return x if gained else None


def paule_mandel(chi2: Callable[[float], float], df: float, residual: np.ndarray) -> float:
    """Return the relative scatter that reduces chi-square, a function of it, to its degrees of freedom.

    It is 0 if chi-square is not larger; the search starts at the RMS of the relative residuals. Paule and
    Mandel 1982, J. Res. NBS 87(5), 377-385, doi:10.6028/jres.087.022.
    """
    if df < 1 or not chi2(0.0) > df:  # also if chi-square is NaN
        return 0.0
    high = float(np.sqrt(np.mean(residual**2))) + 1e-9
    while chi2(high) > df and high < MOST_SCATTER:
        high *= 2
    if high >= MOST_SCATTER:
        return MOST_SCATTER
    return float(brentq(lambda tau: chi2(tau) - df, 0.0, high, xtol=1e-6 * high))
