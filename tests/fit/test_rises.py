"""Bristles followed along strokes, against a loop and differences; ramps against their true motion."""

from dataclasses import replace

import numpy as np
import numpy.testing as npt
import pytest

from sealfit.fit.dynamic.bristle_model import Rises, RisingStroke, StribeckCurve, _followed
from sealfit.fit.dynamic.starts import fit_ramps
from sealfit.fit.least_squares import central_jacobian

CURVE = StribeckCurve(44.0, 29.0, 5.0, 0.05)


def strokes():
    generator = np.random.default_rng(3)
    for k, rows in enumerate((40, 70, 55)):
        time = np.linspace(0.0, 1.0, rows)
        speed = (k + 1.0) * np.clip(time / 0.2, 0.0, 1.0)
        distance = np.r_[0.0, np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(time))]
        force = 30 * (1 - np.exp(-distance / 0.3)) + 0.1 * generator.standard_normal(rows)
        yield RisingStroke(k, k, 1.0 + 0.1 * k, distance, speed, force)


@pytest.mark.parametrize("scale", [0.1, 30.0, 2000.0])
def test_the_recurrence_is_that_of_a_loop_however_far_it_goes(scale):
    generator = np.random.default_rng(1)
    slid, added = scale * generator.random((3, 50)), generator.random((3, 50))
    now, expected = np.zeros(3), []
    for row in range(50):
        now = np.exp(-slid[:, row]) * now + added[:, row]
        expected.append(now)
    npt.assert_allclose(_followed(slid, added), np.array(expected).T, rtol=1e-12)


def test_a_curve_that_is_hardly_known_stays_positive_when_moved_by_its_uncertainty():
    size = np.array([300.0, 200.0, 40.0, 2.0])
    against = np.eye(4)
    against[0, 1] = against[1, 0] = -0.9  # where F_s is larger, F_c is smaller
    vague = replace(CURVE, covariance=against * np.outer(size, size))
    moved = list(vague.moved())
    assert len(moved) == 4
    for curve in moved:
        assert min(curve.static_N, curve.coulomb_N, curve.v_s) > 0
        assert np.isfinite(Rises(list(strokes()), curve).best_of_grid()[0]).all()


@pytest.mark.parametrize("at", [(np.log(80.0), 0.0), (np.log(110.0), 0.004), (np.log(3000.0), 0.01)])
def test_the_tangent_is_that_of_the_residual(at):
    rises, at = Rises(list(strokes()), CURVE), np.array(at)
    found = rises.tangent(at)
    expected = central_jacobian(lambda x: rises.tangent(x).residual.ravel(), at)
    npt.assert_allclose(found.jacobian.reshape(2, -1).T, expected, atol=1e-7 * np.abs(expected).max())


def ramped(begin, ramp, speed, lagging, rows=150):
    time = np.linspace(0.0, 3.0, rows)
    since = np.maximum(time - begin, 0.0)
    if lagging:
        share = 1 - np.exp(-since / ramp)
        return time, 5.0 + speed * (since - ramp * share), speed * share
    share = np.clip(since / ramp, 0.0, 1.0)
    return (
        time,
        5.0 + speed * np.where(since < ramp, 0.5 * ramp * share**2, since - 0.5 * ramp),
        speed * share,
    )


PACES = [2.0 + k for k in range(5)]
MADE = [ramped(0.3 + 0.05 * k, 0.1 * 1.5**k, 2.0 + k, k % 2 == 1, rows=120 + 30 * k) for k in range(5)]


def test_ramps_of_both_shapes_are_found():
    for (_, along, speed), ramp in zip(
        MADE, fit_ramps(*zip(*[m[:2] for m in MADE], strict=True), PACES), strict=True
    ):
        npt.assert_allclose(ramp.speed_mm_s, speed, atol=1e-6)
        npt.assert_allclose(ramp.distance_mm - ramp.distance_mm[0], along - along[0], atol=1e-6)
        assert ramp.rms_mm < 1e-7


def test_a_ramp_does_not_depend_on_which_strokes_are_fitted_with_it():
    generator = np.random.default_rng(5)
    made = [(time, along + 0.002 * generator.standard_normal(len(time))) for time, along, _ in MADE]
    together = fit_ramps(*zip(*made, strict=True), PACES)
    for (time, along), pace, ramp in zip(made, PACES, together, strict=True):
        alone = fit_ramps([time], [along], [pace])[0]
        npt.assert_array_equal(alone.speed_mm_s, ramp.speed_mm_s)
        assert alone.rms_mm == ramp.rms_mm
