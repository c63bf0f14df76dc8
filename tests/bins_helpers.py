"""Bins of a small aging campaign, made straight from Eqs. 14 and 15, with scatter at every level."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

from sealfit.config import Config

LOAD_N = 49.03
TRUE = {
    "mu_s0": 0.93,
    "mu_c0": 0.61,
    "a_s": 0.0445,
    "b_s": 0.08,
    "a_c": 0.033,
    "b_c": 0.13,
    "v_s": 15.0,
    "sigma_2": 0.02,
}
SPEEDS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 100.0)
MANY_SPEEDS = (1.0, 2.0, 4.0, 7.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0, 60.0)


def make_bins(
    seed: int = 0,
    *,
    temperatures: Sequence[float] = (60.0, 80.0),
    days: Sequence[float] = (1.0, 4.0, 8.0, 16.0),
    speeds: Sequence[float] = SPEEDS,
    directions: Sequence[int] = (1,),
    repeats: int = 3,
    bins: int = 20,
    noise_N: float = 0.3,
    gain: float = 0.005,
    setup: float = 0.0,
    specimen: float = 0.0,
    autocorrelation: float = 0.0,
    effect: Callable[[pd.DataFrame, np.ndarray], np.ndarray] | None = None,
    run_channels: dict[str, Callable[[np.random.Generator], object]] | None = None,
) -> pd.DataFrame:
    """Return `bins` of a campaign; `effect(table, force)` returns the force with what nobody declared."""
    rng = np.random.default_rng(seed)
    conditions = [(23.0, 100.0, 0.0), *((t, 80.0, d) for t in temperatures for d in days)]
    files, forces, gains, waves = [], [], [], []
    for temperature, compression, day in conditions:
        piece = rng.normal(0, specimen)
        series = (
            "unaged" if day == 0 else f"temperature_C={temperature:g}, compression_ratio_pct={compression:g}"
        )
        condition = "unaged" if day == 0 else f"{series}, aging_days={day:g}"
        mu_s = TRUE["mu_s0"] - TRUE["a_s"] * np.log1p(day / TRUE["b_s"])
        mu_c = TRUE["mu_c0"] - TRUE["a_c"] * np.log1p(day / TRUE["b_c"])
        for speed in speeds:
            mu = mu_c + (mu_s - mu_c) * np.exp(-((speed / TRUE["v_s"]) ** 2))
            for sign in directions:
                set_up = rng.normal(0, setup)
                own = {name: draw(rng) for name, draw in (run_channels or {}).items()}
                for repeat in range(1, repeats + 1):
                    number = len(files) + 1
                    files.append(
                        {
                            "file": f"f{number:04d}.csv",
                            "run_id": f"{condition}|{sign * speed:g}",
                            "repeat": repeat,
                            "stroke": 1,
                            "direction": sign,
                            "specimen_id": condition,
                            "condition": condition,
                            "series": series,
                            "rubber": "rubber",
                            "speed_mm_s": sign * speed,
                            "speed_set_mm_s": speed,
                            "load_N": LOAD_N,
                            "run_order": float(number),
                            "elapsed_h": 0.1 * number,
                            "temperature_C": temperature,
                            "compression_ratio_pct": compression,
                            "aging_days": day,
                            **own,
                        }
                    )
                    forces.append(sign * (LOAD_N * mu + TRUE["sigma_2"] * speed))
                    waves.append(_wave(rng, bins, autocorrelation))
                    gains.append(1 + piece + set_up + rng.normal(0, gain))
    # One table for all files: a table for each would take most of the time of many tests.
    table = _along_strokes(pd.DataFrame(files), bins)
    force = np.repeat(forces, bins)
    if effect is not None:
        for first in range(0, len(table), bins):
            own = slice(first, first + bins)
            force[own] = effect(table.iloc[own], force[own])
    force = force * np.repeat(gains, bins) + noise_N * np.concatenate(waves)
    return table.assign(force_N=force, force_sd_N=2 * noise_N, rise_mm=0.0, n=20)


def _wave(rng: np.random.Generator, bins: int, autocorrelation: float) -> np.ndarray:
    """Return noise along a stroke, an autoregression of first order with variance 1."""
    wave = rng.normal(0, 1, bins)
    if autocorrelation:
        for k in range(1, bins):
            wave[k] = autocorrelation * wave[k - 1] + np.sqrt(1 - autocorrelation**2) * wave[k]
    return wave


def _along_strokes(files: pd.DataFrame, bins: int) -> pd.DataFrame:
    """Return a row per bin from one per file, with what changes along a stroke."""
    table = files.iloc[np.repeat(np.arange(len(files)), bins)].reset_index(drop=True)
    x = np.tile((np.arange(bins) + 0.5) * 40.0 / bins, len(files))
    table = table.assign(
        bin=np.tile(np.arange(bins), len(files)),
        displacement_mm=np.where(table["direction"] > 0, x, 40.0 - x),
        distance_mm=x,
        time_s=x / table["speed_set_mm_s"].to_numpy(),
    )
    names = list(files)
    return table[[*names[:9], "bin", *names[9:12], "displacement_mm", "distance_mm", "time_s", *names[12:]]]


# For tests of what is found: each fold is a search of its own. The search of one of two has half of the runs,
# and some effects need more.
TWO_FOLDS, THREE_FOLDS = (Config(loop={"folds": count}) for count in (2, 3))


def warm(table: pd.DataFrame, force: np.ndarray) -> np.ndarray:
    """Friction that falls by 5 % as it slides, with a time constant of 3 s: an `effect` of `make_bins`."""
    return force * (1 - 0.05 * (1 - np.exp(-table["time_s"].to_numpy() / 3)))


def mounted_anew(seed: int, sd: float = 0.01, **options) -> pd.DataFrame:
    """Return bins whose files of a specimen and repeat have a gain in common, in the order of mounts."""
    bins = make_bins(seed, temperatures=(60.0,), bins=4, **options)
    mount = bins["specimen_id"] + bins["repeat"].astype(str)
    bins["run_order"] = bins.groupby([mount, "file"], sort=True).ngroup() + 1.0
    bins["elapsed_h"] = 0.1 * bins["run_order"]
    number = bins.groupby(mount, sort=True).ngroup()
    gains = 1 + np.random.default_rng(seed + 1000).normal(0, sd, number.max() + 1)
    return bins.assign(force_N=bins["force_N"] * gains[number], mount=number + 1.0)


def with_another_curve() -> pd.DataFrame:
    """Return bins of two lots, A (aged at 60 degC) and B, of which A has a Stribeck exponent of 0.8."""

    def softer(table, force):
        ratio = np.abs(table["speed_mm_s"].to_numpy()) / TRUE["v_s"]
        change = 0.25 * LOAD_N * (np.exp(-(ratio**0.8)) - np.exp(-(ratio**2)))
        return force + np.where(table["temperature_C"] == 60.0, change, 0.0)

    bins = make_bins(
        bins=4, days=(1.0, 2.0, 4.0, 8.0, 16.0), speeds=np.geomspace(0.6, 60, 9), gain=0.002, effect=softer
    )
    bins["lot"] = np.where(bins["temperature_C"] == 60.0, "A", "B")
    return bins


def make_traces(bins: pd.DataFrame) -> pd.DataFrame:
    """Return the bins themselves as steady samples: what the ripple search sees."""
    return bins[["file", "stroke", "time_s", "displacement_mm", "force_N"]].assign(
        presliding_N=0.0, steady=True
    )
