"""What spreadsheets, recorders and people do to files and tables, as exports of rigs show it."""

import itertools

import numpy as np
import numpy.testing as npt
import pytest
from nptdms import ChannelObject, TdmsWriter
from trace_helpers import DAYS, HEADER, ROWS, campaign, channels, config, csv_of, faults, read, refused, trace

from sealfit.errors import CampaignError, ConfigError
from sealfit.ingest.campaign import ingest_campaign
from sealfit.ingest.cells import seconds_of_day
from sealfit.ingest.columns import TraceRef
from sealfit.ingest.expression import evaluate, parse
from sealfit.ingest.reader import read_trace
from sealfit.ingest.runs import list_traces
from sealfit.units import Units

LOT = 'condition = ["lot"]\n'


# ---------------------------------------------------------------- names of conditions and specimens
@pytest.mark.parametrize(("one", "other"), [("20240301", "20240302"), ("1_2", "12"), ("1.0000001", "1.1")])
def test_lots_whose_names_are_nearly_alike_are_two_conditions(tmp_path, one, other):
    table = f"file,lot,speed_mm_s\na.csv,{one},5\nb.csv,{other},5\n"
    refs, _ = list_traces(campaign(tmp_path, table, ("a.csv", "b.csv")), config(LOT))
    assert len(set(refs.conditions)) == 2


def test_header_lines_name_specimens_as_they_are_written(tmp_path):
    for number in (12345670, 12345671):
        (tmp_path / f"{number}.csv").write_text(f"Probe: {number}\nStart: 20240301\n" + csv_of(ROWS))
    fields = '{specimen_id = "Probe: (.+)", started_at = "Start: (.+)"}'
    text = f'{LOT}files.glob = "*.csv"\nruns.constants = {{lot = "A", speed_mm_s = 5}}\n'
    found = channels(tmp_path, f"{text}[trace]\nheader_lines = 3\nheader_fields = {fields}")
    assert [one["specimen_id"] for one in found.values()] == ["12345670", "12345671"]
    assert {one["started_at"] for one in found.values()} == {"20240301"}


@pytest.mark.parametrize("speed", ["", ",speed_mm_s"])
def test_specimens_stand_in_traces_whether_or_not_the_table_has_the_speed(tmp_path, speed):
    cell, table = ",5" if speed else "", f"file,lot{speed}\n"
    for i in range(3):
        trace(tmp_path, f"r{i}.csv", specimen_id=f"P{i}")
        table += f"r{i}.csv,{'AAB'[i]}{cell}\n"
    (tmp_path / "runs.csv").write_text(table)
    assert [one["specimen_id"] for one in channels(tmp_path, LOT).values()] == ["P0", "P1", "P2"]


# ---------------------------------------------------------------- constants
@pytest.mark.parametrize(
    "constants", ['aging_days = "unaged"', "aging_days = 0", "aging_days = 0, repeat = 1"]
)
def test_constants_are_read_as_cells_are(tmp_path, constants):
    trace(tmp_path, "a.csv")
    text = f'{DAYS}files.glob = "*.csv"\nruns.constants = {{{constants}}}'
    (one,) = channels(tmp_path, text).values()
    assert one["aging_days"] == 0.0


@pytest.mark.parametrize("constants", ["repeat = 1.5", 'repeat = "x"'])
def test_a_constant_that_is_no_count_is_refused(tmp_path, constants):
    trace(tmp_path, "a.csv")
    text = f'{DAYS}files.glob = "*.csv"\nruns.constants = {{aging_days = 4, {constants}}}'
    assert {fault.column for fault in faults(tmp_path, text)} == {"repeat"}


@pytest.mark.parametrize(("name", "word"), [("speed_mm_s", "slow"), ("aging_days", "four")])
def test_a_word_in_a_trace_where_a_number_is_needed_costs_the_file(tmp_path, name, word):
    trace(tmp_path, "a.csv", **{name: word})
    trace(tmp_path, "b.csv", **{name: 5})
    extra = "" if name == "aging_days" else ",aging_days"
    cell = ",4" if extra else ""
    (tmp_path / "runs.csv").write_text(f"file{extra}\na.csv{cell}\nb.csv{cell}\n")
    refs, found = list_traces(tmp_path, config(DAYS))
    assert [ref.file for ref in refs] == ["b.csv"]
    (fault,) = (fault for fault in found if fault.file)
    assert (fault.check, fault.file, fault.column) == ("not_a_number", "a.csv", name)


# ---------------------------------------------------------------- cells
def test_a_filter_reads_labels(tmp_path):
    rows = [f"{row},{'ok' if i % 10 else 'stop'}" for i, row in enumerate(ROWS)]
    found = read(tmp_path, csv_of(rows, f"{HEADER},status"), "trace.keep = \"status == 'ok'\"")
    assert len(found.line) == 90
    assert found.faults == ()


@pytest.mark.parametrize("cell", ["TRUE", "08:30", "2024-03-01"])
@pytest.mark.parametrize("between", ["\n", "\n\n"])
def test_labels_are_kept_as_they_are_written_on_both_ways_of_reading(tmp_path, cell, between):
    rows = [f"{row},{cell}" for row in ROWS]
    content = "\n".join([f"{HEADER},mark", *rows[:50]]) + between + "\n".join(rows[50:])
    assert set(read(tmp_path, content).columns["mark"]) == {cell}


def test_numbers_are_compared_with_text_as_they_are_written():
    cells = np.array([1.0, 2.0])
    npt.assert_array_equal(evaluate(parse("where(cell == '2', 10, 20)"), {"cell": cells}), [20, 10])


def test_an_overload_is_left_out_where_displacement_is_an_integral(tmp_path):
    rows = [f"{0.1 * i:.1f},5,{50 if i % 40 else 9.9e37}" for i in range(100)]
    text = '[trace]\nintegrate_displacement = "v_mm_s"\ncompute = {force_N = "0.1 * load_N"}\n'
    text += 'columns = {time_s = "time_s", load_N = "load_N", v_mm_s = "v_mm_s"}'
    found = read(tmp_path, csv_of(rows, "time_s,v_mm_s,load_N"), text)
    assert len(found.line) == 97
    npt.assert_allclose(found.columns["force_N"], 5.0)


def test_one_wrong_time_of_day_is_no_midnight():
    cells = ["14:00:00.0", "14:00:00.1", "00:00:00.0", "14:00:00.3", "14:00:00.4"]
    npt.assert_allclose(np.delete(seconds_of_day(cells), 2), [0.0, 0.1, 0.3, 0.4])
    npt.assert_allclose(seconds_of_day(["23:59:59", "00:00:00", "00:00:01"]), [0.0, 1.0, 2.0])


@pytest.mark.parametrize("how", ["clock", "rate"])
def test_times_of_day_and_rates_are_in_the_unit_of_the_config(tmp_path, how):
    text = '[quantities]\ntime = {quantity = "time", unit = "min"}\n'
    text += 'speed = {quantity = "speed", unit = "mm/min"}\n'
    if how == "rate":
        rows, header = [row.partition(",")[2] for row in ROWS], "displacement_mm,force_N"
        text += "[trace]\nrate_Hz = 10\n"
    else:
        rows, header = (
            [f"14:00:{0.1 * i:04.1f},{row.partition(',')[2]}" for i, row in enumerate(ROWS)],
            HEADER,
        )
    assert read(tmp_path, csv_of(rows, header), text).columns["time_s"][-1] == pytest.approx(9.9 / 60)


@pytest.mark.parametrize(("cell", "value"), [("-999.00", None), ("-999,0", None), ("-999.5", -999.5)])
def test_codes_for_no_value_are_numbers(tmp_path, cell, value):
    table = f"file;aging_days;humidity_pct\na.csv;4;{cell}\n"
    (one,) = channels(campaign(tmp_path, table, ("a.csv",)), DAYS).values()
    assert one.get("humidity_pct") == value


# ---------------------------------------------------------------- files
@pytest.mark.parametrize("tail", ["\n,,\n,,\n", "\n ; ;\n", "\n\x1a", "\n"])
def test_what_programs_write_below_the_data_is_no_row(tmp_path, tail):
    found = read(tmp_path, csv_of(ROWS).rstrip("\n") + tail)
    assert (found.rows_read, found.faults) == (100, ())


def test_a_blank_line_above_numbers_without_names_is_no_row(tmp_path):
    text = '[trace]\nnames = "none"\nheader_lines = 0\n'
    text += "columns = {time_s = 1, displacement_mm = 2, force_N = 3}"
    assert read(tmp_path, "\n" + "\n".join(ROWS), text).rows_read == 100


def test_a_byte_that_is_not_utf_8_does_not_change_the_others(tmp_path):
    content = csv_of([f"{row},1" for row in ROWS], f"{HEADER},µ").encode() + b"9.99,49,2,\xb5"
    assert "µ" in read(tmp_path, content).columns


@pytest.mark.parametrize("lines", [1, 2])
def test_a_file_that_ends_in_its_header_is_left_out(tmp_path, lines):
    text = "[trace]\nheader_lines = 5\nnames_line = 4"
    assert refused(tmp_path, "a\n" * lines, text).check in ("header_not_found", "no_rows")


def test_columns_by_position_do_not_move_where_a_channel_is_short(tmp_path):
    t, x, force = (np.array([float(row.split(",")[i]) for row in ROWS]) for i in range(3))
    with TdmsWriter(tmp_path / "t.tdms") as writer:
        values = {"t": t, "temp": t[:4], "x": x, "F": force, "Fz": force + 9, "acoustic": np.zeros(1000)}
        writer.write_segment([ChannelObject("all", name, cells) for name, cells in values.items()])
    text = "[trace]\ncolumns = {time_s = 1, displacement_mm = 3, force_N = 4}"
    found = read_trace(tmp_path, TraceRef("t.tdms", {}), config(text))
    npt.assert_array_equal(found.columns["force_N"], force)
    assert sorted(fault.column for fault in found.faults) == ["acoustic", "temp"]


# ---------------------------------------------------------------- lists of files
def test_hidden_files_and_results_are_not_found_by_a_glob(tmp_path):
    trace(tmp_path, "a/T70_d1.csv")
    (tmp_path / "a" / "._T70_d1.csv").write_bytes(b"\0\5\x16\7")
    (tmp_path / "out" / "plots").mkdir(parents=True)
    (tmp_path / "out" / "plots" / "aging.csv").write_text("1\n")
    (tmp_path / "out" / "state.json").write_text("{}")
    found = channels(tmp_path, f'{DAYS}files.glob = "**/*"\nruns.constants = {{aging_days = 4}}')
    assert list(found) == ["a/T70_d1.csv"]


def test_a_campaign_that_holds_results_itself_keeps_its_traces(tmp_path):
    trace(tmp_path, "a/T70_d1.csv")
    (tmp_path / "state.json").write_text("{}")
    found = channels(tmp_path, f'{DAYS}files.glob = "**/*.csv"\nruns.constants = {{aging_days = 4}}')
    assert list(found) == ["a/T70_d1.csv"]


@pytest.mark.parametrize("glob", ["/data/*.csv", "../*.csv", ""])
def test_a_glob_that_leads_outside_is_a_fault_of_the_config(glob):
    with pytest.raises(ConfigError, match=r"files\.glob"):
        config(f'files.glob = "{glob}"')


def test_a_time_of_a_program_that_has_none_is_said(tmp_path):
    table = "file,aging_days,started_at\na.csv,4,0001-01-01T00:00:00+01:00\nb.csv,4,2024-03-01T09:00:00\n"
    (fault,) = faults(campaign(tmp_path, table, ("a.csv", "b.csv")), DAYS)
    assert (fault.check, fault.file, fault.line) == ("not_a_time", "runs.csv", 2)


def test_names_with_and_without_zeros_have_one_order(tmp_path):
    for name in ("run01", "run1", "run001"):
        trace(tmp_path, f"{name}.csv")
    found = channels(tmp_path, f'{DAYS}files.glob = "*.csv"\nruns.constants = {{aging_days = 4}}')
    assert list(found) == ["run001.csv", "run01.csv", "run1.csv"]


def test_a_speed_in_the_name_of_a_column_is_its_unit():
    assert Units().of("feed_mm_s") == "mm/s"
    assert Units().of("v_m_s") == "m/s"
    assert Units().label("feed_mm_s") == "feed (mm/s)"


# ---------------------------------------------------------------- what a config does not say
def rows_of(folder, file, speed, force, pressure, reverse=False):
    time = 0.01 * np.arange(400)
    x = speed * np.where(time < 2, time, 4 - time)
    way = np.where(time < 2, 1.0, -1.0)
    shown = np.abs(force * way) if reverse else force * way
    noise = np.random.default_rng(list(file.encode())).normal(0, 0.02, 400)
    lines = [f"{t:.2f},{a:.4f},{f:.4f},{pressure}" for t, a, f in zip(time, x, shown + noise, strict=True)]
    (folder / file).write_text("\n".join([f"{HEADER},pressure_bar", *lines]))


@pytest.fixture
def pressures(tmp_path):
    """A campaign at two days, two speeds and two pressures, which only the traces have."""
    table = ["file,aging_days,speed_mm_s"]
    for day, speed, pressure in itertools.product((0, 4), (5, 20), (50, 150)):
        file = f"d{day}_v{speed}_p{pressure}.csv"
        rows_of(tmp_path, file, speed, 0.1 * pressure, pressure)
        table.append(f"{file},{day},{speed}")
    (tmp_path / "runs.csv").write_text("\n".join(table) + "\n")
    return tmp_path


def test_a_setting_that_differs_between_repeats_is_named(pressures):
    quality = ingest_campaign(pressures, config(DAYS)).tables["quality"]
    (found,) = quality[quality["check"] == "setting_in_run"].to_dict("records")
    assert found["column"] == "pressure_bar"
    assert "4 of 4 runs: 50, 150." in found["reason"]


def test_unaged_files_that_differ_in_a_setting_of_the_test_are_named(pressures):
    table = [line.split(",") for line in (pressures / "runs.csv").read_text().split()]
    rows = [[*cells, cells[0].partition("_p")[2].removesuffix(".csv")] for cells in table[1:]]
    text = "\n".join(",".join(cells) for cells in [[*table[0], "pressure_bar"], *rows])
    (pressures / "runs.csv").write_text(text + "\n")
    text = 'condition = ["pressure_bar", "aging_days"]\n'
    _, found = list_traces(pressures, config(text))
    (fault,) = (fault for fault in found if fault.check == "unaged_pooled")
    assert fault.column == "pressure_bar"
    assert "(150, 50)" in fault.reason
    assert not [f for f in list_traces(pressures, config(text + 'rubber = ["pressure_bar"]'))[1] if f.column]


def test_a_force_that_is_a_magnitude_is_no_friction_of_turned_sign(tmp_path):
    for speed in (5, 20):
        rows_of(tmp_path, f"v{speed}.csv", speed, 8.0, 50, reverse=True)
    text = f'{LOT}files.glob = "*.csv"\nruns.constants = {{lot = "A"}}\n'
    with pytest.raises(CampaignError) as caught:
        ingest_campaign(tmp_path, config(text))
    (fault,) = (fault for fault in caught.value.faults if fault.check == "turned_sign")
    assert "as a magnitude has" in fault.reason
    assert "sign(SPEED)" in fault.fix


def test_a_displacement_that_counts_the_distance_in_both_directions_is_named(tmp_path):
    """Two strokes to and fro of 40 mm at 5 mm/s, and 8 N against the motion."""
    time = np.arange(0.0, 32.0, 0.02)
    force = np.where(time % 16.0 < 8.0, 8.0, -8.0) + np.random.default_rng(1).normal(0.0, 0.05, time.size)
    lines = [f"{t:.2f},{5 * t:.4f},{f:.4f}" for t, f in zip(time, force, strict=True)]
    (tmp_path / "v5.csv").write_text("\n".join([HEADER, *lines]))
    with pytest.raises(CampaignError) as caught:
        ingest_campaign(tmp_path, config(f'{LOT}files.glob = "*.csv"\nruns.constants = {{lot = "A"}}\n'))
    (fault,) = (fault for fault in caught.value.faults if fault.check == "turned_sign")
    assert "the distance slid in both directions" in fault.reason


@pytest.mark.parametrize("swing", [0.0, 2.5])
def test_noise_or_a_ripple_above_the_friction_is_no_reversal(swing, tmp_path):
    """One stroke of 40 mm: 1 N of friction under 5 N of noise, or a ripple of 2.5 N and 4 mm."""
    time = np.arange(0.0, 8.0, 0.02)
    noise = np.random.default_rng(1).normal(0.0, 0.1 if swing else 5.0, time.size)
    force = 1.0 + swing * np.sin(2 * np.pi * 5 * time / 4.0) + noise
    lines = [f"{t:.2f},{5 * t:.4f},{f:.4f}" for t, f in zip(time, force, strict=True)]
    (tmp_path / "v5.csv").write_text("\n".join([HEADER, *lines]))
    found = ingest_campaign(tmp_path, config(f'{LOT}files.glob = "*.csv"\nruns.constants = {{lot = "A"}}\n'))
    assert "turned_sign" not in set(found.tables["quality"]["check"])
