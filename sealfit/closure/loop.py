"""Close the loop: models before and after, effects added, and what is left, as closure.json and tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd

from sealfit.closure.channels import searched
from sealfit.closure.confirm import (
    NEGATIVE,
    AcceptedEffect,
    Context,
    RefusedEffect,
    turns_negative,
    varies_within,
)
from sealfit.closure.criteria import CERTAIN_P, DETERMINED, JACKKNIFE_UNITS, PART_WITHIN, RIVAL_CORRELATION
from sealfit.closure.errors_and_intervals import level_table, mean_se
from sealfit.closure.forms import describe
from sealfit.closure.left_out import covered, folds, heldout_level, outlier_files
from sealfit.closure.output import channel_table, curve_table, shape_points, shape_table, to_record
from sealfit.closure.result import BeforeAfter, closure_document, effect_table
from sealfit.closure.ripple_selection import numbered, steady_samples
from sealfit.closure.score_test import ScoreTests
from sealfit.closure.search import search
from sealfit.closure.selection import Selection, StartingFit, select_effects
from sealfit.closure.subsampling import Subsample, missed_by_subsample, reselect_on_all, subsamples
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.effects.user import load_user_effects
from sealfit.engine.run_map import run_map
from sealfit.fit.joint import Fitted, fit, fit_declared
from sealfit.fit.joint.model import Model, evaluate, shape_of
from sealfit.fit.joint.rows import LEVELS, SET_UP, Rows, make_rows, records
from sealfit.fit.joint.set_ups import (
    with_both_directions,
    with_set_ups,
    with_specimens_by_condition,
    with_straight_loads,
)
from sealfit.ingest.stored_parts import StoredTraces
from sealfit.progress import Silent, timed


@dataclass(frozen=True)
class Closure:
    """closure.json, the model record for `predict`, the tables, and the after-model fitted to all bins."""

    document: dict
    model: dict
    tables: dict[str, pd.DataFrame]
    after: Fitted


def close_loop(
    bins: pd.DataFrame,
    traces: pd.DataFrame | Sequence[StoredTraces],
    config: Config,
    *,
    workers: int = 1,
    on_progress: Callable[[str], None] | None = None,
) -> Closure:
    """Return the closed loop of one campaign, from its tables `bins` and `traces`.

    `traces` may also be where that table is stored. The folds are searched in `workers` processes, and
    `on_progress` is called with a line on what is being done.
    """
    say = on_progress or Silent().say
    effects = EFFECTS | load_user_effects(config.loop.effects_folder)
    context = Context(config, effects, say, workers=workers)
    columns, named = list(bins.columns), with_straight_loads(numbered(bins.reset_index(drop=True)))
    counted = with_specimens_by_condition(named)
    if counted is not named:
        say("specimens of the same name differ between conditions: they count as different ones in each")
    bins = with_set_ups(counted)
    rows = make_rows(bins, has_aging=config.aging, speed_factor=config.units.speed_factor)
    outliers, fitted = outlier_files(rows)
    left_out = [one.file for one in outliers if not one.instead]
    if left_out:
        say("left out, far off all others: " + ", ".join(left_out))
        # Set-ups are looked for again: one wrong file hides that they scatter.
        bins = with_set_ups(counted[~records(counted).isin(left_out).to_numpy()])
    grouped = with_both_directions(bins, fitted)
    if left_out or grouped is not bins:
        rows = make_rows(grouped, has_aging=config.aging, campaign=rows)
    if SET_UP in rows.table:
        say("files of a specimen with the same repeat, or of both directions, scatter alike: one set-up")
    del bins, named, counted, grouped  # they take much memory, and `rows` contains them
    start = None
    for part in subsamples(rows, config.loop.seed):
        if not part.whole and start is None:  # a start from all strokes is better than from those searched
            say("the declared model on all strokes")
            with timed("declared model", rows=part.every.force.size, of="bins, merged"):
                declared = fit_declared(part.every)
            start = StartingFit(declared.model, declared.scatter)
        heldout = _HeldOut(rows, part, steady_samples(traces, part.rows, config.strokes.turn), context)
        fine = part.rows if part.coarse is not part.rows else None
        with timed("search", rows=part.coarse.force.size, of="bins, merged"):
            begin = None if part.whole else start
            selection = select_effects(part.coarse, heldout.samples, context, fine=fine, start=begin)
        if not part.whole:
            selection, on_all_strokes = reselect_on_all(selection, part.every, heldout.samples, config, say)
        say("before and after on all rows")
        with timed("before and after", rows=rows.force.size, of="bins"):
            before, after = _on_all(rows, selection)
        if not part.whole and (more := missed_by_subsample(on_all_strokes, selection, config)):
            say(f"all {rows.groups.starts['stroke'].size} strokes show more than those searched: {more}")
            continue
        repeated = ": the search repeated without each fold" if heldout.repeats(selection) else ""
        unit = rows.level_name(heldout.level).replace("_", "-")
        say(f"held out by {unit}{repeated}")
        with timed("held out", rows=len(heldout.masks), of="folds"):
            held_before, held_after, determined, found = heldout.forces(selection, say)
            within = heldout.covered(after.model)
            models = BeforeAfter(before, after, held_before, held_after, within, determined)
            if found is not None and not _found_in_folds(selection, found):
                selection, models = _only_halved(selection, models, heldout, say)
            selection, models = _only_gains(selection, models, heldout, say)
        break
    before, after = models.before, models.after
    drawn = _drawn_tables(selection, before, after, config)
    document = closure_document(selection, models, unit, config, effects, outliers)
    bins = rows.table[columns].iloc[np.argsort(rows.order)]  # in their original order
    tables = {
        "effects": effect_table(document["effects"], selection.added),
        "residuals_before": _residual_table(bins, before, models.held_before),
        "residuals_after": _residual_table(bins, after, models.held_after),
        **drawn,
    }
    return Closure(document, to_record(before, after, config, _unconfirmed(selection, after)), tables, after)


def _unconfirmed(selection: Selection, after: Fitted) -> dict[str, Model]:
    """Return the model after the loop with each significant effect that is in no model, by its label.

    An effect that is not finite at every bin, as a logarithm at 0, is left out.
    """
    items = [item for item in (selection.inconclusive,) if item is not None]
    items += [item for item in selection.refused if not item.negligible]
    found, rows = {}, after.rows
    proposals = {describe(item.proposal.term, rows): item.proposal for item in items}  # refused in two rounds
    for label, proposal in proposals.items():
        model = after.model.with_term(proposal.term, proposal.fitted.model.values[-1])
        if np.isfinite(evaluate(model, rows, jacobian=False)[0]).all():
            found[label] = fit(model, rows, after.scatter, turns=1).model
    return found


def _drawn_tables(
    selection: Selection, before: Fitted, after: Fitted, config: Config
) -> dict[str, pd.DataFrame]:
    """Return the tables that do not depend on the folds."""
    stages = (
        ("before", before, selection.before, selection.first),
        ("after", after, selection.after, selection.left_over),
    )
    levels = [level_table(*stage, selection.channels) for stage in stages]
    shapes = shape_table(after, config)
    drawn = {"shapes": shapes, "shape_points": shape_points(after, shapes)}
    if selection.inconclusive is not None:  # the last effect of a fit of its own
        alone = selection.inconclusive.proposal.fitted
        own, number = shape_table(alone, config), len(alone.model.terms) - 1
        for name, more in (("shapes", own), ("shape_points", shape_points(alone, own))):
            more = more[more["effect"] == number].assign(effect=len(selection.added))
            drawn[name] = pd.concat([drawn[name], more], ignore_index=True) if len(drawn[name]) else more
    return {
        "levels": pd.concat(levels, ignore_index=True),
        "channels": channel_table(selection, before, after),
        **drawn,
        "curves": curve_table(before, after),
    }


def _on_all(rows: Rows, selection: Selection) -> tuple[Fitted, Fitted]:
    """Return before and after refitted to all rows with ripples free; twice the same if nothing was added."""
    if selection.before.rows is rows:
        return selection.before, selection.after
    before = fit(selection.before.model, rows, selection.before.scatter, turns=2)
    if not selection.added:
        return before, before
    model = replace(selection.after.model, terms=tuple(a.proposal.term for a in selection.added))
    return before, fit(model, rows, selection.after.scatter, turns=2)


class _HeldOut:
    """Cross-validation: the loop is repeated without some groups, and these are predicted."""

    def __init__(self, rows: Rows, part: Subsample, samples: pd.DataFrame, context: Context) -> None:
        self.rows, self.part, self.samples, self.workers = rows, part, samples, context.workers
        self.context = replace(context, say=Silent().say, compare=False, workers=1)  # of the search in a fold
        self.level = heldout_level(rows)
        loop = context.config.loop
        self.masks = list(folds(rows, self.level, loop.folds, loop.seed))

    def repeats(self, selection: Selection) -> bool:
        """Whether the search is repeated in each fold, or the effects of the full campaign are refitted.

        With few runs a fold has too little power. With p-values below `CERTAIN_P` every fold would find the
        same effects again.
        """
        enough = self.rows.groups.starts["run"].size >= JACKKNIFE_UNITS
        return enough and any(a.proposal.p_value > CERTAIN_P for a in selection.added)

    def forces(
        self, selection: Selection, say: Callable[[str], None]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Sequence[Model] | None]:
        """Return each row's force before and after, by fits without its group, and the models.

        A force is NaN if its row was never held out. The third array is true where the rows not held out
        determine both forces. The models are those of the repeated searches; None if the search is not
        repeated. A repeated search has as many rounds as the full campaign needed for its last effect: with
        less power it would go on for many rounds with small effects that it refuses.
        """
        if not self.repeats(selection):
            before, determined = self.refitted(selection.before)
            after, also = self.refitted(selection.after) if selection.added else (before, determined)
            return before, after, determined & also, None
        start = StartingFit(selection.before.model, selection.before.scatter)
        rounds = max(a.round for a in selection.added)
        repeated = partial(_searched, self.part, self.samples, self.context, start, rounds)
        parts = run_map(repeated, [self.rows.subset(out) for out in self.masks], workers=self.workers)
        before, after = np.full((2, self.rows.force.size), np.nan)
        determined, models = np.zeros(self.rows.force.size, dtype=bool), []
        for k, (out, part) in enumerate(zip(self.masks, parts, strict=True)):
            say(f"  fold {k + 1} of {len(self.masks)}")
            before[out], after[out], determined[out], model = part
            models.append(model)
        return before, after, determined, models

    def refitted(self, fitted: Fitted) -> tuple[np.ndarray, np.ndarray]:
        """Return each row's force by a model refitted without its fold, and where it is determined, (n,)."""
        force, determined = np.full(self.rows.force.size, np.nan), np.zeros(self.rows.force.size, dtype=bool)
        for out in self.masks:
            test = self.rows.subset(out)
            own = fit(fitted.model, _without(self.part.coarse, test), fitted.scatter, turns=1)
            force[out], determined[out] = _predicted(own, self.part, test)
        return force, determined

    def covered(self, model: Model) -> np.ndarray:
        """Return which rows were held out and are covered by the others, shape (n,)."""
        channels = [name for term in model.terms for name in term.channels]
        found = np.zeros(self.rows.force.size, dtype=bool)
        for out in self.masks:
            found |= covered(self.rows, out, channels)
        return found


def _searched(
    part: Subsample, samples: pd.DataFrame, context: Context, start: StartingFit, rounds: int, test: Rows
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Model]:
    """Return the forces before and after at the test rows, where both are determined, and the model after.

    The search is repeated without the strokes of these rows.
    """
    fine = _without(part.rows, test) if part.coarse is not part.rows else None
    seen = samples[~samples["stroke_id"].isin(test.table["stroke_id"])]
    train = _without(part.coarse, test)
    found = select_effects(train, seen, context, fine=fine, start=start, rounds=rounds)
    before, determined = _predicted(found.before, part, test)
    after, also = _predicted(found.after, part, test) if found.added else (before, determined)
    return before, after, determined & also, found.after.model


def _predicted(fitted: Fitted, part: Subsample, test: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Return the force at the test rows, and where the other rows determine it."""
    if not part.whole:  # a model of some runs
        fitted = fit(fitted.model, _without(part.every, test), fitted.scatter, turns=0)
    force, tangent = evaluate(fitted.model, test)
    return force, mean_se(tangent, fitted.covariance) < DETERMINED * fitted.rmse_N


def _without(rows: Rows, test: Rows) -> Rows:
    """Return rows without the strokes of the test rows."""
    return rows.subset(~rows.table["stroke_id"].isin(test.table["stroke_id"]).to_numpy())


def _found_in_folds(selection: Selection, found: Sequence[Model]) -> bool:
    """Whether a fold found one of the effects again, or the evidence for one is not weak.

    A fold that finds nothing predicts as the declared model does, so its error is no evidence for an effect.
    """
    if not all(item.proposal.weak for item in selection.added):
        return True
    rows = selection.after.rows
    known = [pair for model in found for pair in zip(model.terms, model.values, strict=True)]
    shapes = [shape_of(term, values, rows) for term, values in known if "shift" not in term.fixed]
    terms = [item.proposal.term for item in selection.added]
    added = zip(terms, selection.after.model.values, strict=True)
    own = [shape_of(term, values, rows) for term, values in added]
    return any(_same_shape(one, other) for one in own for other in shapes)


def _only_halved(
    selection: Selection, models: BeforeAfter, heldout: _HeldOut, say: Callable[[str], None]
) -> tuple[Selection, BeforeAfter]:
    """Return the result where no fold found the effects: without them, unless they halve the held-out error.

    A strong effect is part of the scatter that it is tested against, and a fold has fewer runs.
    """
    held, determined = heldout.refitted(selection.after)
    refitted = replace(models, held_after=held, determined=models.determined & determined)
    if refitted.halved:
        return selection, refitted
    covered = heldout.covered(models.before.model)
    models = replace(models, after=models.before, held_after=models.held_before, covered=covered)
    names = "; ".join(describe(a.proposal.term, selection.after.rows) for a in selection.added)
    say(f"removed, because no fold found them again: {names}")
    reason = "its evidence is weak, and the repeated search finds it in no fold"
    refused = (*selection.refused, *(RefusedEffect(a.proposal, reason) for a in selection.added))
    return replace(selection, after=selection.before, added=(), refused=refused), models


def _same_shape(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two shapes are correlated, or the same constant."""
    one, other = one - one.mean(), other - other.mean()
    sizes = np.linalg.norm(one), np.linalg.norm(other)
    return not any(sizes) or abs(one @ other) > RIVAL_CORRELATION * sizes[0] * sizes[1]


def _only_gains(
    selection: Selection, models: BeforeAfter, heldout: _HeldOut, say: Callable[[str], None]
) -> tuple[Selection, BeforeAfter]:
    """Return the result without the last effects that do not lower the error in sample and held out.

    A removed effect is recorded as refused: the verdict is `unexplained`, or `cannot_tell` if it is weak.
    """
    refused = []
    while selection.added:
        negative = turns_negative(models.after)
        weak = selection.added[-1].proposal.weak
        if not negative and models.gains(_level_of(selection.added), weak=weak):
            break
        last = selection.added[-1].proposal
        reason = NEGATIVE if negative else "it does not lower the error, in sample or on held-out data"
        say(f"removed, because {reason}: {describe(last.term, selection.after.rows)}")
        refused.append(RefusedEffect(last, reason))
        own = selection.before
        if len(selection.added) > 1:
            model = selection.after.model.without_term(len(selection.added) - 1)
            own = fit(model, selection.after.rows, selection.after.scatter, turns=2)
        selection = replace(selection, after=own, added=selection.added[:-1])
        if not selection.added:
            models = replace(models, after=models.before, held_after=models.held_before)
            break
        _, after = _on_all(models.before.rows, selection)
        held, determined = heldout.refitted(own)
        models = replace(models, after=after, held_after=held, covered=heldout.covered(own.model))
        models = replace(models, determined=models.determined & determined)
    strong = tuple(r for r in refused if not r.proposal.weak)
    if refused and selection.added:
        channels = searched(selection.channels.values(), selection.after.rows)
        last = search(ScoreTests(selection.after), channels, np.random.default_rng(0))
        selection = replace(selection, last=tuple(last))
    return replace(selection, refused=(*selection.refused, *refused), worse=strong), models


def _level_of(added: Sequence[AcceptedEffect]) -> str | None:
    """Return the coarsest level within whose groups the effects vary; None if between specimens."""
    levels = [varies_within(a.proposal, PART_WITHIN) for a in added]
    return None if None in levels else max(levels, key=LEVELS.index)


def _residual_table(bins: pd.DataFrame, fitted: Fitted, held: np.ndarray) -> pd.DataFrame:
    """Return `bins` in its order with the model, the residual, their held-out counterparts and the weight."""
    rows, own = fitted.rows, np.argsort(fitted.rows.order)
    return bins.assign(
        model_N=fitted.force[own],
        residual_N=fitted.residual[own],
        heldout_model_N=held[own],
        heldout_residual_N=(rows.force - held)[own],
        weight=rows.weight[own],
    ).reset_index(drop=True)
