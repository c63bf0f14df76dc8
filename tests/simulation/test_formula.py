import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealfit.errors import ConfigError
from sealfit.simulation.formula import evaluate_formula, parse_formula


def value(text, **channels):
    return evaluate_formula(parse_formula(text), {name: np.asarray(v) for name, v in channels.items()})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2 * x + 1", [-1.0, 5.0]),
        ("x ** 2 / 4", [0.25, 1.0]),
        ("-x", [1.0, -2.0]),
        ("exp(0 * x)", [1.0, 1.0]),
        ("log(x * x)", [0.0, np.log(4.0)]),
        ("sin(pi * x / 2)", [-1.0, 0.0]),
        ("cos(pi * x)", [-1.0, 1.0]),
        ("tanh(0 * x) + sqrt(abs(x) * 4) / 2", [1.0, np.sqrt(2.0)]),
        ("sign(x) * 3", [-3.0, 3.0]),
        ("where(x > 0, 10, 20)", [20.0, 10.0]),
        ("5 * (x > 0 and x < 9) + (not x > 0)", [1.0, 5.0]),
        ("(x < -5 or x == 2) * 7", [0.0, 7.0]),
        ("minimum(x, 0) + maximum(x, 1)", [0.0, 2.0]),
    ],
)
def test_formula_gives_the_value_found_by_hand(text, expected):
    npt.assert_allclose(value(text, x=[-1.0, 2.0]), expected, atol=1e-12)


def test_formula_compares_categories():
    npt.assert_array_equal(value("0.5 * (batch == 'B') - (batch != 'B')", batch=["A", "B"]), [-1.0, 0.5])


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os')",
        "open('x')",
        "x.real",
        "x[0]",
        "lambda: 1",
        "[1, 2]",
        "'text'",
        "True",
        "x if x > 0 else 1",
        "f'{x}'",
        "(y := 3)",
        "exp(x, out=x)",
        "exp(*x)",
        "x // 2",
        "x % 2",
        "x @ x",
        "0 < x < 1",
        "'B' == batch",
        "batch < 'B'",
        "exp(x) == 'B'",
        "1e5j",
        "x in x",
        "",
        "1 +",
        "__class__",
        "9" * 400,
        "(" * 200 + "x" + ")" * 200 + " + " * 0 + "+ 1" * 700,
        "-" * 300 + "x",
    ],
)
def test_formula_refuses_what_is_not_on_the_list(text):
    with pytest.raises(ConfigError):
        parse_formula(text)


def test_formula_names_the_missing_channel_and_the_known_ones():
    with pytest.raises(ConfigError, match=r"no channel 'load_N'\. Known: x"):
        value("load_N * 2", x=[1.0])


def test_formula_says_that_a_category_is_no_number():
    with pytest.raises(ConfigError, match="a category cannot be computed with"):
        value("batch * 2", batch=["A", "B"])


def test_a_huge_power_is_infinite_at_once():
    assert np.isinf(value("9 ** 9 ** 9 ** 9"))


@given(st.text(max_size=40) | st.text("x1.+-*/()=<>!'\"[]{}:, \n\\@%&|if", max_size=25))
def test_any_text_is_a_formula_of_numbers_or_refused(text):
    try:
        formula = parse_formula(text)
    except ConfigError:
        return
    assert evaluate_formula(formula, {name: np.ones(2) for name in formula.channels}).dtype == float


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(0.1, 1e3))
def test_arithmetic_is_pythons(a, b, c):
    npt.assert_allclose(value("a + b * 2 - (a - b) / c ** 2", a=a, b=b, c=c), a + b * 2 - (a - b) / c**2, rtol=1e-12)
