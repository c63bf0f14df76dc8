"""The joint laws of aging as rows to read: what each says, and the evidence for it."""

from __future__ import annotations

import pandas as pd

from sealfit.report.numbers import NOTHING, known, measured, number
from sealfit.report.symbols import symbol_html

MOST_LAWS = 4  # of each quantity


def law_rows(aging_laws: pd.DataFrame, before: pd.DataFrame | None = None) -> list[dict]:
    """Return the likeliest laws of each quantity, and separate laws, as plain values for the page.

    Parameters
    ----------
    aging_laws : DataFrame
        Table `aging_laws`, perhaps empty.
    before : DataFrame, optional
        The same without the loop's effects: its likeliest law follows that of `aging_laws`.
    """
    found = []
    earlier = {} if before is None else {row["key"]: row for row in law_rows(before) if row["chosen"]}
    several = aging_laws["rubber"].nunique() > 1 if len(aging_laws) else False
    for (rubber, quantity), own in aging_laws.groupby(["rubber", "quantity"], sort=False):
        last = own["rank"].max()
        for rank, law in own.groupby("rank", sort=True):
            first = law.iloc[0]
            if rank > MOST_LAWS and not (rank == last and first["law"] == "separate"):
                continue
            by = law.dropna(subset=["parameter"]).set_index("parameter")
            found.append(
                {
                    "rubber": rubber if several else "",
                    "quantity": symbol_html(quantity),
                    "form": first["form"],
                    "changes": f"the {first['way']}" if first["way"] else NOTHING,
                    "criterion": number(first["criterion"]) if rank > 1 else "0",
                    "energy": _with_interval(by, "E"),
                    "kappa": _with_interval(by, "kappa"),
                    "heldout_series": number(first["heldout_series"]) if known(first["heldout_series"]) else NOTHING,
                    "heldout_last_day": number(first["heldout_last_day"])
                    if known(first["heldout_last_day"])
                    else NOTHING,
                    "chosen": rank == 1,
                    "before": False,
                    "key": (rubber, quantity),
                }
            )
            if rank == 1 and (rubber, quantity) in earlier:
                found.append({**earlier[rubber, quantity], "criterion": NOTHING, "chosen": False, "before": True})
    return found


def _with_interval(by: pd.DataFrame, name: str) -> str:
    """Return a parameter with its interval, or that these data do not determine it."""
    if name not in by.index:
        return NOTHING
    row = by.loc[name]
    if not row["identified"]:
        return "not identified"
    value, interval = measured(row["value"], row["lo95"], row["hi95"])
    return f"{value} {interval}"
