"""Columns of a campaign's listing, and the keys `condition`, `series` and `rubber` built from them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.errors import SealfitError

# ---------------------------------------------------------------- columns

Value = float | str
Column = list[Value | None]  # a value of every file, None where it has none
Columns = dict[str, Column]


def mapped(column: Column, change: Callable[[Value], Value | None]) -> Column:
    """Return the column with every value changed; None stays None."""
    return [None if value is None else change(value) for value in column]


def where(column: Column, holds: Callable[[Value], bool]) -> np.ndarray:
    """Return which files have a value of which `holds` is true, shape (files,)."""
    return np.array([value is not None and bool(holds(value)) for value in column], bool)


def known(column: Column) -> np.ndarray:
    """Return which files have a value, shape (files,)."""
    return where(column, lambda value: True)


def put(column: Column, cells: Mapping[int, Value]) -> Column:
    """Return the column with other values for some files, by their numbers."""
    return [cells.get(i, value) for i, value in enumerate(column)]


def columns_of(rows: Sequence[Mapping[str, Value]]) -> Columns:
    """Return rows of named values as columns, in the order in which the names appear."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in names}


def over(column: Column, other: Column) -> Column:
    """Return the column with the values of `other` for files that have none."""
    return [theirs if own is None else own for own, theirs in zip(column, other, strict=True)]


def overlaid(*columns: Columns) -> Columns:
    """Return columns of the same files in one; the last that has a value for a file says it."""
    whole: Columns = {}
    for some in columns:
        for name, column in some.items():
            whole[name] = over(column, whole[name]) if name in whole else column
    return whole


def taken(columns: Columns, files: Sequence[int]) -> Columns:
    """Return the columns of some of the files, by their numbers."""
    return {name: [column[i] for i in files] for name, column in columns.items()}


def in_order(columns: Columns) -> Columns:
    """Return the columns in the order of the first file with a value in each, without those that none has."""
    first = {
        name: next((i for i, value in enumerate(c) if value is not None), None) for name, c in columns.items()
    }
    filled = [name for name in columns if first[name] is not None]
    return {name: columns[name] for name in sorted(filled, key=lambda name: first[name])}


# ---------------------------------------------------------------- conditions
# The keys `condition`, `series` and `rubber` of a table, built from its condition columns; the one place that
# spells them.

UNAGED = "unaged"
ALL = "all"  # the series of a rig whose only condition is its age
ONE_RUBBER = "rubber"


def condition_columns(config: Config) -> list[str]:
    """Return the columns that make a condition: the config's, and the rubber columns not among them."""
    return [*config.condition, *(name for name in config.rubber if name not in config.condition)]


def add_keys(table: pd.DataFrame, config: Config) -> pd.DataFrame:
    """Return `table` with `condition`, `series` and `rubber`.

    A condition is spelled "temperature_C=60, compression_ratio_pct=80, aging_days=4"; a series is the
    condition without days ("all" when no other column is left). Rows with aging_days = 0 are "unaged" in both
    ("unaged, <rubber>" where the config names rubber columns), whatever stands in their other condition
    cells. Without days, series and condition are equal. A row with an empty condition cell has null for both,
    unless it is unaged.

    Parameters
    ----------
    table : DataFrame
        With the config's condition and rubber columns, numbers or text; not changed.
    config : Config
        Says which columns they are.

    Raises
    ------
    SealfitError
        If a condition or rubber column is missing.

    Examples
    --------
    >>> runs = pd.DataFrame(
    ...     {"temperature_C": [60, 60], "compression_ratio_pct": [80, 80], "aging_days": [4, 0]}
    ... )
    >>> add_keys(runs, Config())[["condition", "series"]].values.tolist()[1]
    ['unaged', 'unaged']
    """
    columns = condition_columns(config)
    missing = [name for name in columns if name not in table.columns]
    if missing:
        raise SealfitError(
            f"condition column {', '.join(repr(name) for name in missing)} is missing.",
            fix="Add it, or name other columns in the config's condition and rubber.",
        )
    keys = keys_of({name: table[name].tolist() for name in columns}, len(table), config)
    return table.assign(**{key: pd.array(words, dtype="str") for key, words in keys.items()})


def keys_of(
    columns: Mapping[str, Sequence[object]], rows: int, config: Config
) -> dict[str, list[str | None]]:
    """Return `condition`, `series` and `rubber` of every row, as `add_keys`, from all condition columns."""
    texts = {name: _spelled(columns[name]) for name in condition_columns(config)}
    words = {name: [t if t is None else f"{name}={t}" for t in own] for name, own in texts.items()}
    condition = _joined(words.values(), rows)
    rubber = _joined([texts[name] for name in config.rubber], rows) if config.rubber else [ONE_RUBBER] * rows
    series = condition
    if config.aging:
        others = [own for name, own in words.items() if name != "aging_days"]
        series = _joined(others, rows) if others else [ALL] * rows
        unaged = _joined([[UNAGED] * rows, *([rubber] if config.rubber else [])], rows)
        aged = [days not in ("0", "-0") for days in texts["aging_days"]]
        condition, series = (
            [own if old else new for own, new, old in zip(known, unaged, aged, strict=True)]
            for known in (condition, series)
        )
    return {"condition": condition, "series": series, "rubber": rubber}


def _spelled(values: Sequence[object]) -> list[str | None]:
    """Return every value as text: numbers with %g, so 60, 60.0 and "60" are one condition; null as None."""
    texts = {value: None if pd.isna(value) else _spell(value) for value in set(values)}
    return [texts[value] for value in values]


def _spell(value: object) -> str | None:
    try:
        return f"{float(value):g}"  # type: ignore[arg-type]
    except (TypeError, ValueError):
        text = str(value).strip()
        return text or None


def _joined(parts: Iterable[Sequence[str | None]], rows: int) -> list[str | None]:
    """Return the parts of each row joined by ", "; None where any part is."""
    each = list(zip(*parts, strict=True)) or [()] * rows
    texts = {row: None if None in row else ", ".join(row) for row in set(each)}
    return [texts[row] for row in each]
