"""Python is run only from a folder that the command line names, never from what a campaign or OUT brings."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from drawing_helpers import undrawn
from user_effects import WORN_PATCH

from sealfit import commands
from sealfit.errors import ConfigError, RequestError, StaleError
from sealfit.pipeline import run, single
from sealfit.simulation import load_spec, simulate
from sealfit.store.manifest import ConfigCopy, fingerprint
from sealfit.store.paths import own_effects_folder

SPEC = """
name = "plain"
seed = 3
[design]
temperatures_C = [60]
days = [2, 8]
speeds_mm_s = [1.0, 5.0, 20.0]
repeats = 2
max_rows = 100
[[noise]]
kind = "white"
sd_N = 0.2
"""
RAN = "from pathlib import Path\nPath({mark!r}).write_text('ran')\n"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A campaign, its results, and a folder of own effects that the config names."""
    home = tmp_path_factory.mktemp("own")
    (home / "spec.toml").write_text(SPEC)
    simulate(load_spec(home / "spec.toml"), home / "campaign")
    (home / "mine").mkdir()
    (home / "mine" / "patch.py").write_text(WORN_PATCH)
    (home / "rig.toml").write_text("[loop]\neffects_folder = 'mine'\nmax_rounds = 1\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sealfit.report.page.draw", undrawn)
        run(home / "campaign", home / "out", home / "rig.toml")
    points = pd.read_csv(home / "campaign" / "runs.csv").iloc[[0]].assign(displacement_mm=20.0)
    points[
        ["temperature_C", "compression_ratio_pct", "aging_days", "load_N", "speed_mm_s", "displacement_mm"]
    ].to_csv(home / "points.csv", index=False)
    return home


@pytest.fixture
def home(made, tmp_path):
    """A copy whose paths, as they are kept in OUT, are those of another computer."""
    return Path(shutil.copytree(made, tmp_path / "home"))


def evil(folder: Path) -> Path:
    """Write an effect that leaves a mark when it is run, and return the mark."""
    folder.mkdir(parents=True, exist_ok=True)
    mark = folder.parent / f"{folder.name}.ran"
    (folder / "patch.py").write_text(RAN.format(mark=str(mark)) + WORN_PATCH)
    return mark


def keep(out: Path, **documents: dict) -> None:
    """Write `<name>.json` files of OUT as somebody would who wants them to pass for its own."""
    state = json.loads((out / "state.json").read_text())
    for name, document in documents.items():
        if name != "state":
            (out / f"{name}.json").write_text(json.dumps(document))
            done = state["steps"]["close-loop"]
            done["files"][f"{name}.json"] = (out / f"{name}.json").stat().st_size
            done["checksums"][f"{name}.json"] = fingerprint(out / f"{name}.json").sha256
    (out / "state.json").write_text(json.dumps({**state, **documents.get("state", {})}))


def with_own_effect(out: Path) -> None:
    """Put the user's effect into the model of OUT."""
    model = json.loads((out / "model.json").read_text())
    model["after"]["terms"].append(
        {
            "id": "worn_patch", "channels": ["displacement_mm"], "acts_on": "mu", "operation": "multiply",
            "fixed": {}, "values": {"A": -0.5, "x_0": 20.0}, "smoothness": None,
        }
    )  # fmt: skip
    model["compliance"] = 0.0  # so that friction follows the patch without a lag
    for holder in (model, *model["sandwiches"]):
        holder["covariance"] = np.pad(np.array(holder["covariance"]), (0, 2)).tolist()
    keep(out, model=model)


def predicted(home: Path, **options) -> pd.Series:
    commands.predict(home / "out", home / "points.csv", home / "q.csv", **options)
    return pd.read_csv(home / "q.csv").iloc[0]


# ---------------------------------------------------------------- what OUT brings along is not run
def test_a_folder_named_in_the_model_or_the_state_of_out_is_never_run(home, monkeypatch):
    monkeypatch.setattr("sealfit.report.page.draw", undrawn)
    out = home / "out"
    marks = [evil(out / "evil"), evil(home / "elsewhere")]
    for folder in (out / "evil", home / "elsewhere"):
        model = json.loads((out / "model.json").read_text())
        model["config"]["loop"]["effects_folder"] = str(folder)
        text = f"[loop]\neffects_folder = '{folder}'\nmax_rounds = 1\n"
        (out / "rig.toml").write_text(text)
        for path in (
            str(out / "rig.toml"),
            "/nowhere/rig.toml",
        ):  # read again where it lies, or as the state keeps it
            keep(out, model=model, state={"config": {"path": path, "text": text}})
            for doing in (
                lambda: predicted(home),
                lambda: commands.effects(out),
                lambda: single("close-loop", out, force=True),
                lambda: single("report", out, force=True),
                lambda: commands.lifetime(out, commands.LifetimeRequest(loss_pct=5.0)),
            ):
                try:
                    doing()
                except (RequestError, StaleError) as error:
                    assert "\n" not in str(error)  # noqa: PT017
    assert not any(mark.exists() for mark in marks)


def test_the_model_keeps_no_path_and_the_state_keeps_the_hashes(made):
    assert json.loads((made / "out" / "model.json").read_text())["config"]["loop"]["effects_folder"] is None
    state = json.loads((made / "out" / "state.json").read_text())
    assert list(state["own_effects"]) == ["patch.py"]
    assert len(state["own_effects"]["patch.py"]) == 64


# ---------------------------------------------------------------- the person names the folder
def test_a_model_without_own_effects_predicts_without_their_folder(home):
    assert predicted(home)["force_after_N"] > 0


def test_a_model_with_own_effects_says_which_option_it_needs(home):
    with_own_effect(home / "out")
    with pytest.raises(
        RequestError, match=r"your own effects \(worn_patch\).* Add --effects-folder FOLDER\.$"
    ):
        predicted(home)
    answer = predicted(home, effects_folder=home / "mine")
    # The patch takes half of the friction coefficient away at its middle; the viscous part is small.
    assert answer["force_after_N"] == pytest.approx(0.5 * answer["force_before_N"], rel=0.03)


def test_other_files_than_the_model_was_made_with_are_said(home):
    with_own_effect(home / "out")
    (home / "mine" / "patch.py").write_text(WORN_PATCH + "# changed\n")
    words = r"close-loop is stale: your own effects are not those it was made with \(patch\.py\)"
    with pytest.raises(StaleError, match=words + ".*Run: sealfit close-loop .*--effects-folder"):
        predicted(home, effects_folder=home / "mine")
    assert (
        "are not those it was made with (patch.py)" in commands.effects(home / "out", home / "mine")["note"]
    )


def test_the_loop_is_closed_again_only_with_a_folder_that_is_named(home):
    with pytest.raises(
        RequestError, match=r"closed with your own effects \(patch\.py\).*Add --effects-folder FOLDER"
    ):
        single("close-loop", home / "out", force=True)
    single("close-loop", home / "out", force=True, effects_folder=home / "mine")
    assert predicted(home)["force_after_N"] > 0


def test_effects_lists_own_effects_from_a_folder_that_is_named(home):
    def ids(*asked):
        return {effect["id"] for effect in commands.effects(*asked)["effects"]}

    assert "worn_patch" not in ids(home / "out")
    assert "add --effects-folder" in commands.effects(home / "out")["note"]
    assert "worn_patch" in ids(home / "out", home / "mine")
    assert commands.effects(home / "out", home / "mine")["note"] is None
    assert "worn_patch" in ids(None, home / "mine")


def test_run_takes_the_folder_from_the_option_too(home, tmp_path):
    mark = evil(home / "other")
    run(home / "campaign", tmp_path / "new", steps=("ingest",), effects_folder=home / "other")
    assert not mark.exists()  # ingest has no need of it
    state = json.loads((tmp_path / "new" / "state.json").read_text())
    assert list(state["own_effects"]) == ["patch.py"]


# ---------------------------------------------------------------- never from the data
@pytest.mark.parametrize("way", ["folder", "link", "file"])
@pytest.mark.parametrize("place", ["campaign", "out"])
def test_a_folder_in_the_campaign_or_in_out_is_refused(home, place, way):
    mark = evil(home / place / "evil")
    folder = home / place / "evil"
    if way == "link":
        folder = home / "link"
        folder.symlink_to(home / place / "evil")
    if way == "file":
        folder = home / "links"
        folder.mkdir()
        (folder / "patch.py").symlink_to(home / place / "evil" / "patch.py")
    state = {"campaign": str(home / "campaign")}
    keep(home / "out", state=state)
    (home / "evil.toml").write_text(f"[loop]\neffects_folder = '{folder}'\n")
    for doing in (
        lambda: predicted(home, effects_folder=folder),
        lambda: commands.effects(home / "out", folder),
        lambda: single("close-loop", home / "out", force=True, effects_folder=folder),
        lambda: run(home / "campaign", home / "out", effects_folder=folder),
        lambda: run(home / "campaign", home / "out", home / "evil.toml"),
    ):
        with pytest.raises(ConfigError, match=f"lies in .*{place}, and Python is never run from there"):
            doing()
    assert not mark.exists()


def test_a_config_that_came_with_the_data_cannot_name_a_folder(home):
    config = home / "campaign" / "rig.toml"
    config.write_text("[loop]\neffects_folder = '../mine'\n")
    with pytest.raises(
        ConfigError, match=r"the config lies in .*campaign.*Name the folder by --effects-folder"
    ):
        run(home / "campaign", home / "out", config)


def test_a_missing_folder_is_said(tmp_path):
    (tmp_path / "rig.toml").write_text("[loop]\neffects_folder = 'mine'\n")
    with pytest.raises(ConfigError, match=r"key 'loop.effects_folder': there is no folder .*mine"):
        own_effects_folder(None, ConfigCopy.at(tmp_path / "rig.toml"))
    with pytest.raises(ConfigError, match=r"--effects-folder: there is no folder gone"):
        own_effects_folder(Path("gone"), None)
