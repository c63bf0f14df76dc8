import numpy as np
import pytest
from bins_helpers import make_bins

from sealfit.closure.channels import find_channels
from sealfit.closure.forms import richer_laws
from sealfit.effects import EFFECTS
from sealfit.fit.joint import fit_declared
from sealfit.fit.joint.rows import make_rows

DAYS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)


def laws_of(seed, **options):
    options = {"days": DAYS, "repeats": 1, "bins": 3, "setup": 0.003} | options
    rows = make_rows(make_bins(seed, **options), has_aging=True)
    return richer_laws(fit_declared(rows), {c.name: c for c in find_channels(rows)}, EFFECTS)


def lag(table, force):
    days = table["aging_days"].to_numpy() / 3.0
    return force * (1 + 0.15 * days * np.exp(1 - days))


def test_an_induction_time_is_found_though_the_declared_law_bends_towards_it():
    found = {p.term.effect.id: (c, p) for c, p in laws_of(2, specimen=0.003, effect=lag)}
    candidate, proposal = found["aging_induction"]
    assert candidate.p_value < 0.005
    assert candidate.p_value < found["aging_floor"][0].p_value
    assert candidate.claimable
    assert proposal.values["t_i"] == pytest.approx(3.0, rel=0.1)
    assert proposal.values["A"] == pytest.approx(0.15, rel=0.15)


@pytest.mark.long
def test_specimens_that_scatter_show_no_law():
    few = {"speeds": (1.0, 4.0, 16.0, 64.0), "bins": 2, "specimen": 0.02}
    smallest = [min(c.p_value for c, _ in laws_of(seed + 40, **few)) for seed in range(12)]
    # Adjusted for two laws, a third of the error: 1 in 60 below 0.05; three of 12 would have p 0.001. Were
    # half of the p-values below 0.05, three of 12 would be in 98 % of draws.
    assert sum(p < 0.05 for p in smallest) <= 2
    assert min(smallest) > 0.001


def test_too_few_specimens_are_never_sure():
    few = make_rows(make_bins(1, days=(1.0, 4.0, 8.0, 16.0), repeats=1, bins=3, effect=lag), has_aging=True)
    found = richer_laws(fit_declared(few), {c.name: c for c in find_channels(few)}, EFFECTS)
    assert found
    assert not any(
        c.claimable for c, _ in found
    )  # nine specimens, five numbers of the law, two more: two are left


def test_no_law_is_asked_for_without_days():
    rows = make_rows(make_bins(1, days=(), repeats=1, bins=3), has_aging=True)
    assert richer_laws(fit_declared(rows), {c.name: c for c in find_channels(rows)}, EFFECTS) == []
