"""The tables of a notebook: one meaning each, a row per key, true units in `attrs`."""

from collections.abc import Mapping, Sequence

import pandas as pd

from sealfit.config import Config
from sealfit.report.summary import ERRORS, FLOORED, STATISTICS, verdict_sentence
from sealfit.tables import Schema
from sealfit.units import Units

OF_CONDITIONS = ("steady", "dynamic")  # `quantity` of the rows that are parameters of a condition
# In the order of the equations.
PARAMETERS = ("mu_s", "mu_c", "F_s", "F_c", "v_s", "sigma_2", "sigma_0", "sigma_1")
ESTIMATE = ("value", "se", "lo95", "hi95", "u_sys", "unit", "before", "identified", "reason", "model")
EFFECT = [
    "effect", "id", "label", "channels", "level", "acts_on", "operation", "form", "named", "candidate",
    "p_value", "heldout_gain_N", "heldout_rmse_N", "reference",
]  # fmt: skip
SCATTER = ["level", "sd_rel", "sd_N", "df"]
SENSITIVITY = ["variable", "level", "acts_on", "smallest_N", "smallest_pct", "files_needed", "cannot_tell"]


def with_units(frame: pd.DataFrame, units: Units, schema: Schema | None = None) -> pd.DataFrame:
    """Return the frame with `attrs["units"]`, the true unit by column, and with a schema `attrs["meaning"]`.

    >>> with_units(pd.DataFrame({"force_N": [1.0], "n": [2]}), Units({"force": ("torque", "mN m")})).attrs
    {'units': {'force_N': 'mN m'}}
    """
    columns = [column for column in schema.columns if column.name in frame] if schema else []
    stored = {column.name: column.unit for column in columns}
    found = {name: units.of(name) or stored.get(name, "") for name in map(str, frame)}
    frame.attrs = {"units": {name: unit for name, unit in found.items() if unit}}
    if schema:
        frame.attrs["meaning"] = {column.name: column.meaning for column in columns}
    return frame


def verdict(closure: Mapping, units: Units) -> pd.DataFrame:
    """Return one row: the verdict, its sentence, how good the fit is, and what is left."""
    quality, left = closure["fit_quality"], closure["left"]
    row = {
        "verdict": closure["verdict"],
        "sentence": verdict_sentence(closure, units),
        "effects": sum(not effect["candidate"] for effect in closure["effects"]),
        "fit_quality": quality["state"],
        "error_over_scatter": quality["ratio"],
        "lack_of_fit_p": quality["p_value"],
        **{f"left_{name}": left[name] for name in ("rmse_N", "level", "channel")},
        "left_p": left["p_value"],
    }
    return with_units(pd.DataFrame([row]), units)


def errors(closure: Mapping, units: Units) -> pd.DataFrame:
    """Return a row per error: before, after, the noise floor where it compares with it, unit and meaning."""
    held, floor = closure["heldout_unit"], closure["noise_floor_N"]
    rows = [
        {
            "error": name,
            "before": closure["before"][name],
            "after": closure["after"][name],
            "noise_floor": floor if name in FLOORED else None,
            "unit": units.of(name),
            "meaning": meaning.format(held=held),
        }
        for name, meaning in ERRORS.items()
    ]
    return _frame(rows, None, ("before", "after", "noise_floor"), units)


def effects(closure: Mapping, units: Units) -> pd.DataFrame:
    """Return a row per effect, added or candidate; `effect` is its number, from 0."""
    rows = [
        {**effect, "effect": k, "channels": " ".join(effect["channels"])}
        for k, effect in enumerate(closure["effects"])
    ]
    return _frame(rows, EFFECT, ("p_value", "heldout_gain_N", "heldout_rmse_N"), units)


def effect_parameters(closure: Mapping, units: Units) -> pd.DataFrame:
    """Return a row per effect and parameter, with the ends of its 95 % interval."""
    columns = ["effect", "id", "parameter", "value", "lo95", "hi95", "unit"]
    rows = [
        (k, effect["id"], own["name"], own["value"], *own["ci95"], own["unit"])
        for k, effect in enumerate(closure["effects"])
        for own in effect["parameters"]
    ]
    return _frame(rows, columns, ("value", "lo95", "hi95"), units)


def scatter(closure: Mapping, units: Units) -> pd.DataFrame:
    """Return a row per level of scatter: file, run, specimen."""
    return _frame(closure["scatter"], SCATTER, SCATTER[1:], units)


def sensitivity(closure: Mapping, units: Units) -> pd.DataFrame:
    """Return a row per variable, level and target: the smallest effect to be found with 80 % chance."""
    numbers = ("smallest_N", "smallest_pct", "files_needed")
    return _frame(closure["sensitivity"], SENSITIVITY, numbers, units)


def _frame(rows: list, columns: list[str] | None, numbers: Sequence[str], units: Units) -> pd.DataFrame:
    """Return rows as a frame with units; of columns of numbers an unavailable value (null) is NaN."""
    frame = pd.DataFrame(rows, columns=columns)
    frame = frame.assign(**{name: pd.to_numeric(frame[name]).astype(float) for name in numbers})
    return with_units(frame, units)


def parameters(fits: Sequence[pd.DataFrame], before: Sequence[pd.DataFrame], config: Config) -> pd.DataFrame:
    """Return a row per condition and parameter of Eqs. 1 to 14; unaged rubber has them in each of its series.

    `fits` are tables `steady_fit` and `dynamic_fit` of the answer, and `before` the same without effects.
    """
    rows = _with_before(_of_conditions(fits), _of_conditions(before), ["condition", "parameter"])
    if config.aging and "aging_days" in rows:
        rows = _starting_series(rows, config)
    keys = [name for name in (*config.condition, *config.rubber) if name in rows]
    order = ["series", *(["aging_days"] if "aging_days" in rows else []), "condition"]
    rank = rows["parameter"].map({name: k for k, name in enumerate(PARAMETERS)})
    rows = rows.assign(rank=rank).sort_values([*order, "rank"], kind="stable")
    columns = dict.fromkeys(["series", "rubber", "condition", *keys, "parameter", *ESTIMATE])
    return rows[list(columns)].reset_index(drop=True)


def laws(fit: pd.DataFrame, before: pd.DataFrame, config: Config) -> pd.DataFrame:
    """Return a row per series, quantity and parameter of Eq. 15: mu_0, a, b, c of mu_s, mu_c or a property.

    `fit` is table `aging_fit` of the answer, and `before` the same without effects.
    """
    rows, earlier = (own[own["quantity"] != STATISTICS] for own in (fit, before))
    rows = _with_before(rows, earlier, ["series", "quantity", "parameter"])
    keys = [name for name in (*config.series_columns, *config.rubber) if name in rows]
    columns = dict.fromkeys(["series", "rubber", *keys, "quantity", "parameter", *ESTIMATE])
    return rows[list(columns)].reset_index(drop=True)


def _of_conditions(fits: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return the rows of parameters, whatever else a fit has: statistics, break-aways."""
    kept = [fit[fit["quantity"].isin(OF_CONDITIONS)] for fit in fits]
    return pd.concat([part for part in kept if len(part)] or kept[:1], ignore_index=True)


def _with_before(rows: pd.DataFrame, before: pd.DataFrame, keys: list[str]) -> pd.DataFrame:
    earlier = before[[*keys, "value"]].rename(columns={"value": "before"})
    return rows.merge(earlier, on=keys, how="left", validate="one_to_one")


def _starting_series(rows: pd.DataFrame, config: Config) -> pd.DataFrame:
    """Return the rows, those of unaged rubber once in each of its series, under the series' columns."""
    days = rows["aging_days"].to_numpy(float)
    aged, unaged = rows[days > 0], rows[~(days > 0)]
    columns = [name for name in ("series", *config.series_columns, *config.rubber) if name in rows]
    series = aged[list(dict.fromkeys(["rubber", *columns]))].drop_duplicates("series")
    own = [name for name in columns if name != "rubber"]
    starts = unaged.drop(columns=own).merge(series, on="rubber", how="inner")
    alone = unaged[~unaged["rubber"].isin(set(series["rubber"]))]
    parts = [part for part in (starts, aged, alone) if len(part)]
    return pd.concat(parts, ignore_index=True)[rows.columns] if parts else rows
