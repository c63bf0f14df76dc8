"""The steady window of a stroke: where its speed is on the plateau and its force past the pre-sliding rise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sealfit.ingest.presliding import Start, rises
from sealfit.ingest.segments import Pieces, median, running_median, weighted_medians

REST = 0.5  # slower than this share of the plateau is a rest, not a ripple of the speed
STANDSTILL = 0.05  # slower than this share of the plateau: not moving yet, or no more
# A straight ramp takes 1.1 times as long for all of the plateau as for 90 % of it, and 1.8 times as long for 90 % as
# for 50 %; a first-order lag three times as long for 99.9 %, and 3.3 times. In between, in between.
STRAIGHT, LAG = (1.8, 0.25), (3.3, 2.0)
BEFORE_STOP = 0.5  # an S-shaped stop leaves the plateau earlier than a straight one, by less than half its length
ONSET, HALF_UP = 0.05, 0.5  # shares of the rise below which a force is at rest, and above which it has come up
SPEED_PIECES = (8, 64)  # of a steady window, whose speeds are compared: at least, and at most
LEAST_ROWS = 8  # of such a piece
SAME_SPEED = 0.001  # share by which speeds may differ without a word: errors of screws and scales are of that size
CLEAR = 3.0  # times the scatter by chance that speeds must show: under it, 3 strokes of 1,000 do
SPEED_NOISE = 0.25  # noise of the local speed, as a share of the tolerance: a false exit is then a matter of four SDs


def steady_windows(
    time_s: np.ndarray,
    along_mm: np.ndarray,
    force_N: np.ndarray,
    strokes: Pieces,
    origin: np.ndarray,
    noise_mm: np.ndarray,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return which rows of strokes are in their steady window, in which they slide at all, and what is left there of
    the pre-sliding rise (in N, positive against the motion; 0 outside the window), shape (n,) each; and the length of
    the rise of each stroke in mm, shape (strokes,), 0 without one.

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
    speed, half, blurred = local_speeds(time_s, running_median(along_mm, strokes, 5), strokes, noise_mm, tolerance)
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
    stretches: list[_Stretch] = []
    for i, rows in enumerate(strokes.slices):
        if plateau[i] <= 0.0:
            continue
        own = (values[rows] for values in (time_s, along_mm, speed, slow, fast))
        stroke, since = _Motion(*own, float(plateau[i]), int(half[i])), 0 if blurred[i] else int(origin[i])
        for first, last in stroke.moving(begins[i].tolist(), ends[i].tolist()):
            still = stroke.standstill(since, first)
            begin, end = stroke.ramp_end(still, first, last), stroke.stop_begin(first, last)
            if blurred[i]:  # neither the rest nor the ramp can be seen: the force says better when the motion begins
                still = max(still, first_motion(force_N[rows][:end], still))
                begin = max(begin, still)
            if end - begin >= 4:
                places = (rows.start + row for row in (still, begin, end))
                stretches.append(_Stretch(*places, 0 if blurred[i] else int(half[i])))
            since = last
    left, length = np.zeros(len(time_s)), np.zeros(len(strokes))
    for begin, end, left_N, length_mm in _past_rises(time_s, along_mm, force_N, stretches):
        steady[begin:end] = True
        left[begin:end] = left_N
        length[strokes.of[begin]] = length_mm
    return steady, sliding, left, length


class _Stretch(NamedTuple):
    """A stretch of motion: rows of its standstill and of where the speed is steady (the last one exclusive), and over
    how many rows the displacement is to be averaged; 0 where its noise hides how the stretch starts."""

    still: int
    begin: int
    end: int
    averaged: int


def _past_rises(
    time_s: np.ndarray, along_mm: np.ndarray, force_N: np.ndarray, stretches: Sequence[_Stretch]
) -> list[tuple[int, int, np.ndarray, float]]:
    """Return the rows of each stretch from where the force is past its pre-sliding rise, what is left of it there, and
    its length in mm."""
    starts = []
    for still, begin, end, averaged in stretches:
        distance = _distance(time_s[still:end], along_mm[still:end], begin - still, averaged)
        starts.append(Start(distance, force_N[still:end], begin - still))
    made = []
    for (still, begin, end, _), start, rise in zip(stretches, starts, rises(starts), strict=True):
        past = int(start.distance_mm.searchsorted(rise.end_mm)) if rise.end_mm > 0.0 else 0
        first = max(begin, still + past)
        made.append((first, end, rise.at(start.distance_mm[first - still :]), rise.length_mm))
    return made


def _distance(time_s: np.ndarray, along_mm: np.ndarray, ramp_end: int, averaged: int) -> np.ndarray:
    """Return the distance from standstill, never falling, in mm; free of noise on the plateau of the speed.

    There it is a straight line over time, and what the displacement is off that line, averaged: noise of the
    displacement would be noise of the rise's share that is left. With `averaged` 0 time says all of it.
    """
    rows = slice(ramp_end, None)
    middle, now = along_mm[rows].mean(), time_s[rows].mean()
    along, time = along_mm[rows] - middle, time_s[rows] - now
    speed = float(time @ along) / float(time @ time)
    if not averaged:
        return speed * (time_s - time_s[0])
    line = speed * time
    line = middle - along_mm[0] + line + _averaged(along - line, averaged)
    ramp = np.maximum.accumulate(along_mm[:ramp_end]) - along_mm[0]
    return np.maximum.accumulate(np.r_[np.clip(ramp, 0.0, max(line[0], 0.0)), line])


def _averaged(values: np.ndarray, rows: int) -> np.ndarray:
    """Return the mean over `rows` rows to either side of each, or as many as there are."""
    sums, place = np.concatenate(([0.0], np.cumsum(values))), np.arange(len(values))
    low, high = np.maximum(place - rows, 0), np.minimum(place + rows + 1, len(values))
    return (sums[high] - sums[low]) / (high - low)


def local_speeds(
    time_s: np.ndarray, along_mm: np.ndarray, strokes: Pieces, noise_mm: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the speed over `half` rows to either side of each row, each stroke's `half`: wide enough for noise; and
    in which strokes a rest or a ramp shorter than that cannot be seen.

    Differences of displacement over differences of time: a gap does no harm. Of single samples, or, where these would
    have to be more than a quarter of the stroke apart, of the means of all samples to either side.
    """
    last = strokes.stop - 1
    mean_step = np.abs(along_mm[last] - along_mm[strokes.start]) / np.maximum(strokes.size - 1, 1)
    # The speed's SD is sqrt(2) noise over the width, wanted below SPEED_NOISE * tolerance of the speed itself.
    wanted = np.sqrt(2.0) * noise_mm / np.maximum(2.0 * SPEED_NOISE * tolerance * mean_step, 1e-300)
    most = np.maximum(strokes.size // 8, 1)
    half = np.minimum(np.maximum(np.ceil(wanted), 1), most).astype(np.int64)
    blurred = wanted > most
    # Of means of `half` samples each, `half` apart, it is sqrt(2 / half) noise over `half` steps.
    half[blurred] = np.minimum(np.ceil((2.0 * wanted[blurred]) ** (2.0 / 3.0)), most[blurred]).astype(np.int64)
    rows, width = np.arange(strokes.rows), strokes.spread(half)
    low = np.maximum(rows - width, strokes.spread(strokes.start))
    high = np.minimum(rows + width, strokes.spread(last))
    speed = (along_mm[high] - along_mm[low]) / (time_s[high] - time_s[low])
    for i in np.flatnonzero(blurred).tolist():
        own = strokes.slices[i]
        speed[own] = _speeds_of_means(time_s[own], along_mm[own], int(half[i]))
    return speed, half, blurred


def _speeds_of_means(time_s: np.ndarray, along_mm: np.ndarray, half: int) -> np.ndarray:
    """Return the speed at every row of a stroke from the means of `half` rows before and after it; near the ends that
    of the nearest row which has so many."""
    sums = [np.concatenate(([0.0], np.cumsum(values - values[0]))) for values in (along_mm, time_s)]
    place = np.clip(np.arange(len(time_s)), half, len(time_s) - half)
    moved, lasted = (total[place + half] - 2.0 * total[place] + total[place - half] for total in sums)
    return moved / lasted


def first_motion(force_N: np.ndarray, since: int) -> int:
    """Return the row, from `since` on, from which the force comes up to its level: the last at which it is at rest.

    Examples
    --------
    >>> first_motion(np.r_[np.zeros(50), 30.0 * (1.0 - np.exp(-np.arange(200) / 20.0))], 0)
    51
    """
    own = force_N[since:]
    if len(own) < 8:
        return since
    begin, level = median(own[: max(len(own) // 100, 3)]), median(own)
    share = (own - begin) / (level - begin) if level != begin else np.ones(len(own))
    up = _first(share > HALF_UP)
    still = _last(share[:up] < ONSET) if up else None
    return since if still is None else since + still


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


def speeds_along(
    time_s: np.ndarray,
    displacement_mm: np.ndarray,
    steady: np.ndarray,
    strokes: Pieces,
    speed: np.ndarray,
    noise_mm: np.ndarray,
    lag_mm: np.ndarray,
) -> np.ndarray:
    """Return the speed that the friction at every row of the steady windows follows, shape (n,): the stroke's, and how
    it changes along it, `lag_mm` before: bristles follow a slow change by the length of their rise behind (Eq. 2).

    A window is cut into pieces of equal time, each with a slope by least squares; where these differ clearly, the
    speed is straight between their middles. `speed` is that of each stroke; it is returned as it is elsewhere, and
    where a window is short or has rests. `noise_mm` of a displacement sample decides how many pieces a stroke has.
    """
    made = strokes.spread(speed)
    firsts, lasts = _edges(steady, strokes)
    stroke = strokes.of[firsts]
    count = np.bincount(stroke, minlength=len(strokes))
    for i, first, last in zip(stroke.tolist(), firsts.tolist(), lasts.tolist(), strict=True):
        if count[i] == 1 and last + 1 - first >= SPEED_PIECES[0] * LEAST_ROWS and abs(speed[i]) > 0.0:
            rows = slice(first, last + 1)
            lag_s = float(lag_mm[i] / abs(speed[i]))
            made[rows] += _off_speed(time_s[rows], displacement_mm[rows], float(speed[i]), float(noise_mm[i]), lag_s)
    return made


def _off_speed(
    time_s: np.ndarray, displacement_mm: np.ndarray, speed: float, noise_mm: float, lag_s: float
) -> np.ndarray:
    """Return by how much the speed, so long before, differs from the stroke's at every row of a window, shape (n,)."""
    n, error = len(time_s), SAME_SPEED * abs(speed)
    # k slopes of n / k samples over 1/k of the time have errors of sqrt(12 k^3 / n) noise over the whole of it.
    noise = max(noise_mm / (time_s[-1] - time_s[0]), 1e-9 * error)
    least, most = SPEED_PIECES
    pieces = int(min(max((n * (error / noise) ** 2 / 12.0) ** (1.0 / 3.0), least), most, n // LEAST_ROWS))
    rows = n // pieces * pieces
    time, place = (values[:rows].reshape(pieces, -1) for values in (time_s, displacement_mm))
    middle = time.mean(axis=1)
    t, x = time - middle[:, None], place - place.mean(axis=1)[:, None]
    square = (t * t).sum(axis=1)
    slope = (t * x).sum(axis=1) / square
    residual = x - slope[:, None] * t
    # Neighbours that err alike (steps of a coarse sensor) count as one: a sign lasts for two of independent ones.
    alike = residual.size / max(2 * np.count_nonzero(np.diff(np.sign(residual), axis=1)), 1)
    variance = (residual**2).mean() * max(alike, 1.0) / square + error**2
    scatter = float(((slope - slope.mean()) ** 2 / variance).sum())
    if not scatter > CLEAR * (pieces - 1):
        return np.zeros(n)
    off = slope - speed
    # A whole piece further at either end, along a straight line.
    at = np.r_[2.0 * middle[0] - middle[1], middle, 2.0 * middle[-1] - middle[-2]]
    off = np.r_[2.0 * off[0] - off[1], off, 2.0 * off[-1] - off[-2]]
    return np.interp(time_s - lag_s, at, off)


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
