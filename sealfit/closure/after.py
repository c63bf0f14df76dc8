"""The fits repeated with the effects removed at their reference state."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from sealfit.closure.errors_and_intervals import (
    covariance_with_specimens,
    degrees_of_freedom,
    t_quantile,
)
from sealfit.config import Config
from sealfit.fit.aging import CURVE_POINTS, LawRows, aging_curves, fit_series, law_fit
from sealfit.fit.aging.all_series import joint_laws
from sealfit.fit.aging.law import search_limits
from sealfit.fit.aging.law_table import (
    CurveInterval,
    Estimate,
    SeriesCurve,
    covariance_rows,
    law_rows,
    without_law,
)
from sealfit.fit.dynamic import fit_dynamic
from sealfit.fit.joint import Fitted
from sealfit.fit.joint.declared import series_of_curve
from sealfit.fit.joint.model import Model, Term, evaluate
from sealfit.fit.joint.rows import POWER, Lag, Rows
from sealfit.fit.steady import FORCES, SteadyFit, fit_conditions, parameter_units, table_row
from sealfit.fit.steady.uncertainty import SHIFT
from sealfit.ingest.stored_parts import StoredTraces
from sealfit.progress import timed
from sealfit.tables import AFTER, AGING_CURVES, SCHEMAS

# ---------------------------------------------------------------- reference
# The coefficients of the after-model are those at the reference: the contact cold, the offset removed, a
# column at its reference value. An effect of condition columns only (such as days) is not removed.

KEPT = "not removed: part of the aging condition"
SMALL = 1e-4  # Share of the effects' variance in principal directions that are dropped.


def is_kept(term: Term, config: Config) -> bool:
    """Return whether an effect is part of the conditions: it reads only their columns."""
    return set(term.channels) <= {*config.condition, *config.rubber}


def reference_of(term: Term, values: Mapping[str, float], config: Config) -> str:
    """Return a text that says where an effect is zero, or that it is not removed."""
    if is_kept(term, config):
        return KEPT
    labels = {name: config.units.label(name) for name in term.channels}
    known = {"x": labels[term.channels[0]], "z": labels[term.channels[-1]], **labels}
    numbers = {**term.fixed, **values}
    known |= {name: f"{value:.4g}" for name, value in numbers.items() if isinstance(value, int | float)}
    words = term.effect.reference or f"where {term.effect.form} = 0"
    return re.sub(r"\{(\w+)\}", lambda found: str(known.get(found[1], found[1])), words)


def at_reference(model: Model, config: Config) -> Model:
    """Return the model at the reference: only effects that are part of a condition are kept."""
    return _with_terms(model, [k for k, term in enumerate(model.terms) if is_kept(term, config)])


def _with_terms(model: Model, kept: Sequence[int]) -> Model:
    terms, values = (tuple(own[k] for k in kept) for own in (model.terms, model.values))
    return replace(model, terms=terms, values=values)


def without_effects(steady: pd.DataFrame, after: Fitted, config: Config) -> pd.DataFrame:
    """Return table `steady_after`: the strokes' mean forces with the effects removed at their reference.

    It is table `steady` with `force_N` less `effects_N`, the effects' mean over the steady window;
    `effects_start_N`, their force at the start of the stroke; and columns `effects_u1_N`, ...: the change of
    the force in the direction of motion for one standard error along each principal direction of the effects'
    covariance. A stroke without bins is not used.

    The effects' covariance is that of the joint fit to all bins, `after`. In a linear model, a fit to the
    corrected forces, with this covariance propagated through it, gives the estimate and the covariance of the
    joint fit (Frisch & Waugh 1933, Econometrica 1(4), 387-401, doi:10.2307/1907330).
    """
    model, rows = after.model, after.rows
    force, tangent = evaluate(model, rows)
    reference = at_reference(model, config)
    effects = force - evaluate(reference, rows, jacobian=False)[0]
    taken = [k for k, term in enumerate(model.terms) if not is_kept(term, config)]
    places = np.array([i for k in taken for i in range(*model.term_slice(k).indices(model.size))], int)
    last = tangent.values.shape[1] - model.size
    principal = _principal(tangent.values[:, last + places], after.covariance[np.ix_(places, places)], rows)
    columns = {"effects_N": effects, "effects_start_N": _at_start(model, reference, rows)}
    columns |= {f"{SHIFT}{k + 1}_N": principal[:, k] * np.sign(rows.speed) for k in range(principal.shape[1])}
    keys = [rows.table["file"], rows.table["stroke"]]
    weight = rows.table["n"].astype(float)
    sums = pd.DataFrame(columns).mul(weight, axis=0).groupby(keys).sum()
    means = sums.div(weight.groupby(keys).sum(), axis=0)
    found = means.reindex(pd.MultiIndex.from_frame(steady[["file", "stroke"]])).reset_index(drop=True)
    used = steady["used"].to_numpy(dtype=bool) & found["effects_N"].notna()
    table = steady.reset_index(drop=True).join(found.fillna(0.0))
    return table.assign(force_N=table["force_N"] - table["effects_N"], used=used)


def _principal(columns: np.ndarray, covariance: np.ndarray, rows: Rows) -> np.ndarray:
    """Return L with L L' = J C J' for derivatives J, shape (n, p), and a covariance C, shape (p, p).

    Directions whose mean over the strokes is small are dropped: they do not change a fit to the strokes.
    """
    if not columns.size:
        return columns
    size, axes = np.linalg.eigh(covariance)
    spread = columns @ (axes * np.sqrt(np.maximum(size, 0.0)))
    stroke = rows.codes("stroke")
    sums = np.column_stack([np.bincount(stroke, column) for column in spread.T])
    means = sums / np.bincount(stroke)[:, None]
    _, singular, turned = np.linalg.svd(means, full_matrices=False)
    share = np.cumsum(singular[::-1] ** 2)[::-1]
    kept = share > SMALL * share[0]
    return spread @ turned[kept].T


def _at_start(model: Model, reference: Model, rows: Rows) -> np.ndarray:
    """Return the effects' force at the start of each row's stroke, shape (n,): at distance and time 0."""
    table, direction = rows.table, np.sign(rows.speed)
    origin = table["displacement_mm"] - direction * table["distance_mm"].to_numpy(float)
    start = table.assign(displacement_mm=origin, distance_mm=0.0, time_s=0.0)
    begun = replace(rows, table=start, lag=Lag())
    return evaluate(model, begun, jacobian=False)[0] - evaluate(reference, begun, jacobian=False)[0]


# ---------------------------------------------------------------- after law

SLOW, FAST = 1e-6, 12.0  # Multiples of v_s at which the force is mu_s N, and mu_c N without the viscous term.
WIDEST = 700.0  # Largest logarithm.


def after_laws(
    after: Fitted, steady_fit: SteadyFit, config: Config
) -> tuple[dict[str, pd.DataFrame], pd.DataFrame]:
    """Return tables `aging_fit` and `aging_covariance`, and `aging_curves`; empty without aging.

    The laws are compared with the values of single conditions in `steady_fit`, the fits without the effects.
    mu_0, a and b are those of the joint fit. Effects that are part of the condition (such as days) change the
    law; the curves include them. Three speeds determine no mu_s and mu_c: the laws are then those of single
    conditions, as before the loop.
    """
    if "interpolated" in after.model.declared.stribeck.values():
        laws = fit_series(steady_fit, config)
        return laws, aging_curves(laws)
    fit, rows, curves = steady_fit["steady_fit"], [], []
    for law in _laws(after, config) if config.aging else ():
        rows.append((law.rubber, law.rows(fit)))
        if law.place is not None:
            curves.append(law.curve())
    drawn = pd.concat(curves, ignore_index=True) if curves else pd.DataFrame(columns=AGING_CURVES.names())
    return law_fit(rows, fit, config), drawn


def law_df(after: Fitted) -> float:
    """Return the degrees of freedom of the laws' intervals: specimens less the parameters of one coefficient.

    With few specimens their variance is often estimated as zero; the runs would give too many.
    """
    left = after.rows.groups.starts["specimen"].size - after.model.declared.mu_parameter_count
    return min(degrees_of_freedom(after), float(max(left, 1)))


def _laws(after: Fitted, config: Config) -> Iterator[_LawAfter]:
    """Yield every series and every quantity that the forces determine in some condition of the rubber."""
    conditions, index = after.rows.conditions, after.model.declared.index
    series = series_of_curve(conditions, aging=True)
    aged = conditions["aging_days"].to_numpy(float) > 0
    for name in sorted(set(series[aged])):
        own = np.flatnonzero((series == name) & aged)
        rubber = (conditions["rubber"] == conditions["rubber"].iloc[own[0]]).to_numpy()
        for end in "sc":
            if (index[f"mu_0{end}"][rubber] >= 0).any():
                yield _LawAfter(after, config, name, own, end)


class _LawAfter:
    """Eq. 15 of one quantity of one series in the after-model; `place` is None where it has none."""

    def __init__(self, after: Fitted, config: Config, series: str, conditions: np.ndarray, end: str) -> None:
        self.after, self.config, self.end = after, config, end
        self.conditions = conditions  # aged
        table, declared = after.rows.conditions, after.model.declared
        self.rubber = str(table["rubber"].iloc[conditions[0]])
        days = table["aging_days"].to_numpy(float)
        unaged = bool((days[(table["rubber"] == self.rubber).to_numpy()] == 0).any())
        quantity = f"mu_{end}" if after.rows.has_load else FORCES[f"mu_{end}"]
        unit = parameter_units(config.units, after.rows.has_load)["mu_s"]
        self.curve_of = SeriesCurve(series, quantity, 0, np.unique(days[conditions]), unaged, unit)
        number = [int(declared.index[name][conditions[0]]) for name in (f"mu_0{end}", f"a_{end}", f"b_{end}")]
        self.place = number if min(number) >= 0 else None
        self.df, self.covariance = law_df(after), covariance_with_specimens(after)

    def rows(self, steady_fit: pd.DataFrame) -> LawRows:
        """Return the rows of tables `aging_fit` and `aging_covariance`."""
        if self.place is None:
            return list(without_law(self.curve_of)), []
        after, at, config = self.after, self.place, self.config
        sensor = after.whitening((np.sign(after.rows.speed) * config.sensor.u)[:, None])[:, 0]
        shift = after.covariance[at] @ after.white_jacobian.against(sensor)
        found = Estimate(after.model.theta[at], self.covariance[np.ix_(at, at)], shift)
        changed = {"force", "mu", f"mu_{self.end}", "mu_0", "a", "b"}
        kept = [t for t in after.model.terms if is_kept(t, config) and t.acts_on in changed]
        effects = [f"The effect {t.effect.id} of {' and '.join(t.channels)} acts on top of it." for t in kept]
        words = "; ".join(effects)
        rows = list(law_rows(self.curve_of, found, self._interval(found), self.df))
        for row in rows:
            row["reason"] = " ".join(part for part in (row["reason"], words) if part)
        rows += self._statistics(steady_fit)
        return rows, list(covariance_rows(self.curve_of, found.covariance))

    def _interval(self, found: Estimate) -> CurveInterval:
        """Return the 95 % limits of a, b and c; b is open beyond the search range of laws."""
        t, error = t_quantile(self.df), np.sqrt(np.diag(found.covariance))
        low, high = (found.x[2] + s * t * error[2] for s in (-1, 1))
        first, last = search_limits(self.curve_of.days)
        least = float(np.exp(low)) if low > first else 0.0
        most = float(np.exp(min(high, WIDEST))) if high < last else np.inf
        c, half = -found.x[1] * found.x[2], t * found.error_of_c()
        a = found.x[1] - t * error[1], found.x[1] + t * error[1]
        return {"a": a, "b": (least, most), "c": (c - half, c + half)}

    def _statistics(self, steady_fit: pd.DataFrame) -> Iterator[dict]:
        """Yield the errors of the law at single conditions, and the statistics behind its intervals."""
        curve, steady = self.curve_of, steady_fit["quantity"] == "steady"
        own = steady_fit[steady & (steady_fit["parameter"] == curve.quantity)]
        own = own[own["identified"].astype(bool)].set_index("condition")["value"]
        names = self.after.rows.conditions["condition"].to_numpy()[self.conditions]
        days = self.after.rows.conditions["aging_days"].to_numpy(float)[self.conditions]
        measured = own.reindex(names).to_numpy(float)
        law = self._values(days)[0]
        gap = (law - measured)[np.isfinite(measured)]
        share = (law / measured - 1)[np.isfinite(measured)]
        variance = self.after.scatter.level_variance("specimen", self.after.loads)
        specimen = 100 * np.sqrt(variance.mean() / np.mean(self.after.friction**2))
        for name, value, unit in (
            ("specimen_sd_pct", specimen if self.after.scatter.estimates("specimen") else None, "%"),
            ("error_df", self.df, ""),
            ("max_error_pct", 100 * np.abs(share).max() if share.size else None, "%"),
            ("rmse", np.sqrt(np.mean(gap**2)) if gap.size else None, curve.unit),
            ("n_days", curve.days.size + curve.unaged, ""),
            ("last_day", curve.days[-1], "d"),
        ):
            named = {"quantity": "statistics", "parameter": f"{curve.quantity}:{name}"}
            yield {**table_row(**named, value=value, unit=unit, identified=True), "series": curve.series}

    def curve(self) -> pd.DataFrame:
        """Return the law along aging time with its 95 % band, including effects of the condition."""
        days = self.curve_of.days[-1] * np.linspace(0, 1, CURVE_POINTS) ** 2
        value, error = self._values(days)
        half = t_quantile(self.df) * error
        columns = {"aging_days": days, "value": value, "lo95": value - half, "hi95": value + half}
        named = {"series": self.curve_of.series, "quantity": self.curve_of.quantity}
        return pd.DataFrame({**named, **columns})[AGING_CURVES.names()]

    def _values(self, days: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the coefficient at days of aging, and its standard error, shape (n,) each."""
        after, config, rows = self.after, self.config, self.after.rows
        others = ("v_s", "sigma_2")  # effects on these change no coefficient
        terms = list(enumerate(after.model.terms))
        kept = [k for k, term in terms if is_kept(term, config) and term.acts_on not in others]
        model = _with_terms(after.model, kept)
        condition = int(self.conditions[0])
        index = {name: int(model.declared.index[name][condition]) for name in others}
        v_s = float(np.exp(model.theta[index["v_s"]])) if index["v_s"] >= 0 else 1.0
        theta = model.theta.copy()
        if index["sigma_2"] >= 0:
            theta[index["sigma_2"]] = 0.0
        load = float(rows.load.mean())
        first = rows.table[rows.condition == condition].iloc[[0]]
        speed = v_s * (SLOW if self.end == "s" else FAST)
        table = pd.concat([first] * days.size, ignore_index=True)
        table = table.assign(aging_days=days, speed_mm_s=speed, load_N=load)
        at = rows.points(table.drop(columns=[POWER], errors="ignore"), np.full(days.size, condition))
        force, tangent = evaluate(replace(model, theta=theta), replace(at, days=days))
        places = [np.arange(after.model.size)[after.model.term_slice(k)] for k in kept]
        slope = np.zeros((days.size, after.model.size))
        slope[:, np.concatenate([np.arange(theta.size), *places])] = tangent.toarray()
        slope[:, list(index.values())] = 0.0
        scale = load if rows.has_load else 1.0
        return force / scale, np.sqrt(np.einsum("ni,ij,nj->n", slope, self.covariance, slope)) / scale


# ---------------------------------------------------------------- after fits


def after_fits(
    after: Fitted,
    steady: pd.DataFrame,
    traces: pd.DataFrame | Sequence[StoredTraces],
    config: Config,
    *,
    left_out: bool = False,
    workers: int = 1,
) -> dict[str, pd.DataFrame]:
    """Return the tables `*_after` by name; they have no rows if no effect was added and no file left out.

    `after` is the after-model, fitted to all bins; `steady` and `traces` are these tables, or where `traces`
    is stored. The laws of single series are those of the joint fit; the other fits are to the strokes' forces
    without the effects.
    """
    if not after.model.terms and not left_out:
        return {schema.name: pd.DataFrame(columns=schema.names()) for schema in AFTER}
    free = without_effects(steady, after, config)
    with timed("after: conditions", rows=len(free), of="strokes"):
        conditions = fit_conditions(free, config)
    with timed("after: laws"):
        of_series, curves = after_laws(after, conditions, config)
        laws, master = joint_laws(free, conditions, config)
    with timed("after: starts", rows=len(free), of="strokes"):
        dynamic = fit_dynamic(traces, free, conditions, config, workers=workers)
    found = {"steady": free, **conditions, **of_series, **dynamic}
    found |= {"aging_curves": curves, "aging_laws": laws, "master_curve": master}
    return {
        f"{name}_after": table.assign(model="after") if "model" in SCHEMAS[name].names() else table
        for name, table in found.items()
    }
