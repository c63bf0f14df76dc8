"""The program's entry, and what `predict` writes."""

import builtins
import os
import subprocess
import sys

import pandas as pd
import pytest

from sealfit import __main__
from sealfit.closure.prediction_csv import ANSWERS, read_points, write_answers


def test_ctrl_c_while_the_program_loads_is_one_line_and_130(monkeypatch, capsys):
    def interrupted(name, *rest, _import=builtins.__import__):
        if name == "sealfit" and "cli" in (rest[2] or ()):
            raise KeyboardInterrupt
        return _import(name, *rest)

    monkeypatch.setattr(builtins, "__import__", interrupted)
    with pytest.raises(SystemExit) as ended:
        __main__.main()
    assert ended.value.code == 130
    assert capsys.readouterr().err == "sealfit: interrupted; nothing was begun.\n"


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (MemoryError(), 1),
        (ImportError("liblapack.so: failed to map segment from shared object"), 1),
        (ImportError("No module named 'scipy'"), None),
    ],
)
def test_no_memory_to_load_the_program_is_one_line_and_1(monkeypatch, capsys, error, code):
    def refused(name, *rest, _import=builtins.__import__):
        if name == "sealfit" and "cli" in (rest[2] or ()):
            raise error
        return _import(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refused)
    with pytest.raises(SystemExit if code else ImportError) as ended:
        __main__.main()
    if code:
        assert ended.value.code == code
        assert capsys.readouterr().err.startswith(
            "sealfit: memory ran out; what was complete before is kept."
        )


def test_python_m_sealfit_is_the_program():
    done = subprocess.run([sys.executable, "-m", "sealfit", "--version"], capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout.startswith("sealfit ")


def test_what_is_written_holds_no_formula_and_all_numbers(tmp_path):
    asked = tmp_path / "points.csv"
    rows = ["oil,=x,speed_mm_s", "=cmd(),+1.5,-3", "@sum,-A1,-2.5e-3", " -x,a=b,1"]
    asked.write_text("\n".join(rows) + "\n", "utf-8")
    points = read_points(asked)
    answers = pd.DataFrame({name: [0.0] * 3 for name in ANSWERS})
    write_answers(points, answers, tmp_path / "answers.csv", given=asked)
    written = [line.split(",")[:3] for line in (tmp_path / "answers.csv").read_text("utf-8").splitlines()]
    assert written == [
        ["oil", "'=x", "speed_mm_s"],
        ["'=cmd()", "+1.5", "-3"],
        ["'@sum", "'-A1", "-2.5e-3"],
        ["' -x", "a=b", "1"],
    ]


def test_answers_are_on_the_disk_before_they_take_their_place(tmp_path, monkeypatch):
    asked, output = tmp_path / "points.csv", tmp_path / "answers.csv"
    asked.write_text("speed_mm_s\n1\n")
    output.write_text("earlier")
    (tmp_path / ".answers.csv.part").write_text(
        "left by a process that was killed, and longer than the answers"
    )
    calls, real = [], os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: calls.append("fsync"))
    monkeypatch.setattr(os, "replace", lambda *paths: (calls.append("replace"), real(*paths)))
    answers = pd.DataFrame({name: [0.0] for name in ANSWERS})
    write_answers(read_points(asked), answers, output, given=asked)
    assert calls == ["fsync", "replace", "fsync"]  # the last is that of the folder
    assert output.read_text().startswith("speed_mm_s,force_before_N")
    assert output.read_text().endswith("0.0,0.0\n")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["answers.csv", "points.csv"]
