"""The starts of strokes: from the first motion of the platform, along a ramp of speed, to steady sliding."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pandas as pd

from sealfit.fit.least_squares import levenberg_marquardt
from sealfit.ingest.stored_parts import noise_from_bends, stroke_index, strokes_of

# Starting values of the length of a ramp, in time steps.
RAMPS = np.geomspace(0.5, 200.0, 12)
# Rows of strokes are padded to a multiple of this, so that sums do not depend on the strokes fitted together.
PADDED = 64
# Largest number of rows fitted together.
TOGETHER = 16_384
# Bound of |ln(length of a ramp in s)|.
LONGEST = 50.0


@dataclass(frozen=True)
class Ramp:
    """The motion along a fitted ramp, at the fitted rows."""

    distance_mm: np.ndarray  # (n,)
    speed_mm_s: np.ndarray  # (n,)
    final_mm_s: float  # speed after the ramp
    rms_mm: float  # RMS residual of the displacement


@dataclass(frozen=True)
class _PaddedRows:
    """Padded rows of strokes: time, displacement minus its mean, and mask, shape (strokes, rows) each."""

    time: np.ndarray
    along: np.ndarray
    there: np.ndarray

    def some(self, strokes: np.ndarray) -> "_PaddedRows":
        return _PaddedRows(self.time[strokes], self.along[strokes], self.there[strokes])

    def centred(self, values: np.ndarray) -> np.ndarray:
        """Return values minus their stroke's mean, 0 in padding."""
        mean = np.einsum("kr,kr->k", values, self.there) / self.there.sum(axis=1)
        return (values - mean[:, None]) * self.there


def fit_ramps(
    times_s: Sequence[np.ndarray], alongs_mm: Sequence[np.ndarray], paces_mm_s: Sequence[float]
) -> list[Ramp]:
    """Return the motion of platforms along a linear ramp or a first-order lag, whichever fits better.

    The two parameters of a ramp, beginning and length, use all samples; a local speed is too noisy. Position
    and final speed, near `paces_mm_s`, are solved for exactly (variable projection: Kaufman 1975, BIT 15,
    49-57, doi:10.1007/BF01932995). Displacements are positive along the motion.
    """
    made: list[Ramp | None] = [None] * len(times_s)
    of_length: dict[int, list[int]] = {}
    for k, time in enumerate(times_s):
        of_length.setdefault(-(-len(time) // PADDED) * PADDED, []).append(k)
    for rows, members in of_length.items():
        size = max(TOGETHER // rows, 1)
        for group in (members[i : i + size] for i in range(0, len(members), size)):
            own = ([values[k] for k in group] for values in (times_s, alongs_mm, paces_mm_s))
            for k, ramp in zip(group, _fit_some(*own, rows), strict=True):
                made[k] = ramp
    return made


def _fit_some(
    times_s: Sequence[np.ndarray], alongs_mm: Sequence[np.ndarray], paces_mm_s: Sequence[float], rows: int
) -> list[Ramp]:
    """Return `fit_ramps` of strokes padded to a number of rows."""
    sizes = np.array([len(time) for time in times_s])
    there = np.arange(rows) < sizes[:, None]
    time, along = np.zeros(there.shape), np.zeros(there.shape)
    time[there], along[there] = np.concatenate(times_s), np.concatenate(alongs_mm)
    step = np.array([np.median(np.diff(time)) for time in times_s])
    # Time at which a start at full speed would have given the same displacement.
    each, last = np.arange(len(sizes)), sizes - 1
    lagged = time[each, last] - (along[each, last] - along[:, 0]) / paces_mm_s
    padded = _PaddedRows(time, along, there)
    padded = replace(padded, along=padded.centred(along))
    fits = [_fit_shape(padded, *shape, lagged, step) for shape in ((_straight, 0.5), (_lagging, 1.0))]
    distance, rate, speed, squares = (np.stack(both) for both in zip(*fits, strict=True))
    best = np.argmin(squares, axis=0)
    rms = np.sqrt(squares[best, each] / sizes)
    ramps = []
    for k, (b, n) in enumerate(zip(best.tolist(), sizes.tolist(), strict=True)):
        moved = speed[b, k] * distance[b, k, :n], speed[b, k] * rate[b, k, :n]
        ramps.append(Ramp(*moved, float(speed[b, k]), float(rms[k])))
    return ramps


Shape = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _fit_shape(
    rows: _PaddedRows, shape: Shape, lag: float, lagged: np.ndarray, step: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return distance and speed of the best ramps to a speed of 1, that speed, and the sums of squares."""
    grid = [np.stack([lagged - lag * ramp * step, np.log(ramp * step)], axis=1) for ramp in RAMPS]
    squares = [_solved(rows, rows.centred(_moved(rows, shape, at)[0]))[2] for at in grid]
    at = np.choose(np.argmin(squares, axis=0)[:, None], grid)

    def evaluate(at: np.ndarray, strokes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        own = rows.some(strokes)
        distance, rate, by_ramp = _moved(own, shape, at)
        distance = own.centred(distance)
        speed, residual, _ = _solved(own, distance)
        # residual = along - speed * distance(time - at[0], ramp), with position and speed projected out
        slopes = speed[:, None, None] * np.stack([own.centred(rate), -own.centred(by_ramp)], axis=1)
        square = np.einsum("kr,kr->k", distance, distance)
        shared = np.einsum("kir,kr->ki", slopes, distance) / np.maximum(square, 1e-300)[:, None]
        return residual, slopes - shared[..., None] * distance[:, None]

    ends = np.array([np.inf, LONGEST])
    at, _ = levenberg_marquardt(evaluate, at, -ends, ends)
    distance, rate, _ = _moved(rows, shape, at)
    speed, _, squares = _solved(rows, rows.centred(distance))
    return distance, rate, speed, squares


def _moved(rows: _PaddedRows, shape: Shape, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return shape(rows.time - at[:, :1], np.exp(at[:, 1:]))


def _solved(rows: _PaddedRows, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the slope of the displacement on a centred distance, the residual, and its sum of squares."""
    square = np.einsum("kr,kr->k", distance, distance)
    slope = np.einsum("kr,kr->k", distance, rows.along) / np.maximum(square, 1e-300)
    residual = rows.along - slope[:, None] * distance
    return slope, residual, np.einsum("kr,kr->k", residual, residual)


def _straight(since: np.ndarray, ramp: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distance, speed and d distance / d log ramp, for a speed that rises linearly to 1."""
    share = np.clip(since / ramp, 0.0, 1.0)
    lag = 0.5 * ramp * share**2
    return np.where(since < ramp, lag, since - 0.5 * ramp), share, -lag


def _lagging(since: np.ndarray, ramp: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distance, speed and d distance / d log ramp, for a speed approaching 1 by a first-order lag."""
    since = np.maximum(since, 0.0)
    decay = np.exp(-since / ramp)
    return since - ramp * (1 - decay), 1 - decay, since * decay - ramp * (1 - decay)


# A platform is at rest below this share of the steady speed.
STANDSTILL = 0.05
# Largest standard deviation of the local speed, as a share of the steady speed.
ROUGH = 0.1
# A ramp is accepted if its RMS residual is at most this multiple of the noise.
AS_NOISE = 1.2
# Noise below this share of the displacement is rounding; the local speed is then exact.
ROUNDING = 1e-13
# Share of the steady window in which the force at the beginning of sliding is fitted.
JUST_BEGUN = 0.1
# Smallest number of rows of a start.
LEAST = 4


class Sliding(NamedTuple):
    """A straight line through the force at the beginning of steady sliding, before much warming or wear."""

    force_N: float  # mean
    distance_mm: float  # mean distance slid
    slope_N_mm: float
    rows: int  # number of samples
    extent_mm: float  # square root of the sum of squared deviations from `distance_mm`


@dataclass(frozen=True)
class StrokePart:
    """The start of one stroke, with smoothed displacement, or all of it; positive in its direction."""

    row: int  # in table `steady`
    distance_mm: np.ndarray  # (n,) distance slid, not decreasing
    force_N: np.ndarray  # (n,)
    sliding: Sliding  # force at the beginning of steady sliding
    speed_mm_s: np.ndarray | None = None  # (n,) rate of the distance of a start


@dataclass(frozen=True)
class Along:
    """A stroke with a steady window; displacement and force are positive in its direction."""

    row: int  # in table `steady`
    pace_mm_s: float  # steady speed
    time_s: np.ndarray  # (n,)
    along_mm: np.ndarray  # (n,) displacement
    force_N: np.ndarray  # (n,)
    steady: np.ndarray  # (n,) bool: mask of the steady window

    @cached_property
    def until(self) -> int:
        """The first row of steady sliding."""
        return int(self.steady.argmax())

    @cached_property
    def noise_mm(self) -> float:
        """Standard deviation of the displacement's noise."""
        return noise_from_bends(np.diff(self.along_mm, 2))

    @property
    def noisy(self) -> bool:
        """Whether the displacement has noise above rounding."""
        return self.noise_mm > ROUNDING * float(np.abs(self.along_mm[[0, -1]]).max())


def strokes_along(traces: pd.DataFrame, steady: pd.DataFrame) -> list[Along]:
    """Return all strokes with a steady window that begin at rest or at a turn.

    A steady speed or a turn in the midst of a motion does not: its time counts from an earlier row.
    """
    edges, own = strokes_of(traces, stroke_index(steady))
    time, along, force = (traces[name].to_numpy(float) for name in ("time_s", "displacement_mm", "force_N"))
    sliding, sign = traces["steady"].to_numpy(bool), steady["direction"].to_numpy().tolist()
    pace = np.abs(steady["speed_mm_s"].to_numpy(float)).tolist()
    file = traces["file"].iloc[edges[:-1]].to_numpy()
    later = np.r_[False, file[1:] == file[:-1]] & (time[edges[:-1]] > 0.0)
    own[later] = -1
    made = []
    for begin, end, row in zip(edges[:-1].tolist(), edges[1:].tolist(), own.tolist(), strict=True):
        part = slice(begin, end)
        if row >= 0 and sliding[part].any():
            signed = sign[row] * along[part], sign[row] * force[part]
            made.append(Along(row, pace[row], time[part], *signed, sliding[part]))
    return made


def starts_of(strokes: Sequence[Along]) -> list[StrokePart]:
    """Return the start of every stroke that has one; a record that begins in steady sliding has none."""
    strokes = [stroke for stroke in strokes if stroke.until >= LEAST]
    noisy = [stroke for stroke in strokes if stroke.noisy]
    # Rows up to steady sliding, and as many after.
    begun = [(s.time_s[: 2 * s.until], s.along_mm[: 2 * s.until], s.pace_mm_s) for s in noisy]
    ramps = fit_ramps(*zip(*begun, strict=True)) if begun else []
    ramp_of = dict(zip((stroke.row for stroke in noisy), ramps, strict=True))
    made = (_begun(stroke, ramp_of.get(stroke.row)) for stroke in strokes)
    return [start for start in made if start is not None]


def whole_strokes(strokes: Sequence[Along]) -> list[StrokePart]:
    """Return every stroke from first row to last; its sliding force is the mean of its steady window."""
    made = []
    for stroke in strokes:
        distance = np.maximum.accumulate(stroke.along_mm - stroke.along_mm[0])
        if len(distance) >= LEAST and distance[-1] > 0.0:
            force, middle = stroke.force_N[stroke.steady], distance[stroke.steady]
            mean = Sliding(float(force.mean()), float(middle.mean()), 0.0, len(force), math.inf)
            made.append(StrokePart(stroke.row, distance, stroke.force_N, mean))
    return made


def _begun(stroke: Along, ramp: Ramp | None) -> StrokePart | None:
    """Return the start of a stroke from its first motion, along its ramp if that fits; None if too short."""
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
    slid, force = stroke.along_mm[after] - stroke.along_mm[since], stroke.force_N[after]
    away = slid - slid.mean()
    square = float(away @ away)
    slope = float(away @ force) / max(square, 1e-300)
    line = Sliding(float(force.mean()), float(slid.mean()), slope, len(force), math.sqrt(square))
    return StrokePart(stroke.row, distance, stroke.force_N[since:until], line, speed[since:until])


def _smoothed(stroke: Along) -> tuple[np.ndarray, np.ndarray]:
    """Return distance and speed up to steady sliding, smoothed over a width that depends on the noise.

    Savitzky and Golay 1964, Anal. Chem. 36(8), 1627-1639, doi:10.1021/ac60214a047; of second order.
    """
    half = _half_width(stroke) if stroke.noisy else 1
    rows = slice(0, stroke.until + half + 1)  # all rows that the filter needs
    along, time = stroke.along_mm[rows], stroke.time_s[rows]
    if half == 1:
        smooth, rate = along, np.gradient(along)
    else:
        from scipy.signal import savgol_filter  # imported here: scipy.signal takes half a second to load

        width = 2 * half + 1
        smooth, rate = (savgol_filter(along, width, 2, deriv=k, mode="nearest") for k in (0, 1))
    return smooth, np.maximum(rate / np.gradient(time), 0.0)


def _half_width(stroke: Along) -> int:
    """Return the filter's half-width in rows that gives the local speed to `ROUGH` of the steady speed."""
    step = stroke.pace_mm_s * np.median(np.diff(stroke.time_s))
    half = np.arange(1, max(2, len(stroke.time_s) // 16))
    enough = stroke.noise_mm * np.sqrt(3.0 / (half * (half + 1) * (2 * half + 1))) <= ROUGH * step
    return int(half[enough.argmax()] if enough.any() else half[-1])
