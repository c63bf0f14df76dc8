"""A campaign in parts: how it is cut, what is stored, and what a second run reads again."""

import os
from collections import Counter
from itertools import pairwise

import pandas as pd
import pandas.testing as pdt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealfit.config import Config
from sealfit.ingest import partitions
from sealfit.ingest.campaign import ingest_campaign
from sealfit.ingest.partitions import MOST, PART_FILES, plan_parts
from sealfit.pipeline import ingest
from sealfit.store import Store

SAMPLED = ("traces", "traces_mean", "bins")
SMALL = ("inputs", "runs", "quality", "steady")
SIZE = 2_000  # bytes of a short trace


def plan_of(conditions):
    """Plan for runs of three files; `conditions` names the condition of each run."""
    runs = [f"run {i}" for i in range(len(conditions)) for _ in range(3)]
    return plan_parts([c for c in conditions for _ in range(3)], runs, [SIZE] * len(runs)), runs


@given(st.lists(st.integers(0, 30), min_size=1, max_size=900))
def test_every_file_is_in_one_part_and_no_run_is_cut(numbers):
    plan, runs = plan_of([f"day {n}" for n in numbers])
    assert Counter(i for partitions in plan for i in partitions) == Counter(range(len(runs)))
    assert max(Counter(runs[i] for partitions in plan for i in {min(partitions), *partitions}).values()) == 3
    homes = Counter(run for partitions in plan for run in {runs[i] for i in partitions})
    assert set(homes.values()) == {1}
    assert all(len(partitions) <= MOST * PART_FILES + 3 for partitions in plan)
    assert all(partitions == sorted(partitions) for partitions in plan)


def test_a_condition_lies_in_no_part_but_those_whose_names_span_it():
    conditions = [f"day {(37 * i) % 101}" for i in range(2_000)]
    plan, _ = plan_of(conditions)
    spans = [
        (min(conditions[i // 3] for i in partitions), max(conditions[i // 3] for i in partitions))
        for partitions in plan
    ]
    assert len(spans) > 15
    assert sum(low <= "day 50" <= high for low, high in spans) <= 2


def test_large_files_make_parts_of_few():
    assert [len(partitions) for partitions in plan_parts(["a"] * 6, list("112233"), [50_000_000] * 6)] == [
        2,
        2,
        2,
    ]


def test_files_added_to_one_condition_change_one_part_in_a_hundred():
    conditions = [f"day {i // 8}" for i in range(8_000)]
    before, _ = plan_of(conditions)
    after, _ = plan_of([*conditions, "day 500"])
    assert len(before) > 80
    assert (
        len({tuple(partitions) for partitions in after} - {tuple(partitions) for partitions in before}) <= 3
    )


# ---------------------------------------------------------------- stored
@pytest.fixture
def small_parts(monkeypatch):
    monkeypatch.setattr(partitions, "PART_FILES", 6)


def write(folder, day, repeat, rows=60, level=30.0, **columns):
    """A trace of one stroke at 5 mm/s."""
    name = f"day{day}_r{repeat}.csv"
    x = [0.05 * 5.0 * i for i in range(rows)]
    table = pd.DataFrame({"time_s": [0.05 * i for i in range(rows)], "displacement_mm": x})
    table["force_N"] = [
        level + repeat + 0.01 * day + 0.1 * ((7 * i * i + 3 * repeat) % 11) for i in range(rows)
    ]
    table.assign(**columns).to_csv(folder / name, index=False)
    return f"{name},day{day},{repeat},60,80,{day},49.03,5"


@pytest.fixture
def campaign(tmp_path, small_parts):
    """Twelve conditions of three repeats."""
    folder = tmp_path / "c"
    folder.mkdir()
    lines = [write(folder, day, repeat) for day in range(12) for repeat in (1, 2, 3)]
    header = "file,run_id,repeat,temperature_C,compression_ratio_pct,aging_days,load_N,speed_mm_s"
    (folder / "runs.csv").write_text("\n".join([header, *lines, ""]))
    return folder


def add(campaign, line):
    with (campaign / "runs.csv").open("a") as file:
        file.write(line + "\n")


def tables(out):
    store = Store.open(out)
    return {name: store.read(name) for name in (*SMALL, *SAMPLED)}


def assert_same_tables(one, two):
    for name, table in one.items():
        pdt.assert_frame_equal(table, two[name], check_exact=True)


def stored(out, table="bins"):
    return {path.name: path.stat().st_mtime_ns for path in (out / f"{table}.parquet").iterdir()}


def test_a_table_in_parts_is_read_by_pandas_as_one(campaign, tmp_path):
    ingest(campaign, tmp_path / "out")
    assert len(stored(tmp_path / "out")) > 3
    for name in SAMPLED:
        whole = pd.read_parquet(tmp_path / "out" / f"{name}.parquet")
        assert len(whole) == len(tables(tmp_path / "out")[name])
    one = pd.read_parquet(tmp_path / "out" / "traces.parquet", filters=[("condition", "==", "unaged")])
    assert set(one["file"]) == {"day0_r1.csv", "day0_r2.csv", "day0_r3.csv"}


def test_the_largest_parts_are_read_first_and_the_tables_keep_their_order(campaign):
    done = []
    made = ingest_campaign(campaign, Config(), on_file=lambda files, of: done.append(files))
    sizes = [after - before for before, after in pairwise([0, *done])]
    assert len(set(sizes)) > 1
    assert sizes == sorted(sizes, reverse=True)
    named = pd.read_csv(campaign / "runs.csv")["file"]
    assert made.tables["runs"]["file"].tolist() == made.tables["inputs"]["file"].tolist() == named.tolist()
    edges = made.tables["traces"]["condition"].ne(made.tables["traces"]["condition"].shift())
    assert edges.sum() == 12


def test_three_added_files_leave_the_other_parts_as_they_are(campaign, tmp_path, monkeypatch):
    out = tmp_path / "out"
    ingest(campaign, out)
    before = stored(out)
    for repeat in (1, 2, 3):
        add(campaign, write(campaign, 20, repeat))
    read = []
    count_reading(monkeypatch, read)
    made = ingest(campaign, out)["ingest"]
    assert made["files"]["used"] == 39
    assert 3 <= len(read) <= 15
    kept = stored(out).keys() & before.keys()
    assert len(kept) >= len(before) - 2
    assert all(stored(out)[name] == before[name] for name in kept)
    ingest(campaign, tmp_path / "anew")
    assert_same_tables(tables(out), tables(tmp_path / "anew"))


def count_reading(monkeypatch, read):
    from sealfit.ingest import partitions

    real = partitions.read_strokes

    def counted(ref, *args):
        read.append(ref.file)
        return real(ref, *args)

    monkeypatch.setattr(partitions, "read_strokes", counted)


def test_a_changed_file_and_a_deleted_one_are_seen(campaign, tmp_path):
    out = tmp_path / "out"
    ingest(campaign, out)
    write(campaign, 3, 2, level=31.0)
    runs = (campaign / "runs.csv").read_text().replace("day5_r3.csv,day5,3,60,80,5,49.03,5\n", "")
    (campaign / "runs.csv").write_text(runs)
    (campaign / "day5_r3.csv").unlink()
    assert ingest(campaign, out)["ingest"]["files"]["used"] == 35
    ingest(campaign, tmp_path / "anew")
    assert_same_tables(tables(out), tables(tmp_path / "anew"))


def test_force_reads_everything_again(campaign, tmp_path, monkeypatch):
    ingest(campaign, tmp_path / "out")
    read = []
    count_reading(monkeypatch, read)
    ingest(campaign, tmp_path / "out", force=True)
    assert len(read) == 36


def test_a_part_whose_file_was_damaged_is_read_again(campaign, tmp_path):
    out = tmp_path / "out"
    ingest(campaign, out)
    whole = tables(out)
    victim = next((out / "bins.parquet").iterdir())
    victim.write_bytes(victim.read_bytes()[:-1])
    ingest(campaign, out)
    assert_same_tables(tables(out), whole)


def test_what_a_killed_run_left_in_a_table_is_not_read(campaign, tmp_path):
    out = tmp_path / "out"
    ingest(campaign, out)
    whole = tables(out)
    real = next((out / "bins.parquet").iterdir())
    (out / "bins.parquet" / f"0123456789-{real.name}").write_bytes(real.read_bytes())
    ingest(campaign, out, force=True)
    assert len(pd.read_parquet(out / "bins.parquet")) == len(whole["bins"])


def test_a_table_that_was_one_file_becomes_a_folder(campaign, tmp_path):
    out = tmp_path / "out"
    ingest(campaign, out)
    for path in (out / "bins.parquet").iterdir():
        path.unlink()
    (out / "bins.parquet").rmdir()
    (out / "bins.parquet").write_text("one file")
    ingest(campaign, out)
    assert len(tables(out)["bins"])


def test_a_stroke_that_other_parts_rule_out_is_in_no_table_of_samples(campaign, tmp_path):
    """A dead sensor is seen beside strokes with noise, which lie in other parts."""
    for repeat in (1, 2, 3):
        path = campaign / f"day7_r{repeat}.csv"
        pd.read_csv(path).assign(force_N=12.5).to_csv(path, index=False)
    out = tmp_path / "out"
    ingest(campaign, out)
    found = tables(out)
    dead = found["runs"].loc[~found["runs"]["used"], "file"].tolist()
    assert dead == [f"day7_r{repeat}.csv" for repeat in (1, 2, 3)]
    assert not found["bins"]["file"].isin(dead).any()
    assert not found["traces"].loc[found["traces"]["file"].isin(dead), "steady"].any()
    assert not (
        found["traces_mean"]["condition"] == "temperature_C=60, compression_ratio_pct=80, aging_days=7"
    ).any()
    add(campaign, write(campaign, 20, 1))  # judged again, from what is stored of the parts
    ingest(campaign, out)
    ingest(campaign, tmp_path / "anew")
    assert_same_tables(tables(out), tables(tmp_path / "anew"))


def test_a_channel_of_some_files_only_is_null_in_the_other_parts(campaign, tmp_path):
    for repeat in (1, 2, 3):
        write(campaign, 4, repeat, humidity_pct=40.0 + repeat)
        write(campaign, 8, repeat, remark="wet", humidity_pct="dry" if repeat == 2 else 41.0)
    out = tmp_path / "out"
    ingest(campaign, out)
    found = tables(out)
    bins = found["bins"].set_index("file")
    assert set(bins.loc["day4_r1.csv", "humidity_pct"]) == {"41.0"}  # words in one file, so words in all
    assert set(bins.loc["day8_r2.csv", "humidity_pct"]) == {"dry"}
    assert bins.loc["day2_r1.csv", ["humidity_pct", "remark"]].isna().all().all()
    assert len(pd.read_parquet(out / "bins.parquet", columns=["remark", "file"]).dropna()) == len(
        bins.loc[[f"day8_r{repeat}.csv" for repeat in (1, 2, 3)]]
    )


@pytest.mark.parametrize("workers", [2, 3])
def test_tables_do_not_depend_on_the_number_of_processes(campaign, tmp_path, workers):
    ingest(campaign, tmp_path / "one", workers=1)
    ingest(campaign, tmp_path / "many", workers=workers)
    assert_same_tables(tables(tmp_path / "one"), tables(tmp_path / "many"))
    assert stored(tmp_path / "one").keys() == stored(tmp_path / "many").keys()


def test_a_full_disk_leaves_the_tables_as_they_were(campaign, tmp_path, monkeypatch):
    from sealfit.errors import OutError
    from sealfit.store import parquet

    out = tmp_path / "out"
    ingest(campaign, out)
    whole = tables(out)
    write(campaign, 3, 2, level=31.0)

    def full(table, path):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(parquet, "write_arrow", full)
    with pytest.raises(OutError, match=r"No space left.*Free some space"):
        ingest(campaign, out)
    assert not list(out.glob(".staging*"))
    assert_same_tables(tables(out), whole)
