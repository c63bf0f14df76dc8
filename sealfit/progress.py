"""What a command says while it works: plain lines, or a moving bar where somebody watches a terminal."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TextIO

from sealfit.errors import Fault

OnFile = Callable[[int, int], None]
LINE_EVERY_S = 2.0  # plain progress ends up in log files: a line now and then
FAULTS_SHOWN = 20  # the rest are in the quality table, and `check` lists them all


class Silent:
    """Progress that nobody wants to see."""

    def say(self, text: str) -> None:
        """Say what is being done."""

    def warn(self, text: str) -> None:
        """Say what the user should know."""

    def faults(self, faults: Iterable[Fault]) -> None:
        """List the faults found in a campaign."""

    @contextlib.contextmanager
    def counting(self, what: str) -> Iterator[OnFile]:
        """Give a function to call with (done, total)."""
        yield lambda done, total: None


class Lines(Silent):
    """Plain lines on `stream`, by default stderr."""

    def __init__(self, stream: TextIO | None = None):
        self._stream = stream or sys.stderr

    def say(self, text: str) -> None:
        """Say what is being done."""
        print(text, file=self._stream, flush=True)

    def warn(self, text: str) -> None:
        """Say what the user should know."""
        self.say(f"warning: {text}")

    def faults(self, faults: Iterable[Fault]) -> None:
        """List the faults found in a campaign, the first of them if they are many."""
        shown = [fault for fault in faults if fault.severity != "info"]
        for fault in shown[:FAULTS_SHOWN]:
            left_out = "" if fault.action == "kept" else f" [{fault.action}]"
            self.say(f"{fault.severity}: {fault}{left_out}")
        if len(shown) > FAULTS_SHOWN:
            more = len(shown) - FAULTS_SHOWN
            self.say(f"... and {more} more: `sealfit check` lists them all, the quality table too.")

    @contextlib.contextmanager
    def counting(self, what: str) -> Iterator[OnFile]:
        """Give a function to call with (done, total); now and then it says so in a line."""
        said_at = time.monotonic()

        def on_file(done: int, total: int) -> None:
            nonlocal said_at
            if done == total or time.monotonic() - said_at >= LINE_EVERY_S:
                said_at = time.monotonic()
                self.say(f"{what}: {done} of {total}")

        yield on_file


class Terminal(Lines):
    """Lines, and a bar for what is counted."""

    @contextlib.contextmanager
    def counting(self, what: str) -> Iterator[OnFile]:
        """Give a function to call with (done, total), which moves a bar."""
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        last = 0
        with Progress(*columns, console=Console(file=self._stream), transient=True) as bar:
            task = bar.add_task(what, total=None)

            def on_file(done: int, total: int) -> None:
                nonlocal last
                last = done
                bar.update(task, completed=done, total=total)

            yield on_file
        if last:
            self.say(f"{what}: {last}")


def to_stderr() -> Lines:
    """Return the progress that fits stderr: a bar on a terminal, plain lines otherwise."""
    return Terminal() if sys.stderr.isatty() else Lines()
