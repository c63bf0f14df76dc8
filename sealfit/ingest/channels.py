"""Further columns of a trace file: which are channels of numbers, which are labels, and which are neither."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from sealfit.config import Config
from sealfit.errors import Fault
from sealfit.ingest.cells import OVERLOAD, decimal_fix, listed
from sealfit.ingest.text import as_number

MAX_LABELS = 20  # a text column with more different values, most of them used once, is a clock or a serial number


def channel_columns(
    columns: Mapping[str, np.ndarray],
    slots: Collection[str],
    good: np.ndarray,
    line: np.ndarray,
    config: Config,
    file: str,
) -> tuple[dict[str, np.ndarray], np.ndarray, list[Fault]]:
    """Return the columns that are of use, a mask of rows to leave out, and the faults.

    A channel with a few cells missing costs these rows; one with more than `quality.max_bad_rows` of them missing is
    left out itself, and the file stays. Text is a label; where most cells are numbers, the others are faults; where
    most cells are empty, the rest are remarks, and each is named.

    Parameters
    ----------
    columns : mapping of str to ndarray, shape (n,)
        Float or object columns under our names; `slots` are passed on as they are.
    good, line : ndarray, shape (n,)
        Rows that are good so far, and the line numbers of all rows.
    """
    kept, drop, faults = dict(columns), np.zeros(len(good), bool), []
    for name, values in columns.items():
        if name in slots:
            continue
        numbers, texts = (
            (values, None) if values.dtype.kind == "f" else (_numbers(values, config.trace.decimal), values)
        )
        if texts is not None:
            full = np.array([cell is not None for cell in texts])
            if np.isfinite(numbers).sum() <= 0.5 * full.sum():
                found = _label_faults(name, texts, full, line, file)
                faults += found
                if found:
                    del kept[name]
                continue
            kept[name] = numbers
        missing = good & ~(np.abs(numbers) < OVERLOAD)
        share = missing.sum() / max(good.sum(), 1)
        if share == 1:
            faults.append(_left_out(name, "the column is empty", "info", file))
            del kept[name]
        elif share > config.quality.max_bad_rows:
            faults.append(_left_out(name, f"{missing.sum()} of {good.sum()} cells hold no number", "warning", file))
            del kept[name]
        elif share:
            drop |= missing
            faults += _cell_faults(name, numbers, texts, np.flatnonzero(missing), line, config.trace.decimal, file)
    return kept, drop, faults


def _numbers(texts: np.ndarray, decimal: str) -> np.ndarray:
    found = [None if cell is None else as_number(cell, decimal) for cell in texts]
    return np.array([np.nan if number is None else number for number in found])


def _label_faults(name: str, texts: np.ndarray, full: np.ndarray, line: np.ndarray, file: str) -> list[Fault]:
    """Return why a text column is no label; nothing if it is one."""
    if full.sum() < 0.5 * len(full):

        def make(i: int) -> Fault:
            place = {"line": int(line[i]), "column": name, "value": texts[i]}
            return Fault("remark", "a remark; the row is kept.", file=file, severity="info", action="kept", **place)

        def rest(count: int) -> Fault:
            return Fault("remark", f"and {count} more remarks.", file=file, column=name, severity="info", action="kept")

        return listed(np.flatnonzero(full), make, rest)
    labels = len(set(texts[full]))
    if labels > MAX_LABELS and labels > 0.5 * full.sum():
        return [_left_out(name, f"{labels} different texts are no labels", "info", file)]
    return []


def _left_out(name: str, reason: str, severity: str, file: str) -> Fault:
    fix = "Fill it, or list it under trace.optional and leave it out of the export." if severity == "warning" else ""
    reason = f"{reason}; the column is not used."
    return Fault("channel_left_out", reason, file=file, column=name, severity=severity, action="kept", fix=fix)


def _cell_faults(name, numbers, texts, at, line, decimal, file) -> list[Fault]:
    def make(i: int) -> Fault:
        place = {"file": file, "line": int(line[i]), "column": name, "action": "row left out"}
        cell = None if texts is None else texts[i]
        if cell is not None and as_number(cell, decimal) is None:
            fix = decimal_fix(cell, decimal) or "Put a number there or delete the line."
            return Fault("not_a_number", "is not a number.", value=cell, fix=fix, **place)
        value = cell if cell is not None else "" if np.isnan(numbers[i]) else str(numbers[i])  # JSON has no inf
        reason = "is no measured number." if value != "" else "the cell holds no number."
        return Fault("not_finite", reason, value=value, fix="Fill it or delete the line.", **place)

    def rest(count: int) -> Fault:
        reason = f"and {count} more cells of this column that are not numbers."
        return Fault("not_a_number", reason, file=file, column=name, value=float(count), action="row left out")

    return listed(at, make, rest)
