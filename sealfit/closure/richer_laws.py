r"""Has the aging another law? The richer laws of the catalogue, refitted whole, against the declared one.

The declared law bends: with a and b free it takes up most of what a floor or an induction time does, and what is left
in its tangent space is a small part, so that a dozen specimens say little of it. Each richer law is therefore fitted
jointly from several starts, its scatter of specimens its own. With n specimens, p numbers of the declared law and q
more, the restricted deviances D give the ratio of what is left between specimens,

.. math:: \log \frac{S_0}{S_1} = \frac{1}{n} \Big(D_0 - D_1 + n \log \frac{n - p}{n - p - q} - q \Big), \qquad
          F = \Big(\frac{S_0}{S_1} - 1\Big) \frac{n - p - q}{q}

or, where that is smaller, F = t^2 / q of its amplitude: near a bound of its numbers either alone may say too much.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import fdtrc

from sealfit.closure.channels import Channel
from sealfit.closure.linearised import Proposal
from sealfit.closure.multiplicity import SEARCHES
from sealfit.closure.score_test import JACKKNIFE_UNITS, Candidate, ScoreTestResult, project
from sealfit.closure.small_sample_test import SmallSampleTest
from sealfit.effects.contract import Effect
from sealfit.fit.estimate import Fitted, fit, reestimated
from sealfit.fit.terms import Term, mean_derivatives, shape_of

AGING = "aging_days"
TARGET = ("mu", "multiply")
FEWEST = 2  # numbers more than the declared law that a richer one has: an amplitude and a day
ROWS = 2  # of each stroke: aging moves strokes as a whole
STARTS = 4  # days from which a law's own number is sought


def richer_laws(
    fitted: Fitted, channels: Mapping[str, Channel], effects: Mapping[str, Effect]
) -> list[tuple[Candidate, Proposal]]:
    """Return each richer law of aging with its test, adjusted for how many there are; none for 30 specimens or more.

    Parameters
    ----------
    fitted : Fitted
        The current model.
    channels : mapping
        Channels by name.
    effects : mapping
        The catalogue.
    """
    specimens = fitted.rows.groups.starts["specimen"].size
    lawful = any(fitted.model.declared.law.values())
    if AGING not in channels or channels[AGING].unit != "specimen" or not lawful or specimens >= JACKKNIFE_UNITS:
        return []
    known = {t.effect.id for t in fitted.model.terms}
    laws = [e for e in effects.values() if e.physical and e.reads == (AGING,) and TARGET in e.acts_on]
    laws = [e for e in laws if e.id not in known and len(e.linear) == 1 and e.nonlinear]
    if specimens - fitted.model.declared.numbers_of_mu <= FEWEST:
        return []
    rows = fitted.rows.sparse(ROWS)
    before = reestimated(fit(fitted.model, rows, fitted.scatter, turns=1))
    found = [_judged(fitted, before, effect, len(laws)) for effect in laws]
    return [f for f in found if f is not None]


def _judged(fitted: Fitted, before: Fitted, effect: Effect, laws: int) -> tuple[Candidate, Proposal] | None:
    """Return one law's candidate and proposal."""
    term = Term(effect, effect.reads, *TARGET, fixed={})
    after = _best(before, term)
    if after is None:
        return None
    place = len(after.model.terms) - 1
    without = reestimated(
        fit(after.model.without_term(place), before.rows, before.scatter, turns=0, friction=before.friction)
    )
    gain = min(before.deviance, without.deviance) - after.deviance
    units = fitted.rows.groups.starts["specimen"].size
    q, left = len(effect.parameters), units - fitted.model.declared.numbers_of_mu
    error = left - q
    if error < 1:
        return None
    amplitude = effect.linear[0]
    at = after.model.place(place).start + [p.name for p in effect.parameters].index(amplitude)
    ratio = np.exp((gain + units * np.log(left / error) - q) / units)
    t = after.model.values[place][amplitude] / np.sqrt(max(after.covariance[at, at], 1e-300))
    f = max(min((ratio - 1) * error / q, t**2 / q), 0.0)
    p_value = fdtrc(q, error, f)
    values = after.model.values[place]
    shape = shape_of(term, values, fitted.rows)
    column = project(fitted, (fitted.slope(*TARGET) * shape)[:, None])[:, 0]
    adjusted = float(min(1.0, (SEARCHES + 1) * laws * p_value))
    test = SmallSampleTest(TARGET, np.empty((0, q)), 0.0, gain, float(np.log(max(p_value, 1e-300))), 1.0, error)
    test_result = ScoreTestResult(gain, q, units, test.log_p, few=test)
    candidate = Candidate((AGING,), *TARGET, "specimen", shape[:, None], test_result, adjusted)
    return candidate, Proposal(term, values, "specimen", units, gain, adjusted, column, candidate.key)


def _best(before: Fitted, term: Term) -> Fitted | None:
    """Return the law fitted jointly from several days, the best of them."""
    effect, rows = term.effect, before.rows
    days = np.unique(rows.days[rows.days > 0])
    amplitude, number = effect.linear[0], effect.nonlinear[0].name
    found: list[Fitted] = []
    for day in _spread(days[:-1]):
        (shape,) = mean_derivatives(term, {**effect.start(), number: day}, rows, only_linear=True)
        left = project(before, (before.slope(*TARGET) * shape)[:, None])[:, 0]
        size = float(left @ left)
        start = {
            **effect.start(),
            amplitude: float(left @ before.white_residual) / size if size > 0 else 0.0,
            number: day,
        }
        model = before.model.with_term(term, {p.name: start[p.name] for p in effect.parameters})
        found.append(reestimated(fit(model, rows, before.scatter, turns=0, friction=before.friction)))
    return min(found, key=lambda f: f.deviance, default=None)


def _spread(days: Sequence[float]) -> list[float]:
    places = np.unique(np.linspace(0, len(days) - 1, STARTS).round().astype(int)) if len(days) else ()
    return [float(days[k]) for k in places]
