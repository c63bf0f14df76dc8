"""Several processes on one folder of results, and a Dask cluster that loses a worker or its scheduler.

    python benchmarks/torture/concurrency.py [--seed N] [--writers N] [--rounds N] [--losses N]

Two writers: the second is refused in one line or comes after the first; OUT ends as after one of them.
Twenty readers while a writer works: every answer is that of the old or of the new state, or one line that
says that a step is not done, that OUT was written meanwhile or that another process is writing. The readers
are slow: they wait before every table, so that a writer can come in between.
A cluster: after a worker is killed the run ends as without a cluster; after the scheduler is killed it ends
in one line or had all it needed, and a run without a cluster ends as if it had never been.
"""

# ruff: noqa: E402 (modules of this folder and the one above are found by sys.path)

from __future__ import annotations

import argparse
import os
import pickle
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from random import Random

HERE = Path(__file__).resolve().parent
sys.path += [str(HERE), str(HERE.parent)]

from dask_here import DaskHere
from faults import (
    LIFE,
    Ended,
    Scene,
    asked,
    changed_trace,
    differing,
    files_in,
    forked,
    hold_time,
    make_scene,
    remember_computations,
    under_fault,
    wrong_again,
)

from sealfit.errors import SealfitError
from sealfit.notebook import open as open_results
from sealfit.store import Store

READ_S = 1.0  # how long the readers read before and after a write
WAIT_S = 0.05  # longest wait of a reader before a table
LOST_S = 240  # longest time after a loss until the command has ended
REFUSED = re.compile(r"Run: sealfit |was written while it was read|is writing here|is missing or damaged")
TABLES = ("steady", "steady_fit", "aging_laws", "residuals_before")


# ---------------------------------------------------------------- processes of this computer


def started(work: Callable[[], int], folder: Path) -> tuple[int, Path]:
    """Start `work` in a forked process and return its id and where its end will be written."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "ended"
    pid = os.fork()
    if pid == 0:
        try:
            file.write_bytes(pickle.dumps(forked(work, folder)))
        finally:
            os._exit(0)
    return pid, file


def ended(process: tuple[int, Path]) -> Ended:
    """Wait for a started process and return how it ended."""
    os.waitpid(process[0], 0)
    return pickle.loads(process[1].read_bytes())


def copied(scene: Scene, folder: Path) -> Path:
    """Return a folder of work as it was before the command of a scene."""
    folder.mkdir(parents=True, exist_ok=True)
    fresh(folder / "work", scene.old)
    return folder / "work"


def two_writers(scene: Scene, folder: Path, delay_s: float) -> str:
    """Let two processes do a scene's command, one after a delay, and return what is wrong."""
    work = copied(scene, folder)
    write = partial(under_fault, scene, work, 0, "")
    first = started(write, folder / "first")
    time.sleep(delay_s)
    second = started(write, folder / "second")
    ends = [ended(first), ended(second)]
    for end in ends:
        if end.fault() or (end.code == 1 and "is writing here" not in end.err):
            return end.fault() or end.err
    if all(end.code for end in ends):
        return "both were refused"
    return wrong_again(scene, forked(write, folder), files_in(work))


# ---------------------------------------------------------------- readers


def read_lifetime(scene: Scene, out: Path, folder: Path) -> object:
    """Return what lifetime says."""
    return answer(["lifetime", out, *LIFE.split()])


def read_predict(scene: Scene, out: Path, folder: Path) -> object:
    """Return what predict writes."""
    output = folder / "answers.csv"
    answer(["predict", out, "--points", scene.here / "points.csv", "--output", output])
    return output.read_text()


def read_tables(scene: Scene, out: Path, folder: Path) -> object:
    """Return tables of one store, as one command reads them."""
    store = Store.open(out)
    store.require("close-loop")
    tables = [store.read(name).to_csv() for name in TABLES]
    return (*tables, str(store.read_json("closure")))


def read_notebook(scene: Scene, out: Path, folder: Path) -> object:
    """Return what `sealfit.open` shows of the laws."""
    return open_results(out).laws.to_csv()


def read_report(scene: Scene, out: Path, folder: Path) -> object:
    """Write the report, which takes the lock."""
    answer(["report", out])
    return "done"


READ = (read_lifetime, read_predict, read_tables, read_notebook, read_report)


def answer(words: Sequence[object]) -> str:
    """Return what a command prints; SealfitError if it ends with 1."""
    code, text = asked(words)
    if code == 1:
        raise SealfitError(text.strip())
    return text if code == 0 else f"exit code {code}: {text}"


def slowly(random: Random) -> None:
    """Let this process wait before every table it reads."""
    real = Store.read

    def read(*given, **named):
        time.sleep(random.uniform(0, WAIT_S))
        return real(*given, **named)

    Store.read = read


def reader(scene: Scene, number: int, out: Path, folder: Path, stop: Path, seed: int) -> int:
    """Read again and again; write down each answer."""
    slowly(Random(seed + number))
    read, told = READ[number % len(READ)], []
    while not (stop.exists() and told):
        try:
            told.append((read.__name__, read(scene, out, folder)))
        except SealfitError as error:
            told.append((read.__name__, error))
    (folder / "told").write_bytes(pickle.dumps(told))
    return 0


def expected(scene: Scene, work: Path) -> dict[str, object]:
    """Return the answer of every kind of reader to OUT in a folder of work."""
    return {read.__name__: read(scene, work / "out", work) for read in READ}


def state_of(said: object, known: Sequence[object]) -> str:
    """Return which of the known answers this one is."""
    if isinstance(said, SealfitError):
        return "refused" if REFUSED.search(str(said)) and "\n" not in str(said) else "wrong"
    return next((name for name, one in zip(("old", "new"), known, strict=True) if said == one), "wrong")


def readers(
    scene: Scene, folder: Path, rounds: int, count: int, seed: int, read_s: float
) -> tuple[Counter, list[str]]:
    """Let readers read while a writer makes the new state of the old, and return counts and faults."""
    counts, wrong, work = Counter(), [], folder / "work"
    trace = changed_trace(scene.here)
    after, before = trace.read_bytes(), (scene.here / "before").read_bytes()
    known = []
    for content, files in ((before, scene.old), (after, scene.here / "new")):
        trace.write_bytes(content)
        fresh(work, files)
        known.append(expected(scene, work))
    for turn in range(rounds):
        trace.write_bytes(before)
        fresh(work, scene.old)
        stop, begun = folder / f"stop-{turn}", []
        for number in range(count):
            place, own = folder / f"reader-{number}", seed + 100 * turn + number
            begun.append(started(partial(reader, scene, number, work / "out", place, stop, own), place))
        time.sleep(read_s)
        trace.write_bytes(after)
        while (
            writer := ended(started(partial(under_fault, scene, work, 0, ""), folder / "writer"))
        ).code == 1:
            time.sleep(0.05)  # a report is being written
        time.sleep(read_s)
        stop.touch()
        ends = [ended(process) for process in begun]
        wrong += [end.fault() for end in (writer, *ends) if end.fault()]
        for number in range(count):
            for kind, said in pickle.loads((folder / f"reader-{number}" / "told").read_bytes()):
                state = state_of(said, [one[kind] for one in known])
                counts[state] += 1
                wrong += [f"{kind}: {said}"] if state == "wrong" else []
        if differ := differing(work / "out", scene.here / "new" / "out"):
            wrong.append(f"round {turn}: OUT is not the new one: {differ[:3]}")
    return counts, wrong


def fresh(work: Path, files: Path) -> None:
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(files, work)


# ---------------------------------------------------------------- clusters


def on_cluster(campaign: Path, whole: Path, folder: Path, *, lose: str, after_s: float) -> tuple[str, str]:
    """Run on a cluster that loses a worker of two, or its scheduler; return how it ended and what is wrong.

    `whole` is OUT of a run without a cluster.
    """
    folder.mkdir(parents=True)
    cluster = DaskHere(folder, workers=2)
    try:
        cluster.wait()
        words = [sys.executable, "-m", "sealfit", "run", campaign, "--out", folder / "out"]
        run = subprocess.Popen(
            [*map(str, words), "--scheduler", str(cluster.file)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        time.sleep(after_s)
        (cluster.scheduler if lose == "scheduler" else cluster.workers[0]).kill()
        out, err = run.communicate(timeout=LOST_S)
    finally:
        cluster.stop()
    end = Ended(run.returncode, out, err)
    if end.fault() or (lose == "worker" and end.code):
        return "wrong", end.fault() or end.err[-300:]
    again = subprocess.run([*map(str, words), "--workers", "1"], capture_output=True, text=True, check=False)
    if again.returncode:
        return "wrong", again.stderr[-300:]
    if differ := differing(whole, folder / "out"):
        return "wrong", f"run again, it made other files: {differ[:3]}"
    return ("done" if end.code == 0 else "one line"), ""


# ---------------------------------------------------------------- command line


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--writers", type=int, default=30, help="pairs of writers")
    parser.add_argument("--rounds", type=int, default=4, help="writes under twenty readers")
    parser.add_argument("--readers", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=READ_S, help="of reading before and after a write")
    parser.add_argument("--losses", type=int, default=4, help="workers lost, and schedulers")
    parser.add_argument("--work", type=Path, help="folder to work in; else one for temporary files")
    given = parser.parse_args()
    random, wrong = Random(given.seed), []
    with tempfile.TemporaryDirectory(dir=given.work) as place:
        folder = Path(place)
        hold_time()
        remember_computations()
        scene = make_scene("run", folder)
        began = time.monotonic()
        forked(partial(under_fault, scene, copied(scene, folder / "once"), 0, ""), folder)
        longest = time.monotonic() - began
        found = [
            two_writers(scene, folder / "writers", random.uniform(0, longest)) for _ in range(given.writers)
        ]
        wrong += [f"two writers: {fault}" for fault in found if fault]
        print(f"{given.writers} pairs of writers: {sum(map(bool, found))} wrong", flush=True)
        counts, faults = readers(
            scene, folder / "readers", given.rounds, given.readers, given.seed, given.seconds
        )
        wrong += [f"readers: {fault}" for fault in faults]
        print(
            f"{given.rounds} writes under {given.readers} readers: {dict(counts)}, {len(faults)} wrong",
            flush=True,
        )
        if given.losses:
            wrong += losses(scene.here / "campaign", folder / "clusters", given.losses, random)
        print("\n".join(f"WRONG {fault}" for fault in wrong))
    return bool(wrong)


def losses(campaign: Path, folder: Path, count: int, random: Random) -> list[str]:
    """Lose so many workers and schedulers, each in a cluster of its own, and return what is wrong."""
    whole, wrong = folder / "whole", []
    words = ["run", campaign, "--out", whole, "--workers", "1"]
    began = time.monotonic()
    subprocess.run([sys.executable, "-m", "sealfit", *map(str, words)], capture_output=True, check=True)
    longest = time.monotonic() - began
    for lose in ("worker", "scheduler"):
        ends: Counter[str] = Counter()
        for number in range(count):
            after_s = random.uniform(0.1, 0.8) * longest
            end, fault = on_cluster(campaign, whole, folder / f"{lose}-{number}", lose=lose, after_s=after_s)
            ends[end] += 1
            wrong += [f"{lose} lost after {after_s:.1f} s: {fault}"] if fault else []
        print(f"{count} times a {lose} lost: {dict(ends)}", flush=True)
    return wrong


if __name__ == "__main__":
    sys.exit(main())
