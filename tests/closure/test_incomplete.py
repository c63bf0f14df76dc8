"""A column that a few files have no value of: searched, and said so."""

import json

import numpy as np
import pandas as pd
import pytest
from campaigns import RIG, SPEEDS
from effect_kinds import COLUMN, OTHER

from sealfit.fit.joint.rows import make_rows
from sealfit.ingest.quality import NO_VALUE, incomplete_columns
from sealfit.pipeline import STEPS, run
from sealfit.report.summary_lines import lines
from sealfit.simulation import Spec, simulate
from sealfit.store import Store


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """72 files of an oil content that moves mu by some 20 %, and of an idle dust content."""
    folder = tmp_path_factory.mktemp("incomplete") / "c"
    oil = {"id": "linear", "channels": ("oil_ppm",), "parameters": {"A": 0.01}, "acts_on": "mu"}
    oil |= {"operation": "multiply", "reference": {"x_ref": 50.0}}
    design = {
        "temperatures_C": (60.0,),
        "days": (2.0, 16.0),
        "max_rows": 100,
        "speeds_mm_s": SPEEDS,
    }
    simulate(
        Spec(
            seed=4,
            physics={"growth": {}},
            design=design,
            effects=(oil,),
            channels=(COLUMN, OTHER),
            noise=RIG,
        ),
        folder,
    )
    return folder


@pytest.fixture(scope="module")
def closed(campaign):
    """The campaign after the loop: four files have no oil content, half have no dust content."""
    runs = pd.read_csv(campaign / "runs.csv", dtype=str)
    few = (runs["run_id"] == runs["run_id"][0]) | (runs.index == 40)  # one whole run and one file of another
    runs.loc[few, "oil_ppm"] = ""
    runs.loc[runs.index % 2 == 0, "dust_mg"] = ""
    runs.to_csv(campaign / "runs.csv", index=False)
    (campaign / "rig.toml").write_text("[loop]\nfolds = 2\n")
    out = campaign.parent / "out"
    made = run(campaign, out, campaign / "rig.toml", steps=STEPS[:-1], workers=1)
    return made, Store.open(out), json.loads((out / "closure.json").read_text())


def test_a_column_that_a_few_files_lack_is_searched_and_said(closed):
    made, store, closure = closed
    assert [effect["channels"] for effect in closure["effects"]] == [["oil_ppm"]]
    slope = next(p for p in closure["effects"][0]["parameters"] if p["name"] == "A")
    assert slope["ci95"][0] < 0.01 < slope["ci95"][1]
    files = store.read("inputs")["file"].size
    assert {"channel": "oil_ppm", "files_without": 4, "files": files, "searched": True} in closure[
        "incomplete_channels"
    ]
    said = f"4 of {files} files have no value: the search for effects takes them at the mean of their run"
    quality = store.read("quality")
    found = quality.loc[quality["check"] == "incomplete_column", "reason"]
    assert found.str.startswith(said).sum() == 1
    assert any(line.startswith(f"column      oil_ppm: {said}") for line in lines(made))


def test_a_column_that_many_files_lack_is_left_out_and_said(closed):
    made, _, closure = closed
    (told,) = (one for one in closure["incomplete_channels"] if one["channel"] == "dust_mg")
    assert not told["searched"]
    assert any("the search for effects leaves the column out" in line for line in lines(made))


# ---------------------------------------------------------------- what stands for a missing value
def bins(**columns):
    file = np.repeat([f"f{k}" for k in range(6)], 2)
    table = {
        "file": file, "run_id": np.repeat(["a", "b", "c"], 4), "repeat": np.tile([1, 1, 2, 2], 3),
        "stroke": 1, "specimen_id": "s", "condition": "c", "series": "", "rubber": "", "force_N": 1.0,
        "speed_mm_s": 1.0,
        "load_N": 2.0, "n": 9, "displacement_mm": 1.0,
    }  # fmt: skip
    return pd.DataFrame({**table, **{name: np.repeat(values, 2) for name, values in columns.items()}})


def test_a_missing_value_is_that_of_its_run_else_the_mean():
    nan = np.nan
    rows = make_rows(bins(oil=[0.1, nan, 7.0, 7.0, 7.0, 7.0]), has_aging=False)
    assert rows.values("oil")[2] == 0.1  # to the last digit: it is constant in its run
    assert rows.subset(np.arange(12) > 1).values("oil")[0] == 0.1
    rows = make_rows(bins(oil=[1.0, 3.0, 5.0, nan, 7.0, 7.0]), has_aging=False)
    assert rows.values("oil")[6] == 5.0
    rows = make_rows(bins(oil=[1.0, nan, nan, 5.0, 7.0, 7.0]), has_aging=False)
    assert np.isnan(rows.values("oil")).sum() == 4  # four of six files have a value: too few


def test_a_missing_category_is_a_level_of_its_own():
    rows = make_rows(bins(grade=["K", None, "L", "L", "K", "K"]), has_aging=False)
    assert sorted(set(rows.values("grade"))) == [NO_VALUE, "K", "L"]


def test_each_column_that_some_files_lack_is_said_once():
    steady = bins(
        oil=[1.0, np.nan, 7.0, 7.0, 7.0, 7.0], grade=["K", None, None, "L", "K", "K"], idle=[1.0] * 6
    )
    steady = steady.assign(
        used=True,
        load_N=np.where(steady["file"] == "f3", np.nan, 2.0),
        run_order=[np.nan] + [1.0] * 11,
        started_at=[None] + ["2024-03-01T09:00:00"] * 11,
    )
    told = {fault.column: fault.reason for fault in incomplete_columns(steady)}
    assert set(told) == {"oil", "grade", "load_N", "run_order"}
    assert told["oil"].startswith("1 of 6 files have no value: the search for effects takes them at the mean")
    assert told["grade"] == f"2 of 6 files have no value: they are a level of their own, {NO_VALUE}."
    assert told["load_N"].endswith("the loop fits forces in place of coefficients.")
    assert told["run_order"].endswith("the search for effects leaves the column out.")
