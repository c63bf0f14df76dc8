r"""The aging law of a property measured on specimens: strength, hardness, compression set, ...

Specimens of one condition are replicates. They scatter independently, and those of a batch have a deviation
in common, which is no pure error: a specimen of condition c and batch b has

.. math:: y = \mu(t_c) + B_b + \varepsilon, \qquad \mathrm{Var}\, B_b = \sigma_B^2, \quad
    \mathrm{Var}\, \varepsilon = \sigma^2

Both variances are estimated by restricted maximum likelihood (REML) with a free mean for every condition, so
that no law is assumed. The law is fitted to these means, which are generalised least-squares estimates
(Searle, Casella & McCulloch 1992, Variance Components, chapters 6 and 8).
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.optimize import minimize_scalar
from scipy.special import stdtr

from sealfit.config import Config
from sealfit.fit.aging import SMALLEST, LawRows, aging_curves, law_fit, laws_of_series
from sealfit.fit.aging.all_series import COMPRESSION, TEMPERATURE, aged_of, law_tables, laws_of
from sealfit.fit.aging.joint_law import Aged, JointLaw
from sealfit.fit.least_squares import t_quantile

# Largest ratio of the variance between batches to that between specimens that is searched.
MOST_RATIO = 1e6
# Smaller singular values of the batches within conditions are rounding.
ROUNDING = 1e-9
# Smallest variance. It keeps the weights finite if all values are zero.
TINY = 1e-300
# Level of the test for values that are far off, for all values together (Bonferroni).
FAR_OFF = 0.001


@dataclass(frozen=True)
class Means:
    """Means of one property of one rubber over specimens and batches, by condition.

    Standard deviations are nan if unknown. Degrees of freedom are Satterthwaite's, 0 without replicates.
    """

    table: pd.DataFrame  # a row per condition: series, condition, its columns, value, and n, its specimens
    covariance: np.ndarray  # (n, n) of the means
    specimen_sd: float  # between specimens of one condition and batch
    batch_sd: float  # between batches
    df: float  # of the covariance of differences between means
    level_df: float  # of their common level

    @property
    def scatter(self) -> dict:
        """The fields of `Measured` by name; further scatter is relative to the root mean square of all."""
        value = self.table["value"].to_numpy(float)
        size = np.full(value.size, np.sqrt(np.mean(value**2)) or 1.0)
        return {"size": size, "replicates_df": self.df, "level_df": self.level_df}

    def half_width(self) -> np.ndarray:
        """Return half the width of the 95 % intervals of the means, shape (n,); nan without replicates."""
        if not self.level_df:
            return np.full(len(self.table), np.nan)
        return t_quantile(self.level_df) * np.sqrt(np.diag(self.covariance))

    def aged(self) -> Aged:
        """Return the means as the data of a law for all series."""
        return aged_of(self.table, self.covariance, **self.scatter)


def means_of(specimens: pd.DataFrame) -> Means:
    """Return the means of one property of one rubber, and their covariance, from rows of its specimens."""
    specimens = specimens.assign(batch=specimens["batch"].fillna(""))
    specimen, batch, df = _variances(specimens)
    cells = specimens.groupby(["condition", "batch"], sort=True)["value"].agg(["mean", "size"]).reset_index()
    conditions = specimens.groupby("condition", sort=True)
    table = conditions.first().drop(columns=["value", "batch"]).reset_index()
    table["n"] = conditions.size().to_numpy()

    named = cells["batch"].to_numpy(str)
    same = (named[:, None] == named[None, :]) & (named != "")[:, None]
    shared = np.where(same, np.nan_to_num(batch), 0.0)
    rounding = SMALLEST**2 * np.mean(cells["mean"].to_numpy(float) ** 2) + TINY
    of_cells = shared + np.diag(np.nan_to_num(specimen) / cells["size"].to_numpy(float) + rounding)
    member = pd.get_dummies(cells["condition"], dtype=float)[table["condition"]].to_numpy()
    weighted = np.linalg.solve(of_cells, member).T
    covariance = np.linalg.inv(weighted @ member)
    gain = covariance @ weighted
    table["value"] = gain @ cells["mean"].to_numpy(float)

    share = _batch_shares(gain @ shared @ gain.T, covariance)
    contrast_df, level_df = (_satterthwaite(own, df) for own in share)
    return Means(table, covariance, float(np.sqrt(specimen)), float(np.sqrt(batch)), contrast_df, level_df)


def _batch_shares(shared: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """Return the shares of the batches in the variances of differences between means, and of their level."""
    n = len(shared)
    weight = np.linalg.solve(covariance, np.ones(n))
    level = float(weight @ shared @ weight / (weight @ covariance @ weight))
    if n < 2:
        return 0.0, level
    contrasts = np.linalg.svd(np.ones((1, n)))[2][1:]
    part, whole = contrasts @ shared @ contrasts.T, contrasts @ covariance @ contrasts.T
    return float(np.clip(np.trace(np.linalg.solve(whole, part)) / (n - 1), 0.0, 1.0)), level


def _satterthwaite(share: float, df: tuple[int, int]) -> float:
    """Return the degrees of freedom of a variance of which the batches have a share; 0 without replicates."""
    if not df[0]:
        return 0.0
    return 1 / ((1 - share) ** 2 / df[0] + (share**2 / df[1] if df[1] else 0.0))


def _variances(specimens: pd.DataFrame) -> tuple[float, float, tuple[int, int]]:
    """Return the variances between specimens and batches, nan if not determined, and degrees of freedom."""
    value, condition, batch = specimens["value"].astype(float), specimens["condition"], specimens["batch"]
    df = len(value) - condition.nunique()
    left = (value - value.groupby(condition).transform("mean")).to_numpy(float)
    member = pd.get_dummies(batch[batch != ""], dtype=float).reindex(specimens.index, fill_value=0.0)
    within = (member - member.groupby(condition).transform("mean")).to_numpy(float)
    u, d, _ = np.linalg.svd(within, full_matrices=False)
    kept = d > ROUNDING
    u, d = u[:, kept], d[kept]
    scores = u.T @ left
    if df <= 0:
        return np.nan, np.nan, (0, 0)
    if d.size in (0, df):  # no batch is compared with another, or each has one specimen: they are independent
        return float(left @ left) / df, np.nan, (df, 0)

    rest = float(left @ left - scores @ scores)

    def variance(ratio: float) -> float:
        return (rest + float(np.sum(scores**2 / (1 + ratio * d**2)))) / df

    def deviance(log_ratio: float) -> float:
        ratio = np.exp(log_ratio)
        return float(np.sum(np.log1p(ratio * d**2)) + df * np.log(max(variance(ratio), 1e-300)))

    found = minimize_scalar(deviance, bounds=(-np.log(MOST_RATIO), np.log(MOST_RATIO)), method="bounded")
    ratio = float(np.exp(found.x)) if found.fun < deviance(-np.log(MOST_RATIO)) else 0.0
    return variance(ratio), ratio * variance(ratio), (df - d.size, d.size)


def far_off(specimens: pd.DataFrame) -> pd.DataFrame:
    """Return the values of one property of one rubber that the others contradict, by line of the table.

    Column `others` is the mean of the other specimens of the condition. Each value is tested by its deletion
    residual about a free mean for every condition, and the farthest one is left out until none is
    significant, both with one scatter for all conditions and with scatter in proportion to their means. Of
    two specimens either may be wrong. Scatter is at least that of rounding.
    """
    left = specimens[["condition", "line", "value"]].astype({"value": float})
    step = np.diff(np.unique(left["value"]), append=np.inf).min(initial=np.inf)
    found = [left[:0].assign(others=0.0)]
    while True:
        of = left.groupby("condition")["value"]
        count, mean = of.transform("size"), of.transform("mean")
        rest = left["value"] - mean
        # Deletion residual, and the square of the residual about the mean that it accounts for.
        apart = rest * count / (count - 1).clip(lower=1)
        gain, df = rest * apart, len(left) - of.ngroups - 1
        if df < 1 or not gain.max() > 0:
            break
        t = np.inf
        for size in (1.0, mean.abs().replace(0.0, 1.0)):
            left_over = ((rest / size) ** 2).sum() - gain / size**2
            t = np.minimum(t, np.sqrt(gain / np.maximum(left_over / df * size**2, step**2 / 12)))
        if not 2 * len(left) * stdtr(df, -t.max()) < FAR_OFF:
            break
        far = t >= t.max() * (1 - ROUNDING)
        found.append(left[far].assign(others=left["value"] - apart))
        left = left[~far]
    return pd.concat(found).sort_values("line", ignore_index=True)[["line", "value", "others"]]


def fit_properties(specimens: pd.DataFrame, config: Config) -> dict[str, pd.DataFrame]:
    """Return the tables of the laws of table `property_values`, for series and for all series."""
    series, aged, units = [], {}, {}
    for (rubber, quantity), own in specimens.groupby(["rubber", "quantity"], sort=True):
        means, units[quantity] = means_of(own), str(own["unit"].iloc[0])
        series.append((rubber, _law_per_series(means, quantity, units[quantity])))
        aged[rubber, quantity] = means.aged()
    fit = law_fit(series, specimens, config)
    laws, curve = law_tables(aged, units)
    return {**fit, "aging_curves": aging_curves(fit), "aging_laws": laws, "master_curve": curve}


def laws_of_property(specimens: pd.DataFrame, quantity: str, name: str | None = None) -> list[JointLaw]:
    """Return the laws of one property in order of BIC, or only a named one; errors are those of `law_of`."""
    groups = specimens.groupby(["rubber", "quantity"], sort=True)
    return laws_of({pair: means_of(own).aged() for pair, own in groups}, quantity, name)


def _law_per_series(means: Means, quantity: str, unit: str) -> LawRows:
    table = means.table
    days, series = table["aging_days"].to_numpy(float), table["series"]
    columns = [name for name in (TEMPERATURE, COMPRESSION) if name in table]
    order = table[days > 0].sort_values(columns, kind="stable")["series"] if columns else series[days > 0]
    table = table.assign(quantity=quantity, unit=unit, moved=0.0)
    return laws_of_series(table, list(dict.fromkeys(order)), [quantity], means.covariance, **means.scatter)
