import importlib.util
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from one_campaign import Task, run_campaign
from truths import formula_effect

from sealfit.simulation import load_truth, simulate, truth_path
from sealfit.simulation.spec import plan_files

PATH = Path(__file__).parents[1] / "benchmarks" / "campaigns.py"


def load():
    spec = importlib.util.spec_from_file_location("benchmark_campaigns", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


campaigns = load()
EFFECTS_ONLY = list(campaigns.EFFECT_CAMPAIGNS)
CHANGE_WITH_REPEATS = ("conditioning", "two_at_once", "three_inside_and_between")


def files_of(spec):
    return plan_files(spec.design, np.random.default_rng(1))


@pytest.mark.parametrize("name", [*campaigns.NULLS, *EFFECTS_ONLY])
@pytest.mark.parametrize(("size", "low", "high"), [("small", 190, 220), ("large", 590, 630)])
def test_sizes_are_about_200_and_600_files(name, size, low, high):
    assert low <= len(files_of(campaigns.campaign(name, size=size))) <= high


@pytest.mark.long
def test_a_campaign_of_the_loop_is_scored():
    scored = run_campaign(Task("null_white", "-", 1, "small", rivals=False))
    assert scored["verdict"] == "nothing_missing"
    assert scored["extra"] == 0
    assert scored["errors"]["after"] == scored["errors"]["plain"] < 0.02
    assert scored["errors"]["true_form"] == pytest.approx(scored["errors"]["plain"], rel=0.5)


def test_a_formula_of_the_truth_is_an_effect():
    made = formula_effect("A * oil_ppm * time_s", {"A": 2.0}, ("force", "add"))
    assert made.reads == ("oil_ppm", "time_s")
    assert made.shape({"oil_ppm": np.array([3.0]), "time_s": np.array([5.0])}, A=2.0) == [30.0]


def test_there_are_eight_nulls_and_they_have_no_effect():
    assert len(campaigns.NULLS) == 8
    assert all(campaigns.campaign(name).effects == () for name in campaigns.NULLS)
    assert len({tuple(kind.kind for kind in campaigns.campaign(name).noise) for name in campaigns.NULLS}) >= 7


def test_the_papers_campaign_has_its_73_conditions_and_1752_files():
    spec = campaigns.paper_campaign()
    files = files_of(spec)
    assert len(files) == 1752
    assert files["condition"].nunique() == 73
    assert set(files["temperature_C"]) == {20.0, 40.0, 60.0, 80.0, 23.0}  # 23 is the unaged rubber's
    assert (files["load_N"] == 49.03).all()
    # Every day's tests begin on that day, and end before the next.
    late = files["elapsed_h"] / 24 - files["aging_days"]
    assert late.between(0, 1).all()


@pytest.mark.parametrize("name", EFFECTS_ONLY)
def test_strengths_stand_in_their_proportion_to_the_scatter(name, tmp_path):
    rms = []
    for strength in ("weak", "strong"):
        spec = campaigns.campaign(name, strength=strength, rows=200 if name == "run_in" else 60)
        if name not in CHANGE_WITH_REPEATS:  # the truth has no scatter, so that repeats are alike
            once = {"repeats": 1, "minutes_per_file": spec.design.repeats * spec.design.minutes_per_file}
            spec = spec.model_copy(update={"design": spec.design.model_copy(update=once)})
        simulate(spec, tmp_path / strength)
        truth = load_truth(truth_path(tmp_path / strength))
        rms.append([effect["rms_N"] for effect in truth["effects"]])
    mean = np.abs([row["mean_force_N"] for row in truth["files"]]).mean()
    # One file's scatter: repeat, set-up and specimen, 0.5 % of some 25 N each.
    scatter = mean * np.sqrt(3) * 0.005
    rms = np.array(rms)
    assert ((rms[0] > 0.2 * scatter) & (rms[0] < 2 * scatter)).all()
    np.testing.assert_allclose(
        rms[1] / rms[0], 10.0, rtol=0.14
    )  # factors multiply each other, shifts of v_s saturate


def test_the_strengths_are_one_three_and_ten_times_the_weak_one():
    assert campaigns.STRENGTHS == {"weak": 1.0, "medium": 3.0, "strong": 10.0}
    sizes = [campaigns.campaign("drift", strength=s).effects[0].parameters["A"] for s in campaigns.STRENGTHS]
    np.testing.assert_allclose(np.array(sizes) / sizes[0], [1.0, 3.0, 10.0])


def test_the_command_writes_one_and_refuses_an_unknown_name(tmp_path, capsys):
    out = tmp_path / "c"
    assert (
        campaigns.main(["null_specimen_with_columns", "--seed", "3", "--out", str(out), "--rows", "60"]) == 0
    )
    runs = pd.read_csv(out / "runs.csv")
    assert {"lab_temperature_C", "sheet"} <= set(runs.columns)
    assert load_truth(truth_path(out))["spec"]["seed"] == 3
    assert campaigns.main(["no_such", "--out", str(tmp_path / "d")]) == 1
    assert "there is no campaign 'no_such'" in capsys.readouterr().err
    assert campaigns.main(["--list"]) == 0
    assert capsys.readouterr().out.split() == campaigns.names()
