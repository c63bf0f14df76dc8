"""mu_s and mu_c from forces with what a series' days share: exact, surer, and free where days disagree."""

import numpy as np
import pandas.testing as pdt
import pytest
from scipy.optimize import least_squares
from steady_tables import MU_C, MU_S

from sealfit.config import Config, Quantity
from sealfit.errors import RequestError
from sealfit.fit import steady
from sealfit.fit.aging.all_series import aged_values, joint_laws, law_of, shared_levels
from sealfit.fit.aging.joint_law import fit_joint_law
from sealfit.fit.steady import fit_conditions
from sealfit.fit.steady.uncertainty import run_means
from sealfit.physics import aging_law, stribeck_force

R = 8.314462618e-3
DAYS = (0, 1, 2, 4, 8, 16)
SERIES = tuple((celsius, percent) for celsius in (40.0, 60.0, 80.0) for percent in (80.0, 90.0))


def levels(table):
    return shared_levels(table, fit_conditions(table, Config()))


def pace(celsius, percent, energy, kappa=0.02):
    return np.exp(energy / R * (1 / 333.15 - 1 / (celsius + 273.15)) + kappa * (85.0 - percent))


def arrhenius(energy=80.0, what="rate"):
    """Laws of every series, the rate or the loss by Arrhenius and compression, as `campaign` takes them."""
    laws = {}
    for place in SERIES:
        k = pace(*place, energy)
        own = {"b": 1 / k, "a": 1.0} if what == "rate" else {"b": 1.0, "a": k}
        laws[place] = tuple(
            {**law, "a": law["a"] * own["a"], "b": law["b"] * own["b"]} for law in (MU_S, MU_C)
        )
    return laws


def run_table(table):
    """Run means with the condition's columns."""
    about = table[["condition", "temperature_C", "compression_ratio_pct", "aging_days"]].drop_duplicates()
    return run_means(table).merge(about, on="condition")


def test_intervals_do_not_depend_on_which_conditions_are_done_together(campaign, monkeypatch):
    table, config = campaign(noise=0.01, series=SERIES, laws=arrhenius(), days=DAYS, ways=(1,)), Config()
    one = fit_conditions(table, config)
    monkeypatch.setattr(steady, "BLOCK", 10)
    for name, fitted in fit_conditions(table, config).items():
        pdt.assert_frame_equal(fitted, one[name])


def test_exact_forces_give_the_coefficients_back(campaign):
    found, _ = levels(campaign(noise=1e-9, setup=1e-9))
    assert len(found) == 12
    for row in found.itertuples():
        law = {"mu_s": MU_S, "mu_c": MU_C}[row.quantity]
        assert row.value == pytest.approx(float(aging_law(row.aging_days, **law)), rel=1e-6)


def test_values_and_covariance_are_those_of_one_fit_to_all_forces(campaign):
    table = campaign(noise=0.01, days=(0, 2, 8), repeats=40, ways=(1,))
    (found, measured), runs = levels(table), run_table(table)
    k = np.searchsorted((0, 2, 8), runs["aging_days"])
    speed, force = runs["speed"].to_numpy(), runs["force"].to_numpy()

    def residual(x):
        model = stribeck_force(speed, 49.03, mu_s=x[:3][k], mu_c=x[3:6][k], v_s=x[6], sigma_2=x[7])
        return (model - force) / (0.01 * force / np.sqrt(40))

    direct = least_squares(residual, [0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 5.0, 0.02], x_scale="jac", xtol=1e-14)
    covariance = np.linalg.inv(direct.jac.T @ direct.jac)
    order = [(0, 2, 8).index(row.aging_days) + 3 * (row.quantity == "mu_c") for row in found.itertuples()]
    se, own = np.sqrt(np.diag(covariance))[order], np.sqrt(measured.diagonal())
    assert np.abs(found["value"].to_numpy() - direct.x[order]).max() < 0.15 * se.min()
    assert own == pytest.approx(se, rel=0.15)
    correlation = covariance[np.ix_(order, order)] / np.outer(se, se)
    assert np.abs(measured.toarray() / np.outer(own, own) - correlation).max() < 0.1


def test_what_the_days_share_makes_the_values_surer_than_free_fits(campaign):
    table = campaign(noise=0.01)
    fits = fit_conditions(table, Config())
    found, covariance = shared_levels(table, fits)
    free = fits["steady_fit"].query("quantity == 'steady'").set_index(["condition", "parameter"])["se"]
    own = np.array([free[row.condition, row.quantity] for row in found.itertuples()])
    assert np.median(np.sqrt(covariance.diagonal()) / own) < 0.8


def test_a_day_with_two_speeds_is_known_through_the_others(campaign):
    table = campaign(noise=0.003)
    few = (table["aging_days"] == 8) & ~table["speed_set_mm_s"].isin([1, 32])
    fits = fit_conditions(table[~few], Config())
    alone = fits["steady_fit"].query("aging_days == 8 and parameter == 'mu_s'")
    assert not alone["identified"].any()
    found, _ = shared_levels(table[~few], fits)
    value = found[(found["aging_days"] == 8) & (found["quantity"] == "mu_s")]["value"]
    assert float(value.iloc[0]) == pytest.approx(0.93513 - 0.04448 * np.log1p(8 / 0.0804), rel=0.01)


def test_days_that_do_not_agree_on_the_stribeck_speed_keep_their_free_fits(campaign):
    table = campaign(noise=0.003, days=(0, 2, 4))
    late = table["aging_days"] == 4
    other = stribeck_force(table["speed_mm_s"], 49.03, mu_s=0.76, mu_c=0.49, v_s=15.0, sigma_2=0.02)
    table.loc[late, "force_N"] = other[late] * (
        1 + 0.003 * np.random.default_rng(3).standard_normal(int(late.sum()))
    )
    fits = fit_conditions(table, Config())
    found, _ = shared_levels(table, fits)
    free = fits["steady_fit"].query("quantity == 'steady'").set_index(["condition", "parameter"])["value"]
    for row in found.itertuples():
        assert row.value == free[row.condition, row.quantity]


def test_a_quantity_that_no_condition_identifies_is_said_with_the_reason(campaign):
    table = campaign(noise=0.01, ways=(1,))
    few = table[table["speed_mm_s"].rank(method="dense") <= 4].drop_duplicates(["condition", "speed_mm_s"])
    with pytest.raises(RequestError, match=r"mu_s is not identified in any condition: as many .* no repeats"):
        law_of(few, fit_conditions(few, Config()), "mu_s")


@pytest.mark.parametrize("quantity", ["mu_s", "mu_c"])
def test_a_law_of_the_levels_is_the_law_of_the_forces(campaign, quantity):
    """Against one fit of both laws, v_s and sigma_2 of every series to all run means, by another solver."""
    table = campaign(noise=0.01, series=SERIES, laws=arrhenius(), days=DAYS, ways=(1,))
    aged = aged_values(table, fit_conditions(table, Config()))
    law = fit_joint_law(aged["rubber", quantity], "log", "rate")
    runs = run_means(table).merge(
        table[["run_id", "temperature_C", "compression_ratio_pct", "aging_days"]].drop_duplicates(),
        on="run_id",
    )
    aged = runs["aging_days"].to_numpy() > 0
    place = np.array(
        [
            SERIES.index(pair)
            for pair in zip(runs["temperature_C"], runs["compression_ratio_pct"], strict=True)
        ]
    )
    place = np.where(aged, place, len(SERIES))
    inverse = np.where(aged, 1 / R * (1 / 333.15 - 1 / (runs["temperature_C"] + 273.15)), 0.0)
    percent = np.where(aged, 85.0 - runs["compression_ratio_pct"], 0.0)
    speed, force, days = (runs[name].to_numpy() for name in ("speed", "force", "aging_days"))

    def residual(x):
        mu = [
            p[0] - p[1] * np.log1p(np.exp(p[3] * inverse + p[4] * percent) * days / np.exp(p[2]))
            for p in (x[:5], x[5:10])
        ]
        decay = np.exp(-((speed / x[10:17][place]) ** 2))
        return (49.03 * (mu[1] + (mu[0] - mu[1]) * decay) + x[17:24][place] * speed - force) / (0.01 * force)

    start = [0.9, 0.04, np.log(0.1), 70.0, 0.0, 0.6, 0.03, np.log(0.1), 70.0, 0.0, *[5.0] * 7, *[0.02] * 7]
    direct = least_squares(residual, start, x_scale="jac").x
    direct = direct[:5] if quantity == "mu_s" else direct[5:10]
    assert np.abs(law.x - direct).max() > 0  # another way, so never the same to the last digit
    assert (np.abs(law.x - direct) < 0.35 * np.sqrt(np.diag(law.covariance))).all()


def test_every_condition_lies_on_the_master_curve_whichever_way_temperature_acts(campaign):
    for laws in (arrhenius(), arrhenius(15.0, "loss")):
        table = campaign(noise=1e-4, series=SERIES, laws=laws, days=DAYS, ways=(1,))
        _, curves = joint_laws(table, fit_conditions(table, Config()), Config())
        assert curves["quantity"].unique().tolist() == ["mu_s", "mu_c"]
        own = curves[curves["quantity"] == "mu_s"]
        law = own[own["kind"] == "law"].sort_values("scaled_days")
        values = own[own["kind"] == "value"]
        assert len(values) == len(SERIES) * 5 + 1
        expected = np.interp(values["scaled_days"], law["scaled_days"], law["value"])
        assert values["value"].to_numpy() == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("speeds", [(32, 64), (16, 32, 64)])
def test_a_day_with_fast_speeds_only_has_no_static_coefficient(campaign, speeds):
    table = campaign(noise=0.004, series=((60.0, 80.0), (80.0, 80.0)), specimen=0.01)
    late = (table["temperature_C"] == 80.0) & (table["aging_days"] == 16)
    table = table[~late | table["speed_set_mm_s"].isin(speeds)]
    found, _ = levels(table)
    own = found[(found["temperature_C"] == 80.0) & (found["aging_days"] == 16)]
    assert set(own["quantity"]) == {"mu_c"}
    laws, _ = joint_laws(table, fit_conditions(table, Config()), Config())
    assert laws["scatter_rel"].max() < 0.05


def test_a_day_that_scatters_more_weighs_less(campaign):
    table = campaign(noise=0.004, seed=5)
    late = table["aging_days"] == 16
    rng = np.random.default_rng(1)
    gain = dict.fromkeys(table.loc[late, "run_id"].unique())
    gain = {run: 1 + 0.04 * rng.standard_normal() for run in gain}
    table.loc[late, "force_N"] *= table.loc[late, "run_id"].map(gain)
    found, covariance = levels(table)
    se = dict(zip(found["aging_days"], np.sqrt(covariance.diagonal()), strict=False))
    assert se[16.0] > 1.5 * se[8.0]  # was 1.0


def test_coefficients_of_a_rig_that_reads_torque_have_their_true_unit(campaign):
    config = Config(quantities={"force": Quantity(quantity="torque", unit="mN m")})
    table = campaign(noise=0.004)
    laws, _ = joint_laws(table, fit_conditions(table, config), config)
    assert set(laws.loc[laws["parameter"].isin(["mu_0", "a"]), "unit"]) == {"mN m/N"}
