import bins_helpers
import numpy as np
import numpy.testing as npt
import pytest

from sealfit.closure.channels import find_channels
from sealfit.closure.output import POINTS, channel_table, curve_table
from sealfit.closure.selection import Selection
from sealfit.fit.joint.estimate import fit, fit_declared
from sealfit.fit.joint.rows import make_rows
from sealfit.fit.joint.start import start_model


def test_curves_go_both_ways_over_the_speeds_of_each_condition_at_its_mean_load():
    table = bins_helpers.make_bins(directions=(1, -1), repeats=2, bins=4, temperatures=(60.0,))
    rng = np.random.default_rng(2)
    table["load_N"] += rng.normal(0.0, 0.5, len(table))
    rows = make_rows(table.sample(frac=1.0, random_state=1), has_aging=True)
    fitted = fit(start_model(rows), rows, turns=1)
    curves = curve_table(fitted, fitted)
    ways = curves.groupby(["condition", np.sign(curves["speed_mm_s"])], sort=False)
    assert list(ways.size()) == [POINTS] * 10  # five conditions
    assert [sign for _, sign in ways.groups] == [1.0, -1.0] * 5
    for (condition, sign), curve in ways:
        own = table[(table["condition"] == condition) & (np.sign(table["speed_mm_s"]) == sign)]
        npt.assert_allclose(curve["load_N"], own["load_N"].mean(), rtol=1e-12)
        assert set(curve["series"]) == set(own["series"])
        reached = np.abs(curve["speed_mm_s"])
        assert (reached.min(), reached.max()) == pytest.approx((1.0, 100.0), rel=0.01)
        assert (np.sign(curve["force_after_N"]) == sign).all()
        assert (curve["force_after_lo95_N"] < curve["force_after_N"]).all()


def test_a_mean_residual_names_the_run_that_is_farthest_from_the_model():
    bins = bins_helpers.make_bins(repeats=2, bins=4, temperatures=(60.0,), setup=0.0005)
    far = bins["run_id"].iloc[-1]
    bins["force_N"] += np.where(bins["run_id"] == far, 2.0, 0.0)
    rows = make_rows(bins.assign(batch="A"), has_aging=True)
    fitted = fit_declared(rows)
    channels = {c.name: c for c in find_channels(rows)}
    selection = Selection(fitted, fitted, (), (), (), None, None, channels)
    table = channel_table(selection, fitted, fitted)
    along = table[(table["channel"] == "displacement_mm")]
    assert set(along["before_run"]) == set(along["after_run"]) == {far}
    assert (table["before_run"].isin(set(bins["run_id"]))).all()
