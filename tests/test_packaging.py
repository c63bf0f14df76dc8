import os
import re
import subprocess
import sys
import tomllib
from importlib.metadata import requires, version
from pathlib import Path

import pytest
from pydantic import BaseModel

from sealfit import __version__
from sealfit.config import Config
from sealfit.store.manifest import ConfigCopy

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
README = (ROOT / "README.md").read_text("utf-8")


def is_model(annotation):
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def test_the_version_is_said_once():
    assert __version__ == PROJECT["project"]["version"] == version("sealfit")


def test_no_config_is_the_default_one():
    assert ConfigCopy.at(None).parse() == Config()


def test_every_data_file_of_the_package_is_declared():
    declared = {
        path.relative_to(ROOT)
        for pattern in PROJECT["tool"]["setuptools"]["package-data"]["sealfit"]
        for path in (ROOT / "sealfit").glob(pattern)
    }
    tracked = subprocess.run(["git", "ls-files", "sealfit"], cwd=ROOT, capture_output=True, text=True)
    if tracked.returncode != 0:
        pytest.skip("not a git checkout")
    data = {Path(name) for name in tracked.stdout.splitlines() if not name.endswith(".py")}
    assert data <= declared


def test_every_folder_with_code_is_a_package():
    for path in (ROOT / "sealfit").rglob("*.py"):
        assert (path.parent / "__init__.py").is_file(), path


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.toml")), ids=lambda path: path.name)
def test_every_config_that_ships_is_sound(path):
    assert ConfigCopy.at(path).parse().condition


def test_every_key_of_a_config_has_a_meaning():
    models = [Config, *(f.annotation for f in Config.model_fields.values() if is_model(f.annotation))]
    keys = [(model, name) for model in models for name in model.model_fields]
    assert len(keys) > 60
    missing = [name for model, name in keys if not model.model_fields[name].description]
    assert missing == [name for name, f in Config.model_fields.items() if is_model(f.annotation)]


def test_every_dependency_has_its_reason_in_the_readme():
    names = {re.match(r"[a-z0-9]+", need.lower())[0] for need in requires("sealfit")}
    table = README.split("## Dependencies")[1].split("##")[0]
    rows = set(
        re.findall(r"[a-z0-9]+", " ".join(line.split("|")[1] for line in table.splitlines() if "|" in line))
    )
    assert names <= rows


def test_the_two_commands_of_the_readme_are_targets():
    listed = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for target in re.findall(r"^    make (\w+)$", README, re.MULTILINE):
        assert f"make {target}\t" in listed
    assert set(re.findall(r"make (\w+)\t", listed)) >= {"demo", "test", "lint", "check", "clean", "help"}


@pytest.mark.parametrize(
    ("script", "expected"),
    [
        (
            '[ "$1" = --version ] && echo Python 3.9.2; exit 1',
            "needs Python 3.11 or newer, and here is Python 3.9.2",
        ),
        ('case "$2" in *ensurepip*) exit 1;; esac', "apt install python3-venv"),
    ],
    ids=["too old", "no venv"],
)
def test_make_says_what_is_missing(tmp_path, script, expected):
    for name in ("pyproject.toml", "Makefile"):
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    tools = tmp_path / "tools"
    tools.mkdir()
    for name in ("python3", "python", *(f"python3.{minor}" for minor in (11, 12, 13, 14))):
        (tools / name).write_text(f"#!/bin/sh\n{script}\n")
        (tools / name).chmod(0o755)
    run = subprocess.run(
        ["make", "demo"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={"PATH": f"{tools}{os.pathsep}{os.environ['PATH']}"},
    )
    assert run.returncode != 0
    assert expected in run.stderr
    assert not (tmp_path / ".venv").exists()


def test_python_dash_m_works_from_anywhere(tmp_path):
    run = subprocess.run(
        [sys.executable, "-m", "sealfit", "--version"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout == f"sealfit {__version__}\n"


def test_the_ci_script_can_be_run():
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    assert subprocess.run(["bash", "-n", script], check=False).returncode == 0
