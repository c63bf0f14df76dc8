"""What is found in `bins` before the search: specimens, set-ups that runs share, and loads without noise.

Set-ups are the files of a specimen with the same repeat, if these scatter alike. A run is one set-up at one
speed, and its repeats are recorded without a new one. If the specimen is mounted anew for every repeat
instead, all speeds are measured in one set-up, and their files scatter together. Runs forward and backward at
one speed are one set-up, too, if they scatter alike.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.optimize import isotonic_regression
from scipy.sparse import csr_array, hstack
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import lsmr
from scipy.special import fdtrc

from sealfit.fit.joint import Fitted
from sealfit.fit.joint.rows import SET_UP, nesting_run, records

# Level of the F test of set-ups. Campaigns whose files scatter independently have set-ups that often.
SET_UP_P = 0.001
# Level of the same test without the quarter of the specimens that show most.
OF_THE_OTHERS_P = 0.05
# Number of specimens from which this test is made. Of 60 campaigns with three specimens and four mounts each
# 50 have set-ups with the test, 59 without.
SPECIMENS_COMPARED = 4
# Smallest scatter of set-ups, as a share of the force, that matters; below lies the rounding of equal files.
LEAST_SET_UP = 1e-4
ROUNDING = 1e-9  # Relative deviation of a load from its mean along a stroke that is rounding.


def with_specimens_by_condition(bins: pd.DataFrame) -> pd.DataFrame:
    """Return table `bins` with different specimens in each condition if those of the same name differ there.

    Specimens may be numbered anew in each condition, or mounted anew after further aging. The logarithms of
    the runs' mean forces are fitted by an effect of each setting (a condition, speed and direction) and one
    of each specimen. The specimens are different ones if effects of each specimen in each condition explain
    more by F.
    """
    name, condition = bins["specimen_id"].astype(str), bins["condition"].astype(str)
    if name.nunique() < 2 or not (condition.groupby(name).nunique() > 1).any():
        return bins
    speed = np.sign(bins["speed_mm_s"]) * bins["speed_set_mm_s"].abs()
    force = bins["force_N"].abs()
    if "load_N" in bins and (bins["load_N"] != 0).all() and bins["load_N"].notna().all():
        force = force / bins["load_N"].abs()
    strokes = pd.DataFrame({"specimen": name, "own": name + " in " + condition, "force": force})
    strokes["setting"] = condition + speed.map(" at {:g}".format)
    runs = strokes.groupby([strokes["own"], bins["run_id"]])
    runs = runs.agg({"specimen": "first", "own": "first", "setting": "first", "force": "mean"})
    force = np.log(np.maximum(runs["force"].to_numpy(), 1e-300))
    p_value, _ = _compared(force, [runs["setting"], runs["specimen"]], [runs["setting"], runs["own"]])
    return bins if p_value >= SET_UP_P else bins.assign(specimen_id=strokes["own"])


def with_set_ups(bins: pd.DataFrame) -> pd.DataFrame:
    """Return table `bins` with a column `SET_UP` if repeats are set-ups, else as it is.

    The logarithms of the files' mean forces are fitted by an effect of each run and one of each repeat. If
    set-ups, of a specimen and a repeat, explain more by F, they scatter. A change with the repeat that all
    specimens have in common is none of set-ups, unless each repeat is another specimen, or there is one
    specimen that may have been mounted anew between its repeats. Nor is what a few of four or more specimens
    show: an effect that begins or ends while they are measured.
    """
    record = records(bins)
    strokes = pd.DataFrame({"run": nesting_run(bins, record), "specimen": bins["specimen_id"].astype(str)})
    strokes = strokes.assign(repeat=bins["repeat"].astype(str), force=bins["force_N"].abs())
    strokes = strokes.assign(order=bins.get("run_order", 0.0))
    firsts = dict.fromkeys(("run", "specimen", "repeat", "order"), "first")
    files = strokes.groupby(record, sort=True).agg({**firsts, "force": "mean"})
    files["set_up"] = files["specimen"] + " repeat " + files["repeat"]
    p_value, shown = _p_value(files)
    if p_value >= SET_UP_P:
        return bins
    most = shown.nlargest(max(len(shown) // 4, 1)).index
    if (
        len(shown) >= SPECIMENS_COMPARED
        and _p_value(files[~files["specimen"].isin(most)])[0] >= OF_THE_OTHERS_P
    ):
        return bins
    return bins.assign(**{SET_UP: record.map(files["set_up"])})


def _p_value(files: pd.DataFrame) -> tuple[float, pd.Series]:
    """Return the p-value of set-ups, 1 for a negligible scatter, and what they explain in each specimen."""
    known = [files["run"]]
    alike = files.groupby("run")["specimen"].nunique().max() == 1
    force = np.log(np.maximum(files["force"].to_numpy(), 1e-300))
    if alike and not (files["specimen"].nunique() == 1 and _may_be_mounts(files, force)):
        known.append(files["repeat"])
    p_value, explained = _compared(force, known, [files["run"], files["set_up"]])
    return p_value, pd.Series(explained, files.index).groupby(files["specimen"]).sum()


def _compared(
    force: np.ndarray, few: Sequence[pd.Series], many: Sequence[pd.Series]
) -> tuple[float, np.ndarray]:
    """Return the p-value of `many` factors beside `few` by F, and what they explain of each force.

    Forces have the shape (n,). The p-value is 1 for a negligible scatter.
    """
    (before, df), (after, left) = _fitted(force, few), _fitted(force, many)
    shown, added = before**2 - after**2, df - left
    if added <= 0 or left <= 0 or shown.sum() <= LEAST_SET_UP**2 * added:
        return 1.0, shown
    return float(fdtrc(added, left, shown.sum() / added / max(after @ after / left, 1e-300))), shown


def _may_be_mounts(files: pd.DataFrame, force: np.ndarray) -> bool:
    """Return whether the repeats of one specimen may be mounts.

    All files of a repeat were recorded before those of the next then. If the order is not known, the `force`,
    shape (n,), neither rises nor falls with the repeat: its means differ from the nearest such curve by F.
    """
    if files["order"].nunique() > 1:
        in_order = files.sort_values("order")["repeat"]
        return (in_order != in_order.shift()).sum() == in_order.nunique()
    left, df = _fitted(force, [files["run"], files["repeat"]])
    about = pd.Series(force, files.index)
    about = about - about.groupby(files["run"]).transform("mean")
    repeats = about.groupby(pd.to_numeric(files["repeat"]))
    mean, count = repeats.mean().to_numpy(), repeats.size().to_numpy()
    curves = [isotonic_regression(mean, weights=count, increasing=up).x for up in (True, False)]
    apart = min(count @ (mean - curve) ** 2 for curve in curves)
    noise, added = max(float(left @ left), 1e-300) / max(df, 1), mean.size - 1
    return bool(df > 0 and added > 0 and fdtrc(added, df, apart / added / noise) < SET_UP_P)


def _fitted(values: np.ndarray, factors: Sequence[pd.Series]) -> tuple[np.ndarray, int]:
    """Return the residual of up to two factors' effects, shape (n,), and its degrees of freedom."""
    codes = [pd.factorize(factor)[0] for factor in factors]
    each = np.arange(values.size)
    columns = hstack([csr_array((np.ones(values.size), (each, code))) for code in codes], format="csr")
    residual = values - columns @ lsmr(columns, values, atol=1e-12, btol=1e-12)[0]
    # Effects of two factors are determined up to a constant in each connected part of their table.
    tied = connected_components(columns.T @ columns)[0] if len(codes) > 1 else 0
    return residual, values.size - columns.shape[1] + tied


def with_both_directions(bins: pd.DataFrame, fitted: Fitted) -> pd.DataFrame:
    """Return table `bins` with a column `SET_UP` if runs forward and backward scatter alike, else as it is.

    Such runs of a specimen at one speed, in files of their own, are then one set-up, as if one file had both.
    If they scatter independently, the sums and differences of their residuals, less the means of specimens,
    have the same variance. The two are compared by F.
    """
    table = fitted.rows.table
    if SET_UP in bins or not (nesting_run(table, table["record"]) == table["run_id"]).all():
        return bins
    left = pd.Series(fitted.residual / fitted.friction).groupby(table["run_id"]).mean()
    runs = _runs_both_ways(bins).assign(left=left)
    pairs = runs.pivot_table(index=["specimen", "set_up"], columns="forward", values="left").dropna()
    df = len(pairs) - pairs.index.unique("specimen").size
    if pairs.shape[1] < 2 or df < 1:
        return bins
    forward, backward = (pairs - pairs.groupby("specimen").transform("mean")).to_numpy().T
    alike, opposed = (float(((forward + sign * backward) ** 2).sum()) / df for sign in (1, -1))
    if alike <= LEAST_SET_UP**2 or fdtrc(df, df, alike / max(opposed, 1e-300)) >= SET_UP_P:
        return bins
    return bins.assign(**{SET_UP: bins["run_id"].map(runs["set_up"])})


def _runs_both_ways(bins: pd.DataFrame) -> pd.DataFrame:
    """Return the specimen, set-up and direction of each run.

    The first run forward at a speed is of the set-up of the first one backward, and so on.
    """
    names = {"specimen": "specimen_id", "condition": "condition", "speed": "speed_set_mm_s"}
    runs = bins.assign(forward=bins["speed_mm_s"] > 0, order=bins.get("run_order", 0.0))
    runs = runs.groupby("run_id").agg(
        **{key: (name, "first") for key, name in names.items()},
        forward=("forward", "first"),
        order=("order", "min"),
    )
    runs["specimen"] = runs["specimen"].astype(str)
    runs["number"] = runs.sort_values("order").groupby([*names, "forward"], dropna=False).cumcount()
    number = runs.groupby([*names, "number"], dropna=False).ngroup()
    return runs.assign(set_up=number.map("set-up {}".format))


# ---------------------------------------------------------------- measured loads
def with_straight_loads(bins: pd.DataFrame) -> pd.DataFrame:
    """Return numbered `bins` with loads on a straight line along each stroke, and the forces at these loads.

    The deviations of the load from the line are noise of the sensor, which the force does not follow, and
    fast changes, which it follows with a delay. With them friction would seem to depend on the load. The
    force of each run is fitted to them, and this part of it is subtracted.
    """
    if "load_N" not in bins or bins["load_N"].isna().any():
        return bins
    stroke = bins["stroke_id"]
    values = bins[["load_N", "force_N", "distance_mm"]].astype(float)
    means = values.groupby(stroke).transform("mean")
    values = values - means
    place = values["distance_mm"]
    load, force = (x - _slope(place, x, stroke) * place for x in (values["load_N"], values["force_N"]))
    load = load.where(load.abs() > ROUNDING * means["load_N"].abs(), 0.0)
    following = load * means["force_N"] / means["load_N"]  # deviations of a force in proportion to the load
    followed = _slope(following, force, bins["run_id"]) * following
    return bins.assign(load_N=bins["load_N"] - load, force_N=bins["force_N"] - followed)


def _slope(x: pd.Series, y: pd.Series, group: pd.Series) -> pd.Series:
    """Return the slope of y along x through 0 in the group of each row, 0 where x is."""
    product, square = (values.groupby(group).transform("sum") for values in (x * y, x**2))
    return product / square.where(square > 0, 1.0)
