"""`sealfit ingest` beside a bare loop of pyarrow.csv.read_csv, and its memory: parts of `speed.py`."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from in_turns import in_turns, ratios, show
from many_files import write_campaign
from process_tree import Watched, watched

BARE = Path(__file__).with_name("bare_read.py")


def ingest(campaign: Path, cores: Sequence[int], repeats: int, work: Path) -> None:
    """Print the seconds of the bare loop and of ingest with one and two workers, and their ratios."""
    one, two = cores[:1], cores[:2]
    out = work / "ingest_out"

    def bare() -> dict[str, float]:
        cost = watched([sys.executable, BARE, campaign], cores=one, look=False)
        return {"": cost.seconds, "the loop alone": float(cost.output)}

    def workers(count: int, pinned: Sequence[int]) -> Callable[[], dict[str, float]]:
        return lambda: {"": ingested(campaign, out, count, pinned, look=False).seconds}

    bare()  # brings the files into the system's cache
    found = in_turns({"bare": bare, "one": workers(1, one), "two": workers(2, two)}, repeats)
    print(f"\ningest of {campaign.name}, {repeats} turns")
    show("pyarrow.csv.read_csv, every file, one core", found["bare"])
    show("  of these the loop alone", found["bare, the loop alone"])
    show("sealfit ingest --workers 1, one core", found["one"])
    show("sealfit ingest --workers 2, two cores", found["two"])
    show("ingest / bare loop, whole processes", ratios(found["one"], found["bare"]), "x", "at most 2.5")
    show("ingest / bare loop alone", ratios(found["one"], found["bare, the loop alone"]), "x")
    show("one worker / two", ratios(found["one"], found["two"]), "x", "at least 1.7")


def ingested(campaign: Path, out: Path, workers: int, cores: Sequence[int], *, look: bool = True) -> Watched:
    """Return what a first ingest costs; `out` is gone before and after."""
    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, "-m", "sealfit", "ingest", campaign, "--out", out, "--workers", str(workers)]
    cost = watched(command, cores=cores, look=look)
    shutil.rmtree(out)
    return cost


def peaks(sizes: Sequence[int], *, rows: int, seed: int, cores: Sequence[int], work: Path) -> None:
    """Print the peak memory of ingest of campaigns that differ in the number of files only."""
    print(f"\nmemory of ingest, files of {rows} rows")
    for workers in (1, 2):
        first = None
        for files in sizes:
            campaign = work / f"files_{files}_rows_{rows}_seed_{seed}"
            if not (campaign / "runs.csv").exists():  # written last
                write_campaign(campaign, files, rows=rows, seed=seed)
            cost = ingested(campaign, work / "memory_out", workers, cores[:workers])
            first = first or cost
            print(
                f"  {files:7,} files, --workers {workers}: {cost.resident / 1e6:7.0f} MB in all "
                f"({cost.resident / first.resident:.2f} x), {cost.largest / 1e6:6.0f} MB the largest process "
                f"({cost.largest / first.largest:.2f} x), {1e3 * cost.seconds / files:.3f} ms a file",
                flush=True,
            )
