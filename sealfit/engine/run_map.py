"""Map work over the cores of this computer or over a Dask cluster, with results in order."""

from __future__ import annotations

import contextlib
import json
import logging
import multiprocessing
import os
import pickle
import re
import signal
import socket
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

from sealfit import __version__
from sealfit.engine import claim_memory, one_thread, undisturbed
from sealfit.errors import RequestError, WorkerError

if TYPE_CHECKING:
    from distributed import Client
    from distributed import Future as FutureOfDask

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
    with contextlib.closing(Cluster(scheduler)) as cluster:
        cluster.require_same_version()
        cluster.require_folders(*folders)
        before = _cluster.set(cluster)
        try:
            yield
        finally:
            _cluster.reset(before)


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

WAITING_PER_WORKER = 2  # chunks submitted ahead; bounds the memory of waiting results
# Not fork: it copies the locks of pyarrow's and BLAS's threads without the threads that free them. A fork
# server has no threads, and has loaded what the workers need before the first of them is wanted.
START = "forkserver"


def in_processes(
    apply: Callable[[bytes], list], chunks: Iterator[bytes], workers: int, *, load: str
) -> Iterator[list]:
    """Yield the list that `apply`, which is at the top level of a module, returns for each chunk.

    The server of the processes imports the module `load` once, so that none imports it again. WorkerError if
    a process dies before it has answered (killed, or out of memory).
    """
    context = multiprocessing.get_context(START)
    context.set_forkserver_preload([load])
    executor = ProcessPoolExecutor(workers, context, _start_worker)
    sent: deque[Future[list]] = deque()

    def send(count: int) -> None:
        # Undisturbed, because a process that has not started yet would not be ended below.
        with undisturbed(), _no_interrupt_for_children(), _main_out_of_sight():
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

    A process inherits the blocked signals of the thread that starts it.
    """
    resource_tracker.ensure_running()  # started here, because it unblocks Ctrl-C when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _main_out_of_sight() -> Iterator[None]:
    """Start processes that do not load the script that runs, which would run again in each of them."""
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
    multiprocessing.parent_process().join()
    os._exit(1)


# ---------------------------------------------------------------- cluster

WAITING_PER_THREAD = 2  # chunks submitted per thread of the cluster; bounds the memory of the scheduler
CONNECT_S = 15.0
EXAMPLE = "tcp://host:8786"
LOOK_S = 1.0  # interval between checks for workers, in s
ALONE_S = 60.0  # time without workers before an error, in s; a batch system needs time to start the next


class Cluster:
    """A connection to a Dask scheduler, by its address ("tcp://host:8786") or the path of its scheduler file.

    RequestError if Dask is not installed here, or nobody answers.
    """

    def __init__(self, scheduler: str) -> None:
        self.scheduler = scheduler
        self._client = _connected(scheduler)

    def require_same_version(self) -> None:
        """Raise RequestError if there is no worker, or one has another sealfit."""
        try:
            versions = self._client.run(_version)
        except ModuleNotFoundError as error:
            fix = f"Install sealfit {__version__} in the environment that they are started from."
            reason = f"the workers of {self.scheduler} cannot import {error.name}."
            raise RequestError(reason, fix=fix) from error
        if not versions:
            fix = f"Start one: dask worker {self.scheduler} --nthreads 1"
            raise RequestError(f"the cluster {self.scheduler} has no workers.", fix=fix)
        if others := {worker: found for worker, found in versions.items() if found != __version__}:
            worker, found = next(iter(others.items()))
            reason = f"the worker {worker} has sealfit {found}, here is {__version__}."
            raise RequestError(reason, fix="Install the same version on all workers.")

    def require_folders(self, *folders: Path) -> None:
        """Raise RequestError unless every worker sees these folders."""
        for folder in map(Path.resolve, folders):
            with self._reached():
                found = self._client.run(os.path.isdir, str(folder))
            if blind := [worker for worker, there in found.items() if not there]:
                fix = "Put campaign and OUT on a file system that all workers share, under the same path."
                raise RequestError(f"the worker {blind[0]} does not see the folder {folder}.", fix=fix)

    def threads(self) -> int:
        """Return the present number of threads of the cluster; WorkerError if its scheduler went away."""
        with self._reached():
            return sum(self._client.nthreads().values())

    @contextlib.contextmanager
    def _reached(self) -> Iterator[None]:
        """Raise WorkerError if the scheduler does not answer in the block, or did not before."""
        try:
            if self._client.scheduler is None:  # it did not come back, and the client has ended
                raise ConnectionError
            yield
        except OSError as error:
            raise self._went_away() from error

    def _went_away(self) -> WorkerError:
        fix = "Look at the scheduler, and run the command again."
        return WorkerError(f"the cluster {self.scheduler} went away.", fix=fix)

    def close(self) -> None:
        """Disconnect from the cluster, which keeps running."""
        self._client.close()

    def apply(self, function: Callable[[bytes], list], chunks: Iterator[bytes]) -> Iterator[list]:
        """Yield the list that `function` returns for each chunk.

        WorkerError if the cluster gives a chunk up, or goes away.
        """
        import dask
        from distributed import CancelledError, KilledWorker

        sent: deque = deque()

        def send() -> None:
            room = max(2, WAITING_PER_THREAD * self.threads()) - len(sent)
            # No warning of large chunks, as a fold is large.
            with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 TB"}):
                for chunk in islice(chunks, max(room, 0)):
                    # Not pure: Dask would merge equal chunks of two runs.
                    sent.append(self._client.submit(function, chunk, pure=False))

        try:
            send()
            while sent:
                made = self._result(sent[0])
                sent.popleft().release()
                send()
                yield made
        except KilledWorker as error:
            fix = "If memory ran out, give the workers more of it; their logs say more."
            what = "several workers of the cluster died over the same piece of work."
            raise WorkerError(what, fix=fix) from error
        except (CancelledError, OSError) as error:
            if sent and sent[0].status == "error":  # raised by the work itself
                raise
            raise self._went_away() from error
        finally:
            if sent and self._client.scheduler is not None:
                with contextlib.suppress(OSError):  # the scheduler went away
                    self._client.cancel(list(sent))

    def _result(self, future: FutureOfDask) -> list:
        """Return the result of a chunk; WorkerError after `ALONE_S` without workers."""
        ended, alone = threading.Event(), 0.0
        future.add_done_callback(lambda _: ended.set())  # Dask's wait may miss a result at its timeout
        while alone < ALONE_S:
            if ended.wait(LOOK_S):
                try:
                    return future.result(timeout=ALONE_S)  # not at once if its worker has died since
                except TimeoutError:
                    if future.status == "error":  # the work itself ended with one
                        raise
            alone = alone + LOOK_S if not self.threads() else 0.0
        fix = "If memory ran out, give them more of it; start them again, then run the command again."
        raise WorkerError(f"the cluster {self.scheduler} has no workers left.", fix=fix)


def _connected(scheduler: str) -> Client:
    try:
        from dask import config as settings
        from distributed import Client
    except ImportError as error:
        raise RequestError("Dask is not installed.", fix="Run: pip install 'sealfit[cluster]'") from error
    try:
        address = scheduler
        if Path(scheduler).is_file():
            address = json.loads(Path(scheduler).read_text("utf-8"))["address"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        fix = f"Give one that Dask wrote, or {EXAMPLE}."
        raise RequestError(f"{scheduler} is not a scheduler file.", fix=fix) from error
    place = re.fullmatch(r"\w+://\[?(?P<host>[^]]+)\]?:(?P<port>\d+)", address)
    if place is None:
        fix = f"Write {EXAMPLE}, or its file."
        raise RequestError(f"'{scheduler}' is not an address of a scheduler.", fix=fix)
    encrypted = address.startswith("tls://")
    if encrypted and settings.get("distributed.comm.tls.ca-file", None) is None:
        fix = "Set Dask's TLS options as for the scheduler: see docs/how-to/cluster.md."
        raise RequestError(f"{address} asks for a certificate, and none is set here.", fix=fix)
    if not encrypted and settings.get("distributed.comm.require-encryption", None):
        fix = "Give the scheduler's tls:// address, or unset require-encryption."
        raise RequestError(f"{address} is not encrypted, and Dask's options here ask for it.", fix=fix)
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # our own error says it in one line
    try:  # checked first, because a client without a scheduler blocks for a minute
        socket.create_connection((place["host"], int(place["port"])), timeout=CONNECT_S).close()
        return Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        fix = "Start one (dask scheduler), or give the path of its scheduler file."
        raise RequestError(f"no Dask scheduler answers at {address}.", fix=fix) from error


def _version() -> str:
    one_thread()
    return __version__
