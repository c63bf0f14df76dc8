"""How many threads linear algebra uses; imports next to nothing, as every command begins here."""

from __future__ import annotations

import os

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def one_thread() -> None:
    """Let linear algebra use one thread in this process and those it starts, unless the user has said otherwise.

    Its products are small, and here processes share the cores: more threads only wait for each other, and their
    rounding depends on how many there are. To be called before numpy loads.
    """
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")
