"""Rows of a trace on their way to a clean table: what is no measurement, or out of time, is named and left out."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sealfit.errors import Fault
from sealfit.ingest.cells import OVERLOAD, listed


@dataclass(frozen=True, slots=True)
class Rows:
    """Columns of equal length on their way through the checks, and the lines they come from."""

    columns: dict[str, np.ndarray]
    line: np.ndarray

    def where(self, mask: np.ndarray) -> Rows:
        """Return the rows that the mask chooses."""
        if np.count_nonzero(mask) == len(mask):
            return self
        return Rows({name: values[mask] for name, values in self.columns.items()}, self.line[mask])


def clean(rows: Rows, names: list[str], file: str) -> tuple[Rows, int, list[Fault]]:
    """Return the rows whose slots are finite and whose time rises, the number left out, and the faults."""
    names = [name for name in names if name in rows.columns]
    if _in_order(rows, names):
        return rows, 0, []
    faults: list[Fault] = []
    finite = np.ones(len(rows.line), bool)
    for name in names:
        sizes = np.abs(rows.columns[name])
        wrong, overload = ~np.isfinite(sizes), (sizes >= OVERLOAD) & np.isfinite(sizes)
        finite &= ~(wrong | overload)
        faults += _row_faults("not_finite", "the computed value is not a finite number.", name, rows, wrong, file)
        faults += _row_faults("overload", "is an instrument's mark for overload.", name, rows, overload, file)
    good = rows.where(finite)
    back = _out_of_order(good.columns["time_s"])
    faults += _row_faults("time_order", "time repeats or runs backwards.", "time_s", good, back, file)
    return good.where(~back), int((~finite).sum() + back.sum()), faults


def _in_order(rows: Rows, names: Sequence[str]) -> bool:
    """Return whether nothing is to be found: every slot measured, time rising throughout."""
    time_s = rows.columns["time_s"]
    if len(time_s) < 2 or not (time_s[1:] > time_s[:-1]).all():
        return False
    return all(np.abs(rows.columns[name]).max() < OVERLOAD for name in names)  # not so of nan


def _row_faults(check: str, reason: str, name: str, rows: Rows, wrong: np.ndarray, file: str) -> list[Fault]:
    place = {"file": file, "column": name, "action": "row left out"}
    fix = {
        "time_order": "Check the recorder's clock, or delete the line.",
        "not_finite": "Check [trace.compute].",
        "overload": "Check the sensor's range.",
    }[check]

    def make(i: int) -> Fault:
        value = float(rows.columns[name][i])
        shown = value if np.isfinite(value) else str(value)  # JSON has no nan
        return Fault(check, reason, line=int(rows.line[i]), value=shown, fix=fix, **place)

    def rest(count: int) -> Fault:
        return Fault(check, f"and {count} more rows: {reason}", value=float(count), **place)

    return listed(np.flatnonzero(wrong), make, rest)


def _out_of_order(time_s: np.ndarray) -> np.ndarray:
    """Return a mask of the fewest rows whose removal leaves a time that rises from row to row.

    They are the rows outside a longest rising subsequence (patience sorting), so one wrong time that lies far ahead
    costs one row and not all that follow.
    """
    if len(time_s) < 2 or (np.diff(time_s) > 0).all():
        return np.zeros(len(time_s), bool)
    tails: list[float] = []
    at: list[int] = []
    before = np.full(len(time_s), -1)
    for i, t in enumerate(time_s.tolist()):
        place = bisect_left(tails, t)
        if place < len(tails) and tails[place] == t:
            continue  # of two equal times the first stays
        before[i] = at[place - 1] if place else -1
        tails[place : place + 1], at[place : place + 1] = [t], [i]
    bad = np.ones(len(time_s), bool)
    i = at[-1]
    while i >= 0:
        bad[i] = False
        i = before[i]
    return bad
