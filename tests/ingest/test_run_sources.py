import pytest
from hypothesis import given
from hypothesis import strategies as st
from trace_helpers import DAYS, HEADER, channels, config, faults, trace

from sealfit.errors import ConfigError
from sealfit.ingest.listing import natural
from sealfit.ingest.runs import list_traces

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
    for file in (
        "raw/no1/n20.csv",
        "raw/no1/100.csv",
        "raw/no3/20_warm.csv",
        "raw/no1/steps/5.csv",
        "raw/no1/x.csv",
    ):
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


def test_the_pattern_must_match_the_whole_path(tmp_path):
    text = DAYS + "files.glob = '**/*.csv'\nfiles.name_pattern = '(?P<aging_days>\\d+)d\\.csv'"
    for file in ("4d.csv", "old/8d.csv", "8d.csv.csv"):
        trace(tmp_path, file)
    refs, found = list_traces(tmp_path, config(text))
    assert [ref.file for ref in refs] == ["4d.csv"]
    assert {fault.file for fault in found if fault.check == "not_matched"} == {"old/8d.csv", "8d.csv.csv"}


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
    ("text", "said"),
    [
        ('trace.encoding = "klingon"', "'trace.encoding': 'klingon' is not an encoding"),
        ('trace.delimiter = "::"', "'trace.delimiter': '::' is not a delimiter"),
        ('condition = ["speed_mm_s"]', "'condition': 'speed_mm_s' cannot be a condition column"),
        ('trace.names = "none"', "columns.time_s: 'time_s' is a name, but the files have none"),
        ('files.columns.run_id = "{rig}"', "reads a part 'rig' that the name has not"),
        ('quantities.speed = {quantity = "speed", unit = "step/s"}', "gives no speed in 'step/s'"),
    ],
)
def test_configs_that_cannot_be_meant_are_refused_before_any_file_is_opened(text, said):
    with pytest.raises(ConfigError, match=said):
        config(text)


def test_a_folder_in_which_nothing_fits_stops_the_run(tmp_path):
    trace(tmp_path, "raw/no1/x.csv")
    (*_, fault) = faults(tmp_path, NAMED)
    assert "none of 1 files is matched" in fault.reason
    (tmp_path / "raw/no1/x.csv").rename(tmp_path / "raw/no1/5.csv")
    only_excluded = NAMED.replace("**/steps/*", "**/5.csv")
    assert [fault.check for fault in faults(tmp_path, only_excluded)] == ["excluded", "nothing_left"]
    (tmp_path / "runs.csv").write_text("file\nraw/no1/5.csv\n")
    trace(tmp_path, "raw/no1/5.csv")
    (tmp_path / "raw/no1/5.csv").write_text(
        HEADER
    )  # the condition should stand in the trace, and there is none
    assert [fault.check for fault in faults(tmp_path, DAYS)] == ["no_rows", "nothing_left"]


def test_an_empty_cell_of_a_condition_is_told_where_keep_reads_the_table(tmp_path):
    for file in "ab":
        trace(tmp_path, f"{file}.csv")
    (tmp_path / "runs.csv").write_text("file,run_id,aging_days,status\na.csv,a,4,ok\nb.csv,b,,ok\n")
    (fault,) = faults(tmp_path, DAYS + "trace.keep = \"status == 'ok'\"")
    assert (fault.check, fault.column, fault.line) == ("empty_cell", "aging_days", 3)


@pytest.mark.parametrize("glob", ["../*.csv", "/etc/*"])
def test_globs_stay_inside(glob):
    with pytest.raises(ConfigError, match=r"files\.glob.*leads outside"):
        config(f'files.glob = "{glob}"')


@given(st.lists(st.integers(0, 10**6), unique=True, min_size=2))
def test_natural_order_is_that_of_the_numbers(numbers):
    names = sorted((f"run{number}.csv" for number in numbers), key=natural)
    assert names == [f"run{number}.csv" for number in sorted(numbers)]


RIG = r"""condition = ["temperature_C", "aging_days"]
[files]
glob = "**/*.csv"
name_pattern = 'T(?P<temperature_C>\d+)_C(?P<c>\d+)_d(?P<aging_days>\d+)_v(?P<speed_mm_s>\d+)[.]csv'
"""


@pytest.mark.parametrize(
    ("files", "nearest", "said"),
    [
        (
            ["T80_C20_day4_v5.csv", "notes.csv"],
            "T80_C20_day4_v5.csv",
            "'T80_C20_d', then the path has 'ay4_v5.csv'",
        ),
        (
            ["T80_C20_d4_v5_r2.csv"],
            "T80_C20_d4_v5_r2.csv",
            "'T80_C20_d4_v5', then the path has '_r2.csv'",
        ),
        (["notes.csv"], "notes.csv", "from its start the path has 'notes.csv'"),
    ],
)
def test_a_pattern_that_matches_no_file_says_where_it_broke_on_the_nearest(tmp_path, files, nearest, said):
    for file in files:
        trace(tmp_path, file)
    (fault,) = faults(tmp_path, RIG)
    assert (fault.check, fault.file) == ("not_matched", nearest)
    assert "the whole path below the campaign folder does not match files.name_pattern" in fault.reason
    assert said in fault.reason


def test_a_pattern_for_names_without_folders_says_how_to_begin_it(tmp_path):
    trace(tmp_path, "week 1/T80_C20_d4_v5.csv")
    (fault,) = faults(tmp_path, RIG)
    assert fault.fix == "The pattern matches the name without its folders: begin it with '(?:.*/)?'."
    assert len(channels(tmp_path, RIG.replace("'T(", "'(?:.*/)?T("))) == 1


def test_a_glob_that_matches_nothing_shows_the_nearest_file(tmp_path):
    trace(tmp_path, "raw/a.txt")
    (fault,) = faults(tmp_path, RIG)
    assert fault.fix == "The nearest file is 'raw/a.txt'."
