import os
from datetime import datetime, timedelta

import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trace_helpers import HEADER, ROWS, changed, config, csv_of, read, refused

from sealfit.config import parse_config
from sealfit.errors import BadFile, ConfigError
from sealfit.ingest.averages import with_strokes
from sealfit.ingest.cells import decimal_fix
from sealfit.ingest.columns import TraceRef
from sealfit.ingest.reader import read_trace
from sealfit.ingest.trace_checks import speed_fault


def test_plain_file_reads_as_written(tmp_path):
    trace = read(tmp_path, csv_of(ROWS))
    assert list(trace.table) == ["time_s", "displacement_mm", "force_N"]
    assert [str(kind) for kind in trace.table.dtypes] == ["float64"] * 3
    npt.assert_allclose(trace.table["force_N"].iloc[[0, 99]], [2.0, 2.99])
    npt.assert_array_equal(trace.line[[0, 99]], [2, 101])
    assert trace.rows_read == 100
    assert trace.faults == ()


@pytest.mark.parametrize(
    ("row", "check", "column", "value", "fix"),
    [
        ("1.0,5.0,abc", "not_a_number", "force_N", "abc", "Put a number"),
        ("1.0,5.0,nan", "not_finite", "force_N", "nan", "Delete"),
        ("1.0,5.0,inf", "not_finite", "force_N", "inf", "Delete"),
        ("1.0,,2.0", "empty_cell", "displacement_mm", "", "Fill"),
        ("1.0,5.0", "too_few_cells", "force_N", None, "Complete"),
        ('1.0,5.0,"2,1"', "not_a_number", "force_N", "2,1", 'decimal = ","'),
        ("1.0,5.0,1_0", "not_a_number", "force_N", "1_0", "Put a number"),
        ("1.0,5.0,2.1 was 1.9", "not_a_number", "force_N", "2.1 was 1.9", "Put a number"),
        ("1.0,5.0,2.1,was 1.9", "too_many_cells", None, "was 1.9", "column with a name"),
        ("1.0,5.0,2.1,7", "too_many_cells", None, "7", "column with a name"),
        ("0.9,5.0,2.1", "time_order", "time_s", 0.9, "clock"),
        ("0.3,5.0,2.1", "time_order", "time_s", 0.3, "clock"),
        ("99.0,5.0,2.1", "time_order", "time_s", 99.0, "clock"),
    ],
)
def test_a_bad_cell_costs_its_row_and_is_named_with_line_value_and_fix(
    tmp_path, row, check, column, value, fix
):
    trace = read(tmp_path, changed(10, row))
    (fault,) = trace.faults
    assert (fault.check, fault.line, fault.column, fault.value) == (check, 12, column, value)
    assert (fault.file, fault.action) == ("t.csv", "row left out")
    assert fix in fault.fix
    assert len(trace.table) == 99
    assert trace.rows_read == 100
    assert 12 not in trace.line
    npt.assert_array_equal(np.delete(np.arange(2, 102), 10), trace.line)


@pytest.mark.parametrize("cell", ["", "n/a", "NULL"])
def test_a_word_for_no_value_in_a_channel_is_not_called_an_empty_cell(tmp_path, cell):
    content = csv_of([f"{row},{cell if k == 10 else 20.5}" for k, row in enumerate(ROWS)])
    (fault,) = read(tmp_path, content.replace(HEADER, f"{HEADER},oil_C")).faults
    assert (fault.line, fault.column) == (12, "oil_C")
    assert "holds no value: empty, n/a or the like" in fault.reason


@pytest.mark.parametrize("cell", ["NaN", "inf"])
@pytest.mark.parametrize("settings", ["", 'hum_C = {name = "hum", unit = "degF"}'])
def test_cells_that_are_no_number_are_no_labels_beside_a_faulty_cell(tmp_path, cell, settings):
    rows = [f"{row},{cell if i % 2 else 20 + i}" for i, row in enumerate(ROWS)]
    rows[50] = "5.0,25.0,,21"
    text = f"[trace.columns]\n{settings}" if settings else ""
    found = read(tmp_path, csv_of(rows, f"{HEADER},hum"), text)
    assert list(found.columns) == ["time_s", "displacement_mm", "force_N"]
    (fault,) = (fault for fault in found.faults if fault.check == "channel_left_out")
    assert "of 99 cells hold no number" in fault.reason


def test_a_rate_gives_the_time_of_files_without_one(tmp_path):
    content = csv_of([row.partition(",")[2] for row in changed(10, "0.9,x,1.0").splitlines()[1:]])
    content = content.replace(HEADER, "displacement_mm,force_N")
    trace = read(tmp_path, content, "[trace]\nrate_Hz = 50")
    (fault,) = trace.faults
    assert (fault.check, fault.line) == ("not_a_number", 12)
    npt.assert_allclose(trace.table["time_s"], np.delete(np.arange(100) / 50, 10), rtol=1e-15)
    fault = refused(tmp_path, content, "[trace.columns]\ndisplacement_mm = 1\nforce_N = 2")
    assert (fault.check, fault.column) == ("missing_column", "time_s")
    assert "rate_Hz" in fault.fix


RATE = "give the rows per second as rate_Hz under [trace]."
SPEED = "name a column of speed as integrate_displacement under [trace]."
NAMED = "The columns are {}. Name it under [trace.columns], or "
EITHER = "Name it under [trace.columns], compute it under [trace.compute], or "
FORCE = "Name it under [trace.columns], or compute it under [trace.compute]."


@pytest.mark.parametrize(
    ("header", "text", "column", "fix"),
    [
        ("displacement_mm,force_N", "", "time_s", NAMED.format("'displacement_mm', 'force_N'") + RATE),
        ("time_s,force_N", "", "displacement_mm", NAMED.format("'time_s', 'force_N'") + SPEED),
        ("time_s,displacement_mm", "", "force_N", "The columns are 'time_s', 'displacement_mm'."),
        ("x,F", "displacement_mm = 1\nforce_N = 2", "time_s", EITHER + RATE),
        ("t,F", "time_s = 1\nforce_N = 2", "displacement_mm", EITHER + SPEED),
        ("t,x", "time_s = 1\ndisplacement_mm = 2", "force_N", FORCE),
    ],
)
def test_a_missing_column_is_answered_with_the_ways_to_give_it(tmp_path, header, text, column, fix):
    content = csv_of([row.rpartition(",")[0] for row in ROWS], header)
    fault = refused(tmp_path, content, f"[trace.columns]\n{text}" if text else "")
    assert (fault.check, fault.column, fault.fix) == ("missing_column", column, fix)


@pytest.mark.parametrize(
    ("rate", "more"),
    [
        ("rate_Hz", ""),
        ("1000 * rate_kHz", ""),
        ("1 / _dt", "header_lines = 2\nheader_fields = { _dt = '^dt: (.*)' }"),
    ],
)
def test_a_rate_that_differs_between_files_is_computed_of_what_is_known_of_each(rate, more, tmp_path):
    content = csv_of([row.partition(",")[2] for row in ROWS], header="displacement_mm,force_N")
    content = f"dt: 0.02\n{content}" if more else content
    trace = read(tmp_path, content, f'[trace]\nrate_Hz = "{rate}"\n{more}', rate_Hz=50.0, rate_kHz=0.05)
    npt.assert_allclose(trace.table["time_s"], np.arange(100) / 50, rtol=1e-15)


def test_a_file_without_a_rate_is_left_out_and_says_why(tmp_path):
    content = csv_of([row.partition(",")[2] for row in ROWS], header="displacement_mm,force_N")
    fault = refused(tmp_path, content, '[trace]\nrate_Hz = "rate"', raet=50.0)
    assert (fault.column, "Did you mean 'raet'?" in fault.fix) == ("rate", True)
    fault = refused(tmp_path, content, '[trace]\nrate_Hz = "rate"', rate=0.0)
    assert (fault.check, fault.reason) == ("rate", 'rate_Hz = "rate" gives 0 rows per second.')
    assert (
        "is text, not a number" in refused(tmp_path, content, '[trace]\nrate_Hz = "rate"', rate="fast").reason
    )


@pytest.mark.parametrize("table", ["columns = { time_s = 1, force_N = 2 }", "compute = { time_s = 'n / 9' }"])
def test_a_time_and_a_rate_are_refused(table):
    with pytest.raises(ConfigError, match=r"both rate_Hz and (columns|compute)\.time_s give the time"):
        parse_config(f"[trace]\nrate_Hz = 100\n{table}", "rig.toml")
    for rate in ("0", "-1", "nan", "'50 Hz'"):
        with pytest.raises(ConfigError, match="rate_Hz"):
            parse_config(f"[trace]\nrate_Hz = {rate}", "rig.toml")


def test_a_footer_is_looked_for_below_the_header(tmp_path):
    content = csv_of([*ROWS, "Test ended", "mean,25,2.5"], header=f"Operator: Ada\nTest: friction\n{HEADER}")
    trace = read(tmp_path, content, '[trace]\nheader_lines = 3\nfooter = "Test"')
    assert (trace.line[0], trace.rows_read, trace.faults) == (4, 100, ())


def test_five_percent_of_bad_rows_are_left_out_and_six_leave_the_file_out(tmp_path):
    bad = {i: f"{0.1 * i:.1f},x,1" for i in range(0, 60, 10)}
    five = [bad[i] if i in list(bad)[:5] else row for i, row in enumerate(ROWS)]
    assert len(read(tmp_path, csv_of(five)).table) == 95
    fault = refused(tmp_path, csv_of([bad.get(i, row) for i, row in enumerate(ROWS)]))
    assert fault.check == "too_many_bad_rows"
    assert "6 of 100 rows are bad, more than 5 %" in fault.reason
    assert (
        len(
            read(
                tmp_path, csv_of([bad.get(i, r) for i, r in enumerate(ROWS)]), "quality.max_bad_rows = 0.06"
            ).table
        )
        == 94
    )


def test_many_faults_are_counted_and_only_the_first_twenty_written_out(tmp_path):
    with pytest.raises(BadFile) as caught:
        read(tmp_path, csv_of([row.replace(".", ".", 1) if i % 2 else "1,x,2" for i, row in enumerate(ROWS)]))
    faults = [fault for fault in caught.value.faults if fault.column == "displacement_mm"]
    assert len(faults) == 21
    assert faults[-1].value == 30
    assert "30 more cells" in faults[-1].reason


def test_one_wrong_time_far_ahead_costs_one_row_and_a_clock_set_back_the_file(tmp_path):
    assert len(read(tmp_path, changed(50, "900.0,25.0,2.5")).table) == 99
    fault = refused(tmp_path, csv_of(ROWS + ROWS[40:]))
    assert "rows are bad" in fault.reason
    assert "clock" in fault.fix


@pytest.mark.parametrize("times", [2, 5])
def test_recordings_that_follow_each_other_in_a_file_are_said(tmp_path, times):
    with pytest.raises(BadFile) as caught:
        read(tmp_path, csv_of(times * ROWS))
    first, *_, last = caught.value.faults
    assert (first.check, first.line) == ("time_anew", 102)
    assert f"{100 * (times - 1)} of {100 * times} rows are bad" in last.reason
    assert last.fix.startswith("Save each recording in a file of its own")
    assert len(read(tmp_path, csv_of(times * ROWS), "quality.max_bad_rows = 0.9").table) == 100


def test_rows_before_a_trigger_are_left_out_and_not_the_recording(tmp_path):
    found = read(tmp_path, csv_of(ROWS[:40] + ROWS), "quality.max_bad_rows = 0.9")
    assert len(found.table) == 100
    assert {fault.check for fault in found.faults} == {"time_order"}


@pytest.mark.parametrize(
    ("content", "check", "words"),
    [
        (b"", "empty_file", "empty"),
        (b"\n\n  \n", "empty_file", "empty"),
        (HEADER.encode() + b"\n", "no_rows", "no data"),
        (csv_of(ROWS[:3]).encode(), "no_rows", "3 of 3 data rows"),
        (b"PK\x03\x04" + bytes(range(200)), "binary_file", "xlsx"),
        (csv_of(ROWS).encode().replace(b"0.5,2.01", b"0.5\x00,2.01"), "binary_file", "byte 0x0"),
        (bytes(range(256)) * 20, "binary_file", "not text"),
        (
            csv_of(ROWS, "time_s,Displacement_mm,force_N").encode(),
            "missing_column",
            "Did you mean 'Displacement_mm'",
        ),
        (
            csv_of(ROWS, "time_s,displacment_mm,force_N").encode(),
            "missing_column",
            "Did you mean 'displacment_mm'",
        ),
        (csv_of(ROWS, "time_s,force_N,force_N").encode(), "missing_column", "displacement_mm"),
        (csv_of(ROWS, "force_N,displacement_mm,force_N").encode(), "duplicate_column", "2 times"),
        (csv_of(ROWS).replace(",", ";").encode(), "missing_column", 'delimiter = ";"'),
        (csv_of(ROWS).replace(",", "\t").encode(), "missing_column", 'delimiter = "tab"'),
        (csv_of([row.replace(",", ";") for row in ROWS], HEADER).encode(), "too_many_bad_rows", "100 of 100"),
    ],
)
def test_a_file_that_cannot_be_used_is_left_out_with_a_clear_line(tmp_path, content, check, words):
    with pytest.raises(BadFile, match=words) as caught:
        read(tmp_path, content)
    assert check in [fault.check for fault in caught.value.faults]


def test_no_column_that_is_used_already_is_suggested(tmp_path):
    mapped = 'force_N = "Reibkraft [N]"\nload_N = "Normalkraft [N]"\n'
    text = f'[trace.columns]\ntime_s = "time_s"\ndisplacement_mm = "displacement_mm"\n{mapped}'
    rows = [f"{row},1" for row in ROWS]
    fault = refused(tmp_path, csv_of(rows, "time_s,displacement_mm,Normalkraft [N],cycle"), text)
    assert fault.column == "Reibkraft [N]"
    assert fault.fix.startswith("The columns are 'time_s'")


def test_decimal_commas_everywhere_name_the_config_key(tmp_path):
    rows = [row.replace(",", ";").replace(".", ",") for row in ROWS]
    fault = refused(tmp_path, csv_of(rows, HEADER.replace(",", ";")), 'trace.delimiter = ";"')
    assert 'decimal = ","' in fault.fix
    trace = read(
        tmp_path, csv_of(rows, HEADER.replace(",", ";")), 'trace.delimiter = ";"\ntrace.decimal = ","'
    )
    npt.assert_allclose(trace.table["displacement_mm"], 0.5 * np.arange(100))


@pytest.mark.parametrize(("cell", "decimal"), [("1,200.5", "."), ("1.200,5", ",")])
def test_marks_between_thousands_are_named(cell, decimal):
    assert decimal_fix(cell, decimal) == "Export it again without marks between thousands."
    assert decimal_fix("1 or 2", decimal) == ""


def test_missing_folders_links_and_paths_outside_are_refused(tmp_path):
    (tmp_path / "c").mkdir()
    (tmp_path / "secret.csv").write_text(csv_of(ROWS))
    (tmp_path / "c" / "link.csv").symlink_to(tmp_path / "secret.csv")
    (tmp_path / "c" / "Run.csv").write_text(csv_of(ROWS))
    for file in ("../secret.csv", str(tmp_path / "secret.csv"), "link.csv", "C:\\secret.csv", "."):
        with pytest.raises(BadFile, match="outside the campaign"):
            read_trace(tmp_path / "c", TraceRef(file, {}), config())
    with pytest.raises(BadFile, match=r"Did you mean Run\.csv\?"):
        read_trace(tmp_path / "c", TraceRef("run.csv", {}), config())
    (tmp_path / "c" / "raw").mkdir()
    with pytest.raises(BadFile, match=r"Did you mean raw\?"):
        read_trace(tmp_path / "c", TraceRef("row/run.csv", {}), config())
    with pytest.raises(BadFile, match="Paths are relative to the folder"):
        read_trace(tmp_path / "c", TraceRef("x/run.csv", {}), config())


def of_speed(folder, content, commanded, text=""):
    """Return the findings on the speed of a trace of which one is commanded."""
    made = config(text)
    trace, strokes = with_strokes(read(folder, content, text, speed_set_mm_s=commanded), made)
    assert strokes
    return [fault for fault in [speed_fault(trace, strokes, made)] if fault]


@pytest.mark.parametrize(
    ("factor_t", "factor_x", "speed", "words"),
    [
        (1000.0, 1.0, 5.0, "time in ms"),
        (1.0, 1e-3, 5.0, "displacement in m"),
        (1.0, 1e3, 5.0, "µm"),
        (1.0, 0.1, 5.0, "cm"),
        (1.0, 1 / 25.4, 5.0, "inches"),
        (1 / 60, 1.0, 5.0, "minutes"),
        (1.0, 1.0, 300.0, "per minute"),
        (1.0, 1.0, 12.0, "Check the commanded speed"),
    ],
)
def test_units_mixed_up_are_named_by_speed_times_time(tmp_path, factor_t, factor_x, speed, words):
    rows = [f"{0.1 * i * factor_t!r},{0.5 * i * factor_x!r},2.0" for i in range(100)]
    (fault,) = of_speed(tmp_path, csv_of(rows), speed)
    assert (fault.check, fault.action) == ("speed_disagreement", "file left out")
    assert words in fault.fix


@pytest.mark.parametrize(("factor_t", "factor_x"), [(1000.0, 1.0), (1.0, 1e-3)])
@pytest.mark.parametrize("names", ["time_s,displacement_mm,force_N", "t,x,force_N"])
def test_the_unit_that_is_told_makes_the_file_readable(tmp_path, factor_t, factor_x, names):
    content = csv_of([f"{0.1 * i * factor_t!r},{0.5 * i * factor_x!r},2.0" for i in range(100)], names)
    columns = dict(zip(("time_s", "displacement_mm"), names.split(","), strict=False))
    text = "[trace.columns]\n" + "".join(f"{ours} = '{theirs}'\n" for ours, theirs in columns.items())
    fix = of_speed(tmp_path, content, 5.0, text)[0].fix
    line = fix.partition("Set ")[2].partition(" under")[0]
    kept = [old for old in text.splitlines() if old.split()[0] != line.split()[0]]
    assert of_speed(tmp_path, content, 5.0, "\n".join([*kept, line])) == []


def test_speed_within_tolerance_or_resting_agrees_and_a_slip_warns(tmp_path):
    assert of_speed(tmp_path, csv_of(ROWS), 5.9) == []
    (fault,) = of_speed(tmp_path, csv_of(ROWS), 6.5)
    assert (fault.severity, fault.action) == ("warning", "kept")
    rests = [f"{0.1 * i:.1f},{0.5 * min(i, 50):.1f},2.0" for i in range(100)]
    assert of_speed(tmp_path, csv_of(rests), 5.0) == []


def test_units_rows_are_recognised_for_what_they_are(tmp_path):
    trace = read(tmp_path, csv_of(["[s],[mm],[N]", *ROWS]))
    assert len(trace.table) == 100
    assert all("units_row = true" in fault.fix for fault in trace.faults)
    assert read(tmp_path, csv_of(["[s],[mm],[N]", *ROWS]), "trace.units_row = true").faults == ()


@pytest.mark.parametrize(
    "form",
    [
        "%Y-%m-%d %H:%M:%S.%f",
        "%Y-%m-%dT%H:%M:%S.%fZ",
        "%Y-%m-%dT%H:%M:%S.%f+01:00",
        "%d.%m.%Y %H:%M:%S.%f",
        "%H:%M:%S.%f",
        "%I:%M:%S.%f %p",
    ],
)
def test_times_of_day_are_seconds_since_the_first_past_midnight_too(form, tmp_path):
    first = datetime(2026, 3, 1, 23, 59, 57)
    times = [(first + timedelta(seconds=0.1 * i)).strftime(form) for i in range(len(ROWS))]
    rows = [f"{time},{row.partition(',')[2]}" for time, row in zip(times, ROWS, strict=True)]
    trace = read(tmp_path, csv_of(rows))
    npt.assert_allclose(trace.table["time_s"], 0.1 * np.arange(len(ROWS)), atol=1e-9)
    assert trace.faults == ()
    rows[7] = f"noon,{rows[7].partition(',')[2]}"
    (fault,) = read(tmp_path, csv_of(rows)).faults
    assert (fault.line, fault.column, fault.value) == (9, "time_s", "noon")


def test_many_short_strokes_with_rests_have_the_speed_of_their_plateaus(tmp_path):
    t = np.arange(0, 200, 0.02)
    phase = t % 4  # 1 s forth, 1 s rest, 1 s back, 1 s rest at 0.25 mm/s
    x = 0.25 * (np.clip(phase, 0, 1) - np.clip(phase - 2, 0, 1)) + np.random.default_rng(0).normal(
        0, 2e-4, len(t)
    )
    rows = [f"{a:.2f},{b:.6f},2.0" for a, b in zip(t, x, strict=True)]
    assert of_speed(tmp_path, csv_of(rows), 0.25) == []
    assert of_speed(tmp_path, csv_of(rows), 0.5)[0].check == "speed_disagreement"


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(BadFile, match="is not a file"):
        read_trace(tmp_path, TraceRef("pipe.csv", {}), config())


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 12), min_size=4, max_size=25))
def test_the_fewest_rows_are_left_out_for_a_rising_time(tmp_path_factory, times):
    rows = [f"{t},{i},1" for i, t in enumerate(times)]
    longest = [1] * len(times)  # textbook dynamic programme of the longest rising subsequence
    for i in range(len(times)):
        longest[i] = 1 + max((longest[j] for j in range(i) if times[j] < times[i]), default=0)
    rig = "quality.max_bad_rows = 1.0"
    if max(longest) < 4:
        refused(tmp_path_factory.mktemp("t"), csv_of(rows), rig)
        return
    trace = read(tmp_path_factory.mktemp("t"), csv_of(rows), rig)
    assert len(trace.table) == max(longest)
    assert (np.diff(trace.table["time_s"]) > 0).all()


def test_whole_numbers_of_any_size_are_a_channel(tmp_path):
    big = 2**60 + 1
    trace = read(tmp_path, csv_of([f"{row},{big + i}" for i, row in enumerate(ROWS)], HEADER + ",count"))
    npt.assert_array_equal(trace.columns["count"], np.float64(big))
