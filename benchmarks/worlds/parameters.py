"""Parameters and lifetimes of a world without effects: whether their 95 % intervals hold the truth.

Only without effects: what a hidden effect leaves of mu_0 or a depends on the reference state at which it is
taken out.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd

from worlds.world import World

LAW = ("mu_0", "a", "b")
# What an interval says that excludes the scatter of specimens, in aging_fit and in the notes of `predict`.
EXCLUDES_SCATTER = "the interval excludes the scatter between specimens"
HOLDS_FOR_TESTED = "intervals hold for the tested ones"
DAYS_FOR_LIFETIME = 4  # aged days; with fewer a law can hardly be told


def laws_inside(world: World, out: Path) -> dict[str, list[int]]:
    """Return for each parameter of Eq. 15 how many intervals hold the truth, and how many there are.

    Intervals that say that they exclude the scatter of specimens are not counted.
    """
    counts = {name: [0, 0] for name in LAW}
    steady = pd.read_parquet(out / "steady_fit.parquet")
    flat = steady[
        steady["parameter"].isin(("mu_s", "F_s")) & ~steady["identified"]
    ]  # mu_c is then no mu_c of Eq. 14
    table = pd.read_parquet(out / "aging_fit.parquet")
    table = table[table["identified"] & table["lo95"].notna() & table["parameter"].isin(LAW)]
    table = table[~table["reason"].fillna("").str.contains(EXCLUDES_SCATTER)]
    load = float(world.loads_N[0])
    for row in table.itertuples():
        end = {"mu_s": "s", "mu_c": "c", "F_s": "s", "F_c": "c"}.get(row.quantity)
        own = [s for s in aged_series(world) if s["temperature_C"] == row.temperature_C
               and s["compression_ratio_pct"] == row.compression_ratio_pct]  # fmt: skip
        if end is None or not own or (end == "c" and len(flat)):
            continue
        true = own[0][("mu_0" if row.parameter == "mu_0" else f"{row.parameter}_") + end]
        if row.quantity.startswith("F_") and row.parameter != "b":
            true *= load
        counts[row.parameter][0] += int(row.lo95 <= true <= row.hi95)
        counts[row.parameter][1] += 1
    return counts


def aged_series(world: World) -> list[dict]:
    """Return the series that hold aged rubber."""
    numbers = sorted(world.files.loc[world.files["aging_days"] > 0, "series"].unique())
    return [world.series[k] for k in numbers]


def lifetime_question(world: World) -> tuple[list[str], float] | None:
    """Return the arguments of `sealfit lifetime` and the true days, or None where too few days are tested."""
    days = world.days[world.days > 0]
    if days.size < DAYS_FOR_LIFETIME:
        return None
    own = aged_series(world)[0]
    true = float(np.sqrt(days[0] * days[-1]))
    threshold = own["mu_0s"] - own["a_s"] * np.log1p(true / own["b_s"])
    quantity = "mu_s"
    if not world.rig["load_column"]:
        quantity, threshold = "F_s", threshold * float(world.loads_N[0])
    words = ["--quantity", quantity, "--threshold", f"{threshold:.8g}", "--json"]
    if len(aged_series(world)) > 1:
        words += [
            "--temperature",
            f"{own['temperature_C']:g}",
            "--compression",
            f"{own['compression_ratio_pct']:g}",
        ]
    return words, true


def lifetime_answer(said: str, true: float) -> dict:
    """Return what `lifetime --json` said beside the true days."""
    answer = json.loads(said)
    low, high = answer.get("ci95") or (None, None)
    inside = None if low is None or high is None else bool(low <= true <= high)
    return {"true_d": true, "days": answer.get("days"), "ci95": [low, high], "inside": inside}
