import numpy as np
import pytest
from bins_helpers import make_bins

from sealfit.closure.confirm import Added
from sealfit.closure.linearised import Proposal
from sealfit.closure.next_runs import where_apart
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.fit.estimate import fit_declared, fitted_at
from sealfit.fit.rows import make_rows
from sealfit.fit.terms import Term


def bound(fitted, effect, channel, **values):
    """The declared fit with one effect as a factor on mu, its numbers given."""
    term = Term(EFFECTS[effect], (channel,), "mu", "multiply", fixed={"x_ref": 0.0})
    after = fitted_at(fitted.model.with_term(term, values), fitted.rows, fitted.scatter)
    return Proposal(term, values, "run", 10, 1.0, 0.001, np.zeros(fitted.force.size), ((channel,),), after)


def test_channels_that_always_went_together_are_taken_apart():
    bins = make_bins(bins=4, repeats=1)
    bins["humidity_pct"] = 30.0 + 2.0 * bins["elapsed_h"]  # rose with the calendar
    fitted = fit_declared(make_rows(bins, has_aging=True))
    chosen = bound(fitted, "linear", "humidity_pct", A=0.01)
    rival = bound(fitted, "linear", "elapsed_h", A=0.02)
    where, apart = where_apart(Added(chosen, 0.1, (rival,), 1), rival.fitted, Config())
    hours = bins["elapsed_h"]
    assert {"humidity_pct", "elapsed_h"} <= where.keys()
    # Dry at the end, or humid at the start: by the whole range, and half of it beyond, of the factor on some 45 N.
    assert abs((where["humidity_pct"] - 30.0) / 2.0 - where["elapsed_h"]) > np.ptp(hours)
    assert apart > 0.02 * np.ptp(hours) * 40.0


def test_forms_of_one_channel_differ_most_beyond_what_was_tested():
    fitted = fit_declared(make_rows(make_bins(bins=4, repeats=1), has_aging=True))
    chosen = bound(fitted, "linear", "elapsed_h", A=0.01)
    rival = bound(fitted, "exponential_approach", "elapsed_h", A=0.05, tau=5.0)
    where, apart = where_apart(Added(chosen, 0.1, (rival,), 1), rival.fitted, Config())
    assert where["elapsed_h"] > fitted.rows.values("elapsed_h").max()
    assert where["aging_days"] in fitted.rows.days
    assert apart == pytest.approx(abs(0.01 * where["elapsed_h"] - 0.05) * 45.0, rel=0.5)
