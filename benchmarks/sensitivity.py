"""Count whether effects of the size that `sensitivity` states are found with 80 % chance.

    python benchmarks/sensitivity.py --out out/sensitivity.jsonl --first 0 --count 40
    python benchmarks/sensitivity.py --out out/sensitivity.jsonl --summary
    python benchmarks/sensitivity.py --out out/files.jsonl --files

Each number draws a rig at random: design, noise, and scatter at every level. Of a campaign in which nothing
is missing the stated sizes are read, for up to three entries of different levels. Each is then put into the
same design with fresh noise and scatter: linear in the entry's variable at the entry's level, on the entry's
quantity, of the stated RMS; an offset for the direction. Found: an effect of that variable was added. Same:
one of another variable that these data cannot tell from it. With --files the campaign is made as much larger
as `files_needed` says, by more specimens, and the effect is 1 % of the force. Bins are drawn directly, and
the loop runs without its last held-out folds.

A number that OUT holds already is not run again. The summary gives shares with 95 % Clopper-Pearson bounds.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
from counts import bounds

from sealfit.closure.channels import scaled
from sealfit.closure.confirm import Context
from sealfit.closure.ripple_selection import numbered, steady_samples
from sealfit.closure.score_test import project
from sealfit.closure.selection import Selection, select_effects
from sealfit.closure.sensitivity import sensitivity
from sealfit.closure.subsampling import merged_bins
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.fit.joint.rows import make_rows

# Correlation after projection from which two effects count as one.
ALIKE = 0.9
# Largest stated size, in percent, that is tried. Larger effects are not linear.
LARGEST_PCT = 30.0
# Number of entries of a design.
ENTRIES = 3
# Number of bins of a stroke.
BINS = 6
MOST_FILES = 200
CONFIG = Config()
GROUPS = {
    "stroke": ["file", "stroke"],
    "repeat": ["file"],
    "run": ["run_id", "specimen_id"],
    "condition": ["specimen_id"],
}


def draw_design(number: int) -> dict:
    """Return the facts of a rig drawn at random."""
    rng = np.random.default_rng([number, 1])
    while (design := _drawn(rng)) and files_of(design) > MOST_FILES:
        pass
    return design


def files_of(design: dict) -> int:
    """Return how many files a design has."""
    lists = ("speeds", "directions")
    conditions = 1 + len(design["temperatures"]) * len(design["days"])
    return (
        conditions * design["specimens"] * design["repeats"] * int(np.prod([len(design[n]) for n in lists]))
    )


def _drawn(rng: np.random.Generator) -> dict:
    scatter = {
        name: float(rng.choice([0, 1]) * 10 ** rng.uniform(-3, -1.7))
        for name in ("stroke", "run", "condition")
    }
    return {
        "temperatures": [60.0, 80.0][: rng.integers(1, 3)],
        "days": [1.0, 4.0, 16.0, 32.0, 64.0][: rng.integers(1, 6)],
        "specimens": int(rng.choice([1, 1, 2, 3])),
        "speeds": np.geomspace(100, 1, rng.choice([1, 4, 5, 6])).round(2).tolist(),
        "directions": [1, -1][: rng.integers(1, 3)],
        "repeats": int(rng.integers(1, 4)),
        "strokes": int(rng.choice([1, 1, 3])),
        "shuffled": bool(rng.integers(2)),
        "noise": float(10 ** rng.uniform(-3, -1.5)),
        "gain": {"repeat": float(10 ** rng.uniform(-3, -2)), **scatter},
        "tilt": float(rng.choice([0, 0, 1]) * 10 ** rng.uniform(-3, -2)),  # of runs, along the stroke
    }


def design_table(number: int, design: dict) -> pd.DataFrame:
    """Return a row per bin with every channel and no force."""
    rng = np.random.default_rng([number, 2])
    conditions = [(23.0, 100.0, 0.0), *((t, 80.0, d) for t in design["temperatures"] for d in design["days"])]
    runs = [
        (*condition, specimen, speed, sign)
        for condition in conditions
        for specimen in range(design["specimens"])
        for speed in design["speeds"]
        for sign in design["directions"]
    ]
    if design["shuffled"]:
        runs = [runs[k] for k in rng.permutation(len(runs))]
    names = ["temperature_C", "compression_ratio_pct", "aging_days", "piece", "speed_set_mm_s", "direction"]
    table = pd.DataFrame(runs, columns=names)
    table["series"] = np.where(
        table.aging_days > 0, table.temperature_C.map("temperature_C={:g}".format), "unaged"
    )
    table["condition"] = table.series + table.aging_days.map(", {:g}".format)
    table["specimen_id"] = table.condition + table.piece.map(" piece {}".format)
    table["run_id"] = table.specimen_id + (table.speed_set_mm_s * table.direction).map(" {:g}".format)
    table = table.assign(rubber="rubber", load_N=49.03, speed_mm_s=table.speed_set_mm_s * table.direction)
    table["oil_ppm"] = rng.normal(100, 10, len(table))
    table["operator"] = rng.choice(["A", "B", "C"][: rng.integers(2, 4)], len(table))
    table = table.drop(columns="piece").loc[table.index.repeat(design["repeats"])].reset_index(drop=True)
    table["repeat"] = table.groupby("run_id").cumcount() + 1
    order = np.arange(len(table), dtype=float)
    table = table.assign(
        file=[f"f{k:05d}.csv" for k in range(len(table))], run_order=order, elapsed_h=0.1 * order
    )
    table["humidity_pct"] = rng.normal(50, 5, len(table))
    table["chamber_C"] = 22 + rng.normal(0, 1, len(table))
    table = table.loc[table.index.repeat(design["strokes"])].reset_index(drop=True)
    table["stroke"] = table.groupby("file").cumcount() + 1
    table = table.loc[table.index.repeat(BINS)].reset_index(drop=True)
    table["bin"] = table.groupby(["file", "stroke"]).cumcount()
    distance = (table.bin + 0.5) * 40.0 / BINS
    displacement = np.where(table.direction > 0, distance, 40.0 - distance)
    table["chamber_C"] += rng.normal(0, 1, len(table))
    return table.assign(
        distance_mm=distance, displacement_mm=displacement, time_s=distance / table.speed_set_mm_s
    )


def friction(table: pd.DataFrame) -> np.ndarray:
    """Return the coefficient times load, with the sign of the motion."""
    days, speed = table["aging_days"], table["speed_set_mm_s"]
    mu_c, mu_s = 0.61 - 0.033 * np.log1p(days / 0.13), 0.93 - 0.0445 * np.log1p(days / 0.08)
    return (
        table["direction"] * table["load_N"] * (mu_c + (mu_s - mu_c) * np.exp(-((speed / 15) ** 2)))
    ).to_numpy()


def measured(table: pd.DataFrame, design: dict, effect: np.ndarray | float, seed: list[int]) -> pd.DataFrame:
    """Return bins with noise and scatter."""
    rng = np.random.default_rng(seed)
    factor = np.ones(len(table))
    for level in design["gain"]:
        code = table.groupby(GROUPS[level], sort=False).ngroup().to_numpy()
        factor += design["gain"][level] * rng.normal(size=code.max() + 1)[code]
    code = table.groupby("run_id", sort=False).ngroup().to_numpy()
    factor += (
        design["tilt"]
        * rng.normal(size=code.max() + 1)[code]
        * (table["displacement_mm"].to_numpy() - 20)
        / 20
    )
    force = (friction(table) + 0.02 * table["speed_mm_s"].to_numpy() + effect) * factor
    force += design["noise"] * 30 * rng.normal(size=len(table))
    return table.assign(force_N=force, force_sd_N=60 * design["noise"], n=20)


def effect_of(table: pd.DataFrame, entry: dict, several: bool) -> np.ndarray:
    """Return what an effect adds to the force: linear in the entry's variable, with the entry's RMS."""
    name = entry["variable"]
    values = np.abs(table[name]) if name == "speed_mm_s" else table[name]
    if name == "direction":
        shape = np.ones(len(table))
    elif values.dtype.kind in "iuf":
        shape = scaled(values.to_numpy(dtype=float))
        shape = shape - shape.mean()
        if several:
            shape = at_level(table, shape, entry["level"])
    else:
        shape = (values == sorted(values.unique())[1]).to_numpy(dtype=float)
    added = (
        shape * friction(table)
        if entry.get("acts_on", "mu" if name != "direction" else "force") == "mu"
        else shape
    )
    return added * entry["smallest_N"] / np.sqrt(np.mean(added**2))


def at_level(table: pd.DataFrame, shape: np.ndarray, level: str) -> np.ndarray:
    """Return the part of a variable varying at a level: group means less those of the next coarser groups."""
    levels = ["trace", *GROUPS]
    means = [
        shape,
        *(pd.Series(shape).groupby([table[c] for c in own]).transform("mean") for own in GROUPS.values()),
    ]
    k = levels.index(level)
    return np.asarray(means[k] - (means[k + 1] if k + 1 < len(levels) else 0.0))


def close(bins: pd.DataFrame) -> Selection:
    """Return the end of the loop."""
    rows = make_rows(merged_bins(numbered(bins), CONFIG.loop.seed), has_aging=True)
    traces = bins[["file", "stroke", "time_s", "displacement_mm", "force_N"]].assign(
        presliding_N=0.0, steady=True
    )
    return select_effects(rows, steady_samples(traces, rows), Context(CONFIG, EFFECTS))


def outcome(selection: Selection, entry: dict, effect: np.ndarray) -> str:
    """Return how an effect came out: found, same, shown (significant, in no model), other or none."""
    name = entry["variable"]
    for item in selection.added:
        if name in item.proposal.term.channels:
            return "found"
    true = project(selection.before, effect[:, None])[:, 0]
    for item in selection.added:
        alike = abs(true @ item.proposal.column) / np.linalg.norm(true) / np.linalg.norm(item.proposal.column)
        if alike > ALIKE or any(name in r.term.channels for r, _ in item.rivals):
            return "same"
    return (
        "shown"
        if selection.left or selection.inconclusive or selection.refused
        else "other"
        if selection.added
        else "none"
    )


def run(number: int, *, files: bool) -> list[dict]:
    """Return a record per entry that was tried; of a design without any, one that says so."""
    design = draw_design(number)
    table = design_table(number, design)
    null = close(measured(table, design, 0.0, [number, 3]))
    entries = sensitivity(null, CONFIG.loop.family_error)
    count = Counter(e["variable"] for e in entries)
    tried = [e for e in entries if e["smallest_N"] is not None and e["smallest_pct"] < LARGEST_PCT]
    rng = np.random.default_rng([number, 4])
    tried = [tried[k] for k in rng.permutation(len(tried))]
    facts = {"number": number, "files": int(table["file"].nunique()), "runs": int(table["run_id"].nunique()),
             "specimens": int(table["specimen_id"].nunique())}  # fmt: skip
    if files:
        tried = [e for e in tried if 1.5 <= e["files_needed"] / facts["files"] <= 6 and facts["files"] < 200]
    chosen = list({e["level"]: e for e in tried}.values())[:ENTRIES]
    records = []
    for k, entry in enumerate(chosen):
        if files:
            made = round(design["specimens"] * entry["files_needed"] / facts["files"])
            larger = design | {"specimens": made}
            own = design_table(number, larger)
            pct = np.sqrt(entry["files_needed"] / facts["files"] * design["specimens"] / made)
            entry = entry | {"smallest_N": entry["smallest_N"] / entry["smallest_pct"] * pct}
        else:
            own, larger = table, design
        effect = effect_of(own, entry, count[entry["variable"]] > 1)
        found = close(measured(own, larger, effect, [number, 5, k]))
        rows = found.before.rows
        at = effect[rows.order] if rows.force.size == effect.size else np.zeros(rows.force.size)
        records.append(
            {**facts, **entry, "outcome": outcome(found, entry, at), "null_claims": len(null.added)}
        )
    return records or [{**facts, "outcome": "no entry"}]


def summarise(records: list[dict]) -> None:
    """Print the shares found."""
    tried = [r for r in records if r["outcome"] != "no entry"]
    print(f"{len({r['number'] for r in records})} designs, {len(tried)} effects")
    for title, key in (("level", "level"), ("variable", "variable"), ("quantity", "acts_on")):
        for value in sorted({r.get(key, "-") for r in tried}):
            line(f"{title} {value}", [r["outcome"] for r in tried if r.get(key, "-") == value])
    for low, high in ((0, 30), (30, 1000)):
        line(f"{low} to {high} runs", [r["outcome"] for r in tried if low <= r["runs"] < high])
    line("all", [r["outcome"] for r in tried])


def line(title: str, outcomes: list[str]) -> None:
    counts = Counter(outcomes)
    found, of = counts["found"] + counts["same"], len(outcomes)
    low, high = bounds(found, of) if of else (0.0, 1.0)
    print(
        f"{title:32s} {found:4d} of {of:4d} {found / max(of, 1):5.0%} [{low:.0%}, {high:.0%}]  {dict(counts)}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/sensitivity.jsonl"))
    parser.add_argument("--first", type=int, default=0, help="number of the first design")
    parser.add_argument("--count", type=int, default=40, help="designs")
    parser.add_argument("--files", action="store_true", help="count `files_needed` instead")
    parser.add_argument("--summary", action="store_true", help="summarise what OUT holds, run nothing")
    given = parser.parse_args()
    records = [json.loads(text) for text in given.out.read_text().splitlines()] if given.out.exists() else []
    done = {r["number"] for r in records}
    given.out.parent.mkdir(parents=True, exist_ok=True)
    for number in () if given.summary else range(given.first, given.first + given.count):
        if number not in done:
            made = run(number, files=given.files)
            with given.out.open("a") as file:
                file.writelines(json.dumps(r) + "\n" for r in made)
            records += made
    summarise(records)


if __name__ == "__main__":
    main()
