"""Categorical columns: their codes, and the keys `condition`, `series` and `rubber` built from them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import is_

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.errors import SealfitError

# ---------------------------------------------------------------- coded
# A column of a campaign's listing: every different value once, and which of them each file has.

Value = float | str


@dataclass(frozen=True, slots=True, eq=False)
class Coded:
    """What every file has in one column: a campaign has many files of few temperatures.

    Parameters
    ----------
    codes : ndarray of int32, shape (files,)
        Which of `values` a file has; -1 where it has none.
    values : list
        Different words; numbers, which may be equal.
    """

    codes: np.ndarray
    values: list[Value]

    @classmethod
    def of(cls, cells: Iterable[Value | None]) -> Coded:
        """Return the column of these cells; None is no value.

        Examples
        --------
        >>> Coded.of(["a", None, "b", "a"]).codes.tolist()
        [0, -1, 1, 0]
        """
        codes: dict[object, int] = {None: -1}
        values: list[Value] = []
        found = []
        for cell in cells:
            key = _key(cell)
            if key not in codes:
                codes[key] = len(values)
                values.append(cell)
            found.append(codes[key])
        return cls(np.array(found, np.int32), values)

    @property
    def known(self) -> np.ndarray:
        """Which files have a value, shape (files,)."""
        return self.codes >= 0

    def cells(self) -> list[Value | None]:
        """Return the value of every file, None where there is none."""
        values = [*self.values, None]
        return [values[code] for code in self.codes.tolist()]

    def words(self) -> np.ndarray:
        """Return the value of every file in words that no other value has, shape (files,); "" where there is none."""
        words = [f"={value}" if isinstance(value, str) else repr(value) for value in self.values]
        return np.array([*words, ""], object)[self.codes]

    def __getitem__(self, file: int) -> Value | None:
        code = self.codes[file]
        return self.values[code] if code >= 0 else None

    def map(self, change: Callable[[Value], Value | None]) -> Coded:
        """Return the column with every value changed; None where there is to be none."""
        values = [change(value) for value in self.values]
        if all(map(is_, values, self.values)):
            return self
        return Coded(self.codes, values)._merged()

    def where(self, holds: Callable[[Value], bool]) -> np.ndarray:
        """Return which files have a value of which `holds` is true, shape (files,)."""
        return np.array([*map(holds, self.values), False], bool)[self.codes]

    def take(self, files: np.ndarray) -> Coded:
        """Return the column of some of the files, its values in the order in which these have them."""
        codes, of = pd.factorize(self.codes[files])
        found = of.tolist()
        if -1 in found:
            none = found.index(-1)
            codes = np.where(codes == none, -1, codes - (codes > none))
            del found[none]
        return Coded(codes.astype(np.int32), [self.values[code] for code in found])

    def put(self, cells: Mapping[int, Value]) -> Coded:
        """Return the column with other values for some files, by their numbers."""
        added = Coded.of(cells.values())
        codes = self.codes.copy()
        codes[list(cells)] = added.codes + len(self.values)
        return Coded(codes, [*self.values, *added.values])._merged()

    def over(self, other: Coded) -> Coded:
        """Return the column with the values of `other` for files that have none."""
        codes = np.where(self.known | ~other.known, self.codes, other.codes + np.int32(len(self.values)))
        return Coded(codes, [*self.values, *other.values])._merged()

    def _merged(self) -> Coded:
        merged = Coded.of(self.values)
        return Coded(np.append(merged.codes, np.int32(-1))[self.codes], merged.values)


def _key(value: Value | None) -> object:
    return value if value is None or isinstance(value, str) else (repr(value),)  # -0.0 is not 0.0, and nan is nan


Columns = dict[str, Coded]


def nothing(files: int) -> Coded:
    """Return a column in which no file has a value."""
    return Coded(np.full(files, -1, np.int32), [])


def columns_of(rows: Sequence[Mapping[str, Value]]) -> Columns:
    """Return rows of named values as columns, in the order in which the names appear."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: Coded.of(row.get(name) for row in rows) for name in names}


def overlaid(*columns: Columns) -> Columns:
    """Return columns of the same files in one; the last that has a value for a file says it."""
    whole: Columns = {}
    for some in columns:
        for name, column in some.items():
            whole[name] = column.over(whole[name]) if name in whole else column
    return whole


def in_order(columns: Columns) -> Columns:
    """Return the columns in the order of the first file that has a value in each, without those that none has."""
    filled = {name: column for name, column in columns.items() if column.known.any()}
    return {name: filled[name] for name in sorted(filled, key=lambda name: int(np.argmax(filled[name].known)))}


# ---------------------------------------------------------------- conditions
# The keys `condition`, `series` and `rubber` of a table, built from its condition columns; the one place that spells
# them.

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
            fix="Add it, or name other columns in the config's condition and rubber.",
        )
    keys = keys_of({name: table[name].tolist() for name in columns}, len(table), config)
    return table.assign(**{key: pd.array(words, dtype="str") for key, words in keys.items()})


def keys_of(columns: Mapping[str, Sequence[object]], rows: int, config: Config) -> dict[str, list[str | None]]:
    """Return `condition`, `series` and `rubber` of every row, as `add_keys`; `columns` has all condition columns."""
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
