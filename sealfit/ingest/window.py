"""The steady window of one stroke: where its speed is on the plateau and its force past the pre-sliding rise."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from sealfit.ingest.presliding import rise_end_mm

REST = 0.5  # slower than this share of the plateau is a rest, not a ripple of the speed
STANDSTILL = 0.05  # slower than this share of the plateau: not moving yet, or no more
# A straight ramp takes 1.1 times as long for all of the plateau as for 90 % of it, and 1.8 times as long for 90 % as
# for 50 %; a first-order lag three times as long for 99.9 %, and 3.3 times. In between, in between.
STRAIGHT, LAG = (1.8, 0.25), (3.3, 2.0)
BEFORE_STOP = 0.5  # an S-shaped stop leaves the plateau earlier than a straight one, by less than half its length
SPEED_NOISE = 0.25  # noise of the local speed, as a share of the tolerance: a false exit is then a matter of four SDs


def steady_window(
    time_s: np.ndarray, along_mm: np.ndarray, force_N: np.ndarray, origin: int, noise_mm: float, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return which rows of a stroke are in its steady window, and in which it slides at all, shape (n,) each.

    Parameters
    ----------
    time_s, along_mm, force_N : ndarray, shape (n,)
        One stroke; displacement rising with the motion, force positive against it.
    origin : int
        Row from which it may move.
    noise_mm : float
        Standard deviation of a displacement sample.
    tolerance : float
        Share by which the speed may be off its plateau.
    """
    # A glitch of one sample is not a rest.
    speed, half = local_speed(time_s, median_filter(along_mm, 5, mode="nearest"), noise_mm, tolerance)
    plateau = plateau_speed(time_s, speed)
    steady = np.zeros(len(time_s), bool)
    since = origin
    for first, last in _moving(time_s, along_mm, speed, plateau, since, half):
        still = _standstill(speed, plateau, since, first)
        begin = _ramp_end(time_s, speed, plateau, still, first, last, half, tolerance)
        end = _stop_begin(time_s, speed, plateau, first, last, half, tolerance)
        if end - begin >= 4:
            steady[_rise_end(along_mm, force_N, still, begin, end) : end] = True
        since = last
    sliding = speed > STANDSTILL * plateau
    sliding[:origin] = False
    return steady, sliding


def local_speed(time_s: np.ndarray, along_mm: np.ndarray, noise_mm: float, tolerance: float) -> tuple[np.ndarray, int]:
    """Return the speed over `half` rows to either side of each row, and `half`, wide enough for the noise.

    Differences of displacement over differences of time: a gap does no harm.
    """
    n = len(time_s)
    mean_step = abs(along_mm[-1] - along_mm[0]) / (n - 1)
    # The speed's SD is sqrt(2) noise over the width, wanted below SPEED_NOISE * tolerance of the speed itself.
    wanted = np.sqrt(2.0) * noise_mm / max(2.0 * SPEED_NOISE * tolerance * mean_step, 1e-300)
    half = int(min(max(np.ceil(wanted), 1), max(n // 8, 1)))
    rows = np.arange(n)
    low, high = np.maximum(rows - half, 0), np.minimum(rows + half, n - 1)
    return (along_mm[high] - along_mm[low]) / (time_s[high] - time_s[low]), half


def plateau_speed(time_s: np.ndarray, speed: np.ndarray) -> float:
    """Return the speed at which half of the distance is slid slower and half faster: blind to rests and ramps."""
    distance = np.maximum(speed, 0.0) * np.gradient(time_s)
    order = np.argsort(speed)
    covered = np.cumsum(distance[order])
    if covered[-1] <= 0.0:
        return 0.0
    return float(speed[order][np.searchsorted(covered, 0.5 * covered[-1])])


def slope(time_s: np.ndarray, displacement_mm: np.ndarray, steady: np.ndarray) -> float:
    """Return the slope of displacement over time by least squares, with one slope for all pieces of the window.

    Each piece (between rests) has its own intercept, so a rest does not count as slow sliding. NaN without samples.
    """
    rows = np.flatnonzero(steady)
    if len(rows) < 2:
        return float("nan")
    piece = np.cumsum(np.diff(rows, prepend=rows[0]) > 1)
    count = np.bincount(piece)
    t, d = time_s[rows], displacement_mm[rows]
    t = t - (np.bincount(piece, t) / count)[piece]
    d = d - (np.bincount(piece, d) / count)[piece]
    return float(np.dot(t, d) / np.dot(t, t))


def _moving(
    time_s: np.ndarray, along_mm: np.ndarray, speed: np.ndarray, plateau: float, origin: int, half: int
) -> list[tuple[int, int]]:
    """Return first and last (exclusive) row of every stretch of motion after `origin`.

    Slow samples are a rest only if they cost more time than the width over which the speed is taken: noise does not.
    """
    if plateau <= 0.0:
        return []
    moves = speed > REST * plateau
    moves[: max(origin, 0)] = False
    edges = np.flatnonzero(np.diff(np.concatenate(([False], moves, [False])).astype(np.int8)))
    stretches: list[tuple[int, int]] = []
    step = float(np.median(np.diff(time_s)))
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if stretches:
            a, b = max(stretches[-1][1] - half, 0), min(first + half, len(time_s) - 1)
            lost = (time_s[b] - time_s[a]) - (along_mm[b] - along_mm[a]) / plateau
            if lost <= 2.0 * half * step:
                stretches[-1] = (stretches[-1][0], last)
                continue
        stretches.append((first, last))
    return [(first, last) for first, last in stretches if last - first > 2 * half + 3]


def _standstill(speed: np.ndarray, plateau: float, since: int, first: int) -> int:
    """Return the last row from `since` on, and before `first`, at which the platform still stood; `since` if none."""
    still = np.flatnonzero(speed[since:first] < STANDSTILL * plateau)
    return since + int(still[-1]) if len(still) else since


def _ramp_end(
    time_s: np.ndarray,
    speed: np.ndarray,
    plateau: float,
    still: int,
    first: int,
    last: int,
    half: int,
    tolerance: float,
) -> int:
    reached = np.flatnonzero(speed[first:last] >= (1.0 - tolerance) * plateau)
    if not len(reached):
        return last
    arrived = first + int(reached[0])
    if arrived <= still:
        return arrived
    # The local speed smears a sudden start over 2 half rows, 1.7 of them between standstill and arrival.
    step = (time_s[last - 1] - time_s[first]) / max(last - 1 - first, 1)
    ramp = max(time_s[arrived] - time_s[still] - 1.7 * half * step, 0.0)
    half_way = still + int(np.argmax(speed[still : arrived + 1] >= 0.5 * plateau))
    shape = (time_s[arrived] - time_s[still]) / max(time_s[half_way] - time_s[still], step)
    after = float(np.interp(shape, [STRAIGHT[0], LAG[0]], [STRAIGHT[1], LAG[1]])) * ramp
    return int(np.searchsorted(time_s, time_s[arrived] + after)) + half // 3 + 1


def _stop_begin(
    time_s: np.ndarray, speed: np.ndarray, plateau: float, first: int, last: int, half: int, tolerance: float
) -> int:
    fast = np.flatnonzero(speed[first:last] >= (1.0 - tolerance) * plateau)
    if not len(fast):
        return first
    left = first + int(fast[-1])
    n = len(speed)
    if left == n - 1:
        return n
    still = np.flatnonzero(speed[left:] < STANDSTILL * plateau)
    stopped = left + int(still[0]) if len(still) else n - 1
    step = (time_s[last - 1] - time_s[first]) / max(last - 1 - first, 1)
    brake = max(time_s[stopped] - time_s[left] - 1.7 * half * step, 0.0)
    return int(np.searchsorted(time_s, time_s[left] - BEFORE_STOP * brake)) - half // 3


def _rise_end(along_mm: np.ndarray, force_N: np.ndarray, still: int, begin: int, end: int) -> int:
    """Return the row, at or after `begin`, from which the force is past its pre-sliding rise."""
    distance = np.maximum.accumulate(along_mm[still:end]) - along_mm[still]
    past = rise_end_mm(distance, force_N[still:end], begin - still)
    return max(begin, still + int(np.searchsorted(distance, past)))
