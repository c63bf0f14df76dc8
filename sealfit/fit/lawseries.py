"""Every series of a joint fit by itself, with what all others say of mu_0: for profiles of its curves, all at once."""

from __future__ import annotations

import numpy as np

from sealfit.fit.law import LawFit, Values
from sealfit.fit.least_squares import RANK, levenberg_marquardt


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
