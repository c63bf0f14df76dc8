"""The motion of platforms that start along a ramp of two numbers, fitted to many strokes together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sealfit.ingest.pieces import median

RAMPS = np.geomspace(0.5, 200.0, 12)  # steps in time that a ramp may take, to begin with
PADDED = (
    64  # rows, of which every stroke's are made a multiple: sums do not depend on which strokes are fitted together
)
TOGETHER = 16_384  # rows of strokes at once: what is held of them stays in the cache
TRIALS = 100  # of steps, at most
SETTLED = 1e-18  # of the sum of squares: a step that would change it by less
UNSEEN = (
    1e-13  # of the sum of squares: a step that would change it by less is taken, as rounding hides whether it falls
)
TOO_SHORT = 1e-13  # of the step in time: a step that moves the beginning by less is rounding
DAMPED = (1e-4, 1e-10, 1e12)  # Marquardt's number: to begin with, and where it makes steps those of Newton, or none


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
    projection: Kaufman 1975, BIT 15, 49-57, doi:10.1007/BF01932995), the other two by Levenberg and Marquardt's steps
    from the best of a grid of lengths.

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
    at = _descended(rows, shape, at, np.stack([step, np.ones(len(step))], axis=1))
    distance, rate, _ = _moved(rows, shape, at)
    speed, _, squares = _solved(rows, rows.centred(distance))
    return distance, rate, speed, squares


def _descended(rows: _Rows, shape: Shape, at: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return the beginnings and log lengths, shape (strokes, 2), that least squares lead to from a start.

    Steps are counted in `unit`, (strokes, 2); a stroke whose steps have become small is let be.
    """
    at, damping = at.copy(), np.full(len(at), DAMPED[0])
    alive = np.arange(len(at))
    squares, pull, normal = _tangent(rows, shape, at, unit)
    own = rows
    for _ in range(TRIALS):
        diagonal = np.einsum("kii->ki", normal)
        damped = normal.copy()
        np.einsum("kii->ki", damped)[:] += damping[alive, None] * diagonal + 1e-300
        move = -_solve(damped, pull)
        gain = np.einsum("ki,kij,kj->k", move, normal, move)
        # Where one direction is hardly seen (a ramp within a step), the other is what tells.
        reestimated = (gain <= SETTLED * squares) | (np.abs(move).max(axis=1) <= TOO_SHORT)
        reestimated |= damping[alive] > DAMPED[2]
        if reestimated.any():
            alive, own = alive[~reestimated], own.some(~reestimated)
            squares, pull, normal, move, gain = (values[~reestimated] for values in (squares, pull, normal, move, gain))
            if not len(alive):
                break
        trial = at[alive] + move * unit[alive]
        new_squares, new_pull, new_normal = _tangent(own, shape, trial, unit[alive])
        better = (new_squares < squares) | (gain <= UNSEEN * squares)
        damping[alive] = np.where(better, np.maximum(damping[alive] / 10, DAMPED[1]), damping[alive] * 10)
        at[alive[better]] = trial[better]
        squares, pull, normal = (
            np.where(better.reshape(-1, *[1] * (old.ndim - 1)), new, old)
            for new, old in ((new_squares, squares), (new_pull, pull), (new_normal, normal))
        )
    return at


def _tangent(rows: _Rows, shape: Shape, at: np.ndarray, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the sum of squares, (strokes,), J'r, (strokes, 2), and J'J, (strokes, 2, 2), of steps in `unit`."""
    distance, rate, by_ramp = _moved(rows, shape, at)
    distance = rows.centred(distance)
    speed, residual, squares = _solved(rows, distance)
    # residual = along - speed * distance(time - at[0], ramp): its slopes, free of what place and speed take up
    slopes = np.stack([distance, rows.centred(rate), rows.centred(by_ramp)], axis=1)
    products = np.einsum("kir,kjr->kij", slopes, slopes)
    by = np.stack([speed, -speed], axis=1) * unit
    shared = products[:, 0, 1:] / np.maximum(products[:, 0, :1], 1e-300)
    normal = products[:, 1:, 1:] - shared[:, :, None] * products[:, :1, 1:]
    pull = np.einsum("kir,kr->ki", slopes[:, 1:], residual)  # the residual is free of the distance already
    return squares, by * pull, by[:, :, None] * by[:, None, :] * normal


def _moved(rows: _Rows, shape: Shape, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return shape(rows.time - at[:, :1], np.exp(np.clip(at[:, 1:], -50.0, 50.0)))


def _solved(rows: _Rows, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the slope of the displacement on a centred distance, what it leaves, and the sum of squares of that."""
    square = np.einsum("kr,kr->k", distance, distance)
    slope = np.einsum("kr,kr->k", distance, rows.along) / np.maximum(square, 1e-300)
    residual = rows.along - slope[:, None] * distance
    return slope, residual, np.einsum("kr,kr->k", residual, residual)


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution of two linear equations each, shape (k, 2); 0 where they are one."""
    determinant = matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] ** 2
    safe = np.where(determinant > 0, determinant, np.inf)
    one = matrix[:, 1, 1] * right[:, 0] - matrix[:, 0, 1] * right[:, 1]
    other = matrix[:, 0, 0] * right[:, 1] - matrix[:, 0, 1] * right[:, 0]
    return np.stack([one / safe, other / safe], axis=1)


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
