"""One contract for every effect of the catalogue, with no test code of its own; then what single forms promise."""

import copy
import pickle
import sys
from pathlib import Path

import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealfit.effects import EFFECTS
from sealfit.effects.contract import CHANNEL, Effect, Parameter, fill_unit
from sealfit.effects.free import free_effect, levels_effect, smooth_effect
from sealfit.errors import ParameterError

FREE = {
    "smooth": smooth_effect([0.0, 1.0, 3.0, 10.0], reference=1.2),
    "smooth of two knots": smooth_effect([2.0, 5.0]),
    "levels": levels_effect(["batch A", "batch B", "batch C"]),
}
EVERY = {**EFFECTS, **FREE}
every_effect = pytest.mark.parametrize("effect", EVERY.values(), ids=EVERY)
every_registered = pytest.mark.parametrize("effect", EFFECTS.values(), ids=EFFECTS)

# A campaign's channels: several speeds both ways, records of some strokes, 16 days of aging.
CAMPAIGN = {
    "displacement_mm": np.linspace(-30.0, 60.0, 12),
    "distance_mm": np.linspace(0.0, 90.0, 12),
    "time_s": np.linspace(0.0, 45.0, 12),
    "speed_mm_s": np.array([0.1, -0.1, 0.5, -0.5, 2.0, -2.0, 8.0, -8.0, 20.0, -20.0, 60.0, -60.0]),
    "load_N": np.linspace(10.0, 200.0, 12),
    "direction": np.tile([1.0, -1.0], 6),
    "repeat": np.tile([1.0, 2.0, 3.0], 4),
    "stroke": np.arange(1.0, 13.0),
    "rest_s": np.geomspace(0.1, 1e5, 12),
    "elapsed_h": np.linspace(0.0, 900.0, 12),
    "aging_days": np.array([0.0, 0.0, 1.0, 1.0, 2.0, 2.0, 4.0, 4.0, 8.0, 8.0, 16.0, 16.0]),
    "lab_temperature_C": np.linspace(18.0, 27.0, 12),
    "humidity_pct": np.linspace(20.0, 80.0, 12),
    "x": np.linspace(0.5, 11.8, 12),
}


def inputs_of(effect: Effect) -> dict:
    """The campaign's channels and references, or an effect's own categories."""
    if effect.id == "levels":
        return {CHANNEL: np.array(["batch C", "batch A", "batch B", "batch A"])}
    channels = {name: CAMPAIGN[name] for name in effect.reads}
    return {**channels, **{f"{name}_ref": float(np.mean(np.abs(values))) for name, values in channels.items()}}


def nonzero(effect: Effect) -> dict[str, float]:
    """Start values, with amplitudes that are not zero and not alike."""
    return {**effect.start(), **{name: 0.1 * (k + 1) for k, name in enumerate(effect.linear)}}


@every_effect
def test_gives_its_worked_value(effect):
    inputs, values, expected = effect.worked
    arrays = {name: np.array([value]) if name in effect.reads else value for name, value in inputs.items()}
    npt.assert_allclose(effect.shape(arrays, **values), [expected], rtol=1e-12, atol=1e-15)


@every_effect
def test_worked_value_gives_every_channel_and_parameter(effect):
    inputs, values, _ = effect.worked
    assert set(effect.reads) <= set(inputs)
    assert set(values) == {p.name for p in effect.parameters}


@every_effect
def test_returns_one_number_per_row(effect):
    inputs = inputs_of(effect)
    shape = effect.shape(inputs, **nonzero(effect))
    assert isinstance(shape, np.ndarray)
    assert shape.shape == inputs[effect.reads[0]].shape
    assert np.any(shape != 0)


@every_effect
def test_is_finite_at_its_start_and_at_every_corner_of_its_bounds(effect):
    inputs = inputs_of(effect)
    assert np.isfinite(effect.shape(inputs, **effect.start())).all()
    for number in range(2 ** len(effect.parameters)):
        corner = {p.name: p.bounds[number >> k & 1] for k, p in enumerate(effect.parameters)}
        assert np.isfinite(effect.shape(inputs, **corner)).all(), corner


@every_effect
@given(values=st.data())
def test_is_linear_in_its_amplitudes(effect, values):
    inputs, start = inputs_of(effect), effect.start()
    draw = st.fixed_dictionaries({name: st.floats(-10, 10) for name in effect.linear})
    one, other = values.draw(draw), values.draw(draw)
    together = {name: one[name] + other[name] for name in effect.linear}
    doubled = {name: 2 * one[name] for name in effect.linear}
    shape = effect.shape(inputs, **{**start, **one})
    scale = max(1.0, float(np.abs(shape).max()))
    npt.assert_allclose(effect.shape(inputs, **{**start, **doubled}), 2 * shape, rtol=1e-12, atol=1e-12 * scale)
    sum_ = shape + effect.shape(inputs, **{**start, **other})
    npt.assert_allclose(effect.shape(inputs, **{**start, **together}), sum_, rtol=1e-9, atol=1e-9 * scale)


@every_effect
def test_is_zero_without_amplitude(effect):
    nothing = {**effect.start(), **dict.fromkeys(effect.linear, 0.0)}
    npt.assert_array_equal(effect.shape(inputs_of(effect), **nothing), 0.0)


@every_effect
def test_every_parameter_changes_the_shape(effect):
    inputs, values = inputs_of(effect), nonzero(effect)
    if effect.id == "step":
        values["x_0"] = 4.0
    before = effect.shape(inputs, **values)
    for p in effect.parameters:
        moved = {**values, p.name: values[p.name] * 1.5 + 0.3}
        assert np.abs(effect.shape(inputs, **moved) - before).max() > 1e-9, p.name


@every_effect
def test_edits_nothing(effect):
    inputs = inputs_of(effect)
    kept = copy.deepcopy(inputs)
    effect.shape(inputs, **nonzero(effect))
    assert inputs.keys() == kept.keys()
    for name, value in kept.items():
        npt.assert_array_equal(inputs[name], value)


@every_effect
def test_says_what_it_is(effect):
    for text in (effect.label, effect.equation, effect.form, effect.source):
        assert text.strip()
    assert effect.acts_on
    assert len(set(effect.acts_on)) == len(effect.acts_on)
    assert "ours" in effect.source.lower() or any(str(year) in effect.source for year in range(1900, 2027))


@every_effect
def test_parameters_have_unit_meaning_bounds_and_a_place_to_search(effect):
    names = [p.name for p in effect.parameters]
    assert len(set(names)) == len(names)
    for p in effect.parameters:
        assert p.meaning
        assert np.isfinite(p.bounds).all()
        assert p.bounds[0] < p.bounds[1]
        # No unit: a count of strokes or repeats, or an exponent.
        assert p.unit or p.name in ("n", "n_0"), f"{p.name} has no unit"
        assert "{" not in fill_unit(p.unit, "mm", "N")
        if not p.linear:
            assert p.search, f"{p.name}: say where to look for it"
            if not isinstance(p.search, str):
                assert all(p.bounds[0] <= value <= p.bounds[1] for value in p.search)


@every_effect
def test_survives_the_way_to_a_worker(effect):
    came_back = pickle.loads(pickle.dumps(effect))
    inputs, values = inputs_of(effect), nonzero(effect)
    npt.assert_array_equal(came_back.shape(inputs, **values), effect.shape(inputs, **values))


@every_effect
def test_small_steps_beyond_the_lower_bounds_stay_finite(effect):
    # The fit takes its slopes by differences: 1e-5 of a value, or of 1e-3 for smaller ones.
    inputs, values = inputs_of(effect), nonzero(effect)
    for p in effect.nonlinear:
        below = p.bounds[0] - 1e-5 * max(abs(p.bounds[0]), 1e-3)
        assert np.isfinite(effect.shape(inputs, **{**values, p.name: below})).all(), p.name


@every_registered
def test_lives_in_a_file_of_its_own_name(effect):
    module = sys.modules[effect.shape.__module__]
    assert Path(module.__file__).stem == effect.id
    assert EFFECTS[effect.id] is effect
    assert getattr(module, effect.id.upper()) is effect
    assert module.__doc__.count(".. math::") == 1


def test_every_effect_file_is_registered():
    folder = Path(sys.modules["sealfit.effects"].__file__).parent
    files = {path.stem for path in folder.glob("*.py")} - {"__init__", "contract", "free", "user"}
    assert files == set(EFFECTS)


@every_registered
def test_closed_forms_read_any_channel_and_mechanisms_read_named_ones(effect):
    assert (effect.reads == (CHANNEL,)) != effect.physical
    assert ("{x}" in effect.label) != effect.physical


# ---------------------------------------------------------------- what single forms promise


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


@pytest.mark.parametrize("name", ["log_rate", "grosch_peak", "warming_power", "warming_conduction"])
def test_a_factor_is_even_in_the_speed(name):
    effect = EFFECTS[name]
    inputs = {**inputs_of(effect), "speed_mm_s": np.geomspace(0.1, 60.0, 12)}
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
        {"distance_mm": 5.0 * time, "distance_mm_ref": 5.0, "speed_mm_s": np.full(3, 5.0), "speed_mm_s_ref": 5.0},
        A=0.05,
    )
    npt.assert_allclose(shape, [-0.05, -0.10, -0.15], rtol=1e-14)


def test_nothing_warms_before_sliding_begins():
    for name, channel in (("warming_time", "time_s"), ("warming_distance", "distance_mm")):
        effect = EFFECTS[name]
        npt.assert_array_equal(effect.shape({channel: np.array([-2.0, 0.0])}, **nonzero(effect)), [0.0, 0.0])


def test_first_repeat_and_first_stroke_are_the_reference():
    for name, channel in (("conditioning", "repeat"), ("run_in", "stroke")):
        effect = EFFECTS[name]
        npt.assert_array_equal(effect.shape({channel: np.array([1.0])}, **nonzero(effect)), [0.0])


@given(ratio=st.floats(0.5, 2.0), exponent=st.floats(2 / 3, 1.0))
def test_load_exponent_is_the_power_law_to_first_order(ratio, exponent):
    # What is left out of (N / N_ref)^(n - 1) - 1 is at most half the square of its logarithm (n < 1: one sign apart).
    first = EFFECTS["load_exponent"].shape({"load_N": np.array([50.0 * ratio]), "load_N_ref": 50.0}, A=exponent - 1)
    exact = ratio ** (exponent - 1) - 1
    logarithm = (exponent - 1) * np.log(ratio)
    assert abs(exact - first[0]) <= 0.5 * logarithm**2 * np.exp(abs(logarithm)) + 1e-12


def test_a_floor_stops_the_logarithmic_fall():
    # mu_0 - a ln(1 + t / b) with A = a: beyond t_f the sum is -a ln(t_f / b) up to a b / t.
    days = np.array([100.0, 1e3, 1e4])
    given_back = EFFECTS["aging_floor"].shape({"aging_days": days}, A=0.03, t_f=50.0)
    npt.assert_allclose(-0.03 * np.log1p(days / 0.1) + given_back, -0.03 * np.log(500.0), atol=0.03 * 0.1 / 100)


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


# ---------------------------------------------------------------- free shapes


@given(
    knots=st.lists(st.integers(-50, 50), min_size=3, max_size=6, unique=True).map(sorted),
    amplitudes=st.lists(st.floats(-5, 5), min_size=6, max_size=6),
)
def test_smooth_goes_through_its_knots_and_is_zero_at_the_reference(knots, amplitudes):
    effect = smooth_effect(knots, reference=knots[1])
    values = dict(zip(effect.linear, amplitudes, strict=False))
    wanted = [values.get(f"c_{j + 1}", 0.0) for j in range(len(knots))]
    npt.assert_allclose(effect.shape({"x": np.array(knots, float)}, **values), wanted, atol=1e-10)


def test_smooth_holds_straight_lines_inside_and_beyond_its_knots():
    effect = smooth_effect([0.0, 1.0, 4.0, 10.0], reference=0.0)
    x = np.array([-5.0, 0.0, 0.3, 2.0, 7.7, 10.0, 25.0])
    npt.assert_allclose(effect.shape({"x": x}, c_2=0.5, c_3=2.0, c_4=5.0), 0.5 * x, atol=1e-13)


def test_smooth_goes_on_straight_and_without_a_kink_beyond_its_knots():
    effect = smooth_effect([0.0, 1.0, 2.0])
    for end, way in ((0.0, -1.0), (2.0, 1.0)):
        x = end + way * np.array([-1e-6, 0.0, 1e-6, 1.0, 2.0, 3.0])
        h = effect.shape({"x": x}, c_2=1.0, c_3=-1.0)
        npt.assert_allclose(np.diff(h[3:]), np.diff(h[3:])[0], rtol=1e-12)
        npt.assert_allclose((h[1] - h[0]) / 1e-6, (h[2] - h[1]) / 1e-6, rtol=1e-4)


def test_smooth_against_a_natural_spline_solved_by_hand():
    # Knots 0, 1, 2 with values 0, 1, 0: the middle second derivative m solves 4 m = 6 (0 - 2 + 0), m = -3, so at 1/2
    # h = 1/2 - m/6 (1/2 - 1/8) = 1/2 + 3/16 = 11/16.
    npt.assert_allclose(smooth_effect([0, 1, 2]).shape({"x": np.array([0.5])}, c_2=1.0, c_3=0.0), [11 / 16], rtol=1e-14)


def test_a_category_that_was_not_fitted_gets_no_value():
    effect = levels_effect(["A", "B"])
    npt.assert_array_equal(effect.shape({"x": np.array(["B", "C", "A"])}, d_1=0.3), [0.3, np.nan, 0.0])
    assert effect.parameters[0].meaning == "B less A"


@pytest.mark.parametrize(
    ("id_", "fixed"),
    [("smooth", {"knots": [0.0, 2.0, 5.0], "x_ref": 2.1}), ("levels", {"categories": ["A", "B", "C"]})],
)
def test_free_shapes_are_rebuilt_from_plain_data(id_, fixed):
    direct = smooth_effect(fixed["knots"], fixed["x_ref"]) if id_ == "smooth" else levels_effect(fixed["categories"])
    rebuilt = free_effect(id_, fixed)
    assert rebuilt.parameters == direct.parameters
    assert (rebuilt.id, rebuilt.form) == (id_, direct.form)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: smooth_effect([1.0]), "two or more rising numbers"),
        (lambda: smooth_effect([1.0, 1.0]), "two or more rising numbers"),
        (lambda: smooth_effect([1.0, np.nan]), "two or more rising numbers"),
        (lambda: levels_effect(["A"]), "two or more different categories"),
        (lambda: levels_effect(["A", "A"]), "two or more different categories"),
        (lambda: free_effect("wavelet", {}), "'wavelet' is no free shape.*'smooth' or 'levels'"),
        (lambda: free_effect("smooth", {}), "'knots' is missing"),
        (lambda: Parameter("A", "", 2.0, (0.0, 1.0), "x"), "start 2.0 lies outside its bounds"),
    ],
)
def test_refuses_what_makes_no_effect(call, words):
    with pytest.raises(ParameterError, match=words):
        call()


def test_symbols_are_printed_without_the_underscore_that_python_needs():
    assert [p.symbol for p in EFFECTS["ripple"].parameters] == ["A", "lambda", "phi"]
