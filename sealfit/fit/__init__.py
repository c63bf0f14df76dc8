"""How a fit is stored: its parameters in one table, their covariances and shifts in tables of their own.

The fits hand each other one long table, in which `quantity` also is "covariance", "sensor_shift" or
"effect_shift". On the disk every table has one meaning, so that `steady_fit` has one row per condition and
parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pandas as pd

COVARIANCE, SENSOR, EFFECTS = "covariance", "sensor_shift", "effect_shift"
BESIDE = (COVARIANCE, SENSOR, EFFECTS)
SPLIT = {"steady_fit": ("steady_covariance", "steady_shift"), "aging_fit": ("aging_covariance", None)}
# Columns that rows of the other tables lack.
OF_PARAMETERS = ("quantity", "se", "lo95", "hi95", "u_sys", "reason")
AFTER = "_after"


def stored(name: str, fit: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the tables that store table `name`, by name.

    They are several for "steady_fit", "aging_fit" and the same with "_after", as `fit_conditions`,
    `fit_series` and `after_laws` return them; any other table is stored as it is.

    Examples
    --------
    >>> rows = [("steady", "mu_s", 0.9), ("covariance", "mu_s,mu_c", 1e-5), ("sensor_shift", "mu_s", 0.002)]
    >>> fit = pd.DataFrame(rows, columns=["quantity", "parameter", "value"]).assign(condition="unaged")
    >>> tables = stored("steady_fit", fit)
    >>> [(name, len(table)) for name, table in tables.items()]
    [('steady_fit', 1), ('steady_covariance', 1), ('steady_shift', 1)]
    >>> tables["steady_covariance"][["parameter", "other"]].values.tolist()
    [['mu_s', 'mu_c']]
    """
    suffix = AFTER if name.endswith(AFTER) else ""
    covariance, shift = SPLIT.get(name.removesuffix(AFTER), (None, None))
    if covariance is None:
        return {name: fit}
    quantity = fit["quantity"]
    tables = {
        name: fit[~quantity.isin(BESIDE)],
        covariance + suffix: _covariances(fit[quantity == COVARIANCE]),
    }
    if shift is not None:
        tables[shift + suffix] = _shifts(fit[quantity.isin([SENSOR, EFFECTS])])
    return {name: table.reset_index(drop=True) for name, table in tables.items()}


def _covariances(rows: pd.DataFrame) -> pd.DataFrame:
    """Return covariances with both parameters in columns; a law's "mu_s:mu_0,mu_s:a" is of quantity mu_s."""
    ends = rows["parameter"].str.split(",")
    named = {name: ends.str[k].str.split(":").str[-1] for k, name in enumerate(("parameter", "other"))}
    if "condition" not in rows:
        named["quantity"] = ends.str[0].str.split(":").str[0]
    return _without_intervals(rows).assign(**named)


def _shifts(rows: pd.DataFrame) -> pd.DataFrame:
    """Return shifts with what causes them: the sensor, or a direction of the effects' uncertainty, from 1."""
    parts = (rows["parameter"] + ":sensor").str.split(":")
    return _without_intervals(rows).assign(source=parts.str[1], parameter=parts.str[0])


def _without_intervals(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.drop(columns=[name for name in OF_PARAMETERS if name in rows])


def whole_steady_fit(read: Callable[[str], pd.DataFrame], suffix: str = "") -> pd.DataFrame:
    """Return the long table that `fit_conditions` returned, from those in which it is stored.

    `read` returns a stored table by its name; `suffix` is "_after" for the fit without the loop's effects.
    """
    fit, covariance, shift = (read(f"{name}{suffix}") for name in ("steady_fit", *SPLIT["steady_fit"]))
    pairs = covariance["parameter"] + "," + covariance["other"]
    of_sensor = shift["source"] == "sensor"
    parameter = shift["parameter"].where(of_sensor, shift["parameter"] + ":" + shift["source"])
    parts = (
        covariance.drop(columns="other").assign(quantity=COVARIANCE, parameter=pairs, reason=""),
        shift.drop(columns="source").assign(
            quantity=np.where(of_sensor, SENSOR, EFFECTS), parameter=parameter, reason=""
        ),
    )
    return pd.concat([fit, *(part for part in parts if len(part))], ignore_index=True)


def covariance_matrix(covariances: Mapping[str, float], names: Sequence[str]) -> np.ndarray:
    """Return the covariance of parameters, shape (p, p), from values by "mu_s,mu_c"; 0 if unknown."""
    upper = np.array([[covariances.get(f"{one},{other}", 0.0) for other in names] for one in names])
    upper = np.where(np.isfinite(upper), upper, 0.0)
    return upper + np.triu(upper, 1).T
