import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealfit.errors import ParameterError
from sealfit.physics import stribeck_decay, stribeck_force

PAPER = {
    "mu_s": 0.35,
    "mu_c": 0.3,
    "v_s": 5.0,
    "sigma_2": 0.2,
}  # the sensitivity study of the source, at 50 N
coefficient = st.floats(0.0, 2.0)
positive = st.floats(1e-3, 1e3)


def test_worked_by_hand_at_the_stribeck_speed():
    # at v = v_s: 50 N (0.3 + 0.05 / e) + 0.2 N s/mm * 5 mm/s
    npt.assert_allclose(stribeck_force(5.0, 50.0, **PAPER), 15 + 2.5 * 0.36787944117144233 + 1.0, rtol=1e-14)


def test_slow_limit_is_static_and_fast_limit_is_coulomb_plus_viscous():
    npt.assert_allclose(stribeck_force(1e-9, 50.0, **PAPER), 17.5, rtol=1e-9)
    npt.assert_allclose(stribeck_force(1000.0, 50.0, **PAPER), 15 + 200, rtol=1e-14)


def test_no_force_at_rest():
    assert stribeck_force(0.0, 50.0, **PAPER) == 0.0


@given(speed=st.floats(-500, 500), load=st.floats(0, 1e3), mu_s=coefficient, mu_c=coefficient, v_s=positive)
def test_odd_in_speed_and_between_static_and_coulomb(speed, load, mu_s, mu_c, v_s):
    model = {"mu_s": mu_s, "mu_c": mu_c, "v_s": v_s, "sigma_2": 0.0}
    forward, back = stribeck_force(speed, load, **model), stribeck_force(-speed, load, **model)
    assert forward == -back
    if speed != 0:
        low, high = sorted((mu_s * load, mu_c * load))
        assert low - 1e-9 <= abs(forward) <= high + 1e-9


@given(load=st.floats(0, 1e3, allow_subnormal=False), factor=st.floats(0.1, 10))
def test_proportional_to_load_without_viscosity(load, factor):
    model = PAPER | {"sigma_2": 0.0}
    npt.assert_allclose(
        stribeck_force(3.0, factor * load, **model),
        factor * stribeck_force(3.0, load, **model),
        rtol=1e-12,
        atol=1e-300,
    )


def test_arrays_broadcast():
    force = stribeck_force(np.array([[1.0], [-2.0]]), np.array([10.0, 20.0, 30.0]), **PAPER)
    assert force.shape == (2, 3)
    npt.assert_allclose(force[1, 2], stribeck_force(-2.0, 30.0, **PAPER))


@pytest.mark.parametrize("v_s", [0.0, -1.0, float("nan")])
def test_refuses_a_stribeck_speed_that_is_not_positive(v_s):
    with pytest.raises(ParameterError, match="Stribeck velocity must be positive"):
        stribeck_decay(1.0, v_s)


def test_refuses_a_negative_load():
    with pytest.raises(ParameterError, match=r"load_N = -1.*cannot be negative"):
        stribeck_force(1.0, -1.0, **PAPER)
