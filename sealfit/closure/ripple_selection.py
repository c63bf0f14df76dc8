"""Ripples are selected first: they are found and confirmed on the raw samples, without slow effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from sealfit.closure.channels import channels_of
from sealfit.closure.confirm import AcceptedEffect, Context, RefusedEffect, confirmed
from sealfit.closure.naming import propose_ripples
from sealfit.closure.ripples import Peak, find_ripple
from sealfit.fit.joint import Fitted, fit
from sealfit.fit.joint.model import Model, passes
from sealfit.fit.joint.rows import Rows
from sealfit.ingest.stored_parts import StoredTraces, a_part_at_a_time, stroke_index, strokes_of

SAMPLED = ("displacement_mm", "time_s", "force_N")  # columns of the samples that the ripple search reads

# Steps between samples up to which a turn follows the one before without a gap. A change of speed leaves
# more: its rise is not in the steady windows.
GAP = 3


class Ripples:
    """The periodic effects of a campaign, from its steady samples as returned by `steady_samples`."""

    def __init__(self, samples: pd.DataFrame, context: Context) -> None:
        self.context = context
        self.added: list[AcceptedEffect] = []  # confirmed
        self.refused: list[RefusedEffect] = []  # significant, but not confirmed
        self.samples = samples.assign(residual_N=samples["force_N"])  # less the ripples added so far
        self.found = self._find()  # significant, not in the model yet

    def added_to(self, fitted: Fitted, fine: Rows | None) -> Fitted:
        """Return a fit of the declared model with every ripple that is significant and confirmed.

        If there are `fine` rows, ripples are fitted to them, and fixed on the rows of `fitted`.
        """
        if self.found is None:
            return fitted
        own = fitted if fine is None else fit(fitted.model, fine, fitted.scatter, turns=1)
        while self.found is not None and len(self.added) < self.context.config.loop.max_rounds:
            number = len(self.added) + 1
            self.context.say(f"round {number}: a significant ripple in the samples, before all other effects")
            names = {c.name for c in channels_of(own.rows, self.context.config)}
            proposals = propose_ripples(own, self.found, self.samples, self.context.effects, names)
            accepted, failed = confirmed(own, proposals, self.samples, self.context, number)
            if accepted is None:
                self.refused += failed[:1]
                self.found = None
                break
            self.added.append(accepted)
            # under its own scatter: the former one contains the missing effect
            found = accepted.proposal.fitted
            own = fit(found.model, own.rows, found.scatter, turns=2)
            self.samples = without_ripples(self.samples, own)
            self.found = self._find(own.model)
        if fine is None:
            return own
        if not self.added:
            return fitted
        held = []
        for term, values in zip(own.model.terms, own.model.values, strict=True):
            at_values = {name: (value, value) for name, value in values.items()}
            held.append(replace(term, fixed={**term.fixed, "held": at_values}))
        return fit(replace(own.model, terms=tuple(held)), fitted.rows, own.scatter, turns=2)

    def _find(self, model: Model | None = None) -> Peak | None:
        pairs = zip(model.terms, model.values, strict=True) if model else ()
        known, config = [(term.channels[0], own["lambda_"]) for term, own in pairs], self.context.config
        common, ignored = config.position_origin == "rig", config.loop.ignore_channels
        peak = find_ripple(self.samples, common_phase=common, known=known, ignored=ignored)
        return peak if peak is not None and peak.p_value <= config.loop.family_error else None


def without_ripples(samples: pd.DataFrame, fitted: Fitted) -> pd.DataFrame:
    """Return the samples with `residual_N`: the force less the effects of a model with ripples only.

    Ripples are evaluated at the samples. Slow changes are removed from each stroke by the spectrum itself.
    """
    rows = fitted.rows
    strokes = rows.table.iloc[rows.groups.starts["stroke"]]
    ids, own = strokes["stroke_id"].to_numpy(), samples["stroke_id"].to_numpy()
    level = np.zeros(max(ids.max(), own.max()) + 1)
    level[ids] = rows.groups.means(fitted.force, "stroke")
    residual = samples["force_N"].to_numpy(dtype=float)
    for term, values in zip(fitted.model.terms, fitted.model.values, strict=True):
        place = samples[term.channels[0]].to_numpy(dtype=float)
        shift = term.fixed.get("shift")
        if shift is not None:
            shifts = np.zeros_like(level)
            shifts[ids] = passes(strokes).map(shift).to_numpy(dtype=float)
            place = place + shifts[own]
        given = {term.effect.reads[0]: place, **term.fixed}
        inputs = term.inputs(rows)
        for name in term.effect.reads[1:]:
            second = np.zeros_like(level)
            second[ids] = inputs[name][rows.groups.starts["stroke"]]
            given[name] = second[own]
        shape = term.effect.shape(given, **values)
        residual = residual - shape * (1.0 if term.operation == "add" else level[own])
    return samples.assign(residual_N=residual)


def numbered(bins: pd.DataFrame) -> pd.DataFrame:
    """Return `bins` with `stroke_id`, a number per stroke that samples and all subsets of the rows share."""
    return bins.assign(stroke_id=bins.groupby(["file", "stroke"], sort=False).ngroup().to_numpy())


def steady_samples(
    traces: pd.DataFrame | Sequence[StoredTraces], rows: Rows, turn: float | None = None
) -> pd.DataFrame:
    """Return the steady samples of the strokes in `rows`, for the ripple search.

    `traces` is that table, its samples ordered by stroke, or where it is stored. `rows` are made from
    `numbered` bins. The columns are stroke_id, stroke, direction, unit (number of the file) and `SAMPLED`.
    Strokes that are turns, `turn` long, are joined, since a wave of one period per stroke is hard to
    distinguish from a slow change.
    """
    first = rows.groups.starts["stroke"]
    strokes = rows.table.iloc[first]
    index = stroke_index(strokes)
    about = {name: strokes[name].to_numpy() for name in ("stroke_id", "stroke", "direction")}
    about["unit"] = rows.codes("file")[first]
    parts = []
    for part in a_part_at_a_time(traces, ["file", "stroke", "steady", "presliding_N", *SAMPLED]):
        steady = part[part["steady"].to_numpy(dtype=bool)]
        steady = steady.assign(force_N=steady["force_N"] - steady["presliding_N"])
        edges, own = strokes_of(steady, index)
        place = np.repeat(own, np.diff(edges))
        known = place >= 0
        parts.append((place[known].astype(np.int32), *(steady[name].to_numpy()[known] for name in SAMPLED)))
    parts = parts or [(np.zeros(0, int),) * (1 + len(SAMPLED))]
    place, *values = map(np.concatenate, zip(*parts, strict=True))
    about = {name: own.astype(np.int32)[place] for name, own in about.items()}
    samples = pd.DataFrame({**about, **dict(zip(SAMPLED, values, strict=True))})
    return samples if turn is None or samples.empty else turns_joined(samples, turn)


def turns_joined(samples: pd.DataFrame, turn: float) -> pd.DataFrame:
    """Return samples whose displacement goes on where a stroke is the turn after the one before."""
    place, way = samples["displacement_mm"].to_numpy(), samples["direction"].to_numpy()
    first = np.flatnonzero(np.r_[True, np.diff(samples["stroke_id"]) != 0])
    last = np.r_[first[1:], len(samples)] - 1
    step = (way[last] * (place[last] - place[first])) / np.maximum(last - first, 1)
    gap = way[first[1:]] * (place[first[1:]] - place[last[:-1]]) + turn
    same = [np.diff(samples[name].to_numpy()[first]) == 0 for name in ("unit", "direction")]
    after = np.diff(samples["stroke"].to_numpy()[first]) == 1
    joined = np.r_[False, np.all([*same, after, np.abs(gap) <= GAP * step[1:]], axis=0)]
    begin = np.maximum.accumulate(np.where(joined, 0, np.arange(first.size)))
    shift = way[first] * turn * (np.arange(first.size) - begin)
    size = last - first + 1
    return samples.assign(
        displacement_mm=place + np.repeat(shift, size),
        stroke_id=np.repeat(samples["stroke_id"].to_numpy()[first][begin], size),
    )
