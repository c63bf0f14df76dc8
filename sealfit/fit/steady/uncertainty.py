"""Run means, their variance from pooled repeats, and the Birge ratio of set-up scatter.

The unit of evidence is the run. Strokes of a file are averaged first, then the files (repeats) of a run. The
scatter of repeats, pooled over the campaign, gives the variance of each run mean. If run means disagree with
the model by more, because the rig is set up for each run or because the model lacks an effect, the intervals
are widened by the Birge ratio, the square root of the reduced chi-square.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.special import fdtrc

from sealfit.errors import FitError
from sealfit.fit.joint.rows import nesting_run, records
from sealfit.fit.least_squares import t_quantile
from sealfit.ingest.scatter import RepeatScatter
from sealfit.ingest.strokes import SPEEDS_APART, speed_clusters

# Level of the preliminary test for set-up scatter (Bancroft 1944). A level of 5 % would miss it too often.
POOLING_P = 0.25
# Level at which a condition with more lack of fit than the others is widened by its own ratio.
WORSE_P = 0.01
# Smallest standard deviation of a run mean, also of identical repeats, as a share of the largest force.
SMALLEST_SD = 1e-9
# Smallest force in a scatter proportional to the force, as a share of the largest force.
SMALLEST_SHARE = 0.05
# Share of a column's length below which it is a combination of other columns.
DEPENDENT = 1e-6
# Prefix of the columns of `steady_after` with the directions of the subtracted effects' uncertainty.
SHIFT = "effects_u"
# `direction` of a row that is the mean of both directions.
BOTH_DIRECTIONS = 0

NEEDED = (
    "condition", "series", "rubber", "run_id", "specimen_id", "file", "direction", "speed_mm_s", "load_N",
    "force_N", "used",
)  # fmt: skip


def merge_directions(steady: pd.DataFrame) -> pd.DataFrame:
    """Return used rows of table `steady` with one row per record for runs with both directions at one speed.

    Both directions are one unit of evidence; an offset between them cancels in their mean. In a merged row
    `direction` is 0, `force_N` and `speed_mm_s` are magnitudes, and `run_id` has no sign.
    """
    record = records(steady)
    rows = steady.assign(file=record)
    run = rows["run_id"].where(nesting_run(rows, record) == rows["run_id"], rows["run_id"].str.rstrip("+-"))
    pace = rows["speed_mm_s"].abs()
    if "speed_set_mm_s" in rows.columns:
        pace = rows["speed_set_mm_s"].abs().fillna(pace)
    extent = pd.DataFrame({"file": record, "run": run, "direction": rows["direction"], "pace": pace})
    grouped = extent.groupby(["file", "run"])
    merged = grouped["direction"].transform("nunique").eq(2)
    merged &= grouped["pace"].transform("max") <= SPEEDS_APART * grouped["pace"].transform("min")
    merged = merged.groupby(run).transform("all")
    # A file that lost its strokes of one direction would bring a zero offset into the fit.
    base = rows["run_id"].str.rstrip("+-")
    both, lone = (part.groupby(base).transform("sum") for part in (merged, ~merged))
    kept = merged | (2 * lone >= both)
    rows, run, merged = rows[kept], run[kept], merged[kept]
    if not merged.any():
        return rows
    size = {"force_N": rows["force_N"] * rows["direction"], "speed_mm_s": rows["speed_mm_s"].abs()}
    own = rows.assign(run_id=run, **size)[merged]
    numbers = [c for c in own.columns if pd.api.types.is_float_dtype(own[c])]
    keys = ["file", "run_id"]
    directions = own.groupby([*keys, "direction"], sort=False)[numbers].mean()
    means = own.drop(columns=numbers).groupby(keys, sort=False).first()
    means[numbers] = directions.groupby(level=keys, sort=False).mean()
    means = means.assign(direction=BOTH_DIRECTIONS)
    return pd.concat([rows[~merged], means.reset_index()[list(rows.columns)]], ignore_index=True)


def run_means(steady: pd.DataFrame) -> pd.DataFrame:
    """Return one row per condition, run and direction: mean of its files, each the mean of its strokes.

    The two directions of a file are merged. The columns are `condition`, `run_id`, `direction`, `speed`
    (|v|), `set` (commanded |v|) and `load`, NaN where unknown, `force` (F sgn v) and `files`, sorted by the
    first three; and the columns of `SHIFT`. FitError if a column is missing, no row is used, or a run has
    speed 0.
    """
    missing = [name for name in NEEDED if name not in steady.columns]
    if missing:
        raise FitError(f"table steady lacks {', '.join(missing)}.", fix="Run sealfit ingest again.")
    rows = steady[steady["used"].to_numpy(bool) & steady["condition"].notna().to_numpy()]
    if rows.empty:
        raise FitError("no steady window is left to fit.", fix="Look in table quality why each was left out.")
    rows = merge_directions(rows)
    commanded = rows["speed_set_mm_s"] if "speed_set_mm_s" in rows.columns else pd.Series(np.nan, rows.index)
    direction = rows["direction"].astype(int)
    numbers = rows[["condition", "run_id", "file"]].astype(object)
    numbers = numbers.assign(
        direction=direction,
        speed=rows["speed_mm_s"].astype(float).abs(),
        set=commanded.astype(float).abs(),
        load=rows["load_N"].astype(float),
        force=rows["force_N"].astype(float) * direction.replace(BOTH_DIRECTIONS, 1),
        **{name: rows[name].astype(float) for name in shifts_of(rows)},
    )
    keys = ["condition", "run_id", "direction"]
    per_file = numbers.groupby([*keys, "file"], sort=True).mean()
    grouped = per_file.groupby(level=keys, sort=True)
    specimen = rows["specimen_id"].astype(str).groupby([rows[key] for key in keys]).min()
    runs = grouped.mean().assign(files=grouped.size(), specimen=specimen).reset_index()
    bad = ~(runs["speed"] > 0) | ~np.isfinite(runs["force"])
    if bad.any():
        first = runs[bad].iloc[0]
        windows = f"speed {first['speed']:g} and force {first['force']:g} in its steady window."
        fix = "Leave it out of the campaign, or look at its steady window."
        raise FitError(f"run {first['run_id']} has {windows}", fix=fix)
    return runs


def shifts_of(table: pd.DataFrame) -> list[str]:
    """Return the names of the columns with the subtracted effects' uncertainty; none before the loop."""
    return [name for name in table.columns if str(name).startswith(SHIFT)]


def run_weights(runs: pd.DataFrame, scatter: RepeatScatter) -> np.ndarray:
    """Return 1/variance of run means, shape (n,), from the pooled scatter of repeats; without repeats 1."""
    if not scatter.df > 0:
        return np.ones(len(runs))
    force = runs["force"].abs().to_numpy(float)
    floor = SMALLEST_SD * float(force.max()) or 1.0
    return runs["files"].to_numpy(float) / np.maximum(scatter.sd_N(force), floor) ** 2


def more_likely(chi2: Sequence[float], weights: Sequence[np.ndarray], df: float) -> int:
    """Return the number of the most likely weights: the least n ln(chi2/df) - sum ln w, -2 log likelihood.

    `chi2` is the weighted sum of squares under each choice.
    """
    if not df > 0:
        return 0
    with np.errstate(divide="ignore"):
        both = zip(chi2, weights, strict=True)
        return int(np.argmin([len(w) * np.log(c / df) - np.log(w).sum() for c, w in both]))


def unit_variance(chi2, df, scatter, pure_df: float) -> pd.DataFrame:
    """Return the factors on the variances stated by the weights, from chi-square of every condition.

    The columns are `value`, the factor (Birge ratio squared); `df` of the intervals' Student t; `rise`, that
    of chi-square above its minimum at their ends; `f` and `p` of the lack of fit against pure error, NaN
    without repeats; and whether the condition has its `own` ratio. They are NaN if not determined.

    With repeats (`pure_df` > 0) the reduced chi-square, pooled over the conditions in which it is `scatter`
    of runs, is tested against pure error. If its p-value is at most `POOLING_P`, the factor is the pooled
    ratio, at least 1, with its degrees of freedom; else it is 1 with `pure_df`. A condition whose ratio
    exceeds that at level `WORSE_P` gets its own. Without repeats the pooled ratio is the variance. Birge
    1932, Phys. Rev. 40, 207; Bancroft 1944, Ann. Math. Statist. 15(2), 190-204, doi:10.1214/aoms/1177731284.
    """
    chi2, df = np.asarray(chi2, float), np.asarray(df, float)
    total, total_df = float(np.sum(chi2 * scatter)), float(np.sum(df * scatter))
    ratio = np.divide(chi2, df, out=np.full(chi2.shape, np.nan), where=df > 0)
    pooled = total / total_df if total_df > 0 else np.nan
    repeated = pure_df > 0
    if not repeated:
        base, base_df = pooled, total_df
    elif total_df > 0 and fdtrc(total_df, pure_df, pooled) <= POOLING_P:
        base, base_df = max(pooled, 1.0), total_df
    else:
        base, base_df = 1.0, pure_df
    with np.errstate(invalid="ignore", divide="ignore"):
        worse = (ratio > base) & (fdtrc(df, base_df, ratio / base) < WORSE_P) & (df < df.sum())
        none = np.full(chi2.shape, np.nan)
        f, p = (ratio, fdtrc(df, pure_df, ratio)) if repeated else (none, none)
        value, df = np.where(worse, ratio, base), np.where(worse, df, base_df if base_df > 0 else np.nan)
        rise = t_quantile(df) ** 2 * value
    return pd.DataFrame({"value": value, "df": df, "rise": rise, "f": f, "p": p, "own": worse})


class SpecimenPart(NamedTuple):
    """What specimens that differ in one respect explain of the chi-square of a condition's runs."""

    explained: float
    expected: float  # of `explained`, per variance of the specimens
    df: int
    rest: float  # chi-square that the model and the specimens leave, and its degrees of freedom
    rest_df: int


def specimen_part(model: np.ndarray, own: np.ndarray, residual: np.ndarray) -> SpecimenPart:
    """Return what one number per specimen explains of the residuals of a model.

    `model`, shape (n, p), are its derivatives, `own`, (n, specimens), the change of each specimen's forces,
    and `residual`, (n,), the residuals, all times the root of the weights.
    """
    basis, size, _ = np.linalg.svd(model, full_matrices=False)
    basis = basis[:, size > DEPENDENT * size.max(initial=0.0)]
    left = own - basis @ (basis.T @ own)
    axes, size, _ = np.linalg.svd(left, full_matrices=False)
    axes = axes[:, size > DEPENDENT * np.linalg.norm(own)]
    explained = float(((axes.T @ residual) ** 2).sum())
    rest = max(float(residual @ residual - ((basis.T @ residual) ** 2).sum()) - explained, 0.0)
    rest_df = len(residual) - basis.shape[1] - axes.shape[1]
    return SpecimenPart(explained, float((left**2).sum()), axes.shape[1], rest, rest_df)


def speed_levels(runs: pd.DataFrame) -> dict[int, np.ndarray]:
    """Return the distinct speed levels of one condition, rising, per direction: {+1: (k,), -1: (m,)}.

    They are commanded speeds if every run of the direction has one, else measured speeds grouped within 25 %.
    An offset between slow strokes forward and fast ones backward could be taken for a Stribeck curve.
    """
    directions, commanded, measured = (runs[name].to_numpy() for name in ("direction", "set", "speed"))
    levels = {}
    for direction in (1, -1):
        own = (directions == direction) | (directions == BOTH_DIRECTIONS)
        if not own.any():
            continue
        speeds = commanded[own].astype(float)
        if np.all(np.isfinite(speeds)) and np.all(speeds > 0):
            codes = [float(f"{speed:.6g}") for speed in np.unique(speeds)]
        else:
            codes = [part[0] for part in speed_clusters(np.sort(measured[own].astype(float)))]
        levels[direction] = np.unique(codes)
    return levels
