"""Count the claims of the loop on campaigns without effects and on campaigns with known effects.

    python benchmarks/false_alarms.py --seeds 3                     the 8 kinds of null
    python benchmarks/false_alarms.py --effects --strength strong   the kinds with effects
    python benchmarks/false_alarms.py --seeds 2 NAME NAME ...       those campaigns (campaigns.py --list)

One line per campaign: verdict, effects claimed, errors before and after; then the counts with Clopper-Pearson
bounds.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from campaigns import campaign, names
from counts import bounds

from sealfit.closure.loop import close_loop
from sealfit.config import Config
from sealfit.ingest.campaign import ingest_campaign
from sealfit.simulation import simulate


def close(name: str, seed: int, *, size: str, strength: str) -> tuple[dict, float]:
    """Return closure.json of one simulated campaign and the CPU seconds of the loop."""
    spec = campaign(name, seed=seed, size=size, strength=strength)
    config = Config()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "campaign"
        simulate(spec, place)
        tables = ingest_campaign(place, config).tables
    started = time.process_time()
    closure = close_loop(tables["bins"], tables["traces"], config)
    return closure.document, time.process_time() - started


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="campaigns; default: the null kinds")
    parser.add_argument(
        "--effects", action="store_true", help="the campaigns with effects, not the null kinds"
    )
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--size", default="small", choices=("small", "large"))
    parser.add_argument("--strength", default="medium", choices=("weak", "medium", "strong"))
    given = parser.parse_args()
    chosen = given.names or [n for n in names() if n != "paper" and n.startswith("null") != given.effects]
    claimed = total = worse = 0
    for name in chosen:
        for seed in range(given.first_seed, given.first_seed + given.seeds):
            found, seconds = close(name, seed, size=given.size, strength=given.strength)
            effects = [
                f"{e['id']}({','.join(e['channels'])})->{e['acts_on']}/{e['operation']}"
                for e in found["effects"]
            ]
            before, after = found["before"]["heldout_rmse_N"], found["after"]["heldout_rmse_N"]
            claims = "; ".join(effects) or "-"
            left = f"left {found['left']['channel']} p {found['left']['p_value']}"
            print(
                f"{name:28s} seed {seed} {found['verdict']:16s} {before:.4f} -> {after:.4f} "
                f"floor {found['noise_floor_N']:.4f} {seconds:5.1f} s  {claims}  {left}",
                flush=True,
            )
            total += 1
            claimed += bool(effects) or found["verdict"] == "unexplained"
            worse += after > 1.02 * before
    low, high = bounds(claimed, total)
    print(
        f"claimed or unexplained: {claimed} of {total} [{low:.3f}, {high:.3f}]; "
        f"after above 1.02 x before: {worse}"
    )


if __name__ == "__main__":
    main()
