import os
from pathlib import Path

import numpy as np
import numpy.testing as npt
import pandas as pd
import pyarrow as pa
import pytest

from sealfit.closure.channels import channels_of
from sealfit.config import Bins, Config, Strokes
from sealfit.errors import CampaignError
from sealfit.fit.joint.rows import LEVELS, make_rows
from sealfit.ingest.campaign import ingest_campaign
from sealfit.ingest.columns import force_inputs
from sealfit.report import summary, summary_lines
from sealfit.store.manifest import ConfigCopy
from sealfit.tables import SCHEMAS

TABLES = ["inputs", "runs", "quality", "traces", "traces_mean", "steady", "bins"]
PAIR = r"traces/(?P<run>\d)_(?P<repeat>\d)\.csv"
MEASURED = os.environ.get("SEALFIT_MEASURED")


def write_trace(path, *, level=30.0, speed=5.0, sign=1, n=500, seed=0, way=40.0, both=False, **columns):
    """One stroke, or one there and back, of `way` mm at `speed`, with a rise over 0.3 mm and 0.1 N noise."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, way / speed, n)
    x = speed * time
    force = level * (1.0 - np.exp(-x / 0.3))
    if both:
        time = np.concatenate([time, time[-1] + time[1:]])
        x = np.concatenate([x, way - x[1:]])
        force = np.concatenate([force, -level + 2 * level * np.exp(-speed * (time[n:] - time[n - 1]) / 0.3)])
    table = pd.DataFrame({"time_s": time, "displacement_mm": sign * x, "force_N": sign * force})
    table["force_N"] = (table["force_N"] + rng.normal(0.0, 0.1, len(table))).round(4)
    table = table.assign(**columns)
    path.parent.mkdir(exist_ok=True, parents=True)
    table.to_csv(path, index=False)
    return table


def row(file, run_id, repeat, days=4, speed=5.0, load=49.03, **more):
    cells = {
        "file": file,
        "run_id": run_id,
        "repeat": repeat,
        "temperature_C": 60,
        "compression_ratio_pct": 80,
    }
    return {**cells, "aging_days": days, "load_N": load, "speed_mm_s": speed, **more}


def write_campaign(folder, rows):
    folder.mkdir(exist_ok=True, parents=True)
    pd.DataFrame(rows).to_csv(folder / "runs.csv", index=False)
    return folder


@pytest.fixture
def campaign(tmp_path):
    """Two runs of three repeats (day 0 at 5 mm/s, day 4 at 10 mm/s), with a channel of their own."""
    rows = []
    for run, (days, speed) in enumerate([(0, 5.0), (4, 10.0)]):
        for repeat in (1, 2, 3):
            file = f"traces/{run}_{repeat}.csv"
            level = 30.0 - 5 * run + 0.2 * repeat
            write_trace(tmp_path / "c" / file, level=level, speed=speed, seed=10 * run + repeat)
            rows.append(
                row(file, f"run{run}", repeat, days, speed, oil="abc"[repeat - 1], humidity_pct=40 + repeat)
            )
    return write_campaign(tmp_path / "c", rows)


def findings(ingested, file):
    quality = ingested.tables["quality"]
    return quality[quality["file"] == file]


def test_the_summary_names_files_that_are_no_traces_and_says_why(campaign):
    for name in ("more", "notes"):
        (campaign / f"traces/{name}.csv").touch()
    made = ingest_campaign(campaign, Config(files={"exclude": ["*/no*"], "glob": "traces/*"}))
    assert made.faults == []
    lines = summary_lines.ingest_lines(summary.of_ingest(made.tables))
    assert [text.strip() for text in lines[:2]] == [
        "files       6 used, 0 left out",
        "1 not in the table of runs: traces/more.csv",
    ]
    (campaign / "runs.csv").unlink()
    config = Config(condition=["run"], files={"exclude": ["*/no*"], "glob": "traces/*", "name_pattern": PAIR})
    lines = summary_lines.ingest_lines(summary.of_ingest(ingest_campaign(campaign, config).tables))
    assert sorted(text.strip() for text in lines[1:3]) == [
        "1 excluded by files.exclude: traces/notes.csv",
        "1 not matched by the file-name pattern: traces/more.csv",
    ]


def test_a_campaign_becomes_all_tables_with_their_schemas(campaign):
    seen = []
    made = ingest_campaign(campaign, Config(), on_file=lambda done, of: seen.append((done, of)))
    assert set(made.tables) == set(TABLES)
    assert seen == [(6, 6)]
    assert made.faults == []
    for name in TABLES:
        schema, table = SCHEMAS[name], made.tables[name]
        assert table.columns[: len(schema.columns)].tolist() == schema.names()
        for column in schema.columns:  # every column can be written as the type that the schema says
            written = pa.Array.from_pandas(table[column.name], type=column.dtype, safe=True)
            assert len(written) == len(table)
        if not schema.open_:
            assert len(table.columns) == len(schema.columns)


def test_steady_has_the_means_and_the_keys_of_every_stroke(campaign):
    steady = ingest_campaign(campaign, Config()).tables["steady"]
    assert steady["condition"].unique().tolist() == [
        "unaged",
        "temperature_C=60, compression_ratio_pct=80, aging_days=4",
    ]
    npt.assert_allclose(steady["force_N"], [30.2, 30.4, 30.6, 25.2, 25.4, 25.6], atol=0.02)
    npt.assert_allclose(steady["speed_mm_s"], [5.0] * 3 + [10.0] * 3, rtol=1e-3)
    npt.assert_allclose(steady["speed_set_mm_s"], [5.0] * 3 + [10.0] * 3)
    npt.assert_allclose(steady["force_sd_N"], 0.1, atol=0.015)
    npt.assert_allclose(steady["force_se_N"], 0.1 / np.sqrt(steady["n"]), rtol=0.5)
    npt.assert_allclose(steady["displacement_mm"], (steady["displacement_from_mm"] + 40.0) / 2, atol=0.05)
    npt.assert_allclose(steady["distance_mm"], steady["displacement_mm"], atol=1e-9)
    assert (steady["load_N"] == 49.03).all()
    assert steady["oil"].tolist() == ["a", "b", "c"] * 2
    assert steady["humidity_pct"].tolist() == [41.0, 42.0, 43.0] * 2
    assert not steady["outlier"].any()
    assert steady["used"].all()


def test_bins_are_means_of_the_steady_samples_of_traces(campaign):
    tables = ingest_campaign(campaign, Config(bins=Bins(per_stroke=8))).tables
    bins, traces = tables["bins"], tables["traces"]
    assert bins.groupby("file")["bin"].apply(list).tolist() == [list(range(8))] * 6
    inside = traces[traces["steady"]].groupby("file")
    weighted = bins.assign(sum=bins["n"] * bins["force_N"]).groupby("file")
    assert (weighted["n"].sum() == inside.size()).all()
    npt.assert_allclose(weighted["sum"].sum(), inside["force_N"].sum() - inside["presliding_N"].sum())
    assert bins["oil"].notna().all()
    assert (bins["speed_mm_s"] > 0).all()
    npt.assert_allclose(bins["time_s"] * bins["speed_mm_s"], bins["displacement_mm"], atol=0.05)


def test_traces_hold_every_sample_and_nothing_else(campaign):
    traces = ingest_campaign(campaign, Config()).tables["traces"]
    one = pd.read_csv(campaign / "traces" / "0_1.csv")
    mine = traces[traces["file"] == "traces/0_1.csv"]
    npt.assert_allclose(mine[list(one.columns)], one)
    assert len(traces) == 6 * 500
    assert 0.85 < mine["steady"].mean() < 0.97


def test_repeats_are_averaged_with_the_standard_error_of_the_repeats(campaign):
    mean = ingest_campaign(campaign, Config()).tables["traces_mean"]
    inside = mean[mean["steady"] & (mean["run_id"] == "run0")]
    assert (
        inside["n"] == 3
    ).mean() > 0.97  # the windows of the three end within a few samples of one another
    inside = inside[inside["n"] == 3]
    assert inside["force_N"].mean() == pytest.approx(30.4, abs=0.02)
    # Levels 0.2 N apart and noise of 0.1 N: SE = sqrt((0.04 + 0.01) / 3).
    assert np.sqrt((inside["force_se_N"] ** 2).mean()) == pytest.approx(np.sqrt(0.05 / 3), rel=0.1)


def test_files_with_strokes_both_ways_are_two_runs(tmp_path):
    for repeat in (1, 2, 3):
        write_trace(tmp_path / f"{repeat}.csv", both=True, seed=repeat, level=30 + repeat)
    write_campaign(tmp_path, [row(f"{r}.csv", "swing", r) for r in (1, 2, 3)])
    tables = ingest_campaign(tmp_path, Config()).tables
    steady = tables["steady"]
    assert steady["run_id"].tolist() == ["swing+", "swing-"] * 3
    assert steady["stroke"].tolist() == [1, 2] * 3
    assert steady["direction"].tolist() == [1, -1] * 3
    npt.assert_allclose(steady["force_N"], [31, -31, 32, -32, 33, -33], atol=0.03)
    npt.assert_allclose(steady["speed_mm_s"], [5, -5] * 3, rtol=2e-3)
    # Time counts from the stroke's first row, distance from its start; displacement is never re-zeroed.
    npt.assert_allclose(steady["time_s"] * 5.0, steady["distance_mm"], atol=0.15)
    traces = tables["traces"]
    second = traces[(traces["file"] == "1.csv") & (traces["stroke"] == 2)]
    assert second["time_s"].iloc[0] == 0.0
    assert second["distance_mm"].iloc[0] == 0.0
    assert second["displacement_mm"].iloc[0] == pytest.approx(40.0, abs=0.1)
    assert set(tables["traces_mean"]["run_id"]) == {"swing+", "swing-"}


@pytest.mark.parametrize("numbered", [True, False])
def test_a_record_split_into_files_of_one_stroke_is_one_record(tmp_path, numbered):
    whole, split = [], []
    for repeat in (1, 2, 3):
        both = write_trace(tmp_path / "whole" / f"{repeat}.csv", seed=repeat, both=True)
        whole.append(row(f"{repeat}.csv", "a", repeat))
        for stroke, part in enumerate((both[:500], both[499:]), start=1):
            file = f"{repeat}_{stroke}.csv"
            (tmp_path / "split").mkdir(exist_ok=True)
            part.assign(time_s=part["time_s"] - part["time_s"].iloc[0]).to_csv(
                tmp_path / "split" / file, index=False
            )
            split.append(row(file, "a", repeat, stroke=stroke))
    found = []
    for name, rows in (("whole", whole), ("split", split)):
        listed = pd.DataFrame(rows).drop(columns=[] if numbered else "repeat")
        found.append(ingest_campaign(write_campaign(tmp_path / name, listed), Config(), workers=1).tables)
    keys = ["run_id", "repeat", "stroke"]
    one, other = (tables["steady"].sort_values(keys).reset_index(drop=True) for tables in found)
    assert one[keys].equals(other[keys])
    npt.assert_allclose(one["force_N"], other["force_N"], atol=0.01)
    one, other = (make_rows(tables["bins"], has_aging=True).groups.starts for tables in found)
    assert [len(one[level]) for level in LEVELS] == [len(other[level]) for level in LEVELS] == [6, 3, 1, 1]


def test_runs_of_one_direction_keep_their_names(campaign):
    assert set(ingest_campaign(campaign, Config()).tables["runs"]["run_id"]) == {"run0", "run1"}


def test_a_load_measured_while_sliding_is_used_and_compared_with_the_declared_one(tmp_path):
    rng = np.random.default_rng(0)
    for repeat in (1, 2):
        write_trace(
            tmp_path / f"{repeat}.csv", load_N=60.0 + rng.normal(0, 0.1, 500), oil_C=np.linspace(20, 30, 500)
        )
    write_campaign(tmp_path, [row("1.csv", "r", 1, load=49.03), row("2.csv", "r", 2, load=49.03)])
    made = ingest_campaign(tmp_path, Config())
    npt.assert_allclose(made.tables["steady"]["load_N"], 60.0, atol=0.05)
    npt.assert_allclose(made.tables["bins"]["load_N"], 60.0, atol=0.2)
    assert findings(made, "1.csv")["check"].tolist() == ["load"]
    bins = made.tables["bins"]
    npt.assert_allclose(bins["oil_C"], 20.0 + 10.0 * bins["time_s"] / 8.0, atol=0.05)
    assert "oil_C" in made.tables["traces"].columns


def test_a_run_measured_at_several_loads_is_a_run_for_each_with_repeats_of_its_own(tmp_path):
    rng = np.random.default_rng(0)
    rows = []
    for repeat, load in enumerate((20.0, 45.0, 20.5, 44.0), 1):
        write_trace(tmp_path / f"{repeat}.csv", load_N=load + rng.normal(0, 0.1, 500))
        rows.append(row(f"{repeat}.csv", "r", repeat))
        del rows[-1]["load_N"]
    write_campaign(tmp_path, rows)
    runs = ingest_campaign(tmp_path, Config()).tables["runs"].sort_values("file")
    assert runs["run_id"].tolist() == ["r, load 20.3", "r, load 44.5"] * 2
    assert runs["repeat"].tolist() == [1, 1, 2, 2]


def test_a_load_that_differs_between_the_directions_of_a_file_makes_no_run_of_its_own(tmp_path):
    rows = []
    for repeat in (1, 2):
        write_trace(tmp_path / f"{repeat}.csv", both=True, load_N=np.repeat([45.0, 55.0], [500, 499]))
        rows.append(row(f"{repeat}.csv", "r", repeat))
        del rows[-1]["load_N"]
    write_campaign(tmp_path, rows)
    assert set(ingest_campaign(tmp_path, Config()).tables["runs"]["run_id"]) == {"r+", "r-"}


def test_without_a_load_anywhere_it_is_null_in_every_table(tmp_path):
    write_trace(tmp_path / "1.csv")
    cells = row("1.csv", "r", 1)
    del cells["load_N"]
    write_campaign(tmp_path, [cells])
    tables = ingest_campaign(tmp_path, Config()).tables
    assert all(tables[name]["load_N"].isna().all() for name in ("runs", "steady", "bins"))
    assert tables["traces_mean"]["force_se_N"].isna().all()


def test_one_bad_cell_costs_its_row_and_a_bad_file_costs_itself_and_both_are_in_quality(campaign):
    path = campaign / "traces" / "0_1.csv"
    lines = path.read_text().splitlines()
    lines[100] = lines[100].rsplit(",", 1)[0] + ",oops"
    path.write_text("\n".join(lines) + "\n")
    (campaign / "traces" / "1_2.csv").write_text("nothing here\n")
    made = ingest_campaign(campaign, Config())
    bad = findings(made, "traces/0_1.csv")
    assert bad[["line", "column", "action"]].values.tolist() == [[101, "force_N", "row left out"]]
    assert (made.tables["traces"]["file"] == "traces/0_1.csv").sum() == 499
    assert findings(made, "traces/1_2.csv")["action"].tolist()[-1] == "file left out"
    inputs = made.tables["inputs"].set_index("file")
    assert inputs.loc["traces/1_2.csv", "status"] == "left out"
    assert inputs.loc["traces/0_1.csv", "status"] == "used"
    assert "traces/1_2.csv" not in set(made.tables["steady"]["file"])
    assert {fault.file for fault in made.faults} == {"traces/0_1.csv", "traces/1_2.csv"}


def test_a_spike_costs_its_row_and_does_not_move_the_mean(campaign):
    path = campaign / "traces" / "0_1.csv"
    table = pd.read_csv(path)
    table.loc[250, "force_N"] = -1200.0
    table.to_csv(path, index=False)
    made = ingest_campaign(campaign, Config())
    assert findings(made, "traces/0_1.csv")[["check", "line", "action"]].values.tolist() == [
        ["spike", 252, "row left out"]
    ]
    assert made.tables["steady"]["force_N"].iloc[0] == pytest.approx(30.2, abs=0.02)


def test_a_stroke_left_out_is_in_runs_and_quality_and_in_no_mean(campaign):
    path = campaign / "traces" / "0_2.csv"
    table = pd.read_csv(path)
    table["force_N"] = table["force_N"].clip(upper=30.4)
    table.to_csv(path, index=False)
    made = ingest_campaign(campaign, Config())
    assert findings(made, "traces/0_2.csv")["check"].tolist() == ["saturated"]
    runs = made.tables["runs"].set_index("file")["used"]
    assert runs[~runs].index.tolist() == ["traces/0_2.csv"]
    for name in ("steady", "bins"):
        assert "traces/0_2.csv" not in set(made.tables[name]["file"])
    traces = made.tables["traces"]
    assert not traces.loc[traces["file"] == "traces/0_2.csv", "steady"].any()
    assert made.tables["traces_mean"].query("run_id == 'run0' and steady")["n"].max() == 2


def test_an_outlying_repeat_leaves_fits_and_bins_only_where_the_config_says_so(tmp_path):
    rows = []
    for run in range(8):
        for repeat in (1, 2, 3):
            level = 30.0 + run + 0.02 * repeat * run - (6.0 if (run, repeat) == (3, 2) else 0.0)
            write_trace(tmp_path / f"{run}_{repeat}.csv", level=level, seed=10 * run + repeat, n=200)
            rows.append(row(f"{run}_{repeat}.csv", f"r{run}", repeat, days=run))
    write_campaign(tmp_path, rows)
    kept = ingest_campaign(tmp_path, Config())
    assert findings(kept, "3_2.csv")[["check", "action"]].values.tolist() == [["outlier", "kept"]]
    assert kept.tables["steady"].query("outlier")["file"].tolist() == ["3_2.csv"]
    assert "3_2.csv" in set(kept.tables["bins"]["file"])
    config = Config.model_validate({"quality": {"drop_outliers": True}})
    out = ingest_campaign(tmp_path, config)
    assert findings(out, "3_2.csv")[["check", "action"]].values.tolist() == [["outlier", "file left out"]]
    assert out.tables["steady"].query("not used")["file"].tolist() == ["3_2.csv"]
    assert "3_2.csv" not in set(out.tables["bins"]["file"])
    assert out.tables["runs"].query("not used")["file"].tolist() == ["3_2.csv"]


def test_where_nothing_is_left_the_campaign_is_at_fault_and_every_reason_is_given(tmp_path):
    for repeat in (1, 2):
        write_trace(tmp_path / f"{repeat}.csv", n=15)
    write_campaign(tmp_path, [row(f"{r}.csv", "r", r) for r in (1, 2)])
    with pytest.raises(CampaignError, match="none of 2 trace files can be used") as caught:
        ingest_campaign(tmp_path, Config())
    assert [fault.check for fault in caught.value.faults] == ["too_short", "too_short", "nothing_left"]


def test_nothing_is_said_of_empty_cells_in_a_column_that_the_loop_ignores(campaign):
    table = pd.read_csv(campaign / "runs.csv")
    table["Remark"] = ["cable", *[None] * (len(table) - 1)]
    table.to_csv(campaign / "runs.csv", index=False)
    for ignored, said in (([], ["Remark"]), (["Remark"], [])):
        made = ingest_campaign(campaign, Config(loop={"ignore_channels": ignored}))
        assert [fault.column for fault in made.faults if fault.check == "incomplete_column"] == said


def test_columns_that_the_force_is_computed_from_are_said_and_not_searched(campaign):
    rng = np.random.default_rng(1)
    for path in (campaign / "traces").iterdir():
        table = pd.read_csv(path)
        cylinder = rng.normal(3.0, 0.1, len(table)).round(4)
        table = table.assign(p_bar=cylinder, cell_N=10.0 * cylinder - table["force_N"], oil_C=cylinder)
        table.drop(columns="force_N").to_csv(path, index=False)
    columns = {"time_s": "time_s", "displacement_mm": "displacement_mm"}
    compute = {"pressure_N": "10 * p_bar", "force_N": "pressure_N - cell_N"}
    for given, unsearched in (({}, {"pressure_N", "p_bar", "cell_N"}), ({"drop_columns": ["cell_N"]}, set())):
        rig = Config(trace={"columns": columns, "compute": compute, **given})
        made = ingest_campaign(campaign, rig)
        said = [fault.reason for fault in made.faults if fault.check == "computed_force"]
        assert bool(said) == bool(unsearched)
        searched = {
            channel.name for channel in channels_of(make_rows(made.tables["bins"], has_aging=True), rig)
        }
        assert searched & {"pressure_N", "p_bar", "cell_N", "oil_C"} == (
            {"oil_C"} if unsearched else {"pressure_N", "p_bar", "oil_C"}
        )
        assert not said or "from cell_N, p_bar, pressure_N: " in said[0]
    of_conditions = Config(condition=["p_bar"], trace={"columns": columns, "compute": compute})
    assert force_inputs(of_conditions) == {"pressure_N", "cell_N"}


def test_a_platform_that_does_not_move_is_named(campaign):
    path = campaign / "traces" / "0_1.csv"
    table = pd.read_csv(path)
    table["displacement_mm"] = 7.0
    table.to_csv(path, index=False)
    made = ingest_campaign(campaign, Config())
    assert findings(made, "traces/0_1.csv")["check"].tolist() == ["no_motion"]


def test_a_whole_file_is_steady_where_the_config_says_so(campaign):
    made = ingest_campaign(campaign, Config(strokes=Strokes(whole_file=True)))
    assert made.tables["traces"]["steady"].all()


def test_the_tables_do_not_depend_on_the_number_of_workers(campaign):
    one, two = (ingest_campaign(campaign, Config(), workers=n).tables for n in (1, 2))
    for name in TABLES:
        pd.testing.assert_frame_equal(one[name], two[name])


def test_a_channel_that_only_some_files_have_is_null_in_the_others(tmp_path):
    write_trace(tmp_path / "1.csv", warmth_C=np.linspace(20, 25, 500))
    write_trace(tmp_path / "2.csv", seed=1)
    write_campaign(tmp_path, [row("1.csv", "r", 1), row("2.csv", "r", 2)])
    tables = ingest_campaign(tmp_path, Config()).tables
    for name in ("steady", "bins", "traces"):
        known = tables[name].groupby("file")["warmth_C"].count()
        assert known["1.csv"] > 0
        assert known["2.csv"] == 0


# ---------------------------------------------------------------- measured data
@pytest.mark.skipif(MEASURED is None, reason="SEALFIT_MEASURED names no folder of measured data")
def test_half_loop_and_offset_of_the_pneumatic_cylinder():
    # Means over the middle of the stroke, by hand from the raw files (README of the data set): half loop,
    # offset.
    known = {
        "rerun/1": [(4.95, 1.9), (4.79, 3.4), (5.16, 4.3), (8.81, 4.4)],
        "rerun/2": [(4.79, 1.9), (5.94, 3.4), (5.87, 4.3), (6.29, 4.4)],
        "rerun/3": [(4.22, 1.9), (5.51, 3.4), (7.18, 4.3), (6.55, 4.4)],
        "reconnected/1": [(4.78, 1.2), (6.04, 1.8), (7.35, 2.1), (8.13, 1.8)],
        "reconnected/3": [(6.38, 2.3), (7.36, 3.6), (8.01, 4.2), (7.82, 4.0)],
    }
    root = Path(__file__).parents[2]
    made = ingest_campaign(
        Path(MEASURED) / "pneuseal-repeats", ConfigCopy.at(root / "configs" / "pneuseal.toml").parse()
    )
    bins = made.tables["bins"]
    middle = bins[bins["displacement_mm"].between(7.0, 27.0)]
    mean = (
        middle.groupby(["file", "stroke", "direction"])["force_N"]
        .mean()
        .groupby(["file", "direction"])
        .mean()
    )
    mean = mean.unstack()
    for name, values in known.items():
        for bar, (half, offset) in zip((1, 3, 5, 7), values, strict=True):
            rise, fall = mean.loc[f"raw/{name}_O-ring257_{bar}bar.csv", [1, -1]]
            assert (rise - fall) / 2 == pytest.approx(half, abs=0.11)
            assert (rise + fall) / 2 == pytest.approx(offset, abs=0.26)
    assert (made.tables["runs"].groupby("file")["stroke"].max() == 20).all()
    gaps = made.tables["quality"].query("check == 'gaps'")
    assert sorted(gaps["line"]) == [252, 904, 1208]


@pytest.mark.skipif(MEASURED is None, reason="SEALFIT_MEASURED names no folder of measured data")
def test_torques_of_the_screw_drives():
    root = Path(__file__).parents[2]
    made = ingest_campaign(
        Path(MEASURED) / "screwdrive", ConfigCopy.at(root / "configs" / "screwdrive.toml").parse()
    )
    torque = made.tables["steady"].set_index("file")["force_N"]
    for file, known in {"1/{}/50": 2.54, "1/{}/n50": -3.27, "3/{}/50": 1.00, "3/{}/n50": -1.89}.items():
        name = f"raw/driveNo{file.format('steady_state/0.096kg')}.csv"
        assert torque[name] == pytest.approx(known, abs=0.005)
    # Cells edited by hand, named with file and line; a plain mean of 1.csv would be 30 % too large.
    edited = made.tables["quality"].query("line == 15")["file"].tolist()
    assert sorted(name.rsplit("/", 1)[1] for name in edited) == ["1.csv", "2.csv", "n1.csv"]
