"""Effects asked again: what was named while others were still missing may read otherwise beside them.

While an effect is missing it stands in the scatter, and one that is named then is told from its rivals less well than
the data allow: a factor from an added force, a line from a logarithm. Where a second effect of one channel is found,
the first was not its whole shape: one effect that does as well as the two says so better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import pandas as pd

from sealfit.closure.channels import Channel
from sealfit.closure.confirm import AcceptedEffect, Context, confirmed
from sealfit.closure.criteria import RIVAL, TIED
from sealfit.closure.linearised import Linearised, Proposal
from sealfit.closure.naming import propose
from sealfit.closure.score_test import Candidate, ScoreTests
from sealfit.closure.search import of_channel
from sealfit.fit.joint.estimate import Fitted, fit


@dataclass(frozen=True)
class Renaming:
    """What naming an effect anew needs besides the model.

    Parameters
    ----------
    channels : mapping
        Channels by name.
    samples : DataFrame
        Raw samples with `residual_N`.
    context : Context
        The catalogue, folds, seed and units.
    """

    channels: Mapping[str, Channel]
    samples: pd.DataFrame
    context: Context

    def all_but_last(self, fitted: Fitted, added: list[AcceptedEffect]) -> tuple[Fitted, list[AcceptedEffect]]:
        """Return a fit and its effects with each but the last named anew beside all the others."""
        for item in added[:-1]:
            number = next(k for k, a in enumerate(added) if a is item)
            without, proposals = self._anew(fitted, number, item)
            if not proposals or proposals[0].term.key() == item.proposal.term.key():
                continue
            # While it is missing, what stood for most of the residual may rank too low on a grid to be refitted.
            if proposals[0].bic > fitted.deviance + item.proposal.bic_penalty + RIVAL:
                continue
            better = self._confirmed(without, proposals, item.round)
            if better is not None and better.proposal.term.key() != item.proposal.term.key():
                fitted = fit(better.proposal.fitted.model, fitted.rows, fitted.scatter, turns=2)
                added = [*added[:number], *added[number + 1 :], better]
        return fitted, added

    def one_for_two(
        self, fitted: Fitted, added: list[AcceptedEffect], new: AcceptedEffect
    ) -> tuple[list[AcceptedEffect], AcceptedEffect]:
        """Return earlier effects and a new one that is not in `fitted` yet.

        An earlier effect of the same channel goes where one alone, of another shape, does as well as the two. Two forms
        that are no mechanism are one shape in two pieces: then it is enough that the one fits as well, whatever the
        number of its knots.
        """
        name = self._channel(new)
        number = next((k for k, a in enumerate(added) if name is not None and self._channel(a) == name), None)
        if number is None or name == "direction":
            return added, new
        without, proposals = self._anew(fitted, number, new)
        two = new.proposal.bic + added[number].proposal.bic_penalty
        better = [p for p in proposals[:1] if p.bic < two + TIED]
        if not (better or any(a.proposal.term.effect.physical for a in (added[number], new))):
            pieces = new.proposal.bic_penalty + added[number].proposal.bic_penalty
            fitting = [p for p in proposals if p.bic - p.bic_penalty < two - pieces + RIVAL]
            better = sorted(fitting, key=lambda p: p.bic)[:1]
        one = self._confirmed(without, better, new.round) if better else None
        return (added, new) if one is None else ([*added[:number], *added[number + 1 :]], one)

    def _anew(self, fitted: Fitted, number: int, item: AcceptedEffect) -> tuple[Fitted, Sequence[Proposal]]:
        """Return the fit without a term, and what may stand in its place on the channel of `item`."""
        name = self._channel(item)
        if name is None:
            return fitted, ()
        without = fit(fitted.model.without_term(number), fitted.rows, fitted.scatter, turns=0, friction=fitted.friction)
        finest: dict[tuple, Candidate] = {}
        for c in of_channel(ScoreTests(without), self.channels[name]):
            if c.key not in finest or c.test_result.df > finest[c.key].test_result.df:
                finest[c.key] = replace(c, p_value=item.proposal.p_value)
        found = sorted(finest.values(), key=lambda c: -c.chi2)
        own, values = fitted.model.terms[number], fitted.model.values[number]
        there = {p.name: (values[p.name],) for p in own.effect.nonlinear}
        alike = next((c for c in found if (c.acts_on, c.operation) == (own.acts_on, own.operation)), None)
        as_it_is = Linearised(without)(own, there, alike) if alike is not None else ()
        return without, propose(without, found, self.channels, self.context.effects, as_it_is)

    def _confirmed(self, without: Fitted, proposals: Sequence[Proposal], number: int) -> AcceptedEffect | None:
        self.context.say(f"  round {number} again:")
        return confirmed(without, proposals, self.samples, self.context, number, [])

    def _channel(self, item: AcceptedEffect) -> str | None:
        """Return the channel along which an effect was found; None for a pair and for a ripple."""
        names = item.proposal.source[0]
        single = len(set(names) - {"direction"}) <= 1 and names[-1] in self.channels
        return names[-1] if single and not item.proposal.term.effect.periodic else None
