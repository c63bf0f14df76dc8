"""Lower bound of the time to read a campaign: a loop of pyarrow.csv.read_csv over its files.

    python benchmarks/bare_read.py CAMPAIGN

Prints the seconds of the loop alone, without starting Python and importing pyarrow. Nothing is kept, checked
or written. The call is as it comes: on one core that took less time than with `use_threads=False`.
"""

from __future__ import annotations

import csv
import sys
import time
from pathlib import Path

import pyarrow.csv


def main(campaign: Path) -> None:
    with (campaign / "runs.csv").open(newline="", encoding="utf-8") as table:
        paths = [str(campaign / row["file"]) for row in csv.DictReader(table)]
    begun = time.perf_counter()
    for path in paths:
        pyarrow.csv.read_csv(path)
    print(time.perf_counter() - begun)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
