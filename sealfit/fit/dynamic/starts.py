"""The beginnings of strokes: from where the platform begins to move, along a ramp, to where it slides steadily."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd

from sealfit.fit.least_squares import levenberg_marquardt
from sealfit.ingest.segments import median
from sealfit.ingest.stored_parts import noise_from_bends, stroke_index, strokes_of

# ---------------------------------------------------------------- ramps
# The motion of platforms that start along a ramp of two numbers, fitted to many strokes together.

# Steps in time that a ramp may take, to begin with.
RAMPS = np.geomspace(0.5, 200.0, 12)

# The rows of every stroke are padded to a multiple of this, so that its sums do not depend on which strokes are fitted
# together.
PADDED = 64

# Rows of strokes that are fitted together, at most.
TOGETHER = 16_384

# The logarithm of a ramp's length in s stays within this of 0.
LONGEST = 50.0


@dataclass(frozen=True)
class Ramp:
    """The motion along a fitted ramp, up to the last row that it was fitted to.

    Attributes
    ----------
    distance_mm, speed_mm_s : ndarray, shape (n,)
        Distance and speed.
    final_mm_s : float
        Speed that it comes to.
    rms_mm : float
        What the fit leaves of the displacement.
    """

    distance_mm: np.ndarray
    speed_mm_s: np.ndarray
    final_mm_s: float
    rms_mm: float


@dataclass(frozen=True)
class _Rows:
    """The rows of strokes, padded: time, displacement about its mean, and where there is a row, (strokes, rows)."""

    time: np.ndarray
    along: np.ndarray
    there: np.ndarray

    @classmethod
    def of(cls, time: np.ndarray, along: np.ndarray, there: np.ndarray) -> _Rows:
        return cls(time, cls(time, along, there).centred(along), there)

    def some(self, strokes: np.ndarray) -> _Rows:
        return _Rows(self.time[strokes], self.along[strokes], self.there[strokes])

    def centred(self, values: np.ndarray) -> np.ndarray:
        """Return values about their stroke's mean, 0 where there is no row."""
        mean = np.einsum("kr,kr->k", values, self.there) / self.there.sum(axis=1)
        return (values - mean[:, None]) * self.there


def fit_ramps(
    times_s: Sequence[np.ndarray], alongs_mm: Sequence[np.ndarray], paces_mm_s: Sequence[float]
) -> list[Ramp]:
    """Return the motion of platforms that start along a straight or a lagging ramp, whichever is closer.

    Noise of the displacement makes a local speed of little use where the speed changes most; a ramp of two numbers,
    its beginning and its length, does not care. Place and final speed are linear and solved for exactly (variable
    projection: Kaufman 1975, BIT 15, 49-57, doi:10.1007/BF01932995), the other two by Levenberg-Marquardt from the best
    of a grid of lengths.

    Parameters
    ----------
    times_s, alongs_mm : sequence of ndarray, shape (n,) each
        Time and displacement of every stroke, counted along its motion.
    paces_mm_s : sequence of float
        About how fast it is in the end.
    """
    made: list[Ramp | None] = [None] * len(times_s)
    alike: dict[int, list[int]] = {}
    for k, time in enumerate(times_s):
        alike.setdefault(-(-len(time) // PADDED) * PADDED, []).append(k)
    for rows, members in alike.items():
        size = max(TOGETHER // rows, 1)
        for group in (members[i : i + size] for i in range(0, len(members), size)):
            fitted = _fit_some(*([values[k] for k in group] for values in (times_s, alongs_mm, paces_mm_s)), rows)
            for k, ramp in zip(group, fitted, strict=True):
                made[k] = ramp
    return made


def _fit_some(
    times_s: Sequence[np.ndarray], alongs_mm: Sequence[np.ndarray], paces_mm_s: Sequence[float], rows: int
) -> list[Ramp]:
    """Return `fit_ramps` of strokes that are padded to that number of rows."""
    sizes = np.array([len(time) for time in times_s])
    there = np.arange(rows) < sizes[:, None]
    time, along = np.zeros(there.shape), np.zeros(there.shape)
    time[there], along[there] = np.concatenate(times_s), np.concatenate(alongs_mm)
    step = np.array([median(np.diff(time)) for time in times_s])
    # When it would have started at full speed.
    each, last = np.arange(len(sizes)), sizes - 1
    lagged = time[each, last] - (along[each, last] - along[:, 0]) / paces_mm_s
    padded = _Rows.of(time, along, there)
    fits = [_fit_shape(padded, shape, lagged, lag, step) for shape, lag in ((_straight, 0.5), (_lagging, 1.0))]
    distance, rate, speed, squares = (np.stack(both) for both in zip(*fits, strict=True))
    best = np.argmin(squares, axis=0)
    rms = np.sqrt(squares[best, each] / sizes)
    return [
        Ramp(speed[b, k] * distance[b, k, :n], speed[b, k] * rate[b, k, :n], float(speed[b, k]), float(rms[k]))
        for k, (b, n) in enumerate(zip(best.tolist(), sizes.tolist(), strict=True))
    ]


Shape = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _fit_shape(rows: _Rows, shape: Shape, lagged: np.ndarray, lag: float, step: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the ramps of one shape that fit best: distance and speed where it comes to 1, (strokes, rows) each, the
    speed that it does come to, and the sum of squares, (strokes,) each."""
    grid = [np.stack([lagged - lag * ramp * step, np.log(ramp * step)], axis=1) for ramp in RAMPS]
    squares = [_solved(rows, rows.centred(_moved(rows, shape, at)[0]))[2] for at in grid]
    at = np.choose(np.argmin(squares, axis=0)[:, None], grid)

    def evaluate(at: np.ndarray, strokes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        own = rows.some(strokes)
        distance, rate, by_ramp = _moved(own, shape, at)
        distance = own.centred(distance)
        speed, residual, _ = _solved(own, distance)
        # residual = along - speed * distance(time - at[0], ramp): its slopes, free of what place and speed take up
        slopes = speed[:, None, None] * np.stack([own.centred(rate), -own.centred(by_ramp)], axis=1)
        square = np.einsum("kr,kr->k", distance, distance)
        shared = np.einsum("kir,kr->ki", slopes, distance) / np.maximum(square, 1e-300)[:, None]
        return residual, slopes - shared[..., None] * distance[:, None]

    ends = np.array([np.inf, LONGEST])
    at, _ = levenberg_marquardt(evaluate, at, -ends, ends)
    distance, rate, _ = _moved(rows, shape, at)
    speed, _, squares = _solved(rows, rows.centred(distance))
    return distance, rate, speed, squares


def _moved(rows: _Rows, shape: Shape, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return shape(rows.time - at[:, :1], np.exp(at[:, 1:]))


def _solved(rows: _Rows, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the slope of the displacement on a centred distance, what it leaves, and the sum of squares of that."""
    square = np.einsum("kr,kr->k", distance, distance)
    slope = np.einsum("kr,kr->k", distance, rows.along) / np.maximum(square, 1e-300)
    residual = rows.along - slope[:, None] * distance
    return slope, residual, np.einsum("kr,kr->k", residual, residual)


def _straight(since: np.ndarray, ramp: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distance, speed and d distance / d log ramp, for a speed that rises to 1 along a straight line."""
    share = np.clip(since / ramp, 0.0, 1.0)
    lag = 0.5 * ramp * share**2
    return np.where(since < ramp, lag, since - 0.5 * ramp), share, -lag


def _lagging(since: np.ndarray, ramp: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distance, speed and d distance / d log ramp, for a speed of 1 approached as by a first-order lag."""
    since = np.maximum(since, 0.0)
    left = np.exp(-since / ramp)
    return since - ramp * (1 - left), 1 - left, since * left - ramp * (1 - left)


# ---------------------------------------------------------------- starts
# The beginnings of strokes: from where the platform begins to move to where it slides steadily.

STANDSTILL = 0.05  # slower than this share of the steady speed: not moving yet
ROUGH = 0.1  # wanted noise of the local speed, as a share of the steady speed
AS_NOISE = 1.2  # times the noise: what a ramp may leave that is that of the platform
ROUNDING = 1e-13  # of the displacement: less noise is none, and a local speed says all
JUST_BEGUN = 0.1  # of the steady window: what sliding is like at its beginning
LEAST = 4  # rows below which a beginning shows nothing


@dataclass(frozen=True)
class Sliding:
    """The force where steady sliding has just begun, as a line: further on, warming or wear may change it otherwise.

    Attributes
    ----------
    force_N, distance_mm, slope_N_mm : float
        Mean force, the distance slid there, and how the force changes along it.
    rows : int
        Samples that it rests on.
    extent_mm : float
        Root of the sum of their squared distances from `distance_mm`.
    """

    force_N: float
    distance_mm: float
    slope_N_mm: float
    rows: int
    extent_mm: float

    @classmethod
    def of(cls, distance_mm: np.ndarray, force_N: np.ndarray) -> Sliding:
        """Return the line through samples, shape (n,) each."""
        rows = len(force_N)
        middle = float(np.add.reduce(distance_mm)) / rows
        away = distance_mm - middle
        square = float(away @ away)
        slope = float(away @ force_N) / max(square, 1e-300)
        return cls(float(np.add.reduce(force_N)) / rows, middle, slope, rows, math.sqrt(square))


@dataclass(frozen=True)
class Part:
    """A part of one stroke, its motion and force positive along it.

    Attributes
    ----------
    row : int
        Its row in table `steady`.
    distance_mm, force_N : ndarray, shape (n,)
        Distance slid, never falling, and the force.
    sliding : Sliding
        What it comes to.
    """

    row: int
    distance_mm: np.ndarray
    force_N: np.ndarray
    sliding: Sliding


@dataclass(frozen=True)
class Start(Part):
    """The beginning of one stroke, the noise of its displacement smoothed away.

    Attributes
    ----------
    speed_mm_s : ndarray, shape (n,)
        Rate of the distance.
    """

    speed_mm_s: np.ndarray


@dataclass(frozen=True)
class Along:
    """A stroke that slides steadily somewhere, counted along its motion.

    Attributes
    ----------
    row : int
        Its row in table `steady`.
    pace_mm_s : float
        How fast it slides.
    time_s, along_mm, force_N : ndarray, shape (n,)
        Time, displacement and force.
    steady : ndarray of bool, shape (n,)
        Where it slides steadily.
    """

    row: int
    pace_mm_s: float
    time_s: np.ndarray
    along_mm: np.ndarray
    force_N: np.ndarray
    steady: np.ndarray

    @cached_property
    def until(self) -> int:
        """The first row of steady sliding."""
        return int(self.steady.argmax())

    @cached_property
    def noise_mm(self) -> float:
        """Noise of the displacement."""
        return noise_from_bends(np.diff(self.along_mm, 2))

    @property
    def noisy(self) -> bool:
        """Whether the displacement has noise at all."""
        return self.noise_mm > ROUNDING * float(np.abs(self.along_mm[[0, -1]]).max())


def strokes_along(traces: pd.DataFrame, steady: pd.DataFrame) -> list[Along]:
    """Return every stroke that slides steadily somewhere.

    Parameters
    ----------
    traces : DataFrame
        Table `traces`, the samples of a stroke one after the other.
    steady : DataFrame
        Table `steady`: the strokes.
    """
    edges, own = strokes_of(traces, stroke_index(steady))
    time, along, force = (traces[name].to_numpy(float) for name in ("time_s", "displacement_mm", "force_N"))
    sliding, sign = traces["steady"].to_numpy(bool), steady["direction"].to_numpy().tolist()
    pace = np.abs(steady["speed_mm_s"].to_numpy(float)).tolist()
    made = []
    for begin, end, row in zip(edges[:-1].tolist(), edges[1:].tolist(), own.tolist(), strict=True):
        part = slice(begin, end)
        if row >= 0 and sliding[part].any():
            made.append(
                Along(row, pace[row], time[part], sign[row] * along[part], sign[row] * force[part], sliding[part])
            )
    return made


def starts_of(strokes: Sequence[Along]) -> list[Start]:
    """Return the beginning of every stroke that has one; a stroke whose rows begin in steady sliding has none."""
    strokes = [stroke for stroke in strokes if stroke.until >= LEAST]
    noisy = [stroke for stroke in strokes if stroke.noisy]
    rows = [slice(0, 2 * stroke.until) for stroke in noisy]  # up to steady sliding, and as many after
    ramps = fit_ramps(
        [stroke.time_s[own] for stroke, own in zip(noisy, rows, strict=True)],
        [stroke.along_mm[own] for stroke, own in zip(noisy, rows, strict=True)],
        [stroke.pace_mm_s for stroke in noisy],
    )
    ramp_of = dict(zip((stroke.row for stroke in noisy), ramps, strict=True))
    made = (_begun(stroke, ramp_of.get(stroke.row)) for stroke in strokes)
    return [start for start in made if start is not None]


def whole_strokes(strokes: Sequence[Along]) -> list[Part]:
    """Return every stroke from its first row to its last, the sliding force being the mean of its steady window."""
    made = []
    for stroke in strokes:
        distance = np.maximum.accumulate(stroke.along_mm - stroke.along_mm[0])
        if len(distance) >= LEAST and distance[-1] > 0.0:
            steady = stroke.steady
            rows = int(np.count_nonzero(steady))
            force, middle = (float(np.add.reduce(values[steady])) / rows for values in (stroke.force_N, distance))
            made.append(Part(stroke.row, distance, stroke.force_N, Sliding(force, middle, 0.0, rows, math.inf)))
    return made


def _begun(stroke: Along, ramp: Ramp | None) -> Start | None:
    """Return the beginning of a stroke from where it moves, along its ramp if it has one; None where too short."""
    until, pace = stroke.until, stroke.pace_mm_s
    on_ramp = ramp is not None and ramp.rms_mm <= AS_NOISE * stroke.noise_mm and ramp.final_mm_s > 0.0
    smooth, speed = (ramp.distance_mm, ramp.speed_mm_s) if on_ramp else _smoothed(stroke)
    still = np.flatnonzero(speed[:until] < STANDSTILL * pace)
    since = int(still[-1]) if len(still) else 0
    distance = np.maximum.accumulate(smooth[since:until] - smooth[since])
    if until - since < LEAST or not distance[-1] > 0.0:
        return None
    after = np.flatnonzero(stroke.steady)
    after = after[: max(LEAST, int(JUST_BEGUN * len(after)))]
    line = Sliding.of(stroke.along_mm[after] - stroke.along_mm[since], stroke.force_N[after])
    return Start(stroke.row, distance, stroke.force_N[since:until], line, speed[since:until])


def _smoothed(stroke: Along) -> tuple[np.ndarray, np.ndarray]:
    """Return distance and speed up to steady sliding, by a parabola through as many rows to either side as the noise
    asks for.

    Beyond the ends lie the first and the last displacement (Savitzky and Golay 1964, Anal. Chem. 36(8), 1627-1639,
    doi:10.1021/ac60214a047).
    """
    half = _half_width(stroke) if stroke.noisy else 1
    rows = slice(0, stroke.until + half + 1)  # all that the rows before steady sliding see
    along, time = stroke.along_mm[rows], stroke.time_s[rows]
    if half == 1:
        smooth, rate = along, np.gradient(along)
    else:
        padded = np.pad(along, half, mode="edge")
        away = np.arange(-half, half + 1)
        square = half * (half + 1) * (2 * half + 1) / 3
        weight = (3 * half**2 + 3 * half - 1 - 5 * away**2) * 3 / ((2 * half - 1) * (2 * half + 1) * (2 * half + 3))
        smooth, rate = np.correlate(padded, weight, "valid"), np.correlate(padded, away / square, "valid")
    return smooth, np.maximum(rate / np.gradient(time), 0.0)


def _half_width(stroke: Along) -> int:
    """Return the rows to either side over which a parabola gives the local speed to `ROUGH` of the steady one."""
    step = stroke.pace_mm_s * median(np.diff(stroke.time_s))
    half = np.arange(1, max(2, len(stroke.time_s) // 16))
    enough = stroke.noise_mm * np.sqrt(3.0 / (half * (half + 1) * (2 * half + 1))) <= ROUGH * step
    return int(half[enough.argmax()] if enough.any() else half[-1])
