import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from sealfit.errors import ParameterError
from sealfit.physics import PRESSURES, distributed_force, stribeck_force, total_load
from sealfit.physics.pressure import exponential, parabolic, sine, uniform

MODEL = {"mu_s": 0.35, "mu_c": 0.3, "v_s": 5.0, "sigma_2": 0.2}
SPEEDS = np.array([-200.0, -5.0, -0.01, 0.01, 0.7, 5.0, 40.0])


@pytest.mark.parametrize("pressure", PRESSURES.values(), ids=PRESSURES)
@given(load=st.floats(0.1, 1e3), width=st.floats(0.1, 50))
def test_every_distribution_carries_the_whole_load(pressure, load, width):
    npt.assert_allclose(total_load(pressure, load, width_mm=width), load, rtol=1e-12)


@pytest.mark.parametrize("pressure", PRESSURES.values(), ids=PRESSURES)
def test_the_integral_agrees_with_an_independent_quadrature(pressure):
    by_quad, _ = quad(lambda zeta: float(pressure(zeta, 49.03, width_mm=3.0)), 0, 3.0, epsabs=1e-11)
    npt.assert_allclose(by_quad, 49.03, rtol=1e-11)


def test_values_by_hand():
    npt.assert_allclose(uniform([0.0, 4.0], 20.0, width_mm=4.0), [5.0, 5.0])
    npt.assert_allclose(sine([0.0, 2.0, 4.0], 20.0, width_mm=4.0), [0.0, 2.5 * np.pi, 0.0], atol=1e-12)
    npt.assert_allclose(parabolic([0.0, 2.0, 4.0], 20.0, width_mm=4.0), [0.0, 7.5, 0.0], atol=1e-12)
    ends = exponential([0.0, 4.0], 20.0, width_mm=4.0, decay=2.0)
    npt.assert_allclose(ends, [10 / (1 - np.exp(-2)), 10 / (1 - np.exp(-2)) * np.exp(-2)], rtol=1e-13)
    npt.assert_allclose(exponential(1.0, 20.0, width_mm=4.0, decay=1e-9), 5.0, rtol=1e-8)
    assert exponential(1.0, 20.0, width_mm=4.0, decay=0) == 5.0


@pytest.mark.parametrize("pressure", PRESSURES.values(), ids=PRESSURES)
def test_the_distribution_cancels_in_steady_sliding(pressure):
    """Check 4 of the source: Eq. 14 sees the pressure only through its integral."""
    summed = distributed_force(SPEEDS, 49.03, pressure=pressure, width_mm=3.0, **MODEL)
    npt.assert_allclose(summed, stribeck_force(SPEEDS, 49.03, **MODEL), rtol=1e-13)


def test_the_distribution_matters_where_mu_depends_on_local_pressure():
    """The other half of check 4, with the factor worked out by hand."""

    def mu(pressure):
        return 0.3 * pressure ** (-1 / 2)

    plain, peaked = (
        distributed_force(1.0, 20.0, pressure=p, width_mm=4.0, mu_s=mu, mu_c=mu, v_s=5.0, sigma_2=0.0)
        for p in (uniform, parabolic)
    )
    npt.assert_allclose(plain, 0.3 * 4 * np.sqrt(5.0), rtol=1e-13)
    # integral of sqrt(7.5 (1 - u^2)) over the contact, u from -1 to 1, times 2 mm: 2 sqrt(7.5) pi / 2
    npt.assert_allclose(peaked, 0.3 * np.sqrt(7.5) * np.pi, rtol=1e-5)


def test_refuses_a_place_outside_the_contact_and_a_width_of_zero():
    with pytest.raises(ParameterError, match="zeta_mm must lie in the contact, from 0 to 2 mm"):
        uniform(2.1, 10.0, width_mm=2.0)
    with pytest.raises(ParameterError, match="contact width must be positive"):
        sine(0.0, 10.0, width_mm=0.0)
