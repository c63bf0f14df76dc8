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

# Tests of what a loss of power leaves replace this by their own. The others would wait for the disk: those of
# test_cli.py 2,967 times, as long as they compute.
os.fsync = lambda handle: None

settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


def pytest_xdist_auto_num_workers():
    """Return a number above that of cores: some tests wait, for a killed worker, a port or a browser."""
    return len(os.sched_getaffinity(0)) + 1 if hasattr(os, "sched_getaffinity") else None


# Files of half a minute and more: begun last they would be waited for alone.
LONG_FILES = (
    "test_docs.py",
    "test_search.py",
    "test_cluster.py",
    "test_pipeline.py",
    "test_notebook.py",
    "test_page.py",
    "test_fuzzing.py",
    "test_benchmark_invariances.py",
    "test_faults.py",
    "test_measured_campaigns.py",
    "test_store.py",
    "test_loop.py",
    "test_subsampling.py",
    "test_pairs.py",
    "test_browser.py",
    "test_joint.py",
    "test_aging.py",
    "test_masked_pairs.py",
    "test_pollution.py",
)


def pytest_collection_modifyitems(items):
    """Put long files first; xdist's --no-loadscope-reorder keeps this order, and its own counts tests."""
    places = {name: place for place, name in enumerate(LONG_FILES)}
    items.sort(key=lambda item: places.get(item.path.name, len(places)))
