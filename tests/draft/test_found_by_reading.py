"""Folders whose names, headers and tables say one thing and look like another."""

import exports
import numpy as np
import numpy.testing as npt
import pytest

from sealfit.config import parse_config
from sealfit.draft import draft
from sealfit.errors import RequestError
from sealfit.ingest.columns import TraceRef
from sealfit.ingest.reader import read_trace
from sealfit.ingest.runs import list_traces

HEADER = "Time [s],Displacement [mm],Force [N]\n"


def strokes(speed=5.0, reverse=True):
    """Return a recording of four strokes of 20 mm as text."""
    t = np.linspace(0, 80 / speed, 400)
    phase = (t * speed) % 40
    up = phase < 20
    x = np.where(up, phase, 40 - phase) if reverse else t * speed
    return exports.table([t, x, np.where(up | (not reverse), 10.0, -10.0)], ",", 4)


def folder(path, files, header=HEADER, **more):
    for name, above in files.items():
        file = path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(above + header + strokes(**more))
    return path


def config(made):
    return parse_config(made.text, "rig.toml")


def conditions(path, made, name="aging_days"):
    return [ref.channels[name] for ref in list_traces(path, config(made))[0]]


def doubts(made):
    return "\n".join(doubt.reason for doubt in made.doubts)


# ---------------------------------------------------------------- header lines
def test_the_unit_of_a_header_line_stands_before_other_words(tmp_path):
    files = {
        f"a{days}.csv": f"Aging: {24 * days} h at 70 °C\nSpeed: 300 mm/min nominal\n" for days in (1, 2, 3)
    }
    path = folder(tmp_path, files)
    made = draft(path)
    assert conditions(path, made) == [1.0, 2.0, 3.0]
    assert config(made).files.units["speed_mm_s"] == "mm/min"


@pytest.mark.parametrize(
    ("lines", "factor"),
    [
        ('"Aging time","{}","h"\n"Normal load","2.0394","kgf"\n', 24),
        ("Aging time\t{}\tweeks\nNormal load\t4.4962\tlbf\n", 1 / 7),
        ("Aging time;{};months\nNormal load;0.020;kN\n", 12 / 365.25),
    ],
)
def test_the_unit_of_a_header_line_stands_in_a_cell_of_its_own(tmp_path, lines, factor):
    path = folder(tmp_path, {f"a{days}.csv": lines.format(days * factor) for days in (7, 14)})
    made = draft(path)
    assert conditions(path, made) == pytest.approx([7.0, 14.0], rel=1e-3)
    assert conditions(path, made, "load_N") == pytest.approx([20.0, 20.0], rel=1e-3)


def test_a_word_that_is_no_unit_of_a_header_line_is_a_doubt(tmp_path):
    path = folder(tmp_path, {f"a{days}.csv": f"Aging: {days} fortnights\n" for days in (1, 2)})
    assert "'fortnights' in header line 1 is no unit that is known here; d is assumed" in doubts(draft(path))


@pytest.mark.parametrize(
    "line", ["Samples\t{}00\t{}00", "Number of samples: {}", "Sample rate: {} Hz", "Sample thickness: {} mm"]
)
def test_samples_of_a_logger_are_no_specimens(tmp_path, line):
    files = {f"a{days}.csv": f"Aging: {days} d\n{line.replace('{}', str(days))}\n" for days in (1, 2)}
    assert "specimen_id" not in config(draft(folder(tmp_path, files))).trace.header_fields


def test_a_header_line_whose_unit_differs_between_files_is_not_used(tmp_path):
    path = folder(tmp_path, {"a.csv": "Aging: 24 h\n", "b.csv": "Aging: 7 d\n"})
    made = draft(path)
    assert "aging_days" not in config(made).trace.header_fields
    assert "nothing says temperature, compression or days" in doubts(made)


def test_a_compression_in_a_header_line_is_the_height_that_is_left(tmp_path):
    files = {f"d{days}.csv": f"Compression: 25 %\nAging: {days} d\n" for days in (1, 2)}
    path = folder(tmp_path, files)
    made = draft(path)
    assert conditions(path, made, "compression_ratio_pct") == [75.0, 75.0]
    assert "how much the rubber was compressed" in doubts(made)


@pytest.mark.parametrize(("line", "rate"), [("Sampling rate [ms]: 10", 100.0), ("Sample rate: 10 ms", 100.0)])
def test_a_rate_in_a_unit_of_time_is_a_step(tmp_path, line, rate):
    for name in ("d1.csv", "d2.csv"):
        body = "\n".join(row.partition(",")[2] for row in strokes().splitlines())
        (tmp_path / name).write_text(f"{line}\nDisplacement [mm],Force [N]\n{body}\n")
    assert config(draft(tmp_path)).trace.rate_Hz == rate


# ---------------------------------------------------------------- names of files and columns
@pytest.mark.parametrize("header", ["Zeit t,Weg s,Kraft F\n", "Time t,Position d,Kraft Ft\n"])
def test_letters_for_quantities_are_no_units(tmp_path, header):
    made = draft(folder(tmp_path, {"d1.csv": "", "d2.csv": ""}, header))
    columns = config(made).trace.columns
    assert {ours: column.name for ours, column in columns.items()} == dict(
        zip(("time_s", "displacement_mm", "force_N"), header.strip().split(","), strict=True)
    )


@pytest.mark.parametrize("word", ["up", "hin", "back"])
def test_a_word_before_some_numbers_is_the_direction_it_names(tmp_path, word):
    names = [f"{way}{speed}_{n}.csv" for way in ("", word) for speed in (5, 25) for n in (1, 2)]
    made = draft(folder(tmp_path, dict.fromkeys(names, "")))
    (signs,) = (values for values in config(made).files.values.values() if word in values)
    assert signs == {"": -signs[word], word: -1.0 if word == "back" else 1.0}


def test_a_speed_in_names_that_is_not_the_measured_one_is_a_doubt(tmp_path):
    for number, speed in enumerate((0.5, 5.0, 50.0), start=1):
        folder(tmp_path, {f"T70_d1_v{number}.csv": ""}, speed=speed)
    assert "is measured" in doubts(draft(tmp_path))


def test_temperatures_in_degrees_have_no_unit_of_their_own(tmp_path):
    made = draft(folder(tmp_path, {"T70C_d1.csv": "", "T90C_d1.csv": ""}))
    assert "degC" not in made.text


def test_a_coefficient_beside_a_load_gives_the_force(tmp_path):
    for day in (1, 2):
        rows = [line.split(",") for line in strokes().splitlines()]
        lines = [f"12:00:{float(t):06.3f};{x};{float(force) / 20:.4f};20.1" for t, x, force in rows]
        text = "\n".join(["Uhrzeit;Weg [mm];Reibwert [-];Normalkraft [N]", *lines])
        (tmp_path / f"d{day}.csv").write_text(text + "\n")
    made = draft(tmp_path)
    trace = config(made).trace
    assert trace.compute == {"force_N": "coefficient * load_N"}
    assert trace.columns["coefficient"].name == "Reibwert [-]"
    read = read_trace(tmp_path, TraceRef("d1.csv", {}), config(made))
    npt.assert_allclose(np.abs(read.columns["force_N"]), 0.5 * 20.1, rtol=1e-3)
    assert not [doubt for doubt in made.doubts if "no force" in doubt.reason]


# ---------------------------------------------------------------- tables and other files
@pytest.mark.parametrize(
    ("column", "cell"), [("Specimen width [mm]", "6.2"), ("Run time [s]", "600"), ("Sample rate [Hz]", "100")]
)
def test_a_measured_quantity_names_no_specimen_and_no_run(tmp_path, column, cell):
    path = folder(tmp_path, {"a.csv": "", "b.csv": ""})
    (path / "runs.csv").write_text(f"file,{column},Specimen,Days\na.csv,{cell},P1,1\nb.csv,{cell},P2,2\n")
    made = draft(path)
    assert conditions(path, made, "specimen_id") == ["P1", "P2"]


def test_a_table_with_a_row_per_stroke_is_no_table_of_runs(tmp_path):
    path = folder(tmp_path, {"T70_d1_r1.csv": "", "T70_d2_r1.csv": ""})
    rows = [f"T70_d{day}_r1.csv,{stroke},9.9" for day in (1, 2) for stroke in range(4)]
    (path / "results.csv").write_text("\n".join(["file,stroke,mean force", *rows]) + "\n")
    assert config(draft(path)).files.runs_table is None


def test_results_in_the_campaign_are_not_looked_at(tmp_path):
    path = folder(tmp_path, {"T70_d1_r1.csv": "", "T70_d2_r1.csv": ""})
    (path / "results").mkdir()
    (path / "results" / "state.json").write_text("{}")
    (path / "results" / "points.csv").write_text(HEADER + strokes())
    assert draft(path).files == 2


def test_a_summary_beside_folders_of_traces_excludes_itself_alone(tmp_path):
    path = folder(tmp_path, {f"raw/d{day}/T70_d{day}_r{n}.csv": "" for day in (1, 2) for n in (1, 2)})
    (path / "raw" / "summary.csv").write_text("test,operator,remark\n" + "T70,me,fine\n" * 9)
    made = draft(path)
    assert len(list_traces(path, config(made))[0]) == 4


def test_the_columns_of_files_without_some_cells_are_those_of_the_others(tmp_path):
    for number in range(9):
        rows = [line.split(",") for line in strokes().splitlines()]
        if number == 1:
            text = "\n".join(",".join([*row, "23.5"]) for row in rows)
        else:
            text = "\n".join(",".join([*(f"{float(cell):.0f}" for cell in row), ""]) for row in rows)
        (tmp_path / f"d{number}.csv").write_text("Time,Position,Force,Temp\n" + text + "\n")
    assert draft(tmp_path).files == 9


def test_names_that_are_not_utf_8_are_said(tmp_path):
    folder(tmp_path, {"T70_d1.csv": ""})
    (tmp_path / "T70_d2_\udce9.csv").write_text(HEADER + strokes())
    with pytest.raises(RequestError, match="UTF-8"):
        draft(tmp_path)


def test_a_folder_that_is_misspelt_is_named(tmp_path):
    folder(tmp_path, {"season/T70_d1.csv": ""})
    with pytest.raises(RequestError, match="season"):
        draft(tmp_path / "seasom")


def test_lines_below_the_data_that_begin_differently_are_a_doubt(tmp_path):
    path = folder(tmp_path, {"T70_d1.csv": "", "T70_d2.csv": ""})
    for file, word in (("T70_d1.csv", "Mean"), ("T70_d2.csv", "Done")):
        with open(path / file, "a") as trace:
            trace.write(f"{word},of,strokes\n")
    assert "end in lines that are no data" in doubts(draft(path))


@pytest.mark.parametrize(("aging", "asked"), [("", True), ("Aging: 4 d\n", False)])
def test_a_temperature_without_days_may_be_that_of_the_tests(tmp_path, aging, asked):
    files = {name: f"Temperature: {celsius} C\n{aging}" for name, celsius in (("a.csv", 23), ("b.csv", 70))}
    made = draft(folder(tmp_path, files))
    assert "temperature_C" in config(made).condition
    assert ("temperature_C is the temperature of aging" in doubts(made)) == asked
