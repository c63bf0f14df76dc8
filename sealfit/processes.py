"""Chunks of work in processes of this computer, their results in order."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice

from sealfit.errors import WorkerError
from sealfit.threads import one_thread

WAITING_PER_WORKER = 2  # chunks sent ahead of the one awaited: bounds the memory of results not yet taken
# Not fork: it copies the locks of pyarrow's and BLAS's threads without the threads that free them. A fork server has
# no threads, and has loaded what the workers need before the first of them is wanted.
START = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"


def in_processes(apply: Callable[[bytes], list], chunks: Iterator[bytes], workers: int, *, load: str) -> Iterator[list]:
    """Yield the list that `apply` makes of each chunk.

    Parameters
    ----------
    apply : callable
        At the top level of a module.
    chunks : iterator of bytes
        What it is given, one after the other.
    workers : int
        Processes to use.
    load : str
        Module that the server of processes imports once, so that no process imports it again.

    Raises
    ------
    WorkerError
        If a process dies before it has answered (killed, or out of memory).
    """
    context = multiprocessing.get_context(START)
    if START == "forkserver":
        context.set_forkserver_preload([load])
    executor = ProcessPoolExecutor(workers, context, _start_worker)
    sent: deque[Future[list]] = deque()

    def send(count: int) -> None:
        with _no_interrupt_for_children():
            sent.extend(executor.submit(apply, chunk) for chunk in islice(chunks, count))

    finished = False
    try:
        send(workers * WAITING_PER_WORKER)
        while sent:
            made = sent.popleft().result()
            send(1)
            yield made
        finished = True
    except (BrokenProcessPool, EOFError) as error:  # the second where it was the server that starts them
        raise _died() from error
    finally:
        processes = list((executor._processes or {}).values())
        executor.shutdown(wait=finished, cancel_futures=True)
        if not finished:  # interrupted, failed, or no longer wanted: nobody waits for what is still being computed
            for process in processes:
                process.terminate()
            for process in processes:
                process.join()


def _died() -> WorkerError:
    return WorkerError(
        "a worker process died before it had answered.", fix="If memory ran out, use fewer workers (--workers 1)."
    )


@contextlib.contextmanager
def _no_interrupt_for_children() -> Iterator[None]:
    """Start processes that do not see Ctrl-C: the parent stops them, so none prints a traceback of its own.

    A process inherits the blocked signals of the thread that starts it. A Ctrl-C in between waits, and is not lost.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # here, as it lets Ctrl-C through again when it starts
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
