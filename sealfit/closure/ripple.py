r"""Ripples: periodic force along displacement or time, sought on the raw samples of the steady windows.

Bins hide what is finer than they are, so every stroke's own samples are transformed: :math:`Z_u(f)` is the complex
amplitude of unit u (a file) at frequency f. A ripple of the rig has one phase everywhere, so
:math:`R = |\sum_u Z_u|^2 / \sum_u |Z_u|^2` is large; with phases that fall as they like, R is exponential with mean 1.
Where each file has an origin of its own only the power is shared: it is held against the local background spectrum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.special import betaincc, gammaincc

from sealfit.closure.background import LOBE, alike, background, smooth_background, tops
from sealfit.closure.spectrum import Spectrum, spectra_of

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


AXES = ("displacement_mm", "time_s")  # time is the rival of displacement: mains, servo


def find_ripple(
    samples: pd.DataFrame, *, common_phase: bool, known: Sequence[tuple[str, float]] = (), workers: int = 1
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
    workers : int
        Processes to use where there are many samples.
    """
    peaks, locked = [], []
    for spectrum in spectra_of(samples, AXES, known, workers=workers):
        if common_phase and spectrum.axis == "displacement_mm":
            peaks += _coherent(spectrum)
        elif spectrum.axis == "time_s":  # which counts from the start of every stroke: a wave may be locked to that
            locked = _coherent(spectrum)
        peaks.append(_incoherent(spectrum))
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


def _coherent(spectrum: Spectrum) -> list[Peak]:
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
        peaks.append(Peak(spectrum.axis, wavelength, common.symmetric, True, float(statistic[k]), p, amplitude, energy))
    return peaks


def _coherence_p(statistic: float, units: int) -> float:
    """Return P(R >= statistic) for random phases: R/n is Beta(1, n - 1) where amplitudes are alike."""
    return float(betaincc(1, max(units - 1, 1), min(statistic / units, 1.0)))


def _incoherent(spectrum: Spectrum) -> Peak:
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
        spectrum.axis,
        wavelength,
        True,
        False,
        float(ratio[k]),
        p,
        float(spectrum.amplitude[k]),
        float(energy[sure].max()),
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
