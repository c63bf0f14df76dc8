import numpy as np
import pytest
from trace_helpers import HEADER, ROWS, campaign, channels, config, csv_of, faults, read, refused, trace

from sealfit.errors import ConfigError
from sealfit.units import UNITS, conversion, other_unit, unit_of

BY_HAND = [  # (unit, ours, number, the number in our unit)
    ("kgf", "N", 5.0, 49.03325),  # standard gravity, 9.80665 m/s2
    ("lbf", "N", 1.0, 4.4482216152605),  # 0.45359237 kg
    ("kN", "N", 0.25, 250.0),
    ("in", "mm", 2.0, 50.8),
    ("um", "mm", 1500.0, 1.5),
    ("mm/min", "mm/s", 300.0, 5.0),
    ("ms", "s", 20.0, 0.02),
    ("degF", "°C", 140.0, 60.0),
    ("K", "°C", 333.15, 60.0),
    ("h", "d", 96.0, 4.0),
    ("N*m", "mN m", 0.5, 500.0),
    ("N*mm", "Nm", 500.0, 0.5),
    ("kNm", "Ncm", 0.5, 50000.0),
    ("mNm", "Nmm", 0.5, 0.5),
    ("1", "%", 0.8, 80.0),
]


@pytest.mark.parametrize(("unit", "ours", "number", "expected"), BY_HAND)
def test_numbers_are_converted_to_our_unit(unit, ours, number, expected):
    assert conversion(unit, ours).of_cell(number) == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(conversion(unit, ours)(np.array([number, number])), expected, rtol=1e-12)


def test_columns_of_a_trace(tmp_path):
    rig = """[trace.columns]
time_s = {unit = "ms"}
displacement_mm = {name = "Weg", unit = "in"}
force_N = {name = "Kraft", unit = "kgf"}
oven_C = {name = "T", unit = "degF"}
oil = {name = "p", unit = "psi"}
"""
    rows = [f"{100 * i},{0.1 * i:.1f},{2 + 0.01 * i:.2f},140,{10 + i}" for i in range(100)]
    found = read(tmp_path, csv_of(rows, "time_s,Weg,Kraft,T,p"), rig).columns
    np.testing.assert_allclose(found["time_s"], 0.1 * np.arange(100), atol=1e-12)
    np.testing.assert_allclose(found["displacement_mm"], 2.54 * np.arange(100), atol=1e-9)
    np.testing.assert_allclose(found["force_N"], 9.80665 * (2 + 0.01 * np.arange(100)), rtol=1e-12)
    np.testing.assert_allclose(found["oven_C"], 60.0, rtol=1e-12)
    np.testing.assert_array_equal(
        found["oil"], 10.0 + np.arange(100)
    )  # the campaign's own: it keeps its unit
    units = config(rig).units
    assert (units.label("force_N"), units.label("oil")) == ("friction force (N)", "oil (psi)")


def test_a_slot_of_another_quantity_is_converted_to_its_declared_unit(tmp_path):
    rig = """[quantities]
force = {quantity = "torque", unit = "mN m"}
[trace.columns]
time_s = "time_s"
displacement_mm = "displacement_mm"
force_N = {unit = "N*m"}
"""
    found = read(tmp_path, csv_of(ROWS), rig).columns
    np.testing.assert_allclose(found["force_N"], 1000 * (2 + 0.01 * np.arange(100)), rtol=1e-12)


def test_a_column_of_words_has_no_unit(tmp_path):
    rig = (
        "[trace.columns]\ntime_s = 1\ndisplacement_mm = 2\nforce_N = 3\n"
        'oil_bar = {name = "p", unit = "psi"}\n'
    )
    fault = refused(tmp_path, csv_of([f"{row},low" for row in ROWS], f"{HEADER},p"), rig)
    assert (fault.line, fault.column) == (1, "oil_bar")
    assert "holds no numbers" in fault.reason


TABLE = "file,T,h,load_N,v\na.csv,140,96,5,300\nb.csv,140,192,5,300\nc.csv,140,384,5,300"
RUNS = """condition = ["temperature_C", "aging_days"]
[files.runs_columns]
temperature_C = {name = "T", unit = "degF"}
aging_days = {name = "h", unit = "h"}
load_N = {unit = "kgf"}
speed_mm_s = {name = "v", unit = "mm/min"}
"""


def test_columns_of_runs_csv(tmp_path):
    found = channels(campaign(tmp_path, TABLE), RUNS)
    assert [ref["aging_days"] for ref in found.values()] == [4.0, 8.0, 16.0]
    assert {(ref["temperature_C"], ref["load_N"], ref["speed_set_mm_s"]) for ref in found.values()} == {
        (60.0, 49.03325, 5.0)
    }


def test_a_cell_that_is_no_number_is_told_as_it_stands(tmp_path):
    (fault,) = faults(campaign(tmp_path, TABLE.replace("a.csv,140,96", "a.csv,140,4 days")), RUNS)
    assert (fault.file, fault.line, fault.column, fault.value) == ("runs.csv", 2, "aging_days", "4 days")


@pytest.mark.parametrize(
    "rest",
    [
        'name_pattern = "T(?P<temperature_C>\\\\d+)_(?P<aging_days>\\\\d+)h[.]csv"\n'
        'units = {temperature_C = "degF", aging_days = "h"}',
        'name_pattern = "T(?P<_T>\\\\d+)_(?P<_t>\\\\d+)h[.]csv"\nunits = {_T = "degF", _t = "h"}\n'
        'columns = {temperature_C = "{_T}"}\ncompute = {aging_days = "_t"}',
        'name_pattern = "T(?P<_T>\\\\d+)_(?P<_t>\\\\d+)h[.]csv"\n'
        'units = {temperature_C = "degF", aging_days = "h"}\n'
        'columns = {temperature_C = "{_T}"}\ncompute = {aging_days = "_t + 0"}',
    ],
    ids=["parts", "copies", "columns"],
)
def test_parts_of_file_names(tmp_path, rest):
    trace(tmp_path, "T140_96h.csv")
    rig = f'condition = ["temperature_C", "aging_days"]\n[files]\nglob = "*.csv"\n{rest}\n'
    (found,) = channels(tmp_path, rig).values()
    assert (found["temperature_C"], found["aging_days"]) == (60.0, 4.0)


@pytest.mark.parametrize(
    ("column", "unit", "said"),
    [
        (
            "force_N",
            "kg",
            r"trace.columns.force_N: the unit 'kg' is one of mass; force \(N\) .* mean 'kgf'\?",
        ),
        ("force_N", "g", r"one of mass; force \(N\) is expected. Did you mean 'gf'\?"),
        ("displacement_mm", "mm/s", r"one of speed; length \(mm\) is expected. Did you mean 'mm'\?"),
        ("oven_C", "C", r"temperature \(°C\) is expected. Did you mean 'degC'\?"),
        ("oven_C", "F", r"temperature \(°C\) is expected. Did you mean 'degF'\?"),
        ("force_N", "kgff", r"'kgff' is no known unit; force \(N\) is expected. Did you mean 'kgf'\?"),
        ("force_N", "N-", r"'N-' is no known unit"),
        ("force_N", "mm/kg", r"the unit 'mm/kg' is one of length / mass; force \(N\) is expected."),
        ("displacement_mm", "MM", r"'MM' is .* length \(mm\) is expected. Did you mean 'mm'\?"),
    ],
)
def test_units_that_cannot_be_meant_are_refused(column, unit, said):
    with pytest.raises(ConfigError, match=said):
        config(f'[trace.columns]\n{column} = {{name = "x", unit = "{unit}"}}\n')


def test_a_torque_is_no_force():
    with pytest.raises(
        ConfigError, match=r"files.units.load_N: the unit 'N\*m' is one of torque; force \(N\)"
    ):
        config('[files.units]\nload_N = "N*m"\n')


def test_a_misspelt_key_of_a_column_is_named():
    with pytest.raises(ConfigError, match=r"unknown key 'trace.columns.force_N.units'"):
        config('[trace.columns]\nforce_N = {name = "F", units = "kgf"}\n')


@pytest.mark.parametrize(
    ("header", "settings", "column", "fix"),
    [
        ("t [s],x [mm],F [kN]", 'force_N = "F [kN]"', "F [kN]", 'unit = "kN"} under [trace.columns].'),
        ("t [s],x [mm],F [kg]", "force_N = 3", "F [kg]", 'unit = "kgf"} under [trace.columns].'),
        ("t [s],x [mm],F [V]", 'force_N = "F [V]"', "F [V]", "compute force_N from it."),
        ("t [s],x [mm],F [kN]\n-,-,-", "force_N = 3", "F [kN]", 'unit = "kN"} under [trace.columns].'),
        ("t,x,F\ns,mm,kN", 'force_N = "F"', "F", 'unit = "kN"} under [trace.columns].'),
        ("t [s],x [mm],F [kN]", 'force_N = {name = "F [kN]", unit = "kN"}', None, ""),
        ("t [s],x [mm],F [kg]", 'force_N = {name = "F [kg]", unit = "kgf"}', None, ""),
        ("t [sec],x (s),F [left]", 'force_N = "F [left]"', None, ""),
    ],
)
def test_a_unit_of_the_header_that_is_not_the_config_s_is_a_warning(tmp_path, header, settings, column, fix):
    text = f"trace.units_row = {str(chr(10) in header).lower()}\n[trace.columns]\n"
    text += f"time_s = 1\ndisplacement_mm = 2\n{settings}\n"
    found = read(tmp_path, csv_of(ROWS, header), text).faults
    assert [(fault.check, fault.column, fault.action) for fault in found] == (
        [("unit", column, "kept")] if column else []
    )
    assert all(
        fault.fix.startswith("If the header is right, ") and fault.fix.endswith(fix) for fault in found
    )


def test_times_of_day_are_in_seconds_whatever_the_header_says(tmp_path):
    rows = [f"12:00:{i:02d}.5,{i},2" for i in range(60)]
    text = 'trace.columns = {time_s = "Zeit [h]", displacement_mm = 2, force_N = 3}'
    assert read(tmp_path, csv_of(rows, "Zeit [h],x [mm],F [N]"), text).faults == ()


def test_units_as_a_draft_writes_them_are_those_of_the_header():
    slots = ("time", "length", "force", "torque", "angle")
    texts = [text for text, unit in UNITS.items() if unit.dimension in slots]
    spelled = {way(text) for text in texts for way in (str, str.upper, str.lower, str.title)} - {"u"}
    said = {text: unit.name for text in spelled if (unit := unit_of(text)) is not None}
    assert {text for text, unit in said.items() if other_unit(text, unit) is not None} == set()
    assert [other_unit(text, "N") for text in ("kN", "G", "MN")] == ["kN", "gf", "MN"]


@pytest.mark.parametrize("form", ["(N)", "[N]", "N"])
def test_a_row_of_units_may_have_brackets_and_counts_for_columns_of_the_campaign_too(tmp_path, form):
    rows = [f"s,mm,{form}", *ROWS]
    rig = "trace.units_row = true\n[trace.columns]\ntime_s = 'time_s'\ndisplacement_mm = 'displacement_mm'\n"
    for name, unit, said in (("force_N", "lbf", 1), ("force_raw_N", "kN", 1), ("force_N", "N", 0)):
        own = rig + f"{name} = {{name = 'force_N', unit = '{unit}'}}\n"
        own += "[trace.compute]\nforce_N = '-force_raw_N'\n" if name != "force_N" else ""
        found = read(tmp_path, csv_of(rows), own).faults
        assert [f.check for f in found] == ["unit"] * said
        assert all(f"says 'N', and the config takes the numbers in {unit}" in f.reason for f in found)


@pytest.mark.parametrize(
    ("line", "warned"),
    [
        ('# "Normal load","111.2","N"', True),
        ('# "Normal load","25.00","lbf"', False),
        ("# Normal load: 25.00", False),
        ("# Normal load: 25.00 in the oven", False),
        ("# Normal load: 111.2 [N]", True),
    ],
)
def test_a_header_line_with_another_unit_is_a_warning(tmp_path, line, warned):
    rig = "trace.header_lines = 2\nfiles.units.load_N = 'lbf'\n"
    rig += "trace.header_fields.load_N = 'Normal load\\W*([\\d.]+)'\n"
    found = read(tmp_path, f"{line}\n{csv_of(ROWS)}", rig).faults
    assert [f.check for f in found] == ["unit"] * warned
    assert not warned or "the header line says 'N', and the config takes the number in lbf" in found[0].reason
