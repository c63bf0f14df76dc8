"""Strokes both ways of one file tell the size of the friction once."""

import numpy as np
import pandas as pd
import pytest

from sealfit.config import Config
from sealfit.fit.both_ways import both_ways_together
from sealfit.fit.steady import fit_conditions
from sealfit.fit.uncertainty import run_means


def in_one_file(table):
    """The two ways of every repeat in one file, as a rig that goes to and fro writes them."""
    sign = np.where(table["direction"] > 0, "+", "-")
    speed = table["speed_mm_s"].abs().astype(str)
    file = table["condition"] + " " + speed + " " + table["repeat"].astype(str)
    return table.assign(file=file, run_id=table["condition"] + " " + speed + sign)


def test_one_row_a_file_and_the_offset_between_the_ways_cancels(campaign):
    table = in_one_file(campaign(noise=0.0, days=(0,)))
    shifted = table.assign(force_N=table["force_N"] + 0.7)  # a zero offset: the same sign both ways
    together = both_ways_together(shifted)
    assert len(together) == len(table) / 2
    assert set(together["direction"]) == {0}
    assert together["half_N"].to_numpy() == pytest.approx(0.7)
    plain = run_means(table)["force"].to_numpy()
    assert run_means(shifted)["force"].to_numpy() == pytest.approx(plain, rel=1e-12)


def test_files_of_one_way_each_stay_as_they_are(campaign):
    table = campaign(days=(0,))
    together = both_ways_together(table)
    assert together.drop(columns="half_N").equals(table)


def test_a_slow_way_out_and_a_fast_way_back_are_two_runs(campaign):
    table = in_one_file(campaign(noise=0.0, days=(0,)))
    back = table["direction"] < 0
    table.loc[back, ["speed_mm_s", "speed_set_mm_s"]] *= 3.0
    assert set(both_ways_together(table)["direction"]) == {1, -1}


def test_what_both_ways_share_is_counted_once(campaign):
    """With gain and set-up of the file in both ways, the intervals are those of one way alone."""
    one_way = campaign(noise=0.01, days=(0, 1, 2), ways=(1,))
    back = one_way.assign(direction=-1, speed_mm_s=-one_way["speed_mm_s"], force_N=-one_way["force_N"])
    sign = {1: "+", -1: "-"}
    both = [part.assign(run_id=part["run_id"] + sign[int(part["direction"].iloc[0])]) for part in (one_way, back)]
    fits = [fit_conditions(table, Config()) for table in (one_way, pd.concat(both, ignore_index=True))]
    for name in ("value", "se", "lo95", "hi95"):
        left, right = (fit.loc[fit["quantity"] == "steady", name].to_numpy(float) for fit in fits)
        assert right == pytest.approx(left, rel=1e-6, nan_ok=True)


def test_an_offset_between_the_ways_of_a_file_is_said(campaign):
    table = in_one_file(campaign(noise=0.002, days=(0,)))
    fits = fit_conditions(table.assign(force_N=table["force_N"] + 0.7), Config())
    lack = fits.loc[fits["parameter"] == "lack_of_fit_p", "reason"].iloc[0]
    assert "offset of 0.696 N" in lack
