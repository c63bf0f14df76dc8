"""What a command says while it works, and where its time goes."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TextIO

from sealfit.errors import Fault, grouped, told

# ---------------------------------------------------------------- progress

OnFile = Callable[[int, int], None]
BAR = 20  # characters of the bar's width
LINE_EVERY_S = 2.0  # plain progress ends up in log files: a line now and then
BEAT_EVERY_S = 30.0  # without any line for so long, plain progress says that the step is still at work
FAULTS_SHOWN = 20  # the rest are in the quality table, and `check` lists them all


class Silent:
    """Progress that nobody wants to see."""

    def say(self, text: str) -> None:
        """Say what is being done."""

    def warn(self, text: str) -> None:
        """Say what the user should know."""
        self.say(f"warning: {text}")

    def faults(self, faults: Iterable[Fault]) -> None:
        """List the faults found in a campaign, those of all of it first; only the first if they are many."""
        groups = grouped(fault for fault in faults if fault.severity != "info")
        groups.sort(key=lambda group: group[0].file is not None)
        for group in groups[:FAULTS_SHOWN]:
            left_out = "" if group[0].action == "kept" else f" [{group[0].action}]"
            self.say(f"{group[0].severity}: {told(group)}{left_out}")
        if len(groups) > FAULTS_SHOWN:
            more = sum(len(group) for group in groups[FAULTS_SHOWN:])
            self.say(f"... and {more} more: `sealfit check` lists them all, the quality table too.")

    @contextlib.contextmanager
    def working(self, what: str) -> Iterator[None]:
        """Show that the work in the block goes on, and for how long."""
        yield

    @contextlib.contextmanager
    def counting(self, what: str) -> Iterator[OnFile]:
        """Give a function to call with (done, total)."""
        yield lambda done, total: None


class Lines(Silent):
    """Plain lines on `stream`, by default stderr."""

    def __init__(self, stream: TextIO | None = None):
        self._stream = stream or sys.stderr
        self._said_at = time.monotonic()

    def say(self, text: str) -> None:
        """Say what is being done."""
        self._said_at = time.monotonic()
        print(text, file=self._stream, flush=True)

    @contextlib.contextmanager
    def working(self, what: str) -> Iterator[None]:
        """Say in a line how long the work in the block has taken, where nothing else was said for a while."""
        began, ended = time.monotonic(), threading.Event()

        def beat() -> None:
            while not ended.wait(BEAT_EVERY_S / 10):
                now = time.monotonic()
                if now - self._said_at >= BEAT_EVERY_S:
                    self.say(f"{what}: still at work, {now - began:.0f} s")

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

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
    """Lines, and below them one that moves: what is being done, a bar, and how long it has taken."""

    def __init__(self, stream: TextIO | None = None):
        super().__init__(stream)
        self._bar = None
        self._task = None

    def say(self, text: str) -> None:
        """Say what is being done, in a line of its own and in the moving one."""
        if self._bar is None:
            super().say(text)
            return
        self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)
        self._bar.update(self._task, description=text)

    @contextlib.contextmanager
    def working(self, what: str) -> Iterator[None]:
        """Show the moving line."""
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
        from rich.table import Column

        console = Console(file=self._stream)
        room = max(console.width - len(" 0:00:00 ") - BAR, BAR)  # for the text: the time is never cut off
        column = Column(no_wrap=True, max_width=room)
        text = TextColumn("{task.description}", markup=False, table_column=column)
        columns = (text, BarColumn(bar_width=BAR), TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as bar:
            self._bar, self._task = bar, bar.add_task(what, total=None)
            try:
                yield
            finally:
                self._bar = None

    @contextlib.contextmanager
    def counting(self, what: str) -> Iterator[OnFile]:
        """Give a function to call with (done, total), which moves the bar."""
        last = 0
        with self.working(what) if self._bar is None else contextlib.nullcontext():
            bar, counted = self._bar, self._bar.add_task(what, total=None)
            bar.update(self._task, visible=False)

            def on_file(done: int, total: int) -> None:
                nonlocal last
                last = done
                bar.update(counted, description=f"{what}: {done} of {total}", completed=done, total=total)

            try:
                yield on_file
            finally:
                bar.remove_task(counted)
                bar.update(self._task, visible=True)
        if last:
            self.say(f"{what}: {last}")


def to_stderr() -> Lines:
    """Return the progress that fits stderr: a bar on a terminal, plain lines otherwise."""
    return Terminal() if sys.stderr.isatty() else Lines()


def for_notebook() -> Lines:
    """Return the progress that fits a notebook: lines among its results, not in red; else that for stderr."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython else None
    return Lines(sys.stdout) if hasattr(shell, "kernel") else to_stderr()


# ---------------------------------------------------------------- profiling


@dataclass
class TimedPart:
    """Seconds of a step, or of a part of it: `rows` counts what it worked on, in `of`."""

    step: str
    part: str | None  # None: the whole step
    seconds: float | None = None  # None while it goes on
    rows: int | None = None
    of: str = ""


_parts: ContextVar[list[TimedPart] | None] = ContextVar("parts", default=None)


@contextlib.contextmanager
def profiled() -> Iterator[list[TimedPart]]:
    """Give the list that everything `timed` in the block is written into, in the order in which it began."""
    parts: list[TimedPart] = []
    token = _parts.set(parts)
    try:
        yield parts
    finally:
        _parts.reset(token)


@contextlib.contextmanager
def timed(name: str, rows: int | None = None, of: str = "") -> Iterator[TimedPart]:
    """Take the time of the block, where somebody asked for it; rows may be told while it runs.

    >>> with profiled() as parts, timed("ingest"), timed("reading", rows=3, of="files"):
    ...     pass
    >>> [(part.step, part.part, part.rows, part.of) for part in parts]
    [('ingest', None, None, ''), ('ingest', 'reading', 3, 'files')]
    """
    parts = _parts.get()
    if parts is None:  # nobody asked
        parts = []
    step = next((part.step for part in parts if part.seconds is None), None)
    part = TimedPart(step or name, name if step else None, rows=rows, of=of)
    parts.append(part)
    began = time.perf_counter()
    try:
        yield part
    finally:
        part.seconds = round(time.perf_counter() - began, 3)


def lines(profile: Sequence[Mapping]) -> list[str]:
    """Return a line per step and part: seconds, rows, and rows a second; none without a profile."""
    if not profile:
        return []
    text = [f"{'profile':28s}{'seconds':>9s}{'rows':>13s}{'a second':>11s}"]
    for part in profile:
        name = part["step"] if part["part"] is None else f"  {part['part']}"
        row = f"{name:28s}{part['seconds']:9.2f}"
        if part["rows"] is not None:
            rate = f"{part['rows'] / part['seconds']:11,.0f}" if part["seconds"] > 0 else f"{'':11s}"
            row += f"{part['rows']:13,d}{rate} {part['of']}"
        text.append(row.rstrip())
    return text
