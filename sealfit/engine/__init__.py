"""Threads of linear algebra, memory and Ctrl-C. It imports little, because every command imports it first."""

from __future__ import annotations

import contextlib
import mmap
import os
import signal
import threading
from collections.abc import Iterator

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def one_thread() -> None:
    """Set linear algebra to one thread in this process and its children, unless the user set the variables.

    Processes share the cores here, and the rounding depends on the number of threads. To be called before
    numpy loads.
    """
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")


# Bytes of address space that a run of a small campaign takes. With less, libraries in C would end the process
# with messages of their own, or wait for memory for ever.
LEAST_MEMORY = 640 << 20


def claim_memory() -> None:
    """Let linear algebra take its buffers and Arrow its thread now; MemoryError if there is no room.

    OpenBLAS takes a buffer at its first product. If there is none, it tries again for ever. Arrow starts a
    thread when it reads its first text, and aborts the process if it cannot.
    """
    try:
        mmap.mmap(-1, LEAST_MEMORY).close()
    except OSError as error:
        raise MemoryError("less than a small campaign needs") from error
    import numpy as np
    from pyarrow import BufferReader, csv
    from scipy.linalg import solve_triangular

    csv.read_csv(BufferReader(b"x\n1\n"), csv.ReadOptions(use_threads=False))
    one = np.eye(64)
    solve_triangular(one @ one, one)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Delay Ctrl-C until the block has ended, which moves files to OUT or starts processes."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield  # signals reach the main thread only
        return
    waiting: list[object] = []
    signal.signal(signal.SIGINT, lambda *caught: waiting.append(caught))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if waiting:
            signal.raise_signal(signal.SIGINT)
