"""closure.json: the verdict, errors, effects with intervals, sensitivity, and what is left."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from sealfit.closure import criteria
from sealfit.closure.after import reference_of
from sealfit.closure.channels import FINER, Channel, incomplete_channels, unit_of
from sealfit.closure.confirm import AcceptedEffect, RefusedEffect, about_means
from sealfit.closure.errors_and_intervals import (
    effect_intervals,
    errors,
    explained_variance,
    lack_of_fit,
    noise_floor,
    scatter_list,
)
from sealfit.closure.forms import describe, free_term
from sealfit.closure.left_out import OutlierFile
from sealfit.closure.next_runs import next_runs
from sealfit.closure.ripples import Peak
from sealfit.closure.score_test import Candidate, ScoreTests
from sealfit.closure.search import search
from sealfit.closure.selection import Selection
from sealfit.closure.sensitivity import LEVEL_NAMES, sensitivity, undetectable_variables
from sealfit.config import Config
from sealfit.effects.contract import Effect, fill_unit
from sealfit.fit.joint import Fitted, effective_df, fit
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import Rows
from sealfit.tables import EFFECTS
from sealfit.units import Units

OFFSET = "zero_offset"
# Symbols of equations for the references of channels, by the names under which a term has their values.
REFERENCES = {"N_ref": "load_N_ref", "v_ref": "speed_mm_s_ref", "s_ref": "distance_mm_ref"}
SLOTS = ("force_N", "displacement_mm", "speed_mm_s", "load_N", "time_s")


@dataclass(frozen=True)
class BeforeAfter:
    """The models before and after on all rows, and the forces by fits without a row's unit."""

    before: Fitted
    after: Fitted
    held_before: np.ndarray  # (n,) NaN where never held out
    held_after: np.ndarray
    covered: np.ndarray  # (n,) whether the other rows cover the row; else it is extrapolated
    determined: np.ndarray  # (n,) whether they determine both forces; else it is extrapolated, too

    def heldout_rmse_N(self, held: np.ndarray, *, extrapolated: bool = False) -> float | None:
        """Return the held-out error, on rows that the other rows cover or on extrapolated ones."""
        rows = self.before.rows
        chosen = np.isfinite(held) & ((self.covered & self.determined) != extrapolated)
        weight = rows.weight[chosen]
        if not chosen.any():
            return None
        return float(np.sqrt(weight @ (rows.force - held)[chosen] ** 2 / weight.sum()))

    def gains(self, around: str | None, *, weak: bool) -> bool:
        """Whether the model after has no larger errors than that before, in sample and held out.

        With weak evidence the held-out error must be lower. If a level is given, the errors about the means
        of its groups are compared, and the whole errors may be larger by `HARMLESS`. This needs evidence that
        is not weak, or a held-out error about the means that is halved. Otherwise the whole held-out error
        must be lower too, as the means of the groups would contradict the effect. With both, and halved in
        sample too, the whole held-out error is not compared: it is mostly that of the level of other runs.
        """
        whole = self._ratios(None)
        inside = whole if around is None else self._ratios(around)
        if max(inside) > criteria.SAME_ERROR or (weak and inside[1] >= 1):
            return False
        if around is not None and not weak and max(inside) < criteria.HALVED:
            return whole[0] <= criteria.HARMLESS
        if not weak or inside[1] < criteria.HALVED:
            return max(whole) <= criteria.HARMLESS
        return whole[0] <= criteria.SAME_ERROR and whole[1] < 1

    @property
    def halved(self) -> bool:
        """Whether the held-out error after is less than half of that before."""
        return self._ratios(None)[1] < criteria.HALVED

    def _ratios(self, around: str | None) -> tuple[float, float]:
        """Return the ratio of errors after and before, in sample and held out (1 if nothing was held out)."""
        rows, held = self.before.rows, (self.held_before, self.held_after)
        inside = [rows.weight @ about_means(f.residual, rows, around) ** 2 for f in (self.before, self.after)]
        known = np.isfinite(self.held_before) & np.isfinite(self.held_after) & self.covered
        if around in (None, "specimen"):  # else the level of the force need not be determined
            known &= self.determined
        outside = [1.0, 1.0]
        if known.any():
            test = rows.subset(known)
            outside = [test.weight @ about_means(test.force - h[known], test, around) ** 2 for h in held]
        return tuple(float(np.sqrt(after / max(before, 1e-300))) for before, after in (inside, outside))


def closure_document(
    selection: Selection,
    models: BeforeAfter,
    heldout_unit: str,
    config: Config,
    effects: Mapping[str, Effect],
    outliers: Sequence[OutlierFile] = (),
) -> dict:
    """Return closure.json."""
    after, units = models.after, config.units
    numbers = {}
    held_out = (("before", models.before, models.held_before), ("after", after, models.held_after))
    for name, fitted, held in held_out:
        numbers[name] = {
            **errors(fitted.rows, fitted.residual),
            "heldout_rmse_N": models.heldout_rmse_N(held),
            "heldout_extrapolated_rmse_N": models.heldout_rmse_N(held, extrapolated=True),
            "lack_of_fit_p": lack_of_fit(fitted),
        }
    floor, scatter = noise_floor(after), scatter_list(after)
    quality = fit_quality(numbers["after"], floor)
    seen = sensitivity(selection, config.loop.family_error)
    undetectable = undetectable_variables(selection, seen, scatter)
    unclaimable = isinstance(selection.left, Candidate) and not selection.left.claimable
    only_unclaimable = unclaimable and not selection.added
    significant = bool(selection.worse) or (selection.left is not None and not only_unclaimable)
    # What remains beside effects that were found may be less than repeats scatter by.
    small = bool(selection.added) and not selection.worse and (quality["ratio"] or np.inf) <= 1.0
    unconfirmed = only_unclaimable or any(not item.negligible for item in selection.refused)
    unseen = any(undetectable.values()) or (undetectable and quality["state"] != "within_scatter")
    if significant and not small:
        verdict = "unexplained"
    elif selection.added:
        verdict = "closed"
    else:
        verdict = "cannot_tell" if unconfirmed or unseen else "nothing_missing"
    undecided = list(undetectable) if verdict == "cannot_tell" else []
    return {
        "schema": 1,
        "verdict": verdict,
        "fit_quality": quality,
        "sensitivity": [{**entry, "cannot_tell": entry["variable"] in undetectable} for entry in seen],
        "refused": [_refused(item, after.rows) for item in selection.refused],
        "units": {slot: units.of(slot) for slot in SLOTS},
        "noise_floor_N": floor,
        **numbers,
        "heldout_unit": heldout_unit,
        "effects": effect_entries(after, selection, config),
        "scatter": scatter,
        "left": {**left_entry(selection, numbers["after"]["rmse_N"], floor), "significant": significant},
        "outlier_files": [
            {"file": one.file, "deviation_pct": 100 * one.deviation, "p_value": one.p_value}
            for one in outliers
            if not one.instead
        ],
        "next_runs": next_runs(selection, config, effects, outliers, undecided),
        "incomplete_channels": incomplete_channels(after.rows),
    }


def fit_quality(errors_after: Mapping, floor_N: float | None) -> dict:
    """Return closure.json's `fit_quality`: whether the error exceeds the repeats' scatter, and the ratio."""
    p_value = errors_after["lack_of_fit_p"]
    if floor_N is None or p_value is None:
        return {"state": "unknown", "ratio": None, "p_value": None}
    state = "above_scatter" if p_value < criteria.LACK_OF_FIT else "within_scatter"
    return {"state": state, "ratio": errors_after["rmse_N"] / max(floor_N, 1e-300), "p_value": p_value}


def _refused(item: RefusedEffect, rows: Rows) -> dict:
    term = item.proposal.term
    return {
        **_identity(term, rows),
        "label": describe(term, rows),
        "p_value": item.proposal.p_value,
        "reason": item.reason,
        "weak": item.proposal.weak,
    }


def _identity(term: Term, rows: Rows) -> dict:
    return {"id": term.effect.id, "channels": channels_of(term, rows), "acts_on": term.acts_on}


def effect_entries(after: Fitted, selection: Selection, config: Config) -> list[dict]:
    """Return closure.json's `effects`: one per term of the after-model, then the inconclusive candidate."""
    entries = [_entry(after, number, item, config) for number, item in enumerate(selection.added)]
    if (item := selection.inconclusive) is not None:
        alone = item.proposal.fitted
        entries.append({**_entry(alone, len(alone.model.terms) - 1, item, config), "candidate": True})
    return entries


def _entry(after: Fitted, number: int, item: AcceptedEffect, config: Config) -> dict:
    """Return the entry of one effect of a fit's model."""
    term, proposal = after.model.terms[number], item.proposal
    own_phase = "shift" in term.fixed  # each stroke direction of a file has its own
    intervals = effect_intervals(after, number, proposal.unit)
    if own_phase:
        intervals["phi"] = (None, None, None)
    form = form_of(term)
    if term.smoothness is not None:
        form += f"; smooth, {effective_df(after, number):.1f} effective degrees of freedom"
    parameters = []
    for p in term.effect.parameters:
        value, *ci95 = intervals[p.name]
        unit = parameter_unit(p.unit, term, config.units)
        parameters.append({"name": p.symbol, "value": value, "ci95": ci95, "unit": unit})
    return {
        "id": term.effect.id,
        "label": describe(term, after.rows) + (", separate phase per stroke" if own_phase else ""),
        "level": effect_level(term, after.rows),
        "channels": channels_of(term, after.rows),
        "acts_on": term.acts_on,
        "operation": term.operation,
        "reference": reference_of(term, after.model.values[number], config),
        "form": form,
        "named": proposal.named,
        "candidate": False,
        "parameters": parameters,
        "p_value": proposal.p_value,
        "heldout_gain_N": _number(item.gain_N),
        "heldout_rmse_N": _number(item.left_N),
        "alternatives": [
            {**_identity(rival.term, after.rows), "heldout_rmse_N": _number(rmse)}
            for rival, rmse in item.rivals
        ],
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def channels_of(term: Term, rows: Rows) -> list[str]:
    """Return an effect's channels; an unsigned force along a channel of whole files has direction too."""
    names = list(term.channels)
    both_ways = rows.speed.min() < 0 < rows.speed.max()
    coarse = all(FINER[unit_of(rows.unsigned(name), rows)] > FINER["stroke"] for name in names)
    if both_ways and coarse and term.target == ("force", "add") and "direction" not in names:
        names.insert(0, "direction")
    return names


def effect_level(term: Term, rows: Rows) -> str:
    """Return the finest level at which one of the effect's channels varies, in closure.json's words."""
    units = [unit_of(rows.unsigned(name), rows) for name in channels_of(term, rows)]
    return LEVEL_NAMES[rows.level_name(min(units, key=FINER.get))]


def form_of(term: Term) -> str:
    """Return the effect's equation in plain text with the values of its references."""
    text = term.effect.form.replace("{x}", term.channels[0]).replace("{z}", term.channels[-1])
    for name in ("x_ref", "z_ref"):
        if name in term.fixed:
            if term.fixed[name] == 0.0:
                text = text.replace(f"({name[0]} - {name})", name[0])
            text = text.replace(name, f"{term.fixed[name]:g}")
    known = {name: f"{term.fixed[key]:g}" for name, key in REFERENCES.items() if key in term.fixed}
    return re.sub(r"\b\w_ref\b", lambda found: known.get(found[0], found[0]), text)


def parameter_unit(unit: str, term: Term, units: Units) -> str:
    """Return a parameter's unit: {x} and {z} stand for those of the channels, {y} for that of the effect."""
    channel, second = units.of(term.channels[0]), units.of(term.channels[-1])
    force, speed = units.unit("force"), units.unit("speed")
    added = {"force": force, "sigma_2": f"{force}/({speed})", "v_s": speed}
    given = added.get(term.acts_on, "") if term.operation == "add" else ""
    return fill_unit(unit, channel, given, second)


def effect_table(entries: Sequence[dict], added: Sequence[AcceptedEffect]) -> pd.DataFrame:
    """Return the `effects` table from closure.json's `effects`: a row per parameter of an added effect."""
    records = [
        {
            **entry,
            "round": item.round,
            "channels": " ".join(entry["channels"]),
            "parameter": p["name"],
            "value": p["value"],
            "lo95": p["ci95"][0],
            "hi95": p["ci95"][1],
            "unit": p["unit"],
        }
        for item, entry in zip(added, entries, strict=False)  # a candidate comes last
        for p in entry["parameters"]
    ]
    return pd.DataFrame(records, columns=EFFECTS.names())


def left_entry(selection: Selection, rmse_N: float, floor_N: float | None) -> dict:
    """Return closure.json's `left`: the error above the noise floor and the residual's strongest structure.

    This is what is still significant, or an effect that was removed because it lowered no error, or the
    channel that explains most of the residual of added effects, which is not significant.
    """
    above = float(np.sqrt(max(rmse_N**2 - floor_N**2, 0.0))) if floor_N is not None else None
    level, channel, p_value = _left(selection)
    return {"rmse_N": above, "level": level, "channel": channel, "p_value": p_value}


def _left(selection: Selection) -> tuple[str | None, str | None, float | None]:
    """Return level, channel and p-value of what is left; the least p-value if that is nothing."""
    left = selection.left
    if left is None and selection.worse:
        item, rows = selection.worse[-1].proposal, selection.after.rows
        return effect_level(item.term, rows), " ".join(channels_of(item.term, rows)), item.p_value
    if left is None and selection.added:
        last = [c for c in selection.left_over if c.test_result.log_p <= np.log(criteria.NOT_ADJUSTED)]
        last = [c for c in last if c.p_value < criteria.CHANCE_P]
        left = _unsteady_offset(selection) or _largest(selection.after, last)
    if isinstance(left, Peak):
        return "trace", left.axis, left.p_value
    if left is None:
        return None, None, min((c.p_value for c in selection.left_over), default=None)
    names = [selection.channels[n].unit for n in left.channels if n in selection.channels]
    level = min(names or [left.unit], key=FINER.get)
    if left.channels[0] == "direction" and len(left.channels) > 1:
        level = max(names, key=FINER.get)  # offsets differ along the other channel
    name = LEVEL_NAMES[selection.after.rows.level_name(level)]
    return name, " ".join(left.channels), left.p_value


def _unsteady_offset(selection: Selection) -> Candidate | None:
    """Return the category that explains most of an offset between directions that differs by run, or None.

    An offset per condition is fitted first, because it would mask the influence of a set-up.
    """
    fitted = selection.after
    rows = fitted.rows
    effects = zip(fitted.model.terms, fitted.model.values, strict=True)
    amplitude = max((abs(v["A"]) for term, v in effects if term.effect.id == OFFSET), default=0.0)
    variance = sum(c.variance for c in fitted.scatter.components if c.kind == "offset" and c.level == "run")
    categories = [c for c in selection.channels.values() if not c.numeric and not c.grouping]
    if amplitude == 0 or np.sqrt(variance) < criteria.UNSTEADY * amplitude or not categories:
        return None
    if 2 <= len(rows.conditions) <= rows.groups.starts["file"].size / 3:
        term = free_term(Channel("condition", rows.values("condition"), "run"), "force", "add")
        model = fitted.model.with_term(term, {p.name: 0.0 for p in term.effect.parameters})
        fitted = fit(model, rows, fitted.scatter, turns=2)
    found = search(ScoreTests(fitted), categories, np.random.default_rng(0))
    return _largest(fitted, [c for c in found if c.channels[0] == "direction"])


def _largest(fitted: Fitted, candidates: Sequence[Candidate]) -> Candidate | None:
    """Return the candidate that explains the largest variance of the residual, if any explains some."""
    explained = [explained_variance(fitted, c) for c in candidates]
    return candidates[int(np.argmax(explained))] if max(explained, default=0.0) > 0 else None
