from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealfit.config import parse_config
from sealfit.errors import CampaignError
from sealfit.ingest.derive import condition_keys
from sealfit.ingest.runs import list_traces
from sealfit.ingest.runs_csv import natural

DAYS = 'condition = ["aging_days"]\n'
HEADER = "time_s,displacement_mm,force_N"


def config(text=""):
    return parse_config(text, "rig.toml")


def trace(folder: Path, file: str, speed=5.0, **constants):
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    extra = "".join(f",{value}" for value in constants.values())
    rows = [f"{0.1 * i:.1f},{0.1 * speed * i:.6f},2.0{extra}" for i in range(100)]
    path.write_text("\n".join([HEADER + "".join(f",{name}" for name in constants), *rows]))


def campaign(folder: Path, table: str, files=("a.csv", "b.csv", "c.csv")) -> Path:
    for file in files:
        trace(folder, file)
    (folder / "runs.csv").write_text("\n".join(line.strip() for line in table.strip().splitlines()) + "\n")
    return folder


def channels(folder, text=""):
    refs, _ = list_traces(folder, config(text))
    return {ref.file: ref.channels for ref in refs}


def faults(folder, text=""):
    with pytest.raises(CampaignError) as caught:
        list_traces(folder, config(text))
    return caught.value.faults


FULL = """
file,run_id,repeat,specimen_id,temperature_C,compression_ratio_pct,aging_days,load_N,speed_mm_s,started_at,batch,humidity_pct
a.csv,r1,1,S1,60,80,4,49.03,5,2024-03-01T09:00:00,A,40
b.csv,r1,2,S1,60,80,4,49.03,5,2024-03-01T10:30:00,A,n/a
c.csv,r2,1,S2,60,80,8,49.03,5,2024-03-01T08:00:00,B,42.5
"""


def test_full_table_reads_as_written(tmp_path):
    refs, found = list_traces(campaign(tmp_path, FULL), config())
    assert found == []
    assert [ref.file for ref in refs] == ["a.csv", "b.csv", "c.csv"]
    assert refs[0].channels == {
        "run_id": "r1",
        "repeat": 1,
        "specimen_id": "S1",
        "temperature_C": 60.0,
        "compression_ratio_pct": 80.0,
        "aging_days": 4.0,
        "load_N": 49.03,
        "speed_set_mm_s": 5.0,
        "started_at": "2024-03-01T09:00:00",
        "run_order": 2.0,
        "elapsed_h": 1.0,
        "batch": "A",
        "humidity_pct": 40.0,
    }
    assert refs[1].channels["elapsed_h"] == 2.5
    assert refs[2].channels["run_order"] == 1.0
    assert "humidity_pct" not in refs[1].channels


def test_semicolons_decimal_commas_and_other_names_of_columns(tmp_path):
    table = FULL.strip().replace(".csv", "·csv").replace("49.03", "49,03").replace("42.5", "42,5")
    lines = [line.replace(",", ";").replace("49;03", "49,03").replace("42;5", "42,5") for line in table.splitlines()]
    folder = campaign(tmp_path, "\n".join(lines).replace("·csv", ".csv").replace("load_N", "Last"))
    found = channels(folder, '[files.runs_columns]\nload_N = "Last"')
    assert found["a.csv"]["load_N"] == 49.03
    assert found["c.csv"]["humidity_pct"] == 42.5


def test_only_file_and_condition_are_needed(tmp_path):
    folder = campaign(tmp_path, "file,aging_days,speed_mm_s\na.csv,4,5\nb.csv,4,5\nc.csv,4,10")
    trace(folder, "c.csv", speed=10)
    found = channels(folder, DAYS)
    assert found["a.csv"] == {
        "aging_days": 4.0,
        "specimen_id": "aging_days=4",
        "run_id": "aging_days=4, 5 mm/s",
        "repeat": 1,
        "speed_set_mm_s": 5.0,
    }
    assert (found["b.csv"]["run_id"], found["b.csv"]["repeat"]) == ("aging_days=4, 5 mm/s", 2)
    assert (found["c.csv"]["run_id"], found["c.csv"]["repeat"]) == ("aging_days=4, 10 mm/s", 1)


def test_runs_without_a_commanded_speed_are_told_apart_by_the_measured_one(tmp_path):
    folder = campaign(tmp_path, "file,aging_days\na.csv,4\nb.csv,4\nc.csv,4")
    trace(folder, "b.csv", speed=5.1)
    trace(folder, "c.csv", speed=10)
    refs, found = list_traces(folder, config(DAYS))
    runs = {ref.file: (ref.channels["run_id"], ref.channels["repeat"]) for ref in refs}
    assert runs["a.csv"] == ("aging_days=4, about 5.1 mm/s", 1)
    assert runs["b.csv"] == ("aging_days=4, about 5.1 mm/s", 2)
    assert runs["c.csv"] == ("aging_days=4, about 10 mm/s", 1)
    assert [(fault.check, fault.severity) for fault in found] == [("run_id_derived", "info")]
    assert all("speed_set_mm_s" not in ref.channels for ref in refs)


def test_named_specimens_and_opposite_speeds_are_runs_of_their_own(tmp_path):
    folder = campaign(tmp_path, "file,aging_days,specimen_id,speed_mm_s\na.csv,4,S1,5\nb.csv,4,S2,5\nc.csv,4,S1,-5")
    found = channels(folder, DAYS)
    assert len({row["run_id"] for row in found.values()}) == 3
    assert found["c.csv"]["speed_set_mm_s"] == 5.0


def test_repeats_follow_the_clock_and_fill_gaps(tmp_path):
    head = "file,run_id,aging_days,started_at,repeat\n"
    clock = head + "a.csv,r,4,2024-03-01 12:00,\nb.csv,r,4,2024-03-01T11:00Z,\nc.csv,r,4,2024-03-01T10:00,"
    found = channels(campaign(tmp_path, clock), DAYS)
    assert [found[file]["repeat"] for file in ("a.csv", "b.csv", "c.csv")] == [3, 2, 1]
    found = channels(campaign(tmp_path, head + "a.csv,r,4,,\nb.csv,r,4,,1\nc.csv,r,4,,"), DAYS)
    assert [found[file]["repeat"] for file in ("a.csv", "b.csv", "c.csv")] == [2, 1, 3]


def test_unaged_rows_are_one_condition_whatever_their_other_cells_say(tmp_path):
    table = (
        "file,temperature_C,compression_ratio_pct,aging_days,speed_mm_s\na.csv,60,80,0,5\nb.csv,,,0,5\nc.csv,40,90,0,5"
    )
    found = channels(campaign(tmp_path, table))
    assert {row["run_id"] for row in found.values()} == {"unaged, 5 mm/s"}
    assert [row["repeat"] for row in found.values()] == [1, 2, 3]
    assert {row["specimen_id"] for row in found.values()} == {"unaged"}
    assert "temperature_C" not in found["b.csv"]


def test_unaged_rubbers_are_told_apart():
    rubbers = config(DAYS + 'rubber = ["compound"]')
    assert condition_keys([{"aging_days": 0.0, "compound": "NBR"}], rubbers) == ["unaged, NBR"]


@pytest.mark.parametrize(
    ("old", "new", "check", "line", "column", "words"),
    [
        ("60,80,4,49.03,5,2024-03-01T09", "6O,80,4,49.03,5,2024-03-01T09", "not_a_number", 2, "temperature_C", "6O"),
        ("60,80,8", "60,80,", "empty_cell", 4, "aging_days", "Fill it"),
        ("60,80,8", "60,80,-8", "out_of_range", 4, "aging_days", "below 0"),
        ("8,49.03", "8,0", "out_of_range", 4, "load_N", "above 0"),
        ("8,49.03,5", "8,49.03,0", "out_of_range", 4, "speed_mm_s", "slide"),
        ("8,49.03,5", "8,inf,5", "not_a_number", 4, "load_N", "inf"),
        ("b.csv,r1,2", "b.csv,r1,1", "duplicate_repeat", 3, "repeat", "line 2"),
        ("b.csv,r1,2", "b.csv,r1,two", "not_a_number", 3, "repeat", "two"),
        ("b.csv,r1,2", "b.csv,r1,1.5", "not_a_number", 3, "repeat", "1, 2, 3"),
        ("b.csv,r1,2", "a.csv,r1,2", "duplicate_file", 3, "file", "line 2"),
        ("b.csv,r1,2", "./x/../a.csv,r1,2", "duplicate_file", 3, "file", "line 2"),
        ("b.csv,r1,2", ",r1,2", "empty_cell", 3, "file", "no trace file"),
        ("4,49.03,5,2024-03-01T10", "4,49.03,6,2024-03-01T10", "run_disagrees", 3, "speed_mm_s", "line 2"),
        ("4,49.03,5,2024-03-01T10", "4,30,5,2024-03-01T10", "run_disagrees", 3, "load_N", "line 2"),
        ("4,49.03,5,2024-03-01T10", "4,,5,2024-03-01T10", "run_disagrees", 3, "load_N", "line 2"),
        ("4,49.03,5,2024-03-01T10", "8,49.03,5,2024-03-01T10", "run_disagrees", 3, "condition", "line 2"),
        ("2024-03-01T10:30:00", "1.3.2024 10:30", "not_a_time", 3, "started_at", "2024-03-01T09:30:00"),
        ("b.csv,r1,2", "../b.csv,r1,2", "path_outside", 3, "file", "outside"),
        ("b.csv,r1,2", "/etc/hostname,r1,2", "path_outside", 3, "file", "outside"),
        ("b.csv,r1,2", "C:\\b.csv,r1,2", "path_outside", 3, "file", "outside"),
        ("B,42.5", "B,42.5,extra", "too_many_cells", 4, None, "13 cells where 12"),
        ("aging_days", "Aging_days", "column_name", 1, "Aging_days", "'aging_days'"),
        ("load_N", "load_n", "column_name", 1, "load_n", "'load_N'"),
        ("file,", "File,", "missing_column", 1, "file", "Did you mean 'File'"),
        ("batch", "load_N", "duplicate_column", 1, "load_N", "2 times"),
    ],
)
def test_faults_of_runs_csv_stop_the_run_with_their_place(tmp_path, old, new, check, line, column, words):
    assert FULL.count(old) == 1 or old in ("file,",)
    found = faults(campaign(tmp_path, FULL.replace(old, new)))
    (fault,) = [fault for fault in found if fault.check == check]
    assert (fault.file, fault.line, fault.column) == ("runs.csv", line, column)
    assert fault.mend
    assert words in str(fault)


def test_every_fault_is_told_at_once(tmp_path):
    table = (
        FULL.replace("8,49.03", "8,-1")
        .replace("b.csv,r1,2", "b.csv,r1,x")
        .replace("60,80,4,49.03,5,2024-03-01T09", "hot,80,4,49.03,5,never")
    )
    found = faults(campaign(tmp_path, table))
    assert len(found) == 4
    assert {(fault.line, fault.column) for fault in found} == {
        (2, "temperature_C"),
        (2, "started_at"),
        (3, "repeat"),
        (4, "load_N"),
    }


def test_a_missing_condition_column_is_one_fault_with_the_nearest_name(tmp_path):
    table = FULL.replace("temperature_C", "temprature_C")
    (fault,) = faults(campaign(tmp_path, table))
    assert (fault.check, fault.column) == ("missing_column", "temperature_C")
    assert "Did you mean 'temprature_C'?" in fault.mend


def test_missing_folder_table_traces_and_links_out(tmp_path):
    assert faults(tmp_path / "no")[0].check == "missing_folder"
    (tmp_path / "c").mkdir()
    trace(tmp_path, "c/a.csv")
    (fault,) = faults(tmp_path / "c")
    assert "the folder holds 1 CSV files" in fault.mend
    (tmp_path / "secret.csv").write_text(FULL)
    (tmp_path / "c" / "runs.csv").symlink_to(tmp_path / "secret.csv")
    assert faults(tmp_path / "c")[0].check == "path_outside"
    (tmp_path / "c" / "runs.csv").unlink()
    (tmp_path / "c" / "runs.csv").write_text(
        FULL.replace("a.csv", "x.csv").replace("b.csv", "y.csv").replace("c.csv", "z.csv")
    )
    (fault,) = faults(tmp_path / "c")
    assert "none of the 3 trace files" in fault.reason
    (tmp_path / "c" / "runs.csv").write_text("file,aging_days\n")
    assert faults(tmp_path / "c")[0].check == "no_rows"
    (tmp_path / "c" / "runs.csv").write_text("")
    assert faults(tmp_path / "c")[0].check == "empty_file"


def test_one_missing_trace_is_left_to_reading_and_unlisted_ones_are_told(tmp_path):
    folder = campaign(tmp_path, FULL, files=("a.csv", "c.csv", "forgotten.csv"))
    refs, found = list_traces(folder, config())
    assert [ref.file for ref in refs] == ["a.csv", "b.csv", "c.csv"]
    assert [(fault.check, fault.file, fault.severity) for fault in found] == [("not_listed", "forgotten.csv", "info")]


def test_misspelt_channels_and_slips_in_them_are_warned_of(tmp_path):
    table = FULL.replace("speed_mm_s", "speed_mms")
    _, found = list_traces(campaign(tmp_path, table), config())
    assert [(fault.column, fault.severity) for fault in found] == [("speed_mms", "warning")]
    rows = "\n".join(f"{i}.csv,4,{i if i else 'o'}" for i in range(8))
    (tmp_path / "d").mkdir()
    folder = campaign(tmp_path / "d", "file,aging_days,lab_C\n" + rows, files=[f"{i}.csv" for i in range(8)])
    refs, found = list_traces(folder, config(DAYS))
    assert ("lab_C", "o", 2) in [(fault.column, fault.value, fault.line) for fault in found]
    assert refs[3].channels["lab_C"] == "3"


NAMED = """
condition = ["drive"]
[files]
glob = "raw/**/*.csv"
exclude = ["**/steps/*"]
name_pattern = '^raw/no(?P<drive>\\d+)/(?P<_sign>n?)(?P<_rpm>\\d+)(?:_(?P<note>\\w+))?\\.csv$'
values._sign = {"" = 1, n = -1}
values.drive = {1 = "screw"}
compute.speed_mm_s = "_sign * _rpm"
columns = {run_id = "{drive} {_sign}x{_rpm}", repeat = "1"}
"""


def test_names_of_files_say_what_runs_csv_would(tmp_path):
    for file in ("raw/no1/n20.csv", "raw/no1/100.csv", "raw/no3/20_warm.csv", "raw/no1/steps/5.csv", "raw/no1/x.csv"):
        trace(tmp_path, file)
    refs, found = list_traces(tmp_path, config(NAMED))
    by_file = {ref.file: ref.channels for ref in refs}
    assert list(by_file) == ["raw/no1/100.csv", "raw/no1/n20.csv", "raw/no3/20_warm.csv"]
    assert by_file["raw/no1/n20.csv"] == {
        "drive": "screw",
        "run_id": "screw -1x20",
        "repeat": 1,
        "specimen_id": "drive=screw",
        "speed_set_mm_s": 20.0,
    }
    assert by_file["raw/no3/20_warm.csv"]["note"] == "warm"
    assert by_file["raw/no3/20_warm.csv"]["drive"] == "3"
    listed = {(fault.check, fault.file, fault.severity, fault.action) for fault in found}
    assert ("excluded", "raw/no1/steps/5.csv", "info", "file left out") in listed
    assert ("not_matched", "raw/no1/x.csv", "warning", "file left out") in listed


def test_runs_csv_goes_before_the_name_and_the_name_before_the_header(tmp_path):
    text = (
        DAYS
        + """
    files.name_pattern = '(?P<aging_days>\\d+)d\\.csv'
    trace.header_ends_at = "^time_s"
    trace.header_fields = {aging_days = "^days: (.*)", oven = "^oven: (.*)", _x = "^(days)"}
    """
    )
    for file in ("4d.csv", "8d.csv", "late.csv"):
        trace(tmp_path, file)
        (tmp_path / file).write_text("days: 99\noven: B2\n" + (tmp_path / file).read_text())
    (tmp_path / "runs.csv").write_text("file,aging_days,speed_mm_s\n4d.csv,2,5\n8d.csv,,5\nlate.csv,,5\n")
    found = channels(tmp_path, text)
    assert [found[file]["aging_days"] for file in ("4d.csv", "8d.csv", "late.csv")] == [2.0, 8.0, 99.0]
    assert found["4d.csv"]["oven"] == "B2"
    assert "_x" not in found["4d.csv"]


def test_conditions_may_stand_in_the_traces_as_constants(tmp_path):
    trace(tmp_path, "a.csv", aging_days=4, run_id=7)
    trace(tmp_path, "b.csv", aging_days=8, run_id=8)
    trace(tmp_path, "c.csv")
    text = (tmp_path / "b.csv").read_text()
    (tmp_path / "d.csv").write_text(text.replace("2.0,8,8", "2.0,9,8", 1))
    (tmp_path / "runs.csv").write_text("file\na.csv\nb.csv\nd.csv\ngone.csv\n")
    refs, found = list_traces(tmp_path, config(DAYS))
    by_file = {ref.file: ref.channels for ref in refs}
    assert by_file["a.csv"]["aging_days"] == 4.0
    assert by_file["a.csv"]["run_id"] == "7"
    assert set(by_file) == {"a.csv", "b.csv"}
    left_out = {(fault.file, fault.check) for fault in found if fault.action == "file left out"}
    assert left_out == {("d.csv", "condition_varies"), ("gone.csv", "missing_file"), ("c.csv", "not_listed")}


@pytest.mark.parametrize(
    ("text", "column"),
    [
        ('trace.encoding = "klingon"', "trace.encoding"),
        ('trace.delimiter = "::"', "trace.delimiter"),
        ('trace.decimal = ","', "trace.delimiter"),
        ('condition = ["speed_mm_s"]', "condition"),
        ('trace.names = "none"', "trace.columns.time_s"),
        ('files.columns.run_id = "{rig}"', "files"),
        ('quantities.speed = {quantity = "speed", unit = "knot"}', "quantities"),
    ],
)
def test_configs_that_cannot_be_meant_are_refused_before_any_file_is_opened(tmp_path, text, column):
    found = faults(tmp_path / "no folder is needed", text)
    assert column in [fault.column for fault in found]


def test_a_folder_in_which_nothing_fits_stops_the_run(tmp_path):
    trace(tmp_path, "raw/no1/x.csv")
    (*_, fault) = faults(tmp_path, NAMED)
    assert "none of 1 file names is matched" in fault.reason
    (tmp_path / "raw/no1/x.csv").rename(tmp_path / "raw/no1/5.csv")
    only_excluded = NAMED.replace("**/steps/*", "**/5.csv")
    assert [fault.check for fault in faults(tmp_path, only_excluded)] == ["excluded", "nothing_left"]
    (tmp_path / "runs.csv").write_text("file\nraw/no1/5.csv\n")
    trace(tmp_path, "raw/no1/5.csv")
    (tmp_path / "raw/no1/5.csv").write_text(HEADER)  # the condition should stand in the trace, and there is none
    assert [fault.check for fault in faults(tmp_path, DAYS)] == ["no_rows", "nothing_left"]


@pytest.mark.parametrize("glob", ["../*.csv", "/etc/*"])
def test_globs_stay_inside(tmp_path, glob):
    assert faults(tmp_path, f'files.glob = "{glob}"')[0].check == "path_outside"


@given(st.lists(st.integers(0, 10**6), unique=True, min_size=2))
def test_natural_order_is_that_of_the_numbers(numbers):
    names = sorted((f"run{number}.csv" for number in numbers), key=natural)
    assert names == [f"run{number}.csv" for number in sorted(numbers)]


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 3), st.sampled_from([5, 10]), st.booleans()), min_size=1, max_size=12))
def test_every_file_has_a_run_and_a_repeat_that_no_other_has(tmp_path_factory, rows):
    folder = tmp_path_factory.mktemp("c")
    table = ["file,aging_days,speed_mm_s,repeat"]
    given: dict[tuple, int] = {}
    for i, (days, speed, numbered) in enumerate(rows):
        trace(folder, f"{i}.csv", speed=speed)
        repeat = ""
        if numbered:
            given[days, speed] = repeat = given.get((days, speed), 0) + 2  # 2, 4, ...: gaps for the others
        table.append(f"{i}.csv,{days},{speed},{repeat}")
    (folder / "runs.csv").write_text("\n".join(table))
    refs, _ = list_traces(folder, config(DAYS))
    assert len({(ref.channels["run_id"], ref.channels["repeat"]) for ref in refs}) == len(rows)
    assert len({ref.channels["run_id"] for ref in refs}) == len({row[:2] for row in rows})


cells = st.sampled_from(
    ["a.csv", "b.csv", "../a.csv", "", "1", "2", "-1", "x", "nan", "inf", "4,5", '"', "é", "2024-01-01", "0"]
)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.lists(cells, min_size=1, max_size=6).map(",".join), max_size=6), st.binary(max_size=20))
def test_any_runs_csv_is_read_or_refused_with_a_mend(tmp_path_factory, lines, junk):
    folder = tmp_path_factory.mktemp("c")
    trace(folder, "a.csv")
    trace(folder, "b.csv")
    head = "file,aging_days,repeat,speed_mm_s,started_at"
    (folder / "runs.csv").write_bytes("\n".join([head, *lines]).encode() + junk)
    try:
        refs, _ = list_traces(folder, config(DAYS))
    except CampaignError as error:
        assert all(fault.reason and fault.mend for fault in error.faults)  # noqa: PT017
        return
    assert len(refs) > 0
    assert all({"run_id", "repeat", "specimen_id", "aging_days"} <= set(ref.channels) for ref in refs)
    assert len({(ref.channels["run_id"], ref.channels["repeat"]) for ref in refs}) == len(refs)
