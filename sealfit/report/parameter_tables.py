"""Tables of the fitted parameters and aging laws, each value with its interval."""

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

from sealfit.config import Config
from sealfit.report.drawing import MOST_ROWS, spread
from sealfit.report.notation import (
    NOTHING,
    ConditionNames,
    count,
    given,
    known,
    measured,
    number,
    symbol_html,
    true_units,
)
from sealfit.report.words import with_symbols

MOST_LAWS = 4  # listed per quantity
ROUNDING = 1e-12  # of coefficients of about 1 and forces of some N


def law_rows(aging_laws: pd.DataFrame, before: pd.DataFrame | None = None) -> list[dict]:
    """Return each quantity's laws with the lowest BIC, and the separate laws, a row of the page for each.

    A row has what table `aging_laws` says, and the parameters by name. The best law of `before` follows.
    """
    found = []
    earlier = {} if before is None else {row["key"]: row for row in law_rows(before) if row["rank"] == 1}
    for key, own in aging_laws.groupby(["rubber", "quantity"], sort=False):
        for rank, law in own.groupby("rank", sort=True):
            first = law.iloc[0].to_dict()
            if rank > MOST_LAWS and first["law"] != "separate":
                continue
            parameters = law.dropna(subset=["parameter"]).set_index("parameter")
            found.append({**first, "key": key, "before": False, "parameters": parameters})
            if rank == 1 and key in earlier:
                found.append({**earlier[key], "before": True})
    return found


def error_text(value: float) -> str:
    """Return an error of coefficients; one that is rounding alone is zero."""
    return number(0.0 if value < ROUNDING else value)


def with_interval(parameters: pd.DataFrame, name: str) -> str:
    """Return a law's parameter with its interval, or "not identified"; a dash for one that it has not."""
    if name not in parameters.index:
        return NOTHING
    row = parameters.loc[name]
    if not row["identified"]:
        return "not identified"
    return " ".join(measured(row["value"], row["lo95"], row["hi95"]))


STATISTICS = {
    "rmse_N": "rms error", "rmse": "rms error", "max_error_pct": "largest error",
    "specimen_sd_pct": "specimen scatter", "reduced_chi2": "χ² / df", "lack_of_fit_p": "lack of fit, p",
    "df": "df", "n_runs": "runs", "n_files": "files", "n_speeds": "speeds", "n_days": "days tested",
    "last_day": "last day",
}  # fmt: skip
TITLES = {
    "steady_fit": "Steady friction, per condition",
    "aging_fit": "Aging law per series",
    "dynamic_fit": "Pre-sliding stiffness and damping, per condition",
}
ENDS = ("value", "lo95", "hi95")
MOST_BREAK_AWAYS = 600


@dataclass(frozen=True)
class ParameterTable:
    """A table of the page with a row per condition or series and parameter; `key` says which of the two.

    A row has name, quantity, parameter, value, before, interval, u_sys, unit and note: why a parameter is not
    identified, or a remark. Statistics have neither an interval nor u_sys.
    """

    title: str
    key: str
    rows: list[dict]
    statistics: bool
    compared: bool  # whether rows have the value before
    excerpt: str = ""  # the number of conditions or series shown, where there are too many


def break_aways(dynamic_fit: pd.DataFrame) -> tuple[list[dict], int]:
    """Return the break-aways above sliding that the page has, as ratio and force (`_N`), and their number."""
    rows = dynamic_fit[dynamic_fit["quantity"] == "break_away"]
    ratios, forces = (rows[rows["parameter"] == parameter] for parameter in ("F_ba/F", "F_ba"))
    ratios = ratios[ratios["identified"].astype(bool) & (ratios["reason"].fillna("") == "")]
    keys = ["condition", "speed_set_mm_s", "direction"]
    above = ratios.merge(forces[[*keys, *ENDS]], on=keys, suffixes=("", "_N")).to_dict("records")
    return spread(above, MOST_BREAK_AWAYS), len(above)


def parameter_tables(
    fit: pd.DataFrame, name: str, config: Config, before: pd.DataFrame | None = None
) -> list[ParameterTable]:
    """Return the parameters in `fit`, one of the tables in `TITLES`, and its statistics, if they have rows.

    `before` is the same table without the loop's effects, for its values beside those of `fit`.
    """
    key, names = "series" if name == "aging_fit" else "condition", ConditionNames(config)
    every = sorted(fit[key].unique(), key=names.place)
    excerpt = ""
    if len(every) > MOST_ROWS:
        plural = key if key == "series" else None
        excerpt = f"{MOST_ROWS} of {count(len(every), key, plural)}, selected evenly; {name}.parquet has all."
    shown = {one: number for number, one in enumerate(spread(every, MOST_ROWS))}
    fit = fit[fit[key].isin(shown)].sort_values(key, key=lambda own: own.map(shown), kind="stable")
    earlier = {}
    if before is not None:
        identified = before[before["identified"].astype(bool)]
        earlier = identified.set_index([key, "quantity", "parameter"])["value"].to_dict()
    of_statistics = fit["quantity"] == "statistics"
    statistic = fit["parameter"].str.split(":").str[-1]
    told = of_statistics & statistic.isin(STATISTICS)
    told &= fit["value"].notna() | (statistic != "specimen_sd_pct")
    tables, joint = [], ", from the joint fit" if name == "aging_fit" and before is not None else ""
    for own, title, statistics in (
        (fit[~of_statistics], TITLES[name] + joint, False),
        (fit[told], f"Goodness of fit, per {key}", True),
    ):
        rows = [_row(row, key, earlier, config) for row in own.to_dict("records")]
        if rows:
            tables.append(ParameterTable(title, key, rows, statistics, before is not None, excerpt))
    return tables


def _row(row: Mapping, key: str, earlier: Mapping, config: Config) -> dict:
    """Return a row of the page of a row of a table of fits."""
    # The statistic "mu_s:lack_of_fit_p" is about mu_s alone.
    of, _, parameter = row["parameter"].rpartition(":")
    before = earlier.get((row[key], row["quantity"], row["parameter"]))
    value, interval = measured(*(row[name] for name in ENDS))
    if row["quantity"] == "statistics":
        quantity, symbol = symbol_html(of), STATISTICS[parameter]
        value, before = statistic(row["value"]), statistic(before)
    else:
        quantity, symbol, before = symbol_html(row["quantity"]), symbol_html(parameter), number(before)
    note = row["reason"]
    if not row["identified"]:
        value, interval = "not identified", NOTHING
        note = note or "these data do not determine it"
    return {
        "name": ConditionNames(config)(row[key]),
        "quantity": quantity,
        "parameter": symbol,
        "value": value,
        "before": before,
        "interval": interval,
        "u_sys": number(row["u_sys"], 2) if row["identified"] else NOTHING,
        "unit": row["unit"] if isinstance(row["unit"], str) else "",
        "note": with_symbols(true_units(note, config.units)) if isinstance(note, str) else "",
    }


def statistic(value: float | None) -> str:
    """Return a count without decimals, another statistic to three digits."""
    whole = known(value) and float(value).is_integer() and abs(value) >= 1
    return given(value, 9) if whole else number(value)
