"""The beginnings of strokes: from where the platform begins to move to where it slides steadily."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from sealfit.samples import noise_from_bends, strokes_of

STANDSTILL = 0.05  # slower than this share of the steady speed: not moving yet
ROUGH = 0.1  # wanted noise of the local speed, as a share of the steady speed
RAMPS = np.geomspace(0.5, 200.0, 12)  # steps in time that a ramp may take, to begin with
AS_NOISE = 1.2  # times the noise: what a ramp may leave that is that of the platform
MOST_CELLS = 200  # of the distance over which starts are averaged
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
        slope, _ = _linear(force_N, distance_mm)
        extent = float(np.linalg.norm(distance_mm - distance_mm.mean()))
        return cls(float(force_N.mean()), float(distance_mm.mean()), slope, len(force_N), extent)

    def at(self, distance_mm: np.ndarray) -> np.ndarray:
        """Return the force that sliding would have had at a distance, in N."""
        return self.force_N + self.slope_N_mm * (distance_mm - self.distance_mm)

    def error(self, distance_mm: np.ndarray) -> np.ndarray:
        """Return the standard error of that, in standard deviations of a sample."""
        away = (distance_mm - self.distance_mm) / max(self.extent_mm, 1e-300)
        return np.sqrt(1 / self.rows + away**2)


@dataclass(frozen=True)
class Start:
    """The beginning of one stroke, its motion and force positive along it.

    Attributes
    ----------
    row : int
        Its row in table `steady`.
    distance_mm, speed_mm_s, force_N : ndarray, shape (n,)
        Distance slid, smoothed over the noise of the displacement, its rate, and the force.
    sliding : Sliding
        What it comes to.
    """

    row: int
    distance_mm: np.ndarray
    speed_mm_s: np.ndarray
    force_N: np.ndarray
    sliding: Sliding


def starts_of(traces: pd.DataFrame, steady: pd.DataFrame) -> Iterator[Start]:
    """Yield the beginning of every stroke that has one; a stroke whose rows begin in steady sliding has none.

    Parameters
    ----------
    traces : DataFrame
        Table `traces`, the samples of a stroke one after the other.
    steady : DataFrame
        Table `steady`: the strokes.
    """
    pace = np.abs(steady["speed_mm_s"].to_numpy(float))
    for row, time, along, force, sliding in _along_motion(traces, steady):
        until = int(np.argmax(sliding))
        after = np.flatnonzero(sliding)[: max(LEAST, int(JUST_BEGUN * sliding.sum()))]
        found = _begun(time, along, pace[row], until)
        if found is not None:
            since, distance, speed = found
            line = Sliding.of(along[after] - along[since], force[after])
            yield Start(row, distance, speed, force[since:until], line)


def whole_strokes(traces: pd.DataFrame, steady: pd.DataFrame) -> Iterator[Start]:
    """Yield every stroke from its first row to its last, the sliding force being the mean of its steady window.

    Parameters
    ----------
    traces, steady : DataFrame
        As for `starts_of`.
    """
    for row, time, along, force, sliding in _along_motion(traces, steady):
        distance = np.maximum.accumulate(along - along[0])
        if len(along) >= LEAST and distance[-1] > 0.0:
            middle = float(distance[sliding].mean())
            level = Sliding(float(force[sliding].mean()), middle, 0.0, int(sliding.sum()), np.inf)
            yield Start(row, distance, np.gradient(distance, time), force, level)


def _along_motion(traces: pd.DataFrame, steady: pd.DataFrame) -> Iterator[tuple[int, np.ndarray, ...]]:
    """Yield each stroke that slides steadily somewhere: its row in `steady`, and shape (n,) each the time, displacement
    and force counted along its motion, and whether it slides steadily."""
    edges, own = strokes_of(traces, steady)
    time, along, force = (traces[name].to_numpy(float) for name in ("time_s", "displacement_mm", "force_N"))
    sliding, sign = traces["steady"].to_numpy(bool), steady["direction"].to_numpy()
    for begin, end, row in zip(edges[:-1].tolist(), edges[1:].tolist(), own.tolist(), strict=True):
        part = slice(begin, end)
        if row >= 0 and sliding[part].any():
            yield row, time[part], sign[row] * along[part], sign[row] * force[part], sliding[part]


def cell_means(starts: Sequence[Start], values: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles of cells of distance, shape (cells,), and each start's mean in each, shape (starts, cells).

    The cells reach as far as half of the starts do and are as many as such a start has samples, MOST_CELLS at most; a
    mean is NaN where a start has no sample.

    Parameters
    ----------
    starts : sequence of Start
        Starts at one speed.
    values : sequence of ndarray, shape (n,) each
        What is averaged, a number per sample of each start.
    """
    reach = float(np.median([s.distance_mm[-1] for s in starts]))
    count = int(np.clip(np.median([s.force_N.size for s in starts]), LEAST, MOST_CELLS))
    means = np.full((len(starts), count), np.nan)
    for k, (start, value) in enumerate(zip(starts, values, strict=True)):
        cell = (start.distance_mm / reach * count).astype(int)
        cell, value = cell[cell < count], value[cell < count]
        hits = np.bincount(cell, minlength=count)
        means[k, hits > 0] = np.bincount(cell, value, minlength=count)[hits > 0] / hits[hits > 0]
    return (np.arange(count) + 0.5) * reach / count, means


def _begun(
    time_s: np.ndarray, along_mm: np.ndarray, pace: float, until: int
) -> tuple[int, np.ndarray, np.ndarray] | None:
    """Return the row from which a stroke moves, and distance and speed from there to `until`; None where too short."""
    if until < LEAST:
        return None
    smooth, speed = _motion(time_s, along_mm, pace, until) or _smoothed(time_s, along_mm, pace)
    still = np.flatnonzero(speed[:until] < STANDSTILL * pace)
    since = int(still[-1]) if len(still) else 0
    distance = np.maximum.accumulate(smooth[since:until] - smooth[since])
    return (since, distance, speed[since:until]) if until - since >= LEAST and distance[-1] > 0.0 else None


def _motion(time_s: np.ndarray, along_mm: np.ndarray, pace: float, until: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Return distance and speed of a platform that starts along a straight or a lagging ramp; None if it did not.

    Noise of the displacement makes a local speed of little use where the speed changes most; a ramp of two numbers,
    fitted to the rows up to steady sliding and as many after, does not care.
    """
    rows = slice(0, min(2 * until, len(time_s)))
    time, along = time_s[rows], along_mm[rows]
    step = float(np.median(np.diff(time)))
    lagged = time[-1] - (along[-1] - along[0]) / pace  # when it would have started at full speed
    fits = []
    for shape, lag in ((_straight, 0.5), (_lagging, 1.0)):

        def motion(at, shape=shape):
            return shape(time - at[0], np.exp(np.clip(at[1], -50.0, 50.0)))

        def left(at, motion=motion):
            return along - _linear(along, motion(at)[0])[1]

        def slope(at, motion=motion):  # of variable projection: Kaufman 1975, BIT 15, 49-57, doi:10.1007/BF01932995
            distance, rate, by_ramp = motion(at)
            speed = _linear(along, distance)[0]
            return np.column_stack([_linear(own, distance)[1] - own for own in (-speed * rate, speed * by_ramp)])

        grid = [(lagged - lag * ramp, np.log(ramp)) for ramp in step * RAMPS]
        start = min(grid, key=lambda at: float((left(at) ** 2).sum()))
        fits.append((least_squares(left, start, slope, method="lm", x_scale=[step, 1.0], max_nfev=100), shape))
    found, shape = min(fits, key=lambda fit: fit[0].cost)
    distance, rate, _ = shape(time_s - found.x[0], np.exp(found.x[1]))
    speed = _linear(along, distance[rows])[0]
    if np.sqrt(2 * found.cost / time.size) > AS_NOISE * noise_from_bends(np.diff(along_mm, 2)) or not speed > 0.0:
        return None
    return speed * distance, speed * rate


def _linear(values: np.ndarray, shape: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the slope of values on a shape, and the straight line through them, shape (n,)."""
    centred = shape - shape.mean()
    slope = float(centred @ values / max(centred @ centred, 1e-300))
    return slope, values.mean() + slope * centred


def _straight(since: np.ndarray, ramp: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distance, speed and d distance / d log ramp, for a speed that rises to 1 along a straight line."""
    share = np.clip(since / ramp, 0.0, 1.0)
    lag = 0.5 * ramp * share**2
    return np.where(since < ramp, lag, since - 0.5 * ramp), share, -lag


def _lagging(since: np.ndarray, ramp: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distance, speed and d distance / d log ramp, for a speed of 1 approached as by a first-order lag."""
    since = np.maximum(since, 0.0)
    left = np.exp(-since / ramp)
    return since - ramp * (1 - left), 1 - left, since * left - ramp * (1 - left)


def _smoothed(time_s: np.ndarray, along_mm: np.ndarray, pace: float) -> tuple[np.ndarray, np.ndarray]:
    """Return distance and speed by a parabola through as many rows to either side as the noise asks for."""
    rows, half = np.arange(len(time_s)), _half_width(time_s, along_mm, pace)
    if half == 1:
        smooth, rate = along_mm, np.gradient(along_mm, rows)
    else:
        smooth, rate = (savgol_filter(along_mm, 2 * half + 1, 2, deriv=k, mode="nearest") for k in (0, 1))
    return smooth, np.maximum(rate / np.gradient(time_s, rows), 0.0)


def _half_width(time_s: np.ndarray, along_mm: np.ndarray, pace: float) -> int:
    """Return the rows to either side over which a parabola gives the local speed to `ROUGH` of the steady one."""
    noise, step = noise_from_bends(np.diff(along_mm, 2)), pace * float(np.median(np.diff(time_s)))
    for half in range(1, max(2, len(time_s) // 16)):
        if noise * np.sqrt(3.0 / (half * (half + 1) * (2 * half + 1))) <= ROUGH * step:
            break
    return half
