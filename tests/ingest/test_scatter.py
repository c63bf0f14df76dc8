import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from scipy.optimize import nnls

from sealfit.ingest.repeat_checks import outlying_repeats
from sealfit.ingest.scatter import RepeatCodes, fit_scatter, repeat_means, repeat_scatter, two_nonnegative

S0, G = 0.1, 0.01


def campaign(runs, rng, repeats=3, pattern=(0.02, 0.0, -0.015), shift=0.0):
    """Repeats of runs from 5 to 50 N, sd^2 = S0^2 + (G F)^2; the first of run r0 is off by `shift` SDs."""
    level = rng.uniform(5.0, 50.0, runs)[:, None]
    sd = np.sqrt(S0**2 + (G * level) ** 2)
    force = level * (1.0 + np.array(pattern[:repeats])) + sd * rng.normal(size=(runs, repeats))
    force[0, 0] += shift * sd[0, 0]
    return pd.DataFrame(
        {
            "file": [f"{r}/{k}" for r in range(runs) for k in range(repeats)],
            "run_id": np.repeat([f"r{r}" for r in range(runs)], repeats),
            "repeat": np.tile(np.arange(1, repeats + 1), runs),
            "force_N": force.ravel(),
        }
    )


def test_scatter_and_pattern_of_repeats_are_recovered():
    rng = np.random.default_rng(4)
    campaigns = [campaign(200, rng) for _ in range(10)]
    found = [repeat_scatter(means) for means in campaigns]
    assert np.sqrt(np.mean([s.s0_N**2 for s in found])) == pytest.approx(S0, rel=0.15)
    assert np.sqrt(np.mean([s.g**2 for s in found])) == pytest.approx(G, rel=0.05)
    # 200 runs of three have 400 degrees of freedom; the common pattern of three numbers takes two.
    assert found[0].df == 398
    means, force = campaigns[0], campaigns[0]["force_N"].to_numpy()
    fit = fit_scatter(RepeatCodes.of(means), force, np.ones(len(means), bool))
    taken_out = (force / (fit.mean + fit.residual) - 1.0).reshape(-1, 3)
    npt.assert_allclose(taken_out, np.tile(taken_out[0], (200, 1)), atol=1e-12)
    npt.assert_allclose(taken_out[0], np.array([0.02, 0.0, -0.015]) - 0.005 / 3, atol=0.003)
    npt.assert_allclose(found[0].sd_N([0.0, 30.0]), [found[0].s0_N, np.hypot(found[0].s0_N, 30 * found[0].g)])


def test_scatter_of_equal_forces_is_the_pooled_standard_deviation_by_hand():
    # Two runs: variances 1 (1, 2, 3) and 4 (8, 10, 12 less 8): pooled (2*1 + 2*4) / 4 = 2.5.
    means = pd.DataFrame(
        {
            "file": list("abcdef"),
            "run_id": list("xxxyyy"),
            "repeat": [1, 2, 3] * 2,
            "force_N": [11, 12, 13, 10, 12, 14.0],
        }
    )
    scatter = repeat_scatter(means)
    assert scatter.s0_N == pytest.approx(np.sqrt(2.5))
    assert (scatter.g, scatter.df) == (0.0, 4)


def test_without_repeats_there_is_no_scatter_to_know():
    single = pd.DataFrame({"file": ["a", "b"], "run_id": ["x", "y"], "repeat": [1, 1], "force_N": [1.0, 2.0]})
    scatter = repeat_scatter(single)
    assert scatter.df == 0
    assert np.isnan(scatter.s0_N)
    assert len(outlying_repeats(single, 0.001)) == 0
    assert len(outlying_repeats(single.iloc[:0], 0.001)) == 0


def test_strokes_of_one_file_count_once_and_unused_rows_not_at_all():
    steady = pd.DataFrame(
        {"file": ["a", "a", "b", "b"], "run_id": "x", "repeat": [1, 1, 2, 2],
         "force_N": [-1.0, -3.0, -5.0, -70.0], "used": [True, True, True, False]}
    )  # fmt: skip
    means = repeat_means(steady)
    assert means["force_N"].tolist() == [2.0, 5.0]


def test_files_with_a_stroke_each_are_one_repeat():
    table = campaign(6, np.random.default_rng(1))
    split = pd.concat([table.assign(file=table["file"] + f"/{k}") for k in range(4)], ignore_index=True)
    npt.assert_allclose(repeat_means(split)["force_N"], repeat_means(table)["force_N"])
    assert repeat_scatter(repeat_means(split)).df == repeat_scatter(repeat_means(table)).df


@pytest.mark.parametrize("runs", [6, 24])
def test_false_flags_keep_to_the_family_wise_level(runs):
    rng = np.random.default_rng(runs)
    flagged = sum(len(outlying_repeats(campaign(runs, rng), 0.05)) > 0 for _ in range(300))
    # Binomial(300, 0.05): mean 15, SD 3.8; more than 27 is beyond 3 SDs.
    assert flagged <= 27


def test_a_shifted_repeat_is_found_as_often_as_the_best_possible_test_finds_it():
    # A shift of d SDs stands d sqrt(2/3) SDs of a residual off its run; of 180 repeats at 0.001 the limit is
    # about 4.6. d = 6 leaves it at 4.9 (power about 0.6), d = 8 at 6.5 (0.97).
    rng = np.random.default_rng(8)
    found = {}
    for shift in (6.0, 8.0):
        flagged = [set(outlying_repeats(campaign(60, rng, shift=shift), 0.001)["file"]) for _ in range(60)]
        found[shift] = np.mean(["0/0" in files for files in flagged])
        assert sum(len(files - {"0/0"}) for files in flagged) <= 1
    assert found[6.0] > 0.3
    assert found[8.0] > 0.8


def test_several_outliers_do_not_hide_each_other():
    means = campaign(60, np.random.default_rng(2))
    for run in (0, 10, 20, 30):
        means.loc[3 * run + 1, "force_N"] *= 1.3
    assert set(outlying_repeats(means, 0.001)["file"]) == {"0/1", "10/1", "20/1", "30/1"}


def test_equal_outliers_of_pairs_do_not_hide_each_other():
    """Each inflates the scatter of the others: none of them is three SDs off while all are in."""
    means = campaign(24, np.random.default_rng(5), repeats=2, pattern=(0.0, 0.0))
    means.loc[[1, 9, 25, 41], "force_N"] *= 0.87  # run 4 has 7 N, where the scatter is large
    found = outlying_repeats(means, 0.001)
    assert set(found["file"]) == {f"{run}/{k}" for run in (0, 12, 20) for k in (0, 1)}


def test_a_common_change_from_repeat_to_repeat_is_no_outlier():
    means = campaign(20, np.random.default_rng(3), pattern=(0.2, 0.0, -0.1))
    assert len(outlying_repeats(means, 0.001)) == 0


def test_of_two_repeats_that_disagree_neither_is_singled_out():
    means = campaign(30, np.random.default_rng(5), repeats=2)
    means.loc[0, "force_N"] *= 1.5
    found = outlying_repeats(means, 0.001)
    assert found["file"].tolist() == ["0/0", "0/1"]
    assert found["alone"].all()


@pytest.mark.parametrize("spread", [0.0, 1e-15, 1e-12, 1e-9, 1e-3, 0.5])
def test_two_coefficients_that_are_not_negative(spread):
    rng = np.random.default_rng(3)
    for _ in range(50):
        size = 40.0 * (1 + spread * rng.standard_normal(9))
        y, weight = rng.chisquare(10, 9), rng.uniform(0.5, 2.0, 9)
        a, b = two_nonnegative(size**2, y, weight)
        assert a >= 0
        assert b >= 0
        rss = float(weight @ (y - a - b * size**2) ** 2)
        # No worse than a constant, nor than what a general solver finds, which refuses columns that are
        # alike.
        assert rss <= float(weight @ (y - weight @ y / weight.sum()) ** 2) * (1 + 1e-9)
        if spread >= 1e-3:
            root = np.sqrt(weight)
            columns = np.column_stack([np.ones(9), size**2 / 1600]) * root[:, None]
            assert rss == pytest.approx(nnls(columns, y * root)[1] ** 2, rel=1e-6)


def test_repeats_equal_to_the_last_digit_are_answered():
    means = campaign(10, np.random.default_rng(6), pattern=(0, 0, 0))
    means["force_N"] = 20.0
    assert len(outlying_repeats(means, 0.001)) == 0
    means.loc[0, "force_N"] = 21.0
    assert outlying_repeats(means, 0.001)["file"].tolist() == ["0/0"]
