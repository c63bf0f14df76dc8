"""What the paper printed agrees with itself as far as it does, and is looked up where our tables have it."""

import re
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from paper_numbers import MEASURED, as_printed, compared, condition, printed_errors

from sealfit.config import Config
from sealfit.ingest.columns import add_keys


def test_the_printed_prediction_of_mu_c_needs_another_start():
    found = printed_errors()
    assert found["start"] == pytest.approx(0.639, abs=5e-5)
    assert found["gap"] == pytest.approx(0.030, abs=5e-5)
    assert (found["needed_4"], found["needed_16"]) == pytest.approx((8.6, 7.4), abs=0.05)
    assert (found["own_4"], found["own_16"]) == pytest.approx((2.4, 0.7), abs=0.05)
    assert found["spare"] < 0.0007


def test_eq_15_as_printed_gives_the_printed_mu_s():
    assert as_printed("mu_s", 0.0) == pytest.approx(0.93566, abs=5e-6)
    assert as_printed("mu_s", 16.0) == pytest.approx(0.7, abs=5e-5)


def test_conditions_are_spelled_as_the_tables_spell_them():
    columns = ["temperature_C", "compression_ratio_pct", "aging_days"]
    places = [at for _, _, at, _ in MEASURED]
    runs = pd.DataFrame([at or (23.0, 100.0, 0.0) for at in places], columns=columns)
    assert list(add_keys(runs, Config())["condition"]) == [condition(at) for at in places]


def test_every_published_number_stands_beside_ours():
    series = "temperature_C=60, compression_ratio_pct=80"
    steady = pd.DataFrame(
        [(condition(at), q, "steady", value, value - 0.01, value + 0.01) for _, q, at, value in MEASURED],
        columns=["condition", "parameter", "quantity", "value", "lo95", "hi95"],
    )
    law = pd.DataFrame(
        [(series, q, name, 1.0, 0.5, 2.0) for q in ("mu_s", "mu_c") for name in "abc"],
        columns=["series", "quantity", "parameter", "value", "lo95", "hi95"],
    )
    curves = pd.DataFrame(
        [(series, q, day, 0.7, 0.6, 0.8) for q in ("mu_s", "mu_c") for day in (0.0, 16.0)],
        columns=["series", "quantity", "aging_days", "value", "lo95", "hi95"],
    )
    runs = pd.DataFrame(
        [("unaged", "r1", 40.0), ("unaged", "r2", 49.0), (condition((80, 80, 16)), "r3", 35.0)],
        columns=["condition", "run_id", "force_N"],
    )
    tables = {"steady": runs, "steady_fit": steady, "aging_fit": law, "aging_curves": curves}
    lines = compared(tables)
    assert len(lines) == len(MEASURED) + 6 + 2 + 2
    assert all(line.ours == line.published for line in lines[: len(MEASURED)])
    assert [line.ours for line in lines[-2:]] == [49.0, 35.0]


@pytest.mark.long
def test_the_page_of_the_paper_is_made_in_short(tmp_path):
    script = Path(__file__).resolve().parent.parent / "benchmarks" / "paper.py"
    folders = ["--work", str(tmp_path / "work"), "--docs", str(tmp_path / "docs")]
    done = subprocess.run([sys.executable, str(script), "--short", *folders], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "docs" / "README.md").read_text("utf-8")
    assert "584 files" in page
    assert "8 speeds, 1 repeat, 49.03 N" in page
    assert "nothing missing" in page
    numbers = re.findall(r"^\| 4\.4 \| Eq\. 15 for mu_s at day 16 \| 0\.7 \| (\S+)", page, re.M)
    assert float(numbers[0]) == pytest.approx(0.7, abs=0.02)
    drawn = re.findall(r"\((figure_\d+\.png)\)", page)
    assert len(drawn) == 10
    assert all((tmp_path / "docs" / name).stat().st_size > 10_000 for name in drawn)
