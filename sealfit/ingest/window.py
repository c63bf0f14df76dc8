"""The steady window of a stroke: its speed is on the plateau and its force past the pre-sliding rise."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import chdtrc

from sealfit.ingest.presliding import MotionStart, rise_of

# Share of the plateau speed below which the platform rests. A ripple of the speed stays above it.
REST = 0.5
# Share of the plateau speed below which the platform stands still: it does not move yet, or no more.
STANDSTILL = 0.05
# A straight ramp: its time to 90 % of the plateau speed over that to 50 % (0.9 / 0.5), and the share of it
# that is left out after 90 %. The ramp itself takes 0.11 more.
STRAIGHT = (1.8, 0.25)
# The same of a first-order lag, ln(10) / ln(2) and ln(1000) / ln(10) - 1, after which 99.9 % are reached.
LAG = (3.3, 2.0)
# Share of the braking time by which an S-shaped stop leaves the plateau earlier than a straight one, at most.
BEFORE_STOP = 0.5
# Shares of the rise below which a force is at rest, and above which it has come up.
ONSET, HALF_UP = 0.05, 0.5
# Pieces of a steady window whose speeds are compared, at least and at most, and rows of one at least.
SPEED_PIECES, LEAST_ROWS = (8, 64), 8
# Share by which speeds may differ without a finding. Errors of screws and scales are of that size.
SAME_SPEED = 0.002
# Range of the displacement about a straight line over time, in units of its largest second difference, below
# which the speed does not change. Beats of a sensor's steps with the sampling reach 0.53 (300 strokes).
DEPARTURE = 1.0
# P-value below which the speeds of pieces differ. It is small because campaigns have thousands of strokes.
CLEAR = 1e-6
# Noise of the local speed, as a share of the tolerance. A false exit from the plateau then takes four SDs.
SPEED_NOISE = 0.25
# Samples of a steady window, or of a stroke that may have one, at least.
LEAST_SAMPLES = 4
# Parts of equal rows into which a steady window is cut to see whether it begins within a transient, how many
# may be left out (a longer change is an effect), and how many after these the parabola is fitted to.
PARTS, MOST_PARTS, COMPARED = 20, 2, 8
# Standard errors, and share of the force, by which the first part must be off, one pair or the other. What
# warming leaves beside the parabola in a stroke of low noise reaches 10 standard errors and 2 % of the force.
OFF = ((20.0, 0.002), (8.0, 0.1))


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The steady window of one stroke; arrays of shape (n,).

    `steady` marks its rows, `sliding` those that move at all; `left_N` is what is left there of the
    pre-sliding rise, positive against the motion, and `rise_mm` its length, 0 without one. `settles` is false
    where the speed on the plateau changes by more than the tolerance.
    """

    steady: np.ndarray
    sliding: np.ndarray
    left_N: np.ndarray
    rise_mm: float
    settles: bool = True


def steady_window(
    time_s: np.ndarray,
    along_mm: np.ndarray,
    force_N: np.ndarray,
    origin: int,
    noise_mm: float,
    tolerance: float,
) -> Window:
    """Return the steady window of one stroke, which may move from row `origin` on.

    The arrays have shape (n,); displacement rises with the motion, force is positive against it. `noise_mm`
    is the standard deviation of a displacement sample, `tolerance` the share by which the speed may be off
    its plateau.
    """
    n = len(time_s)
    steady, sliding, left, length, settles = np.zeros(n, bool), np.zeros(n, bool), np.zeros(n), 0.0, True
    if n < LEAST_SAMPLES:
        return Window(steady, sliding, left, length)
    # A glitch of one sample is not a rest.
    smooth = median_filter(along_mm, 5, mode="nearest")
    speed, half, blurred = local_speed(time_s, smooth, noise_mm, tolerance)
    # The speed below which half of the distance is slid: blind to rests and ramps.
    plateau = weighted_median(speed, np.maximum(speed, 0.0) * np.gradient(time_s))
    moves = speed > REST * plateau
    sliding = speed > STANDSTILL * plateau
    sliding[:origin] = moves[:origin] = False
    if plateau <= 0.0:
        return Window(steady, sliding, left, length)
    fast = speed >= (1.0 - tolerance) * plateau
    stroke, since = _StrokeMotion(time_s, along_mm, speed, fast, plateau, half), 0 if blurred else origin
    for first, last in stroke.moving(moves):
        rest = _last(stroke.slow[since:first])
        still = since if rest is None else since + rest
        begin, end = stroke.ramp_end(still, first, last), stroke.stop_begin(first, last)
        if blurred:  # neither the rest nor the ramp can be seen: the force says better when the motion begins
            still = max(still, first_motion(force_N[:end], still))
            begin = max(begin, still)
        if end - begin >= LEAST_SAMPLES:
            rows = slice(still, end)
            distance = _distance(time_s[rows], along_mm[rows], begin - still, 0 if blurred else half)
            rise = rise_of(MotionStart(distance, force_N[rows], begin - still))
            if rise.end_mm > 0.0:
                begin = max(begin, still + int(distance.searchsorted(rise.end_mm)))
            settled = force_N[begin:end] - rise.at(distance[begin - still :])
            off = transient_rows(settled)
            begin += off
            if off:  # the force of inertia that was subtracted errs at both ends
                end -= transient_rows(settled[::-1])
            steady[begin:end] = True
            left[begin:end] = rise.at(distance[begin - still : end - still])
            length = rise.length_mm
            near = first + np.flatnonzero(fast[first:last])
            rows = slice(near[0], near[-1] + 1)
            settles &= _settles(time_s[rows], along_mm[rows], noise_mm, tolerance)
        since = last
    return Window(steady, sliding, left, length, settles)


def _distance(time_s: np.ndarray, along_mm: np.ndarray, ramp_end: int, averaged: int) -> np.ndarray:
    """Return the distance from standstill, never falling, in mm; free of noise on the plateau of the speed.

    There it is a straight line over time and the averaged deviation from it; with `averaged` 0 only the line.
    """
    rows = slice(ramp_end, None)
    middle, now = along_mm[rows].mean(), time_s[rows].mean()
    along, time = along_mm[rows] - middle, time_s[rows] - now
    speed = float(time @ along) / float(time @ time)
    if not averaged:
        return speed * (time_s - time_s[0])
    line = speed * time
    off, place = np.concatenate(([0.0], np.cumsum(along - line))), np.arange(len(line))
    # Over so many rows to either side, or as many as there are.
    low, high = np.maximum(place - averaged, 0), np.minimum(place + averaged + 1, len(line))
    line = middle - along_mm[0] + line + (off[high] - off[low]) / (high - low)
    ramp = np.maximum.accumulate(along_mm[:ramp_end]) - along_mm[0]
    return np.maximum.accumulate(np.r_[np.clip(ramp, 0.0, max(line[0], 0.0)), line])


def local_speed(
    time_s: np.ndarray, along_mm: np.ndarray, noise_mm: float, tolerance: float
) -> tuple[np.ndarray, int, bool]:
    """Return the speed over `half` rows to either side of each row, `half`, and whether rests may be hidden.

    `half` is wide enough for the noise. Differences are of single samples, or, where these would have to be
    more than a quarter of the stroke apart, of means of all samples to either side: then a shorter rest or
    ramp cannot be seen.
    """
    n = len(time_s)
    mean_step = abs(along_mm[-1] - along_mm[0]) / (n - 1)
    # The speed's SD is sqrt(2) noise over the width, wanted below SPEED_NOISE * tolerance of the speed.
    wanted = np.sqrt(2.0) * noise_mm / max(2.0 * SPEED_NOISE * tolerance * mean_step, 1e-300)
    most = max(n // 8, 1)
    if wanted > most:
        # Of means of `half` samples each, `half` apart, it is sqrt(2 / half) noise over `half` steps.
        half = int(min(np.ceil((2.0 * wanted) ** (2.0 / 3.0)), most))
        # Near the ends it is that of the nearest row which has so many.
        place = np.clip(np.arange(n), half, n - half)
        sums = [np.concatenate(([0.0], np.cumsum(values - values[0]))) for values in (along_mm, time_s)]
        moved, lasted = (total[place + half] - 2.0 * total[place] + total[place - half] for total in sums)
        return moved / lasted, half, True
    half = max(int(np.ceil(wanted)), 1)
    rows = np.arange(n)
    low, high = np.maximum(rows - half, 0), np.minimum(rows + half, n - 1)
    return (along_mm[high] - along_mm[low]) / (time_s[high] - time_s[low]), half, False


def acceleration(
    time_s: np.ndarray, displacement_mm: np.ndarray, noise_mm: float, wanted: float
) -> np.ndarray:
    """Return the acceleration at every row of a trace of three rows or more, shape (n,).

    It is the change from the mean speed over `half` rows before the row to that over `half` rows after it;
    near the ends, that of the nearest row with so many. `half` is as wide as the noise asks for, at most a
    sixteenth of the trace: `noise_mm` and `wanted` are the standard deviations of a displacement sample and
    of the acceleration.
    """
    n = len(time_s)
    # The SD of a second difference over `half` steps is sqrt(6) noise / (half step)^2.
    step = np.median(np.diff(time_s))
    half = np.ceil(np.sqrt(np.sqrt(6.0) * noise_mm / max(wanted, 1e-300)) / step)
    half = int(np.clip(half, 1, max(n // 16, 1)))
    at = np.clip(np.arange(n), half, n - 1 - half)
    t, x = ([values[at + shift] for shift in (-half, 0, half)] for values in (time_s, displacement_mm))
    before, after = ((x[i + 1] - x[i]) / (t[i + 1] - t[i]) for i in (0, 1))
    return 2.0 * (after - before) / (t[2] - t[0])


def first_motion(force_N: np.ndarray, since: int) -> int:
    """Return the row from which the force comes up to its level: the last one at rest, from `since` on.

    Examples
    --------
    >>> first_motion(np.r_[np.zeros(50), 30.0 * (1.0 - np.exp(-np.arange(200) / 20.0))], 0)
    51
    """
    own = force_N[since:]
    if len(own) < 8:
        return since
    begin, level = np.median(own[: max(len(own) // 100, 3)]), np.median(own)
    share = (own - begin) / (level - begin) if level != begin else np.ones(len(own))
    up = _first(share > HALF_UP)
    still = _last(share[:up] < ONSET) if up else None
    return since if still is None else since + still


def _settles(time_s: np.ndarray, along_mm: np.ndarray, noise_mm: float, tolerance: float) -> bool:
    """Return whether the speed, a parabola over time that no ripple moves, stays within the tolerance."""
    n = len(time_s)
    if n < 2 * LEAST_SAMPLES:
        return True
    share = 2.0 * (time_s - time_s[0]) / (time_s[-1] - time_s[0]) - 1.0  # from -1 to 1
    powers = np.vstack([np.ones(n), share, share**2, share**3])
    (_, *slopes), *_ = np.linalg.lstsq(powers @ powers.T, powers @ (along_mm - along_mm[0]), rcond=None)
    speed = slopes @ (powers[:3] * [[1.0], [2.0], [3.0]])
    # The SD of the slope at an end is sqrt(sum of (2k + 1) P_k'(1)^2 / n) noise = sqrt(300 / n) noise.
    error = 2.0 * np.sqrt(2.0 * 300.0 / n) * noise_mm
    return bool(np.ptp(speed) <= 2.0 * tolerance * abs(speed.mean()) + error)


def speed_along(
    time_s: np.ndarray,
    displacement_mm: np.ndarray,
    steady: np.ndarray,
    rise_mm: float,
    speed: float,
    noise_mm: float,
) -> np.ndarray:
    """Return the speed that the friction at every row of a steady window follows, shape (n,).

    It is that a rise length before: bristles follow a slow change by the length of their rise behind (Eq. 2).
    The window is cut into pieces of equal time, as many as `noise_mm` of a displacement sample allows, each
    with a slope by least squares. Where these differ clearly, the speed is straight between their middles;
    elsewhere, and where the window is short or has rests, it is `speed`, that of the stroke.
    """
    made, parts = np.full(len(time_s), speed), stretches(steady)
    if len(parts) != 1 or not abs(speed) > 0.0 or parts[0][1] - parts[0][0] < SPEED_PIECES[0] * LEAST_ROWS:
        return made
    window = slice(*parts[0])
    time_s, displacement_mm = time_s[window], displacement_mm[window]
    n, error = len(time_s), SAME_SPEED * abs(speed)
    # k slopes of n / k samples over 1/k of the time have errors of sqrt(12 k^3 / n) noise over all of it.
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
    # Neighbours that err alike (steps of a coarse sensor) count as one; a sign lasts for two of independent.
    alike = residual.size / max(2 * np.count_nonzero(np.diff(np.sign(residual), axis=1)), 1)
    variance = (residual**2).mean() * max(alike, 1.0) / square + error**2
    scatter = float(((slope - slope.mean()) ** 2 / variance).sum())
    if chdtrc(pieces - 1, scatter) > CLEAR:
        return made
    straight = np.polynomial.Polynomial.fit(middle, place.mean(axis=1), 1)
    if np.ptp(place.mean(axis=1) - straight(middle)) < DEPARTURE * np.abs(np.diff(displacement_mm, 2)).max():
        return made
    off = slope - speed
    # A whole piece further at either end, along a straight line.
    at = np.r_[2.0 * middle[0] - middle[1], middle, 2.0 * middle[-1] - middle[-2]]
    off = np.r_[2.0 * off[0] - off[1], off, 2.0 * off[-1] - off[-2]]
    made[window] += np.interp(time_s - rise_mm / abs(speed), at, off)
    return made


@dataclass(frozen=True, slots=True, eq=False)
class _StrokeMotion:
    """How one stroke moves: arrays of shape (n,); `fast` marks the band of the plateau."""

    time_s: np.ndarray
    along_mm: np.ndarray
    speed: np.ndarray
    fast: np.ndarray
    plateau: float
    half: int

    @property
    def slow(self) -> np.ndarray:
        """Rows at standstill."""
        return self.speed < STANDSTILL * self.plateau

    def moving(self, moves: np.ndarray) -> list[tuple[int, int]]:
        """Return first and last (exclusive) row of every motion, from where it is faster than a rest.

        Slow samples are a rest only if they cost more time than the width over which the speed is taken.
        """
        joined: list[tuple[int, int]] = []
        time_s, along_mm, half = self.time_s, self.along_mm, self.half
        step = np.median(np.diff(time_s))
        for first, last in stretches(moves):
            if joined:
                a, b = max(joined[-1][1] - half, 0), min(first + half, len(time_s) - 1)
                lost = (time_s[b] - time_s[a]) - (along_mm[b] - along_mm[a]) / self.plateau
                if lost <= 2.0 * half * step:
                    joined[-1] = (joined[-1][0], last)
                    continue
            joined.append((first, last))
        return [(first, last) for first, last in joined if last - first > 2 * half + 3]

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
        after = np.interp(shape, *zip(STRAIGHT, LAG, strict=True)) * ramp
        return int(time_s.searchsorted(time_s[arrived] + after)) + self.half // 3 + 1

    def stop_begin(self, first: int, last: int) -> int:
        """Return the row at which the speed leaves its plateau for good."""
        fast = _last(self.fast[first:last])
        if fast is None:
            return first
        time_s, left, end = self.time_s, first + fast, len(self.time_s) - 1
        if left == end:
            return end  # it may have stopped since the sample before
        still = _first(self.slow[left:])
        stopped = left + still if still is not None else end
        step = float(time_s[last - 1] - time_s[first]) / max(last - 1 - first, 1)
        brake = max(float(time_s[stopped] - time_s[left]) - 1.7 * self.half * step, 0.0)
        return int(time_s.searchsorted(time_s[left] - BEFORE_STOP * brake)) - self.half // 3


def _first(mask: np.ndarray) -> int | None:
    """Return the first row that is true, if any."""
    at = int(mask.argmax()) if len(mask) else 0
    return at if len(mask) and mask[at] else None


def _last(mask: np.ndarray) -> int | None:
    """Return the last row that is true, if any."""
    found = _first(mask[::-1])
    return None if found is None else len(mask) - 1 - found


def transient_rows(force_N: np.ndarray) -> int:
    """Return how many of the first rows of a steady window are a transient that the law did not reach.

    A first part whose mean is far off the parabola through later ones is left out, with the second if that is
    off, too: an effect of so short a distance could not be told from a rise or an overshoot of a few samples.
    """
    size = len(force_N) // PARTS
    if size < 1:
        return 0
    means = force_N[: size * PARTS].reshape(PARTS, size).mean(axis=1)
    powers = np.vander(np.arange(MOST_PARTS + COMPARED, dtype=float), 3)
    later = slice(MOST_PARTS, MOST_PARTS + COMPARED)
    inverse = np.linalg.pinv(powers[later])
    residual = means[: len(powers)] - powers @ (inverse @ means[later])
    spread = np.sqrt(np.sum(residual[later] ** 2) / (COMPARED - 3))
    error = spread * np.sqrt(1.0 + ((powers[:MOST_PARTS] @ inverse) ** 2).sum(axis=1))
    level, size_N = abs(float(means.mean())), np.abs(residual[:MOST_PARTS])
    off = np.any([size_N > np.maximum(k * error, share * level) for k, share in OFF], axis=0)
    return size * int(np.count_nonzero(np.logical_and.accumulate(off)))


def weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the value at which half of the weight lies at smaller ones; 0 where there is no weight.

    >>> weighted_median(np.array([5.0, 1.0, 3.0]), np.array([1.0, 1.0, 4.0]))
    3.0
    """
    order = np.argsort(values)
    covered = np.cumsum(weights[order])
    return float(values[order[covered.searchsorted(0.5 * covered[-1])]]) if covered[-1] > 0.0 else 0.0


def stretches(mask: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and the last row (exclusive) of every stretch in which `mask` is true.

    Examples
    --------
    >>> stretches(np.array([True, False, True, True]))
    [(0, 1), (2, 4)]
    """
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))
