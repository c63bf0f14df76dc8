"""Write a world as a campaign folder with its truth beside it, and draw new points inside what it tested."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd

from worlds.motion import Batch, batches, coloured
from worlds.world import KINDS, World

START = pd.Timestamp("2025-03-03T08:00:00")
POINTS = 200
CONDITION = ["temperature_C", "compression_ratio_pct", "aging_days"]
OWN = [f"_specimen_{kind}" for kind in KINDS]  # scatter of specimens
EDGE = 0.1  # share of the stroke at both ends where no point is asked for
WITHOUT_AGING = 'condition = ["temperature_C", "compression_ratio_pct"]\n'


def write_campaign(world: World, folder: Path) -> Path | None:
    """Write runs.csv, the traces and, where the default does not fit, a config; return its path or None."""
    (folder / "traces").mkdir(parents=True)
    runs_table(world).to_csv(folder / "runs.csv", index=False)
    for batch in batches(world, scattered=True):
        force = measured_N(world, batch)
        place = measured_mm(world, batch)
        clock = batch.channels["_clock_s"] * (
            1 + world.files["_clock_error"].to_numpy()[batch.files][:, None]
        )
        for k, row in enumerate(batch.files):
            table = {"time_s": clock[k], "displacement_mm": place[k], "force_N": force[k]}
            table |= {name: batch.channels[name][k] for name in trace_names(world)}
            text = pd.DataFrame(table).to_csv(index=False, float_format="%.8g")
            (folder / world.files["file"].iloc[row]).write_text(text, encoding="utf-8")
    if world.days.size:
        return None
    config = folder.with_name(folder.name + ".toml")
    config.write_text(WITHOUT_AGING, encoding="utf-8")
    return config


def trace_names(world: World) -> list[str]:
    """Names of the columns that stand in the traces."""
    return [c["name"] for c in world.columns if c["name"] not in world.files]


def runs_table(world: World) -> pd.DataFrame:
    """Return runs.csv as the laboratory wrote it: without what it did not log, with cells left empty."""
    rig, files = world.rig, world.files
    names = ["file", "run_id", "repeat", "temperature_C", "compression_ratio_pct", "speed_mm_s"]
    names += ["specimen_id"] * rig["specimen_column"] + ["aging_days"] * bool(world.days.size)
    names += ["load_N"] * rig["load_column"] + [c["name"] for c in world.columns if c["name"] in files]
    table = files[names].copy()
    if rig["calendar"]:
        hours = pd.to_timedelta(files["elapsed_h"] * 3600, unit="s").dt.round("s")
        table["started_at"] = (START + hours).dt.strftime("%Y-%m-%dT%H:%M:%S")
    rng = world.streams("missing")
    for column in world.columns:
        if column["missing"] and column["name"] in table:
            empty = rng.random(len(table)) < column["missing"]
            empty[int(rng.integers(len(table)))] = True
            table[column["name"]] = table[column["name"]].astype(object).mask(empty, None)
    return table


def measured_N(world: World, batch: Batch) -> np.ndarray:
    """Return the force as the sensor shows it: with noise, spikes and its resolution."""
    noise, mean = world.noise, world.rig["mean_N"]
    sd = noise_sd_N(world, batch.force_N, batch.speed_mm_s)
    force = np.empty_like(batch.force_N)
    for k, row in enumerate(batch.files):
        rng = world.streams(f"noise {row}")
        n = force.shape[1]
        if noise["kind"] == "coloured":
            unit = coloured(n, noise["samples"], rng)
        elif noise["kind"] == "heavy":
            unit = rng.standard_t(noise["t_df"], n) / np.sqrt(noise["t_df"] / (noise["t_df"] - 2))
        else:
            unit = rng.normal(size=n)
        spikes = (rng.random(n) < noise["outlier_share"]) * rng.normal(size=n) * 0.5 * mean
        force[k] = batch.force_N[k] + sd[k] * unit + spikes
    step = noise["step_rel"] * mean
    return np.round(force / step) * step


def noise_sd_N(world: World, force: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return the standard deviation of a sample's noise in N."""
    noise, mean = world.noise, world.rig["mean_N"]
    grown = {
        "none": 0.0,
        "force": 2 * np.abs(force) / mean,
        "speed": 3 * np.abs(speed) / world.speeds_mm_s[-1],
    }[noise["growth"]]
    return noise["rel"] * mean * (1 + grown) + 0 * force


def measured_mm(world: World, batch: Batch) -> np.ndarray:
    """Return the displacement as the rig logs it."""
    rig, exact = world.rig, batch.channels["displacement_mm"]
    noise = np.stack([world.streams(f"place {row}").normal(size=exact.shape[1]) for row in batch.files])
    step = rig["position_step_mm"]
    return np.round((exact + rig["position_noise_mm"] * noise) / step) * step


def truth_record(world: World) -> dict:
    """Return everything drawn, as JSON-able values."""
    record = {
        "seed_text": world.seed_text, "index": world.index, "size": world.size, "features": world.features,
        "rig": world.rig, "series": world.series, "noise": world.noise, "scatter": world.scatter,
        "columns": world.columns, "effects": [asdict(e) | {"place": e.place} for e in world.effects],
        "speeds_mm_s": world.speeds_mm_s.tolist(), "days": world.days.tolist(),
        "loads_N": world.loads_N.tolist(),
    }  # fmt: skip
    return json.loads(json.dumps(record, default=float))


def draw_points(world: World, count: int = POINTS) -> pd.DataFrame:
    """Return new points inside what was tested, with every channel, `series` too.

    Each starts from a file and a stroke of the campaign, so that condition, calendar and columns go together.
    Speed is drawn anew, log-uniform, and time goes with it; loads lie between the tested ones; a half of the
    aged points lies at days between the tested ones of a series with a law (three or more days) where tests
    do not follow the rubber.
    """
    rng, rig = world.streams("points"), world.rig
    table = world.files.iloc[rng.integers(len(world.files), size=count)].reset_index(drop=True)
    pieces = world.files.groupby([*CONDITION, "specimen_id"], dropna=False)[OWN].first()
    own = pieces.groupby(CONDITION, dropna=False).mean()  # what the tested specimens of a condition differ by
    table = table[[name for name in table if not name.startswith("_")]]
    table = table.merge(own.reset_index(), on=CONDITION, how="left")
    stroke = rng.integers(rig["strokes"], size=count)
    direction = table["direction"] * (-1.0) ** stroke
    keys = ["series", "direction"]  # points keep to the speeds tested there
    tested = world.files.groupby(keys)["speed_mm_s"].agg(["min", "max"])
    low, high = (
        tested[end].reindex(pd.MultiIndex.from_frame(table[keys])).to_numpy() for end in ("min", "max")
    )
    speed = np.exp(rng.uniform(np.log(low), np.log(high)))
    distance = rig["stroke_mm"] * rng.uniform(EDGE, 1 - EDGE, count)
    begin = table["start_mm"] + np.where(direction < 0, rig["stroke_mm"], 0.0)
    if world.loads_N.size > 1:
        table["load_N"] = rng.uniform(world.loads_N[0], world.loads_N[-1], count)
    if world.days.size >= 3 and not (rig["order"] == "follows_rubber" and rig["calendar"]):
        for number, own in world.files[world.files["aging_days"] > 0].groupby("series"):
            days = own["aging_days"].unique()
            here = (table["series"] == number) & (table["aging_days"] > 0) & (rng.random(count) < 0.5)
            if days.size >= 2 + (world.days[0] > 0):
                between = np.exp(rng.uniform(np.log(days.min()), np.log(days.max()), count))
                table["aging_days"] = np.where(here, np.round(between, 3), table["aging_days"])
                table.loc[here, OWN] = 0.0  # no specimen was tested there
    table = table.assign(
        speed_mm_s=direction * speed, direction=direction, stroke=stroke + 1.0, distance_mm=distance,
        displacement_mm=begin + direction * distance,
        time_s=(rig["dwell_share"] * rig["stroke_mm"] + distance) / speed,
    )  # fmt: skip
    for column in world.columns:
        if column["name"] not in table:
            table[column["name"]] = column["mean"] + column["sd"] * np.clip(rng.normal(size=count), -2, 2)
    return table.assign(aging_days=table["aging_days"].fillna(0.0))


def points_csv(world: World, points: pd.DataFrame) -> pd.DataFrame:
    """Return the points as `predict` reads them."""
    drop = ["file", "run_id", "specimen_id", "series", "start_mm", *OWN]
    drop += [] if world.days.size else ["aging_days"]
    drop += [] if world.rig["calendar"] else ["elapsed_h", "run_order", "specimen_use"]
    drop += [] if world.rig["load_column"] else ["load_N"]
    return points.drop(columns=drop)
