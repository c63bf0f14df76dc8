"""Named campaigns for counting false alarms and missed effects: nulls, effects in three strengths, and the paper's own.

    python benchmarks/campaigns.py NAME --seed N --out DIR [--size small|large] [--strength weak|medium|strong]
    python benchmarks/campaigns.py --list

`campaign(name, ...)` gives the SPEC; `sealfit.simulate.simulate` writes it. Small campaigns have about 200 files,
large ones about 600. Strengths are chosen against the scatter of `RIG`: weak has an RMS of 0.25 to 1 times one file's,
medium is three times, strong ten times that. Draws depend on the seed and on what they are for only: two nulls of one
seed share their run order and specimens, so count on different seeds.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from sealfit.errors import SealfitError
from sealfit.simulate import Spec, simulate

Size = Literal["small", "large"]
Strength = Literal["weak", "medium", "strong"]
STRENGTHS: dict[Strength, float] = {"weak": 1.0, "medium": 3.0, "strong": 10.0}

SPEEDS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 50.0)
ONE_WAY: dict[Size, dict] = {
    "small": {"temperatures_C": (60.0, 80.0), "compressions_pct": (80.0,), "days": (1.0, 4.0, 8.0, 16.0)},  # 216 files
    "large": {
        "temperatures_C": (60.0, 80.0),
        "compressions_pct": (80.0, 90.0),
        "days": (1.0, 2.0, 4.0, 8.0, 12.0, 16.0),
    },
}
BOTH_WAYS: dict[Size, dict] = {
    "small": {"temperatures_C": (60.0,), "days": (1.0, 4.0, 8.0, 16.0), "speeds_mm_s": SPEEDS[:7]},  # 210 files
    "large": {"temperatures_C": (60.0, 80.0), "days": (1.0, 2.0, 4.0, 8.0, 12.0, 16.0)},  # 624 files
}
RIG = (
    {"kind": "white", "sd_N": 0.1},
    {"kind": "repeat_gain", "sd_rel": 0.005},
    {"kind": "run_setup", "sd_rel": 0.005},
    {"kind": "specimen", "sd_rel": 0.005},
)
WHITE = {"kind": "white", "sd_N": 0.05}  # no sensor is without

# ---------------------------------------------------------------- nulls: (noise, channels)
NULLS: dict[str, tuple[tuple[dict, ...], tuple[dict, ...]]] = {
    "null_white": (({"kind": "white", "sd_N": 0.2},), ()),
    "null_autocorrelated": (({"kind": "autocorrelated", "sd_N": 0.2, "length": 2.0, "unit": "mm"}, WHITE), ()),
    "null_quantised": (({"kind": "quantised", "resolution_N": 0.2}, WHITE), ()),
    "null_repeat_gain": (({"kind": "repeat_gain", "sd_rel": 0.01}, WHITE), ()),
    "null_run_setup": (({"kind": "run_setup", "sd_rel": 0.01, "sd_N": 0.1}, WHITE), ()),
    "null_specimen": (({"kind": "specimen", "sd_rel": 0.02}, WHITE), ()),
    "null_specimen_with_columns": (
        ({"kind": "specimen", "sd_rel": 0.02}, WHITE),
        (
            {"kind": "slow", "name": "lab_temperature_C", "mean": 22.0, "sd": 1.0, "correlation_h": 48.0},
            {"kind": "category", "name": "sheet", "level": "specimen", "labels": ("A", "B", "C")},
        ),
    ),
    "null_proportional": (({"kind": "proportional", "sd_rel": 0.01}, WHITE), ()),
}

# ---------------------------------------------------------------- effects: strength -> (effects, channels)
COLUMN = {"kind": "numeric", "name": "oil_ppm", "level": "run", "mean": 50.0, "sd": 10.0}
OTHER = {"kind": "numeric", "name": "dust_mg", "level": "run", "mean": 5.0, "sd": 1.0}
GRADES = {"kind": "category", "name": "cleaner", "level": "run", "labels": ("K", "L", "M"), "assignment": "balanced"}
Ingredients = tuple[tuple[dict, ...], tuple[dict, ...]]


def _one(id: str, parameters: dict, acts_on: str, operation: str, **more) -> dict:
    return {"id": id, "parameters": parameters, "acts_on": acts_on, "operation": operation, **more}


def _ripple(k: float) -> dict:
    return _one("ripple", {"A": 0.1 * k, "lambda_": 5.0, "phi": 0.7}, "force", "add")


def _warming_distance(k: float) -> dict:
    return _one("warming_distance", {"A": 0.01 * k, "s_0": 10.0}, "mu", "multiply")


def _conditioning(k: float) -> dict:
    return _one("conditioning", {"A": -0.01 * k, "n_0": 1.0}, "mu", "multiply")


def _column(k: float) -> dict:
    reference = {"x_ref": COLUMN["mean"]}
    return _one("linear", {"A": 0.0007 * k}, "mu", "multiply", channels=("oil_ppm",), reference=reference)


def _column_log(k: float) -> dict:
    reference = {"x_ref": COLUMN["mean"]}
    return _one("log", {"A": 0.7 * k}, "force", "add", channels=("oil_ppm",), reference=reference)


def _grades(k: float, acts_on: str, operation: str, size: float) -> dict:
    values = {"K": -size * k, "L": 0.0, "M": size * k}
    return _one("levels", values, acts_on, operation, channels=("cleaner",))


def _expression(formula: str, size: float, acts_on: str, operation: str) -> dict:
    return _one("expression", {"A": size}, acts_on, operation, formula=formula)


BUMP = "A * exp(-((displacement_mm - 22) / 2) ** 2)"
PRODUCT = "A * (oil_ppm - 50) / 10 * (dust_mg - 5)"

EFFECT_CAMPAIGNS: dict[str, Callable[[float], Ingredients]] = {
    "ripple": lambda k: ((_ripple(k),), ()),
    "warming_time": lambda k: ((_one("warming_time", {"A": 0.01 * k, "tau": 4.0}, "mu", "multiply"),), ()),
    "warming_distance": lambda k: ((_warming_distance(k),), ()),
    "drift": lambda k: ((_one("drift", {"A": 0.004 * k}, "force", "add"),), ()),
    "conditioning": lambda k: ((_conditioning(k),), ()),
    "zero_offset": lambda k: ((_one("zero_offset", {"A": 0.15 * k}, "force", "add"),), ()),
    "asymmetry": lambda k: ((_one("asymmetry", {"A": 0.014 * k}, "mu", "multiply"),), ()),
    "column_linear_mu": lambda k: ((_column(k),), (COLUMN,)),
    "column_log_force": lambda k: ((_column_log(k),), (COLUMN,)),
    "column_category_mu": lambda k: ((_grades(k, "mu", "multiply", 0.008),), (GRADES,)),
    "column_category_force": lambda k: ((_grades(k, "force", "add", 0.2),), (GRADES,)),
    "bump": lambda k: ((_expression(BUMP, 0.25 * k, "force", "add"),), ()),
    "product": lambda k: ((_expression(PRODUCT, 0.007 * k, "mu", "multiply"),), (COLUMN, OTHER)),
    "two_at_once": lambda k: ((_ripple(k), _conditioning(k)), ()),
    "three_at_once": lambda k: ((_warming_distance(k), _column(k), _ripple(k)), (COLUMN,)),
}
NEEDS_BOTH_WAYS = ("zero_offset", "asymmetry")


def names() -> list[str]:
    """Names of all campaigns, nulls first."""
    return [*NULLS, *EFFECT_CAMPAIGNS, "paper"]


def campaign(name: str, *, seed: int = 1, size: Size = "small", strength: Strength = "medium", rows: int = 400) -> Spec:
    """SPEC of a named campaign; `strength` has no meaning for nulls and `paper`, `size` and `rows` none for `paper`."""
    if name == "paper":
        return paper_campaign(seed=seed)
    if name not in names():
        raise SealfitError(f"there is no campaign '{name}'.", mend=f"Known: {', '.join(names())}.")
    effects: tuple[dict, ...] = ()
    if name in NULLS:
        noise, channels = NULLS[name]
    else:
        effects, channels = EFFECT_CAMPAIGNS[name](STRENGTHS[strength])
        noise = RIG
    both = name in NEEDS_BOTH_WAYS
    design = {
        "speeds_mm_s": SPEEDS,
        "directions": (1, -1) if both else (1,),
        "start_scatter_mm": 4.0,  # or distance could not be told from position
        "max_rows": rows,
        **(BOTH_WAYS if both else ONE_WAY)[size],
    }
    return Spec(
        name=name, seed=seed, physics={"growth": {}}, design=design, effects=effects, channels=channels, noise=noise
    )


def paper_campaign(*, seed: int = 1, effects: tuple[dict, ...] = (), channels: tuple[dict, ...] = ()) -> Spec:
    """SPEC of the paper's tests: 73 conditions x 8 speeds x 3 repeats = 1,752 files of about 1,000 rows.

    Wu et al. 2020, Polymers 12(1) 102, doi:10.3390/polym12010102: 20 to 80 °C, 80 to 100 % height, 1 to 16 days and
    unaged, 5 kg dead weight. The paper does not print its speeds, nor a law for every series; those are ours.
    """
    return Spec(
        name="paper",
        seed=seed,
        physics={"growth": {}},
        design={
            "temperatures_C": (20.0, 40.0, 60.0, 80.0),
            "compressions_pct": (80.0, 90.0, 100.0),
            "days": (1.0, 2.0, 4.0, 8.0, 12.0, 16.0),
            "loads_N": (49.03,),
            "speeds_mm_s": SPEEDS,
            "start_scatter_mm": 4.0,
            "minutes_per_file": 3.0,  # 288 files between day 1 and day 2
            "max_rows": 1000,
        },
        effects=effects,
        channels=channels,
        noise=(*RIG, {"kind": "quantised", "resolution_N": 0.01}),
    )


def main(arguments: list[str] | None = None) -> int:
    """Write one campaign; the exit code."""
    parser = argparse.ArgumentParser(description="Write one of the named campaigns, and its truth beside it.")
    parser.add_argument("name", nargs="?", metavar="NAME")
    parser.add_argument("--list", action="store_true", help="print the names")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, metavar="DIR")
    parser.add_argument("--size", choices=["small", "large"], default="small")
    parser.add_argument("--strength", choices=list(STRENGTHS), default="medium")
    parser.add_argument("--rows", type=int, default=400, help="most rows of a file (paper: 1,000)")
    given = parser.parse_args(arguments)
    if given.list:
        print("\n".join(names()))
        return 0
    if given.name is None or given.out is None:
        parser.error("give NAME and --out DIR, or --list")
    try:
        spec = campaign(given.name, seed=given.seed, size=given.size, strength=given.strength, rows=given.rows)
        simulate(spec, given.out)
    except SealfitError as error:
        print(f"campaigns: {error}", file=sys.stderr)
        return 1
    print(f"{given.name} -> {given.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
