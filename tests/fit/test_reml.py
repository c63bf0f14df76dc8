import numpy as np
import numpy.testing as npt
import pytest
from bins_helpers import LOAD_N, TRUE, make_bins
from scipy.optimize import minimize

from sealfit.fit.joint import fit_declared
from sealfit.fit.joint.rows import Groups, make_rows
from sealfit.fit.joint.tangent import Tangent
from sealfit.fit.joint.variance_components import (
    SPEEDS_OF_A_SPECIMEN,
    GroupMeans,
    RestrictedLikelihood,
    estimate_components,
    orthonormal,
    reml,
    usable_components,
)
from sealfit.fit.joint.whitening import KINDS


def loads_of(force):
    """Return the loads of an offset and a gain."""
    return np.column_stack([np.ones_like(force), force])


def nested(files_per_run, runs_per_specimen, specimens):
    files = files_per_run * runs_per_specimen * specimens
    return {
        "file": np.arange(files),
        "run": np.arange(files) // files_per_run,
        "specimen": np.arange(files) // (files_per_run * runs_per_specimen),
    }


def test_the_likelihood_is_that_of_the_dense_covariance_and_its_gradient_is_exact():
    rng = np.random.default_rng(7)
    codes = {"stroke": np.arange(72), **{name: code.repeat(2) for name, code in nested(3, 4, 3).items()}}
    force, tangent = rng.normal(40, 10, 72) * rng.choice([-1, 1], 72), orthonormal(rng.normal(size=(72, 8)))
    residual, variance = rng.normal(size=72), rng.uniform(0.1, 0.3, 72)
    kinds = [(level, kind) for level in codes for kind in ("offset", "gain")]
    kinds += [("specimen", kind) for kind in SPEEDS_OF_A_SPECIMEN]
    sizes = rng.uniform(0.5, 2.0, len(kinds)) * np.r_[np.tile([0.1, 1e-4], 4), 0.1, 0.1, 0.1]
    loads = np.column_stack([loads_of(force), rng.normal(size=(72, 3))])
    likelihood = RestrictedLikelihood(
        GroupMeans(residual, variance, loads, Groups.of(codes)), Tangent.dense(tangent), kinds
    )

    def dense(at):
        covariance = np.diag(variance)
        for (level, kind), size in zip(kinds, at, strict=True):
            load = loads[:, KINDS.index(kind)]
            covariance = covariance + size * np.outer(load, load) * (codes[level][:, None] == codes[level])
        inverse = np.linalg.inv(covariance)
        gram = tangent.T @ inverse @ tangent
        left = residual - tangent @ np.linalg.solve(gram, tangent.T @ inverse @ residual)
        return 0.5 * (np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(gram)[1] + left @ inverse @ left)

    value, gradient = likelihood(sizes)
    steps = np.diag(1e-4 * sizes)
    npt.assert_allclose(value, dense(sizes), rtol=1e-9)
    slopes = [(dense(sizes + step) - dense(sizes - step)) / (2 * step.sum()) for step in steps]
    npt.assert_allclose(gradient, slopes, rtol=1e-5)


@pytest.mark.parametrize("unit", [1e-7, 1e7])
def test_the_likelihood_does_not_depend_on_the_unit_of_force(unit):
    rng = np.random.default_rng(8)
    groups = Groups.of({"file": np.arange(24), "run": np.arange(24) // 3})
    force, residual = rng.normal(40, 10, 24), rng.normal(size=24)
    tangent, kinds = (
        Tangent.dense(orthonormal(rng.normal(size=(24, 5)))),
        [("file", "gain"), ("run", "offset")],
    )
    found = []
    for scale in (1.0, unit):
        means = GroupMeans(scale * residual, np.full(24, (0.4 * scale) ** 2), loads_of(scale * force), groups)
        sizes = np.array([1e-4, 0.1 * scale**2])
        value, gradient = RestrictedLikelihood(means, tangent, kinds)(sizes)
        found.append([value - (24 - 5) * np.log(scale), *(gradient * sizes)])
    npt.assert_allclose(found[1], found[0], rtol=1e-8)


def test_reml_recovers_scatter_of_files_runs_and_specimens():
    codes = nested(3, 8, 25)
    rng = np.random.default_rng(3)
    found = []
    for _ in range(12):
        force = rng.uniform(20, 50, 200)[codes["run"]]
        residual = (
            rng.normal(0, 0.05, force.size)
            + force * rng.normal(0, 0.01, force.size)
            + rng.normal(0, 0.2, 200)[codes["run"]]
            + force * rng.normal(0, 0.02, 25)[codes["specimen"]]
        )
        tangent = np.column_stack([np.ones(force.size), force])
        kinds = [("file", "gain"), ("run", "offset"), ("specimen", "gain")]
        _, parts = reml(
            GroupMeans(residual, np.full(force.size, 0.05**2), loads_of(force), Groups.of(codes)),
            Tangent.dense(tangent),
            kinds,
        )
        found.append([np.sqrt(p.variance) for p in parts])
    npt.assert_allclose(np.mean(found, axis=0), [0.01, 0.2, 0.02], rtol=0.15)


def forces_over_two_decades(seed):
    """Return the arguments of `reml` and the true variances, which differ by orders of magnitude."""
    codes = nested(2, 6, 5)
    kinds = [("file", "offset"), ("file", "gain"), ("run", "offset"), ("run", "gain"), ("specimen", "gain")]
    rng = np.random.default_rng(seed)
    force = np.tile(np.geomspace(0.5, 50, 6), 5)[codes["run"]]
    sd = 10 ** rng.uniform(-3.5, -1, 5) * [10, 1, 10, 1, 1]
    residual = rng.normal(0, 0.02, 60)
    for size, (level, kind) in zip(sd, kinds, strict=True):
        drawn = rng.normal(0, size, codes[level].max() + 1)[codes[level]]
        residual += drawn * (force if kind == "gain" else 1.0)
    means = GroupMeans(residual, np.full(60, 0.02**2), loads_of(force), Groups.of(codes))
    return (means, Tangent.dense(np.column_stack([np.ones(60), force])), kinds), sd**2


def test_no_component_stays_at_zero_that_is_none():
    """A descent from large components makes small ones zero."""
    for seed in range(40):
        given, truth = forces_over_two_decades(seed)
        assert reml(*given)[0] == pytest.approx(reml(*given, truth)[0], abs=0.01)


def test_the_descent_does_not_end_before_the_minimum():
    (means, tangent, kinds), _ = forces_over_two_decades(75)
    value, parts = reml(means, tangent, kinds)
    likelihood = RestrictedLikelihood(means, tangent.orthonormal(1e-9), kinds)
    at = np.log([max(part.variance, 1e-9) for part in parts])
    best = minimize(lambda u: likelihood(np.exp(u))[0], at, method="Nelder-Mead", options={"maxiter": 2000})
    assert value < best.fun + 0.01


def test_reml_counts_the_degrees_of_freedom_that_the_model_took():
    # 40 groups of one, 20 of whose means the model owns: the plain mean square would be half the variance.
    rng = np.random.default_rng(5)
    codes = {"file": np.arange(40)}
    found = []
    for _ in range(200):
        tangent = rng.normal(0, 1, (40, 20))
        error = rng.normal(0, 1.0, 40)
        residual = error - tangent @ np.linalg.lstsq(tangent, error, rcond=None)[0]
        _, (part,) = reml(
            GroupMeans(residual, np.full(40, 1e-6), loads_of(np.ones(40)), Groups.of(codes)),
            Tangent.dense(tangent),
            [("file", "offset")],
        )
        found.append(part.variance)
    assert np.mean(found) == pytest.approx(1.0, abs=0.08)  # SE of the mean: sqrt(2/20/200) = 0.022


def test_rounding_moves_no_variance_and_scatter_that_is_not_there_is_nothing():
    codes = nested(3, 8, 25)
    rng = np.random.default_rng(11)
    force = rng.uniform(20, 50, 200)[codes["run"]]
    tangent = Tangent.dense(np.column_stack([np.ones(force.size), force]))
    kinds = [("file", "offset"), ("file", "gain"), ("run", "offset"), ("run", "gain"), ("specimen", "gain")]
    moved, none = [], 0
    for _ in range(40):
        residual = rng.normal(0, 0.05, force.size) + rng.normal(0, 0.2, 200)[codes["run"]]
        near = residual * (1 + 1e-12 * rng.normal(size=residual.size))
        one, other = (
            np.array(
                [
                    p.variance
                    for p in reml(
                        GroupMeans(r, np.full(600, 0.05**2), loads_of(force), Groups.of(codes)),
                        tangent,
                        kinds,
                    )[1]
                ]
            )
            for r in (residual, near)
        )
        npt.assert_array_equal(one > 0, other > 0)
        moved.append(np.abs(one - other).max() / one.max())
        none += one[4] == 0
    assert max(moved) < 1e-5
    assert none >= 16  # a variance whose best value is at or below zero: half of all, and more beside others


def test_next_to_no_noise_beside_the_scatter_of_files_with_one_stroke_is_no_error():
    """One unit of two levels: what the upper one leaves is a difference of numbers 1e8 times as large."""
    codes = {"stroke": np.arange(96), **nested(3, 1, 32)}
    rng = np.random.default_rng(0)
    force, tangent = rng.uniform(4, 8, 96), orthonormal(rng.normal(size=(96, 22)))
    kinds = [("file", "offset"), ("file", "gain"), ("specimen", "gain")]
    for _ in range(20):
        residual = force * rng.normal(0, 0.05, 96)
        _, parts = reml(
            GroupMeans(residual, np.full(96, 2e-8), loads_of(force), Groups.of(codes)),
            Tangent.dense(tangent),
            kinds,
        )
        assert all(np.isfinite(part.variance) for part in parts)


def test_a_ripple_explains_no_difference_between_files():
    """Its length and phase are determined within strokes, although the means of strokes change a little."""
    bins = make_bins(0, temperatures=(), days=(), speeds=(0.1, 1.0, 10.0, 100.0), repeats=2, gain=0.02)
    fitted = fit_declared(make_rows(bins, has_aging=False))
    start = np.random.default_rng(0).uniform(0.0, 2.3, bins["file"].nunique())[bins["file"].factorize()[0]]
    turn = 2 * np.pi * (bins["displacement_mm"].to_numpy() + start) / 2.3
    waves = fitted.jacobian.append(np.sin(turn)).append(np.cos(turn)).append(turn * np.cos(turn))
    with_waves, without = (
        estimate_components(fitted.rows, fitted.residual, fitted.loads, tangent, fitted.scatter)
        for tangent in (waves, fitted.jacobian)
    )
    npt.assert_allclose(*([c.variance for c in s.components] for s in (with_waves, without)))
    assert sum(c.variance for c in without.components) > 0


def test_runs_that_the_model_goes_through_show_no_scatter():
    for speeds, shown in (((2.0, 6.0, 18.0, 50.0), False), ((2.0, 6.0, 12.0, 18.0, 50.0), True)):
        rows = make_rows(make_bins(speeds=speeds, days=(), repeats=3, bins=4), has_aging=True)
        assert ("run" in {level for level, _ in usable_components(rows)}) == shown


def test_components_that_differ_by_orders_of_magnitude_are_all_found():
    rng = np.random.default_rng(4)
    codes = {"stroke": np.arange(336), "file": np.arange(336) // 4, "run": np.arange(336) // 12}
    force = rng.uniform(50, 150, 336) * np.tile([1, -1], 168)
    file, run = rng.normal(0, 0.01, 84), rng.normal(0, 0.02, 28)
    residual = force * (file[codes["file"]] + run[codes["run"]]) + rng.normal(0, 0.02, 336)
    kinds = [(level, kind) for level in codes for kind in ("offset", "gain")]
    means = GroupMeans(residual, np.full(336, 0.02**2), loads_of(force), Groups.of(codes))
    _, found = reml(means, Tangent.dense(force[:, None] / np.linalg.norm(force)), kinds)
    size = {(c.level, c.kind): np.sqrt(c.variance) for c in found}
    assert 0.008 < size["file", "gain"] < 0.012
    assert 0.014 < size["run", "gain"] < 0.026
    assert size["stroke", "gain"] < 1e-4


def test_specimens_that_differ_in_static_friction_alone_have_that_component():
    rng, own = np.random.default_rng(3), {}

    def another_mu_s(table, force):
        change = own.setdefault(table["specimen_id"].iloc[0], rng.normal(0.0, 0.03))
        return force + LOAD_N * change * np.exp(-((table["speed_mm_s"].to_numpy() / TRUE["v_s"]) ** 2))

    bins = make_bins(5, bins=4, repeats=2, gain=0.002, noise_N=0.02, setup=0.002, effect=another_mu_s)
    found = fit_declared(make_rows(bins, has_aging=True)).scatter.components
    size = {part.kind: np.sqrt(part.variance) for part in found if part.level == "specimen"}
    assert 0.4 * np.std(list(own.values())) < size["mu_s"] < 1.5 * np.std(list(own.values()))
    assert size["gain"] < 0.5 * size["mu_s"]
