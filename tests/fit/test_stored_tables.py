import pandas as pd
import pytest
from steady_tables import steady_rows

from sealfit.config import Config
from sealfit.fit import stored, whole_steady_fit
from sealfit.fit.aging import fit_series
from sealfit.fit.steady import fit_conditions
from sealfit.store import parquet
from sealfit.tables import SCHEMAS
from sealfit.units import Units


@pytest.fixture(scope="module")
def made():
    """The fit to a campaign, whose effects are uncertain along one direction, as it is stored."""
    fit = fit_conditions(steady_rows().assign(effects_u1_N=0.1), Config())
    return fit, stored("steady_fit", fit)


def keyed(fit):
    return fit.set_index(["condition", "quantity", "parameter"]).sort_index()


def test_each_condition_has_one_row_per_parameter(made):
    fit, tables = made
    kept = tables["steady_fit"]
    assert not kept.duplicated(["condition", "parameter"]).any()
    assert (kept["parameter"] == "mu_s").sum() == fit["condition"].nunique()
    assert set(kept["quantity"]) == {"steady", "statistics"}


def test_what_is_read_again_is_what_was_fitted(made, tmp_path):
    fit, tables = made
    for name, table in tables.items():
        parquet.write(table, SCHEMAS[name], Units(), tmp_path / name)
    again = whole_steady_fit(lambda name: parquet.read(tmp_path / name))
    assert list(again.columns) == list(fit.columns)
    pd.testing.assert_frame_equal(keyed(again), keyed(fit), check_dtype=False, check_exact=True)


def test_a_covariance_names_both_parameters(made):
    fit, tables = made
    covariance = tables["steady_covariance"].set_index(["condition", "parameter", "other"])["value"]
    whole = fit[fit["quantity"] == "covariance"].set_index(["condition", "parameter"])["value"]
    assert covariance["unaged", "mu_s", "mu_c"] == whole["unaged", "mu_s,mu_c"]
    se = tables["steady_fit"].set_index(["condition", "parameter"])["se"]
    assert covariance["unaged", "v_s", "v_s"] == pytest.approx(se["unaged", "v_s"] ** 2)


def test_a_shift_names_its_source(made):
    fit, tables = made
    shift = tables["steady_shift"].set_index(["condition", "source", "parameter"])["value"]
    whole = fit.set_index(["condition", "quantity", "parameter"])["value"]
    assert shift["unaged", "sensor", "mu_s"] == whole["unaged", "sensor_shift", "mu_s"]
    assert shift["unaged", "1", "mu_s"] == whole["unaged", "effect_shift", "mu_s:1"]


def test_the_covariances_of_a_law_say_of_which_quantity(made, tmp_path):
    law = fit_series(made[0], Config())
    tables = stored("aging_fit_after", law)
    assert set(tables) == {"aging_fit_after", "aging_covariance_after"}
    assert set(tables["aging_covariance_after"]["quantity"]) == {"mu_s", "mu_c"}
    assert set(tables["aging_covariance_after"]["other"]) == {"mu_0", "a", "ln b"}
    assert not tables["aging_fit_after"].duplicated(["series", "quantity", "parameter"]).any()
    parquet.write(
        tables["aging_covariance_after"], SCHEMAS["aging_covariance_after"], Units(), tmp_path / "law"
    )


def test_a_fit_without_rows_gives_tables_without_rows():
    for name in ("steady_fit", "aging_fit"):
        tables = stored(name, pd.DataFrame(columns=SCHEMAS[name].names()))
        assert [len(table) for table in tables.values()] == [0] * len(tables)
        for part, table in tables.items():
            assert list(table.columns.sort_values()) == sorted(SCHEMAS[part].names())


def test_other_tables_stay_as_they_are(made):
    table = made[0]
    assert stored("dynamic_fit", table)["dynamic_fit"] is table
