"""Excel, TDMS, MATLAB and Parquet give what the same numbers give as CSV; faults are faults of a file."""

import sys
from datetime import datetime, timedelta

import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from format_helpers import (
    ENDINGS,
    WRITERS,
    as_mat,
    as_mat73,
    as_parquet,
    as_tdms,
    as_xlsx,
    book,
    rewritten,
    simulated_campaign,
    table,
)
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat
from scipy.sparse import csc_array
from trace_helpers import config

from sealfit.commands import check
from sealfit.errors import BadFile, CampaignError
from sealfit.ingest import formats
from sealfit.ingest.campaign import ingest_campaign
from sealfit.ingest.columns import TraceRef
from sealfit.ingest.listing import read_table
from sealfit.ingest.reader import read_header, read_trace
from sealfit.pipeline import ingest

NAMES = ("time_s", "displacement_mm", "force_N")


def read(folder, file, text="", **channels):
    return read_trace(folder, TraceRef(file, channels), config(text))


def refused(folder, file, text=""):
    with pytest.raises(BadFile) as caught:
        read(folder, file, text)
    fault = caught.value.fault
    assert (fault.file, fault.action) == (file, "file left out")
    assert fault.fix
    assert "\n" not in str(fault)
    return fault


# ---------------------------------------------------------------- traces


@pytest.mark.parametrize("ending", ENDINGS)
def test_numbers_are_read_back_to_the_last_digit(tmp_path, ending):
    more = {} if ending == "v73.mat" else {"valve": ["open", "shut"] * 30}  # there it would be a cell array
    wanted = table(digits=15 if ending == "xlsx" else 17, temperature_K=333.15, **more)
    WRITERS[ending](tmp_path / f"t.{ending}", wanted)
    trace = read(tmp_path, f"t.{ending}")
    assert set(trace.columns) == set(wanted)
    for name in wanted:
        npt.assert_array_equal(trace.columns[name], wanted[name].to_numpy())
    first = 2 if ending == "xlsx" else 1
    npt.assert_array_equal(trace.line, np.arange(first, first + 60))
    assert not trace.faults


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_config_does_with_columns_what_it_does_with_those_of_csv(tmp_path, ending):
    # h5py lists the fields of a struct by the alphabet, as MATLAB writes them: a, b, c
    written = table(digits=15).set_axis(["a", "b", "c"], axis=1)
    WRITERS[ending](tmp_path / f"t.{ending}", written)
    text = """
    [trace]
    drop_first_rows = 3
    columns = {time_ms = "a", displacement_mm = 2, pull = "c"}
    compute = {time_s = "time_ms / 1000", force_N = "gain * pull"}
    constants = {gain = 2}
    keep = "pull < 30.1"
    drop_columns = ["time_ms", "pull"]
    """
    trace = read(tmp_path, f"t.{ending}", text)
    kept = written[3:][written["c"][3:] < 30.1]
    assert set(trace.columns) == set(NAMES)
    npt.assert_array_equal(trace.columns["time_s"], kept["a"] / 1000)
    npt.assert_array_equal(trace.columns["displacement_mm"], kept["b"])
    npt.assert_array_equal(trace.columns["force_N"], 2 * kept["c"])


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_fault_of_a_cell_names_file_row_and_column(tmp_path, ending):
    wanted = table(digits=15)
    wanted.loc[9, "force_N"] = np.nan
    if ending == "xlsx":
        wanted = wanted.astype(object)
        wanted.loc[9, "force_N"] = None
    WRITERS[ending](tmp_path / f"t.{ending}", wanted)
    trace = read(tmp_path, f"t.{ending}")
    (fault,) = trace.faults
    row = 11 if ending == "xlsx" else 10
    assert (fault.check, fault.line, fault.column) == ("empty_cell", row, "force_N")
    assert row not in trace.line
    assert len(trace.line) == 59
    missing = refused(tmp_path, f"t.{ending}", '[trace.columns]\ntime_s = "time_s"\nforce_N = "Force_N"')
    assert (missing.check, missing.column) == ("missing_column", "Force_N")
    assert "force_N" in missing.fix


@pytest.mark.parametrize("ending", ["tdms", "parquet"])
def test_text_where_a_number_belongs_is_named(tmp_path, ending):
    wanted = table()
    wanted["force_N"] = wanted["force_N"].map(repr)
    wanted.loc[4, "force_N"] = "n.a."
    WRITERS[ending](tmp_path / f"t.{ending}", wanted)
    (fault,) = read(tmp_path, f"t.{ending}").faults
    assert (fault.check, fault.line, fault.value) == ("not_a_number", 5, "n.a.")


def test_header_fields_come_from_rows_properties_scalars_and_metadata(tmp_path):
    wanted = table(digits=15)
    as_xlsx(tmp_path / "t.xlsx", wanted, header=[["Specimen", "S 12"], ["Load [N]", None, 49.03], []])
    as_mat(tmp_path / "t.mat", wanted, specimen="S 12", rig={"load": 49.03})
    as_mat73(tmp_path / "u.mat", wanted, specimen="S 12", load=49.03)
    as_tdms(
        tmp_path / "t.tdms", wanted, root={"specimen": "S 12"}, own={"load": 49.03}, channels={"unit": "N"}
    )
    import pyarrow as pa
    import pyarrow.parquet as pq

    about = {"specimen": "S 12", "load": "49.03"}
    pq.write_table(pa.Table.from_pandas(wanted).replace_schema_metadata(about), tmp_path / "t.parquet")
    for file in ("t.xlsx", "t.mat", "u.mat", "t.tdms", "t.parquet"):
        fields = "{specimen_id = '(?i)specimen\\t(.*)', load_N = '(?i)load(?: \\[N\\]\\t)?\\t(.*)'}"
        text = f"[trace]\nheader_fields = {fields}"
        if file == "t.xlsx":
            text += "\nheader_ends_at = '^time_s'"
        assert read_header(tmp_path, file, config(text)) == {"specimen_id": "S 12", "load_N": 49.03}, file
        npt.assert_array_equal(read(tmp_path, file, text).columns["force_N"], wanted["force_N"])
    unit = "[trace]\nheader_fields = {_unit = '^Measured/force_N/unit\\t(.*)'}"
    assert read_header(tmp_path, "t.tdms", config(unit)) == {"_unit": "N"}


def test_the_ending_in_capitals_counts_and_the_config_may_say_it(tmp_path):
    wanted = table()
    for file in ("t.TDMS", "t.dat"):
        as_tdms(tmp_path / file, wanted)
    expected = wanted["force_N"]
    npt.assert_array_equal(read(tmp_path, "t.TDMS").columns["force_N"], expected)
    npt.assert_array_equal(read(tmp_path, "t.dat", '[trace]\nformat = "tdms"').columns["force_N"], expected)
    fault = refused(tmp_path, "t.dat")
    assert "is a TDMS file, not text" in fault.reason


# ---------------------------------------------------------------- Excel


def test_a_sheet_has_header_units_rows_dates_and_decimal_commas(tmp_path):
    wanted = table(digits=15)
    rows = [
        (timedelta(seconds=round(t, 3)), x, f"{f!r}".replace(".", ","))
        for t, x, f in wanted.itertuples(index=False)
    ]
    head = [["Test of", datetime(2024, 3, 1, 9, 30)], [], ["t", 'x "in"', "F\nmean"], ["s", "mm", "N"]]
    book(tmp_path / "t.xlsx", [*head, *rows])
    text = """
    [trace]
    decimal = ","
    delimiter = ";"
    header_lines = 4
    units_row = true
    columns = {time_s = "t", displacement_mm = 'x "in"', force_N = "F mean"}
    header_fields = {started_at = '^Test of\\t(.*)'}
    """
    trace = read(tmp_path, "t.xlsx", text)
    npt.assert_allclose(trace.columns["time_s"], wanted["time_s"].round(3), rtol=0, atol=1e-9)
    npt.assert_array_equal(trace.columns["displacement_mm"], wanted["displacement_mm"])
    npt.assert_array_equal(trace.columns["force_N"], wanted["force_N"])
    assert (trace.line[0], trace.faults) == (5, ())
    assert read_header(tmp_path, "t.xlsx", config(text)) == {"started_at": "2024-03-01T09:30:00"}


def test_the_sheet_is_the_only_one_with_cells_or_the_one_named(tmp_path):
    wanted = table(digits=15)
    rows = [list(wanted), *wanted.itertuples(index=False)]
    book(tmp_path / "one.xlsx", rows, more=[("Empty", [])])
    book(tmp_path / "two.xlsx", rows, more=[("Notes", [["by Meyer"]])])
    npt.assert_array_equal(read(tmp_path, "one.xlsx").columns["force_N"], wanted["force_N"])
    fault = refused(tmp_path, "two.xlsx")
    assert fault.check == "several_tables"
    assert "sheet = 'Data'" in fault.fix
    for sheet in ('"Data"', "1"):
        npt.assert_array_equal(
            read(tmp_path, "two.xlsx", f"[trace]\nsheet = {sheet}").columns["force_N"], wanted["force_N"]
        )
    assert "Did you mean 'Data'?" in refused(tmp_path, "two.xlsx", '[trace]\nsheet = "data"').fix
    assert "it has 2" in refused(tmp_path, "two.xlsx", "[trace]\nsheet = 3").reason


def test_formulas_count_by_their_values_and_what_a_merged_cell_covers_is_empty(tmp_path):
    wanted = table(digits=15)
    rows = [list(wanted), *wanted.itertuples(index=False)]

    def formula(sheet):
        sheet["C7"] = "=2*15"

    book(tmp_path / "formula.xlsx", rows, change=formula)
    fault = refused(tmp_path, "formula.xlsx")
    assert (fault.check, fault.line, fault.column) == ("formula", 7, "C")
    book(tmp_path / "merged.xlsx", rows, change=lambda sheet: sheet.merge_cells("B9:B11"))
    found = read(tmp_path, "merged.xlsx", "[quality]\nmax_bad_rows = 0.5").faults
    assert [(fault.check, fault.line, fault.column) for fault in found] == [
        ("empty_cell", 10, "displacement_mm"),
        ("empty_cell", 11, "displacement_mm"),
    ]
    titled = [["Report", None, None], *rows]
    book(tmp_path / "title.xlsx", titled, change=lambda sheet: sheet.merge_cells("A1:C1"))
    text = "[trace]\nheader_lines = 2"
    npt.assert_array_equal(read(tmp_path, "title.xlsx", text).columns["force_N"], wanted["force_N"])


def test_saved_values_of_formulas_are_read(tmp_path):
    import zipfile

    wanted = table(digits=15)
    book(
        tmp_path / "t.xlsx",
        [list(wanted), *wanted.itertuples(index=False)],
        change=lambda sheet: sheet.__setitem__("C7", "=2*15"),
    )
    with (
        zipfile.ZipFile(tmp_path / "t.xlsx") as packed,
        zipfile.ZipFile(tmp_path / "saved.xlsx", "w") as saved,
    ):
        for name in packed.namelist():
            saved.writestr(name, packed.read(name).replace(b"<f>2*15</f><v />", b"<f>2*15</f><v>30</v>"))
    force = read(tmp_path, "saved.xlsx").columns["force_N"]
    assert force[5] == 30
    npt.assert_array_equal(np.delete(force, 5), np.delete(wanted["force_N"].to_numpy(), 5))


# ---------------------------------------------------------------- TDMS and MATLAB


def test_time_of_a_waveform_comes_from_its_increment(tmp_path):
    wanted = table()[["displacement_mm", "force_N"]]
    wave = {"wf_increment": 0.005, "wf_start_offset": 0.25}
    as_tdms(tmp_path / "t.tdms", wanted, channels=wave)
    trace = read(tmp_path, "t.tdms")
    npt.assert_array_equal(trace.columns["time_s"], 0.25 + 0.005 * np.arange(60))
    as_tdms(tmp_path / "u.tdms", wanted)
    assert refused(tmp_path, "u.tdms").column == "time_s"


def test_times_of_day_are_seconds_since_the_first(tmp_path):
    wanted = table()
    moments = np.datetime64("2024-03-01T09:30:00") + (np.arange(60) * 125_000).astype("m8[us]")
    as_tdms(tmp_path / "t.tdms", wanted.assign(time_s=moments))
    as_parquet(tmp_path / "t.parquet", wanted.assign(time_s=moments))
    for file in ("t.tdms", "t.parquet"):
        npt.assert_array_equal(read(tmp_path, file).columns["time_s"], 0.125 * np.arange(60))


def test_the_group_is_the_only_one_that_fits_or_the_one_named(tmp_path):
    first, second = table(seed=1), table(seed=2)
    with TdmsWriter(tmp_path / "t.tdms") as writer:
        for group, written in (("up", first), ("down", second)):
            writer.write_segment([ChannelObject(group, name, written[name].to_numpy()) for name in written])
        writer.write_segment([ChannelObject("log", "oil_C", np.arange(3.0))])
    fault = refused(tmp_path, "t.tdms")
    assert fault.check == "several_tables"
    assert "'up', 'down', 'log'" in fault.reason
    force = read(tmp_path, "t.tdms", '[trace]\ngroup = "down"').columns["force_N"]
    npt.assert_array_equal(force, second["force_N"])
    assert "Did you mean 'down'?" in refused(tmp_path, "t.tdms", '[trace]\ngroup = "Down"').fix
    with TdmsWriter(tmp_path / "u.tdms") as writer:
        writer.write_segment([ChannelObject("up", name, first[name].to_numpy()) for name in first])
        writer.write_segment(
            [ChannelObject("up", "slow_C", np.arange(3.0)), ChannelObject("log", "oil_C", np.ones(3))]
        )
    trace = read(tmp_path, "u.tdms")
    npt.assert_array_equal(trace.columns["force_N"], first["force_N"])
    assert [(fault.column, fault.severity) for fault in trace.faults] == [("slow_C", "info")]
    named = '[trace.columns]\ntime_s = "time_s"\ndisplacement_mm = "displacement_mm"\nforce_N = "slow_C"'
    assert refused(tmp_path, "u.tdms", named).reason == "has 3 values where others have 60."


def test_mat_files_hold_structs_matrices_and_vectors(tmp_path):
    wanted = table()
    numbers = wanted.to_numpy()
    vectors = {name: wanted[[name]].to_numpy() for name in wanted}
    savemat(tmp_path / "matrix.mat", {"M": numbers, "rate": 7})
    savemat(tmp_path / "vectors.mat", vectors)
    savemat(tmp_path / "both.mat", {**vectors, "calibration": np.eye(3)})
    savemat(tmp_path / "nested.mat", {"S": {"data": numbers, "name": "run 1"}})
    savemat(tmp_path / "two.mat", {"A": numbers, "B": numbers})
    savemat(tmp_path / "wide.mat", {"M": numbers.T})
    places = "columns = {time_s = 1, displacement_mm = 2, force_N = 3}"
    for file, keys in {
        "matrix.mat": places,
        "vectors.mat": "",
        "both.mat": "",
        "nested.mat": places,
        "two.mat": f'variable = "B"\n{places}',
    }.items():
        force = read(tmp_path, file, f"[trace]\n{keys}").columns["force_N"]
        npt.assert_array_equal(force, wanted["force_N"], err_msg=file)
    assert "'A', 'B'" in refused(tmp_path, "two.mat", f"[trace]\n{places}").reason
    assert refused(tmp_path, "wide.mat", f"[trace]\n{places}").fix == "Save its transpose."
    assert "position" in refused(tmp_path, "matrix.mat").fix
    savemat(tmp_path / "none.mat", {"note": "nothing here"})
    assert "table2struct" in refused(tmp_path, "none.mat").fix


# ---------------------------------------------------------------- damage


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("damage", ["empty", "cut", "cut short", "text", "another"])
def test_a_damaged_file_is_a_fault_with_a_fix(tmp_path, capfd, ending, damage):
    file = f"t.{ending}"
    WRITERS[ending](tmp_path / file, table(rows=500))
    raw = (tmp_path / file).read_bytes()
    as_parquet(tmp_path / "other", table())
    savemat(tmp_path / "other2", {"a": 1})
    another = (tmp_path / ("other2" if ending == "parquet" else "other")).read_bytes()
    changed = {
        "empty": b"",
        "cut": raw[: len(raw) // 2],
        "cut short": raw[:100],
        "text": b"time_s\n1\n",
        "another": another,
    }
    (tmp_path / file).write_bytes(changed[damage])
    assert refused(tmp_path, file).check in ("empty_file", "damaged_file", "binary_file", "no_rows")
    assert read_or_nothing(tmp_path, file) == {}
    assert capfd.readouterr() == ("", "")  # the libraries' own warnings


MIXED = {
    **dict.fromkeys(("time_s", "displacement_mm", "force_N"), np.arange(60.0)),
    "S": {"rate": 1.0, "none": [], "cells": np.array([1, "a"], object)},
    "z": np.arange(3) * 1j,
    "sparse": csc_array(np.eye(3)),
}


def test_mat_files_of_every_kind_of_variable_are_not_refused(tmp_path):
    savemat(tmp_path / "t.mat", MIXED)
    assert len(read(tmp_path, "t.mat", 'trace.variable = "(vectors)"').line) == 60


@pytest.mark.parametrize(
    ("tag", "byte", "bit"),
    [
        (b"\x06\0\0\0\x08\0\0\0\x06", 9, 8),  # an array is complex, and has no imaginary part
        (b"\x09\0\0\0\xe0\1", 0, 1),  # of a type that there is not
        (b"\x05\0\0\0\x08", 2, 2),  # sizes of two bytes
        (b"\x05\0\0\0\x08\0\0\0\1\0\0\0\x02\0\0\0", 15, 64),  # more cells than bytes
    ],
)
def test_a_bit_of_a_mat_file_that_crashes_its_library_is_a_fault(tmp_path, tag, byte, bit):
    savemat(tmp_path / "t.mat", MIXED)
    raw = bytearray((tmp_path / "t.mat").read_bytes())
    raw[raw.index(tag, 128) + byte] ^= bit
    (tmp_path / "t.mat").write_bytes(raw)
    assert refused(tmp_path, "t.mat").check == "damaged_file"


def read_or_nothing(folder, file):
    try:
        return read_header(folder, file, config("[trace]\nheader_fields = {a = 'a'}"))
    except BadFile:
        return {}


def test_old_and_protected_workbooks_are_named(tmp_path):
    shell = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600)
    (tmp_path / "old.xls").write_bytes(shell)
    (tmp_path / "locked.xlsx").write_bytes(shell + "EncryptedPackage".encode("utf-16-le") + bytes(100))
    assert "old Excel" in refused(tmp_path, "old.xls").reason
    assert "password" in refused(tmp_path, "locked.xlsx").reason


# ---------------------------------------------------------------- campaigns


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    return simulated_campaign(tmp_path_factory.mktemp("simulated"))


def compared(ingested):
    return {name: ingested.tables[name].drop(columns="file", errors="ignore") for name in ("runs", "bins")}


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_campaign_gives_the_same_tables_in_every_format(simulated, tmp_path, ending):
    wanted = compared(ingest_campaign(simulated, config()))
    found = compared(ingest_campaign(rewritten(simulated, tmp_path, ending), config()))
    assert len(wanted["bins"]) > 100
    for name in wanted:
        pd.testing.assert_frame_equal(found[name], wanted[name], check_exact=True)


def test_changes_are_seen_and_workers_give_the_same(simulated, tmp_path):
    campaign, out = rewritten(simulated, tmp_path / "c", "tdms"), tmp_path / "out"
    summary, found = check(campaign, workers=2)
    assert summary["files"]
    assert not found
    assert ingest(campaign, out, workers=2)["done"] == ["ingest"]
    assert ingest(campaign, out)["done"] == []
    before = pd.read_parquet(out / "steady.parquet")
    ingest(campaign, tmp_path / "alone", workers=1)
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "alone" / "steady.parquet"), before)
    victim = sorted(campaign.rglob("*.tdms"))[0]
    trace = pd.read_csv(simulated / victim.relative_to(campaign).with_suffix(".csv"))
    as_tdms(victim, trace.assign(force_N=2 * trace["force_N"]))
    assert ingest(campaign, out)["done"] == ["ingest"]
    assert not pd.read_parquet(out / "steady.parquet").equals(before)
    assert ingest(campaign, out)["done"] == []


@pytest.mark.parametrize(("ending", "name"), [("xlsx", "openpyxl"), ("tdms", "nptdms"), ("v73.mat", "h5py")])
def test_a_missing_library_is_one_line_that_names_it(simulated, tmp_path, monkeypatch, ending, name):
    campaign = rewritten(simulated, tmp_path / "c", ending)
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(CampaignError) as caught:
        ingest(campaign, tmp_path / "out")
    said = str(caught.value)
    assert f"{formats.CALLED[ending[-4:].lstrip('.')]} is read by {name}, which is not installed." in said
    assert "pip install 'sealfit[formats]'" in said
    assert "\n" not in said
    assert not (tmp_path / "out").exists()
    _, found = check(campaign)
    assert [fault.check for fault in found] == ["missing_library"]


def test_a_page_of_parquet_that_is_not_what_its_checksum_says_is_damage(tmp_path):
    table().to_parquet(
        tmp_path / "t.parquet", compression="none", use_dictionary=False, write_page_checksum=True
    )
    raw = bytearray((tmp_path / "t.parquet").read_bytes())
    raw[raw.index(table()["force_N"].to_numpy().tobytes()[:64])] ^= 1
    (tmp_path / "t.parquet").write_bytes(raw)
    assert "cannot be read as a Parquet file" in refused(tmp_path, "t.parquet").reason


def test_a_parquet_file_with_too_many_cells_is_left_out(tmp_path, monkeypatch):
    as_parquet(tmp_path / "t.parquet", table())
    cells = table().size
    monkeypatch.setattr(formats, "MOST_CELLS", cells)
    assert read(tmp_path, "t.parquet") is not None
    monkeypatch.setattr(formats, "MOST_CELLS", cells - 1)
    assert f"at most {cells - 1:,} cells" in refused(tmp_path, "t.parquet").reason
    with pytest.raises(CampaignError, match=f"at most {cells - 1:,} cells"):  # as a table of runs, too
        read_table(tmp_path, "t.parquet", config())
