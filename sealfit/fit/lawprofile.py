"""Profile-likelihood intervals of the aging law's a, b and c, one curve at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sealfit.fit.law import PROFILED, LawFit, Values, law_model
from sealfit.fit.polish import RANK, covariance_of

STEPS = 40
CLOSE = 1e-3  # ends are found to 0.1 % of b, or of the rise: far below what an interval means


@dataclass(frozen=True)
class CurveInterval:
    """95 % limits of one curve; an open end is 0 or inf for b, -inf or inf for a and c."""

    a: tuple[float, float]
    b: tuple[float, float]
    c: tuple[float, float]


def curve_intervals(fit: LawFit, rise_of_origin: np.ndarray) -> list[CurveInterval]:
    """Return the profile-likelihood intervals of every curve.

    For b: where the best chi-square with ln b held exceeds the optimum's by no more than the rise. For a and
    c = -a ln b, both linear in a once b is held: the union of their intervals along those b.

    What the other series say of mu_0 enters as a Gaussian: mu_0 hardly moves, so their laws stay in the linear range.

    Parameters
    ----------
    fit : LawFit
        Joint fit.
    rise_of_origin : ndarray, shape (origins,)
        t^2 of each quantity.
    """
    values = fit.values
    found: dict[int, CurveInterval] = {}
    for curves in _linked(values):
        own = np.flatnonzero(np.isin(values.curve, curves))
        small = _Small(fit, own, curves)
        for c in curves:
            rise = rise_of_origin[values.origin[values.curve == c][0]]
            found[c] = small.interval(c, float(rise), fit.limits[0][c], fit.limits[1][c])
    return [found[c] for c in range(values.curves)]


def _linked(values: Values) -> list[list[int]]:
    """Groups of curves whose values are correlated: the quantities of one series."""
    group = list(range(values.curves))
    rows, columns = np.nonzero(values.covariance)
    for one, other in zip(values.curve[rows], values.curve[columns], strict=True):
        if one >= 0 and other >= 0 and group[one] != group[other]:
            old, new = group[other], group[one]
            group = [new if g == old else g for g in group]
    return [[c for c in range(values.curves) if group[c] == g] for g in sorted(set(group))]


class _Small:
    """One series with its own values and, as a Gaussian, what all others say of mu_0."""

    def __init__(self, fit: LawFit, own: np.ndarray, curves: list[int]):
        values, m, k = fit.values, fit.values.origins, fit.values.curves
        self.values = values.part(own)
        self.used = np.unique(values.origin[own])
        self.curves = curves
        whiten = values.whitening
        rest = np.setdiff1d(np.arange(values.value.size), own)
        # rows of other conditions: the covariance has no link to them, so whitening keeps them apart
        tangent = (whiten @ fit.jacobian)[rest]
        miss = (whiten @ (fit.model - values.value))[rest]
        ours = [m + c for c in curves] + [m + k + c for c in curves]
        nuisance = [j for j in range(fit.x.size) if j not in ours and j not in self.used]
        shared = tangent[:, self.used]
        if nuisance:
            aside = tangent[:, nuisance]
            scale = np.linalg.norm(aside, axis=0)
            left, singular, _ = np.linalg.svd(aside / np.where(scale > 0, scale, 1.0), full_matrices=False)
            left = left[:, singular > 1e-10]
            shared = shared - left @ (left.T @ shared)
            miss = miss - left @ (left.T @ miss)
        # R of a QR has the same sum of squares as all those rows
        upper = np.linalg.qr(np.column_stack([shared, miss]), mode="r")
        self.root, self.miss = upper[:, :-1], upper[:, -1]
        self.whiten = self.values.whitening
        self.x = np.concatenate([fit.x[self.used], fit.x[[m + c for c in curves]], fit.x[[m + k + c for c in curves]]])
        self.origin_0 = fit.x[self.used]
        size = len(curves)
        low, high = (np.array([fit.limits[side][c] for c in curves]) for side in (0, 1))
        self.low = np.concatenate([np.full(self.used.size + size, -np.inf), low])
        self.high = np.concatenate([np.full(self.used.size + size, np.inf), high])

    def residual(self, x):
        """Whitened residual of the series and, below it, of what the others say of mu_0."""
        own = self.whiten @ (law_model(self.values, x)[0] - self.values.value)
        return np.concatenate([own, self.root @ (x[: self.used.size] - self.origin_0) + self.miss])

    def jacobian(self, x):
        """Derivative of `residual`."""
        own = self.whiten @ law_model(self.values, x)[1]
        shared = np.zeros((self.root.shape[0], x.size))
        shared[:, : self.used.size] = self.root
        return np.vstack([own, shared])

    def held(self, j: int, u: float, start: np.ndarray):
        """Return chi-square, all parameters and their variances with parameter j held at u: Gauss-Newton from `start`.

        Linear but for the b of the series' other quantity, and started at the neighbouring point of the profile: a few
        steps, each halved until it does not raise chi-square.
        """
        rest = np.delete(np.arange(self.x.size), j)
        x = start.copy()
        x[j] = u
        miss = self.residual(x)
        chi2 = miss @ miss
        for _ in range(STEPS):
            tangent = self.jacobian(x)[:, rest]
            scale = np.linalg.norm(tangent, axis=0)
            scale = np.where(scale > 0, scale, 1.0)
            move = np.zeros(x.size)
            move[rest] = np.linalg.lstsq(tangent / scale, -miss, rcond=RANK)[0] / scale
            before = chi2
            for _ in range(STEPS):
                trial = np.clip(x + move, self.low, self.high)
                trial[j] = u
                trial_miss = self.residual(trial)
                if trial_miss @ trial_miss <= before:
                    x, miss, chi2 = trial, trial_miss, trial_miss @ trial_miss
                    break
                move = move / 2
            if before - chi2 <= 1e-9 * (1 + chi2):
                break
        free = np.ones(x.size, bool)
        free[j] = False
        covariance, _ = covariance_of(self.jacobian(x), free & (x > self.low) & (x < self.high))
        return chi2, x, np.diag(covariance)

    def interval(self, c: int, rise: float, low: float, high: float) -> CurveInterval:
        """Return the interval of curve c; `low` and `high` limit ln b."""
        place, size, shared = self.curves.index(c), len(self.curves), self.used.size
        a, u = shared + place, shared + size + place
        best = self.residual(self.x) @ self.residual(self.x)
        limit = best + rise
        ends, open_ = [], []
        for sign, edge in ((-1, low), (1, high)):
            end, is_open = self._end(u, sign, edge, best, limit)
            ends.append(end)
            open_.append(is_open)
        start = self.x
        lowest = {"a": np.inf, "c": np.inf}
        highest = {"a": -np.inf, "c": -np.inf}
        for at in np.unique(np.append(np.linspace(ends[0], ends[1], PROFILED), self.x[u])):
            chi2, start, variance = self.held(u, float(at), start)
            half = np.sqrt(max(limit - chi2, 0.0) * variance[a])
            for name, factor in (("a", 1.0), ("c", -at)):
                lowest[name] = min(lowest[name], factor * start[a] - abs(factor) * half)
                highest[name] = max(highest[name], factor * start[a] + abs(factor) * half)
        b = (0.0 if open_[0] else float(np.exp(ends[0])), np.inf if open_[1] else float(np.exp(ends[1])))
        signs = [sign for sign, reached in ((1, highest["a"] > 0), (-1, lowest["a"] < 0)) if reached]
        for sign in signs:
            outer, inner = (highest, lowest) if sign > 0 else (lowest, highest)
            if open_[1]:  # a grows with b without end
                outer["a"], inner["c"] = sign * np.inf, -sign * np.inf
            if open_[0]:  # and c grows as b goes to zero
                outer["c"] = sign * np.inf
        return CurveInterval((lowest["a"], highest["a"]), b, (lowest["c"], highest["c"]))

    def _end(self, u: int, sign: int, edge: float, best: float, limit: float) -> tuple[float, bool]:
        """Where the profile along ln b reaches the limit, from the optimum outwards; whether it never does."""
        near, x = float(self.x[u]), self.x
        if sign * (edge - near) <= 0:
            return near, True
        step, far, at_near, at_far = 0.25, None, best, best
        while far is None:
            trial = near + sign * step
            trial = edge if sign * (trial - edge) >= 0 else trial
            chi2, moved, _ = self.held(u, trial, x)
            if chi2 > limit:
                far, at_far = trial, chi2
            elif trial == edge:
                return edge, True
            else:
                near, x, at_near, step = trial, moved, chi2, 2 * step
        # the root of the rise is nearly straight in ln b: a secant lands close, a halving at times is safe
        for turn in range(STEPS):
            if abs(far - near) < CLOSE:
                break
            low, high = (np.sqrt(max(value - best, 0.0)) for value in (at_near, at_far))
            share = (np.sqrt(limit - best) - low) / (high - low) if high > low and turn % 3 < 2 else 0.5
            middle = near + np.clip(share, 0.02, 0.98) * (far - near)
            chi2, moved, _ = self.held(u, middle, x)
            if chi2 > limit:
                far, at_far = middle, chi2
            else:
                near, x, at_near = middle, moved, chi2
            if abs(chi2 - limit) < CLOSE * (limit - best):
                return middle, False
        return near, False
