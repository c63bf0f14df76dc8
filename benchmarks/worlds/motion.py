"""Noise-free traces: the motion of the rig, and the bristles of Eqs. 1 to 7 integrated along it.

Within a step the speed is constant, so dz/dt = v - |v| z / g has the exact solution
z(t + h) = g s + (z(t) - g s) exp(-|v| h / g), s = sgn v. Steps are short enough for the ramps and for 400
steps a stroke. All files of one speed are integrated together; strokes of a file follow one another with the
bristles as they were left.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from worlds.law import parameters
from worlds.world import World

LEAST_STEPS = 400  # of a stroke
RAMP_STEPS = 20
MOST_STEPS = 2000  # of a stroke, unless it has more samples
REVERSED = -0.9  # deflection left by a move back, share of the steady one


@dataclass(frozen=True)
class Batch:
    """Files of one set speed: sample times, positions and noise-free force, all of shape (files, samples)."""

    files: np.ndarray  # (files,) rows of world.files
    channels: dict[str, np.ndarray]  # every channel at the samples
    plateau: np.ndarray  # whether the platform moves at its set speed
    force_N: np.ndarray
    speed_mm_s: np.ndarray  # true speed, signed


def batches(world: World, **more) -> list[Batch]:
    """Return the noise-free traces of a world, a batch per speed; `more` as in `integrate`."""
    return [integrate(world, group, **more) for group in groups(world)]


def groups(world: World, most: int = 400_000) -> list[np.ndarray]:
    """Return the rows of `world.files` by speed, in parts of so many samples at most."""
    found = []
    for speed, own in world.files.groupby("speed_mm_s", sort=True):
        samples = world.rig["rate_Hz"][f"{speed:g}"] * world.rig["stroke_mm"] / speed * world.rig["strokes"]
        parts = int(np.ceil(len(own) * samples / most))
        found += np.array_split(own.index.to_numpy(), parts)
    return found


def distance_mm(t: np.ndarray, speed: np.ndarray, world: World) -> np.ndarray:
    """Return the distance slid `t` seconds after a stroke's start: dwell, ramp up, set speed, ramp down."""
    stroke, dwell, ramp, moving = _times(speed, world)
    x = np.clip(t - dwell, 0.0, moving)
    acceleration = speed / ramp
    up = 0.5 * acceleration * np.minimum(x, ramp) ** 2
    level = speed * np.clip(x - ramp, 0.0, moving - 2 * ramp)
    down = np.clip(x - (moving - ramp), 0.0, ramp)
    return np.minimum(up + level + speed * down - 0.5 * acceleration * down**2, stroke)


def _times(speed, world: World):
    """Return stroke, dwell, ramp time and moving time at true speeds."""
    stroke = world.rig["stroke_mm"]
    fastest = world.speeds_mm_s[-1]
    acceleration = fastest**2 / (2 * world.rig["ramp_mm"])
    ramp = np.abs(speed) / acceleration
    return stroke, world.rig["dwell_share"] * stroke / np.abs(speed), ramp, stroke / np.abs(speed) + ramp


def integrate(
    world: World,
    rows: np.ndarray,
    *,
    without: Collection[int] = (),
    nudge: Mapping[str, float] | None = None,
    scattered: bool = False,
) -> Batch:
    """Return the noise-free traces of some files of one set speed.

    Parameters
    ----------
    world : World
        The world.
    rows : ndarray of int
        Rows of `world.files`.
    without : collection of int
        Numbers of effects left out.
    nudge : mapping of str to float, optional
        Relative changes of declared quantities, `sigma_0` among them.
    scattered : bool
        Whether repeats, runs and specimens scatter; otherwise the population's mean.
    """
    files, rig, nudge = world.files.iloc[rows], world.rig, dict(nudge or {})
    sigma_0 = rig["sigma_0"] * (1 + nudge.pop("sigma_0", 0.0))
    column = {name: files[name].to_numpy()[:, None] for name in files}
    column["aging_days"] = np.nan_to_num(column["aging_days"].astype(float))
    own = {k: column[f"_{k}"] if scattered else 0.0 for k in ("gain", "level", "slope", "v_s", "sigma_2")}
    speed = column["speed_mm_s"] * (1 + column["_speed_error"])  # (files, 1)
    dt = 1.0 / rig["rate_Hz"][f"{files['speed_mm_s'].iloc[0]:g}"]
    _, dwell, ramp, moving = _times(speed, world)
    count = int(np.ceil(float((dwell + moving).max()) / dt))
    sub = int(
        np.clip(
            np.ceil(max(LEAST_STEPS / count, RAMP_STEPS * dt / float(ramp.max()))),
            1,
            max(1, MOST_STEPS // count),
        )
    )
    fine = np.arange(count * sub + 1) * (dt / sub)
    middle = 0.5 * (fine[1:] + fine[:-1])
    z = None
    parts: dict[str, list] = {}
    for stroke in range(rig["strokes"]):
        direction = column["direction"] * (-1.0) ** stroke
        begin = column["start_mm"] + np.where(direction < 0, rig["stroke_mm"], 0.0)
        slid = distance_mm(fine[None, :], speed, world)
        v = np.diff(slid, axis=1) / (dt / sub)
        shared = {**{k: x for k, x in column.items() if not k.startswith("_")}, "direction": direction,
                  "stroke": np.full_like(begin, stroke + 1.0)}  # fmt: skip
        trace = trace_columns(world, rows, stroke, count)
        repeated = {k: np.repeat(x, sub, axis=1) for k, x in trace.items()}
        half = distance_mm(middle[None, :], speed, world)
        g = _deflection(world, shared | repeated, begin, half, middle, v, own, sigma_0, without, nudge)[0]
        if z is None:
            reestimated = g[:, -1:] * direction
            z = np.zeros_like(reestimated) if rig["start"] == "rest" else REVERSED * reestimated
        bent = _followed(z[:, 0], direction * g, v * (dt / sub) / g)[:, ::sub]
        z = bent[:, -1:]
        first = 0 if stroke == 0 else 1  # a stroke's first sample is the last one's last
        t = fine[::sub]
        at = distance_mm(t[None, :], speed, world)
        v_at = _speed(t[None, :], speed, world)
        padded = {k: np.concatenate([x[:, :1], x], axis=1) for k, x in trace.items()}
        g_at, p = _deflection(world, shared | padded, begin, at, t, v_at, own, sigma_0, without, nudge)
        rate = direction * v_at * (1 - direction * bent / g_at)
        along = 1 + own["gain"] + own["slope"] * (at / rig["stroke_mm"] - 0.5)
        friction = (sigma_0 * bent + rig["sigma_1"] * rate) + p["sigma_2"] * (
            1 + own["sigma_2"]
        ) * direction * v_at * along
        force = friction * p["factor"] + p["added_N"] + own["level"] * rig["mean_N"] * direction
        flat = (t >= dwell + ramp) & (t <= dwell + moving - ramp)
        found = {
            **{k: np.broadcast_to(shared[k], at.shape) for k in ("direction", "stroke")}, **padded,
            "distance_mm": at, "displacement_mm": begin + direction * at,
            "time_s": np.broadcast_to(t, at.shape),
            "_clock_s": np.broadcast_to(t + stroke * count * dt, at.shape),
            "_force": np.broadcast_to(force, at.shape), "_flat": flat, "_speed": direction * v_at,
        }  # fmt: skip
        for name, values in found.items():
            parts.setdefault(name, []).append(values[:, first:])
    joined = {k: np.concatenate(x, axis=1) for k, x in parts.items()}
    force, flat, true_speed = (joined.pop(k) for k in ("_force", "_flat", "_speed"))
    return Batch(np.asarray(rows), joined, flat, force, true_speed)


def _followed(z: np.ndarray, target: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the deflection at all steps' ends: from z (files,), targets and steps over g (files, steps)."""
    keep = np.ascontiguousarray(np.exp(-steps).T)
    pulled = np.ascontiguousarray((-np.expm1(-steps) * target).T)
    bent = np.empty((len(keep) + 1, z.size))
    bent[0] = z
    for k in range(len(keep)):
        bent[k + 1] = pulled[k] + keep[k] * bent[k]
    return bent.T


def _speed(t, speed, world: World) -> np.ndarray:
    _, dwell, ramp, moving = _times(speed, world)
    x = t - dwell
    return speed * np.clip(np.minimum(x, moving - x) / ramp, 0.0, 1.0)


def _deflection(world, shared, begin, distance, t, speed, own, sigma_0, without, nudge):
    """Return the settled deflection g and the law's numbers at places along a stroke: (files, places)."""
    given = {**shared, "distance_mm": distance, "displacement_mm": begin + shared["direction"] * distance,
             "time_s": np.broadcast_to(t, distance.shape), "speed_mm_s": speed}  # fmt: skip
    p = parameters(world, given, without=without, nudge=nudge)
    mu = p["mu_c"] + (p["mu_s"] - p["mu_c"]) * np.exp(-((speed / (p["v_s"] * (1 + own["v_s"]))) ** 2))
    along = 1 + own["gain"] + own["slope"] * (distance / world.rig["stroke_mm"] - 0.5)
    return np.maximum(mu * shared["load_N"] * along, 1e-9) / sigma_0, p


def trace_columns(world: World, rows: np.ndarray, stroke: int, count: int) -> dict[str, np.ndarray]:
    """Return the columns that the traces hold beside force and place, shape (files, samples)."""
    found = {}
    for column in world.columns:
        if column["name"] != "motor_current_A":
            continue
        values = np.empty((len(rows), count))
        for k, row in enumerate(rows):
            rng = world.streams(f"trace {row} {stroke}")
            values[k] = column["mean"] + column["sd"] * coloured(count, column["samples"], rng)
        found[column["name"]] = np.round(values, 4)
    return found


def coloured(count: int, length: float, rng: np.random.Generator) -> np.ndarray:
    """Return first-order autoregressive noise of unit variance with a correlation length in samples."""
    from scipy.signal import lfilter

    keep = float(np.exp(-1.0 / length))
    white = rng.normal(size=count)
    start = [keep * rng.normal()]
    return lfilter([np.sqrt(1 - keep**2)], [1.0, -keep], white, zi=start)[0]


def force_at(
    world: World, points: pd.DataFrame, *, without: Collection[int] = (), nudge=None, tested: bool = False
) -> np.ndarray:
    """Return the noise-free mean force at points, bristles settled where each stroke began: shape (points,).

    Each point is reached by sliding at its speed from its stroke's start; the force is integrated along the
    way, so what lags behind a place by a bristle length lags here, too. The rise from rest is left out. With
    `tested` the mean is that of the tested specimens of each condition, otherwise that of the population.
    """
    steps, nudge = LEAST_STEPS, dict(nudge or {})
    sigma_0 = world.rig["sigma_0"] * (1 + nudge.pop("sigma_0", 0.0))
    column = {name: points[name].to_numpy()[:, None] for name in points}
    direction = np.sign(column["speed_mm_s"])
    speed, distance = np.abs(column["speed_mm_s"]), column["distance_mm"]
    begin = column["displacement_mm"] - direction * distance
    dwell = column["time_s"] - distance / speed
    shared = {**{k: x for k, x in column.items() if not k.startswith("_")}, "direction": direction}
    own = {
        k: column[f"_specimen_{k}"] if tested else 0.0 for k in ("gain", "level", "slope", "v_s", "sigma_2")
    }
    places = distance * (np.arange(steps) + 0.5) / steps
    g, _ = _deflection(
        world, shared, begin, places, dwell + places / speed, speed + 0 * places, own, sigma_0, without, nudge
    )
    bent = _followed(g[:, 0], g, distance / steps / g)[:, -1]
    _, p = _deflection(world, shared, begin, distance, column["time_s"], speed, own, sigma_0, without, nudge)
    along = 1 + own["gain"] + own["slope"] * (distance / world.rig["stroke_mm"] - 0.5)
    friction = sigma_0 * bent[:, None] + p["sigma_2"] * (1 + own["sigma_2"]) * speed * along
    return (
        direction * friction * p["factor"] + p["added_N"] + direction * own["level"] * world.rig["mean_N"]
    )[:, 0]
