from pathlib import Path

import pytest
from trace_helpers import DAYS, campaign, config, trace

from sealfit.config import Config
from sealfit.errors import CampaignError, ConfigError, Fault, did_you_mean, grouped, nearest, told
from sealfit.ingest.campaign import ingest_campaign
from sealfit.ingest.quality import quality_table
from sealfit.progress import Lines
from sealfit.report.page import quality_findings
from sealfit.store.manifest import ConfigCopy

FIX = 'Set decimal = "," in the rig config.'


def comma(i, line=2, value="1,84"):
    place = {"line": line, "column": "Kraft", "value": value, "action": "row left out", "fix": FIX}
    return Fault("not_a_number", "is not a number.", file=f"raw/{i}.csv", **place)


def test_what_84_files_share_is_one_message_with_a_count_and_three_examples():
    other = Fault("empty_file", "is empty.", file="raw/7.csv")
    faults = [comma(i) for i in range(7)] + [other] + [comma(i) for i in range(7, 84)]
    shared, alone = grouped(faults)
    assert told(shared) == (
        "84 files: column 'Kraft': is not a number. For example raw/0.csv:2: '1,84'; raw/1.csv:2: '1,84'; "
        f"raw/2.csv:2: '1,84'. {FIX}"
    )
    assert told(alone) == "raw/7.csv: is empty."
    assert str(CampaignError(faults)).splitlines() == [told(shared), told(alone)]
    assert len(CampaignError(faults).as_dicts()) == 85


def test_three_files_are_named_one_by_one_and_the_lines_of_one_file_together():
    faults = [comma(i) for i in range(3)] + [comma(9, line) for line in range(2, 30)]
    assert [len(group) for group in grouped(faults[:3])] == [1, 1, 1]
    assert [len(group) for group in grouped(faults[3:6])] == [1, 1, 1]
    (group,) = grouped(faults[3:])
    assert told(group).startswith(
        "28 lines of raw/9.csv: column 'Kraft': is not a number. For example raw/9.csv:2"
    )
    (group,) = grouped(faults)
    assert told(group).startswith("4 files, 31 times: column 'Kraft': ")


def test_lines_of_runs_csv_are_files():
    faults = [Fault("not_a_time", "is no time.", file="runs.csv", line=n, value="x") for n in range(2, 8)]
    (group,) = grouped(faults)
    assert (
        told(group) == "6 files: is no time. For example runs.csv:2: 'x'; runs.csv:3: 'x'; runs.csv:4: 'x'."
    )


def test_reasons_that_differ_in_numbers_stand_with_the_examples():
    faults = [
        Fault("too_many", f"{i} of 600 rows are bad.", file=f"{i}.csv", value=float(i)) for i in range(5)
    ]
    (group,) = grouped(faults)
    examples = "; ".join(f"{i}.csv: {i} of 600 rows are bad" for i in range(3))
    assert told(group) == f"5 files: for example {examples}."


def test_a_number_that_the_reason_has_is_said_once():
    assert str(Fault("too_many", "60 of 600 rows are bad.", value=60.0)) == "60 of 600 rows are bad."
    assert str(Fault("spike", "is 160 off.", value=60.0)) == "60: is 160 off."


@pytest.mark.parametrize(
    "change", [{"check": "b"}, {"severity": "info"}, {"action": "kept"}, {"fix": "c"}, {"column": "d"}]
)
def test_other_faults_are_not_shared(change):
    alike = {"check": "a", "reason": "is wrong."}
    faults = [Fault(file=f"{i}", **alike) for i in range(3)] + [Fault(file="9", **alike | change)]
    assert [len(group) for group in grouped(faults)] == [1, 1, 1, 1]


def test_the_terminal_and_the_report_list_it_once_and_quality_has_every_row(capsys):
    faults = [comma(i) for i in range(30)] + [Fault("load", "is odd.", severity="warning", action="kept")]
    Lines().faults(faults)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["warning: is odd.", f"error: {told(faults[:30])} [row left out]"]
    table = quality_table(faults, [f"raw/{i}.csv" for i in range(30)])
    assert len(table) == 31
    # The lines are floats in a table that was stored, as some rows have none.
    rows, count = quality_findings(table.astype({"line": float}), Config())
    assert count == 2
    assert (rows[0]["file"], rows[0]["place"]) == (
        "30 files",
        "raw/0.csv:2: '1,84'; raw/1.csv:2: '1,84'; raw/2.csv:2: '1,84'",
    )
    assert (rows[1]["file"], rows[1]["reason"]) == (None, "is odd.")


def test_a_campaign_of_which_nothing_can_be_used_says_so_in_two_lines(tmp_path):
    names = [f"{i}.csv" for i in range(30)]
    folder = campaign(tmp_path, "file,aging_days\n" + "".join(f"{name},4\n" for name in names), names)
    rig = config(
        DAYS + '[trace]\ncolumns = {time_s = "t", displacement_mm = "displacement_mm", force_N = "force_N"}'
    )
    with pytest.raises(CampaignError) as caught:
        ingest_campaign(folder, rig)
    shared, last = str(caught.value).splitlines()
    assert shared.startswith(
        "30 files: column 't': there is no such column. For example 0.csv:1; 1.csv:1; 2.csv:1. "
    )
    assert last.startswith("none of 30 trace files can be used.")


def test_the_nearest_name_beside_a_path_that_is_not_there_or_nothing(tmp_path, monkeypatch):
    (tmp_path / "campaign").mkdir()
    (tmp_path / "rig.toml").write_text("")
    trace(tmp_path / "campaign", "a.csv")
    monkeypatch.chdir(tmp_path)
    assert did_you_mean(Path("campain")) == "Did you mean campaign?"
    assert did_you_mean(Path("campain/a.csv"), Path.is_file).endswith("/campaign?")
    assert did_you_mean(Path("rig.tml"), Path.is_file) == "Did you mean rig.toml?"
    assert did_you_mean(Path("rig.tml")) == did_you_mean(Path("results")) == ""
    assert did_you_mean(Path("x.toml"), Path.is_file) == ""  # only the ending is alike
    assert nearest("Force", ["time", "force"]) == "force"
    assert nearest("Force", ["time"]) == ""


def test_a_fault_that_many_strokes_share_is_one_message():
    def fault(file, stroke):
        return Fault("no_plateau", "never settles.", file=file, stroke=stroke, value=31.13122889305816)

    (one_file,) = grouped([fault("a.csv", stroke) for stroke in range(1, 6)])
    assert told(one_file).startswith(
        "5 strokes of a.csv: never settles. For example a.csv stroke 1: 31.1312;"
    )
    (files,) = grouped([fault(file, stroke) for file in ("a.csv", "b.csv") for stroke in (1, 2)])
    assert told(files).startswith(
        "2 files, 4 times: never settles. For example a.csv stroke 1: 31.1312; b.csv"
    )
    assert len(grouped([fault("a.csv", stroke) for stroke in (1, 2, 3)])) == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[trace]\ndelimeter = ';'", "unknown key 'trace.delimeter'. Did you mean 'trace.delimiter'?"),
        ("[tracee]\ndecimal = ','", "unknown key 'tracee'. Did you mean 'trace'?"),
        ("decimal = ','", "unknown key 'decimal'. Did you mean 'trace.decimal'?"),
        ("[files]\ndecimal = ','", "unknown key 'files.decimal'. Did you mean 'trace.decimal'?"),
        ("[quantities.force]\nunits = 'N'\nquantity = 'x'", "Did you mean 'quantities.force.unit'?"),
        (
            "[files.runs_columns]\nload_N = {name = 'Last', units = 'kgf'}",
            "Did you mean 'files.runs_columns.load_N.unit'?",
        ),
        ("zzz = 1", "unknown key 'zzz'. docs/reference/config.md has"),
    ],
)
def test_a_mistyped_key_is_answered_with_the_nearest(text, said):
    with pytest.raises(ConfigError) as caught:
        config(text)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "[strokes]\nmin_samples = 'many'",
            "toml:2: key 'strokes.min_samples': 'many': Input should be a valid integer",
        ),
        ("[strokes]\nmin_samples = -4", "key 'strokes.min_samples': -4: Input should be greater than"),
        ("[trace]\nintegrate_per = 'h'", "key 'trace.integrate_per': 'h': Input should be 's' or 'min'."),
        ("[trace.columns]\nforce_N = [1]", "key 'trace.columns.force_N': Input should be"),
        ("[trace.columns]\nforce_N = {name = 'F', unit = 'kgff'}", "force_N: 'kgff' is no known unit"),
        (f"name = ['a']\ncondition = '{'x' * 500}'", "xxx...: Input should be a valid list."),
    ],
)
def test_a_value_that_is_refused_is_named(text, said):
    with pytest.raises(ConfigError) as caught:
        config(text)
    assert said in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("name = 'a'\n[trace]\n# delimeter\ndelimeter = ';'", 4),
        ("[trace.columns]\ntime_s = 't'\nforce_N = { name = 'F', unit = 'kfg' }", 3),
        ("[trace]\nzzz = 1\n[files]\nzzz = 1", None),  # two faults
        ("[trace]\nzzz = 1\n[files]\nvalues = { zzz = { a = 1 } }", None),  # one of two lines
    ],
)
def test_a_fault_of_a_config_has_the_line_of_its_key(text, line):
    with pytest.raises(ConfigError) as caught:
        config(text)
    assert caught.value.line == line


def test_each_of_several_faults_of_a_config_has_its_line():
    with pytest.raises(ConfigError, match=r"line 2: unknown key 'trace\.yyy'\. line 4: key 'files\.glob'"):
        config("[trace]\nyyy = 1\n[files]\nglob = 1")


def test_a_mistyped_config_is_answered_with_the_nearest_file_beside_it(tmp_path):
    (tmp_path / "rig.toml").write_text("")
    with pytest.raises(ConfigError, match=r"Did you mean .*rig\.toml\?"):
        ConfigCopy.at(tmp_path / "rog.toml").parse()
    with pytest.raises(ConfigError, match=r"Check --config\."):
        ConfigCopy.at(tmp_path / "other.ini").parse()
