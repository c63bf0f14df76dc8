from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from bins_helpers import make_bins

from sealfit.closure.confirm import Context, Gain, confirmed, gain_between_settings, heldout_gain, varies_within
from sealfit.closure.heldout import blocks
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.fit.joint.estimate import fit, fit_declared
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import make_rows


def test_a_form_of_one_number_is_not_asked_between_settings():
    """Over three settings a straight line is zero at the middle one, and gains nothing there."""
    before = fit_declared(make_rows(make_bins(0, temperatures=(60.0,), days=(4.0,), bins=4), has_aging=True))
    line = SimpleNamespace(channels=("repeat",), effect=SimpleNamespace(parameters=("A",)))
    assert list(gain_between_settings(before, SimpleNamespace(term=line), {})) == []


@pytest.mark.parametrize("jitter", [0.0, 1e-15])
def test_the_one_load_of_a_campaign_has_no_settings_whatever_its_rounding(jitter):
    bins = make_bins(0, temperatures=(60.0,), days=(4.0,), bins=6, speeds=(1.0, 3.0, 10.0, 30.0, 100.0))
    rng = np.random.default_rng(0)
    load = bins["load_N"].iloc[0] * (1 + jitter * rng.integers(0, 3, len(bins)))
    rows = make_rows(bins.assign(load_N=load), has_aging=True)
    before = fit_declared(rows)
    warming = EFFECTS["warming_power"]
    term = Term(warming, warming.reads, "mu", "multiply", {"load_N_ref": 49.03, "speed_mm_s_ref": 10.0})
    after = fit(before.model.with_term(term, {"A": 0.01, "tau": 5.0}), rows, before.scatter, turns=0)
    known = {}
    list(gain_between_settings(before, SimpleNamespace(term=term, fitted=after, unit="run"), known))
    assert {(name, number) for _, name, number in known} == {("speed_mm_s", k) for k in range(3)}


def test_a_share_lost_along_strokes_is_held_out_about_their_means_however_much_friction_differs_between_runs():
    bins = make_bins(0, temperatures=(60.0,), days=(4.0,), bins=6, speeds=(0.1, 1.0, 100.0))
    rows = make_rows(bins, has_aging=True)
    lost = Term(EFFECTS["exponential_approach"], ("distance_mm",), "mu", "multiply")
    model = fit_declared(rows).model.with_term(lost, {"A": -0.004, "tau": 3.0})
    assert varies_within(SimpleNamespace(term=lost, fitted=SimpleNamespace(rows=rows, model=model))) == "stroke"


@pytest.mark.parametrize("seed", [0, 3])
def test_a_gain_is_weighed_by_the_scatter_that_is_left_with_the_effect_in(seed):
    """Aging with a floor stands in the scatter of specimens without it, and each would count for next to nothing."""

    def floor(table, force):
        return force * (1 + 0.05 * np.log(np.maximum(table["aging_days"].to_numpy() / 4, 1)))

    days = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
    tested = {"temperatures": (60.0,), "days": days, "speeds": (1.0, 8.0, 64.0), "repeats": 2, "bins": 3}
    rows = make_rows(make_bins(seed, **tested, specimen=0.005, effect=floor), has_aging=True)
    before = fit_declared(rows)
    term = Term(EFFECTS["aging_floor"], ("aging_days",), "mu", "multiply")
    after = fit(before.model.with_term(term, {"A": 0.05, "t_f": 4.0}), rows, before.scatter, turns=2)
    gain = heldout_gain(before, SimpleNamespace(term=term, fitted=after, unit="specimen"), 5, 0, None, {})
    assert gain.real


def test_blocks_of_the_calendar_are_shorter_than_conditions_that_follow_one_another():
    bins = make_bins(temperatures=(60.0, 80.0), days=(4.0,), repeats=2, bins=4)
    order = bins.groupby("file", sort=True).ngroup()  # one condition after the other
    rows = make_rows(bins.assign(elapsed_h=order.astype(float)), has_aging=True)
    masks = blocks(rows, "run", 3, "elapsed_h")
    assert np.any(masks, axis=0).mean() > 0.5
    assert all(np.unique(rows.condition[~out]).size == len(rows.conditions) for out in masks)


@pytest.mark.parametrize(
    ("effect", "channels", "acts_on", "p_value", "claimed"),
    [
        ("smooth", ("run_order",), "mu", 1e-4, True),
        ("smooth", ("run_order",), "v_s", 1e-4, False),
        ("smooth", ("run_order",), "v_s", 1e-6, True),
        ("surface", ("speed_mm_s", "repeat"), "mu", 1e-4, False),
        ("surface", ("oil_ppm", "dust_mg"), "mu", 1e-4, True),
        ("asymmetry", ("direction",), "sigma_2", 1e-4, True),
    ],
)
def test_a_free_shape_that_bends_the_curve_wants_more_evidence(
    monkeypatch, effect, channels, acts_on, p_value, claimed
):
    monkeypatch.setattr("sealfit.closure.confirm.heldout_gain", lambda *args: Gain(0.5, 0.5, 10.0))
    monkeypatch.setattr("sealfit.closure.confirm.gain_between_settings", lambda *args: [])
    monkeypatch.setattr("sealfit.closure.confirm._added_force", lambda proposal: np.ones(3))
    monkeypatch.setattr("sealfit.closure.confirm.describe", lambda term: term.acts_on)
    own = SimpleNamespace(id=effect, physical=effect == "asymmetry")
    term = SimpleNamespace(effect=own, channels=channels, acts_on=acts_on)
    proposal = SimpleNamespace(term=term, p_value=p_value, unit="run")
    fitted = SimpleNamespace(rows=SimpleNamespace(force=np.full(3, 10.0)))
    samples = pd.DataFrame({"force_N": np.random.default_rng(0).normal(size=50), "stroke_id": 0})
    refused = []
    found = confirmed(fitted, [proposal], samples, Context(Config(), EFFECTS, compare=False), 1, refused)
    assert (found is not None) == claimed
    assert [item.weak for item in refused] == ([] if claimed else [True])
