"""Tables of runs that are not CSV: an Excel log or Parquet gives what runs.csv gives, and only one counts."""

from datetime import datetime

import openpyxl
import pandas as pd
import pytest
from format_helpers import book, rewritten, simulated_campaign
from trace_helpers import DAYS, config, faults

from sealfit.commands import check
from sealfit.errors import CampaignError
from sealfit.ingest.campaign import ingest_campaign
from sealfit.ingest.runs import list_traces
from sealfit.pipeline import ingest


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    return simulated_campaign(tmp_path_factory.mktemp("simulated"))


@pytest.mark.parametrize("runs", ["xlsx", "parquet"])
def test_a_table_of_runs_gives_what_runs_csv_gives(simulated, tmp_path, runs):
    wanted = ingest_campaign(simulated, config()).tables
    campaign = rewritten(simulated, tmp_path, "parquet", runs)
    found = ingest_campaign(campaign, config()).tables
    for name in ("runs", "bins"):
        mine, csv = (tables[name].drop(columns="file", errors="ignore") for tables in (found, wanted))
        pd.testing.assert_frame_equal(mine, csv, check_exact=True)
    assert check(campaign)[1] == []


def test_a_changed_log_is_seen_and_a_second_one_refused(simulated, tmp_path):
    campaign, out = rewritten(simulated, tmp_path / "c", "parquet", "xlsx"), tmp_path / "out"
    assert ingest(campaign, out)["done"] == ["ingest"]
    assert ingest(campaign, out)["done"] == []
    log = openpyxl.load_workbook(campaign / "runs.xlsx")
    column = log.active.max_column + 1
    log.active.cell(1, column).value = "batch"
    log.active.cell(2, column).value = "B7"
    log.save(campaign / "runs.xlsx")
    assert ingest(campaign, out)["done"] == ["ingest"]
    assert "batch" in pd.read_parquet(out / "runs.parquet")
    (campaign / "runs.csv").write_text("file\n")
    with pytest.raises(CampaignError, match=r"runs\.csv and runs\.xlsx"):
        ingest(campaign, out)


def test_a_log_of_runs_keeps_dates_numbers_and_the_rows_of_its_sheet(simulated, tmp_path):
    rewritten(simulated, tmp_path, "parquet")
    files = pd.read_csv(tmp_path / "runs.csv")["file"].tolist()
    head = ["file", "aging_days", "started_at", "thickness_mm", "batch"]
    rows = [[file, 4, datetime(2024, 3, 1, 9, i), 0.1 + 0.2 * i, 12] for i, file in enumerate(files)]
    book(tmp_path / "log.xlsx", [["notes"]], title="Notes", more=[("Runs", [])])
    made = openpyxl.load_workbook(tmp_path / "log.xlsx")
    for row in (head, *rows):
        made["Runs"].append(row)
    made.save(tmp_path / "log.xlsx")
    text = DAYS + '[files]\nruns_table = "log.xlsx"\nruns_sheet = "Runs"'
    listing, _ = list_traces(tmp_path, config(text))
    for i, ref in enumerate(listing):
        assert ref.channels["started_at"] == f"2024-03-01T09:{i:02d}:00"
        assert ref.channels["thickness_mm"] == float(f"{0.1 + 0.2 * i:.16g}")
        assert ref.channels["batch"] == 12
    made["Runs"]["B4"] = "four"
    made.save(tmp_path / "log.xlsx")
    (fault,) = faults(tmp_path, text)
    assert (fault.file, fault.line, fault.column, fault.value) == ("log.xlsx", 4, "aging_days", "four")
    made["Runs"]["B4"] = 4
    made["Runs"].merge_cells("E2:E3")
    made.save(tmp_path / "log.xlsx")
    (fault,) = faults(tmp_path, text)
    assert (fault.check, fault.file, fault.line) == ("merged_cells", "log.xlsx", 2)
    (fault,) = faults(tmp_path, DAYS + '[files]\nruns_table = "none.xlsx"')
    assert (fault.check, fault.file) == ("missing_file", "none.xlsx")
    (tmp_path / "log.xlsx").write_bytes(b"PK\x03\x04 no more")
    (fault,) = faults(tmp_path, text)
    assert (fault.check, fault.file) == ("damaged_file", "log.xlsx")
