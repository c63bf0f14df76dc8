"""Free shapes held smooth: how smooth, how many numbers they are worth, what the joint fit makes of them."""

from dataclasses import replace

import bins_helpers
import numpy as np
import numpy.testing as npt
import pytest

from sealfit.closure.channels import Channel
from sealfit.closure.forms import free_term
from sealfit.effects.free import natural, roughness, surface_roughness
from sealfit.fit.joint import effective_df, fit, fit_declared
from sealfit.fit.joint.model import shape_of
from sealfit.fit.joint.prior import penalised, reml_smoothness
from sealfit.fit.joint.rows import make_rows

KNOTS = tuple(np.linspace(0.0, 1.0, 20))


def normal_equations(truth, noise, seed, n=300):
    rng = np.random.default_rng(seed)
    x = rng.uniform(0, 1, n)
    columns = natural(KNOTS, x)[:, 1:] / noise
    y = (truth(x) - truth(0.0) + rng.normal(0, noise, n)) / noise
    return columns.T @ columns, columns.T @ y


def test_a_straight_line_is_worth_one_number():
    sizes = []
    for seed in range(20):
        normal, gradient = normal_equations(lambda x: 2.0 * np.asarray(x), 0.3, seed)
        rough = roughness(KNOTS)
        amplitude, size = penalised(normal, gradient, reml_smoothness(normal, gradient, rough) * rough)
        sizes.append(size)
        npt.assert_allclose(amplitude, 2.0 * np.array(KNOTS[1:]), atol=0.6)
    assert np.median(sizes) < 1.5


@pytest.mark.parametrize("waves", [1, 3])
def test_the_smoothness_of_greatest_likelihood_is_near_the_one_of_least_error(waves):
    def truth(x):
        return np.sin(2 * np.pi * waves * np.asarray(x))

    rough, wanted = roughness(KNOTS), truth(np.array(KNOTS[1:]))
    ratios = []
    for seed in range(20):
        normal, gradient = normal_equations(truth, 0.3, seed)
        chosen = reml_smoothness(normal, gradient, rough)
        tried = [*(chosen * 10.0 ** np.linspace(-4, 4, 33)), chosen]
        error = [np.sqrt(np.mean((penalised(normal, gradient, t * rough)[0] - wanted) ** 2)) for t in tried]
        ratios.append(error[-1] / min(error))
    assert np.median(ratios) < 1.15


def test_the_joint_fit_holds_a_free_shape_as_smooth_as_the_data_want_it():
    def humps(oil):
        return 0.1 * (np.exp(-(((oil - 40) / 4) ** 2)) + np.exp(-(((oil - 60) / 4) ** 2)))

    bins = bins_helpers.make_bins(
        3,
        setup=0.003,
        bins=4,
        run_channels={"oil_ppm": lambda rng: rng.uniform(25, 75)},
        effect=lambda table, force: force * (1 + humps(table["oil_ppm"].to_numpy())),
    )
    rows = make_rows(bins, has_aging=True)
    before = fit_declared(rows)
    errors, sizes = {}, {}
    for held in (True, False):
        term = free_term(Channel("oil_ppm", rows.values("oil_ppm"), "run"), "mu", "multiply", knots=24)
        term = term if held else replace(term, smoothness=None)
        start = dict.fromkeys(term.effect.linear, 0.0)
        fitted = fit(before.model.with_term(term, start), rows, before.scatter)
        found = shape_of(fitted.model.terms[0], fitted.model.values[0], rows)
        wanted = humps(rows.values("oil_ppm"))
        off = (found - found.mean()) - (wanted - wanted.mean())
        errors[held] = np.sqrt(np.mean(off**2))
        sizes[held] = effective_df(fitted, 0)
    assert errors[True] < 0.006
    assert errors[True] < errors[False]
    assert 6 < sizes[True] < 20
    assert sizes[False] == pytest.approx(22, abs=0.01)  # of 24 knots one is in a gap


def test_smoothness_of_a_surface_whose_plane_the_model_contains():
    rough = surface_roughness((0.0, 1.0, 3.0), (0.0, 2.0, 3.0))
    columns = np.random.default_rng(0).normal(size=(40, 8))
    plane = np.linalg.svd(rough)[0][:, -2:]
    normal = 1e-9 * (columns - columns @ plane @ plane.T).T @ (columns - columns @ plane @ plane.T)
    found = reml_smoothness(normal, np.zeros(8), rough)
    amplitude, size = penalised(normal, np.zeros(8), found * rough)
    assert np.isfinite(found)
    npt.assert_array_equal(amplitude, 0.0)
    assert 0 <= size <= 6
