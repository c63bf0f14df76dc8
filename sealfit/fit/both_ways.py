"""Strokes both ways of one file: one set-up and one repeat, so one piece of evidence of how large the friction is."""

from __future__ import annotations

import numpy as np
import pandas as pd

from sealfit.fit.rows import nesting_run, records

BOTH = 0  # `direction` of a row that stands for both
SAME_SPEED = 1.25  # measured speeds within 25 % are one setting: rigs without speed control wander that much
KEYS = ["file", "run_id"]


def both_ways_together(steady: pd.DataFrame) -> pd.DataFrame:
    """Return table `steady` with one row per record for runs that go both ways at one speed, other rows as they are.

    The size of the force is the mean of the two ways, so that an offset between them cancels; what gain and set-up do
    to a file they do to both, and neither tells anything that the other does not.

    Parameters
    ----------
    steady : DataFrame
        Table `steady`, rows that are used.

    Returns
    -------
    DataFrame
        The same columns and `half_N`, half of the difference between the ways (NaN in other rows). In a row for both,
        `direction` is 0, `force_N` and `speed_mm_s` are sizes, and `run_id` has no sign.
    """
    rows = steady.assign(half_N=np.nan)
    run, record = nesting_run(rows), records(rows)
    pace = rows["speed_mm_s"].abs()
    if "speed_set_mm_s" in rows.columns:
        pace = rows["speed_set_mm_s"].abs().fillna(pace)
    extent = pd.DataFrame({"file": record, "run": run, "way": rows["direction"], "pace": pace})
    grouped = extent.groupby(["file", "run"])
    alike = grouped["way"].transform("nunique").eq(2)
    alike &= grouped["pace"].transform("max") <= SAME_SPEED * grouped["pace"].transform("min")
    alike = alike.groupby(run).transform("all")
    if not alike.any():
        return rows
    size = {"force_N": rows["force_N"] * rows["direction"], "speed_mm_s": rows["speed_mm_s"].abs()}
    own = rows.assign(run_id=run, file=record, **size)[alike]
    numbers = [c for c in own.columns if pd.api.types.is_float_dtype(own[c])]
    ways = own.groupby([*KEYS, "direction"], sort=False)[numbers].mean()
    force = ways["force_N"].unstack("direction")
    together = own.drop(columns=numbers).groupby(KEYS, sort=False).first()
    together[numbers] = ways.groupby(level=KEYS, sort=False).mean()
    together = together.assign(direction=BOTH, half_N=(force[1] - force[-1]) / 2)
    return pd.concat([rows[~alike], together.reset_index()[list(rows.columns)]], ignore_index=True)
