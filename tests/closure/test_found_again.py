from dataclasses import replace

import numpy as np
import pytest
from bins_helpers import make_bins

from sealfit.closure.confirm import AcceptedEffect, silent
from sealfit.closure.linearised import Proposal
from sealfit.closure.loop import _found_again
from sealfit.closure.selection import Selection
from sealfit.effects import EFFECTS
from sealfit.fit.joint.estimate import fit, fit_declared
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import make_rows

OIL = {"oil_ppm": lambda rng: rng.normal(50, 10), "humidity_pct": lambda rng: rng.normal(40, 5)}


def term_of(name, target="mu"):
    return Term(EFFECTS["linear"], (name,), target, "multiply", {"x_ref": 50.0})


@pytest.fixture(scope="module")
def grown():
    """A selection with an effect of sure and one of weak evidence."""
    rows = make_rows(make_bins(5, repeats=1, bins=3, run_channels=OIL), has_aging=True)
    before = fit_declared(rows)
    model = before.model
    for name in OIL:
        model = model.with_term(term_of(name), {"A": 1e-3})
    after = fit(model, rows, before.scatter, turns=0)
    added = tuple(
        AcceptedEffect(
            Proposal(t, v, "run", 72, 1e3, p, np.empty(0), (t.channels, "mu", "multiply")), 1.0, 1.0, (), (), 1
        )
        for t, v, p in zip(after.model.terms, after.model.values, (1e-9, 1e-3), strict=True)
    )
    return Selection(before, after, added, (), (), None, None)


def kept(grown, found):
    own, after, refused = _found_again(grown, grown.before, grown.after, found, silent)
    assert [t.channels for t in after.model.terms] == [a.proposal.term.channels for a in own.added]
    return [a.proposal.term.channels[0] for a in own.added], [r.term.channels[0] for r in refused]


def test_weak_evidence_that_no_fold_finds_again_is_refused(grown):
    nothing = grown.before.model
    other = nothing.with_term(term_of("oil_ppm"), {"A": 1e-3})
    assert kept(grown, [nothing] * 5) == (["oil_ppm"], ["humidity_pct"])  # the other is sure
    assert kept(grown, [other] * 5) == (["oil_ppm"], ["humidity_pct"])


def test_weak_evidence_stays_where_a_fold_finds_its_shape_on_any_quantity(grown):
    nothing = grown.before.model
    again = nothing.with_term(term_of("humidity_pct", "mu_c"), {"A": -1e-3})
    assert kept(grown, [nothing, again]) == (["oil_ppm", "humidity_pct"], [])
    assert kept(grown, None) == (["oil_ppm", "humidity_pct"], [])  # no search was repeated


def test_a_lone_effect_that_no_fold_finds_again_leaves_the_declared_model(grown):
    model = grown.before.model.with_term(term_of("humidity_pct"), {"A": 1e-3})
    alone = replace(grown, added=grown.added[1:], after=fit(model, grown.before.rows, grown.before.scatter, turns=0))
    own, after, refused = _found_again(alone, alone.before, alone.after, [alone.before.model], silent)
    assert own.added == ()
    assert after is alone.before
    assert "in no fold" in refused[0].reason
    assert refused[0].weak
