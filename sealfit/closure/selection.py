"""Round after round: search, name, confirm, add, refit, drop what became needless, until nothing is left."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import pandas as pd

from sealfit.closure.channels import CALENDAR, Channel, channels_of
from sealfit.closure.confirm import AcceptedEffect, Context, RefusedEffect, confirmed
from sealfit.closure.criteria import DOUBTFUL, HALF_OF_CALENDAR, TRIES, WEAK
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
    pairs_in_disguise,
    search,
    search_masked_pairs,
    search_pairs,
)
from sealfit.effects.contract import Effect
from sealfit.fit.joint.estimate import Fitted, fit, fit_declared
from sealfit.fit.joint.model import Model, evaluate
from sealfit.fit.joint.rows import Rows
from sealfit.fit.joint.whitening import Scatter
from sealfit.ingest.stored_parts import StoredTraces, a_part_at_a_time, stroke_index, strokes_of

SAMPLED = ("displacement_mm", "time_s", "force_N")  # what the ripple search reads of a sample


class Start(NamedTuple):
    """The declared model as it was fitted to more rows, and their scatter."""

    model: Model
    scatter: Scatter


@dataclass(frozen=True)
class Selection:
    """The end of the loop on some rows: both fits, what was added, and what the last searches found."""

    before: Fitted
    after: Fitted
    added: tuple[AcceptedEffect, ...]
    first: tuple[Candidate, ...]  # candidates on the declared model
    last: tuple[Candidate, ...]  # candidates on the final one
    left: Candidate | Peak | None  # what is still significant
    unsure: AcceptedEffect | None  # the best form of what too few specimens show; not in any model
    channels: Mapping[str, Channel] = field(default_factory=dict)
    refused: tuple[RefusedEffect, ...] = ()  # significant, and in no model
    worse: tuple[RefusedEffect, ...] = ()  # of these, what was in the model and lowered no error


class _Shown(NamedTuple):
    """What the searches show on one model."""

    claimable: list[Candidate]  # single channels, sure and not doubted
    laws: list[tuple[Candidate, Proposal]]  # richer laws of aging
    pairs: list[Candidate]  # pairs of channels; none where a single one is sure enough
    significant: list[Candidate]  # single channels and pairs, strongest evidence first
    hidden: list[MaskedPair]  # effects that hide each other


def grow(
    rows: Rows,
    samples: pd.DataFrame,
    context: Context,
    *,
    fine: Rows | None = None,
    start: Start | None = None,
    rounds: int | None = None,
) -> Selection:
    """Return the model grown until no channel orders its residual.

    Parameters
    ----------
    rows : Rows
        Bins as arrays, merged along their strokes where there are many.
    samples : DataFrame
        Steady samples for the ripple search: as `steady_samples` gives them.
    context : Context
        Levels of error, rounds, folds, and the catalogue.
    fine : Rows, optional
        The bins as they are, to fit ripples to, which merged bins would blur; they are held as found there.
    start : Start, optional
        Where the fit of the declared model begins, so that it need not search again.
    rounds : int, optional
        Rounds after which a fold's search ends: nothing is asked then but what effects it adds, not for what is left.
    """
    growth = _Growth(rows, samples, context, fine, start)
    last_round = context.config.loop.max_rounds + 2 if rounds is None else rounds
    for number in range(len(growth.added) + 1, last_round + 1):
        if growth.has_ended(number):
            break
    return growth.selection(whole=rounds is None)


class _Growth:
    """The loop while it goes on: the model, what was added and refused, and what the searches show on the model."""

    def __init__(
        self, rows: Rows, samples: pd.DataFrame, context: Context, fine: Rows | None, start: Start | None
    ) -> None:
        self.rows, self.context = rows, context
        self.rng = np.random.default_rng(self.context.config.loop.seed)
        ripples = Ripples(samples, context)
        self.before = fit_declared(rows) if start is None else fit(start.model, rows, start.scatter, turns=1)
        self.channels = {c.name: c for c in channels_of(rows, self.context.config)}
        self.judge = ScoreTests(self.before)
        self.last = self.first = self.searched()
        self.fitted = ripples.added_to(self.before, fine)
        self.added = list(ripples.added)
        self.ripple, self.samples, self.not_confirmed = ripples.found, ripples.samples, ripples.refused
        self.renaming = Renaming(self.channels, self.samples, context)
        self.refused: set[tuple] = set()
        self.left: Candidate | Peak | None = None
        self.hidden: list[MaskedPair] = []  # effects that hide each other, until both are in the model
        self.renamed = False  # whether earlier effects have been named anew
        self.shown: _Shown | None = None

    @property
    def alpha(self) -> float:
        """Level of error of the whole search."""
        return self.context.config.loop.family_error

    def searched(self) -> tuple[Candidate, ...]:
        """Return every candidate of a single channel on the present model."""
        return tuple(search(self.judge, list(self.channels.values()), self.rng))

    def ask(
        self, base: Fitted, proposals: Sequence[Proposal], number: int, failed: list[RefusedEffect]
    ) -> AcceptedEffect | None:
        """Return the first of some proposals that held-out data confirm; what they refuse is added to `failed`."""
        return confirmed(base, proposals, self.samples, self.context, number, failed)

    def has_ended(self, number: int) -> bool:
        """Search, name and confirm once; return whether nothing is left to be done."""
        if self.fitted is not self.judge.fitted:
            self.judge, self.shown = ScoreTests(self.fitted), None
            self.last = self.searched()
        if self.shown is None:  # else the last round refused what it was shown, and the model is as it was
            self.shown = self.look(number)
            if self.adds_two_of_direction(number):
                return False
        open_ = self.open_candidates()
        if not open_ or number > self.context.config.loop.max_rounds:
            return not self.renames()
        claimable, laws = self.shown.claimable, [p for _, p in self.shown.laws]
        open_ += [c for c in _standing_for(open_, claimable) if c.key not in self.refused]
        proposals = propose(self.fitted, open_, self.channels, self.context.effects, laws)
        accepted = self.ask(self.fitted, proposals, number, self.not_confirmed)
        if accepted is None:
            self.refused |= {p.source for p in proposals[:TRIES]} or {c.key for c in open_}
            self.hidden = []
        else:
            self.add(accepted)
        return False

    def look(self, number: int) -> _Shown:
        """Return what the present model lacks."""
        shown = _shown(self.judge, self.last, self.channels, self.context.effects, self.alpha, self.rng)
        tried = f"{len(self.last)} candidates on {len(self.channels)} channels, {len(shown.pairs)} on pairs of them"
        self.context.say(
            f"round {number}: {tried}; {len(shown.significant)} significant, {len(shown.hidden)} hide each other"
        )
        return shown

    def adds_two_of_direction(self, number: int) -> bool:
        """Whether two effects of the direction, which hid each other, were added."""
        two = next((pair for pair in self.shown.hidden if {key[0] for key in pair.keys} == {("direction",)}), None)
        if self.hidden or two is None:
            return False
        awaited = _awaited([two], self.shown.claimable)
        both = _both(self.fitted, awaited, self.channels, self.context.effects, self.ask, number)
        if both:
            later, earlier = both
            own = earlier.proposal.fitted
            without = own.model.without_term(len(own.model.terms) - 1)
            self.fitted = fit(without, self.rows, own.scatter, turns=0, friction=own.friction)
            self.added = [*self.added, later]
            self.add(earlier)
        return bool(both)

    def open_candidates(self) -> list[Candidate]:
        """Return what is significant and not refused; those of effects that hide each other where nothing else is."""
        shown = self.shown
        if not (self.hidden or shown.significant):
            self.hidden = [pair for pair in shown.hidden if self.refused.isdisjoint(pair.keys)]
        significant = _awaited(self.hidden, (*shown.claimable, *shown.pairs)) or list(shown.significant)
        significant += [c for c, _ in shown.laws if c.p_value <= self.alpha and c.sure]
        self.left = significant[0] if significant else self.ripple
        significant += pairs_in_disguise(self.judge, significant, self.channels)
        return [c for c in significant if c.key not in self.refused]

    def renames(self) -> bool:
        """Name earlier effects anew beside the later ones, once; return whether one has another name."""
        if self.renamed or len(self.added) < 2:
            return False
        self.renamed, before = True, self.added
        self.fitted, self.added = self.renaming.all_but_last(self.fitted, self.added)
        if self.added is before:
            return False
        self.fitted, self.added = _drop_needless(self.fitted, self.added)
        rounds = {a.round for a in self.added}
        self.refused |= {a.proposal.source for a in before if a.round not in rounds}
        return True

    def add(self, accepted: AcceptedEffect) -> None:
        """Add an effect; drop what it makes needless."""
        source = accepted.proposal.source
        self.hidden = [pair.without(source) for pair in self.hidden if source in pair.keys]
        awaited = any(pair.keys for pair in self.hidden)
        earlier, accepted = self.renaming.one_for_two(self.fitted, self.added, accepted, awaited=awaited)
        added = [*earlier, accepted]
        own = accepted.proposal.fitted  # under its own scatter: in that of before stands what was missing
        self.fitted, self.added = _drop_needless(fit(own.model, self.rows, own.scatter, turns=2), added)
        # What came and went does not come again.
        self.refused |= {a.proposal.source for a in added if all(a is not k for k in self.added)}

    def selection(self, *, whole: bool) -> Selection:
        """Return the end of the loop; without what is left where not the whole campaign was searched."""
        added = tuple(self.added)
        after = self.fitted if added else self.before
        found = Selection(self.before, after, added, self.first, self.last, None, None, self.channels)
        if not whole:
            return found
        left, unsure = self.left, None
        if isinstance(left, Candidate) and left.key in self.refused and left.p_value > WEAK:
            left = None  # it is listed as refused
        laws = self.shown.laws
        doubtful = [c for c in (*self.last, *(c for c, _ in laws)) if c.p_value <= self.alpha and not c.sure]
        if left is None and doubtful:
            proposals = propose(self.fitted, doubtful, self.channels, self.context.effects, [p for _, p in laws])
            others = tuple(rivals(proposals[0], proposals))
            left = doubtful[0]
            unsure = AcceptedEffect(proposals[0], np.nan, np.nan, others, (np.nan,) * len(others), len(added) + 1)
        return replace(found, left=left, unsure=unsure, refused=tuple(self.not_confirmed))


def _shown(
    judge: ScoreTests,
    last: Sequence[Candidate],
    channels: Mapping[str, Channel],
    effects: Mapping[str, Effect],
    alpha: float,
    rng: np.random.Generator,
) -> _Shown:
    """Return what a model lacks by the search of single channels, `last`, and by those that come after it."""
    doubted = _doubted(last, alpha)
    claimable = _claimable(last, doubted)
    significant = [c for c in claimable if c.p_value <= alpha]
    aged = not significant or any(c.channels == (AGING,) for c in significant)
    laws = richer_laws(judge.fitted, channels, effects) if aged else []
    if significant and significant[0].p_value <= DOUBTFUL:
        return _Shown(claimable, laws, [], significant, [])
    pairs = _claimable(search_pairs(judge, list(channels.values()), last, rng), doubted)
    level = alpha * min((c.p_value for c in significant), default=1.0)
    significant = sorted([*significant, *(c for c in pairs if c.p_value <= level)], key=lambda c: c.p_value)
    level = alpha * min((c.p_value for c in significant), default=1.0)
    hidden = search_masked_pairs(judge, channels, [*claimable, *pairs], level)
    return _Shown(claimable, laws, pairs, significant, hidden)


def _both(
    fitted: Fitted,
    two: Sequence[Candidate],
    channels: Mapping[str, Channel],
    effects: Mapping[str, Effect],
    ask: Callable[..., AcceptedEffect | None],
    number: int,
) -> list[AcceptedEffect]:
    """Return two effects, each confirmed beside the other, as neither predicts held-out data alone; nothing if not."""
    if len(two) < 2:
        return []
    first, second = two
    base = propose(fitted, [first], channels, effects)[0].fitted
    later = ask(base, propose(base, [second], channels, effects), number, [])
    if later is None:
        return []
    alone = later.proposal.fitted.model.without_term(len(fitted.model.terms))
    base = fit(alone, fitted.rows, fitted.scatter, turns=1)
    earlier = ask(base, propose(base, [first], channels, effects), number, [])
    return [] if earlier is None else [later, earlier]


def _doubted(candidates: Sequence[Candidate], alpha: float) -> set[str]:
    """Return the channels along which a few specimens differ: it may be their scatter, whatever quantity it acts on.

    The strongest evidence on mu or the force counts, as on a wrong quantity the same effect looks different in each.
    """
    strongest: dict[str, Candidate] = {}
    for c in candidates:  # strongest evidence first
        if c.p_value <= alpha and (c.acts_on, c.operation) in MAIN_TARGETS:
            strongest.setdefault(c.channels[-1], c)
    return {name for name, c in strongest.items() if not c.agrees} - {"direction"}


def _claimable(candidates: Sequence[Candidate], doubted: set[str]) -> list[Candidate]:
    """Return the candidates that are sure and of no doubted channel, whatever they act on."""
    return [c for c in candidates if c.sure and doubted.isdisjoint(c.channels)]


def _awaited(hidden: Sequence[MaskedPair], candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the straight candidates of hidden pairs that are not in the model yet, with the p-value of the pair."""
    pairs = {key: pair for pair in reversed(hidden) for key in pair.keys}
    found = []
    for c in candidates:
        if c.key in pairs and c.columns.shape[1] == 1:
            chi2 = max(c.chi2, *(pair.chi2 for pair in hidden if c.key in pair.keys))
            p_value = min(c.p_value, pairs[c.key].p_value)
            found.append(replace(c, test_result=c.test_result._replace(chi2=chi2), p_value=p_value))
    found = [c for c in found if c.evidence > 0]  # else the effects in the model hold it
    return sorted(found, key=lambda c: c.p_value)


def _standing_for(significant: list[Candidate], candidates: list[Candidate]) -> list[Candidate]:
    """Return candidates that may be what the significant ones show, though chance alone might explain them.

    That a channel orders the residual is shown once; on which quantity it acts is for the forms to tell, so the same
    channel on others comes along. So do conditions that explain half of what the calendar does on the same quantity:
    they are tested one after the other, so the calendar follows them, and a dozen specimens may not say so.
    """
    found = []
    keys = {c.key for c in significant}
    for shown in significant:
        for c in candidates:
            alike = (c.acts_on, c.operation) == (shown.acts_on, shown.operation)
            behind = shown.channels[0] in CALENDAR and c.unit == "specimen" and alike
            beside = (
                c.channels[-1:] == shown.channels[-1:] and not shown.pair and c.columns.shape == shown.columns.shape
            )
            if (behind or beside) and c.key not in keys and c.chi2 >= HALF_OF_CALENDAR * shown.chi2:
                found.append(replace(c, p_value=shown.p_value))
                keys.add(c.key)
    return found


def _drop_needless(fitted: Fitted, added: list[AcceptedEffect]) -> tuple[Fitted, list[AcceptedEffect]]:
    """Return the fit without effects that a later one has made needless, by Schwarz's price; the weakest first.

    What one of two alike leaves may be needless too, so each is asked again when another has gone. A ripple was
    judged on the raw samples, which bins cannot overrule.
    """
    asked: set[int] = set()
    while True:
        # Far from needless: no refit is wanted to see that.
        size = {
            k: _wald_statistic(fitted, k) - 2 * a.proposal.bic_penalty
            for k, a in enumerate(added[:-1])
            if not a.proposal.term.effect.periodic
        }
        k = min((k for k in size if size[k] <= 0 and k not in asked), key=size.__getitem__, default=None)
        if k is None:
            return fitted, added
        without = fit(fitted.model.without_term(k), fitted.rows, fitted.scatter, turns=0, friction=fitted.friction)
        if without.deviance - fitted.deviance < added[k].proposal.bic_penalty:
            fitted = fit(without.model, fitted.rows, fitted.scatter, turns=1)
            added, asked = [*added[:k], *added[k + 1 :]], set()
        else:
            asked.add(k)


def _wald_statistic(fitted: Fitted, number: int) -> float:
    """Return the squared standardised size of an effect's amplitudes, all together."""
    at = fitted.model.term_slice(number).start
    effect, values = fitted.model.terms[number].effect, fitted.model.values[number]
    places = [at + k for k, p in enumerate(effect.parameters) if p.linear]
    amplitude = np.array([values[p.name] for p in effect.parameters if p.linear])
    return float(amplitude @ np.linalg.pinv(fitted.covariance[np.ix_(places, places)]) @ amplitude)


def numbered(bins: pd.DataFrame) -> pd.DataFrame:
    """Return `bins` with `stroke_id`, a number per stroke that samples and every part of the rows share."""
    return bins.assign(stroke_id=bins.groupby(["file", "stroke"], sort=False).ngroup().to_numpy())


def steady_samples(traces: pd.DataFrame | Sequence[StoredTraces], rows: Rows) -> pd.DataFrame:
    """Return the steady samples of the strokes in `rows`, for the ripple search.

    Parameters
    ----------
    traces : DataFrame or sequence of StoredTraces
        Table `traces`, the samples of a stroke one after the other, or where it lies: then it is read part by part.
    rows : Rows
        Rows made from `numbered` bins.

    Returns
    -------
    DataFrame
        stroke_id, stroke, direction, unit (number of the file), displacement_mm, time_s, force_N.
    """
    first = rows.groups.starts["stroke"]
    strokes = rows.table.iloc[first]
    index = stroke_index(strokes)
    about = {name: strokes[name].to_numpy() for name in ("stroke_id", "stroke", "direction")}
    about["unit"] = rows.codes("file")[first]
    parts = []
    for part in a_part_at_a_time(traces, ["file", "stroke", "steady", "presliding_N", *SAMPLED]):
        steady = part[part["steady"].to_numpy(dtype=bool)]
        steady = steady.assign(force_N=steady["force_N"] - steady["presliding_N"])
        edges, own = strokes_of(steady, index)
        place = np.repeat(own, np.diff(edges))
        known = place >= 0
        parts.append((place[known].astype(np.int32), *(steady[name].to_numpy()[known] for name in SAMPLED)))
    place, *values = map(np.concatenate, zip(*parts, strict=True)) if parts else [np.zeros(0, int)] * (1 + len(SAMPLED))
    about = {name: own.astype(np.int32)[place] for name, own in about.items()}
    return pd.DataFrame({**about, **dict(zip(SAMPLED, values, strict=True))})


def predict_rows(fitted: Fitted, rows: Rows) -> np.ndarray:
    """Return the fitted model's force at other rows of the same campaign, shape (n,)."""
    return evaluate(fitted.model, rows, jacobian=False)[0]
