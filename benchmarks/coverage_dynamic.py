"""How often the 95 % intervals of fit-dynamic, of the joint law and of lifetime hold the truth, on simulated campaigns.

    python benchmarks/coverage_dynamic.py [campaigns] [--seed N]     (default 100; about 3 s a campaign)

Prints, per design and number, the share of intervals that hold the truth with its standard error (campaigns as
clusters), the share called identified, the median half-width relative to the truth, and how many campaigns are given
a break-away peak where there is none.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from sealfit.config import load_config
from sealfit.fit.aged import Aged
from sealfit.fit.dynamic import fit_dynamic
from sealfit.fit.joint_law import fit_joint_law
from sealfit.fit.lifetime import Goal, lifetime
from sealfit.fit.steady import fit_conditions
from sealfit.ingest.campaign import ingest_campaign
from sealfit.physics.losses import LOSSES
from sealfit.simulate import Spec, simulate

BRISTLES = {"sigma_0": 100.0, "sigma_1": 0.5}
RIG = (
    {"kind": "white", "sd_N": 0.1},
    {"kind": "repeat_gain", "sd_rel": 0.005},
    {"kind": "run_setup", "sd_rel": 0.005},
    {"kind": "displacement", "sd_mm": 0.002},
)
ONE = {"days": (), "temperatures_C": (), "compressions_pct": ()}
DYNAMIC_DESIGNS = {
    "8 speeds one way": {},
    "6 speeds both ways, 4 strokes a file": {
        "directions": (1, -1), "strokes_per_file": 4, "max_rows": 4000, "speeds_mm_s": (0.5, 2.0, 4.0, 8.0, 20.0, 40.0),
    },
    "6 speeds one way": {"speeds_mm_s": (0.5, 2.0, 5.0, 10.0, 25.0, 50.0)},
}  # fmt: skip
FLAT = {"mu_s": {"mu_0": 0.6}, "mu_c": {"mu_0": 0.6}, "sigma_2": 0.0, "sigma_0": 100.0}
GAS_CONSTANT = 8.314462618e-3
LAW = {"mu_0": 0.93, "a": 0.05, "b": 0.1, "E": 80.0, "kappa": 0.02}
LAW_DESIGNS = {
    "3 temperatures, 2 compressions, 6 days": ((40.0, 60.0, 80.0), (80.0, 90.0), (1.0, 2.0, 4.0, 8.0, 12.0, 16.0)),
    "2 temperatures, 2 compressions, 4 days": ((60.0, 80.0), (80.0, 90.0), (1.0, 4.0, 8.0, 16.0)),
}


class Counts:
    """Whether intervals held the truth, whether they were called identified, and half their relative widths."""

    def __init__(self) -> None:
        self.found: dict[str, list[tuple[bool, bool, float]]] = defaultdict(list)

    def add(self, name: str, truth: float, low: float, high: float, known: bool = True) -> None:
        """Count one interval."""
        self.found[name].append((low <= truth <= high, known, (high - low) / 2 / truth))

    def print(self, title: str) -> None:
        """Print a line for each number."""
        for name, entries in self.found.items():
            held, known, width = np.array(entries, float).T
            error = np.sqrt(held.mean() * (1 - held.mean()) / held.size)
            print(
                f"{title:40s} {name:9s} {100 * held.mean():5.1f} % +- {100 * error:.1f}"
                f"   identified {100 * known.mean():5.1f} %   half-width {100 * np.median(width):.2g} %"
            )


def dynamic(design: dict, physics: dict, seed: int):
    """Return `dynamic_fit` of a simulated campaign of one condition."""
    config = load_config()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "campaign"
        simulate(Spec(seed=seed, physics=physics, design={**ONE, **design}, noise=RIG), place)
        tables = ingest_campaign(place, config, workers=1).tables
    return fit_dynamic(tables["traces"], tables["steady"], fit_conditions(tables["steady"], config), config).fit


def aged(design: tuple, seed: int) -> Aged:
    """Return values of one quantity under the log law, specimens scattering by 1 %."""
    temperatures, compressions, times = design
    rows = [(0.0, 23.0, 100.0), *((t, T, C) for T in temperatures for C in compressions for t in times)]
    days, celsius, percent = np.array(rows).T
    lost = LAW["a"] * LOSSES["log"].value(rate_at(design, celsius, percent) * days, LAW["b"])
    scatter = 1 + 0.01 * np.random.default_rng(seed).standard_normal(days.size)
    return Aged(days, (LAW["mu_0"] - lost) * scatter, celsius, percent, np.full(days.size, 1e-8))


def rate_at(design: tuple, celsius, percent):
    """Return k at some temperatures and compressions, 1 in the middle of those tested."""
    middle = np.median(design[0]) + 273.15
    exponent = LAW["E"] / GAS_CONSTANT * (1 / middle - 1 / (np.asarray(celsius) + 273.15))
    return np.exp(exponent + LAW["kappa"] * (np.median(design[1]) - np.asarray(percent)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaigns", nargs="?", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    seeds = range(given.seed, given.seed + given.campaigns)
    for title, design in DYNAMIC_DESIGNS.items():
        counts = Counts()
        for seed in seeds:
            fit = dynamic(design, BRISTLES, seed)
            for row in fit[fit["quantity"] == "dynamic"].itertuples():
                counts.add(row.parameter, BRISTLES[row.parameter], row.lo95, row.hi95, row.identified)
        counts.print(title)
    peaks = [(f["reason"] == "").any() for f in (peaks_of(dynamic({}, FLAT, seed)) for seed in seeds)]
    print(f"a break-away where there is none: {sum(peaks)} of {len(peaks)} campaigns")
    for title, design in LAW_DESIGNS.items():
        counts = Counts()
        days = LAW["b"] * np.expm1(0.23 / LAW["a"]) / float(rate_at(design, 50.0, 85.0))
        for seed in seeds:
            law = fit_joint_law(aged(design, seed), "log", "rate")
            for name, _, low, high, known in law.parameters():
                counts.add(name, LAW[name], low, high, known)
            life = lifetime(law, Goal(0.70), 50.0, 85.0)
            counts.add("lifetime", days, life.low, life.high)
        counts.print(title)


def peaks_of(fit):
    """Return the break-aways over the sliding force of a `dynamic_fit`."""
    return fit[fit["parameter"] == "F_ba/F"]


if __name__ == "__main__":
    main()
