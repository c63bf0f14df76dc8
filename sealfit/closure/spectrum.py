"""The spectrum of strokes along an axis, summed over units, and its local background."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pandas as pd
from scipy.fft import next_fast_len
from scipy.special import digamma, polygamma

from sealfit.closure.criteria import LEAST_SAMPLES_OF_STROKE, LOBE, NEIGHBOURS, REACHED


@dataclass(frozen=True)
class AxisStrokes:
    """The m strokes along an axis, with n samples together."""

    place: np.ndarray  # (n,) along the axis, in its unit, ordered by stroke
    residual: np.ndarray  # (n,) in N
    start: np.ndarray  # (m,) first sample
    size: np.ndarray  # (m,) samples
    low: np.ndarray  # (m,) start
    span: np.ndarray  # (m,) length
    unit: np.ndarray  # (m,) number of its file
    direction: np.ndarray  # (m,)

    @classmethod
    def of(cls, samples: pd.DataFrame, axis: str) -> AxisStrokes:
        """Return the strokes of the samples that are long enough for the search for ripples."""
        place, residual = (samples[name].to_numpy(dtype=float) for name in (axis, "residual_N"))
        stroke = samples["stroke_id"].to_numpy()
        start = np.flatnonzero(np.r_[True, stroke[1:] != stroke[:-1]][: stroke.size])
        size = np.diff(np.r_[start, stroke.size])
        low, high = (
            part.reduceat(place, start) if start.size else place for part in (np.minimum, np.maximum)
        )
        good = (size >= LEAST_SAMPLES_OF_STROKE) & (high > low)
        unit, direction = (samples[name].to_numpy()[start[good]] for name in ("unit", "direction"))
        return cls(place, residual, start[good], size[good], low[good], (high - low)[good], unit, direction)

    def along(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return places and residuals of one stroke, sorted by place."""
        own = slice(self.start[k], self.start[k] + self.size[k])
        order = np.argsort(self.place[own], kind="stable")
        return self.place[own][order], self.residual[own][order]


def effective_count(ratio: np.ndarray) -> np.ndarray:
    """Return the effective number of independent powers in the mean at each frequency, shape (f,).

    The logarithm of a mean of c powers has the variance trigamma(c), here from the neighbours' quartiles.
    """
    low, high = _quantiles(_neighbours(np.log(np.maximum(ratio, 1e-300))), (0.25, 0.75))
    spread = ((high - low) / 1.349) ** 2
    numbers = np.geomspace(1e5, 1.0, 200)
    return np.interp(spread, polygamma(1, numbers), numbers)


def _quantiles(windows: np.ndarray, levels: Sequence[float]) -> list[np.ndarray]:
    """Return quantiles of each row without NaN, by linear interpolation, each of shape (f,).

    numpy's nanquantile loops over the rows and is a hundred times slower.
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
    """Return the neighbours of each frequency, (f, window); NaN in its main lobe and beyond the ends."""
    padded = np.pad(value, NEIGHBOURS, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1).copy()
    windows[:, np.abs(np.arange(-NEIGHBOURS, NEIGHBOURS + 1)) <= LOBE] = np.nan
    return windows


def tops(power: np.ndarray) -> np.ndarray:
    """Return where a spectrum has its maximum within a main lobe on each side, without both ends, shape (f,).

    The low end contains the smooth shapes of a stroke; few strokes reach the high end.
    """
    padded = np.pad(power, LOBE, constant_values=np.inf)
    highest = np.lib.stride_tricks.sliding_window_view(padded, 2 * LOBE + 1).max(axis=1)
    return power >= highest


def smooth_background(power: np.ndarray, frequency: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return the background of means of `count` powers: a line in log-log coordinates through the neighbours.

    The spectrum of correlated noise falls steeply, so a median of neighbours would give a false peak at the
    low end. Outlying neighbours are clipped.
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
    """Return the median of each frequency's neighbours, without the main lobe of the peak."""
    return np.maximum(_quantiles(_neighbours(power), (0.5,))[0], 1e-300)


LEAST_STROKES = 3  # Fewest strokes of a spectrum.
LEAST_FREQUENCIES = 4  # Fewest frequencies of a spectrum.


@dataclass(frozen=True)
class Spectrum:
    """Sums over passes (units in one direction) at f frequencies, and over units in one or two modes.

    The first mode is the same force in both directions, the second has the sign of the direction. Amplitudes
    of single units are not kept, so that memory does not grow with the campaign.
    """

    axis: str
    frequency: np.ndarray  # (f,)
    taken: np.ndarray  # (f,) whether it lies in the main lobe of a component in the model
    count: np.ndarray  # (f,) passes that reach each frequency
    power: np.ndarray  # (f,) mean of the passes' powers, each on its own scale
    amplitude: np.ndarray  # (f,) root mean square of the passes' amplitudes
    total: np.ndarray  # (modes, f) complex sum of the units' amplitudes, each on its own scale
    square: np.ndarray  # (modes, f) sum of the units' powers, each on its own scale
    mean: np.ndarray  # (modes, f) complex mean amplitude of the passes that reach the frequency
    units: np.ndarray  # (modes,)


def spectrum_of(samples: pd.DataFrame, axis: str, known: Sequence[float] = ()) -> Spectrum | None:
    """Return the spectrum along an axis; None with too few strokes or frequencies.

    A parabola is subtracted from each stroke, which is then tapered (Hann) and transformed on a grid that
    divides twice the longest stroke, for common frequencies. The longest wavelength is half the median
    stroke. The samples are those of `find_ripple`, and `known` the wavelengths in the model along this axis.
    """
    grid = _Grid.of(AxisStrokes.of(samples, axis))
    if grid is None:
        return None
    sides, unit = np.unique(grid.strokes.direction), grid.strokes.unit
    shape = min(sides.size, 2), grid.numbers.size
    passes, power, square = np.zeros((3, grid.numbers.size))
    total, mean = np.zeros((2, *shape), dtype=complex)
    scaled, units = np.zeros(shape), np.zeros(shape[0], dtype=int)
    order = np.argsort(unit, kind="stable")
    for strokes in np.split(order, np.flatnonzero(np.diff(unit[order])) + 1):
        wave, reached = _passes(grid, strokes, sides)
        width = wave.shape[1]
        passes[:width] += reached.sum(axis=0)
        own = _power(wave)
        typical = own.sum(axis=1) / np.maximum(reached.sum(axis=1), 1)
        power[:width] += (own / np.maximum(typical, 1e-300)[:, None]).sum(axis=0)
        square[:width] += own.sum(axis=0)
        for mode, both in enumerate([wave.sum(axis=0), sides @ wave][: shape[0]]):
            mean[mode, :width] += both
            units[mode] += both.any()
            typical = np.median(_power(both)) if width else 0.0
            if typical > 0:  # units are scaled, so that one noisy file does not dominate
                total[mode, :width] += both / np.sqrt(typical)
                scaled[mode, :width] += _power(both) / typical
    frequency, count = grid.numbers / grid.longest, np.maximum(passes, 1)
    taken = np.zeros(frequency.size, dtype=bool)
    for wavelength in known:
        taken |= np.abs(frequency - 1 / wavelength) <= LOBE / grid.longest
    means = (power / count, np.sqrt(square / count), total, scaled, mean / count)
    return Spectrum(axis, frequency, taken, passes, *means, units)


@dataclass(frozen=True)
class _Grid:
    """Strokes and their frequencies, multiples of 1 / `longest`."""

    strokes: AxisStrokes
    points: np.ndarray  # (m,) grid points of each stroke per `longest`
    reach: np.ndarray  # (m,) number of frequencies that each stroke reaches
    numbers: np.ndarray  # (f,) multiples that are the frequencies
    longest: float  # length, or time, that all grids divide

    @classmethod
    def of(cls, strokes: AxisStrokes) -> _Grid | None:
        if strokes.span.size < LEAST_STROKES:
            return None
        step = strokes.span / (strokes.size - 1)
        longest = float(2 * strokes.span.max())
        least = np.clip(np.ceil(longest / step), 8, 2**15).astype(int)
        points = np.array([next_fast_len(int(n), real=True) for n in least])
        most = min(2**15, int(np.ceil(longest / np.quantile(step, 0.1))))
        frequency = np.arange(most // 2 + 1) / longest
        reach = np.minimum(points // 2 + 1, np.searchsorted(frequency, 0.5 / step, side="right"))
        # strokes, at each frequency
        reaching = np.bincount(reach, minlength=frequency.size + 1)[::-1].cumsum()[::-1][1:]
        widely = reaching[: frequency.size] >= REACHED * reach.size
        use = widely & (frequency >= 2 / np.median(strokes.span))
        if use.sum() < LEAST_FREQUENCIES:
            return None
        first, last = np.flatnonzero(use)[[0, -1]]  # contiguous, as fewer strokes reach further
        reached, numbers = np.clip(reach, first, last + 1) - first, np.arange(first, last + 1)
        return cls(strokes, points, reached, numbers, longest)


def _passes(grid: _Grid, strokes: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean complex amplitudes of a unit's strokes, (directions, f), and where any reaches them."""
    wave = np.zeros((sides.size, int(grid.reach[strokes].max())), dtype=complex)
    count = np.zeros(wave.shape)
    for k in strokes:
        side = np.searchsorted(sides, grid.strokes.direction[k])
        wave[side, : grid.reach[k]] += _amplitudes(grid, k)
        count[side, : grid.reach[k]] += 1
    return wave / np.maximum(count, 1), count > 0


def _amplitudes(grid: _Grid, k: int) -> np.ndarray:
    """Return a stroke's complex amplitudes at the frequencies that it reaches, with phases from place 0."""
    strokes, points, numbers = grid.strokes, grid.points[k], grid.numbers[: grid.reach[k]]
    size = int(np.ceil(strokes.span[k] * points / grid.longest))
    trend, taper = _on_grid(size)
    place = strokes.low[k] + grid.longest / points * np.arange(size)
    value = np.interp(place, *strokes.along(k))
    value -= (value @ trend) @ trend.T
    wave = np.fft.rfft(value * taper, points)[numbers]
    return wave * np.exp(-2j * np.pi / grid.longest * strokes.low[k] * numbers)


@lru_cache(maxsize=512)  # strokes of one speed share their grid
def _on_grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return an orthonormal basis of parabolas on an even grid, (size, 3), and the Hann taper, (size,)."""
    trend, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, size), 3))
    taper = np.hanning(size + 2)[1:-1]
    return trend, taper * (2 / taper.sum())


def _power(wave: np.ndarray) -> np.ndarray:
    return wave.real**2 + wave.imag**2
