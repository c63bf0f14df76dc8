from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from bins_helpers import SPEEDS, TWO_FOLDS, make_bins, make_traces

from sealfit.closure.channels import channels_of
from sealfit.closure.criteria import WEAK_P
from sealfit.closure.errors_and_intervals import scatter_list
from sealfit.closure.loop import close_loop
from sealfit.closure.score_test import ScoreTests
from sealfit.closure.search import search
from sealfit.closure.selection import Selection
from sealfit.closure.sensitivity import _by_numbers, sensitivity, undetectable_variables
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.fit.joint import fit, fit_declared
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import make_rows

SMALL = {"temperatures": (60.0,), "days": (1.0, 4.0), "bins": 6, "noise_N": 0.1, "setup": 0.003}
OIL = {"oil_ppm": lambda rng: rng.normal(100.0, 10.0)}


def searched(bins):
    """The end of a loop that finds nothing: one search."""
    fitted = fit_declared(make_rows(bins, has_aging=True))
    channels = {c.name: c for c in channels_of(fitted.rows, Config())}
    found = tuple(search(ScoreTests(fitted), list(channels.values()), np.random.default_rng(0)))
    return Selection(fitted, fitted, (), found, found, None, None, channels)


def entries(selection):
    return {(e["variable"], e["level"]): e for e in sensitivity(selection, 0.005)}


def p_with(bins, size_pct):
    """The p-value of oil in a campaign where it acts on mu, straight."""
    shape = bins["oil_ppm"] - bins["oil_ppm"].mean()
    shape = shape * bins["force_N"]
    rms = np.sqrt(np.mean(bins["force_N"] ** 2))
    made = bins.assign(force_N=bins["force_N"] + size_pct / 100 * rms * shape / np.sqrt(np.mean(shape**2)))
    return min(c.p_value for c in searched(made).last if c.channels[-1] == "oil_ppm")


@pytest.mark.long
@pytest.mark.parametrize("repeats", [1, 2], ids=["twenty-four runs", "with repeats"])
def test_the_evidence_is_weak_for_half_the_stated_effect_and_strong_for_twice_as_much(repeats):
    bins = make_bins(4, repeats=repeats, run_channels=OIL, **SMALL)
    smallest = entries(searched(bins))["oil_ppm", "run"]["smallest_pct"]
    fresh = make_bins(4, repeats=repeats, run_channels=OIL, **{**SMALL, "noise_N": 0.1001})
    assert p_with(fresh, smallest / 2) > WEAK_P
    assert p_with(fresh, 2 * smallest) < WEAK_P


def test_a_variable_that_can_show_nothing_beside_its_effect_has_no_entry():
    bins = make_bins(4, directions=(1, -1), repeats=1, **SMALL)
    bins["force_N"] += 2.0
    selection = searched(bins)
    assert entries(selection)["direction", "run"]["smallest_N"] > 0
    term = Term(EFFECTS["zero_offset"], ("direction",), "force", "add")
    after = fit(selection.after.model.with_term(term, {"A": 2.0}), selection.after.rows)
    last = tuple(search(ScoreTests(after), list(selection.channels.values()), np.random.default_rng(0)))
    added = (SimpleNamespace(proposal=SimpleNamespace(term=term)),)
    closed = replace(selection, after=after, last=last, added=added)
    assert ("direction", "run") not in entries(closed)


def test_a_variable_has_an_entry_for_each_level_at_which_it_varies():
    bins = make_bins(4, repeats=2, run_channels={"chamber_C": lambda rng: rng.normal(22.0, 1.0)}, **SMALL)
    bins["chamber_C"] += np.random.default_rng(0).normal(0.0, 1.0, len(bins))
    found = entries(searched(bins))
    assert ("chamber_C", "trace") in found
    assert ("chamber_C", "run") in found
    assert [level for name, level in found if name == "displacement_mm"] == ["trace"]
    assert ("time_s", "run") in found  # a slow stroke takes long


def test_four_files_cannot_tell_and_say_how_many_would_do():
    bins = make_bins(1, temperatures=(), speeds=(1.0, 4.0, 16.0, 64.0), repeats=1, bins=6)
    selection = searched(bins)
    found = sensitivity(selection, 0.005)
    undetectable = undetectable_variables(selection, found, [])
    assert "displacement_mm" in undetectable
    assert all(e["files_needed"] == 5 for e in found if e["variable"] in undetectable)


def test_what_differs_between_two_specimens_cannot_be_told():
    bins = make_bins(1, temperatures=(60.0,), days=(4.0,), repeats=2, bins=6)
    selection = searched(bins)
    assert "aging_days" in undetectable_variables(selection, sensitivity(selection, 0.005), [])


def test_two_specimens_of_one_condition_that_differ_cannot_be_told():
    bins = make_bins(1, temperatures=(), repeats=3, bins=6)
    second = bins.assign(specimen_id="second", run_id=bins["run_id"] + "|2", file="2" + bins["file"])
    second["force_N"] *= 1.05
    both = pd.concat([bins, second], ignore_index=True)
    document = close_loop(both, make_traces(both), TWO_FOLDS).document
    assert document["verdict"] == "cannot_tell"
    (undetectable,) = [e for e in document["sensitivity"] if e["variable"] == "specimen_id"]
    assert (undetectable["cannot_tell"], undetectable["files_needed"]) == (True, 120)


def test_a_campaign_of_nine_specimens_can_tell():
    selection = searched(make_bins(3, repeats=2, bins=6, run_channels=OIL))
    assert undetectable_variables(selection, sensitivity(selection, 0.005), []) == {}


@pytest.mark.parametrize(("specimen", "hidden"), [(0.005, False), (0.06, True)])
def test_specimens_that_scatter_much_hide_an_effect_between_them_from_repeats(specimen, hidden):
    selection = searched(make_bins(3, repeats=2, bins=6, specimen=specimen))
    scatter = scatter_list(selection.after)
    undetectable = undetectable_variables(selection, sensitivity(selection, 0.005), scatter)
    assert any(undetectable.values()) == hidden


@pytest.mark.parametrize(("gain", "hidden"), [(0.005, False), (0.1, True)])
def test_repeats_that_scatter_much_hide_an_effect_between_runs_from_themselves(gain, hidden):
    selection = searched(make_bins(3, repeats=2, bins=6, gain=gain))
    scatter = scatter_list(selection.after)
    undetectable = undetectable_variables(selection, sensitivity(selection, 0.005), scatter)
    assert undetectable.get("speed_mm_s", False) == hidden


@pytest.mark.parametrize("slope", [0.01, 0.2])
def test_strokes_that_differ_much_hide_an_effect_along_them(slope):
    bins = make_bins(1, temperatures=(), speeds=(1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0), repeats=1, bins=6)
    place = bins["displacement_mm"].abs() / bins["displacement_mm"].abs().max() - 0.5
    own = dict(zip(bins["file"].unique(), np.random.default_rng(1).normal(0.0, slope, 99), strict=False))
    bins["force_N"] *= 1 + bins["file"].map(own) * place
    selection = searched(bins)
    found = sensitivity(selection, 0.005)
    (entry,) = [e for e in found if e["variable"] == "displacement_mm"]
    assert entry["smallest_N"] is not None
    assert ("displacement_mm" in undetectable_variables(selection, found, [])) == (slope == 0.2)


def test_a_variable_of_an_effect_in_the_model_is_not_said_to_be_undecided():
    bins = make_bins(1, temperatures=(), speeds=(1.0, 4.0, 16.0, 64.0), repeats=1, bins=6)
    selection = searched(bins)
    found = sensitivity(selection, 0.005)
    effect = SimpleNamespace(proposal=SimpleNamespace(term=SimpleNamespace(channels=("displacement_mm",))))
    with_it = undetectable_variables(replace(selection, added=(effect,)), found, [])
    assert {*with_it, "displacement_mm"} == set(undetectable_variables(selection, found, []))
    assert "displacement_mm" not in with_it


def test_a_test_that_leaves_nothing_but_rounding_has_a_margin():
    """The sum of squares of the numbers is that of the test, or a rounding error below it."""
    test = SimpleNamespace(share=1.0, basis=np.ones((4, 1)), known=1e-5, error_df=1.0, chi2=1.0 + 1e-14)
    units = SimpleNamespace(
        test=lambda left, target: test, numbers=lambda target: SimpleNamespace(values=np.array([1.0]))
    )
    margin = _by_numbers((units, units), np.ones((4, 1)), ("mu", "multiply"), 1e-8)
    assert 0.0 <= margin < np.inf


@pytest.mark.parametrize(("speeds", "known"), [(SPEEDS[1:8:2], False), (SPEEDS, True)])
def test_where_the_model_goes_through_all_runs_nothing_between_them_can_be_told(speeds, known):
    few = {"temperatures": (), "days": (), "speeds": speeds, "run_channels": OIL}
    selection = searched(make_bins(3, repeats=3, bins=4, **few))
    undetectable = undetectable_variables(selection, sensitivity(selection, 0.005), [])
    assert undetectable.get("oil_ppm") == (None if known else True)
