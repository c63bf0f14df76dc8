"""Checks of a trace: single samples that cannot be right, and a speed that is not the commanded one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter

from sealfit.config import Config, Quality
from sealfit.errors import KEPT, Fault
from sealfit.ingest.file_names import TraceRef
from sealfit.ingest.strokes import Stroke, displacement_noise_mm

# ---------------------------------------------------------------- spikes

# Samples of the running median. Five are blind to one or two wrong ones, and exact on any slope.
NEIGHBOURS = 5
# Share of the samples that are usual.
USUAL = 0.95
# A spike is so many times as far off as all usual samples (of noise: 7.8 SDs); else it is one of many bursts.
APART = 4.0
# Usual steps by which a spike of displacement is off, at least: see `displacement_spikes`.
STEPS = 5.0
FIX = "Correct the cell if the true value is known."


def _beyond(force_N: np.ndarray, suspects: np.ndarray) -> np.ndarray:
    """Return which samples reach beyond their trace without its suspects by half of its range, shape (n,)."""
    rest = np.where(suspects, 0.0, force_N)  # at rest the force may be zero
    low, high = min(rest.min(), 0.0), max(rest.max(), 0.0)
    return np.maximum(low - force_N, force_N - high) > 0.5 * (high - low)


def displacement_spikes(
    file: str, displacement_mm: np.ndarray, line: np.ndarray, settings: Quality
) -> tuple[np.ndarray, list[Fault]]:
    """Return which rows to keep, shape (n,): none whose displacement jumps away and back; a finding for each.

    More than `max_bad_rows` of them are the nature of the signal, and all are kept.
    """
    keep = np.ones(len(displacement_mm), bool)
    if len(displacement_mm) < 4 * NEIGHBOURS:
        return keep, []
    off = displacement_mm - median_filter(displacement_mm, NEIGHBOURS, mode="mirror")
    # At a turn the median lags by one step of the fastest samples around, never by more than a few of the
    # usual ones.
    step = np.median(np.abs(np.diff(displacement_mm)))
    noise = displacement_noise_mm(displacement_mm)
    least = max(STEPS * step, APART * np.quantile(np.abs(off), USUAL), 1e-9 * float(np.ptp(displacement_mm)))
    spikes = np.abs(off) > max(settings.spike_sigma * noise, least)
    # At its ends the median of a motion that does not rest is a step behind.
    for end, beside in ((0, slice(1, NEIGHBOURS)), (-1, slice(-NEIGHBOURS, -1))):
        spikes[end] &= abs(off[end]) > STEPS * np.abs(np.diff(displacement_mm[beside])).max()
    spikes = np.flatnonzero(spikes)
    if len(spikes) > settings.max_bad_rows * len(off):
        return keep, []
    keep[spikes] = False
    return keep, [_spike(file, None, "displacement_mm", displacement_mm[i], off[i], line[i]) for i in spikes]


def force_spikes(
    file: str, force_N: np.ndarray, strokes: Sequence[Stroke], line: np.ndarray, settings: Quality
) -> tuple[np.ndarray, list[Fault]]:
    """Return which rows to keep, shape (n,): no single force far off its neighbours; a finding for each.

    "Far" is `spike_sigma` robust standard deviations of what the samples of the steady windows are off the
    median of their neighbours, and apart from the bulk of these. Outside the windows, where a break-away peak
    may be as sharp, a spike must also reach beyond the rest of the trace by half of its range. More than
    `max_bad_rows` spikes are the nature of the signal: said, and kept.
    """
    keep = np.ones(len(force_N), bool)
    if len(force_N) < 4 * NEIGHBOURS:
        return keep, []
    steady = np.zeros(len(force_N), bool)
    off = force_N - median_filter(force_N, NEIGHBOURS, mode="mirror")
    for stroke in strokes:
        steady[stroke.rows] = True
    usual = off[steady] if steady.any() else off
    least = max(0.5 * resolution(force_N), 1e-9 * np.median(np.abs(force_N)), 1e-300)
    noise = max(1.4826 * np.median(np.abs(usual)), least)
    apart = APART * np.quantile(np.abs(usual), USUAL)
    suspects = np.abs(off) > max(settings.spike_sigma * noise, apart)
    if not suspects.any():
        return keep, []
    spikes = np.flatnonzero(suspects & (steady | _beyond(force_N, suspects)))
    count = len(spikes)
    if count > settings.max_bad_rows * len(force_N):
        reason = f"{count} samples jump away from their neighbours: too many to be single wrong samples."
        fix = "Look for stick-slip or electrical noise; filter the signal if it is the latter."
        place = {"file": file, "column": "force_N", "value": float(count)}
        return keep, [Fault("spikes", reason, fix=fix, **place, **KEPT)]
    keep[spikes] = False
    starts = np.array([stroke.start for stroke in strokes])
    several = len(strokes) > 1
    found = []
    for i in spikes:
        number = int(np.searchsorted(starts, i, side="right")) if several else None
        found.append(_spike(file, number, "force_N", force_N[i], off[i], line[i]))
    return keep, found


def resolution(values: np.ndarray) -> float:
    """Return the smallest step between different values: the sensor's resolution if coarse, else near 0."""
    different = np.unique(values)
    return float(np.diff(different).min()) if len(different) > 1 else 0.0


def _spike(file: str, stroke: int | None, column: str, value: float, off: float, line: int) -> Fault:
    reason = f"a single sample, {abs(off):.4g} off its neighbours."
    place = {"file": file, "stroke": stroke, "line": int(line), "column": column, "value": float(value)}
    return Fault("spike", reason, severity="warning", action="row left out", fix=FIX, **place)


# ---------------------------------------------------------------- speed check

# Pieces that one or two strokes are cut into: long enough to average noise out, short beside a stroke.
BLOCKS = 100
# Pieces that a noisy trace is cut into at least: a rest at either end, and sliding between.
FEWEST = 6
# Noise of a step between the means of two pieces, as a share of the step.
NOISE_OF_PATH = 0.1
# Factor beyond which the file contradicts itself and is left out. Below it the commanded speed may be
# nominal.
GROSS = 1.5


def measured_speed(time_s: np.ndarray, displacement_mm: np.ndarray) -> tuple[float, float]:
    """Return the mean speed of a trace, rests included, and its plateau speed; magnitudes, nan for none.

    Rising time and displacement, shape (n,), are in any unit; the speeds are in their quotient.

    Notes
    -----
    A trace is cut into 100 pieces, or 50 per stroke. The mean is that of all pieces; the plateau is the
    median of those faster than half their 90th percentile, so rests, turns and ramps do not count. In
    stick-slip the speed that was set is the mean, in a stroke with rests it is the plateau; elsewhere the two
    agree.

    Examples
    --------
    >>> t = np.linspace(0.0, 10.0, 201)
    >>> mean, plateau = measured_speed(t, np.where(t < 5, 3 * t, 15.0))  # slides at 3 mm/s, then rests
    >>> round(mean, 6), round(plateau, 6)
    (1.5, 3.0)
    """
    cuts = min(len(time_s), BLOCKS * max(1, _strokes(displacement_mm) // 2) + 1)
    at = np.linspace(0, len(time_s) - 1, cuts).astype(np.int64)
    return _of_cuts(time_s[at], displacement_mm[at])


def _of_cuts(time_s: np.ndarray, displacement_mm: np.ndarray) -> tuple[float, float]:
    """Return mean and plateau of a trace of which these rows are given."""
    with np.errstate(all="ignore"):  # beyond 1e308 there is no speed: nan or inf, and no check
        path, time = np.abs(np.diff(displacement_mm)), np.diff(time_s)
        speeds = path / time
        fast = speeds[speeds > 0.5 * np.quantile(speeds, 0.9)]
        return float(path.sum() / time.sum()), float(np.median(fast)) if len(fast) else math.nan


def _strokes(displacement_mm: np.ndarray) -> int:
    """Return how often a trace goes from its lowest quarter to its highest or back: roughly, its strokes."""
    low, high = np.quantile(displacement_mm, 0.01), np.quantile(displacement_mm, 0.99)
    quarter = 0.25 * (high - low)
    ends = displacement_mm[(displacement_mm < low + quarter) | (displacement_mm > high - quarter)]
    return int(np.count_nonzero(np.diff(ends > 0.5 * (low + high))))


def speed_fault(
    ref: TraceRef, time_s: np.ndarray, displacement_mm: np.ndarray, config: Config
) -> Fault | None:
    """Return a fault if time and displacement of a trace disagree with the commanded speed.

    None if they agree or no speed is commanded. They agree if the commanded speed lies between the measured
    mean and the plateau, or misses them by no more than `quality.speed_disagreement`. Up to a factor of 1.5
    the file is kept with a warning: every table holds the measured speed. Beyond, the file is left out, and
    the fix names the mix-up that fits the factor. Arguments as in `measured_speed`.
    """
    commanded = ref.channels.get("speed_set_mm_s")
    if not isinstance(commanded, int | float) or not commanded > 0:
        return None
    factor, tolerance = config.units.speed_factor, config.quality.speed_disagreement
    mean, plateau = (factor * speed for speed in measured_speed(time_s, displacement_mm))
    if not (0 < plateau < math.inf and mean < math.inf):  # nothing moves: said where strokes are sought
        return None
    measured = sorted((commanded, mean, plateau))[1]  # between the two, nearest to the commanded one
    if abs(measured / commanded - 1) <= tolerance:
        return None
    of_means = [factor * speed for speed in _speeds_of_means(time_s, displacement_mm)]
    if np.isfinite(of_means).all():
        measured = sorted((commanded, *of_means))[1]
    ratio = measured / commanded
    if abs(ratio - 1) <= tolerance:
        return None
    unit = config.units.unit("speed")
    reason = f"displacement over time gives {measured:.4g} {unit}, commanded are {commanded:.4g} {unit}."
    place = {"file": ref.file, "column": "displacement_mm", "value": measured}
    if 1 / GROSS <= ratio <= GROSS:
        fix = "Check the commanded speed, or slip in the drive."
        return Fault("speed_disagreement", reason, fix=fix, **place, **KEPT)
    declared = [
        f"{name} in {config.trace.columns[name].unit}"
        for name in ("time_s", "displacement_mm")
        if name in config.trace.columns and config.trace.columns[name].unit
    ]
    first = f"Is the unit in the rig config right ({', '.join(declared)})? " if declared else ""
    fix = first + _mix_up(ratio, time_s, displacement_mm, config)
    return Fault("speed_disagreement", reason, action="file left out", fix=fix, **place)


def _speeds_of_means(time_s: np.ndarray, displacement_mm: np.ndarray) -> tuple[float, float]:
    """Return mean and plateau speed of a trace from means of pieces, as few as its noise asks for; else nan.

    The mean of a piece of m samples has a noise of sd / sqrt(m), and two make a step; the path of `count`
    steps is longer by noise that must stay small beside the travel.
    """
    n, travel = len(time_s), float(np.ptp(displacement_mm))
    noise = displacement_noise_mm(displacement_mm)
    if noise <= 0.0 or n < 2 * FEWEST:
        return math.nan, math.nan
    count = int((NOISE_OF_PATH * travel / noise * math.sqrt(n / 2.0)) ** (2.0 / 3.0))
    if not FEWEST <= count < BLOCKS:
        return math.nan, math.nan
    cut = np.linspace(0, n, count + 1).astype(np.int64)
    means = [np.add.reduceat(values, cut[:-1]) / np.diff(cut) for values in (time_s, displacement_mm)]
    return _of_cuts(*means)


def with_unit(column: str, unit: str, config: Config) -> str:
    """Return the fix for a column of traces, ours by name, whose numbers are in another unit."""
    if column in config.trace.compute:
        return f"Correct compute.{column} in the rig config."
    theirs = config.trace.their_columns.get(column, column)
    name = "" if theirs == column else f"name = {theirs!r}, "
    return f'Set {column} = {{{name}unit = "{unit}"}} under [trace.columns] in the rig config.'


def _mix_up(ratio: float, time_s: np.ndarray, displacement: np.ndarray, config: Config) -> str:
    """Return the likely fix for a measured speed that is `ratio` times the commanded one."""
    step, travel = float(np.median(np.diff(time_s))), float(np.ptp(displacement))
    time_in_ms = f"Is the time in ms? {with_unit('time_s', 'ms', config)}"
    metres = f"Is the displacement in m? {with_unit('displacement_mm', 'm', config)}"
    known = (
        # Both are a factor of 1000: rigs sample faster than once a second and travel farther than 1 mm.
        (1e-3, time_in_ms if step >= 0.5 or travel >= 1.0 else metres),
        (1e3, "Is the displacement in µm, or the commanded speed in m/s?"),
        (1e-6, "Is the time in µs, or in ms with the displacement in m?"),
        (0.1, "Is the displacement in cm?"),
        (10.0, "Is the commanded speed in cm/s?"),
        (1 / 25.4, "Is the displacement in inches?"),
        (60.0, "Is the time in minutes?"),
        (1 / 60.0, "Is the commanded speed per minute, not per second?"),
        (3600.0, "Is the time in hours?"),
        (1000.0 / 60.0, "Is the commanded speed in m/min?"),
    )
    factor, fix = min(known, key=lambda row: abs(math.log(ratio / row[0])))
    if abs(math.log(ratio / factor)) <= math.log1p(config.quality.speed_disagreement):
        return fix
    return "Check the commanded speed, the decimal mark, and the units of time and displacement."
