"""Close the loop: before, what is missing, after, and what is left, as closure.json and its tables."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from sealfit.closure.confirm import folds, heldout_level
from sealfit.closure.curves import channel_table, curve_table, shape_table
from sealfit.closure.document import effect_entries, effect_table, left_entry
from sealfit.closure.grow import Grown, Start, grow, numbered, predict_rows, steady_samples
from sealfit.closure.levels import errors, lack_of_fit, level_table, noise_floor, scatter_list
from sealfit.closure.merged import Searched, searched
from sealfit.closure.next_runs import next_runs
from sealfit.closure.overlooked import overlooked
from sealfit.closure.record import to_record
from sealfit.closure.told_by_all import told_by_all
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.effects.contract import Effect
from sealfit.engine import begin_map, many_workers
from sealfit.fit.estimate import Fitted, fit, fit_declared
from sealfit.fit.rows import Rows, make_rows
from sealfit.profiling import timed
from sealfit.samples import StoredTraces
from sealfit.verdict import predicts_worse


@dataclass(frozen=True)
class Closure:
    """closure.json as a dict, the model that predict needs, the loop's tables, and the after-model on all bins."""

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
    """Return the closed loop of one campaign.

    Parameters
    ----------
    bins : DataFrame
        Table `bins`.
    traces : DataFrame or sequence of StoredTraces
        Table `traces`, or where it lies: the raw samples, for what is finer than the bins.
    config : Config
        The rig.
    workers : int
        Processes for the folds, and for the spectra of many samples.
    on_progress : callable, optional
        Told in words what is being done.
    """
    say = on_progress or (lambda text: None)
    effects = dict(EFFECTS)
    if config.loop.effects_folder is not None:
        from sealfit.effects.user import load_user_effects

        effects |= load_user_effects(Path(config.loop.effects_folder))
    columns, counted = list(bins.columns), numbered(bins.reset_index(drop=True))
    del bins
    rows = make_rows(counted, has_aging=config.aging)
    del counted  # much of the memory: `rows` holds all of it
    start = None
    for part in searched(rows, config.loop.seed):
        if not part.whole and start is None:  # all strokes tell where to begin better than those that are searched
            say("the declared model on all strokes")
            with timed("declared model", rows=part.every.force.size, of="bins, merged"):
                declared = fit_declared(part.every)
            start = Start(declared.model, declared.scatter)
        heldout = _HeldOut(rows, part, steady_samples(traces, part.rows), config, effects, workers)
        with closing(heldout):
            fine = part.rows if part.coarse is not part.rows else None
            with timed("search", rows=part.coarse.force.size, of="bins, merged"):
                grown = grow(
                    part.coarse,
                    heldout.samples,
                    config,
                    effects,
                    fine=fine,
                    start=None if part.whole else start,
                    workers=workers,
                    on_found=heldout.begin,
                    on_progress=say,
                )
            if not part.whole:
                grown, on_all_strokes = told_by_all(grown, part.every, heldout.samples, config, say)
            heldout.settle(grown)
            say("before and after on all rows")
            with timed("before and after", rows=rows.force.size, of="bins"):
                before, after = _on_all(rows, grown)
            if not part.whole and (more := overlooked(on_all_strokes, grown, config)):
                say(f"all {rows.groups.starts['stroke'].size} strokes show more than those searched: {more}")
                continue
            drawn = _drawn_tables(grown, before, after, config)
            say(f"held out by {heldout.level}: the search repeated without each fold")
            with timed("held out", rows=len(heldout.masks), of="folds"):
                held_before, held_after = heldout.forces(say)
            break
    document = _document(config, effects, grown, before, after, held_before, held_after, heldout.level)
    bins = rows.table[columns].iloc[np.argsort(rows.order)]  # in their order again
    tables = {
        "effects": effect_table([e for e in document["effects"] if not e["candidate"]], grown.added),
        "residuals_before": _residual_table(bins, before, held_before),
        "residuals_after": _residual_table(bins, after, held_after),
        **drawn,
    }
    return Closure(document, to_record(before, after, config), tables, after)


def _drawn_tables(grown: Grown, before: Fitted, after: Fitted, config: Config) -> dict[str, pd.DataFrame]:
    """Return the tables that need no held-out folds, which workers may be at meanwhile."""
    levels = [level_table("before", before, list(grown.first)), level_table("after", after, list(grown.last))]
    return {
        "levels": pd.concat(levels, ignore_index=True),
        "channels": channel_table(grown, before, after),
        "shapes": shape_table(after, config),
        "curves": curve_table(before, after),
    }


def _on_all(rows: Rows, grown: Grown) -> tuple[Fitted, Fitted]:
    """Return before and after, refitted to rows as they are, held ripples included; once where nothing was added."""
    if grown.before.rows is rows:
        return grown.before, grown.after
    before = fit(grown.before.model, rows, grown.before.scatter, turns=2)
    if not grown.added:
        return before, before
    model = replace(grown.after.model, terms=tuple(a.proposal.term for a in grown.added))
    return before, fit(model, rows, grown.after.scatter, turns=2)


class _HeldOut:
    """The folds: everything fitted and searched again without some groups, and asked for them.

    With several workers the folds begin as soon as something is found in the whole campaign.
    """

    def __init__(
        self,
        rows: Rows,
        part: Searched,
        samples: pd.DataFrame,
        config: Config,
        effects: dict[str, Effect],
        workers: int,
    ) -> None:
        self.rows, self.part, self.samples = rows, part, samples
        self.config, self.effects, self.workers = config, effects, workers
        self.level = heldout_level(rows)
        self.masks = list(folds(rows, self.level, config.loop.folds, config.loop.seed))
        self._begun: Generator | None = None

    def begin(self, before: Fitted) -> None:
        """Set processes to work, on the assumption that something will be added."""
        if many_workers(self.workers):
            self._begun = begin_map(_held_out, _Folds(self, before, search=True), workers=self.workers)

    def close(self) -> None:
        """End what is still being computed."""
        if self._begun is not None:
            self._begun.close()

    def settle(self, grown: Grown) -> None:
        """Set processes to work on what is known to be wanted: without a search, unless something was added."""
        if self._begun is None or not grown.added:
            self.close()
            if not grown.added:
                self.samples = self.samples.iloc[[]]  # much of the memory, and nothing is searched again
            folds = _Folds(self, grown.before, search=bool(grown.added))
            # One refit of merged bins takes less than the start of a process and the way of its rows there.
            self._begun = begin_map(_held_out, folds, workers=self.workers if folds.search else 1)

    def forces(self, say: Callable[[str], None]) -> tuple[np.ndarray, np.ndarray]:
        """Return each row's force, before and after, by fits that did not see its group; NaN if never held out."""
        before, after = np.full(self.rows.force.size, np.nan), np.full(self.rows.force.size, np.nan)
        for k, (out, parts) in enumerate(zip(self.masks, self._begun, strict=True)):
            say(f"  fold {k + 1} of {len(self.masks)}")
            before[out], after[out] = parts
        return before, after


@dataclass(frozen=True)
class _Fold:
    """One fold: the rows and samples the fit may see, and those it is asked for."""

    train: Rows
    fine: Rows | None
    every: Rows | None  # where `train` is of some runs only: all the fit may see
    seen: pd.DataFrame
    test: Rows
    config: Config
    effects: dict[str, Effect]
    start: Start
    search: bool


class _Folds(Sequence):
    """The folds of a campaign, each made when it is asked for: it holds most of the campaign."""

    def __init__(self, campaign: _HeldOut, before: Fitted, *, search: bool) -> None:
        self.campaign, self.start, self.search = campaign, Start(before.model, before.scatter), search

    def __len__(self) -> int:
        return len(self.campaign.masks)

    def __getitem__(self, number):
        if isinstance(number, slice):
            return [self[k] for k in range(*number.indices(len(self)))]
        own, out = self.campaign, self.campaign.masks[number]
        part, gone = own.part, own.rows.table["stroke_id"].to_numpy()[out]

        def kept(rows: Rows) -> Rows:
            return rows.subset(~rows.table["stroke_id"].isin(gone).to_numpy())

        fine, seen = None, own.samples.head(0)
        if self.search:  # without one, neither is looked at
            fine = kept(part.rows) if part.coarse is not part.rows else None
            seen = own.samples[~own.samples["stroke_id"].isin(gone)]
        every = None if part.whole else kept(part.every)
        test = own.rows.subset(out)
        return _Fold(kept(part.coarse), fine, every, seen, test, own.config, own.effects, self.start, self.search)


def _held_out(fold: _Fold) -> tuple[np.ndarray, np.ndarray]:
    """Return the forces before and after at a fold's rows; before twice where the whole campaign lacks nothing."""
    if fold.search:
        part = grow(fold.train, fold.seen, fold.config, fold.effects, fine=fold.fine, start=fold.start, compare=False)
        before, after = part.before, part.after
    else:
        before = after = fit(fold.start.model, fold.train, fold.start.scatter, turns=1)

    def force(fitted: Fitted) -> np.ndarray:
        own = fitted if fold.every is None else fit(fitted.model, fold.every, fitted.scatter, turns=0)
        return predict_rows(own, fold.test)

    first = force(before)
    return first, first if after is before else force(after)


def _document(
    config, effects, grown: Grown, before: Fitted, after: Fitted, held_before, held_after, level: str
) -> dict:
    floor = noise_floor(after)
    entries = effect_entries(after, grown, config)
    numbers = {}
    for name, fitted, held in (("before", before, held_before), ("after", after, held_after)):
        found = errors(fitted.rows, fitted.residual)
        known = np.isfinite(held)
        weight = fitted.rows.weight[known]
        out = float(np.sqrt(weight @ (fitted.rows.force - held)[known] ** 2 / weight.sum())) if known.any() else None
        numbers[name] = {
            "rmse_N": found["rmse_N"],
            "rmse_runs_N": found["rmse_runs_N"],
            "heldout_rmse_N": out,
            "max_abs_N": found["max_abs_N"],
            "mean_abs_pct": found["mean_abs_pct"],
            "lack_of_fit_p": lack_of_fit(fitted),
        }
    worse = predicts_worse({**numbers, "effects": entries})
    verdict = "unexplained" if grown.left is not None or worse else "closed" if grown.added else "nothing_missing"
    units = config.units
    slots = ("force_N", "displacement_mm", "speed_mm_s", "load_N", "time_s")
    return {
        "schema": 1,
        "verdict": verdict,
        "units": {slot: units.of(slot) for slot in slots},
        "noise_floor_N": floor,
        **numbers,
        "heldout_unit": level,
        "effects": entries,
        "scatter": scatter_list(after),
        "left": left_entry(grown, numbers["after"]["rmse_N"], floor, look=not worse),
        "next_runs": next_runs(grown, config, effects),
    }


def _residual_table(bins: pd.DataFrame, fitted: Fitted, held: np.ndarray) -> pd.DataFrame:
    """Return `bins`, in its order, with the model, the residual, their held-out counterparts and the weight."""
    rows, own = fitted.rows, np.argsort(fitted.rows.order)
    return bins.assign(
        model_N=fitted.force[own],
        residual_N=fitted.residual[own],
        heldout_model_N=held[own],
        heldout_residual_N=(rows.force - held)[own],
        weight=rows.weight[own],
    ).reset_index(drop=True)
