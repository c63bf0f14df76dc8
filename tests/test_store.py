import errno
import json
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_tables import small

from sealfit.config import parse_config
from sealfit.errors import ConfigError, OutError, StaleError
from sealfit.store import Store, parquet, staged_writes
from sealfit.store.manifest import STAGING, STATE, STEPS, ConfigCopy, State, fingerprint, seen_config, to_json
from sealfit.store.staged_writes import COMPLETE, LOCK
from sealfit.tables import BINS, INPUTS, QUALITY, RUNS
from sealfit.units import Units

HERE = Path(__file__).resolve().parent
OUTPUTS = {  # table that stands for each step in these tests
    "ingest": "steady",
    "fit-steady": "steady_fit",
    "fit-aging": "aging_fit",
    "fit-dynamic": "dynamic_fit",
    "close-loop": "effects",
    "report": "channels",
}


@pytest.fixture
def campaign(tmp_path):
    folder = tmp_path / "campaign"
    folder.mkdir()
    (folder / "runs.csv").write_text("file\na.csv\n")
    (folder / "a.csv").write_text("time_s,displacement_mm,force_N\n0,0,1\n")
    return folder


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


def do(store, step, rows=2):
    with store.step(step) as staged:
        if step == "ingest":
            campaign = store.state.campaign
            staged.inputs = {p.name: fingerprint(p) for p in sorted(campaign.iterdir())}
        staged.table(OUTPUTS[step], small(OUTPUTS[step], rows))


def do_all(out, campaign, source=None, rows=2):
    with Store.writing(out, campaign, source or ConfigCopy.at(None)) as store:
        for step in STEPS:
            do(store, step, rows)


def stale(out, campaign=None, source=None):
    if campaign is None:
        store = Store.open(out)
        return [step for step in STEPS if store.why_stale(step)]
    with Store.writing(out, campaign, source or ConfigCopy.at(None)) as store:
        return [step for step in STEPS if store.why_stale(step)]


def rig(folder, text):
    path = folder / "rig.toml"
    path.write_text(text)
    return ConfigCopy.at(path)


def content(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


# ---------------------------------------------------------------- tables
numbers = st.one_of(st.none(), st.floats(allow_nan=False))
words = st.one_of(st.none(), st.text(st.characters(codec="utf-8"), max_size=8))


@given(
    st.lists(st.tuples(words, st.one_of(st.none(), st.integers(-(2**53), 2**53)), numbers, words), max_size=6)
)
def test_a_table_survives_parquet(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("t") / "quality.parquet"
    frame = small("quality", len(rows))
    frame["file"] = [row[0] for row in rows]
    frame["line"] = pd.array([row[1] for row in rows], dtype="Int64")
    frame["value"] = [row[3] for row in rows]
    parquet.write_arrow(parquet.to_arrow(frame, QUALITY, Units()), path)
    back = parquet.read(path)
    assert list(back.columns) == QUALITY.names()
    assert [None if pd.isna(v) else v for v in back["file"]] == [row[0] for row in rows]
    assert [None if pd.isna(v) else int(v) for v in back["line"]] == [row[1] for row in rows]
    assert [None if pd.isna(v) else v for v in back["value"]] == [row[3] for row in rows]


@given(st.lists(numbers, min_size=1, max_size=6))
def test_a_number_that_is_missing_is_null_and_stays_missing(tmp_path_factory, values):
    path = tmp_path_factory.mktemp("t") / "bins.parquet"
    frame = small("bins", len(values)).assign(load_N=pd.Series(values, dtype=float))
    parquet.write_arrow(parquet.to_arrow(frame, BINS, Units()), path)
    assert pq.read_table(path)["load_N"].null_count == sum(value is None for value in values)
    np.testing.assert_array_equal(parquet.read(path)["load_N"], np.array(values, dtype=float))


def test_columns_come_in_the_order_of_the_schema_and_channels_after_them(tmp_path):
    frame = small("bins", humidity_pct=40.0, batch="b1")
    parquet.write_arrow(
        parquet.to_arrow(frame[sorted(frame.columns)], BINS, Units()), tmp_path / "bins.parquet"
    )
    assert list(parquet.read(tmp_path / "bins.parquet").columns) == [*BINS.names(), "batch", "humidity_pct"]


@pytest.mark.parametrize("coded", [[], ["run_id"]])
def test_only_the_rows_asked_for_are_read(tmp_path, coded):
    paths = [tmp_path / name for name in ("one.parquet", "two.parquet")]
    for path, runs in zip(paths, (["a", "b", "a"], ["c", "d", "b"]), strict=True):
        parquet.write_arrow(
            parquet.to_arrow(small("bins", 3).assign(run_id=runs, load_N=[1.0, 2.0, 3.0]), BINS, Units()),
            path,
        )
    rows = parquet.read(paths, ["run_id", "load_N"], coded, where={"run_id": ["b", "d"]})
    assert rows["run_id"].tolist() == ["b", "d", "b"]
    assert rows["load_N"].tolist() == [2.0, 2.0, 3.0]
    assert parquet.read(paths, ["run_id"], where={"run_id": []}).empty


def test_types_are_those_of_the_schema(tmp_path):
    frame = small("runs").assign(repeat=[1.0, np.nan], run_id=[7, 8], load_N=[49, 50])
    table = parquet.to_arrow(frame, RUNS, Units())
    assert [field.type for field in table.schema] == [column.dtype for column in RUNS.columns]
    assert table["repeat"].to_pylist() == [1, None]
    assert table["run_id"].to_pylist() == ["7", "8"]


def test_a_channel_of_words_and_numbers_is_words():
    table = parquet.to_arrow(small("runs").assign(batch=["x", 2], empty=[None, None]), RUNS, Units())
    assert table["batch"].to_pylist() == ["x", "2"]
    assert table["empty"].null_count == 2


def test_metadata_holds_true_units_and_meaning():
    units = parse_config(
        '[quantities]\nforce = {quantity = "torque", unit = "mN m"}\n[column_units]\nhumidity = "g/kg"', "rig"
    ).units
    schema = parquet.to_arrow(small("bins", humidity=40.0), BINS, units).schema
    assert schema.field("force_N").metadata[b"unit"] == b"mN m"
    assert schema.field("force_N").metadata[b"meaning"].startswith(b"friction force")
    assert schema.field("displacement_mm").metadata[b"unit"] == b"mm"
    assert schema.field("humidity").metadata[b"unit"] == b"g/kg"
    assert json.loads(schema.metadata[b"units"])["force_sd_N"] == "mN m"
    assert json.loads(schema.metadata[b"sealfit"])["table"] == "bins"
    assert parquet.to_arrow(small("inputs"), INPUTS, units).schema.field("size").metadata[b"unit"] == b"byte"


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (small("inputs").drop(columns="rows"), "missing columns .'rows'"),
        (small("inputs", more=1), "does not know .'more'"),
        (small("inputs").assign(rows="x"), "table inputs, column 'rows'"),
        (small("inputs").assign(rows=1.5), "table inputs, column 'rows'"),
        (pd.concat([small("inputs"), small("inputs")[["rows"]]], axis=1), "doubled columns .'rows'"),
    ],
    ids=["missing", "unknown", "words", "fractions", "doubled"],
)
def test_a_frame_that_is_not_its_table_is_refused(frame, words):
    with pytest.raises(ValueError, match=words):
        parquet.to_arrow(frame, INPUTS, Units())


def test_json_has_neither_nan_nor_infinity_nor_numpy():
    text = to_json(
        {"a": math.nan, "b": [np.float64("inf"), np.int64(3)], "c": np.array([1.5, np.nan]), "d": pd.NA}
    )
    assert json.loads(text, parse_constant=pytest.fail) == {
        "a": None,
        "b": [None, 3],
        "c": [1.5, None],
        "d": None,
    }


# ---------------------------------------------------------------- current and stale
def test_a_folder_of_something_else_is_not_proposed_for_results(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(OutError, match=r"run CAMPAIGN --out \S*empty$"):
        Store.open(tmp_path / "empty")
    (tmp_path / "empty" / "trace.csv").touch()
    with pytest.raises(
        OutError, match=r"Give the folder of the results, or make it: sealfit run CAMPAIGN --out OUT$"
    ):
        Store.open(tmp_path / "empty")


def test_everything_is_current_after_it_was_done(out, campaign):
    do_all(out, campaign)
    assert stale(out) == []
    assert stale(out, campaign) == []


def test_a_touched_input_is_still_current_and_a_changed_one_is_not(out, campaign):
    do_all(out, campaign)
    os.utime(campaign / "a.csv", ns=(1, 1))
    assert stale(out) == []
    (campaign / "a.csv").write_text("time_s,displacement_mm,force_N\n0,0,2\n")
    assert stale(out) == list(STEPS)
    assert "inputs changed (a.csv)" in Store.open(out).why_stale("report")


def test_a_lost_input_and_one_that_appears_make_everything_stale(out, campaign):
    source = rig(campaign.parent, "[files]\nglob = '*.csv'\nexclude = ['x_*']")
    do_all(out, campaign, source)
    (campaign / "x_1.csv").write_text("not a trace")
    assert stale(out) == []
    (campaign / "b.csv").write_text("0")
    assert stale(out) == list(STEPS)
    (campaign / "b.csv").unlink()
    assert stale(out) == []
    (campaign / "a.csv").unlink()
    assert stale(out) == list(STEPS)


@pytest.mark.parametrize(
    ("change", "first"),
    [
        ("[bins]\nper_stroke = 7", "ingest"),
        ("[sensor]\naccuracy = 0.3", "fit-steady"),
        ("[loop]\nseed = 2", "close-loop"),
        ("# only a remark", None),
    ],
)
def test_a_changed_config_makes_stale_what_can_see_it(out, campaign, change, first):
    do_all(out, campaign, rig(campaign.parent, "name = 'default'"))
    rig(campaign.parent, f"name = 'default'\n{change}")
    expected = list(STEPS[STEPS.index(first) :]) if first else []
    assert stale(out) == expected
    assert stale(out, campaign, ConfigCopy.at(campaign.parent / "rig.toml")) == expected
    if first:
        with pytest.raises(StaleError, match=r"config \(rig.toml\) changed"):
            Store.open(out).require(first)


def test_a_step_is_not_given_what_its_key_does_not_hold():
    config = parse_config("[loop]\nseed = 9\n[sensor]\naccuracy = 0.7", "rig")
    assert seen_config("ingest", config) == parse_config("", "rig")
    assert seen_config("fit-steady", config).sensor.accuracy == 0.7
    assert seen_config("fit-steady", config).loop.seed == 1
    assert seen_config("close-loop", config) == config


def test_another_version_makes_everything_stale(out, campaign, monkeypatch):
    do_all(out, campaign)
    for module in ("store.manifest", "store"):
        monkeypatch.setattr(f"sealfit.{module}.__version__", "99.0")
    assert stale(out) == list(STEPS)
    with pytest.raises(StaleError, match=r"made by sealfit .*, this is 99.0"):
        Store.open(out).require("report")


def test_a_user_s_effect_that_changed_makes_the_loop_stale(out, campaign):
    effects = campaign.parent / "mine"
    effects.mkdir()
    (effects / "one.py").write_text("A = 1")
    do_all(out, campaign, rig(campaign.parent, "[loop]\neffects_folder = 'mine'"))
    assert stale(out) == []
    (effects / "one.py").write_text("A = 2")
    assert stale(out) == ["close-loop", "report"]


def test_a_file_outside_out_that_the_state_names_is_never_touched(out, campaign):
    do_all(out, campaign)
    state = json.loads((out / "state.json").read_text())
    for file in ("../rig.toml", str(out.parent / "rig.toml")):
        state["steps"]["report"]["files"][file] = 1
        (out / "state.json").write_text(json.dumps(state))
        with pytest.raises(OutError, match="is not a state that this version"):
            Store.open(out)
        del state["steps"]["report"]["files"][file]


def test_a_redone_step_makes_those_after_it_stale(out, campaign):
    do_all(out, campaign)
    with Store.writing(out) as store:
        do(store, "fit-steady")
    assert stale(out) == ["fit-aging", "fit-dynamic", "close-loop", "report"]


def test_a_table_that_is_missing_or_was_cut_makes_its_step_stale(out, campaign):
    do_all(out, campaign)
    path = out / "aging_fit.parquet"
    path.write_bytes(path.read_bytes()[:-1])
    assert stale(out) == ["fit-aging", "fit-dynamic", "close-loop", "report"]
    path.unlink()
    with pytest.raises(StaleError, match=r"aging_fit.parquet is missing.*Run: sealfit fit-aging"):
        Store.open(out).require("close-loop")


@pytest.mark.parametrize("name", ["aging_fit.parquet", "closure.json"])
def test_a_file_with_one_changed_bit_makes_its_step_stale(out, campaign, name):
    with Store.writing(out, campaign, ConfigCopy.at(None)) as store:
        for step in STEPS:
            with store.step(step) as staged:
                staged.table(OUTPUTS[step], small(OUTPUTS[step], 2))
                if step == "close-loop":
                    staged.file("closure.json", '{"rmse_N": 0.90}')
    raw = bytearray((out / name).read_bytes())
    raw[len(raw) // 2] ^= 1
    (out / name).write_bytes(raw)
    with pytest.raises(StaleError, match=f"its {name} is missing or was changed. Run: sealfit"):
        Store.open(out).require("close-loop")


def test_a_table_in_parts_with_a_changed_bit_is_not_read_as_other_data(tmp_path):
    path = tmp_path / "part.parquet"
    parquet.write_arrow(pa.table({"force_N": np.random.default_rng(0).normal(size=5000)}), path)
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 1
    path.write_bytes(raw)
    with pytest.raises(
        OutError, match=r"is missing or damaged. Make all results again: sealfit run .*--force"
    ):
        parquet.read(path)


def test_a_missing_predecessor_names_the_command_to_run(out, campaign):
    with Store.writing(out, campaign, rig(campaign.parent, "")) as store:
        do(store, "ingest")
        with pytest.raises(
            StaleError, match=r"fit-steady has not been done\. Run: sealfit fit-steady .*out$"
        ):
            store.require("close-loop")
    (campaign / "a.csv").write_text("new")
    with pytest.raises(
        StaleError, match=r"Run: sealfit ingest \S*campaign --out \S*out --config \S*rig.toml$"
    ):
        Store.open(out).require("close-loop")


def test_without_results_there_is_nothing_to_go_on_from(tmp_path):
    for folder in (tmp_path, tmp_path / "no"):
        with pytest.raises(OutError, match="sealfit run CAMPAIGN --out"):
            Store.open(folder)
        with pytest.raises(OutError, match="sealfit run CAMPAIGN --out"), Store.writing(folder):
            pytest.fail("was opened")
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------- whose OUT
def test_a_moved_campaign_keeps_its_results(out, campaign):
    do_all(out, campaign)
    moved = campaign.rename(campaign.with_name("moved"))
    assert "cannot be detected" in Store.open(out).warnings[0]
    assert stale(out) == []
    with Store.writing(out, moved, ConfigCopy.at(None)) as store:
        assert "holds the same data" in store.warnings[0]
        assert not store.why_stale("report")
    assert Store.open(out).state.campaign == moved
    assert Store.open(out).warnings == []


def test_a_moved_out_keeps_its_results(out, campaign):
    do_all(out, campaign)
    moved = out.rename(out.with_name("elsewhere"))
    assert stale(moved) == []
    assert stale(moved, campaign) == []


def test_another_campaign_is_refused_and_nothing_is_touched(out, campaign):
    do_all(out, campaign)
    before = content(out)
    other = campaign.with_name("other")
    other.mkdir()
    (other / "runs.csv").write_text("file\na.csv\n")
    (other / "a.csv").write_text("other data")
    with pytest.raises(
        OutError, match=r"belongs to the campaign .*campaign, and .*other holds other data.*another --out"
    ):
        stale(out, other)
    assert content(out) == before


def test_a_changed_campaign_in_its_place_is_the_same_campaign(out, campaign):
    do_all(out, campaign)
    (campaign / "a.csv").write_text("all new")
    assert stale(out, campaign) == list(STEPS)


def test_a_folder_that_sealfit_did_not_make_is_refused(out, campaign):
    out.mkdir()
    (out / "thesis.doc").write_text("precious")
    with pytest.raises(OutError, match=r"not empty \(it holds thesis.doc\)"):
        do_all(out, campaign)
    assert content(out) == {"thesis.doc": b"precious"}
    with pytest.raises(OutError, match="is a file"):
        do_all(out / "thesis.doc", campaign)
    with pytest.raises(OutError, match="not empty"):
        do_all(campaign, campaign)


DEEP = "[" * 4_000 + "]" * 4_000


@pytest.mark.parametrize("state", ['{"program": "else"}', DEEP], ids=["foreign", "deep"])
def test_a_state_that_cannot_be_read_is_refused(out, campaign, state):
    out.mkdir()
    (out / "state.json").write_text(state)
    with pytest.raises(OutError, match="is not a state that this version"):
        do_all(out, campaign)


@pytest.mark.parametrize("document", [DEEP, "{"], ids=["deep", "cut"])
def test_a_result_that_is_no_json_is_one_line(out, campaign, document):
    do_all(out, campaign)
    (out / "closure.json").write_text(document)
    with pytest.raises(OutError, match=r"closure\.json: is not what sealfit wrote"):
        Store.open(out).read_json("closure")


def test_a_lock_of_lists_in_lists_names_nobody(out, campaign):
    out.mkdir()
    (out / LOCK).write_text(DEEP)
    do_all(out, campaign)
    assert stale(out) == []


needs_bytes = pytest.mark.skipif(sys.platform != "linux", reason="names of files are bytes on Linux only")


@needs_bytes
def test_a_campaign_in_a_folder_that_is_not_utf_8_is_kept(tmp_path, out, campaign):
    place = tmp_path / os.fsdecode(b"caf\xe9")
    campaign.rename(place)
    do_all(out, place)
    assert stale(out, place) == []
    assert Store.open(out).state.campaign == place


@needs_bytes
def test_an_out_that_is_not_utf_8_is_refused(tmp_path, campaign):
    with pytest.raises(OutError, match=r"is a path that is not UTF-8\. Choose another --out"):
        do_all(tmp_path / os.fsdecode(b"caf\xe9"), campaign)


def test_a_config_that_is_a_link_to_itself_is_one_line(tmp_path):
    (tmp_path / "rig.toml").symlink_to("rig.toml")
    with pytest.raises(ConfigError, match=r"cannot be read"):
        ConfigCopy.at(tmp_path / "rig.toml")


@pytest.mark.parametrize(
    "further", [{"inputs": "written otherwise"}, {"moving": {"folder": ".staging-1", "left_over": []}}]
)
def test_results_of_an_earlier_format_are_made_again(out, campaign, further):
    do_all(out, campaign)
    state = json.loads((out / "state.json").read_text())
    (out / "state.json").write_text(json.dumps({**state, "format": 8, **further}))
    assert Store.open(out).why_stale("ingest") == "ingest has not been done"
    do_all(out, campaign, rows=5)
    assert stale(out) == []
    assert len(Store.open(out).read("steady")) == 5


def test_a_folder_that_was_made_for_nothing_goes_again(out, campaign):
    def fail():
        with Store.writing(out, campaign, ConfigCopy.at(None)) as store, store.step("ingest") as staged:
            staged.table("steady", small("steady"))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert not out.exists()


def test_what_a_step_no_longer_writes_is_removed(out, campaign):
    with Store.writing(out, campaign, ConfigCopy.at(None)) as store:
        with store.step("ingest") as staged:
            staged.inputs = {}
            staged.file("plots/old.svg", "old")
            staged.file("plots/both.svg", "one")
        with store.step("ingest") as staged:
            staged.inputs = {}
            staged.file("plots/both.svg", "two")
    assert sorted(p.name for p in (out / "plots").iterdir()) == ["both.svg"]
    assert (out / "plots/both.svg").read_text() == "two"


def test_a_new_folder_is_on_the_disk_before_files_are_moved_into_it(out, campaign, monkeypatch):
    """A power loss may keep what a synced folder holds and lose the folder itself."""
    done, sync, replace = [], staged_writes.sync, os.replace

    def noting(what, act):
        def noted(*paths):
            done.append((what, Path(paths[-1]), (out / "plots").is_dir()))
            act(*paths)

        return noted

    monkeypatch.setattr(staged_writes, "sync", noting("sync", sync))
    monkeypatch.setattr(os, "replace", noting("move", replace))
    with Store.writing(out, campaign, ConfigCopy.at(None)) as store, store.step("ingest") as staged:
        staged.inputs = {}
        staged.file("plots/new.svg", "new")
    assert ("sync", out, True) in done[: done.index(("move", out / "plots/new.svg", True))]


def test_provenance_names_config_inputs_and_steps(out, campaign):
    do_all(out, campaign, rig(campaign.parent, "# ours"))
    found = json.loads((out / "provenance.json").read_text())
    assert found["campaign"] == str(campaign)
    assert found["config"]["text"] == "# ours"
    assert [entry["file"] for entry in found["inputs"]] == ["a.csv", "runs.csv"]
    assert found["inputs"][1]["sha256"] == fingerprint(campaign / "runs.csv").sha256
    assert [entry["step"] for entry in found["steps"]] == list(STEPS)
    assert set(found["packages"]) >= {"numpy", "scipy"}


# ---------------------------------------------------------------- one writer
WRITER = """
import sys, time
sys.path.insert(0, {tests!r})
from pathlib import Path
from sealfit.store.manifest import ConfigCopy
from sealfit.store import Store

with Store.writing(Path({out!r}), Path({campaign!r}), ConfigCopy.at(None)) as store:
    print("holds", flush=True)
    time.sleep(60)
"""


@contextmanager
def writer(out, campaign):
    program = WRITER.format(tests=str(HERE), out=str(out), campaign=str(campaign))
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as run:
        try:
            assert run.stdout.readline() == "holds\n"
            yield run
        finally:
            run.kill()


def test_a_second_writer_is_told_host_and_process_at_once(out, campaign):
    import socket

    with writer(out, campaign) as run:
        began = time.monotonic()
        with pytest.raises(OutError, match=rf"host {socket.gethostname()}, process {run.pid}\) is writing"):
            do_all(out, campaign)
        assert time.monotonic() - began < 2
        assert run.poll() is None


def test_the_lock_of_a_dead_process_is_taken_over(out, campaign):
    with writer(out, campaign) as run:
        run.kill()
        run.wait()
    assert (out / LOCK).exists()
    do_all(out, campaign)
    assert stale(out) == []
    assert not (out / LOCK).exists()


def test_a_lock_of_another_host_is_not_taken_over(out, campaign):
    do_all(out, campaign)
    (out / LOCK).write_text('{"host": "elsewhere.example", "pid": 12}')
    with pytest.raises(OutError, match=r"host elsewhere.example, process 12.*delete .*\.lock"):
        do_all(out, campaign)
    assert Store.open(out).read("steady").shape[0] == 2  # reading needs no lock


@contextmanager
def without_locks(monkeypatch, number=errno.ENOLCK):
    """A file system on which flock fails, as on NFS without a lock daemon."""
    fcntl = pytest.importorskip("fcntl")

    def refuse(*_given):
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(fcntl, "flock", refuse)
        yield


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_without_locks_a_process_that_runs_is_not_disturbed(out, campaign, monkeypatch, number):
    with writer(out, campaign) as run, without_locks(monkeypatch, number):
        with pytest.raises(
            OutError, match=rf"process {run.pid}\) is writing.*is no sealfit, delete .*\.lock"
        ):
            do_all(out, campaign)
        run.kill()
        run.wait()
        do_all(out, campaign)
    assert stale(out) == []
    assert not (out / LOCK).exists()


def test_without_locks_a_number_that_no_process_has_holds_nothing(out, campaign, monkeypatch):
    do_all(out, campaign)
    (out / LOCK).write_text(json.dumps({"host": socket.gethostname(), "pid": 10**30}))
    with without_locks(monkeypatch):
        do_all(out, campaign)
    assert stale(out) == []


def test_results_written_while_they_are_read_are_not_mixed(out, campaign):
    do_all(out, campaign, rows=2)
    reader = Store.open(out)
    assert len(reader.read("steady")) == 2
    (campaign / "a.csv").write_text("changed")
    do_all(out, campaign, rows=5)
    with pytest.raises(OutError, match=r"was written while it was read\. Run the command again"):
        reader.read("steady_fit")
    assert len(Store.open(out).read("steady_fit")) == 5


def test_every_folder_in_which_a_step_puts_files_is_synced(tmp_path, campaign, monkeypatch):
    out, synced = tmp_path / "new" / "out", []
    monkeypatch.setattr("sealfit.store.staged_writes.sync", lambda path: synced.append(Path(path)))
    with Store.writing(out, campaign, ConfigCopy.at(None)) as store, store.step("ingest") as staged:
        staged.table("steady", small("steady"))
        staged.file("plots/a.svg", "<svg/>")
    assert {tmp_path, out.parent, out, out / "plots"} <= set(synced)


# ---------------------------------------------------------------- kills and full disks
# Each line that comes in is the number of a call: `do_all` is killed there, in a process forked for it.
KILLED = """
import os, signal, sys, traceback
sys.path.insert(0, {tests!r})
from pathlib import Path
import test_store
from sealfit.store import staged_writes

calls = 0

def kill_at(at, real):
    def counted(*args):
        global calls
        calls += 1
        if calls == at:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*args)
    return counted

def do_all_until(at):
    os.replace, staged_writes.sync = kill_at(at, os.replace), kill_at(at, staged_writes.sync)
    try:
        test_store.do_all(Path({out!r}), Path({campaign!r}), rows=5)
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)

for line in sys.stdin:
    pid = os.fork()
    if pid == 0:
        do_all_until(int(line))
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""
MOMENTS_PER_STEP = 13  # files written and moved, folders synced


@pytest.fixture
def kill_at(out, campaign):
    """Do all steps in another process, killed at a call of that number; return its exit code."""
    program = KILLED.format(tests=str(HERE), out=str(out), campaign=str(campaign))
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", program], **pipes) as forking:

        def ask(at):
            print(at, file=forking.stdin, flush=True)
            return int(forking.stdout.readline())

        yield ask
        forking.stdin.close()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_kill_at_any_moment_leaves_complete_tables(out, campaign, kill_at):
    do_all(out, campaign, rows=2)
    reached_end = []
    for at in range(1, MOMENTS_PER_STEP * len(STEPS) + 2, 5):
        (campaign / "a.csv").write_text(f"changed before kill {at}")
        code = kill_at(at)
        reached_end.append(code == 0)
        assert code in (0, -signal.SIGKILL)
        store = Store.open(out)
        for step in STEPS:
            rows = len(store.read(OUTPUTS[step]))  # reads whole, or this raises
            assert rows in (2, 5)
            if not store.why_stale(step):
                assert rows == 5
        do_all(out, campaign, rows=2)
        assert stale(out) == []
        assert sorted(p.name for p in out.iterdir()) == sorted(
            [*(f"{table}.parquet" for table in OUTPUTS.values()), "state.json", "provenance.json"]
        )
    assert not reached_end[0]
    assert not reached_end[len(reached_end) // 2]


def at_move(monkeypatch, number, act):
    """Let `act` come before the move of that number: the first of a step is that of its folder."""
    real, moved = os.replace, []

    def replace(*paths):
        moved.append(paths)
        if len(moved) == number:
            act()
        return real(*paths)

    monkeypatch.setattr("sealfit.store.staged_writes.os.replace", replace)


def test_a_ctrl_c_while_files_are_moved_waits_until_they_are(out, campaign, monkeypatch):
    def ingest():
        with Store.writing(out, campaign, ConfigCopy.at(None)) as store:
            do(store, "ingest")

    at_move(monkeypatch, 2, lambda: signal.raise_signal(signal.SIGINT))
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        ingest()
    assert signal.getsignal(signal.SIGINT) is before
    monkeypatch.undo()
    assert not Store.open(out).why_stale("ingest")


def fail_at_move(monkeypatch, out, campaign, number):
    """Do every step, then fit-steady again, whose moves fail from that number on."""
    do_all(out, campaign)

    def fail():
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with Store.writing(out, campaign, ConfigCopy.at(None)) as store:
        at_move(monkeypatch, number, fail)
        with pytest.raises(OutError, match=r"Input/output error"):
            do(store, "fit-steady", rows=5)
        monkeypatch.undo()


def staging(out):
    return [path for path in out.iterdir() if path.name.startswith(STAGING)]


@pytest.mark.parametrize(("number", "rows"), [(1, 2), (2, 5), (3, 5), (4, 5)])
def test_a_step_is_whole_wherever_its_moves_fail(out, campaign, monkeypatch, number, rows):
    fail_at_move(monkeypatch, out, campaign, number)
    assert len(staging(out)) == (number > 1)
    store = Store.open(out)
    assert not staging(out)
    assert len(store.read(OUTPUTS["fit-steady"])) == rows
    assert not store.why_stale("fit-steady")
    assert bool(store.why_stale("fit-aging")) == (number > 1)


@pytest.mark.parametrize("number", [2, 3, 4])
def test_an_interrupted_step_whose_files_were_deleted_is_done_again(out, campaign, monkeypatch, number):
    fail_at_move(monkeypatch, out, campaign, number)
    (left,) = staging(out)
    shutil.rmtree(left)
    assert bool(Store.open(out).why_stale("fit-steady")) == (number > 2)
    do_all(out, campaign, rows=5)
    assert stale(out) == []


def test_a_first_step_that_was_interrupted_is_finished(out, campaign, monkeypatch):
    def fail():
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with Store.writing(out, campaign, ConfigCopy.at(None)) as store:
        at_move(monkeypatch, 3, fail)
        with pytest.raises(OutError, match=r"Input/output error"):
            do(store, "ingest")
        monkeypatch.undo()
    assert not (out / STATE).exists()
    assert not Store.open(out).why_stale("ingest")


def test_no_file_is_moved_or_removed_through_a_link(out, campaign, tmp_path):
    do_all(out, campaign)
    (tmp_path / "mine").mkdir()
    mine = tmp_path / "mine" / "a.svg"
    mine.write_text("mine")
    folder = out / COMPLETE
    folder.mkdir()
    (folder / "plots").symlink_to(mine.parent)
    for file in ("../mine/a.svg", "plots/a.svg"):
        state = json.loads((out / STATE).read_text())
        state["steps"]["report"]["files"][file] = 4
        (folder / STATE).write_text(json.dumps(state))
        with pytest.raises(OutError, match=r"is not a state|is a link to a folder"):
            Store.open(out)
        assert mine.read_text() == "mine"


def full(*_args, **_kwargs):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("place", ["parquet.write_arrow", "staged_writes.sync"])
@pytest.mark.parametrize("step", STEPS)
def test_a_full_disk_is_one_line_and_leaves_out_as_it_was(out, campaign, monkeypatch, step, place):
    do_all(out, campaign)
    before = content(out)
    monkeypatch.setattr(f"sealfit.store.{place}", full)
    with (
        pytest.raises(OutError, match=r"No space left on device\)\. Free some space") as caught,
        Store.writing(out, campaign, ConfigCopy.at(None)) as store,
    ):
        do(store, step, rows=5)
    assert "\n" not in str(caught.value)
    assert content(out) == before
    monkeypatch.undo()
    assert stale(out) == []


@contextmanager
def mounted(folder, options):
    folder.mkdir(exist_ok=True)
    mount = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], capture_output=True, check=False
    )
    if mount.returncode != 0:
        pytest.skip("a small file system cannot be mounted here (needs root)")
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.skipif(not Path("/bin/mount").exists(), reason="no mount command")
def test_a_disk_that_is_really_full(tmp_path, campaign):
    disk = tmp_path / "disk"
    with mounted(disk, "size=256k"):
        out = disk / "out"
        do_all(out, campaign)
        before = content(out)
        noise = np.random.default_rng(1).normal(size=100_000)
        large = small("bins", len(noise)).assign(force_N=noise)
        with (
            pytest.raises(OutError, match=r"No space left on device"),
            Store.writing(out, campaign, ConfigCopy.at(None)) as store,
            store.step("fit-steady") as staged,
        ):
            staged.table("bins", large)
        assert content(out) == before
        (disk / "filler").write_bytes(b"0" * 150_000)
        for _ in range(200):  # the last free blocks too
            try:
                with (disk / "filler").open("ab") as file:
                    file.write(b"0" * 4096)
            except OSError:
                break
        with pytest.raises(OutError, match=r"No space left on device"):
            do_all(out, campaign)
        assert {name: data for name, data in content(out).items() if name != LOCK} == before
        (disk / "filler").unlink()
        do_all(out, campaign)
        assert stale(out) == []


@pytest.mark.skipif(not Path("/bin/mount").exists(), reason="no mount command")
def test_a_folder_that_may_only_be_read(tmp_path, campaign):
    disk = tmp_path / "disk"
    with mounted(disk, "size=4m"):
        out = disk / "out"
        do_all(out, campaign)
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        assert stale(out) == []  # reading goes on
        assert len(Store.open(out).read("steady")) == 2
        with pytest.raises(OutError, match=r"Read-only file system\).*another --out"):
            do_all(out, campaign)
        with pytest.raises(OutError, match=r"Read-only file system\)"):
            do_all(disk / "new", campaign)


def test_a_file_in_the_way_of_the_staging_is_one_line(out, campaign, monkeypatch):
    def refuse(*_args, **_kwargs):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    do_all(out, campaign)
    monkeypatch.setattr(Path, "mkdir", refuse)
    with (
        pytest.raises(OutError, match=r"Permission denied\)\. Choose another --out, or fix the rights"),
        Store.writing(out) as store,
    ):
        do(store, "report")


def test_the_state_is_read_back_as_it_was_written(out, campaign):
    do_all(out, campaign, rig(campaign.parent, "# ümlaut"))
    state = State.read(out)
    assert json.loads(to_json(state.as_dict())) == json.loads((out / "state.json").read_text())
    assert state.config.text == "# ümlaut"
