from types import SimpleNamespace

from bins_helpers import make_bins

from sealfit.closure.confirm import gain_between_settings
from sealfit.fit.estimate import fit_declared
from sealfit.fit.rows import make_rows


def test_a_form_of_one_number_is_not_asked_between_settings():
    """Over three settings a straight line is zero at the middle one, and gains nothing there."""
    before = fit_declared(make_rows(make_bins(0, temperatures=(60.0,), days=(4.0,), bins=4), has_aging=True))
    line = SimpleNamespace(channels=("repeat",), effect=SimpleNamespace(parameters=("A",)))
    assert list(gain_between_settings(before, SimpleNamespace(term=line), {})) == []
