import numpy as np
import numpy.testing as npt
import pytest
from scipy.integrate import quad

from sealfit.errors import ParameterError
from sealfit.physics import PRESSURES, Contact
from sealfit.physics.lugre import load_per_width

uniform, sine, exponential, parabolic = PRESSURES.values()


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


def test_the_distribution_matters_where_mu_depends_on_local_pressure():
    """Check 4 of the source, its factor worked out by hand: mu goes as p^(-1/2), over that at p = 5."""
    for pressure, expected in ((uniform, 1.0), (parabolic, np.sqrt(7.5 / 5.0) * np.pi / 4)):
        share, factor = Contact(pressure, width_mm=4.0, exponent=0.5, reference_N_mm=5.0).elements(20.0)
        # sqrt(5 * 7.5 (1 - u^2)) integrated over the contact, u from -1 to 1, times 2 mm, over 20 N
        npt.assert_allclose(share @ factor, expected, rtol=1e-5)


def test_refuses_a_place_outside_the_contact_and_a_width_of_zero():
    with pytest.raises(ParameterError, match="zeta_mm must lie in the contact, from 0 to 2 mm"):
        uniform(2.1, 10.0, width_mm=2.0)
    with pytest.raises(ParameterError, match="contact width must be positive"):
        sine(0.0, 10.0, width_mm=0.0)


@pytest.mark.parametrize("own", [{"shape": "hertz"}, {"shape": "sine", "decay": 2.0}])
def test_refuses_an_unknown_shape_and_a_decay_of_a_shape_without_one(own):
    with pytest.raises(ParameterError, match="uniform, sine, exponential, parabolic; only exponential has"):
        load_per_width(1.0, 10.0, width_mm=2.0, **own)
