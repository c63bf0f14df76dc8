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

from sealfit.fit.polish import polish
from sealfit.fit.rises import Curve, Rises, Stroke

LEAST = 3  # such samples below which nothing can be said
RISES = 30.0  # residual variances by which a rise must do better than none
MISSED_NOISE, MISSED_LEVEL = 2.0, 0.03  # of the noise and of the sliding force: what a fit leaves that has missed
OPEN = np.log(3.0)  # of log sigma_0: an interval that reaches further each way is no estimate


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
    rmse_N, noise_N : float
        RMS of what the fit leaves, and the noise of a sample as its neighbours tell it.
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
    noise_N: float

    @property
    def seen(self) -> bool:
        """Whether the samples show the rise: some lie within it, and a force that is there at once does worse."""
        return self.within >= LEAST and self.gain > RISES

    def misses(self, level_N: float) -> bool:
        """Whether the force comes up otherwise than the model's, by more than noise and than matters at this level."""
        return self.rmse_N > MISSED_NOISE * self.noise_N and self.rmse_N > MISSED_LEVEL * level_N

    @property
    def quantile(self) -> np.ndarray:
        """Student's quantile of the 95 % intervals of the two, shape (2,)."""
        return stats.t.ppf(0.975, np.maximum(self.df, 1.0))

    def log_half_width(self) -> float:
        """Return half of the 95 % interval of log sigma_0."""
        return float(self.quantile[0] * np.sqrt(self.covariance[0, 0]))

    @property
    def stiffness_known(self) -> bool:
        """Whether the interval of sigma_0 is one."""
        return self.seen and np.isfinite(self.covariance[0, 0]) and self.log_half_width() < OPEN

    @property
    def sigma_1(self) -> float:
        """sigma_0 tau, in N s/mm."""
        return self.sigma_0 * self.tau_s

    @property
    def damping_se(self) -> float:
        """Standard error of sigma_1 by the delta method, in N s/mm."""
        slope = np.array([self.sigma_1, self.sigma_0])
        return float(np.sqrt(slope @ self.covariance @ slope))

    def damping_half_width(self) -> float:
        """Return half of the 95 % interval of sigma_1, in N s/mm."""
        return float(self.quantile[1] * self.damping_se)


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
    rises = Rises(strokes, curve)
    stiffness, tau = rises.grid()
    best = int(np.argmin(rises.squares(stiffness, tau)))
    low = np.array([np.log(stiffness.min()) - 1.0, 0.0])
    high = np.array([np.log(stiffness.max()) + 1.0, np.inf])
    found = polish(rises.residual, None, np.array([np.log(stiffness[best]), tau[best]]), (low, high))
    levels, start_N = rises.amplitudes(found.x)
    level = rises.run_levels(levels)
    shifts = []
    for other in (Rises(strokes, moved) for moved in curve.moved()):
        at = _one_step(found.jacobian, other.residual(found.x), found.x, low, high)
        shifts.append(at - found.x + [other.run_levels(other.amplitudes(at)[0]).mean() - level.mean(), 0.0])
    by_files, df = _between_files(found.jacobian, found.residual, rises.file)
    by_level = float(level.var(ddof=1) / level.size) if level.size > 1 else np.nan
    by_curve = np.array(shifts).T @ np.array(shifts) if shifts else np.zeros((2, 2))
    parts = ((np.diag(by_files), df), (np.array([by_level, 0.0]), level.size - 1), (np.diag(by_curve), curve.df))
    return Stiffness(
        sigma_0=float(np.exp(found.x[0] + level.mean())),
        tau_s=float(found.x[1]),
        covariance=by_files + np.diag([by_level, 0.0]) + by_curve,
        df=together(parts),
        gain=rises.gain_of(found.rss),
        within=rises.inside(float(np.exp(found.x[0])), levels, start_N),
        files=rises.files,
        forces_N=rises.forces(found.residual),
        noise_N=rises.noise_N(),
        rmse_N=float(np.sqrt(found.rss / found.residual.size)),
    )


def _one_step(jacobian: np.ndarray, residual: np.ndarray, x: np.ndarray, low: np.ndarray, high: np.ndarray):
    """Return where one Gauss-Newton step leads, shape (p,); what it would carry over a bound is held there."""
    step, free = np.zeros(x.size), np.ones(x.size, bool)
    for _ in range(x.size):
        step[free] = np.linalg.lstsq(jacobian[:, free], -residual - jacobian @ np.where(free, 0.0, step), rcond=1e-12)[
            0
        ]
        over = free & ((x + step < low) | (x + step > high))
        if not over.any():
            break
        step[over], free = (np.clip(x + step, low, high) - x)[over], free & ~over
    return x + step


def together(parts: Sequence[tuple[np.ndarray, np.ndarray | int]]) -> np.ndarray:
    """Return the degrees of freedom of sums of variances (Welch and Satterthwaite), shape (p,)."""
    total = sum(variance for variance, _ in parts)
    spread = sum(variance**2 / np.maximum(df, 1) for variance, df in parts)
    return total**2 / np.maximum(spread, 1e-300)


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
