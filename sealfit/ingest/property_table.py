"""A table of property values of specimens: strength, hardness, ... over aging time, without traces."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.errors import KEPT, ROW_OUT, CampaignError, Fault, nearest
from sealfit.ingest import derived_columns as derived
from sealfit.ingest.cells import LISTED
from sealfit.ingest.columns import NO_COLUMN, Columns, keys_of, known, suggestion, where
from sealfit.ingest.listing import Entry, read_table, stopped
from sealfit.store.manifest import BATCH
from sealfit.tables import HISTORY

DAYS = "aging_days"
NO_PROPERTY = (*derived.NUMBERS, *derived.COUNTS, *HISTORY)  # columns of numbers
LABELS = ("specimen_id", "run_id", "file", "started_at", BATCH)  # columns that are read as labels


def read_properties(
    path: Path, config: Config, properties: Sequence[str] = (), batch: str = BATCH
) -> tuple[pd.DataFrame, list[Fault]]:
    """Return table `property_values`, and what was found that does not stop the fit.

    The table, CSV, Excel or Parquet, has a row per specimen with `aging_days`, the other condition columns
    and a column per property; names, units and computed columns are those of a table of runs, and condition
    columns that it lacks are not needed. `properties` are the columns of the properties, by default the only
    column of numbers that is no condition; `batch` is the column that names the batch of a specimen.
    CampaignError has every fault at once.
    """
    table = path.name
    lines, columns, faults = read_table(path.parent, table, config)
    if not lines and not faults:
        raise stopped("no_rows", "has a header but no rows.", "Write one row per specimen.", file=table)
    entries = [Entry(table, line, table) for line in lines]
    columns = derived.in_our_units(columns, config.conversions("runs"))
    columns = derived.with_constants(columns, len(lines), config)
    columns = derived.with_day_0(columns, _of_table(config, columns))
    words = {name: columns.pop(name) for name in {*LABELS, batch} if name in columns}
    columns, found = derived.to_values(entries, columns, config)
    faults += found
    if DAYS not in columns:
        fix = suggestion(DAYS, [*columns, *words]) + " Name it in files.runs_columns of a --config."
        raise stopped("missing_column", NO_COLUMN, fix.strip(), file=table, column=DAYS)
    config = _of_table(config, columns)
    try:
        chosen = _properties(table, columns, config, properties)
    except CampaignError as error:  # a cell that is no number may be the reason
        raise CampaignError([*(f for f in faults if f.severity != "info"), *error.faults]) from error
    if batch != BATCH and batch not in words:
        fix = suggestion(batch, [*columns, *words])
        raise stopped("missing_column", NO_COLUMN, fix, file=table, column=batch)
    if batch not in words and (close := nearest(batch, list(columns))):
        reason, fix = f"is not used; it looks like '{batch}'.", f"Write '{batch}' if that is meant."
        faults.append(Fault("column_name", reason, file=table, column=close, fix=fix, **KEPT))
    faults += derived.out_of_range(entries, columns)
    aged = ~where(columns[DAYS], lambda value: value == 0)
    for name in config.condition:
        faults += derived.empty_cells(entries, name, np.flatnonzero(aged & ~known(columns[name])))
    if stopping := [f for f in faults if f.severity == "error" and f.action == "stopped"]:
        raise CampaignError(stopping)
    made = pd.concat([_rows(columns, words, lines, config, name, batch) for name in chosen])
    usable = made["value"].notna()
    faults += _left_out(entries, made[~usable])
    if not (made["aging_days"][usable] > 0).any():
        fix = f"Give values of aged specimens: {DAYS} above 0."
        raise stopped("nothing_left", "holds no value of an aged specimen.", fix, file=table)
    return made[usable].reset_index(drop=True), faults


def _of_table(config: Config, columns: Columns) -> Config:
    """Return the config with the condition columns that the table has."""
    there = [name for name in config.condition if name in columns or name == DAYS]
    condition = there if DAYS in there else [*there, DAYS]
    rubber = [name for name in config.rubber if name in columns]
    return config.model_copy(update={"condition": condition, "rubber": rubber})


def _properties(table: str, columns: Columns, config: Config, named: Sequence[str]) -> list[str]:
    """Return the columns of the properties, those that are named or the only one that may be one."""
    numbers = [
        name
        for name, cells in columns.items()
        if name not in (*NO_PROPERTY, *config.condition, *config.rubber)
        and known(cells).any()
        and not where(cells, lambda value: isinstance(value, str)).any()
    ]
    # Names in one option, between commas, are several, unless a column is called so.
    parts = [own for name in named for own in ([name] if name in columns else name.split(","))]
    named = [own for part in parts if (own := part.strip())]
    for name in named:
        if name not in numbers:
            what = "is no column of numbers." if name in columns else NO_COLUMN
            raise stopped("missing_column", what, suggestion(name, numbers), file=table, column=name)
    if named:
        return list(dict.fromkeys(named))
    if len(numbers) == 1:
        return numbers
    if not numbers:
        fix = "Add one of numbers, or correct the cells that are none."
        raise stopped("missing_column", "there is no column of a property.", fix, file=table)
    reason = f"which column is the property is not said: {', '.join(numbers)}."
    fix = "Name it, or several with commas: --property COLUMN."
    raise stopped("missing_column", reason, fix, file=table)


def _rows(
    columns: Columns, words: Columns, lines: list[int], config: Config, name: str, batch: str
) -> pd.DataFrame:
    """Return the rows of one property, values that are missing included."""
    keys = keys_of(columns, len(lines), config)
    made = pd.DataFrame({**keys, **{key: columns[key] for key in config.condition}, "quantity": name})
    made["value"] = pd.Series(columns[name], dtype=float)
    batches = words.get(batch, [None] * len(lines))
    return made.assign(unit=config.units.of(name), batch=batches, line=lines)


def _left_out(entries: list[Entry], rows: pd.DataFrame) -> list[Fault]:
    """Return a finding for every property that some rows have no value of: how many, and in which lines."""
    faults = []
    for name, lines in rows.groupby("quantity", sort=False)["line"]:
        listed = ", ".join(map(str, lines.head(LISTED))) + (", ..." if len(lines) > LISTED else "")
        reason = f"{len(lines)} rows have no value and are left out: {listed}."
        place = {"file": entries[0].table, "line": int(lines.iloc[0]), "column": name}
        faults.append(Fault("empty_cell", reason, value=float(len(lines)), **place, **ROW_OUT))
    return faults
