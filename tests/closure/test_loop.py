import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from bins_helpers import (
    LOAD_N,
    MANY_SPEEDS,
    THREE_FOLDS,
    TRUE,
    TWO_FOLDS,
    make_bins,
    make_traces,
    mounted_anew,
    warm,
)

from sealfit.closure.confirm import NO_GAIN, TOO_SMALL
from sealfit.closure.loop import close_loop
from sealfit.closure.predict import predict
from sealfit.closure.result import BeforeAfter
from sealfit.config import Config
from sealfit.errors import RequestError
from sealfit.fit.joint import fit_declared
from sealfit.fit.joint.rows import make_rows
from sealfit.tables import HISTORY, RESIDUALS_AFTER, SCHEMAS

CHANNELS = {
    "lab_temperature_C": lambda rng: 22 + rng.normal(),
    "batch": lambda rng: str(rng.choice(list("ABC"))),
}
SCATTER = {"setup": 0.005, "specimen": 0.01, "run_channels": CHANNELS}


def close(bins, config=TWO_FOLDS):
    return close_loop(bins, make_traces(bins), config)


@pytest.fixture(scope="module")
def null():
    bins = make_bins(3, bins=4, **SCATTER)
    return bins, close(bins)


@pytest.fixture(scope="module")
def warming():
    bins = make_bins(3, temperatures=(60.0,), speeds=MANY_SPEEDS, bins=4, setup=0.005, effect=warm)
    return bins, close(bins, THREE_FOLDS)


def test_nothing_is_claimed_where_nothing_is_missing(null):
    document = null[1].document
    assert document["verdict"] == "nothing_missing"
    assert document["effects"] == []
    assert document["after"] == document["before"]
    assert document["left"]["channel"] is None
    assert {s["level"] for s in document["scatter"]} >= {"file", "run", "specimen"}
    assert document["noise_floor_N"] == pytest.approx(0.335, abs=0.02)  # 0.3 N a bin, 0.5 % a file of 30 N


def test_an_outlying_file_is_left_out_and_changes_nothing(null):
    bins, sound = null
    wrong = bins.assign(force_N=bins["force_N"] * np.where(bins["file"] == "f0020.csv", 1.15, 1.0))
    found = close(wrong)
    (outlier,) = found.document["outlier_files"]
    assert (outlier["file"], outlier["deviation_pct"]) == ("f0020.csv", pytest.approx(15.0, abs=2.0))
    assert "f0020.csv is" in found.document["next_runs"][0]["why"]
    assert "f0020.csv" not in set(found.tables["residuals_after"]["file"])
    assert found.document["verdict"] == sound.document["verdict"] == "nothing_missing"
    assert sound.document["outlier_files"] == []
    assert found.document["after"]["rmse_N"] == pytest.approx(sound.document["after"]["rmse_N"], rel=0.02)


def test_an_effect_too_small_to_matter_is_refused_and_leaves_nothing_missing():
    def climb(table, force):
        return force + 0.002 * table["bin"]

    bins = make_bins(3, temperatures=(60.0,), bins=4, noise_N=0.003, gain=1e-6, effect=climb)
    document = close(bins).document
    assert document["refused"][0]["id"] == "linear"
    assert document["refused"][0]["reason"] == TOO_SMALL
    assert {refused["reason"] for refused in document["refused"]} == {TOO_SMALL, NO_GAIN}
    assert document["verdict"] == "nothing_missing"
    assert document["left"]["channel"] is None


def test_scatter_is_what_was_put_in(null):
    found = {s["level"]: s["sd_rel"] for s in null[1].document["scatter"]}
    assert found["file"] == pytest.approx(0.005, rel=0.25)
    assert found["run"] == pytest.approx(0.005, rel=0.4)
    assert found["specimen"] == pytest.approx(0.01, rel=0.7)  # nine pieces of rubber


def test_warming_is_found_named_and_confirmed(warming):
    document = warming[1].document
    assert document["verdict"] == "closed"
    (effect,) = document["effects"]
    assert (effect["id"], effect["channels"], effect["acts_on"]) == ("warming_time", ["time_s"], "mu")
    assert (effect["operation"], effect["level"], effect["named"]) == ("multiply", "trace", True)
    values = {p["name"]: p for p in effect["parameters"]}
    assert values["A"]["value"] == pytest.approx(0.05, abs=0.003)
    assert values["tau"]["value"] == pytest.approx(3.0, rel=0.15)
    assert values["A"]["ci95"][0] < values["A"]["value"] < values["A"]["ci95"][1]
    assert effect["p_value"] <= 0.005
    assert document["after"]["heldout_rmse_N"] < 0.9 * document["before"]["heldout_rmse_N"]
    assert effect["heldout_gain_N"] > 0


def test_document_is_json_and_tables_keep_their_schemas(warming):
    bins, closure = warming
    json.dumps(closure.document, allow_nan=False)
    json.dumps(closure.model, allow_nan=False)
    for name, table in closure.tables.items():
        missing = (
            set(SCHEMAS[name].names()) - set(table.columns) - {*HISTORY, "presliding_N", "speed_bin_mm_s"}
        )
        assert not missing, (name, missing)
    after = closure.tables["residuals_after"]
    assert len(after) == len(bins)
    npt.assert_array_equal(after["file"], bins["file"])
    npt.assert_allclose(after["residual_N"], after["force_N"] - after["model_N"], atol=1e-12)
    assert after["weight"].sum() == pytest.approx(1.0)
    rmse = np.sqrt(after["weight"] @ after["residual_N"] ** 2)
    assert rmse == pytest.approx(closure.document["after"]["rmse_N"])
    lacking = {"presliding_N", "speed_bin_mm_s", "specimen_use"}  # of bins made without traces
    assert set(RESIDUALS_AFTER.names()) - lacking <= set(after.columns)


def test_a_repeat_of_the_loop_gives_the_same_to_the_last_digit(null):
    bins, closure = null
    again = close(bins)
    assert json.dumps(again.document) == json.dumps(closure.document)


@pytest.mark.long
def test_a_search_of_a_part_ends_with_the_numbers_of_a_search_of_all(warming, monkeypatch):
    bins, whole = warming
    monkeypatch.setattr("sealfit.closure.subsampling.RUNS", 1)
    monkeypatch.setattr("sealfit.closure.subsampling.STROKES", 120)
    said = []
    part = close_loop(bins, make_traces(bins), THREE_FOLDS, on_progress=said.append)
    assert not any("show more" in text for text in said)
    (one,), (other,) = part.document["effects"], whole.document["effects"]
    assert (one["id"], one["channels"]) == (other["id"], other["channels"])
    for own, full in zip(one["parameters"], other["parameters"], strict=True):
        assert own["value"] == pytest.approx(full["value"], rel=1e-4)
        assert own["ci95"] == pytest.approx(full["ci95"], rel=1e-3)
    for name in ("before", "after"):
        own, full = part.document[name], whole.document[name]
        assert own["rmse_N"] == pytest.approx(full["rmse_N"], rel=1e-4)
        assert own["heldout_rmse_N"] == pytest.approx(full["heldout_rmse_N"], rel=5e-3)
    assert not part.tables["residuals_after"]["heldout_model_N"].isna().any()


def points_of(bins):
    return bins.groupby("run_id", sort=False).first().reset_index()


def test_predict_carries_the_effect_and_agrees_with_the_fit(warming):
    bins, closure = warming
    ends, after = (t.groupby("run_id", sort=False).last() for t in (bins, closure.tables["residuals_after"]))
    answer = predict(closure.model, ends.reset_index())
    npt.assert_allclose(answer["force_after_N"], after["model_N"], rtol=1e-3)  # there the mean over a bin
    assert (answer["force_after_lo95_N"] < answer["force_after_N"]).all()
    assert (
        answer["meas_hi95_N"] - answer["meas_lo95_N"]
        > answer["force_after_hi95_N"] - answer["force_after_lo95_N"]
    ).all()
    assert not answer["extrapolated"].any()
    assert (answer["note"] == "").all()


def test_predict_follows_the_law_between_days_and_says_where_it_ends(warming):
    bins, closure = warming
    points = points_of(bins).iloc[[20, 20, 20, 20]].reset_index(drop=True)
    points["aging_days"] = [6.0, 40.0, 4.0, 4.0]
    points["temperature_C"] = [60.0, 60.0, 70.0, 60.0]
    points["compression_ratio_pct"] = 80.0
    points.loc[3, "speed_mm_s"] = np.nan
    answer = predict(closure.model, points)
    assert answer["extrapolated"].tolist() == [False, True, False, False]
    assert answer["force_after_N"].isna().tolist() == [False, False, True, True]
    assert "was not tested" in answer["note"][2]
    assert "speed_mm_s" in answer["note"][3]


def test_predict_refuses_a_request_without_a_channel_of_the_model(warming):
    points = points_of(warming[0]).drop(columns=["time_s"])
    with pytest.raises(RequestError, match=r"time_s.*missing"):
        predict(warming[1].model, points)


def test_what_too_few_specimens_show_is_a_candidate_and_in_no_model():
    bins = make_bins(1, temperatures=(60.0,), repeats=2, bins=4, specimen=0.0003)
    rng = np.random.default_rng(3)
    hardness = {piece: rng.normal(70, 3) for piece in bins["specimen_id"].unique()}
    bins["hardness_ShA"] = bins["specimen_id"].map(hardness)
    speed, slower = bins["speed_mm_s"], 1 + 0.04 * (bins["hardness_ShA"] - 70)  # v_s follows the hardness
    bins["force_N"] += 15 * (np.exp(-((speed / (15 * slower)) ** 2)) - np.exp(-((speed / 15) ** 2)))
    # Three degrees of freedom are left: however strong, F says no more than 0.004 to 0.009 after all that is
    # searched.
    made = close_loop(bins, make_traces(bins), Config(loop={"family_error": 0.02, "folds": 2}))
    document = made.document
    assert document["verdict"] == "cannot_tell"
    (effect,) = document["effects"]
    assert effect["candidate"]
    assert (effect["channels"], effect["acts_on"], effect["level"]) == (["hardness_ShA"], "v_s", "condition")
    assert document["after"]["rmse_N"] == document["before"]["rmse_N"]
    assert made.tables["effects"].empty
    shape, points = made.tables["shapes"], made.tables["shape_points"]
    assert set(shape["effect"]) == set(points["effect"]) == {0}
    assert set(points["x"]) <= set(hardness.values())
    line = np.polyfit(points["x"].astype(float), points["value"], 1)
    assert line[0] == pytest.approx(0.04, rel=0.2)
    assert any("another specimen" in run["why"] for run in document["next_runs"])
    points = bins[bins["speed_set_mm_s"] == 16.0].drop_duplicates("specimen_id")
    alone = predict(made.model | {"unconfirmed": []}, points)
    answer = predict(made.model, points)
    anyone = predict(made.model, points.drop(columns="hardness_ShA"))
    assert answer["note"].str.contains(f"not confirmed: {effect['label']}", regex=False).all()
    assert (answer["force_after_N"] == alone["force_after_N"]).all()
    widths = [made["force_after_hi95_N"] - made["force_after_lo95_N"] for made in (alone, answer, anyone)]
    assert (widths[0] <= widths[1]).all()
    assert (widths[1] <= widths[2]).all()
    assert widths[1].max() > widths[0].max() + 0.1
    assert widths[2].min() > widths[0].min() + 0.1


@pytest.mark.long
def test_an_effect_of_sliding_power_is_found_and_predicted_from_load_and_speed():
    def warm_when_hard_driven(table, force):
        load = 50.0 * 2.0 ** (table["repeat"].to_numpy() - 2.0)
        return (
            force
            * load
            / 49.03
            * (1 - 0.1 * np.exp(-((np.log(load * table["speed_mm_s"].abs() / 400) / 0.7) ** 2)))
        )

    bins = make_bins(3, temperatures=(60.0,), effect=warm_when_hard_driven, bins=2, setup=0.003, noise_N=0.1)
    bins["load_N"] = 50.0 * 2.0 ** (bins["repeat"] - 2.0)
    bins["run_id"] = bins["run_id"] + "|" + bins["load_N"].astype(str)
    made = close(bins)
    assert {"power"} in [set(e["channels"]) for e in made.document["effects"]]
    point = bins.head(1).assign(speed_mm_s=8.0, load_N=50.0)
    there, beyond = (predict(made.model, point.assign(load_N=load)) for load in (50.0, 25.0))
    ratio = (there["force_after_N"] / there["force_before_N"]).iloc[0]
    assert ratio < (beyond["force_after_N"] / beyond["force_before_N"]).iloc[0]


def test_too_few_specimens_to_show_their_scatter_are_said_to_be(null):
    bins = make_bins(1, temperatures=(60.0,), days=(1.0, 4.0, 16.0), repeats=2, bins=4, specimen=0.01)
    made = close(bins)
    assert "specimen" not in {s["level"] for s in made.document["scatter"]}
    assert any("scatter of specimens" in run["why"] for run in made.document["next_runs"])
    answer = predict(made.model, bins.head(2))
    assert answer["note"].str.contains("scatter of specimens is not known").all()
    assert answer["force_after_N"].notna().all()
    assert not any("scatter of specimens" in run["why"] for run in null[1].document["next_runs"])


def test_what_ripples_gain_is_seen_inside_strokes():
    rows = make_rows(make_bins(0), has_aging=True)
    fitted = fit_declared(rows)
    run = np.random.default_rng(0).normal(0, 3, rows.groups.starts["run"].size)[rows.codes("run")]
    wave = np.sin(rows.values("displacement_mm"))

    every = np.ones(run.size, dtype=bool)

    def ends(rise, left=0.0, determined=every):
        held = rows.force - run - wave, rows.force - rise * run - left * wave
        return BeforeAfter(fitted, fitted, *held, every, determined)

    assert not ends(1.1).gains(None, weak=False)
    assert ends(1.1).gains("stroke", weak=False)
    assert not ends(1.2).gains("stroke", weak=False)
    assert ends(1.1).gains("stroke", weak=True)
    assert ends(1.1, left=0.8).gains("stroke", weak=False)
    assert not ends(1.1, left=0.8).gains("stroke", weak=True)
    assert not ends(1.015, left=0.8).gains("stroke", weak=True)  # the whole error grows by less than 0.5 %
    assert ends(1.0, left=0.8).gains("stroke", weak=True)
    assert ends(40.0, determined=~every).gains("stroke", weak=False)
    assert not ends(40.0, left=1.1, determined=~every).gains("stroke", weak=False)
    assert ends(40.0, determined=~every).gains("specimen", weak=False)  # of runs at other speeds
    assert not ends(40.0).gains("specimen", weak=False)
    rippled = replace(ends(1.2), before=SimpleNamespace(rows=rows, residual=fitted.residual + 9 * wave))
    assert rippled.gains("stroke", weak=False)  # halved in sample and held out
    assert not rippled.gains("stroke", weak=True)


def of_two_loads(**options):
    """Bins of a campaign at two loads, with a force of 0.001 N s^2/mm^2 times the square of the speed."""
    tables = []
    for load_N in (20.0, 60.0):

        def force_at(table, force, load_N=load_N):
            speed = table["speed_mm_s"].to_numpy()
            viscous = TRUE["sigma_2"] * speed
            return (force - viscous) * load_N / LOAD_N + viscous + 1e-3 * speed * np.abs(speed)

        bins = make_bins(int(load_N), effect=force_at, **options)
        names = {name: bins[name].astype(str) + f" {load_N:g} N" for name in ("file", "run_id")}
        tables.append(bins.assign(load_N=load_N, **names))
    return pd.concat(tables, ignore_index=True)


@pytest.mark.long
def test_friction_by_a_power_of_the_speed_alone_is_told_from_that_of_the_load():
    bins = of_two_loads(temperatures=(60.0,), days=(4.0,), bins=3, repeats=2, **SCATTER)
    (found,) = close(bins).document["effects"]
    assert (found["id"], found["channels"][-1]) == ("power_viscous", "speed_mm_s")
    values = {p["name"]: p["value"] for p in found["parameters"]}
    assert values["n"] == pytest.approx(2.0, abs=0.3)


@pytest.mark.long
def test_an_effect_between_set_ups_is_found_beside_a_wrong_file_and_its_level_is_theirs():
    bins = mounted_anew(3)
    oil = 2.0 * (bins["mount"].to_numpy() % 4)
    wrong = np.where(bins["file"] == "f0008.csv", 0.5, 1.0)
    bins = bins.assign(oil_ppm=oil, force_N=bins["force_N"] * (1 + 0.03 * oil) * wrong)
    made = close(bins)
    assert [one["file"] for one in made.document["outlier_files"]] == ["f0008.csv"]
    (found,) = made.document["effects"]
    assert (found["channels"], found["level"]) == (["oil_ppm"], "set_up")
    assert made.document["heldout_unit"] == "set-up"
    assert {"set_up", "file"} <= {scatter["level"] for scatter in made.document["scatter"]}
    assert "run" not in set(made.tables["levels"]["level"])
    assert "run" not in {entry["level"] for entry in made.document["sensitivity"]}


def test_a_speed_held_out_of_three_is_not_determined_by_the_other_two():
    bins = make_bins(
        1, temperatures=(60.0, 70.0, 80.0), days=(4.0,), speeds=(0.5, 5.0, 50.0), bins=4, **SCATTER
    )
    made = close(bins[bins["aging_days"] > 0]).document
    assert made["heldout_unit"] == "run"
    assert made["before"]["heldout_rmse_N"] is None
    assert made["before"]["heldout_extrapolated_rmse_N"] > 0


def test_weak_evidence_needs_a_lower_error_on_what_was_held_out():
    rows = make_rows(make_bins(0), has_aging=True)
    fitted = fit_declared(rows)
    noise = np.random.default_rng(0).normal(0, 1, rows.force.size)

    def ends(left):
        every = np.ones(noise.size, dtype=bool)
        return BeforeAfter(fitted, fitted, rows.force - noise, rows.force - left * noise, every, every)

    assert ends(1.0).gains(None, weak=False)
    assert not ends(1.0).gains(None, weak=True)
    assert ends(0.999).gains(None, weak=True)
    assert not ends(1.0).gains("stroke", weak=True)
