import numpy as np
import pytest
from bins_helpers import TWO_FOLDS, make_bins, make_traces

from sealfit.closure import rename_effects
from sealfit.closure.channels import find_channels
from sealfit.closure.confirm import AcceptedEffect, Context
from sealfit.closure.criteria import PAIR_PENALTY
from sealfit.closure.forms import terms_of
from sealfit.closure.linearised import Proposal, linearised
from sealfit.closure.ripple_selection import numbered, steady_samples
from sealfit.closure.score_test import Candidate, ScoreTestResult, ScoreTests
from sealfit.closure.search import search
from sealfit.closure.selection import select_effects
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.effects.free import free_effect
from sealfit.fit.joint import fit, fit_declared
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import make_rows

OIL = {"oil_ppm": lambda rng: rng.normal(50, 10)}


def fitted_of(**options):
    return fit_declared(make_rows(make_bins(5, repeats=2, bins=6, setup=0.003, **options), has_aging=True))


@pytest.mark.long
def test_a_shape_of_no_catalogue_is_one_effect_and_not_two_bumps():
    def sigmoid(table, force):
        return force * (1 + 0.06 * np.tanh((table["oil_ppm"].to_numpy() - 50) / 3))

    bins = make_bins(5, setup=0.003, effect=sigmoid, run_channels=OIL, bins=6)
    rows = make_rows(numbered(bins), has_aging=True)
    selection = select_effects(rows, steady_samples(make_traces(bins), rows), Context(TWO_FOLDS, EFFECTS))
    (effect,) = selection.added
    assert effect.proposal.term.channels == ("oil_ppm",)
    assert selection.left is None
    true = 0.06 * np.tanh((rows.values("oil_ppm") - 50) / 3) * rows.force
    found = selection.after.force - selection.before.force
    assert np.corrcoef(found, true)[0, 1] > 0.95


def test_two_humps_that_hide_in_the_scatter_of_runs_are_found():
    def humps(table, force):
        oil = table["oil_ppm"].to_numpy()
        return force * (1 + 0.03 * (np.exp(-(((oil - 40) / 4) ** 2)) + np.exp(-(((oil - 60) / 4) ** 2))))

    rows = fitted_of(effect=humps, run_channels=OIL).rows
    found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0))
    best = min(found, key=lambda c: c.p_value)
    assert best.channels == ("oil_ppm",)
    assert best.p_value < 0.005


def test_a_load_that_does_not_vary_may_be_read_where_that_is_another_equation():
    fitted = fitted_of()
    channels = {c.name: c for c in find_channels(fitted.rows)}
    assert "load_N" not in channels
    test_result = ScoreTestResult(1.0, 4, 72, -1.0)
    candidate = Candidate(("time_s",), "mu", "multiply", "run", np.empty((0, 4)), test_result)
    ids = {term.effect.id for term, _ in terms_of(candidate, channels, fitted, EFFECTS)}
    assert {"warming_time", "warming_power"} <= ids
    candidate = Candidate(("distance_mm",), "mu", "multiply", "run", np.empty((0, 4)), test_result)
    ids = {term.effect.id for term, _ in terms_of(candidate, channels, fitted, EFFECTS)}
    assert "warming_conduction" in ids
    assert "warming_conduction_load" not in ids  # the same equation at one load


def test_two_channels_together_pay_for_being_one_of_many():
    fitted = fitted_of(run_channels=OIL)
    channels = {c.name: c for c in find_channels(fitted.rows)}
    test_result = ScoreTestResult(1.0, 1, 72, -1.0)
    bic_penalty = {}
    for names, pair in ((("oil_ppm",), False), (("oil_ppm", "time_s"), True)):
        candidate = Candidate(names, "mu", "multiply", "run", np.empty((0, 1)), test_result, pair=pair)
        for term, searched in terms_of(candidate, channels, fitted, EFFECTS):
            for proposal in linearised(fitted, term, searched, candidate):
                bic_penalty[term.effect.id] = proposal.bic_penalty
    assert bic_penalty["product"] - bic_penalty["linear"] == pytest.approx(PAIR_PENALTY)


def test_an_effect_is_not_given_up_for_one_that_fits_worse(monkeypatch):
    def warming_and_oil(table, force):
        warming = 0.1 * np.expm1(-table["distance_mm"].to_numpy() / 10)
        return force * (1 + warming + 3e-4 * (table["oil_ppm"].to_numpy() - 50))

    bins = make_bins(5, repeats=2, bins=12, noise_N=0.05, gain=5e-4, effect=warming_and_oil, run_channels=OIL)
    rows = make_rows(bins, has_aging=True)
    model = fit_declared(rows).model
    warming = Term(EFFECTS["warming_distance"], ("distance_mm",), "force", "multiply")
    oil = Term(EFFECTS["linear"], ("oil_ppm",), "force", "multiply", {"x_ref": 50.0})
    model = model.with_term(warming, {"A": 0.1, "s_0": 10.0}).with_term(oil, {"A": 3e-4})
    fitted = fit(model, rows, turns=2)
    added = [
        AcceptedEffect(
            Proposal(t, v, "run", 72, 1e3, 1e-3, np.empty(0), (t.channels, "force", "multiply")),
            1.0,
            1.0,
            (),
            1,
        )
        for t, v in zip(fitted.model.terms, fitted.model.values, strict=True)
    ]
    refitted = []

    def without_its_own_curve(*given):
        refitted.extend(
            p for p in propose(*given) if p.term.effect.id not in ("warming_distance", "exponential_approach")
        )
        return refitted

    propose = rename_effects.propose
    monkeypatch.setattr(rename_effects, "propose", without_its_own_curve)
    channels = {c.name: c for c in find_channels(rows)}
    again = rename_effects.Renaming(channels, rows.table.head(0), Context(Config(), EFFECTS, compare=False))
    after, kept = again.earlier_renamed(fitted, added)
    assert refitted
    assert kept is added
    assert after is fitted


def in_place_of(bins, *terms, gain_N=1.0, **options):
    """Return what stands in place of terms with their starts, each accepted beside those before it."""
    rows = make_rows(numbered(bins), has_aging=True)
    fits = [fit_declared(rows)]
    for term, values in terms:
        fits.append(fit(fits[-1].model.with_term(term, values), rows, fits[-1].scatter, turns=2))

    def accepted(term, values, fitted):
        source = (term.channels, term.acts_on, term.operation)
        units = rows.groups.starts["run"].size
        proposal = Proposal(term, values, "run", units, 1e3, 1e-9, np.empty(0), source, fitted=fitted)
        return AcceptedEffect(proposal, gain_N, 1.0, (), 1)

    *earlier, new = (accepted(t, v, f) for (t, v), f in zip(terms, fits[1:], strict=True))
    channels = {c.name: c for c in find_channels(rows)}
    again = rename_effects.Renaming(channels, rows.table.head(0), Context(Config(), EFFECTS, compare=False))
    earlier, new = again.merged_with_earlier(fits[-2], earlier, new, **options)
    return [a.proposal.term for a in (*earlier, new)]


def test_an_asymmetry_of_mu_told_as_two_of_its_ends_is_one_effect():
    def asymmetric(table, force):
        return force * (1 + 0.02 * table["direction"].to_numpy())

    bins = make_bins(
        3, temperatures=(60.0,), directions=(1, -1), repeats=2, bins=4, noise_N=0.1, effect=asymmetric
    )
    ends = [
        (Term(EFFECTS["asymmetry"], ("direction",), q, "multiply"), {"A": 0.04}) for q in ("mu_s", "mu_c")
    ]
    (term,) = in_place_of(bins, *ends)
    assert (term.effect.id, term.acts_on) == ("asymmetry", "mu")


def test_an_offset_and_an_asymmetry_that_are_both_there_stay_two():
    def both(table, force):
        return force * (1 + 0.02 * table["direction"].to_numpy()) + 0.5

    bins = make_bins(3, directions=(1, -1), repeats=2, bins=4, noise_N=0.1, effect=both)
    offset = Term(EFFECTS["zero_offset"], ("direction",), "force", "add"), {"A": 0.5}
    terms = in_place_of(
        bins, offset, (Term(EFFECTS["asymmetry"], ("direction",), "mu", "multiply"), {"A": 0.04})
    )
    assert [t.effect.id for t in terms] == ["zero_offset", "asymmetry"]


@pytest.mark.long
def test_a_change_with_time_told_by_distance_and_by_displacement_is_one_effect():
    def growing(table, force):
        return force * (1 + 0.004 * table["time_s"].to_numpy())

    bins = make_bins(3, repeats=2, bins=6, noise_N=0.1, effect=growing)
    forms = (EFFECTS["linear"], "distance_mm"), (EFFECTS["log"], "displacement_mm")
    two = (Term(effect, (name,), "mu", "multiply", {"x_ref": 20.0}) for effect, name in forms)
    (term,) = in_place_of(bins, *((t, {"A": 1e-3}) for t in two))
    assert term.channels == ("time_s",)


def test_a_product_told_as_a_sum_of_two_is_one_effect():
    channels = {name: lambda rng: rng.uniform(0, 10) for name in ("oil_ppm", "humidity_pct")}

    def product(table, force):
        return force * (1 + 0.002 * table["oil_ppm"].to_numpy() * table["humidity_pct"].to_numpy())

    bins = make_bins(
        3, temperatures=(60.0,), repeats=2, bins=3, noise_N=0.1, effect=product, run_channels=channels
    )
    two = [(Term(EFFECTS["linear"], (n,), "mu", "multiply", {"x_ref": 5.0}), {"A": 0.01}) for n in channels]
    (term,) = in_place_of(bins, *two)
    assert set(term.channels) == set(channels)
    assert len(in_place_of(bins, *two, pending=True)) == 2  # a third is to come, beside which alone one shows


TWO = {name: lambda rng: rng.uniform(0, 10) for name in ("oil_ppm", "humidity_pct")}


def curve(name):
    fixed = {"knots": (0.0, 2.5, 5.0, 7.5, 10.0), "x_ref": 0.0}
    term = Term(free_effect("smooth", fixed), (name,), "mu", "multiply", fixed)
    return term, dict.fromkeys(term.effect.linear, 0.0)


def waves_of_the_sum(table, force):
    return force * (1 + 0.05 * np.sin(0.25 * (table["oil_ppm"] + table["humidity_pct"]).to_numpy()))


def sum_of_waves(table, force):
    oil, humidity = (table[name].to_numpy() for name in TWO)
    return force * (1 + 0.03 * np.sin(oil / 2) + 0.03 * np.cos(humidity / 2))


@pytest.mark.parametrize(
    ("effect", "found"), [(waves_of_the_sum, ["surface"]), (sum_of_waves, ["smooth", "smooth"])]
)
def test_a_surface_takes_the_place_of_two_curves_unless_they_add_up(effect, found):
    bins = make_bins(4, repeats=2, bins=3, noise_N=0.1, effect=effect, run_channels=TWO)
    terms = in_place_of(bins, *map(curve, TWO))
    assert [term.effect.id for term in terms] == found
    assert {name for term in terms for name in term.channels} == set(TWO)


def test_what_one_effect_leaves_unexplained_is_not_taken_for_scatter_of_files():
    pressures = {"pressure_bar": lambda rng: rng.uniform(0, 10)}
    bins = make_bins(7, temperatures=(), days=(), bins=8, gain=0.002, run_channels=pressures)
    current = np.random.default_rng(1).normal(0, 1, len(bins))
    force = bins["force_N"] + current + 0.3 * bins["pressure_bar"]
    rows = make_rows(bins.assign(current_A=current, force_N=force), has_aging=False)
    first, second = (
        Term(EFFECTS["linear"], (name,), "force", "add", {"x_ref": 0.0})
        for name in ("current_A", "pressure_bar")
    )
    model = fit_declared(rows).model.with_term(first, {"A": 1.0})
    one, two = fit(model, rows, turns=3), fit(model.with_term(second, {"A": 0.3}), rows, turns=3)
    source = (first.channels, "force", "add")
    proposal = Proposal(first, {"A": 1.0}, "run", 8, 1e3, 1e-9, np.empty(0), source, fitted=one)
    lead = rename_effects._lead(proposal, two)
    assert lead == pytest.approx(two.deviance - one.deviance)
    assert lead < 2 * (rename_effects.deviance_under(two, one.scatter) - one.deviance)


@pytest.mark.long
def test_no_surface_changes_with_the_calendar():
    def changes(table, force):
        oil, hours = (table[name].to_numpy() for name in ("oil_ppm", "elapsed_h"))
        return force * (1 + 0.05 * np.sin(0.25 * (oil + hours)))

    columns = {name: TWO["oil_ppm"] for name in ("oil_ppm", "elapsed_h")}
    bins = make_bins(4, repeats=3, bins=3, noise_N=0.1, effect=changes, run_channels=columns)
    terms = in_place_of(bins, curve("oil_ppm"), curve("elapsed_h"))
    assert all(term.effect.id != "surface" for term in terms)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_of_an_unconfirmed_effect_and_a_later_one_the_one_that_explains_least_goes(order, monkeypatch):
    def oil_only(table, force):
        return force * (1 + 1e-3 * (table["oil_ppm"].to_numpy() - 50))

    rows = make_rows(
        numbered(make_bins(5, repeats=2, bins=4, effect=oil_only, run_channels=OIL)), has_aging=True
    )
    slow = Term(EFFECTS["linear"], ("time_s",), "mu", "multiply", {"x_ref": 10.0})
    oil = Term(EFFECTS["linear"], ("oil_ppm",), "mu", "multiply", {"x_ref": 50.0})
    model = fit_declared(rows).model
    for k in order:
        model = model.with_term((slow, oil)[k], {"A": 1e-3})
    fitted = fit(model, rows, turns=2)
    added = [
        AcceptedEffect(
            Proposal(t, v, "run", 72, 1e3, 1e-9, np.empty(0), (t.channels, "mu", "multiply")),
            1.0,
            1.0,
            (),
            k,
        )
        for k, (t, v) in enumerate(zip(fitted.model.terms, fitted.model.values, strict=True))
    ]
    channels = {c.name: c for c in find_channels(rows)}
    monkeypatch.setattr(rename_effects, "confirmed", lambda *given: (None, []))
    again = rename_effects.Renaming(channels, rows.table.head(0), Context(Config(), EFFECTS, compare=False))
    after, kept = again.earlier_renamed(fitted, added)
    assert [a.proposal.term.channels for a in kept] == [("oil_ppm",)]
    assert [t.channels for t in after.model.terms] == [("oil_ppm",)]
    held, _ = again.earlier_renamed(after, kept)
    assert held is after
