import numpy as np
import pandas as pd
from report.made_campaigns import aging_campaign, torque_campaign
from report.made_tables import empty, table

from sealfit.config import Config
from sealfit.report.parameter_tables import parameter_tables
from sealfit.report.summary import of_fit
from sealfit.report.summary_lines import lines


def rows_of(found, *columns):
    return [tuple(str(row[column]) for column in columns) for row in found.rows]


def test_a_row_per_condition_and_parameter_with_u_sys_apart():
    made = aging_campaign()
    steady, statistics = parameter_tables(made.tables["steady_fit"], "steady_fit", made.config)
    assert rows_of(steady, "parameter", "unit")[:4] == [
        ("<i>μ</i><sub>s</sub>", ""),
        ("<i>μ</i><sub>c</sub>", ""),
        ("<i>v</i><sub>s</sub>", "mm/s"),
        ("<i>σ</i><sub>2</sub>", "N s/mm"),
    ]
    assert len(steady.rows) == 7 * 4
    first = steady.rows[4]
    assert first["name"] == "60 °C · 80 % · 1 d"
    row = made.tables["steady_fit"].query(
        "aging_days == 1 and compression_ratio_pct == 80 and parameter == 'mu_s'"
    )
    assert first["value"] == f"{row['value'].iloc[0]:.3f}"  # half-width 0.0126: two digits, three decimals
    assert first["interval"] == f"[{row['lo95'].iloc[0]:.3f}, {row['hi95'].iloc[0]:.3f}]"
    assert first["u_sys"] == "0.0024"
    assert statistics.statistics
    assert rows_of(statistics, "parameter", "value")[0] == ("rms error", "0.310")


def test_what_is_not_identified_says_why_and_gives_no_number():
    made = aging_campaign()
    steady = parameter_tables(made.tables["steady_fit"], "steady_fit", made.config)[0]
    v_s = [row for row in steady.rows if row["name"] == "60 °C · 80 % · 16 d"][2]
    assert (v_s["value"], v_s["interval"], v_s["u_sys"]) == ("not identified", "–", "–")
    assert v_s["note"] == "fewer than two speeds lie below 2 <i>v</i><sub>s</sub>"


def test_coefficients_of_a_law_say_their_quantity():
    made = aging_campaign()
    (laws,) = parameter_tables(made.tables["aging_fit"], "aging_fit", made.config)
    assert laws.key == "series"
    quantities = dict.fromkeys(rows_of(laws, "name", "quantity"))
    assert [quantity for _, quantity in quantities] == ["<i>μ</i><sub>s</sub>", "<i>μ</i><sub>c</sub>"] * 2


def test_forces_carry_the_declared_unit():
    made = torque_campaign()
    (steady,) = parameter_tables(made.tables["steady_fit"], "steady_fit", made.config)
    assert [row["unit"] for row in steady.rows[:4]] == ["mN m", "mN m", "rpm", "mN m/rpm"]


def test_conditions_stand_in_the_order_of_their_numbers():
    made = aging_campaign(days=(1, 16, 4), compressions=(100, 80), speeds=(1, 10))
    steady = parameter_tables(made.tables["steady_fit"], "steady_fit", made.config)[0]
    assert list(dict.fromkeys(row["name"] for row in steady.rows)) == [
        "unaged",
        *(f"60 °C · {compression} % · {day} d" for compression in (80, 100) for day in (1, 4, 16)),
    ]


def test_counts_are_whole():
    made = aging_campaign(speeds=(1, 10))
    fit = made.tables["steady_fit"]
    runs = fit[fit["quantity"] == "statistics"].assign(parameter="n_runs", value=6.0, unit="")
    statistics = parameter_tables(pd.concat([fit, runs]), "steady_fit", made.config)[1]
    assert rows_of(statistics, "value")[:2] == [("0.310",), ("6",)]


def test_statistics_of_several_quantities_stand_apart():
    rows = [
        ("mu_s:lack_of_fit_p", 0.026, "specimens differ"),
        ("mu_c:lack_of_fit_p", 0.39, ""),
        ("mu_c:n_days", 5.0, ""),
        ("mu_c:chi2", 2.0, "not shown"),
    ]
    fit = table("aging_fit", [{"series": "all", "quantity": "statistics", "parameter": p, "value": v,
                               "reason": r, "unit": "", "identified": True}
                              for p, v, r in rows])  # fmt: skip
    (found,) = parameter_tables(fit, "aging_fit", Config())
    assert rows_of(found, "quantity", "parameter", "value", "note") == [
        ("<i>μ</i><sub>s</sub>", "lack of fit, p", "0.0260", "specimens differ"),
        ("<i>μ</i><sub>c</sub>", "lack of fit, p", "0.390", ""),
        ("<i>μ</i><sub>c</sub>", "days tested", "5", ""),
    ]


def test_remarks_on_identified_parameters_stand_beside_them():
    made = aging_campaign()
    fit = made.tables["steady_fit"]
    first = fit.index[(fit["condition"] == "unaged") & (fit["parameter"] == "mu_s")]
    fit.loc[first, "reason"] = "mu_s < mu_c"
    rows = parameter_tables(fit, "steady_fit", made.config)[0].rows
    assert rows[0]["note"] == "<i>μ</i><sub>s</sub> &lt; <i>μ</i><sub>c</sub>"
    assert rows[0]["value"] != "not identified"
    assert not rows[1]["note"]


def test_nothing_fitted_is_no_table():
    assert parameter_tables(empty("aging_fit"), "aging_fit", Config()) == []


def test_a_remark_on_parameters_that_are_identified_stands_in_the_summary_once():
    mean = "the mean coefficient over these speeds, which are too few for a Stribeck curve."
    rows = [
        ("a", "mu_c", 0.6, True, mean),
        ("b", "mu_c", 0.5, True, mean),
        ("a", "v_s", np.nan, False, "few"),
    ]
    fit = pd.DataFrame(rows, columns=["condition", "parameter", "value", "identified", "reason"])
    part = of_fit(fit.assign(quantity="steady", unit=""), "condition")
    found = lines({"fit_steady": part})
    assert found[-1].strip() == f"mu_c: {mean}"
    assert sum(mean in text for text in found) == 1
