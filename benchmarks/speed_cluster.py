"""What a Dask cluster adds to ingest: one campaign by processes and by a local cluster; an empty task."""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from dask_here import DaskHere
from in_turns import in_turns, ratios, show
from process_tree import Watched, watched

from sealfit.engine.run_map import on_cluster, run_map

TASKS, SENT, ANSWERED = 1_000, 60_000, 120_000  # bytes that a part of some 230 files sends and answers
# Mean number of files in a partition.
PER_PART = 230
# Number of files of the extrapolation.
MANY = 10_000_000
WORKERS = (2, 128, 1024)


def cluster(campaign: Path, cores: Sequence[int], repeats: int, work: Path) -> None:
    """Print seconds of ingest by two processes and by a cluster of two workers, and of a task by itself."""
    print("\ncluster of a scheduler and two workers on the same cores")
    with TemporaryDirectory() as folder:
        dask = DaskHere(Path(folder), workers=2, paths=(Path(__file__).parent,))
        try:
            dask.wait()
            ways = {"processes": ("--workers", "2"), "cluster": ("--scheduler", str(dask.file))}
            measured = {name: partial(_seconds, campaign, cores, work, how) for name, how in ways.items()}
            figures = in_turns(measured, repeats)
            empty_s = [_task_seconds(dask) for _ in range(repeats)]
        finally:
            dask.stop()
    for name, values in figures.items():
        show(f"ingest by {name}", values)
    show("cluster over processes", ratios(figures["cluster"], figures["processes"]), "x")
    what = f"a task of {SENT // 1000} kB that answers {ANSWERED // 1000} kB and does nothing"
    show(what, [1e3 * value for value in empty_s], "ms")
    reckon(statistics.median(empty_s), *_per_file(campaign, cores, work))


def _per_file(campaign: Path, cores: Sequence[int], work: Path) -> tuple[float, float]:
    """Return the seconds that a file costs whoever reads it, and the process that asks for it."""
    output = _ingest(campaign, cores, work, ("--workers", "1", "--profile", "--json")).output
    made = json.loads(output[output.index("{") :])  # after the progress
    parts = {part["part"]: part for part in made["profile"] if part["step"] == "ingest"}
    files, reading = parts["reading trace files"]["rows"], parts["reading trace files"]["seconds"]
    here = parts[None]["seconds"] - reading - parts["loading libraries"]["seconds"]
    return reading / files, here / files


def reckon(empty_s: float, reading_s: float, here_s: float) -> None:
    """Print what so many files would take, step by step of the reckoning."""
    tasks = MANY / PER_PART
    print(f"  reckoned for {MANY:,} files like these, {PER_PART} a task: {tasks:,.0f} tasks")
    print(
        f"    reading  {MANY:,} x {1e3 * reading_s:.3f} ms = {MANY * reading_s / 3600:.1f} hours of workers"
    )
    print(
        f"    sending  {tasks:,.0f} x {1e3 * empty_s:.2f} ms = {tasks * empty_s / 60:.1f} minutes, "
        "while they work"
    )
    print(
        f"    here     {MANY:,} x {1e3 * here_s:.4f} ms = {MANY * here_s / 60:.0f} minutes, before and after"
    )
    for workers in WORKERS:
        seconds = MANY * here_s + max(MANY * reading_s / workers, tasks * empty_s)
        print(f"    with {workers:5,d} workers: {seconds / 3600:.1f} hours")


def _seconds(campaign: Path, cores: Sequence[int], work: Path, how: Sequence[str]) -> dict[str, float]:
    return {"": _ingest(campaign, cores, work, how).seconds}


def _ingest(campaign: Path, cores: Sequence[int], work: Path, how: Sequence[str]) -> Watched:
    out = work / "cluster_out"
    return watched(
        [sys.executable, "-m", "sealfit", "ingest", campaign, "--out", out, "--force", *how],
        cores=cores,
        look=False,
    )


def _task_seconds(dask: DaskHere) -> float:
    with on_cluster(str(dask.file)):
        began = time.perf_counter()
        for _ in run_map(empty, [bytes(SENT)] * TASKS, together=1):
            pass
        return (time.perf_counter() - began) / TASKS


def empty(sent: bytes) -> bytes:
    """Do nothing with what a part sends, and answer as much as a part does."""
    return bytes(ANSWERED)
