"""Strokes both ways of one file tell the size of the friction once."""

import pytest

from sealfit.config import Config
from sealfit.fit.steady import fit_conditions
from sealfit.fit.steady.uncertainty import merge_directions, run_means


def test_one_row_a_file_and_the_offset_between_the_ways_cancels(campaign):
    table = campaign(noise=0.0, days=(0,), together=True)
    shifted = table.assign(force_N=table["force_N"] + 0.7)  # a zero offset: the same sign both ways
    together = merge_directions(shifted)
    assert len(together) == len(table) / 2
    assert set(together["direction"]) == {0}
    plain = run_means(table)["force"].to_numpy()
    assert run_means(shifted)["force"].to_numpy() == pytest.approx(plain, rel=1e-12)


def test_files_of_one_way_each_stay_as_they_are(campaign):
    table = campaign(days=(0,))
    together = merge_directions(table)
    assert together.equals(table)


def test_a_slow_way_out_and_a_fast_way_back_are_two_runs(campaign):
    table = campaign(noise=0.0, days=(0,), together=True)
    back = table["direction"] < 0
    table.loc[back, ["speed_mm_s", "speed_set_mm_s"]] *= 3.0
    assert set(merge_directions(table)["direction"]) == {1, -1}


def test_what_both_ways_share_is_counted_once(campaign):
    """With gain and set-up of the file in both ways, the intervals are those of one way alone."""
    both = campaign(noise=0.01, days=(0, 1, 2), together=True)
    one_way = both[both["direction"] > 0]
    fits = [fit_conditions(table, Config())["steady_fit"] for table in (one_way, both)]
    for name in ("value", "se", "lo95", "hi95"):
        one_way, together = (fit.loc[fit["quantity"] == "steady", name].to_numpy(float) for fit in fits)
        assert together == pytest.approx(one_way, rel=1e-6, nan_ok=True)


def test_a_file_without_its_strokes_of_one_way_brings_no_offset_in(campaign):
    table = campaign(noise=0.0, days=(0,), together=True)
    shifted = table.assign(force_N=table["force_N"] + 0.7)
    lone = shifted.index[(shifted["direction"] < 0)][0]
    found = merge_directions(shifted.drop(index=lone))
    assert set(found["direction"]) == {0}
    assert len(found) == len(table) / 2 - 1


def test_files_of_one_way_that_are_as_many_as_those_both_ways_stay(campaign):
    table = campaign(noise=0.0, days=(0,), together=True)
    repeat = table["repeat"].min()
    one_way = table[(table["repeat"] == repeat) | (table["direction"] > 0)]
    found = merge_directions(one_way)
    assert set(found["repeat"]) == set(table["repeat"])
