"""Coverage of the 95 % intervals of the after-model on simulated campaigns with hidden effects.

    python benchmarks/after.py [KIND ...] [--campaigns N] [--seed S] [--strength STRENGTH] [--workers W]

Kinds are those of campaigns.py. Every campaign is read, its loop closed, and everything fitted once more with
the effects taken out, as `sealfit run` does. Counted are mu_0, a and b of every series (of the table
`aging_fit_after`, and of `aging_fit` beside it) and the days to the value that mu_s has after 10 days at the
lowest temperature, by the likeliest law and over all laws (`sealfit lifetime`, after and before). The truth
is that at the effects' reference.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from campaigns import STRENGTHS, campaign
from coverage import Entry, held, report
from loop_summary import coverage

from sealfit.closure.after import after_fits
from sealfit.closure.loop import close_loop
from sealfit.config import Config
from sealfit.engine import one_thread
from sealfit.fit.aging import fit_series
from sealfit.fit.aging.all_series import law_of
from sealfit.fit.aging.lifetime import Goal, lifetime, over_laws
from sealfit.fit.joint import Fitted
from sealfit.fit.steady import SteadyFit, fit_conditions
from sealfit.ingest.campaign import ingest_campaign
from sealfit.pipeline import MADE
from sealfit.simulation import Spec, load_truth, simulate, truth_path

KINDS = ("warming_distance", "warming_time", "conditioning", "zero_offset", "lab_temperature", "two_at_once")
DAYS = 10.0


def count(kind: str, seed: int, strength: str) -> list[Entry]:
    """Return the intervals of one campaign, and which effects were found."""
    spec, config = campaign(kind, seed=seed, strength=strength), Config()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "campaign"
        simulate(spec, place)
        truth = load_truth(truth_path(place))
        tables = ingest_campaign(place, config, workers=1).tables
    closure = close_loop(tables["bins"], tables["traces"], config)
    found = [effect["id"] for effect in closure.document["effects"] if not effect["candidate"]]
    right = sorted(found) == sorted(effect.id for effect in spec.effects)
    after = after_fits(closure.after, tables["steady"], tables["traces"], config)
    conditions = fit_conditions(tables["steady"], config)
    before = fit_series(conditions, config)["aging_fit"]
    factor = _factor(spec, closure.after)
    laws = {str(row["condition"]): row for row in truth["physics"]}
    entries = [Entry("effects found as they are", right, None, None)]
    entries += _laws("after", after["aging_fit_after"], laws, factor)
    entries += _laws("before", before, laws, factor)
    free = {name: after[f"{name}_after"] for name in MADE["fit-steady"]}
    entries += _life("after", after["steady_after"], free, spec, laws, factor)
    return entries + list(_life("before", tables["steady"], conditions, spec, laws, factor))


def _factor(spec: Spec, after: Fitted) -> float:
    """Return the true factor on mu at the effects' reference, where a column changes mu in proportion."""
    factor = 1.0
    for effect in spec.effects:
        if effect.id == "lab_temperature":
            name = "lab_temperature_C"
            own = [term for term in after.model.terms if name in term.channels]
            fixed = own[0].fixed if own else {}
            at = fixed.get(f"{name}_ref", fixed.get("x_ref", float(after.rows.values(name).mean())))
            factor *= 1 + effect.parameters["A"] * (at - effect.reference[f"{name}_ref"])
    return factor


def _laws(model: str, fit: pd.DataFrame, laws: dict, factor: float) -> Iterator[Entry]:
    rows = fit[fit["quantity"].isin(["mu_s", "mu_c"]) & fit["parameter"].isin(["mu_0", "a", "b"])]
    for row in rows.dropna(subset="value").itertuples():
        true = next(
            law
            for law in laws.values()
            if law["temperature_C"] == row.temperature_C and law["aging_days"] > 0
        )
        value = true[f"{row.parameter}{'' if row.parameter == 'mu_0' else '_'}{row.quantity[-1]}"]
        value *= 1.0 if row.parameter == "b" else factor
        yield Entry(f"{model} {row.parameter}", value, row.lo95, row.hi95, row.identified)


def _life(
    model: str, steady: pd.DataFrame, conditions: SteadyFit, spec: Spec, laws: dict, factor: float
) -> Iterator[Entry]:
    celsius = min(law["temperature_C"] for law in laws.values() if law["aging_days"] > 0)
    true = next(law for law in laws.values() if law["temperature_C"] == celsius and law["aging_days"] > 0)
    goal = Goal(factor * (true["mu_0s"] - true["a_s"] * np.log1p(DAYS / true["b_s"])))
    found = law_of(steady, conditions, "mu_s")
    place = celsius if len(spec.design.temperatures_C) > 1 else None
    life = lifetime(found[0], goal, place)
    yield Entry(f"{model} lifetime", DAYS, life.low, life.high)
    yield Entry(f"{model} lifetime, over all laws", DAYS, *over_laws(found, goal, place))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kinds", nargs="*", default=KINDS, metavar="KIND")
    parser.add_argument("--campaigns", type=int, default=4, help="of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--strength", choices=list(STRENGTHS), default="strong")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    one_thread()
    everything = []
    with ProcessPoolExecutor(given.workers) as pool:
        for number, kind in enumerate(given.kinds):
            # A design of its own for each, or one unlucky specimen would count many times.
            seeds = [1000 * (number + 1) + given.seed + k for k in range(given.campaigns)]
            found = list(pool.map(partial(count, kind, strength=given.strength), seeds))
            report(f"{kind}, {given.strength}", found)
            everything += found
    report("all kinds", everything)
    for model in ("after", "before"):
        own = [[e for e in entries if e.name.startswith(model)] for entries in everything]
        print(f"\n{model}, all numbers: {coverage([held(entries) for entries in own])}", flush=True)


if __name__ == "__main__":
    main()
