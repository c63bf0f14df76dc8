"""No test is judged by how long it takes: the first example of a process may load scipy on a busy machine.

A shell starts what it puts in the background with Ctrl-C ignored; tests that send one need it heard, wherever
they run.
"""

import os
import signal

from sealfit.engine import one_thread

one_thread()
signal.signal(signal.SIGINT, signal.default_int_handler)

from hypothesis import settings  # noqa: E402

settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


def pytest_xdist_auto_num_workers():
    """Return a number above that of cores: some tests wait, for a killed worker, a port or a browser."""
    return len(os.sched_getaffinity(0)) + 1 if hasattr(os, "sched_getaffinity") else None
