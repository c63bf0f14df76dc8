"""The numbers of the source paper, and their counterparts in the tables of an analysed campaign."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd

from sealfit.physics import aging_constant, aging_law
from sealfit.simulation.model import Law, Physics, declared_parameters

PUBLISHED_LAWS = {
    "mu_s": Law(mu_0=0.93513, a=0.04448, b=0.0804),
    "mu_c": Law(mu_0=0.609, a=0.03307, b=0.1324),
}
PUBLISHED_C = {"mu_s": 0.11159, "mu_c": 0.06621}
UNAGED = "unaged"
MEASURED = (  # section, quantity, condition (°C, %, days), value; None for unaged rubber
    ("4.1", "mu_s", (60, 100, 1), 0.835),
    ("4.1", "mu_s", (60, 80, 1), 0.822),
    ("4.2", "mu_s", (40, 80, 2), 0.935),
    ("4.2", "mu_s", (80, 80, 2), 0.855),
    ("4.3", "mu_s", None, 0.93513),
    ("4.3", "mu_s", (60, 80, 4), 0.75859),
    ("4.3", "mu_s", (60, 80, 16), 0.70319),
    ("4.3", "mu_c", None, 0.609),
    ("4.3", "mu_c", (60, 80, 4), 0.48429),
    ("4.3", "mu_c", (60, 80, 16), 0.44781),
)
# Values that the paper predicts by its Eq. 15.
PREDICTED = (("mu_s", 16.0, 0.7), ("mu_c", 16.0, 0.48082))
# Friction force in N.
LARGEST = ((None, 49.4), ((80, 80, 16), 35.1))
# Series of Eq. 15 as printed.
SERIES = "temperature_C=60, compression_ratio_pct=80"


class Line(NamedTuple):
    """A published number and ours, with the ends of its 95 % interval where there is one."""

    section: str
    what: str
    published: float
    ours: float
    low: float | None = None
    high: float | None = None


def condition(at: tuple[float, float, float] | None) -> str:
    """Return the name of a condition as the tables spell it."""
    if at is None:
        return UNAGED
    return f"temperature_C={at[0]:g}, compression_ratio_pct={at[1]:g}, aging_days={at[2]:g}"


def words(at: tuple[float, float, float] | None) -> str:
    """Return the name of a condition for people."""
    return "unaged" if at is None else f"{at[0]:g} °C, {at[1]:g} %, day {at[2]:g}"


def compared(tables: Mapping[str, pd.DataFrame]) -> list[Line]:
    """Return every published number beside ours.

    Parameters
    ----------
    tables : mapping of str to DataFrame
        `steady`, `steady_fit`, `aging_fit` and `aging_curves` of the campaign.
    """
    steady = tables["steady_fit"]
    steady = steady[steady["quantity"] == "steady"].set_index(["condition", "parameter"])
    law = tables["aging_fit"][tables["aging_fit"]["series"] == SERIES].set_index(["quantity", "parameter"])
    lines = []
    for section, quantity, at, published in MEASURED:
        row = steady.loc[(condition(at), quantity)]
        lines.append(
            Line(section, f"{quantity}, {words(at)}", published, row["value"], row["lo95"], row["hi95"])
        )
    for quantity, printed in PUBLISHED_LAWS.items():
        for name, published in (("a", printed.a), ("b", printed.b), ("c", PUBLISHED_C[quantity])):
            row = law.loc[(quantity, name)]
            lines.append(
                Line(
                    "4.4", f"{name} of Eq. 15, {quantity}", published, row["value"], row["lo95"], row["hi95"]
                )
            )
    curves = tables["aging_curves"][tables["aging_curves"]["series"] == SERIES]
    for quantity, day, published in PREDICTED:
        curve = curves[curves["quantity"] == quantity]
        ours = [float(np.interp(day, curve["aging_days"], curve[name])) for name in ("value", "lo95", "hi95")]
        lines.append(Line("4.4", f"Eq. 15 for {quantity} at day {day:g}", published, *ours))
    runs = tables["steady"].groupby(["condition", "run_id"])["force_N"].mean()
    for at, published in LARGEST:
        lines.append(
            Line("4.4", f"largest force in N, {words(at)}", published, float(runs[condition(at)].max()))
        )
    return lines


def agreement(tables: Mapping[str, pd.DataFrame], physics: Physics) -> pd.DataFrame:
    """Return by how many percent our laws differ at most from the conditions' fits and from the truth.

    Parameters
    ----------
    tables : mapping of str to DataFrame
        As above.
    physics : Physics
        The truth.

    Returns
    -------
    DataFrame
        `series`, `quantity`, `fits`, `truth`, a row per series and quantity.
    """
    steady = tables["steady_fit"]
    steady = steady[(steady["quantity"] == "steady") & (steady["aging_days"] > 0)]
    rows = []
    for (series, quantity), curve in tables["aging_curves"].groupby(["series", "quantity"], sort=True):
        own = steady[(steady["series"] == series) & (steady["parameter"] == quantity)]
        days = own["aging_days"].to_numpy(float)
        fitted = np.interp(days, curve["aging_days"], curve["value"])
        declared = declared_parameters(
            physics, {name: own[name].to_numpy(float) for name in ("temperature_C", "compression_ratio_pct")}
        )
        end = quantity[-1]
        truth = aging_law(
            days, mu_0=declared[f"mu_0{end}"][0], a=declared[f"a_{end}"][0], b=declared[f"b_{end}"][0]
        )
        at = own.iloc[0]
        rows.append(
            {
                "series": f"{at['temperature_C']:g} °C, {at['compression_ratio_pct']:g} %",
                "quantity": quantity,
                "fits": 100 * float(np.abs(fitted / own["value"].to_numpy(float) - 1).max()),
                "truth": 100 * float(np.abs(fitted / truth - 1).max()),
            }
        )
    return pd.DataFrame(rows)


def as_printed(quantity: str, days, start: float | None = None) -> np.ndarray:
    """Return Eq. 15 with the printed a, b and c, from the printed start or another, shape of `days`."""
    law = PUBLISHED_LAWS[quantity]
    mu_0 = law.mu_0 if start is None else start
    more = aging_constant(law.a, law.b) - PUBLISHED_C[quantity]  # of the constant of Eq. 15
    return aging_law(days, mu_0=mu_0 + more, a=law.a, b=law.b)


def printed_errors() -> dict[str, float]:
    """Return what the printed numbers say of one another: errors of Eq. 15 for mu_c in percent, and gaps.

    `start` is the mu_0 that the printed prediction of day 16 needs; `needed_4`, `needed_16` are the errors
    with it at the printed values of days 4 and 16, `own_4`, `own_16` with the printed start; `spare` is the
    largest |c + a ln b|; `warm` is Eq. 15 for mu_s after 2 days.
    """
    law = PUBLISHED_LAWS["mu_c"]
    measured = {at[2]: value for _, quantity, at, value in MEASURED if quantity == "mu_c" and at is not None}
    predicted = next(value for quantity, _, value in PREDICTED if quantity == "mu_c")
    found = {"printed": law.mu_0, "predicted": predicted}
    start = found["start"] = law.mu_0 + predicted - as_printed("mu_c", 16.0)
    found["gap"] = start - law.mu_0
    for day in (4, 16):
        found[f"needed_{day}"] = 100 * (as_printed("mu_c", day, start) / measured[day] - 1)
        found[f"own_{day}"] = 100 * (as_printed("mu_c", day) / measured[day] - 1)
    found["spare"] = max(abs(PUBLISHED_C[q] + own.a * np.log(own.b)) for q, own in PUBLISHED_LAWS.items())
    found["warm"] = as_printed("mu_s", 2.0)
    return {name: float(value) for name, value in found.items()}
