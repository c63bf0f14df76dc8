"""A script for this campaign with pandas and scipy, as an engineer writes it, to compare with `sealfit run`.

    python benchmarks/pandas_script.py CAMPAIGN OUT [--resamples 200]

It takes some minutes for the paper's 1,752 files. For ingest and fits alone, and straightforward on purpose:
one loop over the files, one `curve_fit` per condition, 95 % intervals from refits to resampled repeats, one
`curve_fit` per aging series. It knows this campaign's layout, checks nothing, and writes CSV. The last line
it prints has the seconds of its parts as JSON.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import curve_fit

CONDITION = ["temperature_C", "compression_ratio_pct", "aging_days"]
PARAMETERS = ["mu_s", "mu_c", "v_s", "sigma_2"]
LAW = ["mu_0", "a", "b"]
# Distance in mm that is excluded after the start and before the stop: pre-sliding and ramps.
ENDS_MM = 2.0
# Number of points of a mean trace.
GRID = 200


def steady_friction(x, mu_s, mu_c, v_s, sigma_2):
    """Eq. 14: steady force at speed and load."""
    speed, load = x
    return load * (mu_c + (mu_s - mu_c) * np.exp(-((speed / v_s) ** 2))) + sigma_2 * speed


def aging(days, mu_0, a, b):
    """Eq. 15 with mu(0) = mu_0."""
    return mu_0 - a * np.log(1 + days / b)


def read_traces(campaign, runs):
    """Read every file; the mean force of its steady part, and the mean trace of every run's repeats."""
    forces, mean_traces = [], []
    for run_id, repeats in runs.groupby("run_id", sort=False):
        steady_parts = []
        for row in repeats.itertuples():
            trace = pd.read_csv(campaign / row.file)
            slid = (trace["displacement_mm"] - trace["displacement_mm"].iloc[0]).abs()
            steady = trace[(slid > ENDS_MM) & (slid < slid.max() - ENDS_MM)]
            forces.append((row.Index, steady["force_N"].mean()))
            steady_parts.append(steady)
        grid = np.linspace(
            max(steady["displacement_mm"].min() for steady in steady_parts),
            min(steady["displacement_mm"].max() for steady in steady_parts),
            GRID,
        )
        on_grid = np.array([np.interp(grid, s["displacement_mm"], s["force_N"]) for s in steady_parts])
        mean_traces.append(
            pd.DataFrame(
                {
                    "run_id": run_id,
                    "displacement_mm": grid,
                    "force_N": on_grid.mean(axis=0),
                    "force_sd_N": on_grid.std(axis=0, ddof=1) if len(on_grid) > 1 else np.nan,
                }
            )
        )
    runs = runs.assign(force_N=pd.Series(dict(forces)))
    return runs, pd.concat(mean_traces, ignore_index=True)


def fit_steady(table):
    """Fit Eq. 14 to the files of one condition."""
    speed, load, force = (table[name].to_numpy() for name in ("speed_mm_s", "load_N", "force_N"))
    mu = force / load
    start = [mu.max(), mu.min(), 5.0, 0.05]
    bounds = ([0, 0, 0.01, 0], [5, 5, 1000, 10])
    return curve_fit(steady_friction, (speed, load), force, p0=start, bounds=bounds)[0]


def resample_repeats(table, rng):
    """Draw the repeats of every run with replacement."""
    rows = table.groupby("run_id").indices.values()
    return table.iloc[np.concatenate([rng.choice(repeats, len(repeats)) for repeats in rows])]


def bootstrap(table, resamples, rng):
    """95 % limits of the four parameters, by refits to resampled repeats."""
    found = []
    for _ in range(resamples):
        try:
            found.append(fit_steady(resample_repeats(table, rng)))
        except RuntimeError:  # no convergence
            continue
    return np.percentile(found, [2.5, 97.5], axis=0)


def fit_conditions(runs):
    """Fit every condition; one row each."""
    rows = []
    for key, table in runs.groupby(CONDITION):
        rows.append(
            {
                **dict(zip(CONDITION, key, strict=True)),
                **dict(zip(PARAMETERS, fit_steady(table), strict=True)),
            }
        )
    return pd.DataFrame(rows)


def add_intervals(fits, runs, resamples, rng):
    """Add the limits of every condition's parameters."""
    limits = []
    for key, table in runs.groupby(CONDITION):
        low, high = bootstrap(table, resamples, rng)
        row = dict(zip(CONDITION, key, strict=True))
        for name, a, b in zip(PARAMETERS, low, high, strict=True):
            row[f"{name}_low"], row[f"{name}_high"] = a, b
        limits.append(row)
    return fits.merge(pd.DataFrame(limits), on=CONDITION)


def fit_aging(fits):
    """Fit Eq. 15 to mu_s and mu_c of every series; the unaged rubber is day 0 of each."""
    unaged, aged = fits[fits["aging_days"] == 0], fits[fits["aging_days"] > 0]
    rows = []
    for (temperature, compression), series in aged.groupby(CONDITION[:2]):
        table = pd.concat([unaged, series])
        for name in ("mu_s", "mu_c"):
            days, mu = table["aging_days"].to_numpy(), table[name].to_numpy()
            start, bounds = [mu.max(), 0.03, 0.1], ([0, 0, 1e-6], [5, 1, 100])
            values, covariance = curve_fit(aging, days, mu, p0=start, bounds=bounds)
            row = {"temperature_C": temperature, "compression_ratio_pct": compression, "quantity": name}
            for parameter, value, sd in zip(LAW, values, np.sqrt(np.diag(covariance)), strict=True):
                row[parameter], row[f"{parameter}_sd"] = value, sd
            rows.append(row)
    return pd.DataFrame(rows)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("campaign", type=Path, metavar="CAMPAIGN")
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--resamples", type=int, default=200, help="of the intervals; 0: none")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    clock = [time.perf_counter()]

    runs, mean_traces = read_traces(given.campaign, pd.read_csv(given.campaign / "runs.csv"))
    runs.to_csv(given.out / "runs.csv", index=False)
    mean_traces.to_csv(given.out / "mean_traces.csv", index=False)
    clock.append(time.perf_counter())

    fits = fit_conditions(runs)
    clock.append(time.perf_counter())

    if given.resamples:
        fits = add_intervals(fits, runs, given.resamples, np.random.default_rng(1))
    fits.to_csv(given.out / "steady_fit.csv", index=False)
    clock.append(time.perf_counter())

    laws = fit_aging(fits)
    laws.to_csv(given.out / "aging_fit.csv", index=False)
    clock.append(time.perf_counter())

    print(f"{len(runs)} files, {len(fits)} conditions, {len(laws)} aging laws -> {given.out}")
    print(
        json.dumps(dict(zip(("ingest", "fits", "bootstrap", "aging"), np.diff(clock).tolist(), strict=True)))
    )


if __name__ == "__main__":
    main()
