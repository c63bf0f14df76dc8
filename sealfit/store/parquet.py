"""Tables to Parquet and back, with the schemas of `tables.py`; units and meanings are in the metadata."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from sealfit import __version__
from sealfit.config import AGING_CONDITION
from sealfit.errors import OutError
from sealfit.tables import SCHEMAS, TEXT, Column, Schema
from sealfit.units import Units

CHANNEL = "channel of the campaign"
Columns = Mapping[str, pd.Series | np.ndarray | pa.Array]  # of equal length, or a frame


def to_arrow(frame: pd.DataFrame | Columns, schema: Schema, units: Units) -> pa.Table:
    """Return `frame` as a table of `schema`: its columns first, in its order and types, NaN as null.

    If it is open, all others follow. Each field's metadata holds `unit` (the true one) and `meaning`; the
    table's holds `sealfit` (version and table) and `units` (true unit by column). ValueError if a column is
    missing, doubled, of the wrong type, or not in a closed schema: a fault of the step, not of the data.
    """
    names = [str(name) for name in frame]
    if doubled := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"table {schema.name}: doubled columns {doubled}")
    missing = [name for name in schema.names() if name not in names]
    others = [name for name in names if name not in set(schema.names())]
    if missing or (others and not schema.open_):
        unknown = f"columns that it does not know {others}"
        raise ValueError(f"table {schema.name}: missing columns {missing}, {unknown}")
    arrays, fields = [], []
    for column in (*schema.columns, *(Column(name, CHANNEL, None) for name in others)):
        array = _array(frame[column.name], column, schema.name)
        arrays.append(array)
        fields.append(_field(column, array.type, units))
    return _table(arrays, fields, json.dumps({"version": __version__, "table": schema.name}))


def _table(arrays: list, fields: list[pa.Field], about: str | bytes) -> pa.Table:
    units = {field.name: field.metadata[b"unit"].decode() for field in fields}
    metadata = {"sealfit": about, "units": json.dumps(units, ensure_ascii=False)}
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=metadata))


def with_columns(table: pa.Table, columns: Mapping[str, str], units: Units) -> pa.Table:
    """Return a table of `to_arrow` with these columns, in this order: name and type, as Arrow spells it.

    A column that it lacks is null throughout; numbers become words where words are asked for.
    """
    arrays, fields = [], []
    for name, kind in columns.items():
        wanted = pa.type_for_alias(kind)
        at = table.schema.get_field_index(name)
        if at < 0:
            arrays.append(pa.nulls(table.num_rows, wanted))
            fields.append(_field(Column(name, CHANNEL, None), wanted, units))
            continue
        values = table.column(at)
        if wanted == TEXT and values.type != TEXT:
            values = as_words(values.to_pandas())
        arrays.append(values.cast(wanted))
        fields.append(table.schema.field(at).with_type(wanted))
    return _table(arrays, fields, table.schema.metadata[b"sealfit"])


def _field(column: Column, dtype: pa.DataType, units: Units) -> pa.Field:
    about = {"unit": units.of(column.name) or column.unit, "meaning": column.meaning}
    return pa.field(column.name, dtype, metadata=about)


def write_arrow(table: pa.Table, path: Path) -> None:
    """Write a table without checks; the caller syncs it to the disk. Raises OSError if the disk refuses."""
    measured = [field.name for field in table.schema if pa.types.is_floating(field.type)]
    settings = {
        "compression": "zstd",
        "use_dictionary": [name for name in table.column_names if name not in measured] or False,
        # First bytes with first bytes, and so on: nothing to lose, and half the time to compress.
        "use_byte_stream_split": measured or False,
        "write_page_checksum": True,
    }
    # A file of Python's, so that a full disk is an OSError with its number.
    with path.open("wb") as file:
        pq.write_table(table, file, **settings)


def write_ipc(table: pa.Table, path: Path) -> None:
    """Write a table in Arrow's IPC format; errors as `write_arrow`."""
    with path.open("wb") as file, pa.ipc.new_file(file, table.schema) as writer:
        writer.write_table(table)


def read_ipc(path: Path) -> pa.Table:
    """Return a table that `write_ipc` wrote; its columns are memory-mapped."""
    with pa.memory_map(str(path)) as file:
        return pa.ipc.open_file(file).read_all()


def read(
    path: Path | Sequence[Path],
    columns: list[str] | None = None,
    coded: Sequence[str] = (),
    where: Mapping[str, Sequence[str]] | None = None,
) -> pd.DataFrame:
    """Return the table at `path`, a file or its parts in order, or those columns of it, or some of its rows.

    Columns of words in `coded` come as categories: no word is spelled out for every row. `where` names
    columns that are read, and the values of the rows that are kept.
    """
    parts = []
    for one in [path] if isinstance(path, Path) else path:
        try:
            # A tenth of what read_table takes for a small file.
            with pq.ParquetFile(one, read_dictionary=list(coded), page_checksum_verification=True) as file:
                _check_schema(file.schema_arrow)
                part = file.read(columns=columns)
            for name, values in (where or {}).items():
                part = part.filter(pc.is_in(part[name], pa.array(values, TEXT)))
        except MemoryError:  # Arrow's own is an ArrowException, too
            raise
        except (OSError, KeyError, ValueError, pa.ArrowException) as error:
            fix = "Make all results again: sealfit run CAMPAIGN --out OUT --force"
            raise OutError("is missing or damaged.", file=one, fix=fix) from error
        parts.append(part)
    return pa.concat_tables(parts).to_pandas(self_destruct=True)


def _check_schema(found: pa.Schema) -> None:
    """Raise KeyError or ValueError for a table that has not the columns and types of its schema."""
    schema = SCHEMAS[json.loads((found.metadata or {})[b"sealfit"])["table"]]
    numbers = [Column(name, CHANNEL) for name in AGING_CONDITION if name in found.names]
    for column in (*schema.columns, *numbers):
        dtype = found.field(column.name).type
        dtype = dtype.value_type if pa.types.is_dictionary(dtype) else dtype  # of a column that is `coded`
        if column.dtype not in (None, dtype):
            raise ValueError(f"column {column.name} has the type {dtype}")


def _array(values: pd.Series | np.ndarray | pa.Array, column: Column, table: str) -> pa.Array:
    try:
        if isinstance(values, pa.Array):
            array = values
        elif column.dtype == TEXT or (column.dtype is None and _holds_words(values)):
            array = as_words(pd.Series(values))
        else:
            array = pa.array(values, type=column.dtype, from_pandas=True)
    except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError) as error:
        raise ValueError(f"table {table}, column '{column.name}': {error}") from error
    if isinstance(array, pa.ChunkedArray):
        array = array.combine_chunks()
    # A column without a single value is an optional channel.
    return array.cast(pa.float64()) if pa.types.is_null(array.type) else array


def as_words(values: pd.Series) -> pa.Array:
    """Return values of any kind as words, null where one is missing."""
    if not isinstance(values.dtype, pd.StringDtype):
        values = values.map(str, na_action="ignore").astype(object)
    return pa.array(values, type=TEXT, from_pandas=True)


def _holds_words(values: pd.Series | np.ndarray) -> bool:
    """Whether a channel holds words or categories; a mixture with numbers is stored as words, too."""
    if isinstance(values.dtype, pd.CategoricalDtype | pd.StringDtype):
        return True
    return values.dtype == object and any(isinstance(value, str) for value in values)
