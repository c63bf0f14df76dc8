from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from sealfit.closure import selection
from sealfit.closure.confirm import NO_GAIN, RefusedEffect
from sealfit.closure.score_test import Candidate, ScoreTestResult
from sealfit.closure.search import MaskedPair
from sealfit.config import Config

PENALTY = 5.0
DEVIANCE = {"abc": 0.0, "bc": 20.0, "ac": 1.0, "c": 2.0}
"""Deviance with some effects: a is needed beside b alone, and b by nothing."""


@dataclass
class Model:
    """Effects by their letters; waves have a length in mm."""

    letters: str
    waves: dict

    @property
    def terms(self):
        periodic = [SimpleNamespace(periodic=letter in self.waves) for letter in self.letters]
        return [SimpleNamespace(effect=own, channels=("displacement_mm",)) for own in periodic]

    @property
    def values(self):
        return [{"lambda_": self.waves.get(letter)} for letter in self.letters]

    def without_term(self, number):
        return Model(self.letters[:number] + self.letters[number + 1 :], self.waves)


def fit(model, *given, **options):
    rows = SimpleNamespace(bin_width=lambda channel: np.array([-0.5, -0.5, 0.5]))
    return SimpleNamespace(
        model=model, deviance=DEVIANCE[model.letters], rows=rows, scatter=None, refitted=fit
    )


def left(monkeypatch, **waves):
    monkeypatch.setattr(selection, "fit", fit)
    added = [SimpleNamespace(name=a, proposal=SimpleNamespace(bic_penalty=PENALTY)) for a in "abc"]
    fitted, kept = selection._remove_redundant(fit(Model("abc", waves)), added)
    assert fitted.model.letters == "".join(a.name for a in kept)
    return fitted.model.letters


def test_an_effect_is_asked_again_when_a_later_one_has_gone(monkeypatch):
    assert left(monkeypatch) == "c"


def test_a_ripple_that_bins_do_not_resolve_is_not_dropped(monkeypatch):
    assert left(monkeypatch, a=1.9) == "ac"


def test_a_long_wave_is_dropped_where_a_later_effect_makes_it_needless(monkeypatch):
    assert left(monkeypatch, a=2.1) == "c"


def a_loop(monkeypatch, candidates, proposals):
    loop = object.__new__(selection._LoopState)
    loop.fitted, loop.added, loop.refused = SimpleNamespace(deviance=10.0), ["earlier"], set()
    loop.tests, loop.found = SimpleNamespace(fitted=loop.fitted), SimpleNamespace(claimable=[], laws=[])
    loop.context = SimpleNamespace(config=SimpleNamespace(loop=SimpleNamespace(max_rounds=9)), effects={})
    loop.channels, loop.unconfirmed, loop.negligible = {}, [], set()
    monkeypatch.setattr(loop.__class__, "open_candidates", lambda own: list(candidates))
    monkeypatch.setattr(selection, "propose", lambda *given: proposals)
    monkeypatch.setattr(selection, "_related_candidates", lambda *given: [])
    return loop


def named(key, channel, chi2):
    """Return a candidate of a channel and its proposal."""
    term = SimpleNamespace(channels=(channel,))
    proposal = SimpleNamespace(source=key, term=term, chi2=chi2, p_value=1e-9)
    return SimpleNamespace(key=key, channels=(channel,), chi2=chi2), proposal


def test_effects_that_take_the_place_of_others_in_turn_end_the_loop(monkeypatch):
    """A new effect that is merged with an earlier one, and explains no more, is not asked again."""
    candidate, proposal = named("c", "x", 5.0)
    loop = a_loop(monkeypatch, [candidate], [proposal])
    accepted = SimpleNamespace(proposal=proposal)
    monkeypatch.setattr(loop.__class__, "confirm", lambda own, *given: (accepted, []))
    monkeypatch.setattr(loop.__class__, "add", lambda own, accepted: setattr(own, "added", ["merged"]))
    assert not loop.run_round(2)
    assert loop.refused == {"c"}


def test_an_effect_too_small_to_matter_is_known_behind_another_that_is_refused(monkeypatch):
    """The second form of a round is negligible, and so is a weaker one of its channel, but not the first."""
    (pair, of_pair), (time, of_time), (weaker, _) = (
        named(*one) for one in (("pair", "speed", 90.0), ("time", "time", 50.0), ("weaker", "time", 40.0))
    )
    loop = a_loop(monkeypatch, [pair, time, weaker], [of_pair, of_time])
    failed = [RefusedEffect(of_pair, "it does not lower the error"), RefusedEffect(of_time, NO_GAIN)]
    monkeypatch.setattr(loop.__class__, "confirm", lambda own, *given: (None, failed))
    assert not loop.run_round(2)
    assert loop.refused == {"pair", "time"}
    assert loop.negligible == {"time", "weaker"}
    assert [item.reason for item in loop.unconfirmed] == ["it does not lower the error"]


def test_effects_that_mask_each_other_come_before_a_weaker_single_one():
    def candidate(name, p_value):
        test = ScoreTestResult(50.0, 1, 20, -30.0)
        return Candidate((name,), "mu", "multiply", "run", np.ones((9, 1)), test, p_value=p_value)

    speed, time, distance = (candidate(*c) for c in (("speed_mm_s", 1e-3), ("time_s", 1), ("distance_mm", 1)))
    pair = MaskedPair(1e-9, 60.0, (time.key, distance.key))
    loop = selection._LoopState.__new__(selection._LoopState)
    loop.found = selection._SearchResult([speed, time, distance], [], [], [speed], [pair])
    loop.masked, loop.refused, loop.negligible, loop.ripple = [], set(), set(), None
    loop.tests, loop.channels, loop.context = None, {}, SimpleNamespace(config=Config())
    assert {c.key for c in loop.open_candidates()} == set(pair.keys)
    loop.masked, loop.refused = [], {time.key}
    assert [c.key for c in loop.open_candidates()] == [speed.key]
