import io
import re
import sys
import time
from types import SimpleNamespace

import pytest
from rich.console import Console

from sealfit.errors import Fault
from sealfit.progress import LINE_EVERY_S, Lines, Silent, Terminal, for_notebook


@pytest.fixture
def clock(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("sealfit.progress.time.monotonic", lambda: now[0])
    return now


def test_plain_progress_is_a_line_now_and_then_and_one_at_the_end(clock):
    stream = io.StringIO()
    with Lines(stream).counting("reading") as on_file:
        for done in range(1, 101):
            clock[0] += LINE_EVERY_S / 8
            on_file(done, 100)
    lines = stream.getvalue().splitlines()
    assert lines[0] == "reading: 8 of 100"
    assert lines[-1] == "reading: 100 of 100"
    assert len(lines) == 13  # 8, 16, ..., 96, and 100


def test_a_terminal_keeps_one_line_of_what_was_counted():
    stream = io.StringIO()
    with Terminal(stream).counting("reading") as on_file:
        on_file(1, 2)
        on_file(2, 2)
    assert stream.getvalue().endswith("reading: 2\n")


@pytest.mark.parametrize(
    ("shell", "stream"), [(SimpleNamespace(kernel=1), "out"), (SimpleNamespace(), "err"), (None, "err")]
)
def test_a_notebook_has_progress_among_its_results(monkeypatch, capsys, shell, stream):
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    for_notebook().say("fitting")
    assert getattr(capsys.readouterr(), stream) == "fitting\n"


def test_faults_are_said_with_what_was_done_and_remarks_are_not():
    stream = io.StringIO()
    kept = Fault("gap", "has a gap.", "a.csv", severity="warning", action="kept", fix="Look at the logger.")
    left = Fault("empty", "is empty.", "b.csv", action="file left out")
    Lines(stream).faults([kept, left, Fault("read", "was read.", severity="info", action="kept")])
    assert stream.getvalue() == (
        "warning: a.csv: has a gap. Look at the logger.\nerror: b.csv: is empty. [file left out]\n"
    )


def test_silence_says_nothing(capsys):
    silent = Silent()
    silent.say("x")
    silent.warn("x")
    silent.faults([Fault("x", "x.")])
    with silent.counting("x") as on_file:
        on_file(1, 1)
    assert capsys.readouterr() == ("", "")


def test_plain_progress_says_that_long_work_goes_on(monkeypatch):
    monkeypatch.setattr("sealfit.progress.BEAT_EVERY_S", 0.05)
    stream = io.StringIO()
    progress = Lines(stream)
    with progress.working("close-loop"):
        while "still" not in stream.getvalue():
            time.sleep(0.01)
    said = stream.getvalue()
    assert said.startswith("close-loop: still at work, 0 s\n")
    time.sleep(0.1)
    assert stream.getvalue() == said


def test_a_terminal_shows_what_is_done_and_for_how_long():
    stream = io.StringIO()
    progress = Terminal(stream)
    with progress.working("close-loop"):
        with progress.counting("folds") as on_fold:
            on_fold(1, 2)
        progress.say("[round] 1")
        shown = [column.render(progress._bar.tasks[0]) for column in progress._bar.columns]
        assert str(shown[0]) == "[round] 1"
        assert str(shown[2]) == "0:00:00"
    assert stream.getvalue().splitlines()[:2] == ["folds: 1", "[round] 1"]
    progress.say("done")
    assert stream.getvalue().endswith("done\n")


def test_a_long_text_leaves_room_for_the_time(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    progress = Terminal(io.StringIO())
    with progress.working(100 * "x"):
        shown = io.StringIO()
        Console(file=shown, width=80).print(progress._bar.get_renderable())
    assert re.fullmatch(r"x{20,}… \S+ 0:00:00\n", shown.getvalue())
