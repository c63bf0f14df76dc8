"""Measure how fast `sealfit` is beside what else there is: commands in fresh processes, in turns, medians.

    python benchmarks/speed.py ingest  [--campaign DIR] [--repeats 5]  beside a bare pyarrow.csv.read_csv loop
    python benchmarks/speed.py memory  [--files 1752 17520]            peak memory of ingest, 10x the files
    python benchmarks/speed.py run     [--campaign DIR] [--repeats 3]  beside `pandas_script.py`
    python benchmarks/speed.py startup [--repeats 20]                  beside `import typer`; imports
    python benchmarks/speed.py cluster [--campaign DIR] [--repeats 3]  local: a Dask cluster beside processes
    python benchmarks/speed.py growth  [--files 1000 10000 100000] [--steps all] [--effect conditioning]
    python benchmarks/speed.py conditions  [--files 200 1000 3000 10000]   fits of so many conditions

Several parts may be named at once. Without --campaign the paper's own, 1,752 files of 1,000 rows, is
simulated first. What is written goes to a temporary folder, or to --work DIR, where campaigns are kept for
the next time.

Seconds are wall time of whole processes, from start to end, with the files in the system's cache: each
campaign is read once before. What runs on "one core" is pinned to one, everything else to the first two.
Memory: see `process_tree.py`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import speed_cluster
import speed_growth
import speed_ingest
import speed_run
import speed_startup
from campaigns import paper_campaign
from in_turns import heading
from many_files import EFFECTS

from sealfit.simulation import simulate

PARTS = ("ingest", "memory", "run", "startup", "growth", "conditions", "cluster")
NEEDS_CAMPAIGN = ("ingest", "run", "cluster")
REPEATS = {"ingest": 5, "run": 3, "startup": 20, "cluster": 3}
FILES = {
    "memory": (1752, 17520),
    "growth": (1000, 10_000, 100_000),
    "conditions": (200, 1000, 3000, 10_000),
}


def main() -> None:
    given = arguments()
    cores = sorted(os.sched_getaffinity(0))[:2] if hasattr(os, "sched_getaffinity") else [0, 1]
    heading(given.seed, cores)
    with tempfile.TemporaryDirectory() as temporary:
        work = given.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        campaign = paper(given, work) if set(given.parts) & set(NEEDS_CAMPAIGN) else None
        for part in given.parts:
            repeats, sizes = given.repeats or REPEATS.get(part, 1), given.files or FILES.get(part, ())
            match part:
                case "ingest":
                    speed_ingest.ingest(campaign, cores, repeats, work)
                case "memory":
                    speed_ingest.peaks(
                        sizes, rows=given.rows or 1000, seed=given.seed, cores=cores, work=work
                    )
                case "run":
                    speed_run.run(campaign, cores, repeats, given.resamples, work)
                case "startup":
                    speed_startup.startup(cores, repeats)
                case "cluster":
                    speed_cluster.cluster(campaign, cores, repeats, work)
                case "growth":
                    growth(given, sizes, cores, work)
                case "conditions":
                    speed_growth.conditions(sizes, seed=given.seed, cores=cores, work=work)


def growth(given: argparse.Namespace, sizes: Sequence[int], cores: Sequence[int], work: Path) -> None:
    """Measure every size of campaign, and print what a further file costs."""
    how = {"rows": given.rows or 80, "seed": given.seed, "workers": given.workers, "steps": given.steps}
    how["effect"] = given.effect
    print(f"\ngrowth, --workers {given.workers}")
    seconds = [(files, speed_growth.measure(files, cores=cores, work=work, **how)) for files in sizes]
    print()
    speed_growth.each_further_file(seconds)


def arguments() -> argparse.Namespace:
    """Return what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="+", choices=PARTS, metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--campaign", type=Path, help="instead of the paper's, for ingest and run")
    parser.add_argument(
        "--work", type=Path, help="folder for campaigns and results, kept; default: a temporary one"
    )
    parser.add_argument("--repeats", type=int, help=f"turns; default: {REPEATS}")
    parser.add_argument(
        "--files", type=int, nargs="+", help=f"sizes of memory, growth and conditions; default: {FILES}"
    )
    parser.add_argument("--rows", type=int, help="of a file of memory and growth; default: 1000 and 80")
    parser.add_argument("--workers", type=int, default=2, help="of growth")
    parser.add_argument(
        "--steps", choices=("ingest", "all"), default="ingest", help="of growth: the later steps too"
    )
    parser.add_argument("--effect", choices=EFFECTS, help="in the files of growth; default: none")
    parser.add_argument("--resamples", type=int, default=200, help="of the script's bootstrap")
    parser.add_argument("--seed", type=int, default=1, help="of the campaigns")
    return parser.parse_args()


def paper(given: argparse.Namespace, work: Path) -> Path:
    """Return the campaign that was named, or the paper's, simulated if it is not there."""
    if given.campaign is not None:
        return given.campaign
    place = work / f"paper_seed_{given.seed}"
    if not (place / "runs.csv").exists():
        simulate(paper_campaign(seed=given.seed), place)
    return place


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as error:
        raise SystemExit(
            f"speed: {' '.join(error.cmd)} ended with {error.returncode}:\n{error.output}"
        ) from None
