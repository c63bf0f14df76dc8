"""One law of aging for all series: truth comes back, evidence chooses the shape, and intervals hold."""

import os
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import least_squares
from scipy.sparse import csr_array

from sealfit.errors import FitError, RequestError
from sealfit.fit.aging.joint_law import (
    MOST_LEFT_OUT,
    Aged,
    fit_joint_law,
    fit_laws,
    left_out,
    rivals_of,
    solved_many,
)
from sealfit.fit.aging.lifetime import (
    DAYS_PER_YEAR,
    Goal,
    answer,
    goal_of,
    lifetime,
    over_laws,
    resampled,
    temperature_for,
)
from sealfit.fit.joint.whitening import log_determinant, whitening_of
from sealfit.fit.least_squares import central_jacobian
from sealfit.physics.aging_laws import LOSSES

MEASURED = os.environ.get("SEALFIT_MEASURED")
R = 8.314462618e-3
DAYS = (1.0, 2.0, 4.0, 8.0, 12.0, 16.0)


def campaign(
    loss="log", own=(0.1,), *, energy=80.0, kappa=0.02, way="rate", a=0.05, scatter=0.005, seed=1, repeats=1
):
    """Values of one quantity over three temperatures and two compressions, and the unaged rubber."""
    rng = np.random.default_rng(seed)
    rows = [(0.0, 23.0, 100.0)] * repeats
    rows += [
        (t, T, C) for T in (40.0, 60.0, 80.0) for C in (80.0, 90.0) for t in DAYS for _ in range(repeats)
    ]
    days, celsius, percent = np.array(rows).T
    k = np.exp(energy / R * (1 / 333.15 - 1 / (celsius + 273.15)) + kappa * (85.0 - percent))
    phi = LOSSES[loss].value
    lost = a * (phi(k * days, *own) if way == "rate" else k * phi(days, *own))
    value = (0.93 - np.where(days > 0, lost, 0.0)) * (1 + scatter * rng.standard_normal(days.size))
    return Aged(days, value, celsius, percent, np.full(days.size, 1e-8))


@pytest.mark.parametrize(
    ("loss", "own"),
    [("log", (0.1,)), ("stretched", (4.0, 0.6)), ("power", (0.4,)), ("induction", (0.3, 2.0))],
)
def test_exact_values_give_the_law_back(loss, own):
    a = {"stretched": 0.3, "power": 0.05}.get(loss, 0.05)
    law = fit_joint_law(campaign(loss, own, a=a, scatter=0.0), loss, "rate")
    found = {name: value for name, value, *_ in law.parameters()}
    assert found["mu_0"] == pytest.approx(0.93, rel=1e-5)
    if (
        loss != "power"
    ):  # a power of k t is a power of k times one of t: a takes what the rate at the reference leaves
        assert found["a"] == pytest.approx(a, rel=1e-3)
    for name, value in zip(LOSSES[loss].parameters, own, strict=True):
        assert found[name] == pytest.approx(value, rel=1e-2)
    assert found["E"] == pytest.approx(80.0, rel=1e-3)
    assert found["kappa"] == pytest.approx(0.02, rel=1e-2)


@pytest.mark.parametrize(("loss", "own", "a"), [("log", (0.1,), 0.05), ("stretched", (4.0, 0.6), 0.3)])
def test_evidence_chooses_the_shape_that_is_true(loss, own, a):
    laws = fit_laws(campaign(loss, own, a=a, scatter=0.003))
    assert (laws[0].loss.name, laws[0].acts_on) == (loss, "rate")
    assert all(law.bic > laws[0].bic for law in laws[1:])
    assert left_out(laws[0])["series"] < 0.02


def test_a_factor_on_the_loss_is_told_from_one_on_the_rate():
    laws = fit_laws(campaign(way="loss", energy=20.0, scatter=0.003))
    assert (laws[0].loss.name, laws[0].acts_on) == ("log", "loss")


@pytest.mark.parametrize("seed", range(12))
def test_a_law_that_passes_through_nearly_all_values_is_not_compared(seed):
    days = np.array([0.0, 3.0, 10.0, 30.0, 60.0])
    value = 0.88 - 0.062 * np.log1p(days / 0.8)
    value *= 1 + 0.007 * np.random.default_rng(seed).standard_normal(days.size)
    laws = fit_laws(Aged(days, value, None, None, None))
    assert {law.loss.name for law in laws} == {"log", "power"}
    life = lifetime(laws[0], Goal(0.5), None, None)
    assert 100.0 < life.days < 1500.0  # 366 d


def test_a_law_without_degrees_of_freedom_is_not_compared_with_one_that_has_some():
    days, value = np.array([0.0, 7.0, 21.0, 56.0]), np.array([0.70, 0.602, 0.570, 0.531])
    laws = fit_laws(Aged(days, value))
    assert {law.loss.name for law in laws} == {"log", "power"}
    assert {law.loss.name for law in fit_laws(Aged(days[:3], value[:3]))} == {"log", "power"}


def test_intervals_hold_the_truth():
    hits = []
    for seed in range(30):
        law = fit_joint_law(campaign(scatter=0.01, seed=seed), "log", "rate")
        truth = {"mu_0": 0.93, "a": 0.05, "b": 0.1, "E": 80.0, "kappa": 0.02}
        hits += [low <= truth[name] <= high for name, _, low, high, _ in law.parameters()]
    assert 0.90 <= np.mean(hits) <= 0.985


def test_too_few_conditions_are_refused():
    aged = Aged(np.array([0.0, 1.0]), np.array([0.9, 0.8]))
    with pytest.raises(FitError, match="do not determine"):
        fit_laws(aged)


def test_one_series_alone_has_neither_energy_nor_compression():
    days = np.array([0.0, *DAYS])
    law = fit_laws(Aged(days, 0.93 - 0.05 * np.log1p(days / 0.1), np.full(7, 60.0), np.full(7, 80.0)))[0]
    assert law.names == ("mu_0", "a", "b")
    assert lifetime(law, Goal(0.75)).days == pytest.approx(0.1 * np.expm1(0.18 / 0.05), rel=1e-3)


# ---------------------------------------------------------------- lifetime
def test_days_to_a_threshold_are_those_of_the_law():
    law = fit_joint_law(campaign(scatter=0.0), "log", "rate")
    k = np.exp(80.0 / R * (1 / 333.15 - 1 / 313.15) + 0.02 * (85.0 - 80.0))
    found = lifetime(law, Goal(0.70), 40.0, 80.0)
    assert found.days == pytest.approx(0.1 * np.expm1(0.23 / 0.05) / k, rel=1e-3)
    assert found.threshold == 0.70
    assert lifetime(law, Goal(loss=0.23 / 0.93), 40.0, 80.0).days == pytest.approx(found.days, rel=1e-6)


def test_beyond_the_tests_is_marked_and_by_how_much():
    law = fit_joint_law(campaign(scatter=0.002), "log", "rate")
    inside = lifetime(law, Goal(0.80), 60.0, 80.0)
    assert not inside.extrapolated
    far = lifetime(law, Goal(0.45), 60.0, 80.0)
    assert far.extrapolated
    assert far.beyond > 2
    assert lifetime(law, Goal(0.80), 20.0, 70.0).outside == ("temperature", "compression")


def test_a_floor_above_the_threshold_is_never_passed():
    law = fit_joint_law(campaign("stretched", (4.0, 0.6), a=0.3, scatter=0.0), "stretched", "rate")
    assert lifetime(law, Goal(0.5), 60.0, 80.0).days == np.inf
    assert lifetime(law, Goal(0.99), 60.0, 80.0).days == 0.0


def test_a_threshold_that_some_draws_reach_has_an_interval():
    law = fit_joint_law(campaign("stretched", (4.0, 0.6), a=0.3, scatter=0.02, seed=2), "stretched", "rate")
    limit, start = law.x[0] - law.x[1], law.x[0]
    never, at_once = (
        lifetime(law, Goal(limit - 0.002), 60.0, 80.0),
        lifetime(law, Goal(start + 0.002), 60.0, 80.0),
    )
    assert never.days == np.inf
    assert 0 < never.low < never.high == np.inf
    assert (at_once.days, at_once.low) == (0.0, 0.0)
    assert 0 < at_once.high < 10
    low, high = over_laws([law], Goal(limit - 0.002), 60.0, 80.0)
    assert low == pytest.approx(never.low, rel=1e-6)
    assert high == np.inf


def test_the_delta_interval_agrees_with_values_drawn_anew():
    law = fit_joint_law(campaign(scatter=0.01), "log", "rate")
    found = lifetime(law, Goal(0.75), 50.0, 85.0)
    low, high = resampled(law, Goal(0.75), 50.0, 85.0)
    assert np.log(high / low) == pytest.approx(np.log(found.high / found.low), rel=0.25)
    assert low < found.days < high


def test_the_interval_over_one_law_is_its_own():
    laws = fit_laws(campaign(scatter=0.003))
    own = lifetime(laws[0], Goal(0.75), 50.0, 85.0)
    assert over_laws(laws[:1], Goal(0.75), 50.0, 85.0) == pytest.approx((own.low, own.high), rel=1e-6)


def test_the_interval_over_laws_reaches_over_rivals_that_cannot_be_told_apart():
    series = campaign(scatter=0.02, seed=3)
    laws = fit_laws(
        series.part((series.days == 0) | ((series.temperature_C > 50) & (series.compression_ratio_pct == 80)))
    )
    goal = Goal(0.55)  # beyond the tests, where the laws part
    own = lifetime(laws[0], goal, 60.0)
    low, high = over_laws(laws, goal, 60.0)
    assert np.log(high / low) > np.log(own.high / own.low)
    assert low < own.days < high


def test_an_end_that_a_likely_law_leaves_open_stays_open():
    laws = fit_laws(campaign("stretched", (4.0, 0.6), a=0.3, scatter=0.0005))
    assert over_laws(laws, Goal(0.3), 60.0, 80.0)[1] == np.inf


def whitened(covariance):
    return whitening_of(csr_array(covariance))


def alone(law, covariance, values, keep=slice(None)):
    """The parameters by scipy, of some values by themselves."""
    white = whitened(covariance[keep][:, keep])
    return least_squares(
        lambda x: white @ (law.at(law.aged, x) - values)[keep],
        law.x,
        x_scale="jac",
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
    ).x


def test_many_draws_at_once_are_fitted_as_each_alone():
    law = fit_joint_law(campaign(scatter=0.01), "log", "rate")
    covariance = law.aged.covariance(law.scatter).toarray()
    drawn = np.random.default_rng(2).multivariate_normal(law.at(law.aged), covariance, 6)
    for values, x in zip(drawn, solved_many(law, whitened(covariance), drawn), strict=True):
        assert x == pytest.approx(alone(law, covariance, values), rel=1e-5, abs=1e-6)


def test_the_error_at_values_left_out_is_that_of_a_law_fitted_without_them():
    """With a common error of a series, so that what is left out is correlated with what stays."""
    aged = campaign(scatter=0.01)
    common = 1e-5 * (aged.series()[:, None] == aged.series()) + np.diag(aged.variance)
    law = fit_joint_law(replace(aged, variance=common), "log", "rate")
    covariance, found = law.aged.covariance(law.scatter).toarray(), left_out(law)
    for name, masks in (("series", aged.whole_series()), ("last_day", aged.last_days())):
        fits = [(out, alone(law, covariance, aged.value, ~out)) for out in masks]
        errors = np.concatenate([(law.at(law.aged, x) - aged.value)[out] for out, x in fits])
        assert found[name] == pytest.approx(np.sqrt(np.mean(errors**2)), rel=1e-5)


def test_of_many_series_some_are_left_out_in_turn():
    rng = np.random.default_rng(1)
    days = np.tile([1.0, 4.0, 16.0], 200)
    celsius = np.repeat(np.linspace(40.0, 80.0, 200), 3)
    value = 0.9 - 0.05 * np.log1p(days / 0.1) + 0.01 * rng.standard_normal(600)
    masks = Aged(days, value, celsius).whole_series()
    assert len(masks) == MOST_LEFT_OUT
    assert masks[0][:3].all()
    assert masks[-1][-3:].all()
    assert {int(own.sum()) for own in masks} == {3}
    assert len(Aged(days[:60], value[:60], celsius[:60]).last_days()) == 20


def test_memory_grows_as_the_conditions():
    """3,999 values of 1,333 series: an array of n by n numbers has 128 MB."""
    rng = np.random.default_rng(1)
    celsius = np.repeat(np.linspace(40.0, 80.0, 1333), 3)
    days = np.tile([1.0, 4.0, 16.0], 1333)
    value = (0.9 - 0.05 * np.log1p(days / 0.1)) * (1 + 0.01 * rng.standard_normal(days.size))
    tracemalloc.start()
    law = fit_joint_law(Aged(days, value, celsius, variance=np.full(days.size, 1e-6)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert law.x[0] == pytest.approx(0.9, abs=0.01)
    assert peak < 60e6


@pytest.mark.parametrize("scatter", [0.0, 0.02])
def test_whitened_values_have_the_covariance(scatter):
    aged = campaign(scatter=0.01)
    common = 1e-5 * (aged.series()[:, None] == aged.series()) + np.diag(aged.variance)
    aged = replace(aged, variance=common)
    covariance, residual = aged.covariance(scatter).toarray(), np.sin(np.arange(aged.value.size))
    white = aged.whitening(scatter)
    assert white @ covariance @ white.T == pytest.approx(np.eye(aged.value.size), abs=1e-9)
    assert aged.chi2(residual, scatter) == pytest.approx(residual @ np.linalg.solve(covariance, residual))
    assert log_determinant(white) == pytest.approx(np.linalg.slogdet(covariance)[1])


@pytest.mark.parametrize("acts_on", ["rate", "loss"])
@pytest.mark.parametrize("loss", LOSSES)
def test_the_slope_of_a_law_is_that_of_its_values(loss, acts_on):
    law = replace(fit_joint_law(campaign(scatter=0.01), "log"), loss=LOSSES[loss], acts_on=acts_on)
    own = len(law.loss.parameters)
    law = replace(law, names=("mu_0", "a", *law.loss.parameters, "E", "kappa"))
    x = np.array([[0.9, 0.05, *[0.3, -0.4][:own], 70.0, 0.02], [0.8, 0.1, *[-1.2, 0.2][:own], 20.0, -0.01]])
    expected = [central_jacobian(lambda at: law.at(law.aged, at), one).T for one in x]
    assert law.slope(law.aged, x) == pytest.approx(np.array(expected), rel=1e-8, abs=1e-10)


def test_correlated_values_weigh_as_their_covariance_says():
    """Half of the values measured with a common error: the same law as on differences and the other half."""
    law = fit_joint_law(campaign(scatter=0.0), "log", "rate")
    known = law.aged
    spread = np.diag(np.full(known.days.size, 1e-8))
    common = (known.temperature_C == 80.0) & (known.days > 0)
    spread += 1e-4 * np.outer(common, common)
    shifted = replace(known, value=known.value + 0.02 * common, variance=spread)
    assert fit_joint_law(shifted, "log", "rate").x == pytest.approx(law.x, rel=0.02, abs=2e-3)
    blind = replace(shifted, variance=np.diag(spread))
    assert abs(fit_joint_law(blind, "log", "rate").x[3] - law.x[3]) > 3.0  # E takes the common error up


def test_lifetimes_hold_the_truth():
    k = np.exp(80.0 / R * (1 / 333.15 - 1 / 313.15) + 0.02 * (85.0 - 80.0))
    truth = 0.1 * np.expm1(0.23 / 0.05) / k
    found = [
        lifetime(fit_joint_law(campaign(scatter=0.01, seed=s), "log", "rate"), Goal(0.70), 40.0, 80.0)
        for s in range(30)
    ]
    assert 0.86 <= np.mean([f.low <= truth <= f.high for f in found]) <= 1.0


def test_the_temperature_for_ten_years_gives_ten_years():
    law = fit_joint_law(campaign(scatter=0.002), "log", "rate")
    celsius, low, high = temperature_for(law, Goal(0.6), 10.0, 80.0)
    assert low < celsius < high
    assert lifetime(law, Goal(0.6), celsius, 80.0).days == pytest.approx(10 * DAYS_PER_YEAR, rel=1e-4)


def test_intervals_of_the_temperature_hold_the_truth():
    days = 0.1 * np.expm1(0.33 / 0.05)  # to 0.6 at k = 1, at 85 %
    k = days / (1.0 * DAYS_PER_YEAR)
    truth = 1 / (1 / 333.15 - np.log(k) * R / 80.0) - 273.15
    found = [
        temperature_for(fit_joint_law(campaign(scatter=0.01, seed=s), "log", "rate"), Goal(0.6), 1.0, 85.0)
        for s in range(40)
    ]
    assert 0.86 <= np.mean([low <= truth <= high for _, low, high in found]) <= 1.0
    assert np.median([celsius for celsius, *_ in found]) == pytest.approx(truth, abs=1.0)


def test_a_life_that_no_temperature_shortens_enough_is_not_called_short():
    law = fit_joint_law(campaign("stretched", (4.0, 0.6), a=0.3, scatter=0.001), "stretched", "rate")
    assert temperature_for(law, Goal(0.5), 20.0, 80.0)[0] == np.inf  # its floor lies above
    assert temperature_for(law, Goal(0.99), 20.0, 80.0)[0] == -np.inf


def test_without_unaged_rubber_there_is_no_share_of_the_start():
    series = campaign(scatter=0.005)
    law = fit_joint_law(series.part(series.days > 0), "log", "rate")
    with pytest.raises(RequestError, match="no unaged rubber"):
        answer(law, Goal(loss=0.2), temperature_C=50.0, compression_ratio_pct=85.0)


def test_limits_of_the_temperature_that_the_tests_do_not_set_are_open():
    law = fit_joint_law(campaign(energy=3.0, scatter=0.01), "log", "rate")
    celsius, low, high = temperature_for(law, Goal(0.75), 10.0 / 365.25, 85.0)
    assert -80 <= celsius <= 300 or not np.isfinite(celsius)
    assert not np.isfinite(low) or not np.isfinite(high)


def test_what_a_request_lacks_is_said():
    law = fit_joint_law(campaign(), "log", "rate")
    with pytest.raises(RequestError, match="more than one temperature"):
        lifetime(law, Goal(0.7), None, 80.0)
    with pytest.raises(RequestError, match="not said"):
        goal_of(None, None)
    with pytest.raises(RequestError, match="no share"):
        goal_of(None, 120.0)


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ({"years": 0.0}, "no time to last"),
        ({"years": -5.0}, "no time to last"),
        ({"years": np.nan}, "no time to last"),
        ({"years": 10.0, "temperature_C": 40.0}, "asks for the temperature"),
        ({"temperature_C": -400.0}, "no temperature of use"),
        ({"temperature_C": np.nan}, "no temperature of use"),
        ({"temperature_C": 40.0, "compression_ratio_pct": 0.0}, "no compression of use"),
    ],
)
def test_what_cannot_be_asked_is_refused(asked, why):
    law = fit_joint_law(campaign(), "log", "rate")
    with pytest.raises(RequestError, match=why):
        answer(law, Goal(0.7), **({"compression_ratio_pct": 80.0} | asked))


def test_a_temperature_is_refused_where_the_tests_had_one():
    days = np.array([0.0, 1.0, 2.0, 4.0, 8.0, 12.0, 16.0])
    law = fit_laws(Aged(days, 0.93 - 0.05 * np.log1p(days / 0.1), np.full(7, 60.0), np.full(7, 80.0)))[0]
    with pytest.raises(RequestError, match="at 60 degC only"):
        lifetime(law, Goal(0.75), 40.0)
    assert lifetime(law, Goal(0.75), 60.0, 80.0).days > 0
    for threshold in (np.nan, np.inf):
        with pytest.raises(RequestError, match="no value to reach"):
            goal_of(threshold, None)


# --------------------------------------------------------- measured: strength of an adhesive and a polymer
@pytest.mark.skipif(MEASURED is None, reason="SEALFIT_MEASURED names no folder of measured data")
@pytest.mark.parametrize(
    ("table", "loss", "energy"),
    [("PolymerY", "log", (72.0, 88.0)), ("AdhesiveFormulationK", "stretched", (145.0, 190.0))],
)
def test_strength_by_temperature(table, loss, energy):
    rows = pd.read_csv(Path(MEASURED) / "aging-strength" / "csv" / f"{table}.csv")
    laws = fit_laws(
        Aged(rows["TimeH"].to_numpy() / 24, rows["Response"].to_numpy(float), rows["TempC"].to_numpy())
    )
    assert (laws[0].loss.name, laws[0].acts_on) == (loss, "rate")
    found = {name: (low, high) for name, _, low, high, _ in laws[0].parameters()}
    assert energy[0] < found["E"][0] < found["E"][1] < energy[1]
    assert laws[0] not in rivals_of(laws)


@pytest.mark.parametrize("size", [1.0, 1e7])
@pytest.mark.parametrize("kind", ["none", "one of zero", "of rank one"])
def test_values_whose_variance_is_zero_or_singular_have_the_law(kind, size):
    exact = campaign(scatter=0.0)
    n, own = exact.value.size, (0.01 * size) ** 2
    variance = {"none": None, "one of zero": np.full(n, own), "of rank one": np.full((n, n), own)}[kind]
    if kind == "one of zero":
        variance[5] = 0.0
    law = fit_joint_law(
        replace(exact, value=size * exact.value, variance=variance, replicates_df=40.0), "log", "rate"
    )
    found = {name: value for name, value, *_ in law.parameters()}
    assert found["E"] == pytest.approx(80.0, rel=1e-3)
    assert found["a"] == pytest.approx(0.05 * size, rel=1e-3)
    assert kind == "none" or law.lack_of_fit_p() > 0.5


def test_an_interval_without_a_bound_has_none():
    law = fit_joint_law(campaign(), "log")
    unknown = law.covariance + 1e5 * np.diag([float(name == "b") for name in law.names])
    ends = {name: (low, high) for name, _, low, high, _ in replace(law, covariance=unknown).parameters()}
    assert np.isnan(ends["b"]).all()
    assert np.isfinite(ends["mu_0"]).all()
