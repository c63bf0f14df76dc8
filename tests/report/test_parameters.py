import pandas as pd
from report.made_campaigns import aging_campaign, torque_campaign
from report.made_tables import empty, table

from sealfit.config import Config
from sealfit.report.parameter_tables import estimate, parameter_tables, statistic


def values(cells):
    return [statistic(row) for row, _ in cells]


def test_a_row_per_condition_with_u_sys_apart():
    made = aging_campaign()
    steady, statistics = parameter_tables(made.tables["steady_fit"], "condition", made.config)
    assert [str(symbol) for symbol, _ in steady.groups][:2] == [
        "<i>μ</i><sub>s</sub>",
        "<i>μ</i><sub>c</sub>",
    ]
    assert [unit for _, unit in steady.groups] == ["", "", "mm/s", "N s/mm"]
    assert len(steady.rows) == 7
    (name,), cells, _ = steady.rows[1]
    assert name == "60 °C · 80 % · 1 d"
    row = made.tables["steady_fit"].query(
        "aging_days == 1 and compression_ratio_pct == 80 and parameter == 'mu_s'"
    )
    value, interval, u_sys = estimate(cells[0][0])
    assert value == f"{row['value'].iloc[0]:.3f}"  # half-width 0.0126: two digits, three decimals
    assert interval == f"[{row['lo95'].iloc[0]:.3f}, {row['hi95'].iloc[0]:.3f}]"
    assert u_sys == "0.0024"
    assert statistics.single
    assert values(statistics.rows[0][1]) == ["0.310"]


def test_what_is_not_identified_says_why_and_gives_no_number():
    made = aging_campaign()
    steady = parameter_tables(made.tables["steady_fit"], "condition", made.config)[0]
    cells, note = {keys[0]: (cells, note) for keys, cells, note in steady.rows}["60 °C · 80 % · 16 d"]
    assert estimate(cells[2][0]) == ("not identified", "–", "–")
    assert (
        note == "<i>v</i><sub>s</sub> not identified: fewer than two speeds lie below 2 <i>v</i><sub>s</sub>"
    )


def test_coefficients_of_one_law_share_a_table():
    made = aging_campaign()
    (table,) = parameter_tables(made.tables["aging_fit"], "series", made.config)
    assert table.heads == ("series", "quantity")
    assert [str(keys[1]) for keys, _, _ in table.rows] == ["<i>μ</i><sub>s</sub>", "<i>μ</i><sub>c</sub>"] * 2


def test_forces_carry_the_declared_unit():
    made = torque_campaign()
    (table,) = parameter_tables(made.tables["steady_fit"], "condition", made.config)
    assert [unit for _, unit in table.groups] == ["mN m", "mN m", "rpm", "mN m/rpm"]


def test_conditions_stand_in_the_order_of_their_numbers():
    made = aging_campaign(days=(1, 16, 4), compressions=(100, 80), speeds=(1, 10))
    rows = parameter_tables(made.tables["steady_fit"], "condition", made.config)[0].rows
    assert [keys[0] for keys, _, _ in rows] == [
        "unaged",
        *(f"60 °C · {compression} % · {day} d" for compression in (80, 100) for day in (1, 4, 16)),
    ]


def test_counts_are_whole():
    made = aging_campaign(speeds=(1, 10))
    fit = made.tables["steady_fit"]
    runs = fit[fit["quantity"] == "statistics"].assign(parameter="n_runs", value=6.0, unit="")
    statistics = parameter_tables(pd.concat([fit, runs]), "condition", made.config)[1]
    assert values(statistics.rows[0][1]) == ["0.310", "6"]


def test_statistics_of_several_quantities_stand_apart():
    rows = [
        ("mu_s:lack_of_fit_p", 0.026, "specimens differ"),
        ("mu_c:lack_of_fit_p", 0.39, ""),
        ("mu_c:n_days", 5.0, ""),
    ]
    fit = table("aging_fit", [{"series": "all", "quantity": "statistics", "parameter": p, "value": v,
                               "reason": r, "unit": "", "identified": True}
                              for p, v, r in rows])  # fmt: skip
    (found,) = parameter_tables(fit, "series", Config())
    assert [str(symbol) for symbol, _ in found.groups] == ["lack of fit, p", "days tested"]
    assert [(keys[1], values(cells), note) for keys, cells, note in found.rows] == [
        ("<i>μ</i><sub>s</sub>", ["0.0260", "–"], "specimens differ"),
        ("<i>μ</i><sub>c</sub>", ["0.390", "5"], ""),
    ]


def test_remarks_on_identified_parameters_stand_apart():
    made = aging_campaign()
    fit = made.tables["steady_fit"]
    first = fit.index[(fit["condition"] == "unaged") & (fit["parameter"] == "mu_s")]
    fit.loc[first, "reason"] = "mu_s < mu_c"
    rows = parameter_tables(fit, "condition", made.config)[0].rows
    assert rows[0][2] == "<i>μ</i><sub>s</sub>: <i>μ</i><sub>s</sub> &lt; <i>μ</i><sub>c</sub>"
    assert not rows[1][2]


def test_nothing_fitted_is_no_table():
    assert parameter_tables(empty("aging_fit"), "series", Config()) == []
