"""The command `sealfit init`: what it writes, prints and refuses."""

import errno
import json
import os
import re
import shlex
import sys
from pathlib import Path

import exports
import pandas as pd
import pytest

from sealfit import cli
from sealfit.config import parse_config
from sealfit.draft import draft
from sealfit.errors import RequestError
from sealfit.ingest import workbooks
from sealfit.ingest.campaign import ingest_campaign
from sealfit.ingest.runs import list_traces
from sealfit.store.manifest import ConfigCopy


@pytest.fixture
def sealfit(monkeypatch, capsys, tmp_path):
    """Call the program in a folder of its own; return exit code, stdout and stderr."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["sealfit", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            sys.exit(cli.exit_code(cli.app))
        return ended.value.code or 0, *capsys.readouterr()

    return call


@pytest.fixture
def campaign(tmp_path):
    exports.dasylab(tmp_path / "raw data")
    return tmp_path / "raw data"


# ---------------------------------------------------------------- what it writes and prints
def test_a_draft_is_written_here_and_the_next_command_works(sealfit, campaign):
    before = {path: path.read_bytes() for path in campaign.rglob("*.asc")}
    code, out, err = sealfit("init", campaign)
    assert (code, err) == (0, "")
    assert ConfigCopy.at(Path("rig.toml")).parse().name == "raw data"
    assert os.listdir() == ["rig.toml"]
    assert {path: path.read_bytes() for path in campaign.rglob("*") if path.is_file()} == before
    *_, last = out.splitlines()
    assert last == f"next: sealfit check '{campaign}' --config rig.toml"
    code, out, _ = sealfit(*shlex.split(last)[2:])
    assert code == 0
    assert out.endswith("No faults found.\n")


def test_the_summary_says_what_was_found_and_what_could_not_be_told(sealfit, campaign):
    _, out, _ = sealfit("init", campaign)
    assert "12 trace files" in out
    assert "about 4 strokes in a file, both ways" in out
    assert "time_s: column 1 'Messzeit [s]': by its name and its unit" in out
    told = out.partition("not determined:")[2]
    assert "compression_ratio_pct" in told
    assert "%d.%m.%Y" not in told


def test_json_is_one_object(sealfit, campaign):
    code, out, _ = sealfit("init", campaign, "--output", "mine.toml", "--json")
    made = json.loads(out)
    assert code == 0
    assert made["ok"] is True
    assert made["command"] == "init"
    assert made["config"] == "mine.toml"
    assert made["files"] == 12
    evidence = "numbers such as '0,0000' in 12 of 12 files"
    assert {"key": "trace.decimal", "value": ",", "evidence": evidence} in made["guesses"]
    assert all(set(doubt) == {"key", "reason", "fix"} and doubt["fix"] for doubt in made["doubts"])
    assert made["next"].startswith("sealfit check ")


def test_a_file_that_is_there_is_kept_unless_forced(sealfit, campaign):
    sealfit("init", campaign)
    Path("rig.toml").write_text("mine")
    code, _, err = sealfit("init", campaign)
    assert code == 1
    assert (
        err == "sealfit: rig.toml: is there already. Choose another --output, or replace it with --force.\n"
    )
    assert Path("rig.toml").read_text() == "mine"
    assert sealfit("init", campaign, "--force")[0] == 0
    assert ConfigCopy.at(Path("rig.toml")).parse()


def test_only_toml_files_are_written(sealfit, campaign):
    trace = next(campaign.rglob("*.asc"))
    code, _, err = sealfit("init", campaign, "--output", trace, "--force")
    assert code == 1
    assert "ends in .toml" in err
    assert trace.stat().st_size > 1000


def test_a_draft_is_never_used_unless_it_is_named(sealfit, campaign):
    sealfit("init", campaign)
    code, out, _ = sealfit("check", campaign)
    assert code == 1
    assert "no runs.csv" in out


def test_a_folder_that_cannot_be_written_is_said(sealfit, campaign):
    code, _, err = sealfit("init", campaign, "--output", "nowhere/rig.toml")
    assert code == 1
    assert "cannot be written" in err


def test_a_full_disk_leaves_the_config_that_was_there(sealfit, campaign, monkeypatch):
    Path("rig.toml").write_text("mine")

    def full(_handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    code, _, err = sealfit("init", campaign, "--force")
    assert code == 1
    assert "rig.toml: cannot be written (No space left on device). Free some space" in err
    assert Path("rig.toml").read_text() == "mine"
    assert not Path(".rig.toml.part").exists()


# ---------------------------------------------------------------- folders that it cannot draft from
def nothing(folder):
    folder.mkdir()


def no_folder(folder):
    pass


def a_file(folder):
    folder.write_text("1,2\n")


def words(folder):
    exports.write(folder, "notes.txt", "only words\n" * 20)


def binary(folder):
    folder.mkdir()
    for number in range(3):
        (folder / f"d{number}.dat").write_bytes(bytes(range(256)) * 20)


def packed(folder):
    folder.mkdir()
    (folder / "d1.csv").write_bytes(b"PK\x03\x04" + bytes(100))


def tdms(folder):
    folder.mkdir()
    for number in range(3):
        (folder / f"run{number}.tdms").write_bytes(b"TDSm" + bytes(100))
    (folder / "log.xlsx").write_bytes(b"PK\x03\x04" + bytes(100))


def hdf5(folder):
    folder.mkdir()
    for number in range(3):
        (folder / f"run{number}.h5").write_bytes(bytes(100))


def empty_files(folder):
    folder.mkdir()
    (folder / "d1.csv").write_bytes(b"")


def values_over_days(folder):
    exports.write(
        folder, "strength.csv", "TempC,TimeH,Response\n" + "50,0,100\n50,72,93.1\n60,0,99\n60,24,95\n" * 5
    )


def only_a_table_of_runs(folder):
    exports.write(folder, "runs.csv", "file,aging_days\n" + "".join(f"{i}.csv,{i}\n" for i in range(20)))


@pytest.mark.parametrize(
    ("make", "reason", "fix"),
    [
        (nothing, "the folder is empty", "Give the folder that holds the trace files"),
        (no_folder, "there is no such folder", "Give the folder that holds the trace files"),
        (a_file, "is a file, not a folder", "Give the folder that holds the trace files"),
        (words, "none of 1 files holds a table of numbers", "sealfit fit-aging --values TABLE"),
        (binary, "is not text", "export them as text"),
        (packed, "a zip archive or .xlsx workbook", "export them as text"),
        (tdms, "cannot be read as ", "export them as text"),
        (hdf5, "3 HDF5 files (.h5) and no trace file that can be read", "export them as text"),
        (empty_files, "is empty", "export them as text"),
        (values_over_days, "but no time and no force", "sealfit fit-aging --values TABLE"),
        (only_a_table_of_runs, "none of 1 files holds a table of numbers", "export them as text"),
    ],
)
def test_a_folder_without_traces_is_one_line_with_what_to_do(make, reason, fix, sealfit, tmp_path):
    make(tmp_path / "folder")
    code, out, err = sealfit("init", tmp_path / "folder")
    assert (code, out) == (1, "")
    assert err.count("\n") == 1
    assert reason in err
    assert fix in err
    assert os.listdir() == []


def test_json_on_failure(sealfit, tmp_path):
    code, out, _ = sealfit("init", tmp_path / "nowhere", "--json")
    (error,) = json.loads(out)["errors"]
    assert code == 1
    assert error["fix"]


# ---------------------------------------------------------------- folders that hold other things, too
def plain(one):
    return "Time_s,Pos_mm,Force_N\n" + exports.table(exports.slots(one), ",", 4)


def test_files_written_otherwise_are_left_out_and_said(tmp_path):
    exports.tribometer(tmp_path)
    for number in range(3):
        exports.write(tmp_path, f"old{number}.csv", "t;x;F\n" + "0,1;0,2;0,3\n1,1;1,2;1,4\n" * 20)
    made = draft(tmp_path)
    assert made.files == 12
    (doubt,) = [doubt for doubt in made.doubts if "written otherwise" in doubt.reason]
    assert "3 files" in doubt.reason
    assert "separator ';', decimal ','" in doubt.reason
    assert parse_config(made.text, "rig.toml").files.exclude == ["old0.csv", "old1.csv", "old2.csv"]


def test_files_with_further_columns_are_read_by_the_names_that_all_have(tmp_path):
    for one in exports.records():
        columns, header = exports.slots(one), "t [s];x [mm];F [N]\n"
        if one.repeat == 2 and one.days == 4:
            columns, header = (
                [one.time_s, one.further["temperature"], *columns[1:]],
                "t [s];T [°C];x [mm];F [N]\n",
            )
        file = f"d{one.days}_v{one.speed:g}_r{one.repeat}.csv"
        exports.write(tmp_path, file, header + exports.table(columns, ";", 4))
    made = draft(tmp_path)
    assert made.files == 12
    (doubt,) = [doubt for doubt in made.doubts if "further columns" in doubt.reason]
    assert "2 of 12 files have further columns: T [°C]." in doubt.reason
    ingested = ingest_campaign(tmp_path, parse_config(made.text, "rig.toml"))
    assert set(ingested.tables["inputs"]["status"]) == {"used"}
    assert ingested.tables["runs"]["speed_mm_s"].abs().round(2).isin([1.0, 5.0]).all()


def test_files_with_their_columns_in_another_order_are_read_by_name_and_no_doubt(tmp_path):
    for one in exports.records():
        columns, header = exports.slots(one), ["t [s]", "x [mm]", "F [N]"]
        if one.repeat == 2 and one.days == 4:
            columns, header = columns[::-1], header[::-1]
        file = f"d{one.days}_v{one.speed:g}_r{one.repeat}.csv"
        exports.write(tmp_path, file, ";".join(header) + "\n" + exports.table(columns, ";", 4))
    made = draft(tmp_path)
    assert made.files == 12
    assert not any("further columns" in doubt.reason for doubt in made.doubts)


def test_a_broken_file_among_traces_is_said_and_excluded(tmp_path):
    exports.tribometer(tmp_path)
    name = "EPDM_90C_80pct_1d_1mms_1.csv"
    (tmp_path / name).write_bytes(b"\x00\x01\x02" * 500)
    made = draft(tmp_path)
    (doubt,) = [doubt for doubt in made.doubts if name in doubt.reason]
    assert "is not text" in doubt.reason
    assert parse_config(made.text, "rig.toml").files.exclude == [name]


def test_documents_and_other_formats_do_not_disturb(tmp_path):
    exports.tribometer(tmp_path)
    exports.write(tmp_path, "README.txt", "1,2,3\n" * 50)
    exports.write(tmp_path, "rig.toml", "name = 'old'\n")
    exports.write(tmp_path, ".hidden/a.csv", "1,2,3\n" * 50)
    (tmp_path / "a.tdms").write_bytes(b"TDSm")
    made = draft(tmp_path)
    assert made.files == 12
    (doubt,) = made.doubts
    assert doubt.reason.startswith("a.tdms holds no column of data")


def test_a_draft_of_many_files_looks_at_some_and_says_so(tmp_path):
    exports.german_daq(tmp_path)
    made = draft(tmp_path)
    (guess,) = [guess for guess in made.guesses if guess.key == "trace.delimiter"]
    assert guess.evidence == "the separator in 24 of 24 files looked at, of 84"


def test_unaged_rubber_of_several_series_is_a_piece_in_each(tmp_path):
    for temperature in (60, 80):
        for one in exports.records(temperatures=(temperature,), days=(0, 4), repeats=(1,)):
            exports.write(tmp_path, f"T{temperature}_d{one.days}_v{one.speed:g}_r1.csv", plain(one))
    made = draft(tmp_path)
    config = parse_config(made.text, "rig.toml")
    assert config.files.columns["specimen_id"] == "{temperature_C} {aging_days}"
    assert any("other pieces of rubber, unaged ones, too" in doubt.reason for doubt in made.doubts)
    runs = ingest_campaign(tmp_path, config).tables["runs"]
    assert sorted(runs.loc[runs["aging_days"] == 0, "specimen_id"].unique()) == ["60 0", "80 0"]


def test_unaged_rubber_of_one_series_is_one_piece(tmp_path):
    for one in exports.records(days=(0, 4), speeds=(5.0,), repeats=(1, 2)):
        exports.write(tmp_path, f"{one.number}_T{one.temperature}_d{one.days}_v5_r1.csv", plain(one))
    assert "specimen_id" not in parse_config(draft(tmp_path).text, "rig.toml").files.columns


def test_a_table_of_runs_in_other_units_is_converted_and_its_doubts_are_said(tmp_path):
    for number in (1, 2):
        (one,) = exports.records(days=(number,), speeds=(5.0,), repeats=(1,))
        exports.write(tmp_path, f"m{number}.csv", plain(one))
    table = "File,Aging time (h),Normal load (kg),Compression (%),Date\n"
    table += "m1.csv,24,5,20,3/14/2024\nm2.csv,96,5,20,3/15/2024\n"
    exports.write(tmp_path, "runs.csv", table)
    made = draft(tmp_path)
    config = parse_config(made.text, "rig.toml")
    columns = config.files.runs_columns
    assert (columns["aging_days"].name, columns["aging_days"].unit) == ("Aging time (h)", "h")
    assert (columns["load_N"].name, columns["load_N"].unit) == ("Normal load (kg)", "kgf")
    assert (columns["_compressed_pct"].name, columns["_compressed_pct"].unit) == ("Compression (%)", None)
    assert {ref.channels["compression_ratio_pct"] for ref in list_traces(tmp_path, config)[0]} == {80.0}
    reasons = " ".join(doubt.reason for doubt in made.doubts)
    assert "how much the rubber was compressed" in reasons
    assert "dates that are not ISO 8601, such as '3/14/2024'" in reasons


def test_a_column_in_a_unit_of_another_quantity_is_not_what_its_words_say(tmp_path):
    for number in (1, 2):
        (one,) = exports.records(days=(number,), speeds=(5.0,), repeats=(1,))
        exports.write(tmp_path, f"m{number}.csv", plain(one))
    table = "Datei,Lagerung [°C],Lagerungstemp.,Lagerdauer [Wochen]\nm1,80,81,1\nm2,80,81,2\n"
    exports.write(tmp_path, "plan.csv", table)
    columns = parse_config(draft(tmp_path).text, "rig.toml").files.runs_columns
    assert columns["temperature_C"].name == "Lagerungstemp."
    assert (columns["aging_days"].name, columns["aging_days"].unit) == ("Lagerdauer [Wochen]", "week")


@pytest.mark.parametrize("weeks", ["Weeks", "Wochen", "Semaines"])
def test_weeks_in_a_log_are_aging_times_and_what_it_lacks_belongs_there(weeks, tmp_path):
    write_with_log(tmp_path, f"{weeks},Date,Remark", lambda one: f"{one.days},14/03/2024,")
    log = (tmp_path / "log.csv").read_text()
    exports.write(tmp_path, "log.csv", log.replace("File,Days,", "File,Status,"))
    made = draft(tmp_path)
    days = parse_config(made.text, "rig.toml").files.runs_columns["aging_days"]
    assert (days.name, days.unit) == (weeks, "week")
    doubts = " ".join(f"{doubt.reason} {doubt.fix}" for doubt in made.doubts)
    assert "what 'Status', 'Remark' of log.csv hold is not known here" in doubts
    assert "same is assumed for all files. Add it to log.csv if it differs." in doubts


def test_files_that_nothing_tells_apart_are_one_condition(tmp_path):
    for number in range(1, 9):
        (one,) = exports.records(days=(1,), speeds=(5.0,), repeats=(1,))
        exports.write(tmp_path, f"m{number}.csv", plain(one))
    made = draft(tmp_path)
    config = parse_config(made.text, "rig.toml")
    assert config.condition == ["state"]
    assert config.files.columns == {"state": "one"}
    assert any("all are taken as one condition" in doubt.reason for doubt in made.doubts)


def test_a_repeat_that_does_not_tell_files_apart_is_not_used(tmp_path):
    for batch, day, repeat in [
        ("a1", 1, 1),
        ("a2", 1, 1),
        ("a1", 4, 1),
        ("a2", 4, 1),
        ("a1", 1, 2),
        ("a2", 1, 2),
    ]:
        (one,) = exports.records(days=(day,), speeds=(5.0,), repeats=(1,))
        exports.write(tmp_path, f"{batch}/d{day}_r{repeat}.csv", plain(one))
    made = draft(tmp_path)
    config = parse_config(made.text, "rig.toml")
    assert config.condition == ["aging_days"]
    assert "<repeat>" not in config.files.name_pattern
    assert any("does not tell 6 files apart" in doubt.reason for doubt in made.doubts)
    listing, _ = list_traces(tmp_path, config)
    assert sorted(ref.channels["repeat"] for ref in listing) == [1, 1, 2, 2, 3, 4]


def test_files_that_an_unknown_word_tells_apart_keep_their_repeats(tmp_path):
    for one in exports.records(days=(1, 4), speeds=(1.0, 5.0)):
        for word in ("links", "rechts"):
            exports.write(tmp_path, f"d{one.days}_v{one.speed:g}_{word}_r{one.repeat}.csv", plain(one))
    made = draft(tmp_path)
    assert not any("does not tell" in doubt.reason for doubt in made.doubts)
    listing, _ = list_traces(tmp_path, parse_config(made.text, "rig.toml"))
    assert [(ref.channels["run_id"], ref.channels["repeat"]) for ref in list(listing)[:4]] == [
        ("1 1 links", 1), ("1 1 links", 2), ("1 1 rechts", 1), ("1 1 rechts", 2),
    ]  # fmt: skip


def test_a_log_with_units_words_for_unaged_and_a_clock_is_read_and_what_is_not_known_is_said(tmp_path):
    rows = ["File,Ofen,Tage,Datum,Uhrzeit,Probe [kg],v [mm/min]"]
    for number, one in enumerate(exports.records(days=(0, 4), speeds=(1.0, 5.0))):
        exports.write(tmp_path, f"M{number}.csv", plain(one))
        oven = one.temperature if one.days else "RT"
        rows.append(f"M{number}.csv,{oven},{one.days},03.03.2024,08:{number:02d},5.0,{60 * one.speed:g}")
    exports.write(tmp_path, "log.csv", "\n".join(rows) + "\n")
    made = draft(tmp_path)
    columns = parse_config(made.text, "rig.toml").files.runs_columns
    assert (columns["temperature_C"].name, columns["speed_mm_s"].unit) == ("Ofen", "mm/min")
    doubts = " ".join(f"{doubt.reason} {doubt.fix}" for doubt in made.doubts)
    started = "files.started_at = { date = 'Datum', time = 'Uhrzeit' }"
    assert f"Set {started} and files.date_format = '%d.%m.%Y %H:%M'." in doubts
    assert "what 'Probe [kg]' of log.csv holds is not known here" in doubts


def write_with_log(folder, columns, started, log="log.csv"):
    """Write four traces, and a log with the time that `started(trace)` gives in the further `columns`."""
    rows = [f"File,Days,{columns}"]
    for number, one in enumerate(exports.records(days=(0, 4), speeds=(1.0, 5.0))):
        exports.write(folder, f"M{number}.csv", plain(one))
        rows.append(f"M{number}.csv,{one.days},{started(one)}")
    exports.write(folder, log, "\n".join(rows) + "\n")


def test_numbers_in_names_that_the_log_has_too_are_no_channels(tmp_path):
    rows = ["name,run,rep,days,oil"]
    for number, one in enumerate(exports.records(days=(0, 4), speeds=(1.0, 5.0), repeats=(1, 2))):
        run, rep, oil = number // 2 + 1, number % 2 + 1, number % 3
        exports.write(tmp_path, f"{run:03d}_{rep}_{oil}.csv", plain(one))
        rows.append(f"{run:03d}_{rep}_{oil}.csv,{run},{rep},{one.days},{oil if number else 7}")
    exports.write(tmp_path, "log.csv", "\n".join(rows) + "\n")
    listing, _ = list_traces(tmp_path, parse_config(draft(tmp_path).text, "rig.toml"))
    assert [name for name in listing.columns if name.startswith("part_")] == ["part_4"]  # differs from 'oil'


@pytest.mark.parametrize("log", ["log.csv", "log.txt"])
def test_a_log_of_any_ending_is_read(tmp_path, log):
    write_with_log(tmp_path, "Start", lambda one: f"2024-03-0{1 + one.days}T08:00:00", log)
    made = parse_config(draft(tmp_path).text, "rig.toml")
    assert made.files.runs_table == log
    listing, _ = list_traces(tmp_path, made)
    assert set(listing.columns["aging_days"]) == {0.0, 4.0}


def test_a_log_with_whole_dates_and_a_clock_is_read(tmp_path):
    write_with_log(tmp_path, "Date,Time", lambda one: f"2024-03-14T00:00:00,{one.started:%H:%M:%S}")
    made = draft(tmp_path)
    assert "columns 'Date' and 'Time' of log.csv" in [guess.evidence for guess in made.guesses]
    runs = ingest_campaign(tmp_path, parse_config(made.text, "rig.toml")).tables["runs"]
    assert list(runs["started_at"])[:2] == ["2024-03-14T09:19:33", "2024-03-14T09:26:33"]


def test_a_log_with_dates_of_another_form_is_said_with_the_key_that_reads_them(tmp_path):
    write_with_log(tmp_path, "Date", lambda one: "14/03/2024")
    (doubt,) = [doubt for doubt in draft(tmp_path).doubts if "ISO 8601" in doubt.reason]
    assert doubt.fix == "Set files.runs_columns.started_at = 'Date' and files.date_format = '%d/%m/%Y'."


@pytest.mark.parametrize(("mark", "sign"), [(",", "."), (";", ",")])
def test_excel_serial_numbers_in_a_log_are_dates(mark, sign, tmp_path):
    rows = ["Datei;Tage;Datum"]
    for number, one in enumerate(exports.records(days=(0, 4), speeds=(1.0, 5.0))):
        exports.write(tmp_path, f"M{number}.csv", plain(one))
        rows.append(f"M{number}.csv;{one.days};{45987.53 + number:.2f}")
    table = "\n".join(rows).replace(";", mark)
    exports.write(tmp_path, "log.csv", re.sub(r"(\d)\.(\d)", rf"\1{sign}\2", table) + "\n")
    made = draft(tmp_path)
    config = parse_config(made.text, "rig.toml")
    assert config.files.runs_columns["started_at"].name == "Datum"
    example = "such as '45987.53': Excel's serial number of 2025-11-26 12:43"
    assert f"column 'Datum' of log.csv, {example}" in [guess.evidence for guess in made.guesses]
    runs = ingest_campaign(tmp_path, config).tables["runs"]
    assert list(runs["started_at"])[:2] == ["2025-11-26T12:43:12", "2025-11-27T12:43:12"]


def test_the_sheet_with_the_most_rows_holds_the_trace(tmp_path, monkeypatch):
    for one in exports.records():
        about, data = pd.DataFrame({"Operator": ["Ada"]}), pd.DataFrame(exports.slots(one)).T
        data.columns = ["Time [s]", "Stroke [mm]", "Force [N]"]
        with pd.ExcelWriter(tmp_path / f"{one.days}d_{one.speed:g}mms_r{one.repeat}.xlsx") as book:
            about.to_excel(book, sheet_name="Info", index=False)
            data.to_excel(book, sheet_name="Data", index=False)
    opened, book = [], workbooks._book
    monkeypatch.setattr(workbooks, "_book", lambda *args, **how: opened.append(1) or book(*args, **how))
    made = draft(tmp_path)
    assert len(opened) == 12 + 6 + 1  # looked at, columns read, sheets counted
    config = parse_config(made.text, "rig.toml")
    assert config.trace.sheet == "Data"
    assert made.files == 12
    ingested = ingest_campaign(tmp_path, config)
    assert not [fault for fault in ingested.faults if fault.severity == "error"]


def test_a_workbook_with_several_recordings_is_a_doubt(tmp_path):
    for days in (1, 4):
        with pd.ExcelWriter(tmp_path / f"80C_{days}d.xlsx") as book:
            for one in exports.records(days=(days,), repeats=(1,)):
                data = pd.DataFrame(dict(zip(("t [s]", "x [mm]", "F [N]"), exports.slots(one), strict=True)))
                data.to_excel(book, sheet_name=f"v{one.speed:g}", index=False)
    (doubt,) = (one for one in draft(tmp_path).doubts if one.key == "trace.sheet")
    assert doubt.reason == "only 'v1' of 80C_1d.xlsx is read, and 'v5' may be recordings, too."
    assert "a file of its own" in doubt.fix


def test_two_words_that_follow_the_displacement_are_the_direction(tmp_path):
    for one in exports.records(days=(1,), speeds=(1.0, 5.0)):
        name = f"{one.speed:g}mms_{{}}_r{one.repeat}.csv"
        exports.write(tmp_path, name.format("p"), plain(one))
        back = [one.time_s, 60.0 - one.displacement_mm, -one.force_N]
        exports.write(tmp_path, name.format("q"), "Time_s,Pos_mm,Force_N\n" + exports.table(back, ",", 4))
    made = draft(tmp_path)
    config = parse_config(made.text, "rig.toml")
    assert config.condition == ["state"]
    assert config.files.values == {"_direction": {"p": 1.0, "q": -1.0}}
    ingested = ingest_campaign(tmp_path, config)
    assert sorted(ingested.tables["steady"]["speed_set_mm_s"].unique()) == [1.0, 5.0]
    assert ingested.tables["steady"].groupby("direction")["repeat"].nunique().to_dict() == {-1: 2, 1: 2}


def test_unreadable_folders_raise_what_the_user_can_mend(tmp_path):
    with pytest.raises(RequestError, match="there is no such folder"):
        draft(tmp_path / "nowhere")
