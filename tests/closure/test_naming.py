"""Which of several proposals is reported: equals by their rank, and only equals."""

from types import SimpleNamespace

import numpy as np
import pytest
from bins_helpers import make_bins

from sealfit.closure import naming
from sealfit.closure.ripples import Peak
from sealfit.closure.selection import numbered
from sealfit.effects import EFFECTS
from sealfit.fit.joint.estimate import fit_declared
from sealfit.fit.joint.rows import make_rows

PRICE = 11.5  # of a number, where many strokes are the evidence


def proposal(effect, acts_on, deviance, size):
    effect = EFFECTS[effect]
    term = SimpleNamespace(effect=effect, acts_on=acts_on, operation="multiply")
    rank = (0 if effect.physical else 1, size, ("mu", "force").index(acts_on), 0)
    fitted = SimpleNamespace(deviance=deviance)
    bic = deviance + PRICE * size
    return SimpleNamespace(term=term, fitted=fitted, size=size, rank=rank, bic=bic, source=(), column=np.ones(3))


@pytest.mark.parametrize(("behind", "first"), [(1.0, "mu"), (10.0, "force")])
def test_a_mechanism_acts_on_what_the_strokes_say_where_they_say_it(behind, first, monkeypatch):
    """A logarithm with a number less is as good as both: what it saves does not make them equals of each other."""
    monkeypatch.setattr(naming, "determined", lambda p: True)
    monkeypatch.setattr(naming, "_overturns", lambda fitted, p: False)
    found = [
        proposal("log", "force", 0.0, 1),
        proposal("warming_distance", "force", 0.6 - behind, 2),
        proposal("warming_distance", "mu", 0.6, 2),
    ]
    chosen = naming._ordered(None, found)[0]
    assert (chosen.term.effect.id, chosen.term.acts_on) == ("warming_distance", first)


def test_rivals_are_told_apart_under_the_noise_that_the_effect_leaves():
    """The friction of these strokes differs by a third, so a ripple that is an added force is no factor on it.

    Strokes start at places of their own: the ripple stands in the noise of the rows while it is missing.
    """
    bins = numbered(make_bins(days=(), repeats=2, noise_N=0.05)).assign(n=1)
    start = np.random.default_rng(1).uniform(0.0, 8.0, bins["file"].nunique())
    place = bins["displacement_mm"] + start[bins["file"].factorize()[0]]
    bins = bins.assign(displacement_mm=place, force_N=bins["force_N"] + np.sin(2 * np.pi * place / 8.0))
    peak = Peak("displacement_mm", 8.0, True, True, 0.0, 0.0, 1.0, 1.0)
    fitted = fit_declared(make_rows(bins, has_aging=True))
    first, second = naming.propose_ripples(fitted, peak, bins.iloc[:0], EFFECTS)[:2]
    assert (first.term.acts_on, first.term.operation) == ("force", "add")
    assert second.bic - first.bic > 100
