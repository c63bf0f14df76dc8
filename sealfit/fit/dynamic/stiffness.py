r"""sigma_0 and sigma_1 from the pre-sliding part of traces: one pair for the strokes of a condition.

Over a stroke the bristles' force :math:`B = \sigma_0 z` follows Eqs. 2 and 6 exactly, step by step of the
distance x,

.. math::
    \frac{dB}{dx} = \sigma_0 \Big(1 - \frac{B}{G}\Big), \quad F = B + \tau \dot B + \sigma_2 v, \quad
    G = N [\mu_c + (\mu_s - \mu_c) e^{-(v/v_s)^2}], \quad \tau = \sigma_1 / \sigma_0,

with the Stribeck curve G of the condition's steady fit. B is linear in its initial value. Each stroke has two
linear parameters, its level and its initial bristle force (0, or negative after a reversal), which are solved
for exactly. sigma_0 and tau are searched on a grid and refined (Golub and Pereyra 1973, SIAM J. Numer. Anal.
10(2), 413-432, doi:10.1137/0710036). The rise determines the length G / sigma_0; its unit of evidence is the
file, as neighbouring samples are correlated. The level of the strokes converts it to a stiffness; its unit of
evidence is the run, as a set-up shifts all files of a run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from sealfit.fit.dynamic.bristle_model import Curve, Rises, Stroke, Tangent
from sealfit.fit.joint.search import least_squares_within
from sealfit.fit.least_squares import levenberg_marquardt

# Number of samples inside the rise that an estimate needs.
LEAST = 3
# Fall of the sum of squares by the rise, in residual variances, that an estimate needs.
RISES = 30.0
# A fit disagrees with the data if its RMS residual exceeds these multiples of the noise and of the sliding
# force.
MISSED_NOISE, MISSED_LEVEL = 2.0, 0.03
# Half-width of the 95 % interval of log sigma_0 from which sigma_0 is not determined.
OPEN = np.log(3.0)


@dataclass(frozen=True)
class Stiffness:
    """sigma_0 in N/mm and tau = sigma_1 / sigma_0 in s, with their scatter between units."""

    sigma_0: float
    tau_s: float
    covariance: np.ndarray  # (2, 2) of log sigma_0 and tau; NaN from fewer than two units
    df: np.ndarray  # (2,) Satterthwaite's degrees of freedom of the two
    within: int  # samples inside the rise
    gain: float  # rise of the sum of squares, in residual variances, for a force constant from the start
    files: int
    forces_N: tuple[np.ndarray, ...]  # (n,) each: fitted force of every stroke
    rmse_N: float  # RMS residual
    noise_N: float  # standard deviation of a sample, from second differences

    @property
    def seen(self) -> bool:
        """Whether the samples resolve the rise."""
        return self.within >= LEAST and self.gain > RISES

    def misses(self, level_N: float) -> bool:
        """Return whether the residual exceeds noise and is not small relative to a sliding force."""
        return self.rmse_N > MISSED_NOISE * self.noise_N and self.rmse_N > MISSED_LEVEL * level_N

    @property
    def quantile(self) -> np.ndarray:
        """Student's quantile of the 95 % intervals of the two, shape (2,)."""
        return stdtrit(np.maximum(self.df, 1.0), 0.975)

    def log_half_width(self) -> float:
        """Return half of the 95 % interval of log sigma_0."""
        return float(self.quantile[0] * np.sqrt(self.covariance[0, 0]))

    @property
    def stiffness_known(self) -> bool:
        """Whether sigma_0 is determined."""
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
    """Return sigma_0 and tau of the strokes of a condition; None without strokes.

    `strokes` are all that start at rest or at a reversal, and `curve` is the condition's Stribeck curve.
    """
    if not strokes:
        return None
    rises = Rises(strokes, curve)
    x, (least, most) = rises.best_of_grid()
    bounds = np.array([[least - 1.0, 0.0], [most + 1.0, np.inf]])

    def evaluate(x: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = rises.tangent(x[0])
        return at.residual.reshape(1, -1), at.jacobian.reshape(1, 2, -1)

    x = levenberg_marquardt(evaluate, x[None], *bounds)[0][0]
    found = rises.tangent(x)
    level = rises.run_levels(found.level)
    inverse = np.linalg.pinv(found.normal.sum(axis=0), rcond=1e-12, hermitian=True)
    shifts = []
    for other in (Rises(strokes, moved) for moved in curve.moved()):
        pull = np.einsum("ikr,kr->i", found.jacobian, other.tangent(x).residual)
        at = x + _step(found.normal.sum(axis=0), pull, *(bounds - x))
        shifts.append(at - x + [other.run_levels(other.tangent(at).level).mean() - level.mean(), 0.0])
    by_files, df = _between_files(found, inverse, rises.file)
    by_level = float(level.var(ddof=1) / level.size) if level.size > 1 else np.nan
    by_curve = np.array(shifts).T @ np.array(shifts) if shifts else np.zeros((2, 2))
    parts = (
        (np.diag(by_files), df),
        (np.array([by_level, 0.0]), level.size - 1),
        (np.diag(by_curve), curve.df),
    )
    return Stiffness(
        sigma_0=float(np.exp(x[0] + level.mean())),
        tau_s=float(x[1]),
        covariance=by_files + np.diag([by_level, 0.0]) + by_curve,
        df=together(parts),
        gain=rises.gain_of(found.rss),
        within=rises.inside(float(np.exp(x[0])), found.level, found.begin),
        files=int(rises.file.max()) + 1,
        forces_N=rises.forces(found.residual),
        noise_N=rises.noise_N(),
        rmse_N=float(np.sqrt(found.rss / rises.there.sum())),
    )


def _step(normal: np.ndarray, pull: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return a Gauss-Newton step within bounds from J'J and J'r, shape (p,)."""
    scale = np.sqrt(np.diag(normal))
    scale = np.where(scale > 0, scale, 1.0)
    scaled = normal / np.outer(scale, scale)
    return least_squares_within(scaled, -pull / scale, low * scale, high * scale) / scale


def together(parts: Sequence[tuple[np.ndarray, np.ndarray | int]]) -> np.ndarray:
    """Return the degrees of freedom of sums of variances (Welch-Satterthwaite), shape (p,)."""
    total = sum(variance for variance, _ in parts)
    spread = sum(variance**2 / np.maximum(df, 1) for variance, df in parts)
    return total**2 / np.maximum(spread, 1e-300)


def _between_files(found: Tangent, inverse: np.ndarray, file: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the cluster-robust covariance of estimates, shape (p, p), and degrees of freedom, shape (p,).

    It is the jackknife over files (CR3). The degrees of freedom depend on the leverages of the files.
    `inverse` is that of J'J, and `file`, shape (strokes,), the number of each stroke's file.
    """
    files, p = int(file.max()) + 1, len(inverse)
    if files < 2:
        return np.full((p, p), np.nan), np.ones(p)
    own, pull = np.zeros((files, p, p)), np.zeros((files, p))
    np.add.at(own, file, found.normal)
    np.add.at(pull, file, found.pull)
    left = np.eye(p) - own @ inverse
    moved = (inverse @ np.linalg.pinv(left, rcond=1e-9) @ pull[..., None])[..., 0]
    covariance = (files - 1) / files * moved.T @ moved
    information = np.einsum("pq,kqr,rp->kp", inverse, own, inverse) / np.maximum(np.diag(inverse), 1e-300)
    df = 1 / np.maximum((information**2).sum(axis=0), 1e-12) - 1
    return covariance, df
