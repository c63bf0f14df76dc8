import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from scipy.optimize import curve_fit

from sealfit.config import Config, Quantity, Sensor
from sealfit.errors import FitError
from sealfit.fit.steady import fit_conditions, parameter_units
from sealfit.fit.steady.uncertainty import more_likely, run_means, speed_levels, unit_variance
from sealfit.tables import STEADY_FIT
from sealfit.units import Units

TRUTH = {"mu_s": 0.7, "mu_c": 0.45, "v_s": 6.0, "sigma_2": 0.03}
UNAGED = {"days": (0,), "model": TRUTH}


def steady(fits, parameter, condition="unaged"):
    fit = fits["steady_fit"]
    rows = fit[(fit.quantity == "steady") & (fit.parameter == parameter) & (fit.condition == condition)]
    assert len(rows) == 1
    return rows.iloc[0]


def statistic(fits, name, condition="unaged"):
    fit = fits["steady_fit"]
    rows = fit[(fit.quantity == "statistics") & (fit.parameter == name) & (fit.condition == condition)]
    assert len(rows) == 1
    return rows.iloc[0]


def test_exact_forces_give_back_the_truth_and_the_table_has_its_schema(campaign):
    fits = fit_conditions(campaign(noise=1e-9, **UNAGED), Config())
    for name, value in TRUTH.items():
        row = steady(fits, name)
        npt.assert_allclose(row.value, value, rtol=1e-6)
        assert row.identified
        assert row.lo95 <= row.value <= row.hi95
    fit = fits["steady_fit"]
    assert list(fit.columns) == [*STEADY_FIT.names(), "temperature_C", "compression_ratio_pct", "aging_days"]
    assert list(fit[fit.quantity == "steady"].unit) == ["", "", "mm/s", "N s/mm"]
    assert set(fit.aging_days) == {0.0}


def test_every_condition_and_its_columns_are_there(campaign):
    fits = fit_conditions(campaign(), Config())
    assert fits["steady_fit"].condition.nunique() == 6
    row = steady(fits, "mu_s", "temperature_C=60, compression_ratio_pct=80, aging_days=16")
    # published for these numbers of Eq. 15: 0.69999 at day 16
    npt.assert_allclose(row.value, 0.6995, atol=4 * row.se)
    assert (row.temperature_C, row.compression_ratio_pct, row.aging_days) == (60, 80, 16)
    assert row.series == "temperature_C=60, compression_ratio_pct=80"
    assert row.rubber == "rubber"


def test_standard_errors_and_covariance_agree_with_another_solver(campaign):
    table = campaign(noise=0.01, **UNAGED)
    fits = fit_conditions(table, Config())
    runs = run_means(table)
    scatter = table.force_N.abs().groupby([table.run_id]).std()
    assert scatter.min() > 0

    def model(speed, mu_s, mu_c, v_s, sigma_2):
        return 49.03 * (mu_c + (mu_s - mu_c) * np.exp(-((speed / v_s) ** 2))) + sigma_2 * speed

    # equal relative scatter in every run: sd of a mean is g F / sqrt 3, with g from the pooled relative
    # deviations
    relative = table.force_N / table.groupby("run_id").force_N.transform("mean") - 1
    g = np.sqrt((relative**2).sum() / (2 * len(runs)))
    sd = g * runs.force / np.sqrt(3)
    values, covariance = curve_fit(
        model, runs.speed, runs.force, p0=[0.6, 0.5, 4, 0.01], sigma=sd, absolute_sigma=True
    )
    for k, name in enumerate(TRUTH):
        row = steady(fits, name)
        npt.assert_allclose(row.value, values[k], atol=0.1 * row.se)
        npt.assert_allclose(row.se, np.sqrt(covariance[k, k]), rtol=0.1)
    part = fits["steady_covariance"].query("parameter == 'mu_s' and other == 'mu_c'").iloc[0]
    npt.assert_allclose(
        part.value, covariance[0, 1], rtol=0.2, atol=0.05 * np.sqrt(covariance[0, 0] * covariance[1, 1])
    )


def test_repeats_are_not_evidence_of_their_own(campaign):
    """With all scatter between set-ups, ten times the repeats must not shrink the intervals."""
    few, many = (
        fit_conditions(campaign(noise=1e-4, setup=0.03, repeats=n, seed=2, **UNAGED), Config())
        for n in (2, 20)
    )
    for name in TRUTH:
        assert steady(many, name).se > 0.5 * steady(few, name).se
    assert statistic(many, "lack_of_fit_p").value < 1e-6
    assert "lack of fit" in statistic(many, "lack_of_fit_p").reason
    assert statistic(many, "birge_ratio").value > 10


def test_strokes_of_a_file_are_averaged_before_its_repeats(campaign):
    table = campaign(**UNAGED)
    strokes = pd.concat([table, table.assign(stroke=2)])
    pd.testing.assert_frame_equal(run_means(strokes), run_means(table))
    uneven = pd.concat([table, table[table.repeat == 1].assign(stroke=2)])
    pd.testing.assert_frame_equal(run_means(uneven), run_means(table))


@pytest.mark.long
@pytest.mark.parametrize("setup", [0.0, 0.02])
def test_intervals_cover(campaign, setup):
    """40 campaigns of three conditions: 95 % intervals cover, with and without scatter between set-ups."""
    hits, total = dict.fromkeys(TRUTH, 0), 0
    for seed in range(40):
        table = campaign(seed=seed, noise=0.01, setup=setup, days=(0, 1, 2), model=TRUTH)
        fits = fit_conditions(table, Config())
        for condition in table.condition.unique():
            total += 1
            for name, value in TRUTH.items():
                row = steady(fits, name, condition)
                hits[name] += row.lo95 <= value <= row.hi95
    for name, count in hits.items():  # 120 intervals: 0.95 - 3 sqrt(0.95 0.05 / 120) = 0.89
        assert count / total >= 0.89, (name, count / total)


# ---------------------------------------------------------------- what the speeds can tell
def test_one_speed_gives_the_sliding_coefficient_and_says_so(campaign):
    fits = fit_conditions(campaign(speeds=(8,), **UNAGED), Config())
    sliding = (0.45 + 0.25 * np.exp(-((8 / 6) ** 2))) + 0.03 * 8 / 49.03
    npt.assert_allclose(steady(fits, "mu_c").value, sliding, rtol=5e-3)
    for name in ("mu_s", "v_s", "sigma_2"):
        row = steady(fits, name)
        assert np.isnan(row.value)
        assert not row.identified
        assert "one speed only" in row.reason


def test_two_speeds_one_each_way_are_one_level(campaign):
    """Slow out, fast back: a direction offset would pass for a viscous slope or a Stribeck curve."""
    table = campaign(speeds=(7, 14), commanded=False, **UNAGED)
    table = table[(table.direction == 1) == (table.speed_mm_s.abs() == 7)]
    assert {k: len(v) for k, v in speed_levels(run_means(table)).items()} == {-1: 1, 1: 1}
    fits = fit_conditions(table, Config())
    assert not steady(fits, "sigma_2").identified
    assert steady(fits, "mu_c").identified
    assert statistic(fits, "n_speeds").value == 1


def test_measured_speeds_that_wander_are_one_level(campaign):
    table = campaign(speeds=(7.0, 7.6, 8.2, 20.0), commanded=False, ways=(1,), **UNAGED)
    npt.assert_allclose(speed_levels(run_means(table))[1], [7.0, 20.0])
    commanded = campaign(speeds=(7.0, 7.6, 8.2, 20.0), ways=(1,), **UNAGED)
    npt.assert_allclose(speed_levels(run_means(commanded))[1], [7.0, 7.6, 8.2, 20.0])


def test_three_speeds_give_mu_c_and_sigma_2(campaign):
    flat = {"mu_s": 0.45, "mu_c": 0.45, "v_s": 1.0, "sigma_2": 0.03}
    fits = fit_conditions(campaign(speeds=(2, 20, 60), days=(0,), model=flat, noise=1e-6), Config())
    npt.assert_allclose(steady(fits, "mu_c").value, 0.45, rtol=1e-5)
    npt.assert_allclose(steady(fits, "sigma_2").value, 0.03, rtol=1e-4)
    assert "3 speeds in one direction" in steady(fits, "v_s").reason


def test_no_stribeck_curve_is_said_and_mu_c_stays_sharp(campaign):
    flat = {"mu_s": 0.45, "mu_c": 0.45, "v_s": 1.0, "sigma_2": 0.03}
    fits = fit_conditions(campaign(days=(0,), model=flat, seed=8), Config())
    assert "mu_s = mu_c is not rejected" in steady(fits, "v_s").reason
    assert not steady(fits, "v_s").identified
    assert not steady(fits, "mu_s").identified
    row = steady(fits, "mu_c")
    assert row.identified
    assert row.hi95 - row.lo95 < 0.01
    npt.assert_allclose(row.value, 0.45, atol=0.005)


def test_speeds_all_above_the_curve_leave_v_s_open_below(campaign):
    fits = fit_conditions(campaign(speeds=(11, 16, 23, 32, 45, 64), **UNAGED), Config())
    row = steady(fits, "v_s")
    assert not row.identified
    assert not steady(fits, "mu_s").identified


def test_one_slow_speed_is_not_enough_for_v_s(campaign):
    fits = fit_conditions(campaign(speeds=(4, 30, 40, 50, 60), noise=0.001, **UNAGED), Config())
    row = steady(fits, "v_s")
    assert not row.identified
    assert np.isnan(row.lo95)
    assert "slower speeds are needed" in row.reason
    assert steady(fits, "mu_c").identified
    assert steady(fits, "sigma_2").identified


def test_rising_friction_is_fitted_and_remarked(campaign):
    rising = TRUTH | {"mu_s": 0.3}
    fits = fit_conditions(campaign(days=(0,), model=rising), Config())
    row = steady(fits, "mu_s")
    assert row.identified
    assert "mu_s < mu_c" in row.reason
    npt.assert_allclose(row.value, 0.3, atol=0.01)


def test_falling_friction_ends_at_the_physical_limit_of_sigma_2(campaign):
    table = campaign(**UNAGED)
    table["force_N"] -= 0.08 * table["speed_mm_s"]
    row = steady(fit_conditions(table, Config()), "sigma_2")
    assert row.value == 0
    assert row.lo95 == 0
    assert np.isnan(row.se)
    assert "physical limit 0" in row.reason


def test_a_turned_sign_is_remarked(campaign):
    table = campaign(**UNAGED)
    row = steady(fit_conditions(table.assign(force_N=-table.force_N), Config()), "mu_c")
    assert "16 runs have a force along the motion" in row.reason


# ---------------------------------------------------------------- units, load, sensor, repeats
def test_without_load_forces_are_fitted_in_the_true_unit(campaign):
    config = Config(
        quantities={
            "force": Quantity(quantity="torque", unit="mN m"),
            "displacement": Quantity(quantity="angle", unit="deg"),
            "speed": Quantity(quantity="speed", unit="rpm"),
        }
    )
    model = {"mu_s": 3.11, "mu_c": 2.6, "v_s": 33.0, "sigma_2": 0.0046}
    table = campaign(days=(0,), model=model, load=None, speeds=(2, 5, 10, 20, 40, 80, 200), noise=1e-4)
    fits = fit_conditions(table, config)
    npt.assert_allclose(steady(fits, "F_s").value, 3.11, rtol=1e-3)
    npt.assert_allclose(steady(fits, "F_c").value, 2.6, rtol=1e-3)
    assert list(fits["steady_fit"].query("quantity == 'steady'").unit) == ["mN m", "mN m", "rpm", "mN m/rpm"]
    assert statistic(fits, "rmse_N").unit == "mN m"
    assert len(fits["steady_covariance"].query("parameter == 'F_s' and other == 'F_c'")) == 1


def test_sensor_accuracy_is_one_offset_that_nothing_averages_down(campaign):
    config = Config(sensor=Sensor(accuracy=0.2))
    for repeats in (2, 12):
        fits = fit_conditions(campaign(repeats=repeats, **UNAGED), config)
        for name in ("mu_s", "mu_c"):  # 0.2 N / sqrt 3 over 49.03 N, by hand
            npt.assert_allclose(steady(fits, name).u_sys, 0.2 / np.sqrt(3) / 49.03, rtol=1e-9)
        assert steady(fits, "v_s").u_sys == 0
        assert steady(fits, "sigma_2").u_sys == 0


def test_sensor_shift_is_what_a_shifted_campaign_gives(campaign):
    table = campaign(noise=0.01, **UNAGED)
    u = Config().sensor.u
    moved = table.assign(force_N=table.force_N + 1e-3 * u * table.direction)
    before, after = fit_conditions(table, Config()), fit_conditions(moved, Config())
    for name in TRUTH:
        found = (steady(after, name).value - steady(before, name).value) / 1e-3
        npt.assert_allclose(found, steady(before, name).u_sys, atol=2e-2 * steady(before, name).u_sys + 5e-5)


def test_without_repeats_the_residual_is_the_scatter_and_lack_of_fit_is_null(campaign):
    fits = fit_conditions(campaign(repeats=1, noise=0.01, days=(0, 1, 2), model=TRUTH), Config())
    assert np.isnan(statistic(fits, "lack_of_fit_p").value)
    assert "no run was repeated" in statistic(fits, "lack_of_fit_p").reason
    row = steady(fits, "mu_s")
    assert 0 < row.se < 0.02
    npt.assert_allclose(row.value, 0.7, atol=4 * row.se)


@pytest.mark.long
@pytest.mark.parametrize(("noise", "constant"), [(0.01, 0.0), (0.0, 0.3)], ids=["relative", "constant"])
def test_without_repeats_the_residuals_say_how_scatter_goes_with_force(campaign, noise, constant):
    """mu_s is seen where the force is largest.

    Were 1 % taken for a constant, its error would be a third too small.
    """
    errors, stated = [], []
    for seed in range(14):
        table = campaign(
            seed=seed, repeats=1, noise=noise, constant=constant, days=(0, 1, 2), model=TRUTH, ways=(1,)
        )
        fits = fit_conditions(table, Config())
        for condition in table.condition.unique():
            row = steady(fits, "mu_s", condition)
            errors.append(row.value - 0.7)
            stated.append(row.se)
    # the spread of 42 errors is known to 11 %; three of those
    npt.assert_allclose(np.sqrt(np.mean(np.square(stated))) / np.std(errors), 1.0, atol=0.34)


def one_file_each_way(forces):
    """Table `steady` of one file a condition, a slow way out, a fast way back, without repeats or loads."""
    rows = [
        {
            "condition": f"c{k}", "series": "", "rubber": "", "run_id": f"c{k}{way:+}", "repeat": 1,
            "specimen_id": f"c{k}", "file": f"c{k}.csv", "stroke": 1 + (way < 0), "direction": way,
            "speed_mm_s": way * speed, "load_N": np.nan, "force_N": way * force,
            "used": True,
        }
        for k, pair in enumerate(forces)
        for way, speed, force in zip((1, -1), (7.0, 14.0), pair, strict=True)
    ]  # fmt: skip
    return pd.DataFrame(rows)


@pytest.mark.parametrize("offset", [0.0, 8.0, 11.0, 40.0])
def test_without_repeats_an_offset_lets_no_direction_decide_alone(offset):
    table = one_file_each_way([(10 + 0.5 * k + offset, 10 + 0.5 * k - offset) for k in range(7)])
    fits = fit_conditions(table, Config(condition=["c"]))
    for k in range(7):
        row = steady(fits, "F_c", f"c{k}")
        npt.assert_allclose(row.value, 10 + 0.5 * k)  # half the difference of the two ways
        assert row.se >= 0.9 * offset / np.sqrt(2)
        assert row.identified


def test_a_coefficient_at_its_limit_is_not_identified_and_has_no_error_of_zero():
    fits = fit_conditions(one_file_each_way([(-10.0, -9.0), (-11.0, -9.5)]), Config(condition=["c"]))
    row = steady(fits, "F_c", "c0")
    assert row.value == 0.0
    assert np.isnan(row.se)
    assert not row.identified
    assert "at its physical limit 0" in row.reason
    assert "check the sign of force or displacement" in row.reason


def test_four_single_runs_are_fitted_exactly_and_trusted_with_nothing(campaign):
    fits = fit_conditions(campaign(repeats=1, speeds=(1, 4, 10, 40), ways=(1,), **UNAGED), Config())
    row = steady(fits, "mu_s")
    npt.assert_allclose(row.value, 0.7, rtol=0.03)
    assert np.isnan([row.se, row.lo95, row.hi95]).all()
    assert "nothing shows how far to trust it" in row.reason


def test_rows_not_used_are_left_out(campaign):
    table = campaign(**UNAGED)
    spoiled = table.assign(used=table.repeat != 2, force_N=table.force_N.where(table.repeat != 2, 1e3))
    row = steady(fit_conditions(spoiled, Config()), "mu_s")
    npt.assert_allclose(row.value, 0.7, rtol=0.02)
    assert statistic(fit_conditions(spoiled, Config()), "n_files").value == 32


def test_runs_without_load_in_a_campaign_with_loads_are_counted_out(campaign):
    table = campaign(**UNAGED)
    table.loc[table.speed_mm_s == 8, "load_N"] = np.nan
    fits = fit_conditions(table, Config())
    assert statistic(fits, "n_runs").value == 15
    assert "1 runs without load" in statistic(fits, "lack_of_fit_p").reason


def test_refuses_an_empty_table_and_a_missing_column(campaign):
    table = campaign(**UNAGED)
    with pytest.raises(FitError, match="no steady window is left"):
        fit_conditions(table.assign(used=False), Config())
    with pytest.raises(FitError, match="lacks load_N"):
        fit_conditions(table.drop(columns="load_N"), Config())
    with pytest.raises(FitError, match="has speed 0"):
        fit_conditions(table.assign(speed_mm_s=0.0), Config())


# ---------------------------------------------------------------- Birge
def test_birge_by_hand():
    variance = unit_variance([8.0, 12.0], [5, 5], True, 40.0)  # pooled 20/10 = 2, F(10, 40) p = 0.06
    npt.assert_allclose(variance.value, 2.0)
    npt.assert_allclose(variance.df, 10)
    npt.assert_allclose(variance.f, [1.6, 2.4])
    calm = unit_variance([4.0, 6.0], [5, 5], True, 40.0)  # pooled 1: no set-up scatter
    npt.assert_allclose(calm.value, 1.0)
    npt.assert_allclose(calm.df, 40)
    npt.assert_allclose(calm["rise"], 2.0211**2, rtol=1e-4)  # t table, 40 degrees of freedom


def test_a_condition_worse_than_the_others_gets_its_own_ratio():
    variance = unit_variance([5.0] * 9 + [100.0], [5] * 10, True, 100.0)
    assert list(variance.own) == [False] * 9 + [True]
    npt.assert_allclose(variance["value"].iloc[-1], 20.0)
    assert variance["df"].iloc[-1] == 5


def test_likelier_weights_by_hand():
    force = np.array([1.0, 1, 10, 10])
    error = np.array([0.1, -0.1, 1, -1])  # in proportion to the force
    weights = [np.ones(4), 1 / force**2]
    assert more_likely([np.sum(w * error**2) for w in weights], weights, 4) == 1
    even = np.array([0.1, -0.1, 0.1, -0.1])
    assert more_likely([np.sum(w * even**2) for w in weights], weights, 4) == 0


@pytest.mark.parametrize(
    ("speed", "load", "mu", "sigma_2"),
    [("mm/s", "N", "", "N s/mm"), ("m/ms", "N", "", "N/(m/ms)"), ("mm/s", "N/mm", "N/(N/mm)", "N s/mm")],
)
def test_units_of_parameters_are_those_of_their_numbers(speed, load, mu, sigma_2):
    units = parameter_units(Units({"speed": ("speed", speed), "load": ("load", load)}), has_load=True)
    assert (units["mu_s"], units["sigma_2"]) == (mu, sigma_2)


@pytest.mark.long
@pytest.mark.parametrize(("speeds", "setup"), [((1, 5, 25), 0.0), ((1, 5, 25), 0.01), ((0.5, 3), 0.0)])
def test_few_speeds_give_the_mean_over_them_and_intervals_that_cover(campaign, speeds, setup):
    """Too few speeds for a Stribeck curve: its fall, the same every day, is no scatter between runs."""
    law = {"mu_0": 0.9, "a": 0.05, "b": 0.3}
    lower = {**law, "mu_0": 0.63, "a": 0.035}
    kw = {"speeds": speeds, "days": (0, 1, 4, 16), "ways": (1,), "laws": {(60.0, 80.0): (law, lower)}}
    exact = campaign(noise=1e-9, repeats=1, **kw).assign(mu=lambda t: t.force_N / 49.03)
    truth = exact.groupby("condition").mu.mean()
    hits, widths = [], []
    for seed in range(40):
        fits = fit_conditions(campaign(seed=seed, noise=0.004, setup=setup, repeats=2, **kw), Config())
        for condition, value in truth.items():
            row = steady(fits, "mu_c", condition)
            hits.append(row.lo95 <= value <= row.hi95)
            widths.append((row.hi95 - row.lo95) / value)
    assert np.mean(hits) > 0.9
    assert np.median(widths) < 0.04


def test_a_condition_with_too_few_speeds_leaves_the_others_their_curve(campaign):
    """What its straight line leaves of the Stribeck curve is no scatter of their runs."""
    table = campaign(speeds=(0.5, 2, 5, 15, 40), days=(0, 2, 8), ways=(1,), noise=0.002, repeats=3)
    last = table["aging_days"] == 8
    fits = fit_conditions(table[~last | ~table["speed_mm_s"].isin([2, 15])], Config())
    found = fits["steady_fit"].query("quantity == 'steady' and parameter == 'mu_s'")
    assert found["identified"].tolist() == (found["aging_days"] != 8).tolist()


def test_few_speeds_do_not_tell_a_sigma_2_of_zero_from_the_fall_of_a_stribeck_curve(campaign):
    """Friction rises between the faster two of three speeds only: the line through all falls."""
    truth = {"mu_s": 0.9, "mu_c": 0.3, "v_s": 2.0, "sigma_2": 0.15}
    fits = fit_conditions(campaign(speeds=(1, 10, 40), days=(0,), model=truth), Config())
    row = steady(fits, "sigma_2")
    assert row.value == 0
    assert not row.identified
    assert row.reason.startswith("3 speeds in one direction: the Stribeck curve needs four")


@pytest.mark.filterwarnings("error")
def test_few_speeds_with_forces_along_the_motion_have_no_friction_and_say_so(campaign):
    table = campaign(speeds=(1, 5, 25), days=(0, 1, 4), ways=(1,))
    fits = fit_conditions(table.assign(force_N=-table.force_N), Config())
    row = steady(fits, "mu_c")
    assert row.value == 0.0
    assert not row.identified


# ---------------------------------------------------------------- specimens
PIECES = {"speeds": (1, 2, 4, 8, 16, 32), "ways": (1,), "noise": 0.005, "days": (0, 1), "model": TRUTH}


def test_intervals_contain_the_scatter_of_specimens_where_a_condition_has_several(campaign):
    held = 0
    for seed in range(8):
        fits = fit_conditions(campaign(specimen=0.05, specimens=4, seed=seed, **PIECES), Config())
        row = steady(fits, "mu_s")
        assert 0.005 < row.se < 0.04  # 0.7 x 5 % / 2 = 0.0175
        held += row.lo95 <= 0.7 <= row.hi95
        assert steady(fits, "v_s").se < 0.2  # a factor of all friction does not change v_s
        assert statistic(fits, "lack_of_fit_p").value > 0.001  # nor is it a lack of fit
        scatter = statistic(fits, "specimen_sd_pct")
        assert 2 < scatter.value < 10
        assert "6 degrees of freedom" in scatter.reason
    assert held >= 7


def test_one_specimen_per_condition_says_for_what_the_intervals_hold(campaign):
    fits = fit_conditions(campaign(specimen=0.05, **PIECES), Config())
    assert np.isnan(statistic(fits, "specimen_sd_pct").value)
    assert "hold for those tested" in statistic(fits, "specimen_sd_pct").reason


def test_other_conditions_show_the_scatter_of_a_single_specimen(campaign):
    table = campaign(specimen=0.05, specimens=4, **PIECES)
    one = table[(table.aging_days == 1) | table.specimen_id.str.endswith(" 0")]
    alone = steady(fit_conditions(one, Config()), "mu_s")
    every = steady(fit_conditions(table, Config()), "mu_s")
    assert 1.3 < alone.se / every.se < 3


def test_specimens_of_one_run_each_are_scatter_between_runs(campaign):
    table = campaign(setup=0.03, **PIECES)
    nested = fit_conditions(table.assign(specimen_id=table.run_id), Config())
    plain = fit_conditions(table, Config())
    columns = ["parameter", "value", "se", "lo95", "hi95"]
    pd.testing.assert_frame_equal(nested["steady_fit"][columns], plain["steady_fit"][columns])


def test_three_speeds_and_two_loads_show_the_scatter_of_specimens(campaign):
    """The friction has a Stribeck curve and falls with the load; neither is in the model of three speeds."""
    pieces = {**PIECES, "speeds": (1, 5, 25), "noise": 0.002}
    light = campaign(specimens=4, specimen=0.02, seed=3, **pieces)
    heavy = light.assign(load_N=2 * light.load_N, force_N=2 * 0.93 * light.force_N)
    names = {name: heavy[name] + " heavy" for name in ("file", "run_id")}
    table = pd.concat([light, heavy.assign(**names)], ignore_index=True)
    levels = np.log(light.groupby(["condition", "specimen_id"])["force_N"].mean())
    spread = 100 * np.sqrt(levels.groupby("condition").var().mean())
    scatter = statistic(fit_conditions(table, Config()), "specimen_sd_pct")
    assert scatter.value == pytest.approx(spread, rel=0.1)


def test_specimens_that_differ_in_v_s_widen_its_interval(campaign):
    table = campaign(specimens=4, **PIECES)
    factor = table.specimen_id.str[-1].map({"0": 0.7, "1": 0.9, "2": 1.1, "3": 1.3})
    load, fall = 49.03, TRUTH["mu_s"] - TRUTH["mu_c"]
    moved = np.exp(-((table.speed_mm_s / (6 * factor)) ** 2)) - np.exp(-((table.speed_mm_s / 6) ** 2))
    differs = fit_conditions(table.assign(force_N=table.force_N + load * fall * moved), Config())
    same = fit_conditions(table, Config())
    assert steady(differs, "v_s").se > 4 * steady(same, "v_s").se
    assert "v_s" in statistic(differs, "specimen_sd_pct").reason


def test_specimens_with_exact_forces_are_fitted_too(campaign):
    fits = fit_conditions(campaign(**{**PIECES, "noise": 0.0}, specimens=3, repeats=1), Config())
    npt.assert_allclose([steady(fits, name).value for name in TRUTH], list(TRUTH.values()), rtol=1e-6)
    assert statistic(fits, "specimen_sd_pct").value < 1e-6
