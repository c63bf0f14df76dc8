"""`sealfit run`, report included, beside the script that an engineer would write: a part of `speed.py`."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from in_turns import in_turns, ratios, show
from process_tree import watched

SCRIPT = Path(__file__).with_name("pandas_script.py")
PARTS = ("ingest", "fits", "bootstrap", "aging")


def run(campaign: Path, cores: Sequence[int], repeats: int, resamples: int, work: Path) -> None:
    """Print the seconds of the script and of the whole run with one and two workers, and their ratios."""
    one, two = cores[:1], cores[:2]
    out = work / "run_out"

    def script(count: int) -> Callable[[], dict[str, float]]:
        def measure() -> dict[str, float]:
            cost = fresh([sys.executable, SCRIPT, campaign, out, "--resamples", str(count)], two)
            return {"": cost.seconds, **json.loads(cost.output.splitlines()[-1])}

        return measure

    def sealfit(workers: int, pinned: Sequence[int]) -> Callable[[], dict[str, float]]:
        command = [sys.executable, "-m", "sealfit", "run", campaign, "--out", out, "--workers", str(workers)]
        return lambda: {"": fresh(command, pinned).seconds}

    def fresh(command: list, pinned: Sequence[int]):
        shutil.rmtree(out, ignore_errors=True)
        cost = watched(command, cores=pinned, look=False)
        shutil.rmtree(out)
        return cost

    measured = {
        "script": script(resamples),
        "plain": script(0),
        "one": sealfit(1, one),
        "two": sealfit(2, two),
    }
    found = in_turns(measured, repeats)
    print(f"\nwhole run of {campaign.name}, {repeats} turns")
    show(f"pandas script, {resamples} resamples", found["script"])
    for part in PARTS:
        show(f"  of these {part}", found[f"script, {part}"])
    show("pandas script without intervals", found["plain"])
    show("sealfit run with report, --workers 1, one core", found["one"])
    show("sealfit run with report, --workers 2, two cores", found["two"])
    show("script / sealfit, two workers", ratios(found["script"], found["two"]), "x", "at least 10")
    show("script / sealfit, one worker", ratios(found["script"], found["one"]), "x")
    show("script without intervals / sealfit, two workers", ratios(found["plain"], found["two"]), "x")
    show("script without intervals / sealfit, one worker", ratios(found["plain"], found["one"]), "x")
