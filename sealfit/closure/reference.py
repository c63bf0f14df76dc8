"""The reference state of the after-model: where its effects are zero, and what they add to the measured forces.

The coefficients of the after-model are those at the reference: the contact cold, the offset removed, a column at its
reference value. An effect of the condition columns alone (of days, say) is part of a condition and stays in its values.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.fit.estimate import Fitted
from sealfit.fit.joint import Model, evaluate
from sealfit.fit.rows import Rows
from sealfit.fit.terms import Term
from sealfit.fit.uncertainty import SHIFT

KEPT = "not taken out: part of the aging condition"
SMALL = 1e-4  # share of the effects' variance that may be dropped with the smallest principal directions


def is_kept(term: Term, config: Config) -> bool:
    """Return whether an effect is part of the conditions: it reads nothing but their columns."""
    return set(term.channels) <= {*config.condition, *config.rubber}


def reference_of(term: Term, values: Mapping[str, float], config: Config) -> str:
    """Return in words where an effect is zero, or that it is not taken out.

    Parameters
    ----------
    term : Term
        The effect on its channels.
    values : mapping of str to float
        Its fitted parameters.
    config : Config
        Names the condition columns, and gives channels their true units.
    """
    if is_kept(term, config):
        return KEPT
    labels = {name: config.units.label(name) for name in term.channels}
    known = {"x": labels[term.channels[0]], "z": labels[term.channels[-1]], **labels}
    known |= {name: f"{value:.4g}" for name, value in (*term.fixed.items(), *values.items()) if np.isscalar(value)}
    words = term.effect.reference or f"where {term.effect.form} = 0"
    return re.sub(r"\{(\w+)\}", lambda found: str(known.get(found[1], found[1])), words)


def at_reference(model: Model, config: Config) -> Model:
    """Return the model with its effects at their reference: only those that are part of a condition are left."""
    kept = [k for k, term in enumerate(model.terms) if is_kept(term, config)]
    return replace(model, terms=tuple(model.terms[k] for k in kept), values=tuple(model.values[k] for k in kept))


def without_effects(steady: pd.DataFrame, after: Fitted, config: Config) -> pd.DataFrame:
    """Return table `steady_after`: the strokes' mean forces with the effects taken out at their reference.

    Parameters
    ----------
    steady : DataFrame
        Table `steady`.
    after : Fitted
        The after-model, fitted to all bins.
    config : Config
        Names the condition columns.

    Returns
    -------
    DataFrame
        `steady` with `force_N` less `effects_N`, the effects' mean over the steady window; `effects_start_N`, their
        force where the stroke starts; and columns `effects_u1_N`, ...: by how much the force in the direction of motion
        changes along each principal direction of the effects' uncertainty, for one standard error. A stroke without
        bins is not used.

    Notes
    -----
    The effects' covariance is that of the joint fit. In a linear model, a fit to the corrected forces, with this
    covariance propagated through it, gives the estimate and the covariance of the joint fit (Frisch & Waugh 1933,
    Econometrica 1(4), 387-401, doi:10.2307/1907330).
    """
    model, rows = after.model, after.rows
    force, tangent = evaluate(model, rows)
    reference = at_reference(model, config)
    effects = force - evaluate(reference, rows, jacobian=False)[0]
    taken = [k for k, term in enumerate(model.terms) if not is_kept(term, config)]
    places = np.array([i for k in taken for i in range(*model.place(k).indices(model.size))], int)
    last = tangent.values.shape[1] - model.size
    principal = _principal(tangent.values[:, last + places], after.covariance[np.ix_(places, places)], rows)
    columns = {"effects_N": effects, "effects_start_N": _at_start(model, reference, rows)}
    columns |= {f"{SHIFT}{k + 1}_N": principal[:, k] * np.sign(rows.speed) for k in range(principal.shape[1])}
    keys = [rows.table["file"], rows.table["stroke"]]
    weight = rows.table["n"].astype(float)
    means = pd.DataFrame(columns).mul(weight, axis=0).groupby(keys).sum().div(weight.groupby(keys).sum(), axis=0)
    found = means.reindex(pd.MultiIndex.from_frame(steady[["file", "stroke"]])).reset_index(drop=True)
    known = found["effects_N"].notna()
    table = steady.reset_index(drop=True).join(found.fillna(0.0))
    return table.assign(force_N=table["force_N"] - table["effects_N"], used=table["used"].astype(bool) & known)


def _principal(columns: np.ndarray, covariance: np.ndarray, rows: Rows) -> np.ndarray:
    """Return L with L L' = J C J' for derivatives J, shape (n, p), and a covariance C, shape (p, p); few columns.

    Directions whose mean over the strokes is small are dropped: a fit to the strokes does not see them.
    """
    if not columns.size:
        return columns
    size, axes = np.linalg.eigh(covariance)
    spread = columns @ (axes * np.sqrt(np.maximum(size, 0.0)))
    stroke = rows.codes("stroke")
    means = np.column_stack([np.bincount(stroke, column) for column in spread.T]) / np.bincount(stroke)[:, None]
    _, singular, turned = np.linalg.svd(means, full_matrices=False)
    share = np.cumsum(singular[::-1] ** 2)[::-1]
    kept = share > SMALL * share[0]
    return spread @ turned[kept].T


def _at_start(model: Model, reference: Model, rows: Rows) -> np.ndarray:
    """Return the effects' force at the start of each row's stroke, shape (n,): at distance and time 0."""
    table, way = rows.table, np.sign(rows.speed)
    origin = table["displacement_mm"] - way * table["distance_mm"].to_numpy(float)
    start = table.assign(displacement_mm=origin, distance_mm=0.0, time_s=0.0)
    begun = replace(rows, table=start, cache={})
    return evaluate(model, begun, jacobian=False)[0] - evaluate(reference, begun, jacobian=False)[0]
