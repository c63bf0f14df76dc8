"""Map work over the cores of this computer or over a Dask cluster, with results in order."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextvars import ContextVar
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, TypeVar

from sealfit.engine import claim_memory, one_thread
from sealfit.errors import WorkerError

if TYPE_CHECKING:
    from sealfit.engine.cluster import Cluster


# ---------------------------------------------------------------- engine

Given = TypeVar("Given")
Made = TypeVar("Made")

CHUNKS_PER_WORKER = 4  # balances items of different cost against the cost of sending
MAX_CHUNK = 32  # items; keeps the progress bar moving

_cluster: ContextVar[Cluster | None] = ContextVar("cluster", default=None)


def cores() -> int:
    """Return the number of cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def on_cluster(scheduler: str | None, *folders: Path) -> Iterator[None]:
    """Run every map of the block on the cluster of a Dask scheduler, or on this computer if it is None.

    The scheduler is an address ("tcp://host:8786") or the path of a scheduler file; every worker has to see
    the folders. RequestError, which says why, if the cluster cannot be used.
    """
    if scheduler is None:
        yield
        return
    from sealfit.engine.cluster import Cluster

    cluster = Cluster(scheduler)
    before = _cluster.set(cluster)
    try:
        cluster.require_folders(*folders)
        yield
    finally:
        _cluster.reset(before)
        cluster.close()


def run_map(
    function: Callable[[Given], Made],
    items: Iterable[Given],
    *,
    workers: int = 1,
    together: int | None = None,
) -> Iterator[Made]:
    """Yield `function(item)` for every item, in the order of the items.

    With one worker, one item, or inside a worker, the work is done here; otherwise in `workers` new
    processes, or on the cluster of `on_cluster`, several items at a time. Results do not depend on where.

    Parameters
    ----------
    function : callable
        A pure function at the top level of a module: processes find it by its name. An exception it raises
        ends the map and is raised here.
    items : iterable
        What to map over; each item is sent to a process, so keep it small.
    workers : int
        Processes to use, at least 1; has no meaning on a cluster.
    together : int, optional
        Items that are sent to a process at once; by default as many as keep the cost of sending low.

    Raises
    ------
    WorkerError
        If a process dies before it has answered (killed, or out of memory), or the cluster gives up.
    """
    items = items if isinstance(items, Sequence) else list(items)
    cluster = _cluster.get()
    inside_worker = multiprocessing.parent_process() is not None
    if inside_worker or (cluster is None and (workers <= 1 or len(items) <= 1)):
        yield from map(function, items)
        return
    workers = min(workers, len(items)) if cluster is None else max(cluster.threads(), 1)
    size = together or max(1, min(MAX_CHUNK, len(items) // (workers * CHUNKS_PER_WORKER)))
    # Pickled here, because the caller may change the items before another thread pickles them.
    chunks = (pickle.dumps((function, items[start : start + size])) for start in range(0, len(items), size))
    if cluster is None:
        module = getattr(function, "func", function).__module__  # of a function, or of a partial one
        made = in_processes(_apply, chunks, workers, load=module)
    else:
        made = cluster.apply(_apply, chunks)
    with contextlib.closing(made):
        for results in made:
            yield from results


def _apply(pickled: bytes) -> list:
    function, chunk = pickle.loads(pickled)
    return [function(item) for item in chunk]


# ---------------------------------------------------------------- processes
# Chunks of work in processes of this computer, with results in order.

WAITING_PER_WORKER = 2  # chunks submitted ahead; bounds the memory of waiting results
# Not fork: it copies the locks of pyarrow's and BLAS's threads without the threads that free them. A fork
# server has no threads, and has loaded what the workers need before the first of them is wanted.
START = "forkserver"


def in_processes(
    apply: Callable[[bytes], list], chunks: Iterator[bytes], workers: int, *, load: str
) -> Iterator[list]:
    """Yield the list that `apply`, which is at the top level of a module, returns for each chunk.

    `workers` processes are used. Their server imports the module `load` once, so that none imports it again.

    Raises
    ------
    WorkerError
        If a process dies before it has answered (killed, or out of memory).
    """
    context = multiprocessing.get_context(START)
    context.set_forkserver_preload([load])
    executor = ProcessPoolExecutor(workers, context, _start_worker)
    sent: deque[Future[list]] = deque()

    def send(count: int) -> None:
        with _no_interrupt_for_children(), _main_out_of_sight():
            sent.extend(executor.submit(apply, chunk) for chunk in islice(chunks, count))

    finished = False
    try:
        send(workers * WAITING_PER_WORKER)
        while sent:
            made = sent.popleft().result()
            send(1)
            yield made
        finished = True
    except (BrokenProcessPool, EOFError) as error:  # EOFError if the fork server died
        fix = "If memory ran out, use fewer workers (--workers 1)."
        raise WorkerError("a worker process died before it had answered.", fix=fix) from error
    finally:
        processes = list((executor._processes or {}).values())
        executor.shutdown(wait=finished, cancel_futures=True)
        if not finished:  # interrupted or failed: pending results are discarded
            for process in processes:
                process.terminate()
            for process in processes:
                process.join()


@contextlib.contextmanager
def _no_interrupt_for_children() -> Iterator[None]:
    """Start processes that ignore Ctrl-C; the parent stops them, so that they print no traceback.

    A process inherits the blocked signals of the thread that starts it. A Ctrl-C in between waits, and is not
    lost.
    """
    resource_tracker.ensure_running()  # started here, because it unblocks Ctrl-C when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _main_out_of_sight() -> Iterator[None]:
    """Start processes that do not load the script that runs.

    A script that calls `sealfit.run` would be run again in each of them. They need nothing of it: what they
    do is found in modules.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _start_worker() -> None:
    one_thread()
    try:
        claim_memory()
    except MemoryError:
        os._exit(1)  # the parent says so
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent has died, so that a killed run leaves no waiting workers."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
