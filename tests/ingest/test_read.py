import os
from pathlib import Path

import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealfit.config import parse_config
from sealfit.errors import BadFile
from sealfit.ingest.read import read_trace
from sealfit.ingest.refs import TraceRef

HEADER = "time_s,displacement_mm,force_N"
ROWS = [f"{0.1 * i:.1f},{0.5 * i:.1f},{2 + 0.01 * i:.2f}" for i in range(100)]  # 5 mm/s, 100 rows


def config(text=""):
    return parse_config(text, "rig.toml")


def read(folder: Path, content: str | bytes, text="", **channels):
    content = content if isinstance(content, bytes) else content.encode()
    (folder / "t.csv").write_bytes(content)
    return read_trace(folder, TraceRef("t.csv", channels), config(text))


def refused(folder, content, text="", **channels):
    with pytest.raises(BadFile) as caught:
        read(folder, content, text, **channels)
    assert caught.value.fault.file == "t.csv"
    assert caught.value.fault.action == "file left out"
    return caught.value.fault


def csv_of(rows, header=HEADER):
    return "\n".join([header, *rows]) + "\n"


def changed(at, row):
    return csv_of([*ROWS[:at], row, *ROWS[at + 1 :]])


def test_plain_file_reads_as_written(tmp_path):
    trace = read(tmp_path, csv_of(ROWS))
    assert list(trace.table) == ["time_s", "displacement_mm", "force_N"]
    assert [str(kind) for kind in trace.table.dtypes] == ["float64"] * 3
    npt.assert_allclose(trace.table["force_N"].iloc[[0, 99]], [2.0, 2.99])
    npt.assert_array_equal(trace.line[[0, 99]], [2, 101])
    assert trace.rows_read == 100
    assert trace.faults == ()


@pytest.mark.parametrize(
    ("row", "check", "column", "value", "mend"),
    [
        ("1.0,5.0,abc", "not_a_number", "force_N", "abc", "Put a number"),
        ("1.0,5.0,nan", "not_finite", "force_N", "nan", "Delete"),
        ("1.0,5.0,inf", "not_finite", "force_N", "inf", "Delete"),
        ("1.0,,2.0", "empty_cell", "displacement_mm", "", "Fill"),
        ("1.0,5.0", "too_few_cells", "force_N", None, "Complete"),
        ('1.0,5.0,"2,1"', "not_a_number", "force_N", "2,1", 'decimal = ","'),
        ("1.0,5.0,1_0", "not_a_number", "force_N", "1_0", "Put a number"),
        ("1.0,5.0,2.1 was 1.9", "remark", "force_N", "2.1 was 1.9", "right number alone"),
        ("1.0,5.0,2.1,was 1.9", "remark", None, "was 1.9", "column with a name"),
        ("1.0,5.0,2.1,7", "too_many_cells", None, "7", "column with a name"),
        ("0.9,5.0,2.1", "time_order", "time_s", 0.9, "clock"),
        ("0.3,5.0,2.1", "time_order", "time_s", 0.3, "clock"),
        ("99.0,5.0,2.1", "time_order", "time_s", 99.0, "clock"),
    ],
)
def test_a_bad_cell_costs_its_row_and_is_named_with_line_value_and_mend(tmp_path, row, check, column, value, mend):
    trace = read(tmp_path, changed(10, row))
    (fault,) = trace.faults
    assert (fault.check, fault.line, fault.column, fault.value) == (check, 12, column, value)
    assert (fault.file, fault.action) == ("t.csv", "row left out")
    assert mend in fault.mend
    assert len(trace.table) == 99
    assert trace.rows_read == 100
    assert 12 not in trace.line
    npt.assert_array_equal(np.delete(np.arange(2, 102), 10), trace.line)


def test_five_percent_of_bad_rows_are_left_out_and_six_leave_the_file_out(tmp_path):
    bad = {i: f"{0.1 * i:.1f},x,1" for i in range(0, 60, 10)}
    five = [bad[i] if i in list(bad)[:5] else row for i, row in enumerate(ROWS)]
    assert len(read(tmp_path, csv_of(five)).table) == 95
    fault = refused(tmp_path, csv_of([bad.get(i, row) for i, row in enumerate(ROWS)]))
    assert fault.check == "too_many_bad_rows"
    assert "6 of 100 rows are bad, more than 5 %" in fault.reason
    assert (
        len(read(tmp_path, csv_of([bad.get(i, r) for i, r in enumerate(ROWS)]), "quality.max_bad_rows = 0.06").table)
        == 94
    )


def test_many_faults_are_counted_and_only_the_first_twenty_written_out(tmp_path):
    with pytest.raises(BadFile) as caught:
        read(tmp_path, csv_of([row.replace(".", ".", 1) if i % 2 else "1,x,2" for i, row in enumerate(ROWS)]))
    faults = [fault for fault in caught.value.faults if fault.column == "displacement_mm"]
    assert len(faults) == 21
    assert faults[-1].value == 30
    assert "30 more cells" in faults[-1].reason


def test_one_wrong_time_far_ahead_costs_one_row_and_a_restarted_clock_the_file(tmp_path):
    assert len(read(tmp_path, changed(50, "900.0,25.0,2.5")).table) == 99
    fault = refused(tmp_path, csv_of(ROWS + ROWS))
    assert "rows are bad" in fault.reason
    assert "clock" in fault.mend


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
        (csv_of(ROWS, "time_s,Displacement_mm,force_N").encode(), "missing_column", "Did you mean 'Displacement_mm'"),
        (csv_of(ROWS, "time_s,displacment_mm,force_N").encode(), "missing_column", "Did you mean 'displacment_mm'"),
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


def test_decimal_commas_everywhere_name_the_config_key(tmp_path):
    rows = [row.replace(",", ";").replace(".", ",") for row in ROWS]
    fault = refused(tmp_path, csv_of(rows, HEADER.replace(",", ";")), 'trace.delimiter = ";"')
    assert 'decimal = ","' in fault.mend
    trace = read(tmp_path, csv_of(rows, HEADER.replace(",", ";")), 'trace.delimiter = ";"\ntrace.decimal = ","')
    npt.assert_allclose(trace.table["displacement_mm"], 0.5 * np.arange(100))


def test_missing_folders_links_and_paths_outside_are_refused(tmp_path):
    (tmp_path / "c").mkdir()
    (tmp_path / "secret.csv").write_text(csv_of(ROWS))
    (tmp_path / "c" / "link.csv").symlink_to(tmp_path / "secret.csv")
    (tmp_path / "c" / "Run.csv").write_text(csv_of(ROWS))
    for file in ("../secret.csv", str(tmp_path / "secret.csv"), "link.csv", "C:\\secret.csv", "."):
        with pytest.raises(BadFile, match="outside the campaign"):
            read_trace(tmp_path / "c", TraceRef(file, {}), config())
    with pytest.raises(BadFile, match="case of letters matters"):
        read_trace(tmp_path / "c", TraceRef("run.csv", {}), config())
    with pytest.raises(BadFile, match="no folder 'x' either"):
        read_trace(tmp_path / "c", TraceRef("x/run.csv", {}), config())


def test_header_by_count_names_and_units_rows_and_positions(tmp_path):
    content = "Rig 7\nspeed: 5\nt;x;F\n[s];[mm];[N]\n" + "\n".join(row.replace(",", ";") for row in ROWS)
    rig = """
    [trace]
    delimiter = ";"
    units_row = true
    header_lines = 4
    columns = {time_s = "t", displacement_mm = "x", force_N = 3}
    """
    trace = read(tmp_path, content, rig)
    npt.assert_allclose(trace.table["force_N"].iloc[0], 2.0)
    assert trace.line[0] == 5
    by_pattern = rig.replace("header_lines = 4", "header_ends_at = '^\\[s\\]'")
    assert read(tmp_path, content, by_pattern).table.equals(trace.table)
    assert (
        refused(tmp_path, content, rig.replace("header_lines = 4", "header_ends_at = '^ms'")).check
        == "header_not_found"
    )
    shifted = rig.replace("force_N = 3", "force_N = 4")
    assert "no column 4: the lines have 3" in str(refused(tmp_path, content, shifted))


def test_header_fields_feed_expressions_and_constants(tmp_path):
    content = "Area;2,5 mm2\nt;x;p\n" + "\n".join(row.replace(",", ";").replace(".", ",") for row in ROWS)
    rig = """
    [trace]
    delimiter = ";"
    decimal = ","
    header_ends_at = "^t;"
    columns = {time_s = "t", displacement_mm = "x", p = "p"}
    header_fields = {_area = '^Area;([\\d,]+)'}
    constants = {gain = 10}
    compute = {force_N = "p * _area * gain"}
    drop_columns = ["p"]
    """
    trace = read(tmp_path, content, rig)
    npt.assert_allclose(trace.table["force_N"].iloc[0], 2.0 * 2.5 * 10)
    assert list(trace.table) == ["time_s", "displacement_mm", "force_N"]


def test_rows_dropped_filtered_and_recomputed(tmp_path):
    rows = [f"{row},{'5.0' if i >= 20 else '1.0'}" for i, row in enumerate(ROWS)]
    rig = """
    [trace]
    drop_first_rows = 10
    keep = "load_N > 4.9 and time_s < 8000"
    compute = {time_s = "time_s * 1000"}
    """
    trace = read(tmp_path, csv_of(rows, HEADER + ",load_N"), rig)
    assert trace.line[0] == 22  # ten dropped, ten filtered
    npt.assert_allclose(trace.table["time_s"].iloc[[0, -1]], [2000.0, 7900.0])
    assert list(trace.table)[3] == "load_N"
    fault = refused(tmp_path, csv_of(rows, HEADER + ",load_N"), 'trace.keep = "load_N > 50"')
    assert fault.check == "no_rows"
    fault = refused(tmp_path, csv_of(ROWS), 'trace.keep = "load > 50"')
    assert "no column 'load'" in fault.reason


def test_displacement_integrates_a_speed_in_turns_per_minute(tmp_path):
    t = np.arange(0.0, 10.0, 0.1)
    rows = [f"{x:.1f},{30 + 6 * x:.3f},1.0" for x in t]  # n = 30 + 6 t per min: 0.5 t + 0.05 t^2 turns
    rig = """
    [trace]
    columns = {time_s = "time_s", rpm = "rpm", force_N = "force_N"}
    integrate_displacement = "speed"
    integrate_per = "min"
    compute = {speed = "-rpm", force_N = "force_N + 0 * displacement_mm"}
    drop_columns = ["rpm", "speed"]
    """
    trace = read(tmp_path, csv_of(rows, "time_s,rpm,force_N"), rig)
    npt.assert_allclose(trace.table["displacement_mm"], -(0.5 * t + 0.05 * t**2), atol=1e-9)
    rows[50] = "5.0,x,1.0"  # the integral spans the gap that a bad row leaves
    trace = read(tmp_path, csv_of(rows, "time_s,rpm,force_N"), rig)
    npt.assert_allclose(trace.table["displacement_mm"].iloc[-1], -(0.5 * t[-1] + 0.05 * t[-1] ** 2), atol=1e-3)


def test_channels_are_numbers_or_labels_and_remarks_are_named(tmp_path):
    extra = [
        f"{row},{20 + i % 3},{'up' if i < 50 else 'down'},{'noise here' if i == 7 else ''},{i if i != 9 else ''},,"
        for i, row in enumerate(ROWS)
    ]
    trace = read(tmp_path, csv_of(extra, HEADER + ",humidity_pct,phase,note,stroke,empty,"))
    assert list(trace.table)[3:] == ["humidity_pct", "phase", "stroke_file"]
    assert set(trace.table["phase"]) == {"up", "down"}
    assert trace.table["humidity_pct"].dtype == float
    checks = {(fault.check, fault.line, fault.column, fault.value, fault.action) for fault in trace.faults}
    assert ("remark", 9, "note", "noise here", "kept") in checks
    assert ("not_finite", 11, "stroke", "", "row left out") in checks
    assert ("channel_left_out", None, "empty", None, "kept") in checks
    assert 11 not in trace.line


def test_a_sparse_channel_is_left_out_and_not_the_file(tmp_path):
    rows = [f"{row},{20 if i % 10 == 0 else ''}" for i, row in enumerate(ROWS)]
    trace = read(tmp_path, csv_of(rows, HEADER + ",temperature_lab_C"))
    assert len(trace.table) == 100
    assert [fault.check for fault in trace.faults] == ["channel_left_out"]


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
    fault = refused(tmp_path, csv_of(rows), speed_set_mm_s=speed)
    assert fault.check == "speed_disagreement"
    assert words in fault.mend


def test_speed_within_tolerance_or_resting_agrees_and_a_slip_warns(tmp_path):
    assert read(tmp_path, csv_of(ROWS), speed_set_mm_s=5.9).faults == ()
    (fault,) = read(tmp_path, csv_of(ROWS), speed_set_mm_s=6.5).faults
    assert (fault.severity, fault.action) == ("warning", "kept")
    rests = [f"{0.1 * i:.1f},{0.5 * min(i, 50):.1f},2.0" for i in range(100)]
    assert read(tmp_path, csv_of(rests), speed_set_mm_s=5.0).faults == ()


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16", "utf-16-le", "utf-16-be", "cp1252"])
def test_encodings_and_line_ends_are_recognised(tmp_path, encoding, end):
    content = csv_of([row + ",20" for row in ROWS], HEADER + ",Öltemperatur °C").replace("\n", end).encode(encoding)
    trace = read(tmp_path, content)
    npt.assert_allclose(trace.table["Öltemperatur °C"], 20.0)
    assert trace.line[-1] == 101


def test_a_declared_encoding_that_is_wrong_is_said(tmp_path):
    content = csv_of([row + ",20" for row in ROWS], HEADER + ",Öl").encode("latin-1")
    assert refused(tmp_path, content, 'trace.encoding = "utf-8"').check == "wrong_encoding"


def test_blank_lines_keep_line_numbers_right(tmp_path):
    trace = read(tmp_path, "\n" + csv_of([*ROWS[:50], "", "  ", *ROWS[50:], "", ""]))
    npt.assert_array_equal(trace.line[[0, 49, 50, 99]], [3, 52, 55, 104])
    assert trace.faults == ()


def test_units_rows_and_clocks_are_recognised_for_what_they_are(tmp_path):
    trace = read(tmp_path, csv_of(["[s],[mm],[N]", *ROWS]))
    assert len(trace.table) == 100
    assert all("units_row = true" in fault.mend for fault in trace.faults)
    assert read(tmp_path, csv_of(["[s],[mm],[N]", *ROWS]), "trace.units_row = true").faults == ()
    clocks = [f"12:00:0{row}" for row in ROWS]
    assert "as seconds" in refused(tmp_path, csv_of(clocks)).mend


def test_many_short_strokes_with_rests_have_the_speed_of_their_plateaus(tmp_path):
    t = np.arange(0, 200, 0.02)
    phase = t % 4  # 1 s forth, 1 s rest, 1 s back, 1 s rest at 0.25 mm/s
    x = 0.25 * (np.clip(phase, 0, 1) - np.clip(phase - 2, 0, 1)) + np.random.default_rng(0).normal(0, 2e-4, len(t))
    rows = [f"{a:.2f},{b:.6f},2.0" for a, b in zip(t, x, strict=True)]
    assert read(tmp_path, csv_of(rows), speed_set_mm_s=0.25).faults == ()
    assert refused(tmp_path, csv_of(rows), speed_set_mm_s=0.5).check == "speed_disagreement"


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(BadFile, match="is no file"):
        read_trace(tmp_path, TraceRef("pipe.csv", {}), config())


values = st.floats(-1e6, 1e6, allow_subnormal=False).map(lambda x: float(f"{x:.9g}"))
writings = st.tuples(
    st.sampled_from([",", ";", "tab", "whitespace", "|"]),
    st.sampled_from([".", ","]),
    st.sampled_from(["utf-8", "utf-8-sig", "latin-1", "utf-16", "utf-16-be"]),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.booleans(),  # trailing separators
    st.booleans(),  # quoted cells
).filter(lambda w: w[0] != w[1] and not (w[0] == "whitespace" and w[4]))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(values, values, values), min_size=4, max_size=12), writings)
def test_a_table_reads_back_the_same_however_it_is_written(tmp_path_factory, rows, writing):
    delimiter, decimal, encoding, end, trailing, quoted = writing
    mark = {"tab": "\t", "whitespace": "  \t "}.get(delimiter, delimiter)
    table = np.array([(float(i), *row) for i, row in enumerate(rows)])

    def write(cell):
        text = (f"{cell:.9g}" if isinstance(cell, float) else cell).replace(".", decimal)
        return f'"{text}"' if quoted and delimiter != "whitespace" else text

    names = ["time_s", "displacement_mm", "force_N", "µ"]
    lines = [mark.join(write(cell) for cell in line) + mark * (2 * trailing) for line in [names, *table.tolist()]]
    rig = f'[trace]\ndelimiter = "{delimiter}"\ndecimal = "{decimal}"\ntrailing_separator = {str(trailing).lower()}'
    trace = read(tmp_path_factory.mktemp("t"), end.join([*lines, ""]).encode(encoding), rig)
    npt.assert_allclose(trace.table[names].to_numpy(), table, rtol=1e-8)
    assert trace.faults == ()


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=300))
def test_any_bytes_are_a_trace_or_a_bad_file(tmp_path_factory, content):
    try:
        trace = read(tmp_path_factory.mktemp("t"), HEADER.encode() + b"\n" + content)
    except BadFile as error:
        assert error.fault.reason  # noqa: PT017
        return
    assert np.isfinite(trace.table[["time_s", "displacement_mm", "force_N"]]).all(axis=None)
    assert (np.diff(trace.table["time_s"]) > 0).all()


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
