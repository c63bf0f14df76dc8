"""The fitted model as plain data: what `predict` needs, written to OUT/model.json."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from sealfit.closure.intervals import degrees_of_freedom, sandwiches
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.effects.contract import Effect
from sealfit.effects.free import FREE, free_effect
from sealfit.fit.declared import QUANTITIES, Declared, JointParameter, tested_speeds
from sealfit.fit.estimate import Fitted
from sealfit.fit.joint import Model
from sealfit.fit.rows import Rows
from sealfit.fit.terms import Term
from sealfit.own_effects import needed


def to_record(before: Fitted, after: Fitted, config: Config) -> dict:
    """Return both fitted models with covariance, scatter and tested ranges as JSON-able values."""
    rows = after.rows
    return {
        "schema": 1,
        "config": _without_effects(config).model_dump(mode="json"),
        "conditions": rows.conditions.to_dict(orient="list"),
        "has_load": rows.has_load,
        "has_aging": rows.has_aging,
        "declared": {
            "parameters": [[p.quantity, p.owner] for p in after.model.declared.parameters],
            "index": {q: after.model.declared.index[q].tolist() for q in QUANTITIES},
            "stribeck": dict(after.model.declared.stribeck),
            "law": {k: bool(v) for k, v in after.model.declared.law.items()},
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
        "df": degrees_of_freedom(after),
        "scatter": {
            "s0": float(after.scatter.s0),
            "g": float(after.scatter.g),
            "alike": float(after.scatter.alike),
            "shape": float(after.scatter.shape),
            "components": [
                {"level": c.level, "kind": c.kind, "variance": float(c.variance)} for c in after.scatter.components
            ],
        },
        "ranges": _ranges(rows),
        "speeds_mm_s": _speeds(rows),
    }


def _without_effects(config: Config) -> Config:
    """Return the config without the folder of the user's own effects: whoever predicts names theirs."""
    return config.model_copy(update={"loop": config.loop.model_copy(update={"effects_folder": None})})


def _model(model: Model) -> dict:
    return {
        "theta": model.theta.tolist(),
        "terms": [
            {
                "id": term.effect.id,
                "channels": list(term.channels),
                "acts_on": term.acts_on,
                "operation": term.operation,
                "fixed": {k: ({} if k == "shift" else _plain(v)) for k, v in term.fixed.items()},
                "values": {k: float(v) for k, v in values.items()},
                "smoothness": term.smoothness,
            }
            for term, values in zip(model.terms, model.values, strict=True)
        ],
    }


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def _ranges(rows: Rows) -> dict:
    """Return what was tested: the range of each numeric channel, the set of each category."""
    ranges: dict = {}
    for name in rows.channels:
        values = np.abs(rows.speed) if name == "speed_mm_s" else rows.values(name)
        if values.dtype.kind == "f":
            known = values[np.isfinite(values)]
            if known.size:
                ranges[name] = [float(known.min()), float(known.max())]
        else:
            ranges[name] = sorted({str(v) for v in values})
    return ranges


def _speeds(rows: Rows) -> dict[str, list[float]]:
    """Return the tested speeds of each series, without signs."""
    series = rows.conditions["series"].to_numpy(dtype=object)[rows.condition]
    return {name: tested_speeds(rows, np.flatnonzero(series == name)).tolist() for name in pd.unique(series)}


def from_record(record: dict, own: Mapping[str, Effect] | None = None) -> tuple[Model, Model, pd.DataFrame]:
    """Return the models before and after and the table of conditions from a record.

    Parameters
    ----------
    record : dict
        As `to_record` returned it; nothing in it is run.
    own : mapping of str to Effect, optional
        The user's own effects, by id.

    Raises
    ------
    RequestError
        If the model has an effect that is neither in the catalogue nor in `own`.
    """
    raw = record["declared"]
    declared = Declared(
        tuple(JointParameter(*p) for p in raw["parameters"]),
        {q: np.array(v, dtype=int) for q, v in raw["index"].items()},
        tuple(record["conditions"]["condition"]),
        record["has_load"],
        raw["stribeck"],
        raw["law"],
    )
    effects = {**EFFECTS, **(own or {})}
    ids = {term["id"] for stage in ("before", "after") for term in record[stage]["terms"]}
    if unknown := sorted(ids - effects.keys() - FREE.keys()):
        raise needed("the model holds", unknown)
    models = []
    for stage in ("before", "after"):
        model = Model(declared, np.array(record[stage]["theta"], dtype=float))
        for raw_term in record[stage]["terms"]:
            fixed = {k: tuple(v) if isinstance(v, list) else v for k, v in raw_term["fixed"].items()}
            effect = free_effect(raw_term["id"], fixed) if raw_term["id"] in FREE else effects[raw_term["id"]]
            own = (raw_term["acts_on"], raw_term["operation"], fixed, raw_term.get("smoothness"))
            model = model.with_term(Term(effect, tuple(raw_term["channels"]), *own), raw_term["values"])
        models.append(model)
    return models[0], models[1], pd.DataFrame(record["conditions"])
