"""Errors of the aging law's mu_0, a, b and c, curve by curve of a joint fit: covariances and intervals.

For one series all others are a Gaussian likelihood of mu_0: their laws are linearised, and their a and b are
eliminated (Schur complement). mu_0 hardly changes along the profile of a curve, so that the linearisation is
harmless. The cost is proportional to the number of series.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize.elementwise import find_root

from sealfit.fit.aging.law import PROFILED, Groups, LawFit
from sealfit.fit.least_squares import CHUNK, covariance_of, levenberg_marquardt

# Tolerance of the ends of intervals in ln b: 0.1 % of b.
CLOSE = 1e-3
# The first step along ln b from the optimum outwards; each further step is twice as long.
FIRST_STEP = 0.25


# ---------------------------------------------------------------- other series
def elsewhere(fit: LawFit, columns: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return what all other groups contribute to the normal matrix of mu_0 and a whitened column.

    `columns`, shape (g, n) each, and the results, shape (g, m + 1, m + 1) each, are by `values.groups`. a and
    b of the other groups are eliminated. Groups are independent, and their contributions add.
    """
    pairs = zip(fit.values.groups, columns, strict=True)
    rows = [own.eliminated(fit.x, column) for own, column in pairs]
    each = np.concatenate([one @ np.swapaxes(one, 1, 2) for one in rows])
    none = np.zeros_like(each[:1])
    before = np.concatenate([none, np.cumsum(each[:-1], axis=0)])
    after = np.concatenate([np.cumsum(each[:0:-1], axis=0)[::-1], none])
    return np.split(before + after, np.cumsum([len(one) for one in rows])[:-1])


def likelihoods(fit: LawFit) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the likelihood of mu_0 from the other groups, by `values.groups`.

    It is R, shape (g, m + 1, m), and r, (g, m + 1): their chi-square is |R (mu_0 - fitted) + r|^2.
    """
    found = []
    for square in elsewhere(fit, fit.residuals):
        share, axes = np.linalg.eigh(square)
        half = np.sqrt(np.maximum(share, 0.0))[..., None] * np.swapaxes(axes, 1, 2)
        found.append((half[..., :-1], half[..., -1]))
    return found


def curve_errors(fit: LawFit, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariance of mu_0, a and ln b of curves, (curves, 3, 3), and their shift, (curves, 3).

    `moved`, shape (n,), is the change of the values that causes the shift.
    """
    values, m = fit.values, fit.values.origins
    covariance, shift = np.zeros((values.curves, 3, 3)), np.zeros((values.curves, 3))
    white = values.whitening @ moved
    pulls = elsewhere(fit, [white[own.rows] for own in values.groups])
    for own, (root, _), pull in zip(values.groups, likelihoods(fit), pulls, strict=True):
        every = np.arange(len(own.rows))[:, None]
        _, slope = own.evaluate(fit.x[own.places], every[:, 0])
        tangent = np.concatenate([slope, _of_mu_0(root, slope.shape[1])], axis=2)
        found, _ = covariance_of(np.swapaxes(tangent, 1, 2), own.free(fit.x))
        gradient = (slope @ white[own.rows][..., None])[..., 0]
        gradient[:, :m] += pull[:, :m, -1]
        step = (np.where(np.isfinite(found), found, 0.0) @ gradient[..., None])[..., 0]
        for place, curve in enumerate(own.curves.T):
            at = np.full((len(curve), 3), (0, m + place, m + own.width + place))
            at[:, 0] = values.places_of_curve[curve, 0]
            covariance[curve] = found[every[..., None], at[:, :, None], at[:, None, :]]
            shift[curve] = step[every, at]
    return covariance, shift


def _of_mu_0(root: np.ndarray, p: int) -> np.ndarray:
    """Return the derivatives of R (mu_0 - fitted), shape (g, p, m + 1), with respect to p parameters."""
    found = np.zeros((len(root), p, root.shape[1]))
    found[:, : root.shape[2]] = np.swapaxes(root, 1, 2)
    return found


# ---------------------------------------------------------------- intervals
@dataclass(frozen=True)
class CurveInterval:
    """95 % intervals of one curve; an open end is 0 or inf for b, -inf or inf for a and c."""

    a: tuple[float, float]
    b: tuple[float, float]
    c: tuple[float, float]


End = tuple[float, bool]  # of an interval of ln b, and whether it is open


def curve_intervals(fit: LawFit, rise_of_origin: np.ndarray) -> list[CurveInterval]:
    """Return the profile-likelihood intervals of every curve.

    The interval of b is where the least chi-square at fixed ln b exceeds the minimum by at most the rise, t^2
    of each quantity, shape (origins,). Those of a and c = -a ln b, which are linear in a at fixed b, are the
    unions of their intervals over these b.
    """
    intervals: dict[int, CurveInterval] = {}
    for own, others in zip(fit.values.groups, likelihoods(fit), strict=True):
        for place, curves in enumerate(own.curves.T):
            profile = _Profile(fit, own, others, place)
            rise = rise_of_origin[fit.values.places_of_curve[curves, 0]]
            intervals |= zip(curves.tolist(), _intervals(profile, rise), strict=True)
    return [intervals[curve] for curve in range(fit.values.curves)]


def _intervals(profile: _Profile, rise: np.ndarray) -> list[CurveInterval]:
    """Return the intervals of a curve of each group; `rise`, shape (g,), is that of chi-square."""
    limit = profile.chi2 + rise
    low, high = (profile.ends(sign, limit) for sign in (-1, 1))
    points = np.concatenate([np.linspace(low[0], high[0], PROFILED), profile.log_b[None]]).T
    of = np.repeat(np.arange(len(points)), points.shape[1])
    chi2, a, variance = (found.reshape(points.shape) for found in profile.at(points.ravel(), of))
    room = limit[:, None] - chi2
    half = np.sqrt(np.where(room > 0, room * variance, 0.0))
    ends = (zip(*end, strict=True) for end in (low, high))
    return [_interval(*row) for row in zip(points, a, half, *ends, strict=True)]


class _Profile:
    """The profile of chi-square along ln b of one curve in each of some groups.

    `others` is the likelihood of mu_0 from all other groups, as in `likelihoods`, and `place` the number of
    the curve within its group. `chi2` and `log_b`, shape (g,), are those of the joint optimum.
    """

    def __init__(self, fit: LawFit, own: Groups, others: tuple[np.ndarray, np.ndarray], place: int) -> None:
        self.own, (self.root, self.miss) = own, others
        self.at_a, self.at_b = own.m + place, own.m + own.width + place
        self.x = fit.x[own.places]
        self.log_b = self.x[:, self.at_b]
        self.chi2 = (self._evaluate(self.x, np.arange(len(self.x)))[0] ** 2).sum(axis=1)

    def at(self, log_b: np.ndarray, of: np.ndarray) -> np.ndarray:
        """Return the least chi-square, a and the variance of a at fixed ln b of groups, shape (3, r)."""
        rows = self.own.rows.shape[1] + self.miss.shape[1]
        parts = 1 + of.size * self.x.shape[1] * rows // CHUNK
        split = (np.array_split(one, parts) for one in (log_b, of))
        return np.concatenate([self._at(*part) for part in zip(*split, strict=True)], axis=1)

    def _at(self, log_b: np.ndarray, of: np.ndarray) -> np.ndarray:
        x, (low, high) = self.x[of], self.own.bounds[:, of]
        x[:, self.at_b] = low[:, self.at_b] = high[:, self.at_b] = log_b
        found, chi2 = levenberg_marquardt(lambda x, rows: self._evaluate(x, of[rows]), x, low, high)
        slope = self._evaluate(found, of)[1]
        covariance, _ = covariance_of(np.swapaxes(slope, 1, 2), (found > low) & (found < high))
        return np.array([chi2, found[:, self.at_a], covariance[:, self.at_a, self.at_a]])

    def _evaluate(self, x: np.ndarray, of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whitened residuals, shape (r, n + m + 1), and derivatives; those of others are last."""
        rest, slope = self.own.evaluate(x, of)
        away = (x - self.x[of])[:, : self.own.m, None]
        others = (self.root[of] @ away)[..., 0] + self.miss[of]
        beside = _of_mu_0(self.root[of], x.shape[1])
        return np.hstack([rest, others]), np.concatenate([slope, beside], axis=2)

    def ends(self, sign: int, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ln b where the profiles reach the limit, from the optimum outwards, and which are open."""
        edge = self.own.bounds[int(sign > 0), :, self.at_b]
        near, far, is_open = self.log_b.copy(), self.log_b.copy(), np.ones(len(edge), bool)

        def above(log_b: np.ndarray, of: np.ndarray) -> np.ndarray:
            return self.at(log_b, of.astype(int))[0] - limit[of.astype(int)]

        todo, step = np.flatnonzero(sign * (edge - near) > 0), FIRST_STEP
        while todo.size:
            far[todo] = sign * np.minimum(sign * near[todo] + step, sign * edge[todo])
            is_open[todo] = ~(above(far[todo], todo) > 0)
            todo = todo[is_open[todo]]
            near[todo], step = far[todo], 2 * step
            todo = todo[sign * (edge[todo] - near[todo]) > 0]
        reached = np.flatnonzero(~is_open)
        if reached.size:
            bracket, stops = (near[reached], far[reached]), {"xatol": CLOSE, "xrtol": 0.0, "fatol": 0.0}
            near[reached] = find_root(above, bracket, args=(reached,), tolerances=stops).x
        return near, is_open


def _interval(log_b: np.ndarray, a: np.ndarray, half: np.ndarray, low: End, high: End) -> CurveInterval:
    """Return the interval of a curve from a and its half-width at fixed values of ln b between the ends."""
    around = {}
    for name, factor in (("a", 1.0), ("c", -log_b)):
        middle, reach = factor * a, np.abs(factor) * half
        around[name] = [float((middle - reach).min()), float((middle + reach).max())]
    signs = [end for end, reached in ((1, around["a"][1] > 0), (0, around["a"][0] < 0)) if reached]
    for outer in signs:
        endless = np.inf if outer else -np.inf
        if high[1]:  # a grows without bound with b
            around["a"][outer], around["c"][1 - outer] = endless, -endless
        if low[1]:  # c grows without bound as b goes to 0
            around["c"][outer] = endless
    b = (0.0 if low[1] else float(np.exp(low[0])), np.inf if high[1] else float(np.exp(high[0])))
    return CurveInterval(tuple(around["a"]), b, tuple(around["c"]))
