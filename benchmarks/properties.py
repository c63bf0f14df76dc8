"""Coverage of aging laws of properties (`fit-aging --values`) and level of their lack of fit, by simulation.

    python benchmarks/properties.py [--count 400] [--seed 1]

Every table is drawn with its own law (two to four temperatures, four to seven days, Arrhenius), its own
number of specimens per condition, holes, and scatter. Batches: none, each batch at every condition, or one to
three batches of each condition's own. Printed are the share of 95 % intervals that hold the truth (mu_0, a, b
of each series where they are determined; E of the law for all series), the share of tests for lack of fit
with p < 0.05, and the same share where one condition deviates by five standard errors of its mean.
"""

from __future__ import annotations

import argparse
from collections import defaultdict

import numpy as np
import pandas as pd
from commit import build
from scipy.stats import beta

from sealfit.config import Config
from sealfit.fit.aging.property import fit_properties

BATCHES = ("none", "crossed", "nested")
KELVIN = 273.15
R = 8.314e-3  # kJ/(mol K)


def drawn(rng: np.random.Generator, batches: str, deviation: float = 0.0) -> tuple[pd.DataFrame, dict]:
    """Return table `property_values` of one draw, and the truth; `deviation` in standard errors of a mean."""
    celsius = np.sort(rng.choice([40.0, 50.0, 60.0, 70.0, 80.0, 90.0], rng.integers(2, 5), replace=False))
    days = np.sort(rng.choice([1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0], rng.integers(4, 7), replace=False))
    start, sd = 100.0, rng.uniform(0.5, 4.0)
    a, energy = rng.uniform(4.0, 12.0), rng.uniform(30.0, 100.0)
    middle = float(np.median(celsius))
    b_middle = days[0] * 10 ** rng.uniform(-0.5, 0.7)
    number, sd_batch = int(rng.integers(2, 8)), sd * rng.uniform(0.5, 2.0) if batches != "none" else 0.0
    crossed = rng.normal(0, sd_batch, int(rng.integers(2, 5)))
    off = (int(rng.integers(len(celsius))), int(rng.integers(1, len(days))))
    rows, truth = [], {"mu_0": start, "a": a, "E": energy, "b": {}}
    for i, t in enumerate(celsius):
        rate = np.exp(energy / R * (1 / (middle + KELVIN) - 1 / (t + KELVIN)))
        series = f"temperature_C={t:g}"
        truth["b"][series] = b_middle / rate
        for j, day in enumerate([0.0, *days] if i == 0 else days):
            if day > 0 and rng.random() < 0.1:
                continue
            mean = start - a * np.log1p(day * rate / b_middle)
            condition = "unaged" if day == 0 else f"{series}, aging_days={day:g}"
            count = max(1, number - int(rng.random() < 0.2))
            own = rng.normal(0, sd_batch, int(rng.integers(1, 4)))
            shift = deviation * sd / np.sqrt(count) if (i, j) == off else 0.0
            for k in range(count):
                name, extra = "", 0.0
                if batches == "crossed":
                    name, extra = f"b{k % crossed.size}", crossed[k % crossed.size]
                elif batches == "nested":
                    name, extra = f"{condition} {k % own.size}", own[k % own.size]
                rows.append(
                    {
                        "rubber": "rubber", "condition": condition,
                        "series": "unaged" if day == 0 else series,
                        "quantity": "strength", "unit": "N", "batch": name, "aging_days": day,
                        "temperature_C": t, "value": mean + extra + shift + rng.normal(0, sd),
                    }
                )  # fmt: skip
    return pd.DataFrame(rows), truth


def counted(count: int, seed: int) -> pd.DataFrame:
    """Return one row per kind of batches, with the shares and their numbers."""
    config, made = Config(), []
    for batches in BATCHES:
        hits: dict[str, list[bool]] = defaultdict(list)
        for number in range(count):
            rng = np.random.default_rng([seed, number, BATCHES.index(batches)])
            table, truth = drawn(rng, batches)
            tables = fit_properties(table, config)
            fit = tables["aging_fit"]
            for row in fit[fit["identified"] & fit["parameter"].isin(["mu_0", "a", "b"])].itertuples():
                true = truth["b"][row.series] if row.parameter == "b" else truth[row.parameter]
                hits[row.parameter].append(row.lo95 <= true <= row.hi95)
            hits["lack"] += list(fit[fit["parameter"].str.endswith("lack_of_fit_p")]["value"].dropna() < 0.05)
            laws = tables["aging_laws"]
            log = laws[(laws["law"] == "log") & (laws["way"] == "rate")]
            for row in log[log["parameter"] == "E"].itertuples():
                hits["E"].append(row.lo95 <= truth["E"] <= row.hi95)
            hits["lack, one law"] += list(log["lack_of_fit_p"].iloc[:1].dropna() < 0.05)
            off = fit_properties(drawn(np.random.default_rng([seed, number, 9]), batches, 5.0)[0], config)
            found = (
                off["aging_laws"].query("law == 'log' and way == 'rate'")["lack_of_fit_p"].iloc[:1].dropna()
            )
            hits["seen, one of 5 se"] += list(found < 0.05)
        made.append({"batches": batches, **{name: interval(own) for name, own in hits.items()}})
    return pd.DataFrame(made)


def interval(hits: list[bool]) -> str:
    """Return a share in percent with its Clopper-Pearson interval, which ignores that tables share a fit."""
    n, k = len(hits), int(np.sum(hits))
    low, high = beta.ppf(0.025, k, n - k + 1) if k else 0.0, beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
    return f"{100 * k / n:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print(f"{options.count} tables of each kind, seed {options.seed}, {build()}")
    print(counted(options.count, options.seed).T.to_string(header=False))
