"""Type A: how far repeats of a run scatter, as a function of the force, pooled over runs.

Three repeats say next to nothing about their own scatter, so it is pooled over runs (GUM 4.2.4; ISO 5725-2,
7.5: sr as a function of the level m), as sd^2 = s0^2 + (g F)^2. What all repeats have in common from first to
last (run-in, Mullins) is no scatter and is taken out before. The sensor's accuracy (type B) is shared by all
repeats, so it is not in their scatter and is kept apart (`config.sensor`).
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
import pandas as pd

ALIKE = 1e-12  # square of the spread of x over that of its size, below which x is a constant
PATTERN_RUNS = 3  # with fewer runs a common pattern of their repeats cannot be told from the scatter itself


@dataclass(frozen=True, slots=True)
class RepeatScatter:
    """Standard deviation of a repeat about its run: `sd_N(force) = sqrt(s0_N^2 + (g |force|)^2)`, with `df`.

    With no repeats at all `df` is 0 and `s0_N` and `g` are NaN.
    """

    s0_N: float
    g: float
    df: float

    def sd_N(self, force_N: np.ndarray | float) -> np.ndarray:
        """Return the standard deviation of one repeat's mean force, in N, at `force_N`, shape (n,)."""
        return np.sqrt(self.s0_N**2 + (self.g * np.asarray(force_N, float)) ** 2)


def repeat_means(steady: pd.DataFrame) -> pd.DataFrame:
    """Return one row per file and run: `file`, `run_id`, `repeat`, `force_N` (size of its strokes' mean).

    The strokes of a file share its set-up, so its mean is repeated. Rows with `used` false are left out.
    """
    rows = steady[steady["used"].to_numpy(bool)] if "used" in steady.columns else steady
    grouped = rows.groupby(["run_id", "repeat"], sort=True, observed=True)
    means = grouped.agg(file=("file", "first"), force_N=("force_N", "mean")).reset_index()
    return means.assign(force_N=means["force_N"].abs())[["file", "run_id", "repeat", "force_N"]]


def repeat_scatter(steady: pd.DataFrame) -> RepeatScatter:
    """Return the scatter of repeats within their runs, pooled over runs, as a function of the force.

    s0 is in the force's unit, g without unit. Maximum likelihood of the run variances, s_r^2 ~ sd^2(F_r)
    chi^2(n_r - 1) / (n_r - 1), with s0^2 and g^2 not below zero: weighted least squares of s_r^2 on [1,
    F_r^2], weights renewed until they stay (Fisher scoring). The common pattern of the repeats costs one
    degree of freedom per repeat number but one.
    """
    means = repeat_means(steady)
    force_N, kept = means["force_N"].to_numpy(float), np.ones(len(means), bool)
    return fit_scatter(RepeatCodes.of(means), force_N, kept).scatter


@dataclass(frozen=True, slots=True)
class RepeatCodes:
    """Run and repeat number of every row, as codes."""

    run: np.ndarray
    runs: int
    repeat: np.ndarray
    repeats: int

    @classmethod
    def of(cls, means: pd.DataFrame) -> Self:
        """Return the layout of a table as `repeat_means` returns it."""
        run, names = pd.factorize(means["run_id"])
        repeat, numbers = pd.factorize(means["repeat"], sort=True)
        return cls(run, len(names), repeat, len(numbers))


@dataclass(frozen=True, slots=True)
class ScatterFit:
    """Scatter of the rows kept, and where every row lies by it; arrays of one length."""

    scatter: RepeatScatter
    covariance: np.ndarray  # of s0^2 and g^2, shape (2, 2)
    mean: np.ndarray  # of the run, per row, pattern removed
    residual: np.ndarray
    share: np.ndarray  # of its variance that a residual keeps: 1 - 1/n of its run
    t: np.ndarray

    def df_at(self, force_N: float) -> float:
        """Return the degrees of freedom of the variance at this force, at most those of all runs.

        Welch-Satterthwaite: a variance with standard error u has 2 variance^2 / u^2 (GUM, G.4.1).
        """
        at = np.array([1.0, force_N**2])
        spread = float(at @ self.covariance @ at)
        variance = float(self.scatter.sd_N(force_N)) ** 2
        return min(self.scatter.df, 2.0 * variance**2 / spread) if spread > 0.0 else self.scatter.df


def fit_scatter(layout: RepeatCodes, force_N: np.ndarray, kept: np.ndarray) -> ScatterFit:
    """Fit run means, the pattern and the scatter to the rows kept; residuals of every row."""
    count = np.bincount(layout.run[kept], minlength=layout.runs).astype(float)
    pattern, cost = np.zeros(layout.repeats), 0
    flat = force_N
    s0_2, g_2, covariance = _variance(layout, flat, kept, count, 0)
    repeated = count[layout.run] > 1
    present = np.bincount(layout.repeat[kept & repeated], minlength=layout.repeats) >= PATTERN_RUNS
    if present.sum() >= 2 and (count > 1).sum() >= PATTERN_RUNS:
        cost = int(present.sum()) - 1
        for _ in range(3):  # weights of the pattern and the scatter need each other; both settle at once
            pattern = _pattern(layout, force_N, kept & repeated, present, s0_2, g_2)
            flat = force_N / (1.0 + pattern[layout.repeat])
            s0_2, g_2, covariance = _variance(layout, flat, kept, count, cost)
    mean = _run_mean(layout, flat, kept, count)[layout.run]
    residual = flat - mean
    share = np.where(count[layout.run] > 1, 1.0 - 1.0 / np.maximum(count[layout.run], 1.0), 0.0)
    df = max(float(np.maximum(count - 1.0, 0.0).sum()) - cost, 0.0)
    scatter = RepeatScatter(float(np.sqrt(s0_2)), float(np.sqrt(g_2)), df)
    sd = scatter.sd_N(mean)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(share > 0.0, residual / (sd * np.sqrt(np.where(share > 0.0, share, 1.0))), 0.0)
    t[np.isnan(t)] = 0.0
    return ScatterFit(scatter, covariance, mean, residual, share, t)


def _run_mean(layout: RepeatCodes, values: np.ndarray, kept: np.ndarray, count: np.ndarray) -> np.ndarray:
    total = np.bincount(layout.run[kept], values[kept], minlength=layout.runs)
    return np.divide(total, count, out=np.full(layout.runs, np.nan), where=count > 0)


def _pattern(
    layout: RepeatCodes, force_N: np.ndarray, rows: np.ndarray, present: np.ndarray, s0_2: float, g_2: float
) -> np.ndarray:
    """Return per repeat number the relative change that all runs share, from log F = run + repeat."""
    log_force = np.log(np.maximum(force_N, 1e-300))
    good = rows & present[layout.repeat] & (force_N > 0.0)
    weight = np.where(good, force_N**2 / np.maximum(s0_2 + g_2 * force_N**2, 1e-300), 0.0)
    change = np.zeros(len(present))
    per_run = np.bincount(layout.run, weight, minlength=layout.runs)
    per_number = np.bincount(layout.repeat, weight, minlength=len(present))
    if not per_number.any():
        return change
    # Normal equations of the numbers after the runs are eliminated: small, as many as there are repeats.
    cell = layout.run * len(present) + layout.repeat
    cross = np.bincount(cell, weight, minlength=layout.runs * len(present)).reshape(layout.runs, len(present))
    scaled = np.divide(cross, per_run[:, None], out=np.zeros_like(cross), where=per_run[:, None] > 0)
    sums = np.bincount(layout.run, weight * log_force, minlength=layout.runs)
    run_mean = np.divide(sums, per_run, out=np.zeros(layout.runs), where=per_run > 0)
    left = np.diag(per_number) - cross.T @ scaled
    right = np.bincount(layout.repeat, weight * (log_force - run_mean[layout.run]), minlength=len(present))
    change = np.linalg.lstsq(left, right, rcond=1e-10)[0]
    change = np.where(present, change - change[present].mean(), 0.0)
    return np.expm1(change)


def _variance(
    layout: RepeatCodes, flat: np.ndarray, kept: np.ndarray, count: np.ndarray, cost: int
) -> tuple[float, float, np.ndarray]:
    """Return s0^2 and g^2 of the rows kept, and their covariance; `flat` is the force without the pattern."""
    none = np.zeros((2, 2))
    mean = _run_mean(layout, flat, kept, count)
    square = np.bincount(layout.run[kept], (flat[kept] - mean[layout.run[kept]]) ** 2, minlength=layout.runs)
    repeated = count > 1
    df = count[repeated] - 1.0
    if not repeated.any():
        return float("nan"), float("nan"), none
    left = max(df.sum() - cost, 1.0) / df.sum()  # what the pattern took out of the squares
    variance = square[repeated] / (df * left)
    force2 = mean[repeated] ** 2
    pooled = float((df * variance).sum() / df.sum())
    if pooled == 0.0:
        return 0.0, 0.0, none
    if len(df) < PATTERN_RUNS or np.ptp(force2) < 0.25 * force2.max():
        return pooled, 0.0, none  # forces too much alike to tell the two parts apart
    expected = np.full(len(df), pooled)
    a = b = 0.0
    for _ in range(50):
        before = expected
        a, b = two_nonnegative(force2, variance, df / expected**2)
        # A run whose own variance is near zero must not take all the weight.
        expected = np.maximum(a + b * force2, 0.01 * pooled)
        if np.abs(expected - before).max() < 1e-6 * pooled:
            break
    weight = 0.5 * df * left / expected**2  # var(s^2) = 2 sigma^4 / df
    design = np.stack([np.ones(len(df)), force2], axis=1)
    return float(a), float(b), np.linalg.inv(design.T @ (design * weight[:, None]))


def two_nonnegative(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Return a, b >= 0 of the weighted least squares y = a + b x, exactly; b = 0 where x does not vary.

    x is >= 0, the weight is 1/variance up to a factor; all are of shape (n,).
    """
    w, wx, wy, wxx, wxy = weight.sum(), weight @ x, weight @ y, weight @ (x * x), weight @ (x * y)
    determinant = w * wxx - wx * wx
    if determinant <= ALIKE * w * wxx:
        return wy / w, 0.0
    a, b = (wxx * wy - wx * wxy) / determinant, (w * wxy - wx * wy) / determinant
    if a >= 0.0 and b >= 0.0:
        return a, b
    only_a, only_b = wy / w, wxy / wxx
    loss = [((y - only_a) ** 2 * weight).sum(), ((y - only_b * x) ** 2 * weight).sum()]
    return (only_a, 0.0) if loss[0] <= loss[1] else (0.0, only_b)
