"""Renaming of effects that were named while others were still missing.

A missing effect is part of the scatter, so an effect named then is not well distinguished from its rivals. If
a second effect of one channel is found, one effect that fits as well replaces the two.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd

from sealfit.closure.channels import Channel
from sealfit.closure.confirm import AcceptedEffect, Context, confirmed, heldout_gain
from sealfit.closure.criteria import EQUAL_BIC, MOST_PROPOSALS, RIVAL_BIC
from sealfit.closure.forms import main_effects_identifiable, surface_term
from sealfit.closure.linearised import Proposal, linearised
from sealfit.closure.naming import deviance_under, named_among, propose
from sealfit.closure.score_test import Candidate, ScoreTests
from sealfit.closure.search import MAIN_TARGETS, NOT_IN_PAIRS, candidate_of, channel_candidates, search_pairs
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
            if better is None:
                model = without.model.with_term(fitted.model.terms[number], fitted.model.values[number])
                unchanged = replace(item.proposal, fitted=fitted.refitted(model))
                if self._confirmed(without, [unchanged], item.round) is not None:
                    continue
                later = range(number + 1, len(added))
                left = [without, *(fitted.refitted(fitted.model.without_term(k)) for k in later)]
                least = min(range(len(left)), key=lambda k: left[k].deviance)
                fitted = fit(left[least].model, fitted.rows, fitted.scatter, turns=2)
                added = [a for k, a in enumerate(added) if k != number + least]
            elif better.proposal.term.key() != item.proposal.term.key():
                fitted = fit(better.proposal.fitted.model, fitted.rows, fitted.scatter, turns=2)
                added = [*added[:number], *added[number + 1 :], better]
        return fitted, added

    def merged_with_earlier(
        self, fitted: Fitted, added: list[AcceptedEffect], new: AcceptedEffect, *, pending: bool = False
    ) -> tuple[list[AcceptedEffect], AcceptedEffect]:
        """Return the earlier effects and a new one, merged with an earlier one if possible.

        The new one is not in `fitted` yet. A single one that fits as well may be a shape of the same channel
        or of a proportional one, or a product or surface of two channels. While the other effect of a masked
        pair is `pending`, only effects of the new one's own channel are merged with it.
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
        to fit as well, whatever its number of parameters. A surface in place of two such forms must lower the
        held-out error more; in place of a physical effect its BIC must be smaller.
        """
        names = self._channel(earlier), self._channel(new)
        effects = [item.proposal.term.effect for item in (earlier, new)]
        if any(effect.periodic for effect in effects):
            return None
        without = fitted.refitted(fitted.model.without_term(number))
        two, penalties = new.proposal.fitted, new.proposal.bic_penalty + earlier.proposal.bic_penalty
        surfaces = named_among(without, self._surfaces(without, earlier.proposal, new.proposal))
        found: list[Proposal] = []
        if None not in names:
            p_value = min(earlier.proposal.p_value, new.proposal.p_value)
            near = list(dict.fromkeys(names))
            if all(self.channels[name].unit == "sample" for name in names):  # all channels along strokes
                near += [name for name in ALONG if name in self.channels and name not in near]
            found += self._proposals_on(fitted, number, without, near, p_value)
            found += self._products(without, names, p_value)
        better = [p for p in found if _lead(p, two) > p.bic_penalty - penalties - EQUAL_BIC]
        if None not in names and names[0] == names[1] and not any(e.physical for e in effects):
            better = better or [p for p in found if _lead(p, two) > -RIVAL_BIC]
        if any(effect.physical for effect in effects):
            better += [p for p in surfaces if _lead(p, two) > p.bic_penalty - penalties + EQUAL_BIC]
        elif surfaces:
            loop = self.context.config.loop
            gain = partial(heldout_gain, without, loop=loop, samples=self.samples)
            least = gain(new.proposal).rmse_N
            better += [p for p in surfaces if _lead(p, two) > 0 and gain(p).rmse_N > least]
        better = sorted(better, key=lambda p: p.bic)
        return self._confirmed(without, better, new.round) if better else None

    def _products(self, without: Fitted, names: tuple[str, str], p_value: float) -> Sequence[Proposal]:
        """Return forms of two channels together; none if both are the same channel."""
        if names[0] == names[1]:
            return ()
        rng = np.random.default_rng(self.context.config.loop.seed)
        found = search_pairs(ScoreTests(without), [self.channels[name] for name in names], [], rng)
        found = sorted((replace(c, p_value=p_value) for c in found), key=lambda c: -c.chi2)
        return propose(without, found, self.channels, self.context.effects)

    def _surfaces(self, without: Fitted, *parts: Proposal) -> list[Proposal]:
        """Return the likeliest surfaces of two channels of which effects may be parts, not refitted yet.

        Time, distance and position are alternatives of each other. No surface differs between directions, and
        none changes with the calendar, as no pair does.
        """
        names = {name for p in parts for name in p.term.channels}
        along = set(ALONG) if names & set(ALONG) else set()
        near = [c for c in self.channels.values() if c.numeric and c.name in (names | along) - NOT_IN_PAIRS]
        targets = dict.fromkeys((*MAIN_TARGETS, *(p.term.target for p in parts)))
        p_value = min(p.p_value for p in parts)
        found = []
        for pair in itertools.combinations(near, 2):
            own = {channel.name for channel in pair}
            if names <= own | (along if along & own else set()) and main_effects_identifiable(pair, without):
                for target in targets:
                    term = surface_term(*pair, *target)
                    candidate = candidate_of(term, pair, without.rows, p_value)
                    found += linearised(without, term, {}, candidate)
        return sorted(found, key=lambda p: p.bic)[:MOST_PROPOSALS]

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
        same_target = [c for c in found if c.target == own.target][:1]
        own_form = [p for c in same_target for p in linearised(without, own, at_own_values, c)]
        return propose(without, found, self.channels, self.context.effects, own_form)

    def _confirmed(
        self, without: Fitted, proposals: Sequence[Proposal], number: int
    ) -> AcceptedEffect | None:
        self.context.say(f"  round {number} again:")
        return confirmed(without, proposals, self.samples, self.context, number)[0]

    def _channel(self, item: AcceptedEffect) -> str | None:
        """Return the channel along which an effect was found; None for a pair and for a ripple."""
        names = item.proposal.source[0]
        single = len(set(names) - {"direction"}) <= 1 and names[-1] in self.channels
        return names[-1] if single and not item.proposal.term.effect.periodic else None


def _lead(proposal: Proposal, other: Fitted) -> float:
    """Return by how much the deviance of a proposal is below that of another fit.

    Each has its own scatter or the other's, whichever is likelier. Under the scatter of one of them alone,
    what this one does not explain would seem to be scatter.
    """
    own = proposal.fitted
    other_deviance = min(other.deviance, deviance_under(other, own.scatter))
    return other_deviance - min(own.deviance, deviance_under(own, other.scatter))
