"""Strokes of a trace, and in each the window in which it slides steadily: found from the data.

A stroke runs from one turning point of the smoothed displacement to the next. Each steady speed of a motion
with several, and each turn of a rotation, is a stroke of its own. Its steady window begins when the speed has
reached its plateau and the pre-sliding rise of the force is over, and ends before the platform slows down;
rests are left out with what follows them until sliding is steady again.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d

from sealfit.config import Strokes
from sealfit.ingest.presliding import has_transient
from sealfit.ingest.window import (
    LEAST_ROWS,
    SAME_SPEED,
    SPEED_NOISE,
    STANDSTILL,
    speed_along,
    steady_window,
    stretches,
)

# Share of the travel of a motion that a steady speed covers at least. It is ten times what counts as a rest
# (`_bounds`), so that no creep is one; 1, 3, 10 and 30 mm/s for equal times cover 2 % and more.
LEAST_TRAVEL = 0.01
# Share of the rows within twice the tolerance of a steady speed that may be slower by more than half of the
# tolerance, and share that may be faster; the same where smoothed ends are a large part of a short stretch.
# Of those of a ramp 38 % are slower and 38 % faster, of those at the top of a sine wave 33 and 24 %.
OFF_SPEED, MOST_OFF_SPEED = 0.2, 0.3
# Samples of a steady speed among several, at least. With 6, some are found on ramps of 50 samples.
FEWEST_SAMPLES = 10
# Lengths of the rise from rest over which friction follows a step from another speed: of a change of 50 %
# then 0.05 % are left. At least a half of the steady window is kept, and all of a window that is shorter than
# so many lengths.
AFTER_STEP, KEPT, LEAST_LENGTHS = 7.0, 0.5, 5.0
# Share of a turn below which what comes before the first or after the last whole turn is no turn of its own.
PART_OF_TURN = 0.05
# Ratio of measured speeds from which they are two settings. Without speed control they vary nearly as much.
SPEEDS_APART = 1.25


@dataclass(frozen=True, slots=True, eq=False)
class Stroke:
    """One stroke: rows `start` to `stop` (exclusive) of its trace.

    `origin` is the row where its motion begins, from which its distance counts (and, in a file of several
    strokes, its time); a steady speed or a turn has that of the first of its motion. `speed_mm_s` is in
    displacement units per time unit, signed. Arrays are of shape (stop - start,): `steady` marks the rows of
    the window, `sliding` those in which it moves; `presliding_N` is what is left of the pre-sliding rise in
    the window, with the sign of the force, 0 elsewhere; `speed_along_mm_s` is the speed at every row.
    `rise_mm` is the length of that rise, 0 without one. `short` says why the window is too short to be used.
    `settles` is false where the speed has no plateau; `several_speeds` is true for a steady speed of a motion
    with several.
    """

    start: int
    stop: int
    origin: int
    direction: int
    speed_mm_s: float
    steady: np.ndarray
    sliding: np.ndarray
    presliding_N: np.ndarray
    speed_along_mm_s: np.ndarray
    rise_mm: float = 0.0
    short: str | None = None
    settles: bool = True
    several_speeds: bool = False

    @property
    def rows(self) -> np.ndarray:
        """Rows of the steady window in the trace, shape (n,)."""
        return self.start + np.flatnonzero(self.steady)


OF_ROWS = ("steady", "sliding", "presliding_N", "speed_along_mm_s")  # arrays of a stroke


class _TraceMotion(NamedTuple):
    """A trace as strokes are found in it: arrays of shape (n,), noise of a displacement sample, settings."""

    time_s: np.ndarray
    displacement_mm: np.ndarray
    force_N: np.ndarray
    noise_mm: float
    settings: Strokes


def find_strokes(
    time_s: np.ndarray, displacement_mm: np.ndarray, force_N: np.ndarray, settings: Strokes
) -> list[Stroke]:
    """Return the strokes of one trace in order; none where nothing moves.

    The arrays, shape (n,), are in the rig's own units, finite, time rising, displacement without spikes.
    Strokes shorter than `min_travel_mm` are part of their neighbours' ends.
    """
    if len(time_s) < 3 or not np.ptp(displacement_mm) > 0.0:
        return []
    smooth = smoothed(displacement_mm, settings.smooth_samples)
    if settings.whole_file:
        whole = _whole_file(time_s, displacement_mm, settings)
        return _turns(time_s, displacement_mm, smooth, whole, settings)
    noise = displacement_noise_mm(displacement_mm)
    span = float(np.ptp(smooth))
    if span <= 8.0 * noise:  # the range of some hundred samples of noise alone is about six SDs
        return []
    # The smoothed noise of a thousand samples comes back by three SDs of one sample: no turn.
    travel = max(0.05 * span, 4.0 * noise) if settings.min_travel_mm is None else settings.min_travel_mm
    turns = turning_rows(smooth, travel)
    if len(turns) < 2:
        return []
    bounds, origin = _bounds(smooth, turns, max(3.0 * noise, 1e-3 * span), settings.smooth_samples)
    # Single spikes must not decide where a rise ends.
    motion = _TraceMotion(time_s, displacement_mm, median_filter(force_N, 3, mode="nearest"), noise, settings)
    found = []
    for number, (start, stop) in enumerate(pairwise(bounds), start=1):
        way = 1 if smooth[turns[number]] > smooth[turns[number - 1]] else -1
        first = origin if number == 1 else start
        rows = slice(start, stop)
        parts = steady_speeds(time_s[rows], way * displacement_mm[rows], noise, settings)
        rise_mm = 0.0  # that of the last start from rest
        for part, begin in parts:
            own = slice(start + part.start, start + part.stop)
            stroke = _stroke(motion, own, start + begin, first, way, rise_mm)
            rise_mm = stroke.rise_mm or rise_mm
            stroke = replace(stroke, several_speeds=len(parts) > 1)
            found += _turns(time_s, displacement_mm, smooth, stroke, settings)
    return found


def _stroke(motion: _TraceMotion, rows: slice, begin: int, origin: int, way: int, rise_mm: float) -> Stroke:
    """Return the stroke that takes these rows of a trace; before `begin` it slides at another speed.

    Without a pre-sliding rise of its own, friction may still follow the step between the speeds: `rise_mm` is
    the length of the rise from rest.
    """
    settings = motion.settings
    time_s, displacement_mm, force_N = (values[begin : rows.stop] for values in motion[:3])
    along, noise, tolerance = way * displacement_mm, motion.noise_mm, settings.speed_tolerance
    window = steady_window(time_s, along, way * force_N, max(origin - begin, 0), noise, tolerance)
    if rise_mm and not window.rise_mm:
        window.steady[_following_step(along, way * force_N, window.steady, rise_mm)] = False
    before = np.zeros(begin - rows.start)  # it slides there, at another speed
    steady, sliding = np.r_[before > 0.0, window.steady], np.r_[before == 0.0, window.sliding]
    left_N = way * np.r_[before, window.left_N]
    time_s, displacement_mm = (values[rows] for values in motion[:2])
    speed = slope(time_s, displacement_mm, steady)
    along = speed_along(time_s, displacement_mm, steady, window.rise_mm, speed, noise)
    short = _too_short(way * displacement_mm, steady, settings, settles=window.settles)
    ends = (rows.start, rows.stop)
    of_rows = (steady, sliding, left_N, along)
    return Stroke(*ends, origin, way, speed, *of_rows, window.rise_mm, short, window.settles)


def _following_step(
    along_mm: np.ndarray, force_N: np.ndarray, steady: np.ndarray, rise_mm: float
) -> np.ndarray:
    """Return which rows of a steady window follow a step between two speeds, as a mask of shape (n,)."""
    x = along_mm - along_mm[0]
    own = x[steady]
    long = own.size >= LEAST_ROWS and np.ptp(own) >= LEAST_LENGTHS * rise_mm
    if not (long and has_transient(own, force_N[steady], rise_mm)):
        return np.zeros(len(x), dtype=bool)
    end = min(AFTER_STEP * rise_mm, own[-1] - KEPT * np.ptp(own))
    return steady & (x < end)


def _turns(
    time_s: np.ndarray, displacement_mm: np.ndarray, smooth_mm: np.ndarray, whole: Stroke, settings: Strokes
) -> list[Stroke]:
    """Return a stroke of a trace cut where it passes a multiple of `turn`: a stroke for each turn."""
    if settings.turn is None:
        return [whole]
    number = whole.direction * smooth_mm[whole.start : whole.stop] / settings.turn
    # Noise at a multiple is not a turn back.
    cuts = np.flatnonzero(np.diff(np.floor(np.maximum.accumulate(number)))) + 1
    long = (number[cuts] - number[0] > PART_OF_TURN) & (number[-1] - number[cuts] > PART_OF_TURN)
    made = []
    for part in pairwise([0, *cuts[long].tolist(), whole.stop - whole.start]):
        own, rows = slice(*part), slice(whole.start + part[0], whole.start + part[1])
        cut = {name: getattr(whole, name)[own] for name in OF_ROWS}
        speed = slope(time_s[rows], displacement_mm[rows], cut["steady"])
        along = whole.direction * displacement_mm[rows]
        short = _too_short(along, cut["steady"], settings, settles=whole.settles)
        turn = {"start": rows.start, "stop": rows.stop, "speed_mm_s": speed, "short": short}
        made.append(replace(whole, **turn, **cut))
    return made


def steady_speeds(
    time_s: np.ndarray, along_mm: np.ndarray, noise_mm: float, settings: Strokes
) -> list[tuple[slice, int]]:
    """Return one motion cut into its steady speeds: the rows of each, and the row where it begins.

    A steady speed is the longest stretch within twice the tolerance of the speed at which most of the way is
    slid, if most of it is within half of the tolerance; then the same of what is left before and after it. A
    cut lies at the slowest row in between. A steady speed begins after the ramp to it, but after a standstill
    with the ramp. A motion with one steady speed, or none, is not cut.

    The arrays, shape (n,), are one motion in one direction, displacement rising with it; `noise_mm` is the
    standard deviation of a displacement sample.
    """
    n, tolerance = len(time_s), settings.speed_tolerance
    x = np.maximum.accumulate(smoothed(along_mm, settings.smooth_samples))
    # The SD of the difference of two samples is SPEED_NOISE * tolerance of the distance.
    half = np.sqrt(0.5) * noise_mm / (SPEED_NOISE * tolerance)
    least = LEAST_TRAVEL * (x[-1] - x[0]) if settings.min_travel_mm is None else settings.min_travel_mm
    least = max(least, 4.0 * half)  # over half of that the speed is taken, of a rest, too
    if n < 2 * settings.min_samples or x[-1] - x[0] < 2.0 * least:
        return [(slice(0, n), 0)]
    row = np.arange(n)
    low = np.clip(x.searchsorted(x - half, "right") - 1, 0, np.maximum(row - 1, 0))
    high = np.clip(x.searchsorted(x + half), np.minimum(row + 1, n - 1), n - 1)
    speed = (x[high] - x[low]) / (time_s[high] - time_s[low])
    found: list[slice] = []
    for rows in _flat_parts(speed, np.diff(x, prepend=x[0]), slice(0, n), least, settings):
        ratio = np.median(speed[rows]) / np.median(speed[found[-1]]) if found else np.inf
        if abs(np.log(ratio)) < np.log1p(2.0 * tolerance):  # the same speed after a rest
            found[-1] = slice(found[-1].start, rows.stop)
        else:
            found.append(rows)
    cuts, begins = [0], [0]
    for before, rows in pairwise(found):
        cut = before.stop - 1 + int(speed[before.stop - 1 : rows.start + 1].argmin())
        rested = speed[cut] < STANDSTILL * np.median(speed[rows])
        cuts.append(cut)
        begins.append(cut if rested else rows.start)
    return list(zip(map(slice, cuts, [*cuts[1:], n]), begins, strict=True))


def slope(time_s: np.ndarray, displacement_mm: np.ndarray, steady: np.ndarray) -> float:
    """Return the slope of displacement over time by least squares, one for all pieces of a steady window.

    Each piece (between rests) has an intercept, so a rest is no slow sliding. NaN without samples.
    """
    product = square = 0.0
    for first, stop in stretches(steady):
        t, d = time_s[first:stop], displacement_mm[first:stop]
        t = t - t.mean()
        product += float(t @ (d - d.mean()))
        square += float(t @ t)
    return product / square if square > 0.0 else np.nan


def several_speeds(speeds: Sequence[float]) -> list[float]:
    """Return the speeds of one direction in a file that holds several, none otherwise.

    One stroke that is off is no speed of its own; each direction may have its speed.

    Examples
    --------
    >>> several_speeds([5.0, 5.0, 1.0, 1.0]), several_speeds([5.0, 5.0, 5.0, 1.0])
    ([1.0, 5.0], [])
    >>> several_speeds([1.0, 2.0, 4.0]), several_speeds([5.0, -8.0, 5.0, -8.0])
    ([1.0, 2.0, 4.0], [])
    """
    forward = _several([speed for speed in speeds if speed > 0])
    return forward or _several([-speed for speed in speeds if speed < 0])


def _several(speeds: list[float]) -> list[float]:
    groups = speed_clusters(np.sort(speeds))
    own = all(len(group) == 1 for group in groups)
    kept = groups if own else [group for group in groups if len(group) > 1]
    apart = all(a[-1] * SPEEDS_APART < b[0] for a, b in pairwise(kept))
    return [float(group[0]) for group in kept] if len(kept) > 1 and apart else []


def speed_clusters(speeds: np.ndarray) -> list[np.ndarray]:
    """Return clusters of sorted positive speeds, each within `SPEEDS_APART` of its slowest."""
    cuts, base = [], 0.0
    for place, speed in enumerate(speeds):
        if speed > SPEEDS_APART * base:
            base = speed
            cuts.append(place)
    return np.split(speeds, cuts[1:]) if len(speeds) else []


def _whole_file(time_s: np.ndarray, displacement_mm: np.ndarray, settings: Strokes) -> Stroke:
    """Return a trace as one stroke, steady throughout."""
    n, every = len(time_s), np.ones(len(time_s), bool)
    way = 1 if displacement_mm[-1] >= displacement_mm[0] else -1
    speed, least = slope(time_s, displacement_mm, every), settings.min_samples
    short = None if n >= least else f"only {n} samples; at least {least} are needed"
    return Stroke(0, n, 0, way, speed, every, every, np.zeros(n), np.full(n, speed), short)


def _flat_parts(
    speed: np.ndarray, step_mm: np.ndarray, within: slice, least_mm: float, settings: Strokes
) -> list[slice]:
    """Return the rows of each steady speed found in a part of a motion, in order, without ramps."""
    own, step, tolerance = speed[within], step_mm[within], settings.speed_tolerance
    if len(own) < FEWEST_SAMPLES or step.sum() < least_mm:
        return []
    order = np.argsort(own)
    lowest, covered = own[order], np.cumsum(step[order])
    last = lowest.searchsorted(lowest * (1.0 + tolerance) ** 2, "right") - 1
    most = int((covered[last] - covered + step[order]).argmax())
    level = np.median(lowest[most : last[most] + 1])
    # Beyond the part, too: a piece of a ramp is as flat as it is short.
    near = [slice(*ends) for ends in stretches(np.abs(speed - level) < 2.0 * tolerance * level)]
    here = [slice(max(rows.start, within.start), min(rows.stop, within.stop)) for rows in near]
    way = [float(step_mm[rows].sum()) if rows.start < rows.stop else 0.0 for rows in here]
    longest = int(np.argmax(way))
    if way[longest] < least_mm:
        return []
    rows, here = near[longest], here[longest]
    off = speed[rows] / np.median(speed[rows]) - 1.0
    share = min(OFF_SPEED + 0.5 * settings.smooth_samples / len(off), MOST_OFF_SPEED)
    ends = np.quantile(off, share), np.quantile(off, 1.0 - share)
    found = []
    if len(off) >= FEWEST_SAMPLES and max(map(abs, ends)) <= 0.5 * tolerance:
        first, after = (int(np.argmax(np.sign(end[0]) * end <= SAME_SPEED)) for end in (off, off[::-1]))
        found = [slice(rows.start + first, rows.stop - after)] if first + after < len(off) else []
    before, behind = slice(within.start, here.start), slice(here.stop, within.stop)
    found = _flat_parts(speed, step_mm, before, least_mm, settings) + found
    return found + _flat_parts(speed, step_mm, behind, least_mm, settings)


WHOLE = 0.01  # largest distance of a whole number of steps from one, of numbers written with few digits


def displacement_noise_mm(displacement_mm: np.ndarray, order: int = 2) -> float:
    """Return the standard deviation of one displacement sample of a trace, noise and resolution together.

    Second differences of a steady motion hold noise only: their variance is six times that of a sample.
    Fourth differences are free of the acceleration along ramps, too, with 70 times the variance. The 90th
    percentile is blind to gaps, stops and spikes. Where most of the way is covered by single steps between
    rows that hardly differ, these are the resolution, whose rounding error is uniform: step / sqrt(12).
    0 of no more than `order` samples.
    """
    if len(displacement_mm) <= order:
        return 0.0
    bends, times = np.diff(displacement_mm, order), math.comb(2 * order, order)
    noise = np.quantile(np.abs(bends), 0.9) / (1.645 * np.sqrt(times))
    steps = np.abs(np.diff(displacement_mm))
    beside = np.zeros(len(steps))
    beside[1:] += steps[:-1]
    beside[:-1] += steps[1:]
    single = steps > 2.0 * beside
    if steps[single].sum() > 0.5 * steps.sum():
        noise = max(noise, np.median(steps[single]) / np.sqrt(12.0))
    return float(noise)


def resolution_mm(displacement_mm: np.ndarray) -> float:
    """Return the step of a displacement that moves by whole numbers of one step; 0 if it does not.

    Examples
    --------
    >>> resolution_mm(np.round(np.arange(50) * 0.197, 1))
    0.1
    """
    steps = np.abs(np.diff(displacement_mm))
    bends = np.abs(np.diff(displacement_mm, 2))
    bends = bends[bends > 1e-6 * steps.max(initial=0.0)]
    if not bends.size:
        return 0.0
    step = float(bends.min())
    whole = np.abs(steps / step - np.round(steps / step)).max() < WHOLE
    return round(step, 12) if whole else 0.0


def turning_rows(smooth_mm: np.ndarray, travel_mm: float) -> list[int]:
    """Return the rows where the motion begins, turns and ends: extremes more than `travel_mm` apart.

    Noise and a small backlash are no turns. Fewer than two rows where nothing moves that far.
    """
    step = np.sign(np.diff(smooth_mm))
    moving = np.flatnonzero(step)
    change = moving[1:][step[moving[1:]] != step[moving[:-1]]]
    # Only local extremes can be turning points; the ends belong to them.
    candidates = [0, *change.tolist(), len(smooth_mm) - 1]
    values = smooth_mm[candidates].tolist()
    turns: list[int] = []
    heading = high = low = 0  # `high` and `low` are places in `candidates`
    for i, value in enumerate(values):
        if heading >= 0 and value > values[high]:
            high = i
        if heading <= 0 and value < values[low]:
            low = i
        if heading >= 0 and values[high] - value >= travel_mm:
            turns.append(candidates[high])
            heading, low = -1, i
        elif heading <= 0 and value - values[low] >= travel_mm:
            turns.append(candidates[low])
            heading, high = 1, i
    if heading:
        turns.append(candidates[high if heading > 0 else low])
    return turns


def _bounds(smooth_mm: np.ndarray, turns: list[int], near_mm: float, samples: int) -> tuple[list[int], int]:
    """Return every stroke's first row, with the number of rows at the end, and the row where the first moves.

    A rest at a turn belongs to the stroke before it: a stroke begins with the last row of rest.
    """
    starts = []
    for turn, after in pairwise(turns):
        away = np.abs(smooth_mm[turn : after + 1] - smooth_mm[turn])
        rest = max(int((away > near_mm).argmax()) - 1, 0)
        per_row = float(away[-1]) / (after - turn)
        # That many rows are as near as that to any turn without a rest.
        starts.append(turn + rest if rest > 3.0 * near_mm / per_row + samples else turn)
    origin = 0 if starts[0] < samples else starts[0]  # noise at the first rows is not a rest
    return [0, *starts[1:], len(smooth_mm)], origin


def _too_short(along_mm: np.ndarray, steady: np.ndarray, settings: Strokes, *, settles: bool) -> str | None:
    """Return why a steady window is too short to be used; by its samples alone where no speed settles."""
    samples = int(np.count_nonzero(steady))
    if samples < settings.min_samples:
        return f"the steady window has {samples} samples; at least {settings.min_samples} are needed"
    covered = np.abs(np.diff(along_mm))[steady[1:] & steady[:-1]].sum()
    share = covered / max(float(np.ptp(along_mm)), 1e-300)
    if settles and share < settings.min_steady_share:
        needed = f"at least {settings.min_steady_share:.0%} is needed"
        return f"the steady window is {share:.1%} of the stroke; {needed}"
    return None


def smoothed(values: np.ndarray, samples: int) -> np.ndarray:
    """Return `values` as a running mean of running medians over `samples` samples, shape (n,)."""
    middle = median_filter(np.asarray(values, float), samples, mode="nearest")
    return uniform_filter1d(middle, samples, mode="nearest")
