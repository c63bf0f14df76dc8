"""Tables to Parquet and back: the schema of `tables.py` applied, true units and meanings in the metadata."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from sealfit import __version__
from sealfit.tables import TEXT, Column, Schema, Units


def to_arrow(frame: pd.DataFrame, schema: Schema, units: Units) -> pa.Table:
    """Return `frame` as a table of `schema`: its columns first, in order and type; then, if it is open, all others.

    Each field's metadata holds `unit` (the true one) and `meaning`; the table's holds `sealfit` (version and table)
    and `units` (true unit by column). NaN becomes null.

    Raises
    ------
    ValueError
        If a column is missing, doubled, of the wrong type, or not in a closed schema: a fault of the step, not of the
        user's data.
    """
    names = [str(name) for name in frame.columns]
    if len(set(names)) != len(names):
        raise ValueError(f"table {schema.name}: doubled columns {sorted({n for n in names if names.count(n) > 1})}")
    missing = [name for name in schema.names() if name not in names]
    others = [name for name in names if name not in set(schema.names())]
    if missing or (others and not schema.open_):
        raise ValueError(f"table {schema.name}: missing columns {missing}, columns that it does not know {others}")

    arrays, fields = [], []
    for column in (*schema.columns, *(Column(name, "", None, "channel of the campaign") for name in others)):
        array = _array(frame[column.name], column, schema.name)
        about = {"unit": units.of(column.name) or column.unit, "meaning": column.meaning}
        arrays.append(array)
        fields.append(pa.field(column.name, array.type, metadata=about))
    about = {
        "sealfit": json.dumps({"version": __version__, "table": schema.name}),
        "units": json.dumps({field.name: field.metadata[b"unit"].decode() for field in fields}, ensure_ascii=False),
    }
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=about))


def write(frame: pd.DataFrame, schema: Schema, units: Units, path: Path) -> None:
    """Write `frame` to `path`. Raises OSError if the disk refuses, ValueError as `to_arrow`."""
    table = to_arrow(frame, schema, units)
    with path.open("wb") as file:  # a file of Python's, so that a full disk is an OSError with its number
        pq.write_table(table, file, compression="zstd")


def read(path: Path, columns: list[str] | None = None) -> pd.DataFrame:
    """Return the table at `path`, a file or a partitioned folder, or those columns of it."""
    return pq.read_table(path, columns=columns).to_pandas(self_destruct=True)


def _array(values: pd.Series, column: Column, table: str) -> pa.Array:
    try:
        if column.dtype == TEXT or (column.dtype is None and _mixed(values)):
            values = values.map(str, na_action="ignore").astype(object)
            return pa.array(values, type=TEXT, from_pandas=True)
        array = pa.array(values, type=column.dtype, from_pandas=True)
    except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError) as error:
        raise ValueError(f"table {table}, column '{column.name}': {error}") from error
    if isinstance(array, pa.ChunkedArray):
        array = array.combine_chunks()
    if pa.types.is_null(array.type):  # an optional channel without a single value
        return array.cast(pa.float64())
    if pa.types.is_large_string(array.type):
        return array.cast(TEXT)
    return array


def _mixed(values: pd.Series) -> bool:
    """Whether a channel holds categories, or numbers and words together: then all of it is words."""
    if isinstance(values.dtype, pd.CategoricalDtype):
        return True
    return values.dtype == object and any(isinstance(value, str) for value in values)
