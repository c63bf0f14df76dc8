"""The steady window of a stroke: where its speed is on the plateau and its force past the pre-sliding rise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sealfit.ingest.pieces import Pieces, median, weighted_medians
from sealfit.ingest.presliding import Start, rise_ends_mm
from sealfit.ingest.running import running_median

REST = 0.5  # slower than this share of the plateau is a rest, not a ripple of the speed
STANDSTILL = 0.05  # slower than this share of the plateau: not moving yet, or no more
# A straight ramp takes 1.1 times as long for all of the plateau as for 90 % of it, and 1.8 times as long for 90 % as
# for 50 %; a first-order lag three times as long for 99.9 %, and 3.3 times. In between, in between.
STRAIGHT, LAG = (1.8, 0.25), (3.3, 2.0)
BEFORE_STOP = 0.5  # an S-shaped stop leaves the plateau earlier than a straight one, by less than half its length
SPEED_NOISE = 0.25  # noise of the local speed, as a share of the tolerance: a false exit is then a matter of four SDs


def steady_windows(
    time_s: np.ndarray,
    along_mm: np.ndarray,
    force_N: np.ndarray,
    strokes: Pieces,
    origin: np.ndarray,
    noise_mm: np.ndarray,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return which rows of strokes are in their steady window, and in which they slide at all, shape (n,) each.

    Parameters
    ----------
    time_s, along_mm, force_N : ndarray, shape (n,)
        Strokes, one after the other; displacement rising with the motion, force positive against it.
    strokes : Pieces
        Where each of them lies.
    origin : ndarray of int, shape (strokes,)
        Row, counted from the stroke's first one, from which it may move.
    noise_mm : ndarray, shape (strokes,)
        Standard deviation of a displacement sample.
    tolerance : float
        Share by which the speed may be off its plateau.
    """
    # A glitch of one sample is not a rest.
    speed, half = local_speeds(time_s, running_median(along_mm, strokes, 5), strokes, noise_mm, tolerance)
    plateau = plateau_speeds(time_s, speed, strokes)
    steady = np.zeros(len(time_s), bool)
    usual = strokes.spread(plateau)
    slow = speed < STANDSTILL * usual
    fast = speed >= (1.0 - tolerance) * usual
    sliding = speed > STANDSTILL * usual
    moves = speed > REST * usual
    for start, rows in zip(strokes.start[origin > 0].tolist(), origin[origin > 0].tolist(), strict=True):
        sliding[start : start + rows] = moves[start : start + rows] = False
    begins, ends = (strokes.split(rows) for rows in _edges(moves, strokes))
    stretches: list[tuple[int, int, int]] = []  # standstill, and where the speed is steady
    for i, rows in enumerate(strokes.slices):
        if plateau[i] <= 0.0:
            continue
        own = (values[rows] for values in (time_s, along_mm, speed, slow, fast))
        stroke, since = _Motion(*own, float(plateau[i]), int(half[i])), int(origin[i])
        for first, last in stroke.moving(begins[i].tolist(), ends[i].tolist()):
            still = stroke.standstill(since, first)
            begin, end = stroke.ramp_end(still, first, last), stroke.stop_begin(first, last)
            if end - begin >= 4:
                stretches.append((rows.start + still, rows.start + begin, rows.start + end))
            since = last
    for begin, end in _past_rises(along_mm, force_N, stretches):
        steady[begin:end] = True
    return steady, sliding


def _past_rises(
    along_mm: np.ndarray, force_N: np.ndarray, stretches: Sequence[tuple[int, int, int]]
) -> list[tuple[int, int]]:
    """Return the rows of each stretch from where the force is past its pre-sliding rise."""
    starts = []
    for still, begin, end in stretches:
        distance = np.maximum.accumulate(along_mm[still:end]) - along_mm[still]
        starts.append(Start(distance, force_N[still:end], begin - still))
    return [
        (max(begin, still + int(start.distance_mm.searchsorted(past))), end)
        for (still, begin, end), start, past in zip(stretches, starts, rise_ends_mm(starts), strict=True)
    ]


def local_speeds(
    time_s: np.ndarray, along_mm: np.ndarray, strokes: Pieces, noise_mm: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the speed over `half` rows to either side of each row, and each stroke's `half`: wide enough for noise.

    Differences of displacement over differences of time: a gap does no harm.
    """
    last = strokes.stop - 1
    mean_step = np.abs(along_mm[last] - along_mm[strokes.start]) / np.maximum(strokes.size - 1, 1)
    # The speed's SD is sqrt(2) noise over the width, wanted below SPEED_NOISE * tolerance of the speed itself.
    wanted = np.sqrt(2.0) * noise_mm / np.maximum(2.0 * SPEED_NOISE * tolerance * mean_step, 1e-300)
    half = np.minimum(np.maximum(np.ceil(wanted), 1), np.maximum(strokes.size // 8, 1)).astype(np.int64)
    rows, width = np.arange(strokes.rows), strokes.spread(half)
    low = np.maximum(rows - width, strokes.spread(strokes.start))
    high = np.minimum(rows + width, strokes.spread(last))
    return (along_mm[high] - along_mm[low]) / (time_s[high] - time_s[low]), half


def plateau_speeds(time_s: np.ndarray, speed: np.ndarray, strokes: Pieces) -> np.ndarray:
    """Return the speed at which half of the distance is slid slower and half faster: blind to rests and ramps."""
    lasts = np.empty(len(time_s))  # how long each sample lasts, as np.gradient says it
    lasts[1:-1] = (time_s[2:] - time_s[:-2]) / 2.0
    first, last = strokes.start, strokes.stop - 1
    lasts[first] = time_s[np.minimum(first + 1, last)] - time_s[first]
    lasts[last] = time_s[last] - time_s[np.maximum(last - 1, first)]
    return weighted_medians(speed, np.maximum(speed, 0.0) * lasts, strokes)


def slopes(time_s: np.ndarray, displacement_mm: np.ndarray, steady: np.ndarray, strokes: Pieces) -> np.ndarray:
    """Return the slope of displacement over time by least squares, with one slope for all pieces of a stroke's window.

    Each piece (between rests) has its own intercept, so a rest does not count as slow sliding. NaN without samples.
    """
    made, sums = np.full(len(strokes), np.nan), np.zeros((len(strokes), 3))
    firsts, lasts = _edges(steady, strokes)
    for i, first, last in zip(strokes.of[firsts].tolist(), firsts.tolist(), lasts.tolist(), strict=True):
        t, d, n = time_s[first : last + 1], displacement_mm[first : last + 1], last + 1 - first
        t = t - np.add.reduce(t) / n
        sums[i] += n, t @ (d - np.add.reduce(d) / n), t @ t
    enough = sums[:, 0] > 1
    with np.errstate(invalid="ignore"):  # rows that are all single pieces have no slope
        made[enough] = sums[enough, 1] / sums[enough, 2]
    return made


def _edges(mask: np.ndarray, strokes: Pieces) -> tuple[np.ndarray, np.ndarray]:
    """Return the first rows of all stretches of `mask`, none longer than its stroke, and their last rows."""
    begins, ends = mask.copy(), mask.copy()
    begins[1:] &= ~mask[:-1]
    ends[:-1] &= ~mask[1:]
    begins[strokes.start] = mask[strokes.start]
    ends[strokes.stop - 1] = mask[strokes.stop - 1]
    return np.flatnonzero(begins), np.flatnonzero(ends)


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """How one stroke moves: arrays of shape (n,); `slow` and `fast` mark standstill and the band of the plateau."""

    time_s: np.ndarray
    along_mm: np.ndarray
    speed: np.ndarray
    slow: np.ndarray
    fast: np.ndarray
    plateau: float
    half: int

    def moving(self, begins: list[int], ends: list[int]) -> list[tuple[int, int]]:
        """Return first and last (exclusive) row of every stretch of motion, from where it is faster than a rest.

        Slow samples are a rest only if they cost more time than the width over which the speed is taken: noise does
        not.
        """
        stretches: list[tuple[int, int]] = []
        time_s, along_mm, half = self.time_s, self.along_mm, self.half
        step = median(time_s[1:] - time_s[:-1]) if len(begins) > 1 else 0.0
        for first, end in zip(begins, ends, strict=True):
            if stretches:
                a, b = max(stretches[-1][1] - half, 0), min(first + half, len(time_s) - 1)
                lost = (time_s[b] - time_s[a]) - (along_mm[b] - along_mm[a]) / self.plateau
                if lost <= 2.0 * half * step:
                    stretches[-1] = (stretches[-1][0], end + 1)
                    continue
            stretches.append((first, end + 1))
        return [(first, last) for first, last in stretches if last - first > 2 * half + 3]

    def standstill(self, since: int, first: int) -> int:
        """Return the last row from `since` on, and before `first`, at which the platform still stood; else `since`."""
        still = _last(self.slow[since:first])
        return since if still is None else since + still

    def ramp_end(self, still: int, first: int, last: int) -> int:
        """Return the row from which the speed is on its plateau."""
        reached = _first(self.fast[first:last])
        if reached is None:
            return last
        time_s, arrived = self.time_s, first + reached
        if arrived <= still:
            return arrived
        # The local speed smears a sudden start over 2 half rows, 1.7 of them between standstill and arrival.
        step = float(time_s[last - 1] - time_s[first]) / max(last - 1 - first, 1)
        took = float(time_s[arrived] - time_s[still])
        ramp = max(took - 1.7 * self.half * step, 0.0)
        half_way = still + int(np.argmax(self.speed[still : arrived + 1] >= 0.5 * self.plateau))
        shape = took / max(float(time_s[half_way] - time_s[still]), step)
        after = _after_ramp(shape) * ramp
        return int(time_s.searchsorted(time_s[arrived] + after)) + self.half // 3 + 1

    def stop_begin(self, first: int, last: int) -> int:
        """Return the row at which the speed leaves its plateau for good."""
        fast = _last(self.fast[first:last])
        if fast is None:
            return first
        time_s, left = self.time_s, first + fast
        n = len(time_s)
        if left == n - 1:
            return n - 1  # where the stroke ends: it may have stopped since the sample before
        still = _first(self.slow[left:])
        stopped = left + still if still is not None else n - 1
        step = float(time_s[last - 1] - time_s[first]) / max(last - 1 - first, 1)
        brake = max(float(time_s[stopped] - time_s[left]) - 1.7 * self.half * step, 0.0)
        return int(time_s.searchsorted(time_s[left] - BEFORE_STOP * brake)) - self.half // 3


def _after_ramp(shape: float) -> float:
    """Return how much of the ramp follows after 90 % of the plateau, from the times to 90 % and to 50 % of it."""
    (low, least), (high, most) = STRAIGHT, LAG
    return least + (most - least) / (high - low) * (min(max(shape, low), high) - low)


def _first(mask: np.ndarray) -> int | None:
    """Return the first row that is true, if any."""
    at = int(mask.argmax()) if len(mask) else 0
    return at if len(mask) and mask[at] else None


def _last(mask: np.ndarray) -> int | None:
    """Return the last row that is true, if any."""
    found = _first(mask[::-1])
    return None if found is None else len(mask) - 1 - found
