"""`fit-aging --values`: results that belong to a table, beside those of campaigns."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from drawing_helpers import only_svg
from typer.testing import CliRunner

import sealfit
from sealfit import commands, pipeline
from sealfit.cli import app
from sealfit.errors import OutError, RequestError, StaleError
from sealfit.store import Store

HARDNESS = Path(__file__).parents[1] / "sample_data" / "hardness.csv"
PROPERTY = "hardness_shore_A"
TO_80 = commands.LifetimeRequest(quantity=PROPERTY, threshold=80.0, temperature_C=60.0)


@pytest.fixture
def table(tmp_path):
    return Path(shutil.copy(HARDNESS, tmp_path / "hardness.csv"))


def test_the_simulated_hardness_comes_back(table, tmp_path, monkeypatch):
    made = pipeline.fit_properties(table, tmp_path / "out")
    (one,) = made["fit_aging"]["properties"]
    assert one["replicate_sd"] == pytest.approx(0.5, rel=0.2)
    assert one["lack_of_fit_p"] > 0.05
    value, low, high = one["law"]["E"]
    assert low < 85.0 < high
    assert value == pytest.approx(85.0, rel=0.1)
    life = commands.lifetime(tmp_path / "out", TO_80)
    assert life["ci95"][0] < 168.0 < life["ci95"][1]  # as docs/how-to/properties.md says
    assert life["model"] is None
    monkeypatch.setattr("sealfit.report.drawing.saved", only_svg)
    pipeline.single("report", tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "hardness.csv: aging report" in page
    assert "Force against speed" not in page
    assert '<span class="badge within_scatter">The law fits<' in page
    (said,) = re.findall(r'<p class="verdict">(.*)</p>', page)
    assert said.startswith(
        "hardness_shore_A: the law <i>μ</i><sub>0</sub> - <i>a</i> ln(1 + <i>t</i>/<i>b</i>), "
    )
    assert "changes the rate, <i>E</i>&nbsp;= 86.6 kJ/mol [" in said
    assert "mu_" not in said
    stored = pd.read_parquet(tmp_path / "out" / "property_values.parquet")
    assert len(stored) == one["values"] == 96


def test_a_second_run_does_nothing_and_a_changed_table_makes_the_results_stale(table, tmp_path):
    out = tmp_path / "out"
    assert pipeline.fit_properties(table, out)["done"] == ["fit-aging"]
    assert pipeline.fit_properties(table, out)["done"] == []
    assert pipeline.single("fit-aging", out)["done"] == []
    table.write_text(table.read_text("utf-8").replace("60,28,A,7", "60,28,A,6", 1), "utf-8")
    with pytest.raises(StaleError, match=r"inputs changed.*sealfit fit-aging --values .*hardness\.csv --out"):
        commands.lifetime(out, TO_80)
    assert pipeline.single("fit-aging", out)["done"] == ["fit-aging"]


def test_other_columns_are_another_question(table, tmp_path):
    out = tmp_path / "out"
    pipeline.fit_properties(table, out)
    made = pipeline.fit_properties(table, out, names=(PROPERTY,), batch="batch")
    assert made["done"] == ["fit-aging"]
    assert Store.open(out).command("fit-aging").endswith(f"--property {PROPERTY}")


def test_of_several_rubbers_one_is_chosen(table, tmp_path):
    rows = pd.read_csv(table, dtype=str)
    both = pd.concat([rows.assign(rubber="EPDM"), rows.assign(rubber="NBR")])
    both.to_csv(table, index=False)
    config, out = tmp_path / "two.toml", tmp_path / "out"
    config.write_text('condition = ["rubber", "temperature_C", "aging_days"]\nrubber = ["rubber"]\n', "utf-8")
    pipeline.fit_properties(table, out, config=config)
    with pytest.raises(RequestError, match="several rubbers: EPDM, NBR") as told:
        commands.lifetime(out, TO_80)
    assert "--rubber" in told.value.fix
    assert commands.lifetime(out, replace(TO_80, rubber="NBR"))["days"] > 100
    with pytest.raises(RequestError, match="no rubber 'FKM'"):
        commands.lifetime(out, replace(TO_80, rubber="FKM"))


def test_a_damaged_result_is_made_again(table, tmp_path):
    out = tmp_path / "out"
    pipeline.fit_properties(table, out)
    path = out / "property_values.parquet"
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 4
    path.write_bytes(raw)
    with pytest.raises(StaleError, match="property_values"):
        commands.lifetime(out, TO_80)
    assert pipeline.fit_properties(table, out)["done"] == ["fit-aging"]


def test_results_of_a_table_and_of_a_campaign_do_not_mix(table, tmp_path):
    out = tmp_path / "out"
    pipeline.fit_properties(table, out)
    with pytest.raises(RequestError, match=r"hardness\.csv, which has no traces: there is no close-loop"):
        pipeline.single("close-loop", out)
    other = Path(shutil.copy(table, tmp_path / "other.csv"))
    with pytest.raises(OutError, match=r"holds the results of the table hardness\.csv"):
        pipeline.fit_properties(other, out)
    (tmp_path / "runs.csv").write_text("file\n", "utf-8")
    with pytest.raises(OutError, match=r"holds the results of the table hardness\.csv"):
        pipeline.ingest(tmp_path, out)


def test_a_notebook_gets_the_laws_the_figures_and_the_lifetime(table, tmp_path):
    results = sealfit.fit_properties(str(table), str(tmp_path / "out"))
    laws = results.laws
    assert laws["series"].drop_duplicates().tolist() == [f"temperature_C={t}" for t in (60, 80, 100)]
    assert (laws["quantity"] == PROPERTY).all()
    assert {"mu_0", "a", "b", "c"} == set(laws["parameter"])
    assert "standard deviation of replicates" in repr(results)
    assert "fits within the scatter" in results._repr_html_()
    assert len(results.plot.aging().axes) >= 3
    assert len(results.table("property_values")) == 96
    assert "life " in repr(results.lifetime(PROPERTY, 80.0, temperature_C=60.0))
    with pytest.raises(RequestError, match="has no traces"):
        _ = results.verdict


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "give OUT, or --values TABLE --out OUT"),
        (["results", "--batch", "lot"], "go with --values"),
        (["--values", "x.csv"], "give the folder of results once"),
        (["results", "--values", "x.csv", "--out", "other"], "give the folder of results once"),
    ],
)
def test_usage(arguments, said):
    done = CliRunner().invoke(app, ["fit-aging", *arguments])
    assert done.exit_code == 2
    assert said in " ".join(done.output.split())


def test_json_and_the_summary_say_the_same(table, tmp_path):
    asked = ["fit-aging", "--values", str(table), "--out", str(tmp_path / "out")]
    made = json.loads(CliRunner().invoke(app, [*asked, "--json"]).stdout)
    assert made["fit_aging"]["properties"][0]["quantity"] == PROPERTY
    said = CliRunner().invoke(app, asked).stdout
    assert "standard deviation of replicates 0.491, of batches 0.609" in said
    missing = CliRunner().invoke(app, ["fit-aging", "--values", "hardnes.csv", "--out", "out"])
    assert "there is no such table of values" in str(missing.exception)


def test_the_page_says_at_its_top_that_a_law_does_not_fit(tmp_path, monkeypatch):
    rng = np.random.default_rng(3)
    rows = [
        f"{temperature},{days},{70.0 + 6.0 * (days in (2, 8)) + rng.normal(0.0, 0.4):.3f}"
        for temperature in (60, 80, 100)
        for days in (0, 1, 2, 4, 8, 16, 32)
        for _ in range(4)
    ]
    table = tmp_path / "steps.csv"
    table.write_text("\n".join(["temperature_C,aging_days,hardness", *rows]) + "\n", "utf-8")
    (one,) = pipeline.fit_properties(table, tmp_path / "out")["fit_aging"]["properties"]
    assert one["lack_of_fit_p"] < 1e-6
    monkeypatch.setattr("sealfit.report.drawing.saved", only_svg)
    pipeline.single("report", tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert '<span class="badge above_scatter">The law does not fit<' in page
    assert "does not fit (lack of fit, p &lt; 0.001): do not rely" in page
