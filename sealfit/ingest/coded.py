"""A column of a campaign's listing: every different value once, and which of them each file has."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import is_

import numpy as np
import pandas as pd

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
