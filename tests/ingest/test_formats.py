import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trace_helpers import HEADER, ROWS, csv_of, read, refused

from sealfit.errors import BadFile


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
    npt.assert_allclose(
        trace.table["displacement_mm"].iloc[-1], -(0.5 * t[-1] + 0.05 * t[-1] ** 2), atol=1e-3
    )


@pytest.mark.parametrize(("unit", "factor"), [("m/s", 1000.0), ("mm/min", 1 / 60), (None, 1.0)])
def test_the_speed_that_is_integrated_is_converted_from_its_unit(tmp_path, unit, factor):
    given = f'{{name = "v", unit = "{unit}"}}' if unit else '"v"'
    rig = f"""
    [trace]
    columns = {{time_s = "t", speed = {given}, force_N = "F"}}
    integrate_displacement = "speed"
    drop_columns = ["speed"]
    """
    trace = read(tmp_path, csv_of([f"{0.1 * k:.1f},0.02,1.0" for k in range(100)], "t,v,F"), rig)
    npt.assert_allclose(trace.table["displacement_mm"].iloc[-1], 9.9 * 0.02 * factor)


def test_channels_are_numbers_or_labels_and_remarks_are_named(tmp_path):
    extra = [
        f"{row},{20 + i % 3},{'up' if i < 50 else 'down'},"
        f"{'noise here' if i == 7 else ''},{i if i != 9 else ''},,"
        for i, row in enumerate(ROWS)
    ]
    trace = read(tmp_path, csv_of(extra, HEADER + ",humidity_pct,phase,note,stroke,empty,"))
    assert list(trace.table)[3:] == ["humidity_pct", "phase", "stroke_file"]
    assert set(trace.table["phase"]) == {"up", "down"}
    assert trace.table["humidity_pct"].dtype == float
    checks = {(fault.check, fault.line, fault.column, fault.value, fault.action) for fault in trace.faults}
    assert ("remark", 9, "note", "noise here", "kept") in checks
    assert ("empty_cell", 11, "stroke", "", "row left out") in checks
    assert ("channel_left_out", None, "empty", None, "kept") in checks
    assert 11 not in trace.line


def test_slips_in_a_channel_with_decimal_commas(tmp_path):
    rows = [f"{row},{20 + i % 3}.5".replace(",", ";").replace(".", ",") for i, row in enumerate(ROWS)]
    rows[5] = rows[5].rpartition(";")[0] + ";20.5"
    rig = 'trace.delimiter = ";"\ntrace.decimal = ","'
    trace = read(tmp_path, csv_of(rows, HEADER.replace(",", ";") + ";lab_C"), rig)
    npt.assert_allclose(trace.table["lab_C"].iloc[:3], [20.5, 21.5, 22.5])
    ((fault),) = trace.faults
    assert (fault.line, fault.column, fault.value) == (7, "lab_C", "20.5")
    assert 'decimal = "."' in fault.fix


def test_what_cannot_be_computed_is_a_fault_that_json_can_hold(tmp_path):
    trace = read(
        tmp_path, csv_of(ROWS), 'trace.compute.force_N = "1 / displacement_mm"'
    )  # 1/0 on the first row
    (fault,) = trace.faults
    assert (fault.check, fault.line, fault.value) == ("not_finite", 2, "inf")


def test_a_computed_channel_that_is_no_number_is_said(tmp_path):
    text = 'trace.compute.root = "sqrt(force_N - 2.1)"\ntrace.compute._helper = "1 / displacement_mm"\n'
    trace = read(tmp_path, csv_of(ROWS), f'{text}trace.drop_columns = ["_helper"]\n')
    (fault,) = trace.faults
    assert (fault.check, fault.column, fault.severity) == ("not_finite", "root", "warning")
    assert "no number in 10 of 100 rows" in fault.reason


def test_an_instrument_s_mark_for_overload_is_no_force(tmp_path):
    rows = [f"{row},20" for row in ROWS]
    rows[10], rows[20] = "1.0,5.0,9.9E+37,20", "2.0,10.0,2.2,9.91e37"
    trace = read(tmp_path, csv_of(rows, HEADER + ",lab_C"))
    assert {(f.check, f.line, f.column, f.action) for f in trace.faults} == {
        ("overload", 12, "force_N", "row left out"),
        ("not_finite", 22, "lab_C", "row left out"),
    }
    assert len(trace.table) == 98


def test_a_sparse_channel_is_left_out_and_not_the_file(tmp_path):
    rows = [f"{row},{20 if i % 10 == 0 else ''}" for i, row in enumerate(ROWS)]
    trace = read(tmp_path, csv_of(rows, HEADER + ",temperature_lab_C"))
    assert len(trace.table) == 100
    assert [fault.check for fault in trace.faults] == ["channel_left_out"]


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16", "utf-16-le", "utf-16-be", "cp1252"]
)
def test_encodings_and_line_ends_are_recognised(tmp_path, encoding, end):
    content = (
        csv_of([row + ",20" for row in ROWS], HEADER + ",Öltemperatur °C").replace("\n", end).encode(encoding)
    )
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
    lines = [
        mark.join(write(cell) for cell in line) + mark * (2 * trailing) for line in [names, *table.tolist()]
    ]
    rig = (
        f'[trace]\ndelimiter = "{delimiter}"\ndecimal = "{decimal}"\n'
        f"trailing_separator = {str(trailing).lower()}"
    )
    trace = read(tmp_path_factory.mktemp("t"), end.join([*lines, ""]).encode(encoding), rig)
    npt.assert_allclose(trace.table[names].to_numpy(), table, rtol=1e-8)
    assert trace.faults == ()


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=300))
@example(b"\x0c")  # blank to str.strip, not to bytes that Arrow calls blank
@example("\u2003\n\xa0".encode())
def test_any_bytes_are_a_trace_or_a_bad_file(tmp_path_factory, content):
    try:
        trace = read(tmp_path_factory.mktemp("t"), HEADER.encode() + b"\n" + content)
    except BadFile as error:
        assert error.fault.reason  # noqa: PT017
        return
    assert np.isfinite(trace.table[["time_s", "displacement_mm", "force_N"]]).all(axis=None)
    assert (np.diff(trace.table["time_s"]) > 0).all()
