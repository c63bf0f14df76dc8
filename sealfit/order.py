"""The steps of a command in their order; one that reads nothing of those before it is begun before its turn."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sealfit.engine import begin_beside
from sealfit.fingerprint import FITS
from sealfit.profiling import Part, adopt, profiled, timed
from sealfit.progress import Relayed, Silent
from sealfit.staging import Staged
from sealfit.store import Store

if TYPE_CHECKING:
    from sealfit.processes import Beside, Say

Counted = tuple[int, str]
Work = Callable[[Store, Staged, int, Silent], Counted]


class Order:
    """The steps of one command, done one after the other; close it (`contextlib.closing`) whatever happens.

    With several workers of this computer, close-loop is worked on in a process of its own while the fits, of which it
    reads nothing, are done here. Its files take their places when it is its turn, and what it says is said then: who
    looks on sees one step after the other.

    Parameters
    ----------
    store : Store
        Where they read and write.
    work : mapping of str to callable
        What does each step, at the top level of a module; returns how many rows of what it worked on.
    early_report : callable
        Given the store when the fits are done: does what of the report needs no more, and returns the report's work.
    """

    def __init__(
        self,
        store: Store,
        steps: tuple[str, ...],
        work: Mapping[str, Work],
        early_report: Callable[[Store], Work],
        *,
        workers: int,
        progress: Silent,
    ) -> None:
        self._store, self._steps, self._work, self._early_report = store, steps, dict(work), early_report
        self._workers, self._progress = workers, progress
        self._loop: Beside | None = None
        self._open = ExitStack()

    def close(self) -> None:
        """End what goes on beside, and remove what it has written."""
        self._open.close()

    def do(self, step: str) -> None:
        """Do a step, or take what was done of it."""
        if step in FITS and self._loop is None and "close-loop" in self._steps:
            self._begin_loop()
        if step == "close-loop" and self._loop is not None:
            self._take_loop()
            return
        workers = max(self._workers - 1, 1) if step in FITS and self._loop is not None else self._workers
        with timed(step) as part, self._store.step(step) as staged:
            part.rows, part.of = self._work[step](self._store, staged, workers, self._progress)

    def _begin_loop(self) -> None:
        self._staged = self._store.stage("close-loop")
        self._open.callback(self._staged.clear)
        asked = _Asked(self._work["close-loop"], self._store, self._staged, self._workers)
        self._loop = begin_beside(_do, asked, workers=self._workers)
        if self._loop is not None:
            self._open.enter_context(closing(self._loop))

    def _take_loop(self) -> None:
        if "report" in self._steps:
            with suppress(Exception):  # the report itself will come upon it, and say so, when it is its turn
                self._work["report"] = self._early_report(self._store)
        with timed("close-loop") as part, self._store.step("close-loop", self._staged) as staged:
            made: _Made = self._loop.result(self._progress.say)
            staged.adopt(made.files)
            staged.seconds = part.seconds = made.seconds
            (part.rows, part.of), part.beside = made.counted, "the fits"
            adopt(made.parts, beside=part.beside)


@dataclass(frozen=True)
class _Asked:
    """What the other process is to do."""

    work: Work
    store: Store
    staged: Staged
    workers: int


@dataclass(frozen=True)
class _Made:
    """What it made: files, with their sizes, and how much of what it worked on for how long."""

    files: dict[str, int]
    counted: Counted
    seconds: float
    parts: list[Part]


def _do(asked: _Asked, say: Say) -> _Made:
    began = time.perf_counter()
    with profiled() as parts:
        counted = asked.work(asked.store, asked.staged, asked.workers, Relayed(say))
    return _Made(asked.staged.files, counted, time.perf_counter() - began, parts)
