"""Strokes of a trace, and in each the window in which it slides steadily: found from the data.

A stroke runs from one turning point of the smoothed displacement to the next. Its steady window begins when
the speed has reached its plateau and the force has ended its pre-sliding rise, and ends before the platform
slows down; rests in between are left out with what follows them until sliding is steady again. Nothing that
changes slowly (warming, drift, a ripple, a Stribeck curve) is taken for a rise: only a force below everything
it later shows counts as one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from sealfit.config import Strokes
from sealfit.ingest.segments import median, quantile, smoothed
from sealfit.ingest.window import slope, speed_along, steady_window


@dataclass(frozen=True, slots=True, eq=False)
class Stroke:
    """One stroke: rows `start` to `stop` (exclusive) of its trace.

    `origin` is the row where it begins to move, from which its distance counts (and, in a file of several
    strokes, its time): the first row, unless rows of rest come before the file's first stroke. `speed_mm_s`
    is in displacement units per time unit, signed. Arrays are of shape (stop - start,): `steady` marks the
    rows of the window, `sliding` those in which it moves; `presliding_N` is what is left of the pre-sliding
    rise in the window, with the sign of the force, 0 elsewhere; `speed_along_mm_s` is the speed at every row,
    where it is seen to differ from the stroke's. `short` says why the window is too short to be used; None if
    it is long enough.
    """

    number: int
    start: int
    stop: int
    origin: int
    direction: int
    speed_mm_s: float
    steady: np.ndarray
    sliding: np.ndarray
    presliding_N: np.ndarray
    speed_along_mm_s: np.ndarray
    short: str | None = None

    @property
    def rows(self) -> np.ndarray:
        """Rows of the steady window in the trace, shape (n,)."""
        return self.start + np.flatnonzero(self.steady)


class _Motion(NamedTuple):
    """A trace as strokes are found in it: arrays of shape (n,), and the noise of a displacement sample."""

    time_s: np.ndarray
    displacement_mm: np.ndarray
    force_N: np.ndarray
    noise_mm: float


def find_strokes(
    time_s: np.ndarray, displacement_mm: np.ndarray, force_N: np.ndarray, settings: Strokes
) -> list[Stroke]:
    """Return the strokes of one trace in order; none where nothing moves.

    Parameters
    ----------
    time_s, displacement_mm, force_N : ndarray, shape (n,)
        A trace in the rig's own units, finite, time rising (steps may differ, and hide gaps); displacement
        without spikes.
    settings : Strokes
        The config's `strokes`.

    Returns
    -------
    list of Stroke
        Strokes shorter than `min_travel_mm` are part of their neighbours' ends.
    """
    if len(time_s) < 3 or not np.ptp(displacement_mm) > 0.0:
        return []
    if settings.whole_file:
        return [_whole_file(time_s, displacement_mm, settings)]
    noise, smooth = displacement_noise_mm(displacement_mm), smoothed(displacement_mm, settings.smooth_samples)
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
    motion = _Motion(time_s, displacement_mm, median_filter(force_N, 3, mode="nearest"), noise)
    found = []
    for number, (start, stop) in enumerate(pairwise(bounds), start=1):
        way = 1 if smooth[turns[number]] > smooth[turns[number - 1]] else -1
        first = origin if number == 1 else start
        found.append(_stroke(motion, settings, number, slice(start, stop), first, way))
    return found


def _stroke(motion: _Motion, settings: Strokes, number: int, rows: slice, origin: int, way: int) -> Stroke:
    """Return the stroke that takes these rows of a trace."""
    time_s, displacement_mm, force_N = (values[rows] for values in motion[:3])
    along, noise = way * displacement_mm, motion.noise_mm
    window = steady_window(time_s, along, way * force_N, origin - rows.start, noise, settings.speed_tolerance)
    speed = slope(time_s, displacement_mm, window.steady)
    return Stroke(
        number,
        rows.start,
        rows.stop,
        origin,
        way,
        speed,
        window.steady,
        window.sliding,
        way * window.left_N,
        speed_along(time_s, displacement_mm, window, speed, noise),
        _too_short(along, window.steady, settings),
    )


def _whole_file(time_s: np.ndarray, displacement_mm: np.ndarray, settings: Strokes) -> Stroke:
    """Return a trace as one stroke, steady throughout."""
    n, every = len(time_s), np.ones(len(time_s), bool)
    way = 1 if displacement_mm[-1] >= displacement_mm[0] else -1
    speed, least = slope(time_s, displacement_mm, every), settings.min_samples
    short = None if n >= least else f"only {n} samples; at least {least} are needed"
    return Stroke(1, 0, n, 0, way, speed, every, every, np.zeros(n), np.full(n, speed), short)


def displacement_noise_mm(displacement_mm: np.ndarray, order: int = 2) -> float:
    """Return the standard deviation of one displacement sample of a trace, noise and resolution together.

    Second differences of a steady motion hold noise only: their variance is six times that of a sample.
    Fourth differences are free of the acceleration along ramps, too, with 70 times the variance. The 90th
    percentile is blind to gaps, stops and spikes. Where most of the way is covered by single steps between
    rows that hardly differ, these are the resolution, whose rounding error is uniform: step / sqrt(12). A
    rest before or after the motion is no such step, be its rows equal or not. 0 of no more than `order`
    samples.
    """
    if len(displacement_mm) <= order:
        return 0.0
    bends, times = np.diff(displacement_mm, order), math.comb(2 * order, order)
    noise = quantile(np.abs(bends), 0.9) / (1.645 * np.sqrt(times))
    steps = np.abs(np.diff(displacement_mm))
    beside = np.zeros(len(steps))
    beside[1:] += steps[:-1]
    beside[:-1] += steps[1:]
    single = steps > 2.0 * beside
    if steps[single].sum() > 0.5 * steps.sum():
        noise = max(noise, median(steps[single]) / np.sqrt(12.0))
    return float(noise)


def turning_rows(smooth_mm: np.ndarray, travel_mm: float) -> list[int]:
    """Return the rows where the motion begins, turns and ends: extremes more than `travel_mm` apart.

    A turn counts once the displacement has come back by `travel_mm`, so neither noise nor a small backlash is
    one. Fewer than two rows where nothing moves that far.
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
    starts = [_last_at_rest(smooth_mm, here, after, near_mm, samples) for here, after in pairwise(turns)]
    origin = 0 if starts[0] < samples else starts[0]  # noise at the first rows is not a rest
    return [0, *starts[1:], len(smooth_mm)], origin


def _last_at_rest(smooth_mm: np.ndarray, turn: int, after: int, near_mm: float, samples: int) -> int:
    far = np.abs(smooth_mm[turn : after + 1] - smooth_mm[turn]) > near_mm
    rest = max(int(far.argmax()) - 1, 0)
    per_row = float(abs(smooth_mm[after] - smooth_mm[turn])) / (after - turn)
    # That many rows are as near as that to any turn without a rest.
    return turn + rest if rest > 3.0 * near_mm / per_row + samples else turn


def _too_short(along_mm: np.ndarray, steady: np.ndarray, settings: Strokes) -> str | None:
    """Return why a steady window is too short to be used."""
    samples = int(np.count_nonzero(steady))
    if samples < settings.min_samples:
        return f"the steady window has {samples} samples; at least {settings.min_samples} are needed"
    covered = np.abs(np.diff(along_mm))[steady[1:] & steady[:-1]].sum()
    share = covered / max(float(np.ptp(along_mm)), 1e-300)
    if share < settings.min_steady_share:
        return (
            f"the steady window is {share:.0%} of the stroke; "
            f"at least {settings.min_steady_share:.0%} is needed"
        )
    return None
