from dataclasses import replace

import numpy as np
import pytest
from bins_helpers import TWO_FOLDS, make_bins, make_traces

from sealfit.closure.criteria import FEW_UNITS
from sealfit.closure.errors_and_intervals import (
    Sandwich,
    covariance_with_specimens,
    degrees_of_freedom,
    effect_intervals,
    mean_half_width,
    normalised_waves,
    sandwiches,
    t_quantile,
)
from sealfit.closure.loop import close_loop
from sealfit.closure.predict import predict
from sealfit.effects import EFFECTS
from sealfit.fit.joint import fit, fit_declared, fitted_at
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import make_rows
from sealfit.fit.joint.tangent import Tangent
from sealfit.fit.joint.whitening import Component


def width(model: dict, points) -> np.ndarray:
    answer = predict(model, points)
    return (answer["force_after_hi95_N"] - answer["force_after_lo95_N"]).to_numpy()


def test_the_interval_of_the_mean_is_the_widest_of_several():
    bins = make_bins(2, bins=6, setup=0.005)
    model = close_loop(bins, make_traces(bins), TWO_FOLDS).model
    points = bins.groupby("condition").head(1)
    narrow = width({**model, "sandwiches": []}, points)
    assert np.all(width(model, points) >= narrow * (1 - 1e-12))
    wide = [{"covariance": (4 * np.array(model["covariance"])).tolist(), "information": []}]
    np.testing.assert_allclose(width({**model, "sandwiches": wide}, points), 2 * narrow, rtol=1e-9)


def test_a_few_groups_have_degrees_of_freedom_of_their_own():
    tangent = Tangent.dense(np.array([[1.0], [2.0]]))
    groups = [(np.array([0]), np.array([[1.0]]))] * 4  # four groups that count the same: 3 degrees of freedom
    few = Sandwich(np.array([[1.0]]), groups)
    half = mean_half_width(tangent, np.array([[0.81]]), 1e6, [few])
    np.testing.assert_allclose(half, t_quantile(3) * np.array([1.0, 2.0]))


def test_a_sandwich_widens_an_interval_by_a_factor_of_three_at_most():
    tangent, groups = Tangent.dense(np.array([[1.0]])), [(np.array([0]), np.array([[1.0]]))] * 4
    half = mean_half_width(tangent, np.array([[0.01]]), 1e6, [Sandwich(np.array([[4.0]]), groups)])
    np.testing.assert_allclose(half, 3 * t_quantile(1e6) * 0.1)


def test_a_point_that_two_groups_determine_has_no_interval_of_one_degree_of_freedom():
    tangent, groups = Tangent.dense(np.array([[1.0]])), [(np.array([0]), np.array([[1.0]]))] * 2
    half = mean_half_width(tangent, np.array([[1.0]]), 4, [Sandwich(np.array([[1.0]]), groups)])
    np.testing.assert_allclose(half, t_quantile(2))  # and not t_quantile(1), three times as much


def test_a_group_that_decides_alone_says_nothing_of_its_scatter():
    tangent = Tangent.dense(np.array([[1.0]]))
    groups = [(np.array([0]), np.array([[99.0]])), (np.array([0]), np.array([[1.0]]))]
    half = mean_half_width(tangent, np.array([[0.01]]), 1e6, [Sandwich(np.array([[4.0]]), groups)])
    np.testing.assert_allclose(half, t_quantile(1e6) * 0.1)


def test_what_rounding_leaves_of_groups_that_tell_nothing_is_no_information():
    groups = [(np.array([0]), np.array([[share]])) for share in (1e-100, -1e-100)]
    with np.errstate(all="raise", under="ignore"):
        half = mean_half_width(
            Tangent.dense(np.array([[1.0]])), np.array([[1.0]]), 1e6, [Sandwich(np.array([[4.0]]), groups)]
        )
    np.testing.assert_allclose(half, t_quantile(1e6))  # the first decides alone


def test_a_point_without_information_from_groups_has_no_interval_from_them():
    groups = [(np.array([0]), np.array([[1.0]]))] * 4
    tangent = Tangent.dense(np.array([[0.0], [1.0]]))
    with np.errstate(all="raise", under="ignore"):
        half = mean_half_width(tangent, np.array([[0.81]]), 1e6, [Sandwich(np.array([[1.0]]), groups)])
    np.testing.assert_allclose(half, [0.0, t_quantile(3)])


def test_files_runs_and_specimens_are_asked_down_to_the_first_of_which_there_are_many():
    rows = make_rows(make_bins(bins=4), has_aging=True)
    counts = [rows.groups.starts[level].size for level in ("specimen", "run", "file")]
    assert counts[0] == 9
    assert counts[1] >= FEW_UNITS
    found = sandwiches(fit_declared(rows))
    assert [len(own.information) for own in found] == [9, 0]


@pytest.mark.parametrize(("run_sd", "least", "most"), [(0.0, 25.0, 31.0), (0.05, 4.0, 4.5)])
def test_a_level_that_scatters_little_does_not_decide_the_degrees_of_freedom(run_sd, least, most):
    """Eight runs of four files: with the scatter of runs alone there are four degrees of freedom."""
    bins = make_bins(4, days=(), temperatures=(), repeats=4, bins=4, gain=0.01)
    fitted = fit_declared(make_rows(bins, has_aging=False))
    parts = [Component("file", "gain", 1e-4), Component("run", "gain", max(run_sd, 1e-3) ** 2)]
    known = fitted_at(fitted.model, fitted.rows, replace(fitted.scatter, components=tuple(parts)))
    assert least <= degrees_of_freedom(known) <= most


def test_a_sigma_2_at_its_limit_leaves_no_scatter_of_runs_to_be_seen():
    def falls(table, force):
        return force - 0.05 * table["speed_mm_s"].to_numpy()

    few = {"days": (), "temperatures": (), "speeds": (1.0, 8.0, 32.0, 100.0), "bins": 4}
    fitted = fit_declared(make_rows(make_bins(1, effect=falls, **few), has_aging=False))
    assert fitted.model.theta[-1] == 0.0
    assert not fitted.scatter.estimates("run")
    assert degrees_of_freedom(fitted) == 0.0


def test_the_scatter_of_specimens_is_in_the_covariance_of_laws_though_no_component_has_it():
    fitted = fit_declared(make_rows(make_bins(2, bins=4, repeats=2, specimen=0.03), has_aging=True))
    within = tuple(part for part in fitted.scatter.components if part.level != "specimen")
    alone = fitted_at(fitted.model, fitted.rows, replace(fitted.scatter, components=within))
    number = [parameter.quantity for parameter in fitted.model.declared.parameters].index("a_s")
    known, missing = (np.sqrt(own.covariance[number, number]) for own in (fitted, alone))
    found = np.sqrt(covariance_with_specimens(alone)[number, number])
    assert missing < 0.4 * known
    assert 2 * missing < found <= 3.001 * missing


def test_an_effect_within_strokes_takes_no_degree_of_freedom_of_the_runs():
    design = {"days": (), "temperatures": (), "repeats": 1, "setup": 0.01}
    rows = make_rows(make_bins(bins=6, **design), has_aging=False)
    declared = fit_declared(rows)
    fixed = {"x_ref": float(rows.values("distance_mm").mean())}
    term = Term(EFFECTS["linear"], ("distance_mm",), "mu", "multiply", fixed=fixed)
    model = declared.model.with_term(term, {p.name: 0.01 for p in term.effect.parameters})
    with_effect = fit(model, rows, declared.scatter, turns=1)
    assert (
        degrees_of_freedom(declared) == degrees_of_freedom(with_effect) == rows.groups.starts["run"].size - 4
    )


@pytest.mark.parametrize(
    ("effect", "inputs", "values"),
    [
        (
            "sinusoid_changing",
            {"x": np.linspace(0, 8, 7), "z": np.linspace(10, 20, 7), "z_ref": 10.0},
            {"A": -2.0, "B": -0.5, "lambda_": 4.0, "phi": 3.0},
        ),
        ("day_and_night", {"elapsed_h": np.linspace(0, 60, 7)}, {"A": -0.02, "t_max": 20.0}),
        (
            "sinusoid_harmonics",
            {"x": np.linspace(0, 8, 7)},
            {"A": -2.0, "B": 0.5, "lambda_": 4.0, "phi": 0.3, "phi_2": 9.0},
        ),
    ],
)
def test_a_wave_of_positive_amplitude_is_the_same_wave(effect, inputs, values):
    intervals = {name: (value, value - 0.1, value + 0.2) for name, value in values.items()}
    made = normalised_waves(intervals)
    shape = EFFECTS[effect].shape
    before, after = shape(inputs, **values), shape(inputs, **{name: made[name][0] for name in made})
    np.testing.assert_allclose(after, before, atol=1e-12)
    assert made["A"][0] > 0
    assert all(low < value < high for value, low, high in made.values())


def test_the_interval_of_a_time_that_rests_do_not_determine_ends_at_its_bounds():
    def stronger(table, force):
        return force * (1 + 0.01 * np.log1p(table["rest_s"].to_numpy() / 0.01))

    rests = {"rest_s": lambda rng: float(rng.choice([1.0, 10.0, 100.0]))}
    rows = make_rows(make_bins(2, days=(), bins=4, run_channels=rests, effect=stronger), has_aging=True)
    effect = EFFECTS["rest_strengthening"]
    before = fit_declared(rows)
    term = Term(effect, ("rest_s",), "mu", "multiply")
    fitted = fit(before.model.with_term(term, {"A": 0.01, "t_0": 0.1}), rows)
    value, low, high = effect_intervals(fitted, 0, "run")["t_0"]
    assert effect.parameters[1].bounds[0] <= low < value < high
