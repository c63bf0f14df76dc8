"""From a channel that explains the residual to an effect: physical effects, closed forms, free shapes.

Every form is fitted to the residual in the tangent space. The best few are refitted jointly with the model,
and the BIC decides. Of equal forms a physical effect is preferred, then a closed form to a free shape.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np
import pandas as pd
from scipy.special import stdtr

from sealfit.closure import criteria
from sealfit.closure.channels import Channel
from sealfit.closure.errors_and_intervals import robust_covariance
from sealfit.closure.forms import CHANGES_A_WAVE, periodic_terms, terms_of
from sealfit.closure.linearised import ZERO_OFFSET, Proposal, linearised
from sealfit.closure.ripples import Peak
from sealfit.closure.score_test import Candidate
from sealfit.effects.contract import CHANNEL, Effect
from sealfit.fit.joint import Fitted, fit, reestimated
from sealfit.fit.joint.model import Model
from sealfit.fit.joint.search import search_nonlinear, solve_linear
from sealfit.fit.joint.whitening import Scatter, Whitening
from sealfit.tables import HISTORY

REFITTED = 8  # Proposals that are refitted jointly.
FORMS_EACH = 2  # Proposals that are refitted for each further quantity and each further set of variables.
LIKELIEST = 3  # Proposals that are refitted first, to see whether most of the scatter was the missing effect.
CALENDAR_RIVALS = 2  # Calendar proposals that are refitted as rivals of others.
LINEAR = "linear"


def propose(
    fitted: Fitted,
    significant: Sequence[Candidate],
    channels: Mapping[str, Channel],
    effects: Mapping[str, Effect],
    also: Sequence[Proposal] = (),
) -> list[Proposal]:
    """Return jointly refitted proposals for the channels that explain most of the residual, best first.

    The `significant` candidates are sorted, strongest first. `also` are further proposals.
    """
    contenders = _contenders(significant)
    forms = [(*form, c) for c in contenders for form in terms_of(c, channels, fitted, effects)]
    forms.sort(key=lambda form: (form[2].channels[-1], form[0].effect.id))  # the order of exact equals
    found = [*also, *(p for form in forms for p in linearised(fitted, *form))]
    calendar = [p for p in found if set(p.term.channels) & set(HISTORY)]
    others = [p for p in found if p not in calendar]
    most, of_others = (max((p.chi2 for p in own), default=-np.inf) for own in (calendar, others))
    if not calendar or of_others < criteria.HALF_OF_CALENDAR * most:
        return _ordered(fitted, _refitted(fitted, _best_few(found), found))
    others = _refitted(fitted, _best_few(others), others)
    calendar = _refitted(fitted, _best_few(calendar)[:CALENDAR_RIVALS])
    return _calendar_last(fitted, others, sorted(calendar, key=lambda p: p.bic))


def _calendar_last(fitted: Fitted, others: list[Proposal], calendar: list[Proposal]) -> list[Proposal]:
    """Return refitted proposals in order, those of the calendar last unless a named one fits much better."""
    least = min(p.bic for p in others) - criteria.RIVAL_BIC
    if any(p.named and p.bic < least for p in calendar):
        return _ordered(fitted, [*calendar, *others])
    return _ordered(fitted, others) + calendar


def propose_ripples(
    fitted: Fitted,
    peak: Peak,
    samples: pd.DataFrame,
    effects: Mapping[str, Effect],
    channels: Collection[str],
) -> list[Proposal]:
    """Return jointly refitted proposals for a periodic component, best first; none if no fit converges.

    Its amplitude may change with some of the `channels`.
    """
    forms = periodic_terms(fitted, peak, samples, effects, channels)
    found = [p for form in forms for p in linearised(fitted, *form)]
    constant = [p for p in found if len(p.term.channels) == 1]
    refitted = _refitted(fitted, _best_few(found), found)
    refitted = [p for p in refitted if len(p.term.channels) == 1 or _changes(p)]
    ordered = _ordered(fitted, refitted or _refitted(fitted, constant))
    # Changes of the amplitude other than the best one were not found.
    return [*ordered[:1], *(p for p in ordered[1:] if len(p.term.channels) == 1)]


def _changes(proposal: Proposal) -> bool:
    """Whether the amplitude of a wave changes with its channel: a Wald test with files as the units."""
    fitted = proposal.fitted
    place = fitted.model.term_slice(len(fitted.model.terms) - 1).start
    place += [p.name for p in proposal.term.effect.parameters].index("B")
    variance = max(fitted.covariance[place, place], robust_covariance(fitted, proposal.unit)[place, place])
    ratio = abs(fitted.model.values[-1]["B"]) / np.sqrt(variance)
    return len(CHANGES_A_WAVE) * 2 * stdtr(proposal.units - 1, -ratio) <= criteria.CHANGE_P


def named_among(fitted: Fitted, found: Sequence[Proposal]) -> list[Proposal]:
    """Return proposals, fitted jointly with the model from their start values: first the one to report."""
    return _ordered(fitted, _refitted(fitted, found))


def _contenders(significant: Sequence[Candidate]) -> Iterator[Candidate]:
    """Yield the candidates that explain nearly as much as the strongest, each once.

    A constant offset comes first: a form that starts at zero would contain it.
    """
    offset = (c for c in significant if c.key == ZERO_OFFSET)  # a form that starts at zero would contain it
    best = next(offset, significant[0]) if significant else None
    seen = set()
    for candidate in significant:
        if candidate.chi2 < criteria.CONTENDER_SHARE * best.chi2 or candidate.key in seen:
            continue
        if best.channels == ("direction",) and (candidate.pair or "direction" not in candidate.channels):
            continue
        seen.add(candidate.key)
        yield candidate


def _best_few(found: list[Proposal]) -> list[Proposal]:
    """Return the few best proposals to refit, the best free shape among them.

    Each effect is kept at most once per target and on at most two. A grid is coarse, so physical effects get
    a margin. Every further physical effect, quantity and set of variables that explains nearly as much has a
    named form among them: the missing effect biases the model it is tested on.
    """
    kept: list[Proposal] = []
    ranked = sorted(found, key=lambda p: p.bic - criteria.EQUAL_BIC * p.term.effect.physical)
    for proposal in ranked:
        effect = proposal.term.effect
        alike = [p for p in kept if p.term.effect.id == effect.id]
        same = [p for p in alike if len(p.term.effect.parameters) == len(effect.parameters)]
        if len(same) >= 2 or any(p.term.key() == proposal.term.key() for p in same):
            continue
        if len(kept) < REFITTED or (not proposal.named and not same):
            kept.append(proposal)
    most = max((p.chi2 for p in found), default=0.0)
    near = [p for p in ranked if p.chi2 >= criteria.CONTENDER_SHARE * most and p.named]
    mechanisms = {p.term.effect.id: p for p in reversed(near) if p.term.effect.physical}
    kept += [p for p in mechanisms.values() if all(p.term.effect.id != own.term.effect.id for own in kept)]
    for part in (attrgetter("term.target"), attrgetter("term.channels")):
        known = {part(p) for p in kept if p.named}
        for own in dict.fromkeys(map(part, near)):
            if own not in known:
                kept += [p for p in near if part(p) == own and p not in kept][:FORMS_EACH]
    return kept


def _ordered(fitted: Fitted, found: list[Proposal]) -> list[Proposal]:
    """Return proposals best first; of equals one that leaves earlier effects unchanged, then by rank."""
    if not found:
        return []
    found = sorted(found, key=lambda p: p.bic)
    best = found[0]
    equals = [p for p in found if p.bic - best.bic < criteria.EQUAL_BIC or _simpler(p, best)]
    candidates = [p for p in equals if determined(p)]
    fewest = min((p.size for p in candidates), default=0)
    candidates += [p for p in equals if p.term.effect.physical and p not in candidates and p.size <= fewest]
    equal_fits = [p for p in found if p.fitted.deviance - best.fitted.deviance < criteria.EQUAL_BIC]
    if not any(p.term.effect.id == LINEAR for p in equal_fits):  # a straight line shows no mechanism
        # The BIC penalty is not decisive for physical effects of just these channels.
        own = [p for p in equal_fits if p.term.effect.physical and CHANNEL not in p.term.effect.reads]
        least = min((p.fitted.deviance for p in own), default=0.0)
        near = [p for p in own if p.fitted.deviance - least < 2 * criteria.EQUAL_BIC]
        candidates += [p for p in near if p not in candidates]
    if candidates:
        first = min(candidates, key=lambda p: (_changes_earlier(fitted, p), p.rank, p.bic))
    else:
        first = next((p for p in found if p.bic - best.bic < criteria.RIVAL_BIC and determined(p)), best)
    return [first, *(p for p in found if p is not first)]


def _changes_earlier(fitted: Fitted, proposal: Proposal) -> bool:
    """Whether a proposal changes an amplitude of an earlier effect by more than a third."""
    model, later = fitted.model, proposal.fitted.model.values
    return any(
        abs(now[name] - then[name]) > criteria.LARGE_CHANGE * abs(then[name])
        for term, then, now in zip(model.terms, model.values, later, strict=False)
        for name in term.effect.linear
    )


def determined(proposal: Proposal) -> bool:
    """Whether the data determine the nonlinear parameters of a form, to half of their value or better."""
    fitted, effect = proposal.fitted, proposal.term.effect
    first = fitted.model.term_slice(len(fitted.model.terms) - 1).start
    covariance = np.maximum(fitted.covariance, robust_covariance(fitted, proposal.unit))
    for k, parameter in enumerate(effect.parameters):
        if parameter.linear or parameter.name == "phi":
            continue
        error, value = np.sqrt(covariance[first + k, first + k]), fitted.model.values[-1][parameter.name]
        place = CHANNEL in effect.reads and parameter.search in ("inside", "between")  # it may be near 0
        if error > criteria.MOST_RELATIVE_ERROR * (np.ptp(parameter.bounds) if place else abs(value)):
            return False
    return True


def _simpler(proposal: Proposal, best: Proposal) -> bool:
    """Whether a proposal adds nearly the same force as the best one, fits nearly as well, and is simpler.

    A quantity of the declared model is preferred to a factor on the whole force.
    """
    gain = best.term.target == ("force", "multiply") and proposal.term.acts_on != "force"
    plain = proposal.rank[:2] < best.rank[:2] or proposal.source == ZERO_OFFSET or gain
    as_good = proposal.bic - best.bic < 2 * criteria.EQUAL_BIC
    return plain and as_good and correlation(proposal, best) > criteria.SAME_EFFECT


def correlation(one: Proposal, other: Proposal) -> float:
    """Return the correlation of what two proposals add to the force, after projection."""
    size = np.linalg.norm(one.column) * np.linalg.norm(other.column)
    return float(abs(one.column @ other.column) / size) if size > 0 else 0.0


def rivals(chosen: Proposal, found: Sequence[Proposal]) -> list[Proposal]:
    """Return proposals these data cannot distinguish from the chosen one: they add nearly the same force.

    Those with a far larger BIC are none: their forces may be wrong by many times the noise.
    """
    kept = []
    for p in found:
        similarity, behind = correlation(p, chosen), p.bic - chosen.bic
        most = criteria.REFIT_MARGIN if similarity > criteria.SAME_EFFECT else criteria.RIVAL_BIC
        same = p is chosen or (p.term.key()[1:] == chosen.term.key()[1:] and abs(behind) < 1e-3)
        if not same and similarity > criteria.RIVAL_CORRELATION and behind < most:
            kept.append(p)
    return kept


def _refitted(fitted: Fitted, found: Sequence[Proposal], more: Sequence[Proposal] = ()) -> list[Proposal]:
    """Return proposals fitted jointly with the model, best first.

    Further named forms of the variables of the best are among them, from `more`. The scatter is re-estimated
    for those whose BIC under the scatter of the best is near. If most of the former scatter was the missing
    effect, as the few likeliest proposals show, the likelier ones are refitted under the re-estimated one.
    """
    if not found:
        return []
    likeliest = sorted(found, key=lambda p: p.bic)
    joint = [_joint(fitted, p) for p in likeliest[:LIKELIEST]]
    first = min(joint, key=lambda p: p.bic)
    best, alone = _reestimated(first), _reestimated(first, noise=True)
    joint += [_joint(fitted, p) for p in likeliest[LIKELIEST:]]
    joint += [_joint(fitted, p) for p in _further_forms(min(joint, key=lambda p: p.bic), found, more)]
    if first.fitted.deviance - alone.fitted.deviance > criteria.SCATTER_FALL:
        scatter = alone.fitted.scatter
        joint = list(_refitted_under(fitted, _likeliest_under(joint, scatter), scatter))
    refitted = sorted(joint, key=lambda p: p.bic)
    if refitted[0] is not first:
        best = _reestimated(refitted[0])
    most = min(best.bic, refitted[0].bic) + criteria.REFIT_MARGIN
    own, far = [], []
    for p in refitted[1:]:
        near = _bic_under(p, best.fitted.scatter) < most
        (own if near else far).append(p)
    return [best, *map(_reestimated, own), *far[:LIKELIEST]]


def _further_forms(best: Proposal, tried: Sequence[Proposal], found: Sequence[Proposal]) -> list[Proposal]:
    """Return the likeliest named forms of the variables of the best proposal that were not tried."""
    known = {p.term.key() for p in tried}
    same = [p for p in found if p.term.channels == best.term.channels and p.named]
    return sorted((p for p in same if p.term.key() not in known), key=lambda p: p.bic)[:REFITTED]


def _joint(fitted: Fitted, proposal: Proposal) -> Proposal:
    """Return a proposal fitted jointly with the model, under the current scatter."""
    models = [fitted.model.with_term(proposal.term, values) for values in _starts(fitted.model, proposal)]
    models = [solve_linear(model, fitted.rows, fitted.scatter, fitted.loads) for model in models]
    return replace(proposal, fitted=min(map(fitted.refitted, models), key=lambda f: f.deviance))


def _starts(model: Model, proposal: Proposal) -> Iterator[Mapping[str, float]]:
    """Yield start values of a proposal: its own, and both sides of a value at which its shape vanishes.

    There, parameters that the declared model has too, such as v_s, start from its value.
    """
    yield proposal.values
    for p in (p for p in proposal.term.effect.nonlinear if p.vanishes_at is not None):
        shared = {name: mean for name, mean in model.geometric_means().items() if name in proposal.values}
        below = [value for value in p.search if value < p.vanishes_at]
        above = [value for value in p.search if value > p.vanishes_at]
        for side in (below, above):
            yield {**proposal.values, **shared, p.name: float(np.median(side))}


def _reestimated(proposal: Proposal, *, noise: bool = False) -> Proposal:
    return replace(proposal, fitted=reestimated(proposal.fitted, noise=noise))


def _likeliest_under(joint: Sequence[Proposal], scatter: Scatter) -> list[Proposal]:
    """Return the proposals whose BIC in the tangent space is near the least, and a few of the others."""
    bic = {p: _bic_under(p, scatter) for p in joint}
    most = min(bic.values()) + criteria.TANGENT_MARGIN
    far = sorted((p for p in joint if bic[p] >= most), key=bic.get)
    return [p for p in joint if p not in far[LIKELIEST:]]


def _refitted_under(fitted: Fitted, joint: Sequence[Proposal], scatter: Scatter) -> Iterator[Proposal]:
    """Yield the fitted proposals, likeliest first, fitted under another scatter: the better of two starts.

    One is their own fit. The other has v_s and b searched anew, with the likeliest effect on each quantity.
    """
    rows, loads = fitted.rows, fitted.loads
    begun: dict[tuple[str, str], np.ndarray] = {}
    for proposal in joint:
        model = fitted.model.with_term(proposal.term, proposal.values)
        target = proposal.term.target
        if target in begun:
            model = solve_linear(replace(model, theta=begun[target]), rows, scatter, loads)
        else:
            model = search_nonlinear(model, rows, scatter)
        starts = [model, proposal.fitted.model]
        fits = [fit(start, rows, scatter, turns=0, loads=loads) for start in starts]
        anew = min(fits, key=lambda f: f.deviance)
        begun.setdefault(target, anew.model.theta)
        yield replace(proposal, fitted=anew)


def _bic_under(proposal: Proposal, scatter: Scatter) -> float:
    """Return the BIC that a fitted proposal would have under another scatter; see `deviance_under`."""
    return deviance_under(proposal.fitted, scatter) + proposal.bic_penalty


def deviance_under(fitted: Fitted, scatter: Scatter) -> float:
    """Return the deviance that a fit would have under another scatter, refitted in its tangent space."""
    whitening = Whitening(scatter, fitted.loads, fitted.rows.groups)
    residual = whitening(fitted.residual[:, None])[:, 0]
    normal, gradient = whitening.normal(fitted.jacobian, residual)
    step, *_ = np.linalg.lstsq(normal, gradient, rcond=1e-10)
    return float(residual @ residual - step @ gradient) + whitening.logdet
