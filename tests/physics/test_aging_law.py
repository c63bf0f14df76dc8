import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealfit.errors import ParameterError
from sealfit.physics import aging_constant, aging_law

MU_S = {"a": 0.04448, "b": 0.0804, "c": 0.11159}  # printed in the source for 80 degC, 80 %
MU_C = {"a": 0.03307, "b": 0.1324, "c": 0.06621}


def as_printed(days, *, mu_0, a, b, c):
    """Return Eq. 15 as printed in the source, with four parameters."""
    return mu_0 - a * np.log(days + b) - c


def test_check_1_the_restored_minus_signs_reproduce_mu_s():
    law = as_printed(np.array([0, 4, 16]), mu_0=0.93513, **MU_S)
    npt.assert_allclose(law, [0.93566, 0.76099, 0.69999], atol=1e-5)
    npt.assert_allclose(law[1:] / [0.75859, 0.70319] - 1, [0.003, -0.005], atol=6e-4)


def test_check_2_mu_c_is_below_five_percent_only_with_its_own_start():
    measured = np.array([0.48429, 0.44781])
    law = as_printed(np.array([4, 16]), mu_0=0.609, **MU_C)
    npt.assert_allclose(law, [0.49587, 0.45083], atol=1e-5)
    assert np.all(np.abs(law / measured - 1) < 0.05)
    printed = as_printed(np.array([4, 16]), mu_0=0.639, **MU_C)
    npt.assert_allclose(printed[1], 0.48082, atol=2e-5)  # the prediction as printed
    npt.assert_allclose(printed / measured - 1, [0.086, 0.074], atol=6e-4)


@pytest.mark.parametrize("printed", [MU_S, MU_C], ids=["mu_s", "mu_c"])
def test_check_3_the_printed_c_is_minus_a_ln_b(printed):
    assert abs(aging_constant(printed["a"], printed["b"]) - printed["c"]) < 0.0008


@given(
    mu_0=st.floats(0, 2),
    a=st.floats(-0.5, 0.5),
    b=st.floats(1e-4, 1e3),
    shift=st.floats(-1, 1),
    day=st.floats(0, 100),
)
def test_check_3_only_mu_0_minus_c_is_determined(mu_0, a, b, shift, day):
    c = aging_constant(a, b)
    plain = aging_law(day, mu_0=mu_0, a=a, b=b)
    npt.assert_allclose(as_printed(day, mu_0=mu_0, a=a, b=b, c=c), plain, atol=1e-10)
    npt.assert_allclose(as_printed(day, mu_0=mu_0 + shift, a=a, b=b, c=c + shift), plain, atol=1e-10)


@given(mu_0=st.floats(0, 2), a=st.floats(-0.5, 0.5), b=st.floats(1e-6, 1e6))
def test_starts_at_mu_0_and_halves_by_ln_2_after_b_days(mu_0, a, b):
    assert aging_law(0.0, mu_0=mu_0, a=a, b=b) == mu_0
    npt.assert_allclose(aging_law(b, mu_0=mu_0, a=a, b=b), mu_0 - a * np.log(2), atol=1e-12)


def test_refuses_b_and_days_outside_the_law():
    with pytest.raises(ParameterError, match="b = 0 d: the aging law needs b > 0"):
        aging_law(1.0, mu_0=1.0, a=0.1, b=0.0)
    with pytest.raises(ParameterError, match="b = -1 d"):
        aging_constant(0.1, -1.0)
    with pytest.raises(ParameterError, match="aging_days = -1: aging time cannot be negative"):
        aging_law(-1.0, mu_0=1.0, a=0.1, b=1.0)
