r"""Ripples: periodic force along displacement or time, sought on the raw samples of the steady windows.

Bins hide what is finer than they are, so every stroke's own samples are transformed: :math:`Z_u(f)` is the complex
amplitude of unit u (a file, or a run of many) at frequency f. A ripple of the rig has one phase everywhere, so
:math:`R = |\sum_u Z_u|^2 / \sum_u |Z_u|^2` is large; with phases that fall as they like, R is exponential with mean 1.
Where each file has an origin of its own only the power is shared: it is held against the local background spectrum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy import stats
from scipy.special import digamma, polygamma

from sealfit.closure.waves import freed_of_trend, strokes_of

NEIGHBOURS = 25  # frequencies on each side that make the local background
SHARED = 1e-3  # p-value below which the phase is taken to be common to all files
LOBE = 4  # frequencies on each side that the taper smears a peak over
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


@dataclass(frozen=True)
class Spectra:
    """Complex amplitudes per unit and direction on one grid of frequencies."""

    frequency: np.ndarray  # (f,)
    amplitude: np.ndarray  # (units, f) complex, zero above a unit's own Nyquist frequency
    known: np.ndarray  # (units, f) whether the unit reaches that frequency
    direction: np.ndarray  # (units,)
    unit: np.ndarray  # (units,) number of the file or run
    strokes: np.ndarray  # (units,) strokes averaged
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
    peaks = []
    for axis in axes:
        spectra = spectra_along(samples, axis)
        if spectra is None:
            continue
        spectra = _without(spectra, [wavelength for place, wavelength in known if place == axis])
        if common_phase and axis == "displacement_mm":
            peaks += _coherent(spectra, axis)
        peaks += _incoherent(spectra, axis)
    if not peaks:
        return None
    best = min(peaks, key=lambda peak: (peak.p_value, -peak.statistic))
    # A phase that all files share says more than power alone: where it is there, the ripple is the rig's.
    shared = [p for p in peaks if p.common_phase and p.axis == best.axis and p.p_value < SHARED]
    best = next((p for p in shared if abs(p.wavelength / best.wavelength - 1) < 0.05), best)
    return replace(best, p_value=min(1.0, best.p_value * len(peaks)))


def spectra_along(samples: pd.DataFrame, axis: str) -> Spectra | None:
    """Return the complex amplitudes of each unit and direction along one axis.

    A stroke is freed of a parabola, tapered (Hann) and transformed on a grid that divides twice the longest stroke, so
    that every stroke has the same frequencies whatever its sampling; the wavelength is at most half a usual stroke.
    """
    good = list(strokes_of(samples, axis))
    if len(good) < 3:
        return None
    spans = np.array([place[-1] - place[0] for _, place, _ in good])
    steps = spans / (np.array([place.size for _, place, _ in good]) - 1)
    longest = 2 * spans.max()
    count = int(min(2**15, np.ceil(longest / np.quantile(steps, 0.1))))
    frequency = np.arange(count // 2 + 1) / longest
    lowest = 2 / np.median(spans)
    direction = samples["direction"].to_numpy()[[a for a, *_ in good]]
    unit = pd.factorize(samples["unit"].to_numpy()[[a for a, *_ in good]])[0]
    keys, number = np.unique(np.column_stack([unit, direction]), axis=0, return_inverse=True)
    number = number.ravel()
    total = np.zeros((len(keys), frequency.size), dtype=complex)
    weight = np.zeros((len(keys), frequency.size))
    strokes = np.bincount(number, minlength=len(keys))
    for k, (_, place, residual) in enumerate(good):
        own = int(np.clip(np.ceil(longest / steps[k]), 8, 2**15))
        step = longest / own
        grid = np.arange(place[0], place[-1], step)
        value = freed_of_trend(grid, np.interp(grid, place, residual))
        taper = np.hanning(grid.size + 2)[1:-1]
        transform = np.fft.rfft(value * taper, own) * (2 / taper.sum())
        reach = min(transform.size, frequency.size)
        reach = min(reach, int(np.searchsorted(frequency, 0.5 / steps[k], side="right")))
        turned = transform[:reach] * np.exp(-2j * np.pi * frequency[:reach] * grid[0])
        total[number[k], :reach] += turned
        weight[number[k], :reach] += 1
    use = (frequency >= lowest) & (weight.sum(axis=0) >= 0.25 * len(good))
    if use.sum() < 4:
        return None
    amplitude = np.where(weight > 0, total / np.maximum(weight, 1), 0.0)
    return Spectra(
        frequency[use],
        amplitude[:, use],
        weight[:, use] > 0,
        keys[:, 1],
        keys[:, 0],
        strokes,
        np.zeros(use.sum(), dtype=bool),
    )


def _without(spectra: Spectra, wavelengths: Sequence[float]) -> Spectra:
    """Return the spectra with everything within a main lobe of some wavelengths marked as taken."""
    step = spectra.frequency[1] - spectra.frequency[0]
    near = np.zeros(spectra.frequency.size, dtype=bool)
    for wavelength in wavelengths:
        near |= np.abs(spectra.frequency - 1 / wavelength) <= LOBE * step
    return replace(spectra, taken=near)


def _coherent(spectra: Spectra, axis: str) -> list[Peak]:
    """Return the best peak of each way of acting: the same force both ways, or following the direction."""
    both = np.unique(spectra.direction).size == 2
    peaks = []
    for symmetric in (True, False) if both else (True,):
        factor = np.ones_like(spectra.direction, dtype=float) if symmetric else spectra.direction.astype(float)
        turned = spectra.amplitude * factor[:, None]
        size = np.maximum(spectra.unit.max() + 1, 1)
        by_unit = np.zeros((size, spectra.frequency.size), dtype=complex)
        np.add.at(by_unit, spectra.unit, turned)
        # Each unit weighs by its own spread, so that one noisy file does not decide.
        spread = np.sqrt(np.median(np.abs(by_unit) ** 2, axis=1, keepdims=True)) + 1e-300
        white = by_unit / spread
        total = np.abs(white.sum(axis=0)) ** 2
        statistic = total / np.maximum((np.abs(white) ** 2).sum(axis=0), 1e-300)
        sharp = total / _background(np.where(spectra.taken, np.nan, total)) > ABOVE_BACKGROUND
        units = int((np.abs(by_unit) > 0).any(axis=1).sum())
        if units < 4 or not sharp.any():
            continue
        k = int(np.argmax(np.where(sharp & _tops(total) & ~spectra.taken, statistic, 0)))
        p = _coherence_p(statistic[k], units) * spectra.frequency.size * (2 if both else 1)
        present = spectra.known[:, k]
        amplitude = float(np.abs((turned[present, k]).mean()))
        peaks.append(
            Peak(axis, _refined(total, spectra.frequency, k), symmetric, True, float(statistic[k]), p, amplitude)
        )
    return peaks


def _coherence_p(statistic: float, units: int) -> float:
    """Return P(R >= statistic) for random phases: R/n is Beta(1, n - 1) where amplitudes are alike."""
    return float(stats.beta.sf(min(statistic / units, 1.0), 1, max(units - 1, 1)))


def _incoherent(spectra: Spectra, axis: str) -> list[Peak]:
    """Return the best peak of power shared by all units whatever their phases.

    The mean of U units' powers, each on its own scale, is Gamma(U) about the background; where units share a texture
    of the track, as if there were fewer of them.
    """
    power = np.abs(spectra.amplitude) ** 2
    count = spectra.known.sum(axis=0)
    scale = power.sum(axis=1, keepdims=True) / np.maximum(spectra.known.sum(axis=1, keepdims=True), 1)
    mean = (power / np.maximum(scale, 1e-300)).sum(axis=0) / np.maximum(count, 1)
    ratio = mean / _smooth_background(np.where(spectra.taken, np.nan, mean), spectra.frequency, count)
    count = np.minimum(count, _alike(np.where(spectra.taken, np.nan, ratio)))
    own = stats.gamma.logsf(ratio * count, count)
    k = int(np.argmin(np.where(_tops(mean) & ~spectra.taken, own, 1.0)))
    p = float(np.exp(own[k])) * spectra.frequency.size
    amplitude = float(np.sqrt((power[:, k] * spectra.known[:, k]).sum() / max(spectra.known[:, k].sum(), 1)))
    return [Peak(axis, _refined(mean, spectra.frequency, k), True, False, float(ratio[k]), p, amplitude)]


def _alike(ratio: np.ndarray) -> np.ndarray:
    """Return of how many independent powers a spectrum behaves like the mean, by its neighbours' spread, shape (f,).

    The logarithm of a mean of c powers has the variance trigamma(c); its spread is taken from the quartiles, which a
    few peaks do not move.
    """
    low, high = np.nanquantile(_neighbours(np.log(np.maximum(ratio, 1e-300))), (0.25, 0.75), axis=1)
    spread = ((high - low) / 1.349) ** 2
    numbers = np.geomspace(1e5, 1.0, 200)
    return np.interp(spread, polygamma(1, numbers), numbers)


def _neighbours(value: np.ndarray) -> np.ndarray:
    """Return each frequency's neighbours, its own main lobe and what lies beyond the ends NaN, shape (f, window)."""
    padded = np.pad(value, NEIGHBOURS, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1).copy()
    windows[:, np.abs(np.arange(-NEIGHBOURS, NEIGHBOURS + 1)) <= LOBE] = np.nan
    return windows


def _tops(power: np.ndarray) -> np.ndarray:
    """Return where a spectrum is highest within a main lobe each side, its low end left out, shape (f,).

    At the low end stand the smooth shapes of a stroke (warming, drift), which are no ripple.
    """
    padded = np.pad(power, LOBE, constant_values=np.inf)[: power.size + LOBE]
    padded = np.r_[padded, np.zeros(LOBE)]
    highest = np.lib.stride_tricks.sliding_window_view(padded, 2 * LOBE + 1).max(axis=1)
    return power >= highest


def _smooth_background(power: np.ndarray, frequency: np.ndarray, count: np.ndarray) -> np.ndarray:
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


def _background(power: np.ndarray) -> np.ndarray:
    """Return the median of each frequency's neighbours, the peak's own main lobe left out."""
    return np.maximum(np.nanmedian(_neighbours(power), axis=1), 1e-300)


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
