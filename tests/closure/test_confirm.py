from types import SimpleNamespace

import numpy as np
from bins_helpers import make_bins

from sealfit.closure.confirm import blocks, gain_between_settings
from sealfit.fit.estimate import fit_declared
from sealfit.fit.rows import make_rows


def test_a_form_of_one_number_is_not_asked_between_settings():
    """Over three settings a straight line is zero at the middle one, and gains nothing there."""
    before = fit_declared(make_rows(make_bins(0, temperatures=(60.0,), days=(4.0,), bins=4), has_aging=True))
    line = SimpleNamespace(channels=("repeat",), effect=SimpleNamespace(parameters=("A",)))
    assert list(gain_between_settings(before, SimpleNamespace(term=line), {})) == []


def test_blocks_of_the_calendar_are_shorter_than_conditions_that_follow_one_another():
    bins = make_bins(temperatures=(60.0, 80.0), days=(4.0,), repeats=2, bins=4)
    order = bins.groupby("file", sort=True).ngroup()  # one condition after the other
    rows = make_rows(bins.assign(elapsed_h=order.astype(float)), has_aging=True)
    masks = blocks(rows, "run", 3, "elapsed_h")
    assert np.any(masks, axis=0).mean() > 0.5
    assert all(np.unique(rows.condition[~out]).size == len(rows.conditions) for out in masks)
