r"""What happens before steady sliding: sigma_0, sigma_1 and the break-away force.

One pair of sigma_0 and sigma_1 is fitted to the pre-sliding part of the strokes of a condition. Over a stroke
the bristles' force :math:`B = \sigma_0 z` follows Eqs. 2 and 6 exactly, step by step of the distance x,

.. math::
    \frac{dB}{dx} = \sigma_0 \Big(1 - \frac{B}{G}\Big), \quad F = B + \tau \dot B + \sigma_2 v, \quad
    G = N [\mu_c + (\mu_s - \mu_c) e^{-(v/v_s)^2}], \quad \tau = \sigma_1 / \sigma_0,

with the Stribeck curve G of the condition's steady fit. Each stroke has two linear parameters, its level and
its initial bristle force (0, or negative after a reversal), which are solved for exactly. sigma_0 and tau are
searched on a grid and refined (Golub and Pereyra 1973, SIAM J. Numer. Anal. 10(2), 413-432,
doi:10.1137/0710036). The unit of evidence of the length of the rise, G / sigma_0, is the file, as
neighbouring samples are correlated; that of the level of the strokes is the run, as a set-up shifts all files
of a run.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.ndimage import convolve1d
from scipy.special import stdtrit

from sealfit.config import Config
from sealfit.fit.dynamic.bristle_model import BristleTangent, Cells, Rises, RisingStroke, StribeckCurve
from sealfit.fit.joint.search import least_squares_within
from sealfit.fit.least_squares import levenberg_marquardt, t_quantile

# Number of samples inside the rise that an estimate needs.
LEAST = 3
# Fall of the sum of squares by the rise, in residual variances, that an estimate needs.
RISES = 30.0
# A fit disagrees with the data if its RMS residual exceeds these multiples of noise and sliding force.
MISSED_NOISE, MISSED_LEVEL = 2.0, 0.03
# Half-width of the 95 % interval of log sigma_0 from which sigma_0 is not determined.
OPEN = np.log(3.0)

# Window over which a peak is averaged, the larger of a number of samples and a share of the distance.
SAMPLES, SHARE = 8, 1 / 40
# Family-wise error rate of the test for a peak in a campaign.
FAMILY = 0.01

FORCE, RATIO, SLIDING = "F_ba", "F_ba/F", "F"
TOP, NOISE, PLACES, WHERE, REACH = "top", "noise", "places", "where", "reach"
AT = ["condition", "speed_set_mm_s", "direction"]
LARGEST = "F_max/F"
INTO = "{where:.3g} {unit} into strokes of {reach:.3g} {unit}"
NO_PEAK = "the force comes up to its sliding value without passing above it"
FEW = "no repeats: no scatter is known"


@dataclass(frozen=True)
class Stiffness:
    """sigma_0 in N/mm and tau = sigma_1 / sigma_0 in s; tau is NaN if the damping is not distinguishable."""

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
        return t_quantile(np.maximum(self.df, 1.0))

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


def fit_stiffness(strokes: Sequence[RisingStroke], curve: StribeckCurve) -> Stiffness | None:
    """Return sigma_0 and tau of all strokes of a condition that start at rest or a reversal; None without."""
    if not strokes:
        return None
    rises = Rises(strokes, curve)
    x, bounds = rises.best_of_grid()
    damped = bool(bounds[1, 1] > 0)

    def evaluate(x: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = rises.tangent(x[0])
        return at.residual.reshape(1, -1), at.jacobian.reshape(1, 2, -1)

    x = levenberg_marquardt(evaluate, x[None], *bounds)[0][0]
    found = rises.tangent(x)
    found = found if damped else replace(found, jacobian=found.jacobian * [[[1.0]], [[0.0]]])
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
    level_variance = np.array([by_level, 0.0])
    parts = (np.diag(by_files), df), (level_variance, level.size - 1), (np.diag(by_curve), curve.df)
    return Stiffness(
        sigma_0=float(np.exp(x[0] + level.mean())),
        tau_s=float(x[1]) if damped else np.nan,
        covariance=by_files + np.diag(level_variance) + by_curve,
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


def _between_files(
    found: BristleTangent, inverse: np.ndarray, file: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
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


def peaks(cells: Cells, file: np.ndarray) -> pd.DataFrame:
    """Return the break-away force F_ba and its ratio to the sliding force, per unit of evidence.

    A unit is a file, or a stroke of a single file; `file`, shape (n,), is the number of the file in each row
    of table `steady`. The sliding force is extrapolated to the peak along the line through the beginning of
    steady sliding, so that warming along the stroke does not count as break-away. The position of the peak is
    taken from the mean of the other units, and the force of a start is read there, as the maximum of noisy
    samples is biased. For the test for a peak, `top` is the force above sliding where the mean of all units
    is largest, `noise` its standard error in units of that of a sample, and `places` the number of positions;
    `F` is the sliding force.

    The table has one row per unit; units with an unknown value are left out.
    """
    half = int(np.ceil(cells.count * max(SAMPLES / cells.samples, SHARE) / 2))  # of the window, in cells
    lines = np.array([part.sliding for part in cells.parts], float)
    mean_N, middle, slope, samples, extent = lines.T
    sliding = mean_N[:, None] + slope[:, None] * (cells.middle_mm - middle[:, None])
    there = np.isfinite(cells.force_N)
    total, hits, above = (
        convolve1d(np.where(there, values, 0.0), np.ones(2 * half + 1), axis=1, mode="constant")
        for values in (cells.force_N, 1.0, cells.force_N - sliding)
    )
    mean = np.where(hits > 0, total / np.maximum(hits, 1), np.nan)
    file = file[[part.row for part in cells.parts]]
    several = (file != file[0]).any()
    unit = np.unique(file, return_inverse=True)[1] if several else np.arange(len(file))
    whole = _highest(above, hits)
    rows = []
    for members in (np.flatnonzero(unit == number) for number in range(unit.max() + 1)):
        others = np.delete(np.arange(len(unit)), members)
        at = _highest(above[others], hits[others]) if others.size else whole
        peak, line = mean[members, at], sliding[members, at]
        both = (peak > 0.0) & (line > 0.0)
        away = (cells.middle_mm[whole] - middle[members]) / np.maximum(extent[members], 1e-300)
        error = np.sqrt(1 / samples[members] + away**2)  # of the line, in standard deviations of a sample
        inside = np.maximum(hits[members, whole] * cells.samples / cells.count, 1.0)  # samples in the window
        row = {
            FORCE: peak[peak > 0.0],
            RATIO: peak[both] / line[both],
            SLIDING: mean_N[members][mean_N[members] > 0.0],
            TOP: mean[members, whole] - sliding[members, whole],
            NOISE: np.hypot(error, 1 / np.sqrt(inside)),
            PLACES: max(cells.count / (2 * half + 1), 1.0),
            WHERE: cells.middle_mm[whole],
            REACH: cells.reach_mm,
        }
        rows.append({name: _mean_of(np.atleast_1d(values)) for name, values in row.items()})
    return pd.DataFrame(rows).dropna(ignore_index=True)


def _highest(above: np.ndarray, hits: np.ndarray) -> int:
    """Return the cell in which the mean force above sliding of strokes is largest.

    `above` and `hits`, shape (strokes, cells), are the sum of the force above sliding over a window about
    each cell, and the number of cells in the sum.
    """
    total, count = above.sum(axis=0), hits.sum(axis=0)
    sure = count > count.max() / 2  # means of fewer cells are too noisy
    return int(np.argmax(np.where(sure, total / np.maximum(count, 1), -np.inf)))


def _mean_of(values: np.ndarray) -> float:
    """Return the mean of the known values; NaN if there is none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else np.nan


def break_away_rows(found: pd.DataFrame, widened: tuple[float, float], config: Config) -> pd.DataFrame:
    """Return rows of table `dynamic_fit` for all break-aways of a campaign, from the result of `peaks`.

    The scatter of repeats is pooled within a condition: for the force relative to it, for the ratio as the
    force above sliding over its noise, as other errors cancel in the ratio. The variance of the force
    includes set-up scatter: `widened` is the ratio of the variance of run means to that expected from
    repeats, and its degrees of freedom. There is a peak if the largest mean exceeds the sliding force in a
    t-test at 1 % for all positions of all starts of the campaign (Bonferroni). Else `reason` says so, without
    an interval.
    """
    logs = {name: np.log(found[name]) for name in (FORCE, RATIO, SLIDING)}
    shares = {
        FORCE: logs[FORCE],
        SLIDING: logs[SLIDING],
        RATIO: found[FORCE] * (1 - 1 / found[RATIO]) / found[NOISE],
        TOP: found[TOP] / found[NOISE],
    }
    groups = [found[name] for name in AT]
    spread, df = _pooled(pd.DataFrame(shares), groups)
    table = pd.DataFrame({name: found[name] for name in (FORCE, TOP, NOISE, PLACES)})
    table = table.assign(**{f"log {name}": logs[name] for name in (FORCE, RATIO)})
    table = table.groupby(groups, dropna=False, sort=False)
    n, places, mean = table.size().to_numpy(), float(table[PLACES].first().sum()), table.mean()
    setup = max(widened[0] - 1, 0.0) * spread[SLIDING] ** 2
    error = spread[TOP] * mean[NOISE].to_numpy() / np.sqrt(n)
    at_least = -stdtrit(np.maximum(df, 1), FAMILY / max(places, 1.0))
    peak = (df >= 1) & (mean[TOP].to_numpy() > at_least * error)
    reason = np.where(peak, "", np.where(df >= 1, NO_PEAK, FEW))
    above = spread[RATIO] * mean[NOISE].to_numpy() / mean[FORCE].to_numpy()
    force_df = together(((spread[FORCE] ** 2, df), (setup, widened[1])))
    both = []
    for name, unit, u_sys, variance, error_df in (
        (FORCE, config.units.unit("force"), config.sensor.u, spread[FORCE] ** 2 + setup, force_df),
        (RATIO, "", np.nan, above**2, df),
    ):
        value = np.exp(mean[f"log {name}"].to_numpy())
        error = np.where(peak, np.sqrt(variance / n), np.nan)
        half = t_quantile(error_df) * error
        row = {"quantity": "break_away", "parameter": name, "value": value, "se": value * error}
        row |= {"lo95": value * np.exp(-half), "hi95": value * np.exp(half), "u_sys": u_sys, "unit": unit}
        both.append(pd.DataFrame({**row, "identified": peak, "reason": reason}))
    keys = mean.index.to_frame(index=False)
    rows = pd.concat([one.join(keys) for one in both])
    return rows.sort_index(kind="stable", ignore_index=True)  # the two rows of a group are adjacent


def largest_rows(found: pd.DataFrame, config: Config) -> pd.DataFrame:
    """Return rows of table `dynamic_fit` for the largest force in whole strokes over their sliding force.

    It may be at the end of a stroke; `reason` has its position. `found` is the result of `peaks`.
    """
    groups = found.assign(**{RATIO: np.log(found[RATIO])}).groupby(AT, dropna=False, sort=False)
    table = groups.agg({RATIO: "mean", WHERE: "first", REACH: "first"}).reset_index()
    unit = config.units.unit("displacement")
    places = zip(table[WHERE], table[REACH], strict=True)
    reason = [INTO.format(where=where, reach=reach, unit=unit) for where, reach in places]
    row = {"quantity": "largest", "parameter": LARGEST, "value": np.exp(table[RATIO]), "unit": ""}
    return table[AT].assign(**row, identified=True, reason=reason)


def _pooled(values: pd.DataFrame, groups: Sequence[pd.Series]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return standard deviations in groups, pooled by first key, and degrees of freedom, (groups,) each."""
    away = values - values.groupby(groups, dropna=False, sort=False).transform("mean")
    pool, size = groups[0], values.groupby(groups, dropna=False, sort=False).size()
    squares = (away**2).groupby(pool, sort=False).sum()
    df = size.groupby(level=0, sort=False).agg(lambda n: int((n - 1).sum()))
    own = size.index.get_level_values(0)
    squares, df = squares.loc[own], df.loc[own].to_numpy()
    return {
        name: np.sqrt(np.divide(squares[name].to_numpy(), df, out=np.full(len(df), np.nan), where=df > 0))
        for name in values
    }, df
