from dataclasses import replace

import numpy as np
import numpy.testing as npt
import pytest
from bins_helpers import TWO_FOLDS, make_bins, make_traces
from scipy import stats

from sealfit.closure.channels import find_channels, level_values, scatter_level, settings, unit_of
from sealfit.closure.loop import close_loop
from sealfit.closure.multiplicity import log_p_of_t, slope_log_p
from sealfit.closure.score_test import ScoreTests
from sealfit.closure.search import search, search_pairs
from sealfit.closure.small_sample_test import ContrastTest, contrast_test, specimens_agree
from sealfit.fit.joint import fit_declared
from sealfit.fit.joint.rows import make_rows

FEW_SPEEDS = (1.0, 4.0, 16.0, 64.0)


def strongest(bins):
    """The smallest p-value of a claim in one search of single channels and pairs."""
    rows = make_rows(bins, has_aging=True)
    tests, channels, rng = ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0)
    singles = search(tests, channels, rng)
    return min(
        (c.p_value for c in (*singles, *search_pairs(tests, channels, singles, rng)) if c.claimable),
        default=1.0,
    )


def tilted(level, size_N, seed):
    """An effect that is none: every group of a level has a slope of its own along the stroke."""

    def shape(table, force):
        group = "".join(str(table[name].iloc[0]) for name in level)
        rng = np.random.default_rng([seed, *group.encode()])
        return force + rng.normal(0, size_N) * (table["displacement_mm"].to_numpy() - 20) / 40

    return shape


@pytest.mark.long
@pytest.mark.parametrize(
    ("days", "level"),
    [((1.0, 4.0, 16.0), ["condition"]), ((4.0,), ["condition"]), ((1.0, 4.0), ["run_id"])],
    ids=["seven specimens", "three specimens", "runs"],
)
def test_slopes_that_specimens_or_runs_have_at_random_are_no_effect(days, level):
    smallest = [
        strongest(
            make_bins(seed, days=days, speeds=FEW_SPEEDS, repeats=2, bins=8, effect=tilted(level, 0.5, seed))
        )
        for seed in range(5)
    ]
    assert min(smallest) > 0.0005  # the least of 5 uniform numbers is smaller in 2.5 of 1,000
    # More in 23 of 1,000; of p-values below 0.05 half the time, in 81 %.
    assert sum(p < 0.05 for p in smallest) <= 1


def test_the_same_slope_in_a_few_specimens_is_an_effect():
    def warmer(table, force):
        return force * (1 - 0.03 * (1 - np.exp(-table["distance_mm"].to_numpy() / 10)))

    bins = make_bins(
        3, days=(1.0, 4.0), temperatures=(60.0,), speeds=FEW_SPEEDS, repeats=2, bins=8, effect=warmer
    )
    assert strongest(bins) < 1e-4


@pytest.mark.parametrize(("share", "claimed"), [(0.1, True), (0.01, False)])
@pytest.mark.parametrize("temperatures", [(), (60.0,)], ids=["one specimen", "two specimens"])
def test_one_or_two_specimens_show_an_effect_only_if_it_is_larger_than_their_own_slopes(
    share, claimed, temperatures
):
    def warmer(table, force):
        return force * (1 - share * (1 - np.exp(-table["distance_mm"].to_numpy() / 10)))

    bins = make_bins(
        3, days=(4.0,), temperatures=temperatures, speeds=FEW_SPEEDS, repeats=3, bins=8, effect=warmer
    )
    assert (strongest(bins) < 1e-4) == claimed


def test_an_offset_that_stands_in_the_scatter_of_eight_runs_is_found():
    bins = make_bins(
        1, days=(4.0,), temperatures=(60.0,), speeds=FEW_SPEEDS, directions=(1, -1), repeats=1, bins=8,
        effect=lambda table, force: force + 1.5,
    )  # fmt: skip
    assert strongest(bins) < 1e-3


def test_one_contrast_of_equal_units_is_students_t():
    rng = np.random.default_rng(0)
    rows = make_rows(make_bins(0, days=(1.0, 4.0), speeds=FEW_SPEEDS, bins=8), has_aging=True)
    fitted = fit_declared(rows)
    units = rows.groups.starts["run"].size
    left = np.tile(np.linspace(-1, 1, 8), rows.force.size // 8)[:, None]
    noise = rng.normal(size=rows.force.size)
    test = contrast_test(replace(fitted, white_residual=noise), left, "run")
    scores = rows.groups.sums(left[:, 0] * noise, "run") / np.sqrt((left**2).sum())
    wanted = stats.ttest_1samp(scores, 0.0)
    npt.assert_allclose(test.slope / np.sqrt(test.variance), wanted.statistic, rtol=1e-9)
    npt.assert_allclose(test.df, units - 1, rtol=1e-9)


def test_a_contrast_of_two_groups_beside_their_mean_is_the_t_test_of_two_samples():
    rng = np.random.default_rng(0)
    rows = make_rows(make_bins(0, days=(1.0, 4.0), speeds=FEW_SPEEDS, bins=8), has_aging=True)
    units = rows.groups.starts["run"].size
    second = (np.arange(units) % 2)[rows.codes("run")]
    along = np.tile(np.linspace(-1, 1, 8), rows.force.size // 8)
    fitted = replace(fit_declared(rows), white_residual=5.0 * second * along + rng.normal(size=along.size))
    mean = along[:, None] / np.linalg.norm(along)
    left = (2.0 * second - 1.0)[:, None] * mean
    test = contrast_test(fitted.beside(mean), left, "run", other=mean)
    scores = rows.groups.sums(along * fitted.white_residual, "run")
    wanted = stats.ttest_ind(scores[1::2], scores[::2])
    npt.assert_allclose(test.slope / np.sqrt(test.variance), wanted.statistic, rtol=1e-9)
    npt.assert_allclose(test.df, units - 2, rtol=1e-9)


def test_a_contrast_of_units_that_other_columns_determine_is_not_tested():
    """Their deviations are rounding errors, to which any contrast is large."""
    rows = make_rows(make_bins(0, days=(1.0, 4.0), speeds=FEW_SPEEDS, bins=8), has_aging=True)
    run, rng = rows.codes("run"), np.random.default_rng(0)
    fitted = replace(fit_declared(rows), white_residual=rng.normal(size=run.size))
    scale = np.isin(run, (0, 1)) / np.sqrt(np.isin(run, (0, 1)).sum())
    left, mean = (np.where(run == 0, 1.0, -1.0) * scale)[:, None], scale[:, None]
    assert contrast_test(fitted.beside(mean), left, "run", other=mean) is None
    half = np.where(run == 2, 1.0, left[:, 0])[:, None]  # a third unit, which is free
    half /= np.linalg.norm(half)
    test = contrast_test(fitted.beside(mean), half, "run", other=mean)
    assert test is None or test.variance > 0.01


def test_moderated_p_values_are_uniform_where_every_unit_has_its_own_slope():
    rng = np.random.default_rng(5)
    units, contrasts, found = 8, 40, []
    for _ in range(400):
        own = (
            rng.normal(size=(units, 1)) * rng.uniform(0, 3) * rng.choice([-1, 1], contrasts)
        )  # shared by all
        scores = (own + rng.normal(size=(units, contrasts))) / np.sqrt(units)
        slope = scores.sum(axis=0)
        deviations = (scores - slope / units) / np.sqrt(1 - 1 / units)
        test = ContrastTest(
            "run", slope, (deviations**2).sum(axis=0), np.full(contrasts, units - 1.0),
            np.ones(contrasts, bool), deviations, np.empty((contrasts, 0)), np.ones(contrasts, bool),
        )  # fmt: skip
        found.append(slope_log_p([test])[0][0])
    assert np.mean(np.array(found) < np.log(0.01)) < 0.025


def test_log_p_of_students_t_far_out():
    npt.assert_allclose(
        log_p_of_t(np.array([12.0]), np.array([9.0])), np.log(2 * stats.t.sf(12.0, 9.0)), rtol=1e-9
    )


def test_jitter_moves_no_channel_to_another_level():
    bins = make_bins(repeats=3, bins=8)
    clean = {
        c.name: (c.unit, np.unique(c.values).size) for c in find_channels(make_rows(bins, has_aging=True))
    }
    rng = np.random.default_rng(2)
    for size in (1e-6, 1e-4, 1e-3):
        noisy = bins.assign(speed_mm_s=bins["speed_mm_s"] * (1 + size * rng.normal(size=len(bins))))
        found = {
            c.name: (c.unit, np.unique(c.values).size)
            for c in find_channels(make_rows(noisy, has_aging=True))
        }
        assert found["speed_mm_s"] == clean["speed_mm_s"] == ("run", 8)


def test_settings_are_groups_of_values_with_gaps_between_them():
    rng = np.random.default_rng(0)
    measured = np.repeat([1.0, 2.0, 50.0], 20) * (1 + 1e-4 * rng.normal(size=60))
    assert np.unique(settings(measured)).size == 3
    rounded = np.array([0.5, 15.0, np.nextafter(15.0, 16.0), 50.0])
    assert np.unique(settings(rounded)).size == 3
    goes_on = rng.uniform(1, 2, 300)
    assert settings(goes_on) is goes_on


def test_what_specimens_differ_in_is_judged_between_specimens():
    bins = make_bins(repeats=2, bins=4, run_channels={"oil_ppm": lambda rng: rng.normal()})
    rows = make_rows(bins, has_aging=True)
    channels = {c.name: c for c in find_channels(rows)}
    assert {
        name: scatter_level([channels[name]], rows) for name in ("displacement_mm", "speed_mm_s", "oil_ppm")
    } == {
        "displacement_mm": "specimen", "speed_mm_s": "specimen", "oil_ppm": "run",
    }  # fmt: skip
    assert scatter_level([channels["oil_ppm"], channels["temperature_C"]], rows) == "specimen"
    two = rows.subset(rows.codes("specimen") < 2)
    assert scatter_level([channels["displacement_mm"]], two) == "run"
    jittered = channels["oil_ppm"].values * (1 + 1e-5 * np.random.default_rng(0).normal(size=rows.force.size))
    assert unit_of(jittered, rows) == "run"
    assert np.unique(level_values(jittered, rows)).size == rows.groups.starts["run"].size


def test_two_specimens_with_the_same_slope_are_too_few_to_claim_it():
    def slope(table, force):
        return force * (1 + 0.03 * (table["displacement_mm"].to_numpy() - 20) / 40)

    bins = make_bins(3, days=(1.0,), temperatures=(60.0,), speeds=FEW_SPEEDS, repeats=5, bins=8, effect=slope)
    rows = make_rows(bins, has_aging=True)
    found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0))
    along = [c for c in found if c.channels == ("displacement_mm",) and c.p_value < 0.005]
    assert along
    assert not any(c.claimable for c in along)


@pytest.mark.parametrize(("of_aged", "claimed"), [(1.0, True), (0.6, True), (-1.0, False)])
def test_a_curve_of_the_speed_is_claimed_if_two_specimens_have_the_same(of_aged, claimed):
    def curve(table, force):
        share = np.where(table["aging_days"] > 0, of_aged, 1.0)
        return force * (1 + 0.06 * share * np.sin(2.5 * np.log(np.abs(table["speed_mm_s"]))))

    speeds = tuple(np.geomspace(0.5, 200, 14))
    bins = make_bins(3, days=(1.0,), temperatures=(60.0,), speeds=speeds, repeats=2, bins=4, effect=curve)
    rows = make_rows(bins, has_aging=True)
    assert rows.groups.starts["specimen"].size == 2
    found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0))
    shapes = [c for c in found if c.channels == ("speed_mm_s",) and c.columns.shape[1] > 1]
    assert any(c.p_value < 0.005 and c.claimable for c in shapes) == claimed


def test_what_two_specimens_show_is_a_candidate_and_the_verdict_cannot_tell():
    def slope(table, force):
        return force * (1 + 0.03 * (table["displacement_mm"].to_numpy() - 20) / 40)

    bins = make_bins(3, days=(1.0,), temperatures=(60.0,), speeds=FEW_SPEEDS, repeats=5, bins=8, effect=slope)
    document = close_loop(bins, make_traces(bins), TWO_FOLDS).document
    assert document["verdict"] == "cannot_tell"
    (candidate,) = document["effects"]
    assert candidate["candidate"]
    # With one load and constant speeds, heating by power over time is a line along the distance.
    forms = [candidate, *candidate["alternatives"]]
    assert any(form["channels"][0] in ("displacement_mm", "distance_mm") for form in forms)


def test_what_no_form_can_describe_is_no_candidate(monkeypatch):
    """Three days leave no form beside the aging law that has a and b of its own."""
    monkeypatch.setattr("sealfit.closure.selection._LoopState.propose", lambda *given: [])

    def slope(table, force):
        return force * (1 + 0.03 * (table["displacement_mm"].to_numpy() - 20) / 40)

    bins = make_bins(3, days=(1.0,), temperatures=(60.0,), speeds=FEW_SPEEDS, repeats=5, bins=8, effect=slope)
    assert close_loop(bins, make_traces(bins), TWO_FOLDS).document["effects"] == []


def test_what_one_specimen_of_two_holds_alone_is_not_said_to_differ_between_them():
    rows = make_rows(
        make_bins(2, days=(4.0,), temperatures=(60.0,), speeds=FEW_SPEEDS, bins=8), has_aging=True
    )
    fitted = fit_declared(rows)
    column = np.where(rows.codes("specimen") == 0, 1.0, 0.0)
    column *= np.where(rows.codes("stroke") % 2, 1.0, -1.0)  # constant in strokes
    assert specimens_agree(fitted, column[:, None]).tolist() == [True]
