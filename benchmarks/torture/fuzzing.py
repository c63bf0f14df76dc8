"""Fuzzing: the bytes of every input and of every file of OUT are mutated.

    python benchmarks/torture/fuzzing.py [--seed N] [--inputs N] [--results N] [--step N] [--jobs N]

A mutation is drawn by Hypothesis: a file cut, bits flipped, blocks swapped, doubled or zeroed, or the content
of another file. Inputs are traces, runs.csv, the rig config, the table of points, the table of values, .xlsx,
.tdms, .mat and .parquet. After each, what the commands call ends without a traceback, within 10 s, and with
one line for each fault. Of OUT every file is mutated, the lock and state.json included: `predict`,
`lifetime`, `report`, `effects` and `run` end without a traceback, within 10 s of the processor, and answer as
they do of the undamaged folder or say in one line what is wrong. Where `run` succeeds, the tables are then
identical to those of the undamaged folder. Pure computations are done once for equal arguments.

Crafted results, whose JSON names effects of their own in OUT, in the campaign or behind a link, are asked
everything: no Python of theirs is run. Forged ones, with right checksums, are in forged.py.

Hypothesis draws from a seed, keeps no examples and does not shrink: the mutation is printed as it is.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import json
import os
import shutil
import signal
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import hypothesis
import pyarrow as pa
import pyarrow.parquet as pq
from hypothesis import strategies as st
from pollution import (
    CONFIG_TEXT,
    POINTS,
    RUNS,
    VALUES,
    _files,
    closed,
    read_a_trace,
    read_points,
    read_runs,
    read_values,
    small_campaign,
    text_of,
    trace_rows,
)  # fmt: skip

from sealfit.cli import app, exit_code
from sealfit.errors import SealfitError
from sealfit.store.manifest import ConfigCopy
from sealfit.store.staged_writes import LOCK

LIMIT_S = 10
KINDS = ("cut", "bit", "bits", "swapped", "doubled", "zeros", "other file", "inserted")


@dataclass(frozen=True)
class Found:
    """What a mutation of a file led to: ok, refused, stale, or one of "traceback", "slow", "wrong"."""

    file: str
    mutation: str
    verdict: str
    said: str = ""


BAD = ("traceback", "slow", "wrong", "not healed", "crashed")
CRASHING = ("mat",)  # inputs that a library in C reads whose crashes are known: scipy.io.loadmat


# ---------------------------------------------------------------- mutations


@st.composite
def mutations(draw, raw: bytes, others: list[bytes]) -> tuple[str, bytes]:
    """Return the name of a mutation and the mutated bytes."""
    size = max(len(raw), 1)
    kind, at = draw(st.sampled_from(KINDS)), draw(st.integers(0, size - 1))
    length = draw(st.sampled_from([1, 2, 7, 16, 64, 512, 4096]))
    block, name = raw[at : at + length], f"{kind} at {at} of {len(raw)}, {length}"
    if kind == "cut":
        return f"{kind} at {at} of {len(raw)}", raw[:at]
    if kind in ("bit", "bits"):
        changed = bytearray(raw)
        for _ in range(1 if kind == "bit" else 20):
            if changed:
                changed[draw(st.integers(0, len(changed) - 1))] ^= 1 << draw(st.integers(0, 7))
        return name, bytes(changed)
    if kind == "swapped":
        return name, raw[:at] + raw[at + length : at + 2 * length] + block + raw[at + 2 * length :]
    if kind == "doubled":
        return name, raw[:at] + block + raw[at:]
    if kind == "zeros":
        return name, raw[:at] + b"\0" * len(block) + raw[at + length :]
    if kind == "inserted":
        return name, raw[:at] + draw(st.binary(min_size=1, max_size=64)) + raw[at:]
    return kind, draw(st.sampled_from(others))


def drawn(raw: bytes, others: list[bytes], count: int, seed: int) -> Iterator[tuple[str, bytes]]:
    """Yield so many different mutations of a file."""
    found: dict[bytes, str] = {}

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=4 * count, deadline=None, database=None, phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )  # fmt: skip
    @hypothesis.given(mutations(raw, others))
    def collect(mutation):
        name, changed = mutation
        if changed != raw:
            found.setdefault(changed, name)

    collect()
    # The first that Hypothesis draws are the simplest.
    chosen = list(found.items())[-count:]
    yield from ((name, changed) for changed, name in chosen)


OWNER = b'{"host": "rig", "pid": 7}'


class TooSlow(BaseException):
    """What is done takes too long."""


@contextlib.contextmanager
def limited(seconds: float = LIMIT_S) -> Iterator[None]:
    """Raise `TooSlow` in what takes more seconds of the processor, or twenty times as many of the clock."""
    timers = (
        (signal.SIGPROF, signal.ITIMER_PROF, seconds),
        (signal.SIGALRM, signal.ITIMER_REAL, 20 * seconds),
    )

    def late(*_):
        raise TooSlow(f"took more than {seconds} s")

    before = [signal.signal(number, late) for number, _, _ in timers]
    for _, timer, most in timers:
        signal.setitimer(timer, most)
    try:
        yield
    finally:
        for (number, timer, _), handler in zip(timers, before, strict=True):
            signal.setitimer(timer, 0)
            signal.signal(number, handler)


# ---------------------------------------------------------------- inputs

OTHERS = [
    b"",
    text_of(trace_rows(7)).encode(),
    b'{"a": 1}',
    b"\x89PNG\r\n\x1a\n" + bytes(range(256)),
    b"PK\x03\x04" + b"\0" * 60,
]


def inputs(work: Path, seed: int) -> dict[str, tuple[bytes, Callable[[bytes], object]]]:
    """Return the bytes of every input, and what the commands do with them."""
    folder = Path(tempfile.mkdtemp(dir=work))

    def config(raw: bytes) -> object:
        (folder / "rig.toml").write_bytes(raw)
        return ConfigCopy.at(folder / "rig.toml").parse()

    table = trace_rows(seed)
    found = {
        "trace": (text_of(table).encode(), partial(read_a_trace, folder)),
        "runs.csv": (text_of(RUNS).encode(), partial(read_runs, _below(folder, "runs"))),
        "config": (CONFIG_TEXT.replace('[units]\nforce = "N"\n', "").encode(), config),
        "points": (text_of(POINTS).encode(), partial(read_points, closed(work, seed), folder)),
        "values": (text_of(VALUES).encode(), partial(read_values, folder)),
    }
    for ending, raw in _files(table, [0, 1, 2, 3]).items():
        found[ending] = (raw, partial(read_a_trace, _below(folder, ending), name=f"0.{ending}"))
    return found


def _below(folder: Path, name: str) -> Path:
    (folder / name).mkdir()
    return folder / name


def fuzzed_input(name: str, work: Path, count: int, seed: int) -> list[Found]:
    """Return what so many mutations of an input led to."""
    raw, read = inputs(work, seed)[name]
    judge = _apart if name in CRASHING else _ended
    return [Found(name, kind, *judge(read, changed)) for kind, changed in drawn(raw, OTHERS, count, seed)]


def _ended(read: Callable[[bytes], object], raw: bytes) -> tuple[str, str]:
    """Return verdict and words of reading these bytes."""
    try:
        with limited(), contextlib.redirect_stderr(io.StringIO()):
            read(raw)
    except SealfitError as error:
        texts = [str(fault) for fault in getattr(error, "faults", [error])]
        odd = [text for text in texts if "\n" in text]
        return ("traceback" if odd else "refused"), " | ".join(odd or texts)
    except TooSlow as error:
        return "slow", str(error)
    except Exception:
        return "traceback", traceback.format_exc(limit=-4)
    return "read", ""


def _apart(read: Callable[[bytes], object], raw: bytes) -> tuple[str, str]:
    """Return the same of a process of its own, which may crash."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        verdict, said = _ended(read, raw)
        os.write(writing, json.dumps([verdict, said[:2000]]).encode())
        os._exit(0)
    os.close(writing)
    with open(reading, "rb") as pipe:
        told = pipe.read()
    _, status = os.waitpid(child, 0)
    return tuple(json.loads(told)) if status == 0 else ("crashed", f"signal {status & 127}")


# ---------------------------------------------------------------- results

# Pure computations, done once for equal arguments: what is tested is what is read and written around them.
COMPUTED = (
    ("sealfit.fit.steady", "fit_conditions"), ("sealfit.fit.aging.all_series", "joint_laws"),
    ("sealfit.fit.dynamic", "fit_dynamic"), ("sealfit.closure.loop", "close_loop"),
    ("sealfit.closure.after", "after_fits"), ("sealfit.report.page", "build_report"),
)  # fmt: skip


def remember_computations() -> None:
    """Let the pure computations return what they did before for equal arguments."""
    for module, name in COMPUTED:
        owner = importlib.import_module(module)
        setattr(owner, name, _remembered(getattr(owner, name)))


def _remembered(real: Callable) -> Callable:
    known: dict[str, object] = {}

    def call(*given, on_progress=None, workers=1, **more):
        key = "\0".join(map(_key, (*given, *more.values())))
        if key not in known:
            known[key] = real(*given, **more)
        return known[key]

    return call


def _key(given: object) -> str:
    if hasattr(given, "to_csv"):
        return given.to_csv()
    if isinstance(given, dict):  # the times in what is known of the steps do not matter
        return (
            "" if "packages" in given else "\0".join(f"{name} {_key(value)}" for name, value in given.items())
        )
    return "\0".join(map(_key, given)) if isinstance(given, list | tuple) else repr(given)


def command(*words: str, limit: float = LIMIT_S) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of one command, in this process."""
    out, err, argv = io.StringIO(), io.StringIO(), sys.argv
    sys.argv = ["sealfit", *words]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), limited(limit):
            try:
                code = exit_code(app)
            except SystemExit as ended:
                code = ended.code
    finally:
        sys.argv = argv
    return int(code or 0), out.getvalue(), err.getvalue()


@dataclass
class Folder:
    """A folder of results, and what the commands answer of it as long as it is undamaged."""

    campaign: Path
    out: Path
    work: Path

    def __post_init__(self):
        self.points = self.work / "points.csv"
        self.points.write_text(text_of(POINTS))
        self.files = {
            path.relative_to(self.out).as_posix(): path.read_bytes()
            for path in sorted(self.out.rglob("*"))
            if path.is_file()
        }
        self.times = {name: (self.out / name).stat() for name in self.files}
        self.answers = {name: self.ask(name) for name in ASKED}
        if refused := [answer for answer in self.answers.values() if answer[0]]:
            raise RuntimeError(f"the undamaged folder does not answer: {refused[0][2]}")

    def ask(self, name: str) -> tuple[int, str, str]:
        """Return exit code, answer and messages of one command."""
        out, answers = str(self.out), self.work / "answers.csv"
        answers.unlink(missing_ok=True)
        words = {
            "predict": ("predict", out, "--points", str(self.points), "--output", str(answers)),
            "lifetime": ("lifetime", out, "--quantity", "mu_c", "--loss", "10", "--json"),
            "effects": ("effects", out, "--json"),
            "report": ("report", out, "--json"),
            "run": ("run", str(self.campaign), "--out", out, "--workers", "1", "--json"),
        }[name]
        code, text, said = command(*words)
        if name == "predict" and answers.exists():
            text = answers.read_text()
        return code, text, said

    def restore(self) -> None:
        """Put every file back, with its times."""
        for path in self.out.rglob("*"):
            name = path.relative_to(self.out).as_posix()
            if path.is_file() and name not in self.files:
                path.unlink()
        for name, raw in self.files.items():
            path = self.out / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if not path.is_file() or path.read_bytes() != raw:
                path.unlink(missing_ok=True)
                path.write_bytes(raw)
                os.utime(path, ns=(self.times[name].st_atime_ns, self.times[name].st_mtime_ns))

    def damaged(self, name: str, raw: bytes, asked: tuple[str, ...]) -> Iterator[tuple[str, str]]:
        """Damage a file, ask, restore; yield verdict and words of every command, and whether `run` heals."""
        path = self.out / name
        path.write_bytes(raw)
        try:
            for command_name in asked:
                verdict, said = self._verdict(command_name)
                yield verdict, said
                if command_name == "run" and verdict == "same":
                    yield self._healed()
        finally:
            self.restore()

    def _verdict(self, name: str) -> tuple[str, str]:
        try:
            code, text, said = self.ask(name)
        except TooSlow as error:
            return "slow", f"{name}: {error}"
        if code == 70 or "Traceback" in said:
            return "traceback", f"{name}: {said[-900:]}"
        if code:
            lines = [line for line in said.splitlines() if line.startswith("sealfit: ")]
            return (
                ("refused", f"{name}: {said[:300]}") if len(lines) == 1 else ("traceback", f"{name}: {said}")
            )
        if name == "effects" and json.loads(text)["note"] != json.loads(self.answers[name][1])["note"]:
            return "refused", f"{name}: {json.loads(text)['note']}"
        same = _shown(name, text) == _shown(name, self.answers[name][1])
        return ("same", name) if same else ("wrong", f"{name}: {text[:300]}")

    def _healed(self) -> tuple[str, str]:
        other = [
            name
            for name, raw in self.files.items()
            if name.endswith((".parquet", ".arrow")) or name in ("closure.json", "model.json")
            if not (self.out / name).is_file() or _differ((self.out / name).read_bytes(), raw)
        ]
        return ("not healed", f"run: {', '.join(other[:5])} differ") if other else ("healed", "run")


def _differ(raw: bytes, other: bytes) -> bool:
    """Whether two files differ in more than bytes of a Parquet file that are no data."""
    if raw == other:
        return False
    try:
        tables = [pq.read_table(io.BytesIO(one), page_checksum_verification=True) for one in (raw, other)]
    except (OSError, pa.ArrowException):
        return True
    return not tables[0].equals(tables[1])


ASKED = ("predict", "lifetime", "effects", "report", "run")


def _shown(name: str, text: str) -> object:
    """Return an answer without what was done for it."""
    if name in ("run", "report"):
        document = json.loads(text)
        return {key: value for key, value in document.items() if key != "done"}
    return text


def results_folder(work: Path, seed: int) -> Folder:
    """Return a folder of results of its own for a process, in which computations are remembered."""
    remember_computations()
    own = Path(tempfile.mkdtemp(dir=work))
    campaign = small_campaign(own, seed)
    out = own / "out"
    code, _, said = command("run", str(campaign), "--out", str(out), "--workers", "1", limit=600)
    if code:
        raise RuntimeError(said)
    return Folder(campaign, out, own)


def files_of_results(folder: Folder, plots: int = 2) -> list[str]:
    """Return the files of OUT and its lock; of the plots, which are alike, some."""
    drawn = [name for name in folder.files if name.startswith("plots/")]
    return [LOCK, *(name for name in folder.files if name not in (LOCK, *drawn[plots:]))]


def fuzzed_results(
    work: Path, seed: int, count: int, share: tuple[int, int] = (0, 1), heal: int = 1
) -> list[Found]:
    """Return what so many mutations of every file of OUT led to; `run` is asked after every `heal`-th."""
    folder, found = results_folder(work, seed), []
    others = [
        b"",
        folder.files["state.json"],
        folder.files["steady.parquet"],
        b'{"program": "sealfit"}',
        b"[]",
    ]
    for i, name in enumerate(files_of_results(folder)):
        if i % share[1] != share[0]:
            continue
        for k, (mutation, raw) in enumerate(drawn(folder.files.get(name, OWNER), others, count, seed + i)):
            asked = ASKED if (k + i) % heal == 0 else ASKED[:3]
            found += [Found(name, mutation, *told) for told in folder.damaged(name, raw, asked)]
    return found


# ---------------------------------------------------------------- crafted results


def crafted(work: Path, seed: int) -> list[Found]:
    """Return what every command does of results whose every file names effects that would run code.

    The effects lie in OUT, in the campaign, or behind a link into them; a file of effects writes a mark when
    it is run, which must never be there.
    """
    folder = results_folder(work, seed)
    mark = folder.work / "was_run"
    code = f"import pathlib\npathlib.Path({str(mark)!r}).write_text('run')\n"
    found = []
    for place in (folder.out / "effects", folder.campaign / "effects", folder.work / "link"):
        if place.name == "link":
            (folder.out / "hidden").mkdir(exist_ok=True)
            (folder.out / "hidden" / "evil.py").write_text(code)
            place.symlink_to(folder.out / "hidden")
        else:
            place.mkdir()
            (place / "evil.py").write_text(code)
        for name, change in _crafts(folder, place).items():
            (folder.out / name).write_text(change)
            for asked in ASKED:
                verdict, said = folder._verdict(asked)
                found.append(
                    Found(name, f"effects in {place.name}", "wrong" if mark.exists() else verdict, said)
                )
                mark.unlink(missing_ok=True)
            folder.restore()
            (folder.out / "effects").mkdir(exist_ok=True)
            if place.parent == folder.out:
                (place / "evil.py").write_text(code)
        for option in ("predict", "effects", "close-loop", "run"):
            words = [option, *([str(folder.campaign), "--out"] if option == "run" else []), str(folder.out)]
            words += (
                ["--points", str(folder.points), "--output", str(folder.work / "a.csv")]
                if option == "predict"
                else []
            )
            ended, _, said = command(*words, "--effects-folder", str(place))
            ok = ended == 1 and not mark.exists()
            found.append(
                Found("--effects-folder", place.name, "refused" if ok else "wrong", f"{option}: {said[:200]}")
            )
            mark.unlink(missing_ok=True)
    return found


def _crafts(folder: Folder, place: Path) -> dict[str, str]:
    """Return the content of the JSON files of OUT with effects in `place`, named wherever they could be."""
    named = f'\n[loop]\neffects_folder = "{place}"\n'
    state = json.loads(folder.files["state.json"])
    state["config"]["text"] += named
    state["config"]["path"] = str(folder.out / "gone.toml")
    state["effects_folder"] = str(place)
    state["own_effects"] = {"evil.py": None}
    model = json.loads(folder.files["model.json"])
    model["effects_folder"] = str(place)
    model["config"].setdefault("loop", {})["effects_folder"] = str(place)
    model["after"] = (
        {**model.get("after", {}), "effects_folder": str(place)}
        if isinstance(model.get("after"), dict)
        else str(place)
    )
    closure = json.loads(folder.files["closure.json"]) | {"effects_folder": str(place)}
    return {
        "state.json": json.dumps(state),
        "model.json": json.dumps(model),
        "closure.json": json.dumps(closure),
    }


# ---------------------------------------------------------------- main

INPUTS = ("trace", "runs.csv", "config", "points", "values", "xlsx", "tdms", "mat", "parquet")


def _part(job: tuple) -> list[Found]:
    name, *rest = job
    if name.startswith("forged"):
        import forged

        return getattr(forged, name)(*rest)
    if name == "crafted":
        return crafted(*rest)
    return fuzzed_results(*rest) if name == "results" else fuzzed_input(name, *rest)


def table_of(found: list[Found]) -> str:
    """Return how often each verdict came, by kinds of files."""
    kinds = {}
    for one in found:
        kind = one.file if one.file in INPUTS or "." not in one.file else f"OUT *{Path(one.file).suffix}"
        kinds.setdefault("OUT lock" if "lock" in one.file else kind, Counter())[one.verdict] += 1
    verdicts = ["read", "same", "refused", "healed", *BAD]
    lines = [f"{'':22}" + "".join(f"{v:>11}" for v in verdicts)]
    lines += [
        f"{kind:22}" + "".join(f"{count[v]:11}" for v in verdicts) for kind, count in sorted(kinds.items())
    ]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description="fuzzing; see the top of the file")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--inputs", type=int, default=100, help="mutations of each input")
    parser.add_argument("--results", type=int, default=4, help="mutations of each file of OUT")
    parser.add_argument(
        "--heal", type=int, default=4, help="`report` and `run` are asked after every so many"
    )
    parser.add_argument("--step", type=int, default=20, help="of the forgeries every so many")
    parser.add_argument("--jobs", type=int, default=2)
    asked = parser.parse_args()
    work = Path(tempfile.mkdtemp(prefix="fuzzing-"))
    try:
        closed(work, asked.seed)
        parts = asked.jobs  # each makes results of its own
        jobs = [("results", work, asked.seed, asked.results, (i, parts), asked.heal) for i in range(parts)]
        jobs += [("crafted", work, asked.seed), ("forged", work, asked.seed, asked.step)]
        jobs += [("forged_tables", work, asked.seed, asked.step)]
        jobs += ((name, work, asked.inputs, asked.seed) for name in INPUTS)
        with ProcessPoolExecutor(asked.jobs, mp_context=get_context("fork")) as pool:
            found = [one for part in pool.map(_part, jobs) for one in part]
    finally:
        shutil.rmtree(work, ignore_errors=True)
    print(table_of(found))
    bad = [one for one in found if one.verdict in BAD]
    for one in bad:
        print(f"\n{one.verdict}: {one.file}: {one.mutation}: {one.said}")
    total = Counter(one.verdict for one in found)
    print(f"\n{len(found)} answers, seed {asked.seed}: " + ", ".join(f"{total[v]} {v}" for v in BAD))
    return int(bool(bad))


if __name__ == "__main__":
    raise SystemExit(main())
