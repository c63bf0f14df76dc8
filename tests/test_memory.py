import ctypes
import os
import subprocess
import sys

import pytest

from sealfit.ending import exit_code

FAULTS = """
import resource, sys
import numpy as np
from sealfit.memory import keep_freed_memory
if "keep" in sys.argv:
    keep_freed_memory()
    keep_freed_memory()
def faults(turns):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(turns):
        columns = [np.ones(1_500_000) for _ in range(4)]
        del columns
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults(5)
print(faults(10))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only glibc gives pages back as it is told")
def test_arrays_made_again_and_again_take_the_pages_of_those_before():
    if not hasattr(ctypes.CDLL(None), "mallopt"):
        pytest.skip("this C library has no mallopt")
    made = [
        int(subprocess.run([sys.executable, "-c", FAULTS, word], check=True, capture_output=True, text=True).stdout)
        for word in ("keep", "leave")
    ]
    columns = 10 * 4 * 1_500_000 * 8 // 4096  # pages of all columns made
    assert made[0] < 0.1 * columns < made[1]


@pytest.mark.parametrize(("said", "used"), [(None, "system"), ("default", "default")])
def test_arrow_asks_the_system_for_memory_unless_the_user_says_otherwise(said, used, monkeypatch):
    name = "ARROW_DEFAULT_MEMORY_POOL"
    monkeypatch.setenv(name, said or "")
    if said is None:
        monkeypatch.delenv(name)
    assert exit_code(lambda **given: 0) == 0
    assert os.environ[name] == used


def test_a_command_that_ends_looks_for_no_garbage():
    told = "import atexit, gc; atexit.register(lambda: print(gc.get_freeze_count()))"
    ended = "from sealfit.ending import exit_code; exit_code(lambda **given: 0)"
    for code, some in ((told, False), (f"{told}; {ended}", True)):
        ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
        assert (int(ran.stdout) > 0) == some
