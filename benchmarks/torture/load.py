"""Long load: many files, long traces, wide traces, many conditions, and many runs in one process.

    python benchmarks/torture/load.py [--scale 0.01] [--parts files rows columns conditions again]

Each part makes a campaign, runs commands on it, each in a fresh process, and prints the seconds and the peak
memory of the process. `again` analyses one campaign many times in one process, and prints the growth of its
memory and of its open handles, and the temporary files that are left. --scale multiplies all sizes.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import csv

sys.path.insert(1, str(Path(__file__).resolve().parent.parent))  # the other benchmarks
from many_files import write_campaign
from process_tree import watched

SIZES = {"files": 100_000, "rows": 10_000_000, "columns": 500, "conditions": 10_000, "again": 200}
TINY = 40  # rows of a tiny trace
SPEEDS = (0.5, 2.0, 8.0, 30.0)
MIB = 2**20


# ---------------------------------------------------------------- campaigns
def write_trace(path: Path, rows: int, speed_mm_s: float, *, force_N: float = 40.0, columns: int = 0) -> None:
    """Write a stroke of 40 mm with noise, and so many further columns."""
    rng = np.random.default_rng([rows, round(1000 * speed_mm_s), round(1000 * force_N), columns])
    share = np.linspace(0.0, 1.0, rows)
    table = {
        "time_s": np.round(share * 40.0 / speed_mm_s, 9),
        "displacement_mm": np.round(40.0 * share, 8),
        "force_N": np.round(force_N + 0.2 * rng.standard_normal(rows), 3),
    }
    table |= {f"channel_{k:03d}": np.round(rng.standard_normal(rows), 3) for k in range(columns)}
    path.parent.mkdir(parents=True, exist_ok=True)
    csv.write_csv(pa.table(table), path)


def write_runs(folder: Path, rows: Sequence[tuple[str, float, float, int]]) -> None:
    """Write runs.csv: file, days, speed and repeat of every trace."""
    lines = [f"{file},{days:g},{speed:g},{repeat},60,80,49.03\n" for file, days, speed, repeat in rows]
    head = "file,aging_days,speed_mm_s,repeat,temperature_C,compression_ratio_pct,load_N\n"
    (folder / "runs.csv").write_text(head + "".join(lines))


def write_long(folder: Path, rows: int) -> None:
    """Write a campaign of one trace of so many rows."""
    write_trace(folder / "long.csv", rows, 5.0)
    write_runs(folder, [("long.csv", 0, 5.0, 1)])


def write_wide(folder: Path, columns: int, *, rows: int = 200) -> None:
    """Write a campaign of eight traces with so many columns each."""
    listed = [(f"v{speed:g}_{repeat}.csv", 0, speed, repeat) for speed in SPEEDS for repeat in (1, 2)]
    for file, _, speed, repeat in listed:
        write_trace(folder / file, rows, speed, force_N=38.0 + 0.2 * repeat + speed / 20, columns=columns)
    write_runs(folder, listed)


def write_conditions(folder: Path, conditions: int) -> None:
    """Write a campaign of so many conditions of two tiny traces each; at most 1,000 files a folder."""
    listed = []
    for number in range(conditions):
        for speed in SPEEDS[1:3]:
            file = f"{number // 500:03d}/{number}_{speed:g}.csv"
            write_trace(
                folder / file, TINY, speed, force_N=30 + 10 * np.exp(-number / conditions) + speed / 20
            )
            listed.append((file, 1 + number, speed, 1))
    write_runs(folder, listed)


# ---------------------------------------------------------------- one process a command
def cost(commands: Sequence[Sequence[str | Path]]) -> Iterator[dict]:
    """Yield seconds and peak memory in MiB of commands of sealfit, each in a fresh process."""
    for arguments in commands:
        run = watched([sys.executable, "-m", "sealfit", *arguments], look=False)
        yield {"command": arguments[0], "seconds": run.seconds, "MiB": run.largest / MIB}


def part(name: str, size: int, home: Path) -> Iterable[dict]:
    """Make the campaign of one part and return what the commands on it cost."""
    campaign, out = home / "campaign", home / "out"
    ingest = ["ingest", campaign, "--out", out]
    if name == "again":
        return [in_a_child(size, home)]
    write: dict[str, Callable] = {
        "files": lambda folder, files: write_campaign(folder, files, rows=TINY),
        "rows": write_long,
        "columns": write_wide,
        "conditions": write_conditions,
    }
    campaign.mkdir()
    write[name](campaign, size)
    later = {
        "columns": ("fit-steady", "fit-aging", "fit-dynamic", "close-loop"),
        "conditions": ("fit-steady",),
    }
    return cost([ingest, *([step, out] for step in later.get(name, ()))])


# ---------------------------------------------------------------- many runs in one process
def again(runs: int, home: Path, report: bool = True) -> dict:
    """Analyse one campaign so many times in this process; growth after a third of them, and what is left.

    Every run redoes all fits, every tenth the loop, too, and with `report` the report.
    """
    import sealfit
    from sealfit.pipeline import run

    campaign, out, temporary = home / "campaign", home / "out", home / "tmp"
    temporary.mkdir()
    os.environ["TMPDIR"] = tempfile.tempdir = str(temporary)
    write_wide(campaign, 2, rows=60)
    memory, began = [], time.perf_counter()
    fits = ("ingest", "fit-steady", "fit-aging", "fit-dynamic")
    whole = {} if report else {"steps": (*fits, "close-loop")}
    for number in range(runs):
        run(campaign, out, force=True, **(whole if number % 10 == 0 else {"steps": fits}))
        sealfit.open(out).steady  # noqa: B018
        gc.collect()
        memory.append(resident())
        if number == 0:
            handles = open_handles()
    settled = memory[len(memory) // 3 :]
    return {
        "command": f"{runs} runs in a row",
        "seconds": time.perf_counter() - began,
        "MiB": max(memory) / MIB,
        "growth_MiB": (np.mean(settled[-5:]) - np.mean(settled[:5])) / MIB,
        "handles_more": open_handles() - handles,
        "left": sorted(str(path) for path in [*temporary.iterdir(), *out.glob(".*")]),
    }


def in_a_child(runs: int, home: Path, report: bool = True) -> dict:
    """Return what `again` finds in a fresh process."""
    command = [
        sys.executable,
        __file__,
        "--again",
        str(runs),
        "--work",
        home,
        *([] if report else ["--no-report"]),
    ]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(ended.stdout.splitlines()[-1])


def resident() -> int:
    """Return the resident memory of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def open_handles() -> int:
    """Return the number of open files, pipes and sockets of this process."""
    return len(os.listdir("/proc/self/fd"))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--parts", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--scale", type=float, default=1.0, help="of all sizes")
    parser.add_argument("--work", type=Path, help="folder for the campaigns; default a temporary one")
    parser.add_argument("--again", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--no-report", action="store_true", help="no report in the runs in a row")
    given = parser.parse_args()
    if given.again:
        print(json.dumps(again(given.again, given.work, not given.no_report)))
        return
    for name in given.parts:
        size = max(round(SIZES[name] * given.scale), 4)
        home = Path(tempfile.mkdtemp(prefix="load-", dir=given.work))
        try:
            for found in part(name, size, home):
                more = {k: v for k, v in found.items() if k not in ("command", "seconds", "MiB")}
                words = f"{found['seconds']:7.1f} s {found['MiB']:7.0f} MiB  {more or ''}"
                print(f"{size:>10,} {name:10} {found['command']:20} {words}", flush=True)
        finally:
            shutil.rmtree(home)


if __name__ == "__main__":
    main()
