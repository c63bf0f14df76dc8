"""Repeats that are set-ups: all speeds of a specimen measured before it is mounted anew."""

import numpy as np
import pandas as pd
import pytest
from bins_helpers import make_bins, mounted_anew

from sealfit.closure.channels import find_channels
from sealfit.closure.score_test import ScoreTests
from sealfit.closure.search import search
from sealfit.fit.joint import fit_declared
from sealfit.fit.joint.rows import CELL, SET_UP, make_rows
from sealfit.fit.joint.set_ups import with_both_directions, with_set_ups, with_specimens_by_condition

SMALL = {"temperatures": (60.0,), "bins": 4}


def test_files_that_scatter_by_themselves_or_by_run_have_no_set_ups():
    found = [SET_UP in with_set_ups(make_bins(seed, setup=0.01 * (seed % 2), **SMALL)) for seed in range(30)]
    assert not any(found)  # nominal 0.001


@pytest.mark.parametrize("seed", range(3))
def test_files_of_a_specimen_and_repeat_that_scatter_alike_are_a_set_up(seed):
    bins = with_set_ups(mounted_anew(seed))
    assert bins.groupby(["specimen_id", "repeat"])[SET_UP].nunique().eq(1).all()
    assert bins[SET_UP].nunique() == 15
    rows = make_rows(bins, has_aging=True)
    assert rows.groups.starts["run"].size == 15
    assert rows.level_name("run") == "set_up"
    assert SET_UP not in rows.channels


BOTH = {"temperatures": (60.0,), "bins": 4, "directions": (1, -1), "repeats": 1}


def both_directions(bins):
    return with_both_directions(bins, fit_declared(make_rows(bins, has_aging=True)))


def test_directions_that_scatter_by_themselves_are_no_set_ups_though_friction_is_asymmetric():
    for seed in range(20):  # nominal 0.001
        bins = make_bins(seed, setup=0.01, **BOTH)
        bins["force_N"] *= 1 + 0.03 * np.sign(bins["speed_mm_s"])
        assert SET_UP not in both_directions(bins)


@pytest.mark.parametrize("seed", range(3))
def test_forward_and_backward_at_one_speed_that_scatter_alike_are_one_set_up(seed):
    bins = make_bins(seed, **BOTH)
    visit = bins["condition"] + bins["speed_set_mm_s"].astype(str)
    bins["force_N"] *= (
        1 + np.random.default_rng(seed).normal(0, 0.02, visit.nunique())[pd.factorize(visit)[0]]
    )
    found = both_directions(bins)
    assert (found.groupby(SET_UP)["run_id"].nunique() == 2).all()
    assert (found.groupby(SET_UP)["speed_set_mm_s"].nunique() == 1).all()
    assert make_rows(found, has_aging=True).groups.starts["run"].size == bins["run_id"].nunique() // 2


def test_files_with_both_directions_and_files_of_one_are_left_as_they_are():
    bins = make_bins(0, **BOTH)
    one_file = bins["condition"] + bins["speed_set_mm_s"].astype(str)
    for own in (bins.assign(file=one_file), make_bins(0, **SMALL)):
        assert SET_UP not in both_directions(own)


def test_a_change_with_the_repeat_that_specimens_have_in_common_is_none_of_set_ups():
    bins = make_bins(1, **SMALL)
    bins["force_N"] *= 1 - 0.03 * np.log(bins["repeat"])
    assert SET_UP not in with_set_ups(bins)


def test_what_two_of_nine_specimens_show_is_an_effect_and_no_scatter_of_set_ups():
    bins = make_bins(1, bins=4)
    changed = bins["aging_days"].isin([4.0]) & (bins["repeat"] > 1)
    bins["force_N"] *= np.where(changed, 1.04, 1.0)
    assert SET_UP not in with_set_ups(bins)


def test_with_another_specimen_for_every_repeat_a_change_in_common_is_their_scatter():
    bins = make_bins(1, temperatures=(), days=(), bins=4)
    bins["force_N"] *= 1 - 0.03 * np.log(bins["repeat"])
    assert SET_UP not in with_set_ups(bins)
    others = bins.assign(specimen_id=bins["repeat"].astype(str))
    assert with_set_ups(others)[SET_UP].nunique() == 3


def test_repeats_of_one_specimen_may_be_set_ups_only_where_they_were_recorded_one_after_the_other():
    bins = mounted_anew(1, days=(8.0,))
    one = bins[bins["aging_days"] == 8.0]
    found = with_set_ups(one)
    assert found.groupby("repeat")[SET_UP].nunique().eq(1).all()
    assert found[SET_UP].nunique() == 3
    in_turn = one.sort_values(["run_id", "repeat"], kind="stable")
    in_turn = in_turn.assign(run_order=pd.factorize(in_turn["file"])[0] + 1.0)
    assert SET_UP not in with_set_ups(in_turn)


@pytest.mark.parametrize(("by_repeat", "mounts"), [((0.0, 0.02, -0.01), True), ((0.0, 0.02, 0.0201), False)])
def test_repeats_of_one_specimen_in_an_unknown_order_may_be_set_ups_unless_friction_rises_or_falls(
    by_repeat, mounts
):
    bins = mounted_anew(1, sd=0.0, days=(8.0,), gain=0.001)
    bins = bins[bins["aging_days"] == 8.0].drop(columns=["run_order", "elapsed_h"])
    bins["force_N"] *= 1 + bins["repeat"].map(dict(enumerate(by_repeat, 1)))
    assert (SET_UP in with_set_ups(bins)) == mounts


def test_set_ups_show_their_scatter_though_they_are_fewer_than_the_numbers_of_the_curves():
    bins = mounted_anew(2, sd=0.03, days=(1.0, 4.0), repeats=2, gain=0.001)
    rows = make_rows(with_set_ups(bins), has_aging=True)
    assert rows.groups.starts["run"].size == 6
    fitted = fit_declared(rows)
    assert 0.01 < max(np.sqrt(c.variance) for c in fitted.scatter.components if c.level == "run") < 0.06
    found = search(ScoreTests(fitted), find_channels(rows), np.random.default_rng(0))
    assert min(c.p_value for c in found if c.channels[0] in ("repeat", "elapsed_h", "run_order")) > 0.005


def test_nothing_is_claimed_between_two_set_ups_of_one_specimen():
    rng = np.random.default_rng(0)
    for seed in range(4):
        bins = mounted_anew(seed, sd=0.0, days=(8.0,), repeats=2, gain=0.001)
        bins["force_N"] *= np.where(bins["repeat"] == 2, 1.03, 1.0)
        bins = with_set_ups(bins[bins["aging_days"] == 8.0])
        assert bins[SET_UP].nunique() == 2
        rows = make_rows(bins, has_aging=False)
        found = search(ScoreTests(fit_declared(rows)), find_channels(rows), rng)
        assert not [c for c in found if c.p_value < 0.005 and c.claimable]


@pytest.mark.parametrize("jitter", [0.0, 1e-6])
def test_forces_that_are_the_same_to_the_last_digits_show_no_set_ups(jitter):
    bins = make_bins(1, noise_N=0.0, gain=0.0, **SMALL)
    mount = pd.factorize(bins["specimen_id"] + bins["repeat"].astype(str))[0]
    bins["force_N"] *= 1 + jitter * np.sin(mount)
    assert SET_UP not in with_set_ups(bins)


def test_a_column_of_the_campaign_with_that_name_is_a_channel():
    bins = make_bins(1, **SMALL).assign(set_up="A")
    rows = make_rows(with_set_ups(bins), has_aging=True)
    assert "set_up" in rows.channels
    assert rows.groups.starts["run"].size == bins["run_id"].nunique()


def test_without_repeats_there_is_nothing_to_find():
    bins = make_bins(1, repeats=1, **SMALL)
    assert with_set_ups(bins) is bins


@pytest.mark.long
def test_nothing_is_significant_where_only_set_ups_scatter():
    def least_p(bins, seed):
        rows = make_rows(bins, has_aging=True)
        found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(seed))
        return min(c.p_value for c in found)

    campaigns = [mounted_anew(seed) for seed in range(3)]
    by_runs, by_set_ups = (
        [least_p(make(bins), seed) for seed, bins in enumerate(campaigns)]
        for make in (lambda bins: bins, with_set_ups)
    )
    assert sum(p < 0.005 for p in by_runs) >= 2  # by files, taken for independent
    assert min(by_set_ups) > 0.005


@pytest.mark.parametrize("seed", [305, 310])
def test_three_specimens_are_enough_to_show_their_mounts(seed):
    """The mounts of two of them agree by chance; a change with the repeat had p = 4e-6 and 1e-6."""
    assert SET_UP in with_set_ups(mounted_anew(seed, repeats=4, setup=0.02, days=(2.0, 8.0)))


@pytest.mark.parametrize("seed", [301, 303])
def test_repeats_in_several_set_ups_are_no_independent_evidence_of_the_speed(seed):
    """Each specimen has its own force at each speed, the same in all its mounts; p was 8e-7 and 5e-6."""
    bins = with_set_ups(mounted_anew(seed, repeats=4, setup=0.02, days=(2.0, 8.0)))
    assert SET_UP in bins
    rows = make_rows(bins, has_aging=True)
    (speed,) = (channel for channel in find_channels(rows) if channel.name == "speed_mm_s")
    found = search(ScoreTests(fit_declared(rows)), [speed], np.random.default_rng(seed))
    assert {c.test_result.small_sample.level for c in found} == {CELL}
    assert min(c.p_value for c in found) > 0.001


# ---------------------------------------------------------------- specimens of one name in several conditions
def two_of_each_condition(scatter: float, persistent: float) -> pd.DataFrame:
    """Specimens 1 and 2 in every condition: other pieces with a `scatter`, or the same ones that differ."""
    made = []
    for number in (1, 2):
        bins = make_bins(number, repeats=1, bins=4, gain=0.002, specimen=scatter)
        bins["force_N"] *= 1 + persistent * number
        own = {name: bins[name] + f" {number}" for name in ("file", "run_id")}
        made.append(bins.assign(**own, specimen_id=str(number)))
    return pd.concat(made, ignore_index=True)


def test_specimens_numbered_anew_in_each_condition_are_other_ones():
    bins = two_of_each_condition(0.02, 0.0)
    found = with_specimens_by_condition(bins)
    assert found["specimen_id"].nunique() == 2 * bins["condition"].nunique()
    assert found["specimen_id"].iloc[0] == f"1 in {bins['condition'].iloc[0]}"
    assert with_specimens_by_condition(bins.assign(load_N=np.nan))["specimen_id"].equals(found["specimen_id"])


def test_specimens_that_differ_alike_in_all_conditions_are_the_same_ones():
    bins = two_of_each_condition(0.0, 0.03)
    assert with_specimens_by_condition(bins) is bins
    one = bins[bins["specimen_id"] == "1"]
    assert with_specimens_by_condition(one) is one
