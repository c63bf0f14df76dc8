"""Strokes of a trace, and in each the window in which it slides steadily: found from the data.

A stroke runs from one turning point of the smoothed displacement to the next. Its steady window begins when the speed
has reached its plateau and the force has ended its pre-sliding rise, and ends before the platform slows down; rests
in between are left out with what follows them until sliding is steady again. Nothing that changes slowly (warming,
drift, a ripple, a Stribeck curve) is taken for a rise: only a force below everything it later shows counts as one.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d

from sealfit.config import Strokes
from sealfit.ingest.window import slope, steady_window


@dataclass(frozen=True, slots=True, eq=False)
class Stroke:
    """One stroke: rows `start` to `stop` (exclusive) of its trace.

    `origin` is the row where it begins to move, from which its distance counts (and, in a file of several strokes, its
    time): the first row, unless rows of rest come before the file's first stroke. `speed_mm_s` is in displacement units
    per time unit, signed. `steady` marks the rows of the window, `sliding` those in which it moves, both of shape
    (stop - start,). `short` says why the window is too short to be used; None if it is long enough.
    """

    number: int
    start: int
    stop: int
    origin: int
    direction: int
    speed_mm_s: float
    steady: np.ndarray
    sliding: np.ndarray
    short: str | None = None

    @property
    def rows(self) -> np.ndarray:
        """Rows of the steady window in the trace, shape (n,)."""
        return self.start + np.flatnonzero(self.steady)


def find_strokes(
    time_s: np.ndarray, displacement_mm: np.ndarray, force_N: np.ndarray, settings: Strokes
) -> list[Stroke]:
    """Return the strokes of one trace in order; none where nothing moves.

    Parameters
    ----------
    time_s, displacement_mm, force_N : ndarray, shape (n,)
        A trace in the rig's own units, finite, time rising (steps may differ, and hide gaps); displacement without
        spikes.
    settings : Strokes
        The config's `strokes`.

    Returns
    -------
    list of Stroke
        Strokes shorter than `min_travel_mm` are part of their neighbours' ends.
    """
    n = len(time_s)
    if n < 3 or np.ptp(displacement_mm) == 0.0:
        return []
    if settings.whole_file:
        return [_whole_file(time_s, displacement_mm, settings)]
    noise = displacement_noise_mm(displacement_mm)
    smooth = smoothed(displacement_mm, settings.smooth_samples)
    span = float(np.ptp(smooth))
    if span <= 8.0 * noise:  # the range of some hundred samples of noise alone is about six SDs
        return []
    travel = settings.min_travel_mm if settings.min_travel_mm is not None else 0.05 * span
    turns = turning_rows(smooth, travel)
    if len(turns) < 2:
        return []
    bounds, origin = _bounds(smooth, turns, max(3.0 * noise, 1e-3 * span), settings.smooth_samples)
    filtered = median_filter(force_N, 3, mode="nearest")  # single spikes must not decide where a rise ends
    strokes = []
    for i, (start, stop) in enumerate(pairwise(bounds)):
        first = origin if i == 0 else start
        direction = 1 if smooth[turns[i + 1]] > smooth[turns[i]] else -1
        rows = slice(start, stop)
        strokes.append(
            _stroke(
                i + 1, start, first, direction, time_s[rows], displacement_mm[rows], filtered[rows], noise, settings
            )
        )
    return strokes


def smoothed(values: np.ndarray, samples: int) -> np.ndarray:
    """Return `values` as a running mean of running medians over `samples` samples, shape (n,)."""
    if samples == 1:
        return np.asarray(values, float)
    return uniform_filter1d(median_filter(values, samples, mode="nearest"), samples, mode="nearest")


def displacement_noise_mm(displacement_mm: np.ndarray) -> float:
    """Return the standard deviation of one displacement sample, noise and resolution together.

    Second differences of a steady motion hold noise only: their variance is six times that of a sample. The 90th
    percentile is blind to gaps, stops and spikes. Where many neighbours are equal the step between the others is the
    resolution, whose rounding error is uniform: step / sqrt(12).
    """
    bend = np.abs(np.diff(displacement_mm, 2))
    noise = float(np.percentile(bend, 90)) / (1.645 * np.sqrt(6.0))
    steps = np.abs(np.diff(displacement_mm))
    moving = steps[steps > 0.0]
    if len(moving) and len(moving) < 0.9 * len(steps):
        noise = max(noise, float(np.percentile(moving, 5)) / np.sqrt(12.0))
    return noise


def turning_rows(smooth_mm: np.ndarray, travel_mm: float) -> list[int]:
    """Return the rows where the motion begins, turns and ends: extremes more than `travel_mm` apart.

    A turn counts once the displacement has come back by `travel_mm`, so neither noise nor a small backlash is one.
    Fewer than two rows where nothing moves that far.
    """
    # Only local extremes can be turning points; the ends belong to them.
    step = np.sign(np.diff(smooth_mm))
    nonzero = np.flatnonzero(step)
    change = nonzero[1:][step[nonzero[1:]] != step[nonzero[:-1]]]
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
    """Return the first row of every stroke, with the number of rows at the end, and the row where the first one moves.

    A rest at a turn belongs to the stroke before it: a stroke begins with the last row of rest.
    """
    starts = [_last_at_rest(smooth_mm, here, after, near_mm, samples) for here, after in pairwise(turns)]
    origin = 0 if starts[0] < samples else starts[0]  # noise at the first rows is not a rest
    return [0, *starts[1:], len(smooth_mm)], origin


def _last_at_rest(smooth_mm: np.ndarray, turn: int, after: int, near_mm: float, samples: int) -> int:
    far = np.flatnonzero(np.abs(smooth_mm[turn : after + 1] - smooth_mm[turn]) > near_mm)
    rest = int(far[0]) - 1 if len(far) else 0
    per_row = abs(smooth_mm[after] - smooth_mm[turn]) / (after - turn)
    # That many rows are as near as that to any turn without a rest.
    return turn + rest if rest > 3.0 * near_mm / per_row + samples else turn


def _whole_file(time_s: np.ndarray, displacement_mm: np.ndarray, settings: Strokes) -> Stroke:
    n = len(time_s)
    speed = slope(time_s, displacement_mm, np.ones(n, bool))
    short = None if n >= settings.min_samples else f"only {n} samples; at least {settings.min_samples} are needed"
    return Stroke(
        1,
        0,
        n,
        0,
        1 if displacement_mm[-1] >= displacement_mm[0] else -1,
        speed,
        np.ones(n, bool),
        np.ones(n, bool),
        short,
    )


def _stroke(
    number: int,
    start: int,
    origin: int,
    direction: int,
    time_s: np.ndarray,
    displacement_mm: np.ndarray,
    force_N: np.ndarray,
    noise_mm: float,
    settings: Strokes,
) -> Stroke:
    """Return one stroke from its own rows."""
    n = len(time_s)
    along = direction * displacement_mm
    steady, sliding = steady_window(
        time_s, along, direction * force_N, origin - start, noise_mm, settings.speed_tolerance
    )
    share = _covered(along, steady) / max(float(np.ptp(along)), 1e-300)
    count = int(steady.sum())
    measured = slope(time_s, displacement_mm, steady)
    short = None
    if count < settings.min_samples:
        short = f"the steady window has {count} samples; at least {settings.min_samples} are needed"
    elif share < settings.min_steady_share:
        short = f"the steady window is {share:.0%} of the stroke; at least {settings.min_steady_share:.0%} is needed"
    return Stroke(number, start, start + n, origin, direction, measured, steady, sliding, short)


def _covered(along_mm: np.ndarray, steady: np.ndarray) -> float:
    both = steady[1:] & steady[:-1]
    return float(np.abs(np.diff(along_mm)[both]).sum()) if both.any() else 0.0
