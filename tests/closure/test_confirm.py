from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from bins_helpers import make_bins

from sealfit.closure.confirm import (
    AT_THE_START,
    NEGATIVE,
    NO_AMPLITUDE,
    OF_THE_RISE,
    Context,
    Gain,
    _by_stroke_number,
    about_means,
    confirmed,
    error_of_rise_N,
    gain_between_settings,
    heldout_gain,
    only_at_start,
    rounding_error_N,
    turns_negative,
    vague_between_speeds,
    varies_within,
)
from sealfit.closure.criteria import RISE_ERROR
from sealfit.closure.left_out import between_speeds, blocks
from sealfit.closure.linearised import Proposal
from sealfit.config import Config, Loop
from sealfit.effects import EFFECTS
from sealfit.fit.joint import fit, fit_declared, fitted_at
from sealfit.fit.joint.model import Term, evaluate
from sealfit.fit.joint.rows import make_rows


def test_a_form_of_one_number_is_not_asked_between_settings():
    """Over three settings a straight line is zero at the middle one, and gains nothing there."""
    before = fit_declared(make_rows(make_bins(0, temperatures=(60.0,), days=(4.0,), bins=4), has_aging=True))
    line = SimpleNamespace(channels=("repeat",), effect=SimpleNamespace(parameters=("A",)))
    assert list(gain_between_settings(before, SimpleNamespace(term=line))) == []


@pytest.mark.parametrize("jitter", [0.0, 1e-15])
def test_the_one_load_of_a_campaign_has_no_settings_whatever_its_rounding(jitter):
    bins = make_bins(0, temperatures=(60.0,), days=(4.0,), bins=6, speeds=(1.0, 3.0, 10.0, 30.0, 100.0))
    rng = np.random.default_rng(0)
    load = bins["load_N"].iloc[0] * (1 + jitter * rng.integers(0, 3, len(bins)))
    rows = make_rows(bins.assign(load_N=load), has_aging=True)
    before = fit_declared(rows)
    warming = EFFECTS["warming_power"]
    term = Term(warming, warming.reads, "mu", "multiply", {"load_N_ref": 49.03, "speed_mm_s_ref": 10.0})
    after = fit(before.model.with_term(term, {"A": 0.01, "tau": 5.0}), rows, before.scatter, turns=0)
    list(gain_between_settings(before, SimpleNamespace(term=term, fitted=after, unit="run")))
    known = [key[2:] for key in before.cache if key[:2] == ("held out", "setting")]
    assert set(known) == {("speed_mm_s", k) for k in range(3)}


def test_a_share_lost_along_strokes_is_held_out_about_their_means_however_much_friction_differs_between_runs():  # noqa: E501
    bins = make_bins(0, temperatures=(60.0,), days=(4.0,), bins=6, speeds=(0.1, 1.0, 100.0))
    rows = make_rows(bins, has_aging=True)
    lost = Term(EFFECTS["exponential_approach"], ("distance_mm",), "mu", "multiply")
    model = fit_declared(rows).model.with_term(lost, {"A": -0.004, "tau": 3.0})
    assert (
        varies_within(SimpleNamespace(term=lost, fitted=SimpleNamespace(rows=rows, model=model))) == "stroke"
    )


@pytest.mark.parametrize("seed", [0, 3])
def test_a_gain_is_weighed_by_the_scatter_that_is_left_with_the_effect_in(seed):
    """Aging with a floor is in the scatter of specimens without it, and each counts for next to nothing."""

    def floor(table, force):
        return force * (1 + 0.05 * np.log(np.maximum(table["aging_days"].to_numpy() / 4, 1)))

    days = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
    tested = {"temperatures": (60.0,), "days": days, "speeds": (1.0, 8.0, 64.0), "repeats": 2, "bins": 3}
    rows = make_rows(make_bins(seed, **tested, specimen=0.005, effect=floor), has_aging=True)
    before = fit_declared(rows)
    term = Term(EFFECTS["aging_floor"], ("aging_days",), "mu", "multiply")
    after = fit(before.model.with_term(term, {"A": 0.05, "t_f": 4.0}), rows, before.scatter, turns=2)
    gain = heldout_gain(before, SimpleNamespace(term=term, fitted=after, unit="specimen"), FIVE_FOLDS, None)
    assert gain.real


def test_one_run_of_a_specimen_in_a_fold_is_compared_with_the_mean_of_all_its_runs():
    """About the mean of the fold's own runs of a specimen, a single one would leave no error at all."""
    bins = make_bins(
        days=(1.0, 2.0, 4.0, 8.0, 16.0),
        speeds=(1.0, 3.0, 10.0, 30.0, 90.0),
        repeats=1,
        bins=4,
        specimen=0.02,
        run_channels={"pressure_bar": lambda rng: rng.uniform(2.0, 8.0)},
        effect=lambda table, force: force + 0.5 * (table["pressure_bar"] - 5.0),
    )
    before = fit_declared(make_rows(bins, has_aging=True))
    term = Term(EFFECTS["linear"], ("pressure_bar",), "force", "add", fixed={"x_ref": 5.0})
    after = fit(before.model.with_term(term, {"A": 0.5}), before.rows, before.scatter, turns=2)
    column = after.force - before.force
    proposal = SimpleNamespace(term=term, fitted=after, unit="run", column=column)
    gain = heldout_gain(before, proposal, FIVE_FOLDS, None)
    assert gain.real
    assert gain.rmse_N > 0.2


def test_blocks_of_the_calendar_are_shorter_than_conditions_that_follow_one_another():
    bins = make_bins(temperatures=(60.0, 80.0), days=(4.0,), repeats=2, bins=4)
    order = bins.groupby("file", sort=True).ngroup()  # one condition after the other
    rows = make_rows(bins.assign(elapsed_h=order.astype(float)), has_aging=True)
    masks = blocks(rows, "run", 3, "elapsed_h")
    assert np.any(masks, axis=0).mean() > 0.5
    assert all(np.unique(rows.condition[~out]).size == len(rows.conditions) for out in masks)


# ---------------------------------------------------------------- the decision, on gains given by hand
FIVE_FOLDS = Loop(folds=5, seed=0)
SAMPLES = pd.DataFrame({"force_N": np.random.default_rng(0).normal(size=50), "stroke_id": 0})
ROWS = SimpleNamespace(force=np.full(3, 10.0), values=lambda channel: channel, has_load=True)
FORCE = SimpleNamespace(rows=ROWS)


FOUR = (1.0, 3.0, 10.0, 100.0)


def test_points_between_speeds_are_halfway_to_the_next_speed_in_both_directions():
    bins = make_bins(0, temperatures=(60.0,), days=(4.0,), bins=2, speeds=FOUR)
    points = between_speeds(make_rows(bins, has_aging=True))
    expected = np.sqrt([3.0, 30.0, 1000.0])
    assert np.unique(np.abs(points.speed)) == pytest.approx(expected, rel=0.01)
    assert set(points.table) >= {"load_N", "time_s", "distance_mm"}
    one = make_rows(make_bins(0, temperatures=(60.0,), days=(4.0,), bins=2, speeds=(3.0,)), has_aging=True)
    assert between_speeds(one).speed.size == 0


def test_a_free_shape_of_few_speeds_beside_the_stribeck_curve_leaves_the_force_between_them_open():
    bins = make_bins(0, temperatures=(60.0,), days=(4.0,), bins=4, speeds=FOUR)
    before = fit_declared(make_rows(bins, has_aging=True))
    term = Term(EFFECTS["quadratic"], ("speed_mm_s",), "mu", "multiply", {"x_ref": 10.0})
    bent = before.refitted(before.model.with_term(term, term.effect.start()))
    assert vague_between_speeds(before, SimpleNamespace(fitted=bent))
    lost = Term(EFFECTS["exponential_approach"], ("distance_mm",), "mu", "multiply")
    warmed = before.refitted(before.model.with_term(lost, {"A": -0.004, "tau": 3.0}))
    assert not vague_between_speeds(before, SimpleNamespace(fitted=warmed))


def proposal(effect="smooth", channels=("run_order",), acts_on="mu", p_value=1e-9, physical=False):
    own = SimpleNamespace(id=effect, physical=physical, label=effect, periodic=False)
    term = SimpleNamespace(effect=own, channels=channels, acts_on=acts_on, operation="multiply")
    return Proposal(term, {}, "run", 1, 0.0, p_value, np.zeros(0), ())


@pytest.fixture
def decide(monkeypatch):
    """Decide on proposals with given gains: held out by groups and by settings, and the force they add."""

    def decided(
        proposals,
        gains,
        settings=(),
        added=1.0,
        samples=SAMPLES,
        vague=False,
        negative=False,
        rise=0.0,
        at_start=False,
        too_large=False,
        **more,
    ):
        held = dict(zip(map(id, proposals), gains, strict=True))
        monkeypatch.setattr("sealfit.closure.confirm.heldout_gain", lambda before, p, *args: held[id(p)])
        monkeypatch.setattr("sealfit.closure.confirm.gain_between_settings", lambda *args: settings)
        monkeypatch.setattr("sealfit.closure.confirm.vague_between_speeds", lambda *args: vague)
        monkeypatch.setattr("sealfit.closure.confirm.turns_negative", lambda fitted: negative)
        monkeypatch.setattr("sealfit.closure.confirm.added_force", lambda p: np.full(3, added))
        monkeypatch.setattr("sealfit.closure.confirm.error_of_rise_N", lambda rows: rise)
        monkeypatch.setattr("sealfit.closure.confirm.only_at_start", lambda *args: at_start)
        monkeypatch.setattr("sealfit.closure.confirm._amplitude_too_large", lambda *args: too_large)
        monkeypatch.setattr("sealfit.closure.confirm.about_means", lambda values, rows, level: values)
        monkeypatch.setattr("sealfit.closure.confirm.follows_strokes", lambda name, rows: name == "time_s")
        monkeypatch.setattr(
            "sealfit.closure.confirm.rivals", lambda chosen, found: [p for p in found if p != chosen]
        )
        said = []
        context = Context(Config(), EFFECTS, **{"compare": False, "say": said.append} | more)
        return *confirmed(FORCE, proposals, samples, context, 2), said

    return decided


GOOD = Gain(0.5, 0.5, 10.0)


@pytest.mark.parametrize(("size", "negative"), [(-0.5, False), (0.9, False), (-1.5, True)])
def test_a_coefficient_times_a_negative_number_is_no_effect(size, negative):
    before = fit_declared(make_rows(make_bins(0, temperatures=(60.0,), days=(4.0,), bins=4), has_aging=True))
    late = Term(EFFECTS["step"], ("time_s",), "mu_s", "multiply")
    place = float(np.median(before.rows.values("time_s")))
    model = before.model.with_term(late, {"A": size, "x_0": place})
    after = fitted_at(model, before.rows, before.scatter)
    assert turns_negative(after) == negative
    added = replace(late, acts_on="force", operation="add")
    assert not turns_negative(replace(after, model=before.model.with_term(added, {"A": size, "x_0": place})))


def test_an_effect_that_turns_a_coefficient_negative_is_refused(decide):
    found, (refused,), _ = decide([proposal("form")], [GOOD], negative=True)
    assert found is None
    assert refused.reason == NEGATIVE


@pytest.mark.parametrize(
    ("gain", "real", "share"),
    [
        (Gain(0.5, 1.5, 10.0, 2.0), True, 0.25),
        (Gain(0.5, 1.5, 1.0, 2.0), False, 0.25),  # no more than its own scatter
        (Gain(-0.5, 1.5, 10.0, 2.0), False, -0.5),
        (Gain(0.0, 0.0, 0.0), False, 0.0),
    ],
)
def test_a_gain_is_real_where_it_exceeds_its_scatter_and_lowers_the_error(gain, real, share):
    assert gain.real == real
    assert gain.share == pytest.approx(share)


def test_the_first_that_gains_is_accepted_with_its_rivals_and_what_they_leave(decide):
    first, second, third = (proposal(f"form {k}") for k in range(3))
    gains = [Gain(-0.1, 1.1, 5.0), Gain(0.3, 0.7, 5.0), Gain(0.2, 0.8, 5.0)]
    found, refused, said = decide([first, second, third], gains, compare=True)
    assert (found.proposal, found.gain_N, found.left_N, found.round) == (second, 0.3, 0.7, 2)
    assert found.rivals == ((first, 1.1), (third, 0.8))
    assert refused == []
    assert said == [
        "  round 2: form 0, factor on mu: held-out gain -0.1 N",
        "  round 2: form 1, factor on mu: held-out gain 0.3 N",
    ]
    found, *_ = decide([first, second, third], gains)
    assert np.isnan([rmse for _, rmse in found.rivals]).all()  # not asked for


def test_after_four_that_gain_nothing_none_is_tried_and_these_are_refused(decide):
    found, refused, said = decide([proposal(f"form {k}") for k in range(5)], [Gain(-1, 2, -1)] * 4 + [GOOD])
    assert found is None
    assert [item.proposal.term.effect.id for item in refused] == [f"form {k}" for k in range(4)]
    assert len(said) == 4


def test_what_is_not_significant_is_not_said_to_be_refused(decide):
    found, refused, _ = decide([proposal(p_value=0.006)], [Gain(-1.0, 2.0, -1.0)])
    assert found is None
    assert refused == []


@pytest.mark.parametrize(
    ("channel", "rise", "refused"), [("time_s", 1.1, True), ("time_s", 0.9, False), ("run_order", 1.1, False)]
)
def test_what_may_be_an_error_of_the_subtracted_rise_is_refused(decide, channel, rise, refused):
    found, reasons, _ = decide([proposal(channels=(channel,))], [GOOD], rise=rise)
    assert (found is None) == refused
    assert [r.reason for r in reasons] == [OF_THE_RISE] * refused
    assert all(r.negligible for r in reasons)


def test_what_is_left_of_the_rise_is_refused_and_nothing_to_explain(decide):
    found, reasons, _ = decide([proposal(channels=("time_s",))], [GOOD], at_start=True)
    assert found is None
    assert [(r.reason, r.negligible) for r in reasons] == [(AT_THE_START, True)]


def test_the_error_of_the_rise_is_a_share_of_what_was_subtracted_along_strokes():
    bins = make_bins(0, temperatures=(60.0,), days=(4.0,), bins=4)
    assert error_of_rise_N(make_rows(bins, has_aging=True)) == 0.0
    bins["presliding_N"] = np.tile([2.0, 1.0, 0.0, 1.0], len(bins) // 4)
    assert error_of_rise_N(make_rows(bins, has_aging=True)) == pytest.approx(RISE_ERROR * np.sqrt(0.5))


STEPS = pd.DataFrame({"force_N": np.repeat([10.0, 10.1, 10.2], 40), "stroke_id": np.repeat([0, 1, 2], 40)})


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"gains": [Gain(0.5, 0.5, 1.0, 2.0)]}, "does not lower the error on held-out data"),
        ({"gains": [Gain(0.0, 0.0, 0.0, known=False)], "added": 0.009}, "no rows can be held out"),
        (
            {"gains": [Gain(-0.5, 0.5, 1.0)], "added": 0.009},
            "lowers the error on held-out data by less than 0.01% of the force",
        ),
        ({"gains": [Gain(0.01, 0.99, 9.0)], "p_value": 1e-4}, "lowers the held-out error by less than 5%"),
        ({"added": 0.0019}, "less than 0.02% of the force"),  # 10 N
        (
            {"added": 0.028, "samples": STEPS},
            "smaller than the resolution of the recorded force",
        ),  # 0.1 N over sqrt(12)
        (
            {"gains": [Gain(0.0009, 0.01, 9.0)]},
            "lowers the error on held-out data by less than 0.01% of the force",
        ),
        ({"settings": [GOOD, Gain(-0.1, 1.0, 1.0)]}, "does not predict held-out settings"),
        ({"vague": True}, "between the tested speeds"),
    ],
)
def test_why_a_proposal_is_refused_is_said(decide, given, reason):
    given = {"gains": [GOOD], "p_value": 1e-9} | given
    found, (refused,), _ = decide([proposal(p_value=given.pop("p_value"))], **given)
    assert found is None
    assert reason in refused.reason


@pytest.mark.parametrize(
    "given",
    [
        {"gains": [Gain(0.01, 0.99, 9.0)]},  # a p-value that leaves no doubt
        {"gains": [Gain(0.06, 0.94, 9.0)], "p_value": 1e-4},
        {"added": 0.0021},
        {"added": 0.029, "samples": STEPS},
        {"settings": [GOOD, GOOD]},
    ],
)
def test_what_just_suffices_is_accepted(decide, given):
    given = {"gains": [GOOD], "p_value": 1e-9} | given
    found, refused, _ = decide([proposal(p_value=given.pop("p_value"))], **given)
    assert found is not None
    assert refused == []


def test_a_ripple_is_no_curve_between_the_speeds(decide):
    wave = proposal("ripple", ("displacement_mm",), "force", 1e-9)
    wave.term.effect.periodic = True
    found, refused, _ = decide([wave], [GOOD], vague=True)
    assert found is not None
    assert refused == []
    found, refused, _ = decide([wave], [GOOD], too_large=True)  # bins as long as the waves
    assert found is None
    assert [r.reason for r in refused] == [NO_AMPLITUDE]


@pytest.mark.parametrize(
    ("effect", "channels", "acts_on", "p_value", "share", "claimed"),
    [
        ("smooth", ("run_order",), "mu", 1e-4, 0.4, True),
        ("smooth", ("run_order",), "v_s", 1e-4, 0.4, False),
        ("smooth", ("run_order",), "v_s", 1e-4, 0.6, True),
        ("smooth", ("run_order",), "v_s", 1e-6, 0.4, True),
        ("surface", ("speed_mm_s", "repeat"), "mu", 1e-4, 0.4, False),
        ("surface", ("oil_ppm", "dust_mg"), "mu", 1e-4, 0.4, True),
        ("asymmetry", ("direction",), "sigma_2", 1e-4, 0.4, True),
        ("warming_distance", ("distance_mm",), "mu_c", 1e-4, 0.4, False),
        ("warming_distance", ("distance_mm",), "mu", 1e-4, 0.4, True),
    ],
)
def test_a_free_shape_that_bends_the_curve_wants_more_evidence(
    decide, effect, channels, acts_on, p_value, share, claimed
):
    made = proposal(effect, channels, acts_on, p_value, physical=effect in ("asymmetry", "warming_distance"))
    found, refused, _ = decide([made], [Gain(share, 1 - share, 10.0)])
    assert (found is not None) == claimed
    assert [item.proposal.weak for item in refused] == ([] if claimed else [True])


@pytest.mark.parametrize(
    ("channels", "p_value", "physical", "share", "claimed"),
    [
        (("time_s",), 2e-4, False, 0.4, False),
        (("time_s",), 2e-4, False, 0.6, True),
        (("time_s",), 2e-4, True, 0.4, True),
        (("time_s",), 1e-5, False, 0.4, True),
        (("run_order", "time_s"), 2e-4, False, 0.4, False),
        (("run_order",), 2e-4, False, 0.4, True),
    ],
)
def test_a_shape_along_strokes_without_a_mechanism_wants_more_evidence(
    decide, channels, p_value, physical, share, claimed
):
    gain = Gain(share, 1 - share, 10.0)
    found, refused, _ = decide([proposal("step", channels, "mu", p_value, physical)], [gain])
    assert (found is not None) == claimed
    assert [item.proposal.weak for item in refused] == ([] if claimed else [True])


# ---------------------------------------------------------------- what a recorder resolves
def test_a_recorder_hides_what_is_less_than_the_rounding_of_its_steps():
    assert rounding_error_N(STEPS) == pytest.approx(0.1 / np.sqrt(12))
    rng = np.random.default_rng(0)
    noisy = STEPS.assign(force_N=(STEPS["force_N"] + rng.normal(0, 0.1, len(STEPS))).round(1))
    assert rounding_error_N(pd.concat([noisy] * 9)) == 0.0  # noise of a step spreads the rounding
    assert rounding_error_N(STEPS.assign(force_N=rng.normal(10, 0.1, len(STEPS)))) == 0.0  # no steps
    assert rounding_error_N(STEPS.assign(force_N=10.0)) == 0.0


@pytest.mark.parametrize(("strokes", "same"), [((1, 2), True), ((2, 1), True), ((1, 1), False)])
def test_an_asymmetry_of_strokes_out_and_back_may_be_one_of_the_stroke_number(strokes, same):
    bins = make_bins(0, temperatures=(60.0,), days=(4.0,), bins=4, directions=(1, -1))
    rows = make_rows(bins.assign(stroke=np.where(bins["direction"] > 0, *strokes)), has_aging=True)
    before = fit_declared(rows)
    term = Term(EFFECTS["asymmetry"], ("direction",), "mu", "multiply")
    after = fitted_at(before.model.with_term(term, {"A": 0.1}), rows, before.scatter)
    column = np.zeros(rows.force.size)
    proposal = Proposal(term, {"A": 0.1}, "run", 10, 1.0, 1e-9, column, ((),), fitted=after)
    found = _by_stroke_number(proposal, EFFECTS["linear"])
    assert [one.term.channels for one in found] == [("stroke",)] * same
    for one in found:
        npt.assert_allclose(evaluate(one.fitted.model, rows, jacobian=False)[0], after.force)


def test_means_are_taken_in_groups_and_directions():
    rows = SimpleNamespace(
        codes=lambda level: np.array([0, 0, 0, 1, 1, 1]), speed=np.array([1, 1, -1, 1, -1, -1])
    )
    values = np.array([1.0, 3.0, 5.0, 7.0, 2.0, 6.0])
    assert about_means(values, rows, "run").tolist() == [-1.0, 1.0, 0.0, 0.0, -2.0, 2.0]
    assert about_means(values, rows, None) is values


@pytest.mark.parametrize(("s_0", "at_start"), [(1.0, True), (15.0, False)])
def test_an_effect_within_the_first_bristle_lengths_is_what_is_left_of_the_rise(s_0, at_start):
    def falls(table, force):
        return force * (1 - 0.2 * -np.expm1(-table["distance_mm"].to_numpy() / s_0))

    bins = make_bins(3, repeats=1, bins=40, days=(), effect=falls)
    bins = bins.assign(rise_mm=0.03 * bins["force_N"].abs())  # bristles of one millimetre
    rows = make_rows(bins, has_aging=True)
    term = Term(EFFECTS["warming_distance"], ("distance_mm",), "mu", "multiply")
    before = fit_declared(rows)
    after = fit(before.model.with_term(term, {"A": 0.2, "s_0": s_0}), rows)
    assert after.rmse_N < before.rmse_N
    assert only_at_start(before, SimpleNamespace(term=term, fitted=after)) == at_start
