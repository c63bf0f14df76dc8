"""The steady distributed LuGre model (Eq. 14) fitted per condition; which parameters the speeds determine."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.effects.contract import fill_unit
from sealfit.fit.least_squares import t_quantile
from sealfit.fit.steady.condition import (
    FULL,
    Condition,
    SpecimenScatter,
    bound,
    drop_flat_curve,
    find_specimens,
    judge,
    make_condition,
    scatter_of_runs,
    solve,
    specimen_scatter,
)
from sealfit.fit.steady.stribeck import NAMES, linearised
from sealfit.fit.steady.uncertainty import (
    SMALLEST_SHARE,
    merge_directions,
    more_likely,
    run_means,
    run_weights,
    unit_variance,
)
from sealfit.ingest.columns import condition_columns
from sealfit.ingest.scatter import RepeatScatter, repeat_scatter
from sealfit.tables import STEADY_COVARIANCE, STEADY_FIT, STEADY_SHIFT, Schema
from sealfit.units import Units

# Level of the test for lack of fit.
SIGNIFICANT = 0.05
# Number of conditions whose intervals are computed together, to bound the memory.
BLOCK = 250
# Numeric columns of a fit table.
NUMBERS = ("value", "se", "lo95", "hi95", "u_sys")
# Names of the coefficients if the load is unknown.
FORCES = {"mu_s": "F_s", "mu_c": "F_c"}


# Tables of the fit of conditions, by name.
SteadyFit = Mapping[str, pd.DataFrame]


def fit_conditions(steady: pd.DataFrame, config: Config) -> SteadyFit:
    r"""Fit Eq. 14 to every condition, and mark the parameters that its speeds determine.

    .. math:: F\,\mathrm{sgn}\,v = N [\mu_c + (\mu_s - \mu_c) e^{-(v/v_s)^2}] + \sigma_2 |v|

    Run means of both directions are fitted together, weighted by the pooled scatter of repeats. mu_s, mu_c
    and sigma_2 are not negative; mu_s < mu_c is allowed and reported. Without load the forces F_s and F_c are
    fitted.

    Parameters
    ----------
    steady : DataFrame
        Table `steady`; rows with `used` false are left out.
    config : Config
        Names the condition columns, the units and the sensor's accuracy.

    Returns
    -------
    dict of DataFrame
        Tables `steady_fit`, `steady_covariance` and `steady_shift`, with the condition columns. In
        `steady_fit` `quantity` is "steady" (one row per parameter) or "statistics". In `steady_shift`
        `source` is "sensor" (change of the parameter if the sensor reads every |force| one standard
        uncertainty too high; `u_sys` is its magnitude) or, if effects were subtracted from the forces, the
        number of a principal direction of the effects' uncertainty, from 1 (it is included in the covariance
        and the intervals, and common to all conditions).

    Raises
    ------
    FitError
        If there is no row to fit.

    Notes
    -----
    Intervals are profile-likelihood intervals with Student's t. If some conditions have several specimens,
    the intervals and `se` contain the scatter of specimens, pooled over these conditions; `steady_covariance`
    does not, as the aging laws estimate it. Otherwise they hold for the specimens tested. `u_sys` assumes one
    unknown error of |force| for all samples, which no averaging reduces. A zero offset of the
    sensor has opposite signs in the two directions and changes the parameters by no more; the loop tests for
    it.
    """
    conditions, scatter, variance = solve_conditions(steady)
    specimens = specimen_scatter(conditions, variance["value"].to_numpy())
    keys = condition_keys(steady, config)
    for start in range(0, len(conditions), BLOCK):
        block = slice(start, start + BLOCK)
        bound(conditions[block], variance["rise"].to_numpy()[block])
    rows = {schema: [] for schema in (STEADY_FIT, STEADY_COVARIANCE, STEADY_SHIFT)}
    for c, own in zip(conditions, variance.itertuples(), strict=True):
        for schema, row in _rows(c, own, specimens, scatter, config):
            rows[schema].append({"condition": c.name, **row})
    others = [name for name in keys.columns if name not in STEADY_FIT.names()]
    found = {}
    for schema, own in rows.items():
        columns = [name for name in schema.names() if name == "condition" or name not in keys]
        table = pd.DataFrame(own, columns=columns)
        table = table.merge(keys, on="condition", how="left", validate="many_to_one")
        found[schema.name] = table[[*schema.names(), *others]]
    return found


def solve_conditions(steady: pd.DataFrame) -> tuple[list[Condition], RepeatScatter, pd.DataFrame]:
    """Return fitted conditions without intervals, the scatter of repeats, and table `unit_variance`.

    A Stribeck curve that is not significant is dropped. FitError if there is no row to fit.
    """
    runs = run_means(steady)
    scatter = repeat_scatter(merge_directions(steady[steady["used"].to_numpy(bool)]))
    runs = runs.assign(weight=run_weights(runs, scatter))
    conditions = [make_condition(name, own) for name, own in runs.groupby("condition", sort=True)]
    solve(conditions)
    if not scatter.df > 0:
        conditions = _more_likely_weights(conditions)
    first = unit_variance(*scatter_of_runs(conditions), scatter.df)
    for condition, value, df in zip(conditions, first["value"], first["df"], strict=True):
        if condition.model == FULL:
            drop_flat_curve(condition, value, df)
    find_specimens(conditions)
    return conditions, scatter, unit_variance(*scatter_of_runs(conditions), scatter.df)


def _more_likely_weights(even: list[Condition]) -> list[Condition]:
    """Return conditions with equal weights or scatter proportional to friction, the more likely ones."""
    sizes = np.cumsum([len(c.runs) for c in even])[:-1]
    # The fitted friction is taken: with measured forces a run that an offset brings near 0 would dominate.
    size = np.abs(np.concatenate([c.model_force() for c in even]))
    weight = 1.0 / np.maximum(size, SMALLEST_SHARE * size.max(initial=0.0) or 1.0) ** 2
    parts = zip(even, np.split(weight, sizes), strict=True)
    other = [replace(c, runs=c.runs.assign(weight=own)) for c, own in parts]
    solve(other)
    chi2 = [sum(c.chi2 for c in conditions) for conditions in (even, other)]
    chosen = more_likely(chi2, [np.ones(weight.size), weight], sum(c.df for c in even))
    return (even, other)[chosen]


def condition_keys(steady: pd.DataFrame, config: Config) -> pd.DataFrame:
    """One row per condition: series, rubber and condition columns; null where unaged rubber has several."""
    names = dict.fromkeys(["series", "rubber", *condition_columns(config)])
    names = [name for name in names if name in steady.columns]
    grouped = steady[steady["condition"].notna()].groupby("condition", sort=True)
    first, several = grouped[names].first(), grouped[names].nunique() > 1
    return first.mask(several).reset_index()


def _rows(
    condition: Condition,
    variance: tuple,
    specimens: SpecimenScatter,
    scatter: RepeatScatter,
    config: Config,
) -> Iterator[tuple[Schema, dict]]:
    """Yield the rows of a condition, each with its table; `variance` is its row of `unit_variance`."""
    unit_of = parameter_units(config.units, condition.has_load)
    speed, _, _, weight = condition.arrays
    moved = np.column_stack([np.ones_like(speed), condition.shifts])
    covariance, changes = linearised(condition.jacobian(), weight, condition.values, condition.names, moved)
    shift, effects = changes[:, 0], changes[:, 1:]
    covariance = covariance * variance.value + effects @ effects.T
    of_specimens = specimens.variance_of(condition)
    # Smaller shifts are rounding.
    shift = np.where(np.abs(shift) > 1e-12 * np.abs(condition.values), shift * config.sensor.u, 0.0)
    judged = judge(condition)
    spelled = {name: name if condition.has_load else FORCES.get(name, name) for name in NAMES}
    for name in NAMES:
        row = dict(zip(("identified", "reason"), judged[name], strict=True))
        if name in condition.names:
            j = condition.names.index(name)
            value = condition.values[j]
            low, high = (None, None) if condition.low is None else (condition.low[j], condition.high[j])
            open_below = name == "v_s" and low == 0.0
            reach = np.hypot(
                t_quantile(variance.df) * np.linalg.norm(effects[j]),
                t_quantile(specimens.df or np.inf) * np.sqrt(of_specimens[j]),
            )
            if reach > 0 and low is not None:  # the half-widths are added in quadrature
                low = max(value - float(np.hypot(value - low, reach)), 0.0)
                high = value + float(np.hypot(high - value, reach))
            # At its limit a parameter is not known with error 0.
            se = None if value == 0.0 else np.sqrt(covariance[j, j] + of_specimens[j])
            row |= {"value": value, "se": se}
            row |= {"lo95": None if open_below else low, "hi95": high, "u_sys": abs(shift[j])}
        row |= {"quantity": "steady", "parameter": spelled[name], "unit": unit_of[name]}
        yield STEADY_FIT, table_row(**row)
    for row in _statistics(condition, variance, specimens, scatter, config):
        yield STEADY_FIT, row
    for i, one in enumerate(condition.names if np.isfinite(variance.value) else ()):
        for j, other in enumerate(condition.names[: i + 1]):
            row = {"model": "before", "parameter": spelled[other], "other": spelled[one]}
            row |= {"value": covariance[i, j] if np.isfinite(covariance[i, j]) else np.nan}
            row |= {"unit": _product(unit_of[other], unit_of[one])}
            yield STEADY_COVARIANCE, row | {"identified": judged[one][0] and judged[other][0]}
    for j, name in enumerate(condition.names):
        row = {"model": "before", "parameter": spelled[name], "unit": unit_of[name]}
        row["identified"] = judged[name][0]
        for source, value in (("sensor", shift[j]), *enumerate(effects[j], start=1)):
            yield STEADY_SHIFT, {**row, "source": str(source), "value": value}


def _statistics(
    condition: Condition,
    variance: tuple,
    specimens: SpecimenScatter,
    scatter: RepeatScatter,
    config: Config,
) -> Iterator[dict]:
    repeated, force_unit = scatter.df > 0, config.units.unit("force")
    no_repeats = "" if repeated else "no run was repeated: there is no pure error to compare with."
    chi2, df = condition.chi2_within, condition.df_within
    ratio = chi2 / df if df else None
    lack = no_repeats
    if repeated and condition.df == 0:
        lack = "as many parameters as runs: the fit cannot disagree with them."
    elif repeated and variance.p < SIGNIFICANT:
        lack = "lack of fit: the runs disagree with the model by more than their repeats scatter (set-up "
        lack += "scatter between runs, or something the model lacks); "
        lack += f"intervals are widened {np.sqrt(variance.value):.2g} times."
    if condition.left_out:
        lack += f" {condition.left_out} runs without load were left out of the fit."
    own = no_repeats or ("own" if variance.own else "pooled")
    residual = condition.arrays[2] - condition.model_force()
    for name, value, unit, reason in (
        ("chi2", chi2 if repeated else None, "", no_repeats),
        ("df", df, "", ""),
        ("reduced_chi2", ratio if repeated else None, "", no_repeats),
        ("lack_of_fit_F", variance.f, "", no_repeats),
        ("lack_of_fit_p", variance.p, "", lack.strip()),
        ("birge_ratio", np.sqrt(variance.value) if repeated else None, "", own),
        ("error_df", variance.df, "", "degrees of freedom of the intervals' Student t"),
        ("specimen_sd_pct", specimens.sd_pct, "%", specimens.remark),
        ("specimen_df", specimens.df or None, "", "degrees of freedom of specimen_sd_pct"),
        ("flat_p", condition.flat_p, "", "chance of this much Stribeck curve where mu_s = mu_c"),
        ("rmse_N", np.sqrt(np.mean(residual**2)), force_unit, ""),
        ("n_runs", len(condition.runs), "", ""),
        ("n_files", condition.runs["files"].sum(), "", ""),
        ("n_speeds", condition.speeds, "", "levels within one direction"),
    ):
        yield table_row(quantity="statistics", parameter=name, value=value, unit=unit, reason=reason)


def parameter_units(units: Units, has_load: bool) -> dict[str, str]:
    """Return the units of mu_s, mu_c (or F_s, F_c), v_s and sigma_2 that follow from the config's units."""
    force, speed, load = units.unit("force"), units.unit("speed"), units.unit("load")
    mu = force if not has_load else "" if force == load else fill_unit("{y}/{x}", load, force)
    per_speed = fill_unit("{y}/{x}", speed, force)
    sigma_2 = f"{force} s/{speed.removesuffix('/s')}" if speed.endswith("/s") else per_speed
    return {"mu_s": mu, "mu_c": mu, "v_s": speed, "sigma_2": sigma_2}


def _product(one: str, other: str) -> str:
    if one == other:
        return f"({one})^2" if one else ""
    return " ".join(f"({unit})" for unit in (one, other) if unit)


def covariance_matrix(covariances: Mapping[tuple[str, str], float], names: Sequence[str]) -> np.ndarray:
    """Return the covariance of parameters, shape (p, p), from values by ("mu_s", "mu_c"); 0 if unknown."""
    upper = np.array([[covariances.get((one, other), 0.0) for other in names] for one in names])
    upper = np.where(np.isfinite(upper), upper, 0.0)
    return upper + np.triu(upper, 1).T


def table_row(
    *, quantity: str, parameter: str, unit: str, identified: bool = True, reason: str = "", **numbers
) -> dict:
    """Return one row of a fit table from any of `NUMBERS`; None and infinite ends become null."""
    known = {name: value for name, value in numbers.items() if value is not None and np.isfinite(value)}
    row = {"model": "before", "quantity": quantity, "parameter": parameter}
    row |= {name: float(known.get(name, np.nan)) for name in NUMBERS}
    return row | {"unit": unit, "identified": bool(identified), "reason": reason}
