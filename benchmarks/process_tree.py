"""Wall seconds and peak memory of a command with all the processes it starts, each one in a fresh process.

Memory is looked at every `LOOK_EVERY_S`: the resident sets of the tree added up (pages that processes share
count once for each), and if asked for the proportional sets, in which shared pages are divided among them;
those take time to read, so not where seconds matter. `largest` is the system's own peak of the largest
process, which no look can miss.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

# Interval of measurements in s. One takes about 2 ms, one percent of a core.
LOOK_EVERY_S = 0.2
# Unit of `ru_maxrss` in bytes.
KIBI = 1 if sys.platform == "darwin" else 1024


@dataclass(frozen=True, slots=True)
class Watched:
    """What a command cost; memory in bytes."""

    seconds: float
    cpu_seconds: float  # of all its processes
    largest: int  # peak of the largest process
    resident: int  # peak of the tree's resident sets added up; 0 where nobody looked
    proportional: int  # peak of the proportional sets; 0 where nobody looked or the system does not tell
    output: str


def watched(
    command: Sequence[str | Path],
    *,
    cores: Collection[int] | None = None,
    look: bool = True,
    proportional: bool = False,
    show_errors: bool = False,
) -> Watched:
    """Run a command and return what it cost.

    Parameters
    ----------
    command : sequence of str or Path
        Program and arguments.
    cores : collection of int, optional
        Cores that it and its processes may use, where the system lets us say so.
    look, proportional : bool
        Whether to look at the memory of the tree, and at proportional sets too.
    show_errors : bool
        Leave its stderr to be seen; otherwise it is part of `output`.

    Raises
    ------
    CalledProcessError
        If it ends with another code than 0; `output` is what it printed.
    """
    pin = partial(os.sched_setaffinity, 0, cores) if cores and hasattr(os, "sched_setaffinity") else None
    most, ended = [0, 0], threading.Event()

    def keep_looking(root: int) -> None:
        while not ended.wait(LOOK_EVERY_S):
            for k, now in enumerate(memory(tree(root), proportional)):
                most[k] = max(most[k], now)

    with tempfile.TemporaryFile("w+", encoding="utf-8") as said:
        started = time.perf_counter()
        process = subprocess.Popen(
            [str(word) for word in command], stdout=said, stderr=None if show_errors else said, preexec_fn=pin
        )
        looker = threading.Thread(target=keep_looking, args=(process.pid,), daemon=True)
        if look:
            looker.start()
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - started
        ended.set()
        if look:
            looker.join()
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        output = said.read()
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, process.args, output)
    return Watched(seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * KIBI, *most, output)


def tree(root: int) -> list[int]:
    """Return the process ids of a process and all it has started."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:  # it has ended meanwhile
                continue
            children.setdefault(parent, []).append(int(entry.name))
    found, waiting = [], [root]
    while waiting:
        found.append(waiting.pop())
        waiting += children.get(found[-1], [])
    return found


def memory(pids: Collection[int], proportional: bool = True) -> tuple[int, int]:
    """Return the resident and the proportional sets of processes, in bytes; the latter 0 if unknown."""
    resident = shared_out = 0
    for pid in pids:
        try:
            resident += int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines() if proportional else []
        except OSError:
            continue
        shared_out += sum(int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:"))
    return resident, shared_out
