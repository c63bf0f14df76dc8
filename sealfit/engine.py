"""Map work over the cores of this computer or over a cluster, in order; the only file that knows which."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from sealfit.cluster import Cluster

Given = TypeVar("Given")
Made = TypeVar("Made")

CHUNKS_PER_WORKER = 4  # enough to even out items of different cost, few enough to keep the cost of sending low
MAX_CHUNK = 32  # so that progress is shown often

_cluster: ContextVar[Cluster | None] = ContextVar("cluster", default=None)


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
    items = items if isinstance(items, Sequence) else list(items)
    cluster = _cluster.get()
    inside_worker = multiprocessing.parent_process() is not None
    if inside_worker or (cluster is None and (workers <= 1 or len(items) <= 1)):
        yield from map(function, items)
        return
    workers = min(workers, len(items)) if cluster is None else max(cluster.threads(), 1)
    size = together or max(1, min(MAX_CHUNK, len(items) // (workers * CHUNKS_PER_WORKER)))
    # Pickled here, not by another thread later, while the caller goes on to use and change the items.
    chunks = (pickle.dumps((function, items[start : start + size])) for start in range(0, len(items), size))
    if cluster is None:
        from sealfit.processes import in_processes

        made = in_processes(_apply, chunks, workers, load=function_module(function))
    else:
        made = cluster.apply(_apply, chunks)
    with contextlib.closing(made):
        for results in made:
            yield from results


def function_module(function: Callable) -> str:
    """Return the name of the module that a function, or a partial one, is found in."""
    return getattr(function, "func", function).__module__


def _apply(pickled: bytes) -> list:
    function, chunk = pickle.loads(pickled)
    return [function(item) for item in chunk]
