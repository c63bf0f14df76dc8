import pandas as pd
from report.made_campaigns import aging_campaign, torque_campaign
from report.made_tables import empty

from sealfit.config import Config
from sealfit.report.parameters import parameter_tables


def test_a_row_per_condition_with_u_sys_apart():
    made = aging_campaign()
    steady, statistics = parameter_tables(made.tables["steady_fit"], "condition", made.config)
    assert [str(symbol) for symbol, _ in steady.groups][:2] == ["<i>μ</i><sub>s</sub>", "<i>μ</i><sub>c</sub>"]
    assert [unit for _, unit in steady.groups] == ["", "", "mm/s", "N s/mm"]
    assert len(steady.rows) == 7
    (name,), cells, _ = steady.rows[1]
    assert name == "60 °C · 80 % · 1 d"
    row = made.tables["steady_fit"].query("aging_days == 1 and compression_ratio_pct == 80 and parameter == 'mu_s'")
    assert cells[0].value == f"{row['value'].iloc[0]:.3f}"  # half-width 0.0126: two digits, three decimals
    assert cells[0].interval == f"[{row['lo95'].iloc[0]:.3f}, {row['hi95'].iloc[0]:.3f}]"
    assert cells[0].u_sys == "0.0024"
    assert statistics.single
    assert statistics.rows[0][1][0].value == "0.310"


def test_what_is_not_identified_says_why_and_gives_no_number():
    made = aging_campaign()
    steady = parameter_tables(made.tables["steady_fit"], "condition", made.config)[0]
    cells = {keys[0]: cells for keys, cells, _ in steady.rows}["60 °C · 80 % · 16 d"]
    assert cells[2].words == "not identified: fewer than two speeds lie below 2 v_s"
    assert cells[2].value == "–"


def test_coefficients_of_one_law_share_a_table():
    made = aging_campaign()
    (table,) = parameter_tables(made.tables["aging_fit"], "series", made.config)
    assert table.heads == ("series", "of")
    assert [str(keys[1]) for keys, _, _ in table.rows] == ["<i>μ</i><sub>s</sub>", "<i>μ</i><sub>c</sub>"] * 2


def test_forces_carry_the_declared_unit():
    made = torque_campaign()
    (table,) = parameter_tables(made.tables["steady_fit"], "condition", made.config)
    assert [unit for _, unit in table.groups] == ["mN m", "mN m", "rpm", "mN m/rpm"]


def test_covariances_are_for_programs():
    made = aging_campaign()
    fit = made.tables["steady_fit"]
    more = fit.head(1).assign(quantity="covariance", parameter="mu_s,mu_c")
    tables = parameter_tables(pd.concat([fit, more]), "condition", made.config)
    assert all("," not in str(symbol) for table in tables for symbol, _ in table.groups)


def test_remarks_on_identified_parameters_stand_apart():
    made = aging_campaign()
    fit = made.tables["steady_fit"]
    first = fit.index[(fit["condition"] == "unaged") & (fit["parameter"] == "mu_s")]
    fit.loc[first, "reason"] = "mu_s < mu_c"
    rows = parameter_tables(fit, "condition", made.config)[0].rows
    assert rows[0][2] == "<i>μ</i><sub>s</sub>: mu_s &lt; mu_c"
    assert not rows[1][2]


def test_nothing_fitted_is_no_table():
    assert parameter_tables(empty("aging_fit"), "series", Config()) == []
