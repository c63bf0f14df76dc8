"""What an effect is and on which quantity it acts, told by all strokes: a part of them may not tell."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import pandas as pd

from sealfit.closure.confirm import COMPARED, Added, heldout_gain
from sealfit.closure.forms import PERIODIC, describe
from sealfit.closure.grow import Grown
from sealfit.closure.linearised import Proposal
from sealfit.closure.naming import RIVAL, named_among
from sealfit.config import Config
from sealfit.fit.estimate import Fitted, fit, fitted_at
from sealfit.fit.rows import Rows

Way = tuple[str, str]  # what an effect acts on, and how


def told_by_all(
    grown: Grown, every: Rows, samples: pd.DataFrame, config: Config, say: Callable[[str], None]
) -> tuple[Grown, Fitted]:
    """Return what the search of a part came to, and its final model fitted to all strokes.

    An effect is held against its first rivals, and what comes out against itself on the quantities that its rivals act
    on, each time on all strokes; rivals on quantities that these rule out are none any more. A ripple was judged on
    samples, and stays.

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
    for first in (a for a in grown.added if a.rivals and not _periodic(a.proposal)):
        item = first
        for others_of in (_first_rivals, _on_other_quantities):
            number = next(k for k, a in enumerate(added) if a is item)
            asked = [item.proposal, *others_of(item)]
            if len(asked) == 1:
                continue
            base = fitted_at(whole.model.without_term(number), every, whole.scatter, whole.friction)
            found = named_among(base, [_of_all(p, every) for p in asked])
            chosen = next(p for p in asked if p.term is found[0].term)
            if chosen is not item.proposal:
                say(f"all strokes say {describe(chosen.term)} rather than {describe(item.proposal.term)}")
                item, after = _instead(item, chosen, after, number, samples, config)
                added, whole = [*added[:number], *added[number + 1 :], item], found[0].fitted
            if others_of is _on_other_quantities:
                left = [_way(p) for p in found if p.criterion - found[0].criterion < RIVAL]
                number = next(k for k, a in enumerate(added) if a is item)
                added[number] = item = _with_rivals(item, [r for r in _rivals(item) if _way(r[0]) in left])
    return replace(grown, added=tuple(added), after=after), whole


def _first_rivals(item: Added) -> list[Proposal]:
    """Return the first rivals of an effect."""
    return [rival for rival in item.rivals[:COMPARED] if not _periodic(rival)]


def _on_other_quantities(item: Added) -> list[Proposal]:
    """Return an effect on the quantities that its rivals act on, to begin where it stands."""
    term = item.proposal.term
    ways = (way for way in dict.fromkeys(map(_way, item.rivals)) if way != _way(item.proposal))
    return [
        replace(item.proposal, term=replace(term, acts_on=way[0], operation=way[1]))
        for way in ways
        if way in term.effect.acts_on
    ]


def _instead(
    item: Added, chosen: Proposal, after: Fitted, number: int, samples: pd.DataFrame, config: Config
) -> tuple[Added, Fitted]:
    """Return an effect with another proposal in its place and its own among the rivals, and the part's fit with it."""
    rows, scatter, friction = after.rows, after.scatter, after.friction
    without = fit(after.model.without_term(number), rows, scatter, turns=0, friction=friction)
    model = without.model.with_term(chosen.term, _values(chosen))
    chosen = replace(chosen, fitted=fit(model, rows, scatter, turns=0, friction=friction))
    gain = heldout_gain(without, chosen, config.loop.folds, config.loop.seed, samples, {})
    rest = [r for r in _rivals(item) if r[0].term is not chosen.term]
    item = _with_rivals(item, [(item.proposal, item.left_N), *rest])
    after = fit(chosen.fitted.model, rows, scatter, turns=2)
    return replace(item, proposal=chosen, gain_N=gain.rmse_N, left_N=gain.left_N), after


def _periodic(proposal: Proposal) -> bool:
    return proposal.term.effect.id in PERIODIC


def _rivals(item: Added) -> list[tuple[Proposal, float]]:
    """Return the rivals of an effect that are not itself, and their RMSE."""
    pairs = zip(item.rivals, item.rivals_rmse_N, strict=True)
    return [(rival, rmse) for rival, rmse in pairs if rival.term.key() != item.proposal.term.key()]


def _with_rivals(item: Added, rivals: list[tuple[Proposal, float]]) -> Added:
    return replace(item, rivals=tuple(r for r, _ in rivals), rivals_rmse_N=tuple(rmse for _, rmse in rivals))


def _of_all(proposal: Proposal, every: Rows) -> Proposal:
    """Return a proposal of a part as one of all strokes, to be fitted."""
    return replace(proposal, units=every.groups.starts[proposal.unit].size, values=_values(proposal), fitted=None)


def _way(proposal: Proposal) -> Way:
    return proposal.term.acts_on, proposal.term.operation


def _values(proposal: Proposal) -> Mapping[str, float]:
    """Return the numbers of a fitted proposal."""
    return proposal.fitted.model.values[-1]
