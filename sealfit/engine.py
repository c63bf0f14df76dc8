"""Map work over the cores of this computer, in order; the only file that knows processes."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import TypeVar

from sealfit.errors import WorkerError
from sealfit.threads import one_thread

Given = TypeVar("Given")
Made = TypeVar("Made")

CHUNKS_PER_WORKER = 4  # enough to even out items of different cost, few enough to keep the cost of sending low
MAX_CHUNK = 32  # so that progress is shown often
WAITING_PER_WORKER = 2  # chunks sent ahead of the one awaited: bounds the memory of results not yet taken
PROCESSES_START_S = 3.0  # until two new processes have loaded numpy and pandas on two cores: 1.5 to 3 s


def cores() -> int:
    """Return the number of cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_map(
    function: Callable[[Given], Made],
    items: Iterable[Given],
    *,
    workers: int = 1,
    trial_s: float = 0.0,
    together: int | None = None,
) -> Iterator[Made]:
    """Yield `function(item)` for every item, in the order of the items.

    With one worker, one item, or inside a worker, the work is done here; otherwise in `workers` new processes, several
    items at a time. Results do not depend on `workers`.

    Parameters
    ----------
    function : callable
        A pure function at the top level of a module: processes find it by its name. An exception it raises ends the
        map and is raised here.
    items : iterable
        What to map over; each item is sent to a process, so keep it small.
    workers : int
        Processes to use, at least 1.
    trial_s : float
        Work here for this many seconds first, and start processes only if what is left would take longer than they
        take to start. For items that are usually quick; leave it out where a single item may take long.
    together : int, optional
        Items that are sent to a process at once; by default as many as keep the cost of sending low.

    Raises
    ------
    WorkerError
        If a process dies before it has answered (killed, or out of memory).
    """
    waiting = deque(items)
    if workers <= 1 or multiprocessing.parent_process() is not None:
        yield from map(function, waiting)
        return
    began, done = time.monotonic(), 0
    while waiting and (time.monotonic() - began < trial_s or len(waiting) == 1):
        yield function(waiting.popleft())
        done += 1
    if waiting and done and (time.monotonic() - began) / done * len(waiting) < PROCESSES_START_S:
        yield from map(function, waiting)
    elif waiting:
        yield from begin_map(function, list(waiting), workers=workers, together=together)


def begin_map(
    function: Callable[[Given], Made], items: Sequence[Given], *, workers: int = 1, together: int | None = None
) -> Generator[Made, None, None]:
    """Return `run_map`, its processes already at work while the caller does something else.

    Close it (`contextlib.closing`) where its results may not be wanted after all.

    Parameters
    ----------
    function, items, workers, together
        As for `run_map`; with one worker nothing is done before the first result is asked for.
    """
    if workers <= 1 or len(items) <= 1 or multiprocessing.parent_process() is not None:
        return (function(item) for item in items)
    workers = min(workers, len(items))
    size = together or max(1, min(MAX_CHUNK, len(items) // (workers * CHUNKS_PER_WORKER)))
    made = _in_processes(function, items, workers, size)
    next(made)
    return made


def _in_processes(function: Callable[[Given], Made], items: Sequence[Given], workers: int, size: int) -> Iterator[Made]:
    """Yield once when the first items are sent, `size` at a time, then the results."""
    chunks = (items[start : start + size] for start in range(0, len(items), size))
    # Spawn, not fork: a fork copies the locks of pyarrow's and BLAS's threads without the threads that free them.
    executor = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _start_worker)
    sent: deque[Future[list[Made]]] = deque()

    def send(count: int) -> None:
        with _no_interrupt_for_children():
            # Pickled here, not by the executor's thread, while the caller goes on to use and change the items.
            sent.extend(executor.submit(_apply, pickle.dumps((function, chunk))) for chunk in islice(chunks, count))

    finished = False
    try:
        send(workers * WAITING_PER_WORKER)
        yield None
        while sent:
            made = sent.popleft().result()
            send(1)
            yield from made
        finished = True
    except BrokenProcessPool as error:
        raise WorkerError(
            "a worker process died before it had answered.",
            mend="If memory ran out, use fewer workers (--workers 1).",
        ) from error
    finally:
        processes = list((executor._processes or {}).values())
        executor.shutdown(wait=finished, cancel_futures=True)
        if not finished:  # interrupted, failed, or no longer wanted: nobody waits for what is still being computed
            for process in processes:
                process.terminate()
            for process in processes:
                process.join()


def _apply(pickled: bytes) -> list:
    function, chunk = pickle.loads(pickled)
    return [function(item) for item in chunk]


@contextlib.contextmanager
def _no_interrupt_for_children() -> Iterator[None]:
    """Start processes that do not see Ctrl-C: the parent stops them, so none prints a traceback of its own.

    A process inherits the blocked signals of the thread that starts it. A Ctrl-C in between waits, and is not lost.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker() -> None:
    if sys.platform == "win32":
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    one_thread()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent is gone, or a killed run would leave its workers waiting forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
