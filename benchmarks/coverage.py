"""Coverage of the 95 % intervals of sealfit on simulated campaigns.

    python benchmarks/coverage.py [steady] [aging] [laws] [dynamic] [--campaigns N] [--seed S] [--workers W]

Prints, per design and number, the share of the intervals that contain the truth, the share called identified
and the median half-width relative to the truth; and per part all of them pooled, with a standard error that
takes campaigns as clusters. "laws" counts the law for all series fitted to the forces, what evidence chooses,
and lifetimes by the true law and over all laws; "dynamic" starts from traces and also counts break-aways
found where there is none. Intervals of `predict` are counted by loop.py.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
from loop_summary import coverage
from steady_tables import MU_C, MU_S, steady_rows

from sealfit.config import Config
from sealfit.engine import one_thread
from sealfit.fit.aging import fit_series
from sealfit.fit.aging.all_series import aged_values
from sealfit.fit.aging.joint_law import GAS_CONSTANT, JointLaw, fit_joint_law, fit_laws, rivals_of
from sealfit.fit.aging.lifetime import DAYS_PER_YEAR, Goal, lifetime, over_laws, resampled, temperature_for
from sealfit.fit.dynamic import fit_dynamic
from sealfit.fit.steady import fit_conditions
from sealfit.ingest.campaign import ingest_campaign
from sealfit.simulation import Spec, simulate

LAWS = {"mu_s": MU_S, "mu_c": MU_C}
CURVE = {"mu_s": 0.7, "mu_c": 0.45, "v_s": 6.0, "sigma_2": 0.03}
DAYS = (0, 1, 2, 4, 8, 12, 16)
FEW, SIX, FIVE = (0.5, 2, 5, 12, 60), (0.5, 2, 5, 10, 25, 60), (1, 3, 8, 20, 60)
TRIPLE = ((40.0, 80.0), (60.0, 80.0), (80.0, 80.0))
GRID = tuple((celsius, percent) for celsius in (40.0, 60.0, 80.0) for percent in (80.0, 90.0))
# True activation energy in kJ/mol, and coefficient of the height in 1/%.
ENERGY, KAPPA = 80.0, 0.02
BRISTLES = {"sigma_0": 100.0, "sigma_1": 0.5}
RIG = (
    {"kind": "white", "sd_N": 0.1},
    {"kind": "repeat_gain", "sd_rel": 0.005},
    {"kind": "run_setup", "sd_rel": 0.005},
    {"kind": "displacement", "sd_mm": 0.002},
)
ONE = {"days": (), "temperatures_C": (), "compressions_pct": ()}
FLAT = {"mu_s": {"mu_0": 0.6}, "mu_c": {"mu_0": 0.6}, "sigma_2": 0.0, "sigma_0": 100.0}
DESIGNS = {
    "steady": {
        "8 speeds both ways, repeats only": {"noise": 0.01},
        "8 speeds both ways, set-up 2 %": {"noise": 0.01, "setup": 0.02},
        "6 speeds one way, repeats only": {"noise": 0.01, "speeds": SIX, "ways": (1,)},
        "6 speeds one way, set-up 1 %": {"noise": 0.01, "setup": 0.01, "speeds": SIX, "ways": (1,)},
        "6 speeds one way, no repeats": {"noise": 0.01, "speeds": SIX, "ways": (1,), "repeats": 1},
        "8 speeds one way, no repeats, noise in N": {
            "noise": 0.0, "constant": 0.3, "ways": (1,), "repeats": 1,
        },
        "6 speeds both ways in one file": {"noise": 0.01, "speeds": SIX, "together": True},
        "6 speeds both ways in one file, set-up 1 %": {
            "noise": 0.01, "setup": 0.01, "speeds": SIX, "together": True,
        },
        "5 speeds one way, noise 4 %": {"noise": 0.04, "speeds": FIVE, "ways": (1,)},
        "6 speeds one way, 3 conditions of 2 specimens of 4 %": {
            "noise": 0.01, "specimen": 0.04, "specimens": 2, "speeds": SIX, "ways": (1,),
        },
        "6 speeds both ways, 3 conditions of 4 specimens of 3 %, set-up 1 %": {
            "noise": 0.01, "setup": 0.01, "specimen": 0.03, "specimens": 4, "speeds": SIX,
        },
        "5 speeds one way, no repeats, 3 conditions of 3 specimens of 5 %": {
            "noise": 0.01, "repeats": 1, "specimen": 0.05, "specimens": 3, "speeds": FIVE, "ways": (1,),
        },
    },
    "aging": {
        "1 series, 7 days, repeats only": {"noise": 0.005},
        "1 series, 7 days, specimens 2 %": {"noise": 0.005, "specimen": 0.02},
        "1 series, 5 days, specimens 1 %": {"noise": 0.005, "specimen": 0.01, "days": (0, 1, 4, 8, 16)},
        "3 series, 7 days, specimens 2 %": {"noise": 0.005, "specimen": 0.02, "series": TRIPLE},
        "3 series, 4 days, specimens 1 %": {
            "noise": 0.005, "specimen": 0.01, "series": TRIPLE, "days": (0, 1, 4, 16),
        },
    },
    "laws": {
        "6 series, 7 days, specimens 1 %": {"specimen": 0.01, "series": GRID},
        "6 series, 7 days, set-up 1 %": {"setup": 0.01, "series": GRID},
        "2 series, 5 days, specimens 1 %": {"specimen": 0.01, "series": TRIPLE[1:], "days": (0, 1, 4, 8, 16)},
    },
    "dynamic": {
        "8 speeds one way": (BRISTLES, {}),
        "6 speeds both ways, 4 strokes a file": (BRISTLES, {
            "directions": (1, -1), "strokes_per_file": 4, "max_rows": 4000,
            "speeds_mm_s": (0.5, 2.0, 4.0, 8.0, 20.0, 40.0),
        }),
        "6 speeds one way": (BRISTLES, {"speeds_mm_s": (0.5, 2.0, 5.0, 10.0, 25.0, 50.0)}),
        "6 speeds one way, slow ramps": (BRISTLES, {
            "speeds_mm_s": (0.5, 2.0, 5.0, 8.0, 10.0, 12.0), "ramp_s": 2.0, "sampling_Hz": 400.0,
            "max_rows": 4000,
        }),
        "no break-away, 8 speeds one way": (FLAT, {}),
    },
}  # fmt: skip


class Entry(NamedTuple):
    """One interval, or where `low` is None, whether something was so."""

    name: str
    truth: float
    low: float | None
    high: float | None
    known: bool = True


def steady(settings: dict, seed: int) -> Iterator[Entry]:
    """Yield the intervals of fit-steady on one condition of a campaign."""
    fits = fit_conditions(steady_rows(seed=seed, days=(0, 1, 2), model=CURVE, **settings), Config())
    rows = fits["steady_fit"].query("quantity == 'steady' and condition == 'unaged'")
    for row in rows.dropna(subset="value").itertuples():
        yield Entry(row.parameter, CURVE[row.parameter], row.lo95, row.hi95, row.identified)


def aging(settings: dict, seed: int) -> Iterator[Entry]:
    """Yield the intervals of the aging law of every series."""
    table = steady_rows(**{"seed": seed, "days": DAYS, "speeds": FEW, "ways": (1,), **settings})
    fit = fit_series(fit_conditions(table, Config()), Config())["aging_fit"]
    for quantity, law in LAWS.items():
        truth = law | {"c": -law["a"] * np.log(law["b"])}
        for row in fit[(fit["quantity"] == quantity)].dropna(subset="value").itertuples():
            yield Entry(
                f"{quantity} {row.parameter}", truth[row.parameter], row.lo95, row.hi95, row.identified
            )


def laws(settings: dict, seed: int) -> Iterator[Entry]:
    """Yield the intervals of one law for all series, and of lifetimes by it and by the likeliest law.

    Yield also what was chosen.
    """
    middle = tuple(float(np.median(np.unique(column))) for column in zip(*settings["series"], strict=True))
    varied = {"E": ENERGY} | (
        {"kappa": KAPPA} if len({percent for _, percent in settings["series"]}) > 1 else {}
    )
    true = {
        (celsius, percent): tuple(
            {**law, "b": law["b"] / _rate(celsius, percent, middle)} for law in LAWS.values()
        )
        for celsius, percent in settings["series"]
    }
    table = steady_rows(
        **{"seed": seed, "days": DAYS, "speeds": FEW, "ways": (1,), "noise": 0.005, "laws": true, **settings}
    )
    values = aged_values(table, fit_conditions(table, Config()))
    for quantity, law in LAWS.items():
        aged = values["rubber", quantity]
        fitted, chosen = fit_joint_law(aged, "log", "rate"), fit_laws(aged)
        for name, _, low, high, known in fitted.parameters():
            yield Entry(f"{quantity} {name}", (law | varied)[name], low, high, known)
        likely = [(one.loss.name, one.acts_on) for one in (chosen[0], *rivals_of(chosen))]
        yield Entry(f"{quantity}: the true law is the likeliest", likely[0] == ("log", "rate"), None, None)
        yield Entry(
            f"{quantity}: the true law is the likeliest or a rival", ("log", "rate") in likely, None, None
        )
        yield from _lives(quantity, law, fitted, chosen, middle)


def _lives(
    quantity: str, law: dict, fitted: JointLaw, chosen: Sequence[JointLaw], middle: tuple
) -> Iterator[Entry]:
    """Yield lifetimes within and beyond the tests: a loss that takes 10 days in the middle, and 100 days."""
    celsius, percent = middle[0] - 5.0, middle[1]
    place = [at if name in fitted.names else None for name, at in (("E", celsius), ("kappa", percent))]
    for title, days in (("life", 10.0), ("life beyond the tests", 100.0)):
        goal = Goal(law["mu_0"] - law["a"] * np.log1p(days / law["b"]))
        truth = days / _rate(celsius, percent, middle)
        found = lifetime(fitted, goal, *place)
        yield Entry(f"{quantity} {title}", truth, found.low, found.high)
        yield Entry(f"{quantity} {title}, over all laws", truth, *over_laws(chosen, goal, *place))
        yield Entry(f"{quantity} {title}, resampled", truth, *resampled(fitted, goal, *place))
        _, low, high = temperature_for(fitted, goal, truth / DAYS_PER_YEAR, place[1])
        yield Entry(f"{quantity} temperature, {title}", celsius, low, high)


def _rate(celsius: float, percent: float, middle: tuple[float, float]) -> float:
    """Return k, 1 in the middle of what was tested."""
    inverse = 1 / (middle[0] + 273.15) - 1 / (celsius + 273.15)
    return float(np.exp(ENERGY / GAS_CONSTANT * inverse + KAPPA * (middle[1] - percent)))


def dynamic(settings: tuple[dict, dict], seed: int) -> Iterator[Entry]:
    """Yield intervals of fit-dynamic on one condition, from traces; without a peak, whether one is found."""
    physics, design = settings
    fit = _dynamic_fit(physics, design, RIG, seed)
    broken = fit[fit["quantity"] == "break_away"]
    if physics is FLAT:
        found = (
            (broken["parameter"] == "F_ba/F") & broken["identified"].astype(bool) & (broken["reason"] == "")
        )
        yield Entry("a break-away where there is none", bool(found.any()), None, None)
        return
    for row in fit[fit["quantity"] == "dynamic"].dropna(subset="value").itertuples():
        yield Entry(row.parameter, physics[row.parameter], row.lo95, row.hi95, row.identified)
    truth = _true_peaks(design)
    for row in broken.dropna(subset="lo95").itertuples():
        yield Entry(
            row.parameter, truth[row.parameter, row.speed_set_mm_s, row.direction], row.lo95, row.hi95
        )


def _dynamic_fit(physics: dict, design: dict, noise: Sequence[dict], seed: int):
    config = Config()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "campaign"
        simulate(Spec(seed=seed, physics=physics, design={**ONE, **design}, noise=tuple(noise)), place)
        tables = ingest_campaign(place, config, workers=1).tables
    return fit_dynamic(tables["traces"], tables["steady"], fit_conditions(tables["steady"], config), config)[
        "dynamic_fit"
    ]


PEAKS: dict[str, dict] = {}  # of the designs counted so far, in this process


def _true_peaks(design: dict) -> dict:
    """Return F_ba and its ratio per speed and direction, from the same rig without noise."""
    if str(design) not in PEAKS:
        fit = _dynamic_fit(BRISTLES, design, [{"kind": "white", "sd_N": 1e-6}], 1)
        rows = fit[fit["quantity"] == "break_away"].itertuples()
        PEAKS[str(design)] = {(row.parameter, row.speed_set_mm_s, row.direction): row.value for row in rows}
    return PEAKS[str(design)]


COUNTED = {"steady": steady, "aging": aging, "laws": laws, "dynamic": dynamic}


def _job(job: tuple[str, str, int]) -> list[Entry]:
    part, title, seed = job
    return list(COUNTED[part](DESIGNS[part][title], seed))


def report(title: str, campaigns: Sequence[Sequence[Entry]]) -> None:
    """Print a line for each number of a design."""
    by = defaultdict(list)
    for entries in campaigns:
        for entry in entries:
            by[entry.name].append(entry)
    print(f"\n{title} ({len(campaigns)} campaigns)")
    for name, entries in by.items():
        if entries[0].low is None:
            print(f"  {name:46s} {sum(e.truth for e in entries)} of {len(entries)}")
            continue
        known = 100 * np.mean([e.known for e in entries])
        width = 100 * np.nanmedian([(e.high - e.low) / 2 / abs(e.truth) for e in entries])
        share = coverage([held(c, name) for c in campaigns])
        print(f"  {name:46s} {share:44s} identified {known:5.1f} %  +- {width:.2g} %")


def held(entries: Sequence[Entry], name: str | None = None) -> tuple[int, int]:
    """Return the number of a campaign's intervals that contain the truth, and their total number."""
    own = [e for e in entries if e.low is not None and name in (None, e.name)]
    low, high = (np.array([e[k] for e in own], float) for k in (2, 3))
    low, high = np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)
    truth = np.array([e.truth for e in own], float)
    return int(((low <= truth) & (truth <= high)).sum()), len(own)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", choices=[*DESIGNS, []], metavar="PART", help=", ".join(DESIGNS))
    parser.add_argument("--campaigns", type=int, default=100, help="of each design")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    one_thread()
    seeds = range(given.seed, given.seed + given.campaigns)
    with ProcessPoolExecutor(given.workers) as pool:
        for part in given.parts or DESIGNS:
            everything = []
            for title in DESIGNS[part]:
                found = list(pool.map(_job, [(part, title, seed) for seed in seeds]))
                report(f"{part}: {title}", found)
                everything += found
            print(f"\n{part}, all designs: {coverage([held(c) for c in everything])}", flush=True)


if __name__ == "__main__":
    main()
