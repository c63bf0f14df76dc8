"""Measure the whole loop on some 600 files of 1,000 rows with 10 columns that mean nothing: wall seconds and memory.

    python benchmarks/loop_cost.py [KIND] [--strength strong] [--seed 1] [--workers 2]

Runs `sealfit ingest`, the fits, and `sealfit close-loop`, which alone is timed. Memory is that of the process tree,
looked at every 0.2 s: resident sets added up (pages that processes share count once for each), and proportional sets
where the system tells them (shared pages divided among them).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from campaigns import campaign

from sealfit.simulate import Spec, simulate

LOOK_EVERY_S = 0.2
NUMBERS = tuple(
    {"kind": "numeric", "name": f"number_{k}", "level": level, "mean": 10.0, "sd": 2.0}
    for k, level in enumerate(("file", "file", "run", "run", "run", "specimen"))
)
OTHERS = (
    {"kind": "slow", "name": "air_pressure_hPa", "mean": 1013.0, "sd": 5.0, "correlation_h": 24.0},
    {"kind": "trace", "name": "motor_current_A", "mean": 2.0, "sd": 0.1, "correlation_s": 1.0},
    {"kind": "category", "name": "operator", "level": "run", "labels": ("A", "B", "C")},
    {"kind": "category", "name": "fixture", "level": "file", "labels": ("left", "right")},
)


def with_idle_columns(spec: Spec) -> Spec:
    """Return a SPEC with 10 more columns that have no influence."""
    return Spec.model_validate(spec.model_dump() | {"channels": [*spec.model_dump()["channels"], *NUMBERS, *OTHERS]})


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


def memory(pids: list[int]) -> tuple[int, int]:
    """Return the resident and the proportional sets of processes, in bytes; the latter 0 where it is not told."""
    resident = proportional = 0
    for pid in pids:
        try:
            resident += int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        except OSError:
            continue
        proportional += sum(int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:"))
    return resident, proportional


def watched(command: list[str]) -> tuple[float, int, int]:
    """Return wall seconds and the peaks of both memories of a command.

    Raises
    ------
    CalledProcessError
        If it ends with another code than 0.
    """
    started = time.monotonic()
    process = subprocess.Popen(command)
    most = (0, 0)
    while process.poll() is None:
        most = tuple(max(pair) for pair in zip(most, memory(tree(process.pid)), strict=True))
        time.sleep(LOOK_EVERY_S)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return time.monotonic() - started, *most


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", nargs="?", default="three_at_once", metavar="KIND")
    parser.add_argument("--strength", default="strong")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    spec = with_idle_columns(
        campaign(given.kind, seed=given.seed, size="large", strength=given.strength, rows=1000),
    )
    sealfit = [sys.executable, "-m", "sealfit.cli"]
    with tempfile.TemporaryDirectory() as folder:
        place, out = Path(folder) / "campaign", Path(folder) / "out"
        simulate(spec, place)
        files = len(list((place / "traces").iterdir()))
        workers = ["--workers", str(given.workers)]
        subprocess.run([*sealfit, "ingest", str(place), "--out", str(out)], check=True, stdout=subprocess.DEVNULL)
        for step in ("fit-steady", "fit-aging", "fit-dynamic"):  # close-loop wants them to be there
            subprocess.run([*sealfit, step, str(out)], check=True, stdout=subprocess.DEVNULL)
        seconds, resident, proportional = watched([*sealfit, "close-loop", str(out), *workers])
    print(
        f"{given.kind}, {given.strength}, {files} files, 10 idle columns, {given.workers} workers: "
        f"{seconds:.0f} s, resident sets {resident / 1e9:.2f} GB, proportional sets {proportional / 1e9:.2f} GB"
    )


if __name__ == "__main__":
    main()
