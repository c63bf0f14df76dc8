import pytest
from trace_helpers import DAYS, campaign, channels, faults, trace

from sealfit.errors import ConfigError

ISO = ["2024-03-01T09:30:00", "2024-03-01T11:00:00", "2024-03-02T08:00:00"]
HOURS = [0.0, 1.5, 22.5]
GERMAN = ["01.03.2024 09:30", "01.03.2024 11:00", "02.03.2024 08:00"]


def log(folder, cells, header="started_at"):
    rows = [f"{name}.csv;4;{cell}" for name, cell in zip("abc", cells, strict=True)]
    return campaign(folder, "\n".join([f"file;aging_days;{header}", *rows]))


def started(folder, rig=""):
    found = channels(folder, DAYS + rig)
    return [ref["started_at"] for ref in found.values()], [ref["elapsed_h"] for ref in found.values()]


@pytest.mark.parametrize(
    ("cells", "rig"),
    [
        (GERMAN, 'date_format = "%d.%m.%Y %H:%M"'),
        (
            ["03/01/2024 9:30 AM", "03/01/2024 11:00 AM", "03/02/2024 8:00 AM"],
            'date_format = "%m/%d/%Y %I:%M %p"',
        ),
        ([GERMAN[0], "2024/03/01 11:00:00", ISO[2]], 'date_format = ["%d.%m.%Y %H:%M", "%Y/%m/%d %H:%M:%S"]'),
        # Serial numbers of Excel: 45352 is 1 March 2024, 9:30 is 9.5 / 24 of a day.
        (["45352.3958333333", "45352,4583333333", "45353.3333333333"], ""),
    ],
    ids=["German", "US", "several", "Excel"],
)
def test_dates_in_other_formats_become_iso(tmp_path, cells, rig):
    times, hours = started(log(tmp_path, cells), f"[files]\n{rig}\n")
    assert times == ISO
    assert hours == pytest.approx(HOURS, abs=1e-6)


@pytest.mark.parametrize(
    "cells",
    [
        ["01.03.2024;09:30", "01.03.2024;11:00", "02.03.2024;08:00"],
        ["2024-03-01 00:00:00;09:30", "2024-03-01 00:00:00;11:00", "2024-03-02 00:00:00;08:00"],
        ["45352;0,39583333333", "45352;0,45833333333", "45353;0,33333333333"],
    ],
    ids=["words", "workbook", "serials"],
)
def test_date_and_time_of_day_in_two_columns(tmp_path, cells):
    rig = '[files]\ndate_format = "%d.%m.%Y %H:%M"\nstarted_at = {date = "Datum", time = "Uhrzeit"}\n'
    folder = log(tmp_path, cells, "Datum;Uhrzeit")
    assert started(folder, rig) == (ISO, pytest.approx(HOURS))
    assert not {"Datum", "Uhrzeit"} & set(channels(folder, DAYS + rig)["a.csv"])


def test_two_parts_of_a_file_name(tmp_path):
    for name in ("20240301_0930", "20240301_1100"):
        trace(tmp_path, f"{name}_d4.csv")
    rig = r"""[files]
glob = "*.csv"
name_pattern = '(?P<day>\d+)_(?P<clock>\d+)_d(?P<aging_days>\d+)[.]csv'
started_at = {date = "day", time = "clock"}
date_format = "%Y%m%d %H%M"
"""
    assert started(tmp_path, rig) == (ISO[:2], HOURS[:2])


def test_two_header_lines_of_a_trace(tmp_path):
    for name, clock in (("a", "09:30:00"), ("b", "11:00:00")):
        trace(tmp_path, f"{name}.csv")
        text = (tmp_path / f"{name}.csv").read_text()
        (tmp_path / f"{name}.csv").write_text(f"Datum: 01.03.2024\nZeit: {clock}\n{text}")
    rig = r"""[files]
glob = "*.csv"
name_pattern = "(?P<run_id>.)[.]csv"
compute = {aging_days = "4"}
started_at = {date = "started_day", time = "started_clock"}
date_format = "%d.%m.%Y %H:%M:%S"
[trace]
header_lines = 3
header_fields = {started_day = 'Datum: (\S+)', started_clock = 'Zeit: (\S+)'}
"""
    assert started(tmp_path, rig) == (ISO[:2], HOURS[:2])


def test_times_with_zones_are_instants(tmp_path):
    rig = '[files]\ndate_format = "%d.%m.%Y %H:%M %z"\n'
    times, hours = started(
        log(tmp_path, ["01.03.2024 09:30 +0100", "01.03.2024 09:30 +0000", ISO[1] + "Z"]), rig
    )
    assert hours == [0.0, 1.0, 2.5]
    assert times == ["2024-03-01T09:30:00+01:00", "2024-03-01T09:30:00+00:00", "2024-03-01T11:00:00+00:00"]


def test_a_cell_that_fits_no_format_is_named_with_those_tried(tmp_path):
    folder = log(tmp_path, [GERMAN[0], "1 March", ISO[0]])
    (fault,) = faults(folder, DAYS + '[files]\ndate_format = ["%d.%m.%Y %H:%M", "%Y/%m/%d"]\n')
    assert (fault.file, fault.line, fault.column, fault.value) == ("runs.csv", 3, "started_at", "1 March")
    assert fault.reason == "fits none of the formats tried: '%d.%m.%Y %H:%M', '%Y/%m/%d', ISO 8601."


@pytest.mark.parametrize(
    ("cell", "fix"),
    [
        ("13.03.2024 10:30", "date_format = '%d.%m.%Y %H:%M'"),
        ("03/01/2024 10:30:00", "'%d/%m/%Y %H:%M:%S' or '%m/%d/%Y %H:%M:%S'"),
        ("12000", "Write it as 2024-03-01T09:30:00"),  # seconds, not a day of 1932
    ],
)
def test_the_fix_names_the_format_that_fits(tmp_path, cell, fix):
    (fault,) = faults(log(tmp_path, [ISO[0], cell, ISO[1]]), DAYS)
    assert fix in fault.fix


def test_half_a_time_and_a_missing_column_are_named(tmp_path):
    rig = DAYS + '[files]\nstarted_at = {date = "Datum", time = "Uhrzeit"}\n'
    half = faults(log(tmp_path, ["2024-03-01;09:30", "2024-03-01;", ";"], "Datum;Uhrzeit"), rig)
    assert [(fault.line, fault.column, fault.check) for fault in half] == [(3, "Uhrzeit", "empty_cell")]
    (fault,) = faults(log(tmp_path, ["2024-03-01;09:30"] * 3, "Date;Uhrzeit"), rig)
    assert (fault.check, fault.column, fault.fix) == ("missing_column", "Datum", "Did you mean 'Date'?")
    assert (fault.file, fault.line) == ("runs.csv", None)  # it may have titles above its header


@pytest.mark.parametrize("wrong", ["%d.%m.%Y %Q", "%H:%M", "dd.mm.yyyy"])
def test_a_format_that_cannot_be_meant_is_refused(tmp_path, wrong):
    with pytest.raises(ConfigError, match=r"files\.date_format.*Write for example '%d.%m.%Y %H:%M'"):
        channels(tmp_path, f'[files]\ndate_format = "{wrong}"\n')
