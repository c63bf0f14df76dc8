import numpy as np
import pytest

from sealfit.closure.intervals import waves_upright

X = np.linspace(0.0, 7.0, 40)


@pytest.mark.parametrize("amplitude", [-1.5, 1.5])
@pytest.mark.parametrize("phase", [-9.0, -3.2, -np.pi, -0.3, 0.0, 2.8, np.pi, 6.5, 12.0])
def test_a_wave_told_upright_is_the_same_wave(amplitude, phase):
    told = waves_upright({"A": (amplitude, amplitude - 0.2, amplitude + 0.3), "phi": (phase, phase - 0.1, phase + 0.1)})
    (a, a_low, a_high), (phi, phi_low, phi_high) = told["A"], told["phi"]
    assert a == 1.5
    assert (a_low, a_high) == pytest.approx((1.3, 1.8) if amplitude > 0 else (1.2, 1.7))
    assert -np.pi < phi <= np.pi + 1e-12
    assert (phi_low - phi, phi_high - phi) == pytest.approx((-0.1, 0.1))
    np.testing.assert_allclose(a * np.sin(X + phi), amplitude * np.sin(X + phase), atol=1e-12)


def test_what_is_no_wave_is_let_be():
    drift = {"A": (-0.1, -0.2, 0.0), "tau": (3.0, 2.0, 4.0)}
    assert waves_upright(drift) == drift
