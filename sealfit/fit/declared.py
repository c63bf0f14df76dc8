"""What the declared model can carry at these conditions and speeds, and which fitted number serves which condition."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from sealfit.fit.both_ways import SAME_SPEED
from sealfit.fit.rows import Rows

QUANTITIES = ("mu_0s", "a_s", "b_s", "mu_0c", "a_c", "b_c", "v_s", "sigma_2")
SPEEDS_FOR_STRIBECK = 4  # mu_s, mu_c, v_s and sigma_2 are four numbers
SPEEDS_FOR_VISCOUS = 2
DAYS_FOR_LAW = 3  # mu_0, a and b are three numbers


@dataclass(frozen=True, slots=True)
class JointParameter:
    """One fitted number of the declared model: which quantity, and of which rubber, series or condition."""

    quantity: str
    owner: str


@dataclass(frozen=True)
class Declared:
    """Which fitted number each condition uses for each quantity; -1 where the quantity is absent."""

    parameters: tuple[JointParameter, ...]
    index: Mapping[str, np.ndarray]  # quantity -> (conditions,) number of the parameter
    conditions: tuple[str, ...]
    has_load: bool
    stribeck: Mapping[str, str]  # series -> "full" | "viscous" | "constant"
    law: Mapping[str, bool]  # series -> whether Eq. 15 is fitted across its days

    @property
    def numbers_of_mu(self) -> int:
        """How many numbers the model fits to one coefficient across conditions: specimens beyond them show scatter."""
        return sum(p.quantity in ("mu_0c", "a_c", "b_c") for p in self.parameters)


def declare(rows: Rows, *, as_in: Rows | None = None) -> Declared:
    """Return the declared model that these conditions and speeds can carry.

    A series needs four speeds in one direction for Eq. 14, two for the viscous term; Eq. 15 needs three days, the
    unaged day included. What cannot be fitted is left out, not guessed. Speeds are counted within one direction, as an
    offset between directions would otherwise pass for a Stribeck curve. Made once for the same rows. Rows that are a
    part of a campaign, with its conditions, may carry its model: `as_in` is the campaign.
    """
    if ("declared",) not in rows.cache:
        rows.cache["declared",] = _declare(rows) if as_in is None else declare(as_in)
    return rows.cache["declared",]


def _declare(rows: Rows) -> Declared:
    conditions = rows.conditions
    names = tuple(conditions["condition"])
    aging = rows.has_aging
    series_of = series_of_curve(conditions, aging)
    stribeck = _speed_forms(rows, series_of)
    rubbers, days = (conditions[name].tolist() for name in ("rubber", "aging_days"))
    unaged_rubbers = {rubber for rubber, day in zip(rubbers, days, strict=True) if day == 0}
    days_of: dict[str, set[float]] = {}
    for s, rubber, day in zip(series_of, rubbers, days, strict=True):
        days_of.setdefault(s, set()).update({day, 0.0} if rubber in unaged_rubbers else {day})
    law = {s: bool(aging and len(own) >= DAYS_FOR_LAW and max(own) > 0) for s, own in days_of.items()}
    law_rubbers = {rubber for s, rubber in zip(series_of, rubbers, strict=True) if law[s]}
    parameters: dict[JointParameter, int] = {}
    index = {quantity: np.full(len(names), -1) for quantity in QUANTITIES}

    def use(c: int, quantity: str, owner: str) -> None:
        index[quantity][c] = parameters.setdefault(JointParameter(quantity, owner), len(parameters))

    for c, (name, series, rubber) in enumerate(zip(names, series_of, rubbers, strict=True)):
        unaged = aging and days[c] == 0 and rubber in law_rubbers
        for end in "sc":
            if end == "s" and stribeck[series] != "full":
                continue
            if law[series]:
                for quantity, owner in ((f"mu_0{end}", rubber), (f"a_{end}", series), (f"b_{end}", series)):
                    use(c, quantity, owner)
            else:
                use(c, f"mu_0{end}", rubber if unaged else name)
        if stribeck[series] == "full":
            use(c, "v_s", series)
        if stribeck[series] != "constant":
            use(c, "sigma_2", series)
    return Declared(tuple(parameters), index, names, rows.has_load, stribeck, law)


def series_of_curve(conditions, aging: bool) -> np.ndarray:
    """Return the series whose v_s and sigma_2 each condition uses: a lone series takes its unaged rubber in.

    Parameters
    ----------
    conditions : DataFrame
        A row per condition with `series`, `rubber` and, where rubber is aged, `aging_days`.
    aging : bool
        Whether it is.
    """
    series = conditions["series"].to_numpy(dtype=object).copy()
    if aging:
        for rubber in conditions["rubber"].unique():
            own = (conditions["rubber"] == rubber).to_numpy()
            aged = own & (conditions["aging_days"] > 0).to_numpy()
            if len(set(series[aged])) == 1:
                series[own] = series[aged][0]
    return series


def _speed_forms(rows: Rows, series_of: np.ndarray) -> dict[str, str]:
    """Return what the speeds of each series can carry, from the series of each condition."""
    number, names = pd.factorize(series_of)
    key = 2 * number[rows.condition] + (rows.speed > 0)
    order = np.argsort(key, kind="stable")
    ends = np.searchsorted(key[order], np.arange(2 * names.size + 1))
    levels = [tested_speeds(rows, order[first:last]).size for first, last in itertools.pairwise(ends)]
    most = np.reshape(levels, (names.size, 2)).max(axis=1)  # of the two directions
    return {
        name: "full" if m >= SPEEDS_FOR_STRIBECK else "viscous" if m >= SPEEDS_FOR_VISCOUS else "constant"
        for name, m in zip(names, most, strict=True)
    }


def tested_speeds(rows: Rows, chosen: np.ndarray) -> np.ndarray:
    """Return the speeds of chosen rows: commanded ones, or means of measured ones that lie within 25 %, ascending."""
    commanded = np.abs(rows.values("speed_set_mm_s")[chosen])
    if np.isfinite(commanded).all():
        return np.unique(np.round(commanded, 9))
    _, stroke = np.unique(rows.codes("stroke")[chosen], return_inverse=True)
    return speed_clusters(np.sort(np.bincount(stroke, np.abs(rows.speed[chosen])) / np.bincount(stroke)))


def speed_clusters(speeds: np.ndarray) -> np.ndarray:
    """Return the means of clusters of sorted positive speeds, each within 25 % of its slowest."""
    cuts, base = [], 0.0
    for place, speed in enumerate(speeds):
        if place == 0 or speed > SAME_SPEED * base:
            base = speed
            cuts.append(place)
    return np.array([part.mean() for part in np.split(speeds, cuts[1:])]) if speeds.size else speeds
