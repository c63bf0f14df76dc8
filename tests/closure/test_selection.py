from dataclasses import dataclass
from types import SimpleNamespace

from sealfit.closure import selection

PENALTY = 5.0
DEVIANCE = {"abc": 0.0, "bc": 20.0, "ac": 1.0, "c": 2.0}
"""Deviance with some effects: a is needed beside b alone, and b by nothing."""


@dataclass
class Model:
    """Effects by their letters."""

    terms: str

    def without_term(self, number):
        return Model(self.terms[:number] + self.terms[number + 1 :])


def fit(model, *given, **options):
    return SimpleNamespace(model=model, deviance=DEVIANCE[model.terms], rows=None, scatter=None, refitted=fit)


def effect(letter, *, periodic=False):
    form = SimpleNamespace(effect=SimpleNamespace(periodic=periodic))
    return SimpleNamespace(name=letter, proposal=SimpleNamespace(term=form, bic_penalty=PENALTY))


def left(monkeypatch, added):
    monkeypatch.setattr(selection, "fit", fit)
    fitted, kept = selection._remove_redundant(fit(Model("abc")), added)
    assert fitted.model.terms == "".join(a.name for a in kept)
    return fitted.model.terms


def test_an_effect_is_asked_again_when_a_later_one_has_gone(monkeypatch):
    assert left(monkeypatch, [effect("a"), effect("b"), effect("c")]) == "c"


def test_a_ripple_is_not_dropped(monkeypatch):
    assert left(monkeypatch, [effect("a", periodic=True), effect("b"), effect("c")]) == "ac"
