import pytest
from trace_helpers import DAYS, campaign, channels, config, faults, trace

from sealfit.errors import ConfigError
from sealfit.ingest.runs import list_traces

LOG = "file,run_id,aging_days,mass_kg,hanger,lap\na.csv,r1,4,5,A,1\nb.csv,r2,4,5,B,2\nc.csv,r3,4,,B,3"


def column(folder, name, rig):
    return [ref.get(name) for ref in channels(folder, DAYS + rig).values()]


def test_columns_of_runs_csv_are_computed_and_one_without_a_value_has_none(tmp_path):
    rig = """[runs]
compute = {load_N = "g * mass_kg + 2 * (hanger == 'B')", repeat = "lap + 1", specimen_id = "10 * _spare"}
constants = {g = 9.80665, _spare = 7, room = "cellar"}
"""
    folder = campaign(tmp_path, LOG)
    loads = column(folder, "load_N", rig)
    assert loads == [pytest.approx(49.03325), pytest.approx(51.03325), None]
    assert column(folder, "repeat", rig) == [2, 3, 4]
    assert column(folder, "specimen_id", rig) == ["70"] * 3
    assert column(folder, "room", rig) == ["cellar"] * 3
    assert column(folder, "_spare", rig) == [None] * 3


def test_a_constant_stands_where_the_log_has_no_value(tmp_path):
    rig = "[runs]\nconstants = {load_N = 49.03, mass_kg = 6}\n"
    folder = campaign(tmp_path, LOG)
    assert column(folder, "load_N", rig) == [49.03] * 3
    assert column(folder, "mass_kg", rig) == [5.0, 5.0, 6.0]


def test_days_are_computed_from_two_dates(tmp_path):
    log = "file,run_id,tested_on,put_in_on\na.csv,r1,2025-04-17,2025-04-10\nb.csv,r2,2025-05-08,10.04.2025"
    rig = "[runs]\ncompute = {aging_days = 'days(tested_on) - days(put_in_on)'}\n"
    assert column(campaign(tmp_path, log), "aging_days", rig) == [7.0, 28.0]
    (fault,) = faults(tmp_path, DAYS + rig.replace("days(put_in_on)", "put_in_on"))
    assert "days(put_in_on)" in fault.fix


def test_a_misspelt_name_of_the_config_is_said(tmp_path):
    text = DAYS + "[runs]\nconstants = {loads_N = 49.03}\n"
    _, (fault,) = list_traces(campaign(tmp_path, LOG), config(text))
    assert fault.column == "loads_N"
    assert fault.fix == "Write 'load_N' if that is meant."


def test_a_computed_value_that_is_no_number_is_a_fault_of_its_row(tmp_path):
    folder = campaign(tmp_path, LOG.replace("b.csv,r2,4,5", "b.csv,r2,4,0"))
    (fault,) = faults(folder, DAYS + "[runs]\ncompute = {load_N = '5 / mass_kg'}\n")
    assert (fault.file, fault.line, fault.column) == ("runs.csv", 3, "load_N")
    assert '"5 / mass_kg"' in fault.reason


@pytest.mark.parametrize(
    ("text", "said"),
    [("mass * 2", "there is no column 'mass'"), ("hanger * 2", "'hanger' is text, not a number")],
)
def test_an_expression_that_cannot_be_meant_stops_the_run(tmp_path, text, said):
    (fault,) = faults(campaign(tmp_path, LOG), DAYS + f"[runs]\ncompute = {{load_N = '{text}'}}\n")
    assert (fault.file, fault.column) == ("config 'default'", "runs.compute.load_N")
    assert said in fault.reason
    assert fault.fix


def test_parts_for_expressions_only_are_read_by_those_of_runs_too_and_absent_ones_say_nothing(tmp_path):
    for file in ("c25_V1.csv", "new_V2.csv"):
        trace(tmp_path, file)
    pattern = "(?:c(?P<_c>\\d+)|new)_(?P<specimen_id>V(?P<_piece>\\d))[.]csv"
    rig = DAYS + f"files.glob = '*.csv'\nfiles.name_pattern = '{pattern}'\n"
    for table in ("files", "runs"):
        computed = f"{table}.compute.compression_ratio_pct = '100 - _c'\n"
        computed += "runs.compute.aging_days = '7 * (_piece == 1)'\n"
        found = channels(tmp_path, computed + rig)
        assert [ref["aging_days"] for ref in found.values()] == [7, 0]
        assert [ref.get("compression_ratio_pct") for ref in found.values()] == [75, None]
        assert not any(name.startswith("_") for ref in found.values() for name in ref)
    (fault,) = faults(tmp_path, "runs.compute.aging_days = '7 * specimen_id'\n" + rig)
    assert fault.fix.startswith("Compare it: specimen_id == 'B'. ")
    assert "specimen_id and started_at stay text" in fault.fix


@pytest.mark.parametrize("text", ["where(_d > 0, _d, 0)", "2 * _d"])
def test_an_absent_part_is_no_number_and_the_message_says_how_to_make_it_one(tmp_path, text):
    for file in ("a0.csv", "a1.csv"):
        trace(tmp_path, file)
    rig = DAYS + f"files.glob = '*.csv'\nfiles.compute.aging_days = '{text}'\n"
    rig += "files.name_pattern = 'a(?P<_n>\\d)(_(?P<_d>\\d+)d)?[.]csv'\n"
    (fault,) = faults(tmp_path, rig)
    assert fault.reason == "files.compute.aging_days gives no value in any file, such as a0.csv."
    assert fault.fix.endswith('under [files.values]: _d = {"" = 0}.')
    found = channels(tmp_path, rig + 'files.values = {_d = {"" = 0}}\n')
    assert [ref["aging_days"] for ref in found.values()] == [0, 0]


def test_a_mistyped_column_of_an_expression_is_answered_with_the_nearest(tmp_path):
    (fault,) = faults(campaign(tmp_path, LOG), DAYS + "[runs]\ncompute = {load_N = '2 * mas_kg'}\n")
    assert fault.fix.startswith("Did you mean 'mass_kg'? Known: ")
    assert "hanger" in fault.fix


def test_a_word_among_numbers_that_an_expression_reads_is_named_with_its_cell(tmp_path):
    log = "file,run_id,aging_days,mass_kg\na.csv,r1,4,5\nb.csv,r2,4,five\nc.csv,r3,4,5"
    (fault,) = faults(campaign(tmp_path, log), DAYS + "[runs]\ncompute = {load_N = '2 * mass_kg'}\n")
    assert (fault.file, fault.line, fault.column, fault.value) == ("runs.csv", 3, "mass_kg", "five")
    assert "runs.compute.load_N reads it" in fault.reason


def test_an_expression_that_is_none_is_refused_with_its_key(tmp_path):
    with pytest.raises(ConfigError, match=r"runs\.compute\.load_N"):
        channels(tmp_path, "[runs]\ncompute = {load_N = '__import__(1)'}\n")


TABLE = "file,temperature_C,compression_ratio_pct,aging_days"


@pytest.mark.parametrize(
    "row",
    [
        "RT,none,unaged",
        "virgin,virgin,Virgin",
        "60,80,fresh",
        "room,free,0",
        "unaged,80,",
        "RT,RT,New",
        ",,0",
        "23,fresh,rt",
    ],
)
def test_unaged_rubber_in_words_is_day_0(tmp_path, row):
    folder = campaign(tmp_path, f"{TABLE}\na.csv,{row}\nb.csv,60,80,4\nc.csv,60,80,8")
    found = channels(folder)
    assert [ref["aging_days"] for ref in found.values()] == [0.0, 4.0, 8.0]
    assert not any(isinstance(found["a.csv"].get(name), str) for name in TABLE.split(",")[1:])


def test_days_alone_may_say_unaged(tmp_path):
    folder = campaign(tmp_path, "file,aging_days\na.csv,unaged\nb.csv,4\nc.csv,8")
    assert [ref["aging_days"] for ref in channels(folder, DAYS).values()] == [0.0, 4.0, 8.0]


def test_aged_rubber_needs_its_temperature_and_a_medium_may_be_fresh(tmp_path):
    folder = campaign(tmp_path, f"{TABLE}\na.csv,RT,80,4\nb.csv,60,80,4\nc.csv,60,80,8")
    (fault,) = faults(folder)
    assert (fault.line, fault.column, fault.value) == (2, "temperature_C", "RT")
    folder = campaign(tmp_path, "file,oil,aging_days\na.csv,fresh,4\nb.csv,used,4\nc.csv,used,0")
    found = channels(folder, 'condition = ["oil", "aging_days"]\n')
    assert [(ref["oil"], ref["aging_days"]) for ref in found.values()] == [
        ("fresh", 4.0),
        ("used", 4.0),
        ("used", 0.0),
    ]


def test_a_computed_name_keeps_its_digits(tmp_path):
    rig = "[runs]\nconstants = {load_N = 49.03}\ncompute = {run_id = '1000000 * aging_days + lap'}\n"
    assert column(campaign(tmp_path, LOG), "run_id", rig) == ["4000001", "4000002", "4000003"]
