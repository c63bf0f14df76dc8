"""One contract for every effect of the catalogue and for free shapes, with no test code of their own."""

import copy
import pickle
import re
import sys
from pathlib import Path

import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealfit.effects import EFFECTS, FAMILIES
from sealfit.effects.contract import CHANNEL, READS_ANY, Effect, Parameter, fill_unit
from sealfit.effects.free import levels_effect, smooth_effect
from sealfit.errors import ParameterError

FREE = {
    "smooth": smooth_effect([0.0, 1.0, 3.0, 10.0]),
    "smooth of two knots": smooth_effect([2.0, 5.0]),
    "smooth about its mean": smooth_effect([0.0, 1.0, 3.0, 10.0], (0.4, 0.3, 0.2, 0.1)),
    "levels about their mean": levels_effect(["batch A", "batch B", "batch C"], (0.5, 0.25, 0.25)),
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
    "temperature_C": np.repeat([23.0, 60.0, 80.0], 4),
    "compression_ratio_pct": np.repeat([100.0, 90.0, 80.0], 4),
    "lab_temperature_C": np.linspace(18.0, 27.0, 12),
    "humidity_pct": np.linspace(20.0, 80.0, 12),
    "x": np.linspace(0.5, 11.8, 12),
    "z": np.linspace(3.0, 1.0, 12) ** 2,
}


def inputs_of(effect: Effect) -> dict:
    """The campaign's channels and references, or an effect's own categories."""
    if effect.id == "levels":
        return {CHANNEL: np.array(["batch C", "batch A", "batch B", "batch A"])}
    channels = {name: CAMPAIGN[name] for name in effect.reads}
    return {
        **channels,
        **{f"{name}_ref": float(np.mean(np.abs(values))) for name, values in channels.items()},
    }


def nonzero(effect: Effect) -> dict[str, float]:
    """Start values, with amplitudes that are not zero and not alike."""
    return {**effect.start(), **{name: 0.1 * (k + 1) for k, name in enumerate(effect.linear)}}


@every_registered
def test_gives_its_worked_value(effect):
    inputs, values, expected = effect.worked
    arrays = {name: np.array([value]) if name in effect.reads else value for name, value in inputs.items()}
    npt.assert_allclose(effect.shape(arrays, **values), [expected], rtol=1e-12, atol=1e-15)


@every_registered
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
    npt.assert_allclose(
        effect.shape(inputs, **{**start, **doubled}), 2 * shape, rtol=1e-12, atol=1e-12 * scale
    )
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
    if effect.id == "temporary_change":
        values |= {"t_1": 150.0, "t_2": 400.0}
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


def test_every_effect_file_is_a_family_of_the_catalogue():
    folder = Path(sys.modules["sealfit.effects"].__file__).parent
    files = {path.stem for path in folder.glob("*.py")} - {"__init__", "contract", "free", "user"}
    assert files == {family.__name__.rpartition(".")[2] for family in FAMILIES}


@every_registered
def test_closed_forms_read_any_channel_and_mechanisms_read_named_ones(effect):
    assert (effect.reads in READS_ANY) != effect.physical
    assert ("{x}" in effect.label) != effect.physical


ZERO_AT = {  # inputs of the states that effects name as their reference
    "cold contact (time 0)": {"time_s": 0.0},
    "cold contact (distance 0)": {"distance_mm": 0.0},
    "time 0 of the file": {"time_s": 0.0},
    "start of the campaign": {"elapsed_h": 0.0},
    "first repeat": {"repeat": 1.0},
    "first stroke": {"stroke": 1.0},
    "no rest before the stroke": {"rest_s": 0.0},
    "not compressed (100 %)": {"compression_ratio_pct": 100.0},
    "unaged": {"aging_days": 0.0},
    "{x} = 0": {"x": 0.0},
}


@every_effect
def test_the_reference_is_said(effect):
    assert effect.reference


@pytest.mark.parametrize(
    "effect",
    [e for e in EVERY.values() if e.reference in ZERO_AT or "_ref}" in e.reference],
    ids=lambda e: e.id,
)
def test_the_shape_is_zero_at_the_reference_that_is_said(effect):
    """Others say a mean, a limit, or a place that parameters or categories tell."""
    named = re.findall(r"\{(\w+)_ref\}", effect.reference)
    at = ZERO_AT.get(effect.reference) or dict.fromkeys(
        named[:1] if " or " in effect.reference else named, 1.5
    )
    inputs = {name: np.array([at.get(name, 2.0)]) for name in effect.reads}
    fixed = {f"{name}_ref": 1.5 for name in effect.reads}
    values = {p.name: p.start for p in effect.parameters} | dict.fromkeys(effect.linear, 0.3)
    npt.assert_allclose(effect.shape({**inputs, **fixed}, **values), 0.0, atol=1e-12)


def test_symbols_are_printed_without_the_underscore_that_python_needs():
    assert [p.symbol for p in EFFECTS["ripple"].parameters] == ["A", "lambda", "phi"]


def test_a_parameter_that_starts_outside_its_bounds_is_refused():
    with pytest.raises(ParameterError, match=r"start 2\.0 lies outside its bounds"):
        Parameter("A", "", 2.0, (0.0, 1.0), "x")


@pytest.mark.parametrize(
    ("unit", "x", "y", "filled"),
    [
        ("{y}", "mm", "", ""),
        ("{x}", "mm", "N", "mm"),
        ("{y}/{x}", "mm", "N", "N/mm"),
        ("{y}/{x}", "mm", "", "1/mm"),
        ("{y}/{x}", "", "mN m", "mN m"),
        ("{y}/{x}", "", "", ""),
        ("{y}/{x}^2", "mm/s", "N", "N/(mm/s)^2"),
        ("rad", "mm", "N", "rad"),
    ],
)
def test_units_are_filled_in(unit, x, y, filled):
    assert fill_unit(unit, x, y) == filled
