import math

import numpy as np

from sealfit.ingest.columns import columns_of, in_order, overlaid, put, taken, where


def test_the_last_source_that_says_something_is_believed():
    header = columns_of([{"days": "99", "oven": "B2"}, {"days": "99"}])
    table = columns_of([{"load": "5"}, {"days": "4", "load": "6"}])
    whole = overlaid(header, table)
    assert whole == {"days": ["99", "4"], "oven": ["B2", None], "load": ["5", "6"]}
    columns = {"late": [None, "x"], "none": [None, None], **whole}
    assert list(in_order(columns)) == ["days", "oven", "load", "late"]
    assert taken(columns, [1])["oven"] == [None]


def test_values_are_asked_and_replaced_where_they_are():
    np.testing.assert_array_equal(where([math.nan, 1.0, None], math.isnan), [True, False, False])
    assert put(["a", None, 0.0], {1: "b"}) == ["a", "b", 0.0]
