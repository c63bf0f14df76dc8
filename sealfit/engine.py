"""Map work over the cores of this computer or over a cluster, in order; the only file that knows which."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from sealfit.cluster import Cluster
    from sealfit.processes import Beside, Say

Given = TypeVar("Given")
Made = TypeVar("Made")

CHUNKS_PER_WORKER = 4  # enough to even out items of different cost, few enough to keep the cost of sending low
MAX_CHUNK = 32  # so that progress is shown often

_cluster: ContextVar[Cluster | None] = ContextVar("cluster", default=None)
_leads: ContextVar[bool] = ContextVar("leads", default=False)  # a process that may use others, although one itself


def cores() -> int:
    """Return the number of cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def on_cluster(scheduler: str | None, *folders: Path) -> Iterator[None]:
    """Let every map of the block run on the cluster of a Dask scheduler; on this computer where it is None.

    Parameters
    ----------
    scheduler : str or None
        Address ("tcp://host:8786"), or path of a scheduler file.
    folders : Path
        Folders that every worker has to see.

    Raises
    ------
    RequestError
        If the cluster cannot be used; it says why.
    """
    if scheduler is None:
        yield
        return
    from sealfit.cluster import Cluster

    cluster = Cluster(scheduler)
    before = _cluster.set(cluster)
    try:
        cluster.require_folders(*folders)
        yield
    finally:
        _cluster.reset(before)
        cluster.close()


def prepare(*modules: str, workers: int) -> None:
    """Begin to load `modules`, in the background, if processes of this computer will want them soon."""
    if workers > 1 and _cluster.get() is None:
        from sealfit.processes import prepare

        prepare(*modules)


def run_map(
    function: Callable[[Given], Made], items: Iterable[Given], *, workers: int = 1, together: int | None = None
) -> Iterator[Made]:
    """Yield `function(item)` for every item, in the order of the items.

    With one worker, one item, or inside a worker, the work is done here; otherwise in `workers` new processes, or on
    the cluster of `on_cluster`, several items at a time. Results do not depend on where.

    Parameters
    ----------
    function : callable
        A pure function at the top level of a module: processes find it by its name. An exception it raises ends the
        map and is raised here.
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
    yield from begin_map(function, list(items), workers=workers, together=together)


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
    cluster = _cluster.get()
    if _here(workers) or (len(items) <= 1 and cluster is None):
        return (function(item) for item in items)
    workers = min(workers, len(items)) if cluster is None else max(cluster.threads(), 1)
    size = together or max(1, min(MAX_CHUNK, len(items) // (workers * CHUNKS_PER_WORKER)))
    made = _elsewhere(function, items, size, workers)
    next(made)
    return made


def begin_beside(function: Callable[[Given, Say], Made], item: Given, *, workers: int) -> Beside | None:
    """Let another process of this computer do `function(item, say)`; None where work is done one after the other.

    It may map over `workers` processes in its turn. Close what is returned (`contextlib.closing`).

    Parameters
    ----------
    function : callable
        At the top level of a module; given the item and a function to call with what there is to say.
    item
        Sent to the process.
    workers : int
        Processes that may be used in all. With one, on a cluster and in a worker there is none to spare.
    """
    if _cluster.get() is not None or _here(workers):
        return None
    from sealfit.processes import Beside

    return Beside(_lead, pickle.dumps((function, item)))


def spare(workers: int) -> int:
    """Return how many processes are idle: in one begun with `begin_beside`, the process that began it is at work."""
    return max(workers - 1, 1) if _leads.get() else workers


def _here(workers: int) -> bool:
    """Whether the work is to be done in this process."""
    if multiprocessing.parent_process() is not None and not _leads.get():  # a worker itself
        return True
    return workers <= 1 and _cluster.get() is None


def _elsewhere(
    function: Callable[[Given], Made], items: Sequence[Given], size: int, workers: int
) -> Generator[Made, None, None]:
    """Yield once when the first items are sent, `size` at a time, then the results."""
    # Pickled here, not by another thread later, while the caller goes on to use and change the items.
    chunks = (pickle.dumps((function, items[start : start + size])) for start in range(0, len(items), size))
    cluster = _cluster.get()
    if cluster is None:
        from sealfit.processes import in_processes

        if _leads.get():  # its workers come from a server of its own, which then loads once what each would load
            prepare(function.__module__, workers=workers)
        made = in_processes(_apply, chunks, workers)
    else:
        made = cluster.apply(_apply, chunks)
    with contextlib.closing(made):
        next(made)
        yield None
        for results in made:
            yield from results


def _apply(pickled: bytes) -> list:
    function, chunk = pickle.loads(pickled)
    return [function(item) for item in chunk]


def _lead(pickled: bytes, say: Say) -> object:
    _leads.set(True)
    function, item = pickle.loads(pickled)
    return function(item, say)
