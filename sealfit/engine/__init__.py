"""Number of threads of linear algebra. It imports little, because every command imports it first."""

from __future__ import annotations

import os

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def one_thread() -> None:
    """Set linear algebra to one thread in this process and its children, unless the user set the variables.

    Its products are small, and here processes share the cores: more threads only wait for each other, and
    their rounding depends on how many there are. To be called before numpy loads.
    """
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")
