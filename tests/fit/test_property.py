"""Aging laws of properties: means over specimens and batches, and the laws fitted to them."""

import os
from pathlib import Path

import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest

from sealfit.config import Config, parse_config
from sealfit.errors import RequestError
from sealfit.fit.aging.property import far_off, fit_properties, laws_of_property, means_of
from sealfit.ingest.property_table import read_properties
from sealfit.report.summary import of_properties
from sealfit.report.summary_lines import property_lines, property_sentences

DAYS = (0.0, 1.0, 4.0, 16.0, 32.0, 64.0)


def specimens(value, *, days=DAYS, temperatures=(60.0, 80.0), count=4, sd=0.5, batches=None, seed=1):
    """Return table `property_values` of `value(temperature, days)` and scatter; `batches`: shifts by name."""
    rng, rows = np.random.default_rng(seed), []
    for t in temperatures:
        for day in days:
            if day == 0 and t != temperatures[0]:
                continue
            series = f"temperature_C={t:g}"
            for number in range(count):
                name = list(batches)[number % len(batches)] if batches else None
                shift = batches[name] if batches else 0.0
                rows.append(
                    {
                        "rubber": "rubber",
                        "series": "unaged" if day == 0 else series,
                        "condition": "unaged" if day == 0 else f"{series}, aging_days={day:g}",
                        "quantity": "strength",
                        "unit": "N",
                        "batch": name,
                        "temperature_C": t,
                        "aging_days": day,
                        "value": value(t, day) + shift + rng.normal(0, sd),
                        "line": len(rows) + 2,
                    }
                )
    return pd.DataFrame(rows)


def law(temperature, days):
    return 100.0 - 8.0 * np.log1p(days * 2 ** ((temperature - 60) / 10) / 2.0)


def summary(table, tables):
    return of_properties(table, tables["aging_fit"], tables["aging_laws"])[0]


def test_variances_of_a_balanced_table_are_those_of_the_analysis_of_variance():
    table = specimens(law, batches={"A": -2.0, "B": 1.0, "C": 1.5}, count=6)
    value, condition, batch = table["value"], table["condition"], table["batch"]
    cell = value.groupby([condition, batch]).transform("mean")
    main = value.groupby(batch).transform("mean") - value.mean()
    n, conditions = len(table), condition.nunique()
    # Without interaction, cells and batches by condition are pooled: the residual of the additive model.
    left = value - value.groupby(condition).transform("mean") - main
    error = float((left**2).sum()) / (n - conditions - 2)
    between = (float((main**2).sum()) / 2 - error) / (n / 3)
    means = means_of(table)
    assert cell.nunique() == 3 * conditions
    assert means.specimen_sd == pytest.approx(np.sqrt(error), rel=1e-4)
    assert means.batch_sd == pytest.approx(np.sqrt(between), rel=1e-3)
    npt.assert_allclose(means.table["value"], value.groupby(condition).mean(), rtol=1e-9)
    # Each batch is at every condition: differences between means are free of it, their level is not.
    assert means.df == pytest.approx(n - conditions - 2, rel=1e-6)
    assert means.level_df < 3
    apart = means.covariance[0, 0] + means.covariance[1, 1] - 2 * means.covariance[0, 1]
    assert apart == pytest.approx(2 * error / 6, rel=1e-3)


def test_without_batches_means_are_independent():
    means = means_of(specimens(law, count=3))
    npt.assert_allclose(means.covariance, np.diag(np.diag(means.covariance)))
    assert means.df == means.level_df == 2 * len(means.table)
    assert np.isnan(means.batch_sd)


def test_batches_of_one_condition_each_are_no_separate_variance():
    table = specimens(law)
    means = means_of(table.assign(batch=table["condition"]))
    assert np.isnan(means.batch_sd)
    assert means.df == 3 * len(means.table)


def test_batches_of_one_specimen_each_are_replicates():
    table = specimens(law)
    alone = means_of(table.assign(batch=[f"b{k}" for k in range(len(table))]))
    plain = means_of(table)
    assert alone.df == plain.df
    assert alone.specimen_sd == pytest.approx(plain.specimen_sd)
    npt.assert_allclose(alone.covariance, plain.covariance, rtol=1e-5, atol=1e-9)


def test_the_law_and_its_rate_are_found():
    tables = fit_properties(specimens(law, sd=0.05), Config())
    fit = tables["aging_fit"].set_index(["series", "quantity", "parameter"])
    for series, b in (("temperature_C=60", 2.0), ("temperature_C=80", 0.5)):
        for name, true in (("mu_0", 100.0), ("a", 8.0), ("b", b)):
            row = fit.loc[series, "strength", name]
            assert row["lo95"] <= true <= row["hi95"]
            assert row["value"] == pytest.approx(true, rel=0.05)
            assert row["unit"] == ("d" if name == "b" else "N")
    best = tables["aging_laws"].query("rank == 1")
    assert best["law"].iloc[0] == "log"
    # a factor of 4 in rate between 60 and 80 degC: E = R ln 4 / (1/333.15 - 1/353.15)
    assert best.set_index("parameter").loc["E", "value"] == pytest.approx(67.8, rel=0.02)
    assert set(tables["master_curve"]["kind"]) == {"value", "law"}


def jump(temperature, days):
    return 100.0 if days < 10 else 70.0


@pytest.mark.parametrize(("value", "fits"), [(jump, False), (law, True)])
def test_a_law_that_does_not_fit_says_so_beside_its_numbers(value, fits):
    table = specimens(value, temperatures=(60.0,))
    one = summary(table, fit_properties(table, Config()))
    assert (one["lack_of_fit_p"] > 0.05) == fits
    said = property_lines([one])[1]
    assert ("does not fit (lack of fit" in said) != fits
    assert ("fits within the scatter of replicates" in said) == fits


def test_values_that_the_other_specimens_contradict_are_named_with_what_to_do():
    table = specimens(law)
    assert "far off" not in " ".join(property_lines([summary(table, fit_properties(table, Config()))]))
    table.loc[9, "value"] += 8.0
    table.loc[30, "value"] *= 1000.0
    one = summary(table, fit_properties(table, Config()))
    assert [value["line"] for value in one["far_off"]] == [11, 32]
    others = table.loc[[8, 10, 11], "value"].mean()
    assert one["far_off"][0]["others"] == pytest.approx(others)
    said = property_lines([one])[1]
    assert f"line 11 ({table.loc[9, 'value']:.4g} beside {others:.4g}), line 32" in said
    assert "empty it to leave the value out" in said
    assert "line 32" in property_sentences(one)


@pytest.mark.long
def test_values_are_rarely_far_off_by_chance_and_rounded_ones_never():
    named = [len(far_off(specimens(law, count=3, seed=seed))) for seed in range(300)]
    assert sum(named) <= 2
    rounded = specimens(law, sd=0.2, count=3).assign(value=lambda t: t["value"].round())
    assert far_off(rounded).empty


def test_scatter_in_proportion_to_the_value_makes_no_value_far_off():
    for seed in range(20):
        table = specimens(lambda *_: 2.0, sd=0.12, seed=seed)
        assert far_off(
            table.assign(value=table["value"].where(table["aging_days"] > 0, 10 * table["value"]))
        ).empty


def test_an_energy_that_no_rubber_has_is_said_to_be_implausible():
    table = specimens(lambda t, day: 100.0 - 8.0 * np.log1p(day * (1.0 if t > 70 else 30.0)), sd=0.1)
    law_line = property_lines([summary(table, fit_properties(table, Config()))])[-1]
    assert "implausible for rubber, 0 to 300: look for wrong values" in law_line


def test_without_replicates_nothing_shows_whether_the_law_fits():
    table = specimens(law, count=1)
    one = summary(table, fit_properties(table, Config()))
    assert one["replicate_sd"] is one["lack_of_fit_p"] is None
    assert "no replicates" in property_lines([one])[0]
    fit = fit_properties(table, Config())["aging_fit"]
    assert np.isfinite(fit.loc[fit["parameter"] == "a", "se"]).all()


def test_a_property_that_starts_at_zero_and_grows():
    table = specimens(lambda t, day: 100.0 - law(t, day), sd=0.3)
    fit = fit_properties(table, Config())["aging_fit"].query("parameter == 'a'")
    assert (fit["lo95"] <= -8.0).all()
    assert (fit["hi95"] >= -8.0).all()
    assert (fit["se"] < 1.0).all()


def test_units_and_order_change_nothing_but_the_scale():
    table = specimens(law, batches={"A": -1.0, "B": 1.0})
    plain = fit_properties(table, Config())["aging_fit"]
    moved = table.assign(value=1e6 * table["value"]).sample(frac=1.0, random_state=3)
    scaled = fit_properties(moved, Config())["aging_fit"]
    rows = plain["parameter"].isin(["mu_0", "a"]).to_numpy()
    npt.assert_allclose(scaled["value"][rows], 1e6 * plain["value"][rows], rtol=1e-5)
    npt.assert_allclose(scaled["se"][rows], 1e6 * plain["se"][rows], rtol=1e-4)


def test_a_rate_that_is_not_determined_is_not_printed():
    table = specimens(lambda t, day: 100.0)
    one = summary(table, fit_properties(table, Config()))
    assert one["law"]["E"] is None
    assert any("E not identified" in line for line in property_lines([one]))
    two = [one, {**one, "rubber": "other"}]
    assert [line for line in property_lines(two) if "rubber other: " in line]


def test_too_few_days_give_no_law_and_the_reason():
    fit = fit_properties(specimens(law, days=(0.0, 4.0)), Config())["aging_fit"]
    assert not fit["identified"].any()
    assert fit["reason"].str.contains("needs 3 distinct days").all()


def test_a_lifetime_asks_for_a_property_that_is_there():
    with pytest.raises(RequestError, match="there is no 'mu_s'"):
        laws_of_property(specimens(law), "mu_s")


MEASURED = os.environ.get("SEALFIT_MEASURED")
# What the folder's README found by hand, per temperature: a and b of the law, and its lack of fit.
BY_HAND = {
    "AdhesiveFormulationK": {40: (9.7, 0.53), 50: (7.0, 0.015), 60: (3.3, 6e-7)},
    "PolymerY": {50: (8.8, 15.6), 65: (7.6, 3.8), 80: (8.6, 1.3)},
}
CONFIG = """
condition = ["temperature_C", "aging_days"]
[files.runs_columns]
temperature_C = "TempC"
aging_days = {name = "TimeH", unit = "h"}
strength = {name = "Response", unit = "N"}
"""


@pytest.mark.parametrize("name", BY_HAND)
@pytest.mark.skipif(MEASURED is None, reason="SEALFIT_MEASURED names no folder of measured data")
def test_measured_strength_agrees_with_what_was_found_by_hand(name):
    config = parse_config(CONFIG, "strength.toml")
    path = Path(MEASURED) / "aging-strength" / "csv" / f"{name}.csv"
    table, faults = read_properties(path, config)
    assert not faults
    tables = fit_properties(table, config)
    fit = tables["aging_fit"].set_index(["series", "quantity", "parameter"])
    for celsius, (a, b) in BY_HAND[name].items():
        own = {p: fit.loc[f"temperature_C={celsius}", "strength", p] for p in ("a", "b")}
        assert own["a"]["lo95"] <= a <= own["a"]["hi95"]
        assert own["b"]["identified"] == (b > 1e-3)
        assert (own["b"]["lo95"] if b > 1e-3 else 0.0) <= b <= own["b"]["hi95"]
    one = summary(table, tables)
    assert one["lack_of_fit_p"] > 0.05
    assert one["law"]["lack_of_fit_p"] > 0.05
