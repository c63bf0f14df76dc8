from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from bins_helpers import make_bins

from sealfit.closure.channels import find_channels
from sealfit.closure.confirm import AcceptedEffect
from sealfit.closure.linearised import Proposal
from sealfit.closure.loop import _found_in_folds, _HeldOut, _only_gains, _only_halved, _same_shape
from sealfit.closure.result import BeforeAfter
from sealfit.closure.selection import Selection
from sealfit.effects import EFFECTS
from sealfit.fit.joint import fit, fit_declared
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import make_rows
from sealfit.progress import Silent

OIL = {"oil_ppm": lambda rng: rng.normal(50, 10), "humidity_pct": lambda rng: rng.normal(40, 5)}


def term_of(name, target="mu"):
    return Term(EFFECTS["linear"], (name,), target, "multiply", {"x_ref": 50.0})


@pytest.fixture(scope="module")
def selection():
    """A selection with two effects of weak evidence."""
    rows = make_rows(make_bins(5, repeats=1, bins=3, run_channels=OIL), has_aging=True)
    before = fit_declared(rows)
    model = before.model
    for name in OIL:
        model = model.with_term(term_of(name), {"A": 1e-3})
    after = fit(model, rows, before.scatter, turns=0)
    added = tuple(
        AcceptedEffect(
            Proposal(t, v, "run", 72, 1e3, 1e-3, np.empty(0), (t.channels, "mu", "multiply")), 1, 1, (), 1
        )
        for t, v in zip(after.model.terms, after.model.values, strict=True)
    )
    return Selection(before, after, added, (), (), None, None)


def test_effects_of_weak_evidence_are_not_found_again_where_no_fold_has_their_shape(selection):
    nothing = selection.before.model
    other = nothing.with_term(term_of("time_s"), {"A": 1e-3})
    assert not _found_in_folds(selection, [nothing] * 5)
    assert not _found_in_folds(selection, [other] * 5)


def test_one_fold_that_finds_one_of_them_on_any_quantity_is_enough(selection):
    nothing = selection.before.model
    again = nothing.with_term(term_of("humidity_pct", "mu_c"), {"A": -1e-3})
    assert _found_in_folds(selection, [nothing, again])


def test_evidence_that_is_not_weak_needs_no_fold_to_find_it_again(selection):
    first = selection.added[0]
    strong = replace(first, proposal=replace(first.proposal, p_value=1e-9))
    assert _found_in_folds(replace(selection, added=(strong, *selection.added[1:])), [selection.before.model])


@pytest.mark.parametrize(
    ("p_values", "repeats"), [((1e-21, 1e-30), False), ((1e-30, 1e-9), True), ((), False)]
)
def test_the_search_is_repeated_in_the_folds_unless_every_effect_is_certain(selection, p_values, repeats):
    added = tuple(
        replace(one, proposal=replace(one.proposal, p_value=p_value))
        for one, p_value in zip(selection.added, p_values, strict=False)
    )
    heldout = SimpleNamespace(rows=selection.after.rows)  # of 72 runs
    assert _HeldOut.repeats(heldout, replace(selection, added=added)) is repeats


def test_what_no_fold_found_again_is_refused_and_leaves_the_declared_model(selection):
    before, every = selection.before, np.ones(selection.before.force.size, dtype=bool)
    heldout = SimpleNamespace(refitted=lambda fitted: (before.force, every), covered=lambda model: every)
    models = BeforeAfter(before, selection.after, before.force, before.force, every, every)
    own, _ = _only_halved(selection, models, heldout, Silent().say)
    assert own.added == ()
    assert own.after is selection.before
    assert own.left_over is own.first  # the candidates of the last search are on another model
    assert [r.proposal.term.channels[0] for r in own.refused] == list(OIL)
    assert all(r.proposal.weak and "no fold" in r.reason for r in own.refused)
    assert own.worse == ()


@pytest.mark.parametrize(("share", "kept"), [(0.4, True), (0.6, False)])
def test_what_no_fold_found_again_stays_only_if_it_halves_the_held_out_error(selection, share, kept):
    rows, before = selection.before.rows, selection.before
    every = np.ones(rows.force.size, dtype=bool)
    refitted = rows.force - share * before.residual
    heldout = SimpleNamespace(refitted=lambda fitted: (refitted, every), covered=lambda model: every)
    models = BeforeAfter(before, selection.after, before.force, before.force, every, every)
    own, models = _only_halved(selection, models, heldout, Silent().say)
    assert own.added == (selection.added if kept else ())
    assert models.after is (selection.after if kept else before)
    assert models.held_after is (refitted if kept else before.force)


@pytest.mark.parametrize("strong", [0, 1])
def test_the_evidence_for_the_last_effect_says_what_is_asked_of_the_error(selection, strong, monkeypatch):
    monkeypatch.setattr("sealfit.closure.loop._level_of", lambda added: "run")
    monkeypatch.setattr("sealfit.closure.loop.turns_negative", lambda fitted: False)

    class Models:
        after = None

        def gains(self, around, *, weak):
            self.weak = weak
            return True

    added = list(selection.added)
    added[strong] = replace(added[strong], proposal=replace(added[strong].proposal, p_value=1e-9))
    kept, models = _only_gains(replace(selection, added=tuple(added)), Models(), None, Silent().say)
    assert kept.added == tuple(added)
    assert models.weak == (strong == 0)


def test_a_constant_is_the_shape_of_no_other():
    constant, line = np.full(5, 2.0), np.arange(5.0)
    assert _same_shape(constant, 3 * constant)
    assert _same_shape(line, 1 - 2 * line)
    assert not _same_shape(constant, line)


def test_the_candidates_are_those_of_the_model_that_is_left(selection, monkeypatch):
    monkeypatch.setattr("sealfit.closure.loop._level_of", lambda added: "run")
    monkeypatch.setattr("sealfit.closure.loop.turns_negative", lambda fitted: False)
    answers = iter([False, True])
    monkeypatch.setattr(BeforeAfter, "gains", lambda self, around, *, weak: next(answers))
    rows, every = selection.before.rows, np.ones(selection.before.force.size, dtype=bool)
    heldout = SimpleNamespace(refitted=lambda f: (f.force, every), covered=lambda model: every)
    channels = {c.name: c for c in find_channels(rows)}
    before, after = selection.before, selection.after
    models = BeforeAfter(before, after, before.force, after.force, every, every)
    kept, _ = _only_gains(replace(selection, channels=channels), models, heldout, Silent().say)
    assert [a.proposal.term.channels for a in kept.added] == [("oil_ppm",)]
    assert {c.channels[-1] for c in kept.last} >= set(OIL)
