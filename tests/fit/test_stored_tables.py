import pandas as pd
import pytest
from steady_tables import steady_rows

from sealfit.config import Config
from sealfit.fit.aging import aging_curves, fit_series
from sealfit.fit.steady import fit_conditions
from sealfit.store import parquet
from sealfit.tables import SCHEMAS
from sealfit.units import Units


@pytest.fixture(scope="module")
def made():
    """The fit to a campaign, whose effects are uncertain along one direction."""
    return fit_conditions(steady_rows().assign(effects_u1_N=0.1), Config())


def read_again(tables, folder):
    for name, table in tables.items():
        parquet.write_arrow(parquet.to_arrow(table, SCHEMAS[name], Units()), folder / name)
    return {name: parquet.read(folder / name) for name in tables}


def test_each_condition_has_one_row_per_parameter(made):
    kept = made["steady_fit"]
    assert not kept.duplicated(["condition", "parameter"]).any()
    assert (kept["parameter"] == "mu_s").sum() == kept["condition"].nunique()
    assert set(kept["quantity"]) == {"steady", "statistics"}


def test_what_is_read_again_is_what_was_fitted(made, tmp_path):
    again = read_again(made, tmp_path)
    for name, table in made.items():
        assert list(again[name].columns) == list(table.columns)
        pd.testing.assert_frame_equal(again[name], table, check_dtype=False, check_exact=True)


def test_a_covariance_names_both_parameters(made):
    covariance = made["steady_covariance"].set_index(["condition", "parameter", "other"])["value"]
    assert covariance["unaged", "mu_s", "mu_c"] != 0
    se = made["steady_fit"].set_index(["condition", "parameter"])["se"]
    assert covariance["unaged", "v_s", "v_s"] == pytest.approx(se["unaged", "v_s"] ** 2)


def test_a_shift_names_its_source(made):
    shift = made["steady_shift"].set_index(["condition", "source", "parameter"])["value"]
    of_sensor = made["steady_fit"].set_index(["condition", "parameter"])["u_sys"]
    assert abs(shift["unaged", "sensor", "mu_s"]) == of_sensor["unaged", "mu_s"]
    assert shift["unaged", "1", "mu_s"] == pytest.approx(0.1 / 49.03, rel=1e-6)


def test_the_covariances_of_a_law_say_of_which_quantity(made, tmp_path):
    laws = fit_series(made, Config())
    assert set(laws["aging_covariance"]["quantity"]) == {"mu_s", "mu_c"}
    assert set(laws["aging_covariance"]["other"]) == {"mu_0", "a", "ln b"}
    assert not laws["aging_fit"].duplicated(["series", "quantity", "parameter"]).any()
    pd.testing.assert_frame_equal(aging_curves(read_again(laws, tmp_path)), aging_curves(laws))


def test_without_aging_the_tables_have_no_rows(made):
    config = Config(condition=["temperature_C"])
    for name, table in fit_series(made, config).items():
        assert table.empty
        assert list(table.columns) == [*SCHEMAS[name].names(), "temperature_C"]
