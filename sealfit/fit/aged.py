"""Values of one quantity over aging time, temperature and compression: what a joint law is fitted to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sealfit.effects import aging_laws

GAS_CONSTANT = aging_laws.GAS_CONSTANT / 1000  # kJ/(mol K)
TINY = 1e-300  # of a variance: values without any scatter
ROUNDING = 1e-14  # of the largest variance: less is not known of a covariance


def _inverse(celsius):
    return 1 / (GAS_CONSTANT * (np.asarray(celsius, float) + aging_laws.ZERO_C))


def _plain(percent):
    return np.asarray(percent, float)


DRIVERS = (("E", "temperature_C", _inverse), ("kappa", "compression_pct", _plain))
"""What changes the pace of aging: its coefficient in ln k (kJ/mol, 1/%), where it stands, what it is multiplied by."""


@dataclass(frozen=True)
class Aged:
    """Values of one quantity: a specimen, or the mean of those of one condition, each.

    Attributes
    ----------
    days, value : ndarray, shape (n,)
        Aging time in days, and the value measured.
    temperature_C, compression_pct : ndarray, shape (n,), or None
        Of aging; whatever stands there for unaged specimens is not read. None where no such thing was varied.
    variance : ndarray, shape (n,) or (n, n), or None
        Variance or covariance of the values as measured; the scatter between specimens is estimated and added. None
        where it is all there is.
    """

    days: np.ndarray
    value: np.ndarray
    temperature_C: np.ndarray | None = None
    compression_pct: np.ndarray | None = None
    variance: np.ndarray | None = None

    def part(self, keep: np.ndarray) -> Aged:
        """Return some of the values; `keep` is a mask, shape (n,)."""
        taken = {
            name: None if getattr(self, name) is None else getattr(self, name)[keep]
            for name in ("temperature_C", "compression_pct")
        }
        variance = self.variance
        if variance is not None:
            variance = variance[keep] if variance.ndim == 1 else variance[np.ix_(keep, keep)]
        return replace(self, days=self.days[keep], value=self.value[keep], variance=variance, **taken)

    def covariance(self, scatter: float, about: np.ndarray | None = None) -> np.ndarray:
        """Return the covariance of the values, shape (n, n).

        Parameters
        ----------
        scatter : float
            Relative standard deviation between specimens, beyond the measured variance.
        about : ndarray, shape (n,), optional
            What it is relative to; default the values.
        """
        measured = np.zeros(self.value.size) if self.variance is None else self.variance
        own = (scatter * (self.value if about is None else about)) ** 2 + TINY
        return (np.diag(measured) if measured.ndim == 1 else measured) + np.diag(own)

    @cached_property
    def spread(self) -> Spread:
        """The same for any scatter."""
        return Spread(self.covariance(0.0), np.abs(self.value))

    def drivers(self) -> tuple[str, ...]:
        """Return the names of the coefficients in ln k of what was varied."""
        aged, found = self.days > 0, []
        for name, column, _ in DRIVERS:
            at = getattr(self, column)
            if at is not None and np.unique(at[aged]).size > 1:
                found.append(name)
        return tuple(found)

    @cached_property
    def middle(self) -> dict[str, float]:
        """The middle of the tested temperatures and compressions, by the name of the coefficient."""
        there = ((name, getattr(self, column)) for name, column, _ in DRIVERS)
        return {name: reference_of(at[self.days > 0]) for name, at in there if at is not None}

    def away(self, name: str, middle: float) -> np.ndarray:
        """Return what a coefficient multiplies in ln k, counted from a temperature or compression, shape (n,)."""
        column, of = next((column, of) for own, column, of in DRIVERS if own == name)
        return np.where(self.days > 0, of(middle) - of(getattr(self, column)), 0.0)

    def series(self) -> np.ndarray:
        """Return the number of each value's series, shape (n,); -1 for unaged specimens."""
        keys = [at for at in (self.temperature_C, self.compression_pct) if at is not None]
        number, aged = np.full(self.days.size, -1), self.days > 0
        number[aged] = 0
        if keys:
            number[aged] = np.unique(np.column_stack(keys)[aged], axis=0, return_inverse=True)[1].ravel()
        return number

    def whole_series(self) -> list[np.ndarray]:
        """Return the mask of each series, shape (n,) each."""
        series = self.series()
        return [series == k for k in np.unique(series[series >= 0])]

    def last_days(self) -> list[np.ndarray]:
        """Return the mask of each series' last day, shape (n,) each."""
        return [own & (self.days == self.days[own].max()) for own in self.whole_series()]


class Spread:
    """The covariance C(s) = M + s^2 diag(size)^2 of values for any scatter s, decomposed once.

    Parameters
    ----------
    measured : ndarray, shape (n, n)
        M.
    size : ndarray, shape (n,)
        What the scatter is relative to.

    Notes
    -----
    Relative to the sizes C is M' + s^2, and the axes of M' are those of C for every s.
    """

    def __init__(self, measured: np.ndarray, size: np.ndarray) -> None:
        self._size = np.maximum(size, ROUNDING * size.max())
        variance, self._axes = np.linalg.eigh(measured / np.outer(self._size, self._size))
        self._variance = np.maximum(variance, max(ROUNDING * variance[-1], TINY))

    def whitening(self, scatter: float) -> np.ndarray:
        """Return W with W C W' = 1, shape (n, n)."""
        return self._axes.T / self._size / np.sqrt(self._variance + scatter**2)[:, None]

    def chi2(self, residual: np.ndarray, scatter: float) -> float:
        """Return r' C^-1 r of a residual, shape (n,)."""
        return float(((residual / self._size) @ self._axes) ** 2 @ (1 / (self._variance + scatter**2)))

    def log_determinant(self, scatter: float) -> float:
        """Return ln det C."""
        return float(np.log(self._variance + scatter**2).sum() + 2 * np.log(self._size).sum())


def reference_of(tested: np.ndarray) -> float:
    """Return the middle of the tested temperatures or compressions, at which k is 1."""
    return float(np.median(np.unique(tested)))
