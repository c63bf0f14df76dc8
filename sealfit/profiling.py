"""Where a command's time goes: seconds and rows of every step, and of the parts of a step that take long."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass


@dataclass
class Part:
    """A step (`depth` 0) or a part of one: `rows` counts what it worked on, in `of`."""

    name: str
    depth: int
    seconds: float = 0.0
    rows: int | None = None
    of: str = ""


_parts: ContextVar[list[Part] | None] = ContextVar("parts", default=None)
_depth: ContextVar[int] = ContextVar("depth", default=0)


@contextlib.contextmanager
def profiled() -> Iterator[list[Part]]:
    """Give the list that everything `timed` in the block is written into, in the order in which it began."""
    parts: list[Part] = []
    token = _parts.set(parts)
    try:
        yield parts
    finally:
        _parts.reset(token)


@contextlib.contextmanager
def timed(name: str, rows: int | None = None, of: str = "") -> Iterator[Part]:
    """Take the time of the block, where somebody asked for it; rows may be told while it runs.

    Examples
    --------
    >>> with profiled() as parts, timed("ingest"), timed("reading", rows=3, of="files"):
    ...     pass
    >>> [(part.name, part.depth, part.rows, part.of) for part in parts]
    [('ingest', 0, None, ''), ('reading', 1, 3, 'files')]
    """
    parts = _parts.get()
    part = Part(name, _depth.get(), rows=rows, of=of)
    if parts is None:
        yield part
        return
    parts.append(part)
    token = _depth.set(part.depth + 1)
    began = time.perf_counter()
    try:
        yield part
    finally:
        part.seconds = time.perf_counter() - began
        _depth.reset(token)


def as_dicts(parts: Sequence[Part]) -> list[dict]:
    """Return the parts as plain values: step, part (null for the step itself), seconds, rows and what these are."""
    found, step = [], ""
    for part in parts:
        step = part.name if part.depth == 0 else step
        name = None if part.depth == 0 else part.name
        seconds = round(part.seconds, 3)
        found.append({"step": step, "part": name, "seconds": seconds, "rows": part.rows, "of": part.of})
    return found


def lines(profile: Sequence[Mapping]) -> list[str]:
    """Return a line per step and part: seconds, rows, and rows a second; none without a profile."""
    if not profile:
        return []
    text = [f"{'profile':28s}{'seconds':>9s}{'rows':>13s}{'a second':>11s}"]
    for part in profile:
        name = part["step"] if part["part"] is None else f"  {part['part']}"
        row = f"{name:28s}{part['seconds']:9.2f}"
        if part["rows"] is not None:
            rate = f"{part['rows'] / part['seconds']:11,.0f}" if part["seconds"] > 0 else f"{'':11s}"
            row += f"{part['rows']:13,d}{rate} {part['of']}"
        text.append(row.rstrip())
    return text
