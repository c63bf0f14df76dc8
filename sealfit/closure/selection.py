"""Rounds of the loop: search, name, confirm, add, refit and remove effects until nothing is significant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import pandas as pd

from sealfit.closure import criteria
from sealfit.closure.channels import Channel, channels_of, searched
from sealfit.closure.confirm import AcceptedEffect, Context, RefusedEffect, confirmed
from sealfit.closure.forms import AGING, richer_laws
from sealfit.closure.linearised import Proposal
from sealfit.closure.naming import propose, rivals
from sealfit.closure.rename_effects import Renaming
from sealfit.closure.ripple_selection import Ripples
from sealfit.closure.ripples import Peak
from sealfit.closure.score_test import Candidate, ScoreTests
from sealfit.closure.search import (
    MAIN_TARGETS,
    MaskedPair,
    equivalent_pairs,
    search,
    search_masked_pairs,
    search_pairs,
)
from sealfit.fit.joint import Fitted, fit, fit_declared
from sealfit.fit.joint.model import Model
from sealfit.fit.joint.rows import ALONG, Rows
from sealfit.fit.joint.whitening import Scatter
from sealfit.tables import CALENDAR


class StartingFit(NamedTuple):
    """The declared model fitted to more rows, and their scatter."""

    model: Model
    scatter: Scatter


@dataclass(frozen=True)
class Selection:
    """Result of the loop on some rows: both fits, the added effects, and the candidates of the searches."""

    before: Fitted
    after: Fitted
    added: tuple[AcceptedEffect, ...]
    first: tuple[Candidate, ...]  # candidates on the declared model
    last: tuple[Candidate, ...]  # candidates on the final one
    left: Candidate | Peak | None  # still significant, in no model
    inconclusive: AcceptedEffect | None  # best form of an effect that too few specimens show; in no model
    channels: Mapping[str, Channel] = field(default_factory=dict)
    refused: tuple[RefusedEffect, ...] = ()  # significant, in no model
    worse: tuple[RefusedEffect, ...] = ()  # those of them that were removed because they lowered no error

    @property
    def left_over(self) -> tuple[Candidate, ...]:
        """Candidates on the model after; those on the declared one if all effects were removed."""
        return self.last if self.added else self.first


class _SearchResult(NamedTuple):
    """The result of all searches on one model."""

    claimable: list[Candidate]  # single channels that may be claimed
    laws: list[tuple[Candidate, Proposal]]  # richer laws of aging
    pairs: list[Candidate]  # pairs of channels; none if a single channel is significant enough
    significant: list[Candidate]  # single channels and pairs, strongest evidence first
    masked: list[MaskedPair]  # effects that mask each other


def select_effects(
    rows: Rows,
    samples: pd.DataFrame,
    context: Context,
    *,
    fine: Rows | None = None,
    start: StartingFit | None = None,
    rounds: int | None = None,
) -> Selection:
    """Add effects until no channel explains the residual, and return the result.

    The rows are merged along their strokes if there are many; ripples are then fitted to the `fine` ones, and
    fixed. The samples are those of `steady_samples`. From a `start` the declared model needs no search. The
    search of a fold ends after `rounds`; what is left is not determined then.
    """
    loop = _LoopState(rows, samples, context, fine, start)
    last_round = context.config.loop.max_rounds + 2 if rounds is None else rounds
    for number in range(len(loop.added) + 1, last_round + 1):
        if loop.run_round(number):
            break
    return loop.selection(whole=rounds is None)


class _LoopState:
    """State of the loop: the model, the effects added and refused, and the search results on the model."""

    def __init__(
        self,
        rows: Rows,
        samples: pd.DataFrame,
        context: Context,
        fine: Rows | None,
        start: StartingFit | None,
    ) -> None:
        self.rows, self.context = rows, context
        self.rng = np.random.default_rng(self.context.config.loop.seed)
        ripples = Ripples(samples, context)
        self.before = fit_declared(rows) if start is None else fit(start.model, rows, start.scatter, turns=1)
        self.all_channels = {c.name: c for c in channels_of(rows, self.context.config)}
        self.channels = {c.name: c for c in searched(self.all_channels.values(), rows)}
        self.tests = ScoreTests(self.before)
        self.last = self.first = tuple(search(self.tests, list(self.channels.values()), self.rng))
        self.fitted = ripples.added_to(self.before, fine)
        self.added = list(ripples.added)
        self.ripple, self.samples, self.unconfirmed = ripples.found, ripples.samples, ripples.refused
        self.renaming = Renaming(self.channels, self.samples, context)
        self.refused: set[tuple] = set()
        self.negligible: set[tuple] = set()  # those of them that are too small to matter
        self.left: Candidate | Peak | None = None
        self.masked: list[MaskedPair] = []  # effects that mask each other, until both are in the model
        self.renamed = False  # whether earlier effects have been renamed
        self.found: _SearchResult | None = None

    @property
    def alpha(self) -> float:
        """Family-wise error rate of the search."""
        return self.context.config.loop.family_error

    def propose(
        self, base: Fitted, candidates: Sequence[Candidate], also: Sequence[Proposal] = ()
    ) -> list[Proposal]:
        """Return refitted proposals for some candidates, best first."""
        return propose(base, candidates, self.channels, self.context.effects, also)

    def confirm(
        self, base: Fitted, proposals: Sequence[Proposal], number: int
    ) -> tuple[AcceptedEffect | None, list[RefusedEffect]]:
        """Return the first proposal that held-out data confirm; if there is none, those refused."""
        return confirmed(base, proposals, self.samples, self.context, number)

    def run_round(self, number: int) -> bool:
        """Search, name and confirm once; return whether the loop is finished."""
        if self.fitted is not self.tests.fitted:
            self.tests, self.found = ScoreTests(self.fitted), None
            self.last = tuple(search(self.tests, list(self.channels.values()), self.rng))
        if self.found is None:  # else the last round added nothing
            found = self.found = self.search_model()
            self.context.say(
                f"round {number}: {len(self.last)} candidates on {len(self.channels)} channels, "
                f"{len(found.pairs)} on pairs of them; {len(found.significant)} significant, "
                f"{len(found.masked)} mask each other"
            )
            if self.add_pair_of_direction(number):
                return False
        open_ = self.open_candidates()
        if not open_ or number > self.context.config.loop.max_rounds:
            return not self.rename_earlier()
        claimable, laws = self.found.claimable, [p for _, p in self.found.laws]
        open_ += [c for c in _related_candidates(open_, claimable) if c.key not in self.refused]
        proposals = self.propose(self.fitted, open_, laws)
        accepted, failed = self.confirm(self.fitted, proposals, number)
        self.unconfirmed += failed[:1]
        if accepted is None:
            keys = {p.source for p in proposals[: criteria.MOST_PROPOSALS]} or {c.key for c in open_}
            for one in failed:
                if one.negligible:
                    self.negligible |= _no_stronger(open_, one.proposal) | {one.proposal.source}
            if failed and failed[0].negligible:
                keys |= _no_stronger(open_, failed[0].proposal)
                self.negligible |= keys
            self.refused |= keys
            self.masked = []
        else:
            count, deviance = len(self.added), self.fitted.deviance
            self.add(accepted)
            if len(self.added) == count and self.fitted.deviance > deviance - criteria.EQUAL_BIC:
                # It took the place of an earlier one and explains no more: the next round would be the same.
                self.refused |= _no_stronger(open_, accepted.proposal) | {accepted.proposal.source}
        return False

    def search_model(self) -> _SearchResult:
        """Return the result of all searches on the current model."""
        inconsistent = _inconsistent_channels(self.last, self.alpha)
        claimable = _claimable(self.last, inconsistent)
        significant = [c for c in claimable if c.p_value <= self.alpha]
        aged = not significant or any(c.channels == (AGING,) for c in significant)
        laws = richer_laws(self.fitted, self.channels, self.context.effects) if aged else []
        if significant and significant[0].p_value <= criteria.PAIRS_FROM_P:
            return _SearchResult(claimable, laws, [], significant, [])
        pairs = search_pairs(self.tests, list(self.channels.values()), self.last, self.rng)
        pairs = _claimable(pairs, inconsistent)
        level = self.alpha * min((c.p_value for c in significant), default=1.0)
        significant += [c for c in pairs if c.p_value <= level]
        significant = sorted(significant, key=lambda c: c.p_value)
        level = self.alpha * min((c.p_value for c in significant), default=1.0)
        masked = search_masked_pairs(self.tests, self.channels, [*claimable, *pairs], level)
        return _SearchResult(claimable, laws, pairs, significant, masked)

    def add_pair_of_direction(self, number: int) -> bool:
        """Add two effects of the direction that mask each other; return whether that was done."""
        of_direction = (p for p in self.found.masked if {key[0] for key in p.keys} == {("direction",)})
        two = next(of_direction, None)
        if self.masked or two is None:
            return False
        pending = _pending_candidates([two], self.found.claimable)
        both = self.confirmed_pair(pending, number) if len(pending) == 2 else None
        if both:
            later, earlier = both
            own = earlier.proposal.fitted
            self.fitted = own.refitted(own.model.without_term(len(own.model.terms) - 1))
            self.added = [*self.added, later]
            self.add(earlier)
        return bool(both)

    def confirmed_pair(
        self, two: Sequence[Candidate], number: int
    ) -> tuple[AcceptedEffect, AcceptedEffect] | None:
        """Return two effects of which each is confirmed given the other; None if they are not."""
        first, second = two
        base = self.propose(self.fitted, [first])[0].fitted
        later, _ = self.confirm(base, self.propose(base, [second]), number)
        if later is None:
            return None
        alone = later.proposal.fitted.model.without_term(len(self.fitted.model.terms))
        base = fit(alone, self.rows, self.fitted.scatter, turns=1)
        earlier, _ = self.confirm(base, self.propose(base, [first]), number)
        return None if earlier is None else (later, earlier)

    def open_candidates(self) -> list[Candidate]:
        """Return the significant candidates not refused; if there are none, those of masked pairs."""
        found = self.found
        if not self.masked:  # pairs are searched at a level below the p-values of the others
            self.masked = [pair for pair in found.masked if self.refused.isdisjoint(pair.keys)]
        significant = _pending_candidates(self.masked, (*found.claimable, *found.pairs))
        significant = significant or list(found.significant)
        significant += [c for c, _ in found.laws if c.p_value <= self.alpha and c.claimable]
        self.left = next((c for c in significant if c.key not in self.negligible), self.ripple)
        significant += equivalent_pairs(self.tests, significant, self.channels)
        return [c for c in significant if c.key not in self.refused]

    def rename_earlier(self) -> bool:
        """Rename earlier effects given the later ones, once; return whether a name changed."""
        if self.renamed or len(self.added) < 2:
            return False
        self.renamed, before = True, self.added
        self.fitted, self.added = self.renaming.earlier_renamed(self.fitted, self.added)
        if self.added is before:
            return False
        self.fitted, self.added = _remove_redundant(self.fitted, self.added)
        rounds = {a.round for a in self.added}
        self.refused |= {a.proposal.source for a in before if a.round not in rounds}
        return True

    def add(self, accepted: AcceptedEffect) -> None:
        """Add an effect and remove earlier ones that it makes redundant."""
        source, merged = accepted.proposal.source, self.renaming.merged_with_earlier
        self.masked = [pair.without(source) for pair in self.masked if source in pair.keys]
        pending = any(pair.keys for pair in self.masked)
        earlier, accepted = merged(self.fitted, self.added, accepted, pending=pending)
        added = [*earlier, accepted]
        own = accepted.proposal.fitted  # under its own scatter: the former one contains the missing effect
        self.fitted, self.added = _remove_redundant(fit(own.model, self.rows, own.scatter, turns=2), added)
        # A removed effect is not added again.
        self.refused |= {a.proposal.source for a in added if all(a is not k for k in self.added)}

    def selection(self, *, whole: bool) -> Selection:
        """Return the result of the loop; for a fold, without what is left."""
        added = tuple(self.added)
        after = self.fitted if added else self.before
        found = Selection(self.before, after, added, self.first, self.last, None, None, self.all_channels)
        if not whole:
            return found
        left, inconclusive = self.left, None
        if isinstance(left, Candidate) and left.key in self.refused and left.p_value > criteria.WEAK_P:
            left = None  # it is listed as refused
        laws = self.found.laws
        tested = (*self.last, *(c for c, _ in laws))
        unclaimable = [c for c in tested if c.p_value <= self.alpha and not c.claimable]
        if left is None and unclaimable:
            left = unclaimable[0]
            # No form can be fitted along three days beside the aging law, for example.
            if proposals := self.propose(self.fitted, unclaimable, [p for _, p in laws]):
                others = tuple((rival, np.nan) for rival in rivals(proposals[0], proposals))
                inconclusive = AcceptedEffect(proposals[0], np.nan, np.nan, others, len(added) + 1)
        return replace(found, left=left, inconclusive=inconclusive, refused=tuple(self.unconfirmed))


def _inconsistent_channels(candidates: Sequence[Candidate], alpha: float) -> set[str]:
    """Return the significant channels whose slopes are not consistent between two to four specimens.

    Their strongest candidate on mu or the force decides: on a wrong quantity the same effect differs by
    specimen.
    """
    known = [c for c in candidates if c.p_value <= alpha and c.target in MAIN_TARGETS]
    strongest = {c.channels[-1]: c for c in reversed(known)}  # they are sorted, strongest evidence first
    return {name for name, c in strongest.items() if not c.consistent} - {"direction"}


def _claimable(candidates: Sequence[Candidate], inconsistent: set[str]) -> list[Candidate]:
    """Return the candidates that may be claimed and are of no inconsistent channel."""
    return [c for c in candidates if c.claimable and inconsistent.isdisjoint(c.channels)]


def _pending_candidates(masked: Sequence[MaskedPair], candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the linear candidates of masked pairs that are not in the model yet, with the pair's p-value."""
    pairs = {key: pair for pair in reversed(masked) for key in pair.keys}
    found = []
    for c in candidates:
        if c.key in pairs and c.straight:
            chi2 = max(c.chi2, *(pair.chi2 for pair in masked if c.key in pair.keys))
            p_value = min(c.p_value, pairs[c.key].p_value)
            found.append(replace(c, test_result=c.test_result._replace(chi2=chi2), p_value=p_value))
    found = [c for c in found if c.evidence > 0]  # else it is explained by effects in the model
    return sorted(found, key=lambda c: c.p_value)


def _related_candidates(significant: list[Candidate], candidates: list[Candidate]) -> list[Candidate]:
    """Return further candidates that may explain the same structure as the significant ones.

    The same channel on other quantities is one: the fits decide on which it acts. So are the channels along
    strokes: time, distance and position are the same there but for the speed. Conditions that explain half of
    what the calendar does on the same quantity are others: they are tested one after the other, so the
    calendar is correlated with them, and a dozen specimens may give too little evidence.
    """
    found = []
    keys = {c.key for c in significant}
    for strong in significant:
        for c in candidates:
            same_target = c.target == strong.target
            condition = strong.channels[0] in CALENDAR and c.unit == "specimen" and same_target
            one, other = c.channels[-1], strong.channels[-1]
            same_channel = one == other or {one, other} <= set(ALONG)
            alike = not (c.pair or strong.pair) and c.columns.shape == strong.columns.shape
            near = c.chi2 >= criteria.HALF_OF_CALENDAR * strong.chi2
            if (condition or (same_channel and alike)) and near and c.key not in keys:
                found.append(replace(c, p_value=strong.p_value))
                keys.add(c.key)
    return found


def _no_stronger(candidates: Sequence[Candidate], proposal: Proposal) -> set[tuple]:
    """Return the keys of candidates that share a channel with a proposal and explain no more than it does."""
    names = set(proposal.term.channels)
    return {c.key for c in candidates if names & set(c.channels) and c.chi2 <= proposal.chi2}


def _remove_redundant(fitted: Fitted, added: list[AcceptedEffect]) -> tuple[Fitted, list[AcceptedEffect]]:
    """Return the fit without effects that a later one has made redundant by the BIC, the weakest first.

    Ripples that bins do not resolve are kept: they were tested on the raw samples.
    """
    without, worth = {}, {}
    for k in range(len(added) - 1):
        if not _finer_than_bins(fitted, k):
            without[k] = fitted.refitted(fitted.model.without_term(k))
            worth[k] = without[k].deviance - fitted.deviance - added[k].proposal.bic_penalty
    k = min(worth, key=worth.get, default=None)
    if k is None or worth[k] >= 0:
        return fitted, added
    fitted = fit(without[k].model, fitted.rows, fitted.scatter, turns=1)
    return _remove_redundant(fitted, [*added[:k], *added[k + 1 :]])


def _finer_than_bins(fitted: Fitted, number: int) -> bool:
    """Whether a term is periodic, with too few bins a wavelength to show the wave."""
    effect, values = fitted.model.terms[number].effect, fitted.model.values[number]
    if not effect.periodic:
        return False
    width = float(np.median(np.abs(fitted.rows.bin_width(fitted.model.terms[number].channels[0]))))
    return values["lambda_"] < criteria.BINS_PER_WAVE * width
