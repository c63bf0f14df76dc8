import math

import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealfit.config import parse_config
from sealfit.errors import ConfigError
from sealfit.ingest.expression import MAX_CHARACTERS, evaluate, parse


def value(text, condition=False, **names):
    return evaluate(parse(text, condition=condition), names)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1 + 2 * 3", 7.0),
        ("(1 + 2) * 3", 9.0),
        ("-2 ** 2", -4.0),  # the minus binds weaker than the power, as on paper
        ("2 ** 3 ** 2", 512.0),
        ("7 / 2", 3.5),
        ("abs(-3) + min(4, 2, 8) + max(1, 5)", 10.0),
        ("sqrt(2) ** 2", 2.0),
        ("pi * (0.0257 / 2) ** 2", 5.187476e-4),  # bore of 25.7 mm: 518.75 mm2
        ("+a - b", 4.0),
    ],
)
def test_arithmetic_is_that_of_paper(text, expected):
    npt.assert_allclose(value(text, a=7.0, b=3.0), expected, rtol=1e-6)


def test_pressure_force_of_the_piston_by_hand():
    # 1 bar on 518.7476 mm2 is 51.87476 N
    force = value(
        "force - pressure * 1e5 * pi * (0.0257 / 2) ** 2",
        force=np.array([60.0, 55.0]),
        pressure=np.array([1.0, 1.0]),
    )
    npt.assert_allclose(force, [8.12524, 3.12524], atol=1e-4)


def test_dates_become_days_without_their_time():
    put_in = np.array(["2025-04-10", "10.04.2025", "2025-04-17T06:00:00", "soon"])
    days = value("days(tested) - days(put_in)", tested="17.04.2025 08:07:00", put_in=put_in)
    npt.assert_array_equal(days, [7.0, 7.0, 0.0, np.nan])
    with pytest.raises(ConfigError, match="days of a column of dates"):
        value("days(tested - 1)", tested="17.04.2025")


def test_row_filter_compares_joins_and_chains():
    load = np.array([4.0, 5.0, 6.0])
    npt.assert_array_equal(value("load_N > 4.9", True, load_N=load), [False, True, True])
    npt.assert_array_equal(value("4.5 < load_N < 5.5", True, load_N=load), [False, True, False])
    npt.assert_array_equal(value("load_N < 4.5 or not load_N <= 5", True, load_N=load), [True, False, True])
    npt.assert_array_equal(value("load_N != 5 and load_N == load_N", True, load_N=load), [True, False, True])
    npt.assert_array_equal(value("load_N > 4.9", True, load_N=np.array([np.nan])), [False])


def test_undefined_values_come_back_as_nan_without_a_warning():
    assert math.isnan(value("0 / a", a=0.0))
    assert math.isnan(value("sqrt(a)", a=-1.0))
    assert value("9 ** 9 ** 9 ** 9") == math.inf


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("exp(0 * x)", [1.0, 1.0]),
        ("log(x * x)", [0.0, np.log(4.0)]),
        ("sin(pi * x / 2)", [-1.0, 0.0]),
        ("cos(pi * x)", [-1.0, 1.0]),
        ("tanh(0 * x) + sqrt(abs(x) * 4) / 2", [1.0, np.sqrt(2.0)]),
        ("sign(x) * 3", [-3.0, 3.0]),
        ("where(x > 0, 10, 20)", [20.0, 10.0]),
        ("5 * (x > 0 and x < 9) + (not x > 0)", [1.0, 5.0]),
        ("(x < -5 or x == 2) * 7", [0.0, 7.0]),
        ("min(x, 0) + max(x, 1)", [0.0, 2.0]),
        ("(0 < x < 3) + 1", [1.0, 2.0]),
    ],
)
def test_functions_and_conditions_give_the_value_found_by_hand(text, expected):
    npt.assert_allclose(value(text, x=np.array([-1.0, 2.0])), expected, atol=1e-12)


def test_categories_are_compared():
    npt.assert_array_equal(value("0.5 * (batch == 'B') - (batch != 'B')", batch=["A", "B"]), [-1.0, 0.5])
    npt.assert_array_equal(value("batch == 'B'", True, batch=["A", "B"]), [False, True])


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "a.b",
        "a[0]",
        "(lambda: 1)()",
        "[x for x in a]",
        "exec('1')",
        "a if b else c",
        "(a := 1)",
        "a // b",
        "a % b",
        "a @ b",
        "~a",
        "'text'",
        "True",
        "1j",
        "f'{a}'",
        "max(a, b, key=c)",
        "__builtins__",
        "{1: 2}",
        "a in b",
        "batch < 'B'",
        "'B' == batch",
        "exp(a) == 'B'",
    ],
)
def test_every_refusal_names_the_piece(text):
    with pytest.raises(ConfigError, match=r"'.+' is not allowed") as refusal:
        parse(text)
    assert "Allowed are" in str(refusal.value)


@pytest.mark.parametrize("text", ["max(*a, b)", "1" + "0" * 400, "a and b", "not a"])
def test_stars_huge_numbers_and_numbers_as_conditions_are_refused(text):
    with pytest.raises(ConfigError):
        parse(text)


@pytest.mark.parametrize("text", ["", "1 +", "(" * 300, "-" * 900 + "1", "a\0b", "a b", "x = 1", "1if 2"])
def test_what_is_no_expression_is_refused(text):
    with pytest.raises(ConfigError):
        parse(text)


def test_long_deep_and_wrongly_called_are_refused():
    with pytest.raises(ConfigError, match="characters"):
        parse("1+" * MAX_CHARACTERS + "1")
    with pytest.raises(ConfigError, match="nesting"):
        parse("+".join("a" * 200))
    with pytest.raises(ConfigError, match="sqrt takes 1 values, 2 given"):
        parse("sqrt(1, 2)")
    with pytest.raises(ConfigError, match="min takes 2 to 20"):
        parse("min(1)")


@pytest.mark.parametrize(
    ("text", "piece"), [("load_N", "compares nothing"), ("a in b", "'a in b'"), ("a is b", "'a is b'")]
)
def test_row_filter_must_compare(text, piece):
    with pytest.raises(ConfigError, match=piece):
        parse(text, condition=True)


def test_unknown_and_text_names_are_told_with_what_is_known():
    with pytest.raises(ConfigError, match=r"no column 'forse'.*Known: force_N, time_s"):
        value("forse * 2", force_N=1.0, time_s=2.0)
    with pytest.raises(ConfigError, match="'batch' is text"):
        value("batch * 2", batch="A")
    with pytest.raises(ConfigError, match="'batch' is text"):
        value("batch * 2", batch=np.array(["1", "x"], dtype=object))
    with pytest.raises(ConfigError, match="Compare it: batch == 'B'"):
        value("batch * 2", batch="A")


numbers = st.floats(-1e3, 1e3).map(lambda x: round(x, 3))
trees = st.recursive(
    numbers.map(lambda x: f"({x!r})") | st.sampled_from(["a", "b"]),
    lambda part: st.tuples(part, st.sampled_from(["+", "-", "*"]), part).map(
        lambda t: f"({t[0]} {t[1]} {t[2]})"
    ),
    max_leaves=12,
)


@given(trees, numbers, numbers)
def test_agrees_with_python_on_plain_arithmetic(text, a, b):
    npt.assert_allclose(value(text, a=a, b=b), eval(text, {"__builtins__": {}}, {"a": a, "b": b}), rtol=1e-12)


@given(st.text(max_size=60))
def test_any_text_is_either_safe_or_refused(text):
    try:
        expression = parse(text)
    except ConfigError:
        return
    result = evaluate(expression, dict.fromkeys(expression.names, 1.5))
    assert result.dtype.kind == "f"


@pytest.mark.parametrize(
    "line",
    [
        "trace.compute.force_N = 'open(1)'",
        "files.compute.speed_mm_s = 'open(1)'",
        "trace.keep = 'open(1) > 2'",
    ],
)
def test_a_config_is_refused_on_load_with_the_place_of_its_unsafe_expression(line):
    with pytest.raises(ConfigError, match=line.split(" = ")[0] + ".*'open.1.' is not allowed"):
        parse_config(line, "rig.toml")
