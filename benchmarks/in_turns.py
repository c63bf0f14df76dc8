"""Paired measurements: the programs to compare run alternately, and ratios are computed within a turn."""

from __future__ import annotations

import importlib.metadata
import platform
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import date
from pathlib import Path

PACKAGES = ("sealfit", "numpy", "pandas", "scipy", "pyarrow", "typer")


def in_turns(
    measured: Mapping[str, Callable[[], Mapping[str, float]]], repeats: int
) -> dict[str, list[float]]:
    """Return every figure of every turn; in each turn everything is measured once, in order.

    `measured` gives by name what measures it and returns its figures, which are kept under `name` (for the
    figure "") or `name, figure`.
    """
    figures: dict[str, list[float]] = {}
    for _ in range(repeats):
        for name, measure in measured.items():
            for figure, value in measure().items():
                figures.setdefault(f"{name}, {figure}" if figure else name, []).append(value)
    return figures


def ratios(above: Sequence[float], below: Sequence[float]) -> list[float]:
    """Return the ratio of two figures in every turn."""
    return [a / b for a, b in zip(above, below, strict=True)]


def show(what: str, values: Sequence[float], unit: str = "s", limit: str = "") -> None:
    """Print a line: the median, the least and the most of all turns, and what it should be."""
    middle, low, high = statistics.median(values), min(values), max(values)
    print(f"  {what:52s}{middle:9.3f} {unit:3s} ({low:.3f} to {high:.3f})  {limit}".rstrip(), flush=True)


def heading(seed: int | None, cores: Iterable[int]) -> None:
    """Print the machine, the versions and the date."""
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in PACKAGES)
    print(f"{date.today()}, {cpu_model()}, cores used {', '.join(map(str, cores))}, seed {seed}")
    print(
        f"{platform.system()} {platform.release()}, Python {platform.python_version()}, {versions}",
        flush=True,
    )


def cpu_model() -> str:
    """Return the name of the processor, if the system provides it."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
        platform.machine(),
    )
