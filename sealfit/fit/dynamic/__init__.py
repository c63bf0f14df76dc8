"""The model's dynamic part per condition: sigma_0 and sigma_1 from pre-sliding, and the break-away force."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.engine.run_map import run_map
from sealfit.fit.dynamic.bristle_model import Cells, RisingStroke, StribeckCurve
from sealfit.fit.dynamic.presliding import AT, Stiffness, break_away_rows, fit_stiffness, largest_rows, peaks
from sealfit.fit.dynamic.starts import StrokePart, starts_of, strokes_along, whole_strokes
from sealfit.fit.joint.rows import nesting_run, records
from sealfit.fit.steady import SteadyFit, condition_keys, covariance_matrix, parameter_units, table_row
from sealfit.ingest.stored_parts import StoredTraces
from sealfit.tables import DYNAMIC_CURVES, DYNAMIC_FIT

# Reasons why sigma_0 or sigma_1 is not determined.
NO_START = (
    "no stroke begins at rest or at a reversal within its rows: the rise of the force is not in these traces"
)
ALONG = (
    "the sliding force of some strokes lies along the motion: check the offset between the directions, "
    "and the sign"
)
TOO_FAST = "the force rises within a few samples: sample faster, or start more slowly"
MISSED = "the rise of the force differs from the model's: the residual is {share:.0%} of the sliding force"
NO_CURVE = "the Stribeck curve is not known: its effect along the ramp cannot be distinguished from damping"
CONSTANT = (
    "the strokes begin at constant speed: damping cannot be distinguished from their initial force; "
    "record the motion from rest"
)
ONE_START = "one start alone: no scatter is known; measure repeats"
WIDE = "the starts disagree: only that it lies between {low:.3g} and {high:.3g} {unit} is known"


def bristle_rows(
    found: Stiffness | None, curve: StribeckCurve, config: Config, *, braked: bool = True
) -> Iterator[dict]:
    """Yield rows of table `dynamic_fit` for one condition: sigma_0, sigma_1 and statistics of the fit.

    `found` is None without a recorded start; `braked` is whether all sliding forces oppose the motion.
    """
    units = config.units
    unit_0 = f"{units.unit('force')}/{units.unit('displacement')}"
    unit_1 = parameter_units(units, has_load=True)["sigma_2"]
    if found is None or not found.seen:
        reason = TOO_FAST if found is not None else NO_START if braked else ALONG
        for name, unit in (("sigma_0", unit_0), ("sigma_1", unit_1)):
            row = {"quantity": "dynamic", "parameter": name, "unit": unit}
            yield table_row(**row, identified=False, reason=reason)
        return
    yield _stiffness_row(found, curve, unit_0, config)
    yield _damping_row(found, curve, unit_1)
    for name, value, unit in (
        ("rise", curve.coulomb_N / found.sigma_0, units.unit("displacement")),
        ("samples_in_rise", found.within, ""),
        ("files", found.files, ""),
        ("rmse", found.rmse_N, units.unit("force")),
    ):
        yield table_row(quantity="statistics", parameter=name, value=value, unit=unit)


def _stiffness_row(found: Stiffness, curve: StribeckCurve, unit: str, config: Config) -> dict:
    value = found.sigma_0
    row = {"quantity": "dynamic", "parameter": "sigma_0", "unit": unit, "value": value}
    if found.files < 2:
        return table_row(**row, identified=False, reason=ONE_START)
    half = found.log_half_width()
    low, high = (value * np.exp(np.clip(sign * half, -50, 50)) for sign in (-1.0, 1.0))
    row |= {"se": value * np.sqrt(found.covariance[0, 0]), "lo95": low, "hi95": high}
    row["u_sys"] = value * config.sensor.u / abs(curve.coulomb_N)
    remark = MISSED.format(share=found.rmse_N / curve.coulomb_N) if found.misses(curve.coulomb_N) else ""
    reason = remark if found.stiffness_known else WIDE.format(low=low, high=high, unit=unit)
    return table_row(**row, identified=found.stiffness_known, reason=reason)


def _damping_row(found: Stiffness, curve: StribeckCurve, unit: str) -> dict:
    row = {"quantity": "dynamic", "parameter": "sigma_1", "unit": unit, "value": found.sigma_1}
    if found.files < 2 or not found.stiffness_known:
        why = ONE_START if found.files < 2 else "sigma_0 is not determined"
        return table_row(**row, identified=False, reason=why)
    if np.isnan(found.tau_s) or not curve.known:
        return table_row(**row, identified=False, reason=CONSTANT if np.isnan(found.tau_s) else NO_CURVE)
    half = found.damping_half_width()
    low, high = max(found.sigma_1 - half, 0.0), found.sigma_1 + half
    row |= {"lo95": low, "hi95": high, "se": found.damping_se}
    if low > 0.0:
        return table_row(**row)
    reason = f"no damping of the bristles is seen: at most {high:.2g} {unit}"
    return table_row(**row, identified=False, reason=reason)


# Columns of table `traces` that are read.
OF_TRACES = ["file", "stroke", "time_s", "displacement_mm", "force_N", "steady"]


def fit_dynamic(
    traces: pd.DataFrame | Sequence[StoredTraces],
    steady: pd.DataFrame,
    steady_fit: SteadyFit,
    config: Config,
    *,
    workers: int = 1,
) -> dict[str, pd.DataFrame]:
    """Fit sigma_0 and sigma_1 of Eqs. 1 to 7 to the pre-sliding part of every condition's strokes.

    Parameters
    ----------
    traces : DataFrame or sequence of StoredTraces
        Table `traces`, or its stored partitions, which are read one at a time.
    steady : DataFrame
        Table `steady` or `steady_after`; rows with `used` false are left out.
    steady_fit : dict of DataFrame
        Its fits, with the Stribeck curve of each condition; a curve that is not identified is flat.
    config : Config
        Names the condition columns, the units and the sensor's accuracy.
    workers : int
        Number of processes.

    Returns
    -------
    dict of DataFrame
        Tables `dynamic_fit`, with the condition columns, and `dynamic_curves`, the mean starts, measured and
        fitted. In `dynamic_fit` `quantity` is "dynamic" (sigma_0, sigma_1), "break_away" (per commanded speed
        and direction: the force, and its ratio to the sliding force), "largest" (likewise: ratio of the
        largest force in the strokes to the sliding force) or "statistics".

    Notes
    -----
    The unit of evidence is the file for the length of the rise and the run for the level of the force; it is
    the stroke if there is only one file or run. Intervals of sigma_0 are symmetric in its logarithm. `u_sys`
    assumes one unknown error of |force| for all samples.
    """
    steady = steady[steady["used"].astype(bool) & steady["condition"].notna()].reset_index(drop=True)
    steady = steady.assign(size_N=steady["force_N"] * steady["direction"])
    asked = _asked(traces, steady, _curves(steady, steady_fit))
    found = run_map(partial(_fit_some, config=config), asked, workers=workers)
    rows, curves, broken, largest = (_together(tables) for tables in zip(*found, strict=True))
    tables = [rows]
    if len(largest):
        tables.append(largest_rows(largest, config))
    if len(broken):
        tables.append(break_away_rows(broken, _widened(steady_fit["steady_fit"]), config))
    keys = condition_keys(steady, config)
    table = pd.concat([part for part in tables if len(part)], ignore_index=True)
    table = table.merge(keys, on="condition", how="left", validate="many_to_one").assign(model="before")
    fixed = DYNAMIC_FIT.names()
    table = table.reindex(columns=[*fixed, *(name for name in keys.columns if name not in fixed)])
    curves = curves.reindex(columns=DYNAMIC_CURVES.names())
    return {"dynamic_fit": table.astype({"direction": "Int64"}), "dynamic_curves": curves}


# The traces of some conditions, their rows of `steady`, and their Stribeck curves.
Asked = tuple[pd.DataFrame | StoredTraces, pd.DataFrame, Mapping[str, StribeckCurve]]


def _asked(
    traces: pd.DataFrame | Sequence[StoredTraces], steady: pd.DataFrame, curves: Mapping[str, StribeckCurve]
) -> list[Asked]:
    """Return the conditions to fit, in partitions that are read together."""
    if isinstance(traces, pd.DataFrame):
        return [(traces, steady, curves)]
    piece = {condition: k for k, part in enumerate(traces) for condition in part.conditions}
    rows = dict(iter(steady.groupby(steady["condition"].map(piece))))
    return [
        (part, rows[k], {name: curves[name] for name in curves.keys() & part.conditions})
        for k, part in enumerate(traces)
        if k in rows
    ]


def _together(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return tables of conditions as one, in order of the conditions."""
    parts = [table for table in tables if len(table)]
    if not parts:
        return pd.DataFrame()
    return pd.concat(parts).sort_values("condition", kind="stable", ignore_index=True)


def _fit_some(asked: Asked, config: Config) -> list[pd.DataFrame]:
    """Return the rows of the fit, the mean starts, the break-aways and the largest forces of conditions."""
    traces, steady, curve_of = asked
    if not isinstance(traces, pd.DataFrame):
        traces = traces.read(OF_TRACES, coded=["file"])
    file = pd.factorize(steady["file"])[0]
    table = steady.assign(file_number=file).reset_index(drop=True)
    along = strokes_along(traces, table)
    if "effects_start_N" in table:  # the effects' force at the start is subtracted
        size = (table["effects_start_N"] * table["direction"]).tolist()
        along = [replace(stroke, force_N=stroke.force_N - size[stroke.row]) for stroke in along]
    starts = {start.row: start for start in starts_of(along)}
    wholes = {whole.row: whole for whole in whole_strokes(along)}
    begun = steady.iloc[list(starts)]
    table.loc[list(starts), "run_number"] = pd.factorize(nesting_run(begun, records(begun)))[0]
    tables = [[], [], [], []]
    for name, own in table.sort_values(AT, kind="stable").groupby("condition", sort=True):
        of_starts = own[own.index.isin(starts.keys())]
        start, curve = [starts[row] for row in of_starts.index], curve_of[name]
        braked = bool((of_starts["size_N"] > 0).all())  # as the model needs
        found = fit_stiffness(_evidence(start, of_starts, curve), curve) if braked else None
        seen = found is not None and found.seen
        models = dict(zip(of_starts.index, found.forces_N, strict=True)) if seen else {}
        rows = pd.DataFrame(bristle_rows(found, curve, config, braked=braked))
        tables[0].append(rows.assign(condition=name))
        for key, group in own.groupby(AT, dropna=False, sort=False):
            at = dict(zip(AT, key, strict=True))
            begun, ran = ([parts[row] for row in group.index if row in parts] for parts in (starts, wholes))
            if begun:
                fitted = [models[part.row] for part in begun] if seen else None
                tables[1].append(_mean_start(Cells(begun), fitted).assign(**at))
                tables[2].append(peaks(Cells(begun), file).assign(**at))
            if ran:
                tables[3].append(peaks(Cells(ran), file).assign(**at))
    return [_together(parts) for parts in tables]


def _mean_start(cells: Cells, models: Sequence[np.ndarray] | None) -> pd.DataFrame:
    """Return the mean start, measured and, if there is a fit, modelled, as rows of `dynamic_curves`."""
    force = pd.DataFrame(cells.force_N)
    found = pd.DataFrame({"distance_mm": cells.middle_mm, "force_N": force.mean(), "force_se_N": force.sem()})
    model = pd.DataFrame(cells.means(models)).mean() if models else np.nan
    return found.assign(n=force.count(), model_N=model)[force.notna().any()]


def _widened(steady_fit: pd.DataFrame) -> tuple[float, float]:
    """Return the reduced chi-square of all conditions' run means under the repeats' scatter, and its df."""
    rows = steady_fit[steady_fit["quantity"] == "statistics"]
    table = rows.pivot(index="condition", columns="parameter", values="value")
    table = table.reindex(columns=["chi2", "df"]).dropna()
    df = float(table["df"].sum())
    return (float(table["chi2"].sum()) / df, df) if df > 0 else (1.0, 1.0)


def _evidence(starts: Sequence[StrokePart], steady: pd.DataFrame, curve: StribeckCurve) -> list[RisingStroke]:
    """Return the starts of a condition with their units of evidence and their ratio to the curve.

    The ratio is that of the loads, or of the sliding forces if the curve is not determined. `steady` has the
    row of each start.
    """
    size = steady["load_N" if curve.known else "size_N"].to_numpy(float)
    known = size[~np.isnan(size)]
    ratio = size / (curve.coulomb_N if not curve.known else known.mean() if known.size else 1.0)
    ratio = np.where(np.isnan(ratio), 1.0, ratio).tolist()
    units = (_numbered(steady[name].to_numpy(int)).tolist() for name in ("file_number", "run_number"))
    return [
        RisingStroke(file, run, part, s.distance_mm, s.speed_mm_s, s.force_N)
        for file, run, part, s in zip(*units, ratio, starts, strict=True)
    ]


def _numbered(numbers: np.ndarray) -> np.ndarray:
    """Return the number of each stroke's file or run; that of the stroke if there is only one."""
    return numbers if (numbers != numbers[:1]).any() else np.arange(len(numbers))


def _curves(steady: pd.DataFrame, steady_fit: SteadyFit) -> dict[str, StribeckCurve]:
    """Return the Stribeck curve of each condition in `steady`, from its identified parameters."""
    fit, covariance = steady_fit["steady_fit"], steady_fit["steady_covariance"]
    known = fit[fit["identified"].to_numpy(bool)].groupby("condition")
    values = {name: dict(zip(own["parameter"], own["value"], strict=True)) for name, own in known}
    covariances = {
        name: own.set_index(["parameter", "other"])["value"].to_dict()
        for name, own in covariance.groupby("condition")
    }
    return {
        name: _curve(values.get(name, {}), covariances.get(name, {}), own)
        for name, own in steady.groupby("condition")
    }


def _curve(
    values: Mapping[str, float], covariances: Mapping[tuple[str, str], float], steady: pd.DataFrame
) -> StribeckCurve:
    """Return a condition's Stribeck curve under its mean load; flat at its median force if not identified."""
    load = steady["load_N"].mean(skipna=False)
    sigma_2 = max(float(values.get("sigma_2", 0.0)), 0.0)
    for static, coulomb, factor in (("mu_s", "mu_c", load), ("F_s", "F_c", 1.0)):
        known = [values.get(name) for name in (static, coulomb, "v_s")]
        if None not in known:
            unit = np.array([factor, factor, 1.0, 1.0])
            covariance = covariance_matrix(covariances, (static, coulomb, "v_s", "sigma_2"))
            covariance = covariance * np.outer(unit, unit)
            return StribeckCurve(*(unit * [*known, sigma_2]).tolist(), covariance, int(values.get("df", 1)))
    flat = float(np.median(steady["size_N"] - sigma_2 * steady["speed_mm_s"].abs()))
    return StribeckCurve(flat, flat, np.inf, sigma_2)
