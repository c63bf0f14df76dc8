import itertools
from dataclasses import replace

import numpy as np
import numpy.testing as npt
import pytest
from bins_helpers import MANY_SPEEDS, THREE_FOLDS, TRUE, make_bins, make_traces

from sealfit.closure.confirm import Context
from sealfit.closure.loop import close_loop
from sealfit.closure.ripple_selection import numbered, steady_samples
from sealfit.closure.selection import select_effects
from sealfit.closure.subsampling import (
    FURTHER,
    MOST_ROWS,
    PER_STROKE,
    ROWS,
    merged_bins,
    reselect_on_all,
    subsamples,
)
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.fit.joint import fit, fit_declared
from sealfit.fit.joint.declared import declare
from sealfit.fit.joint.model import evaluate
from sealfit.fit.joint.rows import make_rows


@pytest.mark.parametrize(("bins", "repeats"), [(20, 1), (60, 3), (200, 6)])
def test_the_search_works_on_few_rows_but_not_on_too_few_of_a_stroke(bins, repeats):
    table = numbered(make_bins(1, bins=bins, repeats=repeats))
    left, strokes = merged_bins(table, 1), table["stroke_id"].nunique()
    rest = strokes  # what is over in each stroke when whole numbers of bins are merged makes a row of its own
    assert len(left) <= max(ROWS, min(PER_STROKE * strokes, MOST_ROWS)) + rest
    assert len(left) == len(table) or len(left) > 0.4 * min(ROWS, PER_STROKE * strokes)
    together = np.ceil(
        len(table) / np.clip(PER_STROKE * strokes, ROWS, MOST_ROWS)
    )  # bins merged into one row
    assert len(left) == np.ceil(table.groupby("stroke_id").size() / together).sum()
    assert left["n"].sum() == table["n"].sum()
    whole, merged = (np.average(rows["force_N"], weights=rows["n"]) for rows in (table, left))
    assert merged == pytest.approx(whole, rel=1e-12)


def test_of_very_many_strokes_a_few_files_all_over_the_campaign_keep_several_bins(monkeypatch):
    monkeypatch.setattr("sealfit.closure.subsampling.MOST_ROWS", 160)
    table = numbered(make_bins(1, bins=20, repeats=3))
    left = merged_bins(table, 1)
    rows = left.groupby(["file", "stroke"]).size()
    several = rows.index[rows > 1].get_level_values("file")
    assert set(rows) == {1, 7}  # 20 bins, three of them in a row
    assert len(several) == pytest.approx(160 / PER_STROKE, abs=1)
    kept = table[table["file"].isin(several)]
    assert set(kept["condition"]) == set(table["condition"])
    assert kept["repeat"].nunique() == 3
    assert left["n"].sum() == table["n"].sum()
    for seed in (1, 2):
        assert merged_bins(table, seed).equals(left) == (seed == 1)


@pytest.fixture
def few(monkeypatch):
    """A search that begins with 40 strokes, whatever the model."""
    monkeypatch.setattr("sealfit.closure.subsampling.STROKES", 40)
    monkeypatch.setattr("sealfit.closure.subsampling.RUNS", 1)
    monkeypatch.setattr("sealfit.closure.subsampling.LEAST_RUNS", 1)


def test_more_and_more_whole_runs_all_over_the_campaign_are_searched_and_in_the_end_all(few):
    rows = make_rows(numbered(make_bins(1, bins=4)), has_aging=True)
    parts = list(subsamples(rows, 1))
    sizes = [part.rows.groups.starts["stroke"].size for part in parts]
    assert sizes == pytest.approx([40, 40 * FURTHER, 216], abs=5)
    assert [part.whole for part in parts] == [False] * (len(parts) - 1) + [True]
    assert parts[-1].rows is rows
    for part, larger in itertools.pairwise(parts):
        assert part.rows.force.size < larger.rows.force.size
        for run in set(part.rows.table["run_id"]):  # with all their repeats
            assert (part.rows.table["run_id"] == run).sum() == (rows.table["run_id"] == run).sum()
        assert set(part.rows.condition) == set(rows.condition)
    drawn = [set(next(subsamples(rows, seed)).rows.table["run_id"]) for seed in (1, 1, 2)]
    assert drawn[0] == drawn[1] != drawn[2]


def test_a_part_has_the_campaigns_model_and_some_run_of_each_condition(few, monkeypatch):
    monkeypatch.setattr("sealfit.closure.subsampling.STROKES", 12)
    monkeypatch.setattr("sealfit.closure.subsampling.MOST_ROWS", 40)
    rows = make_rows(numbered(make_bins(1, bins=20, noise_N=0.0, gain=0.0)), has_aging=True)
    part = next(subsamples(rows, 1))
    assert part.coarse.force.size < part.rows.force.size
    assert set(part.coarse.condition) == set(rows.condition)
    assert part.rows.groups.starts["run"].size == len(rows.conditions)
    assert declare(part.coarse) is declare(rows)  # though no series has four speeds there
    model = fit_declared(rows).model
    npt.assert_allclose(evaluate(model, part.coarse, jacobian=False)[0], part.coarse.force, rtol=1e-4)


def test_few_runs_of_very_many_strokes_are_all_searched(few, monkeypatch):
    rows = make_rows(numbered(make_bins(1, bins=4)), has_aging=True)
    monkeypatch.setattr("sealfit.closure.subsampling.RUNS", rows.groups.starts["run"].size)
    (part,) = subsamples(rows, 1)
    assert part.whole


@pytest.mark.parametrize(
    ("acts_on", "other", "seed"), [pytest.param("mu", "force", 2, marks=pytest.mark.long), ("force", "mu", 6)]
)
def test_an_effect_acts_on_what_all_strokes_say(acts_on, other, seed, monkeypatch):
    """Of the whole force sigma_2 |v| is a part, which a factor on mu leaves as it is."""
    monkeypatch.setattr("sealfit.closure.subsampling.STROKES", 60)
    monkeypatch.setattr("sealfit.closure.subsampling.RUNS", 1)

    def stiffer(table, force):
        viscous = TRUE["sigma_2"] * table["speed_mm_s"] if acts_on == "mu" else 0.0
        return force + 0.1 * -np.expm1(-table["distance_mm"] / 10.0) * (force - viscous)

    bins = numbered(
        make_bins(seed, effect=stiffer, temperatures=(60.0,), speeds=MANY_SPEEDS, bins=4, noise_N=0.1)
    )
    part = next(subsamples(make_rows(bins, has_aging=True), 1))
    samples = steady_samples(make_traces(bins), part.rows)
    selection = select_effects(part.coarse, samples, Context(Config(), EFFECTS))
    (found,) = selection.added

    def on(quantity):
        term = replace(found.proposal.term, acts_on=quantity)
        model = selection.before.model.with_term(term, found.proposal.fitted.model.values[-1])
        return replace(
            found.proposal, term=term, fitted=fit(model, part.coarse, selection.after.scatter, turns=0)
        )

    for first, second in ((other, acts_on), (acts_on, other)):
        chosen, rival = on(first), on(second)
        item = replace(found, proposal=chosen, rivals=((rival, 0.1),))
        off_target = replace(selection, after=chosen.fitted, added=(item,))
        told, whole = reselect_on_all(off_target, part.every, samples, Config(), lambda text: None)
        (effect,) = told.added
        terms = (effect.proposal.term, *told.after.model.terms, *whole.model.terms)
        assert [term.acts_on for term in terms] == [acts_on] * 3
        assert told.after.rows is part.coarse
        assert whole.rows is part.every
        assert np.isfinite(effect.gain_N)
        assert not effect.rivals


@pytest.mark.long
def test_what_only_all_strokes_show_has_all_of_them_searched(monkeypatch):
    monkeypatch.setattr("sealfit.closure.subsampling.STROKES", 60)
    monkeypatch.setattr("sealfit.closure.subsampling.RUNS", 1)
    rng = np.random.default_rng(5)
    bins = make_bins(3, setup=0.003, temperatures=(60.0,), speeds=MANY_SPEEDS, bins=2, noise_N=0.1)
    humidity = bins["run_id"].map({run: rng.normal() for run in bins["run_id"].unique()})
    bins["humidity_pct"] = 50 + 5 * humidity
    bins["force_N"] *= 1 + 0.004 * humidity
    said = []
    closed = close_loop(bins, make_traces(bins), THREE_FOLDS, on_progress=said.append)
    assert f"all {bins['file'].nunique()} strokes show more than those searched: humidity_pct" in said
    (effect,) = closed.document["effects"]
    assert effect["channels"] == ["humidity_pct"]
