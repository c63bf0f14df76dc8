"""The whole chain for real: a simulated campaign from CSV to report and predictions, and interruptions."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import redirect_stderr, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from drawing_helpers import undrawn
from truths import true_force

from sealfit.cli import app, exit_code
from sealfit.pipeline import MADE, TABLES
from sealfit.simulation import load_truth
from sealfit.store import Store
from sealfit.store.manifest import STEPS
from sealfit.tables import AFTER, SCHEMAS

SPEC = """
name = "pipeline"
seed = 11
[design]
days = [2, 4, 8, 16]
speeds_mm_s = [0.5, 2, 5, 20, 50]
repeats = 2
max_rows = 120
[[noise]]
kind = "white"
sd_N = 0.2
[[noise]]
kind = "repeat_gain"
sd_rel = 0.01
"""
ERROR_KEYS = {
    "rmse_N", "rmse_runs_N", "heldout_rmse_N", "heldout_extrapolated_rmse_N", "max_abs_N", "mean_abs_pct",
    "lack_of_fit_p",
}  # fmt: skip
KEYS = {
    "schema", "verdict", "units", "noise_floor_N", "before", "after", "heldout_unit", "effects", "scatter",
    "left",
    "next_runs", "outlier_files", "fit_quality", "sensitivity", "refused", "incomplete_channels",
}  # fmt: skip
TIMES = ("provenance.json", "state.json", "report.html")  # hold times of day


def sealfit(*arguments, code=0):
    """Run a command in this process, which has loaded the libraries, and draw nothing."""
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as out:
        patch.setattr(sys, "argv", ["sealfit", *map(str, arguments)])
        patch.setattr("sealfit.report.page.draw", undrawn)
        with redirect_stderr(StringIO()) as err:
            ended = exit_code(app)
    assert ended == code, err.getvalue()
    return SimpleNamespace(stdout=out.getvalue(), stderr=err.getvalue())


def started(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "sealfit", *map(str, arguments)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def tables(out):
    return {name: pd.read_parquet(out / f"{name}.parquet") for name in TABLES}


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pipeline")
    (folder / "spec.toml").write_text(SPEC)
    sealfit("simulate", folder / "spec.toml", "--out", folder / "campaign")
    return folder / "campaign"


@pytest.fixture(scope="module")
def first(campaign):
    out = campaign.parent / "out"
    words = [sys.executable, "-m", "sealfit", "run", campaign, "--out", out]
    return out, subprocess.run(words, capture_output=True, text=True, check=True)


def test_a_run_gives_every_table_with_its_schema(first):
    out, _ = first
    for name in TABLES:
        schema = ds.dataset(out / f"{name}.parquet", partitioning=None).schema
        fixed = SCHEMAS[name].columns
        assert schema.names[: len(fixed)] == [column.name for column in fixed]
        assert [schema.field(column.name).type for column in fixed] == [column.dtype for column in fixed]
        assert all(schema.field(column.name).metadata[b"meaning"] for column in fixed)
    assert {path.suffix for path in (out / "plots").iterdir()} == {".pdf", ".png", ".svg"}
    assert "<html" in (out / "report.html").read_text("utf-8")[:2000].lower()


def test_closure_json_has_every_key_and_no_nan(first):
    out, _ = first
    closure = json.loads((out / "closure.json").read_text("utf-8"), parse_constant=pytest.fail)
    assert set(closure) == KEYS
    assert set(closure["before"]) == set(closure["after"]) == ERROR_KEYS
    assert set(closure["left"]) == {"rmse_N", "level", "channel", "p_value", "significant"}
    assert closure["verdict"] == "nothing_missing"
    assert closure["before"] == closure["after"]
    assert closure["noise_floor_N"] > 0


def test_where_nothing_is_missing_after_is_before(first):
    out, _ = first
    assert all(pd.read_parquet(out / f"{after.name}.parquet").empty for after in AFTER)
    assert set(pd.read_parquet(out / "aging_fit.parquet")["model"]) == {"before"}
    asked = ("lifetime", out, "--threshold", "0.75", "--json")
    after, before = (json.loads(sealfit(*asked, *model).stdout) for model in ((), ("--model", "before")))
    assert (after.pop("model"), before.pop("model")) == ("after", "before")
    assert after == before
    said = sealfit(*asked[:-1]).stdout
    assert said.startswith("model       after: no effect was added\n")
    assert sealfit(*asked[:-1], "--model", "both", code=1).stderr.startswith(
        "sealfit: there is no model 'both'."
    )


@pytest.mark.parametrize(("lost", "offered"), [("closure.json", True), ("steady_fit.parquet", False)])
def test_lifetime_offers_the_declared_model_where_its_fits_are_current(first, tmp_path, lost, offered):
    shutil.copytree(first[0], tmp_path / "out")
    (tmp_path / "out" / lost).unlink()
    said = sealfit("lifetime", tmp_path / "out", "--threshold", "0.75", code=1).stderr
    assert "Run: sealfit" in said
    assert ("--model before" in said) == offered


def test_a_run_ends_with_a_short_summary(first):
    out, run = first
    lines = run.stdout.splitlines()
    assert 7 <= len(lines) <= 14
    verdict = "verdict     nothing_missing: no effect beyond the declared model is significant"
    assert lines[0].startswith(verdict)
    assert "files       50 used, 0 left out" in lines
    assert lines[-1] == f"report      {out / 'report.html'}"
    assert "reading trace files: 50 of 50" in run.stderr


def test_a_second_run_redoes_nothing_and_says_the_same(first, campaign):
    out, run = first
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    again = sealfit("run", campaign, "--out", out)
    assert again.stdout == run.stdout
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before


def test_results_do_not_depend_on_the_number_of_workers(first, campaign, tmp_path):
    out, _ = first
    sealfit("ingest", campaign, "--out", tmp_path / "out", "--workers", 1)
    for name in MADE["ingest"]:
        one, many = (pd.read_parquet(folder / f"{name}.parquet") for folder in (tmp_path / "out", out))
        pd.testing.assert_frame_equal(one, many)


def test_json_is_one_object_with_the_same_figures(first, campaign):
    out, _ = first
    said = json.loads(sealfit("run", campaign, "--out", out, "--json").stdout, parse_constant=pytest.fail)
    assert said["ok"] is True
    assert said["done"] == []
    assert said["ingest"]["files"]["used"] == 50
    assert said["close_loop"]["verdict"] == "nothing_missing"
    assert Path(said["report"]["file"]).is_file()


def test_predictions_lie_near_the_truth(first, campaign, tmp_path):
    out, _ = first
    points = pd.DataFrame(
        {"temperature_C": 60.0, "compression_ratio_pct": 80.0, "aging_days": [2.0, 6.0, 16.0, 16.0]}
        | {"load_N": 49.03, "speed_mm_s": [1.0, 5.0, 20.0, 40.0]}
    )
    points.to_csv(tmp_path / "p.csv", index=False)
    sealfit("predict", out, "--points", tmp_path / "p.csv", "--output", tmp_path / "q.csv")
    answers = pd.read_csv(tmp_path / "q.csv")
    truth = true_force(load_truth(campaign.with_name("campaign.truth.json")), points)
    # A file's gain scatters by 1 %; the mean of 80 files and four days is known to a fraction of that.
    np.testing.assert_allclose(answers["force_after_N"], truth, rtol=0.02)
    assert (answers["meas_lo95_N"] < truth).all()
    assert (truth < answers["meas_hi95_N"]).all()
    assert not answers["extrapolated"].any()


def test_a_changed_file_is_found_and_everything_after_it_redone(first, campaign, tmp_path):
    copy, out = tmp_path / "campaign", tmp_path / "out"
    subprocess.run(["cp", "-r", campaign, copy], check=True)
    subprocess.run(["cp", "-r", first[0], out], check=True)
    moved = sealfit("run", copy, "--out", out, "--json")
    assert json.loads(moved.stdout)["done"] == []
    assert "holds the same data" in moved.stderr
    trace = sorted((copy / "traces").iterdir())[0]
    trace.write_text(trace.read_text().replace("time_s,", "time_s,", 1) + "oops,no,1\n")
    for words in (["fit-steady", out], ["report", out]):
        assert f"inputs changed (traces/{trace.name}). Run: sealfit ingest" in sealfit(*words, code=1).stderr
    run = sealfit("run", copy, "--out", out, "--json")
    assert json.loads(run.stdout)["done"] == list(STEPS)
    assert f"traces/{trace.name}:" in run.stderr
    assert json.loads(run.stdout)["ingest"]["rows_left_out"] == 1
    refused = sealfit("run", copy, "--out", tmp_path / "strict", "--strict", "--json", code=1)
    assert json.loads(refused.stdout)["errors"][0]["file"] == f"traces/{trace.name}"
    assert sealfit("check", copy, code=1).stdout.endswith("2 faults found.\n")


@pytest.mark.parametrize("moved", [pytest.param(False, marks=pytest.mark.long), True])
def test_a_damaged_part_of_a_table_is_made_again(first, campaign, tmp_path, moved):
    out, copy = tmp_path / "out", tmp_path / "campaign"
    if moved:  # then state.json is written before anything is read
        subprocess.run(["cp", "-r", campaign, copy], check=True)
    subprocess.run(["cp", "-r", first[0], out], check=True)
    part = next((out / "traces.parquet").iterdir())
    whole = part.read_bytes()
    part.write_bytes(whole[:1000] + bytes([whole[1000] ^ 1]) + whole[1001:])
    assert (
        f"its traces.parquet/{part.name} is missing or was changed" in sealfit("report", out, code=1).stderr
    )
    again = sealfit("run", copy if moved else campaign, "--out", out, "--json")
    assert "ingest" in json.loads(again.stdout)["done"]
    assert part.read_bytes() == whole


def locked(out):
    until = time.monotonic() + 20
    while not (out / ".lock").exists() and time.monotonic() < until:
        time.sleep(0.02)


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")
def test_kills_lose_nothing_and_the_next_run_goes_on(first, campaign, tmp_path):
    whole, _ = first
    out = tmp_path / "out"
    killed = 0
    for said in (
        None,
        "fitting 5",
        "fitting the pre",
        "round 1",
        "drawing",
    ):  # each goes on where the last one ended
        run = started("run", campaign, "--out", out)
        if said is None:
            locked(out)
            killed += 1
        else:
            killed += any(
                line.startswith(said) for line in run.stderr
            )  # on a busy machine a kill may come a step late
        with suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
        run.communicate()
        if not (out / "state.json").exists():
            continue
        store = Store.open(out)
        for step in STEPS:
            if not store.why_stale(step):
                for name in store.state.steps[step].files:
                    if name.endswith(".parquet"):
                        pq.read_table(out / name)
    assert killed >= 3
    sealfit("run", campaign, "--out", out)
    for name, table in tables(out).items():
        pd.testing.assert_frame_equal(table, pd.read_parquet(whole / f"{name}.parquet"), check_exact=True)
    assert not list(out.glob(".*"))


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")
@pytest.mark.parametrize("said", ["fitting", "round 1"])
def test_ctrl_c_ends_a_run_with_one_line(campaign, tmp_path, said):
    run = started("run", campaign, "--out", tmp_path / "out")
    assert any(line.startswith(said) for line in run.stderr)
    os.killpg(run.pid, signal.SIGINT)
    _, stderr = run.communicate(timeout=60)
    assert run.returncode == 130
    assert stderr.splitlines()[-1] == "sealfit: interrupted; what was complete before is kept."
    assert "Traceback" not in stderr
    assert Store.open(tmp_path / "out").why_stale("close-loop")  # it did not go on to the end of the step


def test_a_second_run_at_the_same_time_is_refused(campaign, tmp_path):
    out = tmp_path / "out"
    with started("run", campaign, "--out", out) as run:
        locked(out)
        time.sleep(0.1)
        os.killpg(run.pid, signal.SIGSTOP)  # a small campaign may be done before the second has started
        refused = sealfit("run", campaign, "--out", out, code=1)
        assert f"process {run.pid}) is writing here" in refused.stderr
        assert run.poll() is None
        os.killpg(run.pid, signal.SIGKILL)
        run.communicate()
