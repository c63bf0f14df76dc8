import math

import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from simulation_helpers import ONE_CONDITION, effect, mean_forces
from truths import true_force


def test_a_trace_rests_ramps_rises_slides_and_stops(campaign):
    _, runs, traces = campaign(
        design={**ONE_CONDITION, "speeds_mm_s": (20.0,), "dwell_s": 0.1}, physics={"sigma_0": 900.0}
    )
    trace = traces[runs["file"][0]]
    t, x, force = (trace[name].to_numpy() for name in ("time_s", "displacement_mm", "force_N"))
    assert np.all(np.diff(t) > 0)
    assert t[0] == 0
    assert len(t) <= 300
    assert (force[t < 0.09] == 0).all()
    assert (x[t < 0.09] == 0).all()
    assert x[-1] == pytest.approx(40.0)
    # The ramp of 0.2 s covers 2 mm, half of what full speed would.
    assert np.interp(0.3, t, x) == pytest.approx(2.0, abs=0.02)
    assert np.diff(x).min() >= 0
    speed = np.gradient(x, t)
    npt.assert_allclose(speed[(t > 0.4) & (t < 1.9)], 20.0, rtol=1e-4)
    # mu_s > mu_c: break-away during the ramp stands above the plateau, and the force rises from nothing
    # before it.
    plateau = force[(t > 1.0) & (t < 1.5)].mean()
    assert force[(t > 0.1) & (t < 0.4)].max() > 1.02 * plateau
    assert force[np.flatnonzero(x > 0)[0]] < 0.2 * plateau


def test_the_pre_sliding_rise_is_exponential_in_distance(campaign):
    design = {**ONE_CONDITION, "speeds_mm_s": (1.0,), "ramp_s": 0.0}
    physics = {"mu_s": {"mu_0": 0.5}, "mu_c": {"mu_0": 0.5}, "sigma_2": 0.0, "sigma_0": 0.5 * 49.03}
    _, runs, traces = campaign(design=design, physics=physics)
    trace = traces[runs["file"][0]]
    moving = trace[(trace["displacement_mm"] > 0) & (trace["displacement_mm"] < 39)]
    by_hand = 0.5 * 49.03 * (1 - np.exp(-moving["displacement_mm"]))
    npt.assert_allclose(moving["force_N"], by_hand, atol=2e-4)


def test_directions_in_separate_files_mirror_each_other(campaign):
    _, runs, traces = campaign(design={**ONE_CONDITION, "directions": (1, -1), "start_mm": 12.0})
    forward, back = (traces[f"traces/unaged_5mms_{way}_r1.csv"] for way in ("fwd", "back"))
    npt.assert_allclose(forward["force_N"], -back["force_N"])
    npt.assert_allclose(forward["displacement_mm"] - 12, 52 - back["displacement_mm"], atol=1e-9)
    assert runs["run_id"].nunique() == 6
    assert (runs["speed_mm_s"] > 0).all()


def test_strokes_both_ways_in_one_file(campaign):
    design = {**ONE_CONDITION, "directions": (1, -1), "strokes_per_file": 4, "max_rows": 2000}
    truth, runs, traces = campaign(design=design, effects=[effect("0.5 * stroke")])
    trace = traces[runs["file"][0]]
    assert len(runs) == 3
    x, force = trace["displacement_mm"].to_numpy(), trace["force_N"].to_numpy()
    turns = np.flatnonzero(np.diff(np.sign(np.diff(x)[np.diff(x) != 0])))
    assert len(turns) == 3
    # Force is positive on the way out and negative on the way back, continuous across a turn (pre-sliding).
    means = [row["mean_force_N"] for row in truth["runs"] if row["run_id"].startswith("unaged_2mms")]
    assert len(means) == 2
    free = 49.03 * (0.609 + (0.93513 - 0.609) * math.exp(-0.16)) + 0.1
    # Strokes 1 and 3, strokes 2 and 4; two strokes may differ by a row or two of about 300.
    assert means[0] == pytest.approx(free + 0.5 * 2, abs=0.005)
    assert means[1] == pytest.approx(-free + 0.5 * 3, abs=0.005)
    assert np.abs(np.diff(force)).max() < 0.4 * np.ptp(force)
    assert {row["run_id"] for row in truth["runs"]} >= {"unaged_2mms+", "unaged_2mms-"}


def test_a_turn_without_ramp_and_rest_begins_with_the_force_before_it(campaign):
    design = {**ONE_CONDITION, "directions": (1, -1), "strokes_per_file": 2, "ramp_s": 0.0, "dwell_s": 0.0}
    physics = {"mu_s": {"mu_0": 0.5}, "mu_c": {"mu_0": 0.5}, "sigma_2": 0.0, "sigma_0": 0.5 * 49.03}
    _, runs, traces = campaign(design={**design, "max_rows": 2000}, physics=physics)
    trace = traces[runs["file"][0]]
    back = trace.iloc[trace["displacement_mm"].argmax() + 1 :]
    since = 40 - back["displacement_mm"]
    # dF/dx = (-F_0 - F) / x_0 from +F_0: F = F_0 (2 exp(-x / x_0) - 1).
    npt.assert_allclose(back["force_N"], 0.5 * 49.03 * (2 * np.exp(-since) - 1), atol=0.05 * 0.5 * 49.03)
    npt.assert_allclose(back["force_N"].iloc[-500:], -0.5 * 49.03, atol=1e-5)


def test_a_stop_rises_as_far_as_the_bristles_let_it(campaign):
    design = {**ONE_CONDITION, "speeds_mm_s": (20.0,), "max_rows": 1000}
    _, runs, traces = campaign(design=design, physics={"sigma_2": 0.0, "sigma_0": 70.0})
    force = traces[runs["file"][0]]["force_N"]
    free, full = 0.609 * 49.03, 0.93513 * 49.03
    end = force.iloc[-1]
    # The last millimetres are slow, but mu_s is not reached within 0.5 mm of them; at rest the force holds.
    assert free + 0.02 * (full - free) < end < free + 0.5 * (full - free)
    npt.assert_allclose(force.iloc[-10:], end)


def test_columns_that_the_design_does_not_have_are_missing(campaign):
    _, runs, traces = campaign(
        "bare",
        design={
            **ONE_CONDITION,
            "temperatures_C": (),
            "compressions_pct": (),
            "unaged": False,
            "loads_N": (),
            "order": "undated",
            "speeds_mm_s": (50.0,),
        },
        physics={"mu_s": {"mu_0": 30.0}, "mu_c": {"mu_0": 20.0}, "sigma_2": 0.1},
    )
    assert list(runs.columns) == ["file", "run_id", "repeat", "specimen_id", "speed_mm_s"]
    # Without a load the coefficients are forces: 20 N + 0.1 * 50.
    assert mean_forces(runs, traces)[50.0] == pytest.approx(25.0, abs=1e-6)


def test_calendar_tests_each_day_when_the_rubber_is_ready(campaign):
    design = {"days": (1.0, 4.0), "repeats": 2, "max_rows": 100, "temperatures_C": (40.0, 60.0)}
    _, runs, _ = campaign(design=design)
    started = pd.to_datetime(runs["started_at"])
    elapsed_days = (started - started.min()).dt.total_seconds() / 86400
    assert ((elapsed_days - runs["aging_days"]) >= 0).all()
    assert ((elapsed_days - runs["aging_days"]) < 0.2).all()
    assert started.is_unique
    by_time = runs.assign(started=started).sort_values("started")
    assert not by_time["run_id"].drop_duplicates().is_monotonic_increasing
    assert (
        by_time["run_id"].to_numpy()[::2] == by_time["run_id"].to_numpy()[1::2]
    ).all()  # repeats follow each other


def test_randomised_order_goes_with_no_condition(campaign):
    _, runs, _ = campaign(
        design={"days": tuple(range(1, 12)), "max_rows": 50, "repeats": 1, "order": "randomised"}
    )
    rank = pd.to_datetime(runs["started_at"]).rank()
    assert abs(np.corrcoef(rank, runs["aging_days"])[0, 1]) < 0.35  # 96 runs: 3.4 standard deviations


def test_channels_vary_where_they_are_said_to(campaign):
    _, runs, traces = campaign(
        design={"days": (1.0, 2.0), "max_rows": 60, "specimens": 2},
        channels=[
            {"kind": "numeric", "name": "by_file", "level": "file"},
            {"kind": "numeric", "name": "by_run", "level": "run"},
            {"kind": "numeric", "name": "by_condition", "level": "condition"},
            {"kind": "slow", "name": "lab_C", "mean": 21, "sd": 1.0, "correlation_h": 50},
            {"kind": "trace", "name": "vibration", "sd": 2.0},
            {"kind": "category", "name": "operator", "level": "run", "labels": ["x", "y"]},
            {"kind": "category", "name": "serial", "level": "specimen", "assignment": "unique"},
            {"kind": "constant", "name": "rig", "value": "R1"},
            {"kind": "formula", "name": "age_h", "formula": "24 * aging_days"},
        ],
    )
    assert runs["by_file"].nunique() == len(runs)
    assert (runs.groupby("run_id")["by_run"].nunique() == 1).all()
    assert runs["by_run"].nunique() == runs["run_id"].nunique()
    assert runs["by_condition"].nunique() == 3
    assert set(runs["operator"]) == {"x", "y"}
    assert (runs.groupby("specimen_id")["serial"].nunique() == 1).all()
    assert runs["serial"].nunique() == 6
    assert (runs["rig"] == "R1").all()
    npt.assert_allclose(runs["age_h"], 24 * runs["aging_days"])
    ordered = runs.sort_values("started_at")["lab_C"].to_numpy()
    assert np.abs(np.diff(ordered)).mean() < 0.3 * ordered.std()
    drawn = np.concatenate([trace["vibration"] for trace in traces.values()])
    assert drawn.std() == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize(
    "design",
    [
        {"start_scatter_mm": 2.0},
        {"directions": (1, -1)},
        {"directions": (1, -1), "strokes_per_file": 3, "max_rows": 3000},
    ],
    ids=["one way", "separate files", "strokes in one file"],
)
def test_ingest_reads_a_campaign_with_the_default_config_and_finds_the_truth(campaign, tmp_path, design):
    from sealfit.config import Config
    from sealfit.ingest.campaign import ingest_campaign

    truth, _, _ = campaign(
        design={"days": (4.0,), "repeats": 2, "speeds_mm_s": (1.0, 5.0, 25.0), **design},
        effects=[
            effect("-0.06 * (1 - exp(-time_s / 3))", "mu", "multiply"),
            effect("0.5 * tanh((displacement_mm - 20) / 5) + 0.01 * distance_mm * stroke + 0.1 * direction"),
            effect("0.02 * run_order + 0.01 * elapsed_h"),
        ],
        noise=[{"kind": "white", "sd_N": 0.02}],
    )
    found = ingest_campaign(tmp_path / "c", Config())
    bins = found.tables["bins"]
    assert found.faults == []
    assert bins["file"].nunique() == len({row["file"] for row in truth["files"]})
    left = bins["force_N"] - true_force(truth, bins)
    # A bin has some 20 samples of 0.02 N; its mean position stands for a curved truth to within as much.
    assert left.abs().max() < 0.05
    assert abs(left.mean()) < 0.003
