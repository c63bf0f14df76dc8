import numpy as np
import pandas as pd
import pytest
from bins_helpers import TWO_FOLDS, make_bins, make_traces

from sealfit.closure.channels import Channel, find_channels, mixed_columns
from sealfit.closure.forms import terms_of
from sealfit.closure.loop import close_loop
from sealfit.closure.predict import predict
from sealfit.closure.score_test import Candidate, ScoreTestResult, ScoreTests
from sealfit.closure.search import search, search_pairs
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.fit.joint import fit_declared
from sealfit.fit.joint.rows import make_rows

COLUMNS = {
    "oil_ppm": lambda rng: rng.normal(50, 10),
    "dust_mg": lambda rng: rng.normal(5, 1),
    "batch": lambda rng: str(rng.choice(list("AB"))),
}


def close(effect, config):
    bins = make_bins(
        5, temperatures=(60.0,), repeats=2, setup=0.003, effect=effect, run_channels=COLUMNS, bins=4
    )
    return bins, close_loop(bins, make_traces(bins), config)


def test_product_of_two_columns_is_found_and_predicted():
    def product(table, force):
        return force * (1 + 0.006 * (table["oil_ppm"] - 50) * (table["dust_mg"] - 5)).to_numpy()

    bins, closure = close(product, TWO_FOLDS)
    (effect,) = closure.document["effects"]
    assert (effect["id"], set(effect["channels"])) == ("product", {"oil_ppm", "dust_mg"})
    assert (effect["acts_on"], effect["operation"], effect["level"]) == ("mu", "multiply", "run")
    assert effect["parameters"][0]["value"] == pytest.approx(0.006, rel=0.15)
    assert closure.document["after"]["heldout_rmse_N"] < 0.5 * closure.document["before"]["heldout_rmse_N"]
    point = bins.head(1).assign(speed_mm_s=4.0)
    usual, both = (point.assign(oil_ppm=50.0 + d, dust_mg=5.0 + d / 10) for d in (0.0, 10.0))
    forces = [predict(closure.model, table)["force_after_N"].iloc[0] for table in (usual, both)]
    assert forces[1] / forces[0] - 1 == pytest.approx(0.06, rel=0.2)


@pytest.mark.long
def test_slope_in_one_batch_only_is_found():
    def in_b(table, force):
        return (
            force * (1 + 0.008 * (table["oil_ppm"] - 50) * np.where(table["batch"] == "B", 1, -1)).to_numpy()
        )

    effects = close(in_b, Config())[1].document["effects"]
    assert [(e["id"], set(e["channels"])) for e in effects] == [("slopes", {"oil_ppm", "batch"})]
    low, high = sorted(p["value"] for p in effects[0]["parameters"])
    assert (low, high) == (pytest.approx(-0.008, rel=0.2), pytest.approx(0.008, rel=0.2))


def test_mixed_columns_hold_nothing_of_either_channel_alone():
    rng = np.random.default_rng(0)
    one, other = (Channel(name, rng.uniform(1, 2, size=4000), "run") for name in "ab")
    blocks = mixed_columns(one, other)
    assert [b.shape for b in blocks] == [(4000, 1), (4000, 4)]
    for channel in (one, other):
        assert abs(np.corrcoef(blocks[0][:, 0], channel.values)[0, 1]) < 0.05
    category = Channel("c", rng.choice(["x", "y"], 4000), "run")
    assert [b.shape for b in mixed_columns(one, category)] == [(4000, 1)]
    assert mixed_columns(category, category) == []


def test_products_of_logarithms_are_tried_where_a_channel_spans_enough():
    speed = Channel("speed_mm_s", np.tile([0.5, 5.0, 50.0], 4), "run")
    days = Channel("aging_days", np.repeat([0.0, 1.0, 4.0, 16.0], 3), "specimen")
    product = np.log(speed.values / 5) * (np.log(days.values + 1) - np.log(days.values + 1).mean())
    best = max(abs(np.corrcoef(product, block[:, 0])[0, 1]) for block in mixed_columns(speed, days)[:-1])
    assert best == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("speeds", "alone"), [((1.0, 8.0, 32.0, 100.0), False), ((1.0, 4.0, 16.0, 32.0, 64.0), True)]
)
def test_a_product_holds_the_speed_alone_only_where_the_curve_leaves_room(speeds, alone):
    fitted = fit_declared(make_rows(make_bins(1, speeds=speeds, repeats=1, bins=6), has_aging=True))
    channels = {c.name: c for c in find_channels(fitted.rows)}
    test_result = ScoreTestResult(0.0, 1, 20, 0.0)
    candidate = Candidate(
        ("distance_mm", "speed_mm_s"), "mu", "multiply", "run", np.empty((0, 0)), test_result, pair=True
    )
    terms = [term for term, _ in terms_of(candidate, channels, fitted, EFFECTS)]
    assert any(term.effect.id == "product" for term in terms)
    assert any(len(term.effect.linear) > 1 for term in terms) == alone


def test_of_many_columns_those_that_explain_most_are_paired(monkeypatch):
    columns = {f"column_{k}": lambda rng: rng.normal() for k in range(5)}
    bins = make_bins(temperatures=(60.0,), days=(4.0,), bins=2, run_channels=columns)
    tests = ScoreTests(fit_declared(make_rows(bins, has_aging=True)))
    channels, rng = find_channels(tests.fitted.rows), np.random.default_rng(0)
    singles = search(tests, channels, rng)
    monkeypatch.setattr("sealfit.closure.criteria.MOST_PAIRED", 3)
    paired = {name for c in search_pairs(tests, channels, singles, rng) for name in c.channels}
    own = list(dict.fromkeys(c.channels[-1] for c in singles if c.channels[-1] in columns))
    assert {name for name in paired if name in columns} == set(own[:3])
    assert "speed_mm_s" in paired


def test_waves_are_forms_of_ripples_alone():
    fitted = fit_declared(make_rows(make_bins(0, bins=4, repeats=2), has_aging=True))
    channels = {c.name: c for c in find_channels(fitted.rows)}
    result = ScoreTestResult(0.0, 1, 9, 0.0)
    for names in (("repeat",), ("repeat", "time_s")):
        candidate = Candidate(names, "mu", "multiply", "run", np.empty((0, 0)), result, pair=len(names) > 1)
        forms = [term.effect for term, _ in terms_of(candidate, channels, fitted, EFFECTS)]
        assert forms
        assert not any(effect.periodic for effect in forms)


def test_a_speed_that_two_settings_do_not_explain_is_no_interaction_with_the_repeat():
    """Friction that falls between two speeds is no effect of both: the model has no curve of the speed."""

    def falls(table, force):
        return force * np.where(np.abs(table["speed_mm_s"]) > 5, 0.75, 1.0)

    for seed in range(3):
        pieces = []
        for piece in "ABCDEF":
            own = {"days": (), "speeds": (2.0, 10.0), "repeats": 2, "bins": 4, "specimen": 0.03}
            one = make_bins(100 * seed + ord(piece), effect=falls, **own).assign(specimen_id=piece)
            pieces.append(one.assign(file=piece + one["file"], run_id=piece + one["run_id"]))
        bins = pd.concat(pieces, ignore_index=True)
        tests = ScoreTests(fit_declared(make_rows(bins, has_aging=True)))
        channels = find_channels(tests.fitted.rows)
        singles = search(tests, channels, np.random.default_rng(0))
        pairs = search_pairs(tests, channels, singles, np.random.default_rng(0))
        assert min(c.p_value for c in (*singles, *pairs)) > 0.005
