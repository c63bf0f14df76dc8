"""A frame brought into the columns and types of its schema."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from sealfit.tables import BINS, FLOAT, INT, RUNS, STEADY, TEXT, Schema

INNER = ("several", "left", "equal", "extreme", "run", "sliding", "row", "by_itself")  # serve the ingest only
STEADY_ONLY = tuple(
    {column.name for column in STEADY.columns}
    - {column.name for column in RUNS.columns}
    - {column.name for column in BINS.columns}
)


def shaped(table: pd.DataFrame, schema: Schema, drop: Sequence[str] = ()) -> pd.DataFrame:
    """Return the schema's columns in order and with their types, then the open ones but `drop` and `INNER`."""
    fixed = {}
    for column in schema.columns:
        values = (
            table[column.name] if column.name in table.columns else pd.Series(None, index=table.index, dtype=object)
        )
        if column.dtype == FLOAT:
            fixed[column.name] = pd.to_numeric(values, errors="coerce").astype(float)
        elif column.dtype == INT:
            fixed[column.name] = values.astype(np.int64)
        elif column.dtype == TEXT:
            fixed[column.name] = values.astype("str")
        else:
            fixed[column.name] = values.astype(bool)
    taken = {*fixed, *INNER, *(name for name in drop if name not in fixed)}
    return pd.DataFrame({**fixed, **{name: table[name] for name in table.columns if name not in taken}})
