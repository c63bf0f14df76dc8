from dataclasses import replace

import bins_helpers
import numpy as np
import numpy.testing as npt
import pytest

from sealfit.closure.channels import Channel, find_channels
from sealfit.closure.errors_and_intervals import level_table
from sealfit.closure.forms import free_term, surface_term
from sealfit.closure.output import GROUPS, POINTS, channel_table, curve_table, shape_points, shape_table
from sealfit.closure.score_test import Candidate, ScoreTestResult
from sealfit.closure.selection import Selection
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.fit.joint import fit, fit_declared
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import make_rows
from sealfit.fit.joint.search import start_model


def test_curves_go_both_ways_over_the_speeds_of_each_condition_at_its_mean_load():
    table = bins_helpers.make_bins(directions=(1, -1), repeats=2, bins=4, temperatures=(60.0,))
    rng = np.random.default_rng(2)
    table["load_N"] += rng.normal(0.0, 0.5, len(table))
    table[["at", "backward", "pace", "self"]] = 1.0  # channels may have any name
    rows = make_rows(table.sample(frac=1.0, random_state=1), has_aging=True)
    fitted = fit(start_model(rows), rows, turns=1)
    curves = curve_table(fitted, fitted)
    ways = curves.groupby(["condition", np.sign(curves["speed_mm_s"])], sort=False)
    assert list(ways.size()) == [POINTS] * 10  # five conditions
    assert [sign for _, sign in ways.groups] == [1.0, -1.0] * 5
    for (condition, sign), curve in ways:
        own = table[(table["condition"] == condition) & (np.sign(table["speed_mm_s"]) == sign)]
        npt.assert_allclose(curve["load_N"], own["load_N"].mean(), rtol=1e-12)
        assert set(curve["series"]) == set(own["series"])
        reached = np.abs(curve["speed_mm_s"])
        assert (reached.min(), reached.max()) == pytest.approx((1.0, 100.0), rel=0.01)
        assert (np.sign(curve["force_after_N"]) == sign).all()
        assert (curve["force_after_lo95_N"] < curve["force_after_N"]).all()


def test_each_of_two_loads_has_curves_of_its_own():
    table = bins_helpers.make_bins(repeats=2, bins=4, temperatures=(60.0,))
    heavy = table["repeat"] == 2
    table.loc[heavy, ["load_N", "force_N"]] *= 2
    rows = make_rows(table, has_aging=True)
    fitted = fit(start_model(rows), rows, turns=1)
    curves = curve_table(fitted, fitted)
    loads = curves.groupby("condition")["load_N"].unique()
    assert all(len(own) == 2 and own[1] == pytest.approx(2 * own[0]) for own in loads)


def test_a_mean_residual_names_the_run_that_is_farthest_from_the_model():
    bins = bins_helpers.make_bins(repeats=2, bins=4, temperatures=(60.0,), setup=0.0005)
    far = bins["run_id"].iloc[-1]
    bins["force_N"] += np.where(bins["run_id"] == far, 2.0, 0.0)
    rows = make_rows(bins.assign(batch="A"), has_aging=True)
    fitted = fit_declared(rows)
    channels = {c.name: c for c in find_channels(rows)}
    selection = Selection(fitted, fitted, (), (), (), None, None, channels)
    table = channel_table(selection, fitted, fitted)
    along = table[(table["channel"] == "displacement_mm")]
    assert set(along["before_run"]) == set(along["after_run"]) == {far}
    assert (table["before_run"].isin(set(bins["run_id"]))).all()


@pytest.mark.parametrize(("added", "along"), [(True, False), (False, True)])
def test_residuals_of_friction_count_along_the_motion_where_strokes_go_both_ways(added, along):
    bins = bins_helpers.make_bins(repeats=2, bins=4, temperatures=(60.0,), directions=(1, -1), noise_N=0.02)
    bins["oil"] = bins["repeat"].astype(float)
    step = np.where(bins["repeat"] == 2, 1.0, 0.0)
    bins["force_N"] += step * (1.0 if added else np.sign(bins["speed_mm_s"]))
    rows = make_rows(bins, has_aging=True)
    fitted = fit_declared(rows)
    channels = {c.name: c for c in find_channels(rows)}
    table = channel_table(Selection(fitted, fitted, (), (), (), None, None, channels), fitted, fitted)
    own = table[table["channel"] == "oil"]
    assert set(own["along_motion"]) == {along}
    assert np.ptp(own["before_N"]) == pytest.approx(1.0, rel=0.2)


@pytest.mark.long
def test_intervals_of_mean_residuals_hold_zero_where_nothing_is_missing():
    held = []
    for seed in range(12):
        bins = bins_helpers.make_bins(repeats=2, bins=4, temperatures=(60.0,), setup=0.004, seed=seed)
        bins["batch"] = np.where(bins["repeat"] == 2, "B", "A")
        rows = make_rows(bins, has_aging=True)
        fitted = fit_declared(rows)
        channels = {c.name: c for c in find_channels(rows)}
        table = channel_table(Selection(fitted, fitted, (), (), (), None, None, channels), fitted, fitted)
        assert (table["before_half_N"] > 1e-6).sum() == table["before_half_N"].notna().sum()
        own = table[table["channel"] == "batch"]
        held += (own["before_N"].abs() <= own["before_half_N"]).tolist()
    assert np.mean(held) > 0.85


def test_partial_residuals_follow_the_data_where_the_shape_does_not():
    bins = bins_helpers.make_bins(repeats=2, temperatures=(60.0,), directions=(1, -1), noise_N=0.02, gain=0.0)
    bins["batch"] = np.where(bins["repeat"] == 2, "B", "A")
    bins["force_N"] *= 1 + 0.04 * (bins["distance_mm"] / 40) ** 2
    bins["force_N"] += np.where(bins["batch"] == "B", 1.0, 0.0)
    rows = make_rows(bins, has_aging=True)
    batch = free_term(Channel("batch", rows.values("batch"), "file"), "force", "add")
    line = Term(EFFECTS["linear"], ("distance_mm",), "mu", "multiply", {"x_ref": 20.0})
    model = start_model(rows).with_term(line, {"A": 0.0})
    fitted = fit(model.with_term(batch, {p.name: 0.0 for p in batch.effect.parameters}), rows)
    shapes = shape_table(fitted, Config())
    points = shape_points(fitted, shapes)
    along, levels = (points[points["effect"] == number] for number in (0, 1))
    assert len(along) == GROUPS
    bent = 0.04 * (along["x"] / 40) ** 2
    assert np.ptp(along["value"] - bent) < 0.002
    straight = np.interp(along["x"], *shapes.loc[shapes["effect"] == 0, ["x", "value"]].to_numpy(float).T)
    assert np.ptp(straight - bent) > 0.008
    assert along["se"].between(0.0005, 0.002).all()
    assert levels["label"].tolist() == ["A", "B"]
    assert set(levels["unit"]) == {"N"}
    assert np.diff(levels["value"]) == pytest.approx(1.0, abs=0.02)


def test_a_shape_along_the_speed_is_even_on_a_logarithmic_axis():
    speeds = tuple(np.geomspace(0.5, 200, 13))
    rows = make_rows(bins_helpers.make_bins(bins=2, temperatures=(60.0,), speeds=speeds), has_aging=True)
    rate = Term(EFFECTS["log_rate"], ("speed_mm_s",), "mu", "multiply", {"speed_mm_s_ref": 10.0})
    shapes = shape_table(fit(start_model(rows).with_term(rate, {"A": 0.0}), rows), Config())
    assert len(shapes) == POINTS
    assert np.ptp(np.diff(np.log(shapes["x"].astype(float)))) < 1e-6


def test_a_surface_is_drawn_along_both_its_channels_with_the_other_at_its_mean():
    bins = bins_helpers.make_bins(repeats=2, temperatures=(60.0,), noise_N=0.02, gain=0.0)
    bins["oil_ppm"] = bins.groupby("file").ngroup() % 7 * 10.0
    bins["force_N"] *= 1 + 0.001 * bins["oil_ppm"] * (bins["distance_mm"] / 40)
    rows = make_rows(bins, has_aging=True)
    two = [Channel(name, rows.values(name), "file") for name in ("oil_ppm", "distance_mm")]
    term = surface_term(*two, "mu", "multiply")
    fitted = fit(start_model(rows).with_term(term, dict.fromkeys(term.effect.linear, 0.0)), rows)
    shapes = shape_table(fitted, Config())
    points = shape_points(fitted, shapes)
    means = {c.name: c.values.mean() for c in two}
    for own, other in (("oil_ppm", "distance_mm"), ("distance_mm", "oil_ppm")):
        drawn = shapes[shapes["channel"] == own]
        slope = np.polyfit(drawn["x"], drawn["value"].astype(float), 1)[0]
        assert slope == pytest.approx(0.001 / 40 * means[other], rel=0.1)
        assert (points["channel"] == own).sum() > 5


def test_beside_a_free_shape_of_its_channel_an_effect_has_no_free_shape():
    """Only the sum of two free shapes of one channel is identifiable; one alone may swing anywhere."""
    rows = make_rows(bins_helpers.make_bins(bins=6, temperatures=(60.0,), noise_N=0.02), has_aging=True)
    step = Term(EFFECTS["step"], ("distance_mm",), "force", "add")
    model = start_model(rows).with_term(step, {"A": 0.1, "x_0": 20.0})
    alone = shape_table(fit(model, rows), Config())
    free = free_term(Channel("distance_mm", rows.values("distance_mm"), "sample"), "force", "add", knots=8)
    both = shape_table(fit(model.with_term(free, dict.fromkeys(free.effect.linear, 0.0)), rows), Config())
    assert alone["free"].notna().all()
    assert both["free"].isna().all()


def test_a_variable_has_the_level_at_which_it_varies():
    """Not that of the units between which it is tested: the report says the same of effects."""
    rows = make_rows(bins_helpers.make_bins(repeats=2, bins=4, temperatures=(60.0,)), has_aging=True)
    fitted = fit(start_model(rows), rows, turns=1)
    channels = {one.name: one for one in find_channels(rows)}
    result = ScoreTestResult(1.0, 1, 10, 0.0)
    candidates = [
        Candidate((name,), "mu", "multiply", "run", channels[name].values[:, None], result)
        for name in ("displacement_mm", "speed_mm_s")
    ]
    levels = level_table("after", fitted, fitted, candidates, channels).dropna(subset="channel")
    assert dict(zip(levels["channel"], levels["level"], strict=True)) == {
        "displacement_mm": "sample", "speed_mm_s": "run",
    }  # fmt: skip


def test_the_part_of_a_variable_is_what_it_explains_of_the_residual():
    rows = make_rows(bins_helpers.make_bins(repeats=3, bins=4, temperatures=(60.0,)), has_aging=True)
    fitted = fit(start_model(rows), rows, turns=1)
    shape = (rows.values("repeat") - 2.0)[:, None]
    exact = replace(fitted, force=rows.force - 0.3 * fitted.slope("mu", "multiply") * shape[:, 0])
    candidate = Candidate(("repeat",), "mu", "multiply", "file", shape, ScoreTestResult(1.0, 1, 10, -9.0))
    table = level_table("before", exact, exact, [candidate], {}).set_index("channel")
    assert table.loc["repeat", "share"] == pytest.approx(1.0)
    assert table.loc["repeat", "sd_N"] == pytest.approx(exact.rmse_N)
