"""Free shapes: natural splines and levels, rebuilt from plain data."""

import json

import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealfit.effects.free import (
    free_effect,
    levels_effect,
    roughness,
    slopes_effect,
    smooth_effect,
    surface_effect,
    surface_roughness,
)
from sealfit.errors import ParameterError


@given(
    knots=st.lists(st.integers(-50, 50), min_size=3, max_size=6, unique=True).map(sorted),
    amplitudes=st.lists(st.floats(-5, 5), min_size=6, max_size=6),
)
def test_smooth_goes_through_its_knots_and_is_zero_at_the_first(knots, amplitudes):
    effect = smooth_effect(knots)
    values = dict(zip(effect.linear, amplitudes, strict=False))
    wanted = [values.get(f"c_{j + 1}", 0.0) for j in range(len(knots))]
    npt.assert_allclose(effect.shape({"x": np.array(knots, float)}, **values), wanted, atol=1e-10)


def test_smooth_holds_straight_lines_inside_its_knots_and_its_last_values_beyond():
    effect = smooth_effect([0.0, 1.0, 4.0, 10.0])
    x = np.array([-5.0, 0.0, 0.3, 2.0, 7.7, 10.0, 25.0])
    wanted = 0.5 * np.clip(x, 0.0, 10.0)
    npt.assert_allclose(effect.shape({"x": x}, c_2=0.5, c_3=2.0, c_4=5.0), wanted, atol=1e-13)


def test_smooth_against_a_natural_spline_solved_by_hand():
    # Knots 0, 1, 2 with values 0, 1, 0: the middle second derivative m solves 4 m = 6 (0 - 2 + 0), m = -3, so
    # at 1/2 h = 1/2 - m/6 (1/2 - 1/8) = 1/2 + 3/16 = 11/16.
    npt.assert_allclose(
        smooth_effect([0, 1, 2]).shape({"x": np.array([0.5])}, c_2=1.0, c_3=0.0), [11 / 16], rtol=1e-14
    )


def test_a_shape_in_one_category_is_zero_in_the_others():
    effect = free_effect("within", {"category": "B", "knots": [0.0, 1.0, 2.0]})
    given = {"x": np.array([1.0, 1.0, 2.0]), "z": np.array(["A", "B", "B"])}
    npt.assert_allclose(effect.shape(given, c_2=0.3, c_3=0.5), [0.0, 0.3, 0.5])
    assert effect.label == "smooth in {x} where {z} is B"


def test_roughness_is_the_integral_of_the_squared_second_derivative():
    # Knots 0, 1, 2 scaled to 0, 1/2, 1: h'' rises to m and falls to 0, m = -3 * 4 at values 0, 1, 0; m^2/3.
    npt.assert_allclose(np.array([1.0, 0.0]) @ roughness((0.0, 1.0, 2.0)) @ [1.0, 0.0], 12**2 / 3, rtol=1e-12)


@pytest.mark.parametrize("knots", [(0.0, 1.0, 4.0, 5.0, 9.0), (0.5, 2.0, 9.0, 40.0)])
def test_a_straight_line_is_not_rough(knots):
    line = (
        np.log(knots) if knots[0] > 0 else np.array(knots)
    )  # over a factor of 20: straight in the logarithm
    value = (line - line[0])[1:]
    npt.assert_allclose(roughness(knots) @ value, 0.0, atol=1e-10)
    assert np.linalg.matrix_rank(roughness(knots), tol=1e-8) == len(knots) - 2


def test_a_category_that_was_not_fitted_gets_no_value():
    effect = levels_effect(["A", "B"])
    npt.assert_array_equal(effect.shape({"x": np.array(["B", "C", "A"])}, d_1=0.3), [0.3, np.nan, 0.0])
    assert effect.parameters[0].meaning == "B less A"


@pytest.mark.parametrize(
    ("id_", "fixed"),
    [("smooth", {"knots": [0.0, 2.0, 5.0]}), ("levels", {"categories": ["A", "B", "C"]})],
)
def test_free_shapes_are_rebuilt_from_plain_data(id_, fixed):
    direct = smooth_effect(fixed["knots"]) if id_ == "smooth" else levels_effect(fixed["categories"])
    rebuilt = free_effect(id_, json.loads(json.dumps(fixed)))
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
        (
            lambda: free_effect("wavelet", {}),
            "'wavelet' is no free shape.*smooth, within, levels, surface, slopes",
        ),
        (lambda: free_effect("smooth", {}), "'knots' is missing"),
        (lambda: free_effect("surface", {"x_knots": (0, 1)}), "'z_knots' is missing"),
        (lambda: surface_effect((0, 1), (2, 2)), "two or more rising numbers"),
        (lambda: slopes_effect(["A", "A"]), "two or more different categories"),
    ],
)
def test_refuses_what_makes_no_effect(call, words):
    with pytest.raises(ParameterError, match=words):
        call()


@pytest.mark.parametrize(
    ("effect", "inputs", "values", "expected"),
    [
        # At a knot the spline is that knot's amplitude, whatever the others are.
        (smooth_effect([0, 1, 3, 10]), {"x": 10.0}, {"c_2": 1.0, "c_3": 3.0, "c_4": 4.0}, 4.0),
        # The mean is 2 * 0.3 + 3 * 0.2 + 4 * 0.1.
        (
            smooth_effect([0, 1, 3, 10], (0.4, 0.3, 0.2, 0.1)),
            {"x": 10.0},
            {"c_2": 2.0, "c_3": 3.0, "c_4": 4.0},
            4.0 - 1.6,
        ),
        (levels_effect(["A", "B", "C"]), {"x": "C"}, {"d_1": 0.1, "d_2": 0.2}, 0.2),
        (
            levels_effect(["A", "B", "C"], (0.5, 0.25, 0.25)),
            {"x": "C"},
            {"d_1": 0.1, "d_2": 0.2},
            0.2 - 0.075,
        ),
        # 3 above the reference, in the last category.
        (slopes_effect(["A", "B"]), {"x": 5.0, "x_ref": 2.0, "z": "B"}, {"e_1": 0.1, "e_2": 0.2}, 0.6),
        # At the upper corner the surface is the last amplitude; the mean is 1 * 0.2 + 10 * 0.3 + 11 * 0.4.
        (
            surface_effect((2.0, 6.0), (0.0, 10.0)),
            {"x": 6.0, "z": 10.0},
            {"c_12": 1.0, "c_21": 10.0, "c_22": 11.0},
            11.0,
        ),
        (
            surface_effect((2.0, 6.0), (0.0, 10.0), (0.1, 0.2, 0.3, 0.4)),
            {"x": 6.0, "z": 10.0},
            {"c_12": 1.0, "c_21": 10.0, "c_22": 11.0},
            11.0 - 7.6,
        ),
    ],
)
def test_free_shapes_give_what_is_worked_by_hand(effect, inputs, values, expected):
    assert float(effect.shape(inputs, **values)) == pytest.approx(expected)


def test_surface_of_two_knots_each_is_bilinear_and_constant_beyond_them():
    effect = surface_effect((2.0, 6.0), (0.0, 10.0))
    at = {"x": np.array([2.0, 4.0, 6.0, 7.0]), "z": np.array([0.0, 5.0, 5.0, 12.0])}
    given = effect.shape(at, c_12=1.0, c_21=2.0, c_22=5.0)
    assert list(given) == [0.0, 2.0, 3.5, 5.0]


def test_roughness_of_a_surface_by_hand_and_of_a_plane():
    # h = x z on the unit square: h_xz = 1, so twice its square integrates to 2.
    rough = surface_roughness((0.0, 1.0), (0.0, 1.0))
    assert np.array([0.0, 0.0, 1.0]) @ rough @ [0.0, 0.0, 1.0] == pytest.approx(2.0)
    x, z = (0.0, 1.0, 4.0, 5.0), (1.0, 2.0, 3.0)
    plane = np.add.outer(2.0 * np.array(x), 3.0 * (np.array(z) - 1.0)).ravel()[1:]
    rough = surface_roughness(x, z)
    npt.assert_allclose(rough @ plane, 0.0, atol=1e-9)
    assert np.linalg.matrix_rank(rough, tol=1e-8) == plane.size - 2
