"""Which column is what, by name, unit and behaviour; how files are written."""

from datetime import timedelta

import exports
import numpy as np
import pytest

from sealfit.config import parse_config
from sealfit.draft import draft
from sealfit.draft.columns import moving_strokes, stroke_count
from sealfit.draft.dialect import sniff
from sealfit.draft.vocabulary import AFTER, column_role, name_and_unit, setting
from sealfit.ingest.columns import TraceRef
from sealfit.ingest.files import as_utf8
from sealfit.ingest.reader import read_trace
from sealfit.units import UNITS, Units, conversion

SPEEDS = (1.0, 5.0)


def campaign(folder, columns, header="", strokes=1, delimiter=",", decimals=5):
    """Write two files; `columns` makes the columns of a record."""
    for one in exports.records(days=(4,), speeds=SPEEDS, repeats=(1,), strokes=strokes):
        body = exports.table(columns(one), delimiter, decimals)
        exports.write(folder, f"d{one.days}_v{one.speed:g}.csv", header + body)
    return draft(folder)


def slots(made):
    columns = parse_config(made.text, "rig.toml").trace.columns
    return {ours: column.name for ours, column in columns.items()}


# ---------------------------------------------------------------- columns
def test_columns_without_names_are_found_by_their_behaviour(tmp_path):
    made = campaign(tmp_path, lambda one: [one.force_N, one.time_s, one.displacement_mm], strokes=4)
    assert slots(made) == {"force_N": 1, "time_s": 2, "displacement_mm": 3}
    reasons = [doubt.reason for doubt in made.doubts if "its behaviour does" in doubt.reason]
    assert [reason.rpartition(", and ")[2] for reason in reasons] == [
        "s is assumed.",
        "mm is assumed.",
        "N is assumed.",
    ]


def test_a_counter_is_no_time_and_a_later_time_is(tmp_path):
    def columns(one):
        return [np.arange(len(one.time_s)), one.displacement_mm, one.force_N, one.time_s]

    made = campaign(tmp_path, columns, "No.,Position,Force,Zeit\n")
    assert slots(made)["time_s"] == "Zeit"


@pytest.mark.parametrize("step", [0.1, 1.0])
def test_a_time_whose_clock_is_coarse_is_the_time_all_the_same(tmp_path, step):
    def columns(one):
        return [np.floor(one.time_s / step) * step, one.displacement_mm, one.force_N]

    assert slots(campaign(tmp_path, columns, "Time,Position,Force\n"))["time_s"] == "Time"


def test_recordings_side_by_side_are_a_doubt(tmp_path):
    def columns(one):
        return [one.time_s, one.displacement_mm, one.force_N, one.displacement_mm[::-1], 0.9 * one.force_N]

    doubts = campaign(tmp_path, columns, "Time,Pos 1,Force 1,Pos 2,Force 2\n").doubts
    assert any("further recordings" in doubt.fix for doubt in doubts)


def test_a_counter_without_a_name_is_no_time(tmp_path):
    made = campaign(tmp_path, lambda one: [np.arange(len(one.time_s)), *exports.slots(one)], strokes=2)
    assert slots(made) == {"time_s": 2, "displacement_mm": 3, "force_N": 4}


def test_the_raw_signal_of_a_sensor_is_left_for_the_scaled_one(tmp_path):
    made = campaign(
        tmp_path, lambda one: [one.time_s, 1.2 + one.displacement_mm / 20, *exports.slots(one)[1:]]
    )
    assert slots(made) == {"time_s": 1, "displacement_mm": 3, "force_N": 4}
    assert "column 2, the same signal as column 3" in made.text


def test_load_and_friction_are_told_apart(tmp_path):
    def columns(one):
        return [one.time_s, one.displacement_mm, one.further["load"], one.force_N]

    made = campaign(tmp_path, columns, "Time [s],Stroke [mm],Normal Force [N],Friction Force [N]\n")
    assert slots(made)["load_N"] == "Normal Force [N]"
    assert slots(made)["force_N"] == "Friction Force [N]"


def test_the_force_in_another_unit_is_no_load(tmp_path):
    def columns(one):
        return [one.time_s, one.displacement_mm, one.force_N, one.force_N / 1000]

    made = campaign(tmp_path, columns, "time_s,displacement_mm,force_N,force_kN\n")
    assert "load_N" not in slots(made)


def test_a_load_cell_along_the_motion_is_the_force_though_it_is_called_load(tmp_path):
    made = campaign(tmp_path, exports.slots, "Time,Extension,Load\n")
    assert slots(made)["force_N"] == "Load"
    assert "load_N" not in slots(made)


def test_names_that_stand_twice_go_by_position(tmp_path):
    made = campaign(tmp_path, exports.slots, "Zeit,Kanal,Kanal\n", strokes=2)
    assert slots(made) == {"time_s": "Zeit", "displacement_mm": 2, "force_N": 3}


def test_a_force_that_is_a_magnitude_is_a_doubt(tmp_path):
    def columns(one):
        return [one.time_s, one.displacement_mm, np.abs(one.force_N)]

    made = campaign(tmp_path, columns, "time_s,displacement_mm,force_N\n", strokes=4)
    (doubt,) = [doubt for doubt in made.doubts if "same sign in both directions" in doubt.reason]
    assert doubt.key == "trace.columns.force_N"


def test_a_displacement_is_integrated_from_a_speed(tmp_path):
    def columns(one):
        return [one.time_s, np.gradient(one.displacement_mm, one.time_s) * 60, one.force_N]

    made = campaign(tmp_path, columns, "Zeit [s],Geschwindigkeit [mm/min],Kraft [N]\n")
    trace = parse_config(made.text, "rig.toml").trace
    assert trace.integrate_displacement == "speed_column_mm_s"
    assert trace.columns["speed_column_mm_s"].unit == "mm/min"


@pytest.mark.parametrize(
    ("unit", "factor", "scale", "doubted"),
    [("mm/min", 60, 1.0, False), ("mm/min", 60, 1e-3, True), ("rpm", 2, 1e-3, True)],
)
def test_a_height_beside_a_speed_is_a_doubt(unit, factor, scale, doubted, tmp_path):
    def columns(one):
        speed = np.gradient(one.displacement_mm, one.time_s)
        return [one.time_s, scale * one.displacement_mm, factor * speed, one.force_N]

    made = campaign(tmp_path, columns, f"Zeit [s],Z [mm],Geschwindigkeit [{unit}],Kraft [N]\n", strokes=2)
    assert slots(made)["displacement_mm"] == "Z [mm]"
    assert doubted == any("it may be a height" in doubt.reason for doubt in made.doubts)


@pytest.mark.parametrize(("unit", "ms"), [("V", 1), ("mm/s", 1000)])
def test_a_speed_in_another_unit_and_a_clock_in_ms_are_no_doubt_of_the_displacement(unit, ms, tmp_path):
    def columns(one):
        return [
            ms * one.time_s,
            one.displacement_mm,
            np.gradient(one.displacement_mm, one.time_s),
            one.force_N,
        ]

    made = campaign(tmp_path, columns, f"Zeit,Weg [mm],Geschwindigkeit [{unit}],Kraft [N]\n", strokes=2)
    assert slots(made)["displacement_mm"] == "Weg [mm]"
    assert not any("it may be a height" in doubt.reason for doubt in made.doubts)


def test_a_time_in_no_unit_that_would_last_for_hours_is_in_ms(tmp_path):
    made = campaign(
        tmp_path, lambda one: [one.time_s * 1000, *exports.slots(one)[1:]], "Time,Position,Force\n"
    )
    trace = parse_config(made.text, "rig.toml").trace
    assert trace.columns["time_s"].unit == "ms"
    assert any("taken as ms" in doubt.reason for doubt in made.doubts)


def test_a_speed_of_names_in_mm_per_minute_is_seen_in_the_displacement(tmp_path):
    for one in exports.records(days=(4,), repeats=(1,)):
        header = "Time_s,Position_mm,Force_N\n"
        exports.write(
            tmp_path, f"d4_v{60 * one.speed:g}.csv", header + exports.table(exports.slots(one), ",", 4)
        )
    config = parse_config(draft(tmp_path).text, "rig.toml")
    assert config.files.units == {"speed_mm_s": "mm/min"}


def test_a_number_in_names_that_is_the_measured_speed_is_the_speed(tmp_path):
    for one in exports.records(days=(4,), speeds=(1.0, 5.0, 8.0), repeats=(1,)):
        header = "Time_s,Position_mm,Force_N\n"
        exports.write(tmp_path, f"d4_X{one.speed:g}.csv", header + exports.table(exports.slots(one), ",", 4))
    config = parse_config(draft(tmp_path).text, "rig.toml")
    assert "(?P<speed_mm_s>" in config.files.name_pattern


@pytest.mark.parametrize("strokes", [1, 2, 4, 7])
@pytest.mark.parametrize("sign", [1, -1])
def test_strokes_are_counted(strokes, sign):
    (one,) = exports.records(days=(1,), speeds=(5.0,), repeats=(1,), strokes=strokes)
    assert stroke_count(sign * one.displacement_mm) == strokes
    expected = [5.0 * sign * (-1) ** i for i in range(strokes)]
    found = moving_strokes(one.time_s, sign * one.displacement_mm)
    assert not any(stroke.several_speeds for stroke in found)
    assert [stroke.speed_mm_s for stroke in found] == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("Prüfzeit", "time"), ("Elapsed Time", "time"), ("t", "time"), ("Messzeit", "time"),
        ("Traversenweg", "displacement"), ("Crosshead", "displacement"), ("Verfahrweg", "displacement"),
        ("x", "displacement"), ("Standardkraft", "force"), ("Fx", "force"), ("Reibkraft", "force"),
        ("Load Cell", "force"), ("Normalkraft", "load"), ("Fz", "load"), ("Reibungszahl", "coefficient"),
        ("COF", "coefficient"),
        ("Probentemperatur", "temperature"), ("Geschwindigkeit", "speed"), ("Drehmoment", "torque"),
        ("MX440B_CH 1", ""), ("Temps", "time"), ("Tempo", "time"), ("Déplacement", "displacement"),
        ("Effort tangentiel", "force"), ("Vitesse", "speed"), ("Température", "temperature"),
    ],
)  # fmt: skip
def test_names_of_columns_in_several_languages(name, role):
    assert column_role(name)[0] == role


def test_names_of_settings_in_several_languages():
    spanish = "Archivo Fecha Compresión Días Velocidad Repetición Carga"
    ours = "file started_at compression_ratio_pct aging_days speed_mm_s repeat load_N"
    assert [setting(name) for name in spanish.split()] == ours.split()
    assert setting("Temperatura de envejecimiento") == "temperature_C"
    others = "Fichier Jours Vitesse Dagen Snelheid Herhaling"
    assert [setting(name) for name in others.split()] == [
        "file", "aging_days", "speed_mm_s", "aging_days", "speed_mm_s", "repeat"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "name", "unit"),
    [
        ("Weg [mm]", "Weg", "mm"), ("Kraft (kN)", "Kraft", "kN"), ("t / ms", "t", "ms"),
        ("s in µm", "s", "um"), ("Load_lbf", "Load", "lbf"), ("Position, in", "Position", "in"),
        ("Force N", "Force", "N"), ("v_mm_min", "v", "mm/min"), ("Weg_inch", "Weg", "in"),
        ("Temp [F]", "Temp", "degF"), ("Oven_temp_F", "Oven_temp", "degF"), ("T (°F)", "T", "degF"),
        ("Temperature / K", "Temperature", "K"),
    ],
)  # fmt: skip
def test_units_in_names_of_columns(text, name, unit):
    found, known = name_and_unit(text)
    assert (found, known.name) == (name, unit)


@pytest.mark.parametrize("text", ["Kraft F", "Kanal K"])
def test_a_letter_that_is_no_temperature(text):
    assert name_and_unit(text) == (text, None)


OF_DIMENSION = {
    "time": "s", "length": "mm", "force": "N", "speed": "mm/s", "temperature": "degC", "pressure": "bar",
    "share": "%", "angle": "deg", "rotation": "rpm", "torque": "N*m",
}  # fmt: skip


def test_units_of_files_are_known_to_the_config():
    for unit in {unit for unit in UNITS.values() if unit.dimension in OF_DIMENSION}:
        conversion(unit.name, OF_DIMENSION[unit.dimension])
    for ours, unit in AFTER.values():
        assert not unit or conversion(unit, Units().of(ours)).factor != 1.0


def test_sensors_beside_the_motion_are_channels_with_names_of_their_own(tmp_path):
    def columns(one):
        rng = np.random.default_rng(one.number)
        return [*exports.slots(one), *(20 + rng.normal(size=(4, len(one.time_s))))]

    header = "Zeit s;Weg mm;Kraft N;Temp Probe °C;Temp Luft °C;Feuchte %;Luftdruck mbar\n"
    named = slots(campaign(tmp_path, columns, header, delimiter=";"))
    assert named["temperature_sensor_C"] == "Temp Probe °C"
    assert named["temp_luft_C"] == "Temp Luft °C"
    assert {"humidity_sensor_pct", "pressure_sensor_mbar"} <= set(named)
    assert len(named) == 7


def test_a_unit_makes_a_column_a_channel_whose_name_does_not_say_what_it_is(tmp_path):
    def columns(one):
        return [*exports.slots(one), 40 + np.random.default_rng(one.number).normal(size=len(one.time_s))]

    named = slots(campaign(tmp_path, columns, "Zeit s;Weg mm;Kraft N;T_oil [degC]\n", delimiter=";"))
    assert named["temperature_sensor_C"] == "T_oil [degC]"


def test_a_row_of_units_goes_before_a_letter_of_a_name(tmp_path):
    def columns(one):
        rng = np.random.default_rng(one.number)
        return [*exports.slots(one), *(3 + rng.normal(size=(3, len(one.time_s))))]

    header = "Zeit;Weg;Kraft;Druck A;Druck B;Druck C\ns;mm;N;bar;bar;bar\n"
    named = slots(campaign(tmp_path, columns, header, delimiter=";"))
    others = {"pressure_sensor_bar": "Druck A", "druck_b_bar": "Druck B", "druck_c_bar": "Druck C"}
    assert {name: named.get(name) for name in others} == others


def test_a_row_of_dashes_leaves_the_units_of_names(tmp_path):
    def columns(one):
        time_s, x, force_N = exports.slots(one)
        return [time_s, x / 10, force_N]

    made = campaign(tmp_path, columns, "Time [s];Weg [cm];Kraft [N]\n-;-;-\n", delimiter=";")
    assert parse_config(made.text, "rig.toml").trace.columns["displacement_mm"].unit == "cm"


def test_a_measured_load_goes_before_that_of_the_header(tmp_path):
    def columns(one):
        return [one.time_s, one.displacement_mm, one.force_N, one.further["load"]]

    header = "Normal load: 50 N\n\nt [s];x [mm];F [N];Fz [N]\n"
    config = parse_config(campaign(tmp_path, columns, header, delimiter=";").text, "rig.toml")
    assert config.trace.columns["load_N"].name == "Fz [N]"
    assert config.trace.header_fields == {}


def test_names_with_blanks_above_columns_of_blanks_go_by_position(tmp_path):
    made = campaign(
        tmp_path, exports.slots, "Elapsed Time (s)   Slide Position (mm)   Force (N)\n", delimiter="   "
    )
    assert slots(made) == {"time_s": 1, "displacement_mm": 2, "force_N": 3}
    assert parse_config(made.text, "rig.toml").trace.header_lines == 1
    assert [doubt.key for doubt in made.doubts] == ["condition"]  # names say the days only


@pytest.mark.parametrize(
    "header", ["# t x F\n", "#t[s] x[mm] F[N]\n", "# made by numpy\n# time position force\n"]
)
def test_names_behind_a_mark_of_comment(header, tmp_path):
    made = campaign(tmp_path, exports.slots, header.replace(" ", "\t"), delimiter="\t")
    config = parse_config(made.text, "rig.toml")
    table = read_trace(tmp_path, TraceRef("d4_v5.csv", {}), config).table
    assert list(table) == ["time_s", "displacement_mm", "force_N"]
    assert table["displacement_mm"].max() == pytest.approx(30, abs=0.5)


def test_the_line_for_spreadsheets_is_header(tmp_path):
    made = campaign(tmp_path, exports.slots, "sep=;\nZeit s;Weg mm;Kraft N\n", delimiter=";")
    assert slots(made) == {"time_s": "Zeit s", "displacement_mm": "Weg mm", "force_N": "Kraft N"}
    assert parse_config(made.text, "rig.toml").trace.header_lines == 2


def test_a_column_of_times_of_day_is_not_empty(tmp_path):
    for one in exports.records(days=(4,), speeds=SPEEDS, repeats=(1,)):
        rows = zip(*exports.slots(one), strict=True)
        lines = [
            f"{one.started + timedelta(seconds=float(t)):%H:%M:%S.%f};{x:.4f};{f:.4f}" for t, x, f in rows
        ]
        exports.write(tmp_path, f"d4_v{one.speed:g}.csv", "\n".join(["Uhrzeit;Weg [mm];Kraft [N]", *lines]))
    trace = parse_config(draft(tmp_path).text, "rig.toml").trace
    assert (trace.columns["time_s"].name, trace.other_columns) == ("Uhrzeit", "channels")


def test_a_set_point_is_left_for_what_was_measured(tmp_path):
    def columns(one):
        return [one.time_s, one.displacement_mm, one.displacement_mm, one.force_N]

    made = campaign(tmp_path, columns, "Zeit [s],Istweg [mm],Sollweg [mm],Kraft [N]\n")
    assert slots(made)["displacement_mm"] == "Istweg [mm]"


# ---------------------------------------------------------------- dialect
SEPARATORS = {
    "german_daq": ";", "nested": "tab", "labview": "tab", "catman": "tab", "dasylab": ";", "hbm": "tab",
    "instron": ",", "zwick": ";", "mts": "tab", "tribometer": ",", "benchvue": ",", "matlab": ",",
    "excel_german": ";", "excel_us": ",",
}  # fmt: skip


@pytest.mark.parametrize("name", SEPARATORS)
def test_the_separator_is_found_with_the_header_and_without(name, tmp_path):
    file = min(exports.EXPORTS[name](tmp_path))
    lines = as_utf8((tmp_path / file).read_bytes(), "auto").decode().split("\n")
    assert sniff("\n".join(lines[:60])).delimiter == SEPARATORS[name]
    assert sniff("\n".join(lines[60:100])).delimiter == SEPARATORS[name]


def text_of(delimiter, comma=False, header="t x F\n"):
    (one,) = exports.records(days=(1,), speeds=(5.0,), repeats=(1,))
    return header.replace(" ", delimiter) + exports.table(exports.slots(one), delimiter, 3, comma)


@pytest.mark.parametrize(
    ("delimiter", "comma", "found", "decimal"),
    [
        (",", False, ",", "."), (";", False, ";", "."), (";", True, ";", ","), ("\t", True, "tab", ","),
        ("|", False, "|", "."), ("   ", False, "whitespace", "."), (" ", True, "whitespace", ","),
    ],
)  # fmt: skip
def test_separator_and_decimal_sign(delimiter, comma, found, decimal):
    dialect = sniff(text_of(delimiter, comma))
    assert (dialect.delimiter, dialect.decimal) == (found, decimal)
    assert dialect.names == ("t", "x", "F")


def test_whole_numbers_do_not_show_the_decimal_sign():
    dialect = sniff("a;b\n" + "\n".join(f"{i};{2 * i}" for i in range(20)))
    assert (dialect.delimiter, dialect.decimal) == (";", "")


def test_a_table_of_results_above_the_data_is_header():
    dialect = sniff("Max;F\n1;2,5\n2;3,5\n\n" + text_of(";", comma=True))
    assert len(dialect.header) == 5
    assert dialect.names == ("t", "x", "F")


@pytest.mark.parametrize("text", ["", "a\n", "only words\n" * 30, "1\n2\n3\n" * 20, "1,2\n3,4\n"])
def test_no_table_of_numbers(text):
    assert sniff(text) is None


# ---------------------------------------------------------------- odd files
def test_letters_above_the_data_are_names_and_no_units(tmp_path):
    made = campaign(
        tmp_path, lambda one: [one.time_s, one.displacement_mm, one.force_N], "t,s,F\n", strokes=4
    )
    assert slots(made) == {"time_s": "t", "displacement_mm": "s", "force_N": "F"}


def test_units_above_the_data_are_no_names(tmp_path):
    made = campaign(
        tmp_path, lambda one: [one.time_s, one.displacement_mm, one.force_N], "ms,mm,N\n", strokes=4
    )
    assert slots(made) == {"time_s": 1, "displacement_mm": 2, "force_N": 3}
    assert parse_config(made.text, "rig.toml").trace.columns["time_s"].unit == "ms"


def test_decimal_commas_in_quotes_are_read_between_commas(tmp_path):
    (one,) = exports.records(days=(4,), speeds=(5.0,), repeats=(1,), strokes=2)
    columns = (one.time_s, one.displacement_mm, one.force_N)
    rows = [
        ",".join(f'"{value:.4f}"'.replace(".", ",") for value in row) for row in zip(*columns, strict=True)
    ]
    exports.write(tmp_path, "d4_v5.csv", "\n".join(['"Zeit [s]","Weg [mm]","Kraft [N]"', *rows, ""]))
    made = draft(tmp_path)
    config = parse_config(made.text, "rig.toml")
    assert (config.trace.delimiter, config.trace.decimal) == (",", ",")
    read = read_trace(tmp_path, TraceRef("d4_v5.csv", {}), config)
    np.testing.assert_allclose(read.columns["force_N"], one.force_N, atol=1e-4)


def test_a_time_that_runs_back_in_one_file_is_the_time(tmp_path):
    for one in exports.records(days=(4,), speeds=SPEEDS, repeats=(1, 2, 3), strokes=2):
        time = one.time_s[::-1] if one.speed == 5.0 and one.repeat == 3 else one.time_s
        body = exports.table([time, one.displacement_mm, one.force_N], ",", 5)
        exports.write(
            tmp_path, f"d{one.days}_v{one.speed:g}_{one.repeat}.csv", "time [s],x [mm],force [N]\n" + body
        )
    assert slots(draft(tmp_path))["time_s"] == "time [s]"


def test_a_table_of_runs_may_have_a_title_and_weights(tmp_path):
    lines = ["Versuchsplan 2025;;;", ";;;", "Datei;Alterung [d];Vorschub [mm/s];Gewicht [kg]"]
    for one in exports.records(days=(4, 8), speeds=SPEEDS, repeats=(1,), strokes=2):
        columns = [one.time_s, one.displacement_mm, one.force_N]
        exports.write(tmp_path, f"M{one.number}.csv", "t [s],x [mm],F [N]\n" + exports.table(columns, ",", 5))
        lines.append(f"M{one.number};{one.days};{one.speed:g};5")
    exports.write(tmp_path, "Plan.csv", "\n".join([*lines, ""]))
    config = parse_config(draft(tmp_path).text, "rig.toml")
    columns = {ours: (column.name, column.unit) for ours, column in config.files.runs_columns.items()}
    assert columns["load_N"] == ("Gewicht [kg]", "kgf")
    assert columns["aging_days"][0] == "Alterung [d]"


def test_a_title_of_known_words_is_no_line_of_names(tmp_path):
    header = "# friction rig v2\n# t [s]  x [mm]  F [N]\n"
    made = campaign(tmp_path, lambda one: [one.time_s, one.displacement_mm, one.force_N], header, 2, " ")
    assert slots(made) == {"time_s": 1, "displacement_mm": 2, "force_N": 3}


def test_a_table_of_results_above_the_names_is_no_line_of_names(tmp_path):
    results = '"","Static COF","Max Load (lbf)"\n"1","0.512","3.22"\n'
    header = results + '"Time","Extension","Load"\n"(s)","(mm)","(N)"\n'
    made = campaign(tmp_path, lambda one: [one.time_s, one.displacement_mm, one.force_N], header, 2)
    assert slots(made) == {"time_s": "Time", "displacement_mm": "Extension", "force_N": "Load"}
