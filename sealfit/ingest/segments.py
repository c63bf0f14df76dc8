"""Medians, waves, transients and stretches of one trace."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.optimize import minimize_scalar

# Means of rows from which the frequency of a wave is found, periods that they hold at least, and the factor
# by which the spectrum is finer than theirs.
MEANS, LEAST_PERIODS, FINER = 512, 2, 8
# Share of the variance beside a parabola that a strong wave explains.
STRONG = 0.5
# Parts of equal rows into which a steady window is cut to see whether it begins within a transient, and how
# many of the first may be left out: a longer change is an effect.
PARTS, MOST_PARTS = 20, 2
# Parts after these to which the parabola is fitted with which they are compared.
COMPARED = 8
# Standard errors, and share of the force, by which the first part must be off, one pair or the other. What
# warming leaves beside the parabola in a stroke of low noise reaches 10 standard errors and 2 % of the force.
OFF = ((20.0, 0.002), (8.0, 0.1))


def weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the value at which half of the weight lies at smaller ones; 0 where there is no weight.

    Examples
    --------
    >>> weighted_median(np.array([5.0, 1.0, 3.0]), np.array([1.0, 1.0, 4.0]))
    3.0
    """
    order = np.argsort(values)
    covered = np.cumsum(weights[order])
    return float(values[order[covered.searchsorted(0.5 * covered[-1])]]) if covered[-1] > 0.0 else 0.0


def smoothed(values: np.ndarray, samples: int) -> np.ndarray:
    """Return `values` as a running mean of running medians over `samples` samples, shape (n,)."""
    middle = median_filter(np.asarray(values, float), samples, mode="nearest")
    return uniform_filter1d(middle, samples, mode="nearest")


def strong_wave(x: np.ndarray, values: np.ndarray, late: int) -> np.ndarray:
    """Return the sine that explains most of the variance of `values` from row `late` on, shape (n,).

    A parabola is fitted beside it. It is 0 if no sine explains half of the variance that the parabola leaves.
    `x` rises evenly from row `late` on.

    Examples
    --------
    >>> x = np.linspace(0.0, 10.0, 400)
    >>> wave = strong_wave(x, 5.0 - 4.0 * np.exp(-x) + np.sin(7.0 * x), 200)
    >>> bool(np.abs(wave - np.sin(7.0 * x)).max() < 0.05)
    True
    """
    size = max((len(x) - late) // MEANS, 1)
    n = (len(x) - late) // size
    if n < 4 * LEAST_PERIODS:
        return np.zeros(len(x))
    along, mean = (part[late : late + n * size].reshape(n, size).mean(axis=1) for part in (x, values))
    place = 2.0 * (along - along[0]) / (along[-1] - along[0]) - 1.0
    parabola = np.vander(place, 3)

    def sines(periods: float, at: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(np.pi * periods * at), np.cos(np.pi * periods * at)], axis=1)

    def fitted(periods: float) -> tuple[np.ndarray, float]:
        columns = np.hstack([sines(periods, place), parabola])
        factors = np.linalg.lstsq(columns, mean, rcond=None)[0]
        return factors[:2], float(np.sum((mean - columns @ factors) ** 2))

    beside = mean - parabola @ np.linalg.lstsq(parabola, mean, rcond=None)[0]
    power = np.abs(np.fft.rfft(beside, FINER * n)) ** 2
    least, whole = LEAST_PERIODS * FINER, float(beside @ beside)
    peak = least + int(np.argmax(power[least:]))
    if not 2.0 * power[peak] > STRONG * n * whole:
        return np.zeros(len(x))
    ends = ((peak - 1) / FINER, (peak + 1) / FINER)
    periods = minimize_scalar(lambda k: fitted(k)[1], bounds=ends, method="bounded").x
    return sines(periods, 2.0 * (x - along[0]) / (along[-1] - along[0]) - 1.0) @ fitted(periods)[0]


def transient_rows(force_N: np.ndarray) -> int:
    """Return how many of the first rows of a steady window are a transient that the law did not reach.

    The force of n rows is cut into parts. A first part whose mean is far off the parabola through later ones
    is left out, with the second if that is off, too: a rise or an overshoot of a few samples at a high speed
    is not fitted, and an effect of so short a distance could not be told from it. Of the reversed force it is
    the number of last rows.
    """
    size = len(force_N) // PARTS
    if size < 1:
        return 0
    means = force_N[: size * PARTS].reshape(PARTS, size).mean(axis=1)
    powers = np.vander(np.arange(MOST_PARTS + COMPARED, dtype=float), 3)
    later = slice(MOST_PARTS, MOST_PARTS + COMPARED)
    inverse = np.linalg.pinv(powers[later])
    residual = means[: len(powers)] - powers @ (inverse @ means[later])
    spread = np.sqrt(np.sum(residual[later] ** 2) / (COMPARED - 3))
    error = spread * np.sqrt(1.0 + ((powers[:MOST_PARTS] @ inverse) ** 2).sum(axis=1))
    level, size_N = abs(float(means.mean())), np.abs(residual[:MOST_PARTS])
    off = np.any([size_N > np.maximum(k * error, share * level) for k, share in OFF], axis=0)
    return size * int(np.count_nonzero(np.logical_and.accumulate(off)))


def stretches(mask: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and the last row (exclusive) of every stretch in which `mask` is true.

    Examples
    --------
    >>> stretches(np.array([True, False, True, True]))
    [(0, 1), (2, 4)]
    """
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))
