"""Faults of the system, injected at every call that changes a file; and memory, workers, clocks and locks.

    python benchmarks/torture/faults.py [--seed N] [--points N] [--parts NAME ...] [--jobs N]

A point is one command, one call of it and one fault (`faulty_disk`). After each of them

- the command has ended with 0, or with 1 and one line, never a traceback;
- every file of OUT is that of the old or of the new state, byte by byte;
- OUT as the commands that read see it is the old or the new state whole: its files, the steps that count as
  current, and what `predict` and `lifetime` answer. `run` makes several steps, each of them whole: after some
  of them the answers are as before or as after, or say in one line that a step is not done;
- the same command, undisturbed, ends with OUT equal byte by byte to that of an undisturbed run, and no
  temporary file is left.

After a command that said it was done, a power loss takes nothing of it away.

Campaigns are small. Every command runs in a process forked from one that has loaded the libraries. The time
of day in OUT is held, so that its files can be compared. Pure computations, the fits and the drawing, are
remembered by their arguments; everything that touches a file is done each time.
"""

# ruff: noqa: E402 (modules of this folder and the one above are found by sys.path)

from __future__ import annotations

import argparse
import contextlib
import errno
import hashlib
import io
import json
import os
import pickle
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from random import Random
from types import SimpleNamespace

HERE = Path(__file__).resolve().parent
sys.path += [str(HERE), str(HERE.parent)]

from faulty_disk import KILLED, SPACE, Disk
from process_tree import tree

from sealfit import cli, store
from sealfit.errors import SealfitError
from sealfit.ingest.stored_parts import StoredTraces
from sealfit.report import page
from sealfit.simulation import load_spec, simulate
from sealfit.store import PROVENANCE, Store
from sealfit.store.manifest import STATE

SPEC = """
name = "small"
seed = 11
[design]
days = [2, 4, 8]
speeds_mm_s = [0.5, 2, 5, 20, 50]
repeats = 1
max_rows = 60
[[noise]]
kind = "white"
sd_N = 0.2
"""
RIG = "[sensor]\naccuracy = {accuracy}\n"
POINTS_CSV = """aging_days,compression_ratio_pct,temperature_C,load_N,speed_mm_s
{day},80,60,49.03,2
4,80,60,49.03,-5
"""
VALUES_CSV = "aging_days,temperature_C,strength_MPa\n" + "".join(
    f"{day},{temperature},{value}\n"
    for temperature, values in ((60, (9.0, 8.1, 7.2, 6.6)), (80, (9.1, 7.0, 5.9, 4.8)))
    for day, value in zip((0, 4, 16, 64), values, strict=True)
)
HANGS_S = 240  # a command that takes longer has hung; on a quiet machine it takes a second
REFUSED = re.compile(r"Run: sealfit |Make it: sealfit |Make them with: sealfit ")  # a proper refusal
VARIANTS = ("nothing", "names", "some", "some")  # of what a power loss leaves


# ---------------------------------------------------------------- commands in forked processes


# Lines of libraries, after which they end the process: of OpenBLAS, and of the C library that loads others.
OF_LIBRARY = (
    "OpenBLAS error: Memory allocation still failed",
    "cannot allocate memory for thread-local data: ABORT",
)


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit code, negative for a signal, and what it printed."""

    code: int
    out: str
    err: str

    @property
    def lines(self) -> list[str]:
        """The messages, without the lines of progress."""
        return [line for line in self.err.splitlines() if line.startswith("sealfit: ")]

    def of_library(self) -> bool:
        """Whether a library without memory has ended the process, with a line of its own."""
        return self.code in (1, 127) and any(line in self.err for line in OF_LIBRARY)

    def fault(self) -> str:
        """Return why this is no proper end: not 0, not killed by a fault, and not 1 with one line."""
        if "Traceback" in self.err:
            return f"traceback: {self.err.strip().splitlines()[-2:]}"
        if self.code in (0, KILLED) or (self.code == 1 and len(self.lines) == 1):
            return ""
        if self.code == -signal.SIGALRM:
            return f"hung for {HANGS_S} s"
        return f"exit code {self.code}, {len(self.lines)} lines: {self.err[-300:]!r}"


def forked(work: Callable[[], int], folder: Path, limit_s: int = HANGS_S) -> Ended:
    """Return how `work` ends in a process of its own; what it prints goes through files in `folder`."""
    streams = [folder / name for name in ("stdout.txt", "stderr.txt")]
    pid = os.fork()
    if pid == 0:
        code = 70
        try:
            for number, path in enumerate(streams, start=1):
                os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
            sys.stdout, sys.stderr = (os.fdopen(number, "w", encoding="utf-8") for number in (1, 2))
            signal.alarm(limit_s)
            code = work()
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    _, status = os.waitpid(pid, 0)
    return Ended(os.waitstatus_to_exitcode(status), *(path.read_text("utf-8") for path in streams))


def sealfit(words: Sequence[object]) -> int:
    """Run a command line in this process and return its exit code."""
    sys.argv = ["sealfit", *map(str, words)]
    return cli.exit_code(cli.app)


def hold_time() -> None:
    """Hold the time of day that OUT keeps, for the rest of this process."""
    held = datetime(2026, 1, 1, tzinfo=UTC)
    store.datetime = SimpleNamespace(now=lambda _: held)
    store.time = SimpleNamespace(monotonic=lambda: 0.0)


# ---------------------------------------------------------------- remembered computations

COMPUTED = (
    ("sealfit.fit.steady", "fit_conditions"),
    ("sealfit.fit.aging", "fit_series"),
    ("sealfit.fit.aging", "aging_curves"),
    ("sealfit.fit.aging.all_series", "joint_laws"),
    ("sealfit.fit.aging.property", "fit_properties"),
    ("sealfit.fit.dynamic", "fit_dynamic"),
    ("sealfit.closure.loop", "close_loop"),
    ("sealfit.closure.after", "after_fits"),
    ("sealfit.fit.aging.all_series", "law_of"),
    ("sealfit.fit.aging.lifetime", "answer"),
    ("sealfit.report.page", "build_report"),
    ("sealfit.store.manifest", "version"),
)


def remember_computations() -> None:
    """Let pure functions remember what they returned, by their arguments; plots are not drawn."""
    for module, name in COMPUTED:
        __import__(module)
        real = getattr(sys.modules[module], name)
        setattr(sys.modules[module], name, _remembering(real))
    page.draw = lambda plot: {"png": b"png", "pdf": b"pdf", "svg": "<svg/>"}


def _remembering(real: Callable) -> Callable:
    known: dict[str, object] = {}

    def remembered(*given, on_progress=None, workers=1, **named):
        key = _key((given, sorted(named.items())))
        if key not in known:
            known[key] = real(*given, **named)
        return known[key]

    return remembered


def _key(given: object) -> str:
    digest = hashlib.sha256()
    for part in _parts(given):
        digest.update(part if isinstance(part, bytes) else repr(part).encode())
        digest.update(b"\0")
    return digest.hexdigest()


def _parts(given: object) -> Iterable[object]:
    """Yield what tells an argument from others: a stored part by its name, which is a hash of its content."""
    if hasattr(given, "to_csv"):
        yield given.to_csv().encode()
        yield str(given.dtypes.tolist())
    elif isinstance(given, StoredTraces):
        yield sorted(given.conditions), [path.name for path in given.paths]
    elif isinstance(given, list | tuple | dict):
        for part in given.items() if isinstance(given, dict) else given:
            yield from _parts(part)
    elif hasattr(given, "model_dump_json"):
        yield given.model_dump_json()
    elif not isinstance(given, str | int | float | None):
        yield pickle.dumps(given)
    else:
        yield given


# ---------------------------------------------------------------- scenes

RUN = "run {here}/campaign --config {here}/rig.toml --out {work}/out --workers 1"
INGEST = "ingest {here}/campaign --config {here}/rig.toml --out {work}/out --workers 1"
VALUES = "fit-aging --values {here}/values.csv --out {work}/out"
PREDICT = "predict {work}/out --points {here}/points.csv --output {work}/answers.csv"
LIFE = "--quantity mu_s --loss 3 --temperature 60 --compression 80 --law log"
LIFE_OF_VALUES = "--quantity strength_MPa --loss 20 --temperature 40 --law log"
ANSWERS = "answers.csv"


def changed_trace(here: Path) -> Path:
    return sorted((here / "campaign" / "traces").glob("*.csv"))[3]


def change_trace(here: Path) -> None:
    path = changed_trace(here)
    shutil.copy(path, here / "before")
    header, *rows = path.read_text().splitlines()
    cells = (row.rpartition(",") for row in rows)
    changed = [f"{before},{1.03 * float(force):.4f}" for before, _, force in cells]
    path.write_text("\n".join([header, *changed]) + "\n")


def change_accuracy(here: Path) -> None:
    (here / "rig.toml").write_text(RIG.format(accuracy=0.2))


def change_values(here: Path) -> None:
    (here / "values.csv").write_text(VALUES_CSV.replace("7.2", "7.3"))


def change_points(here: Path) -> None:
    (here / "points.csv").write_text(POINTS_CSV.format(day=3))


def _steps(*names: str) -> list[str]:
    return [f"{name} {{work}}/out" + ("" if name == "report" else " --workers 1") for name in names]


# By name: the commands before an input changes, the change, the commands after it, the command under test.
SCENES = {
    "run, new": ([], None, [], RUN),
    "run": ([RUN], change_trace, [], RUN),
    "ingest": ([RUN], change_trace, [], INGEST),
    "fit-steady": ([RUN], change_accuracy, [], *_steps("fit-steady")),
    "fit-aging": ([RUN], change_accuracy, _steps("fit-steady"), *_steps("fit-aging")),
    "fit-aging --values": ([VALUES], change_values, [], VALUES),
    "close-loop": (
        [RUN],
        change_accuracy,
        _steps("fit-steady", "fit-aging", "fit-dynamic"),
        *_steps("close-loop"),
    ),
    "report": (
        [RUN],
        change_accuracy,
        _steps("fit-steady", "fit-aging", "fit-dynamic", "close-loop"),
        *_steps("report"),
    ),
    "predict": ([RUN, PREDICT], change_points, [], PREDICT),
}


@dataclass(frozen=True)
class Answers:
    """What the commands that read say: the steps that are current, and exit code and text of each command."""

    current: tuple[str, ...]
    given: tuple[tuple[int, str], ...]


@dataclass(frozen=True)
class Scene:
    """A command that writes, and the folder it writes in as it was (`old`) and as it is to be (`new`).

    `files` are the contents of the two, by name; `before` and `after` what the commands that read say;
    `calls` the kinds of the command's calls that change files.
    """

    name: str
    here: Path
    old: Path
    files: tuple[dict[str, bytes], dict[str, bytes]]
    before: Answers
    after: Answers
    calls: tuple[str, ...]

    def words(self, work: Path) -> list[str]:
        """Return the command line, for a folder of work."""
        return SCENES[self.name][-1].format(here=self.here, work=work).split()


def make_scene(name: str, folder: Path) -> Scene:
    """Return a scene, made in `folder` by undisturbed commands of this process."""
    here, first = folder / name.replace(" ", ""), SCENES[name]
    before, change, then, command = first
    here.mkdir(parents=True)
    (here / "spec.toml").write_text(SPEC)
    simulate(load_spec(here / "spec.toml"), here / "campaign")
    (here / "rig.toml").write_text(RIG.format(accuracy=0.1))
    (here / "points.csv").write_text(POINTS_CSV.format(day=2))
    (here / "values.csv").write_text(VALUES_CSV)
    work, old, new = here / "work", here / "old", here / "new"
    work.mkdir()
    for words in before:
        _do(words, here, work)
    if change is not None:
        change(here)
    for words in then:
        _do(words, here, work)
    shutil.copytree(work, old)
    said = answers(name, here, work)
    _do(command, here, work)
    shutil.copytree(work, new)
    after = answers(name, here, work)
    made = Scene(name, here, old, (files_in(old), files_in(new)), said, after, ())
    shutil.rmtree(work)
    shutil.copytree(old, work)
    forked(lambda: under_fault(made, work, 0, "count"), here)
    calls, _ = pickle.loads((here / "report").read_bytes())
    return replace(made, calls=tuple(calls))


def _do(words: str, here: Path, work: Path) -> None:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
        code = sealfit(words.format(here=here, work=work).split())
    if code:
        raise RuntimeError(f"{words} ended with {code}: {said.getvalue()}")


def under_fault(scene: Scene, work: Path, at: int, fault: str) -> int:
    """Do the command of a scene in this process, with a fault at its `at`-th call."""
    disk = Disk(work, at, fault, report=work.parent / "report")
    disk.install()
    code = sealfit(scene.words(work))
    disk.end()
    return code


def files_in(folder: Path) -> dict[str, bytes]:
    """Return the files in a folder, by name."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def answers(name: str, here: Path, work: Path) -> Answers:
    """Return what the commands that read say of OUT in a folder of work."""
    properties = "values" in name
    questions = [["lifetime", work / "out", *(LIFE_OF_VALUES if properties else LIFE).split()]]
    output = work.parent / "asked.csv"
    output.unlink(missing_ok=True)
    if not properties:
        questions += [["predict", work / "out", "--points", here / "points.csv", "--output", output]]
    given = [(code, text.replace(str(work), "")) for code, text in map(asked, questions)]
    if output.exists():
        given[-1] = 0, output.read_text()
    return Answers(_current(work / "out"), tuple(given))


def told(scene: Scene, work: Path) -> Answers:
    """Return the `answers` of a process of its own."""
    file = work.parent / "told"

    def ask() -> int:
        file.write_bytes(pickle.dumps(answers(scene.name, scene.here, work)))
        return 0

    ended = forked(ask, work.parent)
    if ended.code:
        return Answers((f"ended with {ended.code}: {ended.err[-500:]}",), ())
    return pickle.loads(file.read_bytes())


def asked(words: Sequence[object]) -> tuple[int, str]:
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = sealfit(words)
    return code, err.getvalue() if code else out.getvalue()


def _current(out: Path) -> tuple[str, ...]:
    try:
        store = Store.open(out)
        return tuple(step for step in store.state.order if not store.why_stale(step))
    except SealfitError as error:
        return (str(error),)


# ---------------------------------------------------------------- points


@dataclass(frozen=True)
class Point:
    """One fault: at which call of which scene, and for a power loss what it leaves and by which seed."""

    scene: str
    at: int
    fault: str
    variant: str = ""
    seed: int = 0


def all_points(scenes: Sequence[Scene], seed: int) -> list[Point]:
    """Return every point; the last call of a scene is followed by a power loss after its end."""
    points = []
    for scene in scenes:
        for at, kind in enumerate(scene.calls, start=1):
            points += [Point(scene.name, at, fault) for fault in faults_of(kind)]
        for at in range(1, len(scene.calls) + 2):
            points += [
                Point(scene.name, at, "power", variant, seed + 1000 * k) for k, variant in enumerate(VARIANTS)
            ]
    return points


def faults_of(kind: str) -> tuple[str, ...]:
    """Return the faults of a kind of call, without power loss."""
    return ("eio", "kill") + (("enospc",) if kind in SPACE else ()) + (("short",) if kind == "write" else ())


def drawn(points: Sequence[Point], count: int, seed: int) -> list[Point]:
    """Return so many of the points at random, in turns from every scene; all of them for 0."""
    order = Random(seed).sample(points, len(points))
    rank: Counter[str] = Counter()
    ranked = []
    for point in order:
        rank[point.scene] += 1
        ranked.append((rank[point.scene], point))
    ranked.sort(key=lambda pair: pair[0])
    return [point for _, point in ranked][: count or None]


@dataclass(frozen=True)
class Verdict:
    """What was found at a point: how OUT was left, and what is wrong, if anything."""

    point: Point
    call: str
    left: str  # "old", "new" or "between": some steps of `run` are new, and others not done
    wrong: str


def judge(scene: Scene, point: Point, work: Path) -> Verdict:
    """Inject the fault of a point, look at what is left, and run the command again."""
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(scene.old, work)
    over = point.at > len(scene.calls)
    ended = forked(lambda: under_fault(scene, work, point.at, point.fault), work.parent)
    if point.fault == "power":
        _, journal = pickle.loads((work.parent / "report").read_bytes())
        shutil.rmtree(work)
        work.mkdir()
        journal.rebuild(work, point.variant, Random(f"{point.seed} {point.scene} {point.at}"))
    found, said, left = files_in(work), told(scene, work), files_in(work)
    wrong = (
        ended.fault() or wrong_files(scene, found) or wrong_files(scene, left) or wrong_answers(scene, said)
    )
    state = state_of(scene, left, said)
    if not wrong and ended.code == 0 and state != "new":
        wrong = f"it said it was done, and OUT is {state}: {said}"
    if not wrong and state == "between" and not point.scene.startswith("run"):
        wrong = f"neither the old nor the new state: {said}"
    again = forked(lambda: under_fault(scene, work, 0, ""), work.parent)
    wrong = wrong or wrong_again(scene, again, files_in(work))
    call = "end" if over else scene.calls[point.at - 1]
    return Verdict(point, call, state, wrong)


def state_of(scene: Scene, left: dict[str, bytes], said: Answers) -> str:
    """Return "old" or "new" if answers and files are those of one state, else "between"."""
    for name, files, known in zip(("old", "new"), scene.files, (scene.before, scene.after), strict=True):
        if said == known and results_in(left) == results_in(files):
            return name
    return "between"


def results_in(files: dict[str, bytes]) -> dict[str, bytes]:
    """Return the files that are results: not temporary, and no account of the steps."""
    return {
        name: content
        for name, content in files.items()
        if not is_temporary(name) and Path(name).name not in (STATE, PROVENANCE)
    }


def is_temporary(name: str) -> bool:
    """Whether a file is the lock, a staged file, or a draft of one that `predict` writes."""
    return any(part.startswith(".") for part in Path(name).parts)


def wrong_files(scene: Scene, left: dict[str, bytes]) -> str:
    """Return what is wrong with the files left: neither old nor new."""
    for name, content in left.items():
        if is_temporary(name):
            continue
        if Path(name).name in (STATE, PROVENANCE):
            try:
                json.loads(content)
            except ValueError:
                return f"{name} is no JSON"
        elif content not in (known.get(name) for known in scene.files):
            return f"{name} is neither the old nor the new one ({len(content)} bytes)"
    return ""


def wrong_answers(scene: Scene, said: Answers) -> str:
    """Return what is wrong with the answers: of neither state, or no proper refusal."""
    if any(" " in step and not REFUSED.search(step) for step in said.current):
        return f"steps: {said.current}"
    known = {*scene.before.given, *scene.after.given}
    for code, text in said.given:
        if (code, text) not in known and not (code == 1 and REFUSED.search(text) and text.count("\n") == 1):
            return f"an answer of neither state: {code} {text!r}"
    return ""


def wrong_again(scene: Scene, again: Ended, files: dict[str, bytes]) -> str:
    """Return what is wrong after the command was run again."""
    if again.code != 0:
        return f"run again, it ended with {again.code}: {again.err[-300:]}"
    new = scene.files[1]
    if extra := sorted(files.keys() - new.keys()):
        return f"run again, it left {extra[:3]}"
    if differ := [name for name in new if files.get(name) != new[name]]:
        return f"run again, it made other files: {differ[:3]}"
    return ""


def judged(scenes: Sequence[Scene], points: Sequence[Point], folder: Path, jobs: int) -> list[Verdict]:
    """Return the verdict on every point; `jobs` processes share the work."""
    by_name = {scene.name: scene for scene in scenes}
    places = [folder / f"job-{job}" for job in range(jobs)]

    def share(job: int) -> int:
        found = [judge(by_name[point.scene], point, places[job] / "work") for point in points[job::jobs]]
        (places[job] / "found").write_bytes(pickle.dumps(found))
        return 0

    in_processes(share, places)
    return [verdict for place in places for verdict in pickle.loads((place / "found").read_bytes())]


def in_processes(share: Callable[[int], int], places: Sequence[Path]) -> None:
    """Do `share(job)` in a forked process per place. No threads here: a fork copies their locks."""
    started = []
    for job, place in enumerate(places):
        place.mkdir(exist_ok=True)
        if (pid := os.fork()) == 0:
            code = 1
            try:
                code = share(job)
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        started.append(pid)
    if any(os.waitpid(pid, 0)[1] for pid in started):
        raise RuntimeError("a process of this suite failed")


def lines(verdicts: Sequence[Verdict]) -> list[str]:
    """Return a table: points per scene and fault, how OUT was left, and every failure."""
    told = [f"{'command':20s}{'fault':>8s}{'points':>8s}{'old':>6s}{'new':>6s}{'between':>10s}{'wrong':>7s}"]
    groups: dict[tuple[str, str], list[Verdict]] = {}
    for verdict in verdicts:
        groups.setdefault((verdict.point.scene, verdict.point.fault), []).append(verdict)
    for (scene, fault), group in sorted(groups.items()):
        left = Counter(verdict.left for verdict in group)
        wrong = sum(bool(verdict.wrong) for verdict in group)
        counts = f"{len(group):8d}{left['old']:6d}{left['new']:6d}{left['between']:10d}{wrong:7d}"
        told.append(f"{scene:20s}{fault:>8s}{counts}")
    told += [f"WRONG {v.point} {v.call}: {v.wrong}" for v in verdicts if v.wrong]
    return told


# ---------------------------------------------------------------- the surroundings

MEMORY_MB = (80, 2000)  # from where the program cannot load to where it has enough
NOBODY = 65534


def memory(scene: Scene, folder: Path, count: int) -> tuple[Counter, list[str]]:
    """Run under so many limits of address space on one OUT; then without a limit."""
    ends, wrong, out = Counter(), [], folder / "work" / "out"
    folder.mkdir()
    words = [sys.executable, "-m", "sealfit", *scene.words(folder / "work"), "--force"]
    for number in range(count):
        low, high = MEMORY_MB
        limit = round(low * (high / low) ** (number / (count - 1))) << 20

        def limited(limit: int = limit) -> None:
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))

        end = subprocess_ended([*words[:-3], "--workers", "2"], preexec_fn=limited)
        fault = "" if end.of_library() else end.fault()
        ends["done" if end.code == 0 else "wrong" if fault else "one line"] += 1
        wrong += [f"{limit >> 20} MB: {fault}"] if fault else []
    end = forked(lambda: sealfit(scene.words(folder / "work")), folder)
    if end.code or differing(out, scene.here / "new" / "out"):
        wrong.append(
            f"afterwards without a limit: {end.code} {differing(out, scene.here / 'new' / 'out')[:3]}"
        )
    return ends, wrong


def subprocess_ended(words: Sequence[str], **more: object) -> Ended:
    """Run a command and return how it ended; one that hangs is killed with its processes."""
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    with subprocess.Popen(words, **streams, **more) as run:
        try:
            out, err = run.communicate(timeout=HANGS_S)
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            return Ended(-signal.SIGALRM, *run.communicate())
    return Ended(run.returncode, out, err)


def workers_killed(folder: Path, count: int, random: Random) -> tuple[Counter, list[str]]:
    """Kill a process that works for close-loop at so many moments: one of two workers, or their server.

    The campaign is the sample's series at 60 degC, one repeat: smaller ones need no such processes. The
    moment is drawn from the time in which an undisturbed command has them.
    """
    ends, wrong, campaign, done, out = Counter(), [], *(folder / name for name in ("campaign", "done", "out"))
    folder.mkdir()
    spec = load_spec(HERE.parents[1] / "sample_data" / "simulated.spec.toml")
    small = {"temperatures_C": spec.design.temperatures_C[:1], "repeats": 1}
    simulate(spec.model_copy(update={"design": spec.design.model_copy(update=small)}), campaign)
    forked(lambda: sealfit(["run", campaign, "--out", done, "--workers", "1"]), folder)
    lasts_s = killed_after(done, None, random)[0]
    for _ in range(count):
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(done, out)
        _, hit, end = killed_after(out, random.uniform(0, lasts_s), random)
        fault = end.fault()
        if not fault:
            again = forked(lambda: sealfit(["close-loop", out, "--workers", "1"]), folder)
            fault = again.fault() or ", ".join(differing(out, done))
        kind = "wrong" if fault else "no process there" if not hit else "one line" if end.code else "done"
        ends[kind] += 1
        wrong += [fault] if fault else []
    return ends, wrong


def killed_after(out: Path, wait_s: float | None, random: Random) -> tuple[float, bool, Ended]:
    """Redo close-loop with two workers, and kill one of its processes so long after it has them.

    Nothing is killed where `wait_s` is None. Return for how long it had such processes, whether one was
    killed, and how the command ended.
    """
    words = [sys.executable, "-m", "sealfit", "close-loop", str(out), "--workers", "2", "--force"]
    since = until = None
    hit = False
    with subprocess.Popen(words, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run:
        while run.poll() is None:
            there, now = helpers(run.pid), time.monotonic()
            if len(there) >= 2:
                since, until = since or now, now
                if wait_s is not None and not hit and now - since >= wait_s:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(random.choice(there), signal.SIGKILL)
                        hit = True
            time.sleep(0.01)
        end = Ended(0, *run.communicate())
    return (until or 0) - (since or 0), hit, replace(end, code=run.returncode)


def helpers(pid: int) -> list[int]:
    """Return the processes that a command has started to work for it, and their server."""
    found = []
    for other in tree(pid)[1:]:
        with contextlib.suppress(OSError):
            if b"resource_tracker" not in Path(f"/proc/{other}/cmdline").read_bytes():
                found.append(other)
    return found


def read_only(scene: Scene, folder: Path) -> str:
    """Do the command on folders that may only be read, as another user where this one is root."""
    work = _work(scene, folder)
    for path in (work, *work.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)

    def refused() -> int:
        if os.getuid() == 0:
            os.setgid(NOBODY)
            os.setuid(NOBODY)
        return sealfit(scene.words(work))

    end = forked(refused, folder)
    same = results_in(files_in(work)) == results_in(scene.files[0])
    for path in (work, *work.rglob("*")):
        path.chmod(0o755)
    return end.fault() or ("" if end.code == 1 and same else f"ended with {end.code}, unchanged: {same}")


def clock_set_back(scene: Scene, folder: Path) -> str:
    """Do the command with the clock, and the times of the changed file, years before those in OUT."""
    work = _work(scene, folder)
    changed = changed_trace(scene.here)
    os.utime(changed, (1e9, 1e9))

    def earlier() -> int:
        past = datetime(2001, 9, 9, tzinfo=UTC)
        store.datetime = SimpleNamespace(now=lambda _: past)
        time.time, time.time_ns = (lambda: 1e9), (lambda: 10**18)
        return sealfit(scene.words(work))

    end = forked(earlier, folder)
    return end.fault() or ", ".join(differing(work / "out", scene.here / "new" / "out"))


def changing_file(scene: Scene, folder: Path, when: str) -> str:
    """Let a trace change "before", "within" or "after" its read, and run the command again."""
    work, trace = _work(scene, folder), changed_trace(scene.here)
    new = trace.read_bytes()
    old = b"".join(new.splitlines(keepends=True)[:-1])  # not what OUT holds, which would not be read
    trace.write_bytes(old)

    def changed_while_read() -> int:
        real, done = os.read, []

        def read(handle: int, size: int) -> bytes:
            if done or os.readlink(f"/proc/self/fd/{handle}") != str(trace.resolve()):
                return real(handle, size)
            done.append(handle)
            raw = b"" if when == "before" else real(handle, size if when == "after" else len(old) // 2)
            time.sleep(0.01)  # two writes within a tick of the clock have the same time
            trace.write_bytes(new)
            return raw or real(handle, size)

        os.read = read
        return sealfit(scene.words(work))

    end = forked(changed_while_read, folder)
    if trace.read_bytes() != new:
        return "the file was not read"
    again = forked(lambda: sealfit(scene.words(work)), folder)
    return end.fault() or again.fault() or ", ".join(differing(work / "out", scene.here / "new" / "out"))


def without_locks(scene: Scene, folder: Path, number: int) -> str:
    """Do the command on a file system that has no locks: flock fails with an error number, as on NFS."""
    work = _work(scene, folder)

    def unlocked() -> int:
        import fcntl

        def refuse(*_: object) -> None:
            raise OSError(number, os.strerror(number))

        fcntl.flock = refuse
        return under_fault(scene, work, 0, "")

    end = forked(unlocked, folder)
    return end.fault() or wrong_again(scene, end, files_in(work))


def _work(scene: Scene, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    shutil.rmtree(folder / "work", ignore_errors=True)
    shutil.copytree(scene.old, folder / "work")
    return folder / "work"


def differing(one: Path, two: Path) -> list[str]:
    """Return the tables and documents in which two OUT differ, without `inputs`: it has times of files."""
    first, second = (results_in(files_in(out)) for out in (one, two))
    names = [name for name in first.keys() | second.keys() if name.endswith((".parquet", ".arrow", ".json"))]
    return sorted(name for name in names if name != "inputs.parquet" and first.get(name) != second.get(name))


def surroundings(scenes: Sequence[Scene], folder: Path) -> dict[str, list[str]]:
    """Return what is wrong with read-only folders, a clock set back, changing files and missing locks."""
    by_name = {scene.name: scene for scene in scenes}
    numbers = (errno.ENOLCK, errno.EOPNOTSUPP)
    found = {
        "read-only folder": [read_only(scene, folder) for scene in scenes],
        "no locks": [without_locks(scene, folder, number) for scene in scenes for number in numbers],
    }
    if run := by_name.get("run"):
        times = ("before", "within", "after")
        found["file that changes while it is read"] = [changing_file(run, folder, when) for when in times]
        found["clock set back"] = [clock_set_back(run, folder)]
    return found


# ---------------------------------------------------------------- command line


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--points", type=int, default=1000, help="how many, drawn at random; 0 for all")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=SCENES, metavar="NAME")
    parser.add_argument("--limits", type=int, default=20, help="limits of memory; needs the scene run")
    parser.add_argument("--kills", type=int, default=50, help="workers killed, 5 s each on two free cores")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--work", type=Path, help="folder to work in; else one for temporary files")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.work) as place:
        folder = Path(place)
        hold_time()
        remember_computations()
        scenes = [make_scene(name, folder) for name in given.scenes]
        print(", ".join(f"{scene.name}: {len(scene.calls)} calls" for scene in scenes), flush=True)
        points = drawn(all_points(scenes, given.seed), given.points, given.seed)
        began = time.monotonic()
        verdicts = judged(scenes, points, folder, given.jobs)
        print("\n".join(lines(verdicts)))
        print(f"{len(verdicts)} points in {time.monotonic() - began:.0f} s, seed {given.seed}", flush=True)
        wrong = [verdict.wrong for verdict in verdicts if verdict.wrong]
        folder.chmod(0o755)
        for what, found in surroundings(scenes, folder / "other").items():
            wrong += told_wrong(what, len(found), [fault for fault in found if fault])
        by_name = {scene.name: scene for scene in scenes}
        if given.limits:
            ends, found = memory(by_name["run"], folder / "memory", given.limits)
            wrong += told_wrong(f"limits of memory {dict(ends)}", given.limits, found)
        if given.kills:
            random = Random(given.seed)
            ends, found = workers_killed(folder / "kills", given.kills, random)
            wrong += told_wrong(f"workers killed {dict(ends)}", given.kills, found)
    return bool(wrong)


def told_wrong(what: str, count: int, wrong: list[str]) -> list[str]:
    """Print the count of one kind of fault and what is wrong, and return the latter."""
    print(
        "\n".join([f"{what}: {count}, {len(wrong)} wrong", *(f"WRONG {fault}" for fault in wrong)]),
        flush=True,
    )
    return wrong


if __name__ == "__main__":
    sys.exit(main())
