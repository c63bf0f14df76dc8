"""How a trace file is written: its head, and what stands in each of its columns. Files written alike share it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sealfit.config import TraceFormat
from sealfit.errors import BadFile, Fault
from sealfit.ingest.columns import locate, numeric_names
from sealfit.ingest.text import Layout, find_layout, split_line


@dataclass(frozen=True, slots=True)
class Form:
    """What files that begin with the same `head` and have as many cells in their first data line have in common.

    `ours` holds our name of each position (from 0), `numeric` those that must hold numbers.
    """

    head: bytes
    layout: Layout
    cells: int
    ours: Mapping[int, str]
    numeric: Mapping[int, str]
    delimiter: str

    def fits(self, text: bytes) -> bool:
        """Return whether a file is written like this."""
        start = len(self.head)
        if not text.startswith(self.head) or (start and not self.head.endswith(b"\n")):  # it ended within the head
            return False
        return _has_data(text, start) and _cells(text, start, self.delimiter) == self.cells

    def body(self, text: bytes) -> bytes:
        """Return the data lines of a file without the line ends after the last one."""
        return text[self.layout.start :].rstrip(b"\n \t" if self.delimiter == "whitespace" else b"\n")


def form_of(text: bytes, settings: TraceFormat, file: str) -> Form:
    """Return how a file is written.

    Parameters
    ----------
    text : bytes
        The whole file as clean UTF-8 (`text.as_utf8`).

    Raises
    ------
    BadFile
        If its header does not end, it has no data, or a column is missing or named twice.
    """
    layout = find_layout(text, settings, file)
    start = layout.start
    if not _has_data(text, start):
        place = {"file": file, "action": "file left out"}
        raise BadFile(Fault("no_rows", "has a header but no data.", fix="Export it again.", **place))
    cells = _cells(text, start, settings.delimiter)
    ours = locate(layout, len(layout.names) or cells, settings, file)
    must = numeric_names(settings)
    numeric = {i: name for i, name in ours.items() if name in must}
    return Form(text[:start], layout, cells, ours, numeric, settings.delimiter)


def _has_data(text: bytes, start: int) -> bool:
    blank = b"\n \t,;"
    return bool(text[start : start + 256].strip(blank) or text[start:].strip(blank))


def _cells(text: bytes, start: int, delimiter: str) -> int:
    end = text.find(b"\n", start)
    return len(split_line(text[start : end if end >= 0 else len(text)].decode("utf-8", "replace"), delimiter))
