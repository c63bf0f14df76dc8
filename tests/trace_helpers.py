"""Trace files and campaigns written by tests, and what reading them gives."""

from pathlib import Path

import pytest

from sealfit.config import parse_config
from sealfit.errors import BadFile, CampaignError
from sealfit.ingest.columns import TraceRef
from sealfit.ingest.reader import read_trace
from sealfit.ingest.runs import list_traces

HEADER = "time_s,displacement_mm,force_N"
ROWS = [f"{0.1 * i:.1f},{0.5 * i:.1f},{2 + 0.01 * i:.2f}" for i in range(100)]  # 5 mm/s, 100 rows
DAYS = 'condition = ["aging_days"]\n'


def config(text=""):
    return parse_config(text, "rig.toml")


def read(folder: Path, content: str | bytes, text="", **channels):
    content = content if isinstance(content, bytes) else content.encode()
    (folder / "t.csv").write_bytes(content)
    return read_trace(folder, TraceRef("t.csv", channels), config(text))


def refused(folder, content, text="", **channels):
    with pytest.raises(BadFile) as caught:
        read(folder, content, text, **channels)
    assert caught.value.fault.file == "t.csv"
    assert caught.value.fault.action == "file left out"
    return caught.value.fault


def csv_of(rows, header=HEADER):
    return "\n".join([header, *rows]) + "\n"


def changed(at, row):
    return csv_of([*ROWS[:at], row, *ROWS[at + 1 :]])


def trace(folder: Path, file: str, speed=5.0, **constants):
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    extra = "".join(f",{value}" for value in constants.values())
    rows = [f"{0.1 * i:.1f},{0.1 * speed * i:.6f},2.0{extra}" for i in range(100)]
    path.write_text("\n".join([HEADER + "".join(f",{name}" for name in constants), *rows]))


def campaign(folder: Path, table: str, files=("a.csv", "b.csv", "c.csv")) -> Path:
    for file in files:
        trace(folder, file)
    (folder / "runs.csv").write_text("\n".join(line.strip() for line in table.strip().splitlines()) + "\n")
    return folder


def channels(folder, text=""):
    refs, _ = list_traces(folder, config(text))
    return {ref.file: ref.channels for ref in refs}


def faults(folder, text=""):
    with pytest.raises(CampaignError) as caught:
        list_traces(folder, config(text))
    return caught.value.faults
