"""Commands that pages of the documentation show, run in a folder that is like a clone."""

import doctest
import io
import re
import shlex
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path

import drawing_helpers
import pytest

from sealfit.cli import app, exit_code
from sealfit.simulation import load_spec, simulate

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
OWN = """
name = "my campaign"
seed = 3
[design]
days = [2, 8]
speeds_mm_s = [0.5, 2, 10, 50]
directions = [1, -1]
repeats = 1
max_rows = 80
[[effects]]
id = "zero_offset"
acts_on = "force"
operation = "add"
parameters = { A = 3.0 }
[[noise]]
kind = "white"
sd_N = 0.1
"""


def console(page):
    """Return the commands of a page, each with the output that the page shows."""
    indented = re.findall(r"(?:^    .*\n|^\n(?=    ))+", page.read_text("utf-8"), re.MULTILINE)
    for block in indented:
        for part in re.split(r"^    \$ ", block, flags=re.MULTILINE)[1:]:
            command, _, output = part.partition("\n")
            yield command, re.sub(r"^    ", "", output, flags=re.MULTILINE)


def plain(page):
    """Return the commands of a page that stand without a prompt and an output."""
    return re.findall(r"^    (sealfit .*)$", page.read_text("utf-8"), re.MULTILINE)


def examples(of_results):
    """Return the examples of the reference of commands: those that ask results, or the others."""
    page = (DOCS / "reference" / "commands.md").read_text("utf-8")
    lines = re.findall(r"^Example: (.*)$", page, re.MULTILINE)
    return [line for line in lines if (line.split()[2] == "results") == of_results]


def has(expected, printed):
    """Whether an output is what a page shows; `...` stands for anything."""
    return doctest.OutputChecker().check_output(expected, printed, FLAGS)


def as_in_a_clone(folder):
    """Put the sample data, the configs and a small campaign into a folder."""
    for name in ("sample_data", "configs"):
        (folder / name).symlink_to(ROOT / name)
    (folder / "spec.toml").write_text(OWN, "utf-8")
    simulate(load_spec(folder / "spec.toml"), folder / "my_campaign")
    return folder


def run(command, folder, codes=(0,)):
    """Run a command of a page with this Python's sealfit, and return what it prints on stdout.

    Of a report nothing is drawn.
    """
    words = shlex.split(command)
    if words[0] == "sealfit":
        words = drawing_helpers.command(*words[1:])
    elif words[0] == "python":
        words[0] = sys.executable
    settings = drawing_helpers.environment(BROWSER="true")  # a program that opens nothing
    done = subprocess.run(words, cwd=folder, env=settings, capture_output=True, text=True)
    assert done.returncode in codes, f"{command}\n{done.stderr}"
    return done.stdout


def called(command, folder, monkeypatch, codes=(0,)):
    """Run a command of sealfit in this process, which has loaded the libraries, and return its stdout."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", shlex.split(command))
    monkeypatch.setattr("typer.launch", lambda address: 0)
    with redirect_stdout(io.StringIO()) as said, redirect_stderr(io.StringIO()) as told:
        code = exit_code(app)
    assert code in codes, f"{command}\n{told.getvalue()}"
    return said.getvalue()


def ran(page, folder):
    """Run every command of a page in a folder; return each with what the page shows and what it printed.

    `sealfit run` and other programs have a process of their own.
    """
    commands = list(console(page))
    assert commands
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sealfit.report.page.draw", drawing_helpers.undrawn)
        here = partial(called, monkeypatch=patch)
        ways = [here if re.match("sealfit (?!run )", command) else run for command, _ in commands]
        printed = [
            way(command, folder, codes=(0, 1)) for way, (command, _) in zip(ways, commands, strict=True)
        ]
    return [(*shown, text) for shown, text in zip(commands, printed, strict=True)]


def assert_as_shown(commands):
    """Fail where a command that `ran` printed something else than its page shows."""
    for command, shown, printed in commands:
        assert has(shown, printed), f"{command}\n{printed}"
