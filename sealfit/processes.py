"""Chunks of work in processes of this computer, their results in order."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing.connection import Connection
from typing import Any

from sealfit.errors import SealfitError, WorkerError
from sealfit.interrupts import undisturbed
from sealfit.threads import one_thread

Say = Callable[[str], None]

WAITING_PER_WORKER = 2  # chunks sent ahead of the one awaited: bounds the memory of results not yet taken
UNHEARD_S = 5.0  # a process that is told to end may be at a long product of matrices
# Not fork: it copies the locks of pyarrow's and BLAS's threads without the threads that free them. A fork server has
# no threads, and has loaded what the workers need before the first of them is wanted.
START = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"


def prepare(*modules: str) -> None:
    """Begin to load `modules`, in the background, for processes that will be wanted soon."""
    if START == "forkserver":
        from multiprocessing import forkserver

        multiprocessing.set_forkserver_preload(list(modules))
        with _no_interrupt_for_children():
            forkserver.ensure_running()


def in_processes(apply: Callable[[bytes], list], chunks: Iterator[bytes], workers: int) -> Iterator[list]:
    """Yield once when the first chunks are sent, then the list that `apply` makes of each chunk.

    Raises
    ------
    WorkerError
        If a process dies before it has answered (killed, or out of memory).
    """
    executor = ProcessPoolExecutor(workers, multiprocessing.get_context(START), _start_worker)
    sent: deque[Future[list]] = deque()

    def send(count: int) -> None:
        with _no_interrupt_for_children():
            sent.extend(executor.submit(apply, chunk) for chunk in islice(chunks, count))

    finished = False
    try:
        send(workers * WAITING_PER_WORKER)
        yield []
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


class Beside:
    """One piece of work in a process of its own, which may use others.

    Parameters
    ----------
    work : callable
        A function at the top level of a module: given `asked`, and a function to call with what there is to say.
    asked : bytes
        What it is to do.
    """

    def __init__(self, work: Callable[[bytes, Say], Any], asked: bytes) -> None:
        context = multiprocessing.get_context(START)
        self._told, tell = context.Pipe(duplex=False)
        self._process = context.Process(target=_telling, args=(work, asked, tell))
        try:
            with _no_interrupt_for_children():
                self._process.start()
        except EOFError as error:
            raise _died() from error
        tell.close()
        self._answered = False

    def result(self, say: Say) -> Any:
        """Return what the work returns, or raise what it raises; pass on what it said so far, and says until then.

        Raises
        ------
        WorkerError
            If the process dies before.
        """
        while True:
            try:
                kind, told = self._told.recv()
            except EOFError as error:
                raise _died() from error
            if kind == "said":
                say(told)
                continue
            self._answered = True
            if kind == "raised":
                raise told
            return told

    def close(self) -> None:
        """End the process, whatever it is at."""
        if not self._answered:
            self._process.terminate()
            self._process.join(UNHEARD_S)
            self._process.kill()
        self._process.join()
        self._told.close()


def _telling(work: Callable[[bytes, Say], Any], asked: bytes, tell: Connection) -> None:
    _start_worker()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # ends its own processes, and leaves nothing of theirs
    try:
        told = "made", work(asked, lambda text: tell.send(("said", text)))
    except SystemExit:
        return  # and lets go of what was begun, before anybody waits for it
    except Exception as error:
        if not isinstance(error, SealfitError):  # a bug: its traceback is here
            error.add_note(traceback.format_exc())
        told = "raised", error
    tell.send(told)


def _died() -> WorkerError:
    return WorkerError(
        "a worker process died before it had answered.", mend="If memory ran out, use fewer workers (--workers 1)."
    )


@contextlib.contextmanager
def _no_interrupt_for_children() -> Iterator[None]:
    """Start processes that do not see Ctrl-C: the parent stops them, so none prints a traceback of its own.

    A process inherits the blocked signals of the thread that starts it. A Ctrl-C in between waits, and is not lost; nor
    is the end that a process beside is told: what it is about to start would look for it in vain.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # here, as it lets Ctrl-C through again when it starts
    with undisturbed(by=signal.SIGTERM):
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
