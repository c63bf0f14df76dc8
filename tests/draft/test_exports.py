"""The draft of a config reads what others' programs export, without an edit."""

import re
from datetime import timedelta
from functools import cache
from itertools import product
from pathlib import Path

import exports
import numpy as np
import numpy.testing as npt
import pytest

from sealfit.config import parse_config
from sealfit.draft import draft
from sealfit.draft.dialect import settings_in, started_in
from sealfit.ingest.campaign import ingest_campaign
from sealfit.ingest.columns import TraceRef
from sealfit.ingest.reader import read_trace

ROUNDED = 6e-4  # s, mm, N: the coarsest export writes three decimals

ALL = ("temperature_C", "compression_ratio_pct", "aging_days", "speed_set_mm_s", "repeat")
NO_COMPRESSION = ("temperature_C", "aging_days", "speed_set_mm_s", "repeat")
SPECIMENS = ("temperature_C", "compression_ratio_pct", "aging_days", "speed_set_mm_s")
TELLS = {  # what is to be found of each file; all of it where nothing else is said
    "dasylab": NO_COMPRESSION,
    "mts": NO_COMPRESSION,
    "instron": SPECIMENS,
    "zwick": SPECIMENS,
    "excel_german": (*ALL, "load_N", "started_at"),
    "matlab": (*ALL, "started_at"),
    "german_daq": (*ALL, "load_N"),
}


def wanted(one: exports.Record) -> dict:
    return {
        "temperature_C": one.temperature,
        "compression_ratio_pct": one.compression,
        "aging_days": one.days,
        "speed_set_mm_s": one.speed,
        "repeat": one.repeat,
        "load_N": 50.0,
        "started_at": str(one.started),
    }


def read(folder: Path):
    made = draft(folder)
    config = parse_config(made.text, "rig.toml")
    return made, config, ingest_campaign(folder, config)


def assert_settings(ingested, written, names):
    runs = ingested.tables["runs"]
    assert set(runs["file"]) == set(written)
    assert runs["used"].all()
    for row in runs.to_dict("records"):
        told = wanted(written[row["file"]])
        for name in names:
            if isinstance(told[name], str):
                assert row[name].replace("T", " ") == told[name]
            else:
                assert row[name] == pytest.approx(told[name], rel=1e-5), (row["file"], name)


def assert_values(folder, config, written):
    for file in (min(written), max(written)):
        one = written[file]
        table = read_trace(folder, TraceRef(file, {}), config).table
        npt.assert_allclose(table["time_s"], one.time_s, atol=ROUNDED)
        npt.assert_allclose(table["displacement_mm"], one.displacement_mm, atol=ROUNDED)
        npt.assert_allclose(table["force_N"], one.force_N, atol=ROUNDED)


@pytest.fixture(scope="module")
def export(tmp_path_factory):
    """Return by name the folder of an export, what was written, the draft, the config, and what is read."""

    @cache
    def made(name):
        folder = tmp_path_factory.mktemp(name)
        written = exports.EXPORTS[name](folder)
        return folder, written, *read(folder)

    return made


@pytest.mark.parametrize("name", exports.EXPORTS)
def test_the_draft_reads_an_export(name, export):
    folder, written, _, config, ingested = export(name)
    assert_values(folder, config, written)
    assert_settings(ingested, written, TELLS.get(name, ALL))
    assert set(ingested.tables["inputs"]["status"]) == {"used"}


@pytest.mark.parametrize("name", sorted(set(exports.EXPORTS) - {"excel_us"}))
def test_the_draft_leads_to_no_fault(name, export):
    *_, ingested = export(name)
    assert [str(fault) for fault in ingested.faults] == []


@pytest.mark.parametrize(("name", "footer"), [("excel_german", None), ("excel_us", "Average")])
def test_lines_below_the_data_are_named_by_how_they_begin(name, footer, export):
    _, _, made, config, ingested = export(name)
    assert config.trace.footer == footer
    assert not any("end in lines that are no data" in doubt.reason for doubt in made.doubts)
    assert not ingested.faults


# ---------------------------------------------------------------- what single exports need
def test_dates_in_names_are_read(tmp_path):
    written = exports.german_daq(tmp_path, dates="names")
    made, _, ingested = read(tmp_path)
    assert_settings(ingested, written, (*ALL, "load_N", "started_at"))
    assert len(written) == 84
    assert made.doubts == ()


def test_a_date_whose_order_is_not_sure_is_a_doubt():
    when = started_in([["Date\t03/02/2024 09:19:33"], ["Date\t04/02/2024 10:19:33"]])
    assert (when.format, when.sure) == ("%m/%d/%Y %H:%M:%S", False)
    assert started_in([["Date\t03.02.2024 09:19:33"]]).sure


@pytest.mark.parametrize(
    ("dates", "order"),
    [(("03/14/2024", "03/02/2024"), "%m/%d/%Y"), (("03/02/2024", "14/03/2024"), "%d/%m/%Y")],
)
def test_the_order_of_day_and_month_is_the_one_that_fits_all_files(dates, order):
    lines = [f"Date\t{date} 09:19:33.25" for date in dates]
    when = started_in([(line,) for line in lines])
    assert (when.format, when.sure) == (f"{order} %H:%M:%S", True)
    assert [re.search(when.pattern, line)[1] for line in lines] == [f"{date} 09:19:33" for date in dates]


@pytest.mark.parametrize(
    ("name", "date_format"),
    [
        ("labview", "%Y/%m/%d %H:%M:%S"),
        ("catman", "%d.%m.%Y %H:%M:%S"),
        ("dasylab", "%d.%m.%Y %H:%M:%S"),
        ("mts", "%m/%d/%Y %I:%M:%S %p"),
        ("benchvue", "%m/%d/%Y %H:%M:%S"),
    ],
)
def test_the_format_of_a_date_in_the_header_is_found(name, date_format, tmp_path):
    written = exports.EXPORTS[name](tmp_path)
    made, _, ingested = read(tmp_path)
    assert f"date_format = '{date_format}'" in made.text
    assert not any("header line" in doubt.reason for doubt in made.doubts)
    assert_settings(ingested, written, ("started_at",))


@pytest.mark.parametrize(
    ("oven", "found"),
    [
        (("Lagerung [°C];RT", "Lagerung [°C];70"), ("RT", "70")),
        (("Lagerung [°C];70", "Lagerung [°C];rt;"), ("70", "rt")),
        (("Lagerung [°C];70;\nOfentemp. [°C];71", "Lagerung [°C];100\nOfentemp. [°C];101"), ("71", "101")),
    ],
)
def test_a_header_line_of_the_oven_gives_the_temperature_of_unaged_rubber_in_a_word(oven, found):
    headers = [f"{line}\nLagerdauer [Tage];4".split("\n") for line in oven]
    settings = {one.ours: one for one in settings_in(headers, ",")}
    assert settings["temperature_C"].values == found
    assert settings["aging_days"].values == ("4", "4")


def test_a_word_for_unaged_rubber_stands_in_the_line_of_the_days():
    (days,) = settings_in([["Aged: 4 days"], ["Aged: new"], ["Aged: 0.5 days"]], ".")
    assert (days.ours, days.unit.name, days.values) == ("aging_days", "d", ("4", "new", "0.5"))


def test_a_compression_of_20_is_taken_as_a_height_of_80_and_said(tmp_path):
    exports.nested(tmp_path)
    made = draft(tmp_path)
    assert "compression_ratio_pct = '100 - _compression'" in made.text
    assert any("how much the rubber was compressed" in doubt.reason for doubt in made.doubts)


def test_pieces_of_rubber_are_numbered_within_their_condition(tmp_path):
    written = exports.zwick(tmp_path)
    _, _, ingested = read(tmp_path)
    runs = ingested.tables["runs"]
    assert runs["specimen_id"].nunique() == 3 * 2  # days, pieces
    assert len(runs) == len(written) == 12


def test_a_force_of_the_other_sign_is_turned(tmp_path):
    exports.dasylab(tmp_path)
    made, config, ingested = read(tmp_path)
    steady = ingested.tables["steady"]
    assert (np.sign(steady["force_N"]) == steady["direction"]).all()
    assert config.trace.compute == {"force_N": "-force_raw_N"}
    assert made.motion == "about 4 strokes in a file, both ways"


def test_a_load_counted_downwards_is_turned_and_a_ratio_is_no_channel(tmp_path):
    written = exports.tribometer(tmp_path)
    _, config, _ = read(tmp_path)
    table = read_trace(tmp_path, TraceRef(min(written), {}), config).table
    npt.assert_allclose(table["load_N"], written[min(written)].further["load"], atol=ROUNDED)
    assert list(table) == ["time_s", "displacement_mm", "force_N", "load_N"]


def test_headers_of_different_lengths_end_at_a_line(tmp_path):
    exports.mts(tmp_path)
    config = parse_config(draft(tmp_path).text, "rig.toml")
    assert config.trace.header_ends_at == r"^Sec\tmm\tN\tsegments"
    assert config.trace.header_lines is None


def test_units_of_columns_are_named_in_the_config(tmp_path):
    exports.hbm(tmp_path)
    trace = parse_config(draft(tmp_path).text, "rig.toml").trace
    units = {name: column.unit for name, column in trace.columns.items()}
    assert units == {"time_s": "ms", "displacement_mm": "um", "force_N": "kN"}
    assert (trace.compute, trace.drop_columns) == ({}, None)


def test_settings_and_dates_in_the_header_are_enough(tmp_path):
    written = {}
    for one in exports.records(temperatures=(60, 80)):
        head = (
            f"Test: friction\nDate: {one.started}\nAging temperature: {one.temperature} °C\n"
            f"Aging time: {24 * one.days} h\nCompression: {one.compression} %\n"
            f"Speed: {60 * one.speed:g} mm/min\n"
            "Normal load: 50 N\n\nt [s]\tx [mm]\tF [N]\n"
        )
        file = f"test{one.number:04d}.txt"
        exports.write(tmp_path, file, head + exports.table(exports.slots(one), "\t", 4))
        written[file] = one
    made, config, ingested = read(tmp_path)
    assert made.doubts == ()
    assert_values(tmp_path, config, written)
    assert_settings(ingested, written, (*SPECIMENS, "repeat", "load_N", "started_at"))
    assert ingested.faults == []


@pytest.mark.parametrize(
    ("key", "pieces", "told"),
    [("Probe", "AB", True), ("Sample ID", "ABCD", True), ("Probe", "A", False), ("Sample rate", "AB", False)],
)
def test_specimens_in_the_header(key, pieces, told, tmp_path):
    for i, one in enumerate(exports.records(days=(1,), speeds=(1.0, 5.0))):
        head = f"{key}: {pieces[i % len(pieces)]}\nt [s],x [mm],F [N]\n"
        file = f"{one.days}d_{one.speed:g}mms_r{one.repeat}.csv"
        exports.write(tmp_path, file, head + exports.table(exports.slots(one), ",", 4))
    made, _, ingested = read(tmp_path)
    assert set(ingested.tables["runs"]["specimen_id"]) == (set(pieces) if told else {"aging_days=1"})
    assert any("a specimen of its own" in doubt.reason for doubt in made.doubts) == (pieces == "ABCD")


def test_rubbers_directions_and_decimal_commas_in_names(tmp_path):
    written = {}
    for one in exports.records(speeds=(0.5, 5.0)):
        for rubber, (word, sign) in (("NBR", ("vor", 1)), ("FKM", ("rueck", -1))):
            speed = f"{one.speed:g}".replace(".", ",")
            file = f"{rubber}/{one.days} Tage/{one.temperature}C_v{speed}_{word}_{one.repeat}.txt"
            columns = [one.time_s, sign * one.displacement_mm, sign * one.force_N]
            exports.write(
                tmp_path, file, "Zeit s;Weg mm;Kraft N\n" + exports.table(columns, ";", 4, comma=True)
            )
            written[file] = one
    _, config, ingested = read(tmp_path)
    assert config.rubber == ["rubber"]
    assert_settings(ingested, written, NO_COMPRESSION)
    runs = ingested.tables["runs"]
    assert (runs["direction"] == runs["file"].str.contains("vor").map({True: 1, False: -1})).all()
    assert (runs["rubber"] == runs["file"].str[:3]).all()


@pytest.mark.parametrize("name", exports.EXPORTS)
def test_every_guess_has_its_evidence_above_it(name, export):
    made = export(name)[2]
    lines = made.text.splitlines()
    assert all(guess.evidence for guess in made.guesses)
    for number, line in enumerate(lines):
        if " = " in line and not line.startswith(("#", "name =")):
            assert lines[number - 1].startswith("# "), line


@pytest.mark.parametrize(("angle", "turn"), [("Winkel [deg]", 360.0), ("revolutions [rev]", 1.0)])
def test_a_rotating_rig_with_two_loads_needs_no_edit(angle, turn, tmp_path):
    """The displacement is an angle, the force a torque; a run is a rubber at one load and speed."""
    rng = np.random.default_rng(0)
    for rubber, load, rpm, repeat in product(("NBR", "FKM"), (20, 40), (2, 20), (1, 2)):
        turns = np.linspace(0.0, 3.0, 400)
        torque = 0.02 * load * (1 - np.exp(-turns / 0.01)) + 0.002 * rng.normal(size=400)
        rows = zip(60.0 * turns / rpm, turn * turns, torque, strict=True)
        lines = [f"time [s],{angle},torque [N*m]", *(f"{t:.4f},{x:.5f},{m:.5f}" for t, x, m in rows)]
        (tmp_path / f"{rubber}_{load}N_{rpm}rpm_{repeat}.csv").write_text("\n".join(lines) + "\n")
    made, config, ingested = read(tmp_path)
    assert config.units.label("displacement_mm").startswith("angle (")
    assert config.units.label("force_N") == "torque (N m)"
    assert any("set turn" in doubt.fix for doubt in made.doubts)
    assert f"turn = {turn:g}" in made.text
    runs = ingested.tables["steady"].groupby("run_id")["speed_mm_s"].first()
    assert len(runs) == 8  # of a rubber, a load and a speed
    assert sorted(runs.round(1).unique()) == [2.0, 20.0]  # in rpm
    assert set(ingested.tables["runs"]["speed_set_mm_s"]) == {2.0, 20.0}  # and no channel beside it
    assert list(ingested.faults) == []


@pytest.mark.parametrize(
    ("unit", "said"),
    [("daN", None), ("ozf", "'Kraft' has the unit 'ozf', which is not known here; N is assumed")],
)
def test_a_unit_below_the_name_is_used_or_named_in_a_doubt(unit, said, tmp_path):
    for one in exports.records(speeds=(5.0,)):
        head = f"Zeit;Weg;Kraft\ns;mm;{unit}\n"
        exports.write(
            tmp_path, f"T80_d{one.days}_r{one.repeat}.csv", head + exports.table(exports.slots(one), ";", 4)
        )
    made, config, _ = read(tmp_path)
    assert config.trace.columns["force_N"].unit == (None if said else unit)
    assert [doubt.reason for doubt in made.doubts if "Kraft" in doubt.reason] == (
        [f"column 3 {said}."] if said else []
    )


def test_settings_in_a_header_of_comments_are_read(tmp_path):
    written = {}
    for one in exports.records():
        head = f"# temperature = {one.temperature} degC\n# aged = {one.days} days\n# compression = 80 %\n"
        file = f"{one.started:%Y%m%d-%H%M%S}.dat"
        body = exports.table(exports.slots(one), " ", 4)
        exports.write(tmp_path, file, f"{head}# t[s] x[mm] F[N]\n{body}")
        written[file] = one
    made, _, ingested = read(tmp_path)
    assert made.doubts == ()
    assert_settings(ingested, written, ("temperature_C", "compression_ratio_pct", "aging_days", "started_at"))


def test_properties_of_a_tdms_channel_are_no_settings_of_the_file():
    header = ("Group/LoadCell/wf_increment\t0.14", "Group/Speed/gain\t2", "Load [N]\t50", "Speed [mm/s]\t5")
    assert [(one.ours, one.line) for one in settings_in([header], ".")] == [("load_N", 3), ("speed_mm_s", 4)]


def test_times_of_day_are_found_as_the_time(tmp_path):
    for name, one in zip("ab", exports.records(days=(1,), speeds=(1.0, 5.0), repeats=(1,)), strict=True):
        times = [(one.started + timedelta(seconds=float(t))).isoformat(" ") for t in one.time_s]
        rows = zip(times, one.displacement_mm, one.force_N, strict=True)
        lines = ["Timestamp,Position [mm],Force [N]", *(f"{t},{x:.5f},{f:.5f}" for t, x, f in rows)]
        (tmp_path / f"{name}.csv").write_text("\n".join(lines) + "\n")
    made, config, _ = read(tmp_path)
    assert not any("there is no time" in doubt.reason for doubt in made.doubts)
    table = read_trace(tmp_path, TraceRef("b.csv", {}), config).table
    npt.assert_allclose(table["time_s"], one.time_s, atol=1e-5)


@pytest.mark.parametrize(
    ("line", "rate"),
    [
        ("Abtastrate: {:g} Hz", 40.0),
        ("Sampling Rate [kHz];{:g}", 0.04),
        ("Sample interval (ms);{:g}", 25.0),
        ("Delta_X;{:.6E}", 0.025),
    ],
)
def test_without_a_time_the_rate_of_the_header_gives_it(line, rate, tmp_path):
    for one in exports.records(speeds=(5.0,)):
        columns = exports.table([one.displacement_mm, one.force_N], ";", 4)
        head = f"Rig 7;\nTest frequency: 2 Hz;\n{line.format(rate)}\nWeg [mm];Kraft [N]\n"
        exports.write(tmp_path, f"T80_d{one.days}_r{one.repeat}.txt", head + columns)
    made, config, ingested = read(tmp_path)
    assert f"'{line.format(rate)}'" in {g.key: g.evidence for g in made.guesses}["trace.rate_Hz"]
    assert config.trace.rate_Hz == 40.0
    assert not any("time" in doubt.reason for doubt in made.doubts)
    assert ingested.tables["runs"]["used"].all()


@pytest.mark.parametrize(
    ("line", "scale", "rate"),
    [
        ("Abtastrate [kHz]: {:.9g}", 0.001, "1000 * _rate"),
        ("Delta_X (ms);{:.9g}", None, "1 / (0.001 * _rate)"),
    ],
)
def test_of_files_of_different_rates_the_header_gives_each_its_own(line, scale, rate, tmp_path):
    for one in exports.records():
        step = one.time_s[1]
        columns = exports.table([one.displacement_mm, one.force_N], ";", 4)
        head = line.format(scale / step if scale else 1000 * step) + "\nWeg [mm];Kraft [N]\n"
        exports.write(tmp_path, f"T80_d{one.days}_v{one.speed:g}_r{one.repeat}.txt", head + columns)
    made, config, ingested = read(tmp_path)
    assert config.trace.rate_Hz == rate
    assert not any("time" in doubt.reason for doubt in made.doubts)
    runs = ingested.tables["runs"]
    assert runs["used"].all()
    assert "_rate" not in runs
    npt.assert_allclose(runs["speed_mm_s"].abs(), runs["speed_set_mm_s"], rtol=0.02)


def test_files_of_which_one_has_no_rate_are_a_doubt_that_names_the_key(tmp_path):
    for k, one in enumerate(exports.records()):
        columns = exports.table([one.displacement_mm, one.force_N], ";", 4)
        head = f"{'Abtastrate' if k else 'Pause'}: {1 / one.time_s[1]:g} Hz\nWeg [mm];Kraft [N]\n"
        exports.write(tmp_path, f"T80_d{one.days}_v{one.speed:g}_r{one.repeat}.txt", head + columns)
    (doubt,) = (one for one in draft(tmp_path).doubts if "there is no time" in one.reason)
    assert "rate_Hz" in doubt.fix


@pytest.mark.parametrize(("mark", "decimal"), [(".", ","), ("'", "."), (" ", ",")])
def test_marks_between_thousands_are_named_with_what_to_do(mark, decimal, tmp_path):
    for one in exports.records(speeds=(5.0,)):
        rows = zip(1000.0 * one.time_s, one.displacement_mm, one.force_N, strict=True)
        swapped = str.maketrans({",": mark, ".": decimal})
        lines = [";".join(f"{value:,.3f}" for value in row).translate(swapped) for row in rows]
        text = "\n".join(["Zeit [ms];Weg [mm];Kraft [N]", *lines, ""])
        exports.write(tmp_path, f"T80_d{one.days}_r{one.repeat}.txt", text)
    (doubt,) = (one for one in draft(tmp_path).doubts if "marks between thousands" in one.reason)
    assert f"'1{mark}" in doubt.reason
    assert "without these marks" in doubt.fix
