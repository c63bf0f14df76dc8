"""Numerical trust: the same digits whatever the size of the numbers.

    python benchmarks/torture/digits.py [--campaigns aged short no_load] [--changes force_1e-06 ...]

A campaign is written again with forces and loads of another size (a typical force of 1 uN to 1 MN, the loads
in proportion), with positions that are offset by 1e6 mm, with times since 1970 (1.7e9 s), and in other units
by the config. Every step but the report is done, and points are predicted. The verdict and the effects must
stay, and every number of every table, after conversion, must agree to a relative 1e-6 or to 0.01 standard
errors.

Numbers of a column of rows and of a curve are compared on the scale of that column; the standard error of a
row is the scatter of the rows, that of a standard deviation follows from its degrees of freedom. p-values,
information criteria and the like, steep functions of the residuals, are compared to 1e-3, covariances to 0.02
of themselves. Positions and times are compared after an offset is taken out; the phase of a ripple is
not compared, nor how much of a residual lies along time itself, whose logarithm an offset changes.

The solvers on the NIST reference sets are in tests/fit/test_nist.py. `thermometer` is example H.3 of the GUM
(JCGM 100:2008).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pint
import pyarrow.parquet as pq

sys.path.insert(1, str(Path(__file__).resolve().parent.parent))  # the other benchmarks
from invariances import Campaign, toml

from sealfit import commands
from sealfit.closure.prediction_csv import ANSWERS
from sealfit.fit.least_squares import covariance_of, levenberg_marquardt
from sealfit.pipeline import run
from sealfit.simulation import Spec, simulate

# ---------------------------------------------------------------- the GUM's thermometer
# JCGM 100:2008, table H.6: readings in degC, and observed corrections in degC.
READINGS = np.array([21.521, 22.012, 22.512, 23.003, 23.507, 23.999, 24.513, 25.002, 25.503, 26.010, 26.511])
CORRECTIONS = -np.array([0.171, 0.169, 0.166, 0.159, 0.164, 0.165, 0.156, 0.157, 0.159, 0.161, 0.160])
REFERENCE_C = 20.0
# As printed there: intercept, slope, their standard uncertainties, their correlation, the standard deviation
# of the fit, and the correction predicted for 30 degC with its standard uncertainty.
PRINTED = {
    "y_1": -0.1712, "y_2": 0.00218, "u_1": 0.0029, "u_2": 0.00067, "r": -0.930, "s": 0.0035, "b_30": -0.1494,
    "u_30": 0.0041,
}  # fmt: skip


def thermometer() -> dict[str, float]:
    """Return the results of example H.3 by the solver and the covariance that the fits use."""
    columns = np.column_stack([np.ones_like(READINGS), READINGS - REFERENCE_C])

    def evaluate(x: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return x @ columns.T - CORRECTIONS, np.tile(columns.T, (len(x), 1, 1))

    endless = np.full(2, np.inf)
    x, rss = levenberg_marquardt(evaluate, np.zeros((1, 2)), -endless, endless)
    s = float(np.sqrt(rss[0] / (len(READINGS) - 2)))
    covariance = s**2 * covariance_of(columns)[0]
    u = np.sqrt(np.diag(covariance))
    at_30 = np.array([1.0, 30.0 - REFERENCE_C])
    return {
        "y_1": x[0, 0], "y_2": x[0, 1], "u_1": u[0], "u_2": u[1], "r": covariance[0, 1] / (u[0] * u[1]),
        "s": s, "b_30": at_30 @ x[0], "u_30": float(np.sqrt(at_30 @ covariance @ at_30)),
    }  # fmt: skip


# ---------------------------------------------------------------- campaigns
NOISE = (
    {"kind": "repeat_gain", "sd_rel": 0.008},
    {"kind": "white", "sd_N": 0.15},
    {"kind": "displacement", "sd_mm": 0.002},
)
WARMING = {
    "id": "warming_distance", "acts_on": "mu", "operation": "multiply",
    "parameters": {"A": 0.06, "s_0": 10.0},
}  # fmt: skip
RIPPLE = {
    "id": "ripple", "acts_on": "force", "operation": "add",
    "parameters": {"A": 0.8, "lambda_": 5.0, "phi": 0.7},
}  # fmt: skip
SPECS = {
    "aged": {
        "design": {
            "temperatures_C": (60.0, 80.0), "days": (1.0, 4.0, 16.0), "unaged": True, "repeats": 2,
            "max_rows": 100, "speeds_mm_s": (0.5, 2.0, 6.0, 20.0), "start_scatter_mm": 4.0,
        },
        "effects": (WARMING,),
    },
    "short": {
        "design": {
            "days": (), "unaged": True, "speeds_mm_s": (0.5, 2.0, 6.0, 20.0), "repeats": 2, "max_rows": 100,
            "start_scatter_mm": 4.0,
        },
        "effects": (RIPPLE,),
    },
}  # fmt: skip
NAMES = ("aged", "short", "no_load")


@cache
def campaign(name: str) -> Campaign:
    """Return a small campaign; `no_load` is `short` without its loads, so that forces are fitted."""
    if name == "no_load":
        short = campaign("short")
        return replace(short, runs=short.runs.drop(columns="load_N"))
    with tempfile.TemporaryDirectory() as folder:
        simulate(Spec(name=name, seed=5, noise=NOISE, **SPECS[name]), Path(folder) / "c")
        return Campaign.read(Path(folder) / "c", "")


# ---------------------------------------------------------------- changes
TYPICAL_N = 40.0  # force of the campaigns
ACCURACY_N = 0.2  # of the sensor, the config's default


@dataclass(frozen=True)
class Change:
    """What is done to a campaign.

    `force` multiplies forces and loads; offsets are added to positions and times; `quantities` gives slots
    other units, and `columns` the columns of files other units.
    """

    force: float = 1.0
    offset_mm: float = 0.0
    offset_s: float = 0.0
    quantities: dict[str, str] = field(default_factory=dict)
    columns: dict[str, str] = field(default_factory=dict)


CHANGES = {
    **{f"force_{size:g}": Change(force=size / TYPICAL_N) for size in (1e-6, 1e-3, 1.0, 1e3, 1e6)},
    **{f"position_{far:g}": Change(offset_mm=far) for far in (1e3, 1e6)},
    "time_1970": Change(offset_s=1.7e9),
    "slots_mN_m_ms": Change(quantities={"force": "mN", "displacement": "m", "time": "ms"}),
    "slots_MN_um_min": Change(quantities={"force": "MN", "displacement": "um", "time": "min"}),
    "files_kN_m_ms": Change(columns={"force": "kN", "displacement": "m", "time": "ms"}),
    "files_uN_nm_h": Change(columns={"force": "uN", "displacement": "nm", "time": "h"}),
    "all": Change(1e6 / TYPICAL_N, 1e6, 1.7e9, {}, {"force": "mN", "displacement": "um", "time": "ms"}),
}
SLOTS = {"force_N": "N", "load_N": "N", "displacement_mm": "mm", "time_s": "s", "speed_mm_s": "mm/s"}
REGISTRY = pint.UnitRegistry()


def times(unit: str, other: str) -> float:
    """Return the number of `other` in one `unit`."""
    return float(REGISTRY.Quantity(1.0, unit).to(other).magnitude)


def changed(given: Campaign, change: Change) -> Campaign:
    """Return a campaign with a change, its config with it."""
    given = given.each(
        lambda trace: trace.assign(
            force_N=trace["force_N"] * change.force,
            displacement_mm=trace["displacement_mm"] + change.offset_mm,
            time_s=trace["time_s"] + change.offset_s,
        )
    )
    if "load_N" in given.runs:
        given = replace(given, runs=given.runs.assign(load_N=given.runs["load_N"] * change.force))
    units = _units_of_columns(change.quantities or change.columns)
    by = {column: times(SLOTS[column], unit) for column, unit in units.items()}

    def scaled(table: pd.DataFrame) -> pd.DataFrame:
        return table.assign(**{name: table[name] * k for name, k in by.items() if name in table})

    given = replace(given.each(scaled), runs=scaled(given.runs))
    accuracy = ACCURACY_N * change.force * (by["force_N"] if change.quantities else 1.0)
    sections: dict[str, dict] = {"sensor": {"accuracy": accuracy}}
    if change.quantities:
        sections["quantities"] = {
            column.split("_")[0]: {"quantity": column.split("_")[0], "unit": unit}
            for column, unit in units.items()
        }
    if change.columns:
        of_runs = [name for name in ("load_N", "speed_mm_s") if name in given.runs]
        named = {name: {"name": name, "unit": units[name]} for name in units}
        sections["trace"] = {
            "columns": {name: named[name] for name in ("time_s", "displacement_mm", "force_N")}
        }
        sections["files"] = {"runs_columns": {name: named[name] for name in of_runs}}
    return given.told(**sections)


def _units_of_columns(units: dict[str, str]) -> dict[str, str]:
    """Return the unit of every column from those of force, displacement and time."""
    if not units:
        return dict(SLOTS)
    force, length, clock = units["force"], units["displacement"], units["time"]
    return {
        "force_N": force, "load_N": force, "displacement_mm": length, "time_s": clock,
        "speed_mm_s": f"{length}/{clock}",
    }  # fmt: skip


# ---------------------------------------------------------------- results
PLACES = ("phi", "x_0")  # parameters that an offset of the position moves
STEPS = ("ingest", "fit-steady", "fit-aging", "fit-dynamic", "close-loop")
NUMBERS = ("value", "se", "lo95", "hi95", "u_sys")


@dataclass(frozen=True)
class Results:
    """Tables of numbers in N, mm and s (without a change's factor and offsets), and closure.json."""

    tables: dict[str, pd.DataFrame]
    closure: dict


def results(given: Campaign, change: Change) -> Results:
    """Return what every command but the report says of a campaign with a change."""
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        made = changed(given, change)
        (home / "c").mkdir()
        made.write(home / "c")
        (home / "rig.toml").write_text(made.config or toml({}))
        run(home / "c", home / "out", home / "rig.toml", steps=STEPS)
        tables = {path.name.removesuffix(".parquet"): _table(path, change)
                  for path in sorted((home / "out").glob("*.parquet"))}  # fmt: skip
        tables["predictions"] = _predicted(home, made, change)
        closure = json.loads((home / "out" / "closure.json").read_text())
    tables["closure"] = _of_closure(closure, change)
    for name, table in tables.items():
        if "parameter" in table:
            tables[name] = table[~table["parameter"].isin(PLACES)].reset_index(drop=True)
    return Results(tables, closure)


def _predicted(home: Path, made: Campaign, change: Change) -> pd.DataFrame:
    trace = made.traces[made.runs["file"][0]]
    middle = trace["displacement_mm"].mean()
    points = made.runs.iloc[:: max(len(made.runs) // 8, 1)].drop(columns=["started_at"], errors="ignore")
    units = _units_of_columns(change.columns)  # points are in the units of the slots
    for name in ("load_N", "speed_mm_s"):
        if name in points and change.columns:
            points[name] = points[name] * times(units[name], SLOTS[name])
    place = middle * (times(units["displacement_mm"], "mm") if change.columns else 1.0)
    points = points.assign(
        displacement_mm=place, run_order=3, elapsed_h=1.0, distance_mm=np.nan, time_s=np.nan
    )
    begin = (trace["displacement_mm"].iloc[0], trace["time_s"].iloc[0])
    by = (
        (times(units["displacement_mm"], "mm"), times(units["time_s"], "s")) if change.columns else (1.0, 1.0)
    )
    points["distance_mm"] = place - begin[0] * by[0]
    points["time_s"] = begin[1] * by[1] + (trace["time_s"].mean() - begin[1]) * by[1]
    points.to_csv(home / "points.csv", index=False)
    commands.predict(home / "out", home / "points.csv", home / "q.csv")
    answers = pd.read_csv(home / "q.csv")[[name for name in ANSWERS if name.endswith("_N")]]
    unit = _units_of_columns(change.quantities)["force_N"]
    return answers * times(unit, "N") / change.force


@cache
def _exponents(unit: str) -> tuple[float, dict[str, float]]:
    """Return a unit's size in N, mm, s and its exponents of these."""
    text = unit.replace("°C", "K").replace("%", "percent").replace("·", " ")
    quantity = REGISTRY.Quantity(1.0, text) if text else REGISTRY.Quantity(1.0)
    dimension = dict(quantity.dimensionality)
    force = dimension.get("[mass]", 0)
    length, clock = dimension.get("[length]", 0) - force, dimension.get("[time]", 0) + 2 * force
    base = REGISTRY.newton**force * REGISTRY.mm**length * REGISTRY.s**clock
    if set(dimension) - {"[mass]", "[length]", "[time]"} or not dimension:
        return 1.0, {}
    return float(quantity.to(base).magnitude), {"force": force}


def _factor(unit: str, change: Change) -> float:
    """Return what a number of this unit is multiplied by to get that of the campaign as it is."""
    if unit in ("d", "h", "byte", "ns"):
        return 1.0
    size, exponents = _exponents(unit)
    return size / change.force ** exponents.get("force", 0)


def _table(path: Path, change: Change) -> pd.DataFrame:
    """Return a table with its numbers in N, mm and s, without a change's factor and offsets."""
    table = pd.read_parquet(path)
    schema = pq.read_schema(path if path.is_file() else next(path.glob("*.parquet")))
    units = {column.name: (column.metadata or {}).get(b"unit", b"").decode() for column in schema}
    rows = None
    if "unit" in table and len(table):
        rows = table["unit"].fillna("").map(lambda unit: _factor(unit, change)).to_numpy(float)
    elif "quantity" in table and "value" in table and len(table):
        forces = table["quantity"].astype(str).str.startswith("F_")
        unit = change.quantities.get("force", "N")
        rows = np.where(forces, _factor(unit, change), 1.0)
    for name in table.columns:
        if not pd.api.types.is_float_dtype(table[name]):
            continue
        by = rows if name in NUMBERS and rows is not None else _factor(units[name], change)
        table[name] = table[name] * by
        if name.startswith("displacement") and name.endswith("_mm"):
            table[name] -= change.offset_mm
        if name == "time_s":
            table[name] -= change.offset_s
    return table


def _of_closure(closure: dict, change: Change) -> pd.DataFrame:
    """Return the parameters of the effects as a table, without places and phases."""
    rows = [
        (f"{number} {effect['id']} {one['name']}", one["value"], *one["ci95"], one["unit"])
        for number, effect in enumerate(closure["effects"])
        for one in effect["parameters"]
        if one["name"] not in PLACES
    ]
    table = pd.DataFrame(rows, columns=["parameter", "value", "lo95", "hi95", "unit"])
    by = table["unit"].map(lambda unit: _factor(unit, change)).to_numpy(float)
    return table.assign(**{name: table[name].astype(float) * by for name in ("value", "lo95", "hi95")})


# ---------------------------------------------------------------- comparison
RELATIVE, OF_SE = 1e-6, 0.01
ZERO = 1e-12  # in N, mm, s: a parameter on its bound of 0 has rounding errors only
# p-values, degrees of freedom, information criteria and held-out errors: of themselves, or of 1.
STEEP = 1e-3
STEEP_COLUMNS = (
    "p_value",
    "df",
    "criterion",
    "lack_of_fit_p",
    "scatter_rel",
    "heldout_series",
    "heldout_last_day",
)
# A covariance: 0.01 in each of its standard errors.
COVARIANCE = 0.02
SECOND_MOMENTS = ("steady_covariance", "aging_covariance", "steady_shift")
CURVES = ("shapes", "curves", "aging_curves", "master_curve")
NOT_COMPARED = {"mtime_ns", "size", "x"}


def _standard_errors(name: str, table: pd.DataFrame) -> np.ndarray | None:
    """Return the standard error of every row's numbers; None where a table has none."""
    for low, high in (("lo95", "hi95"), ("force_after_lo95_N", "force_after_hi95_N")):
        if {low, high} <= set(table) and "se" not in table:
            return (table[high] - table[low]).to_numpy(float) / 4
    if "se" in table:
        return table["se"].to_numpy(float)
    if "after_half_N" in table:
        return table["after_half_N"].to_numpy(float) / 2
    if {"sd_N", "df"} <= set(table):
        return table["sd_N"].max() / np.sqrt(2 * table["df"].to_numpy(float))
    for scatter in ("residual_N", "force_se_N", "force_sd_N"):  # of a row
        if scatter in table:
            return np.full(len(table), np.sqrt(np.nanmean(table[scatter].to_numpy(float) ** 2)))
    return None


@dataclass
class Compared:
    """How two results of a campaign agree."""

    numbers: int = 0
    worst_relative: float = 0.0  # of the numbers that agree
    worst_of_se: float = 0.0  # of those that agree by their standard error only
    beyond: list[str] = field(default_factory=list)


def compared(before: Results, after: Results) -> Compared:
    """Return what agrees and what does not."""
    found = Compared()
    if before.closure["verdict"] != after.closure["verdict"]:
        found.beyond.append(f"verdict {before.closure['verdict']} -> {after.closure['verdict']}")
    kinds = [[(e["id"], e["channels"], e["acts_on"], e["operation"]) for e in one.closure["effects"]]
             for one in (before, after)]  # fmt: skip
    if kinds[0] != kinds[1]:
        found.beyond.append(f"effects {kinds[0]} -> {kinds[1]}")
        return found
    scatter_N = float(before.tables["residuals_before"]["residual_N"].std())
    for name in sorted(before.tables.keys() | after.tables.keys()):
        one, other = before.tables.get(name), after.tables.get(name)
        if name == "levels" and one is not None and other is not None:
            one, other = (table[table["channel"] != "time_s"] for table in (one, other))
        if one is None or other is None or len(one) != len(other):
            found.beyond.append(f"{name}: {[None if t is None else len(t) for t in (one, other)]} rows")
            continue
        _compare(name, one, other, scatter_N, found)
    return found


def _compare(name: str, one: pd.DataFrame, other: pd.DataFrame, scatter_N: float, found: Compared) -> None:
    known_se = _standard_errors(name, one)
    for column in one.columns:
        if column in NOT_COMPARED or not pd.api.types.is_numeric_dtype(one[column]):
            continue
        a, b = one[column].to_numpy(float), other[column].to_numpy(float)
        found.numbers += a.size
        if not np.array_equal(np.isnan(a), np.isnan(b)):
            found.beyond.append(f"{name}.{column}: other cells are empty")
            continue
        if column.startswith("effects_u") or name.startswith("steady_shift"):
            a, b = np.abs(a), np.abs(b)  # eigenvectors: their sign has no meaning
        known = np.isfinite(a) & np.isfinite(b)
        scale, allowed = np.abs(a), RELATIVE
        if column in STEEP_COLUMNS:
            scale, allowed = np.maximum(scale, 1.0), STEEP
        elif name.startswith(SECOND_MOMENTS):
            allowed = COVARIANCE
        elif name.removesuffix("_after") in CURVES or column not in NUMBERS:
            scale = np.maximum(scale, np.sqrt(np.mean(a[known] ** 2)) if known.any() else 0.0)
        away = np.where(known, np.abs(a - b), 0.0)
        relative = np.divide(away, scale, out=np.zeros_like(away), where=away > ZERO)
        if "quantity" in one:  # chi-square, p-values, ...
            allowed = np.where(one["quantity"] == "statistics", STEEP, allowed)
        beyond = known & (away > allowed * scale + ZERO)
        se = known_se if known_se is not None else np.full(a.size, np.nan)
        if column.endswith("_N") or name in ("shapes", "shape_points"):
            se = np.where(np.isfinite(se) & (se > ZERO), se, scatter_N)
        if name == "shape_points":  # that of a point of two files may be near 0 by chance
            se = np.maximum(se, 0.1 * np.median(se))
        if column not in STEEP_COLUMNS:
            of_se = np.divide(away, se, out=np.full_like(away, np.inf), where=np.isfinite(se) & (se > 0))
            by_se = beyond & (of_se <= OF_SE)
            found.worst_of_se = max(found.worst_of_se, of_se[by_se].max(initial=0.0))
            beyond &= ~by_se
            relative = np.where(by_se, 0.0, relative)
        if np.all(allowed == RELATIVE):
            found.worst_relative = max(found.worst_relative, relative[~beyond].max(initial=0.0))
        if beyond.any():
            k = int(np.argmax(np.where(beyond, relative, 0)))
            words = f"{a[k]:.9g} -> {b[k]:.9g} (se {se[k]:.2g})"
            found.beyond.append(f"{name}.{column}: {beyond.sum()} of {a.size}, {_place(one, k)}: {words}")


def _place(table: pd.DataFrame, row: int) -> str:
    names = [name for name in ("quantity", "parameter", "parameter_2", "level", "channel") if name in table]
    return " ".join([f"row {row}", *(str(table[name].iloc[row]) for name in names)])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--campaigns", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--changes", nargs="+", choices=CHANGES, default=list(CHANGES))
    given = parser.parse_args()
    print("GUM H.3:", {name: f"{value:.4g}" for name, value in thermometer().items()})
    for name in given.campaigns:
        before = results(campaign(name), Change())
        effects = [effect["id"] for effect in before.closure["effects"]]
        print(f"{name}: {before.closure['verdict']}, {effects}")
        for change in given.changes:
            began = time.perf_counter()
            found = compared(before, results(campaign(name), CHANGES[change]))
            seconds = time.perf_counter() - began
            print(
                f"  {change:16} {found.numbers} numbers, worst {found.worst_relative:.1e} of themselves, "
                f"{found.worst_of_se:.1e} standard errors, {len(found.beyond)} beyond, {seconds:.1f} s",
                flush=True,
            )  # fmt: skip
            for line in found.beyond:
                print(f"    {line}")


if __name__ == "__main__":
    main()
