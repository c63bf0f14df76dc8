"""The beginnings of a condition's strokes, which the bristles follow step by step, all strokes together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sealfit.physics import bristle_limit
from sealfit.samples import noise_from_bends

STIFFNESSES = 40  # of the grid: the rise's length from a third of a step to the whole stroke
DAMPINGS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)  # of the grid: tau as a share of the time that the rise takes
SHARE = (0.02, 0.98)  # of the rise: samples in between show its length


@dataclass(frozen=True)
class Stroke:
    """A stroke from where it begins to move to where it slides steadily, in the direction of its motion.

    Attributes
    ----------
    file, run : int
        Numbers of its file and run; of the stroke itself, where there is one file or run alone.
    share : float
        Its limit over that of the condition's curve.
    distance_mm, speed_mm_s, force_N : ndarray, shape (n,)
        Distance slid, smoothed; speed; force against the motion.
    """

    file: int
    run: int
    share: float
    distance_mm: np.ndarray
    speed_mm_s: np.ndarray
    force_N: np.ndarray


@dataclass(frozen=True)
class Curve:
    """The Stribeck curve of a condition under its load, in N: F_s, F_c; v_s in mm/s (inf: flat), sigma_2 in N s/mm.

    `covariance`, shape (4, 4), is of these four in this order, with `df` degrees of freedom.
    """

    static_N: float
    coulomb_N: float
    v_s: float
    sigma_2: float
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((4, 4)))
    df: int = 1

    @property
    def known(self) -> bool:
        """Whether it bends at all."""
        return bool(np.isfinite(self.v_s))

    def moved(self) -> Iterator[Curve]:
        """Yield the curve moved by one standard deviation along each principal axis of its covariance."""
        size = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        unit = np.where(size > 0, size, 1.0)
        variance, axes = np.linalg.eigh(self.covariance / np.outer(unit, unit))
        at = np.array([self.static_N, self.coulomb_N, self.v_s, self.sigma_2])
        for step in (axes * np.sqrt(np.maximum(variance, 0.0))).T:
            if np.abs(step).max() > 1e-9:
                static, coulomb, v_s, sigma_2 = at + step * size
                yield replace(self, static_N=static, coulomb_N=coulomb, v_s=max(v_s, 0.1 * self.v_s), sigma_2=sigma_2)

    def limit_N(self, speed_mm_s: np.ndarray) -> np.ndarray:
        """Return G, the bristles' force in steady sliding, of the shape of the speed."""
        if not self.known:
            return np.full(np.shape(speed_mm_s), self.coulomb_N)
        return bristle_limit(speed_mm_s, 1.0, mu_s=self.static_N, mu_c=self.coulomb_N, v_s=self.v_s, sigma_0=1.0)


class Rises:
    """The strokes of a condition, padded to one length, so that all are followed step by step together."""

    def __init__(self, strokes: Sequence[Stroke], curve: Curve) -> None:
        sizes = np.array([s.force_N.size for s in strokes])
        self.there = np.arange(sizes.max())[:, None] < sizes  # (rows, strokes)
        self.step, self.speed, self.force = (np.zeros(self.there.shape) for _ in range(3))
        for k, s in enumerate(strokes):
            n = s.force_N.size
            self.step[1:n, k] = np.maximum(np.diff(s.distance_mm), 0.0)
            self.speed[:n, k], self.force[:n, k] = s.speed_mm_s, s.force_N
        self.limit = curve.limit_N(self.speed) * np.array([s.share for s in strokes])
        self.viscous = curve.sigma_2 * self.speed
        of_stroke = np.unique([s.file for s in strokes], return_inverse=True)[1]
        self.files = int(of_stroke.max()) + 1
        self.file = np.broadcast_to(of_stroke, self.there.shape)[self.there]
        self.run = np.unique([s.run for s in strokes], return_inverse=True)[1]

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Return stiffnesses and dampings to try, each of shape (points,)."""
        level = float(np.median(self.limit[self.there]))
        steps = self.step[self.step > 0]
        lengths = np.geomspace(0.3 * np.median(steps), self.step.sum(axis=0).max(), STIFFNESSES)
        pace = float(np.median(self.speed.max(axis=0)))
        length, share = (a.ravel() for a in np.meshgrid(lengths, DAMPINGS, indexing="ij"))
        return level / length, share * length / pace

    def _columns(self, sigma_0: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the force from relaxed bristles, and what a start of 1 N adds to it, (rows, strokes, points) each."""
        between = self.limit.copy()
        between[1:] = (self.limit[1:] + self.limit[:-1]) / 2
        kept = np.exp(-self.step[..., None] * sigma_0 / between[..., None])
        bristles, start = np.empty(kept.shape), np.empty(kept.shape)
        now, left = np.zeros(kept.shape[1:]), np.ones(kept.shape[1:])
        for row in range(kept.shape[0]):
            target = between[row][:, None]
            now = target + (now - target) * kept[row]
            left = left * kept[row]
            bristles[row], start[row] = now, left
        rate = self.speed[..., None] * sigma_0 * tau
        limit = self.limit[..., None]
        return bristles + rate * (1 - bristles / limit) + self.viscous[..., None], start * (1 - rate / limit)

    def _solved(self, sigma_0: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return level and start of every stroke, (strokes, points) each, and the residual, (rows, strokes, points)."""
        whole, start = self._columns(sigma_0, tau)
        whole, start = whole * self.there[..., None], start * self.there[..., None]
        force = (self.force * self.there)[..., None]
        ww, ss, ws = (whole**2).sum(axis=0), (start**2).sum(axis=0), (whole * start).sum(axis=0)
        wf, sf = (whole * force).sum(axis=0), (start * force).sum(axis=0)
        own = ww * ss - ws**2
        apart = own > 1e-10 * ww * ss
        own = np.where(apart, own, 1.0)
        level = np.where(apart, (ss * wf - ws * sf) / own, wf / np.maximum(ww, 1e-300))
        begin = np.where(apart, (ww * sf - ws * wf) / own, 0.0)
        return level, begin, force - level * whole - begin * start

    def squares(self, sigma_0: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return the sum of squares at every point of a grid, shape (points,)."""
        part = max(1, 2_000_000 // self.there.size)
        return np.concatenate(
            [
                (self._solved(sigma_0[k : k + part], tau[k : k + part])[2] ** 2).sum(axis=(0, 1))
                for k in range(0, sigma_0.size, part)
            ]
        )

    def residual(self, at: np.ndarray) -> np.ndarray:
        """Return measured minus model of every sample at (log sigma_0, tau), shape (samples,)."""
        return self._solved(np.exp(at[:1]), at[1:])[2][..., 0][self.there]

    def noise_N(self) -> float:
        """Return the noise of a sample, from how neighbours bend."""
        return noise_from_bends(np.diff(self.force, 2, axis=0)[self.there[2:]])

    def gain_of(self, rss: float) -> float:
        """Return how much better a fit is than a force that is there after one row, in its own residual variances."""
        force = np.where(self.there, self.force, np.nan)[1:]
        flat = float(np.nansum((force - np.nanmean(force, axis=0)) ** 2))
        rounding = 1e-20 * float(np.nansum(force**2))
        return (flat - rss) / max(rss / self.there.sum(), rounding)

    def forces(self, residual: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return every stroke's fitted force, from the residual of all samples."""
        fitted = np.zeros(self.there.shape)
        fitted[self.there] = self.force[self.there] - residual
        return tuple(fitted[there, k] for k, there in enumerate(self.there.T))

    def amplitudes(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return level and start of every stroke at (log sigma_0, tau), shape (strokes,) each."""
        level, begin, _ = self._solved(np.exp(at[:1]), at[1:])
        return level[:, 0], begin[:, 0]

    def run_levels(self, levels: np.ndarray) -> np.ndarray:
        """Return the mean log level of each run's strokes, shape (runs,)."""
        return np.bincount(self.run, np.log(np.maximum(levels, 1e-6))) / np.bincount(self.run)

    def inside(self, sigma_0: float, levels: np.ndarray, start_N: np.ndarray) -> int:
        """Return how many samples lie inside the rise."""
        slid = np.cumsum(self.step, axis=0)
        left = np.exp(-slid * sigma_0 / self.limit) * (1 - start_N / np.maximum(levels * self.limit[0], 1e-300))
        return int(((left > 1 - SHARE[1]) & (left < 2 - SHARE[0]) & (slid > 0) & self.there).sum())
