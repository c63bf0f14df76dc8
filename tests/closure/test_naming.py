"""Which of several proposals is reported: equals by their rank, and only equals."""

from types import SimpleNamespace

import numpy as np
import pytest

from sealfit.closure import naming
from sealfit.effects import EFFECTS

PRICE = 11.5  # of a number, where many strokes are the evidence


def proposal(effect, acts_on, deviance, size):
    effect = EFFECTS[effect]
    term = SimpleNamespace(effect=effect, acts_on=acts_on, operation="multiply")
    rank = (0 if effect.physical else 1, size, ("mu", "force").index(acts_on), 0)
    fitted = SimpleNamespace(deviance=deviance)
    criterion = deviance + PRICE * size
    return SimpleNamespace(
        term=term, fitted=fitted, size=size, rank=rank, criterion=criterion, source=(), column=np.ones(3)
    )


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
