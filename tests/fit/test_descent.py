"""The search for v_s and b after an effect has come in, and the linear fit within bounds under it."""

import bins_helpers
import numpy as np
import numpy.testing as npt
import pytest
from scipy.optimize import lsq_linear

import sealfit.fit.joint.search as joint_search
from sealfit.effects import EFFECTS
from sealfit.fit.joint import fitted_at, search
from sealfit.fit.joint.model import Term, loads_of
from sealfit.fit.joint.rows import make_rows
from sealfit.fit.joint.search import (
    ROWS_FOR_START,
    bounds_of,
    least_squares_within,
    search_nonlinear,
    solve_linear,
    start_model,
)
from sealfit.fit.joint.whitening import Component, Scatter

SCATTER = Scatter(
    0.1,
    0.0,
    (Component("file", "offset", 0.01), Component("run", "gain", 1e-5), Component("specimen", "gain", 1e-5)),
)


def astray(one_specimen: bool, aging: bool):
    """A model with an effect, whose series have lost their v_s, and the rows it was made for."""
    bins = bins_helpers.make_bins(temperatures=(40.0, 50.0, 60.0, 80.0), repeats=2, bins=4, specimen=0.003)
    if one_specimen:  # several series on one piece of rubber
        bins.loc[bins["temperature_C"] > 55.0, "specimen_id"] = "one"
    rows = make_rows(bins, has_aging=aging)
    model = start_model(rows).with_term(
        Term(EFFECTS["conditioning"], ("repeat",), "mu", "multiply"), {"A": 0.01, "n_0": 1.0}
    )
    lost = model.vector()
    curved = np.flatnonzero([p.quantity == "v_s" for p in model.declared.parameters])
    lost[curved] += np.random.default_rng(4).normal(0.0, 0.8, curved.size)
    return model.at(lost), rows, curved


@pytest.mark.parametrize("one_specimen", [False, True])
@pytest.mark.parametrize("aging", [True, False])
def test_series_that_lost_their_stribeck_speed_find_it(one_specimen, aging):
    model, rows, curved = astray(one_specimen, aging)
    found = search_nonlinear(model, rows, SCATTER)
    assert np.abs(found.vector()[curved] - model.vector()[curved]).max() > 0.3
    npt.assert_allclose(
        np.exp(found.vector()[curved]), bins_helpers.TRUE["v_s"], rtol=0.4
    )  # a grid of twelve


@pytest.mark.parametrize(("gained", "moves"), [(0.1, False), (50.0, True)])
def test_a_stribeck_speed_moves_only_for_what_its_prior_costs(gained, moves, monkeypatch):
    model, rows, curved = astray(one_specimen=False, aging=False)
    stands = model.vector()

    def solved(at, *_):
        return 100.0 - gained * float(np.abs(at.vector() - stands).max() > 1.0), at

    monkeypatch.setattr(search, "_linear_optimum", solved)
    found = search_nonlinear(model, rows, SCATTER).vector()
    assert np.array_equal(found[curved], stands[curved]) != moves


@pytest.mark.parametrize("gain", [0.0, 1e-5, 3e-4])
@pytest.mark.parametrize("noise", [0.005, 0.1])
def test_a_search_never_ends_worse_than_it_began(gain, noise):
    """With a gain for each file, a v_s far off would fit best with a negative friction."""
    model, rows, _ = astray(one_specimen=False, aging=False)
    rows = rows.sparse(ROWS_FOR_START)
    scatter = Scatter(noise, 0.0, (Component("file", "gain", gain),))
    loads = loads_of(model, rows, rows.force)
    begun = solve_linear(model, rows, scatter, loads)
    found = search_nonlinear(model, rows, scatter)
    low, high = bounds_of(found, rows)
    assert np.all((found.vector() >= low) & (found.vector() <= high))
    before, after = (fitted_at(m, rows, scatter, loads).deviance for m in (begun, found))
    assert after <= before


def test_series_are_searched_on_their_own_rows_as_on_all(monkeypatch):
    model, rows, curved = astray(one_specimen=False, aging=True)
    moving, still = joint_search._split_by_action(model, rows, [int(curved[0])])
    assert 0 < moving.force.size < rows.force.size == moving.force.size + still.force.size
    assert set(moving.table["specimen_id"]).isdisjoint(still.table["specimen_id"])
    found = search_nonlinear(model, rows, SCATTER)
    monkeypatch.setattr(joint_search, "_split_by_action", lambda model, rows, group: (rows,))
    npt.assert_allclose(search_nonlinear(model, rows, SCATTER).vector(), found.vector(), rtol=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_least_squares_within_bounds(seed):
    rng = np.random.default_rng(seed)
    columns, force = rng.normal(size=(30, 4)), rng.normal(size=30)
    low, high = -rng.uniform(0.0, 0.2, 4), rng.uniform(0.0, 0.2, 4)
    found = least_squares_within(columns.T @ columns, columns.T @ force, low, high)
    npt.assert_allclose(found, lsq_linear(columns, force, (low, high), tol=1e-14).x, atol=1e-6)


def test_least_squares_within_bounds_of_columns_that_are_alike():
    column = np.linspace(1.0, 2.0, 9)[:, None]
    both = np.hstack([column, column])
    found = least_squares_within(
        both.T @ both, both.T @ column[:, 0], np.array([-1.0, -1.0]), np.array([0.3, 2.0])
    )
    npt.assert_allclose(found.sum(), 1.0, rtol=1e-6)
    assert found[0] <= 0.3


def test_a_column_that_does_nothing_stays_where_it_is():
    columns = np.column_stack([np.linspace(1.0, 2.0, 9), np.zeros(9), np.full(9, 1e-160)])
    low, high = np.array([-0.2, -1.0, 0.0]), np.array([0.3, 1.0, np.inf])
    found = least_squares_within(columns.T @ columns, columns.T @ (2 * columns[:, 0]), low, high)
    npt.assert_allclose(found[:2], [0.3, 0.0], atol=1e-6)
    assert np.isfinite(found).all()


def test_the_bounds_of_a_column_that_does_nothing_may_be_beyond_what_numbers_resolve():
    """An amplitude of 8e29 at a shape that underflows: its bounds less its value are equal."""
    columns = np.column_stack([np.linspace(1.0, 2.0, 9), np.full(9, 1e-30)])
    low, high = np.array([-0.2, -8e29]), np.array([0.3, -8e29])
    found = least_squares_within(columns.T @ columns, columns.T @ (2 * columns[:, 0]), low, high)
    npt.assert_allclose(found, [0.3, -8e29], rtol=1e-6)


def test_series_are_searched_though_every_row_of_one_is_held_out():
    model, rows, curved = astray(one_specimen=False, aging=True)
    found = search_nonlinear(model, rows.subset(rows.values("temperature_C") != 80.0), SCATTER)
    npt.assert_allclose(np.exp(found.vector()[curved]), bins_helpers.TRUE["v_s"], rtol=0.4)
