import math

from hypothesis import given, settings
from hypothesis import strategies as st

from sealfit.report.notation import decimals, measured, number, p_value, together

SIGNS = str.maketrans("−⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "--0123456789")
sizes = st.floats(1e-12, 1e12)
signed = st.floats(-1e12, 1e12).filter(lambda x: x == 0 or abs(x) > 1e-12)


def read(text):
    """Return the number that a text says, as a person would read it."""
    text = text.translate(SIGNS).replace("\u202f", "")
    mantissa, _, power = text.partition("×10")
    return float(mantissa) * 10.0 ** int(power or 0)


@given(signed, st.integers(2, 5))
def test_a_number_reads_back_to_its_digits(value, digits):
    assert math.isclose(read(number(value, digits)), value, rel_tol=0.51 * 10.0 ** (1 - digits))


@given(sizes)
def test_decimals_leave_two_significant_digits(size):
    places = decimals(size)
    assert 10 <= round(size * 10.0**places) < 100 or math.isclose(size * 10.0**places, 100, rel_tol=1e-9)


@settings(max_examples=300)
@given(st.floats(-1e5, 1e5), st.floats(1e-4, 1e4), st.floats(1e-4, 1e4))
def test_value_and_interval_are_rounded_alike_and_hold_each_other(value, below, above):
    text, interval = measured(value, value - below, value + above)
    tail = interval[interval.index("]") + 1 :]
    ends = [read(end + tail) for end in interval[1 : interval.index("]")].split(", ")]
    # two significant digits of the half-width: nothing is off by more than 1/20 of it
    half = (below + above) / 2
    assert abs(read(text) - value) <= 0.051 * half + 1e-9 * abs(value)
    assert abs(ends[0] - (value - below)) <= 0.051 * half + 1e-9 * abs(value)
    assert ends[0] <= read(text) <= ends[1]
    places = {
        len(part.partition(".")[2].split("×")[0].strip("\u202f]"))
        for part in (text, *interval[1:].split(", "))
    }
    assert len(places) == 1


def test_what_is_not_there_is_a_dash_and_never_nan():
    for nothing in (None, math.nan):
        assert number(nothing) == "–"
        assert measured(nothing, 1.0, 2.0) == ("–", "–")
        assert p_value(nothing) == "not available"
        assert together([nothing, 1.0]) == ["–", "1.0"]
    assert number(math.inf) == "∞"


def test_a_one_sided_interval_says_so():
    assert measured(3.0, None, 4.5) == ("3.00", "up to 4.50")
    assert measured(3.0, 1.5, math.nan) == ("3.00", "from 1.50")


def test_no_minus_stands_before_zero():
    assert measured(-0.0001, -0.2, 0.2)[0] == "0.00"


def test_together_gives_every_number_the_same_decimals():
    assert together([1.4234, 0.3121, 0.2899]) == ["1.42", "0.31", "0.29"]
    # one value near zero does not drag the others along
    assert together([1.5, 1e-9]) == ["1.500", "0.000"]


def test_small_p_values_are_bounds_not_zeros():
    assert p_value(0.0) == "< 0.001"
    assert p_value(0.00999) == "= 0.010"
    assert p_value(1.0) == "> 0.99"
