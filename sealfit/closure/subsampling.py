"""Subsampling of large campaigns: choice of the runs and rows searched, and check of the result on all."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from sealfit.closure.channels import channels_of, searched
from sealfit.closure.confirm import AcceptedEffect, heldout_gain
from sealfit.closure.criteria import MOST_RIVALS, RIVAL_BIC
from sealfit.closure.forms import describe
from sealfit.closure.linearised import Proposal
from sealfit.closure.naming import named_among
from sealfit.closure.score_test import ScoreTests
from sealfit.closure.search import search
from sealfit.closure.selection import Selection
from sealfit.config import Config
from sealfit.fit.joint import Fitted, fit, fitted_at
from sealfit.fit.joint.declared import declare
from sealfit.fit.joint.rows import POWER, Rows, make_rows, merge, thin

# A campaign with no more strokes is searched in full. Of a larger one this many are drawn, by whole runs.
STROKES = 4_000
RUNS = 1_000  # Least number of runs drawn: runs are the evidence for most variables.
LEAST_RUNS = 20  # Least number of runs drawn for each parameter of the declared model.
FURTHER = 4  # Factor on the number of strokes drawn next if the full campaign shows more than those searched.
ROWS = 4_000  # Approximate number of rows in a search. More rows are merged along their strokes.
PER_STROKE = 8  # Number of merged rows kept per stroke, if `MOST_ROWS` allows it.
MOST_ROWS = 8_000  # Largest number of rows in a search.
# If `MOST_ROWS` allows fewer rows per stroke, some files keep `PER_STROKE` and the others one row per stroke.
LEAST_PER_STROKE = 4


@dataclass(frozen=True)
class Subsample:
    """The part of a campaign that is searched: some or all runs, and their rows merged along the strokes.

    The attributes are the same object if nothing is left out or merged.
    """

    rows: Rows
    coarse: Rows
    every: Rows  # the full campaign, merged

    @property
    def whole(self) -> bool:
        """Whether all runs are searched."""
        return self.coarse is self.every


def subsamples(rows: Rows, seed: int) -> Iterator[Subsample]:
    """Yield larger and larger subsets of a campaign's runs, drawn evenly over its conditions, then all runs.

    The rows are made of bins as returned by `numbered`.
    """
    every, most, searched_before = _merged(rows, rows, seed), STROKES, 0
    strokes, runs = (rows.groups.starts[level].size for level in ("stroke", "run"))
    while most < strokes:
        drawn = _rows_drawn(rows, min(max(most / strokes, RUNS / runs), 1.0), seed)
        if searched_before < np.count_nonzero(drawn) < drawn.size:
            part = rows.subset(drawn)
            yield Subsample(part, _merged(part, rows, seed), every)
            searched_before = part.force.size
        most *= FURTHER
    yield Subsample(rows, every, every)


def _merged(part: Rows, campaign: Rows, seed: int) -> Rows:
    """Return rows merged along their strokes, with the full campaign's conditions and declared model."""
    merged = merged_bins(part.table.drop(columns=POWER, errors="ignore"), seed)
    if len(merged) == part.force.size:
        return part
    made = make_rows(merged, has_aging=campaign.has_aging, campaign=campaign)
    declare(made, as_in=campaign)
    return made


def _rows_drawn(rows: Rows, share: float, seed: int) -> np.ndarray:
    """Return which rows belong to the runs drawn, shape (n,): one at random of every 1 / `share` neighbours.

    At least one run of each condition is drawn, and `LEAST_RUNS` for each parameter of the declared model.
    """
    first = rows.groups.starts["run"]
    condition = rows.condition[first]
    drawn = _one_per_group(np.lexsort([np.abs(rows.speed[first]), condition]), share, seed)
    rng = np.random.default_rng(seed)
    _fill(drawn, condition, 1, rng)
    for numbers in declare(rows).index.values():
        _fill(drawn, numbers[condition], LEAST_RUNS, rng)
    return drawn[rows.codes("run")]


def _fill(drawn: np.ndarray, number: np.ndarray, least: int, rng: np.random.Generator) -> None:
    """Draw more at random until there are `least` of each number (or all); numbers below 0 are not drawn."""
    wanted = least - np.bincount(number[drawn & (number >= 0)], minlength=number.max(initial=0) + 1)
    left = rng.permutation(np.flatnonzero(~drawn & (number >= 0)))
    left = left[np.argsort(number[left], kind="stable")]
    own = number[left]
    place = np.arange(left.size) - np.searchsorted(own, own)
    drawn[left[place < wanted[own]]] = True


def merged_bins(bins: pd.DataFrame, seed: int) -> pd.DataFrame:
    """Return bins of `numbered` for the search: neighbours within a stroke are merged if there are many.

    With very many strokes, some files drawn evenly over the campaign keep several rows per stroke, in
    `MOST_ROWS` rows together. The others keep their mean only.
    """
    strokes = bins["stroke_id"].nunique()
    if LEAST_PER_STROKE * strokes <= MOST_ROWS:
        return thin(bins, int(np.clip(PER_STROKE * strokes, ROWS, MOST_ROWS)))
    finely = _files_drawn(bins, MOST_ROWS / (PER_STROKE * strokes), seed)
    together = int(np.ceil(len(bins) / strokes / PER_STROKE))
    return merge(bins, np.where(finely, together, len(bins)))


def _files_drawn(bins: pd.DataFrame, share: float, seed: int) -> np.ndarray:
    """Return whether each row's file is drawn, shape (n,): one of every 1 / `share` neighbours."""
    file = pd.factorize(bins["file"])[0]
    first = np.flatnonzero(np.diff(np.maximum.accumulate(file), prepend=-1))
    order = np.lexsort([pd.factorize(bins[name])[0][first] for name in ("run_id", "condition")])
    return _one_per_group(order, share, seed)[file]


def _one_per_group(order: np.ndarray, share: float, seed: int) -> np.ndarray:
    """Return what is drawn, one at random of every 1 / `share` in an order, shape (n,)."""
    group = np.floor(np.arange(order.size) * share)
    shuffled = np.lexsort((np.random.default_rng(seed).random(order.size), group))
    drawn = np.zeros(order.size, dtype=bool)
    drawn[order[shuffled[np.flatnonzero(np.diff(group, prepend=-1))]]] = True
    return drawn


def reselect_on_all(
    selection: Selection, every: Rows, samples: pd.DataFrame, config: Config, say: Callable[[str], None]
) -> tuple[Selection, Fitted]:
    """Re-select the form and target of each effect on all strokes; return the result and the fitted model.

    An effect is compared with its first rivals, and the best of them with itself on the targets of its
    rivals. Rivals on targets that are excluded by this are removed. Ripples were tested on the samples and
    are kept. `every` has all rows, merged along the strokes, and `samples` the raw samples of the part.
    """
    added, after = list(selection.added), selection.after
    whole = fit(after.model, every, after.scatter, turns=1)
    for first in (a for a in selection.added if a.rivals and not a.proposal.term.effect.periodic):
        item = first
        for others_of in (_first_rivals, _on_other_quantities):
            number = next(k for k, a in enumerate(added) if a is item)
            compared = [item.proposal, *others_of(item)]
            if len(compared) == 1:
                continue
            base = fitted_at(whole.model.without_term(number), every, whole.scatter, whole.loads)
            found = named_among(base, [_on_full_campaign(p, every) for p in compared])
            chosen = next(p for p in compared if p.term is found[0].term)
            if chosen is not item.proposal:
                better, worse = (describe(p.term, every) for p in (chosen, item.proposal))
                say(f"on all strokes {better} fits better than {worse}")
                item, after = _replaced(item, chosen, after, number, samples, config)
                added, whole = [*added[:number], *added[number + 1 :], item], found[0].fitted
            if others_of is _on_other_quantities:
                left = [p.term.target for p in found if p.bic - found[0].bic < RIVAL_BIC]
                number = next(k for k, a in enumerate(added) if a is item)
                rivals = (r for r in _rivals(item) if r[0].term.target in left)
                added[number] = item = replace(item, rivals=tuple(rivals))
    return replace(selection, added=tuple(added), after=after), whole


def _first_rivals(item: AcceptedEffect) -> list[Proposal]:
    return [rival for rival, _ in item.rivals[:MOST_RIVALS] if not rival.term.effect.periodic]


def _on_other_quantities(item: AcceptedEffect) -> list[Proposal]:
    """Return an effect on the targets of its rivals, with its own values as start."""
    term = item.proposal.term
    targets = dict.fromkeys(rival.term.target for rival, _ in item.rivals)
    return [
        replace(item.proposal, term=replace(term, acts_on=target[0], operation=target[1]))
        for target in targets
        if target != term.target and target in term.effect.acts_on
    ]


def _replaced(
    item: AcceptedEffect, chosen: Proposal, after: Fitted, number: int, samples: pd.DataFrame, config: Config
) -> tuple[AcceptedEffect, Fitted]:
    """Return an effect replaced by another proposal, its own now a rival, and the fit of the part with it."""
    without = after.refitted(after.model.without_term(number))
    model = without.model.with_term(chosen.term, chosen.fitted.model.values[-1])
    chosen = replace(chosen, fitted=after.refitted(model))
    gain = heldout_gain(without, chosen, config.loop, samples)
    rest = (r for r in _rivals(item) if r[0].term is not chosen.term)
    rivals = ((item.proposal, item.left_N), *rest)
    after = fit(chosen.fitted.model, after.rows, after.scatter, turns=2)
    return AcceptedEffect(chosen, gain.rmse_N, gain.left_N, rivals, item.round), after


def _rivals(item: AcceptedEffect) -> list[tuple[Proposal, float]]:
    """Return the rivals of an effect, without itself, and their RMSE."""
    return [pair for pair in item.rivals if pair[0].term.key() != item.proposal.term.key()]


def _on_full_campaign(proposal: Proposal, every: Rows) -> Proposal:
    """Return a proposal of a part as one for all strokes, not fitted yet."""
    units = every.groups.starts[proposal.unit].size
    return replace(proposal, units=units, values=proposal.fitted.model.values[-1], fitted=None)


def missed_by_subsample(fitted: Fitted, selection: Selection, config: Config) -> str:
    """Return the channel that still explains the residual of all strokes but not of those searched; or "".

    Channels that were significant there are known already.
    """
    alpha = config.loop.family_error
    channels = searched(channels_of(fitted.rows, config), fitted.rows)
    found = search(ScoreTests(fitted), channels, np.random.default_rng(config.loop.seed))
    known = {c.channels for c in selection.last if c.p_value <= alpha}
    new = (c for c in found if c.p_value <= alpha and c.claimable and c.channels not in known)
    return ", ".join(next((c.channels for c in new), ()))
