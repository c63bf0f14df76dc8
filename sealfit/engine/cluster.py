"""Chunks of work on a running Dask cluster, with results in order.

Nothing is kept on the cluster: a chunk is sent as bytes, and its answer comes back or, for what is large,
lies on the file system that all workers share. So Dask may do a chunk again on another worker if one dies, as
often as it likes.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import socket
import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from sealfit import __version__
from sealfit.engine import one_thread
from sealfit.errors import RequestError, WorkerError

if TYPE_CHECKING:
    from distributed import Client, Future

WAITING_PER_THREAD = 2  # chunks submitted per thread of the cluster; bounds the memory of the scheduler
CONNECT_S = 15.0
EXAMPLE = "tcp://host:8786"
LOOK_S = 1.0  # interval between checks for workers, in s
ALONE_S = 60.0  # time without workers before an error, in s; a batch system needs time to start the next


class Cluster:
    """A connection to a running Dask scheduler.

    Parameters
    ----------
    scheduler : str
        Its address ("tcp://host:8786"), or the path of the scheduler file that it wrote.

    Raises
    ------
    RequestError
        If Dask is not installed here, nobody answers, there is no worker, or a worker has another sealfit.
    """

    def __init__(self, scheduler: str) -> None:
        self.scheduler = scheduler
        self._client = _connected(scheduler)
        try:
            self._check_versions()
        except BaseException:
            self.close()
            raise

    def _check_versions(self) -> None:
        try:
            versions = self._client.run(_version)
        except ModuleNotFoundError as error:
            raise RequestError(
                f"the workers of {self.scheduler} cannot import {error.name}.",
                fix=f"Install sealfit {__version__} in the environment that they are started from.",
            ) from error
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
                    key = f"sealfit-{uuid.uuid4().hex}"  # Dask would merge equal chunks of two runs
                    sent.append(self._client.submit(function, chunk, key=key, pure=False))

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

    def _result(self, future: Future) -> list:
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
