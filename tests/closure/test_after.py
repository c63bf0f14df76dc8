"""The fits of the after-model: effects taken out at their reference, with their uncertainty."""

import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from bins_helpers import TRUE, make_bins, make_traces, warm

from sealfit.closure.after import (
    KEPT,
    after_fits,
    after_laws,
    at_reference,
    law_df,
    reference_of,
    without_effects,
)
from sealfit.closure.errors_and_intervals import t_quantile
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.fit.aging.all_series import law_of, shared_levels
from sealfit.fit.aging.lifetime import Goal, lifetime
from sealfit.fit.dynamic import fit_dynamic
from sealfit.fit.joint import fit, fit_declared
from sealfit.fit.joint.model import Term, evaluate
from sealfit.fit.joint.rows import make_rows
from sealfit.fit.steady import fit_conditions
from sealfit.fit.steady.uncertainty import shifts_of
from sealfit.pipeline import MADE
from sealfit.tables import AFTER, AGING_FIT, SCHEMAS

SCATTER = {"setup": 0.003, "specimen": 0.005, "bins": 10}
WARMING = (Term(EFFECTS["warming_time"], ("time_s",), "mu", "multiply"), {"A": 0.05, "tau": 3.0})


def steady_of(bins):
    """Return table `steady` of bins of equal size."""
    keys = ["file", "stroke"]
    others = {name: "first" for name in bins.columns if name not in (*keys, "force_N", "n")}
    table = bins.groupby(keys, sort=False).agg({**others, "force_N": "mean", "n": "sum"}).reset_index()
    return table.assign(used=True, force_se_N=0.05)


def fitted(bins, *terms):
    before = fit_declared(make_rows(bins, has_aging=True))
    model = before.model
    for term, values in terms:
        model = model.with_term(term, values)
    return fit(model, before.rows, before.scatter, turns=2)


@pytest.fixture(scope="module")
def warmed():
    bins = make_bins(7, effect=warm, **SCATTER)
    after = fitted(bins, WARMING)
    return steady_of(bins), after, after_fits(after, steady_of(bins), made_traces(bins), Config())


def conditions_of(tables):
    """Return the fits of the conditions without the effects."""
    return {name: tables[f"{name}_after"] for name in MADE["fit-steady"]}


def made_traces(bins):
    return make_traces(bins).assign(condition=bins["condition"])


def test_the_forces_are_those_of_rubber_that_does_not_warm(warmed):
    steady, _, tables = warmed
    cold = steady_of(make_bins(7, **SCATTER))
    slow = steady["speed_set_mm_s"] == 1.0  # its strokes last 40 s: the mean loss is 4.6 % of some 40 N
    assert (cold["force_N"] - steady["force_N"])[slow].mean() > 1.2
    left = tables["steady_after"]["force_N"] - cold["force_N"]
    assert np.abs(left[slow]).max() < 0.05
    npt.assert_allclose(
        left + tables["steady_after"]["effects_N"], steady["force_N"] - cold["force_N"], atol=1e-9
    )


def test_the_shifts_hold_the_covariance_that_the_effects_give_the_forces(warmed):
    _, after, tables = warmed
    shifts = tables["steady_after"][shifts_of(tables["steady_after"])].to_numpy()
    place = after.model.term_slice(0)
    derivative = pd.DataFrame(evaluate(after.model, after.rows)[1].toarray()[:, place])
    means = derivative.groupby([after.rows.table["file"], after.rows.table["stroke"]], sort=False).mean()
    means = means.loc[pd.MultiIndex.from_frame(tables["steady_after"][["file", "stroke"]])].to_numpy()
    expected = means @ after.covariance[place, place] @ means.T
    npt.assert_allclose(shifts @ shifts.T, expected, atol=1e-3 * np.abs(expected).max())


def test_the_law_of_a_series_is_that_of_the_joint_fit(warmed):
    _, after, tables = warmed
    law = tables["aging_fit_after"].set_index(["series", "quantity", "parameter"])
    assert law_df(after) == 4  # nine specimens; mu_0, and a and b of two series
    declared = after.model.declared
    place = next(k for k, p in enumerate(declared.parameters) if (p.quantity, p.owner) == ("mu_0s", "rubber"))
    error = np.sqrt(after.covariance[place, place])
    for series in (
        "temperature_C=60, compression_ratio_pct=80",
        "temperature_C=80, compression_ratio_pct=80",
    ):
        row = law.loc[(series, "mu_s", "mu_0")]
        assert row["value"] == after.model.theta[place]
        assert row["hi95"] - row["value"] == pytest.approx(t_quantile(4.0) * error)
        assert row["lo95"] < TRUE["mu_s0"] < row["hi95"]
        assert law.loc[(series, "mu_s", "b"), "lo95"] < TRUE["b_s"] < law.loc[(series, "mu_s", "b"), "hi95"]
    assert set(law["model"]) == {"after"}
    before = fit_conditions(steady_of(make_bins(7, effect=warm, **SCATTER)), Config())["steady_fit"]
    unaged = before[(before["condition"] == "unaged") & (before["parameter"] == "mu_s")]
    assert unaged["hi95"].iloc[0] < TRUE["mu_s0"]  # warm


def test_the_curve_of_a_law_passes_through_it_with_its_errors(warmed):
    _, _, tables = warmed
    law = tables["aging_fit_after"].set_index(["series", "quantity", "parameter"])
    for (series, quantity), curve in tables["aging_curves_after"].groupby(["series", "quantity"]):
        mu_0, a, b = (law.loc[(series, quantity, name)] for name in ("mu_0", "a", "b"))
        expected = mu_0["value"] - a["value"] * np.log1p(curve["aging_days"] / b["value"])
        npt.assert_allclose(curve["value"], expected, rtol=1e-6)
        npt.assert_allclose(curve["hi95"].iloc[0], mu_0["hi95"], rtol=1e-6)


def test_life_is_longer_than_warm_rubber_makes_it_look(warmed):
    steady, _, tables = warmed
    goal = Goal(TRUE["mu_s0"] - TRUE["a_s"] * np.log1p(8.0 / TRUE["b_s"]))
    after = lifetime(law_of(tables["steady_after"], conditions_of(tables), "mu_s", "log")[0], goal, 60.0)
    before = lifetime(law_of(steady, fit_conditions(steady, Config()), "mu_s", "log")[0], goal, 60.0)
    assert after.low < 8.0 < after.high
    assert before.high < 8.0


def test_the_effects_uncertainty_is_common_to_all_conditions(warmed):
    _, after, tables = warmed
    free, conditions = tables["steady_after"], conditions_of(tables)
    known = free.drop(columns=shifts_of(free))
    _, alone = shared_levels(known, fit_conditions(known, Config()))
    levels, covariance = shared_levels(free, conditions)
    added = (covariance - alone).toarray()
    place = after.model.term_slice(0)
    share = 0.035 / 0.05  # of the warming, in the mean of a stroke at mu_s: some 3.5 of 5 percent
    error = share * np.sqrt(after.covariance[place, place][0, 0]) * levels["value"].to_numpy()
    unlike = levels["condition"].to_numpy()[:, None] != levels["condition"].to_numpy()[None, :]
    assert (added[unlike] > 0).all()
    npt.assert_allclose(np.sqrt(np.diag(added)) / error, 1.0, atol=0.6)


def test_an_offset_is_taken_out_of_both_directions():
    def offset(table, force):
        return force + 1.5

    bins = make_bins(5, directions=(1, -1), temperatures=(60.0,), effect=offset, **SCATTER)
    after = fitted(bins, (Term(EFFECTS["zero_offset"], ("direction",), "force", "add"), {"A": 1.5}))
    free = without_effects(steady_of(bins), after, Config())
    npt.assert_allclose(free["effects_N"], after.model.values[0]["A"])
    npt.assert_allclose(free["effects_start_N"], after.model.values[0]["A"])
    shift = free[shifts_of(free)].to_numpy()[:, 0] * free["direction"].to_numpy()
    npt.assert_allclose(shift, shift[0])  # along the motion it has the sign of the direction
    one = fit_conditions(free, Config())["steady_fit"]
    unaged = one[
        (one["condition"] == "unaged") & (one["parameter"] == "mu_s") & (one["quantity"] == "steady")
    ].iloc[0]
    assert unaged["value"] == pytest.approx(TRUE["mu_s0"], rel=0.015)


def test_starts_are_fitted_to_forces_without_the_offset():
    """A straight rise over 1 mm to 30 N, and 2 N more shown by the sensor."""
    distance = np.linspace(0.0, 10.0, 400)
    force = 30.0 * np.minimum(distance, 1.0) + 2.0
    keys = {
        "file": "a.csv",
        "repeat": 1,
        "stroke": 1,
        "specimen_id": "s",
        "condition": "unaged",
        "direction": 1,
    }
    trace = pd.DataFrame({**keys, "time_s": distance, "displacement_mm": distance, "force_N": force})
    steady = {
        **keys,
        "series": "unaged",
        "rubber": "rubber",
        "run_id": "r",
        "speed_mm_s": 1.0,
        "speed_set_mm_s": 1.0,
    }
    steady = pd.DataFrame([{**steady, "load_N": 50.0, "force_N": 30.0, "effects_start_N": 2.0, "used": True}])
    none = {name: pd.DataFrame(columns=SCHEMAS[name].names()) for name in MADE["fit-steady"]}
    traces = trace.assign(steady=distance > 3.0)
    curve = fit_dynamic(traces, steady, none, Config())["dynamic_curves"]
    assert curve["force_N"].max() == pytest.approx(30.0, abs=0.01)


def test_an_effect_of_days_alone_stays_in_the_values():
    term = Term(EFFECTS["aging_induction"], ("aging_days",), "mu", "multiply")
    values = {"A": 0.04, "t_i": 3.0}

    def induction(table, force):
        return force * (1 + term.effect.shape({"aging_days": table["aging_days"].to_numpy(float)}, **values))

    bins = make_bins(2, temperatures=(60.0,), effect=induction, setup=0.001, bins=4)
    after = fitted(bins, (term, values))
    assert reference_of(term, values, Config()) == KEPT
    assert at_reference(after.model, Config()).terms == (term,)
    steady = steady_of(bins)
    free = without_effects(steady, after, Config())
    npt.assert_array_equal(free["force_N"], steady["force_N"])
    assert shifts_of(free) == []
    law, curves = after_laws(after, fit_conditions(free, Config()), Config())
    fit_of = law["aging_fit"].set_index(["quantity", "parameter"])
    curve = curves[curves["quantity"] == "mu_s"]
    mu_0, a, b = (fit_of.loc[("mu_s", name), "value"] for name in ("mu_0", "a", "b"))
    shape = term.effect.shape({"aging_days": curve["aging_days"].to_numpy()}, **after.model.values[0])
    expected = (mu_0 - a * np.log1p(curve["aging_days"] / b)) * (1 + shape)
    npt.assert_allclose(curve["value"], expected, rtol=1e-6)
    assert "aging_induction" in fit_of.loc[("mu_s", "a"), "reason"]


@pytest.mark.parametrize(
    ("id", "channels", "fixed", "values", "words"),
    [
        ("warming_distance", ("distance_mm",), {}, {}, "cold contact (distance 0)"),
        ("zero_offset", ("direction",), {}, {}, "zero offset removed"),
        ("linear", ("oil_ppm",), {"x_ref": 50.25}, {}, "oil ppm = 50.25"),
        ("product", ("oil_ppm", "dust_mg"), {"x_ref": 50.0, "z_ref": 5.0}, {}, "oil ppm = 50 or dust mg = 5"),
        ("log_rate", ("speed_mm_s",), {"speed_mm_s_ref": 7.25}, {}, "sliding speed (mm/s) = 7.25"),
        ("exponential_approach", ("distance_mm",), {}, {}, "sliding distance (mm) = 0"),
        ("step", ("run_order",), {}, {"A": 1.0, "x_0": 33.5}, "run order below 33.5"),
    ],
)
def test_the_reference_is_said_in_words(id, channels, fixed, values, words):
    term = Term(EFFECTS[id], channels, EFFECTS[id].acts_on[0][0], EFFECTS[id].acts_on[0][1], fixed)
    assert reference_of(term, values, Config()) == words


@pytest.mark.parametrize(
    "columns", [["temperature_C", "compression_ratio_pct"], None], ids=["no aging", "two days"]
)
def test_without_a_law_there_are_still_conditions(columns):
    bins = make_bins(3, effect=warm, days=(2.0,), temperatures=(60.0,), bins=3)
    config = Config() if columns is None else Config(condition=columns)
    before = fit_declared(make_rows(bins, has_aging=config.aging))
    after = fit(before.model.with_term(*WARMING), before.rows, before.scatter, turns=1)
    table = steady_of(bins) if config.aging else steady_of(bins).drop(columns="aging_days")
    tables = after_fits(after, table, made_traces(bins), config)
    law = tables["aging_fit_after"]
    assert not law["identified"].any()
    assert (law["value"].notna().sum(), len(tables["aging_curves_after"])) == (0, 0)
    values = tables["steady_fit_after"].query("quantity == 'steady' and parameter == 'mu_s'")
    assert values["identified"].all()
    assert len(values) == 2


def test_nothing_is_doubled_where_nothing_was_added():
    bins = make_bins(1, temperatures=(60.0,), bins=2)
    tables = after_fits(fitted(bins), steady_of(bins), made_traces(bins), Config())
    assert list(tables) == [schema.name for schema in AFTER]
    assert all(table.empty for table in tables.values())


def test_a_file_that_the_loop_left_out_is_in_no_fit_after_it():
    bins = make_bins(1, temperatures=(60.0,), bins=2)
    wrong = bins["file"].iloc[-1]
    steady = steady_of(bins)
    steady.loc[steady["file"] == wrong, "force_N"] *= 1.3
    after = fitted(bins[bins["file"] != wrong])
    tables = after_fits(after, steady, made_traces(bins), Config(), left_out=True)
    sound = fit_conditions(steady[steady["file"] != wrong], Config())["steady_fit"]
    found = tables["steady_fit_after"]
    npt.assert_allclose(found["value"], sound["value"], rtol=1e-9, atol=1e-12)
    assert set(found["model"]) == {"after"}
    assert not tables["aging_fit_after"].empty


def test_a_condition_may_be_called_rubber():
    bins = make_bins(7, days=(4.0,), **SCATTER)
    steady = fit_conditions(steady_of(bins), Config())
    law, _ = after_laws(fitted(bins), steady, Config(condition=["rubber", "temperature_C", "aging_days"]))
    assert list(law["aging_fit"].columns) == [*AGING_FIT.names(), "temperature_C"]
    assert set(law["aging_fit"]["rubber"]) == {"rubber"}


def test_three_speeds_have_laws_of_the_mean_coefficient_as_before_the_loop():
    bins = make_bins(7, speeds=(1.0, 8.0, 32.0), effect=warm, **SCATTER)
    after = fitted(bins, WARMING)
    assert "interpolated" in after.model.declared.stribeck.values()
    tables = after_fits(after, steady_of(bins), made_traces(bins), Config())
    law = tables["aging_fit_after"]
    assert set(law["model"]) == {"after"}
    assert set(law.loc[law["parameter"] == "mu_0", "quantity"]) == {"mu_c"}
    assert set(tables["aging_curves_after"]["quantity"]) == {"mu_c"}
