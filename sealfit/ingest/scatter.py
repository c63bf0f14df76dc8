"""Type A: how far repeats of a run scatter, as a function of the force, pooled over runs; and repeats that lie outside.

Three repeats say next to nothing about their own scatter: of a standard deviation with two degrees of freedom, the 95 %
interval spans a factor of twelve. Scatter is therefore pooled over runs (GUM 4.2.4; ISO 5725-2, 7.5: sr as a function
of the level m), as sd^2 = s0^2 + (g F)^2: a part that every run has, and a part in proportion to the force. What all
repeats have in common from first to last (run-in, Mullins) is no scatter and is taken out before. The sensor's
accuracy (type B) is one unknown that all repeats share, so it is not in their scatter and is kept apart
(`config.sensor`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

PATTERN_RUNS = 3  # fewer runs cannot tell a common pattern of their repeats from the scatter itself
MAX_OUTLIERS = 0.1  # share of repeats that the search takes out at most: beyond that the bulk is not known


@dataclass(frozen=True, slots=True)
class Scatter:
    """Standard deviation of a repeat about its run: `sd_N(force) = sqrt(s0_N^2 + (g |force|)^2)`, with `df`.

    `pattern` holds, per repeat number, the share by which repeats of that number differ from their runs' means. With no
    repeats at all `df` is 0 and `s0_N` and `g` are NaN.
    """

    s0_N: float
    g: float
    df: float
    pattern: dict[int, float]

    def sd_N(self, force_N: np.ndarray | float) -> np.ndarray:
        """Return the standard deviation of one repeat's mean force, in N, at `force_N`, shape (n,)."""
        return np.sqrt(self.s0_N**2 + (self.g * np.asarray(force_N, float)) ** 2)


def repeat_means(steady: pd.DataFrame) -> pd.DataFrame:
    """Return one row per file and run: `file`, `run_id`, `repeat`, `force_N` (size of its strokes' mean force).

    The strokes of a file share its set-up; its mean is the unit that is repeated. Rows with `used` false are left out.
    """
    rows = steady[steady["used"].to_numpy(bool)] if "used" in steady.columns else steady
    if not len(rows):
        return pd.DataFrame({"file": [], "run_id": [], "repeat": np.array([], int), "force_N": np.array([], float)})
    means = rows.groupby(["run_id", "repeat", "file"], sort=True, observed=True)["force_N"].mean().abs()
    return means.reset_index()[["file", "run_id", "repeat", "force_N"]]


def repeat_scatter(steady: pd.DataFrame) -> Scatter:
    """Return the scatter of repeats within their runs, pooled over runs, as a function of the force.

    Parameters
    ----------
    steady : DataFrame
        Table `steady` (file, run_id, repeat, force_N, and `used` if it has it).

    Returns
    -------
    Scatter
        s0 in the force's unit, g without unit, and the degrees of freedom they rest on.

    Notes
    -----
    Maximum likelihood of the run variances, s_r^2 ~ sd^2(F_r) chi^2(n_r - 1) / (n_r - 1), with s0^2 and g^2 not below
    zero: weighted least squares of s_r^2 on [1, F_r^2], weights renewed until they stay (Fisher scoring). The common
    pattern of the repeats costs one degree of freedom per repeat number but one.
    """
    means = repeat_means(steady)
    return _fit(_Layout.of(means), means["force_N"].to_numpy(float), np.ones(len(means), bool)).scatter


def outlying_repeats(means: pd.DataFrame, level: float) -> pd.DataFrame:
    """Return the repeats that disagree with their runs beyond the pooled scatter.

    Parameters
    ----------
    means : DataFrame
        As `repeat_means` returns it.
    level : float
        Chance that any repeat at all is flagged in a campaign without outliers.

    Returns
    -------
    DataFrame
        Rows of `means` with `run_mean_N` (the run's mean without it), `t`, `p` (adjusted over the campaign) and
        `alone` (true where two repeats disagree and which of them is wrong cannot be known: both are returned).

    Notes
    -----
    The generalized extreme studentized deviate procedure (Rosner 1983, Technometrics 25(2), 165-172,
    doi:10.1080/00401706.1983.10487848), on residuals within runs: the most extreme repeat is taken out, scatter and
    pattern are estimated without it, and so on; the outliers are those up to the last one that exceeds its limit. So
    neither does an outlier widen the scale it is judged by, nor do two hide each other. The limit is Sidak's for
    the repeats left, on Student's t with the pooled degrees of freedom.
    """
    layout = _Layout.of(means)
    force = means["force_N"].to_numpy(float)
    kept = np.ones(len(means), bool)
    tiny = 1e-6 * float(np.max(np.abs(force), initial=0.0)) + 1e-300  # repeats that agree to the last digit
    found: list[tuple[np.ndarray, float, float, float]] = []
    last = 0
    for _ in range(max(1, int(MAX_OUTLIERS * len(means)))):
        fit = _fit(layout, force, kept)
        candidates = kept & (fit.share > 1e-9)
        if fit.scatter.df < 4 or not candidates.any():
            break
        size = np.where(candidates, np.abs(fit.t), -1.0)
        worst = int(np.argmax(size))
        together = np.flatnonzero(kept & (layout.run == layout.run[worst]))
        rows = together if len(together) == 2 else np.array([worst])
        without = kept.copy()
        without[rows] = False
        apart = _fit(layout, force, without)
        if apart.scatter.df < 3:
            break
        sd = max(float(apart.scatter.sd_N(fit.mean[worst])), tiny)
        t = float(fit.residual[worst] / (sd * np.sqrt(fit.share[worst])))
        tests = int(candidates.sum()) - (len(rows) - 1)
        p_one = 2.0 * stats.t.sf(abs(t), apart.df_at(float(fit.mean[worst])))
        p = float(-np.expm1(tests * np.log1p(-min(p_one, 1.0 - 1e-16))))
        found.append((rows, t, p, float(apart.mean[worst]) if len(rows) == 1 else float(fit.mean[worst])))
        if p < level:
            last = len(found)
        elif abs(t) < 3.0:  # nothing further out remains
            break
        kept = without
    parts = [
        means.iloc[rows].assign(run_mean_N=mean, t=t, p=p, alone=len(rows) == 2) for rows, t, p, mean in found[:last]
    ]
    empty = means.iloc[:0].assign(run_mean_N=0.0, t=0.0, p=0.0, alone=False)
    return pd.concat(parts) if parts else empty


@dataclass(frozen=True, slots=True)
class _Layout:
    """Run and repeat number of every row, as codes."""

    run: np.ndarray
    runs: int
    repeat: np.ndarray
    numbers: np.ndarray

    @classmethod
    def of(cls, means: pd.DataFrame) -> _Layout:
        run, names = pd.factorize(means["run_id"])
        repeat, numbers = pd.factorize(means["repeat"], sort=True)
        return cls(run, len(names), repeat, np.asarray(numbers))


@dataclass(frozen=True, slots=True)
class _Fit:
    scatter: Scatter
    covariance: np.ndarray  # of s0^2 and g^2, shape (2, 2)
    mean: np.ndarray  # of the run, per row, pattern removed
    residual: np.ndarray
    share: np.ndarray  # of its variance that a residual keeps: 1 - 1/n of its run
    t: np.ndarray

    def df_at(self, force_N: float) -> float:
        """Degrees of freedom of the variance at this force: those of all runs only where one number describes them all.

        Welch-Satterthwaite: a variance with standard error u has 2 variance^2 / u^2 (GUM, G.4.1).
        """
        at = np.array([1.0, force_N**2])
        spread = float(at @ self.covariance @ at)
        variance = float(self.scatter.sd_N(force_N)) ** 2
        return min(self.scatter.df, 2.0 * variance**2 / spread) if spread > 0.0 else self.scatter.df


def _fit(layout: _Layout, force_N: np.ndarray, kept: np.ndarray) -> _Fit:
    """Fit run means, the pattern and the scatter to the rows kept; residuals of every row."""
    count = np.bincount(layout.run[kept], minlength=layout.runs).astype(float)
    pattern, cost = np.zeros(len(layout.numbers)), 0
    s0_2, g_2, covariance = _variance(layout, force_N, kept, count, pattern, 0)
    repeated = count[layout.run] > 1
    present = np.bincount(layout.repeat[kept & repeated], minlength=len(layout.numbers)) >= PATTERN_RUNS
    if present.sum() >= 2 and (count > 1).sum() >= PATTERN_RUNS:
        cost = int(present.sum()) - 1
        for _ in range(3):  # weights of the pattern and the scatter need each other; both settle at once
            pattern = _pattern(layout, force_N, kept & repeated, present, s0_2, g_2)
            s0_2, g_2, covariance = _variance(layout, force_N, kept, count, pattern, cost)
    flat = force_N / (1.0 + pattern[layout.repeat])
    mean = _run_mean(layout, flat, kept, count)[layout.run]
    residual = flat - mean
    share = np.where(count[layout.run] > 1, 1.0 - 1.0 / np.maximum(count[layout.run], 1.0), 0.0)
    df = max(float(np.maximum(count - 1.0, 0.0).sum()) - cost, 0.0)
    named = {int(number): float(value) for number, value in zip(layout.numbers, pattern, strict=True)}
    scatter = Scatter(float(np.sqrt(s0_2)), float(np.sqrt(g_2)), df, named)
    sd = scatter.sd_N(mean)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(share > 0.0, residual / (sd * np.sqrt(np.where(share > 0.0, share, 1.0))), 0.0)
    return _Fit(scatter, covariance, mean, residual, share, np.nan_to_num(t, nan=0.0, posinf=np.inf, neginf=-np.inf))


def _run_mean(layout: _Layout, values: np.ndarray, kept: np.ndarray, count: np.ndarray) -> np.ndarray:
    total = np.bincount(layout.run[kept], values[kept], minlength=layout.runs)
    return np.divide(total, count, out=np.full(layout.runs, np.nan), where=count > 0)


def _pattern(
    layout: _Layout, force_N: np.ndarray, rows: np.ndarray, present: np.ndarray, s0_2: float, g_2: float
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
    cross = np.zeros((layout.runs, len(present)))
    np.add.at(cross, (layout.run, layout.repeat), weight)
    scaled = np.divide(cross, per_run[:, None], out=np.zeros_like(cross), where=per_run[:, None] > 0)
    sums = np.bincount(layout.run, weight * log_force, minlength=layout.runs)
    run_mean = np.divide(sums, per_run, out=np.zeros(layout.runs), where=per_run > 0)
    left = np.diag(per_number) - cross.T @ scaled
    right = np.bincount(layout.repeat, weight * (log_force - run_mean[layout.run]), minlength=len(present))
    change = np.linalg.lstsq(left, right, rcond=1e-10)[0]
    change = np.where(present, change - change[present].mean(), 0.0)
    return np.expm1(change)


def _variance(
    layout: _Layout, force_N: np.ndarray, kept: np.ndarray, count: np.ndarray, pattern: np.ndarray, cost: int
) -> tuple[float, float, np.ndarray]:
    """Return s0^2 and g^2 of the rows kept, and their covariance."""
    none = np.zeros((2, 2))
    flat = force_N / (1.0 + pattern[layout.repeat])
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
        a, b = _two_nonnegative(force2, variance, df / expected**2)
        # A run whose own variance is near zero must not take all the weight.
        expected = np.maximum(a + b * force2, 0.01 * pooled)
        if np.abs(expected - before).max() < 1e-6 * pooled:
            break
    weight = 0.5 * df * left / expected**2  # var(s^2) = 2 sigma^4 / df
    design = np.stack([np.ones(len(df)), force2], axis=1)
    return float(a), float(b), np.linalg.inv(design.T @ (design * weight[:, None]))


def _two_nonnegative(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Return a, b >= 0 of the weighted least squares y = a + b x."""
    w, wx, wy, wxx, wxy = weight.sum(), weight @ x, weight @ y, weight @ (x * x), weight @ (x * y)
    determinant = w * wxx - wx * wx
    if determinant > 0.0:
        a, b = (wxx * wy - wx * wxy) / determinant, (w * wxy - wx * wy) / determinant
        if a >= 0.0 and b >= 0.0:
            return a, b
    only_a, only_b = wy / w, wxy / wxx
    loss = [((y - only_a) ** 2 * weight).sum(), ((y - only_b * x) ** 2 * weight).sum()]
    return (only_a, 0.0) if loss[0] <= loss[1] else (0.0, only_b)
