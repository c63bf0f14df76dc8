"""What the README and docs/ show runs, and prints what they say."""

import doctest
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from drawing_helpers import undrawn
from page_helpers import (
    DOCS,
    ROOT,
    as_in_a_clone,
    assert_as_shown,
    called,
    console,
    examples,
    has,
    plain,
    ran,
    run,
)
from pydantic import TypeAdapter

from sealfit.closure.prediction_csv import ANSWERS
from sealfit.effects.user import load_user_effects
from sealfit.report.summary import verdict_sentence
from sealfit.store.documents import CLOSURE
from sealfit.units import Units

PAGES = sorted(page for page in DOCS.rglob("*.md") if page.parent.name != "paper")
WITH_RESULTS = ("notebook.md",)  # run where there are results of the sample campaign: tests/notebook
EXAMPLES = [page for page in PAGES if ">>>" in page.read_text("utf-8") and page.name not in WITH_RESULTS]
NAMES = {page: str(page.relative_to(DOCS)) for page in PAGES}
WHERE = {  # the commands and the Python code of each page are run
    "explanation/fits.md": "tests/notebook",
    "how-to/cluster.md": "",  # not run: it needs several computers, or Slurm. tests/test_cluster.py has one
    "how-to/enough-runs.md": "tests/notebook",
    "how-to/notebook.md": "tests/notebook",
    "how-to/own-data.md": "here",
    "how-to/own-effects.md": "here",
    "how-to/properties.md": "here",
    "reference/commands.md": "here and tests/notebook",
    "tutorial.md": "tests/test_measured_samples.py",
}


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder with the sample data and the configs beside it."""
    return as_in_a_clone(tmp_path_factory.mktemp("desk"))


@pytest.fixture(scope="module")
def printed(desk):
    """What the commands of the README for one's own data print; `results` are those they make."""
    text = (ROOT / "README.md").read_text("utf-8").split("## Your own data")[1].split("Two measured")[0]
    commands = re.findall(r"^    \.venv/bin/(sealfit .*)$", text, re.MULTILINE)
    (desk / "results").symlink_to(desk / "my_results")
    return {command.split()[1]: run(command, desk) for command in commands}


def test_every_command_is_run_or_said_not_to_be():
    shown = {
        name
        for page, name in NAMES.items()
        if plain(page) or list(console(page)) or "\n```python" in page.read_text("utf-8")
    }
    assert shown | {"reference/commands.md"} == set(WHERE)


@pytest.mark.parametrize("page", EXAMPLES, ids=[NAMES[page] for page in EXAMPLES])
def test_examples_print_what_they_say(page):
    failed, tried = doctest.testfile(str(page), module_relative=False, encoding="utf-8")
    assert tried > 10
    assert not failed


def test_the_commands_about_properties_print_what_they_say(desk):
    assert_as_shown(ran(DOCS / "how-to" / "properties.md", desk))


def test_the_command_about_other_names_runs(desk):
    page = DOCS / "how-to" / "properties.md"
    (config,) = re.findall(r"^```toml\n(.*?)^```$", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    (desk / "strength.toml").write_text(config, "utf-8")
    table = pd.read_csv(ROOT / "sample_data" / "hardness.csv")
    table = table.assign(TimeH=24 * table.pop("aging_days"))
    names = {"temperature_C": "TempC", "hardness_shore_A": "Response"}
    table.rename(columns=names).to_csv(desk / "strength.csv", index=False)
    (command,) = plain(page)
    assert "strength" in run(command, desk)


def test_the_commands_of_the_readme_for_your_own_data_run(desk, printed):
    assert list(printed) == ["init", "check", "run"]
    assert "verdict     closed" in printed["run"]
    text = (ROOT / "README.md").read_text("utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert run(f"python -c {shlex.quote(code)}", desk) == ""


def test_the_examples_of_commands_on_campaigns_run(desk, printed, tmp_path, monkeypatch):
    shutil.copy(ROOT / "sample_data" / "hardness.csv", tmp_path / "strength.csv")
    (tmp_path / "sample_data").symlink_to(ROOT / "sample_data")
    commands = [*plain(DOCS / "how-to" / "own-data.md"), *examples(of_results=False)]
    for command in commands:
        if " init " in command:
            (desk / "rig.toml").unlink()
        new = command.split()[1] in ("fit-aging", "simulate")
        assert called(command.replace("FOLDER", "my_campaign"), tmp_path if new else desk, monkeypatch)


def test_the_effect_of_ones_own_is_searched_and_predicted_with(desk, tmp_path, monkeypatch):
    page = DOCS / "how-to" / "own-effects.md"
    (code,) = re.findall(r"^```python\n(.*?)^```$", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    (tmp_path / "my_effects").mkdir()
    (tmp_path / "my_effects" / "worn_patch.py").write_text(code, "utf-8")
    assert list(load_user_effects(tmp_path / "my_effects")) == ["worn_patch"]
    shutil.copytree(desk / "my_campaign", tmp_path / "my_campaign")
    runs = pd.read_csv(desk / "my_campaign" / "runs.csv")
    runs.drop(columns="file").assign(displacement_mm=20.0).to_csv(tmp_path / "points.csv", index=False)
    monkeypatch.setattr("sealfit.report.page.draw", undrawn)
    for command in plain(page):
        assert called(command, tmp_path, monkeypatch)
    assert pd.read_csv(tmp_path / "answers.csv")["force_after_N"].notna().all()


def test_the_verdicts_that_a_page_quotes_are_said_so():
    limit = {"variable": "displacement_mm", "level": "trace", "smallest_N": 0.1, "smallest_pct": 0.2}
    above = {"state": "above_scatter", "ratio": 1.6, "p_value": 1e-21}
    unknown = {"state": "unknown", "ratio": None, "p_value": None}
    found = {
        "nothing_missing": {
            "effects": [],
            "fit_quality": unknown,
            "sensitivity": [{**limit, "cannot_tell": False}],
        },
        "closed": {"effects": [{"candidate": False}], "fit_quality": above, "sensitivity": []},
    }
    others = {
        "refused": [],
        "outlier_files": [],
        "noise_floor_N": None,
        "left": {"significant": False, "p_value": None},
    }
    text = (DOCS / "how-to" / "verdict.md").read_text("utf-8")
    shown = dict(re.findall(r"^    verdict     (\w+): (.*)$", text, re.MULTILINE))
    for verdict, closure in found.items():
        assert has(shown[verdict], verdict_sentence({"verdict": verdict, **others, **closure}, Units()))
    assert set(shown) == set(found)


def test_every_column_of_predictions_is_explained():
    page = (DOCS / "reference/results.md").read_text("utf-8")
    assert {name for name in ANSWERS if f"`{name}`" not in page} == set()


def test_every_key_of_closure_json_is_explained():
    page = (DOCS / "reference" / "closure.md").read_text("utf-8")
    rows = [line.split(" | ") for line in page.splitlines() if line.startswith("| `")]
    listed = {key for row in rows for key in re.findall(r"`(\w+)`", row[0])}
    shape = TypeAdapter(CLOSURE).json_schema()
    records = [shape, *shape["$defs"].values()]
    keys = {key for record in records for key in record["properties"]}
    assert listed <= keys
    assert keys <= set(re.findall(r"`(\w+)`", page))


def test_generated_pages_are_up_to_date():
    done = subprocess.run(
        [sys.executable, "generate.py", "--check"], cwd=DOCS, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_the_site_builds_without_a_warning_and_loads_nothing_from_another_host(tmp_path):
    shutil.copytree(DOCS, tmp_path / "docs")
    shutil.copy(ROOT / "mkdocs.yml", tmp_path)
    program = Path(sys.executable).with_name("zensical")
    command = [str(program), "build", "--strict"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / "out" / "docs" / "index.html").read_text("utf-8")
    assert not re.findall(r"<(?:script|link|img)[^>]+(?:src|href)=.?https?://[^>]*>", page)


def test_the_readme_is_read_in_a_few_minutes():
    assert len((ROOT / "README.md").read_text("utf-8").split()) <= 900
