import numpy as np
import pandas as pd
import pytest
from report.made_campaigns import PROVENANCE, aging_campaign
from report.made_tables import table

from sealfit.config import Config
from sealfit.report import page
from sealfit.report.drawing import draw, panels_of
from sealfit.report.figures.aging import aging
from sealfit.report.figures.speed import force_speed
from sealfit.report.page import build_report
from sealfit.report.parameter_tables import break_aways, parameter_tables
from sealfit.report.words import curve_of

TEMPERATURES = (20, 30, 40, 50, 60, 70, 80)


@pytest.fixture(scope="module")
def large():
    """Return 14 series of two days, more than a figure shows."""
    return aging_campaign(
        temperatures=TEMPERATURES, days=(1, 4), speeds=(1, 10), bins_per_file=2, trace_points=5
    )


def test_few_are_all_shown():
    assert panels_of("abc", "series") == (["a", "b", "c"], "")


def test_many_are_spread_evenly():
    picked, words = panels_of(range(23), "series")
    assert picked == list(range(0, 23, 2))
    assert words == "12 of 23 series are drawn, selected evenly."


@pytest.mark.parametrize("figure", [force_speed, aging])
def test_a_large_campaign_shows_twelve_panels_and_says_of_how_many(figure, large):
    plot = figure(large.tables, large.config)
    assert len(plot.panels) == 12
    assert plot.note.startswith("12 of 14 ")
    assert ".parquet" in plot.note
    titles = [panel.title for panel in plot.panels]
    assert {"20 °C · 80 %", "80 °C · 100 %"} <= set(titles)
    assert titles == sorted(titles, key=lambda title: [int(word) for word in title.split() if word.isdigit()])


def test_the_page_says_what_is_not_drawn(large, unsaved):
    html = build_report(*large.arguments).html
    assert "12 of 14 panels are drawn" in html
    assert "12 of 14 series are drawn" in html


def steady_rows(days, runs=1):
    names = [
        f"temperature_C=60, compression_ratio_pct={p}, aging_days={d}" for p in range(70, 84) for d in days
    ]
    rows = pd.DataFrame(
        {"condition": np.repeat(names, runs), "rubber": "rubber", "direction": 1, "used": True}
    )
    rows = rows.assign(run_id=[f"r{k}" for k in range(len(rows))], force_N=10.0, load_N=1.0)
    return rows.assign(speed_mm_s=1.0 + np.arange(len(rows)) % runs, file=rows["run_id"])


def drawn_of(rows):
    return force_speed(page.with_after_fits({"steady": rows}), Config())


def test_many_days_of_a_series_are_thinned():
    plot = drawn_of(steady_rows(range(1, 21)))
    assert len(plot.panels) == 12
    assert "They hold 120 of 280 conditions." in plot.note
    assert len(plot.legend) < 20


def test_many_points_are_drawn_as_pixels(only_drawings):
    few, many = draw(drawn_of(steady_rows((1, 2)))), draw(drawn_of(steady_rows((1, 2), runs=200)))
    assert "<image" not in few["svg"]
    assert "<image" in many["svg"]
    assert len(many["svg"]) < 4 * len(few["svg"])


# ---------------------------------------------------------------- tables
def fits(n, quantity="steady"):
    rows = [{"temperature_C": 20.0 + k, "compression_ratio_pct": 80.0, "aging_days": 1.0,
             "quantity": quantity, "parameter": "mu_s", "value": 0.9, "unit": "", "identified": True}
            for k in range(n)]  # fmt: skip
    frame = pd.DataFrame(rows)
    names = [f"temperature_C={t:g}, compression_ratio_pct=80, aging_days=1" for t in frame["temperature_C"]]
    return table("steady_fit", frame.assign(condition=names))


def test_long_parameter_tables_are_cut_and_say_where_the_rest_is():
    (found,) = parameter_tables(fits(301), "steady_fit", Config())
    assert len(found.rows) == 200
    assert found.rows[0]["name"] == "20 °C · 80 % · 1 d"
    assert found.rows[-1]["name"] == "320 °C · 80 % · 1 d"
    assert found.excerpt.startswith("200 of 301 conditions")
    assert "steady_fit.parquet" in found.excerpt
    assert parameter_tables(fits(200), "steady_fit", Config())[0].excerpt == ""


def test_break_aways_are_cut_and_counted():
    one = {"quantity": "break_away", "direction": 1, "unit": "", "identified": True, "lo95": 1.0, "hi95": 2.0}
    rows = [
        {**one, "condition": f"c{k}", "parameter": p, "value": 1.5}
        for k in range(700)
        for p in ("F_ba", "F_ba/F")
    ]
    frame = pd.DataFrame(rows).assign(speed_set_mm_s=5.0, u_sys=np.nan, reason="")
    rows, in_all = break_aways(frame)
    assert (len(rows), in_all) == (600, 700)
    assert [rows[0][name] for name in ("condition", "value", "value_N")] == ["c0", 1.5, 1.5]


def test_inputs_are_cut_and_counted():
    every = [{"file": f"{k}.csv", "size": 10, "sha256": "ab"} for k in range(2500)]
    html = build_report({}, None, {**PROVENANCE, "inputs": every}, Config()).html
    assert html.count(".csv</td>") == 2000
    assert "2500 files, 0.0250 MB" in html
    assert "The first 2000 of 2500; inputs.parquet has all." in html


def test_the_page_is_called_what_the_config_is():
    facts = {**PROVENANCE, "campaign": "/data/csv"}
    assert page.name_of(facts, Config(name="emps")) == "emps"
    assert page.name_of(facts, Config()) == "csv"


def test_a_free_shape_is_a_table_of_its_curve_and_has_no_coefficients():
    place = np.linspace(0.0, 60.0, 61)
    ends = {"value": 0.1 + 0 * place, "lo95": 0.09 + 0 * place, "hi95": 0.11 + 0 * place}
    shapes = pd.DataFrame({"effect": 0, "channel": "time_s", "x": place, "label": None, **ends, "unit": ""})
    coefficients = [{"name": "c_2", "value": 0.2, "ci95": [0.1, 0.3], "unit": ""}]
    free = {
        "id": "smooth", "label": "smooth in time_s, factor on mu", "channels": ["time_s"], "acts_on": "mu",
        "operation": "multiply", "named": False, "candidate": False, "parameters": coefficients,
        "form": "natural cubic spline", "level": "trace", "reference": "mean", "p_value": 0.001,
        "heldout_gain_N": 0.1, "heldout_rmse_N": 0.4, "alternatives": [],
    }  # fmt: skip
    curve = curve_of(free, shapes, {"effects": [free]}, Config())
    assert curve["value"] == "change of <i>μ</i> (%)"
    assert [row[0] for row in curve["rows"]] == ["0", "10", "20", "30", "40", "50", "60"]
    assert curve["rows"][0][1:] == ("10.0", "[9.0, 11.0]")
    assert curve_of(free, shapes.iloc[:0], {"effects": [free]}, Config()) is None
