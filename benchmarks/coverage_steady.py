"""How often the 95 % intervals of fit-steady and fit-aging hold the truth, counted on simulated campaigns.

Run: python benchmarks/coverage_steady.py [campaigns]     (default 400; about 1 s per campaign with aging)

Prints, per design and parameter, the share of intervals that hold the truth, the share called identified and the median
width. Nominal is 95 %; with n campaigns one standard error of a share is sqrt(0.95 0.05 / n), 1.1 % at 400.
"""

from __future__ import annotations

import importlib.util
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from sealfit.config import Config
from sealfit.fit.aging import fit_series
from sealfit.fit.steady import fit_conditions

TRUTH = {"mu_s": 0.7, "mu_c": 0.45, "v_s": 6.0, "sigma_2": 0.03}
DAYS = (0, 1, 2, 4, 8, 12, 16)
STEADY_DESIGNS = {
    "8 speeds both ways, repeats only": {"noise": 0.01},
    "8 speeds both ways, set-up 2 %": {"noise": 0.01, "setup": 0.02},
    "6 speeds one way, repeats only": {"noise": 0.01, "speeds": (0.5, 2, 5, 10, 25, 60), "ways": (1,)},
    "6 speeds one way, set-up 1 %": {"noise": 0.01, "setup": 0.01, "speeds": (0.5, 2, 5, 10, 25, 60), "ways": (1,)},
    "6 speeds one way, no repeats": {"noise": 0.01, "speeds": (0.5, 2, 5, 10, 25, 60), "ways": (1,), "repeats": 1},
    "8 speeds one way, no repeats, noise the same at every force": {
        "noise": 0.0,
        "constant": 0.3,
        "ways": (1,),
        "repeats": 1,
    },
    "5 speeds one way, noisy": {"noise": 0.04, "speeds": (1, 3, 8, 20, 60), "ways": (1,)},
}
AGING_DESIGNS = {
    "1 series, repeats only": {"noise": 0.005},
    "1 series, specimens 2 %": {"noise": 0.005, "specimen": 0.02},
    "3 series, specimens 2 %": {"noise": 0.005, "specimen": 0.02, "series": ((40.0, 80.0), (60.0, 80.0), (80.0, 80.0))},
}


def simulated():
    """The simulator of the tests and its truth."""
    path = Path(__file__).parents[1] / "tests" / "fit" / "conftest.py"
    spec = importlib.util.spec_from_file_location("simulated", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Count:
    """Hits, identified and widths of one parameter."""

    def __init__(self):
        self.hit, self.identified, self.widths = [], [], []

    def add(self, row, truth):
        low = -np.inf if np.isnan(row.lo95) else row.lo95
        high = np.inf if np.isnan(row.hi95) else row.hi95
        self.identified.append(bool(row.identified))
        if not np.isnan(row.value):
            self.hit.append(low <= truth <= high)
            self.widths.append(high - low)

    def line(self):
        hit = 100 * np.mean(self.hit) if self.hit else np.nan
        known, width = 100 * np.mean(self.identified), np.median(self.widths)
        return f"{hit:6.1f} %  {known:6.1f} %  {width:10.4g}  n = {len(self.hit)}"


def report(design, counts):
    print(f"\n{design}\n{'':14}covered   identified     width")
    for name, count in counts.items():
        print(f"  {name:12}{count.line()}")


def main(campaigns: int) -> None:
    module = simulated()
    for design, settings in STEADY_DESIGNS.items():
        counts = defaultdict(Count)
        for seed in range(campaigns):
            table = module.steady_rows(seed=seed, days=(0, 1, 2), model=TRUTH, **settings)
            fits = fit_conditions(table, Config())
            rows = fits[(fits.quantity == "steady") & (fits.condition == "unaged")]
            for row in rows.itertuples():
                counts[row.parameter].add(row, TRUTH[row.parameter])
        report(f"fit-steady: {design}", counts)
    for design, settings in AGING_DESIGNS.items():
        counts = defaultdict(Count)
        for seed in range(max(campaigns // 4, 1)):
            table = module.steady_rows(seed=seed, days=DAYS, speeds=(0.5, 2, 5, 12, 60), ways=(1,), **settings)
            fit = fit_series(fit_conditions(table, Config()), Config())
            for quantity, law in (("mu_s", module.MU_S), ("mu_c", module.MU_C)):
                truth = law | {"c": -law["a"] * np.log(law["b"])}
                for row in fit[fit.quantity == quantity].itertuples():
                    counts[f"{quantity} {row.parameter}"].add(row, truth[row.parameter])
        report(f"fit-aging: {design}", counts)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400)
