"""The report where the loop added effects: numbers of the after-model, those before beside them."""

import re

import pandas as pd
import pytest
from report.made_campaigns import HIGHER, after_campaign, aging_campaign
from report.test_page import Page

from sealfit.report.figures.aging import aging
from sealfit.report.notation import number
from sealfit.report.page import build_report, with_after_fits
from sealfit.report.parameter_tables import error_text, law_rows, parameter_tables


@pytest.fixture(scope="module")
def made():
    return after_campaign()


def test_values_before_stand_beside_those_after(made):
    fit = made.tables["steady_fit"]
    found = parameter_tables(made.tables["steady_fit_after"], "steady_fit", made.config, fit)[0]
    assert found.compared
    row = fit.query("aging_days == 1 and compression_ratio_pct == 80 and parameter == 'mu_s'").iloc[0]
    shown = [found.rows[4][name] for name in ("value", "before")]
    assert shown == [f"{HIGHER * row['value']:.3f}", number(row["value"])]
    law = parameter_tables(made.tables["aging_fit_after"], "aging_fit", made.config, made.tables["aging_fit"])
    assert law[0].title == "Aging law per series, from the joint fit"
    assert parameter_tables(fit, "steady_fit", made.config)[0].compared is False


def test_the_likeliest_law_before_follows_that_after(made):
    rows = law_rows(made.tables["aging_laws_after"], made.tables["aging_laws"])
    first = [row for row in rows if row["key"] == rows[0]["key"]][:2]
    assert [(row["rank"], row["before"]) for row in first] == [(1, False), (1, True)]
    assert sum(row["before"] for row in rows) == len({row["key"] for row in rows})


def test_the_page_is_of_the_after_model_and_says_its_reference(made, unsaved):
    page = Page(build_report(*made.arguments).html)
    assert "at the reference state: cold contact (time 0)" in page.text
    assert re.search(r"parameter value 95 % u sys before unit", page.text)
    legend = aging(with_after_fits(made.tables), made.config).legend
    assert legend[-1].label == "before, without the effects"


def test_without_effects_nothing_is_doubled(unsaved):
    made = aging_campaign(verdict="nothing_missing", speeds=(1, 10), days=(4,))
    tables = with_after_fits(made.tables)
    assert not any(name.endswith("_before") and name != "residuals_before" for name in tables)
    page = Page(build_report(*made.arguments).html)
    assert "without the effects" not in page.text
    assert "at the reference state of its effects" not in page.text


def test_rubbers_whose_names_differ_in_case_are_named_beside_their_laws(unsaved):
    made = aging_campaign(verdict="nothing_missing", speeds=(1, 10))
    laws = made.tables["aging_laws"]
    made.tables["aging_laws"] = pd.concat([laws.assign(rubber="NBR"), laws.assign(rubber="nbr")])
    text = Page(build_report(*made.arguments).html).text
    assert "NBR, μ" in text
    assert "nbr, μ" in text


def test_an_error_that_is_rounding_alone_is_zero():
    assert (error_text(2.2e-16), error_text(0.0352)) == ("0", "0.0352")
