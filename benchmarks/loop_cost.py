"""Measure the whole loop on some 600 files of 1,000 rows with 10 irrelevant columns: wall seconds and memory.

    python benchmarks/loop_cost.py [KIND] [--strength strong] [--seed 1] [--workers 2]

Runs `sealfit ingest`, the fits, and `sealfit close-loop`, which alone is timed. Memory is that of the process
tree, looked at every 0.2 s (`process_tree.py`): resident sets added up (pages that processes share count once
for each), and proportional sets where the system tells them (shared pages divided among them).
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from campaigns import campaign
from process_tree import watched

from sealfit.simulation import Spec, simulate

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
    return Spec.model_validate(
        spec.model_dump() | {"channels": [*spec.model_dump()["channels"], *NUMBERS, *OTHERS]}
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", nargs="?", default="three_at_once", metavar="KIND")
    parser.add_argument("--strength", default="strong")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    spec = with_idle_columns(
        campaign(given.kind, seed=given.seed, size="large", strength=given.strength, rows=1000),
    )
    sealfit = [sys.executable, "-m", "sealfit"]
    with tempfile.TemporaryDirectory() as folder:
        place, out = Path(folder) / "campaign", Path(folder) / "out"
        simulate(spec, place)
        files = len(list((place / "traces").iterdir()))
        workers = ["--workers", str(given.workers)]
        subprocess.run(
            [*sealfit, "ingest", str(place), "--out", str(out)], check=True, stdout=subprocess.DEVNULL
        )
        for step in ("fit-steady", "fit-aging", "fit-dynamic"):  # close-loop wants them to be there
            subprocess.run([*sealfit, step, str(out)], check=True, stdout=subprocess.DEVNULL)
        cost = watched([*sealfit, "close-loop", str(out), *workers], proportional=True, show_errors=True)
    print(
        f"{given.kind}, {given.strength}, {files} files, 10 idle columns, {given.workers} workers: "
        f"{cost.seconds:.0f} s, resident sets {cost.resident / 1e9:.2f} GB, "
        f"proportional sets {cost.proportional / 1e9:.2f} GB"
    )


if __name__ == "__main__":
    main()
