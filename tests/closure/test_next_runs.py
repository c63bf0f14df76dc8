from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from bins_helpers import make_bins

from sealfit.closure.confirm import RefusedEffect
from sealfit.closure.left_out import OutlierFile
from sealfit.closure.linearised import Proposal
from sealfit.closure.next_runs import (
    LONGER_STROKES,
    _combinations,
    _is_tested,
    find_aliases,
    largest_difference,
    next_runs,
)
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.effects.contract import AMPLITUDE, Parameter
from sealfit.fit.joint import fit_declared, fitted_at
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import make_rows


def bound(fitted, effect, channel, **values):
    """The declared fit with one effect as a factor on mu, its numbers given."""
    term = Term(EFFECTS[effect], (channel,), "mu", "multiply", fixed={"x_ref": 0.0})
    after = fitted_at(fitted.model.with_term(term, values), fitted.rows, fitted.scatter)
    return Proposal(
        term, values, "run", 10, 1.0, 0.001, np.zeros(fitted.force.size), ((channel,),), fitted=after
    )


def between(chosen, rival):
    channels = (*chosen.term.channels, *rival.term.channels)
    return largest_difference(chosen.fitted.model, rival.fitted.model, chosen.fitted.rows, channels, Config())


@pytest.mark.parametrize("unknown", [None, "f0003.csv"])  # a file without the channel
def test_channels_that_always_went_together_are_taken_apart(unknown):
    bins = make_bins(bins=4, repeats=1)
    bins["humidity_pct"] = 2.0 * bins["elapsed_h"]  # rose with the calendar
    bins.loc[bins["file"] == unknown, "humidity_pct"] = np.nan
    fitted = fit_declared(make_rows(bins, has_aging=True))
    chosen = bound(fitted, "linear", "humidity_pct", A=0.01)
    rival = bound(fitted, "linear", "elapsed_h", A=0.02)
    where, apart = between(chosen, rival)
    hours = bins["elapsed_h"]
    assert {"humidity_pct", "elapsed_h"} <= where.keys()
    # Dry after the end: by the whole range, and half of it beyond, of the factor on some 45 N.
    assert where["elapsed_h"] - where["humidity_pct"] / 2.0 > np.ptp(hours)
    assert apart > 0.02 * np.ptp(hours) * 40.0


def test_forms_of_one_channel_differ_most_beyond_what_was_tested():
    fitted = fit_declared(make_rows(make_bins(bins=4, repeats=1), has_aging=True))
    chosen = bound(fitted, "linear", "elapsed_h", A=0.01)
    rival = bound(fitted, "exponential_approach", "elapsed_h", A=0.05, tau=5.0)
    where, apart = between(chosen, rival)
    assert where["elapsed_h"] > fitted.rows.values("elapsed_h").max()
    assert where["aging_days"] in fitted.rows.days
    assert apart == pytest.approx(abs(0.01 * where["elapsed_h"] - 0.05) * 45.0, rel=0.5)


@pytest.mark.parametrize(
    ("changed", "tested"),
    [
        ({}, True),
        ({"distance_mm": 2.0}, True),
        ({"distance_mm": 1e4}, False),
        ({"speed_mm_s": 7.7}, False),
        ({"direction": -1.0}, False),
        ({"temperature_C": 61.0}, False),
    ],
)
def test_a_run_is_tested_if_the_campaign_has_one_of_its_conditions(changed, tested):
    rows = make_rows(make_bins(bins=4, repeats=1), has_aging=True)
    first = rows.table.iloc[0]
    names = ("temperature_C", "aging_days", "speed_mm_s", "direction")
    conditions = {name: float(first[name]) for name in names}
    assert _is_tested({**conditions, **changed}, rows) == tested


@pytest.mark.parametrize(("rival", "begins"), [("elapsed_h", "would"), ("humidity_pct", "more repeats of")])
def test_repeats_are_asked_where_the_models_differ_most_at_a_tested_run(rival, begins, monkeypatch):
    bins = make_bins(bins=4, repeats=1).assign(humidity_pct=lambda table: 30.0 + table["elapsed_h"] % 7)
    fitted = fit_declared(make_rows(bins, has_aging=True))
    chosen, other = bound(fitted, "linear", "elapsed_h", A=0.01), bound(fitted, "linear", rival, A=0.02)
    first = {name: fitted.rows.table[name].iloc[0] for name in ("temperature_C", "aging_days", "speed_mm_s")}
    most = {**first, "speed_mm_s": first["speed_mm_s"] * (1.0 if begins.startswith("more") else 1.3)}
    monkeypatch.setattr("sealfit.closure.next_runs.largest_difference", lambda *given: (most, 0.5))
    item = SimpleNamespace(proposal=chosen, rivals=((other, 0.1),))
    selection = SimpleNamespace(added=[item], after=fitted, inconclusive=None, refused=())
    run, *_ = next_runs(selection, Config(), {})
    assert run["why"].startswith(begins)


def test_no_run_that_was_made_is_said_to_show_what_these_runs_cannot():
    fitted = fit_declared(make_rows(make_bins(bins=4, repeats=3), has_aging=True))
    models = [bound(fitted, "linear", "repeat", A=size).fitted.model for size in (0.01, 0.02)]
    found, _ = largest_difference(*models, fitted.rows, ("repeat",), Config())
    assert _is_tested(found, fitted.rows)
    assert largest_difference(*models, fitted.rows, ("repeat",), Config(), untested=True) is None


def test_runs_lie_within_what_was_tested_except_for_the_calendar_and_the_days():
    bins = make_bins(bins=2, repeats=1).assign(pressure_bar=lambda t: 2.0 * (t["elapsed_h"] % 4).round())
    fitted = fit_declared(make_rows(bins, has_aging=True))
    names = ("pressure_bar", "aging_days", "elapsed_h")
    tried = pd.DataFrame(_combinations(fitted.model, fitted.rows, names))
    tested = {name: fitted.rows.values(name) for name in names}
    assert sorted(tried["pressure_bar"].unique()) == [0.0, 1.0, 4.0, 8.0]
    assert tried["aging_days"].max() == 1.5 * tested["aging_days"].max()
    assert tried["elapsed_h"].min() == tested["elapsed_h"].max()


def test_an_effect_that_was_refused_and_variables_without_power_have_a_run_each():
    fitted = fit_declared(make_rows(make_bins(bins=4, repeats=2), has_aging=True))
    item = RefusedEffect(bound(fitted, "linear", "elapsed_h", A=0.01), "it rests on one day")
    selection = SimpleNamespace(added=(), inconclusive=None, refused=(item,), after=fitted)
    whys = [run["why"] for run in next_runs(selection, Config(), {}, undecided=["pressure_bar"])]
    assert any("would confirm or refute linear in elapsed_h" in why for why in whys)
    assert fitted.knows_specimens == any("would show effects of pressure_bar" in why for why in whys)


def test_an_offset_is_friction_where_all_runs_go_one_way():
    fitted = fit_declared(make_rows(make_bins(bins=4, repeats=2, noise_N=0.05), has_aging=True))
    alias = next(
        a for a in find_aliases(fitted, EFFECTS, ("temperature_C",)) if a.term.effect.id == "zero_offset"
    )
    force = 49.03 * 0.6
    assert alias.size_N == pytest.approx(0.01 * force, rel=0.3)
    where, apart = largest_difference(alias.holding, alias.lacking, fitted.rows, ("direction",), Config())
    assert where["direction"] < 0  # the other way, where the offset helps the friction it stood for
    assert where["speed_mm_s"] > 0  # runs.csv has magnitudes
    assert apart == pytest.approx(2 * alias.size_N, rel=0.05)


def test_a_slower_speed_is_wanted_where_speeds_are_too_few():
    bins = make_bins(speeds=(2.0, 10.0, 40.0), directions=(1, -1), bins=4, repeats=2)
    fitted = fit_declared(make_rows(bins, has_aging=True))
    selection = SimpleNamespace(added=(), inconclusive=None, refused=(), after=fitted)
    wanted = next_runs(selection, Config(), EFFECTS)
    assert "four speeds in one direction" in wanted[-1]["why"]  # the terminal has the first three runs
    assert wanted[-1]["conditions"]["speed_mm_s"] == 1.0
    assert all(run["conditions"].get("speed_mm_s", 1.0) > 0 for run in wanted)


def test_an_offset_is_no_alias_where_runs_go_both_ways():
    fitted = fit_declared(make_rows(make_bins(bins=4, repeats=1, directions=(1, -1)), has_aging=True))
    found = {
        a.term.effect.id for a in find_aliases(fitted, EFFECTS, ("temperature_C", "compression_ratio_pct"))
    }
    assert not found & {"zero_offset", "asymmetry", "drift", "warming_time"}


def test_an_effect_on_what_does_not_act_where_it_is_there_is_no_alias():
    """mu_s is no part of friction far above v_s, so a change of it there adds nothing that can be scaled."""
    fitted = fit_declared(
        make_rows(make_bins(speeds=(1.0, 4.0, 8.0, 16.0, 32.0, 1000.0), bins=4, repeats=1), has_aging=True)
    )
    fast = replace(
        EFFECTS["drift"], id="fast", reads=("speed_mm_s",), acts_on=(("mu_s", "multiply"),),
        shape=lambda inputs, **values: values["A"] * (np.abs(inputs["speed_mm_s"]) > 500.0),
        parameters=(Parameter("A", "", 0.1, AMPLITUDE, "size", linear=True),),
    )  # fmt: skip
    assert find_aliases(fitted, {"fast": fast}, ()) == []


def test_the_run_of_an_outlying_file_comes_first():
    fitted = fit_declared(make_rows(make_bins(bins=4, repeats=1), has_aging=True))
    selection = SimpleNamespace(added=(), inconclusive=None, refused=(), after=fitted)
    known = {"temperature_C": 80.0, "aging_days": 4.0, "speed_mm_s": 2.0}
    where = {**known, "load_N": float("nan"), "bin": 3}  # a log without the load
    outlier = OutlierFile("a.csv", -0.12, 1e-6, where)
    first, *_ = next_runs(selection, Config(), {}, [outlier])
    assert first["why"].startswith("file a.csv is 12% below what all others predict and was left out")
    assert first["conditions"] == known
    kept = outlier._replace(instead=("b.csv",))
    first, *_ = next_runs(selection, Config(), {}, [kept])
    assert first["why"].endswith(
        "was kept, as b.csv may be the wrong file instead: look at them, and repeat their runs"
    )


def test_longer_strokes_are_wanted_where_the_friction_is_not_steady_at_their_end():
    bins = make_bins(bins=4, repeats=1)
    bins["presliding_N"] = -0.05 * bins["force_N"]
    selection = SimpleNamespace(
        added=(), inconclusive=None, refused=(), after=fit_declared(make_rows(bins, has_aging=True))
    )
    assert {"why": LONGER_STROKES, "conditions": {}} in next_runs(selection, Config(), {})


@pytest.mark.parametrize("temperatures", [(60.0,), (60.0, 80.0)])
def test_days_are_varied_where_each_aged_series_has_a_law(temperatures):
    bins = make_bins(2, temperatures=temperatures, days=(2.0, 4.0, 16.0), bins=2, repeats=1)
    fitted = fit_declared(make_rows(bins, has_aging=True))
    found = _combinations(fitted.model, fitted.rows, ("aging_days",))
    assert [point["aging_days"] for point in found][-2:] == [16.0, 24.0]


def test_a_place_between_tested_ones_is_tested_on_either_side_of_0():
    bins = make_bins(2, temperatures=(60.0,), days=(4.0,), bins=4, repeats=1)
    rows = make_rows(bins.assign(displacement_mm=bins["displacement_mm"] - 100.0), has_aging=True)
    assert _is_tested({"displacement_mm": float(rows.values("displacement_mm").max())}, rows)
    assert not _is_tested({"displacement_mm": -1.0}, rows)


def test_files_with_a_specimen_each_show_the_scatter_of_specimens():
    bins = make_bins(2, temperatures=(60.0,), days=(1.0, 4.0, 16.0), bins=4, repeats=1, specimen=0.03)
    fitted = fit_declared(make_rows(bins.assign(specimen_id=bins["file"]), has_aging=True))
    assert not fitted.scatter.estimates("specimen")
    assert fitted.knows_specimens
    selection = SimpleNamespace(added=(), inconclusive=None, refused=(), after=fitted)
    assert not any("scatter of specimens" in run["why"] for run in next_runs(selection, Config(), {}))
