"""Search for ripples, periodic forces along displacement or time, in the raw samples of steady windows."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd
from numpy.polynomial.legendre import legvander
from scipy.special import betaincc, fdtrc, gammaincc

from sealfit.closure import criteria
from sealfit.closure.spectrum import (
    AxisStrokes,
    Spectrum,
    background,
    effective_count,
    smooth_background,
    spectrum_of,
    tops,
)
from sealfit.fit.joint.model import Model, passes
from sealfit.fit.joint.rows import Rows
from sealfit.ingest.strokes import SPEEDS_APART

# Bins are too coarse for short waves, so the samples of every stroke are transformed: :math:`Z_u(f)` is the
# complex amplitude of unit u (a file) at frequency f. A ripple of the rig has the same phase in all files, so
# :math:`R = |\sum_u Z_u|^2 / \sum_u |Z_u|^2` is large; with random phases R is exponential with mean 1. If
# each file has an origin of its own, only the power is common, and it is tested against the local background
# of the spectrum.


@dataclass(frozen=True)
class Peak:
    """A periodic component: its axis, wavelength, mode and evidence."""

    axis: str  # displacement_mm | time_s
    wavelength: float
    sign_symmetric: bool  # False: with the sign of the direction (factor); True: added force
    common_phase: bool
    statistic: float
    p_value: float  # adjusted over frequencies, axes and modes
    energy: float  # sum of squared amplitudes over passes, of the largest significant wave along the axis


AXES = ("displacement_mm", "time_s")  # in time: mains, servo

LONG_WAVES = np.linspace(1.5, 4.5, 16)  # Periods per median stroke that are tried for waves of few periods.
RANDOM_PHASES = 9_999  # Sums with random phases with which that of the files is compared.
# Least ratio of the sum of all files to that of the directions each by itself if they share the phase: a
# backlash shifts one against the other, and the phases of either direction agree.
SAME_BOTH_WAYS = 0.98
MOST_PHASES = 1 << 22  # Phases of all files that are drawn at once: 67 MB.
MAIN_LOBE = 2  # Periods per stroke about a wave in the model within which what is left of it is found again.
CURVE_DEGREE = 14  # Degree of the Legendre series of a curve of the position; it resolves six periods.
# Degrees of the Legendre series of a smooth curve along the travel, without the parabola.
TRAVEL_DEGREES = np.arange(3, 7)
# Least share of what a curve of the position explains that a wave must explain. A bump of the position, a
# change of slope and warming leave 7 % and more of the curve unexplained.
WAVE_OF_CURVE = 0.95
# Least ratio of what a wave along the other axis explains to what the peak explains if it takes its place.
OTHER_AXIS = 1.2


def find_ripple(
    samples: pd.DataFrame,
    *,
    common_phase: bool,
    known: Sequence[tuple[str, float]] = (),
    ignored: Collection[str] = (),
) -> Peak | None:
    """Return the strongest periodic component of the samples' residual, or None if none can be tested.

    The samples are steady and ordered by stroke: stroke_id, direction, unit, the axes, `residual_N`. With
    `common_phase`, displacement means the same place in every file (`position_origin = "rig"`). `known` are
    axis and wavelength of the components in the model. The axes that are `ignored` are not searched.
    """
    peaks, locked = [], []
    if common_phase and samples["unit"].nunique() < criteria.LEAST_GROUPS_HELD_OUT:
        samples = samples.assign(unit=samples["stroke_id"])  # strokes are held out, too
    speed = _one_speed(samples) if known else 0.0
    for axis in (name for name in AXES if name not in ignored):
        lengths = [length for own, length in known if own == axis]
        if speed:  # a wave in time is the same as one along displacement
            factor = 1 / speed if axis == "time_s" else speed
            lengths += [length * factor for own, length in known if own != axis]
        if common_phase and axis == "displacement_mm":
            peaks += _long_waves(samples, lengths)
        spectrum = spectrum_of(samples, axis, lengths)
        if spectrum is None:
            continue
        if common_phase and axis == "displacement_mm":
            peaks += _coherent(spectrum)
        elif axis == "time_s":  # a wave may be locked to the start of the strokes
            locked = _coherent(spectrum)
        peaks += _incoherent(spectrum)
    if not peaks:
        return None
    # A wave in time is also seen along displacement, at each speed, and vice versa. If both are significant,
    # the axis along which it is the same wave in all files has more energy.
    significant = [peak for peak in peaks if peak.p_value < criteria.SHARED_PHASE]
    best = min(peaks, key=lambda p: (p.p_value, -p.statistic))
    best = max(significant, key=lambda p: p.energy, default=best)
    best = _along_likelier_axis(best, samples, ignored)
    # A common phase is stronger evidence than power.
    shared = [p for p in (*peaks, *locked) if p.common_phase and p.p_value < criteria.SHARED_PHASE]
    same_axis = [p for p in shared if p.axis == best.axis]
    best = next((p for p in same_axis if abs(p.wavelength / best.wavelength - 1) < 0.05), best)
    if common_phase and not best.common_phase:
        best = _with_shared_phase(best, samples)
    return replace(best, p_value=min(1.0, best.p_value * len(peaks)))


def _one_speed(samples: pd.DataFrame) -> float:
    """Return the speed of the samples in units of the axes, or 0 if their strokes differ in it."""
    ends = samples.groupby("stroke_id")[list(AXES)].agg(["min", "max"])
    spans = [ends[axis]["max"] - ends[axis]["min"] for axis in AXES]
    speeds = (spans[0] / spans[1].where(spans[1] > 0)).dropna()
    return float(speeds.median()) if speeds.size and speeds.max() <= SPEEDS_APART * speeds.min() else 0.0


def _along_likelier_axis(peak: Peak, samples: pd.DataFrame, ignored: Collection[str]) -> Peak:
    """Return a peak of the mean power as a wave along the other axis, if that explains more of all strokes.

    At the speed of the stroke that it explains most of, both are the same wave. Strokes with fewer than two
    samples per wave are left out.
    """
    other = next(axis for axis in AXES if axis != peak.axis)
    sure = not peak.common_phase and peak.p_value < criteria.SHARED_PHASE
    if not sure or other in ignored or _one_speed(samples):
        return peak
    ends = samples.groupby("stroke_id")[list(AXES)].agg(np.ptp)
    speed = ends[peak.axis] / ends[other].where(ends[other] > 0)
    explained = _explained_by_wave(samples, peak.axis, peak.wavelength)
    length = peak.wavelength / float(speed[explained.idxmax()])
    steps = ends.div(samples.groupby("stroke_id").size(), axis=0)
    fine = (steps[peak.axis] < peak.wavelength / 2) & (steps[other] < length / 2)
    seen = samples[samples["stroke_id"].isin(fine.index[fine])]
    if seen["unit"].nunique() < 2:
        return peak
    length, _ = common_wavelength(seen, length, other)
    own, its = (
        _explained_by_wave(seen, *place).sum() for place in ((peak.axis, peak.wavelength), (other, length))
    )
    return replace(peak, axis=other, wavelength=length) if its > OTHER_AXIS * own else peak


def _explained_by_wave(samples: pd.DataFrame, axis: str, wavelength: float) -> pd.Series:
    """Return the sum of squares that a wave of any phase explains in each stroke, by `stroke_id`."""
    strokes = waves_of(samples.assign(unit=samples["stroke_id"]), np.array([wavelength]), axis)
    return pd.Series((strokes.amplitudes * strokes.product).sum(axis=(1, 2)), strokes.unit)


def _with_shared_phase(peak: Peak, samples: pd.DataFrame) -> Peak:
    """Return a peak of the mean power, with one phase in all files if their phases agree.

    The sum of the files' complex amplitudes is compared with sums in which the phases are random. Files
    without the wave have little weight: a ripple may be that of one direction or of some conditions.
    """
    waves = waves_of(samples, np.array([peak.wavelength]), peak.axis)
    own = waves.amplitudes[:, 0] @ np.array([1, 1j])
    files, file = np.unique(waves.unit, return_inverse=True)
    sums = np.zeros((files.size, 2), dtype=complex)  # the same force in both directions, or with their sign
    np.add.at(sums, file, np.column_stack([own, waves.direction * own]))
    rng, alike, part = np.random.default_rng(0), np.zeros(2), max(1, MOST_PHASES // files.size)
    for first in range(0, RANDOM_PHASES, part):
        turned = np.exp(2j * np.pi * rng.random((min(part, RANDOM_PHASES - first), files.size)))
        alike += (np.abs(turned @ np.abs(sums)) >= np.abs(sums.sum(axis=0))).sum(axis=0)
    p_values = (1 + alike) / (1 + RANDOM_PHASES)
    whole = np.abs(sums.sum(axis=0))
    best = int(whole.argmax())
    each_way = sum(abs(own[waves.direction == way].sum()) for way in np.unique(waves.direction))
    if p_values.size * p_values[best] > criteria.SHARED_PHASE or whole[best] < SAME_BOTH_WAYS * each_way:
        return peak
    return replace(peak, common_phase=True, sign_symmetric=best == 0)


def _coherent(spectrum: Spectrum) -> list[Peak]:
    """Return the best peak per mode: the same force in both directions, or with the sign of the direction."""
    peaks, modes = [], len(spectrum.units)
    for mode in range(modes):
        total = np.abs(spectrum.total[mode]) ** 2
        statistic = total / np.maximum(spectrum.square[mode], 1e-300)
        sharp = total / background(np.where(spectrum.taken, np.nan, total)) > criteria.ABOVE_BACKGROUND
        found = sharp & tops(total) & ~spectrum.taken
        units = int(spectrum.units[mode])
        if units < 4 or not found.any():
            continue
        k = int(np.argmax(np.where(found, statistic, 0)))
        # With random phases R/n is Beta(1, n - 1) for equal amplitudes of n units.
        p = float(betaincc(1, max(units - 1, 1), min(statistic[k] / units, 1.0)))
        p = p * spectrum.frequency.size * modes
        wavelength = _refined(total, spectrum.frequency, k)
        energy = float(np.abs(spectrum.mean[mode, k])) ** 2 * float(spectrum.count[k])
        peaks.append(Peak(spectrum.axis, wavelength, mode == 0, True, float(statistic[k]), p, energy))
    return peaks


def _long_waves(samples: pd.DataFrame, known: Sequence[float]) -> list[Peak]:
    """Return the best wave of few periods per stroke, per mode, unless a smooth curve is as likely.

    The modes are the same force in both directions, that with the sign of the direction, and a force in one
    direction only. The mean over files of the amplitudes of sine and cosine is tested against their scatter
    (Hotelling's T squared). Nearly all of what any curve of the position that all files share explains must
    be the wave, and a curve along the travel, as of warming, must explain less.
    """
    strokes = AxisStrokes.of(samples, "displacement_mm")
    if not strokes.size.size:
        return []
    units, unit = np.unique(strokes.unit, return_inverse=True)
    sides, side = np.unique(strokes.direction, return_inverse=True)
    span, ends = np.median(strokes.span), (strokes.low.min(), (strokes.low + strokes.span).max())
    waves = np.array([m for m in LONG_WAVES if all(abs(m - span / length) > MAIN_LOBE for length in known)])
    if not waves.size:
        return []
    pairs = np.arange(2 * waves.size).reshape(2, -1).T  # columns of each wave's sine and cosine
    curve = pairs.size + np.arange(CURVE_DEGREE)
    travel = curve[-1] + 1 + np.arange(TRAVEL_DEGREES.size)
    size = travel[-1] + 1
    square, product = np.zeros((sides.size, size, size)), np.zeros((sides.size, units.size, size))
    own_square = np.zeros((sides.size, units.size, waves.size, 2, 2))
    for k, place in enumerate(zip(side, unit, strict=True)):
        gram = _long_wave_gram(strokes, k, waves / span, ends)
        square[place[0]] += gram[:-1, :-1]
        product[place] += gram[-1, :-1]
        own_square[place] += gram[pairs[:, :, None], pairs[:, None, :]]
    peaks = []
    modes = np.array([[1, 1], sides, [1, 0], [0, 1]]) if sides.size > 1 else np.ones((1, 1))
    sums = [(np.tensordot(mode**2, square, 1), np.tensordot(mode, product, 1)) for mode in modes]
    by_travel = max(_explained(own, along.sum(axis=0), travel) for own, along in sums)
    for mode, (own, along) in zip(modes, sums, strict=True):
        explained = partial(_explained, own, along.sum(axis=0))
        by_wave = np.array([explained(pair) for pair in pairs])
        best = int(np.argmax(by_wave))
        if by_wave[best] < max(WAVE_OF_CURVE * explained(curve), by_travel):
            continue
        normal = np.tensordot(mode**2, own_square[:, :, best], 1)
        seen = normal.any(axis=(1, 2))
        if seen.sum() < criteria.LEAST_GROUPS_HELD_OUT:
            continue
        amplitudes = (np.linalg.pinv(normal[seen]) @ along[seen][:, pairs[best], None])[:, :, 0]
        statistic, p = _mean_of_zero(amplitudes)
        length = span / _summit(waves, by_wave, best)
        p *= len(modes) * waves.size
        energy = float(np.linalg.norm(amplitudes.mean(axis=0))) ** 2 * (mode[side] != 0).sum()
        same = bool(mode.sum())  # not the sign of the direction
        peaks.append(Peak("displacement_mm", length, same, True, statistic, p, energy))
    return peaks


def _long_wave_gram(
    strokes: AxisStrokes, k: int, frequency: np.ndarray, ends: tuple[float, float]
) -> np.ndarray:
    """Return a stroke's Gram matrix of sines, cosines, curves of place and of travel, and the residual.

    `ends` are the lowest and the highest place of all strokes.
    """
    (place, value), (low, high) = strokes.along(k), ends
    turn = 2 * np.pi * place[:, None] * frequency
    of_place = legvander(2 * (place - low) / (high - low) - 1, CURVE_DEGREE)[:, 1:]
    of_travel = legvander(strokes.direction[k] * _even(place), TRAVEL_DEGREES[-1])[:, TRAVEL_DEGREES]
    flat = _flattened(place, np.column_stack([np.sin(turn), np.cos(turn), of_place, of_travel, value]))
    return flat.T @ flat


def _explained(square: np.ndarray, product: np.ndarray, columns: np.ndarray) -> float:
    """Return the sum of squares that some columns explain, from the normal equations of all."""
    own = product[columns]
    return float(own @ np.linalg.pinv(square[np.ix_(columns, columns)], rcond=1e-9) @ own)


def _mean_of_zero(numbers: np.ndarray) -> tuple[float, float]:
    """Return F and p of Hotelling's test that the mean of n vectors of k numbers, (n, k), is zero."""
    n, k = numbers.shape
    mean = numbers.mean(axis=0)
    statistic = float((n - k) / k * mean @ np.linalg.pinv(np.cov(numbers.T, ddof=0)) @ mean)
    return statistic, float(fdtrc(k, n - k, statistic))


def _incoherent(spectrum: Spectrum) -> list[Peak]:
    """Return the best peak of the mean power of all units, whatever their phases; none without a peak.

    The mean of U units' powers, each on its own scale, is Gamma(U) about the background. If units share a
    texture of the track, their effective number is smaller.
    """
    open_power = np.where(spectrum.taken, np.nan, spectrum.power)
    ratio = spectrum.power / smooth_background(open_power, spectrum.frequency, spectrum.count)
    count = np.minimum(spectrum.count, effective_count(np.where(spectrum.taken, np.nan, ratio)))
    with np.errstate(divide="ignore"):  # -inf for a p-value of 0
        own = np.log(gammaincc(count, ratio * count))
    peaks = tops(spectrum.power) & ~spectrum.taken
    if not peaks.any():
        return []
    k = int(np.argmin(np.where(peaks, own, 1.0)))
    p = float(np.exp(own[k])) * spectrum.frequency.size
    wavelength = _refined(spectrum.power, spectrum.frequency, k)
    energy = spectrum.amplitude**2 * spectrum.count * (1 - 1 / np.maximum(ratio, 1.0))
    significant = peaks & (own < np.log(criteria.SHARED_PHASE / spectrum.frequency.size))
    significant[k] = True
    most = float(energy[significant].max())
    return [Peak(spectrum.axis, wavelength, True, False, float(ratio[k]), p, most)]


def _refined(power: np.ndarray, frequency: np.ndarray, k: int) -> float:
    """Return the wavelength at the highest point of a peak."""
    first = max(k - criteria.LOBE, 0)
    return 1 / _summit(frequency, power, first + int(np.argmax(power[first : k + criteria.LOBE + 1])))


def _summit(places: np.ndarray, power: np.ndarray, k: int) -> float:
    """Return the maximum of a sampled curve, by the parabola through its highest point and two neighbours."""
    if 0 < k < power.size - 1:
        left, middle, right = power[k - 1 : k + 2]
        curvature = left - 2 * middle + right
        if curvature < 0:
            return float(places[k] + 0.25 * (left - right) / curvature * (places[k + 1] - places[k - 1]))
    return float(places[k])


# ---------------------------------------------------------------- stroke phases
# A pass is a file in one direction. A parabola, a sine and a cosine of the place are fitted to a stroke's
# residual by least squares weighted with a Hann window. The strokes of a pass share the sine and the cosine.

AROUND = np.linspace(-0.5, 0.5, 101)  # Periods per stroke on each side of a peak that are refined.


@dataclass(frozen=True)
class Waves:
    """Normal equations of sine and cosine at m wavelengths, for p passes in order of file and direction."""

    unit: np.ndarray  # (p,) number of the file
    direction: np.ndarray  # (p,)
    square: np.ndarray  # (p, m, 2, 2)
    product: np.ndarray  # (p, m, 2)
    total: np.ndarray  # (p,) sum of squares of the residual without its trend
    middle: np.ndarray  # (p,) mean of the strokes' mean places

    @property
    def amplitudes(self) -> np.ndarray:
        """Amplitudes of sine and cosine, shape (p, m, 2)."""
        return np.einsum("pmij,pmj->pmi", np.linalg.pinv(self.square, hermitian=True), self.product)


def waves_of(samples: pd.DataFrame, lengths: np.ndarray, axis: str) -> Waves:
    """Return the wave of each pass at m wavelengths, `lengths` in the unit of the axis, shape (m,).

    The samples are those of `find_ripple`; the wave runs along their column `axis`.
    """
    strokes = AxisStrokes.of(samples, axis)
    count = strokes.size.size
    square, product = np.zeros((count, lengths.size, 2, 2)), np.zeros((count, lengths.size, 2))
    total, middle = np.zeros((2, count))
    for k in range(count):
        place, value = strokes.along(k)
        turn = 2 * np.pi * place[:, None] / lengths
        columns = _flattened(place, np.column_stack([np.sin(turn), np.cos(turn), value]))
        waves, y = columns[:, :-1].reshape(place.size, 2, lengths.size), columns[:, -1]
        square[k], product[k] = np.einsum("nim,njm->mij", waves, waves), np.einsum("nim,n->mi", waves, y)
        total[k], middle[k] = y @ y, place.mean()
    order = np.lexsort((strokes.direction, strokes.unit))
    unit, direction = strokes.unit[order], strokes.direction[order]
    first = np.flatnonzero(np.r_[True, (np.diff(unit) != 0) | (np.diff(direction) != 0)][: order.size])
    parts = (part[order] for part in (square, product, total, middle))
    sums = [np.add.reduceat(part, first, axis=0) if first.size else part for part in parts]
    return Waves(unit[first], direction[first], *sums[:3], sums[3] / np.diff(np.r_[first, order.size]))


def _flattened(place: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return columns along a stroke, shape (n, k), weighted (Hann window) and without a parabola."""
    root = np.sqrt(np.hanning(place.size + 2)[1:-1])[:, None]
    trend, _ = np.linalg.qr(root * np.vander(_even(place), 3))
    columns = root * columns
    return columns - trend @ (trend.T @ columns)


def _even(place: np.ndarray) -> np.ndarray:
    """Return places along a stroke from -1 to 1 about their mean, shape (n,)."""
    return 2 * (place - place.mean()) / np.ptp(place)


def common_wavelength(samples: pd.DataFrame, wavelength: float, axis: str) -> tuple[float, float]:
    """Return the wavelength near a peak that explains most with a phase per pass, and its standard error.

    The error is a jackknife over files.
    """
    lengths = 1 / (1 / wavelength + AROUND / np.median(AxisStrokes.of(samples, axis).span))
    waves = waves_of(samples, lengths, axis)
    files, file = np.unique(waves.unit, return_inverse=True)
    explained = np.einsum("pmi,pmi->pm", waves.amplitudes, waves.product)
    share = np.zeros((len(files), lengths.size))  # of the sum of squares
    np.add.at(share, file, explained / np.maximum(waves.total, 1e-300)[:, None])
    without = np.array([_top(lengths, share.sum(axis=0) - own) for own in share])
    spread = (len(files) - 1) / len(files) * ((without - without.mean()) ** 2).sum()
    return _top(lengths, share.sum(axis=0)), float(np.sqrt(spread))


def _top(lengths: np.ndarray, power: np.ndarray) -> float:
    """Return the maximum of a sampled curve between its ends."""
    return _summit(lengths, power, int(np.clip(np.argmax(power), 1, power.size - 2)))


def agreement(samples: pd.DataFrame, first: np.ndarray, wavelength: float, axis: str) -> np.ndarray:
    """Return per file the scalar product of the amplitudes of its two halves, shape (files,).

    Without a wave both signs are equally likely. With too few files for a sign test the products are per
    pass. `first`, shape (n,), is true for the samples of the first half.
    """
    one, other = (waves_of(samples[mask], np.array([wavelength]), axis) for mask in (first, ~first))
    whole = [np.rec.fromarrays([part.unit, part.direction]) for part in (one, other)]
    _, mine, its = np.intersect1d(*whole, assume_unique=True, return_indices=True)
    cross = (one.amplitudes[mine, 0] * other.amplitudes[its, 0]).sum(axis=1)
    files, file = np.unique(one.unit[mine], return_inverse=True)
    return np.bincount(file, cross) if files.size >= criteria.LEAST_FILES_OF_RIPPLE else cross


def pass_shifts(samples: pd.DataFrame, rows: Rows, wavelength: float, axis: str) -> dict[str, float]:
    """Return per pass the shift of its origin from that of the wave, in the unit of the axis.

    Of the possible origins the one nearest to the middle of the pass is taken.
    """
    strokes = rows.table.iloc[rows.groups.starts["stroke"]]
    names = dict(zip(strokes["stroke_id"], passes(strokes), strict=True))
    first = samples.drop_duplicates(["unit", "direction"]).set_index(["unit", "direction"])["stroke_id"]
    waves = waves_of(samples, np.array([wavelength]), axis)
    sine, cosine = waves.amplitudes[:, 0].T
    shift = wavelength * np.arctan2(cosine, sine) / (2 * np.pi)
    shift -= wavelength * np.round((waves.middle + shift) / wavelength)
    keys = zip(waves.unit.tolist(), waves.direction.tolist(), strict=True)
    return {names[first[key]]: own for key, own in zip(keys, shift.tolist(), strict=True)}


def unresolved_wave(model: Model, rows: Rows) -> bool:
    """Whether the last effect of a model is a wave that no stroke distinguishes from an earlier one.

    Two waves are distinguished if the longest stroke has one period more of one than of the other.
    """
    waves = [
        (t.channels[0], v["lambda_"])
        for t, v in zip(model.terms, model.values, strict=True)
        if "lambda_" in v
    ]
    if not waves or not model.terms[-1].effect.periodic:
        return False
    (axis, length), earlier = waves[-1], waves[:-1]
    place = pd.Series(rows.values(axis)).groupby(rows.codes("stroke"))
    longest = float((place.max() - place.min()).max())
    return any(axis == other and abs(longest / length - longest / own) < 1.0 for other, own in earlier)
