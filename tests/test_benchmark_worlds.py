import json
import sys
from dataclasses import replace

import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from worlds.campaign import draw_points, points_csv, truth_record, write_campaign
from worlds.effects import FAMILIES, Effect
from worlds.main import read
from worlds.motion import batches, force_at, integrate
from worlds.parameters import EXCLUDES_SCATTER, HOLDS_FOR_TESTED, aged_series, laws_inside
from worlds.priors import PRIORS
from worlds.run import command, copies, read_closure, true_effects
from worlds.score import (
    NONE,
    RIGHT,
    SAME_AT_DESIGN,
    Target,
    explained_by,
    grade,
    named_rightly,
    on_variables,
    scored,
)
from worlds.summary import alarmed, summarise
from worlds.true_form import candidates, make_rows, p_units, z_values
from worlds.world import draw_world

from sealfit.closure.predict import TESTED_ONLY
from sealfit.fit.aging.law_table import NO_SCATTER

SEED = "tests"
RIPPLE = Target(("displacement_mm",), (), ("trace",), ("ripple",), True)
WARM_HOT = Target(
    ("distance_mm",), ("temperature_C", "compression_ratio_pct"), ("trace",), ("warming_distance",), False
)
OFFSET_IN_WEEK = Target((), ("elapsed_h",), ("repeat",), ("step",), True)


def claim(
    id="ripple", channels=("displacement_mm",), level="trace", named=True, alternatives=(), acts_on="force"
):
    return {"id": id, "channels": list(channels), "level": level, "named": named, "acts_on": acts_on,
            "operation": "add", "alternatives": list(alternatives)}  # fmt: skip


def quiet(index, **rig):
    """A drawn world without effects, with parts of its rig replaced."""
    world = draw_world(SEED, index)
    world.effects = []
    world.rig |= rig
    return world


def steady_N(world, row, speed):
    """Eq. 14 with Eq. 15, written out by hand."""
    s = world.series[int(row["series"])]
    days = 0.0 if np.isnan(row["aging_days"]) else row["aging_days"]
    mu_s = s["mu_0s"] - s["a_s"] * np.log(1 + days / s["b_s"])
    mu_c = s["mu_0c"] - s["a_c"] * np.log(1 + days / s["b_c"])
    stribeck = mu_c + (mu_s - mu_c) * np.exp(-((speed / s["v_s"]) ** 2))
    return stribeck * row["load_N"] + s["sigma_2"] * speed


@pytest.mark.parametrize("index", range(6))
def test_a_world_is_a_campaign_within_its_priors(index):
    world = draw_world(SEED, index)
    low, high = PRIORS["files_small"].values
    assert low <= len(world.files) <= high
    assert 3 <= world.speeds_mm_s.size <= 12
    assert not world.files.duplicated(["run_id", "repeat"]).any()
    mount = world.files["specimen_id"] + world.files["repeat"].astype(str)
    assert not world.rig["mounted_anew"] or mount.ne(mount.shift()).sum() == mount.nunique()
    for own in world.series:
        assert own["mu_0s"] > own["mu_0c"] > 0
        assert own["v_s"] > 0
        assert own["mu_0c"] - own["a_c"] * np.log1p(world.days.max(initial=0) / own["b_c"]) > 0
    assert all(0 < e.strength_pct <= 20.01 for e in world.effects)
    samples = sum(b.force_N.size for b in batches(world))
    assert samples < 400_000


def test_the_same_seed_draws_the_same_world_and_another_text_another(tmp_path):
    for name in ("a", "b"):
        write_campaign(draw_world(SEED, 3), tmp_path / name)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.csv"))
    assert all((tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files)
    assert truth_record(draw_world(SEED, 3)) != truth_record(draw_world("other", 3))


@pytest.mark.parametrize("index", range(8))
def test_far_from_the_start_the_integrated_force_is_eq_14(index):
    world = quiet(index, stroke_bristles=300.0)
    world.rig["sigma_0"] *= 300.0 / draw_world(SEED, index).rig["stroke_bristles"]
    for batch in batches(world):
        last = (
            batch.plateau.shape[1] - 1 - batch.plateau[:, ::-1].argmax(axis=1)
        )  # last sample at the set speed
        for k, row in enumerate(batch.files):
            speed = abs(batch.speed_mm_s[k, last[k]])
            wanted = steady_N(world, world.files.iloc[row], speed)
            npt.assert_allclose(abs(batch.force_N[k, last[k]]), wanted, rtol=2e-3)
            assert np.sign(batch.force_N[k, last[k]]) == np.sign(batch.speed_mm_s[k, last[k]])


def test_bristles_rise_by_their_length():
    # One steady speed far above v_s, from rest: F = F_c (1 - exp(-sigma_0 s / F_c)), by hand.
    world = quiet(2, stroke_bristles=30.0, start="rest", dwell_share=0.0, sigma_1=0.0)
    for own in world.series:
        own |= {"v_s": 1e-6, "sigma_2": 0.0}
    group = world.files.index[world.files["speed_mm_s"] == world.speeds_mm_s[0]].to_numpy()[:1]
    batch = integrate(world, group)
    first = (
        int(world.rig["strokes"] > 1 and batch.force_N.shape[1] // world.rig["strokes"])
        or batch.force_N.shape[1]
    )
    F_c = steady_N(world, world.files.iloc[group[0]], 1e3)
    distance = batch.channels["distance_mm"][0, :first]
    wanted = F_c * (1 - np.exp(-world.rig["sigma_0"] * distance / F_c))
    npt.assert_allclose(np.abs(batch.force_N[0, :first]), wanted, atol=2e-3 * F_c)


def test_the_truth_at_new_points_is_the_traces_force():
    world = quiet(4, speed_error=0.0)
    world.files["_speed_error"] = 0.0
    world.effects = [Effect("ripple", (), ("displacement_mm",), "force", "add", "sine",
                            {"period": 3.0, "phase": 1.0},
                            amplitude=0.1 * world.rig["mean_N"])]  # fmt: skip
    world.rig["sigma_0"] *= 300.0 / world.rig["stroke_bristles"]  # settled soon
    batch = batches(world)[0]
    at = int(np.flatnonzero(batch.plateau[0])[-1])
    row = world.files.iloc[[batch.files[0]]]
    here = {name: [values[0, at]] for name, values in batch.channels.items()}
    point = pd.DataFrame({**{n: row[n].tolist() for n in row if not n.startswith("_")}, **here})
    point = point.assign(
        speed_mm_s=[batch.speed_mm_s[0, at]], aging_days=row["aging_days"].fillna(0.0).tolist()
    )
    npt.assert_allclose(force_at(world, point), batch.force_N[0, at], rtol=1e-3)


@pytest.mark.parametrize("index", range(4))
def test_points_lie_inside_what_was_tested(index):
    world = draw_world(SEED, index)
    points = draw_points(world)
    assert np.isfinite(force_at(world, points)).all()
    assert set(points["series"]) <= set(world.files["series"])
    speed = np.abs(points["speed_mm_s"])
    assert speed.min() >= world.speeds_mm_s[0] * 0.999
    assert speed.max() <= world.speeds_mm_s[-1] * 1.001
    assert ("aging_days" in points_csv(world, points)) == bool(world.days.size)


def test_every_family_has_a_shape_that_acts():
    seen = set()
    for index in range(60):
        world = quiet(index)
        for name, (made, here) in FAMILIES.items():
            if name not in seen and here(world):
                world.effects = [replace(made(world, np.random.default_rng(index)))]
                force = integrate(world, world.files.index.to_numpy()[:1]).force_N
                assert np.isfinite(force).all(), name
                seen.add(name)
    assert len(seen) >= len(FAMILIES) - 2, set(FAMILIES) - seen


def test_a_strong_ripple_is_seen_and_an_absent_one_is_not():
    world = quiet(5)
    ripple = Effect("ripple", ("ripple",), ("displacement_mm",), "force", "add", "sine",
                    {"period": world.rig["stroke_mm"] / 5, "phase": 0.3})  # fmt: skip
    z = {}
    for share in (0.2, 1e-6):
        world.effects = [replace(ripple, amplitude=share * world.rig["mean_N"])]
        z[share] = z_values(make_rows(world), world)[0]["z_expected"]
    assert z[0.2] > 8 > 1 > z[1e-6]


def test_what_can_be_told_is_counted_by_units_and_by_candidates():
    z = {"z": 9.0, "z_specimens": 2.0}
    npt.assert_allclose(
        [p_units(z, scatters=True), p_units(z, scatters=False)], [0.0455, 2.257e-19], rtol=1e-3
    )
    world = quiet(5)
    variables = len(world.ranges) + (world.rig["directions"] != "one") + ("batch" in world.files)
    aged = 9 if (world.days > 0).any() else 7
    assert candidates(world) == variables * aged + variables * (variables - 1)
    ripple = Effect("ripple", ("ripple",), ("displacement_mm",), "force", "add", "sine",
                    {"period": world.rig["stroke_mm"] / 5, "phase": 0.3})  # fmt: skip
    world.effects = [replace(ripple, amplitude=1e-6 * world.rig["mean_N"])]
    found = z_values(make_rows(world), world)[0]
    assert found["p_units"] >= 2e-3
    assert not found["told"]


def test_variables_of_a_claim():
    assert on_variables(RIPPLE, ["displacement_mm"])
    assert on_variables(RIPPLE, ["displacement_mm", "direction"])
    assert not on_variables(RIPPLE, ["displacement_mm", "time_s"])
    assert on_variables(WARM_HOT, ["distance_mm"])
    assert on_variables(WARM_HOT, ["distance_mm", "temperature_C"])
    assert not on_variables(WARM_HOT, ["temperature_C"])
    assert on_variables(OFFSET_IN_WEEK, ["elapsed_h"])
    assert not on_variables(OFFSET_IN_WEEK, ["run_order"])
    assert on_variables(Target(("direction",), (), ("run",), (), True), ["direction"])


def test_grades_and_names():
    assert grade(RIPPLE, claim(), 0.0) == RIGHT
    assert grade(RIPPLE, claim(level="run"), 0.0) == NONE
    assert grade(RIPPLE, claim(channels=("time_s",)), 0.99) == SAME_AT_DESIGN
    by_power = Target(
        ("distance_mm", "speed_mm_s"), (), ("trace",), ("warming_conduction", "warming_power"), False
    )
    assert grade(by_power, claim("warming_power", ("time_s", "speed_mm_s", "load_N")), 0.0) == RIGHT
    listed = [{"id": "ripple", "channels": ["displacement_mm"], "acts_on": "force"}]
    assert grade(RIPPLE, claim(channels=("time_s",), alternatives=listed), 0.0) == SAME_AT_DESIGN
    assert named_rightly(RIPPLE, claim())
    assert named_rightly(RIPPLE, claim("linear"))
    assert not named_rightly(RIPPLE, claim("drift"))
    assert named_rightly(RIPPLE, claim("drift", named=False))


def test_a_claim_stands_for_one_effect_and_the_rest_is_extra():
    result = scored([RIPPLE], [claim(), claim(), claim("linear", ("oil_ppm",), "run")], np.zeros((1, 3)))
    assert result["effects"][0]["grade"] == RIGHT
    assert (result["extra"], result["extra_on_true_variable"]) == (2, 1)
    assert scored([], [claim()], np.zeros((0, 1)))["extra"] == 1


def test_of_several_effects_of_one_variable_the_claim_is_for_the_one_it_names():
    night = Target(("elapsed_h",), (), ("run",), ("sinusoid", "day_and_night"), False)
    recalibrated = Target(("elapsed_h",), (), ("run",), ("step",), True)
    steps = [claim("step", ("elapsed_h",), "run")]
    for targets in ([night, recalibrated], [recalibrated, night]):
        graded = [e["grade"] for e in scored(targets, steps, np.zeros((2, 1)))["effects"]]
        assert graded == [RIGHT if "step" in t.names else NONE for t in targets]


def test_channels_that_order_the_rows_alike_are_one():
    hours = np.array([0.1, 0.5, 3.0, 9.0])
    table = pd.DataFrame({"elapsed_h": hours, "run_order": [1, 2, 3, 4], "oil_ppm": [3.0, 1.0, 2.0, 4.0]})
    assert copies(table, {"elapsed_h"}, {"run_order", "oil_ppm", "batch"}) == {"run_order": "elapsed_h"}


def test_a_copy_of_the_variable_explains_an_effect_and_noise_does_not():
    rng = np.random.default_rng(1)
    x, scale = rng.uniform(0, 1, 400), np.ones((400, 1))
    copied = {"copy": x + 1e-3 * rng.normal(size=400)}
    assert explained_by(copied, x**2, np.empty((400, 0)), scale) > 0.99
    assert explained_by({"noise": rng.normal(size=400)}, x**2, np.empty((400, 0)), scale) < 0.3
    assert explained_by(copied, x, np.column_stack([np.ones(400), x]), scale) < 0.01  # declared already


@pytest.mark.parametrize("coming", [False, True])
def test_a_closure_is_read_with_and_without_the_statement_of_power(coming):
    world = quiet(5)
    wave = {"period": world.rig["stroke_mm"] / 5, "phase": 0.3}
    size = 0.2 * world.rig["mean_N"]
    world.effects = [
        Effect("ripple", ("ripple",), ("displacement_mm",), "force", "add", "sine", wave, amplitude=size)
    ]
    rows, errors = make_rows(world), {"heldout_rmse_N": 1.0, "rmse_N": 1.0}
    verdict = "cannot_tell" if coming else "closed"
    closure = {"verdict": verdict, "effects": [claim()], "before": errors, "after": errors}
    closure |= {"noise_floor_N": None, "left": {}}
    if coming:
        closure |= {
            "sensitivity": [{"variable": "displacement_mm", "level": "trace", "smallest_N": 0.25}],
            "refused": [],
        }
    found = read_closure(world, rows, closure, true_effects(world, rows))
    assert (found["effects"][0]["grade"], found["extra"]) == (RIGHT, 0)
    assert found["effects"][0]["smallest_N"] == (0.25 if coming else None)
    assert found["has_sensitivity"] == coming


def record(index=0, effects=(), verdict="nothing_missing", extra=0, **more):
    return {
        "seed_text": "s", "index": index, "size": "small", "features": ["small"], "files": 9,
        "effects": list(effects), "verdict": verdict, "claims": [], "extra": extra,
        "extra_on_true_variable": 0, "exit": 0, "traceback": None,
        "seconds": 5.0, "peak_MB": 200.0, "predict_exit": 0, "points": 100, "inside": 95, "fit_quality": None,
        "refused": None, "errors": {"before": 1.0, "after": 1.0, "true_form": 0.5},
        "of_tested_specimens": {"points": 40, "inside": 38}, **more,
    }  # fmt: skip


def effect(grade=RIGHT, z=20.0):
    return {"family": "ripple", "acts_on": "force", "strength_pct": 3.0, "z": z, "clear": z >= 8,
            "grade": grade, "claimed_id": "ripple" if grade else None, "named_rightly": bool(grade),
            "smallest_N": 0.1,
            "own_rms_N": 0.1}  # fmt: skip


def test_the_summary_counts_what_the_records_say(tmp_path):
    records = [
        record(0),
        record(1, verdict="unexplained"),
        record(2, [effect()], "closed", errors={"before": 1.0, "after": 2.0, "true_form": 0.5}),
        record(3, [effect(NONE)], "cannot_tell"),
        record(4, [effect(NONE, 2.0)]),
        {**record(5), "exit": 1, "traceback": "KeyError: 'x'"},
    ]
    del records[-1]["verdict"]
    text = summarise(records)
    assert "| nothing hidden: claimed or unexplained | 1/2 = 50.0 %" in text
    assert "| clear effects found | 1/2 = 50.0 %" in text
    assert "tells among all candidates | - |" in text
    assert "| predict: error after above before by more than 5 % | 1/5 = 20.0 %" in text
    assert "cannot_tell 1" in text
    assert "traceback: KeyError: 'x'" in text
    assert "| effects of about the size that `sensitivity` states: found | 1/3" in text
    assert "tested specimens' only | 190/200 = 95.0 %" in text
    assert not alarmed(records[0])
    path = tmp_path / "r.jsonl"
    path.write_text(
        "\n".join(
            json.dumps(r) for r in [*records, {"seed_text": "s", "index": 9, "size": "small", "error": "x"}]
        )
    )
    assert [r["index"] for r in read(path)] == [0, 1, 2, 3, 4, 5]


def test_processor_time_is_that_of_all_of_a_commands_processes():
    busy = "import time\nwhile time.process_time() < 0.4: pass"
    inner = f"import subprocess, sys, time; subprocess.run([sys.executable, '-c', {busy!r}]); time.sleep(0.2)"
    command([sys.executable, "-c", busy], 60.0)  # that of another command is not counted again
    ended = command([sys.executable, "-c", inner], 60.0)
    assert ended.code == 0
    assert 0.4 <= ended.cpu_seconds < ended.seconds + 0.4


def test_the_words_by_which_intervals_say_what_they_leave_out_are_those_of_sealfit():
    assert HOLDS_FOR_TESTED in TESTED_ONLY
    assert EXCLUDES_SCATTER in NO_SCATTER


def test_intervals_of_the_law_are_held_to_the_series_truth(tmp_path):
    world = next(w for w in (draw_world(SEED, k) for k in range(20)) if (w.days > 0).sum() >= 2)
    own = aged_series(world)[0]
    rows = [
        ("mu_s", "mu_0", own["mu_0s"], 0.01, True), ("mu_c", "a", own["a_c"], 0.001, True),
        ("mu_c", "b", own["b_c"] + 9.0, 0.1, True), ("mu_s", "b", own["b_s"], 0.1, False),
    ]  # fmt: skip
    table = pd.DataFrame(rows, columns=["quantity", "parameter", "value", "half", "identified"])
    place = {name: own[name] for name in ("temperature_C", "compression_ratio_pct")}
    table = table.assign(lo95=table["value"] - table["half"], hi95=table["value"] + table["half"], **place)
    table["reason"] = ""
    table.to_parquet(tmp_path / "aging_fit.parquet")
    steady = pd.DataFrame({"parameter": ["mu_s", "mu_c"], "identified": [True, True]})
    steady.to_parquet(tmp_path / "steady_fit.parquet")
    assert laws_inside(world, tmp_path) == {"mu_0": [1, 1], "a": [1, 1], "b": [0, 1]}
    # Without a Stribeck curve mu_c is the coefficient over the tested speeds.
    steady.assign(identified=[False, True]).to_parquet(tmp_path / "steady_fit.parquet")
    assert laws_inside(world, tmp_path) == {"mu_0": [1, 1], "a": [0, 0], "b": [0, 0]}
