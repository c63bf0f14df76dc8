"""Files and configs that no rig should write: each is answered by one fault that says what to do."""

import os
import time
from dataclasses import replace

import pytest
from trace_helpers import HEADER, ROWS, campaign, channels, config, csv_of, read, refused, trace

from sealfit.errors import BadFile, CampaignError, ConfigError, Fault, grouped, told
from sealfit.ingest.campaign import ingest_campaign
from sealfit.ingest.reader import read_trace
from sealfit.ingest.runs import list_traces
from sealfit.ingest.stored_parts import part_key
from sealfit.store.manifest import ConfigCopy

RUNS = """
file,aging_days,speed_mm_s
a.csv,0,5
b.csv,1,5
c.csv,2,5
"""


@pytest.mark.parametrize(
    ("content", "reason", "fix"),
    [
        (b"\xff\xfea", "is not utf-16: byte 2 cannot be read", "Export it again."),
        (b"\xff" * 5000, "holds no table of numbers", "Export it again."),
        (b"\xff\xfe", "is empty", "Export it again"),
        (b"<!DOCTYPE html><p>no</p>", "is a web page, not a table", "as CSV"),
        (b'{"time_s": [0, 1]}', "is a JSON file, not a table", "as CSV"),
        (f"Rig 7, oil 3\n{csv_of(ROWS)}", "names of the columns", "in line 2: set header_lines = 2 under"),
        (csv_of(ROWS).replace("time_s", "'time_s'"), "no such column", "Did you mean \"'time_s'\"?"),
    ],
)
def test_what_is_not_a_table_is_called_what_it_is(tmp_path, content, reason, fix):
    fault = refused(tmp_path, content)
    assert reason in fault.reason
    assert fix in fault.fix


@pytest.mark.parametrize(
    ("header", "fix"),
    [
        ("header_lines = 5", "line 1: set header_lines = 1 under"),
        ("header_lines = 5\nunits_row = true", "line 1: set header_lines = 2 under"),
        ("header_ends_at = '^0.3'", "line 1: set header_lines = 1 in place of header_ends_at under"),
    ],
)
def test_a_header_that_is_said_to_be_too_long_is_one_fault(tmp_path, header, fix):
    with pytest.raises(BadFile) as caught:
        read(tmp_path, csv_of(ROWS), f"[trace]\n{header}\n")
    (fault,) = caught.value.faults
    assert fix in fault.fix


def test_columns_by_their_positions_have_no_names_to_look_for(tmp_path):
    text = '[trace]\nnames = "none"\n[trace.columns]\ntime_s = 1\ndisplacement_mm = 2\nforce_N = 5\n'
    fault = refused(tmp_path, "\n".join(ROWS), text)
    assert fault.reason == "there is no column 5: the lines have 3."
    assert fault.fix == "Check delimiter and positions in the rig config."


def test_utf_16_without_its_mark_is_refused(tmp_path):
    fault = refused(tmp_path, csv_of(ROWS).encode("utf-16-le"), '[trace]\nencoding = "utf-16"\n')
    assert (fault.check, fault.fix) == ("wrong_encoding", 'Set encoding = "auto".')
    assert fault.reason == "is not utf-16: there is no byte-order mark."


def test_a_cell_of_thousands_of_separators_is_read_in_no_time(tmp_path):
    began = time.monotonic()
    read(tmp_path, csv_of([*ROWS, '"1' + ",," * 20_000 + '"']))
    assert time.monotonic() - began < 10  # with a pattern of cubic time it took minutes


def test_a_remark_beside_a_number_is_quoted(tmp_path):
    found = read(tmp_path, csv_of([*ROWS, '10.0,50.0,"2.5, seal slipped"']))
    assert [(fault.check, fault.value) for fault in found.faults] == [("not_a_number", "2.5, seal slipped")]


def test_long_cells_and_control_characters_are_shortened_and_escaped_in_messages():
    fault = Fault("odd", "\x1b[2J is odd.", file=os.fsdecode(b"caf\xe9.csv"), value="x" * 1_000_000)
    said = str(fault)
    assert len(said) < 200
    assert len(fault.as_dict()["value"]) < 500
    assert said.startswith("caf\\xe9.csv: 'xxx")
    assert "\\x1b[2J" in said


def test_a_pipe_is_no_trace_and_is_not_waited_for(tmp_path):
    campaign(tmp_path, RUNS)
    (tmp_path / "a.csv").unlink()
    os.mkfifo(tmp_path / "a.csv")
    faults = ingest_campaign(tmp_path, config('condition = ["aging_days"]')).faults
    assert [(fault.file, fault.reason) for fault in faults] == [("a.csv", "is not a file.")]


def test_a_link_to_nowhere_says_so(tmp_path):
    campaign(tmp_path, RUNS)
    (tmp_path / "a.csv").unlink()
    (tmp_path / "a.csv").symlink_to("gone.csv")
    (fault,) = ingest_campaign(tmp_path, config('condition = ["aging_days"]')).faults
    assert fault.reason == "is a link to 'gone.csv', which does not exist."


@pytest.mark.parametrize(
    "header", ["time_s,displacement_mm,,force_N", "time_s,displacement_mm,force_N,oil,gas"]
)
def test_a_header_with_more_names_than_cells_is_refused(tmp_path, header):
    rows = [f"{row},45.1" for row in ROWS] if "oil" in header else ROWS
    fault = refused(tmp_path, csv_of(rows, header))
    names, cells = header.count(",") + 1, rows[0].count(",") + 1
    assert fault.line == 2
    assert fault.reason == f"the header names {names} columns, and the first line of data has {cells} cells."


@pytest.mark.parametrize("last", ["", "Comment"])
def test_a_last_name_that_never_has_cells_is_no_column(tmp_path, last):
    assert read(tmp_path, csv_of(ROWS, f"{HEADER},{last}")).rows_read == 100


def test_labels_have_no_blanks_around_them_whichever_reader_saw_them(tmp_path):
    header, rows = f"{HEADER}, oil", [f"{row}, mineral " for row in ROWS]
    fast = read(tmp_path, csv_of(rows, header))
    patient = read(tmp_path, csv_of([*rows, "10.0,slipped,2, mineral "], header))
    assert set(fast.columns["oil"]) == set(patient.columns["oil"]) == {"mineral"}


def test_a_short_line_in_runs_csv_is_refused(tmp_path):
    campaign(tmp_path, RUNS.replace("b.csv,1,5", "b.csv,15"))
    with pytest.raises(CampaignError, match=r"runs.csv:3: the line has 2 cells where 3 are named"):
        channels(tmp_path, 'condition = ["aging_days"]\n')


@pytest.mark.parametrize("value", ["9.9e37", "inf", "1e400"])
def test_a_mark_of_overload_is_no_number_in_runs_csv(tmp_path, value):
    campaign(tmp_path, RUNS.replace("b.csv,1,5", f"b.csv,1,{value}"))
    with pytest.raises(CampaignError, match=r"runs.csv:3: column 'speed_mm_s'.*is not a number"):
        channels(tmp_path, 'condition = ["aging_days"]\n')


def test_a_name_longer_than_names_can_be_is_a_missing_file(tmp_path):
    long = "x" * 5000
    campaign(tmp_path, RUNS.replace("b.csv", long))
    found = ingest_campaign(tmp_path, config('condition = ["aging_days"]')).faults
    assert [fault.check for fault in found if fault.file == long] == ["unreadable_file"]


def test_names_of_columns_are_not_listed_without_end(tmp_path):
    campaign(tmp_path, RUNS.replace("file", "\xff" * 5000))
    with pytest.raises(CampaignError) as caught:
        channels(tmp_path)
    assert len(str(caught.value)) < 1000


def test_equal_faults_of_many_lines_of_a_file_are_one_message():
    faults = [
        Fault(
            "not_a_number", "is not a number.", "a.csv", line=i, column="force_N", value="-", fix="Mend it."
        )
        for i in range(2, 9)
    ]
    (group,) = grouped(faults)
    assert told(group) == (
        "7 lines of a.csv: column 'force_N': is not a number. "
        "For example a.csv:2: '-'; a.csv:3: '-'; a.csv:4: '-'. Mend it."
    )


@pytest.mark.skipif(os.name == "nt", reason="names are text there")
@pytest.mark.parametrize("listed", [True, False])
def test_a_name_that_is_not_utf_8_is_one_finding(tmp_path, listed):
    campaign(tmp_path, RUNS)
    try:
        trace(tmp_path, os.fsdecode(b"caf\xe9.csv"))
    except OSError:
        pytest.skip("this file system has names in UTF-8 only")
    text = 'condition = ["aging_days"]\n'
    if not listed:
        (tmp_path / "runs.csv").unlink()
        text += '[files]\nglob = "*.csv"\n[runs]\nconstants = {aging_days = 1}\n'
    refs, faults = list_traces(tmp_path, config(text))
    assert len(refs) == 3
    (fault,) = [fault for fault in faults if fault.check == "file_name"]
    assert (fault.file, fault.reason) == ("caf\\xe9.csv", "the name of the file is not UTF-8.")


def test_a_quotation_mark_left_open_in_runs_csv_is_said(tmp_path):
    campaign(tmp_path, RUNS.replace("b.csv", '"b.csv'))
    with pytest.raises(CampaignError, match=r"runs.csv:3: a quotation mark is left open"):
        channels(tmp_path)


def test_a_long_cell_with_a_quotation_mark_is_a_fault_of_its_line(tmp_path):
    campaign(tmp_path, f'file,aging_days\na.csv,4\nb.csv,"{"y" * 200000}')
    with pytest.raises(CampaignError, match=r"runs.csv:3: a quotation mark is left open"):
        channels(tmp_path)


def test_a_quotation_mark_within_a_cell_is_a_mark_like_any_other(tmp_path):
    campaign(tmp_path, 'file,aging_days,speed_mm_s,hose\na.csv,0,5,1/2" wide\nb.csv,1,5,"1"" wide"\n')
    assert [c["hose"] for c in channels(tmp_path, 'condition = ["aging_days"]\n').values()] == [
        '1/2" wide',
        '1" wide',
    ]


@pytest.mark.parametrize("value", [-300, -273.15])
def test_no_temperature_is_below_absolute_zero(tmp_path, value):
    campaign(tmp_path, f"file,aging_days,speed_mm_s,oven_C\na.csv,0,5,{value}\n", files=("a.csv",))
    with pytest.raises(CampaignError, match="is not above absolute zero"):
        channels(tmp_path, 'condition = ["aging_days"]\n')


@pytest.mark.parametrize(
    "text",
    [
        "[strokes]\nmin_travel_mm = -1\n",
        "[strokes]\nsmooth_samples = 1000000\n",
        "[strokes]\nspeed_tolerance = 1e308\n",
        "[strokes]\nturn = 1e-320\n",
        "[rig]\nmoving_mass_kg = 1e308\n",
        "[loop]\nseed = -1\n",
        "[trace.columns]\ntime_s = 0\n",
        "[trace.columns]\ntime_s = true\n",
        '[files]\nglob = "a**b"\n',
        '[files]\nglob = "."\n',
    ],
)
def test_settings_have_bounds(text):
    with pytest.raises(ConfigError):
        config(text)


def test_a_pipe_is_no_config(tmp_path):
    os.mkfifo(tmp_path / "rig.toml")
    with pytest.raises(ConfigError, match=r"is not a file. Check --config."):
        ConfigCopy.at(tmp_path / "rig.toml").parse()


@pytest.mark.parametrize("encoding", ["rot13", "hex", "no-such", "latin-1\\u0000"])
def test_codecs_that_are_no_text_are_no_encodings(encoding):
    with pytest.raises(ConfigError, match="is not an encoding"):
        config(f'[trace]\nencoding = "{encoding}"\n')


def test_forces_that_are_zero_everywhere_were_not_measured(tmp_path):
    campaign(tmp_path, RUNS)
    for name in "abc":
        rows = [row.rpartition(",")[0] + ",0" for row in ROWS]
        (tmp_path / f"{name}.csv").write_text("\n".join([HEADER, *rows]))
    with pytest.raises(CampaignError, match="so it was not measured"):
        ingest_campaign(tmp_path, config('condition = ["aging_days"]'))


@pytest.mark.parametrize(("factor", "said"), [("1e-100", "so it was not measured"), ("1e28", "rows are bad")])
def test_forces_that_no_rig_measures_are_left_out(tmp_path, factor, said):
    campaign(tmp_path, RUNS)
    rows = [row.rpartition(",")[0] + f",{2 + 0.1 * (i % 7)}" for i, row in enumerate(ROWS)]
    for name in "abc":
        (tmp_path / f"{name}.csv").write_text(csv_of(rows))
    text = f'condition = ["aging_days"]\n[trace.compute]\nforce_N = "force_N * {factor}"\n'
    with pytest.raises(CampaignError, match=said):
        ingest_campaign(tmp_path, config(text))


@pytest.mark.parametrize("value", ["[runs.constants]\nload_N = 1e150", "[runs.compute]\nload_N = '1e150'"])
def test_values_that_no_rig_has_are_refused(tmp_path, value):
    campaign(tmp_path, RUNS)
    with pytest.raises(CampaignError, match="is larger than any quantity of a rig"):
        channels(tmp_path, f'condition = ["aging_days"]\n{value}\n')


def test_a_friction_that_pushes_along_stops_with_the_line_for_the_config(tmp_path):
    campaign(tmp_path, RUNS)
    for name in "abc":
        rows = [row.rpartition(",")[0] + f",-{2 + 0.1 * (i % 7)}" for i, row in enumerate(ROWS)]
        (tmp_path / f"{name}.csv").write_text("\n".join([HEADER, *rows]))
    with pytest.raises(CampaignError, match=r'force_N = "-force_N" under \[trace.compute\]'):
        ingest_campaign(tmp_path, config('condition = ["aging_days"]'))
    text = 'condition = ["aging_days"]\n[trace.compute]\nforce_N = "-force_N"\n'
    assert ingest_campaign(tmp_path, config(text)).tables["steady"]["force_N"].min() > 0
    computed = 'condition = ["aging_days"]\n[trace.columns]\nraw = "force_N"\n[trace.compute]\nforce_N = '
    with pytest.raises(CampaignError, match=r'force_N = "-\(2 \* raw\)" under \[trace.compute\]'):
        ingest_campaign(tmp_path, config(computed + '"2 * raw"\n'))
    made = ingest_campaign(tmp_path, config(computed + '"-(2 * raw)"\n'))
    assert made.tables["steady"]["force_N"].min() > 0


@pytest.mark.parametrize("how", ["copy", "link", "rewritten"])
def test_a_copy_is_no_second_measurement(tmp_path, how):
    campaign(tmp_path, RUNS)
    rows = [row.rpartition(",")[0] + f",{2 + 0.1 * (i % 7)}" for i, row in enumerate(ROWS)]
    (tmp_path / "a.csv").write_text("\n".join([HEADER, *rows]))
    (tmp_path / "c.csv").write_text("\n".join([HEADER, *(f"{row}1" for row in rows)]))
    (tmp_path / "b.csv").unlink()
    if how == "link":
        (tmp_path / "b.csv").symlink_to("a.csv")
    else:
        other = rows if how == "copy" else [f"{row}0" for row in rows]
        (tmp_path / "b.csv").write_text("\n".join([HEADER, *other]))
    made = ingest_campaign(tmp_path, config('condition = ["aging_days"]'))
    (fault,) = [fault for fault in made.faults if fault.check == "copy"]
    assert (fault.file, fault.action) == ("b.csv", "stroke left out")
    assert fault.reason.startswith("holds the samples of a.csv")
    used = made.tables["steady"].loc[lambda t: t["used"], "file"].tolist()
    assert used == ["a.csv", "c.csv"]


@pytest.mark.parametrize("left", [99, 98, 65, 60])
def test_a_copy_without_its_last_rows_is_no_second_measurement(tmp_path, left):
    campaign(tmp_path, RUNS)
    for number, name in enumerate("abc"):
        rows = [
            row.rpartition(",")[0] + f",{2 + 0.01 * ((i + 5 * number) % 37)}" for i, row in enumerate(ROWS)
        ]
        (tmp_path / f"{name}.csv").write_text(csv_of(rows))
    whole = (tmp_path / "a.csv").read_text().splitlines()
    assert not ingest_campaign(tmp_path, config('condition = ["aging_days"]')).faults
    (tmp_path / "b.csv").write_text("\n".join(whole[: 1 + left]) + "\n")
    made = ingest_campaign(tmp_path, config('condition = ["aging_days"]'))
    (fault,) = [fault for fault in made.faults if fault.check == "copy"]
    assert (fault.file, fault.action) == ("b.csv", "stroke left out")
    assert fault.reason.startswith("begins with the samples of a.csv")


FIVE = "file,aging_days,temperature_C,compression_ratio_pct,speed_mm_s\n" + "".join(
    f"{name}.csv,{day},60,80,5\n" for day, name in enumerate("abcde")
)


def written(tmp_path, runs, open_ended, encoding="utf-8"):
    """Write the traces of a table of runs; those named do not end with a line end."""
    campaign(tmp_path, runs)
    for name in (line.split(",")[0] for line in runs.strip().splitlines()[1:]):
        text = csv_of(ROWS).removesuffix("\n") + ("" if name in open_ended else "\n")
        (tmp_path / name).write_bytes(text.encode(encoding))
    listing, _ = list_traces(tmp_path, config())
    return {ref.file: ref for ref in listing}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_file_that_was_cut_loses_its_last_line(tmp_path, encoding):
    refs = written(tmp_path, FIVE, {"c.csv"}, encoding)
    assert {file for file, ref in refs.items() if ref.cut} == {"c.csv"}
    whole, cut = (read_trace(tmp_path, refs[file], config()) for file in ("b.csv", "c.csv"))
    assert len(cut.line) == len(whole.line) - 1
    (fault,) = cut.faults
    assert (fault.check, fault.line, fault.action) == ("cut_file", len(ROWS) + 1, "row left out")
    assert not whole.faults


@pytest.mark.parametrize("open_ended", [set(), {"a.csv", "b.csv"}, {f"{name}.csv" for name in "abcde"}])
def test_files_whose_program_ends_no_last_line_are_whole(tmp_path, open_ended):
    assert not any(ref.cut for ref in written(tmp_path, FIVE, open_ended).values())


def test_what_was_stored_of_a_file_is_read_again_when_others_show_that_it_was_cut(tmp_path):
    written(tmp_path, FIVE, {"c.csv"})
    listing, _ = list_traces(tmp_path, config())
    hashes = ["0"] * len(listing)
    assert part_key(listing, hashes, "") != part_key(replace(listing, cut=frozenset()), hashes, "")
