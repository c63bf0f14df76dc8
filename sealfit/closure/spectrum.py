r"""The spectrum of strokes along an axis, summed over units: no amplitude of a single one is kept.

Strokes that share a grid are transformed together, and the units are added some at a time, so that memory does not grow
with the campaign.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pandas as pd
from scipy.fft import next_fast_len
from scipy.sparse import csr_array

from sealfit.closure.background import LOBE
from sealfit.closure.waves import LEAST_SAMPLES

MOST_NUMBERS = 1 << 20  # of grids that are transformed together: 8 MB
EXPONENTS = 64  # of a stroke's phase factor that are computed; the others are products of these and their powers


@dataclass(frozen=True)
class Common:
    """Sums over units of amplitudes that keep their phase, for one way of acting."""

    symmetric: bool  # True: the same force both ways; False: it follows the direction
    total: np.ndarray  # (f,) complex, each unit on its own scale
    square: np.ndarray  # (f,) of the units' powers, each on its own scale
    units: int
    amplitude: np.ndarray  # (f,) complex, mean over the passes that reach the frequency


@dataclass(frozen=True)
class Spectrum:
    """Sums over passes (units in one direction) at f frequencies; no pass is kept, so that memory stays small."""

    frequency: np.ndarray  # (f,)
    count: np.ndarray  # (f,) passes that reach each frequency
    power: np.ndarray  # (f,) mean of the passes' powers, each on its own scale
    amplitude: np.ndarray  # (f,) root mean square of the passes' amplitudes
    common: tuple[Common, ...]
    taken: np.ndarray  # (f,) within a main lobe of a component already in the model


class Strokes:
    """Strokes of some samples along an axis, those long enough to say something of a ripple; m of them.

    Parameters
    ----------
    samples : DataFrame
        Samples of a stroke one after the other: stroke_id, direction, unit, the axis, `residual_N`.
    axis : str
        Column along which the wave runs.

    Attributes
    ----------
    low, span, step : ndarray, shape (m,)
        Where each begins, how far it goes, and from one sample to the next, in the unit of the axis.
    unit, direction : ndarray, shape (m,)
        Number of its file, and its direction.
    """

    def __init__(self, samples: pd.DataFrame, axis: str) -> None:
        self._place = samples[axis].to_numpy(dtype=float)
        self._residual = samples["residual_N"].to_numpy(dtype=float)
        stroke = samples["stroke_id"].to_numpy()
        start = np.flatnonzero(np.r_[True, stroke[1:] != stroke[:-1]][: stroke.size])
        size = np.diff(np.r_[start, stroke.size])
        low, high = (part.reduceat(self._place, start) if start.size else start for part in (np.minimum, np.maximum))
        good = (size >= LEAST_SAMPLES) & (high > low)
        self._start, self._size = start[good], size[good]
        self.low, self.span = low[good], (high - low)[good]
        self.step = self.span / (self._size - 1)
        self.unit, self.direction = (samples[name].to_numpy()[self._start] for name in ("unit", "direction"))

    def on_grids(self, chosen: np.ndarray, step: float, size: int) -> np.ndarray:
        """Return residuals of chosen strokes on even grids of `size` places from where each begins, (strokes, size)."""
        grid = step * np.arange(size)
        found = np.empty((chosen.size, size))
        for row, k in zip(found, chosen, strict=True):
            own = slice(self._start[k], self._start[k] + self._size[k])
            order = np.argsort(self._place[own], kind="stable")
            row[:] = np.interp(self.low[k] + grid, self._place[own][order], self._residual[own][order])
        return found


def spectrum_along(samples: pd.DataFrame, axis: str, known: Sequence[float] = ()) -> Spectrum | None:
    """Return the spectrum along one axis, summed over units and directions; None where there is too little.

    A stroke is freed of a parabola, tapered (Hann) and transformed on a grid that divides twice the longest stroke, so
    that every stroke has the same frequencies whatever its sampling; the wavelength is at most half a usual stroke.
    """
    strokes = Strokes(samples, axis)
    if strokes.span.size < 3:
        return None
    longest = 2 * strokes.span.max()
    points = np.clip(np.ceil(longest / strokes.step), 8, 2**15).astype(int)
    distinct, number = np.unique(points, return_inverse=True)
    points = np.array([next_fast_len(int(n), real=True) for n in distinct])[number]
    frequency = np.arange(min(2**15, int(np.ceil(longest / np.quantile(strokes.step, 0.1)))) // 2 + 1) / longest
    reach = np.minimum(points // 2 + 1, np.searchsorted(frequency, 0.5 / strokes.step, side="right"))
    reaching = np.bincount(reach, minlength=frequency.size + 1)[::-1].cumsum()[::-1][1:]  # strokes, at each frequency
    use = (frequency >= 2 / np.median(strokes.span)) & (reaching[: frequency.size] >= 0.25 * reach.size)
    if use.sum() < 4:
        return None
    first, last = np.flatnonzero(use)[[0, -1]]  # with none between them left out, as fewer strokes reach further
    sums = _Sums(np.arange(first, last + 1), longest, np.unique(strokes.direction))
    reached = np.clip(reach, first, last + 1) - first
    for chosen in _parts(strokes.unit, points):
        sums.add(strokes, chosen, points[chosen], reached[chosen])
    near = np.zeros(int(use.sum()), dtype=bool)
    for wavelength in known:
        near |= np.abs(frequency[use] - 1 / wavelength) <= LOBE / longest
    return sums.spectrum(near)


def _parts(unit: np.ndarray, points: np.ndarray) -> list[np.ndarray]:
    """Return numbers of strokes, whole units of so many points together, those with like grids beside each other."""
    own, code = np.unique(unit, return_inverse=True)
    finest = np.zeros(own.size, dtype=int)
    np.maximum.at(finest, code, points)
    order = np.lexsort((code, finest[code]))
    begin = np.flatnonzero(np.r_[True, np.diff(code[order]) != 0])
    part = np.cumsum(points[order])[begin] // MOST_NUMBERS
    return np.split(order, begin[1:][np.diff(part) > 0])


@lru_cache(maxsize=512)  # strokes of one speed share their grids: one each for hundreds of thousands
def _on_grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return an orthonormal basis of parabolas on an even grid, shape (size, 3), and the Hann taper, shape (size,)."""
    trend, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, size), 3))
    taper = np.hanning(size + 2)[1:-1]
    return trend, taper * (2 / taper.sum())


def _power(wave: np.ndarray) -> np.ndarray:
    return wave.real**2 + wave.imag**2


class _Sums:
    """A spectrum in the making: what is kept of the units.

    Parameters
    ----------
    numbers : ndarray of int, shape (f,)
        Which multiples of 1 / `longest` the frequencies are.
    longest : float
        Length, or time, of which all grids are parts.
    sides : ndarray
        Directions that there are.
    """

    def __init__(self, numbers: np.ndarray, longest: float, sides: np.ndarray) -> None:
        self.numbers, self.longest, self.sides = numbers, longest, sides
        size = numbers.size
        self.count, self.power, self.square = np.zeros(size), np.zeros(size), np.zeros(size)
        ways = (True, False) if sides.size == 2 else (True,)
        self.common = {way: [np.zeros(size, complex), np.zeros(size), 0, np.zeros(size, complex)] for way in ways}

    def add(self, strokes: Strokes, chosen: np.ndarray, points: np.ndarray, reach: np.ndarray) -> None:
        """Add whole units: the points of each chosen stroke's grid, and how many of the frequencies it reaches."""
        units, unit = np.unique(strokes.unit[chosen], return_inverse=True)
        passes = unit * self.sides.size + np.searchsorted(self.sides, strokes.direction[chosen])
        every, width = np.arange(chosen.size), int(reach.max())
        summing = csr_array((np.ones(chosen.size), (passes, every)), (units.size * self.sides.size, chosen.size))
        known = summing @ (np.arange(width) < reach[:, None]).astype(float)
        wave = summing @ self._transformed(strokes, chosen, points, reach) / np.maximum(known, 1)
        wave, known = (part.reshape(units.size, self.sides.size, width) for part in (wave, known > 0))
        power = _power(wave)
        mean = power.sum(axis=2) / np.maximum(known.sum(axis=2), 1)
        self.count[:width] += known.sum(axis=(0, 1))
        self.square[:width] += power.sum(axis=(0, 1))
        self.power[:width] += (power / np.maximum(mean, 1e-300)[:, :, None]).sum(axis=(0, 1))
        most = np.zeros(units.size, dtype=int)
        np.maximum.at(most, unit, reach)
        for way, sums in self.common.items():
            own = wave.sum(axis=1) if way else np.einsum("usf,s->uf", wave, self.sides)
            power = _power(own)
            square = _medians(power, most)  # each unit weighs by its own spread, so that one noisy file does not decide
            kept = square > 0
            sums[0][:width] += (own[kept] / np.sqrt(square[kept])[:, None]).sum(axis=0)
            sums[1][:width] += (power[kept] / square[kept, None]).sum(axis=0)
            sums[2] += int(own.any(axis=1).sum())
            sums[3][:width] += own.sum(axis=0)

    def _transformed(self, strokes: Strokes, chosen: np.ndarray, points: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return complex amplitudes of strokes, phases counted from place 0, 0 beyond reach, (strokes, most)."""
        found = np.zeros((chosen.size, int(reach.max())), dtype=complex)
        size = np.ceil(strokes.span[chosen] * points / self.longest).astype(int)
        for length, count in np.unique(np.column_stack([points, size]), axis=0):
            alike = np.flatnonzero((points == length) & (size == count))
            trend, taper = _on_grid(count)
            value = strokes.on_grids(chosen[alike], self.longest / length, count)
            value -= (value @ trend) @ trend.T
            width = int(reach[alike].max())
            wave = np.fft.rfft(value * taper, length)[:, self.numbers[0] : self.numbers[0] + width]
            found[alike, :width] = np.where(np.arange(width) < reach[alike, None], wave, 0.0)
        turn = -2j * np.pi / self.longest * strokes.low[chosen, None]
        many, few = np.divmod(self.numbers[: found.shape[1]], EXPONENTS)  # a product of two costs less than a power
        found *= np.exp(turn * EXPONENTS * np.arange(many[-1] + 1))[:, many]
        return found * np.exp(turn * np.arange(EXPONENTS))[:, few]

    def spectrum(self, taken: np.ndarray) -> Spectrum:
        """Return the spectrum of all units added, shape (f,) of `taken`."""
        count, frequency = np.maximum(self.count, 1), self.numbers / self.longest
        common = tuple(
            Common(way, total, square, units, own / count) for way, (total, square, units, own) in self.common.items()
        )
        return Spectrum(frequency, self.count, self.power / count, np.sqrt(self.square / count), common, taken)


def _medians(values: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return the median of the first so many values of each row, shape (rows,); 0 of none."""
    found = np.zeros(count.size)
    for size in np.unique(count[count > 0]):
        alike = count == size
        found[alike] = np.median(values[alike, :size], axis=1)
    return found
