"""Draw a whole world from a seed: rig, campaign, friction, noise, scatter, columns and effects."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from worlds.effects import FAMILIES, WIDE, Effect, change, smooth_random
from worlds.law import quasi_steady_N
from worlds.priors import draw

LEAST_SAMPLES = 60  # of the fastest stroke: nobody logs a test with fewer
MOST_TOTAL = {"small": 250_000, "any": 4_000_000}  # samples of a world, so that it is quick
FASTEST = 500.0  # mm/s: no rig for seals slides faster
PLACES = 12  # along a stroke, where effects are scaled
TEMPERATURES = (23.0, 40.0, 60.0, 70.0, 80.0, 100.0)
COMPRESSIONS = (100.0, 90.0, 80.0, 70.0)
DAYS = (0.5, 1.0, 2.0, 3.0, 4.0, 7.0, 8.0, 12.0, 14.0, 16.0, 21.0, 28.0, 42.0, 56.0)
LEVELS = ("repeat", "run", "specimen")
KINDS = ("gain", "level", "slope", "v_s", "sigma_2")


@dataclass
class World:
    """Everything drawn. `files` has a row per file; names that begin with _ are scatter no column shows."""

    seed_text: str
    index: int
    size: str
    rig: dict
    speeds_mm_s: np.ndarray
    days: np.ndarray  # tested, 0 for unaged rubber; empty where nothing is aged
    loads_N: np.ndarray
    series: list[dict]
    files: pd.DataFrame
    columns: list[dict] = field(default_factory=list)
    noise: dict = field(default_factory=dict)
    scatter: list[dict] = field(default_factory=list)
    ranges: dict = field(default_factory=dict)  # variable -> (low, high, logarithmic)
    effects: list[Effect] = field(default_factory=list)
    features: list[str] = field(default_factory=list)

    def streams(self, name: str) -> np.random.Generator:
        """Return the random numbers of one purpose: the draws of one do not move those of another."""
        return generator(self.seed_text, self.index, f"{self.size} {name}")


def generator(seed_text: str, index: int, name: str) -> np.random.Generator:
    """Return random numbers that depend on the seed text, the world's number and what they are for."""
    words = [int.from_bytes(hashlib.sha256(t.encode()).digest()[:8], "big") for t in (seed_text, name)]
    return np.random.default_rng(np.random.SeedSequence([*words, index]))


def draw_world(seed_text: str, index: int, size: str = "small") -> World:
    """Return world number `index` of a seed text; `size` is "small" or "any"."""
    rng = generator(seed_text, index, f"{size} design")
    design = _design(rng, size)
    world = World(seed_text, index, size, **design)
    _friction(world, world.streams("friction"))
    world.files = _calendar(world, world.streams("calendar"))
    _sampling(world, rng)
    _columns(world, world.streams("columns"))
    _ranges(world)
    _scatter_and_noise(world, world.streams("scatter"))
    _effects(world, world.streams("effects"))
    _features(world)
    return world


def _design(rng, size: str) -> dict:
    count = {
        "speeds": draw("speeds", rng), "days": draw("days", rng), "series": draw("series", rng),
        "loads": draw("loads", rng), "repeats": draw("repeats", rng), "specimens": draw("specimens", rng),
    }  # fmt: skip
    unaged, directions = draw("unaged", rng), draw("directions", rng)
    target = draw(f"files_{size}", rng)
    least = {"speeds": 3, "days": 1, "series": 1, "loads": 1, "repeats": 1, "specimens": 1}

    def files() -> int:
        conditions = count["series"] * max(count["days"], 1) + (unaged and count["days"] > 0)
        each = count["specimens"] * count["speeds"] * count["loads"] * count["repeats"]
        return conditions * each * (2 if directions == "separate" else 1)

    while files() > target:  # the more of something, the sooner it is cut
        excess = np.array([np.log(max(count[k], 1) / least[k]) for k in count])
        if not excess.any():
            break
        count[list(count)[int(rng.choice(excess.size, p=excess / excess.sum()))]] -= 1
    while files() < 8:
        count["repeats" if rng.random() < 0.5 else "speeds"] += 1
    stroke = draw("stroke_mm", rng)
    v_s, decades, place = draw("v_s_mm_s", rng), draw("decades", rng), draw("speed_place", rng)
    slowest = min(v_s * 10 ** (-decades * place), FASTEST / 10**decades)
    speeds = _sharp(np.geomspace(slowest, slowest * 10**decades, count["speeds"]), 3)
    days = np.sort(rng.choice(DAYS, count["days"], replace=False)) if count["days"] else np.empty(0)
    aged = days
    if count["days"] and unaged:
        days = np.r_[0.0, days]
    pairs = [(t, c) for t in TEMPERATURES for c in COMPRESSIONS]
    chosen = [pairs[k] for k in rng.permutation(len(pairs))[: count["series"]]]
    load = draw("load_N", rng)
    loads = np.sort(_sharp(load * np.linspace(1, 0.3, count["loads"]), 4))
    strokes = max(2, draw("strokes", rng)) if directions == "together" else 1
    one = -1 if rng.random() < 0.2 else 1
    rig = {
        "stroke_mm": stroke,
        "v_s_mm_s": v_s,
        "stroke_bristles": draw("stroke_bristles", rng),
        "start_mm": float(rng.uniform(-20, 20)),
        "start_scatter_mm": stroke * draw("start_scatter", rng),
        "start": draw("start", rng),
        "ramp_mm": stroke * draw("ramp_share", rng),
        "dwell_share": draw("dwell_share", rng) if strokes == 1 else 0.0,
        "directions": directions,
        "strokes": strokes,
        "position_noise_mm": stroke * draw("position_noise", rng),
        "position_step_mm": stroke * draw("position_step", rng),
        "speed_error": draw("speed_error", rng),
        "clock_error": draw("clock_error", rng) if draw("clock_drifts", rng) else 0.0,
        "calendar": draw("calendar", rng),
        "order": draw("order", rng),
        "load_column": count["loads"] > 1 or draw("load_column", rng),
        "specimen_column": count["specimens"] > 1 or draw("specimen_column", rng),
        "holes": draw("holes", rng),
    }
    rows = []
    conditions = [(k, day) for day in (aged if aged.size else [np.nan]) for k in range(len(chosen))]
    if days.size and days[0] == 0:
        conditions.insert(0, (len(chosen) if len(chosen) > 1 else 0, 0.0))
    both = {"one": (one,), "separate": (1, -1), "together": (1,)}[directions]
    for k, day in conditions:
        t, c = (23.0, 100.0) if day == 0 else chosen[k]
        name = "unaged" if day == 0 else f"{t:g}C_{c:g}pct" + ("" if np.isnan(day) else f"_{day:g}d")
        for piece in range(count["specimens"]):
            for load_N in loads:
                for speed in speeds:
                    for d in both:
                        run = f"{name}_s{piece + 1}_{load_N:g}N_{speed:g}{'n' if d < 0 else ''}"
                        for repeat in range(count["repeats"]):
                            rows.append(
                                (run, repeat + 1, f"{name}_s{piece + 1}", k, t, c, day, load_N, speed, d)
                            )
    names = ("run_id", "repeat", "specimen_id", "series", "temperature_C", "compression_ratio_pct",
             "aging_days", "load_N", "speed_mm_s", "direction")  # fmt: skip
    table = pd.DataFrame(rows, columns=names)
    if rig["holes"] and len(table) > 12:
        share = draw("holes_share", rng)
        runs = table["run_id"].unique()
        lost = set(runs[rng.random(runs.size) < share / 2])
        keep = ~table["run_id"].isin(lost).to_numpy() & (rng.random(len(table)) >= share / 2)
        table = table[keep].reset_index(drop=True) if keep.sum() >= 8 else table
    series = [{"temperature_C": t, "compression_ratio_pct": c} for t, c in chosen]
    if len(chosen) > 1 and days.size and days[0] == 0:
        series.append({"temperature_C": 23.0, "compression_ratio_pct": 100.0})
    return {
        "rig": rig,
        "speeds_mm_s": speeds,
        "days": days,
        "loads_N": loads,
        "series": series,
        "files": table,
    }


def _sharp(values: np.ndarray, digits: int) -> np.ndarray:
    """Return values rounded to so many digits, as people set them."""
    return np.array([float(f"{v:.{digits}g}") for v in values])


def _friction(world: World, rng) -> None:
    """Draw the declared coefficients of every series; mu_0 is common to all where rubber is aged."""
    aging = world.days.size > 0
    speeds = world.speeds_mm_s
    mu_c, over = draw("mu_c", rng), draw("mu_s_over_mu_c", rng)
    v_s = world.rig["v_s_mm_s"]
    load = float(world.loads_N.mean())
    sigma_2 = draw("viscous_share", rng) * mu_c * load / speeds[-1]
    spread = draw("series_spread", rng)
    last = world.days.max() if aging else 1.0
    loss, b = {e: draw("aging_loss", rng) for e in "sc"}, {e: draw("aging_b_days", rng) for e in "sc"}
    for own in world.series:
        r = {
            name: float(1 + spread * rng.uniform(-1, 1))
            for name in ("mu", "a_s", "a_c", "b_s", "b_c", "v", "s2")
        }
        scale = 1.0 if aging else r["mu"]
        own |= {
            "mu_0c": mu_c * scale,
            "mu_0s": mu_c * over * scale,
            "v_s": v_s * r["v"],
            "sigma_2": sigma_2 * r["s2"],
        }
        for end in "sc":
            own[f"b_{end}"] = b[end] * r[f"b_{end}"]
            lost = loss[end] * r[f"a_{end}"] * own[f"mu_0{end}"] if aging else 0.0
            own[f"a_{end}"] = lost / float(np.log1p(last / own[f"b_{end}"]))
    world.rig["sigma_0"] = mu_c * load * world.rig["stroke_bristles"] / world.rig["stroke_mm"]
    world.rig["sigma_1"] = world.rig["sigma_0"] * draw("sigma_1_over_sigma_0_s", rng)


def _calendar(world: World, rng) -> pd.DataFrame:
    """Return the files in the order of their tests, with their hours."""
    files, rig = world.files, world.rig
    if rig["order"] == "follows_rubber" and not world.days.size:
        rig["order"] = "blocked"
    runs = files["run_id"].unique()
    shuffled = dict(zip(rng.permutation(runs), range(runs.size), strict=True))
    condition = (
        files.groupby(["specimen_id"], sort=False).ngroup().map(dict(enumerate(rng.permutation(10_000))))
    )
    keys = {
        "blocked": [condition, files["run_id"].map(shuffled)],
        "shuffled": [files["run_id"].map(shuffled)],
        "by_speed": [files["speed_mm_s"], files["run_id"].map(shuffled)],
        "follows_rubber": [files["aging_days"].fillna(0.0), condition, files["run_id"].map(shuffled)],
    }[rig["order"]]
    passes = draw("passes", rng)
    rig["mounted_anew"] = files["repeat"].max() > 1 and draw("mounted_anew", world.streams("set-ups"))
    if rig["mounted_anew"]:
        days = [files["aging_days"].fillna(0.0)] if rig["order"] == "follows_rubber" else []
        keys = [*days, condition, files["repeat"], keys[-1]]
    elif passes and rig["order"] != "follows_rubber":
        keys = [files["repeat"], *keys]
    else:
        keys = [*keys, files["repeat"]]
    order = np.lexsort([np.asarray(k, dtype=float) for k in reversed(keys)])
    files = files.iloc[order].reset_index(drop=True)
    gaps = draw("minutes_per_file", rng) / 60 * np.exp(0.2 * rng.normal(size=len(files)))
    hours = np.cumsum(gaps) - gaps[0]
    if draw("nights", rng):  # ten hours of each day
        hours = hours % 10 + 24 * (hours // 10)
    if rig["order"] == "follows_rubber":
        days = files["aging_days"].fillna(0.0).to_numpy()
        start = 0.0
        for day in np.unique(days):
            here = days == day
            start = max(start, 24 * day)
            hours[here] = start + hours[here] - hours[here][0]
            start = hours[here].max() + 0.5
    files["elapsed_h"] = np.round(hours * 3600) / 3600
    files["run_order"] = np.arange(1.0, len(files) + 1)
    files["specimen_use"] = 1.0 + files.groupby("specimen_id").cumcount()
    files["start_mm"] = rig["start_mm"] + rig["start_scatter_mm"] * rng.normal(size=len(files))
    files["_speed_error"] = np.clip(rig["speed_error"] * rng.normal(size=len(files)), -0.02, 0.02)
    files["_clock_error"] = rig["clock_error"] * rng.normal(size=len(files))
    files["file"] = [f"traces/t{k + 1:04d}.csv" for k in range(len(files))]
    return files


def _sampling(world: World, rng) -> None:
    """Settle the sampling rate of each speed."""
    rig, stroke = world.rig, world.rig["stroke_mm"]
    fastest = stroke / world.speeds_mm_s[-1]
    rate = float(
        np.clip(
            draw("rate_Hz", rng), LEAST_SAMPLES / fastest, 1e4 if fastest > 0.006 else LEAST_SAMPLES / fastest
        )
    )
    share = MOST_TOTAL[world.size] / (len(world.files) * rig["strokes"])
    most = max(100, min(draw("samples_per_file", rng), int(share)))
    rig["rate_Hz"] = {f"{v:g}": float(min(rate, most * v / stroke)) for v in world.speeds_mm_s}


def _columns(world: World, rng) -> None:
    """Put columns into the log: idle, correlated with the design, and some that an effect may use."""
    files = world.files
    n, hours = len(files), files["elapsed_h"].to_numpy()
    pool = ["lab_temperature_C", "humidity_pct", "batch", "pressure_bar", "motor_current_A", "operator",
            "dust_mg", "oil_age_h", "oven_position"]  # fmt: skip
    for k in rng.permutation(len(pool))[: draw("idle_columns", rng) + int(rng.random() < 0.4)]:
        name = pool[k]
        column = {"name": name, "missing": 0.0}
        if name in ("lab_temperature_C", "humidity_pct"):
            mean, sd = (22.0, rng.uniform(0.4, 3.0)) if name[0] == "l" else (45.0, rng.uniform(2.0, 10.0))
            slow = _slow(hours, rng.uniform(4, 72), rng)
            files[name] = np.round(mean + sd * (slow + 0.5 * np.sin(2 * np.pi * hours / 24)), 1)
        elif name == "batch":
            pieces = files["specimen_id"].unique()
            labels = [f"B{j + 1}" for j in range(int(rng.integers(2, 5)))]
            if pieces.size < 2 * len(labels):
                continue
            files[name] = files["specimen_id"].map(
                dict(zip(pieces, rng.choice(labels, pieces.size), strict=True))
            )
        elif name == "pressure_bar":
            runs = files["run_id"].unique()
            files[name] = files["run_id"].map(
                dict(zip(runs, np.round(rng.uniform(1, 8, runs.size), 1), strict=True))
            )
        elif name == "motor_current_A":  # a column of the traces; its mean here
            column |= {"mean": 2.0, "sd": 0.2, "samples": float(np.exp(rng.uniform(0, 4)))}
        elif name == "operator":
            files[name] = rng.choice(["Ada", "Ben", "Cem"], n)
        elif name == "dust_mg":
            files[name] = np.round(np.exp(rng.normal(1.5, 0.4, n)), 2)
        elif name == "oil_age_h":  # correlated with the calendar
            files[name] = np.round(hours + np.ptp(hours) * 0.1 * rng.normal(size=n) + 50, 1)
        else:  # correlated with the condition
            files[name] = np.round(
                files["temperature_C"] / 20 + files["aging_days"].fillna(0) / 10 + rng.normal(size=n), 1
            )
        if name != "motor_current_A" and draw("missing", rng):
            column["missing"] = draw("missing_share", rng)
        world.columns.append(column)


def _slow(hours: np.ndarray, length_h: float, rng) -> np.ndarray:
    """Return an Ornstein-Uhlenbeck process at the hours of the tests, of unit variance."""
    values = np.empty(hours.size)
    values[0] = rng.normal()
    for k in range(1, hours.size):
        keep = np.exp(-(hours[k] - hours[k - 1]) / length_h)
        values[k] = keep * values[k - 1] + np.sqrt(1 - keep**2) * rng.normal()
    return values


def _ranges(world: World) -> None:
    """Settle what the variables of the world span: what smooth random effects may hang on."""
    rig, files = world.rig, world.files
    stroke, scatter = rig["stroke_mm"], 2 * rig["start_scatter_mm"]
    longest = stroke / files["speed_mm_s"].min()
    ranges = {
        "displacement_mm": (rig["start_mm"] - scatter, rig["start_mm"] + stroke + scatter),
        "distance_mm": (0.0, stroke),
        "time_s": (0.0, longest),
        "speed_mm_s": (float(world.speeds_mm_s[0]), float(world.speeds_mm_s[-1])),
    }
    if world.loads_N.size > 2:
        ranges["load_N"] = (float(world.loads_N[0]), float(world.loads_N[-1]))
    if world.days.size > 3:
        ranges["aging_days"] = (0.0, float(world.days[-1]))
    if rig["calendar"]:
        ranges["elapsed_h"] = (0.0, float(files["elapsed_h"].max()))
    if files["repeat"].max() > 2:
        ranges["repeat"] = (1.0, float(files["repeat"].max()))
    if rig["strokes"] > 2:
        ranges["stroke"] = (1.0, float(rig["strokes"]))
    for column in world.columns:
        name = column["name"]
        if name == "motor_current_A":
            ranges[name] = (1.4, 2.6)
        elif files[name].dtype.kind == "f" and np.ptp(files[name]) > 0:
            ranges[name] = (float(files[name].min()), float(files[name].max()))
    world.ranges = {k: (float(a), float(b), bool(a > 0 and b / a >= WIDE)) for k, (a, b) in ranges.items()}


def _scatter_and_noise(world: World, rng) -> None:
    """Draw scatter of repeats, runs and specimens in every kind, and the noise of the force channel."""
    files = world.files
    units = {"repeat": np.arange(len(files)), "run": pd.factorize(files["run_id"])[0],
             "set_up": files.groupby(["specimen_id", "repeat"]).ngroup().to_numpy(),
             "specimen": pd.factorize(files["specimen_id"])[0]}  # fmt: skip
    drawn = {kind: np.zeros(len(files)) for kind in KINDS}

    def scatters(level: str, kind: str, rng) -> None:
        sd = draw(f"scatter_{kind}", rng)
        world.scatter.append({"level": level, "kind": kind, "sd": sd})
        values = sd * rng.normal(size=units[level].max() + 1)[units[level]]
        drawn[kind] += values
        if level == "specimen":
            files[f"_specimen_{kind}"] = values

    for level in LEVELS:
        for kind in KINDS:
            if draw("scatter_gain_here" if kind == "gain" else "scatter_other_here", rng):
                scatters(level, kind, rng)
    if world.rig["mounted_anew"]:
        scatters("set_up", "gain", world.streams("scatter of set-ups"))
    world.noise = {
        "rel": draw("noise_rel", rng),
        "kind": draw("noise_kind", rng),
        "samples": draw("noise_samples", rng),
        "t_df": draw("noise_t_df", rng),
        "growth": draw("noise_growth", rng),
        "step_rel": draw("force_step", rng),
        "outlier_share": draw("outlier_share", rng) if draw("outliers", rng) else 0.0,
    }
    files["_wrong"] = False
    if world.noise["outlier_share"]:  # a file in fifty that went wrong, one at least
        wrong = rng.permutation(len(files))[: max(1, len(files) // 50)]
        files.loc[wrong, "_wrong"] = True
        drawn["gain"][wrong] += rng.choice([-1, 1], wrong.size) * rng.uniform(0.05, 0.2, wrong.size)
    for kind, values in drawn.items():
        files[f"_{kind}"] = np.clip(values, -0.5, None)
        files[f"_specimen_{kind}"] = files.get(f"_specimen_{kind}", 0.0)
    world.rig["mean_N"] = float(np.sqrt(np.mean(quasi_steady_N(world, scale_points(world)) ** 2)))


def scale_points(world: World) -> dict[str, np.ndarray]:
    """Return every channel at places along the strokes of every file: shape (files, places)."""
    files, rig = world.files, world.rig
    given = {name: np.asarray(files[name])[:, None] for name in files if not name.startswith("_")}
    given["aging_days"] = np.nan_to_num(given["aging_days"])
    along = (np.arange(PLACES) + 0.5) / PLACES
    distance = along[None, :] * rig["stroke_mm"]
    stroke = 1.0 + np.arange(PLACES)[None, :] % rig["strokes"]
    direction = given["direction"] * (-1.0) ** (stroke - 1)
    begin = given["start_mm"] + np.where(direction < 0, rig["stroke_mm"], 0.0)
    given |= {
        "distance_mm": distance + 0 * begin, "stroke": stroke + 0 * begin, "direction": direction,
        "displacement_mm": begin + direction * distance, "time_s": distance / given["speed_mm_s"],
    }  # fmt: skip
    for column in world.columns:
        if column["name"] == "motor_current_A":
            given[column["name"]] = (
                column["mean"] + column["sd"] * np.sin(7.0 * np.arange(PLACES))[None, :] + 0 * begin
            )
    return given


def _effects(world: World, rng) -> None:
    """Hide effects, each scaled to its drawn strength."""
    if draw("null", rng):
        return
    for _ in range(draw("effects", rng)):
        if draw("smooth_random", rng):
            effect = smooth_random(world, rng)
        else:
            possible = [made for made, here in FAMILIES.values() if here(world)]
            effect = possible[rng.integers(len(possible))](world, rng)
        if any(e.family == effect.family for e in world.effects):
            continue
        wanted = draw("strength_pct", rng)
        world.effects.append(effect)
        points = scale_points(world)
        world.effects[-1] = _scaled(world, effect, wanted, points)
    world.effects = [
        e for e in world.effects if e.strength_pct > 1e-3
    ]  # one outside its place changes nothing


def _scaled(world: World, effect: Effect, wanted_pct: float, points: dict) -> Effect:
    """Return an effect with the amplitude for its strength, within what keeps every quantity positive."""
    number = len(world.effects) - 1
    size = float(np.abs(change(effect, points)).max())
    if size == 0:
        return replace(effect, strength_pct=0.0)
    most = 0.6 / size
    if effect.acts_on == "mu" and effect.operation == "add":
        most *= min(s["mu_0c"] for s in world.series) * 0.5
    elif effect.operation == "add":
        most = np.inf
    bare = quasi_steady_N(world, points, without={number})

    def strength(amplitude: float) -> float:
        world.effects[number] = replace(effect, amplitude=effect.amplitude * amplitude)
        return (
            100 * float(np.sqrt(np.mean((quasi_steady_N(world, points) - bare) ** 2))) / world.rig["mean_N"]
        )

    amplitude = min(most, 1.0)
    for _ in range(4):  # nearly proportional
        now = strength(amplitude)
        if now == 0:
            return replace(effect, strength_pct=0.0)
        amplitude = min(most, amplitude * wanted_pct / now)
    return replace(effect, amplitude=effect.amplitude * amplitude, strength_pct=strength(amplitude))


def _features(world: World) -> None:
    """Name what the world is like, for the counts by feature."""
    rig, files, noise = world.rig, world.files, world.noise
    kinds = {(s["kind"]) for s in world.scatter}
    marks = {
        "small": len(files) < 40,
        "short strokes": rig["stroke_bristles"] < 12,
        "no repeats": files["repeat"].max() == 1,
        "coloured": noise["kind"] == "coloured",
        "heavy tails": noise["kind"] == "heavy",
        "quantised": noise["step_rel"] > 2 * noise["rel"],
        "noise grows": noise["growth"] != "none",
        "random slopes": "slope" in kinds,
        "random v_s": "v_s" in kinds,
        "random sigma_2": "sigma_2" in kinds,
        "outliers": noise["outlier_share"] > 0,
        "clock drifts": rig["clock_error"] > 0,
        "both ways": rig["directions"] != "one",
        "both ways in one file": rig["directions"] == "together",
        "several loads": world.loads_N.size > 1,
        "no load column": not rig["load_column"],
        "no aging": world.days.size == 0,
        "several series": files["series"].nunique() > 1,
        "holes": rig["holes"],
        "columns": bool(world.columns),
        "missing cells": any(c["missing"] for c in world.columns),
        "mounted anew": rig["mounted_anew"],
        "calendar": rig["calendar"],
        "follows rubber": rig["order"] == "follows_rubber" and rig["calendar"],
        "three or four speeds": world.speeds_mm_s.size < 5,
        "noisy position": rig["position_noise_mm"] > 5e-4 * rig["stroke_mm"],
        "one specimen a condition": files.groupby("specimen_id")["aging_days"].first().size
        == files.groupby(["temperature_C", "compression_ratio_pct", "aging_days"], dropna=False).ngroups,
    }
    world.features = [name for name, here in marks.items() if here]
