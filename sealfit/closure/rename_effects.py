"""Renaming of effects that were named while others were still missing.

A missing effect is part of the scatter, so an effect named then is not well distinguished from its rivals: a
factor from an added force, a line from a logarithm. If a second effect of one channel is found, the first was
not its whole shape: one effect that fits as well replaces the two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from sealfit.closure.channels import Channel
from sealfit.closure.confirm import AcceptedEffect, Context, confirmed
from sealfit.closure.criteria import EQUAL_BIC, RIVAL_BIC
from sealfit.closure.linearised import Linearised, Proposal
from sealfit.closure.naming import propose
from sealfit.closure.score_test import Candidate, ScoreTests
from sealfit.closure.search import channel_candidates, search_pairs
from sealfit.fit.joint import Fitted, fit
from sealfit.fit.joint.rows import ALONG


@dataclass(frozen=True)
class Renaming:
    """What renaming an effect needs besides the model."""

    channels: Mapping[str, Channel]
    samples: pd.DataFrame  # raw, with `residual_N`
    context: Context

    def earlier_renamed(
        self, fitted: Fitted, added: list[AcceptedEffect]
    ) -> tuple[Fitted, list[AcceptedEffect]]:
        """Return a fit and its effects, each but the last renamed given all others.

        An effect that keeps its name was confirmed while others were missing. If it has no gain on held-out
        data given the others, it or a later one is removed: the one that explains least.
        """
        for item in added[:-1]:
            number = next((k for k, a in enumerate(added) if a is item), None)
            name = self._channel(item)
            if name is None or number is None:
                continue
            without = fitted.refitted(fitted.model.without_term(number))
            proposals = self._proposals_on(fitted, number, without, [name], item.proposal.p_value)
            # A grid may rank the right form of a large missing effect too low for it to be refitted.
            if not proposals or proposals[0].bic > fitted.deviance + item.proposal.bic_penalty + RIVAL_BIC:
                continue
            same = proposals[0].term.key() == item.proposal.term.key()
            better = self._confirmed(without, proposals[:1] if same else proposals, item.round)
            if better is None and self._unchanged(without, fitted, number, item) is None:
                later = range(number + 1, len(added))
                left = [without, *(fitted.refitted(fitted.model.without_term(k)) for k in later)]
                least = min(range(len(left)), key=lambda k: left[k].deviance)
                fitted = fit(left[least].model, fitted.rows, fitted.scatter, turns=2)
                added = [a for k, a in enumerate(added) if k != number + least]
            elif better is not None and better.proposal.term.key() != item.proposal.term.key():
                fitted = fit(better.proposal.fitted.model, fitted.rows, fitted.scatter, turns=2)
                added = [*added[:number], *added[number + 1 :], better]
        return fitted, added

    def _unchanged(
        self, without: Fitted, fitted: Fitted, number: int, item: AcceptedEffect
    ) -> AcceptedEffect | None:
        """Return an effect of a fit with its own name, confirmed given the others; None if not confirmed."""
        model = without.model.with_term(fitted.model.terms[number], fitted.model.values[number])
        own = replace(item.proposal, fitted=fitted.refitted(model))
        return self._confirmed(without, [own], item.round)

    def merged_with_earlier(
        self, fitted: Fitted, added: list[AcceptedEffect], new: AcceptedEffect, *, pending: bool = False
    ) -> tuple[list[AcceptedEffect], AcceptedEffect]:
        """Return the earlier effects and a new one, merged with an earlier one if possible.

        The new one is not in `fitted` yet. Two effects are merged if a single one fits as well: a shape of
        the same channel or of a proportional one, or a product of two channels. While the other effect of a
        masked pair is `pending`, only effects of the new one's own channel are merged with it.
        """
        for number, earlier in enumerate(added):
            if pending and self._channel(earlier) != self._channel(new):
                continue
            one = self._single_effect(fitted, number, earlier, new)
            if one is not None:
                return [*added[:number], *added[number + 1 :]], one
        return added, new

    def _single_effect(
        self, fitted: Fitted, number: int, earlier: AcceptedEffect, new: AcceptedEffect
    ) -> AcceptedEffect | None:
        """Return one effect that fits as well as an earlier and a new one; None if there is none.

        Two forms of one channel that are no physical effects are one shape: then the single effect only has
        to fit as well, whatever its number of parameters.
        """
        names = self._channel(earlier), self._channel(new)
        if None in names:
            return None
        without = fitted.refitted(fitted.model.without_term(number))
        p_value = min(earlier.proposal.p_value, new.proposal.p_value)
        proposals = self._proposals_on(fitted, number, without, self._channels_near(*names), p_value)
        proposals = sorted([*proposals, *self._products(without, names, p_value)], key=lambda p: p.bic)
        two = new.proposal.bic + earlier.proposal.bic_penalty
        better = [p for p in proposals[:1] if p.bic < two + EQUAL_BIC]
        pieces = names[0] == names[1] and not any(a.proposal.term.effect.physical for a in (earlier, new))
        if pieces and not better:
            penalties = new.proposal.bic_penalty + earlier.proposal.bic_penalty
            fitting = [p for p in proposals if p.bic - p.bic_penalty < two - penalties + RIVAL_BIC]
            better = sorted(fitting, key=lambda p: p.bic)[:1]
        return self._confirmed(without, better, new.round) if better else None

    def _channels_near(self, *names: str) -> list[str]:
        """Return the channels of two effects; if both vary along strokes, all channels that do."""
        found = list(dict.fromkeys(names))
        if all(self.channels[name].unit == "sample" for name in names):
            found += [name for name in ALONG if name in self.channels and name not in found]
        return found

    def _products(self, without: Fitted, names: tuple[str, str], p_value: float) -> Sequence[Proposal]:
        """Return forms of two channels together; none if both are the same channel."""
        if names[0] == names[1]:
            return ()
        rng = np.random.default_rng(self.context.config.loop.seed)
        found = search_pairs(ScoreTests(without), [self.channels[name] for name in names], [], rng)
        found = sorted((replace(c, p_value=p_value) for c in found), key=lambda c: -c.chi2)
        return propose(without, found, self.channels, self.context.effects)

    def _proposals_on(
        self, fitted: Fitted, number: int, without: Fitted, names: Sequence[str], p_value: float
    ) -> Sequence[Proposal]:
        """Return proposals that may replace a term, on some channels, from the fit `without` it."""
        finest: dict[tuple, Candidate] = {}
        tests = ScoreTests(without)
        for c in (c for name in names for c in channel_candidates(tests, self.channels[name])):
            if c.key not in finest or c.test_result.df > finest[c.key].test_result.df:
                finest[c.key] = replace(c, p_value=p_value)
        found = sorted(finest.values(), key=lambda c: -c.chi2)
        own, values = fitted.model.terms[number], fitted.model.values[number]
        at_own_values = {p.name: (values[p.name],) for p in own.effect.nonlinear}
        same_target = next((c for c in found if c.target == own.target), None)
        own_form = Linearised(without)(own, at_own_values, same_target) if same_target is not None else ()
        return propose(without, found, self.channels, self.context.effects, own_form)

    def _confirmed(
        self, without: Fitted, proposals: Sequence[Proposal], number: int
    ) -> AcceptedEffect | None:
        self.context.say(f"  round {number} again:")
        return confirmed(without, proposals, self.samples, self.context, number, [])

    def _channel(self, item: AcceptedEffect) -> str | None:
        """Return the channel along which an effect was found; None for a pair and for a ripple."""
        names = item.proposal.source[0]
        single = len(set(names) - {"direction"}) <= 1 and names[-1] in self.channels
        return names[-1] if single and not item.proposal.term.effect.periodic else None
