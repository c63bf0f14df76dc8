"""Columns of the campaign that some of its files have no value of."""

from __future__ import annotations

import pandas as pd

from sealfit.errors import Fault
from sealfit.tables import STEADY

LEAST_KNOWN = 0.8  # share of the files that have a value, from which the search for effects still looks at a column
NO_VALUE = "(no value)"  # level of a category in files without one
CALENDAR = ("run_order", "elapsed_h")  # both from started_at


def incomplete_columns(steady: pd.DataFrame) -> list[Fault]:
    """Return, for every column that some files have no value of, how many, what that does, and the fix.

    Parameters
    ----------
    steady : DataFrame
        Table `steady`; rows with `used` false are left out.
    """
    used = steady[steady["used"].to_numpy(bool)]
    files = used["file"].nunique()
    fixed, faults = set(STEADY.names()) - set(CALENDAR) - {"load_N"}, []
    for name in used.columns:
        if name in fixed:
            continue
        missing = used["file"][used[name].isna()].nunique()
        if 0 < missing < files:
            reason = f"{missing} of {files} files have no value: {_what_follows(name, used[name], missing / files)}."
            fix = "Fill started_at." if name in CALENDAR else "Fill it for these files too."
            place = {"column": name, "value": float(missing), "severity": "warning", "action": "kept"}
            faults.append(Fault("incomplete_column", reason, fix=fix, **place))
    return faults


def _what_follows(name: str, column: pd.Series, share: float) -> str:
    if name == "load_N":
        return "the loop fits forces in place of coefficients"
    if name in CALENDAR or (_is_number(column) and share > 1 - LEAST_KNOWN):
        return "the search for effects leaves the column out"
    if _is_number(column):
        return "the search for effects takes them at the mean of their run, else of all files"
    return f"they are a level of their own, {NO_VALUE}"


def _is_number(column: pd.Series) -> bool:
    return pd.api.types.is_numeric_dtype(column)
