"""From a channel that orders the residual to the effect that explains it: the catalogue, closed forms, free shapes.

Every form that may act there is fitted to the residual in the tangent space (exact in its amplitudes, a grid over the
rest), the best few are refitted jointly with the physics, and the likelihood less Schwarz's price per parameter
decides.
Where rivals do equally well, a named mechanism comes before a closed form, and that before a free shape.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from sealfit.closure.channels import Channel
from sealfit.closure.forms import periodic_terms, terms_of
from sealfit.closure.intervals import robust_covariance
from sealfit.closure.ripple import Peak
from sealfit.closure.search import Candidate, project
from sealfit.effects import EFFECTS
from sealfit.effects.contract import Effect
from sealfit.effects.free import SMOOTH, SURFACE
from sealfit.fit.estimate import Fitted, fit, settled
from sealfit.fit.joint import Term, mean_derivatives, term_slope

CONTENDER = 0.6  # share of the best explained sum of squares from which a rival channel is worth naming
REFITTED = 8  # proposals refitted jointly
TIED = 3.0  # less than this apart on the deviance scale, the simpler or more physical one is reported
RIVAL = 10.0  # an alternative: the data favour the chosen one by less than exp(5)
HELD = 0.5  # relative standard error beyond which a form's own number is not determined
OVERTURNED = 1 / 3  # share of its size by which a new effect may change an earlier one, where it has equals
ALIKE = 0.5  # correlation below which two candidates explain different things
SAME = 0.98  # correlation above which two candidates are one effect here
UNNAMED = (SMOOTH, SURFACE)
OFFSET = (("direction",), "force", "add")
PREFERRED = ("mu", "mu_c", "mu_s", "v_s", "sigma_2", "a", "b", "mu_0", "force")


@dataclass(frozen=True)
class Proposal:
    """A term with start values, how much it explains, and, once refitted, the joint fit."""

    term: Term
    values: Mapping[str, float]
    unit: str  # level of its whole units
    units: int
    chi2: float
    p_value: float
    column: np.ndarray  # (n,) what it adds to the force, whitened and projected
    source: tuple  # key of the candidate it stands for
    fitted: Fitted | None = None

    @property
    def price(self) -> float:
        """Schwarz's price of its parameters."""
        return len(self.term.effect.parameters) * np.log(max(self.units, 2))

    @property
    def criterion(self) -> float:
        """Twice the negative log likelihood plus the price; smaller is better."""
        return (self.fitted.deviance if self.fitted is not None else -self.chi2) + self.price

    @property
    def named(self) -> bool:
        """Whether the form has a name."""
        return self.term.effect.id not in UNNAMED

    @property
    def rank(self) -> tuple:
        """Order among equals: mechanism, closed form, free shape; then fewer parameters; then what it acts on."""
        effect = self.term.effect
        kind = 0 if effect.physical else 2 if effect.id in UNNAMED else 1
        offset = self.source == OFFSET  # an amplifier's zero is off more often than a friction differs by direction
        return (kind, len(effect.parameters), -1 if offset else PREFERRED.index(self.term.acts_on))


def propose(
    fitted: Fitted,
    significant: Sequence[Candidate],
    channels: Mapping[str, Channel],
    peak: Peak | None = None,
    samples: pd.DataFrame | None = None,
    effects: Mapping[str, Effect] = EFFECTS,
) -> list[Proposal]:
    """Return jointly refitted proposals for what orders the residual most, best first.

    Parameters
    ----------
    fitted : Fitted
        The current model.
    significant : sequence of Candidate
        Candidates accepted by the search, strongest first.
    channels : mapping
        Channels by name.
    peak : Peak, optional
        A periodic component found on the raw samples.
    samples : DataFrame, optional
        The samples it was found on, with `residual_N`; wanted with a peak.
    effects : mapping
        The catalogue, the user's own effects included.
    """
    found: list[Proposal] = []
    if significant:
        # A form that starts at zero would take a constant offset in along with its own shape: the offset comes first.
        best = next((c for c in significant if c.key == OFFSET), significant[0])
        seen = set()
        for candidate in significant:
            if candidate.chi2 < CONTENDER * best.chi2 or candidate.key in seen:
                continue
            if best.channels == ("direction",) and (candidate.pair or "direction" not in candidate.channels):
                continue
            seen.add(candidate.key)
            for term, search in terms_of(candidate, channels, fitted, effects):
                found += _linearised(fitted, term, search, candidate)
    if peak is not None:
        for term, search, candidate in periodic_terms(fitted, peak, samples, effects):
            found += [replace(p, source=("peak", peak.axis)) for p in _linearised(fitted, term, search, candidate)]
    found.sort(key=lambda p: p.criterion)
    found = [_refit(fitted, p) for p in _spread(found)]
    return _ordered(fitted, found)


def _spread(found: list[Proposal]) -> list[Proposal]:
    """Return the few best, each effect and target once, no effect on more than two; the best free shape among them.

    A grid is coarse, so a mechanism gets the benefit of the doubt until it has been refitted.
    """
    kept: list[Proposal] = []
    for proposal in sorted(found, key=lambda p: p.criterion - TIED * p.term.effect.physical):
        same = [p for p in kept if p.term.effect.id == proposal.term.effect.id]
        if len(same) >= 2 or any(p.term.key() == proposal.term.key() for p in same):
            continue
        if len(kept) < REFITTED or (not proposal.named and not same):
            kept.append(proposal)
    return kept


def _ordered(fitted: Fitted, found: list[Proposal]) -> list[Proposal]:
    """Return proposals best first; in front of its equals the one that leaves earlier effects alone, then by rank."""
    if not found:
        return []
    found = sorted(found, key=lambda p: p.criterion)
    best = found[0]
    equals = [p for p in found if p.criterion - best.criterion < TIED or _same(p, best, TIED * 2)]
    held = [p for p in equals if determined(p)]
    if held:
        first = min(held, key=lambda p: (_overturns(fitted, p), p.rank, p.criterion))
    else:
        first = next((p for p in found if p.criterion - best.criterion < RIVAL and determined(p)), best)
    return [first, *(p for p in found if p is not first)]


def _overturns(fitted: Fitted, proposal: Proposal) -> bool:
    """Whether a proposal changes an amplitude of an earlier effect by more than a third.

    Two effects that take from each other what both explain read worse than one beside the other.
    """
    return any(
        abs(now[p.name] - then[p.name]) > OVERTURNED * abs(then[p.name])
        for term, then, now in zip(fitted.model.terms, fitted.model.values, proposal.fitted.model.values, strict=False)
        for p in term.effect.parameters
        if p.linear
    )


def determined(proposal: Proposal) -> bool:
    """Whether the data hold the form's own numbers: a time constant known to worse than half of itself is not one.

    Such a form is a straight line or a constant under another name, and the plain one says so better.
    """
    fitted, effect = proposal.fitted, proposal.term.effect
    first = fitted.model.size - len(effect.parameters)
    covariance = np.maximum(fitted.covariance, robust_covariance(fitted, proposal.unit))
    for k, parameter in enumerate(effect.parameters):
        if parameter.linear or parameter.name == "phi":
            continue
        error = float(np.sqrt(covariance[first + k, first + k]))
        if error > HELD * abs(fitted.model.values[-1][parameter.name]):
            return False
    return True


def _same(one: Proposal, other: Proposal, margin: float) -> bool:
    return correlation(one, other) > SAME and one.criterion - other.criterion < margin


def correlation(one: Proposal, other: Proposal) -> float:
    """Return the correlation of what two proposals add to the force, after projection."""
    size = np.linalg.norm(one.column) * np.linalg.norm(other.column)
    return float(abs(one.column @ other.column) / size) if size > 0 else 0.0


def rivals(chosen: Proposal, found: Sequence[Proposal]) -> list[Proposal]:
    """Return the proposals that these data cannot tell from the chosen one: they add much the same to the force."""
    return [p for p in found if p is not chosen and not _identical(p, chosen) and _rival(p, chosen)]


def _rival(proposal: Proposal, chosen: Proposal) -> bool:
    alike = correlation(proposal, chosen)
    return alike > SAME or (alike > ALIKE and proposal.criterion - chosen.criterion < RIVAL)


def _identical(one: Proposal, other: Proposal) -> bool:
    """Whether two proposals are one equation under two names, on the same channels and quantity."""
    return one.term.key()[1:] == other.term.key()[1:] and abs(one.criterion - other.criterion) < 1e-3


def _refit(fitted: Fitted, proposal: Proposal) -> Proposal:
    model = fitted.model.with_term(proposal.term, proposal.values)
    refitted = fit(model, fitted.rows, fitted.scatter, turns=0, loading=fitted.force)
    return replace(proposal, fitted=settled(refitted, fitted.force))


def _linearised(fitted: Fitted, term: Term, search: Mapping[str, tuple], candidate: Candidate) -> list[Proposal]:
    """Return the term at the best point of its grid, its amplitudes exact; nothing where none is left of it here."""
    effect = term.effect
    slope = term_slope(fitted.model, fitted.rows, term.acts_on, term.operation)
    names = list(search)
    points = [dict(zip(names, point, strict=True)) for point in itertools.product(*search.values())] or [{}]
    linear = [k for k, p in enumerate(effect.parameters) if p.linear]
    best: Proposal | None = None
    for part in range(0, len(points), 32):
        some = points[part : part + 32]
        columns = []
        for point in some:
            values = {**effect.start(), **point}
            derivatives = mean_derivatives(term, values, fitted.rows, only_linear=True)
            columns += [slope * derivatives[k] for k in range(len(linear))]
        with np.errstate(all="ignore"):
            left = project(fitted, np.column_stack(columns))
        for k, point in enumerate(some):
            own = left[:, k * len(linear) : (k + 1) * len(linear)]
            if not np.isfinite(own).all() or not np.abs(own).max() > 0:
                continue
            amplitude, *_ = np.linalg.lstsq(own, fitted.white_residual, rcond=1e-10)
            column = own @ amplitude
            chi2 = float(2 * column @ fitted.white_residual - column @ column)
            if best is None or chi2 > best.chi2:
                named = {effect.parameters[i].name: float(a) for i, a in zip(linear, amplitude, strict=True)}
                values = {p.name: {**effect.start(), **point, **named}[p.name] for p in effect.parameters}
                best = Proposal(
                    term, values, candidate.unit, candidate.units, chi2, candidate.p_value, column, candidate.key
                )
    return [best] if best is not None else []
