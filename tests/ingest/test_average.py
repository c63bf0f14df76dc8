import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealfit.config import Bins
from sealfit.ingest.averages import bin_table, common_by_group, mean_traces, standard_error


def test_standard_error_of_white_noise_is_s_over_root_n():
    values = np.random.default_rng(0).normal(0.0, 2.0, 4000)
    assert standard_error(values) == pytest.approx(2.0 / np.sqrt(4000), rel=0.15)


def test_standard_error_counts_the_correlation_of_neighbours():
    # AR(1) with rho: 2 tau = (1 + rho) / (1 - rho), here 19.
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(20):
        x = np.zeros(4000)
        noise = rng.normal(size=4000)
        for i in range(1, 4000):
            x[i] = 0.9 * x[i - 1] + noise[i]
        errors.append(standard_error(x) ** 2)
    true = 1.0 / (1.0 - 0.81) * 19.0 / 4000
    assert np.mean(errors) == pytest.approx(true, rel=0.15)


def test_standard_error_of_one_sample_is_unknown_and_of_equal_ones_zero():
    assert np.isnan(standard_error(np.array([1.0])))
    assert np.isnan(standard_error(np.array([])))
    assert standard_error(np.full(10, 3.0)) == 0.0


def strokes(**columns):
    n = len(columns["run_id"])
    return pd.DataFrame({"file": [f"f{i}" for i in range(n)], "direction": 1, **columns})


def samples(*parts):
    """Samples of strokes from (displacement, force) pairs."""
    return pd.DataFrame(
        {
            "row": np.repeat(np.arange(len(parts)), [len(x) for x, _ in parts]),
            "displacement_mm": np.concatenate([x for x, _ in parts]),
            "force_N": np.concatenate([f for _, f in parts]),
            "steady": True,
        }
    )


def binned(*given):
    return pd.DataFrame(bin_table(*given))


def averaged(*given):
    return pd.DataFrame(mean_traces(*given))


def test_bins_of_repeats_share_their_edges_and_hold_their_own_means():
    x = np.linspace(0.0, 40.0, 401)
    made = binned(samples((x, 2 * x), (x[37:], -x[37:])), strokes(run_id=["a", "a"]), Bins(per_stroke=4))
    assert made.groupby("row")["bin"].apply(list).tolist() == [[0, 1, 2, 3], [0, 1, 2, 3]]
    # Bins of 10 mm: 100 samples each (the last has the end too), and 63 of the first are left in the second
    # stroke.
    assert made["n"].tolist() == [100, 100, 100, 101, 63, 100, 100, 101]
    npt.assert_allclose(
        made["displacement_mm"], [4.95, 14.95, 24.95, 35.0, (3.7 + 9.9) / 2, 14.95, 24.95, 35.0]
    )
    npt.assert_allclose(made["force_N"][:4], 2 * made["displacement_mm"][:4])
    npt.assert_allclose(made["force_N"][4:], -made["displacement_mm"][4:])
    # SD of 100 values 0.2 apart: 0.2 sqrt(n (n + 1) / 12).
    npt.assert_allclose(made["force_sd_N"][0], 0.2 * np.sqrt(100 * 101 / 12))


def test_bins_count_along_the_motion():
    x = np.linspace(40.0, 0.0, 401)
    made = binned(samples((x, x)), strokes(run_id=["a"], direction=[-1]), Bins(per_stroke=4))
    assert made["bin"].tolist() == [0, 1, 2, 3]
    assert (np.diff(made["displacement_mm"]) < 0).all()


def test_labels_of_a_bin_are_the_most_frequent_and_further_channels_are_averaged():
    table = samples((np.arange(8.0), np.zeros(8))).assign(oil=list("aaabbbab"), warmth_C=np.arange(8.0))
    made = binned(table, strokes(run_id=["a"]), Bins(per_stroke=2, min_samples=1))
    assert made["oil"].tolist() == ["a", "b"]
    npt.assert_allclose(made["warmth_C"], [1.5, 5.5])
    assert common_by_group(np.array(["x", "y", "y", None], object), np.array([0, 0, 0, 1]), 3).tolist() == [
        "y",
        None,
        None,
    ]
    assert common_by_group(np.array(["y", "x"], object), np.array([0, 0]), 1).tolist() == ["x"]


@given(
    lengths=st.lists(st.integers(1, 200), min_size=1, max_size=4),
    per_stroke=st.integers(1, 50),
    least=st.integers(1, 9),
    seed=st.integers(0, 99),
)
def test_no_sample_is_lost_in_the_bins_and_none_is_thin(lengths, per_stroke, least, seed):
    rng = np.random.default_rng(seed)
    table = samples(*[(np.sort(rng.uniform(0, 40, n)), rng.normal(size=n)) for n in lengths])
    made = binned(table, strokes(run_id=["a"] * len(lengths)), Bins(per_stroke=per_stroke, min_samples=least))
    assert made.groupby("row")["n"].sum().tolist() == lengths
    total = (made["n"] * made["force_N"]).sum()
    npt.assert_allclose(total, table["force_N"].sum(), atol=1e-9)
    for _, one in made.groupby("row"):
        assert len(one) <= per_stroke
        assert len(one) == 1 or one["n"].min() >= least


def test_mean_trace_of_repeats_has_their_mean_and_standard_error():
    x = np.linspace(0.0, 10.0, 101)
    force = 20.0 * (1.0 - np.exp(-x / 0.5))
    made = averaged(samples((x, force - 1), (x, force), (x, force + 1)), strokes(run_id=["a"] * 3))
    # Three repeats 1 N apart: SD 1, SE 1 / sqrt(3).
    npt.assert_allclose(made["force_se_N"], 1.0 / np.sqrt(3.0))
    assert (made["n"] == 3).all()
    inside = 20.0 * (1.0 - np.exp(-made["displacement_mm"] / 0.5))
    assert np.abs(made["force_N"] - inside).max() < 20 * 0.1 / 0.5
    assert len(made) == 100


def test_one_repeat_has_no_standard_error_and_strokes_of_one_file_are_no_repeats():
    x = np.linspace(0.0, 10.0, 101)
    one = averaged(samples((x, x), (x, x + 2)), strokes(run_id=["a", "a"], file=["f", "f"]))
    assert one["force_se_N"].isna().all()
    assert (one["n"] == 2).all()
    npt.assert_allclose(one["force_N"].iloc[10], 1.0 + 1.05, atol=0.06)


def test_a_gap_stays_a_gap_and_steady_strokes_are_averaged_with_steady_ones_only():
    x = np.linspace(0.0, 10.0, 101)
    table = samples((np.delete(x, slice(40, 60)), np.zeros(81)), (x, np.ones(101)))
    table.loc[table["displacement_mm"] < 2.0, "steady"] = False
    table.loc[(table["row"] == 1) & (table["displacement_mm"] > 8.0), "steady"] = False
    made = averaged(table, strokes(run_id=["a", "a"]))
    gap = made[(made["displacement_mm"] > 4.3) & (made["displacement_mm"] < 5.7)]
    assert (gap["n"] == 1).all()
    assert (gap["force_N"] == 1.0).all()
    assert gap["force_se_N"].isna().all()
    assert not made.loc[made["displacement_mm"] < 1.9, "steady"].any()
    late = made[made["displacement_mm"] > 8.2]
    assert late["steady"].all()
    assert (late["n"] == 1).all()
    assert (late["force_N"] == 0.0).all()
    assert made.loc[made["displacement_mm"].between(2.2, 3.8), "steady"].all()


def test_a_repeat_that_starts_later_makes_no_dip_in_the_mean():
    x = np.linspace(0.0, 20.0, 201)
    rise = 20.0 * (1.0 - np.exp(-x / 0.3))
    table = samples((x, rise), (x + 5.0, rise))
    travel = table["displacement_mm"] - np.where(table["row"] == 1, 5.0, 0.0)
    made = averaged(table.assign(steady=travel > 2.0), strokes(run_id=["a", "a"]))
    inside = made[made["displacement_mm"] > 2.5]
    assert inside["force_N"].min() > 19.9
    assert (inside.loc[inside["displacement_mm"].between(7.5, 19.5), "n"] == 2).all()


def test_runs_are_averaged_apart():
    x = np.linspace(0.0, 10.0, 101)
    made = averaged(samples((x, x), (-x, -x)), strokes(run_id=["a", "b"], direction=[1, -1]))
    assert made.groupby("row").size().tolist() == [100, 100]
    assert np.sign(made["displacement_mm"]).tolist() == np.where(made["row"] == 0, 1, -1).tolist()
    npt.assert_allclose(made["force_N"], made["displacement_mm"], atol=0.11)
