"""The fitted parameters as tables to read: a row per condition or series, each parameter with interval and u_sys."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pandas as pd
from markupsafe import Markup

from sealfit.config import Config
from sealfit.report.numbers import NOTHING, known, measured, number
from sealfit.report.symbols import ConditionNames, quantity_words, symbol_html, true_units

STATISTICS = ("rmse_N", "reduced_chi2", "lack_of_fit_p", "df", "n_runs", "n_files", "n_speeds")
HIDDEN = ("covariance", "sensor_shift")  # for programs; they stand in the Parquet tables


@dataclass(frozen=True)
class Cell:
    """One parameter of one row; `words` says in its place why these data do not determine it."""

    value: str = NOTHING
    interval: str = NOTHING
    u_sys: str = NOTHING
    words: str | Markup = ""


@dataclass(frozen=True)
class ParameterTable:
    """A table ready to be written: heads of the key columns, (symbol, unit) of each parameter, rows, remarks."""

    title: str
    heads: tuple[str, ...]
    groups: tuple[tuple[Markup, str], ...]
    rows: tuple[tuple[tuple[str | Markup, ...], tuple[Cell, ...], str], ...]
    single: bool = False  # values only: statistics have neither interval nor u_sys


def parameter_tables(fit: pd.DataFrame, key: str, config: Config) -> list[ParameterTable]:
    """Return the tables of `steady_fit` (key "condition") or `aging_fit` (key "series").

    Quantities with the same parameters share a table; units stand in the head, and where a parameter has another unit
    than in the head's row it has a column of its own.

    Parameters
    ----------
    fit : DataFrame
        Table `steady_fit` or `aging_fit`, perhaps empty.
    key : str
        Column that tells the rows apart.
    config : Config
        Names the conditions and gives the true units.
    """
    fit = fit[~fit["quantity"].isin(HIDDEN)]
    if fit.empty:
        return []
    names = ConditionNames.of(config)
    of_quantity = {
        quantity: tuple(dict.fromkeys(zip(rows["parameter"], rows["unit"].fillna(""), strict=True)))
        for quantity, rows in fit.groupby("quantity", sort=False)
    }
    tables = []
    for parameters in dict.fromkeys(of_quantity.values()):
        quantities = [quantity for quantity, own in of_quantity.items() if own == parameters]
        rows = fit[fit["quantity"].isin(quantities)]
        if quantities == ["statistics"]:
            tables.append(_statistics(rows, key, names, config))
        else:
            tables.append(_table(rows, key, quantities, parameters, names, config))
    return tables


def _table(
    fit: pd.DataFrame,
    key: str,
    quantities: Sequence[str],
    parameters: Sequence[tuple[str, str]],
    names: ConditionNames,
    config: Config,
) -> ParameterTable:
    several = len(quantities) > 1 or key == "series"
    found = []
    for (name, quantity), rows in fit.groupby([key, "quantity"], sort=False):
        by = {(row["parameter"], row["unit"] or ""): row for row in _records(rows)}
        cells = tuple(_cell(by.get(parameter), config) for parameter in parameters)
        keys = (names(name), symbol_html(quantity)) if several else (names(name),)
        found.append((keys, cells, _remark(by, config)))
    heads = (_head(key), "of") if several else (_head(key),)
    return ParameterTable(
        _title(key, quantities), heads, tuple((symbol_html(p), u) for p, u in parameters), tuple(found)
    )


def _statistics(fit: pd.DataFrame, key: str, names: ConditionNames, config: Config) -> ParameterTable:
    present = {(row["parameter"], row["unit"] or "") for row in _records(fit)}
    shown = [(name, unit) for name in STATISTICS for found, unit in sorted(present) if found == name]
    shown = shown or sorted(present)
    found = []
    for name, rows in fit.groupby(key, sort=False):
        by = {(row["parameter"], row["unit"] or ""): row for row in _records(rows)}
        cells = tuple(Cell(number(by[p]["value"]) if p in by else NOTHING) for p in shown)
        lack = {p: row for p, row in by.items() if p[0] == "lack_of_fit_p"}
        found.append(((names(name),), cells, _remark(lack, config, named=False)))
    groups = tuple((Markup("{}").format(quantity_words(p)), u) for p, u in shown)
    return ParameterTable(
        "How well the fits do" if key == "condition" else "How well the aging law does",
        (_head(key),),
        groups,
        tuple(found),
        single=True,
    )


def _records(rows: pd.DataFrame) -> list[dict]:
    plain = rows[["parameter", "unit", "value", "lo95", "hi95", "u_sys", "identified", "reason"]].astype(object)
    return plain.where(plain.notna(), None).to_dict("records")


def _cell(row: Mapping | None, config: Config) -> Cell:
    if row is None:
        return Cell()
    if not row["identified"]:
        why = row["reason"] or "these data do not determine it"
        return Cell(words=f"not identified: {true_units(why, config.units)}")
    value, interval = measured(row["value"], row["lo95"], row["hi95"])
    return Cell(value, interval, number(row["u_sys"], 2) if known(row["u_sys"]) else NOTHING)


def _remark(rows: Mapping[tuple[str, str], Mapping], config: Config, *, named: bool = True) -> Markup:
    """Return every remark on a row once, with the parameters it is about."""
    about: dict[str, list[str]] = {}
    for (parameter, _), row in rows.items():
        if row["reason"] and row["identified"]:  # what is not identified says so, and why, in its own cell
            about.setdefault(str(row["reason"]), []).append(parameter)
    said = [
        Markup("{}: {}").format(
            Markup(", ").join([symbol_html(p) for p in parameters]), true_units(reason, config.units)
        )
        if named
        else Markup("{}").format(true_units(reason, config.units))
        for reason, parameters in about.items()
    ]
    return Markup("; ").join(said)


def _head(key: str) -> str:
    return {"condition": "condition", "series": "series"}.get(key, key)


def _title(key: str, quantities: Sequence[str]) -> str:
    if key == "condition":
        return "Steady friction, fitted to each condition on its own"
    return (
        "Aging law, fitted to each series"
        if set(quantities) <= {"mu_s", "mu_c", "F_s", "F_c"}
        else ", ".join(quantities)
    )
