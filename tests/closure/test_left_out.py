"""Files that went wrong as a whole."""

from __future__ import annotations

import numpy as np
import pytest
from bins_helpers import make_bins

from sealfit.closure.left_out import foldable, outlier_files
from sealfit.fit.joint.rows import make_rows


def bins_with(factor: dict[int, float], **design):
    bins = make_bins(bins=4, noise_N=0.05, **design)
    files = bins["file"].unique()
    for number, gain in factor.items():
        bins.loc[bins["file"] == files[number], "force_N"] *= gain
    return bins, files


@pytest.mark.parametrize("repeats", [1, 2])
def test_a_file_that_went_wrong_is_found(repeats):
    bins, files = bins_with({17: 1.2}, repeats=repeats)
    (one,) = outlier_files(make_rows(bins, has_aging=True))[0]
    assert one.file == files[17]
    assert one.deviation == pytest.approx(0.2, abs=0.02)
    assert one.p_value < 1e-3
    own = bins[bins["file"] == files[17]].iloc[0]
    assert one.conditions["aging_days"] == own["aging_days"]


def test_two_files_do_not_hide_each_other():
    bins, files = bins_with({5: 0.9, 17: 1.15}, repeats=1)
    found = outlier_files(make_rows(bins, has_aging=True))[0]
    assert [one.file for one in found] == [files[17], files[5]]


def test_scatter_of_the_files_is_no_outlier():
    bins, files = bins_with({}, repeats=1)
    gain = 1 + 0.02 * np.random.default_rng(3).standard_normal(files.size)
    bins["force_N"] *= gain[bins["file"].map({name: k for k, name in enumerate(files)})]
    assert outlier_files(make_rows(bins, has_aging=True))[0] == []


def test_a_file_within_a_fiftieth_is_no_outlier():
    bins, _ = bins_with({17: 1.015}, repeats=1)
    assert outlier_files(make_rows(bins, has_aging=True))[0] == []


def test_too_few_files_predict_no_other():
    bins, files = bins_with({}, repeats=1)
    few = bins[bins["file"].isin(files[:6])].copy()
    few.loc[few["file"] == files[2], "force_N"] *= 1.3
    assert outlier_files(make_rows(few, has_aging=True))[0] == []


@pytest.mark.long
def test_one_of_ten_files_that_went_wrong_is_found_though_the_curve_follows_it():
    """A curve without a fall, or with another v_s, may fit all ten so that another file is the farthest."""

    def shallow(table, force):
        speed = table["speed_mm_s"].to_numpy()
        return 9.0 * (1 + 0.15 * np.exp(-((speed / 5.0) ** 2)) + 0.0004 * speed)

    design = {"days": (), "temperatures": (), "speeds": tuple(np.geomspace(1.0, 480.0, 10)), "repeats": 1}
    found = []
    for number in range(10):
        bins, files = bins_with({number: 1.2}, gain=0.0005, effect=shallow, **design)
        found += outlier_files(make_rows(bins, has_aging=True))[0]
        assert len(found) == number + 1
        assert files[number] in (found[-1].file, *found[-1].instead)
    assert sum(bool(one.instead) for one in found) <= 2  # either of the two slowest may be the wrong one


def test_few_files_that_scatter_are_no_outliers():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        speeds = tuple(np.geomspace(0.5, rng.uniform(20, 500), int(rng.integers(5, 10))))
        one_condition = {"days": (), "temperatures": (), "repeats": 1, "gain": rng.uniform(0.003, 0.05)}
        bins = make_bins(seed, bins=4, noise_N=0.05, speeds=speeds, **one_condition)
        assert outlier_files(make_rows(bins, has_aging=True))[0] == []


@pytest.mark.long
def test_no_file_is_left_out_where_another_may_be_the_wrong_one():
    """Twelve files, three speeds both ways: without either of two files the others agree."""
    design = {"days": (4.0,), "temperatures": (60.0,), "speeds": (1.0, 10.0, 100.0), "directions": (1, -1)}
    for number in (0, 3, 4, 7, 8, 11):  # each condition and speed, one way and the other in turn
        bins, files = bins_with({number: 1.2}, gain=0.001, repeats=1, **design)
        (one,) = outlier_files(make_rows(bins, has_aging=True))[0]
        assert one.instead
        assert files[number] in (one.file, *one.instead)


@pytest.mark.long
def test_no_file_is_left_out_where_the_rest_does_not_predict_it_without_another():
    """Two days of four speeds: without the wrong file, one other file determines v_s of the condition."""
    design = {"days": (1.0, 12.0), "temperatures": (40.0, 100.0), "speeds": (2.35, 9.4, 37.5, 150.0)}
    for number in (3, 7):
        bins, files = bins_with({number: 0.83}, gain=0.002, repeats=1, **design)
        (one,) = outlier_files(make_rows(bins, has_aging=True))[0]
        assert one.instead
        assert files[number] in (one.file, *one.instead)


@pytest.mark.parametrize(("days", "level"), [((1.0, 4.0), "run"), ((1.0, 4.0, 16.0), "specimen")])
def test_specimens_are_held_out_only_where_an_aging_law_predicts_them(days, level):
    """One specimen a condition: two days without unaged rubber have no law that predicts them."""
    bins = make_bins(bins=4, repeats=1, days=days)
    rows = make_rows(bins[bins["aging_days"] > 0], has_aging=True)
    assert foldable(rows, "specimen") == level
