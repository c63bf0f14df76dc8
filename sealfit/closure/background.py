"""The background of a spectrum, from each frequency's neighbours: what a peak stands out of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import digamma, polygamma

NEIGHBOURS = 25  # frequencies on each side that make the local background
LOBE = 4  # frequencies on each side that the taper smears a peak over


def alike(ratio: np.ndarray) -> np.ndarray:
    """Return of how many independent powers a spectrum behaves like the mean, by its neighbours' spread, shape (f,).

    The logarithm of a mean of c powers has the variance trigamma(c); its spread is taken from the quartiles, which a
    few peaks do not move.
    """
    low, high = _quantiles(_neighbours(np.log(np.maximum(ratio, 1e-300))), (0.25, 0.75))
    spread = ((high - low) / 1.349) ** 2
    numbers = np.geomspace(1e5, 1.0, 200)
    return np.interp(spread, polygamma(1, numbers), numbers)


def _quantiles(windows: np.ndarray, levels: Sequence[float]) -> list[np.ndarray]:
    """Return quantiles of each row, NaN left out, by linear interpolation, each of shape (f,).

    numpy's nanquantile takes the rows one by one, a hundred times slower.
    """
    ordered = np.sort(windows, axis=1)  # NaN last
    last = np.maximum(np.isfinite(windows).sum(axis=1) - 1, 0)
    every = np.arange(last.size)
    found = []
    for level in levels:
        place = level * last
        low = np.floor(place).astype(int)
        high = np.minimum(low + 1, last)
        found.append(ordered[every, low] + (place - low) * (ordered[every, high] - ordered[every, low]))
    return found


def _neighbours(value: np.ndarray) -> np.ndarray:
    """Return each frequency's neighbours, its own main lobe and what lies beyond the ends NaN, shape (f, window)."""
    padded = np.pad(value, NEIGHBOURS, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1).copy()
    windows[:, np.abs(np.arange(-NEIGHBOURS, NEIGHBOURS + 1)) <= LOBE] = np.nan
    return windows


def tops(power: np.ndarray) -> np.ndarray:
    """Return where a spectrum is highest within a main lobe each side, both ends left out, shape (f,).

    At the low end stand the smooth shapes of a stroke (warming, drift), which are no ripple; at the high end only the
    strokes that are sampled most finely are left, and their noise is not that of all.
    """
    padded = np.pad(power, LOBE, constant_values=np.inf)
    highest = np.lib.stride_tricks.sliding_window_view(padded, 2 * LOBE + 1).max(axis=1)
    return power >= highest


def smooth_background(power: np.ndarray, frequency: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return the background of a mean of `count` powers: a straight line in log-log through each point's neighbours.

    Correlated noise falls steeply towards high frequencies, which a plain median of neighbours would take for a peak at
    the low end. Neighbours that stand out are clipped, the peak's own main lobe left out.
    """
    value = np.log(np.maximum(power, 1e-300))
    place = np.log(frequency)
    y, x = _neighbours(value), _neighbours(place)
    for _ in range(3):
        weight = np.isfinite(y).astype(float)
        total = weight.sum(axis=1)
        mean_x = np.nansum(np.where(weight > 0, x, 0.0), axis=1) / total
        mean_y = np.nansum(y, axis=1) / total
        dx = np.where(weight > 0, x - mean_x[:, None], 0.0)
        dy = np.where(weight > 0, y - mean_y[:, None], 0.0)
        slope = (dx * dy).sum(axis=1) / np.maximum((dx**2).sum(axis=1), 1e-300)
        line = mean_y[:, None] + slope[:, None] * (x - mean_x[:, None])
        spread = np.sqrt(np.nanmean((y - line) ** 2, axis=1))[:, None]
        y = np.minimum(y, line + 2 * spread)
    level = mean_y + slope * (place - mean_x)
    return np.exp(level - (digamma(count) - np.log(count)))


def background(power: np.ndarray) -> np.ndarray:
    """Return the median of each frequency's neighbours, the peak's own main lobe left out."""
    return np.maximum(_quantiles(_neighbours(power), (0.5,))[0], 1e-300)
