"""Null campaigns with slow strokes of few bristle lengths: false claims and interval coverage of the loop.

    python benchmarks/short_strokes.py                                     all ratios, 4 seeds of every design
    python benchmarks/short_strokes.py --ratios 3 11 --seeds 2 --designs plain noisy

A campaign has unaged rubber and one series of four days, six speeds from 0.5 to 20 mm/s, and a LuGre bristle
of sigma_0 = 100 N/mm: its length G(v) / sigma_0 is 0.3 to 0.45 mm. Strokes at the three lowest speeds are
`ratio` lengths of the slowest bristle long, the others 40 mm. Nothing is missing: whatever the loop claims is
invented. The truth is integrated here, step by step of constant speed, independent of `sealfit simulate`.

One line per campaign: verdict, how many 95 % intervals hold the truth (mu_s and mu_c of fit-steady; `predict`
at every condition and speed), the error of `predict` before and after, and the effects claimed. Then the
counts.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from counts import bounds

from sealfit.closure.loop import close_loop
from sealfit.closure.predict import predict
from sealfit.config import Config
from sealfit.errors import SealfitError
from sealfit.fit.steady import fit_conditions
from sealfit.ingest.campaign import ingest_campaign

LOAD, SIGMA_0, SIGMA_2, V_S = 49.03, 100.0, 0.05, 5.0
# mu_0, a and b of Eq. 15.
LAW = {"mu_s": (0.93513, 0.04448, 0.0804), "mu_c": (0.609, 0.03307, 0.1324)}
DAYS = (0.0, 1.0, 4.0, 8.0, 16.0)
SPEEDS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
SHORT_SPEEDS, LONG_MM = 3, 40.0
RATIOS = (3.0, 6.0, 11.0, 30.0, 100.0, 300.0)
# Relative standard deviation of the friction between files.
REPEAT_SD = 0.007
# Integration steps per sample along a ramp.
STEPS = 16


@dataclass(frozen=True)
class Rig:
    """How a design is measured: sampling, noise of displacement samples, repeats, start and speed ramp."""

    sampling_Hz: float = 500.0
    displacement_sd_mm: float = 0.002
    repeats: int = 3
    reversed: bool = False  # the bristles start deflected the other way round, as after a stroke back
    ramp_s: float = 0.1
    lag: bool = False  # the speed comes up as by a first-order lag of ramp_s / 3
    force_sd_N: float = 0.1
    all_short: bool = False
    sag: float = (
        0.0  # share by which the speed is higher where cruising begins; half of it is left 3 mm further
    )


DESIGNS: Mapping[str, Rig] = {
    "plain": Rig(),
    "noisy": Rig(displacement_sd_mm=0.3),
    "coarse": Rig(sampling_Hz=20.0),
    "fine": Rig(sampling_Hz=2000.0),
    "single": Rig(repeats=1),
    "reversed": Rig(reversed=True),
    "slow_ramp": Rig(ramp_s=1.0),
    "lag": Rig(ramp_s=0.6, lag=True),
    "all_short": Rig(all_short=True),
    "sag": Rig(sag=0.06),
}


def mu_of(name: str, days: float) -> float:
    """Return the true mu_s or mu_c after so many days."""
    mu_0, a, b = LAW[name]
    return mu_0 - a * np.log1p(days / b)


def limit_N(speed: np.ndarray, days: float, gain: float) -> np.ndarray:
    """Return G(v), the bristles' force in steady sliding."""
    mu_s, mu_c = mu_of("mu_s", days), mu_of("mu_c", days)
    return gain * LOAD * (mu_c + (mu_s - mu_c) * np.exp(-((speed / V_S) ** 2)))


def trace(
    rig: Rig, speed: float, length: float, days: float, gain: float, random: np.random.Generator
) -> pd.DataFrame:
    """Return one file: rest, ramp, cruise, and a sudden stop after the last row."""
    rest = min(0.3, 0.1 * length / speed)
    ramp = min(rig.ramp_s, 0.3 * length / speed)
    total = rest + length / speed + ramp / 2
    step = max(1.0 / rig.sampling_Hz, total / 3000)
    fine = np.arange(int(total / step) * STEPS + 1) * (step / STEPS)
    since = np.maximum(fine - rest, 0.0)
    share = 1.0 - np.exp(-3.0 * since / ramp) if rig.lag else np.minimum(since / ramp, 1.0)
    share = share * (1.0 + rig.sag * 0.5 ** (since * speed / 3.0))
    middle = (share[1:] + share[:-1]) / 2 * speed
    slid = middle * (step / STEPS)
    level = limit_N(middle, days, gain)
    left = np.exp(-slid * SIGMA_0 / level)
    force = np.empty(fine.size)
    force[0] = -level[-1] if rig.reversed else 0.0
    now = force[0]
    for k, (keep, target) in enumerate(zip(left.tolist(), level.tolist(), strict=True)):
        now = target + (now - target) * keep
        force[k + 1] = now
    rows = slice(None, None, STEPS)
    place, pace = np.r_[0.0, np.cumsum(slid)][rows], (share * speed)[rows]
    total_N = force[rows] + SIGMA_2 * pace
    return pd.DataFrame(
        {
            "time_s": fine[rows],
            "displacement_mm": np.round(place + random.normal(0, rig.displacement_sd_mm, place.size), 5),
            "force_N": np.round(total_N + random.normal(0, rig.force_sd_N, place.size), 4),
        }
    )


def write(folder: Path, rig: Rig, ratio: float, seed: int) -> None:
    """Write one campaign."""
    random = np.random.default_rng([seed, int(ratio)])
    longest = limit_N(np.array(SPEEDS[0]), 0.0, 1.0) / SIGMA_0
    rows = []
    for days in DAYS:
        for k, speed in enumerate(SPEEDS):
            length = float(ratio * longest) if k < SHORT_SPEEDS or rig.all_short else LONG_MM
            for repeat in range(1, rig.repeats + 1):
                gain = random.normal(1.0, REPEAT_SD)
                name = f"d{days:g}_v{speed:g}_r{repeat}.csv"
                trace(rig, speed, length, days, gain, random).to_csv(folder / name, index=False)
                rows.append((name, f"d{days:g}_v{speed:g}", repeat, 60.0, 80.0, days, LOAD, speed))
    names = (
        "file",
        "run_id",
        "repeat",
        "temperature_C",
        "compression_ratio_pct",
        "aging_days",
        "load_N",
        "speed_mm_s",
    )
    pd.DataFrame(rows, columns=names).to_csv(folder / "runs.csv", index=False)


def one(rig: Rig, ratio: float, seed: int) -> dict:
    """Return what one campaign gives."""
    config = Config()
    with tempfile.TemporaryDirectory() as place:
        write(Path(place), rig, ratio, seed)
        tables = ingest_campaign(Path(place), config).tables
    closure = close_loop(tables["bins"], tables["traces"], config)
    held = {name: [] for name in LAW}
    steady = fit_conditions(tables["steady"], config)
    for row in steady[(steady["quantity"] == "steady") & steady["identified"].astype(bool)].itertuples():
        if row.parameter in LAW:
            held[row.parameter].append(row.lo95 <= mu_of(row.parameter, row.aging_days) <= row.hi95)
    asked = pd.DataFrame(list(product(DAYS, SPEEDS)), columns=["aging_days", "speed_mm_s"])
    asked = asked.assign(temperature_C=60.0, compression_ratio_pct=80.0, load_N=LOAD, repeat=1, stroke=1)
    answer = predict(closure.model, asked.assign(displacement_mm=20.0, distance_mm=20.0, time_s=20.0))
    truth = [
        limit_N(np.array(p.speed_mm_s), p.aging_days, 1.0) + SIGMA_2 * p.speed_mm_s
        for p in asked.itertuples()
    ]
    held["predict"] = list((answer["force_after_lo95_N"] <= truth) & (truth <= answer["force_after_hi95_N"]))
    document = closure.document
    return {
        "verdict": document["verdict"],
        "claims": [f"{e['id']}({','.join(e['channels'])})->{e['acts_on']}" for e in document["effects"]],
        "strokes": int(tables["steady"]["used"].sum()),
        "rms": [float(np.sqrt(np.mean((answer[f"force_{k}_N"] - truth) ** 2))) for k in ("before", "after")],
        "held": {name: np.array([sum(found), len(found)]) for name, found in held.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--ratios", type=float, nargs="*", default=RATIOS)
    parser.add_argument("--designs", nargs="*", default=list(DESIGNS), choices=list(DESIGNS))
    parser.add_argument("--seeds", type=int, default=4)
    given = parser.parse_args()
    total = invented = 0
    held = {name: np.zeros(2, int) for name in (*LAW, "predict")}
    for design, ratio, seed in product(given.designs, given.ratios, range(1, given.seeds + 1)):
        head = f"{design:10s} {ratio:4g} seed {seed}"
        try:
            found = one(DESIGNS[design], ratio, seed)
        except SealfitError as error:
            print(f"{head} {error.message}", flush=True)
            continue
        total += 1
        invented += bool(found["claims"]) or found["verdict"] == "unexplained"
        for name, pair in found["held"].items():
            held[name] += pair
        shares = " ".join(f"{name} {a}/{b}" for name, (a, b) in found["held"].items())
        before, after = found["rms"]
        claims = "; ".join(found["claims"]) or "-"
        print(
            f"{head} {found['verdict']:15s} {found['strokes']:3d} strokes {shares} "
            f"{before:.3f} -> {after:.3f} N  {claims}",
            flush=True,
        )
    low, high = bounds(invented, total)
    print(f"claimed or unexplained: {invented} of {total} [{low:.3f}, {high:.3f}]")
    print("; ".join(f"{name}: {a} of {b} intervals hold ({a / b:.1%})" for name, (a, b) in held.items() if b))


if __name__ == "__main__":
    main()
