import math

import numpy as np
import numpy.testing as npt
import pytest
from simulation_helpers import ONE_CONDITION, steady

CLEAN = {}


def noisy(campaign, *kinds, **more):
    """Campaigns without and with noise; the difference of their forces, file by file.

    Campaigns without noise are kept for other tests of the same design.
    """
    spec = {
        "design": {
            "days": (),
            "repeats": 10,
            "speeds_mm_s": tuple(range(1, 21)),
            "max_rows": 200,
            "specimens": 2,
        },
        "physics": {"mu_s": {"mu_0": 0.5}, "mu_c": {"mu_0": 0.5}, "sigma_2": 0.0},
        **more,
    }
    if str(more) not in CLEAN:
        CLEAN[str(more)] = campaign("clean", **spec)
    _, runs, clean = CLEAN[str(more)]
    truth, _, dirty = campaign("dirty", **spec, noise=kinds)
    return truth, runs, {file: (clean[file], dirty[file]) for file in clean}


def differences(pairs):
    return np.stack(
        [(steady(dirty)["force_N"] - steady(clean)["force_N"]).iloc[:100] for clean, dirty in pairs.values()]
    )


def ratios(runs, pairs):
    gain = [
        steady(dirty)["force_N"].mean() / steady(clean)["force_N"].mean() for clean, dirty in pairs.values()
    ]
    return runs.assign(gain=gain)


def test_white_noise_has_its_sd_and_no_memory(campaign):
    _, _, pairs = noisy(campaign, {"kind": "white", "sd_N": 0.2})
    found = differences(pairs)  # 400 files x 100 samples: the SD is known to 0.35 %
    assert found.std() == pytest.approx(0.2, rel=0.02)
    assert abs(np.mean(found[:, 1:] * found[:, :-1]) / 0.04) < 0.02
    assert abs(np.corrcoef(found)[np.triu_indices(len(found), 1)].mean()) < 0.005


@pytest.mark.parametrize(("unit", "length"), [("samples", 5.0), ("mm", 1.0)])
def test_autocorrelated_noise_has_its_sd_and_length(campaign, unit, length):
    _, _, pairs = noisy(campaign, {"kind": "autocorrelated", "sd_N": 0.3, "length": length, "unit": unit})
    found = differences(pairs)
    assert found.std() == pytest.approx(0.3, rel=0.05)
    step = (
        1.0 if unit == "samples" else np.diff(steady(next(iter(pairs.values()))[0])["displacement_mm"]).mean()
    )
    memory = np.mean(found[:, 1:] * found[:, :-1]) / np.mean(found**2)
    assert memory == pytest.approx(math.exp(-step / length), abs=0.05)


def test_quantised_force_stands_on_its_grid(campaign):
    _, _, traces = campaign(
        design=ONE_CONDITION,
        noise=[{"kind": "white", "sd_N": 0.5}, {"kind": "quantised", "resolution_N": 0.25}],
    )
    force = np.concatenate([trace["force_N"] for trace in traces.values()])
    npt.assert_allclose(force / 0.25, np.round(force / 0.25), atol=1e-7)
    assert len(np.unique(force)) > 10


def test_repeat_gain_has_its_sd_and_is_one_factor_per_file(campaign):
    truth, runs, pairs = noisy(campaign, {"kind": "repeat_gain", "sd_rel": 0.02})
    table = ratios(runs, pairs)
    assert table["gain"].std() == pytest.approx(0.02, rel=0.15)  # 400 files: SD known to 3.5 %
    assert table.groupby("run_id")["gain"].mean().std() == pytest.approx(0.02 / math.sqrt(10), rel=0.5)
    npt.assert_allclose(table["gain"], [row["gain"] for row in truth["files"]], rtol=1e-6)
    assert (
        max(
            (d := dirty["force_N"] / clean["force_N"])[clean["force_N"] > 1].std()
            for clean, dirty in pairs.values()
        )
        < 1e-6
    )
    assert len(d) > 0


def test_run_setup_is_shared_by_repeats(campaign):
    _, runs, pairs = noisy(campaign, {"kind": "run_setup", "sd_rel": 0.03})
    table = ratios(runs, pairs)
    assert table.groupby("run_id")["gain"].std().max() < 1e-9
    assert table.groupby("run_id")["gain"].first().std() == pytest.approx(
        0.03, rel=0.4
    )  # 40 runs: SD known to 11 %
    _, runs, pairs = noisy(campaign, {"kind": "run_setup", "sd_N": 0.4})
    offsets = runs.assign(offset=differences(pairs).mean(axis=1)).groupby("run_id")["offset"]
    assert offsets.std().max() < 1e-8
    assert offsets.first().std() == pytest.approx(0.4, rel=0.4)


def test_specimen_scatter_is_shared_by_a_specimens_runs(campaign):
    design = {
        "days": tuple(range(1, 31)),
        "specimens": 2,
        "repeats": 1,
        "speeds_mm_s": (2.0, 20.0),
        "max_rows": 100,
    }
    _, runs, pairs = noisy(campaign, {"kind": "specimen", "sd_rel": 0.05}, design=design)
    table = ratios(runs, pairs)
    assert table.groupby("specimen_id")["gain"].std().max() < 1e-9
    assert table.groupby("specimen_id")["gain"].first().std() == pytest.approx(
        0.05, rel=0.35
    )  # 62: known to 9 %


def test_proportional_noise_grows_with_force(campaign):
    design = {"days": (), "loads_N": (10.0, 100.0), "repeats": 10, "max_rows": 200}
    _, runs, pairs = noisy(campaign, {"kind": "proportional", "sd_rel": 0.01}, design=design)
    found = differences(pairs)
    for load in (10.0, 100.0):
        assert found[(runs["load_N"] == load).to_numpy()].std() == pytest.approx(0.01 * 0.5 * load, rel=0.03)


def test_displacement_and_speed_noise(campaign):
    truth, runs, pairs = noisy(
        campaign, {"kind": "displacement", "sd_mm": 0.02}, {"kind": "speed", "sd_rel": 0.01}
    )
    real = np.abs([row["speed_mm_s"] for row in truth["files"]]) / runs["speed_mm_s"]
    assert real.std() == pytest.approx(0.01, rel=0.15)
    measured, noise = [], []
    for _, dirty in pairs.values():
        window = steady(dirty)
        slope, start = np.polyfit(window["time_s"], window["displacement_mm"], 1)
        measured.append(slope)
        noise.append((window["displacement_mm"] - start - slope * window["time_s"]).std())
    npt.assert_allclose(measured / runs["speed_mm_s"], real, rtol=2e-3)
    assert np.mean(noise) == pytest.approx(0.02, rel=0.05)


def test_outlier_repeats_are_listed_and_off_by_their_factor(campaign):
    truth, runs, pairs = noisy(campaign, {"kind": "outlier_repeats", "share": 0.1, "size_rel": 0.5})
    gain = ratios(runs, pairs)["gain"].to_numpy()
    listed = np.array([row["outlier"] for row in truth["files"]])
    npt.assert_allclose(gain[listed], 1.5)
    npt.assert_allclose(gain[~listed], 1.0)
    assert 0.05 < listed.mean() < 0.15  # 400 files: 3.3 standard deviations


def test_adding_one_noise_kind_leaves_the_other_draws_alone(campaign):
    design = {**ONE_CONDITION, "repeats": 3}
    gains = []
    for name, extra in (("one", []), ("two", [{"kind": "white", "sd_N": 1.0}])):
        truth, _, _ = campaign(name, design=design, noise=[*extra, {"kind": "repeat_gain", "sd_rel": 0.1}])
        gains.append([row["gain"] for row in truth["files"]])
    assert gains[0] == gains[1]
    assert len(set(gains[0])) == 9


def test_bad_data_is_injected_and_listed(campaign, tmp_path):
    kinds = ("missing_cells", "spikes", "gaps", "saturated", "reversed")
    design = {**ONE_CONDITION, "repeats": 4, "sampling_Hz": 1000.0}
    truth, _, traces = campaign(design=design, noise=[{"kind": "bad_data", **dict.fromkeys(kinds, 2)}])
    listed = {row["file"]: row["defect"] for row in truth["files"]}
    assert sorted(d for d in listed.values() if d) == sorted(kinds * 2)
    for file, defect in listed.items():
        trace = traces[file]
        force, step = trace["force_N"], trace["time_s"].diff().dropna()
        size = force.abs()
        assert (force.isna().sum() == len(force) // 50) == (defect == "missing_cells")
        assert ((size > 3 * size.median()).sum() == 3) == (defect == "spikes")
        assert (step.max() > 20 * step.abs().median()) == (defect == "gaps")
        assert ((size == size.max()).mean() > 0.4) == (defect == "saturated")
        assert (step.max() < 0) == (defect == "reversed")
