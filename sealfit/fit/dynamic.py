"""The dynamic part of the model per condition: sigma_0 and sigma_1 from how the force comes up, and the break-away."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.engine import run_map
from sealfit.fit.breakaway import break_away_rows, largest_row, peaks
from sealfit.fit.rises import Curve, Stroke
from sealfit.fit.rows import nesting_run
from sealfit.fit.starts import Start, cell_means, starts_of, whole_strokes
from sealfit.fit.steady import condition_keys, parameter_units, table_row
from sealfit.fit.stiffness import Stiffness, fit_stiffness
from sealfit.samples import StoredTraces
from sealfit.tables import DYNAMIC_CURVES, DYNAMIC_FIT

OF_TRACES = ["file", "stroke", "time_s", "displacement_mm", "force_N", "steady"]  # columns that are read
NO_START = "no stroke begins at rest or at a reversal within its rows: the rise of the force is not in these traces"
TOO_FAST = "the force comes up within a few samples: sample faster, or start more slowly"
MISSED = "the force does not come up as the model's does: {share:.0%} of the sliding force is left"
NO_CURVE = "the Stribeck curve is not known: what it does along the ramp looks like damping"
ONE_START = "one start alone: no scatter is known; measure repeats"
WIDE = "the starts disagree: only that it lies between {low:.3g} and {high:.3g} {unit} is known"


@dataclass(frozen=True)
class Dynamic:
    """Tables `dynamic_fit`, with the condition columns, and `dynamic_curves`."""

    fit: pd.DataFrame
    curves: pd.DataFrame


def fit_dynamic(
    traces: pd.DataFrame | Sequence[StoredTraces],
    steady: pd.DataFrame,
    steady_fit: pd.DataFrame,
    config: Config,
    *,
    workers: int = 1,
) -> Dynamic:
    """Fit sigma_0 and sigma_1 of Eqs. 1 to 7 to the pre-sliding part of every condition's strokes.

    Parameters
    ----------
    traces : DataFrame or sequence of StoredTraces
        Table `traces`, or where it lies: then no more of it is read at once than some conditions have.
    steady : DataFrame
        Table `steady`; rows with `used` false are left out.
    steady_fit : DataFrame
        Table `steady_fit`: the Stribeck curve of each condition; flat where that is not identified.
    config : Config
        Names the condition columns, the units and the sensor's accuracy.
    workers : int
        Processes.

    Returns
    -------
    Dynamic
        In its fit `quantity` is "dynamic" (sigma_0, sigma_1), "break_away" (rows per commanded speed and direction: the
        force, and its share of the sliding force), "largest" (the same rows: the largest force anywhere in the strokes
        over the sliding force) or "statistics". Its curves are the mean starts and the model's.

    Notes
    -----
    Files are the units of evidence for the length of the rise, runs for the level of the force; strokes where there is
    one file or run alone. Intervals of sigma_0 are symmetric in its logarithm. `u_sys` takes the sensor's accuracy as
    one unknown error of the force's size, the same for all samples.
    """
    steady = steady[steady["used"].astype(bool) & steady["condition"].notna()].reset_index(drop=True)
    if isinstance(traces, pd.DataFrame):
        asked = [_Asked(traces, steady, steady_fit)]
    else:
        asked = [
            _Asked(part, *(table[table["condition"].isin(part.conditions)] for table in (steady, steady_fit)))
            for part in traces
        ]
    found = [one for made in run_map(partial(_fit_some, config=config), asked, workers=workers) for one in made]
    found.sort(key=lambda one: one.name)
    rows = [row for one in found for row in one.rows] + [row for one in found for row in one.largest]
    broken = [each for one in found for each in one.broken if len(each[1])]
    rows += break_away_rows(broken, _widened(steady_fit), config)
    curves = [curve for one in found for curve in one.curves]
    keys = condition_keys(steady, config)
    table = pd.DataFrame(rows).merge(keys, on="condition", how="left", validate="many_to_one")
    fixed = DYNAMIC_FIT.names()
    table = table.reindex(columns=[*fixed, *(name for name in keys.columns if name not in fixed)])
    curves = pd.concat(curves, ignore_index=True) if curves else pd.DataFrame()
    return Dynamic(table.astype({"direction": "Int64"}), curves.reindex(columns=DYNAMIC_CURVES.names()))


@dataclass(frozen=True)
class _Asked:
    """Some conditions: their traces, and their rows of `steady` and `steady_fit`."""

    traces: pd.DataFrame | StoredTraces
    steady: pd.DataFrame
    steady_fit: pd.DataFrame


@dataclass(frozen=True)
class _Found:
    """What one condition gives: rows of the fit, mean starts, break-aways per speed and direction, largest forces."""

    name: str
    rows: list[dict]
    curves: list[pd.DataFrame]
    broken: list[tuple]
    largest: list[dict]


def _fit_some(asked: _Asked, config: Config) -> list[_Found]:
    traces = asked.traces if isinstance(asked.traces, pd.DataFrame) else asked.traces.read(OF_TRACES)
    steady = asked.steady.reset_index(drop=True)
    starts = {start.row: start for start in starts_of(traces, steady)}
    strokes = {stroke.row: stroke for stroke in whole_strokes(traces, steady)}
    return [_fit_one(name, own, starts, strokes, asked, config) for name, own in steady.groupby("condition", sort=True)]


def _fit_one(
    name: str, own: pd.DataFrame, starts_at: Mapping, strokes: Mapping, asked: _Asked, config: Config
) -> _Found:
    curve = _curve(asked.steady_fit, name, own)
    largest = list(_largest(strokes, own, config))
    own = own[own.index.isin(list(starts_at))]
    starts = [starts_at[row] for row in own.index]
    found = fit_stiffness(_strokes(starts, own, curve), curve)
    models = found.forces_N if found is not None and found.seen else None
    curves, broken = [], []
    for (speed, direction), of in own.reset_index().groupby(["speed_set_mm_s", "direction"], dropna=False):
        at = {"condition": name, "speed_set_mm_s": speed, "direction": direction}
        places = of.index.to_numpy()
        alike = [starts[k] for k in places]
        distance, force = cell_means(alike, [s.force_N for s in alike])
        broken.append((at, peaks(alike, distance, force, of)))
        model = None if models is None else cell_means(alike, [models[k] for k in places])[1]
        curves.append(_mean_curve(distance, force, model).assign(**at))
    rows = [{"condition": name, **row} for row in _rows(found, curve, config)]
    return _Found(name, rows, curves, broken, largest)


def _largest(strokes: Mapping[int, Start], own: pd.DataFrame, config: Config) -> Iterator[dict]:
    """Yield a row for the largest force of a condition's strokes at each commanded speed and direction."""
    own = own[own.index.isin(list(strokes))]
    for at, of in own.groupby(["condition", "speed_set_mm_s", "direction"], dropna=False, sort=True):
        row = largest_row([strokes[k] for k in of.index], of, config)
        if row is not None:
            yield {**row, **dict(zip(("condition", "speed_set_mm_s", "direction"), at, strict=True))}


def _widened(steady_fit: pd.DataFrame) -> tuple[float, float]:
    """Return the reduced chi-square of run means under the repeats' scatter, all conditions pooled, and its df."""
    rows = steady_fit[steady_fit["quantity"] == "statistics"]
    table = rows[rows["parameter"].isin(["chi2", "df"])].pivot(index="condition", columns="parameter", values="value")
    table = table.reindex(columns=["chi2", "df"]).dropna()
    df = float(table["df"].sum())
    return (float(table["chi2"].sum()) / df, df) if df > 0 else (1.0, 1.0)


def _strokes(starts: Sequence[Start], own: pd.DataFrame, curve: Curve) -> list[Stroke]:
    """Return the starts of a condition with their units of evidence and their share of the curve.

    That is their load's; where the curve is flat, as the speeds do not tell it, that of their own sliding force.
    """
    size = own["load_N"] if curve.known else own["force_N"] * own["direction"]
    ratio = (size / (size.mean() if curve.known else curve.coulomb_N)).fillna(1.0).to_numpy(float)
    units = (_numbered(names) for names in (own["file"], nesting_run(own)))
    return [
        Stroke(file, run, part, s.distance_mm, s.speed_mm_s, s.force_N)
        for file, run, part, s in zip(*units, ratio, starts, strict=True)
    ]


def _numbered(names: pd.Series) -> np.ndarray:
    """Return the number of each stroke's file or run; the strokes' own where there is one alone."""
    return pd.factorize(names)[0] if names.nunique() > 1 else np.arange(len(names))


def _mean_curve(distance: np.ndarray, force: np.ndarray, model: np.ndarray | None) -> pd.DataFrame:
    """Return the mean start at one speed and direction, and the fitted model's, as table `dynamic_curves`."""
    cells = pd.DataFrame(force)
    table = {"distance_mm": distance, "force_N": cells.mean(), "force_se_N": cells.sem(), "n": cells.count()}
    table["model_N"] = np.nan if model is None else pd.DataFrame(model).mean()
    return pd.DataFrame(table).query("n > 0")


def _curve(steady_fit: pd.DataFrame, condition: str, own: pd.DataFrame) -> Curve:
    """Return a condition's Stribeck curve under its mean load; flat at its mean force where it is not identified."""
    load = own["load_N"].to_numpy(float).mean()
    fitted = steady_fit[steady_fit["condition"] == condition]
    rows = fitted[fitted["quantity"] == "steady"]
    known = rows[rows["identified"].astype(bool)].set_index("parameter")["value"]
    sigma_2 = max(float(known.get("sigma_2", 0.0)), 0.0)
    size = (own["force_N"] * own["direction"]).to_numpy(float)
    flat = float(np.median(size - sigma_2 * np.abs(own["speed_mm_s"].to_numpy(float))))
    for static, coulomb, factor in (("mu_s", "mu_c", load), ("F_s", "F_c", 1.0)):
        if {static, coulomb, "v_s"} <= set(known.index):
            own_unit = np.array([factor, factor, 1.0, 1.0])
            covariance, df = _uncertainty(fitted, (static, coulomb, "v_s", "sigma_2"))
            scaled = covariance * np.outer(own_unit, own_unit)
            return Curve(known[static] * factor, known[coulomb] * factor, known["v_s"], sigma_2, scaled, df)
    return Curve(flat, flat, np.inf, sigma_2)


def _uncertainty(fitted: pd.DataFrame, names: Sequence[str]) -> tuple[np.ndarray, int]:
    """Return the covariance of a steady fit's parameters, shape (p, p), zero where it is not known, and its df."""
    rows = fitted[fitted["quantity"] == "covariance"].set_index("parameter")["value"]
    covariance = np.zeros((len(names), len(names)))
    for i, one in enumerate(names):
        for j, other in enumerate(names):
            value = rows.get(f"{one},{other}", rows.get(f"{other},{one}", np.nan))
            covariance[i, j] = value if np.isfinite(value) else 0.0
    df = fitted.loc[(fitted["quantity"] == "statistics") & (fitted["parameter"] == "df"), "value"]
    return covariance, int(df.iloc[0]) if len(df) else 1


def _rows(found: Stiffness | None, curve: Curve, config: Config) -> Iterator[dict]:
    """Yield the rows of one condition: sigma_0, sigma_1 and what the fit rests on."""
    units = dynamic_units(config)
    if found is None or not found.seen:
        reason = NO_START if found is None else TOO_FAST
        for name in ("sigma_0", "sigma_1"):
            yield table_row(quantity="dynamic", parameter=name, unit=units[name], identified=False, reason=reason)
        return
    yield _stiffness_row(found, curve, units["sigma_0"], config)
    yield _damping_row(found, curve, units["sigma_1"])
    rise = curve.coulomb_N / found.sigma_0
    for name, value, unit in (
        ("rise", rise, config.units.unit("displacement")),
        ("samples_in_rise", found.within, ""),
        ("files", found.files, ""),
        ("rmse", found.rmse_N, config.units.unit("force")),
    ):
        yield table_row(quantity="statistics", parameter=name, value=value, unit=unit, identified=True)


def _stiffness_row(found: Stiffness, curve: Curve, unit: str, config: Config) -> dict:
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


def _damping_row(found: Stiffness, curve: Curve, unit: str) -> dict:
    row = {"quantity": "dynamic", "parameter": "sigma_1", "unit": unit, "value": found.sigma_1}
    if found.files < 2 or not found.stiffness_known:
        why = ONE_START if found.files < 2 else "sigma_0 is not determined"
        return table_row(**row, identified=False, reason=why)
    if not curve.known:
        return table_row(**row, identified=False, reason=NO_CURVE)
    half = found.damping_half_width()
    low, high = max(found.sigma_1 - half, 0.0), found.sigma_1 + half
    row |= {"lo95": low, "hi95": high, "se": found.damping_se}
    if low > 0.0:
        return table_row(**row, identified=True)
    return table_row(**row, identified=False, reason=f"no damping of the bristles is seen: at most {high:.2g} {unit}")


def dynamic_units(config: Config) -> Mapping[str, str]:
    """Return the units of sigma_0 and sigma_1 under the config's units."""
    units = config.units
    return {
        "sigma_0": f"{units.unit('force')}/{units.unit('displacement')}",
        "sigma_1": parameter_units(units, has_load=True)["sigma_2"],
    }
