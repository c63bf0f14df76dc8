"""Small complete tables for the tests of OUT."""

import pandas as pd
import pyarrow as pa

from sealfit.tables import SCHEMAS

VALUES = {pa.float64(): 1.5, pa.int64(): 2, pa.string(): "a", pa.bool_(): True}


def small(table, rows=2, **others):
    """Return a frame with every column of `table`, and `others`."""
    columns = {column.name: [VALUES[column.dtype]] * rows for column in SCHEMAS[table].columns}
    return pd.DataFrame({**columns, **{name: [value] * rows for name, value in others.items()}})
