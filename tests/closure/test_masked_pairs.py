"""Effects that mask each other in few units."""

import numpy as np
import pandas as pd
import pytest
from bins_helpers import TWO_FOLDS, make_bins, make_traces

from sealfit.closure.channels import find_channels
from sealfit.closure.loop import close_loop
from sealfit.closure.score_test import ScoreTests
from sealfit.closure.search import _pairs, search, search_masked_pairs, search_pairs
from sealfit.fit.joint import fit_declared
from sealfit.fit.joint.rows import make_rows

FOUR = (1.0, 4.0, 16.0, 64.0)
PRESSURE = {"pressure_bar": lambda rng: float(rng.integers(1, 8))}
ONE = {"temperatures": (), "days": (), "directions": (1, -1), "setup": 0.003, "bins": 8}


def hidden(bins, alpha=0.005):
    rows = make_rows(bins, has_aging=True)
    tests, channels, rng = ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0)
    singles = search(tests, channels, rng)
    pairs = search_pairs(tests, channels, singles, rng)
    return search_masked_pairs(tests, {c.name: c for c in channels}, [*singles, *pairs], alpha)


def one_way(table, force):
    """Friction that grows by 12 % along the stroke, forward only: more than one specimen does by itself."""
    return force * (1 + 0.003 * table["distance_mm"].to_numpy() * (table["direction"].to_numpy() > 0))


def test_a_slope_along_strokes_and_its_change_with_pressure_hide_each_other():
    def tilt(table, force):
        return force - 0.02 * table["pressure_bar"].to_numpy() * (table["displacement_mm"].to_numpy() - 20)

    bins = make_bins(0, speeds=FOUR, repeats=1, run_channels=PRESSURE, effect=tilt, **ONE)
    first, *_ = hidden(bins)
    assert first.keys == (
        (("displacement_mm",), "force", "add"),
        (("displacement_mm", "pressure_bar"), "force", "add"),
    )


@pytest.mark.long
def test_pairs_of_chance_are_not_found_too_often():
    """By chance in 10 %: in more than 5 of 20 with p 0.01; were it 40 %, in more than 5 of 20 with p 0.87."""
    bins = (make_bins(seed, speeds=FOUR, repeats=1, run_channels=PRESSURE, **ONE) for seed in range(20))
    assert sum(bool(hidden(own, alpha=0.1)) for own in bins) <= 5


def test_steps_in_time_are_in_no_pair():
    """The best of many places would count as one test: in 28 files a pair had p < 0.005 in 4 % by chance."""
    rows = make_rows(make_bins(0, speeds=FOUR, repeats=1, **ONE), has_aging=True)
    tests, channels = ScoreTests(fit_declared(rows)), {c.name: c for c in find_channels(rows)}
    singles = search(tests, list(channels.values()), np.random.default_rng(0))
    steps = {id(c) for c in singles if c.channels[-1] == "elapsed_h" and c.place}
    paired = [c for two, _ in _pairs(tests, channels, singles) for c in two]
    assert steps
    assert any(c.channels[-1] == "elapsed_h" for c in paired)
    assert steps.isdisjoint(map(id, paired))


def test_growth_in_one_direction_is_found_and_named():
    bins = make_bins(1, repeats=1, effect=one_way, **ONE)
    effects = close_loop(bins, make_traces(bins), TWO_FOLDS).document["effects"]
    (effect,) = [
        e for e in effects if e["channels"] != ["direction"]
    ]  # from one direction to the other, mu may differ
    assert (effect["id"], effect["channels"][1]) == ("linear_each_way", "direction")
    forward, backward = effect["parameters"]
    assert forward["value"] == pytest.approx(0.003, rel=0.2)
    assert backward["ci95"][0] < 0 < backward["ci95"][1]


def test_a_wrong_piston_area_is_an_offset_that_changes_with_pressure():
    bins = make_bins(
        0, speeds=FOUR, temperatures=(60.0,), days=(1.0, 4.0, 16.0), directions=(1, -1), repeats=1, bins=8,
        run_channels=PRESSURE,
        effect=lambda table, force: force + 0.35 * (table["pressure_bar"].to_numpy() - 4),
    )  # fmt: skip
    (effect,) = close_loop(bins, make_traces(bins), TWO_FOLDS).document["effects"]
    assert effect["id"] in ("linear", "offset_slope")  # the offset is zero near the mean pressure
    assert (set(effect["channels"]), effect["acts_on"]) == ({"pressure_bar", "direction"}, "force")
    assert effect["parameters"][0]["value"] == pytest.approx(0.35, rel=0.1)


def test_an_offset_and_an_asymmetry_of_sigma_2_enter_together():
    def askew(table, force):
        return force - 1 + 0.015 * np.abs(table["speed_mm_s"].to_numpy())

    bins = make_bins(0, repeats=1, effect=askew, **ONE)
    effects = close_loop(bins, make_traces(bins), TWO_FOLDS).document["effects"]
    assert {(e["id"], e["acts_on"]) for e in effects} == {("zero_offset", "force"), ("asymmetry", "sigma_2")}


def test_a_drift_of_the_zero_is_seen_beside_its_own_mean():
    """The mean of the drift is an offset that hides its change along the campaign, and is hidden by it."""
    pieces = []
    for number, piece in enumerate("ABCDE"):
        own = make_bins(number, speeds=(4.0, 64.0), repeats=1, specimen=0.03, **ONE)
        hours = own["elapsed_h"] + 2.0 * number
        own = own.assign(specimen_id=piece, elapsed_h=hours, force_N=own["force_N"] + 0.15 * hours)
        pieces.append(own.assign(file=piece + own["file"], run_id=piece + own["run_id"]))
    found = hidden(pd.concat(pieces, ignore_index=True))
    both = {(("direction",), "force", "add"), (("direction", "elapsed_h"), "force", "add")}
    assert both in [set(pair.keys) for pair in found]
