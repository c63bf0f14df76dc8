"""How trace columns behave: time rises evenly, displacement fills its range, force follows the motion."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sealfit.config import Strokes
from sealfit.ingest.strokes import displacement_noise_mm, steady_speeds, turning_rows
from sealfit.ingest.trace_checks import measured_speed

SMOOTHED = 7  # samples, as `strokes.smooth_samples`
MOVING = 0.3  # of the highest smoothed speed: slower samples belong to rests, ramps and turns
STROKE = 0.2  # of the range: a smaller way back is no turn
SPEEDS_APART = 1.25  # ratio of two steady speeds in one file; plateaus of one speed differ by far less


def rises(values: np.ndarray) -> bool:
    """Whether a column rises from row to row, as time and counters do."""
    return len(values) > 2 and bool((np.diff(values) > 0).mean() > 0.99)


def evenness(values: np.ndarray) -> float:
    """Return how even the steps of a rising column are: 1 where all are the same."""
    steps = np.diff(values)
    middle = np.median(steps)
    return float(np.mean(np.abs(steps - middle) <= 0.2 * abs(middle))) if middle else 0.0


def is_counter(values: np.ndarray) -> bool:
    """Whether a column counts rows: whole numbers one apart."""
    return rises(values) and bool((np.diff(values) == 1.0).all())


def spread(values: np.ndarray) -> float:
    """Return how a column fills its range: 0.9 if every tenth has as many samples, 0 for a constant."""
    low, high = np.min(values), np.max(values)
    if high <= low:
        return 0.0
    counts, _ = np.histogram(values, bins=10, range=(low, high))
    return float(1.0 - counts.max() / counts.sum())


def smoothness(values: np.ndarray) -> float:
    """Return the share of a column's path that its strokes explain: 1 for a displacement, less with noise."""
    path = float(np.abs(np.diff(values)).sum())
    return float((stroke_count(values) * np.ptp(values)) / path) if path else 0.0


def ends_of_strokes(values: np.ndarray) -> list[int]:
    """Return the rows where a displacement begins, turns and ends: a fifth of its range apart or more."""
    smooth = smoothed(values)
    return turning_rows(smooth, STROKE * float(np.ptp(smooth)))


def stroke_count(values: np.ndarray) -> int:
    """Return how many strokes a displacement has."""
    return max(len(ends_of_strokes(values)) - 1, 1)


def smoothed(values: np.ndarray) -> np.ndarray:
    """Return a running mean over seven samples, shorter at the ends."""
    width = min(SMOOTHED, len(values))
    kernel = np.ones(width)
    return np.convolve(values, kernel, "same") / np.convolve(np.ones(len(values)), kernel, "same")


def velocity(time: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Return the smoothed speed; 0 where the clock stands."""
    with np.errstate(all="ignore"):
        return smoothed(np.nan_to_num(np.gradient(displacement, time), posinf=0.0, neginf=0.0))


def mean_speed(speed: np.ndarray) -> float:
    """Return the mean magnitude of speeds where there is motion; slow ones are steps of their resolution."""
    size = smoothed(np.abs(speed))
    return float(np.mean(size[size >= MOVING * np.quantile(size, 0.95)]))


@dataclass(frozen=True, slots=True)
class Follows:
    """How a column follows the motion: `sign` is that of the column where the displacement rises.

    `strength` is 0 to 1; `both_ways` whether the file moves in both directions.
    """

    sign: int
    strength: float
    both_ways: bool


def follows(values: np.ndarray, speed: np.ndarray) -> Follows:
    """Return how a column follows the direction of the motion.

    With strokes both ways its means forward and backward are compared, so an offset does not matter; with one
    direction the mean while moving is compared with zero, and its strength with the first samples at rest.
    """
    fast = np.quantile(np.abs(speed), 0.95) * MOVING
    forward, backward = values[speed > fast], values[speed < -fast]
    least = 0.05 * len(values)
    if len(forward) > least and len(backward) > least:
        apart = float(np.mean(forward) - np.mean(backward))
        scatter = float(0.5 * (np.std(forward) + np.std(backward)))
        return Follows(int(np.sign(apart)), _share(apart, scatter), True)
    moving, way = (forward, 1) if len(forward) >= len(backward) else (backward, -1)
    if len(moving) == 0:
        return Follows(0, 0.0, False)
    mean = float(np.mean(moving))
    rest = float(values[0])
    return Follows(int(np.sign(mean)) * way, _share(mean - rest, float(np.std(moving))), False)


def _share(difference: float, scatter: float) -> float:
    total = abs(difference) + 2.0 * scatter
    return abs(difference) / total if total else 0.0


def plateau_speeds(time: np.ndarray, displacement: np.ndarray) -> list[list[float]]:
    """Return the steady speeds of every stroke, with the sign of the motion; rests and ramps do not count."""
    strokes, noise = [], displacement_noise_mm(displacement)
    for first, last in pairwise(ends_of_strokes(displacement)):
        t, x = time[first : last + 1], displacement[first : last + 1]
        sign = float(np.sign(x[-1] - x[0]))
        if len(t) <= SMOOTHED:
            continue
        parts = [(slice(len(t)), 0)]
        if (np.diff(t) > 0).all():  # where the clock stands there is no speed at a row
            parts = steady_speeds(t, sign * x, noise, Strokes())
        speeds = [sign * measured_speed(t[at : part.stop], x[at : part.stop])[1] for part, at in parts]
        strokes.append([speed for speed in speeds if np.isfinite(speed) and speed != 0])
    return strokes


def several_speeds(speeds: list[float]) -> list[float]:
    """Return the speeds of one direction in a file that holds several, none otherwise.

    One stroke that is off is no speed of its own; each direction may have its speed.

    Examples
    --------
    >>> several_speeds([5.0, 5.0, 1.0, 1.0]), several_speeds([5.0, 5.0, 5.0, 1.0])
    ([1.0, 5.0], [])
    >>> several_speeds([1.0, 2.0, 4.0])
    [1.0, 2.0, 4.0]
    >>> several_speeds([5.0, -8.0, 5.0, -8.0])
    []
    """
    forward = _several([speed for speed in speeds if speed > 0])
    return forward or _several([-speed for speed in speeds if speed < 0])


def _several(speeds: list[float]) -> list[float]:
    groups = _groups(speeds)
    own = all(len(group) == 1 for group in groups)
    kept = groups if own else [group for group in groups if len(group) > 1]
    apart = all(a[-1] * SPEEDS_APART < b[0] for a, b in pairwise(kept))
    return [group[0] for group in kept] if len(kept) > 1 and apart else []


def _groups(speeds: list[float]) -> list[list[float]]:
    """Return the speeds in groups that differ by a quarter or more, the slowest first."""
    found: list[list[float]] = []
    for speed in sorted(speeds):
        if not found or speed > SPEEDS_APART * found[-1][0]:
            found.append([])
        found[-1].append(speed)
    return found
