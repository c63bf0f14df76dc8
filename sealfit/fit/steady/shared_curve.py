r"""mu_s and mu_c of all conditions from the forces, one v_s and one sigma_2 for all days of a series.

In the declared model (Eq. 14 with Eq. 15) the days of a series share v_s and sigma_2; only mu_s and mu_c age.
For a given v_s the force is linear in all other parameters,

.. math:: F\,\mathrm{sgn}\,v = N [\mu_c^{(i)} + (\mu_s^{(i)} - \mu_c^{(i)}) e^{-(v/v_s)^2}] + \sigma_2 |v|,

so mu_s and mu_c of the conditions i, with their covariance, contain all information of the forces on an aging
law: a law fitted to them by generalised least squares is fitted to the forces. Sharing v_s and sigma_2
reduces the standard errors, and determines conditions with too few speeds for a separate fit. If an F test
rejects that the days of a series share them, its conditions keep their separate fits; so do days with few
speeds that disagree with the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.optimize import minimize_scalar
from scipy.sparse import block_diag, csr_array
from scipy.special import fdtrc

from sealfit.fit.aging import PAIRS, steady_covariance, values_of
from sealfit.fit.joint.declared import series_of_curve
from sealfit.fit.joint.search import pairs_and_shared
from sealfit.fit.least_squares import covariance_of, even_grid
from sealfit.fit.steady import FORCES, solve_conditions
from sealfit.fit.steady.condition import FULL, Condition
from sealfit.fit.steady.stribeck import search_limits
from sealfit.fit.steady.uncertainty import UnitVariance, shifts_of
from sealfit.tables import STEADY_FIT

# Level of the F test for a shared v_s and sigma_2.
SHARED_P = 0.01
# Grid points of v_s per decade. With all days of a series together no minimum is narrow.
PER_DECADE = 30
# Largest relative standard error of a value that counts as determined.
DETERMINED = 0.3


@dataclass(frozen=True)
class Levels:
    """Values of mu_s and mu_c (F_s and F_c) and the covariance of their measurement."""

    table: pd.DataFrame  # `condition`, `quantity`, `value`, and the condition's columns of `steady_fit`
    covariance: csr_array  # (n, n) of the values; before the loop it is 0 between series


def shared_levels(steady: pd.DataFrame, steady_fit: pd.DataFrame) -> Levels:
    """Return mu_s and mu_c, with their covariance, at every aged condition and the unaged rubber.

    `steady_fit` has the separate fits, of which only identified values are used, with `aging_days`.

    Raises
    ------
    FitError
        If there is no row to fit.
    """
    rows = steady_fit[(steady_fit["quantity"] == "steady") & steady_fit["aging_days"].notna()]
    of_parameters = [name for name in STEADY_FIT.names() if name not in ("condition", "series", "rubber")]
    about = rows.drop(columns=of_parameters, errors="ignore").drop_duplicates("condition")
    known = rows[rows["identified"].to_numpy(bool) & rows["value"].notna()]
    curved = set(known.loc[known["parameter"] == "v_s", "condition"])
    free = known[known["parameter"].isin([name for pair in PAIRS for name in pair])]
    free = free.assign(quantity=free["parameter"])[["condition", "quantity", "value"]]
    conditions, _, variance = solve_conditions(steady, steady_fit)
    place = {c.name: k for k, c in enumerate(conditions)}
    series = series_of_curve(about.reset_index(drop=True), aging=True)
    known_covariances, known_shifts = (
        values_of(steady_fit, "covariance"),
        values_of(steady_fit, "effect_shift"),
    )
    count = len(shifts_of(steady))
    tables, covariances, shifts, covered = [], [], [], set()
    for places in about.groupby(series, sort=False).indices.values():
        of = [place[name] for name in about["condition"].to_numpy(object)[places]]
        found = _shared([conditions[k] for k in of], variance, variance.value[of], curved)
        if found is not None:
            tables.append(found[0])
            covariances.append(found[1])
            shifts.append(found[2])
            covered |= found[3]
    alone = free[free["condition"].isin(set(about["condition"]) - covered)]
    keys = zip(alone["condition"], alone["quantity"], strict=True)
    shift = [[known_shifts.get((c, f"{q}:{k + 1}"), 0.0) for k in range(count)] for c, q in keys]
    shift = np.reshape(shift, (len(alone), count))
    # Effects are common to all conditions: their part in the separate fits' covariances is subtracted here.
    within = steady_covariance(alone, known_covariances)
    row, column = within.nonzero()
    common = csr_array(((shift[row] * shift[column]).sum(axis=1), (row, column)), shape=within.shape)
    table = pd.concat([*tables, alone], ignore_index=True)
    covariance = block_diag([*covariances, within - common], format="csr")
    if count:
        together = np.concatenate([*shifts, shift])
        covariance = csr_array(covariance + together @ together.T)
    order = np.argsort(pd.Index(about["condition"]).get_indexer(table["condition"]), kind="stable")
    table = table.iloc[order].merge(about, on="condition", how="left", validate="many_to_one")
    return Levels(table, covariance[order][:, order])


def _shared(
    own: Sequence[Condition], variance: UnitVariance, widened: np.ndarray, curved: set[str]
) -> tuple[pd.DataFrame, np.ndarray, np.ndarray, set[str]] | None:
    """Return the values of a series on a shared curve, or None if its days do not share one.

    Returns the values, their covariance, their change along the directions of the effects' uncertainty, shape
    (values, k), and the conditions on the curve. `widened`, shape (conditions,), is the factor on variances.
    """
    is_full = np.array([c.model == FULL for c in own])
    full = [c for c in own if c.model == FULL]
    df = _usual_df(variance)
    if is_full.sum() < 2 or not curved & {c.name for c in own} or len({c.has_load for c in own}) > 1:
        return None
    if not np.isfinite(widened).all() or not np.isfinite(df):
        return None
    curve = _Curve(full, widened[is_full])
    free = sum(c.chi2 / w for c, w in zip(full, widened[is_full], strict=True))
    if _worse(curve.rss - free, curve.df - sum(c.df for c in full), df):
        return None
    if len(full) < len(own):  # days with too few speeds for a separate fit, if they agree with the others
        every = _Curve(own, widened)
        if not _worse(every.rss - curve.rss, every.df - curve.df, df):
            curve = every
    covariance, _ = covariance_of(curve.tangent())
    names = list(curve.names())
    value, variances = curve.levels.ravel(), np.diag(covariance)[: len(names)]
    keep = np.isfinite(variances) & (variances > 0) & (value > 0) & (variances < (DETERMINED * value) ** 2)
    table = pd.DataFrame(names, columns=["condition", "quantity"]).assign(value=value)
    places = np.flatnonzero(keep)
    sure = np.where(np.isfinite(covariance), covariance, 0.0)
    shift = sure[places] @ curve.tangent().T @ curve.shifts()
    known = {c.name for c in curve.own}
    return table[keep].reset_index(drop=True), covariance[np.ix_(places, places)], shift, known


def _worse(rise: float, more: int, df: float) -> bool:
    """Return whether an F test finds a sum of squares' rise significant, for `more` degrees of freedom."""
    return more > 0 and bool(fdtrc(more, df, rise / more) < SHARED_P)


def _usual_df(variance: UnitVariance) -> float:
    """Return the degrees of freedom of conditions without a variance factor of their own."""
    usual = variance.df[np.isfinite(variance.value) & ~variance.own]
    return float(usual[0]) if usual.size else np.nan


class _Curve:
    """Least-squares fit of Eq. 14 to several conditions with one v_s and one sigma_2."""

    def __init__(self, own: Sequence[Condition], widened: np.ndarray) -> None:
        self.own = own
        arrays = zip(*(c.arrays for c in own), strict=True)
        self.speed, self.load, self.force, weight = (np.concatenate(parts) for parts in arrays)
        self.code = np.repeat(np.arange(len(own)), [len(c.runs) for c in own])
        self.root = np.sqrt(weight / widened[self.code])
        grid = even_grid(*search_limits(self.speed[None], weight[None]), PER_DECADE)[0]
        rss = [self._solve(u)[0] for u in grid]
        best = int(np.argmin(rss))
        ends = grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]
        found = minimize_scalar(
            lambda u: self._solve(u)[0], bounds=ends, method="bounded", options={"xatol": 1e-9}
        )
        self.log_v_s = float(found.x) if found.fun <= rss[best] else float(grid[best])
        self.rss, self.levels, self.sigma_2, rank = self._solve(self.log_v_s)
        self.df = self.code.size - rank - 2

    def _columns(self, log_v_s: float) -> np.ndarray:
        """Return the weighted columns of mu_s and mu_c, shape (2, runs)."""
        decay = np.exp(-((self.speed / np.exp(log_v_s)) ** 2))
        return np.stack([decay, 1 - decay]) * self.load * self.root

    def _solve(self, log_v_s: float) -> tuple[float, np.ndarray, float, int]:
        """Return the sum of squares, mu_s and mu_c, (conditions, 2), sigma_2, and the rank of the levels."""
        columns, speed, force = self._columns(log_v_s), self.speed * self.root, self.force * self.root
        levels, sigma_2, rank = pairs_and_shared(columns, self.code, speed, force)
        residual = force - (levels[self.code].T * columns).sum(axis=0) - sigma_2 * speed
        return float(residual @ residual), levels, sigma_2, rank

    def names(self) -> Iterator[tuple[str, str]]:
        """Yield condition and quantity of every level, in the order of the tangent's columns."""
        for condition in self.own:
            for name in ("mu_s", "mu_c"):
                yield condition.name, name if condition.has_load else FORCES[name]

    def tangent(self) -> np.ndarray:
        """Return weighted derivatives with respect to the levels, ln v_s and sigma_2 if not 0, (runs, p)."""
        runs = self.code.size
        own = np.zeros((runs, *self.levels.shape))
        own[np.arange(runs), self.code] = self._columns(self.log_v_s).T
        square = (self.speed / np.exp(self.log_v_s)) ** 2
        rise = self.levels[self.code] @ [1.0, -1.0]
        bend = rise * self.load * np.exp(-square) * 2 * square * self.root
        shared = [bend] + ([self.speed * self.root] if self.sigma_2 > 0 else [])
        return np.column_stack([own.reshape(runs, -1), *shared])

    def shifts(self) -> np.ndarray:
        """Return weighted changes of forces along the directions of the effects' uncertainty, (runs, k)."""
        return np.concatenate([c.shifts for c in self.own]) * self.root[:, None]
