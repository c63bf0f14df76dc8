"""Which of several proposals is reported: equals by rank, and only equals; which are said to be rivals."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from bins_helpers import make_bins

from sealfit.closure import naming
from sealfit.closure.linearised import ZERO_OFFSET, Proposal
from sealfit.closure.naming import _calendar_last, correlation, determined, named_among, rivals
from sealfit.closure.ripple_selection import numbered
from sealfit.closure.ripples import Peak
from sealfit.effects import EFFECTS
from sealfit.effects.free import SURFACE, free_effect
from sealfit.fit.joint import fit_declared
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import Groups, make_rows
from sealfit.fit.joint.tangent import Tangent

UNITS = 100  # log 100 = 4.6 a parameter
CHANNELS = {
    "warming_distance": ("distance_mm",), "warming_time": ("time_s",), "zero_offset": ("direction",),
    "asymmetry": ("direction",), "offset_slope": ("oil_ppm", "direction"),
}  # fmt: skip
KNOTS = {"knots": [0.0, 1.0, 2.0], "x_ref": 0.0}
CHANGING = {"speed_mm_s"}  # along which the amplitude of a wave may change
ALONG, ACROSS = np.array([1.0, 0.0]), np.array([0.0, 1.0])


class HandFit:
    """What naming reads of a joint fit: its effects' values with standard errors, each told by one run."""

    def __init__(self, deviance, terms, values, errors, left=0.0):
        ends = np.cumsum([0, *(len(term.effect.parameters) for term in terms)])
        self.deviance = deviance
        self.model = SimpleNamespace(
            terms=terms, values=values, term_slice=lambda k: slice(ends[k], ends[k + 1])
        )
        self.covariance = np.diag(np.square(np.asarray(errors, dtype=float)))
        self.white_jacobian = Tangent.dense(np.eye(ends[-1]))
        self.rows = SimpleNamespace(groups=Groups.of({"run": np.arange(ends[-1])}))
        self.unit_residual = lambda level: np.full(ends[-1], left)


def numbers_of(effect):
    return {p.name: 1.0 for p in effect.parameters}


def proposal(
    effect, acts_on="mu", operation="multiply", *, behind=0.0, error=0.1, left=0.0, earlier=(), **more
):
    """A refitted proposal whose BIC is `behind` that of 0; `error` and `left` are those of each number."""
    effect = EFFECTS[effect] if isinstance(effect, str) else effect
    term = Term(effect, more.pop("channels", CHANNELS.get(effect.id, ("oil_ppm",))), acts_on, operation)
    deviance = behind - len(effect.parameters) * np.log(UNITS)
    terms, values = [t for t, _ in earlier] + [term], [v for _, v in earlier] + [numbers_of(effect)]
    errors = np.full(sum(len(t.effect.parameters) for t in terms), error)
    fitted = HandFit(deviance, terms, values, errors, left)
    given = {"column": ALONG, "source": (term.channels, acts_on, operation)} | more
    return Proposal(term, values[-1], "run", UNITS, 1.0, 1e-4, fitted=fitted, **given)


@pytest.fixture
def first_of(monkeypatch):
    """Say which proposal is reported of some that are refitted already, on a model with some effects."""
    monkeypatch.setattr(naming, "_refitted", lambda fitted, found: list(found))

    def first(*found, before=()):
        fitted = SimpleNamespace(
            model=SimpleNamespace(terms=[t for t, _ in before], values=[v for _, v in before])
        )
        named = named_among(fitted, found)
        assert sorted(map(id, named)) == sorted(map(id, found))  # none is lost, none comes twice
        assert [p.bic for p in named[1:]] == sorted(p.bic for p in named[1:])
        return named[0]

    return first


@pytest.mark.parametrize(("behind", "first"), [(0.0, "campaign_drift"), (85.0, "linear"), (200.0, "linear")])
def test_the_calendar_comes_first_where_a_named_form_of_it_fits_much_better(behind, first):
    """A free shape of the calendar that fits a little better than the named form does not hide it."""
    calendar = [
        proposal(free_effect("smooth", KNOTS), channels=("elapsed_h",), behind=behind - 2.0),
        proposal("campaign_drift", channels=("elapsed_h",), behind=behind),
    ]
    others = [proposal("linear", channels=("repeat",), behind=90.0)]
    fitted = SimpleNamespace(model=SimpleNamespace(terms=[], values=[]))
    found = _calendar_last(fitted, others, calendar)
    assert found[0].term.effect.id == first
    assert len(found) == 3


def test_a_proposal_costs_the_logarithm_of_the_units_for_each_number():
    made = proposal("warming_distance", behind=7.0)
    assert made.bic_penalty == pytest.approx(2 * np.log(100))
    assert made.bic == pytest.approx(7.0)
    assert proposal("product", channels=("oil_ppm", "dust_mg")).bic_penalty == pytest.approx(
        np.log(100) + 10.0
    )


def test_after_a_fall_of_the_scatter_forms_far_behind_are_not_refitted_but_for_three(monkeypatch):
    monkeypatch.setattr(naming, "deviance_under", lambda fitted, scatter: fitted.deviance)
    found = [proposal("linear", behind=behind) for behind in (700.0, 0.0, 500.0, 290.0, 400.0, 600.0)]
    kept = naming._likeliest_under(found, None)
    assert [p.bic for p in kept] == pytest.approx([0.0, 500.0, 290.0, 400.0, 600.0])


def test_of_none_none_is_named():
    assert named_among(None, []) == []


@pytest.mark.parametrize(
    ("behind", "column", "named"),
    [(2.9, ACROSS, "quadratic"), (3.1, ACROSS, "smooth"), (5.9, ALONG, "quadratic"), (6.1, ALONG, "smooth")],
)
def test_a_closed_form_comes_before_a_free_shape_that_is_hardly_better(first_of, behind, column, named):
    """Hardly is twice as much where both add the same to the force."""
    free = proposal(free_effect("smooth", KNOTS))
    assert first_of(free, proposal("quadratic", behind=behind, column=column)).term.effect.id == named


@pytest.mark.parametrize(("behind", "named"), [(7.5, "warming_distance"), (7.7, "log")])
def test_a_mechanism_of_just_these_channels_need_not_pay_for_its_number_where_it_is_as_likely(
    first_of, behind, named
):
    """By hand: its second number costs log 100 = 4.6, and likelihoods are equal up to a deviance of 3."""
    log = proposal("log", channels=("distance_mm",), column=ACROSS)
    assert first_of(log, proposal("warming_distance", behind=behind)).term.effect.id == named


def test_a_mechanism_whose_length_is_open_comes_after_a_straight_line_that_does_as_well(first_of):
    log, line = (proposal(name, channels=("distance_mm",), column=ACROSS) for name in ("log", "linear"))
    open_ended = proposal("warming_distance", behind=4.0, error=0.9)
    assert first_of(log, open_ended) is open_ended
    assert first_of(line, open_ended) is line


@pytest.mark.parametrize(("error", "left", "known"), [(0.4, 0.0, True), (0.6, 0.0, False), (0.4, 4.0, False)])
def test_a_time_constant_is_determined_where_its_error_is_less_than_half_of_it(error, left, known):
    """By hand: with a whitened residual r for a run, the error that runs show is error^2 r = 0.64."""
    assert determined(proposal("warming_time", error=error, left=left)) == known


@pytest.mark.parametrize(("error", "known"), [(0.4, True), (0.6, False)])
def test_a_place_near_0_is_determined_where_its_error_is_less_than_half_of_the_range(error, known):
    made = proposal("step", channels=("displacement_mm",), error=error)
    at_0 = [replace(p, bounds=(-0.5, 0.5)) if p.name == "x_0" else p for p in made.term.effect.parameters]
    made = replace(made, term=replace(made.term, effect=replace(made.term.effect, parameters=tuple(at_0))))
    made.fitted.model.values[-1]["x_0"] = 1e-6
    assert determined(made) == known


def test_amplitudes_and_phases_need_not_be_determined():
    assert determined(proposal("linear", error=3.0))
    ripple = proposal("ripple", "force", "add", channels=("displacement_mm",))
    ripple.fitted.covariance = np.diag([9.0, 0.01, 9.0])
    assert determined(ripple)
    ripple.fitted.covariance = np.diag([9.0, 0.36, 9.0])
    assert not determined(ripple)


@pytest.mark.parametrize(("change", "named"), [(0.3, "log"), (0.4, "linear")])
def test_of_equals_the_one_that_leaves_earlier_effects_alone_is_named(first_of, change, named):
    term = Term(EFFECTS["asymmetry"], ("direction",), "mu", "multiply")
    moved = proposal("log", earlier=[(term, {"A": 1.0 + change})])
    other = proposal("linear", behind=1.0, earlier=[(term, {"A": 1.0})], channels=("dust_mg",))
    assert first_of(moved, other, before=[(term, {"A": 1.0})]).term.effect.id == named


def test_of_equals_friction_as_a_whole_comes_before_one_coefficient(first_of):
    found = [
        proposal("linear", name, behind=k / 10) for k, name in enumerate(("sigma_2", "mu_s", "force", "mu"))
    ]
    assert first_of(*found).term.acts_on == "mu"


@pytest.mark.parametrize(
    ("behind", "column", "acts_on"),
    [(5.0, ALONG, "mu"), (7.0, ALONG, "force"), (5.0, ALONG + ACROSS, "force")],
)
def test_a_factor_on_friction_comes_before_a_gain_of_the_whole_force_where_both_add_the_same(
    first_of, behind, column, acts_on
):
    gain = proposal("linear", "force")
    assert first_of(gain, proposal("linear", "mu", behind=behind, column=column)).term.acts_on == acts_on


def test_an_offset_of_the_amplifier_comes_before_friction_that_differs_by_direction(first_of):
    offset = proposal("zero_offset", "force", "add", behind=2.0)
    assert offset.source == ZERO_OFFSET
    assert first_of(proposal("asymmetry"), offset) is offset


def test_where_no_equal_is_determined_the_next_that_is_comes_first(first_of):
    open_ended = proposal("saturation", error=0.9)
    assert first_of(open_ended, proposal("quadratic", behind=9.0)).term.effect.id == "quadratic"
    assert first_of(open_ended, proposal("quadratic", behind=11.0)) is open_ended


@pytest.mark.parametrize(("behind", "first"), [(1.0, "mu"), (10.0, "force")])
def test_a_mechanism_acts_on_what_the_strokes_say_where_they_say_it(first_of, behind, first):
    """A logarithm with a number less is as good as both: what it saves does not make the two equals."""
    saved = np.log(UNITS)
    found = [
        proposal("log", "force", channels=("distance_mm",), column=ACROSS),
        proposal("warming_distance", "force", behind=saved + 0.6 - behind),
        proposal("warming_distance", "mu", behind=saved + 0.6),
    ]
    chosen = first_of(*found)
    assert (chosen.term.effect.id, chosen.term.acts_on) == ("warming_distance", first)


# ---------------------------------------------------------------- rivals
def test_correlation_is_that_of_columns_whatever_their_sign_and_nothing_of_an_empty_one():
    one, other = proposal("log"), proposal("linear", column=np.array([-1.0, 1.0]))
    assert correlation(one, other) == pytest.approx(np.sqrt(0.5))
    assert correlation(one, proposal("linear", column=np.zeros(2))) == 0.0


@pytest.mark.parametrize(
    ("cosine", "behind", "told_apart"),
    [(0.99, 50.0, False), (0.99, 70.0, True), (0.9, 9.0, False), (0.9, 11.0, True), (0.4, 1.0, True)],
)
def test_rivals_add_the_same_to_the_force_or_much_of_it_and_are_hardly_worse(cosine, behind, told_apart):
    chosen = proposal("linear")
    other = proposal("log", behind=behind, column=np.array([cosine, np.sqrt(1 - cosine**2)]))
    assert rivals(chosen, [chosen, other]) == ([] if told_apart else [other])


def test_one_equation_under_two_names_is_no_rival_of_itself():
    chosen = proposal("warming_distance")
    same = proposal("exponential_approach", channels=("distance_mm",))
    assert rivals(chosen, [chosen, same]) == []
    elsewhere = proposal("exponential_approach", "force", channels=("distance_mm",))
    assert rivals(chosen, [chosen, elsewhere]) == [elsewhere]


def test_rivals_are_told_apart_under_the_noise_that_the_effect_leaves():
    """The friction of these strokes differs by a third, so a ripple as an added force is no factor on it.

    Strokes start at places of their own: the ripple stands in the noise of the rows while it is missing.
    """
    bins = numbered(make_bins(days=(), repeats=2, noise_N=0.05)).assign(n=1)
    start = np.random.default_rng(1).uniform(0.0, 8.0, bins["file"].nunique())
    place = bins["displacement_mm"] + start[bins["file"].factorize()[0]]
    bins = bins.assign(displacement_mm=place, force_N=bins["force_N"] + np.sin(2 * np.pi * place / 8.0))
    peak = Peak("displacement_mm", 8.0, True, True, 0.0, 0.0, 1.0)
    fitted = fit_declared(make_rows(bins, has_aging=True))
    first, second = naming.propose_ripples(fitted, peak, bins.iloc[:0], EFFECTS, CHANGING)[:2]
    assert (first.term.acts_on, first.term.operation) == ("force", "add")
    assert second.term.effect.id == "ripple"
    assert second.bic - first.bic > 100


@pytest.mark.parametrize(("back", "changes"), [(1.0, False), (0.0, True)])
def test_a_ripple_of_one_direction_has_an_amplitude_that_changes_with_the_direction(back, changes):
    bins = numbered(make_bins(days=(), repeats=2, noise_N=0.05, directions=(1, -1)))
    bins = bins.drop(columns="load_N")  # a rig may lack a channel along which amplitudes may change
    wave = np.sin(2 * np.pi * bins["displacement_mm"] / 8.0)
    strength = np.where(bins["direction"] > 0, 0.3, back * 0.3)
    rows = make_rows(bins.assign(force_N=bins["force_N"] + strength * wave), has_aging=True)
    peak = Peak("displacement_mm", 8.0, True, True, 0.0, 0.0, 1.0)
    changing = {"direction", "speed_mm_s"}
    first, *others = naming.propose_ripples(fit_declared(rows), peak, bins.iloc[:0], EFFECTS, changing)
    assert (first.term.effect.id == "sinusoid_changing") == changes
    assert first.term.channels == ("displacement_mm", "direction")[: 1 + changes]
    assert all(len(p.term.channels) == 1 for p in others)
    if changes:
        values = first.fitted.model.values[-1]
        assert values["B"] == pytest.approx(values["A"], rel=0.2)


def test_a_ripple_far_from_position_0_has_its_phase_near_the_positions():
    bins = numbered(make_bins(days=(), repeats=2, noise_N=0.05))
    bins["force_N"] += 0.3 * np.sin(2 * np.pi * bins["displacement_mm"] / 8.0)
    peak = Peak("displacement_mm", 8.0, True, True, 0.0, 0.0, 1.0)
    near, far = (
        naming.propose_ripples(
            fit_declared(make_rows(moved, has_aging=True)), peak, bins.iloc[:0], EFFECTS, CHANGING
        )[0]
        for moved in (bins, bins.assign(displacement_mm=bins["displacement_mm"] + 1e6))
    )
    assert (near.term.fixed["x_ref"], far.term.fixed["x_ref"]) == (0.0, 1e6)
    values, same = (p.fitted.model.values[-1] for p in (near, far))
    assert [same[name] for name in values] == pytest.approx(list(values.values()), rel=1e-4)


def test_proposals_of_one_term_are_compared_by_identity():
    one, other = (proposal("linear", column=np.array([1.0, 2.0])) for _ in range(2))
    assert one in [one]
    assert one not in [other]


def test_every_set_of_variables_that_explains_nearly_as_much_has_named_forms_among_those_refitted():
    along = [proposal(name, behind=k) for k, name in enumerate(("log", "quadratic", "power", "bump"))]
    time = [proposal(name, behind=30.0 + k, channels=("time_s",)) for k, name in enumerate(("linear", "log"))]
    kept = naming._best_few([*time, *along])
    assert all(p in kept for p in time)
    further = naming._further_forms(time[0], kept, [*time, *along, proposal("power", channels=("time_s",))])
    assert [p.term.effect.id for p in further] == ["power"]


def test_a_mechanism_that_explains_nearly_as_much_is_among_those_refitted():
    names, along = (
        ("linear", "log", "quadratic", "power", "saturation", "hyperbolic", "bump", "step"),
        ("distance_mm",),
    )
    first = [proposal(name, behind=k, channels=along) for k, name in enumerate(names)]
    first = [replace(p, chi2=100.0) for p in first]
    warming, weak = (replace(proposal("warming_distance", behind=30.0), chi2=chi2) for chi2 in (90.0, 50.0))
    assert warming in naming._best_few([warming, *first])
    assert weak not in naming._best_few([weak, *first])


def test_a_free_shape_of_a_quantity_leaves_its_named_forms_among_those_refitted():
    names = ("linear", "log", "quadratic", "power", "saturation", "hyperbolic", "bump", "step")
    first = [proposal(name, "force", behind=k) for k, name in enumerate(names)]
    surface = proposal(replace(EFFECTS["linear"], id=SURFACE), "mu", behind=20.0)
    named = proposal("exponential_approach", "mu", behind=30.0)
    kept = naming._best_few([named, surface, *first])
    assert surface in kept
    assert named in kept
