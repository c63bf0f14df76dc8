"""Named campaigns to count false alarms and missed effects: nulls, effects in three strengths, the paper's.

    python benchmarks/campaigns.py NAME --seed N --out DIR [--size small|large]
                                   [--strength weak|medium|strong]
    python benchmarks/campaigns.py --list

`campaign(name, ...)` gives the SPEC; `sealfit.simulation.simulate` writes it. Small campaigns have about 200
files, large ones about 600. Strengths are chosen against the scatter of `RIG`: weak has an RMS of 0.25 to 1
times one file's, medium is three times, strong ten times that; faint is beyond what the files can show. The
kinds of effect stand in `effect_kinds.py`. Draws depend on the seed and on what they are for only: two nulls
of one seed share their run order and specimens, so count on different seeds.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Literal

from effect_kinds import DESIGNS, EFFECT_CAMPAIGNS, NEEDS_BOTH_WAYS, Size

from sealfit.errors import SealfitError
from sealfit.simulation import Spec, simulate

Strength = Literal["faint", "weak", "medium", "strong"]
STRENGTHS: dict[Strength, float] = {"weak": 1.0, "medium": 3.0, "strong": 10.0}
# Size of an effect that some 200 files cannot show, relative to medium effects.
FAINT = 0.002

SPEEDS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 50.0)
ONE_WAY: dict[Size, dict] = {
    "small": {
        "temperatures_C": (60.0, 80.0),
        "compressions_pct": (80.0,),
        "days": (1.0, 4.0, 8.0, 16.0),
    },  # 216 files
    "large": {
        "temperatures_C": (60.0, 80.0),
        "compressions_pct": (80.0, 90.0),
        "days": (1.0, 2.0, 4.0, 8.0, 12.0, 16.0),
    },
}
BOTH_WAYS: dict[Size, dict] = {
    "small": {
        "temperatures_C": (60.0,),
        "days": (1.0, 4.0, 8.0, 16.0),
        "speeds_mm_s": SPEEDS[:7],
    },  # 210 files
    "large": {"temperatures_C": (60.0, 80.0), "days": (1.0, 2.0, 4.0, 8.0, 12.0, 16.0)},  # 624 files
}
# Stiffness of the bristles in N/mm: rises of 0.1 to 0.35 mm.
SIGMA_0 = 130.0
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
    "null_autocorrelated": (
        ({"kind": "autocorrelated", "sd_N": 0.2, "length": 2.0, "unit": "mm"}, WHITE),
        (),
    ),
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


def names() -> list[str]:
    """Names of all campaigns, nulls first."""
    return [*NULLS, *EFFECT_CAMPAIGNS, "paper"]


def campaign(
    name: str, *, seed: int = 1, size: Size = "small", strength: Strength = "medium", rows: int = 400
) -> Spec:
    """SPEC of a named campaign; nulls and `paper` have no `strength`, `paper` has no `size` and no `rows`."""
    if name == "paper":
        return paper_campaign(seed=seed)
    if name not in names():
        raise SealfitError(f"there is no campaign '{name}'.", fix=f"Known: {', '.join(names())}.")
    effects: tuple[dict, ...] = ()
    if name in NULLS:
        noise, channels = NULLS[name]
    else:
        effects, channels = EFFECT_CAMPAIGNS[name](FAINT if strength == "faint" else STRENGTHS[strength])
        noise = RIG
    both = name in NEEDS_BOTH_WAYS
    design = {
        "speeds_mm_s": SPEEDS,
        "directions": (1, -1) if both else (1,),
        "start_scatter_mm": 4.0,  # or distance could not be told from position
        "max_rows": rows,
        **(BOTH_WAYS if both else ONE_WAY)[size],
        **DESIGNS.get(name, {}).get(size, {}),
    }
    return Spec(
        name=name,
        seed=seed,
        physics={"growth": {}, "sigma_0": SIGMA_0},
        design=design,
        effects=effects,
        channels=channels,
        noise=noise,
    )


def paper_campaign(*, seed: int = 1, effects: tuple[dict, ...] = (), channels: tuple[dict, ...] = ()) -> Spec:
    """SPEC of the paper's tests: 73 conditions x 8 speeds x 3 repeats = 1,752 files of about 1,000 rows.

    Wu et al. 2020, Polymers 12(1) 102, doi:10.3390/polym12010102: 20 to 80 °C, 80 to 100 % height, 1 to 16
    days and unaged, 5 kg dead weight. The paper does not print its speeds, nor a law for every series; those
    are ours.
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
    parser.add_argument("--strength", choices=["faint", *STRENGTHS], default="medium")
    parser.add_argument("--rows", type=int, default=400, help="most rows of a file (paper: 1,000)")
    given = parser.parse_args(arguments)
    if given.list:
        print("\n".join(names()))
        return 0
    if given.name is None or given.out is None:
        parser.error("give NAME and --out DIR, or --list")
    try:
        spec = campaign(
            given.name, seed=given.seed, size=given.size, strength=given.strength, rows=given.rows
        )
        simulate(spec, given.out)
    except SealfitError as error:
        print(f"campaigns: {error}", file=sys.stderr)
        return 1
    print(f"{given.name} -> {given.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
