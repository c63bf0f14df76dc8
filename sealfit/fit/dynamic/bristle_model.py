"""The starts of the strokes of a condition: averages over cells of distance, and the bristle model."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from sealfit.fit.dynamic.starts import LEAST, StrokePart
from sealfit.ingest.stored_parts import noise_from_bends
from sealfit.physics import bristle_limit

# Largest number of cells of a group.
MOST_CELLS = 200


class Cells:
    """Cells of distance for strokes of a condition, commanded speed and direction, to their median reach.

    `count` is the median number of samples of a stroke, `samples`, at most MOST_CELLS.
    """

    def __init__(self, parts: Sequence[StrokePart]) -> None:
        self.parts = parts
        self.samples = float(np.median([part.force_N.size for part in parts]))
        self.reach_mm = float(np.median([part.distance_mm[-1] for part in parts]))
        self.count = int(np.clip(int(self.samples), LEAST, MOST_CELLS))
        self.middle_mm = (np.arange(self.count) + 0.5) * (self.reach_mm / self.count)
        self.force_N = self.means([part.force_N for part in parts])  # (strokes, cells)

    def means(self, values: Sequence[np.ndarray]) -> np.ndarray:
        """Return each stroke's mean in each cell, shape (strokes, cells); NaN without a sample."""
        found = np.full((len(self.parts), self.count), np.nan)
        for row, part, own in zip(found, self.parts, values, strict=True):
            cell = (part.distance_mm / self.reach_mm * self.count).astype(np.int64)
            inside = cell < self.count
            hits, total = (np.bincount(cell[inside], of, self.count) for of in (None, own[inside]))
            np.divide(total, hits, out=row, where=hits > 0)
        return found


# Grid values of the stiffness. The length of the rise goes from a third of a step to the whole stroke.
STIFFNESSES = 40
# Grid values of the damping: tau as a share of the duration of the rise.
DAMPINGS = np.array([0.0, 0.01, 0.03, 0.1, 0.3, 1.0])
# Samples between these shares of the rise determine its length.
SHARE = (0.02, 0.98)
# Least share of the damping's sum of squares that other parameters of strokes do not explain: about the
# square of the relative variation of the speed, here 1 %.
DISTINCT = 1e-4
# Number of rise lengths after which the exponential is zero; larger exponents overflow.
FAR = 500.0
# Level and start are distinguishable if the determinant of their Gram matrix, scaled, is above this.
APART = 1e-10


@dataclass(frozen=True)
class RisingStroke:
    """A stroke from the start of motion to steady sliding."""

    file: int  # number of its file, or of the stroke itself if there is only one file
    run: int  # the same of its run
    share: float  # ratio of its steady bristle force to that of the condition's curve
    distance_mm: np.ndarray  # (n,) smoothed distance slid
    speed_mm_s: np.ndarray  # (n,)
    force_N: np.ndarray  # (n,) opposing the motion


@dataclass(frozen=True)
class StribeckCurve:
    """A condition's Stribeck curve under its load: F_s, F_c in N; v_s in mm/s (inf: flat), sigma_2 in N s/mm.

    `covariance`, shape (4, 4), is that of these four in this order, with `df` degrees of freedom.
    """

    static_N: float
    coulomb_N: float
    v_s: float
    sigma_2: float
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((4, 4)))
    df: int = 1

    @property
    def known(self) -> bool:
        """Whether the curve is determined; it is flat otherwise."""
        return bool(np.isfinite(self.v_s))

    def moved(self) -> Iterator["StribeckCurve"]:
        """Yield the curve one standard deviation off along each principal axis; values stay above a tenth."""
        size = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        unit = np.where(size > 0, size, 1.0)
        variance, axes = np.linalg.eigh(self.covariance / np.outer(unit, unit))
        at = np.array([self.static_N, self.coulomb_N, self.v_s, self.sigma_2])
        for step in (axes * np.sqrt(np.maximum(variance, 0.0))).T:
            if np.abs(step).max() > 1e-9:
                static, coulomb, v_s, sigma_2 = np.maximum(at + step * size, 0.1 * at).tolist()
                yield replace(self, static_N=static, coulomb_N=coulomb, v_s=v_s, sigma_2=sigma_2)

    def limit_N(self, speed_mm_s: np.ndarray) -> np.ndarray:
        """Return G, the bristle force in steady sliding in N, shape of the speed."""
        if not self.known:
            return np.full(np.shape(speed_mm_s), self.coulomb_N)
        mu = {"mu_s": self.static_N, "mu_c": self.coulomb_N}
        return bristle_limit(speed_mm_s, 1.0, **mu, v_s=self.v_s, sigma_0=1.0)


@dataclass(frozen=True)
class BristleTangent:
    """Residual of the forces at (log sigma_0, tau), with optimal linear parameters, and its derivative."""

    level: np.ndarray  # (strokes,) force relative to the curve
    begin: np.ndarray  # (strokes,) bristle force at the start, in N
    residual: np.ndarray  # (strokes, rows) measured minus model
    jacobian: np.ndarray  # (2, strokes, rows) derivative of the residual

    @property
    def rss(self) -> float:
        """Sum of squares."""
        return float(np.einsum("kr,kr->", self.residual, self.residual))

    @cached_property
    def normal(self) -> np.ndarray:
        """J'J of every stroke, shape (strokes, 2, 2)."""
        return np.einsum("ikr,jkr->kij", self.jacobian, self.jacobian)

    @cached_property
    def pull(self) -> np.ndarray:
        """J'r of every stroke, shape (strokes, 2)."""
        return np.einsum("ikr,kr->ki", self.jacobian, self.residual)


class Rises:
    """The strokes of a condition, padded to one length and simulated together."""

    def __init__(self, strokes: Sequence[RisingStroke], curve: StribeckCurve) -> None:
        sizes = np.array([s.force_N.size for s in strokes])
        self.there = np.arange(sizes.max()) < sizes[:, None]  # (strokes, rows)
        self.step, self.speed, self.force = (np.zeros(self.there.shape) for _ in range(3))
        for name, padded in (("distance_mm", self.step), ("speed_mm_s", self.speed), ("force_N", self.force)):
            padded[self.there] = np.concatenate([getattr(s, name) for s in strokes])
        self.step[:, 1:] = np.maximum(np.diff(self.step, axis=1), 0.0) * self.there[:, 1:]
        self.step[:, 0] = 0.0
        self.file = np.unique([s.file for s in strokes], return_inverse=True)[1]
        self.run = np.unique([s.run for s in strokes], return_inverse=True)[1]
        self.limit = curve.limit_N(self.speed) * np.array([s.share for s in strokes])[:, None]
        self.viscous = curve.sigma_2 * self.speed
        self.between = self.limit.copy()
        self.between[:, 1:] = (self.limit[:, 1:] + self.limit[:, :-1]) / 2

    def _columns(self, sigma_0: float, *, slopes: bool) -> list[np.ndarray]:
        """Return the columns at sigma_0, and with `slopes` their derivatives with respect to log sigma_0.

        They are (2, strokes, 2, rows): the first plus tau times the second are the force from relaxed
        bristles, and that of a start of 1 N.
        """
        slid = sigma_0 * self.step / self.between
        kept = np.exp(-slid)
        bristles = _followed(slid, (1 - kept) * self.between)
        start = np.exp(-np.cumsum(slid, axis=1))
        rate = sigma_0 * self.speed * self.there
        lag = rate / self.limit
        whole = (bristles + self.viscous) * self.there
        made = [_stacked(whole, start * self.there, rate - bristles * lag, -start * lag)]
        if slopes:
            before = np.zeros(bristles.shape)
            before[:, 1:] = bristles[:, :-1]
            rising = _followed(slid, (self.between - before) * slid * kept)
            falling = start * np.cumsum(slid, axis=1)
            lagging = rate - (bristles + rising) * lag, (falling - start) * lag
            made.append(_stacked(rising * self.there, -falling * self.there, *lagging))
        return made

    def _solved(self, both: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the inverse normal matrices of level and start, their values, and the residual."""
        inverse = _inverse(both @ both.transpose(0, 2, 1))
        linear = inverse @ (both @ self.force[..., None])
        return inverse, linear, self.force - (linear * both).sum(axis=1)

    def tangent(self, at: np.ndarray) -> BristleTangent:
        """Return the residual at (log sigma_0, tau) with optimal linear parameters, and its derivative."""
        (columns, slopes), tau = self._columns(float(np.exp(at[0])), slopes=True), float(at[1])
        both = columns[0] + tau * columns[1]
        inverse, linear, residual = self._solved(both)
        moved = []
        for by in (slopes[0] + tau * slopes[1], columns[1]):
            model = (linear * by).sum(axis=1)
            change = inverse @ (by @ residual[..., None] - both @ model[..., None])
            moved.append(-model - (change * both).sum(axis=1))
        return BristleTangent(linear[:, 0, 0], linear[:, 1, 0], residual, np.stack(moved))

    def shows_damping(self, sigma_0: float) -> bool:
        """Return whether a small damping is distinguishable from the level and initial force of strokes."""
        at = self.tangent(np.array([np.log(sigma_0), 0.0]))
        lagging = self._columns(sigma_0, slopes=False)[0][1]
        effect = at.level[:, None] * lagging[:, 0] + at.begin[:, None] * lagging[:, 1]
        return float(at.normal[:, 1, 1].sum()) > DISTINCT * float((effect**2).sum())

    def best_of_grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the best point of a grid, (log sigma_0, tau), and bounds, (2, 2); tau is 0 if not seen."""
        level = float(np.median(self.limit[self.there]))
        steps = self.step[self.step > 0]
        lengths = np.geomspace(0.3 * np.median(steps), self.step.sum(axis=1).max(), STIFFNESSES)
        pace = float(np.median(self.speed.max(axis=1)))
        squares = np.zeros((STIFFNESSES, DAMPINGS.size))
        for k, length in enumerate(lengths):
            constant, lagging = self._columns(level / length, slopes=False)[0]
            for m, tau in enumerate(DAMPINGS * length / pace):
                squares[k, m] = (self._solved(constant + tau * lagging)[2] ** 2).sum()
        damped = self.shows_damping(level / lengths[np.argmin(squares[:, 0])])
        squares[:, 1:] += 0.0 if damped else np.inf
        best, damping = np.unravel_index(np.argmin(squares), squares.shape)
        low, high = np.log(level / lengths[[-1, 0]])
        tau = DAMPINGS[damping] * lengths[best] / pace
        bounds = np.array([[low - 1.0, 0.0], [high + 1.0, np.inf if damped else 0.0]])
        return np.array([np.log(level / lengths[best]), tau]), bounds

    def noise_N(self) -> float:
        """Return the standard deviation of a sample in N, from second differences."""
        return noise_from_bends(np.diff(self.force, 2, axis=1)[self.there[:, 2:]])

    def gain_of(self, rss: float) -> float:
        """Return the fall of the rss from a force that is constant after one row, in residual variances."""
        there, force = self.there[:, 1:], self.force[:, 1:]
        mean = force.sum(axis=1) / there.sum(axis=1)
        flat = float((((force - mean[:, None]) * there) ** 2).sum())
        rounding = 1e-20 * float((force**2).sum())
        return (flat - rss) / max(rss / self.there.sum(), rounding)

    def forces(self, residual: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the fitted forces of the strokes from the residual, shape (strokes, rows)."""
        fitted = self.force - residual
        return tuple(own[:n] for own, n in zip(fitted, self.there.sum(axis=1).tolist(), strict=True))

    def run_levels(self, levels: np.ndarray) -> np.ndarray:
        """Return the mean log level of each run's strokes, shape (runs,)."""
        return np.bincount(self.run, np.log(np.maximum(levels, 1e-6))) / np.bincount(self.run)

    def inside(self, sigma_0: float, levels: np.ndarray, start_N: np.ndarray) -> int:
        """Return the number of samples inside the rise."""
        slid = np.cumsum(self.step, axis=1)
        height = 1 - start_N / np.maximum(levels * self.limit[:, 0], 1e-300)
        remaining = np.exp(-slid * sigma_0 / self.limit) * height[:, None]
        return int(((remaining > 1 - SHARE[1]) & (remaining < 2 - SHARE[0]) & (slid > 0) & self.there).sum())


def _stacked(whole: np.ndarray, start: np.ndarray, *lagging: np.ndarray) -> np.ndarray:
    """Return the columns of level and start, without and with lag, shape (2, strokes, 2, rows)."""
    return np.stack([np.stack(both, axis=1) for both in ((whole, start), lagging)])


def _followed(slid: np.ndarray, added: np.ndarray, begin: np.ndarray | float = 0.0) -> np.ndarray:
    r"""Return x of the recursion :math:`x_k = e^{-s_k} x_{k-1} + a_k` along the last axis.

    With D the cumulative sum of s, :math:`x_k = e^{-D_k} (x_{-1} + \sum_j a_j e^{D_j})`. If that would
    overflow, the rows are split in two halves. s >= 0 and a have the shape (strokes, rows).
    """
    far = np.cumsum(slid, axis=-1)
    half = slid.shape[-1] // 2
    if far[..., -1].max() > FAR and half:
        first = _followed(slid[..., :half], added[..., :half], begin)
        last = _followed(slid[..., half:], added[..., half:], first[..., -1:])
        return np.concatenate([first, last], axis=-1)
    grown = np.exp(np.minimum(far, FAR))
    return (begin + np.cumsum(added * grown, axis=-1)) / grown


def _inverse(gram: np.ndarray) -> np.ndarray:
    """Return the inverse Gram matrices of two columns, shape (..., 2, 2); of the first alone if dependent."""
    ww, ss, ws = gram[..., 0, 0], gram[..., 1, 1], gram[..., 0, 1]
    own = ww * ss - ws**2
    apart = own > APART * ww * ss
    own = np.where(apart, own, 1.0)
    inverse = np.zeros(gram.shape)
    inverse[..., 0, 0] = np.where(apart, ss / own, 1 / np.maximum(ww, 1e-300))
    inverse[..., 1, 1] = np.where(apart, ww / own, 0.0)
    inverse[..., 0, 1] = inverse[..., 1, 0] = np.where(apart, -ws / own, 0.0)
    return inverse
