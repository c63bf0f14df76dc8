import errno
import json
import os
import re
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import fake_parts
import pandas as pd
import pyarrow as pa
import pytest

from sealfit import cli
from sealfit.errors import CampaignError, Fault, FitError
from sealfit.report import summary_lines
from sealfit.store.manifest import STEPS

ROOT = Path(__file__).resolve().parent.parent
COMMANDS = sorted(command.name or command.callback.__name__ for command in cli.app.registered_commands)


@pytest.fixture
def parts(monkeypatch):
    return fake_parts.put_in(monkeypatch)


@pytest.fixture
def campaign(tmp_path):
    folder = tmp_path / "campaign"
    folder.mkdir()
    (folder / "runs.csv").write_text("file\na.csv\n")
    (folder / "a.csv").write_text("1")
    return folder


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


class Ended:
    def __init__(self, code, captured):
        self.code, self.stdout, self.stderr = code, captured.out, captured.err

    @property
    def json(self):
        return json.loads(self.stdout, parse_constant=pytest.fail)


@pytest.fixture
def sealfit(monkeypatch, capsys):
    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["sealfit", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            sys.exit(cli.exit_code(cli.app))
        return Ended(ended.value.code or 0, capsys.readouterr())

    return call


# ---------------------------------------------------------------- help, documents, start-up
def test_the_commands_are_those_of_the_design():
    assert set(COMMANDS) >= {
        "ingest", "fit-steady", "fit-aging", "fit-dynamic", "close-loop", "report", "run", "predict",
        "lifetime", "effects", "simulate", "check",
    }  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_and_is_in_the_reference(sealfit, command):
    ended = sealfit(command, "--help")
    assert ended.code == 0
    assert "--json" in ended.stdout
    reference = (ROOT / "docs" / "reference" / "commands.md").read_text("utf-8")
    assert f"## `sealfit {command}`" in reference
    for option in re.findall(r"--[a-z]+", ended.stdout):
        assert re.search(rf"{option}\b", reference), option


def test_help_lists_every_command_whole(sealfit):
    ended = sealfit("--help")
    assert all(re.search(rf"^  {command} +\w.*\.$", ended.stdout, re.MULTILINE) for command in COMMANDS)
    assert "..." not in ended.stdout.split("Commands:")[1]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example_and_plain_arguments(sealfit, command):
    ended = sealfit(command, "-h")
    assert f"Example: sealfit {command} " in " ".join(ended.stdout.split())
    assert "{" not in ended.stdout


def test_the_summary_names_the_settings_of_the_next_runs(sealfit, parts, campaign, out):
    ended = sealfit("run", campaign, "--out", out)
    assert "next runs   a second load would separate them: load_N 98\n" in ended.stdout


@pytest.mark.parametrize(
    ("own", "expected"),
    [
        (("speed_mm_s", 20.0, {"speed_mm_s": "mm/s"}), "speed_mm_s 20"),
        (("speed_mm_s", 20.0, {"speed_mm_s": "rpm"}), "speed_mm_s 20 rpm"),
        (("speed_mm_s", 0.05, {"speed_mm_s": "m/s"}), "speed_mm_s 0.05 m/s"),
        (("rubber", "NBR", {}), "rubber NBR"),
    ],
)
def test_a_setting_has_its_unit_where_the_name_does_not_say_it(own, expected):
    assert summary_lines._setting(*own) == expected


def test_the_report_opens_in_the_browser(sealfit, parts, campaign, out, monkeypatch):
    opened = []
    monkeypatch.setattr(cli.typer, "launch", opened.append)
    sealfit("run", campaign, "--out", out)
    assert sealfit("report", out, "--open").code == 0
    assert opened == [str(out / "report.html")]


def test_the_command_line_starts_without_the_heavy_libraries():
    heavy = ("numpy", "pandas", "scipy", "pyarrow", "matplotlib", "pydantic", "rich", "distributed")
    program = f"import sys, sealfit.cli; print([name for name in {heavy} if name in sys.modules])"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout == "[]\n"


def test_version(sealfit):
    assert re.fullmatch(r"sealfit \d+\.\d+\.\d+\n", sealfit("--version").stdout)


def test_processes_here_and_a_cluster_exclude_each_other(sealfit, campaign, out):
    ended = sealfit("run", campaign, "--out", out, "--workers", 2, "--scheduler", "tcp://127.0.0.1:1")
    assert ended.code == 2
    assert "either --workers (this computer) or --scheduler" in ended.stderr
    assert not out.exists()


# ---------------------------------------------------------------- exit codes
@pytest.mark.parametrize(
    "arguments",
    [[], ["rum"], ["run"], ["run", "c"], ["ingest", "c", "--out", "o", "--workers", "0"], ["run", "--bad"]],
)
def test_wrong_usage_is_2(sealfit, arguments):
    ended = sealfit(*arguments)
    assert ended.code == 2
    assert ended.stdout == ""
    assert "Usage: sealfit" in ended.stderr
    ended = sealfit(*arguments, "--json")
    assert ended.code == 2
    assert ended.json["ok"] is False
    assert len(ended.json["errors"]) == 1


@pytest.mark.parametrize("value", ["two", "2.5", "0"])
def test_a_refused_value_of_an_option_is_named(sealfit, value):
    ended = sealfit("run", "c", "--out", "o", "--workers", value)
    assert ended.code == 2
    assert ended.stderr.splitlines()[-1].startswith("sealfit: Invalid value for '--workers': ")
    assert value in ended.stderr.splitlines()[-1]


def test_a_campaign_at_fault_is_1_and_leaves_no_out(sealfit, parts, campaign, out):
    parts.raises["ingest"] = CampaignError(
        [Fault("twice", "is listed twice.", "runs.csv", None, 3, fix="Drop one.")]
    )
    ended = sealfit("run", campaign, "--out", out)
    assert (ended.code, ended.stdout) == (1, "")
    assert "sealfit: runs.csv:3: is listed twice. Drop one.\n" in ended.stderr
    assert not out.exists()
    error = sealfit("run", campaign, "--out", out, "--json").json["errors"][0]
    assert {"file", "line", "column", "value", "fix", "reason"} <= set(error)
    assert (error["file"], error["line"], error["fix"]) == ("runs.csv", 3, "Drop one.")


def test_ctrl_c_is_130_one_line_and_out_is_intact(sealfit, parts, campaign, out):
    assert sealfit("ingest", campaign, "--out", out).code == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    parts.raises["fit-steady"] = KeyboardInterrupt()
    ended = sealfit("run", campaign, "--out", out)
    assert ended.code == 130
    assert ended.stderr.splitlines()[-1] == "sealfit: interrupted; what was complete before is kept."
    assert ended.stderr.count("interrupted") == 1
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert sealfit("run", campaign, "--out", out, "--json").json["ok"] is False


def test_a_bug_is_70_and_keeps_its_traceback(sealfit, parts, campaign, out):
    parts.raises["fit-steady"] = ZeroDivisionError("a\nbug")
    ended = sealfit("run", campaign, "--out", out)
    assert (ended.code, ended.stdout) == (70, "")
    assert "Traceback (most recent call last):" in ended.stderr
    assert "fake_parts.py" in ended.stderr
    assert "ZeroDivisionError: a\nbug" in ended.stderr
    assert ended.stderr.splitlines()[-1].startswith("sealfit: this is a bug. Please report it")


@pytest.mark.parametrize(
    ("arguments", "at"),
    [
        (["run", "c", "--out", "o"], "sealfit.pipeline.run"),
        (["ingest", "c", "--out", "o"], "sealfit.pipeline.run"),
        (["close-loop", "o"], "sealfit.pipeline.single"),
        (["predict", "o", "--points", "p.csv", "--output", "q.csv"], "sealfit.commands.predict"),
        (["lifetime", "o"], "sealfit.commands.lifetime"),
        (["effects"], "sealfit.commands.effects"),
        (["simulate", "s.toml", "--out", "c"], "sealfit.commands.simulate"),
        (["check", "c"], "sealfit.commands.check"),
        (["effects"], "sealfit.store.manifest.to_json"),
    ],
)
def test_a_bug_under_json_leaves_one_object(sealfit, monkeypatch, arguments, at):
    def broken(*given, **named):
        raise ZeroDivisionError("a\nbug")

    monkeypatch.setattr(at, broken)
    ended = sealfit(*arguments, "--json")
    assert ended.code == 70
    assert ended.json["ok"] is False
    (error,) = ended.json["errors"]
    assert error["kind"] == "bug"
    assert error["reason"] == "ZeroDivisionError: a bug"
    assert {"file", "line", "column", "value", "fix", "reason"} <= set(error)
    assert "Traceback (most recent call last):" in ended.stderr


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("array"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        RuntimeError("can't start new thread"),
        ImportError("a.so: failed to map segment from shared object"),
        SystemError("<function _find_and_load at 0x7f> returned NULL without setting an exception"),
        pa.ArrowException("Unknown error: Failed to launch worker thread: Resource temporarily unavailable"),
    ],
)
def test_no_memory_is_one_line_and_1(sealfit, monkeypatch, error):
    def broken(*given, **named):
        try:
            raise error
        except type(error) as first:
            raise ValueError("what a library made of it") from first

    monkeypatch.setattr("sealfit.commands.effects", broken)
    ended = sealfit("effects", "--json")
    assert ended.code == 1
    (told,) = ended.json["errors"]
    assert ended.stderr == f"sealfit: {told['reason']} {told['fix']}\n"
    assert told["reason"].startswith("memory ran out")


def test_a_folder_that_may_not_be_searched_is_one_line_and_1(sealfit, monkeypatch):
    def refused(*_):
        raise PermissionError(errno.EACCES, "Permission denied", "/locked/out")

    monkeypatch.setattr("sealfit.commands.effects", refused)
    ended = sealfit("effects", "/locked/out", "--json")
    assert ended.code == 1
    (told,) = ended.json["errors"]
    assert told["file"] == "/locked/out"
    assert ended.stderr == f"sealfit: /locked/out: {told['reason']} {told['fix']}\n"
    assert told["reason"] == "there is no access (Permission denied)."


@pytest.mark.parametrize("text", ["glob = '{}'", "runs_table = '{}.csv'"])
def test_a_name_longer_than_names_can_be_is_one_line_and_1(sealfit, campaign, tmp_path, text):
    (tmp_path / "rig.toml").write_text("[files]\n" + text.format("x" * 5000))
    ended = sealfit("check", campaign, "--config", tmp_path / "rig.toml")
    assert ended.code == 1
    assert len(ended.stderr.splitlines()) == 1
    assert len(ended.stderr) < 1000
    assert "there is no access (File name too long)" in ended.stderr


@pytest.mark.parametrize("name", ["\x1b[2J", "\x9b2J", "\u202e"])
def test_the_terminal_gets_no_control_characters_from_names(sealfit, campaign, out, tmp_path, name):
    out.mkdir()
    (out / name).write_text("")
    for words in (("ingest", campaign, "--out", out), ("report", tmp_path / name)):
        for option in ((), ("--json",)):
            ended = sealfit(*words, *option)
            assert ended.code == 1
            assert {c for c in ended.stdout + ended.stderr if not c.isprintable()} <= {"\n"}


def test_a_reader_that_leaves_early_is_no_fault():
    program = "import sys; sys.argv = ['sealfit', '--help']; from sealfit.__main__ import main; main()"
    read = subprocess.run(
        ["bash", "-c", f'{sys.executable} -c "{program}" | true'], capture_output=True, text=True
    )
    assert "Traceback" not in read.stderr


# ---------------------------------------------------------------- run and the single steps
def test_run_does_every_step_and_says_so_in_a_few_lines(sealfit, parts, campaign, out):
    ended = sealfit("run", campaign, "--out", out)
    assert ended.code == 0
    assert parts.calls == list(STEPS)
    lines = ended.stdout.splitlines()
    assert 8 <= len(lines) <= 18
    assert "files       1 used, 0 left out" in lines
    assert "steady fit  a 1.5 a" in lines  # of the after-model: nothing in this stand-in's tables has a name
    assert "  before    mu_s 0.7 to 0.8" in lines
    assert "  before    not identified: mu_s in 1 of 3. Too few speeds." in lines
    sentence = "one effect was added; no significant residual remains; the error is within the scatter"
    assert f"verdict     closed: {sentence} of repeats" in lines
    assert "            + lead-screw ripple: A 0.25 [0.2, 0.3] N, n unknown" in lines
    assert "              reference state of the coefficients: mean over a wavelength" in lines
    assert (
        "error (N)   rmse 0.4 -> 0.2; held out 0.5 -> unknown; run means 0.3 -> 0.3; largest 1.5 -> 1.5"
        in lines
    )
    assert f"report      {out / 'report.html'}" in lines
    assert "reading trace files: 1 of 1" in ended.stderr
    assert "trying ripple" in ended.stderr


def test_a_second_run_redoes_nothing_and_prints_the_same(sealfit, parts, campaign, out):
    first = sealfit("run", campaign, "--out", out)
    parts.calls.clear()
    second = sealfit("run", campaign, "--out", out)
    assert second.stdout == first.stdout
    assert parts.calls == []
    assert second.stderr.count("current, not redone") == len(STEPS)
    assert sealfit("run", campaign, "--out", out, "--json").json["done"] == []
    assert sealfit("run", campaign, "--out", out, "--json", "--force").json["done"] == list(STEPS)


def test_run_redoes_exactly_what_is_stale(sealfit, parts, campaign, out, tmp_path):
    config = tmp_path / "rig.toml"
    config.write_text("name = 'rig'")
    assert sealfit("run", campaign, "--out", out, "--config", config).code == 0
    config.write_text("name = 'rig'\n[loop]\nseed = 4")
    ended = sealfit("run", campaign, "--out", out, "--config", config, "--json")
    assert ended.json["done"] == ["close-loop", "report"]
    assert "close-loop is stale: the config (rig.toml) changed" in ended.stderr
    (campaign / "a.csv").write_text("2")
    assert sealfit("run", campaign, "--out", out, "--config", config, "--json").json["done"] == list(STEPS)


def test_each_step_sees_only_what_its_key_holds(sealfit, parts, campaign, out, tmp_path):
    config = tmp_path / "rig.toml"
    config.write_text("[loop]\nseed = 4\n[sensor]\naccuracy = 0.9")
    sealfit("run", campaign, "--out", out, "--config", config)
    assert parts.configs["ingest"].sensor.accuracy == 0.2
    assert parts.configs["fit-steady"].sensor.accuracy == 0.9
    assert [parts.configs[step].loop.seed for step in STEPS] == [1, 1, 1, 1, 4, 4]


def test_the_steps_one_by_one_are_the_run(sealfit, parts, campaign, out, tmp_path):
    whole = sealfit("run", campaign, "--out", tmp_path / "whole")
    said = sealfit("ingest", campaign, "--out", out).stdout
    for step in STEPS[1:]:
        ended = sealfit(step, out)
        assert ended.code == 0
        said += ended.stdout
    whole = whole.stdout.replace(str(tmp_path / "whole"), str(out))
    texts = [sorted({line[12:] for line in lines.splitlines()}) for lines in (said, whole)]
    assert texts[0] == texts[1]  # a run says what was before beside what is after


def test_workers_reach_the_loop(sealfit, parts, campaign, out):
    sealfit("run", campaign, "--out", out, "--workers", 3)
    assert parts.workers == 3
    sealfit("close-loop", out, "--force", "--workers", 5)
    assert parts.workers == 5


def test_a_step_without_its_predecessor_names_the_command(sealfit, parts, campaign, out):
    sealfit("ingest", campaign, "--out", out)
    ended = sealfit("close-loop", out)
    assert ended.code == 1
    assert ended.stderr == f"sealfit: {out}: fit-steady has not been done. Run: sealfit fit-steady {out}\n"
    (campaign / "a.csv").write_text("2")
    ended = sealfit("fit-steady", out, "--json")
    assert ended.code == 1
    assert ended.json["errors"][0]["fix"] == f"Run: sealfit ingest {campaign} --out {out}"


def test_a_step_that_fails_keeps_those_before_it(sealfit, parts, campaign, out):
    parts.raises["fit-steady"] = FitError("condition a: too few speeds.", fix="Measure more.")
    ended = sealfit("run", campaign, "--out", out)
    assert (ended.code, ended.stdout) == (1, "")
    assert ended.stderr.splitlines()[-1] == "sealfit: condition a: too few speeds. Measure more."
    del parts.raises["fit-steady"]
    assert sealfit("run", campaign, "--out", out, "--json").json["done"] == list(STEPS[1:])


def test_faults_are_said_and_counted_and_strict_stops(sealfit, parts, campaign, out):
    parts.faults = [fake_parts.FAULT]
    ended = sealfit("run", campaign, "--out", out)
    assert ended.code == 0
    assert (
        "warning: a.csv:3: column 'force_N': 'x': is not a number. Fix the cell. [row left out]"
        in ended.stderr
    )
    assert "faults      0 errors, 1 warning; left out: 1 row (table quality)" in ended.stdout
    parts.faults = [fake_parts.FAULT, replace(fake_parts.FAULT, line=None)]
    parts.calls.clear()
    for arguments in (["--strict", "--force"], ["--strict"]):
        ended = sealfit("run", campaign, "--out", out, "--json", *arguments)
        assert ended.code == 1
        assert [error["line"] for error in ended.json["errors"]] == [3, None]
    assert parts.calls == ["ingest"]
    assert sealfit("ingest", campaign, "--out", out, "--strict").code == 1


def test_many_faults_are_cut_short(sealfit, parts, campaign, out):
    parts.faults = [fake_parts.FAULT] * 100
    ended = sealfit("ingest", campaign, "--out", out)
    assert ended.stderr.count("is not a number") == 20
    assert "and 80 more: `sealfit check`" in ended.stderr


def test_an_effect_that_is_not_named_or_not_applied_is_said_so(sealfit, parts, campaign, out):
    unnamed = {**fake_parts.EFFECT, "label": "smooth in time", "named": False}
    candidate = {**fake_parts.EFFECT, "candidate": True}
    parts.closure = {**fake_parts.CLOSURE, "effects": [unnamed, candidate]}
    lines = sealfit("run", campaign, "--out", out).stdout.splitlines()
    assert "            + smooth in time: no closed form fits as well" in lines
    assert "            candidate, not applied: lead-screw ripple: A 0.25 [0.2, 0.3] N, n unknown" in lines
    assert "closed: one effect was added" in "".join(lines)


@pytest.mark.parametrize(
    ("verdict", "effects", "left", "expected"),
    [
        ("nothing_missing", [], [None, None, None], "no effect beyond the declared model is significant"),
        (
            "unexplained",
            [],
            ["run", "elapsed_h", 0.00123],
            "no effect was added; a significant residual remains along time since first run (h) between runs"
            " (p = 0.0012)",
        ),
        ("closed", [fake_parts.EFFECT] * 2, [None, None, None], "2 effects were added; no significant"),
    ],
)
def test_the_verdict_is_a_sentence(sealfit, parts, campaign, out, verdict, effects, left, expected):
    level, channel, p_value = left
    left = {"rmse_N": 0.2, "level": level, "channel": channel, "p_value": p_value}
    left["significant"] = verdict == "unexplained"
    parts.closure = {**fake_parts.CLOSURE, "verdict": verdict, "effects": effects, "left": left}
    assert f"verdict     {verdict}: {expected}" in sealfit("run", campaign, "--out", out).stdout


def test_a_file_that_the_loop_left_out_is_named_beside_the_verdict(sealfit, parts, campaign, out):
    outliers = [{"file": "a.csv", "deviation_pct": 12.3, "p_value": 1e-5}]
    parts.closure = {**fake_parts.CLOSURE, "outlier_files": outliers}
    assert "what all others predict: a.csv (+12 %)" in sealfit("run", campaign, "--out", out).stdout


def test_held_out_errors_that_are_all_extrapolated_are_said_to_be(sealfit, parts, campaign, out):
    errors = {**fake_parts.ERRORS, "heldout_rmse_N": None, "heldout_extrapolated_rmse_N": 3.0}
    parts.closure = {**fake_parts.CLOSURE, "before": errors, "after": errors}
    printed = sealfit("run", campaign, "--out", out).stdout
    assert "rmse 0.4 -> 0.4; held out, all extrapolated 3 -> 3; run means" in printed


# ---------------------------------------------------------------- check
def test_check_lists_every_fault_and_writes_nothing(sealfit, parts, campaign, tmp_path):
    parts.faults = [fake_parts.FAULT] * 30
    before = sorted(tmp_path.rglob("*"))
    ended = sealfit("check", campaign)
    assert ended.code == 1
    assert ended.stdout.count("warning: a.csv:3: column 'force_N'") == 30
    assert ended.stdout.endswith("30 faults found.\n")
    assert sorted(tmp_path.rglob("*")) == before
    ended = sealfit("check", campaign, "--json")
    assert ended.code == 1
    assert len(ended.json["errors"]) == 30


def test_check_of_a_sound_campaign_is_0(sealfit, parts, campaign):
    ended = sealfit("check", campaign)
    assert ended.code == 0
    assert ended.stdout.endswith("No faults found.\n")
    assert sealfit("check", campaign, "--json").json["errors"] == []


def test_check_lists_faults_that_would_stop_a_run(sealfit, parts, campaign):
    parts.raises["ingest"] = CampaignError([Fault("twice", "is listed twice.", "runs.csv")] * 2)
    ended = sealfit("check", campaign)
    assert ended.code == 1
    assert ended.stdout == "error: runs.csv: is listed twice.\n" * 2 + "2 faults found.\n"


# ---------------------------------------------------------------- wrong places
def test_wrong_places_come_with_the_likeliest_right_one(sealfit, parts, campaign, out, tmp_path):
    def fault(*arguments):
        ended = sealfit(*arguments)
        assert (ended.code, ended.stdout) == (1, "")
        assert ended.stderr.count("\n") == 1
        return ended.stderr

    assert f"Did you mean {campaign}?" in fault("run", tmp_path / "campain", "--out", out)
    assert f"Did you mean {campaign}?" in fault("run", tmp_path / "campain" / "deeper", "--out", out)
    assert f"Give its folder: {campaign}" in fault("run", campaign / "runs.csv", "--out", out)
    assert f"has no runs.csv. Did you mean {campaign}?" in fault("run", tmp_path, "--out", out)
    assert "rig.toml: cannot be read" in fault(
        "run", campaign, "--out", out, "--config", tmp_path / "rig.toml"
    )
    assert not out.exists()
    sealfit("run", campaign, "--out", out)
    assert f"Did you mean {out}?" in fault("fit-steady", tmp_path / "oot")
    assert "sealfit run CAMPAIGN --out" in fault("fit-steady", tmp_path)
    assert "no.csv: there is no such table of points. Fix" in fault(
        "predict", out, "--points", "no.csv", "--output", "q.csv"
    )
    (tmp_path / "points.csv").write_text("a\n1\n")
    arguments = ("--points", tmp_path / "point.csv", "--output", tmp_path / "q.csv")
    assert f"Did you mean {tmp_path / 'points.csv'}?" in fault("predict", out, *arguments)
    for asked in (("check", "gone"), ("predict", out, "--points", "gone", "--output", "q.csv")):
        (told,) = sealfit(*asked, "--json").json["errors"]
        assert (told["file"], told["fix"]) == ("gone", "Fix the path.")


def test_effects_are_never_read_from_a_campaign(sealfit, parts, campaign, out):
    (campaign / "mine").mkdir()
    (campaign.parent / "rig.toml").write_text("[loop]\neffects_folder = 'campaign/mine'")
    ended = sealfit("run", campaign, "--out", out, "--config", campaign.parent / "rig.toml")
    assert ended.code == 1
    assert f"mine lies in {campaign}, and Python is never run from there. Read the files" in ended.stderr


# ---------------------------------------------------------------- predict
@pytest.fixture
def done(sealfit, parts, campaign, out):
    assert sealfit("run", campaign, "--out", out).code == 0
    return out


def predict(sealfit, done, tmp_path, text, *more):
    points = tmp_path / "points.csv"
    points.write_bytes(text if isinstance(text, bytes) else text.encode())
    return sealfit("predict", done, "--points", points, "--output", tmp_path / "q.csv", *more)


def test_predict_gives_back_the_points_as_written_and_their_answers(sealfit, done, tmp_path):
    ended = predict(sealfit, done, tmp_path, '\ufeffbatch,speed_mm_s\r\n007,1.50\r\n\r\n"a,b",2\r\n')
    assert ended.code == 0
    assert ended.stdout.startswith("points      1 of 2 rows predicted, 0 extrapolated; 1 row not predicted")
    answers = pd.read_csv(tmp_path / "q.csv", dtype=str, keep_default_na=False)
    assert list(answers.columns) == [
        "batch", "speed_mm_s", "force_before_N", "force_after_N", "force_after_lo95_N", "force_after_hi95_N",
        "meas_lo95_N", "meas_hi95_N", "extrapolated", "note",
    ]  # fmt: skip
    assert list(answers["batch"]) == ["007", "a,b"]
    assert list(answers["speed_mm_s"]) == ["1.50", "2"]
    assert list(answers["force_after_N"]) == ["1.0", ""]
    assert answers["note"][1] == "cannot be answered"
    told = predict(sealfit, done, tmp_path, "speed_mm_s\n1\n", "--json").json
    assert told["rows"] == 1
    assert told["includes"] == [e["label"] for e in fake_parts.CLOSURE["effects"] if not e["candidate"]]
    assert ("force_after_N is what the sensor would read" in ended.stdout) == bool(told["includes"])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "is empty"),
        ("speed_mm_s\n", "has no rows"),
        ("a;b\n1;2\n", "is not separated by commas"),
        ("a,a\n1,2\n", "column 'a': appears twice"),
        ("a,b\n1,2\n1,2,3\n", "points.csv:3: has 3 cells, and there are 2 columns"),
        ("note\nx\n", "column 'note': is a column of the answer"),
        (b"a\n\xff\n", "is not UTF-8"),
    ],
)
def test_predict_says_what_is_wrong_with_the_points(sealfit, done, tmp_path, text, expected):
    ended = predict(sealfit, done, tmp_path, text)
    assert (ended.code, ended.stdout) == (1, "")
    assert expected in ended.stderr
    assert not (tmp_path / "q.csv").exists()


def test_predict_needs_a_closed_loop(sealfit, done, campaign, tmp_path):
    (campaign / "a.csv").write_text("2")
    ended = predict(sealfit, done, tmp_path, "a\n1\n")
    assert ended.code == 1
    assert "ingest is stale: inputs changed (a.csv). Run: sealfit ingest" in ended.stderr


def test_predict_never_overwrites_the_points(sealfit, done, tmp_path):
    points = tmp_path / "points.csv"
    points.write_text("a\n1\n")
    ended = sealfit("predict", done, "--points", points, "--output", points)
    assert ended.code == 1
    assert points.read_text() == "a\n1\n"
    assert (
        "there is no folder"
        in sealfit("predict", done, "--points", points, "--output", tmp_path / "n/q.csv").stderr
    )
    assert "is a folder" in sealfit("predict", done, "--points", points, "--output", tmp_path).stderr
    os.mkfifo(tmp_path / "pipe")
    assert (
        "pipe is no file"
        in sealfit("predict", done, "--points", points, "--output", tmp_path / "pipe").stderr
    )
    assert stat.S_ISFIFO(os.stat(tmp_path / "pipe").st_mode)  # and so for a device: it is not replaced
    kept = (done / "model.json").read_bytes()
    ended = sealfit("predict", done, "--points", points, "--output", done / "model.json")
    assert "Give a name that ends in .csv." in ended.stderr
    assert (done / "model.json").read_bytes() == kept


# ---------------------------------------------------------------- simulate
def test_simulate_names_campaign_and_truth_and_replaces_only_when_told(sealfit, parts, tmp_path):
    spec, made = tmp_path / "spec.toml", tmp_path / "deep" / "made"
    spec.write_text("one")
    ended = sealfit("simulate", spec, "--out", made)
    assert ended.code == 0
    assert ended.stdout == f"1 trace files in {made}\ntruth: {made}.truth.json\n"
    spec.write_text("two")
    assert (
        "is there already. Choose another --out, or replace it"
        in sealfit("simulate", spec, "--out", made).stderr
    )
    assert (made / "a.csv").read_text() == "one\n"
    assert sealfit("simulate", spec, "--out", made, "--force").code == 0
    assert (made / "a.csv").read_text() == "two\n"
    assert "there is no such spec" in sealfit("simulate", tmp_path / "none.toml", "--out", made).stderr
