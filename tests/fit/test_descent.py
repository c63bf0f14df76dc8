"""v_s of one series at a time, by its own rows and sums over the others, against all rows at every value."""

import bins_helpers
import numpy as np
import numpy.testing as npt
import pytest

from sealfit.effects import EFFECTS
from sealfit.fit import descent
from sealfit.fit.descent import search_nonlinear
from sealfit.fit.rows import make_rows
from sealfit.fit.start import start_model
from sealfit.fit.terms import Term
from sealfit.fit.whitening import Component, Scatter

SCATTER = Scatter(
    0.1, 0.0, (Component("file", "offset", 0.01), Component("run", "gain", 1e-5), Component("specimen", "gain", 1e-5))
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
def test_series_by_themselves_are_found_as_on_all_rows(monkeypatch, one_specimen, aging):
    model, rows, curved = astray(one_specimen, aging)
    found = search_nonlinear(model, rows, SCATTER)
    monkeypatch.setattr(descent, "ALONE", 0.0)
    whole = search_nonlinear(model, rows, SCATTER)
    npt.assert_allclose(found.vector(), whole.vector(), rtol=1e-6, atol=1e-9)
    assert np.abs(found.vector()[curved] - model.vector()[curved]).max() > 0.3
    npt.assert_allclose(np.exp(found.vector()[curved]), bins_helpers.TRUE["v_s"], rtol=0.4)  # a grid of twelve


def test_few_rows_are_looked_at_for_one_series(monkeypatch):
    model, rows, curved = astray(one_specimen=False, aging=True)
    seen = []
    sums = descent._sums
    monkeypatch.setattr(descent, "_sums", lambda m, r, *more: seen.append(r.force.size) or sums(m, r, *more))
    search_nonlinear(model, rows, SCATTER)
    # Three passes over all rows for each series, 13 each for all series together and for b; the rest on its own rows.
    assert sum(size == rows.sparse(descent.ROWS_FOR_START).force.size for size in seen) <= 3 * curved.size + 2 * 13


def test_series_are_searched_though_every_row_of_one_is_held_out():
    model, rows, curved = astray(one_specimen=False, aging=True)
    found = search_nonlinear(model, rows.subset(rows.values("temperature_C") != 80.0), SCATTER)
    npt.assert_allclose(np.exp(found.vector()[curved]), bins_helpers.TRUE["v_s"], rtol=0.4)
