import pandas as pd
import pytest

from sealfit.config import Config
from sealfit.errors import SealfitError
from sealfit.ingest.columns import add_keys, condition_columns


def keys(table, config=None):
    return add_keys(pd.DataFrame(table), config or Config())


def test_condition_and_series_are_spelled_from_the_columns_in_the_config_s_order():
    made = keys({"aging_days": [4], "compression_ratio_pct": [80.0], "temperature_C": ["60"], "other": ["x"]})
    assert made["condition"].tolist() == ["temperature_C=60, compression_ratio_pct=80, aging_days=4"]
    assert made["series"].tolist() == ["temperature_C=60, compression_ratio_pct=80"]
    assert made["rubber"].tolist() == ["rubber"]


def test_day_zero_is_one_condition_whatever_stands_in_its_other_cells():
    made = keys(
        {"temperature_C": [20, None, 80], "compression_ratio_pct": [None, 100, 90], "aging_days": [0, 0.0, 2]}
    )
    assert made["condition"].tolist()[:2] == ["unaged", "unaged"]
    assert made["series"].tolist() == ["unaged", "unaged", "temperature_C=80, compression_ratio_pct=90"]


def test_each_rubber_has_its_own_unaged_condition_and_its_own_aged_ones():
    config = Config(condition=["aging_days"], rubber=["compound", "batch"])
    made = keys({"aging_days": [0, 0, 2], "compound": ["NBR", "FKM", "FKM"], "batch": [1, 1, 2]}, config)
    assert made["condition"].tolist() == [
        "unaged, NBR, 1",
        "unaged, FKM, 1",
        "aging_days=2, compound=FKM, batch=2",
    ]
    assert made["series"].tolist()[2] == "compound=FKM, batch=2"
    assert made["rubber"].tolist() == ["NBR, 1", "FKM, 1", "FKM, 2"]
    assert condition_columns(config) == ["aging_days", "compound", "batch"]


def test_without_days_series_and_condition_are_equal_and_with_days_alone_the_series_is_all():
    made = keys({"drive": ["lead", "worm"]}, Config(condition=["drive"]))
    assert made["series"].tolist() == made["condition"].tolist() == ["drive=lead", "drive=worm"]
    assert keys({"aging_days": [3]}, Config(condition=["aging_days"]))["series"].tolist() == ["all"]


def test_an_empty_cell_gives_no_condition_and_a_missing_column_is_named():
    made = keys({"temperature_C": [20, None], "compression_ratio_pct": [80, 80], "aging_days": [1, 1]})
    assert made["condition"].isna().tolist() == [False, True]
    with pytest.raises(SealfitError, match="'compression_ratio_pct', 'aging_days' is missing"):
        keys({"temperature_C": [20]})


def test_equal_numbers_are_one_condition_however_they_are_written():
    made = keys({"pressure_bar": [0.3, 0.1 + 0.2, "0.30"]}, Config(condition=["pressure_bar"]))
    assert made["condition"].nunique() == 1


def test_the_caller_s_table_is_not_changed_and_an_empty_one_is_answered():
    table = pd.DataFrame({"temperature_C": [20.0], "compression_ratio_pct": [80.0], "aging_days": [1.0]})
    before = table.copy()
    assert add_keys(table, Config()).shape == (1, 6)
    pd.testing.assert_frame_equal(table, before)
    assert add_keys(table.iloc[:0], Config()).shape == (0, 6)
