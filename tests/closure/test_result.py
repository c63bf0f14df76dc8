"""closure.json by hand: errors held out, verdict, what is left, and how effects are written down."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from bins_helpers import make_bins

from sealfit.closure import result
from sealfit.closure.channels import find_channels
from sealfit.closure.confirm import NO_GAIN, AcceptedEffect, RefusedEffect
from sealfit.closure.forms import describe
from sealfit.closure.linearised import Proposal
from sealfit.closure.result import (
    BeforeAfter,
    channels_of,
    closure_document,
    effect_level,
    effect_table,
    fit_quality,
    form_of,
    left_entry,
    parameter_unit,
)
from sealfit.closure.ripples import Peak
from sealfit.closure.score_test import Candidate, ScoreTestResult
from sealfit.closure.selection import Selection
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.fit.joint import fit_declared, fitted_at
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import make_rows
from sealfit.units import Units

TORQUE = Units(
    {"force": ("torque", "mN m"), "displacement": ("angle", "turn"), "speed": ("rotational speed", "rpm")}
)
WARMING = Term(EFFECTS["warming_distance"], ("distance_mm",), "mu", "multiply")
PEAK = Peak("time_s", 0.3, True, True, 9.0, 1e-4, 1.0)


@pytest.fixture(scope="module")
def fitted():
    """The declared model on one specimen: five speeds both ways, each made twice."""
    bins = make_bins(
        2, temperatures=(), days=(), speeds=(1.0, 4.0, 16.0, 64.0, 100.0), directions=(1, -1), repeats=2,
        bins=4,
        run_channels={"oil_ppm": lambda rng: rng.normal(50.0, 5.0)},
    )  # fmt: skip
    return fit_declared(make_rows(bins, has_aging=True))


@pytest.fixture(scope="module")
def selection(fitted):
    """The end of a loop that found nothing, with effects and candidates of one's choice put in."""
    channels = {c.name: c for c in find_channels(fitted.rows)}
    return Selection(fitted, fitted, (), (), (), None, None, channels)


def accepted(fitted, term=WARMING, values=(-0.05, 10.0), p_value=1e-8, rivals=()):
    numbers = dict(zip([p.name for p in term.effect.parameters], values, strict=True))
    after = fitted_at(fitted.model.with_term(term, numbers), fitted.rows, fitted.scatter)
    column = np.ones(fitted.force.size)
    proposal = Proposal(
        term, numbers, "run", 10, 50.0, p_value, column, (term.channels, "mu", "multiply"), fitted=after
    )
    return AcceptedEffect(proposal, 0.2, 0.4, rivals, 1), after


def candidate(*channels, p_value=1e-3, log_p=-9.0, chi2=20.0, unit="run"):
    return Candidate(
        channels, "mu", "multiply", unit, np.ones((4, 1)), ScoreTestResult(chi2, 1, 10, log_p), p_value
    )


# ---------------------------------------------------------------- errors held out
def test_an_error_held_out_weighs_rows_and_leaves_out_what_is_not_covered():
    rows = SimpleNamespace(force=np.array([1.0, 2.0, 3.0, 4.0]), weight=np.array([0.1, 0.2, 0.3, 0.4]))
    held = np.array([2.0, np.nan, 5.0, 7.0])  # errors of 1, 2 and 3; the second row was never held out
    every, first = np.ones(4, dtype=bool), np.array([True, True, True, False])
    for covered, determined in ((first, every), (every, first)):
        models = BeforeAfter(SimpleNamespace(rows=rows), None, held, held, covered, determined)
        assert models.heldout_rmse_N(held) == pytest.approx(np.sqrt((0.1 * 1 + 0.3 * 4) / 0.4))
        assert models.heldout_rmse_N(held, extrapolated=True) == pytest.approx(3.0)
        assert models.heldout_rmse_N(np.full(4, np.nan)) is None


@pytest.mark.parametrize(
    ("p_value", "floor", "state", "ratio"),
    [
        (0.04, 0.5, "above_scatter", 2.0), (0.06, 0.5, "within_scatter", 2.0),
        (None, 0.5, "unknown", None), (0.04, None, "unknown", None),
    ],
)  # fmt: skip
def test_the_error_is_compared_with_what_repeats_scatter_by(p_value, floor, state, ratio):
    found = fit_quality({"rmse_N": 1.0, "lack_of_fit_p": p_value}, floor)
    assert (found["state"], found["ratio"]) == (state, ratio)
    assert found["p_value"] == (None if state == "unknown" else p_value)


# ---------------------------------------------------------------- the verdict
def document(selection, after=None):
    after = selection.after if after is None else after
    held = np.full(after.force.size, np.nan)
    every = np.ones(held.size, dtype=bool)
    models = BeforeAfter(selection.before, after, held, held, every, every)
    return closure_document(replace(selection, after=after), models, "run", Config(), EFFECTS)


def test_the_verdict_says_what_was_found_and_what_is_left(selection, fitted, monkeypatch):
    item, after = accepted(fitted)
    weak, strong = (
        RefusedEffect(Proposal(WARMING, {}, "run", 1, 0.0, p, np.zeros(0), ()), "it does not lower the error")
        for p in (1e-4, 1e-7)
    )
    small = RefusedEffect(strong.proposal, NO_GAIN)
    left = candidate("oil_ppm")
    unclaimable = replace(left, test_result=left.test_result._replace(consistent=False))
    verdicts = {
        "closed": document(replace(selection, added=(item,)), after),
        "unexplained": document(replace(selection, left=left)),
        "cannot_tell": document(replace(selection, left=unclaimable, inconclusive=item)),
        "nothing_missing": document(replace(selection, refused=(small,))),
    }
    assert {name: found["verdict"] for name, found in verdicts.items()} == {name: name for name in verdicts}
    assert document(replace(selection, added=(item,), left=left), after)["verdict"] == "unexplained"
    monkeypatch.setattr(result, "noise_floor", lambda fitted: 100.0)  # the error is far below it
    within = document(replace(selection, added=(item,), left=left), after)
    assert (within["verdict"], within["left"]["significant"]) == ("closed", True)
    monkeypatch.undo()
    assert document(replace(selection, left=unclaimable))["verdict"] == "cannot_tell"  # no form describes it
    assert document(replace(selection, refused=(strong,)))["verdict"] == "cannot_tell"
    assert document(replace(selection, worse=(strong,), refused=(strong,)))["verdict"] == "unexplained"
    refused = document(replace(selection, refused=(weak, strong)))
    assert refused["verdict"] == "cannot_tell"
    assert [(entry["id"], entry["weak"], entry["reason"]) for entry in refused["refused"]] == [
        ("warming_distance", True, weak.reason), ("warming_distance", False, strong.reason),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("acts_on", "operation", "words"),
    [
        ("mu", "multiply", "factor on friction"),
        ("mu_s", "add", "added to F_s"),
        ("v_s", "add", "added to v_s"),
    ],
)
def test_without_a_load_a_label_names_what_is_fitted(acts_on, operation, words, fitted):
    term = replace(WARMING, acts_on=acts_on, operation=operation)
    assert describe(term, replace(fitted.rows, has_load=False)) == f"warming by sliding (distance), {words}"


def test_the_place_of_a_jump_lies_between_two_neighbouring_values(selection, fitted):
    item, after = accepted(fitted, Term(EFFECTS["step"], ("distance_mm",), "mu", "multiply"))
    (entry,) = document(replace(selection, added=(item,)), after)["effects"]
    (place,) = [p for p in entry["parameters"] if p["name"] == "x_0"]
    values = np.unique(fitted.rows.values("distance_mm"))
    low, high = place["ci95"]
    assert low <= place["value"] <= high
    assert values.searchsorted(high) == values.searchsorted(low) + 1


def test_an_effect_is_written_with_its_intervals_and_rivals(selection, fitted):
    rivals = tuple(
        (accepted(fitted, replace(WARMING, acts_on=name))[0].proposal, rmse)
        for name, rmse in (("force", 0.41), ("mu_c", np.nan))
    )
    item, after = accepted(fitted, rivals=rivals)
    (entry,) = document(replace(selection, added=(item,)), after)["effects"]
    assert entry["label"] == "warming by sliding (distance), factor on mu"
    assert (entry["level"], entry["channels"], entry["named"], entry["candidate"]) == (
        "trace", ["distance_mm"], True, False,
    )  # fmt: skip
    assert (entry["heldout_gain_N"], entry["heldout_rmse_N"], entry["p_value"]) == (0.2, 0.4, 1e-8)
    amplitude, length = entry["parameters"]
    assert (amplitude["value"], length["value"]) == (-0.05, 10.0)
    assert (amplitude["unit"], length["unit"]) == ("", "mm")
    assert all(p["ci95"][0] < p["value"] < p["ci95"][1] for p in entry["parameters"])
    assert entry["alternatives"] == [
        {"id": "warming_distance", "channels": ["distance_mm"], "acts_on": "force", "heldout_rmse_N": 0.41},
        {"id": "warming_distance", "channels": ["distance_mm"], "acts_on": "mu_c", "heldout_rmse_N": None},
    ]
    (inconclusive_effect,) = document(replace(selection, inconclusive=item))["effects"]
    assert inconclusive_effect["candidate"]
    assert {**inconclusive_effect, "candidate": False} == entry
    table = effect_table([entry], [item])
    assert table[["round", "id", "channels", "parameter"]].to_numpy().tolist() == [
        [1, "warming_distance", "distance_mm", "A"], [1, "warming_distance", "distance_mm", "s_0"],
    ]  # fmt: skip
    assert table[["value", "lo95", "hi95"]].to_numpy().tolist() == [
        [p["value"], *p["ci95"]] for p in entry["parameters"]
    ]


def test_a_table_of_no_effects_has_its_columns():
    table = effect_table([], [])
    assert table.empty
    assert {"round", "id", "parameter", "value", "lo95", "hi95", "unit", "p_value"} <= set(table)


# ---------------------------------------------------------------- what is left
def test_the_error_left_is_what_exceeds_the_floor(selection):
    assert left_entry(selection, 0.5, 0.3)["rmse_N"] == pytest.approx(0.4)
    assert left_entry(selection, 0.2, 0.3)["rmse_N"] == 0.0
    assert left_entry(selection, 0.5, None)["rmse_N"] is None


def test_what_is_still_significant_is_named_at_its_level(selection):
    def left(found, **more):
        entry = left_entry(replace(selection, left=found, **more), 0.5, 0.3)
        return entry["level"], entry["channel"], entry["p_value"]

    assert left(PEAK) == ("trace", "time_s", 1e-4)
    assert left(candidate("oil_ppm")) == ("run", "oil_ppm", 1e-3)
    assert left(candidate("displacement_mm", "oil_ppm")) == ("trace", "displacement_mm oil_ppm", 1e-3)
    assert left(candidate("direction", "oil_ppm")) == ("run", "direction oil_ppm", 1e-3)
    assert left(candidate("condition", unit="specimen")) == ("condition", "condition", 1e-3)
    assert left(None) == (None, None, None)
    not_significant = candidate("oil_ppm", p_value=0.3), candidate("time_s", p_value=0.9)
    assert left(None, first=not_significant) == (None, None, 0.3)


def test_an_effect_that_lowered_no_error_is_left(selection):
    worse = RefusedEffect(Proposal(WARMING, {}, "run", 1, 0.0, 1e-7, np.zeros(0), ()), "it lowers no error")
    entry = left_entry(replace(selection, worse=(worse,)), 0.5, 0.3)
    assert (entry["level"], entry["channel"], entry["p_value"]) == ("trace", "distance_mm", 1e-7)


# ---------------------------------------------------------------- how an effect is written down
def test_an_unsigned_force_along_a_channel_of_runs_is_told_by_the_direction_too(fitted):
    rows = fitted.rows
    added = Term(EFFECTS["linear"], ("oil_ppm",), "force", "add", {"x_ref": 50.0})
    assert channels_of(added, rows) == ["direction", "oil_ppm"]
    assert channels_of(replace(added, operation="multiply"), rows) == ["oil_ppm"]
    assert channels_of(replace(added, channels=("displacement_mm",)), rows) == ["displacement_mm"]
    one_way = rows.subset(rows.speed > 0)
    assert channels_of(added, one_way) == ["oil_ppm"]
    assert effect_level(added, rows) == "run"
    assert effect_level(WARMING, rows) == "trace"


@pytest.mark.parametrize(
    ("term", "unit", "expected"),
    [
        (Term(EFFECTS["linear"], ("displacement_mm",), "mu", "multiply"), "{y}/{x}", "1/turn"),
        (Term(EFFECTS["linear"], ("displacement_mm",), "force", "add"), "{y}/{x}", "mN m/turn"),
        (Term(EFFECTS["linear"], ("displacement_mm",), "sigma_2", "add"), "{y}", "mN m/(rpm)"),
        (Term(EFFECTS["linear"], ("displacement_mm",), "v_s", "add"), "{y}", "rpm"),
        (Term(EFFECTS["linear"], ("displacement_mm",), "mu_s", "add"), "{y}", ""),
        (
            Term(EFFECTS["product"], ("speed_mm_s", "displacement_mm"), "mu", "multiply"),
            "1/({x} {z})",
            "1/(rpm turn)",
        ),
    ],
)
def test_units_of_parameters_are_those_of_the_rig(term, unit, expected):
    assert parameter_unit(unit, term, TORQUE) == expected


def test_an_equation_is_written_with_its_reference():
    term = Term(EFFECTS["linear"], ("oil_ppm",), "mu", "multiply", {"x_ref": 50.25})
    assert form_of(term) == "A (x - 50.25)"
    ripple = Term(EFFECTS["ripple"], ("displacement_mm",), "force", "add", {"x_ref": 0.0})
    assert form_of(ripple) == "A sin(2 pi x / lambda + phi)"
    far = Term(EFFECTS["ripple"], ("displacement_mm",), "force", "add", {"x_ref": 1e6})
    assert form_of(far) == "A sin(2 pi (x - 1e+06) / lambda + phi)"
    fixed = {"speed_mm_s_ref": 6.82, "distance_mm_ref": 39.4}
    warming = Term(EFFECTS["warming_conduction"], ("distance_mm", "speed_mm_s"), "mu", "multiply", fixed)
    assert form_of(warming) == "-A sqrt(|v| s / (6.82 39.4))"


def test_the_speed_of_strokes_both_ways_in_one_file_varies_between_runs():
    bins = make_bins(directions=(1, -1), repeats=1, bins=8, speeds=(10.0, 30.0, 100.0))
    speed = bins["speed_set_mm_s"].abs().map("{:g}".format)
    together = {"file": bins["condition"] + speed, "run_id": bins["condition"] + speed}
    rows = make_rows(bins.assign(**together, stroke=1 + (bins["speed_mm_s"] < 0)), has_aging=True)
    slower = Term(EFFECTS["log_rate"], ("speed_mm_s",), "mu", "multiply", {"v_ref": 30.0})
    assert effect_level(slower, rows) == "run"
