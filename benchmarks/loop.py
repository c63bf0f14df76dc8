"""Close the loop on simulated campaigns, and compare claims, predictions and intervals with the truth.

    python benchmarks/loop.py --out FILE [--kinds K ...] [--seeds 1 2 3 4] [--strengths weak medium strong]
                              [--nulls]
    python benchmarks/loop.py --summary FILE

Each campaign's result is a line of FILE (JSON) as soon as it is there; what FILE holds already is not run
again, so a run can be stopped and taken up. Two processes, each with one thread. The last of the seeds 4
(effects) and 20 (nulls) has some 600 files, the others 200. The summary is Markdown; the power curve is drawn
beside FILE as PNG.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
import traceback
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from campaigns import STRENGTHS
from effect_kinds import EFFECT_CAMPAIGNS
from one_campaign import Task, run_campaign

from sealfit.engine import ONE_THREAD

LARGE_SEED = {"effects": 4, "nulls": 20}
RIVALS_ON_NULLS = (
    2  # first seeds of each kind of null on which the rivals are learned too: there is nothing to learn
)
FAINT_SEEDS = (1, 2)


def plan(
    kinds: list[str], strengths: list[str], seeds: list[int], null_seeds: list[int], *, rivals: bool
) -> list[Task]:
    """Return every campaign to run, by seed, so that a stopped run has all kinds; nulls have no strength."""
    from campaigns import NULLS

    tasks = []
    for kind in kinds:
        null = kind in NULLS
        for strength in ["-"] if null else strengths:
            own = null_seeds if null else [s for s in seeds if strength != "faint" or s in FAINT_SEEDS]
            for seed in own:
                large = seed == LARGE_SEED["nulls" if null else "effects"] and strength != "faint"
                with_rivals = (
                    rivals and not large and (not null or seed <= RIVALS_ON_NULLS) and strength != "faint"
                )
                tasks.append(Task(kind, strength, seed, "large" if large else "small", with_rivals))
    return sorted(tasks, key=lambda t: t.seed)


def run(tasks: list[Task], out: Path, workers: int, *, limit: float) -> None:
    """Run the campaigns that `out` lacks and append each result; start none after `limit` seconds."""
    done = {key(record) for record in read(out)}
    todo = [t for t in tasks if t.key not in done]
    print(f"{len(todo)} of {len(tasks)} campaigns to run", file=sys.stderr)
    started, waiting = time.monotonic(), iter(todo)
    out.parent.mkdir(parents=True, exist_ok=True)
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))  # before the processes load numpy
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool, out.open("a", encoding="utf-8") as file:
        running = {pool.submit(guarded, t) for _, t in zip(range(workers), waiting, strict=False)}
        count = 0
        while running:
            finished = next(as_completed(running))
            running.discard(finished)
            record = finished.result()
            file.write(json.dumps(record) + "\n")
            file.flush()
            count += 1
            print(
                f"{count:4d}/{len(todo)} {time.monotonic() - started:6.0f} s  {line(record)}", file=sys.stderr
            )
            if time.monotonic() - started < limit and (task := next(waiting, None)) is not None:
                running.add(pool.submit(guarded, task))


def guarded(task: Task) -> dict:
    """Return a campaign's record; a failure is a record too, with what went wrong."""
    try:
        return run_campaign(task)
    except Exception:
        return {**task.record(), "error": traceback.format_exc()}


def key(record: dict) -> tuple:
    return (record["kind"], record["strength"], record["seed"], record["size"])


def read(path: Path) -> list[dict]:
    """Return the records of a file, the last of each campaign; failures are left out, so they run again."""
    if not path.exists():
        return []
    records = [json.loads(text) for text in path.read_text("utf-8").splitlines() if text.strip()]
    return list({key(r): r for r in records if "error" not in r}.values())


def line(record: dict) -> str:
    """Return a campaign's result in a line."""
    head = f"{record['kind']:24s} {record['strength']:6s} seed {record['seed']:2d} {record['size']:5s}"
    if "error" in record:
        return f"{head} FAILED: {record['error'].strip().splitlines()[-1]}"
    marks = " ".join(
        f"z={e['z']:.1f}:{('missed', 'lenient', 'found')[e['grade']]}"
        f"{'' if e['named'] else '/' + str(e['claimed_id'])}"
        for e in record["effects"]
    )
    claims = "; ".join(
        f"{c['id']}({','.join(c['channels'])})->{c['acts_on']}/{c['operation']}" for c in record["claims"]
    )
    errors = " ".join(f"{name} {value:.3f}" for name, value in record["errors"].items())
    spent = " ".join(f"{name} {value:.0f}" for name, value in record["seconds"].items() if value >= 0.5)
    return (
        f"{head} {record['verdict']:15s} {marks} | {claims or '-'} | extra {record['extra']} | {errors} | "
        f"s: {spent}"
    )


def main(arguments: list[str] | None = None) -> int:
    """Run, then summarise; the exit code."""
    from campaigns import NULLS

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="JSON lines, one a campaign; taken up where it ends"
    )
    parser.add_argument("--summary", type=Path, metavar="FILE", help="only summarise")
    parser.add_argument("--kinds", nargs="+", choices=[*NULLS, *EFFECT_CAMPAIGNS], metavar="KIND")
    parser.add_argument("--nulls", action="store_true", help="only the kinds of null")
    parser.add_argument("--effects", action="store_true", help="only the kinds with effects")
    strengths = ["faint", *STRENGTHS]
    parser.add_argument("--strengths", nargs="+", choices=strengths, default=strengths)
    parser.add_argument(
        "--seeds", nargs="+", type=int, default=[1, 2, 3, 4], help="of the kinds with effects"
    )
    parser.add_argument("--null-seeds", nargs="+", type=int, default=list(range(1, 21)))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--minutes", type=float, default=float("inf"), help="start no campaign after this long"
    )
    parser.add_argument("--no-rivals", action="store_true")
    given = parser.parse_args(arguments)
    if (given.out is None) == (given.summary is None):
        parser.error("give --out FILE or --summary FILE")
    path = given.summary or given.out
    if given.out is not None:
        kinds = given.kinds or [*([] if given.effects else NULLS), *([] if given.nulls else EFFECT_CAMPAIGNS)]
        tasks = plan(kinds, given.strengths, given.seeds, given.null_seeds, rivals=not given.no_rivals)
        run(tasks, path, given.workers, limit=60 * given.minutes)
    from loop_summary import draw_power, summarise

    records = read(path)
    if not records:
        print(f"loop: {path} holds no result", file=sys.stderr)
        return 1
    print(summarise(records))
    draw_power(records, path.with_suffix(".power.png"))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
