"""Effects that this campaign cannot see: what they do, the current model takes up whole.

An offset of the sensor in a campaign that runs one way is friction; a drift along it, with one specimen tested
after the other, is aging. No residual shows them, so they are looked for in the design: of an alias, less than 1 % is
left after projection on the tangent space of the model, whatever its numbers and whichever quantity it acts on.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from sealfit.closure.forms import grid_of, reference
from sealfit.closure.score_test import LEAST_LEFT
from sealfit.effects.contract import CHANNEL, Effect
from sealfit.fit.descent import bounds_of
from sealfit.fit.estimate import Fitted
from sealfit.fit.joint import Model
from sealfit.fit.terms import Term, mean_derivatives

SIZE = 0.01  # of the force's RMS that an alias is given
NEGLIGIBLE = 1e-6  # RMS of a shape of amplitude 1, below which it does nothing here


@dataclass(frozen=True)
class Alias:
    """An effect that is there without a trace: a model that holds it, and one without it that gives the same forces."""

    term: Term
    holding: Model
    lacking: Model
    size_N: float  # RMS of what it adds


def find_aliases(fitted: Fitted, effects: Mapping[str, Effect], taken: tuple[str, ...]) -> list[Alias]:
    """Return the mechanisms of the catalogue that the model takes up whole in this campaign.

    Parameters
    ----------
    fitted : Fitted
        The final model.
    effects : mapping
        The catalogue.
    taken : tuple of str
        Channels that make a condition: what differs between series is the model's own already.
    """
    known = set(fitted.rows.channels) - set(taken)
    own = [e for e in effects.values() if e.physical and CHANNEL not in e.reads and set(e.reads) <= known]
    found = []
    for effect in own:
        first = None
        for *form, left in (f for target in effect.acts_on for f in _at_grid(fitted, effect, target)):
            if left >= LEAST_LEFT:
                break  # it shows there, and the rest of its grid need not be looked at
            first = first or form
        else:
            found += [_alias(fitted, *first)] if first else []
    return found


def _at_grid(
    fitted: Fitted, effect: Effect, target: tuple[str, str]
) -> Iterator[tuple[Term, dict[str, float], np.ndarray, float]]:
    """Yield a form over the grid of its nonlinear numbers: its values, what it adds, and the share that is left."""
    rows = fitted.rows
    values = {name: rows.values(name) for name in effect.reads}
    if any(v.dtype.kind != "f" or (np.ptp(v) == 0 and name != "direction") for name, v in values.items()):
        return  # what does not vary is no effect here
    slope = fitted.slope(*target)
    if np.abs(slope).max() <= 0:
        return
    fixed = {f"{name}_ref": reference(np.abs(v)) for name, v in values.items()}
    term = Term(effect, effect.reads, *target, fixed=fixed)
    searched = grid_of(effect, np.abs(values[effect.reads[0]]))
    for point in itertools.product(*searched.values()):
        at = {**effect.start(), **dict(zip(searched, point, strict=True))}
        for name, shape in zip(effect.linear, mean_derivatives(term, at, rows, only_linear=True), strict=True):
            column = slope * shape
            if np.isfinite(shape).all() and (column**2).mean() > NEGLIGIBLE**2 * (slope**2).mean():
                white = fitted.whitening(column[:, None])[:, 0]
                left = fitted.basis.freed(white)
                amplitudes = {n: float(n == name) for n in effect.linear}
                yield term, {**at, **amplitudes}, column, float(left @ left / (white @ white))


def _alias(fitted: Fitted, term: Term, values: Mapping[str, float], column: np.ndarray) -> Alias:
    size = SIZE * float(np.sqrt((fitted.rows.force**2).mean()))
    scale = size / float(np.sqrt((column**2).mean()))
    white = fitted.whitening(scale * column[:, None])[:, 0]
    change = fitted.covariance @ fitted.white_jacobian.against(white)
    scaled = {name: value * (scale if name in term.effect.linear else 1.0) for name, value in values.items()}
    chosen = {p.name: scaled[p.name] for p in term.effect.parameters}
    model = fitted.model
    without = np.clip(model.vector() + change, *bounds_of(model, fitted.rows))
    return Alias(term, model.with_term(term, chosen), model.at(without), size)
