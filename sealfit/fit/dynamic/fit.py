"""The model's dynamic part per condition: sigma_0 and sigma_1 from pre-sliding, and the break-away force."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.engine.run_map import run_map
from sealfit.fit.dynamic.breakaway import break_away_rows, largest_rows, peaks
from sealfit.fit.dynamic.bristle_model import Cells, Curve, Stroke, mean_over
from sealfit.fit.dynamic.starts import Along, Part, Start, starts_of, strokes_along, whole_strokes
from sealfit.fit.dynamic.stiffness import Stiffness, fit_stiffness
from sealfit.fit.joint.rows import nesting_run
from sealfit.fit.steady.fit import condition_keys, parameter_units, table_row
from sealfit.ingest.stored_parts import StoredTraces
from sealfit.tables import DYNAMIC_CURVES, DYNAMIC_FIT

# ---------------------------------------------------------------- bristle rows
# Rows of table `dynamic_fit` for sigma_0 and sigma_1, with the reason if one of them is not determined.

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
ONE_START = "one start alone: no scatter is known; measure repeats"
WIDE = "the starts disagree: only that it lies between {low:.3g} and {high:.3g} {unit} is known"


def bristle_rows(
    found: Stiffness | None, curve: Curve, config: Config, *, braked: bool = True
) -> Iterator[dict]:
    """Yield rows of table `dynamic_fit` for one condition: sigma_0, sigma_1 and statistics of the fit.

    Parameters
    ----------
    found : Stiffness or None
        Estimates; None if no stroke has a recorded start.
    curve : Curve
        Stribeck curve of the fit.
    config : Config
        Gives the units and the sensor's accuracy.
    braked : bool
        Whether the sliding force of every stroke opposes its motion.
    """
    units = dynamic_units(config)
    if found is None or not found.seen:
        reason = TOO_FAST if found is not None else NO_START if braked else ALONG
        for name in ("sigma_0", "sigma_1"):
            yield table_row(
                quantity="dynamic", parameter=name, unit=units[name], identified=False, reason=reason
            )
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
    return table_row(
        **row, identified=False, reason=f"no damping of the bristles is seen: at most {high:.2g} {unit}"
    )


def dynamic_units(config: Config) -> Mapping[str, str]:
    """Return the units of sigma_0 and sigma_1 under the config's units."""
    units = config.units
    return {
        "sigma_0": f"{units.unit('force')}/{units.unit('displacement')}",
        "sigma_1": parameter_units(units, has_load=True)["sigma_2"],
    }


# ---------------------------------------------------------------- dynamic
# The fit of all conditions.

# Columns of table `traces` that are read.
OF_TRACES = ["file", "stroke", "time_s", "displacement_mm", "force_N", "steady"]

# Columns of a table, all of one length.
Columns = dict[str, np.ndarray]


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
        Table `traces`, or its stored partitions, which are read one at a time.
    steady : DataFrame
        Table `steady` or `steady_after`; rows with `used` false are left out.
    steady_fit : DataFrame
        Its table `steady_fit` with the Stribeck curve of each condition; a curve that is not identified is
        flat.
    config : Config
        Names the condition columns, the units and the sensor's accuracy.
    workers : int
        Number of processes.

    Returns
    -------
    Dynamic
        In its fit `quantity` is "dynamic" (sigma_0, sigma_1), "break_away" (per commanded speed and
        direction: the force, and its ratio to the sliding force), "largest" (likewise: ratio of the largest
        force in the strokes to the sliding force) or "statistics". Its curves are the mean starts, measured
        and fitted.

    Notes
    -----
    The unit of evidence is the file for the length of the rise and the run for the level of the force; it is
    the stroke if there is only one file or run. Intervals of sigma_0 are symmetric in its logarithm. `u_sys`
    assumes one unknown error of |force| for all samples.
    """
    steady = steady[steady["used"].astype(bool) & steady["condition"].notna()].reset_index(drop=True)
    asked = _asked(traces, steady, steady_fit)
    found = [
        one for made in run_map(partial(_fit_some, config=config), asked, workers=workers) for one in made
    ]
    found.sort(key=lambda one: one.name)
    curves, broken, largest = (_stacked(found, name) for name in ("curves", "broken", "largest"))
    rows = [
        pd.DataFrame([row for one in found for row in one.rows]),
        largest_rows(largest, config) if len(largest) else largest,
        break_away_rows(broken, _widened(steady_fit), config) if len(broken) else broken,
    ]
    keys = condition_keys(steady, config)
    table = pd.concat([part for part in rows if len(part)], ignore_index=True)
    table = table.merge(keys, on="condition", how="left", validate="many_to_one").assign(model="before")
    fixed = DYNAMIC_FIT.names()
    table = table.reindex(columns=[*fixed, *(name for name in keys.columns if name not in fixed)])
    return Dynamic(table.astype({"direction": "Int64"}), curves.reindex(columns=DYNAMIC_CURVES.names()))


@dataclass(frozen=True)
class _Asked:
    """Some conditions: their traces, and their rows of `steady` and `steady_fit`."""

    traces: pd.DataFrame | StoredTraces
    steady: pd.DataFrame
    steady_fit: pd.DataFrame


@dataclass(frozen=True)
class _Found:
    """Results of one condition: rows of the fit; columns of mean starts, break-aways and largest forces."""

    name: str
    rows: list[dict]
    curves: Columns
    broken: Columns
    largest: Columns


def _asked(
    traces: pd.DataFrame | Sequence[StoredTraces], steady: pd.DataFrame, steady_fit: pd.DataFrame
) -> list[_Asked]:
    """Return the conditions to fit, in partitions that are read together."""
    if isinstance(traces, pd.DataFrame):
        return [_Asked(traces, steady, steady_fit)]
    piece = {condition: k for k, part in enumerate(traces) for condition in part.conditions}
    rows = [dict(iter(table.groupby(table["condition"].map(piece)))) for table in (steady, steady_fit)]
    return [
        _Asked(part, rows[0][k], rows[1].get(k, steady_fit.iloc[:0]))
        for k, part in enumerate(traces)
        if k in rows[0]
    ]


def _stacked(found: Sequence[_Found], name: str) -> pd.DataFrame:
    """Return the columns in one attribute of all conditions as one table, with the condition."""
    parts = [(one.name, getattr(one, name)) for one in found if getattr(one, name)]
    if not parts:
        return pd.DataFrame()
    table = {key: np.concatenate([columns[key] for _, columns in parts]) for key in parts[0][1]}
    sizes = [len(columns["direction"]) for _, columns in parts]
    return pd.DataFrame({"condition": np.repeat([one for one, _ in parts], sizes), **table})


class _Strokes:
    """Table `steady` as arrays of shape (strokes,), and the groups of one condition, speed and direction."""

    def __init__(self, steady: pd.DataFrame) -> None:
        self.load_N, self.speed_mm_s, force = (
            steady[name].to_numpy(float) for name in ("load_N", "speed_mm_s", "force_N")
        )
        self.direction, self.speed_set_mm_s = (
            steady[name].to_numpy() for name in ("direction", "speed_set_mm_s")
        )
        self.size_N = force * self.direction
        self.file = pd.factorize(steady["file"])[0]
        self.group = (
            steady.groupby(["condition", "speed_set_mm_s", "direction"], dropna=False).ngroup().to_numpy()
        )
        self.conditions = steady.groupby("condition", sort=True).indices


def _fit_some(asked: _Asked, config: Config) -> list[_Found]:
    traces = (
        asked.traces
        if isinstance(asked.traces, pd.DataFrame)
        else asked.traces.read(OF_TRACES, coded=["file"])
    )
    table = asked.steady.reset_index(drop=True)
    along = _less_effects(strokes_along(traces, table), table)
    starts = {start.row: start for start in starts_of(along)}
    wholes = {whole.row: whole for whole in whole_strokes(along)}
    strokes, fitted = _Strokes(table), _fitted(asked.steady_fit)
    run = np.full(len(table), -1)
    run[list(starts)] = pd.factorize(nesting_run(table.iloc[list(starts)]))[0]
    made = []
    for name, rows in strokes.conditions.items():
        rows = rows[np.argsort(strokes.group[rows], kind="stable")]
        own, whole = ([parts[row] for row in rows.tolist() if row in parts] for parts in (starts, wholes))
        curve = _curve(fitted.get(name, {}), strokes, rows)
        braked = _against_motion(own, strokes)
        found = fit_stiffness(_evidence(own, strokes, run, curve), curve) if braked else None
        models = found.forces_N if found is not None and found.seen else None
        fit = [{"condition": name, **row} for row in bristle_rows(found, curve, config, braked=braked)]
        begun = _Grouped(own, strokes) if own else None
        made.append(
            _Found(
                name,
                rows=fit,
                curves=begun.curves(models) if begun else {},
                broken=begun.peaks() if begun else {},
                largest=_Grouped(whole, strokes).peaks() if whole else {},
            )
        )
    return made


def _less_effects(strokes: Sequence[Along], steady: pd.DataFrame) -> Sequence[Along]:
    """Return strokes minus the effects' force at their start, if table `steady` has it."""
    if "effects_start_N" not in steady:
        return strokes
    size = (steady["effects_start_N"] * steady["direction"]).tolist()
    return [replace(stroke, force_N=stroke.force_N - size[stroke.row]) for stroke in strokes]


class _Grouped:
    """Parts of strokes of one condition, in groups of one commanded speed and direction."""

    def __init__(self, parts: Sequence[Part], strokes: _Strokes) -> None:
        rows = np.array([part.row for part in parts])
        group = np.unique(strokes.group[rows], return_inverse=True)[1]
        self.cells, self.file = Cells(parts, group), strokes.file[rows]
        first = rows[self.cells.groups.start]
        self.at = {"speed_set_mm_s": strokes.speed_set_mm_s[first], "direction": strokes.direction[first]}

    def peaks(self) -> Columns:
        """Return the columns of `peaks`, with speed and direction."""
        found = peaks(self.cells, self.file)
        group = found.pop("group")
        return {**{name: values[group] for name, values in self.at.items()}, **found}

    def curves(self, models: Sequence[np.ndarray] | None) -> Columns:
        """Return the mean starts, measured and, if there is a fit, modelled, as table `dynamic_curves`."""
        force, error, n = mean_over(self.cells, self.cells.force_N)
        model = (
            np.full(n.shape, np.nan) if models is None else mean_over(self.cells, self.cells.means(models))[0]
        )
        group, cell = np.nonzero(n > 0)
        table = {
            "distance_mm": self.cells.middle_mm,
            "force_N": force,
            "force_se_N": error,
            "n": n,
            "model_N": model,
        }
        columns = {name: values[group, cell] for name, values in table.items()}
        return {**{name: values[group] for name, values in self.at.items()}, **columns}


def _widened(steady_fit: pd.DataFrame) -> tuple[float, float]:
    """Return the reduced chi-square of all conditions' run means under the repeats' scatter, and its df."""
    rows = steady_fit[steady_fit["quantity"] == "statistics"]
    table = rows[rows["parameter"].isin(["chi2", "df"])].pivot(
        index="condition", columns="parameter", values="value"
    )
    table = table.reindex(columns=["chi2", "df"]).dropna()
    df = float(table["df"].sum())
    return (float(table["chi2"].sum()) / df, df) if df > 0 else (1.0, 1.0)


def _against_motion(starts: Sequence[Start], strokes: _Strokes) -> bool:
    """Return whether the sliding force of every start opposes the motion, as the model needs.

    An offset between the directions or a wrong sign can reverse it.
    """
    return all(strokes.size_N[start.row] > 0 for start in starts)


def _evidence(starts: Sequence[Start], strokes: _Strokes, run: np.ndarray, curve: Curve) -> list[Stroke]:
    """Return the starts of a condition with their units of evidence and their ratio to the curve.

    The ratio is that of the loads, or of the sliding forces if the curve is not determined.
    """
    rows = np.array([start.row for start in starts], int)
    size = (strokes.load_N if curve.known else strokes.size_N)[rows]
    known = size[~np.isnan(size)]
    ratio = size / (curve.coulomb_N if not curve.known else known.mean() if known.size else 1.0)
    units = (_numbered(numbers[rows]).tolist() for numbers in (strokes.file, run))
    return [
        Stroke(file, run, part, s.distance_mm, s.speed_mm_s, s.force_N)
        for file, run, part, s in zip(
            *units, np.where(np.isnan(ratio), 1.0, ratio).tolist(), starts, strict=True
        )
    ]


def _numbered(numbers: np.ndarray) -> np.ndarray:
    """Return the number of each stroke's file or run; that of the stroke if there is only one."""
    return numbers if (numbers != numbers[:1]).any() else np.arange(len(numbers))


def _fitted(steady_fit: pd.DataFrame) -> dict[str, dict[tuple[str, str], float]]:
    """Return the values of table `steady_fit` by condition, quantity and parameter; only identified ones."""
    made: dict[str, dict[tuple[str, str], float]] = {}
    names = ("condition", "quantity", "parameter", "value", "identified")
    for condition, quantity, parameter, value, identified in zip(
        *(steady_fit[name].tolist() for name in names), strict=True
    ):
        if identified or quantity != "steady":
            made.setdefault(condition, {}).setdefault((quantity, parameter), value)
    return made


def _curve(fitted: Mapping[tuple[str, str], float], strokes: _Strokes, rows: np.ndarray) -> Curve:
    """Return a condition's Stribeck curve under its mean load; flat at its median force if not identified."""
    load = strokes.load_N[rows].mean()
    sigma_2 = max(float(fitted.get(("steady", "sigma_2"), 0.0)), 0.0)
    flat = float(np.median(strokes.size_N[rows] - sigma_2 * np.abs(strokes.speed_mm_s[rows])))
    for static, coulomb, factor in (("mu_s", "mu_c", load), ("F_s", "F_c", 1.0)):
        known = [fitted.get(("steady", name)) for name in (static, coulomb, "v_s")]
        if None not in known:
            own_unit = np.array([factor, factor, 1.0, 1.0])
            covariance = _covariance(fitted, (static, coulomb, "v_s", "sigma_2")) * np.outer(
                own_unit, own_unit
            )
            df = int(fitted.get(("statistics", "df"), 1))
            return Curve(known[0] * factor, known[1] * factor, known[2], sigma_2, covariance, df)
    return Curve(flat, flat, np.inf, sigma_2)


def _covariance(fitted: Mapping[tuple[str, str], float], names: Sequence[str]) -> np.ndarray:
    """Return the covariance of a steady fit's parameters, shape (p, p), 0 if unknown."""
    covariance = np.zeros((len(names), len(names)))
    for i, one in enumerate(names):
        for j, other in enumerate(names):
            pairs = (("covariance", f"{one},{other}"), ("covariance", f"{other},{one}"))
            value = next((fitted[pair] for pair in pairs if pair in fitted), np.nan)
            covariance[i, j] = value if np.isfinite(value) else 0.0
    return covariance
