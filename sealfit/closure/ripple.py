r"""Ripples: periodic force along displacement or time, sought on the raw samples of the steady windows.

Bins hide what is finer than they are, so every stroke's own samples are transformed: :math:`Z_u(f)` is the complex
amplitude of unit u (a file) at frequency f. A ripple of the rig has one phase everywhere, so
:math:`R = |\sum_u Z_u|^2 / \sum_u |Z_u|^2` is large; with phases that fall as they like, R is exponential with mean 1.
Where each file has an origin of its own only the power is shared: it is held against the local background spectrum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pandas as pd
from scipy.fft import next_fast_len
from scipy.special import betaincc, gammaincc

from sealfit.closure.background import LOBE, alike, background, smooth_background, tops
from sealfit.closure.waves import strokes_of

SHARED = 1e-3  # p-value below which the phase is taken to be common to all files
ABOVE_BACKGROUND = 4.0  # a peak's power over the median of its neighbours: a smooth trend has no peak


@dataclass(frozen=True)
class Peak:
    """One periodic component: along which axis, its wavelength, how it acts and how surely it is there."""

    axis: str  # displacement_mm | time_s
    wavelength: float
    sign_symmetric: bool  # True: same force both ways (added force); False: follows the direction (factor)
    common_phase: bool
    statistic: float
    p_value: float  # adjusted over the frequencies, axes and ways of acting looked at
    amplitude: float  # in force units, mean over units
    energy: float  # squared amplitudes, all passes that reach the frequency: of the largest sure wave along the axis


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


def find_ripple(
    samples: pd.DataFrame,
    *,
    common_phase: bool,
    known: Sequence[tuple[str, float]] = (),
    axes: tuple[str, ...] = ("displacement_mm", "time_s"),
) -> Peak | None:
    """Return the strongest periodic component of the samples' residual, or None where there is none to test.

    Parameters
    ----------
    samples : DataFrame
        Steady samples, those of a stroke one after the other: stroke_id, direction, unit, the axes, `residual_N`.
    common_phase : bool
        Whether displacement means the same place in every file (`position_origin = "rig"`).
    known : sequence of (axis, wavelength)
        Components already in the model: what is left around them is their own scatter from file to file.
    axes : tuple of str
        Axes to look along; time is the rival of displacement (mains, servo).
    """
    peaks, locked = [], []
    for axis in axes:
        spectrum = spectrum_along(samples, axis, [wavelength for place, wavelength in known if place == axis])
        if spectrum is None:
            continue
        if common_phase and axis == "displacement_mm":
            peaks += _coherent(spectrum, axis)
        elif axis == "time_s":  # which counts from the start of every stroke: a wave may be locked to that
            locked = _coherent(spectrum, axis)
        peaks.append(_incoherent(spectrum, axis))
    if not peaks:
        return None
    # What is periodic in time shows in displacement too, speed by speed, and the other way round: where both are sure,
    # the axis along which it is the same wave in all files holds more of it.
    sure = [peak for peak in peaks if peak.p_value < SHARED]
    best = max(sure, key=lambda p: p.energy) if sure else min(peaks, key=lambda p: (p.p_value, -p.statistic))
    # A phase that all files share says more than power alone.
    shared = [p for p in (*peaks, *locked) if p.common_phase and p.axis == best.axis and p.p_value < SHARED]
    best = next((p for p in shared if abs(p.wavelength / best.wavelength - 1) < 0.05), best)
    return replace(best, p_value=min(1.0, best.p_value * len(peaks)))


def spectrum_along(samples: pd.DataFrame, axis: str, known: Sequence[float] = ()) -> Spectrum | None:
    """Return the spectrum along one axis, summed over units and directions; None where there is too little.

    A stroke is freed of a parabola, tapered (Hann) and transformed on a grid that divides twice the longest stroke, so
    that every stroke has the same frequencies whatever its sampling; the wavelength is at most half a usual stroke.
    """
    good = list(strokes_of(samples, axis))
    if len(good) < 3:
        return None
    spans = np.array([place[-1] - place[0] for _, place, _ in good])
    steps = spans / (np.array([place.size for _, place, _ in good]) - 1)
    longest = 2 * spans.max()
    points = np.array([next_fast_len(int(n), real=True) for n in np.clip(np.ceil(longest / steps), 8, 2**15)])
    frequency = np.arange(min(2**15, int(np.ceil(longest / np.quantile(steps, 0.1)))) // 2 + 1) / longest
    reach = np.minimum(points // 2 + 1, np.searchsorted(frequency, 0.5 / steps, side="right"))
    strokes = np.bincount(reach, minlength=frequency.size + 1)[::-1].cumsum()[::-1][1:]  # that reach each frequency
    use = (frequency >= 2 / np.median(spans)) & (strokes[: frequency.size] >= 0.25 * len(good))
    if use.sum() < 4:
        return None
    first = [a for a, *_ in good]
    direction = samples["direction"].to_numpy()[first]
    unit = samples["unit"].to_numpy()[first]
    sums = _Sums(int(use.sum()), (True, False) if np.unique(direction).size == 2 else (True,))
    order = np.argsort(unit, kind="stable")
    for strokes_of_unit in np.split(order, np.flatnonzero(np.diff(unit[order])) + 1):
        passes = {}
        for side in np.unique(direction[strokes_of_unit]):
            total, weight = np.zeros(frequency.size, dtype=complex), np.zeros(frequency.size)
            for k in strokes_of_unit[direction[strokes_of_unit] == side]:
                wave = _transform(good[k][1], good[k][2], longest, points[k], reach[k])
                total[: wave.size] += wave
                weight[: wave.size] += 1
            passes[side] = (total[use] / np.maximum(weight[use], 1), weight[use] > 0)
        sums.add(passes)
    near = np.zeros(int(use.sum()), dtype=bool)
    for wavelength in known:
        near |= np.abs(frequency[use] - 1 / wavelength) <= LOBE / longest
    return sums.spectrum(frequency[use], near)


def _transform(place: np.ndarray, residual: np.ndarray, longest: float, points: int, reach: int) -> np.ndarray:
    """Return a stroke's complex amplitudes at the first multiples of 1 / `longest`, phases counted from place 0."""
    grid = np.arange(place[0], place[-1], longest / points)
    trend, taper = _on_grid(grid.size)
    value = np.interp(grid, place, residual)
    value -= trend @ (value @ trend)
    wave = np.fft.rfft(value * taper, points)[:reach]
    return wave * np.exp(-2j * np.pi / longest * grid[0] * np.arange(wave.size))


@lru_cache(maxsize=512)  # strokes of one speed share their grids: one each for hundreds of thousands
def _on_grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return an orthonormal basis of parabolas on an even grid, shape (size, 3), and the Hann taper, shape (size,)."""
    trend, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, size), 3))
    taper = np.hanning(size + 2)[1:-1]
    return trend, taper * (2 / taper.sum())


def _power(wave: np.ndarray) -> np.ndarray:
    return wave.real**2 + wave.imag**2


class _Sums:
    """A spectrum in the making: what is kept of each unit."""

    def __init__(self, size: int, ways: tuple[bool, ...]) -> None:
        self.count, self.power, self.square = np.zeros(size), np.zeros(size), np.zeros(size)
        self.common = {way: [np.zeros(size, complex), np.zeros(size), 0, np.zeros(size, complex)] for way in ways}

    def add(self, passes: dict[float, tuple[np.ndarray, np.ndarray]]) -> None:
        """Add one unit: per direction its amplitudes and which frequencies it reaches, each of shape (f,)."""
        for wave, known in passes.values():
            power = _power(wave)
            self.count += known
            self.square += power
            self.power += power / max(power.sum() / max(known.sum(), 1), 1e-300)
        reached = np.any([known for _, known in passes.values()], axis=0)
        for way, sums in self.common.items():
            own = sum(wave * (1.0 if way else side) for side, (wave, _) in passes.items())
            # Each unit weighs by its own spread, so that one noisy file does not decide.
            power = _power(own)
            square = np.median(power[reached]) if reached.any() else 0.0
            if square > 0:
                sums[0] += own / np.sqrt(square)
                sums[1] += power / square
            sums[2] += bool(own.any())
            sums[3] += own

    def spectrum(self, frequency: np.ndarray, taken: np.ndarray) -> Spectrum:
        """Return the spectrum of all units added."""
        count = np.maximum(self.count, 1)
        common = tuple(
            Common(way, total, square, units, own / count) for way, (total, square, units, own) in self.common.items()
        )
        return Spectrum(frequency, self.count, self.power / count, np.sqrt(self.square / count), common, taken)


def _coherent(spectrum: Spectrum, axis: str) -> list[Peak]:
    """Return the best peak of each way of acting: the same force both ways, or following the direction."""
    peaks = []
    for common in spectrum.common:
        total = np.abs(common.total) ** 2
        statistic = total / np.maximum(common.square, 1e-300)
        sharp = total / background(np.where(spectrum.taken, np.nan, total)) > ABOVE_BACKGROUND
        if common.units < 4 or not sharp.any():
            continue
        k = int(np.argmax(np.where(sharp & tops(total) & ~spectrum.taken, statistic, 0)))
        p = _coherence_p(statistic[k], common.units) * spectrum.frequency.size * len(spectrum.common)
        wavelength, amplitude = _refined(total, spectrum.frequency, k), float(np.abs(common.amplitude[k]))
        energy = amplitude**2 * float(spectrum.count[k])
        peaks.append(Peak(axis, wavelength, common.symmetric, True, float(statistic[k]), p, amplitude, energy))
    return peaks


def _coherence_p(statistic: float, units: int) -> float:
    """Return P(R >= statistic) for random phases: R/n is Beta(1, n - 1) where amplitudes are alike."""
    return float(betaincc(1, max(units - 1, 1), min(statistic / units, 1.0)))


def _incoherent(spectrum: Spectrum, axis: str) -> Peak:
    """Return the best peak of power shared by all units whatever their phases.

    The mean of U units' powers, each on its own scale, is Gamma(U) about the background; where units share a texture
    of the track, as if there were fewer of them.
    """
    open_power = np.where(spectrum.taken, np.nan, spectrum.power)
    ratio = spectrum.power / smooth_background(open_power, spectrum.frequency, spectrum.count)
    count = np.minimum(spectrum.count, alike(np.where(spectrum.taken, np.nan, ratio)))
    with np.errstate(divide="ignore"):  # -inf: beyond doubt
        own = np.log(gammaincc(count, ratio * count))
    peaks = tops(spectrum.power) & ~spectrum.taken
    k = int(np.argmin(np.where(peaks, own, 1.0)))
    p = float(np.exp(own[k])) * spectrum.frequency.size
    wavelength = _refined(spectrum.power, spectrum.frequency, k)
    energy = spectrum.amplitude**2 * spectrum.count * (1 - 1 / np.maximum(ratio, 1.0))
    sure = peaks & (own < np.log(SHARED / spectrum.frequency.size))
    sure[k] = True
    return Peak(
        axis, wavelength, True, False, float(ratio[k]), p, float(spectrum.amplitude[k]), float(energy[sure].max())
    )


def _refined(power: np.ndarray, frequency: np.ndarray, k: int) -> float:
    """Return the wavelength at the parabola through the highest point of a peak and its two neighbours."""
    first = max(k - LOBE, 0)
    k = first + int(np.argmax(power[first : k + LOBE + 1]))
    if 0 < k < power.size - 1:
        left, middle, right = power[k - 1 : k + 2]
        bend = left - 2 * middle + right
        if bend < 0:
            shift = 0.5 * (left - right) / bend
            return float(1 / (frequency[k] + shift * (frequency[1] - frequency[0])))
    return float(1 / frequency[k])
