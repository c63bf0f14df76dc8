"""Tables from made-up fits: several rubbers, no aging, nothing found."""

import pandas as pd

from sealfit.config import Config
from sealfit.notebook import frames

AGED = "temperature_C=60, compression_ratio_pct=80"


def fit(*rows, quantity="steady"):
    """A fit's table of rows (condition, series, rubber, temperature, compression, days, parameter, value)."""
    names = [
        "condition",
        "series",
        "rubber",
        "temperature_C",
        "compression_ratio_pct",
        "aging_days",
        "parameter",
    ]
    table = pd.DataFrame(rows, columns=[*names, "value"]).assign(quantity=quantity, model="before", unit="")
    return table.assign(
        se=0.01, lo95=table["value"] - 0.02, hi95=table["value"] + 0.02, u_sys=0.0, identified=True, reason=""
    )


def two_rubbers():
    return fit(
        ("unaged, batch=a", "unaged, batch=a", "a", 23.0, 100.0, 0.0, "mu_s", 0.9),
        ("unaged, batch=b", "unaged, batch=b", "b", None, None, 0.0, "mu_s", 0.8),
        (f"{AGED}, batch=a, aging_days=4", f"{AGED}, batch=a", "a", 60.0, 80.0, 4.0, "mu_s", 0.7),
        (f"{AGED}, batch=a, aging_days=1", f"{AGED}, batch=a", "a", 60.0, 80.0, 1.0, "mu_s", 0.75),
        (
            "temperature_C=80, batch=a, aging_days=4",
            "temperature_C=80, batch=a",
            "a",
            80.0,
            80.0,
            4.0,
            "mu_s",
            0.6,
        ),
    ).assign(batch=["a", "b", "a", "a", "a"])


def test_unaged_rubber_starts_only_series_of_its_own():
    config = Config(rubber=["batch"])
    found = frames.parameters([two_rubbers()], [two_rubbers()], config)
    assert found[["series", "aging_days", "value"]].values.tolist() == [
        [f"{AGED}, batch=a", 0.0, 0.9],
        [f"{AGED}, batch=a", 1.0, 0.75],
        [f"{AGED}, batch=a", 4.0, 0.7],
        ["temperature_C=80, batch=a", 0.0, 0.9],
        ["temperature_C=80, batch=a", 4.0, 0.6],
        ["unaged, batch=b", 0.0, 0.8],
    ]
    assert found.loc[0, ["condition", "temperature_C", "batch"]].tolist() == ["unaged, batch=a", 60.0, "a"]


def test_without_aging_a_condition_is_a_row():
    config = Config(condition=["temperature_C"])
    rows = (
        two_rubbers().drop(columns=["compression_ratio_pct", "aging_days", "batch"]).assign(rubber="rubber")
    )
    found = frames.parameters([rows], [rows], config)
    assert sorted(found["value"]) == [0.6, 0.7, 0.75, 0.8, 0.9]


def test_statistics_and_what_else_a_fit_has_are_no_parameters():
    steady = pd.concat([two_rubbers(), two_rubbers().assign(quantity="statistics", parameter="chi2")])
    dynamic = pd.concat(
        [
            two_rubbers().assign(quantity=q, parameter=p)
            for q, p in (("dynamic", "sigma_0"), ("break_away", "F_ba"))
        ]
    )
    found = frames.parameters(
        [steady, dynamic], [steady, dynamic.assign(value=1.0)], Config(rubber=["batch"])
    )
    assert found["parameter"].tolist() == ["mu_s", "sigma_0"] * 6
    assert (found.loc[found["parameter"] == "sigma_0", "before"] == 1.0).all()


def closure(**changed):
    errors = {
        "rmse_N": 0.4,
        "rmse_runs_N": 0.3,
        "heldout_rmse_N": None,
        "heldout_extrapolated_rmse_N": None,
        "max_abs_N": 1.5,
        "mean_abs_pct": 2.0,
    }
    found = {
        "verdict": "nothing_missing",
        "fit_quality": {"state": "unknown", "ratio": None, "p_value": None},
        "left": {"rmse_N": None, "level": None, "channel": None, "p_value": None},
        "noise_floor_N": None,
        "heldout_unit": "run",
        "before": errors,
        "after": errors,
        "effects": [],
        "scatter": [],
        "sensitivity": [],
        "refused": [],
        "outlier_files": [],
    }
    return {**found, **changed}


def test_where_nothing_was_found_tables_have_their_columns():
    assert frames.effects(closure(), Config().units)["id"].tolist() == []
    assert list(frames.effect_parameters(closure(), Config().units)) == [
        "effect",
        "id",
        "parameter",
        "value",
        "lo95",
        "hi95",
        "unit",
    ]
    assert list(frames.scatter(closure(), Config().units)) == ["level", "sd_rel", "sd_N", "df"]
    assert frames.verdict(closure(), Config().units)["effects"].tolist() == [0]


def test_an_unavailable_value_is_nan():
    errors = frames.errors(closure(), Config().units).set_index("error")
    assert errors["noise_floor"].isna().all()
    assert errors.loc["heldout_rmse_N", ["before", "after"]].isna().all()
    assert errors.loc["rmse_N", "before"] == 0.4
    assert errors["unit"].to_dict() == {
        "rmse_N": "N", "rmse_runs_N": "N", "heldout_rmse_N": "N", "heldout_extrapolated_rmse_N": "N",
        "max_abs_N": "N", "mean_abs_pct": "%",
    }  # fmt: skip


def test_errors_carry_the_declared_unit():
    config = Config(quantities={"force": {"quantity": "torque", "unit": "mN m"}})
    assert frames.errors(closure(), config.units)["unit"].unique().tolist() == ["mN m", "%"]
