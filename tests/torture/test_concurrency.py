"""A short form of the suite of concurrency; lost workers and schedulers are in test_cluster.py."""

import subprocess
import sys

import concurrency
import pytest

from sealfit.errors import OutError, SealfitError


@pytest.mark.parametrize(
    ("said", "state"),
    [
        ("5 d", "old"),
        ("6 d", "new"),
        ("5.5 d", "wrong"),
        (OutError("was written while it was read.", fix="Run the command again."), "refused"),
        (SealfitError("there is no law."), "wrong"),
        (SealfitError("fit-aging has not been done. Run: sealfit fit-aging out\nand more"), "wrong"),
    ],
)
def test_an_answer_is_that_of_one_state_or_a_refusal(said, state):
    assert concurrency.state_of(said, ["5 d", "6 d"]) == state


@pytest.mark.long
@pytest.mark.skipif(not hasattr(concurrency.os, "fork"), reason="needs fork")
def test_the_short_form(tmp_path):
    words = ["--writers", "1", "--rounds", "1", "--readers", "5", "--seconds", "0.2", "--losses", "0"]
    run = subprocess.run(
        [sys.executable, concurrency.__file__, *words, "--work", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert "1 pairs of writers: 0 wrong" in run.stdout
    assert "'new'" in run.stdout
    assert "'refused'" in run.stdout
