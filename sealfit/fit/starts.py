"""The beginnings of strokes: from where the platform begins to move to where it slides steadily."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd

from sealfit.fit.ramps import Ramp, fit_ramps
from sealfit.ingest.pieces import median
from sealfit.samples import noise_from_bends, stroke_index, strokes_of

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
        return noise_from_bends(_bends(self.along_mm))

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


def _bends(values: np.ndarray) -> np.ndarray:
    """Return the second differences of neighbours, as `np.diff` does."""
    steps = values[1:] - values[:-1]
    return steps[1:] - steps[:-1]
