"""The scripts that measure speed do what they say; what they measure is no test."""

import subprocess
import sys
from itertools import pairwise

import many_files
import numpy as np
import numpy.testing as npt
import pandas as pd
import pandas_script
import pytest
from in_turns import in_turns, ratios
from many_files import MU_C, MU_S, SIGMA_2, V_S, add_files, design_for, write_campaign
from process_tree import watched
from speed_growth import DESIGNS, many_conditions

from sealfit.config import Config
from sealfit.fit.steady import fit_conditions
from sealfit.ingest.campaign import ingest_campaign


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    folder = tmp_path_factory.mktemp("short")
    write_campaign(folder, 60, rows=80)
    return folder


def test_short_traces_are_read_without_a_fault_and_fit_their_law(short):
    ingested = ingest_campaign(short, Config())
    assert ingested.faults == []
    fits = fit_conditions(ingested.tables["steady"], Config())
    unaged = fits["steady_fit"].query("condition == 'unaged' and quantity == 'steady'")
    unaged = unaged.set_index("parameter")["value"]
    wanted = {"mu_s": MU_S["mu_0"], "mu_c": MU_C["mu_0"], "v_s": V_S, "sigma_2": SIGMA_2}
    for name, value in wanted.items():  # specimen, set-up and repeat scatter by 0.5 % each
        assert unaged[name] == pytest.approx(value, rel=0.4 if name == "sigma_2" else 0.06)


def test_many_files_fill_folders_and_designs_grow(tmp_path, monkeypatch):
    monkeypatch.setattr(many_files, "PER_FOLDER", 20)
    write_campaign(tmp_path, 50, rows=5)
    assert sorted(len(list(folder.iterdir())) for folder in (tmp_path / "traces").iterdir()) == [10, 20, 20]
    runs = pd.read_csv(tmp_path / "runs.csv")
    assert all((tmp_path / file).is_file() for file in runs["file"])
    assert not runs.duplicated(["run_id", "repeat"]).any()
    conditions = [len(design_for(files).conditions) for files in (1_000, 10_000, 100_000)]
    assert all(few < many for few, many in pairwise(conditions))
    for files in (1, 24, 1_000, 10_000, 100_000):
        design = design_for(files)
        assert len(design.conditions) * design.files_per_condition >= files


def test_designs_of_many_conditions_have_distinct_ones():
    for varied, days in DESIGNS.values():
        rows = many_conditions(varied, days, 30)
        assert rows["condition"].nunique() == 31
        assert rows.groupby("condition").size().eq(16).all()
        aged = rows[rows["aging_days"] > 0]
        column = "temperature_C" if varied == "temperature" else "compression_ratio_pct"
        assert aged[column].nunique() == 30 // len(days)


def forces_of(folder):
    """Forces of the files of runs.csv, and its rows and the places, shapes (files, rows)."""
    runs = pd.read_csv(folder / "runs.csv")
    traces = [pd.read_csv(folder / file) for file in runs["file"]]
    return runs, *(np.array([trace[name] for trace in traces]) for name in ("force_N", "displacement_mm"))


@pytest.mark.parametrize("effect", many_files.EFFECTS)
def test_an_effect_is_in_the_files_and_nothing_else_is_changed(short, tmp_path, effect):
    write_campaign(tmp_path, 60, rows=80, effect=effect, strength=5.0)
    runs, with_it, place = forces_of(tmp_path)
    start = place[:, :1]
    _, without, same_place = forces_of(short)
    npt.assert_array_equal(place, same_place)
    middle = slice(30, 60)  # at rest nothing is added, and the force rises at first
    added, force, place = (with_it - without)[:, middle], without[:, middle], place[:, middle]
    if effect == "conditioning":
        wanted = -0.05 * (1 - np.exp(1.0 - runs["repeat"].to_numpy()))[:, None] * force
    elif effect == "warming_distance":
        slid = place - start
        wanted = 0.05 * (1 - np.exp(-slid / 10.0)) * force
    else:
        wanted = 0.5 * np.sin(2 * np.pi * place / 5.0 + 0.7)
    npt.assert_allclose(
        added, wanted, atol=0.03
    )  # rounded to 0.01 N; noise of force and place is in what is compared


def test_added_files_are_a_new_run_of_a_condition_that_was_there(tmp_path):
    write_campaign(tmp_path, 60, rows=80)
    before = pd.read_csv(tmp_path / "runs.csv")
    assert len(add_files(tmp_path)) == 3
    added = pd.read_csv(tmp_path / "runs.csv").iloc[len(before) :]
    condition = ["temperature_C", "compression_ratio_pct", "aging_days", "load_N", "speed_mm_s"]
    assert len(added.merge(before[condition].drop_duplicates())) == 3
    assert added["run_id"].nunique() == 1
    assert not set(added["run_id"]) & set(before["run_id"])
    assert added["started_at"].min() > before["started_at"].max()
    assert ingest_campaign(tmp_path, Config()).faults == []


def test_the_script_finds_the_law_of_the_traces(short):
    runs, mean_traces = pandas_script.read_traces(short, pd.read_csv(short / "runs.csv"))
    fits = pandas_script.fit_conditions(runs[runs["aging_days"] == 0])
    assert fits.loc[0, ["mu_s", "mu_c"]].tolist() == pytest.approx([MU_S["mu_0"], MU_C["mu_0"]], rel=0.06)
    assert set(mean_traces["run_id"]) == set(runs["run_id"])
    both = pandas_script.add_intervals(fits, runs[runs["aging_days"] == 0], 20, np.random.default_rng(1))
    assert (both["mu_s_low"] < both["mu_s"]).all()
    assert (both["mu_s"] < both["mu_s_high"]).all()


def test_the_script_fits_the_aging_law():
    days = np.array([0.0, 1, 2, 4, 8, 16])
    fits = pd.DataFrame({"temperature_C": 60, "compression_ratio_pct": 80, "aging_days": days})
    fits["mu_s"], fits["mu_c"] = 0.9 - 0.04 * np.log1p(days / 0.1), 0.6 - 0.03 * np.log1p(days / 0.2)
    found = pandas_script.fit_aging(fits).set_index("quantity")
    assert found.loc["mu_s", ["mu_0", "a", "b"]].tolist() == pytest.approx([0.9, 0.04, 0.1], rel=1e-3)
    assert found.loc["mu_c", ["mu_0", "a", "b"]].tolist() == pytest.approx([0.6, 0.03, 0.2], rel=1e-3)


def test_a_watched_command_tells_its_memory_and_what_it_said():
    cost = watched(
        [sys.executable, "-c", "import time; a = b'x' * 80_000_000; time.sleep(0.5); print('said')"]
    )
    assert cost.output == "said\n"
    assert cost.seconds > 0.5
    assert cost.largest > 80_000_000
    assert cost.resident == 0 or cost.resident > 80_000_000  # 0 where the system has no /proc


def test_a_watched_command_that_fails_says_so():
    with pytest.raises(subprocess.CalledProcessError) as caught:
        watched([sys.executable, "-c", "raise SystemExit('broken')"], look=False)
    assert "broken" in caught.value.output


def test_what_is_compared_is_measured_in_turns():
    order = []
    found = in_turns(
        {
            "a": lambda: order.append("a") or {"": 1.0, "part": 0.5},
            "b": lambda: order.append("b") or {"": 2.0},
        },
        2,
    )
    assert order == ["a", "b", "a", "b"]
    assert found == {"a": [1.0, 1.0], "a, part": [0.5, 0.5], "b": [2.0, 2.0]}
    assert ratios(found["b"], found["a"]) == [2.0, 2.0]
