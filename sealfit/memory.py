"""What a process does with memory that it has freed."""

from __future__ import annotations

import ctypes
from functools import cache

# Names and numbers of malloc.h; other C libraries have no such function, and leave it as it is.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
KEPT_BYTES = 64_000_000  # at the heap's end; some ten columns of a part's samples
LARGE_BYTES = 16_000_000  # larger arrays have pages of their own, and give them back


@cache
def keep_freed_pages() -> None:
    """Let the C library keep some freed memory for the arrays made next, which would be given new pages otherwise.

    The kernel clears a page before it gives it away: for the arrays of a part's samples, a tenth of reading them.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # not glibc; on Windows there is no library without a name
        return
    mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
    mallopt(M_MMAP_THRESHOLD, LARGE_BYTES)
