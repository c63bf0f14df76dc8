"""Numerical trust in short: the GUM's thermometer, and a small campaign in other sizes and units.

The long form is benchmarks/torture/digits.py; the NIST reference sets are in ../fit/test_nist.py.
"""

import pytest
from torture.digits import CHANGES, PRINTED, Change, campaign, compared, results, thermometer


@pytest.mark.parametrize("name", PRINTED)
def test_the_thermometer_of_the_gum_has_the_printed_digits(name):
    printed = PRINTED[name]
    decimals = len(str(printed).partition(".")[2])
    assert round(thermometer()[name], decimals) == printed


@pytest.fixture(scope="module")
def as_it_is():
    return results(campaign("short"), Change())


@pytest.mark.parametrize("change", [pytest.param("force_1e+06", marks=pytest.mark.long), "slots_mN_m_ms"])
def test_size_and_unit_change_no_digits(change, as_it_is):
    assert as_it_is.closure["verdict"] == "closed"
    found = compared(as_it_is, results(campaign("short"), CHANGES[change]))
    assert found.beyond == []
    assert found.numbers > 10_000


def test_numbers_that_differ_are_found(as_it_is):
    table = as_it_is.tables["steady_fit"]
    other = {**as_it_is.tables, "steady_fit": table.assign(value=table["value"] * 1.01)}
    assert compared(as_it_is, type(as_it_is)(other, as_it_is.closure)).beyond
