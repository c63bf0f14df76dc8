"""How the cost of `sealfit` grows with the number of files: a part of `speed.py`, which says how to run it.

Every campaign is written by `many_files.py` if it is not there. Measured are a first ingest (wall seconds a
file, peak of the tree's resident sets), the same again with nothing changed, again after three files more (a
new run of a condition that was there), and reading one condition of table `bins` beside reading all of it:
seconds and bytes, in a process of its own. With all steps also what each later step takes, on the tables
without the three files; with an effect in the files close-loop has something to find, and to find again in
every fold.

`conditions` measures fit-steady and fit-aging of tables with thousands of conditions, without files.
"""

from __future__ import annotations

import itertools
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from many_files import add_files, write_campaign
from process_tree import Watched, watched
from steady_tables import MU_C, MU_S, steady_rows

LATER_STEPS = ("fit-steady", "fit-aging", "fit-dynamic", "close-loop", "report")
TAKES_WORKERS = ("ingest", "close-loop")
# Designs of thousands of conditions: temperatures and compressions that are distinct, and their days.
DESIGNS = {
    "temperatures, one day each": ("temperature", (8,)),
    "temperatures, three days each": ("temperature", (2, 8, 32)),
    "compressions, six days each": ("compression", (1, 2, 4, 8, 16, 32)),
}
FIT = """
import sys
import pandas as pd
from sealfit.config import Config
steady, fit, step = pd.read_parquet(sys.argv[1]), sys.argv[2], sys.argv[3]
if step == "fit-steady":
    from sealfit.fit.steady import fit_conditions
    pd.to_pickle(fit_conditions(steady, Config()), fit)
else:
    from sealfit.fit.aging.all_series import joint_laws
    from sealfit.fit.aging import aging_curves, fit_series
    steady_fit = pd.read_pickle(fit)
    aging_curves(fit_series(steady_fit, Config()))
    joint_laws(steady, steady_fit, Config())
"""
READ = """
import io, json, sys, time
import pandas as pd
path, condition = sys.argv[1:]
empty = io.BytesIO()  # read once before the clock starts, so that everything is imported
pd.DataFrame({"condition": ["none"]}).to_parquet(empty)
pd.read_parquet(empty, filters=[("condition", "==", "none")])

def timed(**how):
    before, begun = taken(), time.perf_counter()
    rows = len(pd.read_parquet(path, **how))
    return rows, time.perf_counter() - begun, taken() - before

def taken():  # bytes asked of files so far, whether they came from the disk or from memory
    try:
        return int(next(line for line in open("/proc/self/io") if line.startswith("rchar")).split()[1])
    except OSError:
        return 0

print(json.dumps({"one condition": timed(filters=[("condition", "==", condition)]), "all": timed()}))
"""


def measure(
    files: int,
    *,
    rows: int,
    seed: int,
    workers: int,
    cores: Sequence[int],
    work: Path,
    steps: str,
    effect: str | None = None,
) -> float:
    """Measure one size and print its lines; seconds of the first ingest. The campaign stays in `work`."""
    name = f"files_{files}_rows_{rows}_seed_{seed}{f'_{effect}' if effect else ''}"
    campaign, out = work / name, work / "growth_out"
    if not (campaign / "runs.csv").exists():  # written last
        write_campaign(campaign, files, rows=rows, seed=seed, effect=effect)
    shutil.rmtree(out, ignore_errors=True)

    def sealfit(step: str, *words: str | Path) -> Watched:
        asked = ["--workers", str(workers)] if step in TAKES_WORKERS else []
        return watched([sys.executable, "-m", "sealfit", step, *words, *asked], cores=cores)

    print(f"\n{files:,} files of {rows} rows{f', {effect}' if effect else ''}")
    runs = (campaign / "runs.csv").read_bytes()
    first = sealfit("ingest", campaign, "--out", out)
    line("ingest", first, f"{1e3 * first.seconds / files:8.3f} ms a file")
    line("ingest, nothing changed", sealfit("ingest", campaign, "--out", out))
    if steps == "all":
        for step in LATER_STEPS:
            cost = sealfit(step, out)
            line(step, cost, f"{1e3 * cost.seconds / files:8.3f} ms a file")
    one_condition(out)
    added = add_files(campaign, rows=rows)
    try:
        line("ingest, 3 files more", sealfit("ingest", campaign, "--out", out))
    finally:  # the campaign is as it was, for the next time
        (campaign / "runs.csv").write_bytes(runs)
        for path in added:
            (campaign / path).unlink()
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    print(f"  {'OUT':28s}{size / 1e6:9.1f} MB, {size / files / 1e3:.2f} kB a file")
    shutil.rmtree(out)
    return first.seconds


def conditions(sizes: Sequence[int], *, seed: int, cores: Sequence[int], work: Path) -> None:
    """Measure fit-steady and fit-aging of tables with about so many conditions, of every design."""
    table, fit = work / "steady.parquet", work / "steady_fit.pickle"
    for (name, (varied, days)), size in itertools.product(DESIGNS.items(), sizes):
        rows = many_conditions(varied, days, size, seed=seed)
        rows.to_parquet(table)
        print(f"\n{rows['condition'].nunique():,} conditions: {name}")
        for step in ("fit-steady", "fit-aging"):
            line(step, watched([sys.executable, "-c", FIT, table, fit, step], cores=cores))


def many_conditions(varied: str, days: Sequence[float], size: int, *, seed: int = 1):
    """Return table `steady` of unaged rubber and about `size` conditions: eight speeds, two repeats each.

    Aging is faster the hotter and the more compressed the rubber is. Specimens scatter by 0.5 %.
    """
    count = max(size // len(days), 1)
    if varied == "temperature":
        series = [(float(t), 80.0) for t in np.linspace(20.0, 90.0, count)]
    else:
        series = [(60.0, float(c)) for c in np.linspace(70.0, 95.0, count)]
    faster = {(t, c): 2.0 ** ((t - 60.0) / 40.0) * (1.0 + 0.005 * (80.0 - c)) for t, c in series}
    laws = {at: tuple({**law, "b": law["b"] / k} for law in (MU_S, MU_C)) for at, k in faster.items()}
    how = {"repeats": 2, "ways": (1,), "specimen": 0.005, "seed": seed}
    return steady_rows(days=(0, *days), series=series, laws=laws, **how)


def each_further_file(seconds: Sequence[tuple[int, float]]) -> None:
    """Print what a further file costs between the sizes: seconds a file without what every start costs."""
    for (few, before), (many, after) in itertools.pairwise(sorted(seconds)):
        print(
            f"  from {few:,} to {many:,} files: {1e3 * (after - before) / (many - few):.3f} ms a further file"
        )


def line(what: str, cost: Watched, more: str = "") -> None:
    """Print what one command cost."""
    print(
        f"  {what:28s}{cost.seconds:9.2f} s wall {cost.cpu_seconds:9.2f} s of cores "
        f"{cost.resident / 1e6:7.0f} MB in all, {cost.largest / 1e6:5.0f} MB the largest process {more}",
        flush=True,
    )


def one_condition(out: Path) -> None:
    """Print what reading one condition of `bins` costs beside reading all of it."""
    import pandas as pd

    path = next((out / name for name in ("bins", "bins.parquet") if (out / name).exists()), None)
    if path is None:
        print("  no table bins")
        return
    condition = pd.read_parquet(path, columns=["condition"])["condition"].astype(str)
    chosen = condition.iloc[len(condition) // 2]
    found = json.loads(watched([sys.executable, "-c", READ, path, chosen], look=False).output)
    for name, (rows, seconds, taken) in found.items():
        print(f"  {f'read {name} of bins':28s}{seconds:9.3f} s, {taken / 1e6:.2f} MB, {rows:,} rows")
