"""What single effects promise: limits, symmetries, and second closed forms."""

import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealfit.effects import EFFECTS
from sealfit.effects.contract import Effect


def nonzero(effect: Effect) -> dict[str, float]:
    """Start values, with amplitudes that are not zero and not alike."""
    return {**effect.start(), **{name: 0.1 * (k + 1) for k, name in enumerate(effect.linear)}}


@pytest.mark.parametrize("name", ["linear", "quadratic", "log", "power"])
def test_forms_with_a_reference_are_zero_there(name):
    effect = EFFECTS[name]
    npt.assert_array_equal(effect.shape({"x": np.array([7.0]), "x_ref": 7.0}, **nonzero(effect)), [0.0])


@pytest.mark.parametrize("name", ["exponential_approach", "saturation", "log_growth"])
def test_forms_from_the_origin_start_there_and_say_nothing_below(name):
    effect = EFFECTS[name]
    shape = effect.shape({"x": np.array([0.0, -1.0]), "x_ref": 7.0}, **nonzero(effect))
    npt.assert_array_equal(shape, [0.0, np.nan])


@pytest.mark.parametrize("name", ["log", "power"])
def test_forms_of_a_positive_channel_say_nothing_elsewhere(name):
    effect = EFFECTS[name]
    npt.assert_array_equal(
        effect.shape({"x": np.array([0.0, -1.0]), "x_ref": 7.0}, **nonzero(effect)), [np.nan, np.nan]
    )
    npt.assert_array_equal(effect.shape({"x": np.array([2.0]), "x_ref": 0.0}, **nonzero(effect)), [np.nan])


@given(speed=st.floats(1e-3, 1e3), n=st.floats(0.1, 3), A=st.floats(-100, 100))
def test_an_added_viscous_force_is_odd_in_the_speed(speed, n, A):
    shape = EFFECTS["power_viscous"].shape
    forward = shape({"speed_mm_s": np.array([speed])}, A=A, n=n)
    npt.assert_array_equal(shape({"speed_mm_s": np.array([-speed])}, A=A, n=n), -forward)


@pytest.mark.parametrize(
    "name", ["log_rate", "stribeck_exponent", "grosch_peak", "warming_power", "warming_conduction"]
)
def test_a_factor_is_even_in_the_speed(name):
    effect = EFFECTS[name]
    sliding = {"distance_mm": np.arange(12.0), "time_s": np.arange(12.0), "load_N": np.arange(1.0, 13.0)}
    inputs = {**sliding, "speed_mm_s": np.geomspace(0.1, 60.0, 12)}
    back = {**inputs, "speed_mm_s": -inputs["speed_mm_s"]}
    values = nonzero(effect)
    npt.assert_array_equal(effect.shape(inputs, **values), effect.shape(back, **values))


def test_warming_by_power_at_the_reference_is_warming_by_time():
    time = np.linspace(0.0, 30.0, 7)
    at_reference = {
        "speed_mm_s": np.full(7, 5.0),
        "speed_mm_s_ref": 5.0,
        "load_N": np.full(7, 50.0),
        "load_N_ref": 50.0,
    }
    power = EFFECTS["warming_power"].shape({"time_s": time, **at_reference}, A=0.2, tau=4.0)
    npt.assert_allclose(power, EFFECTS["warming_time"].shape({"time_s": time}, A=0.2, tau=4.0), rtol=1e-15)


def test_conduction_follows_the_root_of_time_at_one_speed():
    # v s = v^2 t: at one speed the surface warms as the root of the time, Carslaw & Jaeger's half-space.
    time = np.array([1.0, 4.0, 9.0])
    shape = EFFECTS["warming_conduction"].shape(
        {
            "distance_mm": 5.0 * time,
            "distance_mm_ref": 5.0,
            "speed_mm_s": np.full(3, 5.0),
            "speed_mm_s_ref": 5.0,
        },
        A=0.05,
    )
    npt.assert_allclose(shape, [-0.05, -0.10, -0.15], rtol=1e-14)


def test_nothing_warms_before_sliding_begins():
    for name, channel in (("warming_time", "time_s"), ("warming_distance", "distance_mm")):
        effect = EFFECTS[name]
        npt.assert_array_equal(effect.shape({channel: np.array([-2.0, 0.0])}, **nonzero(effect)), [0.0, 0.0])


@pytest.mark.parametrize("name", [*(id for id in EFFECTS if id.startswith("warming")), "grosch_peak"])
def test_friction_that_grows_is_no_warming_and_a_valley_no_peak(name):
    (amplitude,) = EFFECTS[name].linear
    bounds = {p.name: p.bounds for p in EFFECTS[name].parameters}
    assert bounds[amplitude][0] == 0.0


def test_first_repeat_and_first_stroke_are_the_reference():
    for name, channel in (("conditioning", "repeat"), ("run_in", "stroke")):
        effect = EFFECTS[name]
        npt.assert_array_equal(effect.shape({channel: np.array([1.0])}, **nonzero(effect)), [0.0])


@given(ratio=st.floats(0.5, 2.0), exponent=st.floats(2 / 3, 1.0))
def test_load_exponent_is_the_power_law_to_first_order(ratio, exponent):
    # What is left out of (N / N_ref)^(n - 1) - 1 is at most half the square of its logarithm (n < 1: one sign
    # apart).
    first = EFFECTS["load_exponent"].shape(
        {"load_N": np.array([50.0 * ratio]), "load_N_ref": 50.0}, A=exponent - 1
    )
    exact = ratio ** (exponent - 1) - 1
    logarithm = (exponent - 1) * np.log(ratio)
    assert abs(exact - first[0]) <= 0.5 * logarithm**2 * np.exp(abs(logarithm)) + 1e-12


def test_a_floor_stops_the_logarithmic_fall():
    # mu_0 - a ln(1 + t / b) with A = a: beyond t_f the sum is -a ln(t_f / b) up to a b / t.
    days = np.array([100.0, 1e3, 1e4])
    given_back = EFFECTS["aging_floor"].shape({"aging_days": days}, A=0.03, t_f=50.0)
    npt.assert_allclose(
        -0.03 * np.log1p(days / 0.1) + given_back, -0.03 * np.log(500.0), atol=0.03 * 0.1 / 100
    )


def test_an_induction_lag_is_largest_at_its_day_and_gone_at_day_0():
    days = np.array([0.0, 1.9, 2.0, 2.1, 60.0])
    lag = EFFECTS["aging_induction"].shape({"aging_days": days}, A=0.1, t_i=2.0)
    assert lag[0] == 0
    npt.assert_allclose(lag[2], 0.1, rtol=1e-15)
    assert lag[2] > max(lag[1], lag[3])
    assert abs(lag[4]) < 1e-10


def test_asymmetry_is_the_difference_of_both_ways_and_leaves_their_mean():
    forward, back = EFFECTS["asymmetry"].shape({"direction": np.array([1.0, -1.0])}, A=0.08)
    npt.assert_allclose([forward - back, forward + back], [0.08, 0.0], rtol=1e-15)


def test_a_viscoelastic_peak_has_no_force_at_rest():
    shape = EFFECTS["grosch_peak"].shape({"speed_mm_s": np.array([0.0])}, A=0.3, v_p=1.0, w=1.0)
    npt.assert_array_equal(shape, [0.0])


def test_the_declared_curve_with_its_exponent_changed_is_the_curve_of_that_exponent():
    speed = np.geomspace(0.1, 60.0, 20)
    declared = 0.4 + 0.3 * np.exp(-((speed / 5.0) ** 2))
    change = EFFECTS["stribeck_exponent"].shape({"speed_mm_s": speed}, A=0.3, v_s=5.0, n=0.7)
    npt.assert_allclose(declared + change, 0.4 + 0.3 * np.exp(-((speed / 5.0) ** 0.7)), rtol=1e-14)


@given(n=st.floats(0.2, 10.0))
def test_a_stribeck_exponent_changes_nothing_at_rest_at_the_stribeck_speed_and_far_above(n):
    shape = EFFECTS["stribeck_exponent"].shape
    npt.assert_allclose(
        shape({"speed_mm_s": np.array([0.0, 5.0, 5e19])}, A=0.3, v_s=5.0, n=n), 0.0, atol=1e-15
    )


def test_a_stribeck_exponent_of_2_is_the_declared_curve_and_near_2_only_a_product_shows():
    speed = np.geomspace(0.1, 60.0, 20)
    shape = EFFECTS["stribeck_exponent"].shape
    npt.assert_array_equal(shape({"speed_mm_s": speed}, A=0.3, v_s=5.0, n=2.0), 0.0)
    ratio = speed / 5.0
    first = 0.3 * -1e-4 * ratio**2 * np.log(ratio) * np.exp(-(ratio**2))
    npt.assert_allclose(shape({"speed_mm_s": speed}, A=0.3, v_s=5.0, n=2.0001), first, atol=1e-8)


def test_a_hyperbolic_decay_is_a_constant_less_a_saturation():
    inputs = {"x": np.array([0.0, 1.0, 50.0, -1.0])}
    decay = EFFECTS["hyperbolic"].shape(inputs, A=0.4, x_half=3.0)
    npt.assert_allclose(decay, 0.4 - EFFECTS["saturation"].shape(inputs, A=0.4, x_half=3.0), rtol=1e-14)
    npt.assert_array_equal(decay[[0, 3]], [0.4, np.nan])


def test_a_sine_with_harmonics_is_two_sines_the_second_of_half_the_period():
    inputs = {"x": np.linspace(-3.0, 4.0, 15)}
    both = EFFECTS["sinusoid_harmonics"].shape(inputs, A=0.4, B=0.2, lambda_=1.7, phi=0.3, phi_2=-1.1)
    sine = EFFECTS["sinusoid"].shape
    first, second = sine(inputs, A=0.4, lambda_=1.7, phi=0.3), sine(inputs, A=0.2, lambda_=0.85, phi=-1.1)
    npt.assert_allclose(both, first + second, atol=1e-14)


def test_arrhenius_is_a_factor_of_two_to_three_per_ten_degrees_at_a_rubbers_activation_energy():
    # van 't Hoff's rule. By hand, 60 to 70 degC at 80 kJ/mol: 9621.8 K * (1/333.15 - 1/343.15) / K = 0.84165.
    inputs = {"temperature_C": np.array([60.0, 70.0]), "temperature_C_ref": 60.0}
    shape = EFFECTS["arrhenius_aging"].shape(inputs, A=1.0, E=8e4)
    npt.assert_allclose(1 + shape, [1.0, 2.3202], atol=2e-4)


@given(celsius=st.floats(20.0, 100.0), energy=st.floats(1e3, 1.2e5))
def test_arrhenius_on_a_time_undoes_that_on_a_rate(celsius, energy):
    shape = EFFECTS["arrhenius_aging"].shape
    inputs = {"temperature_C": np.array([celsius]), "temperature_C_ref": 60.0}
    rate, time = 1 + shape(inputs, A=1.0, E=energy), 1 + shape(inputs, A=1.0, E=-energy)
    npt.assert_allclose(rate * time, 1.0, rtol=1e-9)


def test_arrhenius_says_nothing_below_absolute_zero():
    shape = EFFECTS["arrhenius_aging"].shape({"temperature_C": np.array([-273.15, -300.0])}, A=1.0, E=8e4)
    npt.assert_array_equal(shape, [np.nan, np.nan])


def test_rubber_that_was_not_compressed_is_the_reference_whatever_the_campaigns_mean():
    inputs = {"compression_ratio_pct": np.array([100.0, 90.0, 80.0]), "compression_ratio_pct_ref": 90.0}
    npt.assert_allclose(EFFECTS["compression_factor"].shape(inputs, A=0.5), [0.0, 0.05, 0.10], atol=1e-16)
