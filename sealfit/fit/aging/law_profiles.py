"""Profile-likelihood intervals of the aging law's a, b and c, curve by curve of a joint fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from sealfit.fit.aging.law import PROFILED, LawFit, Values, law_model
from sealfit.fit.least_squares import covariance_of, levenberg_marquardt

# Tolerance of the ends of intervals in ln b: 0.1 % of b.
CLOSE = 1e-3
# The first step along ln b from the optimum outwards; each further step is twice as long.
FIRST_STEP = 0.25


@dataclass(frozen=True)
class CurveInterval:
    """95 % intervals of one curve; an open end is 0 or inf for b, -inf or inf for a and c."""

    a: tuple[float, float]
    b: tuple[float, float]
    c: tuple[float, float]


End = tuple[float, bool]  # of an interval of ln b, and whether it is open


def curve_intervals(fit: LawFit, rise_of_origin: np.ndarray) -> list[CurveInterval]:
    """Return the profile-likelihood intervals of every curve.

    The interval of b is where the least chi-square at fixed ln b exceeds the minimum by at most the rise.
    Those of a and c = -a ln b, which are linear in a at fixed b, are the unions of their intervals over these
    b.

    Parameters
    ----------
    fit : LawFit
        Joint fit.
    rise_of_origin : ndarray, shape (origins,)
        t^2 of each quantity.
    """
    values = fit.values
    linked = _linked(values)
    rows = [np.flatnonzero(np.isin(values.curve, curves)) for curves in linked]
    intervals: dict[int, CurveInterval] = {}
    for curves, own, others in zip(linked, rows, _other_series(fit, linked, rows), strict=True):
        series = _Series(fit, curves, own, *others)
        for place, curve in enumerate(curves):
            rise = float(rise_of_origin[values.origin[values.curve == curve][0]])
            intervals[curve] = _curve_interval(series, place, rise)
    return [intervals[curve] for curve in range(values.curves)]


def _curve_interval(series: _Series, place: int, rise: float) -> CurveInterval:
    """Return the interval of one curve of a series; `rise` is that of chi-square above its minimum."""
    limit, log_b = series.chi2 + rise, float(series.x[series.b_at(place)])
    low, high = (_end(series, place, sign, limit) for sign in (-1, 1))
    points = np.unique([*np.linspace(low[0], high[0], PROFILED), log_b])
    chi2, a, variance = np.array([series.profile(place, u) for u in points]).T
    room = limit - chi2
    half = np.sqrt(np.where(room > 0, room * variance, 0.0))
    return _interval(points, a, half, low, high)


class _Series:
    """The curves of one series, with its values and a Gaussian likelihood of mu_0 from the other series.

    mu_0 hardly changes along a profile, so that the laws of the other series may be linearised. The
    parameters of a series are its mu_0, then a, then ln b of its curves.

    Parameters
    ----------
    fit : LawFit
        Joint fit.
    curves : list of int
        The curves of the series.
    rows : ndarray of int, shape (n,)
        Its values.
    root, miss : ndarray, shape (k, m) and (k,)
        The chi-square of the other series is |root (mu_0 - fitted) + miss|^2.

    Attributes
    ----------
    x : ndarray, shape (p,)
        Its parameters at the joint optimum.
    chi2 : float
        Chi-square there.
    """

    def __init__(
        self, fit: LawFit, curves: list[int], rows: np.ndarray, root: np.ndarray, miss: np.ndarray
    ) -> None:
        self.values, self.root, self.miss = fit.values.part(rows), root, miss
        m, k = fit.values.origins, fit.values.curves
        places = np.r_[np.unique(fit.values.origin[rows]), m + np.array(curves), m + k + np.array(curves)]
        self.x, self.m, self.width = fit.x[places], root.shape[1], len(curves)
        endless = np.full(self.m + self.width, np.inf)
        self.low, self.high = np.r_[-endless, fit.limits[0][curves]], np.r_[endless, fit.limits[1][curves]]
        self.chi2 = float((self._evaluate(self.x[None])[0] ** 2).sum())

    def b_at(self, place: int) -> int:
        """Return the index of ln b of a curve among the parameters."""
        return self.m + self.width + place

    def profile(self, place: int, log_b: float) -> tuple[float, float, float]:
        """Return the least chi-square, a and the variance of a at a fixed ln b of one curve."""
        x, low, high = self.x.copy(), self.low.copy(), self.high.copy()
        x[self.b_at(place)] = low[self.b_at(place)] = high[self.b_at(place)] = log_b
        found, chi2 = levenberg_marquardt(lambda x, _: self._evaluate(x), x[None], low, high)
        free = (found[0] > low) & (found[0] < high)
        covariance, _ = covariance_of(self._evaluate(found)[1][0].T, free)
        at = self.m + place
        return float(chi2[0]), float(found[0, at]), float(covariance[at, at])

    def _evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whitened residuals, shape (1, n + k), and the derivative; mu_0 from other series is last."""
        model, slope = law_model(self.values, x[0])
        white = self.values.whitening
        others = np.zeros((self.miss.size, x.size))
        others[:, : self.m] = self.root
        rest = np.r_[white @ (model - self.values.value), self.root @ (x[0] - self.x)[: self.m] + self.miss]
        return rest[None], np.concatenate([white @ slope, others]).T[None]


def _interval(log_b: np.ndarray, a: np.ndarray, half: np.ndarray, low: End, high: End) -> CurveInterval:
    """Return the interval of a curve from a and its half-width at fixed values of ln b between the ends."""
    around = {
        name: [
            float((factor * a - np.abs(factor) * half).min()),
            float((factor * a + np.abs(factor) * half).max()),
        ]
        for name, factor in (("a", 1.0), ("c", -log_b))
    }
    signs = [end for end, reached in ((1, around["a"][1] > 0), (0, around["a"][0] < 0)) if reached]
    for outer in signs:
        endless = np.inf if outer else -np.inf
        if high[1]:  # a grows without bound with b
            around["a"][outer], around["c"][1 - outer] = endless, -endless
        if low[1]:  # c grows without bound as b goes to 0
            around["c"][outer] = endless
    b = (0.0 if low[1] else float(np.exp(low[0])), np.inf if high[1] else float(np.exp(high[0])))
    return CurveInterval(tuple(around["a"]), b, tuple(around["c"]))


def _end(series: _Series, place: int, sign: int, limit: float) -> End:
    """Return ln b where the profile reaches the limit, from the optimum outwards, and whether it is open."""
    at = series.b_at(place)
    near, edge = float(series.x[at]), float((series.low, series.high)[sign > 0][at])

    def above(log_b: float) -> float:
        return series.profile(place, log_b)[0] - limit

    step = FIRST_STEP
    while sign * (edge - near) > 0:
        far = sign * min(sign * (near + sign * step), sign * edge)
        if above(far) > 0:
            return float(brentq(above, near, far, xtol=CLOSE)), False
        near, step = far, 2 * step
    return near, True


def _linked(values: Values) -> list[list[int]]:
    """Return groups of curves with correlated values: the quantities of one series."""
    group = list(range(values.curves))
    rows, columns = np.nonzero(values.covariance)
    for one, other in set(zip(values.curve[rows].tolist(), values.curve[columns].tolist(), strict=True)):
        if one >= 0 and other >= 0 and group[one] != group[other]:
            old, new = group[other], group[one]
            group = [new if g == old else g for g in group]
    return [[c for c in range(values.curves) if group[c] == g] for g in sorted(set(group))]


def _other_series(
    fit: LawFit, series: list[list[int]], rows: list[np.ndarray]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield per series the likelihood of its mu_0 from the other series: R, shape (k, m), and r, shape (k,).

    Their chi-square is |R (mu_0 - fitted) + r|^2, linearised, with their a and b eliminated. Series are not
    correlated, so that their contributions add.
    """
    values, m, k = fit.values, fit.values.origins, fit.values.curves
    tangent = values.whitening @ fit.jacobian
    # Of mu_0, and the residual.
    columns = np.column_stack([tangent[:, :m], values.whitening @ (fit.model - values.value)])
    unaged = np.setdiff1d(np.arange(values.value.size), np.concatenate(rows))
    squares = []
    for curves, own in zip(series, rows, strict=True):
        aside = tangent[np.ix_(own, [*(m + np.array(curves)), *(m + k + np.array(curves))])]
        scale = np.linalg.norm(aside, axis=0)
        left, singular, _ = np.linalg.svd(aside / np.where(scale > 0, scale, 1.0), full_matrices=False)
        left = left[:, singular > 1e-10]
        rest = columns[own] - left @ (left.T @ columns[own])
        squares.append(rest.T @ rest)
    total = columns[unaged].T @ columns[unaged]
    for s, own in enumerate(rows):
        square = total + sum(squares[:s] + squares[s + 1 :], np.zeros_like(total))
        used = np.append(np.isin(np.arange(m), values.origin[own]), True)
        if not used.all():  # mu_0 of quantities that the series lacks are eliminated too
            cross = square[np.ix_(~used, used)]
            square = (
                square[np.ix_(used, used)] - cross.T @ np.linalg.pinv(square[np.ix_(~used, ~used)]) @ cross
            )
        share, axes = np.linalg.eigh(square)
        half = np.sqrt(np.maximum(share, 0.0))[:, None] * axes.T
        yield half[:, :-1], half[:, -1]
