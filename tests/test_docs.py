"""What the README and docs/ show runs, and prints what they say."""

import doctest
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from page_helpers import DOCS, ROOT, as_in_a_clone, assert_as_shown, ran, run

from sealfit.effects.user import load_user_effects

PAGES = sorted(page for page in DOCS.rglob("*.md") if page.parent.name != "paper")
WITH_RESULTS = ("notebook.md",)  # run where there are results of the sample campaign: tests/notebook
EXAMPLES = [page for page in PAGES if ">>>" in page.read_text("utf-8") and page.name not in WITH_RESULTS]
NAMES = {page: str(page.relative_to(DOCS)) for page in PAGES}


@pytest.fixture
def desk(tmp_path):
    """A folder with the sample data and the configs beside it."""
    return as_in_a_clone(tmp_path)


@pytest.mark.parametrize("page", EXAMPLES, ids=[NAMES[page] for page in EXAMPLES])
def test_examples_print_what_they_say(page):
    failed, tried = doctest.testfile(str(page), module_relative=False, encoding="utf-8")
    assert tried > 10
    assert not failed


def test_the_commands_about_properties_print_what_they_say(desk):
    assert_as_shown(ran(DOCS / "how-to" / "properties.md", desk))


def test_the_commands_of_the_readme_for_your_own_data_run(desk):
    text = (ROOT / "README.md").read_text("utf-8").split("## Your own data")[1].split("\n## ")[0]
    commands = re.findall(r"^    \.venv/bin/(sealfit .*)$", text, re.MULTILINE)
    assert [command.split()[1] for command in commands] == ["init", "check", "run"]
    for command in commands:
        printed = run(command, desk)
    assert "verdict     closed" in printed
    (code,) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert run(f"python -c {shlex.quote(code)}", desk) == ""


def test_the_example_of_an_effect_loads(tmp_path):
    text = (DOCS / "how-to" / "own-effects.md").read_text("utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    (tmp_path / "worn_patch.py").write_text(code, "utf-8")
    assert list(load_user_effects(tmp_path)) == ["worn_patch"]


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
