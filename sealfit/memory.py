"""What a process does with memory that it has freed."""

from __future__ import annotations

import numpy as np

KEPT = 24 << 20  # bytes; the most that glibc learns from is 32 MB


def keep_freed_memory() -> None:
    """Let the C library keep some freed memory for the arrays made next, which would be given new pages otherwise.

    glibc gives free memory back above twice the largest mapped piece that was ever freed. A page that is asked for
    again costs a fault, and the kernel clears it: a tenth of reading a part, a third of fitting a block of problems.
    Nothing is written here, so it costs nothing; other C libraries do as they always do.
    """
    np.empty(KEPT, np.uint8)
