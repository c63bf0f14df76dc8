"""Strokes of a trace, and in each the window in which it slides steadily: found from the data.

A stroke runs from one turning point of the smoothed displacement to the next. Its steady window begins when the speed
has reached its plateau and the force has ended its pre-sliding rise, and ends before the platform slows down; rests
in between are left out with what follows them until sliding is steady again. Nothing that changes slowly (warming,
drift, a ripple, a Stribeck curve) is taken for a rise: only a force below everything it later shows counts as one.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sealfit.config import Strokes
from sealfit.ingest.segments import Pieces, median, quantile, running_mean, running_median
from sealfit.ingest.window import slopes, speeds_along, steady_windows


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


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The strokes of several traces that lie one after the other.

    Arrays of shape (strokes,), in order: `trace` (its place among the traces) and what a `Stroke` has, with `start`,
    `stop` and `origin` as rows of the flat arrays. `steady` and `sliding` are of shape (rows,), false in traces
    without strokes; so is `presliding_N`, what is left of the pre-sliding rise in the steady windows, with the sign
    of the force, 0 elsewhere. `speed_along_mm_s` is the speed at every row, where it is seen to differ from the
    stroke's.
    """

    trace: np.ndarray
    number: np.ndarray
    start: np.ndarray
    stop: np.ndarray
    origin: np.ndarray
    direction: np.ndarray
    speed_mm_s: np.ndarray
    short: list[str | None]
    steady: np.ndarray
    sliding: np.ndarray
    presliding_N: np.ndarray
    speed_along_mm_s: np.ndarray

    def of_trace(self, trace: int, first_row: int) -> list[Stroke]:
        """Return the strokes of one trace, whose first row is given, with rows counted from there."""
        return [self.stroke(i, first_row) for i in np.flatnonzero(self.trace == trace).tolist()]

    def stroke(self, i: int, first_row: int) -> Stroke:
        """Return one stroke, with rows counted from the first one of its trace."""
        rows = slice(int(self.start[i]), int(self.stop[i]))
        ends = (int(row) - first_row for row in (self.start[i], self.stop[i], self.origin[i]))
        way, speed = int(self.direction[i]), float(self.speed_mm_s[i])
        return Stroke(int(self.number[i]), *ends, way, speed, self.steady[rows], self.sliding[rows], self.short[i])


def find_strokes(
    time_s: np.ndarray, displacement_mm: np.ndarray, force_N: np.ndarray, settings: Strokes
) -> list[Stroke]:
    """Return the strokes of one trace in order; none where nothing moves. For arguments see `find_all`."""
    if not len(time_s):
        return []
    return find_all(time_s, displacement_mm, force_N, Pieces([len(time_s)]), settings).of_trace(0, 0)


def find_all(
    time_s: np.ndarray,
    displacement_mm: np.ndarray,
    force_N: np.ndarray,
    traces: Pieces,
    settings: Strokes,
    noise_mm: np.ndarray | None = None,
) -> Found:
    """Return the strokes of several traces.

    Parameters
    ----------
    time_s, displacement_mm, force_N : ndarray, shape (n,)
        Traces in the rig's own units, one after the other, finite, time rising in each (steps may differ, and hide
        gaps); displacement without spikes.
    traces : Pieces
        Where each of them lies.
    settings : Strokes
        The config's `strokes`.
    noise_mm : ndarray, shape (traces,), optional
        What `displacement_noises_mm` says of them, where it is known.

    Returns
    -------
    Found
        Strokes shorter than `min_travel_mm` are part of their neighbours' ends.
    """
    moves = (traces.size >= 3) & (traces.max(displacement_mm) != traces.min(displacement_mm))
    if settings.whole_file:
        whole = np.flatnonzero(moves)
        last, first = displacement_mm[traces.stop[whole] - 1], displacement_mm[traces.start[whole]]
        way = np.where(last >= first, 1, -1)
        cut = _Cut(whole, np.ones_like(whole), traces.start[whole], traces.stop[whole], traces.start[whole], way)
        return _whole_files(time_s, displacement_mm, traces.spread(moves), cut, settings)
    noise = displacement_noises_mm(displacement_mm, traces) if noise_mm is None else noise_mm
    smooth = smoothed(displacement_mm, traces, settings.smooth_samples)
    span = traces.max(smooth) - traces.min(smooth)
    moves &= ~(span <= 8.0 * noise)  # the range of some hundred samples of noise alone is about six SDs
    # The smoothed noise of a thousand samples comes back by three SDs of one sample: no turn.
    travel = np.maximum(0.05 * span, 4.0 * noise)
    if settings.min_travel_mm is not None:
        travel = np.full(len(traces), settings.min_travel_mm)
    cut = _cut(smooth, traces, moves, travel, np.maximum(3.0 * noise, 1e-3 * span), settings.smooth_samples)
    moves = np.isin(np.arange(len(traces)), cut.trace)
    rows = slice(None) if moves.all() else traces.spread(moves)
    strokes = Pieces(cut.stop - cut.start)
    way = strokes.spread(cut.direction)
    filtered = running_median(force_N, traces, 3)  # single spikes must not decide where a rise ends
    time_s, along, displacement_mm = time_s[rows], way * displacement_mm[rows], displacement_mm[rows]
    steady, sliding, left = np.zeros(traces.rows, bool), np.zeros(traces.rows, bool), np.zeros(traces.rows)
    if not len(strokes):
        return Found(*cut, np.empty(0), [], steady, sliding, left, np.zeros(traces.rows))
    steady[rows], sliding[rows], against, lag = steady_windows(
        time_s, along, way * filtered[rows], strokes, cut.origin - cut.start, noise[cut.trace], settings.speed_tolerance
    )
    left[rows] = way * against
    count, share = strokes.sum(steady[rows]), _share_covered(along, steady[rows], strokes)
    short = [_too_short(n, part, settings) for n, part in zip(count.tolist(), share.tolist(), strict=True)]
    speed, along_it = slopes(time_s, displacement_mm, steady[rows], strokes), np.zeros(traces.rows)
    along_it[rows] = speeds_along(time_s, displacement_mm, steady[rows], strokes, speed, noise[cut.trace], lag)
    return Found(*cut, speed, short, steady, sliding, left, along_it)


def smoothed(values: np.ndarray, traces: Pieces, samples: int) -> np.ndarray:
    """Return `values` as a running mean of running medians over `samples` samples, shape (n,)."""
    if samples == 1:
        return np.asarray(values, float)
    return running_mean(running_median(values, traces, samples), traces, samples)


def displacement_noises_mm(displacement_mm: np.ndarray, traces: Pieces) -> np.ndarray:
    """Return the standard deviation of one displacement sample, noise and resolution together, of every trace.

    Second differences of a steady motion hold noise only: their variance is six times that of a sample. The 90th
    percentile is blind to gaps, stops and spikes. Where most of the way is covered by single steps between rows that
    hardly differ, these are the resolution, whose rounding error is uniform: step / sqrt(12). A rest before or after
    the motion is no such step, be its rows equal or not. 0 of less than three samples.
    """
    steps = traces.steps(displacement_mm)
    bend = np.zeros(len(steps))
    np.abs(steps[1:] - steps[:-1], out=bend[:-1])
    steps = np.abs(steps)
    beside = np.zeros(len(steps))
    beside[1:] += steps[:-1]
    beside[:-1] += steps[1:]
    single = steps > 2.0 * beside
    coarse = traces.sum(np.where(single, steps, 0.0)) > 0.5 * traces.sum(steps)
    made = np.zeros(len(traces))
    for i, rows in enumerate(traces.slices):
        if rows.stop - rows.start < 3:
            continue
        made[i] = quantile(bend[rows.start : rows.stop - 2], 0.9) / (1.645 * np.sqrt(6.0))
        if coarse[i]:
            made[i] = max(made[i], median(steps[rows][single[rows]]) / np.sqrt(12.0))
    return made


class _Cut(NamedTuple):
    """Where strokes lie, as `Found` has it."""

    trace: np.ndarray
    number: np.ndarray
    start: np.ndarray
    stop: np.ndarray
    origin: np.ndarray
    direction: np.ndarray


def _cut(
    smooth_mm: np.ndarray, traces: Pieces, moves: np.ndarray, travel_mm: np.ndarray, near_mm: np.ndarray, samples: int
) -> _Cut:
    """Return the strokes of every trace that moves."""
    made: list[tuple[int, ...]] = []
    for i, (rows, change) in enumerate(zip(traces.slices, traces.split(_extremes(smooth_mm, traces)), strict=True)):
        own = smooth_mm[rows]
        turns = _turns(own, change.tolist(), float(travel_mm[i])) if moves[i] else []
        if len(turns) < 2:
            continue
        bounds, origin = _bounds(own, turns, float(near_mm[i]), samples)
        for number, (start, stop) in enumerate(pairwise(bounds), start=1):
            way = 1 if own[turns[number]] > own[turns[number - 1]] else -1
            first = origin if number == 1 else start
            made.append((i, number, rows.start + start, rows.start + stop, rows.start + first, way))
    return _Cut(*np.array(made, np.int64).reshape(-1, 6).T)


def turning_rows(smooth_mm: np.ndarray, travel_mm: float) -> list[int]:
    """Return the rows where the motion begins, turns and ends: extremes more than `travel_mm` apart.

    A turn counts once the displacement has come back by `travel_mm`, so neither noise nor a small backlash is one.
    Fewer than two rows where nothing moves that far.
    """
    return _turns(smooth_mm, _extremes(smooth_mm, Pieces([len(smooth_mm)])).tolist(), travel_mm)


def _extremes(smooth_mm: np.ndarray, traces: Pieces) -> np.ndarray:
    """Return the rows in all traces where the motion changes its sign."""
    step = np.sign(traces.steps(smooth_mm))
    nonzero = np.flatnonzero(step)
    of, way = traces.of[nonzero], step[nonzero]
    return nonzero[1:][(way[1:] != way[:-1]) & (of[1:] == of[:-1])]


def _turns(smooth_mm: np.ndarray, extremes: list[int], travel_mm: float) -> list[int]:
    # Only local extremes can be turning points; the ends belong to them.
    candidates = [0, *extremes, len(smooth_mm) - 1]
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
    far = np.abs(smooth_mm[turn : after + 1] - smooth_mm[turn]) > near_mm
    rest = max(int(far.argmax()) - 1, 0)
    per_row = float(abs(smooth_mm[after] - smooth_mm[turn])) / (after - turn)
    # That many rows are as near as that to any turn without a rest.
    return turn + rest if rest > 3.0 * near_mm / per_row + samples else turn


def _whole_files(
    time_s: np.ndarray, displacement_mm: np.ndarray, moves: np.ndarray, cut: _Cut, settings: Strokes
) -> Found:
    """Return every trace that moves as one stroke, steady throughout."""
    size = cut.stop - cut.start
    least = settings.min_samples
    short = [None if n >= least else f"only {n} samples; at least {least} are needed" for n in size.tolist()]
    strokes = Pieces(size)
    speed = slopes(time_s[moves], displacement_mm[moves], np.ones(strokes.rows, bool), strokes)
    along_it = np.zeros(len(moves))
    along_it[moves] = strokes.spread(speed)
    return Found(*cut, speed, short, moves, moves.copy(), np.zeros(len(moves)), along_it)


def _too_short(samples: int, share: float, settings: Strokes) -> str | None:
    """Return why a steady window is too short to be used."""
    if samples < settings.min_samples:
        return f"the steady window has {samples} samples; at least {settings.min_samples} are needed"
    if share < settings.min_steady_share:
        return f"the steady window is {share:.0%} of the stroke; at least {settings.min_steady_share:.0%} is needed"
    return None


def _share_covered(along_mm: np.ndarray, steady: np.ndarray, strokes: Pieces) -> np.ndarray:
    """Return the share of its range that a stroke covers within its steady window."""
    covered = np.abs(strokes.steps(along_mm))
    covered[:-1] *= steady[1:] & steady[:-1]
    return strokes.sum(covered) / np.maximum(strokes.max(along_mm) - strokes.min(along_mm), 1e-300)
