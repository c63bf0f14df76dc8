import json

import numpy as np
import numpy.testing as npt
import pytest
from bins_helpers import TWO_FOLDS, make_bins, make_traces, with_another_curve

from sealfit.closure.loop import close_loop
from sealfit.closure.predict import predict
from sealfit.errors import RequestError
from sealfit.store.documents import read_document


@pytest.fixture(scope="module")
def of_three_speeds():
    """Bins at three speeds, and the model of them."""
    bins = make_bins(temperatures=(60.0,), speeds=(1.0, 8.0, 64.0), bins=4)
    return bins, close_loop(bins, make_traces(bins), TWO_FOLDS).model


def test_an_effect_that_is_not_confirmed_is_of_a_column_that_was_tested(of_three_speeds):
    bins, model = of_three_speeds
    term = {"id": "linear", "acts_on": "mu", "operation": "multiply", "smoothness": None}
    term |= {"channels": ["displacement_mm"], "fixed": {"x_ref": 0.0}, "values": {"A": 0.01}}
    one = {"label": "linear in displacement_mm", "theta": model["after"]["theta"], "terms": [term]}
    model = model | {"unconfirmed": [one], "first_started_at": None}
    wider = predict(read_document("model", json.dumps(model)), bins.head(3))
    lost = wider["force_after_N"] * 0.01 * bins["displacement_mm"].head(3)
    npt.assert_array_less(lost, (wider["force_after_hi95_N"] - wider["force_after_N"]).abs())
    for unknown in ({"channels": ["oil_ppm"]}, {"channels": []}):
        with pytest.raises(ValueError, match="validation error"):
            read_document("model", json.dumps(model | {"unconfirmed": [one | {"terms": [term | unknown]}]}))


def with_an_effect_of_days(model, slope):
    """Return a model whose friction also changes by a share `slope` a day."""
    term = {"id": "linear", "acts_on": "mu", "operation": "multiply", "smoothness": None}
    term |= {"channels": ["aging_days"], "fixed": {"x_ref": 0.0}, "values": {"A": slope}}
    covariance = np.pad(np.array(model["covariance"]), (0, 1)).tolist()
    after = model["after"] | {"terms": [*model["after"]["terms"], term]}
    return model | {"after": after, "covariance": covariance, "sandwiches": []}


def test_beyond_the_tested_days_an_effect_of_them_may_have_ended(of_three_speeds):
    bins, model = of_three_speeds
    model, last = with_an_effect_of_days(model, -0.01), bins[bins["aging_days"] == 16].head(1)
    model["scatter"] = model["scatter"] | {"of_specimens": True}
    tested, later = (predict(model, last.assign(aging_days=days)).iloc[0] for days in (16.0, 40.0))
    assert tested["force_after_hi95_N"] < tested["force_before_N"]
    assert later["force_after_N"] < 0.7 * later["force_before_N"] < later["force_after_hi95_N"]
    assert "with and without linear in aging_days, factor on mu" in later["note"]
    assert later["note"].count("outside the tests") == 1


def test_beyond_the_tests_no_force_pushes_along_the_motion(of_three_speeds):
    bins, model = of_three_speeds
    point = bins[bins["aging_days"] == 16].head(1).assign(aging_days=40.0)
    answer = predict(with_an_effect_of_days(model, -0.05), point).iloc[0]
    assert answer["force_before_N"] > 0
    assert np.isnan(answer["force_after_N"])
    assert "no force: beyond the tests" in answer["note"]


def test_between_three_speeds_the_force_is_not_known(of_three_speeds):
    bins, model = of_three_speeds
    points = bins.groupby("condition").head(1).assign(speed_mm_s=8.1)
    tested = predict(model, points)
    assert not tested["extrapolated"].any()
    between = predict(model, points.assign(speed_mm_s=20.0))
    assert between["extrapolated"].all()
    assert (
        between["note"].str.contains("too few speeds for the friction between them; tested: 1, 8, 64").all()
    )
    assert np.isfinite(between["force_after_N"]).all()


def test_a_point_with_an_infinite_number_has_no_answer(of_three_speeds):
    bins, model = of_three_speeds
    points = bins.groupby("condition").head(1)
    for name in ("load_N", "speed_mm_s"):
        for value in (np.inf, 9.9e37):
            answer = predict(model, points.assign(**{name: value}))
            assert answer["force_after_N"].isna().all()
            assert answer["note"].str.contains(f"{name} must be a").all()


def test_days_between_the_tested_ones_have_an_interval_only_if_the_scatter_of_specimens_is_known():
    bins = make_bins(temperatures=(60.0,), days=(2.0, 8.0), bins=4)
    model = close_loop(bins, make_traces(bins), TWO_FOLDS).model
    assert not model["scatter"]["of_specimens"]
    point = bins[bins["aging_days"] == 2].head(1)
    tested, between = (predict(model, point.assign(aging_days=days)).iloc[0] for days in (2.0, 4.0))
    ends = ["force_after_lo95_N", "force_after_hi95_N", "meas_lo95_N", "meas_hi95_N"]
    assert np.isfinite(tested[ends].astype(float)).all()
    assert "hold for the tested ones" in tested["note"]
    assert between[ends].isna().all()
    assert between["force_after_N"] < tested["force_after_N"]
    assert "no interval: these days were not tested" in between["note"]


@pytest.mark.parametrize(("column", "refused"), [("load_kN", True), ("load_cell", False), ("load_V", False)])
def test_a_load_in_another_unit_is_not_taken_for_the_tested_one(of_three_speeds, column, refused):
    bins, model = of_three_speeds
    points = bins.head(2).drop(columns="load_N").assign(**{column: 0.05})
    if refused:
        with pytest.raises(RequestError, match=f"load_N.*Convert {column} to N; tested from"):
            predict(model, points)
    else:
        assert np.isfinite(predict(model, points)["force_after_N"]).all()


def test_unaged_rubber_may_be_named_as_in_a_runs_table():
    bins = make_bins(temperatures=(60.0,), repeats=2, bins=4)
    model = close_loop(bins, make_traces(bins), TWO_FOLDS).model
    points = bins[bins["aging_days"] == 0].head(2)
    answer = predict(model, points)
    assert np.isfinite(answer["force_after_N"]).all()
    for word in ("unaged", "Fresh"):
        other = predict(model, points.assign(aging_days=word, temperature_C="RT", compression_ratio_pct=None))
        assert other["force_after_N"].tolist() == answer["force_after_N"].tolist()
        assert (other["aging_days"] == word).all()


def test_a_point_outside_the_tests_says_which_of_its_numbers_is(of_three_speeds):
    bins, model = of_three_speeds
    point = bins[bins["aging_days"] > 0].head(1)
    answer = predict(model, point.assign(speed_mm_s=-100.0, load_N=1e4, aging_days=1e3))
    assert answer["extrapolated"].all()
    (note,) = answer["note"]
    beyond = [text.partition(" is outside the tests: ")[0] for text in note.split("; ") if "outside" in text]
    assert beyond == ["aging_days", "speed_mm_s", "load_N"]
    assert "speed_mm_s is outside the tests: 1 to 64" in note


def test_a_direction_that_was_not_tested_is_extrapolated(of_three_speeds):
    bins, model = of_three_speeds
    points = bins.groupby("condition").head(1).drop(columns="direction")
    assert not predict(model, points)["extrapolated"].any()
    back = predict(model, points.assign(speed_mm_s=-points["speed_mm_s"]))
    assert back["extrapolated"].all()
    assert back["note"].str.contains("backward motion was not tested").all()


def test_the_direction_of_a_point_is_that_of_its_speed():
    bins = make_bins(
        temperatures=(60.0,), directions=(1, -1), bins=4, repeats=2, effect=lambda table, force: force + 1.5
    )
    model = close_loop(bins, make_traces(bins), TWO_FOLDS).model
    points = bins.groupby("direction").head(1).drop(columns="direction")
    own = np.sign(points["speed_mm_s"])
    answer = predict(model, points)["force_after_N"].tolist()
    assert predict(model, points.assign(direction=own))["force_after_N"].tolist() == answer
    assert predict(model, points.assign(direction=np.nan))["force_after_N"].tolist() == answer
    for wrong in (2 * own, -own, "up"):
        refused = predict(model, points.assign(direction=wrong))
        assert refused["force_after_N"].isna().all()
        assert (refused["note"] == "direction must be 1 or -1, and speed_mm_s must have its sign").all()


def test_a_point_in_the_gap_in_which_a_change_happened_may_lie_before_or_after_it():
    bins = make_bins(temperatures=(60.0,), bins=4)
    order = np.random.default_rng(1).permutation(bins["file"].nunique())
    bins["run_order"] = 1.0 + order[bins["run_order"].astype(int) - 1]
    bins["elapsed_h"] = 0.1 * bins["run_order"]
    late = bins["elapsed_h"] > bins["elapsed_h"].median()
    bins.loc[late, "force_N"] *= 1.2
    bins.loc[late, "elapsed_h"] += 20.0
    found = close_loop(bins, make_traces(bins), TWO_FOLDS)
    (jump,) = found.model["jumps"]
    before, after = bins.loc[~late, "elapsed_h"].max(), bins.loc[late, "elapsed_h"].min()
    assert (jump["parameter"], jump["low"], jump["high"]) == ("x_0", before, after)
    point = bins.head(1)
    first, gap, last = (
        predict(found.model, point.assign(elapsed_h=hours)).iloc[0] for hours in (before, before + 2, after)
    )
    assert gap["note"] == (
        f"step changes somewhere between elapsed_h {before:g} and {after:g}, where nothing was tested"
    )
    assert not first["note"]
    low, high = "force_after_lo95_N", "force_after_hi95_N"
    assert gap[low] == pytest.approx(first[low], rel=0.01)
    assert gap[high] == pytest.approx(last[high], rel=0.01)
    assert gap[high] / gap[low] > 1.15 > last[high] / last[low]


def test_a_curve_of_one_lot_is_read_back_and_changes_only_its_forces():
    bins = with_another_curve()
    closed = close_loop(bins, make_traces(bins), TWO_FOLDS)
    assert [effect["id"] for effect in closed.document["effects"]] == ["within"]
    read_document("closure", json.dumps(closed.document))
    model = read_document("model", json.dumps({**closed.model, "first_started_at": None}))
    points = bins[bins["repeat"] == 1].groupby(["condition", "speed_set_mm_s"]).head(1)
    own = (points["lot"] == "A").to_numpy()
    answer = predict(model, points)
    error = (answer["force_after_N"] - points["force_N"].to_numpy()).to_numpy()
    assert np.std(error[own]) < 1.2 * np.std(error[~own])
    swapped = predict(model, points.assign(lot=np.where(own, "B", "A")))["force_after_N"]
    assert (np.abs(swapped - answer["force_after_N"]) > 0).any()
