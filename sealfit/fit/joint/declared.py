"""Parameters of the declared model that conditions and speeds determine, and conditions that use them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.special import fdtrc

from sealfit.fit.joint.rows import Rows
from sealfit.ingest.strokes import speed_clusters

QUANTITIES = ("mu_0s", "a_s", "b_s", "mu_0c", "a_c", "b_c", "v_s", "sigma_2")
# Number of tested speeds that determine the curve, four numbers, between them as well.
SPEEDS_BETWEEN = 4
# Forms of the speed dependence with mu_s and v_s.
CURVED = ("full", "interpolated")
# Number of tested speeds that the viscous term needs.
SPEEDS_FOR_VISCOUS = 2
# Number of aging days that Eq. 15 needs: mu_0, a and b are three numbers.
DAYS_FOR_LAW = 3
# Standard deviation of the prior of the Stribeck drop mu_s - mu_c, as a share of friction. Without a prior
# mu_c = 0 may fit four speeds as well as any other value, and the force between the speeds is far off.
DROP_SHARE = 0.5
# P-value below which a line through two or three speeds is rejected. Few files give the test little power. In
# 59 campaigns drawn at random with at most 27 files and three speeds, 0.5 in place of 0.15 lowered the error
# against the truth in three, 2 to 35 times, and raised it in one, by 8 %.
REJECTED = 0.5
# A residual sum of squares below this share of the total is rounding.
ROUNDING = 1e-24


@dataclass(frozen=True, slots=True)
class JointParameter:
    """One fitted number of the declared model: its quantity, and its rubber, series or condition."""

    quantity: str
    owner: str


@dataclass(frozen=True, eq=False)
class Declared:
    """The fitted number that each condition uses for each quantity; -1 if the condition's model lacks it."""

    parameters: tuple[JointParameter, ...]
    index: Mapping[str, np.ndarray]  # quantity -> (conditions,) number of the parameter
    stribeck: Mapping[str, str]  # series -> "full" | "interpolated" | "viscous" | "constant"
    law: Mapping[str, bool]  # series -> whether Eq. 15 is fitted across its days
    drops: Mapping[tuple[int, int], float]  # (mu_s, mu_c) -> standard deviation of the prior of mu_s - mu_c

    @property
    def mu_parameter_count(self) -> int:
        """Number of parameters of a coefficient over all conditions; specimens beyond it show scatter."""
        return sum(p.quantity in ("mu_0c", "a_c", "b_c") for p in self.parameters)


def declare(rows: Rows, *, as_in: Rows | None = None) -> Declared:
    """Return the declared model that these conditions and speeds determine.

    A series needs four speeds in one direction for Eq. 14, or two or three at which friction is no line that
    rises ("interpolated"), and two for the viscous term. Few will do if another series of its rubber has a
    curve. Eq. 15 needs three days, the unaged day included. Parameters that are not determined are left out.
    Speeds are counted within one direction: an offset between directions could be taken for a Stribeck curve.
    The result is cached. A part of a campaign with the same conditions takes its model, `as_in`.
    """
    return rows.cache.once(("declared",), lambda: _declare(rows) if as_in is None else declare(as_in))


def _declare(rows: Rows) -> Declared:
    conditions = rows.conditions
    names = tuple(conditions["condition"])
    aging = rows.has_aging
    series_of = series_of_curve(conditions, aging)
    stribeck = _speed_forms(rows, series_of)
    rubbers, days = (conditions[name].tolist() for name in ("rubber", "aging_days"))
    law = dict(zip(series_of, has_law(conditions, aging).tolist(), strict=True))
    law_rubbers = {rubber for s, rubber in zip(series_of, rubbers, strict=True) if law[s]}
    parameters: dict[JointParameter, int] = {}
    index = {quantity: np.full(len(names), -1) for quantity in QUANTITIES}

    def use(c: int, quantity: str, owner: str) -> None:
        index[quantity][c] = parameters.setdefault(JointParameter(quantity, owner), len(parameters))

    for c, (name, series, rubber) in enumerate(zip(names, series_of, rubbers, strict=True)):
        unaged = aging and days[c] == 0 and rubber in law_rubbers
        for end in "sc":
            if end == "s" and stribeck[series] not in CURVED:
                continue
            if law[series]:
                for quantity, owner in ((f"mu_0{end}", rubber), (f"a_{end}", series), (f"b_{end}", series)):
                    use(c, quantity, owner)
            else:
                use(c, f"mu_0{end}", rubber if unaged else name)
        if stribeck[series] in CURVED:
            use(c, "v_s", series)
        if stribeck[series] != "constant":
            use(c, "sigma_2", series)
    drops = _drops(index["mu_0s"], index["mu_0c"], rows)
    return Declared(tuple(parameters), index, stribeck, law, drops)


def has_law(conditions: pd.DataFrame, aging: bool) -> np.ndarray:
    """Return whether the series of each condition has enough days, unaged ones included, for Eq. 15."""
    series = series_of_curve(conditions, aging)
    rubbers, days = (conditions[name].tolist() for name in ("rubber", "aging_days"))
    unaged_rubbers = {rubber for rubber, day in zip(rubbers, days, strict=True) if day == 0}
    days_of: dict[str, set[float]] = {}
    for s, rubber, day in zip(series, rubbers, days, strict=True):
        days_of.setdefault(s, set()).update({day, 0.0} if rubber in unaged_rubbers else {day})
    return np.array([aging and len(days_of[s]) >= DAYS_FOR_LAW and max(days_of[s]) > 0 for s in series])


def _drops(number_s: np.ndarray, number_c: np.ndarray, rows: Rows) -> dict[tuple[int, int], float]:
    """Return the prior's standard deviation of mu_s - mu_c for pairs of numbers, -1 without a curve."""
    mu, found = np.abs(rows.force) / rows.load, {}
    both = np.column_stack([number_s, number_c])
    for pair in np.unique(both[number_s >= 0], axis=0):
        own = mu[(both == pair).all(axis=1)[rows.condition]]
        if own.any():
            found[tuple(pair.tolist())] = DROP_SHARE * float(own.mean())
    return found


def series_of_curve(conditions, aging: bool) -> np.ndarray:
    """Return the series whose v_s each condition uses; unaged rubber uses the only one of its rubber."""
    series = conditions["series"].to_numpy(dtype=object).copy()
    if aging:
        for rubber in conditions["rubber"].unique():
            own = (conditions["rubber"] == rubber).to_numpy()
            aged = own & (conditions["aging_days"] > 0).to_numpy()
            if len(set(series[aged])) == 1:
                series[own] = series[aged][0]
    return series


def _speed_forms(rows: Rows, series_of: np.ndarray) -> dict[str, str]:
    """Return the form of the speed dependence of each series; a curve, if one of the same rubber has one."""
    number, names = pd.factorize(series_of)
    forms = {}
    for k, name in enumerate(names):
        chosen = np.flatnonzero(number[rows.condition] == k)
        forward = rows.speed[chosen] > 0
        most = max(tested_speeds(rows, chosen[way]).size for way in (forward, ~forward))
        if most >= SPEEDS_BETWEEN:
            forms[name] = "full"
        elif most < SPEEDS_FOR_VISCOUS:
            forms[name] = "constant"
        else:
            forms[name] = "interpolated" if _p_of_lines(rows, chosen) < REJECTED else "viscous"
    owners = list(zip(series_of, rows.conditions["rubber"], strict=True))
    curved = {rubber for name, rubber in owners if forms[name] in CURVED}
    return forms | {
        name: "interpolated" for name, rubber in owners if forms[name] == "viscous" and rubber in curved
    }


def _p_of_lines(rows: Rows, chosen: np.ndarray) -> float:
    """Return the p-value of F tests on file means that friction at two or three speeds is a line that rises.

    A curve through so few speeds leaves few degrees of freedom for other effects, so a line is kept if it is
    not rejected. As in the declared model its slope is not negative and shared by all conditions, each of
    which has its own level. The curve adds curvature that all share, and may add a slope of each condition
    (mu_s less mu_c). Repeats may differ, each by the same in all runs: seals run in. So may the directions.
    Without a degree of freedom there is no test; it is 0 then, and the curve is taken.
    """
    speed, load = np.abs(rows.speed[chosen]), rows.load[chosen]
    nearest = np.abs(speed[:, None] - tested_speeds(rows, chosen)).argmin(axis=1)
    repeat = rows.table["repeat"].to_numpy()[chosen]
    table = pd.DataFrame(
        {
            "file": rows.codes("file")[chosen],
            "direction": np.sign(rows.speed[chosen]),
            "condition": rows.condition[chosen],
            "repeat": repeat,
            "slow": nearest == 0,
            "middle": nearest == 1,
            "slope": speed / load,
            "mu": np.abs(rows.force[chosen]) / load,
        }
    )
    files = table.groupby(["file", "direction", "condition", "slow", "middle"], as_index=False).mean()
    of_level = ("condition", "repeat", "direction")
    levels = np.hstack([pd.get_dummies(files[name], dtype=float) for name in of_level])
    slope = files["slope"].to_numpy()[:, None]
    line = np.column_stack([levels, slope])
    falls = np.linalg.lstsq(line, files["mu"], rcond=1e-9)[0][-1] < 0
    bends = files[["slow", "middle"]]  # with one load, one of them is a slope
    conditions = levels[:, : files["condition"].nunique()]
    curves = [np.column_stack([levels, slopes, bends]) for slopes in (slope, conditions * slope)]
    tests = [_p_of_line(levels if falls else line, curve, files["mu"].to_numpy()) for curve in curves]
    p_values = [p for p in tests if p is not None]
    return len(p_values) * min(p_values, default=0.0)


def _p_of_line(line: np.ndarray, curve: np.ndarray, values: np.ndarray) -> float | None:
    """Return the p-value of a line within a curve, both columns of shape (n, k), by an F test.

    None where the curve leaves no degree of freedom and the line does not fit exactly.
    """
    sums, ranks = [], []
    for columns in (line, curve):
        found, _, rank, _ = np.linalg.lstsq(columns, values, rcond=1e-9)
        sums.append(float(np.sum((values - columns @ found) ** 2)))
        ranks.append(rank)
    more, left, rounding = ranks[1] - ranks[0], values.size - ranks[1], ROUNDING * float(values @ values)
    if more == 0 or sums[0] <= rounding:
        return 1.0
    if left == 0:
        return None
    return float(fdtrc(more, left, (sums[0] - sums[1]) / more / max(sums[1] / left, rounding)))


def tested_speeds(rows: Rows, chosen: np.ndarray) -> np.ndarray:
    """Return the speeds of chosen rows, ascending: commanded, or means of measured ones within 25 %."""
    commanded = np.abs(rows.values("speed_set_mm_s")[chosen])
    if np.isfinite(commanded).all():
        return np.unique(np.round(commanded, 9))
    _, stroke = np.unique(rows.codes("stroke")[chosen], return_inverse=True)
    means = np.sort(np.bincount(stroke, np.abs(rows.speed[chosen])) / np.bincount(stroke))
    return np.array([part.mean() for part in speed_clusters(means)])
