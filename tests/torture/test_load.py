"""Long load in short: memory follows the campaign, and nothing grows or is left; no test looks at the clock.

The long form is benchmarks/torture/load.py.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from many_files import write_campaign
from torture import load

BENCHMARKS = Path(load.__file__).resolve().parent.parent

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory and handles are read from /proc")


def peak_MiB(folder: Path) -> float:
    """Return the peak of `sealfit ingest`, asked by a small process: its own peak counts as the command's."""
    code = "import json, sys; from torture import load; print(json.dumps(*load.cost([sys.argv[1:]])))"
    words = ["ingest", folder, "--out", folder.with_name(f"{folder.name}-out")]
    paths = os.pathsep.join([str(BENCHMARKS), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        capture_output=True,
        check=True,
        env={**os.environ, "PYTHONPATH": paths},
    )
    return json.loads(done.stdout)["MiB"]


@pytest.mark.long
def test_memory_does_not_grow_with_the_number_of_files(tmp_path):
    write_campaign(tmp_path / "few", 50, rows=load.TINY)
    write_campaign(tmp_path / "many", 500, rows=load.TINY)
    assert peak_MiB(tmp_path / "many") < peak_MiB(tmp_path / "few") + 60


@pytest.mark.long
def test_memory_of_a_long_trace_is_a_small_multiple_of_its_file(tmp_path):
    load.write_long(tmp_path / "short", 1_000)
    load.write_long(tmp_path / "long", 200_000)
    more = peak_MiB(tmp_path / "long") - peak_MiB(tmp_path / "short")
    assert more < 15 * (tmp_path / "long" / "long.csv").stat().st_size / load.MIB


def test_a_hundred_columns_are_read(tmp_path):
    load.write_wide(tmp_path / "wide", 100)
    assert peak_MiB(tmp_path / "wide") < 300


@pytest.mark.long
def test_nothing_grows_and_nothing_is_left_after_runs_in_a_row(tmp_path):
    found = load.in_a_child(12, tmp_path, report=False)
    assert found["growth_MiB"] < 8
    assert found["handles_more"] == 0
    assert found["left"] == []
