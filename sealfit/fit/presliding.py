r"""sigma_0 and sigma_1 from the pre-sliding part of traces: one pair for the strokes of a condition.

Over a stroke the bristles' force :math:`B = \sigma_0 z` follows Eqs. 2 and 6 exactly, step by step of the distance x,

.. math::
    \frac{dB}{dx} = \sigma_0 \Big(1 - \frac{B}{G}\Big), \quad F = B + \tau \dot B + \sigma_2 v, \quad
    G = N [\mu_c + (\mu_s - \mu_c) e^{-(v/v_s)^2}], \quad \tau = \sigma_1 / \sigma_0,

with the Stribeck curve G of the condition's steady fit. It is linear in where the bristles begin, so each stroke has
two linear numbers of its own, its level and its start (relaxed, or bent the other way after a reversal), and they are
solved for exactly; sigma_0 and tau are searched on a grid and polished (Golub and Pereyra 1973, SIAM J. Numer. Anal.
10(2), 413-432, doi:10.1137/0710036). The rise shows the length G / sigma_0, and its evidence are whole files, as
neighbouring samples are not independent; what makes a stiffness of it is the level of the strokes, whose evidence are
runs, as a set-up shifts all files of a run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from sealfit.fit.polish import central_jacobian, polish
from sealfit.physics.stribeck import stribeck_decay

STIFFNESSES = 40  # of the grid: the rise's length from a third of a step to the whole stroke
DAMPINGS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)  # of the grid: tau as a share of the time that the rise takes
SHARE = (0.02, 0.98)  # of the rise: samples in between show its length
LEAST = 3  # such samples below which nothing can be said
RISES = 30.0  # residual variances by which a rise must do better than none
OPEN = np.log(3.0)  # of log sigma_0: an interval that reaches further each way is no estimate


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
    """The Stribeck curve of a condition under its load, in N: F_s, F_c; v_s in mm/s (inf: flat), sigma_2 in N s/mm."""

    static_N: float
    coulomb_N: float
    v_s: float
    sigma_2: float

    @property
    def known(self) -> bool:
        """Whether it bends at all."""
        return bool(np.isfinite(self.v_s))

    def limit_N(self, speed_mm_s: np.ndarray) -> np.ndarray:
        """Return G, the bristles' force in steady sliding, of the shape of the speed."""
        if not self.known:
            return np.full(np.shape(speed_mm_s), self.coulomb_N)
        return self.coulomb_N + (self.static_N - self.coulomb_N) * stribeck_decay(speed_mm_s, self.v_s)


@dataclass(frozen=True)
class Stiffness:
    """sigma_0 in N/mm and tau = sigma_1 / sigma_0 in s, with the covariance of (log sigma_0, tau) between units.

    Attributes
    ----------
    sigma_0, tau_s : float
        Estimates.
    covariance : ndarray, shape (2, 2)
        Of log sigma_0 and tau; NaN from fewer than two units.
    df : ndarray, shape (2,)
        Satterthwaite's degrees of freedom of the two.
    within : int
        Samples inside the rise.
    gain : float
        By how many residual variances a force that is there at once fits worse.
    files : int
        Files.
    forces_N : tuple of ndarray, shape (n,) each
        Fitted force of every stroke.
    rmse_N : float
        Of what the fit leaves.
    """

    sigma_0: float
    tau_s: float
    covariance: np.ndarray
    df: np.ndarray
    within: int
    gain: float
    files: int
    forces_N: tuple[np.ndarray, ...]
    rmse_N: float

    @property
    def seen(self) -> bool:
        """Whether the samples show the rise: some lie within it, and a force that is there at once does worse."""
        return self.within >= LEAST and self.gain > RISES

    def log_half_width(self) -> float:
        """Return half of the 95 % interval of log sigma_0."""
        return float(stats.t.ppf(0.975, max(self.df[0], 1.0)) * np.sqrt(self.covariance[0, 0]))

    @property
    def stiffness_known(self) -> bool:
        """Whether the interval of sigma_0 is one."""
        return self.seen and np.isfinite(self.covariance[0, 0]) and self.log_half_width() < OPEN

    @property
    def sigma_1(self) -> float:
        """sigma_0 tau, in N s/mm."""
        return self.sigma_0 * self.tau_s

    def damping_half_width(self) -> float:
        """Return half of the 95 % interval of sigma_1, by the delta method, in N s/mm."""
        slope = np.array([self.sigma_1, self.sigma_0])
        return float(stats.t.ppf(0.975, max(self.df[1], 1.0)) * np.sqrt(slope @ self.covariance @ slope))


def fit_stiffness(strokes: Sequence[Stroke], curve: Curve) -> Stiffness | None:
    """Return sigma_0 and tau of the strokes of a condition; None where there is no stroke.

    Parameters
    ----------
    strokes : sequence of Stroke
        All strokes that begin at rest or at a reversal.
    curve : Curve
        Of the condition.
    """
    if not strokes:
        return None
    rises = _Rises(strokes, curve)
    stiffness, tau = rises.grid()
    squares = rises.squares(stiffness, tau)
    best = int(np.argmin(squares))
    start = np.array([np.log(stiffness[best]), tau[best]])
    low = np.array([np.log(stiffness.min()) - 1.0, 0.0])
    high = np.array([np.log(stiffness.max()) + 1.0, np.inf])
    found = polish(rises.residual, None, start, (low, high))
    sigma_0, tau_s = float(np.exp(found.x[0])), float(found.x[1])
    jacobian = central_jacobian(rises.residual, found.x)
    levels, start_N = rises.amplitudes(sigma_0, tau_s)
    covariance, df = _between_files(jacobian, found.residual, rises.file)
    level = rises.run_levels(levels)
    spread = float(level.var(ddof=1) / level.size) if level.size > 1 else np.nan
    total = covariance[0, 0] + spread
    df[0] = total**2 / (covariance[0, 0] ** 2 / max(df[0], 1.0) + spread**2 / max(level.size - 1, 1))
    covariance[0, 0] = total
    return Stiffness(
        sigma_0=sigma_0 * float(np.exp(level.mean())),
        tau_s=tau_s,
        covariance=covariance,
        df=df,
        gain=rises.gain_of(found.rss),
        within=rises.inside(sigma_0, levels, start_N),
        files=rises.files,
        forces_N=rises.forces(found.residual),
        rmse_N=float(np.sqrt(found.rss / found.residual.size)),
    )


def _between_files(jacobian: np.ndarray, residual: np.ndarray, file: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariance of the estimates from how files pull at them, shape (p, p), and its degrees of freedom.

    Each file's pull is that on a fit without it (the jackknife's, CR3); the degrees of freedom follow from how evenly
    files share the information.
    """
    files = int(file.max()) + 1
    p = jacobian.shape[1]
    normal = jacobian.T @ jacobian
    inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
    own = np.stack([jacobian[file == k].T @ jacobian[file == k] for k in range(files)])
    pull = np.stack([jacobian[file == k].T @ residual[file == k] for k in range(files)])
    if files < 2:
        return np.full((p, p), np.nan), np.ones(p)
    left = np.eye(p) - own @ inverse
    moved = np.stack([inverse @ np.linalg.lstsq(a, b, rcond=1e-9)[0] for a, b in zip(left, pull, strict=True)])
    covariance = (files - 1) / files * moved.T @ moved
    information = np.einsum("pq,kqr,rp->kp", inverse, own, inverse) / np.maximum(np.diag(inverse), 1e-300)
    df = 1 / np.maximum((information**2).sum(axis=0), 1e-12) - 1
    return covariance, df


class _Rises:
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

    def amplitudes(self, sigma_0: float, tau_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return level and start of every stroke, shape (strokes,) each."""
        level, begin, _ = self._solved(np.array([sigma_0]), np.array([tau_s]))
        return level[:, 0], begin[:, 0]

    def run_levels(self, levels: np.ndarray) -> np.ndarray:
        """Return the mean log level of each run's strokes, shape (runs,)."""
        return np.bincount(self.run, np.log(np.maximum(levels, 1e-6))) / np.bincount(self.run)

    def inside(self, sigma_0: float, levels: np.ndarray, start_N: np.ndarray) -> int:
        """Return how many samples lie inside the rise."""
        slid = np.cumsum(self.step, axis=0)
        left = np.exp(-slid * sigma_0 / self.limit) * (1 - start_N / np.maximum(levels * self.limit[0], 1e-300))
        return int(((left > 1 - SHARE[1]) & (left < 2 - SHARE[0]) & (slid > 0) & self.there).sum())
