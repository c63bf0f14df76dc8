"""The command line of the worlds: run, resume, summarise."""

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

from commit import newest_commit

from worlds.run import THREADS, Task, run_world
from worlds.summary import line, summarise


def guarded(task: Task) -> dict:
    """Return a world's record; a failure of the benchmark itself is a record too, with what went wrong."""
    try:
        return run_world(task)
    except Exception:
        return {
            "seed_text": task.seed_text,
            "index": task.index,
            "size": task.size,
            "error": traceback.format_exc(),
        }


def read(path: Path) -> list[dict]:
    """Return the records of a file, the last of each world.

    The benchmark's own failures are left out and run again.
    """
    if not path.exists():
        return []
    records = [json.loads(text) for text in path.read_text("utf-8").splitlines() if text.strip()]
    return list({(r["seed_text"], r["index"], r["size"]): r for r in records if "error" not in r}.values())


def run(tasks: list[Task], out: Path, jobs: int, *, limit_s: float) -> None:
    """Run what `out` does not hold, appending results as they come; no new ones after `limit_s` seconds."""
    done = {(r["seed_text"], r["index"], r["size"]) for r in read(out)}
    waiting = iter(todo := [t for t in tasks if t.key not in done])
    print(f"{len(todo)} of {len(tasks)} worlds to run", file=sys.stderr)
    started = time.monotonic()
    out.parent.mkdir(parents=True, exist_ok=True)
    os.environ.update(dict.fromkeys(THREADS, "1"))  # before the processes load numpy
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool, out.open("a", encoding="utf-8") as file:
        running = {pool.submit(guarded, t) for _, t in zip(range(jobs), waiting, strict=False)}
        while running:
            finished = next(as_completed(running))
            running.discard(finished)
            record = finished.result()
            file.write(json.dumps(record) + "\n")
            file.flush()
            print(f"{time.monotonic() - started:6.0f} s  {line(record)}", file=sys.stderr, flush=True)
            if time.monotonic() - started < limit_s and (task := next(waiting, None)) is not None:
                running.add(pool.submit(guarded, task))


def main(arguments: list[str] | None = None, *, description: str | None = None) -> int:
    """Run worlds, then summarise; the exit code."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="JSON lines, one a world; taken up where it ends"
    )
    parser.add_argument("--summary", type=Path, metavar="FILE", help="only summarise")
    parser.add_argument("--show", type=int, metavar="INDEX", help="run one world and print its record")
    parser.add_argument("--keep", metavar="DIR", help="keep campaigns and results there")
    parser.add_argument("--seed-text", metavar="TEXT", help="default: the newest commit's hash")
    parser.add_argument("--first", type=int, default=0, help="number of the first world")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--size", choices=["small", "any"], default="small", help="up to 150 or 2,000 files")
    parser.add_argument("--jobs", type=int, default=1, help="worlds at a time")
    parser.add_argument("--workers", type=int, default=1, help="processes that sealfit may use")
    parser.add_argument("--limit", type=float, default=300.0, metavar="SECONDS", help="for one world")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="start no world after this long")
    parser.add_argument("--python", default=sys.executable, help="interpreter with the sealfit to be tried")
    given = parser.parse_args(arguments)
    if sum(x is not None for x in (given.out, given.summary, given.show)) != 1:
        parser.error("give one of --out FILE, --summary FILE and --show INDEX")
    text = given.seed_text or (newest_commit() if given.summary is None else "")

    def task(index: int) -> Task:
        return Task(text, index, given.size, given.python, given.workers, given.limit, given.keep)

    if given.show is not None:
        print(json.dumps(run_world(task(given.show)), indent=1))
        return 0
    if given.out is not None:
        numbers = range(given.first, given.first + given.count)
        run([task(k) for k in numbers], given.out, given.jobs, limit_s=60 * given.minutes)
    path = given.summary or given.out
    records = read(path)
    if not records:
        print(f"worlds: {path} holds no result", file=sys.stderr)
        return 1
    print(summarise(records))
    return 0
