import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trace_helpers import DAYS, campaign, channels, config, faults, trace

from sealfit.errors import CampaignError
from sealfit.ingest.columns import keys_of
from sealfit.ingest.runs import list_traces
from sealfit.store.paths import campaign_folder

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
        "specimen_use": 1.0,
        "batch": "A",
        "humidity_pct": 40.0,
    }
    assert refs[1].channels["elapsed_h"] == 2.5
    assert refs[2].channels["run_order"] == 1.0
    assert "humidity_pct" not in refs[1].channels


def test_the_files_of_each_named_specimen_are_counted(tmp_path):
    refs, _ = list_traces(campaign(tmp_path, FULL), config())
    assert [ref.channels["specimen_use"] for ref in refs] == [1.0, 2.0, 1.0]
    one_specimen = FULL.replace("S2", "S1")  # it would be a copy of run_order
    refs, _ = list_traces(campaign(tmp_path / "one", one_specimen), config())
    assert "specimen_use" not in refs[0].channels


def test_of_two_specimens_of_one_run_it_is_said_that_each_needs_its_own(tmp_path):
    (fault,) = faults(campaign(tmp_path, FULL.replace("b.csv,r1,2,S1", "b.csv,r1,1,S3")))
    assert fault.check == "duplicate_repeat"
    assert fault.fix.startswith("Give each specimen a run_id of its own.")


@pytest.mark.parametrize("change", [("a.csv", '"a.csv"'), ("B,42.5", "B,42.5,"), ("b.csv", " b.csv")])
def test_a_table_that_must_be_read_line_by_line_says_what_a_plain_one_does(tmp_path, change):
    (tmp_path / "d").mkdir()
    plain, _ = list_traces(campaign(tmp_path, FULL), config())
    table = FULL.replace(*change)
    refs, found = list_traces(campaign(tmp_path / "d", table), config())
    assert (list(refs), found) == (list(plain), [])


def test_blank_lines_count(tmp_path):
    found = faults(campaign(tmp_path, FULL.replace("b.csv,r1,2", "  \n,,;\nb.csv,r1,two")))
    assert [(fault.line, fault.value) for fault in found] == [(5, "two")]


def test_semicolons_decimal_commas_and_other_names_of_columns(tmp_path):
    table = FULL.strip().replace(".csv", "·csv").replace("49.03", "49,03").replace("42.5", "42,5")
    lines = [
        line.replace(",", ";").replace("49;03", "49,03").replace("42;5", "42,5")
        for line in table.splitlines()
    ]
    folder = campaign(tmp_path, "\n".join(lines).replace("·csv", ".csv").replace("load_N", "Last"))
    found = channels(folder, '[files.runs_columns]\nload_N = "Last"')
    assert found["a.csv"]["load_N"] == 49.03
    assert found["c.csv"]["humidity_pct"] == 42.5


@pytest.mark.parametrize(("name", "warned"), [("Gewicht [kg]", True), ("Last (N)", False), ("Last", False)])
def test_a_unit_in_the_header_of_the_table_that_the_config_does_not_name_is_warned_of(tmp_path, name, warned):
    folder = campaign(tmp_path, FULL.strip().replace("load_N", name))
    found = warnings_of_units(folder, f'"{name}"')
    assert [fault.column for fault in found] == [name] * warned
    if warned:
        assert "load_N = {name = 'Gewicht [kg]', unit = \"kgf\"} under [files.runs_columns]" in found[0].fix
        assert warnings_of_units(folder, f'{{name = "{name}", unit = "kgf"}}') == []


def warnings_of_units(folder, load):
    made = config(f"[files.runs_columns]\nload_N = {load}")
    return [fault for fault in list_traces(folder, made)[1] if fault.check == "unit"]


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


@pytest.mark.parametrize(
    ("strokes", "runs"),
    [((1, 2, 3), 1), ((1, 3, 2), 2), ((1, 1, 2), 2), (("", 2, 3), 2)],
    ids=["there and back", "both speeds one way", "a stroke twice", "a stroke without a number"],
)
def test_strokes_there_and_back_of_one_record_share_a_run_though_the_rig_is_faster_one_way(
    tmp_path, strokes, runs
):
    cells = "\n".join(f"{file}.csv,4,{stroke}" for file, stroke in zip("abc", strokes, strict=True))
    folder = campaign(tmp_path, f"file,aging_days,stroke\n{cells}")
    trace(folder, "b.csv", speed=5.5)
    given = channels(folder, DAYS).values()
    assert len({own["run_id"] for own in given}) == runs
    if runs == 1:
        assert {own["repeat"] for own in given} == {1}


def test_named_specimens_and_opposite_speeds_are_runs_of_their_own(tmp_path):
    folder = campaign(
        tmp_path, "file,aging_days,specimen_id,speed_mm_s\na.csv,4,S1,5\nb.csv,4,S2,5\nc.csv,4,S1,-5"
    )
    found = channels(folder, DAYS)
    assert len({row["run_id"] for row in found.values()}) == 3
    assert found["c.csv"]["speed_set_mm_s"] == 5.0


def test_settings_that_differ_by_rounding_are_one(tmp_path):
    table = FULL.replace("4,49.03,5,2024-03-01T10", "4,49.030001,5.0000004,2024-03-01T10").replace(
        "8,49.03,5,", "8,49.05,-5.001,"
    )
    refs, found = list_traces(campaign(tmp_path, table), config())
    assert found == []
    assert [ref.channels["load_N"] for ref in refs] == [49.03] * 3
    assert [ref.channels["speed_set_mm_s"] for ref in refs][:2] == [5.0, 5.0]
    refs, _ = list_traces(campaign(tmp_path, FULL.replace("8,49.03,5,", "8,49.5,5.05,")), config())
    assert refs[2].channels["load_N"] == 49.5
    assert refs[2].channels["speed_set_mm_s"] == 5.05


@pytest.mark.parametrize("named", [True, False])
def test_a_load_that_was_measured_for_every_file_is_kept_and_makes_no_runs(tmp_path, named):
    table = "file,run_id,repeat,temperature_C,compression_ratio_pct,aging_days,load_N,speed_mm_s\n"
    run = "r1" if named else ""
    other = "r2" if named else ""
    table += f"a.csv,{run},1,60,80,4,49.0,5\nb.csv,{run},2,60,80,4,50.6,5\nc.csv,{other},1,60,80,4,98,5\n"
    refs, found = list_traces(campaign(tmp_path, table), config())
    assert found == []
    assert [ref.channels["load_N"] for ref in refs] == [49.0, 50.6, 98.0]
    first, second, third = (ref.channels["run_id"] for ref in refs)
    assert first == second != third


def test_without_run_id_settings_that_differ_by_rounding_are_one_run(tmp_path):
    table = (
        "file,temperature_C,compression_ratio_pct,aging_days,speed_mm_s\n"
        "a.csv,60,80,4,5\nb.csv,60,80,4,5.00001\n"
    )
    refs, _ = list_traces(campaign(tmp_path, table), config())
    assert len({ref.channels["run_id"] for ref in refs}) == 1
    assert sorted(ref.channels["repeat"] for ref in refs) == [1, 2]


def test_repeats_follow_the_clock_and_fill_gaps(tmp_path):
    head = "file,run_id,aging_days,started_at,repeat\n"
    clock = head + "a.csv,r,4,2024-03-01 12:00,\nb.csv,r,4,2024-03-01T11:00Z,\nc.csv,r,4,2024-03-01T10:00,"
    found = channels(campaign(tmp_path, clock), DAYS)
    assert [found[file]["repeat"] for file in ("a.csv", "b.csv", "c.csv")] == [3, 2, 1]
    found = channels(campaign(tmp_path, head + "a.csv,r,4,,\nb.csv,r,4,,1\nc.csv,r,4,,"), DAYS)
    assert [found[file]["repeat"] for file in ("a.csv", "b.csv", "c.csv")] == [2, 1, 3]


def test_unaged_rows_are_one_condition_whatever_their_other_cells_say(tmp_path):
    table = (
        "file,temperature_C,compression_ratio_pct,aging_days,speed_mm_s\n"
        "a.csv,60,80,0,5\nb.csv,,,0,5\nc.csv,40,90,0,5"
    )
    found = channels(campaign(tmp_path, table))
    assert {row["run_id"] for row in found.values()} == {"unaged, 5 mm/s"}
    assert [row["repeat"] for row in found.values()] == [1, 2, 3]
    assert {row["specimen_id"] for row in found.values()} == {"unaged"}
    assert "temperature_C" not in found["b.csv"]


def test_unaged_rubbers_are_told_apart():
    rubbers = config(DAYS + 'rubber = ["compound"]')
    columns = {"aging_days": [0.0], "compound": ["NBR"]}
    assert keys_of(columns, 1, rubbers)["condition"] == ["unaged, NBR"]


@pytest.mark.parametrize(
    ("old", "new", "check", "line", "column", "words"),
    [
        (
            "60,80,4,49.03,5,2024-03-01T09",
            "6O,80,4,49.03,5,2024-03-01T09",
            "not_a_number",
            2,
            "temperature_C",
            "6O",
        ),
        ("60,80,8", "60,80,", "empty_cell", 4, "aging_days", "Fill it"),
        ("60,80,8", "60,80,-8", "out_of_range", 4, "aging_days", "below 0"),
        ("8,49.03", "8,0", "out_of_range", 4, "load_N", "above 0"),
        ("8,49.03,5", "8,49.03,0", "out_of_range", 4, "speed_mm_s", "sliding speed"),
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
        (
            "2024-03-01T10:30:00",
            "1.3.2024 10:30",
            "not_a_time",
            3,
            "started_at",
            "date_format = '%d.%m.%Y %H:%M'",
        ),
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
    assert fault.fix
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


def test_files_that_cannot_be_opened_are_told_with_the_faults_of_the_table(tmp_path):
    folder = campaign(tmp_path, FULL.replace("8,49.03", "8,-1"), files=("a.csv", "c.csv"))
    (folder / "a.csv").write_text("")
    found = [(fault.file, fault.check) for fault in faults(folder)]
    assert found == [("runs.csv", "out_of_range"), ("a.csv", "empty_file"), ("b.csv", "missing_file")]


def test_a_missing_condition_column_is_one_fault_with_the_nearest_name(tmp_path):
    table = FULL.replace("temperature_C", "temprature_C")
    (fault,) = faults(campaign(tmp_path, f"Rig 2\n{table.strip()}"))
    assert (fault.check, fault.column, fault.line) == ("missing_column", "temperature_C", None)
    assert "Did you mean 'temprature_C'?" in fault.fix


def test_a_condition_column_in_another_unit_is_named_with_that_unit(tmp_path):
    folder = campaign(tmp_path, FULL.replace("aging_days", "aging_h").replace("80,4,", "80,96,"))
    (fault,) = faults(folder)
    line = 'aging_days = {name = "aging_h", unit = "h"}'
    assert f"'aging_h'? Set {line} under [files.runs_columns] in the rig config." in fault.fix
    assert channels(folder, f"[files.runs_columns]\n{line}")["a.csv"]["aging_days"] == 4.0


def test_one_trace_file_whose_name_is_longer_than_a_file_system_takes_is_missing(tmp_path):
    table = FULL.replace("a.csv", 5000 * "a").replace("b.csv", "y.csv").replace("c.csv", "z.csv")
    (fault,) = faults(campaign(tmp_path, table))
    assert "none of the 3 trace files" in fault.reason


def test_missing_folder_table_traces_and_links_out(tmp_path):
    with pytest.raises(CampaignError, match="there is no such folder"):
        campaign_folder(tmp_path / "no", config())
    (tmp_path / "c").mkdir()
    trace(tmp_path, "c/a.csv")
    with pytest.raises(CampaignError, match=r"has no runs\.csv.* Files here: a\.csv\."):
        campaign_folder(tmp_path / "c", config())
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
    assert [(fault.check, fault.file, fault.severity) for fault in found] == [
        ("not_listed", "forgotten.csv", "info")
    ]


def test_a_glob_beside_runs_csv_that_matches_nothing_is_warned_of(tmp_path):
    folder = campaign(tmp_path, FULL)
    assert list_traces(folder, config("files.glob = '*.csv'"))[1] == []
    (fault,) = list_traces(folder, config("files.glob = '*.txt'"))[1]
    assert (fault.severity, fault.reason) == ("warning", "no file matches files.glob = '*.txt'.")


@pytest.mark.parametrize(
    ("unaged", "aged", "checks"),
    [
        ("100,23", "80,60", ["swapped_columns"]),
        ("23,100", "60,80", []),
        ("100,25", "100,25", []),  # as planned, and not read
        ("100,", "60,80", []),
    ],
)
def test_swapped_temperature_and_compression_are_warned_of_by_unaged_rubber(tmp_path, unaged, aged, checks):
    table = FULL.replace("60,80,8", f"{unaged},0").replace("60,80,4", f"{aged},4")
    _, found = list_traces(campaign(tmp_path, table), config())
    assert [fault.check for fault in found if fault.severity == "warning"] == checks


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


def test_the_temperature_of_the_lab_is_not_taken_for_a_misspelt_one(tmp_path):
    table = "file,aging_days,lab_temperature_C\na.csv,4,21\nb.csv,4,22"
    _, found = list_traces(campaign(tmp_path, table), config(DAYS))
    assert [fault for fault in found if fault.column == "lab_temperature_C"] == []


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.tuples(st.integers(1, 3), st.sampled_from([5, 10]), st.booleans()), min_size=1, max_size=12)
)
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
def test_any_runs_csv_is_read_or_refused_with_a_fix(tmp_path_factory, lines, junk):
    folder = tmp_path_factory.mktemp("c")
    trace(folder, "a.csv")
    trace(folder, "b.csv")
    head = "file,aging_days,repeat,speed_mm_s,started_at"
    (folder / "runs.csv").write_bytes("\n".join([head, *lines]).encode() + junk)
    try:
        refs, _ = list_traces(folder, config(DAYS))
    except CampaignError as error:
        assert all(fault.reason and fault.fix for fault in error.faults)  # noqa: PT017
        return
    assert len(refs) > 0
    assert all({"run_id", "repeat", "specimen_id", "aging_days"} <= set(ref.channels) for ref in refs)
    assert len({(ref.channels["run_id"], ref.channels["repeat"]) for ref in refs}) == len(refs)


def test_a_log_may_name_files_without_folders_and_suffix(tmp_path):
    folder = campaign(tmp_path, "file,aging_days,load_N,speed_mm_s\nt1,4,49,5\nraw/t2,4,49,6\n")
    (folder / "raw").mkdir()
    for name in ("t1", "t2"):
        (folder / "raw" / f"{name}.tdms").touch()
    (folder / "raw" / "t1.tdms_index").touch()
    listing, notes = list_traces(folder, config(DAYS))
    assert listing.files == ["raw/t1.tdms", "raw/t2.tdms"]
    assert [(n.line, n.value, n.severity) for n in notes] == [(2, "t1", "info"), (3, "raw/t2", "info")]
    (folder / "t1.csv").touch()  # now it is not the only one
    assert "t1" in list_traces(folder, config(DAYS))[0].files


def test_unaged_rubber_of_several_series_needs_a_name_for_each_piece(tmp_path):
    table = "file,temperature_C,compression_ratio_pct,aging_days,speed_mm_s,load_N,repeat\n"
    (fault,) = faults(campaign(tmp_path, table + "a.csv,60,80,0,5,49,1\nb.csv,80,80,0,5,49,1\n"))
    assert "unaged rubber" in fault.fix
    assert "specimen_id" in fault.fix
