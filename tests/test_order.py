"""Close-loop begun while the fits are done: the same to who looks on, whatever fails on either side."""

import multiprocessing
import shutil
from pathlib import Path

import pandas as pd
import pytest

from sealfit.errors import ConfigError, FitError, WorkerError
from sealfit.fingerprint import FITS, STEPS
from sealfit.profiling import as_dicts, lines, profiled
from sealfit.progress import Relayed
from sealfit.simulate import load_spec, simulate
from sealfit.steps import AFTER, CLOSED, FITTED, run
from sealfit.store import Store

ROOT = Path(__file__).resolve().parent.parent
BEFORE_LOOP = STEPS[: STEPS.index("close-loop")]


PLAIN = """
name = "plain"
seed = 3
[design]
temperatures_C = [60]
days = [2, 8]
repeats = 2
max_rows = 100
[[noise]]
kind = "white"
sd_N = 0.2
"""


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A campaign in which nothing is missing."""
    folder = tmp_path_factory.mktemp("order")
    (folder / "spec.toml").write_text(PLAIN)
    simulate(load_spec(folder / "spec.toml"), folder / "c")
    return folder / "c"


@pytest.fixture(scope="module")
def ingested(campaign):
    out = campaign.parent / "ingested"
    run(campaign, out, steps=("ingest",))
    return out


@pytest.fixture
def out(ingested, tmp_path):
    return Path(shutil.copytree(ingested, tmp_path / "out"))


def current(out):
    store = Store.open(out)
    return tuple(step for step in STEPS if not store.why_stale(step))


def assert_nothing_is_left_over(out):
    assert not multiprocessing.active_children()
    assert not list(out.glob(".*"))


def said_in(made, *asked, **options):
    said = []
    made(*asked, progress=Relayed(said.append), **options)
    return [line for line in said if not line.startswith("reading trace files")]  # so many as there is time for


def test_two_workers_say_and_make_the_same_as_one(tmp_path):
    """Of a campaign with an effect that the loop finds, so that its folds search in further processes."""
    spec = load_spec(ROOT / "sample_data" / "simulated.spec.toml")
    design = spec.design.model_copy(update={"temperatures_C": (60.0,), "days": (1.0, 4.0), "max_rows": 150})
    simulate(spec.model_copy(update={"design": design}), tmp_path / "c")
    alone, out = tmp_path / "alone", tmp_path / "out"
    said = [said_in(run, tmp_path / "c", folder, workers=workers) for folder, workers in ((alone, 1), (out, 2))]
    assert said[0] == said[1]
    assert any(line.startswith("round 1") for line in said[0])
    for name in (*FITTED, *CLOSED, *AFTER):
        one, two = (pd.read_parquet(folder / f"{name}.parquet") for folder in (alone, out))
        pd.testing.assert_frame_equal(one, two, check_exact=True)
    plots = [path.relative_to(alone) for path in alone.glob("plots/*")]
    assert len(plots) > 10
    for path in ("closure.json", "model.json", *plots):
        assert (out / path).read_bytes() == (alone / path).read_bytes()
    assert current(out) == STEPS
    assert_nothing_is_left_over(out)


def test_a_profile_says_what_went_on_beside_the_fits(campaign, out):
    with profiled() as parts:
        run(campaign, out, workers=2)
    profile = as_dicts(parts)
    steps = [part for part in profile if part["part"] is None]
    assert [part["step"] for part in steps] == [*STEPS[1:], "summary"]
    assert {part["step"] for part in profile if part["beside"]} == {"close-loop"}
    loop = next(part for part in steps if part["step"] == "close-loop")
    assert loop["seconds"] >= sum(p["seconds"] for p in profile if p["step"] == "close-loop" and p["part"]) > 0
    assert Store.open(out).state.steps["close-loop"].seconds == loop["seconds"]
    assert sum(line.endswith("(beside the fits)") for line in lines(profile)) >= 4


def fails(*_asked, **_options):
    raise FitError("nothing fits.", mend="Measure again.")


def test_a_fit_that_fails_ends_the_loop_beside_it(campaign, out, monkeypatch):
    monkeypatch.setattr("sealfit.fit.dynamic.fit_dynamic", fails)
    with pytest.raises(FitError, match="nothing fits"):
        run(campaign, out, workers=2)
    assert current(out) == ("ingest", "fit-steady", "fit-aging")
    assert_nothing_is_left_over(out)


def test_a_death_of_the_loop_is_told_at_its_turn_and_the_next_run_goes_on(campaign, out, monkeypatch):
    from sealfit.fit import aging

    real = aging.fit_series

    def killing(*asked):
        (loop,) = multiprocessing.active_children()
        loop.kill()
        return real(*asked)

    monkeypatch.setattr(aging, "fit_series", killing)
    with pytest.raises(WorkerError, match="died before it had answered"):
        run(campaign, out, workers=2)
    assert current(out) == BEFORE_LOOP
    assert_nothing_is_left_over(out)
    assert run(campaign, out, workers=2)["done"] == ["close-loop", "report"]


def test_an_error_of_the_loop_comes_at_its_turn(campaign, out, tmp_path):
    (tmp_path / "effects").mkdir()
    (tmp_path / "effects" / "mine.py").write_text("1 / 0\n")
    rig = tmp_path / "rig.toml"
    rig.write_text('[loop]\neffects_folder = "effects"\n')
    with pytest.raises(ConfigError, match="cannot be run: ZeroDivisionError") as caught:
        run(campaign, out, rig, workers=2)
    assert (Path(caught.value.file).name, caught.value.line) == ("mine.py", 1)
    assert current(out)[: len(BEFORE_LOOP)] == BEFORE_LOOP
    assert_nothing_is_left_over(out)


def test_a_figure_that_cannot_be_drawn_early_costs_nothing(campaign, out, monkeypatch):
    monkeypatch.setattr("sealfit.report.page.figures_of_fits", fails)
    assert run(campaign, out, workers=2)["done"] == [*FITS, "close-loop", "report"]
