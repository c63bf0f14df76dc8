"""Points new to the loop: tested conditions and days between, any speed in range, channels by their laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from sealfit.fit.joint import Fitted
from sealfit.fit.joint.model import evaluate
from sealfit.fit.joint.rows import Rows
from sealfit.simulation import Spec
from sealfit.simulation.noise import CategoryChannel, NumericChannel, SlowChannel

# Share of the aged points at days between the tested ones.
BETWEEN = 0.5


def draw_points(bins: pd.DataFrame, spec: Spec, count: int, rng: np.random.Generator) -> pd.DataFrame:
    """Return points to predict at, with every channel of `bins`.

    Each starts as a row of `bins`, so that position, distance and stroke go together. Then the speed is drawn
    anew, log-uniform in the tested range, and time stretched with it; for half of the aged points the days
    are drawn log-uniform between that series' first and last, and the calendar moved along where tests follow
    it; loads are drawn in their range, and the SPEC's channels by their laws, within what was tested.
    """
    table = bins.iloc[rng.integers(len(bins), size=count)].reset_index(drop=True)
    speed = np.abs(table["speed_mm_s"].to_numpy())
    tested = np.abs(bins["speed_mm_s"].to_numpy())
    new = np.exp(rng.uniform(np.log(tested.min()), np.log(tested.max()), count))
    table["time_s"] = (table["time_s"] * speed / new).clip(bins["time_s"].min(), bins["time_s"].max())
    table["speed_mm_s"] = new * np.sign(table["speed_mm_s"])
    if len(spec.design.loads_N) > 1:
        table["load_N"] = rng.uniform(min(spec.design.loads_N), max(spec.design.loads_N), count)
    table = _other_days(table, bins, spec, rng)
    for channel in spec.channels:
        match channel:
            case NumericChannel() | SlowChannel():
                values = rng.normal(channel.mean, channel.sd, count)
                table[channel.name] = values.clip(bins[channel.name].min(), bins[channel.name].max())
            case CategoryChannel() if channel.labels:
                table[channel.name] = rng.choice(
                    np.unique(bins[channel.name].astype(str)), count
                )  # those that were drawn
            case _:  # a formula of other columns: as some file had it
                table[channel.name] = bins[channel.name].to_numpy()[rng.integers(len(bins), size=count)]
    return table.drop(columns=["force_N", "force_sd_N", "n", "bin", "started_at"], errors="ignore")


def _other_days(
    table: pd.DataFrame, bins: pd.DataFrame, spec: Spec, rng: np.random.Generator
) -> pd.DataFrame:
    days = table["aging_days"].to_numpy(dtype=float)
    aged = bins[bins["aging_days"] > 0].groupby("series")["aging_days"].agg(["min", "max"])
    moved = (days > 0) & (rng.random(len(table)) < BETWEEN)
    low = table["series"].map(aged["min"]).to_numpy(dtype=float)
    high = table["series"].map(aged["max"]).to_numpy(dtype=float)
    drawn = np.round(
        np.exp(rng.uniform(np.log(np.where(moved, low, 1)), np.log(np.where(moved, high, 1)))), 3
    )
    new = np.where(moved, drawn, days)
    changed = {"aging_days": new}
    if spec.design.order == "calendar" and "elapsed_h" in table:
        elapsed = table["elapsed_h"].to_numpy() + 24.0 * (new - days)
        known = bins[["elapsed_h", "run_order"]].drop_duplicates().sort_values("elapsed_h")
        changed["elapsed_h"] = elapsed.clip(known["elapsed_h"].min(), known["elapsed_h"].max())
        changed["run_order"] = np.interp(changed["elapsed_h"], known["elapsed_h"], known["run_order"])
    return table.assign(**changed)


def force_at(fitted: Fitted, points: pd.DataFrame) -> np.ndarray:
    """Return a fitted joint model's mean force at points of tested series, shape (n,)."""
    rows: Rows = fitted.rows
    conditions = rows.conditions
    # Any condition of a series has its law, whatever the days; the unaged rubber is a series by itself.
    like = {series: k for k, series in enumerate(conditions["series"])}
    code = points["series"].map(like).to_numpy(dtype=int)
    at = replace(rows.points(points, code), days=points["aging_days"].to_numpy(dtype=float))
    plain = replace(fitted.model, terms=(), values=())
    at = replace(at, force=evaluate(plain, at, jacobian=False)[0])  # its lag
    return evaluate(fitted.model, at, jacobian=False)[0]
