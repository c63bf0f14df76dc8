"""Output of the loop: the fitted model as plain data, and the tables for the plots."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pandas as pd
from pandas.api.typing import SeriesGroupBy

from sealfit.closure.channels import Channel, scatter_level, settings, unit_of
from sealfit.closure.errors_and_intervals import (
    degrees_of_freedom,
    mean_half_width,
    mean_se,
    places_of_jumps,
    robust_covariance,
    sandwiches,
    t_quantile,
)
from sealfit.closure.forms import free_term
from sealfit.closure.result import parameter_unit
from sealfit.closure.selection import Selection
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.effects.contract import SECOND, Effect
from sealfit.effects.free import FREE, LEVELS, SLOPES, SMOOTH, SURFACE, WIDE, free_effect
from sealfit.errors import ParameterError
from sealfit.fit.joint import Fitted, fit
from sealfit.fit.joint.declared import QUANTITIES, Declared, JointParameter, tested_speeds
from sealfit.fit.joint.model import Model, Term, evaluate, term_derivatives
from sealfit.fit.joint.rows import Rows, open_columns
from sealfit.fit.joint.tangent import Tangent
from sealfit.store.paths import needed
from sealfit.tables import CHANNELS, CURVES, SHAPE_POINTS, SHAPES

# ---------------------------------------------------------------- model record


def to_record(before: Fitted, after: Fitted, config: Config, unconfirmed: Mapping[str, Model]) -> dict:
    """Return OUT/model.json: both fitted models with covariance, scatter and tested ranges.

    `unconfirmed` are models after the loop with one more effect, by its label.
    """
    rows, declared, scatter = after.rows, after.model.declared, after.scatter
    series = rows.conditions["series"].to_numpy(dtype=object)[rows.condition]
    speeds = {
        name: tested_speeds(rows, np.flatnonzero(series == name)).tolist() for name in pd.unique(series)
    }
    # The folder of user effects is an argument of a prediction.
    own_config = config.model_copy(update={"loop": config.loop.model_copy(update={"effects_folder": None})})
    return {
        "schema": 1,
        "config": own_config.model_dump(mode="json"),
        "conditions": rows.conditions.to_dict(orient="list"),
        "has_load": rows.has_load,
        "has_aging": rows.has_aging,
        "compliance": rows.lag.compliance,
        "declared": {
            "parameters": [[p.quantity, p.owner] for p in declared.parameters],
            "index": {q: declared.index[q].tolist() for q in QUANTITIES},
            "stribeck": dict(declared.stribeck),
            "law": {k: bool(v) for k, v in declared.law.items()},
        },
        "before": _model(before.model),
        "after": _model(after.model),
        "covariance": after.covariance.tolist(),
        "sandwiches": [
            {
                "covariance": own.covariance.tolist(),
                "information": [[numbers.tolist(), block.tolist()] for numbers, block in own.information],
            }
            for own in sandwiches(after)
        ],
        "unconfirmed": [{"label": label, **_model(model)} for label, model in unconfirmed.items()],
        "jumps": [
            {"effect": number, "parameter": name, "low": low, "high": high}
            for number, (term, values) in enumerate(zip(after.model.terms, after.model.values, strict=True))
            for name, (low, high) in places_of_jumps(term, values, rows).items()
        ],
        "df": degrees_of_freedom(after),
        "scatter": {
            "s0": float(scatter.s0),
            "g": float(scatter.g),
            "alike": float(scatter.design_effect),
            "shape": float(scatter.shape),
            "of_specimens": after.knows_specimens,
            "components": [
                {"level": c.level, "kind": c.kind, "variance": float(c.variance)} for c in scatter.components
            ],
        },
        "ranges": _ranges(rows),
        "speeds_mm_s": speeds,
    }


def _model(model: Model) -> dict:
    return {
        "theta": model.theta.tolist(),
        "terms": [
            {
                "id": term.effect.id,
                "channels": list(term.channels),
                "acts_on": term.acts_on,
                "operation": term.operation,
                "fixed": {k: ({} if k == "shift" else v) for k, v in term.fixed.items()},
                "values": {k: float(v) for k, v in values.items()},
                "smoothness": term.smoothness,
            }
            for term, values in zip(model.terms, model.values, strict=True)
        ],
    }


def _ranges(rows: Rows) -> dict:
    """Return the tested range of each numeric channel and the tested values of each category."""
    ranges: dict = {}
    for name in rows.channels:
        values = rows.unsigned(name)
        if values.dtype.kind == "f":
            known = values[np.isfinite(values)]
            if known.size:
                ranges[name] = [float(known.min()), float(known.max())]
        else:
            ranges[name] = sorted({str(v) for v in values})
    return ranges


def from_record(
    record: dict, own: Mapping[str, Effect] | None = None
) -> tuple[Model, Model, list[Model], pd.DataFrame]:
    """Return a record's models before, after, and with an unconfirmed effect, and the table of conditions.

    None of the record is executed. `own` are the user's own effects, by id. RequestError if the model has an
    effect that is not known; ParameterError if the values of an effect are not those that it has.
    """
    raw = record["declared"]
    parameters = tuple(JointParameter(*p) for p in raw["parameters"])
    index = {q: np.array(v, dtype=int) for q, v in raw["index"].items()}
    declared = Declared(parameters, index, raw["stribeck"], raw["law"], {})  # it is not fitted again
    effects = {**EFFECTS, **(own or {})}
    stages = [record["before"], record["after"], *record["unconfirmed"]]
    ids = {term["id"] for stage in stages for term in stage["terms"]}
    if unknown := sorted(ids - effects.keys() - FREE.keys()):
        raise needed("the model holds", unknown)
    models = []
    for stage in stages:
        model = Model(declared, np.array(stage["theta"], dtype=float))
        for raw_term in stage["terms"]:
            fixed = {k: tuple(v) if isinstance(v, list) else v for k, v in raw_term["fixed"].items()}
            effect = free_effect(raw_term["id"], fixed) if raw_term["id"] in FREE else effects[raw_term["id"]]
            own = (raw_term["acts_on"], raw_term["operation"], fixed, raw_term.get("smoothness"))
            channels, values = tuple(raw_term["channels"]), raw_term["values"]
            if len(channels) != len(effect.reads) or values.keys() != {p.name for p in effect.parameters}:
                raise ParameterError(f"effect {effect.id}: its channels or parameters are others.")
            model = model.with_term(Term(effect, channels, *own), values)
        models.append(model)
    before, after, *unconfirmed = models
    return before, after, unconfirmed, pd.DataFrame(record["conditions"])


# ---------------------------------------------------------------- plot tables

GROUPS = 12  # Groups of a numeric channel in the residual plot.
POINTS = 60  # Points of a plotted curve.
MOST_LOADS = 4  # Loads that have curves of their own.
ROUNDING = 1e-9  # Relative difference that rounding errors make.
PERIODS = 4  # Periods of a periodic effect that are drawn.


def channel_table(selection: Selection, before: Fitted, after: Fitted) -> pd.DataFrame:
    """Return the mean residual by channel, before and after, with 95 % intervals from whole units.

    In strokes both ways an added force and a change of friction differ in sign. Residuals count along the
    motion where the channel explains more of them so.
    """
    rows = before.rows
    runs, motion = rows.table["run_id"].to_numpy(), np.sign(rows.speed)
    records = []
    for name, known in selection.channels.items():
        values = rows.values(name) if name != "speed_mm_s" else np.abs(rows.speed)
        code, middle, labels = _grouped(values, numeric=known.numeric)
        units = rows.codes(scatter_level([known], rows))
        explained = [_between_groups(before.residual * sign, rows.weight, code) for sign in (1.0, motion)]
        along = name != "direction" and explained[1] > (1 + ROUNDING) * explained[0]
        sign = motion if along else np.ones(motion.size)
        for group in np.unique(code):
            inside = code == group
            record = {"channel": name, "x": middle[group], "label": labels[group], "n": int(inside.sum())}
            record["along_motion"] = bool(along)
            for stage, fitted in (("before", before), ("after", after)):
                weight, residual = rows.weight[inside], (fitted.residual * sign)[inside]
                record[f"{stage}_N"] = mean = weight @ residual / weight.sum()
                parts = weight * (residual - mean) / weight.sum()
                record[f"{stage}_half_N"] = _half_width(parts, units[inside])
                sums = pd.DataFrame({"weight": weight, "residual": weight * residual}).groupby(runs[inside])
                farthest = (sums["residual"].sum() / sums["weight"].sum()).abs().idxmax()
                record[f"{stage}_run"] = farthest
            records.append(record)
    return pd.DataFrame(records, columns=CHANNELS.names())


def _between_groups(values: np.ndarray, weight: np.ndarray, code: np.ndarray) -> float:
    """Return the weighted variance of the groups' means."""
    sums, total = np.bincount(code, weight * values), np.bincount(code, weight)
    kept = total > 0
    means = sums[kept] / total[kept]
    return float(np.average((means - np.average(means, weights=total[kept])) ** 2, weights=total[kept]))


def _half_width(parts: np.ndarray, units: np.ndarray) -> float:
    """Return half the width of the 95 % interval of a mean, from its parts by unit; nan for one unit."""
    sums = np.bincount(np.unique(units, return_inverse=True)[1], parts)
    if sums.size < 2:
        return np.nan
    return float(t_quantile(sums.size - 1) * np.sqrt(sums @ sums * sums.size / (sums.size - 1)))


def _grouped(values: np.ndarray, *, numeric: bool, groups: int = GROUPS) -> tuple[np.ndarray, list, list]:
    """Return the group of each value, and the middle and label of each group, None where it has none."""
    distinct, code = np.unique(values, return_inverse=True)
    if not numeric:
        return code, [None] * distinct.size, list(distinct)
    if distinct.size <= groups:
        return code, list(distinct), [None] * distinct.size
    edges = np.unique(np.quantile(values, np.linspace(0, 1, groups + 1)))
    code = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, edges.size - 2)
    middle = np.bincount(code, values) / np.maximum(np.bincount(code), 1)
    return code, list(middle), [None] * middle.size


def shape_table(after: Fitted, config: Config) -> pd.DataFrame:
    """Return each effect's shape along its channel with a 95 % band, and the corresponding free shape.

    A surface is drawn along each of its channels, with the other one at its mean.
    """
    shapes = []
    reach = t_quantile(degrees_of_freedom(after))
    for number, first in _drawn(after.model):
        term, values = after.model.terms[number], after.model.values[number]
        place = after.model.term_slice(number)
        covariance = robust_covariance(after, "file") if "held" in term.fixed else after.covariance
        inputs, x, labels = _along(term, values, after.rows, first)
        value = np.asarray(term.effect.shape(inputs, **values), dtype=float)
        derivatives = term_derivatives(term, values, inputs)
        tangent = np.column_stack([np.broadcast_to(d, value.shape) for d in derivatives])
        se = mean_se(Tangent.dense(tangent), covariance[place, place])
        free = _free_shape(after, number, x)
        unit = parameter_unit("{y}", term, config.units)
        drawn = {"effect": number, "id": term.effect.id, "channel": first, "x": x}
        drawn |= {
            "category": _category_drawn(term, values),
            "label": labels,
            "value": value,
            "lo95": value - reach * se,
            "hi95": value + reach * se,
        }
        shapes.append(pd.DataFrame({**drawn, "free": np.nan if free is None else free, "unit": unit}))
    return pd.concat(shapes, ignore_index=True) if shapes else pd.DataFrame(columns=SHAPES.names())


def _category_drawn(term: Term, values: Mapping[str, float]) -> str | None:
    """Return the category in which an effect is drawn: its own, or that of the largest slope; else None."""
    if term.effect.id == SLOPES:
        sizes = [abs(values[p.name]) for p in term.effect.parameters]
        return str(term.fixed["categories"][int(np.argmax(sizes))])
    return term.fixed.get("category")


def _drawn(model: Model) -> Iterator[tuple[int, str]]:
    """Yield the numbers of the effects and the channels along which they are drawn."""
    for number, term in enumerate(model.terms):
        for channel in term.channels if term.effect.id == SURFACE else term.channels[:1]:
            yield number, channel


def shape_points(after: Fitted, shapes: pd.DataFrame) -> pd.DataFrame:
    """Return the partial residuals of each effect: its shape, of table `shapes`, plus the mean residual.

    The residual is divided by the force's derivative with respect to the shape, by weighted least squares in
    groups of the first channel's values (Larsen and McCleary 1972, Technometrics 14(3), 781-790). Standard
    errors are from whole files, or from the strokes of a single one. Of a periodic effect all periods are
    shifted onto those that are drawn.
    """
    rows, parts = after.rows, []
    units = rows.codes("file" if rows.groups.starts["file"].size > 1 else "stroke")
    for number, first in _drawn(after.model):
        term = after.model.terms[number]
        own = shapes[(shapes["effect"] == number) & (shapes["channel"] == first)]
        values = term.inputs(rows)[term.effect.reads[term.channels.index(first)]]
        numeric = bool(own["label"].isna().all())
        known = np.isfinite(values) if numeric else np.full(values.size, True)
        category = _category_drawn(term, after.model.values[number])
        if category is not None:
            known &= rows.values(term.channels[-1]) == category
        if numeric:
            low, high = own["x"].min(), own["x"].max()
            values = np.where(values > high, low + (values - low) % ((high - low) or 1.0), values)
        groups = PERIODS * GROUPS if term.effect.periodic else GROUPS
        code, x, labels = _grouped(values[known], numeric=numeric, groups=groups)
        slope, residual = after.slope(*term.target)[known], after.residual[known]
        weighted, unit = rows.weight[known] * slope, units[known]
        size = np.bincount(code, weighted * slope)
        size[size <= 0] = np.nan
        change = np.bincount(code, weighted * residual) / size
        left = np.zeros((size.size, unit.max() + 1))
        np.add.at(left, (code, unit), weighted * (residual - slope * change[code]))
        if numeric:
            shape = np.interp(x, own["x"], own["value"])
        else:
            shape = own.set_index("label").loc[labels, "value"].to_numpy()
        part = 1 + shape if term.operation == "multiply" else 1.0  # which the slope has in it
        se = np.abs(part) * np.sqrt((left**2).sum(axis=1)) / size
        found = {"effect": number, "channel": first, "x": x, "label": labels}
        found |= {"value": shape + part * change, "se": se, "unit": own["unit"].iloc[0]}
        parts.append(pd.DataFrame(found))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=SHAPE_POINTS.names())


def _along(
    term: Term, parameters: Mapping[str, float], rows: Rows, first: str
) -> tuple[dict, np.ndarray, list | None]:
    """Return inputs along one of a term's channels, others at their means, and its values or categories."""
    values = rows.unsigned(first)
    if values.dtype.kind != "f":
        labels = [str(c) for c in np.unique(values)]
        return {term.effect.reads[0]: np.array(labels), **term.fixed}, np.full(len(labels), np.nan), labels
    low, high = float(values.min()), float(values.max())
    if "lambda_" in parameters:
        high = min(high, low + PERIODS * parameters["lambda_"])
    x = np.unique(values)
    if x.size > 12:
        spaced = np.geomspace if first == "speed_mm_s" and low > 0 and high >= WIDE * low else np.linspace
        x = spaced(low, high, 4 * POINTS if high < values.max() else POINTS)
    inputs = {}
    for name, channel in zip(term.effect.reads, term.channels, strict=True):
        others = rows.values(channel)
        if channel == first:
            inputs[name] = x
        elif others.dtype.kind != "f":
            inputs[name] = np.full(x.size, _category_drawn(term, parameters) or str(np.unique(others)[0]))
        else:
            far = name == SECOND and term.effect.id != SURFACE
            inputs[name] = np.full(x.size, np.quantile(others, 0.9) if far else np.abs(others).mean())
    fixed = {key: value for key, value in term.fixed.items() if key != "shift"}
    return {**inputs, **fixed}, x, None


def _free_shape(after: Fitted, number: int, x: np.ndarray) -> np.ndarray | None:
    """Return the free shape fitted instead of an effect, with its mean; None for periodic ones and levels.

    It is None beside another free shape of the same channel and quantity too: only their sum is identifiable.
    """
    term, rows, name = after.model.terms[number], after.rows, after.model.terms[number].channels[0]
    free_shapes = [(t.channels, t.target) for t in after.model.terms if t.effect.id == SMOOTH]
    shown = term.effect.periodic or term.effect.id in (SMOOTH, LEVELS) or np.isnan(x).any()
    beside = (term.channels, term.target) in free_shapes
    if shown or beside or len(term.channels) != 1 or name == "direction":
        return None
    values = np.abs(rows.speed) if name == "speed_mm_s" else rows.values(name)
    free = free_term(Channel(name, values, unit_of(values, rows)), *term.target)
    model = after.model.without_term(number).with_term(free, {p.name: 0.0 for p in free.effect.parameters})
    fitted = fit(model, rows, after.scatter, turns=0)
    shape = free.effect.shape({free.effect.reads[0]: x, **free.fixed}, **fitted.model.values[-1])
    own = term.effect.shape({term.effect.reads[0]: x, **term.fixed}, **after.model.values[number])
    return shape + float(np.mean(own - shape))


def curve_table(before: Fitted, after: Fitted) -> pd.DataFrame:
    """Return force against speed per condition, before and after, other channels at their means.

    Each of a few loads has curves of its own.
    """
    rows = after.rows
    channels = {name for term in (*before.model.terms, *after.model.terms) for name in term.channels}
    read = [name for name in rows.table.columns if name in {*CURVES.names(), *channels}]
    own = {name: rows.values(name) for name in open_columns(rows.table)}
    moving = rows.speed != 0
    loads = settings(rows.load)
    loads = loads if np.unique(loads).size <= MOST_LOADS else np.zeros_like(loads)
    # Arrays, as a channel may have any name; forward strokes first.
    keys = [rows.condition[moving], -np.sign(rows.speed[moving]), loads[moving]]
    groups = pd.DataFrame({**rows.table, **own})[moving].groupby(keys)
    points = pd.DataFrame({name: _averaged(groups[name]) for name in read})
    low, high = pd.Series(np.abs(rows.speed[moving])).groupby(keys).agg(["min", "max"]).to_numpy().T
    counts = np.where(high > 1.02 * low, POINTS, 1)
    along = np.concatenate([np.geomspace(*own) for own in zip(low, high, counts, strict=True)])
    points = points.iloc[np.repeat(np.arange(len(points)), counts)]
    condition, backward = (points.index.get_level_values(level).to_numpy() for level in (0, 1))
    points = points.assign(direction=-backward, speed_mm_s=-backward * along, file="")
    at = rows.points(points, condition)
    before_N, _ = evaluate(before.model, at, jacobian=False)
    at = replace(at, force=before_N)
    mean, tangent = evaluate(after.model, at)
    reach = mean_half_width(tangent, after.covariance, degrees_of_freedom(after), sandwiches(after))
    forces = {"force_before_N": before_N, "force_after_N": mean}
    ends = {"force_after_lo95_N": mean - reach, "force_after_hi95_N": mean + reach}
    return at.table.assign(**forces, **ends)[CURVES.names()]


def _averaged(groups: SeriesGroupBy) -> pd.Series:
    """Return the mean of a numeric channel, or the most frequent category, in each group of rows."""
    if pd.api.types.is_float_dtype(groups.obj) or groups.obj.name in ("repeat", "stroke"):
        return groups.agg(lambda own: own.mean())
    return groups.agg(lambda own: own.mode().iloc[0])
