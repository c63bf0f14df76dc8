"""Number of threads of linear algebra. It imports little, because every command imports it first."""

from __future__ import annotations

import mmap
import os

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def one_thread() -> None:
    """Set linear algebra to one thread in this process and its children, unless the user set the variables.

    Its products are small, and here processes share the cores: more threads only wait for each other, and
    their rounding depends on how many there are. To be called before numpy loads.
    """
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")


BUFFERS = 256 << 20  # bytes; OpenBLAS takes 32 MB for numpy and for scipy each, and more where it has threads


def claim_memory() -> None:
    """Let linear algebra take its buffers now; MemoryError if there is no room for them.

    OpenBLAS takes a buffer at its first product. If there is none, it tries again for ever.
    """
    try:
        mmap.mmap(-1, BUFFERS).close()
    except OSError as error:
        raise MemoryError("no room for the buffers of linear algebra") from error
    import numpy as np
    from scipy.linalg import solve_triangular

    one = np.eye(64)
    solve_triangular(one @ one, one)
