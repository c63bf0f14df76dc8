"""Joint laws of aging as tables: every law with its evidence, compared with separate laws of the series."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.errors import FitError, RequestError
from sealfit.fit.aging.joint_law import DRIVERS, Aged, JointLaw, fit_laws, left_out, rivals_of
from sealfit.fit.aging.law import Values, fit_law, law_model
from sealfit.fit.steady import FORCES, parameter_units
from sealfit.fit.steady.shared_curve import Levels, shared_levels
from sealfit.physics.aging_laws import LOSSES
from sealfit.tables import AGING_LAWS, MASTER_CURVE

TEMPERATURE, COMPRESSION = "temperature_C", "compression_ratio_pct"
# Name of the law with separate a and b of Eq. 15 for every series.
SEPARATE = "separate"
# Number of the best laws whose held-out error is computed.
HELD_OUT_LAWS = 3
# Points of a curve from a third of the first aged day on.
CURVE_POINTS = 61
# Further points between day 0 and a third of the first aged day.
START_POINTS = 20


def aged_values(levels: Levels, rubber: str, quantity: str) -> Aged:
    """Return the values of one quantity of a rubber at the conditions where the forces determine it."""
    of = (levels.table["rubber"] == rubber) & (levels.table["quantity"] == quantity)
    rows, here = levels.table[of], of.to_numpy()

    def column(name):
        return rows[name].to_numpy(float) if name in rows and rows[name].notna().any() else None

    return Aged(
        rows["aging_days"].to_numpy(float),
        rows["value"].to_numpy(float),
        column(TEMPERATURE),
        column(COMPRESSION),
        levels.covariance[here][:, here],
    )


def joint_laws(
    steady: pd.DataFrame, steady_fit: pd.DataFrame, config: Config
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return tables `aging_laws` and `master_curve`; empty without aging or with too few conditions.

    They are fitted to the forces in table `steady`, with `steady_fit` and its condition columns.
    """
    data = {}
    if config.aging and "aging_days" in steady_fit.columns:
        levels = shared_levels(steady, steady_fit)
        for rubber, quantity in _quantities(levels):
            unit = parameter_units(config.units, quantity in FORCES)["mu_s"]
            data[rubber, quantity] = (aged_values(levels, rubber, quantity), unit)
    return law_tables(data)


def law_tables(data: Mapping[tuple[str, str], tuple[Aged, str]]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return tables `aging_laws` and `master_curve` of values and their units, by rubber and quantity."""
    rows, curves = [], []
    for (rubber, quantity), (aged, unit) in data.items():
        try:
            laws = fit_laws(aged)
        except FitError:  # no law can be fitted
            continue
        at = {"rubber": rubber, "quantity": quantity}
        rows += [{**at, **row} for row in _law_rows(laws, unit)]
        curves.append(_master_curve(laws[0]).assign(**at))
    curves = pd.concat(curves, ignore_index=True) if curves else pd.DataFrame()
    return (
        pd.DataFrame(rows).assign(model="before").reindex(columns=AGING_LAWS.names()),
        curves.reindex(columns=MASTER_CURVE.names()),
    )


def _quantities(levels: Levels) -> list[tuple[str, str]]:
    """Return rubber and quantity of all values, in order; mu_s comes before mu_c."""
    pairs = levels.table[["rubber", "quantity"]].drop_duplicates().itertuples(index=False, name=None)
    order = [*FORCES, *FORCES.values()]
    return sorted(pairs, key=lambda pair: (pair[0], order.index(pair[1])))


def _law_rows(laws: Sequence[JointLaw], unit: str) -> Iterator[dict]:
    best = laws[0]
    rivals = rivals_of(laws)
    for number, law in enumerate(laws):
        errors = left_out(law) if number < HELD_OUT_LAWS else {}
        head = {
            "law": law.loss.name,
            "way": law.acts_on if best.aged.drivers() else "",
            "form": law.loss.form,
            "rank": number + 1,
            "rival": law in rivals,
            "criterion": law.bic - best.bic,
            "scatter_rel": law.scatter,
            "lack_of_fit_p": law.lack_of_fit_p(),
            "heldout_series": errors.get("series", np.nan),
            "heldout_last_day": errors.get("last_day", np.nan),
        }
        units = {"mu_0": unit, "a": unit, "E": "kJ/mol", "kappa": "1/%"}
        units |= dict(zip(law.loss.parameters, law.loss.units, strict=True))
        for name, value, low, high, known in law.parameters():
            yield {
                **head, "parameter": name, "value": value, "lo95": low, "hi95": high, "unit": units[name],
                "identified": known,
            }  # fmt: skip
    apart = _separate(best)
    if apart is not None:
        yield {
            "law": SEPARATE, "way": "", "form": "mu_0 - a ln(1 + t/b), a and b of each series",
            "rank": len(laws) + 1, "rival": False, "criterion": apart[0] - best.bic,
            "heldout_last_day": apart[1], "identified": True,
        }  # fmt: skip


def _separate(law: JointLaw) -> tuple[float, float] | None:
    """Return the BIC of separate laws under the joint law's scatter, and their held-out error at last days.

    None if the series have too few values for separate laws.
    """
    aged, series, days = law.aged, law.aged.series(), law.aged.days_of_series()
    if len(days) < 2 or min(days) < 3:
        return None
    origin = np.zeros(aged.value.size, int)
    fitted = fit_law(Values(aged.days, aged.value, origin, series, aged.covariance(law.scatter)))
    bic = fitted.chi2 + aged.spread.log_determinant(law.scatter) + fitted.x.size * np.log(aged.value.size)
    squares = []
    for out in aged.last_days() if min(days) > 3 else []:
        part = fit_law(fitted.values.part(~out), fitted.x)
        squares += list((law_model(fitted.values, part.x)[out] - aged.value[out]) ** 2)
    return bic, float(np.sqrt(np.mean(squares))) if squares else np.nan


def _master_curve(law: JointLaw) -> pd.DataFrame:
    """Return values on the master curve, and the law with band at reference temperature and compression.

    If temperature and compression change the rate of aging, times are multiplied by k; if they change the
    loss, losses are divided by k.
    """
    aged = law.aged
    tested = (aged.temperature_C, aged.compression_pct)
    scaled, start = law.tested_days(), law.x[0]
    value = aged.value if law.acts_on == "rate" else start + (aged.value - start) / law.rate(aged)
    points = {"kind": "value", "scaled_days": scaled, "value": value, "aging_days": aged.days}
    for name, column in zip((TEMPERATURE, COMPRESSION), tested, strict=True):
        points[name] = np.nan if column is None else np.where(aged.days > 0, column, np.nan)
    first = scaled[scaled > 0].min() / 3
    near = first * np.linspace(0, 1, START_POINTS, endpoint=False) ** 2  # laws fall fastest there
    days = np.r_[near, np.geomspace(first, scaled.max() * 1.5, CURVE_POINTS)]
    middle = [np.full(days.size, aged.middle[name]) if name in aged.middle else None for name, *_ in DRIVERS]
    at = Aged(days, np.zeros(days.size), *middle)
    slope = law.slope(at)
    half = law.t * np.sqrt(np.einsum("in,ij,jn->n", slope, law.covariance, slope))
    value = law.at(at)
    curve = {"kind": "law", "scaled_days": days, "value": value, "lo95": value - half, "hi95": value + half}
    return pd.concat([pd.DataFrame(points), pd.DataFrame(curve)], ignore_index=True)


def law_of(
    steady: pd.DataFrame, steady_fit: pd.DataFrame, quantity: str, name: str | None = None
) -> list[JointLaw]:
    """Return the laws of one quantity, such as "mu_s", in order of BIC, or only a named one.

    Raises
    ------
    RequestError
        If rubber is not aged, the quantity was not fitted, there are several rubbers, or no such law can be
        fitted.
    """
    if "aging_days" not in steady_fit.columns:
        raise RequestError("this rig ages no rubber.", fix="Name aging_days in the config's condition.")
    levels = shared_levels(steady, steady_fit)
    rubber = rubber_of(_quantities(levels), quantity)
    return laws_of(aged_values(levels, rubber, quantity), name)


def rubber_of(known: Sequence[tuple[str, str]], quantity: str) -> str:
    """Return the one rubber of a quantity among the known (rubber, quantity).

    Raises
    ------
    RequestError
        If the quantity is not there, or of several rubbers.
    """
    rubbers = [rubber for rubber, own in known if own == quantity]
    if not rubbers:
        there = ", ".join(dict.fromkeys(own for _, own in known)) or "none"
        raise RequestError(f"there is no '{quantity}' to follow.", fix=f"Choose one of: {there}.")
    if len(rubbers) > 1:
        raise RequestError(
            f"there are several rubbers: {', '.join(rubbers)}.", fix="Analyse them one by one."
        )
    return rubbers[0]


def laws_of(aged: Aged, name: str | None = None) -> list[JointLaw]:
    """Return the laws of one quantity in order of BIC, or only a named one.

    Raises
    ------
    RequestError
        If there is no such law, or it cannot be fitted.
    """
    if name is not None and name not in LOSSES:
        raise RequestError(f"there is no law '{name}'.", fix=f"Choose one of: {', '.join(LOSSES)}.")
    try:
        return fit_laws(aged) if name is None else fit_laws(aged, (name,))
    except FitError as error:
        raise RequestError(error.message, fix=error.fix) from error
