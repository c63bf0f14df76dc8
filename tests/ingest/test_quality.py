import numpy as np
import pandas as pd
import pytest

from sealfit.config import Config, Quality, Strokes, parse_config
from sealfit.errors import Fault
from sealfit.ingest.averages import read_strokes
from sealfit.ingest.cells import Trace
from sealfit.ingest.columns import TraceRef
from sealfit.ingest.quality import (
    _jump,
    improbable_loads,
    incomplete_columns,
    load_faults,
    quality_table,
    repeats_of_force,
    speed_column_faults,
    stroke_faults,
    stuck_samples,
    swapped_faults,
)
from sealfit.ingest.repeat_checks import constant_strokes, other_units, outlying_files, reversed_strokes
from sealfit.ingest.strokes import Stroke, find_strokes
from sealfit.ingest.trace_checks import displacement_spikes, force_spikes, resolution
from sealfit.tables import QUALITY


def trace(n=1000, noise=0.1, step=0.0, seed=0, ripple=0.0):
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 8.0, n)
    x = 5.0 * time
    force = (30.0 + ripple * np.sin(2 * np.pi * x / 6.0)) * (1.0 - np.exp(-x / 0.3)) + rng.normal(
        0.0, noise, n
    )
    return time, x, np.round(force / step) * step if step else force


def rows_of(time, force, line=None, number=None):
    number = np.arange(len(time)) if number is None else number
    line = 2 + number if line is None else line
    return Trace(
        {"time_s": time, "force_N": force}, line, np.zeros(len(time), bool), len(time), number=number
    )


def checks(time, x, force, **quality):
    config = Config(quality=Quality(**quality))
    (stroke,) = find_strokes(time, x, force, config.strokes)
    return stroke_faults(stroke, rows_of(time, force), config.quality)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("noise", "step", "ripple"),
    [
        (0.1, 0.0, 0.0),
        (0.1, 0.01, 0.0),
        (0.1, 0.1, 0.5),
        (0.05, 0.5, 0.0),
        (0.1, 0.5, 2.0),
        (0.0, 0.0, 0.0),
        (0.0, 0.001, 0.0),
        (0.0, 0.1, 1.0),
        (0.0, 1.0, 0.0),
    ],
)
def test_a_sound_stroke_is_not_blamed_however_fine_or_coarse_its_sensor(noise, step, ripple, seed):
    assert checks(*trace(noise=noise, step=step, seed=seed, ripple=ripple)) == []


def test_clipping_at_the_sensor_s_end_is_named_with_value_and_line():
    time, x, force = trace(step=0.01)
    (fault,) = checks(time, x, np.minimum(force, 30.05))
    assert (fault.check, fault.value, fault.action, fault.column) == (
        "saturated",
        30.05,
        "stroke left out",
        "force_N",
    )
    # 30 N with an SD of 0.1 N: 31 % of the samples lie above 30.05 N.
    assert 0.26 < float(fault.reason.split("%")[0]) / 100 < 0.36
    assert force[fault.line - 2] >= 30.05
    (mirrored,) = checks(time, -x, -np.minimum(force, 30.05))
    assert mirrored.value == -30.05


def blamed(force):
    every = np.ones(len(force), bool)
    none = np.zeros(len(force))
    stroke = Stroke(0, len(force), 0, 1, 5.0, every, every, none, none + 5.0)
    time = np.linspace(0.0, 8.0, len(force))
    return [f.check for f in stroke_faults(stroke, rows_of(time, force), Quality())]


def test_a_few_samples_of_a_short_stroke_may_share_its_extreme():
    """Of 60 samples with noise of three steps five or more lie at the extreme in one of 200 strokes."""
    rng = np.random.default_rng(1)
    strokes = np.round(30.0 + rng.normal(0.0, 0.03, (4000, 60)), 2)
    top = (strokes == strokes.max(axis=1, keepdims=True)).sum(axis=1)
    many = strokes[top >= 5]
    assert len(many) > 20
    assert not any(blamed(force) for force in many)
    clipped = np.minimum(np.round(30.0 + rng.normal(0.0, 0.1, (50, 60)), 2), 30.05)
    assert sum(blamed(force) == ["saturated"] for force in clipped) > 45


def test_a_sensor_that_stops_while_the_platform_moves_is_stuck():
    time, x, force = trace(step=0.01)
    force[500:620] = force[500]
    (fault,) = checks(time, x, force)
    assert (fault.check, fault.line, fault.action) == ("stuck", 502, "stroke left out")
    assert "120 samples" in fault.reason
    force = trace(step=0.01)[2]
    force[500:530] = force[500]
    assert checks(time, x, force) == []


def test_equal_samples_are_counted_from_their_first_place():
    values = np.random.default_rng(0).normal(size=300)
    values[100:160] = 0.5
    assert stuck_samples(values, 50) == (100, 60)
    assert stuck_samples(values, 61) is None


def test_gaps_are_told_and_too_much_hidden_time_leaves_the_stroke_out():
    time, x, force = trace()
    keep = np.ones(1000, bool)
    keep[400:500] = False
    (fault,) = checks(time[keep], x[keep], force[keep])
    assert (fault.check, fault.action, fault.line) == ("gaps", "kept", 401)
    assert fault.value == pytest.approx(0.1, abs=0.002)
    keep[500:700] = False
    (fault,) = checks(time[keep], x[keep], force[keep])
    assert (fault.severity, fault.action) == ("error", "stroke left out")


def test_rows_that_the_config_filters_out_are_no_gap(tmp_path):
    time, x, force = trace()
    valve = np.r_[np.ones(400), np.zeros(300), np.ones(300)]
    table = pd.DataFrame({"time_s": time, "displacement_mm": x, "force_N": force, "valve": valve})
    rig = parse_config('[trace]\nkeep = "valve == 1"\n', "rig.toml")
    for lost, expected in ((0, []), (60, [("gaps", "kept")])):
        table.drop(index=range(100, 100 + lost)).to_csv(tmp_path / "t.csv", index=False)
        found = read_strokes(TraceRef("t.csv", {}), tmp_path, rig).faults
        assert [(fault.check, fault.action) for fault in found] == expected


def test_the_longest_gap_is_told_as_long_as_it_is_over_rows_filtered_out():
    time, x, force = trace()
    kept = np.r_[0:400, 600:1000]
    number = np.r_[0:400, 410:810]  # 190 rows are lost, and 10 are filtered out
    (stroke,) = find_strokes(time[kept], x[kept], force[kept], Strokes())
    (fault,) = stroke_faults(stroke, rows_of(time[kept], force[kept], 2 + kept, number), Quality())
    assert "after this line, is 1.61 where 0.00801 is usual" in fault.reason


def fault_of_a_sinusoid(settings):
    time = np.arange(0.0, 2.0, 0.01)
    x = -10.0 * np.cos(0.5 * np.pi * time)
    force = 20.0 + 0.1 * np.gradient(x, time)
    (stroke,) = find_strokes(time, x, force, settings)
    rows = rows_of(time, force)
    rows.columns["displacement_mm"] = x
    (fault,) = stroke_faults(stroke, rows, Quality())
    return fault


def test_where_the_displacement_jumps_the_encoder_may_have_slipped():
    time, x, force = trace()
    x[500:] += 3.0
    (stroke,) = find_strokes(time, x, force, Strokes())
    rows = rows_of(time, force)
    rows.columns["displacement_mm"] = x
    (fault,) = stroke_faults(stroke, rows, Quality())
    assert fault.fix.startswith("The displacement jumps by 3.04 at line 502: look for slip of the encoder. ")


def test_a_stroke_whose_speed_never_settles_is_kept_however_short_its_window_is():
    fault = fault_of_a_sinusoid(Strokes(min_steady_share=0.6))
    assert (fault.check, fault.action) == ("no_plateau", "kept")


def test_a_speed_that_never_settles_is_said_of_a_stroke_that_is_left_out():
    fault = fault_of_a_sinusoid(Strokes(min_samples=150))
    assert fault.check == "too_short"
    assert fault.fix.startswith("Drive at a constant speed. ")
    assert "strokes.min_samples" in fault.fix  # of a sinusoidal motion nothing else can be changed
    assert fault.reason.startswith("the speed never settles: the steady window has 25 samples")


def test_a_stroke_too_short_says_what_is_needed():
    time, x, force = trace(n=18)
    (stroke,) = find_strokes(time, x, force, Strokes())
    (fault,) = stroke_faults(stroke, rows_of(time, force), Quality())
    assert (fault.check, fault.action) == ("too_short", "stroke left out")
    assert "at least 20 are needed" in fault.reason
    assert "strokes.min_samples" in fault.fix


def spikes(time, x, force, **quality):
    found = find_strokes(time, x, force, Strokes())
    return force_spikes(force, found, 2 + np.arange(len(force)), Quality(**quality))


@pytest.mark.parametrize("place", [0, 1, 500, 998, 999])
def test_a_single_wrong_sample_is_left_out_wherever_it_stands(place):
    time, x, force = trace()
    force[place] = -1200.0
    keep, (fault,) = spikes(time, x, force)
    assert np.flatnonzero(~keep).tolist() == [place]
    assert (fault.check, fault.line, fault.value, fault.action) == (
        "spike",
        place + 2,
        -1200.0,
        "row left out",
    )


@pytest.mark.parametrize("seed", range(20))
def test_noise_ripples_and_break_away_peaks_are_no_spikes(seed):
    time, x, force = trace(seed=seed, ripple=1.0)
    force = force + 12.0 * np.exp(-(((x - 0.35) / 0.06) ** 2))  # a peak of three samples
    keep, found = spikes(time, x, force)
    assert keep.all()
    assert found == []
    heavy = trace(seed=seed)[2] + 0.1 * np.random.default_rng(seed).standard_t(3, 1000)
    assert spikes(time, x, heavy, spike_sigma=30.0)[0].all()


def test_bursts_are_the_nature_of_the_signal_and_are_said_but_kept():
    time, x, force = trace()
    force[np.random.default_rng(1).choice(np.arange(100, 1000), 30, replace=False)] += 20.0
    keep, found = spikes(time, x, force, max_bad_rows=0.01)
    assert keep.all()
    assert [(f.check, f.action) for f in found] == [("spikes", "kept")]


def test_spikes_name_their_stroke_where_there_are_several():
    time = np.arange(1600) * 0.01
    x = np.where(time < 8, 5 * time, 80 - 5 * time)
    force = np.where(time < 8, 20.0, -20.0) + np.random.default_rng(0).normal(0, 0.1, 1600)
    force[1200] = 500.0
    _, (fault,) = spikes(time, x, force)
    assert fault.stroke == 2


def test_a_displacement_that_jumps_away_and_back_is_left_out_and_a_fast_turn_is_not():
    x = trace()[1]
    x[300] += 2.0
    keep, (fault,) = displacement_spikes(x, np.arange(1000), Quality())
    assert np.flatnonzero(~keep).tolist() == [300]
    assert (fault.column, fault.line) == ("displacement_mm", 300)
    triangle = np.abs(np.arange(1000) - 500) * 0.04
    assert displacement_spikes(triangle, np.arange(1000), Quality())[0].all()


def test_resolution_is_the_smallest_step():
    assert resolution(np.array([1.0, 1.5, 3.0, 1.0])) == 0.5
    assert resolution(np.ones(3)) == 0.0


def strokes(force, **columns):
    n = len(force)
    flags = {"several": False, "extreme": False, "used": True}
    base = {
        "file": [f"f{i}" for i in range(n)],
        "stroke": 1,
        "run": "r",
        "direction": 1,
        "equal": 0.1,
        **flags,
    }
    return pd.DataFrame({**base, "force_N": force, **columns})


def test_a_force_of_the_wrong_sign_is_left_out_where_its_peers_have_the_right_one():
    keep, (fault,) = reversed_strokes(strokes([20.0, -20.0, 21.0]))
    assert keep.tolist() == [True, False, True]
    assert (fault.check, fault.file, fault.action) == ("reversed", "f1", "stroke left out")


def test_a_campaign_that_counts_force_the_other_way_is_kept_and_told():
    keep, found = reversed_strokes(strokes([-20.0, -20.0, -21.0]))
    assert keep.all()
    assert {(f.action, f.severity) for f in found} == {("kept", "warning")}
    assert "compute.force_N" in found[0].fix


def test_an_offset_larger_than_the_friction_is_no_wrong_sign():
    keep, found = reversed_strokes(strokes([3.0, 2.5, -0.4], run=["a", "b", "c"]))
    assert keep.all()
    assert len(found) == 1
    keep, found = reversed_strokes(strokes([3.0, 2.5, -2.0, -3.0], direction=[1, 1, -1, -1]))
    assert found == []


def test_a_constant_force_is_a_dead_sensor_only_where_others_show_noise():
    dead, (fault,) = constant_strokes(strokes([20.0, 21.0, 22.0], equal=[1.0, 0.05, 0.1]))
    assert dead.tolist() == [False, True, True]
    assert (fault.check, fault.action) == ("stuck", "stroke left out")
    _, (fault,) = constant_strokes(
        strokes([20.0, 21.0, 22.0], equal=[1.0, 0.05, 0.1], extreme=[True, False, False])
    )
    assert fault.check == "saturated"
    coarse, (fault,) = constant_strokes(strokes([20.0, 21.0, 22.0], equal=[1.0, 0.95, 0.8]))
    assert coarse.all()
    assert (fault.check, fault.action, fault.severity) == ("coarse", "kept", "info")
    assert constant_strokes(strokes([20.0, 20.0], equal=[1.0, 1.0]))[0].all()


def repeats(force, used=True):
    runs = np.repeat([f"r{i}" for i in range(len(force) // 3)], 3)
    return pd.DataFrame(
        {"file": [f"f{i}" for i in range(len(force))], "run_id": runs,
         "repeat": np.tile([1, 2, 3], len(force) // 3), "force_N": force, "used": used}
    )  # fmt: skip


@pytest.mark.parametrize("drop", [False, True])
def test_an_outlying_repeat_is_flagged_and_left_out_only_where_the_config_says_so(drop):
    force = 30.0 + np.random.default_rng(3).normal(0.0, 0.2, 90)
    force[40] += 6.0
    made, (fault,) = outlying_files(repeats(force), Config(quality=Quality(drop_outliers=drop)))
    assert np.flatnonzero(made["outlier"]).tolist() == [40]
    assert np.flatnonzero(~made["used"]).tolist() == ([40] if drop else [])
    assert fault.action == ("file left out" if drop else "kept")
    assert "repeat 2 of run r13 is 36." in fault.reason


def test_speed_and_load_columns_are_compared_with_what_was_measured_and_declared():
    assert speed_column_faults(5.0, -5.2, Config()) == []
    (fault,) = speed_column_faults(5.0, 300.0, Config())
    assert (fault.check, fault.action) == ("speed_disagreement", "kept")
    assert load_faults(50.0, 49.0, "N") == []
    (fault,) = load_faults(60.0, 49.03, "N")
    assert fault.reason == "measured 60 N, declared 49.03 N."


def test_a_load_that_varies_as_friction_does_beside_a_constant_force_is_a_warning():
    _, _, friction = trace()
    load = 50.0 + 0.01 * friction
    config = parse_config('[trace.columns]\nforce_N = "Fz [N]"\nload_N = {name = "Fx"}\n', "rig.toml")
    assert swapped_faults(friction, load, config) == []
    assert swapped_faults(friction, friction + 50.0, config) == []
    assert swapped_faults(load, np.zeros(len(load)), config) == []
    for other in (friction, -friction, friction * np.sign(np.arange(1000) - 500.0)):  # one way; to and fro
        (fault,) = swapped_faults(load, other, config)
        assert (fault.check, fault.severity, fault.action) == ("swapped_columns", "warning", "kept")
        assert fault.reason.startswith("'Fx' varies by ")
        assert "the force, 'Fz [N]', by " in fault.reason


def test_the_quality_table_has_a_row_per_finding_and_one_for_every_sound_file():
    faults = [
        Fault("spike", "b.", file="b", line=9, value=1.5, action="row left out", severity="warning"),
        Fault("gaps", "a.", file="b", line=3, severity="warning", action="kept"),
        Fault("not_listed", "c.", file="c", severity="info", action="file left out"),
    ]
    table = quality_table(faults, ["a", "b", "c"])
    assert table["file"].tolist() == ["a", "b", "b", "c"]
    assert table["check"].tolist() == ["ok", "gaps", "spike", "not_listed"]
    assert table["line"].tolist()[1:3] == [3, 9]
    assert table["value"].tolist()[2] == "1.5"
    assert table.columns.tolist() == QUALITY.names()
    assert quality_table([], []).columns.tolist() == QUALITY.names()


def steady_of(load, force=47.07, **more):
    rows = {
        "file": ["a.csv", "a.csv", "b.csv"],
        "force_N": [force, -force, force],
        "load_N": load,
        "used": True,
    }
    return pd.DataFrame(rows | more)


@pytest.mark.parametrize(
    ("load", "said", "fix"),
    [
        (49.03e-3, "9.6e+02 times the load in 2 of 2 files", "mN"),  # or the force in mN
        (5.0, "9.4 times the load in 2 of 2 files", "kgf"),  # 5 kg
        (5000.0, "0.0094 times the load in 2 of 2 files", "gf"),  # 5000 g
        ([49.03, 49.03, 5.0], "9.4 times the load in 1 of 2 files", "kgf"),
    ],
)
def test_a_load_in_kg_or_g_is_a_warning(load, said, fix):
    (fault,) = improbable_loads(steady_of(load), Config())
    assert (fault.check, fault.severity, fault.action, fault.column) == (
        "improbable_load",
        "warning",
        "kept",
        "load_N",
    )
    assert said in fault.reason
    assert f'unit = "{fix}"' in fault.fix


@pytest.mark.parametrize(("unit", "load"), [("kN", False), ("mN", True), ("kgf", True)])
def test_of_a_wrong_unit_that_is_declared_the_right_one_is_named(unit, load):
    own = parse_config(f'trace.columns.force_N = {{name = "F", unit = "{unit}"}}\n', "rig.toml")
    factor = {"kN": 1e3, "mN": 1e-3, "kgf": 9.80665}[unit]
    (fault,) = improbable_loads(steady_of(49.03, force=36.2 * factor), own)
    assert fault.fix.startswith("Is the force in N? Set force_N = {name = 'F', unit = \"N\"} under")
    assert ("Is the load" in fault.fix) == load


def test_of_a_few_improbable_files_the_first_is_named():
    steady = pd.DataFrame(
        {"file": ["a.csv", "b.csv", "c.csv"], "force_N": [30.0, 3100.0, 31.0], "load_N": 49.03, "used": True}
    )
    (fault,) = improbable_loads(steady, Config())
    assert "63 times the load in 1 of 3 files, such as b.csv" in fault.reason
    assert "unit =" not in fault.fix


def test_true_loads_are_not_blamed_nor_what_is_not_used_nor_a_torque():
    assert improbable_loads(steady_of(49.03), Config()) == []
    assert improbable_loads(steady_of(5.0, used=False), Config()) == []
    assert improbable_loads(steady_of(5.0).drop(columns="load_N"), Config()) == []
    torque = parse_config('[quantities]\nforce = {quantity = "torque", unit = "mN m"}\n', "rig.toml")
    assert improbable_loads(steady_of(5.0), torque) == []
    small = parse_config('[quantities]\nforce = {quantity = "friction force", unit = "mN"}\n', "rig.toml")
    assert improbable_loads(steady_of(49.03, force=47070.0), small) == []


def test_unaged_rubber_needs_no_temperature_and_aged_rubber_does():
    rows = {"file": ["a", "b", "c"], "used": True, "aging_days": [0.0, 4.0, 8.0]}
    unaged = pd.DataFrame(rows | {"temperature_C": [np.nan, 60.0, 60.0]})
    assert incomplete_columns(unaged, ["temperature_C"]) == []
    aged = pd.DataFrame(rows | {"temperature_C": [np.nan, np.nan, 60.0]})
    (fault,) = incomplete_columns(aged, ["temperature_C"])
    assert (fault.column, fault.value) == ("temperature_C", 1.0)


def test_of_a_column_of_remarks_it_is_said_how_to_leave_it_out():
    rows = {"file": ["a", "b"], "used": True, "Remark": ["cable", None], "room_C": [21.0, np.nan]}
    remarks, numbers = incomplete_columns(pd.DataFrame(rows))
    assert remarks.fix.endswith("too. If it holds remarks, list it under loop.ignore_channels.")
    assert "ignore_channels" not in numbers.fix


def test_columns_that_follow_the_force_in_all_strokes_are_named():
    force = np.array([30.0, -31.0, 40.0, -42.0, 55.0, -53.0, 61.0, -64.0, 70.0])
    steady = pd.DataFrame({"file": "a", "used": True, "force_N": force, "load_N": 50.0, "remark": "x"})
    steady = steady.assign(force_kN=np.round(np.abs(force) / 1000, 4), cof=force / 50, current_A=force**2)
    assert [fault.column for fault in repeats_of_force(steady)] == ["cof", "force_kN"]
    assert repeats_of_force(steady.head(5)) == []
    unknown = steady.assign(load_N=np.nan)
    assert [fault.column for fault in repeats_of_force(unknown)] == ["cof", "force_kN"]


def specimens_of(scale, speeds=(1.0, 10.0, 100.0)):
    """Steady strokes of specimens at a few speeds, the force of each multiplied by its scale."""
    force = {speed: 30.0 / (1 + k) for k, speed in enumerate(speeds)}
    rows = [(f"s{k}", speed, force[speed] * own) for k, own in enumerate(scale) for speed in speeds]
    table = pd.DataFrame(rows, columns=["specimen_id", "speed_mm_s", "force_N"])
    table["file"] = table["specimen_id"] + "_" + table["speed_mm_s"].astype(str) + ".csv"
    return table.assign(condition="c", speed_set_mm_s=table["speed_mm_s"], load_N=np.nan, used=True)


@pytest.mark.parametrize(("unit", "in_N"), [("kgf", 9.80665), ("lbf", 4.4482), ("kN", 1e3), ("mN", 1e-3)])
def test_specimens_whose_force_is_in_another_unit_are_named(unit, in_N):
    (fault,) = other_units(specimens_of([1.0, 0.9, 1.05 / in_N, 1.1]), Config())
    assert "in 3 files, such as s2_1.0.csv" in fault.reason
    assert fault.fix == f"Is the force of these files in {unit}? Export them again in N."


@pytest.mark.parametrize("scale", [[1.0, 0.9, 0.5, 1.1], [1.0, 0.1], [1.0, 0.3, 0.1, 2.0], [1.0]])
def test_no_unit_is_suspected_where_friction_differs_otherwise(scale):
    assert other_units(specimens_of(scale), Config()) == []
    torque = parse_config('[quantities]\nforce = {quantity = "torque", unit = "mN m"}\n', "rig.toml")
    assert other_units(specimens_of([1.0, 0.1, 1.0, 1.0]), torque) == []


@pytest.mark.parametrize("commanded", [0.0, np.nan])
def test_speeds_that_are_not_commanded_are_measured_where_units_are_compared(commanded):
    assert (
        len(other_units(specimens_of([1.0, 0.9, 0.1, 1.1]).assign(speed_set_mm_s=commanded), Config())) == 1
    )


def test_steps_of_a_coarse_encoder_are_no_jumps():
    place = np.repeat(np.arange(20.0), 50)
    rows = rows_of(np.arange(1000) * 0.01, place)
    rows.columns["displacement_mm"] = place
    assert _jump(rows, slice(0, 1000)) == ""
    assert _jump(rows, slice(0, 1)) == _jump(rows, slice(0, 40)) == ""  # nothing moves
    place[500:] += 30.0
    assert "jumps by 31 at line 502" in _jump(rows, slice(0, 1000))
