"""Profile-likelihood intervals of the aging law's a, b and c, of all curves of a joint fit at once."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass

import numpy as np

from sealfit.fit.aging.law import PROFILED, LawFit, Values
from sealfit.fit.least_squares import RANK, levenberg_marquardt

# ---------------------------------------------------------------- lawseries
# Every series of a joint fit by itself, with what all others say of mu_0: for profiles of its curves, all at once.


class EachSeries:
    """The curves' series, each with its own values and, as a Gaussian, what the others say of mu_0.

    mu_0 hardly moves, so that the others' laws stay in the linear range. The numbers of a series are mu_0 of every
    origin, then a, then ln b of its curves; what it has not is zero and held.

    Parameters
    ----------
    fit : LawFit
        Joint fit.
    """

    def __init__(self, fit: LawFit) -> None:
        values, m, k = fit.values, fit.values.origins, fit.values.curves
        series = _linked(values)
        self.m, self.width = m, max(map(len, series))
        rows = [np.flatnonzero(np.isin(values.curve, curves)) for curves in series]
        n = max(own.size for own in rows)
        self.days, self.value = np.zeros((2, len(series), n))
        self.whiten = np.zeros((len(series), n, n))
        self.origin, self.curve = np.zeros((len(series), m, n)), np.zeros((len(series), self.width, n))  # 1 where it is
        self.x, self.limits = (
            np.zeros((len(series), m + 2 * self.width)),
            np.zeros((2, len(series), m + 2 * self.width)),
        )
        self.of, self.place = np.zeros((2, k), int)  # of a curve: its series, and where it stands in it
        for s, (curves, own) in enumerate(zip(series, rows, strict=True)):
            size, at = len(curves), np.arange(own.size)
            self.of[curves], self.place[curves] = s, np.arange(size)
            self.days[s, : own.size], self.value[s, : own.size] = values.days[own], values.value[own]
            self.whiten[s, : own.size, : own.size] = values.whitening[np.ix_(own, own)]
            self.origin[s, values.origin[own], at] = 1.0
            self.curve[s, np.searchsorted(curves, values.curve[own]), at] = 1.0
            used = np.unique(values.origin[own])
            a, u = m + np.arange(size), m + self.width + np.arange(size)
            self.x[s, used], self.x[s, a], self.x[s, u] = fit.x[used], fit.x[m:][curves], fit.x[m + k :][curves]
            for side, endless in enumerate((-np.inf, np.inf)):
                self.limits[side, s, used] = self.limits[side, s, a] = endless
                self.limits[side, s, u] = fit.limits[side][curves]
        self.root, self.miss = _of_the_others(fit, series, rows)

    def chi2_at_optimum(self) -> np.ndarray:
        """Return chi-square of every curve's series at the joint optimum, shape (curves,)."""
        return (self._evaluate(self.x, np.arange(len(self.x)))[0] ** 2).sum(axis=1)[self.of]

    def held(self, curves: np.ndarray, log_b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return chi-square, a and its variance with ln b held, of some curves, each of shape (r,).

        Parameters
        ----------
        curves : ndarray of int, shape (r,)
        log_b : ndarray, shape (r,)
        """
        series, every, at = self.of[curves], np.arange(curves.size), self.m + self.place[curves]
        x, (low, high) = self.x[series], self.limits[:, series]
        for numbers in (x, low, high):
            numbers[every, at + self.width] = log_b
        x, chi2 = levenberg_marquardt(lambda x, rows: self._evaluate(x, series[rows]), x, low, high)
        tangent = self._evaluate(x, series)[1] * ((x > low) & (x < high))[:, :, None]
        return chi2, x[every, at], _variance(tangent, at)

    def _evaluate(self, x: np.ndarray, series: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the whitened residual, then what the others say of mu_0, shape (r, n + m + 1), and its derivative."""
        origin, curve, white = self.origin[series], self.curve[series], np.swapaxes(self.whiten[series], 1, 2)
        parts = zip(np.split(x, (self.m, self.m + self.width), axis=1), (origin, curve, curve), strict=True)
        mu_0, a, log_b = (numbers[:, None, :] @ which for numbers, which in parts)
        ratio = self.days[series, None] * np.exp(-log_b)
        loss = np.log1p(ratio)
        own = (mu_0 - a * loss - self.value[series, None]) @ white
        slope = np.concatenate([origin, -loss * curve, a * ratio / (1 + ratio) * curve], axis=1) @ white
        root = np.swapaxes(self.root[series], 1, 2)
        others = (x - self.x[series])[:, None, : self.m] @ root + self.miss[series, None]
        held = np.zeros((len(x), 2 * self.width, self.m + 1))
        return (
            np.concatenate([own, others], axis=2)[:, 0],
            np.concatenate([slope, np.concatenate([root, held], axis=1)], axis=2),
        )


def _linked(values: Values) -> list[list[int]]:
    """Groups of curves whose values are correlated: the quantities of one series."""
    group = list(range(values.curves))
    rows, columns = np.nonzero(values.covariance)
    for one, other in set(zip(values.curve[rows].tolist(), values.curve[columns].tolist(), strict=True)):
        if one >= 0 and other >= 0 and group[one] != group[other]:
            old, new = group[other], group[one]
            group = [new if g == old else g for g in group]
    return [[c for c in range(values.curves) if group[c] == g] for g in sorted(set(group))]


def _of_the_others(fit: LawFit, series: list[list[int]], rows: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return what the others say of mu_0: R, shape (series, m + 1, m), and r, shape (series, m + 1).

    Their chi-square is |R (mu_0 - fitted) + r|^2. Their a and b are solved for, in the linear range. The covariance
    links no two series, so each says its own.
    """
    values, m, k = fit.values, fit.values.origins, fit.values.curves
    tangent = values.whitening @ fit.jacobian
    said = np.column_stack([tangent[:, :m], values.whitening @ (fit.model - values.value)])
    unaged = np.setdiff1d(np.arange(values.value.size), np.concatenate(rows))
    squares = []
    for curves, own in zip(series, rows, strict=True):
        aside = tangent[np.ix_(own, [*(m + np.array(curves)), *(m + k + np.array(curves))])]
        scale = np.linalg.norm(aside, axis=0)
        left, singular, _ = np.linalg.svd(aside / np.where(scale > 0, scale, 1.0), full_matrices=False)
        left = left[:, singular > 1e-10]
        rest = said[own] - left @ (left.T @ said[own])
        squares.append(rest.T @ rest)
    total = said[unaged].T @ said[unaged]
    root, miss = np.zeros((len(series), m + 1, m)), np.zeros((len(series), m + 1))
    for s, own in enumerate(rows):
        square = total + sum(squares[:s] + squares[s + 1 :], np.zeros_like(total))
        used = np.append(np.isin(np.arange(m), values.origin[own]), True)
        if not used.all():  # what the series has not is solved for too
            cross = square[np.ix_(~used, used)]
            square = square[np.ix_(used, used)] - cross.T @ np.linalg.pinv(square[np.ix_(~used, ~used)]) @ cross
        share, axes = np.linalg.eigh(square)
        half = np.sqrt(np.maximum(share, 0.0))[:, None] * axes.T
        root[s, : len(half), np.flatnonzero(used[:m])], miss[s, : len(half)] = half[:, :-1].T, half[:, -1]
    return root, miss


def _variance(tangent: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Return the variance of one number of each problem, shape (r,); inf where it is not determined.

    Parameters
    ----------
    tangent : ndarray, shape (r, p, n)
        Of the whitened residual; zero along what is held.
    which : ndarray of int, shape (r,)
    """
    size = np.linalg.norm(tangent, axis=2)
    scale = np.where(size > 0, size, 1.0)
    every = np.arange(which.size)
    axes, singular, _ = np.linalg.svd(tangent / scale[:, :, None], full_matrices=False)
    known = singular > RANK * singular.max(axis=1, keepdims=True)
    own = axes[every, which]
    variance = np.where(known, own / np.where(known, singular, 1.0), 0.0)
    lost = (np.abs(own) > 1e-6) & ~known
    return np.where(lost.any(axis=1), np.inf, (variance**2).sum(axis=1) / scale[every, which] ** 2)


# ---------------------------------------------------------------- lawprofile
# Profile-likelihood intervals of the aging law's a, b and c, those of all curves at once.

STEPS = 40
CLOSE = 1e-3  # ends are found to 0.1 % of b, or of the rise: far below what an interval means


@dataclass(frozen=True)
class CurveInterval:
    """95 % limits of one curve; an open end is 0 or inf for b, -inf or inf for a and c."""

    a: tuple[float, float]
    b: tuple[float, float]
    c: tuple[float, float]


End = tuple[float, bool]  # of an interval of ln b, and whether it is open
Asked = tuple[int, float]  # chi-square of which curve, with its ln b held where


def curve_intervals(fit: LawFit, rise_of_origin: np.ndarray) -> list[CurveInterval]:
    """Return the profile-likelihood intervals of every curve.

    For b: where the best chi-square with ln b held exceeds the optimum's by no more than the rise. For a and
    c = -a ln b, both linear in a once b is held: the union of their intervals along those b.

    Parameters
    ----------
    fit : LawFit
        Joint fit.
    rise_of_origin : ndarray, shape (origins,)
        t^2 of each quantity.
    """
    values, each, log_b = fit.values, EachSeries(fit), fit.x[-fit.values.curves :]
    curves = np.arange(values.curves)
    best = each.chi2_at_optimum()
    limit = best + rise_of_origin[[values.origin[values.curve == c][0] for c in curves]]
    searches = [
        _end(c, sign, fit.limits[side][c], log_b[c], best[c], limit[c])
        for c in curves
        for side, sign in enumerate((-1, 1))
    ]
    ends = _together(searches, lambda asked: each.held(*map(np.array, zip(*asked, strict=True)))[0])
    points = [
        np.unique([*np.linspace(low, high, PROFILED), at])
        for (low, _), (high, _), at in zip(ends[::2], ends[1::2], log_b, strict=True)
    ]
    of = np.repeat(curves, [at.size for at in points])
    chi2, a, variance = each.held(of, np.concatenate(points))
    room = limit[of] - chi2
    half = np.sqrt(np.where(room > 0, room * variance, 0.0))
    return [
        _interval(at, a[of == c], half[of == c], ends[2 * c], ends[2 * c + 1])
        for c, at in zip(curves, points, strict=True)
    ]


def _interval(log_b: np.ndarray, a: np.ndarray, half: np.ndarray, low: End, high: End) -> CurveInterval:
    """Return the interval of a curve: a with its half-width where ln b is held at points from one end to the other."""
    around = {
        name: [float((factor * a - np.abs(factor) * half).min()), float((factor * a + np.abs(factor) * half).max())]
        for name, factor in (("a", 1.0), ("c", -log_b))
    }
    signs = [end for end, reached in ((1, around["a"][1] > 0), (0, around["a"][0] < 0)) if reached]
    for outer in signs:
        endless = np.inf if outer else -np.inf
        if high[1]:  # a grows with b without end
            around["a"][outer], around["c"][1 - outer] = endless, -endless
        if low[1]:  # and c grows as b goes to zero
            around["c"][outer] = endless
    b = (0.0 if low[1] else float(np.exp(low[0])), np.inf if high[1] else float(np.exp(high[0])))
    return CurveInterval(tuple(around["a"]), b, tuple(around["c"]))


def _end(
    c: int, sign: int, edge: float, near: float, best: float, limit: float
) -> Generator[Asked, float, tuple[float, bool]]:
    """Find where the profile along ln b reaches the limit, from the optimum outwards; return whether it never does."""
    if sign * (edge - near) <= 0:
        return near, True
    step, far, at_near, at_far = 0.25, None, best, best
    while far is None:
        trial = near + sign * step
        trial = edge if sign * (trial - edge) >= 0 else trial
        chi2 = yield c, trial
        if chi2 > limit:
            far, at_far = trial, chi2
        elif trial == edge:
            return edge, True
        else:
            near, at_near, step = trial, chi2, 2 * step
    # the root of the rise is nearly straight in ln b: a secant lands close, a halving at times is safe
    for turn in range(STEPS):
        if abs(far - near) < CLOSE:
            break
        low, high = (np.sqrt(max(value - best, 0.0)) for value in (at_near, at_far))
        share = (np.sqrt(limit - best) - low) / (high - low) if high > low and turn % 3 < 2 else 0.5
        middle = near + np.clip(share, 0.02, 0.98) * (far - near)
        chi2 = yield c, middle
        if chi2 > limit:
            far, at_far = middle, chi2
        else:
            near, at_near = middle, chi2
        if abs(chi2 - limit) < CLOSE * (limit - best):
            return middle, False
    return near, False


def _together(
    searches: Sequence[Generator[Asked, float, End]], answer: Callable[[list[Asked]], np.ndarray]
) -> list[End]:
    """Return what searches find that ask for one number after the other, the next ones of all answered at once."""
    found: dict[int, End] = {}
    answers: dict[int, float | None] = dict.fromkeys(range(len(searches)))
    while answers:
        asked = {}
        for k, given in answers.items():
            try:
                asked[k] = searches[k].send(given)
            except StopIteration as end:
                found[k] = end.value
        answers = dict(zip(asked, answer(list(asked.values())), strict=True)) if asked else {}
    return [found[k] for k in range(len(searches))]
