"""Tables of the fitted parameters and aging laws, each value with its interval."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import pandas as pd
from markupsafe import Markup

from sealfit.config import Config
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
from sealfit.report.style import MOST_ROWS, spread
from sealfit.report.words import with_symbols

MOST_LAWS = 4  # listed per quantity
ROUNDING = 1e-12  # of coefficients of about 1 and forces of some N


def law_rows(aging_laws: pd.DataFrame, before: pd.DataFrame | None = None) -> list[dict]:
    """Return each quantity's laws with the lowest BIC, and the separate laws, a row of the page for each.

    A row has what table `aging_laws` says of a law, and its parameters by name. `before` is that table
    without the loop's effects; its best law follows that of `aging_laws`.
    """
    found = []
    earlier = {} if before is None else {row["key"]: row for row in law_rows(before) if row["rank"] == 1}
    for key, own in aging_laws.groupby(["rubber", "quantity"], sort=False):
        last = own["rank"].max()
        for rank, law in own.groupby("rank", sort=True):
            first = law.iloc[0].to_dict()
            if rank > MOST_LAWS and not (rank == last and first["law"] == "separate"):
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


# ---------------------------------------------------------------- parameters

STATISTICS = {
    "rmse_N": "rms error", "rmse": "rms error", "max_error_pct": "largest error",
    "specimen_sd_pct": "specimen scatter", "reduced_chi2": "χ² / df", "lack_of_fit_p": "lack of fit, p",
    "df": "df", "n_runs": "runs", "n_files": "files", "n_speeds": "speeds", "n_days": "days tested",
    "last_day": "last day",
}  # fmt: skip
ENDS = ("value", "lo95", "hi95")
MOST_BREAK_AWAYS = 600

SHARED = 3  # rows with one note, from which it is said once
_NUMBERS = re.compile(r"(?<![\w<;&#.])\d+(?:\.\d+)?(?![\w.]*[<;])")  # not those in symbols or in markup
Fitted = Mapping | None
Rows = dict[tuple[str, str], Mapping]  # of one condition or series, by parameter and unit


@dataclass(frozen=True)
class ParameterTable:
    """A table for the page: heads of the key columns, (symbol, unit) of each parameter, rows, notes.

    A row has keys, cells and a note: why a parameter is not identified, or a remark. A cell is the row of a
    parameter in the table of fits, and that without the loop's effects; None where there is none.
    """

    title: str
    heads: tuple[str, ...]
    groups: tuple[tuple[Markup, str], ...]
    rows: tuple[tuple[tuple[str | Markup, ...], tuple[tuple[Fitted, Fitted], ...], Markup], ...]
    single: bool = False  # values only: statistics have neither interval nor u_sys
    note: str = ""  # the number of rows shown, where there are too many
    compared: bool = False  # whether cells have the value before
    remarks: tuple[Markup, ...] = ()  # notes that several rows share, below the table


def break_aways(dynamic_fit: pd.DataFrame) -> tuple[list[dict], int]:
    """Return the break-away forces above the sliding force that the page has, and the number of all.

    Each is the row of its ratio to the sliding force; the force itself has the suffix `_N`.
    """
    rows = dynamic_fit[dynamic_fit["quantity"] == "break_away"]
    ratios, forces = (rows[rows["parameter"] == parameter] for parameter in ("F_ba/F", "F_ba"))
    ratios = ratios[ratios["identified"].astype(bool) & (ratios["reason"].fillna("") == "")]
    keys = ["condition", "speed_set_mm_s", "direction"]
    above = ratios.merge(forces[[*keys, *ENDS]], on=keys, suffixes=("", "_N")).to_dict("records")
    return spread(above, MOST_BREAK_AWAYS), len(above)


def parameter_tables(
    fit: pd.DataFrame, key: str, config: Config, before: pd.DataFrame | None = None
) -> list[ParameterTable]:
    """Return the tables of `steady_fit` (key "condition") or `aging_fit` (key "series").

    Quantities with the same parameters share a table; units stand in the head, and where a parameter has
    another unit than in the head's row it has a column of its own. `before` is the same table without the
    loop's effects, for its values beside those of `fit`.
    """
    if fit.empty:
        return []
    of_quantity = {
        quantity: tuple(dict.fromkeys(zip(rows["parameter"], rows["unit"].fillna(""), strict=True)))
        for quantity, rows in fit.groupby("quantity", sort=False)
    }
    fit, note = _readable(fit, key, ConditionNames.of(config))
    tables = []
    for parameters in dict.fromkeys(of_quantity.values()):
        quantities = [quantity for quantity, own in of_quantity.items() if own == parameters]
        rows = fit[fit["quantity"].isin(quantities)]
        if quantities == ["statistics"]:
            tables.append(_statistics(rows, key, config))
        else:
            tables.append(_parameters(rows, key, parameters, config, before))
    return [replace(table, note=note) for table in tables]


def _readable(fit: pd.DataFrame, key: str, names: ConditionNames) -> tuple[pd.DataFrame, str]:
    """Return the rows of at most `MOST_ROWS` conditions or series, and a note on the selection."""
    every = sorted(fit[key].unique(), key=names.place)
    if len(every) <= MOST_ROWS:
        return fit, ""
    stored = "dynamic_fit" if "dynamic" in set(fit["quantity"]) else "steady_fit"
    if key == "series":
        stored = "aging_fit"
    note = f"{MOST_ROWS} of {count(len(every), key, key if key == 'series' else None)}, selected evenly; "
    return fit[fit[key].isin(spread(every, MOST_ROWS))], f"{note}{stored}.parquet has all."


def _parameters(
    fit: pd.DataFrame,
    key: str,
    parameters: Sequence[tuple[str, str]],
    config: Config,
    before: pd.DataFrame | None,
) -> ParameterTable:
    names, quantities = ConditionNames.of(config), list(dict.fromkeys(fit["quantity"]))
    compared = before is not None
    records = _records(before, key) if compared else ()
    earlier = {(row[key], row["quantity"], row["parameter"]): row for row in records}
    several = len(quantities) > 1 or key == "series"
    found = []
    for name, quantity, by in _rows_of(fit, key, names):
        cells = tuple((by.get(p), earlier.get((name, quantity, p[0]))) for p in parameters)
        found.append((_heads(names(name), symbol_html(quantity), several), cells, _note(by, config)))
    groups = tuple((symbol_html(p), u) for p, u in parameters)
    title = _title(key, quantities, after=compared)
    rows, remarks = _said_once(found)
    heads = _heads(key, "quantity", several)
    return ParameterTable(title, heads, groups, rows, compared=compared, remarks=remarks)


def _heads(first: str, second: str | Markup, several: bool) -> tuple[str | Markup, ...]:
    return (first, second) if several else (first,)


def _said_once(rows: Sequence[tuple]) -> tuple[tuple[tuple, ...], tuple[Markup, ...]]:
    """Return the rows without the notes that several share but for a number, and these notes, each once."""
    alike: dict[str, list[Markup]] = {}
    for *_, note in rows:
        if note:
            alike.setdefault(_NUMBERS.sub("\0", note), []).append(note)
    shared = {form: notes for form, notes in alike.items() if len(notes) >= SHARED}
    kept = tuple((*row, Markup("") if _NUMBERS.sub("\0", note) in shared else note) for *row, note in rows)
    remarks = []
    for form, notes in shared.items():
        of = "all rows" if len(notes) == len(rows) else f"{len(notes)} of {len(rows)} rows"
        numbers = iter(map(_range, zip(*map(_NUMBERS.findall, notes), strict=True)))
        text = re.sub("\0", lambda _, own=numbers: next(own), form)
        remarks.append(Markup(f"{text} ({of})"))
    return kept, tuple(remarks)


def _range(numbers: Sequence[str]) -> str:
    """Return equal numbers as one, others as the smallest to the largest."""
    low, high = min(numbers, key=float), max(numbers, key=float)
    return low if low == high else f"{low} to {high}"


def _statistics(fit: pd.DataFrame, key: str, config: Config) -> ParameterTable:
    names, parts = ConditionNames.of(config), fit["parameter"].str.rpartition(":")
    fit = fit.assign(quantity=parts[0], parameter=parts[2])  # "mu_s:lack_of_fit_p" is about mu_s alone
    several = fit["quantity"].ne("").any()
    present = sorted(set(zip(fit["parameter"], fit["unit"].fillna(""), strict=True)))
    shown = [p for name in STATISTICS for p in present if p[0] == name] or present
    found = []
    for name, quantity, by in _rows_of(fit, key, names):
        cells = tuple((by.get(p), None) for p in shown)
        lack = {p: row for p, row in by.items() if p[0] == "lack_of_fit_p"}
        keys = _heads(names(name), symbol_html(quantity), several)
        found.append((keys, cells, _note(lack, config, named=False)))
    groups = tuple((STATISTICS.get(p, p.removesuffix("_N").replace("_", " ")), u) for p, u in shown)
    title = f"Goodness of fit{' of the aging law' if key == 'series' else ''}, per {key}"
    return ParameterTable(title, _heads(key, "quantity", several), groups, tuple(found), single=True)


def _rows_of(fit: pd.DataFrame, key: str, names: ConditionNames) -> list[tuple[str, str, Rows]]:
    """Return (name, quantity, rows by parameter and unit): unaged first, then by temperature, ..., days."""
    found: dict[tuple[str, str], Rows] = {}
    for row in _records(fit, key):
        found.setdefault((row[key], row["quantity"]), {})[row["parameter"], row["unit"] or ""] = row
    return sorted(((*keys, by) for keys, by in found.items()), key=lambda entry: names.place(entry[0]))


def _records(rows: pd.DataFrame, key: str) -> list[dict]:
    """Return rows as dictionaries, with None for missing values."""
    columns = [key, "quantity", "parameter", "unit", *ENDS, "u_sys", "identified", "reason"]
    plain = rows[columns].astype(object)
    return plain.where(plain.notna(), None).to_dict("records")


def statistic(row: Fitted) -> str:
    """Return a count without decimals, another statistic to three digits."""
    if row is None:
        return NOTHING
    whole = known(row["value"]) and float(row["value"]).is_integer() and abs(row["value"]) >= 1
    return given(row["value"], 9) if whole else number(row["value"])


def estimate(row: Fitted) -> tuple[str, str, str]:
    """Return the value of a parameter or that it is not identified, its interval, and its u_sys."""
    if row is None:
        return NOTHING, NOTHING, NOTHING
    if not row["identified"]:
        return "not identified", NOTHING, NOTHING
    return *measured(*(row[name] for name in ENDS)), number(row["u_sys"], 2)


def _note(rows: Mapping[tuple[str, str], Mapping], config: Config, *, named: bool = True) -> Markup:
    """Return the reasons and remarks of a row, each once, with its parameters."""
    about: dict[tuple[bool, str], list[Markup]] = {}
    for (parameter, _), row in rows.items():
        why = row["reason"] or ("" if row["identified"] else "these data do not determine it")
        if why:
            about.setdefault((bool(row["identified"]), why), []).append(symbol_html(parameter))
    said = []
    for (identified, why), symbols in about.items():
        lead = Markup(", ").join(symbols if named else [])
        lead += "" if identified else " not identified"
        said.append(
            Markup("{}{}{}").format(lead, ": " if lead else "", with_symbols(true_units(why, config.units)))
        )
    return Markup("<br>").join(said)


def _title(key: str, quantities: Sequence[str], *, after: bool) -> str:
    if quantities == ["dynamic"]:
        return "Pre-sliding stiffness and damping, per condition"
    if key == "condition":
        return "Steady friction, per condition"
    if set(quantities) <= {"mu_s", "mu_c", "F_s", "F_c"}:
        return "Aging law per series, from the joint fit" if after else "Aging law per series"
    return f"Aging law per series: {', '.join(quantities)}"
