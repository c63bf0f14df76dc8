from functools import partial

import numpy as np
import numpy.testing as npt
import pytest
from scipy.integrate import quad

from sealfit.errors import ParameterError
from sealfit.physics import PRESSURES, Contact
from sealfit.physics.lugre import exponential

uniform, sine, _, parabolic = PRESSURES.values()


@pytest.mark.parametrize("pressure", [*PRESSURES.values(), partial(exponential, decay=-3.0)])
def test_the_mean_over_the_contact_is_one(pressure):
    by_quad, _ = quad(lambda x: float(pressure(x)), 0, 1, epsabs=1e-12)
    npt.assert_allclose(by_quad, 1.0, rtol=1e-11)


def test_values_by_hand():
    x = np.array([0.0, 0.5, 1.0])
    npt.assert_allclose(uniform(x), 1.0)
    npt.assert_allclose(sine(x), [0.0, np.pi / 2, 0.0], atol=1e-15)
    npt.assert_allclose(parabolic(x), [0.0, 1.5, 0.0])
    ends = exponential(np.array([0.0, 1.0]), decay=2.0)
    npt.assert_allclose(ends, [2 / (1 - np.exp(-2)), 2 / (1 - np.exp(-2)) * np.exp(-2)], rtol=1e-13)
    npt.assert_allclose(exponential(x, decay=1e-9), 1.0, rtol=1e-8)
    npt.assert_array_equal(exponential(x, decay=0), 1.0)


def test_the_distribution_matters_where_mu_depends_on_local_pressure():
    """Check 4 of the source, its factor worked out by hand: mu goes as p^(-1/2), over that at p = 5."""
    for pressure, expected in ((uniform, 1.0), (parabolic, np.sqrt(7.5 / 5.0) * np.pi / 4)):
        share, factor = Contact(pressure, width_mm=4.0, exponent=0.5, reference_N_mm=5.0).elements(20.0)
        # sqrt(5 * 7.5 (1 - u^2)) integrated over the contact, u from -1 to 1, times 2 mm, over 20 N
        npt.assert_allclose(share @ factor, expected, rtol=1e-5)


@pytest.mark.parametrize("width", [0.0, -1.0])
def test_refuses_a_contact_without_a_width(width):
    with pytest.raises(ParameterError, match="contact width must be positive"):
        Contact(sine, width_mm=width).elements(10.0)
