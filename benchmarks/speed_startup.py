"""How soon `sealfit --help` is there, and which heavy packages each command imports: a part of `speed.py`."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from in_turns import in_turns, ratios, show
from process_tree import watched

from sealfit.store import Store

HEAVY = ("numpy", "pandas", "scipy", "pyarrow", "pydantic", "jinja2", "matplotlib")
SAMPLE = Path(__file__).parents[1] / "sample_data" / "simulated"
STEPS = ("fit-steady", "fit-aging", "fit-dynamic", "close-loop", "report")


def startup(cores: Sequence[int], repeats: int) -> None:
    """Print the seconds of `sealfit --help` and of importing typer, and what the commands import."""
    program = Path(sys.executable).with_name("sealfit")
    python = [sys.executable, "-c"]
    asked = {"help": [program, "--help"], "typer": [*python, "import typer"], "python": [*python, ""]}

    def start(command: list) -> Callable[[], dict[str, float]]:
        return lambda: {"": watched(command, cores=cores, look=False).seconds}

    for command in asked.values():  # compiled, and in the system's cache
        watched(command, cores=cores, look=False)
    found = in_turns({name: start(command) for name, command in asked.items()}, repeats)
    print(f"\nstart-up, {repeats} turns")
    show("python -c ''", found["python"])
    show("python -c 'import typer'", found["typer"])
    show("sealfit --help", found["help"], "s", "at most 0.3, or twice typer")
    show("sealfit --help / import typer", ratios(found["help"], found["typer"]), "x", "at most 2, or 0.3 s")
    print(
        "\nheavy packages that a command imports, on the simulated sample; "
        "matplotlib should be in report and run only"
    )
    with tempfile.TemporaryDirectory() as folder:
        for name, words in commands(Path(folder)):
            there = imported(words, cores)
            print(
                f"  {name:14s}{', '.join(package for package in HEAVY if package in there) or 'none'}",
                flush=True,
            )


def commands(folder: Path) -> Iterator[tuple[str, list]]:
    """Yield every command with valid arguments; each must be run before the next."""
    out, points = folder / "out", folder / "points.csv"
    one = ["--workers", "1"]
    yield "--help", ["--help"]
    yield "effects", ["effects"]
    yield "check", ["check", SAMPLE, *one]
    yield "simulate", ["simulate", SAMPLE.with_suffix(".spec.toml"), "--out", folder / "campaign"]
    yield "ingest", ["ingest", SAMPLE, "--out", out, *one]
    for step in STEPS:
        yield step, [step, out, *(one if step == "close-loop" else [])]
    yield "run, again", ["run", SAMPLE, "--out", out, *one]
    Store.open(out).read("bins").head().to_csv(points, index=False)
    yield "predict", ["predict", out, "--points", points, "--output", folder / "answers.csv"]
    yield "lifetime", ["lifetime", out, "--loss", "20", "--temperature", "60"]


def imported(words: Sequence[str | Path], cores: Sequence[int]) -> set[str]:
    """Return the packages that a command imports."""
    said = watched(
        [sys.executable, "-X", "importtime", "-m", "sealfit", *words], cores=cores, look=False
    ).output
    lines = (line.rpartition("|")[2].strip() for line in said.splitlines() if line.startswith("import time:"))
    return {line.partition(".")[0] for line in lines}
