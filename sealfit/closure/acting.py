"""On which quantity an effect acts, told by all strokes: a part of them may not tell a factor on mu from a gain."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import pandas as pd

from sealfit.closure.confirm import Added, heldout_gain
from sealfit.closure.forms import PERIODIC, describe
from sealfit.closure.grow import Grown
from sealfit.closure.linearised import Proposal
from sealfit.closure.naming import RIVAL, named_among
from sealfit.config import Config
from sealfit.fit.estimate import Fitted, fit, fitted_at
from sealfit.fit.rows import Rows

Way = tuple[str, str]  # what an effect acts on, and how


def acting_as_all_say(
    grown: Grown, every: Rows, samples: pd.DataFrame, config: Config, say: Callable[[str], None]
) -> tuple[Grown, Fitted]:
    """Return what the search of a part came to, and its final model fitted to all strokes.

    An effect with rivals on other quantities is held against itself on those, and acts on what suits all strokes best;
    rivals on quantities that all strokes rule out are none any more. A ripple was judged on samples, and stays.

    Parameters
    ----------
    grown : Grown
        What the search of a part came to.
    every : Rows
        The campaign, merged along the strokes.
    samples : DataFrame
        The part's raw samples, with `residual_N`.
    config : Config
        Folds and seed.
    say : callable
        Told in words what is being done.
    """
    added, after = list(grown.added), grown.after
    whole = fit(after.model, every, after.scatter, turns=1)
    for item in grown.added:
        number = next(k for k, a in enumerate(added) if a is item)
        without = fit(after.model.without_term(number), after.rows, after.scatter, turns=0, friction=after.friction)
        asked = {_way(item.proposal): item.proposal, **_on_other_quantities(item, without)}
        if len(asked) == 1:
            continue
        base = fitted_at(whole.model.without_term(number), every, whole.scatter, whole.friction)
        found = named_among(base, [_of_all(p, every) for p in asked.values()])
        ways = [_way(p) for p in found if p.criterion - found[0].criterion < RIVAL]
        chosen = asked[ways[0]]
        if chosen is item.proposal:
            added[number] = _with_rivals(item, ways)
            continue
        say(f"all strokes say {describe(chosen.term)} rather than {describe(item.proposal.term)}")
        gain = heldout_gain(without, chosen, config.loop.folds, config.loop.seed, samples, {})
        item = replace(item, rivals=(item.proposal, *item.rivals), rivals_rmse_N=(item.left_N, *item.rivals_rmse_N))
        item = replace(item, proposal=chosen, gain_N=gain.rmse_N, left_N=gain.left_N)
        added = [*added[:number], *added[number + 1 :], _with_rivals(item, ways)]
        after, whole = fit(chosen.fitted.model, after.rows, after.scatter, turns=2), found[0].fitted
    return replace(grown, added=tuple(added), after=after), whole


def _on_other_quantities(item: Added, without: Fitted) -> dict[Way, Proposal]:
    """Return an effect on the quantities that its rivals act on, each fitted to the part, by what it acts on."""
    effect, found = item.proposal.term.effect, {}
    if effect.id in PERIODIC:
        return found
    for way in dict.fromkeys(map(_way, item.rivals)):
        if way != _way(item.proposal) and way in effect.acts_on:
            term = replace(item.proposal.term, acts_on=way[0], operation=way[1])
            model = without.model.with_term(term, _values(item.proposal))
            fitted = fit(model, without.rows, without.scatter, turns=0, friction=without.friction)
            found[way] = replace(item.proposal, term=term, fitted=fitted)
    return found


def _of_all(proposal: Proposal, every: Rows) -> Proposal:
    """Return a proposal of a part as one of all strokes, to be fitted."""
    return replace(proposal, units=every.groups.starts[proposal.unit].size, values=_values(proposal), fitted=None)


def _with_rivals(item: Added, ways: list[Way]) -> Added:
    """Return an effect with those of its rivals that act in some ways, and are not itself."""
    rest = [
        (rival, rmse)
        for rival, rmse in zip(item.rivals, item.rivals_rmse_N, strict=True)
        if _way(rival) in ways and rival.term.key() != item.proposal.term.key()
    ]
    return replace(item, rivals=tuple(rival for rival, _ in rest), rivals_rmse_N=tuple(rmse for _, rmse in rest))


def _way(proposal: Proposal) -> Way:
    return proposal.term.acts_on, proposal.term.operation


def _values(proposal: Proposal) -> Mapping[str, float]:
    """Return the numbers of a fitted proposal."""
    return proposal.fitted.model.values[-1]
