r"""Joint laws of aging of mu_s and mu_c, from the forces with one v_s and one sigma_2 per series.

In the declared model (Eq. 14 with Eq. 15) the days of a series share v_s and sigma_2; only mu_s and mu_c age.
For a given v_s the force is linear in all other parameters,

.. math:: F\,\mathrm{sgn}\,v = N [\mu_c^{(i)} + (\mu_s^{(i)} - \mu_c^{(i)}) e^{-(v/v_s)^2}] + \sigma_2 |v|,

so a law fitted to mu_s and mu_c of the conditions i by generalised least squares is fitted to the forces.
Sharing v_s and sigma_2 reduces the standard errors, and determines conditions with too few speeds for a
separate fit. If an F test rejects that the days of a series share them, its conditions keep their separate
fits; so do days with few speeds that disagree with the others.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pandas as pd
from scipy.optimize import minimize_scalar
from scipy.sparse import block_diag, csr_array
from scipy.special import fdtrc

from sealfit.config import Config
from sealfit.errors import FitError, RequestError
from sealfit.fit.aging import specimens_of, steady_covariance
from sealfit.fit.aging.joint_law import DRIVERS, Aged, JointLaw, fit_laws, left_out, rivals_of
from sealfit.fit.aging.law import Values, fit_law, law_model
from sealfit.fit.joint.declared import series_of_curve
from sealfit.fit.joint.search import pairs_and_shared
from sealfit.fit.joint.whitening import log_determinant
from sealfit.fit.least_squares import covariance_of
from sealfit.fit.steady import FORCES, SteadyFit, parameter_units, solve_conditions
from sealfit.fit.steady.condition import FULL, Condition
from sealfit.fit.steady.stribeck import search_grid
from sealfit.fit.steady.uncertainty import shifts_of
from sealfit.physics.aging_laws import LOSSES
from sealfit.tables import AGING_LAWS, MASTER_CURVE, STEADY_FIT

# Level of the F test for a shared v_s and sigma_2.
SHARED_P = 0.01
# Grid points of v_s per decade. With all days of a series together no minimum is narrow.
PER_DECADE = 30
# Largest relative standard error of a value that counts as determined.
DETERMINED = 0.3

TEMPERATURE, COMPRESSION = "temperature_C", "compression_ratio_pct"
# Name of the law with separate a and b of Eq. 15 for every series.
SEPARATE = "separate"
# Number of the best laws whose held-out error is computed.
HELD_OUT_LAWS = 3
# Points of a curve from a third of the first aged day on.
CURVE_POINTS = 61
# Further points between day 0 and a third of the first aged day.
START_POINTS = 20


def shared_levels(steady: pd.DataFrame, steady_fit: SteadyFit) -> tuple[pd.DataFrame, csr_array]:
    """Return mu_s and mu_c at every aged condition and the unaged rubber, and their covariance, shape (n, n).

    The table has `condition`, `quantity` (mu_s, mu_c, F_s or F_c), `value`, and the condition's columns. Of
    the separate fits only identified values are used. FitError if there is no row to fit.
    """
    fit = steady_fit["steady_fit"]
    rows = fit[(fit["quantity"] == "steady") & fit["aging_days"].notna()]
    of_parameters = [name for name in STEADY_FIT.names() if name not in ("condition", "series", "rubber")]
    about = rows.drop(columns=of_parameters, errors="ignore").drop_duplicates("condition")
    known = rows[rows["identified"].to_numpy(bool) & rows["value"].notna()]
    curved = set(known.loc[known["parameter"] == "v_s", "condition"])
    free = known[known["parameter"].isin([*FORCES, *FORCES.values()])]
    free = free.assign(quantity=free["parameter"])[["condition", "quantity", "value"]]
    conditions, _, variance = solve_conditions(steady)
    place = {c.name: k for k, c in enumerate(conditions)}
    series = series_of_curve(about.reset_index(drop=True), aging=True)
    count = len(shifts_of(steady))
    known_shifts = steady_fit["steady_shift"].set_index(["condition", "parameter", "source"])
    known_shifts = known_shifts["value"].to_dict()
    tables, covariances, shifts, covered = [], [], [], set()
    for places in about.groupby(series, sort=False).indices.values():
        of = [place[name] for name in about["condition"].to_numpy(object)[places]]
        curve = _shared([conditions[k] for k in of], variance, variance["value"].to_numpy()[of], curved)
        if curve is not None:
            for kept, one in zip((tables, covariances, shifts), curve.determined(), strict=True):
                kept.append(one)
            covered |= {c.name for c in curve.own}
    alone = free[free["condition"].isin(set(about["condition"]) - covered)]
    keys = zip(alone["condition"], alone["quantity"], strict=True)
    shift = [[known_shifts.get((c, q, str(k + 1)), 0.0) for k in range(count)] for c, q in keys]
    shift = np.reshape(shift, (len(alone), count))
    # Effects are common to all conditions: their part in the separate fits' covariances is subtracted here.
    within = steady_covariance(alone, steady_fit["steady_covariance"])
    row, column = within.nonzero()
    common = csr_array(((shift[row] * shift[column]).sum(axis=1), (row, column)), shape=within.shape)
    table = pd.concat([*tables, alone], ignore_index=True)
    covariance = block_diag([*covariances, within - common], format="csr")
    if count:
        together = np.concatenate([*shifts, shift])
        covariance = csr_array(covariance + together @ together.T)
    order = np.argsort(pd.Index(about["condition"]).get_indexer(table["condition"]), kind="stable")
    table = table.iloc[order].merge(about, on="condition", how="left", validate="many_to_one")
    return table, covariance[order][:, order]


def _shared(
    own: Sequence[Condition], variance: pd.DataFrame, widened: np.ndarray, curved: set[str]
) -> "_SharedCurve | None":
    """Return the shared curve of the days of a series, or None; `widened` are the factors on variances."""
    is_full = np.array([c.model == FULL for c in own])
    full = [c for c in own if c.model == FULL]
    usual = variance.loc[np.isfinite(variance["value"]) & ~variance["own"], "df"]
    df = float(usual.iloc[0]) if usual.size else np.nan
    if is_full.sum() < 2 or not curved & {c.name for c in own} or len({c.has_load for c in own}) > 1:
        return None
    if not np.isfinite(widened).all() or not np.isfinite(df):
        return None
    curve = _SharedCurve(full, widened[is_full])
    free = sum(c.chi2 / w for c, w in zip(full, widened[is_full], strict=True))
    if _worse(curve.rss - free, curve.df - sum(c.df for c in full), df):
        return None
    if len(full) < len(own):  # days with too few speeds for a separate fit, if they agree with the others
        every = _SharedCurve(own, widened)
        if not _worse(every.rss - curve.rss, every.df - curve.df, df):
            curve = every
    return curve


def _worse(rise: float, more: int, df: float) -> bool:
    """Return whether an F test finds a sum of squares' rise significant, for `more` degrees of freedom."""
    return more > 0 and bool(fdtrc(more, df, rise / more) < SHARED_P)


class _SharedCurve:
    """Least-squares fit of Eq. 14 to several conditions with one v_s and one sigma_2."""

    def __init__(self, own: Sequence[Condition], widened: np.ndarray) -> None:
        self.own = own
        arrays = zip(*(c.arrays for c in own), strict=True)
        self.speed, self.load, self.force, weight = (np.concatenate(parts) for parts in arrays)
        self.code = np.repeat(np.arange(len(own)), [len(c.runs) for c in own])
        self.root = np.sqrt(weight / widened[self.code])
        grid = search_grid(self.speed[None], weight[None], PER_DECADE)[0]
        rss = [self._solve(u)[0] for u in grid]
        best = int(np.argmin(rss))
        ends = grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]
        options = {"xatol": 1e-9}
        found = minimize_scalar(lambda u: self._solve(u)[0], bounds=ends, method="bounded", options=options)
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

    def determined(self) -> tuple[pd.DataFrame, np.ndarray, np.ndarray]:
        """Return mu_s and mu_c where they are determined, their covariance, and shift with the effects."""
        names = [(c.name, q if c.has_load else FORCES[q]) for c in self.own for q in ("mu_s", "mu_c")]
        tangent, value = self.tangent(), self.levels.ravel()
        covariance, _ = covariance_of(tangent)
        variance = np.diag(covariance)[: value.size]
        keep = np.isfinite(variance) & (variance > 0) & (value > 0) & (variance < (DETERMINED * value) ** 2)
        table = pd.DataFrame(names, columns=["condition", "quantity"]).assign(value=value)
        places = np.flatnonzero(keep)
        moved = np.concatenate([c.shifts for c in self.own]) * self.root[:, None]  # weighted forces
        shift = np.where(np.isfinite(covariance), covariance, 0.0)[places] @ tangent.T @ moved
        return table[keep].reset_index(drop=True), covariance[np.ix_(places, places)], shift

    def tangent(self) -> np.ndarray:
        """Return weighted derivatives with respect to the levels, ln v_s and sigma_2 if not 0, (runs, p)."""
        runs = self.code.size
        own = np.zeros((runs, *self.levels.shape))
        own[np.arange(runs), self.code] = self._columns(self.log_v_s).T
        square = (self.speed / np.exp(self.log_v_s)) ** 2
        rise = self.levels[self.code] @ [1.0, -1.0]
        shared = [rise * self.load * np.exp(-square) * 2 * square * self.root]
        shared += [self.speed * self.root] if self.sigma_2 > 0 else []
        return np.column_stack([own.reshape(runs, -1), *shared])


# Values of a law for all series, by rubber and quantity.
AgedValues = Mapping[tuple[str, str], Aged]


def aged_values(steady: pd.DataFrame, steady_fit: SteadyFit) -> AgedValues:
    """Return mu_s and mu_c (F_s and F_c) of every rubber where the forces determine them."""
    levels, covariance = shared_levels(steady, steady_fit)
    rubber, quantity = levels["rubber"], levels["quantity"]
    order, found = [*FORCES, *FORCES.values()], {}
    fit = steady_fit["steady_fit"]
    for name in sorted(set(rubber)):
        own = fit[fit["rubber"] == name]
        alone = own[(own["quantity"] == "steady") & own["parameter"].isin(order) & own["se"].notna()]
        alone = alone.assign(quantity=alone["parameter"])
        within = steady_covariance(alone, steady_fit["steady_covariance"])
        specimens = specimens_of(alone, own, within)
        for one in sorted(set(quantity[rubber == name]), key=order.index):
            here = ((rubber == name) & (quantity == one)).to_numpy()
            known = specimens.get(one)
            found[name, one] = aged_of(levels[here], covariance[here][:, here], specimens=known)
    return found


def aged_of(rows: pd.DataFrame, covariance, **scatter) -> Aged:
    """Return the values of table rows with the condition's columns; `scatter` is as in `Aged`."""
    known = []
    for name in (TEMPERATURE, COMPRESSION):
        known.append(rows[name].to_numpy(float) if name in rows and rows[name].notna().any() else None)
    days, value = (rows[name].to_numpy(float) for name in ("aging_days", "value"))
    return Aged(days, value, *known, covariance, **scatter)


def joint_laws(
    steady: pd.DataFrame, steady_fit: SteadyFit, config: Config
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return tables `aging_laws` and `master_curve`; empty without aging or with too few conditions."""
    aging = config.aging and "aging_days" in steady_fit["steady_fit"].columns
    aged = aged_values(steady, steady_fit) if aging else {}
    return law_tables(aged, {q: parameter_units(config.units, q in FORCES)["mu_s"] for _, q in aged})


def law_tables(values: AgedValues, units: Mapping[str, str]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return tables `aging_laws` and `master_curve`; `units` are those of the quantities."""
    rows, curves = [], []
    for (rubber, quantity), aged in values.items():
        try:
            laws = fit_laws(aged)
        except FitError:  # no law can be fitted
            continue
        at = {"rubber": rubber, "quantity": quantity}
        rows += [{**at, **row} for row in _law_rows(laws, units[quantity])]
        curves.append(_master_curve(laws[0]).assign(**at))
    curves = pd.concat(curves, ignore_index=True) if curves else pd.DataFrame()
    laws = pd.DataFrame(rows).assign(model="before").reindex(columns=AGING_LAWS.names())
    return laws, curves.reindex(columns=MASTER_CURVE.names())


def _law_rows(laws: Sequence[JointLaw], unit: str) -> Iterator[dict]:
    best, rivals = laws[0], rivals_of(laws)
    for number, law in enumerate(laws):
        errors = left_out(law) if number < HELD_OUT_LAWS else {}
        head = {
            "law": law.loss.name,
            "way": law.acts_on if best.aged.drivers() else "",
            "form": law.loss.form,
            "rank": number + 1,
            "rival": law in rivals,
            "criterion": law.bic - best.bic,
            "scatter_rel": law.scatter,
            "lack_of_fit_p": law.lack_of_fit_p(),
            "heldout_series": errors.get("series", np.nan),
            "heldout_last_day": errors.get("last_day", np.nan),
        }
        units = {"mu_0": unit, "a": unit, "E": "kJ/mol", "kappa": "1/%"}
        units |= dict(zip(law.loss.parameters, law.loss.units, strict=True))
        for name, value, low, high, known in law.parameters():
            row = {"parameter": name, "value": value, "lo95": low, "hi95": high, "unit": units[name]}
            yield {**head, **row, "identified": known}
    apart = _separate(best)
    if apart is not None:
        yield {
            "law": SEPARATE,
            "way": "",
            "form": "mu_0 - a ln(1 + t/b), a and b of each series",
            "rank": len(laws) + 1,
            "rival": False,
            "criterion": apart[0] - best.bic,
            "heldout_last_day": apart[1],
            "identified": True,
        }


def _separate(law: JointLaw) -> tuple[float, float] | None:
    """Return the BIC of separate laws under the joint scatter, and their held-out error; None if too few."""
    aged, series = law.aged, law.aged.series()
    pairs = np.unique(np.column_stack([series, aged.days])[series >= 0], axis=0)
    days = np.bincount(pairs[:, 0].astype(int))  # number of days of each series
    if len(days) < 2 or min(days) < 3:
        return None
    origin = np.zeros(aged.value.size, int)
    fitted = fit_law(Values(aged.days, aged.value, origin, series, aged.covariance(law.scatter)))
    bic = fitted.chi2 + log_determinant(fitted.values.whitening) + fitted.x.size * np.log(aged.value.size)
    squares = []
    for out in aged.last_days() if min(days) > 3 else []:
        part = fit_law(fitted.values.part(~out), fitted.x)
        squares += list((law_model(fitted.values, part.x)[out] - aged.value[out]) ** 2)
    return bic, float(np.sqrt(np.mean(squares))) if squares else np.nan


def _master_curve(law: JointLaw) -> pd.DataFrame:
    """Return values on the master curve, and the law with band at reference temperature and compression.

    Times are multiplied by k if the rate of aging changes; losses are divided by k if the loss changes.
    """
    aged = law.aged
    scaled, start = law.tested_days(), law.x[0]
    value = aged.value if law.acts_on == "rate" else start + (aged.value - start) / law.factors(aged)[1]
    points = {"kind": "value", "scaled_days": scaled, "value": value, "aging_days": aged.days}
    for name, (column, _) in DRIVERS.items():
        points[column] = np.where(aged.days > 0, aged.known[name], np.nan) if name in aged.known else np.nan
    first = scaled[scaled > 0].min() / 3
    near = first * np.linspace(0, 1, START_POINTS, endpoint=False) ** 2  # laws fall fastest there
    days = np.r_[near, np.geomspace(first, scaled.max() * 1.5, CURVE_POINTS)]
    middle = [np.full(days.size, aged.middle[name]) if name in aged.middle else None for name in DRIVERS]
    at = Aged(days, np.zeros(days.size), *middle)
    slope = law.slope(at)
    half = law.t * np.sqrt(np.einsum("in,ij,jn->n", slope, law.covariance, slope))
    value = law.at(at)
    curve = {"kind": "law", "scaled_days": days, "value": value, "lo95": value - half, "hi95": value + half}
    return pd.concat([pd.DataFrame(points), pd.DataFrame(curve)], ignore_index=True)


def law_of(
    steady: pd.DataFrame, steady_fit: SteadyFit, quantity: str, name: str | None = None
) -> list[JointLaw]:
    """Return the laws of one quantity, such as "mu_s", in order of BIC, or only a named one.

    RequestError if rubber is not aged, the quantity was not fitted or is not identified, there are several
    rubbers, or no such law can be fitted.
    """
    fit = steady_fit["steady_fit"]
    if "aging_days" not in fit.columns:
        raise RequestError("this rig ages no rubber.", fix="Name aging_days in the config's condition.")
    values = aged_values(steady, steady_fit)
    rows = fit[(fit["quantity"] == "steady") & (fit["parameter"] == quantity)]
    if len(rows) and quantity not in {one for _, one in values}:
        raise RequestError(
            f"{quantity} is not identified in any condition: {rows['reason'].mode()[0]}",
            fix="Measure more speeds and repeats, or follow another quantity.",
        )
    return laws_of(values, quantity, name)


def laws_of(values: AgedValues, quantity: str, name: str | None = None) -> list[JointLaw]:
    """Return the laws of one quantity in order of BIC, or only a named one; errors as `law_of`."""
    aged = {rubber: own for (rubber, one), own in values.items() if one == quantity}
    if not aged:
        there = ", ".join(dict.fromkeys(one for _, one in values)) or "none"
        raise RequestError(f"there is no '{quantity}' to follow.", fix=f"Choose one of: {there}.")
    if len(aged) > 1:
        fix = f"Choose one: --rubber '{next(iter(aged))}'."
        raise RequestError(f"there are several rubbers: {', '.join(aged)}.", fix=fix)
    if name is not None and name not in LOSSES:
        raise RequestError(f"there is no law '{name}'.", fix=f"Choose one of: {', '.join(LOSSES)}.")
    try:
        return fit_laws(*aged.values(), tuple(LOSSES) if name is None else (name,))
    except FitError as error:
        raise RequestError(error.message, fix=error.fix) from error
