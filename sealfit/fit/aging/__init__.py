"""The aging law (Eq. 15) of mu_s and mu_c per series, fitted to the steady fits of the conditions."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
from scipy.sparse import csr_array, diags_array

from sealfit.config import Config
from sealfit.fit.aging import law_table
from sealfit.fit.aging.law import LawFit, Values, fit_law, paule_mandel
from sealfit.fit.aging.law_table import Estimate, OneQuantity, SeriesCurve
from sealfit.fit.joint.declared import DAYS_FOR_LAW
from sealfit.fit.least_squares import t_quantile
from sealfit.fit.steady import SteadyFit, covariance_matrix
from sealfit.fit.steady.condition import FULL
from sealfit.physics import aging_law
from sealfit.tables import AGING_COVARIANCE, AGING_CURVES, AGING_FIT

PAIRS = (("mu_s", "mu_c"), ("F_s", "F_c"))
# Smallest relative standard deviation of a steady value.
SMALLEST = 1e-6
# Number of points of a curve, which are denser near day 0.
CURVE_POINTS = 61

# Rows of tables `aging_fit` and `aging_covariance`.
LawRows = tuple[list[dict], list[dict]]
# Per quantity the relative scatter of the conditions' means between specimens, and its degrees of freedom.
Specimens = Mapping[str, tuple[float, float]]


def fit_series(steady_fit: SteadyFit, config: Config) -> dict[str, pd.DataFrame]:
    r"""Fit the aging law to every series, mu_0 shared by all series of a rubber.

    .. math:: \mu(t) = \mu_0 - a \ln(1 + t / b), \quad c = -a \ln b

    All series and both quantities of a rubber are fitted together by generalised least squares. The
    covariance is that of mu_s and mu_c in the steady fits plus the scatter between specimens, estimated from
    the residuals.

    Parameters
    ----------
    steady_fit : dict of DataFrame
        The fits of the conditions, with the column `aging_days`; only identified values are used.
    config : Config
        Names the condition columns.

    Returns
    -------
    dict of DataFrame
        Table `aging_fit`: per series and quantity mu_0, a, b, c, and "statistics" rows, whose `parameter`
        starts with the quantity ("mu_s:chi2"); and table `aging_covariance` of mu_0, a and ln b. Empty
        without `aging_days` in the condition or without aged rubber.

    Notes
    -----
    Intervals of a, b and c are profile-likelihood intervals, that of mu_0 is from the curvature, with
    Student's t. The degrees of freedom are values minus parameters of the quantity, as specimens are the unit
    of evidence. `u_sys` is the change of the fit if the sensor's error changes all steady values together.
    """
    fit = steady_fit["steady_fit"]
    has_aging = config.aging and "aging_days" in fit.columns
    laws = {}
    for rubber in sorted(set(fit["rubber"])) if has_aging else ():
        laws[rubber] = _fit_rubber({name: own[own["rubber"] == rubber] for name, own in steady_fit.items()})
    return law_fit(laws.items(), fit, config)


def law_fit(
    laws: Iterable[tuple[str, LawRows]], about: pd.DataFrame, config: Config
) -> dict[str, pd.DataFrame]:
    """Return tables `aging_fit` and `aging_covariance` of laws by rubber; `about` has columns of series."""
    rows = [[], []]
    for rubber, own in laws:
        for kept, new in zip(rows, own, strict=True):
            kept += [{"rubber": rubber, **row} for row in new]
    found = {}
    for schema, own in zip((AGING_FIT, AGING_COVARIANCE), rows, strict=True):
        others = [name for name in config.series_columns if name in about and name not in schema.names()]
        keys = about.groupby("series", sort=True)[others].first().reset_index()
        table = pd.DataFrame(own, columns=schema.names())
        found[schema.name] = table.merge(keys, on="series", how="left", validate="many_to_one")
    return found


def _fit_rubber(steady_fit: SteadyFit) -> LawRows:
    own, shift = steady_fit["steady_fit"], steady_fit["steady_shift"]
    found = own[(own["quantity"] == "steady") & own["identified"].to_numpy(bool) & own["value"].notna()]
    pair = next((pair for pair in PAIRS if found["parameter"].isin(pair).any()), None)
    if pair is None:
        return [], []
    found = found[found["parameter"].isin(pair) & found["aging_days"].notna()]
    found = _of_one_meaning(found, own, pair)
    found = found.assign(quantity=found["parameter"]).sort_values(["condition", "quantity"], kind="stable")
    sensor = shift[shift["source"] == "sensor"].set_index(["condition", "parameter"])["value"]
    moved = sensor.reindex(pd.MultiIndex.from_frame(found[["condition", "quantity"]])).to_numpy(float)
    series = list(dict.fromkeys(own.loc[own["aging_days"].to_numpy(float) > 0, "series"]))
    found = found.assign(moved=np.nan_to_num(moved))
    covariance = steady_covariance(found, steady_fit["steady_covariance"])
    return laws_of_series(found, series, pair, covariance, specimens=specimens_of(found, own, covariance))


def specimens_of(found: pd.DataFrame, own: pd.DataFrame, covariance: csr_array) -> Specimens:
    """Return what the steady fits `own` know of the scatter of specimens: it is in their `se` only.

    `found` are their values, with `quantity`, and `covariance`, shape (n, n), is that without specimens.
    """
    df = own.loc[own["parameter"] == "specimen_df", "value"].max()
    if not df > 0:
        return {}
    variance = np.maximum(found["se"].to_numpy(float) ** 2 - covariance.diagonal(), 0.0)
    relative = pd.Series(variance / found["value"].to_numpy(float) ** 2, found.index)
    return {name: (np.sqrt(mean), df) for name, mean in relative.groupby(found["quantity"]).mean().items()}


def _of_one_meaning(found: pd.DataFrame, own: pd.DataFrame, pair: tuple[str, str]) -> pd.DataFrame:
    """Return the values without mu_c of few speeds, which includes mu_s, if others have a Stribeck curve."""
    with_curve = set(found.loc[found["parameter"] == pair[0], "condition"])
    if not with_curve:
        return found
    speeds = own[(own["quantity"] == "statistics") & (own["parameter"] == "n_speeds")]
    few = set(speeds.loc[speeds["value"] < FULL, "condition"]) - with_curve
    return found[~((found["parameter"] == pair[1]) & found["condition"].isin(few))]


def _curves_of(found: pd.DataFrame, series: Sequence[str], quantities: Sequence[str]) -> list[SeriesCurve]:
    """Return the curves of some series and quantities; those with enough days are numbered."""
    unaged, unit = set(found.loc[found["aging_days"] == 0, "quantity"]), str(found["unit"].iloc[0])
    aged = found[found["aging_days"] > 0]
    days_of = aged["aging_days"].astype(float).groupby([aged["series"], aged["quantity"]], sort=False)
    tested = dict(days_of.unique())
    curves, place = [], 0
    for name, quantity in product(series, quantities):
        days = np.sort(tested.get((name, quantity), np.zeros(0)))
        enough = days.size + (quantity in unaged) >= DAYS_FOR_LAW
        curves.append(SeriesCurve(name, quantity, place if enough else -1, days, quantity in unaged, unit))
        place += enough
    return curves


def steady_covariance(used: pd.DataFrame, known: pd.DataFrame) -> csr_array:
    """Return the covariance of steady values, shape (n, n), from table `steady_covariance`, `known`."""
    quantity, n = used["quantity"].to_numpy(object), len(used)
    value_of = known.set_index(["condition", "parameter", "other"])["value"].to_dict()
    pairs, found = [], []
    for condition, places in used.groupby("condition", sort=False).indices.items():
        for i, j in product(places.tolist(), repeat=2):
            names = sorted((quantity[i], quantity[j]), reverse=True)  # mu_s before mu_c
            value = value_of.get((condition, *names), np.nan)
            pairs.append((i, j))
            found.append(value if np.isfinite(value) else 0.0)
    covariance = csr_array((found, np.reshape(pairs, (-1, 2)).T), shape=(n, n))
    return covariance + diags_array((SMALLEST * used["value"].to_numpy(float)) ** 2 + 1e-300)


def _with_specimens(values: Values, taus: list[float], model: np.ndarray) -> Values:
    """Return values with specimen scatter in the covariance, correlated in a condition as the residuals."""
    scale = values.scale(model)
    relative = (values.value - model) / scale
    added = np.array(taus)[values.origin] * scale
    near = values.covariance.tocoo()
    link = values.origin[near.row] != values.origin[near.col]
    row, column, covariance = near.row[link], near.col[link], near.data[link]
    correlation = 0.0
    if row.size and min(taus) > 0:
        cross = (relative[row] * relative[column] - covariance / (scale[row] * scale[column])).mean()
        correlation = float(np.clip(cross / np.prod(taus), -0.9, 0.9))  # below 1, so that it is invertible
    both = csr_array((correlation * added[row] * added[column], (row, column)), shape=near.shape)
    return replace(values, covariance=values.covariance + diags_array(added**2) + both)


def between_scatter(values: Values) -> tuple[float, LawFit]:
    """Return a quantity's relative scatter beyond its covariance, and the fit without it (Paule, Mandel)."""
    plain = fit_law(values)
    if plain.df <= 0 or plain.chi2 <= plain.df:
        return 0.0, plain
    scale, last = values.scale(plain.model), plain

    def chi2(tau: float) -> float:
        nonlocal last
        covariance = values.covariance + diags_array((tau * scale) ** 2)
        last = fit_law(replace(values, covariance=covariance), last.x)
        return last.chi2

    return paule_mandel(chi2, plain.df, (plain.model - values.value) / scale), plain


def laws_of_series(
    found: pd.DataFrame,
    series: Sequence[str],
    quantities: Sequence[str],
    covariance: csr_array | np.ndarray,
    *,
    specimens: Specimens | None = None,
    **replicates,
) -> LawRows:
    """Return the rows of the laws of one rubber in the order of `series` and `quantities`.

    `found` has `series`, `quantity`, `aging_days`, `value`, `unit`, and `moved`, the change of values if the
    sensor reads one standard uncertainty too high; values of one condition are adjacent. `covariance`, shape
    (n, n), and `replicates` are as in `Values`. `specimens` is used where the law leaves no residual.
    """
    quantities = [name for name in quantities if (found["quantity"] == name).any()]
    curves = _curves_of(found, series, quantities)
    fitted = [name for name in quantities if any(c.place >= 0 and c.quantity == name for c in curves)]
    if not fitted:
        return [row for curve in curves for row in law_table.without_law(curve)], []
    days, value, moved = (found[name].to_numpy(float) for name in ("aging_days", "value", "moved"))
    origin = np.array([quantities.index(name) for name in found["quantity"]], int)
    unaged = (days == 0) & found["quantity"].isin(fitted).to_numpy()
    place = {(c.series, c.quantity): c.place for c in curves}
    keys = zip(found["series"], found["quantity"], strict=True)
    number = np.where(unaged, -1, [place.get(key, -1) for key in keys])
    kept = unaged | (number >= 0)
    values = Values(days, value, origin, number, covariance, **replicates).part(kept)
    return _rows(values, curves, fitted, moved[kept], specimens or {})


def _rows(
    values: Values, curves: list[SeriesCurve], fitted: list[str], moved: np.ndarray, specimens: Specimens
) -> LawRows:
    """Return the rows of all curves; `fitted` are the quantities with a law, in the order of their origin."""
    quantities = {}
    model = np.empty(values.value.size)
    for q, name in enumerate(fitted):
        part = np.flatnonzero(values.origin == q)
        own = values.part(part)
        tau, alone = between_scatter(own)
        model[part] = alone.model
        squares = (own.whitening @ (own.value - alone.model)) ** 2
        series = len({c.series for c in curves if c.place >= 0 and c.quantity == name})
        df, level_df = (own.df(alone.df, tau, level=level) for level in (False, True))
        if alone.df <= 0 and name in specimens:
            tau, df = specimens[name]
            level_df = df
        quantities[name] = OneQuantity(part, squares, tau, series, t_quantile(df or np.inf), level_df)
    joint = fit_law(_with_specimens(values, [one.tau for one in quantities.values()], model))
    intervals = law_table.curve_intervals(joint, np.array([one.t**2 for one in quantities.values()]))
    covariance, shift = law_table.curve_errors(joint, moved)
    x = joint.x[values.places_of_curve]
    rows, covariances = [], []
    for curve in curves:
        if curve.place < 0:
            rows += law_table.without_law(curve)
            continue
        one = quantities[curve.quantity]
        found = Estimate(x[curve.place], covariance[curve.place], shift[curve.place])
        rows += law_table.law_rows(curve, found, intervals[curve.place], one.level_df)
        rows += law_table.statistics_rows(curve, joint, one)
        covariances += law_table.covariance_rows(curve, found.covariance)
    return rows, covariances


def aging_curves(laws: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Return table `aging_curves`: laws of series up to the last tested day, with 95 % bands of the mean."""
    tables, fit, covariance = [], laws["aging_fit"], laws["aging_covariance"]
    of_law = dict(iter(covariance.groupby(["series", "quantity"])))
    for series, own in fit.groupby("series", sort=False):
        known = own.set_index(["quantity", "parameter"])["value"].to_dict()
        for quantity in [quantity for quantity, parameter in known if parameter == "mu_0"]:
            curve = _curve(known, quantity, of_law.get((series, quantity)))
            tables.append(pd.DataFrame(curve).assign(series=series, quantity=quantity))
    none = pd.DataFrame({name: np.zeros(0) for name in AGING_CURVES.names()})
    none = none.astype(dict.fromkeys(("series", "quantity"), "str"))
    return pd.concat([curve for curve in tables if len(curve)] or [none], ignore_index=True)[none.columns]


def _curve(
    known: dict[tuple[str, str], float], quantity: str, of_law: pd.DataFrame | None
) -> dict[str, np.ndarray]:
    """Return the curve of one quantity from values by quantity and parameter, and the law's covariance."""
    mu_0, a, b = (known[quantity, name] for name in ("mu_0", "a", "b"))
    if np.isnan([mu_0, a, b]).any():
        return {}
    covariances = of_law.set_index(["parameter", "other"])["value"].to_dict()
    covariance = covariance_matrix(covariances, ("mu_0", "a", "ln b"))
    t = t_quantile(known["statistics", f"{quantity}:error_df"] or np.inf)
    days = known["statistics", f"{quantity}:last_day"] * np.linspace(0, 1, CURVE_POINTS) ** 2
    ratio = days / b
    slope = np.stack([np.ones_like(days), -np.log1p(ratio), a * ratio / (1 + ratio)], axis=1)
    half = t * np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", slope, covariance, slope), 0.0))
    value = aging_law(days, mu_0=mu_0, a=a, b=b)
    return {"aging_days": days, "value": value, "lo95": value - half, "hi95": value + half}
