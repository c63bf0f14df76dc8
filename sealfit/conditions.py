"""The keys `condition`, `series` and `rubber` of a table, built from its condition columns; the one place that spells
them."""

from __future__ import annotations

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.errors import SealfitError

UNAGED = "unaged"
ALL = "all"  # the series of a rig whose only condition is its age
ONE_RUBBER = "rubber"


def condition_columns(config: Config) -> list[str]:
    """Return the columns that make a condition: the config's, and the rubber columns that are not among them."""
    return [*config.condition, *(name for name in config.rubber if name not in config.condition)]


def add_keys(table: pd.DataFrame, config: Config) -> pd.DataFrame:
    """Return `table` with `condition`, `series` and `rubber`.

    A condition is spelled "temperature_C=60, compression_ratio_pct=80, aging_days=4"; a series is the condition
    without days ("all" when no other column is left). Rows with aging_days = 0 are "unaged" in both ("unaged,
    <rubber>" where the config names rubber columns), whatever stands in their other condition cells. Without days,
    series and condition are equal. A row with an empty condition cell has null for both, unless it is unaged.

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
    >>> runs = pd.DataFrame({"temperature_C": [60, 60], "compression_ratio_pct": [80, 80], "aging_days": [4, 0]})
    >>> add_keys(runs, Config())[["condition", "series"]].values.tolist()[1]
    ['unaged', 'unaged']
    """
    columns = condition_columns(config)
    missing = [name for name in columns if name not in table.columns]
    if missing:
        raise SealfitError(
            f"condition column {', '.join(repr(name) for name in missing)} is missing.",
            mend="Add it, or name other columns in the config's condition and rubber.",
        )
    words = {name: _words(name, table[name]) for name in columns}
    condition = _joined([words[name] for name in columns], len(table))
    rubber = _joined([_spelled(table[name]) for name in config.rubber], len(table)) if config.rubber else None
    series = condition
    if config.aging:
        others = [words[name] for name in columns if name != "aging_days"]
        series = _joined(others, len(table)) if others else np.full(len(table), ALL, object)
        unaged = pd.to_numeric(table["aging_days"], errors="coerce").to_numpy(float) == 0.0
        name = _joined([np.full(len(table), UNAGED, object), rubber], len(table)) if rubber is not None else UNAGED
        condition, series = np.where(unaged, name, condition), np.where(unaged, name, series)
    keys = {
        "condition": condition,
        "series": series,
        "rubber": rubber if rubber is not None else np.full(len(table), ONE_RUBBER, object),
    }
    return table.assign(**{key: pd.array(value, dtype="str") for key, value in keys.items()})


def _words(name: str, values: pd.Series) -> np.ndarray:
    spelled = _spelled(values)
    return np.array([None if value is None else f"{name}={value}" for value in spelled], object)


def _spelled(values: pd.Series) -> np.ndarray:
    """Return every value as text: numbers with %g, so 60, 60.0 and "60" are one condition; null as None."""
    codes, found = pd.factorize(values, use_na_sentinel=True)
    texts = np.array([*(_spell(value) for value in found), None], object)
    return texts[codes]


def _spell(value: object) -> str | None:
    try:
        return f"{float(value):g}"  # type: ignore[arg-type]
    except (TypeError, ValueError):
        text = str(value).strip()
        return text or None


def _joined(parts: list[np.ndarray], n: int) -> np.ndarray:
    """Return the parts of each row joined by ", "; None where any part is."""
    if not parts:
        return np.full(n, "", object)
    rows = list(zip(*parts, strict=True))
    texts = {row: None if None in row else ", ".join(row) for row in set(rows)}
    return np.array([texts[row] for row in rows], object)
